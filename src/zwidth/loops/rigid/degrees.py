"""Grouping of points by the degree of their polynomial, so that none is padded before its computation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays import batching
from zwidth.arrays.xp import is_traced
from zwidth.loops.domain import LONGEST_DELAY
from zwidth.words.errors import InputError
from zwidth.words.types import ArrayLike

NAMES = ("alpha", "beta", "delta", "d")


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
    """The degrees that occur in a flat array of delays, each with the positions where it does."""
    # What is beyond the range of the model becomes NaN, and must not decide the length of all others.
    defined = np.where((d >= 0) & (d <= LONGEST_DELAY), d, 0.0)
    # Twice the whole part, plus one where a fraction remains, orders the degrees.
    code = 2.0 * np.floor(defined) + (defined != np.floor(defined))
    # One degree is the common case, and to sort a million codes takes as long as some kernels.
    alike = code.size > 0 and code.min() == code.max()
    for value in code[:1] if alike else np.unique(code):
        yield Degree(int(value // 2), bool(value % 2)), np.flatnonzero(code == value)


def map_by_degree(
    kernel: Callable[..., Any],
    values: tuple[ArrayLike, ...],
    *,
    static: tuple[Any, ...] = (),
    lead: bool = False,
    few: Callable[[Degree], int] | None = None,
) -> Any:
    """Apply ``kernel(alpha, beta, delta, d, degree, *static)`` to points whose delays may differ.

    Results that are vectors come back in one array; shorter ones are filled with zeros in front (``lead``, for
    coefficients) or NaN behind (for poles). With ``few`` the kernel's text serves NumPy too, along first axes of any
    shape, and takes up to so many points of a degree without JAX.
    """
    if is_traced(*values):
        return _map_traced(kernel, values, static, lead)
    arrays = batching.broadcast(NAMES, values)
    columns = [array.ravel() for array in arrays]
    parts, places = [], []
    for degree, index in groups(columns[-1]):
        picked = columns if index.size == columns[-1].size else [column[index] for column in columns]
        if few is not None and index.size <= few(degree):
            with np.errstate(all="ignore"):
                parts.append(kernel(*picked, degree, *static))
        else:
            parts.append(batching.map_flat(kernel, picked, (degree, *static)))
        places.append(index)
    if not parts:
        parts, places = [_of_nothing(kernel, columns, static, few)], [np.arange(0)]
    order = np.argsort(np.concatenate(places), kind="stable")
    shape = arrays[0].shape

    def gather(*leaves: np.ndarray) -> np.ndarray:
        joined = leaves[0] if len(leaves) == 1 else np.concatenate(_same_length(list(leaves), lead, np))[order]
        return joined.reshape(shape + joined.shape[1:])

    return batching.to_caller(batching.tree_map(gather, *parts), values)


def _of_nothing(kernel: Callable[..., Any], columns: list[np.ndarray], static: tuple, few: Any) -> Any:
    """Results of no point, of the shapes that the shortest delay gives."""
    if few is not None:
        return kernel(*columns, Degree(0, False), *static)
    return batching.map_flat(kernel, columns, (Degree(0, False), *static))


def few_poles(degree: Degree) -> int:
    """Up to how many points of a degree NumPy has done before a compiler has begun."""
    return max(1, batching.FEW * 64 // max(64, degree.poles**2))


def _same_length(leaves: list[Any], lead: bool, numpy: Any) -> list[Any]:
    """Fill vectors of different length to the longest one."""
    if leaves[0].ndim == 1:
        return leaves
    longest = max(leaf.shape[1] for leaf in leaves)
    filled = []
    for leaf in leaves:
        missing = longest - leaf.shape[1]
        if lead:
            # Zeros in front of a polynomial, NaN in front of one that is not defined.
            front = numpy.where(numpy.isnan(leaf[:, :1]), np.nan, 0.0)
            filled.append(numpy.concatenate([numpy.repeat(front, missing, axis=1), leaf], axis=1))
        else:
            filled.append(numpy.pad(leaf, ((0, 0), (0, missing)), constant_values=np.nan))
    return filled


def _map_traced(kernel: Callable[..., Any], values: tuple, static: tuple, lead: bool) -> Any:
    import jax
    import jax.numpy as jnp

    delays = batching.concrete_delay(values[-1])
    arrays = batching.traced_columns(values)
    shape = arrays[0].shape
    flat_delays = np.broadcast_to(delays, shape).ravel()
    columns = [array.reshape(-1) for array in arrays]
    parts, places = [], []
    for degree, index in groups(flat_delays):
        picked = [column[index] for column in columns]
        parts.append(jax.vmap(lambda *point, degree=degree: kernel(*point, degree, *static))(*picked))
        places.append(index)
    if not parts:
        raise InputError(f"{', '.join(NAMES)}: got no point at all inside a JAX transformation")
    order = np.argsort(np.concatenate(places), kind="stable")

    def gather(*leaves: jax.Array) -> jax.Array:
        joined = jnp.concatenate(_same_length(list(leaves), lead, jnp))[order]
        return joined.reshape(shape + joined.shape[1:])

    return jax.tree.map(gather, *parts)
