"""How the four arguments of a method are laid out: which axes each varies along, before they are broadcast.

A map over alpha and beta of one device needs the device's coefficients once and the work of a row once a row. The
methods of this folder see that from the shapes alone, so arguments are kept as small as they came; axes along which
an argument only repeats itself (broadcast views, `numpy.meshgrid`) are folded back to length 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from zwidth.batching import as_float64, concretely
from zwidth.errors import InputError
from zwidth.grouping import NAMES, Degree

# Below this many values an argument is too small for looking for repetition to pay.
_WORTH_FOLDING = 2048
# Compiled sizes are powers of two up to this many points; larger batches run in pieces of it.
PIECE = 1 << 17


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


def picked(points: Points, mask: np.ndarray) -> Points:
    """The points of a mask of the broadcast shape, listed; what is the same for all of them stays a single value."""
    shape = points.shape
    return Points(*(a.reshape(1) if a.size == 1 and shape else np.broadcast_to(a, shape)[mask] for a in points))


class Part(NamedTuple):
    """Arguments that belong to one value of a key, and where their results go."""

    value: Any
    arrays: tuple[np.ndarray, ...]
    place: tuple[Any, ...]


def split(arrays: tuple[np.ndarray, ...], key: np.ndarray) -> list[Part]:
    """Group arguments by the values of a key that broadcasts with them.

    Where the key varies along one axis the parts keep their layout; where it varies along several, the points are
    listed one by one.
    """
    key = fold(key)
    values = np.unique(key)
    if values.size <= 1:
        return [Part(values[0] if values.size else 0, arrays, (...,))]
    varying = [axis for axis, length in enumerate(key.shape) if length > 1]
    parts = []
    if len(varying) == 1:
        axis, along = varying[0], key.reshape(-1)
        for value in values:
            index = np.flatnonzero(along == value)
            taken = tuple(array if array.shape[axis] == 1 else array.take(index, axis) for array in arrays)
            parts.append(Part(value, taken, ((slice(None),) * axis + (index,))))
        return parts
    everywhere = np.broadcast_arrays(key, *arrays)
    for value in values:
        mine = everywhere[0] == value
        parts.append(Part(value, tuple(array[mine] for array in everywhere[1:]), (mine,)))
    return parts


def split_by_degree(points: Points) -> list[Part]:
    """Group points by the `Degree` of their polynomial; an impossible delay counts as 0."""
    defined = np.where(np.isfinite(points.d) & (points.d >= 0), points.d, 0.0)
    whole = np.floor(defined)
    # Twice the whole part, plus one where a fraction remains, names a degree.
    code = 2 * whole + (defined != whole)
    return [
        Part(Degree(int(value // 2), bool(value % 2)), arrays, place) for value, arrays, place in split(points, code)
    ]


def assemble(
    parts: list[Part], shape: tuple[int, ...], dtype: Any, work: Callable[..., np.ndarray], several: int = 0
) -> np.ndarray:
    """Put the results of ``work(value, *arrays)`` where they belong; ``several`` of them lie along an axis in front."""
    if len(parts) == 1:
        return work(parts[0].value, *parts[0].arrays)
    out = np.empty((several, *shape) if several else shape, dtype)
    front = (slice(None),) if several else ()
    for value, arrays, place in parts:
        out[front + place] = work(value, *arrays)
    return out


def device_ok(points: Points) -> np.ndarray:
    """Where delta and d are in range, of their common shape."""
    delta, d = points.delta, points.d
    return np.isfinite(delta) & np.isfinite(d) & (delta >= 0) & (d >= 0)


def point_ok(points: Points) -> np.ndarray:
    """Where all four arguments are in range, of the shape they have before they are broadcast to the caller's."""
    return np.isfinite(points.alpha) & np.isfinite(points.beta) & device_ok(points)


def pieces(count: int, piece: int = PIECE, least: int = 1) -> Iterator[tuple[slice, int]]:
    """Slices that cover ``count`` values, each with the compiled size to which it is padded, not below ``least``."""
    for start in range(0, count, piece):
        stop = min(start + piece, count)
        yield slice(start, stop), min(piece, max(least, 1 << max(stop - start - 1, 0).bit_length()))


def padded(column: np.ndarray, size: int) -> np.ndarray:
    """Repeat the last value up to ``size``: it is as harmless as the point it came from."""
    if column.size == size:
        return column
    filled = np.empty(size, column.dtype)
    filled[: column.size] = column
    filled[column.size :] = column[-1]
    return filled


class DeviceWork(NamedTuple):
    """A compiled function of (delta, d) and one of points with its result: what is shared, and what is not."""

    device: Callable[[Any, Any], Any]  # (delta, d) -> fields along a new first axis
    kernel: Callable[..., Any]  # (*columns, fields) -> one value a point, or several along a new first axis
    dtype: Any
    piece: int = PIECE
    several: int = 0
    least: int = 1  # a shorter batch is filled up: the compiler treats very short ones differently, to the last place


def per_device(work: DeviceWork, columns: list[np.ndarray], delta: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Apply ``work`` to columns that broadcast with delta and d; the result has their broadcast shape.

    Each device is computed once, unless there are about as many devices as points: then both go through the cache in
    small pieces.
    """
    shape = np.broadcast_shapes(delta.shape, d.shape, *(column.shape for column in columns))
    device_shape = np.broadcast_shapes(delta.shape, d.shape)
    deltas, delays = (np.broadcast_to(array, device_shape).reshape(-1) for array in (delta, d))
    flat = [np.broadcast_to(column, shape).reshape(-1) for column in columns]
    if not flat[0].size:
        return np.empty((work.several, *shape) if work.several else shape, work.dtype)
    owner = None
    if deltas.size > 1:
        owner = np.broadcast_to(np.arange(deltas.size).reshape(device_shape), shape).reshape(-1)
    values = _in_pieces(work, flat, deltas, delays, owner)
    return values.reshape((work.several, *shape) if work.several else shape)


def _in_pieces(
    work: DeviceWork, flat: list[np.ndarray], delta: np.ndarray, d: np.ndarray, owner: np.ndarray | None
) -> np.ndarray:
    count = flat[0].size
    shared = 4 * delta.size <= count or delta.size == 1
    out = np.empty((work.several, count) if work.several else count, work.dtype)
    with concretely():
        fields = fields_of(work, delta, d) if shared else None
        for part, size in pieces(count, work.piece, work.least):
            if fields is None:
                # Not shared, so there are several devices, each point with its own.
                rows = np.asarray(owner)[part]
                here = work.device(*(padded(device[rows], size) for device in (delta, d)))
            elif owner is None:
                here = fields
            else:
                here = np.asarray(fields)[:, padded(owner[part], size)]
            values = work.kernel(*(padded(column[part], size) for column in flat), here)
            out[..., part] = np.asarray(values)[..., : part.stop - part.start]
    return out


def fields_of(work: DeviceWork, delta: np.ndarray, d: np.ndarray) -> Any:
    """The fields of every device of two flat arrays; call it with float64 enabled."""
    if delta.size == 1:
        return work.device(delta, d)
    parts = []
    for part, size in pieces(delta.size, work.piece):
        values = work.device(padded(delta[part], size), padded(d[part], size))
        parts.append(np.asarray(values)[:, : part.stop - part.start])
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
