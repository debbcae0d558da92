"""The spectral radius of arrays: on maps by warm-started Newton steps, elsewhere point by point.

On a map the largest pole of one node a cell is found by itself; its derivatives with respect to alpha and beta place
the pole of every point of the cell, Newton's method finishes it and the certificate of `zwidth.stability.radius`
accepts it. What is not accepted (another pole is the largest there, or two are about to meet) is done point by point.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import ceil, log, log2
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array
from zwidth.batching import concretely
from zwidth.grouping import Degree, degree_of
from zwidth.stability.devices import Device, compiled_device
from zwidth.stability.layout import DeviceWork, Points, assemble, padded, per_device, picked, split_by_degree
from zwidth.stability.poles import companion_chunk, is_spring, pole_kernel
from zwidth.stability.radius import (
    Pole,
    accept,
    bisect,
    bracket,
    evaluate,
    newton,
    over,
    start,
    sure_error,
)

# Points along each side of a cell that shares one node.
_CELL = 16
# Rows of cells computed at once: bounded memory, and one compilation for maps of any height.
_BAND = 16
# Smaller maps are not worth a compilation of their own.
_WORTH_CELLS = 1 << 14
_STEPS_IN_CELL = 3
# Up to this degree XLA makes one loop over the points of many Newton steps; of more it would make several, and each
# would compute all steps before it again.
_STEPS_IN_ONE = 40
# Up to this degree the few points that no certificate accepts get companion eigenvalues.
COMPANION_POLES = 40
# Kernels that pass over their points many times work on as many as stay in the cache.
_LOOP_PIECE = 1 << 12
_LEAST = 64


class Radii(NamedTuple):
    """Results of the folded points: the radius, a bound of its error, and whether both sides are proved."""

    radius: np.ndarray
    error: np.ndarray
    certified: np.ndarray


def _collected(points: Points, of: Callable[[Degree, Points], np.ndarray]) -> Radii:
    """Results of every degree; radius, error and flag travel as one array with an axis in front."""
    parts = split_by_degree(points)
    shape = points.shape
    values = assemble(parts, shape, np.float64, lambda degree, *part: of(degree, Points(*part)), several=3)
    return Radii(values[0], values[1], values[2] > 0)


def steps_for(accuracy: float, degree: Degree) -> int:
    """How many halvings bring the bracket, a factor of 2 degree wide at most, to a relative accuracy."""
    return max(1, ceil(log2(log(2.0 * degree.poles) / accuracy)))


def bisected(points: Points, accuracy: float) -> Radii:
    """Bisection alone, in as many steps as the accuracy needs."""
    return _collected(points, lambda degree, part: _bisected(part, degree, accuracy))


def _bisected(points: Points, degree: Degree, accuracy: float) -> np.ndarray:
    shape = points.shape
    constants = [np.full((1,) * len(shape), value, np.float64) for value in (steps_for(accuracy, degree), accuracy)]
    return per_device(_bisection(degree), [points.alpha, points.beta, *constants], points.delta, points.d)


@cache
def _bisection(degree: Degree) -> DeviceWork:
    def kernel(alpha: Array, beta: Array, steps: Array, accuracy: Array, fields: Array) -> Array:
        device = Device(*fields)
        low, high = bracket(alpha, beta, device, degree)
        low, high = bisect(alpha, beta, low, high, jnp.int32(steps[0]), device, degree)
        # The lower end is known to some ulp.
        half = 0.5 * (high - low) + 4e-15 * high
        radius = 0.5 * (low + high)
        beyond = sure_error(alpha, beta, high, accuracy, device, degree)
        return jnp.stack([radius, half + beyond, jnp.zeros_like(radius)])

    return DeviceWork(compiled_device(), jax.jit(kernel), np.float64, _LOOP_PIECE, several=3)


@cache
def _companion(degree: Degree, spring: bool) -> DeviceWork:
    def point(alpha: Array, beta: Array, delta: Array, d: Array, *fields: Array) -> Array:
        poles = pole_kernel(alpha, beta, delta, d, degree, spring)
        size = jnp.abs(poles)
        z = poles[jnp.argmax(size)]
        radius = jnp.max(size)
        at = evaluate(Pole(z.real, z.imag), alpha, beta, Device(*fields), degree)
        # A pole lies within degree |P/P'| of any z. What rounding may do to P itself comes on top.
        slope = jnp.sqrt(at.slope.square)
        largest = jnp.maximum(radius, 1.0)
        wall = (jnp.abs(alpha) + jnp.abs(beta)) * largest**3
        rounding = 4e-16 * degree.poles * ((1.0 + radius) ** 2 * radius ** (degree.poles - 2) + wall)
        near = degree.poles * (jnp.sqrt(at.value.square) + rounding) / slope
        return jnp.stack([radius, near + 4e-16 * radius, jnp.zeros_like(radius)])

    def kernel(alpha: Array, beta: Array, delta: Array, d: Array, fields: Array) -> Array:
        spread = jnp.broadcast_to(fields, (fields.shape[0], *alpha.shape))
        return jax.vmap(point, out_axes=1)(alpha, beta, delta, d, *spread)

    return DeviceWork(compiled_device(), jax.jit(kernel), np.float64, companion_chunk(degree), several=3)


def by_companion(points: Points) -> Radii:
    """All poles of every point; the error is how far from the largest one computed a pole may be."""

    def of(degree: Degree, part: Points) -> np.ndarray:
        return per_device(_companion(degree, is_spring(part.beta)), list(part), part.delta, part.d)

    return _collected(points, of)


def by_newton(points: Points, accuracy: float) -> Radii:
    """Newton's method with a certificate, on maps from the nodes of cells, elsewhere from a coarse bisection."""
    return _collected(points, lambda degree, part: _by_newton(part, degree, accuracy))


