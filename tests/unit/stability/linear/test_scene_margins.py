"""Stability margins of linear scenes, against a fine frequency grid and eigenvalues of independent state spaces."""

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


def radius_with_delay(scene, stiffness, damping, delay):
    timing = zwidth.Timing(scene.timing.period, delay)
    delayed = dataclasses.replace(scene, timing=timing)
    return np.abs(np.linalg.eigvals(closed_loop_matrix(delayed, stiffness, damping))).max()


def grid_margins(scene, stiffness, damping):
    """Return gain and phase margins at all crossings, and the least distance from -1, on 60,000 frequencies."""
    nyquist = 0.5 / scene.timing.period
    frequency = np.concatenate(
        [np.geomspace(1e-7 * nyquist, 0.05 * nyquist, 30000), np.linspace(0.05, 1.0, 30001)[1:] * nyquist]
    )
    L = scene.frequency_response(stiffness, damping, frequency)
    length = np.maximum(np.abs(L), 1e-300)
    size, sine = np.log(length), L.imag / length
    gain, phase = find_crossings(size), find_crossings(sine[:-1])
    phase = [(k, fraction) for k, fraction in phase if L.real[k] < 0]
    factors = [np.exp(-interpolate(size, *crossing)) for crossing in phase] + (
        [np.exp(-size[-1])] if L.real[-1] < 0 else []
    )
    phases = [abs(np.angle(-L[k], deg=True) + fraction * np.angle(L[k + 1] / L[k], deg=True)) for k, fraction in gain]
    return np.array(factors), np.array(phases), np.abs(1 + L).min()


def find_crossings(values):
    """Return the sign changes of values: the index before each, and the fraction of the step at which it occurs."""
    k = np.flatnonzero((values[1:] > 0) != (values[:-1] > 0))
    return list(zip(k, values[k] / (values[k] - values[k + 1]), strict=True))


def interpolate(values, k, fraction):
    return values[k] + fraction * (values[k + 1] - values[k])


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "rigid"])
def test_margins_agree_with_a_grid_and_eigenvalues(kind):
    rng = np.random.default_rng(5)
    for _ in range(2):
        scene = random_scene(kind, rng)
        stiffness, damping = random_walls(scene, rng, 60)
        stable = np.flatnonzero(scene.is_stable(stiffness, damping))[0]
        K, B = stiffness[stable], damping[stable]
        margins = scene.margins(K, B)
        factors, phases, distance = grid_margins(scene, K, B)
        # A resonance may be narrower than the grid.
        assert 0.98 * distance <= margins.modulus_margin <= distance * (1 + 1e-9)
        if phases.size:
            assert margins.phase_margin == pytest.approx(phases.min(), rel=1e-3)
        if factors.size:
            nearest = factors[np.argmin(np.abs(np.log(factors)))]
            assert np.log(margins.gain_margin) == pytest.approx(np.log(nearest), rel=1e-3, abs=1e-4)
            # Scaled by the gain margin, the loop has a pole on the unit circle.
            edge = closed_loop_matrix(scene, K * margins.gain_margin, B * margins.gain_margin)
            assert np.abs(np.abs(np.linalg.eigvals(edge)) - 1).min() < 1e-6
        if np.isfinite(margins.delay_margin) and margins.delay_margin < 40 * scene.timing.period:
            delay = scene.timing.delay + margins.delay_margin * (1 + np.array([-1e-4, 1e-4]))
            below, above = (radius_with_delay(scene, K, B, t) for t in delay)
            assert below < 1 < above
            for fraction in np.linspace(0.05, 0.95, 10):
                assert radius_with_delay(scene, K, B, scene.timing.delay + fraction * margins.delay_margin) < 1


@pytest.mark.parametrize("stiffness, damping", [(500.0, 1.0), (2e3, 4.0), (4e3, 10.0)])
def test_delay_margin_ends_where_an_eigenvalue_leaves_the_circle(stiffness, damping):
    def excess(delay):
        return radius_with_delay(FILTERED, stiffness, damping, delay) - 1.0

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
def test_delay_margin_ends_at_the_first_interval_of_instability(damping, periods, cutoff, wall):
    # The wall becomes stable again nearly one period later.
    device, timing = zwidth.Device(mass=0.1, damping=damping), zwidth.Timing(period=1e-3, delay=periods * 1e-3)
    scene = zwidth.Scene(device, timing, velocity=zwidth.LowPass(cutoff=cutoff))
    margin = scene.margins(*wall).delay_margin
    fractions, (K, B) = (*np.linspace(0, 0.999, 40), 1.001), wall
    radii = [radius_with_delay(scene, K, B, timing.delay + fraction * margin) for fraction in fractions]
    assert max(radii[:-1]) < 1 < radii[-1]
    assert radius_with_delay(scene, K, B, np.ceil(periods) * 1e-3 + 1.2e-3) < 1


