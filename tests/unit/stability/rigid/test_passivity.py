"""Passivity at any delay, against eq. (21), the model's passivity condition in 50 digits, and a linear program."""

import math
from typing import Any

import jax
import mpmath as mp
import numpy as np
import pytest
import tolerances as tol
from compiling import compile_bends
from scipy.optimize import linprog

import zwidth
from zwidth.core.errors import InputError
from zwidth.stability.rigid.passivity import passive_stiffness_slope
from zwidth.stability.rigid.poles import radius_by_companion
from zwidth.stability.rigid.required_damping import find_directions

RANDOM = np.random.default_rng(20)
# Relative error beyond that of the required damping.
EXACT = 2e-15
DELAYS = [0.0, 1.0, 2.0, 4.0, 8.0, 0.05, 0.125, 0.5, 0.9, 1.3, 2.5]


def size(alpha, beta, delta, d):
    return np.abs(alpha) * (d + 1) + np.abs(beta) + delta


def test_zero_delay_is_eq_21():
    alpha, beta, delta = RANDOM.uniform([0, -2, 0], [4, 2, 3], (500, 3)).T
    margin = zwidth.passivity_margin(alpha, beta, delta, 0)
    exact = delta - alpha / 2 - np.abs(beta)
    assert np.abs(margin - exact).max() <= tol.PASSIVITY.float64 * size(alpha, beta, delta, 0).max()
    clear = np.abs(exact) > 1e-9
    np.testing.assert_array_equal(zwidth.is_passive(alpha, beta, delta, 0)[clear], exact[clear] > 0)


@pytest.mark.parametrize("d", DELAYS)
def test_passive_set_is_a_convex_cone(d):
    one, two = RANDOM.uniform([0, -1, 0], [2, 1, 3], (2, 40, 3))
    first, second, middle = (zwidth.passivity_margin(*wall.T, d=d) for wall in (one, two, (one + two) / 2))
    allowed = tol.PASSIVITY.float64 * 10 * (d + 1)
    assert (middle >= (first + second) / 2 - allowed).all()
    np.testing.assert_allclose(zwidth.passivity_margin(*(3 * one).T, d=d), 3 * first, rtol=0, atol=3 * allowed)


@pytest.mark.parametrize("d, share", [(1, 0.42), (2, 0.62), (4, 0.77)])
def test_eq_21_accepts_unstable_walls_if_delayed(d, share):
    delta = RANDOM.uniform(0.05, 3.0, 4000)
    alpha, beta = RANDOM.uniform(0, 2, 4000) * delta, RANDOM.uniform(-1, 1, 4000) * delta
    accepted = delta > alpha / 2 + np.abs(beta)
    unstable = radius_by_companion(alpha, beta, delta, d) > 1 + tol.LABEL_BAND.float64
    assert np.mean(unstable[accepted]) == pytest.approx(share, abs=0.05)
    assert not zwidth.is_passive(alpha, beta, delta, d)[unstable].any()


