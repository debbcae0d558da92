"""Values and derivatives of the boundary curve in its forms: at s, at omega, and for delays below one period."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zwidth.plant.rigid_mass import discretize_mass, discretize_plant
from zwidth.stability.rigid.boundary_curve import (
    compute_squared_modulus,
    evaluate_curve,
    evaluate_polynomials,
    evaluate_short_delay_curve,
    evaluate_stationarity,
    evaluate_wall,
    evaluate_wave,
    evaluate_wave_at,
    expand_curve,
    expand_curve_with_offset,
    expand_short_delay_curve,
)

COUNT = 300


def sample(delays):
    """Return plants, and s on the lower three quarters of the range that contains the lobe."""
    random = np.random.default_rng(5)
    plant = discretize_plant(10 ** random.uniform(-3, 2, COUNT), random.choice(delays, COUNT))
    return plant, np.sin(0.5 * np.pi / (plant.whole + 1) * random.uniform(0.01, 0.75, COUNT))


@pytest.mark.parametrize("delays", [[0.0, 0.3], [1.0, 2.6, 7.0, 60.5]])
def test_all_forms_agree(delays):
    plant, s = sample(delays)
    curve, n = expand_curve_with_offset(plant), plant.whole
    wave = evaluate_wave(s, n)
    point = evaluate_curve(wave, curve).divide(s)
    elsewhere = expand_curve(discretize_mass(plant.delta, plant.f))
    alpha, beta = evaluate_wall(evaluate_wave_at(2 * np.arcsin(s), n), elsewhere)
    size = np.abs(alpha) + np.abs(beta) + plant.delta
    assert np.max(np.abs(point.alpha - alpha) / size) < 1e-13
    assert np.max(np.abs(point.b - plant.delta - beta) / size) < 1e-13
    if max(delays) < 1:
        short = evaluate_short_delay_curve(s * s, expand_short_delay_curve(plant)).divide(s)
        for got, expected in zip(short, point, strict=True):
            np.testing.assert_allclose(got, expected, rtol=1e-9)
    low = wave.y <= 0.5
    V = compute_squared_modulus(wave.y, wave.q, curve)
    np.testing.assert_allclose(V[low], evaluate_polynomials(wave, curve).V[low], rtol=1e-13)


@pytest.mark.parametrize("delays", [[0.0, 0.3], [1.0, 2.6, 7.0, 60.5]])
def test_derivatives_in_s_agree_with_automatic_differentiation(delays):
    with jax.enable_x64(True):
        plant, s = sample(delays)
        plant = jax.tree.map(jnp.asarray, plant)
        curve, n, s = expand_curve_with_offset(plant), plant.whole, jnp.asarray(s)
        one = jnp.ones_like(s)

        def evaluate(s):
            return evaluate_curve(evaluate_wave(s, n), curve).divide(s)

        point, slope = jax.jvp(evaluate, (s,), (one,))
        np.testing.assert_allclose(point.d_alpha, slope.alpha, rtol=1e-9, atol=1e-10 * np.max(np.abs(slope.alpha)))
        np.testing.assert_allclose(point.d_b, slope.b, rtol=1e-9, atol=1e-10 * np.max(np.abs(slope.b)))
        (T, dT), (T_slope, _) = jax.jvp(lambda s: evaluate_stationarity(s, curve, n), (s,), (one,))
        V = evaluate_polynomials(evaluate_wave(s, n), curve).V
        np.testing.assert_allclose(T, V**2 * point.d_alpha / (8 * s), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(dT, T_slope, rtol=1e-9, atol=1e-10 * np.max(np.abs(T_slope)))


def test_wave_without_delay_equals_the_general_one_up_to_the_corner():
    s, zero = np.array([0.1, 0.6, 0.9, 1.0]), np.zeros(4)
    for field, general in zip(evaluate_wave(s, zero, True), evaluate_wave(s, zero), strict=True):
        np.testing.assert_allclose(np.broadcast_to(field, np.shape(general)), general, rtol=1e-15, atol=1e-15)
