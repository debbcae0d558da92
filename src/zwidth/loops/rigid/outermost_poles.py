"""Outermost poles of arrays, each proved: most of them compiled, the rest by more patient means in NumPy.

On maps of alpha and beta they come from series (`loops.rigid.pole_map`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.blocks import map_blocks
from zwidth.arrays.evaluate import BLOCK, FEW, Route, compile_columns
from zwidth.arrays.held_mass import classify_delays
from zwidth.loops.rigid.circle import count, factor_loop
from zwidth.loops.rigid.crossover import stable_kernel
from zwidth.loops.rigid.folding import Points, fold
from zwidth.loops.rigid.normalization import wall_status
from zwidth.loops.rigid.pole_groups import DOUBTFUL
from zwidth.loops.rigid.pole_map import Area, fill_up, follow_poles
from zwidth.loops.rigid.pole_search import (
    OutermostPoles,
    bound_radius,
    certification_width,
    certify_again,
    certify_starts,
    quick_kernel,
    search,
)
from zwidth.words.status import Status

# Multiples of the accuracy at which the two circles are tried where the rounding of a count is too large for it.
_LADDER = 10.0 ** np.arange(12)
_LARGEST_ERROR = 0.1
_BELOW_ONE, _ROUNDED = 1.0 - 2.0**-53, 1e-13
# A rate of which no more is proved than this share of it is no answer.
_LARGEST_SHARE = 1e-3
# Poles so near to the real axis are taken for single ones.
_REAL = 1e-6
# Maps of fewer walls a device are not worth their cells.
SMALLEST_MAP = 1 << 11
# Listed walls whose poles are found at one time without a compiler: in smaller lists they take longer.
_AT_ONCE = 1 << 13
# So few walls take less one by one than in cells.
FEW_FOR_CELLS = 1 << 13
# Points that are compiled together: one size for all batches that are worth it.
PIECE = BLOCK >> 3

# The relative error of radii and rates where nobody asks for another.
ACCURACY = 1e-9
_NONE = np.empty(0)


def outermost_poles(columns: list[np.ndarray], accuracy: float, route: Route = "auto") -> OutermostPoles:
    """The outermost poles of equally long columns of alpha, beta, delta and d."""
    # By the routes "numpy" and "jax" a wall's pole does not depend on the others.
    fractional = columns[3] != np.floor(columns[3])
    if not fractional.any() or fractional.all():
        return _of_one_kind(columns, accuracy, bool(fractional.any()), route)
    # A mixed batch pays for the cubic only where it must.
    whole = OutermostPoles(*(np.empty(fractional.size) for _ in OutermostPoles._fields))
    for part in (np.flatnonzero(fractional), np.flatnonzero(~fractional)):
        for leaf, found in zip(whole, outermost_poles([c[part] for c in columns], accuracy, route), strict=True):
            leaf[part] = found
    return whole


def _of_one_kind(columns: list[np.ndarray], accuracy: float, kind: bool, route: Route) -> OutermostPoles:
    size = columns[0].size
    asked = [*columns, np.full(size, accuracy)]
    with np.errstate(all="ignore"):
        if size == 1 and route == "auto":
            # Plain numbers are several times faster than arrays of one.
            found = [np.reshape(leaf, 1) for leaf in quick_kernel(*(column[0] for column in asked), fractional=kind)]
        elif route == "numpy" or (route == "auto" and size <= FEW):
            full = [column[fill_up(np.arange(size))] for column in asked]
            found = zip(*_in_lists(lambda some: quick_kernel(*some, fractional=kind), full), strict=True)
            found = [np.concatenate(leaves)[:size] for leaves in found]
        else:
            # Always of one size: other batches may round differently.
            found = map_blocks(compile_columns(quick_kernel, (kind,)), asked, PIECE, exact=True)
    return _finish_poles(columns, OutermostPoles(*(np.array(leaf) for leaf in found)), accuracy, kind)


def _finish_poles(columns: list[np.ndarray], poles: OutermostPoles, accuracy: float, kind: bool) -> OutermostPoles:
    """What is not proved once more, in place: with all crossovers, by halvings, then with larger errors."""
    left = np.flatnonzero(~poles.proved)
    # Nothing is proved of bad walls.
    left = left[np.asarray(wall_status(*(column[left] for column in columns))) == Status.OK]
    looser = accuracy * _LADDER
    attempts = [(method, accuracy) for method in (certify_again, certify_starts, bound_radius, search)]
    attempts += [(bound_radius, error) for error in looser[looser <= _LARGEST_ERROR].tolist()]
    for method, tolerance in attempts:
        if not left.size:
            break

        def attempt(lists: list[np.ndarray], method: Any = method, tolerance: float = tolerance) -> np.ndarray:
            (some,) = lists
            full = fill_up(some)
            loop = factor_loop(*(column[full] for column in columns), fractional=kind)
            new = method(OutermostPoles(*(leaf[full] for leaf in poles)), tolerance, loop, kind)
            good = np.isfinite(new.re[: some.size])
            for whole, leaf in zip(poles, new, strict=True):
                whole[some[good]] = leaf[: some.size][good]
            return some[~new.proved[: some.size]]

        left = np.concatenate(_in_lists(attempt, [left]))
    return poles


def _in_lists(function: Callable[[list[np.ndarray]], Any], columns: list[np.ndarray]) -> list[Any]:
    """The function's results for lists of walls, one after another: two threads take as long, or longer."""
    starts = range(0, max(columns[0].size, 1), _AT_ONCE)
    with np.errstate(all="ignore"):
        return [function([column[start : start + _AT_ONCE] for column in columns]) for start in starts]


