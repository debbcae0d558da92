"""Contract cases compiled once each inside `jit`, `vmap` and `grad`, shared by all tests."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from compiling import QUICKLY

from contract.cases import CASES

# Three valid points, then invalid and out-of-range values for one argument at a time; all cases have as many rows.
ROWS = 16


def make_batch(case, beyond=True):
    """Columns of the traceable arguments and a mask of the valid rows; each other row has one bad value."""
    fixed = set(case.concrete)
    spoiled = [case.bad, case.beyond] if beyond else [case.bad]
    rows = [{name: values[k] for name, values in case.good.items()} for k in range(3)]
    for numbers in spoiled:
        for argument, value in numbers.items():
            if argument not in fixed:
                rows.append({name: values[1] for name, values in case.good.items()} | {argument: value})
    assert len(rows) <= ROWS
    rows += [rows[0]] * (ROWS - len(rows))
    good = np.array([k < 3 or row is rows[0] for k, row in enumerate(rows)])
    return [np.array([row[name] for row in rows]) for name in case.free], good


def has_gradient(case):
    return case.derivatives is not None and not case.gradient_in


def read_concrete(case):
    return {name: case.arguments[name][0] for name in case.concrete}


# Cases of one kernel are compiled together, which compiles their common part once.
FAMILIES = [("spectral_radius", "decay_rate", "dominant_pole"), ("passivity_margin", "is_passive")]


def find_family(name):
    return next((names for names in FAMILIES if name in names), (name,))


def compute_leaves(case, point):
    return case.leaves(case.call(**dict(zip(case.free, point, strict=True)), **read_concrete(case)))


def compile_case(case_name):
    """Return a function that evaluates a case inside jit and vmap, and grad if it has a gradient, at its batch
    in float64.
    """
    return lambda columns: compile_family(find_family(case_name))(columns)[case_name]


@cache
def compile_family(names):
    cases = [next(case for case in CASES if case.name == name) for name in names]
    return jax.jit(
        jax.vmap(lambda point: {case.name: add_gradient(case)(point) for case in cases}), compiler_options=QUICKLY
    )


def add_gradient(case):
    def values(point):
        leaves = compute_leaves(case, point)
        # Sums reduce arrays and complex results to one real number each, and many results to one, because one reverse
        # pass per result is slow to compile.
        real = {name: v for name, v in leaves.items() if v.dtype.kind in "fc"}
        sums = {name: jnp.sum(jnp.abs(v)) if v.ndim or v.dtype.kind == "c" else v for name, v in real.items()}
        return (sums if len(sums) <= 3 else {"all": sum(map(jnp.abs, sums.values()))}), leaves

    return jax.jacrev(values, has_aux=True) if has_gradient(case) else lambda point: values(point)[1]


@cache
def compute_float32(names):
    """Leaves of each case of a family in float32, at the batch without out-of-range values."""
    cases = [next(case for case in CASES if case.name == name) for name in names]
    columns = [jnp.asarray(np.float32(column)) for column in make_batch(cases[0], beyond=False)[0]]
    return jax.jit(lambda *point: {case.name: compute_leaves(case, point) for case in cases}, compiler_options=QUICKLY)(
        *columns
    )


@cache
def compute_float64(case_name):
    """Leaves of a case at its batch, and their derivatives with respect to every argument."""
    case = next(case for case in CASES if case.name == case_name)
    with jax.enable_x64(True):
        result = compile_case(case_name)([jnp.asarray(column) for column in make_batch(case)[0]])
    slopes, leaves = result if has_gradient(case) else (None, result)
    return {name: np.asarray(value) for name, value in leaves.items()}, slopes


def evaluate_case(name: str, **columns: Any) -> tuple[dict[str, np.ndarray], dict[str, dict[str, np.ndarray]]]:
    """Leaves of a case in float64 at up to `ROWS` points, and their derivatives with respect to every argument."""
    case = next(case for case in CASES if case.name == name)
    spread = np.broadcast_arrays(*(np.asarray(columns[argument], np.float64) for argument in case.free))
    count = spread[0].size
    assert count <= ROWS
    with jax.enable_x64(True):
        slopes, leaves = compile_case(name)([jnp.asarray(np.resize(column, ROWS)) for column in spread])
    return (
        {leaf: np.asarray(value)[:count] for leaf, value in leaves.items()},
        {
            leaf: {argument: np.asarray(slope)[:count] for argument, slope in zip(case.free, parts, strict=True)}
            for leaf, parts in slopes.items()
        },
    )
