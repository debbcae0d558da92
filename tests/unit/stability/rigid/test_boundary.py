"""Closed form of the stability boundary and exact points on lines, against the characteristic equation (a real 2x2
system) solved in mpmath.
"""

import itertools
import math
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import tolerances as tol
from compiling import QUICKLY
from mpmath import mpf

import oracles
import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.plant.rigid_mass import discretize_plant

NEAR_ZERO = [1e-300, 1e-100, 1e-20, 1e-8, 1e-3]
NEAR_PI = [3.14, math.pi - 1e-6, math.pi - 1e-12, np.nextafter(math.pi, 0), math.pi]
FREQUENCIES = [*NEAR_ZERO, 0.1, 1.0, 2.0, 2.5, *NEAR_PI]
DAMPINGS = [0.0, 1e-12, 0.1, 2.31, 30.0, 1e6]
DELAYS = [0.0, 1e-10, 0.125, 0.5, 1 - 2.0**-53, 1.0, 1.3, 4.0, 37.25, 500.0]
GRID = np.array(list(itertools.product(FREQUENCIES, DAMPINGS, DELAYS)))


def digits(omega, delta):
    return oracles.digits_for(delta) + 40 + max(0, math.ceil(-3 * math.log10(omega)))


def evaluate_with_condition(omega, delta, d):
    """Return alpha and beta, each with its condition number: |f| + sum |x df/dx|, the effect of one rounding error in
    every input.
    """
    exact = oracles.boundary(omega, delta, d)
    h = mpf(10) ** -30
    # Shift omega and delta downwards to stay in the domain, but d upwards, because derivatives at integer d are taken
    # from the right.
    shifted = [(omega * (1 - h), delta, d), (omega, delta * (1 - h), d), (omega, delta, d * (1 + h))]
    shifted_values = [oracles.boundary(*map(mpf, point)) for point in shifted]
    return [(value, abs(value) + sum(abs(m[k] - value) for m in shifted_values) / h) for k, value in enumerate(exact)]


def test_boundary_matches_mpmath():
    got = zwidth.boundary(*GRID.T)
    for point, *walls in zip(GRID, got.alpha, got.beta, strict=True):
        omega, delta, d = map(float, point)
        with mp.workdps(digits(omega, delta)):
            exact_parts = evaluate_with_condition(omega, delta, d)
            # alpha is computed from beta: near a zero of alpha the rounding error of beta dominates.
            floor = mpf(1e-290) + (abs(exact_parts[1][0]) if omega > 1 else 0)
            for value, (exact, condition) in zip(walls, exact_parts, strict=True):
                assert abs(mpf(float(value)) - exact) <= tol.BOUNDARY.float64 * (condition + floor), point


@pytest.mark.parametrize("omega", [0.0, -0.0, 5e-324])
def test_boundary_at_zero_frequency_is_eq_19(omega):
    delta = np.array([0.0, 1e-300, 0.25, 2.31, 1e6])[:, None]
    got = zwidth.boundary(omega, delta, np.array([0.0, 0.5, 1.0, 500.0]))
    np.testing.assert_array_equal(got.alpha, np.zeros((5, 4)))
    np.testing.assert_allclose(got.beta, np.broadcast_to(-delta, (5, 4)), rtol=tol.BOUNDARY_LIMIT.float64)


@pytest.mark.parametrize("d", [0.0, 0.125, 0.9, 1.0, 2.0, 3.3])
def test_boundary_at_pi_is_the_limit(d):
    delta = np.array([0.1, 2.31, 4.0, 100.0, 1e4])
    got = zwidth.boundary(math.pi, delta, d)
    for k, value in enumerate(delta):
        with mp.workdps(100):
            alpha, beta = oracles.boundary(mp.pi - mpf(10) ** -40, value, d)
            size = abs(alpha) + abs(beta)
            assert abs(mpf(float(got.alpha[k])) - alpha) <= 8 * tol.BOUNDARY_LIMIT.float64 * size
            assert abs(mpf(float(got.beta[k])) - beta) <= 8 * tol.BOUNDARY_LIMIT.float64 * size


def test_minus_one_coefficient_places_a_pole_at_minus_one():
    points = np.array(list(itertools.product([0.1, 2.0, 2.31, 4.0, 1e3], [0.0, 0.125, 0.5, 0.9, 1.0, 2.0, 3.3])))
    for limit, (delta, d) in zip(1.0 / discretize_plant(*points.T).minus_one_coefficient, points, strict=True):
        with mp.workdps(60):
            # P(-1) depends on alpha + 2 beta only, so beta = 0 suffices.
            at_zero, at_one = (oracles.evaluate(oracles.polynomial(a, 0, delta, d), -1) for a in (0, 1))
            exact = (-at_zero / (at_one - at_zero)).real
            # N(-1) suffers cancellation near the fractional delay at which it vanishes.
            numerator = oracles.numerator(delta, d - int(d))
            condition = sum(numerator) / abs(numerator[0] - numerator[1] + numerator[2])
            assert oracles.relative_error(limit, exact) <= tol.BOUNDARY.float64 * float(condition)


# Points of differentiation: d integer (derivative from the right) and fractional, including delta = 0.
SLOPE_POINTS = [(0.3, 0.0, 0.0), (0.7, 0.2, 1.0), (1.1, 3.0, 0.4), (2.6, 2.5, 0.0), (0.2, 1e3, 4.5), (0.05, 1e-9, 8.0)]
DIRECTIONS = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)], dtype=float)


