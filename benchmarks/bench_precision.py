#!/usr/bin/env python3
"""Measure errors and speed of zwidth's functions inside `jit` in float32, mixed precision and float64.

    python benchmarks/bench_precision.py [--points 1000000] [--checked 1000] [--runs 7]
                                         [--write benchmarks/results/precision.md]

alpha and beta are the normalized stiffness and damping of a wall, delta is the damping of the device, and d the delay
in periods. A wall is labeled stable or unstable by `is_stable`; its distance from the stability boundary is relative in
alpha. Speeds are ratios of CPU times that are measured alternately.
"""

from __future__ import annotations

import platform
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from methods.clock import time_calls
from methods.page import write_page
from methods.precisions import (
    DELAYS,
    DELTAS,
    FARTHEST,
    LABELS,
    NEAREST,
    QUANTITIES,
    draw_rounded_walls,
    evaluate_walls,
    prepare,
)
from methods.problems import Walls, scattered
from zwidth.plant.rigid_mass import ANY
from zwidth.stability.rigid.mixed_precision import label_in_float32
from zwidth.stability.rigid.verdict import is_stable

# Quantities whose errors are listed by the distance of the wall from the stability boundary.
OF_WALLS = ("spectral radius", "gain margin", "phase margin", "delay margin", "modulus margin")


def draw_all(checked: int) -> tuple[Walls, np.ndarray]:
    """Return walls and their distances from the stability boundary, in arrays of shape (delays, dampings, walls)."""
    drawn = [[draw_rounded_walls(delta, d, checked) for delta in DELTAS] for d in DELAYS]
    columns = (np.array([[np.asarray(walls[k]) for walls, _ in row] for row in drawn]) for k in range(4))
    return Walls(*columns), np.array([[distance for _, distance in row] for row in drawn])


def find_errors(walls: Walls, name: str) -> np.ndarray:
    """Return the error of a quantity in float32 at each wall, compared with float64; relative if its unit is "1".

    The error is 0 if both values are NaN or the same infinity, and NaN if only the float32 value is NaN.
    """
    function, unit = QUANTITIES[name]
    exact, rounded = (
        evaluate_walls(function, walls, dtype).reshape(walls.alpha.shape) for dtype in ("float64", "float32")
    )
    same = (rounded == exact) | (np.isnan(rounded) & np.isnan(exact))
    size = np.where(same | (unit != "1"), 1.0, np.abs(exact))
    return np.abs(np.where(same, 0.0, rounded) - np.where(same, 0.0, exact)) / size


def head_row(first: str, cells: Iterable[str], align: str = "--:") -> list[str]:
    """Return the first two lines of a Markdown table; ``align`` is the alignment of its first column."""
    cells = list(cells)
    return [f"| {first} | {' | '.join(cells)} |", f"|{align}|{'--:|' * len(cells)}"]


def format_error(error: float) -> str:
    """Return an error as text with one significant digit; empty for NaN."""
    return "" if np.isnan(error) else f"{error:.0e}" if error else "0"


def largest(errors: np.ndarray, chosen: Any = True) -> str:
    """Return the largest error of the chosen walls as text, followed by the number of walls whose error is NaN."""
    errors = errors[np.broadcast_to(chosen, errors.shape)]
    missing = int(np.isnan(errors).sum())
    text = format_error(float(np.max(errors, initial=0.0, where=~np.isnan(errors)))) if errors.size else ""
    return f"{text} ({missing} NaN)" if missing else text


def tabulate_labels(distance: np.ndarray, wrong: np.ndarray) -> list[str]:
    """Return a table of the largest distance at which a stability label is wrong, by delay and damping."""
    lines = head_row("d", (f"delta = {delta:g}" for delta in DELTAS))
    for d, distances, is_wrong in zip(DELAYS, distance, wrong, strict=True):
        cells = (format_error(float(max(x[bad], default=0.0))) for x, bad in zip(distances, is_wrong, strict=True))
        lines.append(f"| {d:g} | {' | '.join(cells)} |")
    return lines


def tabulate_distances(distance: np.ndarray, wrong: np.ndarray, errors: dict[str, np.ndarray]) -> list[str]:
    """Return a table of wrong stability labels and largest errors, by decade of the distance from the boundary."""
    lines = head_row("distance", ["wrong labels", *errors], "---")
    for decade in range(NEAREST, FARTHEST + 1):
        chosen = (distance >= 10.0**decade) & (distance < 10.0 ** (decade + 1))
        cells = [f"{100 * wrong[chosen].mean():.2g} %", *(largest(error, chosen) for error in errors.values())]
        lines.append(f"| 1e{decade} to 1e{decade + 1} | {' | '.join(cells)} |")
    return lines


