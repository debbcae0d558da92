"""Every public function with every argument type, in JAX transformations and in both precisions.

At most one argument is traced, or all; the others share one type. Values are integers, which every type
represents exactly. Functions that convert their arguments by the same code share one representative, which is traced
with every type in every transformation. All other functions are called directly with every type, and traced with the
most common types, at shapes for which one compiled program serves all types.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun

from contract.cases import CASES, SCENE_CASES, Case

NUMBERS = {
    "int": int,
    "float": float,
    **{kind.__name__: kind for kind in (np.int8, np.int32, np.int64, np.uint8, np.float16, np.float32, np.float64)},
    "0-d int": lambda value: np.array(int(value)),
    "0-d float32": lambda value: np.array(value, np.float32),
    "JAX int": lambda value: jnp.asarray(int(value)),
    "JAX float32": lambda value: jnp.asarray(value, jnp.float32),
}
ARRAYS = {
    "list of int": lambda value: [int(value)] * 2,
    "list of float": lambda value: [float(value)] * 2,
    "int array": lambda value: np.full(2, int(value)),
    "float32 array": lambda value: np.full(2, value, np.float32),
    "float64 array": lambda value: np.full(2, float(value)),
    "JAX int array": lambda value: jnp.full(2, int(value)),
    "JAX float32 array": lambda value: jnp.full(2, value, jnp.float32),
}
TYPES = NUMBERS | ARRAYS
# One type per conversion path of the untraced arguments, because each entry with derivatives compiles separately.
CONVERSIONS = ("int", "float", "int32", "JAX float32", "list of int", "float64 array")
# One scalar and one array: conversions in single precision follow the same paths, which saves compilations.
SINGLE_CONVERSIONS = ("int", "float64 array")
# One function per way of evaluation: quantities with units, a compiled kernel, a kernel with derivatives by NumPy, the
# same in SI units, results with an axis of their own, conversion of complex numbers, methods of scenes.
REPRESENTATIVES = (
    "normalize",
    "passivity_margin",
    "alpha_max",
    "max_stiffness",
    "char_poly",
    "count_poles",
    "Scene.passivity_margin",
)
# Types of the arguments that are not traced, for all other functions.
COMMON = ("int", "float", "float32", "float64", "list of int", "int array", "float64 array", "JAX float32 array")
DIFFERENTIATED = ("grad", "jit(grad)", "hessian")
ALL = "all"  # instead of an argument's name: all arguments are traced
EVERY_CASE = [*CASES, *SCENE_CASES]


class Combination(NamedTuple):
    """One entry of the matrix."""

    type: str  # of the arguments that are not traced
    transform: str
    traced: str  # the traced argument, "" for a direct call, or ALL
    x64: bool


def combinations(case: Case) -> Iterator[Combination]:
    """Yield the entries of a function: all of them for a representative, otherwise the common ones."""
    yield from all_combinations(case) if case.name in REPRESENTATIVES else common_combinations(case)


def common_combinations(case: Case) -> Iterator[Combination]:
    """Yield direct calls with every type, traced calls with the common types, and the highest promised derivative."""
    for x64 in (True, False):
        for kind in TYPES:
            yield Combination(kind, "direct", "", x64)
    if case.refuses_tracing:
        return
    # Two walls each, also of scenes, whose parameters are single numbers: one program serves all types.
    first, last = case.free[0], case.free[-1]
    yield Combination("float64 array", "jit", ALL, True)
    for kind in COMMON:
        yield Combination(kind, "jit", first if kind in ARRAYS and last not in case.one_number else last, True)
    yield Combination("float64 array", "jit", last, False)
    if case.derivatives is None:
        yield Combination("float64 array", "vmap", first, True)
    elif not case.gradient_in:
        yield Combination("int", "jit(grad)", first, True)
        # A method of a scene calls the function of arrays, whose second derivative is an entry, with parameters that
        # the representative of the scenes converts with second derivatives.
        if case.derivatives == 2 and not case.one_number:
            yield Combination("int", "hessian", first, True)


def all_combinations(case: Case) -> Iterator[Combination]:
    """Yield every type in every transformation that the contract promises."""
    for x64 in (True, False):
        for kind in TYPES:
            yield Combination(kind, "direct", "", x64)
            if case.refuses_tracing:
                continue
            # JAX turns a list into one traced value per item. Single numbers need a separate compilation. A scene
            # converts units in the precision of its traced parameters.
            coarse = case.one_number and kind in NUMBERS and kind.endswith(("float16", "float32"))
            if not kind.startswith("list") and not coarse and (x64 or kind in ARRAYS):
                yield Combination(kind, "jit", ALL, x64)
            conversions = CONVERSIONS if x64 else SINGLE_CONVERSIONS
            for traced in dict.fromkeys((case.free[0], case.free[-1])) if kind in conversions else case.free[:1]:
                if x64 or kind in CONVERSIONS:
                    yield Combination(kind, "jit", traced, x64)
            if kind not in conversions:
                continue
            # The compiled program depends on the traced argument only, so the first argument suffices.
            first = case.free[0]
            yield Combination(kind, "vmap", first, x64)
            if first in case.one_number and kind in ARRAYS:
                # With several walls per scene, the gradient would sum over the walls.
                continue
            if case.derivatives is not None:
                yield Combination(kind, "grad", first, x64)
                yield Combination(kind, "jit(grad)", first, x64)
            # The contract covers no second derivatives in single precision. Those next to arrays would be compiled for
            # another shape, although the first derivatives cover the conversion of arrays.
            if case.derivatives == 2 and not case.gradient_in and x64 and kind in NUMBERS:
                yield Combination(kind, "hessian", first, x64)


def compute(case: Case, entry: Combination) -> dict[str, Any]:
    """Return the leaves of one entry: values, or the derivative of their sum as "slope"."""
    fixed = {name: convert(case, name, entry.type) for name in case.good}
    if entry.transform == "direct":
        return case.leaves(case.call(**fixed))
    if entry.traced == ALL:
        traced = {name: jnp.asarray(fixed.pop(name)) for name in case.free}
        return run_traced(lambda arguments: case.leaves(case.call(**fixed, **arguments)), traced)
    del fixed[entry.traced]

    def compute_leaves(x: Any) -> dict[str, Any]:
        return case.leaves(case.call(**fixed, **{entry.traced: x}))

    def compute_sum(x: Any) -> Any:
        return sum_leaves(compute_leaves(x), jnp)

    # Two points even if the other arguments are numbers, so that one program serves both. Scenes take single numbers.
    shape = () if entry.traced in case.one_number else (2,)
    x = jnp.full(shape, traced_value(case, entry.traced), jnp.float64 if entry.x64 else jnp.float32)
    if entry.transform == "vmap":
        return {name: leaf[0] for name, leaf in jax.vmap(compute_leaves)(x[None]).items()}
    if entry.transform == "jit":
        return run_traced(compute_leaves, x)
    slope = jax.grad(compute_sum)
    if entry.transform == "hessian":
        # Points are independent: the sum over a row of the Hessian is the second derivative at a point.
        slope = jax.grad(lambda x: jnp.sum(jax.grad(compute_sum)(x)))
    return {"slope": run_traced(slope, x) if entry.transform == "jit(grad)" else slope(x)}


def run_traced(function: Any, x: Any) -> Any:
    """Trace a function as jit does, and evaluate the operations of the trace one by one.

    The kernels in the trace are compiled functions shared by all entries, whereas jit would compile every entry.
    """
    trace = jax.jit(function).trace(x)
    leaves = jaxpr_as_fun(trace.jaxpr)(*jax.tree.leaves(x))
    return jax.tree.unflatten(jax.tree.structure(trace.out_info), leaves)


def convert(case: Case, name: str, kind: str) -> Any:
    """Return the integer value of an argument as one type; parameters of scenes stay single numbers."""
    value = case.integer_point[name]
    return (NUMBERS["int"] if name in case.one_number and kind in ARRAYS else TYPES[kind])(value)


def traced_value(case: Case, name: str) -> float:
    """Return the value of a traced argument: not an integer, since derivatives jump at integer delays, except
    for a lag.
    """
    return case.integer_point[name] + (0.0 if name == "lag" else 0.25)


def sum_leaves(leaves: dict[str, Any], xp: Any) -> Any:
    """Return the sum of all real leaves and of the magnitudes of complex leaves."""
    kinds = {name: leaf.dtype.kind for name, leaf in leaves.items()}
    parts = [xp.abs(leaf) if kinds[name] == "c" else leaf for name, leaf in leaves.items() if kinds[name] in "fc"]
    return sum(xp.sum(part) for part in parts)


def compute_direct(case: Case, **changes: float) -> dict[str, np.ndarray]:
    """Return the leaves of a direct call with Python floats."""
    numbers = {name: float(value) for name, value in case.integer_point.items()} | changes
    return {name: np.asarray(leaf) for name, leaf in case.leaves(case.call(**numbers)).items()}


def expected_slope(case: Case, name: str, order: int) -> float:
    """Return a derivative of the sum of the leaves by central differences of direct calls."""
    step = (1e-5, 1e-3)[order - 1]
    low, middle, high = (
        float(sum_leaves(compute_direct(case, **{name: traced_value(case, name) + k * step}), np)) for k in (-1, 0, 1)
    )
    return (high - low) / (2 * step) if order == 1 else (high - 2 * middle + low) / step**2
