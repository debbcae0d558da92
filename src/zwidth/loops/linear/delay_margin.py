"""How much more delay a stable wall bears in any linear loop, the fraction held as the hardware does it.

One period more of delay changes nothing but the phase of L, by the angle w itself: at a gain crossover of phase
``p = arg(-L)`` a pole is on the circle m periods later if ``p - m w`` is a multiple of 2 pi. So the loops of 33 delays
within one period, each exact, serve all longer ones. Where that phase passes a multiple from one of them to the next,
the delay is found between the two, each trial with the exact loop of its own. Real poles come to z = -1 where
``|L(-1)|`` passes 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from zwidth.loops.domain import WALL_RANGE, within
from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.chain import Chain, find_roots
from zwidth.loops.linear.curve import nodes_of
from zwidth.loops.linear.margins import OpenLoop, margins_of
from zwidth.loops.linear.radius import log_radius
from zwidth.loops.linear.roots import LoopRoots
from zwidth.loops.linear.rows import label_walls
from zwidth.loops.rigid.margins import Margins
from zwidth.words.types import Array

_PARTS = 32
_LONGEST = 1 << 17
_TURN = 2.0 * np.pi
# Shares of the margin at which the wall must still be stable, and one at which it must not be.
_WITNESSES, _BEYOND = (0.25, 0.5, 0.75, 1.0 - 1e-5), 1.0 + 1e-5
_STEPS = 60


class Crossovers(NamedTuple):
    """Of one wall at one delay: gain crossovers, their phases ``arg(-L)``, and L at z = -1."""

    w: np.ndarray
    phase: np.ndarray
    last: float


class Passage(NamedTuple):
    """Between which delays of the first period, and after how many more, a pole comes to the circle."""

    cell: int
    periods: int
    curve: int  # of the gain crossovers; -1 at z = -1


@dataclass(frozen=True)
class DelayedLoops:
    """The loops of one chain at its own delay and at longer ones, up to one period more."""

    chain: Chain
    delays: np.ndarray
    loops: list[LoopRoots]
    nodes: list[np.ndarray]

    @classmethod
    def lay_out(cls, chain: Chain) -> DelayedLoops:
        """At every thirty-second of a period, whole ones among them."""
        own = float(chain.d)
        grid = (np.floor(own * _PARTS) + 1.0 + np.arange(_PARTS)) / _PARTS
        delays = np.concatenate([[own], grid[(grid > own + 1e-9) & (grid < own + 1.0 - 1e-9)], [own + 1.0]])
        loops = [loop_at(chain, delay) for delay in delays]
        return cls(chain, delays, loops, [nodes_of(loop) for loop in loops])


def loop_at(chain: Chain, delay: float) -> LoopRoots:
    """The loop of a chain at another delay."""
    return find_roots(replace(chain, d=float(delay), whole=int(np.floor(delay))))


def _cross(loop: LoopRoots, alpha: float, beta: float, nodes: np.ndarray) -> Crossovers:
    wall = OpenLoop.lay_out(loop, alpha, beta, nodes)
    w = wall.gain_crossovers()
    return Crossovers(w, np.angle(-wall.at(w).value), float(wall.L.value[-1].real))


def delay_margin(loops: DelayedLoops, alpha: float, beta: float) -> float:
    """Periods of delay that a stable wall bears; infinite where no delay is too long, NaN where that is in doubt."""
    found = [_cross(loop, alpha, beta, nodes) for loop, nodes in zip(loops.loops, loops.nodes, strict=True)]
    passages = [p for cell in range(len(found) - 1) for p in _passages(cell, found[cell], found[cell + 1])]
    if not passages:
        return np.inf if not any(part.w.size for part in found) else np.nan
    first = min(passages, key=lambda p: loops.delays[p.cell] + p.periods)
    # Two in one cell are told apart by where they are.
    rivals = [p for p in passages if (p.cell, p.periods) == (first.cell, first.periods)]
    margin = min(_refine(loops, found, alpha, beta, rival) for rival in rivals) - float(loops.chain.d)
    return margin if _is_first_loss(loops.chain, alpha, beta, margin) else np.nan


def _passages(cell: int, here: Crossovers, there: Crossovers) -> list[Passage]:
    out = []
    for curve, w in enumerate(here.w):
        if not there.w.size:
            break
        other = int(np.argmin(np.abs(there.w - w)))
        if np.argmin(np.abs(here.w - there.w[other])) != curve:
            continue
        phase, w_next = here.phase[curve], there.w[other]
        after = there.phase[other] + _TURN * np.round((phase - there.phase[other]) / _TURN)
        # Until a whole turn has passed, and one more for the change of w.
        most = min(int(2.0 * _TURN / min(w, w_next)) + 3, _LONGEST)
        m: Array = np.arange(most)
        passed = np.floor((phase - m * w) / _TURN) != np.floor((after - m * w_next) / _TURN)
        if passed.any():
            out.append(Passage(cell, int(np.argmax(passed)), curve))
    if (abs(here.last) > 1.0) != (abs(there.last) > 1.0):
        out.append(Passage(cell, 0 if here.last < 0 else 1, -1))
    return out


def _refine(loops: DelayedLoops, found: list[Crossovers], alpha: float, beta: float, at: Passage) -> float:
    """The delay of a passage, by bisection and false position with the exact loop of each trial."""
    low, high = (float(value) for value in loops.delays[at.cell : at.cell + 2])
    ends = found[at.cell], found[at.cell + 1]

    def excess(delay: float) -> float:
        loop = loop_at(loops.chain, delay)
        if at.curve < 0:
            last = OpenLoop.lay_out(loop, alpha, beta, np.array([3.0])).L.value[-1].real
            return float(np.log(abs(float(last))))
        here = _cross(loop, alpha, beta, nodes_of(loop))
        share = (delay - low_end) / (high_end - low_end)
        place = int(np.argmin(np.abs(here.w - (w0 + share * (w1 - w0)))))
        turned = here.phase[place] - at.periods * here.w[place]
        return float(turned - _TURN * np.round((turned - center) / _TURN) - center)

    low_end, high_end = low, high
    w0 = w1 = center = 0.0
    if at.curve >= 0:
        w0 = float(ends[0].w[at.curve])
        w1 = float(ends[1].w[int(np.argmin(np.abs(ends[1].w - w0)))])
        # The multiple of 2 pi next to which it passes.
        before = float(ends[0].phase[at.curve]) - at.periods * w0
        center = _TURN * np.round(before / _TURN)
    first, last = excess(low), excess(high)
    for step in range(_STEPS):
        if high - low <= 1e-13 * (1.0 + high) or first == last:
            break
        x = low - first * (high - low) / (last - first) if step % 3 else 0.5 * (low + high)
        x = min(max(x, low + 1e-3 * (high - low)), high - 1e-3 * (high - low))
        value = excess(x)
        if (value > 0) == (first > 0):
            low, first = x, value
        else:
            high, last = x, value
    return 0.5 * (low + high) + at.periods


def _is_first_loss(chain: Chain, alpha: float, beta: float, margin: float) -> bool:
    """Whether the wall is stable at some delays before, and no longer beyond: poles counted, not followed."""
    wall = np.array([alpha]), np.array([beta])
    delays = [float(chain.d) + share * margin for share in (*_WITNESSES, _BEYOND)]
    logs = [log_radius(loop_at(chain, delay), *wall)[0] for delay in delays]
    return all(log < 0 for log in logs[:-1]) and logs[-1] > 0


def linear_margins(chain: Chain, boundary: Boundary, alpha: np.ndarray, beta: np.ndarray) -> Margins:
    """All margins of walls of one shape, periods and radians a period; NaN where a wall is out of range."""
    stable = label_walls(boundary, alpha, beta)
    inside = within(alpha, WALL_RANGE) & within(beta, WALL_RANGE)
    loops: DelayedLoops | None = None
    out = np.full((len(Margins._fields), *alpha.shape), np.nan)
    for place in np.ndindex(alpha.shape):
        a, b, good = float(alpha[place]), float(beta[place]), bool(stable[place])
        if not inside[place]:
            continue
        found = margins_of(OpenLoop.lay_out(boundary.loop, a, b, boundary.w), good)
        delay = 0.0
        if good:
            loops = loops or DelayedLoops.lay_out(chain)
            delay = delay_margin(loops, a, b)
        out[(slice(None), *place)] = found._replace(delay_margin=delay)
    return Margins(*(part[()] for part in out))
