"""The discretized mass, and the paper's transfer functions computed from it, against the printed formulas in mpmath."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances as tol
from mpmath import mp, mpf

import oracles
from zwidth.plant.rigid_mass import discretize_mass, phi_functions, split_delay

FRACTIONS = [0.0, 1e-300, 1e-16, 1e-8, 0.125, 0.25, 0.37, 0.5, 0.75, 0.9, 1 - 2.0**-30, 1 - 2.0**-53]
DAMPINGS = [0.0, 1e-300, 1e-16, 1e-8, 1e-3, 0.1, 1.0, 2.31, 2.5, 3.0, 8.0, 30.0, 700.0, 1e4, 1e6]
GRID = np.array([(delta, fraction) for delta in DAMPINGS for fraction in FRACTIONS])


def digits(delta, fraction):
    """Return digits sufficient for 1 - f, f and the cancellation in delta."""
    return oracles.digits_for(delta) + oracles.digits_for(fraction)


@pytest.fixture(scope="module")
def plants():
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(discretize_mass))(*jnp.asarray(GRID).T))


def test_gap_is_the_numerator_at_minus_one(plants):
    for row, (delta, fraction) in enumerate(GRID):
        with mp.workdps(digits(delta, fraction)):
            a2, a1, a0 = oracles.numerator(delta, fraction)
            # The gap changes sign with the fraction, so its error is relative to the sum of its terms.
            error = abs(mpf(float(plants.gap[row])) - (a2 - a1 + a0)) / (a2 + a1 + a0)
        assert error <= tol.PLANT.float64, (delta, fraction)


def test_c_and_one_minus_c_are_accurate(plants):
    for row, (delta, _) in enumerate(GRID):
        with mp.workdps(oracles.digits_for(delta)):
            assert oracles.relative_error(plants.em[row], 1 - mp.exp(-mpf(delta))) <= tol.PLANT.float64
            assert oracles.relative_error(plants.c[row], mp.exp(-mpf(delta)), floor=1e-290) <= tol.PLANT.float64


@pytest.mark.parametrize(
    "d, n_expected, fraction",
    [
        (0.0, 0, 0.0),
        (2.0, 2, 0.0),
        (2.25, 2, 0.25),
        (1e-300, 0, 1e-300),
        (1 - 2.0**-53, 0, 1 - 2.0**-53),
        (500.5, 500, 0.5),
    ],
)
def test_split_delay_is_exact(d, n_expected, fraction, x64):
    n, f = split_delay(np.float64(d))
    assert (float(n), float(f)) == (n_expected, fraction)


PHYSICAL = [(0.1, 10.0, 1e-3), (0.1, 100.0, 1e-3), (2.0, 1e-9, 5e-4), (0.045, 300.0, 2e-2)]


def transfers(mass, damping, period):
    """Return numerators and denominators of the paper's H_v and H_x, from held force in N to sampled velocity and
    position.
    """
    delta = np.float64(damping * period / mass)
    plant = discretize_mass(delta)
    gain = period * period / mass
    velocity = [period / mass * phi_functions(delta).phi1], [1.0, -plant.c]
    return velocity, ([gain * plant.a2, gain * plant.a1], [1.0, -(1.0 + plant.c), plant.c])


@pytest.mark.parametrize("mass, damping, period", PHYSICAL)
def test_transfer_functions_are_eqs_5_and_9(mass, damping, period):
    velocity, position = transfers(mass, damping, period)
    allowed = tol.TRANSFER.float64 * (1 + damping * period / mass)
    with mp.workdps(60):
        m, b, T = mpf(mass), mpf(damping), mpf(period)
        c = mp.exp(-T * b / m)
        assert oracles.worst(velocity[0], [(1 - c) / b]) <= tol.TRANSFER.float64
        assert oracles.worst(velocity[1], [mpf(1), -c]) <= allowed
        # (T b (z - c) + m (1 - z)(1 - c))/b^2
        numerator = [(T * b - m * (1 - c)) / b**2, (-T * b * c + m * (1 - c)) / b**2]
        assert oracles.worst(position[0], numerator) <= tol.TRANSFER.float64
        assert oracles.worst(position[1], [mpf(1), -(1 + c), c]) <= allowed


def test_undamped_transfer_functions_are_eqs_12_and_13():
    mass, period = 0.25, 1 / 512
    velocity, position = transfers(mass, 0.0, period)
    # All values are powers of two: no rounding errors.
    np.testing.assert_array_equal(velocity[0], [period / mass])
    np.testing.assert_array_equal(velocity[1], [1, -1])
    np.testing.assert_array_equal(position[0], [period**2 / (2 * mass)] * 2)
    np.testing.assert_array_equal(position[1], [1, -2, 1])
