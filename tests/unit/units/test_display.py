"""Test the display of results at the prompt and in notebooks: concise, with units, and with a reason for every NaN."""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import numpy as np
import pytest

import zwidth
from zwidth.core.status import RidgeKind, Status
from zwidth.units.display import draw_line, format_value

SCENE = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1e-3), zwidth.VirtualWall(10e3, 40.0))
# With a velocity estimate of the wrong sign and no damping, no wall is stable.
BACKWARDS = zwidth.VelocityFilter([-1000.0, 1000.0], [1.0, 0.0])
NOWHERE = zwidth.Scene(zwidth.Device(0.1, 0.0), zwidth.Timing(1e-3, 1e-3), velocity=BACKWARDS)
# Functions, so that collecting the tests computes nothing.
RESULTS: dict[str, Callable[[], Any]] = {
    "wall": lambda: SCENE.max_stiffness(),
    "ridge": lambda: zwidth.alpha_max(0.1, 1),
    "ridges": lambda: zwidth.alpha_max(np.linspace(0.0, 1.0, 1000), 1),
    "margins": lambda: SCENE.margins(),
    "best": lambda: SCENE.best_damping(),
    "required": lambda: SCENE.required("damping", 25e3),
    "slopes": lambda: SCENE.sensitivities(),
    "model": lambda: SCENE.state_space(),
    "verdict": lambda: zwidth.assess(SCENE),
    "limit": lambda: zwidth.limits_of(SCENE)[0],
    "recommendation": lambda: SCENE.recommend(),
    "motion": lambda: SCENE.simulate(start_position=1e-4, periods=1000),
    "motions": lambda: zwidth.simulate(SCENE, np.linspace(1e3, 5e4, 30), 40.0, start_position=1e-4, periods=50),
    "outline": lambda: SCENE.stable_region()[0],
    "region": lambda: zwidth.stable_region(0.1, 1.0),
    "normalized": lambda: SCENE.normalized,
    "units": lambda: SCENE.units,
    "labels": lambda: zwidth.decide_stability(np.linspace(0.1, 0.3, 5), 0.4, 0.1, 1),
    "label": lambda: zwidth.decide_stability(np.linspace(0.1, 0.3, 50), 0.4, 0.1, 1),
    "robust": lambda: zwidth.robust_wall(mass=zwidth.Interval(0.09, 0.11), damping=10, period=1e-3),
    "tolerances": lambda: zwidth.simulate_tolerances(SCENE, {"mass": 0.1}, samples=100),
    "response": lambda: zwidth.step_response(0.1, 0.4, 0.1, 1, periods=500),
}


@cache
def compute_result(name: str) -> Any:
    """Return a result by its name."""
    return RESULTS[name]()


def test_lists_of_results_have_html_tables():
    lists: list[Any] = [zwidth.limits_of(SCENE), SCENE.stable_region()]
    for results in lists:
        assert results._repr_html_().count("<table>") == len(results) > 0
        assert results == list(results)


@pytest.mark.parametrize("name", RESULTS)
def test_result_has_a_short_repr_and_one_html_table(name):
    result = compute_result(name)
    text = repr(result)
    assert text.startswith(f"{type(result).__name__}(")
    assert len(text) < 1200
    assert not any(word in text for word in ("np.", "int32", "float64", "\n    array(["))
    table = result._repr_html_()
    assert table.startswith(f"<table><caption>{type(result).__name__}</caption>")
    assert table.count("<table>") == table.count("</table>") == 1


def test_repr_shows_units_and_names():
    assert repr(compute_result("wall")) == (
        "StiffestWall(stiffness=19.8649 kN/m, virtual_damping=41.5989 N s/m, frequency=93.1993 Hz, "
        "kind=SMOOTH, status=OK)"
    )
    assert "alpha=array (1000), 0.144469 to 0.874821" in repr(compute_result("ridges"))
    assert "1000 OK" in repr(compute_result("ridges"))
    # Margins of a scene are in s and Hz, those of the normalized loop in periods and rad per period.
    margins = compute_result("margins")
    assert f"delay_margin={1e6 * margins.delay_margin:.6g} µs" in repr(margins)
    assert f"gain_crossover={margins.gain_crossover:.6g} Hz" in repr(margins)
    assert "periods" in repr(zwidth.margins(0.1, 0.4, 0.1, 1))


