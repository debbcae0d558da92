"""The characteristic polynomial against eqs. (17), (11) and (10) of the paper and the zero-order-hold model, in
mpmath.
"""

import itertools

import jax
import numpy as np
import pytest
import tolerances as tol
from mpmath import mp, mpf

import oracles
import zwidth
from zwidth.plant.rigid_mass import discretize_mass
from zwidth.stability.reference import expand_polynomial
from zwidth.stability.rigid.broadcasting import find_degree

WALLS = [(0.5, 0.5), (1e-8, -0.3), (40.0, -7.0), (-0.1, 0.0), (0.0, 1.0)]
DAMPINGS = [1e-300, 1e-12, 1e-8, 1e-3, 0.1, 1.0, 2.31, 30.0, 700.0, 1e4, 1e6]
INTEGER_DELAYS = [0, 1, 2, 4, 8]
FRACTIONAL_DELAYS = [1e-16, 0.125, 0.5, 0.9, 1 - 2.0**-53, 1.3, 4.5]


def assert_coefficients_agree(got, exact, sizes):
    """Compare coefficients; ``sizes`` are the sums of the magnitudes of the terms of each coefficient."""
    assert len(got) == len(exact)
    for value, true, size in zip(got, exact, sizes, strict=True):
        assert abs(mpf(float(value)) - true) <= tol.COEFFICIENT.float64 * max(size, mpf(1e-290))


def sum_magnitudes(alpha, beta, delta, d):
    """Return, for each coefficient, the sum of the magnitudes of its terms, to which its rounding error is
    proportional.
    """
    n = int(d)
    a2, a1, a0 = oracles.numerator(delta, mpf(float(d)) - n)
    c = mp.exp(-mpf(delta))
    total = [mpf(1), 1 + c, c] + [mpf(0)] * (n + 2)
    wall = (abs(mpf(alpha)), abs(mpf(beta)))
    for k, (spring, damper) in enumerate([(a2, a2), (a1, a2 + a1), (a0, a1 + a0), (0, a0)]):
        total[n + 1 + k] += wall[0] * spring + wall[1] * damper
    return total if d != n else total[:-1]


def test_integer_delays_give_eq_17():
    points = np.array([(*wall, *rest) for wall in WALLS for rest in itertools.product(DAMPINGS, INTEGER_DELAYS)])
    got = zwidth.char_poly(*points.T)
    assert got.shape == (len(points), 4 + max(INTEGER_DELAYS))
    for row, (alpha, beta, delta, d) in zip(got, points, strict=True):
        with mp.workdps(oracles.digits_for(delta)):
            printed = oracles.paper_polynomial(alpha, beta, delta, int(d))
            exact = [coefficient / -(mpf(delta) ** 2) for coefficient in printed]
            assert not row[: -len(exact)].any()
            assert_coefficients_agree(row[-len(exact) :], exact, sum_magnitudes(alpha, beta, delta, d))


def test_fractional_delays_give_the_zero_order_hold_polynomial():
    points = np.array(
        [(*wall, *rest) for wall in WALLS for rest in itertools.product([0.0, *DAMPINGS], FRACTIONAL_DELAYS)]
    )
    got = zwidth.char_poly(*points.T)
    for row, (alpha, beta, delta, d) in zip(got, points, strict=True):
        with mp.workdps(oracles.digits_for(delta) + 20):
            exact = oracles.polynomial(alpha, beta, delta, d)
            assert len(exact) == 5 + int(d)
            sizes = sum_magnitudes(alpha, beta, delta, d)
            # e^(-delta (1 - f)) in the last coefficients amplifies the rounding error of its exponent.
            sizes = [size * (1 + min(mpf(delta), 700)) if k >= len(exact) - 2 else size for k, size in enumerate(sizes)]
            assert_coefficients_agree(row[-len(exact) :], exact, sizes)


def test_undamped_polynomial_is_the_loop_of_eq_13():
    got = zwidth.char_poly(0.3, 0.2, 0.0, np.array([0, 1, 2]))
    for row, d in zip(got, (0, 1, 2), strict=True):
        # z^(1+d) (z - 1)^2 + (z + 1)/2 (alpha z + beta (z - 1))
        expected = np.polyadd(np.r_[1, -2, 1, np.zeros(d + 1)], np.polymul([0.5, 0.5], [0.5, -0.2]))
        np.testing.assert_allclose(row[-len(expected) :], expected, atol=tol.COEFFICIENT.float64)


