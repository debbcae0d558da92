"""How the four arguments of a method are laid out: the axes each varies along, and the points of one degree.

A map over alpha and beta of one device needs the device's coefficients once and the work of a row once a row. The
methods of this folder see that from the shapes alone, so arguments are kept as small as they came; axes along which an
argument only repeats itself (broadcast views, `numpy.meshgrid`) are folded back to length 1. For methods whose arrays
are as long as the polynomial points are grouped by its degree, so that none is padded before its computation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.evaluate import (
    FEW,
    Route,
    as_float64,
    broadcast,
    broadcast_traced,
    check_scalars,
    evaluate_columns,
    join_shapes,
    to_caller,
)
from zwidth.words.errors import TracedDelayError
from zwidth.words.quantities import LONGEST_DELAY
from zwidth.words.types import ArrayLike
from zwidth.words.xp import is_traced

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


def map_by_degree(
    kernel: Callable[..., Any], values: tuple[ArrayLike, ...], *static: Any, lead: bool = False, route: Route = "auto"
) -> Any:
    """The vectors ``kernel(alpha, beta, delta, d, degree, *static)`` of points of any delays, as one array."""
    # Shorter ones are filled with zeros in front (``lead``, for coefficients) or NaN behind (for poles). By "numpy" the
    # kernel gets all points of a degree.
    arguments = dict(zip(NAMES, values, strict=True))
    check_scalars(arguments)
    traced = is_traced(*values)
    if traced:
        if is_traced(values[-1]):
            raise TracedDelayError(
                "d: got a traced value, but the number of poles depends on it; pass d as a plain number, "
                "for example through jit's static_argnums or a closure"
            )
        delays, arrays = as_float64("d", values[-1]), broadcast_traced(arguments)
        import jax.numpy as xp
    else:
        arrays, xp = broadcast(arguments), np
        delays = arrays[-1]
    shape = np.shape(arrays[0])
    columns: list[Any] = [xp.reshape(array, -1) for array in arrays]
    # What is beyond the range of the model must not decide the length of all others.
    defined = np.broadcast_to(np.where((delays >= 0) & (delays <= LONGEST_DELAY), delays, 0.0), shape).reshape(-1)
    parts, places = [], []
    for delay, picked, place in group_by(tuple(columns), 0.5 * (np.floor(defined) + np.ceil(defined))):
        degree = find_degree(delay)
        if traced or route == "numpy":
            with np.errstate(all="ignore"):
                parts.append(kernel(*picked, degree, *static))
        else:
            # In coefficients; a power of two.
            weight = 1 << max(0, degree.poles.bit_length() - 4)
            parts.append(evaluate_columns(kernel, picked, degree, *static, weight=weight))
        places.append(np.arange(columns[0].size)[place])
    (result, *others), longest = parts, max(part.shape[1] for part in parts)
    if others:
        order = np.argsort(np.concatenate(places), kind="stable")
        result = xp.concatenate([_fill_up(part, longest, lead, xp) for part in parts])[order]
    result = result.reshape(*shape, longest)
    return result if traced else to_caller(result, values)


def _fill_up(part: Any, longest: int, lead: bool, xp: Any) -> Any:
    """Vectors as long as the longest one."""
    missing = longest - part.shape[1]
    if not lead:
        return xp.pad(part, ((0, 0), (0, missing)), constant_values=xp.nan)
    # Zeros in front of a polynomial, NaN in front of one that is not defined.
    front = xp.where(xp.isnan(part[:, :1]), xp.nan, 0.0)
    return xp.concatenate([xp.repeat(front, missing, axis=1), part], axis=1)


def few_poles(degree: Degree) -> int:
    """Up to how many points of a degree NumPy has done before a compiler has begun."""
    return max(1, FEW // max(8, degree.poles**2))


# Below this many values an argument is too small for looking for repetition to pay.
_WORTH_FOLDING = 2048
# Smaller maps are listed point by point, in padded pieces that share their compilations.
_WORTH_OWN_SHAPE = 1 << 16


class Points(NamedTuple):
    """Arguments of one rank and their broadcast shape; float64, each of length 1 where it does not vary."""

    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray
    d: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        """The broadcast shape."""
        return np.broadcast_shapes(*(array.shape for array in self))

    @property
    def size(self) -> int:
        """How many points there are."""
        return int(np.prod(self.shape))

    def columns(self) -> list[np.ndarray]:
        """The points listed, one array each; what is the same for all of them stays a single value."""
        return [a.reshape(1) if a.size == 1 else np.broadcast_to(a, self.shape).reshape(-1) for a in self]

    @property
    def is_dense(self) -> bool:
        """Whether the points form a map large enough to be compiled in its own shape, row by row."""
        shape = self.shape
        return self.size >= _WORTH_OWN_SHAPE and shape[-1] >= 32 and 4 * sum(a.size for a in self) <= self.size


def fold_arguments(values: tuple[Any, Any, Any, Any]) -> tuple[Points, tuple[int, ...]]:
    """Concrete arguments, checked and folded where they repeat, and the shape that they broadcast to."""
    arrays = [as_float64(name, value) for name, value in zip(NAMES, values, strict=True)]
    shape = join_shapes(zip(NAMES, (array.shape for array in arrays), strict=True))
    ranked = [array.reshape((1,) * (len(shape) - array.ndim) + array.shape) for array in arrays]
    return Points(*map(fold, ranked)), shape


def spread(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """What was computed of folded arguments, in the shape that they broadcast to; a view where something repeats."""
    return values if values.shape == shape else np.broadcast_to(values, shape)


def fold(array: np.ndarray) -> np.ndarray:
    """Return the array with every axis along which its values are constant reduced to length 1."""
    # Decide by the size before folding, because folding one axis can make the array too small for a comparison.
    compare = array.size >= _WORTH_FOLDING
    for axis in range(array.ndim):
        if array.shape[axis] > 1 and _repeats(array, axis, compare):
            array = array[(slice(None),) * axis + (slice(0, 1),)]
    return array


def _repeats(array: np.ndarray, axis: int, compare: bool) -> bool:
    """Return whether the values are constant along an axis: by the stride and, if ``compare``, by comparing values."""
    if array.strides[axis] == 0:
        return True
    if not compare:
        return False
    along = np.moveaxis(array, axis, 0)
    # Compare the last slice first, because it differs in most arrays that are not constant.
    return bool(np.array_equal(along[0], along[-1]) and (along == along[0]).all())


def group_by(arrays: tuple[np.ndarray, ...], key: np.ndarray) -> Iterator[tuple[Any, tuple[np.ndarray, ...], Any]]:
    """The values of a key that broadcasts with arguments, the arguments of each, and the place of what they give."""
    # Where the key varies along one axis the parts keep their layout; along several, the points are listed one by one.
    key = fold(key)
    # One value is the common case, and of no points it is 0.
    values = np.unique(key) if key.size else np.zeros(1)
    varying = [axis for axis, length in enumerate(key.shape) if length > 1]
    if values.size == 1:
        yield values[0], arrays, ...
        return
    if len(varying) > 1:
        key, *everywhere = np.broadcast_arrays(key, *arrays)
        for value in values:
            yield value, tuple(array[key == value] for array in everywhere), key == value
        return
    for value in values:
        axis, index = varying[0], np.flatnonzero(key.reshape(-1) == value)
        taken = tuple(array if array.shape[axis] == 1 else array.take(index, axis) for array in arrays)
        yield value, taken, (slice(None),) * axis + (index,)
