#!/usr/bin/env python3
"""Measure questions about scenes inside JAX transformations: the first call, and calls with other numbers.

    python benchmarks/bench_traced_scenes.py [--write benchmarks/results/traced_scenes.md]

Each row is measured in a process of its own, so that the first call includes all compilations. The first compilation
of an empty program is not included. Times are CPU times of all threads, which hardly depend on the load of the machine.
"""

from __future__ import annotations

import platform
import subprocess
import sys

import jax

from methods.page import write_page

# Functions of a scene by name; K is its maximum stiffness.
FUNCTIONS = {
    "`jit`": "jax.jit(K)",
    "`grad`": "jax.grad(K)",
    "`jit(grad)`": "jax.jit(jax.grad(K))",
    "`jit(hessian)`": "jax.jit(jax.hessian(K))",
    "`jit(vmap)`, 64 scenes": "jax.jit(jax.vmap(K))",
    "`jit(vmap(grad))`, 64 scenes": "jax.jit(jax.vmap(jax.grad(K)))",
    "`jit(vmap)`, 100,000 scenes": "jax.jit(jax.vmap(K))",
}
SECONDS = 10.0  # times of at least 10 s are printed in s, shorter ones in ms
MANY = 10_000  # batches of at least this many scenes are called only once with other numbers, to save time
SCENES = {
    "low-pass": "Scene(Device(0.1, 10), Timing(1e-3, 1e-3), velocity=LowPass(cutoff=100))",
    "low-pass, coupling and hand": (
        "Scene(Device(0.1, 1, Coupling(0.05, 3e4, 1.0)), Timing(1e-3, 1e-3), velocity=LowPass(cutoff=100), "
        "operator=Operator(0.5, 6, 135, 800, 4))"
    ),
}
PROGRAM = """
import time, jax
from zwidth import *
jax.config.update("jax_enable_x64", True)
jax.block_until_ready(jax.jit(lambda x: x + 1)(1.0))
def K(scene): return scene.max_stiffness().stiffness
scene, function = {scene}, {function}
def numbers(k):
    factors = 1.0 + 0.01 * k + jax.numpy.linspace(0.0, 0.1, {count}) if {count} else 1.0 + 0.01 * k
    return jax.block_until_ready(jax.tree.map(lambda x: x * factors, scene))
scenes, times = [numbers(k) for k in range({calls})], []
for each in scenes:
    start = time.process_time()
    jax.block_until_ready(function(each))
    times.append(time.process_time() - start)
print(times[0], min(times[1:]))
"""


def measure(scene: str, transformation: str) -> tuple[float, float]:
    """Return the CPU times in s of the first call, and of the fastest call with other numbers."""
    scenes = transformation.partition(", ")[2].removesuffix(" scenes").replace(",", "")
    count = int(scenes or 0)
    function, calls = FUNCTIONS[transformation], 2 if count >= MANY else 6
    program = PROGRAM.format(scene=scene, function=function, count=count, calls=calls)
    output = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    first, later = map(float, output.split())
    return first, later


def measure_all() -> str:
    """Return the page with the table."""
    lines = [
        "# Scenes inside JAX transformations",
        "",
        "The command `benchmarks/bench_traced_scenes.py --write` writes this table: the maximum stiffness of a scene",
        "with all its numbers traced, in float64, each row in a process of its own. The first call includes all",
        "compilations. Times are CPU times of all threads, which hardly depend on other programs; the run time on an",
        f"idle machine is at most as long. JAX {jax.__version__}, Python {platform.python_version()}.",
        "",
        "| scene | transformation | first call | other numbers |",
        "|---|---|--:|--:|",
    ]
    for name, scene in SCENES.items():
        for transformation in FUNCTIONS:
            first, later = measure(scene, transformation)
            spelled = f"{1e3 * later:.0f} ms" if later < SECONDS else f"{later:.1f} s"
            lines.append(f"| {name} | {transformation} | {first:.2f} s | {spelled} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    write_page(__doc__, measure_all)
