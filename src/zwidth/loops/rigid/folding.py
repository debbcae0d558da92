"""How the four arguments of a method are laid out: which axes each varies along, before they are broadcast.

A map over alpha and beta of one device needs the device's coefficients once and the work of a row once a row. The
methods of this folder see that from the shapes alone, so arguments are kept as small as they came; axes along which
an argument only repeats itself (broadcast views, `numpy.meshgrid`) are folded back to length 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.arguments import as_float64, join_shapes
from zwidth.loops.rigid.degrees import NAMES

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


class FoldedArguments(NamedTuple):
    """Folded arguments and the shape the caller's arguments broadcast to."""

    points: Points
    shape: tuple[int, ...]

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Broadcast values of the folded arguments to the caller's shape; a view where something repeats."""
        return values if values.shape == self.shape else np.broadcast_to(values, self.shape)


def fold_arguments(values: tuple[Any, Any, Any, Any]) -> FoldedArguments:
    """Convert concrete arguments, check that they broadcast, and fold what repeats."""
    arrays = [as_float64(name, value) for name, value in zip(NAMES, values, strict=True)]
    shape = join_shapes(zip(NAMES, (array.shape for array in arrays), strict=True))
    ranked = [array.reshape((1,) * (len(shape) - array.ndim) + array.shape) for array in arrays]
    points = Points(*map(fold, ranked))
    # An axis along which nothing varies has nothing to compute; `FoldedArguments.spread` restores it.
    return FoldedArguments(points, shape)


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


def pick_points(points: Points, mask: np.ndarray) -> Points:
    """The points of a mask of the broadcast shape, listed; what is the same for all of them stays a single value."""
    shape = points.shape
    return Points(*(a.reshape(1) if a.size == 1 and shape else np.broadcast_to(a, shape)[mask] for a in points))


def group_by(arrays: tuple[np.ndarray, ...], key: np.ndarray) -> Iterator[tuple[Any, tuple[np.ndarray, ...], Any]]:
    """The values of a key that broadcasts with arguments, the arguments of each, and the place of what they give.

    Where the key varies along one axis the parts keep their layout; where it varies along several, the points are
    listed one by one.
    """
    key = fold(key)
    values = np.unique(key)
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
