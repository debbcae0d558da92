"""The stiffness slope g of eq. (22), against its limit polynomial, closed forms, and the ridge at strong damping."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from compiling import QUICKLY

import zwidth
from zwidth.stability.rigid.ridge import slope_kernel, stiffness_slope


def limit_polynomial(g, h, d):
    """Return z^(2+n) (z - 1) + ((1 - f) z + f) ((g + h) z - h), highest power first."""
    n = int(np.floor(d))
    f = d - n
    total = np.zeros(n + 4)
    total[:2] = 1, -1
    total[-3:] += np.convolve([1 - f, f], [g + h, -h])
    return total


@pytest.mark.parametrize("d", [0.0, 0.1, 0.25, 0.3, 0.9, 1.0, 1.5, 2.0, 3.0, 4.0, 7.25])
def test_slope_is_the_largest_with_a_stable_limit_polynomial(d):
    g = stiffness_slope(d)
    # h = -1 at the corner of d = 0 and close to 0 for long delays; the grid resolves both sides of g.
    offsets = np.linspace(-1.05, 1.05, 1401)

    def smallest_radius(slope):
        return min(np.abs(np.roots(limit_polynomial(slope, h, d))).max() for h in offsets)

    assert smallest_radius(0.99 * g) < 1
    assert smallest_radius(1.01 * g) > 1


def test_published_values():
    got = stiffness_slope(np.arange(5))
    np.testing.assert_allclose(got, [4, 1, 0.631130, 0.465011, 0.369041], atol=5e-7)
    np.testing.assert_allclose(stiffness_slope(np.arange(5.0)), got, rtol=tol.LIMIT_SLOPE.float64)


def test_closed_forms_for_delays_below_one_period():
    d = np.linspace(0, 0.25, 26)
    exact = 4 * (1 - 3 * d) / (1 - 2 * d) ** 2
    np.testing.assert_allclose(stiffness_slope(d), exact, rtol=tol.LIMIT_SLOPE.float64)
    d = np.linspace(0.25, 1, 76)
    np.testing.assert_allclose(stiffness_slope(d), 1 / d, rtol=tol.LIMIT_SLOPE.float64)
    assert stiffness_slope(1 / 6) == pytest.approx(4.5, rel=1e-15)


def test_slope_is_the_limit_of_the_ridge():
    d = np.array([0.0, 0.05, 0.2, 0.5, 0.8, 1.0, 1.3, 2.0, 2.6, 10.0, 100.5])
    slope = stiffness_slope(d)
    for delta in (1e6, 1e7, 1e8):
        ratio = zwidth.alpha_max(delta, d).alpha / delta
        # alpha_max = g delta + O(1).
        np.testing.assert_allclose(ratio, slope, rtol=30 / delta)


@cache
def compiled_slopes():
    return jax.jit(jax.vmap(jax.value_and_grad(lambda d: slope_kernel(d))), compiler_options=QUICKLY)


def differentiate_slope(d):
    """Return the slope and its derivative; padded to one size, for a single compilation."""
    with jax.enable_x64(True):
        padded = np.resize(np.asarray(d, dtype=float), 16)
        return [np.asarray(leaf)[: len(d)] for leaf in compiled_slopes()(padded)]


def test_derivative_in_d():
    d = np.array([0.0, 0.1, 0.2, 0.3, 0.6, 0.95])
    exact = np.where(d < 0.25, 4 * (1 - 6 * d) / (1 - 2 * d) ** 3, -1 / np.maximum(d, 0.25) ** 2)
    np.testing.assert_allclose(differentiate_slope(d)[1], exact, rtol=1e-13)
    d = np.array([0.3, 1.2, 2.7, 8.5])
    step = 1e-5
    up, down = (stiffness_slope(d + sign * step) for sign in (1, -1))
    np.testing.assert_allclose(differentiate_slope(d)[1], (up - down) / (2 * step), rtol=1e-7)


def test_derivative_at_integer_delays_is_from_the_right():
    integers = np.array([1.0, 2.0, 3.0])
    before, at_integers, after = (differentiate_slope(integers + step) for step in (-1e-9, 0.0, 1e-9))
    np.testing.assert_allclose(before[0], at_integers[0], rtol=1e-8)
    np.testing.assert_allclose(after[1], at_integers[1], atol=1e-7)
    assert (before[1] < at_integers[1] - 0.1).all()
    assert at_integers[1][0] == pytest.approx(0, abs=1e-14)
    assert before[1][0] == pytest.approx(-1, rel=1e-8)


def test_shapes_invalid_input_and_precision():
    got = stiffness_slope(np.array([[1.0, np.nan], [-1.0, np.inf]]))
    np.testing.assert_array_equal(np.isnan(got), [[False, True], [True, True]])
    values, slopes = differentiate_slope([1.5, np.nan, -1.0, np.inf])
    assert np.isnan(values[1:]).all()
    assert np.isnan(slopes[1:]).all()
    assert np.isfinite(slopes[0])
    assert isinstance(stiffness_slope(2), np.float64)
    single = jax.jit(stiffness_slope)(jnp.float32(2.0))
    assert single.dtype == jnp.float32
    assert single == pytest.approx(0.631130, abs=1e-5)