def test_undamped_device_has_no_response_at_the_nyquist_frequency():
    scene = zwidth.Scene(zwidth.Device(0.1), zwidth.Timing(1e-3), velocity=zwidth.LowPass(cutoff=100))
    response = scene.frequency_response(1e3, 5.0, [499.9, 500.0])
    assert response[1] == 0
    assert abs(response[0]) < 1e-3


def test_margins_of_a_loop_with_a_zero_at_the_nyquist_frequency():
    """The filter's zero at the Nyquist frequency is a zero of L if the wall has no stiffness."""
    scene = zwidth.Scene(
        zwidth.Device(0.1, 1.0), zwidth.Timing(1e-3, 1e-3), velocity=zwidth.Butterworth(cutoff=120.0, order=1)
    )
    assert scene.frequency_response(0.0, 30.0, 500.0) == 0
    margins = scene.margins(0.0, 30.0)
    factors, phases, distance = grid_margins(scene, 0.0, 30.0)
    assert margins.gain_margin == pytest.approx(factors[np.argmin(np.abs(np.log(factors)))], rel=1e-3)
    assert abs(margins.phase_margin) == pytest.approx(phases.min(), rel=1e-3)
    assert 0.98 * distance <= margins.modulus_margin <= distance * (1 + 1e-9)


def test_gain_margin_at_the_nyquist_frequency():
    """With strong damping the first unstable pole is real, at z = -1, where L is always real."""
    scene = zwidth.Scene(zwidth.Device(0.1, 800.0), zwidth.Timing(1e-3), velocity=zwidth.LowPass(cutoff=400.0))
    margins = scene.margins(20e3, 20.0)
    assert margins.phase_crossover == pytest.approx(500.0, rel=1e-12)
    assert margins.gain_margin == pytest.approx(-1.0 / scene.frequency_response(20e3, 20.0, 500.0).real, rel=1e-12)
    edge = closed_loop_matrix(scene, 20e3 * margins.gain_margin, 20.0 * margins.gain_margin)
    assert np.abs(np.linalg.eigvals(edge) + 1).min() < 1e-12


def test_margins_of_an_unstable_wall():
    margins = FILTERED.margins(60e3, 4.0)
    assert margins.gain_margin < 1
    assert margins.phase_margin < 0
    assert margins.delay_margin == 0
    assert FILTERED.is_stable(60e3 * margins.gain_margin * 0.999, 4.0 * margins.gain_margin * 0.999)


def test_smallest_margin_of_several_crossovers_is_returned():
    """A lightly damped resonance crosses |L| = 1 twice more."""
    coupling = zwidth.Coupling(mass=0.1, stiffness=4e3, damping=0.05)
    scene = zwidth.Scene(zwidth.Device(0.1, 0.3, coupling), zwidth.Timing(1e-3))
    factors, phases, _ = grid_margins(scene, 2e3, 1.0)
    assert phases.size > 1
    margins = scene.margins(2e3, 1.0)
    assert abs(margins.phase_margin) == pytest.approx(phases.min(), rel=1e-2)
    assert margins.gain_margin == pytest.approx(factors[np.argmin(np.abs(np.log(factors)))], rel=1e-2)


def test_margins_without_crossover_are_infinite():
    """The operator's stiff spring keeps the loop gain below 1."""
    scene = dataclasses.replace(FILTERED, operator=zwidth.Operator(0.1, 30.0, 5e3))
    margins = scene.margins(10.0, 0.0)
    assert np.isinf(margins.phase_margin)
    assert np.isinf(margins.delay_margin)
    assert margins.gain_margin > 1


def test_margins_of_rigid_scenes_and_walls_out_of_range():
    scene = zwidth.Scene(zwidth.Device(0.1, 3.0), zwidth.Timing(1e-3, 1.5e-3))
    walls = scene.normalize_walls(np.array([500.0, 2e4]), 4.0)
    expected = zwidth.margins(*walls, scene.delta, scene.d)
    margins = scene.margins([500.0, 2e4], 4.0)
    np.testing.assert_array_equal(margins.gain_margin, expected.gain_margin)
    np.testing.assert_array_equal(margins.delay_margin, expected.delay_margin * 1e-3)
    for wall in ((np.nan, 0.0), (np.inf, 0.0), (1e-80, 0.0), (0.0, 1e160)):
        assert all(np.isnan(part) for part in FILTERED.margins(*wall))


