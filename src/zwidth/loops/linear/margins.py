"""Gain, phase and modulus margin of walls in any linear loop, and every crossover they are taken from.

``L = -(alpha + beta F)/q`` on the circle. The nodes of `loops.linear.boundary` resolve q and F; where the wall itself
nearly vanishes they are halved. Between neighbors |L| and its phase then hardly change: a root shows by a change of
sign, or as a dip that the tangents at both ends announce, and is polished from there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zwidth.arrays.circle import CirclePoints, Jet, circle
from zwidth.arrays.roots import bisect
from zwidth.loops.linear.roots import LoopRoots
from zwidth.loops.rigid.margins import Margins
from zwidth.words.types import Array

# Halvings beside a zero of the wall, and how much of itself the wall may change from node to node.
_HALVINGS, _SHARE = 40, 0.25
_STEPS, _CLOSED = 100, 4e-16
# A Newton step so small, of the angle, leaves an error of its own square.
_ARRIVED = 1e-10


class OpenLoop(NamedTuple):
    """One wall in one loop, on angles that resolve it."""

    loop: LoopRoots
    alpha: float
    beta: float
    w: np.ndarray
    L: Jet

    @classmethod
    def lay_out(cls, loop: LoopRoots, alpha: float, beta: float, nodes: np.ndarray) -> OpenLoop:
        """Refine the nodes of a loop for a wall."""
        w = np.append(nodes[nodes < np.pi], np.pi)
        for _ in range(_HALVINGS):
            f = loop.estimate.jet(circle(w))
            wall = np.abs(alpha + beta * f.value)
            step = np.diff(w)
            change = np.abs(beta * np.diff(f.value))
            wide = (change > _SHARE * np.maximum(wall[:-1], wall[1:])) & (step > 1e-9 * w[1:])
            if not wide.any():
                break
            w = np.sort(np.concatenate([w, w[:-1][wide] + 0.5 * step[wide]]))
        return cls(loop, alpha, beta, w, open_loop_response(loop, alpha, beta, circle(w)))

    def at(self, w: np.ndarray) -> Jet:
        """L and its derivative."""
        return open_loop_response(self.loop, self.alpha, self.beta, circle(w))

    def at_rest(self) -> float | None:
        """``L(1)`` where it is finite and not 0."""
        value = self.at(np.zeros(1)).value[0]
        return float(value.real) if np.isfinite(value) and value.real != 0 else None

    def gain_crossovers(self) -> np.ndarray:
        """Angles at which ``|L| = 1``, ascending."""

        def size(jet: Jet) -> tuple[np.ndarray, np.ndarray]:
            with np.errstate(all="ignore"):
                return np.log(np.abs(jet.value)), (jet.slope / jet.value).real

        return self._roots(size)

    def phase_crossovers(self) -> np.ndarray:
        """Angles in (0, pi) at which L is real and negative, ascending."""

        def turn(jet: Jet) -> tuple[np.ndarray, np.ndarray]:
            with np.errstate(all="ignore"):
                unit = jet.value / np.abs(jet.value)
                return unit.imag, unit.real * (jet.slope / jet.value).imag

        # At pi L is real in any case.
        found = self._roots(turn, until=-1)
        return found[self.at(found).value.real < 0]

    def _roots(self, read: Callable[[Jet], tuple[np.ndarray, np.ndarray]], until: int | None = None) -> np.ndarray:
        w, L = self.w[:until], Jet(*(part[:until] for part in self.L))
        value, slope = read(L)
        dips = self._dips(read, w, value, slope)
        if dips.size:
            w = np.sort(np.concatenate([w, dips]))
            value, slope = read(self.at(w))
        k = np.flatnonzero((value[:-1] > 0) != (value[1:] > 0))
        return polish_roots(lambda x: read(self.at(x)), w[k], w[k + 1], value[k] > 0)

    def _dips(
        self, read: Callable[[Jet], tuple[np.ndarray, np.ndarray]], w: np.ndarray, value: np.ndarray, slope: np.ndarray
    ) -> np.ndarray:
        """Lowest points between nodes of one sign from which the tangents lead to the other sign."""
        step, sign = np.diff(w), np.sign(value[:-1])
        toward = (np.sign(value[1:]) == sign) & (sign * slope[:-1] < 0) & (sign * slope[1:] > 0)
        size, fall = np.abs(value), np.abs(slope)
        # At half the rate L may be 0: no tangent of its logarithm leads anywhere from there.
        with np.errstate(invalid="ignore"):
            lowest = np.minimum(size[:-1] - fall[:-1] * step, size[1:] - fall[1:] * step)
        k = np.flatnonzero(toward & (lowest < 0))
        return bisect(lambda x: sign[k] * read(self.at(x))[1] < 0, w[k], w[k + 1]) if k.size else w[k]

    def least_distance(self) -> tuple[float, float]:
        """The least ``|1 + L|`` and its angle."""
        value, slope = 1.0 + self.L.value, self.L.slope
        distance = np.abs(value)
        rising = (value.conj() * slope).real > 0
        k = np.flatnonzero(~rising[:-1] & rising[1:])
        k = k[np.minimum(distance[k], distance[k + 1]) < 2.0 * np.nanmin(distance)]

        def nears(w: np.ndarray) -> np.ndarray:
            jet = self.at(w)
            return ~(((1.0 + jet.value).conj() * jet.slope).real > 0)

        places = np.concatenate([self.w, bisect(nears, self.w[k], self.w[k + 1]) if k.size else self.w[k]])
        distances = np.concatenate([distance, np.abs(1.0 + self.at(places[self.w.size :]).value)])
        rest = self.at_rest()
        if rest is not None:
            places, distances = np.append(places, 0.0), np.append(distances, abs(1.0 + rest))
        best = int(np.nanargmin(distances))
        return float(distances[best]), float(places[best])


def open_loop_response(loop: LoopRoots, alpha: Array, beta: Array, at: CirclePoints) -> Jet:
    """L and its derivative in w."""
    with np.errstate(all="ignore"):
        f = loop.estimate.jet(at)
        found = Jet(alpha + beta * f.value, beta * f.slope).times(loop.response(at))
        # At pi it is real.
        real = at.w >= np.pi
        return Jet(np.where(real, found.value.real + 0j, found.value), found.slope)


def polish_roots(
    read: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], low: np.ndarray, high: np.ndarray, falling: np.ndarray
) -> np.ndarray:
    """Newton's method between ends of different sign; a step that leaves them, and every fourth, is a bisection.

    `numerics.roots.newton` ends beside a crossing where L is all but 0, and with another gain margin.
    """
    x = 0.5 * (low + high)
    for step in range(_STEPS if x.size else 0):
        value, slope = read(x)
        ahead = (value > 0) == falling
        low, high = np.where(ahead, x, low), np.where(ahead, high, x)
        with np.errstate(all="ignore"):
            new = x - value / slope
        good = (new >= low) & (new <= high) & (step % 4 != 3)
        new = np.where(good, new, 0.5 * (low + high))
        done = (np.abs(new - x) <= _ARRIVED * x) & good | (high - low <= _CLOSED * x) | (value == 0)
        x = np.where(value == 0, x, new)
        if done.all():
            break
    return x


def margins_of(wall: OpenLoop, stable: bool) -> Margins:
    """The nearest crossovers, and the least distance from -1, of one wall; the delay margin is not asked for."""
    w = wall.phase_crossovers()
    places, values = list(w), list(np.abs(wall.at(w).value))
    for place, value in ((np.pi, float(wall.L.value[-1].real)), (0.0, wall.at_rest())):
        if value is not None and np.isfinite(value) and value < 0:
            places.append(place)
            values.append(-value)
    gain, phase_at = (np.inf if stable else 0.0), np.nan
    if places:
        nearest = int(np.argmin(np.abs(np.log(values))))
        gain, phase_at = 1.0 / values[nearest], places[nearest]
    crossed = wall.gain_crossovers()
    phase, gain_at = (np.inf if stable else np.nan), np.nan
    if crossed.size:
        phases: Array = np.abs(np.angle(-wall.at(crossed).value, deg=True))
        nearest = int(np.argmin(phases))
        phase, gain_at = phases[nearest] * (1.0 if stable else -1.0), crossed[nearest]
    distance, closest = wall.least_distance()
    return Margins(float(gain), float(phase), np.nan, distance, float(phase_at), float(gain_at), closest)
