"""Boundary, ridge, passivity, step, recommend and map studies, against the library's functions and pole counts."""

import json
import re

import numpy as np
import pytest

import zwidth
from zwidth.config.scenes import PhysicalScene
from zwidth.core.status import Status
from zwidth.model.checks import read_texts
from zwidth.plotting.table import stack
from zwidth.stability.rigid.passivity import passive_stiffness_slope
from zwidth.stability.rigid.poles import radius_by_companion
from zwidth.studies.boundary import BoundaryStudy, MapStudy, tabulate_boundary, tabulate_stable_intervals
from zwidth.studies.outcome import csv_text
from zwidth.studies.responses import RecommendStudy, StepStudy
from zwidth.studies.ridge import PassivityStudy, RidgeStudy, ridge_table, slope_table, trace_unit_outline

DELTAS = np.array([0.0, 0.5, 2.0, 2.5, 4.0])
DELAYS = np.array([0.0, 0.25, 0.9, 1.0, 4.0])


def read_csv(text):
    """Return a CSV table as text columns."""
    header, *rows = [line.split(",") for line in text.splitlines()]
    return dict(zip(header, np.array(rows).T, strict=True))


def test_stable_interval_at_zero_stiffness_agrees_with_poles():
    # alpha is small enough that beta moves by less than the step, and large enough that the pole near 1 is counted.
    alpha, step = 1e-7, 1e-3
    for interval in tabulate_stable_intervals(DELTAS, DELAYS):
        lower, upper, d = interval["beta_lower"], interval["beta_upper"], interval["d"]
        inside = radius_by_companion(alpha, np.stack([lower + step, upper - step]), DELTAS, d)
        outside = radius_by_companion(alpha, np.stack([lower - step, upper + step]), DELTAS, d)
        assert np.all(inside < 1), d
        assert np.all(outside >= 1), d


@pytest.mark.parametrize("d", [0.0, 0.5, 1.0, 2.0])
def test_passive_outline_separates_passive_walls(d):
    alpha, beta = trace_unit_outline(d)
    for delta in (0.1, 3.0):
        inside = zwidth.is_passive(delta * alpha * (1 - 1e-9), delta * beta * (1 - 1e-9), delta, d)
        outside = zwidth.is_passive(delta * alpha * (1 + 1e-9), delta * beta * (1 + 1e-9), delta, d)
        assert np.all(inside)
        assert not np.any(outside)


def test_passive_region_without_delay_is_colgates_triangle():
    alpha, beta = trace_unit_outline(0.0)
    np.testing.assert_allclose(alpha / 2 + np.abs(beta), 1.0, rtol=1e-13)


def test_maximum_passive_stiffness_is_below_the_stable_one():
    study = PassivityStudy.model_validate(
        {"kind": "passivity", "name": "p", "delta": [0.1, 1.0, 10.0], "d": [0, 0.5, 2]}
    )
    table = study.compute(None, alone=True).table
    assert np.all(table["alpha_max_passive"] < table["alpha_max"])
    np.testing.assert_allclose(table["alpha_max"], zwidth.alpha_max(table["delta"], table["d"]).alpha, rtol=1e-13)
    for d in (0.0, 0.5, 2.0):
        selected = table["d"] == d
        slopes = np.outer(table["delta"][selected], passive_stiffness_slope(d)).T
        np.testing.assert_array_equal((table["alpha_max_passive"][selected], table["beta_passive"][selected]), slopes)


def test_operator_does_not_affect_the_passivity_study():
    """Passivity holds for any operator, so only the device's damping counts, here a seventh of the total."""
    device = {"mass": 0.1, "damping": 1.0, "period": "1 ms", "delay": "1 ms"}
    scene = PhysicalScene.model_validate({**device, "operator": {"mass": 0.5, "damping": 6.0}})
    study = PassivityStudy.model_validate({"kind": "passivity", "name": "p", "delta": scene.delta, "d": scene.d})
    table = study.compute(scene, alone=True).table
    edge = table["alpha_max_passive"] * scene.to_scene().units.stiffness
    damping = table["beta_passive"] * scene.to_scene().units.virtual_damping
    assert abs(scene.to_scene().passivity_margin(edge, damping)) < 1e-12


