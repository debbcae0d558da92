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
from zwidth.grouping import Degree, degree_of
from zwidth.stability.devices import Device, compiled_device
from zwidth.stability.layout import DeviceWork, Points, assemble, padded, per_device, split_by_degree
from zwidth.stability.poles import companion_chunk, pole_kernel
from zwidth.stability.radius import (
    Accepted,
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
_STEPS_ALONE = 4
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
        half = 0.5 * (high - low)
        radius = low + half
        beyond = sure_error(alpha, beta, high, accuracy, device, degree)
        return jnp.stack([radius, half + beyond, jnp.zeros_like(radius)])

    return DeviceWork(compiled_device(), jax.jit(kernel), np.float64, _LOOP_PIECE, several=3)


@cache
def _companion(degree: Degree) -> DeviceWork:
    def point(alpha: Array, beta: Array, delta: Array, d: Array, *fields: Array) -> Array:
        poles = pole_kernel(alpha, beta, delta, d, degree)
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
        return per_device(_companion(degree), list(part), part.delta, part.d)

    return _collected(points, of)


def by_newton(points: Points, accuracy: float) -> Radii:
    """Newton's method with a certificate, on maps from the nodes of cells, elsewhere from a coarse bisection."""
    return _collected(points, lambda degree, part: _by_newton(part, degree, accuracy))


def _coarse_steps(degree: Degree) -> int:
    """Halvings after which the radius is known to a small part of the distance between poles."""
    return steps_for(0.03 / degree.poles, degree)


class _Stages(NamedTuple):
    """The way to one pole, each stage compiled apart: fused, XLA computes what two of them share over and over."""

    coarse: Callable[..., Any]  # an upper bound of the radius
    first: Callable[..., Any]  # the largest pole, roughly
    steps: Callable[..., Any]  # the pole and the last step
    last: Callable[..., Any]  # radius, and whether it is proved

    def pole(self, alpha: Any, beta: Any, fields: Any) -> tuple[Any, ...]:
        """Real and imaginary part of the pole and of the last step."""
        high = self.coarse(alpha, beta, fields)
        return self.steps(*self.first(alpha, beta, high, fields), alpha, beta, fields)


@cache
def _stages(degree: Degree) -> _Stages:
    def coarse(alpha: Array, beta: Array, fields: Array) -> Array:
        device = Device(*fields)
        low, high = bracket(alpha, beta, device, degree)
        return bisect(alpha, beta, low, high, _coarse_steps(degree), device, degree)[1]

    def first(alpha: Array, beta: Array, high: Array, fields: Array) -> tuple[Array, ...]:
        z = start(alpha, beta, high, Device(*fields), degree)
        return z.re, z.im

    def steps(re: Array, im: Array, alpha: Array, beta: Array, fields: Array) -> tuple[Array, ...]:
        z, step = newton(Pole(re, im), _STEPS_ALONE, alpha, beta, Device(*fields), degree)
        return z.re, z.im, step.re, step.im

    def last(re, im, step_re, step_im, tolerance: Array, alpha: Array, beta: Array, fields: Array) -> Accepted:
        return accept(Pole(re, im), Pole(step_re, step_im), tolerance, alpha, beta, Device(*fields), degree)

    return _Stages(*map(jax.jit, (coarse, first, steps, last)))


@cache
def _alone(degree: Degree) -> DeviceWork:
    """Radius and acceptance of points without neighbors."""
    stages = _stages(degree)

    def kernel(alpha: Any, beta: Any, tolerance: Any, fields: Any) -> np.ndarray:
        found = stages.last(*stages.pole(alpha, beta, fields), tolerance, alpha, beta, fields)
        return np.stack([np.asarray(found.radius), np.asarray(found.ok, np.float64)])

    return DeviceWork(compiled_device(), kernel, np.float64, _LOOP_PIECE, several=2, least=_LEAST)


def certified_columns(
    alpha: np.ndarray, beta: np.ndarray, delta: np.ndarray, d: np.ndarray, accuracy: float
) -> tuple[np.ndarray, np.ndarray]:
    """Radii of equally many values of each, all of one degree, and whether each is proved; the others say nothing."""
    degree = degree_of(d[0])
    tolerance = np.full(alpha.size, accuracy)
    values = per_device(_alone(degree), [alpha, beta, tolerance], delta, d)
    return values[0], values[1] > 0


def _by_newton(points: Points, degree: Degree, accuracy: float) -> np.ndarray:
    axes = _map_axes(points)
    if axes is None:
        return _listed(points, degree, accuracy)
    out = np.empty((3, *points.shape))
    # One map for every device; the axes that are left are those of delta and d.
    for place in np.ndindex(*np.broadcast_shapes(points.delta.shape, points.d.shape)):
        delta, d = (array[_one(place, array.shape)] for array in (points.delta, points.d))
        where = tuple(slice(None) if axis in axes else slice(i, i + 1) for axis, i in enumerate(place))
        out[(slice(None), *where)] = _on_map(Points(points.alpha, points.beta, delta, d), degree, accuracy)
    return out


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
    stages = _stages(degree)

    def slopes(re: Array, im: Array, alpha: Array, beta: Array, fields: Array) -> Array:
        z = Pole(re, im)
        at = evaluate(z, alpha, beta, Device(*fields), degree)
        by_alpha = over(z * at.n, at.slope)
        by_beta = over(z.shifted(-1.0) * at.n, at.slope)
        return jnp.stack([alpha, beta, z.re, z.im, -by_alpha.re, -by_alpha.im, -by_beta.re, -by_beta.im])

    compiled = jax.jit(slopes)

    def node(alpha: np.ndarray, beta: np.ndarray, fields: Any) -> Any:
        alpha, beta = (np.ascontiguousarray(array) for array in np.broadcast_arrays(alpha, beta))
        re, im, _, _ = stages.pole(alpha, beta, fields)
        return compiled(re, im, alpha, beta, fields)

    def cell(alpha: Array, beta: Array, tolerance: Array, nodes: Array, fields: Array) -> tuple[Array, Array]:
        device = Device(*fields)
        alpha0, beta0, re, im, re_a, im_a, re_b, im_b = nodes
        da, db = alpha - alpha0, beta - beta0
        z = Pole(re + re_a * da + re_b * db, im + im_a * da + im_b * db)
        z, step = newton(z, _STEPS_IN_CELL, alpha, beta, device, degree)
        found = accept(z, step, tolerance, alpha, beta, device, degree)
        return found.radius, found.ok

    return node, jax.jit(cell)


def _on_map(points: Points, degree: Degree, accuracy: float) -> np.ndarray:
    """One device; the two varying axes are cut into cells, in bands along the first of them."""
    first = next(axis for axis, length in enumerate(points.shape) if length > 1)
    transposed = points.alpha.shape[first] > 1
    outer, inner = (points.alpha, points.beta) if transposed else (points.beta, points.alpha)
    rows, columns = outer.size, inner.size
    across = _cut(inner.reshape(-1), _CELL)
    radius, ok = np.empty((rows, columns)), np.empty((rows, columns), bool)
    node, cell = _cells(degree)
    tolerance = np.full((1, 1, 1, 1), accuracy)
    height = _BAND * _CELL
    with jax.enable_x64(True):
        fields = compiled_device()(points.delta.reshape(-1), points.d.reshape(-1))[..., None, None, None]
        for top in range(0, rows, height):
            down = _cut(padded(outer.reshape(-1)[top : top + height], height), _CELL)
            pair = (down[:, :, None, None], across[None, None])
            alpha, beta = pair if transposed else pair[::-1]
            middle = (pair[0][:, _CELL // 2, None], pair[1][..., _CELL // 2, None])
            nodes = node(*(middle if transposed else middle[::-1]), fields)
            here, good = cell(alpha, beta, tolerance, nodes, fields)
            stop = min(top + height, rows)
            for whole, part in ((radius, here), (ok, good)):
                whole[top:stop] = np.asarray(part).reshape(height, -1)[: stop - top, :columns]
    radius, ok = radius.reshape(points.shape), ok.reshape(points.shape)
    return _completed(points, radius, ok, accuracy, lambda rest: _listed(rest, degree, accuracy))


def _cut(values: np.ndarray, length: int) -> np.ndarray:
    """Values in cells of one length; the last value fills up."""
    return padded(values, -(-values.size // length) * length).reshape(-1, length)


def _listed(points: Points, degree: Degree, accuracy: float) -> np.ndarray:
    """Points one by one; what is not accepted, mostly double poles, is left to a method without certificate."""
    tolerance = np.broadcast_to(np.float64(accuracy), (1,) * len(points.shape))
    values = per_device(_alone(degree), [points.alpha, points.beta, tolerance], points.delta, points.d)
    last = by_companion if degree.poles <= COMPANION_POLES else lambda rest: bisected(rest, accuracy)
    return _completed(points, values[0], values[1] > 0, accuracy, lambda rest: np.stack(last(rest)))


def _completed(
    points: Points, radius: np.ndarray, ok: np.ndarray, accuracy: float, other: Callable[[Points], np.ndarray]
) -> np.ndarray:
    """Results of accepted points, and of ``other`` for the rest."""
    out = np.empty((3, *points.shape))
    out[0], out[1], out[2] = radius, radius * accuracy, ok
    left = ~ok
    if np.any(left):
        # A mask serves a single point, of no axes, too.
        out[:, left] = other(Points(*(array[left] for array in np.broadcast_arrays(*points))))
    return out
