"""Stable intervals of virtual damping at a given stiffness, against poles certified in ball arithmetic."""

import any_loop
import numpy as np
import proved_loop
import pytest

import zwidth
from zwidth.stability.linear.rows import find_stable_dampings


@pytest.mark.parametrize("alpha", [0.3, 5.0, np.nan, np.inf])
def test_no_stable_damping_above_the_maximum_stiffness(alpha):
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))
    assert find_stable_dampings(scene.loop.boundary, alpha).shape == (0, 2)


# The curve crosses these lines near their ends, outside of its first or last node, or between two close extrema.
STEEP = {
    "order 4 at 3 Hz": (
        zwidth.Device(0.1, 10),
        zwidth.Timing(1e-3, 1e-3),
        zwidth.Butterworth(3, 4),
        (1.0, 60.0, 6000.0),
    ),
    "order 7 at 6.7 Hz": (
        zwidth.Device(0.1, 0.74),
        zwidth.Timing(1e-3),
        zwidth.Butterworth(6.7, 7),
        (1e-3, 30.0, 1040.0),
    ),
    "order 2 at 20 Hz": (zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 4e-4), zwidth.Butterworth(20, 2), (0.1, 3e3, 9e3)),
}


@pytest.mark.parametrize("name", STEEP)
def test_stable_dampings_with_filters_of_low_cutoff(name):
    device, timing, velocity, stiffnesses = STEEP[name]
    scene = zwidth.Scene(device, timing, velocity=velocity)
    for stiffness in stiffnesses:
        assert check_column(scene, stiffness) is not None


def test_end_near_zero_damping_of_a_soft_wall_is_accurate():
    # An undamped tip at 2e-7 of K_max: 1/60 of the damping range is stable, and the intervals hardly depend on K.
    coupling = zwidth.Coupling(2.906851785633506, 205186.7108746703, 0.0, "tip")
    timing = zwidth.Timing(0.00038470647865914017, 0.00011541194359774204)
    scene = zwidth.Scene(zwidth.Device(2.9043679345862086, 0.0, coupling), timing)
    exact, computed = proved_loop.proved_column(scene, 0.04824013422078757), scene.stable_damping(0.04824013422078757)
    assert exact is not None
    np.testing.assert_allclose(computed, exact, rtol=1e-8)


def check_column(scene, stiffness):
    """Compare the intervals with certified ones; return the latter, or None if balls cannot decide."""
    exact = proved_loop.proved_column(scene, stiffness)
    if exact is None:
        return None
    computed = (
        find_stable_dampings(scene.loop.boundary, stiffness / scene.units.stiffness) * scene.units.virtual_damping
    )
    assert computed.shape == exact.shape, (scene, stiffness, computed, exact)
    if exact.size:
        np.testing.assert_allclose(computed, exact, rtol=1e-9, atol=1e-12 * np.abs(exact).max())
    return exact


def test_stable_dampings_agree_with_certified_intervals():
    decided = 0
    for seed in range(21):
        rng = np.random.default_rng([seed, 41])
        scene = any_loop.random_scene(any_loop.KINDS[seed % len(any_loop.KINDS)], rng)
        if seed % 3 == 0:
            cutoff = 10 ** rng.uniform(-2.7, -0.5) / float(scene.timing.period)
            scene = scene.replace(velocity=zwidth.Butterworth(cutoff, int(rng.integers(1, 8))))
        top = float(scene.max_stiffness().stiffness)
        top = top if np.isfinite(top) else float(scene.units.stiffness)
        fractions = 10 ** rng.uniform(-7, -1), rng.uniform(0.1, 1.0)
        decided += sum(check_column(scene, top * fraction) is not None for fraction in fractions)
    # Not counted are scenes with poles near the unit circle for every wall, for example of an undamped coupling.
    assert decided >= 36