def test_ridge_table_agrees_with_alpha_max():
    delta, d = np.linspace(0.0, 10.0, 7), np.array([0.0, 0.125, 3.0])
    table, notes = ridge_table(delta, d)
    assert notes == []
    expected = zwidth.alpha_max(np.tile(delta, 3), np.repeat(d, 7))
    np.testing.assert_array_equal(table["delta"], np.tile(delta, 3))
    np.testing.assert_array_equal(table["d"], np.repeat(d, 7))
    np.testing.assert_allclose(table["alpha_max"], expected.alpha, rtol=1e-13)
    assert [zwidth.RidgeKind[name.upper()] for name in table["kind"]] == list(expected.kind)
    assert table["kind"][6] == "corner"


def test_points_without_result_are_noted():
    _, notes = ridge_table(np.array([0.1, np.nan, np.inf]), np.array([0.0, 1.0]))
    assert notes == [f"alpha_max: 2 of 3 points have no result for d = {d}" for d in (0, 1)]


def test_ridge_study_tabulates_every_curve():
    study = RidgeStudy.model_validate({"kind": "ridge", "name": "r", "delta": [0, 1], "d": [0.5, 1]})
    outcome = study.compute(None, alone=True)
    assert list(outcome.table["d"]) == [0.5, 0.5, 1, 1]
    assert "delay_model" not in outcome.table
    assert list(outcome.figures) == [""]


def test_slope_at_strong_damping_approaches_its_limit():
    study = RidgeStudy.model_validate({"kind": "ridge", "name": "r", "delta": [1, 1e4], "d": [0, 1]})
    outcome = study.compute(None, alone=True)
    assert list(outcome.figures) == ["", "_slope"]
    slopes = slope_table(outcome.table)
    limits = [slopes["slope"][slopes["d"] == d][0] for d in (0.0, 1.0)]
    assert limits == pytest.approx((4.0, 1.0), rel=1e-14)
    strongest = outcome.table["alpha_max"][outcome.table["delta"] == 1e4] / 1e4
    assert strongest == pytest.approx(limits, rel=1e-3)
    # Delays without tabulated samples are included.
    assert 0.3 in slope_table({"d": np.array([0.3])})["d"]


def test_outline_has_named_pieces():
    edge = tabulate_boundary(3.0, 0.0)
    assert set(edge["piece"]) == {"complex_pair", "minus_one"}


def test_boundary_study_tabulates_boundary_ridge_and_passivity():
    study = BoundaryStudy.model_validate(
        {"kind": "boundary", "name": "b", "delta": [0, 0.5], "d": [0, 1], "ridge_path": True, "passivity": True}
    )
    table = study.compute(None, alone=True).table
    assert "stiffness_N_per_m" not in table
    curve = (table["curve"] == "boundary") & (table["piece"] == "complex_pair")
    # The first and last vertex of a lobe have alpha = 0 by definition.
    curve &= table["alpha"] > 1e-9
    expected = zwidth.boundary(table["omega"][curve], table["delta"][curve], table["d"][curve])
    np.testing.assert_allclose(table["alpha"][curve], expected.alpha, rtol=1e-12)
    np.testing.assert_allclose(table["beta"][curve], expected.beta, rtol=1e-12, atol=1e-14)
    ridge = table["curve"] == "ridge_path"
    np.testing.assert_allclose(
        table["alpha"][ridge], zwidth.alpha_max(table["delta"][ridge], table["d"][ridge]).alpha, rtol=1e-12
    )
    for d in (0.0, 1.0):
        path = table["delta"][ridge & (table["d"] == d)]
        assert (path.min(), path.max()) == (0.0, 0.5)
    assert set(table["delta"][table["curve"] == "passive"]) == {0.5}


