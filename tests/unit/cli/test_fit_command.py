"""`zwidth fit`: walls and logs as a shell gives them, and what it prints."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli
from zwidth.identification.onset_fit import fit_buzz
from zwidth.studies.document import load_config

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
WALLS = ["--buzz", "K=6.846kN/m B=0 f=40.1Hz", "--buzz", "K = 15.86 kN/m, B = 18.7, f = 68.6"]
POINTS = [(6846.0, 0.0, 40.1), (15860.0, 18.7, 68.6)]
pytestmark = pytest.mark.usefixtures("fitted_once")


def run(*arguments, code=0):
    result = CliRunner().invoke(cli, ["fit", *arguments])
    assert result.exit_code == code, result.output
    return result.stdout


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    force = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 24), 25)
    scene = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(period=1e-3))
    position = zwidth.simulate(scene, 0.0, 0.0, external_force_history=force, periods=600).position[:600]
    file = tmp_path_factory.mktemp("log") / "log.csv"
    rows = [f"{k},{1e3 * x!r},{f!r}" for k, (x, f) in enumerate(zip(position.tolist(), force.tolist(), strict=True))]
    file.write_text("\n".join(["t,x,f", *rows]), encoding="utf-8")
    return str(file)


def test_walls_are_fitted_as_in_python():
    found = json.loads(run(*WALLS, "--period", "1 ms", "--noise", "2%", "--json"))
    expected = fit_buzz(POINTS, period=1e-3, noise=0.02)
    assert found["mass"] == expected.mass
    assert found["next"] == expected.as_dict()["next"] != {}
    assert found["safe_wall"]["stiffness"] == expected.safe_wall().stiffness
    words = run(*WALLS, "--period", "1 ms", "--noise", "0.02")
    assert words.startswith(f"SET        {expected.recommended.spell_wall()}\n")
    assert "device     m = 100.0 g (95 %: " in words
    assert "next       raise K at B = " in words


def test_a_log_in_millimeters_and_milliseconds(log):
    found = json.loads(run(log, "--time", "t:ms", "--position", "x:mm", "--force", "f", "--json"))
    np.testing.assert_allclose([found["mass"], found["damping"]], [0.1, 2.0], rtol=1e-6)
    assert found["delay"] == pytest.approx(0.0, abs=1e-9)
    # Nothing but the name says which column the force is, and which are the others.
    assert json.loads(run(log, "--time", "t:ms", "--position", "x:mm", "--json")) == found
    words = run(log, "--period", "1 ms", "--position", "x:mm", "--force", "f", "--verbose")
    assert "data       log.csv" in words
    assert "data  " not in run(log, "--period", "1 ms", "--position", "x:mm", "--force", "f")


@pytest.mark.parametrize(
    "more, velocity",
    [
        ([], zwidth.BackwardDifference()),
        (["--velocity-cutoff", "300"], zwidth.LowPass(cutoff=300)),
        (["--velocity-samples", "3"], zwidth.WindowedDifference(samples=3)),
    ],
)
def test_the_configuration_can_be_run_and_says_where_its_numbers_are_from(unpainted, more, velocity, tmp_path):
    text = run(*WALLS, "--period", "1 ms", "--yaml", *more)
    assert text.startswith("# Fitted to 2 onsets of instability: 95 % between")
    assert text.count("# fitted, 95 % between") == 3
    file = tmp_path / "fitted.yaml"
    file.write_text(text, encoding="utf-8")
    assert load_config(file).name == "fitted_2_onsets_of_instability"
    fitted = json.loads(run(*WALLS, "--period", "1 ms", "--json", *more))
    assert fitted["mass"] == fit_buzz(POINTS, period=1e-3, velocity=velocity).mass
    for name in ("mass", "damping", "delay"):
        written = float(re.findall(rf"{name}: (\S+) ", text)[0])
        # Digits beyond a thousandth of the error say nothing.
        assert abs(written - fitted[name]) <= 1e-3 * fitted["errors"][name]


@pytest.mark.parametrize(
    "arguments, words",
    [
        ([], "give either --buzz"),
        ([*WALLS], "give --period or --rate"),
        ([*WALLS, "--period", "1 ms", "--time", "t"], "--time applies only to a LOG.csv"),
        (["--buzz", "K=1 B=2"], "write K, B and f"),
        (["--buzz", "K=1 B=2 f=3 g=4"], "got"),
        (["--buzz", "K=1 B=2 f=3 f=4"], "got 'K=1 B=2 f=3 f=4'; write K, B and f"),
        (["--buzz", "K=1kg f=3"], "K: got '1kg'"),
        (["--buzz", "K=1 N/m B=2 N m s/rad f=3"], "write K in N/m and B in N s/m"),
        (["--buzz", "K=1 N/m f=3", "--buzz", "K=1Nm/rad f=3", "--period", "1 ms"], "fit them separately"),
        (["--buzz", "K=1 furlong/rad f=3", "--period", "1 ms"], "the units allowed are N m/rad"),
        ([*WALLS, "--period", "1 ms", "--noise", "much"], "write a share"),
        (["LOG", "--time", "t", "--period", "1 ms"], "give one of --time, --period and --rate"),
        (["LOG", "--figure", "fit.txt"], "ends with .png"),
        ([*WALLS, "--period", "1 ms", "--resolution", "1mm"], "--resolution applies only to a LOG.csv"),
        ([*WALLS, "--period", "1 ms", "--resample"], "--resample applies only to a LOG.csv"),
        ([*WALLS, "--period", "1 ms", "--json", "--yaml"], "give only one of --json, --yaml and --code"),
        (["LOG", "--noise", "1%"], "--noise applies only to --buzz"),
    ],
)
def test_wrong_use_is_told(arguments, words, log):
    result = CliRunner().invoke(cli, ["fit", *(log if word == "LOG" else word for word in arguments)])
    assert result.exit_code == 2
    assert words in result.output


@pytest.mark.parametrize(
    "columns, words",
    [
        (["--time", "t", "--position", "y", "--force", "f"], "has no column 'y'"),
        (["--time", "t", "--position", "x:furlong", "--force", "f"], "got the unit 'furlong'"),
        (["--time", "t", "--position", "word", "--force", "f"], "bad.csv:3: got 'no' under 'word'; a number is needed"),
    ],
)
def test_columns_that_cannot_be_read_are_named(columns, words, tmp_path):
    file = tmp_path / "bad.csv"
    file.write_text("t,x,f,word\n0,0,1,1\n1,0,1,no\n", encoding="utf-8")
    result = CliRunner().invoke(cli, ["fit", str(file), *columns])
    assert result.exit_code
    assert words in (result.output or str(result.exception))


def test_several_logs_in_counts_and_a_figure(tmp_path):
    text = (CONFIGS / "fit_log.csv").read_text("utf-8")
    head, lines = text.splitlines()[2], text.splitlines()[3:]
    files = []
    for k, part in enumerate((lines[:1500], lines[1500:])):
        files.append(tmp_path / f"part{k}.csv")
        files[-1].write_text("\n".join([head, *part]), encoding="utf-8")
    words = run(*map(str, files), "--resolution", "0.03mm", "--verbose", "--figure", str(tmp_path / "fit.png"))
    assert "\ndata       part0.csv and part1.csv\n" in words
    assert "friction 8" in words
    assert "a constant force" in words
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    found = json.loads(run(*map(str, files), "--position", "encoder [counts]", "--resolution", "0.03 mm", "--json"))
    for name, true in (("mass", 0.075), ("damping", 0.6), ("delay", 2.3e-3), ("friction", 0.08)):
        low, high = found["intervals"][name]
        assert low < true < high
        assert high - low < 0.02 * true


def test_a_rotary_axis_is_the_linear_one_in_other_units(tmp_path):
    text = (CONFIGS / "fit_log.csv").read_text("utf-8").replace("force [N]", "torque [Nm]")
    file = tmp_path / "rotary.csv"
    file.write_text(text, encoding="utf-8")
    linear = json.loads(run(str(CONFIGS / "fit_log.csv"), "--resolution", "0.03mm", "--json"))
    turned = json.loads(run(str(file), "--resolution", "0.03mrad", "--json"))
    for name in ("mass", "damping", "delay", "friction", "stiffness_max"):
        assert turned[name] == pytest.approx(linear[name], rel=1e-9)
    words = run(str(file), "--resolution", "0.03mrad")
    # 1 kg m^2 is 10^7 g cm^2.
    assert re.search(r"^device +J = 7500\d\d\.\d* g cm\^2 \(95 %: ", words, re.MULTILINE)
    assert "mN m s/rad" in words
    assert "kN m/rad" in words
    scene = run(str(file), "--resolution", "0.03mrad", "--yaml")
    assert re.search(r"^  mass: \S+ kg m\^2 # fitted", scene, re.MULTILINE)
    assert re.search(r"^  damping: \S+ N m s/rad # fitted", scene, re.MULTILINE)
    made = tmp_path / "fitted.yaml"
    made.write_text(scene, encoding="utf-8")
    device = load_config(made).scene.to_scene().device  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    assert device.rotary
    assert device.mass == pytest.approx(turned["mass"], rel=1e-6)
    result = CliRunner().invoke(cli, ["fit", str(file), "--resolution", "0.03mm"])
    assert "a length belongs to a force" in result.output


def test_walls_of_a_rotary_axis():
    walls = ["--buzz", "K=6.846 N m/rad B=0 f=40.1Hz", "--buzz", "K=276.809mNm/deg B=18.7 mNms/rad f=68.6"]
    options = ["--period", "1 ms", "--noise", "2%"]
    found = json.loads(run(*walls, *options, "--json"))
    expected = fit_buzz([(6.846, 0.0, 40.1), (0.276809 * 180 / np.pi, 0.0187, 68.6)], period=1e-3, noise=0.02)
    assert found["mass"] == pytest.approx(expected.mass, rel=1e-12)
    assert found["units"]["stiffness"] == "N m/rad"
    words = run(*walls, *options)
    assert re.search(r"^device +J = 1000 g cm\^2", words, re.MULTILINE)
    assert "next       raise K at B = 80.4 mN m s/rad, to about 7.55 N m/rad" in words


def test_what_is_not_ok_is_told_first():
    arguments = [str(CONFIGS / "fit_log.csv"), "--resolution", "0.03mm", "--max-delay", "1 ms"]
    first, *others = run(*arguments, code=1).splitlines()
    assert not any(line.startswith("SET ") for line in others)
    assert first == "NO WALL    resolve the warnings first, then record again"
    assert "WARNING    the delay is at the end of the search range, 1.000 ms; give a longer max_delay" in others
    text = run(*arguments, "--yaml")
    assert 'reason: "the delay is at the end of the search range"' in text
    assert "    stiffness: 0.0 N/m\n" in text
    result = CliRunner().invoke(cli, ["fit", *arguments, "--code", "c"])
    assert result.exit_code == 1
    assert "no wall is safe" in result.stderr


def test_a_rate_stands_for_the_period():
    assert run(*WALLS, "--rate", "1 kHz", "--json") == run(*WALLS, "--period", "1 ms", "--json")
    result = CliRunner().invoke(cli, ["fit", *WALLS, "--rate", "1 kHz", "--period", "1 ms"])
    assert "--period and --rate are both given" in result.output


def test_a_figure_needs_a_folder(tmp_path):
    arguments = [*WALLS, "--period", "1 ms", "--figure", str(tmp_path / "nowhere" / "fit.png")]
    result = CliRunner().invoke(cli, ["fit", *arguments])
    assert "does not exist; create it first" in result.output


def test_a_missing_file_is_an_input_error():
    result = CliRunner().invoke(cli, ["fit", "nowhere.csv"])
    assert isinstance(result.exception, zwidth.InputError)
    assert "nowhere.csv: no such file" in str(result.exception)


def test_a_long_log_is_announced_before_it_is_read(log, tmp_path, capsys):
    """On the error stream, so that what is printed stays as it is."""
    long = tmp_path / "long.csv"
    long.write_text(Path(log).read_text() + "\n" + 9 * 2**10 * (1023 * " " + "\n"))
    said = []
    for file in (log, str(long)):
        cli.main(["fit", file, "--time", "t:ms", "--position", "x:mm", "--force", "f:N"], standalone_mode=False)
        said.append(capsys.readouterr())
    short, told = said
    assert told.out.replace("long.csv", "log.csv") == short.out
    assert short.err == ""
    assert told.err == "zwidth: reading long.csv, 9 MiB; the results follow\n"
