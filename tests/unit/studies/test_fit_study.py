"""The fit study: its tables against the functions it calls, its figure, its scene, and its faults."""

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
HEARD = [(6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)]
pytestmark = pytest.mark.usefixtures("fitted_once")
LOG = "version: 1\nname: a\nstudies:\n  - kind: fit\n    name: f\n"


def only_study(config) -> Any:
    (study,) = config.studies
    return study


def study_of(**keys):
    given = {"kind": "fit", "name": "f", **keys}
    return only_study(read_mapping({"version": 1, "name": "a", "studies": [given]}, Config))


@pytest.fixture(scope="module")
def both():
    """The study of configs/fit.yaml."""
    with fitting_once():
        return only_study(load_config(ROOT / "configs" / "fit.yaml")).compute(None, True)


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    return importlib.import_module("make_fit_log")


def test_the_records_of_the_example_are_what_the_script_makes(script):
    assert script.make_log() == script.FILE.read_text(encoding="utf-8")
    assert script.FILE.stat().st_size < 100_000
    study = only_study(load_config(ROOT / "configs" / "fit.yaml"))
    assert [(wall.stiffness, wall.virtual_damping, wall.frequency) for wall in study.buzz] == script.list_walls()
    assert study.noise == script.NOISE


def test_the_intervals_of_the_example_hold_the_true_device(both, script):
    true = {"mass_kg": script.MASS, "damping_N_s_per_m": script.DAMPING, "delay_s": script.DELAY}
    scene = zwidth.Scene(
        zwidth.Device(script.MASS, script.DAMPING), zwidth.Timing(period=script.PERIOD, delay=script.DELAY)
    )
    true |= {"stiffness_max_N_per_m": float(scene.max_stiffness().stiffness)}
    assert both.table["status"].tolist() == ["OK", "OK"]
    for name, value in true.items():
        quantity, _, unit = name.partition("_max_") if "max" in name else name.partition("_")
        quantity += "_max" if "max" in name else ""
        for row in range(2):
            low, high = (both.table[f"{quantity}_{end}_{unit}"][row] for end in ("low", "high"))
            assert low < value < high, (name, row)
    assert both.table["friction_low_N"][0] < script.FRICTION < both.table["friction_high_N"][0]
    assert np.isnan(both.table["friction_N"][1])
    assert both.table["resolution_m"].tolist() == [script.RESOLUTION, 0.0]
    assert "log and buzzing walls agree" in both.answer[-1]


def test_the_figure_shows_what_the_tables_hold(both):
    panels = both.figures[""]()
    assert [ax.get_title("left") for ax in panels] == ["(a)", "(b)", "(c)", "(d)", "(e)"]
    tables = {name: list(csv.DictReader(io.StringIO(text))) for name, text in both.documents.items() if "csv" in name}

    def column(table, name, **wanted):
        rows = [row for row in tables[f"device_{table}.csv"] if all(row[key] == value for key, value in wanted.items())]
        return np.array([float(row[name] or "nan") for row in rows])

    position, residual, correlation, walls, boundary = panels
    measured, modelled = position.lines
    np.testing.assert_allclose(measured.get_ydata(), 1e3 * column("motion", "position_m"))
    np.testing.assert_allclose(modelled.get_ydata(), 1e3 * column("motion", "modelled_m"))
    np.testing.assert_allclose(residual.lines[0].get_ydata(), 1e6 * column("motion", "residual_m"))
    halves = [line.get_ydata()[0] for line in residual.lines if line.get_label() == "half a step"]
    assert halves == [pytest.approx(-15.0), pytest.approx(15.0)]
    sticks = next(each for each in correlation.collections if each.get_label() == "autocorrelation")
    heights = [segment[1][1] for segment in sticks.get_segments()]
    np.testing.assert_allclose(heights, column("correlation", "autocorrelation"))
    dots = {line.get_label(): line.get_ydata() for line in walls.lines}
    np.testing.assert_allclose(dots["stiffness"], column("walls", "stiffness_residual", kind="buzzing"))
    for source, color in (("fit_log.csv", "#0072B2"), ("4 buzzing walls", "#009E73")):
        (line,) = [line for line in boundary.lines if line.get_label() == f"boundary, {source}"]
        assert line.get_color() == color
        rows = column("boundary", "stiffness_N_per_m", fitted_to=source) / 1e3
        assert set(np.round(line.get_xdata(), 9)) <= set(np.round(rows, 9))
        assert max(line.get_xdata()) == max(rows)
        (band,) = [each for each in boundary.collections if each.get_label() == f"band, {source}"]
        assert max(band.get_paths()[0].vertices[:, 0]) == pytest.approx(
            max(column("boundary", "stiffness_high_N_per_m", fitted_to=source)) / 1e3
        )
        # Each wall to set is told from the other by the color of the device that it suits.
        (set_,) = [line for line in boundary.lines if line.get_label() == "set" and line.get_color() == color]
        wall = column("walls", "stiffness_N_per_m", kind="set", fitted_to=source)
        np.testing.assert_allclose(set_.get_xdata(), wall / 1e3)
    assert {text.get_text() for text in boundary.texts} == {"8.38 Hz", "33.9 Hz", "48.2 Hz", "57.9 Hz"}


