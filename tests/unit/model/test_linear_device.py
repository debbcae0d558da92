"""Devices given as linear systems: every form, the same answers as parts of the same matrices, and random systems."""

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

# A mass of 0.1 kg with 10 N s/m.
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
def test_every_form_of_a_rigid_mass_is_the_rigid_device(form):
    scene = zwidth.Scene(zwidth.LinearDevice(form), TIMING, zwidth.VirtualWall(4e3, 10.0))
    rigid = zwidth.Scene(zwidth.Device(0.1, 10.0), TIMING, scene.wall)
    assert scene.units == pytest.approx(rigid.units, rel=1e-15)
    np.testing.assert_allclose(scene.max_stiffness()[:3], rigid.max_stiffness()[:3], rtol=1e-12)
    np.testing.assert_allclose(scene.stable_stiffness(20.0), rigid.stable_stiffness(20.0), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(scene.margins(), rigid.margins(), rtol=1e-9)
    assert scene.spectral_radius() == pytest.approx(rigid.spectral_radius(), rel=1e-12)


def same_matrices(scene: zwidth.Scene) -> Any:
    """The scene with its device, hand and all as one linear system."""
    table, _, seen = any_loop.rate_table(scene)
    own = np.array(table)[:-1]
    return zwidth.Scene(zwidth.LinearDevice((own[:, :-1], own[:, -1], seen)), scene.timing, velocity=scene.velocity)


@pytest.mark.parametrize("kind", ["tip", "motor", "all", "driven"])
def test_parts_and_their_matrices_give_the_same_answers(kind):
    generator = np.random.default_rng(5)
    for _ in range(4):
        scene = any_loop.random_scene(kind, generator)
        if scene.device.coupling is not None:
            # Without any damping, soft walls are stable or not by the last bit.
            scene = scene.replace(**{"coupling.damping": scene.device.coupling.damping + 1.0, "damping": 1.0})
        system, units = same_matrices(scene), scene.units
        K = 10 ** generator.uniform(-4, 0.5, 12) * units.stiffness
        B = generator.uniform(-0.1, 0.3, 12) * units.virtual_damping
        assert np.all(scene.is_stable(K, B) == system.is_stable(K, B))
        np.testing.assert_allclose(scene.spectral_radius(K, B), system.spectral_radius(K, B), rtol=1e-12)
        top, found = scene.max_stiffness(), system.max_stiffness()
        assert top.status == found.status
        if top.status == zwidth.Status.OK:
            np.testing.assert_allclose(found[:3], top[:3], rtol=1e-12, atol=1e-12 * units.virtual_damping)
            own, other = scene.sensitivities().per, system.sensitivities().per
            assert other["delay"] == pytest.approx(own["delay"], rel=1e-6, nan_ok=True)
        ends, others = scene.stable_stiffness(B[0]), system.stable_stiffness(B[0])
        np.testing.assert_allclose(others, ends, rtol=1e-10, atol=1e-9 * units.stiffness)
        response = system.state_space(0.1 * K[0], 0.1 * B[0]).step(40)
        if scene.device.actuator is None and not scene.device.modes:
            np.testing.assert_allclose(response, scene.state_space(0.1 * K[0], 0.1 * B[0]).step(40), rtol=1e-9)


def random_system(generator: np.random.Generator, period: float) -> tuple[list[complex], list[complex], float]:
    """Roots of 1 to 12 states: integrators, resonances of 0.1 to 20 % damping, lags, unstable poles, zeros anywhere."""

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
    still = min(int(generator.integers(0, 3)), size)
    poles = [0j] * still + draw(size - still, 0.07)
    zeros = draw(int(generator.integers(0, max(size - 1, 1))), 0.2)
    at = 1j * 10 ** generator.uniform(-1.5, -0.5) / period
    answer = np.prod([abs(at - zero) for zero in zeros]) / np.prod([abs(at - pole) for pole in poles])
    return zeros, poles, float(10 ** generator.uniform(-5, -3) / answer)


@pytest.mark.parametrize("path", ["delay", "period"])
def test_without_inertia_slopes_at_a_whole_delay_are_those_of_a_little_more(path):
    scene = zwidth.Scene(zwidth.LinearDevice(([-2000.0], [-30.0, 0.0], 0.02)), zwidth.Timing(1e-3, 2e-3))
    more = scene.replace(**{path: scene.parameters()[path] + 1e-9}).max_stiffness().stiffness
    slope = (more - scene.max_stiffness().stiffness) / 1e-9
    assert scene.sensitivities().per[path] == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_random_systems_are_judged_as_balls_do(seed):
    generator, judged = np.random.default_rng(seed), 0
    for _ in range(6):
        period = 10 ** generator.uniform(-4, -2.5)
        periods = float(generator.choice(np.array([0.0, 1.0, generator.integers(0, 6), generator.uniform(0, 4)])))
        device = zwidth.LinearDevice(random_system(generator, period))
        scene = zwidth.Scene(device, zwidth.Timing(period, periods * period))
        units, curve = scene.units, evaluate_curve(scene.loop.roots, generator.choice(scene.loop.boundary.w, 6))
        side = 1.0 + 10 ** generator.uniform(-6, -2, 6) * generator.choice([-1.0, 1.0], 6)
        K = np.append(10 ** generator.uniform(-4, 1, 4), curve.alpha * side) * units.stiffness
        B = np.append(generator.uniform(-0.1, 0.15, 4), curve.beta * side) * units.virtual_damping
        fine = (np.abs(K) < 1e8 * units.stiffness) & (np.abs(K) > 1e-9 * units.stiffness)
        K, B = K[fine], B[fine]
        labels = np.atleast_1d(scene.is_stable(K, B))
        for place, (stiffness, damping) in enumerate(zip(K, B, strict=True)):
            outside = proved_loop.count_outside(scene, stiffness, damping, 250)
            assert outside is None or (outside == 0) == labels[place], (device, periods, stiffness, damping)
            judged += outside is not None
        certified = scene.decide_stability(K[:2], B[:2], method="certified")
        known = certified.status == zwidth.Status.OK
        assert np.all(certified.stable[known] == labels[:2][known])
    assert judged > 30


def test_a_sampled_system_is_the_held_one():
    device = zwidth.Device(0.1, 5.0, zwidth.Coupling(0.05, 20e3, 2.0, "tip"))
    scene = zwidth.Scene(device, zwidth.Timing(1e-3, 1e-3), velocity=zwidth.LowPass(cutoff=80.0))
    matrices = same_matrices(scene).device.system
    numbers = ([float(c) for c in part] for part in matrices[:2])
    held = control.c2d(control.ss(control.tf(*numbers)), 1e-3, "zoh")
    later = zwidth.Scene(zwidth.LinearDevice(held), zwidth.Timing(1e-3, 1e-3), velocity=scene.velocity)
    own, found = scene.max_stiffness(), later.max_stiffness()
    # Rounding of the sampled coefficients moves slow poles.
    assert found.stiffness == pytest.approx(own.stiffness, rel=1e-6)
    assert later.is_stable(0.9 * own.stiffness, own.virtual_damping, method="certified")
    assert later.margins(0.5 * own.stiffness, own.virtual_damping).gain_margin == pytest.approx(
        scene.margins(0.5 * own.stiffness, own.virtual_damping).gain_margin, rel=1e-5
    )
    assert np.isnan(later.sensitivities().per["period"])


@pytest.mark.parametrize("mass, damping", [(0.1, 2.0), (0.5, 10.0), (1.0, 2.0)])
def test_the_rounding_of_a_sampled_system_takes_no_soft_wall_away(mass, damping):
    # What SciPy makes of a mass and a damper has its pole at z = 1 beyond it, by 1e-14: alone it is unstable.
    top, bottom, _ = scipy.signal.cont2discrete(([1.0], [mass, damping, 0.0]), 1e-3)
    assert sum(bottom) < 0
    sampled = zwidth.LinearDevice(SIGNAL.dlti(np.trim_zeros(np.ravel(top), "f"), bottom, dt=1e-3))
    scene = zwidth.Scene(sampled, zwidth.Timing(1e-3))
    exact = zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(1e-3)).max_stiffness()
    assert scene.max_stiffness().stiffness == pytest.approx(exact.stiffness, rel=1e-6)
    assert scene.islands() == []
    assert [piece.island for piece in scene.stable_region()] == [False]
    assert scene.recommend().stiffness > 0


