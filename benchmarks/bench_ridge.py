#!/usr/bin/env python3
"""Measure alpha_max: values with gradients per second, compared with the Newton method of optimistix.

    python benchmarks/bench_ridge.py [--count 200000] [--json FILE]

Every row is compiled before it is timed, and results are awaited; the time is the minimum of several runs. The error is
the largest relative error at the smooth points of tests/reference/ridge_extended.json with delta from 1e-3 to 1e4: of
alpha, and of its derivatives relative to |slope| + alpha/(1 + delta) and |slope| + alpha.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix

import zwidth
from methods.clock import time_calls
from zwidth.stability.reference import build_loop, solve_wall
from zwidth.stability.rigid.ridge import ridge_kernel

REFERENCE = Path(__file__).resolve().parents[1] / "tests" / "reference" / "ridge_extended.json"
# On a busy machine, the minimum of many short runs is least affected by other processes.
LEAST_RUNS, LEAST_SECONDS, QUERIES = 7, 3.0, 5000


class Row(NamedTuple):
    """One measurement: time to trace and compile, points per second of wall and CPU time, relative errors."""

    name: str
    compile_seconds: float
    compile_processor_seconds: float
    points_per_second: float
    points_per_processor_second: float
    error: float
    slope_error: float


def fast(delta: jax.Array, d: jax.Array) -> jax.Array:
    """Return alpha_max of one point, computed by zwidth."""
    return ridge_kernel(delta, d).alpha


def by_optimistix(delta: jax.Array, d: jax.Array) -> jax.Array:
    """Return alpha_max by optimistix' Newton method for a zero derivative of the closed form; smooth optima only."""

    def slope(omega: jax.Array, point: tuple[jax.Array, jax.Array]) -> jax.Array:
        loop = build_loop(*point)
        return jax.grad(lambda w: solve_wall(w, loop)[0])(omega)

    # Initial value as in zwidth, a fit of s = sin(omega/2) with an error below 4 %.
    u, t = 1.0 / (d + 1.0), delta * (d + 1.0) / (delta * (d + 1.0) + 3.0)
    start = 2.0 * jnp.arcsin(jnp.minimum((0.551 + 0.493 * t + (t * u) ** 2 * (1.204 * u - 0.701)) * u, 0.999))
    solver = optimistix.Newton(rtol=1e-13, atol=1e-13)
    omega = optimistix.root_find(
        slope, solver, jax.lax.stop_gradient(start), args=(delta, d), max_steps=16, throw=False
    ).value
    return solve_wall(omega, build_loop(delta, d))[0]


def timed(call: Callable[[], Any]) -> tuple[float, float]:
    """Return the minimum wall time and the minimum CPU time of one call, in s."""
    best, least = time_calls(lambda: jax.block_until_ready(call()), LEAST_RUNS, seconds=LEAST_SECONDS).min(axis=1)
    return best, least


def errors(alpha: Any, by_delta: Any, by_d: Any, rows: list[dict[str, str]]) -> tuple[float, float]:
    """Return the largest relative errors of alpha and of its derivatives at the reference points."""
    exact = {
        name: np.array([float(row[name]) for row in rows]) for name in ("alpha", "delta", "alpha_delta", "alpha_d")
    }
    size = exact["alpha"]
    of_slopes = [
        np.abs(by_delta - exact["alpha_delta"]) / (np.abs(exact["alpha_delta"]) + size / (1 + exact["delta"])),
        np.abs(by_d - exact["alpha_d"]) / (np.abs(exact["alpha_d"]) + size),
    ]
    return float(np.max(np.abs(alpha / size - 1))), float(np.max(of_slopes))


def traced_row(name: str, kernel: Callable[..., Any], points: tuple[np.ndarray, ...], rows: list) -> Row:
    """Measure value and gradient of one kernel, compiled as one program."""
    function = jax.jit(jax.vmap(jax.value_and_grad(kernel, (0, 1))))
    programs: list[Any] = []
    seconds = time_calls(lambda: programs.append(function.lower(*points).compile()), 1)[:, 0]
    arguments = [jnp.asarray(column) for column in points]
    speeds = (points[0].size / best for best in timed(lambda: programs[0](*arguments)))
    alpha, (by_delta, by_d) = function(*reference_points(rows))
    return Row._make((name, *seconds, *speeds, *errors(alpha, by_delta, by_d, rows)))


