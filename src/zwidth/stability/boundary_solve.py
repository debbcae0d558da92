"""Exact boundary points by a general solve: P(e^(j omega)) = 0 in real unknowns, by optimistix from a jaxopt bracket.

Of the loop nothing is used but its frequency response and that a column meets its lobe but once on either side of the
ridge, a row but once: an independent judge of the closed forms of `zwidth.stability.curve` (any loop whose stable set
is bounded by one lobe).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix

from zwidth._types import Array, ArrayLike
from zwidth.batching import pointwise
from zwidth.domain import poison, wall_status
from zwidth.loop import FrequencyLoop, Wall, frequency_boundary, frequency_loop
from zwidth.stability.boundary import BoundaryPoint
from zwidth.stability.bracketing import bisect, lobe_end
from zwidth.stability.crossover import stable_kernel
from zwidth.stability.ridge import ridge_kernel
from zwidth.stability.ridge_kkt import frequency_residual
from zwidth.status import Status

# What is asked travels as a number: one compilation serves rows and columns.
_CODES = {"lower": 0.0, "upper": 1.0, "row": 2.0}


def solved_point(names: tuple[str, ...], values: tuple[ArrayLike, ...], line: str, delay_model: str) -> BoundaryPoint:
    """`zwidth.boundary_point` of delta, d and the number of one line, solved anew."""
    return pointwise(_point_kernel, (*names, "line"), (*values, _CODES[line]), (delay_model,))


class _Line(NamedTuple):
    """A row or column of the (alpha, beta) plane, walked in one direction from its origin."""

    alpha: Array
    beta: Array
    dalpha: Array
    dbeta: Array

    def offset(self, wall: Wall) -> Array:
        """Zero where a wall lies on the line, of opposite sign on its two sides."""
        return self.dalpha * (wall.beta - self.beta) - self.dbeta * (wall.alpha - self.alpha)

    def distance(self, wall: Wall) -> Array:
        """How far along the line a wall on it lies, in lengths of the direction."""
        return (wall.alpha - self.alpha) * self.dalpha + (wall.beta - self.beta) * self.dbeta


def _point_kernel(delta: Array, d: Array, number: Array, code: Array, delay_model: str) -> BoundaryPoint:
    is_row, is_upper = (code == _CODES[name] for name in ("row", "upper"))
    inputs = delta, d, number
    given = wall_status(jnp.where(is_row, 0.0, number), jnp.where(is_row, number, 0.0), delta, d)
    ok = given == int(Status.OK)
    delta, d, number = (jnp.where(ok, value, 1.0) for value in inputs)
    zero, one = jnp.zeros_like(number), jnp.ones_like(number)
    axes = (zero, number, one, zero), (number, zero, zero, one)
    line = _Line(*(jnp.where(is_row, row, column) for row, column in zip(*axes, strict=True)))
    loop = frequency_loop(delta, d, delay_model)
    ridge = jax.lax.stop_gradient(ridge_kernel(delta, d, delay_model))
    end = lobe_end(loop, d, delay_model)
    low, high = jnp.where(is_upper, ridge.omega, 0.0), jnp.where(is_upper | is_row, end, ridge.omega)
    start, on_lobe = bisect(
        lambda omega, line, loop: line.offset(frequency_boundary(omega, loop, delay_model)), low, high, line, loop
    )
    omega, distance, converged = _polish(line, start, loop, delay_model)
    ahead = on_lobe & ((distance > 0) | ~is_row)
    real = jnp.where(code == _CODES["lower"], jnp.inf, _real_pole_crossing(line, loop, is_row))
    is_real = real < jnp.where(ahead, distance, jnp.inf)
    omega, distance = jnp.where(is_real, jnp.pi, omega), jnp.where(is_real, real, distance)
    # A stable wall before the point, on the same line.
    begins = 0.5 * distance
    starts = stable_kernel(begins, line.beta, delta, d)
    if delay_model != "held":
        inside = on_lobe & (begins > 0) & (begins < frequency_boundary(start, loop, delay_model).alpha)
        starts = jnp.where(d == 0, starts, inside)
    on_column = (line.alpha > 0) & (line.alpha < ridge.alpha)
    exists = (ahead | is_real) & jnp.where(is_row, starts, on_column)
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


def _real_pole_crossing(line: _Line, loop: FrequencyLoop, forward: Array) -> Array:
    """Where the line meets P(-1) = 0 below one period: infinite if it does not."""
    plant, lag = loop
    usable = (lag == 0) & (plant.gap > 0)
    sum_at_minus_one = 2.0 * (1.0 + plant.c) / jnp.where(usable, plant.gap, 1.0)
    at_minus_one = (sum_at_minus_one - line.alpha - 2.0 * line.beta) / (line.dalpha + 2.0 * line.dbeta)
    return jnp.where(usable & ((at_minus_one > 0) | ~forward), at_minus_one, jnp.inf)


def _polish(line: _Line, start: Array, loop: FrequencyLoop, delay_model: str) -> tuple[Array, Array, Array]:
    """Solve P = 0 for the frequency and the distance along the line; whether that ended where it started."""
    distance = jax.lax.stop_gradient(line.distance(frequency_boundary(start, loop, delay_model)))
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
    wall = frequency_boundary(omega, loop, delay_model)
    missed = jnp.abs(line.offset(wall))
    near = float(jnp.finfo(start.dtype).eps) ** 0.5
    hit = missed <= 0.1 * near * (jnp.abs(wall.alpha) + jnp.abs(wall.beta))
    return omega, distance, hit & (jnp.abs(omega - start) <= 100.0 * near)
