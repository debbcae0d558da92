#!/usr/bin/env python3
"""Kill runs at random moments, resume them, and compare their results with those of an undisturbed run, bit for bit.

    PYTHONPATH=src .venv/bin/python scripts/kill_and_resume.py --kills 50 --json

Two kinds of processes are killed with SIGKILL, ``--kills`` times each, every time in a new run:

- the parent, alternately without workers and with two workers: the run is then resumed and must complete;
- one of two workers while it computes: the run itself must replace it and complete.

Afterwards all values, coordinates and status arrays must equal those of the undisturbed run, all checksums must be
correct, and no file of a chunk that was marked as done before the kill may have been rewritten. Exit code 1 on failure.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.sweep.dataset import open_dataset, verify
from zwidth.sweep.store import Store

# Two families of functions, real and boolean outputs; about 2 s of work in some thirty chunks.
CONFIG = """\
version: 1
name: killed
studies:
  - kind: sweep
    name: map
    axes:
      alpha: {linear: {start: 0, stop: 1, num: 1000}}
      beta: {linear: {start: -0.2, stop: 1, num: 1000}}
      delta: {linear: {start: 0, stop: 2, num: 20}}
      d: [1, 2]
    outputs: [stable]
  - kind: sweep
    name: radius
    axes:
      alpha: {linear: {start: 0, stop: 1, num: 60}}
      beta: {linear: {start: -0.2, stop: 1, num: 60}}
      delta: {linear: {start: 0, stop: 2, num: 50}}
      d: 1
    outputs: [spectral_radius, stable]
  - kind: sweep
    name: ridge
    axes:
      delta: {log: {start: 1e-3, stop: 10, num: 1000}}
      d: {linear: {start: 0, stop: 9.5, num: 96}}
    outputs: [alpha_max, beta_at_max, kind]
"""
LONGEST = 600.0


class Trial:
    """Runs of one configuration.

    Args:
        folder: parent of the run folders.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config = folder / "killed.yaml"
        self.config.write_text(CONFIG, encoding="utf-8")
        self.outcomes: Counter[str] = Counter()
        started = time.monotonic()
        process = self.start(folder / "undisturbed")
        wait_for(lambda: chunks_done(folder / "undisturbed") or process.poll() is not None)
        self.beginning = time.monotonic() - started
        self.finish(process)
        self.seconds = time.monotonic() - started
        self.reference = contents(folder / "undisturbed")
        self.chunks = len(marked_files(folder / "undisturbed"))

    def start(self, out: Path, *options: str) -> subprocess.Popen[str]:
        """Start a run in a new process group."""
        return subprocess.Popen(
            [sys.executable, "-m", "zwidth", "run", str(self.config), "--out", str(out), *options],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def finish(self, process: subprocess.Popen[str]) -> None:
        """Wait for the end of a run that must succeed."""
        errors = process.communicate(timeout=LONGEST)[1]
        if process.returncode:
            raise SystemExit(f"a run that was to complete ended with exit code {process.returncode}:\n{errors}")

    def wait_for_the_moment(self, process: subprocess.Popen[str], out: Path, moments: random.Random) -> None:
        """Wait until a random moment; two thirds of the moments lie between the first chunk and the end."""
        if moments.random() < 1 / 3:
            time.sleep(moments.uniform(0.0, self.beginning))
            return
        first = moments.randrange(self.chunks)
        wait_for(lambda: chunks_done(out) > first or process.poll() is not None)
        time.sleep(moments.uniform(0.0, 2.0 * (self.seconds - self.beginning) / self.chunks))

    def check(self, out: Path, before: dict[Path, tuple[int, int]]) -> None:
        """Check a completed run against the undisturbed run, and its finished chunks against those before the kill."""
        if contents(out) != self.reference:
            raise SystemExit(f"{out}: not the values of the undisturbed run")
        if not all(store.ok for store in verify(out)):
            raise SystemExit(f"{out}: verify finds fault with it")
        if not before.items() <= marked_files(out, flat=True).items():
            raise SystemExit(f"{out}: a chunk was written again after it was marked as done")
        if left := list(out.rglob("*.partial")):
            raise SystemExit(f"{out}: left behind: {left}")


def wait_for(condition: Callable[[], object]) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + LONGEST
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f"nothing happened in {LONGEST:g} s")
        time.sleep(0.002)


def chunks_done(out: Path) -> int:
    """Return the number of chunks that are marked as done."""
    files = [f"{top}/{file}" for top, _, files in os.walk(out) for file in files]
    return sum(bool(re.search(r"status/c(/\d+)*$", file)) for file in files)


