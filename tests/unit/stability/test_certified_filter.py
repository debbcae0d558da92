"""The floating-point filter: its stated errors hold, and its two routes never contradict each other or the balls."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

import oracles
import zwidth
from zwidth.stability import balls, certified_crossover
from zwidth.stability.certified_crossover import crossover
from zwidth.stability.certified_filter import OPEN, STABLE, UNSTABLE, coefficients, device, recursion

pytestmark = pytest.mark.usefixtures("x64")

UNIT = 2.0**-53
DELTAS = np.array([0.0, 5e-324, 1e-300, 1e-16, 1e-8, 1e-3, 0.3, 1.0, 2.4999, 2.5, 2.51, 7.0, 50.0, 699.0, 750.0, 1e6])


def columns(count, seed, delta, d):
    """Walls around the stable set of one device."""
    rng = np.random.default_rng(seed)
    ridge = zwidth.alpha_max(delta, d)
    reach = abs(float(ridge.beta)) + delta
    alpha = float(ridge.alpha) * rng.uniform(0, 1.5, count)
    return jnp.asarray(alpha), jnp.asarray(rng.uniform(-1.2 * reach, 2.5 * reach, count))


def near_the_curve(delta, d, count, seed):
    """Walls at relative distances of 1e-4 to 1e-14 from the boundary."""
    rng = np.random.default_rng(seed)
    top = float(zwidth.alpha_max(delta, d).omega)
    wall = zwidth.boundary(top * rng.uniform(0.05, 1.0, count), delta, d)
    distance = 10 ** rng.uniform(-14, -4, count) * rng.choice([-1, 1], count)
    return jnp.asarray(np.asarray(wall.alpha) * (1 + distance)), jnp.asarray(np.asarray(wall.beta))


@partial(jax.jit, static_argnums=(4, 5))
def by_recursion(alpha, beta, delta, fraction, whole, fractional):
    return recursion(*coefficients(alpha, beta, device(delta, fraction, fractional), whole))


@partial(jax.jit, static_argnums=(5, 6))
def by_crossover(alpha, beta, delta, fraction, whole, fractional, edge):
    return crossover(alpha, beta, delta, whole, device(delta, fraction, fractional), True, edge)


def recursion_codes(alpha, beta, delta, d):
    fraction = d - int(d)
    return np.asarray(by_recursion(alpha, beta, jnp.full(1, delta), jnp.full(1, fraction), int(d), fraction > 0))


def crossover_codes(alpha, beta, delta, d, edge=False):
    fraction, whole = d - int(d), jnp.full(1, float(int(d)))
    return np.asarray(by_crossover(alpha, beta, jnp.full(1, delta), jnp.full(1, fraction), whole, fraction > 0, edge))


def test_whole_delay_device_errors_are_as_stated():
    plant = device(jnp.asarray(DELTAS), jnp.zeros(DELTAS.size), False)
    for index, delta in enumerate(DELTAS):
        with mp.workdps(oracles.digits_for(delta)):
            exact = oracles.phi(delta)
            assert oracles.relative_error(plant.c[index], exact.c, floor=1e-280) <= 8 * UNIT
            assert oracles.relative_error(plant.a2[index], exact.phi2) <= 20 * UNIT
            assert oracles.relative_error(plant.a1[index], exact.psi) <= 20 * UNIT


def test_phi_errors_are_as_stated_between():
    delta = 10 ** np.random.default_rng(5).uniform(-4, 3, 4000)
    plant = device(jnp.asarray(delta), jnp.zeros(delta.size), False)
    with mp.workdps(80):
        exact = [oracles.phi(x) for x in delta]
        for got, want, count in ((plant.c, 0, 8), (plant.a2, 2, 20), (plant.a1, 3, 20)):
            assert oracles.worst(got, [value[want] for value in exact], floor=1e-280) <= count * UNIT


@pytest.mark.parametrize("fraction", [5e-324, 1e-9, 0.2, 0.5, 0.83, 1.0 - 2.0**-53])
def test_held_fraction_device_errors_are_as_stated(fraction):
    plant = device(jnp.asarray(DELTAS), jnp.full(DELTAS.size, fraction), True)
    for index, delta in enumerate(DELTAS):
        with mp.workdps(max(oracles.WIDE, oracles.digits_for(delta)) if fraction < 1e-300 else 900):
            exact = oracles.numerator(delta, fraction)
            error = sum(abs(mpf(float(got[index])) - want) for got, want in zip(plant[1:], exact, strict=True))
            assert error <= 60 * UNIT * sum(exact)


@pytest.mark.parametrize("d", [0, 1, 2, 5, 12, 0.25, 0.5, 3.7, 12.6])
def test_routes_never_contradict_each_other(d):
    for delta in (0.0, 1e-4, 0.3, 3.7, 40.0, 800.0, 1e4):
        alpha, beta = columns(3000, 11, delta, d)
        first, second = recursion_codes(alpha, beta, delta, d), crossover_codes(alpha, beta, delta, d)
        both = (first != OPEN) & (second != OPEN)
        np.testing.assert_array_equal(first[both], second[both])
        assert both.mean() > 0.99


@pytest.mark.parametrize("d", [0, 1, 4, 12, 0.5, 1.3])
@pytest.mark.parametrize("delta", [1e-3, 1.0, 30.0])
def test_routes_never_contradict_balls_next_to_the_boundary(d, delta):
    alpha, beta = near_the_curve(delta, d, 60, seed=13)
    first, second = recursion_codes(alpha, beta, delta, d), crossover_codes(alpha, beta, delta, d)
    truth = [balls.decide(float(a), float(b), delta, float(d), 4096).stable for a, b in zip(alpha, beta, strict=True)]
    expected = np.where(truth, STABLE, UNSTABLE)
    for code in (first, second):
        np.testing.assert_array_equal(code[code != OPEN], expected[code != OPEN])
    # Both must refuse some: the nearest are beyond what float64 tells.
    assert (first == OPEN).any()
    assert (second == OPEN).any()


@pytest.mark.parametrize("d", [13, 20.5, 50, 200, 500.25])
@pytest.mark.parametrize("delta", [0.0, 0.1, 3.0, 1e3])
def test_crossover_never_contradicts_balls_at_long_delays(d, delta):
    far, near = columns(8, 17, delta, d), near_the_curve(delta, d, 12, seed=19)
    alpha, beta = (jnp.concatenate(pair) for pair in zip(far, near, strict=True))
    code = crossover_codes(alpha, beta, delta, d)
    for a, b, found in zip(alpha, beta, code, strict=True):
        if found != OPEN:
            assert balls.decide(float(a), float(b), delta, float(d), 8192).stable == (found == STABLE)
    assert (code[:8] != OPEN).all()
    assert (code == OPEN).any()


@pytest.mark.parametrize("d", [0, 1, 6, 0.5, 40, 40.5])
def test_edge_agrees_with_balls(d):
    rng = np.random.default_rng(23)
    seen = set()
    for delta in (0.0, 0.2, 5.0):
        beta = delta + rng.uniform(0, 4.0 + 2.0 * delta, 40) / (1.0 + d)
        code = crossover_codes(jnp.zeros(beta.size), jnp.asarray(beta), delta, d, edge=True)
        for b, found in zip(beta, code, strict=True):
            verdict = balls.decide(0.0, float(b), delta, float(d), 4096)
            assert found == OPEN or (found == STABLE) == (verdict.status == zwidth.Status.ON_BOUNDARY)
        assert (code != OPEN).mean() > 0.9
        seen.update(code.tolist())
    assert {STABLE, UNSTABLE} <= seen


def test_crossover_leaves_open_what_its_proof_does_not_cover():
    def code(alpha, beta, whole=20.0):
        return int(crossover_codes(jnp.full(1, alpha), jnp.full(1, beta), 0.1, whole)[0])

    assert code(1e-4, 0.05) == STABLE
    assert [code(a, b) for a, b in ((0.0, 0.05), (-1e-4, 0.05), (np.nan, 0.05), (1e-4, np.inf), (2.0**201, 1.0))] == (
        [OPEN] * 5
    )
    assert code(1e-4, 0.05, whole=2.0**31) == OPEN


def test_extremes_of_the_recursion_stay_open():
    nothing = jnp.asarray([np.nan, np.inf, -np.inf, 1e308, 1e200])
    code = recursion_codes(nothing, nothing, 0.5, 1.5)
    assert set(code.tolist()) <= {OPEN, UNSTABLE}
    assert (code[:3] == OPEN).all()


def test_own_elementary_functions():
    rng = np.random.default_rng(29)
    x = np.concatenate([10 ** rng.uniform(-250, 250, 20000), [1.0, 2.0, 0.5, 4.0]])
    root, inverse = certified_crossover._root, certified_crossover._inverse
    np.testing.assert_allclose(root(jnp.asarray(x)), np.sqrt(x), rtol=2.0**-50)
    np.testing.assert_allclose(inverse(jnp.asarray(-x)), -1 / x, rtol=2.0**-47)
    assert float(root(jnp.asarray(0.0))) == 0.0
    v, u = np.cos(rng.uniform(-np.pi, np.pi, 20000)), np.sin(rng.uniform(-np.pi, np.pi, 20000))
    angle = certified_crossover._angle
    np.testing.assert_allclose(angle(jnp.asarray(u), jnp.asarray(v)), np.arctan2(u, v), rtol=0, atol=2.0**-36)
    tiny = 10 ** rng.uniform(-100, -1, 2000)
    np.testing.assert_allclose(angle(jnp.asarray(tiny), jnp.asarray(1.0)), np.arctan(tiny), rtol=2.0**-35)
