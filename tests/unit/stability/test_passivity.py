"""Passivity at any delay: eq. (21), the condition as printed scanned over frequency, and a linear program."""

import math

import jax
import numpy as np
import pytest
from scipy.optimize import linprog

import tolerances as tol
import zwidth
from zwidth.errors import InputError, TracedDelayError
from zwidth.stability.passivity import passive_stiffness_slope
from zwidth.stability.poles import radius_by_companion

RANDOM = np.random.default_rng(20)
DELAYS = [0.0, 1.0, 2.0, 4.0, 8.0, 0.05, 0.125, 0.5, 0.9, 1.3, 2.5]


def size(alpha, beta, delta, d):
    return np.abs(alpha) * (d + 1) + np.abs(beta) + delta


def test_no_delay_is_eq_21():
    alpha, beta, delta = RANDOM.uniform([0, -2, 0], [4, 2, 3], (500, 3)).T
    margin = zwidth.passivity_margin(alpha, beta, delta, 0)
    exact = delta - alpha / 2 - np.abs(beta)
    assert np.abs(margin - exact).max() <= tol.PASSIVITY.float64 * size(alpha, beta, delta, 0).max()
    clear = np.abs(exact) > 1e-9
    np.testing.assert_array_equal(zwidth.is_passive(alpha, beta, delta, 0)[clear], exact[clear] > 0)


def needed_by_scan(alpha, beta, d, frequencies=100_000):
    """The damping that the printed conditions ask for, at evenly spaced frequencies, in extended precision."""
    w = np.linspace(0, math.pi, frequencies + 1, dtype=np.longdouble)[1:]
    n = math.floor(d)
    f = np.longdouble(d) - n
    z = np.exp(1j * w)
    wall = alpha + beta * (1 - 1 / z)
    twice = 4 * np.sin(w / 2) ** 2  # 2 (1 - cos w)
    if f == 0:
        needed = np.real((1 - 1 / z) * wall * z**-n) / twice
    else:
        # 2 (1 - cos w) delta^2 + 2 delta Re{((1 - f) + f z) g} - f (1 - f) |g|^2 > 0
        g = np.conj(wall) * (z - 1) * z**n / 2
        half_b = np.real(((1 - f) + f * z) * g)
        needed = (np.sqrt(half_b**2 + twice * f * (1 - f) * np.abs(g) ** 2) - half_b) / twice
    return max(float(needed.max()), 0.0)


@pytest.mark.parametrize("d", DELAYS)
def test_any_delay_by_a_scan_of_frequencies(d):
    alpha, beta = RANDOM.uniform([0, -1], [1, 1], (8, 2)).T
    margin = zwidth.passivity_margin(alpha, beta, 2.0, d)
    scanned = 2.0 - np.array([needed_by_scan(a, b, d) for a, b in zip(alpha, beta, strict=True)])
    allowed = tol.PASSIVITY_SCAN.float64 * size(alpha, beta, 2.0, d)
    assert (np.abs(margin - scanned) <= allowed).all()
    # A scan can only miss the worst frequency.
    assert (margin <= scanned + tol.PASSIVITY.float64 * size(alpha, beta, 2.0, d)).all()


def test_hundreds_of_periods():
    margin = zwidth.passivity_margin(0.001, 0.1, 1.0, 500)
    # The worst frequency is 0, where the condition is delta > alpha (d + 1/2) - beta.
    assert margin == pytest.approx(1.0 - (0.001 * 500.5 - 0.1), abs=1e-13)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_held_delays_join_the_whole_ones(n):
    alpha, beta = RANDOM.uniform([0, -1], [1, 1], (6, 2)).T
    for near, whole in ((n + 1e-9, n), (n + 1 - 1e-9, n + 1)):
        difference = zwidth.passivity_margin(alpha, beta, 1.0, near) - zwidth.passivity_margin(alpha, beta, 1.0, whole)
        # The square root's slope: a change of f moves the bound by at most sqrt(f (1 - f)) |G|.
        assert np.abs(difference).max() <= 1e-4


@pytest.mark.parametrize("d", DELAYS)
def test_the_passive_set_is_convex_and_a_cone(d):
    one, two = RANDOM.uniform([0, -1, 0], [2, 1, 3], (2, 40, 3))
    first, second, middle = (zwidth.passivity_margin(*wall.T, d) for wall in (one, two, (one + two) / 2))
    allowed = tol.PASSIVITY.float64 * 10 * (d + 1)
    assert (middle >= (first + second) / 2 - allowed).all()
    np.testing.assert_allclose(zwidth.passivity_margin(*(3 * one).T, d), 3 * first, rtol=0, atol=3 * allowed)


@pytest.mark.parametrize("d, alpha, beta", [(12.0, 0.00788585704807089, 0.9951298014123421), (20.0, 0.00217, 0.999)])
def test_the_highest_of_many_equal_peaks(d, alpha, beta):
    # With hardly any spring all d + 1 peaks are about as high: the first one, between samples, is the highest.
    omega = np.linspace(0, 1.5 * np.pi / (d + 1), 400_001)[1:]
    needed = alpha * np.sin((d + 0.5) * omega) / (2 * np.sin(0.5 * omega)) - beta * np.cos((d + 1) * omega)
    assert zwidth.passivity_margin(alpha, beta, 1.0, d) == pytest.approx(1.0 - needed.max(), abs=1e-10)