def test_repr_gives_a_reason_for_nan():
    nowhere = NOWHERE.max_stiffness()
    assert Status(int(nowhere.status)) == Status.NO_BOUNDARY
    assert "stiffness=NaN" in repr(nowhere)
    assert f"status=NO_BOUNDARY: {Status.NO_BOUNDARY.message}" in repr(nowhere)
    assert "impact_velocity=NaN, the device does not enter the wall after the first sample" in repr(
        compute_result("motion")
    )
    assert "[OK, INVALID_INPUT]" in repr(zwidth.alpha_max(np.array([0.1, -1.0]), 1))
    assert "stiffness_max=NaN, no wall is stable" in repr(zwidth.assess(NOWHERE.replace(stiffness=1e3)))
    assert "reason=no stiffness is stable at any damping" in repr(NOWHERE.recommend())


def test_single_recorded_motion_has_a_plot():
    assert "<svg" in compute_result("motion")._repr_html_()
    assert '<td style="text-align:left">REST</td>' in compute_result("motion")._repr_html_()
    assert "<svg" not in compute_result("motions")._repr_html_()
    unrecorded: Any = SCENE.simulate(start_position=1e-4, periods=10, record=False)
    assert "<svg" not in unrecorded._repr_html_()


def test_html_table_of_decisions_has_a_row_per_wall():
    assert compute_result("labels")._repr_html_().count("<tr>") == 1 + compute_result("labels").stable.size


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.1, "kg", "100 g"),
        (np.float64(1.5e-40), "m", "1.5e-40 m"),
        (np.array([]), "m", "[]"),
        (np.array([1.0, np.nan] * 4), "m", "array (8), 1 m, 4 NaN"),
        (np.full((2, 3), np.nan), "m", "array (2, 3), none of them finite"),
        (np.array([True] * 5 + [False]), "", "array (6), 5 True"),
        (np.int32(1), RidgeKind, "CORNER"),
        (-np.inf, "N", "-inf N"),
        ("", "", "''"),
        (None, "m", "None"),
        ({"mass": 1.0}, "", "{mass: 1}"),
    ],
)
def test_format_value(value, unit, text):
    assert format_value(value, unit) == text


def test_repr_rounds_maximum_stiffness_down():
    wall = SCENE.max_stiffness()
    for stiffness in 19876.5432 * np.geomspace(1.0, 10.0, 40):
        shown = repr(wall._replace(stiffness=stiffness)).partition("stiffness=")[2].partition(" kN/m")[0]
        assert 0 <= stiffness - 1e3 * float(shown) <= 1e-5 * stiffness


def test_repr_of_traced_results():
    texts = []

    def compute_alpha_max(delta):
        ridge = zwidth.alpha_max(delta, 1)
        texts.append(repr(ridge))
        return ridge.alpha

    jax.jit(compute_alpha_max)(0.1)
    assert texts[0].startswith("RidgePoint(")


def test_draw_line_without_finite_values_is_empty():
    assert draw_line(np.arange(3.0), np.full(3, np.nan), "nothing") == ""
    assert draw_line(np.arange(3.0), np.ones(3), "<flat>").count("&lt;flat&gt;") == 1


def test_dir_of_modules_lists_only_public_names():
    assert dir(zwidth.devices) == [
        "DEVICES",
        "HAND",
        "PublishedDevice",
        "PublishedHand",
        "PublishedValue",
        "find_device",
    ]


def test_arrays_show_the_reason_for_nan_and_no_negative_zero():
    motions = repr(SCENE.simulate([10e3, 1e3], 40.0, start_velocity=0.1, periods=100))
    assert "impact_velocity=[NaN, NaN]; NaN: the device does not enter the wall after the first sample" in motions
    assert format_value(np.array([-0.0, 1.0])) == "[0, 1]"
