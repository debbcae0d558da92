"""The record of a run: references outside of the folder are rejected, links are not followed, and a loss is
recoverable.
"""

import json
import os

import numpy as np
import pytest
from run_folders import read_record, read_states

from zwidth.app.report.page import write_report
from zwidth.core.errors import InputError, StoreError, StoreExistsError
from zwidth.runs import run

pytestmark = pytest.mark.usefixtures("unpainted")


def list_tree(folder):
    """Return the entries of a folder: contents of files and targets of links."""
    contents = {}
    for path in sorted(folder.rglob("*")):
        contents[path.relative_to(folder).as_posix()] = (
            f"-> {os.readlink(path)}" if path.is_symlink() else path.read_bytes() if path.is_file() else None
        )
    return contents


OUTSIDE = ["../victim/a.txt", "{victim}/a.txt", "../victim/store.zarr", "..", ".", "", "sub/../../victim/a.txt", "a\0b"]


@pytest.mark.parametrize("key", ["files", "name", "inputs"])
@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("options", [{"resume": True}, {"overwrite": True}], ids=str)
def test_record_naming_files_outside_raises(tmp_path, config_with_sweep, name, key, options):
    victim = tmp_path / "victim"
    (victim / "store.zarr").mkdir(parents=True)
    for file in ("a.txt", "store.zarr/zarr.json", "store.zarr/chunk"):
        (victim / file).write_text("dear", encoding="utf-8")
    out = tmp_path / "out"
    out.mkdir()
    name, entry = name.format(victim=victim), {"name": "one", "kind": "map", "state": "open", "inputs": {}, "files": {}}
    record = {"format": 2, "versions": {}, "studies": [entry], "inputs": {}}
    if key == "name":
        entry["name"] = name
    else:
        (entry if key == "files" else record)[key][name] = "0"
    (out / "run.json").write_text(json.dumps(record), encoding="utf-8")
    before = list_tree(victim), list_tree(out)
    with pytest.raises(StoreError, match="which is not the name of a file in its folder; choose another folder"):
        run(config_with_sweep, out=out, **options)
    with pytest.raises(StoreError, match="not the name of a file in its folder"):
        write_report(out)
    assert (list_tree(victim), list_tree(out)) == before


@pytest.mark.parametrize("content", [[], {}, {"studies": 1}, {"studies": [1]}, {"studies": [], "versions": 1},
                                     {"studies": [{"name": "a", "files": "b"}]}, {"studies": [{}]}])  # fmt: skip
def test_invalid_record_raises(tmp_path, config_with_sweep, content):
    (tmp_path / "run.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(StoreError, match=r"run.json: .*; choose another folder"):
        run(config_with_sweep, out=tmp_path, resume=True)


@pytest.mark.parametrize("options", [{"resume": True}, {"overwrite": True}], ids=str)
def test_links_in_a_run_are_replaced_without_touching_their_targets(finished, config_with_sweep, tmp_path, options):
    victim = tmp_path / "victim"
    (victim / "tree").mkdir(parents=True)
    (victim / "tree" / "zarr.json").write_text("dear", encoding="utf-8")
    (victim / "two.npz").write_bytes((finished / "two.npz").read_bytes())
    (victim / "secret.svg").write_text("<svg>dear</svg>", encoding="utf-8")
    before = list_tree(victim)
    for name, target in (("two.npz", "two.npz"), ("one_stable.svg", "secret.svg")):
        (finished / name).unlink()
        (finished / name).symlink_to(victim / target)
    # A link left by another study and named in the record.
    (finished / "left.zarr").symlink_to(victim / "tree")
    record = read_record(finished)
    record["studies"][0]["files"]["left.zarr"] = None
    record["studies"][0]["state"] = "open"
    (finished / "run.json").write_text(json.dumps(record), encoding="utf-8")
    assert run(config_with_sweep, out=finished, **options).ok
    assert list_tree(victim) == before
    assert not (finished / "two.npz").is_symlink()
    assert not (finished / "one_stable.svg").is_symlink()


def test_report_does_not_follow_links(finished, tmp_path):
    secret = tmp_path / "secret.svg"
    secret.write_text("<svg>dear</svg>", encoding="utf-8")
    (finished / "one_stable.svg").unlink()
    (finished / "one_stable.svg").symlink_to(secret)
    with pytest.raises(StoreError, match=r"one_stable\.svg is damaged"):
        write_report(finished)
    assert not (finished / "report.html").exists()


@pytest.mark.parametrize("options", [{"resume": True}, {"overwrite": True}], ids=str)
def test_lost_record_is_reported_and_restored(finished, config_with_sweep, options):
    values = np.load(finished / "two.npz")["stable"]
    (finished / "run.json").unlink()
    (finished / "mine.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(StoreExistsError, match=r"without its record run.json; replace .* --overwrite, .* --resume"):
        run(config_with_sweep, out=finished)
    result = run(config_with_sweep, out=finished, **options)
    assert result.ok
    assert read_states(finished) == {"one": "done", "two": "done", "swept": "done"}
    assert result.sweeps["swept"].computed == (0 if "resume" in options else 1)
    np.testing.assert_array_equal(np.load(finished / "two.npz")["stable"], values)
    assert (finished / "mine.txt").read_text(encoding="utf-8") == "mine"
    assert [study.state for study in run(config_with_sweep, out=finished, resume=True).studies] == [
        "kept",
        "kept",
        "done",
    ]


@pytest.mark.parametrize("options", [{}, {"overwrite": True}], ids=str)
def test_files_of_another_configuration_are_not_overwritten(finished, config, options):
    (finished / "run.json").unlink()
    before = list_tree(finished)
    with pytest.raises(StoreExistsError, match="contains no run"):
        run(config, out=finished, **options)
    assert list_tree(finished) == before


@pytest.mark.parametrize("kind", ["link", "dangling", "linked folder"])
def test_lock_does_not_follow_links(config, tmp_path, kind):
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "run").write_text("dear", encoding="utf-8")
    locks = tmp_path / "out" / ".locks"
    if kind == "linked folder":
        locks.parent.mkdir()
        locks.symlink_to(victim)
    else:
        locks.mkdir(parents=True)
        make = {
            "link": lambda: (locks / "run").symlink_to(victim / "run"),
            "dangling": lambda: (locks / "run").symlink_to(victim / "none"),
        }
        make[kind]()
    with pytest.raises((InputError, OSError)):
        run(config, out=tmp_path / "out")
    assert list_tree(victim) == {"run": b"dear"}
