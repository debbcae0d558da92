"""Invalid configuration files: every error is reported with its exact location and a remedy."""

import pickle
import re
from pathlib import Path

import pytest

from zwidth.config.fields import ConfigFileError
from zwidth.config.reader import _Tree, read_mapping
from zwidth.studies.document import Config, load_config

# Files by name: sections of bad_configs.txt, each after a line with its name, and files that are not plain text.
_PARTS = re.split(r"^=== (\w+)\n", (Path(__file__).parent / "bad_configs.txt").read_text(encoding="utf-8"), flags=re.M)
FILES = {name: text.encode() for name, text in zip(_PARTS[1::2], _PARTS[2::2], strict=True)} | {
    "control_character": b"version: 1\nname: bad\ndescription: a\x07b\n",
    "not_utf8": b"version: 1\nname: bad\ndescription: caf\xe9\n",  # codespell:ignore
    "tab": b"version: 1\nname: bad\nscene:\n\tmass: 0.1 kg\n\tperiod: 1 ms\n",
    "too_many_values": b"version: 1\nname: bad\nstudies: [" + 50_001 * b"1," + b"]\n",
    "utf16": "version: 1\nname: bad\nstudies:\n  - kind: ridge\n    name: r\n    delta: [0, 1]\n    d: 1\n".encode(
        "utf-16"
    ),
}

_DELAY_MODEL = "remove it; for the paper's z^(1+d), use the kinds 'paper_fig6' and 'paper_fig10'"

