"""Studies of devices with filters, couplings and operators, against scenes and pole counts."""

import json
from typing import Any

import numpy as np
import pytest
from matplotlib.path import Path as Polygon

import zwidth
from zwidth import plotting
from zwidth.plotting.table import SI_COLUMNS, select
from zwidth.studies.boundary import BoundaryStudy, CompareStudy
from zwidth.studies.design import FiltersStudy
from zwidth.studies.responses import RecommendStudy
from zwidth.units.formatting import with_unit

DEVICE = {"mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": "1 periods"}
ISLANDS = {**DEVICE, "velocity": {"kind": "windowed_difference", "samples": 24}}
# A window for which the boundary curve has a pole between two stable walls.
WITH_POLE = {**DEVICE, "velocity": {"kind": "windowed_difference", "samples": 25}}
TIP = {**DEVICE, "coupling": {"mass": 0.05, "stiffness": 2e4, "damping": 2, "sensor": "tip"}}
WITH_OPERATOR = {**DEVICE, "operator": {"mass": 0.554, "damping": 6.45, "stiffness": 135, "coupling_stiffness": 1000}}


def make_boundary_study(device):
    return BoundaryStudy.model_validate({"kind": "boundary", "name": "b", "device": device})


@pytest.mark.parametrize(
    "device", [ISLANDS, WITH_POLE, TIP, WITH_OPERATOR], ids=["islands", "poles", "tip", "operator"]
)
def test_outlines_contain_exactly_the_stable_walls(device):
    study = make_boundary_study(device)
    assert study.device is not None
    scene, table = study.device.to_scene(), study.compute(None, True).table
    assert {"d", "delta", "alpha", "beta", "piece", "number"} <= set(table)
    inside = np.zeros((80, 80), int)
    corners = [table[name] for name in SI_COLUMNS]
    grid = [
        np.linspace(column.min() - 0.1 * np.ptp(column), column.max() + 0.1 * np.ptp(column), 80) for column in corners
    ]
    points = np.stack([column.ravel() for column in np.meshgrid(*grid, indexing="ij")], -1)
    for number in np.unique(table["number"]):
        piece = select(table, number=number)
        outline = np.stack([piece[name] for name in SI_COLUMNS], -1)
        np.testing.assert_array_equal(outline[0], outline[-1])
        inside += Polygon(outline, closed=True).contains_points(points).reshape(inside.shape)
    stable = scene.is_stable(grid[0][:, None], grid[1][None, :])
    # A polygon of several hundred vertices misclassifies few walls near the boundary.
    assert np.mean((inside % 2 == 1) != stable) < 2e-3
    assert 0.02 < stable.mean() < 0.9


def test_islands_are_labeled_and_drawn():
    outcome = make_boundary_study(ISLANDS).compute(None, True)
    assert list(dict.fromkeys(outcome.table["piece"].tolist())) == ["outline", "island"]
    (ax,) = outcome.figures[""]()
    assert [line.get_label() for line in ax.lines[:3]] == ["outline 1", "island 2", "stiffest"]


def test_recommendation_with_the_sensor_at_the_tip_has_no_passivity():
    device = {"mass": 0.1, "damping": 10, "period": 1e-3, "delay": 1e-3}
    tip = {"mass": 0.05, "stiffness": 20e3, "damping": 1.0, "sensor": "tip"}
    study = RecommendStudy.model_validate({"kind": "recommend", "name": "r", "device": device | {"coupling": tip}})
    outcome = study.compute(None, alone=True)
    best = json.loads(outcome.documents["recommendation.json"])["recommended"]
    assert best["stable"] is True
    assert best["passive"] is None
    assert "passive: not known with the sensor at the tip" in outcome.documents["recommendation.md"]


def test_recommended_wall_is_stable_with_margins_and_damping_range():
    study = RecommendStudy.model_validate({"kind": "recommend", "name": "r", "device": WITH_OPERATOR})
    outcome = study.compute(None, True)
    report = json.loads(outcome.documents["recommendation.json"])
    best, scene = report["recommended"], study.device.to_scene()
    stiffness = best["stiffness"]
    assert 0 < stiffness <= 0.75 * report["maximum"]["stiffness"]
    assert best["phase_margin"] >= 30
    assert best["gain_margin"] >= 2
    lower, upper = best["virtual_damping_lower"], best["virtual_damping_upper"]
    inside = np.linspace(lower, upper, 101)[1:-1]
    assert best["stable"]
    assert scene.is_stable(stiffness, inside).all()
    outside = np.array([lower, upper]) + 1e-6 * (upper - lower) * np.array([-1, 1])
    assert not scene.is_stable(stiffness, outside).any()
    wall = stiffness, best["virtual_damping"]
    assert best["passive"] == bool(scene.is_passive(*wall))
    assert best["spectral_radius"] == pytest.approx(np.abs(scene.poles(*wall)).max(), rel=1e-9)
    assert best["decay_time"] == pytest.approx(-1e-3 * np.log(50) / np.log(best["spectral_radius"]))
    assert outcome.notes == ()
    assert len(outcome.figures[""]()) == 2


def test_recommendation_excludes_islands():
    study = RecommendStudy.model_validate({"kind": "recommend", "name": "r", "device": ISLANDS})
    outcome = study.compute(None, True)
    report = json.loads(outcome.documents["recommendation.json"])
    assert report["recommended"]["stable"] is True
    assert report["maximum"]["stiffness"] == pytest.approx(6846.364, abs=1e-3)
    (note,) = outcome.notes
    assert "island of stable walls, K from 7.537 kN/m to 9.037 kN/m" in note


