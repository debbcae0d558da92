#!/usr/bin/env python3
"""Compare fits to walls at the onset of instability with the true devices: K_max, its interval, and recommended walls.

    python benchmarks/bench_onsets.py [--rigid 200] [--others 200] [--processes 2] [--write docs/onsets.md]

The devices are those of `tests/oracles/measured_devices.py`, rigid or with an actuator lag, one or two resonances, or
both. Onsets and stability on the true device are computed by eigenvalues, without zwidth.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import zwidth

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "oracles"))

from measured_devices import TrueDevice

from methods.page import write_page

NOISE = 0.02  # relative standard deviation of K and f
SOFTEST = 30.0  # the search for an onset begins at K = 1e-3 m/T^2 divided by this; devices unstable there are skipped
# Relative stiffnesses at which stability is checked, because a user raises K from below.
SOFTER = np.array([0.03, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0])
INTRODUCTION = """\
# Accuracy of fits to walls at the onset of instability

The command `benchmarks/bench_onsets.py --write docs/onsets.md` writes this page.

`zwidth.fit_buzz` fits a rigid device to walls at the onset of instability. This benchmark simulates random devices.
For each rigid device, four walls are measured. All other devices have an actuator lag of 0.1 to 1 ms, one or two
resonances of 30 to 400 Hz, or both, and for each of them four to six walls are measured. The virtual dampings B of the
walls of one device are equally spaced. The smallest B is 0. The largest B is the damping of the stiffest wall,
multiplied by a random factor of 0.7 to 1.2. The measured K and the measured frequency f have independent random errors
with a relative standard deviation of 2 %; B is exact. The onsets and the stability of walls are computed from the
eigenvalues of the true device.

