"""Test rotary devices: the values of linear devices in rotary units. Mixed unit systems are rejected."""

import copy
import dataclasses
import pickle
import re
from typing import Any

import jax
import numpy as np
import pytest

import zwidth
from zwidth.units.display import find_unit
from zwidth.units.formatting import with_unit
from zwidth.units.parsing import DIMENSIONS
from zwidth.units.unit_system import LINEAR, ROTARY, UNIT_PAIRS

LINEAR_UNITS = re.compile(r"\b(k|m|µ|M)?(N/m|N s/m|g)\b(?! ?cm\^2)|\bkg\b(?! m\^2)")


def make_rotary() -> zwidth.Scene:
    wall = zwidth.VirtualWall("2 mN m/deg", "0.4 mN m s/rad")
    return zwidth.Scene(zwidth.Device("12 g cm^2", "0.02 mN m s/rad"), zwidth.Timing("1 ms", "1 ms"), wall)


def write_html(result: Any) -> str:
    return result._repr_html_()


def test_rotary_units_make_a_device_rotary():
    scene = make_rotary()
    assert scene.device == zwidth.Device(12e-7, 2e-5, rotary=True)
    assert scene.device != zwidth.Device(12e-7, 2e-5)
    assert "rotary=True" in repr(scene.device)
    assert "rotary" not in repr(zwidth.Device(0.1))
    assert scene.wall.stiffness == pytest.approx(2e-3 * 180 / np.pi, rel=1e-15)
    assert zwidth.Device(1e-4, coupling=zwidth.Coupling("3 g cm²", "20 N m/rad")).rotary
    assert zwidth.Device(1e-4, modes=[zwidth.Mode(100, 0.01, "3 g·cm^2")]).rotary
    assert not zwidth.Device("0.1 kg").rotary
    assert not zwidth.Device(0.1).rotary
    assert zwidth.devices.find_device("haptic_wheel").to_device().rotary


# Devices with couplings, modes and neither, each with a filter and with an operator.
@pytest.mark.parametrize("seed", [1, 2, 3, 5, 6, 10])
def test_rotary_scene_has_the_values_of_the_linear_scene(seed):
    random = np.random.default_rng(seed)
    mass, damping, period = 10.0 ** random.uniform([-7, -6, -4], [-2, -3, -2])
    coupling = zwidth.Coupling(0.3 * mass, 0.5 * mass / period**2, 0.01 * mass / period) if seed % 3 == 0 else None
    modes = [zwidth.Mode(0.2 / period, 0.05, 4 * mass)] if seed % 3 == 1 else []
    velocity = zwidth.LowPass(0.1 / period) if seed % 2 else zwidth.BackwardDifference()
    hand = zwidth.Operator(0.2 * mass, 1e-3 * mass / period, 1e-4 * mass / period**2) if seed % 4 == 2 else None
    timing = zwidth.Timing(period, random.uniform(0, 2) * period)
    linear, rotary = (
        zwidth.Scene(
            zwidth.Device(mass, damping, coupling, modes=modes, rotary=is_rotary),
            timing,
            velocity=velocity,
            operator=hand,
        )
        for is_rotary in (False, True)
    )
    top = linear.max_stiffness()
    K = top.stiffness * random.uniform(0.1, 1.5, 5)
    B = top.virtual_damping * random.uniform(0.0, 2.0, 5)
    for name in ("max_stiffness", "sensitivities", "islands", "stable_region"):
        np.testing.assert_equal(getattr(rotary, name)(), getattr(linear, name)())
    for name in ("is_stable", "spectral_radius", "margins", "poles"):
        np.testing.assert_equal(getattr(rotary, name)(K, B), getattr(linear, name)(K, B))
    np.testing.assert_array_equal(rotary.stable_stiffness(B), linear.stable_stiffness(B))
    one, other = (scene.recommend(stiffness_fraction=0.5) for scene in (linear, rotary))
    assert (one.stiffness, one.virtual_damping, one.limited_by) == (
        other.stiffness,
        other.virtual_damping,
        other.limited_by,
    )
    assert one.verdict is not None
    assert other.verdict is not None
    np.testing.assert_equal(one.verdict.as_dict(), other.verdict.as_dict())
    walls = [scene.replace(stiffness=K[0], virtual_damping=B[0]) for scene in (linear, rotary)]
    first, second = (zwidth.assess(scene).as_dict() for scene in walls)
    np.testing.assert_equal(first, second)
    # Only for one scene of each kind, because the simulation is compiled for each.
    if seed <= 3:
        one, other = (scene.simulate(K[0], B[0], start_position=1e-3, periods=200).amplitude for scene in walls)
        np.testing.assert_array_equal(one, other)


