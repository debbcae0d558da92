"""Scenes from a configuration file or the folder of a run, with options overriding the file."""

import json

import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli

pytestmark = pytest.mark.usefixtures("fitted_once")
SCENE = """\
version: 1
name: knob
scene:
{scene}
studies:
  - {{kind: ridge, name: top, delta: 0.1, d: 1}}
"""
LINEAR = {"mass": "100 g", "damping": "10 N s/m", "rate": "1 kHz", "delay": "1 ms"}
WALL = {"stiffness": "10 kN/m", "virtual_damping": "40 N s/m"}

DEVICE = [f"--{name}={value}" for name, value in LINEAR.items()]


@pytest.fixture
def write_scene(tmp_path):
    def write_scene(**keys):
        file = tmp_path / "scene.yaml"
        file.write_text(SCENE.format(scene="\n".join(f"  {key}: {value}" for key, value in keys.items())))
        return str(file)

    return write_scene


def run(*arguments):
    return CliRunner().invoke(cli, [str(word) for word in arguments])


def run_invalid(*arguments):
    """Return the error message of an invalid call, which `main` prints on stderr."""
    result = run(*arguments)
    assert result.exit_code != 0, result.output
    assert isinstance(result.exception, SystemExit | zwidth.ZwidthError)
    return result.stderr if isinstance(result.exception, SystemExit) else str(result.exception)


def run_json(*arguments):
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def make_options(keys):
    return [word for key, value in keys.items() for word in (f"--{key.replace('_', '-')}", value)]


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("check", []),
        ("check", ["--stiffness", "12 kN/m"]),
        ("recommend", ["--phase-margin", "30"]),
        ("ridge", []),
        ("design", ["--stiffness", "30 kN/m", "--find", "rate"]),
    ],
)
def test_scene_file_is_equivalent_to_options(command, options, write_scene):
    file = write_scene(**LINEAR, **WALL)
    wall = {key: value for key, value in WALL.items() if f"--{key.replace('_', '-')}" not in options}
    given = make_options(LINEAR | (wall if command in ("check", "design") else {}))
    assert run_json(command, file, *options) == run_json(command, *given, *options)


