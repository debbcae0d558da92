"""Test `zwidth.fit_log` on devices with lags and resonances: modeled, or rejected without a recommended wall.

Reference: devices simulated by matrix exponentials.
"""

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


def record_log(plant, seed, step=1e-5):
    """Return forces of random sign and positions read by a noisy encoder."""
    return OtherDevice.of(plant, step).record(np.random.default_rng(seed))


@cache
def fit_other(name):
    """Fit a log of the named device."""
    force, position = record_log(OTHERS[name], 0)
    return zwidth.fit_log(PERIOD, position, force)


@cache
def fit_hidden():
    """Fit a log with a resonance at 200 Hz that the coarse encoder hides."""
    force, position = record_log(add_mode(RIGID, 200, 0.03, 0.4), 3, step=2e-4)
    return zwidth.fit_log(PERIOD, position, force)


@pytest.mark.parametrize("name", OTHERS)
def test_non_rigid_device_is_modeled_or_has_no_wall(name):
    true, fit = OtherDevice.of(OTHERS[name]), fit_other(name)
    safe, wall = fit.safe_wall(), fit.recommended
    if fit.is_unreliable:
        assert wall.status == Status.UNREACHABLE
        assert np.isnan([fit.stiffness_max, fit.stiffness_error, safe.stiffness]).all()
        return
    # A current loop of 500 Hz is fitted as a delay, and a compliance at 300 Hz as a mode without damping.
    assert fit.stiffness_max == pytest.approx(true.limit_of_walls(), rel=0.05)
    assert true.is_stable(*safe[:2])
    assert true.is_stable(wall.stiffness, wall.virtual_damping)


def test_resonance_is_identified_and_written_to_the_scene(tmp_path):
    force, position = record_log(add_mode(RIGID, 120, 0.03, 0.1), 1)
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


def test_damping_ratio_of_weakly_damped_resonance_is_recovered():
    """With a lower bound of 5e-4 the other parameters were many standard errors off, without a warning."""
    force, position = record_log(add_mode(RIGID, 120, 1e-4, 0.1), 1, step=1e-6)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    true = {"mass": MASS, "damping": DAMPING, "modes.0.frequency": 120.0, "modes.0.damping_ratio": 1e-4}
    assert max(abs(fit.value_of(name) - value) / fit.errors[name] for name, value in true.items()) < 4.0


def test_undetermined_resonance_has_no_safe_wall():
    # Four modes nearly cancel: along some principal axis of the covariance, every step makes one of them invalid.
    force, position = record_log(OTHERS["compliance of 50 Hz, encoder at the motor"], 0, step=2e-4)
    fit = zwidth.fit_log(PERIOD, position, force)
    safe = fit.safe_wall()
    assert fit.is_unreliable or fit.build_response_scene(0.99, True) is None
    assert safe.status == Status.UNDECIDED
    assert np.isnan(safe.stiffness)
    assert fit.recommended.status == Status.UNREACHABLE


def test_actuator_lag_is_identified_separately_from_delay():
    fit = fit_other("amplifier, lag of 1 ms")
    assert fit.actuator is not None
    assert fit.actuator.order == 1
    assert abs(fit.actuator.time_constant - 1e-3) < 4 * fit.errors["actuator.time_constant"]
    assert abs(fit.delay - DELAY) < 4 * fit.errors["delay"]
    assert fit.lag is None


def test_interval_of_max_stiffness_includes_a_hidden_lag():
    force, position = record_log(OTHERS["amplifier, lag of 0.3 ms"], 2, step=2e-4)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert fit.actuator is None
    assert fit.lag is not None
    assert fit.lag.time_constant > 3e-4
    assert fit.intervals["stiffness_max"].high >= fit.lag.stiffness_max
    assert fit.lag.delay < fit.delay
    assert fit.as_dict()["lag"]["time_constant"] == fit.lag.time_constant
    assert any("lag" in text for label, text in detail_fit(fit, "a log") if label == "alternative")


@pytest.mark.parametrize("numerator, denominator", [([0.2], [1.0, -0.8]), ([0.2] * 5, [1.0])])
def test_filter_in_the_logger_leaves_no_wall(numerator, denominator):
    force, position = record_log(RIGID, 2)
    fit = zwidth.fit_log(PERIOD, lfilter(numerator, denominator, position), force)
    assert np.isnan(fit.stiffness_max)
    assert fit.status == Status.UNDECIDED


def test_rigid_devices_are_fitted_without_modes_and_keep_their_walls():
    scene = zwidth.Scene(zwidth.Device(MASS, DAMPING), zwidth.Timing(period=PERIOD, delay=DELAY))
    true = float(scene.max_stiffness().stiffness)
    logs = [record_log(RIGID, seed) for seed in range(6)]
    fits = [zwidth.fit_log(PERIOD, position, force) for force, position in logs]
    assert [(fit.status, fit.warnings, fit.is_structured) for fit in fits] == 6 * [(Status.OK, (), False)]
    assert all(fit.response is not None for fit in fits)
    covered = [fit.intervals["stiffness_max"].low <= true <= fit.intervals["stiffness_max"].high for fit in fits]
    # With 6 intervals of 95 %, fewer than 4 cover the true value with a probability of 0.2 %.
    assert sum(covered) >= 4
    # Possible hidden resonances cost a fifth of the maximum stiffness; with a device known to be rigid the cost is
    # small.
    shares = [[fit.safe_wall(rigid=rigid).stiffness / true for rigid in (False, True)] for fit in fits[:3]]
    assert np.all((np.array(shares) > 0.7) & (np.array(shares) < [0.9, 1.0]))
    assert all(np.isfinite(fit.safe_wall().resonance) for fit in fits[:3])


