"""Position estimates and further feedback: definitions, refusals, and the parts that `pid` and `cascade` return."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest
from program_loop import Pll, find_filter

import zwidth
from zwidth.core.errors import InputError
from zwidth.model.circle_functions import circle_points
from zwidth.model.position import estimate_position

DEVICE, TIMING = zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3)
T = 1e-3
untyped: Any = zwidth  # for arguments of wrong types
ANGLES = np.array([0.05, 0.7, 2.9])


@pytest.mark.parametrize(
    "part",
    [
        zwidth.ExponentialFilter(0.3),
        zwidth.ExponentialFilter(coefficient=1),
        zwidth.ExponentialFilter(time_constant="2 ms"),
        zwidth.ExponentialFilter(cutoff="50 Hz"),
        zwidth.LowPass(cutoff=80, order=2),
        zwidth.Butterworth(cutoff=80, order=3),
        zwidth.PositionFilter([0.5, 0.3, 0.2], [1, 0, 0]),
    ],
    ids=repr,
)
def test_the_response_is_that_of_the_program(part):
    program = find_filter(part, T)
    z = np.exp(1j * ANGLES)
    expected = np.polyval(program.b, z) / np.polyval(program.a, z)
    response = estimate_position(part, T).jet(circle_points(ANGLES)).value
    np.testing.assert_allclose(response, expected, rtol=1e-12)


def test_a_coded_period_changes_the_filter_but_not_its_gain():
    part = zwidth.LowPass(cutoff=50, coded_period=2e-3)
    assert estimate_position(part, T).jet(circle_points(np.zeros(1))).value[0] == pytest.approx(1.0, rel=1e-14)


def test_the_definition_of_simplefoc():
    assert zwidth.ExponentialFilter.simplefoc(5e-3, 1e-3).coefficient == pytest.approx(1 / 6)


def test_the_response_of_a_pll_is_that_of_its_statements():
    pll, program = zwidth.Pll(bandwidth=300), Pll(300, T)
    z, step = np.exp(1j * ANGLES[1]), program.step
    matrix = np.array([step(unit, 0.0)[0] for unit in np.eye(2)]).T
    new, _ = step(np.zeros(2), 1.0)
    state = np.linalg.solve(z * np.eye(2) - matrix, new)
    # The estimates are the states after the period, i.e. the next states.
    points = circle_points(ANGLES[1:2])
    assert estimate_position(pll, T).jet(points).value[0] == pytest.approx(z * state[0], rel=1e-12)
    assert pll.estimate_velocity(T).jet(points).value[0] / T == pytest.approx(z * state[1], rel=1e-12)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: zwidth.ExponentialFilter(), "got none of coefficient, time_constant, cutoff"),
        (lambda: zwidth.ExponentialFilter(0.3, cutoff=50), "got coefficient and cutoff"),
        (lambda: zwidth.ExponentialFilter(1.5), "position.coefficient: got 1.5"),
        (lambda: untyped.ExponentialFilter(0.3, velocity_from="sensor"), "position.velocity_from"),
        (lambda: zwidth.PositionFilter([1, 0], [1]), "position.numerator: got degree 1"),
        (lambda: zwidth.PositionFilter([1], [1, -1]), "position.denominator: got a pole of magnitude 1;"),
        (lambda: zwidth.Observer([1, 0, 0], [1], [1, 0]), "position.position: got degree 2"),
        (lambda: zwidth.Observer([1], [1, 0, 0, 0], [1, 0]), "position.velocity: got degree 3"),
        (lambda: untyped.Observer([1], ["a"], [1, 0]), "position.velocity: got ['a']"),
        (lambda: zwidth.Feedback([1, 2], [1]), "feedback.numerator: got degree 1"),
        (lambda: untyped.IntegralFeedback(1, rule="euler"), "feedback.rule"),
        (lambda: untyped.Scene(DEVICE, TIMING, position=zwidth.BackwardDifference()), "position: got"),
        (lambda: untyped.Scene(DEVICE, TIMING, feedback=zwidth.LowPass(cutoff=50)), "feedback: got"),
        (
            lambda: zwidth.Scene(DEVICE, TIMING, velocity=zwidth.LowPass(cutoff=50), position=zwidth.Pll(300)),
            "has its own velocity estimate; omit velocity",
        ),
        (lambda: zwidth.cascade(20, 1, position=zwidth.Pll(300), velocity=zwidth.LowPass(cutoff=50)), "omit velocity"),
        (lambda: zwidth.cascade_gains(10, 0), "virtual_damping: got 0"),
        (lambda: untyped.pid(1, units="inches"), "units"),
        (lambda: untyped.pid("10 N/m"), "kp: got the text '10 N/m'"),
        (
            lambda: zwidth.Scene(DEVICE, TIMING, position=zwidth.Pll(900)).is_stable(1, 1),
            "position.bandwidth: got 900 rad/s; the PLL is unstable from 828.427 rad/s on",
        ),
        (
            lambda: zwidth.Scene(DEVICE, TIMING, position=zwidth.ExponentialFilter(cutoff=600)).is_stable(1, 1),
            "position.cutoff: got 600 Hz",
        ),
        (
            lambda: zwidth.Scene(
                DEVICE, TIMING, position=zwidth.PositionFilter([0.5, 0.5], [1, 0], velocity_from="measured")
            ).is_stable(1, 1),
            "position: the filter has a zero on the unit circle",
        ),
    ],
)  # fmt: skip
def test_refusals(make, message):
    with pytest.raises(InputError) as error:
        make()
    assert message in str(error.value)


def test_a_scene_lists_and_replaces_the_parameters_of_its_estimates():
    scene = zwidth.Scene(
        DEVICE, TIMING, position=zwidth.ExponentialFilter(cutoff=100), feedback=zwidth.Feedback.integral(500)
    )
    parameters = scene.parameters()
    assert (parameters["position.cutoff"], parameters["feedback.gain"]) == (100.0, 500.0)
    changed = scene.replace(**{"position.cutoff": 50, "feedback.gain": 0})
    assert changed.position == zwidth.ExponentialFilter(cutoff=50)
    assert eval(repr(changed), dict(vars(zwidth))) == changed


def test_a_cascade_converts_to_a_wall_and_back():
    controller = zwidth.cascade(pos_gain=20, vel_gain=0.16, vel_integrator_gain=0.3)
    wall = controller.wall
    assert wall.stiffness == pytest.approx(20 * 0.16 / (2 * np.pi))
    assert wall.virtual_damping == pytest.approx(0.16 / (2 * np.pi))
    gains = zwidth.cascade_gains(wall.stiffness, wall.virtual_damping)
    assert gains == pytest.approx((20, 0.16, 0.0))
    scene = zwidth.Scene(zwidth.Device("1e-4 kg m^2", "1e-4 N m s/rad"), zwidth.Timing(rate=8000), **controller)
    assert scene.feedback == controller.feedback


@pytest.mark.parametrize("units", ["m", "rad", "turns", "degrees"])
def test_a_pid_controller_converts_to_a_wall_and_back(units):
    controller = zwidth.pid(3, 4, 0.5, units=units, output_unit=0.05, derivative_filter=1e-3)
    assert controller.velocity == zwidth.LowPass(time_constant=1e-3)
    wall, feedback = controller.wall, controller.feedback
    assert feedback is not None
    gains = zwidth.pid_gains(wall.stiffness, wall.virtual_damping, feedback.gain, units=units, output_unit=0.05)
    assert gains == pytest.approx((3, 4, 0.5))


def test_a_pid_controller_inside_jit(x64):
    def radius(ki):
        return zwidth.Scene(zwidth.Device(0.1, 0), zwidth.Timing(1e-3), **zwidth.pid(1000, ki, 10)).spectral_radius()

    assert float(jax.jit(radius)(2000.0)) == pytest.approx(radius(2000), rel=1e-12)


def test_a_pid_controller_without_integral_has_no_feedback():
    assert zwidth.pid(1000, kd=10).feedback is None
