"""Devices drawn within tolerances: the draws, the share, and what a share of them bears."""

import numpy as np
import pytest

import zwidth
from zwidth.analysis.tolerances import _compute_confidence_interval

WALL = zwidth.VirtualWall(17e3, 35.0)
SCENE = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1e-3), WALL)
SHARES = {"mass": 0.2, "damping": 0.3}


def test_every_label_is_that_of_its_device():
    found = zwidth.simulate_tolerances(SCENE, SHARES, samples=500, seed=3)
    for k in range(0, 500, 25):
        one = SCENE.replace(**{name: float(values[k]) for name, values in found.drawn.items()})
        assert found.labels[k] == one.is_stable(WALL.stiffness, WALL.virtual_damping)
    assert found.stable == found.labels.mean()
    assert found.stable_low < found.stable < found.stable_high


def test_the_maximum_stiffness_is_that_of_the_scene():
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1.5e-3), WALL)
    found = zwidth.simulate_tolerances(scene, {"mass": 1e-12}, samples=3)
    np.testing.assert_allclose(found.stiffness_max, scene.max_stiffness().stiffness, rtol=1e-11)


def test_the_stiffness_is_borne_by_that_share_and_hardly_more_is_not():
    found = zwidth.simulate_tolerances(SCENE, SHARES, samples=2000, reliability=0.9)
    scenes = [SCENE.replace(mass=m, damping=b) for m, b in zip(*found.drawn.values(), strict=True)]
    for factor, enough in ((1 - 1e-9, True), (1 + 1e-9, False)):
        bear = np.mean([scene.is_stable(found.stiffness * factor, WALL.virtual_damping) for scene in scenes])
        assert (bear >= 0.9) == enough
    assert found.stiffness_max > found.stiffness


def test_a_share_of_all_lies_between_the_weakest_and_the_nominal():
    found = zwidth.simulate_tolerances(SCENE, SHARES)
    box = {"mass": zwidth.Interval(0.08, 0.12), "damping": zwidth.Interval(7.0, 13.0)}
    weakest = zwidth.robust_max_stiffness(**box, period=1e-3, delay=1e-3)
    assert weakest.stiffness < found.stiffness_max < SCENE.max_stiffness().stiffness


def test_draws_are_repeated_by_their_seed_and_keep_to_their_distribution():
    first, again, other = (zwidth.simulate_tolerances(SCENE, SHARES, samples=4000, seed=s) for s in (1, 1, 2))
    assert np.array_equal(first.drawn["mass"], again.drawn["mass"])
    assert not np.array_equal(first.drawn["mass"], other.drawn["mass"])
    mass = first.drawn["mass"]
    assert 0.08 <= mass.min() < 0.081
    assert 0.119 < mass.max() <= 0.12
    normal = zwidth.simulate_tolerances(SCENE, {"mass": zwidth.Tolerance(0.1, "normal")}, samples=4000).drawn["mass"]
    # Standard errors of mean and deviation of 4000 draws are 1.6e-4 and 1.1e-4.
    assert normal.mean() == pytest.approx(0.1, abs=6e-4)
    assert normal.std() == pytest.approx(0.01, abs=5e-4)


def test_a_rigid_hand_has_no_tolerance_of_the_device():
    hand = zwidth.Operator(mass=0.1)
    found = zwidth.simulate_tolerances(
        zwidth.Scene(SCENE.device, SCENE.timing, WALL, operator=hand), SHARES, samples=60
    )
    for k in range(0, 60, 6):
        device = zwidth.Device(float(found.drawn["mass"][k]) + 0.1, float(found.drawn["damping"][k]))
        assert found.labels[k] == zwidth.Scene(device, SCENE.timing).is_stable(17e3, 35.0)


def test_parts_are_drawn_as_well():
    scene = zwidth.Scene(
        SCENE.device, SCENE.timing, zwidth.VirtualWall(11e3, 25.0), velocity=zwidth.LowPass(cutoff=100)
    )
    found = zwidth.simulate_tolerances(scene, {"velocity.cutoff": 0.3}, samples=12)
    for k, cutoff in enumerate(found.drawn["velocity.cutoff"]):
        assert found.labels[k] == scene.replace(**{"velocity.cutoff": float(cutoff)}).is_stable(11e3, 25.0)
    assert 0 < found.stable < 1
    assert np.isnan(found.stiffness_max)


def test_the_interval_of_a_share():
    """Clopper and Pearson 1934: no failure in n devices leaves up to 1 - 0.025^(1/n)."""
    low, high = _compute_confidence_interval(100, 100)
    assert high == 1.0
    assert low == pytest.approx(0.025 ** (1 / 100), rel=1e-12)
    assert _compute_confidence_interval(0, 100) == pytest.approx((0.0, 1 - low), rel=1e-12)


@pytest.mark.parametrize(
    ("tolerances", "options", "message"),
    [
        ({"massa": 0.1}, {}, "tolerances: got 'massa', .*did you mean 'mass'"),
        ({"stiffness": 0.1}, {}, "tolerances: got 'stiffness'"),
        ({"mass": 1.5}, {}, "tolerances: mass: got 1.5; pass a share between 0 and 1"),
        ({"mass": zwidth.Tolerance(0.5, "normal")}, {}, "mass: got 0.5; pass a share between 0 and 0.333"),
        ({"mass": 0.1}, {"samples": 0}, "samples: got 0"),
        ({"mass": 0.1}, {"reliability": 1.0}, "reliability: got 1.0"),
    ],
)
def test_what_is_refused(tolerances, options, message):
    with pytest.raises(zwidth.InputError, match=message):
        zwidth.simulate_tolerances(SCENE, tolerances, **options)


def test_nothing_has_no_share():
    scene = zwidth.Scene(zwidth.Device(0.1), SCENE.timing, WALL)
    with pytest.raises(zwidth.InputError, match="damping is 0"):
        zwidth.simulate_tolerances(scene, {"damping": 0.1})
