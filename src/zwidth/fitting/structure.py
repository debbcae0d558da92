"""The motion of a rubbing mass with an amplifier before it and resonances beside it, under a recorded force; exact.

The amplifier and the resonances are linear, so that what they add to the motion of `zwidth.fitting.moving` is a sum
over their poles p of ``r E_p``, ``E_p' = p E_p + F(t - d)``, the force held. For an amplifier ``A = sum r_j/(s - p_j)``

    A(s)/(s (s + delta)) = 1/(s (s + delta)) + sum_j (r_j/p_j)/(p_j + delta) (1/(s - p_j) - 1/(s + delta)).

Friction alone is not linear: its turns are those of the mass whose force comes later by the amplifier's delay at low
frequencies, -A'(0), which is the same but for the bends of the force within a turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from zwidth.fitting.moving import Recording, Recordings, recur
from zwidth.fitting.scenes import scene_of
from zwidth.loops.rigid.device import phi_functions
from zwidth.parts.velocity import Velocity
from zwidth.scenes.scene import Scene

# Of theta's differences: of delta and d absolute, of all else relative.
_STEP = 1e-6
# Time constants of amplifiers in periods, frequencies in radians a period, damping ratios.
LAGS, TURNS, RATIOS = (0.02, 5.0), (0.0125, 3.11), (5e-4, 4.0)
# A double pole has no partial fractions.
_DOUBLE = 1e-5


@dataclass(frozen=True)
class StructuredRecordings(Recordings):
    """Several logs of one device with an amplifier of order ``lag`` and so many ``modes``.

    theta is ``(g, delta, d)``, the amplifier's time constant in periods (and damping ratio), of each mode the frequency
    in radians a period, the damping ratio and ``T^2/m``, then for each log x0 and v0, and two numbers of how each mode
    was moving before; o and c come last.
    """

    lag: int = 0  # pyright: ignore[reportIncompatibleVariableOverride]  (0 of every rigid mass)
    modes: int = 0  # pyright: ignore[reportIncompatibleVariableOverride]

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = super().bounds()
        ends = [LAGS, RATIOS][: self.lag] + self.modes * [TURNS, RATIOS, (-np.inf, np.inf)]
        low[self.parts], high[self.parts] = np.reshape(ends, (-1, 2)).T
        return low, high

    def predict(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        places, slopes, states = [], [], self.parts.stop + 2 * len(self.logs)
        lag, modes = range(3, 3 + self.lag), range(3 + self.lag, self.parts.stop, 3)
        for speed, log in zip(self.speeds, self.logs, strict=True):
            into = [0, 1, 2, speed - 1, speed, -2, -1]
            late, by_late = _delay(theta, self.lag, log)
            moved = log.move(*(theta[into] + np.eye(7)[2] * late).tolist())
            place, slope = moved.position, np.zeros((log.position.size, self.size))
            slope[:, into] = moved.slopes
            slope[:, lag] = moved.slopes[:, 2:3] * by_late

            # Columns times numbers of theta: where these are, and which others move the columns.
            parts = [(partial(add_lag, log=log, order=self.lag), [0], [1, 2, *lag])] if self.lag else []
            for mode in modes:
                own = [mode, mode + 1]
                parts.append((partial(_ring, log=log, order=self.lag, mode=mode), [mode + 2], [2, *lag, *own]))
                parts.append((partial(_ring_on, log=log, mode=mode), [states, states + 1], own))
                states += 2
            for function, sizes, moving in parts:
                columns = function(theta)
                place = place + columns @ theta[sizes]
                slope[:, sizes] += columns
                for k in moving:
                    slope[:, k] += _differ(function, theta, k, columns) @ theta[sizes]
            places.append(place)
            slopes.append(slope)
        return np.concatenate(places), np.concatenate(slopes)


def to_scene(model: Recordings, theta: np.ndarray, period: float, velocity: Velocity) -> Scene:
    """The scene of theta; its numbers go as `zwidth.fitting.scenes.name_numbers` names them."""
    mass, (lag, modes) = period**2 / theta[0], np.split(theta[model.parts], [model.lag])
    late = lag * [period, 1.0][: model.lag]
    ringing = modes.reshape(-1, 3) * [0.5 / (np.pi * period), 1.0, period**-2]
    ringing[:, 2] = 1.0 / ringing[:, 2]
    values = [mass, theta[1] * mass / period, theta[2] * period, *late, *ringing.ravel()]
    return scene_of(values, period, velocity, model.lag, model.modes)


def derive_numbers(model: Recordings, theta: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """The derivatives of the scene's numbers in the first ones of theta; and what power of the period each is."""
    g, delta = theta[:2]
    gains = theta[model.parts][model.lag + 2 :: 3]
    slopes = [[0.5 / (np.pi * period), 1.0, -((period / gain) ** 2)] for gain in gains.tolist()]
    by_theta = np.diag([-((period / g) ** 2), period / g, period, *[period, 1.0][: model.lag], *np.ravel(slopes)])
    by_theta[1, 0] = -delta * period / g**2
    return by_theta, np.array([2.0, 1.0, 1.0, *[1.0, 0.0][: model.lag], *model.modes * [-1.0, 0.0, 2.0]])


