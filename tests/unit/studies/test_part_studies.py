"""Studies of devices with parts: outlines, recommendations, comparisons and filters, against scenes and pole counts."""

import json

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
# Where the curve runs to infinity between two stable walls.
POLES = {**DEVICE, "velocity": {"kind": "windowed_difference", "samples": 25}}
TIP = {**DEVICE, "coupling": {"mass": 0.05, "stiffness": 2e4, "damping": 2, "sensor": "tip"}}
HELD = {**DEVICE, "operator": {"mass": 0.554, "damping": 6.45, "stiffness": 135, "coupling_stiffness": 1000}}


def boundary_of(device):
    return BoundaryStudy.model_validate({"kind": "boundary", "name": "b", "device": device})


@pytest.mark.parametrize("device", [ISLANDS, POLES, TIP, HELD], ids=["islands", "poles", "tip", "held"])
def test_outlines_hold_the_stable_walls_and_no_others(device):
    study = boundary_of(device)
    assert study.device is not None
    scene, table = study.device.to_scene(), study.compute(None, True).table
    assert {"d", "delta", "alpha", "beta", "piece", "number"} <= set(table)
    inside = np.zeros((80, 80), int)
    corners = [table[name] for name in SI_COLUMNS]
    grid = [np.linspace(part.min() - 0.1 * np.ptp(part), part.max() + 0.1 * np.ptp(part), 80) for part in corners]
    points = np.stack([part.ravel() for part in np.meshgrid(*grid, indexing="ij")], -1)
    for number in np.unique(table["number"]):
        piece = select(table, number=number)
        outline = np.stack([piece[name] for name in SI_COLUMNS], -1)
        np.testing.assert_array_equal(outline[0], outline[-1])
        inside += Polygon(outline, closed=True).contains_points(points).reshape(inside.shape)
    stable = scene.is_stable(grid[0][:, None], grid[1][None, :])
    # A polygon of some hundreds of points misses walls next to the edge, one in a hundred of those near it at most.
    assert np.mean((inside % 2 == 1) != stable) < 2e-3
    assert 0.02 < stable.mean() < 0.9


def test_islands_are_told_apart_and_drawn():
    outcome = boundary_of(ISLANDS).compute(None, True)
    assert list(dict.fromkeys(outcome.table["piece"].tolist())) == ["outline", "island"]
    (ax,) = outcome.figures[""]()
    assert [line.get_label() for line in ax.lines[:3]] == ["outline 1", "island 2", "stiffest"]


def test_a_recommendation_with_the_sensor_at_the_tip_leaves_passivity_open():
    device = {"mass": 0.1, "damping": 10, "period": 1e-3, "delay": 1e-3}
    tip = {"mass": 0.05, "stiffness": 20e3, "damping": 1.0, "sensor": "tip"}
    study = RecommendStudy.model_validate({"kind": "recommend", "name": "r", "device": device | {"coupling": tip}})
    outcome = study.compute(None, alone=True)
    best = json.loads(outcome.documents["recommendation.json"])["recommended"]
    assert best["stable"] is True
    assert best["passive"] is None
    assert "passive: not known with the sensor at the tip" in outcome.documents["recommendation.md"]


def test_a_recommendation_has_a_stable_wall_and_the_damping_that_goes_with_it():
    study = RecommendStudy.model_validate({"kind": "recommend", "name": "r", "device": HELD})
    outcome = study.compute(None, True)
    found = json.loads(outcome.documents["recommendation.json"])
    best, scene = found["recommended"], study.device.to_scene()
    stiffness = best["stiffness"]
    assert 0 < stiffness <= 0.75 * found["maximum"]["stiffness"]
    assert best["phase_margin"] >= 30
    assert best["gain_margin"] >= 2
    lower, upper = best["virtual_damping_lower"], best["virtual_damping_upper"]
    inside = np.linspace(lower, upper, 101)[1:-1]
    assert best["stable"]
    assert scene.is_stable(stiffness, inside).all()
    beyond = np.array([lower, upper]) + 1e-6 * (upper - lower) * np.array([-1, 1])
    assert not scene.is_stable(stiffness, beyond).any()
    wall = stiffness, best["virtual_damping"]
    assert best["passive"] == bool(scene.is_passive(*wall))
    assert best["spectral_radius"] == pytest.approx(np.abs(scene.poles(*wall)).max(), rel=1e-9)
    assert best["decay_time"] == pytest.approx(-1e-3 * np.log(50) / np.log(best["spectral_radius"]))
    assert outcome.notes == ()
    assert len(outcome.figures[""]()) == 2


