"""Gain, phase, modulus and delay margin of walls in any linear loop, and every crossover they are taken from.

``L = -(alpha + beta F)/q`` on the circle. The nodes of `loops.linear.boundary` resolve q and F; where the wall itself
nearly vanishes they are halved. Between neighbors |L| and its phase then hardly change: a root shows by a change of
sign, or as a dip that the tangents at both ends announce, and is polished from there.

One period more of delay changes nothing but the phase of L, by the angle w itself: at a gain crossover of phase
``p = arg(-L)`` a pole is on the circle m periods later if ``p - m w`` is a multiple of 2 pi. So the loops of delays
within one period serve all longer ones: where m passes a whole number from one of them to the next, the delay is found
by Newton's method, each step with the exact loop of its own. Real poles come to z = -1 where ``|L(-1)|`` passes 1.
Poles counted before and beyond must confirm the first of these delays.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from dataclasses import replace
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from zwidth.arrays.roots import zeros_between
from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.curve import nodes_of
from zwidth.loops.linear.held import find_roots
from zwidth.loops.linear.poles import log_radius
from zwidth.loops.linear.roots import LoopRoots
from zwidth.loops.linear.rows import label_walls
from zwidth.parts.chain import AnyChain
from zwidth.parts.circle import CirclePoints, Jet, circle
from zwidth.words.quantities import WALL_RANGE
from zwidth.words.results import Margins
from zwidth.words.types import Array
from zwidth.words.xp import within

# Halvings beside a zero of the wall, and how much of itself the wall may change from node to node.
_HALVINGS, _SHARE = 40, 0.25
# The offset from z = 1 of a pole there.
_AT_ONE = 1e-13
# An L so small, as a share of what it changes by over w, is a zero of it.
_NOTHING = 1e-10


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
        free = int(np.count_nonzero(np.abs(loop.poles) <= _AT_ONE))
        soft = abs(alpha * loop.response(circle(w[:1])).value[0])
        if free and 0.0 < soft < 1.0:
            # To a free device L has no end towards w = 0: that of a soft wall passes 1 below all nodes.
            most = 1.0 - np.log2(soft) / free
            w = np.concatenate([w[0] * np.exp2(-np.linspace(most, 1.0, int(np.ceil(most)))), w])
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
        """Angles in (0, pi] at which L is real and negative, ascending."""

        def turn(jet: Jet) -> tuple[np.ndarray, np.ndarray]:
            with np.errstate(all="ignore"):
                unit = jet.value / np.abs(jet.value)
                return unit.imag, unit.real * (jet.slope / jet.value).imag

        # At pi L is real in any case.
        found = np.append(self._roots(turn, until=-1), np.pi)
        L = self.at(found)
        # Where L passes through 0 its phase jumps, and no factor brings a pole there.
        return found[(L.value.real < 0) & (np.abs(L.value) > _NOTHING * found * np.abs(L.slope))]

    def _roots(self, read: Callable[[Jet], tuple[np.ndarray, np.ndarray]], until: int | None = None) -> np.ndarray:
        w, L = self.w[:until], Jet(*(part[:until] for part in self.L))
        value, slope = read(L)
        dips = self._dips(read, w, value, slope)
        if dips.size:
            w = np.sort(np.concatenate([w, dips]))
            value, slope = read(self.at(w))
        k = np.flatnonzero((value[:-1] > 0) != (value[1:] > 0))
        return zeros_between(lambda at: read(self.at(at))[0], w, value, k)

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
        return zeros_between(lambda at: read(self.at(at))[1], w, slope, k)

    def least_distance(self) -> tuple[float, float]:
        """The least ``|1 + L|`` and its angle."""

        def slope(jet: Jet) -> np.ndarray:
            return ((1.0 + jet.value).conj() * jet.slope).real

        distance, rising = np.abs(1.0 + self.L.value), np.nan_to_num(slope(self.L))
        k = np.flatnonzero((rising[:-1] <= 0) & (rising[1:] > 0))
        k = k[np.minimum(distance[k], distance[k + 1]) < 2.0 * np.nanmin(distance)]
        places = np.concatenate([self.w, zeros_between(lambda at: slope(self.at(at)), self.w, rising, k)])
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


def margins_of(wall: OpenLoop, stable: bool, wanted: Container[str]) -> Margins:
    """The nearest crossovers, and the least distance from -1, of one wall; NaN for what nobody asks for.

    That of the delay needs more than this loop.
    """
    found = Margins(*[np.nan] * len(Margins._fields))
    if "gain_margin" in wanted:
        w = wall.phase_crossovers()
        sizes, rest = np.abs(wall.at(w).value), wall.at_rest()
        if rest is not None and rest < 0:
            w, sizes = np.append(w, 0.0), np.append(sizes, -rest)
        gain, at = nearest_phase_crossover(stable, w, sizes)
        found = found._replace(gain_margin=gain, phase_crossover=at)
    if "phase_margin" in wanted:
        w = wall.gain_crossovers()
        phase, at = nearest_gain_crossover(stable, w, np.angle(-wall.at(w).value))
        found = found._replace(phase_margin=phase, gain_crossover=at)
    if "modulus_margin" in wanted:
        distance, at = wall.least_distance()
        found = found._replace(modulus_margin=distance, modulus_frequency=at)
    return found


def nearest_phase_crossover(stable: bool, w: np.ndarray, sizes: np.ndarray) -> tuple[float, float]:
    """The gain margin and where it is taken, of places where L is negative and of some size."""
    if not w.size:
        return np.inf if stable else 0.0, np.nan
    nearest = int(np.argmin(np.abs(np.log(sizes))))
    return float(1.0 / sizes[nearest]), float(w[nearest])


def nearest_gain_crossover(stable: bool, w: np.ndarray, turns: Array) -> tuple[float, float]:
    """The phase margin and where it is taken, of places where L is of size 1 and so far turned from -1."""
    if not w.size:
        return np.inf if stable else np.nan, np.nan
    phases = np.degrees(np.abs(turns))
    nearest = int(np.argmin(phases))
    return float(phases[nearest] * (1.0 if stable else -1.0)), float(w[nearest])


# Parts of a period at whose ends crossovers are looked for, and by how many of them a start may miss its own.
_PARTS, _SPARE = 8, 1.5
# And how long before a whole delay, in time constants of the fastest pole: within ln 2 of them a strongly damped device
# bears less than at it. Slower ones than this the parts resolve.
_EARLY, _FAST = np.array([1.0, 0.5, 0.25, 0.1]), 2.0
# The step of a derivative in a delay, with a share of it; Newton steps at most, and a logarithm of L that is rounding.
_STEP, _PART, _TRIALS, _ROUNDED = 1e-5, 1e-9, 30, 1e-9
# Shares of the margin at which the wall must still be stable, and one at which it must not be.
_WITNESSES, _BEYOND = (0.25, 0.5, 0.75, 1.0 - 1e-5), 1.0 + 1e-5


def lay_delays(chain: AnyChain) -> dict[float, tuple[LoopRoots, np.ndarray]]:
    """Loops and nodes at delays up to a period longer than the own one: that, every eighth, just before a whole one."""
    own = float(chain.d)
    fastest = -float(np.linalg.eigvals(chain.realize().A).real.min())
    early = 1.0 - _EARLY / fastest if fastest > _FAST else np.empty(0)
    grid = np.floor(own) + np.union1d(np.arange(_PARTS) / _PARTS, early)
    grid = np.concatenate([grid, grid + 1.0])
    delays = np.concatenate([[own], grid[(grid > own + 1e-9) & (grid < own + 1.0 - 1e-9)], [own + 1.0]])
    return {delay: (loop := loop_at(chain, delay), nodes_of(loop)) for delay in delays.tolist()}


def loop_at(chain: AnyChain, delay: float) -> LoopRoots:
    """The loop of a chain at another delay."""
    return find_roots(replace(chain, d=float(delay), whole=int(np.floor(delay))))


def delay_margin(
    chain: AnyChain, delayed: dict[float, tuple[LoopRoots, np.ndarray]], alpha: float, beta: float
) -> float:
    """Periods of delay that a stable wall bears; infinite where no delay is too long, NaN where that is in doubt."""
    wall, delays = (alpha, beta), list(delayed)
    laid = [OpenLoop.lay_out(loop, *wall, nodes) for loop, nodes in delayed.values()]
    crossed = [each.gain_crossovers() for each in laid]
    turns = [np.mod(np.angle(-each.at(w).value), 2.0 * np.pi) for each, w in zip(laid, crossed, strict=True)]
    ends = [_follow(chain, wall, w, delay) for w, delay in _find_starts(delays, crossed, turns)]

    def at_half_rate(delay: float) -> float:
        return open_loop_response(loop_at(chain, delay), *wall, circle(np.array([np.pi]))).value[0].real

    last = np.array([each.L.value[-1].real for each in laid])
    above = np.abs(last) - 1.0
    k = np.flatnonzero((above[1:] > 0) != (above[:-1] > 0))
    met = zeros_between(lambda at: np.abs([*map(at_half_rate, at)]) - 1.0, np.array(delays), above, k)
    ends += (met + np.where(last[k] < 0, 0.0, 1.0)).tolist()
    ends = [end - float(chain.d) for end in ends if end > chain.d]
    if not ends:
        return np.nan if any(w.size for w in crossed) else np.inf
    return min(ends) if _is_first_loss(chain, alpha, beta, min(ends)) else np.nan


def _find_starts(
    delays: list[float], crossed: list[np.ndarray], turns: list[np.ndarray]
) -> Iterator[tuple[float, float]]:
    """Angles and delays next to which a pole is on the circle, by gain crossovers of laid delays and their phases."""
    # So many periods more as the phase is of the angle turn L to -1, and whole ones leave its size as it is: between
    # two delays each whole number is looked for that this passes, and beside a lowest one that below it.
    more = [phases / w for phases, w in zip(turns, crossed, strict=True)]
    for k, (w, after) in enumerate(pairwise(crossed)):
        if w.size != after.size:
            # Two crossovers have met in between; one may have turned past L = -1 meanwhile.
            for i, turn in product((k, k + 1), (0.0, 2.0 * np.pi)):
                left = (turns[i] - turn) / crossed[i]
                whole = np.round(left)
                near = (np.abs(left - whole) <= _SPARE / _PARTS) & (whole >= 0.0)
                yield from zip(crossed[i][near].tolist(), (delays[i] + left[near]).tolist(), strict=True)
            continue
        rise = np.mod(turns[k + 1] - turns[k] + np.pi, 2.0 * np.pi) - np.pi
        for turn in (0.0, 2.0 * np.pi):
            first, last = (turns[k] - turn) / w, (turns[k] + rise - turn) / after
            whole = np.maximum(np.ceil(np.minimum(first, last)), 0.0)
            for j in np.flatnonzero(whole <= np.maximum(first, last)):
                share = (whole[j] - first[j]) / (last[j] - first[j]) if first[j] != last[j] else 0.0
                at = delays[k] + share * (delays[k + 1] - delays[k])
                yield float(w[j] + share * (after[j] - w[j])), float(at + whole[j])
    for k, (before, here, after) in enumerate(zip(more, more[1:], more[2:], strict=False), 1):
        if before.size == here.size == after.size:
            lowest = (here <= before) & (here <= after)
            for j in np.flatnonzero(lowest & (here - np.floor(here) <= np.maximum(before, after) - here)):
                yield float(crossed[k][j]), float(delays[k] + here[j])


def _follow(chain: AnyChain, wall: tuple[float, float], w: float, delay: float) -> float:
    """The delay near a start with which a pole is on the circle, by Newton's method on ``log(-L)``; else NaN."""
    rest = np.inf
    for _ in range(_TRIALS):
        if not (0.0 < w < np.pi and delay >= 0.0):
            return np.nan
        at, step = circle(np.array([w])), _STEP + _PART * delay
        here, beside = (open_loop_response(loop_at(chain, delay + h), *wall, at) for h in (0.0, step))
        rest, turn = np.log(-here.value[0]), here.slope[0] / here.value[0]
        slope = np.log(beside.value[0] / here.value[0]) / step
        # Where L is the same for a while, as of a device that has come to rest before, this leads to no angle.
        with np.errstate(all="ignore"):
            by_w, by_delay = np.imag([slope * rest.conj(), rest * turn.conj()]) / np.imag(slope * turn.conj())
        w, delay = w - by_w, delay - by_delay
        # On the flank of a narrow resonance the rounding of w alone moves the delay by more.
        if abs(by_delay) <= 1e-14 * (1.0 + delay):
            break
    return delay if abs(rest) < _ROUNDED else np.nan