def test_boundary_of_the_scene_itself_has_si_units():
    scene = PhysicalScene.model_validate({"mass": 0.1, "damping": 50, "period": "1 ms", "delay": "1 ms"})
    study = {"kind": "boundary", "name": "b", "delta": scene.delta, "d": scene.d}
    table = BoundaryStudy.model_validate(study).compute(scene, alone=True).table
    np.testing.assert_allclose(table["stiffness_N_per_m"], 1e5 * table["alpha"], rtol=1e-15)
    np.testing.assert_allclose(table["virtual_damping_N_s_per_m"], 1e2 * table["beta"], rtol=1e-15)
    other = BoundaryStudy.model_validate({**study, "d": 2}).compute(scene, alone=True).table
    assert "stiffness_N_per_m" not in other


def test_step_study_agrees_with_step_response():
    device = {"mass": 0.1, "damping": "10 N s/m", "period": "1 ms", "delay": "1 periods"}
    study = StepStudy.model_validate(
        {"kind": "step", "name": "s", "devices": [device], "stiffness_fraction": 0.75, "duration": "50 periods"}
    )
    table = study.compute(None, alone=True).table
    ridge = zwidth.alpha_max(0.1, 1)
    expected = zwidth.step_response(0.75 * float(ridge.alpha), float(ridge.beta), 0.1, 1, periods=50)
    np.testing.assert_allclose(table["position_m"], expected.position * 1e-3**2 / 0.1, rtol=1e-12)
    np.testing.assert_allclose(table["time_s"], expected.time * 1e-3, rtol=1e-12)
    assert table["label"][0] == "K = 14.89 kN/m, B = 41.60 N s/m"
    np.testing.assert_allclose(table["final_position_m"], expected.final_position * 1e-3**2 / 0.1, rtol=1e-12)
    np.testing.assert_allclose(table["settling_time_s"], expected.settling_time * 1e-3, rtol=1e-12)


def test_recommendation_is_a_fraction_of_the_maximum():
    """Values of the published device m = 0.1 kg, T = 1 ms, delta = 0.1, d = 1; unit conversion by hand."""
    device = {"mass": 0.1, "damping": "10 N s/m", "period": "1 ms", "delay": "1 periods"}
    study = RecommendStudy.model_validate(
        {"kind": "recommend", "name": "r", "device": device, "stiffness_fraction": 0.6, "duration": "50 periods"}
    )
    outcome = study.compute(None, alone=True)
    report = json.loads(outcome.documents["recommendation.json"])
    ridge = zwidth.alpha_max(0.1, 1)
    assert report["maximum"]["stiffness"] == pytest.approx(1e5 * float(ridge.alpha), rel=1e-12)
    best = report["recommended"]
    assert best["stiffness"] == pytest.approx(0.6e5 * float(ridge.alpha), rel=1e-12)
    assert best["virtual_damping"] == pytest.approx(1e2 * float(ridge.beta), rel=1e-12)
    assert best["stable"] is True
    assert ": 60 % of K_max = " in outcome.documents["recommendation.md"]


@pytest.mark.parametrize("mass", np.linspace(0.05, 0.5, 6).tolist())
def test_recommended_stiffness_is_rounded_down(mass):
    """A stiffness rounded to nearest would violate the required margins at half of all devices."""
    device = {"mass": mass, "damping": "10 N s/m", "period": "1 ms", "delay": "1 periods"}
    study = RecommendStudy.model_validate({"kind": "recommend", "name": "r", "device": device, "phase_margin": 30})
    outcome = study.compute(None, alone=True)
    stiffness_text = re.search(r"- K = (.*?), B = ", outcome.documents["recommendation.md"])
    assert stiffness_text is not None
    exact = json.loads(outcome.documents["recommendation.json"])["recommended"]["stiffness"]
    assert (1 - 1e-3) * exact < read_texts("stiffness", stiffness_text[1], "N/m") <= exact * (1 + 1e-12)


@pytest.mark.parametrize("fraction", [0.3, 0.45, 0.6, 0.7, 0.85])
def test_recommended_wall_is_simulated_bit_for_bit(fraction):
    """The values are passed on, because computing them twice may differ in the last digit."""
    device = {"mass": 0.37, "damping": "3.1 N s/m", "period": "0.7 ms", "delay": "1.3 periods"}
    study = RecommendStudy.model_validate(
        {"kind": "recommend", "name": "r", "device": device, "stiffness_fraction": fraction, "duration": "50 periods"}
    )
    outcome = study.compute(None, alone=True)
    best = json.loads(outcome.documents["recommendation.json"])["recommended"]
    assert set(outcome.table["alpha"]) == {best["alpha"]}
    assert set(outcome.table["beta"]) == {best["beta"]}


