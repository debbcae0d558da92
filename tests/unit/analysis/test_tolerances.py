"""Test `simulate_tolerances`: sampled devices, the share of stable devices, and the reliable stiffness.

References: decisions for the individual devices, and the interval of Clopper and Pearson (1934).
"""

import numpy as np
import pytest

import zwidth
from zwidth.analysis.tolerances import _compute_confidence_interval

WALL = zwidth.VirtualWall(17e3, 35.0)
SCENE = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1e-3), WALL)
SHARES = {"mass": 0.2, "damping": 0.3}


def test_each_label_matches_its_sampled_device():
    simulation = zwidth.simulate_tolerances(SCENE, SHARES, samples=500, seed=3)
    for k in range(0, 500, 25):
        one = SCENE.replace(**{name: float(values[k]) for name, values in simulation.drawn.items()})
        assert simulation.labels[k] == one.is_stable(WALL.stiffness, WALL.virtual_damping)
    assert simulation.stable == simulation.labels.mean()
    assert simulation.stable_low < simulation.stable < simulation.stable_high


def test_stiffness_max_matches_the_scene_at_zero_tolerance():
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1.5e-3), WALL)
    simulation = zwidth.simulate_tolerances(scene, {"mass": 1e-12}, samples=3)
    np.testing.assert_allclose(simulation.stiffness_max, scene.max_stiffness().stiffness, rtol=1e-11)


def test_stiffness_is_the_quantile_for_the_reliability():
    simulation = zwidth.simulate_tolerances(SCENE, SHARES, samples=2000, reliability=0.9)
    scenes = [SCENE.replace(mass=m, damping=b) for m, b in zip(*simulation.drawn.values(), strict=True)]
    for factor, expected in ((1 - 1e-9, True), (1 + 1e-9, False)):
        stable_share = np.mean(
            [scene.is_stable(simulation.stiffness * factor, WALL.virtual_damping) for scene in scenes]
        )
        assert (stable_share >= 0.9) == expected
    assert simulation.stiffness_max > simulation.stiffness


def test_stiffness_max_lies_between_worst_case_and_nominal():
    simulation = zwidth.simulate_tolerances(SCENE, SHARES)
    box = {"mass": zwidth.Interval(0.08, 0.12), "damping": zwidth.Interval(7.0, 13.0)}
    weakest = zwidth.robust_max_stiffness(**box, period=1e-3, delay=1e-3)
    assert weakest.stiffness < simulation.stiffness_max < SCENE.max_stiffness().stiffness


def test_samples_are_reproducible_and_follow_the_distribution():
    first, again, other = (zwidth.simulate_tolerances(SCENE, SHARES, samples=4000, seed=s) for s in (1, 1, 2))
    assert np.array_equal(first.drawn["mass"], again.drawn["mass"])
    assert not np.array_equal(first.drawn["mass"], other.drawn["mass"])
    mass = first.drawn["mass"]
    assert 0.08 <= mass.min() < 0.081
    assert 0.119 < mass.max() <= 0.12
    normal = zwidth.simulate_tolerances(SCENE, {"mass": zwidth.Tolerance(0.1, "normal")}, samples=4000).drawn["mass"]
    # The standard errors of mean and standard deviation of 4000 samples are 1.6e-4 and 1.1e-4.
    assert normal.mean() == pytest.approx(0.1, abs=6e-4)
    assert normal.std() == pytest.approx(0.01, abs=5e-4)


def test_mass_tolerance_excludes_rigidly_coupled_operator():
    hand = zwidth.Operator(mass=0.1)
    simulation = zwidth.simulate_tolerances(
        zwidth.Scene(SCENE.device, SCENE.timing, WALL, operator=hand), SHARES, samples=60
    )
    for k in range(0, 60, 6):
        device = zwidth.Device(float(simulation.drawn["mass"][k]) + 0.1, float(simulation.drawn["damping"][k]))
        assert simulation.labels[k] == zwidth.Scene(device, SCENE.timing).is_stable(17e3, 35.0)


def test_tolerances_of_velocity_filter():
    scene = zwidth.Scene(
        SCENE.device, SCENE.timing, zwidth.VirtualWall(11e3, 25.0), velocity=zwidth.LowPass(cutoff=100)
    )
    simulation = zwidth.simulate_tolerances(scene, {"velocity.cutoff": 0.3}, samples=12)
    for k, cutoff in enumerate(simulation.drawn["velocity.cutoff"]):
        assert simulation.labels[k] == scene.replace(**{"velocity.cutoff": float(cutoff)}).is_stable(11e3, 25.0)
    assert 0 < simulation.stable < 1
    assert simulation.stiffness_max > simulation.stiffness


def test_confidence_interval_without_failures():
    """Clopper and Pearson 1934: without failures in n devices the lower bound of the share is 0.025^(1/n)."""
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
def test_simulate_tolerances_rejects_invalid_arguments(tolerances, options, message):
    with pytest.raises(zwidth.InputError, match=message):
        zwidth.simulate_tolerances(SCENE, tolerances, **options)


def test_tolerance_of_a_zero_parameter_is_rejected():
    scene = zwidth.Scene(zwidth.Device(0.1), SCENE.timing, WALL)
    with pytest.raises(zwidth.InputError, match="damping is 0"):
        zwidth.simulate_tolerances(scene, {"damping": 0.1})
