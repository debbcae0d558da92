"""The fit study, against zwidth.fit_buzz and the true parameters of a generated log; its figure, scene and messages."""

import csv
import importlib
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fitted_once import fitting_once

import zwidth
from zwidth.config.reader import read_mapping
from zwidth.core.errors import StoreError
from zwidth.studies.document import Config, load_config

ROOT = Path(__file__).resolve().parents[3]
WALLS = [
    {"stiffness": "6.85 kN/m", "virtual_damping": 0, "frequency": "40.1 Hz"},
    {"stiffness": "15.9 kN/m", "virtual_damping": 18.7, "frequency": 68.6},
    {"stiffness": "19.7 kN/m", "virtual_damping": 37.4, "frequency": 89.1},
]
ONSETS = [(6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)]
pytestmark = pytest.mark.usefixtures("fitted_once")
LOG = "version: 1\nname: a\nstudies:\n  - kind: fit\n    name: f\n"


def only_study(config) -> Any:
    (study,) = config.studies
    return study


def make_study(**keys):
    mapping = {"kind": "fit", "name": "f", **keys}
    return only_study(read_mapping({"version": 1, "name": "a", "studies": [mapping]}, Config))


@pytest.fixture(scope="module")
def fit():
    """Return the outcome of the study of configs/fit.yaml, with a log and onsets of instability."""
    with fitting_once():
        return only_study(load_config(ROOT / "configs" / "fit.yaml")).compute(None, True)


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    return importlib.import_module("make_fit_log")


def test_example_records_agree_with_their_script(script):
    assert script.make_log() == script.FILE.read_text(encoding="utf-8")
    assert script.FILE.stat().st_size < 100_000
    study = only_study(load_config(ROOT / "configs" / "fit.yaml"))
    assert [(wall.stiffness, wall.virtual_damping, wall.frequency) for wall in study.buzz] == script.list_walls()
    assert study.noise == script.NOISE


def test_intervals_of_the_example_contain_the_true_parameters(fit, script):
    expected = {"mass_kg": script.MASS, "damping_N_s_per_m": script.DAMPING, "delay_s": script.DELAY}
    scene = zwidth.Scene(
        zwidth.Device(script.MASS, script.DAMPING), zwidth.Timing(period=script.PERIOD, delay=script.DELAY)
    )
    expected |= {"stiffness_max_N_per_m": float(scene.max_stiffness().stiffness)}
    assert fit.table["status"].tolist() == ["OK", "OK"]
    for name, value in expected.items():
        quantity, _, unit = name.partition("_max_") if "max" in name else name.partition("_")
        quantity += "_max" if "max" in name else ""
        for row in range(2):
            low, high = (fit.table[f"{quantity}_{end}_{unit}"][row] for end in ("low", "high"))
            assert low < value < high, (name, row)
    assert fit.table["friction_low_N"][0] < script.FRICTION < fit.table["friction_high_N"][0]
    assert np.isnan(fit.table["friction_N"][1])
    assert fit.table["resolution_m"].tolist() == [script.RESOLUTION, 0.0]
    assert "log and onsets agree" in fit.answer[-1]


def test_figure_agrees_with_the_tables(fit):
    panels = fit.figures[""]()
    assert [ax.get_title("left") for ax in panels] == ["(a)", "(b)", "(c)", "(d)", "(e)"]
    tables = {name: list(csv.DictReader(io.StringIO(text))) for name, text in fit.documents.items() if "csv" in name}

    def column(table, name, **conditions):
        rows = [
            row for row in tables[f"device_{table}.csv"] if all(row[key] == value for key, value in conditions.items())
        ]
        return np.array([float(row[name] or "nan") for row in rows])

    position, residual, correlation, walls, boundary = panels
    measured, modeled = position.lines
    np.testing.assert_allclose(measured.get_ydata(), 1e3 * column("motion", "position_m"))
    np.testing.assert_allclose(modeled.get_ydata(), 1e3 * column("motion", "modeled_m"))
    np.testing.assert_allclose(residual.lines[0].get_ydata(), 1e6 * column("motion", "residual_m"))
    halves = [line.get_ydata()[0] for line in residual.lines if line.get_label() == "half an encoder step"]
    assert halves == [pytest.approx(-15.0), pytest.approx(15.0)]
    sticks = next(artist for artist in correlation.collections if artist.get_label() == "autocorrelation")
    heights = [segment[1][1] for segment in sticks.get_segments()]
    np.testing.assert_allclose(heights, column("correlation", "autocorrelation"))
    dots = {line.get_label(): line.get_ydata() for line in walls.lines}
    np.testing.assert_allclose(dots["stiffness"], column("walls", "stiffness_residual", kind="onset"))
    for source, color in (("fit_log.csv", "#0072B2"), ("4 onsets of instability", "#009E73")):
        (line,) = [line for line in boundary.lines if line.get_label() == f"boundary, {source}"]
        assert line.get_color() == color
        rows = column("boundary", "stiffness_N_per_m", fitted_to=source) / 1e3
        assert set(np.round(line.get_xdata(), 9)) <= set(np.round(rows, 9))
        assert max(line.get_xdata()) == max(rows)
        (band,) = [artist for artist in boundary.collections if artist.get_label() == f"band, {source}"]
        assert max(band.get_paths()[0].vertices[:, 0]) == pytest.approx(
            max(column("boundary", "stiffness_high_N_per_m", fitted_to=source)) / 1e3
        )
        # The recommended walls have the colors of their devices.
        (set_,) = [line for line in boundary.lines if line.get_label() == "set" and line.get_color() == color]
        wall = column("walls", "stiffness_N_per_m", kind="set", fitted_to=source)
        np.testing.assert_allclose(set_.get_xdata(), wall / 1e3)
    assert {text.get_text() for text in boundary.texts} == {"8.38 Hz", "33.9 Hz", "48.2 Hz", "57.9 Hz"}


