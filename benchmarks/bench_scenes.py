#!/usr/bin/env python3
"""Measure the cost of each scene component: number of poles, time of a verdict, of a map and of the stiffest wall.

    python benchmarks/bench_scenes.py [--write docs/scenes.md]

All measurements run in one process with one thread; times are minima of several runs. Each map is compared with
`numpy.linalg.eigvals` of companion matrices of the same walls: time, and number of different labels in a sample.
"""

from __future__ import annotations

import os

# Before NumPy is loaded: both sides of every comparison use one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable
from typing import Any

import numpy as np

import zwidth
from methods.clock import time_calls
from methods.page import write_page
from zwidth.numerics.polynomials import companion
from zwidth.stability.linear.roots import affine_polynomial

MAP, SAMPLE, SCATTERED = 2000, 20_000, 100_000
# Closer to the unit circle, the error of eigenvalues exceeds their distance from it.
BLUR = 1e-7

TIMING = zwidth.Timing(period=1e-3, delay=1e-3)
DEVICE = zwidth.Device(mass=0.1, damping=10)
COUPLED = {
    sensor: zwidth.Device(0.1, 10, zwidth.Coupling(mass=0.05, stiffness=20e3, damping=1.0, sensor=sensor))
    for sensor in ("motor", "tip")
}
HAND = zwidth.Operator(mass=0.554, damping=6.45, stiffness=135)
SOFT_HAND = zwidth.Operator(0.554, 6.45, 135, coupling_stiffness=2000, coupling_damping=5)
SCENES = {
    "rigid device, backward difference": zwidth.Scene(DEVICE, TIMING),
    "hand with a rigid grasp": zwidth.Scene(DEVICE, TIMING, operator=HAND),
    "low-pass 100 Hz": zwidth.Scene(DEVICE, TIMING, velocity=zwidth.LowPass(cutoff=100)),
    "Butterworth 100 Hz, order 4": zwidth.Scene(DEVICE, TIMING, velocity=zwidth.Butterworth(100, 4)),
    "window of 10 samples": zwidth.Scene(DEVICE, TIMING, velocity=zwidth.WindowedDifference(10)),
    "coupling, sensor at the motor": zwidth.Scene(COUPLED["motor"], TIMING),
    "coupling, sensor at the tip": zwidth.Scene(COUPLED["tip"], TIMING),
    "hand with an elastic grasp": zwidth.Scene(DEVICE, TIMING, operator=SOFT_HAND),
    "low-pass, coupling and hand": zwidth.Scene(
        COUPLED["motor"], TIMING, velocity=zwidth.LowPass(cutoff=100), operator=SOFT_HAND
    ),
}


def seconds(call: Callable[[], Any], runs: int = 5) -> float:
    """Return the time of the fastest run in s."""
    return time_calls(call, runs)[0].min()


def fresh(scene: zwidth.Scene) -> zwidth.Scene:
    """Return a copy of a scene without cached results."""
    return scene.replace(mass=float(scene.device.mass))


def eigenvalue_labels(scene: zwidth.Scene, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Return the spectral radii of walls from companion matrices."""
    parts = affine_polynomial(scene.loop.roots)
    polynomials = parts.D + alpha[:, None] * parts.N1 + beta[:, None] * parts.N2
    return np.abs(np.linalg.eigvals(companion(polynomials / polynomials[:, :1]))).max(-1)


def measure(scene: zwidth.Scene) -> tuple[int, float, float, float, float, int, float]:
    """Return poles, times of a first verdict, a wall, a map wall and its eigenvalues, wrong labels, maximum time."""
    top = float(scene.max_stiffness().stiffness)
    damping = 2.0 * max(abs(float(scene.max_stiffness().virtual_damping)), 10.0)
    stiffness, rows = np.linspace(0.0, 1.5 * top, MAP), np.linspace(-0.2 * damping, damping, MAP)[:, None]
    random = np.random.default_rng(1)
    walls = random.uniform(0, 1.5 * top, SCATTERED), random.uniform(-0.2 * damping, damping, SCATTERED)
    alpha, beta = scene.normalize_walls(walls[0][:SAMPLE], walls[1][:SAMPLE])
    radius = eigenvalue_labels(scene, alpha, beta)
    clear = np.abs(radius - 1.0) > BLUR
    wrong = int(np.sum((scene.is_stable(walls[0][:SAMPLE], walls[1][:SAMPLE]) != (radius < 1.0)) & clear))
    return (
        scene.poles(top, 0.0).size,
        seconds(lambda: fresh(scene).is_stable(top, 1.0)),
        seconds(lambda: scene.is_stable(*walls)) / SCATTERED,
        seconds(lambda: scene.is_stable(stiffness, rows)) / MAP**2,
        seconds(lambda: eigenvalue_labels(scene, alpha, beta), 3) / SAMPLE,
        wrong,
        seconds(lambda: fresh(scene).max_stiffness(), 3),
    )


def report() -> str:
    """Return the table in Markdown."""
    lines = [
        "# Run times of scenes",
        "",
        "`benchmarks/bench_scenes.py --write docs/scenes.md` writes this table. All times are measured in one process",
        "with one thread. The device is the paper's PHANToM (m = 0.1 kg, b = 10 N s/m, T = 1 ms, delay of one period).",
        "Each row after the first one adds parts to this device.",
        "",
        "| column | content |",
        "|---|---|",
        "| first query | time of the first stability query for one wall, including the computation of the boundary |",
        f"| per wall | time per wall for {SCATTERED:,} random walls, each with a different damping |",
        f"| per grid wall | time per wall for a grid of {MAP**2:,} walls |",
        "| eigenvalues | time per wall of batched `numpy.linalg.eigvals` for companion matrices of the same loop, "
        "divided by the time per grid wall |",
        f"| wrong labels | labels of {SAMPLE:,} walls that differ from those of the eigenvalues; walls with a spectral "
        f"radius within {BLUR:g} of 1 are excluded |",
        "| stiffest wall | time to compute the stiffest wall of a new scene |",
        "",
        "| scene | poles | first query | per wall | per grid wall | eigenvalues | wrong labels | stiffest wall |",
        "|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    direct = None
    for name, scene in SCENES.items():
        scene.is_stable(1.0, 1.0)
        poles, first, wall, mapped, eigen, wrong, top = measure(scene)
        lines.append(
            f"| {name} | {poles} | {_spell(first * 1e3)} ms | {_spell(wall * 1e6)} us | {_spell(mapped * 1e9)} ns "
            f"| {eigen / mapped:,.0f} | {wrong} | {_spell(top * 1e3)} ms |"
        )
        if direct is None:
            direct = _rigid_ratio(scene)
    lines += [
        "",
        f"For a rigid scene, the grid takes {direct:.2f} times as long as `zwidth.is_stable` with normalized walls.",
        "",
    ]
    return "\n".join(lines)


def _spell(value: float) -> str:
    """Format a number with two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _rigid_ratio(scene: zwidth.Scene) -> float:
    """Return the time of a rigid scene relative to the closed form, measured in alternating runs."""
    stiffness, rows = np.linspace(0.0, 30e3, MAP), np.linspace(-10.0, 90.0, MAP)[:, None]
    alpha, beta = scene.normalize_walls(stiffness, rows)
    own, plain = [], []
    for _ in range(15):
        own.append(seconds(lambda: scene.is_stable(stiffness, rows), 1))
        plain.append(seconds(lambda: zwidth.is_stable(alpha, beta, scene.delta, scene.d), 1))
    return min(own) / min(plain)


if __name__ == "__main__":
    write_page(__doc__, report)