def test_zero_of_the_open_loop_is_no_phase_crossover():
    """At the antiresonance of an undamped tip L = 0 and its phase jumps: no gain places a pole there."""
    device = zwidth.Device(0.125, 0.0, zwidth.Coupling(mass=0.03, stiffness=32e3))
    scene = zwidth.Scene(device, zwidth.Timing(period=1.3e-3, delay=1.3e-3))
    factors = np.geomspace(1e-4, 1e4, 81)
    assert not scene.is_stable(2.5e3 * factors, 4.4 * factors).any()
    margins = scene.margins(2.5e3, 4.4)
    assert margins.gain_margin == 0
    assert np.isnan(margins.phase_crossover)


NARROW = {
    # On the flank of the resonance, an ulp of frequency changes the delay by a hundred ulps.
    "flank": (
        zwidth.Device(
            mass=0.0307,
            modes=(zwidth.Mode(199.539, damping_ratio=3.4e-5, mass=0.0865), zwidth.Mode(24.85, 0.0015, mass=0.2)),
        ),
        zwidth.Timing(period=0.714e-3, delay=0.714e-3),
        (0.15, 0.0116),
    ),
    # Both crossovers appear at a delay of about 0.3 periods; at the next sampled delay one has already passed -1.
    "appearing": (
        zwidth.Device(mass=0.026013692, damping=12.0476264, modes=(zwidth.Mode(947.58718, 0.000242737, -0.391404527),)),
        zwidth.Timing(period=1.3364519965781e-3),
        (7496.157782518655, 22.952514039378066),
    ),
}


@pytest.mark.parametrize("device, timing, wall", NARROW.values(), ids=NARROW)
def test_delay_margin_near_a_narrow_resonance(device, timing, wall):
    scene = zwidth.Scene(device, timing)
    margin = scene.margins(*wall).delay_margin
    assert 0 < margin < timing.period
    for fraction, stable in ((0.5, True), (0.999, True), (1.001, False)):
        delayed = scene.replace(timing=zwidth.Timing(timing.period, timing.delay + fraction * margin))
        assert delayed.is_stable(*wall, method="certified") == stable


@pytest.mark.parametrize("stiffness", [1e-2, 1e-6])
def test_margins_of_a_soft_wall_with_a_very_low_crossover(stiffness):
    # L = K/(b s) and K (1 + (B/K) s)/(m s^2), valid far below every other frequency of the loop.
    damped = FILTERED.margins(stiffness, 0.0)
    assert damped.gain_crossover == pytest.approx(stiffness / 3.0 / (2 * np.pi), rel=1e-5)
    assert damped.phase_margin == pytest.approx(90.0, abs=1e-2)
    # Delay margins of minutes and months.
    assert damped.delay_margin == pytest.approx(0.5 * np.pi * 3.0 / stiffness, rel=1e-4)
    undamped = FILTERED.replace(damping=0.0)
    lead = 6e-3
    margins = undamped.margins(stiffness, lead * stiffness)
    crossover = np.sqrt(stiffness / 0.1)
    # The force is delayed by 1.5 ms; difference and filter delay only B, by 0.5 ms and p T/(1 - p).
    phase = crossover * (lead - 1.5e-3)
    assert margins.gain_crossover == pytest.approx(crossover / (2 * np.pi), rel=1e-4)
    assert margins.phase_margin == pytest.approx(np.degrees(phase), rel=1e-3)
    assert margins.delay_margin == pytest.approx(lead - 1.5e-3, rel=1e-4)
    # The distance from -1 is smallest at |L| = 1.
    assert margins.modulus_margin == pytest.approx(phase, rel=1e-3)


@pytest.mark.parametrize("periods", [0, 1, 2])
@pytest.mark.parametrize("rate", [10.0, 30.0, 56.0])
def test_delay_margin_of_a_device_that_settles_within_a_period(rate, periods):
    """Regression: a slightly longer delay does not change this loop, which caused a division by zero."""
    device = zwidth.LinearDevice(([rate * 1e3], [1.0, rate * 1e3]))
    scene, wall = zwidth.Scene(device, zwidth.Timing(1e-3, periods * 1e-3)), (1.05, -0.5e-3)
    margin = scene.margins(*wall).delay_margin
    # Instability at four periods, up to the motion of the device within its time constants before that.
    assert margin == pytest.approx((4 - periods) * 1e-3, abs=1e-2 * 1e-3)
    for fraction, stable in ((0.5, True), (1 - 1e-9, True), (1 + 1e-9, False)):
        delayed = scene.replace(delay=periods * 1e-3 + fraction * margin)
        assert delayed.is_stable(*wall, method="certified") == stable
