"""Time response of the device in contact with the wall, exact at the samples and between them.

Between two instants at which a force changes, the damped mass has the exact solution

    x(t) = x + t phi1(delta t) v + t^2 phi2(delta t) F        v(t) = e^(-delta t) v + t phi1(delta t) F

(T = 1, m = 1). In each period the wall's force changes once, at the fraction f of a delay d = n + f.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth import phi
from zwidth._types import Array
from zwidth.batching import as_float64, concretely
from zwidth.errors import InputError
from zwidth.grouping import degree_of
from zwidth.scene import Scene

# The band round the final value that counts as settled, as in control textbooks.
SETTLING_BAND = 0.02


class StepResponse(NamedTuple):
    """The response to a constant force that sets in at time 0; arrays of one time axis."""

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    wall_force: np.ndarray
    final_position: float
    settling_time: float


def _advance(x: Array, v: Array, force: Array, t: Array, delta: Array) -> tuple[Array, Array]:
    """The exact state after time t under a constant force."""
    p1, p2 = phi.phi1(delta * t), phi.phi2(delta * t)
    return x + t * p1 * v + t * t * p2 * force, phi.decay(delta * t) * v + t * p1 * force


def _simulate(wall: Array, fractions: Array, f: Array, lag: int, periods: int) -> tuple[Array, Array, Array]:
    """Run the loop; rows are periods, columns the instants ``fractions`` of each, from 0 on."""
    alpha, beta, delta, applied = wall

    def period(state, _):
        x, v, previous, queue = state
        # The force of this sample enters the queue; what leaves it is lag + 1 samples old, then lag samples old.
        computed = -(alpha * x + beta * (x - previous))
        queue = jnp.concatenate([queue[1:], computed[None]])
        older, newer = queue[0], queue[1]
        x_bend, v_bend = _advance(x, v, applied + older, f, delta)
        before = fractions < f
        span = jnp.where(before, fractions, fractions - f)
        force = jnp.where(before, older, newer)
        xs, vs = _advance(jnp.where(before, x, x_bend), jnp.where(before, v, v_bend), applied + force, span, delta)
        x_next, v_next = _advance(x_bend, v_bend, applied + newer, 1.0 - f, delta)
        return (x_next, v_next, x, queue), (xs, vs, force)

    zero = jnp.zeros_like(alpha)
    start = (zero, zero, zero, jnp.zeros(lag + 2, dtype=alpha.dtype))
    _, history = jax.lax.scan(period, start, length=periods)
    return history


def step_response(
    alpha: float,
    beta: float,
    delta: float,
    d: float,
    *,
    periods: int = 100,
    substeps: int = 10,
    force: float = 1.0,
) -> StepResponse:
    """Return the response, from force to position, of the device that rests in contact with the wall.

    The force pushes on the mass itself from time 0 on; the wall answers with
    ``-(alpha x_k + beta (x_k - x_(k-1)))``, computed at sample k and acting from k + d to k + d + 1 (held).

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not. All four single numbers.
        periods: how many sampling periods to simulate, >= 1.
        substeps: instants in each period, >= 1; 1 gives the samples alone.
        force: the constant force in units of m/T^2 times a length unit.

    Returns:
        StepResponse: ``time`` in periods; ``position``; ``velocity`` in position a period; ``wall_force``, what the
        wall applies then; all (periods * substeps,). ``final_position`` is force/alpha, NaN for alpha = 0.
        ``settling_time`` is the last instant outside 2 % of it, NaN where the response does not settle in time.

    Raises:
        InputError: an argument is no single finite number, or out of range.

    Numerics:
        Exact between force changes up to rounding; float64. An unstable response that outgrows it ends as inf or NaN.

    References:
        Hulin, Preusche, Hirzinger 2006, section VIII, Fig. 11, eqs. (2), (6).

    Example:
        >>> import zwidth
        >>> response = zwidth.step_response(0.108, 0.425, 0.0, 1)
        >>> print(f"{response.position[-1] * 0.108:.2f}")
        1.00
    """
    arguments = {"alpha": alpha, "beta": beta, "delta": delta, "d": d, "force": force}
    numbers = {name: as_float64(name, value) for name, value in arguments.items()}
    for name, number in numbers.items():
        if number.ndim or not np.isfinite(number):
            raise InputError(f"{name}: got {arguments[name]!r}; a single finite number is needed")
        if name in ("delta", "d") and number < 0:
            raise InputError(f"{name}: got {arguments[name]!r}; it must be at least 0")
    for name, count in {"periods": periods, "substeps": substeps}.items():
        if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
            raise InputError(f"{name}: got {count!r}; a whole number of at least 1 is needed")
    alpha, beta, delta, d, force = (float(number) for number in numbers.values())
    lag = degree_of(d).whole
    fractions = np.arange(substeps) / substeps
    with concretely():
        history = _simulate_jit(np.array([alpha, beta, delta, force]), fractions, d - lag, lag, int(periods))
    position, velocity, wall_force = (np.asarray(part).ravel() for part in history)
    time = (np.arange(periods)[:, None] + fractions).ravel()
    final = force / alpha if alpha != 0 else np.nan
    return StepResponse(time, position, velocity, wall_force, final, settling_time(time, position, final))


_simulate_jit = jax.jit(_simulate, static_argnums=(3, 4))


def settling_time(time: np.ndarray, position: np.ndarray, final: float, band: float = SETTLING_BAND) -> float:
    """The last instant outside the band round the final value; NaN where the last one of all is outside."""
    outside = ~(np.abs(position - final) <= band * abs(final))
    if not np.isfinite(final) or outside[-1]:
        return float("nan")
    last = np.flatnonzero(outside)
    return float(time[last[-1]]) if last.size else 0.0


def scene_step_response(scene: Scene, *, duration: float, substeps: int = 10, force: float = 1.0) -> StepResponse:
    """`step_response` of a scene in SI units: seconds, meters, meters a second, newtons."""
    period, mass = scene.timing.period, scene.device.mass
    alpha, beta, delta, d = scene.normalized
    length = period * period / mass
    raw = step_response(alpha, beta, delta, d, periods=max(1, round(duration / period)), substeps=substeps, force=force)
    return StepResponse(
        raw.time * period,
        raw.position * length,
        raw.velocity * length / period,
        raw.wall_force,
        raw.final_position * length,
        raw.settling_time * period,
    )