def add_lag(theta: np.ndarray, log: Recording, order: int) -> np.ndarray:
    """What an amplifier adds to the motion of the mass with g = 1 whose force comes later, a column."""
    delta, d = theta[1:3]
    poles, residues = amplify(theta[3 : 3 + order])
    weights = residues / poles / (poles + delta)
    ways = [np.real(weight * _follow(log, pole, d)) for pole, weight in zip(poles, weights, strict=True)]
    later = _slide(log, delta, d) - _slide(log, delta, d + _delay(theta, order, log)[0])
    return (later + sum(ways) - np.real(weights.sum() * _follow(log, -delta, d)))[:, None]


def _delay(theta: np.ndarray, order: int, log: Recording) -> tuple[float, np.ndarray]:
    """By how much an amplifier delays slow forces, and its derivatives; no more than forces are known."""
    if order == 2:
        late, by = 2.0 * theta[3] * theta[4], 2.0 * theta[[4, 3]]
    else:
        late, by = theta[3:4].sum() if order else 0.0, np.ones(order)
    most = log.skip - 1.5 - theta[2]
    return (float(late), by) if late < most else (float(most), 0.0 * by)


def _ring(theta: np.ndarray, log: Recording, order: int, mode: int) -> np.ndarray:
    """What a mode with ``T^2/m = 1`` adds, behind the amplifier, a column."""
    own = find_roots(*theta[mode : mode + 2])
    poles, residues = amplify(theta[3 : 3 + order])
    place = np.zeros(log.position.size)
    for pole, residue in zip(poles, residues, strict=True):
        place += (residue / np.prod(pole - own) * _follow(log, pole, theta[2])).real
    for pole, other in (own, own[::-1]):
        gain = np.sum(residues / (pole - poles)) if order else 1.0
        place += (gain / (pole - other) * _follow(log, pole, theta[2])).real
    return place[:, None]


def _ring_on(theta: np.ndarray, log: Recording, mode: int) -> np.ndarray:
    """How a mode moves that did so before, two columns."""
    own, other = np.exp(np.arange(log.position.size)[:, None] * find_roots(*theta[mode : mode + 2])).T
    return np.stack([own.real, own.imag if own.imag.any() else other.real], -1)


def amplify(lag: Sequence[Any] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poles and residues of A, along the first axis, by its time constant and damping ratio; none without them."""
    if len(lag) == 0:
        return np.zeros(0), np.zeros(0)
    poles = find_roots(1.0 / lag[0], lag[1]) if len(lag) == 2 else np.array([-1.0 / lag[0] + 0j])
    return poles, np.prod(-poles, 0) / (poles - poles[::-1] if len(lag) == 2 else np.ones_like(poles))


def find_roots(w: Any, ratio: Any) -> np.ndarray:
    """Of ``s^2 + 2 zeta w s + w^2``, along the first axis; a double one is parted a little."""
    inside = ratio**2 - 1.0
    root = np.sqrt(np.where(np.abs(inside) > _DOUBLE, inside, _DOUBLE) + 0j)
    return np.array([w * (-ratio + root), w * (-ratio - root)])


def _differ(function: Callable[[np.ndarray], np.ndarray], theta: np.ndarray, k: int, columns: np.ndarray) -> np.ndarray:
    """The derivative in one number of theta, of which the columns are known."""
    step = np.zeros(theta.size)
    step[k] = _STEP * max(abs(float(theta[k])), 1.0 if k < 3 else 0.0)
    return (function(theta + step) - columns) / step[k]


def _follow(log: Recording, pole: complex, d: float) -> np.ndarray:
    """``E_p`` at the positions, from rest at the log's first sample."""
    whole = int(np.floor(d))
    f, pole, force = d - whole, complex(pole), np.append([0.0, 0.0], _prolong(log))
    late, first = _held(pole, f) * np.exp(pole * (1.0 - f)), _held(pole, 1.0 - f)
    moved = recur(np.exp(pole), first * force[1:-1] + late * force[:-2])
    return moved[log.skip - whole :][: log.position.size]


def _held(pole: complex, time: float) -> complex:
    """``(e^(p t) - 1)/p``."""
    return np.expm1(pole * time) / pole if pole else time + 0j


def _slide(log: Recording, delta: float, d: float) -> np.ndarray:
    """The way of a mass with g = 1 and no friction from the first position on."""
    whole = int(np.floor(d))
    f, now = d - whole, np.arange(log.skip, log.skip + log.position.size - 1) - whole
    spans = np.array([f, 1.0 - f, 1.0])
    both = phi_functions(delta * spans)
    reach, way = both.phi1 * spans, both.phi2 * spans**2
    speed, force = np.real(_follow(log, -delta, d))[:-1], _prolong(log)
    steps = reach[2] * speed + (way[0] + reach[0] * reach[1]) * force[now - 1] + way[1] * force[now]
    return np.concatenate([[0.0], np.cumsum(steps)])


def _prolong(log: Recording) -> np.ndarray:
    """The forces, and two more: a search may pass delays of a period less than none."""
    return np.append(log.force, 2 * [log.force[-1]])
