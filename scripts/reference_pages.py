#!/usr/bin/env python3
"""Generate the tables of pages: commands, configuration files, outputs of sweeps, units and status codes.

    scripts/reference_pages.py NAME      prints one of them

`scripts/refresh_docs.py` writes them between ``<!-- include: NAME -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import click
import yaml

from zwidth.cli import cli
from zwidth.cli.help import GROUPS, OWN, find_group
from zwidth.core.status import Status
from zwidth.units.outputs import OUTPUTS
from zwidth.units.parsing import COUNTS, DIMENSIONS, PERIOD_WORDS

ROOT = Path(__file__).resolve().parents[1]
MOST_NAMES = 8  # allowed values that a table lists; the description of the key names a longer set
SECTION = "Section"  # suffix of the models of scene components


def list_commands() -> str:
    """Return one section per command, then the tables of the options that several commands share."""
    context = click.Context(cli, info_name="zwidth", **cli.context_settings)
    shared: dict[str, dict[str, str]] = {name: {} for name in GROUPS if name != OWN}
    parts = [_describe_command(cli.commands[name], context, shared) for name in sorted(cli.commands)]
    parts.append("## Shared options")
    for name, rows in shared.items():
        parts += [f"### {name}", "\n".join(["| option | meaning |", "|---|---|", *rows.values()])]
    return "\n\n".join(parts)


def _describe_command(command: click.Command, parent: click.Context, shared: dict[str, dict[str, str]]) -> str:
    """Return the section of a command; add its options of shared groups to ``shared``."""
    context = click.Context(command, info_name=command.name, parent=parent)
    usage = " ".join(["zwidth", str(command.name), *command.collect_usage_pieces(context)])
    paragraphs = [_join_lines(part) for part in (command.help or "").replace("\f", "").split("\n\n")]
    parts = [f"## zwidth {command.name}", f"```text\n{usage}\n```", *filter(None, paragraphs)]
    own, others = [], {}
    for option in command.get_params(context):
        record = option.get_help_record(context) if isinstance(option, click.Option) else None
        if record is None:
            continue
        flag = option.opts[-1]
        row = f"| `{record[0]}` | {_escape(record[1])} |"
        if (group := find_group(flag, getattr(command, "own", ()))) == OWN:
            own.append(row)
        else:
            shared[group].setdefault(flag, row)
            others.setdefault(group, []).append(f"`{flag}`")
    if own:
        parts.append("\n".join(["| option | meaning |", "|---|---|", *own]))
    ordered = [name for name in GROUPS if name in others]
    parts.append("\n".join(f"- [{name}](#{_anchor(name)}): {', '.join(others[name])}" for name in ordered))
    example = (command.epilog or "").replace("\b\nExample:\n", "").strip("\n").strip()
    return "\n\n".join([*parts, *([f"```text\n{example}\n```"] if example else [])])


def _anchor(heading: str) -> str:
    return heading.lower().replace(",", "").replace(" ", "-")


def list_configuration() -> str:
    """Return the tables of all keys of configuration files, generated from the schema, with one example per kind."""
    schema = json.loads((ROOT / "src" / "zwidth" / "config" / "schema.json").read_text(encoding="utf-8"))
    models, kinds = schema["$defs"], schema["properties"]["studies"]["items"]["discriminator"]["mapping"]
    examples = _find_examples()
    studies = {kind: reference.rpartition("/")[2] for kind, reference in sorted(kinds.items())}
    parts = ["## File", _describe_keys(schema, models), "## scene", "A scene is physical or normalized."]
    components = [name for name in sorted(models) if name.endswith(SECTION)]
    for name in ("PhysicalScene", "NormalizedScene", *components):
        parts += _describe_model(name, models)
    for kind, name in studies.items():
        model = models[name]
        description = re.sub("^The ", "the ", _join_lines(model["description"]))
        parts += [f"## kind: {kind}", f"This study computes {description}", _describe_keys(model, models)]
        if kind in examples:
            file, study = examples[kind]
            text = yaml.safe_dump([study], sort_keys=False, allow_unicode=True, width=100).strip()
            parts.append(f"Example, from `configs/{file}`:\n\n```yaml\nstudies:\n{_indent(text)}\n```")
    covered = {"PhysicalScene", "NormalizedScene", *components, *studies.values()}
    parts.append("## Mappings within studies")
    for name in sorted(models):
        if name not in covered and "properties" in models[name]:
            parts += _describe_model(name, models)
    return "\n\n".join(part for part in parts if part)


def _describe_model(name: str, models: dict[str, Any]) -> list[str]:
    description = _join_lines(models[name].get("description", ""))
    return [f"### {_title(name)}", description, _describe_keys(models[name], models)]


def _find_examples() -> dict[str, tuple[str, dict[str, Any]]]:
    """Return the shortest study of each kind in configs/, with the name of its file."""
    found: dict[str, tuple[str, dict[str, Any]]] = {}
    for path in sorted((ROOT / "configs").glob("*.yaml")):
        for study in yaml.safe_load(path.read_text(encoding="utf-8"))["studies"]:
            best = found.get(study["kind"])
            if best is None or len(str(study)) < len(str(best[1])):
                found[study["kind"]] = path.name, study
    return found


def _describe_keys(model: dict[str, Any], models: dict[str, Any]) -> str:
    required = model.get("required", ())
    lines = ["| key | value | default | meaning |", "|---|---|---|---|"]
    properties = dict(model.get("properties", {}))
    scene = models["PhysicalScene"]["properties"]
    if model is not models["PhysicalScene"] and {"mass", "period", "velocity"} <= set(properties):
        shared = [key for key in properties if key in scene and key != "stiffness"]
        lines.append(f"| {', '.join(f'`{key}`' for key in shared)} | | | As in [physical-scene](#physical-scene). |")
        properties = {key: value for key, value in properties.items() if key not in shared}
    for key, value in properties.items():
        if value.get("items", {}).get("discriminator"):
            value = {"type": "array", "description": value["description"] + " One section below per kind."}
        if key in required:
            default = "required"
        elif value.get("default") is None:
            default = ""
        else:
            default = f"`{_short(value['default'])}`"
        lines.append(
            f"| `{key}` | {_describe_value(value, models)} | {default} | {_escape(value.get('description', ''))} |"
        )
    return "\n".join(lines)


def _describe_list(entry: str) -> str:
    """Return the description of a list from that of its entries; plain numbers and their lists in the plural."""
    if entry == "number":
        return "list of numbers"
    return f"list of lists{entry[4:]}" if entry.startswith("list of ") else f"list: {entry}"


def _describe_value(value: dict[str, Any], models: dict[str, Any]) -> str:
    """Return the values that a key allows, in words."""
    if "$ref" in value:
        name = value["$ref"].rpartition("/")[2]
        model = models[name]
        if "properties" in model:
            return f"[{_title(name)}](#{_title(name)})"
        if name.startswith("axis"):
            return f"axis: {_describe_value(model['anyOf'][0], models)}"
        unit = re.match("A number in ([^,]+)", model.get("description", ""))
        return f"number in {unit[1]}" if unit else _describe_value(model, models)
    if "const" in value:
        return f"`{value['const']}`"
    if "enum" in value:
        if len(value["enum"]) > MOST_NAMES:
            return "a name"
        return "one of " + ", ".join(f"`{each}`" for each in value["enum"])
    for several in ("anyOf", "oneOf"):
        if several in value:
            texts = [_describe_value(each, models) for each in value[several]]
            return ", or ".join(dict.fromkeys(text for text in texts if text != "null"))
    types = value.get("type", "")
    kind = str(next(each for each in types if each != "null") if isinstance(types, list) else types)
    if kind == "array":
        return _describe_list(_describe_value(value["items"], models)) if value.get("items") else "list"
    limits = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}
    ends = [f"{word} {value[name]:g}" for name, word in limits.items() if name in value]
    return ", ".join([{"string": "text", "boolean": "true or false", "object": "mapping"}.get(kind, kind), *ends])


def list_outputs() -> str:
    """Return a table of the outputs of sweeps: names, units, meanings, and whether devices with parts have them."""
    lines = ["| output | one value per | unit | for devices with parts | meaning |", "|---|---|---|---|---|"]
    for output in OUTPUTS.values():
        unit = "true or false" if output.dtype == "bool" else "code" if output.dtype == "uint8" else output.units
        unit = unit.replace("1/period", "1 per period") if unit != "1" else ""
        if output.physical_units:
            unit += f"; in SI quantities {output.physical_units}"
        parts = "yes" if output.with_parts else "no"
        only = "; only in SI quantities" if output.physical_only else ""
        lines.append(f"| `{output.name}` | {output.family} | {unit} | {parts} | {_escape(output.long_name)}{only} |")
    return "\n".join(lines)


def list_units() -> str:
    """Return a table of the dimensions with their usual units and an example of each."""
    lines = ["| dimension | usual units | example |", "|---|---|---|"]
    for dimension in DIMENSIONS.values():
        if dimension.names:
            units = ", ".join(f"`{unit}`" for unit in dimension.units)
            lines.append(f"| {dimension.base} | {units} | `{dimension.example}` |")
    words = ", ".join(f"`{word}`" for word in PERIOD_WORDS), ", ".join(f"`{word}`" for word in COUNTS)
    text = f"Delays can also be given in {words[0]}. Encoder positions can also be given in {words[1]}."
    return "\n".join([*lines, "", text])


def list_statuses() -> str:
    """Return a table of the status codes with their messages."""
    lines = ["| code | name | message |", "|--:|---|---|"]
    return "\n".join([*lines, *(f"| {code.value} | `{code.name}` | {_escape(code.message)} |" for code in Status)])


def _title(name: str) -> str:
    """Return the heading of a model."""
    words = "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in name.removesuffix(SECTION))
    return words.strip().replace(" ", "-").replace("f-o-a-w", "foaw")


def _short(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else json.dumps(value)


def _escape(text: str) -> str:
    return _join_lines(text).replace("|", "\\|").replace("[", "\\[")


def _join_lines(text: str) -> str:
    return " ".join(text.split())


def _indent(text: str) -> str:
    return "\n".join(f"  {line}" for line in text.splitlines())


TABLES = {
    "commands": list_commands,
    "configuration": list_configuration,
    "outputs": list_outputs,
    "units": list_units,
    "statuses": list_statuses,
}

if __name__ == "__main__":
    print(TABLES[sys.argv[1]]())
