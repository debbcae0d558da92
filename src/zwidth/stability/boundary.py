"""The stability boundary: its closed form, and exact points on a given line."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix

from zwidth._types import Array, ArrayLike, DelayModel
from zwidth.batching import is_traced, pointwise, to_caller
from zwidth.errors import InputError, check_choice
from zwidth.loop import (
    BoundaryCurve,
    FrequencyLoop,
    check_delay_model,
    frequency_boundary,
    frequency_loop,
    poison,
    valid_device,
)
from zwidth.stability.bracketing import bisect
from zwidth.stability.curve import lobe_end
from zwidth.stability.poles import radius_by_companion
from zwidth.stability.ridge import ridge_kernel
from zwidth.stability.ridge_kkt import frequency_residual
from zwidth.status import Status

# Cells into which the lobe is cut to bracket its crossings with a line.
_CELLS = 256
# Poles are looked at this far (relative) before and behind a boundary point, until they tell the sides apart. A small
# step does not leave the tip of a corner on its far side; a large one still moves the poles of a very soft wall.
_SIDE_STEPS = (1e-8, 1e-5, 1e-11, 1e-14)
# Below this distance from the unit circle the magnitude of a pole, double ones included, may be rounding.
_ROUNDING = 1e-10
# What to look for on a line: its lowest crossing, the next one above that, or the first one ahead of its origin.
_LOWEST, _ABOVE_LOWEST, _AHEAD = 0.0, 1.0, 2.0


def boundary(omega: ArrayLike, delta: ArrayLike, d: ArrayLike, *, delay: DelayModel = "held") -> BoundaryCurve:
    """Return the wall that puts a pole pair of the loop at ``e^(+-j omega)``, in closed form.

    With ``q = -z^n (z - 1)(z - c)/(n0(z) + n1(z)/z)`` on ``z = e^(j omega)``: ``beta = Im q / sin omega``,
    ``alpha = Re q - tan(omega/2) Im q``. The curve starts at (0, -delta), eq. (19). It lists candidates: which of its
    pieces bound the stable set is decided by counting poles, see `zwidth.stable_region`.

    Args:
        omega: frequency in radians a period, 0 <= omega <= pi.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not. All three broadcast.
        delay: "held" (exact) or "fractional_power" (the paper's z^(1+d), principal branch).

    Returns:
        BoundaryCurve with ``alpha`` and ``beta`` of the broadcast shape; NaN out of range. At omega -> 0 and -> pi the
        values are the limits; for delta = 0, or a fractional power, the curve runs to infinity at pi.

    Raises:
        InputError: an argument is no real number, shapes do not broadcast, or ``delay`` is unknown.

    Numerics:
        A few units in the last place, at a cost that does not grow with d. Traceable, also in d (derivatives at whole
        d are those from the right). Float64 when called directly; the ambient precision inside `jit`.

    References:
        Hulin, Preusche, Hirzinger 2006, section V; D-decomposition.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.boundary(0.0, 0.25, 2).beta:.2f}")
        -0.25
    """
    check_delay_model(delay)
    return pointwise(_boundary_kernel, ("omega", "delta", "d"), (omega, delta, d), (delay,))


def _boundary_kernel(omega: Array, delta: Array, d: Array, delay: str) -> BoundaryCurve:
    ok = valid_device(delta, d) & (omega >= 0) & (omega <= np.pi)
    spoiled = poison(ok, omega, delta, d)
    omega, delta, d = (jnp.where(ok, value, 1.0) for value in (omega, delta, d))
    curve = frequency_boundary(omega, frequency_loop(delta, d, delay), delay)
    return BoundaryCurve(curve.alpha + spoiled, curve.beta + spoiled)


class BoundaryPoint(NamedTuple):
    """A wall on the edge of stability, or an array of them."""

    alpha: Array
    beta: Array
    omega: Array
    status: Array


def boundary_point(
    delta: ArrayLike,
    d: ArrayLike,
    *,
    beta: ArrayLike | None = None,
    alpha: ArrayLike | None = None,
    side: str = "lower",
    ray: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike] | None = None,
    delay: DelayModel = "held",
) -> BoundaryPoint:
    """Find the exact boundary point on a line, by an optimistix solve of ``P(e^(j omega)) = 0`` in real unknowns.

    Exactly one of ``beta``, ``alpha`` and ``ray`` is given: the stiffest stable wall of that damping; the smallest
    (``side="lower"``) or largest (``"upper"``) stable damping of that stiffness; or the first boundary point on the
    ray ``(alpha0, beta0) + s (dalpha, dbeta)``, s > 0, from a stable wall (alpha0, beta0).

    Args:
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0.
        beta: normalized virtual damping of a row.
        alpha: normalized stiffness of a column, > 0.
        side: which end of the column.
        ray: (alpha0, beta0, dalpha, dbeta). Everything broadcasts.
        delay: "held" or "fractional_power".

    Returns:
        BoundaryPoint: ``alpha``, ``beta``; ``omega`` of the pole on the circle (0 and pi: the real ones);
        ``status``, NO_BOUNDARY with NaN where the line has no stable part, NOT_CONVERGED with NaN where the wall is
        too soft (alpha below about 1e-30) for its frequency to be found.

    Raises:
        InputError: not exactly one line is given, an argument is no real number, or a name is unknown.

    Numerics:
        Agrees with the closed form to 1e-12. Called directly with a held delay, a point is refused where the poles a
        little before and behind it contradict that the line leaves the stable set there. Traced calls rely on the
        single-lobe shape of the stable set instead. Traceable, also in d.

    References:
        Hulin, Preusche, Hirzinger 2006, section V.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.boundary_point(0.0, 0, beta=0.5).alpha:.4f}")
        0.6000
    """
    check_delay_model(delay)
    check_choice("side", side, ("lower", "upper"))
    given = [name for name, value in (("beta", beta), ("alpha", alpha), ("ray", ray)) if value is not None]
    if len(given) != 1:
        raise InputError(f"beta, alpha, ray: got {' and '.join(given) or 'none'}; give exactly one of the three")
    if beta is not None:
        values, search = (0.0, beta, 1.0, 0.0), _AHEAD
    elif alpha is not None:
        values, search = (alpha, 0.0, 0.0, 1.0), _LOWEST if side == "lower" else _ABOVE_LOWEST
    else:
        if not isinstance(ray, tuple | list) or len(ray) != 4:
            raise InputError(f"ray: got {ray!r}; give the four numbers (alpha0, beta0, dalpha, dbeta)")
        values, search = tuple(ray), _AHEAD
    names = ("delta", "d", "alpha0", "beta0", "dalpha", "dbeta", "search")
    everything = (delta, d, *values)
    # What to search for travels as a number: one compilation serves rows, columns and rays.
    point = pointwise(_point_kernel, names, (*everything, search), (delay,), fused=False)
    if is_traced(*everything) or delay != "held":
        return point
    return _counted(point, everything, search)


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


def _counted(point: BoundaryPoint, everything: tuple[ArrayLike, ...], search: float) -> BoundaryPoint:
    """Keep a point unless the poles beside it say that the inner side is unstable or the outer one stable."""
    numbers = [np.asarray(value, dtype=np.float64) for value in everything]
    status = np.asarray(point.status)
    delta, d, _, _, dalpha, dbeta = (np.broadcast_to(number, status.shape).ravel() for number in numbers)
    alpha, beta = np.asarray(point.alpha).ravel(), np.asarray(point.beta).ravel()
    outward = -1.0 if search == _LOWEST else 1.0
    found = status.ravel() == Status.OK
    confirmed, possible, refuted = (np.zeros(found.shape, dtype=bool) for _ in range(3))
    for share in _SIDE_STEPS:
        if not (found & ~confirmed & ~refuted).any():
            break
        step = outward * share * np.hypot(alpha, beta) / np.hypot(dalpha, dbeta)
        inner, outer = (
            np.asarray(radius_by_companion(alpha + away * dalpha, beta + away * dbeta, delta, d)) - 1.0
            for away in (-step, step)
        )
        confirmed |= (inner < -_ROUNDING) & (outer > _ROUNDING)
        refuted |= (outer < -_ROUNDING) & ~confirmed
        possible |= inner <= _ROUNDING
    kept = (found & ~refuted & (confirmed | possible)).reshape(status.shape)
    status = np.where((status == Status.OK) & ~kept, Status.NO_BOUNDARY, status)
    alpha, beta, omega = (np.where(kept, np.asarray(value), np.nan) for value in (point.alpha, point.beta, point.omega))
    return to_caller(BoundaryPoint(alpha, beta, omega, status.astype(np.int32)), everything)
