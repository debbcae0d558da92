"""Test devices given as linear systems: input forms, equivalence with devices from parts, and random systems.

References: rigid devices, state-space matrices of the parts, and certified pole counts.
"""

from __future__ import annotations

from typing import Any

import any_loop
import control
import numpy as np
import proved_loop
import pytest
import scipy.signal

import zwidth
from zwidth.stability.linear.curve import evaluate_curve

# A mass of 0.1 kg with a physical damping of 10 N s/m.
TIMING = zwidth.Timing(1e-3, 1.5e-3)
COEFFICIENTS = [1.0], [0.1, 10.0, 0.0]
MATRICES = [[0.0, 1.0], [0.0, -100.0]], [[0.0], [10.0]], [[1.0, 0.0]]
SIGNAL: Any = scipy.signal
FORMS = {
    "coefficients": COEFFICIENTS,
    "matrices": MATRICES,
    "roots": ([], [0.0, -100.0], 10.0),
    "signal coefficients": SIGNAL.TransferFunction(*COEFFICIENTS),
    "signal matrices": SIGNAL.StateSpace(*MATRICES, [[0.0]]),
    "signal roots": SIGNAL.ZerosPolesGain([], [0.0, -100.0], 10.0),
    "control coefficients": control.tf(*COEFFICIENTS),
    "control matrices": control.ss(*MATRICES, [[0.0]]),
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS.keys())
def test_every_form_of_a_rigid_mass_is_equivalent_to_the_device(form):
    scene = zwidth.Scene(zwidth.LinearDevice(form), TIMING, zwidth.VirtualWall(4e3, 10.0))
    rigid = zwidth.Scene(zwidth.Device(0.1, 10.0), TIMING, scene.wall)
    assert scene.units == pytest.approx(rigid.units, rel=1e-15)
    np.testing.assert_allclose(scene.max_stiffness()[:3], rigid.max_stiffness()[:3], rtol=1e-12)
    np.testing.assert_allclose(scene.stable_stiffness(20.0), rigid.stable_stiffness(20.0), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(scene.margins(), rigid.margins(), rtol=1e-9)
    assert scene.spectral_radius() == pytest.approx(rigid.spectral_radius(), rel=1e-12)


def convert_to_linear(scene: zwidth.Scene) -> Any:
    """Return the scene with its device, operator included, as one linear system."""
    table, _, output = any_loop.rate_table(scene)
    rates = np.array(table)[:-1]
    return zwidth.Scene(
        zwidth.LinearDevice((rates[:, :-1], rates[:, -1], output)), scene.timing, velocity=scene.velocity
    )


@pytest.mark.parametrize("kind", ["tip", "motor", "all", "driven"])
def test_device_from_parts_equals_its_linear_system(kind):
    generator = np.random.default_rng(5)
    for _ in range(4):
        scene = any_loop.random_scene(kind, generator)
        if scene.device.coupling is not None:
            # Without any damping, the stability of soft walls depends on the last bit.
            scene = scene.replace(**{"coupling.damping": scene.device.coupling.damping + 1.0, "damping": 1.0})
        system, units = convert_to_linear(scene), scene.units
        K = 10 ** generator.uniform(-4, 0.5, 12) * units.stiffness
        B = generator.uniform(-0.1, 0.3, 12) * units.virtual_damping
        assert np.all(scene.is_stable(K, B) == system.is_stable(K, B))
        np.testing.assert_allclose(scene.spectral_radius(K, B), system.spectral_radius(K, B), rtol=1e-12)
        expected, system_top = scene.max_stiffness(), system.max_stiffness()
        assert expected.status == system_top.status
        if expected.status == zwidth.Status.OK:
            np.testing.assert_allclose(system_top[:3], expected[:3], rtol=1e-12, atol=1e-12 * units.virtual_damping)
            per_parameter, per_system = scene.sensitivities().per, system.sensitivities().per
            assert per_system["delay"] == pytest.approx(per_parameter["delay"], rel=1e-6, nan_ok=True)
        ranges, system_ranges = scene.stable_stiffness(B[0]), system.stable_stiffness(B[0])
        np.testing.assert_allclose(system_ranges, ranges, rtol=1e-10, atol=1e-9 * units.stiffness)
        response = system.state_space(0.1 * K[0], 0.1 * B[0]).step(40)
        if scene.device.actuator is None and not scene.device.modes:
            np.testing.assert_allclose(response, scene.state_space(0.1 * K[0], 0.1 * B[0]).step(40), rtol=1e-9)


def random_system(generator: np.random.Generator, period: float) -> tuple[list[complex], list[complex], float]:
    """Return zeros, poles and gain of a random system with 1 to 12 states.

    The poles are integrators, modes with damping ratios of 0.1 to 20 %, lags, and unstable poles.
    """

    def draw(count: int, unstable: float) -> list[complex]:
        roots: list[complex] = []
        while len(roots) < count:
            w, side = 10 ** generator.uniform(-2.5, 0.4) / period, -1.0 if generator.random() > unstable else 0.1
            if count - len(roots) >= 2 and generator.random() < 0.6:
                ratio = 10 ** generator.uniform(-3, -0.7)
                pole = w * complex(side * ratio, np.sqrt(1.0 - ratio * ratio))
                roots += [pole, pole.conjugate()]
            else:
                roots.append(complex(side * w))
        return roots

    size = int(generator.integers(1, 13))
    n_integrators = min(int(generator.integers(0, 3)), size)
    poles = [0j] * n_integrators + draw(size - n_integrators, 0.07)
    zeros = draw(int(generator.integers(0, max(size - 1, 1))), 0.2)
    point = 1j * 10 ** generator.uniform(-1.5, -0.5) / period
    response = np.prod([abs(point - zero) for zero in zeros]) / np.prod([abs(point - pole) for pole in poles])
    return zeros, poles, float(10 ** generator.uniform(-5, -3) / response)


@pytest.mark.parametrize("path", ["delay", "period"])
def test_delay_and_period_sensitivity_at_integer_delay_without_inertia(path):
    """The derivative is one-sided: that of a slightly larger delay or period."""
    scene = zwidth.Scene(zwidth.LinearDevice(([-2000.0], [-30.0, 0.0], 0.02)), zwidth.Timing(1e-3, 2e-3))
    larger = scene.replace(**{path: scene.parameters()[path] + 1e-9}).max_stiffness().stiffness
    slope = (larger - scene.max_stiffness().stiffness) / 1e-9
    assert scene.sensitivities().per[path] == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_random_systems_match_certified_pole_counts(seed):
    generator, n_decided = np.random.default_rng(seed), 0
    for _ in range(6):
        period = 10 ** generator.uniform(-4, -2.5)
        d = float(generator.choice(np.array([0.0, 1.0, generator.integers(0, 6), generator.uniform(0, 4)])))
        device = zwidth.LinearDevice(random_system(generator, period))
        scene = zwidth.Scene(device, zwidth.Timing(period, d * period))
        units, curve = scene.units, evaluate_curve(scene.loop.roots, generator.choice(scene.loop.boundary.w, 6))
        side = 1.0 + 10 ** generator.uniform(-6, -2, 6) * generator.choice([-1.0, 1.0], 6)
        K = np.append(10 ** generator.uniform(-4, 1, 4), curve.alpha * side) * units.stiffness
        B = np.append(generator.uniform(-0.1, 0.15, 4), curve.beta * side) * units.virtual_damping
        in_range = (np.abs(K) < 1e8 * units.stiffness) & (np.abs(K) > 1e-9 * units.stiffness)
        K, B = K[in_range], B[in_range]
        labels = np.atleast_1d(scene.is_stable(K, B))
        for index, (stiffness, damping) in enumerate(zip(K, B, strict=True)):
            outside = proved_loop.count_outside(scene, stiffness, damping, 250)
            assert outside is None or (outside == 0) == labels[index], (device, d, stiffness, damping)
            n_decided += outside is not None
        certified = scene.decide_stability(K[:2], B[:2], method="certified")
        is_decided = certified.status == zwidth.Status.OK
        assert np.all(certified.stable[is_decided] == labels[:2][is_decided])
    assert n_decided > 30


def test_sampled_system_is_equivalent_to_its_continuous_system():
    device = zwidth.Device(0.1, 5.0, zwidth.Coupling(0.05, 20e3, 2.0, "tip"))
    scene = zwidth.Scene(device, zwidth.Timing(1e-3, 1e-3), velocity=zwidth.LowPass(cutoff=80.0))
    matrices = convert_to_linear(scene).device.system
    coefficients = ([float(c) for c in part] for part in matrices[:2])
    sampled = control.c2d(control.ss(control.tf(*coefficients)), 1e-3, "zoh")
    sampled_scene = zwidth.Scene(zwidth.LinearDevice(sampled), zwidth.Timing(1e-3, 1e-3), velocity=scene.velocity)
    expected, sampled_top = scene.max_stiffness(), sampled_scene.max_stiffness()
    # Rounding errors of the sampled coefficients shift slow poles.
    assert sampled_top.stiffness == pytest.approx(expected.stiffness, rel=1e-6)
    assert sampled_scene.is_stable(0.9 * expected.stiffness, expected.virtual_damping, method="certified")
    assert sampled_scene.margins(0.5 * expected.stiffness, expected.virtual_damping).gain_margin == pytest.approx(
        scene.margins(0.5 * expected.stiffness, expected.virtual_damping).gain_margin, rel=1e-5
    )
    assert np.isnan(sampled_scene.sensitivities().per["period"])


@pytest.mark.parametrize("mass, damping", [(0.1, 2.0), (0.5, 10.0), (1.0, 2.0)])
def test_rounding_of_sampled_system_keeps_soft_walls_stable(mass, damping):
    # SciPy's discretization of a mass with a damper has its pole at 1 + 1e-14: without a wall the system is unstable.
    numerator, denominator, _ = scipy.signal.cont2discrete(([1.0], [mass, damping, 0.0]), 1e-3)
    assert sum(denominator) < 0
    sampled = zwidth.LinearDevice(SIGNAL.dlti(np.trim_zeros(np.ravel(numerator), "f"), denominator, dt=1e-3))
    scene = zwidth.Scene(sampled, zwidth.Timing(1e-3))
    exact = zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(1e-3)).max_stiffness()
    assert scene.max_stiffness().stiffness == pytest.approx(exact.stiffness, rel=1e-6)
    assert scene.islands() == []
    assert [piece.island for piece in scene.stable_region()] == [False]
    assert scene.recommend().stiffness > 0


