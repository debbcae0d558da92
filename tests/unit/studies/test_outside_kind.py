"""A study kind defined outside of the package: registered, run, resumed and checked like a built-in one."""

import json
from importlib.metadata import EntryPoint
from typing import Literal

import numpy as np
import pytest
from sweeping import run_main

import zwidth
from zwidth.config.values import DeltaAxis
from zwidth.core.errors import ConfigError, StoreError
from zwidth.studies import ComputedStudy, Outcome, document, register


class RatioStudy(ComputedStudy):
    """Ratio of the maximum stable to the maximum passive stiffness, without delay."""

    method = "Closed forms, without delay."
    from_scene = ("delta",)

    kind: Literal["ratio"]

    delta: DeltaAxis
    """Normalized damping of the device, an axis; taken from the scene if omitted."""

    @property
    def points(self):
        return self.delta.size

    @property
    def extent(self):
        return f"delta = {self.points}"

    def compute(self, scene, alone):
        delta = self.delta.values()
        # Eq. (21) of the paper: without delay the maximum passive stiffness is alpha = 2 delta.
        return Outcome(table={"delta": delta, "ratio": zwidth.alpha_max(delta, 0.0).alpha / (2 * delta)})


CONFIG = "{version: 1, name: outside, scene: {delta: 0.5, d: 0}, studies: [{kind: ratio, name: r}]}"


@pytest.fixture
def config(tmp_path):
    file = tmp_path / "outside.yaml"
    file.write_text(CONFIG, encoding="utf-8")
    yield file
    document.KINDS.pop("ratio", None)


def test_external_study_is_run_and_resumed(config, tmp_path, capsys):
    register(RatioStudy)
    out = tmp_path / "out"
    assert run_main("run", config, "--dry-run", "--out", out) == 0
    assert "study r\n  1 points (delta = 1)" in capsys.readouterr().out
    assert run_main("run", config, "--out", out) == 0
    header, row = (out / "r.csv").read_text(encoding="utf-8").split()
    assert header == "delta,ratio"
    np.testing.assert_allclose([float(text) for text in row.split(",")], [0.5, zwidth.alpha_max(0.5, 0).alpha / 1.0])
    entry = json.loads((out / "run.json").read_text(encoding="utf-8"))["studies"][0]
    assert (entry["kind"], entry["state"], list(entry["files"])) == ("ratio", "done", ["r.csv"])
    assert '<p class="soft">Closed forms, without delay.</p>' in zwidth.write_report(out).read_text(encoding="utf-8")
    assert [study.state for study in zwidth.run(config, out=out, resume=True).studies] == ["kept"]
    config.write_text(CONFIG.replace("0.5", "0.6"), encoding="utf-8")
    with pytest.raises(
        StoreError, match=r"studies\[r\]\.delta: the run was created with 0.5, the configuration has 0.6"
    ):
        zwidth.run(config, out=out, resume=True)


def test_external_study_has_errors_and_schema(config):
    register(RatioStudy)
    config.write_text(CONFIG.replace("name: r", "name: r, delta: -1"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"studies\[0\]\.delta: got -1"):
        zwidth.load_config(config)
    assert "RatioStudy" in document.config_json_schema()["$defs"]


def test_external_study_is_found_by_its_entry_point(config, monkeypatch):
    with pytest.raises(ConfigError, match="got 'ratio'; the kinds are"):
        zwidth.load_config(config)
    entry_point = EntryPoint("ratio", f"{__name__}:RatioStudy", "zwidth.studies")
    monkeypatch.setattr(document, "entry_points", lambda group, name: [entry_point] if name == "ratio" else [])
    assert zwidth.load_config(config).studies[0].kind_name() == "ratio"
