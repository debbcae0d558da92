"""Spectral radii of arrays, each proved: the quick way for all, a search for what that leaves.

On maps of alpha and beta the poles of neighboring points are followed (`zwidth.stability.radius_map`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import BLOCK, FEW, broadcast, in_blocks, to_caller
from zwidth.domain import wall_status
from zwidth.grouping import NAMES
from zwidth.stability.circle import loop_of
from zwidth.stability.crossover import stable_kernel
from zwidth.stability.devices import kind_of
from zwidth.stability.layout import Points, fold
from zwidth.stability.quick import quick_kernel
from zwidth.stability.radius import proved, radius_kernel
from zwidth.stability.radius_map import SMALLEST_MAP, Map, as_map, followed_poles, nodes_of
from zwidth.status import Status

# Counts, whether some of them bisect, and Newton steps on the pole, for what the quick way has not proved.
_EFFORTS = ((10, False, 6), (25, False, 12), (90, True, 40))
# Multiples of the accuracy at which the two circles are tried where the rounding of a count is too large for it.
_LADDER = 10.0 ** np.arange(1, 12)
_LARGEST_ERROR = 0.1
# Closer to the circle (in the logarithm of the radius) the verdict in closed form says on which side a pole is.
_DOUBTFUL = 1e-8
_BELOW_ONE = 1.0 - 2.0**-53
# From so many points on a map's nodes are worth a compilation, too.
_WORTH_COMPILING = 1 << 18


class Proved(NamedTuple):
    """Radii with absolute errors, certificates and status."""

    radius: Array
    error: Array
    certified: Array
    status: Array


class Poles(NamedTuple):
    """Outermost poles ``e^(re + j im)`` of flat arrays, the relative error proved, infinite where none is."""

    re: np.ndarray
    im: np.ndarray
    error: np.ndarray


def _kernel(effort: int) -> Callable[..., Any]:
    """The quick way for all, then a search."""
    if effort == 0:
        return quick_kernel
    steps: tuple[Any, ...] = _EFFORTS[effort - 1]
    return lambda *arguments: radius_kernel(*arguments, *steps)


@cache
def _compiled(fractional: bool, effort: int) -> Any:
    import jax

    return jax.jit(lambda *columns: _kernel(effort)(*columns, fractional))


def _search(
    columns: list[np.ndarray], accuracy: float, fractional: bool, effort: int, few: int = FEW
) -> tuple[np.ndarray, ...]:
    if columns[0].size == 1:
        # Plain numbers are several times faster than arrays of one.
        with np.errstate(all="ignore"):
            found = _kernel(effort)(*(column[0] for column in columns), accuracy, fractional)
        return tuple(np.reshape(leaf, 1) for leaf in found)
    tolerance = np.full_like(columns[0], accuracy)
    if columns[0].size <= few:
        with np.errstate(all="ignore"):
            return _kernel(effort)(*columns, tolerance, fractional)
    return in_blocks(_compiled(fractional, effort), [*columns, tolerance], BLOCK >> 3)


def outermost_poles(columns: list[np.ndarray], accuracy: float) -> Poles:
    """The outermost poles of equally long columns of alpha, beta, delta and d."""
    d = columns[3]
    fractional = d != np.floor(d)
    if fractional.any() and not fractional.all():
        # A mixed batch pays for the cubic only where it must.
        parts = [np.flatnonzero(fractional), np.flatnonzero(~fractional)]
        found = [outermost_poles([column[part] for column in columns], accuracy) for part in parts]
        order = np.argsort(np.concatenate(parts), kind="stable")
        return Poles(*(np.concatenate(leaves)[order] for leaves in zip(*found, strict=True)))
    kind = bool(fractional.any())
    re, im, ok = _searched(columns, accuracy, kind, len(_EFFORTS))
    error = np.where(ok, accuracy, np.inf)
    _ladder(columns, re, error, accuracy, kind)
    return Poles(re, im, error)


def _searched(
    columns: list[np.ndarray], accuracy: float, kind: bool, efforts: int, few: int = FEW
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poles and whether they are proved, the quick way and by so many efforts for what that leaves."""
    re, im, ok = (np.array(leaf) for leaf in _search(columns, accuracy, kind, 0, few))
    for effort in range(1, efforts + 1):
        left = np.flatnonzero(~ok)
        if left.size:
            again = _search([column[left] for column in columns], accuracy, kind, effort)
            better = np.isfinite(again[0])
            re[left], im[left], ok[left] = (
                np.where(better, new, old[left]) for new, old in zip(again, (re, im, ok), strict=True)
            )
    return re, im, ok