def test_response_that_does_not_settle_is_noted():
    study = StepStudy.model_validate(
        {
            "kind": "step",
            "name": "s",
            "devices": [{"delta": 0.1, "d": 1, "label": "stiff"}],
            "walls": [{"alpha": 1.0, "beta": 0.4}],
            "duration": "20 periods",
        }
    )
    outcome = study.compute(None, alone=True)
    assert "stiff" in outcome.notes[0]
    assert "position" in outcome.table


def test_map_study_contains_every_output():
    study = MapStudy.model_validate(
        {
            "kind": "map",
            "name": "m",
            "alpha": [0.1, 0.2, 0.9],
            "beta": [0.1, 0.4],
            "delta": [0, 0.1],
            "d": [0, 0.5, 1],
            "outputs": ["stable", "spectral_radius", "passive"],
        }
    )
    arrays = study.compute(None, alone=True).arrays
    grid = np.meshgrid(arrays["alpha"], arrays["beta"], arrays["delta"], arrays["d"], indexing="ij")
    radius = np.array([np.nanmax(np.abs(row)) for row in zwidth.poles(*(axis.ravel() for axis in grid))])
    np.testing.assert_allclose(arrays["spectral_radius"].ravel(), radius, rtol=1e-9)
    np.testing.assert_array_equal(arrays["stable"], arrays["spectral_radius"] < 1)
    np.testing.assert_array_equal(arrays["passive"], zwidth.is_passive(*grid))
    assert "stiffness_N_per_m" not in arrays


def test_walls_out_of_range_do_not_affect_others():
    study = {"kind": "map", "name": "m", "alpha": [0.1, 1e70], "beta": [0.1, 0.4], "delta": [0.1, 1], "d": 1}
    outcome = MapStudy.model_validate({**study, "outputs": ["stable", "spectral_radius"]}).compute(None, alone=True)
    good = np.zeros((2, 2, 2, 1), bool)
    good[0] = True
    np.testing.assert_array_equal(outcome.arrays["status"], np.where(good, Status.OK, Status.OUT_OF_RANGE))
    np.testing.assert_array_equal(outcome.arrays["stable"], good)
    np.testing.assert_array_equal(np.isfinite(outcome.arrays["spectral_radius"]), good)
    assert outcome.notes == ("4 of 8 points have no result: 4 out of range",)
    for draw in outcome.figures.values():
        (legend,) = draw()[0].figure.legends
        assert "no result" in [text.get_text() for text in legend.get_texts()]


def test_map_of_the_scene_itself_has_si_units():
    scene = PhysicalScene.model_validate({"mass": 0.1, "damping": 50, "period": "1 ms", "delay": "1 ms"})
    study = {"kind": "map", "name": "m", "alpha": [0.1, 0.2], "beta": 0.1, "delta": scene.delta, "d": scene.d}
    arrays = MapStudy.model_validate(study).compute(scene, alone=True).arrays
    np.testing.assert_allclose(arrays["stiffness_N_per_m"], 1e5 * arrays["alpha"], rtol=1e-15)
    np.testing.assert_allclose(arrays["virtual_damping_N_s_per_m"], 1e2 * arrays["beta"], rtol=1e-15)


def test_csv_tables_have_every_digit():
    value = np.array([0.1 + 0.2, 1e-300, np.nan])
    table = stack([{"curve": "a", "x": value}, {"curve": "b", "x": value[:1], "y": 2.0}])
    columns = read_csv(csv_text(table))
    assert list(columns["curve"]) == ["a", "a", "a", "b"]
    np.testing.assert_array_equal(columns["x"].astype(float), [*value, value[0]])
    np.testing.assert_array_equal(columns["y"].astype(float), [np.nan, np.nan, np.nan, 2.0])
