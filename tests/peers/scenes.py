"""Two hundred random devices and walls in SI units, and their models by independent tools."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from peers.models import advance

COUNT = 200


@dataclass(frozen=True)
class Loop:
    """One device, timing and wall in SI units."""

    mass: float
    damping: float
    period: float
    delay: float
    stiffness: float
    virtual_damping: float

    @property
    def n_delay(self) -> int:
        """Integer part of the delay in periods."""
        return int(np.floor(self.delay / self.period + 1e-9))

    @property
    def fraction(self) -> float:
        """Fractional part of the delay in periods."""
        return max(self.delay / self.period - self.n_delay, 0.0)


def random_loops() -> list[Loop]:
    """Return loops with masses of 5 g to 5 kg, rates of 100 Hz to 10 kHz, delays of 0 to 6 periods, half of
    them integer.
    """
    generator = np.random.default_rng(2006)
    loops = []
    for index in range(COUNT):
        mass, period = 10 ** generator.uniform(-2.3, 0.7), 10 ** generator.uniform(-4, -2)
        periods = generator.integers(0, 7) if index % 2 == 0 else generator.uniform(0, 6)
        delta = 0.0 if index % 10 == 0 else 10 ** generator.uniform(-3, 0.7)
        alpha, beta = generator.uniform(0.001, 1.0), generator.uniform(-delta, 1.2)
        # Most walls near the stable region, inside and outside.
        scale = (1.0 + delta) / (1.0 + periods)
        loops.append(
            Loop(mass, delta * mass / period, period, float(periods) * period, alpha * scale * mass / period**2,
                 beta * scale * mass / period)
        )  # fmt: skip
    return loops


def continuous(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """Return the damped mass in continuous time, from force to (position, velocity)."""
    return np.array([[0.0, 1.0], [0.0, -loop.damping / loop.mass]]), np.array([[0.0], [1.0 / loop.mass]])


def hold_force(loop: Loop, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the transition over ``duration``, and the effect of a force held for that time."""
    transition, by_force = advance(loop.mass, loop.damping, duration)
    return transition, by_force[:, None]


def closed_loop_matrix(loop: Loop) -> np.ndarray:
    """Return the state matrix of the closed loop: position, velocity, last position, then the delayed forces."""
    f, n, t = loop.fraction, loop.n_delay, loop.period
    step, _ = hold_force(loop, t)
    rest, newer = hold_force(loop, (1.0 - f) * t)
    _, first = hold_force(loop, f * t)
    size = 4 + n
    matrix = np.zeros((size, size))
    force = np.zeros(size)
    force[0] = -(loop.stiffness + loop.virtual_damping / t)
    force[2] = loop.virtual_damping / t
    matrix[:2, :2] = step
    matrix[2, 0] = 1.0
    # The queue contains the forces of samples k - 1, ..., k - n - 1.
    matrix[:2, 3 + n] += (rest @ first).ravel()
    if n == 0:
        matrix[:2] += newer @ force[None, :]
    else:
        matrix[:2, 2 + n] += newer.ravel()
    matrix[3] = force
    matrix[np.arange(4, size), np.arange(3, size - 1)] = 1.0
    return matrix
