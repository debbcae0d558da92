"""Whatever the values, reading ends soon, with a configuration or with a ConfigError."""

import json
import os
import random
import re
from pathlib import Path

import pytest
import yaml
from sweeping import main_of

from zwidth.config.fields import ConfigFileError, format_path
from zwidth.config.reader import MAX_DEPTH, MAX_NODES
from zwidth.studies.document import Config, load_config

CONFIGS = Path(__file__).parents[3] / "configs"
# More of them: ZWIDTH_MUTATIONS=5000 python -m pytest tests/unit/config/test_config_fuzz.py
SEEDS = range(int(os.environ.get("ZWIDTH_MUTATIONS", "150")))

# Bits of YAML that change how the rest is read, and values at the edge of what the fields allow.
SCRAPS = [
    *"[]{}:,-?&*!|>'\"%@`#\t\n\r\0\\",
    *("- ", ": ", "\n---\n", "\n...\n", "&a ", "*a", "<<: ", "!!float ", "!<", "%YAML 1.", "? ", "|\n", ">-9\n"),
    *("null", "~", "true", ".nan", "-.inf", "1e999", "-1", "0x", "9" * 400, "1e-999", '"\\ud800"', '"\\U00110000"'),
    *("1 periods", "1 kN/m", "kind: map", "kind: paper_fig6", "{linear: {start: 0, stop: 1, num: 99999}}"),
]


def mutated(data, rng):
    """The file with one to eight changes."""
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


def fields_of(data, loader=yaml.SafeLoader):
    """Every field of a document by its path, as PyYAML reads it, "" for the whole; None where that is no YAML."""
    try:
        root = yaml.compose(data.decode("utf-8-sig"), Loader=loader)
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError):
        return None
    found = {}

    def walk(node, path):
        # Deeper, or more, than any file that is read may have.
        if len(path) > 2 * MAX_DEPTH or len(found) > 2 * MAX_NODES:
            return
        found[format_path(path)] = node
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                # Of a key that comes twice the first counts.
                if isinstance(key, yaml.ScalarNode) and format_path((*path, key.value)) not in found:
                    walk(value, (*path, key.value))
        elif isinstance(node, yaml.SequenceNode):
            for index, value in enumerate(node.value):
                walk(value, (*path, index))

    walk(root, ())
    return found


def check_named(fault, fields):
    """A fault has a place, and names a field of the document, one that is missing in such a field, or a bad key."""
    assert fault.line >= 1, fault
    assert fault.column >= 1, fault
    start, _, text = str(fault).partition(f"{fault.file}:{fault.line}:{fault.column}: ")
    assert start == ""
    if fields is None:
        return
    assert text.startswith(f"{fault.field}: ") or not fault.field
    if fault.problem.startswith("got the key ") or fault.problem == "got a complex key":
        # What is no text names no field; it is told itself, with the field that holds it.
        assert isinstance(fields[fault.field], yaml.MappingNode), fault
    elif fault.field:
        if fault.problem == "missing":
            above, _, name = fault.field.rpartition(".")
            assert name in text
            assert fault.field not in fields
            assert isinstance(fields[above], yaml.MappingNode), fault
        else:
            # What a study has from the scene is wrong there.
            supplied = f"scene.{fault.field.rpartition('.')[2]}"
            # A hand without a mass has none, which is refused behind a spring.
            left_out = fault.field.endswith(".operator.mass") and fault.field.rpartition(".")[0] in fields
            assert fault.field in fields or (supplied in fields and supplied in fault.problem) or left_out, fault
    else:
        # Only what is no mapping has no fields; then those that it needs are named.
        assert not isinstance(fields[""], yaml.MappingNode), fault
        assert "'version'" in text or "version, name and studies" in text, fault


def outcome(path):
    """The configuration and no faults, or none and its faults; any other exception is the test's failure."""
    try:
        return load_config(path), ()
    except ConfigFileError as error:
        return None, error.faults


# Values that are wrong almost everywhere, and the ends of float64.
ODD_VALUES = [
    *(None, True, 0, -1, 1e308, -1e308, 5e-324, 10**400, "", "x", "1", [], {}, [1, 1], [None], [[1]], {"kind": "map"}),
    *("1e308 N/m", "1e300 kg", "1e-300 kg", "1e308 s", "1e-300 s", "1 periods", "1e308 periods", "fractional_power"),
    *({"linear": None}, {"log": {"start": 5e-324, "stop": 1e308, "num": 9}}, {"alpha": 1e308, "beta": -1e308}),
    *({"linear": {"start": -1e308, "stop": 1e308, "num": 5}}, {"mass": 1e-300, "damping": 1e300, "period": 1e9}),
]


