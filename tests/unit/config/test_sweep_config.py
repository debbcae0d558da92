"""Sweep studies in configurations: axes with units, tables of devices in YAML and CSV, and located errors."""

import json
from pathlib import Path

import numpy as np
import pytest

from zwidth.config.fields import ConfigFileError
from zwidth.stability.rigid.normalization import normalize
from zwidth.studies.document import Config, config_json_schema
from zwidth.sweep.grid import Grid

ROOT = Path(__file__).parents[3]
SCENE = "scene: {mass: 100 g, damping: 10 N s/m, rate: 1 kHz, delay: 1 ms}\n"
CSV = """label, mass [g], damping (N s/m), source
# remarks are skipped

small, 50, 1, a guess
large, 2 kg, 3e1, another
"""


def sweep(axes, rest=""):
    return f"studies: [{{kind: sweep, name: s, axes: {{{axes}}}{rest}}}]\n"


def test_physical_axes_with_units(load):
    axes = "stiffness: [1 N/mm, 2e3], virtual_damping: {linear: {start: 0, stop: 20 N s/m, num: 3}}, mass: 100 g, "
    axes += "damping: {log: {start: 1 N s/m, stop: 100, num: 3}}, rate: [1 kHz, 500], delay: [0 periods, 1 periods]"
    study = load(sweep(axes)).studies[0]
    grid = Grid(study)
    assert grid.sizes == {"rate": 2, "delay": 2, "damping": 3, "stiffness": 2, "virtual_damping": 3}
    assert grid.device_dims == ("rate", "delay", "damping")
    block = grid.block(tuple(slice(None) for _ in grid.dims))
    period = 1 / np.array([1000.0, 500.0])
    damping, stiffness = np.array([1.0, 10.0, 100.0]), np.array([1000.0, 2000.0])
    indices = np.ix_(range(2), range(2), range(3))
    device = normalize(mass=0.1, damping=damping, period=period[:, None, None] + np.zeros((1, 2, 1)))
    np.testing.assert_array_equal(block.delta.reshape(2, 2, 3), device.delta)
    np.testing.assert_array_equal(block.d.reshape(2, 2, 3), indices[1] + np.zeros((2, 1, 3)))
    wall = normalize(mass=0.1, period=period[:, None], stiffness=stiffness, virtual_damping=stiffness / 100.0)
    np.testing.assert_array_equal(block.alpha.reshape(2, 2, 3, 2)[:, 1, 2], wall.alpha)
    np.testing.assert_array_equal(block.beta.reshape(2, 2, 3, 3)[:, 0, 0, 1:], wall.beta)


def test_delays_in_seconds_are_exact_multiples_of_the_period(load):
    study = load(sweep("stiffness: 1, mass: 1, period: 0.1 ms, delay: [0.3 ms, 1.1 ms]")).studies[0]
    assert list(Grid(study).block((slice(None),)).d) == [3.0, 11.0]


def test_scene_supplies_the_device(load):
    study = load(SCENE + sweep("stiffness: [1, 2]")).studies[0]
    assert set(study.axes.given) == {"period", "delay", "mass", "damping", "stiffness"}
    study = load(SCENE + sweep("alpha: [1, 2], d: 3")).studies[0]
    assert set(study.axes.given) == {"alpha", "delta", "d"}
    assert study.axes.delta.values() == pytest.approx([0.1])


def test_columns_of_a_device_table_form_one_axis(load):
    study = load(sweep("devices: {label: [a, b], mass: [100 g, 1], delay: [1 ms, 3]}, rate: 1 Hz, stiffness: [1, 2]"))
    grid = Grid(study.studies[0])
    assert grid.sizes == {"device": 2, "stiffness": 2}
    block = grid.block((slice(0, 2), slice(1, 2)))
    assert list(block.d) == [0.001, 3.0]
    assert block.alpha[:, 0] == pytest.approx([20.0, 2.0])
    assert list(grid.coordinates()["device"][1]) == ["a", "b"]


