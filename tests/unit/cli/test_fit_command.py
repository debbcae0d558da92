"""`zwidth fit`: walls and logs from a shell, against fit_buzz and true parameters; output and errors."""

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


def test_walls_agree_with_fit_buzz():
    fit = json.loads(run(*WALLS, "--period", "1 ms", "--noise", "2%", "--json"))
    expected = fit_buzz(POINTS, period=1e-3, noise=0.02)
    assert fit["mass"] == expected.mass
    assert fit["next"] == expected.as_dict()["next"] != {}
    assert fit["safe_wall"]["stiffness"] == expected.safe_wall().stiffness
    text = run(*WALLS, "--period", "1 ms", "--noise", "0.02")
    assert text.startswith(f"SET        {expected.recommended.spell_wall()}\n")
    assert "device     m = 100.0 g (95 %: " in text
    assert "next       raise K at B = " in text


def test_log_in_millimeters_and_milliseconds(log):
    fit = json.loads(run(log, "--time", "t:ms", "--position", "x:mm", "--force", "f", "--json"))
    np.testing.assert_allclose([fit["mass"], fit["damping"]], [0.1, 2.0], rtol=1e-6)
    assert fit["delay"] == pytest.approx(0.0, abs=1e-9)
    # Columns without options are recognized by their names.
    assert json.loads(run(log, "--time", "t:ms", "--position", "x:mm", "--json")) == fit
    text = run(log, "--period", "1 ms", "--position", "x:mm", "--force", "f", "--verbose")
    assert "data       log.csv" in text
    assert "data  " not in run(log, "--period", "1 ms", "--position", "x:mm", "--force", "f")


@pytest.mark.parametrize(
    "options, velocity",
    [
        ([], zwidth.BackwardDifference()),
        (["--velocity-cutoff", "300"], zwidth.LowPass(cutoff=300)),
        (["--velocity-samples", "3"], zwidth.WindowedDifference(samples=3)),
    ],
)
def test_written_configuration_is_loadable_with_sources(unpainted, options, velocity, tmp_path):
    text = run(*WALLS, "--period", "1 ms", "--yaml", *options)
    assert text.startswith("# Fitted to 2 onsets of instability: 95 % between")
    assert text.count("# fitted, 95 % between") == 3
    file = tmp_path / "fitted.yaml"
    file.write_text(text, encoding="utf-8")
    assert load_config(file).name == "fitted_2_onsets_of_instability"
    fitted = json.loads(run(*WALLS, "--period", "1 ms", "--json", *options))
    assert fitted["mass"] == fit_buzz(POINTS, period=1e-3, velocity=velocity).mass
    for name in ("mass", "damping", "delay"):
        written = float(re.findall(rf"{name}: (\S+) ", text)[0])
        # The parameters have digits up to a thousandth of their error.
        assert abs(written - fitted[name]) <= 1e-3 * fitted["errors"][name]


