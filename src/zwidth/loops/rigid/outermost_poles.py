"""Outermost poles of arrays, each proved: most of them compiled, the rest by more patient means in NumPy.

On maps of alpha and beta the poles of neighboring points are followed (`loops.rigid.radius_map`).
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.evaluate import BLOCK, FEW, map_blocks
from zwidth.arrays.xla import WIDE
from zwidth.loops.domain import wall_status
from zwidth.loops.rigid.circle import factor_loop
from zwidth.loops.rigid.crossover import stable_kernel
from zwidth.loops.rigid.delay_classes import classify_delays
from zwidth.loops.rigid.folding import Points, fold
from zwidth.loops.rigid.pole_search import Found, certify_pole, has_bound, quick_kernel, search
from zwidth.loops.rigid.radius_map import SMALLEST_MAP, Map, as_map, followed_poles, lay_nodes
from zwidth.words.status import Status

# Multiples of the accuracy at which the two circles are tried where the rounding of a count is too large for it.
_LADDER = 10.0 ** np.arange(12)
_LARGEST_ERROR = 0.1
# Closer to the circle (in the logarithm of the radius) the verdict in closed form says on which side a pole is: of the
# radii of walls with alpha from 1e-18 on one in ten rounds to 1, of those within 1e-10 of the boundary as many err.
_DOUBTFUL = 1e-8
_BELOW_ONE = 1.0 - 2.0**-53
# Points that are compiled together: one size for all batches that are worth it.
PIECE = BLOCK >> 3


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


def outermost_poles(columns: list[np.ndarray], accuracy: float, few: int = FEW, patient: bool = True) -> OutermostPoles:
    """The outermost poles of equally long columns of alpha, beta, delta and d; up to ``few`` without a compiler.

    Without patience some are not proved that could be.
    """
    fractional = columns[3] != np.floor(columns[3])
    if not fractional.any() or fractional.all():
        return _of_one_kind(columns, accuracy, bool(fractional.any()), few, patient)
    # A mixed batch pays for the cubic only where it must.
    whole = OutermostPoles(*(np.empty(fractional.size) for _ in OutermostPoles._fields))
    for part in (np.flatnonzero(fractional), np.flatnonzero(~fractional)):
        for leaf, found in zip(whole, outermost_poles([c[part] for c in columns], accuracy, few, patient), strict=True):
            leaf[part] = found
    return whole


def _of_one_kind(columns: list[np.ndarray], accuracy: float, kind: bool, few: int, patient: bool) -> OutermostPoles:
    size = columns[0].size
    with np.errstate(all="ignore"):
        if size == 1 <= few:
            # Plain numbers are several times faster than arrays of one.
            alpha, beta, delta, d = (column[0] for column in columns)
            found = [np.reshape(leaf, 1) for leaf in quick_kernel(alpha, beta, delta, d, accuracy, kind)]
        elif size <= few:
            alpha, beta, delta, d = columns
            found = quick_kernel(alpha, beta, delta, d, np.full(size, accuracy), kind)
        else:
            # Always of one size: other batches may round differently.
            short = max(0, PIECE - size)
            padded = [np.pad(c, (0, short), mode="edge") for c in (*columns, np.full(size, accuracy))]
            found = [leaf[:size] for leaf in map_blocks(_compile_quick(kind), padded, PIECE)]
    return _finish_poles(columns, Found(*(np.array(leaf) for leaf in found)), accuracy, kind, patient)


def _finish_poles(
    columns: list[np.ndarray], found: Found, accuracy: float, kind: bool, patient: bool
) -> OutermostPoles:
    """What is not proved once more, in place: with all crossovers, by halvings, then with larger errors."""
    error = np.where(found.proved, accuracy, np.inf)
    left = np.flatnonzero(~found.proved & patient)
    for first in range(0, left.size, FEW):
        _patiently(columns, found, error, left[first : first + FEW], accuracy, kind)
    return OutermostPoles(found.re, found.im, error, found.doubt)


def _patiently(
    columns: list[np.ndarray], found: Found, error: np.ndarray, left: np.ndarray, accuracy: float, kind: bool
) -> None:
    with np.errstate(all="ignore"):
        alpha, beta, delta, d = (column[left] for column in columns)
        loop = factor_loop(alpha, beta, delta, d, kind)
        again = certify_pole(found.re[left], found.im[left], accuracy, loop, kind, False)
        left, loop = _store_poles(found, error, left, loop, again, again.proved, accuracy)
        if left.size:
            left, loop = _store_poles(found, error, left, loop, search(accuracy, loop, kind), True, accuracy)
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


def _by_map(area: Map, accuracy: float) -> tuple[np.ndarray, np.ndarray]:
    """The logarithms of radii and their errors in the order of the axes that the caller gave."""
    fractional = area.d != np.floor(area.d)
    if fractional.all() or not fractional.any():
        found = _map_poles(area, accuracy, bool(fractional.any()))
    else:
        found = tuple(np.empty((area.d.size, area.beta.size, area.alpha.size)) for _ in range(2))
        for kind in (False, True):
            part = np.flatnonzero(fractional == kind)
            found[0][part], found[1][part] = _map_poles(area.of(part), accuracy, kind)
    back = np.argsort(area.order)
    re, error = (leaf.reshape(area.shape).transpose(back).reshape(-1) for leaf in found)
    return re, error


def _map_poles(area: Map, accuracy: float, kind: bool) -> tuple[np.ndarray, np.ndarray]:
    """The same of devices whose delays are all whole, or none; axes as in the map."""
    nodes = lay_nodes(area)
    start = outermost_poles(nodes, accuracy, patient=False)
    re, proved = followed_poles(area, nodes, start.re, start.im, accuracy, kind)
    error = np.where(proved, accuracy, np.inf)
    left = np.nonzero(~proved)
    late = outermost_poles([area.alpha[left[2]], area.beta[left[1]], area.delta[left[0]], area.d[left[0]]], accuracy)
    re[left], error[left] = late.re, late.error
    return re, error


def prove_radii(arrays: list[np.ndarray], accuracy: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radii, relative errors (infinite where none is proved) and status of arrays of one shape, flat."""
    area = as_map(Points(*map(fold, arrays))) if arrays[0].size >= SMALLEST_MAP else None
    if area is not None and area.good():
        (re, error), status = _by_map(area, accuracy), np.zeros(arrays[0].size, np.int32)
    else:
        columns, status = usable([array.reshape(-1) for array in arrays])
        found = outermost_poles(columns, accuracy)
        re, error = found.re, np.where(status == Status.OK, found.error, np.inf)
    return radius_at(re, error, arrays), error, status


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
    near = np.flatnonzero(np.abs(re) <= _DOUBTFUL)
    if near.size:
        alpha, beta, delta, d = (array.reshape(-1)[near] for array in arrays)
        with np.errstate(all="ignore"):
            stable = np.asarray(stable_kernel(alpha, beta, delta, d, classify_delays(d)))
        # The largest number below 1 is as near to the truth as 1 itself.
        radius[near] = np.where(stable, np.minimum(radius[near], _BELOW_ONE), np.maximum(radius[near], 1.0))
    return radius
