"""Taylor arithmetic against the derivatives that JAX computes."""

import jax
import jax.numpy as jnp
import numpy as np
from compiling import QUICKLY
from scipy.linalg import expm

from zwidth.numerics.taylor import differentiate_implicitly, flow, multiply, seed, solve, stack

POINT = [0.7, -0.4, 1.3]


def assert_equal_derivatives(result, function):
    """Compare value, gradient and Hessian with those of a JAX function of three variables."""

    def differentiate(x):
        return function(x), jax.jacfwd(function)(x), jax.jacfwd(jax.jacfwd(function))(x)

    # One program, because every operation outside jit would be compiled separately.
    value, first, second = jax.jit(differentiate, compiler_options=QUICKLY)(jnp.array(POINT))
    np.testing.assert_allclose(result.v, value, rtol=1e-13)
    np.testing.assert_allclose(result.first, first, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(result.second, second, rtol=1e-11, atol=1e-12)


def compute(point, xp):
    """A function of all operations, for Taylor objects and for arrays."""
    a, b, c = point
    t = xp.exp(a * b) / c - xp.expm1(b) + 2.0 * xp.tan(a) / (1.0 - b) + xp.sqrt(c) * xp.sin(c - a)
    return t**3 - 1.5 / t


def test_functions_agree_with_jax(x64):
    assert_equal_derivatives(compute(seed(POINT, 2), np), lambda x: compute(x, jnp))
    a, b, c = seed(POINT, 2)
    square = ((a + b * 1j) / (c - 2j)).conjugate() * 3j
    assert_equal_derivatives(square.imag, lambda x: (jnp.conj((x[0] + 1j * x[1]) / (x[2] - 2j)) * 3j).imag)
    assert (a > b, a < b, a >= 0.7, a <= 0.6) == (True, False, True, False)


def test_matrices_agree_with_jax(x64):
    def matrices(point, build):
        a, b, c = point
        return build([[a, b], [0.5, c]]), build([b, 1.0])

    def stacked(entries):
        return jnp.array(entries)

    a, b, c = seed(POINT, 2)
    A, B = matrices((a, b, c), lambda entries: stack(entries, a))
    assert_equal_derivatives(solve(A, B), lambda x: jnp.linalg.solve(*matrices(x, stacked)))
    assert_equal_derivatives(multiply(A, A), lambda x: matrices(x, stacked)[0] @ matrices(x, stacked)[0])

    def whole(x):
        A, B = matrices(x, stacked)
        both = jnp.zeros((3, 3)).at[:2, :2].set(A).at[:2, 2].set(B)
        return jax.scipy.linalg.expm(both * x[0])

    change, held = flow(A, B, a)
    assert_equal_derivatives(change, lambda x: whole(x)[:2, :2] - jnp.eye(2))
    assert_equal_derivatives(held, lambda x: whole(x)[:2, 2])
    np.testing.assert_allclose(change.v, expm(A.v * 0.7) - np.eye(2), rtol=1e-13)


def test_implicit_derivatives_of_a_square_root(x64):
    # u^2 = p^3 at p = 4, u = 8.
    p, u = seed([4.0, 8.0], 2)
    (result,) = differentiate_implicitly([u * u - p**3], [8.0])
    assert (result.v, result.first[0]) == (8.0, 1.5 * 4.0**0.5)
    assert result.second is not None
    assert result.second[0, 0] == 0.75 * 4.0**-0.5
    p, u = seed([4.0, 8.0], 1)
    assert np.isnan(differentiate_implicitly([p * 0.0 + u * 0.0], [8.0])[0].first).all()
