"""The critical controller of a device, which puts a pole on the unit circle: ``K + B F(z)/T = q(z)``, ``q = -1/G``.

The lag and the modes add to the response of the mass a sum over their poles p of ``r h(p; z)``: the response of
``E' = p E + F`` to a held force with the delay d = n + f. With zeta = z - 1:

    h = (zeta (e^((1 - f) p) - 1) + e^p - 1)/(p (zeta + 1 - e^p) z^(n + 1))

A row of walls of one damping ends at its first crossing: the smallest K > 0 at which a pole reaches the unit circle,
from K -> 0+, where it is stable for all B below the first that puts a pole on the circle there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from zwidth.arrays.held_mass import Plant, discretize_mass, split_delay
from zwidth.loops.rigid.ridge import plant_slopes
from zwidth.parts.circle import CirclePoints, Jet
from zwidth.words.types import Array

# Poles closer than this are moved apart, because partial fractions require distinct poles.
_DOUBLE = 1e-5
# Dampings of a column, as shares of its end, then refined so often.
_DAMPINGS, _REFINED, _TIMES = 33, 9, 3


class RequiredWall:
    """``q = -1/G`` of devices; the arguments are arrays that broadcast with the frequencies.

    A rigid device has ``q = -z^n (z - 1)(z - c)/(a2 z + a1 + a0/z)``. ``lag`` contains the time constant of the
    actuator in periods and, for second order, its damping ratio; ``modes`` frequencies in rad per sample, damping
    ratios and mass ratios ``m/m_i``.
    """

    def __init__(self, delta: Any, d: Any, lag: Sequence[Any] = (), modes: Sequence[Sequence[Any]] = ()) -> None:
        """Compute the quantities that do not depend on the frequency."""
        self.whole, fraction = split_delay(np.asarray(d, float))
        self.delta, self.fraction = delta, fraction
        poles, residues = list_poles(delta, lag, modes)
        self.beside = len(poles) > 0
        if poles:
            both = np.array(np.broadcast_arrays(fraction + np.zeros(1), *poles, *residues)[1:], complex)
            poles, self.residues = np.where(both[: len(poles)] == 0, 1e-300, both[: len(poles)]), both[len(poles) :]
            self.turns, self.full = np.expm1(poles), np.expm1(poles) / poles
            self.late = np.expm1((1.0 - fraction) * poles) / poles

    @cached_property
    def plant(self) -> Plant:
        """The rigid mass."""
        return discretize_mass(self.delta, self.fraction)

    def value(self, at: CirclePoints) -> Array:
        """Return q."""
        rigid = self.jet(at).value
        return rigid / (1.0 - rigid * self.add(at)) if self.beside else rigid

    def jet(self, at: CirclePoints) -> Jet:
        """Return q of the rigid mass and its derivative in w."""
        plant, turn = self.plant, 1j * at.z
        total, below = _answer(plant, at), at.before + plant.em
        q = -np.exp(1j * self.whole * at.w) * at.before * below / total
        slopes = turn / at.before + turn / below - 1j * (plant.a2 * at.z - plant.a0 / at.z) / total
        return Jet(q, q * (1j * self.whole + slopes))

    def add(self, at: CirclePoints) -> Array:
        """Return the part of the frequency response that is due to lag and modes."""
        above, below = at.before * self.late + self.full, at.before - self.turns
        return (self.residues * (np.exp(-1j * (self.whole + 1.0) * at.w) * above / below)).sum(0)

    def moves(self, at: CirclePoints, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of q of the rigid mass with respect to delta and d."""
        by_delta, by_fraction = plant_slopes(self.delta, self.fraction)
        total = _answer(self.plant, at)
        return (
            q * (by_delta.em / (at.before + self.plant.em) - _answer(by_delta, at) / total),
            -q * _answer(by_fraction, at) / total,
        )


def _answer(plant: Any, at: CirclePoints) -> Any:
    return plant.a2 * at.z + plant.a1 + plant.a0 / at.z


