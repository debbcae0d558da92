"""What lies beyond the range of the model is refused, point by point in arrays; nothing inside is."""

import numpy as np
import pytest

import zwidth
from zwidth.core.status import Status


@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=100)], ids=["rigid", "parts"])
def test_walls_beyond_the_range_have_no_answer(velocity):
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1.5e-3), velocity=velocity)
    walls = np.array([1e3, 1e70, 1e-80, 1e3]), np.array([5.0, 5.0, 5.0, 1e80])
    none = [False, True, True, True]
    for answer in (scene.spectral_radius(*walls), scene.passivity_margin(*walls), scene.margins(*walls).gain_margin):
        np.testing.assert_array_equal(np.isnan(answer), none)
    np.testing.assert_array_equal(np.isnan(scene.poles(*walls)).all(-1), none)
    np.testing.assert_array_equal(scene.is_stable(*walls), np.logical_not(none))
    for method in ("auto", "companion", "certified"):
        found = scene.decide_stability(*walls, method=method)
        assert found.status.tolist() == [Status.OK] + 3 * [Status.OUT_OF_RANGE]
        np.testing.assert_array_equal(found.stable, np.logical_not(none))
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


@pytest.mark.parametrize("ask", REFUSED.values(), ids=REFUSED)
def test_whole_numbers_beyond_float64_are_refused(ask):
    with pytest.raises(zwidth.InputError, match=r"got|is needed"):
        ask(zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3)))


@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=100)])
def test_a_wall_beyond_float64_is_one_of_infinite_stiffness(velocity):
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), velocity=velocity)
    assert scene.decide_stability(HUGE, 1) == scene.decide_stability(np.inf, 1)
    assert np.isnan(scene.spectral_radius(HUGE, 1))
