"""Compute the dominant pole of each wall of an array, certified: spectral radii and decay rates.

The dominant pole e^(re + j im) is the pole of largest modulus. e^re is the spectral radius, -re the decay rate per
period. A result is certified by counting the poles outside a circle (`stability.rigid.dominant.pole_count`); walls
without a certificate are *open*.

The walls are given by *columns*: one-dimensional arrays of alpha, beta, delta and d. Most walls are computed by one
compiled kernel (`stability.rigid.dominant.search`). Walls that this kernel does not certify are computed again by
slower methods in NumPy. On grids of alpha and beta, one Taylor series serves a whole *cell* of neighboring walls
(`stability.rigid.dominant.grid`); walls without a certified series are computed one by one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.status import Status
from zwidth.core.types import Array
from zwidth.core.xp import epsilon, namespace
from zwidth.numerics.blocks import map_blocks
from zwidth.numerics.evaluate import BLOCK, FEW, Route, compile_columns
from zwidth.plant.rigid_mass import classify_delays
from zwidth.stability.rigid.broadcasting import Points, fold
from zwidth.stability.rigid.characteristic_polynomial import LoopFactors, factor_loop
from zwidth.stability.rigid.crossover import stable_kernel
from zwidth.stability.rigid.dominant.grid import Area, compute_grid_poles, pad_to_16
from zwidth.stability.rigid.dominant.pole_count import count_poles
from zwidth.stability.rigid.dominant.search import (
    DominantPoles,
    bisect_radius,
    bound_radius,
    certification_width,
    certify_starts,
    quick_kernel,
    round_to_real,
)
from zwidth.stability.rigid.normalization import wall_status

# If a pole count is uncertain because of rounding errors, the count is repeated with larger error bounds: the required
# accuracy times these factors, up to `MAX_ERROR`.
ERROR_FACTORS = 10.0 ** np.arange(12)
MAX_ERROR = 0.1  # largest relative error of a radius that is certified
# Bound of the rounding error of a computed radius. For alpha = 0, a radius below 1 + RADIUS_ROUNDING is set to 1,
# because one pole is exactly 1.
RADIUS_ROUNDING = 1e-13
# Largest certified relative error of a decay rate; with a larger error the rate is NaN.
MAX_RATE_ERROR = 1e-3
# Value of |log radius| below which the closed-form stability verdict, not the computed radius, decides whether the
# radius is above or below 1. Within 1e-10 of the stability boundary, one in ten computed radii is on the wrong side of
# 1.
VERDICT_WIDTH = 1e-7
# Upper limit of the accuracy that is added to `VERDICT_WIDTH` for walls of a grid, because their |log radius| has this
# error.
MAX_UNCERTAIN_WIDTH = 1e-5
# Value of |sin(im)| below which a pole e^(re + j im) counts as real, i.e. as one pole and not as a conjugate pair.
REAL_AXIS_WIDTH = 1e-6
# Smallest number of walls per device for which a grid is computed by cells; for fewer walls, computing each wall
# separately is faster.
SMALLEST_MAP = 1 << 11
# Number of walls per batch in NumPy. Smaller batches take longer per wall.
BATCH_SIZE = 1 << 13
# Number of open walls per batch in NumPy. It is smaller, because their arrays have four rows, one per starting point,
# and NumPy rounds complex products differently in arrays of 256 KB or more.
OPEN_BATCH_SIZE = 1 << 11
# Largest number of walls for which each wall is computed separately, without a test whether the walls form a grid.
FEW_FOR_CELLS = 1 << 13
# Number of walls per compiled batch. All large batches have this size, so that they share one compiled program.
PIECE = BLOCK >> 3

# Default accuracy: largest relative error of spectral radii and decay rates.
ACCURACY = 1e-9
NOT_REQUESTED = np.empty(0)  # placeholder for results that are not requested


def compute_dominant_poles(columns: list[np.ndarray], accuracy: float, route: Route = "auto") -> DominantPoles:
    """Return the dominant pole of each wall, given columns of alpha, beta, delta and d of equal length.

    With ``route`` "numpy" or "jax", the result for a wall does not depend on the other walls.
    """
    fractional = columns[3] != np.floor(columns[3])
    if not fractional.any() or fractional.all():
        return _compute_by_kind(columns, accuracy, bool(fractional.any()), route)
    # Compute walls with fractional and with integer delays separately: counting poles requires the zeros of a cubic
    # polynomial for fractional delays, but only of a quadratic one for integer delays.
    results = DominantPoles(*(np.empty(fractional.size) for _ in DominantPoles._fields))
    for index in (np.flatnonzero(fractional), np.flatnonzero(~fractional)):
        for leaf, values in zip(
            results, compute_dominant_poles([c[index] for c in columns], accuracy, route), strict=True
        ):
            leaf[index] = values
    return results


def _compute_by_kind(columns: list[np.ndarray], accuracy: float, fractional: bool, route: Route) -> DominantPoles:
    """Return the dominant poles of walls whose delays are all fractional (``fractional`` is True) or all integer."""
    size = columns[0].size
    arguments = [*columns, np.full(size, accuracy)]
    with np.errstate(all="ignore"):
        if size == 1 and route == "auto":
            # Compute with plain numbers, which is several times faster than with arrays of length 1.
            results = [
                np.reshape(leaf, 1)
                for leaf in quick_kernel(*(column[0] for column in arguments), fractional=fractional)
            ]
        elif route == "numpy" or (route == "auto" and size <= FEW):
            padded = [column[pad_to_16(np.arange(size))] for column in arguments]
            results = zip(
                *_map_in_batches(lambda batch: quick_kernel(*batch, fractional=fractional), padded), strict=True
            )
            results = [np.concatenate(leaves)[:size] for leaves in results]
        else:
            # Pad all batches to the size PIECE, because a program compiled for another size may round differently.
            results = map_blocks(compile_columns(quick_kernel, (fractional,)), arguments, PIECE, exact=True)
    return _certify_open_walls(columns, DominantPoles(*(np.array(leaf) for leaf in results)), accuracy, fractional)


def _certify_open_walls(
    columns: list[np.ndarray], poles: DominantPoles, accuracy: float, fractional: bool
) -> DominantPoles:
    """Certify open poles in place: from other starting points, then by bisection, then with larger error bounds."""
    open_walls = np.flatnonzero(~poles.certified)
    # Skip invalid walls, which cannot be certified.
    open_walls = open_walls[np.asarray(wall_status(*(column[open_walls] for column in columns))) == Status.OK]
    errors = accuracy * ERROR_FACTORS
    attempts = [(certify_starts, accuracy), (bisect_radius, accuracy)]
    attempts += [(bound_radius, error) for error in errors[errors <= MAX_ERROR].tolist()]
    for method, tolerance in attempts:
        if not open_walls.size:
            break

        def attempt(lists: list[np.ndarray], method: Any = method, tolerance: float = tolerance) -> np.ndarray:
            (batch,) = lists
            padded = pad_to_16(batch)
            loop = factor_loop(*(column[padded] for column in columns), fractional=fractional)
            attempted = method(DominantPoles(*(leaf[padded] for leaf in poles)), tolerance, loop, fractional)
            is_finite = np.isfinite(attempted.re[: batch.size])
            for column, leaf in zip(poles, attempted, strict=True):
                column[batch[is_finite]] = leaf[: batch.size][is_finite]
            return batch[~attempted.certified[: batch.size]]

        open_walls = np.concatenate(_map_in_batches(attempt, [open_walls], OPEN_BATCH_SIZE))
    return poles


def _map_in_batches(
    function: Callable[[list[np.ndarray]], Any], columns: list[np.ndarray], size: int = BATCH_SIZE
) -> list[Any]:
    """Apply a function to batches of walls in a single thread, because a second thread would not save time."""
    starts = range(0, max(columns[0].size, 1), size)
    with np.errstate(all="ignore"):
        return [function([column[start : start + size] for column in columns]) for start in starts]


def find_wall_axes(shapes: Sequence[tuple[int, ...]]) -> list[int] | None:
    """Return the axis of beta and the axis of alpha of a grid of walls; None if the shapes form no large grid.

    In a grid, alpha varies along one axis, beta along another, and no other argument varies along these two axes. For a
    constant alpha or beta, the first axis is returned; it must have length 1 for all arguments.

    Args:
        shapes: shapes of alpha, beta, delta and d, with the same number of axes.
    """
    wall_axes = []
    for k in (1, 0):
        varying = [axis for axis, length in enumerate(shapes[k]) if length > 1] or [0]
        if len(varying) > 1 or any(shape[varying[0]] > 1 for shape in (*shapes[:k], *shapes[k + 1 :])):
            return None
        wall_axes.append(varying[0])
    too_small = math.prod(np.broadcast_shapes(*shapes)) <= FEW_FOR_CELLS
    return None if too_small or math.prod(shapes[0] + shapes[1]) < SMALLEST_MAP else wall_axes


def arrange_as_area(points: Points) -> tuple[Area, tuple[int, ...], tuple[int, ...]] | None:
    """Return points arranged as a grid over alpha and beta for one or more devices; None if they form no large grid.

    Returns:
        The grid; the axes of ``points`` in the order of the grid (devices, beta, alpha); and the lengths of these axes.
    """
    shape, wall_axes = points.shape, find_wall_axes([array.shape for array in points])
    if wall_axes is None:
        return None
    others = tuple(axis for axis in range(len(shape)) if axis not in wall_axes)
    order = (*others, *wall_axes)
    delta, d = (
        np.broadcast_to(array, shape).transpose(order)[..., 0, 0].reshape(-1) for array in (points.delta, points.d)
    )
    area = Area.whole(points.alpha.reshape(1, -1), points.beta.reshape(1, -1), delta, d)
    return area, order, tuple(shape[axis] for axis in order)


class WallPoles(NamedTuple):
    """Spectral radii of walls, with the decay rate and the angle of the dominant pole if requested."""

    radius: np.ndarray  # NaN without a certified error bound
    certified: np.ndarray  # True if the requested accuracy of the radius is certified
    rate: np.ndarray  # NaN if fewer than three digits are certified
    angle: np.ndarray  # in [0, pi]; NaN if the radius is certified, but not the pole

    def map(self, function: Callable[[np.ndarray], np.ndarray]) -> WallPoles:
        """Return the results after applying a function to each array, e.g. a function that changes its shape."""
        return WallPoles(*(leaf if leaf is NOT_REQUESTED else function(leaf) for leaf in self))


def area_poles(area: Area, accuracy: float, with_rate: bool = False, with_angle: bool = False) -> WallPoles:
    """Compute the dominant poles of a grid by one Taylor series per cell; if the series of a wall fails, separately.

    Nothing is compiled. The result for a wall does not depend on the window, the part of the grid that is computed.
    """
    radius, re, *im = compute_grid_poles(area, accuracy, with_angle)
    rate, angle = -re if with_rate else NOT_REQUESTED, im[0] if with_angle else NOT_REQUESTED
    width = VERDICT_WIDTH + min(accuracy, MAX_UNCERTAIN_WIDTH)
    special = np.unravel_index(np.flatnonzero(~(np.abs(re) > width)), re.shape)
    is_open, columns = np.isnan(re[special]), area.walls(special)
    poles = WallPoles(radius, np.ones(re.shape, bool), rate, angle)
    near_one, open_walls = (tuple(index[mask] for index in special) for mask in (~is_open, is_open))
    poles.radius[near_one] = _correct_by_verdict(poles.radius[near_one], [column[~is_open] for column in columns])
    if open_walls[0].size:
        single_poles = list_poles([column[is_open] for column in columns], accuracy, with_rate, with_angle, "numpy")
        for array, leaf in zip(poles, single_poles, strict=True):
            if array.size:
                array[open_walls] = leaf
    return poles


def list_poles(
    columns: list[np.ndarray],
    accuracy: float,
    with_rate: bool = False,
    with_angle: bool = False,
    route: Route = "auto",
) -> WallPoles:
    """Compute the dominant poles of walls given by columns, each wall separately; walls may be invalid."""
    size = columns[0].size
    if route != "auto":
        columns = [column[pad_to_16(np.arange(size))] for column in columns]
    dominant = compute_dominant_poles(columns, accuracy, route)
    re, error = dominant.re, dominant.error
    rate = compute_rates(dominant, columns, accuracy) if with_rate else NOT_REQUESTED
    radius = np.exp(np.where(dominant.certified, re, np.nan))
    near_one = np.flatnonzero(np.abs(re) <= np.maximum(VERDICT_WIDTH, np.where(dominant.certified, error, 0.0)))
    radius[near_one] = _correct_by_verdict(radius[near_one], [column[near_one] for column in columns])
    angle = NOT_REQUESTED
    if with_angle:
        angle = np.where(dominant.certified & np.isfinite(dominant.pole_error), round_to_real(dominant), np.nan)
    return WallPoles(radius, error <= accuracy, rate, angle).map(lambda leaf: leaf[:size])


def find_poles(
    arrays: list[np.ndarray],
    accuracy: float,
    with_rate: bool = False,
    with_angle: bool = False,
    route: Route = "auto",
) -> WallPoles:
    """Compute the dominant poles of walls given by arrays of equal shape; by cells if the walls form a grid."""
    shape = arrays[0].shape
    # Add a first axis of length 1, because `arrange_as_area` needs two axes and a line of walls has only one.
    arranged = (
        arrange_as_area(Points(*(fold(array[None]) for array in arrays))) if arrays[0].size > FEW_FOR_CELLS else None
    )
    if arranged is None:
        columns = [array.reshape(-1) for array in arrays]
        return list_poles(columns, accuracy, with_rate, with_angle, route).map(lambda leaf: leaf.reshape(shape))
    area, order, area_shape = arranged

    def restore_layout(leaf: np.ndarray) -> np.ndarray:
        leaf = leaf.reshape(area_shape).transpose(np.argsort(order))[0]
        return leaf if leaf.shape == shape else np.broadcast_to(leaf, shape).copy()

    return area_poles(area, accuracy, with_rate, with_angle).map(restore_layout)


def compute_rates(poles: DominantPoles, columns: list[np.ndarray], accuracy: float) -> np.ndarray:
    """Return the decay rates of dominant poles; NaN if the certified relative error exceeds `MAX_RATE_ERROR`."""
    rate, allowed, width = 0.0 - poles.re, MAX_RATE_ERROR * np.abs(poles.re), certification_width(poles.re, accuracy)
    # Add ``width``, the distance in log |z| from the pole to the circle of the count, because other poles up to this
    # circle are not excluded.
    error = np.minimum(poles.error, poles.pole_error + width)
    # If alpha = 0 and beta + delta = 0, both poles near 1 are exactly 1, so that the decay rate 0 has no error.
    error[(poles.re == 0) & (columns[0] == 0) & (columns[1] == -columns[2])] = 0.0
    is_fractional = columns[3] != np.floor(columns[3])
    with np.errstate(all="ignore"):
        for fractional in (False, True):
            index = np.flatnonzero((error > allowed) & (poles.pole_error <= allowed) & (is_fractional == fractional))
            if not index.size:
                continue
            loop = factor_loop(*(column[index] for column in columns), fractional=fractional)
            is_only = is_only_pole_outside(poles.re[index], poles.im[index], width[index], loop, fractional)
            error[index] = np.where(is_only, poles.pole_error[index], error[index])
    return np.where(error <= allowed, rate, np.nan)


def is_only_pole_outside(re: Array, im: Array, width: Array, loop: LoopFactors, fractional: bool) -> Array:
    """Return whether a computed pole (or conjugate pair) is provably the only one outside |z| = e^(re - width).

    The computed pole is ``e^(re + j im)``. If the result is True, the other poles are smaller, so that the error of the
    decay rate is the error of the computed pole.
    """
    xp, poles_outside = namespace(re), count_poles(re - width, loop, fractional)
    return poles_outside.certain & (poles_outside.outside == xp.where(xp.sin(im) < REAL_AXIS_WIDTH, 1, 2))


def _correct_by_verdict(radius: np.ndarray, columns: list[np.ndarray]) -> np.ndarray:
    """Return spectral radii close to 1, corrected such that each is below 1 if and only if its wall is stable."""
    if not radius.size:
        return radius
    with np.errstate(all="ignore"):
        alpha, beta, delta, d = columns
        return place_by_verdict(radius, alpha, stable_kernel(alpha, beta, delta, d, classify_delays(d)))


def place_by_verdict(radius: Array, alpha: Array, stable: Array) -> Array:
    """Return spectral radii close to 1, limited to values below 1 for stable walls and to at least 1 otherwise."""
    xp = namespace(radius)
    # For alpha = 0, set the radius to 1 if it is 1 up to rounding errors, because one pole is exactly 1. Limit the
    # radius of a stable wall to the largest number below 1.
    outside = xp.where((alpha == 0) & (radius < 1.0 + RADIUS_ROUNDING), 1.0, xp.maximum(radius, 1.0))
    return xp.where(stable, xp.minimum(radius, 1.0 - 0.5 * epsilon(radius)), outside)
