"""Reading of valid configurations: defaults, values from the scene, SI units, YAML 1.2, dumps and the JSON schema."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from zwidth.analysis.scene import Scene
from zwidth.config.reader import read_mapping, write_yaml
from zwidth.config.scenes import NormalizedWall, PhysicalDevice, PhysicalWall, normalized_wall
from zwidth.model.checks import Span
from zwidth.studies.document import KINDS, Config, config_json_schema, load_config
from zwidth.studies.ridge import PassivityStudy, RidgeStudy

CONFIGS = Path(__file__).parents[3] / "configs"
SHIPPED = sorted(CONFIGS.glob("*.yaml"))
PHYSICAL = "scene: {mass: 100 g, damping: 10 N s/m, rate: 1 kHz, delay: 1.5 periods}\n"
RIDGE = "studies: [{kind: ridge, name: r}]\n"


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_configs_are_valid_and_named_after_their_file(path):
    config = load_config(str(path))
    assert config.name == path.stem
    assert all(study.points > 0 and study.nbytes > 0 for study in config.studies)


def test_paper_configuration_is_complete():
    studies: dict[str, Any] = {study.name: study for study in load_config(CONFIGS / "paper.yaml").studies}
    figures = ["fig5", "fig6", "fig7", "fig8", "fig9", "fig10", "fig11"]
    assert list(studies) == [*figures, "passivity_cost", "published"]
    np.testing.assert_array_equal(studies["fig5"].delta.values(), [0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_array_equal(studies["fig5"].d.values(), [0, 1, 2, 4])
    np.testing.assert_array_equal(studies["fig6"].d.values(), [0, 0.25, 0.5, 1, 2, 4])
    np.testing.assert_array_equal(studies["fig10"].d.values(), [0, 0.125, 0.25, 0.5, 1, 2, 4])
    assert [studies[name].kind for name in ("fig6", "fig10")] == ["paper_fig6", "paper_fig10"]
    devices = studies["fig11"].devices
    assert [device.delta for device in devices] == pytest.approx([0, 0.1, 1])
    assert [device.d for device in devices] == [1, 1, 1]


def test_scene_supplies_omitted_fields(load):
    config = load(
        PHYSICAL
        + "studies:\n"
        + "  - {kind: ridge, name: r}\n"
        + "  - {kind: boundary, name: b, d: [0, 1]}\n"
        + "  - {kind: map, name: m, alpha: 0.1, beta: [0, 1], delta: 3}\n"
        + "  - {kind: step, name: s, stiffness_fraction: 0.5}\n"
        + "  - {kind: recommend, name: k}\n"
    )
    ridge, boundary, grid, step, recommend = config.studies
    assert ridge.delta.values() == pytest.approx([0.1])
    assert ridge.d.values() == [1.5]
    assert list(boundary.d.values()) == [0, 1]
    assert grid.delta.values() == [3]
    assert tuple(grid.sizes.values()) == (1, 2, 1, 1)
    assert step.devices == (recommend.device,) == (config.scene.without_wall(),)
    assert step.pairs() == ((config.scene.without_wall(), None),)
    assert (recommend.device.mass, recommend.device.period) == (0.1, 1e-3)


def test_scene_supplies_its_wall_to_a_step_study(load):
    wall = "scene: {mass: 100 g, rate: 1 kHz, stiffness: 10 kN/m, virtual_damping: 40 N s/m}\n"
    study = load(wall + "studies: [{kind: step, name: s}]\n").studies[0]
    assert study.walls == (PhysicalWall(stiffness=10e3, virtual_damping=40.0),)
    assert normalized_wall(*study.pairs()[0]) == pytest.approx((0.1, 0.4))
    study = load(wall + "studies: [{kind: step, name: s, stiffness_fraction: 0.5}]\n").studies[0]
    assert study.walls is None


def test_physical_scene_is_in_si_units(load):
    scene = load(PHYSICAL.replace("}", ", stiffness: 10 N/mm}") + RIDGE).scene
    converted = scene.to_scene()
    assert isinstance(converted, Scene)
    assert (converted.device.mass, converted.device.damping) == (0.1, 10.0)
    assert (converted.timing.period, converted.timing.delay) == (1e-3, 1.5e-3)
    assert (converted.wall.stiffness, converted.wall.virtual_damping) == (10e3, 0.0)
    assert scene.d == 1.5
    assert scene.delta == pytest.approx(0.1)


def test_normalized_scene(load):
    scene = load("scene: {delta: 0.1, alpha: 0.2}\n" + RIDGE).scene
    assert (scene.delta, scene.d) == (0.1, 0.0)
    assert scene.wall == NormalizedWall(alpha=0.2, beta=0.0)


def test_devices_and_walls_are_paired(load):
    text = "studies: [{{kind: step, name: s, devices: [{}], walls: [{}]}}]\n"
    one, two = "{delta: 0}", "{delta: 0}, {delta: 1, d: 2}"
    for devices, walls, expected in [
        (two, "{alpha: 0.1}", [(0, 0.1), (1, 0.1)]),
        (two, "{alpha: 0.1}, {alpha: 0.2, beta: 0.3}", [(0, 0.1), (1, 0.2)]),
        (one, "{alpha: 0.1}, {alpha: 0.2}, {alpha: 0.3}", [(0, 0.1), (0, 0.2), (0, 0.3)]),
    ]:
        pairs = load(text.format(devices, walls)).studies[0].pairs()
        assert [(device.delta, wall.alpha) for device, wall in pairs] == expected


def test_defaults(load):
    step, grid = load(
        "studies:\n"
        "  - {kind: step, name: s, stiffness_fraction: 0.5, devices: [{mass: 1, period: 1}]}\n"
        "  - {kind: map, name: m, alpha: 0, beta: 0, delta: 0, d: 0}\n"
    ).studies
    assert (step.duration, step.substeps) == (Span(100.0, "periods"), 10)
    assert step.devices == (PhysicalDevice(mass=1.0, damping=0.0, period=1.0, delay=Span(0.0, "s")),)
    assert grid.outputs == ("stable",)


@pytest.mark.parametrize(
    "text, value",
    [("1e-3", 1e-3), ("1e6", 1e6), ("+.5", 0.5), ("0x10", 16.0), ("0o17", 15.0), ("017", 17.0), ("1.", 1.0)],
)
def test_numbers_of_yaml_1_2(load, text, value):
    assert load(f"studies: [{{kind: ridge, name: r, d: 0, delta: {text}}}]\n").studies[0].delta.values() == [value]


@pytest.mark.parametrize("text", ["no", "on", "12:30:45", "1_000", "2001-01-01"])
def test_texts_of_yaml_1_2(load, text):
    config = load(f"description: {text}\nscene: {{delta: 0}}\n{RIDGE}")
    assert config.description == text


def test_aliases_and_a_byte_order_mark(tmp_path):
    path = tmp_path / "config.yaml"
    text = "version: 1\nname: a\nstudies:\n  - {kind: ridge, name: r, delta: &x [0, 1], d: 0}\n"
    path.write_text(text + "  - {kind: passivity, name: p, delta: *x, d: 0}\n", encoding="utf-8-sig")
    first, second = load_config(path).studies
    assert isinstance(first, RidgeStudy)
    assert isinstance(second, PassivityStudy)
    assert first.delta == second.delta


def test_configs_are_frozen_and_picklable():
    config = load_config(CONFIGS / "phantom.yaml")
    with pytest.raises(ValueError, match="frozen"):
        config.name = "other"
    assert pickle.loads(pickle.dumps(config)) == config


@pytest.mark.parametrize("text", ["1e-3", "no", "0o7", "0x1F", "~", "", "it: is\nmany", "- µ", "true", "1 kHz"])
def test_written_yaml_is_read_back_equal(tmp_path, text):
    study = {"kind": "ridge", "name": "r", "delta": [1e-7, 1e-22, 0.1 + 0.2], "d": 0}
    data = {"version": 1, "name": "n", "description": text, "studies": [study, {**study, "name": "again"}]}
    (tmp_path / "written.yaml").write_text(write_yaml(data), encoding="utf-8")
    read = load_config(tmp_path / "written.yaml")
    assert read == read_mapping(data, Config)
    assert read.description == text


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_dump_is_read_back_equal(path, tmp_path, monkeypatch):
    # Dumps refer to log files, which are not embedded.
    for table in path.parent.glob("*.csv"):
        (tmp_path / table.name).write_bytes(table.read_bytes())
    monkeypatch.chdir(tmp_path)
    dump = load_config(path).model_dump(mode="json", exclude_none=True)
    (tmp_path / "dump.yaml").write_text(write_yaml(dump), encoding="utf-8")
    for again in (Config.model_validate(json.loads(json.dumps(dump))), load_config(tmp_path / "dump.yaml")):
        assert again.model_dump(mode="json", exclude_none=True) == dump


def conforms(value, schema, root):
    """Return whether a value conforms to a JSON Schema; supports only the keywords that this schema uses."""
    if "$ref" in schema:
        return conforms(value, root["$defs"][schema["$ref"].rsplit("/", 1)[1]], root)
    options = schema.get("anyOf") or schema.get("oneOf")
    if options and not any(conforms(value, option, root) for option in options):
        return False
    if ("const" in schema and value != schema["const"]) or value not in schema.get("enum", [value]):
        return False
    kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "integer": int, "number": (int, float)}
    if "type" in schema and not isinstance(value, kinds[schema["type"]]):
        return False
    if isinstance(value, dict):
        properties = schema.get("properties", {})
        return (
            set(schema.get("required", [])) <= set(value)
            and (set(value) <= set(properties) or schema.get("additionalProperties", True))
            and all(conforms(item, properties.get(key, {}), root) for key, item in value.items())
        )
    if isinstance(value, list):
        return all(conforms(item, schema.get("items", {}), root) for item in value)
    return isinstance(value, str | bool) or value >= schema.get("minimum", value)


@pytest.fixture(scope="module")
def schema():
    return json.loads(json.dumps(config_json_schema()))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_configs_conform_to_the_schema(path, schema):
    raw = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert conforms(raw, schema, schema)
    raw["studies"][0]["colour"] = "red"
    assert not conforms(raw, schema, schema)


def test_schema_describes_every_field(schema):
    assert set(schema["$defs"]) >= {model.__name__ for model in KINDS.values()}
    assert all("properties" in schema["$defs"][model.__name__] for model in KINDS.values())
    for model in [schema, *schema["$defs"].values()]:
        for name, field in model.get("properties", {}).items():
            assert name == "kind" or field.get("description"), (model["title"], name)
