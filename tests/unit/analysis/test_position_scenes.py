"""Every public method of a scene with a position estimate or further feedback answers for them, or refuses."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import zwidth
from zwidth.analysis.assessment import list_improvements
from zwidth.core.errors import InputError

DEVICE, TIMING, WALL = zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), zwidth.VirtualWall(3e3, 15)
PARTS = {
    "filter": {"position": zwidth.ExponentialFilter(0.4)},
    "measured": {"position": zwidth.ExponentialFilter(cutoff=150, velocity_from="measured")},
    "pll": {"position": zwidth.Pll(800)},
    "integral": {"feedback": zwidth.IntegralFeedback(300)},
    "cascade": {"position": zwidth.Pll(700), "feedback": zwidth.IntegralFeedback(30, "forward", 20, 1)},
}
ARGUMENTS = {"boundary": (100.0,), "required": ("damping", 5e3), "frequency_response": (3e3, 10.0, 50.0)}
OPTIONS = {"simulate": {"start_position": 1e-3}}
# Results that do not depend on the controller, or that are equal for this wall.
EQUAL = {
    "check_parts", "decide_stability", "explain_undecided", "is_stable", "islands", "normalize_walls", "required",
    "to_si",
}  # fmt: skip
METHODS = [name for name in dir(zwidth.Scene) if name[0] != "_" and callable(getattr(zwidth.Scene, name))]


@pytest.fixture(scope="module")
def plain():
    return zwidth.Scene(DEVICE, TIMING, WALL)


@pytest.mark.parametrize("parts", PARTS.values(), ids=PARTS)
@pytest.mark.parametrize("method", METHODS)
def test_no_method_ignores_a_part(method, parts, plain):
    scene, arguments = zwidth.Scene(DEVICE, TIMING, WALL, **parts), ARGUMENTS.get(method, ())
    options, message, result = OPTIONS.get(method, {}), "", None
    try:
        result = getattr(scene, method)(*arguments, **options)
    except InputError as error:
        message = str(error)
    if message:
        assert "position" in message or "feedback" in message
    elif method == "damper_range" and parts is PARTS["measured"]:
        # With K = 0 the position estimate has no effect, because the velocity is computed from the measured position.
        np.testing.assert_allclose(np.asarray(result), plain.damper_range(), rtol=1e-12)
    elif method not in EQUAL:
        assert repr(result) != repr(getattr(plain, method)(*arguments, **options))


def test_measured_devices_refuse_them():
    frequency = np.geomspace(1, 500, 60)
    response = 1 / (-0.1 * (2 * np.pi * frequency) ** 2 + 10j * 2 * np.pi * frequency)
    device = zwidth.MeasuredDevice(frequency, response)
    with pytest.raises(InputError, match="position: needs a model of the device"):
        zwidth.Scene(device, zwidth.Timing(1e-3), position=zwidth.ExponentialFilter(0.4))


@pytest.mark.parametrize("name", ["filter", "pll", "cascade"])
def test_a_traced_scene(name, x64):
    scene = zwidth.Scene(DEVICE, TIMING, **PARTS[name])
    top = scene.max_stiffness()
    traced = jax.jit(lambda scene: scene.max_stiffness())(scene)
    assert float(traced.stiffness) == pytest.approx(float(top.stiffness), rel=1e-14)
    K = np.linspace(1e3, 3e4, 5)
    labels = jax.jit(lambda scene, K: scene.is_stable(K, 20.0))(scene, K)
    np.testing.assert_array_equal(labels, scene.is_stable(K, 20.0))
    slopes = jax.grad(lambda scene: scene.max_stiffness().stiffness)(scene).parameters()
    sensitivities = scene.sensitivities()
    for path, step in (("mass", 1e-6), (f"position.{'coefficient' if name == 'filter' else 'bandwidth'}", 1e-5)):
        x = scene.parameters()[path]
        high, low = (
            float(scene.replace(**{path: x * (1 + sign * step)}).max_stiffness().stiffness) for sign in (1, -1)
        )
        expected = (high - low) / (2 * x * step)
        assert float(slopes[path]) == pytest.approx(expected, rel=1e-4)
        assert sensitivities.per[path] == pytest.approx(float(slopes[path]), rel=1e-10)


def test_derivatives_of_margins_include_the_feedback(x64):
    scene = zwidth.Scene(DEVICE, TIMING, **PARTS["cascade"])
    for name in ("gain_margin", "phase_margin", "delay_margin", "modulus_margin"):

        def margin(scene, name=name):
            return getattr(scene.margins(3e3, 15.0), name)

        slope = jax.grad(margin)(scene).parameters()["damping"]
        high, low = (float(margin(scene.replace(damping=10 + step))) for step in (1e-3, -1e-3))
        assert float(slope) == pytest.approx((high - low) / 2e-3, rel=1e-5)


def test_many_scenes():
    scene = zwidth.Scene(DEVICE, TIMING, **PARTS["filter"])
    walls = zwidth.stiffest_walls(scene, {"position.coefficient": [0.3, 0.5]})
    for coefficient, stiffness in zip((0.3, 0.5), walls.stiffness, strict=True):
        single = scene.replace(**{"position.coefficient": coefficient}).max_stiffness()
        assert stiffness == pytest.approx(float(single.stiffness), rel=1e-9)


def test_a_filter_in_powers_of_z_keeps_its_rate():
    in_z = zwidth.PositionFilter([0.5, 0.5], [1, 0])
    for position, changes_rate in ((zwidth.ExponentialFilter(0.4), False), (in_z, False), (zwidth.Pll(300), True)):
        improvements = list_improvements(zwidth.Scene(DEVICE, TIMING, WALL, position=position))
        assert any("rate" in each[1] for each in improvements) == changes_rate
