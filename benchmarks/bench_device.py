#!/usr/bin/env python3
"""Measure functions inside `jit` on every type of device available to JAX, such as a CPU and a GPU.

    python benchmarks/bench_device.py [--points 1000000] [--runs 5] [--write benchmarks/results/device.md]

In float64 at random walls, each with its own device and delay. Compile time is listed separately, and each speed is
listed with the largest difference from direct calls of the same function.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import zwidth
from methods.clock import time_calls
from methods.page import write_page

SEED, SAMPLE = 20060901, 20_000


def draw_walls(points: int) -> tuple[np.ndarray, ...]:
    """Return alpha, beta, delta and d of random walls, about half of which are stable."""
    generator = np.random.default_rng(SEED)
    delta, d = generator.uniform(0.01, 1.0, points), generator.uniform(0.0, 8.0, points)
    top = zwidth.alpha_max(delta, d)
    share = generator.uniform(0.05, 1.2, points)
    return share * np.asarray(top.alpha), np.asarray(top.beta) * generator.uniform(0.3, 1.4, points), delta, d


def list_questions() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield names and functions of (alpha, beta, delta, d)."""
    yield "`is_stable`", zwidth.is_stable
    yield "`spectral_radius`", zwidth.spectral_radius
    yield "`margins`, modulus", lambda *wall: zwidth.margins(*wall).modulus_margin
    yield "`passivity_margin`", zwidth.passivity_margin
    yield "`alpha_max`", lambda _alpha, _beta, *device: zwidth.alpha_max(*device).alpha

    def slope(_alpha: Any, _beta: Any, delta: Any, d: Any) -> Any:
        return jax.jvp(lambda x: zwidth.alpha_max(x, d).alpha, (delta,), (jnp.ones_like(delta),))[1]

    yield "`alpha_max`, its derivative in delta", slope


def measure(function: Callable[..., Any], walls: tuple[np.ndarray, ...], device: Any, runs: int) -> tuple[float, ...]:
    """Return compile time in s, walls per second, and the largest difference (of 1 or the value) from direct calls."""
    with jax.default_device(device):
        program, there = jax.jit(function), [jax.device_put(column, device) for column in walls]
        first = time_calls(lambda: jax.block_until_ready(program(*there)), 1)[0].min()
        best = time_calls(lambda: jax.block_until_ready(program(*there)), runs)[0].min()
        got = np.asarray(program(*there))[:SAMPLE].astype(float)
    with jax.default_device(jax.devices("cpu")[0]):
        # Derivatives are also compiled here.
        direct = np.asarray(function(*(column[:SAMPLE] for column in walls))).astype(float)
    same = np.isnan(got) == np.isnan(direct)
    apart = np.abs(got - direct) / np.maximum(1.0, np.abs(direct))
    return first - best, walls[0].size / best, float(np.nanmax(apart)) if same.all() else np.nan


def name_of(device: Any) -> str:
    """Return the name of a device, with the number of processors of a CPU."""
    return f"{os.cpu_count()} CPU cores" if device.platform == "cpu" else device.device_kind


def measure_all(points: int, runs: int) -> str:
    """Return the page with the table."""
    devices = {device.platform: device for kind in ("cpu", jax.default_backend()) for device in jax.devices(kind)[:1]}
    walls = draw_walls(points)
    head = [
        part for device in devices.values() for part in (f"{name_of(device)}: M walls/s", "s to compile", "difference")
    ]
    lines = [
        "# Inside `jit`, by device",
        "",
        "The command `benchmarks/bench_device.py --write` writes this table. Each function is called inside `jit` in",
        f"float64 with a batch of {points:,} random walls. Each wall has a different device and a different delay of",
        f"0 to 8 periods. The speed is the largest of {runs} runs, with JAX {jax.__version__} and Python",
        f'{platform.python_version()}. The column "difference" contains the largest difference of {SAMPLE:,} values',
        "from the values of a direct call. The difference is relative for values above 1 in magnitude, and absolute",
        "for smaller values.",
        "",
        f"| function | {' | '.join(head)} |",
        f"|---|{'--:|' * len(head)}",
    ]
    for name, function in list_questions():
        cells = []
        for device in devices.values():
            compiling, speed, apart = measure(function, walls, device, runs)
            rounded = float(f"{speed / 1e6:.3g}")
            cells += [f"{rounded:,.10g}", f"{compiling:.1f}", f"{apart:.0e}" if apart else "0"]
        lines.append(f"| {name} | {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    write_page(__doc__, measure_all, points=(1_000_000, "points per batch"), runs=(5, "timed runs"))