@pytest.mark.parametrize(
    "change, message",
    [
        ({"period": 2e-3}, "got a system sampled at 0.001 s in a loop of 0.002 s"),
        ({"delay": 0.5e-3}, "got 0.5 periods; a sampled device"),
        ({"operator": zwidth.Operator(0.1)}, "operator: allowed only with a zwidth.Device"),
    ],
)
def test_sampled_system_requires_its_period_and_integer_delay(change, message):
    device = zwidth.LinearDevice(SIGNAL.TransferFunction([1e-5], [1.0, -1.9, 0.9], dt=1e-3))
    scene = zwidth.Scene(device, zwidth.Timing(1e-3))
    assert scene.max_stiffness().stiffness > 0
    with pytest.raises(zwidth.InputError, match=message):
        scene.replace(**change).is_stable(1.0)


@pytest.mark.parametrize("zeros", [[0.0, 0.0], [1.0, 1.0], [-1.0, 0.2 + 0.6j, 0.2 - 0.6j, 1.0]], ids=str)
@pytest.mark.parametrize("gain", [1e-4, -1e-4])
def test_sampled_system_with_zeros_at_0_and_on_the_unit_circle(zeros, gain):
    # Reference: roots of the closed loop as a polynomial, for the spring and for the backward difference.
    poles = [0.9, 0.7, 0.5 + 0.2j, 0.5 - 0.2j, -0.3]
    for n_delay in (0, 1):
        scene = zwidth.Scene(
            zwidth.LinearDevice(SIGNAL.dlti(zeros, poles, gain, dt=1e-3)), zwidth.Timing(1e-3, n_delay * 1e-3)
        )
        loop, numerator = np.poly(poles + [0.0] * (n_delay + 1)), gain * np.poly(zeros)

        def compute_radius(K: float, B: float, loop: Any = loop, numerator: Any = numerator) -> float:
            return np.abs(np.roots(np.polyadd(loop, np.convolve(numerator, [K + B / 1e-3, -B / 1e-3])))).max()

        for B in (0.0, 0.3, -0.3):
            K = np.linspace(-2e4, 2e4, 81) + 17.0
            radii = np.array([compute_radius(stiffness, B) for stiffness in K])
            np.testing.assert_array_equal(scene.is_stable(K, B), radii < 1.0)
            np.testing.assert_allclose(scene.spectral_radius(K, B), radii, rtol=1e-9)
            for end in scene.stable_stiffness(B)[0]:
                assert compute_radius(end, B) == pytest.approx(1.0, abs=1e-9)
        wall = scene.max_stiffness(negative_damping=False)
        # At a double pole the roots have only half the digits.
        assert (wall.status, compute_radius(*wall[:2])) == (zwidth.Status.OK, pytest.approx(1.0, abs=1e-7))