def _is_first_loss(chain: AnyChain, alpha: float, beta: float, margin: float) -> bool:
    """Whether the wall is stable at some delays before, and no longer beyond: poles counted, not followed."""
    wall = np.array([alpha]), np.array([beta])
    delays = [float(chain.d) + share * margin for share in (*_WITNESSES, _BEYOND)]
    logs = [log_radius(loop_at(chain, delay), *wall)[0] for delay in delays]
    return all(log < 0 for log in logs[:-1]) and logs[-1] > 0


def linear_margins(
    chain: AnyChain, boundary: Boundary, alpha: np.ndarray, beta: np.ndarray, wanted: Container[str]
) -> Margins:
    """Margins of walls of one shape, periods and radians a period; NaN where a wall is out of range."""
    stable = label_walls(boundary, alpha, beta)
    inside = within(alpha, WALL_RANGE) & within(beta, WALL_RANGE)
    delayed: dict[float, tuple[LoopRoots, np.ndarray]] = {}
    # What a sampled device does between its samples is not known.
    with_delay = "delay_margin" in wanted and not chain.sampled
    out = np.full((len(Margins._fields), *alpha.shape), np.nan)
    for place in np.ndindex(alpha.shape):
        a, b, good = float(alpha[place]), float(beta[place]), bool(stable[place])
        if not inside[place]:
            continue
        found = margins_of(OpenLoop.lay_out(boundary.loop, a, b, boundary.w), good, wanted)
        delay = 0.0 if with_delay else np.nan
        if good and with_delay:
            delayed = delayed or lay_delays(chain)
            delay = delay_margin(chain, delayed, a, b)
        out[(slice(None), *place)] = found._replace(delay_margin=delay)
    return Margins(*(part[()] for part in out))