def test_written_scenes_can_be_loaded(fit, tmp_path):
    for name in ("log", "buzz"):
        file = tmp_path / f"{name}.yaml"
        file.write_text(fit.documents[f"device_{name}_scene.yaml"], encoding="utf-8")
        mass, error = (fit.table[f"mass{part}_kg"][int(name == "buzz")] for part in ("", "_error"))
        assert abs(only_study(load_config(file)).device.mass - mass) <= 1e-3 * error


def test_fit_without_a_log_agrees_with_fit_buzz():
    outcome = make_study(buzz=WALLS, period="1 ms", noise=0.02).compute(None, True)
    expected = zwidth.fit_buzz(ONSETS, period=1e-3, noise=0.02)
    for name, head in (("mass", "mass_kg"), ("delay", "delay_s"), ("stiffness_max", "stiffness_max_N_per_m")):
        assert outcome.table[head].tolist() == [getattr(expected, name)]
    assert outcome.table["mass_error_kg"].tolist() == [expected.errors["mass"]]
    wall = expected.recommended
    assert outcome.answer[:2] == ("data: 3 onsets of instability", f"SET: {wall.spell_wall()}")
    assert any(line.startswith("device: m = 99.98 g (95 %: ") for line in outcome.answer)
    assert any(line.startswith("K_max: 19.86 kN/m (95 %: ") for line in outcome.answer)
    assert any(line.startswith("next: raise K at B = ") for line in outcome.answer)
    # The stiffness of a recommended wall is rounded down.
    evidence = outcome.figures[""].keywords
    walls = {**evidence["walls"], "stiffness_N_per_m": np.where(evidence["walls"]["kind"] == "set", 14897.0, 1e4)}
    _, boundary = outcome.figures[""](walls=walls)
    assert any("recommended wall: $K = 14.89$ kN/m" in text.get_text() for text in boundary.get_legend().get_texts())
    assert list(outcome.documents) == ["f_boundary.csv", "f_walls.csv", "f_scene.yaml"]


def test_failed_fit_reports_its_warnings_first(monkeypatch):
    monkeypatch.chdir(ROOT / "configs")
    outcome = make_study(log={"csv": "fit_log.csv", "resolution": "0.03 mm"}, max_delay="1 ms").compute(None, True)
    assert outcome.table["status"].tolist() == ["UNREACHABLE"]
    assert outcome.answer[1] == "NO WALL: the fit has warnings: record again as they advise"
    assert "WARNING: the delay is at the end of the search range, 1.000 ms; give a longer max_delay" in outcome.answer


def test_records_of_two_devices_are_reported_as_inconsistent(monkeypatch):
    monkeypatch.chdir(ROOT / "configs")
    log = {"csv": "fit_log.csv", "resolution": "0.03 mm"}
    outcome = make_study(log=log, buzz=WALLS, noise=0.02).compute(None, True)
    assert "log and onsets do NOT agree" in outcome.answer[-1]


def test_several_logs_with_a_velocity_filter(tmp_path):
    lines = (ROOT / "configs" / "fit_log.csv").read_text(encoding="utf-8").splitlines()
    for k, part in enumerate((lines[3:1503], lines[1503:])):
        (tmp_path / f"{k}.csv").write_text("\n".join([lines[2], *part]), encoding="utf-8")
    file = tmp_path / "a.yaml"
    file.write_text(
        LOG + "    log: [{csv: 0.csv, resolution: 0.03 mm}, {csv: 1.csv, resolution: 0.03 mm}]\n"
        "    velocity: {kind: low_pass, cutoff: 100 Hz}\n    max_delay: 5 ms\n",
        encoding="utf-8",
    )
    study = only_study(load_config(file))
    assert (study.points, study.extent) == (3000, "2 logs")
    outcome = study.compute(None, True)
    assert outcome.table["fitted_to"].tolist() == ["0.csv and 1.csv"]
    filtered = zwidth.Scene(
        zwidth.Device(0.075, 0.6), zwidth.Timing(period=1e-3, delay=2.3e-3), velocity=zwidth.LowPass(cutoff=100)
    )
    top = float(filtered.max_stiffness().stiffness)
    assert outcome.table["stiffness_max_N_per_m"][0] == pytest.approx(top, rel=0.01)
    assert outcome.figures[""]()[0].get_title("left") == "(a) the first of 2 logs"


