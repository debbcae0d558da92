"""How the four arguments of a method are laid out: which axes each varies along, before they are broadcast.

A map over alpha and beta of one device needs the device's coefficients once and the work of a row once a row. The
methods of this folder see that from the shapes alone, so arguments are kept as small as they came; axes along which
an argument only repeats itself (broadcast views, `numpy.meshgrid`) are folded back to length 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from zwidth.batching import as_float64
from zwidth.errors import InputError
from zwidth.grouping import NAMES, Degree, groups

# Below this many values an argument is too small for looking for repetition to pay.
_WORTH_FOLDING = 2048
# Compiled sizes are powers of two up to this many points; larger batches run in pieces of it.
PIECE = 1 << 17


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

    def flat(self) -> Points:
        """Every argument at every point, in one axis."""
        return Points(*(np.ascontiguousarray(array).reshape(-1) for array in np.broadcast_arrays(*self)))


class Laid(NamedTuple):
    """Folded arguments and the shape the caller's arguments broadcast to."""

    points: Points
    shape: tuple[int, ...]

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Broadcast values of the folded arguments to the caller's shape; a view where something repeats."""
        return values if values.shape == self.shape else np.broadcast_to(values, self.shape)


def lay_out(values: tuple[Any, Any, Any, Any]) -> Laid:
    """Convert concrete arguments, check that they broadcast, and fold what repeats."""
    arrays = [as_float64(name, value) for name, value in zip(NAMES, values, strict=True)]
    try:
        shape = np.broadcast_shapes(*(array.shape for array in arrays))
    except ValueError as error:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in zip(NAMES, arrays, strict=True))
        raise InputError(f"shapes do not broadcast: {shapes}; make each axis equal or 1") from error
    ranked = [array.reshape((1,) * (len(shape) - array.ndim) + array.shape) for array in arrays]
    points = Points(*map(fold, ranked))
    # An axis along which nothing varies has nothing to compute; `Laid.spread` restores it.
    return Laid(points, shape)


def fold(array: np.ndarray) -> np.ndarray:
    """Shorten to 1 every axis along which the array repeats itself."""
    for axis in range(array.ndim):
        if array.shape[axis] > 1 and _repeats(array, axis):
            array = array[(slice(None),) * axis + (slice(0, 1),)]
    return array


def _repeats(array: np.ndarray, axis: int) -> bool:
    if array.strides[axis] == 0:
        return True
    if array.size < _WORTH_FOLDING:
        return False
    first = array.take([0], axis=axis)
    # Most arrays that do not repeat are found out by their last slice.
    return bool(np.array_equal(first, array.take([-1], axis=axis)) and (array == first).all())


def by_degree(points: Points, shape: tuple[int, ...], dtype: Any, work: Callable[[Degree, Points], np.ndarray]) -> Any:
    """Fill an array of ``shape`` with ``work(degree, part)`` for the parts of ``points`` of one degree each.

    Where the delay varies along one axis its parts keep their layout; where it varies along several, the points are
    listed one by one.
    """
    parts = list(_parts(points))
    if len(parts) == 1 and parts[0][1] is None:
        return work(parts[0][0], points)
    varying = [axis for axis, length in enumerate(points.d.shape) if length > 1]
    if len(varying) != 1:
        flat = points.flat()
        out = np.empty(flat.alpha.size, dtype)
        for degree, index in groups(flat.d):
            out[index] = work(degree, Points(*(column[index] for column in flat)))
        return out.reshape(shape)
    axis = varying[0]
    out = np.empty(shape, dtype)
    for degree, index in parts:
        part = Points(*(column if column.shape[axis] == 1 else column.take(index, axis) for column in points))
        out[(slice(None),) * axis + (index,)] = work(degree, part)
    return out


def _parts(points: Points) -> Iterator[tuple[Degree, np.ndarray | None]]:
    found = list(groups(points.d.reshape(-1)))
    if len(found) <= 1:
        yield (found[0][0] if found else Degree(0, False)), None
        return
    yield from found


def device_ok(points: Points) -> np.ndarray:
    """Where delta and d are in range, of their common shape."""
    delta, d = points.delta, points.d
    return np.isfinite(delta) & np.isfinite(d) & (delta >= 0) & (d >= 0)


def point_ok(points: Points) -> np.ndarray:
    """Where all four arguments are in range, of the shape they have before they are broadcast to the caller's."""
    return np.isfinite(points.alpha) & np.isfinite(points.beta) & device_ok(points)


def pieces(count: int) -> Iterator[tuple[slice, int]]:
    """Slices that cover ``count`` values, each with the compiled size to which it is padded."""
    for start in range(0, count, PIECE):
        stop = min(start + PIECE, count)
        yield slice(start, stop), min(PIECE, 1 << max(stop - start - 1, 0).bit_length())


def padded(column: np.ndarray, size: int) -> np.ndarray:
    """Repeat the last value up to ``size``: it is as harmless as the point it came from."""
    return column if column.size == size else np.pad(column, (0, size - column.size), mode="edge")


def run_pieces(function: Callable[..., Any], columns: list[np.ndarray], dtype: Any) -> np.ndarray:
    """Apply a compiled elementwise function to flat columns in float64; columns of length 1 are shared by all."""
    count = max(column.size for column in columns)
    out = np.empty(count, dtype)
    with jax.enable_x64(True):
        for part, size in pieces(count):
            columns_here = [column if column.size == 1 else padded(column[part], size) for column in columns]
            out[part] = np.asarray(function(*columns_here))[: part.stop - part.start]
    return out