@pytest.mark.parametrize(
    "change, words",
    [
        ({"period": 2e-3}, "got a system sampled at 0.001 s in a loop of 0.002 s"),
        ({"delay": 0.5e-3}, "got 0.5 periods; a sampled device"),
        ({"operator": zwidth.Operator(0.1)}, "operator: allowed only with a zwidth.Device"),
    ],
)
def test_a_sampled_system_belongs_to_its_period(change, words):
    device = zwidth.LinearDevice(SIGNAL.TransferFunction([1e-5], [1.0, -1.9, 0.9], dt=1e-3))
    scene = zwidth.Scene(device, zwidth.Timing(1e-3))
    assert scene.max_stiffness().stiffness > 0
    with pytest.raises(zwidth.InputError, match=words):
        scene.replace(**change).is_stable(1.0)


@pytest.mark.parametrize("zeros", [[0.0, 0.0], [1.0, 1.0], [-1.0, 0.2 + 0.6j, 0.2 - 0.6j, 1.0]], ids=str)
@pytest.mark.parametrize("gain", [1e-4, -1e-4])
def test_a_sampled_system_with_zeros_at_rest_and_on_the_circle(zeros, gain):
    # Its closed loop as a polynomial: spring alone, and with the difference of two samples.
    poles = [0.9, 0.7, 0.5 + 0.2j, 0.5 - 0.2j, -0.3]
    for whole in (0, 1):
        scene = zwidth.Scene(
            zwidth.LinearDevice(SIGNAL.dlti(zeros, poles, gain, dt=1e-3)), zwidth.Timing(1e-3, whole * 1e-3)
        )
        loop, top = np.poly(poles + [0.0] * (whole + 1)), gain * np.poly(zeros)

        def radius(K: float, B: float, loop: Any = loop, top: Any = top) -> float:
            return np.abs(np.roots(np.polyadd(loop, np.convolve(top, [K + B / 1e-3, -B / 1e-3])))).max()

        for B in (0.0, 0.3, -0.3):
            K = np.linspace(-2e4, 2e4, 81) + 17.0
            radii = np.array([radius(stiffness, B) for stiffness in K])
            np.testing.assert_array_equal(scene.is_stable(K, B), radii < 1.0)
            np.testing.assert_allclose(scene.spectral_radius(K, B), radii, rtol=1e-9)
            for end in scene.stable_stiffness(B)[0]:
                assert radius(end, B) == pytest.approx(1.0, abs=1e-9)
        wall = scene.max_stiffness(negative_damping=False)
        # Of two poles that meet there roots know half the digits.
        assert (wall.status, radius(*wall[:2])) == (zwidth.Status.OK, pytest.approx(1.0, abs=1e-7))


