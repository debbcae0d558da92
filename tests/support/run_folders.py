"""Configurations of small runs, and readers of a run's folder."""

import json

SMALL = """
version: 1
name: small
studies:
  - {kind: map, name: one, alpha: [0.1, 0.2], beta: [0.1, 0.4], delta: 0.1, d: 0}
  - {kind: map, name: two, alpha: 0.1, beta: [0.1, 0.4], delta: 0.1, d: 0}
"""

# With a sweep, because every kind of study must behave equally.
SMALL_WITH_SWEEP = (
    SMALL
    + """
  - {kind: sweep, name: swept, axes: {alpha: [0.1, 0.9], beta: [0.1, 0.4], delta: 0.1, d: [0, 1]}}
"""
)


def read_record(folder):
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def read_states(folder):
    return {entry["name"]: entry["state"] for entry in read_record(folder)["studies"]}


def list_contents(folder):
    """Return every file of a run with its inode and modification time, which change if it is rewritten."""
    files = [path for path in folder.rglob("*") if path.is_file() and ".locks" not in path.parts]
    return {path.relative_to(folder).as_posix(): (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}
