"""Zeros of functions whose zeros are known: Newton's method, bisection, false position."""

import jax
import numpy as np
import pytest

from zwidth.numerics.root_finding import attach_root_derivatives, bisect, false_position, newton


def test_a_step_out_of_the_bracket_becomes_a_bisection():
    # From 1 on Newton's method for arctan overshoots farther and farther from about 1.39.
    zero, last = newton(
        lambda x: (np.arctan(x), 1 / (1 + x * x)), np.float64(-30.0), np.float64(7.0), np.float64(7), 24
    )
    assert abs(zero) < 1e-15
    assert last < 1e-6
    # A point's result does not depend on those beside it.
    starts = np.array([7.0, 0.1, -20.0])
    both, _ = newton(lambda x: (np.arctan(x) - 1, 1 / (1 + x * x)), starts - 30, starts + 10, starts, 24)
    for start, together in zip(starts, both, strict=True):
        alone, _ = newton(lambda x: (np.arctan(x) - 1, 1 / (1 + x * x)), start - 30, start + 10, start, 24)
        assert alone == together


def test_bisection_ends_between_two_neighbors():
    found = bisect(lambda x: x * x < 2, np.float64(1e-3), np.float64(8.0))
    assert found == pytest.approx(np.sqrt(2), rel=4e-16)


def test_false_position_and_its_derivative(x64):
    def function(x, shift=0.3):
        return np.exp(-x) - shift if isinstance(x, np.floating) else jax.numpy.exp(-x) - shift

    low, high = np.float64(0.0), np.float64(9.0)
    found = false_position(function, low, high, function(low), function(high), 240, 1e-16)
    assert found == pytest.approx(-np.log(0.3), rel=1e-15)

    def root(shift):
        return attach_root_derivatives(function, jax.numpy.asarray(found), lambda x, slope, step: slope < 0, shift)

    assert jax.grad(root)(0.3) == pytest.approx(-1 / 0.3, rel=1e-14)
    assert jax.grad(jax.grad(root))(0.3) == pytest.approx(1 / 0.09, rel=1e-13)
