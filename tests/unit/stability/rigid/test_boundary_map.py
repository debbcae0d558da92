"""Stability grids from the closed-form boundary: every array layout must yield the labels of the direct comparison
alpha < limit(beta).
"""

import numpy as np
import pytest

from zwidth.plant.rigid_mass import discretize_plant
from zwidth.stability.rigid import stiffness_limit as stiffness_limit
from zwidth.stability.rigid.stiffness_limit import build_long_lobe, find_limit_long_delay, row_limits
from zwidth.stability.rigid.verdict import is_stable

ROWS, COLUMNS = 331, 400
LIMITS = np.concatenate([np.linspace(-0.1, 1.1, ROWS - 5), [np.nan, np.inf, -np.inf, 0.0, 0.25]])[:, None]


def ascending():
    return np.linspace(-0.2, 1.2, COLUMNS)


def with_repeats():
    return np.sort(np.round(np.linspace(-0.2, 1.2, COLUMNS), 2))


def without_positive():
    return np.linspace(-2.0, 0.0, COLUMNS)


def with_infinities():
    return np.concatenate([[-np.inf, -0.0, 0.0, 5e-324], np.linspace(0.1, 1.0, COLUMNS - 5), [np.inf]])


def descending():
    return ascending()[::-1]


def shuffled_with_nan():
    values = np.random.default_rng(3).permutation(ascending())
    values[[5, 80]] = np.nan
    return values


ALPHAS = (ascending, with_repeats, without_positive, with_infinities, descending, shuffled_with_nan)


@pytest.mark.parametrize("make", ALPHAS)
@pytest.mark.parametrize("layout", ["alpha along the last axis", "alpha along the first axis", "stacked"])
def test_every_layout_equals_the_direct_comparison(make, layout):
    alpha, limit = make()[None, :], LIMITS
    if layout == "alpha along the first axis":
        alpha, limit = alpha.T, limit.T
    if layout == "stacked":
        limit = np.stack([limit, 0.5 * limit])
        alpha = alpha[None]
    expected = (alpha > 0) & (alpha < limit)
    assert expected.size >= stiffness_limit.MIN_PATTERN_SIZE
    got = stiffness_limit._compare_with_limits(alpha, limit)
    assert got.dtype == bool
    np.testing.assert_array_equal(got, expected)


def test_few_long_rows_and_shuffled_alpha():
    alpha = np.linspace(0.0, 1.0, 70_001)[None, :]
    for rows in (3, 9):
        limit = np.linspace(0.2, 0.9, rows)[:, None]
        np.testing.assert_array_equal(stiffness_limit._compare_with_limits(alpha, limit), (alpha > 0) & (alpha < limit))
    mixed = np.random.default_rng(4).permutation(alpha[0])[None, :]
    np.testing.assert_array_equal(stiffness_limit._compare_with_limits(mixed, limit), (mixed > 0) & (mixed < limit))


@pytest.mark.parametrize("d", [0.0, 0.5, 1.0, 4.3, 50.0])
def test_grid_and_point_list_agree(d):
    alpha, beta = np.linspace(-0.01, 0.9, 301)[None, :], np.linspace(-0.3, 1.1, 303)[:, None]
    stable = is_stable(alpha, beta, 0.2, d)
    # Two raveled arrays are not recognized as a grid: every point is evaluated as a row of its own.
    points = [np.ravel(part) for part in np.broadcast_arrays(alpha, beta)]
    np.testing.assert_array_equal(stable.ravel(), is_stable(*points, delta=0.2, d=d))
    assert 0 < stable.sum() < stable.size


@pytest.mark.parametrize("d", [1.0, 2.5, 8.0, 60.0, 500.0])
@pytest.mark.parametrize("delta", [0.0, 1e-8, 0.3, 4.0, 1e3, 1e6])
def test_row_limits_are_converged_to_rounding_error(d, delta, monkeypatch):
    fields = build_long_lobe(discretize_plant(np.float64(delta), np.float64(d)))
    beta = np.linspace(0.0, 0.999, 500)[1:] * fields.end_b - delta
    limit = row_limits(beta, np.array([delta]), np.array([d]))
    monkeypatch.setattr("zwidth.stability.rigid.stiffness_limit.ROW_STEPS", 6)
    refined = find_limit_long_delay(beta, fields)[0]
    # beta is accurate to one ulp of delta only, which near the end of the lobe is a larger relative error of the limit.
    np.testing.assert_allclose(limit, refined, rtol=1e-13, atol=2e-13 * refined.max())


def test_numpy_and_jax_routes_give_equal_row_limits():
    random = np.random.default_rng(4)
    delta, d = 10.0 ** random.uniform(-8, 6, 400), random.uniform(0, 6, 400)
    d[::2] = np.floor(d[::2])
    beta = random.uniform(-1, 1, 400) * (delta + 1.0)
    few, many = (row_limits(beta, delta, d, route=route) for route in ("numpy", "jax"))
    assert 100 < np.sum(few > 0) < 400
    np.testing.assert_allclose(many, few, rtol=1e-12, atol=1e-13 * np.nanmax(few))
