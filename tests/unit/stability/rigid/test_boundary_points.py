"""Boundary points at extremes of the domain, by every method, against verdicts of is_stable, mpmath and Optimistix."""

from functools import cache, partial
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
from zwidth.core.status import Status

COUNT = 10_000


@cache
def devices(count=COUNT, seed=5):
    """Return delta and d of random devices: integer, nearly integer and fractional delays; zero, weak, moderate and
    strong damping.
    """
    random = np.random.default_rng(seed)
    n = np.where(random.random(count) < 0.6, random.integers(0, 5, count), np.floor(10 ** random.uniform(0, 5, count)))
    near = random.choice([-1, 1], count) * 10 ** random.uniform(-12, -0.1, count) % 1
    f = np.choose(random.integers(0, 4, count), [0 * n, 0 * n, random.random(count), near])
    delta = np.choose(
        random.integers(0, 4, count),
        [0 * n, 10 ** random.uniform(-30, 12, count), 10 ** random.uniform(-4, 4, count), random.uniform(0, 10, count)],
    )
    return delta, np.minimum(n + f, 1e5)


def find_wrong_verdicts(stable, alpha, beta, use):
    """Return the indices of walls selected by ``use`` whose verdict is not ``stable``."""
    delta, d = devices()
    alpha, beta = (np.where(np.abs(part) < 1e-60, 0.0, part) for part in (alpha, beta))
    return np.flatnonzero(use & (np.asarray(zwidth.is_stable(alpha, beta, delta, d)) != stable))


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_points_on_lines_of_constant_alpha_separate_the_verdicts(side):
    delta, d = devices()
    random = np.random.default_rng(1)
    small_alpha = 10 ** random.uniform(-45, 0, COUNT)
    alpha = np.where(random.random(COUNT) < 0.5, small_alpha, 10 ** random.uniform(-1, 1, COUNT)) / (d + 1) ** 2
    points = zwidth.boundary_point(delta, d, alpha=alpha, side=side)
    has_point = points.status == Status.OK
    assert np.isin(points.status, [Status.OK, Status.NO_BOUNDARY]).all()
    assert 0.6 < has_point.mean() < 1
    # A relative step of 1e-9 in b, or the resolution of float64.
    step = np.maximum(1e-9 * np.abs(points.beta + delta), 16 * tol.EPS64 * np.maximum(delta, np.abs(points.beta)))
    step = step if side == "lower" else -step
    # Near the ridge beta is ill-conditioned: require a boundary point also at an alpha larger by 1e-6.
    well_conditioned = zwidth.boundary_point(delta, d, alpha=alpha * (1 + 1e-6)).status == Status.OK
    assert not find_wrong_verdicts(True, alpha, points.beta + step, has_point & well_conditioned).size
    assert not find_wrong_verdicts(False, alpha, points.beta - step, has_point).size
    # Without a boundary point, the wall at the beta of the ridge must be unstable at this alpha.
    assert not find_wrong_verdicts(False, alpha, zwidth.alpha_max(delta, d).beta, ~has_point).size


def test_points_on_lines_of_constant_beta_separate_the_verdicts():
    delta, d = devices()
    random = np.random.default_rng(2)
    ratio = np.where(random.random(COUNT) < 0.5, 10 ** random.uniform(-30, 0, COUNT), random.uniform(0, 4, COUNT))
    # The verdict loses digits closer to beta = -delta; test_soft_walls covers that range.
    b = np.maximum(ratio * (delta + 1 / (d + 1)), 1e-5 * delta)
    beta = np.where(b < 1e-60, 0.0, b - delta)
    points = zwidth.boundary_point(delta, d, beta=beta)
    has_point = points.status == Status.OK
    assert 0.5 < has_point.mean() < 1
    assert not find_wrong_verdicts(True, points.alpha * (1 - 1e-9), beta, has_point).size
    assert not find_wrong_verdicts(False, points.alpha * (1 + 1e-9), beta, has_point).size
    for alpha in (1e-9, 1e-3, 1.0):
        assert not find_wrong_verdicts(False, np.full(COUNT, alpha) / (d + 1) ** 2, beta, ~has_point).size


@pytest.mark.parametrize(
    "device, line, expected",
    [
        ((0.5, 1), {"alpha": 1e-17, "side": "upper"}, 1.240063540320605),
        ((0.5, 1), {"alpha": 1e-60, "side": "upper"}, 1.240063540320605),
        ((0.5, 1), {"alpha": 1e-60}, -0.5),
        # b = w^2 and alpha = 2 w^2 at the start of the undamped curve without delay.
        ((0.0, 0), {"beta": 1e-16}, 2e-16),
        # alpha = b / (1/2 + d), the limit for small b.
        ((0.0, 1.3), {"beta": 1e-16}, 1e-16 / 1.8),
        ((0.0, 20), {"beta": 1e-40}, 1e-40 / 20.5),
        ((2.3, 0), {"beta": -2.2999999999999967}, 3.17253817793562e-14),
    ],
)
def test_soft_walls(device, line, expected):
    point = zwidth.boundary_point(*device, **line)
    assert point.status == Status.OK
    got = point.alpha if "beta" in line else point.beta
    assert got == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize("fixed", ["alpha", "beta"])
