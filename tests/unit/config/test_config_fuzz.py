"""Fuzzing of configuration files: reading always ends quickly, with a configuration or a ConfigError."""

import json
import os
import random
import re
from pathlib import Path

import pytest
import yaml
from sweeping import run_main

from zwidth.config.fields import ConfigFileError, format_path
from zwidth.config.reader import MAX_DEPTH, MAX_NODES
from zwidth.studies.document import Config, load_config

CONFIGS = Path(__file__).parents[3] / "configs"
# For more seeds: ZWIDTH_MUTATIONS=5000 python -m pytest tests/unit/config/test_config_fuzz.py
SEEDS = range(int(os.environ.get("ZWIDTH_MUTATIONS", "150")))

# YAML syntax that changes the interpretation of the rest, and values at the limits of the fields.
SCRAPS = [
    *"[]{}:,-?&*!|>'\"%@`#\t\n\r\0\\",
    *("- ", ": ", "\n---\n", "\n...\n", "&a ", "*a", "<<: ", "!!float ", "!<", "%YAML 1.", "? ", "|\n", ">-9\n"),
    *("null", "~", "true", ".nan", "-.inf", "1e999", "-1", "0x", "9" * 400, "1e-999", '"\\ud800"', '"\\U00110000"'),
    *("1 periods", "1 kN/m", "kind: map", "kind: paper_fig6", "{linear: {start: 0, stop: 1, num: 99999}}"),
]


def mutate(data, rng):
    """Return the file with one to eight random edits."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        start = rng.randrange(len(data) + 1)
        stop = min(len(data), start + rng.choice([0, 1, 2, 8, 40]))
        match rng.randrange(6):
            case 0:
                data[start:stop] = b""
            case 1:
                data[start:stop] = bytes(rng.randrange(256) for _ in range(rng.randint(1, 4)))
            case 2:
                data[start:stop] = rng.choice(SCRAPS).encode("utf-8", "surrogatepass")
            case 3:
                data[start:start] = data[start : start + rng.choice([1, 10, 200, 2000])] * rng.randint(1, 3)
            case 4:
                data[start:start] = rng.choice(SCRAPS).encode() * rng.choice([2, 50, 1000])
            case _:
                lines = data.split(b"\n")
                rng.shuffle(lines)
                data[:] = b"\n".join(lines)
    return bytes(data)


def list_fields(data, loader=yaml.SafeLoader):
    """Return every field of a document by its path as PyYAML reads it ("" for the root), or None if it is not
    valid YAML.
    """
    try:
        root = yaml.compose(data.decode("utf-8-sig"), Loader=loader)
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError):
        return None
    fields = {}

    def walk(node, path):
        # Stop at twice the depth and number that a readable file may have.
        if len(path) > 2 * MAX_DEPTH or len(fields) > 2 * MAX_NODES:
            return
        fields[format_path(path)] = node
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                # The first of duplicate keys counts.
                if isinstance(key, yaml.ScalarNode) and format_path((*path, key.value)) not in fields:
                    walk(value, (*path, key.value))
        elif isinstance(node, yaml.SequenceNode):
            for index, value in enumerate(node.value):
                walk(value, (*path, index))

    walk(root, ())
    return fields


def check_fault(fault, fields):
    """Check that a fault has a location and names a field of the document, a field missing in it, or an invalid key."""
    assert fault.line >= 1, fault
    assert fault.column >= 1, fault
    start, _, text = str(fault).partition(f"{fault.file}:{fault.line}:{fault.column}: ")
    assert start == ""
    if fields is None:
        return
    assert text.startswith(f"{fault.field}: ") or not fault.field
    if fault.problem.startswith("got the key ") or fault.problem == "got a complex key":
        # A key that is not text is quoted itself, together with the field that contains it.
        assert isinstance(fields[fault.field], yaml.MappingNode), fault
    elif fault.field:
        if fault.problem == "missing":
            parent, _, name = fault.field.rpartition(".")
            assert name in text
            assert fault.field not in fields
            assert isinstance(fields[parent], yaml.MappingNode), fault
        else:
            # Values that a study takes from the scene may be invalid there.
            supplied = f"scene.{fault.field.rpartition('.')[2]}"
            # An omitted operator mass is zero, which is invalid with a coupling spring.
            left_out = fault.field.endswith(".operator.mass") and fault.field.rpartition(".")[0] in fields
            assert fault.field in fields or (supplied in fields and supplied in fault.problem) or left_out, fault
    else:
        # Only a document that is not a mapping has no fields; the message then lists the required ones.
        assert not isinstance(fields[""], yaml.MappingNode), fault
        assert "'version'" in text or "version, name and studies" in text, fault


def try_load(path):
    """Return the configuration and no faults, or None and the faults; let any other exception fail the test."""
    try:
        return load_config(path), ()
    except ConfigFileError as error:
        return None, error.faults


# Values that are invalid almost everywhere, and the limits of float64.
ODD_VALUES = [
    *(None, True, 0, -1, 1e308, -1e308, 5e-324, 10**400, "", "x", "1", [], {}, [1, 1], [None], [[1]], {"kind": "map"}),
    *("1e308 N/m", "1e300 kg", "1e-300 kg", "1e308 s", "1e-300 s", "1 periods", "1e308 periods", "fractional_power"),
    *({"linear": None}, {"log": {"start": 5e-324, "stop": 1e308, "num": 9}}, {"alpha": 1e308, "beta": -1e308}),
    *({"linear": {"start": -1e308, "stop": 1e308, "num": 5}}, {"mass": 1e-300, "damping": 1e300, "period": 1e9}),
]


def list_paths(tree, path=()):
    """Yield the path to every value of a tree except the root."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        yield (*path, key)
        yield from list_paths(value, (*path, key))


