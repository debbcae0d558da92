"""Values of one parameter at which the stiffest wall reaches a wanted stiffness."""

import numpy as np
import pytest
from required_values import find_required

from zwidth import Device, LowPass, Scene, Status, Timing
from zwidth.analysis.optimization import Crossing, _find_crossing
from zwidth.core.errors import InputError

RIGID = Scene(Device(0.1, 10.0), Timing(1e-3, 1e-3))
FILTERED = RIGID.replace(velocity=LowPass(cutoff=30.0))


def test_a_rigid_scene_needs_what_the_closed_form_says():
    got = RIGID.required("damping", 25e3)
    exact = find_required("damping", 25e3, 1.0, 100.0, mass=0.1, period=1e-3, delay=1e-3)
    assert (got.status, got.sufficient_side) == (Status.OK, "above")
    assert got.value == pytest.approx(exact, rel=1e-10)


@pytest.mark.parametrize("parameter, stiffness, side", [("velocity.cutoff", 9e3, "above"), ("period", 8.5e3, "below")])
def test_both_sides_are_what_is_told(parameter, stiffness, side):
    value = FILTERED.parameters()[parameter]
    got = FILTERED.required(parameter, stiffness, within=(0.2 * value, 4.0 * value))
    assert got.status == Status.OK
    assert got.sufficient_side == side
    for crossing in got.crossings:
        turn = 1.0 if crossing.sufficient_side == "above" else -1.0
        for there in (crossing.value, crossing.value * (1.0 + 1e-4 * turn)):
            assert FILTERED.replace(**{parameter: there}).max_stiffness().stiffness >= stiffness
        beyond = FILTERED.replace(**{parameter: crossing.value * (1.0 - 1e-4 * turn)})
        assert beyond.max_stiffness().stiffness < stiffness


def test_of_several_crossings_the_nearest_is_told():
    """K_max is least at some mass between them."""
    scene = RIGID.replace(velocity=LowPass(cutoff=100.0))
    light, heavy = (scene.replace(mass=mass).required("mass", 7.8e3, within=(0.01, 0.5)) for mass in (0.012, 0.2))
    assert [crossing.sufficient_side for crossing in light.crossings] == ["below", "above"]
    assert (light.sufficient_side, heavy.sufficient_side) == ("below", "above")
    assert light.value < 0.03 < heavy.value
    for found in (light, heavy):
        assert scene.replace(mass=found.value).max_stiffness().stiffness == pytest.approx(7.8e3, rel=1e-9)


@pytest.mark.parametrize("mass, above", [(0.0204557, 1e-3), (0.023, 1e-3), (0.03, 1e-6)])
def test_no_dip_between_the_values_is_passed_over(mass, above):
    """K_max is 7585.93 N/m at 20.5 g, and more with less mass and with more."""
    stiffness, scene = 7585.93 * (1.0 + above), RIGID.replace(velocity=LowPass(cutoff=100.0), mass=mass)
    got = scene.required("mass", stiffness, within=(0.000592, 0.5326))
    assert [crossing.sufficient_side for crossing in got.crossings] == ["below", "above"]
    assert got.crossings[0].value < 0.0204557 < got.crossings[1].value
    assert scene.replace(mass=got.value).max_stiffness().stiffness >= stiffness


def test_a_rate_is_the_inverse_of_a_period():
    rate, period = (FILTERED.required(name, 8.5e3) for name in ("rate", "period"))
    assert (rate.sufficient_side, period.sufficient_side) == ("above", "below")
    assert rate.value * period.value == pytest.approx(1.0, rel=1e-10)


def test_out_of_reach_and_everywhere():
    never = FILTERED.required("mass", 1e9, within=(0.05, 0.2))
    assert (never.status, never.sufficient_side, never.crossings) == (Status.UNREACHABLE, "nowhere", ())
    assert np.isnan(never.value)
    always = FILTERED.required("mass", 1.0, within=(0.05, 0.2))
    assert (always.status, always.sufficient_side, always.value) == (Status.OK, "everywhere", 0.1)


@pytest.mark.parametrize("unknown, status", [((11, 15), Status.NOT_CONVERGED), ((60, 80), Status.OK)])
def test_a_nearer_crossing_may_hide_where_nothing_is_known(unknown, status, monkeypatch):
    known = Scene.max_stiffness

    def ask(scene, **options):
        top = known(scene, **options)
        return top._replace(status=Status.NOT_CONVERGED) if unknown[0] < scene.device.damping < unknown[1] else top

    monkeypatch.setattr(Scene, "max_stiffness", ask)
    got = RIGID.required("damping", 25e3)
    assert (got.status, np.isnan(got.value)) == (status, status != Status.OK)
    assert [crossing.sufficient_side for crossing in got.crossings] == ["above"]


def test_the_range_ends_where_values_are_refused():
    got = FILTERED.required("velocity.cutoff", 9e3, within=(20.0, 5e3))
    assert got.range[1] < 500.0
    assert [crossing.sufficient_side for crossing in got.crossings] == ["above"]


@pytest.mark.parametrize(
    "parameter, delay, ends",
    [
        ("delay", 0.3, (0.01, 1.0)),
        ("delay", 2.0, (2.0 / 30.0, 2.0)),
        ("period", 0.3, (3e-4, 0.03)),
        ("rate", 0.3, (1e3 / 30.0, 1e3 / 0.3)),
        ("rate", 0.0, (1e3 / 30.0, 3e4)),
    ],
)
def test_a_range_of_long_delays_has_an_end(parameter, delay, ends):
    got = RIGID.replace(delay=delay).required(parameter, 10.0)
    np.testing.assert_allclose(got.range, ends, rtol=1e-12)


def test_a_crossing_next_to_what_cannot_be_computed_is_none():
    assert _find_crossing(lambda x: np.log(x) if abs(x - 1.5) > 0.6 else np.nan, 0.5, 3.0) is None
    assert _find_crossing(np.log, 0.5, 3.0) == Crossing(1.0 + 1e-11, "above")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("velocity.cutof", 1e3), "parameter: got 'velocity.cutof'.*did you mean 'velocity.cutoff'"),
        (("stiffness", 1e3), "parameter: got 'stiffness'"),
        (("velocity.order", 1e3), "must be an integer"),
        (("mass", -1.0), "stiffness: got -1.0"),
        (("mass", 1e3, (2.0, 1.0)), "within: got"),
    ],
)
def test_what_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        FILTERED.required(*arguments[:2], within=arguments[2] if len(arguments) > 2 else None)


def test_a_parameter_that_is_zero_needs_a_range():
    with pytest.raises(InputError, match="within: delay is 0 now"):
        FILTERED.replace(delay=0.0).required("delay", 1e3)
