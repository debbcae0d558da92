#!/usr/bin/env python3
"""Measure time simulations: samples per second of a batch, compared with a NumPy loop and scipy.signal.dlsim.

    python benchmarks/bench_simulation.py [--write docs/simulation.md]

All measurements run in one process; times are minima of several runs after a first run that compiles. The error is the
largest difference from the positions of the loop and of dlsim, relative to the largest position.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.linalg
import scipy.signal

import zwidth
from methods.clock import time_calls
from methods.page import write_page

SCENES, PERIODS, BESIDE = 10_000, 1000, 20
PUSH = 0.5


def random_scenes() -> tuple[list[zwidth.Scene], np.ndarray, np.ndarray]:
    """Return random devices and delays, each with a wall of half its maximum stiffness."""
    random = np.random.default_rng(1)
    scenes = [
        zwidth.Scene(
            zwidth.Device(mass=10 ** random.uniform(-1.5, 0), damping=10 ** random.uniform(-1, 1)),
            zwidth.Timing(period=1e-3, delay=random.choice([0.0, 1e-3, 1.5e-3, 2e-3])),
        )
        for _ in range(SCENES)
    ]
    delta, d = np.array([(scene.delta, scene.d) for scene in scenes]).T
    top = zwidth.alpha_max(delta, d)
    units = np.array([scene.units for scene in scenes])
    return scenes, 0.5 * top.alpha * units[:, 0], top.beta * units[:, 1]


def loop_in_numpy(scene: zwidth.Scene, stiffness: float, virtual_damping: float) -> np.ndarray:
    """Simulate by a plain loop over samples with precomputed device matrices."""
    period, mass = scene.timing.period, scene.device.mass
    rate = np.array([[0.0, 1.0, 0.0], [0.0, -scene.device.damping / mass, 1.0 / mass], [0.0, 0.0, 0.0]])
    fraction = scene.d - scene.integer_delay
    first, second = scipy.linalg.expm(rate * fraction * period), scipy.linalg.expm(rate * (1 - fraction) * period)
    commands = deque([0.0] * (scene.integer_delay + 2), maxlen=scene.integer_delay + 2)
    state, last, positions = np.zeros(2), 0.0, np.empty(PERIODS)
    for k in range(PERIODS):
        positions[k] = position = state[0]
        commands.append(-(stiffness * position + virtual_damping * (position - last) / period))
        last = position
        state = first[:2, :2] @ state + first[:2, 2] * (commands[0] + PUSH)
        state = second[:2, :2] @ state + second[:2, 2] * (commands[1] + PUSH)
    return positions


def dlsim(scene: zwidth.Scene, stiffness: float, virtual_damping: float) -> np.ndarray:
    """Simulate the closed loop by scipy.signal.dlsim."""
    system = scene.state_space(stiffness, virtual_damping)
    return scipy.signal.dlsim((system.A, system.B, system.C, system.D, system.dt), np.full(PERIODS, PUSH))[1][:, 0]


def seconds(call: Callable[[], Any], runs: int = 3) -> float:
    """Return the time of the fastest run in s."""
    return time_calls(call, runs)[0].min()


def report() -> str:
    """Return the tables in Markdown."""
    scenes, stiffness, damping = random_scenes()
    walls = list(zip(scenes[:BESIDE], stiffness[:BESIDE].tolist(), damping[:BESIDE].tolist(), strict=True))
    options: dict[str, Any] = {"periods": PERIODS, "external_force": PUSH, "record": False}
    cold = seconds(lambda: zwidth.simulate(scenes, stiffness, damping, **options), 1)
    each = SCENES * PERIODS
    own = seconds(lambda: zwidth.simulate(scenes, stiffness, damping, **options)) / each
    few = zwidth.simulate(scenes[:BESIDE], stiffness[:BESIDE], damping[:BESIDE], periods=PERIODS, external_force=PUSH)
    assert few.position is not None, "a recorded motion"
    lines = [
        "# Run times of simulations",
        "",
        "The command `benchmarks/bench_simulation.py --write docs/simulation.md` writes this page.",
        "",
        "## Linear loops",
        "",
        f"The batch contains {SCENES:,} devices with different masses, dampings and delays, each with a different",
        f"wall. A constant external force acts for {PERIODS:,} periods. The time per sample is the time of the",
        f"whole call, divided by the number of devices and periods. The other methods simulate {BESIDE} of the",
        "devices in the same process. The last column is the largest difference of a position from that of",
        "`zwidth.simulate`, relative to the largest position.",
        "",
        "| method | time per sample | relative to the batch | largest difference |",
        "|---|--:|--:|--:|",
        f"| `zwidth.simulate`, one batch | {own * 1e9:.0f} ns | 1 | |",
    ]
    for name, method in (("loop in NumPy", loop_in_numpy), ("`scipy.signal.dlsim`", dlsim)):
        spent = seconds(lambda method=method: [method(*wall) for wall in walls]) / (BESIDE * PERIODS)
        peers = np.array([method(*wall) for wall in walls])
        error = np.abs(peers - few.position).max() / np.abs(few.position).max()
        lines.append(f"| {name} | {spent * 1e9:,.0f} ns | {spent / own:,.0f} | {error:.0e} |")
    lines += ["", f"The first call includes the compilation and took {cold:.1f} s.", "", *report_parts(), ""]
    return "\n".join(lines)


def report_parts() -> list[str]:
    """Return the table of the cost of nonlinear components, for one device and many walls."""
    timing = zwidth.Timing(period=1e-3, delay=1e-3)
    device = zwidth.Device(mass=0.1, damping=1.0)
    bare, coupled = zwidth.Scene(device, timing), zwidth.Device(0.1, 1.0, zwidth.Coupling(0.05, 20e3, 1.0))
    hit = {"start_position": -1e-4, "start_velocity": 0.1, "contact": "unilateral"}
    cases: dict[str, tuple[zwidth.Scene, dict[str, Any]]] = {
        "linear": (bare, {"start_position": 1e-4}),
        "contact": (bare, hit),
        "contact, encoder, saturation": (bare, {**hit, "resolution": 2e-5, "max_force": 8.0}),
        "contact, encoder, saturation, friction": (bare, {**hit, "resolution": 2e-5, "max_force": 8.0, "coulomb": 0.1}),
        "contact and jitter": (bare, {**hit, "jitter": 2e-4}),
        "FOAW and encoder": (
            zwidth.Scene(device, timing, velocity=zwidth.FOAW(noise=2e-5)),
            {**hit, "resolution": 2e-5},
        ),
        "coupling, contact": (zwidth.Scene(coupled, timing), hit),
        "coupling, contact and friction": (zwidth.Scene(coupled, timing), {**hit, "coulomb": 0.1}),
    }
    lines = [
        "## Nonlinear effects",
        "",
        "One device is simulated with 1,000 walls for 1,000 periods, without recording the trajectories. The last",
        "column is the time of one simulation with one wall and a recorded trajectory. The first call includes",
        "the compilation, unless a scene in a row above uses the same compiled program.",
        "",
        "| scene | first call | time per sample, 1,000 walls | one recorded simulation |",
        "|---|--:|--:|--:|",
    ]
    stiffness = np.linspace(100.0, 10e3, 1000)
    for name, (scene, options) in cases.items():
        cold = seconds(lambda s=scene, o=options: s.simulate(stiffness, 10.0, record=False, **o), 1)
        scene.simulate(5e3, 10.0, **options)
        many = seconds(lambda s=scene, o=options: s.simulate(stiffness, 10.0, record=False, **o)) / 1e6
        one = seconds(lambda s=scene, o=options: s.simulate(5e3, 10.0, **o))
        lines.append(f"| {name} | {cold:.1f} s | {many * 1e9:,.0f} ns | {one * 1e3:.0f} ms |")
    return lines


if __name__ == "__main__":
    write_page(__doc__, report)
