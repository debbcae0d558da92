#!/usr/bin/env python3
"""Measure sweeps end to end: points per second with one and two workers, memory and disk space.

    PYTHONPATH=src python benchmarks/bench_sweep.py [--quick] [--json]

Every run is a new process of the command line that writes results and checksums to disk. Three rates are measured:

- cold: from the start of the program to its end, including imports and compilation;
- warm: between the first and the last finished chunk, which is the rate of long sweeps;
- in process: a second sweep in a process that has compiled everything, including the creation of the store.

Rates depend on the load of the machine: runs with one and two workers alternate, ratios are ratios of medians, and the
load before and after is listed. The points per second of CPU time hardly depend on the load.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

# About a hundred chunks per worker; 25 times configs/dense.yaml.
STABLE = """\
version: 1
name: stable
studies:
  - kind: sweep
    name: map
    axes:
      alpha: {{linear: {{start: 0.002, stop: 2, num: 1000}}}}
      beta: {{linear: {{start: -0.5, stop: 1.5, num: 1000}}}}
      delta: {{linear: {{start: 0, stop: 1.9, num: {devices}}}}}
      d: [0, 0.5, 1, 2, 4]
    outputs: [stable]
"""
RADIUS = """\
version: 1
name: radius
studies:
  - kind: sweep
    name: map
    axes:
      alpha: {{linear: {{start: 0.01, stop: 1, num: 100}}}}
      beta: {{linear: {{start: -0.2, stop: 1, num: 100}}}}
      delta: {{linear: {{start: 0, stop: 2, num: {devices}}}}}
      d: 1
    outputs: [spectral_radius]
"""

# Runs a configuration twice in one process and prints the time of both runs in s.
TWICE = """
import shutil, sys, time
import zwidth

config = zwidth.load_config(sys.argv[1])
for number in range(int(sys.argv[3])):
    start = time.perf_counter()
    assert zwidth.run(config, out=f"{sys.argv[2]}/{number}").ok
    print(time.perf_counter() - start)
    shutil.rmtree(f"{sys.argv[2]}/{number}")
"""


def run(config: Path, out: Path, workers: int) -> dict[str, float]:
    """Return rates, CPU time and the largest resident memory of any process for one run of the command line.

    Each worker is limited to one processor, since a single worker would otherwise use all of them.
    """
    words = [sys.executable, "-m", "zwidth", "run", str(config), "--out", str(out), "--workers", str(workers)]
    available = sorted(os.sched_getaffinity(0))[:workers]
    started = time.perf_counter()
    process = subprocess.Popen(
        words,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: os.sched_setaffinity(0, available),
    )
    peak: dict[int, int] = {}
    used: dict[int, float] = {}
    spent: list[tuple[int, float]] = []
    while process.poll() is None:
        for pid in family(process.pid):
            peak[pid] = max(peak.get(pid, 0), resident(pid))
            used[pid] = max(used.get(pid, 0.0), processor_seconds(pid))
        spent.append((time.time_ns(), sum(used.values())))
        time.sleep(0.02)
    seconds = time.perf_counter() - started
    if process.returncode:
        raise SystemExit(process.stderr.read() if process.stderr else "failed")
    from zwidth.sweep.store import Store

    store = Store(out / "map.zarr")
    tasks = list(store.plan.tasks())
    ends = sorted((store.status_file(task).stat().st_mtime_ns, task.points) for task in tasks)
    points = sum(number for _, number in ends)
    # The first chunk of each worker includes its start-up.
    first, last = ends[workers - 1][0], ends[-1][0]
    warm = sum(number for _, number in ends[workers:])
    times, seconds_used = zip(*spent, strict=True)
    processors = float(np.interp(last, times, seconds_used) - np.interp(first, times, seconds_used))
    disk = sum(file.stat().st_size for file in store.path.rglob("*") if file.is_file())
    return {
        "points": points,
        "cold_seconds": seconds,
        "cold_points_per_second": points / seconds,
        "warm_points_per_second": warm / ((last - first) / 1e9),
        "warm_points_per_processor_second": warm / processors,
        "peak_mib_of_a_process": max(peak.values()) / 2**20,
        "planned_mib_of_a_chunk": store.plan.memory / 2**20,
        "disk_bits_per_point": 8 * disk / points,
    }


def family(pid: int) -> list[int]:
    """Return the IDs of a process and its children."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    except OSError:
        return []
    return [pid, *map(int, children)]


def processor_seconds(pid: int) -> float:
    """Return the CPU time of a process in s."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident(pid: int) -> int:
    """Return the peak resident memory of a process in bytes."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM")), 0)


def by_turns(text: str, folder: Path, rounds: int) -> dict[str, Any]:
    """Return medians of alternating runs with one and two workers."""
    config = folder / "config.yaml"
    config.write_text(text, encoding="utf-8")
    found: dict[int, list[dict[str, float]]] = {1: [], 2: []}
    for number in range(rounds):
        for workers, results in found.items():
            out = folder / f"{workers}_{number}"
            results.append(run(config, out, workers))
            subprocess.run(["rm", "-rf", str(out)], check=True)
    medians = {
        f"workers_{workers}": {key: statistics.median(result[key] for result in results) for key in results[0]}
        for workers, results in found.items()
    }
    one, two = (medians[f"workers_{workers}"] for workers in (1, 2))
    ratio = two["warm_points_per_second"] / one["warm_points_per_second"]
    kept = two["warm_points_per_processor_second"] / one["warm_points_per_processor_second"]
    # The second ratio is the speedup expected on an otherwise idle machine.
    return {**medians, "two_over_one": ratio, "two_over_one_by_processor_time": 2.0 * kept}


def in_process(text: str, folder: Path, points: int) -> dict[str, float]:
    """Return rates of repeated sweeps in one process."""
    config = folder / "config.yaml"
    config.write_text(text, encoding="utf-8")
    result = subprocess.run(
        [sys.executable, "-c", TWICE, str(config), str(folder), "4"], capture_output=True, text=True, check=True
    )
    first, *others = map(float, result.stdout.split())
    best = min(others)
    return {"points": points, "first_seconds": first, "seconds": best, "points_per_second": points / best}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure sweeps end to end.")
    parser.add_argument("--quick", action="store_true", help="smaller sweeps, once")
    parser.add_argument("--only", choices=("in_process", "stable", "spectral_radius"), help="one of the three")
    parser.add_argument("--json", action="store_true", help="print JSON for machines")
    options = parser.parse_args()
    rounds = 1 if options.quick else 3
    report: dict[str, Any] = {
        "machine": {"processors": os.cpu_count(), "name": platform.machine(), "load_before": os.getloadavg()}
    }
    with tempfile.TemporaryDirectory() as folder:
        if options.only in (None, "in_process"):
            report["stable_1e8_in_process"] = in_process(STABLE.format(devices=20), Path(folder), 10**8)
        if options.only in (None, "stable"):
            report["stable"] = by_turns(STABLE.format(devices=20 if options.quick else 500), Path(folder), rounds)
        if options.only in (None, "spectral_radius"):
            devices = 60 if options.quick else 200
            report["spectral_radius"] = by_turns(RADIUS.format(devices=devices), Path(folder), rounds)
    report["machine"]["load_after"] = os.getloadavg()
    if options.json:
        print(json.dumps(report, indent=2))
        return
    for name, values in report.items():
        print(name)
        for key, value in values.items():
            print(f"  {key}: {value if not isinstance(value, float) else f'{value:.4g}'}")


if __name__ == "__main__":
    main()
