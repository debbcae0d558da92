"""One question, one answer: what every road to a question about a scene says, with parts and without.

A wall's stability can be asked of the scene, of its poles, of a row, a column, an outline, a margin, the command line,
a sweep, python-control and the time domain; the stiffest wall, passivity and derivatives have roads of their own. None
may contradict another, in value or in status. Where two roads differ on a wall, the certified verdict (balls of
python-flint) a little to all sides of it tells whether rounding explains it.

As a program, ``python tests/properties/test_one_answer.py COUNT SEED`` prints the contradictions, and how many answers
to each question were compared. Every scene takes the quick roads; `EVERY` says how many take which of the slow ones.
A scene that the library refuses is passed over and counted.
"""

from __future__ import annotations

import argparse
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from roads import (
    Question,
    Wall,
    assessed_questions,
    draw_high_wall,
    draw_scene,
    draw_wall,
    highest_questions,
    near_the_edge,
    quick_questions,
    run_questions,
    traced_questions,
)

import zwidth

SEED = 20


class Every(NamedTuple):
    """One scene in how many takes the roads that cost more than the quick ones."""

    highest: int = 4  # the stiffest wall, around which the wall then lies
    assessed: int = 16  # assess, margins, check
    run: int = 48  # ridge, limits, a sweep, the time domain
    traced: int = 48  # jax.grad, compiled for every scene with parts


EVERY = Every()


def differing(values: dict[str, Any]) -> str:
    """The roads and their answers, where two that know differ."""
    known = {road: value for road, value in values.items() if value is not None}
    return "" if len(set(known.values())) < 2 else str(known)


def spread(values: dict[str, Any], within: float) -> str:
    """The roads and their numbers, where they differ by more than rounding, or only some know."""
    numbers = np.array([np.nan if value is None else float(value) for value in values.values()])
    if np.isnan(numbers).all() or np.all(numbers == numbers[0]):
        return ""
    if not np.isfinite(numbers).all() or np.ptp(numbers) > within * np.abs(numbers).max():
        return str(values)
    return ""


def contradiction(question: Question, wall: Wall) -> str:
    """The answers, where roads contradict each other beyond rounding."""
    if question.within is not None:
        return spread(question.answers, question.within)
    text = differing(question.answers)
    return "" if text and near_the_edge(wall) else text


@dataclass
class Tally:
    """What was asked, and what was found."""

    scenes: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    asked: Counter[str] = field(default_factory=Counter)
    compared: Counter[str] = field(default_factory=Counter)
    unknown: Counter[str] = field(default_factory=Counter)
    roads: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    found: list[tuple[int, str, str, Wall]] = field(default_factory=list)

    def ask(self, k: int, wall: Wall, every: Every) -> None:
        """All questions to scene k."""
        slow = highest_questions, assessed_questions, run_questions, traced_questions
        for nth, questions in ((1, quick_questions), *zip(every, slow, strict=True)):
            if k % nth:
                continue
            try:
                for question in questions(wall):
                    self._compare(k, question, wall)
            except Exception:
                self.found.append((k, "error", traceback.format_exc(limit=-4), wall))

    def _compare(self, k: int, question: Question, wall: Wall) -> None:
        # One line for the slopes in all numbers.
        (name, *_), values = question.name.split(" in "), question.answers
        known = sum(not (value is None or np.isnan(value)) for value in values.values())
        self.asked[name] += 1
        self.compared[name] += known
        self.unknown[name] += len(values) - known
        self.roads[name] |= values.keys()
        if text := contradiction(question, wall):
            self.found.append((k, question.name, text, wall))

    def table(self) -> Iterator[str]:
        """How often each question was asked and answered, in Markdown."""
        yield "| question | roads | asked | answers compared | unknown | contradictions |"
        yield "|---|--:|--:|--:|--:|--:|"
        bad = Counter(name.split(" in ")[0] for _, name, *_ in self.found)
        for name in (*self.asked, *(bad.keys() - self.asked.keys())):
            counts = len(self.roads[name]), self.asked[name], self.compared[name], self.unknown[name], bad[name]
            yield f"| {name} | {' | '.join(f'{count:,}' for count in counts)} |"


def ask_scenes(count: int, seed: int, every: Every = EVERY) -> Tally:
    """So many scenes, each of its own seed."""
    tally = Tally()
    for k in range(count):
        random = np.random.default_rng([seed, k])
        tally.scenes += 1
        try:
            scene = draw_scene(random)
            wall = draw_wall(scene, random) if k % every.highest else draw_high_wall(scene, random)
        except zwidth.InputError as error:
            tally.refused[str(error).split(":")[0]] += 1
            continue
        tally.ask(k, wall, every)
    return tally


def test_every_road_gives_the_same_answer():
    tally = ask_scenes(64, SEED, Every(2, 8, 16, 32))
    assert tally.found == []
    assert sum(tally.refused.values()) <= 2, "a link that rings thousands of times a period"
    roads = {"check", "sweep", "simulate", "simulate, label", "to_control", "zwidth.is_stable", "assess.stable"}
    assert roads <= tally.roads["stable"]
    assert {"check", "ridge", "sweep", "alpha_max", "limits_of, 0"} <= tally.roads["K_max"]
    assert {"ridge", "jax.grad", "sensitivities"} <= tally.roads["slope of K_max"]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int)
    parser.add_argument("seed", type=int)
    for name, nth in EVERY._asdict().items():
        parser.add_argument(f"--{name}", type=int, default=nth, help=f"one in so many scenes, {nth} if left out")
    given = parser.parse_args()
    warnings.simplefilter("ignore", zwidth.PrecisionWarning)
    start, every = time.process_time(), Every(*(getattr(given, name) for name in Every._fields))
    told = ask_scenes(given.count, given.seed, every)
    for k, question, text, wall in told.found:
        print(f"{k}: {question}: {text}\n    {wall}")
    print("\n".join(told.table()))
    shares = ", ".join(f"{name} one in {nth}" for name, nth in every._asdict().items())
    print(
        f"{told.scenes} scenes ({shares}), {sum(told.refused.values())} refused {dict(told.refused)}, "
        f"{len(told.found)} contradictions, {time.process_time() - start:.0f} s of CPU"
    )