class _Effort(NamedTuple):
    """How near the start comes before Newton's method takes over, and how many steps of it follow."""

    known: float  # the radius, to this part of it over the degree: the distance between poles
    steps: int

    def halvings(self, degree: Degree) -> np.int32:
        """The steps of bisection that this takes."""
        return np.int32(steps_for(self.known / degree.poles, degree))


# Nearly all points need the first; where two poles are almost equally large, or almost meet, the second tells them
# apart.
_EFFORTS = (_Effort(0.03, 4), _Effort(1e-6, 9))


class _Search(NamedTuple):
    """The way to the largest pole of a point by itself, in stages compiled apart, each with one array as its result."""

    coarse: Callable[..., Any]  # (alpha, beta, steps, fields) -> an upper bound of the radius
    near: Callable[..., Any]  # (steps, alpha, beta, bound, fields) -> the pole, complex, after so many Newton steps
    step: Callable[..., Any]  # (pole, alpha, beta, fields) -> the pole after one more
    last: Callable[..., Any]  # (pole, alpha, beta, tolerance, fields) -> the radius, negative where it is not proved


@cache
def _search(degree: Degree) -> _Search:
    def coarse(alpha: Array, beta: Array, steps: Array, fields: Array) -> Array:
        device = Device(*fields)
        low, high = bracket(alpha, beta, device, degree)
        return bisect(alpha, beta, low, high, steps, device, degree)[1]

    def follow(steps: int, z: Pole, alpha: Array, beta: Array, fields: Array) -> Array:
        z, _ = newton(z, steps, alpha, beta, Device(*fields), degree)
        return jax.lax.complex(z.re, z.im)

    def near(steps: int, alpha: Array, beta: Array, high: Array, fields: Array) -> Array:
        return follow(steps, start(alpha, beta, high, Device(*fields), degree), alpha, beta, fields)

    def last(z: Array, alpha: Array, beta: Array, tolerance: Array, fields: Array) -> Array:
        device = Device(*fields)
        found, step = newton(Pole(z.real, z.imag), 1, alpha, beta, device, degree)
        return accept(found, step, tolerance, alpha, beta, device, degree)

    compiled = jax.jit(near, static_argnums=0)
    one = jax.jit(lambda z, *values: follow(1, Pole(z.real, z.imag), *values))

    def near_stepwise(steps: int, alpha: Any, beta: Any, high: Any, fields: Any) -> Any:
        z = compiled(0, alpha, beta, high, fields)
        for _ in range(steps):
            z = one(z, alpha, beta, fields)
        return z

    return _Search(jax.jit(coarse), compiled if _is_short(degree) else near_stepwise, one, jax.jit(last))


