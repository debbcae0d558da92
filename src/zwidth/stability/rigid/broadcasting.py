"""Fold repeated values of the arguments alpha, beta, delta and d, and group points by the degree of P.

A *point* is one combination of the four arguments: a wall (alpha, beta) on a device with damping delta and delay d. If
an argument is constant along an axis (broadcast views, `numpy.meshgrid`), the axis is *folded*: the argument gets
length 1 there. From these shapes callers recognize a grid over alpha and beta for one device, and compute the device
once and each line of constant beta once.

The characteristic polynomial P has a degree that depends on the delay. For functions whose results have the length of
P, points are grouped by this degree, so that no array is padded before the computation. A *kernel* is a function of
*columns*, one-dimensional arrays with one entry per point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import TracedDelayError
from zwidth.core.types import ArrayLike
from zwidth.core.xp import is_jax, is_traced, namespace
from zwidth.numerics.devices import map_on_devices
from zwidth.numerics.evaluate import (
    CACHED_KERNELS,
    FEW,
    Route,
    as_float64,
    broadcast,
    broadcast_traced,
    check_scalars,
    evaluate_columns,
    join_shapes,
    precision,
)
from zwidth.stability.reference import Degree
from zwidth.units.quantities import LONGEST_DELAY

NAMES: tuple[str, ...] = ("alpha", "beta", "delta", "d")


def find_degree(d: float) -> Degree:
    """Return the properties of one delay that determine the degree of P; for an invalid delay, those of d = 0."""
    if not (np.isfinite(d) and d >= 0):
        return Degree(0, False)
    n = int(np.floor(d))
    return Degree(n, bool(d != n))


def map_by_degree(
    kernel: Callable[..., Any], values: tuple[ArrayLike, ...], *static: Any, lead: bool = False, route: Route = "auto"
) -> Any:
    """Evaluate a kernel for all points, grouped by the degree of P, and return the vectors of all points as one array.

    The kernel is called as ``kernel(alpha, beta, delta, d, degree, *static)``.

    Args:
        kernel: Function of columns whose points have the same degree; returns an array of shape (points, length).
        values: alpha, beta, delta and d; the delays may differ.
        *static: Further arguments of the kernel.
        lead: Fill shorter vectors with leading zeros, for coefficients; otherwise with NaN at the end, for poles.
        route: Route of `evaluate_columns`; with "numpy" the kernel receives all points of a degree at once. JAX arrays
            are computed by compiled code.

    Returns:
        Array of the broadcast shape with an additional last axis, whose length is that of the longest vector.
    """
    arguments = dict(zip(NAMES, values, strict=True))
    check_scalars(arguments)
    if any(map(is_jax, values)):
        if is_traced(values[-1]):
            raise TracedDelayError(
                "d: got a traced value, but the number of poles depends on it; pass d as a plain number, "
                "for example through jit's static_argnums or a closure"
            )
        with precision(values):
            arrays, delays = broadcast_traced(arguments), as_float64("d", values[-1])
            degrees = _group_delays(delays)
            distinct = np.unique(degrees)
            if distinct.size == 1:
                return map_on_devices(compile_by_degree(kernel, find_degree(distinct[0]), *static), arrays)
            return _join_degrees(kernel, arrays, degrees, static, lead)
    arrays = broadcast(arguments)
    return _join_degrees(kernel, arrays, _group_delays(arrays[-1]), static, lead, route)


@lru_cache(CACHED_KERNELS)
def compile_by_degree(kernel: Callable[..., Any], degree: Degree, *static: Any) -> Callable[..., Any]:
    """Return the kernel, compiled by JAX for points of one degree of P, as a function of JAX arrays of equal shape."""
    import jax

    def compute(*arrays: Any) -> Any:
        results = kernel(*(array.reshape(-1) for array in arrays), degree, *static)
        return jax.tree.map(lambda leaf: leaf.reshape(*arrays[0].shape, *leaf.shape[1:]), results)

    return jax.jit(compute)


def _group_delays(delays: np.ndarray) -> np.ndarray:
    """Return a key for each delay d, by which points are grouped: n for d = n, and n + 1/2 for n < d < n + 1.

    All delays with the same key have polynomials P of the same degree.
    """
    # Replace delays out of range by 0, so that they do not affect the length of the result.
    defined = np.where((delays >= 0) & (delays <= LONGEST_DELAY), delays, 0.0)
    return 0.5 * (np.floor(defined) + np.ceil(defined))


def _join_degrees(
    kernel: Callable[..., Any], arrays: list[Any], degrees: np.ndarray, static: tuple, lead: bool, route: Route = "auto"
) -> Any:
    """Evaluate a kernel for arrays of equal shape, separately for each degree of P, and join the resulting vectors.

    ``degrees`` are the keys that `_group_delays` returns; the other arguments are those of `map_by_degree`.
    """
    xp = namespace(*arrays)
    shape = np.shape(arrays[0])
    columns: list[Any] = [xp.reshape(array, -1) for array in arrays]
    key = np.broadcast_to(degrees, shape).reshape(-1)
    vectors, indices = [], []
    for delay, group, index in group_by_value(tuple(columns), key):
        degree = find_degree(delay)
        if xp is not np:
            vectors.append(compile_by_degree(kernel, degree, *static)(*group))
        elif route == "numpy":
            with np.errstate(all="ignore"):
                vectors.append(kernel(*group, degree, *static))
        else:
            # Estimate the cost per point as an eighth of the number of poles, rounded down to a power of two, but at
            # least 1.
            weight = 1 << max(0, degree.poles.bit_length() - 4)
            vectors.append(evaluate_columns(kernel, group, degree, *static, weight=weight))
        indices.append(np.arange(columns[0].size)[index])
    (result, *others), longest = vectors, max(vector.shape[1] for vector in vectors)
    if others:
        order = np.argsort(np.concatenate(indices), kind="stable")
        result = xp.concatenate([_pad_vectors(vector, longest, lead, xp) for vector in vectors])[order]
    return result.reshape(*shape, longest)


def _pad_vectors(part: Any, longest: int, lead: bool, xp: Any) -> Any:
    """Pad vectors of equal length to the length ``longest``: with leading zeros (``lead``), or with NaN at the end."""
    missing = longest - part.shape[1]
    if not lead:
        return xp.pad(part, ((0, 0), (0, missing)), constant_values=xp.nan)
    # Insert zeros before the coefficients of a polynomial; if the point is invalid, insert NaN.
    front = xp.where(xp.isnan(part[:, :1]), xp.nan, 0.0)
    return xp.concatenate([xp.repeat(front, missing, axis=1), part], axis=1)


def count_uncompiled_points(degree: Degree) -> int:
    """Return the largest number of points with the given degree for which NumPy is faster than compiling."""
    return max(1, FEW // max(8, degree.poles**2))


# Smallest size of an argument whose values are compared to detect repetition; for fewer values a comparison takes
# longer than folding saves.
MIN_COMPARED_SIZE = 2048
# Smallest number of points of a grid for which a program is compiled in the shape of the grid. Smaller grids are
# flattened into columns and padded to common sizes, so that they share one program.
MIN_DENSE_SIZE = 1 << 16


class Points(NamedTuple):
    """Float64 arrays of alpha, beta, delta and d of equal rank, with length 1 along axes on which they are constant."""

    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray
    d: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape to which the four arguments broadcast."""
        return np.broadcast_shapes(*(array.shape for array in self))

    @property
    def size(self) -> int:
        """Number of points."""
        return int(np.prod(self.shape))

    def columns(self) -> list[np.ndarray]:
        """Return the points as one column per argument; a column has length 1 if the argument is constant."""
        return [a.reshape(1) if a.size == 1 else np.broadcast_to(a, self.shape).reshape(-1) for a in self]

    @property
    def is_dense(self) -> bool:
        """True if the points form a grid that is large enough to be compiled in its own shape."""
        shape = self.shape
        return self.size >= MIN_DENSE_SIZE and shape[-1] >= 32 and 4 * sum(a.size for a in self) <= self.size