# Expected per file, in the order of the locations: the start of each message (line:column: field: problem) and the
# start of its remedy.
FAULTS = {
    "a_list": [("1:1: got a list of 2 items", "write 'key: value' lines, or {key: value}")],
    "alias_bomb": [("1:29: e[5][5][7][3][7]: too many values", "write long axes as linear or log")],
    "alias_of_itself": [("4:5: studies[0]: an alias of a value that contains it", "write the values out")],
    "alias_undefined": [("3:10: not valid YAML", "define it before with '&', or remove the '*'")],
    "axis_boolean": [("7:16: studies[0].delta[1]: got true", "write a number such as 0.5")],
    "axis_empty": [("7:12: studies[0].delta: got an empty list", "fill the list")],
    "axis_entry_quoted": [("7:16: studies[0].delta[1]: got '0.5'", "drop the quotes")],
    "axis_huge_number": [("7:12: studies[0].delta: got .inf", "write a finite number")],
    "axis_infinite": [("7:12: studies[0].delta: got .inf", "write a finite number")],
    "axis_nan": [("7:16: studies[0].delta[1]: got .nan", "write a finite number")],
    "axis_negative": [("7:16: studies[0].delta[1]: got -1", "write a number in this range")],
    "axis_nested_list": [("7:13: studies[0].delta[0]: got a list of 2 items", "write a number such as 0.5")],
    "axis_nothing": [("7:11: studies[0].delta: got nothing", "add one or remove the key")],
    "axis_number_quoted": [("7:12: studies[0].delta: got '1e-3'", "drop the quotes")],
    "axis_twice": [("7:19: studies[0].delta[2]: got 0.0 twice, here and at [0]", "remove it")],
    "axis_two_forms": [("7:12: studies[0].delta: got a mapping of 2 keys", "keep one of these forms")],
    "axis_unknown_form": [("7:13: studies[0].delta.lin: unknown key", "did you mean 'linear'?")],
    "axis_with_unit": [("7:12: studies[0].delta: got '10 N s/m'", "this field has no unit; write only the number")],
    "axis_word": [("7:12: studies[0].delta: got 'no'", "write a number such as 0.5")],
    "bad_indent": [("5:10: not valid YAML", "check the indentation, the colons and the")],
    "boolean_as_text": [("8:16: studies[0].passivity: got 'yes'", "write true or false, without quotes")],
    "complex_key": [("3:3: got a complex key", "write the name of a field")],
    "control_character": [("3:15: got the character '\\x07'", "remove it")],
    "damping_beyond_float": [("5:12: scene.damping: got 1e+20, whose normalized value is delta = 1e+40", "check the")],
    "damping_unit": [("5:12: scene.damping: got '10 N/m'", "write a number and a unit, as in '10 N s/m'")],
    "deep_keys": [(f"1:29: version{'.?' * 19}: the values are nested too deeply", "use fewer levels")],
    "deep_nesting": [(f"1:29: version{'[0]' * 19}: the values are nested too deeply", "use fewer levels")],
    "delay_axis_too_long": [("7:12: studies[0].d[1]: got 20000", "write a number in this range")],
    "delay_model_of_a_map": [("10:5: studies[0].delay_model: key of an earlier release", _DELAY_MODEL)],
    "delay_model_of_a_scene": [("6:3: scene.delay_model: key of an earlier release", _DELAY_MODEL)],
    "delay_models_of_a_study": [("8:5: studies[0].delay_models: key of an earlier release", _DELAY_MODEL)],
    "delay_negative": [("6:10: scene.delay: got -0.001 s", "write a number in this range")],
    "delay_too_long": [("6:10: scene.delay: got 11 s, which is 11000 periods", "check the units")],
    "delta_missing": [("4:5: studies[0].delta: missing", "add 'delta', or a scene")],
    "devices_missing": [("4:5: studies[0].devices: missing", "add 'devices', or a scene")],
    "devices_mixed": [("8:22: studies[0].devices[1].period: physical key, after", "remove it, or write all keys")],
    "duplicate_key": [("8:5: studies[0].delta: the key occurs twice, first in line 6", "remove one of them")],
    "duration_in_seconds": [("8:15: studies[0].duration: got 0.1 s", "write it in periods, as in '100 periods'")],
    "duration_unit": [("8:15: studies[0].duration: got '100 samples'", "write a number and a unit, as in '1 ms'")],
    "empty": [("1:1: the file is empty", "start with 'version: 1'")],
    "escape_beyond_unicode": [("3:17: an escape or a number that does not exist", "correct or remove it")],
    "fraction_75": [("7:25: studies[0].stiffness_fraction: got 75", "write 75 % as 0.75")],
    "fraction_and_walls": [("8:5: studies[0].walls: stiffness_fraction and walls are both", "remove one")],
    "fraction_missing": [("4:5: studies[0]: stiffness_fraction or walls is missing", "add 'stiffness_fraction")],
    "kind_list": [("4:11: studies[0].kind: got a list of 1 item", "write one of these")],
    "kind_missing": [("4:5: studies[0].kind: missing", "add 'kind: boundary'")],
    "kind_unknown": [("4:11: studies[0].kind: got 'rigde'", "did you mean 'ridge'?")],
    "linear_list": [("7:21: studies[0].delta.linear: got a list of 3 items", "write 'key: value' lines, or {key")],
    "linear_no_length": [("7:38: studies[0].delta.linear.stop: got 1, equal to start", "write one number instead")],
    "linear_num_1": [("7:46: studies[0].delta.linear.num: got 1", "write a number in this range")],
    "linear_num_fraction": [("7:46: studies[0].delta.linear.num: got 11.0", "write 11")],
    "linear_num_missing": [("7:21: studies[0].delta.linear.num: missing", "add 'num'")],
    "linear_unknown_key": [
        ("7:21: studies[0].delta.linear.stop: missing", "add 'stop'"),
        ("7:32: studies[0].delta.linear.end: unknown key", "remove it"),
    ],
    "log_from_zero": [("7:26: studies[0].delta.log.start: got 0", "write a number in this range")],
    "many_faults": [
        ("2:7: name: got 'Bad Name'", "write 'bad_name'"),
        ("4:9: scene.mass: got -1 kg", "write a number in this range"),
        ("5:11: scene.period: got '1 min'", "write a number and a unit, as in '1 ms'"),
        ("6:3: scene.dampng: unknown key", "did you mean 'damping'?"),
        ("10:16: studies[0].delta[1]: got .nan", "write a finite number"),
        ("10:22: studies[0].delta[2]: got '2'", "drop the quotes"),
        ("11:12: studies[0].d[1]: got 1 twice, here and at", "remove it"),
        ("11:15: studies[0].d[2]: got -1", "write a number in this range"),
        ("12:5: studies[0].colour: unknown key", "remove it"),
        ("13:11: studies[1].kind: got 'mop'", "did you mean 'map'?"),
        ("14:5: studies[2].beta: missing", "add 'beta'"),
        ("15:11: studies[2].name: got 'b' twice, here and at [0]", "rename one"),
        ("16:38: studies[2].alpha.linear.stop: got 'x'", "write a number such as 0.5"),
        ("16:46: studies[2].alpha.linear.num: got 1", "write a number in this range"),
        ("17:14: studies[2].outputs: got 'stable'", "write [stable]"),
    ],
    "map_2_gb": [("4:5: studies[0]: alpha x beta x delta x d = 12000 x 12000 x 1 x", "use fewer values on an")],
    "map_too_many_points": [("4:5: studies[0]: alpha x beta x delta x d = 1000 x 1000 x 151 x", "use fewer values")],
    "mass_list": [("4:9: scene.mass: got a list of 1 item", "write a number and a unit, as in '0.1 kg'")],
    "mass_missing": [("4:3: scene.mass: missing", "add 'mass: 0.1 kg'")],
    "mass_nan": [("4:9: scene.mass: got .nan", "write a finite number")],
    "mass_negative": [("4:9: scene.mass: got -0.1 kg", "write a number in this range")],
    "mass_quoted": [("4:9: scene.mass: got the text '0.1'", "drop the quotes (it is then in kg)")],
    "mass_unit": [("4:9: scene.mass: got '0.1 stone'", "write a number and a unit, as in '0.1 kg'")],
    "mass_unit_alone": [("4:9: scene.mass: got 'kg'", "write a number and a unit, as in '0.1 kg'")],
    "mass_unit_case": [("4:9: scene.mass: got '0.1 KG'", "did you mean 'kg'?")],
    "mass_zero": [("4:9: scene.mass: got 0 kg", "write a number in this range")],
    "merge_key": [("9:5: studies[1].<<: unknown key", "write the keys out")],
    "mixed_normalized_scene": [("6:3: scene.stiffness: physical key, after normalized ones", "remove it, or write")],
    "mixed_scene": [
        ("6:3: scene.delta: normalized key, after physical ones", "remove it, or write all keys"),
        ("7:3: scene.beta: normalized key, after physical ones", "remove it, or write all keys"),
    ],
    "modes_text": [("6:10: scene.modes: got '120 Hz'; it must be a list", "write '- ' before each entry")],
    "name_number": [("2:7: name: got 2006", "write a name, in quotes if it is all")],
    "name_slash": [("2:7: name: got '../bad'", "write 'bad'")],
    "not_a_mapping": [("1:1: got 'just a text'", "write 'key: value' lines, or {key: value}")],
    "not_utf8": [("3:17: got the byte 0xe9, which is not UTF-8", "save it as UTF-8")],
    "number_as_key": [("3:1: got the key 1", "write the name of a field")],
    "only_comments": [("1:1: the file is empty", "start with 'version: 1'")],
    "output_unknown": [("10:23: studies[0].outputs[1]: got 'spectral-radius'", "did you mean 'spectral_radius'?")],
    "outputs_empty": [("10:14: studies[0].outputs: got an empty list", "fill the list")],
    "period_and_rate": [("7:3: scene.rate: period and rate are both given", "remove one")],
    "period_missing": [("4:3: scene.period: missing", "add 'period: 1 ms' or 'rate: 1 kHz'")],
    "period_zero": [("5:11: scene.period: got 0 s", "write a number in this range")],
    "plane_needs_axis": [("7:12: studies[0].delta: got one value", "give delta as a list, linear or log axis")],
    "rate_unit": [("5:9: scene.rate: got '1 ms'", "write a number and a unit, as in '1 kHz'")],
    "recommend_normalized": [("5:5: studies[0].device: missing", "give the scene mass and period")],
    "recommend_without_scene": [("4:5: studies[0].device: missing", "give the scene mass and period")],
    "response_too_long": [("4:5: studies[0]: responses x periods x points a period = 1 x 10", "shorten the")],
    "ridge_path_in_other_plane": [("9:17: studies[0].ridge_path: got true with plane delta_beta", "remove")],
    "scene_empty": [
        ("4:3: scene.mass: missing", "add 'mass: 0.1 kg'"),
        ("4:3: scene.period: missing", "add 'period: 1 ms' or 'rate: 1 kHz'"),
    ],
    "scene_nothing": [("3:7: scene: got nothing", "add one or remove the key")],
    "scene_text": [("4:3: scene: got 'phantom'", "write 'key: value' lines")],
    "scene_without_value": [("4:8: scene.mass: got nothing", "add one or remove the key")],
    "studies_empty": [("3:10: studies: got an empty list", "fill the list")],
    "studies_mapping": [("4:3: studies: got a mapping of 2 keys", "write '- ' before each of them")],
    "studies_missing": [("1:1: studies: missing", "add 'studies: [{kind: recommend, name: wall")],
    "studies_nothing": [("3:9: studies: got nothing", "add one or remove the key")],
    "study_names_twice": [("9:11: studies[1].name: got 'r' twice, here and at [0]", "rename one")],
    "study_null": [("8:4: studies[1]: got nothing", "write '- kind: boundary' and its fields, or")],
    "study_text": [("4:5: studies[0]: got 'ridge'", "write '- kind: boundary' and its fields, or")],
    "substeps_zero": [("8:15: studies[0].substeps: got 0", "write a number in this range")],
    "tab": [("4:1: not valid YAML", "indent with spaces")],
    "tag": [
        ("6:12: studies[0].delta: got the tag 'tag:yaml.org,2002:float'", "remove the tag"),
        ("7:8: studies[0].d: got the tag '!python/name:os.system'", "remove the tag"),
    ],
    "too_many_values": [("3:99997: studies[49993]: too many values", "write long axes as linear or log")],
    "two_documents": [("8:1: a second document begins here", "remove the '---' or split the file")],
    "unclosed_bracket": [("7:6: not valid YAML", "close the bracket opened at line 6, column 12")],
    "unclosed_quote": [("5:1: not valid YAML", "check the quoted text that begins at line 3")],
    "blank_missing": [
        ("3:8: scene.mass: missing", "add 'mass: 0.1 kg'"),
        ("3:9: scene.mass:100 g: unknown key", "write 'mass: 100 g'"),
    ],
    "unknown_key": [("6:5: studies[0].detla: unknown key", "did you mean 'delta'?")],
    "unknown_top_key": [("8:1: studys: unknown key", "did you mean 'studies'?")],
    "utf16": [("1:1: got the byte 0xff, which is not UTF-8", "save it as UTF-8")],
    "version_2": [("1:10: version: got 2", "install a newer zwidth, or rewrite the file")],
    "version_missing": [("1:1: version: missing", "add 'version: 1'")],
    "version_text": [("1:10: version: got '1'", "drop the quotes")],
    "version_true": [("1:10: version: got true", "write 'version: 1'")],
    "wall_in_si_units": [("7:27: studies[0].walls[1]: got a wall in SI units", "write alpha and beta")],
    "wall_out_of_range": [("7:27: studies[0].walls[1]: got a wall that is out of range", "check the units")],
    "walls_for_devices": [("7:12: studies[0].walls: got 3 walls for 2 devices", "make the numbers equal")],
}