def test_the_scene_can_be_run(both, tmp_path):
    for name in ("log", "buzz"):
        file = tmp_path / f"{name}.yaml"
        file.write_text(both.documents[f"device_{name}_scene.yaml"], encoding="utf-8")
        mass, error = (both.table[f"mass{part}_kg"][int(name == "buzz")] for part in ("", "_error"))
        assert abs(only_study(load_config(file)).device.mass - mass) <= 1e-3 * error


def test_walls_alone_are_fitted_as_in_python():
    outcome = study_of(buzz=WALLS, period="1 ms", noise=0.02).compute(None, True)
    expected = zwidth.fit_buzz(HEARD, period=1e-3, noise=0.02)
    for name, head in (("mass", "mass_kg"), ("delay", "delay_s"), ("stiffness_max", "stiffness_max_N_per_m")):
        assert outcome.table[head].tolist() == [getattr(expected, name)]
    assert outcome.table["mass_error_kg"].tolist() == [expected.errors["mass"]]
    wall = expected.recommended
    assert outcome.answer[:2] == ("fitted to 3 buzzing walls", f"SET: {wall.spell_wall()}")
    assert any(line.startswith("device: m = 99.98 g (95 %: ") for line in outcome.answer)
    assert any(line.startswith("K_max: 19.87 kN/m (95 %: ") for line in outcome.answer)
    assert any(line.startswith("next: raise K at B = ") for line in outcome.answer)
    # A wall to set is written no stiffer than it is.
    evidence = outcome.figures[""].keywords
    walls = {**evidence["walls"], "stiffness_N_per_m": np.where(evidence["walls"]["kind"] == "set", 14897.0, 1e4)}
    _, boundary = outcome.figures[""](walls=walls)
    assert any("recommended wall: $K = 14.89$ kN/m" in text.get_text() for text in boundary.get_legend().get_texts())
    assert list(outcome.documents) == ["f_boundary.csv", "f_walls.csv", "f_scene.yaml"]


def test_an_answer_that_is_not_ok_begins_with_that(monkeypatch):
    monkeypatch.chdir(ROOT / "configs")
    outcome = study_of(log={"csv": "fit_log.csv", "resolution": "0.03 mm"}, max_delay="1 ms").compute(None, True)
    assert outcome.table["status"].tolist() == ["UNREACHABLE"]
    assert outcome.answer[1] == "NO WALL: resolve the warnings first, then record again"
    assert "WARNING: the delay is at the end of the search range, 1.000 ms; give a longer max_delay" in outcome.answer


def test_records_of_two_devices_do_not_agree(monkeypatch):
    monkeypatch.chdir(ROOT / "configs")
    log = {"csv": "fit_log.csv", "resolution": "0.03 mm"}
    outcome = study_of(log=log, buzz=WALLS, noise=0.02).compute(None, True)
    assert "log and buzzing walls do NOT agree" in outcome.answer[-1]


