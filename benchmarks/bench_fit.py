#!/usr/bin/env python3
"""Measure fits of logs: errors, coverage of the intervals, and stability of the safe walls on the true device.

    python benchmarks/bench_fit.py [--logs 1000] [--devices 1000] [--processes 2] [--write docs/fitting.md]

Devices, delays, forces, encoders, noise and clocks are random; two thirds of the devices have friction. Errors are
relative to the Cramer-Rao bound for white noise plus the encoder's quantization variance q^2/12. The logs use the
closed forms of the fit, which tests/unit/identification/test_friction_model.py compares with `zwidth.simulate`; logs in
contact with a wall are computed step by step. Logs of devices with lags and resonances come from the matrices of
`tests/oracles/measured_devices.py`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import zwidth
from zwidth.identification.extended_model import Recordings
from zwidth.identification.friction_model import Recording

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "oracles"))

import measured_devices

from methods.page import write_page

PERIOD, SKIP = 1e-3, 22
NAMES = ("mass", "damping", "delay", "friction")
KINDS = ("to and fro", "single push", "closed by a wall", "jittered stamps")
# Bounds of the noise relative to the encoder step: for the main table, and without noise.
NOISY, SILENT = (0.15, 3.0), (0.0, 0.0)


class Made(NamedTuple):
    """A log and its true parameters: device, delay, friction, offset, noise standard deviation and encoder step."""

    kind: str
    time: Any
    force: np.ndarray
    position: np.ndarray
    truth: tuple[float, float, float, float, float]
    noise: float
    step: float


class Mover(NamedTuple):
    """A device in units of the period, in the form required by `Recording.move`."""

    g: float
    delta: float
    d: float
    offset: float
    friction: float


def make_log(seed: int, share: tuple[float, float]) -> Made:
    """Return a random log; ``share`` bounds the noise relative to the encoder step."""
    random = np.random.default_rng([7, seed])
    kind = KINDS[seed % len(KINDS)]
    count = int(random.choice([1000, 2000, 5000]))
    mass = float(np.exp(random.uniform(np.log(0.03), 0.0)))
    delta = float(np.exp(random.uniform(np.log(2e-3), np.log(0.1))))
    d = float(random.uniform(0, 5)) if random.random() < 0.6 else float(random.integers(0, 6))
    force = np.concatenate([np.zeros(SKIP), make_force(random, count, kind)])
    effective = float(np.sqrt(np.mean(force[force != 0] ** 2)))
    friction = effective * np.exp(random.uniform(np.log(0.002), np.log(0.3))) if random.random() < 2 / 3 else 0.0
    offset = random.uniform(-0.05, 0.05) if random.random() < 0.2 else 0.0
    g = PERIOD**2 / mass
    device = Mover(g, delta, d, g * offset, g * friction)
    wall, white = (0.0, 0.0), random.standard_normal(count)
    if kind == "closed by a wall":
        stiffest = zwidth.Scene(
            zwidth.Device(mass, delta * mass / PERIOD), zwidth.Timing(period=PERIOD, delay=d * PERIOD)
        ).max_stiffness()
        wall = (random.uniform(0.02, 0.3) * float(stiffest.stiffness), 0.7 * float(stiffest.virtual_damping))
    moved = respond(device, force, wall, 0.0, np.zeros(count))[1]
    step = float(np.ptp(moved) / np.exp(random.uniform(np.log(300), np.log(1e5))))
    noise = step * (np.exp(random.uniform(*np.log(share))) if share[0] else 0.0)
    force, moved, read = respond(device, force, wall, step, step * random.uniform() + noise * white)
    position = np.concatenate([np.full(SKIP, read[0]), read])
    clock: Any = PERIOD
    if kind == "jittered stamps":
        clock = PERIOD * (np.arange(position.size) + random.uniform(0.01, 0.4) * random.random(position.size))
    return Made(kind, clock, force, position, (mass, delta * mass / PERIOD, d * PERIOD, friction, offset), noise, step)


def make_force(random: np.random.Generator, count: int, kind: str) -> np.ndarray:
    """Return alternating steps, a chirp, random steps or a single push, in N."""
    if kind == "single push":
        first, lasts = random.integers(5, 60), random.integers(20, 200)
        return np.where((np.arange(count) >= first) & (np.arange(count) < first + lasts), 1.0, 0.0)
    shape, held = random.integers(3), int(random.integers(8, 60))
    if shape == 1:
        now = PERIOD * np.arange(count)
        return np.sin(2 * np.pi * (2 * now + 10 / (count * PERIOD) * now**2))
    steps = random.choice([-1.0, 1.0], count // held + 1) if shape == 0 else random.standard_normal(count // held + 1)
    return np.repeat(steps, held)[:count]


def respond(
    device: Mover, force: np.ndarray, wall: tuple[float, float], step: float, errors: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return forces, positions and encoder readings; a wall adds a force computed from the readings."""
    count = force.size - SKIP

    def read(place: Any, error: Any) -> Any:
        return step * np.round((place + error) / step) if step else place + error

    if wall[0]:
        force, whole = force.copy(), int(np.floor(device.d))
        f = device.d - whole
        place, speed, before = 0.0, 0.0, float(read(0.0, errors[0]))
        for k in range(count):
            now = float(read(place, errors[k]))
            force[SKIP + k] -= wall[0] * now + wall[1] * (now - before) / PERIOD
            before = now
            for last, lasts in ((1, f), (0, 1.0 - f)):
                push = device.g * force[SKIP + k - whole - last] + device.offset
                place, speed = glide(place, speed, push, lasts, device.delta, device.friction)
    moved = Recording(force, np.zeros(count), SKIP).move(*device[:3], 0.0, 0.0, *device[3:]).position
    return force, moved, read(moved, errors)


