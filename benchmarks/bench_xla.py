#!/usr/bin/env python3
"""Measure the speedup by each optimization of `core.xp`: alternating runs with and without it, in one process.

    python benchmarks/bench_xla.py [--points 65536] [--runs 15] [--only TEXT]

Each line is the time without divided by the time with the optimization, to compile and to run (minimum of all runs).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np

from methods.clock import time_calls
from zwidth.core import xp
from zwidth.numerics import blocks, evaluate
from zwidth.plant.rigid_mass import ANY
from zwidth.stability.rigid import crossover, margins, ridge, ridge_newton, stiffness_limit
from zwidth.stability.rigid.dominant import pole_count as circle
from zwidth.stability.rigid.dominant import search as radius
from zwidth.stability.rigid.dominant import steps as pole_step

Make = Callable[[], Callable[..., Any]]


def compile_and_run(makes: list[Make], columns: tuple[Any, ...], runs: int) -> list[tuple[float, float]]:
    """Return the times to the first result and of the fastest run in s, for each variant."""
    functions: list[Callable[..., Any]] = []

    def begin(make: Make) -> None:
        functions.append(make())
        jax.block_until_ready(functions[-1](*columns))

    first = [time_calls(lambda m=make: begin(m), 1)[0].min() for make in makes]
    turns = [
        [time_calls(lambda f=function: jax.block_until_ready(f(*columns)), 1)[0].min() for function in functions]
        for _ in range(runs)
    ]
    return list(zip(first, np.min(turns, axis=0).tolist(), strict=True))


def compiled(kernel: Callable[..., Any], options: dict[str, Any] | None = None, **instead: Any) -> Make:
    """Return a maker of a compiled kernel in which some names of modules (``module__name``) are replaced."""

    def make() -> Callable[..., Any]:
        function = jax.jit(lambda *columns: kernel(*columns), compiler_options=options)

        def call(*columns: Any) -> Any:
            with replaced(instead):
                return function(*columns)

        return call

    return make


@contextmanager
def replaced(names: dict[str, Any]) -> Iterator[None]:
    """Replace functions of modules temporarily, while a kernel is traced."""
    modules = {"crossover": crossover, "newton": ridge_newton, "margins": margins, "limit": stiffness_limit}
    modules |= {"circle": circle, "radius": radius, "step": pole_step}
    patches = [patch.object(modules[name.split("__")[0]], name.split("__")[1], value) for name, value in names.items()]
    for each in patches:
        each.start()
    try:
        yield
    finally:
        for each in patches:
            each.stop()


def same(values: Any, _witness: Any = None) -> Any:
    return values


def their_angle(re: Any, im: Any) -> Any:
    return jnp.arctan2(im, re)


def their_turn(x: Any, y: Any, xp: Any) -> Any:
    return 2.0 * xp.arctan2(xp.sqrt(x), xp.sqrt(y))


def their_half_turn(x: Any, xp: Any) -> Any:
    return xp.sin(x), xp.cos(x)


def questions(columns: tuple[Any, ...]) -> Iterator[tuple[str, Make, Make, tuple[Any, ...]]]:
    """Yield the measurements: name, variant with the optimization, variant without, and arguments."""
    alpha, beta, delta, d = columns

    def stable(*walls: Any) -> Any:
        return crossover.stable_kernel(*walls, ANY)  # pyright: ignore

    def quick(*walls: Any) -> Any:
        return radius.quick_kernel(*walls, 1e-9, True)  # pyright: ignore

    def top(a: Any, b: Any) -> Any:
        return ridge.ridge_kernel(a, b, ANY)

    wide = xp.WIDE
    yield "WIDE, radius", compiled(quick, wide), compiled(quick), columns
    yield "WIDE, verdict", compiled(stable, wide), compiled(stable), columns
    yield "materialize, ridge", compiled(top), compiled(top, newton__materialize=same), (delta, d)
    yield "materialize, radius", compiled(quick, wide), compiled(quick, wide, radius__materialize=same), columns

    def phase_margin(*walls: Any) -> Any:
        return margins.margins_kernel(*walls)[1]

    yield (
        "materialize, phase margin",
        compiled(phase_margin),
        compiled(phase_margin, margins__materialize=same),
        columns,
    )

    def label(a: Any, b: Any) -> Any:
        return stiffness_limit._compile_labels.__wrapped__(ANY)(a, b, 0.1, 1.0)

    grid = jnp.linspace(0.001, 0.9, 2000)[:, None], jnp.linspace(0.0, 0.9, 2000)
    yield "materialize, labels of a grid", compiled(label), compiled(label, limit__materialize=same), grid
    yield "angle, alone", compiled(xp.angle), compiled(their_angle), (alpha - 1.0, beta)
    other = {"circle__angle": their_angle, "circle__invert_haversine": their_turn, "radius__angle": their_angle}
    yield "angle and invert_haversine, radius", compiled(quick, wide), compiled(quick, wide, **other), columns
    by_rule, alone = slopes()
    yield "custom_jvp, gradient of ridge", lambda: by_rule, lambda: alone, (delta, d)
    million = tuple(np.tile(np.asarray(column), 16) for column in (delta, d))
    ridges = evaluate.compile_kernel(ridge.ridge_kernel, (ANY,))
    yield "BLOCK, ridge of a million", in_blocks(ridges, 1 << 16), in_blocks(ridges, 1 << 20), million
    yield (
        "sine series, radius",
        compiled(quick, wide),
        compiled(quick, wide, step___sine_and_cosine=their_half_turn),
        columns,
    )


def in_blocks(function: Callable[..., Any], size: int) -> Make:
    """Return a maker of a compiled function that is applied to blocks of one size, on one processor."""
    return lambda: lambda *columns: blocks.map_blocks(function, list(columns), size, 1)


def slopes() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the gradient outside `jit` by the rule of `numerics.evaluate`, and by JAX alone."""
    by_rule = evaluate.compile_kernel.__wrapped__(ridge.ridge_kernel, (ANY,))
    alone = jax.jit(lambda *columns: ridge.ridge_kernel(*columns, ANY))  # pyright: ignore
    return tuple(jax.grad(lambda *c, f=f: f(*c).alpha.sum(), argnums=(0, 1)) for f in (by_rule, alone))  # type: ignore


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("--points", type=int, default=1 << 16)
    parser.add_argument("--runs", type=int, default=15)
    parser.add_argument("--only", default="", help="lines whose name holds this text")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(0)
    count = options.points
    ranges = ((0.01, 1.0), (0.05, 1.0), (0.05, 3.0), (0.0, 5.0))
    columns = tuple(jnp.asarray(rng.uniform(low, high, count)) for low, high in ranges)
    print(f"{'':30}{'compile':>9}{'run':>7}{'with: s, ms':>20}")
    for name, with_it, without, arguments in questions(columns):
        if options.only in name:
            show(name, compile_and_run([with_it, without], arguments, options.runs))


def show(name: str, times: list[tuple[float, float]]) -> None:
    (first, run), (other_first, other_run) = times
    ratios = f"{other_first / first:9.2f}{other_run / run:7.2f}"
    print(f"{name:30}{ratios}{first:12.2f}{1e3 * run:8.2f}", flush=True)


if __name__ == "__main__":
    main()
