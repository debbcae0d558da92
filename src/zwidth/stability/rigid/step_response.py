"""Compute the step response of a rigid device in contact with the wall, exactly at and between the samples.

Between two instants at which a force changes, the damped mass has the exact solution

    x(t) = x + t phi1(delta t) v + t^2 phi2(delta t) F        v(t) = e^(-delta t) v + t phi1(delta t) F

for the position x, the velocity v and the force F, in units in which the sampling period T and the mass m are 1. In
each period the wall's force changes once, at the fraction f of a delay d = n + f. A response has settled when the
position stays in the *band* of +-2 % around its final value.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from zwidth.core.types import Array, Samples
from zwidth.model.checks import check_integer
from zwidth.numerics.evaluate import as_number
from zwidth.numerics.root_finding import bisect
from zwidth.plant.rigid_mass import phi_functions
from zwidth.stability.rigid.broadcasting import find_degree
from zwidth.stability.rigid.crossover import stable_kernel
from zwidth.stability.rigid.dominant.arrays import ACCURACY, find_poles
from zwidth.units.display import compact_repr

SETTLING_BAND = 0.02  # relative deviation from the final position that counts as settled, as in control textbooks
INSTANTS = 40  # instants per period at which a settling time is searched
BLOCK = 1 << 16  # instants evaluated at once
MOST_PERIODS = 1 << 21  # longest simulation for a settling time; takes some seconds


def advance(x: Array, v: Array, force: Array, t: Array, delta: float) -> tuple[Array, Array]:
    """Return the exact position and velocity of the damped mass after time t under a constant force."""
    phi = phi_functions(delta * t)
    return x + t * phi.phi1 * v + t * t * phi.phi2 * force, np.exp(-delta * t) * v + t * phi.phi1 * force


def advance_period(
    x: Array, v: Array, older: Array, newer: Array, t: Array, delta: float, f: float
) -> tuple[Array, Array]:
    """Return position and velocity at the instant t of a period in which the force changes at the fraction f.

    Args:
        x: Position at the start of the period.
        v: Velocity at the start of the period.
        older: Force before the change.
        newer: Force after the change.
        t: Time from the start of the period, 0 to 1.
        delta: Normalized physical damping.
        f: Fraction of the period at which the force changes.
    """
    x, v = advance(x, v, older, np.minimum(t, f), delta)
    return advance(x, v, newer, np.maximum(t - f, 0.0), delta)


def settling_time(alpha: float, beta: float, delta: float, d: float) -> float:
    """Return the last instant, in periods, at which a step response is outside the band; NaN if unstable or too slow.

    The simulation is at least twice as long as its dominant pole takes to decay to `SETTLING_BAND`. Its length is
    doubled until the response stays inside the band throughout the second half.
    """
    wall = alpha, beta, delta, d
    with np.errstate(all="ignore"):
        stable = stable_kernel(np.float64(alpha), np.float64(beta), np.float64(delta), np.float64(d))
        walls = [np.array([value]) for value in wall]
        rate = float(find_poles(walls, ACCURACY, with_rate=True).rate[0]) if stable else math.nan
    periods = 2.0 * (d + 2.0 - math.log(SETTLING_BAND) / rate) if rate > 0 else math.inf
    while periods < MOST_PERIODS:
        last = _find_last_outside(wall, math.ceil(periods))
        if last < 0.5 * periods:
            return last
        periods *= 2.0
    return math.nan


def _find_last_outside(wall: tuple[float, float, float, float], periods: int) -> float:
    """Return the last instant, in periods, at which a step response is outside the band; 0 if there is none."""
    alpha, _, delta, d = wall
    f = d - math.floor(d)
    instants = np.unique([*np.arange(INSTANTS) / INSTANTS, f, 1.0])
    x, v, older, newer = _simulate(*wall, 1.0, periods)[:, :, None]

    def is_outside(k: slice, t: np.ndarray) -> np.ndarray:
        return (
            np.abs(alpha * advance_period(x[k], v[k], 1.0 + older[k], 1.0 + newer[k], t, delta, f)[0] - 1.0)
            > SETTLING_BAND
        )

    rows = BLOCK // instants.size
    for stop in range(periods, 0, -rows):
        start = max(stop - rows, 0)
        row, index = np.nonzero(is_outside(slice(start, stop), instants))
        if row.size:
            k, ends = start + int(row[-1]), instants[index[-1] : index[-1] + 2]
            if ends.size < 2:
                return k + 1.0
            return k + float(bisect(partial(is_outside, slice(k, k + 1)), *ends.reshape(2, 1, 1)).item())
    return 0.0


def decay_time(rate: Array) -> Array:
    """Return an estimate of the settling time by the dominant pole, ``ln 50/rate``; infinite if it does not decay."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rate > 0, -math.log(SETTLING_BAND) / rate, np.where(np.isnan(rate), np.nan, np.inf))