def test_delay_of_500_periods():
    got = zwidth.char_poly(1e-6, 1e-3, 0.1, 500)
    assert got.shape == (504,)
    with mp.workdps(oracles.DIGITS):
        exact = oracles.polynomial(1e-6, 1e-3, 0.1, 500)
        assert_coefficients_agree(got, exact, sum_magnitudes(1e-6, 1e-3, 0.1, 500))


def test_affine_parts_add_up_to_the_polynomial(x64):
    for d in (0.0, 3.0, 2.25):
        parts = expand_polynomial(jax.numpy.float64(0.7), jax.numpy.float64(d), find_degree(d))
        with mp.workdps(oracles.DIGITS):
            free = oracles.polynomial(0, 0, 0.7, d)
            spring = [left - right for left, right in zip(oracles.polynomial(1, 0, 0.7, d), free, strict=True)]
            damper = [left - right for left, right in zip(oracles.polynomial(0, 1, 0.7, d), free, strict=True)]
            for got, exact in zip(parts, (free, spring, damper), strict=True):
                assert oracles.worst(got, exact, floor=0.01) <= 10 * tol.COEFFICIENT.float64


def test_mixed_delays_have_leading_zeros():
    singles = [zwidth.char_poly(0.5, 0.4, 0.3, d) for d in (0, 2, 0.5)]
    together = zwidth.char_poly(0.5, 0.4, 0.3, np.array([0, 2, 0.5]))
    for row, single in zip(together, singles, strict=True):
        assert not row[: 6 - single.size].any()
        np.testing.assert_array_equal(row[6 - single.size :], single)


PHYSICAL = [(0.1, 10.0, 1e-3, 10e3, 40.0), (0.1, 100.0, 1e-3, 60e3, -20.0), (2.0, 1e-6, 5e-4, 1e4, 300.0)]


def characteristic_polynomial_si(mass, damping, period, stiffness, virtual_damping, delay):
    """Return the characteristic polynomial of a loop given in SI units."""
    device = {"mass": mass, "damping": damping, "period": period, "delay": delay}
    return zwidth.char_poly(*zwidth.normalize(**device, stiffness=stiffness, virtual_damping=virtual_damping))


@pytest.mark.parametrize("d", [0, 1, 3])
@pytest.mark.parametrize("scene", PHYSICAL)
def test_si_polynomial_is_eq_11_over_its_leading_coefficient(scene, d):
    mass, damping, period, stiffness, virtual_damping = scene
    got = characteristic_polynomial_si(*scene, delay=d * period)
    with mp.workdps(80):
        printed = oracles.paper_polynomial_si(*scene, d=d)
        exact = [coefficient / (-mpf(period) * mpf(damping) ** 2) for coefficient in printed]
        delta = mpf(damping) * mpf(period) / mpf(mass)
        alpha = mpf(stiffness) * mpf(period) ** 2 / mpf(mass)
        beta = mpf(virtual_damping) * mpf(period) / mpf(mass)
        # alpha, beta and delta are rounded before the coefficients are computed.
        sizes = [2 * size for size in sum_magnitudes(alpha, beta, delta, d)]
        assert_coefficients_agree(got, exact, sizes)


@pytest.mark.parametrize("d", [0, 1, 3])
@pytest.mark.parametrize("scene", PHYSICAL)
def test_closed_loop_numerator_is_eq_10(scene, d):
    mass, damping, period, *_ = scene
    plant = discretize_mass(np.float64(damping * period / mass))
    got = period * period / mass * np.array([plant.a2, plant.a1])
    with mp.workdps(80):
        m, b, T = mpf(mass), mpf(damping), mpf(period)
        c = mp.exp(-T * b / m)
        # ((-T b + m (1 - c)) z + (T b c - m (1 - c))) T z^(1+d), over -T b^2
        numerator = [(-T * b + m * (1 - c)) * T, (T * b * c - m * (1 - c)) * T]
        assert oracles.worst(got, [coefficient / (-T * b**2) for coefficient in numerator]) <= tol.TRANSFER.float64


def test_undamped_polynomial_is_exact():
    # z^2 (z - 1)^2 + (z + 1)/2 (z/2 + (z - 1)/2), exact in binary
    np.testing.assert_array_equal(
        characteristic_polynomial_si(0.5, 0.0, 1.0, 0.25, 0.25, 1.0), [1, -2, 1.5, 0.25, -0.25]
    )
