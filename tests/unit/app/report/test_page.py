"""The HTML report of a run: contents, content security policy, and errors for damaged or missing files."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil

import numpy as np
import pytest
from click.testing import CliRunner
from sweeping import PLANES, study

import zwidth
from zwidth.cli.commands import cli
from zwidth.core.errors import StoreError
from zwidth.studies import Config

PLANE = study("plane", PLANES, ("stable", "spectral_radius"))
TOP = {"kind": "ridge", "name": "top", "delta": [0, 1], "d": 1}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "it"
    text = "<script>alert('x')</script>"
    config = {"version": 1, "name": "example", "description": text, "studies": [TOP, PLANE]}
    zwidth.run(Config.model_validate(config), out=folder)
    return folder


@pytest.fixture(scope="module")
def page(run):
    return zwidth.write_report(run).read_text(encoding="utf-8")


def test_page_loads_nothing_and_allows_only_its_own_script_and_style(page):
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page)
    assert policy is not None
    assert policy[1].startswith("default-src 'none'; img-src data:;")
    assert "unsafe" not in policy[1]
    for element in ("style", "script"):
        (text,) = re.findall(rf"<{element}>(.*?)</{element}>", page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{element}-src 'sha256-{digest}'" in policy[1]
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)


def test_configuration_texts_are_escaped(page):
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page


def test_page_contains_figures_versions_and_studies(page):
    assert 'src="data:image/svg+xml;base64,' in page
    assert 'id="top"' in page
    assert 'id="plane"' in page
    assert zwidth.__version__ in page


def test_page_contains_the_answer_of_a_study(tmp_path):
    device = {"mass": 0.1, "damping": 10, "period": 1e-3, "delay": 1e-3}
    config = {"version": 1, "name": "r", "scene": device, "studies": [{"kind": "recommend", "name": "wall"}]}
    result = zwidth.run(Config.model_validate(config), out=tmp_path / "r")
    answer_lines = result.studies[0].answer
    assert answer_lines[0].startswith("K = 7.989 kN/m")
    page = zwidth.write_report(result.folder).read_text(encoding="utf-8")
    assert all(f"<p>{line}</p>" in page for line in answer_lines)


def test_slices_agree_with_the_store(run, page):
    blocks = [json.loads(text) for text in re.findall(r'<script type="application/json">(.*?)</script>', page)]
    # Blocks have the order of all outputs, not that of the store.
    assert [block["name"] for block in blocks] == ["stable", "spectral_radius"]
    blocks_by_name = {block["name"]: block for block in blocks}
    block_radius = blocks_by_name["spectral_radius"]
    values = np.frombuffer(base64.b64decode(block_radius["values"]), "<f4").reshape(2, 20, 30)
    with zwidth.open_dataset(run / "plane.zarr") as data:
        stored = data["spectral_radius"].squeeze("d", drop=True) if "d" in data.dims else data["spectral_radius"]
        expected = stored.transpose("delta", "beta", "alpha").values
    np.testing.assert_allclose(values, expected, rtol=1e-6)
    assert block_radius["others"][0]["values"] == [0.1, 0.5]
    assert blocks_by_name["stable"]["truth"] is True
    for edges, delta in zip(block_radius["edges"], (0.1, 0.5), strict=True):
        region = zwidth.stable_region(delta, 1.0)
        ((ring,), (passive, *_)) = (
            [np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 2) for text in edges[name]]
            for name in ("stable", "passive")
        )
        np.testing.assert_allclose(ring, np.stack([region.alpha, region.beta], -1), rtol=1e-6, atol=1e-7)
        alpha, beta = passive.astype(float).mean(0)
        assert zwidth.is_passive(alpha, beta, delta, 1.0)


def test_folder_without_a_run_raises(tmp_path):
    with pytest.raises(StoreError, match="contains no run"):
        zwidth.write_report(tmp_path)


def test_command_reports_its_file(run, tmp_path):
    result = CliRunner().invoke(cli, ["report", str(run), "--out", str(tmp_path / "it.html"), "--json"])
    assert result.exit_code == 0
    assert json.loads(result.output)["bytes"] == (tmp_path / "it.html").stat().st_size


def test_damaged_or_missing_files_raise(run, tmp_path):
    damages = {
        "run.json is damaged": lambda out: replace_in_file(out / "run.json", '"seconds": ', '"seconds": 1'),
        "config.yaml is damaged": lambda out: replace_in_file(out / "config.yaml", "num: 30", "num: 31"),
        "config.yaml is missing": lambda out: (out / "config.yaml").unlink(),
        "plane.zarr is missing": lambda out: shutil.rmtree(out / "plane.zarr"),
        "plane.zarr: chunks are missing": lambda out: shutil.rmtree(out / "plane.zarr" / "status" / "c"),
        "top.svg is damaged": lambda out: replace_in_file(out / "top.svg", "</svg>", "</svg> "),
    }
    for number, (message, damage) in enumerate(damages.items()):
        out = tmp_path / str(number)
        shutil.copytree(run, out, ignore=shutil.ignore_patterns("report.html"))
        damage(out)
        with pytest.raises(StoreError, match=f"{re.escape(message)}.*'zwidth run CONFIG --resume'"):
            zwidth.write_report(out)
        assert not (out / "report.html").exists()


def replace_in_file(file, old, new):
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")


def test_linked_store_is_not_shown(run, tmp_path):
    shutil.copytree(run, tmp_path / "out")
    (tmp_path / "out" / "plane.zarr").rename(tmp_path / "elsewhere.zarr")
    (tmp_path / "out" / "plane.zarr").symlink_to(tmp_path / "elsewhere.zarr")
    text = zwidth.write_report(tmp_path / "out").read_text(encoding="utf-8")
    assert "plane.zarr is a link and is not shown" in text
    assert "application/json" not in text


def test_labeled_devices_are_sliders_by_name(tmp_path):
    devices = {"label": ["=one", "two"], "mass": [0.1, 0.2], "damping": [1, 2]}
    axes = {"devices": devices, "rate": "1 kHz", "delay": "1 periods", "stiffness": [1e3, 2e3, 3e3]}
    study = {"kind": "sweep", "name": "s", "axes": axes | {"virtual_damping": [0, 1, 2]}, "outputs": ["stable"]}
    zwidth.run({"version": 1, "name": "n", "studies": [study]}, out=tmp_path / "out")
    text = zwidth.write_report(tmp_path / "out").read_text(encoding="utf-8")
    slices = [
        json.loads(text_block) for text_block in re.findall(r'<script type="application/json">(.*?)</script>', text)
    ]
    assert [other["values"] for other in slices[0]["others"]] == [["=one", "two"]]


def test_walls_without_result_are_nan_in_slices(tmp_path):
    """Walls out of range are not shown as unstable; the settling time of an unstable wall is infinite."""
    axes = {"alpha": [0.1, 0.9, 1e61], "beta": [0.1, 0.2], "delta": 0.1, "d": 1}
    outputs = ["stable", "settling_time"]
    study = {"kind": "sweep", "name": "s", "axes": axes, "outputs": outputs}
    zwidth.run({"version": 1, "name": "far", "studies": [study]}, out=tmp_path / "run")
    text = zwidth.write_report(tmp_path / "run").read_text(encoding="utf-8")
    for block in re.findall(r'<script type="application/json">(.*?)</script>', text, re.DOTALL):
        content = json.loads(block)
        values = np.frombuffer(base64.b64decode(content["values"]), "<f4").reshape(2, 3)
        values = values if content["x"]["values"] == axes["alpha"] else values.reshape(3, 2).T
        assert np.isnan(values[:, 2]).all()
        expected = [1.0, 0.0] if content["name"] == "stable" else [values[0, 0], np.inf]
        np.testing.assert_array_equal(values[0, :2], expected)
    assert len(re.findall(r'<script type="application/json">', text)) == 2


def test_sweep_over_one_parameter_has_a_curve(tmp_path):
    top = study("top", {"delta": [0.0, 0.5, 1.0], "d": 1.0}, ("alpha_max",))
    plane = study(
        "tops", {"delta": {"linear": {"start": 0, "stop": 1, "num": 8}}, "d": [0, 1, 2, 3, 4, 5, 6]}, ("alpha_max",)
    )
    config = {"version": 1, "name": "example", "studies": [top, plane]}
    zwidth.run(Config.model_validate(config), out=tmp_path)
    page = zwidth.write_report(tmp_path).read_text(encoding="utf-8")
    assert "<figcaption>top_alpha_max</figcaption>" in page
    assert "<figcaption>tops_alpha_max</figcaption>" not in page
    assert page.count('<div class="slices">') == 1
    assert "exact boundary" not in page


def test_date_of_the_run_is_readable(page):
    assert re.search(r"Computed on \d{4}-\d\d-\d\d at \d\d:\d\d UTC, in float64", page)


def test_study_not_started_is_listed_as_missing(tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("zwidth.studies.boundary.BoundaryStudy.compute", interrupt)
    walls = [{"kind": "boundary", "name": name, "delta": 0.1, "d": 1} for name in ("walls", "more")]
    assert zwidth.run({"version": 1, "name": "example", "studies": [TOP, *walls]}, out=tmp_path).interrupted
    page = zwidth.write_report(tmp_path).read_text(encoding="utf-8")
    for name in ("walls", "more"):
        assert f"<strong>{name} is missing</strong> because it is not finished; " in page


def test_failed_study_is_reported_without_a_section(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise ValueError("<no luck>")

    monkeypatch.setattr("zwidth.studies.ridge.RidgeStudy.compute", fail)
    walls = {"kind": "boundary", "name": "walls", "delta": 0.1, "d": 1}
    assert not zwidth.run({"version": 1, "name": "example", "studies": [TOP, walls]}, out=tmp_path).ok
    page = zwidth.write_report(tmp_path).read_text(encoding="utf-8")
    assert "<strong>top is missing</strong> because it failed: ValueError: &lt;no luck&gt;; " in page
    assert 'id="top"' not in page
    assert 'id="walls"' in page


def test_slices_have_the_colors_of_the_figure(tmp_path):
    """The color scale of alpha_max covers its range; that of a time ends at 100 times its minimum, with an arrow."""
    wide = {"delta": [1e-6, 1.0, 1e5], "d": [0.0, 4.0, 20.0]}
    walls = {"alpha": {"log": {"start": 1e-5, "stop": 0.3, "num": 40}}, "beta": [0.1, 0.2, 0.4], "delta": 0.1, "d": 1}
    outputs = ("settling_time", "delay_margin", "spectral_radius")
    studies = [study("tops", wide, ("alpha_max",)), study("walls", walls, outputs)]
    zwidth.run({"version": 1, "name": "example", "studies": studies}, out=tmp_path)
    page = zwidth.write_report(tmp_path).read_text(encoding="utf-8")
    blocks = {block["name"]: block for block in map(json.loads, re.findall(r"<script type=.*?>(\{.*?)</script>", page))}
    for store, names in (("tops", ("alpha_max",)), ("walls", outputs)):
        with zwidth.open_dataset(tmp_path / f"{store}.zarr") as data:
            for name in names:
                (ax,) = zwidth.plotting.draw_plane(data, name)
                image, bar = ax.collections[0], ax.figure.axes[-1]
                assert blocks[name]["low"] == pytest.approx(image.norm.vmin, rel=1e-6)
                assert blocks[name]["high"] == pytest.approx(image.norm.vmax, rel=1e-6)
                shown = image.cmap(np.linspace(0, 1, len(blocks[name]["colors"])))
                drawn = [[int(hex_[k : k + 2], 16) for k in (0, 2, 4)] for hex_ in blocks[name]["colors"]]
                np.testing.assert_allclose(drawn, 255 * shown[:, :3], atol=0.51)
                assert bar.get_label() == "<colorbar>"
                assert blocks[name]["extend"] == bar._colorbar.extend
    assert blocks["alpha_max"]["high"] > 1e4 * blocks["alpha_max"]["low"]
    assert blocks["settling_time"]["extend"] == "max"
    assert "higher values: arrow" in page
