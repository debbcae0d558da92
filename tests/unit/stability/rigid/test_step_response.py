"""Step responses against simulations by matrix exponentials."""

import numpy as np
import pytest
import tolerances as tol

import zwidth
from peers import models
from zwidth.core.errors import InputError
from zwidth.stability.rigid.step_response import step_response

STABLE = [
    (0.108, 0.425, 0.0, 1.0),
    (0.149, 0.416, 0.1, 1.0),
    (0.656, 0.388, 1.0, 1.0),
    (0.4, 0.5, 0.0, 0.0),
    (3.0, -0.2, 2.0, 0.0),
    (0.1, 0.3, 0.3, 0.125),
    (0.2, 0.3, 0.5, 0.9),
    (0.05, 0.2, 0.1, 2.6),
    (0.01, 0.1, 0.5, 8.0),
]


def assert_close(got, expected, tolerance):
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance.float64 * np.abs(expected).max())


@pytest.mark.parametrize("wall", STABLE)
def test_response_agrees_with_matrix_exponentials(wall):
    alpha, beta, delta, d = wall
    got = step_response(*wall, periods=120, substeps=4, force=2.0)
    position, velocity, wall_force = models.simulate(1.0, delta, 1.0, alpha, beta, d, 2.0, np.arange(4) / 4, 120)
    assert_close(got.position, position, tol.RESPONSE)
    assert_close(got.velocity, velocity, tol.RESPONSE)
    assert_close(got.wall_force, wall_force, tol.RESPONSE)


def test_examples_of_the_paper_settle_at_the_static_deflection():
    for wall in STABLE[:3]:
        got = step_response(*wall, periods=400)
        assert got.final_position == 1 / wall[0]
        assert got.position[-1] == pytest.approx(got.final_position, rel=1e-3)
        after = got.time > got.settling_time
        assert np.abs(got.position[after] / got.final_position - 1).max() <= 0.02
        assert abs(got.position[np.flatnonzero(~after)[-1]] / got.final_position - 1) > 0.02


def test_stronger_damping_settles_earlier():
    settling = [step_response(*wall, periods=400).settling_time for wall in STABLE[:3]]
    assert settling[2] < settling[1] < settling[0]


def test_wall_force_is_zero_before_the_delay():
    got = step_response(0.1, 0.3, 0.2, 2.5, periods=6, substeps=2)
    # Sample 1 has the first deflection; its force acts from 1 + 2.5 on.
    np.testing.assert_array_equal(got.wall_force != 0, got.time >= 3.5)
    free = models.simulate(1.0, 0.2, 1.0, 0.0, 0.0, 0.0, 1.0, [0.0, 0.5], 6)[0]
    assert_close(got.position[got.time <= 3.5], free[got.time <= 3.5], tol.RESPONSE)


def test_response_scales_with_the_force():
    # Scale by a power of two, which causes no rounding errors.
    one, three = (step_response(0.1, 0.3, 0.2, 0.5, force=force) for force in (1.0, -4.0))
    np.testing.assert_array_equal(-4.0 * one.position, three.position)
    assert three.settling_time == one.settling_time


def test_unstable_response_overflows_without_a_warning():
    got = step_response(3.0, 0.0, 0.0, 4.0, periods=4000, substeps=1)
    assert np.abs(got.position[:100]).max() > 1e3
    assert not np.isfinite(got.position[-1])
    assert np.isnan(got.settling_time)


def test_zero_stiffness_has_no_final_position():
    for alpha in (0.0, -0.0):
        got = step_response(alpha, 0.5, 0.5, 1)
        assert np.isnan(got.final_position)
        assert np.isnan(got.settling_time)
        # The final velocity is force/(damping + virtual damping).
        assert got.velocity[-1] == pytest.approx(1.0, rel=1e-6)
    assert step_response(np.float64(5e-324), 0.5, 0.5, 1).final_position == np.inf


def test_response_of_a_scene_in_si_units():
    device = zwidth.Device(mass=0.1, damping=10.0)
    scene = zwidth.Scene(device, zwidth.Timing(period=1e-3, delay=1.5e-3), zwidth.VirtualWall(8e3, 30.0))
    raw = step_response(*map(float, scene.normalized), periods=100, substeps=2, force=3.0)
    expected = models.simulate(0.1, 10.0, 1e-3, 8e3, 30.0, 1.5, 3.0, [0.0, 0.5], 100)
    # The unit of length is T^2/m for 1 N, the unit of time T.
    got = (raw.position * 1e-3**2 / 0.1, raw.velocity * 1e-3 / 0.1, raw.wall_force)
    for value, true in zip(got, expected, strict=True):
        assert_close(value, true, tol.RESPONSE)
    assert raw.final_position * 1e-3**2 / 0.1 == pytest.approx(3.0 / 8e3, rel=1e-14)
    assert raw.time[-1] == 99.5


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"delta": -1e-9}, r"delta: got -1e-09; a single finite number of at least 0"),
        ({"d": -1}, r"d: got -1; a single finite number of at least 0"),
        ({"alpha": np.nan}, r"alpha: got nan; a single finite number is needed"),
        ({"beta": [1.0, 2.0]}, r"beta: got \[1.0, 2.0\]; a single finite number is needed"),
        ({"force": np.inf}, r"force: got inf; a single finite number is needed"),
        ({"alpha": "1"}, r"alpha: got '1', a real number"),
        ({"alpha": 1j}, r"alpha: got 1j, a real number"),
        ({"periods": 0}, r"periods: got 0; it must be a whole number from 1 to 10000000"),
        ({"periods": 10**400}, r"periods: got 1000"),
        ({"periods": True}, r"periods: got True"),
        ({"substeps": 2.5}, r"substeps: got 2.5"),
    ],
)
def test_invalid_arguments_raise(changes, message):
    arguments = {"alpha": 0.1, "beta": 0.1, "delta": 0.1, "d": 1} | changes
    with pytest.raises(InputError, match=message):
        step_response(**arguments)