def test_devices_from_a_csv_file(load, tmp_path, monkeypatch):
    (tmp_path / "devices.csv").write_text(CSV, encoding="utf-8")
    config = load(SCENE + sweep("devices: {csv: devices.csv}, stiffness: 10"))
    table = config.studies[0].axes.devices
    assert table.labels == ("small", "large")
    assert table.columns == {"mass": (0.05, 2.0), "damping": (1.0, 30.0)}
    # The dump contains the table and needs no file.
    dump = config.model_dump(mode="json", exclude_none=True)
    assert dump["studies"][0]["axes"]["devices"] == {
        "label": ["small", "large"],
        "mass": [0.05, 2.0],
        "damping": [1.0, 30.0],
    }
    assert Config.model_validate(dump).model_dump(mode="json", exclude_none=True) == dump


def test_devices_of_a_spreadsheet_with_decimal_commas(load, tmp_path):
    (tmp_path / "d.csv").write_text("sep=;\nlabel;mass (g);damping\narm, left;0,5;1,5\n", encoding="utf-8")
    table = load(SCENE + sweep("devices: {csv: d.csv}, stiffness: 10")).studies[0].axes.devices
    assert (table.labels, table.columns) == (("arm, left",), {"mass": (0.0005,), "damping": (1.5,)})


NORMALIZED = "alpha: 1, delta: 1, d: 1"
PHYSICAL = "stiffness: 1, mass: 1, rate: 1 kHz, "


@pytest.mark.parametrize(
    "axes, rest, field, message",
    [
        (NORMALIZED + ", mass: 1 kg", "", "axes.mass", "never both"),
        (NORMALIZED + ", rate: 1", "", "axes.rate", "never both"),
        ("alpha: 1, d: 1", "", "axes", "delta missing"),
        ("stiffness: 1, mass: 1", "", "axes", "period missing"),
        ("stiffness: 1, rate: 1", "", "axes", "mass missing"),
        ("delta: 1, d: 1", "", "axes", "alpha missing"),
        (NORMALIZED, ", outputs: [alpha_max]", "axes.alpha", "changes no output"),
        ("delta: 1, d: 1", ", outputs: [stiffness_max]", "outputs[0]", "SI units"),
        (NORMALIZED, ", outputs: [stabel]", "outputs[0]", "did you mean 'stable'?"),  # codespell:ignore
        ("mass: [0.05, 0.1], damping: 10, rate: 1e3", ", outputs: [K_max]", "outputs[0]", "write stiffness_max"),
        (NORMALIZED, ", outputs: [rho]", "outputs[0]", "write spectral_radius"),
        (NORMALIZED, ", accuracy: 0", "accuracy", "at least"),
        (NORMALIZED, ", accuracy: 1e-13", "accuracy", "at least 1e-12"),
        (NORMALIZED, ", accuracy: tight", "accuracy", "one number"),
        (NORMALIZED + ", betta: 1", "", "axes.betta", "did you mean 'beta'?"),
        (NORMALIZED + ", d: 1", "", "axes.d", "occurs twice"),
        ("stiffness: 1, mass: 1, rate: 1, period: 1", "", "axes.period", "both given"),
        ("stiffness: 1, mass: 1, rate: 1, delay: [1 s, 1 periods]", "", "axes.delay[1]", "all in seconds"),
        ("stiffness: [1 N/m, 1], mass: 1, rate: 1", "", "axes.stiffness[1]", "twice"),
        ("stiffness: 1 kg, mass: 1, rate: 1", "", "axes.stiffness", "units allowed"),
        ("stiffness: 1, mass: 1, rate: 1 kHz, delay: 11", "", "axes.delay", "longest delay"),
        ("devices: {mass: [1, 2], damping: [1]}, stiffness: 1, rate: 1", "", "axes.devices", "different length"),
        ("devices: {mass: [1, 0]}, stiffness: 1, rate: 1", "", "axes.devices.mass[1]", "greater than 0"),
        ("devices: {mas: [1]}, stiffness: 1, rate: 1", "", "axes.devices.mas", "did you mean 'mass'?"),
        ("devices: {mass: 1}, stiffness: 1, rate: 1", "", "axes.devices.mass", "is a list"),
        ("devices: {label: [a]}, stiffness: 1", "", "axes.devices", "no parameter"),
        ("devices: {mass: [1]}, mass: 2, stiffness: 1, rate: 1", "", "axes.mass", "given twice"),
        ("devices: {mass: [1]}, alpha: 1, d: 1", "", "axes.devices", "never both"),
        ("devices: 3", "", "axes.devices", "lists of equal length"),
        ("devices: {csv: missing.csv}, stiffness: 1", "", "axes.devices.csv", "no such file"),
        ("devices: {csv: wrong.csv}, stiffness: 1, rate: 1", "", "axes.devices.csv", "line 3: mass: got -1 kg"),
        ("devices: {csv: short.csv}, stiffness: 1, rate: 1", "", "axes.devices.csv", "line 2: damping is missing"),
        ("devices: {csv: mixed.csv}, stiffness: 1, rate: 1", "", "axes.devices.csv", "'1,500' in line 2; "),
        ("devices: {csv: typo.csv}, stiffness: 1, rate: 1", "", "axes.devices.csv", "did you mean 'damping'?"),
        ("devices: {csv: empty.csv}, stiffness: 1, rate: 1", "", "axes.devices.csv", "0 rows"),
        ("devices: {csv: wrong.csv, unit: g}, stiffness: 1", "", "axes.devices.unit", "has the keys 'csv'"),
        ("devices: {csv: 3}, stiffness: 1", "", "axes.devices.csv", "must be text"),
        (PHYSICAL + "velocity.samples: [2, 5]", "", "axes.velocity.samples", "{kind: windowed_difference, samples: 5}"),
        (
            PHYSICAL + "velocity.time_constant: [1 ms, 2 ms]",
            "",
            "axes.velocity.time_constant",
            "low_pass, time_constant: 2 ms",
        ),
        (PHYSICAL + "velocity.order: [1, 2]", "", "axes.velocity.order", "{kind: low_pass, cutoff: 100 Hz}"),
        (PHYSICAL + "modes.0.mass: [1, 2]", "", "axes.modes.0.mass", "damping_ratio: 0.03, mass: 2 kg}]"),
        (
            "alpha: {linear: {start: 0, stop: 1, num: 9999999}}, beta: {linear: {start: 0, stop: 1, num: 9999999}}, "
            "delta: 1, d: 1",
            "",
            "studies[0]",
            "at most 1e+12 points",
        ),
    ],
)
def test_invalid_sweeps_raise_at_their_location(load, tmp_path, axes, rest, field, message):
    (tmp_path / "wrong.csv").write_text("mass\n1\n-1\n", encoding="utf-8")
    (tmp_path / "short.csv").write_text("mass,damping\n1\n", encoding="utf-8")
    (tmp_path / "typo.csv").write_text("mass,dampng\n1,2\n", encoding="utf-8")
    (tmp_path / "empty.csv").write_text("", encoding="utf-8")
    (tmp_path / "mixed.csv").write_text("mass [g];damping\n1,500;0.5\n", encoding="utf-8")
    with pytest.raises(ConfigFileError) as caught:
        load(sweep(axes, rest))
    fields = [fault.field.removeprefix("studies[0].") for fault in caught.value.faults]
    assert field in fields, str(caught.value)
    assert message in str(caught.value)
    for fault in caught.value.faults:
        assert fault.line is not None
        assert fault.remedy, str(fault)