def load_invalid(path):
    with pytest.raises(ConfigFileError) as caught:
        load_config(path)
    return caught.value


@pytest.fixture
def write_invalid(tmp_path):
    """Return a function that writes one of the files."""

    def write(name):
        path = tmp_path / f"{name}.yaml"
        path.write_bytes(FILES[name])
        return path

    return write


def test_every_file_has_expected_errors():
    assert set(FILES) == set(FAULTS)


@pytest.mark.parametrize("name", FAULTS)
def test_errors_and_their_locations(write_invalid, name):
    path = write_invalid(name)
    error = load_invalid(path)
    lines = str(error).splitlines()
    assert len(lines) == len(error.faults) == len(FAULTS[name])
    for line, fault, (start, remedy) in zip(lines, error.faults, FAULTS[name], strict=True):
        assert line == str(fault)
        assert line.startswith(f"{path}:{start}")
        assert fault.remedy.startswith(remedy)


@pytest.mark.parametrize("name", FAULTS)
def test_dict_has_the_errors_of_the_file_without_locations(write_invalid, name):
    file = write_invalid(name)
    try:
        tree = _Tree(str(file), file.read_text(encoding="utf-8-sig"))
    except ValueError:
        pytest.skip("not valid YAML, hence no dict")
    if tree.faults or not isinstance(tree.data, dict):
        pytest.skip("an error of the text, which a dict cannot have")
    with pytest.raises(ConfigFileError) as caught:
        read_mapping(tree.data, Config)
    expected = {(fault.field, fault.problem, fault.allowed, fault.remedy) for fault in load_invalid(file).faults}
    assert {(fault.field, fault.problem, fault.allowed, fault.remedy) for fault in caught.value.faults} == expected
    assert not any(line.startswith(":") or str(file) in line for line in str(caught.value).split("\n"))


