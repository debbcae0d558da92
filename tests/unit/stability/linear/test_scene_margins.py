"""Margins of scenes: by a fine grid, and for the delay by a state space of its own at each delay."""

import dataclasses

import numpy as np
import pytest
import scipy.optimize
from any_loop import closed_loop_matrix
from independent_scenes import KINDS, random_scene, random_walls

import zwidth

FILTERED = zwidth.Scene(
    zwidth.Device(mass=0.1, damping=3.0), zwidth.Timing(period=1e-3, delay=1e-3), velocity=zwidth.LowPass(cutoff=100.0)
)


def radius_at(scene, stiffness, damping, delay):
    timing = zwidth.Timing(scene.timing.period, delay)
    moved = dataclasses.replace(scene, timing=timing)
    return np.abs(np.linalg.eigvals(closed_loop_matrix(moved, stiffness, damping))).max()


def grid_margins(scene, stiffness, damping):
    """Gain and phase margins of both signs, and the least distance from -1, on 60,000 frequencies."""
    half = 0.5 / scene.timing.period
    frequency = np.concatenate(
        [np.geomspace(1e-7 * half, 0.05 * half, 30000), np.linspace(0.05, 1.0, 30001)[1:] * half]
    )
    L = scene.frequency_response(stiffness, damping, frequency)
    length = np.maximum(np.abs(L), 1e-300)
    size, turn = np.log(length), L.imag / length
    gain, phase = crossings(size), crossings(turn[:-1])
    phase = [(k, share) for k, share in phase if L.real[k] < 0]
    factors = [np.exp(-between(size, *at)) for at in phase] + ([np.exp(-size[-1])] if L.real[-1] < 0 else [])
    phases = [abs(np.angle(-L[k], deg=True) + share * np.angle(L[k + 1] / L[k], deg=True)) for k, share in gain]
    return np.array(factors), np.array(phases), np.abs(1 + L).min()


def crossings(values):
    """Where values change their sign: before which place, and at which share of the way."""
    k = np.flatnonzero((values[1:] > 0) != (values[:-1] > 0))
    return list(zip(k, values[k] / (values[k] - values[k + 1]), strict=True))


def between(values, k, share):
    return values[k] + share * (values[k + 1] - values[k])


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "rigid"])
def test_margins_by_a_fine_grid_and_by_other_delays(kind):
    rng = np.random.default_rng(5)
    for _ in range(2):
        scene = random_scene(kind, rng)
        stiffness, damping = random_walls(scene, rng, 60)
        stable = np.flatnonzero(scene.is_stable(stiffness, damping))[0]
        K, B = stiffness[stable], damping[stable]
        found = scene.margins(K, B)
        factors, phases, distance = grid_margins(scene, K, B)
        # A resonance is sharper than the grid.
        assert 0.98 * distance <= found.modulus_margin <= distance * (1 + 1e-9)
        if phases.size:
            assert found.phase_margin == pytest.approx(phases.min(), rel=1e-3)
        if factors.size:
            nearest = factors[np.argmin(np.abs(np.log(factors)))]
            assert np.log(found.gain_margin) == pytest.approx(np.log(nearest), rel=1e-3, abs=1e-4)
            # At that factor a pole is on the circle.
            edge = closed_loop_matrix(scene, K * found.gain_margin, B * found.gain_margin)
            assert np.abs(np.abs(np.linalg.eigvals(edge)) - 1).min() < 1e-6
        if np.isfinite(found.delay_margin) and found.delay_margin < 40 * scene.timing.period:
            delay = scene.timing.delay + found.delay_margin * (1 + np.array([-1e-4, 1e-4]))
            before, beyond = (radius_at(scene, K, B, t) for t in delay)
            assert before < 1 < beyond
            for share in np.linspace(0.05, 0.95, 10):
                assert radius_at(scene, K, B, scene.timing.delay + share * found.delay_margin) < 1


@pytest.mark.parametrize("stiffness, damping", [(500.0, 1.0), (2e3, 4.0), (4e3, 10.0)])
def test_the_delay_margin_ends_where_an_eigenvalue_first_leaves_the_circle(stiffness, damping):
    def excess(delay):
        return radius_at(FILTERED, stiffness, damping, delay) - 1.0

    delays = np.arange(1.0, 10.0, 0.05) * 1e-3
    first = next(k for k, delay in enumerate(delays) if excess(delay) > 0)
    end = scipy.optimize.brentq(excess, *delays[first - 1 : first + 1], xtol=1e-14)
    expected = end - FILTERED.timing.delay
    assert FILTERED.margins(stiffness, damping).delay_margin == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    "damping, periods, cutoff, wall",
    [
        (1216.5, 1.99, 373.3895, (18852.96595750567, 1284.5443335840655)),
        (2816.9, 3.0, 366.5891, (1068.6242229434915, 2880.773414737671)),
    ],
)
def test_a_delay_that_a_strongly_damped_wall_does_not_bear_for_a_while_ends_its_margin(damping, periods, cutoff, wall):
    # Beyond it the wall is stable once more, nearly a period on.
    device, timing = zwidth.Device(mass=0.1, damping=damping), zwidth.Timing(period=1e-3, delay=periods * 1e-3)
    scene = zwidth.Scene(device, timing, velocity=zwidth.LowPass(cutoff=cutoff))
    found = scene.margins(*wall).delay_margin
    shares, (K, B) = (*np.linspace(0, 0.999, 40), 1.001), wall
    radii = [radius_at(scene, K, B, timing.delay + share * found) for share in shares]
    assert max(radii[:-1]) < 1 < radii[-1]
    assert radius_at(scene, K, B, np.ceil(periods) * 1e-3 + 1.2e-3) < 1


