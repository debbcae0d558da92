"""Runs of the shipped configurations paper.yaml and phantom.yaml, compared with the paper's printed values and
the library.
"""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from unpainted import painting_nothing

import zwidth

CONFIGS = Path(__file__).resolve().parents[2] / "configs"

FIGURES = ("fig5", "fig6", "fig7", "fig8", "fig9", "fig10", "fig11", "passivity_cost")

# Values printed in the paper: eqs. (24) and (25), section VIII, remark 3.
PRINTED = {
    "alpha_max(delta = 0, d = 0)": "0.6863",
    "alpha_max(delta = 0, d = 1)": "0.1445",
    "delta, b = 0 N s/m": "0",
    "delta, b = 10 N s/m": "0.1",
    "delta, b = 100 N s/m": "1",
    "0.75 alpha_max, b = 0 N s/m": "0.108",
    "0.75 alpha_max, b = 10 N s/m": "0.149",
    "0.75 alpha_max, b = 100 N s/m": "0.656",
    "beta at alpha_max, b = 0 N s/m": "0.425",
    "beta at alpha_max, b = 10 N s/m": "0.416",
    "beta at alpha_max, b = 100 N s/m": "0.388",
    "delta above which the line appears for d = 0": "2.3",
}


@pytest.fixture(scope="module")
def paper(tmp_path_factory):
    return zwidth.run(CONFIGS / "paper.yaml", out=tmp_path_factory.mktemp("runs") / "paper")


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    with painting_nothing():
        return zwidth.run(CONFIGS / "phantom.yaml", out=tmp_path_factory.mktemp("runs") / "phantom")


