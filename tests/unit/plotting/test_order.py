"""Values in any order, as a list of a configuration may have them, draw the figure of the same values in order."""

import numpy as np
import pytest
import xarray
from figure_tables import COSTS, RIDGE, SLOPES, grid_map, interval
from matplotlib.text import Annotation

from zwidth import plotting
from zwidth.app.report.page import find_slices
from zwidth.plotting.table import stack

DELTA = stack([interval(), interval(0.5), interval(3.0, curve="passive")])
FILTERS = stack(
    {"damping_N_s_per_m": damping, "estimate": estimate, "cutoff_Hz": cutoff, "samples": samples, **best}
    | {"stiffness_N_per_m": (1e3 + damping) * noise, "velocity_noise_m_per_s": 1e-3 * noise}
    for best in ({"best": False},)
    for damping in (0.0, 5.0)
    for estimate, cutoff, samples, noise in (
        ("low_pass", np.array([10.0, 30.0, 100.0]), np.nan, np.array([1.0, 3.0, 9.0])),
        ("windowed_difference", np.nan, np.array([9.0, 5.0, 2.0]), np.array([2.0, 3.0, 5.0])),
        ("backward_difference", np.nan, np.nan, 12.0),
    )
)
AMPLITUDES = np.geomspace(2e-6, 1e-4, 24).reshape(1, 4, 6)
BUZZES = {
    "condition": np.array(["plain"]),
    "stiffness_N_per_m": np.linspace(1e3, 4e3, 4),
    "resolution_m": np.geomspace(1e-6, 1e-4, 6),
    "amplitude_m": AMPLITUDES,
    "frequency_Hz": 1e6 * AMPLITUDES,
    "outcome": np.ones((1, 4, 6), int),
    "linearly_stable": np.ones((1, 4, 6), int),
}
BOUNDS = 1e-6, 1e-3
ORDER = [2, 0, 3, 1]


def shuffle_rows(table):
    """The rows of every curve over delta, or of every kind of filter, the other way round."""
    keys = [name for name in ("curve", "d", "delay_model", "damping_N_s_per_m", "estimate") if name in table]
    count = len(table[keys[0]])
    curve = [tuple(table[key][row] for key in keys) for row in range(count)]
    order = sorted(range(count), key=lambda row: (curve.index(curve[row]), -row))
    return {name: np.asarray(column)[order] for name, column in table.items()}


def shuffle_grid(arrays, name, dimension):
    """A grid whose axis is out of order."""
    count, most = arrays[name].size, max(values.ndim for values in arrays.values())
    order = [place for place in (*ORDER, *range(4, count)) if place < count]
    grids = {each: values.take(order, dimension) for each, values in arrays.items() if values.ndim == most}
    return {**arrays, **grids, name: arrays[name][order]}


def list_drawn(axes):
    """What is drawn: lines, the colors of cells, and where the names of curves stand."""
    found = []
    for ax in np.asarray(axes, dtype=object).ravel():
        found += [line.get_xydata().tolist() for line in ax.lines]
        found += [
            np.ma.filled(each.get_array(), -1).tolist() for each in ax.collections if each.get_array() is not None
        ]
        found += [(text.get_text(), text.xy) for text in ax.texts if isinstance(text, Annotation)]
        found += [(*ax.get_xlim(), *ax.get_ylim(), ax.get_xscale(), ax.get_title(loc="left"))]
    return found


def assert_alike(one, other):
    assert repr(list_drawn(one)) == repr(list_drawn(other))


@pytest.mark.parametrize(
    ("draw", "table", "more"),
    [
        (plotting.draw_ridge, RIDGE, ()),
        (plotting.draw_slope, RIDGE, (SLOPES,)),
        (plotting.draw_passivity_cost, COSTS, ()),
        (plotting.draw_zero_stiffness, DELTA, ()),
        (plotting.draw_filters, FILTERS, ()),
        (plotting.draw_filter_noise, FILTERS, (np.nan,)),
    ],
)
def test_curves_over_values_in_any_order(draw, table, more):
    assert_alike(draw(shuffle_rows(table), *more), draw(table, *more))


def test_maps_over_values_in_any_order():
    arrays = grid_map((0.0, 0.1, 0.5))
    for dimension, name in enumerate(("alpha", "beta", "delta")):
        other = shuffle_grid(arrays, name, dimension)
        assert_alike(plotting.draw_map(other, "spectral_radius"), plotting.draw_map(arrays, "spectral_radius"))


@pytest.mark.parametrize("family", ["", "stiffness_N_per_m"])
def test_buzz_over_values_in_any_order(family):
    for dimension, name in enumerate(("stiffness_N_per_m", "resolution_m"), start=1):
        pairs = [BUZZES, shuffle_grid(BUZZES, name, dimension)]
        if family:
            assert_alike(*(plotting.draw_limit_cycle_curves(each, {}, BOUNDS, family) for each in pairs))
        else:
            assert_alike(*(plotting.draw_limit_cycles(each, {}, BOUNDS) for each in pairs))


@pytest.fixture
def sweep():
    """A made-up sweep over walls and delays, as a store holds it."""
    axes = {"alpha": np.linspace(0.1, 1.0, 7), "beta": np.linspace(0.0, 1.0, 8), "d": np.array([0.0, 0.5, 1.0, 2.0])}
    alpha, beta, d = np.meshgrid(*axes.values(), indexing="ij")
    outputs = {"margin": 0.5 - alpha - (beta - 0.4) ** 2 - 0.1 * d, "status": np.zeros(alpha.shape, int)}
    tops = {"alpha_max": 0.5 - 0.1 * axes["d"], "beta_at_max": np.full(4, 0.4), "ridge_status": np.zeros(4, int)}
    return xarray.Dataset(
        {name: (tuple(axes), values) for name, values in outputs.items()}
        | {name: (("d",), values) for name, values in tops.items()},
        axes,
    )


@pytest.mark.parametrize("name", ["alpha", "beta", "d"])
def test_sweeps_over_values_in_any_order(sweep, name):
    order = [*ORDER, *range(4, sweep.sizes[name])]
    other = sweep.isel({name: order})
    assert_alike(plotting.draw_plane(other, "margin"), plotting.draw_plane(sweep, "margin"))
    assert_alike(plotting.draw_curves(other, "alpha_max"), plotting.draw_curves(sweep, "alpha_max"))
    assert_alike(plotting.draw_outlines(other), plotting.draw_outlines(sweep))
    slices = [list(find_slices(each)) for each in (sweep, other)]
    assert slices[0]
    assert slices[0] == slices[1]


def test_names_of_curves_stand_where_they_end():
    (ax,) = plotting.draw_ridge(shuffle_rows(RIDGE))
    heights = [text.xy[1] for text in ax.texts]
    assert [text.get_text() for text in ax.texts] == ["$d = 0$", "$d = 0.5$"]
    assert heights[0] > 0.9