def test_an_undamped_device_answers_nothing_at_half_the_rate():
    scene = zwidth.Scene(zwidth.Device(0.1), zwidth.Timing(1e-3), velocity=zwidth.LowPass(cutoff=100))
    response = scene.frequency_response(1e3, 5.0, [499.9, 500.0])
    assert response[1] == 0
    assert abs(response[0]) < 1e-3


def test_a_wall_whose_loop_is_zero_at_half_the_rate():
    """The filter has a zero there, which a wall without stiffness shares."""
    scene = zwidth.Scene(
        zwidth.Device(0.1, 1.0), zwidth.Timing(1e-3, 1e-3), velocity=zwidth.Butterworth(cutoff=120.0, order=1)
    )
    assert scene.frequency_response(0.0, 30.0, 500.0) == 0
    found = scene.margins(0.0, 30.0)
    factors, phases, distance = grid_margins(scene, 0.0, 30.0)
    assert found.gain_margin == pytest.approx(factors[np.argmin(np.abs(np.log(factors)))], rel=1e-3)
    assert abs(found.phase_margin) == pytest.approx(phases.min(), rel=1e-3)
    assert 0.98 * distance <= found.modulus_margin <= distance * (1 + 1e-9)


def test_a_loop_that_a_stiffer_wall_drives_at_half_the_rate():
    """Behind strong damping the pole that leaves first is real: at z = -1, where L is real in any case."""
    scene = zwidth.Scene(zwidth.Device(0.1, 800.0), zwidth.Timing(1e-3), velocity=zwidth.LowPass(cutoff=400.0))
    found = scene.margins(20e3, 20.0)
    assert found.phase_crossover == pytest.approx(500.0, rel=1e-12)
    assert found.gain_margin == pytest.approx(-1.0 / scene.frequency_response(20e3, 20.0, 500.0).real, rel=1e-12)
    edge = closed_loop_matrix(scene, 20e3 * found.gain_margin, 20.0 * found.gain_margin)
    assert np.abs(np.linalg.eigvals(edge) + 1).min() < 1e-12


def test_an_unstable_wall():
    found = FILTERED.margins(60e3, 4.0)
    assert found.gain_margin < 1
    assert found.phase_margin < 0
    assert found.delay_margin == 0
    assert FILTERED.is_stable(60e3 * found.gain_margin * 0.999, 4.0 * found.gain_margin * 0.999)


def test_of_several_crossovers_the_nearest_counts():
    """Behind a lightly damped spring the resonance crosses |L| = 1 twice more."""
    coupling = zwidth.Coupling(mass=0.1, stiffness=4e3, damping=0.05)
    scene = zwidth.Scene(zwidth.Device(0.1, 0.3, coupling), zwidth.Timing(1e-3))
    factors, phases, _ = grid_margins(scene, 2e3, 1.0)
    assert phases.size > 1
    found = scene.margins(2e3, 1.0)
    assert abs(found.phase_margin) == pytest.approx(phases.min(), rel=1e-2)
    assert found.gain_margin == pytest.approx(factors[np.argmin(np.abs(np.log(factors)))], rel=1e-2)


def test_where_nothing_crosses():
    """A hand holds the device by a stiff spring: the wall's loop gain stays below 1."""
    scene = dataclasses.replace(FILTERED, operator=zwidth.Operator(0.1, 30.0, 5e3))
    found = scene.margins(10.0, 0.0)
    assert np.isinf(found.phase_margin)
    assert np.isinf(found.delay_margin)
    assert found.gain_margin > 1


def test_rigid_scenes_and_walls_out_of_range():
    scene = zwidth.Scene(zwidth.Device(0.1, 3.0), zwidth.Timing(1e-3, 1.5e-3))
    walls = scene.normalize_walls(np.array([500.0, 2e4]), 4.0)
    expected = zwidth.margins(*walls, scene.delta, scene.d)
    found = scene.margins([500.0, 2e4], 4.0)
    np.testing.assert_array_equal(found.gain_margin, expected.gain_margin)
    np.testing.assert_array_equal(found.delay_margin, expected.delay_margin * 1e-3)
    for wall in ((np.nan, 0.0), (np.inf, 0.0), (1e-80, 0.0), (0.0, 1e160)):
        assert all(np.isnan(part) for part in FILTERED.margins(*wall))