def fold_arguments(values: tuple[Any, Any, Any, Any]) -> tuple[Points, tuple[int, ...]]:
    """Check and fold arguments that JAX does not trace; return the points and the shape to which they broadcast."""
    arrays = [as_float64(name, value) for name, value in zip(NAMES, values, strict=True)]
    shape = join_shapes(zip(NAMES, (array.shape for array in arrays), strict=True))
    aligned = [array.reshape((1,) * (len(shape) - array.ndim) + array.shape) for array in arrays]
    return Points(*map(fold, aligned)), shape


def restore_shape(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Broadcast the results of folded arguments to the original shape; returns a view if a result is repeated."""
    return values if values.shape == shape else np.broadcast_to(values, shape)


def fold(array: np.ndarray) -> np.ndarray:
    """Reduce every axis along which the values of an array are constant to length 1, and return the array."""
    # Decide before folding whether values are compared, because folding an axis reduces the size of the array.
    compare = array.size >= MIN_COMPARED_SIZE
    for axis in range(array.ndim):
        if array.shape[axis] > 1 and _is_constant(array, axis, compare):
            array = array[(slice(None),) * axis + (slice(0, 1),)]
    return array


def _is_constant(array: np.ndarray, axis: int, compare: bool) -> bool:
    """Return whether values are constant along an axis, as shown by a stride of 0 or, if ``compare``, by the values."""
    if array.strides[axis] == 0:
        return True
    if not compare:
        return False
    along = np.moveaxis(array, axis, 0)
    # Compare the last slice first, because it differs in most arrays that are not constant.
    return bool(np.array_equal(along[0], along[-1]) and (along == along[0]).all())


def group_by_value(
    arrays: tuple[np.ndarray, ...], key: np.ndarray
) -> Iterator[tuple[Any, tuple[np.ndarray, ...], Any]]:
    """Yield each distinct value of a key array, with the arguments and the index of the points that have this value.

    Args:
        arrays: Arguments.
        key: Array that broadcasts with the arguments.

    Yields:
        The value; the arguments of its points; and the index of these points in the broadcast shape.
    """
    # If the key varies along one axis only, slice the arguments along this axis; otherwise flatten the points of a
    # group.
    key = fold(key)
    # Handle a key with a single value separately, because this case is the most frequent one. If there are no points,
    # yield the value 0.
    values = np.unique(key) if key.size else np.zeros(1)
    varying = [axis for axis, length in enumerate(key.shape) if length > 1]
    if values.size == 1:
        yield values[0], arrays, ...
        return
    if len(varying) > 1:
        key, *all_arrays = np.broadcast_arrays(key, *arrays)
        for value in values:
            yield value, tuple(array[key == value] for array in all_arrays), key == value
        return
    for value in values:
        axis, index = varying[0], np.flatnonzero(key.reshape(-1) == value)
        group = tuple(array if array.shape[axis] == 1 else array.take(index, axis) for array in arrays)
        yield value, group, (slice(None),) * axis + (index,)
