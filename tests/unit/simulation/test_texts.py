"""Arguments of simulations and analyses as texts with units, typed as a user types them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError

SCENE = zwidth.Scene(zwidth.Device("100 g", "10 N s/m"), zwidth.Timing("1 ms", "1 ms"))
untyped: Any = zwidth  # for arguments of wrong types


@pytest.mark.parametrize(
    ("length", "count"),
    [
        ({"duration": "50 ms"}, 50),
        ({"duration": 0.05}, 50),
        ({"duration": "20 periods"}, 20),
        ({"duration": 1}, 1000),
        ({"periods": 30}, 30),
        ({}, 1000),
    ],
)
def test_the_duration_of_a_simulation(length, count):
    motion = zwidth.simulate(SCENE, "5 kN/m", "20 N s/m", start_position="1 mm", **length)
    assert motion.position.shape == (count,)


def test_every_quantity_of_a_simulation_may_be_a_text():
    texts = {
        "start_velocity": "10 mm/s",
        "external_force": "0.2 N",
        "external_force_history": ["0.1 N"] * 50,
        "resolution": "10 um",
        "noise": "1 um",
        "coulomb": "0.1 N",
        "static": "200 mN",
        "max_force": "5 N",
        "max_rate": "1 kN/s",
        "jitter": "10 us",
    }
    numbers = {
        "start_velocity": 0.01,
        "external_force": 0.2,
        "external_force_history": [0.1] * 50,
        "resolution": 1e-5,
        "noise": 1e-6,
        "coulomb": 0.1,
        "static": 0.2,
        "max_force": 5,
        "max_rate": 1000,
        "jitter": 1e-5,
    }
    a = zwidth.simulate(SCENE, "5 kN/m", "20 N s/m", duration="50 ms", **texts)
    b = zwidth.simulate(SCENE, 5000, 20, periods=50, **numbers)
    np.testing.assert_array_equal(a.position, b.position)


@pytest.mark.parametrize(
    ("length", "message"),
    [
        ({"duration": "1 kg"}, "duration: got '1 kg'; the units allowed are s"),
        ({"duration": "1 s", "periods": 3}, "together with periods = 3; pass only one"),
        ({"duration": 0}, "it must be 1 to 1000000000 periods"),
        ({"duration": "1e9 s"}, "it must be 1 to 1000000000 periods"),
        ({"duration": [1, 2]}, "it must be a single number"),
        ({"periods": "1 s"}, "periods: got '1 s'"),
    ],
)
def test_invalid_durations(length, message):
    with pytest.raises(InputError, match=message):
        untyped.simulate(SCENE, 5000, 20, **length)


def test_a_duration_requires_equal_periods():
    other = SCENE.replace(period="0.5 ms")
    with pytest.raises(InputError, match="different sampling periods; pass periods"):
        zwidth.simulate([SCENE, other], 5000, 20, duration="1 s")
    assert zwidth.simulate([SCENE, other], 5000, 20, duration="20 periods").position.shape == (2, 20)


def test_requirements_frequencies_and_tolerances_may_be_texts():
    texts = SCENE.recommend(stiffness_fraction="50%", gain_margin="6 dB", phase_margin="30 deg")
    numbers = SCENE.recommend(stiffness_fraction=0.5, gain_margin=10**0.3, phase_margin=30)
    assert texts.stiffness == numbers.stiffness
    with pytest.raises(InputError, match="gain_margin: got '6 deg'; a number greater than 1 is needed"):
        SCENE.recommend(gain_margin="6 deg")
    assert SCENE.boundary("80 Hz") == SCENE.boundary(160 * np.pi)
    assert SCENE.boundary("500 rad/s") == SCENE.boundary(500)
    walled = SCENE.replace(stiffness="5 kN/m", virtual_damping="20 N s/m")
    shares = [zwidth.simulate_tolerances(walled, {"mass": share}, samples=200).stable for share in ("10%", 0.1)]
    assert shares[0] == shares[1]
    with pytest.raises(InputError, match="tolerances: mass: got '5 kg'"):
        zwidth.simulate_tolerances(walled, {"mass": "5 kg"})