def test_a_zero_of_the_open_loop_is_no_crossover():
    """At the antiresonance of an undamped tip L is 0 and its phase jumps: no factor brings a pole there."""
    device = zwidth.Device(0.125, 0.0, zwidth.Coupling(mass=0.03, stiffness=32e3))
    scene = zwidth.Scene(device, zwidth.Timing(period=1.3e-3, delay=1.3e-3))
    factors = np.geomspace(1e-4, 1e4, 81)
    assert not scene.is_stable(2.5e3 * factors, 4.4 * factors).any()
    found = scene.margins(2.5e3, 4.4)
    assert found.gain_margin == 0
    assert np.isnan(found.phase_crossover)


NARROW = {
    # At its flank the last place of the frequency moves the delay by a hundred of its own.
    "flank": (
        zwidth.Device(
            mass=0.0307,
            modes=(zwidth.Mode(199.539, damping_ratio=3.4e-5, mass=0.0865), zwidth.Mode(24.85, 0.0015, mass=0.2)),
        ),
        zwidth.Timing(period=0.714e-3, delay=0.714e-3),
        (0.15, 0.0116),
    ),
    # Its two crossovers appear at a delay of about 0.3 periods, and one has turned past -1 at the next that is laid.
    "appearing": (
        zwidth.Device(mass=0.026013692, damping=12.0476264, modes=(zwidth.Mode(947.58718, 0.000242737, -0.391404527),)),
        zwidth.Timing(period=1.3364519965781e-3),
        (7496.157782518655, 22.952514039378066),
    ),
}


@pytest.mark.parametrize("device, timing, wall", NARROW.values(), ids=NARROW)
def test_the_delay_margin_beside_a_narrow_resonance(device, timing, wall):
    scene = zwidth.Scene(device, timing)
    found = scene.margins(*wall).delay_margin
    assert 0 < found < timing.period
    for share, stable in ((0.5, True), (0.999, True), (1.001, False)):
        moved = scene.replace(timing=zwidth.Timing(timing.period, timing.delay + share * found))
        assert moved.is_stable(*wall, method="certified") == stable


@pytest.mark.parametrize("stiffness", [1e-2, 1e-6])
def test_a_soft_wall_on_a_free_device_has_its_crossover_at_any_frequency(stiffness):
    # L = K/(b s) and K (1 + (B/K) s)/(m s^2) so far below every other frequency of the loop.
    damped = FILTERED.margins(stiffness, 0.0)
    assert damped.gain_crossover == pytest.approx(stiffness / 3.0 / (2 * np.pi), rel=1e-5)
    assert damped.phase_margin == pytest.approx(90.0, abs=1e-2)
    # Minutes, or months.
    assert damped.delay_margin == pytest.approx(0.5 * np.pi * 3.0 / stiffness, rel=1e-4)
    undamped = FILTERED.replace(damping=0.0)
    lead = 6e-3
    found = undamped.margins(stiffness, lead * stiffness)
    crossover = np.sqrt(stiffness / 0.1)
    # The force comes 1.5 ms late; the difference and its filter are slow by 0.5 ms and p T/(1 - p) more, by B only.
    turn = crossover * (lead - 1.5e-3)
    assert found.gain_crossover == pytest.approx(crossover / (2 * np.pi), rel=1e-4)
    assert found.phase_margin == pytest.approx(np.degrees(turn), rel=1e-3)
    assert found.delay_margin == pytest.approx(lead - 1.5e-3, rel=1e-4)
    # Where |L| passes 1 it is nearest to -1.
    assert found.modulus_margin == pytest.approx(turn, rel=1e-3)


@pytest.mark.parametrize("periods", [0, 1, 2])
@pytest.mark.parametrize("rate", [10.0, 30.0, 56.0])
def test_the_delay_margin_of_a_device_that_rests_before_the_period_is_over(rate, periods):
    """A little more delay changes nothing of such a loop: the way to the next crossing was a division by zero."""
    device = zwidth.LinearDevice(([rate * 1e3], [1.0, rate * 1e3]))
    scene, wall = zwidth.Scene(device, zwidth.Timing(1e-3, periods * 1e-3)), (1.05, -0.5e-3)
    found = scene.margins(*wall).delay_margin
    # Four periods are too long, up to what the device moves within the time constants before it.
    assert found == pytest.approx((4 - periods) * 1e-3, abs=1e-2 * 1e-3)
    for share, stable in ((0.5, True), (1 - 1e-9, True), (1 + 1e-9, False)):
        moved = scene.replace(delay=periods * 1e-3 + share * found)
        assert moved.is_stable(*wall, method="certified") == stable
