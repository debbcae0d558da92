"""Modulus, angle and decay rate of the dominant pole against eigenvalues of companion matrices."""

import subprocess
import sys
from functools import partial

import jax
import numpy as np
import pytest
import tolerances as tol
from compiling import QUICKLY

import zwidth
from zwidth.core.status import Status

DELAYS = (0.0, 1.0, 2.0, 4.0, 9.0, 0.3, 1.5, 3.75, 40.0)


def random_walls(count, seed=5):
    rng = np.random.default_rng(seed)
    d = rng.choice(DELAYS, count)
    alpha, beta = rng.uniform(-0.1, 1.5, count) / (1 + d), rng.uniform(-0.3, 1.5, count) / (1 + d)
    return alpha, beta, 10.0 ** rng.uniform(-3, 1, count), d


def angle_by_eigenvalues(alpha, beta, delta, d):
    """Return the angle of the largest eigenvalue, and whether no other one is within 1e-6 of its modulus."""
    z = np.roots(zwidth.char_poly(alpha, beta, delta, d))
    modulus = np.abs(z)
    dominant = z[modulus.argmax()]
    others = modulus[(np.abs(z - dominant) > 1e-4) & (np.abs(z - np.conj(dominant)) > 1e-4)]
    return np.abs(np.angle(dominant)), others.max(initial=0.0) < modulus.max() * (1 - 1e-6)


def test_random_walls_agree_with_eigenvalues():
    walls = random_walls(800)
    pole = zwidth.dominant_pole(*walls)
    np.testing.assert_array_equal(pole.status, Status.OK)
    np.testing.assert_array_equal(pole.radius, zwidth.spectral_radius(*walls))
    np.testing.assert_array_equal(pole.decay_rate, zwidth.decay_rate(*walls))
    exact, is_only = np.transpose([angle_by_eigenvalues(*wall) for wall in zip(*walls, strict=True)])
    assert is_only.mean() > 0.99
    # Near a double pole, eigenvalues have half of the digits.
    np.testing.assert_allclose(pole.angle[is_only == 1], exact[is_only == 1], atol=tol.DOUBLE_POLE.float64)
    real = np.isin(pole.angle, (0.0, np.pi))
    assert 0.1 < real.mean() < 0.9
    assert (exact[real & (is_only == 1)] % np.pi < tol.DOUBLE_POLE.float64).mean() > 0.9


@pytest.mark.parametrize("d", [0.0, 4.0, 1.5, 60.0])
def test_grids_agree_with_single_walls(d):
    alpha, beta = np.linspace(-0.1, 1.5, 130) / (1 + d), np.linspace(-0.3, 1.5, 120)[:, None] / (1 + d)
    grid = zwidth.dominant_pole(alpha, beta, 0.1, d)
    rows, columns = np.random.default_rng(1).integers(0, (120, 130), (500, 2)).T
    single = zwidth.dominant_pole(alpha[columns], beta[rows, 0], 0.1, d)
    ok = (grid.status[rows, columns] == Status.OK) & (single.status == Status.OK)
    assert ok.mean() > 0.99
    np.testing.assert_allclose(grid.angle[rows, columns][ok], single.angle[ok], atol=2e-9)
    np.testing.assert_array_equal((grid.angle == 0)[rows, columns][ok], (single.angle == 0)[ok])


def test_walls_as_typed_by_a_user():
    assert zwidth.dominant_pole(0, 0, 1, 1).angle == 0
    assert zwidth.dominant_pole(1, 1, 1, 2).angle == pytest.approx(angle_by_eigenvalues(1, 1, 1, 2)[0], rel=1e-9)
    pole = zwidth.dominant_pole([1, 2], 1, 1, 0)
    assert pole.angle.shape == pole.status.shape == (2,)
    # Without delay and with much damping, the dominant pole is real and negative: the response alternates.
    assert zwidth.dominant_pole(0.1, 10, 5, 0).angle == np.pi
    poor = zwidth.dominant_pole([0.1, np.nan, 1e70], 1, [0.1, 0.1, 0.1], 1)
    assert poor.status.tolist() == [Status.OK, Status.INVALID_INPUT, Status.OUT_OF_RANGE]
    assert np.isnan(poor.angle).tolist() == [False, True, True]


@pytest.mark.parametrize("d", [1, 1.5])
def test_angle_and_its_derivative_inside_jit(d, x64):
    alpha, beta, delta, _ = random_walls(40, seed=8)
    direct = zwidth.dominant_pole(alpha, beta, delta, d)
    inside = jax.jit(partial(zwidth.dominant_pole, d=d), compiler_options=QUICKLY)(alpha, beta, delta)
    np.testing.assert_allclose(inside.angle, direct.angle, atol=1e-9)
    np.testing.assert_allclose(inside.radius, direct.radius, rtol=1e-9)
    np.testing.assert_array_equal(inside.status, direct.status)
    slope = jax.jit(jax.grad(lambda alpha: zwidth.dominant_pole(alpha, 0.3, 0.1, d).angle), compiler_options=QUICKLY)
    h = 1e-6
    difference = (
        zwidth.dominant_pole(0.4 + h, 0.3, 0.1, d).angle - zwidth.dominant_pole(0.4 - h, 0.3, 0.1, d).angle
    ) / (2 * h)
    assert slope(0.4) == pytest.approx(difference, rel=1e-6)


def test_few_walls_need_no_jax():
    code = "import zwidth, sys; zwidth.dominant_pole([0.1, 0.2], 0.3, 0.1, 1.5); assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
