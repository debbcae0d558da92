#!/usr/bin/env python3
"""Measure fits of logs: how far off, how often the intervals hold the true device, whether friction is found.

    python benchmarks/bench_fit.py [--logs 1000] [--processes 2] [--write docs/fitting.md]

Devices, delays, forces, encoders and noises are random, with friction in a third of them. Errors stand over the bound
of Cramer and Rao, for noise and the encoder's q^2/12 as white. The logs are made by the closed forms that the fit
uses, which tests/unit/fitting/test_moving.py compares with `zwidth.simulate`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import zwidth
from zwidth.fitting.moving import PARTS, Recording, Recordings

PERIOD, SKIP = 1e-3, 22
NAMES = ("mass", "damping", "delay", "friction")
# Noise as a share of the encoder's step: those of the main table, and none.
NOISY, SILENT = (0.15, 3.0), (0.0, 0.0)


class Made(NamedTuple):
    """A log and its truth: mass, damping, delay, friction, offset; the noise's deviation and the encoder's step."""

    force: np.ndarray
    position: np.ndarray
    truth: tuple[float, float, float, float, float]
    noise: float
    step: float


def make_log(seed: int, share: tuple[float, float]) -> Made:
    """One random log; ``share`` bounds the noise over the encoder's step."""
    random = np.random.default_rng([7, seed])
    count = int(random.choice([1000, 2000, 5000]))
    mass = float(np.exp(random.uniform(np.log(0.03), 0.0)))
    delta = float(np.exp(random.uniform(np.log(2e-3), np.log(0.1))))
    d = float(random.uniform(0, 5)) if random.random() < 0.6 else float(random.integers(0, 6))
    force = np.concatenate([np.zeros(SKIP), make_force(random, count)])
    effective = float(np.sqrt(np.mean(force**2)))
    friction = effective * random.uniform(0.03, 0.25) if random.random() < 1 / 3 else 0.0
    offset = random.uniform(-0.05, 0.05) if random.random() < 0.2 else 0.0
    g = PERIOD**2 / mass
    moved = Recording(force, np.zeros(count), SKIP).move(g, delta, d, 0.0, 0.0, g * offset, g * friction).position
    step = float(np.ptp(moved) / np.exp(random.uniform(np.log(300), np.log(1e5))))
    noise = step * (np.exp(random.uniform(*np.log(share))) if share[0] else 0.0)
    read = step * np.round(moved / step + noise / step * random.standard_normal(count) + random.uniform())
    position = np.concatenate([np.full(SKIP, read[0]), read])
    return Made(force, position, (mass, delta * mass / PERIOD, d * PERIOD, friction, offset), noise, step)


