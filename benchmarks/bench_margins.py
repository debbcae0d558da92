#!/usr/bin/env python3
"""Print the table of docs/guides/my-device.md that compares requirements for recommended walls.

    python benchmarks/bench_margins.py [--count 60]

Random devices have a mass of 10 g to 1 kg (or the inertia of such a mass at a radius of 1 to 10 cm), delta 0.001 to 2,
a delay of 0 to 3 periods, a period of 0.1 to 3 ms and, in half of the cases, a velocity filter. Nearby devices differ
by up to 20 % in mass, 50 % in damping, and 10 % plus a tenth of a period in delay.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

import zwidth

REQUIREMENTS: dict[str, dict[str, Any]] = {
    "75 % of K_max": {"stiffness_fraction": 0.75},
    "20 deg, gain 1.4": {"phase_margin": 20, "gain_margin": 1.4},
    "30 deg, gain 1.6": {"phase_margin": 30, "gain_margin": 1.6},
    "**30 deg, gain 2**": {"phase_margin": 30, "gain_margin": 2},
    "40 deg, gain 2": {"phase_margin": 40, "gain_margin": 2},
}
NEARBY = 50  # number of nearby devices per random device


def draw_scene(random: np.random.Generator) -> zwidth.Scene:
    """Return a random linear or rotary device in its loop."""
    rotary, period = bool(random.integers(2)), 10 ** random.uniform(-4, -2.52)
    mass = 10 ** random.uniform(-2, 0) * (10 ** random.uniform(-4, -2) if rotary else 1.0)
    damping = 10 ** random.uniform(-3, np.log10(2)) * mass / period
    cutoff = 10 ** random.uniform(-2, -0.5) / period
    filters: tuple[Any, ...] = (zwidth.LowPass(cutoff=cutoff), zwidth.Butterworth(cutoff, 2))
    velocity = filters[random.integers(2)] if random.integers(2) else zwidth.BackwardDifference()
    timing = zwidth.Timing(period, random.uniform(0, 3) * period)
    return zwidth.Scene(zwidth.Device(mass, damping, rotary=rotary), timing, velocity=velocity)


def count_unstable(scene: zwidth.Scene, random: np.random.Generator) -> float:
    """Return the proportion of nearby devices on which the wall of a scene is unstable."""
    period, unstable = scene.timing.period, 0
    for mass, damping, delay, shift in random.uniform(-1, 1, (NEARBY, 4)):
        later = scene.timing.delay * (1 + 0.1 * delay) + 0.1 * shift * period
        device = scene.device
        near = scene.replace(
            mass=device.mass * (1 + 0.2 * mass), damping=device.damping * (1 + 0.5 * damping), delay=max(later, 0.0)
        )
        unstable += not near.is_stable()
    return unstable / NEARBY


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60)
    rows: dict[str, list[tuple[float, float, float, bool, bool]]] = {name: [] for name in REQUIREMENTS}
    for seed in range(parser.parse_args().count):
        scene = draw_scene(np.random.default_rng(seed))
        for name, wanted in REQUIREMENTS.items():
            found = scene.recommend(**wanted)
            share = found.stiffness / float(found.stiffest.stiffness)
            unstable = count_unstable(found.scene, np.random.default_rng(seed))
            unsafe = [key for key, stable in found.grasps.items() if not stable]
            hands = [any(key.startswith(spring) for key in unsafe) for spring in ("soft", "firm")]
            phase = float(found.scene.margins().phase_margin)
            rows[name].append((100 * share, phase, 100 * unstable, hands[0], hands[1]))
    for name, columns in rows.items():
        share, phase, unstable, soft, firm = np.array(columns, float).T
        cells = f"{np.median(share):.0f} % | {np.median(phase):.0f} deg | {np.mean(unstable):.2g} %"
        print(f"| {name} | {cells} | {int(soft.sum())} | {int(firm.sum())} |")


if __name__ == "__main__":
    main()
