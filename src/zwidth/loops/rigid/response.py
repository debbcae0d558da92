"""Time response of the rigid device in contact with the wall, exact at the samples and between them.

Between two instants at which a force changes, the damped mass has the exact solution

    x(t) = x + t phi1(delta t) v + t^2 phi2(delta t) F        v(t) = e^(-delta t) v + t phi1(delta t) F

(T = 1, m = 1). In each period the wall's force changes once, at the fraction f of a delay d = n + f.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from zwidth.arrays import phi
from zwidth.arrays.arguments import as_float64
from zwidth.loops.rigid.degrees import find_degree
from zwidth.loops.rigid.settling import advance, settling_time
from zwidth.words.errors import InputError
from zwidth.words.types import Array, Samples


class StepResponse(NamedTuple):
    """The response to a constant force that sets in at time 0; arrays of one time axis."""

    time: Samples
    position: Samples
    velocity: Samples
    wall_force: Samples
    final_position: float
    settling_time: float


class _Samples(NamedTuple):
    """State at the start of every period, and the wall's force before and behind the instant at which it changes."""

    x: np.ndarray
    v: np.ndarray
    older: np.ndarray
    newer: np.ndarray


def _run(alpha: float, beta: float, delta: float, d: float, applied: float, periods: int) -> _Samples:
    """Run the loop from rest, sample by sample.

    In plain floats: a period takes a microsecond or two, less than importing a compiler for most runs.
    """
    lag = find_degree(d).whole
    f = d - lag
    # x and v after each part of a period are linear in x, v and the force: three numbers a part.
    parts = []
    for t in (f, 1.0 - f):
        at = phi.phi_functions(np.float64(delta * t))
        parts.append((float(t * at.phi1), float(t * t * at.phi2), math.exp(-delta * t)))
    (xv0, xf0, c0), (xv1, xf1, c1) = parts
    # The velocity gains t phi1 F, the factor that the velocity has in the position.
    x = v = previous = 0.0
    forces = [0.0] * (periods + lag + 2)
    rows = []
    for k in range(periods):
        forces[k + lag + 1] = -(alpha * x + beta * (x - previous))
        older, newer = forces[k], forces[k + 1]
        rows.append((x, v, older, newer))
        previous = x
        first, second = applied + older, applied + newer
        x, v = x + xv0 * v + xf0 * first, c0 * v + xv0 * first
        x, v = x + xv1 * v + xf1 * second, c1 * v + xv1 * second
    return _Samples(*np.array(rows).T)


def _interpolate(samples: _Samples, fractions: np.ndarray, delta: float, f: float, applied: float) -> tuple[Array, ...]:
    """Position, velocity and force at the instants ``fractions`` of every period; rows are periods."""
    x, v, older, newer = (column[:, None] for column in samples)
    x_bend, v_bend = advance(x, v, applied + older, np.float64(f), delta)
    before = fractions < f
    span = np.where(before, fractions, fractions - f)
    force = np.where(before, older, newer)
    x, v = advance(np.where(before, x, x_bend), np.where(before, v, v_bend), applied + force, span, delta)
    return x, v, force


def step_response(
    alpha: float, beta: float, delta: float, d: float, *, periods: int = 100, substeps: int = 10, force: float = 1.0
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
        ``settling_time`` in periods is the last instant of all outside 2 % of it, however long was simulated: it comes
        from the poles, see `loops.rigid.settling`. NaN where the wall is not stable, and beyond d = 500.

    Numerics:
        Exact between force changes up to rounding; float64, by NumPy. An unstable response that outgrows it ends as
        inf or NaN.

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
    fractions = np.arange(substeps) / substeps
    with np.errstate(all="ignore"):
        samples = _run(alpha, beta, delta, d, force, int(periods))
        history = _interpolate(samples, fractions, delta, d - math.floor(d), force)
    position, velocity, wall_force = (np.broadcast_to(part, (periods, substeps)).ravel() for part in history)
    time = (np.arange(periods)[:, None] + fractions).ravel()
    final = force / alpha if alpha != 0 else math.nan
    settled = settling_time(alpha, beta, delta, d) if force != 0 else 0.0
    return StepResponse(time, position, velocity, wall_force, final, settled)
