"""What a fit rests on: its tables against the fit itself, and its words."""

import re
from dataclasses import replace

import numpy as np
import pytest

import zwidth
from zwidth import plotting
from zwidth.identification.diagnostics import correlate_residuals, gather_evidence, trace_boundary
from zwidth.identification.fit_report import summarize_fit, write_scene
from zwidth.identification.onset_fit import BuzzPoint

HEARD = tuple(BuzzPoint(*wall) for wall in ((6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)))
B, K = "virtual_damping_N_s_per_m", "stiffness_N_per_m"
LOW, HIGH = "stiffness_low_N_per_m", "stiffness_high_N_per_m"


@pytest.fixture(scope="module")
def heard():
    return zwidth.fit_buzz(HEARD, period=1e-3, noise=0.02)


@pytest.fixture(scope="module")
def logged():
    """Two logs with white noise."""
    rng = np.random.default_rng(1)
    scene = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(period=1e-3))
    force = np.repeat(rng.choice([-1.0, 1.0], (2, 40)), 20, axis=1)
    places = [
        zwidth.simulate(scene, 0.0, 0.0, external_force_history=push, periods=800).position[:800] for push in force
    ]
    noisy = [place + 1e-5 * rng.standard_normal(800) for place in places]
    return zwidth.fit_log([1e-3, 1e-3], noisy, list(force))


def test_the_boundary_is_that_of_the_fitted_device(heard):
    traced = trace_boundary(heard)
    rows = heard.nominal.stable_stiffness(traced[B])[:, 0, 1]
    np.testing.assert_allclose(traced[K], np.nan_to_num(rows), rtol=1e-9, atol=1e-6)
    assert np.all(traced[LOW] <= traced[HIGH])


@pytest.mark.parametrize("velocity", [None, zwidth.LowPass(cutoff=300)])
def test_the_band_at_the_stiffest_wall_is_the_interval_of_k_max(velocity):
    """Its ends move with the device as K_max does: at the stiffest wall another damping counts to second order."""
    options = {"period": 1e-3, "noise": 0.005, "velocity": velocity}
    further = zwidth.fit_buzz(HEARD, **options).next
    assert further is not None
    fit = zwidth.fit_buzz([*HEARD, (further.stiffness, further.virtual_damping, further.frequency)], **options)
    # The stiffest wall is within what was tried.
    assert further.virtual_damping > fit.virtual_damping
    traced = trace_boundary(fit)
    at = int(np.argmax(traced[K]))
    bar = fit.intervals["stiffness_max"]
    # The quantiles of 200 devices.
    assert traced[HIGH][at] - traced[LOW][at] == pytest.approx(bar.high - bar.low, rel=0.15)
    assert traced[LOW][at] == pytest.approx(bar.low, rel=0.01)


def test_a_noise_that_is_estimated_widens_the_band(heard):
    open_noise = zwidth.fit_buzz(HEARD, period=1e-3)
    widths = [np.nanmax(traced[HIGH] - traced[LOW]) / fit.stiffness_error for fit in (heard, open_noise)
              for traced in [trace_boundary(fit)]]  # fmt: skip
    assert open_noise.coverage_factor > 1.5 * heard.coverage_factor
    assert widths[1] > 1.3 * widths[0]


def test_residuals_of_white_noise_are_not_correlated(logged):
    found = correlate_residuals(logged)
    rests = [motion.position - motion.modeled for motion in logged.motions]
    good = [rest[np.isfinite(rest)] for rest in rests]
    assert found["lag_s"][0] == logged.period
    assert found["band"][0] == pytest.approx(1.96 / np.sqrt(sum(rest.size for rest in good)), rel=1e-4)
    first = sum(np.sum(rest[1:] * rest[:-1]) for rest in good) / sum(np.sum(rest**2) for rest in good)
    assert found["autocorrelation"][0] == pytest.approx(first, rel=1e-12)
    assert np.mean(np.abs(found["autocorrelation"]) < found["band"]) > 0.85


