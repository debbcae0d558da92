"""The explorer page without a browser: incoming messages, resulting figures and texts."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bokeh", reason="zwidth[explore] is not installed")

from click.testing import CliRunner
from open_pages import open_page, send_message

import zwidth
from zwidth.app.explorer.controls import Controls, read_controls, read_link
from zwidth.cli.commands import cli


@pytest.fixture
def page():
    return open_page(Controls())


def test_drag_updates_only_outline_wall_poles_and_verdict(page):
    send_message(page, serial=1, set={"damping": 20})
    scene = Controls().change({"damping": 20}).scene
    (edge,) = scene.stable_region()
    closed = [*edge[0], edge[0][0], np.nan]
    np.testing.assert_array_equal(page.sources["edge"].data["x"], closed)
    assert page.sources["wall"].data == {"x": [10e3], "y": [40.0]}
    assert page.sources["poles"].data["x"].size == 4
    assert page.texts["word"] == "stable"
    assert page.texts["serial"] == 1
    assert page.queue.tasks == []
    assert len(page.sources["contours"].data["xs"]) == 0


@pytest.mark.parametrize("components", [{}, {"velocity": "LowPass"}])
def test_text_at_rest_agrees_with_check(page, components):
    send_message(page, set=components, rest=True)
    page.queue.work()
    options = ["--velocity-cutoff", "100"] if components else []
    device = ["--mass", "0.1", "--damping", "10", "--period", "1e-3", "--delay", "1e-3"]
    result = CliRunner().invoke(cli, ["check", "--stiffness", "10e3", "--virtual-damping", "40", *device, *options])
    assert page.texts["verdict"] + "\n" == result.stdout
    assert page.texts["busy"] is False
    assert len(page.sources["contours"].data["xs"]) > 3
    assert len(page.sources["passive"].data["x"]) > 3


def test_drag_updates_the_outline_of_a_filtered_scene(page):
    send_message(page, set={"velocity": "LowPass"})
    (outline,) = page.controls.scene.stable_region()
    np.testing.assert_array_equal(page.sources["edge"].data["x"][:-2], outline.stiffness)
    np.testing.assert_array_equal(page.sources["area"].data["ys"][0][0][0][:-1], outline.virtual_damping)


def test_results_of_another_device_are_removed_immediately(page):
    send_message(page, set={}, rest=True)
    page.queue.work()
    assert len(page.sources["ridge"].data["x"]) > 0
    send_message(page, set={"stiffness": 5e3})
    assert len(page.sources["ridge"].data["x"]) > 0
    send_message(page, set={"damping": 11})
    for name in ("contours", "passive", "ridge", "best"):
        assert not any(len(column) for column in page.sources[name].data.values())
    assert page.texts["slopes"] == ""


def test_outdated_computation_is_discarded(page):
    send_message(page, set={"damping": 20}, rest=True)
    send_message(page, set={"damping": 30}, rest=True)
    old, *page.queue.tasks = page.queue.tasks
    old()
    assert "verdict" not in page.texts
    page.queue.work()
    assert "30.00 N s/m" in page.texts["verdict"]


def test_filtered_scene_shows_ridge_and_sensitivities(page):
    send_message(page, set={"velocity": "LowPass"}, rest=True)
    page.queue.work()
    assert len(page.sources["ridge"].data["x"]) > 3
    assert "velocity.cutoff" in page.texts["slopes"]


def test_interrupted_computation_is_repeated_for_the_new_wall(page):
    send_message(page, set={"damping": 11}, rest=True)
    (work,), page.queue.tasks = page.queue.tasks, []
    send_message(page, set={"stiffness": 5e3}, rest=True)
    work()
    assert len(page.sources["ridge"].data["x"]) == 0
    page.queue.work()
    assert len(page.sources["ridge"].data["x"]) > 3


INVALID_MESSAGES = [
    {},
    {"json": []},
    {"json": ["{"]},
    {"json": ["[]"]},
    {"json": ['{"set": 1}']},
    {"json": [7]},
    {"json": ["[" * 3000]},
    {"json": ['{"set": {"mass": 100}}' + " " * 20_000]},
    {"x": [1.0]},
    None,
]


def test_invalid_message_is_reported_and_changes_nothing(page):
    for data in INVALID_MESSAGES:
        before = page.controls
        page.receive(data)
        assert "invalid message" in page.texts["error"], data
        assert page.controls == before, data
        send_message(page, set={"mass": 200})
        assert page.texts["error"] == "", data


def test_invalid_value_keeps_the_last_valid_view(page):
    send_message(page, set={"mass": 200})
    send_message(page, set={"mass": -1})
    assert page.texts["error"].startswith("mass m: got -1 g")
    assert page.texts["state"]["mass"] == 200
    assert page.controls.scene.mass == 0.2


def test_invalid_value_keeps_the_running_computation(page):
    send_message(page, set={"mass": 200}, rest=True)
    send_message(page, set={"mass": -1}, rest=True)
    page.queue.work()
    assert "200.0 g" in page.texts["verdict"]
    assert len(page.sources["contours"].data["xs"]) > 3
    assert page.texts["busy"] is False


def test_failed_computation_is_reported(page, monkeypatch):
    def fail(scene):
        raise ZeroDivisionError("far away")

    monkeypatch.setattr("zwidth.app.explorer.model.assess", fail)
    send_message(page, rest=True)
    page.queue.work()
    assert page.texts["error"].startswith("the computation failed (ZeroDivisionError: far away); ")
    assert page.texts["busy"] is False
    # Results of the previous wall are removed.
    assert page.texts["verdict"] == ""


def test_dark_page_has_different_colors(page):
    send_message(page, dark=True)
    dark = [getattr(glyph, name) for glyph, name, _ in page.inks]
    send_message(page, dark=False)
    assert all(before != getattr(glyph, name) for before, (glyph, name, _) in zip(dark, page.inks, strict=True))


def test_figures_are_exported_as_csv(page):
    send_message(page, set={"velocity": "WindowedDifference"})
    send_message(page, set={"velocity.samples": 24}, rest=True)
    page.queue.work()
    send_message(page, csv="plane")
    rows = [line.split(",") for line in page.texts["csv"].splitlines()]
    assert rows[0] == ["curve", "piece", "stiffness K in N/m", "damping B in N s/m"]
    pieces = [[row for row in rows if row[:2] == ["stable", number]] for number in ("1", "2", "3")]
    outlines = page.controls.scene.stable_region()
    assert [len(piece) for piece in pieces] == [*(outline.stiffness.size + 1 for outline in outlines), 0]
    for piece, outline in zip(pieces, outlines, strict=False):
        np.testing.assert_allclose([float(row[2]) for row in piece[:-1]], outline.stiffness, rtol=1e-7, atol=1e-7)
    assert ["your wall", "1", "10000", "40"] in rows
    send_message(page, csv="gain")
    assert page.texts["csv"].splitlines()[0] == "curve,piece,frequency in Hz,|L| in dB"


def test_link_sets_the_scene_and_an_empty_one_resets_it(page):
    send_message(page, open="mass=200+g&period=2+ms&stiffness=1+kN/m&virtual_damping=3+N+s/m", rest=True)
    assert page.controls.scene.mass == 0.2
    assert page.texts["link"] == "mass=200+g&damping=0+N+s/m&period=2+ms&stiffness=1+kN/m&virtual_damping=3+N+s/m"
    send_message(page, open="mass=heavy&period=1+ms")
    assert "scene.mass: got 'heavy'" in page.texts["error"]
    assert page.controls.scene.mass == 0.2
    send_message(page, open="", rest=True)
    assert page.controls == Controls()


def test_linear_device_is_shown_and_copied(tmp_path):
    file = tmp_path / "system.yaml"
    scene = "{device: 1900 / 0.1 191 1900 0, period: 1 ms, stiffness: 5 kN/m, virtual_damping: 30}"
    file.write_text(f"version: 1\nname: s\nscene: {scene}\nstudies: [{{kind: boundary, name: b}}]\n")
    page = open_page(read_controls(file))
    send_message(page, set={"delay": 0.5}, rest=True, contact=True)
    page.queue.work()
    assert page.texts["error"] == ""
    assert page.texts["busy"] is False
    system = zwidth.LinearDevice(([1900.0], [0.1, 191.0, 1900.0, 0.0]))
    expected = zwidth.Scene(system, zwidth.Timing(1e-3, 0.5e-3), zwidth.VirtualWall(5e3, 30.0))
    assert page.controls.scene == expected
    result = CliRunner().invoke(
        cli,
        "check --device '1900 / 0.1 191 1900 0' --period 1ms --delay 0.5ms --stiffness 5e3 --virtual-damping 30",
    )
    assert page.texts["verdict"] + "\n" == result.stdout
    assert len(page.sources["step"].data["x"]) > 10
    assert len(page.sources["contact"].data["x"]) == 0
    assert "no body" in page.texts["contact_words"]
    # The copied code, link and configuration reproduce the scene.
    names: dict = {}
    exec(page.texts["python"].partition("verdict =")[0], names)
    assert names["scene"] == expected
    assert read_link(page.texts["link"]).scene == expected
    (tmp_path / "copied.yaml").write_text(page.texts["yaml"])
    assert zwidth.load_config(tmp_path / "copied.yaml").scene.to_scene() == expected  # pyright: ignore
    for name, value in (("mode", "normalized"), ("coupling", "tip"), ("motion", "rotary"), ("operator", "rigid")):
        with pytest.raises(zwidth.InputError, match=f"^{name}: "):
            page.controls.change({name: value})
