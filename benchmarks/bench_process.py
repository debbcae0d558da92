#!/usr/bin/env python3
"""Measure in separate processes: memory for large maps, and the effect of XLA flags.

    PYTHONPATH=src python benchmarks/bench_process.py [--quick] [--out benchmarks/results/process.md]

zwidth sets no flags; users can set ``XLA_FLAGS`` before Python starts. Each setting is measured several times in new
processes, alternating between settings; ratios are ratios of medians.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
from pathlib import Path

import numpy as np

from methods.clock import time_calls

SETTINGS = {
    "none": "",
    "vector width 512": "--xla_cpu_prefer_vector_width=512",
    "vector width 128": "--xla_cpu_prefer_vector_width=128",
    "two CPU devices": "--xla_force_host_platform_device_count=2",
    "one thread": "--xla_cpu_multi_thread_eigen=false",
    "none, again": "",
}
# Cases timed with every setting: quantity, method, layout, delay, points.
CASES = [
    ("stable", "crossover", "map", 4.0, 4_000_000),
    ("stable", "crossover", "scattered", 4.0, 4_000_000),
    ("stable", "certified", "scattered", 4.0, 1_000_000),
    ("passive", "worst frequency", "scattered", 4.0, 1_000_000),
    ("spectral_radius", "newton", "scattered", 4.0, 250_000),
]
# Cases of the memory table: quantity, method, layout, delay, points, bytes of the result per point.
LARGE = [
    ("stable", "crossover", "map", 4.0, 100_000_000, 1),
    ("stable", "crossover", "map", 500.0, 100_000_000, 1),
    ("stable", "crossover", "scattered", 4.0, 10_000_000, 1),
    ("stable", "certified", "map", 4.0, 10_000_000, 1),
    ("passive", "worst frequency", "map", 4.0, 10_000_000, 1),
    ("spectral_radius", "newton", "map", 4.0, 1_000_000, 8),
]


def call(quantity: str, method: str, layout: str, d: float, points: int):
    """Return the function to measure and its number of points."""
    import zwidth
    from methods import problems

    walls = problems.grid(d, points) if layout == "map" else problems.scattered(d, points)
    function = {"stable": zwidth.is_stable, "spectral_radius": zwidth.spectral_radius, "passive": zwidth.is_passive}
    options = {} if quantity == "passive" else {"method": method}
    return (lambda: function[quantity](*walls, **options)), walls.points


def time_cases(quick: bool) -> list[float]:
    """Return points per second of every case, by the median of several calls."""
    rates = []
    for quantity, method, layout, d, points in CASES:
        function, count = call(quantity, method, layout, d, points // (16 if quick else 1))
        function()
        rates.append(count / statistics.median(time_calls(function, 3 if quick else 15)[0]))
    return rates


def peak() -> int:
    """Return the peak memory of this process in bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def memory_of(quantity: str, method: str, layout: str, d: float, points: int) -> list[int]:
    """Return the number of points and the increase of peak memory by a large map after a small warm-up map."""
    small, _ = call(quantity, method, layout, d, 100_000)
    small()
    before = peak()
    large, count = call(quantity, method, layout, d, points)
    assert np.asarray(large()).size == count
    return [count, peak() - before]


def in_program(arguments: list[str], flags: str = "") -> list:
    """Run this file in a new process and return its JSON output."""
    environment = os.environ | ({"XLA_FLAGS": flags} if flags else {})
    command = [sys.executable, __file__, *arguments]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def report(quick: bool) -> str:
    """Return both tables in Markdown."""
    from methods.report import environment

    rates = {name: [] for name in SETTINGS}
    for _ in range(1 if quick else 5):
        for name, flags in SETTINGS.items():
            rates[name].append(in_program(["--time", *(["--quick"] if quick else [])], flags))
    middle = {name: [statistics.median(column) for column in zip(*runs, strict=True)] for name, runs in rates.items()}
    here = environment()
    lines = [
        f"Measured on {here['cores']} cores ({here['processor']}) with JAX {here['jax']}, written by",
        "`benchmarks/bench_process.py`.",
        "",
        "### XLA's flags",
        "",
        "zwidth sets none, and changes no setting of JAX. Speed at d = 4 as a multiple of the speed without a flag,",
        "for a user who sets `XLA_FLAGS` before Python starts. The last line repeats the measurement without one: so",
        "far apart are two of the same.",
        "",
        "| `XLA_FLAGS` | " + " | ".join(f"{method}, {layout}" for _, method, layout, _, _ in CASES) + " |",
        "|---|" + "--:|" * len(CASES),
    ]
    for name, flags in SETTINGS.items():
        if name != "none":
            ratios = [f"{mine / plain:.2f}" for mine, plain in zip(middle[name], middle["none"], strict=True)]
            lines.append(f"| {f'`{flags}`' if flags else name} | {' | '.join(ratios)} |")
    lines += [
        "",
        "### Memory of a large map",
        "",
        "Peak memory beyond that of a small map, after everything has been compiled, and beside it the result alone.",
        "",
        "| asked for | method | layout | d | points | memory | of it the result |",
        "|---|---|---|--:|--:|--:|--:|",
    ]
    for quantity, method, layout, d, points, size in LARGE:
        words = [quantity, method, layout, str(d), str(points // (10 if quick else 1))]
        count, grown = in_program(["--memory", *words])
        asked = quantity.replace("_", " ")
        lines.append(f"| {asked} | {method} | {layout} | {d:g} | {count:,} | {_size(grown)} | {_size(count * size)} |")
    return "\n".join(lines) + "\n"


def _size(count: float) -> str:
    return f"{count / 1e6:,.0f} MB"


def main() -> None:
    """Measure, print, and write to a file if a path is given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small maps, one round")
    parser.add_argument("--out", type=Path, help="write the tables there")
    parser.add_argument("--time", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--memory", nargs=5, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.time:
        print(json.dumps(time_cases(given.quick)))
    elif given.memory:
        quantity, method, layout, d, points = given.memory
        print(json.dumps(memory_of(quantity, method, layout, float(d), int(points))))
    else:
        text = report(given.quick)
        print(text)
        if given.out:
            given.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