def tabulate_speeds(points: int, runs: int) -> tuple[list[str], dict[str, list[float]]]:
    """Return a table of times and wrong labels of float32 and mixed precision, and the times relative to float64."""
    lines = head_row("d", ["float32: time", "mixed: time", "float32: wrong", "mixed: wrong", "mixed: in float64"])
    ratios: dict[str, list[float]] = {"float32": [], "mixed": []}
    for d in DELAYS:
        walls = scattered(d, points)
        calls = {name: prepare(function, walls, dtype) for name, (function, dtype) in LABELS.items()}
        labels = {name: np.asarray(call()) for name, call in calls.items()}
        # Measure the three precisions alternately, so that other programs slow down all of them equally.
        seconds = dict.fromkeys(calls, np.inf)
        for _ in range(runs):
            for name, call in calls.items():
                seconds[name] = min(seconds[name], float(time_calls(call, 1)[1].min()))
        for name, values in ratios.items():
            values.append(seconds[name] / seconds["float64"])
        is_open = prepare(lambda *wall: label_in_float32(*wall, kind=ANY)[1], walls, "float64")()
        cells = [f"{values[-1]:.2g}" for values in ratios.values()]
        cells += [f"{np.sum(labels[name] != labels['float64']):,}" for name in ratios]
        lines.append(f"| {d:g} | {' | '.join([*cells, f'{np.sum(np.asarray(is_open)):,}'])} |")
        print(lines[-1], flush=True)
    return lines, ratios


def tabulate_choice(farthest: float, ratios: dict[str, list[float]]) -> list[str]:
    """Return the table of the precisions: selection, error, time and recommended use."""
    times = {name: f"{min(values):.1f} to {max(values):.1f}" for name, values in ratios.items()}
    x64 = '`jax.config.update("jax_enable_x64", True)`'
    return [
        "| precision | selection | distance of wrong labels | time on a CPU | recommended use |",
        "|---|---|--:|--:|---|",
        f"| float64 | direct calls; inside `jit` after {x64} | rounding errors of float64 | 1 | always; the default |",
        f'| mixed | `is_stable(..., precision="mixed")`; inside `jit` after {x64} | as float64 | {times["mixed"]} '
        "| stability labels on a GPU with slow float64 arithmetic |",
        f"| float32 | inside `jit` with JAX's default settings | up to {farthest:.0e} | {times['float32']} "
        "| previews, and values that need few digits |",
    ]


def measure_all(points: int, checked: int, runs: int) -> str:
    """Return the page with all tables."""
    walls, distance = draw_all(checked)
    labels = [evaluate_walls(is_stable, walls, dtype).reshape(distance.shape) for dtype in ("float64", "float32")]
    wrong = labels[0] != labels[1]
    errors = {name: find_errors(walls, name) for name in QUANTITIES}
    units = {name: "relative" if unit == "1" else unit for name, (_, unit) in QUANTITIES.items()}
    by_delay = head_row("quantity", ["error", *(f"d = {d:g}" for d in DELAYS)], "---")
    by_delay += [f"| {name} | {units[name]} | {' | '.join(map(largest, errors[name]))} |" for name in QUANTITIES]
    by_distance = {f"{name}, {units[name]}": errors[name] for name in OF_WALLS}
    speeds, ratios = tabulate_speeds(points, runs)
    lines = [
        "# Precision",
        "",
        "## Choice of a precision",
        "",
        "The command `benchmarks/bench_precision.py --write` writes the tables of this section, with JAX",
        f"{jax.__version__} and Python {platform.python_version()}. Distances from the stability boundary are relative",
        "to alpha. Times are CPU times of `is_stable` for scattered walls, divided by the time in float64.",
        "",
        *tabulate_choice(float(distance[wrong].max()), ratios),
        "",
        "## Errors of float32",
        "",
        "Errors inside `jit` with float32 arguments, compared with float64 at the same arguments. For each pair of d",
        f"and delta, {checked:,} walls lie at relative distances in alpha of 1e{NEAREST} to 0.9 from the stability",
        "boundary, next to random points of the boundary between 2 and 99.5 % of its range of frequencies.",
        "",
        "Largest relative distance in alpha from the boundary at which a label of `is_stable` is wrong:",
        "",
        *tabulate_labels(distance, wrong),
        "",
        f"Largest errors over these values of delta, with the number of NaN among {checked * len(DELTAS):,} walls:",
        "",
        *by_delay,
        "",
        "Share of wrong labels, and largest errors by relative distance from the boundary, over all values of d and",
        "delta. On the boundary the delay margin of some devices jumps from 0, because they are stable again with a",
        "longer delay.",
        "",
        *tabulate_distances(distance, wrong, by_distance),
        "",
        "## Speed of each precision",
        "",
        f"CPU time of `is_stable` for {points:,} scattered walls inside `jit`, divided by the CPU time in float64",
        f"(fastest of {runs} runs). The next columns contain the number of labels that differ from those in float64,",
        "and the number of walls that mixed precision computes in float64. On GPUs the times are not measured.",
        "",
        *speeds,
    ]
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    write_page(
        __doc__,
        measure_all,
        points=(1_000_000, "walls of the timed calls"),
        checked=(1_000, "walls for each pair of delay and damping"),
        runs=(7, "timed runs"),
    )
