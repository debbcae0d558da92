"""Full disks, unwritable folders and damaged stores, as reported by the command line."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest
import yaml
from chunks import fail_on_2
from sweeping import AXES, assert_equal_stores, chunk_file, command, flip_byte, list_status_files, run_main, study
from waiting import LONGEST

# The limit is set before exec: a preexec_fn would run Python code in a fork of a process with JAX's threads.
RUN_LIMITED = """
import os, resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (12_000, 12_000))
os.execv(sys.argv[1], sys.argv[1:])
"""
COMMANDS = [["run"], ["run", "--dry-run"], ["run", "--resume"]]


def write_config(path, *studies):
    """Write a configuration file with the given studies."""
    path.write_text(yaml.safe_dump({"version": 1, "name": "sweep", "studies": list(studies)}), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return write_config(tmp_path_factory.mktemp("config") / "sweep.yaml", study())


@pytest.fixture(scope="module")
def finished(config, tmp_path_factory):
    """Folder of an undisturbed run."""
    folder = tmp_path_factory.mktemp("finished") / "out"
    assert run_main("run", config, "--out", folder) == 0
    return folder


@pytest.fixture
def copy(finished, tmp_path):
    """Copy of the finished run, to be damaged."""
    shutil.copytree(finished, tmp_path / "out")
    return tmp_path / "out"


@contextmanager
def without_root():
    """Run as an unprivileged user, because permissions do not restrict root; imports must be done before."""
    root = os.geteuid() == 0
    if root:
        os.setresuid(65534, 65534, 0)
    try:
        yield
    finally:
        if root:
            os.setresuid(0, 0, 0)


def make_accessible(folder):
    """Make a temporary folder of pytest accessible to other users."""
    for path in (folder, *folder.parents):
        if path.stat().st_uid == os.geteuid() and path.stat().st_mode & 0o077 == 0:
            path.chmod(path.stat().st_mode | 0o055)


def test_full_disk_ends_the_run_which_resumes_with_more_room(tmp_path):
    # Outputs that compress poorly, so that the chunks exceed the limit.
    axes = {**AXES, "d": 1, "delta": 0.1, "beta": {"linear": {"start": -0.2, "stop": 1.0, "num": 1000}}}
    config, out = write_config(tmp_path / "rough.yaml", study(axes=axes, outputs=("margin",))), tmp_path / "out"
    # A separate compilation cache: the limit also truncates compiled kernels, which must not reach the shared cache.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment["XDG_CACHE_HOME"] = str(tmp_path / "cache")
    # Python 3.11 keeps a truncated .pyc file, and every later import of it raises EOFError.
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    arguments = [sys.executable, "-c", RUN_LIMITED, *command("run", config, "--out", out)]
    result = subprocess.run(arguments, capture_output=True, text=True, check=False, timeout=LONGEST, env=environment)
    assert result.returncode == 1
    first, second = (line for line in result.stderr.splitlines() if line.startswith(("zwidth:", "Error:")))
    assert first.startswith(f"Error: out: {out}: ")
    assert "File too large" in first
    assert f"make room and resume with: zwidth run {config} --out {out} --resume" in second
    for noise in ("Traceback", "UserWarning", "compilation cache"):
        assert noise not in result.stderr
    assert list(out.rglob("*.partial")) == []
    assert run_main("run", config, "--out", out, "--resume") == 0
    assert run_main("verify", out) == 0


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
@pytest.mark.parametrize("name", ["sweep", "others"])
def test_out_that_is_a_file_is_refused(config, arguments, name, tmp_path, capsys):
    if name == "others":
        config = write_config(tmp_path / "others.yaml", {"kind": "ridge", "name": "r", "delta": [0, 1], "d": 0})
    file = tmp_path / "a_file"
    file.touch()
    for out, message in ((file, "is a file"), (file / "below", f"cannot be created because {file} is a file")):
        assert run_main(*arguments, config, "--out", out) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"Error: out: {out} {message}")
        assert "choose another" in error
    assert file.read_bytes() == b""


@pytest.mark.usefixtures("finished")
def test_read_only_folder_is_refused(config, tmp_path, capsys):
    make_accessible(tmp_path)
    make_accessible(config.parent)
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(0o555)
    with without_root():
        assert run_main("run", config, "--out", folder / "out") == 2
    message = f"Error: out: {folder}/out cannot be created because {folder} is not writable for you; choose another"
    assert capsys.readouterr().err.startswith(message)


def test_store_that_became_read_only_ends_the_run_with_a_message(config, copy, capsys):
    next(iter(list_status_files(copy))).unlink()
    make_accessible(copy)
    make_accessible(config.parent)
    for path in (copy / "map.zarr").rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    copy.chmod(0o777)
    with without_root():
        assert run_main("run", config, "--out", copy, "--resume") == 1
    assert "Permission denied" in (message := capsys.readouterr().err)
    assert "esume with: zwidth run" in message
    assert run_main("run", config, "--out", copy, "--resume") == 0


def test_sweep_larger_than_the_free_disk_space_is_refused_before_computing(config, tmp_path, capsys):
    axes = {name: {"linear": {"start": 0, "stop": 1, "num": num}} for name, num in (("alpha", 10**6), ("beta", 10**5))}
    axes |= {"delta": [0.1, 0.2, 0.3, 0.4, 0.5], "d": 1}
    huge = write_config(tmp_path / "huge.yaml", study(axes=axes, outputs=("margin",)))
    assert run_main("run", huge, "--out", tmp_path / "out") == 2
    assert "free, but the results may take" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda file: flip_byte(file, 5), "stable is damaged"),
        (lambda file: file.unlink(), "stable is missing"),
    ],
    ids=["flipped-byte", "missing-file"],
)
def test_verify_names_a_damaged_chunk_and_resume_recomputes_only_it(config, finished, copy, damage, message, capsys):
    damage(chunk_file(copy / "map.zarr", "stable", 3))
    before = list_status_files(copy)
    assert run_main("verify", copy) == 1
    out, err = capsys.readouterr()
    assert "map.zarr: 8 of 8 chunks done, 1 damaged" in out
    (line,) = err.splitlines()
    assert line.startswith(f"Error: {copy}/map.zarr: wall/3 (d ")
    assert line.endswith(f": {message}")
    assert run_main("verify", copy, "--json") == 1
    report = json.loads(capsys.readouterr().out)["map.zarr"]
    assert (report["ok"], report["done"], len(report["damaged"])) == (False, 8, 1)
    assert run_main("run", config, "--out", copy, "--resume") == 0
    out, err = capsys.readouterr()
    assert f"repaired map/{line.partition('map.zarr: ')[2]}" in err
    assert "8 of 8 chunks done (1 now)" in out
    assert len(before.items() & list_status_files(copy).items()) == 7
    assert run_main("verify", copy) == 0
    assert_equal_stores(finished, copy)


def test_failed_chunk_is_named_with_exit_code_1(config, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("zwidth.sweep.jobs.perform", fail_on_2)
    assert run_main("run", config, "--out", tmp_path / "out") == 1
    out, err = capsys.readouterr()
    assert "7 of 8 chunks done" in out
    assert "Error: chunk map/wall/2 (d 1:2, delta 0:2, alpha 0:40, beta 0:300) failed: ArithmeticError: no" in err
    assert f"retry the failed parts with: zwidth run {config} --out {tmp_path}/out --resume" in err
    assert run_main("verify", tmp_path / "out") == 1
    assert "map.zarr: 7 of 8 chunks done, none damaged" in capsys.readouterr().out


def test_damaged_store_metadata_is_reported_and_restored_from_its_copy(config, copy, capsys):
    text = (copy / "map.zarr" / "zarr.json").read_text(encoding="utf-8")
    for damaged in (text[:100], "", "[]", text.replace("float64", "float32")):
        (copy / "map.zarr" / "zarr.json").write_text(damaged, encoding="utf-8")
        assert run_main("verify", copy) == 1
        # Restored from the second copy, zwidth.json.
        assert run_main("run", config, "--out", copy, "--resume") == 0
        assert "repaired map/zarr.json (restored)" in capsys.readouterr().err
        assert run_main("verify", copy) == 0
        for name in ("zarr.json", "zwidth.json"):
            (copy / "map.zarr" / name).write_text(damaged, encoding="utf-8")
        assert run_main("verify", copy) == 1
        assert run_main("run", config, "--out", copy, "--resume") == 2
        err = capsys.readouterr().err
        assert "map.zarr: zarr.json " in err
        assert "start again in a new folder" in err
        for name in ("zarr.json", "zwidth.json"):
            (copy / "map.zarr" / name).write_text(text, encoding="utf-8")


def test_folder_without_a_store_is_reported(tmp_path, capsys):
    for arguments in (["verify", tmp_path], ["export", tmp_path, "--csv", tmp_path / "x.csv"]):
        assert run_main(*arguments) == 2
        assert "contains no store of a sweep" in capsys.readouterr().err
    assert run_main("verify", tmp_path / "no") == 2
    assert "no such folder" in capsys.readouterr().err


def test_dry_run_without_sweeps_prints_the_plan(tmp_path, capsys):
    config = write_config(tmp_path / "others.yaml", {"kind": "ridge", "name": "r", "delta": [0, 1], "d": 0})
    assert run_main("run", "--dry-run", config, "--out", tmp_path / "out") == 0
    assert "study r\n  2 points" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