def test_results_are_shown_in_rotary_units():
    scene = make_rotary()
    top = scene.max_stiffness()
    assert "mN m/rad" in repr(top)
    assert "µN m s/rad" in repr(top)
    assert "mN m/rad" in write_html(top)
    for result in (
        *(top, scene.units, scene.sensitivities(), zwidth.assess(scene), scene.recommend(), scene.best_damping()),
        *(scene.boundary(300.0), *scene.stable_region(), *zwidth.limits_of(scene)),
        *(scene.simulate(start_position="1 deg"), scene.to_si(alpha=0.1), scene.required("damping", 0.2)),
    ):
        for text in (repr(result), write_html(result)):
            assert not LINEAR_UNITS.search(text), text
    recommendation = scene.recommend()
    assert "mN m/deg" in recommendation.lines()[0]
    assert "N m s/rad" in recommendation.lines()[1]
    assert recommendation.as_dict()["units"]["stiffness"] == "N m/rad"
    assert "angle in rad" in recommendation.code()
    assert "angle in rad" in recommendation.code("python")
    assert "N m/rad" in zwidth.limits_of(scene)[0].spell()
    assert "N/m" in repr(zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3)).max_stiffness())


def test_copied_and_pickled_results_keep_their_units():
    top = make_rotary().max_stiffness()
    for each in (copy.deepcopy(top), pickle.loads(pickle.dumps(top)), top._replace(frequency=1.0)):
        assert "mN m/rad" in repr(each)
    verdict = zwidth.assess(make_rotary())
    for each in (copy.deepcopy(verdict), pickle.loads(pickle.dumps(verdict)), dataclasses.replace(verdict, alpha=0)):
        assert "mN m/rad" in repr(each)


def test_functions_of_values_return_rotary_units_for_rotary_input():
    arguments: dict[str, Any] = {"mass": "12 g cm^2", "damping": ["0.02 mN m s/rad"], "period": "1 ms"}
    gains = zwidth.sensitivities(**arguments)
    assert gains.stiffness_max == zwidth.sensitivities(mass=12e-7, damping=[2e-5], period=1e-3).stiffness_max
    assert "mN m/rad" in repr(gains)
    assert "per kg m^2" in repr(gains)
    with pytest.raises(zwidth.InputError, match=r"^damping: got '2 N s/m', in linear units, together with mass"):
        zwidth.max_stiffness(mass="12 g cm^2", damping=["2 N s/m"], period=1e-3)


ROTARY_DEVICE, LINEAR_DEVICE = zwidth.Device(12e-7, 2e-5, rotary=True), zwidth.Device(0.1, 10)
TIMING = zwidth.Timing(1e-3)


@pytest.mark.parametrize(
    ("field", "make"),
    [
        ("damping", lambda: zwidth.Device("12 g", "0.02 mN m s/rad")),
        ("damping", lambda: zwidth.Device("12 g cm^2", "0.02 N s/m")),
        ("mass", lambda: zwidth.Device("12 g", rotary=True)),
        ("mass", lambda: zwidth.Device("12 g cm^2", rotary=False)),
        ("coupling", lambda: zwidth.Device("12 g cm^2", coupling=zwidth.Coupling("10 g", "20 kN/m"))),
        ("coupling", lambda: zwidth.Device(1e-4, coupling=zwidth.Coupling("10 g", 20e3), rotary=True)),
        ("modes.0", lambda: zwidth.Device("12 g cm^2", modes=[zwidth.Mode(100, 0.01, "20 g")])),
        ("modes.1", lambda: zwidth.Device(1, modes=[zwidth.Mode(1, 1, "2 g"), zwidth.Mode(1, 1, "2 g cm^2")])),
        ("coupling.stiffness", lambda: zwidth.Coupling("10 g", "20 N m/rad")),
        ("virtual_damping", lambda: zwidth.VirtualWall("10 N/m", "1 mN m s/rad")),
        ("wall", lambda: zwidth.Scene(ROTARY_DEVICE, TIMING, zwidth.VirtualWall("10 N/m"))),
        ("wall", lambda: zwidth.Scene(LINEAR_DEVICE, TIMING, zwidth.VirtualWall("10 mN m/deg"))),
        ("operator", lambda: zwidth.Scene(ROTARY_DEVICE, TIMING, operator=zwidth.Operator("0.5 kg"))),
        ("stiffness", lambda: zwidth.Scene(ROTARY_DEVICE, TIMING).is_stable("10 N/m", 0)),
        ("virtual_damping", lambda: zwidth.Scene(ROTARY_DEVICE, TIMING).stable_stiffness("2 N s/m")),
        ("stiffness", lambda: zwidth.Scene(LINEAR_DEVICE, TIMING).is_stable("10 mN m/deg", 0)),
        ("stiffness", lambda: zwidth.Scene(ROTARY_DEVICE, TIMING).best_damping("10 N/m")),
        ("start_position", lambda: zwidth.simulate(zwidth.Scene(ROTARY_DEVICE, TIMING), 1, 0, start_position="1 mm")),
        ("mass", lambda: zwidth.Scene(LINEAR_DEVICE, TIMING).replace(mass="12 g cm^2")),
        ("mass", lambda: zwidth.Scene(ROTARY_DEVICE, TIMING).replace(mass="12 g")),
        ("scenes", lambda: zwidth.simulate([zwidth.Scene(each, TIMING) for each in (LINEAR_DEVICE, ROTARY_DEVICE)], 1)),
        ("rotary", lambda: zwidth.Device(0.1, rotary="yes")),  # pyright: ignore[reportArgumentType]
    ],
)
def test_mixed_unit_systems_are_rejected(field, make):
    with pytest.raises(zwidth.InputError, match=rf"^{re.escape(field)}: got ") as error:
        make()
    assert "; " in str(error.value)


