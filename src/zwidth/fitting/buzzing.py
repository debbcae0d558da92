"""Walls at the onset of buzzing as the loop has them: which K and which frequency, for a device, at a damping.

With z = e^(jw), w = 2 pi f T, a pole pair is on the circle exactly where

    K T^2 + B T F(z) = m q(z; delta, d),     q = -1/G,

two real equations a wall. At a known B they determine w and K (docs/theory/scenes.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zwidth.linear_loop import Estimate, circle, lag_jet
from zwidth.plant import held_plant, split_delay
from zwidth.stability.ridge_slopes import plant_slopes

# Newton's steps towards w, the longest of them as a share of w, and the last one's share.
_STEPS, _LONGEST, _ARRIVED = 40, 0.15, 1e-13


class NeededAnswer(NamedTuple):
    """q and its derivatives in w, delta and d, at these w for these devices."""

    q: Any
    by_w: Any
    by_delta: Any
    by_d: Any


def needed_answer(w: np.ndarray, delta: Any, d: Any) -> NeededAnswer:
    """``q = -z^n (z - 1)(z - c)/(a2 z + a1 + a0/z)`` with its derivatives; all broadcast."""
    whole, f = split_delay(np.asarray(d, float))
    plant, (by_delta, by_f) = held_plant(delta, f), plant_slopes(delta, f)
    at = circle(w)

    def answer(part):
        return part.a2 * at.z + part.a1 + part.a0 / at.z

    below, slow, total = at.before + plant.em, at.before, answer(plant)
    q = -lag_jet(at, whole).value * slow * below / total
    turn = 1j * at.z
    by_w = 1j * whole + turn / slow + turn / below - 1j * (plant.a2 * at.z - plant.a0 / at.z) / total
    return NeededAnswer(q, q * by_w, q * (by_delta.em / below - answer(by_delta) / total), -q * answer(by_f) / total)


@dataclass(frozen=True)
class Onsets:
    """Measured walls: ``kappa = K T^2`` in kg, ``rub = B T`` in kg, w; and the velocity estimate."""

    kappa: np.ndarray
    rub: np.ndarray
    w: np.ndarray
    estimate: Estimate

    def follow(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """kappa and w that ``(ln m, delta, d)`` leads to at these dampings, w nearest to the measured ones.

        Returns:
            kappa, w, the derivatives of ``(ln kappa, ln w)`` in theta, (n, 2, 3), and whether w was found.
        """
        mass, delta, d = np.exp(theta[0]), theta[1], theta[2]
        w = self.w
        step = np.full(w.shape, np.inf)
        for _ in range(_STEPS):
            f, at = self.estimate.jet(circle(w)), needed_answer(w, delta, d)
            rest, slope = (self.rub * f.value - mass * at.q).imag, (self.rub * f.slope - mass * at.by_w).imag
            step = np.clip(-rest / slope, -_LONGEST * w, _LONGEST * w)
            w = np.minimum(w + step, 0.5 * (w + np.pi))
            if np.all(np.abs(step) <= _ARRIVED * w):
                break
        f, at = self.estimate.jet(circle(w)), needed_answer(w, delta, d)
        kappa = (mass * at.q - self.rub * f.value).real
        return kappa, w, *self._slopes(kappa, w, mass, at, f.slope), np.abs(step) <= 1e-6 * w

    def _slopes(self, kappa, w, mass, at, f_slope) -> tuple[np.ndarray]:
        """kappa and w as theta moves: ``d kappa + e_w dw = m dq`` with ``e_w = rub F' - m q'``."""
        moved = mass * np.stack([at.q, at.by_delta, at.by_d], -1)
        by_w = (self.rub * f_slope - mass * at.by_w)[:, None]
        dw = moved.imag / by_w.imag
        return (np.stack([(moved.real - by_w.real * dw) / kappa[:, None], dw / w[:, None]], 1),)

    def starts(self, deltas: np.ndarray, longest: float, count: int) -> list[np.ndarray]:
        """Devices to start from: the lowest dips over damping and delay, where the mass follows in closed form.

        By phases and by magnitudes, of which the mean is the mass. No stable wall turns its phase by more than half a
        turn over its delay.
        """
        delays = np.linspace(0.0, longest, max(8, int(np.ceil(longest * self.w.max() / 0.1))) + 1)
        f = self.estimate.jet(circle(self.w)).value
        wall = self.kappa + self.rub * f
        q = needed_answer(self.w, deltas[:, None, None], delays[:, None]).q
        away = np.log(wall / q)
        log_mass = away.real.mean(-1)
        cost = (away.imag**2).sum(-1) + ((away.real - log_mass[..., None]) ** 2).sum(-1)
        walled = np.pad(cost, 1, constant_values=np.inf)
        around = [walled[1 + i : 1 + i + cost.shape[0], 1 + j : 1 + j + cost.shape[1]] for i, j in _AROUND]
        dips = np.argwhere(np.all([cost <= other for other in around], axis=0))
        dips = sorted(dips.tolist(), key=lambda at: cost[tuple(at)])[:count]
        return [np.array([log_mass[i, j], deltas[i], delays[j]]) for i, j in dips]


_AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
