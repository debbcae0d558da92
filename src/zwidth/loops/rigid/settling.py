"""When a step response has settled, for ever after: from the modes of the rigid loop, not from where a run ends.

The deviation from the final position is a sum of modes, at the samples and between them (T = 1, unit force):

    x(k + t) - 1/alpha = sum_i r_i g_i(t) z_i^k        r_i = (phi2 z_i + psi) z_i^(2+n)/(P'(z_i) (z_i - 1))

``g_i(t)``, 0 <= t < 1, is the motion within a period of the mode that is 1 at its start. The sum of absolute values
bounds all that can still come; from where that leaves the band for good, the last instant outside is searched
backwards.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from zwidth.arrays import phi
from zwidth.arrays.roots import bisect
from zwidth.loops.rigid.crossover import stable_kernel
from zwidth.loops.rigid.degrees import find_degree
from zwidth.loops.rigid.poles import poles
from zwidth.loops.rigid.polynomial import coefficients
from zwidth.words.quantities import LONGEST_SETTLING
from zwidth.words.types import Array

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
    speed: np.ndarray  # velocity at the sample, of the mode that is 1 there
    older: np.ndarray  # its force before and behind the instant at which the force changes
    newer: np.ndarray
    delta: float
    f: float

    def shape(self, t: np.ndarray) -> np.ndarray:
        """``r_i g_i(t)``, shape (instants, modes)."""
        t = np.asarray(t, dtype=float)[:, None]
        first, second = np.minimum(t, self.f), np.maximum(t - self.f, 0.0)
        x, v = advance(1.0, self.speed, self.older, first, self.delta)
        return self.residue * advance(x, v, self.newer, second, self.delta)[0]

    def deviation(self, time: np.ndarray) -> np.ndarray:
        """The deviation at any instants, in periods."""
        k = np.floor(time)
        return np.real(np.sum(self.shape(time - k) * self.z ** k[:, None], axis=1))


def advance(x: Array, v: Array, force: Array, t: Array, delta: float) -> tuple[Array, Array]:
    """The exact state of the damped mass after time t under a constant force."""
    at = phi.phi_functions(delta * t)
    return x + t * at.phi1 * v + t * t * at.phi2 * force, np.exp(-delta * t) * v + t * at.phi1 * force


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
    here = phi.phi_functions(numbers[2])
    lag = z ** (n + (2 if degree.fractional else 1))
    residue = (here.phi2 * z + here.psi) * lag / (slope * (z - 1.0))
    # The mode's force as computed at a sample of 1, and as it arrives n + 1 and n samples later.
    computed = -(alpha + beta - beta / z)
    newer, older = computed * z**-n, computed * z ** -(n + 1.0)
    x_f, v_f = advance(0.0, 0.0, older, np.float64(f), delta)
    reached, _ = advance(x_f, v_f, newer, np.float64(1.0 - f), delta)
    speed = (z - 1.0 - reached) / here.phi1
    found = Modes(z, residue, speed, older, newer, float(delta), float(f))
    # At rest at first; one period later under the applied force alone.
    exact = np.array([-1.0 / alpha, here.phi2 - 1.0 / alpha])
    got = found.deviation(np.array([0.0, 1.0]))
    if not np.all(np.abs(got - exact) <= _MISFIT / alpha):
        return None
    return found


def settling_time(alpha: float, beta: float, delta: float, d: float, band: float = SETTLING_BAND) -> float:
    """The last instant at which a step response is outside the band round its final value, in periods.

    NaN where the wall is not stable, where poles so nearly coincide that rounding hides their modes, for d > 500, and
    where the motion is within the band for so many periods before its modes must be that the search is given up.
    """
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
    last = _envelope_end(bound, rate, allowed)
    return _last_outside(found, instants, last, allowed)


def decay_time(rate: Array) -> Array:
    """In what time a slowest pole that decays at a rate has decayed to 2 %; infinite where it does not decay.

    An estimate of the settling time by one pole, ``ln 50/rate``: the others and their residues may delay or hasten it.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rate > 0, -math.log(SETTLING_BAND) / rate, np.where(np.isnan(rate), np.nan, np.inf))


def _envelope_end(bound: np.ndarray, rate: np.ndarray, allowed: float) -> int:
    """The first period from which on the sum of the modes' sizes stays within the band."""
    longest = np.max(np.log(np.maximum(bound * bound.size / allowed, 1.0)) / rate)
    return math.ceil(bisect(lambda k: np.sum(bound * np.exp(-rate * k)) > allowed, np.float64(0.0), longest))


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
