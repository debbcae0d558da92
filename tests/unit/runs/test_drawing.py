"""Options for figures of sweeps: slices, axes, file formats and sizes, and the messages if no figure is possible."""

import matplotlib
import numpy as np
import pytest
from matplotlib.image import imread
from sweeping import make_config, run_main, run_sweeps, study

from zwidth.core.errors import InputError
from zwidth.plotting import draw_curves, draw_plane
from zwidth.plotting.grid import name_panels
from zwidth.plotting.style import figure_of, new_figure
from zwidth.runs import draw
from zwidth.runs.draw import draw_stores
from zwidth.sweep.dataset import open_dataset

AXES = {
    "mass": [0.1, 0.2, 0.5],
    "damping": {"linear": {"start": 1, "stop": 10, "num": 7}},
    "rate": {"log": {"start": 500, "stop": 4000, "num": 8}},
    "delay": ["0 periods", "1 periods"],
}
WALLS = {"alpha": [0.1, 0.5, 0.9], "beta": [0.1, 0.4], "delta": [0.05, 0.1, 0.2, 0.4], "d": [0, 1]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    studies = [
        study("ridge", axes=AXES, outputs=("stiffness_max", "kind")),
        study("walls", axes=WALLS, outputs=("stable", "margin")),
        study("point", axes={"alpha": 0.1, "beta": 0.1, "delta": 0.1, "d": 1}),
    ]
    assert run_sweeps(make_config(*studies), folder).ok
    return folder


@pytest.fixture
def draw_without_writing(monkeypatch, tmp_path):
    """Return a function that draws without writing; it returns the axes of each figure by name, and the notes."""
    figures, notes = {}, []
    monkeypatch.setattr(
        draw, "save", lambda axes, stem, *_, **__: figures.setdefault(stem.name, axes) is None or (stem,)
    )

    def draw_at(path, at=None):
        figures.clear()
        notes.clear()
        draw_stores(path, tmp_path, selection=at, note=notes.append)
        return figures, notes

    return draw_at


@pytest.mark.parametrize(
    "requested, selected, expected_notes",
    [
        ("0.2", 0.2, []),
        (0.2 * (1 + 1e-12), 0.2, []),
        ("0.21", 0.2, ["ridge.zarr: mass = 0.2 kg, the value of the sweep nearest to 0.21"]),
        ("0.64", 0.5, ["ridge.zarr: mass = 0.5 kg, the value of the sweep nearest to 0.64"]),
        ("0.06", 0.1, ["ridge.zarr: mass = 0.1 kg, the value of the sweep nearest to 0.06"]),
    ],
)
def test_nearest_value_is_selected_and_noted(folder, draw_without_writing, requested, selected, expected_notes):
    figures, notes = draw_without_writing(folder / "ridge.zarr", {"mass": requested})
    assert rf"$m = {1e3 * selected:g}\,\mathrm{{g}}$" in figures["ridge_stiffness_max"][0].get_title(loc="left")
    assert notes == expected_notes


@pytest.mark.parametrize("requested", ["9", "0.66", "0.04", "-0.1"])
def test_value_beyond_half_a_step_raises(folder, draw_without_writing, requested):
    with pytest.raises(InputError, match=rf"at: mass: got {requested} kg, the sweep has 0.1 kg to 0.5 kg; choose"):
        draw_without_writing(folder / "ridge.zarr", {"mass": requested})
    # A single value has no step size.
    with pytest.raises(InputError, match=r"at: mass: got 0.11 kg, the sweep has 0.1 kg; choose"):
        draw._find_nearest(open_dataset(folder / "ridge.zarr").isel(mass=[0]), "mass", 0.11)


def test_curves_over_given_axes(folder):
    data = open_dataset(folder / "ridge.zarr")
    axes = draw_curves(data, "stiffness_max", x="rate", hue="delay", col="mass")
    kept = data.stiffness_max.isel(damping=0)
    assert len(axes) == 3
    for mass, ax in enumerate(axes):
        assert len(ax.lines) == 2
        for delay, line in enumerate(ax.lines):
            np.testing.assert_allclose(line.get_xdata(), kept.rate.values / 1e3, rtol=1e-15)
            np.testing.assert_allclose(line.get_ydata(), kept.isel(mass=mass, delay=delay).values / 1e3, rtol=1e-15)


def test_plane_over_given_axes(folder):
    data = open_dataset(folder / "ridge.zarr")
    axes = draw_plane(data, "stiffness_max", x="rate", y="mass", col="delay")
    kept = data.stiffness_max.isel(damping=0)
    for delay, ax in enumerate(axes):
        np.testing.assert_allclose(
            ax.collections[0].get_array(), kept.isel(delay=delay).transpose("mass", "rate").values / 1e3, rtol=1e-15
        )
    assert figure_of(axes).get_supxlabel().startswith("sampling rate")


def test_remaining_axes_are_chosen_automatically(folder):
    data = open_dataset(folder / "walls.zarr").load()
    (ax, *_) = draw_plane(data, "margin", x="delta")
    assert ax.collections[0].get_array().shape == (3, 4)
    # Without colors and panels given, the axes of walls are used for these first.
    axes = draw_curves(data, "margin", hue="alpha", col="beta")
    assert len(axes) == 2
    np.testing.assert_array_equal(axes[1].lines[2].get_xdata(), data.delta.values)
    np.testing.assert_array_equal(axes[1].lines[2].get_ydata(), data.margin.isel(d=0, beta=1, alpha=2).values)


def test_files_have_the_given_format_size_and_style(folder, tmp_path, capsys):
    sheet = tmp_path / "mine.mplstyle"
    sheet.write_text("lines.linewidth: 4\n", encoding="utf-8")
    arguments = ["--at", "delay=0", "--at", "damping=1", "--style", sheet]
    arguments += ["--format", "png", "--format", "pdf", "--dpi", "50", "--size", "6x3"]
    before = dict(matplotlib.rcParams)
    assert run_main("figures", folder / "ridge.zarr", *arguments, "--out", tmp_path / "out") == 0
    assert dict(matplotlib.rcParams) == before
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [
        "ridge_stiffness_max.pdf",
        "ridge_stiffness_max.png",
    ]
    assert imread(tmp_path / "out" / "ridge_stiffness_max.png").shape[:2] == (150, 300)
    assert (tmp_path / "out" / "ridge_stiffness_max.pdf").read_bytes().startswith(b"%PDF")
    first = (tmp_path / "out" / "ridge_stiffness_max.pdf").read_bytes()
    assert run_main("figures", folder / "ridge.zarr", *arguments, "--out", tmp_path / "out") == 0
    assert (tmp_path / "out" / "ridge_stiffness_max.pdf").read_bytes() == first
    with draw.style_sheet(sheet):
        (ax,) = draw_curves(open_dataset(folder / "ridge.zarr").isel(delay=0, damping=0), "stiffness_max", x="rate")
    assert ax.lines[0].get_linewidth() == 4
    capsys.readouterr()


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--size", "7"], "got '7'; write width x height"),
        (["--size", "0x4"], "got '0x4'; write width x height"),
        (["--size", "85 m"], "or a width such as 85mm"),
        (["--at", "rate=1", "--at", "rate=2"], "got 'rate' twice; give each name only once"),
        (["--format", "gif"], "'gif' is not one of"),
        (["--style", "no/such.mplstyle"], "style: no/such.mplstyle: No such file"),
    ],
)
def test_invalid_figure_options_raise(folder, tmp_path, capsys, arguments, message):
    assert run_main("figures", folder, *arguments, "--out", tmp_path / "out") == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_command_without_figures_states_the_reason(folder, tmp_path, capsys):
    assert run_main("figures", folder / "point.zarr", "--out", tmp_path / "out") == 1
    assert "point.zarr: no figure, because it is a single point" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_panel_titles_fit_above_the_panel(folder):
    values = {"period": (1e-3, "s"), "delay": (1.0, "sampling periods"), "damping": (10.0, "N s/m")}
    data = open_dataset(folder / "ridge.zarr").drop_vars(["damping", "delay"]).isel(damping=0, delay=0, rate=0)
    few, many = (
        data.assign_coords({name: ((), value, {"units": unit}) for name, (value, unit) in list(values.items())[:count]})
        for count in (2, 3)
    )

    def panel_titles(data, masses):
        _, axes = new_figure(7.0, 3.0, 1, len(masses))
        name_panels(axes[0], [data.isel(mass=k).drop_vars("rate", errors="ignore") for k in masses])
        return [ax.get_title() for ax in axes[0]]

    assert [title.count("=") for title in panel_titles(few, (0, 1, 2))] == [3, 3, 3]
    # Long common values would overlap the next title.
    assert [title.count("=") for title in panel_titles(many, (0, 1, 2))] == [1, 1, 1]
    assert [title.count("=") for title in panel_titles(many, (0,))] == [4]