def _is_short(degree: Degree) -> bool:
    return degree.poles <= _STEPS_IN_ONE


@cache
def _alone(degree: Degree, effort: int) -> DeviceWork:
    """The radius of points without neighbors, negative where it is not proved."""
    search = _search(degree)
    halvings = _EFFORTS[effort].halvings(degree)

    def kernel(alpha: Any, beta: Any, tolerance: Any, fields: Any) -> Any:
        high = search.coarse(alpha, beta, halvings, fields)
        z = search.near(_EFFORTS[effort].steps - 1, alpha, beta, high, fields)
        return search.last(z, alpha, beta, tolerance, fields)

    return DeviceWork(compiled_device(), kernel, np.float64, _LOOP_PIECE, least=_LEAST)


def _alone_at(points: Points, degree: Degree, accuracy: float, effort: int) -> np.ndarray:
    tolerance = np.broadcast_to(np.float64(accuracy), (1,) * len(points.shape))
    return per_device(_alone(degree, effort), [points.alpha, points.beta, tolerance], points.delta, points.d)


def certified_columns(
    alpha: np.ndarray, beta: np.ndarray, delta: np.ndarray, d: np.ndarray, accuracy: float
) -> tuple[np.ndarray, np.ndarray]:
    """Radii of equally many values of each, all of one degree, and whether each is proved; the others say nothing."""
    degree = degree_of(d[0])
    points = Points(alpha, beta, delta, d)
    found = _proved_alone(points, degree, accuracy)
    return np.abs(found), found > 0


def _proved_alone(points: Points, degree: Degree, accuracy: float) -> np.ndarray:
    """Radii of points one by one, negative where not proved."""
    found = np.array(_alone_at(points, degree, accuracy, 0))
    _again(points, degree, accuracy, found)
    return found


def _again(points: Points, degree: Degree, accuracy: float, found: np.ndarray) -> None:
    """Try what was not proved with more effort, in place."""
    left = ~(found > 0)
    if np.any(left):
        found[left] = _alone_at(picked(points, left), degree, accuracy, 1)


def _by_newton(points: Points, degree: Degree, accuracy: float) -> np.ndarray:
    axes = _map_axes(points)
    if axes is None:
        return _completed(points, degree, _proved_alone(points, degree, accuracy), accuracy)
    devices = np.broadcast_shapes(points.delta.shape, points.d.shape)
    if np.prod(devices) == 1:
        return _completed(points, degree, _on_map(points, degree, accuracy), accuracy)
    found = np.empty(points.shape)
    # One map for every device; the axes that are left are those of delta and d.
    for place in np.ndindex(*devices):
        delta, d = (array[_one(place, array.shape)] for array in (points.delta, points.d))
        where = tuple(slice(None) if axis in axes else slice(i, i + 1) for axis, i in enumerate(place))
        found[where] = _on_map(Points(points.alpha, points.beta, delta, d), degree, accuracy)
    return _completed(points, degree, found, accuracy)


def _one(place: tuple[int, ...], shape: tuple[int, ...]) -> tuple[slice, ...]:
    return tuple(slice(i, i + 1) if length > 1 else slice(None) for i, length in zip(place, shape, strict=True))


def _map_axes(points: Points) -> tuple[int, int] | None:
    """The axes of a map worth cells: alpha varies along one alone, beta along another, the device along neither."""
    alone = []
    for array in (points.alpha, points.beta):
        varying = [axis for axis, length in enumerate(array.shape) if length > 1]
        if len(varying) != 1 or any(other.shape[varying[0]] > 1 for other in points if other is not array):
            return None
        alone.append(varying[0])
    size = points.alpha.size * points.beta.size
    return (alone[0], alone[1]) if size >= _WORTH_CELLS else None


