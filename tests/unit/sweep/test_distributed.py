"""Sweeps on a dask.distributed cluster: one on this machine, with workers in processes of their own."""

import os
import socket
import subprocess
import sys
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from chunks import (
    doing_nothing,
    killed_on_2,
    killed_once_on_2,
    killing_the_scheduler_on_2,
    replay_from,
    stopping_the_scheduler_on_2,
)
from sweeping import assert_same, config_of, config_of_everything, cut, flags, main_of, run_sweeps, study

from zwidth.core.errors import InputError

# Closing a cluster leaves sockets to the garbage collector, which pytest then reports in whatever test runs next.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(scope="module")
def workers():
    """A scheduler with two workers, each of which is replaced when it dies."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from dask import config
        from distributed import LocalCluster

        # One death more and dask gives a chunk up: each of them costs the start of a worker.
        few = config.set({"distributed.scheduler.allowed-failures": 1})
        # None starts no dashboard, though what distributed annotates is a text.
        options: dict[str, Any] = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
        with few:
            cluster = LocalCluster(processes=True, **options)
            with cluster:
                yield cluster


@pytest.fixture
def cluster(workers):
    """The address of its scheduler."""
    return workers.scheduler_address


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    assert run_sweeps(config_of(), folder).ok
    return folder


def test_no_output_depends_on_the_cluster_and_chunks(cluster, tmp_path, monkeypatch):
    config = config_of_everything()
    assert run_sweeps(config, tmp_path / "here").ok
    cut(monkeypatch, 5, 3)
    result = run_sweeps(config, tmp_path / "there", scheduler=cluster)
    assert result.ok
    assert result.computed == result.total > 50
    assert_same(tmp_path / "here", tmp_path / "there")


def test_work_of_a_killed_worker_is_done_by_another(cluster, finished, tmp_path):
    replay_from(finished, tmp_path)
    result = run_sweeps(config_of(), tmp_path, scheduler=cluster, perform=killed_once_on_2)
    assert result.ok
    assert_same(finished, tmp_path)


def test_a_chunk_that_always_kills_its_worker_is_named_and_the_exit_code_is_1(
    workers, cluster, finished, tmp_path, monkeypatch, capsys
):
    # With a first death dask gives up the chunk, and those that its worker had begun; one by one they are tried again.
    monkeypatch.setattr(workers.scheduler, "allowed_failures", 0)
    monkeypatch.setattr("zwidth.sweep.jobs.perform", killed_on_2)
    replay_from(finished, tmp_path / "out")
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump({"version": 1, "name": "sweep", "studies": [study()]}), encoding="utf-8")
    assert main_of("run", path, "--out", tmp_path / "out", "--scheduler", cluster) == 1
    out, err = capsys.readouterr()
    assert "7 of 8 chunks done" in out
    assert "Error: chunk map/wall/2 (" in err
    assert err.count(" failed: ") == 1
    assert ") failed: KilledWorker: the worker process died in every attempt" in err
    assert "Traceback" not in err


def test_no_scheduler_at_the_address(tmp_path, monkeypatch):
    monkeypatch.setattr("zwidth.sweep.distributed._CONNECT_SECONDS", 1)
    with pytest.raises(InputError, match=r"scheduler: no answer from 'tcp://127\.0\.0\.1:9'"):
        run_sweeps(config_of(), tmp_path, scheduler="tcp://127.0.0.1:9")


@contextmanager
def own_cluster(folder):
    """A scheduler with one worker, each a process of its own; yields the address and ends both."""
    from distributed import Client

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    address, python = f"tcp://127.0.0.1:{port}", [sys.executable, "-m"]
    paths = [str(Path(__file__).parents[2] / "support"), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    scheduler = ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"]
    worker = ["distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
    with open(folder / "log", "wb") as log:
        options = {"stdout": log, "stderr": log, "env": environment}
        started = [
            subprocess.Popen([*python, *words], **options)
            for words in (scheduler, [*worker, "--local-directory", folder])
        ]
        (folder / "pid").write_text(str(started[0].pid), encoding="utf-8")
        try:
            # Both are there: with nobody to talk to, a worker ends by itself.
            with Client(address, timeout=240) as client:
                client.wait_for_workers(1, timeout=240)
            yield address
        finally:
            for process in started:
                process.kill()
                process.wait()


@pytest.mark.parametrize("disturbed", [killing_the_scheduler_on_2, stopping_the_scheduler_on_2])
def test_a_scheduler_that_dies_or_falls_silent_ends_the_run_in_one_line(
    finished, tmp_path, monkeypatch, capfd, disturbed
):
    monkeypatch.setattr("zwidth.sweep.jobs.perform", disturbed)
    path, out = tmp_path / "sweep.yaml", tmp_path / "out"
    replay_from(finished, out)
    path.write_text(yaml.safe_dump({"version": 1, "name": "test", "studies": [study()]}), encoding="utf-8")
    with own_cluster(tmp_path) as address:
        assert main_of("run", path, "--out", out, "--scheduler", address) == 1
    out_text, err = capfd.readouterr()
    ours = [line for line in err.splitlines() if not line.startswith(("map ", "[1/1] map "))]
    go_on = f"Resume with: zwidth run {path} --out {out} --resume --scheduler {address}"
    assert ours == [
        f"Error: scheduler: {address} no longer replies, or has been restarted; results so far are kept. {go_on}"
    ]
    told = int(out_text.split(" of 8 chunks done")[0])
    # What it was at may have been finished since.
    assert told <= len(flags(out)) < 8
    monkeypatch.undo()
    assert run_sweeps(config_of(), out, resume=True).ok
    assert_same(finished, out)


def test_a_chunk_is_done_when_the_store_says_so(cluster, tmp_path):
    for engine in ({"scheduler": cluster}, {"workers": 1}, {}):
        out = tmp_path / "-".join(["out", *engine])
        result = run_sweeps(config_of(), out, perform=doing_nothing, **engine)
        assert not result.ok
        assert (result.computed, result.total) == (0, 8)
        assert set(result.failed.values()) == {"reported as computed but missing from the store"}