The column "no K_max" contains the number of fits that end with an error or with a warning. These fits recommend no
wall. Safe walls are computed for a reliability of 99 %. A safe wall counts as stable if this wall and softer walls with
the same B are stable. The last column contains the median stiffness of the safe walls. This stiffness and the median
interval width are relative to K_max of the true device.
"""


def draw_device(random: np.random.Generator, rigid: bool) -> TrueDevice:
    """Return a random rigid device, or one with a lag, resonances or both."""
    while True:
        true = TrueDevice.draw(random)
        if rigid:
            return TrueDevice("rigid", true.mass, true.damping, 0.0, (), true.delay, true.period, 1e-5, 3.0)
        if true.lag or true.modes:
            return true


def name_kind(true: TrueDevice) -> str:
    """Return the kind of a device for the table."""
    modes = ("", "one resonance", "two resonances")[len(true.modes)]
    return " and ".join(filter(None, [modes, "lag" if true.lag else ""])) or "rigid"


def raise_stiffness(true: TrueDevice, damping: float) -> tuple[float, float]:
    """Return the smallest unstable K in N/m for a damping, and the frequency of the instability in Hz; NaN if none."""
    A, B, C = true.sampled()
    size, rate = B.size, damping / true.period

    def find_dominant(stiffness: float) -> complex:
        closed = np.zeros((size + 1, size + 1))
        closed[:size, :size] = A - np.outer(B, (stiffness + rate) * C)
        closed[:size, size], closed[size, :size] = rate * B, C
        poles = np.linalg.eigvals(closed)
        return poles[np.argmax(np.abs(poles))]

    low = high = 1e-3 * true.mass / true.period**2 / SOFTEST
    if abs(find_dominant(low)) >= 1:
        return np.nan, np.nan
    while abs(find_dominant(high)) < 1:
        low, high = high, 1.02 * high
    while high - low > 1e-13 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if abs(find_dominant(middle)) < 1 else (low, middle)
    return low, abs(np.angle(find_dominant(high))) / (2 * np.pi * true.period)


def measure(seed: int, rigid: bool) -> tuple[TrueDevice, np.ndarray, float] | None:
    """Return a random device, its walls (K, B, f) with noise, and its K_max; None if a wall cannot be measured."""
    random = np.random.default_rng([11, seed, rigid])
    true = draw_device(random, rigid)
    device = zwidth.LinearDevice(true.matrices())
    top = zwidth.Scene(device, zwidth.Timing(true.period, true.delay)).max_stiffness()
    count = int(random.choice([4, 5, 5, 5, 6])) if not rigid else 4
    # From no damping to somewhat more or less than that of the stiffest wall.
    shares = np.linspace(0.0, random.uniform(0.7, 1.2), count)
    walls = [(*raise_stiffness(true, share * float(top.virtual_damping)),) for share in shares]
    table = np.array([(K, share * float(top.virtual_damping), f) for (K, f), share in zip(walls, shares, strict=True)])
    good = top.status == 0 and top.virtual_damping > 0 and np.isfinite(table).all() and (table[:, 2] < 450).all()
    table = table * (1 + NOISE * np.array([1, 0, 1]) * random.standard_normal(table.shape))
    return (true, table, float(top.stiffness)) if good else None


def judge(seed: int, rigid: bool) -> dict[str, Any] | None:
    """Return the results of a fit to the walls of one device; None if the walls cannot be measured."""
    measured = measure(seed, rigid)
    if measured is None:
        return None
    true, walls, limit = measured
    row: dict[str, Any] = {"seed": seed, "kind": name_kind(true), "unreliable": True, "refused": False}
    try:
        fit = zwidth.fit_buzz(walls, period=true.period, noise=NOISE)
    except zwidth.InputError as error:
        return {**row, "refused": True, "why": str(error)}
    row |= {"unreliable": fit.is_unreliable, "why": "; ".join(fit.warnings), "structured": fit.is_structured}
    if fit.is_unreliable:
        return row
    bar, safe, advice = fit.intervals["stiffness_max"], fit.safe_wall(), fit.recommended

    def is_stable(wall: tuple[float, float]) -> bool:
        return all(true.is_stable(softer * wall[0], wall[1]) for softer in SOFTER)

    return {
        **row,
        "held": bar.low <= limit <= bar.high,
        "width": (bar.high - bar.low) / limit,
        "safe": is_stable(safe[:2]) if safe.stiffness > 0 else None,
        "share": safe.stiffness / limit,
        "advised": is_stable((advice.stiffness, advice.virtual_damping)) if advice.stiffness > 0 else None,
    }


def judge_all(count: int, rigid: bool, processes: int) -> list[dict[str, Any]]:
    """Return the rows of the first ``count`` devices whose walls can be measured."""
    rows: list[dict[str, Any]] = []
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for row in pool.map(partial(judge, rigid=rigid), range(3 * count), chunksize=5):
            rows += [row] if row else []
            if len(rows) == count:
                pool.shutdown(cancel_futures=True)
                break
    return rows


def tabulate(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table, in Markdown."""
    yield "| device | fits | no K_max | interval contains K_max | interval width | stable safe walls | stiffness |"
    yield "|---|--:|--:|--:|--:|--:|--:|"
    kinds = sorted({row["kind"] for row in rows} - {"rigid"})
    for kind in ("rigid", *kinds, "all but rigid"):
        those = [row for row in rows if kind == row["kind"] or (kind == "all but rigid" and row["kind"] in kinds)]
        known = [row for row in those if not row["unreliable"]]
        walls = [row for row in known if row["safe"] is not None]
        held = sum(row["held"] for row in known)
        cells = [
            kind, len(those), len(those) - len(known), f"{100 * held / max(1, len(known)):.1f} %",
            f"{100 * np.median([row['width'] for row in known]):.0f} %" if known else "",
            f"{sum(row['safe'] for row in walls)} of {len(walls)}",
            f"{np.median([row['share'] for row in walls]):.2f}" if walls else "",
        ]  # fmt: skip
        yield f"| {' | '.join(map(str, cells))} |"


def report(rigid: int, others: int, processes: int) -> str:
    """Return the page."""
    rows = judge_all(rigid, True, processes) + judge_all(others, False, processes)
    for row in rows:
        if row.get("safe") is False or row.get("advised") is False or row.get("held") is False:
            print(row)
    advised = [row["advised"] for row in rows if row.get("advised") is not None]
    stable = f"On the true device, {sum(advised)} of {len(advised)} recommended walls are stable."
    return "\n".join([INTRODUCTION, *tabulate(rows), "", stable, ""])


if __name__ == "__main__":
    write_page(
        __doc__,
        report,
        rigid=(200, "rigid devices"),
        others=(200, "devices with a lag, resonances or both"),
        processes=(2, "parallel processes"),
    )
