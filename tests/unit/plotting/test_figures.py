"""Figures of all kinds, tested by their plotted data and texts instead of pixels."""

import csv
import inspect
import io
import warnings
from functools import cache
from itertools import combinations

import matplotlib
import numpy as np
import pytest
from figure_tables import (
    BOUNDARY,
    EVERY_FIGURE,
    LIMITS,
    RIDGE,
    SLOPES,
    cost,
    grid_map,
    interval,
    outline,
    path,
    response,
    ridge,
)
from matplotlib.axes import Axes
from matplotlib.axis import Tick
from matplotlib.colors import to_rgb
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.text import Annotation, Text

from zwidth import plotting
from zwidth.core.errors import InputError
from zwidth.plotting import style, table
from zwidth.plotting.table import stack
from zwidth.studies.outcome import csv_text


def draw(name, axes=None, **keywords):
    """Draw one of the figures and return its axes."""
    return getattr(plotting, name.split()[0])(*EVERY_FIGURE[name], axes, **keywords)


def get_curves(ax):
    """Return the labeled curves of an axes, as (x, y)."""
    return {str(line.get_label()): line.get_xydata().T for line in ax.lines if not line.get_label().startswith("_")}


def assert_drawn(ax, label, x, y):
    line = get_curves(ax)[label]
    np.testing.assert_allclose(line[0], x, rtol=1e-15)
    np.testing.assert_allclose(line[1], y, rtol=1e-15)


def get_text(figure):
    """Return all text of a figure."""
    return " ".join(text.get_text() for text in figure.findobj(Text))


