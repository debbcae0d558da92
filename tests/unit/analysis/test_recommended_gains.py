"""Recommended gains of motor controllers: stable, with the required margins, as the user sets them."""

from __future__ import annotations

from dataclasses import replace

import pytest

import zwidth
from zwidth.core.errors import InputError

MOTOR, TIMING = zwidth.Device("1e-4 kg m^2", "1e-4 N m s/rad"), zwidth.Timing(rate="8 kHz", delay="1.5 periods")


@pytest.mark.parametrize("integrator", [0.3, 3])
def test_an_odrive_with_integrator_satisfies_the_requirements_as_set(integrator):
    parts = {"position": zwidth.Pll(1000), "rule": "forward"}
    scene = zwidth.Scene(MOTOR, TIMING, **zwidth.cascade(20, 0.16, integrator, **parts))
    advice = scene.recommend()
    pos_gain, vel_gain, vel_integrator_gain = advice.cascade_gains()
    assert vel_integrator_gain == pytest.approx(integrator)
    # Build the controller as the user sets it, from the printed gains.
    gains = (float(f"{gain:.6g}") for gain in (pos_gain, vel_gain, vel_integrator_gain))
    controller = zwidth.Scene(MOTOR, TIMING, **zwidth.cascade(*gains, **parts))
    assert controller.is_stable()
    margins = controller.margins()
    assert margins.phase_margin >= 30 - 1e-3
    assert margins.gain_margin >= 2 - 1e-4
    # The stiffness is the largest: 1 % more of pos_gain violates the phase margin.
    stiffer = zwidth.Scene(MOTOR, TIMING, **zwidth.cascade(1.01 * pos_gain, vel_gain, integrator, **parts))
    assert stiffer.margins().phase_margin < 30


def test_the_integrator_of_the_recommended_scene_contains_the_recommended_pos_gain():
    scene = zwidth.Scene(MOTOR, TIMING, **zwidth.cascade(20, 0.16, 1))
    advice = scene.recommend(stiffness_fraction=0.2)
    assert advice.scene.feedback.position == pytest.approx(advice.stiffness / advice.virtual_damping, rel=1e-12)
    assert advice.cascade_gains("rad").vel_gain == pytest.approx(advice.virtual_damping)
    assert advice.as_dict()["recommended"]["stable"]


def test_a_cascade_without_integrator_and_a_pid_are_recommended_as_before():
    plain = zwidth.Scene(MOTOR, TIMING).recommend(stiffness_fraction=0.3)
    cascade = zwidth.Scene(MOTOR, TIMING, **zwidth.cascade(20, 0.16)).recommend(stiffness_fraction=0.3)
    assert cascade.stiffness == plain.stiffness
    assert cascade.cascade_gains("rad", 0.5).vel_gain == pytest.approx(2 * plain.virtual_damping)
    pid = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing("1 ms"), **zwidth.pid(1000, 2000, 10))
    advice = pid.recommend(stiffness_fraction=0.3)
    assert advice.pid_gains() == pytest.approx((advice.stiffness, 2000, advice.virtual_damping))
    with pytest.raises(InputError, match="require the integrator of a cascade"):
        advice.cascade_gains()


def test_gains_that_belong_to_another_controller_are_refused():
    scene = zwidth.Scene(MOTOR, TIMING, **zwidth.cascade(20, 0.16, 0.3))
    advice = scene.recommend(stiffness_fraction=0.2)
    with pytest.raises(InputError, match="require an integral of the position"):
        advice.pid_gains()
    other = replace(advice, scene=advice.scene.replace(**{"feedback.position": 20}))
    with pytest.raises(InputError, match="pos_gain = K/B"):
        other.cascade_gains()
    unstable = zwidth.Scene(MOTOR, TIMING, **zwidth.cascade(20, 0.16, 1e4)).recommend()
    with pytest.raises(InputError, match="there is no wall"):
        unstable.cascade_gains()


def test_the_result_does_not_depend_on_the_given_pos_gain():
    def recommend(pos_gain):
        return zwidth.Scene(MOTOR, TIMING, **zwidth.cascade(pos_gain, 0.16, 10)).recommend(phase_margin=50)

    low, high = recommend(20), recommend(20_000)
    assert high.stiffness == pytest.approx(low.stiffness, rel=1e-3)
    assert high.cascade_gains() == pytest.approx(low.cascade_gains(), rel=0.01)


@pytest.mark.parametrize(
    "make", [lambda wrong: zwidth.cascade(20, 0.1, position=wrong), lambda wrong: zwidth.pid(9, position=wrong)]
)
def test_position_estimate_must_be_an_object(make):
    with pytest.raises(InputError, match=r"position: got 1000; pass an object such as zwidth.Pll"):
        make(1000)
