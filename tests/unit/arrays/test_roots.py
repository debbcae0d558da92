"""Zeros of functions whose zeros are known: brackets of the last one, Newton's method, bisection, false position."""

import jax
import numpy as np
import pytest

from zwidth.arrays.roots import bisect, false_position, follow_root, last_cell, newton


def solve(value, slope, inner, outer, offset=0.0):
    low, high, crossed = last_cell(value, *map(np.float64, (inner, outer, offset)))
    zero, last = newton(lambda x: (value(x), slope(x)), low, high, high, 24)
    return zero, bool(crossed), last


def test_of_several_zeros_the_last():
    zero, crossed, _ = solve(lambda x: (x - 1) * (x - 2) * (x - 3), lambda x: 3 * x * x - 12 * x + 11, 0.5, 10.0)
    assert crossed
    assert zero == pytest.approx(3.0, rel=1e-15)


def test_a_function_above_zero_has_none():
    assert not solve(lambda x: 1.0 + x, lambda x: 1.0 + 0 * x, 0.5, 2.0)[1]


@pytest.mark.parametrize("place", [0.713, 1.0012, 1.9, 3.999])
@pytest.mark.parametrize("height", [1e-7, 1e-9])
def test_a_dip_between_two_samples_is_found_on_its_far_side(place, height):
    # No sample lies below 0: the cells on both sides of the lowest one are kept.
    assert np.all((0.5 * 8 ** (np.arange(161) / 160) - place) ** 2 > height)
    zero, crossed, _ = solve(lambda x: (x - place) ** 2 - height, lambda x: 2 * (x - place), 0.5, 4.0)
    assert not crossed
    assert zero == pytest.approx(place + np.sqrt(height), rel=1e-12)


def test_a_zero_at_the_inner_end_and_an_offset():
    zero, crossed, _ = solve(lambda x: x, lambda x: 1.0 + 0 * x, 0.0, 5.0, 1.0)
    assert crossed
    assert abs(zero) < 1e-300


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


@pytest.mark.parametrize("geometric", [False, True])
def test_bisection_ends_between_two_neighbors(geometric):
    found = bisect(lambda x: x * x < 2, np.float64(1e-3), np.float64(8.0), geometric=geometric)
    assert found == pytest.approx(np.sqrt(2), rel=4e-16)


def test_false_position_and_its_derivative(x64):
    def function(x, shift=0.3):
        return np.exp(-x) - shift if isinstance(x, np.floating) else jax.numpy.exp(-x) - shift

    low, high = np.float64(0.0), np.float64(9.0)
    found = false_position(function, low, high, function(low), function(high), 240, 1e-16)
    assert found == pytest.approx(-np.log(0.3), rel=1e-15)

    def root(shift):
        return follow_root(lambda x: function(x, shift), jax.numpy.asarray(found), lambda slope, step: slope < 0)

    assert jax.grad(root)(0.3) == pytest.approx(-1 / 0.3, rel=1e-14)
    assert jax.grad(jax.grad(root))(0.3) == pytest.approx(1 / 0.09, rel=1e-13)
