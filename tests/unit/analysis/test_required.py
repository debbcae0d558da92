"""Test `Scene.required`, the parameter value at which the maximum stiffness reaches a given stiffness.

References: the closed form of rigid scenes, and K_max on both sides of each crossing.
"""

import numpy as np
import pytest
from required_values import find_required

from zwidth import Device, LowPass, Scene, Status, Timing
from zwidth.analysis.ensemble import Variants
from zwidth.analysis.optimization import Crossing, _find_crossing
from zwidth.core.errors import InputError

RIGID = Scene(Device(0.1, 10.0), Timing(1e-3, 1e-3))
FILTERED = RIGID.replace(velocity=LowPass(cutoff=30.0))


def test_required_damping_of_rigid_scene_matches_closed_form():
    result = RIGID.required("damping", 25e3)
    expected = find_required("damping", 25e3, 1.0, 100.0, mass=0.1, period=1e-3, delay=1e-3)
    assert (result.status, result.sufficient_side) == (Status.OK, "above")
    assert result.value == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("parameter, stiffness, side", [("velocity.cutoff", 9e3, "above"), ("period", 8.5e3, "below")])
def test_max_stiffness_on_both_sides_of_a_crossing(parameter, stiffness, side):
    value = FILTERED.parameters()[parameter]
    result = FILTERED.required(parameter, stiffness, within=(0.2 * value, 4.0 * value))
    assert result.status == Status.OK
    assert result.sufficient_side == side
    for crossing in result.crossings:
        sign = 1.0 if crossing.sufficient_side == "above" else -1.0
        for value_inside in (crossing.value, crossing.value * (1.0 + 1e-4 * sign)):
            assert FILTERED.replace(**{parameter: value_inside}).max_stiffness().stiffness >= stiffness
        outside = FILTERED.replace(**{parameter: crossing.value * (1.0 - 1e-4 * sign)})
        assert outside.max_stiffness().stiffness < stiffness


def test_nearest_of_several_crossings_is_returned():
    """K_max has its minimum at a mass between the two crossings."""
    scene = RIGID.replace(velocity=LowPass(cutoff=100.0))
    light, heavy = (scene.replace(mass=mass).required("mass", 7.8e3, within=(0.01, 0.5)) for mass in (0.012, 0.2))
    assert [crossing.sufficient_side for crossing in light.crossings] == ["below", "above"]
    assert (light.sufficient_side, heavy.sufficient_side) == ("below", "above")
    assert light.value < 0.03 < heavy.value
    for result in (light, heavy):
        assert scene.replace(mass=result.value).max_stiffness().stiffness == pytest.approx(7.8e3, rel=1e-9)


@pytest.mark.parametrize("mass, above", [(0.0204557, 1e-3), (0.023, 1e-3), (0.03, 1e-6)])
def test_narrow_dip_of_max_stiffness_is_detected(mass, above):
    """K_max has a minimum of 7585.93 N/m at 20.5 g."""
    stiffness, scene = 7585.93 * (1.0 + above), RIGID.replace(velocity=LowPass(cutoff=100.0), mass=mass)
    result = scene.required("mass", stiffness, within=(0.000592, 0.5326))
    assert [crossing.sufficient_side for crossing in result.crossings] == ["below", "above"]
    assert result.crossings[0].value < 0.0204557 < result.crossings[1].value
    assert scene.replace(mass=result.value).max_stiffness().stiffness >= stiffness


def test_required_rate_is_inverse_of_required_period():
    rate, period = (FILTERED.required(name, 8.5e3) for name in ("rate", "period"))
    assert (rate.sufficient_side, period.sufficient_side) == ("above", "below")
    assert rate.value * period.value == pytest.approx(1.0, rel=1e-10)


def test_unreachable_stiffness_and_stiffness_reached_everywhere():
    unreachable = FILTERED.required("mass", 1e9, within=(0.05, 0.2))
    assert (unreachable.status, unreachable.sufficient_side, unreachable.crossings) == (
        Status.UNREACHABLE,
        "nowhere",
        (),
    )
    assert np.isnan(unreachable.value)
    everywhere = FILTERED.required("mass", 1.0, within=(0.05, 0.2))
    assert (everywhere.status, everywhere.sufficient_side, everywhere.value) == (Status.OK, "everywhere", 0.1)


@pytest.mark.parametrize("failing, status", [((11, 15), Status.NOT_CONVERGED), ((60, 80), Status.OK)])
def test_required_is_nan_if_a_nearer_crossing_cannot_be_excluded(failing, status, monkeypatch):
    single, many = Scene.max_stiffness, Variants.stiffest

    def fail(damping, statuses):
        return np.where((failing[0] < damping) & (damping < failing[1]), Status.NOT_CONVERGED, statuses)

    def fail_in_interval(scene, **options):
        maximum = single(scene, **options)
        return maximum._replace(status=fail(scene.device.damping, maximum.status))

    def fail_in_interval_of_many(variants, negative):
        stiffness, damping, statuses = many(variants, negative)
        return stiffness, damping, fail(variants.drawn["damping"], statuses)

    monkeypatch.setattr(Scene, "max_stiffness", fail_in_interval)
    monkeypatch.setattr(Variants, "stiffest", fail_in_interval_of_many)
    result = RIGID.required("damping", 25e3)
    assert (result.status, np.isnan(result.value)) == (status, status != Status.OK)
    assert [crossing.sufficient_side for crossing in result.crossings] == ["above"]


def test_range_ends_at_values_rejected_by_the_scene():
    result = FILTERED.required("velocity.cutoff", 9e3, within=(20.0, 5e3))
    assert result.range[1] < 500.0
    assert [crossing.sufficient_side for crossing in result.crossings] == ["above"]


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
def test_range_of_delay_and_period_is_bounded(parameter, delay, ends):
    result = RIGID.replace(delay=delay).required(parameter, 10.0)
    np.testing.assert_allclose(result.range, ends, rtol=1e-12)


def test_no_crossing_is_bracketed_next_to_nan():
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
def test_required_rejects_invalid_arguments(arguments, message):
    with pytest.raises(InputError, match=message):
        FILTERED.required(*arguments[:2], within=arguments[2] if len(arguments) > 2 else None)


def test_zero_parameter_requires_a_range():
    with pytest.raises(InputError, match="within: delay is 0 now"):
        FILTERED.replace(delay=0.0).required("delay", 1e3)
