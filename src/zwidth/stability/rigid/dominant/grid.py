"""Compute the dominant poles of a grid of walls: one power series and one certificate per cell of walls.

A *cell* is a rectangle of neighboring walls in the (alpha, beta) plane. One or two of its poles are expanded in the
position of the wall (`stability.rigid.dominant.series`). One count of poles
(`stability.rigid.dominant.pole_count.count_poles_in_cell`) certifies for all walls of the cell that no other pole is
larger. C1 to C5 denote proofs in docs/theory/maps.md. A cell without a certificate is divided into smaller cells. Walls
of the smallest cells without a certificate are *open*: their result is NaN, and `stability.rigid.dominant.arrays`
computes each of them separately.

A grid has the axes device, row (beta) and column (alpha); the *position* of a cell or a wall is its index triple on
these axes. Only a *window* of the grid, a range of rows and columns, is computed. Within a cell, xi and eta are alpha
and beta relative to the center, scaled to -1 to 1. A pole is e^(re + j im) with 0 <= im <= pi. A field ``order`` of a
pole is an index into `ORDERS`; it is ``len(ORDERS)`` if no circle encloses the pole.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyvander

from zwidth.stability.rigid.characteristic_polynomial import LoopFactors, factor_loop
from zwidth.stability.rigid.dominant.pole_count import count_poles_in_cell
from zwidth.stability.rigid.dominant.search import list_starts
from zwidth.stability.rigid.dominant.series import (
    ORDERS,
    RATE_ACCURACY,
    REAL_AXIS_WIDTH,
    Cells,
    EnclosedPole,
    enclose_poles,
    expand_log,
    select_cells,
)
from zwidth.stability.rigid.dominant.steps import halley_step

# Side lengths of the cells of a square grid, in walls. Cells of other grids have the same numbers of walls and the
# proportions of the grid.
CELL_SIDES = (128, 64, 32, 16, 8)
# Sizes of batches, chosen such that the working arrays stay in the cache.
CELLS_PER_LIST = 1 << 9  # number of cells whose poles are searched at once
CELLS_PER_BATCH = 1 << 7  # number of cells whose series are computed at once
WALLS_PER_WRITE = 1 << 16  # number of walls whose poles are evaluated and stored at once
# Number of Halley steps from each starting point of the search for the two largest poles at the center of a cell.
HALLEY_STEPS = 5
# Distance in log z, multiplied by n + 1 because neighboring poles of a long delay are about 2 pi/(n + 1) apart. It has
# two uses: Halley steps have converged if the last step is shorter, because an expansion may start anywhere near the
# pole; and two results closer together than this distance are the same pole.
SAME_POLE_DISTANCE = 1e-2
# Circles on which poles are counted. Each number is the distance in log |z| of the circle below the lower bound of the
# expanded poles, divided by the distance of this bound from the poles at the center of the cell. A certified count on
# one of the circles suffices (C5): a near circle encloses other poles of similar modulus; a far circle keeps its
# distance from the expanded poles.
COUNT_CIRCLES = (0.3, 1.5, 6.0)


class Area(NamedTuple):
    """A grid of walls for one or more devices, and the window of the grid that is computed.

    The shapes are (devices or 1, columns) for alpha, (devices or 1, rows) for beta, and (devices,) for delta and d.
    """

    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray
    d: np.ndarray
    window: tuple[slice, slice]  # ranges of rows (beta) and of columns (alpha)

    @classmethod
    def whole(cls, alpha: np.ndarray, beta: np.ndarray, delta: np.ndarray, d: np.ndarray) -> Area:
        """Return an area whose window is the whole grid."""
        return cls(alpha, beta, delta, d, (slice(0, beta.shape[1]), slice(0, alpha.shape[1])))

    def walls(self, position: tuple[np.ndarray, ...]) -> list[np.ndarray]:
        """Return alpha, beta, delta and d at positions (device, row, column) in the window."""
        device, row, column = position
        alpha, beta = (device if part.shape[0] > 1 else 0 * device for part in (self.alpha, self.beta))
        row, column = row + self.window[0].start, column + self.window[1].start
        return [self.alpha[alpha, column], self.beta[beta, row], self.delta[device], self.d[device]]


class _AxisPieces:
    """The values along one axis (alpha or beta) of the grid, divided into pieces; a piece is one side of a cell."""

    def __init__(self, values: np.ndarray, side: int) -> None:
        with np.errstate(all="ignore"):
            pieces = np.pad(values, ((0, 0), (0, -values.shape[1] % side)), mode="edge")
            pieces = pieces.reshape(values.shape[0], -1, side)
            low, high = pieces.min(-1), pieces.max(-1)
            self.center = 0.5 * (low + high)
            # Keep the half width positive, also if all values of a piece are equal, because the positions are divided
            # by it.
            self.half = np.maximum(0.5 * (high - low), 1e-12 * np.abs(self.center) + 1e-200)
            self.positions = (pieces - self.center[..., None]) / self.half[..., None]

    def locate(self, device: np.ndarray, piece: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the index of a piece in the arrays of this axis, which have the shape (devices or 1, pieces)."""
        return device if self.center.shape[0] > 1 else 0 * device, piece


