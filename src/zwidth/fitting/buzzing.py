"""Walls at the onset of buzzing as the loop has them: which K and which frequency, for a device, at a damping.

With z = e^(jw), w = 2 pi f T, a pole pair is on the circle exactly where

    K T^2 + B T F(z) = m q(z),     q = -1/G,

two real equations a wall, whatever G is. At a known B they determine w and K (docs/theory/scenes.md). A device is
looked for as ``theta = (ln m, delta, d)``, then the logarithms of an amplifier's time constant in periods and damping
ratio, and of each mode those of its frequency in radians a period and its damping ratio, and ``m/m_i``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from zwidth.fitting.device_estimate import DimensionlessDevice
from zwidth.fitting.required_wall import RequiredWall
from zwidth.fitting.structure import LAGS, RATIOS, TURNS
from zwidth.parts.circle import circle
from zwidth.parts.velocity import Estimate, Velocity
from zwidth.words.unit_system import LINEAR, UnitSystem

# Newton's steps towards w, the longest of them as a share of w, the last one's share (it squares), and the share
# beyond which w was not found.
_STEPS, _LONGEST, _ARRIVED, _FOUND = 25, 0.15, 1e-9, 1e-6
# The step of differences of fourth order, and their weights.
_STEP, _SIDES, _WEIGHTS = 1e-3, np.array([-2.0, -1.0, 1.0, 2.0]), np.array([1.0, -8.0, 8.0, -1.0]) / 12.0
# Starts of lags of each order, in periods, and of damping ratios; how many delays and frequencies are looked at, and
# how far apart the logarithms of starts lie.
_LAGS: list[list[tuple[float, ...]]] = [[()], [(0.3,), (1.0,), (3.0,)], [(0.3, 0.7), (1.0, 0.7), (3.0, 0.7)]]
_RATIOS, _DELAYS, _FREQUENCIES, _ALIKE = (0.01, 0.05, 0.3), 16, 24, 0.3


class Followed(NamedTuple):
    """kappa and w of walls, whether w was found, and what differentiates their logarithms, (n, 2, unknowns)."""

    kappa: np.ndarray
    w: np.ndarray
    found: np.ndarray
    slopes: Callable[[], np.ndarray]


@dataclass(frozen=True)
class Onsets:
    """Measured walls: ``kappa = K T^2`` in kg, ``rub = B T`` in kg, w; how the velocity was estimated; which device.

    ``lag`` is the order of its amplifier, 0 for none.
    """

    kappa: np.ndarray
    rub: np.ndarray
    w: np.ndarray
    velocity: Velocity
    period: float
    lag: int = 0
    modes: int = 0
    system: UnitSystem = LINEAR

    @cached_property
    def _estimate(self) -> Estimate:
        return self.velocity.estimate(self.period)

    @property
    def unknowns(self) -> int:
        """How many numbers are looked for."""
        return 3 + self.lag + 3 * self.modes

    def is_possible(self, theta: np.ndarray) -> bool:
        """Whether such parts are looked for."""
        ends = [LAGS, RATIOS][: self.lag] + self.modes * [TURNS, RATIOS, (0.0, np.inf)]
        low, high = np.reshape(ends, (-1, 2)).T
        parts = np.abs(np.concatenate([np.ravel(part) for part in self._read(theta)]))
        return bool(np.all((low < parts) & (parts < high)))

    def _read(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of the amplifier, and of each mode; of thetas along the first axis."""
        lag, modes = np.split(theta[3:], [self.lag])
        modes = modes.reshape(self.modes, 3, *theta.shape[1:]).copy()
        modes[:, :2] = np.exp(modes[:, :2])
        return np.exp(lag), modes

    def normalize(self, theta: np.ndarray) -> DimensionlessDevice:
        """The device of theta."""
        return DimensionlessDevice(np.exp(theta[0]), *theta[1:3], *map(list, self._read(theta)))

    def answer(self, theta: np.ndarray) -> RequiredWall:
        """What devices need, one or several along further axes of theta."""
        return RequiredWall(*self.normalize(theta)[1:])

    def follow(self, theta: np.ndarray) -> Followed:
        """The walls of theta at these dampings, w nearest to the measured ones."""
        mass, answer, estimate, w = np.exp(theta[0]), self.answer(theta), self._estimate, self.w
        step = np.full(w.shape, np.inf)
        for _ in range(_STEPS):
            at = circle(w)
            f, q = estimate.jet(at), answer.jet(at)
            rest, slope = (self.rub * f.value - mass * q.value).imag, (self.rub * f.slope - mass * q.slope).imag
            step = np.clip(-rest / slope, -_LONGEST * w, _LONGEST * w)
            w = np.minimum(w + step, 0.5 * (w + np.pi))
            # Nothing comes of a wall that is NaN.
            if not np.any(np.abs(step) > _ARRIVED * w):
                break
        at = circle(w)
        f, q = estimate.jet(at), answer.jet(at)
        kappa = (mass * q.value - self.rub * f.value).real

        def differentiate() -> np.ndarray:
            # kappa and w as theta moves: d kappa + e_w dw = m dq - rub dF with e_w = rub F' - m q'.
            rigid = answer.rigid_jet(at).value if answer.beside else q.value
            change = np.stack([q.value, *answer.moves(at, rigid)], -1)
            if answer.beside:
                # q = -1/G: what moves the mass alone counts by the square of its share.
                change[:, 1:] *= (q.value / rigid)[:, None] ** 2
                k = np.r_[1, 2, 3 : self.unknowns]
                sides = theta[:, None, None, None] + _STEP * np.eye(theta.size)[:, k, None, None] * _SIDES[:, None]
                more = np.einsum("kjn,j->nk", self.answer(sides).add(at).value, _WEIGHTS) / _STEP
                more *= (q.value**2)[:, None]
                change[:, 1:] += more[:, :2]
                change = np.concatenate([change, more[:, 2:]], -1)
            moved = mass * change
            by_w = (self.rub * f.slope - mass * q.slope)[:, None]
            dw = moved.imag / by_w.imag
            return np.stack([(moved.real - by_w.real * dw) / kappa[:, None], dw / w[:, None]], 1)

        return Followed(kappa, w, np.abs(step) <= _FOUND * w, differentiate)

    def starts(self, deltas: np.ndarray, longest: float, count: int) -> list[np.ndarray]:
        """Devices to start from: the lowest dips over damping and delay, where the mass is in closed form."""
        # By phases and by magnitudes, of which the mean is the mass. No stable wall turns its phase by more than half a
        # turn over its delay.
        from scipy.ndimage import minimum_filter

        delays = np.linspace(0.0, longest, max(8, int(np.ceil(longest * self.w.max() / 0.1))) + 1)
        at = circle(self.w)
        q = RequiredWall(deltas[:, None, None], delays[:, None]).jet(at).value
        away = np.log((self.kappa + self.rub * self._estimate.jet(at).value) / q)
        log_mass = away.real.mean(-1)
        cost = (away.imag**2).sum(-1) + ((away.real - log_mass[..., None]) ** 2).sum(-1)
        lowest = np.argwhere(cost == minimum_filter(cost, 3, mode="constant", cval=np.inf))
        dips = sorted(lowest.tolist(), key=lambda place: cost[tuple(place)])[:count]
        return [np.array([log_mass[i, j], deltas[i], delays[j]]) for i, j in dips]

    def starts_beside(self, deltas: np.ndarray, longest: float, count: int) -> list[np.ndarray]:
        """Devices with lag and modes to start from: the lowest dips over their time constants and frequencies."""
        # Where the walls have the responses ``-1/(K T^2 + B T F)``, ``1/m`` and ``1/m_i`` are linear least squares.
        delays = np.linspace(0.0, longest, _DELAYS)
        at = circle(self.w)
        wanted = -1.0 / (self.kappa + self.rub * self._estimate.jet(at).value)
        frequencies = np.geomspace(max(0.5 * self.w.min(), 1.1 * TURNS[0]), 0.9 * TURNS[1], _FREQUENCIES)
        found: list[tuple[float, np.ndarray]] = []
        for lag, ratio in product(_LAGS[self.lag], _RATIOS[: None if self.modes else 1]):
            grid = deltas[:, None, None, None], delays[:, None, None]
            mass = -1.0 / RequiredWall(*grid, lag).jet(at).value / wanted
            ringing = [(frequencies[:, None], ratio, 1.0)][: self.modes]
            mode = -1.0 / RequiredWall(*grid, lag, ringing).jet(at).value / wanted - mass
            (aa, bb, ab), (a, b) = (
                [(one * other.conj()).real.sum(-1) for one, other in ((mass, mass), (mode, mode), (mass, mode))],
                [each.real.sum(-1) for each in (mass, mode)],
            )
            with np.errstate(all="ignore"):
                share = (aa * b - ab * a) / (bb * a - ab * b) if self.modes else 0.0 * bb
                inverse = (a + share * b) / (aa + share * (2.0 * ab + share * bb))
                cost = np.where(inverse > 0, self.w.size - inverse * (a + share * b), np.inf)
            for k in range(cost.shape[2]):
                i, j = np.unravel_index(np.nanargmin(cost[:, :, k]), cost.shape[:2])
                rest = [np.log(frequencies[k]), np.log(ratio), share[i, j, k]][: 3 * self.modes]
                theta = [-np.log(inverse[i, j, k]), deltas[i], delays[j], *np.log(lag), *rest]
                found.append((float(cost[i, j, k]), np.array(theta)))
        kept: list[np.ndarray] = []
        for _, theta in sorted(found, key=lambda each: each[0]):
            if all(np.abs(theta - other)[3:].max() > _ALIKE for other in kept):
                kept.append(theta)
        return kept[:count]
