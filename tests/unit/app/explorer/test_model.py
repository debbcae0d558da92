"""Data shown by the explorer, against the library's functions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tolerances import CONTOUR, EDGE_RADIUS, RESPONSE, RIDGE

import zwidth
from zwidth.app.explorer import model
from zwidth.app.explorer.controls import Controls, normalized_controls
from zwidth.app.printing import name_verdict, spell_radius

CHOICES = {
    "rigid": {},
    "fractional delay": {"delay": 1.3},
    "rigid operator": {"operator": "rigid"},
    "grasp": {"operator": "grasp"},
    "low-pass": {"velocity": "LowPass"},
    "window": {"velocity": "WindowedDifference", "velocity.samples": 5},
    "tip": {"coupling": "tip", "damping": 2},
    "all": {"velocity": "Butterworth", "operator": "grasp", "coupling": "motor"},
}


@pytest.fixture(params=CHOICES)
def scene(request):
    return Controls().change(CHOICES[request.param]).scene


def test_outline_of_a_rigid_device_is_its_boundary():
    scene = Controls().scene
    region = zwidth.stable_region(scene.delta, scene.d)
    (edge,), units = scene.stable_region(), scene.units
    np.testing.assert_array_equal(edge[:2], (region.alpha * units.stiffness, region.beta * units.virtual_damping))
    inner = (region.omega > 0) & (region.omega < np.pi)
    exact = scene.boundary(region.omega[inner] / scene.timing.period)
    np.testing.assert_allclose(edge[0][inner], exact.stiffness, rtol=RIDGE.float64, atol=1e-9 * exact.stiffness.max())


def test_outline_has_a_pole_on_the_unit_circle(scene):
    shown = model.show_outlines(scene)["edge"]
    x, y = shown["x"], shown["y"]
    finite = np.isfinite(x)
    radius = np.abs(scene.poles(x[finite], y[finite])).max(-1)
    assert np.abs(radius - 1.0).max() < EDGE_RADIUS.float64


def test_fast_verdict_agrees_with_assess(scene):
    for stiffness in (-100.0, 3e3, 9e3, 60e3):
        changed = scene.replace(stiffness=stiffness)
        stable, poles = bool(changed.decide_stability(method="companion").stable), changed.poles()
        verdict = zwidth.assess(changed)
        assert stable == verdict.stable
        assert np.abs(poles).max() == pytest.approx(verdict.spectral_radius, rel=1e-9)


def test_passive_outline_separates_passive_walls(scene):
    edge: Any = model.find_passive_boundary(scene)
    if scene.device.coupling is not None and scene.device.coupling.sensor == "tip":
        assert edge is None
        return
    inner = slice(1, -1)
    for scale, expected in ((1 - 1e-6, True), (1 + 1e-6, False)):
        assert np.all(scene.is_passive(edge[0][inner] * scale, edge[1][inner] * scale) == expected)


def test_passive_outline_is_empty_without_damping():
    edge: Any = model.find_passive_boundary(Controls().change({"damping": 0}).scene)
    assert edge[0].size == edge[1].size == 0


def test_step_response_agrees_with_the_library():
    scene = Controls().change({"delay": 1.3}).scene
    time, position = model.compute_step_response(scene, 60)
    units = scene.units
    exact = zwidth.step_response(*scene.normalized, periods=61, substeps=1)
    np.testing.assert_allclose(time, exact.time * scene.timing.period, rtol=1e-14)
    np.testing.assert_allclose(position * units.stiffness, exact.position, atol=RESPONSE.float64 * exact.position.max())


def test_gain_crossover_is_on_the_unit_circle(scene):
    verdict = zwidth.assess(scene)
    shown = model.compute_open_loop(scene, verdict)["crossover"]
    cross = complex(shown["x"][0], shown["y"][0])
    assert abs(cross) == pytest.approx(1.0, rel=1e-9)
    # The sign of the margin is that of the verdict.
    assert abs(np.degrees(np.angle(-cross))) == pytest.approx(abs(verdict.phase_margin), rel=1e-6)


def test_ridge_path_contains_the_maximum():
    for change in ({}, {"velocity": "LowPass"}):
        scene = Controls().change(change).scene
        best = scene.max_stiffness()
        x, y = model.compute_ridge(scene)
        middle = (x.size - 1) // 4
        assert x[middle] == pytest.approx(float(best.stiffness), rel=1e-9)
        assert y[middle] == pytest.approx(float(best.virtual_damping), rel=1e-6)
        assert np.all(np.diff(x) > 0)


def test_contours_have_the_labeled_radius(scene):
    across, up = model.choose_ranges(scene.stable_region()[0][:2], (10e3, 40.0))
    contours = model.find_contours(scene, across, up)
    levels = {}
    for x, y in zip(contours["xs"], contours["ys"], strict=True):
        radius = scene.spectral_radius(x, y)
        level = min(model.LEVELS, key=lambda candidate: abs(candidate - np.median(radius)))
        levels[level] = float(np.median(np.abs(radius - level)))
    assert levels
    assert max(levels.values()) < CONTOUR.float64
    # On a chart of 700 x 330 pixels no labels overlap, and only very short contours are unlabeled.
    width, height = np.ptp(across), np.ptp(up)
    labels = [label for label in zip(contours["x"], contours["y"], contours["text"], strict=True) if label[2]]
    for k, (x, y, _) in enumerate(labels):
        for other_x, other_y, _ in labels[:k]:
            assert abs(x - other_x) / width > 26 / 700 or abs(y - other_y) / height > 10 / 330
    for x, y, text in zip(contours["xs"], contours["ys"], contours["text"], strict=True):
        assert text or np.ptp(x) / width > 0.02 or np.ptp(y) / height > 0.02


def test_axis_limits_contain_outline_and_wall():
    (edge,) = Controls().scene.stable_region()
    for wall in ((0.0, 0.0), (30e3, 150.0), (-9e3, 40.0)):
        across, up = model.choose_ranges(edge[:2], wall)
        assert across[0] <= min(edge[0].min(), wall[0]) < max(edge[0].max(), wall[0]) <= across[1]
        assert up[0] <= min(edge[1].min(), wall[1]) < max(edge[1].max(), wall[1]) <= up[1]
    # A very distant wall is excluded, because it would shrink the outline to a point.
    assert model.choose_ranges(edge[:2], (1e9, 40.0)) == model.choose_ranges(edge[:2], (10e3, 40.0))
    nothing = np.empty(0), np.empty(0)
    assert all(low < high for low, high in model.choose_ranges(nothing, (0.0, 0.0)))


def test_hit_agrees_with_simulate():
    scene = Controls().scene
    _, position, force, text = model.simulate_hit(scene, 50)
    hit = scene.simulate(start_position=-5e-4, start_velocity=0.1, contact="unilateral", periods=50)
    np.testing.assert_array_equal(position, hit.position)
    np.testing.assert_array_equal(force, hit.wall_force)
    assert int(hit.bounces) == 1
    assert text == "(leaves the wall after 1 contact within 50.0 ms)"
    assert position[0] < 0 < position.max()


def test_strongly_damped_device_reaches_the_wall():
    scene = normalized_controls(0.5, 0.4, 1.0, 1.0).scene
    _, position, force, _ = model.simulate_hit(scene, 50)
    assert position[0] < 0 < position.max()
    assert np.any(force)


def test_large_radius_is_printed_in_scientific_notation():
    assert spell_radius(1.25) == "spectral radius 1.250000"
    assert spell_radius(2.2e41) == "spectral radius 2.200e+41"


def test_normalized_text_contains_the_values_of_the_verdict():
    verdict: Any = zwidth.assess(normalized_controls(0.1, 0.4, 0.1, 1.0).scene)
    text = "\n".join(model.format_normalized_verdict(verdict))
    for number in (verdict.alpha_max, verdict.beta_at_max, verdict.stiffness_limit, verdict.gain_margin):
        assert f"{number:.4g}" in text
    assert "N/m" not in text


@pytest.mark.parametrize("delay", [0, 2, 70])
def test_bode_plot_agrees_with_the_frequency_response(delay):
    """The reference phase is unwrapped without the delay, so that it changes by less than 180 degrees between
    samples.
    """
    scene = Controls().change({"delay": delay}).scene
    shown = model.compute_open_loop(scene, zwidth.assess(scene))["bode"]
    prompt = scene.replace(delay=0).frequency_response(frequency=shown["x"])
    np.testing.assert_allclose(shown["gain"], 20 * np.log10(np.abs(prompt)), atol=1e-6)
    delay_phase = 360 * shown["x"] * delay * 1e-3
    np.testing.assert_allclose(shown["phase"], np.degrees(np.unwrap(np.angle(prompt))) - delay_phase, atol=1e-5)


RINGING = zwidth.Device(0.1, 1.0, modes=[zwidth.Mode(frequency=40, damping_ratio=0.005, mass=-2.0)])


@pytest.mark.parametrize(
    "scene",
    [
        Controls().scene,
        # The crossover is on the flank of a resonance, where the phase changes by degrees between samples.
        zwidth.Scene(RINGING, zwidth.Timing(1e-3, 1e-3), zwidth.VirtualWall(5e3, 4.0)),
    ],
    ids=["rigid", "ringing"],
)
def test_margins_are_marked_on_the_bode_plot(scene):
    verdict = zwidth.assess(scene)
    shown = model.compute_open_loop(scene, verdict)
    assert shown["crossover"]["phase"][0] + 180 == pytest.approx(verdict.phase_margin, abs=1e-6)
    loop = scene.frequency_response(frequency=shown["turned"]["hertz"])
    assert shown["turned"]["gain"] == pytest.approx(20 * np.log10(np.abs(loop)), abs=1e-6)


@pytest.mark.parametrize(
    "wall, x, y, angle",
    [
        ((5, 5), None, None, None),
        ((100, 5), 9.7, 5, -90),
        ((-1, 5), 0.3, 5, 90),
        ((5, 11), 5, 9.7, 0),
        ((-1, -1), 0.3, 0.3, 135),
    ],
)
def test_arrow_at_the_border_points_to_the_wall(wall, x, y, angle):
    arrow = model.place_arrow(wall, (0.0, 10.0), (0.0, 10.0))
    if angle is None:
        assert arrow["x"] == []
        return
    assert (arrow["x"], arrow["y"]) == ([pytest.approx(x)], [pytest.approx(y)])
    assert np.degrees(arrow["angle"][0]) % 360 == pytest.approx(angle % 360)


def test_islands_are_labeled_at_their_upper_end():
    scene = Controls().scene.replace(velocity=zwidth.WindowedDifference(24))
    (island,) = scene.islands()
    labels = model.name_islands(scene)
    assert (labels["text"], labels["y"]) == (["island"], [island.virtual_damping[1]])
    assert island.stiffness[0] < labels["x"][0] < island.stiffness[1]
    assert model.name_islands(Controls().scene)["text"] == []


@pytest.mark.parametrize(
    "stiffness, verdict_name, outside", [(10e3, "Stable", 0), (30e3, "Unstable", 2), (0, "Marginal", 0)]
)
def test_captions_agree_with_the_verdict(stiffness, verdict_name, outside):
    scene = Controls().scene.replace(stiffness=stiffness)
    verdict = zwidth.assess(scene)
    poles = model.caption_poles(scene.poles(), name_verdict(verdict))
    assert poles.startswith(f"{verdict_name}: {f'{outside} of 4' if outside else ''}")
    captions = model.caption_curves(verdict, False)
    assert captions["nyquist_words"].startswith(f"{verdict_name}: ")
    assert ("mirror image encircle" in captions["nyquist_words"]) == (verdict_name == "Unstable")
    assert ("phase" in captions["bode_words"]) == (verdict_name != "Marginal")
    assert {"Stable": "decays", "Unstable": "grows", "Marginal": "neither"}[verdict_name] in captions["step_words"]
