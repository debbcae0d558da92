"""A delay keeps the unit in which it was given, seconds or periods, if the period changes."""

import numpy as np
import pytest

import zwidth

DEVICE = zwidth.Device(mass="100 g", damping="10 N s/m")
PERIODS = zwidth.Scene(DEVICE, zwidth.Timing(rate="1 kHz", delay="1 periods"))
SECONDS = zwidth.Scene(DEVICE, zwidth.Timing(rate="1 kHz", delay="1 ms"))
PARTS = {"rigid": {}, "filter": {"velocity": zwidth.LowPass(cutoff="100 Hz")}}


def stiffness_max(mass, damping, period, d):
    """K_max from alpha_max of the normalized device."""
    return float(zwidth.alpha_max(damping * period / mass, d).alpha) * mass / period**2


def test_a_delay_in_periods_stays_in_periods():
    faster = PERIODS.replace(rate=2000)
    assert (faster.d, faster.timing.delay) == (1.0, 0.5e-3)
    assert SECONDS.replace(rate=2000).d == 2.0
    # Further changes, and a new delay in seconds.
    assert PERIODS.replace(mass=0.2).replace(period=1 / 3).d == 1.0
    assert faster.replace(delay=0.5e-3).replace(rate=1000).d == 0.5


def test_the_repr_keeps_the_unit():
    timing = zwidth.Timing(rate="4 kHz", delay="1.5 periods")
    again = eval(repr(timing), {"Timing": zwidth.Timing})
    assert again.in_periods
    assert again.d == 1.5
    assert repr(SECONDS.timing) == "Timing(period=0.001, delay=0.001)"


@pytest.mark.parametrize("parts", PARTS.values(), ids=PARTS)
@pytest.mark.parametrize("scene", [PERIODS, SECONDS], ids=["periods", "seconds"])
def test_sensitivity_to_the_period(scene, parts):
    scene, step = scene.replace(**parts), 1e-9
    low, high = (scene.replace(period=1e-3 + side * step).max_stiffness().stiffness for side in (-1, 1))
    # A central difference of K_max; its rounding error is some 1e-13 K_max / step.
    assert scene.sensitivities().per["period"] == pytest.approx((high - low) / (2 * step), rel=1e-5)


def test_the_rate_needed_for_a_stiffness():
    needed = PERIODS.required("rate", "30 kN/m").value
    assert stiffness_max(0.1, 10, 1 / needed, 1.0) == pytest.approx(30e3, rel=1e-9)
    needed = SECONDS.required("rate", "30 kN/m").value
    assert stiffness_max(0.1, 10, 1 / needed, 1e-3 * needed) == pytest.approx(30e3, rel=1e-9)


@pytest.mark.parametrize("parts", PARTS.values(), ids=PARTS)
def test_tolerances_of_the_period(parts):
    scene = PERIODS.replace(stiffness="16 kN/m", virtual_damping=30.0, **parts)
    found = zwidth.simulate_tolerances(scene, {"period": 0.2, "delay": 0.2}, samples=40)
    drawn = found.drawn
    for k, stable in enumerate(found.labels):
        timing = zwidth.Timing(period=drawn["period"][k], delay=drawn["delay"][k])
        assert bool(scene.replace(timing=timing).is_stable()) == stable
    ratio = drawn["delay"] / drawn["period"]
    assert np.all((ratio > 0.8) & (ratio < 1.2))
    only = zwidth.simulate_tolerances(scene, {"period": 0.2}, samples=40)
    for period, stable in zip(only.drawn["period"], only.labels, strict=True):
        timing = zwidth.Timing(period=period, delay="1 periods")
        assert bool(scene.replace(timing=timing).is_stable()) == stable


def test_gradient_in_the_period():
    jax = pytest.importorskip("jax")
    with jax.enable_x64(True):
        for scene in (PERIODS, SECONDS):
            slope = jax.grad(lambda period, scene=scene: scene.replace(period=period).max_stiffness().stiffness)(1e-3)
            assert float(slope) == pytest.approx(scene.sensitivities().per["period"], rel=1e-9)
