"""Figures of stored sweeps: which are drawn, their contents and slices."""

import json

import numpy as np
import pytest
from chunks import fail_on_2
from matplotlib.figure import Figure
from sweeping import make_config, run_main, run_sweeps, study

import zwidth
from zwidth.core.errors import InputError, StoreError
from zwidth.plotting import draw_curves, draw_outlines, draw_plane
from zwidth.runs import draw
from zwidth.runs.draw import draw_stores
from zwidth.sweep.dataset import open_dataset

PLANE = {
    "alpha": {"linear": {"start": 0.01, "stop": 1.0, "num": 15}},
    "beta": {"linear": {"start": -0.2, "stop": 1.0, "num": 13}},
    "delta": [0.05, 0.1, 0.5, 1.0],
    "d": [0, 1],
}
SURFACE = {"delta": {"log": {"start": 0.01, "stop": 4, "num": 9}}, "d": {"linear": {"start": 0, "stop": 4, "num": 8}}}
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
    assert run_sweeps(make_config(*studies), folder).ok
    return folder


@pytest.fixture(scope="module")
def plane(folder):
    """Return the results over walls, devices and delays."""
    return open_dataset(folder / "plane.zarr").load()


def color_values(axes):
    """Return the values drawn as colors, per panel."""
    return [ax.collections[0].get_array() for ax in axes]


def titles(axes):
    return [ax.get_title(loc="left") for ax in axes]


def test_every_sweep_is_drawn(folder, tmp_path, monkeypatch):
    reported = []
    # Do not write the files, which is slow and tested elsewhere.
    monkeypatch.setattr(
        draw, "save", lambda drawn, stem, *_, **__: (stem.with_suffix(".png"), stem.with_suffix(".svg"))
    )
    files = draw_stores(folder, tmp_path, progress=reported.append)
    assert reported == list(files)
    names = {file.stem for file in files}
    assert names == {
        *(f"plane_{name}" for name in ALL if name not in ("kind", "passive")),
        *("plane_boundaries", "surface_alpha_max", "devices_stiffness_max", "devices_virtual_damping_at_max"),
    }
    assert {file.suffix for file in files} == {".png", ".svg"}


def test_panels_of_nearly_equal_values_have_distinct_titles(plane):
    close = plane.assign_coords(d=[1.0, 1.00001], delta=[0.1, 0.100002, 0.5, 1.0])
    panel_titles = titles(draw_plane(close, "margin"))
    assert panel_titles[0] == r"$d = 1$,  $\delta = 0.1$"
    assert len(set(panel_titles)) == len(panel_titles)


def test_panels_of_inertias_have_their_unit(tmp_path):
    walls = {"stiffness": ["10 N m/rad", "100 N m/rad"], "virtual_damping": ["0 N m s/rad", "0.1 N m s/rad"]}
    inertias = {"mass": ["2000 g cm^2", "4500 g cm^2"], "damping": "1 mN m s/rad", "period": "1 ms"}
    config = {"version": 1, "name": "turning", "studies": [study("turned", axes=walls | inertias, outputs=("margin",))]}
    zwidth.run(config, out=tmp_path)
    axes = draw_plane(open_dataset(tmp_path / "turned.zarr"), "margin")
    axes[0].figure.draw_without_rendering()
    for title, inertia in zip(titles(axes), (2000, 4500), strict=True):
        assert rf"$J = {inertia}\,\mathrm{{g~cm^2}}$" in title


def test_plane_agrees_with_the_store(plane):
    axes = draw_plane(plane, "margin")
    # Both delays, and three of the four dampings.
    selections = [{"d": d, "delta": delta} for d in (0, 1) for delta in (0, 2, 3)]
    assert titles(axes) == [rf"$d = {d}$,  $\delta = {delta}$" for d in (0, 1) for delta in (0.05, 0.5, 1)]
    peaks = []
    for selection, ax, mesh in zip(selections, axes, color_values(axes), strict=True):
        np.testing.assert_array_equal(mesh, plane.margin.isel(selection).values.T)
        peaks += [line.get_xydata().tolist() for line in ax.lines if line.get_label() == "stiffest stable wall"]
        wall = plane[["alpha_max", "beta_at_max"]].isel(selection)
        # Without delay the maximum at the third damping lies outside of the axes.
        if wall.alpha_max <= plane.alpha.max() and wall.beta_at_max <= plane.beta.max():
            assert peaks[-1] == [[float(wall.alpha_max), float(wall.beta_at_max)]]
    assert 0 < len(peaks) < 6


