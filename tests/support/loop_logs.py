"""Simulated logs of a knob in the formats of control loops, with the true parameters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter, ss2tf


class Knob(NamedTuple):
    """A simulated knob with its log: kg m^2, N m s/rad, s, counts per revolution; N m and counts per sample."""

    inertia: float
    damping: float
    delay: float
    period: float
    counts: int
    torque: np.ndarray
    reading: np.ndarray  # in counts, unwrapped

    @property
    def step(self) -> float:
        """One count in rad."""
        return 2.0 * np.pi / self.counts

    def holds(self, fit, factor: float = 1.0) -> bool:
        """Return whether the 95 % intervals of a fit, widened by a factor, contain the true device."""
        expected = {"mass": self.inertia, "damping": self.damping, "delay": self.delay}
        for name, value in expected.items():
            low, high = fit.intervals[name]
            middle, half = 0.5 * (low + high), 0.5 * factor * (high - low) + 1e-12 * value
            if abs(value - middle) > half:
                return False
        return True


def respond_from_rest(mass: float, damping: float, delay: float, period: float, force: np.ndarray) -> np.ndarray:
    """Return positions at the samples by the transfer functions of both parts of a period."""
    n_delay, fraction = int(delay // period), delay / period % 1
    rate = np.array([[0, 1, 0], [0, -damping / mass, 1 / mass], [0, 0, 0]])
    one, first, second = (expm(rate * part * period) for part in (1.0, fraction, 1 - fraction))
    delayed = np.concatenate([np.zeros(n_delay + 1), force])
    position = np.zeros(force.size)
    inputs = (second[:2, :2] @ first[:2, 2], delayed[: force.size]), (second[:2, 2], delayed[1 : force.size + 1])
    for column, signal in inputs:
        top, bottom = ss2tf(one[:2, :2], column[:, None], np.array([[1.0, 0.0]]), np.zeros((1, 1)))
        position += lfilter(top[0], bottom, signal)
    return position


def make_knob(seed: int = 0, samples: int = 1500, period: float = 1e-3, counts: int = 16384) -> Knob:
    """Return a typical knob, moved to and fro by torques that also turn it several times."""
    rng = np.random.default_rng(seed)
    inertia, damping = 10 ** rng.uniform(-5.3, -4.3), 10 ** rng.uniform(-4.5, -3.5)
    delay = period * rng.uniform(0.3, 2.5)
    hold = int(rng.integers(20, 60))
    # One torque per interval, with a speed of about one revolution in 0.3 s.
    size = inertia * 20.0 / (hold * period)
    torque = np.repeat(np.round(size * rng.uniform(-1, 1, samples // hold + 1), 6), hold)[:samples]
    angle = respond_from_rest(inertia, damping, delay, period, torque) + rng.uniform(0, 2 * np.pi)
    return Knob(inertia, damping, delay, period, counts, torque, np.round(angle * counts / (2 * np.pi)))
