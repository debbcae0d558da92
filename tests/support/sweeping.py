"""Helpers for tests of sweeps: small configurations, the command line, and comparison of stores."""

import os
import re
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from waiting import LONGEST

from zwidth import run
from zwidth.cli import main
from zwidth.config.sweep import SweepStudy
from zwidth.studies.document import Config
from zwidth.sweep import plan
from zwidth.sweep.dataset import open_dataset
from zwidth.sweep.store import list_stores

AXES = {
    "alpha": {"linear": {"start": 0.0, "stop": 1.0, "num": 40}},
    "beta": {"linear": {"start": -0.2, "stop": 1.0, "num": 300}},
    "delta": [0.0, 0.1, 1.0, 3.0],
    "d": [0, 0.5, 1, 2],
}

# Two planes of walls, shown as slices in a report.
PLANES = {
    "alpha": {"linear": {"start": 0.01, "stop": 0.3, "num": 30}},
    "beta": {"linear": {"start": -0.2, "stop": 1.0, "num": 20}},
    "delta": [0.1, 0.5],
    "d": 1,
}


def study(name="map", axes=None, outputs=("stable",), **fields):
    return {"kind": "sweep", "name": name, "axes": AXES if axes is None else axes, "outputs": list(outputs), **fields}


WALLS = (
    *("stable", "spectral_radius", "margin", "decay_rate", "settling_time", "passive", "passivity_margin"),
    *("pole_angle", "gain_margin", "phase_margin", "delay_margin", "modulus_margin"),
)
DEVICES = ("alpha_max", "beta_at_max", "kind")
FEW = {"alpha": [0.0, 0.1, 0.5], "beta": [-0.05, 0.1, 0.4, 0.9], "delta": [0.0, 0.3], "d": [0, 0.5, 2]}
IN_SI = {
    **{"mass": ["100 g", "1 kg"], "damping": [0, 10], "rate": "1 kHz", "delay": ["1 ms", "2.5 ms"]},
    **{"stiffness": [0, 1000, 20_000], "virtual_damping": [0, 5, 40]},
}


def make_full_config():
    """Return a configuration with every output, in normalized and SI units, and with an accuracy for radii."""
    return make_config(
        study("map", FEW, (*WALLS, *DEVICES)),
        study("proved", FEW, ("spectral_radius", "settling_time"), accuracy=1e-11),
        study("si", IN_SI, (*WALLS, "frequency", "stiffness_max", "virtual_damping_at_max")),
    )


def limit_chunk_sizes(monkeypatch, walls, devices):
    """Limit chunks to this many points; other processes read the plan from the store."""
    original = plan.chunk_shape

    def chunk_shape(shape, target):
        # Grids of walls have two dimensions more than those of devices.
        return original(shape, walls if len(shape) > 3 else devices)

    monkeypatch.setattr(plan, "chunk_shape", chunk_shape)


def make_config(*studies, name="test"):
    return Config.model_validate({"version": 1, "name": name, "studies": list(studies) or [study()]})


def make_sweep(fields) -> SweepStudy:
    """Return a validated sweep."""
    (sweep,) = make_config(fields).studies
    assert isinstance(sweep, SweepStudy)
    return sweep


def run_sweeps(config, out, *, perform=None, **options):
    """Run a configuration with its chunks computed by ``perform``; return the counts and failures of all sweeps."""
    with patch("zwidth.sweep.jobs.perform", perform) if perform else nullcontext():
        result = run(config, out=out, **options)
    sweeps = result.sweeps.values()
    counts = {name: sum(getattr(sweep, name) for sweep in sweeps) for name in ("computed", "skipped", "total")}
    failed = {chunk: error for sweep in sweeps for chunk, error in sweep.failed.items()}
    flags_of_run = {name: getattr(result, name) for name in ("ok", "repaired", "fatal_error", "interrupted")}
    return SimpleNamespace(**counts, **flags_of_run, failed=failed)


def read_values(path):
    """Return every variable of a store, in memory."""
    with open_dataset(path) as dataset:
        return {name: variable.values for name, variable in dataset.data_vars.items()}


def assert_equal_stores(first, second):
    """Check that two stores, or all stores of two folders, are equal bit by bit."""
    stores = list_stores(first)
    assert [store.name for store in stores] == [store.name for store in list_stores(second)]
    for store, other_store in zip(stores, list_stores(second), strict=True):
        first_values, second_values = read_values(store), read_values(other_store)
        assert first_values.keys() == second_values.keys()
        for name in first_values:
            assert first_values[name].dtype == second_values[name].dtype
            assert first_values[name].tobytes() == second_values[name].tobytes(), (store.name, name)


def list_status_files(path):
    """Return the status files of finished chunks with inode and modification time, which change if rewritten."""
    # Unlike `rglob`, `os.walk` tolerates folders that are renamed meanwhile.
    files = [f"{top}/{file}" for top, _, files in os.walk(path) for file in files]
    marks = [Path(file) for file in files if re.search(r"status/c(/\d+)*$", file)]
    return {mark: (mark.stat().st_ino, mark.stat().st_mtime_ns) for mark in marks}


def chunk_file(path, variable="stable", number=0):
    """Return one chunk file of a variable."""
    return sorted(file for file in (Path(path) / variable / "c").rglob("*") if file.is_file())[number]


def command(*arguments):
    """Return the arguments that start the command line."""
    return [sys.executable, "-m", "zwidth", *map(str, arguments)]


def run_main(*arguments):
    """Run the command line in this process and return its exit code, without changing this process's settings."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        # With an empty setting, the command does not create the user's cache folder.
        with patch.dict(os.environ, JAX_COMPILATION_CACHE_DIR=""):
            main([str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code or 0
    finally:
        signal.signal(signal.SIGTERM, handler)
    return 0


def run_command(*arguments, **options):
    """Run the command line in a subprocess to its end."""
    return subprocess.run(command(*arguments), capture_output=True, text=True, check=False, timeout=LONGEST, **options)


def start_command(*arguments, **options):
    """Start the command line in its own process group."""
    return subprocess.Popen(
        command(*arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        **options,
    )


def flip_byte(file, position=-1):
    """Flip the bits of one byte of a file."""
    data = bytearray(file.read_bytes())
    data[position] ^= 0xFF
    file.write_bytes(data)