@compact_repr()
class StepResponse(NamedTuple):
    """Response of the device, at rest in contact with the wall, to a constant external force that begins at time 0."""

    time: Samples  # in periods; the next three fields are at these instants
    position: Samples
    velocity: Samples
    wall_force: Samples
    final_position: float
    settling_time: float  # in periods


def _simulate(alpha: float, beta: float, delta: float, d: float, applied: float, periods: int) -> np.ndarray:
    """Return x and v at the start of each period, from rest, and the wall's force before and after its change.

    Args:
        alpha: Normalized stiffness.
        beta: Normalized virtual damping.
        delta: Normalized physical damping.
        d: Delay in periods.
        applied: Constant external force.
        periods: Number of periods.

    Returns:
        Array (4, periods).
    """
    # Use plain floats, because a period takes one or two microseconds and importing a compiler would take longer.
    n = find_degree(d).n
    f = d - n
    # Compute three coefficients per part of a period, because x and v after a part are linear in x, v and the force.
    coefficients = []
    for t in (f, 1.0 - f):
        phi = phi_functions(np.float64(delta * t))
        coefficients.append((float(t * phi.phi1), float(t * t * phi.phi2), math.exp(-delta * t)))
    (xv0, xf0, c0), (xv1, xf1, c1) = coefficients
    # The coefficient of v in x and that of the force in v are both t phi1.
    x = v = previous = 0.0
    forces = [0.0] * (periods + n + 2)
    rows = []
    for k in range(periods):
        forces[k + n + 1] = -(alpha * x + beta * (x - previous))
        older, newer = forces[k], forces[k + 1]
        rows.append((x, v, older, newer))
        previous = x
        first, second = applied + older, applied + newer
        x, v = x + xv0 * v + xf0 * first, c0 * v + xv0 * first
        x, v = x + xv1 * v + xf1 * second, c1 * v + xv1 * second
    return np.array(rows).T


def step_response(
    alpha: float, beta: float, delta: float, d: float, *, periods: int = 100, substeps: int = 10, force: float = 1.0
) -> StepResponse:
    """Return the response to a constant external force of the device at rest in contact with the wall.

    The force acts on the mass and begins at time 0. The force of the wall, ``-(alpha x_k + beta (x_k - x_(k-1)))``, is
    computed at sample k and acts from k + d to k + d + 1 (zero-order hold).

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, integer or fractional. All four are single numbers.
        periods: number of simulated sampling periods, 1 to 10,000,000.
        substeps: number of instants per period, 1 to 10,000; 1 returns the samples only.
        force: external force, in units of m/T^2 times the unit of the position.

    Returns:
        StepResponse: ``time`` in periods; ``position``; ``velocity`` in position per period; ``wall_force``, the force
        of the wall; all (periods * substeps,). ``final_position`` is force/alpha, NaN for alpha = 0. ``settling_time``
        in periods is the last instant at which the position deviates by more than 2 % from it, also if that instant is
        after the returned periods. NaN if the wall is not stable or needs more than about 500,000 periods to settle.

    Numerics:
        Exact between force changes except for rounding errors; float64, by NumPy. An unstable response that overflows
        ends with infinities or NaN.

    References:
        Hulin, Preusche, Hirzinger 2006, section VIII, Fig. 11, eqs. (2), (6).

    Example:
        >>> import zwidth
        >>> response = zwidth.step_response(0.108, 0.425, 0.0, 1)
        >>> print(f"{response.position[-1] * 0.108:.2f}")
        1.00
    """
    alpha, beta, force = as_number("alpha", alpha), as_number("beta", beta), as_number("force", force)
    delta, d = as_number("delta", delta, 0.0), as_number("d", d, 0.0)
    periods = check_integer("periods", periods, 1, 10**7)
    substeps = check_integer("substeps", substeps, 1, 10_000)
    fractions = np.arange(substeps) / substeps
    with np.errstate(all="ignore"):
        samples = _simulate(alpha, beta, delta, d, force, periods)
        x, v, older, newer = samples[:, :, None]
        f = d - math.floor(d)
        x, v = advance_period(x, v, force + older, force + newer, fractions, delta, f)
        parts = (np.broadcast_to(part, (periods, substeps)) for part in (x, v, np.where(fractions < f, older, newer)))
    position, velocity, wall_force = (part.ravel() for part in parts)
    time = (np.arange(periods)[:, None] + fractions).ravel()
    final = force / alpha if alpha != 0 else math.nan
    settled = settling_time(alpha, beta, delta, d) if force != 0 else 0.0
    return StepResponse(time, position, velocity, wall_force, final, settled)