def glide(place: float, speed: float, push: float, lasts: float, delta: float, friction: float) -> tuple[float, float]:
    """Return position and speed after a constant push, including reversals and sticking."""
    while lasts > 0:
        way = np.sign(speed) or (np.sign(push) if abs(push) > friction else 0.0)
        if not way:
            return place, 0.0
        a = push - way * friction
        stops = np.log1p(-delta * speed / a) / delta if speed and a * way < 0 else np.inf
        t = min(lasts, stops)
        decay = -np.expm1(-delta * t) / delta
        place += decay * speed + (t - decay) / delta * a
        speed = 0.0 if t == stops else speed * np.exp(-delta * t) + decay * a
        lasts -= t
    return place, speed


def bound_errors(made: Made) -> dict[str, float]:
    """Return the Cramer-Rao bounds of the fitted model as standard errors; empty if they cannot be computed."""
    mass, damping, delay, friction, offset = made.truth
    model = Recordings((Recording(made.force, made.position[SKIP:], SKIP),))
    g = PERIOD**2 / mass
    # At zero friction its derivative would vanish.
    theta = np.array([g, damping * PERIOD / mass, delay / PERIOD, 0, 0, g * offset, g * max(friction, 1e-12)])
    by_truth = np.eye(theta.size)
    by_truth[[0, 1], 0] = -theta[:2] / mass
    by_truth[1, 1], by_truth[2, 2] = PERIOD / mass, 1 / PERIOD
    by_truth[[5, 6], 0], by_truth[5, 5], by_truth[6, 6] = -theta[5:] / mass, g, g
    slopes = model.simulate(theta).derivatives @ by_truth
    sizes = np.linalg.norm(slopes, axis=0)
    seen = sizes > 0
    slopes = slopes[:, seen] / sizes[seen]
    if np.linalg.cond(slopes) > 1e6:
        return {}
    variance = made.noise**2 + made.step**2 / 12
    errors = np.full(theta.size, np.nan)
    errors[seen] = np.sqrt(variance * np.sum(np.linalg.pinv(slopes) ** 2, axis=1)) / sizes[seen]
    return {str(name): float(error) for name, error in zip(NAMES, errors[[0, 1, 2, 6]], strict=True)}


