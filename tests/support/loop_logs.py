"""Logs of a knob as control loops write them: clocks, counts and columns of files, and the true device."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter, ss2tf


class Knob(NamedTuple):
    """A simulated knob with its log: kg m^2, N m s/rad, s, counts per revolution, N m and counts of each sample."""

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
        true = {"mass": self.inertia, "damping": self.damping, "delay": self.delay}
        for name, value in true.items():
            low, high = fit.intervals[name]
            middle, half = 0.5 * (low + high), 0.5 * factor * (high - low) + 1e-12 * value
            if abs(value - middle) > half:
                return False
        return True


def respond_from_rest(mass: float, damping: float, delay: float, period: float, force: np.ndarray) -> np.ndarray:
    """Return positions at the samples by the transfer functions of both parts of a period."""
    whole, fraction = int(delay // period), delay / period % 1
    rate = np.array([[0, 1, 0], [0, -damping / mass, 1 / mass], [0, 0, 0]])
    one, first, second = (expm(rate * part * period) for part in (1.0, fraction, 1 - fraction))
    late = np.concatenate([np.zeros(whole + 1), force])
    moved = np.zeros(force.size)
    pushes = (second[:2, :2] @ first[:2, 2], late[: force.size]), (second[:2, 2], late[1 : force.size + 1])
    for push, held in pushes:
        top, bottom = ss2tf(one[:2, :2], push[:, None], np.array([[1.0, 0.0]]), np.zeros((1, 1)))
        moved += lfilter(top[0], bottom, held)
    return moved


def make_knob(seed: int = 0, samples: int = 1500, period: float = 1e-3, counts: int = 16384) -> Knob:
    """Return an ordinary knob, pushed to and fro by torques that also turn it around several times."""
    rng = np.random.default_rng(seed)
    inertia, damping = 10 ** rng.uniform(-5.3, -4.3), 10 ** rng.uniform(-4.5, -3.5)
    delay = period * rng.uniform(0.3, 2.5)
    hold = int(rng.integers(20, 60))
    # A torque in each stretch, with a speed of about a turn in 0.3 s.
    size = inertia * 20.0 / (hold * period)
    torque = np.repeat(np.round(size * rng.uniform(-1, 1, samples // hold + 1), 6), hold)[:samples]
    place = respond_from_rest(inertia, damping, delay, period, torque) + rng.uniform(0, 2 * np.pi)
    return Knob(inertia, damping, delay, period, counts, torque, np.round(place * counts / (2 * np.pi)))