def test_common_factors_of_numerator_and_denominator_cancel():
    # As in a sum of two responses, where each has an integrator.
    both: Any = control.tf([1.0], [0.1, 10.0, 0.0]) + control.tf([1.0], [1.0, 200.0, 0.0])
    assert zwidth.LinearDevice(both) == zwidth.LinearDevice(([1.1, 210.0], [0.1, 30.0, 2000.0, 0.0]))
    assert zwidth.LinearDevice(SIGNAL.dlti([1.0], [1.0, 1.0, 0.5], 1e-5, dt=1e-3)).zeros.size == 0
    # State-space matrices define the uncontrollable mode explicitly.
    hidden = [[0.0, 1.0, 0.0], [0.0, -100.0, 0.0], [0.0, 0.0, 0.5]], [0.0, 10.0, 0.0], [1.0, 0.0, 0.0]
    with pytest.raises(zwidth.InputError, match=r"the mode s = 0.5 does not decay"):
        zwidth.LinearDevice(hidden)


@pytest.mark.parametrize(
    "system, message",
    [
        (3, "got '3'; it must be finite numbers as"),
        ({}, "got '{}'; it must be finite numbers as"),
        (([1.0], [1.0]), "does not depend on the force"),
        (([0.0], [1.0, 2.0]), "does not depend on the force"),
        (([1.0, 2.0], [1.0, 2.0]), "numerator of degree 1 over one of degree 1"),
        (([1.0], [1.0, np.nan]), "finite numbers"),
        (([], [1j, 2.0], 1.0), "finite numbers"),
        ((np.eye(2), [1.0], [1.0, 2.0]), "finite numbers"),
        (control.tf([1.0], [1.0, 0.5], True), "sampled system without its period"),
        (control.ss(np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2))), "finite numbers"),
    ],
)
def test_invalid_systems_are_rejected(system, message):
    with pytest.raises(zwidth.InputError, match=message):
        zwidth.LinearDevice(system)