def test_several_logs_and_a_velocity_estimate(tmp_path):
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


def test_a_run_knows_when_the_log_has_changed(tmp_path, unpainted):
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
    "nothing to fit": ("    noise: 0.1\n", "log or buzz is missing"),
    "no file": ("    log: {csv: nowhere.csv}\n", "studies[0].log.csv: "),
    "no column": ("    log: {csv: log.csv, position: z}\n", "has no column 'z'"),
    "a key": ("    log: {csv: log.csv, positon: x}\n", "did you mean 'position'?"),  # codespell:ignore
    "a study's key": ("    log: {csv: log.csv}\n    max_dely: 1 ms\n", "did you mean 'max_delay'?"),
    "a resolution": ("    log: {csv: log.csv, resolution: 1 kg}\n", "got '1 kg'"),
    "an empty list": ("    log: []\n", "got an empty list"),
    "no period": ("    buzz: [{stiffness: 1, frequency: 2}]\n", "a fit without a log needs the period"),
    "noise of a log": ("    log: {csv: log.csv}\n    noise: 0.1\n", "got noise without buzz"),
    "delay of walls": (
        "    buzz: [{stiffness: 1, frequency: 2}]\n    period: 1 ms\n    max_delay: 1 ms\n",
        "got max_delay without log",
    ),
    "a name alone": ("    log: log.csv\n", "write {csv: NAME.csv}"),
    "logs of two axes": ("    log: [{csv: log.csv}, {csv: turn.csv}]\n", "studies[0].log[1]: got another axis"),
    "too fast": (
        "    buzz: [{stiffness: 1, frequency: 2}, {stiffness: 2, virtual_damping: 1, frequency: 700}]\n"
        "    period: 1 ms\n",
        "studies[0].buzz[1].frequency: got 700.0 Hz; it must be below the Nyquist frequency, 500.0 Hz",
    ),
    "one damping": (
        "    buzz: [{stiffness: 1, frequency: 2}, {stiffness: 1.1, frequency: 2.1}]\n    period: 1 ms\n",
        "studies[0].buzz: got walls of only one virtual_damping",
    ),
    "no frequency": ("    buzz: [{stiffness: 1}]\n    period: 1 ms\n", "frequency"),
    "angles and walls": (
        "    log: {csv: turn.csv}\n    buzz: [{stiffness: 1, frequency: 2}]\n    period: 1 ms\n",
        "got walls in N/m and a log of an angle",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_told_with_their_place(name, tmp_path):
    (tmp_path / "log.csv").write_text("t,x,F\n0,1,2\n", encoding="utf-8")
    (tmp_path / "turn.csv").write_text("t,phi [deg],tau [N m]\n0,1,2\n", encoding="utf-8")
    file = tmp_path / "a.yaml"
    file.write_text(LOG + FAULTS[name][0], encoding="utf-8")
    with pytest.raises(zwidth.ConfigError) as caught:
        load_config(file)
    assert FAULTS[name][1] in str(caught.value)
    assert "a.yaml:" in str(caught.value)


def test_a_period_beside_other_times_is_refused(monkeypatch):
    monkeypatch.chdir(ROOT / "configs")
    log = {"csv": "fit_log.csv", "resolution": "0.03 mm", "time": "time [ms]"}
    with pytest.raises(zwidth.InputError, match=r"the samples of the log are 1\.000 ms apart"):
        study_of(log=log, period="2 ms").compute(None, True)


def test_the_doubts_on_the_page_are_those_that_are_told():
    page = (ROOT / "docs" / "guides" / "my-log.md").read_text(encoding="utf-8")
    told = [row.split("|")[1].strip() for row in page.partition("|---|---|---|\n")[2].splitlines()]
    sources = (ROOT / "src" / "zwidth").glob("*/*.py")
    code = " ".join(path.read_text(encoding="utf-8") for path in sources)
    # A sentence may be broken over two lines of a text.
    code = " ".join(code.replace('"', "").split()).replace(" f{", " {")
    assert len(told) > 5
    for words in told[1:]:
        assert words.replace("a mass far", "far") in code, words
