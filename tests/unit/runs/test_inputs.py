"""Copies of input files in a run's folder, from which the run can be repeated."""

import hashlib
import shutil
from typing import Any

import pytest
from run_folders import read_record

import zwidth
from zwidth.core.errors import StoreError, StoreExistsError
from zwidth.runs.record import gather_inputs
from zwidth.sweep.dataset import open_dataset

pytestmark = pytest.mark.usefixtures("unpainted")

TABLE = "label,mass [kg],damping [N s/m]\none,0.1,1\ntwo,0.2,1\n"
SWEEP = """
version: 1
name: table
studies:
  - kind: sweep
    name: swept
    axes: {devices: {csv: %s}, rate: 1 kHz, delay: 1 periods}  # of the workshop
    outputs: [stiffness_max]
"""


def write_config(folder, table_path, text=TABLE):
    """Write a table and a configuration that refers to it; return the latter."""
    file = folder / table_path.strip("'\"")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
    (folder / "own.yaml").write_text(SWEEP % table_path, encoding="utf-8")
    return folder / "own.yaml"


@pytest.mark.parametrize("table_path", ["devices.csv", "of mine/dévices, #1.csv", "'it: is.csv'", '"quoted.csv"'])
def test_run_is_repeatable_from_its_own_folder(tmp_path, table_path):
    if not table_path.startswith(("'", '"')) and "," in table_path:
        table_path = f"'{table_path}'"
    config = write_config(tmp_path / "source", table_path)
    out = tmp_path / "out"
    assert zwidth.run(config, out=out).ok
    (copy,) = (out / "inputs").iterdir()
    assert copy.read_text(encoding="utf-8") == TABLE
    assert read_record(out)["inputs"] == {copy.name: hashlib.sha256(TABLE.encode()).hexdigest()}
    text = (out / "config.yaml").read_text(encoding="utf-8")
    assert f"csv: inputs/{copy.name}}}, rate: 1 kHz, delay: 1 periods}}  # of the workshop" in text
    shutil.rmtree(config.parent)
    moved = out.rename(tmp_path / "moved")
    again = zwidth.run(moved / "config.yaml", out=tmp_path / "again")
    assert again.ok
    assert (again.folder / "config.yaml").read_text(encoding="utf-8") == text
    assert open_dataset(again.folder).equals(open_dataset(moved))
    option_sets: list[dict[str, Any]] = [{"resume": True}, {"overwrite": True}]
    for options in option_sets:
        assert zwidth.run(moved / "config.yaml", out=moved, **options).ok
        assert copy.name in {file.name for file in (moved / "inputs").iterdir()}
    (moved / "inputs" / copy.name).unlink()
    (moved / "own.csv").write_text("mine", encoding="utf-8")
    assert zwidth.run(again.folder / "config.yaml", out=moved, resume=True).ok
    assert (moved / "inputs" / copy.name).is_file()
    assert "inputs</code> of the run" in zwidth.write_report(moved).read_text(encoding="utf-8")


def test_loaded_configuration_stores_its_tables(tmp_path, monkeypatch):
    config = zwidth.load_config(write_config(tmp_path / "source", "devices.csv"))
    monkeypatch.chdir(tmp_path)
    # The contents of the table are part of the written configuration.
    assert zwidth.run(config, out="out").ok
    assert zwidth.run("out/config.yaml", out="again").ok


def test_changed_table_is_not_resumed(tmp_path):
    poses, config = tmp_path / "arm.csv", tmp_path / "arm.yaml"
    poses.write_text("x,y,mass [kg],damping\n0,0,0.1,1\n1,0,0.2,1\n", encoding="utf-8")
    study = "{kind: workspace, name: w, poses: {csv: arm.csv, across: x, up: y}, period: 1 ms, delay: 0 s}"
    config.write_text(f"{{version: 1, name: arm, studies: [{study}]}}", encoding="utf-8")
    assert zwidth.run(config, out=tmp_path / "out").ok
    assert zwidth.run(config, out=tmp_path / "out", resume=True).studies[0].state == "kept"
    assert zwidth.run(tmp_path / "out" / "config.yaml", out=tmp_path / "out", resume=True).studies[0].state == "kept"
    poses.write_text("x,y,mass [kg],damping\n0,0,0.1,1\n1,0,0.3,1\n", encoding="utf-8")
    with pytest.raises(StoreError, match=r"studies\[w\].poses.csv: the run was created with 'inputs/arm.csv, sha256 "):
        zwidth.run(config, out=tmp_path / "out", resume=True)


def test_inputs_with_equal_names_anchors_and_quotes(tmp_path):
    for name in ("a/x.csv", "b/x.csv", "b/X-2.csv", "c.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name, encoding="utf-8")
    text = (
        'one: {csv: &first a/x.csv}\ntwo: {csv: "b/x.csv"}  # b\nthree:\n  csv: >-\n    b/X-2.csv\n'
        "four: {csv: *first}\n"
        "five: {csv: none.csv, name: c.csv}\nsix: {csv: 'c.csv'}\n"
    )
    rewritten, files, names = gather_inputs(text, tmp_path)
    assert rewritten == (
        "one: {csv: &first inputs/x.csv}\ntwo: {csv: inputs/x-2.csv}  # b\nthree:\n  csv: inputs/X-2-2.csv\n"
        "four: {csv: *first}\nfive: {csv: none.csv, name: c.csv}\nsix: {csv: inputs/c.csv}\n"
    )
    assert {name: files[copy.removeprefix("inputs/")].decode() for name, copy in names.items()} == {
        name: name for name in names
    }
    # Gathering again does not rename the copies.
    folder = tmp_path / "run" / "inputs"
    folder.mkdir(parents=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    assert gather_inputs(rewritten, folder.parent)[:2] == (rewritten, files)


def test_files_not_written_by_the_run_are_kept(tmp_path):
    config = write_config(tmp_path / "source", "devices.csv")
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    assert zwidth.run(config, out=out).ok
    shutil.rmtree(out / "inputs")
    elsewhere.mkdir()
    (out / "inputs").symlink_to(elsewhere)
    option_sets: list[dict[str, Any]] = [{"resume": True}, {"overwrite": True}]
    for options in option_sets:
        with pytest.raises(StoreExistsError, match="was not written by this run"):
            zwidth.run(config, out=out, **options)
    assert list(elsewhere.iterdir()) == []
    other = tmp_path / "other"
    (other / "inputs").mkdir(parents=True)
    (other / "inputs" / "devices.csv").write_text("mine", encoding="utf-8")
    with pytest.raises(StoreExistsError, match="was not written by this run"):
        zwidth.run(config, out=other, resume=True)
    assert (other / "inputs" / "devices.csv").read_text(encoding="utf-8") == "mine"
