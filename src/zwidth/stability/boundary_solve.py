"""Exact boundary points by a general solve: P(e^(j omega)) = 0 in real unknowns, by optimistix from a jaxopt bracket.

Of the loop nothing is used but its frequency response, so that this judges the closed forms of
`zwidth.stability.curve` independently, and serves loops that have none.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix

from zwidth._types import Array, ArrayLike
from zwidth.batching import pointwise
from zwidth.domain import WALL_RANGE, wall_status, within
from zwidth.loop import BoundaryCurve, FrequencyLoop, frequency_boundary, frequency_loop, poison
from zwidth.stability.bracketing import bisect
from zwidth.stability.crossover import stable_kernel
from zwidth.stability.curve import lobe_end
from zwidth.stability.ridge import ridge_kernel
from zwidth.stability.ridge_kkt import frequency_residual
from zwidth.status import Status

# Cells into which the lobe is cut to bracket its crossings with a line.
_CELLS = 256
# What to look for on a line: its lowest crossing, the next one above that, or the first one ahead of its origin.
_LOWEST, _ABOVE_LOWEST, _AHEAD = 0.0, 1.0, 2.0


def solved_point(names: tuple[str, ...], values: tuple[ArrayLike, ...], line: str, delay: str) -> "SolvedPoint":
    """`zwidth.boundary_point` of (delta, d) and the numbers of one line, solved anew."""
    return pointwise(_KERNELS[line], ("delta", "d", *names), values, (delay,), fused=False)


class SolvedPoint(NamedTuple):
    """A wall on the edge of stability, or an array of them."""

    alpha: Array
    beta: Array
    omega: Array
    status: Array


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


def _point_kernel(
    delta: Array, d: Array, alpha0: Array, beta0: Array, dalpha: Array, dbeta: Array, search: Array, delay: str
) -> BoundaryPoint:
    inputs = (delta, d, alpha0, beta0, dalpha, dbeta)
    ok = valid_device(delta, d) & jnp.isfinite(sum(inputs)) & ((dalpha != 0) | (dbeta != 0))
    delta, d, *direction = (jnp.where(ok, value, 1.0) for value in inputs)
    line = _Line(*direction)
    loop = frequency_loop(delta, d, delay)
    omegas = _lobe_frequencies(delta, d, loop, delay)
    on_curve = _curve_crossings(line, omegas, loop, delay)
    real = _real_pole_crossings(line, loop)
    index, exists = _choose(on_curve, real, search)
    # For alpha <= 0 a real pole is at 1 or beyond, whatever beta.
    exists = exists & ((line.dalpha != 0) | (line.alpha > 0))
    cell = jnp.minimum(index, _CELLS - 1)
    omega, distance, converged = _polish(line, omegas[cell], omegas[cell + 1], loop, delay)
    is_real = index >= _CELLS
    omega = jnp.where(is_real, jnp.where(index == _CELLS, 0.0, jnp.pi), omega)
    distance = jnp.where(is_real, real[jnp.clip(index - _CELLS, 0, 1)], distance)
    solved = is_real | converged
    found = ok & exists & solved
    status = jnp.where(exists, jnp.where(solved, Status.OK, Status.NOT_CONVERGED), Status.NO_BOUNDARY)
    status = jnp.where(ok, status, Status.INVALID_INPUT)
    spoiled = poison(found, *inputs)
    return BoundaryPoint(
        line.alpha + distance * line.dalpha + spoiled,
        line.beta + distance * line.dbeta + spoiled,
        omega + spoiled,
        status.astype(jnp.int32),
    )


def _lobe_frequencies(delta: Array, d: Array, loop: FrequencyLoop, delay: str) -> Array:
    """Cell edges along the lobe; the ridge is one of them, so that a column meets at most one edge a cell."""
    top = jax.lax.stop_gradient(ridge_kernel(delta, d, delay).omega)
    end = lobe_end(loop, d, delay)
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


def _real_pole_crossings(line: _Line, loop: FrequencyLoop) -> Array:
    """The distances at which the line meets alpha = 0 (a pole at z = 1) and P(-1) = 0."""
    at_one = -line.alpha / jnp.where(line.dalpha == 0, 1.0, line.dalpha)
    plant, lag = loop
    whole = lag == jnp.floor(lag)
    sign = 1.0 - 2.0 * jnp.mod(lag, 2.0)
    usable = whole & (plant.gap != 0)
    sum_at_minus_one = sign * 2.0 * (1.0 + plant.c) / jnp.where(usable, plant.gap, 1.0)
    rate = line.dalpha + 2.0 * line.dbeta
    at_minus_one = (sum_at_minus_one - line.alpha - 2.0 * line.beta) / jnp.where(rate == 0, 1.0, rate)
    exists = jnp.stack([line.dalpha != 0, usable & (rate != 0)])
    return jnp.where(exists, jnp.stack([at_one, at_minus_one]), jnp.inf)


def _choose(on_curve: Array, real: Array, search: Array) -> tuple[Array, Array]:
    """Which crossing bounds the stable part of the line: a cell, then z = 1, then z = -1; and whether there is one."""
    lowest = jnp.argmin(on_curve)
    candidates = jnp.concatenate([on_curve, real])
    # A column is left upwards, beyond its lower end; a ray is left at the first crossing ahead.
    start = jnp.where(search == _ABOVE_LOWEST, on_curve[lowest], 0.0)
    ahead = jnp.where(candidates > start, candidates, jnp.inf)
    index = jnp.where(search == _LOWEST, lowest, jnp.argmin(ahead))
    chosen = jnp.where(search == _LOWEST, on_curve[lowest], ahead[index])
    return index, jnp.isfinite(chosen)


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
    # Of a wall softer than about 1e-30 the frequency is below what a bracket resolves.
    wall = frequency_boundary(omega, loop, delay)
    missed = jnp.abs(line.offset(wall)) / jnp.hypot(line.dalpha, line.dbeta)
    hit = missed <= 1e-9 * (jnp.abs(wall.alpha) + jnp.abs(wall.beta))
    return omega, distance, bracketed & hit & (jnp.abs(omega - start) <= 1e-6)
