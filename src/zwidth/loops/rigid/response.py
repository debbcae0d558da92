"""Time response of the rigid device in contact with the wall, exact at the samples and between them.

Between two instants at which a force changes, the damped mass has the exact solution

    x(t) = x + t phi1(delta t) v + t^2 phi2(delta t) F        v(t) = e^(-delta t) v + t phi1(delta t) F

(T = 1, m = 1). In each period the wall's force changes once, at the fraction f of a delay d = n + f. When it has
settled, for ever after, its modes tell: the deviation from the final position is

    x(k + t) - 1/alpha = sum_i r_i g_i(t) z_i^k        r_i = (phi2 z_i + psi) z_i^(2+n)/(P'(z_i) (z_i - 1))

``g_i(t)``, 0 <= t < 1, the motion within a period of the mode that is 1 at its start. The sum of absolute values bounds
all that can still come; from where that leaves the band for good, the last instant outside is searched backwards.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from zwidth.arrays.evaluate import as_number
from zwidth.arrays.held_mass import phi_functions
from zwidth.arrays.roots import bisect
from zwidth.loops.rigid.crossover import stable_kernel
from zwidth.loops.rigid.folding import find_degree
from zwidth.loops.rigid.poles import poles
from zwidth.loops.rigid.polynomial import coefficients
from zwidth.parts.checks import check_whole
from zwidth.words.quantities import LONGEST_SETTLING
from zwidth.words.showing import shown
from zwidth.words.types import Array, Samples

# The band round the final value that counts as settled, as in control textbooks.
SETTLING_BAND = 0.02
# Instants a period at which the motion is looked at, beside the one at which the force changes.
_INSTANTS = 40
# How far the modes, summed up at the first samples, may be from the motion that they stand for.
_MISFIT = 1e-6
# Instants laid out at one time.
_BLOCK = 1 << 16
# How many such blocks are searched at most: some seconds.
_MOST_BLOCKS = 1 << 12


class Modes(NamedTuple):
    """Poles and residues of a loop's step response, and what places its motion within a period."""

    z: np.ndarray
    residue: np.ndarray
    speed: np.ndarray  # velocity at the sample of the mode that is its residue there
    older: np.ndarray  # its force before and behind the instant at which the force changes
    newer: np.ndarray
    delta: float
    f: float

    def shape(self, t: np.ndarray) -> np.ndarray:
        """``r_i g_i(t)``, shape (instants, modes)."""
        t = np.asarray(t, dtype=float)[:, None]
        return move(self.residue, self.speed, self.older, self.newer, t, self.delta, self.f)[0]

    def deviation(self, time: np.ndarray) -> np.ndarray:
        """The deviation at any instants, in periods."""
        k = np.floor(time)
        return np.real(np.sum(self.shape(time - k) * self.z ** k[:, None], axis=1))


def advance(x: Array, v: Array, force: Array, t: Array, delta: float) -> tuple[Array, Array]:
    """The exact state of the damped mass after time t under a constant force."""
    at = phi_functions(delta * t)
    return x + t * at.phi1 * v + t * t * at.phi2 * force, np.exp(-delta * t) * v + t * at.phi1 * force


def move(x: Array, v: Array, older: Array, newer: Array, t: Array, delta: float, f: float) -> tuple[Array, Array]:
    """The state at the instant t of a period, whose force changes at the fraction f."""
    x, v = advance(x, v, older, np.minimum(t, f), delta)
    return advance(x, v, newer, np.maximum(t - f, 0.0), delta)


def modes(alpha: float, beta: float, delta: float, d: float) -> Modes | None:
    """The modes of a stable wall; None where rounding keeps them from standing for its motion."""
    degree = find_degree(d)
    n, f = degree.whole, d - degree.whole
    z = np.asarray(poles(alpha, beta, delta, d), dtype=complex)
    z = z[np.abs(z) > 1e-300]
    numbers = [np.float64(value) for value in (alpha, beta, delta, d)]
    monic = coefficients(numbers[0], numbers[1], numbers[2], numbers[3], degree)
    power = degree.poles - np.arange(degree.poles)
    slope = np.sum(power[:, None] * monic[:-1, None] * z ** (power[:, None] - 1.0), axis=0)
    here = phi_functions(numbers[2])
    # All in the sizes of the residues: ``z^-n`` alone overflows next to 0.
    share, ahead = (here.phi2 * z + here.psi) / (slope * (z - 1.0)), 2 if degree.fractional else 1
    residue = share * z ** (n + ahead)
    # The mode's force as computed at a sample of ``z^n``, and as it arrives n + 1 and n samples later.
    computed = -(alpha + beta - beta / z) * share
    newer, older = computed * z**ahead, computed * z ** (ahead - 1)
    reached, _ = move(0.0, 0.0, older, newer, np.float64(1.0), delta, f)
    speed = ((z - 1.0) * residue - reached) / here.phi1
    found = Modes(z, residue, speed, older, newer, float(delta), float(f))
    # At rest at first; one period later under the applied force alone.
    exact = np.array([-1.0 / alpha, here.phi2 - 1.0 / alpha])
    got = found.deviation(np.array([0.0, 1.0]))
    if not np.all(np.abs(got - exact) <= _MISFIT / alpha):
        return None
    return found


