"""Stable intervals of the damping at a stiffness, against poles proved in balls."""

import any_loop
import numpy as np
import proved_loop
import pytest

import zwidth
from zwidth.stability.linear.rows import find_stable_dampings


@pytest.mark.parametrize("alpha", [0.3, 5.0, np.nan, np.inf])
def test_a_column_beyond_the_stable_set_is_empty(alpha):
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))
    assert find_stable_dampings(scene.loop.boundary, alpha).shape == (0, 2)


# Columns that a curve crosses next to its ends, beyond its first or last node, or between two narrow turns.
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
def test_columns_behind_steep_filters(name):
    device, timing, velocity, stiffnesses = STEEP[name]
    scene = zwidth.Scene(device, timing, velocity=velocity)
    for stiffness in stiffnesses:
        assert check_column(scene, stiffness) is not None


def test_an_end_near_0_of_a_soft_wall_keeps_its_digits():
    # An undamped tip and 2e-7 of K_max: 1 part in 60 of the damping is stable, and rows there move hardly at all.
    coupling = zwidth.Coupling(2.906851785633506, 205186.7108746703, 0.0, "tip")
    timing = zwidth.Timing(0.00038470647865914017, 0.00011541194359774204)
    scene = zwidth.Scene(zwidth.Device(2.9043679345862086, 0.0, coupling), timing)
    exact, found = proved_loop.proved_column(scene, 0.04824013422078757), scene.stable_damping(0.04824013422078757)
    assert exact is not None
    np.testing.assert_allclose(found, exact, rtol=1e-8)


def check_column(scene, stiffness):
    """One column against balls; the share of each end by which it is off, of the larger one where it is nearly 0."""
    exact = proved_loop.proved_column(scene, stiffness)
    if exact is None:
        return None
    found = find_stable_dampings(scene.loop.boundary, stiffness / scene.units.stiffness) * scene.units.virtual_damping
    assert found.shape == exact.shape, (scene, stiffness, found, exact)
    if exact.size:
        np.testing.assert_allclose(found, exact, rtol=1e-9, atol=1e-12 * np.abs(exact).max())
    return exact


def test_columns_agree_with_proved_ones():
    known = 0
    for seed in range(21):
        rng = np.random.default_rng([seed, 41])
        scene = any_loop.random_scene(any_loop.KINDS[seed % len(any_loop.KINDS)], rng)
        if seed % 3 == 0:
            cutoff = 10 ** rng.uniform(-2.7, -0.5) / float(scene.timing.period)
            scene = scene.replace(velocity=zwidth.Butterworth(cutoff, int(rng.integers(1, 8))))
        top = float(scene.max_stiffness().stiffness)
        top = top if np.isfinite(top) else float(scene.units.stiffness)
        shares = 10 ** rng.uniform(-7, -1), rng.uniform(0.1, 1.0)
        known += sum(check_column(scene, top * share) is not None for share in shares)
    # Poles next to the circle for every wall, as of an undamped coupling, are not counted.
    assert known >= 36