def test_region_is_bounded_by_a_contour_of_the_margin(plane):
    axes = draw_plane(plane, "stable")
    figure = axes[0].figure
    assert list(figure.axes) == list(axes)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["stable", "passive", "stiffest stable wall"]
    assert figure.get_supxlabel() == r"normalized stiffness  $\alpha = K\,T^2\!/m$"
    np.testing.assert_array_equal(color_values(axes)[0], plane.stable.isel(d=0, delta=0).values.T)
    # A contour of booleans runs along or midway between grid lines, that of the margin anywhere.
    edge, step = axes[0].collections[1].get_paths()[0].vertices, float(np.diff(plane.alpha)[0])
    offset = np.abs(edge[:, :1] - plane.alpha.values).min(axis=1) / step
    assert np.count_nonzero((offset > 0.01) & (offset < 0.49)) > 3


def test_part_of_a_dataset_is_drawn_into_given_axes(plane):
    figure = Figure(layout="constrained")
    left, right = figure.subplots(1, 2)
    part = plane.sel(d=1, delta=0.1)
    assert list(draw_plane(part, "margin", left)) == [left]
    np.testing.assert_array_equal(color_values([left])[0], part.margin.values.T)
    assert left.get_title(loc="left") == r"$d = 1$,  $\delta = 0.1$"
    assert left.get_xlabel()
    assert left.get_ylabel()
    assert list(draw_curves(part.isel(beta=3), "margin", right)) == [right]
    np.testing.assert_array_equal(right.lines[0].get_ydata(), part.margin.isel(beta=3).values)
    # The data must not be modified.
    assert "units" in plane.alpha.attrs
    assert "factor" not in plane.alpha.attrs


def test_every_device_has_its_boundary(plane):
    part = plane.sel(d=1)
    (ax,) = draw_outlines(part, Figure().subplots())
    assert [text.get_text() for text in ax.get_legend().get_texts()] == [
        rf"$\delta = {delta}$" for delta in (0.05, 0.1, 0.5, 1)
    ]
    assert len(ax.collections) == 4
    for outline, device in zip(ax.collections, range(4), strict=True):
        for alpha, beta in outline.get_paths()[0].vertices[::5]:
            # The end of a line may lie outside of the grid by a rounding error.
            alpha = np.clip(alpha, part.alpha.min(), part.alpha.max())
            beta = np.clip(beta, part.beta.min(), part.beta.max())
            # Between grid points the margin is nearly linear.
            assert abs(float(part.margin.isel(delta=device).interp(alpha=alpha, beta=beta))) < 1e-3


@pytest.mark.parametrize("draw", [draw_plane, lambda data, name: draw_curves(data.isel(alpha=0), name)])
def test_figure_of_a_single_value_raises(plane, draw):
    with pytest.raises(InputError, match="'stable' varies over"):
        draw(plane.isel(beta=0, delta=0, d=0), "stable")
    with pytest.raises(InputError, match="contains no boundaries of several devices"):
        draw_outlines(plane.isel(delta=0, d=0))


def test_slices_are_at_the_nearest_values(folder, capsys, tmp_path, monkeypatch):
    figures = []
    with monkeypatch.context() as patch:
        patch.setattr(draw, "save", lambda drawn, stem, *_, **__: figures.append((stem.name, drawn)) or ())
        notes: list[str] = []
        draw_stores(folder / "devices.zarr", tmp_path, selection={"rate": "2.1 kHz"}, note=notes.append)
        draw_stores(folder / "devices.zarr", tmp_path, selection={"rate": "2kHz"}, note=notes.append)
        draw_stores(folder / "plane.zarr", tmp_path, selection={"delta": "0.12", "d": 0.9})
        draw_stores(folder / "devices.zarr", tmp_path, selection={"device": "heavy"})
    assert notes == ["devices.zarr: rate = 2000 Hz, the value of the sweep nearest to 2.1 kHz"]
    drawn = dict(figures)
    assert titles(drawn["plane_stable"]) == [r"$d = 1$,  $\delta = 0.1$"]
    assert titles(drawn["devices_stiffness_max"]) == ["heavy"]
    arguments = ["figures", folder / "plane.zarr", "--at", "delta=0.12", "--at", "d=1", "--out", tmp_path, "--json"]
    assert run_main(*arguments) == 0
    assert len(json.loads(capsys.readouterr().out)["files"]) == 8
    assert all(file.stat().st_size > 1000 for file in tmp_path.iterdir())


