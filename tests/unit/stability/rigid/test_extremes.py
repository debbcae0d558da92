"""Accuracy of every method at extremes of the parameters, judged by certified verdicts."""

import numpy as np
import pytest
from bounds import bound_radius

import zwidth
from methods import extremes
from zwidth.core.status import Status

# Largest relative distance from the boundary at which each method may return a wrong label.
LARGEST_ERROR = {
    "crossover": 1e-15,
    # At nearly multiple poles, eigenvalues have half of their digits, and a quarter at delta = 1e12.
    "companion": 1e-2,
}
DELAYS = [0.0, float(np.nextafter(1.0, 0.0)), 1.0, 50.0, 500.0, 1e5]


@pytest.mark.parametrize("d", DELAYS, ids=str)
def test_every_method_is_right_outside_its_error_band(d, monkeypatch):
    if d >= 50:
        # The companion matrices of long delays are slow and exercise nothing new.
        monkeypatch.setattr(extremes, "METHODS", ["crossover"])
    outcomes = list(extremes.judge(d))
    assert {outcome.points >= 60 for outcome in outcomes} == {True}
    for outcome in outcomes:
        if outcome.method == "crossover" and np.isnan(outcome.farthest):
            pytest.fail(f"{outcome}: beside the start and for soft walls the closed form is exact")
        # Near the start of the boundary and for soft walls, a rounding error of the coefficients exceeds the distance.
        assert np.isnan(outcome.farthest) or outcome.farthest <= LARGEST_ERROR[outcome.method], outcome


@pytest.mark.parametrize("d", [np.float64(np.inf), np.float64(np.nan), np.float64(-np.inf), np.inf])
def test_non_finite_delay_has_a_status_and_no_warning(d):
    # NumPy warns when it computes the remainder of infinity by 1.
    assert not zwidth.is_stable(0.1, 0.4, 0.1, d)
    assert zwidth.alpha_max(0.1, d).status == Status.INVALID_INPUT


def test_softer_walls_at_the_beta_of_a_corner_are_stable():
    """At the corner the lobe meets the line of z = -1 (y = 1 up to rounding errors), and both limit the row."""
    random = np.random.default_rng(5)
    delta, d = 10 ** random.uniform(-3, 3, 6000), np.append(random.uniform(0, 1, 5990), np.zeros(10))
    top = zwidth.alpha_max(delta, d)
    corner = np.flatnonzero(top.kind == zwidth.RidgeKind.CORNER)
    assert corner.size > 400
    alpha, beta, delta, d = top.alpha[corner], top.beta[corner], delta[corner], d[corner]
    for ratio in (1e-9, 0.5, 1.0 - 1e-9):
        assert zwidth.is_stable(ratio * alpha, beta, delta, d).all()
        assert zwidth.decide_stability(ratio * alpha, beta, delta, d, method="certified").stable.all()
    assert not zwidth.is_stable((1.0 + 1e-9) * alpha, beta, delta, d).any()


def test_wall_with_gain_above_one_at_every_frequency_is_unstable():
    """Far above ``|L(-1)| = 1`` the formulas of the row contain only rounding errors."""
    random = np.random.default_rng(0)
    delta, d = 10 ** random.uniform(-15, -6, 20000), 10 ** random.uniform(-15, -8, 20000)
    d[::2] = 1.0 - d[::2]
    alpha = zwidth.alpha_max(delta, d).alpha * 10 ** random.uniform(10, 50, delta.shape)
    assert not zwidth.is_stable(alpha, alpha * random.uniform(-1.0, 2.0, delta.shape), delta, d).any()
    assert not zwidth.is_stable(99.57297700720724, 2.978195961433618e17, 8.23821423969356e-09, 0.9999999998914924)


@pytest.mark.parametrize("method", ["crossover", "companion", "certified"])
def test_invalid_points_do_not_affect_valid_ones(method):
    bad = [np.nan, np.inf, -np.inf]
    alpha = np.array([0.1, *bad, 0.1, 0.1, 0.1, 0.1, 0.1])
    delta = np.array([0.1, 0.1, 0.1, 0.1, *bad, -1.0, 0.1])
    result = zwidth.decide_stability(alpha, 0.3, delta, 1.0, method=method)
    assert result.status.tolist() == [0, *[Status.INVALID_INPUT] * 7, 0]
    assert result.stable.tolist() == [True, *[False] * 7, True]
    for d in (np.nan, np.inf, -1.0):
        assert zwidth.decide_stability(0.1, 0.3, 0.1, d, method=method).status == Status.INVALID_INPUT


@pytest.mark.parametrize("delta", extremes.DELTAS, ids=str)
def test_radius_of_a_very_soft_and_a_very_stiff_wall(delta):
    walls = (np.array([1e-30, 1e3 * (1 + delta)]), 0.1 * (1 + delta), delta, 0.0)
    result = bound_radius(*walls)
    assert (result.status == Status.OK).all()
    # The dominant pole of the soft wall is 1 up to rounding, that of the stiff wall far outside the unit circle.
    assert result.radius[0] == pytest.approx(1.0, abs=1e-8)
    assert result.radius[1] > 1
    exact = zwidth.spectral_radius(*walls, method="companion")
    np.testing.assert_allclose(result.radius, exact, rtol=1e-7)


def test_report_lists_every_method_and_delay():
    text = extremes.report((0.0,))
    assert text.count("## ") == text.count(f"| d | {' | '.join(extremes.METHODS)} |") == 4
    assert text.count("\n| 0 | ") == 4
    assert "delta = 0, 5e-324, 1e-300," in text
