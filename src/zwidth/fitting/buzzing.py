"""Walls at the onset of buzzing as the loop has them: which K and which frequency, for a device, at a damping.

With z = e^(jw), w = 2 pi f T, a pole pair is on the circle exactly where

    K T^2 + B T F(z) = m q(z; delta, d),     q = -1/G,

two real equations a wall. At a known B they determine w and K (docs/theory/scenes.md). A device is looked for as
``theta = (ln m, delta, d)``, and ``ln cutoff`` where the velocity's cut-off is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.circle import CirclePoints, Jet, circle, lag_jet
from zwidth.fitting.scenes import with_cutoff
from zwidth.loops.rigid.device import held_plant, split_delay
from zwidth.loops.rigid.ridge import plant_slopes
from zwidth.parts.velocity import Estimate, Velocity

# Newton's steps towards w, the longest of them as a share of w, the last one's share (it squares), and the share
# beyond which w was not found.
_STEPS, _LONGEST, _ARRIVED, _FOUND = 25, 0.15, 1e-9, 1e-6
# The step in ln cutoff of a difference of fourth order, and its weights.
_STEP, _WEIGHTS = 1e-3, {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
# No cut-off is looked for above this share of half the sampling rate, or below this one of the lowest frequency heard,
# where a filter makes of the damper a spring.
_HIGHEST, _LOWEST = 0.99, 1e-3


class NeededAnswer:
    """``q = -z^n (z - 1)(z - c)/(a2 z + a1 + a0/z)`` of devices, arrays that broadcast with the points asked for."""

    def __init__(self, delta: Any, d: Any) -> None:
        """Of delta and d, described once for all frequencies."""
        self.whole, fraction = split_delay(np.asarray(d, float))
        self.delta, self.fraction = delta, fraction
        self.plant = held_plant(delta, fraction)

    def jet(self, at: CirclePoints) -> Jet:
        """q and its derivative in w."""
        plant, turn = self.plant, 1j * at.z
        total, below = _answer(plant, at), at.before + plant.em
        q = -lag_jet(at, self.whole).value * at.before * below / total
        slopes = turn / at.before + turn / below - 1j * (plant.a2 * at.z - plant.a0 / at.z) / total
        return Jet(q, q * (1j * self.whole + slopes))

    def moves(self, at: CirclePoints, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The derivatives of q in delta and d."""
        by_delta, by_fraction = plant_slopes(self.delta, self.fraction)
        total = _answer(self.plant, at)
        return (
            q * (by_delta.em / (at.before + self.plant.em) - _answer(by_delta, at) / total),
            -q * _answer(by_fraction, at) / total,
        )


def _answer(plant: Any, at: CirclePoints) -> Any:
    return plant.a2 * at.z + plant.a1 + plant.a0 / at.z


class Followed(NamedTuple):
    """kappa and w of walls, the derivatives of their logarithms in theta, (n, 2, unknowns), and whether w was found."""

    kappa: np.ndarray
    w: np.ndarray
    slopes: np.ndarray
    found: np.ndarray


