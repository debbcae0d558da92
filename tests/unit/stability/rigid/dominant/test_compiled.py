"""Dominant poles of JAX arrays: equal to those of NumPy, in grids and for separate walls, with derivatives."""

from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from zwidth.stability.rigid.verdict import StabilityMethod

ALPHA, BETA = np.linspace(0.001, 0.9, 128)[:, None], np.linspace(-0.05, 0.9, 72)[None, :]
LINE = np.linspace(0.001, 0.9, 9000)


def make_walls(count=4000):
    """Return ordinary and extreme walls, walls next to the ridge, and walls without stiffness."""
    rng = np.random.default_rng(3)
    d = np.resize([0.0, 1.0, 0.5, 3.25, 30.0], count)
    delta = rng.uniform(0.0, 2.0, count)
    ridge = zwidth.alpha_max(delta, d)
    far = rng.uniform(0.01, 1.3, count)
    walls = [
        (far * ridge.alpha, rng.uniform(0.0, 1.2, count) * ridge.beta, delta),
        (10.0 ** rng.uniform(-12, 3, count), 10.0 ** rng.uniform(-9, 3, count), 10.0 ** rng.uniform(-9, 3, count)),
        (ridge.alpha * (1.0 + 1e-9 * rng.standard_normal(count)), ridge.beta, delta),
        (0.0 * delta, rng.uniform(-2.0, 1.0, count) * delta, delta),
    ]
    alpha, beta, delta = (np.concatenate(parts) for parts in zip(*walls, strict=True))
    return alpha, beta, delta, np.tile(d, len(walls))


def test_jax_arrays_have_the_poles_and_statuses_of_numpy_arrays():
    walls = make_walls()
    expected = zwidth.dominant_pole(*walls)
    with jax.enable_x64(True):
        arrays = [jnp.asarray(column) for column in walls]
        poles, stable = zwidth.dominant_pole(*arrays), zwidth.is_stable(*arrays)
    np.testing.assert_allclose(poles.radius, expected.radius, rtol=1e-12)
    np.testing.assert_array_equal(np.asarray(poles.radius) < 1.0, stable)
    np.testing.assert_allclose(poles.angle, expected.angle, rtol=0, atol=1e-9)
    # The certificates of the two methods differ for rates that are nearly lost in rounding errors.
    both = (expected.status == 0) & (np.asarray(poles.status) == 0)
    assert np.mean(both != (expected.status == 0)) < 2e-3
    np.testing.assert_allclose(np.asarray(poles.decay_rate)[both], expected.decay_rate[both], rtol=1e-3)
    assert np.isnan(np.asarray(poles.decay_rate)[~np.asarray(poles.status == 0)]).all()


@pytest.mark.parametrize("d", [0, 1, 2.5])
def test_grids_in_jit_equal_those_of_numpy(d):
    expected = zwidth.dominant_pole(ALPHA, BETA, 0.1, d)
    with jax.enable_x64(True):
        poles = jax.jit(lambda alpha, beta: zwidth.dominant_pole(alpha, beta, 0.1, d))(ALPHA, BETA)
        direct = zwidth.spectral_radius(jnp.asarray(ALPHA), BETA, 0.1, d)
        line = jax.jit(lambda alpha: zwidth.spectral_radius(alpha, 0.3, 0.1, d))(LINE)
    for name, values in poles._asdict().items():
        np.testing.assert_allclose(values, getattr(expected, name), rtol=1e-15, err_msg=name)
    np.testing.assert_allclose(direct, expected.radius, rtol=1e-15)
    np.testing.assert_allclose(line, zwidth.spectral_radius(LINE, 0.3, 0.1, d), rtol=1e-15)


def test_float32_grid_in_jit_is_rounded_from_float64():
    with jax.enable_x64(False):
        alpha, beta = jnp.asarray(ALPHA, jnp.float32), jnp.asarray(BETA, jnp.float32)
        radius = jax.jit(lambda alpha, beta: zwidth.spectral_radius(alpha, beta, 0.125, 1))(alpha, beta)
        stable = jax.jit(lambda alpha, beta: zwidth.is_stable(alpha, beta, 0.125, 1))(alpha, beta)
    assert radius.dtype == jnp.float32
    expected = zwidth.spectral_radius(np.float64(alpha), np.float64(beta), 0.125, 1)
    np.testing.assert_allclose(radius, expected, rtol=1e-7)
    np.testing.assert_array_equal(radius < 1.0, stable)