def read_table(run, name):
    """Columns of a CSV file; numeric columns as float64."""
    with open(run.folder / f"{name}.csv", encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    columns = {}
    for key, values in zip(header, zip(*rows, strict=True), strict=True):
        try:
            columns[key] = np.array(values, dtype=np.float64)
        except ValueError:
            columns[key] = np.array(values)
    return columns


def read_json(run, name):
    return json.loads((run.folder / f"{name}.json").read_text(encoding="utf-8"))


def test_paper_run_writes_every_file(paper):
    assert paper.failed == ()
    assert [note for study in paper.studies for note in study.notes] == []
    expected = {f"{name}.{suffix}" for name in FIGURES for suffix in ("csv", "png", "svg")}
    expected |= {"published.md", "published.json", "run.json", "config.yaml", ".locks"}
    assert {file.name for file in paper.folder.iterdir()} == expected
    for file in paper.folder.iterdir():
        assert file.stat().st_size > 500, file.name


def test_every_printed_number_is_reproduced(paper):
    content = read_json(paper, "published")
    assert content["all_agree"] is True
    printed = {row["quantity"]: row["printed"] for row in content["published"]}
    assert printed.items() >= PRINTED.items()
    # Two numbers are quoted from other papers and are not computed.
    assert [row["agrees"] for row in content["published"]] == 15 * [True] + 2 * [None]
    sharpened = {row["where"]: row["computed"] for row in content["sharpened"]}
    assert sharpened["remark 3: 'delta > 2.3'"] == pytest.approx(2.310571356753694, abs=1e-14)
    values = [row["computed"] for row in content["sharpened"]]
    assert values[1] == pytest.approx(3.659361627421784, abs=1e-14)
    text = (paper.folder / "published.md").read_text(encoding="utf-8")
    assert "NO" not in text
    assert "0.6862915010" in text


def test_fig5_contains_20_boundaries_and_the_path_through_their_maxima(paper):
    table = read_table(paper, "fig5")
    boundary = table["curve"] == "boundary"
    curves = set(zip(table["d"][boundary], table["delta"][boundary], strict=True))
    assert curves == {(d, delta) for d in (0, 1, 2, 4) for delta in (0, 0.25, 0.5, 0.75, 1)}
    for d, delta in curves:
        mask = boundary & (table["d"] == d) & (table["delta"] == delta)
        maximum = zwidth.alpha_max(delta, d)
        assert np.max(table["alpha"][mask]) == pytest.approx(float(maximum.alpha), rel=1e-12)
        assert table["beta"][mask][0] == pytest.approx(-delta, abs=1e-12)
        on_path = (table["curve"] == "ridge_path") & (table["d"] == d) & np.isclose(table["delta"], delta, atol=1e-12)
        assert table["alpha"][on_path] == pytest.approx(float(maximum.alpha), rel=1e-9)


def test_fig10_contains_both_delay_models_where_they_differ(paper):
    table = read_table(paper, "fig10")
    fractional = table["delay_model"] == "fractional_power"
    assert set(table["d"][fractional]) == {0.125, 0.25, 0.5}
    assert set(table["d"][~fractional]) == {0, 0.125, 0.25, 0.5, 1, 2, 4}
    # Section VII: the maximum stiffness increases with physical damping.
    for d in (0, 0.125, 0.25, 0.5, 1, 2, 4):
        mask = ~fractional & (table["d"] == d)
        assert np.all(np.diff(table["alpha_max"][mask]) > 0)


def test_fig8_passivity_boundary_satisfies_its_condition(paper):
    table = read_table(paper, "fig8")
    passive = table["curve"] == "passive"
    bound = table["alpha"][passive] / 2 + np.abs(table["beta"][passive])
    np.testing.assert_allclose(bound, table["delta"][passive], rtol=1e-12)


def test_fig11_settles_faster_with_more_damping(paper):
    table = read_table(paper, "fig11")
    assert list(dict.fromkeys(table["label"])) == ["b = 0 N s/m", "b = 10 N s/m", "b = 100 N s/m"]
    settling_times = []
    for label in dict.fromkeys(table["label"]):
        mask = table["label"] == label
        final = 1e-3**2 / 0.1 / table["alpha"][mask][0]
        outside = np.abs(table["position_m"][mask] - final) > 0.02 * final
        settling_times.append(table["time_s"][mask][outside][-1])
    assert settling_times == sorted(settling_times, reverse=True)


def test_recommendation_matches_the_library_in_si_units(phantom):
    assert phantom.failed == ()
    report = read_json(phantom, "recommendation")
    ridge = zwidth.alpha_max(0.1, 1)
    assert report["maximum"]["stiffness"] == pytest.approx(float(ridge.alpha) * 1e5, rel=1e-12)
    assert report["maximum"]["virtual_damping"] == pytest.approx(float(ridge.beta) * 1e2, rel=1e-7)
    recommended = report["recommended"]
    assert recommended["stiffness"] == pytest.approx(0.75 * report["maximum"]["stiffness"], rel=1e-12)
    assert recommended["stable"] is True
    assert recommended["passive"] is False
    assert recommended["virtual_damping_lower"] < recommended["virtual_damping"] < recommended["virtual_damping_upper"]
    for name, offset in (("virtual_damping_lower", -1e-6), ("virtual_damping_upper", 1e-6)):
        edge = recommended[name] / 1e2
        radii = [np.abs(zwidth.poles(recommended["alpha"], edge + sign * offset, 0.1, 1)).max() for sign in (-1.0, 1.0)]
        assert radii[0] < 1 < radii[1]
    assert 0.0 < recommended["settling_time"] < 0.1
    text = (phantom.folder / "recommendation.md").read_text(encoding="utf-8")
    assert "19.86 kN/m" in text
    # Rounded down, since 14.90 would be stiffer than recommended.
    assert "14.89 kN/m" in text


def test_phantom_run_writes_every_file(phantom):
    names = {file.name for file in phantom.folder.iterdir()}
    figures = ("recommend", "boundary", "step", "map_stable", "map_spectral_radius", "map_passive")
    assert names >= {f"{name}.{suffix}" for name in figures for suffix in ("png", "svg")}
    assert names >= {"recommend.csv", "boundary.csv", "step.csv", "map.npz", "recommendation.md", "run.json"}
    boundary = read_table(phantom, "boundary")
    np.testing.assert_allclose(boundary["stiffness_N_per_m"], 1e5 * boundary["alpha"], rtol=1e-12)
    with np.load(phantom.folder / "map.npz") as arrays:
        assert arrays["stable"].shape == (101, 121, 1, 1)
        np.testing.assert_array_equal(arrays["stable"], arrays["spectral_radius"] < 1)