def reference_points(rows: list[dict[str, str]]) -> tuple[np.ndarray, ...]:
    return tuple(np.array([float(row[name]) for row in rows]) for name in ("delta", "d"))


def public_row(points: tuple[np.ndarray, ...], rows: list) -> Row:
    """Measure `zwidth.sensitivities` of NumPy arrays: K_max and its four derivatives, on all processors."""

    def call(delta: np.ndarray, d: np.ndarray) -> zwidth.Sensitivities:
        return zwidth.sensitivities(mass=1.0, damping=delta, period=1.0, delay=d)

    first = time_calls(lambda: call(*points), 1)[:, 0]
    best = timed(lambda: call(*points))
    gain = call(*reference_points(rows))
    return Row._make(
        (
            "zwidth.sensitivities",
            *(with_compilation - without for with_compilation, without in zip(first, best, strict=True)),
            *(points[0].size / seconds for seconds in best),
            *errors(gain.stiffness_max, gain.per_damping, gain.per_delay, rows),
        )
    )


def one_query() -> dict[str, float]:
    """Return the time in us of a call for a single number, and of a call with the same overhead but no computation."""
    zwidth.alpha_max(0.1, 1.0)
    packed = jax.jit(lambda point: jnp.stack([point[0], point[1], point[0], point[1], point[0]]))
    point = np.array([0.1, 1.0])

    def many(call: Callable[[], Any]) -> float:
        """Return the tenth percentile of single calls, since slower calls wait for a processor on a busy machine."""
        return float(np.quantile(time_calls(call, QUERIES)[0], 0.1)) * 1e6

    return {
        "zwidth.alpha_max": many(lambda: zwidth.alpha_max(0.1, 1.0)),
        "dispatch": many(lambda: np.asarray(packed(point))),
    }


def measure(count: int) -> dict[str, Any]:
    """Return all rows, in float64."""
    rng = np.random.default_rng(0)
    # Smooth maxima only, because the comparison cannot handle corners.
    points = 10 ** rng.uniform(-3, 2, count), rng.uniform(0.3, 8, count)
    rows = [
        row
        for row in json.loads(REFERENCE.read_text())
        if row["model"] == "held" and row["kind"] == "smooth" and float(row["d"]) > 0.2
        if 1e-3 <= float(row["delta"]) <= 1e4
    ]
    with jax.enable_x64(True):
        results = [
            traced_row("fast route", fast, points, rows),
            public_row(points, rows),
            traced_row("optimistix Newton", by_optimistix, points, rows),
        ]
    return {
        "count": count,
        "processors": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "machine": platform.processor() or platform.machine(),
        "jax": jax.__version__,
        "rows": [row._asdict() for row in results],
        "ratio": results[0].points_per_second / results[2].points_per_second,
        "one_query_us": one_query(),
    }


def main() -> None:
    """Print the table, and write JSON if requested."""
    parser = argparse.ArgumentParser(description="Value and gradient of alpha_max, beside optimistix' Newton method.")
    parser.add_argument("--count", type=int, default=200_000, help="points in the batch")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    result = measure(options.count)
    print(f"value and gradient, {result['count']} points, {result['processors']} processors, load {result['load']:.1f}")
    print(f"{'':<22}{'compile':>9}{'(cpu)':>9}{'points/s':>11}{'per cpu s':>11}{'error':>9}{'of slopes':>11}")
    for row in result["rows"]:
        print(
            f"{row['name']:<22}{row['compile_seconds']:>7.2f} s{row['compile_processor_seconds']:>7.2f} s"
            f"{row['points_per_second'] / 1e6:>9.2f} M{row['points_per_processor_second'] / 1e6:>9.2f} M"
            f"{row['error']:>9.0e}{row['slope_error']:>11.0e}"
        )
    print(f"fast route over optimistix Newton: {result['ratio']:.1f}")
    query = result["one_query_us"]
    print(f"one query: {query['zwidth.alpha_max']:.1f} us, of which dispatch {query['dispatch']:.1f} us")
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
