"""Figures are independent of the order of values in a configuration."""

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
LIMIT_CYCLES = {
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
    """Return the table with the rows of every curve reversed."""
    keys = [name for name in ("curve", "d", "delay_model", "damping_N_s_per_m", "estimate") if name in table]
    count = len(table[keys[0]])
    curve = [tuple(table[key][row] for key in keys) for row in range(count)]
    order = sorted(range(count), key=lambda row: (curve.index(curve[row]), -row))
    return {name: np.asarray(column)[order] for name, column in table.items()}


def shuffle_grid(arrays, name, dimension):
    """Return a grid with one axis in shuffled order."""
    count, ndim = arrays[name].size, max(values.ndim for values in arrays.values())
    order = [index for index in (*ORDER, *range(4, count)) if index < count]
    grids = {key: values.take(order, dimension) for key, values in arrays.items() if values.ndim == ndim}
    return {**arrays, **grids, name: arrays[name][order]}


def list_drawn(axes):
    """Return the drawn lines, cell colors, annotations and axis limits."""
    contents = []
    for ax in np.asarray(axes, dtype=object).ravel():
        contents += [line.get_xydata().tolist() for line in ax.lines]
        contents += [
            np.ma.filled(collection.get_array(), -1).tolist()
            for collection in ax.collections
            if collection.get_array() is not None
        ]
        contents += [(text.get_text(), text.xy) for text in ax.texts if isinstance(text, Annotation)]
        contents += [(*ax.get_xlim(), *ax.get_ylim(), ax.get_xscale(), ax.get_title(loc="left"))]
    return contents


def assert_equal_figures(first, second):
    assert repr(list_drawn(first)) == repr(list_drawn(second))


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
def test_curves_are_independent_of_the_order(draw, table, more):
    assert_equal_figures(draw(shuffle_rows(table), *more), draw(table, *more))


def test_maps_are_independent_of_the_order():
    arrays = grid_map((0.0, 0.1, 0.5))
    for dimension, name in enumerate(("alpha", "beta", "delta")):
        shuffled = shuffle_grid(arrays, name, dimension)
        assert_equal_figures(
            plotting.draw_map(shuffled, "spectral_radius"), plotting.draw_map(arrays, "spectral_radius")
        )


@pytest.mark.parametrize("family", ["", "stiffness_N_per_m"])
def test_limit_cycles_are_independent_of_the_order(family):
    for dimension, name in enumerate(("stiffness_N_per_m", "resolution_m"), start=1):
        pairs = [LIMIT_CYCLES, shuffle_grid(LIMIT_CYCLES, name, dimension)]
        if family:
            assert_equal_figures(*(plotting.draw_limit_cycle_curves(arrays, {}, BOUNDS, family) for arrays in pairs))
        else:
            assert_equal_figures(*(plotting.draw_limit_cycles(arrays, {}, BOUNDS) for arrays in pairs))


@pytest.fixture
def sweep():
    """Return a synthetic sweep over walls and delays, in the form of a store."""
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
def test_sweeps_are_independent_of_the_order(sweep, name):
    order = [*ORDER, *range(4, sweep.sizes[name])]
    shuffled = sweep.isel({name: order})
    assert_equal_figures(plotting.draw_plane(shuffled, "margin"), plotting.draw_plane(sweep, "margin"))
    assert_equal_figures(plotting.draw_curves(shuffled, "alpha_max"), plotting.draw_curves(sweep, "alpha_max"))
    assert_equal_figures(plotting.draw_outlines(shuffled), plotting.draw_outlines(sweep))
    slices = [list(find_slices(data)) for data in (sweep, shuffled)]
    assert slices[0]
    assert slices[0] == slices[1]


def test_labels_of_curves_are_at_their_ends():
    (ax,) = plotting.draw_ridge(shuffle_rows(RIDGE))
    heights = [text.xy[1] for text in ax.texts]
    assert [text.get_text() for text in ax.texts] == ["$d = 0$", "$d = 0.5$"]
    assert heights[0] > 0.9
