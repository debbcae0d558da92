"""Fixtures with configurations of runs, finished runs and failing studies."""

import shutil

import pytest
from run_folders import SMALL, SMALL_WITH_SWEEP
from unpainted import painting_nothing

from zwidth.runs import run
from zwidth.studies.boundary import MapStudy


@pytest.fixture
def config(tmp_path):
    file = tmp_path / "small.yaml"
    file.write_text(SMALL, encoding="utf-8")
    return file


@pytest.fixture
def config_with_sweep(tmp_path):
    file = tmp_path / "both.yaml"
    file.write_text(SMALL_WITH_SWEEP, encoding="utf-8")
    return file


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """Return the folder of an undisturbed run."""
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "both.yaml").write_text(SMALL_WITH_SWEEP, encoding="utf-8")
    with painting_nothing():
        result = run(folder / "both.yaml", out=folder / "out")
    assert result.ok
    assert [(study.name, study.state) for study in result.studies] == [
        (name, "done") for name in ("one", "two", "swept")
    ]
    return result.folder


@pytest.fixture
def finished(undisturbed, tmp_path):
    """Return a copy of the undisturbed run, which the test may modify."""
    return shutil.copytree(undisturbed, tmp_path / "out")


@pytest.fixture
def fail(monkeypatch):
    """Make the study ``one`` fail; ``fail.undo()`` ends that."""
    real = MapStudy.compute

    def compute(self, scene, alone):
        if self.name == "one":
            raise FloatingPointError("no such luck")
        return real(self, scene, alone)

    monkeypatch.setattr(MapStudy, "compute", compute)
    return monkeypatch
