"""Figures from the store of a sweep: which there are, what they show, and at which slices."""

import json

import numpy as np
import pytest

from sweeping import config_of, failing_on_2, main_of, run_sweeps, study
from zwidth.errors import InputError, StoreError
from zwidth.figures.curves import draw_curves
from zwidth.figures.plane import draw_plane
from zwidth.runs import draw
from zwidth.runs.draw import _View, draw_stores
from zwidth.sweep.store import open_dataset

PLANE = {
    "alpha": {"linear": {"start": 0.01, "stop": 1.0, "num": 15}},
    "beta": {"linear": {"start": -0.2, "stop": 1.0, "num": 13}},
    "delta": [0.05, 0.1, 0.5, 1.0],
    "d": [0, 1],
}
SURFACE = {
    "delta": {"log": {"start": 0.01, "stop": 4, "num": 9}},
    "d": {"linear": {"start": 0, "stop": 4, "num": 8}},
}
DEVICES = {
    "devices": {"label": ["light", "heavy"], "mass": [0.1, 1], "damping": [1, 2]},
    "rate": [1000, 2000, 4000],
    "delay": ["0 periods", "1 periods"],
}
ALL = ("stable", "spectral_radius", "margin", "settling_time", "passive", "alpha_max", "beta_at_max", "kind")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    studies = [
        study("plane", axes=PLANE, outputs=ALL),
        study("surface", axes=SURFACE, outputs=("alpha_max", "kind")),
        study("devices", axes=DEVICES, outputs=("stiffness_max", "virtual_damping_at_max")),
        study("point", axes={"alpha": 0.1, "beta": 0.1, "delta": 0.1, "d": 1}),
    ]
    assert run_sweeps(config_of(*studies), folder).ok
    return folder


@pytest.fixture(scope="module")
def view(folder):
    return _View(open_dataset(folder / "plane.zarr"), {})


def test_every_sweep_is_drawn(folder, tmp_path, monkeypatch):
    told = []
    # To write the files takes longer than all the rest; another test does.
    monkeypatch.setattr(draw, "save", lambda figure, stem: (stem.with_suffix(".png"), stem.with_suffix(".svg")))
    files = draw_stores(folder, tmp_path, progress=told.append)
    assert told == list(files)
    names = {file.stem for file in files}
    assert names == {
        *(f"plane_{name}" for name in ALL if name not in ("kind", "passive")),
        *("plane_boundaries", "surface_alpha_max", "devices_stiffness_max", "devices_virtual_damping_at_max"),
    }
    assert {file.suffix for file in files} == {".png", ".svg"}


def test_a_plane_holds_the_values_of_the_store(folder, view):
    data = view._plane("margin")
    kept = open_dataset(folder / "plane.zarr")
    assert (data.x.name, data.y.name, data.columns) == ("alpha", "beta", 3)
    # Two delays, and three of the four dampings.
    assert len(data.panels) == 6
    place = {"d": 1, "delta": 3}
    assert data.panels[5].title == r"$d = 1$,  $\delta = 1$"
    np.testing.assert_array_equal(data.panels[5].fields["margin"], kept.margin.isel(place).values.T)
    peak = kept[["alpha_max", "beta_at_max"]].isel(place)
    assert data.panels[5].peak == (float(peak.alpha_max), float(peak.beta_at_max))
    # Its stiffest wall lies beyond the axis.
    assert data.panels[2].peak is None


def test_a_region_is_bounded_by_the_contour_of_a_number(view):
    data = view._plane("stable")
    assert set(data.panels[0].fields) == {"stable", "passive", "margin"}
    figure = draw_plane(data, view._quantity("stable"))
    assert len(figure.axes) == 6
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["stable", "passive", "stiffest stable wall"]
    assert figure.get_supxlabel() == r"normalized stiffness  $\alpha = K\,T^2\!/m$"


def test_slices_are_the_nearest_values(folder, capsys, tmp_path):
    view = _View(open_dataset(folder / "plane.zarr"), {"delta": "0.12", "d": 0.9})
    (panel,) = view._plane("stable").panels
    assert panel.title == r"$d = 1$,  $\delta = 0.1$"
    words = ["figures", folder / "plane.zarr", "--at", "delta=0.12", "--at", "d=1", "--out", tmp_path, "--json"]
    assert main_of(*words) == 0
    assert len(json.loads(capsys.readouterr().out)["files"]) == 8
    assert all(file.stat().st_size > 1000 for file in tmp_path.iterdir())
    device = _View(open_dataset(folder / "devices.zarr"), {"device": "heavy"})
    curves = device._curves("stiffness_max", device._quantity("stiffness_max"))
    assert [panel.title for panel in curves.panels] == ["heavy"]


def test_curves_have_units_one_can_read(folder):
    view = _View(open_dataset(folder / "devices.zarr"), {})
    quantity = view._quantity("stiffness_max")
    assert quantity.label == r"maximum stable stiffness  $K_{\max}$  in kN/m"
    data = view._curves("stiffness_max", quantity)
    assert data.x.label == "sampling rate  $1/T$  in kHz"
    np.testing.assert_allclose(data.x.values, [1, 2, 4])
    kept = open_dataset(folder / "devices.zarr").stiffness_max.isel(device=1).transpose("delay", "rate").values
    np.testing.assert_allclose(data.panels[1].fields["stiffness_max"], kept / 1000)
    figure = draw_curves(data, quantity)
    assert [line.get_label() for line in figure.axes[0].lines] == [
        r"$t_d = 0\,\mathrm{periods}$", r"$t_d = 1\,\mathrm{periods}$"
    ]  # fmt: skip


def test_what_is_not_computed_is_left_blank_and_said(tmp_path):
    axes = {**PLANE, "alpha": {"linear": {"start": 0.01, "stop": 1.0, "num": 2000}}, "delta": [0.1], "d": [0, 1, 2]}
    run_sweeps(config_of(study(axes=axes)), tmp_path, perform=failing_on_2)
    view = _View(open_dataset(tmp_path), {})
    data = view._plane("stable")
    assert any((panel.fields["stable"] < 0).any() for panel in data.panels)
    # A grid finer than a page is thinned.
    assert data.x.values.size == 500
    figure = draw_plane(data, view._quantity("stable"))
    assert "not computed" in [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.parametrize(
    "at, says",
    [
        ({"mu": 1}, "at: no sweep in .* varies 'mu'; choose from .*d, delta"),
        ({"delta": "x"}, "at: delta: got 'x'; write a number in 1"),
        ({"delta": "nan"}, "at: delta: got 'nan'; write a finite number"),
        ({"device": "x"}, "at: there is no device 'x'; choose from light, heavy"),
    ],
)
def test_slices_that_do_not_exist_are_refused(folder, tmp_path, at, says):
    with pytest.raises(InputError, match=says):
        draw_stores(folder, tmp_path / "no", at=at)
    assert not (tmp_path / "no").exists()


def test_a_folder_without_stores_is_refused(tmp_path, capsys):
    with pytest.raises(StoreError, match="holds no store of a sweep"):
        draw_stores(tmp_path)
    assert main_of("figures", tmp_path) == 2
    assert main_of("figures", tmp_path, "--at", "delta") == 2
    assert "write NAME=VALUE, as in delta=0.1" in capsys.readouterr().err
