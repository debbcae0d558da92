"""Closed-form derivatives of the ridge against finite differences in 60 digits, directly and inside JAX
transformations.
"""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from compiling import QUICKLY, compile_bends

import zwidth
from zwidth.stability.rigid.ridge import ridge_kernel, slopes_kernel


def plant_in_mpmath(delta, f):
    """Return a2, a1, a0 and gap, independently, from superposed position and velocity responses."""

    def respond_to_pulse(t):
        if delta == 0:
            return t * t / 2, t
        speed = -mp.expm1(-delta * t) / delta
        return (t - speed) / delta, speed

    c = mp.exp(-delta)
    (x, v), (late, speed) = respond_to_pulse(mp.mpf(1)), respond_to_pulse(1 - f)
    a2, a1, a0 = late, v * speed - c * late + x - late, v * (v - speed) - c * (x - late)
    return a2, a1, a0, a2 - a1 + a0


def alpha_in_mpmath(delta, d, guess):
    """Return alpha_max by root finding in 60 digits on the boundary curve."""
    n = mp.floor(d)
    a2, a1, a0, _ = plant_in_mpmath(delta, d - n)
    c = mp.exp(-delta)

    def height(omega):
        z = mp.expj(omega)
        wall = -(z - 1) * (z - c) * mp.expj(omega * n) / (a2 * z + a1 + a0 / z)
        return mp.re(wall) - mp.tan(omega / 2) * mp.im(wall)

    return height(mp.findroot(lambda w: mp.diff(height, w), guess, tol=1e-30))


POINTS = [(0.0, 0.5), (0.1, 1.3), (0.1, 1.0), (3.0, 0.25), (20.0, 0.6), (0.7, 6.5), (50.0, 3.5)]


def derivatives_in_mpmath(delta, d, omega):
    """Return gradient and Hessian, both from the right as documented, by one-sided differences of four points per
    variable.
    """
    step = mp.mpf(10) ** -9
    with mp.workdps(60):
        first, second = (mp.mpf(-11) / 6, 3, mp.mpf(-3) / 2, mp.mpf(1) / 3), (2, -5, 4, -1)
        values = [[alpha_in_mpmath(delta + i * step, d + j * step, omega) for j in range(4)] for i in range(4)]
        down, across = [values[i][0] for i in range(4)], values[0]
        mixed = sum(first[i] * first[j] * values[i][j] for i in range(4) for j in range(4)) / step**2
        gradient = [mp.fdot(first, line) / step for line in (down, across)]
        bends = [mp.fdot(second, line) / step**2 for line in (down, across)]
    return np.array(gradient, float), np.array([[bends[0], mixed], [mixed, bends[1]]], float)


def test_gradient_and_hessian_agree_with_60_digits(x64):
    def alpha(p):
        return zwidth.alpha_max(p[0], p[1]).alpha

    _, hessians = compile_bends(jax.grad(alpha))(POINTS)
    for k, (delta, d) in enumerate(POINTS):
        point = zwidth.alpha_max(delta, d)
        gradient, hessian = derivatives_in_mpmath(delta, d, point.omega)
        size = 1 + abs(float(point.alpha))
        by_hand = slopes_kernel(np.float64(delta), np.float64(d))
        np.testing.assert_allclose((by_hand.by_delta, by_hand.by_d), gradient, rtol=1e-13, atol=1e-14 * size)
        p = jnp.array([delta, d])
        np.testing.assert_allclose(jax.grad(alpha)(p), gradient, rtol=1e-13, atol=1e-14 * size)
        np.testing.assert_allclose(hessians[k], hessian, rtol=1e-10, atol=1e-11 * size)
        if k != 1:
            continue
        # Test one mixed derivative only, because outside jit every call is traced again and compiles a program.
        bend = jax.grad(jax.grad(lambda delta, d: zwidth.alpha_max(delta, d).alpha), 1)(delta, d)
        np.testing.assert_allclose(bend, hessian[0, 1], rtol=1e-10, atol=1e-11 * size)


