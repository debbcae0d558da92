"""Arrays have the shapes and types of their annotations, as checked by jaxtyping, which the package never loads
itself.
"""

from __future__ import annotations

import runpy
import sys
import typing
from unittest.mock import patch

import numpy as np
import pytest
from jaxtyping import AbstractArray, jaxtyped

import zwidth
from zwidth.core import types as _types
from zwidth.core.types import Reals, Roots
from zwidth.numerics.polynomials import companion
from zwidth.stability.reference import compute_poles, compute_radii, expand_loop, expand_polynomial
from zwidth.stability.rigid.boundary import sample_lobe
from zwidth.stability.rigid.broadcasting import find_degree
from zwidth.stability.rigid.poles import (
    aberth_kernel,
    compute_discs,
    factor_with_pole_axis,
    pole_kernel,
    radius_by_companion,
)
from zwidth.stability.rigid.step_response import step_response

with patch.object(typing, "TYPE_CHECKING", True):
    ALIASES = {name: value for name, value in runpy.run_path(_types.__file__).items() if name[0] != "_"}

# Arguments that broadcast to shape (2, 3), and arrays of that shape.
WALL = {"alpha": np.array([0.1, 0.2, 0.4]), "beta": np.array([[0.1], [0.3]]), "delta": np.float64(0.2)}
GRID = dict(zip(WALL, np.broadcast_arrays(*WALL.values()), strict=True))
DEVICE = {"delta": GRID["delta"], "d": np.full((2, 3), 1.5)}
HALF = find_degree(1.5)
KERNEL = {**GRID, **DEVICE, "degree": HALF}
COLUMNS = {name: np.ravel(value) if name != "degree" else value for name, value in KERNEL.items()}
ROOTS_FIRST = np.moveaxis(pole_kernel(**KERNEL), -1, 0)

CALLS = [
    (zwidth.char_poly, {**WALL, "d": np.array([1.0, 2.0, 0.5])}),
    (zwidth.poles, {**WALL, "d": np.array([1.0, 2.0, 0.5])}),
    (radius_by_companion, {**WALL, "d": np.float64(1.5)}),
    (
        zwidth.count_poles,
        {"zeros": np.ones((3, 1)), "poles": np.ones((2, 1, 2)), "gain": np.float64(0.1), "lag": np.array([1, 2, 3])},
    ),
    (zwidth.stable_region, {"delta": 0.1, "d": 1.0, "points": 20}),
    (sample_lobe, {"delta": 0.1, "d": 1.0, "points": 20}),
    (step_response, {"alpha": 0.1, "beta": 0.2, "delta": 0.1, "d": 1.0, "periods": 20}),
    (expand_polynomial, {**DEVICE, "degree": HALF}),
    (expand_loop, KERNEL),
    (companion, {"monic": expand_loop(**KERNEL)}),
    (pole_kernel, KERNEL),
    (aberth_kernel, KERNEL),
    (compute_discs, {"z": ROOTS_FIRST, "loop": factor_with_pole_axis(**KERNEL), "degree": HALF}),
    (compute_poles, COLUMNS),
    (compute_radii, COLUMNS),
]


def read_hints(annotated):
    return typing.get_type_hints(annotated, {**vars(sys.modules[annotated.__module__]), **ALIASES})


def list_annotated(value, hint, path):
    """Yield path, array and annotation of each array in a value whose annotation names its axes."""
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        yield path, value, hint
    elif hasattr(hint, "_fields"):
        for name, inner in read_hints(hint).items():
            yield from list_annotated(getattr(value, name), inner, f"{path}.{name}")
    elif typing.get_origin(hint) is tuple and Ellipsis not in typing.get_args(hint):
        for index, (part, inner) in enumerate(zip(value, typing.get_args(hint), strict=True)):
            yield from list_annotated(part, inner, f"{path}[{index}]")


def find_mismatches(function, arguments):
    """Paths of the arguments and results whose axes or type differ from the annotation."""
    hints = read_hints(function)
    annotated_arguments = [
        item for name, value in arguments.items() for item in list_annotated(value, hints[name], name)
    ]
    annotated_results = list(list_annotated(function(**arguments), hints["return"], "result"))
    assert annotated_results
    with jaxtyped("context"):
        return [path for path, value, hint in annotated_arguments + annotated_results if not isinstance(value, hint)]


@pytest.mark.parametrize("function, arguments", CALLS, ids=[function.__name__ for function, _ in CALLS])
def test_arrays_match_their_annotations(function, arguments):
    assert find_mismatches(function, arguments) == []


def test_mismatched_axes_are_detected():
    def transposed(alpha: Reals, beta: Reals) -> Roots:
        return ROOTS_FIRST

    assert find_mismatches(transposed, {"alpha": GRID["alpha"], "beta": GRID["beta"].T}) == ["beta", "result"]
