"""Areas against the outlined region, a Monte Carlo count of poles, and Colgate's triangle."""

import jax
import numpy as np
import pytest

import zwidth
from zwidth.design import passive_area, stable_area
from zwidth.design.area import adaptive_integral
from zwidth.stability.poles import unstable_poles

# Undamped; cut by the line of z = -1 before and after the corner becomes the ridge; delayed; held.
POINTS = [(0.0, 0.0), (0.5, 0.0), (3.0, 0.0), (10.0, 0.0), (0.1, 1.0), (1.0, 4.0), (40.0, 0.125), (2.0, 0.6)]


def test_the_area_is_that_of_the_outline():
    delta, d = np.array(POINTS).T
    outlines = [zwidth.stable_region(*point, points=1200) for point in POINTS]
    assert all(outline.verified for outline in outlines)
    # A chord polygon of 1200 points misses about 1e-5 of the area, and touches the line only to its sampling.
    np.testing.assert_allclose(stable_area(delta, d), [outline.area for outline in outlines], rtol=5e-5)


def test_the_undamped_area_without_delay_has_a_closed_form():
    # alpha = 2 beta (2 - beta)/(2 + beta) from beta = 0 to 2: 2 (4 beta - beta^2/2 - 8 ln(2 + beta)) between them.
    assert stable_area(np.array([0.0]), 0.0)[0] == pytest.approx(2.0 * (6.0 - 8.0 * np.log(2.0)), rel=1e-13)


@pytest.mark.parametrize("delta, d", [(3.0, 0.0), (0.5, 1.0)])
def test_the_area_is_the_share_of_stable_walls(delta, d):
    outline = zwidth.stable_region(delta, d)
    random = np.random.default_rng(7)
    low, high = outline.beta.min(), outline.beta.max()
    alpha, beta = random.uniform(0, outline.alpha.max(), 20_000), random.uniform(low, high, 20_000)
    share = np.mean(np.asarray(unstable_poles(alpha, beta, delta, d)) == 0)
    box = outline.alpha.max() * (high - low)
    # Four standard deviations of the count.
    assert abs(share - stable_area(np.array([delta]), d)[0] / box) < 4 * np.sqrt(share * (1 - share) / 20_000)


def test_the_slope_of_the_area(x64):
    step = 1e-5
    delta = np.array([1.0 - step, 1.0 + step])
    area = stable_area(delta, 1.3)
    slope = jax.jit(jax.grad(stable_area), compiler_options={"xla_disable_hlo_passes": "fusion"})
    assert float(slope(1.0, 1.3)) == pytest.approx((area[1] - area[0]) / (2 * step), rel=1e-8)


def test_the_passive_set_without_delay_is_a_triangle():
    np.testing.assert_allclose(passive_area(np.array([0.0, 0.5, 3.0]), 0), [0.0, 0.5, 18.0], rtol=1e-12)


def test_the_passive_area_lies_between_two_polygons():
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 4001)
    for d in (1.0, 0.5):
        needed = 1.0 - zwidth.passivity_margin(np.abs(np.cos(angle)), np.sin(angle), 1.0, d)
        x, y = np.cos(angle) / needed, np.sin(angle) / needed
        inner = 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])
        # A convex set exceeds its chords; of 4,000 of them by less than 1e-6 of the area.
        assert inner <= passive_area(1.0, d) < inner * (1 + 1e-6)


def test_passive_walls_are_fewer_than_stable_ones():
    delta, d = np.array(POINTS).T
    assert np.all(passive_area(delta, d) < stable_area(delta, d))


def test_bad_points_are_nan():
    assert np.isnan(stable_area(np.array([-1.0, 1.0, np.inf]), 1.0)).tolist() == [True, False, True]
    assert np.isnan(passive_area(np.array([-1.0, 1.0]), np.array([0.0, np.nan]))).all()
    with pytest.raises(zwidth.TracedDelayError, match="d: got a traced value"):
        jax.jit(passive_area)(1.0, 1.0)


def test_the_quadrature_finds_kinks():
    assert adaptive_integral(lambda x: np.abs(x - 1 / 3), 0.0, 1.0) == pytest.approx(5 / 18, rel=1e-13)
