"""Devices given as a linear system or a measured response, against the same rigid device."""

import json
from typing import Any

import numpy as np
import pytest

import zwidth
from zwidth.config.fields import ConfigFileError
from zwidth.studies.document import Config

STUDIES = "studies: [{kind: recommend, name: r}]\n"
RIGID = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1e-3))
FREQUENCIES = np.geomspace(1.0, 450.0, 300)
RESPONSE = RIGID.frequency_response(1.0, 0.0, FREQUENCIES)


def scene_with(device: str, more: str = "period: 1 ms, delay: 1 ms") -> str:
    return f"scene: {{device: {device}, {more}}}\n{STUDIES}"


@pytest.fixture
def response_file(tmp_path):
    """Write a response next to the configuration."""
    zwidth.MeasuredDevice(FREQUENCIES, RESPONSE, 1e-9).save(tmp_path / "response.csv")


@pytest.mark.parametrize(
    "device",
    [
        "'1 / 0.1 10 0'",
        "'1, / 0.1, 10, 0'",
        "{numerator: [1], denominator: [0.1, 10, 0]}",
        "{numerator: 1, denominator: [0.1, 10, 0]}",
        "{poles: [0, -100], gain: 10}",
        "{zeros: [], poles: ['0', '-100+0j'], gain: 10}",
        "{A: [[0, 1], [0, -100]], B: [0, 10], C: [1, 0]}",
    ],
)
def test_every_form_of_a_rigid_mass_agrees_with_the_rigid_device(load, device):
    config = load(scene_with(device))
    maximum, expected = config.scene.to_scene().max_stiffness(), RIGID.max_stiffness()
    np.testing.assert_allclose(maximum[:3], expected[:3], rtol=1e-12)
    # The dumped configuration is equal.
    assert Config.model_validate(config.model_dump(mode="json", exclude_none=True)) == config


def test_complex_roots_with_their_conjugates(load):
    scene = load(scene_with("{poles: [0, '-3 + 40j', '-3 - 40j'], gain: 1e3}")).scene.to_scene()
    assert sorted(scene.device.poles, key=lambda pole: pole.imag) == pytest.approx([-3 - 40j, 0, -3 + 40j], rel=1e-15)


def test_sampled_system_agrees_with_the_rigid_device(load):
    loop = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3)).open_loop(1.0, 0.0)
    matrices = {name: getattr(loop, name).tolist() for name in "AB"} | {"C": loop.C.tolist(), "sampled": "1 ms"}
    scene = load(scene_with(json.dumps(matrices), "period: 1 ms")).scene.to_scene()
    expected = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3)).max_stiffness()
    np.testing.assert_allclose(scene.max_stiffness()[:3], expected[:3], rtol=1e-9)


def test_response_file_is_read_and_stored_by_its_values(load, response_file, tmp_path):
    config = load(scene_with("response.csv", "period: 1 ms"))
    expected = zwidth.MeasuredDevice(FREQUENCIES, RESPONSE, 1e-9)
    assert config.scene.to_scene().device == expected
    dump = config.model_dump(mode="json", exclude_none=True)
    (tmp_path / "response.csv").unlink()
    again: Any = Config.model_validate(dump).scene
    assert again.to_scene().device == expected
    (study,) = config.studies
    (outcome,) = [study.compute(config.scene, True)]
    report = json.loads(outcome.documents["recommendation.json"])
    wall = report["recommended"]["stiffness"], report["recommended"]["virtual_damping"]
    assert RIGID.is_stable(*wall), "every response in the uncertainty band is stable, including this one"
    assert report["recommended"]["spectral_radius"] is None
    text = outcome.documents["recommendation.md"]
    assert "for every response in the band" in text
    assert "measured response, 300 lines from 1 to 450 Hz" in text


