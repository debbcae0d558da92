"""All routes to a result about a scene agree, in value and status.

The stability of a wall follows from the scene, its poles, a line of constant B or K, an outline, a margin, the
command line, a sweep, python-control and simulation; the maximum stiffness, passivity and derivatives have
several routes, too. If two routes disagree on a wall, the certified verdict (balls of python-flint) at nearby
walls shows whether rounding errors explain it.

As a program, ``python tests/properties/test_one_answer.py COUNT SEED`` prints the contradictions, and the
number of compared results per quantity. Every scene takes the fast routes; `EVERY` contains the intervals of
the slow ones. Scenes that the library rejects are skipped and counted.
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
from routes import (
    Comparison,
    Wall,
    compare_assessment,
    compare_fast,
    compare_gradients,
    compare_maximum,
    compare_runs,
    draw_high_wall,
    draw_scene,
    draw_wall,
    is_near_boundary,
)

import zwidth

SEED = 20


class Every(NamedTuple):
    """Intervals, in scenes, at which the slow routes are taken."""

    maximum: int = 4  # the maximum stiffness, near which the wall then lies
    assessed: int = 16  # assess, margins, check
    run: int = 48  # ridge, limits, a sweep, the time domain
    traced: int = 48  # jax.grad, compiled for every general scene


EVERY = Every()


def describe_difference(values: dict[str, Any]) -> str:
    """Return the results as text if two decided ones differ, otherwise an empty string."""
    decided = {route: value for route, value in values.items() if value is not None}
    return "" if len(set(decided.values())) < 2 else str(decided)


def describe_spread(values: dict[str, Any], within: float) -> str:
    """Return the values as text if they differ beyond the tolerance or only some exist, otherwise an empty string."""
    numbers = np.array([np.nan if value is None else float(value) for value in values.values()])
    if np.isnan(numbers).all() or np.all(numbers == numbers[0]):
        return ""
    if not np.isfinite(numbers).all() or np.ptp(numbers) > within * np.abs(numbers).max():
        return str(values)
    return ""


def describe_contradiction(comparison: Comparison, wall: Wall) -> str:
    """Return the results as text if routes contradict each other beyond rounding errors."""
    if comparison.tolerance is not None:
        return describe_spread(comparison.results, comparison.tolerance)
    text = describe_difference(comparison.results)
    return "" if text and is_near_boundary(wall) else text


@dataclass
class Tally:
    """Counts of comparisons, and the contradictions."""

    scenes: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    scenes_by_name: Counter[str] = field(default_factory=Counter)
    compared: Counter[str] = field(default_factory=Counter)
    unknown: Counter[str] = field(default_factory=Counter)
    routes: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    contradictions: list[tuple[int, str, str, Wall]] = field(default_factory=list)

    def compare(self, k: int, wall: Wall, every: Every) -> None:
        """Compare all quantities of scene k."""
        slow = compare_maximum, compare_assessment, compare_runs, compare_gradients
        for nth, comparisons in ((1, compare_fast), *zip(every, slow, strict=True)):
            if k % nth:
                continue
            try:
                for comparison in comparisons(wall):
                    self._compare(k, comparison, wall)
            except Exception:
                self.contradictions.append((k, "error", traceback.format_exc(limit=-4), wall))

    def _compare(self, k: int, comparison: Comparison, wall: Wall) -> None:
        # Derivatives by all parameters share one row.
        (name, *_), values = comparison.name.split(" in "), comparison.results
        decided = sum(not (value is None or np.isnan(value)) for value in values.values())
        self.scenes_by_name[name] += 1
        self.compared[name] += decided
        self.unknown[name] += len(values) - decided
        self.routes[name] |= values.keys()
        if text := describe_contradiction(comparison, wall):
            self.contradictions.append((k, comparison.name, text, wall))

    def table(self) -> Iterator[str]:
        """Return the number of comparisons and results per quantity, in Markdown."""
        yield "| quantity | routes | scenes | results compared | undecided | contradictions |"
        yield "|---|--:|--:|--:|--:|--:|"
        bad = Counter(name.split(" in ")[0] for _, name, *_ in self.contradictions)
        for name in (*self.scenes_by_name, *(bad.keys() - self.scenes_by_name.keys())):
            counts = (
                len(self.routes[name]),
                self.scenes_by_name[name],
                self.compared[name],
                self.unknown[name],
                bad[name],
            )
            yield f"| {name} | {' | '.join(f'{count:,}' for count in counts)} |"


def compare_scenes(count: int, seed: int, every: Every = EVERY) -> Tally:
    """Compare the routes on random scenes, each with its own seed."""
    tally = Tally()
    for k in range(count):
        random = np.random.default_rng([seed, k])
        tally.scenes += 1
        try:
            scene = draw_scene(random)
            wall = draw_wall(scene, random) if k % every.maximum else draw_high_wall(scene, random)
        except zwidth.InputError as error:
            tally.rejected[str(error).split(":")[0]] += 1
            continue
        tally.compare(k, wall, every)
    return tally


def test_all_routes_agree():
    tally = compare_scenes(64, SEED, Every(2, 8, 16, 32))
    assert tally.contradictions == []
    assert sum(tally.rejected.values()) <= 2, "a link with a resonance at thousands of times the sampling rate"
    routes = {"check", "sweep", "simulate", "simulate, label", "to_control", "zwidth.is_stable", "assess.stable"}
    assert routes <= tally.routes["stable"]
    assert {"check", "ridge", "sweep", "alpha_max", "limits_of, 0"} <= tally.routes["K_max"]
    assert {"ridge", "jax.grad", "sensitivities"} <= tally.routes["slope of K_max"]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int)
    parser.add_argument("seed", type=int)
    for name, nth in EVERY._asdict().items():
        parser.add_argument(f"--{name}", type=int, default=nth, help=f"interval in scenes, default {nth}")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", zwidth.PrecisionWarning)
    start, every = time.process_time(), Every(*(getattr(arguments, name) for name in Every._fields))
    tally = compare_scenes(arguments.count, arguments.seed, every)
    for k, comparison, text, wall in tally.contradictions:
        print(f"{k}: {comparison}: {text}\n    {wall}")
    print("\n".join(tally.table()))
    intervals = ", ".join(f"{name} every {nth}th" for name, nth in every._asdict().items())
    print(
        f"{tally.scenes} scenes ({intervals}), {sum(tally.rejected.values())} rejected {dict(tally.rejected)}, "
        f"{len(tally.contradictions)} contradictions, {time.process_time() - start:.0f} s of CPU"
    )