def _map_poles(area: Map, accuracy: float) -> Poles:
    """The outermost poles of a map of devices whose delays are all whole, or none; axes as in the map."""
    kind = bool((area.d != np.floor(area.d)).any())
    nodes = nodes_of(area)
    few = FEW if area.size < _WORTH_COMPILING else 0
    re, im, ok = followed_poles(area, nodes, *_searched(nodes, accuracy, kind, 1, few)[:2], accuracy, kind)
    error = np.where(ok, accuracy, np.inf)
    left = np.nonzero(~ok)
    if left[0].size:
        columns = [area.alpha[left[2]], area.beta[left[1]], area.delta[left[0]], area.d[left[0]]]
        re[left], im[left], error[left] = outermost_poles(columns, accuracy)
    return Poles(re, im, error)


def _by_map(area: Map, accuracy: float) -> Poles:
    """The outermost poles in the order of the axes that the caller gave."""
    fractional = area.d != np.floor(area.d)
    parts = [part for part in (np.flatnonzero(fractional), np.flatnonzero(~fractional)) if part.size]
    if len(parts) == 1:
        found = _map_poles(area, accuracy)
    else:
        shape = (area.d.size, area.beta.size, area.alpha.size)
        found = Poles(*(np.empty(shape) for _ in Poles._fields))
        for part in parts:
            for whole, leaf in zip(found, _map_poles(area.of(part), accuracy), strict=True):
                whole[part] = leaf
    back = np.argsort(area.order)
    return Poles(*(leaf.reshape(area.shape).transpose(back).reshape(-1) for leaf in found))


def _ladder(columns: list[np.ndarray], re: np.ndarray, error: np.ndarray, accuracy: float, kind: bool) -> None:
    """The least of larger errors that two counts prove, in place."""
    for factor in _LADDER:
        left = np.flatnonzero(np.isinf(error) & np.isfinite(re))
        tolerance = factor * accuracy
        if not left.size or tolerance > _LARGEST_ERROR:
            return
        with np.errstate(all="ignore"):
            loop = loop_of(columns[0][left], columns[1][left], columns[2][left], columns[3][left], kind)
            here = proved(re[left], [tolerance], loop, kind)[0]
        error[left[here]] = tolerance


def poles_of(arrays: list[np.ndarray], accuracy: float) -> tuple[Poles, np.ndarray]:
    """The outermost poles of arrays of one shape, flat, and the status of the walls."""
    area = as_map(Points(*map(fold, arrays))) if arrays[0].size >= SMALLEST_MAP else None
    if area is not None and area.good():
        return _by_map(area, accuracy), np.zeros(arrays[0].size, np.int32)
    columns = [array.reshape(-1) for array in arrays]
    status = np.asarray(wall_status(*columns))
    ok = status == Status.OK
    if not ok.all():
        columns = [np.where(ok, column, fill) for column, fill in zip(columns, (0.1, 0.1, 1.0, 0.0), strict=True)]
    return outermost_poles(columns, accuracy), status


def radii(values: tuple[ArrayLike, ...], accuracy: float) -> Array:
    """Spectral radii of concrete arguments; NaN where no error bound is proved."""
    arrays = broadcast(NAMES, values)
    found, status = poles_of(arrays, accuracy)
    return to_caller(_radius(found, status, arrays).reshape(arrays[0].shape), values)


def _radius(found: Poles, status: np.ndarray, arrays: list[np.ndarray]) -> np.ndarray:
    """Radii on the verdict's side of the circle, which the proved error alone may not tell."""
    radius = np.exp(found.re)
    radius[np.flatnonzero((status != Status.OK) | np.isinf(found.error))] = np.nan
    near = np.flatnonzero(np.abs(found.re) <= _DOUBTFUL)
    if near.size:
        alpha, beta, delta, d = (array.reshape(-1)[near] for array in arrays)
        with np.errstate(all="ignore"):
            stable = np.asarray(stable_kernel(alpha, beta, delta, d, kind_of(d)))
        # The largest number below 1 is as near to the truth as 1 itself.
        radius[near] = np.where(stable, np.minimum(radius[near], _BELOW_ONE), np.maximum(radius[near], 1.0))
    return radius


def proved_radii(values: tuple[ArrayLike, ...], accuracy: float) -> Proved:
    """Spectral radii of concrete arguments, with errors and certificates."""
    arrays = broadcast(NAMES, values)
    shape = arrays[0].shape
    found, status = poles_of(arrays, accuracy)
    radius = _radius(found, status, arrays)
    ok = status == Status.OK
    certified = ok & (found.error <= accuracy)
    error = np.where(certified, np.expm1(accuracy), np.inf)
    rest = np.flatnonzero(~certified & np.isfinite(found.error))
    error[rest] = np.expm1(found.error[rest])
    # Of the pole at 1 of a wall without stiffness, and of any other, the logarithm has all the digits.
    error = np.where(np.isinf(error), error, (error + 2e-16) * radius)
    error[~ok] = np.nan
    status = np.where(ok & ~certified, np.int32(Status.NOT_CONVERGED), status).astype(np.int32)
    leaves = Proved(radius, error, certified, status)
    return to_caller(Proved(*(leaf.reshape(shape) for leaf in leaves)), values)