def test_newton_converges_in_three_steps_everywhere():
    """The status is OK only if the second of three steps was below the square root of the rounding error."""
    rng = np.random.default_rng(5)
    for low, high in ((0.0, 1.0), (1.0, 2.0), (2.0, 9.0), (9.0, 1e5)):
        d = rng.uniform(low, high, 20000) if high < 10 else 10 ** rng.uniform(1, 5, 20000)
        edge = rng.random(20000)
        d = np.where(edge < 0.2, np.floor(d), np.where(edge < 0.4, np.floor(d) + 10 ** rng.uniform(-16, -1, 20000), d))
        d = np.where(edge > 0.8, np.floor(d) + 1 - 10 ** rng.uniform(-16, -1, 20000), d)
        delta = np.minimum(np.where(rng.random(20000) < 0.1, 0.0, 10 ** rng.uniform(-8, 12, 20000)), 1e12)
        delta[:5000] = 10 ** rng.uniform(-1, 2, 5000)
        point = ridge_kernel(delta, np.minimum(d, 1e5))
        assert (point.status == 0).all()
        assert np.isfinite(point.alpha).all()


# Integer and fractional delays, both sides of the corner transition of d = 0, smallest and largest damping.
HARD = [(0.0, 0.0), (1e-12, 0.0), (3.6593, 0.0), (3.6594, 0.0), (50.0, 0.0), (1e6, 0.0), (0.0, 1.0), (0.3, 1.0)]
HARD += [(0.3, 1.5), (1e6, 0.37), (1e-9, 499.5), (2.0, 500.0), (1e6, 500.0), (30.0, 0.01), (-1.0, 1.0), (np.nan, 2.0)]


def differentiate_all(function, delta, d):
    """Return the derivatives of (alpha, beta, omega) by delta and d at every device."""
    sides = [
        jax.jvp(lambda *args: function(*args)[:3], (delta, d), side)[1]
        for side in ((1.0 + 0 * d, 0 * d), (0 * d, 1.0 + 0 * d))
    ]
    return np.array(sides)


def test_gradients_outside_and_inside_jit_agree(x64):
    rng = np.random.default_rng(5)
    delta, d = (
        np.concatenate([column, drawn])
        for column, drawn in zip(
            np.array(HARD).T, (10 ** rng.uniform(-6, 6, 200), rng.choice([0.0, 1.0, 3.0, 0.4, 7.3], 200)), strict=True
        )
    )
    delta, d = jnp.asarray(delta), jnp.asarray(d)
    direct = differentiate_all(zwidth.alpha_max, delta, d)
    compiled = differentiate_all(jax.jit(lambda *args: zwidth.alpha_max(*args)[:3]), delta, d)
    valid = (delta >= 0.0) & np.isfinite(delta)
    assert np.isfinite(direct[..., valid]).all()
    assert np.isnan(direct[..., ~valid]).all()
    # Errors are relative to the largest derivative of a device, because derivatives by an irrelevant damping are
    # differences of equal terms. Near the corner the derivative of omega grows inversely with the distance, which
    # amplifies rounding errors.
    size = np.abs(compiled).max(axis=(0, 1))
    assert (np.abs(direct - compiled) <= 1e-13 * size * np.maximum(1.0, size))[..., valid].all()


def test_derivatives_of_plain_numbers_in_both_precisions_and_of_any_order():
    """As a user types them, with a Python integer for the other argument."""
    expected = zwidth.sensitivities(mass=1.0, damping=0.3, period=1.0, delay=2.0).per_damping
    for enabled, tolerance in ((True, 1e-13), (False, 1e-5)):
        with jax.enable_x64(enabled):
            grad = jax.grad(lambda delta: zwidth.alpha_max(delta, 2).alpha)
            for function in (grad, jax.jit(grad)):
                assert float(function(0.3)) == pytest.approx(float(expected), rel=tolerance)
                assert np.isnan(function(np.nan))
            assert jax.jit(grad)(0.3).dtype == (np.float64 if enabled else np.float32)
    with jax.enable_x64(True):
        third = jax.jit(jax.grad(jax.grad(grad)), compiler_options=QUICKLY)(0.3)
        step = 1e-3
        values = [zwidth.alpha_max(0.3 + k * step, 2).alpha for k in (-2, -1, 1, 2)]
        assert float(third) == pytest.approx(np.dot((-1, 2, -2, 1), values) / (2 * step**3), rel=1e-3)
