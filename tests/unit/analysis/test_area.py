"""Test `stable_area` and `passive_area`.

References: polygons of the boundary, quadrature in mpmath, and Colgate's passivity condition.
"""

import jax
import mpmath as mp
import numpy as np
import pytest
from compiling import compile_bends
from mpmath import mpf

import oracles
import zwidth
from zwidth import passive_area, stable_area
from zwidth.stability.rigid.boundary import Piece

# Undamped; z = -1 line before and after the corner becomes the ridge; delayed; fractional delays (zero-order hold).
POINTS = [(0.0, 0.0), (0.5, 0.0), (3.0, 0.0), (10.0, 0.0), (0.1, 1.0), (1.0, 4.0), (40.0, 0.125), (2.0, 0.6)]


def test_stable_area_matches_polygon_of_boundary():
    delta, d = np.array(POINTS).T
    regions = [zwidth.stable_region(*point, points=1200) for point in POINTS]
    # A polygon of 1200 chords misses about 1e-5 of the area, and samples the z = -1 line only coarsely.
    np.testing.assert_allclose(stable_area(delta, d), [region.area for region in regions], rtol=5e-5)


def test_stable_area_without_damping_and_delay_closed_form():
    # The integral of alpha = 2 beta (2 - beta)/(2 + beta) is 2 (4 beta - beta^2/2 - 8 ln(2 + beta)), from beta = 0 to
    # 2.
    assert stable_area(np.array([0.0]), 0.0)[0] == pytest.approx(2.0 * (6.0 - 8.0 * np.log(2.0)), rel=1e-13)


@pytest.mark.parametrize("delta, d", [*POINTS, (0.01, 0.97), (1e4, 2.3), (1e-3, 30.0)])
def test_stable_area_matches_mpmath_quadrature(delta, d):
    with mp.workdps(40 + oracles.digits_for(delta)):
        region = zwidth.stable_region(delta, d, points=8)
        # The last point of the curve, before the line to alpha = 0.
        ends_at_nyquist = region.piece[-1] == Piece.MINUS_ONE
        end, corner, h = mp.pi, mpf(0), mpf(10) ** -20
        if ends_at_nyquist:
            corner = oracles.boundary(mp.pi - mpf(10) ** -18, delta, d)[0] ** 2 / 4
        else:
            near = mpf(float(region.omega[-1]))
            end = mp.findroot(lambda w: oracles.boundary(w, delta, d)[0], (near, near * (1 - mpf(10) ** -9)))

        def height(omega):
            before, after = (oracles.boundary(omega * (1 + sign * h), delta, d)[1] for sign in (-1, 1))
            return oracles.boundary(omega, delta, d)[0] * (after - before) / (2 * h * omega)

        # The integrand is smooth: 24 nodes per interval give 28 digits; tanh-sinh needs seven times as many.
        ends = mp.linspace(end * mpf(10) ** -12, end * (1 - mpf(10) ** -15), 4)
        exact = mp.quad(height, ends, maxdegree=4, method="gauss-legendre") + corner
        assert oracles.relative_error(stable_area(delta, d), exact) < 1e-12


def test_passive_area_without_delay_is_a_triangle():
    np.testing.assert_allclose(passive_area(np.array([0.0, 0.5, 3.0]), 0), [0.0, 0.5, 18.0], rtol=1e-12)


def test_passive_area_lies_between_inscribed_polygon_and_its_error_bound():
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 40_001)
    for d in (0.03, 0.15, 0.4, 0.5, 1.0, 1.7, 20.0):
        needed = 1.0 - zwidth.passivity_margin(np.abs(np.cos(angle)), np.sin(angle), 1.0, d)
        x, y = np.cos(angle) / needed, np.sin(angle) / needed
        inner = 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])
        # The area of a convex set exceeds that of the inscribed polygon; with 40,000 chords by less than 1e-7.
        assert inner <= passive_area(1.0, d) < inner * (1 + 1e-7)


def test_passive_area_is_smaller_than_stable_area():
    delta, d = np.array(POINTS).T
    assert np.all(passive_area(delta, d) < stable_area(delta, d))


def test_second_derivatives_of_stable_area_match_differences(x64):
    # Lobes that end at alpha = 0 and at a corner, for d < 1 and d > 1; no integer delays, where the area has kinks.
    points, step = (
        np.array([(0.0, 0.2), (0.3, 0.5), (3.0, 0.9), (40.0, 0.2), (0.1, 1.3), (20.0, 2.6), (2.0, 50.25)]),
        1e-5,
    )
    differentiate = compile_bends(jax.grad(lambda point: stable_area(*point)))
    _, hessians = differentiate(points)
    for k, side in enumerate(np.eye(2)):
        up, down = points + step * side, np.maximum(points - step * side, 0.0)
        change = (differentiate(up)[0] - differentiate(down)[0]) / (up - down)[:, k : k + 1]
        # At delta = 0 the difference is one-sided.
        np.testing.assert_allclose(hessians[..., k], change, rtol=1e-4, atol=1e-6)