def test_shipped_schema_is_the_output_of_zwidth_schema():
    shipped = (ROOT / "src" / "zwidth" / "config" / "schema.json").read_text(encoding="utf-8")
    assert shipped == json.dumps(config_json_schema(), indent=2) + "\n", (
        "run: zwidth schema > src/zwidth/config/schema.json"
    )


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_configuration_refers_to_the_schema(path):
    first = path.read_text(encoding="utf-8").splitlines()[0]
    marker = "# yaml-language-server: $schema="
    assert first.startswith(marker)
    assert (path.parent / first.removeprefix(marker)).resolve() == ROOT / "src" / "zwidth" / "config" / "schema.json"


@pytest.mark.parametrize(
    ("axes", "key", "remedy"),
    [
        ("alpha: [0.1, 0.2], stiffness: [1 kN/m, 2 kN/m]", "stiffness", "remove it"),
        ("stiffness: [1 kN/m, 2 kN/m], alpha: [0.1, 0.2]", "alpha", "remove it"),
        ("delta: [0.1, 0.2], stiffness: [1 kN/m, 2 kN/m]", "stiffness", "write 'alpha'"),
    ],
)
def test_mixed_axes_with_a_scene_are_one_error_at_their_key(load, axes, key, remedy):
    with pytest.raises(ConfigFileError) as refused:
        load(SCENE + sweep(axes))
    (line,) = str(refused.value).splitlines()
    assert f"studies[0].axes.{key}: " in line
    assert line.endswith(f"are in SI units or normalized, never both; {remedy}")