def test_resuming_with_a_changed_log_raises(tmp_path, unpainted):
    file, log = tmp_path / "a.yaml", tmp_path / "log.csv"
    text = (ROOT / "configs" / "fit_log.csv").read_text(encoding="utf-8")
    log.write_text(text, encoding="utf-8")
    file.write_text(LOG + "    log: {csv: log.csv, resolution: 0.03 mm}\n", encoding="utf-8")
    assert zwidth.run(file, out=tmp_path / "out").ok
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names >= {"f.csv", "f.png", "f.svg", "f_motion.csv", "f_correlation.csv", "f_scene.yaml"}
    assert zwidth.run(file, out=tmp_path / "out", resume=True).studies[0].state == "kept"
    log.write_text(text + text.splitlines()[-1].replace("2999,", "3000,") + "\n", encoding="utf-8")
    with pytest.raises(StoreError):
        zwidth.run(file, out=tmp_path / "out", resume=True)


FAULTS = {
    "no data": ("    noise: 0.1\n", "log or buzz is missing"),
    "no file": ("    log: {csv: nowhere.csv}\n", "studies[0].log.csv: "),
    "no column": ("    log: {csv: log.csv, position: z}\n", "has no column 'z'"),
    "unknown key of log": ("    log: {csv: log.csv, positon: x}\n", "did you mean 'position'?"),  # codespell:ignore
    "unknown key of study": ("    log: {csv: log.csv}\n    max_dely: 1 ms\n", "did you mean 'max_delay'?"),
    "wrong unit": ("    log: {csv: log.csv, resolution: 1 kg}\n", "got '1 kg'"),
    "empty list": ("    log: []\n", "got an empty list"),
    "no period": ("    buzz: [{stiffness: 1, frequency: 2}]\n", "a fit without a log needs the period"),
    "noise without buzz": ("    log: {csv: log.csv}\n    noise: 0.1\n", "got noise without buzz"),
    "max_delay without log": (
        "    buzz: [{stiffness: 1, frequency: 2}]\n    period: 1 ms\n    max_delay: 1 ms\n",
        "got max_delay without log",
    ),
    "file name instead of mapping": ("    log: log.csv\n", "write {csv: NAME.csv}"),
    "linear and rotary logs": ("    log: [{csv: log.csv}, {csv: turn.csv}]\n", "studies[0].log[1]: got another axis"),
    "frequency above Nyquist": (
        "    buzz: [{stiffness: 1, frequency: 2}, {stiffness: 2, virtual_damping: 1, frequency: 700}]\n"
        "    period: 1 ms\n",
        "studies[0].buzz[1].frequency: got 700.0 Hz; it must be below the Nyquist frequency, 500.0 Hz",
    ),
    "single damping": (
        "    buzz: [{stiffness: 1, frequency: 2}, {stiffness: 1.1, frequency: 2.1}]\n    period: 1 ms\n",
        "studies[0].buzz: got walls of only one virtual_damping",
    ),
    "no frequency": ("    buzz: [{stiffness: 1}]\n    period: 1 ms\n", "frequency"),
    "rotary log and linear walls": (
        "    log: {csv: turn.csv}\n    buzz: [{stiffness: 1, frequency: 2}]\n    period: 1 ms\n",
        "got walls in N/m and a log of an angle",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_invalid_fields_raise_with_their_location(name, tmp_path):
    (tmp_path / "log.csv").write_text("t,x,F\n0,1,2\n", encoding="utf-8")
    (tmp_path / "turn.csv").write_text("t,phi [deg],tau [N m]\n0,1,2\n", encoding="utf-8")
    file = tmp_path / "a.yaml"
    file.write_text(LOG + FAULTS[name][0], encoding="utf-8")
    with pytest.raises(zwidth.ConfigError) as caught:
        load_config(file)
    assert FAULTS[name][1] in str(caught.value)
    assert "a.yaml:" in str(caught.value)


def test_period_that_contradicts_the_log_raises(monkeypatch):
    monkeypatch.chdir(ROOT / "configs")
    log = {"csv": "fit_log.csv", "resolution": "0.03 mm", "time": "time [ms]"}
    with pytest.raises(zwidth.InputError, match=r"the samples of the log are 1\.000 ms apart"):
        make_study(log=log, period="2 ms").compute(None, True)


def test_the_warnings_on_the_page_are_those_that_are_printed():
    page = (ROOT / "docs" / "guides" / "my-log.md").read_text(encoding="utf-8")
    documented = [row.split("|")[1].strip() for row in page.partition("|---|---|---|\n")[2].splitlines()]
    sources = (ROOT / "src" / "zwidth").glob("*/*.py")
    code = " ".join(path.read_text(encoding="utf-8") for path in sources)
    # Join strings that are split over two lines.
    code = " ".join(code.replace('"', "").split()).replace(" f{", " {")
    assert len(documented) > 5
    for warning in documented[1:]:
        assert warning.replace("a mass far", "far") in code, warning
