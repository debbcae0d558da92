"""Components of the stable region: the maximum stiffness belongs to the component connected to K = 0, not to islands.

The reference flood-fills a grid of walls from K = 0; each label follows from Jury's table of the polynomial in
`proved_loop.ball_parts`, which is independent of the library.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import proved_loop
import pytest
import scipy.signal
from scipy import ndimage

import zwidth
from zwidth import Butterworth, Coupling, Device, LowPass, Operator, Scene, Timing, VelocityFilter, WindowedDifference

TIMING = Timing(1e-3, 1e-3)
PHANTOM = Scene(Device(0.1, 10.0), TIMING)


def is_stable(scene: Scene, stiffness: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return whether Jury's criterion is satisfied at each wall, for arrays of one shape."""
    parts = proved_loop.ball_parts(scene)
    degree = max(part.degree() for part in parts)
    terms = [np.array([float(part[k].real.mid()) for k in range(degree, -1, -1)]) for part in parts]
    table = terms[0][:, None] + terms[1][:, None] * stiffness.ravel() + terms[2][:, None] * damping.ravel()
    stable = np.ones(stiffness.size, bool)
    while len(table) > 1:
        stable &= np.abs(table[-1]) < np.abs(table[0])
        ratio = np.where(stable, table[-1] / np.where(table[0] == 0, 1.0, table[0]), 0.0)
        table = (table - ratio * table[::-1])[:-1]
        table = table / np.where(table[0] == 0, 1.0, np.abs(table[0]))
    return stable.reshape(stiffness.shape)