@pytest.mark.parametrize(
    "arguments, message",
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
def test_invalid_arguments_exit_with_2(arguments, message, log):
    result = CliRunner().invoke(cli, ["fit", *(log if word == "LOG" else word for word in arguments)])
    assert result.exit_code == 2
    assert message in result.output


@pytest.mark.parametrize(
    "columns, message",
    [
        (["--time", "t", "--position", "y", "--force", "f"], "has no column 'y'"),
        (["--time", "t", "--position", "x:furlong", "--force", "f"], "got the unit 'furlong'"),
        (["--time", "t", "--position", "word", "--force", "f"], "bad.csv:3: got 'no' under 'word'; a number is needed"),
    ],
)
def test_unreadable_columns_are_reported(columns, message, tmp_path):
    file = tmp_path / "bad.csv"
    file.write_text("t,x,f,word\n0,0,1,1\n1,0,1,no\n", encoding="utf-8")
    result = CliRunner().invoke(cli, ["fit", str(file), *columns])
    assert result.exit_code
    assert message in (result.output or str(result.exception))


def test_several_logs_in_counts_with_a_figure(tmp_path):
    text = (CONFIGS / "fit_log.csv").read_text("utf-8")
    head, lines = text.splitlines()[2], text.splitlines()[3:]
    files = []
    for k, part in enumerate((lines[:1500], lines[1500:])):
        files.append(tmp_path / f"part{k}.csv")
        files[-1].write_text("\n".join([head, *part]), encoding="utf-8")
    printed = run(*map(str, files), "--resolution", "0.03mm", "--verbose", "--figure", str(tmp_path / "fit.png"))
    assert "\ndata       part0.csv and part1.csv\n" in printed
    assert "friction 8" in printed
    assert "a constant force" in printed
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    fit = json.loads(run(*map(str, files), "--position", "encoder [counts]", "--resolution", "0.03 mm", "--json"))
    for name, expected in (("mass", 0.075), ("damping", 0.6), ("delay", 2.3e-3), ("friction", 0.08)):
        low, high = fit["intervals"][name]
        assert low < expected < high
        assert high - low < 0.02 * expected


def test_rotary_log_agrees_with_the_linear_one(tmp_path):
    text = (CONFIGS / "fit_log.csv").read_text("utf-8").replace("force [N]", "torque [Nm]")
    file = tmp_path / "rotary.csv"
    file.write_text(text, encoding="utf-8")
    linear = json.loads(run(str(CONFIGS / "fit_log.csv"), "--resolution", "0.03mm", "--json"))
    rotary = json.loads(run(str(file), "--resolution", "0.03mrad", "--json"))
    for name in ("mass", "damping", "delay", "friction", "stiffness_max"):
        assert rotary[name] == pytest.approx(linear[name], rel=1e-9)
    text_rotary = run(str(file), "--resolution", "0.03mrad")
    # 1 kg m^2 = 10^7 g cm^2.
    assert re.search(r"^device +J = 7500\d\d\.\d* g cm\^2 \(95 %: ", text_rotary, re.MULTILINE)
    assert "mN m s/rad" in text_rotary
    assert "kN m/rad" in text_rotary
    scene = run(str(file), "--resolution", "0.03mrad", "--yaml")
    assert re.search(r"^  mass: \S+ kg m\^2 # fitted", scene, re.MULTILINE)
    assert re.search(r"^  damping: \S+ N m s/rad # fitted", scene, re.MULTILINE)
    scene_file = tmp_path / "fitted.yaml"
    scene_file.write_text(scene, encoding="utf-8")
    device = load_config(scene_file).scene.to_scene().device  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    assert device.rotary
    assert device.mass == pytest.approx(rotary["mass"], rel=1e-6)
    result = CliRunner().invoke(cli, ["fit", str(file), "--resolution", "0.03mm"])
    assert "a length belongs to a force" in result.output


def test_walls_of_a_rotary_axis():
    walls = ["--buzz", "K=6.846 N m/rad B=0 f=40.1Hz", "--buzz", "K=276.809mNm/deg B=18.7 mNms/rad f=68.6"]
    options = ["--period", "1 ms", "--noise", "2%"]
    fit = json.loads(run(*walls, *options, "--json"))
    expected = fit_buzz([(6.846, 0.0, 40.1), (0.276809 * 180 / np.pi, 0.0187, 68.6)], period=1e-3, noise=0.02)
    assert fit["mass"] == pytest.approx(expected.mass, rel=1e-12)
    assert fit["units"]["stiffness"] == "N m/rad"
    text = run(*walls, *options)
    assert re.search(r"^device +J = 1000 g cm\^2", text, re.MULTILINE)
    assert "next       raise K at B = 80.4 mN m s/rad, to about 7.55 N m/rad" in text


def test_failed_fit_prints_its_warning_first():
    arguments = [str(CONFIGS / "fit_log.csv"), "--resolution", "0.03mm", "--max-delay", "1 ms"]
    first, *others = run(*arguments, code=1).splitlines()
    assert not any(line.startswith("SET ") for line in others)
    assert first == "NO WALL    the fit has warnings: record again as they advise"
    assert "WARNING    the delay is at the end of the search range, 1.000 ms; give a longer max_delay" in others
    text = run(*arguments, "--yaml")
    assert 'reason: "the delay is at the end of the search range"' in text
    assert "    stiffness: 0.0 N/m\n" in text
    result = CliRunner().invoke(cli, ["fit", *arguments, "--code", "c"])
    assert result.exit_code == 1
    assert "no wall is safe" in result.stderr


def test_rate_is_equivalent_to_the_period():
    assert run(*WALLS, "--rate", "1 kHz", "--json") == run(*WALLS, "--period", "1 ms", "--json")
    result = CliRunner().invoke(cli, ["fit", *WALLS, "--rate", "1 kHz", "--period", "1 ms"])
    assert "--period and --rate are both given" in result.output


def test_figure_in_a_missing_folder_raises(tmp_path):
    arguments = [*WALLS, "--period", "1 ms", "--figure", str(tmp_path / "nowhere" / "fit.png")]
    result = CliRunner().invoke(cli, ["fit", *arguments])
    assert "does not exist; create it first" in result.output


def test_missing_file_raises():
    result = CliRunner().invoke(cli, ["fit", "nowhere.csv"])
    assert isinstance(result.exception, zwidth.InputError)
    assert "nowhere.csv: no such file" in str(result.exception)


def test_long_log_is_announced_on_stderr(log, tmp_path, capsys):
    long = tmp_path / "long.csv"
    long.write_text(Path(log).read_text() + "\n" + 9 * 2**10 * (1023 * " " + "\n"))
    outputs = []
    for file in (log, str(long)):
        cli.main(["fit", file, "--time", "t:ms", "--position", "x:mm", "--force", "f:N"], standalone_mode=False)
        outputs.append(capsys.readouterr())
    short_output, long_output = outputs
    assert long_output.out.replace("long.csv", "log.csv") == short_output.out
    assert short_output.err == ""
    assert long_output.err == "zwidth: reading long.csv, 9 MiB; the results follow\n"