def judge(seed: int, span: tuple[float, float]) -> dict[str, Any]:
    """Return the results of the fit of one log, compared with the true parameters."""
    made = make_log(seed, span)
    bounds = bound_errors(made)
    start = time.process_time()
    try:
        fit = zwidth.fit_log(made.time, made.position, made.force, resample=made.kind == "jittered stamps")
    except zwidth.ZwidthError as error:
        return {"seed": seed, "kind": made.kind, "refused": str(error)}
    took = time.process_time() - start
    truth: dict[str, float] = {str(name): value for name, value in zip((*NAMES, "offset"), made.truth, strict=True)}
    scene = zwidth.Scene(
        zwidth.Device(truth["mass"], truth["damping"]), zwidth.Timing(period=PERIOD, delay=truth["delay"])
    )
    truth["stiffness_max"] = float(scene.max_stiffness().stiffness)
    known = {name: bar for name, bar in fit.intervals.items() if np.isfinite(bar.low) and name in truth}
    safe = fit.safe_wall()
    # Errors in units of standard errors.
    away = {name: abs(getattr(fit, name) - truth[name]) * fit.coverage_factor / (bar.high - getattr(fit, name))
            for name, bar in known.items()}  # fmt: skip
    return {
        "seed": seed,
        "kind": made.kind,
        "took": took,
        "held": {name: bar.low <= truth[name] <= bar.high for name, bar in known.items()},
        "off": {name: (getattr(fit, name) - truth[name]) / bounds[name] for name in NAMES if bounds and name in known},
        "open": "friction" not in known,
        "away": away,
        "status": fit.status,
        "warnings": fit.warnings,
        "safe": bool(scene.is_stable(safe.stiffness, safe.virtual_damping)) if safe.stiffness > 0 else None,
        "share": safe.stiffness / truth["stiffness_max"],
        "width": measure_width(fit),
    }


def measure_width(fit: zwidth.DeviceFit) -> float:
    """Return the width of the interval of K_max relative to K_max; NaN without an interval."""
    low, high = fit.intervals["stiffness_max"]
    return (high - low) / fit.stiffness_max


def judge_device(seed: int) -> dict[str, Any]:
    """Return the results of one device that may have a lag or resonances, with walls checked on the true device."""
    random = np.random.default_rng([8, seed])
    true = measured_devices.TrueDevice.draw(random)
    count = int(random.choice([1000, 2000, 5000]))
    force = true.limit * make_force(random, count, "to and fro")
    force /= max(1.0, np.abs(force / true.limit).max())
    exact = true.play(force, read=False)
    noise = true.encoder * np.exp(random.uniform(*np.log(NOISY)))
    read = true.encoder * np.round((exact + noise * random.standard_normal(count)) / true.encoder)
    row: dict[str, Any] = {"seed": seed, "kind": true.kind + (" and amplifier" if true.lag and true.modes else "")}
    try:
        fit = zwidth.fit_log(true.period, read, force)
    except zwidth.ZwidthError:
        return row | {"given": False}
    if fit.is_unreliable:
        return row | {"given": False}
    limit, bar, safe, rigid = (
        true.limit_of_walls(),
        fit.intervals["stiffness_max"],
        fit.safe_wall(),
        fit.safe_wall(rigid=True),
    )
    return row | {
        "given": True,
        "held": bar.low <= limit <= bar.high,
        "width": measure_width(fit),
        "safe": true.is_stable(*safe[:2]) if safe.stiffness > 0 else None,
        "share": safe.stiffness / limit,
        # Without a wall that is stable on all sampled devices, there is nothing to check.
        "rigid": bool(np.isfinite(rigid.stiffness)) and true.is_stable(*rigid[:2]),
    }


def judge_all(judge: Callable[[int], dict[str, Any]], count: int, processes: int) -> list[dict[str, Any]]:
    """Return the results of ``count`` logs, computed in parallel processes."""
    if processes == 1:
        return [judge(seed) for seed in range(count)]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        return list(pool.map(judge, range(count), chunksize=10))