def test_dict_may_be_recursive_or_have_invalid_keys():
    recursive = {"version": 1, "name": "endless", 3: 4}
    recursive["studies"] = [recursive]
    with pytest.raises(ConfigFileError) as caught:
        read_mapping(recursive, Config)
    lines = str(caught.value).split("\n")
    assert "got the key 3; keys are text; write the name of a field" in lines
    assert any(line.endswith("the values are nested too deeply; at most 20 levels") for line in lines)


def test_missing_file():
    error = load_invalid("no/such/file.yaml")
    assert str(error) == "no/such/file.yaml: no such file; check the path"
    assert error.faults[0].line is None


def test_folder_instead_of_a_file(tmp_path):
    assert str(load_invalid(tmp_path)).startswith(f"{tmp_path}: got a folder; ")


def test_too_large_file(tmp_path):
    path = tmp_path / "large.yaml"
    path.write_text("#" * (2**20 + 1))
    assert "too large; at most 1048576 bytes" in str(load_invalid(path))


@pytest.mark.parametrize("path", ["a\0b", "x" * 5000, "", "line\nbreak.yaml", "esc\x1b[0m.yaml", "\udcff.yaml"])
def test_invalid_path(path):
    message = str(load_invalid(path))
    # The message is one printable line for any name.
    assert message.isprintable()


