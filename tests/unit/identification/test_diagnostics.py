"""Test the tables and texts that document a fit, against the fit itself and sampled devices."""

import re
from dataclasses import replace

import numpy as np
import pytest

import zwidth
from zwidth import plotting
from zwidth.identification.diagnostics import correlate_residuals, gather_evidence, trace_boundary
from zwidth.identification.fit_report import summarize_fit, write_scene
from zwidth.identification.onset_fit import BuzzPoint

ONSETS = tuple(BuzzPoint(*wall) for wall in ((6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)))
B, K = "virtual_damping_N_s_per_m", "stiffness_N_per_m"
LOW, HIGH = "stiffness_low_N_per_m", "stiffness_high_N_per_m"


@pytest.fixture(scope="module")
def onset_fit():
    return zwidth.fit_buzz(ONSETS, period=1e-3, noise=0.02)


@pytest.fixture(scope="module")
def log_fit():
    """Fit two logs with white noise."""
    rng = np.random.default_rng(1)
    scene = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(period=1e-3))
    force = np.repeat(rng.choice([-1.0, 1.0], (2, 40)), 20, axis=1)
    positions = [
        zwidth.simulate(scene, 0.0, 0.0, external_force_history=external, periods=800).position[:800]
        for external in force
    ]
    noisy = [clean + 1e-5 * rng.standard_normal(800) for clean in positions]
    return zwidth.fit_log([1e-3, 1e-3], noisy, list(force))


def test_traced_boundary_is_that_of_the_fitted_device(onset_fit):
    traced = trace_boundary(onset_fit)
    rows = onset_fit.nominal.stable_stiffness(traced[B])[:, 0, 1]
    np.testing.assert_allclose(traced[K], np.nan_to_num(rows), rtol=1e-9, atol=1e-6)
    assert np.all(traced[LOW] <= traced[HIGH])


@pytest.mark.parametrize("velocity", [None, zwidth.LowPass(cutoff=300)])
def test_band_at_the_stiffest_wall_is_the_interval_of_max_stiffness(velocity):
    """Both ends vary as K_max does, because at the stiffest wall the damping has only a second-order effect."""
    options = {"period": 1e-3, "noise": 0.005, "velocity": velocity}
    next_wall = zwidth.fit_buzz(ONSETS, **options).next
    assert next_wall is not None
    fit = zwidth.fit_buzz([*ONSETS, (next_wall.stiffness, next_wall.virtual_damping, next_wall.frequency)], **options)
    # The stiffest wall lies within the tested dampings.
    assert next_wall.virtual_damping > fit.virtual_damping
    traced = trace_boundary(fit)
    index = int(np.argmax(traced[K]))
    interval = fit.intervals["stiffness_max"]
    # The tolerances allow for quantiles of only 200 devices.
    assert traced[HIGH][index] - traced[LOW][index] == pytest.approx(interval.high - interval.low, rel=0.15)
    assert traced[LOW][index] == pytest.approx(interval.low, rel=0.01)


def test_estimated_noise_widens_the_band(onset_fit):
    open_noise = zwidth.fit_buzz(ONSETS, period=1e-3)
    widths = [np.nanmax(traced[HIGH] - traced[LOW]) / fit.stiffness_error for fit in (onset_fit, open_noise)
              for traced in [trace_boundary(fit)]]  # fmt: skip
    assert open_noise.coverage_factor > 1.5 * onset_fit.coverage_factor
    assert widths[1] > 1.3 * widths[0]


def test_white_residuals_are_uncorrelated(log_fit):
    correlation = correlate_residuals(log_fit)
    residuals = [motion.position - motion.modeled for motion in log_fit.motions]
    finite = [residual[np.isfinite(residual)] for residual in residuals]
    assert correlation["lag_s"][0] == log_fit.period
    assert correlation["band"][0] == pytest.approx(1.96 / np.sqrt(sum(residual.size for residual in finite)), rel=1e-4)
    first = sum(np.sum(residual[1:] * residual[:-1]) for residual in finite) / sum(
        np.sum(residual**2) for residual in finite
    )
    assert correlation["autocorrelation"][0] == pytest.approx(first, rel=1e-12)
    assert np.mean(np.abs(correlation["autocorrelation"]) < correlation["band"]) > 0.85


