"""Exact boundary points by a general solve: P(e^(j omega)) = 0 in real unknowns, by optimistix from a jaxopt bracket.

Of the loop nothing is used but its frequency response and that a line meets its lobe but once on either side of the
ridge, or of the row of its origin: an independent judge of the closed forms of `loops.rigid.curve` (any loop whose
stable set is bounded by one lobe).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix

from zwidth.arrays.batching import pointwise
from zwidth.loops.domain import poison
from zwidth.loops.rigid.boundary import BoundaryPoint, line_status
from zwidth.loops.rigid.bracketing import bisect, lobe_end
from zwidth.loops.rigid.crossover import stable_kernel
from zwidth.loops.rigid.polynomial import FrequencyLoop, Wall, frequency_boundary, frequency_loop
from zwidth.loops.rigid.ridge import ridge_kernel
from zwidth.loops.rigid.ridge_kkt import frequency_residual
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike

# What is asked travels as a number: one compilation serves rows, columns and rays.
_CODES = {"lower": 0.0, "upper": 1.0, "row": 2.0, "ray": 3.0}


def solved_point(names: tuple[str, ...], values: tuple[ArrayLike, ...], line: str, delay_model: str) -> BoundaryPoint:
    """`zwidth.boundary_point` of (delta, d) and the numbers of one line, solved anew."""
    delta, d, *numbers = values
    if line == "row":
        numbers, names = [0.0, numbers[0], 1.0, 0.0], ("alpha0", "beta", "dalpha", "dbeta")
    elif line != "ray":
        numbers, names = [numbers[0], 0.0, 0.0, 1.0], ("alpha", "beta0", "dalpha", "dbeta")
    everything = (delta, d, *numbers, _CODES[line])
    return pointwise(_point_kernel, ("delta", "d", *names, "line"), everything, (delay_model,))


class _Line(NamedTuple):
    """A line in the (alpha, beta) plane, walked in one direction from its origin."""

    alpha: Array
    beta: Array
    dalpha: Array
    dbeta: Array

    def offset(self, wall: Wall) -> Array:
        """Zero where a wall lies on the line, of opposite sign on its two sides."""
        return self.dalpha * (wall.beta - self.beta) - self.dbeta * (wall.alpha - self.alpha)

    def distance(self, wall: Wall) -> Array:
        """How far along the line a wall on it lies, in lengths of the direction."""
        along = (wall.alpha - self.alpha) * self.dalpha + (wall.beta - self.beta) * self.dbeta
        return along / (self.dalpha**2 + self.dbeta**2)


def _point_kernel(*arguments: Any) -> BoundaryPoint:
    *inputs, code, delay_model = arguments
    given = line_status(*inputs)
    ok = given == int(Status.OK)
    delta, d, *direction = (jnp.where(ok, value, 1.0) for value in inputs)
    line, loop = _Line(*direction), frequency_loop(delta, d, delay_model)
    is_row, is_ray, is_upper = (code == _CODES[name] for name in ("row", "ray", "upper"))
    ridge = jax.lax.stop_gradient(ridge_kernel(delta, d, delay_model))
    end = lobe_end(loop, d, delay_model)
    # A ray upwards leaves behind the end of its origin's row, one downwards before it.
    row = _Line(line.alpha, line.beta, jnp.ones_like(d), jnp.zeros_like(d))
    row_omega, on_row = _crossing(row, jnp.zeros_like(end), end, loop, delay_model)
    row_omega = jnp.where(on_row, row_omega, end)
    split = jnp.where(is_ray, row_omega, ridge.omega)
    beyond = is_upper | (is_ray & (line.dbeta >= 0))
    low, high = jnp.where(beyond, split, 0.0), jnp.where(beyond | is_row, end, split)
    start, on_lobe = _crossing(line, low, high, loop, delay_model)
    omega, distance, converged = _polish(line, start, loop, delay_model)
    ahead = on_lobe & ((distance > 0) | ~(is_row | is_ray))
    at_one, at_minus_one = _real_pole_crossings(line, loop, is_ray, is_row | is_ray)
    real = jnp.where(code == _CODES["lower"], jnp.inf, jnp.minimum(at_one, at_minus_one))
    is_real = real < jnp.where(ahead, distance, jnp.inf)
    omega = jnp.where(is_real, jnp.where(at_one < at_minus_one, 0.0, jnp.pi), omega)
    distance = jnp.where(is_real, real, distance)
    # A stable wall before the point, on the same line.
    begins = line.alpha + jnp.where(is_row, 0.5 * distance, 0.0) * line.dalpha
    starts = stable_kernel(begins, line.beta, delta, d)
    if delay_model != "held":
        inside = on_row & (begins > 0) & (begins < frequency_boundary(row_omega, loop, delay_model).alpha)
        starts = jnp.where(d == 0, starts, inside)
    on_column = (line.alpha > 0) & (line.alpha < ridge.alpha)
    exists = (ahead | is_real) & jnp.where(is_row | is_ray, starts, on_column)
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


def _crossing(line: _Line, low: Array, high: Array, loop: FrequencyLoop, delay_model: str) -> tuple[Array, Array]:
    """Where the lobe crosses a line between two frequencies, and whether it does."""
    return bisect(
        lambda omega, line, loop: line.offset(frequency_boundary(omega, loop, delay_model)), low, high, line, loop
    )


def _real_pole_crossings(line: _Line, loop: FrequencyLoop, is_ray: Array, forward: Array) -> tuple[Array, Array]:
    """Where the line meets alpha = 0 (a pole at z = 1) and, below one period, P(-1) = 0: infinite if it does not."""
    at_one = -line.alpha / jnp.where(line.dalpha == 0, 1.0, line.dalpha)
    plant, lag = loop
    usable = (lag == 0) & (plant.gap > 0)
    sum_at_minus_one = 2.0 * (1.0 + plant.c) / jnp.where(usable, plant.gap, 1.0)
    rate = line.dalpha + 2.0 * line.dbeta
    at_minus_one = (sum_at_minus_one - line.alpha - 2.0 * line.beta) / jnp.where(rate == 0, 1.0, rate)
    return (
        jnp.where(is_ray & (line.dalpha != 0) & (at_one > 0), at_one, jnp.inf),
        jnp.where(usable & (rate != 0) & ((at_minus_one > 0) | ~forward), at_minus_one, jnp.inf),
    )


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
    missed = jnp.abs(line.offset(wall)) / jnp.hypot(line.dalpha, line.dbeta)
    near = float(jnp.finfo(start.dtype).eps) ** 0.5
    hit = missed <= 0.1 * near * (jnp.abs(wall.alpha) + jnp.abs(wall.beta))
    return omega, distance, hit & (jnp.abs(omega - start) <= 100.0 * near)
