"""K_max of devices with a resonance that a log does not show, against scenes that have it; and its interval."""

from dataclasses import replace

import numpy as np
import pytest
from measured_devices import PERIOD, TrueDevice

import zwidth
from zwidth.core.status import Status
from zwidth.identification.critical_controller import GridLimits
from zwidth.identification.extended_model import Recordings
from zwidth.identification.friction_model import Recording
from zwidth.identification.model_selection import choose_structure
from zwidth.identification.output_error import fit_model
from zwidth.identification.unmodeled_dynamics import HiddenResonances, sample_resonances

SKIP, DELAY = 22, 1.3e-3
SCENES = {
    "rigid": {},
    "resonance": {"modes": (zwidth.Mode(frequency=150, damping_ratio=0.02, mass=0.5),)},
    "beyond a node": {"modes": (zwidth.Mode(frequency=150, damping_ratio=0.02, mass=-1.0),)},
    "lag": {"actuator": zwidth.Actuator(time_constant=1e-3)},
}


@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=200)])
def test_rows_on_a_grid_have_the_stiffest_walls_of_scenes(velocity):
    lines = np.concatenate([np.geomspace(0.2, 499.0, 1500), 150.0 + np.linspace(-15.0, 15.0, 301)])
    lines, timing = np.unique(lines), zwidth.Timing(period=PERIOD, delay=DELAY)
    scenes = [zwidth.Scene(zwidth.Device(0.1, 3.0, **parts), timing, velocity=velocity) for parts in SCENES.values()]
    answers = np.array([[scene.frequency_response(*wall, lines) for scene in scenes] for wall in ((1, 0), (0, 1))])
    found = GridLimits(-1.0 / answers[0], answers[1] / answers[0]).find_stiffness_max()
    exact = [float(scene.max_stiffness(negative_damping=False).stiffness) for scene in scenes]
    np.testing.assert_allclose(found, exact, rtol=5e-3)


def play(modes, encoder, seed=0, count=2000):
    """A device, its fit and the log."""
    true = TrueDevice("", 0.1, 3.0, 0.0, modes, DELAY, PERIOD, encoder, 3.0)
    rng = np.random.default_rng(seed)
    force = 3.0 * np.repeat(rng.choice([-1.0, 1.0], count // 25), 25)
    exact = true.play(force, read=False)
    return true, force, encoder * np.round(exact / encoder + 0.5 * rng.standard_normal(force.size))


def test_what_a_resonance_makes_of_the_stiffest_wall_is_that_of_the_scene_with_it(monkeypatch):
    _, force, position = play((), 1e-4)
    best = fit_model(Recordings((Recording(force, position[SKIP:], SKIP),), resolution=1e-4))
    best, _, bank, _ = choose_structure(best)
    velocity = zwidth.BackwardDifference()
    scene = best.model.normalize(best.theta, PERIOD).to_scene(PERIOD, velocity)
    assert bank is not None
    share, rows = 0.05, [300, 360, *(np.flatnonzero(bank.ratio == ratio)[k] for ratio, k in ((0.03, 45), (0.2, 50)))]
    drawn = bank.select(np.array([rows[0], *rows])), share * np.array([0.0, 1.0, 1.0, 1.0, 1.0])
    monkeypatch.setattr("zwidth.identification.unmodeled_dynamics._draw_modes", lambda _: (1.0, *drawn))
    found = sample_resonances(best, scene, bank)
    assert found is not None
    ratios = found.stiffness_max
    for ratio, row in zip(ratios, rows, strict=True):
        # Correct the other parameters for the bias by the resonance.
        theta = best.theta - share * np.append(bank.absorbed[row, :3], np.zeros(4))
        moved = best.model.normalize(theta, PERIOD).to_scene(PERIOD, velocity)
        mode = zwidth.Mode(bank.frequency[row] / PERIOD, bank.ratio[row], scene.device.mass / share)
        there = replace(moved, device=replace(moved.device, modes=(mode,)))
        exact = there.max_stiffness(negative_damping=False).stiffness / scene.max_stiffness().stiffness
        assert ratio == pytest.approx(float(exact), rel=0.01)


def test_the_interval_is_that_of_all_devices_alike():
    _, force, position = play((), 1e-4)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert fit.hidden is not None
    assert fit.degrees_of_freedom is not None
    rng, count = np.random.default_rng(0), 400_000
    for odds, ratios in ((0.0, [0.5]), (0.3, [0.4, 0.9, 1.2]), (4.0, [0.2, 1.0])):
        alike = replace(fit, hidden=HiddenResonances(odds, np.array(ratios)), lag=None)
        hides = rng.random(count) < odds / (1.0 + odds)
        middle = fit.stiffness_max * np.where(hides, rng.choice(ratios, count), 1.0)
        drawn = middle * np.exp(fit.stiffness_error / fit.stiffness_max * rng.standard_t(fit.degrees_of_freedom, count))
        low, high = np.quantile(drawn, [0.025, 0.975])
        found = alike.intervals["stiffness_max"]
        assert found == pytest.approx((low, high), abs=0.1 * fit.stiffness_error)
    # The K_max that is printed lies in it all the same.
    likely = replace(fit, hidden=HiddenResonances(1e4, np.array([0.5])), lag=None)
    assert likely.intervals["stiffness_max"].high == fit.stiffness_max
    lost = replace(fit, status=int(Status.NOT_CONVERGED))
    assert np.isnan(lost.intervals["stiffness_max"]).all()


def test_the_interval_holds_what_a_resonance_that_does_not_show_leaves():
    held, clear = 0, []
    modes = ((270.0, 0.02, 0.15),)
    for seed in range(4):
        true, force, position = play(modes, 2e-4, seed)
        fit = zwidth.fit_log(PERIOD, position, force)
        assert not fit.modes
        low, high = fit.intervals["stiffness_max"]
        limit = true.limit_of_walls()
        held += fit.is_unreliable or low <= limit <= high
        assert abs(limit - fit.stiffness_max) > fit.coverage_factor * fit.stiffness_error or fit.is_unreliable
        # An encoder that would show it leaves the interval as it is.
        fit = zwidth.fit_log(PERIOD, play((), 1e-7, seed)[2], force)
        clear.append(np.ptp(fit.intervals["stiffness_max"]) / (2.0 * fit.coverage_factor * fit.stiffness_error))
    assert held == 4
    assert max(clear) < 20.0