def places(tree, path=()):
    """The path to every value of a tree but the root."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        yield (*path, key)
        yield from places(value, (*path, key))


def unlike_places(tree):
    """The path to one value of each name: a name is read by the same field in every study, and so are all of a list."""
    return {tuple(key if isinstance(key, str) else "" for key in path): path for path in places(tree)}.values()


def with_value(tree, path, value):
    """A copy of a tree with one value replaced."""
    if not path:
        return value
    copy = tree.copy()
    copy[path[0]] = with_value(tree[path[0]], path[1:], value)
    return copy


@pytest.mark.parametrize("value", ODD_VALUES, ids=range(len(ODD_VALUES)))
def test_any_value_anywhere_ends_in_a_config_or_a_clear_error(value, tmp_path):
    tree = yaml.safe_load((CONFIGS / "phantom.yaml").read_text(encoding="utf-8"))
    path = tmp_path / "odd.yaml"
    for place in unlike_places(tree):
        # JSON is YAML 1.2.
        path.write_text(json.dumps(with_value(tree, place, value)), encoding="utf-8")
        config, faults = outcome(path)
        assert all(fault.problem and fault.allowed and fault.remedy for fault in faults)
        # In C, where PyYAML has that: of JSON it makes the same.
        fields = fields_of(path.read_bytes(), getattr(yaml, "CSafeLoader", yaml.SafeLoader)) if faults else {}
        for fault in faults:
            check_named(fault, fields)
        if config is not None:
            dump = config.model_dump(mode="json", exclude_none=True)
            assert Config.model_validate(dump).model_dump(mode="json", exclude_none=True) == dump


def flipped(data, rng):
    """The file with some bits of some bytes flipped."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def rearranged(data, rng):
    """The tree with keys exchanged, values taken from elsewhere, out of range, or of another kind; as JSON."""
    tree = yaml.safe_load(data)
    for _ in range(rng.randint(1, 3)):
        options = list(places(tree))
        place = rng.choice(options)
        match rng.randrange(4):
            case 0:
                tree = with_value(tree, place, rng.choice(ODD_VALUES))
            case 1:
                tree = with_value(tree, place, value_at(tree, rng.choice(options)))
            case 2:
                tree = with_value(tree, place, scaled(value_at(tree, place), rng))
            case _:
                tree = with_keys_swapped(tree, rng)
    return json.dumps(tree).encode()


def value_at(tree, path):
    for key in path:
        tree = tree[key]
    return tree


def scaled(value, rng):
    """A number far from what it was, with its unit where it has one."""
    factor = rng.choice([-1, 0, 1e-12, 1e-3, 1e3, 1e12, 1e300])
    if isinstance(value, int | float):
        return value * factor
    words = str(value).split()
    try:
        return " ".join([repr(float(words[0]) * factor), *words[1:]])
    except (IndexError, ValueError):
        return f"{value}{value}"


def with_keys_swapped(tree, rng):
    """A copy in which two keys of the whole tree are exchanged wherever they stand."""
    keys = sorted({place[-1] for place in places(tree) if isinstance(place[-1], str)})
    one, other = rng.choice(keys), rng.choice(keys)
    names = {one: other, other: one}

    def copy(part):
        if isinstance(part, dict):
            return {names.get(key, key): copy(value) for key, value in part.items()}
        return [copy(item) for item in part] if isinstance(part, list) else part

    return copy(tree)


# More of them: ZWIDTH_MUTATIONS=5000 python -m pytest tests/unit/config/test_config_fuzz.py -k plan
@pytest.mark.parametrize("seed", SEEDS)
def test_any_mutation_ends_in_a_plan_or_in_exit_code_2(seed, tmp_path, capsys):
    rng = random.Random(f"plan {seed}")
    shipped = rng.choice(sorted(CONFIGS.glob("*.yaml")))
    path = tmp_path / "fuzzed.yaml"
    path.write_bytes(rng.choice([flipped, rearranged, mutated])(shipped.read_bytes(), rng))
    for table in CONFIGS.glob("*.csv"):
        (tmp_path / table.name).write_bytes(table.read_bytes())
    code = main_of("run", "--dry-run", path, "--out", tmp_path / "out")
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert code == (2 if lines else 0)
    assert out or lines
    config, faults = outcome(path)
    fields = fields_of(path.read_bytes()) if faults else {}
    for fault in faults:
        check_named(fault, fields)
    if config is not None:
        # What is wrong with no field may still be too large for the machine.
        largest = "|".join(re.escape(study.name) for study in config.studies)
        named = rf"Error: (out: .* of studies\[({largest})\]\.axes \(|workers: )"
        assert all(re.match(named, line) for line in lines), lines
    else:
        assert lines == [f"Error: {fault}" for fault in faults]
    for line in lines:
        assert "; " in line, line
        told = line.removeprefix("Error: ")
        assert not any(word in told for word in ("Error", "Traceback", "Exception")), line
        assert line.isprintable()
    assert not (tmp_path / "out").exists()
