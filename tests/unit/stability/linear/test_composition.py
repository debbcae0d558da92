"""Loops with position estimates and further feedback, against the eigenvalues of programs as matrices."""

from __future__ import annotations

import numpy as np
import pytest
from program_loop import draw_scene, find_radius

import zwidth

ODRIVE = zwidth.Device("1e-4 kg m^2", "1e-4 N m s/rad"), zwidth.Timing(rate=8e3, delay="1.5 periods")
N_SCENES = 40
N_DENSE = 9  # dampings of the search for a stiffer stable wall


def test_the_default_gains_of_odrive():
    controller = zwidth.cascade(pos_gain=20, vel_gain=0.16, position=zwidth.Pll(bandwidth=1000))
    scene = zwidth.Scene(*ODRIVE, **controller)
    assert scene.spectral_radius() == pytest.approx(0.9974119767, abs=1e-10)
    ((low, high),) = scene.stable_stiffness(0.16 / (2 * np.pi))
    assert (low, high) == pytest.approx((0.0, 18.385), abs=5e-4)
    # A filter of the velocity only would yield a limit that is 51 % too high.
    assert zwidth.Scene(*ODRIVE).stable_stiffness(0.16 / (2 * np.pi))[0, 1] > 1.5 * high


def test_an_integral_gain():
    scene = zwidth.Scene(zwidth.Device(0.1, 0), zwidth.Timing(1e-3), **zwidth.pid(kp=1000, ki=2000, kd=10))
    assert scene.spectral_radius() == pytest.approx(0.99796, abs=5e-6)
    assert scene.spectral_radius() == pytest.approx(find_radius(scene, 1000, 10), abs=1e-12)


@pytest.mark.parametrize("seed", range(N_SCENES))
def test_random_loops(seed):
    rng = np.random.default_rng([7, seed])
    scene = draw_scene(rng)
    top = scene.max_stiffness()
    assert top.status == zwidth.Status.OK
    best = float(top.stiffness), float(top.virtual_damping)
    assert find_radius(scene, *best) == pytest.approx(1.0, abs=1e-9)
    for damping in best[1] * np.linspace(0.8, 1.2, N_DENSE):
        assert find_radius(scene, best[0] * 1.001, damping) > 1.0 - 1e-9
    K, B = best[0] * rng.uniform(0.05, 1.3, 5), best[1] * rng.uniform(0.3, 1.5, 5)
    expected = np.array([find_radius(scene, *wall) for wall in zip(K, B, strict=True)])
    np.testing.assert_allclose(scene.spectral_radius(K, B), expected, rtol=0, atol=1e-9)
    clear = np.abs(expected - 1.0) > 1e-7
    np.testing.assert_array_equal(scene.is_stable(K, B)[clear], expected[clear] < 1.0)
    wall = K[0], B[0]
    if clear[0]:
        for method in ("companion", "certified"):
            assert scene.is_stable(*wall, method=method) == (expected[0] < 1.0)
    model = scene.state_space(*wall)
    assert np.abs(np.linalg.eigvals(model.A)).max() == pytest.approx(expected[0], abs=1e-7)


@pytest.mark.parametrize("source", ["position", "measured"])
def test_shared_factors_are_no_poles(source):
    # The zero of P at 0.99 would be the dominant pole if it were not canceled.
    position = zwidth.PositionFilter([1.0, -0.99], [1.0, -0.9], velocity_from=source)
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), position=position)
    poles = scene.poles(1e3, 10)
    assert poles.size == 4
    assert np.abs(poles).max() == pytest.approx(find_radius(scene, 1e3, 10), abs=1e-12)


def test_poles_of_a_spring():
    position = zwidth.PositionFilter([0.6, 0.2], [1.0, -0.2], velocity_from="measured")
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), position=position)
    assert scene.spectral_radius(2e3, 0) == pytest.approx(find_radius(scene, 2e3, 0), abs=1e-12)


def test_a_fixed_velocity_loop_adds_to_the_damping():
    device, timing = zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3)
    plain = zwidth.Scene(device, timing)
    inner = zwidth.Scene(device, timing, feedback=zwidth.Feedback([5e3, -5e3], [1, 0]))
    top, shifted = plain.max_stiffness(), inner.max_stiffness()
    assert shifted.stiffness == pytest.approx(top.stiffness, rel=1e-9)
    assert shifted.virtual_damping == pytest.approx(top.virtual_damping - 5, rel=1e-6)
    assert inner.damper_range()[0] == pytest.approx(plain.damper_range()[0] - 5, rel=1e-9)


def test_a_long_delay_with_an_integrator():
    scene = zwidth.Scene(
        zwidth.Device(0.1, 10), zwidth.Timing(1e-3, "12.3 periods"), feedback=zwidth.IntegralFeedback(20, "forward")
    )
    top = scene.max_stiffness(negative_damping=False)
    assert find_radius(scene, float(top.stiffness), float(top.virtual_damping)) == pytest.approx(1.0, abs=1e-9)


def test_margins_change_the_whole_controller():
    feedback = zwidth.Feedback.integral(2e4, position=1.0)
    scene = zwidth.Scene(
        zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), position=zwidth.ExponentialFilter(0.5), feedback=feedback
    )
    margins = scene.margins(3e3, 15)
    factor = float(margins.gain_margin)
    scaled = scene.replace(**{"feedback.gain": 2e4 * factor})
    assert find_radius(scaled, 3e3 * factor, 15 * factor) == pytest.approx(1.0, abs=1e-9)
    for share, stable in ((0.999, True), (1.001, False)):
        later = scene.replace(delay=scene.timing.delay + share * float(margins.delay_margin))
        assert (find_radius(later, 3e3, 15) < 1.0) == stable
    response = scene.frequency_response(3e3, 15, np.linspace(1.0, 500.0, 100_001))
    assert np.abs(1 + response).min() == pytest.approx(margins.modulus_margin, rel=1e-5)
    model = scene.open_loop(3e3, 15)
    z = np.exp(2j * np.pi * 50 * 1e-3)
    value = model.C @ np.linalg.solve(z * np.eye(len(model.A)) - model.A, model.B) + model.D
    assert scene.frequency_response(3e3, 15, 50.0) == pytest.approx(value.item(), rel=1e-10)
