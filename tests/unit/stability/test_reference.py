"""The reference method against NumPy's eigenvalues of the same loop, written as a recurrence, and the fast methods."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from zwidth.stability.reference import (
    compute_radii,
    expand_loop,
    find_boundary_point,
    maximize_stiffness,
)
from zwidth.stability.rigid.broadcasting import find_degree


def sample_walls(d, count):
    rng = np.random.default_rng(7)
    delta = 10 ** rng.uniform(-3, 1, count)
    top = zwidth.alpha_max(delta, d)
    alpha = top.alpha * rng.uniform(0.01, 2.0, count)
    return alpha, top.beta * rng.uniform(0.0, 2.0, count), delta, np.full(count, float(d))


def build_state_matrix(alpha, beta, delta, n):
    """Return the closed loop of position, velocity, previous position and n delayed forces, for an integer delay n."""
    c = np.exp(-delta)
    phi1 = -np.expm1(-delta) / delta
    phi2 = (1.0 - phi1) / delta
    size = 3 + n
    A = np.zeros((size, size))
    force = -np.array([alpha + beta, 0.0, -beta])  # of position, velocity and previous position
    A[0, :2], A[1, 1], A[2, 0] = (1.0, phi1), c, 1.0
    if n == 0:
        A[0, :3] += phi2 * force
        A[1, :3] += phi1 * force
    else:
        A[0, 3], A[1, 3] = phi2, phi1  # the oldest force acts
        A[3:-1, 4:] = np.eye(n - 1)
        A[-1, :3] = force
    return A


@pytest.mark.parametrize("d", [0, 1, 4, 8])
def test_radius_equals_that_of_the_state_matrix(d, x64):
    walls = sample_walls(d, 200)
    radii = compute_radii(*map(jnp.asarray, walls), degree=find_degree(d))
    expected = [np.abs(np.linalg.eigvals(build_state_matrix(*wall[:3], d))).max() for wall in zip(*walls, strict=True)]
    # Eigenvalues near a double pole have errors of the square root of the rounding unit.
    np.testing.assert_allclose(radii, expected, rtol=1e-7)
    assert np.median(np.abs(radii / np.array(expected) - 1.0)) < 1e-14


@pytest.mark.parametrize("d", [0, 0.3, 1, 2.5, 4, 8])
def test_labels_of_a_grid_equal_those_of_the_closed_form(d, x64):
    alpha, beta, delta, _ = sample_walls(d, 1)
    grid = np.broadcast_arrays(
        alpha * np.linspace(0.02, 2.0, 128)[:, None], beta * np.linspace(0.0, 2.0, 128), delta, d
    )
    columns = [jnp.asarray(np.ravel(part), float) for part in grid]
    radii = np.asarray(jax.jit(compute_radii, static_argnums=4)(*columns, find_degree(d))).reshape(grid[0].shape)
    stable = zwidth.is_stable(*grid)
    resolved = np.abs(radii - 1.0) > 1e-9
    assert resolved.mean() > 0.98
    np.testing.assert_array_equal((radii < 1.0)[resolved], stable[resolved])
    np.testing.assert_allclose(radii, zwidth.spectral_radius(*grid), rtol=1e-7)


def test_polynomial_is_that_of_the_paper():
    """Equation (17) of the paper, divided by -delta^2, for integer d."""
    alpha, beta, delta = 0.3, 0.2, 0.1
    for d in (0, 1, 3):
        c = np.exp(-delta)
        s, t = delta - 1.0 + c, 1.0 - c - delta * c
        device = np.polymul([1.0, -1.0], [1.0, -c] + [0.0] * (1 + d)) * delta**2
        expected = np.polyadd(device, np.polymul([s, t], [alpha + beta, -beta]))
        coefficients = expand_loop(*map(np.asarray, (alpha, beta, delta, float(d))), degree=find_degree(d))
        np.testing.assert_allclose(coefficients, expected / delta**2, rtol=1e-12)


def test_maximum_stiffness_has_spectral_radius_1_and_is_a_maximum(x64):
    rng = np.random.default_rng(8)
    delta, d = 10 ** rng.uniform(-2, 1, 100), rng.choice([0, 0.25, 1, 1.5, 3], 100)
    point, _ = jax.jit(jnp.vectorize(maximize_stiffness))(delta, d)
    assert np.asarray(point.converged).all()
    at_top = zwidth.spectral_radius(np.asarray(point.alpha), np.asarray(point.beta), delta, d)
    np.testing.assert_allclose(at_top, 1.0, atol=1e-6)  # a double pole at the corner
    for factor in (0.99, 1.01):
        assert not zwidth.is_stable(1.001 * np.asarray(point.alpha), factor * np.asarray(point.beta), delta, d).any()
    assert zwidth.is_stable(0.999 * np.asarray(point.alpha), np.asarray(point.beta), delta, d).all()


@pytest.mark.parametrize("line", ["row", "lower", "upper"])
def test_boundary_points_separate_stable_from_unstable_walls(line, x64):
    rng = np.random.default_rng(9)
    delta, d = 10 ** rng.uniform(-2, 1, 100), rng.choice([0, 0.25, 1, 1.5, 3], 100)
    top = zwidth.alpha_max(delta, d)
    given = (top.beta if line == "row" else top.alpha) * rng.uniform(0.2, 0.9, 100)
    find = jax.jit(jnp.vectorize(functools.partial(find_boundary_point, line=line)))
    point, exists = find(delta, d, given)
    assert np.asarray(exists & point.converged).all()
    inner, outer = {"row": (0.999, 1.001), "lower": (1.001, 0.999), "upper": (0.999, 1.001)}[line]
    for factor, expected in ((inner, True), (outer, False)):
        # Scale beta + delta, which is positive on the boundary; beta itself may be 0.
        beta = (point.beta + delta) * factor - delta
        walls = (point.alpha * factor, point.beta) if line == "row" else (point.alpha, beta)
        assert (zwidth.is_stable(np.asarray(walls[0]), np.asarray(walls[1]), delta, d) == expected).all()
