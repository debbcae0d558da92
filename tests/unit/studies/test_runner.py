"""The runner: folders, events, failures and the record of a run."""

import json
from pathlib import Path

import numpy as np
import pytest

import zwidth
from zwidth.errors import ConfigError, StoreExistsError
from zwidth.studies import jobs, run
from zwidth.studies.folder import staged
from zwidth.studies.outcome import Outcome
from zwidth.sweep.config import Config, load_config

SMALL = """
version: 1
name: small
studies:
  - {kind: map, name: one, alpha: [0.1, 0.2], beta: [0.1, 0.4], delta: 0.1, d: 0}
  - {kind: map, name: two, alpha: 0.1, beta: [0.1, 0.4], delta: 0.1, d: 0}
"""


@pytest.fixture
def config(tmp_path):
    file = tmp_path / "small.yaml"
    file.write_text(SMALL, encoding="utf-8")
    return file


def record_of(folder):
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def test_a_run_writes_what_its_record_lists(config, tmp_path):
    result = zwidth.run(config, out=tmp_path / "out")
    assert result.ok
    assert result.folder == tmp_path / "out"
    record = record_of(result.folder)
    listed = {file for study in record["studies"] for file in study["files"]}
    assert listed == {"one.npz", "one_stable.png", "one_stable.svg", "two.npz"}
    assert {file.name for file in result.folder.iterdir()} == listed | {"run.json", "config.yaml"}
    assert [study["state"] for study in record["studies"]] == ["done", "done"]
    assert record["precision"] == "float64"
    assert record["versions"]["zwidth"] == zwidth.__version__
    assert (result.folder / "config.yaml").read_text(encoding="utf-8") == SMALL


def test_the_folder_is_named_after_the_configuration(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert zwidth.run(config).folder == Path("runs", "small")
    assert (tmp_path / "runs" / "small" / "run.json").is_file()


def test_a_configuration_in_memory_leaves_a_file_that_can_be_run(config, tmp_path):
    result = run(load_config(config), out=tmp_path / "out")
    assert load_config(result.folder / "config.yaml") == load_config(config)


def test_a_run_tells_when_studies_start_and_end(config, tmp_path):
    events = []
    run(config, out=tmp_path / "out", progress=events.append)
    assert [(event.index, event.total, event.name) for event in events[::2]] == [(1, 2, "one"), (2, 2, "two")]
    assert [event.result is None for event in events] == [True, False] * 2
    assert events[1].result.state == "done"


def test_a_run_is_never_overwritten_unasked(config, tmp_path):
    out = tmp_path / "out"
    run(config, out=out)
    before = (out / "run.json").read_bytes()
    with pytest.raises(StoreExistsError, match=r"already holds a run.*--out") as caught:
        run(config, out=out)
    assert str(out) in str(caught.value)
    assert (out / "run.json").read_bytes() == before
    (out / "one.npz").unlink()
    assert run(config, out=out, overwrite=True).ok
    assert (out / "one.npz").is_file()
    assert [file.name for file in tmp_path.iterdir() if file.name.startswith(".")] == []


def test_a_folder_without_a_run_is_not_touched(config, tmp_path):
    out = tmp_path / "precious"
    out.mkdir()
    (out / "thesis.txt").write_text("words", encoding="utf-8")
    for overwrite in (False, True):
        with pytest.raises(StoreExistsError, match="holds no run"):
            run(config, out=out, overwrite=overwrite)
    assert [file.name for file in out.iterdir()] == ["thesis.txt"]
    with pytest.raises(StoreExistsError, match="is a file"):
        run(config, out=out / "thesis.txt")


def test_an_empty_folder_is_used(config, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    assert run(config, out=out).ok


def test_a_broken_configuration_makes_no_folder(tmp_path):
    file = tmp_path / "bad.yaml"
    file.write_text("version: 1\n", encoding="utf-8")
    with pytest.raises(ConfigError):
        run(file, out=tmp_path / "out")
    assert [entry.name for entry in tmp_path.iterdir()] == ["bad.yaml"]


def test_one_failure_does_not_lose_the_other_studies(config, tmp_path, monkeypatch):
    real = jobs.run_map

    def fail_first(study, si):
        if study.name == "one":
            raise FloatingPointError("no such luck")
        return real(study, si)

    monkeypatch.setattr(jobs, "run_map", fail_first)
    result = run(config, out=tmp_path / "out")
    assert not result.ok
    assert [study.name for study in result.failed] == ["one"]
    assert isinstance(result.failed[0].exception, FloatingPointError)
    assert (result.folder / "two.npz").is_file()
    assert record_of(result.folder)["studies"][0]["error"] == "FloatingPointError: no such luck"


def test_data_stay_when_the_drawing_fails(config, tmp_path, monkeypatch):
    def broken():
        raise ValueError("no ink")

    monkeypatch.setattr(jobs, "run_map", lambda study, si: Outcome(table={"x": np.ones(1)}, figures={"": broken}))
    result = run(config, out=tmp_path / "out")
    assert result.failed[0].files == ("one.csv",)
    assert (result.folder / "one.csv").is_file()


def test_an_interrupted_run_leaves_nothing_behind(config, tmp_path):
    def interrupt(event):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(config, out=tmp_path / "out", progress=interrupt)
    assert [entry.name for entry in tmp_path.iterdir()] == ["small.yaml"]


def test_a_folder_that_appears_meanwhile_is_left_alone(tmp_path):
    out = tmp_path / "out"
    other = tmp_path / "other"
    other.mkdir()
    (other / "run.json").write_text("{}", encoding="utf-8")
    with pytest.raises(StoreExistsError), staged(out, overwrite=False):
        other.rename(out)
    assert (out / "run.json").read_text(encoding="utf-8") == "{}"


def test_a_half_finished_run_does_not_pass_for_one(tmp_path):
    with staged(tmp_path / "out", overwrite=False) as partial:
        assert partial.parent == tmp_path
        assert partial.name.endswith(".partial")
        assert not (tmp_path / "out").exists()
    assert (tmp_path / "out").is_dir()


def test_repeated_figures_of_the_paper_bring_its_numbers():
    study = {"kind": "ridge", "name": "r", "delta": [0, 1], "d": 0, "figure": "fig10"}
    config = Config.model_validate({"version": 1, "name": "p", "studies": [study]})
    assert [job.name for job in jobs.jobs_of(config)] == ["r", "published"]
    del study["figure"]
    plain = Config.model_validate({"version": 1, "name": "p", "studies": [study]})
    assert [job.name for job in jobs.jobs_of(plain)] == ["r"]
