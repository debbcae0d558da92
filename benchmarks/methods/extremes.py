"""Errors of each stability method in extreme cases of the model, compared with certified results."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from methods.problems import Walls
from zwidth.core.status import Status
from zwidth.stability.rigid.boundary import boundary, sample_lobe
from zwidth.stability.rigid.ridge import alpha_max
from zwidth.stability.rigid.verdict import StabilityMethod, decide_stability, is_stable

DELTAS = (0.0, 5e-324, 1e-300, 1e-16, 1e-8, 1e-4, 1.0, 50.0, 700.0, 750.0, 1e4, 1e6, 1e12)
DELAYS = (0.0, 5e-324, 0.5, float(np.nextafter(1.0, 0.0)), 1.0, 8.0, 50.0, 500.0, 1e4, 1e5)
DISTANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13, 1e-15)
METHODS: tuple[StabilityMethod, ...] = ("crossover", "companion")
# Beyond this delay, computing all poles takes minutes.
_LONGEST = {"companion": 50.0}


class Group(NamedTuple):
    """Walls that are extreme in one respect, with their distances from the boundary, NaN if unknown."""

    name: str
    walls: Walls
    distance: np.ndarray


class Finding(NamedTuple):
    """Results of one method for one group at one delay."""

    method: str
    group: str
    d: float
    points: int
    wrong: int
    farthest: float  # largest distance of a wall with a wrong label; 0 if all are correct, NaN if unknown


def groups(d: float) -> Iterator[Group]:
    """Yield all groups of walls at one delay."""
    rng = np.random.default_rng(20061101)
    yield _group("walls near the stability boundary", [_near(delta, d, rng) for delta in DELTAS], d)
    yield _group("walls near the start of the boundary curve, beta = -delta", [_start(delta) for delta in DELTAS], d)
    yield _group("soft walls, alpha = 1e-60 to 1e-8", [_soft(delta) for delta in DELTAS], d)
    yield _group("walls near the ridge (double and triple poles)", [_ridge(delta, d) for delta in DELTAS], d)


def _group(name: str, parts: list[tuple[np.ndarray, ...]], d: float) -> Group:
    alpha, beta, delta, distance = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Group(name, Walls(alpha, beta, delta, np.full(alpha.size, d)), distance)


def _near(delta: float, d: float, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    end = float(sample_lobe(delta, d, points=16)[0][-1])
    distance = np.repeat(DISTANCES, 4)
    curve = boundary(rng.uniform(0.02, 0.98, distance.size) * end, delta, d)
    alpha = np.asarray(curve.alpha) * (1.0 + distance * np.tile([1.0, -1.0], distance.size // 2))
    return alpha, np.asarray(curve.beta), np.full(distance.size, delta), distance


def _start(delta: float) -> tuple[np.ndarray, ...]:
    beta = [-delta]
    for _ in range(3):
        beta = [np.nextafter(beta[0], -np.inf), *beta, np.nextafter(beta[-1], np.inf)]
    count = len(beta)
    alpha = np.full(count, 1e-12)
    return alpha, np.array(beta), np.full(count, delta), np.full(count, np.nan)


def _soft(delta: float) -> tuple[np.ndarray, ...]:
    alpha = 10.0 ** np.array([-60.0, -50.0, -40.0, -30.0, -16.0, -8.0])
    return alpha, np.full(alpha.size, 1e-3 * (1.0 + delta)), np.full(alpha.size, delta), np.full(alpha.size, np.nan)


def _ridge(delta: float, d: float) -> tuple[np.ndarray, ...]:
    top = alpha_max(delta, d)
    distance = np.repeat(DISTANCES, 2)
    scale = 1.0 + distance * np.tile([1.0, -1.0], len(DISTANCES))
    alpha, beta = float(top.alpha) * scale, np.full(distance.size, float(top.beta))
    return alpha, beta, np.full(distance.size, delta), distance


def judge(d: float) -> Iterator[Finding]:
    """Yield the results of every method for every group; points exactly on the boundary, without label, are omitted."""
    for group in groups(d):
        truth = decide_stability(*group.walls, method="certified")
        known = np.asarray(truth.status) == Status.OK
        walls = Walls(*(part[known] for part in group.walls))
        for method in METHODS:
            if d > _LONGEST.get(method, np.inf):
                continue
            wrong = np.asarray(is_stable(*walls, method=method)) != np.asarray(truth.stable)[known]
            farthest = float(np.max(group.distance[known][wrong], initial=0.0))
            yield Finding(method, group.name, d, int(known.sum()), int(wrong.sum()), farthest)


def report(delays: tuple[float, ...] = DELAYS) -> str:
    """Return a Markdown table of wrong labels and their largest distance, by method, group and delay."""
    found = [outcome for d in delays for outcome in judge(d)]
    lines = [
        "# Validity of the methods at extreme parameters",
        "",
        "Each table contains the number of wrong labels (stable or unstable) of the methods of `zwidth.is_stable`. The",
        'reference is `method="certified"`, which returns a label only if the label is guaranteed to be correct.',
        "The devices have the following values of the normalized physical damping:",
        f"delta = {', '.join(map(_shortest, DELTAS))}.",
        "",
        'A cell contains the number of wrong labels and the number of walls, for example "1 of 364". If the',
        "distances of the walls from the stability boundary are known and if labels are wrong, the cell also",
        "contains the largest distance of a wall with a wrong label, relative to alpha. A cell is empty if the",
        "method is not measured at this delay. The delay `1 - ulp` is the largest float64 number below 1.",
        "",
        "The script `scripts/refresh_extremes.py` writes this page.",
        "",
    ]
    for name in dict.fromkeys(outcome.group for outcome in found):
        lines += [
            f"## {name[0].upper()}{name[1:]}",
            "",
            f"| d | {' | '.join(METHODS)} |",
            "|--:|" + "--:|" * len(METHODS),
        ]
        for d in delays:
            mine = {outcome.method: _cell(outcome) for outcome in found if (outcome.group, outcome.d) == (name, d)}
            lines.append(f"| {_delay(d)} | {' | '.join(mine.get(method, '') for method in METHODS)} |")
        lines.append("")
    return "\n".join(lines)


def _delay(d: float) -> str:
    if d == np.nextafter(1.0, 0.0):
        return "1 - ulp"
    return _shortest(d)


def _shortest(number: float) -> str:
    return min(f"{number:g}", repr(number), key=len)


def _cell(outcome: Finding) -> str:
    if not outcome.wrong:
        return f"0 of {outcome.points}"
    where = f", {outcome.farthest:.0e}" if outcome.farthest > 0 else ""
    return f"{outcome.wrong} of {outcome.points}{where}"
