"""Texts with units in Python: parts and functions read them as configuration files do."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

import zwidth
from zwidth.parts.checks import Span


def test_parts_read_texts_with_units():
    assert zwidth.Device(mass="70 g", damping="3 mN s/mm") == zwidth.Device(mass=0.07, damping=3.0)
    assert zwidth.Timing(rate="4 kHz", delay="0.3 ms") == zwidth.Timing(period=0.25e-3, delay=0.3e-3)
    assert zwidth.Timing("1 ms").period == 1e-3
    assert zwidth.LowPass(cutoff="0.1 kHz") == zwidth.LowPass(cutoff=100)
    assert zwidth.LowPass(time_constant="5 ms", coded_period="100 us").coded_period == 1e-4
    tip = zwidth.Coupling(mass="50 g", stiffness="20 kN/m", damping="1 N s/m")
    assert tip == zwidth.Coupling(mass=0.05, stiffness=20e3, damping=1.0)
    assert zwidth.Operator(mass="554 g", coupling_stiffness="1 N/mm").coupling_stiffness == 1e3
    assert zwidth.VirtualWall("5 kN/m", "10 N s/m") == zwidth.VirtualWall(5e3, 10.0)


# Divisions that miss the delay in periods by a rounding error, or only by chance do not.
@pytest.mark.parametrize("periods", [0.1, 0.3, 1.0, 1.1, 2.7, 11.0, 123.4])
@pytest.mark.parametrize("rate", [1e3, 3e3, 7e3, 44100.0])
def test_a_delay_in_periods_is_exact_in_periods(periods, rate):
    timing = zwidth.Timing(rate=rate, delay=f"{periods} periods")
    scene = zwidth.Scene(zwidth.Device(0.1), timing)
    assert timing.d == scene.d == scene.normalized.d == periods
    assert timing.delay == periods * timing.period
    assert zwidth.Timing(rate=rate, delay=Span(periods, "periods")).d == periods


def test_a_delay_in_seconds_is_divided_and_a_changed_one_forgets_its_periods():
    assert zwidth.Timing(1e-4, 1.1e-3).d == 11.0
    changed = dataclasses.replace(zwidth.Timing(1e-3, "2 periods"), delay=0.5e-3)
    assert changed.d == 0.5


def test_periods_of_a_traced_period():
    d = []

    def seconds(period):
        timing = zwidth.Timing(period, "1.5 periods")
        d.append(timing.d)
        return timing.delay

    assert jax.grad(seconds)(1e-3) == 1.5
    assert d == [1.5]


def test_functions_read_texts_with_units():
    numbers: dict[str, Any] = {"mass": 0.07, "damping": 10.0, "period": 1e-3, "delay": 1.5e-3}
    texts: dict[str, Any] = {"mass": "70 g", "damping": "10 N s/m", "period": "1 ms", "delay": "1.5 periods"}
    assert zwidth.max_stiffness(**texts) == zwidth.max_stiffness(**numbers)
    assert zwidth.sensitivities(**texts) == zwidth.sensitivities(**numbers)
    assert zwidth.normalize(**texts, stiffness="5 kN/m") == zwidth.normalize(**numbers, stiffness=5e3)
    known = {name: value for name, value in texts.items() if name != "damping"}
    plain = {name: value for name, value in numbers.items() if name != "damping"}
    assert zwidth.required("damping", "5 kN/m", **known) == zwidth.required("damping", 5e3, **plain)
    worst = zwidth.robust_max_stiffness(mass=zwidth.Interval("60 g", "80 g"), period="1 ms", delay="1 periods")
    assert worst == zwidth.robust_max_stiffness(mass=zwidth.Interval(0.06, 0.08), period=1e-3, delay=1e-3)
    arrays = zwidth.max_stiffness(mass=np.array([0.07, 0.1]), period="1 ms")
    assert arrays[0] == zwidth.max_stiffness(mass=0.07, period=1e-3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: zwidth.Device(mass="70 gramm"), "mass: got '70 gramm'; the units allowed are kg, g, mg"),
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
            lambda: zwidth.required("mass", "5 kN/m", period=zwidth.Interval(1, 2), delay="1 periods"),
            "delay: got '1 per",
        ),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(zwidth.InputError, match=message):
        make()
