"""Spectral radii of arrays, each proved by two counts: the quick search for all, more patience for what is left."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import BLOCK, FEW, broadcast, in_blocks, to_caller
from zwidth.domain import wall_status
from zwidth.grouping import NAMES
from zwidth.stability.circle import loop_of
from zwidth.stability.radius import proved, radius_kernel
from zwidth.status import Status

# Counts, whether some of them bisect, and Newton steps on the pole: nearly all points need the first.
_EFFORTS = ((5, False, 2), (10, False, 6), (25, False, 12), (90, True, 40))
# Multiples of the accuracy at which the two circles are tried where the rounding of a count is too large for it.
_LADDER = 10.0 ** np.arange(1, 12)
_LARGEST_ERROR = 0.1


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


@cache
def _compiled(fractional: bool, effort: int) -> Any:
    import jax

    return jax.jit(lambda *columns: radius_kernel(*columns, fractional, *_EFFORTS[effort]))


def _search(columns: list[np.ndarray], accuracy: float, fractional: bool, effort: int) -> tuple[np.ndarray, ...]:
    tolerance = np.full_like(columns[0], accuracy)
    if columns[0].size <= FEW:
        with np.errstate(all="ignore"):
            return radius_kernel(*columns, tolerance, fractional, *_EFFORTS[effort])
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
    re, im, ok = (np.array(leaf) for leaf in _search(columns, accuracy, kind, 0))
    for effort in range(1, len(_EFFORTS)):
        left = np.flatnonzero(~ok)
        if left.size:
            again = _search([column[left] for column in columns], accuracy, kind, effort)
            better = np.isfinite(again[0])
            re[left], im[left], ok[left] = (
                np.where(better, new, old[left]) for new, old in zip(again, (re, im, ok), strict=True)
            )
    error = np.where(ok, accuracy, np.inf)
    _ladder(columns, re, error, accuracy, kind)
    return Poles(re, im, error)


def _ladder(columns: list[np.ndarray], re: np.ndarray, error: np.ndarray, accuracy: float, kind: bool) -> None:
    """The least of larger errors that two counts prove, in place."""
    for factor in _LADDER:
        left = np.flatnonzero(np.isinf(error) & np.isfinite(re))
        tolerance = factor * accuracy
        if not left.size or tolerance > _LARGEST_ERROR:
            return
        with np.errstate(all="ignore"):
            loop = loop_of(*(column[left] for column in columns), kind)
            here = proved(re[left], [tolerance], loop, kind)[0]
        error[left[here]] = tolerance


def proved_radii(values: tuple[ArrayLike, ...], accuracy: float) -> Proved:
    """Spectral radii of concrete arguments."""
    arrays = broadcast(NAMES, values)
    shape = arrays[0].shape
    columns = [array.reshape(-1) for array in arrays]
    status = np.asarray(wall_status(*columns))
    ok = status == Status.OK
    found = outermost_poles(
        [np.where(ok, column, fill) for column, fill in zip(columns, (0.1, 0.1, 1.0, 0.0), strict=True)], accuracy
    )
    radius = np.where(ok, np.exp(found.re), np.nan)
    # Of the pole at 1 of a wall without stiffness, and of any other, the logarithm has all the digits.
    error = np.where(
        ok, np.where(np.isfinite(found.error), np.expm1(found.error) * radius + 2e-16 * radius, np.inf), np.nan
    )
    certified = ok & (found.error <= accuracy)
    status = np.where(ok & ~certified, np.int32(Status.NOT_CONVERGED), status).astype(np.int32)
    leaves = Proved(radius, error, certified, status)
    return to_caller(Proved(*(leaf.reshape(shape) for leaf in leaves)), values)


def certified_columns(
    alpha: np.ndarray, beta: np.ndarray, delta: np.ndarray, d: np.ndarray, accuracy: float
) -> tuple[np.ndarray, np.ndarray]:
    """Radii of equally many values of each, and whether each is proved to a relative accuracy."""
    found = proved_radii((alpha, beta, delta, d), accuracy)
    return found.radius, found.certified