def pad_to_16(index: np.ndarray) -> np.ndarray:
    """Pad an index array to a multiple of 16 by repeating its last entry, so that results do not depend on the length.

    Otherwise NumPy may round the last entries, which do not fill a vector register, differently from all others.
    """
    return np.concatenate([index, np.repeat(index[-1:], -index.size % 16)])


def _find_two_poles(loop: LoopFactors, fractional: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return re and im of each cell's two largest distinct poles found by Halley's method; shape (2, cells)."""
    previous = re, im = list_starts(loop, fractional)
    distance = SAME_POLE_DISTANCE / loop.n_plus_1
    for _ in range(HALLEY_STEPS):
        previous = re, im
        re, im = halley_step(re, im, loop, fractional)
    converged = np.abs(re - previous[0]) + np.abs(im - previous[1]) < distance
    im = np.where(im < REAL_AXIS_WIDTH, 0.0, np.where(np.pi - im < REAL_AXIS_WIDTH, np.pi, im))
    re, cells = np.where(converged, re, -np.inf), np.arange(re.shape[1])
    first = re.argmax(0)
    is_same = np.abs(re - re[first, cells]) + np.abs(im - im[first, cells]) < distance
    second = np.where(is_same, -np.inf, re).argmax(0)
    best = np.stack([first, second])
    return re[best, cells], im[best, cells]


def _list_cell_sizes(rows: int, columns: int) -> list[tuple[int, int]]:
    """Return the cell sizes to be tried as pairs (rows, columns) of powers of 2, the largest cells first."""
    log_aspect, all_sides = 0.5 * np.log2(columns / rows), []
    # Use no cells with a side above a tenth of the grid, because within such cells the dominant pole usually changes to
    # another pole.
    for side in (side for side in CELL_SIDES if side < 0.1 * max(rows, columns) or side == CELL_SIDES[-1]):
        rows_per_cell = int(2.0 ** np.clip(np.round(np.log2(side) - log_aspect), 0.0, 2.0 * np.log2(side)))
        all_sides.append((rows_per_cell, side**2 // rows_per_cell))
    return all_sides


class _CellGrid:
    """All cells of one size, and the computation of their poles.

    ``results`` are arrays of re and, if requested, im. They cover the window, extended to whole cells of the largest
    size; ``corner`` is the position of the first wall of the extended window.
    """

    def __init__(
        self, area: Area, sides: tuple[int, int], accuracy: float, results: list[np.ndarray], corner: np.ndarray
    ) -> None:
        self.area, self.sides, self.accuracy = area, sides, accuracy
        self.axes = _AxisPieces(area.beta, sides[0]), _AxisPieces(area.alpha, sides[1])
        # Reshape the results to five axes: device, cell row, cell column, wall row in the cell, and wall column in the
        # cell.
        (devices, rows, columns), (height, width) = results[0].shape, sides
        shape = devices, rows // height, height, columns // width, width
        self.results = [values.reshape(shape).swapaxes(2, 3) for values in results]
        # Number of walls from one cell to the next along the axes device, row and column.
        self.steps = np.array([[1], *([side] for side in sides)])
        self.first = corner // self.steps

    def split(self, positions: np.ndarray, sides: tuple[int, int]) -> np.ndarray:
        """Divide cells of size ``sides`` into cells of this object's size; return those that overlap the window."""
        counts = np.array([1, *sides]) // self.steps[:, 0]
        offsets = np.indices(counts.tolist()).reshape(3, 1, -1)
        positions = ((positions * counts[:, None])[:, :, None] + offsets).reshape(3, -1)
        low, (start, stop) = (positions * self.steps)[1:], np.array([(w.start, w.stop) for w in self.area.window]).T
        return positions[:, ((low < stop[:, None]) & (low + self.steps[1:] > start[:, None])).all(0)]

    def solve_all(self, positions: np.ndarray, fractional: bool) -> np.ndarray:
        """Store the poles of all cells that can be certified, in batches; return the positions of the other cells."""
        lists = (positions[:, start : start + CELLS_PER_LIST] for start in range(0, positions.shape[1], CELLS_PER_LIST))
        return np.concatenate([positions[:, :0], *(self._solve(some, fractional) for some in lists)], axis=1)

    def _solve(self, positions: np.ndarray, fractional: bool) -> np.ndarray:
        """Store the poles of the cells of one batch that can be certified; return the positions of the others."""
        count = positions.shape[1]
        positions = positions[:, pad_to_16(np.arange(count))]
        device, *pieces = positions
        index = [axis.locate(device, piece) for axis, piece in zip(self.axes, pieces, strict=True)]
        beta, alpha = (axis.center[i] for axis, i in zip(self.axes, index, strict=True))
        b, a = (axis.half[i] for axis, i in zip(self.axes, index, strict=True))
        cells = Cells(factor_loop(alpha, beta, self.area.delta[device], self.area.d[device], fractional), a, b)
        re, im = _find_two_poles(cells.loop, fractional)
        first = enclose_poles(re[0], im[0], cells, fractional, self.accuracy)
        certified = self._certify([first], positions, cells, fractional)
        # In cells without a certificate, expand a second pole, which may be the dominant one for some walls of the
        # cell.
        chosen = pad_to_16(np.flatnonzero((first.order < len(ORDERS)) & ~certified))
        if chosen.size:
            part = select_cells(cells, chosen)
            second = enclose_poles(re[1, chosen], im[1, chosen], part, fractional, self.accuracy)
            poles = [select_cells(first, chosen), second]
            certified[chosen] = self._certify(poles, positions[:, chosen], part, fractional)
        return positions[:, :count][:, ~certified[:count]]

    def _certify(self, poles: list[EnclosedPole], positions: np.ndarray, cells: Cells, fractional: bool) -> np.ndarray:
        """Store the poles of cells whose dominant pole is provably one of ``poles`` (C4, C5); return their mask."""
        enclosed = np.logical_and.reduce([pole.order < len(ORDERS) for pole in poles])
        if len(poles) == 2:
            enclosed &= poles[0].is_disjoint(poles[1])
        index = pad_to_16(np.flatnonzero(enclosed))
        poles, positions, cells = (
            [select_cells(pole, index) for pole in poles],
            positions[:, index],
            select_cells(cells, index),
        )
        # Count the poles outside all circles by a single call.
        circles = [np.minimum.reduce([pole.low - x * (pole.re - pole.low) for pole in poles]) for x in COUNT_CIRCLES]
        loop, a, b = select_cells(cells, np.tile(np.arange(index.size), len(circles)))
        outside, certain = count_poles_in_cell(np.concatenate(circles), loop, (a, b), fractional)
        shape, count = (len(circles), index.size), sum(np.where(pole.is_real, 1, 2) for pole in poles)
        accepted = (certain.reshape(shape) & (outside.reshape(shape) == count)).any(0)
        certified = np.zeros(enclosed.size, bool)
        certified[index[accepted]] = True
        for k, pole in enumerate(poles):
            self._write(pole, np.flatnonzero(accepted), positions, cells, k > 0)
        return certified

    def _write(
        self, pole: EnclosedPole, accepted: np.ndarray, positions: np.ndarray, cells: Cells, merge: bool
    ) -> None:
        """Store one pole of each accepted cell, in batches of equal order; with ``merge``, only where it is larger."""
        walls_per_cell = self.sides[0] * self.sides[1]
        # Reuse the same buffers for all batches, because allocating memory would take as long as the computation.
        buffers = np.empty((len(self.results), max(1, WALLS_PER_WRITE // walls_per_cell), *self.sides))
        for k, order in enumerate(ORDERS):
            index = accepted[pole.order[accepted] == k]
            for start in range(0, index.size, CELLS_PER_BATCH):
                chosen = index[start : start + CELLS_PER_BATCH]
                batch = select_cells(pole, pad_to_16(chosen))
                all_series = expand_log(batch, select_cells(cells, pad_to_16(chosen)), order, len(self.results) > 1)
                # Bound |re| from below by the magnitude of the constant term of the series minus those of all other
                # terms. Leave a wall open (NaN) if the error of re is too large relative to |re|.
                sizes, least = np.abs(all_series[0]), batch.error[k] / RATE_ACCURACY
                is_close = 2.0 * sizes[:, 0, 0] - sizes.sum((1, 2)) < least
                for first in range(0, chosen.size, buffers.shape[1]):
                    part = slice(first, min(first + buffers.shape[1], chosen.size))
                    place = positions[:, chosen[part]]
                    values = [
                        self._evaluate(series[part], place, order, buffer[: part.stop - first])
                        for series, buffer in zip(all_series, buffers, strict=True)
                    ]
                    close = np.flatnonzero(is_close[part])
                    near = values[0][close]
                    values[0][close] = np.where(np.abs(near) < least[part][close, None, None], np.nan, near)
                    self._store(values, tuple(place - self.first), merge)

    def _evaluate(self, series: np.ndarray, positions: np.ndarray, order: int, buffer: np.ndarray) -> np.ndarray:
        """Return the values of each cell's series at all walls of the cell, stored in ``buffer``."""
        device, *pieces = positions
        eta, xi = (
            polyvander(axis.positions[axis.locate(device, piece)], order)
            for axis, piece in zip(self.axes, pieces, strict=True)
        )
        xi = xi.transpose(0, 2, 1)
        # Multiply along the shorter side first, because the first product is then smaller; only the second one has the
        # full size of the cell.
        first, second = (eta @ series, xi) if self.sides[0] < self.sides[1] else (eta, series @ xi)
        return np.matmul(first, second, out=buffer)

    def _store(self, values: list[np.ndarray], index: tuple[np.ndarray, ...], merge: bool) -> None:
        """Store re and im of the walls of some cells; with ``merge``, only where the new re is larger or NaN (open)."""
        if merge:
            old = [results[index] for results in self.results]
            keeps = (old[0] >= values[0]) | np.isnan(old[0])
            values = [np.where(keeps, *pair) for pair in zip(old, values, strict=True)]
        for results, new in zip(self.results, values, strict=True):
            results[index] = new


def compute_grid_poles(area: Area, accuracy: float, with_angle: bool = False) -> list[np.ndarray]:
    """Compute the dominant poles e^(re + j im) of the walls in the window of a grid; NaN for open walls.

    Returns:
        Arrays of shape (devices, betas, alphas): the radius e^re, re, and im if requested.
    """
    # Place the cells by the whole grid and not by the window, so that the result for a wall does not depend on the
    # window. For this purpose, extend the window to whole cells of the largest size.
    sizes = _list_cell_sizes(area.beta.shape[1], area.alpha.shape[1])
    starts, stops = zip(
        *((w.start // side, -(-w.stop // side)) for w, side in zip(area.window, sizes[0], strict=True)), strict=True
    )
    corner = np.array([[0], *([start * side] for start, side in zip(starts, sizes[0], strict=True))])
    shape = area.d.size, *((stop - start) * side for start, stop, side in zip(starts, stops, sizes[0], strict=True))
    results = [np.full(shape, np.nan) for _ in range(1 + with_angle)]
    is_fractional = area.d != np.floor(area.d)
    devices = [np.flatnonzero(is_fractional == kind) for kind in (False, True)]
    corners = [np.arange(start, stop) for start, stop in zip(starts, stops, strict=True)]
    open_cells = [np.reshape(np.meshgrid(each, *corners, indexing="ij"), (3, -1)) for each in devices]
    with np.errstate(all="ignore"):
        for sides, larger in zip(sizes, (sizes[0], *sizes), strict=False):
            level = _CellGrid(area, sides, accuracy, results, corner)
            open_cells = [
                level.solve_all(level.split(cells, larger), kind == 1) for kind, cells in enumerate(open_cells)
            ]
            if not any(cells.size for cells in open_cells):
                break
    # Compute the radii before the extended window is cut to the requested one, because NumPy may round the last
    # elements of an array differently.
    results.insert(0, np.exp(results[0]))
    rows, columns = (
        slice(w.start - first, w.stop - first) for w, first in zip(area.window, corner[1:, 0].tolist(), strict=True)
    )
    return [values[:, rows, columns] for values in results]
