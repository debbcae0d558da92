"""The chosen dampings against a brute-force search of the stable interval."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from zwidth import fastest_damping, fastest_wall, modulus_margin, most_robust_damping
from zwidth.arrays.minimize import lowest
from zwidth.loops.rigid.poles import radius_by_companion
from zwidth.words.status import Status

DELTA = np.array([0.0, 0.5, 3.0, 0.1, 0.1])
D = np.array([0.0, 0.0, 0.0, 1.0, 0.5])
ALPHA = np.asarray(0.5 * zwidth.alpha_max(DELTA, D).alpha)


@pytest.fixture(scope="module")
def trials():
    """A fine row of stable dampings for every device."""
    low, high = (zwidth.boundary_point(DELTA, D, alpha=ALPHA, side=side).beta for side in ("lower", "upper"))
    return np.linspace(low, high, 2001)[1:-1]


def test_no_other_damping_settles_faster(trials):
    choice = fastest_damping(ALPHA, DELTA, D)
    radius = np.asarray(radius_by_companion(ALPHA, trials, DELTA, D))
    assert choice.status.tolist() == [Status.OK] * 5
    assert np.all(choice.achieved <= radius.min(axis=0) + 1e-9)
    # A kink like a square root falls steeply between two trials, yet not farther than this.
    assert np.all(choice.achieved > radius.min(axis=0) - 0.05)
    np.testing.assert_allclose(radius_by_companion(ALPHA, choice.beta, DELTA, D), choice.achieved, rtol=1e-9)
    assert np.all(choice.achieved < 1)


def test_no_other_damping_is_more_robust(trials):
    choice = most_robust_damping(ALPHA, DELTA, D)
    margin = np.asarray(modulus_margin(ALPHA, trials[::10], DELTA, D))
    assert choice.status.tolist() == [Status.OK] * 5
    assert np.all(choice.achieved >= margin.max(axis=0) - 1e-12)
    np.testing.assert_allclose(choice.achieved, margin.max(axis=0), rtol=0.02)
    assert np.all(np.asarray(radius_by_companion(ALPHA, choice.beta, DELTA, D)) < 1)


def test_the_margin_is_the_distance_of_p_over_its_open_loop():
    omega = np.linspace(0, np.pi, 40_001)[1:]
    z = np.exp(1j * omega)
    for alpha, beta, delta, d in ((0.1, 0.2, 0.1, 0.0), (0.05, 0.1, 0.1, 1.5), (1e-3, 0.05, 0.5, 3.0)):
        ratio = np.polyval(zwidth.char_poly(alpha, beta, delta, d), z) / np.polyval(zwidth.char_poly(0, 0, delta, d), z)
        assert modulus_margin(np.array([alpha]), beta, delta, d)[0] == pytest.approx(np.abs(ratio).min(), rel=1e-6)


def test_the_margin_vanishes_on_the_boundary():
    edge = zwidth.boundary(0.5, 0.3, 1.0)
    assert modulus_margin(np.array([edge.alpha]), edge.beta, 0.3, 1.0)[0] < 1e-8


def test_no_damping_where_none_is_stable():
    choice = fastest_damping(np.array([2.0, -1.0, np.nan]) * zwidth.alpha_max(0.1, 1.0).alpha, 0.1, 1.0)
    assert choice.status.tolist() == [Status.NO_BOUNDARY, Status.NO_BOUNDARY, Status.INVALID_INPUT]
    assert np.all(np.isnan(choice.beta))
    with pytest.raises(zwidth.TracedDelayError, match="got a traced value"):
        jax.jit(fastest_damping)(0.1, 0.1, 1.0)


def test_the_fastest_wall_of_all():
    wall = fastest_wall(0.5, 0.0)
    random = np.random.default_rng(3)
    alpha = random.uniform(0, float(zwidth.alpha_max(0.5, 0.0).alpha), 20_000)
    beta = random.uniform(-0.5, 2.5, 20_000)
    radius = np.asarray(radius_by_companion(alpha, beta, 0.5, 0.0))
    assert wall.spectral_radius <= radius.min() + 1e-5
    assert float(radius_by_companion(wall.alpha, wall.beta, 0.5, 0.0)) == pytest.approx(wall.spectral_radius, rel=1e-9)
    assert np.isnan(fastest_wall(-1.0, 0.0).alpha)


def test_the_fastest_undamped_wall_has_a_triple_pole():
    # (z - r)^3 = z (z - 1)^2 + (z + 1)(alpha z + beta (z - 1))/2 leaves (r + 1)^3 = 4.
    r = 4 ** (1 / 3) - 1
    wall = fastest_wall(0.0, 0.0)
    assert wall.spectral_radius == pytest.approx(r, abs=2e-5)
    assert wall.alpha == pytest.approx(6 * r**2 - 2, abs=2e-3)
    assert wall.beta == pytest.approx(2 * r**3, abs=2e-3)


def test_a_kink_is_found(x64):
    def cost(x):
        return jnp.abs(x - 0.3) + jnp.cos(40 * x) * 0.01, ()

    x, value, _ = lowest(cost, jnp.zeros(()), jnp.ones(()), samples=66, dips=3, steps=52)
    grid = np.linspace(0, 1, 200_001)
    assert value <= np.min(np.abs(grid - 0.3) + np.cos(40 * grid) * 0.01) + 1e-12
    assert 0 < x < 1
