"""Configurations of runs, runs of them, and what their folders hold."""

import shutil

import pytest
from run_folders import BOTH, SMALL
from unpainted import painting_nothing

from zwidth.runs import run
from zwidth.studies.boundary import MapStudy


@pytest.fixture
def config(tmp_path):
    file = tmp_path / "small.yaml"
    file.write_text(SMALL, encoding="utf-8")
    return file


@pytest.fixture
def both(tmp_path):
    file = tmp_path / "both.yaml"
    file.write_text(BOTH, encoding="utf-8")
    return file


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The folder of a run that nothing disturbed."""
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "both.yaml").write_text(BOTH, encoding="utf-8")
    with painting_nothing():
        result = run(folder / "both.yaml", out=folder / "out")
    assert result.ok
    assert [(study.name, study.state) for study in result.studies] == [
        (name, "done") for name in ("one", "two", "swept")
    ]
    return result.folder


@pytest.fixture
def finished(undisturbed, tmp_path):
    """A copy of it, for a test to do with as it likes."""
    return shutil.copytree(undisturbed, tmp_path / "out")


@pytest.fixture
def fail(monkeypatch):
    """Makes the study ``one`` fail until the test is done with it."""
    real = MapStudy.compute

    def compute(self, scene, alone):
        if self.name == "one":
            raise FloatingPointError("no such luck")
        return real(self, scene, alone)

    monkeypatch.setattr(MapStudy, "compute", compute)
    return monkeypatch
