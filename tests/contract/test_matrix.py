"""Every public function with every argument type, in every JAX transformation, against direct calls and central
differences.
"""

import jax
import numpy as np
import pytest

import zwidth
from contract.cases import SINGLE_ERROR
from contract.matrix import (
    ALL,
    DIFFERENTIATED,
    EVERY_CASE,
    combinations,
    compute,
    compute_direct,
    expected_slope,
    traced_value,
)
from zwidth.core.errors import InputError


@pytest.mark.parametrize("case", EVERY_CASE, ids=lambda case: case.name)
def test_every_argument_type_in_every_transformation(case):
    slopes = {}
    for entry in combinations(case):
        with jax.enable_x64(entry.x64):
            leaves = {name: np.asarray(leaf) for name, leaf in compute(case, entry).items()}
        if entry.transform in DIFFERENTIATED:
            order = 2 if entry.transform == "hessian" else 1
            if order not in slopes:
                slopes[order] = expected_slope(case, entry.traced, order)
            # Central differences have 5 to 6 digits; single-precision derivatives lose some to cancellation.
            tolerance = 2e-4 if entry.x64 else 2e-2
            size = max(1.0, abs(slopes[1]))
            np.testing.assert_allclose(
                leaves["slope"], slopes[order], rtol=tolerance, atol=tolerance * size, err_msg=str(entry)
            )
            continue
        changes = {} if entry.traced in ("", ALL) else {entry.traced: traced_value(case, entry.traced)}
        exact = entry.x64 or entry.transform == "direct"
        for name, expected in compute_direct(case, **changes).items():
            if expected.dtype.kind == "c":
                # The order of the poles is unspecified.
                leaves[name], expected = np.sort_complex(leaves[name]), np.sort_complex(expected)
            tolerance = 1e-11 if exact else SINGLE_ERROR
            np.testing.assert_allclose(
                *np.broadcast_arrays(leaves[name], expected), rtol=tolerance, atol=tolerance, err_msg=f"{name}: {entry}"
            )


def test_python_integers_in_jit_equal_direct_calls():
    """Calls as an optimizer makes them: Python integers next to one traced argument."""
    with jax.enable_x64(True):
        assert jax.jit(lambda delta: zwidth.alpha_max(delta, 1).alpha)(0.1) == pytest.approx(
            zwidth.alpha_max(0.1, 1).alpha, rel=1e-14
        )
        stiffness = jax.jit(lambda period: zwidth.max_stiffness(mass=1, damping=10, period=period, delay=0))(1e-3)
        assert stiffness == pytest.approx(zwidth.max_stiffness(mass=1, damping=10, period=1e-3, delay=0), rel=1e-14)
        wall = jax.jit(lambda mass: zwidth.normalize(mass=mass, damping="10 N s/m", period=1, stiffness=[1, 2]).alpha)
        np.testing.assert_allclose(wall(2), [0.5, 1.0])
        point = jax.jit(lambda delta: zwidth.boundary_point(delta, 1, beta=1).alpha)(8)
        assert point == pytest.approx(zwidth.boundary_point(8.0, 1.0, beta=1.0).alpha, rel=1e-14)


@pytest.mark.parametrize("value", ["1", 1j, None, ["1"], {}], ids=repr)
def test_traced_call_names_the_argument_that_is_not_real(value):
    with jax.enable_x64(True), pytest.raises(InputError, match=r"^d: got .*real number"):
        jax.jit(lambda delta: zwidth.alpha_max(delta, value).alpha)(0.1)


def test_traced_call_names_shapes_that_do_not_broadcast():
    with pytest.raises(InputError, match=r"shapes do not broadcast: delta \(2,\), d \(3,\)"):
        jax.jit(lambda delta: zwidth.alpha_max(delta, [1, 2, 3]).alpha)(np.ones(2))


def test_error_names_traced_complex_numbers_and_lists_of_tracers():
    with pytest.raises(InputError, match="delta: got complex numbers"):
        jax.jit(lambda delta: zwidth.alpha_max(delta, 1).alpha)(1j)
    with pytest.raises(InputError, match="delta: got a list of values that JAX traces"):
        jax.jit(lambda x: zwidth.alpha_max([x, 2 * x], 1).alpha)(0.1)