def flood_fill(scene: Scene, negative: bool, points: int) -> tuple[float, float, float]:
    """Return the maximum stiffness connected to K = 0 on a grid, that of all islands (NaN if none), and the grid's
    step.
    """
    outlines = scene.stable_region()
    largest = 1.02 * max(float(outline.stiffness.max()) for outline in outlines)
    dampings = np.concatenate([outline.virtual_damping for outline in outlines])
    stiffness = np.union1d(
        np.geomspace(1e-5 * largest, 0.05 * largest, points // 6), np.linspace(0.02 * largest, largest, points)
    )
    damping = np.append(np.linspace(dampings.min(), dampings.max(), points), 0.0)
    damping.sort()
    pieces, _ = ndimage.label(is_stable(scene, *np.meshgrid(stiffness, damping)))  # pyright: ignore
    main = (pieces > 0) & np.isin(pieces, np.setdiff1d(pieces[:, 0], 0))
    allowed = np.full(damping.shape, True) if negative else damping >= 0
    reached = [(part & allowed[:, None]).any(0) for part in (main, (pieces > 0) & ~main)]
    tops = [float(stiffness[part].max()) if part.any() else np.nan for part in reached]
    return tops[0], tops[1], float(np.diff(stiffness)[-1])


SCENES: dict[str, tuple[Scene, bool]] = {
    "island of 47 N/m": (PHANTOM.replace(velocity=WindowedDifference(21)), False),
    "without islands": (PHANTOM.replace(velocity=WindowedDifference(25)), False),
    "island at B < 0": (PHANTOM.replace(velocity=WindowedDifference(34)), True),
    "coupling": (
        Scene(Device(0.1, 2.0, Coupling(0.03, 2.5e4, 0.4, "motor")), TIMING, velocity=Butterworth(60.0)),
        True,
    ),
    "light link above the Nyquist frequency": (
        Scene(Device(0.1, 5.0, Coupling(0.02, 1.7e7, 3.0, "tip")), TIMING, velocity=LowPass(cutoff=150.0, order=2)),
        True,
    ),
    "device with operator": (
        Scene(
            Device(0.1, 1.0),
            TIMING,
            velocity=WindowedDifference(12),
            operator=Operator(0.5, 6.0, 300.0, 2000.0, 4.0),
        ),
        True,
    ),
    "filter with position feedthrough": (
        Scene(Device(0.1, 10.0), TIMING, velocity=VelocityFilter([700.0, -690.0], [1.0, 0.0])),
        True,
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_maximum_stiffness_agrees_with_a_flood_fill_from_zero_stiffness(name):
    scene, negative = SCENES[name]
    top, other, step = flood_fill(scene, negative, 160)
    wall = scene.max_stiffness(negative_damping=negative)
    # The grid misses intervals thinner than its step.
    assert wall.stiffness == pytest.approx(top, abs=2.0 * step)
    islands = scene.islands(negative_damping=negative)
    assert bool(islands) >= np.isfinite(other)
    if np.isfinite(other):
        assert islands[0].stiffness[1] == pytest.approx(other, abs=2.0 * step)


@pytest.mark.parametrize("ratio", [1.0, 1.000001, 1.001])
def test_corner_with_slightly_different_dampings_of_its_edges(ratio):
    # Rounding errors of the two edges place the corner at dampings that differ by 1e-7.
    tip = zwidth.Coupling(2.2583072897267993 * ratio, 4608848.735088809, 0.46886219337213614)
    slow = zwidth.LowPass(cutoff=12.558130981789532, coded_period=0.0002658533987553419)
    timing = zwidth.Timing(0.0003469063541584205)
    top = zwidth.Scene(zwidth.Device(1.3434767231708333, 0.0, tip), timing, velocity=slow).max_stiffness()
    assert top.status == zwidth.Status.OK
    assert top.stiffness == pytest.approx(7151.5 - 5400 * (ratio - 1.0), rel=1e-5)


def test_island_of_a_window_of_21_samples_is_reported_separately():
    scene = SCENES["island of 47 N/m"][0]
    wall = scene.max_stiffness()
    assert (wall.stiffness, wall.virtual_damping) == (pytest.approx(6846.3642, abs=1e-3), 0.0)
    (island,) = scene.islands()
    assert island.stiffness == pytest.approx((10549.409, 10596.153), abs=1e-2)
    assert island.virtual_damping == pytest.approx((74.343586, 75.493801), abs=1e-5)
    # Walls of the island are stable, but just below it no wall is.
    assert scene.is_stable(10595.5, np.linspace(*island.virtual_damping, 4001)).any()
    low = 0.999 * island.stiffness[0]
    assert not scene.is_stable(low, np.linspace(*island.virtual_damping, 401)).any()
    assert [outline.island for outline in scene.stable_region()] == [False, True]


def test_sensitivities_and_assessment_exclude_islands():
    scene = SCENES["island of 47 N/m"][0]
    largest = float(scene.max_stiffness().stiffness)
    assert scene.sensitivities().stiffness == pytest.approx(largest, rel=1e-12)
    verdict: Any = zwidth.assess(scene.replace(wall=zwidth.VirtualWall(1e3, 10.0)))
    assert verdict.stiffness_max == largest


def test_rigid_scene_has_no_islands():
    assert PHANTOM.islands() == []
    assert [outline.island for outline in PHANTOM.stable_region()] == [False]


def make_resonant_scene(modes, cutoff, mass, damping, velocity, delay):
    """Return a scene whose resonance makes the boundary pass the stable walls within 1e-5 of the sampling rate."""
    device = Device(mass, damping, modes=[zwidth.Mode(*mode) for mode in modes], actuator=zwidth.Actuator(cutoff))
    return Scene(device, Timing(1e-3, delay), velocity=velocity)


@pytest.mark.parametrize(
    "scene",
    [
        make_resonant_scene(
            [(430.735, 0.00210914, 1.45971), (29.2526, 0.0150854, 0.0487502), (663.756, 0.00467683, 0.0577636)],
            3817.53 / (2 * np.pi),
            0.0664063,
            0.150808,
            zwidth.BackwardDifference(),
            0.0,
        ),
        make_resonant_scene(
            [(189.887, 0.00215821, 1.44521), (382.025, 0.0169526, -0.507537)],
            568.96 / (2 * np.pi),
            0.25984,
            4.36215,
            LowPass(time_constant=1.02432e-3, order=2),
            1e-3,
        ),
    ],
    ids=["undelayed", "filtered"],
)
def test_edge_between_two_nodes_belongs_to_the_outline(scene):
    (outline,) = scene.stable_region()
    # The edge in question lies at the largest damping of the softest walls.
    softest = scene.stable_damping(1e-3)
    assert outline.virtual_damping.max() == pytest.approx(softest.max(), rel=1e-3)
    area = float(np.trapezoid(*measure_widths(scene, outline.virtual_damping)))
    assert outline.area == pytest.approx(area, rel=2e-3)


def measure_widths(scene, dampings):
    """Return the total length of the stable intervals at dampings within the range, and these dampings."""
    rows = np.linspace(dampings.min(), dampings.max(), 801)[1:-1]
    return [float(np.sum(np.diff(scene.stable_stiffness(row)))) for row in rows.tolist()], rows


def sampled(*system) -> zwidth.LinearDevice:
    """Return a device from coefficients or roots in z, for a period of 1 ms."""
    model: Any = scipy.signal.dlti
    return zwidth.LinearDevice(model(*system, dt=1e-3))


def test_two_poles_have_a_triangular_stable_region():
    # z^2 + (gK + gB/T - a) z - gB/T: all pole pairs on the unit circle are at B = -T/g.
    scene, pole = Scene(zwidth.LinearDevice(([1.0], [0.1, 10.0])), Timing(1e-3)), np.exp(-0.1)
    gain = (1.0 - pole) / 10.0
    assert scene.stable_stiffness(0.0)[0] == pytest.approx([-10.0, (1.0 + pole) / gain], rel=1e-12)
    assert scene.stable_damping(1.0)[0] == pytest.approx(
        1e-3 / gain * np.array([-1.0, (1.0 + pole - gain) / 2.0]), rel=1e-12
    )
    (outline,) = scene.stable_region()
    assert outline.area == pytest.approx(4e-3 / gain**2, rel=1e-9)
    steepest = scene.max_stiffness(negative_damping=True)[:2]
    assert steepest == pytest.approx([(3.0 + pole) / gain, -1e-3 / gain], rel=1e-12)
    assert scene.max_stiffness()[:2] == scene.max_stiffness(negative_damping=False)[:2]
    assert scene.max_stiffness(negative_damping=False)[:2] == pytest.approx([(1.0 + pole) / gain, 0.0], rel=1e-12)
    # A mass discretized by semi-implicit Euler: K < 4 m/T^2, and B > 0 without friction.
    euler = Scene(sampled([1e-5, 0.0], [1.0, -2.0, 1.0]), Timing(1e-3))
    for negative in (False, True):
        assert euler.max_stiffness(negative_damping=negative)[:2] == pytest.approx([4e5, 0.0], rel=1e-12, abs=1e-12)
    assert euler.islands(negative_damping=True) == []
    (outline,) = euler.stable_region()
    assert outline.area == pytest.approx(4e7, rel=1e-9)


def test_plant_without_inertia_has_a_corner_at_zero_damping():
    # z^4 + g (K z + B (z - 1)/T): at B = 0 three poles reach the unit circle simultaneously.
    wall = Scene(sampled([4.05e-6], [1.0, 0.0]), Timing(1e-3, 2e-3)).max_stiffness(negative_damping=False)
    assert (wall.status, wall.stiffness) == (zwidth.Status.OK, pytest.approx(1.0 / 4.05e-6, rel=1e-12))
    assert wall.virtual_damping == pytest.approx(0.0, abs=1e-9)


def test_soft_walls_between_two_nodes_without_a_detected_edge():
    poles = [-0.7852, 0.9938, -0.99991 + 0.00296j, 0.795 + 0.086j, -0.8538 + 0.5165j]
    poles += [pole.conjugate() for pole in poles[2:]]
    device = sampled([], poles, -2.646e-5)
    scene = Scene(device, Timing(1e-3, 1e-3), velocity=zwidth.Butterworth(70.66, order=3))
    ends, wall = scene.stable_stiffness(0.0), scene.max_stiffness()
    assert (wall.status, wall.stiffness) == (zwidth.Status.OK, pytest.approx(ends[0, 1], rel=1e-12))
    loop = np.poly(poles).real
    for ratio, stable in ((1.0 - 1e-4, True), (1.0 + 1e-4, False)):
        closed = np.append(loop, 0.0)
        closed[-1] -= 2.646e-5 * ratio * wall.stiffness
        assert (np.abs(np.roots(closed)).max() < 1.0) == stable


def test_rounding_errors_above_zero_stiffness_are_no_island():
    # The device moves against the force: no wall with K > 0 is stable.
    device = sampled([-3.9e-6], [1.0, -1.98, 0.98])
    assert Scene(device, Timing(1e-3, 1e-3)).islands() == []


@pytest.mark.parametrize("damping", [1e7, 1e8])
@pytest.mark.parametrize("hand", [(0.1, 1.0, 10.0, 1e3, 1.0), (0.05, 1.0, 1.0)])
def test_strongly_damped_device_with_a_spring_has_one_component(damping, hand):
    """Regression: at the lower end dampings differ by rounding errors only, so that lines were reported as
    components.
    """
    timing = zwidth.Timing(1e-3, 1e-3)
    scene = zwidth.Scene(zwidth.Device(0.1, damping), timing, operator=zwidth.Operator(*hand))
    (outline,) = scene.stable_region()
    assert not outline.hole
    assert not outline.island
    assert outline.stiffness.max() == pytest.approx(scene.max_stiffness().stiffness, rel=1e-6)


@pytest.mark.parametrize("delay, samples", [(2, 2), (2, 4), (3, 3), (4, 6), (8, 2)])
def test_loop_in_powers_of_z_agrees_with_the_reduced_loop(delay, samples):
    """Regression: poles reach the circle several at a time; coinciding edges took a minute, three lines raised an
    error.
    """
    power = int(np.gcd(delay, samples))
    # A delayed force, and a device that comes to rest within a period.
    late = Scene(sampled([1e-4], np.eye(1, delay + 1)[0]), Timing(1e-3))
    fast = Scene(zwidth.LinearDevice(([16.0], [1.0, 1.6e5])), Timing(1e-3, (delay - 1) * 1e-3))
    simple = Scene(sampled([1e-4], np.eye(1, delay // power + 1)[0]), Timing(1e-3))
    simple = simple.replace(velocity=WindowedDifference(samples // power))
    for negative in (False, True):
        expected = simple.max_stiffness(negative_damping=negative)
        for scene in (late, fast):
            wall = scene.replace(velocity=WindowedDifference(samples)).max_stiffness(negative_damping=negative)
            assert wall.status == expected.status == zwidth.Status.OK
            assert wall.stiffness == pytest.approx(expected.stiffness, rel=1e-9)
            assert wall.virtual_damping == pytest.approx(power * expected.virtual_damping, rel=1e-9, abs=1e-9)
            assert wall.frequency == pytest.approx(expected.frequency / power, rel=1e-9)


def test_poles_at_equal_angles_are_a_loop_in_powers_of_z():
    # y^2 + (g K + g B/(2 T) - 1/4) y - g B/(2 T) with y = z^2: all pole pairs on the circle are at B = -2 T/g.
    scene = Scene(sampled([1e-4], [1.0, 0.0, -0.25]), Timing(1e-3), velocity=WindowedDifference(2))
    assert scene.max_stiffness(negative_damping=True)[:2] == pytest.approx([32_500.0, -20.0], rel=1e-12)
    assert scene.max_stiffness()[:2] == pytest.approx([12_500.0, 0.0], rel=1e-12)
    (outline,) = scene.stable_region()
    assert outline.area == pytest.approx(800e3, rel=1e-9)


@pytest.mark.parametrize("delay", [2.0, 2.5])
def test_edges_meeting_at_zero_damping_enclose_soft_walls(delay):
    """Regression: three edges meet at B = 0, and none was assigned to that line, so that no maximum was found."""
    # z^3 + g K with a pole that decays within the period, with a slow filter; and a delay with a window.
    fast_device = zwidth.LinearDevice(([5e6], [1.0, 5e6]))
    slow = Scene(fast_device, Timing(3.2e-5, delay * 3.2e-5), velocity=LowPass(cutoff=59.23))
    window = Scene(sampled([1e-4], np.eye(1, 6)[0]), Timing(1e-3), velocity=WindowedDifference(2))
    for scene, stiffest in ((slow, 1.0), (window, 1e4)):
        wall = scene.max_stiffness()
        assert wall.status == zwidth.Status.OK
        assert wall[:2] == pytest.approx([stiffest, 0.0], rel=1e-9, abs=1e-9)
        assert scene.loop.is_connected(0.5 * stiffest / scene.units.stiffness, 0.0)
