"""The factors and expansions of the characteristic polynomial, against its coefficients (`zwidth.char_poly`)."""

import numpy as np
import pytest

import zwidth
from zwidth.core.xp import horner
from zwidth.plant.rigid_mass import discretize_plant
from zwidth.stability.rigid.characteristic_polynomial import (
    bound_wall_part,
    differentiate_open_loop,
    evaluate_at_nyquist,
    evaluate_factors,
    evaluate_on_unit_circle,
    expand_at_one,
    expand_gain_difference,
    expand_gain_difference_at_nyquist,
    expand_on_circle,
    expand_taylor,
    expand_wall,
    factor_loop,
    recover_wall,
)

WALLS = [(0.3, 0.4, 0.1, 0.0), (0.2, -0.1, 2.0, 3.0), (0.7, 1.3, 0.0, 0.25), (0.1, 0.2, 5.0, 2.6)]
POINTS = np.array([0.7 + 0.4j, -0.9 + 0.1j, 1.2 - 0.3j, 1.0 + 1e-9j, -1.0, 0.05j])


def make_loop(wall):
    fractional = wall[3] % 1 != 0
    columns = (np.full(POINTS.shape, value) for value in wall)
    return factor_loop(*columns, fractional=fractional), fractional


@pytest.mark.parametrize("wall", WALLS)
def test_factors_and_their_derivatives_match_the_coefficients(wall):
    loop, fractional = make_loop(wall)
    A, dA, N, dN, ddN, W = evaluate_factors(POINTS, POINTS - 1, loop, fractional)
    p, s = loop.n_plus_1 + fractional, loop.s
    coefficients = zwidth.char_poly(*wall)
    value = POINTS**p * A + N * W
    slope = POINTS ** (p - 1) * (p * A + POINTS * dA) + dN * W + N * s
    curvature = POINTS ** (p - 2) * (p * (p - 1) * A + 2 * p * POINTS * dA + 2 * POINTS**2) + ddN * W + 2 * dN * s
    for order, got in enumerate((value, slope, curvature)):
        np.testing.assert_allclose(got, np.polyval(np.polyder(coefficients, order), POINTS), rtol=1e-12, atol=1e-13)
    assert np.all(np.abs(N * W) <= bound_wall_part(np.abs(POINTS), np.abs(POINTS - 1), loop, fractional) * (1 + 1e-12))


@pytest.mark.parametrize("wall", WALLS)
def test_expansions_match_the_coefficients(wall):
    loop, fractional = make_loop(wall)
    z0, z0_minus_1 = POINTS, POINTS - 1
    series = expand_taylor(z0_minus_1, z0 ** (loop.n_plus_1 - 1), loop, fractional, 20)
    u = 0.003
    z = z0 * (1 + u)
    _, _, N, _, _, _ = evaluate_factors(z, z - 1, loop, fractional)
    # N is z M for fractional delays, and then the polynomial is z P.
    expected = -np.polyval(zwidth.char_poly(*wall), z) / (z * N)
    np.testing.assert_allclose(horner(u, list(series.terms)), expected, rtol=1e-11)
    # The first neglected term is of third order in x = z - 1.
    x = 1e-4
    quotient = np.polyval(zwidth.char_poly(*wall), 1 + x) / (1 + x) ** (loop.n_plus_1[0] + fractional)
    assert abs(horner(x, expand_at_one(loop))[0] - quotient) < 1e3 * x**3


@pytest.mark.parametrize("wall", WALLS)
def test_squared_moduli_on_circles(wall):
    loop, _ = make_loop(wall)
    r, w = 0.8, 1.1
    z = r * np.exp(1j * w)
    factors = expand_on_circle(r, r - 1, loop)
    values = (z - 1, z - loop.c, loop.alpha * z + loop.beta * (z - 1), loop.a2 * z + loop.h, 1 + loop.q / z)
    for (value, slope), expected in zip(factors, values, strict=True):
        np.testing.assert_allclose(value**2 + slope * np.sin(w / 2) ** 2, np.abs(expected) ** 2, rtol=1e-13)


@pytest.mark.parametrize("wall", WALLS)
def test_open_loop_and_gain_difference_on_the_unit_circle(wall):
    alpha, beta, delta, d = (np.float64(value) for value in wall)
    plant = discretize_plant(delta, d)
    w, h = 0.9, 1e-4

    def evaluate_loop(w):
        z = np.exp(1j * w)
        M = plant.a2 * z + plant.a1 + plant.a0 / z
        T, B = z ** (plant.whole + 1) * (z - 1) * (z - plant.c), M * (alpha * z + beta * (z - 1))
        return B / T, np.abs(B) ** 2 - np.abs(T) ** 2

    loop, slope = differentiate_open_loop(w, alpha, beta, plant)
    before, after = (np.log(evaluate_loop(x)[0]) for x in (w - h, w + h))
    np.testing.assert_allclose(loop, evaluate_loop(w)[0], rtol=1e-13)
    np.testing.assert_allclose(slope / loop, (after - before) / (2 * h), rtol=1e-6)
    assert evaluate_on_unit_circle(w, alpha, beta, plant).abs2_Z == pytest.approx(abs(np.exp(1j * w) - plant.c) ** 2)
    difference = evaluate_loop(w)[1]
    assert horner(1 - np.cos(w), expand_gain_difference(alpha, beta, plant)) == pytest.approx(difference, rel=1e-12)
    in_v = expand_gain_difference_at_nyquist(alpha, beta, plant)
    assert horner(1 + np.cos(w), in_v) == pytest.approx(-difference, rel=1e-12)
    wall_part, device = evaluate_at_nyquist(alpha, beta, plant)
    # For fractional delays, the coefficients are those of z P.
    value = wall_part + (-1) ** (plant.whole + 1) * device
    assert np.polyval(zwidth.char_poly(*wall), -1) == pytest.approx(value if d % 1 == 0 else -value, rel=1e-12)


def test_wall_factor_is_linear_and_invertible():
    first, second = expand_wall(0.3, 0.4), expand_wall(0.1, -0.7)
    np.testing.assert_allclose(np.add(first, second), expand_wall(0.4, -0.3), rtol=1e-15)
    assert recover_wall(*first[:2]) == (0.3, 0.4)
    assert first.s == pytest.approx(first.alpha + first.beta)
