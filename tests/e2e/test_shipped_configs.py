"""Every shipped configuration, with fewer points, through run, rerun, resume, export, verify, report and explorer."""

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from unpainted import painting_nothing

import zwidth
from zwidth.core.errors import InputError
from zwidth.plotting import style
from zwidth.runs.draw import draw_stores
from zwidth.sweep.dataset import to_csv, to_netcdf, verify

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
# Only these files contain times and host information.
TIMESTAMPED = ("run.json", "zarr.json", "zwidth.json")


def shrink(text: str) -> str:
    """Keep the first study of each kind, with at most four values per axis and shorter simulations."""
    text = re.sub(r"num: (\d+)", lambda match: f"num: {min(int(match[1]), 4)}", text)
    text = re.sub(r"((?:samples|cutoff|damping): \[[^,\]]+, [^,\]]+)[^\]]*\]", r"\1]", text)
    text = re.sub(r"duration: (\d+)00 periods", r"duration: \g<1>0 periods", text)
    head, *studies = re.split(r"(?m)^(?=  - kind: )", text)
    kinds = {study.split()[2]: study for study in reversed(studies)}
    return head + "".join(study for study in studies if study in kinds.values())


def read_results(folder):
    files = [path for path in folder.rglob("*") if path.is_file() and path.name not in TIMESTAMPED]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files if ".locks" not in path.parts}


@pytest.fixture(params=sorted(path.stem for path in CONFIGS.glob("*.yaml")))
def config(request, tmp_path):
    """Copy of the configuration next to the files that it reads."""
    for file in CONFIGS.glob("*.csv"):
        shutil.copy(file, tmp_path)
    text = (CONFIGS / f"{request.param}.yaml").read_text(encoding="utf-8")
    (tmp_path / "shrunk.yaml").write_text(shrink(text), encoding="utf-8")
    return tmp_path / "shrunk.yaml"


def test_shipped_configuration_reruns_resumes_and_exports(config, tmp_path, monkeypatch, fitted_once):
    monkeypatch.setattr(style, "PNG_DPI", 40)
    first = zwidth.run(config, out=tmp_path / "first")
    assert [study.error for study in first.failed] == []
    assert {study.state for study in first.studies} == {"done"}
    before = read_results(first.folder)

    # Rerun from the copy in the run's own folder, after moving it.
    config.unlink()
    for file in tmp_path.glob("*.csv"):
        file.unlink()
    moved = first.folder.rename(tmp_path / "moved")
    # Figures are not drawn again: equal numbers give equal figures, which the plotting tests check.
    with painting_nothing():
        second = zwidth.run(moved / "config.yaml", out=tmp_path / "second")
    assert second.ok
    names = {name: name.encode() for name in before if name.endswith((".png", ".svg"))}
    assert read_results(second.folder) == before | names
    resumed = zwidth.run(second.folder / "config.yaml", out=moved, resume=True)
    assert {study.state for study in resumed.studies} <= {"kept", "done"}
    assert read_results(moved) == before

    for store in sorted(moved.glob("*.zarr")):
        to_netcdf(store, tmp_path / f"{store.stem}.nc")
        to_csv(store, tmp_path / f"{store.stem}.csv")
    if list(moved.glob("*.zarr")):
        assert all(report.ok for report in verify(moved))
        assert draw_stores(moved, formats=("png",))
    page = zwidth.write_report(moved).read_text(encoding="utf-8")
    assert all(f'id="{study.name}"' in page for study in first.studies)


def test_shipped_configuration_opens_in_the_explorer(config, tmp_path):
    pytest.importorskip("bokeh", reason="zwidth[explore] is not installed")
    from open_pages import open_page, send_message

    from zwidth.app.explorer.controls import read_controls

    scene = zwidth.load_config(config).scene
    if scene is None or getattr(scene, "device", None) is not None:
        with pytest.raises(InputError, match="scene: missing" if scene is None else "a response or a sampled system"):
            read_controls(config)
        return
    page = open_page(read_controls(config))
    send_message(page, set={}, rest=True)
    page.queue.work()
    assert page.texts["error"] == ""
    assert page.texts["word"].upper() in page.texts["verdict"]


def test_velocity_filter_configuration_comments_are_correct():
    section: Any = zwidth.load_config(CONFIGS / "velocity_filter.yaml").scene
    scene = section.to_scene().replace(damping=10.0)

    def has_zero_damping_at_maximum(velocity):
        return scene.replace(velocity=velocity).max_stiffness().virtual_damping == 0.0

    windows = {count: zwidth.WindowedDifference(count) for count in (9, 10, 20, 21, 24, 25, 34, 35)}
    assert [count for count, velocity in windows.items() if has_zero_damping_at_maximum(velocity)] == [
        10,
        20,
        21,
        24,
        35,
    ]
    assert [count for count, velocity in windows.items() if scene.replace(velocity=velocity).islands()] == [21, 24]
    assert [has_zero_damping_at_maximum(zwidth.LowPass(cutoff)) for cutoff in (15.0, 16.0)] == [True, False]
