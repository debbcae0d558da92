"""Test the maximum stiffness and its interval for devices with a resonance that the log does not show.

References: scenes that include the resonance, and sampled mixtures.
"""

from dataclasses import replace

import numpy as np
import pytest
from measured_devices import PERIOD, TrueDevice

import zwidth
from zwidth.core.status import Status
from zwidth.identification.extended_model import Recordings
from zwidth.identification.friction_model import Recording
from zwidth.identification.grid_limits import GridLimits
from zwidth.identification.model_selection import choose_structure
from zwidth.identification.output_error import fit_model
from zwidth.identification.unmodeled_dynamics import HiddenResonances, sample_resonances

SKIP, DELAY = 22, 1.3e-3
SCENES = {
    "rigid": {},
    "resonance": {"modes": (zwidth.Mode(frequency=150, damping_ratio=0.02, mass=0.5),)},
    "negative mass ratio": {"modes": (zwidth.Mode(frequency=150, damping_ratio=0.02, mass=-1.0),)},
    "lag": {"actuator": zwidth.Actuator(time_constant=1e-3)},
}


@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=200)])
def test_stiffness_limits_on_a_frequency_grid_match_scenes(velocity):
    lines = np.concatenate([np.geomspace(0.2, 499.0, 1500), 150.0 + np.linspace(-15.0, 15.0, 301)])
    lines, timing = np.unique(lines), zwidth.Timing(period=PERIOD, delay=DELAY)
    scenes = [zwidth.Scene(zwidth.Device(0.1, 3.0, **parts), timing, velocity=velocity) for parts in SCENES.values()]
    responses = np.array([[scene.frequency_response(*wall, lines) for scene in scenes] for wall in ((1, 0), (0, 1))])
    limits = GridLimits(-1.0 / responses[0], responses[1] / responses[0]).find_stiffness_max()
    exact = [float(scene.max_stiffness(negative_damping=False).stiffness) for scene in scenes]
    np.testing.assert_allclose(limits, exact, rtol=5e-3)


def simulate_log(modes, encoder, seed=0, count=2000):
    """Return a device, the forces, and positions read by a noisy encoder."""
    true = TrueDevice("", 0.1, 3.0, 0.0, modes, DELAY, PERIOD, encoder, 3.0)
    rng = np.random.default_rng(seed)
    force = 3.0 * np.repeat(rng.choice([-1.0, 1.0], count // 25), 25)
    exact = true.play(force, read=False)
    return true, force, encoder * np.round(exact / encoder + 0.5 * rng.standard_normal(force.size))


def test_effect_of_hidden_resonance_on_max_stiffness_matches_its_scene(monkeypatch):
    _, force, position = simulate_log((), 1e-4)
    best = fit_model(Recordings((Recording(force, position[SKIP:], SKIP),), resolution=1e-4))
    best, _, bank, _ = choose_structure(best)
    velocity = zwidth.BackwardDifference()
    scene = best.model.normalize(best.theta, PERIOD).to_scene(PERIOD, velocity)
    assert bank is not None
    share, rows = 0.05, [300, 360, *(np.flatnonzero(bank.ratio == ratio)[k] for ratio, k in ((0.03, 45), (0.2, 50)))]
    draws = bank.select(np.array([rows[0], *rows])), share * np.array([0.0, 1.0, 1.0, 1.0, 1.0])
    monkeypatch.setattr("zwidth.identification.unmodeled_dynamics._draw_modes", lambda _: (1.0, *draws))
    sampled = sample_resonances(best, scene, bank)
    assert sampled is not None
    ratios = sampled.stiffness_max
    for ratio, row in zip(ratios, rows, strict=True):
        # Correct the other parameters for the bias that the resonance causes.
        theta = best.theta - share * np.append(bank.absorbed[row, :3], np.zeros(4))
        corrected = best.model.normalize(theta, PERIOD).to_scene(PERIOD, velocity)
        mode = zwidth.Mode(bank.frequency[row] / PERIOD, bank.ratio[row], scene.device.mass / share)
        with_mode = replace(corrected, device=replace(corrected.device, modes=(mode,)))
        exact = with_mode.max_stiffness(negative_damping=False).stiffness / scene.max_stiffness().stiffness
        assert ratio == pytest.approx(float(exact), rel=0.01)


def test_interval_matches_quantiles_of_a_sampled_mixture():
    _, force, position = simulate_log((), 1e-4)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert fit.hidden is not None
    assert fit.degrees_of_freedom is not None
    rng, count = np.random.default_rng(0), 400_000
    for odds, ratios in ((0.0, [0.5]), (0.3, [0.4, 0.9, 1.2]), (4.0, [0.2, 1.0])):
        mixture = replace(fit, hidden=HiddenResonances(odds, np.array(ratios)), lag=None)
        has_resonance = rng.random(count) < odds / (1.0 + odds)
        middle = fit.stiffness_max * np.where(has_resonance, rng.choice(ratios, count), 1.0)
        sampled = middle * np.exp(
            fit.stiffness_error / fit.stiffness_max * rng.standard_t(fit.degrees_of_freedom, count)
        )
        low, high = np.quantile(sampled, [0.025, 0.975])
        interval = mixture.intervals["stiffness_max"]
        assert interval == pytest.approx((low, high), abs=0.1 * fit.stiffness_error)
    # The interval always contains the reported K_max.
    probable = replace(fit, hidden=HiddenResonances(1e4, np.array([0.5])), lag=None)
    assert probable.intervals["stiffness_max"].high == fit.stiffness_max
    not_converged = replace(fit, status=int(Status.NOT_CONVERGED))
    assert np.isnan(not_converged.intervals["stiffness_max"]).all()


def test_interval_covers_the_effect_of_an_invisible_resonance():
    covered, widths = 0, []
    modes = ((270.0, 0.02, 0.15),)
    for seed in range(4):
        true, force, position = simulate_log(modes, 2e-4, seed)
        fit = zwidth.fit_log(PERIOD, position, force)
        assert not fit.modes
        low, high = fit.intervals["stiffness_max"]
        limit = true.limit_of_walls()
        covered += fit.is_unreliable or low <= limit <= high
        assert abs(limit - fit.stiffness_max) > fit.coverage_factor * fit.stiffness_error or fit.is_unreliable
        # An encoder that would reveal the resonance leaves the interval narrow.
        fit = zwidth.fit_log(PERIOD, simulate_log((), 1e-7, seed)[2], force)
        widths.append(np.ptp(fit.intervals["stiffness_max"]) / (2.0 * fit.coverage_factor * fit.stiffness_error))
    assert covered == 4
    assert max(widths) < 20.0