def test_recommended_damping_may_differ_from_that_of_the_maximum():
    study = RecommendStudy.model_validate(
        {"kind": "recommend", "name": "r", "device": WITH_POLE, "stiffness_fraction": 0.5}
    )
    outcome = study.compute(None, True)
    report, scene = json.loads(outcome.documents["recommendation.json"]), study.device.to_scene()
    best, maximum = report["recommended"], report["maximum"]
    assert best["stiffness"] == 0.5 * maximum["stiffness"]
    assert not scene.is_stable(best["stiffness"], maximum["virtual_damping"])
    assert np.abs(scene.poles(best["stiffness"], best["virtual_damping"])).max() < 1
    assert "B from -41.61 N s/m to 18.51 N s/m is stable" in outcome.documents["recommendation.md"]
    assert any("B differs from that of the stiffest wall" in note for note in outcome.notes)


def test_comparison_has_a_row_and_outlines_per_device():
    devices = [{"label": "free", **DEVICE}, {"label": "held", **WITH_OPERATOR}, {"label": "windowed", **ISLANDS}]
    study = CompareStudy.model_validate({"kind": "compare", "name": "c", "devices": devices})
    outcome = study.compute(None, True)
    assert outcome.table["label"].tolist() == ["free", "held", "windowed"]
    assert outcome.table["islands"].tolist() == [0, 0, 1]
    # The first device is that of the paper, which has a closed form.
    ridge = zwidth.alpha_max(0.1, 1.0)
    assert outcome.table[SI_COLUMNS[0]][0] == pytest.approx(1e5 * float(ridge.alpha), rel=1e-9)
    assert "free,1,outline" in outcome.documents["c_outlines.csv"]
    (ax,) = outcome.figures[""]()
    assert [line.get_label() for line in ax.lines].count("stiffest") == 3
    # As in README.md for this device, one line per device.
    assert outcome.answer[0] == "free: K_max = 19.86 kN/m at B = 41.60 N s/m"
    assert [line.partition(":")[0] for line in outcome.answer] == ["free", "held", "windowed"]


@pytest.fixture(scope="module")
def filters():
    values = {"damping": [0, 10], "cutoff": [10, 30, 100], "samples": [5, 10, 15], "resolution": "20 um"}
    raw = {"kind": "filters", "name": "f", "device": DEVICE, "noise_limit": "1 mm/s", **values}
    return FiltersStudy.model_validate(raw).compute(None, True)


def test_best_filter_is_the_stiffest_within_the_noise_limit(filters):
    for damping in (0.0, 10.0):
        rows = select(filters.table, damping_N_s_per_m=damping)
        quiet = rows["velocity_noise_m_per_s"] <= 1e-3
        assert 0 < quiet.sum() < quiet.size
        assert rows[SI_COLUMNS[0]][rows["best"]].tolist() == [rows[SI_COLUMNS[0]][quiet].max()]
        assert any(line.startswith(f"b = {with_unit(damping, 'N s/m')}: ") for line in filters.answer)


def test_figures_of_filters(filters):
    panels = filters.figures[""]()
    assert [line.get_label() for line in panels[0].lines[::2]] == ["b = 0", "b = 10"]
    (ax,) = filters.figures["_noise"]()
    assert [line.get_label() for line in ax.lines].count("best") == 2
    (line,) = [line for line in ax.lines if line.get_label() == "low_pass, b = 10"]
    np.testing.assert_allclose(
        line.get_ydata(), select(filters.table, estimate="low_pass", damping_N_s_per_m=10.0)[SI_COLUMNS[0]] / 1e3
    )
    assert plotting.draw_filters(filters.table, panels) is not None


def test_a_ridge_includes_a_position_filter(tmp_path):
    text = """\
version: 1
name: filtered
scene: {mass: 100 g, damping: 10, rate: 1 kHz, delay: 1 ms, position: {kind: exponential, coefficient: 0.3}}
studies:
  - {kind: ridge, name: one}
  - {kind: ridge, name: curve, delta: [0.05, 0.1, 0.2]}
  - {kind: ridge, name: delays, d: [0, 2]}
  - {kind: ridge, name: rigid, delta: 0.1, d: 1}
"""
    file = tmp_path / "filtered.yaml"
    file.write_text(text, encoding="utf-8")
    scene = zwidth.load_scene(file)
    studies: Any = zwidth.load_config(file).studies
    one, curve, delays, rigid = (study.compute(None, False).table for study in studies)
    top = scene.max_stiffness()
    assert one["stiffness_N_per_m"] == pytest.approx(top.stiffness)
    assert one["omega"] == pytest.approx(2 * np.pi * top.frequency * 1e-3)
    for delta, alpha in zip(curve["delta"], curve["alpha_max"], strict=True):
        damped = scene.replace(damping=delta * 100).max_stiffness()
        assert alpha == pytest.approx(damped.stiffness / 1e5, rel=1e-9)
    for d, alpha in zip(delays["d"], delays["alpha_max"], strict=True):
        assert alpha == pytest.approx(scene.replace(delay=f"{d:g} periods").max_stiffness().stiffness / 1e5, rel=1e-9)
    # With both delta and d, the study is about a rigid mass without parts, as before.
    assert rigid["alpha_max"] == pytest.approx(zwidth.alpha_max(0.1, 1).alpha)