def make_force(random: np.random.Generator, count: int) -> np.ndarray:
    """Steps to and fro, a chirp, or random steps, in N."""
    kind, held = random.integers(3), int(random.integers(8, 60))
    if kind == 1:
        now = PERIOD * np.arange(count)
        return np.sin(2 * np.pi * (2 * now + 10 / (count * PERIOD) * now**2))
    steps = random.choice([-1.0, 1.0], count // held + 1) if kind == 0 else random.standard_normal(count // held + 1)
    return np.repeat(steps, held)[:count]


def bound_errors(made: Made) -> dict[str, float]:
    """Least standard errors by Cramer and Rao, of the model that made the log; nothing where it cannot be told."""
    mass, damping, delay, friction, offset = made.truth
    beyond: dict[str, float] = {PARTS[0]: offset, PARTS[1]: friction}
    parts = tuple(name for name in PARTS if beyond[name])
    model = Recordings((Recording(made.force, made.position[SKIP:], SKIP),), parts)
    g = PERIOD**2 / mass
    theta = np.array([g, damping * PERIOD / mass, delay / PERIOD, 0.0, 0.0, *(g * beyond[name] for name in parts)])
    by_truth = np.eye(theta.size)
    by_truth[[0, 1], 0] = -theta[:2] / mass
    by_truth[1, 1], by_truth[2, 2] = PERIOD / mass, 1 / PERIOD
    for name in parts:
        k = model.find(name)
        by_truth[k, 0], by_truth[k, k] = -theta[k] / mass, g
    slopes = model.predict(theta)[1] @ by_truth
    sizes = np.linalg.norm(slopes, axis=0)
    seen = sizes > 0
    slopes = slopes[:, seen] / sizes[seen]
    if np.linalg.cond(slopes) > 1e6:
        return {}
    variance = made.noise**2 + made.step**2 / 12
    errors = np.full(theta.size, np.nan)
    errors[seen] = np.sqrt(variance * np.sum(np.linalg.pinv(slopes) ** 2, axis=1)) / sizes[seen]
    found = {str(name): float(error) for name, error in zip(NAMES, [*errors[:3], np.nan], strict=True)}
    return found | ({"friction": errors[-1]} if friction else {})


def judge(seed: int, span: tuple[float, float]) -> dict[str, Any]:
    """One log's fit beside its truth."""
    made = make_log(seed, span)
    bounds = bound_errors(made)
    start = time.process_time()
    try:
        fit = zwidth.fit_log(PERIOD, made.position, made.force)
    except zwidth.ZwidthError as error:
        return {"refused": str(error)}
    took = time.process_time() - start
    truth: dict[str, float] = {str(name): value for name, value in zip(NAMES, made.truth[:4], strict=True)}
    scene = zwidth.Scene(
        zwidth.Device(truth["mass"], truth["damping"]), zwidth.Timing(period=PERIOD, delay=truth["delay"])
    )
    truth["stiffness_max"] = float(scene.max_stiffness().stiffness)
    bars = fit.intervals

    def real(name: str) -> bool:
        return name != "friction" or truth[name] > 0

    return {
        "seed": seed,
        "took": took,
        "share": made.noise / made.step,
        "held": {name: bar.low <= truth[name] <= bar.high for name, bar in bars.items() if real(name)},
        "off": {
            name: (getattr(fit, name) - truth[name]) / bounds[name]
            for name in NAMES
            if bounds and real(name) and (name != "friction" or fit.friction)
        },
        "rubs": truth["friction"] > 0,
        "told": bool(bounds),
        "right": (fit.friction > 0, fit.offset != 0) == (truth["friction"] > 0, made.truth[4] != 0),
        "found": fit.friction > 0,
        "pushed": (made.truth[4] != 0, fit.offset != 0),
        "status": fit.status,
        "doubted": bool(fit.doubts),
    }


def judge_all(count: int, span: tuple[float, float], processes: int) -> list[dict[str, Any]]:
    """As many logs, in processes of their own."""
    if processes == 1:
        return [judge(seed, span) for seed in range(count)]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        return list(pool.map(partial(judge, span=span), range(count), chunksize=10))


def tabulate(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Coverage and errors, in Markdown."""
    fitted = [row for row in rows if "refused" not in row]
    yield "| | 95 % interval holds it | error over the bound | with the right parts kept | median |"
    yield "|---|--:|--:|--:|--:|"
    for name in (*NAMES, "stiffness_max"):
        held = [row["held"][name] for row in fitted if name in row["held"]]
        off = np.array([row["off"][name] for row in fitted if name in row["off"]])
        right = np.array([row["off"][name] for row in fitted if name in row["off"] and row["right"]])
        sizes = "| |"
        if off.size:
            sizes = " | ".join(f"{size:.2f}" for size in (rms(off), rms(right), np.median(np.abs(off)) / 0.6745))
        yield f"| {name} | {100 * np.mean(held):.1f} % of {len(held):,} | {sizes} |"


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def share(found: list[bool]) -> str:
    """In percent of how many."""
    return f"{100 * np.mean(found):.1f} % of {len(found):,}" if found else "none of 0"


def tell_choices(rows: list[dict[str, Any]]) -> str:
    """Whether friction and a constant force are found where they are."""
    fitted = [row for row in rows if "refused" not in row]
    rubs = [row["found"] for row in fitted if row["rubs"] and row["told"]]
    smooth = [row["found"] for row in fitted if not row["rubs"]]
    pushed = [row["pushed"][1] for row in fitted if row["pushed"][0] and row["told"]]
    free = [row["pushed"][1] for row in fitted if not row["pushed"][0]]
    untold = sum(not row["told"] for row in fitted)
    return "\n".join([
        f"Friction is found in {share(rubs)} logs that have it, and in {share(smooth)} without; a constant force in",
        f"{share(pushed)} and {share(free)}. Refused: {len(rows) - len(fitted)}; with a doubt:",
        f"{sum(row['doubted'] for row in fitted)}; with a status that is not OK:",
        f"{sum(row['status'] != 0 for row in fitted)}; logs that cannot tell friction from a constant force,",
        f"not counted here: {untold}.",
    ])  # fmt: skip


def report(count: int, processes: int) -> str:
    """All tables."""
    noisy = judge_all(count, NOISY, processes)
    silent = judge_all(max(count // 3, 1), SILENT, processes)
    took = np.array([row["took"] for row in noisy if "took" in row])
    lines = [
        "# How good fits of logs are",
        "",
        "Written by `benchmarks/bench_fit.py --write docs/fitting.md`.",
        "",
        f"{count:,} random logs of 1,000 to 5,000 samples: devices of 30 g to 1 kg, delays of 0 to 5 periods,",
        "whole and not; steps, chirps and random forces; 300 to 100,000 steps of the encoder over the way",
        "moved, noise of 0.15 to 3 steps; friction of 3 to 25 % of the effective force in a third, a constant",
        "force in a fifth. The bound is that of Cramer and Rao for the model that made the log, with the",
        "noise and the encoder's q²/12 as white. Errors over the bound are root mean squares; their median is",
        "that of the sizes, in units of a normal error's.",
        "",
        *tabulate(noisy),
        "",
        tell_choices(noisy),
        f"A fit took {np.median(took):.2f} s of the processor (median).",
        "",
        f"{len(silent):,} logs of an encoder without any noise, whose errors are alike from sample to sample:",
        "",
        *tabulate(silent),
        "",
        tell_choices(silent),
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure, and print or write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--write", type=Path, help="file for the tables, in Markdown")
    given = parser.parse_args()
    text = report(given.logs, given.processes)
    print(text)
    if given.write:
        given.write.write_text(text)


if __name__ == "__main__":
    main()
