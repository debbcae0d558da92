"""The common style of figures: legends, logarithmic axes, cell edges and file formats."""

from itertools import combinations

import matplotlib.style
import numpy as np
import pytest
from figure_tables import RIDGE

from zwidth import plotting
from zwidth.plotting import grid, style

LONG = "a device with a filter, a coupling and a hand, number {}"


@pytest.mark.parametrize(
    "label_format, columns", [("short {}", 5), ("a scene {}", 4), (LONG, 1), (LONG + ", " + LONG * 2, 1)]
)
def test_legend_is_not_wider_than_its_figure(label_format, columns):
    panels = style.panels(None, 1, 6.4, 4.0)
    style.legend(panels, [style.line(label_format.format(k, k, k)) for k in range(5)], outside=True, ncols=5)
    figure = style.figure_of(panels)
    figure.draw_without_rendering()
    (legend,) = figure.legends
    assert len({round(text.get_window_extent().x0) for text in legend.get_texts()}) == columns
    box = legend.get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1
    boxes = [text.get_window_extent() for text in legend.get_texts()]
    assert not any(first.overlaps(second) for first, second in combinations(boxes, 2))
    assert [" ".join(text.get_text().split()) for text in legend.get_texts()] == [
        label_format.format(k, k, k) for k in range(5)
    ]


def test_figure_has_the_configured_size():
    with style.style_sheet(size=(3.0, 2.0)):
        panels = style.panels(None, 1, 6.4, 4.0)
    figure = style.figure_of(panels)
    assert figure.get_size_inches().tolist() == [3.0, 2.0]
    assert style.figure_of(style.panels(None, 1, 6.4, 4.0)).get_size_inches().tolist() == [6.4, 4.0]


def test_house_style_is_a_matplotlib_style():
    with style.house_style():
        house = dict(matplotlib.rcParams)
    with matplotlib.style.context("zwidth.plotting.house"):
        assert dict(matplotlib.rcParams) == house


@pytest.mark.parametrize(
    "low, high",
    [
        (2.1, 4.9),
        (9.3, 11.7),
        (99.0, 101.0),
        (7.0, 19.0),
        (1.1, 1.9),
        (2.0, 8.0),
        (2.1, 10.4),
        (0.3, 40.0),
        (1e-3, 1e4),
    ],
)
def test_logarithmic_axis_has_plain_numbers(low, high):
    (ax,) = style.panels(None, 1, 5.0, 3.0)
    style.use_logarithmic(ax, "x", (low, high))
    ax.set_xlim(low, high)
    style.figure_of(ax).draw_without_rendering()
    ticks = [tick for minor in (False, True) for tick in ax.xaxis.get_ticklabels(minor=minor) if tick.get_text()]
    shown = [tick for tick in ticks if low <= tick.get_position()[0] <= high]
    assert 2 <= len(shown) <= 9
    assert [float(tick.get_text()) for tick in shown] == pytest.approx([tick.get_position()[0] for tick in shown])


def test_logarithmic_axis_of_a_single_value():
    (ax,) = style.panels(None, 1, 5.0, 3.0)
    style.use_logarithmic(ax, "x", [100.0])
    assert ax.get_xlim() == (50.0, 200.0)


def test_many_decades_have_ticks_only_at_powers_of_ten():
    (ax,) = style.panels(None, 1, 5.0, 3.0)
    style.use_logarithmic(ax, "x", (1.0, 2000.0), style.DECADES)
    ax.set_xlim(1e-12, 2.0)
    style.figure_of(ax).draw_without_rendering()
    shown = [tick for tick in ax.get_xticks() if 1e-12 <= tick <= 2.0]
    assert len(shown) > 2
    np.testing.assert_allclose(np.log10(shown), np.round(np.log10(shown)), atol=1e-9)


@pytest.mark.parametrize(
    "values, expected",
    [
        (np.geomspace(1e-3, 10, 7), True),
        (np.geomspace(2.0, 3.0, 5), True),
        ([1, 2, 5, 10, 20], True),
        ([4000, 2000, 1000, 500, 200], True),
        ([1, 2, 4], True),
        ([0.1, 0.2, 0.3, 0.4], False),
        (np.linspace(1, 1000, 50), False),
        ([0, 1, 10, 100], False),
        ([1, 10], False),
        ([2, 3, 2, 3], False),
        ([1, 1.5, 2.2], False),
        ([5, 5, 5], False),
    ],
)
def test_nearly_equal_ratios_are_logarithmic(values, expected):
    assert grid.logarithmic(np.asarray(values, dtype=float)) is expected


def test_cell_edges_are_midway_between_values():
    np.testing.assert_allclose(grid.find_edges(np.array([1.0, 2.0, 3.0])), [0.5, 1.5, 2.5, 3.5], rtol=1e-15)
    edges = grid.find_edges(np.array([1.0, 10.0, 100.0]))
    np.testing.assert_allclose(edges, 10.0 ** np.array([-0.5, 0.5, 1.5, 2.5]), rtol=1e-14)


def test_dampings_in_equal_ratios_have_a_logarithmic_axis():
    delta = np.geomspace(0.1, 1e4, 41)
    columns = {name: values[:41] for name, values in RIDGE.items()}
    (ax,) = plotting.draw_ridge({**columns, "delta": delta, "alpha_max": 3 * delta + 1})
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    (even,) = plotting.draw_ridge(columns)
    assert (even.get_xscale(), even.get_yscale()) == ("linear", "linear")


@pytest.mark.parametrize("text", [False, True])
def test_style_sheet_may_keep_text_as_text(tmp_path, text):
    sheet = tmp_path / "text.mplstyle"
    sheet.write_text("svg.fonttype: none\n", encoding="utf-8")
    with style.style_sheet(sheet if text else None):
        (file,) = plotting.save(plotting.draw_ridge(RIDGE), tmp_path / "ridge", ("svg",))
    written = file.read_text(encoding="utf-8")
    assert ("<text" in written) is text
    # Otherwise the text appears in no comment of the outlines either.
    assert (">held delay (exact)<" in written) is text
