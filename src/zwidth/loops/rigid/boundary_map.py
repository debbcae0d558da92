"""Stable or not by the closed-form boundary: where each row ends, then one comparison a point.

The row work (`loops.rigid.row_limit`) and the comparison are compiled apart. In one function XLA would fuse the
row work into the comparison and repeat it at every point, a hundred times slower.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from zwidth.arrays.evaluate import compute_concretely, evaluate_columns
from zwidth.arrays.xp import within
from zwidth.loops.rigid.device import device
from zwidth.loops.rigid.folding import Points, group_by
from zwidth.loops.rigid.row_limit import long_lobe, long_row, short_row
from zwidth.words.quantities import WALL_RANGE
from zwidth.words.types import Array

# Smaller maps are compared by NumPy, with nothing to compile.
_WORTH_COMPILING = 1 << 16
# So few rows are solved by NumPy.
_FEW_ROWS = 1 << 12
# A place in the order that no count reaches: alpha <= 0 and NaN are never stable.
_NEVER = np.iinfo(np.int16).max
# A pattern is as long as two rows: with fewer rows it would be a cost of its own.
_ENOUGH_ROWS = 8


def boundary_map(points: Points) -> np.ndarray:
    """Label every point by the limit of its row: stable walls are those with ``0 < alpha < limit``.

    Args:
        points: folded arguments.

    Returns:
        Labels of the shape that the arguments broadcast to, False for a point out of range.

    Numerics:
        The limit is right to about 1e-15 relative, and to 1e-15 of the largest limit near the lobe's end.
    """
    alpha, beta = (np.where(within(part, WALL_RANGE), part, np.nan) for part in (points.alpha, points.beta))
    return _compare(alpha, row_limits(beta, points.delta, points.d, _FEW_ROWS))


@cache
def _compile_kernel(name: str) -> Any:
    import jax
    import jax.numpy as jnp

    return jax.jit({"less": jnp.less, "between": lambda alpha, limit: (alpha > 0) & (alpha < limit)}[name])


def row_limits(beta: np.ndarray, delta: np.ndarray, d: np.ndarray, few: int = 0) -> np.ndarray:
    """The stiffest stable wall of every (beta, delta, d), of their broadcast shape; NaN where out of range.

    Compiled, unless there are at most ``few``: the two routes may differ in the last place, and what is stored must not
    depend on how it was cut into pieces.
    """
    shape = np.broadcast_shapes(beta.shape, delta.shape, d.shape)
    out = np.empty(shape)
    for long, points, place in group_by((beta, delta, d), d >= 1):
        kernel = _long_limit if long else _short_limit
        if out.size <= few:
            # Each device is computed once.
            with np.errstate(all="ignore"):
                out[place] = kernel(points[0], *np.broadcast_arrays(*points[1:]))
        else:
            whole = np.broadcast_arrays(*points)
            limits = evaluate_columns(kernel, [array.reshape(-1) for array in whole], route="jax")
            out[place] = limits.reshape(whole[0].shape)
    return out


def _short_limit(beta: Array, delta: Array, d: Array) -> Array:
    return short_row(beta, device(delta, d))


def _long_limit(beta: Array, delta: Array, d: Array) -> Array:
    return long_row(beta, long_lobe(device(delta, d)))


def _compare(alpha: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """``0 < alpha < limit``, broadcast."""
    shape = np.broadcast_shapes(alpha.shape, limit.shape)
    if np.prod(shape) < _WORTH_COMPILING:
        return (alpha > 0) & (alpha < limit)
    varying = [axis for axis, length in enumerate(alpha.shape) if length > 1]
    if len(varying) == 1 and limit.shape[varying[0]] == 1:
        values = alpha.reshape(-1)
        if varying[0] == alpha.ndim - 1 and limit.size >= _ENOUGH_ROWS and np.all(values[1:] >= values[:-1]):
            stable = copy_rows(_below(values, limit), values.size)
            stable[:, : np.searchsorted(values, 0.0, side="right")] = False
            return stable.reshape(*limit.shape[:-1], values.size)
        if alpha.size < _NEVER:
            return _compare_places(alpha, limit)
    with compute_concretely():
        return np.asarray(_compile_kernel("between")(alpha, limit))


def copy_rows(count: np.ndarray, size: int) -> np.ndarray:
    """Rows of a length that are true in their first ``count`` places: pieces of one pattern, copied at memory speed.

    The pattern is true up to its middle; a row that ends after ``count`` places starts ``count`` before the middle.
    """
    pattern = np.zeros(2 * size, bool)
    pattern[:size] = True
    return np.lib.stride_tricks.sliding_window_view(pattern, size)[size - count]


def _below(ordered: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """How many alphas lie below each limit; none where the limit is NaN, which would sort last."""
    return np.searchsorted(ordered, np.where(np.isnan(limit), -np.inf, limit).reshape(-1))


def _compare_places(alpha: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """The same by places in the order of alpha: 16 bits a value, five times the speed of 64, and exact."""
    values = alpha.reshape(-1)
    order = np.argsort(values, kind="stable")
    place = np.empty(values.size, np.int16)
    place[order] = np.arange(values.size, dtype=np.int16)
    place = np.where(values > 0, place, np.int16(_NEVER))
    count = _below(values[order], limit).astype(np.int16)
    with compute_concretely():
        return np.asarray(_compile_kernel("less")(place.reshape(alpha.shape), count.reshape(limit.shape)))