def test_hidden_resonance_bounds_the_safe_wall():
    hidden = TrueDevice("", MASS, DAMPING, 0.0, ((200.0, 0.03, MASS / 0.4),), DELAY, PERIOD, 2e-4, 3.0)
    fit = fit_hidden()
    assert fit.warnings == ()
    safe, rigid = fit.safe_wall(), fit.safe_wall(rigid=True)
    assert hidden.is_stable(*safe[:2])
    assert not hidden.is_stable(*rigid[:2])
    limit = fit.scene.safe_limit
    assert limit is not None
    # The safe limit is rounded down to four digits.
    assert 0.998 * safe.stiffness < limit.stiffness <= safe.stiffness
    assert 0.998 * safe.virtual_damping < limit.virtual_damping <= safe.virtual_damping
    wall = fit.scene.recommend(stiffness_fraction=0.75)
    assert (wall.stiffness, wall.virtual_damping) == (0.75 * limit.stiffness, limit.virtual_damping)
    for limited in (wall, fit.recommended):
        assert limit.allows(limited.stiffness, limited.virtual_damping)
        assert hidden.is_stable(limited.stiffness, limited.virtual_damping)
    summary = summarize_fit(fit)
    assert [label for label, _ in summary[:2]] == ["SET", ""]
    assert ", with B limited by the safe limit: a resonance near" in summary[1][1]
    assert "zwidth excite --rate '1.000 kHz' --force '3.0 N' --resolution '200 µm'" in dict(summary)["next"]
    assert dict(detail_fit(fit, "a log"))["stiffer wall"].startswith("K = ")
    assert any(line.startswith('    reason: "a resonance near') for line in write_scene(fit, "a log"))


def test_hidden_resonance_lies_within_the_deviation_of_the_response():
    response = fit_hidden().response
    assert response is not None
    devices = (zwidth.Device(MASS, DAMPING, modes=modes) for modes in ([zwidth.Mode(200, 0.03, MASS / 0.4)], []))
    timing = zwidth.Timing(period=PERIOD, delay=DELAY)
    with_mode, rigid = (
        zwidth.Scene(device, timing).frequency_response(1.0, 0.0, response.frequency) for device in devices
    )
    shares = np.abs(with_mode - rigid) / response.deviation
    # At its peak, a resonance a few times larger would be visible.
    assert 0.2 < shares.max() < 1.0


@pytest.mark.parametrize("seed", range(5))
def test_safe_wall_is_stable_on_random_devices_with_resonances(seed):
    rng = np.random.default_rng([5, seed])
    true = TrueDevice.draw(rng)
    while not true.modes:
        true = TrueDevice.draw(rng)
    force = true.limit * np.repeat(rng.choice([-1.0, 1.0], 100), 20)
    fit = zwidth.fit_log(true.period, replace(true, encoder=10 * true.encoder).play(force), force)
    safe = fit.safe_wall()
    assert safe.status != Status.OK or true.is_stable(safe.stiffness, safe.virtual_damping)


@pytest.mark.parametrize("seed", [0, 1])
def test_rounding_errors_do_not_change_intervals_of_a_single_pulse(seed):
    """Friction and offset have nearly the same effect in this log; their difference must not count as a direction."""
    force, n_before = np.zeros(1030), 30
    force[50:150] = 1.0
    g = PERIOD**2 / 0.1
    motion = Recording(force, np.zeros(1000), n_before).move(g, 0.01, 1.3, 0.0, 0.0, 0.0, 0.05 * g).position
    step, noise = np.ptp(motion) / 5000.0, np.random.default_rng(seed).standard_normal(force.size)
    position = step * np.round(np.append(np.zeros(n_before), motion) / step + 0.2 * noise)
    first, *others = (
        np.array(zwidth.fit_log(PERIOD, position * factor, force, resolution=step).intervals["stiffness_max"])
        for factor in (1.0, 1.0 + 3e-15, 1.0 - 7e-15)
    )
    for other in others:
        np.testing.assert_allclose(other, first, rtol=0, atol=1e-3 * np.ptp(first))


def test_long_logs_are_truncated_in_the_search_for_resonances(monkeypatch):
    monkeypatch.setattr("zwidth.identification.unmodeled_dynamics.MAX_SAMPLES", 2000)
    rng = np.random.default_rng(4)
    force = 3 * np.repeat(rng.choice([-1.0, 1.0], 100), 25)
    position = OtherDevice.of(OTHERS["two resonances"]).play(force) + 1e-5 * rng.standard_normal(force.size)
    assert len(zwidth.fit_log(PERIOD, position, force).modes) == 2
