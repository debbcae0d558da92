"""Configurations of small runs, and what the folder of a run holds."""

import json

SMALL = """
version: 1
name: small
studies:
  - {kind: map, name: one, alpha: [0.1, 0.2], beta: [0.1, 0.4], delta: 0.1, d: 0}
  - {kind: map, name: two, alpha: 0.1, beta: [0.1, 0.4], delta: 0.1, d: 0}
"""

# A sweep as well: what holds for one kind of study holds for every other.
BOTH = (
    SMALL
    + """
  - {kind: sweep, name: swept, axes: {alpha: [0.1, 0.9], beta: [0.1, 0.4], delta: 0.1, d: [0, 1]}}
"""
)


def record_of(folder):
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def states(folder):
    return {entry["name"]: entry["state"] for entry in record_of(folder)["studies"]}


def contents(folder):
    """Every file of a run, with what would change if it were written again."""
    files = [path for path in folder.rglob("*") if path.is_file() and ".locks" not in path.parts]
    return {path.relative_to(folder).as_posix(): (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}