def test_curves_have_readable_units(folder):
    kept = open_dataset(folder / "devices.zarr")
    axes = draw_curves(kept, "stiffness_max")
    figure = axes[0].figure
    assert figure.get_supylabel() == r"maximum stable stiffness  $K_{\max}$  in kN/m"
    assert figure.get_supxlabel() == "sampling rate  $1/T$  in kHz"
    for index, line in enumerate(axes[1].lines):
        np.testing.assert_allclose(line.get_xdata(), [1, 2, 4])
        np.testing.assert_allclose(line.get_ydata(), kept.stiffness_max.isel(device=1, delay=index).values / 1000)
    names = [r"$t_d = 0\,\mathrm{periods}$", r"$t_d = 1\,\mathrm{period}$"]
    assert [line.get_label() for line in axes[0].lines] == names
    assert [text.get_text() for text in figure.legends[0].get_texts()] == names


def test_missing_points_are_blank_and_in_the_legend(tmp_path):
    axes = {**PLANE, "alpha": {"linear": {"start": 0.01, "stop": 1.0, "num": 2000}}, "delta": [0.1], "d": [0, 1, 2]}
    run_sweeps(make_config(study(axes=axes)), tmp_path, perform=fail_on_2)
    drawn = draw_plane(open_dataset(tmp_path), "stable")
    assert any(np.ma.getmaskarray(mesh).any() for mesh in color_values(drawn))
    # A grid finer than the page is thinned.
    assert [mesh.shape for mesh in color_values(drawn)] == [(13, 500)] * 3
    assert "no result" in [text.get_text() for text in drawn[0].figure.legends[0].get_texts()]


@pytest.mark.parametrize(
    "at, message",
    [
        ({"mu": 1}, "at: no sweep in .* varies 'mu'; choose from .*d, delta"),
        ({"delta": "x"}, "at: delta: got 'x'; write a number$"),
        ({"rate": "2 ms"}, "at: rate: got '2 ms'; the units allowed are Hz, kHz, MHz"),
        ({"delay": "1 ms"}, "at: delay: got '1 ms'; write a number of sampling periods, because the period varies"),
        ({"delay": "1 kg"}, "at: delay: got '1 kg'; the units allowed are s, ms"),
        ({"delta": "nan"}, "at: delta: got 'nan'; write a finite number"),
        ({"device": "x"}, "at: no device 'x' in the sweep; choose from light, heavy"),
    ],
)
def test_invalid_slices_raise(folder, tmp_path, at, message):
    with pytest.raises(InputError, match=message):
        draw_stores(folder, tmp_path / "no", selection=at)
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("delay", ["1 ms", "1ms", "1 periods", "1", 1])
def test_delay_in_periods_is_selected_with_any_unit(tmp_path, delay):
    axes = {
        "mass": 0.1,
        "damping": 10,
        "period": "1 ms",
        "delay": ["0 periods", "1 periods"],
        "stiffness": {"linear": {"start": 100, "stop": 20e3, "num": 7}},
        "virtual_damping": {"linear": {"start": 0, "stop": 80, "num": 7}},
    }
    run_sweeps(make_config(study(axes=axes)), tmp_path)
    data = open_dataset(tmp_path)
    assert draw._find_nearest(data.reset_coords(drop=True), "delay", delay) == (1, True)


def test_folder_without_stores_raises(tmp_path, capsys):
    with pytest.raises(StoreError, match="contains no store of a sweep"):
        draw_stores(tmp_path)
    assert run_main("figures", tmp_path) == 2
    assert run_main("figures", tmp_path, "--at", "delta") == 2
    assert "write NAME=VALUE, such as delta=0.1" in capsys.readouterr().err
