"""Test the matrix exponential and the dissipated energy, against scipy, quadrature and JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from zwidth.plant.transition import compute_transition

GENERATOR = np.random.default_rng(3)
RATE = GENERATOR.normal(size=(3, 4, 6)) - np.eye(4, 6)
HALF = GENERATOR.normal(size=(3, 6, 6))
DRAIN = HALF @ HALF.mT


def extend(rate):
    """Return the square matrix [[A, B], [0, 0]]."""
    return np.pad(rate, ((0, rate.shape[-1] - rate.shape[-2]), (0, 0)))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 30.0])
def test_change_is_the_matrix_exponential(scale):
    times = np.array([0.0, 2.0**-52, 0.3, 1.0])
    change = compute_transition(scale * RATE[:, None], times).change
    for k, rate in enumerate(RATE):
        for j, time in enumerate(times):
            exact = (expm(extend(scale * rate) * time) - np.eye(6))[:4]
            # The reference loses the digits below 1e-16, because it subtracts 1 from the exponential.
            np.testing.assert_allclose(change[k, j], exact, rtol=1e-12, atol=1e-15 + 1e-13 * np.abs(exact).max())


def test_change_keeps_the_digits_of_slow_motions():
    """The change of a slow state is far smaller than 1, where the exponential itself would lose its digits."""
    change = compute_transition(np.diag([-1e-12, -1e6]), 1).change
    np.testing.assert_allclose(np.diag(change), np.expm1([-1e-12, -1e6]), rtol=1e-15)


def test_loss_is_the_integral_of_the_power():
    loss = compute_transition(RATE, 0.8, DRAIN).loss
    nodes, weights = np.polynomial.legendre.leggauss(30)
    for rate, drain, form in zip(RATE, DRAIN, loss, strict=True):
        exponentials = [expm(extend(rate) * 0.4 * (node + 1.0)) for node in nodes]
        exact = 0.4 * sum(w * E.T @ drain @ E for w, E in zip(weights, exponentials, strict=True))
        np.testing.assert_allclose(form, exact, rtol=1e-11, atol=1e-12)


def test_jax_arrays_and_derivatives(x64):
    transition = jax.jit(lambda rate, time: compute_transition(rate, time).change)
    np.testing.assert_allclose(transition(jnp.asarray(RATE), 0.7), compute_transition(RATE, 0.7).change, rtol=1e-12)
    # d change/dt = A change + [A, B]; a complex step in the time yields the same derivative.
    exact = RATE[..., :4] @ compute_transition(RATE, 0.7).change + RATE
    np.testing.assert_allclose(jax.jacfwd(transition, 1)(jnp.asarray(RATE), 0.7), exact, rtol=1e-11)
    by_step = compute_transition(RATE + 0j, 0.7 + 1e-30j).change.imag / 1e-30
    np.testing.assert_allclose(by_step, exact, rtol=1e-11)
