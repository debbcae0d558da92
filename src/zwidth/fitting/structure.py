"""The motion of a rubbing mass with an amplifier before it and resonances beside it, under a recorded force; exact.

The amplifier and the resonances are linear, so that what they add to the motion of `zwidth.fitting.moving` is a sum
over their poles p of ``r E_p``, ``E_p' = p E_p + F(t - d)``, the force held. For an amplifier ``A = sum r_j/(s - p_j)``

    A(s)/(s (s + delta)) = 1/(s (s + delta)) + sum_j (r_j/p_j)/(p_j + delta) (1/(s - p_j) - 1/(s + delta)).

So are the derivatives: in the pole E_p is filtered once more, and a force that comes later moves it by ``-E_p'``.

Friction alone is not linear: its turns are those of the mass whose force comes later by the amplifier's delay at low
frequencies, -A'(0), which is the same but for the bends of the force within a turn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from zwidth.arrays.held_mass import phi_functions
from zwidth.fitting.device_estimate import DimensionlessDevice
from zwidth.fitting.encoder import MeasurementNoise
from zwidth.fitting.moving import ModelledMotion, Recording, recur
from zwidth.fitting.required_wall import list_poles

# Of differences to both sides: of delta and of a followed pole absolute, of all else relative.
_STEP = 1e-6
# Time constants of amplifiers in periods, frequencies in radians a period, damping ratios.
LAGS, TURNS, RATIOS = (0.02, 5.0), (0.0125, 3.11), (1e-6, 4.0)
# The delays at low frequencies of those of second order.
_SLOW = 2.0 * RATIOS[0] * LAGS[0], 2.0 * LAGS[1]


@dataclass(frozen=True)
class Recordings:
    """Several logs of one device with an amplifier of order ``lag``, 0 for none, and so many ``modes``.

    theta is ``(g, delta, d)``, the amplifier's delay at low frequencies in periods (and damping ratio), of each mode
    the frequency in radians a period, the damping ratio and ``T^2/m``, then for each log x0 and v0, and two numbers of
    how each mode was moving before; o and c come last. The delay of second order, ``2 zeta tau``, stands in place of
    tau: a log tells its sum with d far better than either, and along a straight valley steps are long.

    ``longest`` is the longest delay that is looked for, in periods, ``resolution`` the encoder's step, 0 for none.
    """

    logs: tuple[Recording, ...]
    noise: MeasurementNoise | None = None
    lag: int = 0
    modes: int = 0
    longest: float = 20.0
    resolution: float = 0.0

    def weigh(self, columns: np.ndarray) -> np.ndarray:
        """Columns over samples, as `MeasurementNoise.weigh` where the noise is known."""
        return columns if self.noise is None else self.noise.weigh(columns)

    def begin(self, count: int) -> Recordings:
        """Of each log so many first positions."""
        return replace(self, logs=tuple(log.begin(count) for log in self.logs), noise=None)

    @property
    def measured(self) -> np.ndarray:
        """All positions that count."""
        return np.concatenate([log.position for log in self.logs])

    def split(self, column: np.ndarray) -> list[np.ndarray]:
        """What of a column over samples belongs to each log."""
        return np.split(column, np.cumsum([log.position.size for log in self.logs])[:-1])

    @property
    def size(self) -> int:
        """How many numbers theta has."""
        return self.parts.stop + 2 + 2 * (1 + self.modes) * len(self.logs)

    @property
    def parts(self) -> slice:
        """Where in theta the numbers of amplifier and modes are."""
        return slice(3, 3 + self.lag + 3 * self.modes)

    @property
    def speeds(self) -> np.ndarray:
        """Where in theta the first speeds are."""
        return self.parts.stop + 1 + 2 * np.arange(len(self.logs))

    @property
    def largest(self) -> float:
        """The largest force commanded."""
        return max(float(np.abs(log.force).max()) for log in self.logs)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the largest that each number of theta may be."""
        low, high = np.full((2, self.size), [[-np.inf], [np.inf]])
        ends = [LAGS if self.lag == 1 else _SLOW, RATIOS][: self.lag] + self.modes * [TURNS, RATIOS, (-np.inf, np.inf)]
        low[self.parts], high[self.parts] = np.reshape(ends, (-1, 2)).T
        # A little beyond 0 the model goes on, so that an optimum at 0 is no corner.
        count = max(log.force.size for log in self.logs)
        # No faster than the fastest lag, whose pole it would meet there.
        low[1:3], high[1:3] = (-5.0 / count, -1.0), (0.99 / LAGS[0], self.longest)
        return low, high

    def normalize(self, theta: np.ndarray, period: Any) -> DimensionlessDevice:
        """The device of theta, or those of thetas along the first axis."""
        modes = theta[self.parts][self.lag :].reshape(self.modes, 3, *theta.shape[1:]).copy()
        modes[:, 2] /= theta[0]
        lag = theta[3 : 3 + self.lag].copy()
        lag[:1] /= 2.0 * lag[1] if self.lag == 2 else 1.0
        return DimensionlessDevice(period**2 / theta[0], theta[1], theta[2], lag, modes)

    def follow(self, theta: np.ndarray) -> ModelledMotion:
        """The motion of theta in all logs."""
        each = [self.follow_log(theta, k) for k in range(len(self.logs))]
        place = np.concatenate([motion.position for motion in each])
        return ModelledMotion(place, lambda: np.concatenate([motion.slopes for motion in each]))

    def follow_log(self, theta: np.ndarray, which: int) -> ModelledMotion:
        """The motion in one of them."""
        late, by_late = _delay(theta, self.lag, self.logs[which])
        speed = self.speeds[which]
        into = np.array([0, 1, 2, speed - 1, speed, -2, -1])
        rigid = self.logs[which].move(*(theta[into] + late * np.eye(7)[2]).tolist())
        beside = self.add_parts(theta, which) if self.lag or self.modes else None

        def differentiate() -> np.ndarray:
            slopes = np.zeros((theta.size, rigid.position.size)).T
            slopes[:, into] = rigid.slopes
            if beside is not None:
                slopes += beside.slopes
                slopes[:, 3 : 3 + self.lag] += np.outer(rigid.slopes[:, 2], by_late)
            return slopes

        return ModelledMotion(rigid.position if beside is None else rigid.position + beside.position, differentiate)

    def add_parts(self, theta: np.ndarray, which: int) -> ModelledMotion:
        """What amplifier and modes add in one log to the mass whose force comes later."""
        log, (g, delta, d) = self.logs[which], theta[:3].tolist()
        own, now, place = np.eye(theta.size), np.arange(log.position.size), np.zeros(log.position.size)
        poles, weights, states = self._find_poles(theta[:, None])
        first, ways, ringing, slides = self.parts.stop + 2 * (len(self.logs) + self.modes * which), {}, [], []
        poles, weights = poles[:, 0].tolist(), weights[:, 0]
        for own_pole, (pole, weight, k) in enumerate(zip(poles, weights, states, strict=True)):
            ways[pole] = _follow(log, pole, d)
            place += (weight * ways[pole].position).real
            if k >= 0:
                # How a mode moves that did so before: by two real poles, or the real and imaginary part of one.
                free = own[first + k] - 1j * own[first + k + 1] if pole.imag else own[first + k]
                motion, size = np.exp(pole * now), free @ theta
                place += (motion * size).real
                ringing.append((own_pole, motion, free, size))
        if self.lag:
            late, by_late = _delay(theta, self.lag, log)
            turn = own[2] + by_late @ own[3 : 3 + self.lag]
            for sign, by, there in ((g, own[2], d), (-g, turn, d + late)):
                speed = ways[-delta] if there == d else _follow(log, -delta, there)
                slide = _slide(log, delta, there, speed)
                place += sign * slide.position
                slides.append((sign, by, speed.position, slide))

        def differentiate() -> np.ndarray:
            # Rows, and how their real parts count in the slopes. A delay moves E by -E' = -p E - F.
            moved = log.pushes[0, log.skip - int(np.floor(d)) + now]
            parts: list[tuple[Any, Any]] = [(moved, -own[2] * weights.sum())]
            by_theta, slopes = self._differ_poles(theta)
            for pole, weight, by, slope in zip(poles, weights, by_theta, slopes, strict=True):
                way = ways[pole]
                parts += [(way.position, slope - pole * weight * own[2]), (way.slopes, weight * by)]
            for k, motion, free, size in ringing:
                parts += [(motion, free), (now * motion, size * by_theta[k])]
            for sign, by, speed, slide in slides:
                parts += [(slide.position, sign / g * own[0]), (slide.slopes, sign * own[1])]
                parts += [(speed[0] - speed, sign * by)]
            rows = [(row.real, factor.real) for row, factor in parts]
            rows += [(row.imag, -factor.imag) for row, factor in parts if np.iscomplexobj(row)]
            columns, factors = map(np.array, zip(*rows, strict=True))
            return columns.T @ factors

        return ModelledMotion(place, differentiate)

    def _find_poles(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of thetas by the first axis: poles on and above the real axis, weights, and which state of modes, or -1."""
        device = self.normalize(at, 1.0)
        poles, weights = (np.array(each) for each in list_poles(device.delta, device.lag, device.modes))
        states, height = np.maximum(np.arange(-len(poles), 0) + 2 * self.modes, -1), np.imag(poles[:, 0])
        # Of a pair half is followed, which counts twice.
        weights = weights * at[0] * (1.0 + (height > 0))[:, None]
        return poles[height >= 0], weights[height >= 0], states[height >= 0]

    def _differ_poles(self, theta: np.ndarray) -> np.ndarray:
        """The slopes of these poles, and of their weights."""
        moving = np.r_[0, 1, self.parts]
        steps, count = _STEP * np.abs(theta[moving]), moving.size
        steps[1], steps[4 + self.lag :: 3] = max(_STEP, steps[1]), steps[0]
        at = np.tile(theta[:, None], 1 + 2 * count)
        at[moving, 1 + np.arange(count)] += steps
        at[moving, 1 + count + np.arange(count)] -= steps
        both = np.array(self._find_poles(at)[:2])
        by_theta = np.zeros((*both.shape[:2], theta.size), complex)
        by_theta[..., moving] = (both[..., 1 : 1 + count] - both[..., 1 + count :]) / (2.0 * steps)
        return by_theta


def _delay(theta: np.ndarray, order: int, log: Recording) -> tuple[float, np.ndarray]:
    """By how much an amplifier delays slow forces, and its derivatives; no more than forces are known."""
    late, by = theta[3:4].sum() if order else 0.0, np.eye(2)[0, :order]
    most = log.skip - 1.5 - theta[2]
    return (float(late), by) if late < most else (float(most), 0.0 * by)


def _follow(log: Recording, pole: complex, d: float) -> ModelledMotion:
    """``E_p`` at the positions, from rest at the log's first sample; its slope is that in p."""
    whole = int(np.floor(d))
    f, pole, first = d - whole, pole if pole.imag else pole.real, log.skip - whole
    seen = slice(first, first + log.position.size)
    # What a new force and the older one move until a sample, and a little beside the pole.
    at = pole + _STEP * np.array([[0.0], [1.0], [-1.0]])
    at = np.where(at == 0, 1e-300, at)
    held = np.expm1(np.array([1.0 - f, f]) * at) / at * np.exp([0.0, 1.0 - f] * at)
    turn = np.exp(pole)
    ways = recur(turn, held[0] @ log.pushes)

    def differentiate() -> np.ndarray:
        moves = (held[1] - held[2]) * 0.5 / _STEP @ log.pushes
        moves[1:] += turn * ways[:-1]
        return recur(turn, moves)[seen]

    return ModelledMotion(ways[seen], differentiate)


def _slide(log: Recording, delta: float, d: float, speed: ModelledMotion) -> ModelledMotion:
    """The way of a mass with g = 1 and no friction from the first position on; its slope is that in delta."""
    whole = int(np.floor(d))
    spans, now = np.array([d - whole, 1.0 - d + whole, 1.0]), log.skip - whole
    at = phi_functions((delta + _STEP * np.array([[0.0], [1.0], [-1.0]])) * spans)
    reach, way = (at.phi1 * spans).T, (at.phi2 * spans**2).T
    factors = np.array([reach[2], way[0] + reach[0] * reach[1], way[1]])
    terms = np.vstack([speed.position[:-1], log.pushes[::-1, now + 1 : now + log.position.size]])

    def differentiate() -> np.ndarray:
        steps = 0.5 / _STEP * (factors[:, 1] - factors[:, 2]) @ terms - factors[0, 0] * speed.slopes[:-1]
        return np.append(0.0, np.cumsum(steps))

    return ModelledMotion(np.append(0.0, np.cumsum(factors[:, 0] @ terms)), differentiate)
