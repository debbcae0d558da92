"""Test that a delay keeps the unit in which it was given, seconds or periods, if the period changes.

References: `alpha_max` of the normalized device, and finite differences.
"""

import jax
import numpy as np
import pytest

import zwidth

DEVICE = zwidth.Device(mass="100 g", damping="10 N s/m")
PERIODS = zwidth.Scene(DEVICE, zwidth.Timing(rate="1 kHz", delay="1 periods"))
SECONDS = zwidth.Scene(DEVICE, zwidth.Timing(rate="1 kHz", delay="1 ms"))
PARTS = {"rigid": {}, "filter": {"velocity": zwidth.LowPass(cutoff="100 Hz")}}


def stiffness_max(mass, damping, period, d):
    """Return K_max from alpha_max of the normalized device."""
    return float(zwidth.alpha_max(damping * period / mass, d).alpha) * mass / period**2


def test_delay_in_periods_is_constant_in_periods():
    faster = PERIODS.replace(rate=2000)
    assert (faster.d, faster.timing.delay) == (1.0, 0.5e-3)
    assert SECONDS.replace(rate=2000).d == 2.0
    # Further changes, and a new delay in seconds.
    assert PERIODS.replace(mass=0.2).replace(period=1 / 3).d == 1.0
    assert faster.replace(delay=0.5e-3).replace(rate=1000).d == 0.5


def test_repr_keeps_the_unit_of_the_delay():
    timing = zwidth.Timing(rate="4 kHz", delay="1.5 periods")
    restored = eval(repr(timing), {"Timing": zwidth.Timing})
    assert restored.in_periods
    assert restored.d == 1.5
    assert repr(SECONDS.timing) == "Timing(period=0.001, delay=0.001)"


@pytest.mark.parametrize("parts", PARTS.values(), ids=PARTS)
@pytest.mark.parametrize("scene", [PERIODS, SECONDS], ids=["periods", "seconds"])
def test_sensitivity_to_period_matches_difference(scene, parts):
    scene, step = scene.replace(**parts), 1e-9
    low, high = (scene.replace(period=1e-3 + side * step).max_stiffness().stiffness for side in (-1, 1))
    # A central difference of K_max, with a rounding error of about 1e-13 K_max/step.
    assert scene.sensitivities().per["period"] == pytest.approx((high - low) / (2 * step), rel=1e-5)


def test_required_rate_matches_alpha_max():
    rate = PERIODS.required("rate", "30 kN/m").value
    assert stiffness_max(0.1, 10, 1 / rate, 1.0) == pytest.approx(30e3, rel=1e-9)
    rate = SECONDS.required("rate", "30 kN/m").value
    assert stiffness_max(0.1, 10, 1 / rate, 1e-3 * rate) == pytest.approx(30e3, rel=1e-9)


@pytest.mark.parametrize("parts", PARTS.values(), ids=PARTS)
def test_tolerances_of_period_and_delay(parts):
    scene = PERIODS.replace(stiffness="16 kN/m", virtual_damping=30.0, **parts)
    simulation = zwidth.simulate_tolerances(scene, {"period": 0.2, "delay": 0.2}, samples=40)
    draws = simulation.drawn
    for k, stable in enumerate(simulation.labels):
        timing = zwidth.Timing(period=draws["period"][k], delay=draws["delay"][k])
        assert bool(scene.replace(timing=timing).is_stable()) == stable
    ratio = draws["delay"] / draws["period"]
    assert np.all((ratio > 0.8) & (ratio < 1.2))
    period_only = zwidth.simulate_tolerances(scene, {"period": 0.2}, samples=40)
    for period, stable in zip(period_only.drawn["period"], period_only.labels, strict=True):
        timing = zwidth.Timing(period=period, delay="1 periods")
        assert bool(scene.replace(timing=timing).is_stable()) == stable


def test_gradient_in_the_period_equals_sensitivity():
    jax = pytest.importorskip("jax")
    with jax.enable_x64(True):
        for scene in (PERIODS, SECONDS):
            slope = jax.grad(lambda period, scene=scene: scene.replace(period=period).max_stiffness().stiffness)(1e-3)
            assert float(slope) == pytest.approx(scene.sensitivities().per["period"], rel=1e-9)


def test_a_gradient_prints_no_delay_in_periods(x64):
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing("1 ms", "1.3 periods"))
    gradient = jax.grad(lambda scene: scene.max_stiffness().stiffness)(scene)
    derivative = gradient.timing.span.value
    step = 1e-6
    ends = [scene.replace(delay=f"{1.3 + k * step} periods").max_stiffness().stiffness for k in (-1, 1)]
    assert float(derivative) == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-4)
    assert gradient.timing.delay == derivative
    assert "periods" not in repr(gradient)
    moved = jax.tree.map(lambda value, slope: value + 1e-16 * slope, scene, gradient)
    assert "periods" in repr(moved)
    assert float(moved.timing.delay) == pytest.approx(1.3e-3, rel=1e-4)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((1e-3, 1), "delay is 1 s, an implausible value; did you mean delay='1 ms' or delay='1 periods'"),
        ((1 / 8e3, 1.5), "delay is 1.5 s, an implausible value; did you mean delay='1.5 ms' or delay='1.5 periods'"),
        ((1000,), "period is 1000 s, an implausible value; did you mean rate='1000 Hz'"),
    ],
)
def test_plain_numbers_of_another_unit_cause_a_warning(arguments, message):
    with pytest.warns(UserWarning, match=message) as record:
        timing = zwidth.Timing(*arguments)
    assert [each.filename for each in record] == [__file__]
    assert timing.period == arguments[0]


def test_long_values_with_units_cause_no_warning():
    timing = zwidth.Timing("1 ms", "1 s")
    scene = zwidth.Scene(zwidth.Device(0.1, 10), timing).replace(mass=0.2)
    assert scene.timing.delay == 1
    assert zwidth.Timing(0.1, 1).d == 10
    assert zwidth.Timing(1, 60).d == 60
    assert zwidth.Timing("1000 s").period == 1000