def slope_by_linear_program(d, frequencies=20_000):
    """Return (alpha, beta) of the largest alpha/delta at integer d: delta = 1 >= alpha D/2 - beta cos((d + 1) w) at
    every frequency.
    """
    w = np.linspace(0, math.pi, frequencies + 1)[1:]
    dirichlet = np.sin((d + 0.5) * w) / np.sin(w / 2)
    constraints = np.column_stack([dirichlet / 2, -np.cos((d + 1) * w)])
    limit = np.array([d + 0.5, -1.0])  # w -> 0
    # Start with a subset of the constraints and add the most violated one until none is violated: the optimum of all.
    some = set(range(0, frequencies, frequencies // 100))
    while True:
        rows = np.vstack([constraints[sorted(some)], limit])
        solved = linprog([-1, 0], A_ub=rows, b_ub=np.ones(len(rows)), bounds=(None, None))
        assert solved.success
        most = int(np.argmax(constraints @ solved.x))
        if most in some:
            return solved.x
        some.add(most)


@pytest.mark.parametrize(
    "d, exact", [(0, 2.0), (1, 2 * math.sqrt(2) - 2), (2, 4 - 2 * math.sqrt(3)), (3, None), (5, None)]
)
def test_stiffest_passive_wall_agrees_with_a_linear_program(d, exact):
    slope, beta = passive_stiffness_slope(d)
    expected = slope_by_linear_program(d)
    assert slope == pytest.approx(expected[0], rel=tol.PASSIVE_SLOPE_LP.float64)
    assert beta == pytest.approx(expected[1], abs=1e-3)
    if exact is not None:
        assert slope == pytest.approx(exact, rel=tol.PASSIVE_SLOPE.float64)


def test_stiffest_passive_wall_of_a_fractional_delay_is_on_the_boundary():
    slope, beta = passive_stiffness_slope(0.5)
    margin = zwidth.passivity_margin(slope * np.array([0.999, 1.001]), beta, 1.0, 0.5)
    assert margin[0] > 0 > margin[1]
    # No other virtual damping is passive at this stiffness.
    assert zwidth.passivity_margin(1.01 * slope, np.linspace(-1, 1, 41), 1.0, 0.5).max() < 0


@pytest.mark.parametrize("d", [-1, np.nan, [1, 2]])
def test_stiffest_passive_wall_requires_a_single_valid_delay(d):
    with pytest.raises(InputError, match=r"d: got .*; a single finite number of at least 0 is needed"):
        passive_stiffness_slope(d)


def test_negative_stiffness_is_never_passive():
    margin = zwidth.passivity_margin(-0.1, 0.0, 5.0, np.array([0, 1, 0.5]))
    np.testing.assert_array_equal(margin, [-0.1, -0.1, -0.1])
    # Without a wall the margin is zero, which does not count as passive.
    assert zwidth.passivity_margin(0.0, 0.0, 0.0, 1) == 0
    assert not zwidth.is_passive(0.0, 0.0, 0.0, 1)
    assert zwidth.passivity_margin(-0.0, 0.0, 1.0, 1) == 1


def test_derivatives_agree_with_finite_differences(x64):
    # Central differences of the values, and of the first derivatives.
    def margin(wall):
        return zwidth.passivity_margin(*wall)

    d = np.array([0.001, 1.001, 2.3, 0.1, 0.5, 300.2])
    walls = np.stack([0.3 / (d + 0.5), 0.4 + 0 * d, 1.0 + 0 * d, d], axis=-1)
    differentiate = compile_bends(jax.grad(margin))
    gradient, hessian = differentiate(walls)
    for k in range(4):
        step = np.zeros_like(walls)
        step[:, k] = 1e-5 / (d + 0.5) if k == 0 else 1e-5
        slope = (margin((walls + step).T) - margin((walls - step).T)) / (2 * step[:, k])
        assert (np.abs(gradient[:, k] - slope) <= 1e-5 * np.abs(gradient).max(axis=1)).all()
        expected = (differentiate(walls + step)[0] - differentiate(walls - step)[0]) / (2 * step[:, k, None])
        largest = np.abs(hessian).max(axis=(1, 2))[:, None]
        assert (np.abs(hessian[..., k] - expected) <= 1e-5 * largest).all()


def test_derivative_at_the_kink_alpha_equals_two_beta():
    # At d = 0 the margin is delta - alpha/2 - |beta|, also on the line alpha = 2 beta.
    assert float(jax.grad(lambda alpha: zwidth.passivity_margin(alpha, 0.1, 1.0, 0))(0.2)) == -0.5


@pytest.mark.parametrize("beta, d", [(0.3, 0), (0.3, 0.5), (-0.3, 0.5), (0.3, 2)])
def test_derivative_at_zero_stiffness_is_the_right_derivative(beta, d, x64):
    slope = jax.grad(lambda alpha: zwidth.passivity_margin(alpha, beta, 1.0, d))(0.0)
    margins = zwidth.passivity_margin(np.array([0.0, 1e-6, 2e-6]), beta, 1.0, d)
    assert float(slope) == pytest.approx((4 * margins[1] - 3 * margins[0] - margins[2]) / 2e-6, rel=1e-8)


def damping_required(omega, alpha, beta, n, f):
    """Return the damping that the model's passivity condition requires at one frequency, in mpmath."""
    z = mp.expj(omega)
    twice = 2 * (1 - mp.cos(omega))
    g = mp.conj(alpha + beta * (1 - 1 / z)) * (z - 1) * z**n / 2
    half_b = mp.re(((1 - f) + f * z) * g)
    return (mp.sqrt(half_b**2 + twice * f * (1 - f) * abs(g) ** 2) - half_b) / twice


def golden_maximum(function, low, high, steps=70):
    ratio = (mp.sqrt(5) - 1) / 2
    one, two = high - ratio * (high - low), low + ratio * (high - low)
    at_one, at_two = function(one), function(two)
    for _ in range(steps):
        if at_one > at_two:
            high, two, at_two = two, one, at_one
            one = high - ratio * (high - low)
            at_one = function(one)
        else:
            low, one, at_one = one, two, at_two
            two = low + ratio * (high - low)
            at_two = function(two)
    return max(at_one, at_two, function(low), function(high))


def required_in_mpmath(alpha, beta, d):
    """Return the supremum over frequency in 50 digits: golden section on the first half wave and around the largest
    sample.
    """
    n = math.floor(d)
    samples = max(2000, 40 * (n + 2))
    step = math.pi / samples
    omega = np.arange(1, samples + 1) * step
    z = np.exp(1j * omega)
    g = np.conj(alpha + beta * (1 - 1 / z)) * (z - 1) * z**n / 2
    half_b, twice = np.real(((1 - (d - n)) + (d - n) * z) * g), 4 * np.sin(omega / 2) ** 2
    values = (np.sqrt(half_b**2 + twice * (d - n) * (1 - (d - n)) * np.abs(g) ** 2) - half_b) / twice
    top = float(omega[np.argmax(values)])
    with mp.workdps(50):
        f, a, b = mp.mpf(d) - n, mp.mpf(alpha), mp.mpf(beta)
        tiny = mp.mpf(10) ** -18
        brackets: list[tuple[Any, Any]] = [(tiny, min(mp.pi, 1.1 * mp.pi / (mp.mpf(d) + 1)))]
        brackets.append((max(tiny, mp.mpf(top - step)), min(mp.pi, mp.mpf(top + step))))
        return max(golden_maximum(lambda w: damping_required(w, a, b, n, f), *bracket) for bracket in brackets)


def sample_directions(random, d):
    """Return ratios beta/alpha: random ones of both signs, and ones near the two transitions of the peak."""
    transitions = find_directions(np.float64(d))
    ratios = [*(10 ** random.uniform(-3, 4, 3) * (d + 0.1)), -(10 ** random.uniform(-3, 3))]
    for edge in transitions:
        if 0 < edge < np.inf:
            ratios += [edge * (1 + sign * 10 ** random.uniform(-9, -1)) for sign in (-1, 1)]
    return np.array(ratios)


@pytest.mark.parametrize(
    "d", [0.0, 1.0, 2.0, 7.0, 60.0, 1e-9, 1e-4, 0.1, 2 / 9, 0.25, 1 / 3, 0.5, 0.77, 1 - 1e-9, 1.5, 2.6, 8.999999]
)
def test_all_directions_agree_with_mpmath(d):
    ratio = sample_directions(np.random.default_rng(7), d)
    alpha, beta = 1 / (1 + np.abs(ratio)), ratio / (1 + np.abs(ratio))
    required = [required_in_mpmath(a, b, d) for a, b in zip(alpha, beta, strict=True)]
    margin = zwidth.passivity_margin(alpha, beta, np.zeros_like(alpha), d)
    for a, b, got, exact in zip(alpha, beta, margin, required, strict=True):
        assert abs(float(-got / exact - 1)) <= EXACT, (a, b)


@pytest.mark.parametrize("d", [10_000.0, 10_000.3])
def test_delay_of_ten_thousand_periods(d):
    for ratio in (1e2, 4e3, 1e6):
        alpha, beta = 1 / (1 + ratio), ratio / (1 + ratio)
        required = required_in_mpmath(alpha, beta, d)
        assert abs(float(-zwidth.passivity_margin(alpha, beta, 0.0, d) / required - 1)) <= EXACT
        edge = float(required)
        assert zwidth.is_passive(alpha, beta, edge * (1 + 1e-13), d)
        assert not zwidth.is_passive(alpha, beta, edge * (1 - 1e-13), d)


def test_condition_has_a_single_peak_in_the_first_half_wave():
    # Verified numerically because the proof assumes it: for fractional delays and beta > 0 there is one peak at psi <=
    # pi.
    random = np.random.default_rng(5)
    for d in random.uniform(0, 1, 12) + random.integers(0, 6, 12):
        n, f = math.floor(d), d - math.floor(d)
        w = np.linspace(0, np.pi / (n + 1), 4001)[1:]
        psi = (n + 1) * w + np.arctan2(f * np.sin(w), 1 - f + f * np.cos(w))
        w = w[psi <= np.pi]
        z = np.exp(1j * w)
        for ratio in 10 ** random.uniform(-2, 3, 20) * (d + 0.1):
            g = np.conj(1 + ratio * (1 - 1 / z)) * (z - 1) * z**n / 2
            half_b, twice = np.real(((1 - f) + f * z) * g), 4 * np.sin(w / 2) ** 2
            values = (np.sqrt(half_b**2 + twice * f * (1 - f) * np.abs(g) ** 2) - half_b) / twice
            steps = np.diff(values)
            signs = np.sign(steps[np.abs(steps) > 1e-12 * np.abs(values).max()])
            assert np.sum(signs[1:] > signs[:-1]) == 0


@pytest.mark.parametrize("d", [0.0, 0.15, 0.5, 1.0, 2.3, 500.0])
def test_grids_agree_with_scattered_walls(d):
    alpha, beta = np.linspace(-0.1, 2.0, 90)[:, None] / (d + 1), np.linspace(-1.2, 1.2, 100)
    grid = zwidth.passivity_margin(alpha, beta, 1.0, d)
    walls = [value.ravel()[::7] for value in np.broadcast_arrays(alpha, beta)]
    scattered = zwidth.passivity_margin(*walls, delta=1.0, d=d)
    np.testing.assert_allclose(grid.ravel()[::7], scattered, rtol=0, atol=2 * EXACT)
    np.testing.assert_array_equal(zwidth.is_passive(alpha, beta, 1.0, d), grid > 0)


@pytest.mark.usefixtures("early_compiler")
def test_several_delays_in_one_grid():
    delays = np.array([0.0, np.nan, 2.0, 0.3])[:, None, None]
    alpha, beta = np.linspace(0, 1, 100)[:, None], np.linspace(-1, 1, 90)
    grid = zwidth.passivity_margin(alpha, beta, 1.0, delays)
    assert np.isnan(grid[1]).all()
    for single, d in zip(grid[[0, 2, 3]], (0.0, 2.0, 0.3), strict=True):
        np.testing.assert_allclose(single, zwidth.passivity_margin(alpha, beta, 1.0, d), rtol=0, atol=2 * EXACT)
    # Walls with individual delays use the compiled kernel.
    walls = np.random.default_rng(3).uniform([0, -1, 0, 0], [1, 1, 2, 9], (5000, 4)).T
    few = zwidth.passivity_margin(*(value[:500] for value in walls))
    np.testing.assert_allclose(zwidth.passivity_margin(*walls)[:500], few, rtol=0, atol=1e-14)