@cache
def _cells(degree: Degree) -> Any:
    """The compiled work on nodes, and on the points of their cells; arrays (cells, points, cells, points)."""
    search = _search(degree)

    def slopes(pole: Array, alpha: Array, beta: Array, fields: Array) -> Array:
        z = Pole(pole.real, pole.imag)
        at = evaluate(z, alpha, beta, Device(*fields), degree)
        by_alpha = over(z * at.n, at.slope)
        by_beta = over(z.shifted(-1.0) * at.n, at.slope)
        return jnp.stack([alpha, beta, z.re, z.im, -by_alpha.re, -by_alpha.im, -by_beta.re, -by_beta.im])

    compiled = jax.jit(slopes)

    def node(alpha: np.ndarray, beta: np.ndarray, fields: Any) -> Any:
        alpha, beta = (np.ascontiguousarray(array) for array in np.broadcast_arrays(alpha, beta))
        effort = _EFFORTS[0]
        high = search.coarse(alpha, beta, effort.halvings(degree), fields)
        return compiled(search.near(effort.steps, alpha, beta, high, fields), alpha, beta, fields)

    def placed(alpha: Array, beta: Array, nodes: Array) -> Pole:
        alpha0, beta0, re, im, re_a, im_a, re_b, im_b = nodes
        da, db = alpha - alpha0, beta - beta0
        return Pole(re + re_a * da + re_b * db, im + im_a * da + im_b * db)

    def cell(alpha: Array, beta: Array, tolerance: Array, nodes: Array, fields: Array) -> Array:
        device = Device(*fields)
        z, step = newton(placed(alpha, beta, nodes), _STEPS_IN_CELL, alpha, beta, device, degree)
        return accept(z, step, tolerance, alpha, beta, device, degree)

    def complex_start(alpha: Array, beta: Array, nodes: Array) -> Array:
        z = placed(alpha, beta, nodes)
        return jax.lax.complex(z.re, z.im)

    first = jax.jit(complex_start)

    def cell_stepwise(alpha: Any, beta: Any, tolerance: Any, nodes: Any, fields: Any) -> Any:
        z = first(alpha, beta, nodes)
        for _ in range(_STEPS_IN_CELL - 1):
            z = search.step(z, alpha, beta, fields)
        return search.last(z, alpha, beta, tolerance, fields)

    return node, jax.jit(cell) if _is_short(degree) else cell_stepwise


def _on_map(points: Points, degree: Degree, accuracy: float) -> np.ndarray:
    """One device; the two varying axes are cut into cells, in bands along the first of them. Not proved: negative."""
    first = next(axis for axis, length in enumerate(points.shape) if length > 1)
    transposed = points.alpha.shape[first] > 1
    outer, inner = (points.alpha, points.beta) if transposed else (points.beta, points.alpha)
    rows, columns = outer.size, inner.size
    across = _cut(inner.reshape(-1), _CELL)
    found = np.empty((rows, columns))
    node, cell = _cells(degree)
    tolerance = np.full((1, 1, 1, 1), accuracy)
    height = _BAND * _CELL
    with concretely():
        fields = compiled_device()(points.delta.reshape(-1), points.d.reshape(-1))[..., None, None, None]
        for top in range(0, rows, height):
            down = _cut(padded(outer.reshape(-1)[top : top + height], height), _CELL)
            pair = (down[:, :, None, None], across[None, None])
            alpha, beta = pair if transposed else pair[::-1]
            middle = (pair[0][:, _CELL // 2, None], pair[1][..., _CELL // 2, None])
            nodes = node(*(middle if transposed else middle[::-1]), fields)
            here = cell(alpha, beta, tolerance, nodes, fields)
            stop = min(top + height, rows)
            found[top:stop] = np.asarray(here).reshape(height, -1)[: stop - top, :columns]
    found = found.reshape(points.shape)
    _again(points, degree, accuracy, found)
    return found


def _cut(values: np.ndarray, length: int) -> np.ndarray:
    """Values in cells of one length; the last value fills up."""
    return padded(values, -(-values.size // length) * length).reshape(-1, length)


def _completed(points: Points, degree: Degree, found: np.ndarray, accuracy: float) -> np.ndarray:
    """Results: what is proved, and by a method without certificate the rest, mostly double poles."""
    proved = found > 0
    out = np.empty((3, *points.shape))
    # With an ellipsis these are views of a single point, of no axes, too.
    np.multiply(np.abs(found, out=out[0, ...]), accuracy, out=out[1, ...])
    out[2] = proved
    left = ~proved
    if np.any(left):
        rest = picked(points, left)
        # A mask serves a single point, of no axes, too.
        out[:, left] = np.stack(by_companion(rest) if degree.poles <= COMPANION_POLES else bisected(rest, accuracy))
    return out
