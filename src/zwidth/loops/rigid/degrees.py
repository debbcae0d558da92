"""Grouping of points by the degree of their polynomial, so that none is padded before its computation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.arguments import as_float64, broadcast, broadcast_traced, check_scalars, to_caller
from zwidth.arrays.evaluate import FEW, Route, evaluate_columns
from zwidth.arrays.xp import is_traced, tree_map
from zwidth.loops.domain import LONGEST_DELAY
from zwidth.words.errors import TracedDelayError
from zwidth.words.types import ArrayLike

NAMES: tuple[str, ...] = ("alpha", "beta", "delta", "d")


class Degree(NamedTuple):
    """What decides the shape of the polynomial: whole periods of delay, and whether a fraction remains."""

    whole: int
    fractional: bool

    @property
    def poles(self) -> int:
        """The degree of P: 3 + d for whole d, 4 + n otherwise."""
        return self.whole + (4 if self.fractional else 3)


def find_degree(d: float) -> Degree:
    """The `Degree` of one concrete delay; an impossible delay gets the smallest one."""
    if not (np.isfinite(d) and d >= 0):
        return Degree(0, False)
    whole = int(np.floor(d))
    return Degree(whole, bool(d != whole))


def groups(d: np.ndarray) -> Iterator[tuple[Degree, np.ndarray]]:
    """The degrees that occur in a flat array of delays (the smallest if it is empty), each with its positions."""
    # What is beyond the range of the model becomes NaN, and must not decide the length of all others.
    defined = np.where((d >= 0) & (d <= LONGEST_DELAY), d, 0.0)
    # Twice the whole part, plus one where a fraction remains, orders the degrees.
    code = 2.0 * np.floor(defined) + (defined != np.floor(defined))
    # One degree is the common case, and to sort a million codes takes as long as some kernels.
    alike = code.size == 0 or code.min() == code.max()
    for value in (code[:1] if code.size else [0.0]) if alike else np.unique(code):
        yield Degree(int(value // 2), bool(value % 2)), np.flatnonzero(code == value)


def map_by_degree(
    kernel: Callable[..., Any], values: tuple[ArrayLike, ...], *static: Any, lead: bool = False, route: Route = "auto"
) -> Any:
    """Apply ``kernel(alpha, beta, delta, d, degree, *static)``, elementwise, to points whose delays may differ.

    Results that are vectors, along a last axis, come back in one array; shorter ones are filled with zeros in front
    (``lead``, for coefficients) or NaN behind (for poles). By the route "numpy" the kernel gets all points of a degree.
    """
    arguments = dict(zip(NAMES, values, strict=True))
    check_scalars(arguments)
    traced = is_traced(*values)
    if traced:
        delays, arrays = _concrete_delay(values[-1]), broadcast_traced(values)
        import jax.numpy as xp
    else:
        arrays, xp = broadcast(arguments), np
        delays = arrays[-1]
    shape = arrays[0].shape
    columns = [array.reshape(-1) for array in arrays]
    parts, places = [], []
    for degree, index in groups(np.broadcast_to(delays, shape).reshape(-1)):
        picked = columns if index.size == columns[0].size else [column[index] for column in columns]
        if traced or route == "numpy":
            with np.errstate(all="ignore"):
                parts.append(kernel(*picked, degree, *static))
        else:
            # In coefficients; a power of two.
            weight = 1 << max(0, degree.poles.bit_length() - 4)
            parts.append(evaluate_columns(kernel, picked, degree, *static, weight=weight))
        places.append(index)
    order = np.argsort(np.concatenate(places), kind="stable")

    def gather(*leaves: Any) -> Any:
        joined = leaves[0] if len(leaves) == 1 else xp.concatenate(_same_length(leaves, lead, xp))[order]
        return joined.reshape(shape + joined.shape[1:])

    result = tree_map(gather, *parts)
    return result if traced else to_caller(result, values)


def few_poles(degree: Degree) -> int:
    """Up to how many points of a degree NumPy has done before a compiler has begun."""
    return max(1, FEW * 64 // max(64, degree.poles**2))


def _same_length(leaves: tuple[Any, ...], lead: bool, xp: Any) -> list[Any]:
    """Fill vectors of different length to the longest one."""
    if leaves[0].ndim == 1:
        return list(leaves)
    longest = max(leaf.shape[1] for leaf in leaves)
    filled = []
    for leaf in leaves:
        missing = longest - leaf.shape[1]
        if lead:
            # Zeros in front of a polynomial, NaN in front of one that is not defined.
            front = xp.where(xp.isnan(leaf[:, :1]), xp.nan, 0.0)
            filled.append(xp.concatenate([xp.repeat(front, missing, axis=1), leaf], axis=1))
        else:
            filled.append(xp.pad(leaf, ((0, 0), (0, missing)), constant_values=xp.nan))
    return filled


def _concrete_delay(d: ArrayLike) -> np.ndarray:
    """The delay as a concrete array; a traced one is refused where it decides an array's shape."""
    if is_traced(d):
        raise TracedDelayError(
            "d: got a traced value, but the number of poles depends on it; pass d as a plain number, "
            "for example through jit's static_argnums or a closure"
        )
    return as_float64("d", d)
