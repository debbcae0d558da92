"""Compute the dominant poles of a grid of walls: one power series and one certificate per cell of walls.

In each cell, one or two *groups* of poles (one pole, or a pair near the real axis) are expanded in the wall's position
(`stability.rigid.pole_cells`). One count (`stability.rigid.pole_count.count_poles_in_cell`) certifies for all walls of
the cell that no other pole is larger, by the argument principle. The proofs, C1 to C6, are in docs/theory/maps.md.
Cells that fail, also because of other pairs, are divided in four; walls of the smallest cells that fail are left
*open*, and `stability.rigid.dominant_poles` computes them one by one. The *special* walls are those that are open or
whose spectral radius is so close to 1 that its side of 1 is uncertain.

A grid has the axes device, row (beta) and column (alpha); a *position* is an index triple of these, of a cell or of a
wall. Only a *window* of the grid, a range of rows and columns, is computed. xi and eta are the positions in alpha and
beta relative to the center of the cell, from -1 to 1. A *log radius* is log |z| of a pole z, a *decay rate* is -log |z|
of the dominant pole. `AllowedErrors` converts the requested accuracy of radii to the largest error of log radii
(``limit``); only if this accuracy is *coarse*, which excludes decay rates, may another pole be slightly larger. A field
``order`` of a group is an index of `ORDERS`; it is ``len(ORDERS)`` if no circle encloses the group.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyvander

from zwidth.stability.rigid.characteristic_function import halley_step
from zwidth.stability.rigid.characteristic_polynomial import LoopFactors, factor_loop
from zwidth.stability.rigid.dominant_pole_search import list_starts
from zwidth.stability.rigid.pole_cells import (
    ORDERS,
    REAL_AXIS_WIDTH,
    ROUNDING,
    VERDICT_WIDTH,
    AllowedErrors,
    Cells,
    Group,
    compute_interpolation_weights,
    compute_larger,
    enclose_poles,
    expand_sums,
    find_stationary_point,
    is_larger_accurate,
    list_chebyshev_nodes,
    select_cells,
)
from zwidth.stability.rigid.pole_count import count_poles_in_cell

# Sides of the cells of a square grid, in walls. Cells of other grids have as many walls and the grid's proportions.
CELL_SIDES = (128, 64, 32, 16, 8)
# Sizes of batches, chosen such that the working arrays stay in the cache.
CELLS_PER_LIST = 1 << 9  # number of cells whose poles are searched at once
CELLS_PER_BATCH = 1 << 7  # number of cells whose series are computed at once
WALLS_PER_WRITE = 1 << 16  # number of walls whose poles are evaluated and stored at once
# Number of Halley steps from each starting point of the search for the two largest poles at the center of a cell.
HALLEY_STEPS = 5
# Distance in log z times n + 1; with a long delay, neighboring poles are about 2 pi/(n + 1) apart. Halley steps have
# converged if the last step is shorter (expansions may start anywhere near the pole); closer ends are the same pole.
SAME_POLE_DISTANCE = 1e-2
# Largest number of walls along an axis for which powers and interpolation weights are cached.
MAX_CACHED = 1 << 14
# Circles on which poles are counted: distances in log |z| below the lower bound of the groups' poles, relative to the
# distance between this bound and the poles at the center of the cell. One success suffices (C5): a near
# circle keeps close poles inside, a far one keeps its distance from the poles of the group.
COUNT_CIRCLES = (0.3, 1.5, 6.0)


class Area(NamedTuple):
    """A grid of walls for several devices, or a window of it.

    alpha and beta have the shape (devices or 1, walls); delta and d have one value per device.
    """

    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray
    d: np.ndarray
    window: tuple[slice, slice]  # of beta and of alpha

    @classmethod
    def whole(cls, alpha: np.ndarray, beta: np.ndarray, delta: np.ndarray, d: np.ndarray) -> Area:
        """Return an area without a window, i.e. the whole grid."""
        return cls(alpha, beta, delta, d, (slice(0, beta.shape[1]), slice(0, alpha.shape[1])))

    def walls(self, position: np.ndarray) -> list[np.ndarray]:
        """Return alpha, beta, delta and d at positions (3, walls) in the window."""
        device, row, column = position
        alpha, beta = (device if part.shape[0] > 1 else 0 * device for part in (self.alpha, self.beta))
        row, column = row + self.window[0].start, column + self.window[1].start
        return [self.alpha[alpha, column], self.beta[beta, row], self.delta[device], self.d[device]]


class _AxisPieces:
    """The values along one axis of the grid, divided into pieces of one cell each: (devices, pieces)."""

    def __init__(self, values: np.ndarray, side: int) -> None:
        with np.errstate(all="ignore"):
            pieces = np.pad(values, ((0, 0), (0, -values.shape[1] % side)), mode="edge")
            pieces = pieces.reshape(values.shape[0], -1, side)
            low, high = pieces.min(-1), pieces.max(-1)
            self.center = 0.5 * (low + high)
            # Divide by a positive number, also if all values of a piece are equal.
            self.half = np.maximum(0.5 * (high - low), 1e-12 * np.abs(self.center) + 1e-200)
            self._positions = (pieces - self.center[..., None]) / self.half[..., None]
        self._tables: dict[Any, np.ndarray] = {}

    def table(self, function: Callable[[np.ndarray, int], np.ndarray], order: int, pieces: Any) -> np.ndarray:
        """Return ``function`` (powers or interpolation weights) at the walls of pieces, shape (pieces, walls, ...)."""
        if self._positions.size > MAX_CACHED:
            return function(self._positions[pieces], order)
        if (function, order) not in self._tables:
            self._tables[function, order] = function(self._positions, order)
        return self._tables[function, order][pieces]


def pad_to_16(index: np.ndarray) -> np.ndarray:
    """Pad an index array with its last entry to a multiple of 16, so that results do not depend on the batch size.

    NumPy's vectorized loops may round the last entries, which do not fill a vector, differently.
    """
    return np.concatenate([index, np.repeat(index[-1:], -index.size % 16)])


def _bound_on_one_side(re: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Return ``re - error`` and ``re + error``, limited so that both are on the same side of the unit circle as re.

    If re is closer to 0 than the limit, the bounds do not enclose it, and the certificate fails.
    """
    gap = 2.0 * VERDICT_WIDTH
    return (
        np.where(re > 0, np.maximum(re - error, gap), re - error),
        np.where(re > 0, re + error, np.minimum(re + error, -gap)),
    )