@cache
def draw_cached(name):
    """Draw one of the figures, cached for all tests, with every warning an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = style.figure_of(draw(name))
        figure.draw_without_rendering()
    return figure


@pytest.mark.parametrize("name", EVERY_FIGURE)
def test_figure_does_not_change_global_state_of_matplotlib(name):
    import matplotlib.pyplot as plt

    before, fignums = matplotlib.rcParams.copy(), plt.get_fignums()
    assert isinstance(draw_cached(name), Figure)
    assert matplotlib.rcParams == before
    assert plt.get_fignums() == fignums


@pytest.mark.parametrize("name", EVERY_FIGURE)
def test_figure_is_drawn_into_given_axes(name):
    figure = Figure()
    ax = figure.subplots()
    result = draw(name, ax)
    assert result is ax if name.startswith("draw_zero_stiffness") else list(result) == [ax]
    assert ax.has_data()
    assert ax.get_xlabel()
    assert ax.get_ylabel()
    # At most a color bar is added.
    assert len(figure.axes) <= 2
    assert not figure.legends


@pytest.mark.parametrize("name", ["draw_boundary", "draw_step", "draw_passivity_cost", "draw_map of many"])
def test_every_panel_is_drawn_into_given_axes(name):
    expected = draw_cached(name).axes
    part = Figure(layout="constrained").subfigures(1, 2, squeeze=False)[0, 1]
    axes = part.subplots(1, len(expected))
    assert list(draw(name, axes)) == list(axes)
    for ax, reference in zip(axes, expected, strict=True):
        assert {name: line.tolist() for name, line in get_curves(ax).items()} == {
            name: line.tolist() for name, line in get_curves(reference).items()
        }
        assert ax.get_xlabel() or name == "draw_step"


def test_delays_share_one_axes_or_have_one_each():
    axes = Figure().subplots(1, 3)
    (shared,) = plotting.draw_boundary(BOUNDARY, axes[0])
    assert len(get_curves(shared)) == 6
    table_of_delays = stack([outline(0.5, d) for d in (0.0, 1.0, 2.0)])
    with pytest.raises(InputError, match="got 2 for 3 delays"):
        plotting.draw_boundary(table_of_delays, axes[:2])


def test_equal_responses_are_drawn_separately():
    positions, forces = plotting.draw_step(stack([response(), response()]))
    for ax in (positions, forces):
        assert [line.get_xdata().size for line in ax.lines if line.get_xdata()[-1] > 50] == [100, 100]


def test_every_function_has_axes_as_last_argument():
    for name in (name for name in dir(plotting) if name.startswith("draw_")):
        signature = inspect.signature(getattr(plotting, name))
        heights = [
            parameter
            for parameter in signature.parameters.values()
            if parameter.kind is not inspect.Parameter.KEYWORD_ONLY
        ]
        (axes_parameter,) = [parameter for parameter in heights if parameter.default is None]
        assert axes_parameter is heights[-1], name
        assert axes_parameter.name == ("ax" if name == "draw_zero_stiffness" else "axes"), name
        assert signature.return_annotation == ("Axes" if axes_parameter.name == "ax" else "np.ndarray"), name


def test_figure_is_drawn_from_its_csv_file():
    header, *rows = csv.reader(io.StringIO(csv_text(BOUNDARY)))
    read = {name: np.array(column) for name, column in zip(header, zip(*rows, strict=True), strict=True)}
    read = {name: column if name == "curve" else column.astype(float) for name, column in read.items()}
    for ax, reference in zip(plotting.draw_boundary(read), draw_cached("draw_boundary").axes, strict=True):
        assert {name: line.tolist() for name, line in get_curves(ax).items()} == {
            name: line.tolist() for name, line in get_curves(reference).items()
        }


def test_data_frame_is_accepted_as_table():
    pandas = pytest.importorskip("pandas")
    assert isinstance(plotting.draw_zero_stiffness(pandas.DataFrame(EVERY_FIGURE["draw_zero_stiffness"][0])), Axes)
    for name in ("draw_boundary", "draw_ridge", "draw_step", "draw_passivity_cost"):
        frame = pandas.DataFrame(EVERY_FIGURE[name][0])
        for ax, reference in zip(getattr(plotting, name)(frame), draw_cached(name).axes, strict=True):
            assert get_curves(ax).keys() == get_curves(reference).keys()


def test_curves_are_grouped_by_their_keys():
    columns = {"d": [0.0, 0.0, 1.0, 0.0], "kind": ["a", "a", "a", "b"], "x": [1.0, 2.0, 3.0, 4.0]}
    groups = table.curves(columns, "d", "kind")
    assert [(curve.d, curve.kind, curve.x.tolist()) for curve in groups] == [
        (0.0, "a", [1.0, 2.0]),
        (1.0, "a", [3.0]),
        (0.0, "b", [4.0]),
    ]
    assert [curve.x.tolist() for curve in table.curves(columns, "kind", d=0.0)] == [[1.0, 2.0], [4.0]]
    assert table.curves(columns, "d", kind="c") == []


@pytest.mark.parametrize("name", EVERY_FIGURE)
def test_every_text_is_inside_the_figure(name):
    figure = draw_cached(name)
    page = figure.bbox
    # Ticks outside of the range exist but are not drawn.
    ticks = {label for tick in figure.findobj(Tick) for label in (tick.label1, tick.label2)}
    for text in figure.findobj(Text):
        if text in ticks or not text.get_visible() or not text.get_text().strip():
            continue
        box = text.get_window_extent()
        assert box.x0 >= page.x0 - 1, text.get_text()
        assert box.x1 <= page.x1 + 1, text.get_text()
        assert box.y0 >= page.y0 - 1, text.get_text()
        assert box.y1 <= page.y1 + 1, text.get_text()


@pytest.mark.parametrize("name", EVERY_FIGURE)
def test_annotations_do_not_overlap(name):
    for ax in draw_cached(name).axes:
        boxes = [Text.get_window_extent(text) for text in ax.texts if isinstance(text, Annotation)]
        assert not any(first.overlaps(second) for first, second in combinations(boxes, 2))


@pytest.mark.parametrize("name", ["draw_boundary with a line", "draw_map of stable"])
def test_equal_figures_have_equal_files(name, tmp_path):
    written = []
    before = matplotlib.rcParams.copy()
    for attempt in ("first", "second"):
        files = plotting.save(draw(name), tmp_path / attempt)
        assert [file.suffix for file in files] == [".png", ".svg"]
        written.append([file.read_bytes() for file in files])
    assert matplotlib.rcParams == before
    assert written[0] == written[1]
    assert b"<dc:date>" not in written[0][1]
    assert b"<text" not in written[0][1], "text is drawn as outlines"


def test_boundaries_have_one_panel_per_delay():
    figure = draw_cached("draw_boundary")
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["$d = 0$", "$d = 2$"]
    for ax, d in zip(figure.axes, (0.0, 2.0), strict=True):
        for delta in (0.5, 1.0):
            given = outline(delta, d)
            assert_drawn(ax, f"boundary, delta = {delta:g}, d = {d:g}", given["alpha"], given["beta"])
        assert_drawn(ax, f"path of alpha_max, d = {d:g}", path(d)["alpha"], path(d)["beta"])
        shaded = [np.asarray(patch.get_path().vertices) for patch in ax.patches if isinstance(patch, PathPatch)]
        assert any(np.array_equal(xy[:21], np.c_[outline(1.0, d)["alpha"], outline(1.0, d)["beta"]]) for xy in shaded)


def test_axis_labels_define_their_symbols():
    text = get_text(draw_cached("draw_boundary"))
    assert r"\alpha = K\,T^2\!/m" in text
    assert r"\beta = B\,T/m" in text
    assert r"$\delta = 0.5$" in text
    assert r"\delta = b\,T/m" in get_text(draw_cached("draw_ridge"))


def test_line_of_minus_one_is_drawn_separately():
    ax = draw_cached("draw_boundary with a line").axes[0]
    given = outline(3.0, line=True)
    assert_drawn(ax, "boundary, delta = 3, d = 0", given["alpha"][:21], given["beta"][:21])
    assert_drawn(ax, "z = -1, delta = 3, d = 0", given["alpha"][20:], given["beta"][20:])
    styles = {line.get_label(): line.get_linestyle() for line in ax.lines}
    assert styles["boundary, delta = 3, d = 0"] != styles["z = -1, delta = 3, d = 0"]


def test_passive_outline_and_si_axes():
    ax = draw_cached("draw_boundary with passivity in SI").axes[0]
    assert_drawn(ax, "passive, delta = 0.5, d = 0", [0.0, 1.0, 0.0], [-0.5, 0.0, 0.5])
    top, right = ax.child_axes
    assert "kN/m" in top.get_xlabel()
    assert "N s/m" in right.get_ylabel()
    np.testing.assert_allclose(top.get_xlim(), np.array(ax.get_xlim()) * 100.0, rtol=1e-12)
    np.testing.assert_allclose(right.get_ylim(), np.array(ax.get_ylim()) * 100.0, rtol=1e-12)


def test_larger_delta_is_darker():
    ax = draw_cached("draw_boundary").axes[0]
    gray = {line.get_label(): np.dot(to_rgb(line.get_color()), [0.299, 0.587, 0.114]) for line in ax.lines}
    assert gray["boundary, delta = 1, d = 0"] < gray["boundary, delta = 0.5, d = 0"] - 0.1


def test_zero_stiffness_shows_both_delay_models():
    figure = draw_cached("draw_zero_stiffness")
    ax = figure.axes[0]
    for given in (interval(), interval(0.5), interval(0.5, "fractional_power")):
        assert_drawn(ax, f"beta_upper, d = {given['d']:g}, {given['delay_model']}", given["delta"], given["beta_upper"])
    assert_drawn(ax, "beta_lower", interval()["delta"], -interval()["delta"])
    assert_drawn(ax, "passive beta_upper, d = 3", interval(3.0)["delta"], interval(3.0)["beta_upper"])
    styles = {line.get_label(): line.get_linestyle() for line in ax.lines}
    assert styles["beta_upper, d = 0.5, held"] == "-"
    assert styles["beta_upper, d = 0.5, fractional_power"] == "--"
    assert "fractional power" in get_text(figure)


def test_ridge_has_two_scalings():
    near, far = plotting.draw_ridge(RIDGE, two_scalings=True)
    assert near.get_xlim() == (0.0, 1.0)
    assert far.get_xlim() == (0.0, 10.0)
    for table_of_ridge in (ridge(), ridge(0.5), ridge(0.5, "fractional_power")):
        label = f"alpha_max, d = {table_of_ridge['d']:g}, {table_of_ridge['delay_model']}"
        assert_drawn(far, label, table_of_ridge["delta"], table_of_ridge["alpha_max"])
        inside = table_of_ridge["delta"] <= 1.0
        assert_drawn(near, label, table_of_ridge["delta"][inside], table_of_ridge["alpha_max"][inside])


def test_one_scaling_is_drawn_if_no_delta_is_small():
    large = {"d": [1.0, 1.0], "delta": [1.0, 2.0], "alpha_max": [1.0, 2.0]}
    assert len(plotting.draw_ridge(large, two_scalings=True)) == 1


def test_slope_is_drawn_with_its_limit():
    ratio, limit = draw_cached("draw_slope").axes
    for table_of_ridge in (ridge(model=""), ridge(0.5, "")):
        shown = table_of_ridge["delta"] >= 0.1
        label = f"alpha_max/delta, d = {table_of_ridge['d']:g}"
        assert_drawn(
            ratio,
            label,
            table_of_ridge["delta"][shown],
            table_of_ridge["alpha_max"][shown] / table_of_ridge["delta"][shown],
        )
        value = LIMITS[table_of_ridge["d"]]
        lines = [line for line in ratio.lines if line.get_label() == f"g, d = {table_of_ridge['d']:g}"]
        assert any(np.all(np.asarray(line.get_ydata()) == value) for line in lines)
    assert_drawn(limit, "g", SLOPES["d"], SLOPES["slope"])
    # The label of a delay is at the end of its curve.
    heights = {text.get_text(): text.xy[1] for text in ratio.texts if isinstance(text, Annotation)}
    low, high = np.log(ratio.get_ylim())
    assert heights["$d = 0.5$"] == pytest.approx((np.log(2.5) - low) / (high - low), abs=0.03)


def test_passivity_cost_shows_both_maxima_and_their_ratio():
    maxima, ratio = draw_cached("draw_passivity_cost").axes
    for d in (0.0, 1.0):
        given = cost(d)
        for name in ("alpha_max", "alpha_max_passive"):
            assert_drawn(maxima, f"{name}, d = {d:g}", given["delta"], given[name])
        percentage = 100.0 * given["alpha_max_passive"] / given["alpha_max"]
        assert_drawn(ratio, f"passive share, d = {d:g}", given["delta"], percentage)


def test_step_responses_have_readable_units():
    figure = draw_cached("draw_step")
    positions, forces = figure.axes
    given = response()
    text = r"first  ($\alpha = 0.1$, $\beta = 0.4$)"
    line = get_curves(positions)[text]
    np.testing.assert_allclose(line[0], given["time_s"] * 1e3, rtol=1e-14)
    np.testing.assert_allclose(line[1], given["position_m"] * 1e6, rtol=1e-14)
    np.testing.assert_array_equal(get_curves(forces)["wall_force, first"][1], given["wall_force_N"])
    assert "µm" in positions.get_ylabel()
    assert "ms" in forces.get_xlabel()
    assert "not settled" in get_text(figure)


def test_map_shows_values_and_the_stability_boundary():
    figure = draw_cached("draw_map of radius")
    mesh = figure.axes[0].collections[0]
    np.testing.assert_array_equal(np.asarray(mesh.get_array()).T, grid_map()["spectral_radius"][:, :, 0, 0])
    contour = figure.axes[0].collections[1]
    assert isinstance(contour, ContourSet)
    assert list(contour.levels) == [1.0]
    stable = draw_cached("draw_map of stable").axes[0].collections[0]
    np.testing.assert_array_equal(np.asarray(stable.get_array()).T, grid_map()["stable"][:, :, 0, 0])


def test_map_of_many_deltas_shows_ends_and_middle():
    titles = [ax.get_title(loc="left") for ax in draw_cached("draw_map of many").axes]
    assert titles == [rf"$\delta = {delta:g}$,  $d = 1$" for delta in (0, 0.5, 1)]


def test_recommended_stiffness_is_rounded_down():
    outlines = {"label": np.full(3, ""), "number": np.ones(3), "piece": np.full(3, "outline")}
    outlines |= {"stiffness_N_per_m": np.array([0, 2e4, 0]), "virtual_damping_N_s_per_m": np.array([0, 40.0, 90])}
    walls = {"label": np.array([""]), "wall": np.array(["recommended (75 %)"])}
    walls |= {"stiffness_N_per_m": np.array([14897.0]), "virtual_damping_N_s_per_m": np.array([41.6])}
    for digits, text in ({}, "$K$ = 14.89 kN/m"), ({"digits": np.array([6])}, "$K$ = 14.8970 kN/m"):
        (ax,) = plotting.draw_stable_set(outlines, walls | digits)
        assert text in ax.texts[0].get_text()


@pytest.mark.parametrize(
    "positions, gap, expected",
    [
        ([0.0, 1.0], 0.5, [0.0, 1.0]),
        ([0.0, 0.0], 1.0, [-0.5, 0.5]),
        ([3.0, 0.0, 0.1], 0.5, [3.0, -0.2, 0.3]),
        ([5.0], 1.0, [5.0]),
    ],
)
def test_labels_are_moved_as_little_as_necessary(positions, gap, expected):
    np.testing.assert_allclose(style.spread(positions, gap), expected, atol=1e-12)


@pytest.mark.parametrize(
    "largest, unit, factor, text",
    [
        (0.1, "s", 1e3, "ms"),
        (9e-5, "m", 1e6, "µm"),
        (2e4, "N/m", 1e-3, "kN/m"),
        (0.0, "m", 1.0, "m"),
        (5.0, "m", 1, "m"),
    ],
)
def test_units_have_a_readable_prefix(largest, unit, factor, text):
    prefix_factor, name = style.si_unit(largest, unit)
    assert prefix_factor == pytest.approx(factor)
    assert name == text