def test_misspelled_rotary_unit_suggests_rotary_unit():
    with pytest.raises(zwidth.InputError, match=r"did you mean 'mN m s/rad'\?"):
        zwidth.Device(1e-6, "0.02 mN m s/rd")
    with pytest.raises(zwidth.InputError, match=r"a rotary unit for a linear device"):
        zwidth.Scene(LINEAR_DEVICE, TIMING).is_stable(10, "0.02 mN m s/rad")


def test_unit_pairs_are_parsed_and_formatted():
    for linear, rotary in UNIT_PAIRS:
        assert (LINEAR[linear], ROTARY[linear], ROTARY[rotary]) == (linear, rotary, rotary)
        if linear != "m/N":
            assert [DIMENSIONS[unit].base for unit in (linear, rotary)] == [linear, rotary]
    assert with_unit(4.5e-4, ROTARY["kg"]) == "4500 g cm^2"
    assert with_unit(2.0, ROTARY["N/m per kg"]) == "2.000 N m/rad per kg m^2"


def test_rotary_and_linear_results_share_class_and_pytree_structure():
    rotary, linear = make_rotary().max_stiffness(), zwidth.Scene(LINEAR_DEVICE, TIMING).max_stiffness()
    assert type(rotary) is type(linear)
    assert [find_unit(each, "N/m") for each in (rotary, linear)] == ["N m/rad", "N/m"]
    assert jax.tree.structure(rotary) == jax.tree.structure(linear)
    ratio = jax.tree.map(lambda one, other: float(one / max(other, 1)), rotary, linear)
    K, B, *_ = rotary
    assert (ratio.stiffness, ratio.virtual_damping) == (K / linear.stiffness, B / max(linear.virtual_damping, 1))


@pytest.mark.parametrize(
    "transform",
    [
        lambda wall: jax.tree.map(np.asarray, wall),
        lambda wall: jax.jit(lambda each: each)(wall),
        lambda wall: jax.vmap(lambda each: each)(jax.tree.map(np.atleast_1d, wall)),
    ],
)
def test_jax_transformed_results_are_shown_without_force_units(transform):
    transformed = transform(make_rotary().max_stiffness())
    assert type(transformed).__name__ == "StiffestWall"
    assert transformed.unit_system is None
    assert "Hz" in repr(transformed)
    assert "N" not in repr(transformed).replace("NO_", "").removeprefix("StiffestWall")


def test_values_without_units_are_linear():
    gains = zwidth.sensitivities(mass=0.1, period=1e-3)
    assert "kN/m" in repr(gains)
    assert "kN/m" in repr(gains._replace(per_mass=1.0))
    assert "kN/m" in repr(zwidth.denormalize(mass=0.1, period=1e-3, alpha=0.1))
    traced = jax.jit(lambda mass: zwidth.sensitivities(mass=mass, period=1e-3))(0.1)
    assert float(traced.stiffness_max) == pytest.approx(float(gains.stiffness_max), rel=1e-5)


def test_dataset_of_rotary_motion_has_rotary_units():
    data = make_rotary().simulate(start_position="1 deg", periods=50).to_dataset()
    assert (data.position.units, data.velocity.units, data.command.units) == ("rad", "rad/s", "N m")


def test_fit_buzz_accepts_rotary_argument():
    points = [(0.4, 0.0, 40.0), (0.9, 1e-3, 68.0), (1.1, 2e-3, 89.0)]
    fit = zwidth.fit_buzz(points, period="1 ms", noise=0.02, rotary=True)
    assert fit.scene.device.rotary
    assert "N m" in repr(fit)
    with pytest.raises(zwidth.InputError, match=r"^rotary: got False"):
        zwidth.fit_buzz([("0.4 N m/rad", 0, 40), ("0.9 N m/rad", 1e-3, 68)], period=1e-3, rotary=False)
