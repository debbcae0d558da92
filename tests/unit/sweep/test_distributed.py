"""Sweeps on a local dask.distributed cluster with worker processes: results, failures and error messages."""

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
    kill_scheduler_on_2,
    kill_worker_on_2,
    kill_worker_once_on_2,
    replay_from,
    stop_scheduler_on_2,
    store_nothing,
)
from sweeping import (
    assert_equal_stores,
    limit_chunk_sizes,
    list_status_files,
    make_config,
    make_full_config,
    run_main,
    run_sweeps,
    study,
)

from zwidth.core.errors import InputError

# Closing a cluster leaves sockets to the garbage collector, whose warnings pytest would attribute to later tests.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(scope="module")
def workers():
    """Yield a cluster of two workers, each of which is restarted if it dies."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from dask import config
        from distributed import LocalCluster

        # Allow one failure per chunk only, because each costs the start of a worker.
        few = config.set({"distributed.scheduler.allowed-failures": 1})
        # None disables the dashboard, although the annotation of distributed allows only strings.
        options: dict[str, Any] = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
        with few:
            cluster = LocalCluster(processes=True, **options)
            with cluster:
                yield cluster


@pytest.fixture
def cluster(workers):
    """Return the address of the cluster's scheduler."""
    return workers.scheduler_address


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    assert run_sweeps(make_config(), folder).ok
    return folder


def test_results_are_independent_of_cluster_and_chunks(cluster, tmp_path, monkeypatch):
    config = make_full_config()
    assert run_sweeps(config, tmp_path / "local").ok
    limit_chunk_sizes(monkeypatch, 5, 3)
    result = run_sweeps(config, tmp_path / "cluster", scheduler=cluster)
    assert result.ok
    assert result.computed == result.total > 50
    assert_equal_stores(tmp_path / "local", tmp_path / "cluster")


def test_chunk_of_a_killed_worker_is_computed_by_another(cluster, finished, tmp_path):
    replay_from(finished, tmp_path)
    result = run_sweeps(make_config(), tmp_path, scheduler=cluster, perform=kill_worker_once_on_2)
    assert result.ok
    assert_equal_stores(finished, tmp_path)


def test_chunk_that_kills_every_worker_is_reported_with_exit_code_1(
    workers, cluster, finished, tmp_path, monkeypatch, capsys
):
    # Without allowed failures dask abandons also other chunks of the killed worker; these are retried individually.
    monkeypatch.setattr(workers.scheduler, "allowed_failures", 0)
    monkeypatch.setattr("zwidth.sweep.jobs.perform", kill_worker_on_2)
    replay_from(finished, tmp_path / "out")
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump({"version": 1, "name": "sweep", "studies": [study()]}), encoding="utf-8")
    assert run_main("run", path, "--out", tmp_path / "out", "--scheduler", cluster) == 1
    out, err = capsys.readouterr()
    assert "7 of 8 chunks done" in out
    assert "Error: chunk map/wall/2 (" in err
    assert err.count(" failed: ") == 1
    assert ") failed: KilledWorker: the worker process died in every attempt" in err
    assert "Traceback" not in err


def test_unreachable_scheduler_raises(tmp_path, monkeypatch):
    monkeypatch.setattr("zwidth.sweep.distributed._CONNECT_SECONDS", 1)
    with pytest.raises(InputError, match=r"scheduler: no answer from 'tcp://127\.0\.0\.1:9'"):
        run_sweeps(make_config(), tmp_path, scheduler="tcp://127.0.0.1:9")


@contextmanager
def start_cluster(folder):
    """Start a scheduler and one worker as separate processes, yield the address, and end both."""
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
            subprocess.Popen([*python, *arguments], **options)
            for arguments in (scheduler, [*worker, "--local-directory", folder])
        ]
        (folder / "pid").write_text(str(started[0].pid), encoding="utf-8")
        try:
            # Wait for the worker, which would otherwise exit by itself without a client.
            with Client(address, timeout=240) as client:
                client.wait_for_workers(1, timeout=240)
            yield address
        finally:
            for process in started:
                process.kill()
                process.wait()


@pytest.mark.parametrize("disturbed", [kill_scheduler_on_2, stop_scheduler_on_2])
def test_lost_scheduler_ends_the_run_with_one_message(finished, tmp_path, monkeypatch, capfd, disturbed):
    monkeypatch.setattr("zwidth.sweep.jobs.perform", disturbed)
    path, out = tmp_path / "sweep.yaml", tmp_path / "out"
    replay_from(finished, out)
    path.write_text(yaml.safe_dump({"version": 1, "name": "test", "studies": [study()]}), encoding="utf-8")
    with start_cluster(tmp_path) as address:
        assert run_main("run", path, "--out", out, "--scheduler", address) == 1
    out_text, err = capfd.readouterr()
    messages = [line for line in err.splitlines() if not line.startswith(("map ", "[1/1] map "))]
    resume_hint = f"Resume with: zwidth run {path} --out {out} --resume --scheduler {address}"
    assert messages == [
        f"Error: scheduler: {address} no longer replies, or has been restarted; results so far are kept. {resume_hint}"
    ]
    reported = int(out_text.split(" of 8 chunks done")[0])
    # The chunk in progress may have finished after the report.
    assert reported <= len(list_status_files(out)) < 8
    monkeypatch.undo()
    assert run_sweeps(make_config(), out, resume=True).ok
    assert_equal_stores(finished, out)


def test_chunk_counts_as_done_only_if_stored(cluster, tmp_path):
    for engine in ({"scheduler": cluster}, {"workers": 1}, {}):
        out = tmp_path / "-".join(["out", *engine])
        result = run_sweeps(make_config(), out, perform=store_nothing, **engine)
        assert not result.ok
        assert (result.computed, result.total) == (0, 8)
        assert set(result.failed.values()) == {"reported as computed but missing from the store"}
