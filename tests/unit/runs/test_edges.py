"""Exact boundaries in figures of sweeps: against verdicts on both sides, and omitted if the sweep contradicts them."""

import numpy as np
import pytest
from sweeping import make_config, run_sweeps, study

from zwidth import Device, LowPass, Scene, Timing, is_passive, is_stable
from zwidth.plotting import draw_outlines, draw_plane
from zwidth.plotting.grid import prepare
from zwidth.runs.draw import make_edges
from zwidth.sweep.dataset import open_dataset
from zwidth.sweep.store import Store

WALLS = {
    "alpha": {"linear": {"start": 0.0, "stop": 1.0, "num": 21}},
    "beta": {"linear": {"start": -0.6, "stop": 1.6, "num": 23}},
    "delta": [0.05, 0.5],
    "d": [0, 1],
}
IN_SI = {
    "stiffness": {"log": {"start": 100, "stop": 40000, "num": 20}},
    "virtual_damping": {"linear": {"start": -20, "stop": 100, "num": 20}},
    "devices": {"label": ["light", "heavy"], "mass": [0.1, 0.2], "damping": [1, 5]},
    "rate": "1 kHz",
    "delay": "1 ms",
}
FILTERED = {**IN_SI, "devices": {"label": ["one"], "mass": [0.1], "damping": [5]}}
CUT_OFF = {**FILTERED, "velocity.cutoff": ["50 Hz", "400 Hz"]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    studies = [
        study("walls", axes=WALLS, outputs=("stable", "passive")),
        study("si", axes=IN_SI, outputs=("stable", "settling_time")),
        study("filtered", axes=FILTERED, velocity={"kind": "low_pass", "cutoff": "50 Hz"}),
        study("cut_off", axes=CUT_OFF, velocity={"kind": "low_pass", "cutoff": "50 Hz"}),
    ]
    assert run_sweeps(make_config(*studies), folder).ok
    return folder


def open_with_edges(folder, name):
    path = folder / f"{name}.zarr"
    return open_dataset(path).reset_coords(drop=True).load(), make_edges(Store(path))


def scale_outline(points, size):
    """Return points of an outline scaled about its center, without those near alpha = 0."""
    center = points[points[:, 0] > 0].mean(axis=0)
    walls = center + size * (points - center)
    return walls[(points[:, 0] > 1e-3 * points[:, 0].max())].T


@pytest.mark.parametrize("selection", [{"d": 0, "delta": 1}, {"d": 1, "delta": 0}])
def test_verdicts_change_at_the_edges(folder, selection):
    data, edges = open_with_edges(folder, "walls")
    part = prepare(data, ["stable"]).isel(selection)
    outlines = edges(part)
    delta, d = float(part.delta), float(part.d)
    for name, verdict in (("stable", is_stable), ("passive", is_passive)):
        ((points, hole),) = outlines[name]
        assert not hole
        for size, expected in ((0.999, True), (1.001, False)):
            alpha, beta = scale_outline(points, size)
            assert set(np.asarray(verdict(alpha, beta, delta, d))) == {expected}


def test_edges_have_the_units_of_the_figure(folder):
    data, edges = open_with_edges(folder, "si")
    part = prepare(data, ["stable"]).isel(device=1)
    assert part.stiffness.attrs["units"] == "kN/m"
    ((points, _),) = edges(part)["stable"]
    scene = Scene(Device(mass=0.2, damping=5), Timing(period=1e-3, delay=1e-3))
    for size, stable in ((0.999, True), (1.001, False)):
        stiffness, damping = scale_outline(points, size)
        assert set(scene.is_stable(1e3 * stiffness, damping)) == {stable}


def test_edges_of_scenes_with_filters(folder):
    data, edges = open_with_edges(folder, "filtered")
    ((points, _), *_) = edges(prepare(data, ["stable"]))["stable"]
    scene = Scene(Device(mass=0.1, damping=5), Timing(period=1e-3, delay=1e-3), velocity=LowPass(50.0))
    for size, stable in ((0.999, True), (1.001, False)):
        stiffness, damping = scale_outline(points, size)
        assert set(scene.is_stable(1e3 * stiffness, damping)) == {stable}
    (ax,) = draw_plane(data, "stable", edges=edges)
    assert exact_lines(ax)


@pytest.mark.parametrize("k, cutoff", [(0, 50.0), (1, 400.0)])
def test_each_cutoff_has_its_own_edge(folder, k, cutoff):
    data, edges = open_with_edges(folder, "cut_off")
    ((points, _), *_) = edges(prepare(data, ["stable"]).isel(velocity_cutoff=k))["stable"]
    scene = Scene(Device(mass=0.1, damping=5), Timing(period=1e-3, delay=1e-3), velocity=LowPass(cutoff))
    assert 1e3 * points[:, 0].max() == pytest.approx(float(scene.max_stiffness().stiffness), rel=1e-3)


def exact_lines(ax):
    return [line.get_xydata() for line in ax.lines if line.get_label() == "exact boundary"]


def test_plane_shows_the_exact_edges(folder):
    data, edges = open_with_edges(folder, "walls")
    for ax, indices in zip(
        draw_plane(data, "stable", edges=edges), [(d, k) for d in (0, 1) for k in (0, 1)], strict=True
    ):
        part = prepare(data, ["stable"]).isel(d=indices[0], delta=indices[1])
        lines = exact_lines(ax)
        assert len(lines) == 2
        for line, name in zip(lines, ("stable", "passive"), strict=True):
            np.testing.assert_array_equal(line[:-1], edges(part)[name][0][0])
    # Without `edges` only the edges of grid cells are drawn.
    assert not any(map(exact_lines, draw_plane(data, "stable")))
    for ax in draw_outlines(data, edges=edges):
        assert len(exact_lines(ax)) == 2


def test_axes_may_be_exchanged(folder):
    data, edges = open_with_edges(folder, "walls")
    part = data.isel(d=1, delta=1)
    (ax,) = draw_plane(part, "stable", x="beta", y="alpha", edges=edges)
    (reference,) = draw_plane(part, "stable", edges=edges)
    np.testing.assert_array_equal(exact_lines(ax)[0][:, ::-1], exact_lines(reference)[0])


def test_edges_contradicting_the_sweep_are_not_drawn(folder):
    data, edges = open_with_edges(folder, "walls")
    part = data.isel(d=[1], delta=[1])
    wrong = part.copy(deep=True)
    wrong["stable"][..., 2:8, 8:14] = ~wrong["stable"][..., 2:8, 8:14]
    (ax,) = draw_plane(wrong, "stable", edges=edges)
    # Only the edge of the passive region remains.
    assert len(exact_lines(ax)) == 1
    (ax,) = draw_plane(part, "stable", edges=edges)
    assert len(exact_lines(ax)) == 2


def test_edges_exist_only_for_planes_of_walls(folder):
    data, edges = open_with_edges(folder, "walls")
    assert edges(prepare(data, ["stable"]).isel(alpha=0, d=0)) == {}


def test_settling_times_end_at_the_edge(folder):
    data, edges = open_with_edges(folder, "si")
    axes = draw_plane(data, "settling_time", edges=edges)
    for ax in axes:
        assert ax.get_xscale() == "log"
        assert len(exact_lines(ax)) == 1
    assert "boundary of the stable walls" in [text.get_text() for text in axes[0].figure.legends[0].get_texts()]


def test_legend_omits_edges_that_are_not_drawn(tmp_path):
    beta = {"linear": {"start": -0.4, "stop": 3.0, "num": 9}}
    for name, start, in_legend in (("all", 0.0, True), ("unstable", 2.0, False)):
        axes = {"alpha": {"linear": {"start": start, "stop": 3.0, "num": 9}}, "beta": beta, "delta": 0.5, "d": 1}
        assert run_sweeps(make_config(study(name, axes=axes, outputs=("decay_rate",))), tmp_path / name).ok
        data, edges = open_with_edges(tmp_path / name, name)
        (ax,) = draw_plane(data, "decay_rate", edges=edges)
        legend = ax.figure.legends[0].get_texts() if ax.figure.legends else []
        assert ("boundary of the stable walls" in [text.get_text() for text in legend]) == in_legend
