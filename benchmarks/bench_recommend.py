#!/usr/bin/env python3
"""Check recommended walls of random devices with eigenvalues and frequency responses computed without zwidth.

    python benchmarks/bench_recommend.py [--devices 400] [--first 0]

Checks per device:

- The printed wall is stable, without an operator and in the soft reference grasps.
- The stability in each reference grasp is reported correctly.
- Cautions appear if and only if a margin is thin or the wall is unstable in a grasp.
- The printed range of B is stable and contains the printed B.
- The stiffness of each improvement agrees with the recommendation for the changed device.
"""

from __future__ import annotations

import math
import re
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import zwidth
from device_counts import build_parser, count_devices
from zwidth.analysis.cautions import LEAST_DELAY_MARGIN, LEAST_GAIN_MARGIN, LEAST_PHASE_MARGIN, LONGEST_TIME_CONSTANT

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "oracles"))

from any_loop import closed_loop_matrix, continuous, flow, velocity_polynomials

POINTS = 40_000  # frequencies on the uniform grid of an open-loop response
NEAR = 0.02  # margins this close to their threshold, relative to it, are not checked
PREFIXES = {"n": 1e-9, "µ": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3, "M": 1e6}
ROUNDING = 1e-12  # relative rounding error of a printed number times its SI prefix
TRUE_STEP = 0.02  # largest relative error of the stiffness of an improvement


def draw_scene(random: np.random.Generator) -> zwidth.Scene:
    """Return a random linear or rotary device with a common velocity estimate."""
    rotary = bool(random.integers(2))
    period, delta = 10 ** random.uniform(-4, -2.7), 10 ** random.uniform(-3, math.log10(2))
    mass = 10 ** (random.uniform(-6, -3) if rotary else random.uniform(-1.5, 0.5))
    delay = float(random.integers(0, 4)) if random.integers(2) else float(random.uniform(0, 3))
    kind = random.integers(4)
    velocity: Any = zwidth.BackwardDifference()
    if kind == 1:
        velocity = zwidth.LowPass(cutoff=10 ** random.uniform(-2, -0.5) / period)
    elif kind == 2:
        velocity = zwidth.Butterworth(10 ** random.uniform(-2, -0.5) / period, 2)
    elif kind == 3:
        velocity = zwidth.WindowedDifference(int(random.integers(2, 12)))
    timing: dict[str, Any] = {"period": period, "delay": delay * period}
    if random.integers(2):
        timing["delay"] = f"{delay!r} periods"
    device = zwidth.Device(mass, delta * mass / period, rotary=rotary)
    return zwidth.Scene(device, zwidth.Timing(**timing), velocity=velocity)


def draw_wishes(random: np.random.Generator) -> dict[str, Any]:
    """Return random requirements of a recommendation: the defaults with probability 1/2."""
    if random.integers(2):
        return {}
    wishes: list[dict[str, Any]] = [
        {"stiffness_fraction": float(random.uniform(0.3, 0.99))},
        {"phase_margin": float(random.uniform(5, 50))},
        {"gain_margin": float(random.uniform(1.1, 3))},
        {"phase_margin": 40.0, "gain_margin": 2.5},
        {"passive": True},
        {"grasps": "all"},
        {"stiffness_fraction": 0.75, "grasps": "all"},
    ]
    return wishes[random.integers(len(wishes))]


def find_radius(scene: zwidth.Scene, stiffness: float, damping: float) -> float:
    """Return the spectral radius of the closed loop."""
    return float(np.abs(np.linalg.eigvals(closed_loop_matrix(scene, stiffness, damping))).max())