def tabulate(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table of coverage and errors, in Markdown."""
    yield "| | 95 % interval contains the true value | RMS error / bound | median error / bound |"
    yield "|---|--:|--:|--:|"
    for name in (*NAMES, "offset", "stiffness_max"):
        held = [row["held"][name] for row in rows if name in row["held"]]
        off = np.array([row["off"][name] for row in rows if name in row["off"]])
        sizes = " | "
        if off.size:
            sizes = " | ".join(f"{size:.2f}" for size in (rms(off), np.median(np.abs(off)) / 0.6745))
        yield f"| {name} | {share(held)} | {sizes} |"


def tabulate_kinds(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table by kind of log, in Markdown."""
    columns = (
        "mass | damping | delay | friction | offset | K_max | friction not determined | with a warning | safe walls"
    )
    yield f"| kind | {columns} |"
    yield "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|"
    for kind in KINDS:
        those = [row for row in rows if row["kind"] == kind]
        held = [share([row["held"][name] for row in those if name in row["held"]])
                for name in (*NAMES, "offset", "stiffness_max")]  # fmt: skip
        safe = [row["safe"] for row in those if row["safe"] is not None]
        warned = sum(bool(row["warnings"]) for row in those)
        cells = [*held, str(sum(row["open"] for row in those)), str(warned), f"{sum(safe)} of {len(safe)}"]
        yield f"| {kind} | {' | '.join(cells)} |"


def tabulate_devices(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table for devices with lags and resonances, in Markdown."""
    columns = "with K_max | interval contains K_max | interval width | stable safe walls | stiffness | rigid safe walls"
    yield f"| device | logs | {columns} |"
    yield "|---|--:|--:|--:|--:|--:|--:|--:|"
    for kind in (*sorted({row["kind"] for row in rows}), "all"):
        those = [row for row in rows if kind in (row["kind"], "all")]
        given = [row for row in those if row["given"]]
        walls = [row for row in given if row["safe"] is not None]
        shares = f"{np.median([row['share'] for row in walls]):.2f}" if walls else ""
        width = f"{100 * np.median([row['width'] for row in given]):.1f} %" if given else ""
        cells = [len(those), len(given), share([row["held"] for row in given]), width,
                 f"{sum(row['safe'] for row in walls)} of {len(walls)}", shares,
                 f"{sum(row['rigid'] for row in given)} of {len(given)}"]  # fmt: skip
        yield f"| {kind} | {' | '.join(map(str, cells))} |"


def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def share(found: list[bool]) -> str:
    """Return a percentage and the number of cases."""
    return f"{100 * np.mean(found):.1f} % of {len(found):,}" if found else "none of 0"


def spell_widths(rows: list[dict[str, Any]]) -> str:
    """Return a sentence about the widths of the intervals of K_max."""
    widths = [row["width"] for row in rows if np.isfinite(row["width"])]
    middle, high = 100 * np.quantile(widths, [0.5, 0.9])
    median = f"The median width of the intervals of K_max is {middle:.1f} % of K_max"
    return f"{median}; a tenth of the intervals are wider than {high:.0f} %."


def tell_rest(rows: list[dict[str, Any]], fitted: list[dict[str, Any]]) -> str:
    """Return a text on rejected fits, fits with warnings, and wrong fits without warnings."""
    sure = [row for row in fitted if row["status"] == 0 and not row["warnings"]]
    wrong = [row for row in sure if max(row["away"].values()) > 5]
    safe = [row["safe"] for row in fitted if row["safe"] is not None]
    low, middle, high = np.quantile([row["share"] for row in fitted if row["safe"] is not None], [0.1, 0.5, 0.9])
    spread = f"{middle:.2f}; the 10 % quantile is {low:.2f}, and the 90 % quantile is {high:.2f}"
    warned, troubled = sum(bool(row["warnings"]) for row in fitted), sum(row["status"] != 0 for row in fitted)
    return "\n".join([
        f"Logs for which the fit ends with an error: {len(rows) - len(fitted)}. Fits with a warning: {warned}.",
        f"Fits with a status other than OK: {troubled}. {spell_widths(fitted)}",
        f"In {len(wrong)} of {len(sure)} fits without a warning and with the status OK, an estimate differs from the",
        "true value by more than 5 standard errors.",
        f"On the true device, {sum(safe)} of {len(safe)} safe walls are stable.",
        f"The median stiffness of a safe wall, divided by K_max of the true device, is {spread}.",
        "Safe walls are softer than K_max, because a log cannot exclude all resonances. The devices of this test have",
        "no resonances.",
    ])  # fmt: skip


def report(count: int, parts: int, processes: int) -> str:
    """Return the page with all tables."""
    noisy, silent = (
        judge_all(partial(judge, span=span), size, processes)
        for size, span in ((count, NOISY), (max(count // 3, 1), SILENT))
    )
    devices = judge_all(judge_device, parts, processes)
    fitted, quiet = ([row for row in rows if "refused" not in row] for rows in (noisy, silent))
    for row in (*noisy, *silent):
        if "refused" in row or row["safe"] is False or (not row["warnings"] and max(row["away"].values()) > 5):
            print(row)
    # Depends on the machine, so not part of the page.
    print(f"a fit took {np.median([row['took'] for row in fitted]):.2f} s of the processor (median)")
    lines = [
        "# Accuracy of fits to logs",
        "",
        "The command `benchmarks/bench_fit.py --write docs/fitting.md` writes this page.",
        "",
        f"{count:,} random logs of 1,000 to 5,000 samples are fitted. The rigid devices have masses of 30 g to 1 kg",
        "and integer or fractional delays of 0 to 5 periods. The range of motion is 300 to 100,000 encoder steps,",
        "and the noise is 0.15 to 3 steps. Two thirds of the devices have friction of 0.2 to 30 % of the RMS",
        "force, and a fifth of them have a constant force. There are four kinds of logs, and each kind makes up a",
        "quarter of the logs:",
        "",
        "- to and fro: the force consists of steps, a chirp or random values;",
        "- single push: the device is pushed once;",
        "- closed by a wall: the device also moves in a virtual wall with 2 to 30 % of the maximum stiffness;",
        "- jittered stamps: the timestamps have a jitter of 1 to 40 % of a period.",
        "",
        "Every fit estimates friction and a constant force. The bound is the Cramér-Rao lower bound of the standard",
        "error for the fitted model. It treats the noise and the quantization error of the encoder (variance q²/12",
        'for an encoder step q) as white noise. The columns "RMS error / bound" and "median error / bound" contain',
        "errors divided by this bound. The median error is the median of the absolute errors, divided by 0.6745, so",
        "that it equals the standard deviation for normal errors. Intervals of friction and of the constant force",
        'are counted only if the log determines these two parameters. The column "safe walls" contains the number',
        "of safe walls that are stable on the true device.",
        "",
        *tabulate(fitted),
        "",
        *tabulate_kinds(fitted),
        "",
        tell_rest(noisy, fitted),
        "",
        f"In {len(silent):,} further logs, the positions have no noise except the quantization error of the encoder,",
        "which is autocorrelated.",
        "",
        *tabulate(quiet),
        "",
        tell_rest(silent, quiet),
        "",
        f"{parts:,} further logs are those of devices that can have an actuator lag of 0.1 to 1 ms, and one or two",
        "resonances with frequencies of 30 to 400 Hz and damping ratios of 0.5 to 10 %. The devices are moved to",
        "and fro. The encoder steps are 1 to 40 µm, and the noise is as above. The table reports K_max for fits",
        "without a warning. Each fit includes the actuator lag and the resonances that are detected in the log. The",
        "interval of K_max also includes devices with one additional resonance; the prior probability of this",
        "resonance is 50 %. The interval width is a median, relative to the fitted K_max. The stiffness is the median",
        "stiffness of the safe walls, relative to K_max of the true device.",
        '"Stable safe walls" are the walls of `safe_wall()` that are stable on the true device. These walls',
        'are computed for devices that may have a resonance hidden in the log. "Rigid safe walls" are the walls of',
        "`safe_wall(rigid=True)` that are stable on the true device. These walls are computed without hidden",
        "resonances.",
        "",
        *tabulate_devices(devices),
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    write_page(
        __doc__,
        report,
        logs=(1000, "logs of rigid devices"),
        devices=(1000, "logs of devices with lags and resonances"),
        processes=(2, "parallel processes"),
    )