def settling_time(alpha: float, beta: float, delta: float, d: float, band: float = SETTLING_BAND) -> float:
    """The last instant, in periods, at which a step response is outside the band; NaN where none is known."""
    with np.errstate(all="ignore"):
        stable = stable_kernel(np.float64(alpha), np.float64(beta), np.float64(delta), np.float64(d))
    if not stable or d > LONGEST_SETTLING:
        return math.nan
    with np.errstate(all="ignore"):
        found = modes(alpha, beta, delta, d)
    if found is None:
        return math.nan
    allowed = band / alpha
    instants = np.unique(np.append(np.arange(_INSTANTS) / _INSTANTS, found.f))
    bound = np.abs(found.shape(instants)).max(axis=0) * 1.5
    with np.errstate(all="ignore"):
        rate = -np.log(np.abs(found.z))
    if not np.all(rate > 0):
        return math.nan
    # The first period from which on the sum of the modes' sizes stays within the band.
    longest = np.max(np.log(np.maximum(bound * bound.size / allowed, 1.0)) / rate)
    last = bisect(lambda k: np.sum(bound * np.exp(-rate * k)) > allowed, np.float64(0.0), longest)
    return _last_outside(found, instants, math.ceil(last), allowed)


def decay_time(rate: Array) -> Array:
    """An estimate of the settling time by the slowest pole alone, ``ln 50/rate``; infinite where it does not decay."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rate > 0, -math.log(SETTLING_BAND) / rate, np.where(np.isnan(rate), np.nan, np.inf))


def _last_outside(found: Modes, instants: np.ndarray, last: int, allowed: float) -> float:
    """Search backwards, block by block, then halve the interval in which the response enters the band for good."""
    shape = found.shape(instants)
    rows = max(1, _BLOCK // (instants.size * max(found.z.size, 1)))
    for searched, stop in enumerate(range(last + 1, 0, -rows)):
        if searched == _MOST_BLOCKS:
            return math.nan
        k = np.arange(max(stop - rows, 0), stop)
        size = np.abs(np.real((found.z ** k[:, None]) @ shape.T)).ravel()
        time = (k[:, None] + instants).ravel()
        near = _find_peaks(found, time, size, allowed)
        outside = np.flatnonzero(size > allowed)
        latest = max(near, float(time[outside[-1]]) if outside.size else -1.0)
        if latest < 0:
            continue
        after = time[np.searchsorted(time, latest, side="right") :]
        inside = float(after[0]) if after.size else float(stop)
        ends = np.array([latest]), np.array([inside])
        return float(bisect(lambda at: np.abs(found.deviation(at)) > allowed, *ends)[0])
    return 0.0


def _find_peaks(found: Modes, time: np.ndarray, size: np.ndarray, allowed: float) -> float:
    """The last instant outside the band between the instants looked at, -1 where there is none."""
    inner = np.arange(1, size.size - 1)
    peak = (size[inner] >= size[inner - 1]) & (size[inner] >= size[inner + 1])
    close = inner[peak & (size[inner] <= allowed) & (size[inner] > 0.98 * allowed)]
    for index in close[::-1]:
        fine = np.linspace(time[index - 1], time[index + 1], 201)
        outside = np.flatnonzero(np.abs(found.deviation(fine)) > allowed)
        if outside.size:
            return float(fine[outside[-1]])
    return -1.0


@shown()
class StepResponse(NamedTuple):
    """The response to a constant force that sets in at time 0; arrays of one time axis."""

    time: Samples
    position: Samples
    velocity: Samples
    wall_force: Samples
    final_position: float
    settling_time: float


def _run(alpha: float, beta: float, delta: float, d: float, applied: float, periods: int) -> np.ndarray:
    """Run the loop from rest: x and v at the start of every period, the wall's force before and behind its change."""
    # In plain floats: a period takes a microsecond or two, less than importing a compiler for most runs.
    lag = find_degree(d).whole
    f = d - lag
    # x and v after each part of a period are linear in x, v and the force: three numbers a part.
    parts = []
    for t in (f, 1.0 - f):
        at = phi_functions(np.float64(delta * t))
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
    return np.array(rows).T


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
        periods: how many sampling periods to simulate, 1 to 10,000,000.
        substeps: instants in each period, 1 to 10,000; 1 gives the samples alone.
        force: the constant force in units of m/T^2 times a length unit.

    Returns:
        StepResponse: ``time`` in periods; ``position``; ``velocity`` in position a period; ``wall_force``, what the
        wall applies then; all (periods * substeps,). ``final_position`` is force/alpha, NaN for alpha = 0.
        ``settling_time`` in periods is the last instant of all outside 2 % of it, however long was simulated: it comes
        from the poles, see `loops.rigid.response`. NaN where the wall is not stable, beyond d = 500, and of walls so
        soft that they take some 10^7 periods to settle, at long delays some 10^5.

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
    alpha, beta, force = as_number("alpha", alpha), as_number("beta", beta), as_number("force", force)
    delta, d = as_number("delta", delta, 0.0), as_number("d", d, 0.0)
    periods = check_whole("periods", periods, 1, 10**7)
    substeps = check_whole("substeps", substeps, 1, 10_000)
    fractions = np.arange(substeps) / substeps
    with np.errstate(all="ignore"):
        samples = _run(alpha, beta, delta, d, force, periods)
        x, v, older, newer = samples[:, :, None]
        f = d - math.floor(d)
        x, v = move(x, v, force + older, force + newer, fractions, delta, f)
        parts = (np.broadcast_to(part, (periods, substeps)) for part in (x, v, np.where(fractions < f, older, newer)))
    position, velocity, wall_force = (part.ravel() for part in parts)
    time = (np.arange(periods)[:, None] + fractions).ravel()
    final = force / alpha if alpha != 0 else math.nan
    settled = settling_time(alpha, beta, delta, d) if force != 0 else 0.0
    return StepResponse(time, position, velocity, wall_force, final, settled)