def _find_two_poles(loop: LoopFactors, fractional: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return re and im of the two largest distinct poles that Halley's method finds per cell, of shape (2, cells)."""
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


class GridPoles(NamedTuple):
    """Spectral radii and, if requested, decay rates, of shape (devices, betas, alphas); NaN for open walls."""

    radius: np.ndarray
    rate: np.ndarray
    special: tuple[np.ndarray, ...]


class _ResultArrays:
    """Result arrays of a window that is extended to whole cells, and a list of the special walls."""

    def __init__(self, area: Area, sides: tuple[int, int], with_rate: bool) -> None:
        # Extend the window to whole cells of the largest size, because only whole cells are computed.
        windows = list(zip(area.window, sides, strict=True))
        starts = [part.start // side * side for part, side in windows]
        sizes = [-(-part.stop // side) * side - start for (part, side), start in zip(windows, starts, strict=True)]
        shape, self.first = (area.d.size, *sizes), np.array([[0], *([start] for start in starts)])
        self.radius, self.rate = np.empty(shape), np.empty(shape if with_rate else (0, 0, 0))
        self.special: list[np.ndarray] = []  # positions of the special walls

    def cut_out(self, window: tuple[slice, slice]) -> GridPoles:
        """Return the results in the window."""
        rows, columns = (
            slice(part.start - start, part.stop - start)
            for part, start in zip(window, self.first[1:, 0].tolist(), strict=True)
        )
        radius, rate = (values[:, rows, columns] for values in (self.radius, self.rate))
        index = np.concatenate([np.empty((3, 0), int), *self.special], axis=1) - [[0], [rows.start], [columns.start]]
        is_inside = (index[1:] >= 0).all(0) & (index[1] < radius.shape[1]) & (index[2] < radius.shape[2])
        # Remove duplicates, because walls for which two groups were compared may be listed twice. Walls of which only
        # the smaller pole is close to the unit circle are listed needlessly.
        is_special = np.zeros(radius.shape, bool)
        is_special[tuple(index[:, is_inside])] = True
        return GridPoles(radius, rate, np.unravel_index(np.flatnonzero(is_special), radius.shape))


def _list_cell_sizes(rows: int, columns: int) -> list[tuple[int, int]]:
    """Return the sizes of the cells as pairs (rows, columns), the largest first; all numbers are powers of 2."""
    log_aspect, all_sides = 0.5 * np.log2(columns / rows), []
    # Use no cells with a side above a tenth of the grid, because in such cells another pole usually becomes dominant.
    for side in (side for side in CELL_SIDES if side < 0.1 * max(rows, columns) or side == CELL_SIDES[-1]):
        rows_per_cell = int(2.0 ** np.clip(np.round(np.log2(side) - log_aspect), 0.0, 2.0 * np.log2(side)))
        all_sides.append((rows_per_cell, side**2 // rows_per_cell))
    return all_sides


def _view_as_cells(values: np.ndarray, sides: tuple[int, int]) -> np.ndarray:
    """Return a view with the axes device, cell row, cell column, row in the cell and column in the cell."""
    (devices, rows, columns), (height, width) = values.shape, sides
    return values.reshape(devices, rows // height, height, columns // width, width).swapaxes(2, 3)


class _CellGrid:
    """The cells of one size, and the computation of their poles."""

    def __init__(self, area: Area, sides: tuple[int, int], errors: AllowedErrors, results: _ResultArrays) -> None:
        self.area, self.sides, self.errors, self.results = area, sides, errors, results
        self.axes = _AxisPieces(area.alpha, sides[1]), _AxisPieces(area.beta, sides[0])
        self.radius, self.rate = _view_as_cells(results.radius, sides), _view_as_cells(results.rate, sides)
        # Step in walls between neighboring cells, along the axes device, row and column.
        self.steps = np.array([[1], *([side] for side in sides)])
        self.first = results.first // self.steps

    def split(self, positions: np.ndarray, sides: tuple[int, int]) -> np.ndarray:
        """Divide cells with the given sides into cells of this size; return those that meet the window."""
        counts = np.array([1, *sides]) // self.steps[:, 0]
        offsets = np.indices(counts.tolist()).reshape(3, 1, -1)
        positions = ((positions * counts[:, None])[:, :, None] + offsets).reshape(3, -1)
        low, (start, stop) = (positions * self.steps)[1:], np.array([(w.start, w.stop) for w in self.area.window]).T
        return positions[:, ((low < stop[:, None]) & (low + self.steps[1:] > start[:, None])).all(0)]

    def solve_all(self, positions: np.ndarray, fractional: bool) -> np.ndarray:
        """Store the poles of all cells that can be certified, in batches; return the positions of the other cells."""
        lists = (positions[:, start : start + CELLS_PER_LIST] for start in range(0, positions.shape[1], CELLS_PER_LIST))
        return np.concatenate([positions[:, :0], *(self.solve(some, fractional) for some in lists)], axis=1)

    def solve(self, positions: np.ndarray, fractional: bool) -> np.ndarray:
        """Store the poles of all cells that can be certified; return the positions of the other cells."""
        count = positions.shape[1]
        positions = positions[:, pad_to_16(np.arange(count))]
        axis_indices = self._index_axes(positions)
        alpha, beta = (axis.center[position] for axis, position in zip(self.axes, axis_indices, strict=True))
        half = (axis.half[position] for axis, position in zip(self.axes, axis_indices, strict=True))
        loop = factor_loop(alpha, beta, self.area.delta[positions[0]], self.area.d[positions[0]], fractional)
        cells = Cells(loop, *half)
        re, im = _find_two_poles(loop, fractional)
        single = enclose_poles(1, re[0], im[0], cells, fractional, self.errors)
        certified = self._certify([single], positions, cells, fractional)
        if self.errors.is_coarse:
            index = pad_to_16(np.flatnonzero(~certified))
            if index.size:
                certified[index] = self._certify_uniform(
                    re[0, index], positions[:, index], select_cells(cells, index), fractional
                )
        enclosed = (single.order < len(ORDERS)) | certified
        # Expand two poles: as two groups if a circle encloses the first one, but the second one may be larger; as a
        # pair if no circle encloses the first one alone.
        for mask, poles in ((enclosed & ~certified, 1), (~enclosed, 2)):
            index = pad_to_16(np.flatnonzero(mask))
            if not index.size:
                continue
            part = select_cells(cells, index)
            if poles == 1:
                other = enclose_poles(1, re[1, index], im[1, index], part, fractional, self.errors)
                groups = [select_cells(single, index), other]
            else:
                # Use the real zero of A' between the two poles as the center.
                center = find_stationary_point(re[0, index], im[0, index], part.loop, fractional)
                groups = [enclose_poles(2, *center, part, fractional, self.errors)]
            certified[index] = self._certify(groups, positions[:, index], part, fractional)
        return positions[:, :count][:, ~certified[:count]]

    def _evaluates_logarithms(self, k: int) -> bool:
        """Return whether series of the order ``ORDERS[k]`` are evaluated at each wall instead of interpolated."""
        return self.errors.with_rate or min(self.sides) <= list_chebyshev_nodes(ORDERS[k]).size

    def _index_axes(self, positions: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the indices of the cells on the alpha axis and on the beta axis, each as (device, piece)."""
        device, row, column = positions
        return [
            (device if axis.center.shape[0] > 1 else 0 * device, position)
            for axis, position in zip(self.axes, (column, row), strict=True)
        ]

    def _certify(self, groups: list[Group], positions: np.ndarray, cells: Cells, fractional: bool) -> np.ndarray:
        """Store the poles of cells whose groups provably contain all dominant poles (C4 to C6); return their mask."""
        enclosed = np.logical_and.reduce([group.order < len(ORDERS) for group in groups])
        if len(groups) == 2:
            enclosed &= groups[0].is_disjoint(groups[1])
        index = pad_to_16(np.flatnonzero(enclosed))
        groups = [select_cells(group, index) for group in groups]
        circles = [
            np.minimum.reduce([group.low - x * (group.re - group.low) for group in groups]) for x in COUNT_CIRCLES
        ]
        counts = [sum(group.n_poles for group in groups)] * len(circles)
        if self.errors.is_coarse:
            # Also accept other poles that are larger by at most `AllowedErrors.reserve` and on the same side of the
            # unit circle.
            low = np.maximum.reduce([group.low for group in groups])
            circles.append(_bound_on_one_side(low, self.errors.reserve)[1])
            counts.append(0 * counts[0])
        loop, a, b = select_cells(cells, np.tile(index, len(circles)))
        # Count the poles outside each circle, in one call.
        outside, certain = count_poles_in_cell(np.concatenate(circles), loop, (a, b), fractional)
        shape = len(circles), index.size
        certified = np.zeros(positions.shape[1], bool)
        certified[index[(certain.reshape(shape) & (outside.reshape(shape) == counts)).any(0)]] = True
        selected, positions, cells = np.flatnonzero(certified[index]), positions[:, index], select_cells(cells, index)
        for k, group in enumerate(groups):
            self._write_group(group, selected, positions, cells, k > 0)
        return certified

    def _certify_uniform(self, re: np.ndarray, positions: np.ndarray, cells: Cells, fractional: bool) -> np.ndarray:
        """Store one radius for each cell whose spectral radii agree within the accuracy (C6); return a mask of them."""
        loop, a, b = select_cells(cells, np.tile(np.arange(re.size), 2))
        circles = np.concatenate(_bound_on_one_side(re, self.errors.accuracy))
        outside, certain = (part.reshape(2, -1) for part in count_poles_in_cell(circles, loop, (a, b), fractional))
        uniform = certain.all(0) & (outside[0] > 0) & (outside[1] == 0)
        values = np.exp(np.where(re > 0, *_bound_on_one_side(re, 0.0)))
        # Store no rates, because coarse accuracy excludes them.
        self.radius[tuple((positions - self.first)[:, uniform])] = values[uniform, None, None]
        return uniform

    def _write_group(
        self, group: Group, selected: np.ndarray, positions: np.ndarray, cells: Cells, merge: bool
    ) -> None:
        """Compute and store the poles of one group in the selected cells, in batches of equal series order.

        Args:
            group: The group of each cell.
            selected: Indices of the selected cells.
            positions: Positions of all ``cells``.
            merge: Keep values of another group that are larger.
        """
        for k, order in enumerate(ORDERS):
            index = selected[group.order[selected] == k]
            for start in range(0, index.size, CELLS_PER_BATCH):
                chosen = index[start : start + CELLS_PER_BATCH]
                padded = pad_to_16(chosen)
                batch = select_cells(group, padded)
                with np.errstate(all="ignore"):
                    sums = expand_sums(batch, select_cells(cells, padded), order)
                    self._write(positions[:, chosen], sums, batch, k, merge)

    def _write(self, positions: np.ndarray, sums: list[np.ndarray], group: Group, k: int, merge: bool) -> None:
        """Store the poles of all walls of some cells; with ``merge``, only those larger than the stored ones."""
        size, log_error = max(1, WALLS_PER_WRITE // (self.sides[0] * self.sides[1])), group.log_error[k]
        # Interpolate the differences from the radius at the center and not the radii, because the rounding error is
        # proportional to the largest interpolated value.
        center = np.exp(group.re)[:, None, None]
        if len(sums) == 1:
            (logarithms,) = sums
            logarithms[:, 0, 0] += group.re
            if self._evaluates_logarithms(k):
                polynomials = [(logarithms, polyvander)]
            else:
                powers = polyvander(list_chebyshev_nodes(ORDERS[k]), ORDERS[k])
                polynomials = [(np.exp(powers @ logarithms @ powers.T) - center, compute_interpolation_weights)]
            # Bound |log radius| from below by the magnitude of the constant term minus those of all other terms.
            sizes = np.abs(logarithms)
            least_log = np.maximum(2.0 * sizes[:, 0, 0] - sizes.sum((1, 2)), 0.0)
            # Select the cells in which a wall may be special: too close to the unit circle or, with rates only, not
            # accurate enough. Without rates, `limit` is the same for all smaller sizes for which an order is chosen.
            is_close = (least_log < 2.0 * self.errors.uncertain_width) | (log_error > self.errors.limit(least_log))
        else:
            polynomials, is_close = [(x, polyvander) for x in sums], np.ones(log_error.size, bool)
        # Reuse one buffer, because allocating memory would take as long as the computation.
        buffers = np.empty((len(polynomials), min(size, positions.shape[1]), *self.sides))
        for start in range(0, positions.shape[1], size):
            part = slice(start, min(start + size, positions.shape[1]))
            batch, close_cells = positions[:, part], np.flatnonzero(is_close[part])
            values = [
                self._evaluate_at_walls(x[part], basis, k, batch, buffer)
                for (x, basis), buffer in zip(polynomials, buffers, strict=True)
            ]
            if len(sums) == 2:
                values = self._select_larger(values, select_cells(group, part), k)
            elif self._evaluates_logarithms(k):
                close = values[0][close_cells]
                inaccurate = log_error[part][close_cells, None, None] > self.errors.limit(np.abs(close))
                values[0][close_cells] = np.where(inaccurate, np.nan, close)
                values = [np.exp(values[0]), -values[0]][: 1 + self.errors.with_rate]
            else:
                values[0] += center[part]
            if close_cells.size:
                self._note_special(batch[:, close_cells], values[0][close_cells])
            index = tuple(batch - self.first)
            for array, new, choose in zip((self.radius, self.rate), values, (np.maximum, np.minimum), strict=False):
                array[index] = choose(array[index], new) if merge else new

    def _select_larger(self, sums: list[np.ndarray], group: Group, k: int) -> list[np.ndarray]:
        """Return radius and rate of the larger of two poles; NaN if not accurate enough.

        ``sums`` are the sums of u/U and (u/U)^2 over both poles, with the radius U = ``disk`` of the circle (C1).
        """
        re, disk, error = (x[:, None, None] for x in (group.re, group.disk, group.error[k] + ROUNDING))
        values, discriminant = compute_larger(sums[0], sums[1], disk)
        values += re
        accurate = is_larger_accurate(discriminant, disk, error, self.errors.limit(np.abs(values)))
        values[~accurate] = np.nan
        return [np.exp(values), -values][: 1 + self.errors.with_rate]

    def _evaluate_at_walls(
        self, values: np.ndarray, basis: Any, k: int, positions: np.ndarray, buffer: np.ndarray
    ) -> np.ndarray:
        """Evaluate the series of each cell, or the interpolation between nodes, at all walls of the cell.

        Args:
            values: Coefficients in eta and xi, or values at the nodes, of each cell.
            basis: Function of `_AxisPieces.table`: powers or interpolation weights.
            k: Index of the order in `ORDERS`.
            positions: Positions of the cells.
            buffer: Array for the result.
        """
        axis_indices = zip(self.axes, self._index_axes(positions), strict=True)
        xi, eta = (axis.table(basis, ORDERS[k], position) for axis, position in axis_indices)
        xi = xi.transpose(0, 2, 1)
        # Multiply along the longer side last, because the second product then expands to the full size of the cell.
        first, second = (eta @ values, xi) if self.sides[0] < self.sides[1] else (eta, values @ xi)
        return np.matmul(first, second, out=buffer[: positions.shape[1]])

    def mark_open(self, positions: np.ndarray) -> None:
        """Set the radii and rates of all walls of some cells to NaN, i.e. leave the walls open."""
        self._note_special(positions, np.full((positions.shape[1], *self.sides), np.nan))
        for array in (self.radius, self.rate)[: 1 + self.errors.with_rate]:
            array[tuple(positions - self.first)] = np.nan

    def _note_special(self, positions: np.ndarray, radius: np.ndarray) -> None:
        """Add the walls whose radius is NaN or so close to 1 that its side is uncertain to the special walls."""
        # The width applies to log radii, which differ from radius - 1 by less than 1 % here.
        index = np.flatnonzero(~(np.abs(radius - 1.0) > 1.01 * self.errors.uncertain_width))
        cell, *offset = np.unravel_index(index, radius.shape)
        corner = (self.steps * (positions - self.first))[1:, cell]
        self.results.special.append(np.concatenate([positions[:1, cell], corner + offset]))


def compute_grid_poles(area: Area, accuracy: float, with_rate: bool = False) -> GridPoles:
    """Compute the dominant poles of a window of a grid; NaN for walls that no cell certifies accurately enough."""
    # Compute each cell of the whole grid separately, so that the result of a wall does not depend on the window.
    sizes, errors = _list_cell_sizes(area.beta.shape[1], area.alpha.shape[1]), AllowedErrors(accuracy, with_rate)
    is_fractional = area.d != np.floor(area.d)
    results = _ResultArrays(area, sizes[0], with_rate)
    corners = [np.arange(w.start // side, -(-w.stop // side)) for w, side in zip(area.window, sizes[0], strict=True)]
    devices = [np.flatnonzero(is_fractional == kind) for kind in (False, True)]
    open_cells = [np.reshape(np.meshgrid(each, *corners, indexing="ij"), (3, -1)) for each in devices]
    with np.errstate(all="ignore"):
        for sides, larger in zip(sizes, (sizes[0], *sizes), strict=False):
            level = _CellGrid(area, sides, errors, results)
            open_cells = [
                level.solve_all(level.split(cells, larger), kind == 1) for kind, cells in enumerate(open_cells)
            ]
            if not any(cells.size for cells in open_cells):
                break
            if sides == sizes[-1]:
                level.mark_open(np.concatenate(open_cells, axis=1))
    return results.cut_out(area.window)
