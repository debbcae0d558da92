"""Logs of devices that are more than a rigid mass, moved by matrix exponentials: no K_max, and no wall to set."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from measured_devices import TrueDevice
from scipy.linalg import expm
from scipy.signal import lfilter

import zwidth
from zwidth.fitting.words import choose_wall, describe_fit, write_scene
from zwidth.words.status import Status

PERIOD, DELAY, MASS, DAMPING, SAMPLES = 1e-3, 1.5e-3, 0.1, 1.0, 2000


def add_mode(plant, frequency, ratio, share):
    """A resonance beside the mass that moves so much as it; negative beyond a node."""
    A, B, C = plant
    w, size = 2 * np.pi * frequency, len(A)
    return (
        np.block([[A, np.zeros((size, 2))], [np.zeros((2, size)), np.array([[0, 1], [-w * w, -2 * ratio * w]])]]),
        np.array([*B, 0.0, 1 / MASS]),
        np.array([*C, share, 0.0]),
    )


def add_lag(plant, den):
    """An amplifier of ``1 / (den[0] s^n + ... + 1)`` before it."""
    A, B, C = plant
    size, order = len(A), len(den) - 1
    lag = np.eye(order, k=1)
    lag[-1] = -np.array(den[:0:-1]) / den[0]
    push = np.zeros(order)
    push[-1] = 1 / den[0]
    return (
        np.block([[A, np.outer(B, np.eye(order)[0])], [np.zeros((order, size)), lag]]),
        np.array([*np.zeros(size), *push]),
        np.array([*C, *np.zeros(order)]),
    )


RIGID = np.array([[0.0, 1.0], [0.0, -DAMPING / MASS]]), np.array([0.0, 1 / MASS]), np.array([1.0, 0.0])
W = 2 * np.pi * 150
MORE = {
    "a lag of 0.3 ms": add_lag(RIGID, (3e-4, 1.0)),
    "a lag of 2 ms": add_lag(RIGID, (2e-3, 1.0)),
    "a current loop of 150 Hz": add_lag(RIGID, (W**-2, 1.4 / W, 1.0)),
    "50 Hz, encoder at the motor": add_mode(RIGID, 50, 0.03, 0.4),
    "100 Hz, encoder at the motor": add_mode(RIGID, 100, 0.03, 0.67),
    "200 Hz, encoder at the motor": add_mode(RIGID, 200, 0.03, 0.67),
    "300 Hz, encoder at the motor": add_mode(RIGID, 300, 0.03, 0.67),
    "100 Hz, encoder at the load": add_mode(RIGID, 100, 0.03, -1.0),
    "300 Hz, encoder at the load": add_mode(RIGID, 300, 0.03, -1.0),
    "two resonances": add_mode(add_mode(RIGID, 60, 0.03, 0.3), 150, 0.03, 0.3),
    "a lag and a resonance": add_lag(add_mode(RIGID, 200, 0.03, 0.4), (1e-3, 1.0)),
}


def move(plant, force):
    """Positions under a force held from sample to sample, a delay of one period and a half later."""
    A, B, C = plant
    size = len(A)
    whole = np.zeros((size + 1, size + 1))
    whole[:size, :size], whole[:size, size] = A, B
    half = expm(whole * 0.5 * PERIOD)
    late, state, places = np.concatenate([[0.0, 0.0], force]), np.zeros(size + 1), []
    for k in range(force.size):
        places.append(C @ state[:size])
        for push in late[k : k + 2]:
            state[size] = push
            state = half @ state
    return np.array(places)


def record(plant, seed, step=1e-5):
    """A log of steps to and fro, read by an encoder with noise."""
    rng = np.random.default_rng(seed)
    force = 3 * np.repeat(rng.choice([-1.0, 1.0], SAMPLES // 25), 25)
    exact = move(plant, force)
    return force, step * np.round((exact + 0.3 * step * rng.standard_normal(SAMPLES)) / step)


@pytest.mark.parametrize("name", MORE)
def test_what_follows_the_force_leaves_no_stiffest_wall_and_none_to_set(name):
    force, position = record(MORE[name], 0)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert fit.status == Status.UNDECIDED
    assert any("follows the force" in doubt and "zwidth.excite" in doubt for doubt in fit.doubts)
    assert np.isnan([fit.stiffness_max, fit.stiffness_error, fit.safe_wall().stiffness]).all()
    assert choose_wall(fit) is None
    said = dict(describe_fit(fit, "a log"))
    assert "do not rely" in said["UNDECIDED"]
    assert said["K_max"] == "open"


def test_the_frequency_of_a_resonance_is_told():
    force, position = record(add_mode(RIGID, 120, 0.03, 0.1), 1)
    (doubt,) = zwidth.fit_log(PERIOD, position, force).doubts
    told = float(doubt.partition("near ")[2].partition(" Hz")[0])
    # The frequencies that are tried are 6 % apart.
    assert told == pytest.approx(120, rel=0.06)


@pytest.mark.parametrize("top, bottom", [([0.2], [1.0, -0.8]), ([0.2] * 5, [1.0])])
def test_a_filter_in_the_logger_is_told_from_a_device(top, bottom):
    force, position = record(RIGID, 2)
    fit = zwidth.fit_log(PERIOD, lfilter(top, bottom, position), force)
    assert np.isnan(fit.stiffness_max)
    assert fit.status == Status.UNDECIDED


def test_logs_of_rigid_devices_keep_their_walls():
    scene = zwidth.Scene(zwidth.Device(MASS, DAMPING), zwidth.Timing(period=PERIOD, delay=DELAY))
    true = float(scene.max_stiffness().stiffness)
    fits = [zwidth.fit_log(PERIOD, position, force) for force, position in map(partial(record, RIGID), range(20))]
    assert [(fit.status, fit.doubts) for fit in fits] == 20 * [(Status.OK, ())]
    held = [fit.intervals["stiffness_max"].low <= true <= fit.intervals["stiffness_max"].high for fit in fits]
    # Of 20 intervals of 95 % fewer than 16 hold by chance in 3 of 1,000 cases.
    assert sum(held) >= 16
    # What may hide costs a fifth of the stiffest wall, and a rigid device nothing.
    shares = [[fit.safe_wall(rigid=rigid).stiffness / true for rigid in (False, True)] for fit in fits[:3]]
    assert np.all((np.array(shares) > 0.7) & (np.array(shares) < [0.9, 1.0]))
    assert all(np.isfinite(fit.safe_wall().resonance) for fit in fits[:3])


def test_a_resonance_that_a_coarse_encoder_hides_bounds_the_safe_wall():
    hidden = TrueDevice("", MASS, DAMPING, 0.0, ((200.0, 0.03, MASS / 0.4),), DELAY, PERIOD, 2e-4, 3.0)
    force, position = record(add_mode(RIGID, 200, 0.03, 0.4), 3, step=hidden.encoder)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert fit.doubts == ()
    safe, rigid = fit.safe_wall(), fit.safe_wall(rigid=True)
    assert hidden.is_stable(*safe[:2])
    assert not hidden.is_stable(*rigid[:2])
    wall = choose_wall(fit)
    assert wall is not None
    assert wall[:2] == (0.75 * safe.stiffness, safe.virtual_damping)
    assert hidden.is_stable(*wall[:2])
    said = dict(describe_fit(fit, "a log"))
    assert "may make stiffer walls unstable" in said["not seen"]
    assert said["if it is rigid"].startswith("K = ")
    assert any("A resonance that the log does not show" in line for line in write_scene(fit, "a log"))


def test_a_hidden_resonance_lies_within_the_radius_of_the_response():
    force, position = record(add_mode(RIGID, 200, 0.03, 0.4), 3, step=2e-4)
    response = zwidth.fit_log(PERIOD, position, force).response
    assert response is not None
    devices = (zwidth.Device(MASS, DAMPING, modes=modes) for modes in ([zwidth.Mode(200, 0.03, MASS / 0.4)], []))
    timing = zwidth.Timing(period=PERIOD, delay=DELAY)
    more, rigid = (zwidth.Scene(device, timing).frequency_response(1.0, 0.0, response.frequency) for device in devices)
    shares = np.abs(more - rigid) / response.deviation
    # At its top it would show if it were a few times larger.
    assert 0.2 < shares.max() < 1.0


@pytest.mark.parametrize("seed", range(8))
def test_no_safe_wall_is_unstable_on_a_device_with_resonances(seed):
    rng = np.random.default_rng([5, seed])
    true = TrueDevice.draw(rng)
    while not true.modes:
        true = TrueDevice.draw(rng)
    force = true.limit * np.repeat(rng.choice([-1.0, 1.0], 100), 20)
    fit = zwidth.fit_log(true.period, replace(true, encoder=10 * true.encoder).play(force), force)
    safe = fit.safe_wall()
    assert fit.is_doubted or true.is_stable(safe.stiffness, safe.virtual_damping)


def test_long_logs_are_looked_at_in_part():
    rng = np.random.default_rng(4)
    force = 3 * np.repeat(rng.choice([-1.0, 1.0], 1000), 25)
    position = move(MORE["200 Hz, encoder at the motor"], force) + 1e-5 * rng.standard_normal(force.size)
    assert zwidth.fit_log(PERIOD, position, force).status == Status.UNDECIDED