def test_functions_that_need_a_mass_are_rejected():
    scene = zwidth.Scene(zwidth.LinearDevice(COEFFICIENTS), TIMING)
    with pytest.raises(zwidth.InputError, match=r"use external_force or external_force_history, or a zwidth\.Device"):
        scene.simulate(1e3, 1.0, start_velocity=0.1)
    with pytest.raises(zwidth.InputError, match="passivity with a linear device"):
        scene.passivity_margin(1e3, 1.0)
    assert zwidth.assess(scene.replace(stiffness=1e3)).passive is None
    with pytest.raises(zwidth.InputError, match="got a pole of 1e\\+06 rad per period"):
        zwidth.Scene(zwidth.LinearDevice(([1.0], [1.0, 1e9])), TIMING).is_stable(1.0)


@pytest.mark.parametrize("delay", [0.0, 0.4e-3, 2e-3])
def test_zero_at_s_0_is_a_sampled_zero_at_z_1(delay):
    """A velocity sensor with a centering spring, s/(s^2 + 2 s + 1), against eigenvalues of the sampled system."""
    timing = zwidth.Timing(1e-3, delay)
    scene = zwidth.Scene(zwidth.LinearDevice("1 0 / 1 2 1"), timing, velocity=zwidth.LowPass(cutoff=100))
    assert np.sum(scene.loop.roots.zeros == 0) == 1
    top = scene.max_stiffness()
    assert top.status == zwidth.Status.OK
    damping = float(top.virtual_damping)
    for factor, stable in ((1 - 1e-6, True), (1 + 1e-6, False)):
        matrix = scene.state_space(factor * top.stiffness, damping).A
        assert (np.abs(np.linalg.eigvals(matrix)).max() < 1.0) == stable
