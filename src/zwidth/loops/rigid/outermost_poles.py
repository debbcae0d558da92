"""Outermost poles of arrays, each proved: most of them compiled, the rest by more patient means in NumPy.

On maps of alpha and beta they come from series (`loops.rigid.pole_map`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.evaluate import BLOCK, FEW, map_blocks
from zwidth.arrays.xp import WIDE
from zwidth.loops.rigid.circle import count, factor_loop
from zwidth.loops.rigid.crossover import stable_kernel
from zwidth.loops.rigid.device import classify_delays, wall_status
from zwidth.loops.rigid.folding import Points, fold
from zwidth.loops.rigid.pole_map import Area, follow_poles
from zwidth.loops.rigid.pole_search import (
    LONG,
    SHORT,
    Found,
    certification_width,
    certify_both,
    has_bound,
    quick_kernel,
    search,
)
from zwidth.words.status import Status

# Multiples of the accuracy at which the two circles are tried where the rounding of a count is too large for it.
_LADDER = 10.0 ** np.arange(12)
_LARGEST_ERROR = 0.1
# How far below a pole the search for a larger one begins.
_BELOW = 1e-6
# Closer to the circle (in the logarithm of the radius) the verdict in closed form says on which side a pole is: of the
# radii of walls with alpha from 1e-18 on one in ten rounds to 1, of those within 1e-10 of the boundary as many err.
_DOUBTFUL = 1e-8
_BELOW_ONE = 1.0 - 2.0**-53
# A rate of which no more is proved than this share of it is no answer; on maps a smaller one is looked at wall by wall.
_LARGEST_SHARE, _KNOWN = 1e-3, 1e-6
# Poles so near to the real axis are taken for single ones.
_REAL = 1e-6
# Smaller maps are not worth their cells.
SMALLEST_MAP = 1 << 11
# Points that are compiled together: one size for all batches that are worth it.
PIECE = BLOCK >> 3


_NONE = np.empty(0)


class OutermostPoles(NamedTuple):
    """Outermost poles ``e^(re + j im)`` of flat arrays, the relative error proved, infinite where none is."""

    re: np.ndarray
    im: np.ndarray
    error: np.ndarray
    doubt: np.ndarray  # how far re may be from the pole; infinite where the proof is of the radius alone


@cache
def _compile_quick(fractional: bool) -> Any:
    import jax

    return jax.jit(lambda a, b, c, d, accuracy: quick_kernel(a, b, c, d, accuracy, fractional), compiler_options=WIDE)


def outermost_poles(columns: list[np.ndarray], accuracy: float, few: int = FEW) -> OutermostPoles:
    """The outermost poles of equally long columns of alpha, beta, delta and d; up to ``few`` without a compiler."""
    fractional = columns[3] != np.floor(columns[3])
    if not fractional.any() or fractional.all():
        return _of_one_kind(columns, accuracy, bool(fractional.any()), few)
    # A mixed batch pays for the cubic only where it must.
    whole = OutermostPoles(*(np.empty(fractional.size) for _ in OutermostPoles._fields))
    for part in (np.flatnonzero(fractional), np.flatnonzero(~fractional)):
        for leaf, found in zip(whole, outermost_poles([c[part] for c in columns], accuracy, few), strict=True):
            leaf[part] = found
    return whole


def _of_one_kind(columns: list[np.ndarray], accuracy: float, kind: bool, few: int) -> OutermostPoles:
    size = columns[0].size
    with np.errstate(all="ignore"):
        if size == 1 <= few:
            # Plain numbers are several times faster than arrays of one.
            found = [np.reshape(leaf, 1) for leaf in _quick([column[0] for column in columns], accuracy, kind)]
        elif size <= few:
            pieces = [[column[start : start + FEW] for column in columns] for start in range(0, max(size, 1), FEW)]
            parts = [_quick(piece, accuracy, kind) for piece in pieces]
            found = list(map(np.concatenate, zip(*parts, strict=True)))
        else:
            # Always of one size: other batches may round differently.
            short = max(0, PIECE - size)
            padded = [np.pad(c, (0, short), mode="edge") for c in (*columns, np.full(size, accuracy))]
            found = [leaf[:size] for leaf in map_blocks(_compile_quick(kind), padded, PIECE)]
    return _finish_poles(columns, Found(*(np.array(leaf) for leaf in found)), accuracy, kind)


def _quick(columns: list[Any], accuracy: float, kind: bool) -> Found:
    alpha, beta, delta, d = columns
    return quick_kernel(alpha, beta, delta, d, accuracy + 0.0 * alpha, kind)


def _finish_poles(columns: list[np.ndarray], found: Found, accuracy: float, kind: bool) -> OutermostPoles:
    """What is not proved once more, in place: with all crossovers, by halvings, then with larger errors."""
    error = np.where(found.proved, accuracy, np.inf)
    left = np.flatnonzero(~found.proved)
    with np.errstate(all="ignore"):
        for start in range(0, left.size, FEW):
            _patiently(columns, found, error, left[start : start + FEW], accuracy, kind)
    return OutermostPoles(found.re, found.im, error, found.doubt)


def _patiently(
    columns: list[np.ndarray], found: Found, error: np.ndarray, left: np.ndarray, accuracy: float, kind: bool
) -> None:
    alpha, beta, delta, d = (column[left] for column in columns)
    loop = factor_loop(alpha, beta, delta, d, kind)
    one, other = certify_both(accuracy, loop, kind)
    new = Found(*(np.where(one.proved, *pair) for pair in zip(one, other, strict=True)))
    # Where neither start leads there, a third pole is next to the larger of what they lead to, more often than not.
    low = np.fmax(one.re, other.re)[~new.proved] - _BELOW
    left, loop = _store_poles(found, error, left, loop, new, new.proved, accuracy)
    for start, halvings in ((low, SHORT), (None, LONG)):
        if left.size:
            new = search(accuracy, loop, kind, start, halvings)
            good = new.proved | (halvings == LONG)
            left, loop = _store_poles(found, error, left, loop, new, good, accuracy)
    for factor in _LADDER[accuracy * _LADDER <= _LARGEST_ERROR]:
        if not left.size:
            return
        here = has_bound(found.re[left], factor * accuracy, loop, kind)
        error[left[here]], found.doubt[left[here]] = factor * accuracy, np.inf
        left, loop = left[~here], type(loop)(*(part[~here] for part in loop))


def _store_poles(
    found: Found, error: np.ndarray, left: np.ndarray, loop: Any, new: Found, good: Any, accuracy: float
) -> tuple[np.ndarray, Any]:
    """Keep new poles where they are good; what is not proved by them is left."""
    good = good & np.isfinite(new.re)
    for whole, leaf in zip(found, new, strict=True):
        whole[left[good]] = leaf[good]
    error[left[new.proved]] = accuracy
    return left[~new.proved], type(loop)(*(part[~new.proved] for part in loop))


def as_area(points: Points) -> tuple[Area, tuple[int, ...], tuple[int, ...]] | None:
    """The points as a map of one or several devices, where they are one that is large enough.

    With it the caller's axes in the map's order, those of the devices, then beta's, then alpha's; and its shape.
    """
    shape, alone = points.shape, []
    for name in ("beta", "alpha"):
        varying = [axis for axis, length in enumerate(getattr(points, name).shape) if length > 1]
        # By name: one and the same array may be given twice.
        others = [array for other, array in points._asdict().items() if other != name]
        if len(varying) != 1 or any(other.shape[varying[0]] > 1 for other in others):
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
    """Logarithms of the radii of walls, their errors, infinite where none is proved, and rates of decay if wanted."""

    re: np.ndarray
    error: np.ndarray
    rate: np.ndarray  # NaN where less than three digits are known

    def map(self, function: Callable[[np.ndarray], np.ndarray]) -> WallPoles:
        """The same in another layout."""
        return WallPoles(*(leaf if leaf is _NONE else function(leaf) for leaf in self))


def area_poles(area: Area, accuracy: float, with_rate: bool = False) -> WallPoles:
    """The outermost poles of a map (devices, betas, alphas): by series, and where these fail wall by wall.

    Nothing is compiled, and a wall's value does not depend on the others of its window.
    """
    (re, error), missing = follow_poles(area, accuracy)
    if with_rate:
        left = error > _KNOWN * np.abs(re)
        left[tuple(missing)] = True
        missing = np.stack(np.nonzero(left))
    found = WallPoles(re, error, -re if with_rate else _NONE)
    held = (area.d % 1.0 != 0.0)[missing[0]]
    kinds = [missing[:, held == kind] for kind in (False, True)]
    for places in kinds:
        if not places.size:
            continue
        # A multiple of 16: NumPy rounds odd ones at the end of a list otherwise.
        walls = area.walls(np.pad(places, ((0, 0), (0, -places.shape[1] % 16)), mode="edge"))
        for whole, leaf in zip(found, list_poles(walls, accuracy, with_rate, few=walls[0].size), strict=True):
            if leaf.size:
                whole[tuple(places)] = leaf[: places.shape[1]]
    return found


def list_poles(columns: list[np.ndarray], accuracy: float, with_rate: bool = False, few: int = FEW) -> WallPoles:
    """The outermost poles of equally long columns; as for `outermost_poles`, bad walls among them."""
    columns, status = usable(columns)
    found, bad = outermost_poles(columns, accuracy, few), status != Status.OK
    rate = rates(found, columns, accuracy) if with_rate else _NONE
    found.error[bad] = np.inf
    rate[bad[: rate.size]] = np.nan
    return WallPoles(found.re, found.error, rate)


def find_poles(arrays: list[np.ndarray], accuracy: float, with_rate: bool = False) -> WallPoles:
    """The outermost poles of arrays of one shape, as a map where they are one."""
    shape = arrays[0].shape
    laid = as_area(Points(*map(fold, arrays))) if arrays[0].size >= SMALLEST_MAP else None
    if laid is None:
        columns = [array.reshape(-1) for array in arrays]
        return list_poles(columns, accuracy, with_rate).map(lambda leaf: leaf.reshape(shape))
    area, order, sizes = laid
    back = np.argsort(order)
    return area_poles(area, accuracy, with_rate).map(
        lambda leaf: np.broadcast_to(leaf.reshape(sizes).transpose(back), shape)
    )


def prove_radii(arrays: list[np.ndarray], accuracy: float) -> tuple[np.ndarray, np.ndarray]:
    """Radii and relative errors (infinite where none is proved) of arrays of one shape."""
    shape, arrays = arrays[0].shape, [np.atleast_1d(array) for array in arrays]
    found = find_poles(arrays, accuracy)
    return radius_at(found.re, found.error, arrays).reshape(shape), found.error.reshape(shape)


def rates(found: OutermostPoles, columns: list[np.ndarray], accuracy: float) -> np.ndarray:
    """The rates of decay of outermost poles; NaN where their relative errors are not proved to be small."""
    rate, allowed, beyond = 0.0 - found.re, _LARGEST_SHARE * np.abs(found.re), certification_width(found.re, accuracy)
    # Other poles may be larger by what the count allows.
    error = np.minimum(found.error, found.doubt + beyond)
    # Without stiffness and damping both poles next to 1 are at 1.
    error[(found.re == 0) & (columns[0] == 0) & (columns[1] == -columns[2])] = 0.0
    held = columns[3] % 1.0 != 0.0
    with np.errstate(all="ignore"):
        for kind in (False, True):
            part = np.flatnonzero((error > allowed) & (found.doubt <= allowed) & (held == kind))
            loop = factor_loop(*(column[part] for column in columns), fractional=kind)
            # Whether a count proves that no other pole is nearly as large.
            seen = count(found.re[part] - beyond[part], loop, kind)
            alone = seen.sure & (seen.missing == np.where(np.sin(found.im[part]) < _REAL, 1, 2))
            error[part] = np.where(alone, found.doubt[part], error[part])
    return np.where(error <= allowed, rate, np.nan)


def usable(columns: list[np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
    """The columns with some good wall in place of every bad one, and the status of the walls."""
    status = np.asarray(wall_status(*columns))
    ok = status == Status.OK
    if not ok.all():
        columns = [np.where(ok, column, fill) for column, fill in zip(columns, (0.1, 0.1, 1.0, 0.0), strict=True)]
    return columns, status


def radius_at(re: np.ndarray, error: np.ndarray, arrays: list[np.ndarray]) -> np.ndarray:
    """Radii on the verdict's side of the circle, which the proved error alone may not tell."""
    radius = np.exp(re)
    radius[np.isinf(error)] = np.nan
    near = np.nonzero(np.abs(re) <= _DOUBTFUL)
    if near[0].size:
        alpha, beta, delta, d = (array[near] for array in arrays)
        with np.errstate(all="ignore"):
            stable = np.asarray(stable_kernel(alpha, beta, delta, d, classify_delays(d)))
        # The largest number below 1 is as near to the truth as 1 itself. A wall without stiffness has a pole at 1.
        known = np.where((alpha == 0) & (radius[near] <= 1.0 + error[near]), 1.0, np.maximum(radius[near], 1.0))
        radius[near] = np.where(stable, np.minimum(radius[near], _BELOW_ONE), known)
    return radius