def test_points_match_mpmath(fixed):
    delta, d = (part[:400] for part in devices(seed=8))
    random = np.random.default_rng(6)
    b = 10 ** random.uniform(-12, -0.5, 400) * (delta + 1 / (d + 1))
    if fixed == "beta":
        points = zwidth.boundary_point(delta, d, beta=b - delta)
    else:
        alpha = 10 ** random.uniform(-30, -1.5, 400) / (d + 1) ** 2
        points = zwidth.boundary_point(delta, d, alpha=alpha, side="upper")
    rows = np.flatnonzero((points.status == Status.OK) & (points.omega < 3) & (d < 1e3) & (delta < 1e6))[:60]
    assert rows.size == 60
    for row in rows:
        omega, device = mpf(float(points.omega[row])), (float(delta[row]), float(d[row]))
        with mp.workdps(160 + oracles.digits_for(device[0])):
            axis = 1 if fixed == "beta" else 0
            target = mpf(float((points.beta if axis else points.alpha)[row]))

            def offset(w, device=device, axis=axis, target=target):
                return oracles.boundary(w, *device)[axis] - target

            exact_omega = mp.findroot(
                offset, (omega, omega * (1 - mpf(10) ** -9)), solver="secant", tol=mpf(10) ** -150
            )
            exact = oracles.boundary(exact_omega, *device)
            assert abs(omega / exact_omega - 1) < 1e-12
            if axis:
                assert oracles.relative_error(points.alpha[row], exact[0]) < 8e-15
            else:
                assert abs(mpf(float(points.beta[row])) - exact[1]) < 1e-14 * (abs(exact[1]) + device[0])


def test_rows_without_a_stable_wall_have_no_boundary_by_any_route():
    traced = jax.jit(lambda b, d: zwidth.boundary_point(0.1, d, beta=b).status, compiler_options=QUICKLY)
    beta = np.array([5.0, 50.0, -0.1, -0.2, 0.3])
    for d in (0.5, 20.0, 7.4):
        direct = zwidth.boundary_point(0.1, d, beta=beta).status
        assert (direct[:4] == Status.NO_BOUNDARY).all()
        np.testing.assert_array_equal(traced(beta, d), direct)


def test_float32_agrees_with_float64():
    random = np.random.default_rng(9)
    delta, d = 10 ** random.uniform(-3, 2, 2400), random.choice([0.0, 0.3, 1.0, 2.5, 8.0], 2400)
    beta = np.float32(-delta + random.uniform(0.01, 2, 2400) * (delta + 1 / (d + 1))).astype(float)
    delta = np.float32(delta).astype(float)
    d = np.float32(d).astype(float)
    direct = zwidth.boundary_point(delta, d, beta=beta)
    traced = jax.jit(lambda delta, d, beta: zwidth.boundary_point(delta, d, beta=beta), compiler_options=QUICKLY)
    got = traced(*(jnp.asarray(part, jnp.float32) for part in (delta, d, beta)))
    assert got.alpha.dtype == jnp.float32
    # A row near the end of the lobe, within rounding error, may have either status.
    assert np.mean(np.asarray(got.status) != direct.status) < 0.002
    both = (direct.status == Status.OK) & (np.asarray(got.status) == Status.OK)
    near = np.isclose(np.asarray(got.alpha), direct.alpha, rtol=1e-3, atol=2e-4 * np.nanmax(direct.alpha))
    assert near[both].all()


@pytest.mark.parametrize("side", [None, "lower", "upper"])
def test_optimistix_method_agrees(side):
    random = np.random.default_rng(4)
    count = 300
    d, delta = random.choice([0, 0.5, 1, 1.3, 4, 20.5], count), 10 ** random.uniform(-3, 2, count)
    top = zwidth.alpha_max(delta, d)
    alpha = top.alpha * random.uniform(1e-3, 0.98, count)
    beta = -delta + (top.beta + delta) * random.uniform(0.05, 1.2, count)
    line: Any = {"alpha": alpha} if side else {"beta": beta}
    options: Any = {"side": side} if side else {}
    direct = zwidth.boundary_point(delta, d, **line, **options)
    solve = partial(zwidth.boundary_point, method="optimistix", **options)
    if side:
        # Inside jit with QUICKLY the compilation takes a third of the time.
        with jax.enable_x64(True):
            other = jax.tree.map(np.asarray, jax.jit(solve, compiler_options=QUICKLY)(delta, d, **line))
    else:
        other = solve(delta, d, **line)
    np.testing.assert_array_equal(direct.status, other.status)
    # Near -delta the general solver resolves b to one ulp of delta only.
    size = (np.abs(direct.alpha) + np.abs(direct.beta)) * (1 + delta / (direct.beta + delta)) ** 2
    for one, two in zip(direct[:2], other[:2], strict=True):
        assert (np.abs(one - two) <= tol.BOUNDARY_POINT.float64 * size)[direct.status == Status.OK].all()


def test_row_without_walls_does_not_affect_derivatives_of_others(x64):
    beta, delta, d = (
        np.array([0.1, -4732.43624518642]),
        np.array([0.1, 4732.43624518642]),
        np.array([1.0, 0.3945414887199974]),
    )

    def solve(beta, delta, d):
        return zwidth.boundary_point(delta, d, beta=beta, method="optimistix").alpha

    slopes = jax.jit(jax.vmap(jax.grad(solve)), compiler_options=QUICKLY)(beta, delta, d)
    omega, step = zwidth.boundary_point(0.1, 1.0, beta=0.1).omega, 1e-5
    low, high = (zwidth.boundary(omega + side, 0.1, 1.0) for side in (-step, step))
    assert slopes[0] == pytest.approx((high.alpha - low.alpha) / (high.beta - low.beta), rel=1e-8)
    assert np.isnan(slopes[1])
