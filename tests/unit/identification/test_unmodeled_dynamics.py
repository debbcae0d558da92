"""Logs of devices that are more than a rigid mass, moved by matrix exponentials: modeled, or refused with no wall."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from measured_devices import DAMPING, DELAY, MASS, OTHERS, PERIOD, RIGID, OtherDevice, TrueDevice, add_mode
from scipy.signal import lfilter

import zwidth
from zwidth.core.status import Status
from zwidth.identification.fit_report import detail_fit, summarize_fit, write_scene
from zwidth.identification.friction_model import Recording


def record(plant, seed, step=1e-5):
    """A log of steps to and fro, read by an encoder with noise."""
    return OtherDevice.of(plant, step).record(np.random.default_rng(seed))


@cache
def fit_other(name):
    """The fit of a log of one of them."""
    force, position = record(OTHERS[name], 0)
    return zwidth.fit_log(PERIOD, position, force)


@cache
def fit_hidden():
    """The fit of a log whose coarse encoder hides a resonance of 200 Hz."""
    force, position = record(add_mode(RIGID, 200, 0.03, 0.4), 3, step=2e-4)
    return zwidth.fit_log(PERIOD, position, force)


@pytest.mark.parametrize("name", OTHERS)
def test_a_device_with_more_parts_is_modeled_with_them_or_has_no_wall(name):
    true, fit = OtherDevice.of(OTHERS[name]), fit_other(name)
    safe, wall = fit.safe_wall(), fit.recommended
    if fit.is_unreliable:
        assert wall.status == Status.UNREACHABLE
        assert np.isnan([fit.stiffness_max, fit.stiffness_error, safe.stiffness]).all()
        return
    # A current loop of 500 Hz is taken for a delay, a compliance of 300 Hz for a mode without damping of its own.
    assert fit.stiffness_max == pytest.approx(true.limit_of_walls(), rel=0.05)
    assert true.is_stable(*safe[:2])
    assert true.is_stable(wall.stiffness, wall.virtual_damping)


def test_a_resonance_is_found_with_its_numbers_and_written_into_the_scene(tmp_path):
    force, position = record(add_mode(RIGID, 120, 0.03, 0.1), 1)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert (fit.status, fit.warnings, fit.actuator) == (Status.OK, (), None)
    true = {"frequency": 120.0, "damping_ratio": 0.03, "mass": 10 * MASS}
    for name, value in true.items():
        path = f"modes.0.{name}"
        assert abs(fit.value_of(path) - value) < 4 * fit.errors[path]
        assert fit.errors[path] < 0.1 * value
    resonance = dict(summarize_fit(fit))["resonance"]
    assert resonance.startswith(f"frequency {fit.value_of('modes.0.frequency'):.2f} Hz (95 %: ")
    assert "damping ratio" in resonance
    assert dict(detail_fit(fit, "a log"))["stiffer wall"].startswith("K = ")
    (tmp_path / "scene.yaml").write_text("\n".join(write_scene(fit, "a log")))
    section: Any = zwidth.load_config(tmp_path / "scene.yaml").scene
    (written,) = section.modes
    for name in true:
        assert getattr(written, name) == pytest.approx(fit.value_of(f"modes.0.{name}"), rel=1e-4)


def test_a_resonance_that_hardly_decays_has_its_damping_ratio():
    """Held at 5e-4 at the least, it kept the other numbers off by many of their errors, without a warning."""
    force, position = record(add_mode(RIGID, 120, 1e-4, 0.1), 1, step=1e-6)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    true = {"mass": MASS, "damping": DAMPING, "modes.0.frequency": 120.0, "modes.0.damping_ratio": 1e-4}
    assert max(abs(fit.value_of(name) - value) / fit.errors[name] for name, value in true.items()) < 4.0


def test_a_resonance_whose_numbers_are_open_has_no_safe_wall():
    # Four modes that nearly cancel: no step along some axis of the covariance leaves all of them devices.
    force, position = record(OTHERS["compliance of 50 Hz, encoder at the motor"], 0, step=2e-4)
    fit = zwidth.fit_log(PERIOD, position, force)
    safe = fit.safe_wall()
    assert fit.is_unreliable or fit.build_response_scene(0.99, True) is None
    assert safe.status == Status.UNDECIDED
    assert np.isnan(safe.stiffness)
    assert fit.recommended.status == Status.UNREACHABLE


def test_a_lag_is_found_and_the_delay_without_it():
    fit = fit_other("amplifier, lag of 1 ms")
    assert fit.actuator is not None
    assert fit.actuator.order == 1
    assert abs(fit.actuator.time_constant - 1e-3) < 4 * fit.errors["actuator.time_constant"]
    assert abs(fit.delay - DELAY) < 4 * fit.errors["delay"]
    assert fit.lag is None


def test_the_interval_of_the_stiffest_wall_reaches_to_a_lag_that_does_not_show():
    force, position = record(OTHERS["amplifier, lag of 0.3 ms"], 2, step=2e-4)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert fit.actuator is None
    assert fit.lag is not None
    assert fit.lag.time_constant > 3e-4
    assert fit.intervals["stiffness_max"].high >= fit.lag.stiffness_max
    assert fit.lag.delay < fit.delay
    assert fit.as_dict()["lag"]["time_constant"] == fit.lag.time_constant
    assert any("lag" in text for label, text in detail_fit(fit, "a log") if label == "alternative")


@pytest.mark.parametrize("top, bottom", [([0.2], [1.0, -0.8]), ([0.2] * 5, [1.0])])
def test_a_filter_in_the_logger_is_told_from_a_device(top, bottom):
    force, position = record(RIGID, 2)
    fit = zwidth.fit_log(PERIOD, lfilter(top, bottom, position), force)
    assert np.isnan(fit.stiffness_max)
    assert fit.status == Status.UNDECIDED


def test_logs_of_rigid_devices_have_no_parts_and_keep_their_walls():
    scene = zwidth.Scene(zwidth.Device(MASS, DAMPING), zwidth.Timing(period=PERIOD, delay=DELAY))
    true = float(scene.max_stiffness().stiffness)
    logs = [record(RIGID, seed) for seed in range(12)]
    fits = [zwidth.fit_log(PERIOD, position, force) for force, position in logs]
    assert [(fit.status, fit.warnings, fit.is_structured) for fit in fits] == 12 * [(Status.OK, (), False)]
    assert all(fit.response is not None for fit in fits)
    held = [fit.intervals["stiffness_max"].low <= true <= fit.intervals["stiffness_max"].high for fit in fits]
    # Of 12 intervals of 95 % fewer than 9 hold by chance in 2 of 1,000 cases.
    assert sum(held) >= 9
    # What may hide costs a fifth of the stiffest wall, and a rigid device nothing.
    shares = [[fit.safe_wall(rigid=rigid).stiffness / true for rigid in (False, True)] for fit in fits[:3]]
    assert np.all((np.array(shares) > 0.7) & (np.array(shares) < [0.9, 1.0]))
    assert all(np.isfinite(fit.safe_wall().resonance) for fit in fits[:3])


def test_a_resonance_that_a_coarse_encoder_hides_bounds_the_safe_wall():
    hidden = TrueDevice("", MASS, DAMPING, 0.0, ((200.0, 0.03, MASS / 0.4),), DELAY, PERIOD, 2e-4, 3.0)
    fit = fit_hidden()
    assert fit.warnings == ()
    safe, rigid = fit.safe_wall(), fit.safe_wall(rigid=True)
    assert hidden.is_stable(*safe[:2])
    assert not hidden.is_stable(*rigid[:2])
    limit = fit.scene.safe_limit
    assert limit is not None
    # Rounded down to four digits.
    assert 0.998 * safe.stiffness < limit.stiffness <= safe.stiffness
    assert 0.998 * safe.virtual_damping < limit.virtual_damping <= safe.virtual_damping
    wall = fit.scene.recommend(stiffness_fraction=0.75)
    assert (wall.stiffness, wall.virtual_damping) == (0.75 * limit.stiffness, limit.virtual_damping)
    for found in (wall, fit.recommended):
        assert limit.allows(found.stiffness, found.virtual_damping)
        assert hidden.is_stable(found.stiffness, found.virtual_damping)
    said = summarize_fit(fit)
    assert [label for label, _ in said[:2]] == ["SET", ""]
    assert ", with B limited by the safe limit: a resonance near" in said[1][1]
    assert "zwidth excite --rate '1.000 kHz' --force '3.0 N' --resolution '200 µm'" in dict(said)["next"]
    assert dict(detail_fit(fit, "a log"))["stiffer wall"].startswith("K = ")
    assert any(line.startswith('    reason: "a resonance near') for line in write_scene(fit, "a log"))


def test_a_hidden_resonance_lies_within_the_radius_of_the_response():
    response = fit_hidden().response
    assert response is not None
    devices = (zwidth.Device(MASS, DAMPING, modes=modes) for modes in ([zwidth.Mode(200, 0.03, MASS / 0.4)], []))
    timing = zwidth.Timing(period=PERIOD, delay=DELAY)
    more, rigid = (zwidth.Scene(device, timing).frequency_response(1.0, 0.0, response.frequency) for device in devices)
    shares = np.abs(more - rigid) / response.deviation
    # At its top it would show if it were a few times larger.
    assert 0.2 < shares.max() < 1.0


@pytest.mark.parametrize("seed", range(5))
def test_no_safe_wall_is_unstable_on_a_device_with_resonances(seed):
    rng = np.random.default_rng([5, seed])
    true = TrueDevice.draw(rng)
    while not true.modes:
        true = TrueDevice.draw(rng)
    force = true.limit * np.repeat(rng.choice([-1.0, 1.0], 100), 20)
    fit = zwidth.fit_log(true.period, replace(true, encoder=10 * true.encoder).play(force), force)
    safe = fit.safe_wall()
    assert safe.status != Status.OK or true.is_stable(safe.stiffness, safe.virtual_damping)


@pytest.mark.parametrize("seed", [0, 1])
def test_rounding_decides_nothing_where_a_log_has_one_push(seed):
    """There friction and offset move alike, and what is left between them is no direction."""
    force, ahead = np.zeros(1030), 30
    force[50:150] = 1.0
    g = PERIOD**2 / 0.1
    moved = Recording(force, np.zeros(1000), ahead).move(g, 0.01, 1.3, 0.0, 0.0, 0.0, 0.05 * g).position
    step, noise = np.ptp(moved) / 5000.0, np.random.default_rng(seed).standard_normal(force.size)
    position = step * np.round(np.append(np.zeros(ahead), moved) / step + 0.2 * noise)
    first, *others = (
        np.array(zwidth.fit_log(PERIOD, position * by, force, resolution=step).intervals["stiffness_max"])
        for by in (1.0, 1.0 + 3e-15, 1.0 - 7e-15)
    )
    for other in others:
        np.testing.assert_allclose(other, first, rtol=0, atol=1e-3 * np.ptp(first))


def test_long_logs_are_looked_at_in_part(monkeypatch):
    monkeypatch.setattr("zwidth.identification.unmodeled_dynamics.MAX_SAMPLES", 2000)
    rng = np.random.default_rng(4)
    force = 3 * np.repeat(rng.choice([-1.0, 1.0], 100), 25)
    position = OtherDevice.of(OTHERS["two resonances"]).play(force) + 1e-5 * rng.standard_normal(force.size)
    assert len(zwidth.fit_log(PERIOD, position, force).modes) == 2