def list_distinct_paths(tree):
    """Return one path per key name, because a name is read by the same field everywhere, as are all items of a list."""
    return {tuple(key if isinstance(key, str) else "" for key in path): path for path in list_paths(tree)}.values()


def replace_value(tree, path, value):
    """Return a copy of a tree with one value replaced."""
    if not path:
        return value
    copy = tree.copy()
    copy[path[0]] = replace_value(tree[path[0]], path[1:], value)
    return copy


@pytest.mark.parametrize("value", ODD_VALUES, ids=range(len(ODD_VALUES)))
def test_any_value_anywhere_yields_a_config_or_a_complete_error(value, tmp_path):
    tree = yaml.safe_load((CONFIGS / "phantom.yaml").read_text(encoding="utf-8"))
    path = tmp_path / "odd.yaml"
    for path_in_tree in list_distinct_paths(tree):
        # JSON is valid YAML 1.2.
        path.write_text(json.dumps(replace_value(tree, path_in_tree, value)), encoding="utf-8")
        config, faults = try_load(path)
        assert all(fault.problem and fault.allowed and fault.remedy for fault in faults)
        # Use the C parser if available; for JSON both agree.
        fields = list_fields(path.read_bytes(), getattr(yaml, "CSafeLoader", yaml.SafeLoader)) if faults else {}
        for fault in faults:
            check_fault(fault, fields)
        if config is not None:
            dump = config.model_dump(mode="json", exclude_none=True)
            assert Config.model_validate(dump).model_dump(mode="json", exclude_none=True) == dump


def flip_bits(data, rng):
    """Return the file with up to four bits flipped."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def rearrange(data, rng):
    """Return the tree as JSON, with keys exchanged or values moved, rescaled or replaced."""
    tree = yaml.safe_load(data)
    for _ in range(rng.randint(1, 3)):
        options = list(list_paths(tree))
        path = rng.choice(options)
        match rng.randrange(4):
            case 0:
                tree = replace_value(tree, path, rng.choice(ODD_VALUES))
            case 1:
                tree = replace_value(tree, path, get_value(tree, rng.choice(options)))
            case 2:
                tree = replace_value(tree, path, rescale(get_value(tree, path), rng))
            case _:
                tree = swap_keys(tree, rng)
    return json.dumps(tree).encode()


def get_value(tree, path):
    for key in path:
        tree = tree[key]
    return tree


def rescale(value, rng):
    """Return a number multiplied by an extreme factor, with its unit if it has one."""
    factor = rng.choice([-1, 0, 1e-12, 1e-3, 1e3, 1e12, 1e300])
    if isinstance(value, int | float):
        return value * factor
    arguments = str(value).split()
    try:
        return " ".join([repr(float(arguments[0]) * factor), *arguments[1:]])
    except (IndexError, ValueError):
        return f"{value}{value}"


def swap_keys(tree, rng):
    """Return a copy in which two key names are exchanged throughout."""
    keys = sorted({path[-1] for path in list_paths(tree) if isinstance(path[-1], str)})
    first, second = rng.choice(keys), rng.choice(keys)
    names = {first: second, second: first}

    def copy_part(part):
        if isinstance(part, dict):
            return {names.get(key, key): copy_part(value) for key, value in part.items()}
        return [copy_part(item) for item in part] if isinstance(part, list) else part

    return copy_part(tree)


# For more seeds: ZWIDTH_MUTATIONS=5000 python -m pytest tests/unit/config/test_config_fuzz.py -k plan
@pytest.mark.parametrize("seed", SEEDS)
def test_any_mutation_yields_a_plan_or_exit_code_2(seed, tmp_path, capsys):
    rng = random.Random(f"plan {seed}")
    shipped = rng.choice(sorted(CONFIGS.glob("*.yaml")))
    path = tmp_path / "fuzzed.yaml"
    path.write_bytes(rng.choice([flip_bits, rearrange, mutate])(shipped.read_bytes(), rng))
    for table in CONFIGS.glob("*.csv"):
        (tmp_path / table.name).write_bytes(table.read_bytes())
    code = run_main("run", "--dry-run", path, "--out", tmp_path / "out")
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert code == (2 if lines else 0)
    assert out or lines
    config, faults = try_load(path)
    fields = list_fields(path.read_bytes()) if faults else {}
    for fault in faults:
        check_fault(fault, fields)
    if config is not None:
        # A valid configuration may still exceed the resources of the machine.
        largest = "|".join(re.escape(study.name) for study in config.studies)
        resource_message = rf"Error: (out: .* of studies\[({largest})\]\.axes \(|workers: )"
        assert all(re.match(resource_message, line) for line in lines), lines
    else:
        assert lines == [f"Error: {fault}" for fault in faults]
    for line in lines:
        assert "; " in line, line
        message = line.removeprefix("Error: ")
        assert not any(word in message for word in ("Error", "Traceback", "Exception")), line
        assert line.isprintable()
    assert not (tmp_path / "out").exists()