@pytest.mark.parametrize(
    "changed",
    [
        {"mass": "70 g"},
        {"damping": "2"},
        {"rate": "2 kHz"},
        {"period": "0.5 ms"},
        {"delay": "1.5 periods"},
        {"velocity_cutoff": "50 Hz"},
        {"velocity_samples": "5"},
        {"operator_mass": "500 g"},
        {"coupling_mass": "20 g", "coupling_stiffness": "20 kN/m"},
        {"actuator_cutoff": "200 Hz"},
        {"modes_0_frequency": "140 Hz", "modes_0_mass": "600 g", "modes_0_damping_ratio": "0.02"},
        {"stiffness": "5 kN/m"},
        {"virtual_damping": "30"},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_option_overrides_the_file(changed, write_scene):
    keys = LINEAR | WALL
    timing = {"rate"} if "period" in changed else set()
    both = {key: value for key, value in keys.items() if key not in timing} | changed
    assert run_json("check", write_scene(**keys), *make_options(changed)) == run_json("check", *make_options(both))


def test_option_changes_single_parameters_of_a_filter(write_scene):
    file = write_scene(
        **LINEAR, **WALL, velocity="{kind: butterworth, cutoff: 100 Hz, order: 4}", operator="{mass: 500 g}"
    )
    changed = run_json("check", file, "--velocity-cutoff", "200 Hz", "--operator-mass", "0.2")
    scene = zwidth.Scene(
        zwidth.Device(0.1, 10),
        zwidth.Timing(rate=1000, delay=1e-3),
        zwidth.VirtualWall(10e3, 40),
        velocity=zwidth.Butterworth(cutoff=200, order=4),
        operator=zwidth.Operator(mass=0.2),
    )
    assert changed["spectral_radius"] == pytest.approx(float(scene.spectral_radius()), rel=1e-12)


def test_device_option_replaces_the_device_of_the_file(write_scene):
    file = write_scene(**LINEAR, **WALL, coupling="{mass: 20 g, stiffness: 20 kN/m}")
    changed = run_json("check", file, "--device", "1 / 0.1 10 0")
    assert changed["spectral_radius"] == pytest.approx(
        run_json("check", *make_options(LINEAR | WALL))["spectral_radius"], rel=1e-9
    )


def test_rotary_file_implies_rotary_units(write_scene):
    file = write_scene(mass="60 g cm^2", damping="0.02 mN m s/rad", rate="1 kHz", delay="0.7 periods")
    result = run("check", file, "--stiffness", "0.05")
    assert result.exit_code == 0, result.output
    assert "mN m/rad" in result.output
    assert "in linear units, together with scene.yaml" in run_invalid("check", file, "--stiffness", "10 N/m")


def test_run_folder_is_accepted_as_scene_file(write_scene, tmp_path):
    file = write_scene(**LINEAR, **WALL)
    assert run("run", file, "--out", tmp_path / "out").exit_code == 0
    assert run_json("check", tmp_path / "out") == run_json("check", file)


@pytest.mark.parametrize(
    ("keys", "arguments", "message"),
    [
        (LINEAR, ["check"], "give --stiffness: the scene of the file has no wall"),
        (LINEAR, ["check", "--virtual-damping", "3"], "give --stiffness: the scene of the file has no wall"),
        ({"delta": 0.1, "d": 1}, ["ridge"], "scene: got normalized parameters"),
        (LINEAR, ["check", "--rate", "1 kHz", "--period", "1 ms"], "--period and --rate are both given"),
        (
            {"device": "{numerator: [1], denominator: [0.1, 10, 0]}", "rate": "1 kHz"},
            ["check", "--stiffness", "1", "--mass", "1"],
            "--mass: the file gives the device as a linear system or a response; change it in the file",
        ),
    ],
)
def test_missing_or_conflicting_fields_are_named(keys, arguments, message, write_scene):
    assert message in run_invalid(arguments[0], write_scene(**keys), *arguments[1:])


def test_missing_file_or_scene_is_named(tmp_path):
    file = tmp_path / "bare.yaml"
    file.write_text("version: 1\nname: bare\nstudies:\n  - {kind: ridge, name: top, delta: 0.1, d: 1}\n")
    assert "add a section 'scene'" in run_invalid("ridge", file)
    assert "absent.yaml" in run_invalid("ridge", tmp_path / "absent.yaml")
    with pytest.raises(zwidth.ConfigError):
        zwidth.load_scene(tmp_path / "absent.yaml")


WITH_HARDWARE = """\
version: 1
name: fitted
scene: {{mass: 100 g, damping: 10 N s/m, rate: 1 kHz, delay: 1 ms{}}}
studies: [{{kind: recommend, name: wall}}]
"""


def test_hardware_of_a_file_is_printed(tmp_path):
    file, wall = tmp_path / "fitted.yaml", ("--stiffness", "5 kN/m", "--virtual-damping", "30 N s/m")
    file.write_text(WITH_HARDWARE.format(", resolution: 20 um, coulomb: 50 mN, max_force: 3 N"))
    used = "encoder step 20.0 µm, friction 50.0 mN, largest motor output 3.00 N"
    for arguments in (["recommend", str(file)], ["check", str(file), *wall]):
        text = " ".join(CliRunner().invoke(cli, arguments).stdout.split())
        assert f"hardware {used} (from fitted.yaml)" in text
        assert "no friction given" not in text
    for name in ("diagnose", "simulate"):
        text = " ".join(CliRunner().invoke(cli, [name, str(file), *wall, "--max-force", "4 N"]).stdout.split())
        assert "hardware encoder step 20.0 µm, friction 50.0 mN (from fitted.yaml)" in text
    result = CliRunner().invoke(cli, ["run", str(file), "--out", str(tmp_path / "run")])
    text = " ".join(result.stdout.split())
    assert "grasps: stable in all six reference grasps" in text
    assert f"simulated with {used}: " in text
    assert f"simulated with {used}: " in (tmp_path / "run" / "recommendation.md").read_text("utf-8")
    assert "hardware" not in CliRunner().invoke(cli, ["check", *wall, *DEVICE, "--resolution", "20 um"]).stdout


def test_encoder_without_friction_has_a_caution(tmp_path):
    file, caution = tmp_path / "fitted.yaml", "no friction given: the encoder is simulated without friction"
    file.write_text(WITH_HARDWARE.format(", resolution: 20 um"))
    wall = "--stiffness", "5 kN/m", "--virtual-damping", "30 N s/m"
    options = [*DEVICE, "--resolution", "20 um"]
    for arguments in (["check", str(file)], ["recommend", *options], ["simulate", *options], ["diagnose", str(file)]):
        arguments += wall if arguments[0] != "recommend" else ()
        text = " ".join(CliRunner().invoke(cli, arguments).stdout.split())
        assert text.count(f"CAUTION {caution}, which can stop a limit cycle; give") == 1
    assert "no friction given" not in CliRunner().invoke(cli, ["check", str(file), *wall, "--friction", "0"]).stdout
    assert caution in json.loads(CliRunner().invoke(cli, ["recommend", str(file), "--json"]).stdout)["cautions"][-1]
    assert "friction" not in CliRunner().invoke(cli, ["ridge", str(file)]).stdout
    run = CliRunner().invoke(cli, ["run", str(file), "--out", str(tmp_path / "run")]).stdout
    assert "simulated with encoder step 20.0 µm, without friction: " in " ".join(run.split())


def test_filter_of_sections_agrees_with_python(tmp_path):
    file = tmp_path / "filtered.yaml"
    sections = {"numerator": [[1000, -1000], [0.2, 0.1]], "denominator": [[1, 0], [1, -0.7]]}
    filtered = (
        f", velocity: {{kind: filter, numerator: {sections['numerator']}, denominator: {sections['denominator']}}}"
    )
    file.write_text(WITH_HARDWARE.format(filtered))
    maximum = json.loads(CliRunner().invoke(cli, ["ridge", str(file), "--json"]).stdout)["stiffness_max"]
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), velocity=zwidth.VelocityFilter(**sections))
    assert maximum == float(scene.max_stiffness().stiffness)
    file.write_text(file.read_text().replace("[0.2, 0.1]", "3"))
    with pytest.raises(zwidth.ConfigError, match=r"numerator\[1\]: got 3; coefficients are a list"):
        CliRunner().invoke(cli, ["ridge", str(file)], catch_exceptions=False)
