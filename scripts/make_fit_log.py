#!/usr/bin/env python3
"""Simulate the data fitted by configs/fit.yaml: write configs/fit_log.csv and print walls at the onset of instability.

A light device with dry friction is pushed back and forth by force steps of random length, at 1 kHz. The force is
delayed by 2.3 ms, which is not an integer number of periods: the motion is simulated at a 10 times higher rate, and the
encoder reads every 10th position. The walls lie on the stability boundary of the device without friction, with errors
of about 2 % in stiffness and frequency.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import zwidth

FILE = Path(__file__).resolve().parents[1] / "configs" / "fit_log.csv"
MASS, DAMPING, FRICTION = 0.075, 0.6, 0.08  # kg, N s/m, N
PERIOD, DELAY, RESOLUTION = 1e-3, 2.3e-3, 3e-5  # s, s, m
SAMPLES, FORCE, FINER = 3000, 1.2, 10
DAMPINGS, NOISE = (0.0, 8.0, 16.0, 24.0), 0.02  # N s/m, relative
HOLDS = (30, 90)  # shortest and longest step, in samples


def command() -> np.ndarray:
    """Return double steps of force with random duration and amplitude, each of which leaves the device at rest."""
    rng = np.random.default_rng(2006)
    parts: list[np.ndarray] = []
    while sum(part.size for part in parts) < SAMPLES:
        hold = int(rng.integers(*HOLDS))
        # A double step: the second half cancels the velocity of the first half.
        parts.append(FORCE * rng.uniform(0.5, 1.0) * np.repeat([1.0, -1.0, -1.0, 1.0], hold // 2))
    return np.concatenate(parts)[:SAMPLES].round(2)


def move(force: np.ndarray) -> np.ndarray:
    """Return the encoder counts for a commanded force."""
    late = np.repeat(force, FINER)
    late = np.concatenate([np.zeros(round(DELAY / PERIOD * FINER)), late])[: late.size]
    scene = zwidth.Scene(zwidth.Device(MASS, DAMPING), zwidth.Timing(period=PERIOD / FINER))
    options = {"coulomb": FRICTION, "resolution": RESOLUTION, "external_force_history": late, "periods": late.size}
    measured = zwidth.simulate(scene, 0.0, 0.0, **options).measured
    assert measured is not None, "it is recorded"
    return np.round(measured[::FINER][:SAMPLES] / RESOLUTION).astype(int)


def make_log() -> str:
    """Return the text of the file."""
    force = command()
    lines = ["# Simulated by scripts/make_fit_log.py: free motion of a device under forces of a program.",
             f"# One count of the encoder is {1e3 * RESOLUTION:g} mm.",
             "time [ms],encoder [counts],force [N]"]  # fmt: skip
    lines += [f"{k},{count},{push:g}" for k, (count, push) in enumerate(zip(move(force), force, strict=True))]
    return "\n".join(lines) + "\n"


def list_walls() -> list[tuple[float, float, float]]:
    """Return stiffness in N/m, virtual damping in N s/m and frequency in Hz of walls at the onset of instability."""
    rate = MASS / PERIOD
    edge = zwidth.boundary_point(DAMPING / rate, DELAY / PERIOD, beta=np.array(DAMPINGS) / rate)
    off = 1.0 + NOISE * np.random.default_rng(2006).standard_normal((2, len(DAMPINGS)))
    numbers = edge.alpha * rate / PERIOD * off[0], edge.omega / (2 * np.pi * PERIOD) * off[1]
    rounded = [[float(f"{value:.3g}") for value in column] for column in numbers]
    return list(zip(rounded[0], DAMPINGS, rounded[1], strict=True))


if __name__ == "__main__":
    FILE.write_text(make_log(), encoding="utf-8")
    for stiffness, virtual_damping, frequency in list_walls():
        print(f"- {{stiffness: {stiffness:g} N/m, virtual_damping: {virtual_damping:g}, frequency: {frequency:g} Hz}}")