def test_device_file_instead_of_a_file():
    assert str(load_invalid("/dev/zero")).startswith("/dev/zero: got no regular file; ")


def test_error_is_picklable(write_invalid):
    error = load_invalid(write_invalid("many_faults"))
    copy = pickle.loads(pickle.dumps(error))
    assert str(copy) == str(error)
    assert copy.faults == error.faults


@pytest.mark.parametrize("value", ["9" * 10**6, "1" + " x" * 10**5, "N" + "*" * 10**6, "1 N" + " " * 10**6 + "x"])
@pytest.mark.parametrize("start", ["scene: {mass: '", "studies: [{kind: ridge, name: r, d: 0, delta: '"])
def test_long_values_are_rejected_in_linear_time(tmp_path, start, value):
    path = tmp_path / "long.yaml"
    path.write_text(f"{start}{value}'" + ("}" if "scene" in start else "}]"))
    # With quadratic run time this would not end.
    load_invalid(path)


def test_values_are_shown_in_one_printable_line(tmp_path):
    path = tmp_path / "shown.yaml"
    path.write_text('version: "\\e[31m\\n\\ud800"\nname: {}\n"k\\ny": 1\nstudies: []\n'.format("x" * 200))
    for line in str(load_invalid(path)).split("\n"):
        assert line.isprintable()
        assert len(line) < len(str(path)) + 250


@pytest.mark.parametrize(("word", "key"), [("inertia: 3 g cm^2", "mass"), ("friction: 1 mN m", "coulomb")])
def test_words_of_rotary_devices_and_commands_name_the_key(tmp_path, word, key):
    file = tmp_path / "knob.yaml"
    scene = f"{{mass: 35 g cm^2, rate: 1 kHz, {word}}}"
    file.write_text(f"version: 1\nname: knob\nscene: {scene}\nstudies: [{{kind: recommend, name: wall}}]\n", "utf-8")
    with pytest.raises(ConfigFileError, match=f"unknown key; .*; use '{key}'"):
        load_config(file)