def test_the_motion_is_every_sample_of_every_log(logged):
    tables = gather_evidence(logged, "two logs")
    motion = tables["motion"]
    assert np.bincount(motion["log"]).tolist() == [0, 800, 800]
    np.testing.assert_array_equal(motion["position_m"] - motion["modeled_m"], motion["residual_m"])
    assert np.nanstd(motion["residual_m"]) == pytest.approx(1e-5, rel=0.1)
    assert set(tables["walls"]["kind"]) == {"stiffest", "set"}


def test_walls_that_buzzed_keep_their_errors_and_distances(heard):
    walls = gather_evidence(heard, "walls", HEARD)["walls"]
    those = walls["kind"] == "onset"
    np.testing.assert_array_equal(walls[K][those], [wall.stiffness for wall in HEARD])
    np.testing.assert_allclose(walls["stiffness_error_N_per_m"][those], 0.02 * walls[K][those])
    np.testing.assert_array_equal(walls["stiffness_residual"][those], heard.residuals[:, 0])
    np.testing.assert_array_equal(walls["frequency_residual"][those], heard.residuals[:, 1])


def test_the_wall_to_set_is_softer_if_k_max_is_uncertain(heard):
    top = heard.scene.max_stiffness()
    limit = heard.scene.safe_limit
    # No wall with more damping than the last one was tried.
    assert limit.virtual_damping <= HEARD[-1].virtual_damping
    wall = heard.scene.recommend(stiffness_fraction=0.75)
    assert wall.limited_by == "safe_limit"
    assert wall.stiffness == 0.75 * limit.stiffness
    # The share is the same whichever limit binds.
    assert 0.9 * 0.75 * float(top.stiffness) < wall.stiffness < 0.75 * float(top.stiffness)
    vague = zwidth.fit_buzz(HEARD, period=1e-3, noise=0.3)
    softer = vague.scene.recommend(stiffness_fraction=0.75)
    assert softer.stiffness == pytest.approx(0.75 * vague.safe_wall().stiffness, rel=1e-3)
    assert softer.stiffness < 0.6 * float(top.stiffness)
    # If the walls leave the device open, no wall is recommended.
    lost = replace(heard, covariance=1e6 * heard.covariance)
    assert lost.recommended.status == zwidth.Status.UNREACHABLE
    assert "too uncertain" in lost.recommended.reason


def test_the_error_of_the_best_damping_is_that_of_devices_drawn(heard):
    drawn = replace(heard, covariance=0.01 * heard.covariance).draw(3000)
    assert drawn is not None
    rate = drawn[:, 0] / 1e-3
    best = rate * zwidth.alpha_max(drawn[:, 1] / rate, drawn[:, 2] / 1e-3).beta
    assert 10.0 * np.std(best) == pytest.approx(heard.virtual_damping_error, rel=0.05)


def test_a_band_that_is_not_known_is_not_drawn(heard):
    unknown = replace(heard, covariance=np.full((3, 3), np.nan))
    traced = trace_boundary(unknown)
    assert np.isnan(traced[LOW]).all()
    np.testing.assert_array_equal(traced[K], trace_boundary(heard)[K])
    tables = gather_evidence(unknown, "walls")
    panels = plotting.draw_device_fit(tables["boundary"], tables["walls"])
    assert len(panels) == 1


def test_an_estimate_of_any_kind_is_written_into_the_scene():
    estimate = zwidth.VelocityFilter([1000.0, -1000.0], [1.0, 0.0])
    fit = zwidth.fit_buzz(HEARD, period=1e-3, noise=0.02, velocity=estimate)
    (line,) = [line for line in write_scene(fit, "walls") if line.startswith("  velocity:")]
    assert line == "  velocity: {kind: filter, numerator: [1000.0, -1000.0], denominator: [1.0, 0.0]} # as given"


def test_intervals_have_digits_to_show(heard):
    exact = zwidth.fit_buzz(HEARD, period=1e-3, noise=1e-6)
    for fit in (heard, exact):
        said = dict(summarize_fit(fit))
        for text in re.findall(r"\(95 %: (.*?)\)", f"{said['device']}, {said['K_max']}"):
            low, high = text.split(" to ")
            assert low != high