@cache
def compile_directional_derivatives():
    """Return a function computing value, first and second derivative of (alpha, beta) along directions in (omega,
    delta, d).
    """

    def derivatives(point, direction):
        def value(step):
            return jnp.stack(zwidth.boundary(*(point + step * direction)))

        def slope(step):
            return jax.jvp(value, (step,), (1.0,))

        (first, second), (_, third) = jax.jvp(slope, (0.0,), (1.0,))
        return first, second, third

    # One compilation per direction is faster than one for all directions.
    compiled = jax.jit(jax.vmap(derivatives, (0, None)), compiler_options=QUICKLY)

    def each(points, directions):
        results = [compiled(points, direction) for direction in directions]
        return [np.stack([np.asarray(part) for part in parts], 1) for parts in zip(*results, strict=True)]

    return each


def test_first_and_second_derivatives_match_finite_differences(x64):
    _, first, second = compile_directional_derivatives()(np.array(SLOPE_POINTS), DIRECTIONS)
    h = mpf(10) ** -25
    with mp.workdps(140):
        for (row, point), (column, direction) in itertools.product(enumerate(SLOPE_POINTS), enumerate(DIRECTIONS)):

            def shifted_boundary(steps, point=point, direction=direction):
                return oracles.boundary(*(mpf(x) + steps * h * mpf(u) for x, u in zip(point, direction, strict=True)))

            for part, (f0, f1, f2, f3) in enumerate(zip(*(shifted_boundary(steps) for steps in range(4)), strict=True)):
                slope, bend = (4 * f1 - f2 - 3 * f0) / (2 * h), (2 * f0 - 5 * f1 + 4 * f2 - f3) / h**2
                for got, exact in ((first, slope), (second, bend)):
                    size = np.abs(got[row, :, part]).max()
                    assert oracles.relative_error(got[row, column, part], exact, size) <= tol.BOUNDARY_SLOPE.float64


def test_derivative_in_omega_near_pi(x64):
    # alpha and beta are even about pi: the derivative is the second derivative times the distance from pi.
    slope = jax.jit(
        jax.jacfwd(lambda omega, delta, d: jnp.stack(zwidth.boundary(omega, delta, d)), 0), compiler_options=QUICKLY
    )
    for delta, d in ((0.5, 0.0), (0.0, 0.5), (0.3, 0.5), (0.7, 1.0), (0.2, 4.0), (2.0, 37.25)):
        with mp.workdps(80):
            h = mpf(10) ** -12
            ahead, level = (oracles.boundary(mp.pi - k * h, delta, d) for k in (2, mpf(10) ** -12))
            bend = [2 * (a - b) / (2 * h) ** 2 for a, b in zip(ahead, level, strict=True)]
        for distance in (0.0, 1e-12, 1e-9, 1e-7, 1e-6):
            omega = math.pi - distance
            # Add the part of pi that float64 does not represent.
            left = mpf(math.pi - omega) + mpf("1.2246467991473532e-16")
            for got, second in zip(slope(omega, delta, d), bend, strict=True):
                # Rounding errors of cancelling terms, plus the neglected fourth derivative.
                allowed = 4 * tol.EPS64 + (2e-10 + (d + 1) ** 2 * float(left) ** 2) * float(left)
                assert abs(mpf(float(got)) + second * left) <= allowed * abs(second), (delta, d)


# --- points on lines ---------------------------------------------------------------------------------------------

# All calls use equally many points and so share one compilation.
DEVICES = np.array(list(itertools.product([0.0, 0.1, 2.4, 100.0], [0.0, 0.5, 1.0, 1.3, 4.0])))
DELTA, D = DEVICES.T


@pytest.fixture(scope="module")
def ridge():
    return zwidth.alpha_max(DELTA, D)


def test_strongly_damped_device_is_limited_by_a_pole_at_minus_one():
    delta, beta = np.full(DELTA.size, 10.0), np.full(DELTA.size, -1.0)
    points = zwidth.boundary_point(delta, np.zeros(DELTA.size), beta=beta)
    with mp.workdps(60):
        c = mp.exp(-10)
        # alpha + 2 beta = 2 delta^2 (1 + c)/(delta (1 + c) - 2 (1 - c))
        alpha = 200 * (1 + c) / (10 * (1 + c) - 2 * (1 - c)) + 2
    np.testing.assert_array_equal(points.omega, math.pi)
    np.testing.assert_allclose(points.alpha, float(alpha), rtol=1e-14)


def test_lines_outside_the_stable_region_have_no_boundary_point(ridge):
    nan = np.full(DELTA.size, np.nan)
    lines: tuple[dict[str, Any], ...] = (
        {"alpha": 1.001 * ridge.alpha},
        {"alpha": 1.001 * ridge.alpha, "side": "upper"},
        {"alpha": np.zeros(DELTA.size)},
        {"alpha": -np.ones(DELTA.size), "side": "upper"},
        {"beta": -1.001 * DELTA - 0.01},
        {"beta": 10 * (DELTA + 1)},
    )
    for line in lines:
        points = zwidth.boundary_point(DELTA, D, **line)
        np.testing.assert_array_equal(points.status, Status.NO_BOUNDARY)
        for value in (points.alpha, points.beta, points.omega):
            np.testing.assert_array_equal(value, nan)


@pytest.mark.parametrize(
    "line, message",
    [
        ({}, "beta, alpha: got none; give exactly one of the two"),
        ({"alpha": 0.1, "beta": 0.1}, "beta, alpha: got both; give exactly one"),
        ({"alpha": 0.1, "side": "top"}, "side: got 'top', allowed are 'lower', 'upper'"),
        ({"alpha": "0.1"}, "alpha.*: got '0.1', a real number"),
    ],
)
def test_invalid_line_arguments_raise(line, message):
    with pytest.raises(InputError, match=message):
        zwidth.boundary_point(0.1, 1, **line)
