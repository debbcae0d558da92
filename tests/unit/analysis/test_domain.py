"""Test that walls outside the accepted range are rejected, elementwise in arrays, and no others."""

import numpy as np
import pytest

import zwidth
from zwidth.core.status import Status


@pytest.mark.parametrize(
    "velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=100)], ids=["rigid", "filtered"]
)
def test_walls_out_of_range_yield_nan_and_status(velocity):
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1.5e-3), velocity=velocity)
    walls = np.array([1e3, 1e70, 1e-80, 1e3]), np.array([5.0, 5.0, 5.0, 1e80])
    rejected = [False, True, True, True]
    for values in (scene.spectral_radius(*walls), scene.passivity_margin(*walls), scene.margins(*walls).gain_margin):
        np.testing.assert_array_equal(np.isnan(values), rejected)
    np.testing.assert_array_equal(np.isnan(scene.poles(*walls)).all(-1), rejected)
    np.testing.assert_array_equal(scene.is_stable(*walls), np.logical_not(rejected))
    for method in ("auto", "companion", "certified"):
        decision = scene.decide_stability(*walls, method=method)
        assert decision.status.tolist() == [Status.OK] + 3 * [Status.OUT_OF_RANGE]
        np.testing.assert_array_equal(decision.stable, np.logical_not(rejected))
    assert scene.stable_damping(1e-80).shape == (0, 2)
    assert np.isnan(scene.stable_stiffness([1e80, 1e-80])).all()
    with pytest.raises(zwidth.InputError, match=r"^alpha: got .*must be"):
        scene.is_stable(1e70, 5.0)


HUGE = 10**400
REFUSED = {
    "required": lambda scene: scene.required("mass", HUGE),
    "within": lambda scene: scene.required("mass", 1e4, within=(1, HUGE)),
    "recommend": lambda scene: scene.recommend(phase_margin=HUGE),
    "filter": lambda scene: zwidth.VelocityFilter([HUGE, 1], [1, 0]),
    "response": lambda scene: zwidth.MeasuredDevice([HUGE] * 9, [1] * 9),
    "delay": lambda scene: zwidth.is_passive(0.1, 0.1, 0.1, HUGE),
}


@pytest.mark.parametrize("function", REFUSED.values(), ids=REFUSED)
def test_integers_that_overflow_float64_are_rejected(function):
    with pytest.raises(zwidth.InputError, match=r"got|is needed"):
        function(zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3)))


@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=100)])
def test_overflowing_stiffness_equals_infinite_stiffness(velocity):
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), velocity=velocity)
    assert scene.decide_stability(HUGE, 1) == scene.decide_stability(np.inf, 1)
    assert np.isnan(scene.spectral_radius(HUGE, 1))
