"""A measured response as a curve, and how far from it the true one may be (docs/theory/measured.md, M2 to M8).

With ``u = |z - 1|^2`` and ``S = u G`` the closed loop is decided by ``X = u (1 + H G) = u + alpha S + beta F S``, which
winds around 0 as ``1 + H G`` does, and stays of one size where the device moves like a mass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from zwidth.arrays.circle import circle
from zwidth.parts.velocity import Estimate
from zwidth.words.errors import InputError

# The least damping ratio that a resonance between two lines is taken to have.
LEAST_DAMPING_RATIO = 0.005
# What a resonance half-way between two lines, d apart, adds at its top, over the second difference that it leaves at
# them: d/(2 zeta f) times 1/(2 + 2/3).
_SEEN = 16.0 / 3.0
# Of a smooth curve a chord misses an eighth of the second difference; twice that.
_SMOOTH = 0.25
# A turn of the response between two lines, in rad, beyond which nothing between them is known.
MOST_TURN = 0.5
# By what share of itself the curve may change between points, and how many are laid between two lines at most.
_STEP, _MOST = 0.005, 32
# By what the first line's phase may miss those of a mass, a damper or a spring, told apart by so many lines or more.
_PHASE, _FIRST = 0.8, 4
# Beyond the last line the response is at most so many times that of the lines from this share of the band on, unless it
# has risen there by so much against a mass: then a resonance is in sight, and nothing is known.
_BEYOND, _LAST, _RISEN = 2.0, 0.8, 1.2
_ACROSS = 65


@dataclass(frozen=True)
class ResponseCurve:
    """Points of the curve, laid so densely that chords serve; in units of the period and of the scene's mass."""

    w: np.ndarray
    u: np.ndarray  # |z - 1|^2
    S: np.ndarray  # u G
    F: np.ndarray  # the velocity estimate
    band: np.ndarray  # radius of S by the deviation of the lines
    gap: np.ndarray  # radius of S by what may be between the lines
    weakest: float  # |G| at the first line, at least, and below it
    strongest: float  # |G| beyond the last line, at most
    slow: float  # |F| below the first line, at most
    fast: float  # |F| beyond the last line, at most
    odd: bool  # whether the first line moves like neither mass, damper nor spring

    @property
    def radius(self) -> np.ndarray:
        """How far S may be from the curve."""
        return self.band + self.gap

    def at(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """S and F at other angles, by straight lines; NaN beyond the ends."""

        def between(values: np.ndarray) -> np.ndarray:
            return np.interp(w, self.w, values, np.nan, np.nan)

        parts = (self.S, self.F)
        S, F = (between(np.real(part)) + 1j * between(np.imag(part)) for part in parts)
        return S, F

    @classmethod
    def lay_out(cls, device: Any, period: float, stiffness: float, estimate: Estimate) -> ResponseCurve:
        """The curve of a `MeasuredDevice` at a period, its response times the unit of stiffness."""
        w = 2.0 * np.pi * device.frequency * period
        if w[-1] >= np.pi:
            raise InputError(
                f"frequency: got {device.frequency[-1]:g} Hz at a period of {period:g} s; a controller sees less than "
                f"half its rate, {0.5 / period:g} Hz: leave the lines above out, or correct the period"
            )
        G = device.response * stiffness
        r = np.zeros(w.size) if device.deviation is None else device.deviation * stiffness
        u = _square(w)
        S, R = u * G, u * r
        E = _gaps(w, S)
        # By what share the curve changes from line to line, beyond what its deviation explains.
        change = np.maximum(np.abs(np.diff(S)) - 2.0 * (R[1:] + R[:-1]), 0.0)
        change = change / (np.maximum(np.abs(S[1:]), np.abs(S[:-1])) + 1e-300)
        count = np.maximum(2.0 * np.diff(w) / w[1:], change) / _STEP
        count = np.clip(np.ceil(count), 1, _MOST).astype(int)
        line = np.repeat(np.arange(w.size - 1), count)
        share = (np.arange(line.size) - np.repeat(np.cumsum(count) - count, count)) / count[line]
        step = np.diff(w)[line]
        at = np.append(w[line] + share * step, w[-1])
        slope = np.gradient(S, w)
        # Cubic between two lines, with the slopes of their neighbors.
        t = share
        inner = (1 + 2 * t) * (1 - t) ** 2 * S[line] + t * (1 - t) ** 2 * step * slope[line]
        inner += t * t * (3 - 2 * t) * S[line + 1] + t * t * (t - 1) * step * slope[line + 1]
        F = estimate.jet(circle(at)).value
        band, gap = np.append(np.maximum(R[:-1], R[1:])[line], R[-1]), np.append(E[line], E[-1])
        starts = np.flatnonzero(share == 0)[1:]
        for values in (band, gap):
            values[starts] = np.maximum(values[starts], values[starts - 1])
        below, above = np.linspace(0.0, w[0], _ACROSS), np.linspace(w[-1], np.pi, _ACROSS)
        slow, fast = (float(np.abs(estimate.jet(circle(part)).value).max()) for part in (below, above))
        return cls(
            at, _square(at), np.append(inner, S[-1]), F, band, gap,
            float(abs(G[0]) - r[0]), _bound_beyond(w, np.abs(G), r), slow, fast,
            _is_odd(w, G, r),
        )  # fmt: skip


def _square(w: np.ndarray) -> np.ndarray:
    """``|z - 1|^2``."""
    return 4.0 * np.sin(0.5 * w) ** 2


def _is_odd(w: np.ndarray, G: np.ndarray, r: np.ndarray) -> bool:
    """Whether the first line moves like neither mass, damper nor spring: a quarter turn behind for each power of w."""
    few = min(w.size, max(_FIRST, int(np.sum(w <= 1.5 * w[0]))))
    if r[0] >= abs(G[0]) or not np.all(G[:few]):
        return True
    power = np.polyfit(np.log(w[:few]), np.log(np.abs(G[:few])), 1)[0]
    phase, uncertain = np.angle(1j * G[0]) - 0.5 * np.pi, np.arcsin(np.minimum(r[:few] / np.abs(G[:few]), 1.0))
    away = abs(phase - 0.5 * np.pi * np.clip(power, -2.0, 0.0)) + uncertain[0]
    # Whole turns of a long delay are in no phase, but in how it turns from line to line.
    share = w[:few] - np.mean(w[:few])
    share *= w[0] / np.sum(share**2)
    turned = abs(share @ np.unwrap(np.angle(G[:few]))) + np.abs(share) @ uncertain
    return bool(max(away, turned) > _PHASE)


def _bound_beyond(w: np.ndarray, size: np.ndarray, r: np.ndarray) -> float:
    """The largest |G| beyond the last line, by means that noise only raises; infinite with a resonance in sight."""
    last = np.flatnonzero(w >= _LAST * w[-1])
    u, few = _square(w), max(1, last.size // 4)
    first, final = (float(np.median((u * size)[part])) for part in (last[:few], last[-few:]))
    room = float(np.median((u * r)[last]))
    if final - room > _RISEN * (first + room):
        return np.inf
    halves = (part for part in np.array_split(last, 2) if part.size)
    return _BEYOND * max(float(np.sqrt(np.mean(size[part] ** 2))) for part in halves)


def _gaps(w: np.ndarray, S: np.ndarray) -> np.ndarray:
    """How far the true curve may be from the interpolated one between each two lines."""
    step, chord = np.diff(w), np.diff(S)
    bend = np.abs(2.0 * np.diff(chord / step) / (step[1:] + step[:-1]))
    bend = np.maximum(np.append(bend[:1], bend), np.append(bend, bend[-1:])) * step**2
    share = 2.0 * step / (w[1:] + w[:-1])
    gap = bend * np.maximum(_SMOOTH, share / (_SEEN * LEAST_DAMPING_RATIO))
    with np.errstate(all="ignore"):
        turn = np.abs(np.angle(S[1:] / S[:-1]))
    return np.where(turn > MOST_TURN, np.maximum(gap, np.abs(chord)), gap)