def test_grids_are_computed_in_float64_by_callbacks_in_other_threads():
    """A product of matrices delays the call of NumPy, which another thread, with another default precision, makes."""
    with jax.enable_x64(True):

        @jax.jit
        def compute(matrix, alpha):
            zero = 0.0 * jnp.sum(matrix @ matrix @ matrix)
            return zwidth.spectral_radius(alpha + zero, BETA, 0.1, 1)

        radius = compute(jnp.ones((900, 900)), ALPHA)
    np.testing.assert_allclose(radius, zwidth.spectral_radius(ALPHA, BETA, 0.1, 1), rtol=1e-15)


def test_vmap_over_grids():
    delays = np.array([0.0, 1.0, 2.5])
    with jax.enable_x64(True):
        radii = jax.jit(jax.vmap(lambda d: zwidth.spectral_radius(ALPHA, BETA, 0.1, d)))(delays)
        both = jax.vmap(lambda alpha, beta: zwidth.spectral_radius(alpha, beta, 0.1, 1))(
            jnp.stack([ALPHA, 2 * ALPHA]), jnp.stack([BETA, 0.5 * BETA])
        )
    np.testing.assert_allclose(radii, zwidth.spectral_radius(ALPHA, BETA, 0.1, delays[:, None, None]), rtol=1e-12)
    np.testing.assert_allclose(both[1], zwidth.spectral_radius(2 * ALPHA, 0.5 * BETA, 0.1, 1), rtol=1e-12)


def test_derivatives_of_grids_equal_differences():
    def compute_sum(delta):
        return jnp.sum(zwidth.spectral_radius(ALPHA, BETA, delta, 1))

    h = 1e-4
    with jax.enable_x64(True):
        low, middle, high = (np.float64(compute_sum(jnp.float64(0.1 + k * h))) for k in (-1, 0, 1))
        first, second = map(float, jax.jit(jax.value_and_grad(jax.grad(compute_sum)))(0.1))
        assert jax.grad(compute_sum)(0.1) == pytest.approx(first, rel=1e-9)
    assert first == pytest.approx((high - low) / (2 * h), rel=1e-4)
    assert np.isfinite(second)
    assert second == pytest.approx((high - 2 * middle + low) / h**2, rel=0.2)


def test_radius_at_the_boundary_keeps_its_derivative():
    """Radii next to 1 are moved to the side of the label; the derivative remains that of the pole."""
    point = zwidth.boundary_point(0.1, 1.0, beta=0.4)
    with jax.enable_x64(True):
        for factor in (1.0 - 1e-16, 1.0, 1.0 + 3e-16):
            radius, slope = jax.value_and_grad(lambda alpha: zwidth.spectral_radius(alpha, 0.4, 0.1, 1.0))(
                float(point.alpha) * factor
            )
            assert radius == pytest.approx(1.0, abs=1e-14)
            inside = jax.grad(lambda alpha: zwidth.spectral_radius(alpha, 0.4, 0.1, 1.0))(float(point.alpha) - 1e-6)
            assert slope == pytest.approx(float(inside), rel=1e-4)


def test_accuracy_of_jax_arrays_may_be_chosen():
    with jax.enable_x64(True):
        radius = zwidth.spectral_radius(jnp.asarray([0.1, 0.5]), 0.5, 0.1, 1, accuracy=1e-12)
    np.testing.assert_allclose(radius, zwidth.spectral_radius([0.1, 0.5], 0.5, 0.1, 1), rtol=1e-12)


@pytest.mark.parametrize("method", get_args(StabilityMethod))
def test_methods_of_decide_stability_for_jax_arrays(method):
    alpha = [0.1, 0.6, float("nan"), 1e70, 0.8]
    expected = zwidth.decide_stability(alpha, 0.4, 0.1, 1, method=method)
    with jax.enable_x64(True):
        result = zwidth.decide_stability(jnp.asarray(alpha), 0.4, 0.1, 1, method=method)
        results = [result]
        if method != "certified":
            results.append(
                jax.jit(lambda a,: zwidth.decide_stability(a, 0.4, 0.1, 1, method=method))(jnp.asarray(alpha))
            )
    for each in results:
        for name, values in each._asdict().items():
            assert isinstance(values, jax.Array)
            np.testing.assert_array_equal(values, np.broadcast_to(getattr(expected, name), 5), err_msg=name)
