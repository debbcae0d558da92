"""Cases inside `jit`, `vmap` and `grad` at once: one compiled program a case, for all who ask about it."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from compiling import QUICKLY

from contract.cases import CASES

# Three good points, then what is bad and beyond, one argument at a time; as many rows for every case.
ROWS = 16


def batch(case, beyond=True):
    """(columns of the traceable arguments, how many rows are good): the others hold a bad number each."""
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


def fixed_of(case):
    return {name: case.arguments[name][0] for name in case.concrete}


# Of one kernel: compiled together, what they share is compiled once.
FAMILIES = [("spectral_radius", "decay_rate"), ("passivity_margin", "is_passive")]


def family_of(name):
    return next((names for names in FAMILIES if name in names), (name,))


def leaves_at(case, point):
    return case.leaves(case.call(**dict(zip(case.free, point, strict=True)), **fixed_of(case)))


def compiled(case_name):
    """The case inside jit, vmap and grad at once, where it has a gradient, in float64: what comes out for its batch."""
    return lambda columns: compiled_family(family_of(case_name))(columns)[case_name]


@cache
def compiled_family(names):
    cases = [next(case for case in CASES if case.name == name) for name in names]
    return jax.jit(
        jax.vmap(lambda point: {case.name: with_gradient(case)(point) for case in cases}), compiler_options=QUICKLY
    )


def with_gradient(case):
    def values(point):
        leaves = leaves_at(case, point)
        # Of one point: complex numbers and lists of numbers are added up, and so are many results, for a sweep back
        # from each of them compiles for long.
        real = {name: v for name, v in leaves.items() if v.dtype.kind in "fc"}
        sums = {name: jnp.sum(jnp.abs(v)) if v.ndim or v.dtype.kind == "c" else v for name, v in real.items()}
        return (sums if len(sums) <= 3 else {"all": sum(map(jnp.abs, sums.values()))}), leaves

    return jax.jacrev(values, has_aux=True) if has_gradient(case) else lambda point: values(point)[1]


@cache
def in_float32(names):
    """The leaves of each case of a family at `batch` without what is beyond."""
    cases = [next(case for case in CASES if case.name == name) for name in names]
    columns = [jnp.asarray(np.float32(column)) for column in batch(cases[0], beyond=False)[0]]
    return jax.jit(lambda *point: {case.name: leaves_at(case, point) for case in cases}, compiler_options=QUICKLY)(
        *columns
    )


@cache
def in_float64(case_name):
    """(leaves, for each of them its derivatives in every argument) of `batch`."""
    case = next(case for case in CASES if case.name == case_name)
    with jax.enable_x64(True):
        result = compiled(case_name)([jnp.asarray(column) for column in batch(case)[0]])
    slopes, leaves = result if has_gradient(case) else (None, result)
    return {name: np.asarray(value) for name, value in leaves.items()}, slopes


def ask(name: str, **columns: Any) -> tuple[dict[str, np.ndarray], dict[str, dict[str, np.ndarray]]]:
    """The leaves of a case in float64 at up to `ROWS` points, and the derivatives of each in every argument."""
    case = next(case for case in CASES if case.name == name)
    spread = np.broadcast_arrays(*(np.asarray(columns[argument], np.float64) for argument in case.free))
    count = spread[0].size
    assert count <= ROWS
    with jax.enable_x64(True):
        slopes, leaves = compiled(name)([jnp.asarray(np.resize(column, ROWS)) for column in spread])
    return (
        {leaf: np.asarray(value)[:count] for leaf, value in leaves.items()},
        {
            leaf: {argument: np.asarray(slope)[:count] for argument, slope in zip(case.free, parts, strict=True)}
            for leaf, parts in slopes.items()
        },
    )