def test_a_factor_of_numerator_and_denominator_is_not_there():
    # As sums of two responses have it: each has an integrator.
    both: Any = control.tf([1.0], [0.1, 10.0, 0.0]) + control.tf([1.0], [1.0, 200.0, 0.0])
    assert zwidth.LinearDevice(both) == zwidth.LinearDevice(([1.1, 210.0], [0.1, 30.0, 2000.0, 0.0]))
    assert zwidth.LinearDevice(SIGNAL.dlti([1.0], [1.0, 1.0, 0.5], 1e-5, dt=1e-3)).zeros.size == 0
    # Matrices say that there is such a motion.
    hidden = [[0.0, 1.0, 0.0], [0.0, -100.0, 0.0], [0.0, 0.0, 0.5]], [0.0, 10.0, 0.0], [1.0, 0.0, 0.0]
    with pytest.raises(zwidth.InputError, match=r"the mode s = 0.5 does not decay"):
        zwidth.LinearDevice(hidden)


@pytest.mark.parametrize(
    "system, words",
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
def test_what_is_no_such_system_is_refused(system, words):
    with pytest.raises(zwidth.InputError, match=words):
        zwidth.LinearDevice(system)


def test_what_needs_bodies_is_refused():
    scene = zwidth.Scene(zwidth.LinearDevice(COEFFICIENTS), TIMING)
    with pytest.raises(zwidth.InputError, match=r"use external_force or external_force_history, or a zwidth\.Device"):
        scene.simulate(1e3, 1.0, start_velocity=0.1)
    with pytest.raises(zwidth.InputError, match="passivity with a linear device"):
        scene.passivity_margin(1e3, 1.0)
    assert zwidth.assess(scene.replace(stiffness=1e3)).passive is None
    with pytest.raises(zwidth.InputError, match="got a pole of 1e\\+06 rad per period"):
        zwidth.Scene(zwidth.LinearDevice(([1.0], [1.0, 1e9])), TIMING).is_stable(1.0)


@pytest.mark.parametrize("delay", [0.0, 0.4e-3, 2e-3])
def test_a_zero_at_rest_is_a_sampled_zero_at_one(delay):
    """A velocity sensor with a centering spring: s/(s^2 + 2 s + 1), against eigenvalues of the sampled system."""
    timing = zwidth.Timing(1e-3, delay)
    scene = zwidth.Scene(zwidth.LinearDevice("1 0 / 1 2 1"), timing, velocity=zwidth.LowPass(cutoff=100))
    assert np.sum(scene.loop.roots.zeros == 0) == 1
    top = scene.max_stiffness()
    assert top.status == zwidth.Status.OK
    damping = float(top.virtual_damping)
    for share, stable in ((1 - 1e-6, True), (1 + 1e-6, False)):
        matrix = scene.state_space(share * top.stiffness, damping).A
        assert (np.abs(np.linalg.eigvals(matrix)).max() < 1.0) == stable
