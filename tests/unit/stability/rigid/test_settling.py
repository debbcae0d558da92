"""Settling times, computed from modes, against long simulations."""

import numpy as np
import pytest

import zwidth
from zwidth.stability.rigid.step_response import SETTLING_BAND, settling_time, step_response

# A light, lightly damped device near its ridge: a simulation of 100 periods ends inside the band by chance.
LIGHT = (0.06647088772544794, 0.29085403745877014, 0.014256791346175352, 2.0)


def last_outside(wall, periods, substeps):
    """Return the last simulated instant outside the band, or 0 if there is none."""
    run = step_response(*wall, periods=periods, substeps=substeps)
    outside = np.flatnonzero(np.abs(run.position / run.final_position - 1.0) > SETTLING_BAND)
    assert outside.size == 0 or outside[-1] < run.time.size - 1, "simulated too short"
    return run.time[outside[-1]] if outside.size else 0.0


def test_settling_time_is_independent_of_the_simulated_length():
    times = [step_response(*LIGHT, periods=periods).settling_time for periods in (1, 100, 1000)]
    assert times == [times[0]] * 3
    assert 0 <= times[0] - last_outside(LIGHT, 4000, 10) < 0.1
    assert times[0] == pytest.approx(2845.339, abs=1e-3)


def lightly_damped_walls(count):
    """Return walls at the beta of the ridge, close to its stiffness, with long oscillations."""
    random = np.random.default_rng(20)
    for _ in range(count):
        d = random.choice([0.0, 0.3, 1.0, 1.5, 2.0, 4.0, 8.2])
        delta = 10.0 ** random.uniform(-3, 1)
        ridge = zwidth.alpha_max(delta, d)
        wall = (float(ridge.alpha) * random.choice([0.3, 0.9, 0.97, 0.99]), float(ridge.beta), delta, d)
        if zwidth.is_stable(*wall):
            yield wall


def test_settling_time_agrees_with_long_simulations():
    for wall in lightly_damped_walls(60):
        settling = settling_time(*wall)
        # A peak between coarse instants may be the last one outside the band.
        coarse = last_outside(wall, int(2 * settling + 100), 10)
        assert coarse <= settling + 1e-9, wall
        if settling - coarse > 0.1:
            assert settling - last_outside(wall, int(settling + 2), 200) < 0.005, wall


@pytest.mark.parametrize(
    "wall", [(2.1953505327853247, 11.591324520071204, 40.0, 30.5), (0.6006660802493176, 91.07577583447727, 800.0, 1.7)]
)
def test_pole_near_zero_does_not_hide_the_settling_time(wall):
    """``z^-n`` of such a pole overflows, although its contribution decays within one period."""
    settling = settling_time(*wall)
    assert 0 <= settling - last_outside(wall, int(2 * settling + 100), 50) < 0.05


@pytest.mark.parametrize(
    "wall", [(3.0, 0.0, 0.0, 4.0), (0.0, 0.5, 0.5, 1.0), (0.2, 0.4, 0.1, 501.0), (-0.1, 0.4, 0.1, 1)]
)
def test_settling_time_is_nan_if_undefined_or_not_computed(wall):
    assert np.isnan(settling_time(*wall))


def test_settling_time_at_a_double_pole():
    # At the fastest damping two poles coincide, numerically only nearly.
    random = np.random.default_rng(22)
    for _ in range(10):
        delta = random.uniform(0.05, 1.0)
        alpha = 0.3 * float(zwidth.alpha_max(delta, 1.0).alpha)
        scene = zwidth.Scene(zwidth.Device(1.0, delta), zwidth.Timing(1.0, 1.0))
        wall = (alpha, scene.best_damping(alpha).virtual_damping, delta, 1.0)
        settling = settling_time(*wall)
        assert abs(settling - last_outside(wall, 400, 200)) < 0.006 or np.isnan(settling), wall