def test_motion_table_contains_every_sample_of_every_log(log_fit):
    tables = gather_evidence(log_fit, "two logs")
    motion = tables["motion"]
    assert np.bincount(motion["log"]).tolist() == [0, 800, 800]
    np.testing.assert_array_equal(motion["position_m"] - motion["modeled_m"], motion["residual_m"])
    assert np.nanstd(motion["residual_m"]) == pytest.approx(1e-5, rel=0.1)
    assert set(tables["walls"]["kind"]) == {"stiffest", "set"}


def test_wall_table_contains_errors_and_residuals_of_onsets(onset_fit):
    walls = gather_evidence(onset_fit, "walls", ONSETS)["walls"]
    is_onset = walls["kind"] == "onset"
    np.testing.assert_array_equal(walls[K][is_onset], [wall.stiffness for wall in ONSETS])
    np.testing.assert_allclose(walls["stiffness_error_N_per_m"][is_onset], 0.02 * walls[K][is_onset])
    np.testing.assert_array_equal(walls["stiffness_residual"][is_onset], onset_fit.residuals[:, 0])
    np.testing.assert_array_equal(walls["frequency_residual"][is_onset], onset_fit.residuals[:, 1])


def test_recommended_wall_is_softer_if_max_stiffness_is_uncertain(onset_fit):
    top = onset_fit.scene.max_stiffness()
    limit = onset_fit.scene.safe_limit
    # No wall with more damping than that of the last onset was tested.
    assert limit.virtual_damping <= ONSETS[-1].virtual_damping
    wall = onset_fit.scene.recommend(stiffness_fraction=0.75)
    assert wall.limited_by == "safe_limit"
    assert wall.stiffness == 0.75 * limit.stiffness
    # The stiffness fraction applies to either limit.
    assert 0.9 * 0.75 * float(top.stiffness) < wall.stiffness < 0.75 * float(top.stiffness)
    uncertain = zwidth.fit_buzz(ONSETS, period=1e-3, noise=0.3)
    softer = uncertain.scene.recommend(stiffness_fraction=0.75)
    assert softer.stiffness == pytest.approx(0.75 * uncertain.safe_wall().stiffness, rel=1e-3)
    assert softer.stiffness < 0.6 * float(top.stiffness)
    # If the onsets do not determine the device, no wall is recommended.
    undetermined = replace(onset_fit, covariance=1e6 * onset_fit.covariance)
    assert undetermined.recommended.status == zwidth.Status.UNREACHABLE
    assert "too uncertain" in undetermined.recommended.reason


def test_error_of_best_damping_is_that_of_sampled_devices(onset_fit):
    sampled = replace(onset_fit, covariance=0.01 * onset_fit.covariance).draw(3000)
    assert sampled is not None
    rate = sampled[:, 0] / 1e-3
    best = rate * zwidth.alpha_max(sampled[:, 1] / rate, sampled[:, 2] / 1e-3).beta
    assert 10.0 * np.std(best) == pytest.approx(onset_fit.virtual_damping_error, rel=0.05)


def test_band_with_unknown_covariance_is_not_plotted(onset_fit):
    without_covariance = replace(onset_fit, covariance=np.full((3, 3), np.nan))
    traced = trace_boundary(without_covariance)
    assert np.isnan(traced[LOW]).all()
    np.testing.assert_array_equal(traced[K], trace_boundary(onset_fit)[K])
    tables = gather_evidence(without_covariance, "walls")
    panels = plotting.draw_device_fit(tables["boundary"], tables["walls"])
    assert len(panels) == 1


def test_velocity_filter_is_written_into_the_scene():
    estimate = zwidth.VelocityFilter([1000.0, -1000.0], [1.0, 0.0])
    fit = zwidth.fit_buzz(ONSETS, period=1e-3, noise=0.02, velocity=estimate)
    (line,) = [line for line in write_scene(fit, "walls") if line.startswith("  velocity:")]
    assert line == "  velocity: {kind: filter, numerator: [1000.0, -1000.0], denominator: [1.0, 0.0]} # as given"


def test_printed_intervals_have_distinct_ends(onset_fit):
    exact = zwidth.fit_buzz(ONSETS, period=1e-3, noise=1e-6)
    for fit in (onset_fit, exact):
        summary = dict(summarize_fit(fit))
        for text in re.findall(r"\(95 %: (.*?)\)", f"{summary['device']}, {summary['K_max']}"):
            low, high = text.split(" to ")
            assert low != high
