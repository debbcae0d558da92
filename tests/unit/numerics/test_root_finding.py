"""Test root finding by Newton's method, bisection and false position, on functions with known roots."""

import jax
import numpy as np
import pytest

from zwidth.numerics.root_finding import attach_root_derivatives, bisect, false_position, newton


def test_newton_bisects_if_a_step_leaves_the_bracket():
    # For arctan, Newton's method diverges from starting values beyond about 1.39.
    zero, last = newton(
        lambda x: (np.arctan(x), 1 / (1 + x * x)), np.float64(-30.0), np.float64(7.0), np.float64(7), 24
    )
    assert abs(zero) < 1e-15
    assert last < 1e-6
    # The result of a point does not depend on the other points.
    starts = np.array([7.0, 0.1, -20.0])
    batch, _ = newton(lambda x: (np.arctan(x) - 1, 1 / (1 + x * x)), starts - 30, starts + 10, starts, 24)
    for start, in_batch in zip(starts, batch, strict=True):
        single, _ = newton(lambda x: (np.arctan(x) - 1, 1 / (1 + x * x)), start - 30, start + 10, start, 24)
        assert single == in_batch


def test_bisection_converges_to_adjacent_floats():
    root = bisect(lambda x: x * x < 2, np.float64(1e-3), np.float64(8.0))
    assert root == pytest.approx(np.sqrt(2), rel=4e-16)


def test_false_position_and_derivatives_of_its_root(x64):
    def function(x, shift=0.3):
        return np.exp(-x) - shift if isinstance(x, np.floating) else jax.numpy.exp(-x) - shift

    low, high = np.float64(0.0), np.float64(9.0)
    zero = false_position(function, low, high, function(low), function(high), 240, 1e-16)
    assert zero == pytest.approx(-np.log(0.3), rel=1e-15)

    def differentiable_root(shift):
        return attach_root_derivatives(function, jax.numpy.asarray(zero), lambda x, slope, step: slope < 0, shift)

    assert jax.grad(differentiable_root)(0.3) == pytest.approx(-1 / 0.3, rel=1e-14)
    assert jax.grad(jax.grad(differentiable_root))(0.3) == pytest.approx(1 / 0.09, rel=1e-13)
