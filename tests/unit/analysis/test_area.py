"""Areas against the outlined region, quadrature in mpmath, and Colgate's triangle."""

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

# Undamped; cut by the line of z = -1 before and after the corner becomes the ridge; delayed; held.
POINTS = [(0.0, 0.0), (0.5, 0.0), (3.0, 0.0), (10.0, 0.0), (0.1, 1.0), (1.0, 4.0), (40.0, 0.125), (2.0, 0.6)]


def test_the_area_is_that_of_the_outline():
    delta, d = np.array(POINTS).T
    outlines = [zwidth.stable_region(*point, points=1200) for point in POINTS]
    # A chord polygon of 1200 points misses about 1e-5 of the area, and touches the line only to its sampling.
    np.testing.assert_allclose(stable_area(delta, d), [outline.area for outline in outlines], rtol=5e-5)


def test_the_undamped_area_without_delay_has_a_closed_form():
    # alpha = 2 beta (2 - beta)/(2 + beta) from beta = 0 to 2: 2 (4 beta - beta^2/2 - 8 ln(2 + beta)) between them.
    assert stable_area(np.array([0.0]), 0.0)[0] == pytest.approx(2.0 * (6.0 - 8.0 * np.log(2.0)), rel=1e-13)


@pytest.mark.parametrize("delta, d", [*POINTS, (0.01, 0.97), (1e4, 2.3), (1e-3, 30.0)])
def test_the_area_by_quadrature_in_mpmath(delta, d):
    with mp.workdps(40 + oracles.digits_for(delta)):
        region = zwidth.stable_region(delta, d, points=8)
        # The last point of the curve, in front of the line to alpha = 0.
        rises = region.piece[-1] == Piece.MINUS_ONE
        end, corner, h = mp.pi, mpf(0), mpf(10) ** -20
        if rises:
            corner = oracles.boundary(mp.pi - mpf(10) ** -18, delta, d)[0] ** 2 / 4
        else:
            near = mpf(float(region.omega[-1]))
            end = mp.findroot(lambda w: oracles.boundary(w, delta, d)[0], (near, near * (1 - mpf(10) ** -9)))

        def height(omega):
            before, after = (oracles.boundary(omega * (1 + sign * h), delta, d)[1] for sign in (-1, 1))
            return oracles.boundary(omega, delta, d)[0] * (after - before) / (2 * h * omega)

        # Smooth: these 24 nodes a piece are right to 28 digits, which tanh-sinh takes seven times as many for.
        ends = mp.linspace(end * mpf(10) ** -12, end * (1 - mpf(10) ** -15), 4)
        exact = mp.quad(height, ends, maxdegree=4, method="gauss-legendre") + corner
        assert oracles.relative_error(stable_area(delta, d), exact) < 1e-12


def test_the_passive_set_without_delay_is_a_triangle():
    np.testing.assert_allclose(passive_area(np.array([0.0, 0.5, 3.0]), 0), [0.0, 0.5, 18.0], rtol=1e-12)


def test_the_passive_area_lies_between_two_polygons():
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 40_001)
    for d in (0.03, 0.15, 0.4, 0.5, 1.0, 1.7, 20.0):
        needed = 1.0 - zwidth.passivity_margin(np.abs(np.cos(angle)), np.sin(angle), 1.0, d)
        x, y = np.cos(angle) / needed, np.sin(angle) / needed
        inner = 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])
        # A convex set exceeds its chords; of 40,000 of them by less than 1e-7 of the area.
        assert inner <= passive_area(1.0, d) < inner * (1 + 1e-7)


def test_passive_walls_are_fewer_than_stable_ones():
    delta, d = np.array(POINTS).T
    assert np.all(passive_area(delta, d) < stable_area(delta, d))


def test_second_derivatives_of_the_stable_area(x64):
    # Ends at alpha = 0 and at a corner, below one period and beyond; not at whole delays, which have kinks.
    points, step = (
        np.array([(0.0, 0.2), (0.3, 0.5), (3.0, 0.9), (40.0, 0.2), (0.1, 1.3), (20.0, 2.6), (2.0, 50.25)]),
        1e-5,
    )
    differentiate = compile_bends(jax.grad(lambda point: stable_area(*point)))
    _, bends = differentiate(points)
    for k, side in enumerate(np.eye(2)):
        up, down = points + step * side, np.maximum(points - step * side, 0.0)
        change = (differentiate(up)[0] - differentiate(down)[0]) / (up - down)[:, k : k + 1]
        # At delta = 0 the difference is to one side.
        np.testing.assert_allclose(bends[..., k], change, rtol=1e-4, atol=1e-6)