@pytest.mark.parametrize(
    ("device", "more", "field", "message"),
    [
        ("nobody", "period: 1 ms", "scene.device", "published are"),
        ("phantom_2007", "period: 1 ms", "scene.device", "did you mean 'phantom_2006'?"),
        ("'1 / x'", "period: 1 ms", "scene.device", "coefficients in s"),
        ("'1 / 2 / 3'", "period: 1 ms", "scene.device", "coefficients in s"),
        ("missing.csv", "period: 1 ms", "scene.device", "missing.csv: no such file; check the path"),
        ("3", "period: 1 ms", "scene.device", "published are"),
        ("{frequency: [1, 2], real: [1, 2], imag: [1]}", "period: 1 ms", "scene.device.imag", "and 2 of real"),
        ("{numerator: [1]}", "period: 1 ms", "scene.device", "'numerator', 'denominator' or"),
        ("{numerator: [1], poles: [0]}", "period: 1 ms", "scene.device", "a linear system has"),
        ("{numerator: [1, 0, 0], denominator: [1, 0]}", "period: 1 ms", "scene.device", "add the missing dynamics"),
        ("{numerator: [1], denominator: [x]}", "period: 1 ms", "scene.device.denominator", "list of finite numbers"),
        ("{numerator: [1], denominator: [true]}", "period: 1 ms", "scene.device.denominator", "list of finite numbers"),
        ("{poles: ['-3+40j'], gain: 1}", "period: 1 ms", "scene.device", "it must be finite numbers"),
        ("{numerator: [1], denomnator: [1, 0]}", "period: 1 ms", "scene.device.denomnator", "did you mean"),
        ("'1 / 0.1 10 0'", "period: 1 ms, mass: 1 kg", "scene.mass", "remove one"),
        ("'1 / 0.1 10 0'", "period: 1 ms, operator: {mass: 1}", "scene.operator", "remove one"),
        ("response.csv", "period: 1 ms, delay: 1 ms", "scene.delay", "includes all delays"),
        ("response.csv", "period: 2 ms", "scene.device.frequency", "below the Nyquist frequency"),
        ("{frequency: [1, 2], real: [1, 2], imag: [1, 2]}", "period: 1 ms", "scene.device.frequency", "at least 8"),
    ],
)
def test_invalid_devices_raise_at_their_location(load, response_file, device, more, field, message):
    with pytest.raises(ConfigFileError) as error:
        load(scene_with(device, more))
    (fault,) = error.value.faults
    assert fault.field == field
    assert message in str(fault)


@pytest.mark.parametrize(
    ("study", "message"),
    [
        ("kind: passivity", "a device with a system or response in place of its mass"),
        ("kind: boundary, passivity: true", "without a system or response"),
        ("kind: sweep, axes: {period: [0.5 ms, 1 ms]}, outputs: [stiffness_max]", "at which it was measured"),
        ("kind: simulate, walls: [{stiffness: 1000}]", "a simulation needs mass"),
    ],
)
def test_study_requiring_a_mass_or_model_raises(load, response_file, study, message):
    with pytest.raises(ConfigFileError, match=message):
        load(scene_with("response.csv", "period: 1 ms").replace("kind: recommend", study))


def test_devices_of_different_forms_are_compared(load, response_file):
    text = scene_with("'1 / 0.2 10 0'").replace(
        "kind: recommend, name: r",
        "kind: compare, name: c, devices: [{label: of the scene}, {label: rigid, mass: 0.1, damping: 10}, "
        "{label: measured, device: response.csv, delay: 0 s}]",
    )
    config = load(text)
    (study,) = config.studies
    stiffness = study.compute(config.scene, True).table["stiffness_N_per_m"]
    heavy = zwidth.Scene(zwidth.Device(0.2, 10.0), RIGID.timing)
    assert stiffness[:2] == pytest.approx([heavy.max_stiffness().stiffness, RIGID.max_stiffness().stiffness], rel=1e-12)
    assert 0.9 * stiffness[1] < stiffness[2] < stiffness[1]