def as_area(points: Points) -> tuple[Area, tuple[int, ...], tuple[int, ...]] | None:
    """The points as a map of one or several devices, where they are one that is large enough; a line is a map, too."""
    # With it the caller's axes in the map's order, those of the devices, then beta's, then alpha's, of which a line
    # lacks one: it gets the first axis, which has to be of length 1; and its shape.
    shape, alone = points.shape, []
    for name in ("beta", "alpha"):
        varying = [axis for axis, length in enumerate(getattr(points, name).shape) if length > 1] or [0]
        # By name: one and the same array may be given twice.
        others = [array for other, array in points._asdict().items() if other != name]
        if len(varying) > 1 or any(other.shape[varying[0]] > 1 for other in others):
            return None
        alone.append(varying[0])
    if points.alpha.size * points.beta.size < SMALLEST_MAP:
        return None
    others = tuple(axis for axis in range(len(shape)) if axis not in alone)
    order = (*others, *alone)
    delta, d = (
        np.broadcast_to(array, shape).transpose(order)[..., 0, 0].reshape(-1) for array in (points.delta, points.d)
    )
    area = Area.whole(points.alpha.reshape(1, -1), points.beta.reshape(1, -1), delta, d)
    return area, order, tuple(shape[axis] for axis in order)


class WallPoles(NamedTuple):
    """Spectral radii, NaN where no error is proved; whether the accuracy is; and rates of decay if wanted."""

    radius: np.ndarray
    proved: np.ndarray
    rate: np.ndarray  # NaN where less than three digits are known

    def map(self, function: Callable[[np.ndarray], np.ndarray]) -> WallPoles:
        """The same in another layout."""
        return WallPoles(*(leaf if leaf is _NONE else function(leaf) for leaf in self))


def area_poles(area: Area, accuracy: float, with_rate: bool = False) -> WallPoles:
    """The outermost poles of a map: by series, and where these fail wall by wall."""
    # Nothing is compiled, and a wall's value does not depend on the others of its window.
    found = follow_poles(area, accuracy, with_rate)
    (radius, rate, places), proved = found, np.ones(found.radius.shape, bool)
    columns, missing = area.walls(np.stack(places)), np.isnan(radius[places])
    near, left = (tuple(place[part] for place in places) for part in (~missing, missing))
    radius[near] = _on_its_side(radius[near], [column[~missing] for column in columns])
    if left[0].size:
        alone = list_poles([column[missing] for column in columns], accuracy, with_rate, "numpy")
        for whole, leaf in zip((radius, proved, rate), alone, strict=True):
            if whole.size:
                whole[left] = leaf
    return WallPoles(radius, proved, rate if with_rate else _NONE)