def list_poles(delta: Any, lag: Any, modes: Any) -> tuple[list[Any], list[Any]]:
    """Poles and residues of ``A(s) (1/(s (s + delta)) + sum of modes)`` but for ``1/(s (s + delta))``."""
    # Those of the amplifier, -delta behind one, and two of each mode: frequency, damping ratio and ``m/m_i``.
    late, gains = (list(each) for each in _amplify(lag))
    poles, weights = list(late), [gain / pole / (pole + delta) for pole, gain in zip(late, gains, strict=True)]
    if late:
        poles, weights = [*poles, -delta + 0j], [*weights, -sum(weights)]
    for turns, ratio, share in modes:
        own = _find_roots(turns, ratio)
        for k, (pole, gain) in enumerate(zip(late, gains, strict=True)):
            weights[k] = weights[k] + share * gain / (pole - own[0]) / (pole - own[1])
        for pole, other in (own, own[::-1]):
            poles.append(pole)
            behind = sum(gain / (pole - each) for each, gain in zip(late, gains, strict=True)) if late else 1.0
            weights.append(share * behind / (pole - other))
    return poles, weights


def _amplify(lag: Sequence[Any] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poles and residues of A, along the first axis, by its time constant and damping ratio; none without them."""
    if len(lag) == 0:
        return np.zeros(0), np.zeros(0)
    poles = _find_roots(1.0 / lag[0], lag[1]) if len(lag) == 2 else np.array([-1.0 / lag[0] + 0j])
    return poles, np.prod(-poles, 0) / (poles - poles[::-1] if len(lag) == 2 else np.ones_like(poles))


def _find_roots(w: Any, ratio: Any) -> np.ndarray:
    """Of ``s^2 + 2 zeta w s + w^2``, along the first axis; a double one is parted a little."""
    inside = ratio**2 - 1.0
    root = np.sqrt(np.where(np.abs(inside) > _DOUBLE, inside, _DOUBLE) + 0j)
    return np.array([w * (-ratio + root), w * (-ratio - root)])


@dataclass(frozen=True)
class DeviceRows:
    """Devices with ``needed`` q in N/m, a row each over frequencies, and F/T in 1/s, a row for all or for each."""

    needed: Array
    velocity: Array

    @cached_property
    def ends(self) -> np.ndarray:
        """Up to which damping soft walls are stable; inf where that is nowhere."""
        return _cross_first(self.needed * self.velocity.conj(), self.needed / self.velocity)

    def row_ends(self, virtual_damping: np.ndarray) -> np.ndarray:
        """Up to which stiffness every softer wall is stable, at one damping or at one for each device."""
        wall = self.needed - np.reshape(virtual_damping, (-1, 1)) * self.velocity
        ends = _cross_first(wall, wall)
        # A slower crossing than the grid's slowest, or no end at all, is not believed.
        real = (wall.imag[:, 0] < 0) & (virtual_damping < self.ends) & np.isfinite(ends)
        return np.where(real, ends, 0.0)

    def stiffest(self) -> np.ndarray:
        """K_max of each device, of walls with B >= 0 alone."""
        return find_highest(self.row_ends, np.where(np.isfinite(self.ends), self.ends, 0.0))[0]


def find_highest(limit: Callable[[np.ndarray], np.ndarray], top: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The highest limits over dampings from 0 to ``top``, and these dampings, all elementwise."""
    middle = width = limits = 0.5 * top
    for count in (_DAMPINGS, *_TIMES * [_REFINED]):
        tried = np.clip(middle + width * np.linspace(-1.0, 1.0, count)[:, None], 0.0, top)
        limits = np.array([limit(damping) for damping in tried])
        middle = np.take_along_axis(tried, limits.argmax(0)[None], 0)[0]
        width = 2.0 * width / (count - 1)
    return limits.max(0), middle


@np.errstate(all="ignore")
def _cross_first(turning: Array, value: Array) -> np.ndarray:
    """The smallest real part > 0 of ``value`` where ``turning`` is real; inf where there is none."""
    left, right = turning.imag[:, :-1], turning.imag[:, 1:]
    share = np.where(left == right, 0.0, left / (left - right))
    between = value.real[:, :-1] + share * (value.real[:, 1:] - value.real[:, :-1])
    crossed = (left * right <= 0) & (between > 0)
    first = np.where(crossed, between, np.inf).min(1)
    last = value.real[:, -1]
    return np.where((last > 0) & np.isfinite(last), np.minimum(first, last), first)
