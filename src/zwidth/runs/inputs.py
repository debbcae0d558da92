"""The files that a configuration reads: a run keeps copies of them, and its configuration names the copies."""

from __future__ import annotations

import re
from pathlib import Path, PurePath
from typing import Any

from zwidth.config.reader import find_values
from zwidth.runs.record import INPUTS

_KEY = "csv"


def gather_inputs(text: str, folder: Path) -> tuple[str, dict[str, bytes], dict[str, str]]:
    """What a run keeps so that it can be repeated from its own folder.

    Args:
        text: of a configuration without faults.
        folder: where the files are that it names.

    Returns:
        The text with the names of the copies; the copies' bytes by their names in the folder of inputs; and, by the
        names that the configuration has, those that the text has now. A copy's own name stays as it is.
    """
    files: dict[str, bytes] = {}
    names: dict[str, str] = {}
    places = sorted(find_values(text, _KEY), key=lambda place: place[1])
    for name, _, _ in places:
        if name not in names and (folder / name).is_file():
            copy = _choose_name(name, files)
            files[copy] = (folder / name).read_bytes()
            names[name] = f"{INPUTS}/{copy}"
    for name, first, last in reversed(places):
        if name in names:
            text = f"{text[:first]}{names[name]}{text[last:]}"
    return text, files, names


def _choose_name(name: str, taken: dict[str, bytes]) -> str:
    """A name that any file system and YAML take as it is; files of one name in different folders are told apart."""
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", PurePath(name).name)
    stem, suffix = PurePath(plain).stem, PurePath(plain).suffix
    number = 1
    # Some file systems do not tell cases apart.
    while plain.lower() in {each.lower() for each in taken}:
        number += 1
        plain = f"{stem}-{number}{suffix}"
    return plain


def rename_inputs(value: Any, names: dict[str, str]) -> Any:
    """A configuration's JSON with the names of the copies."""
    if isinstance(value, list):
        return [rename_inputs(item, names) for item in value]
    if not isinstance(value, dict):
        return value
    return {
        key: names.get(item, item) if key == _KEY and isinstance(item, str) else rename_inputs(item, names)
        for key, item in value.items()
    }