def list_poles(columns: list[np.ndarray], accuracy: float, with_rate: bool = False, route: Route = "auto") -> WallPoles:
    """The outermost poles of equally long columns; as for `outermost_poles`, bad walls among them."""
    size = columns[0].size
    if route != "auto":
        columns = [column[fill_up(np.arange(size))] for column in columns]
    return _find_listed(columns, accuracy, with_rate, route)[0].map(lambda leaf: leaf[:size])


def slowest_pole(wall: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """The spectral radius of one wall, its rate of decay and the angle of that pole."""
    poles, found = _find_listed([np.array([value]) for value in wall], ACCURACY, True, "auto")
    return float(poles.radius[0]), float(poles.rate[0]), abs(float(found.im[0]))


def _find_listed(
    columns: list[np.ndarray], accuracy: float, with_rate: bool, route: Route
) -> tuple[WallPoles, OutermostPoles]:
    found = outermost_poles(columns, accuracy, route)
    rate = rates(found, columns, accuracy) if with_rate else _NONE
    radius = np.exp(np.where(np.isinf(found.error), np.nan, found.re))
    near = np.flatnonzero(np.abs(found.re) <= np.maximum(DOUBTFUL, np.where(np.isinf(found.error), 0.0, found.error)))
    radius[near] = _on_its_side(radius[near], [column[near] for column in columns])
    return WallPoles(radius, found.error <= accuracy, rate), found


def find_poles(arrays: list[np.ndarray], accuracy: float, with_rate: bool = False) -> WallPoles:
    """The outermost poles of arrays of one shape, as a map where they are one."""
    shape = arrays[0].shape
    # A line lacks an axis.
    laid = as_area(Points(*(fold(array[None]) for array in arrays))) if arrays[0].size > FEW_FOR_CELLS else None
    if laid is None:
        columns = [array.reshape(-1) for array in arrays]
        return list_poles(columns, accuracy, with_rate).map(lambda leaf: leaf.reshape(shape))
    area, order, sizes = laid

    def lay(leaf: np.ndarray) -> np.ndarray:
        leaf = leaf.reshape(sizes).transpose(np.argsort(order))[0]
        return leaf if leaf.shape == shape else np.broadcast_to(leaf, shape).copy()

    return area_poles(area, accuracy, with_rate).map(lay)


def rates(found: OutermostPoles, columns: list[np.ndarray], accuracy: float) -> np.ndarray:
    """The rates of decay of outermost poles; NaN where their relative errors are not proved to be small."""
    rate, allowed, beyond = 0.0 - found.re, _LARGEST_SHARE * np.abs(found.re), certification_width(found.re, accuracy)
    # Other poles may be larger by what the count allows.
    error = np.minimum(found.error, found.doubt + beyond)
    # Without stiffness and damping both poles next to 1 are at 1.
    error[(found.re == 0) & (columns[0] == 0) & (columns[1] == -columns[2])] = 0.0
    held = columns[3] != np.floor(columns[3])
    with np.errstate(all="ignore"):
        for kind in (False, True):
            part = np.flatnonzero((error > allowed) & (found.doubt <= allowed) & (held == kind))
            if not part.size:
                continue
            loop = factor_loop(*(column[part] for column in columns), fractional=kind)
            # Whether a count proves that no other pole is nearly as large.
            seen = count(found.re[part] - beyond[part], loop, kind)
            alone = seen.sure & (seen.missing == np.where(np.sin(found.im[part]) < _REAL, 1, 2))
            error[part] = np.where(alone, found.doubt[part], error[part])
    return np.where(error <= allowed, rate, np.nan)


def _on_its_side(radius: np.ndarray, columns: list[np.ndarray]) -> np.ndarray:
    """Radii next to 1 on the verdict's side of it, which errors alone may not tell."""
    if not radius.size:
        return radius
    alpha, beta, delta, d = columns
    with np.errstate(all="ignore"):
        stable = np.asarray(stable_kernel(alpha, beta, delta, d, classify_delays(d)))
    # A wall without stiffness has a pole at 1. The largest number below 1 is as near to the truth as 1 itself.
    outside = np.where((alpha == 0) & (radius < 1.0 + _ROUNDED), 1.0, np.maximum(radius, 1.0))
    return np.where(stable, np.minimum(radius, _BELOW_ONE), outside)