def measure_margins(scene: zwidth.Scene, stiffness: float, damping: float) -> dict[str, float]:
    """Return the gain margin, the phase margin in degrees and the delay margin in s from the open-loop response."""
    a, b, sensor = continuous(scene)
    period, part = scene.timing.period, scene.d - scene.integer_delay
    step, older = flow(a, b, period)[0], flow(a, b, part * period)[1]
    rest, newer = flow(a, b, (1 - part) * period)
    eigenvalues, vectors = np.linalg.eig(step)
    left, right = sensor @ vectors, np.linalg.inv(vectors) @ np.stack([newer, rest @ older], 1)
    angle = np.concatenate([np.geomspace(1e-6, 0.02, POINTS // 4), np.linspace(0.02, math.pi, POINTS)[1:-1]])
    top, bottom = velocity_polynomials(scene)

    def respond(angle: np.ndarray) -> np.ndarray:
        z = np.exp(1j * angle)
        modal = (left / (z[:, None] - eigenvalues)) @ right
        plant = (modal[:, 0] + modal[:, 1] / z) * z**-scene.integer_delay
        return (stiffness + damping * np.polyval(top, z) / np.polyval(bottom, z)) * plant

    def cross(values: np.ndarray) -> np.ndarray:
        """Return the angles at which values change their sign, by linear interpolation."""
        index = np.flatnonzero(values[:-1] * values[1:] < 0)
        share = values[index] / (values[index] - values[index + 1])
        return angle[index] + share * (angle[index + 1] - angle[index])

    loop = respond(angle)
    unit, real = cross(np.log(np.abs(loop))), cross(np.imag(loop))
    late = np.mod(np.angle(respond(unit)) + math.pi, 2 * math.pi)
    gains = np.real(respond(np.append(real, math.pi)))
    logs = np.abs(np.log(-gains[gains < 0]))
    return {
        "gain": float(np.exp(np.min(logs, initial=math.inf))),
        "phase": math.degrees(np.min(np.minimum(late, 2 * math.pi - late), initial=math.inf)),
        "delay": float(np.min(late / unit, initial=math.inf)) * period,
    }


def judge_thin(scene: zwidth.Scene, stiffness: float, damping: float) -> bool | None:
    """Return whether a margin is thin; None if a margin is too close to its threshold for a check."""
    margins, period = measure_margins(scene, stiffness, damping), scene.timing.period
    constant = -period / math.log(find_radius(scene, stiffness, damping))
    ratios = (
        math.log(margins["gain"]) / math.log(LEAST_GAIN_MARGIN),
        margins["phase"] / LEAST_PHASE_MARGIN,
        margins["delay"] / (LEAST_DELAY_MARGIN * period),
        LONGEST_TIME_CONSTANT / constant,
    )
    if min(ratios) < 1 - NEAR:
        return True
    return False if min(ratios) > 1 + NEAR else None


def judge_grasps(scene: zwidth.Scene, stiffness: float, damping: float) -> dict[str, bool]:
    """Return whether a wall is stable in each reference grasp, by the name of the grasp."""
    found: dict[str, bool] = {}
    for radius in zwidth.model.grasps.RADII if scene.device.rotary else (None,):
        for name, hand in zwidth.reference_grasps(radius).items():
            held = scene.replace(operator=hand)
            found[name] = found.get(name, True) and find_radius(held, stiffness, damping) < 1
    return found


def improve(scene: zwidth.Scene, step: Any) -> zwidth.Scene:
    """Return a new scene with an improvement from `Recommendation.improvements`."""
    device, timing = scene.device, scene.timing
    velocity: Any = scene.velocity
    period, delay = timing.period, timing.delay
    if "rate" in step.label:
        kept_periods = step.name == "period_and_delay" or timing.in_periods
        if isinstance(velocity, zwidth.WindowedDifference):
            velocity = zwidth.WindowedDifference(2 * velocity.samples)
        later = f"{float(scene.d)!r} periods" if kept_periods else delay
        return zwidth.Scene(device, zwidth.Timing(period=period / 2, delay=later), velocity=velocity)
    if step.label == "half the delay":
        return zwidth.Scene(device, zwidth.Timing(period=period, delay=0.5 * scene.d * period), velocity=velocity)
    if "damping" in step.label:
        device = zwidth.Device(device.mass, 1.1 * device.damping, rotary=device.rotary)
    elif step.label == "no velocity filter":
        velocity = zwidth.BackwardDifference()
    elif "filter" in step.label:
        velocity = replace(velocity, cutoff=2 * velocity.cutoff)
    else:
        assert "window" in step.label, step.label
        velocity = zwidth.WindowedDifference(max(1, round(velocity.samples / 2)))
    return zwidth.Scene(device, timing, velocity=velocity)


def check_device(seed: int) -> tuple[Counter[str], list[str]]:
    """Return the counts of one device and its failures."""
    random = np.random.default_rng(seed)
    scene, wishes = draw_scene(random), draw_wishes(random)
    counts, failures = Counter(devices=1), []

    def count(name: str, right: bool, more: str = "") -> None:
        counts[name] += 1
        counts[f"right: {name}"] += right
        if not right:
            failures.append(f"{name} {more}".rstrip())

    found = scene.recommend(**wishes)
    counts["default wishes"] += not wishes
    if found.status != zwidth.Status.OK:
        return counts + Counter(without_a_wall=1), failures
    K, B, _ = found.rounded_wall
    for wall in ((K, B), (found.stiffness, found.virtual_damping)):
        count("walls stable", find_radius(scene, *wall) < 1, f"{wall}")
    grasps = judge_grasps(scene, found.stiffness, found.virtual_damping)
    count("labels of grasps", grasps == found.grasps, f"{grasps} {found.grasps}")
    soft = all(stable for name, stable in judge_grasps(scene, K, B).items() if name.startswith("soft"))
    if not wishes:
        count("stable in soft hands", soft)
    if wishes.get("grasps") == "all":
        count("stable in all hands", all(judge_grasps(scene, K, B).values()))
    held = any("in the hand" in each for each in found.cautions)
    count("cautions of hands", held == (not all(grasps.values())))
    thin, printed = judge_thin(scene, found.stiffness, found.virtual_damping), len(found.cautions) > held
    if thin is not None:
        count("cautions of margins", thin == printed, f"thin {thin}: {found.cautions}")
    for caution in found.cautions:
        check_remedy(caution, scene, count)
    ends = read_range(found.lines()[1])
    assert ends is not None, found.lines()
    spare = ROUNDING * max(abs(B), *map(abs, ends))
    inside = ends[0] - spare <= B <= ends[1] + spare
    stable = all(find_radius(scene, K, end) < 1 for end in ends)
    count("printed ranges", stable and inside, f"{found.lines()[:2]}")
    for step in found.improvements:
        true = improve(scene, step).recommend(**wishes).stiffness
        right = bool(abs(step.stiffness / true - 1) < TRUE_STEP)
        count("improvements", right, f"{step.label}: {step.stiffness / true:.4f} of the true one")
    return counts, failures


def check_remedy(caution: str, scene: zwidth.Scene, count: Any) -> None:
    """Count whether the wall that a caution proposes is stable in all grasps, or has no thin margin."""
    wall = re.search(r": K = (\S+) (\S*?)N(?:/m| m/rad).*?, B = (\S+) (\S*?)N (?:s/m|m s/rad) \(", caution)
    if wall is None:
        count("cautions with a remedy", False, caution)
        return
    count("cautions with a remedy", True)
    K, B = float(wall[1]) * PREFIXES[wall[2]], float(wall[3]) * PREFIXES[wall[4]]
    stable = find_radius(scene, K, B) < 1
    if "in the hand" in caution:
        count("walls of cautions of hands", stable and all(judge_grasps(scene, K, B).values()), caution)
    elif (thin := judge_thin(scene, K, B)) is not None:
        count("walls of cautions of margins", stable and not thin, caution)


def read_range(line: str) -> tuple[float, float] | None:
    """Return the ends of the printed stable range of B in N s/m or N m s/rad; None if the line has no range."""
    unit = r"(\S*?)N (?:s/m|m s/rad)"
    found = re.search(rf"B from (\S+)(?: {unit})? to (\S+) {unit} is stable", line)
    if found is None:
        return None
    low, low_prefix, high, high_prefix = found.groups()
    return float(low) * PREFIXES[high_prefix if low_prefix is None else low_prefix], float(high) * PREFIXES[high_prefix]


if __name__ == "__main__":
    count_devices(build_parser(__doc__, 400).parse_args(), check_device)