@dataclass(frozen=True)
class Onsets:
    """Measured walls: ``kappa = K T^2`` in kg, ``rub = B T`` in kg, w; and how the velocity was estimated."""

    kappa: np.ndarray
    rub: np.ndarray
    w: np.ndarray
    velocity: Velocity
    period: float
    unknown_cutoff: bool = False

    @cached_property
    def _estimate(self) -> Estimate:
        return self.velocity.estimate(self.period)

    @property
    def unknowns(self) -> int:
        """How many numbers are looked for."""
        return 4 if self.unknown_cutoff else 3

    @property
    def cutoffs(self) -> tuple[float, float]:
        """The lowest and the highest that are looked for, in Hz."""
        coded = getattr(self.velocity, "coded_period", None) or self.period
        return _LOWEST * float(self.w.min()) / (2 * np.pi * self.period), _HIGHEST * 0.5 / coded

    def _estimate_at(self, theta: np.ndarray) -> Estimate:
        if not self.unknown_cutoff:
            return self._estimate
        return with_cutoff(self.velocity, float(np.exp(theta[3]))).estimate(self.period)

    def is_possible(self, theta: np.ndarray) -> bool:
        """Whether a filter of this cut-off is looked for."""
        return not self.unknown_cutoff or bool(np.log(self.cutoffs[0]) < theta[3] < np.log(self.cutoffs[1]))

    def follow(self, theta: np.ndarray) -> Followed:
        """The walls of theta at these dampings, w nearest to the measured ones."""
        mass, answer, estimate = np.exp(theta[0]), NeededAnswer(theta[1], theta[2]), self._estimate_at(theta)
        w = self.w
        step = np.full(w.shape, np.inf)
        for _ in range(_STEPS):
            at = circle(w)
            f, q = estimate.jet(at), answer.jet(at)
            rest, slope = (self.rub * f.value - mass * q.value).imag, (self.rub * f.slope - mass * q.slope).imag
            step = np.clip(-rest / slope, -_LONGEST * w, _LONGEST * w)
            w = np.minimum(w + step, 0.5 * (w + np.pi))
            if np.all(np.abs(step) <= _ARRIVED * w):
                break
        at = circle(w)
        f, q = estimate.jet(at), answer.jet(at)
        kappa = (mass * q.value - self.rub * f.value).real
        # kappa and w as theta moves: d kappa + e_w dw = m dq - rub dF with e_w = rub F' - m q'.
        moved = mass * np.stack([q.value, *answer.moves(at, q.value)], -1)
        if self.unknown_cutoff:
            sides = {k: self._estimate_at(theta + _STEP * k * np.eye(4)[3]).jet(at).value for k in _WEIGHTS}
            change = sum(weight * sides[k] for k, weight in _WEIGHTS.items()) / _STEP
            moved = np.concatenate([moved, -(self.rub * change)[:, None]], -1)
        by_w = (self.rub * f.slope - mass * q.slope)[:, None]
        dw = moved.imag / by_w.imag
        slopes = np.stack([(moved.real - by_w.real * dw) / kappa[:, None], dw / w[:, None]], 1)
        return Followed(kappa, w, slopes, np.abs(step) <= _FOUND * w)

    def starts(self, deltas: np.ndarray, longest: float, cutoffs: np.ndarray, count: int) -> list[np.ndarray]:
        """Devices to start from: the lowest dips over damping, delay and cut-off, where the mass is in closed form.

        By phases and by magnitudes, of which the mean is the mass. No stable wall turns its phase by more than half a
        turn over its delay. ``cutoffs`` are not looked at where the cut-off is known.
        """
        delays = np.linspace(0.0, longest, max(8, int(np.ceil(longest * self.w.max() / 0.1))) + 1)
        at = circle(self.w)
        q = NeededAnswer(deltas[:, None, None], delays[:, None]).jet(at).value
        filters = [with_cutoff(self.velocity, cutoff) for cutoff in cutoffs] if self.unknown_cutoff else [self.velocity]
        f = np.stack([one.estimate(self.period).jet(at).value for one in filters])
        away = np.log((self.kappa + self.rub * f)[:, None, None] / q)
        log_mass = away.real.mean(-1)
        cost = (away.imag**2).sum(-1) + ((away.real - log_mass[..., None]) ** 2).sum(-1)
        walled = np.pad(cost, 1, constant_values=np.inf)
        lowest = np.ones(cost.shape, bool)
        for shifts in product((0, 1, 2), repeat=3):
            around = tuple(slice(by, by + size) for by, size in zip(shifts, cost.shape, strict=True))
            lowest &= cost <= walled[around]
        dips = sorted(np.argwhere(lowest).tolist(), key=lambda place: cost[tuple(place)])[:count]
        return [
            np.array([log_mass[c, i, j], deltas[i], delays[j], np.log(cutoffs[c])][: self.unknowns]) for c, i, j in dips
        ]
