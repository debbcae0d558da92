"""Exact boundary points by a general solve: P(e^(j omega)) = 0 in real unknowns, by optimistix from a jaxopt bracket.

Of the loop nothing is used but its frequency response, so that this judges the closed forms of
`zwidth.stability.curve` independently, and serves loops that have none.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix

from zwidth._types import Array, ArrayLike
from zwidth.batching import pointwise
from zwidth.loop import BoundaryCurve, FrequencyLoop, frequency_boundary, frequency_loop, poison
from zwidth.stability.boundary import BoundaryPoint, line_status
from zwidth.stability.bracketing import bisect
from zwidth.stability.crossover import stable_kernel
from zwidth.stability.curve import lobe_end
from zwidth.stability.ridge import ridge_kernel
from zwidth.stability.ridge_kkt import frequency_residual
from zwidth.status import Status

# Cells into which the lobe is cut to bracket its crossings with a line.
_CELLS = 256
# What is asked travels as a number: one compilation serves rows, columns and rays.
_CODES = {"lower": 0.0, "upper": 1.0, "row": 2.0, "ray": 3.0}


def solved_point(names: tuple[str, ...], values: tuple[ArrayLike, ...], line: str, delay: str) -> BoundaryPoint:
    """`zwidth.boundary_point` of (delta, d) and the numbers of one line, solved anew."""
    delta, d, *numbers = values
    if line == "row":
        numbers, names = [0.0, numbers[0], 1.0, 0.0], ("alpha0", "beta", "dalpha", "dbeta")
    elif line != "ray":
        numbers, names = [numbers[0], 0.0, 0.0, 1.0], ("alpha", "beta0", "dalpha", "dbeta")
    everything = (delta, d, *numbers, _CODES[line])
    return pointwise(_point_kernel, ("delta", "d", *names, "line"), everything, (delay,), fused=False)


class _Line(NamedTuple):
    """A line in the (alpha, beta) plane, walked in one direction from its origin."""

    alpha: Array
    beta: Array
    dalpha: Array
    dbeta: Array

    def offset(self, wall: BoundaryCurve) -> Array:
        """Zero where a wall lies on the line, of opposite sign on its two sides."""
        return self.dalpha * (wall.beta - self.beta) - self.dbeta * (wall.alpha - self.alpha)

    def distance(self, wall: BoundaryCurve) -> Array:
        """How far along the line a wall on it lies, in lengths of the direction."""
        along = (wall.alpha - self.alpha) * self.dalpha + (wall.beta - self.beta) * self.dbeta
        return along / (self.dalpha**2 + self.dbeta**2)


class _Inputs(NamedTuple):
    """A device and a line."""

    delta: Array
    d: Array
    alpha0: Array
    beta0: Array
    dalpha: Array
    dbeta: Array


def _point_kernel(*arguments: Any) -> BoundaryPoint:
    *numbers, code, delay = arguments
    inputs = _Inputs(*numbers)
    given = line_status(*inputs)
    ok = given == int(Status.OK)
    safe = _Inputs(*(jnp.where(ok, value, 1.0) for value in inputs))
    delta, d, *direction = safe
    line = _Line(*direction)
    loop = frequency_loop(delta, d, delay)
    ridge = jax.lax.stop_gradient(ridge_kernel(delta, d, delay))
    omegas = _lobe_frequencies(ridge.omega, lobe_end(loop, d, delay))
    on_curve = _curve_crossings(line, omegas, loop, delay)
    real = _real_pole_crossings(line, loop, code)
    index, exists = _choose(on_curve, real, code)
    cell = jnp.minimum(index, _CELLS - 1)
    omega, distance, converged = _polish(line, omegas[cell], omegas[cell + 1], loop, delay)
    is_real = index >= _CELLS
    omega = jnp.where(is_real, jnp.where(index == _CELLS, 0.0, jnp.pi), omega)
    distance = jnp.where(is_real, real[jnp.clip(index - _CELLS, 0, 1)], distance)
    # A stable wall before the point, on the same line.
    is_row, is_ray = code == _CODES["row"], code == _CODES["ray"]
    begins = line.alpha + jnp.where(is_row, 0.5 * distance, 0.0) * line.dalpha
    starts = stable_kernel(begins, line.beta, delta, d)
    if delay != "held":
        row = _curve_crossings(_Line(begins, line.beta, jnp.ones_like(d), jnp.zeros_like(d)), omegas, loop, delay)
        on_row = (begins > 0) & jnp.any((row > 0) & jnp.isfinite(row))
        starts = jnp.where(d == 0, starts, on_row)
    on_column = (line.alpha > 0) & (line.alpha < ridge.alpha)
    exists = exists & jnp.where(is_row | is_ray, starts, on_column)
    solved = is_real | converged
    status = jnp.where(exists, jnp.where(solved, int(Status.OK), int(Status.NOT_CONVERGED)), int(Status.NO_BOUNDARY))
    status = jnp.where(ok, status, given)
    spoiled = poison(status == int(Status.OK), *inputs)
    return BoundaryPoint(
        line.alpha + distance * line.dalpha + spoiled,
        line.beta + distance * line.dbeta + spoiled,
        omega + spoiled,
        status.astype(jnp.int32),
    )


def _lobe_frequencies(top: Array, end: Array) -> Array:
    """Cell edges along the lobe; the ridge is one of them, so that a column meets at most one edge a cell."""
    part = jnp.linspace(0.0, 1.0, _CELLS // 2 + 1)
    return jnp.concatenate([top * part, top + (end - top) * part[1:]])


def _curve_crossings(line: _Line, omegas: Array, loop: FrequencyLoop, delay: str) -> Array:
    """The distance along the line at which each cell of the lobe crosses it, infinite where it does not."""
    walls = jax.vmap(lambda omega: frequency_boundary(omega, loop, delay))(jax.lax.stop_gradient(omegas))
    offset, distance = line.offset(walls), line.distance(walls)
    before, after = offset[:-1], offset[1:]
    crosses = ((before < 0) & (after >= 0)) | ((before > 0) & (after <= 0))
    share = before / jnp.where(crosses, before - after, 1.0)
    return jnp.where(crosses, distance[:-1] + share * (distance[1:] - distance[:-1]), jnp.inf)


def _real_pole_crossings(line: _Line, loop: FrequencyLoop, code: Array) -> Array:
    """The distances at which the line meets alpha = 0 (a pole at z = 1) and, below one period, P(-1) = 0."""
    at_one = -line.alpha / jnp.where(line.dalpha == 0, 1.0, line.dalpha)
    plant, lag = loop
    usable = (lag == 0) & (plant.gap > 0)
    sum_at_minus_one = 2.0 * (1.0 + plant.c) / jnp.where(usable, plant.gap, 1.0)
    rate = line.dalpha + 2.0 * line.dbeta
    at_minus_one = (sum_at_minus_one - line.alpha - 2.0 * line.beta) / jnp.where(rate == 0, 1.0, rate)
    exists = jnp.stack([(line.dalpha != 0) & (code == _CODES["ray"]), usable & (rate != 0)])
    return jnp.where(exists, jnp.stack([at_one, at_minus_one]), jnp.inf)


def _choose(on_curve: Array, real: Array, code: Array) -> tuple[Array, Array]:
    """Which crossing bounds the stable part of the line: a cell, then z = 1, then z = -1; and whether there is one."""
    lowest = jnp.argmin(on_curve)
    candidates = jnp.concatenate([on_curve, real])
    # A column is left upwards, beyond its lower end; a row or a ray is left at the first crossing ahead.
    start = jnp.where(code == _CODES["upper"], on_curve[lowest], 0.0)
    ahead = jnp.where(candidates > start, candidates, jnp.inf)
    is_lower = code == _CODES["lower"]
    index = jnp.where(is_lower, lowest, jnp.argmin(ahead))
    return index, jnp.isfinite(jnp.where(is_lower, on_curve[lowest], ahead[index]))


def _polish(line: _Line, lower: Array, upper: Array, loop: FrequencyLoop, delay: str) -> tuple[Array, Array, Array]:
    """Solve P = 0 for the frequency and the distance along the line, from a bracket of the frequency."""
    start, bracketed = bisect(
        lambda omega, line, loop: line.offset(frequency_boundary(omega, loop, delay)), lower, upper, line, loop
    )
    distance = jax.lax.stop_gradient(line.distance(frequency_boundary(start, loop, delay)))
    scale = jnp.where(distance == 0, 1.0, jnp.abs(distance))

    def residual(unknowns: Array, args: tuple[_Line, FrequencyLoop]) -> Array:
        line, loop = args
        s = unknowns[0] * scale
        return frequency_residual(unknowns[1], line.alpha + s * line.dalpha, line.beta + s * line.dbeta, loop)

    tolerance = float(16 * jnp.finfo(start.dtype).eps)
    solution = optimistix.root_find(
        residual,
        optimistix.Newton(rtol=tolerance, atol=tolerance),
        jnp.stack([distance / scale, start]),
        args=(line, loop),
        max_steps=8,
        throw=False,
    )
    omega, distance = solution.value[1], solution.value[0] * scale
    # Of a very soft wall the frequency is below what a bracket resolves.
    wall = frequency_boundary(omega, loop, delay)
    missed = jnp.abs(line.offset(wall)) / jnp.hypot(line.dalpha, line.dbeta)
    near = float(jnp.finfo(start.dtype).eps) ** 0.5
    hit = missed <= 0.1 * near * (jnp.abs(wall.alpha) + jnp.abs(wall.beta))
    return omega, distance, bracketed & hit & (jnp.abs(omega - start) <= 100.0 * near)
