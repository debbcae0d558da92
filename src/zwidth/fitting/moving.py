"""The motion of a damped mass under a recorded force that acts a delay later, held from sample to sample; exact.

With j periods since the first sample that counts, and in units of the period,

    x_j = g R_j(delta, d) + x0 + v0 j phi1(delta j) + g f0 j^2 phi2(delta j),     g = T^2/m,

R the answer of `zwidth.plant` to the forces. The recursion is run by SciPy's compiled filters, first the velocity's,
then a sum, so that rounding grows with the samples and not with their square; nothing is compiled for a log's length,
which JAX would do for seconds. Derivatives are exact: filters of the same kind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zwidth.numerics.phi import phi_functions
from zwidth.plant import Plant, held_plant, split_delay
from zwidth.stability.ridge_slopes import plant_slopes


@dataclass(frozen=True)
class Recording:
    """One log at even times: its forces, and its positions from sample ``skip`` on, whose forces are all known."""

    force: np.ndarray
    position: np.ndarray
    skip: int

    def begin(self, count: int) -> Recording:
        """Its first positions alone."""
        return Recording(self.force[: self.skip + count], self.position[:count], self.skip)

    @property
    def steps(self) -> np.ndarray:
        """Periods since the first position."""
        return np.arange(self.position.size, dtype=float)

    def answer(self, delta: float, d: float) -> np.ndarray:
        """R."""
        whole, f = split_delay(np.float64(d))
        plant = held_plant(np.float64(delta), f)
        return np.cumsum(_decaying(self._push(plant, int(whole) + 1), plant.c))[self.skip :]

    def answers(self, delta: float, d: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R and its derivatives in delta and d."""
        whole, f = split_delay(np.float64(d))
        delta = np.float64(delta)
        plant, (by_delta, by_f) = held_plant(delta, f), plant_slopes(delta, f)
        turns = int(whole) + 1
        speed = _decaying(self._push(plant, turns), plant.c)
        late = np.concatenate([[0.0], speed[:-1]])
        slower = _decaying(self._push(by_delta, turns) - plant.c * late, plant.c)
        moved = _decaying(self._push(by_f, turns), plant.c)
        speed, slower, moved = (np.cumsum(part)[self.skip :] for part in (speed, slower, moved))
        return speed, slower, moved

    def _push(self, plant: Plant, turns: int) -> np.ndarray:
        """``(a2 + a1/z + a0/z^2) z^-turns`` of the forces."""
        push = np.convolve(self.force, [plant.a2, plant.a1, plant.a0])
        return np.concatenate([np.zeros(turns), push])[: self.force.size]

    def drift(self, delta: float) -> tuple[np.ndarray, np.ndarray]:
        """``j phi1(delta j)`` and its derivative in delta."""
        at = phi_functions(delta * self.steps)
        return self.steps * at.phi1, -(self.steps**2) * at.psi

    def fall(self, delta: float) -> tuple[np.ndarray, np.ndarray]:
        """``j^2 phi2(delta j)`` and its derivative in delta."""
        j = self.steps
        at = phi_functions(delta * j)
        return j**2 * at.phi2, -(j**3) / 6.0 if delta == 0 else -(j**2) * at.gap / delta


def _decaying(push: np.ndarray, c: float) -> np.ndarray:
    """``v_k = c v_(k-1) + push_k``."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], [1.0, -c], push))


@dataclass(frozen=True)
class Recordings:
    """Several logs of one device; theta is ``(g, delta, d)``, for each log x0 and v0, and g f0 where there is one."""

    logs: tuple[Recording, ...]
    with_offset: bool

    @property
    def measured(self) -> np.ndarray:
        """All positions that count."""
        return np.concatenate([log.position for log in self.logs])

    def columns(self, delta: float, d: float) -> np.ndarray:
        """What the positions are sums of, but for R's derivatives: (n, 1 + 2 logs + offset)."""
        blocks = []
        for k, log in enumerate(self.logs):
            block = np.zeros((log.position.size, 1 + 2 * len(self.logs) + self.with_offset))
            block[:, 0], block[:, 1 + 2 * k], block[:, 2 + 2 * k] = log.answer(delta, d), 1.0, log.drift(delta)[0]
            if self.with_offset:
                block[:, -1] = log.fall(delta)[0]
            blocks.append(block)
        return np.concatenate(blocks)

    def project(self, delta: float, d: float) -> tuple[np.ndarray, float]:
        """The best theta for this damping and delay, and its sum of squares."""
        columns = self.columns(delta, d)
        sizes = np.linalg.norm(columns, axis=0)
        scaled = columns / np.where(sizes > 0, sizes, 1.0)
        # Half of the digits are enough to start from.
        values = np.linalg.lstsq(scaled.T @ scaled, scaled.T @ self.measured, rcond=None)[0]
        rest = self.measured - scaled @ values
        values = values / np.where(sizes > 0, sizes, 1.0)
        return np.concatenate([values[:1], [delta, d], values[1:]]), float(rest @ rest)

    def predict(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and their derivatives in theta."""
        g, delta, d = theta[:3]
        places, slopes = [], []
        for k, log in enumerate(self.logs):
            (answer, by_delta, by_d), (drift, drift_slope) = log.answers(delta, d), log.drift(delta)
            x0, v0 = theta[3 + 2 * k : 5 + 2 * k]
            slope = np.zeros((answer.size, theta.size))
            slope[:, 0], slope[:, 1], slope[:, 2] = answer, g * by_delta + v0 * drift_slope, g * by_d
            slope[:, 3 + 2 * k], slope[:, 4 + 2 * k] = 1.0, drift
            place = g * answer + x0 + v0 * drift
            if self.with_offset:
                fall, fall_slope = log.fall(delta)
                place, slope[:, -1] = place + theta[-1] * fall, fall
                slope[:, 1] += theta[-1] * fall_slope
            places.append(place)
            slopes.append(slope)
        return np.concatenate(places), np.concatenate(slopes)
