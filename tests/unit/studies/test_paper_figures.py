"""The paper's figs. 6 and 10 with the fractional power z^(1+d), against 60 digits, mpmath and the exact delay."""

import json
from pathlib import Path

import mpmath as mp
import numpy as np
import pytest
import tolerances as tol

import oracles
import zwidth
from zwidth.studies.paper_figures import Fig6Study, Fig10Study, find_upper_damping, limit_slope, maximize_alpha

REFERENCE = Path(__file__).resolve().parents[2] / "reference" / "ridge_extended.json"
ROWS = [row for row in json.loads(REFERENCE.read_text()) if row["model"] == "fractional_power"]


def test_maximum_agrees_with_60_digits():
    assert len(ROWS) > 70
    for row in ROWS:
        delta, d = float(row["delta"]), float(row["d"])
        alpha, beta, omega = (float(value[0]) for value in maximize_alpha(np.array([delta]), d))
        assert alpha == pytest.approx(float(row["alpha"]), rel=tol.RIDGE.float64), row
        size = float(row["alpha"]) + abs(float(row["beta"]))
        assert beta == pytest.approx(float(row["beta"]), abs=tol.RIDGE_BETA.float64 * size), row
        condition = 1 + 1 / max(abs(np.pi - float(row["omega"])), tol.EPS64)
        assert omega == pytest.approx(float(row["omega"]), abs=tol.RIDGE_OMEGA.float64 * condition), row


@pytest.mark.parametrize("d", [0.05, 0.125, 0.5, 0.9, 1.5, 3.7])
def test_largest_damping_is_the_end_of_the_curve(d):
    deltas = np.array([0.0, 0.1, 1.0, 2.5, 10.0])
    for delta, upper in zip(deltas, find_upper_damping(deltas, d), strict=True):
        with mp.workdps(50):

            def alpha(omega, delta=delta):
                return oracles.boundary(omega, delta, d, "fractional_power")[0]

            grid = [mp.pi * k / 400 for k in range(1, 400)]
            last = next(k for k, omega in enumerate(grid) if alpha(omega) < 0)
            end = mp.findroot(alpha, (grid[last - 1], grid[last]), solver="anderson")
            exact = oracles.boundary(end, delta, d, "fractional_power")[1]
        assert upper == pytest.approx(float(exact), rel=4e-15)


@pytest.mark.parametrize("d", [0.0, 0.05, 0.2, 0.5, 0.8, 1.0, 1.3, 2.6, 10.0])
def test_slope_is_the_limit_for_strong_damping(d):
    for delta in (1e6, 1e8):
        assert maximize_alpha(np.array([delta]), d)[0][0] / delta == pytest.approx(limit_slope(d), rel=30 / delta)


def test_integer_delays_agree_with_the_exact_delay():
    delta = np.array([0.0, 0.3, 4.0])
    for d in (0.0, 2.0):
        np.testing.assert_array_equal(maximize_alpha(delta, d), zwidth.alpha_max(delta, d)[:3])
        assert limit_slope(d) == zwidth.stiffness_slope(d)


def test_tables_contain_both_delay_models():
    axes = {"delta": [2, 0, 1], "d": [0, 0.25, 1]}
    fig6 = Fig6Study.model_validate({"kind": "paper_fig6", "name": "a", **axes}).compute(None, alone=True)
    fig10 = Fig10Study.model_validate({"kind": "paper_fig10", "name": "b", **axes}).compute(None, alone=True)
    for outcome in (fig6, fig10):
        power = outcome.table["delay_model"] == "fractional_power"
        assert outcome.table["d"].tolist() == [0] * 3 + [0.25] * 3 + [1] * 3 + [0.25] * 3
        assert set(outcome.table["d"][power]) == {0.25}
        assert outcome.notes == ()
    power = fig10.table["delay_model"] == "fractional_power"
    np.testing.assert_array_equal(fig10.table["delta"][power], [2, 0, 1])
    np.testing.assert_array_equal(fig10.table["alpha_max"][power], maximize_alpha(np.array([2.0, 0, 1]), 0.25)[0])
    held = fig10.table["alpha_max"][~power]
    np.testing.assert_array_equal(held, zwidth.alpha_max(fig10.table["delta"][~power], fig10.table["d"][~power]).alpha)
    upper = fig6.table["beta_upper"][power]
    np.testing.assert_array_equal(upper, find_upper_damping(np.array([0.0, 1, 2]), 0.25))


@pytest.mark.parametrize("kind", ["paper_fig6", "paper_fig10"])
def test_configuration_with_and_without_axes_runs(kind, tmp_path):
    file = tmp_path / "paper.yaml"
    file.write_text(
        f"version: 1\nname: a\nscene: {{delta: 0.5, d: 0.5}}\nstudies:\n"
        f"  - {{kind: {kind}, name: all, delta: {{linear: {{start: 0, stop: 2, num: 5}}}}, d: [1, 0.5]}}\n"
        f"  - {{kind: {kind}, name: exact, delta: [0, 1], d: 1}}\n"
        f"  - {{kind: {kind}, name: of_scene}}\n",
        encoding="utf-8",
    )
    outcome = zwidth.run(file, out=tmp_path / "out")
    assert outcome.ok
    assert (tmp_path / "out" / "all.svg").exists()