def test_a_recommendation_is_of_walls_that_soft_ones_lead_to():
    study = RecommendStudy.model_validate({"kind": "recommend", "name": "r", "device": ISLANDS})
    outcome = study.compute(None, True)
    found = json.loads(outcome.documents["recommendation.json"])
    assert found["recommended"]["stable"] is True
    assert found["maximum"]["stiffness"] == pytest.approx(6846.364, abs=1e-3)
    (note,) = outcome.notes
    assert "island of stable walls, K from 7.537 kN/m to 9.037 kN/m" in note


def test_a_share_that_is_not_stable_with_the_damping_of_the_stiffest_wall_has_another():
    study = RecommendStudy.model_validate(
        {"kind": "recommend", "name": "r", "device": POLES, "stiffness_fraction": 0.5}
    )
    outcome = study.compute(None, True)
    found, scene = json.loads(outcome.documents["recommendation.json"]), study.device.to_scene()
    best, most = found["recommended"], found["maximum"]
    assert best["stiffness"] == 0.5 * most["stiffness"]
    assert not scene.is_stable(best["stiffness"], most["virtual_damping"])
    assert np.abs(scene.poles(best["stiffness"], best["virtual_damping"])).max() < 1
    assert "B from -41.61 N s/m to 18.51 N s/m is stable" in outcome.documents["recommendation.md"]
    assert any("B differs from that of the stiffest wall" in note for note in outcome.notes)


def test_a_comparison_has_a_row_and_outlines_for_each_device():
    devices = [{"label": "free", **DEVICE}, {"label": "held", **HELD}, {"label": "windowed", **ISLANDS}]
    study = CompareStudy.model_validate({"kind": "compare", "name": "c", "devices": devices})
    outcome = study.compute(None, True)
    assert outcome.table["label"].tolist() == ["free", "held", "windowed"]
    assert outcome.table["islands"].tolist() == [0, 0, 1]
    # The first one is the paper's own device, for which there is a closed form.
    ridge = zwidth.alpha_max(0.1, 1.0)
    assert outcome.table[SI_COLUMNS[0]][0] == pytest.approx(1e5 * float(ridge.alpha), rel=1e-9)
    assert "free,1,outline" in outcome.documents["c_outlines.csv"]
    (ax,) = outcome.figures[""]()
    assert [line.get_label() for line in ax.lines].count("stiffest") == 3
    # As README.md has it for this device, and a line for each.
    assert outcome.answer[0] == "free: K_max = 19.86 kN/m at B = 41.60 N s/m"
    assert [line.partition(":")[0] for line in outcome.answer] == ["free", "held", "windowed"]


@pytest.fixture(scope="module")
def filters():
    values = {"damping": [0, 10], "cutoff": [10, 30, 100], "samples": [5, 10, 15], "resolution": "20 um"}
    raw = {"kind": "filters", "name": "f", "device": DEVICE, "noise_limit": "1 mm/s", **values}
    return FiltersStudy.model_validate(raw).compute(None, True)


def test_the_best_filter_is_the_stiffest_of_those_that_are_quiet(filters):
    for damping in (0.0, 10.0):
        rows = select(filters.table, damping_N_s_per_m=damping)
        quiet = rows["velocity_noise_m_per_s"] <= 1e-3
        assert 0 < quiet.sum() < quiet.size
        assert rows[SI_COLUMNS[0]][rows["best"]].tolist() == [rows[SI_COLUMNS[0]][quiet].max()]
        assert any(line.startswith(f"b = {with_unit(damping, 'N s/m')}: ") for line in filters.answer)


def test_figures_of_filters(filters):
    both = filters.figures[""]()
    assert [line.get_label() for line in both[0].lines[::2]] == ["b = 0", "b = 10"]
    (ax,) = filters.figures["_noise"]()
    assert [line.get_label() for line in ax.lines].count("best") == 2
    (line,) = [line for line in ax.lines if line.get_label() == "low_pass, b = 10"]
    np.testing.assert_allclose(
        line.get_ydata(), select(filters.table, estimate="low_pass", damping_N_s_per_m=10.0)[SI_COLUMNS[0]] / 1e3
    )
    assert plotting.draw_filters(filters.table, both) is not None
