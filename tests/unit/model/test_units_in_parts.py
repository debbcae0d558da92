"""Test that parts and functions accept strings with units, with the same results as values in SI units."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

import zwidth
from zwidth.model.checks import Span


def test_parts_accept_strings_with_units():
    assert zwidth.Device(mass="70 g", damping="3 mN s/mm") == zwidth.Device(mass=0.07, damping=3.0)
    assert zwidth.Timing(rate="4 kHz", delay="0.3 ms") == zwidth.Timing(period=0.25e-3, delay=0.3e-3)
    assert zwidth.Timing("1 ms").period == 1e-3
    assert zwidth.LowPass(cutoff="0.1 kHz") == zwidth.LowPass(cutoff=100)
    assert zwidth.LowPass(time_constant="5 ms", coded_period="100 us").coded_period == 1e-4
    tip = zwidth.Coupling(mass="50 g", stiffness="20 kN/m", damping="1 N s/m")
    assert tip == zwidth.Coupling(mass=0.05, stiffness=20e3, damping=1.0)
    assert zwidth.Operator(mass="554 g", coupling_stiffness="1 N/mm").coupling_stiffness == 1e3
    assert zwidth.VirtualWall("5 kN/m", "10 N s/m") == zwidth.VirtualWall(5e3, 10.0)


# For some of these pairs, delay/period differs from the number of periods by a rounding error.
@pytest.mark.parametrize("periods", [0.1, 0.3, 1.0, 1.1, 2.7, 11.0, 123.4])
@pytest.mark.parametrize("rate", [1e3, 3e3, 7e3, 44100.0])
def test_delay_in_periods_is_exact(periods, rate):
    timing = zwidth.Timing(rate=rate, delay=f"{periods} periods")
    scene = zwidth.Scene(zwidth.Device(0.1), timing)
    assert timing.d == scene.d == scene.normalized.d == periods
    assert timing.delay == periods * timing.period
    assert zwidth.Timing(rate=rate, delay=Span(periods, "periods")).d == periods


def test_delay_in_seconds_is_divided_by_the_period():
    assert zwidth.Timing(1e-4, 1.1e-3).d == 11.0
    changed = dataclasses.replace(zwidth.Timing(1e-3, "2 periods"), delay=0.5e-3)
    assert changed.d == 0.5


def test_delay_in_periods_of_a_traced_period():
    d = []

    def seconds(period):
        timing = zwidth.Timing(period, "1.5 periods")
        d.append(timing.d)
        return timing.delay

    assert jax.grad(seconds)(1e-3) == 1.5
    assert d == [1.5]


def test_functions_accept_strings_with_units():
    values: dict[str, Any] = {"mass": 0.07, "damping": 10.0, "period": 1e-3, "delay": 1.5e-3}
    texts: dict[str, Any] = {"mass": "70 g", "damping": "10 N s/m", "period": "1 ms", "delay": "1.5 periods"}
    assert zwidth.max_stiffness(**texts) == zwidth.max_stiffness(**values)
    assert zwidth.sensitivities(**texts) == zwidth.sensitivities(**values)
    assert zwidth.normalize(**texts, stiffness="5 kN/m") == zwidth.normalize(**values, stiffness=5e3)
    worst = zwidth.robust_max_stiffness(mass=zwidth.Interval("60 g", "80 g"), period="1 ms", delay="1 periods")
    assert worst == zwidth.robust_max_stiffness(mass=zwidth.Interval(0.06, 0.08), period=1e-3, delay=1e-3)
    arrays = zwidth.max_stiffness(mass=np.array([0.07, 0.1]), period="1 ms")
    assert arrays[0] == zwidth.max_stiffness(mass=0.07, period=1e-3)


SCENE = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1e-3))
# Each function with strings and with values.
FUNCTIONS = {
    "is_stable": (lambda *wall: SCENE.is_stable(*wall), ("10 kN/m", 40), (10e3, 40)),
    "a list": (lambda *wall: SCENE.is_stable(*wall), (["10 kN/m", 30e3], "40 N s/m"), ([10e3, 30e3], 40)),
    "an array": (lambda *wall: SCENE.is_stable(*wall), (np.array(["10 kN/m"]), 40), (np.array([10e3]), 40)),
    "poles": (lambda *wall: SCENE.poles(*wall), ("10 N/mm", "40 N s/m"), (10e3, 40)),
    "margins": (lambda *wall: SCENE.margins(*wall), ("10 kN/m", "0.04 kN s/m"), (10e3, 40)),
    "stable_stiffness": (lambda B: SCENE.stable_stiffness(B), ("40 N s/m",), (40,)),
    "stable_damping": (lambda K: SCENE.stable_damping(K), ("10 kN/m",), (10e3,)),
    "best_damping": (lambda K: SCENE.best_damping(K), ("10 kN/m",), (10e3,)),
    "required": (
        lambda K, within: SCENE.required("damping", K, within=within).value,
        ("25 kN/m", ("1 N s/m", "0.1 kN s/m")),
        (25e3, (1, 100)),
    ),
    "frequency_response": (
        lambda *arguments: SCENE.frequency_response(*arguments),
        (10e3, 40, "0.1 kHz"),
        (10e3, 40, 100),
    ),
    "state_space": (lambda *wall: SCENE.state_space(*wall).A, ("10 kN/m", 40), (10e3, 40)),
    "simulate": (
        lambda K, x, push: SCENE.simulate(K, 40, start_position=x, external_force=push, periods=3).position,
        ("10 kN/m", "0.1 mm", ["1 N", "2 N"]),
        (10e3, 1e-4, [1, 2]),
    ),
    "denormalize": (
        lambda mass, period: zwidth.denormalize(mass=mass, period=period, alpha=0.1),
        ("100 g", "1 ms"),
        (0.1, 1e-3),
    ),
    "fit_buzz": (
        lambda *point: zwidth.fit_buzz([point, (6e3, 20.0, 50.0)], period=1e-3).mass,
        ("5 kN/m", 0, "0.04 kHz"),
        (5e3, 0, 40),
    ),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_scene_methods_accept_strings_with_units(name):
    function, texts, values = FUNCTIONS[name]
    np.testing.assert_array_equal(function(*texts), function(*values))


def test_rotary_operator_with_coupling_accepts_units():
    hand = zwidth.Operator(mass="2000 g cm^2", coupling_stiffness="2 N m/rad", coupling_damping="10 mN m s/rad")
    assert (hand.mass, hand.coupling_stiffness, hand.coupling_damping) == (2e-4, 2.0, 0.01)
    device = zwidth.Device("60 g cm^2", "0.02 mN m s/rad")
    scene = zwidth.Scene(device, zwidth.Timing("1 ms"), operator=hand)
    expected = zwidth.Scene(device, zwidth.Timing(1e-3), operator=zwidth.Operator(2e-4, 0, 0, 2.0, 0.01))
    assert scene.max_stiffness().stiffness == expected.max_stiffness().stiffness
    with pytest.raises(zwidth.InputError, match=r"operator.mass: got 0 kg m\^2; it must be greater than 0"):
        zwidth.Operator(mass="0 g cm^2", coupling_stiffness="2 N m/rad")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: zwidth.Device(mass="70 gramm"), "mass: got '70 gramm'; the units allowed are kg, g, mg"),
        (lambda: SCENE.is_stable("10 kN", 40), "stiffness: got '10 kN'; the units allowed are N/m"),
        (lambda: SCENE.is_stable("10,000 N/m", 40), "thousands separator; write '10000 N/m' or '10.000 N/m'"),
        (lambda: zwidth.Device(mass="10,000"), "mass: got '10,000'; .* write '10000' or '10.000'"),
        (
            lambda: zwidth.Device(mass="0,1"),
            "it must be one number without separators; write 0.1 if the comma is a decimal point$",
        ),
        (lambda: zwidth.Timing("1 ms", rate="1 kHz"), "timing: got both; pass either period"),
        (lambda: zwidth.Device(mass="0.07"), r"mass: got the text '0.07'; .*drop the quotes \(it is then in kg\)"),
        (lambda: zwidth.Device(mass="-70 g"), "mass: got -0.07 kg; it must be greater than 0 kg"),
        (lambda: zwidth.Device(mass=None), "mass: got None; it must be a number in kg"),
        (lambda: zwidth.Device(mass=np.inf), "mass: got inf; it must be finite"),
        (lambda: zwidth.LowPass(cutoff="100 ms"), "velocity.cutoff: got '100 ms'; the units allowed are Hz"),
        (lambda: zwidth.Timing("1 ms", "1 periodes"), "delay: .*did you mean 'periods'"),
        (lambda: zwidth.Timing("1 ms", "-1 periods"), "delay: got -1 periods; it must be at least 0 periods"),
        (lambda: zwidth.max_stiffness(mass="70 m", period="1 ms"), "mass: got '70 m'; the units allowed are"),
        (lambda: zwidth.max_stiffness(mass="-70 g", period="1 ms"), "mass: got -0.07; it must be finite and greater"),
        (
            lambda: zwidth.robust_wall(mass=0.1, period=zwidth.Interval(1, 2), delay="1 periods"),
            "delay: got '1 per",
        ),
    ],
)
def test_invalid_strings_and_values_are_rejected(make, message):
    with pytest.raises(zwidth.InputError, match=message):
        make()


def test_repr_of_scene_is_short_and_evaluates_to_the_scene():
    scene = zwidth.Scene(
        zwidth.Device("100 g", 10, modes=[zwidth.Mode(100, 0.01, 1)]),
        zwidth.Timing("1 ms"),
        zwidth.VirtualWall("10 kN/m", 3),
        velocity=zwidth.LowPass(cutoff=60),
        operator=zwidth.Operator(mass="500 g"),
    )
    bare = zwidth.Scene(zwidth.Device(0.1), zwidth.Timing(1e-3))
    assert repr(bare) == "Scene(device=Device(mass=0.1), timing=Timing(period=0.001))"
    for each in (scene, bare, zwidth.Scene(zwidth.Device("1 g cm^2"), zwidth.Timing(1e-3))):
        assert eval(repr(each), {name: getattr(zwidth, name) for name in dir(zwidth)}) == each
    linear = zwidth.LinearDevice("1 / 0.1 10 0")
    assert repr(linear) == "LinearDevice('1 / 0.1 10 0')"
    assert linear == zwidth.LinearDevice(([1.0], [0.1, 10.0, 0.0]))


def test_integral_gains_have_units():
    texts = ("2 kN/(m s)", "2 N/(mm s)", "2000 N/m/s", 2000)
    assert {zwidth.IntegralFeedback(text).gain for text in texts} == {2000.0}
    feedback = zwidth.IntegralFeedback("2 mN m/(rad s)")
    scene = zwidth.Scene(zwidth.Device("12 g cm^2"), zwidth.Timing("1 ms"), feedback=feedback)
    assert scene.parameters()["feedback.gain"] == pytest.approx(2e-3)
    assert zwidth.IntegralFeedback("1 N m/(turn s)").gain == pytest.approx(1 / (2 * np.pi))
    untyped: Any = zwidth
    gains = untyped.pid_gains("2 N m/rad", "50 mN m s/rad", "3 N m/(rad s)", units="turns")
    assert gains.ki == pytest.approx(6 * np.pi)
    assert untyped.cascade_gains("2 kN/m", "50 N s/m", "3 kN/m", units="m") == (40.0, 50.0, 3000.0)
    with pytest.raises(zwidth.InputError, match=r"feedback: got IntegralFeedback.*, in rotary units, for a linear"):
        zwidth.Scene(zwidth.Device(0.1), zwidth.Timing("1 ms"), feedback=feedback)
    with pytest.raises(zwidth.InputError, match=r"feedback.gain: got '2 N/m'; the units allowed are N/\(m s\)"):
        zwidth.IntegralFeedback("2 N/m")
