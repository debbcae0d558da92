"""`zwidth simulate` and `zwidth diagnose`, typed as a user types them."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli

pytestmark = pytest.mark.usefixtures("fitted_once")
KNOB = [
    *("--mass", "60 g cm^2", "--damping", "0.02 mN m s/rad", "--rate", "1 kHz", "--delay", "0.7 periods"),
    *("--velocity-cutoff", "100 Hz", "--stiffness", "0.3 N m/rad", "--virtual-damping", "1.4 mN m s/rad"),
]
HANDLE = ["--mass", "100 g", "--damping", "10", "--rate", "1 kHz", "--delay", "1 ms", "--virtual-damping", "33.45"]
SOFT, STIFF = ["--stiffness", "8.008 kN/m"], ["--stiffness", "25 kN/m"]


def run(*arguments):
    result = CliRunner().invoke(cli, list(arguments))
    assert result.exit_code == 0, result.output
    return result.stdout


def parse(*arguments):
    return json.loads(run(*arguments, "--json"))


def test_the_knob_of_2000_counts():
    printed = run("diagnose", *KNOB, "--resolution", "2000 counts", "--friction", "0.1 mN m")
    cause, _, remedies = " ".join(printed.split()).partition("to stop it ")
    assert cause.startswith("LIMIT CYCLE ")
    assert "caused by the encoder's steps of 3.14 mrad; the linear loop is stable" in cause
    assert "counts per turn" in remedies
    assert "or friction at least " in remedies
    assert remedies.endswith("; simulated at these and larger changes: check the value that you choose with diagnose")
    frictionless = " ".join(run("diagnose", *KNOB, "--resolution", "2000 counts").split())
    assert "; without friction a finer encoder only reduces the amplitude, in proportion to its steps" in frictionless
    found = parse("diagnose", *KNOB, "--resolution", "0.0005 rev", "--friction", "0.1 mN m")
    assert found["cause"] == "quantization"
    assert found["hardware"]["resolution"] == pytest.approx(2 * np.pi / 2000)


def test_an_unstable_wall_says_what_makes_it_stable():
    printed = run("diagnose", *HANDLE, *STIFF)
    assert printed.startswith("UNSTABLE ")
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(rate=1000, delay=1e-3))
    ends = {each["parameter"]: each["high"] for each in parse("diagnose", *HANDLE, *STIFF)["remedies"]}
    assert ends["stiffness"] == pytest.approx(scene.stable_stiffness(33.45)[0, 1], rel=1e-2)


def test_without_encoder_a_stable_wall_comes_to_rest():
    assert run("diagnose", *HANDLE, *SOFT).startswith("AT REST ")


def test_a_hit(tmp_path):
    file = tmp_path / "hit.png"
    printed = run("simulate", *HANDLE, *SOFT, "--hit", "0.1 m/s", "--figure", str(file))
    assert "hit at 100 mm/s" in printed
    assert "leaves the wall after 1 contact" in printed
    assert file.read_bytes().startswith(b"\x89PNG")
    found = parse("simulate", *HANDLE, *SOFT, "--hit", "0.1 m/s")
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(rate=1000, delay=1e-3))
    motion = scene.simulate(
        8008, 33.45, start_position=-2e-4, start_velocity=0.1, contact="unilateral", periods=found["periods"]
    )
    assert found["penetration"] == pytest.approx(motion.penetration, rel=1e-12)
    assert found["bounces"] == motion.bounces


def test_a_push_and_a_release():
    found = parse("simulate", *HANDLE, *SOFT, "--push", "2 N", "--duration", "500 periods")
    assert found["periods"] == 500
    # With a constant force the device rests at F/K, after one overshoot of less than twice that.
    assert 2 / 8008 < found["penetration"] < 4 / 8008
    assert found["outcome"] == "REST"
    held = run("simulate", *HANDLE, *SOFT, "--hold", "0.2 mm", "--resolution", "20 um")
    assert "released at a depth of 200 µm" in held
    assert "caused by the encoder's steps of 20.0 µm" in held


def test_a_transfer_function_is_pushed():
    found = run(*("simulate", "--device", "1 / 0.1 10 0", "--rate", "1 kHz", *SOFT, "--virtual-damping", "33.45"))
    assert "pushed with 8.01 N" in found


def test_a_scene_file(tmp_path):
    file = tmp_path / "knob.yaml"
    scene = "{mass: 60 g cm^2, damping: 0.02 mN m s/rad, period: 1 ms, stiffness: 0.1 N m/rad, virtual_damping: 1e-3}"
    file.write_text(
        f"version: 1\nname: knob\nscene: {scene}\nstudies: [{{kind: simulate, name: s}}]\n", encoding="utf-8"
    )
    printed = run("simulate", str(file), "--hit", "1 rad/s", "--duration", "0.2 s")
    assert "hit at 1.00 rad/s" in printed
    assert run("diagnose", str(file)).startswith("AT REST ")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--hit", "1 m/s", "--hold", "1 mm"], "--hold: given together with --hit"),
        (["--hit", "0"], "'--hit'"),
        (["--resolution", "20 kg"], "'--resolution'"),
    ],
)
def test_bad_input(given, said):
    result = CliRunner().invoke(cli, ["simulate", *HANDLE, *SOFT, *given])
    assert result.exit_code != 0
    assert said in result.output + str(result.exception)