@pytest.mark.parametrize("d, share", [(1, 0.42), (2, 0.62), (4, 0.77)])
def test_eq_21_is_wrong_for_delays(d, share):
    delta = RANDOM.uniform(0.05, 3.0, 4000)
    alpha, beta = RANDOM.uniform(0, 2, 4000) * delta, RANDOM.uniform(-1, 1, 4000) * delta
    called = delta > alpha / 2 + np.abs(beta)
    unstable = radius_by_companion(alpha, beta, delta, d) > 1 + tol.LABEL_BAND.float64
    assert np.mean(unstable[called]) == pytest.approx(share, abs=0.05)
    assert not zwidth.is_passive(alpha, beta, delta, d)[unstable].any()


def slope_by_linear_program(d, frequencies=20_000):
    """The largest alpha/delta for whole d: delta = 1 exceeds alpha D/2 - beta cos((d + 1) w) at every frequency."""
    w = np.linspace(0, math.pi, frequencies + 1)[1:]
    dirichlet = np.sin((d + 0.5) * w) / np.sin(w / 2)
    constraints = np.column_stack([dirichlet / 2, -np.cos((d + 1) * w)])
    limit = np.array([d + 0.5, -1.0])  # w -> 0
    solved = linprog([-1, 0], A_ub=np.vstack([constraints, limit]), b_ub=np.ones(frequencies + 1), bounds=(None, None))
    assert solved.success
    return solved.x


@pytest.mark.parametrize(
    "d, exact", [(0, 2.0), (1, 2 * math.sqrt(2) - 2), (2, 4 - 2 * math.sqrt(3)), (3, None), (5, None)]
)
def test_the_stiffest_passive_wall(d, exact):
    slope, beta = passive_stiffness_slope(d)
    expected = slope_by_linear_program(d)
    assert slope == pytest.approx(expected[0], rel=tol.PASSIVE_SLOPE_LP.float64)
    assert beta == pytest.approx(expected[1], abs=1e-3)
    if exact is not None:
        assert slope == pytest.approx(exact, rel=tol.PASSIVE_SLOPE.float64)


def test_the_stiffest_passive_wall_of_a_held_delay_is_on_the_edge():
    slope, beta = passive_stiffness_slope(0.5)
    alpha = slope * np.array([0.999, 1.001])
    needed = [needed_by_scan(a, beta, 0.5, frequencies=20_000) for a in alpha]
    assert needed[0] < 1 < needed[1]
    # No other damping reaches it.
    others = [needed_by_scan(1.01 * slope, b, 0.5, frequencies=2_000) for b in np.linspace(-1, 1, 41)]
    assert min(others) > 1


@pytest.mark.parametrize("d", [-1, np.nan, [1, 2]])
def test_the_stiffest_passive_wall_needs_one_delay(d):
    with pytest.raises(InputError, match=r"d: got .*; a single finite number of at least 0 is needed"):
        passive_stiffness_slope(d)


def test_a_negative_spring_is_never_passive():
    margin = zwidth.passivity_margin(-0.1, 0.0, 5.0, np.array([0, 1, 0.5]))
    np.testing.assert_array_equal(margin, [-0.1, -0.1, -0.1])
    # No wall at all needs no damping, but has none to spare either.
    assert zwidth.passivity_margin(0.0, 0.0, 0.0, 1) == 0
    assert not zwidth.is_passive(0.0, 0.0, 0.0, 1)
    assert zwidth.passivity_margin(-0.0, 0.0, 1.0, 1) == 1


def test_points_out_of_range():
    delays = np.array([0.0, 1.0, np.nan, -1.0, np.inf, 0.5])
    deltas = np.array([1.0, -1.0, 1.0, 1.0, 1.0, np.nan])
    margin = zwidth.passivity_margin(0.1, 0.1, deltas, delays)
    np.testing.assert_array_equal(np.isnan(margin), [False, True, True, True, True, True])
    assert margin[0] == zwidth.passivity_margin(0.1, 0.1, 1.0, np.array([0.0]))[0]
    np.testing.assert_array_equal(
        zwidth.is_passive(0.1, 0.1, deltas, delays), [True, False, False, False, False, False]
    )


@pytest.mark.parametrize("d", [0, 2.3])
def test_derivatives(d, x64):
    gradient = jax.jit(jax.vmap(jax.grad(lambda wall: zwidth.passivity_margin(*wall, d))))
    walls = np.array([(0.3, 0.2, 2.0), (0.3, -0.2, 2.0), (0.3, 0.2, -1.0)])
    got = np.asarray(gradient(walls))
    assert np.isnan(got[2]).all()
    h = 1e-6
    for k, step in enumerate(h * np.eye(3)):
        up, down = (zwidth.passivity_margin(*(walls[:2] + s * step).T, d) for s in (1, -1))
        np.testing.assert_allclose(got[:2, k], (up - down) / (2 * h), atol=1e-6)
    if d == 0:
        np.testing.assert_allclose(got[:2], [(-0.5, -1, 1), (-0.5, 1, 1)], atol=1e-9)


def test_a_traced_delay_is_refused():
    with pytest.raises(TracedDelayError, match="d: got a traced value, but the number of frequencies depends on it"):
        jax.jit(lambda d: zwidth.passivity_margin(0.1, 0.1, 1.0, d))(1.0)