def marked_files(out: Path, *, flat: bool = False) -> dict:
    """Return the files of all chunks marked as done, with inode and modification time, which rewriting would change."""
    found = {}
    for path in sorted(out.glob("*.zarr")):
        store = Store(path)
        for task in store.plan.tasks():
            if store.is_done(task):
                states = {file: (file.stat().st_ino, file.stat().st_mtime_ns) for file in store.files(task)}
                found |= states if flat else {(path.name, str(task)): states}
    return found


def contents(out: Path) -> dict[tuple[str, str], tuple[str, bytes]]:
    """Return every variable and coordinate of all stores as bytes."""
    found = {}
    for path in sorted(out.glob("*.zarr")):
        with open_dataset(path) as data:
            for name, variable in data.variables.items():
                values = np.asarray(variable.values)
                found[path.name, str(name)] = (str(values.dtype), values.tobytes())
    return found


def children_of(pid: int) -> list[int]:
    """Return the workers of a run: the child processes spawned by multiprocessing."""
    found = []
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            lines = dict(line.split(":\t", 1) for line in status.read_text().splitlines() if ":\t" in line)
            command = (status.parent / "cmdline").read_bytes()
        except (OSError, ValueError):
            # The process has ended meanwhile.
            continue
        if int(lines["PPid"]) == pid and b"spawn_main" in command:
            found.append(int(lines["Pid"]))
    return found


def kill_parent(trial: Trial, number: int, moments: random.Random) -> bool:
    """Kill a run and resume it; return False if it had already ended."""
    out = trial.folder / f"parent_{number}"
    options = ["--workers", "2"] if number % 2 else []
    process = trial.start(out, *options)
    trial.wait_for_the_moment(process, out, moments)
    if process.poll() is not None:
        process.communicate()
        return False
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    # The workers end by themselves; chunks that they have finished until then count as done.
    wait_for(lambda: not group_lives(process.pid))
    before = marked_files(out, flat=True)
    trial.outcomes[stage(trial, out)] += 1
    trial.finish(trial.start(out, *options, "--resume"))
    trial.check(out, before)
    return True


def kill_worker(trial: Trial, number: int, moments: random.Random) -> bool:
    """Kill a worker of a run, which must still complete; return False if there was no worker to kill."""
    out = trial.folder / f"worker_{number}"
    process = trial.start(out, "--workers", "2")
    trial.wait_for_the_moment(process, out, moments)
    workers = children_of(process.pid)
    if not workers:
        process.communicate(timeout=LONGEST)
        return False
    before = marked_files(out, flat=True)
    victim = moments.choice(workers)
    try:
        os.kill(victim, signal.SIGKILL)
    except ProcessLookupError:
        process.communicate(timeout=LONGEST)
        return False
    trial.outcomes[stage(trial, out)] += 1
    trial.finish(process)
    trial.check(out, before)
    return True


def group_lives(group: int) -> bool:
    """Return True if a process group still has members."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def stage(trial: Trial, out: Path) -> str:
    """Return the stage that a run has reached."""
    done = chunks_done(out)
    if not any(out.glob("*.zarr")):
        return "before its first store"
    return "before its first chunk" if not done else "between chunks" if done < trial.chunks else "after its last chunk"


def main() -> None:
    """Kill, resume, compare and report."""
    parser = argparse.ArgumentParser(description="Kill runs at random moments, resume and compare them.")
    parser.add_argument("--kills", type=int, default=50, help="of the parent, and as many of a worker [50]")
    parser.add_argument("--victim", choices=("parent", "worker"), help="one of the two only")
    parser.add_argument("--seed", type=int, default=2006, help="of the random moments [2006]")
    parser.add_argument("--json", action="store_true", help="print JSON for machines")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial(Path(folder))
        compared = sum(len(data) for _, data in trial.reference.values())
        report: dict[str, Any] = {"chunks_a_run": trial.chunks, "bytes_compared_a_run": compared}
        for name, kill in (("parent", kill_parent), ("worker", kill_worker)):
            if options.victim not in (None, name):
                continue
            moments, done, number = random.Random(f"{options.seed} {name}"), 0, 0
            trial.outcomes = Counter()
            while done < options.kills:
                done += kill(trial, number, moments)
                number += 1
            report[name] = {"killed": done, "identical": done, "too_late": number - done, **trial.outcomes}
            if not options.json:
                print(f"{name}: killed {done} times, every run completed and identical ({dict(trial.outcomes)})")
    if options.json:
        print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
