"""Figures of degenerate sweeps: no stable wall, zeros, nearly equal values."""

import numpy as np
import pytest
import xarray

from zwidth import plotting

AXES = {"stiffness": np.linspace(1e3, 2e3, 9), "virtual_damping": np.linspace(0.0, 8.0, 9)}


def make_sweep(name, values, units="s"):
    """Return a sweep over walls in the form of a store."""
    outputs = {name: (tuple(AXES), values, {"units": units}), "status": (tuple(AXES), np.zeros(values.shape, int))}
    return xarray.Dataset(outputs, AXES)


def read_ticks(ax):
    ax.figure.draw_without_rendering()
    low, high = ax.get_ylim()
    return [tick.label1.get_text() for tick in ax.yaxis.get_major_ticks() if low <= tick.get_loc() <= high]


@pytest.mark.parametrize(("name", "value"), [("settling_time", np.inf), ("delay_margin", 0.0)])
def test_sweep_without_a_stable_wall(name, value):
    (ax,) = plotting.draw_plane(make_sweep(name, np.full((9, 9), value)), name)
    assert np.ma.getmaskarray(ax.collections[0].get_array()).all()
    ax.figure.draw_without_rendering()


def test_integer_axis_has_only_integer_ticks():
    sweep = xarray.Dataset(
        {"stiffness_max": ("actuator_order", [2e3, 1e3]), "ridge_status": ("actuator_order", [0, 0])}
    )
    (ax,) = plotting.draw_curves(sweep.assign_coords(actuator_order=[1, 2]), "stiffness_max")
    ax.figure.draw_without_rendering()
    assert set(np.mod(ax.get_xticks(), 1)) == {0.0}


def test_zeros_are_omitted_on_a_logarithmic_axis():
    margin = np.where(AXES["virtual_damping"] > 4.0, 2e-5 * AXES["virtual_damping"], 0.0)
    (ax,) = plotting.draw_curves(make_sweep("delay_margin", margin * np.ones((9, 1))).isel(stiffness=0), "delay_margin")
    drawn = ax.lines[0].get_ydata()
    np.testing.assert_allclose(drawn[5:], 20.0 * AXES["virtual_damping"][5:])
    assert np.isnan(drawn[:5]).all()
    assert ax.get_ylabel().endswith("in µs")


def test_nearly_equal_values_are_labeled_with_plain_numbers():
    times = np.geomspace(0.18, 0.39, 9)[:, None] * np.ones(9)
    (ax,) = plotting.draw_plane(make_sweep("settling_time", times), "settling_time")
    bar = ax.figure.axes[-1]
    assert read_ticks(bar) == ["200", "300"]
    assert len([text for text in ax.texts if text.get_text() in ("200", "220", "240", "260")]) >= 3


def test_response_of_a_single_instant_has_a_time_axis(recwarn):
    columns = ("time_s", "position_m", "velocity_m_per_s", "wall_force_N", "contact")
    energies = [f"{name}_J" for name in ("wall_work", "external_work", "damping_loss", "friction_loss", "energy")]
    table = {"label": np.array(["still"]), **{name: np.zeros(1) for name in (*columns, *energies)}}
    for draw in (plotting.draw_motion, plotting.draw_energy):
        assert draw(table)[0].get_xlim() == (0.0, 1.0)
    assert not recwarn.list


def test_nearly_equal_required_stiffnesses_have_distinct_labels():
    stiffnesses = np.array([11.1e3, 11.13e3, 11.138e3])
    curve = {"parameter": np.array(["delay"] * 2), "value_s": np.array([1e-4, 1e-2]), "stiffness_N_per_m": [4e4, 1e3]}
    required = {"stiffness_N_per_m": stiffnesses, "reserve": np.ones(3), "present_s": np.full(3, 1e-3)}
    required |= {
        "value_s": np.full(3, 1e-3),
        "sufficient_side": np.array(["below"] * 3),
        "other_crossings_s": np.array([""] * 3),
    }
    (ax,) = plotting.draw_requirement(curve, required)
    names = [text.get_text() for text in ax.figure.legends[0].get_texts()]
    assert names[:3] == ["11.1 kN/m", "11.13 kN/m", "11.14 kN/m"]
