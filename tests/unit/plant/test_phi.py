"""Test the phi-functions and their derivatives against Kummer's function in mpmath, evaluated without cancellation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from compiling import QUICKLY
from mpmath import hyp1f1, mp, mpf

from zwidth.plant.rigid_mass import phi_functions

SMALL = [0.0, 5e-324, 1e-300, *(10.0**k for k in range(-16, 0))]
AROUND_THE_SWITCH = [2.4, np.nextafter(2.5, 0), 2.5, np.nextafter(2.5, 3), 2.6]
LARGE = [10.0, 30.0, 100.0, 700.0, 1e3, 1e4, 1e5, 1e6]
ARGUMENTS = np.array([*SMALL, *np.linspace(0.2, 9.0, 89), *AROUND_THE_SWITCH, *LARGE])


def kummer(a, b, x):
    return hyp1f1(a, b, -x)


# Name: value, first and second derivative, with 1F1(a; b; -x)' = -(a/b) 1F1(a + 1; b + 1; -x).
EXACT = {
    "c": [lambda x: mp.exp(-x), lambda x: -mp.exp(-x), lambda x: mp.exp(-x)],
    "phi1": [lambda x: kummer(1, 2, x), lambda x: -kummer(2, 3, x) / 2, lambda x: kummer(3, 4, x) / 3],
    "phi2": [lambda x: kummer(1, 3, x) / 2, lambda x: -kummer(2, 4, x) / 6, lambda x: kummer(3, 5, x) / 12],
    "psi": [lambda x: kummer(2, 3, x) / 2, lambda x: -kummer(3, 4, x) / 3, lambda x: kummer(4, 5, x) / 4],
    "gap": [
        lambda x: x * kummer(2, 4, x) / 6,
        lambda x: (kummer(2, 4, x) - x * kummer(3, 5, x) / 2) / 6,
        lambda x: (-kummer(3, 5, x) + x * kummer(4, 6, x) * 3 / 10) / 6,
    ],
}
TOLERANCES = [tol.PHI, tol.PHI_SLOPE, tol.PHI_CURVATURE]


def compile_derivative(name, order):
    def function(x):
        return getattr(phi_functions(x), name)

    for _ in range(order):
        function = jax.grad(function)
    return jax.jit(jax.vmap(function), compiler_options=QUICKLY)


def compute_errors(name, order, arguments, values):
    """Yield relative errors; near zeros of the derivatives of gap = phi2 - psi, relative to the derivatives of psi."""
    with mp.workdps(40):
        for x, value in zip(arguments, values, strict=True):
            exact = EXACT[name][order](mpf(float(x)))
            terms = EXACT["psi"][order](mpf(float(x))) if name == "gap" and order else 0
            # Values that underflow in e^-x, or for a denormal argument, have no relative accuracy in any form.
            scale = max(abs(exact), abs(terms), mpf(1e-300))
            yield float(abs(mpf(float(value)) - exact) / scale)


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("name", EXACT)
def test_values_and_derivatives_in_float64(name, order, x64):
    values = compile_derivative(name, order)(jnp.asarray(ARGUMENTS))
    assert values.dtype == jnp.float64
    assert max(compute_errors(name, order, ARGUMENTS, values)) <= TOLERANCES[order].float64


@pytest.mark.parametrize("name", EXACT)
def test_values_in_float32(name):
    arguments = np.float32(ARGUMENTS[(ARGUMENTS > 1e-30) & (ARGUMENTS < 80)])
    values = compile_derivative(name, 0)(jnp.asarray(arguments))
    assert values.dtype == jnp.float32
    assert max(compute_errors(name, 0, arguments, values)) <= tol.PHI.float32


@pytest.mark.parametrize("name", EXACT)
def test_nan_stays_nan(name, x64):
    assert np.isnan(compile_derivative(name, 0)(jnp.array([np.nan]))[0])
