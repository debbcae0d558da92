"""Dominant poles of linear loops against all poles and simulated oscillations."""

import jax
import numpy as np
import pytest
from compiling import QUICKLY

import zwidth
from zwidth.core.status import Status

DEVICE = zwidth.Device(0.1, 5)
LOW_PASS = zwidth.LowPass(cutoff=100)


def make_scene(delay=1e-3, velocity=LOW_PASS):
    return zwidth.Scene(DEVICE, zwidth.Timing(period=1e-3, delay=delay), velocity=velocity)


@pytest.mark.parametrize("delay", [0, 1e-3, 2.5e-3, 20e-3])
def test_random_walls_agree_with_all_poles(delay):
    rng = np.random.default_rng(4)
    K, B = rng.uniform(1, 6000, 150), rng.uniform(0, 30, 150)
    scene = make_scene(delay)
    pole, z = scene.dominant_pole(K, B), scene.poles(K, B)
    dominant = np.take_along_axis(z, np.abs(z).argmax(-1)[:, None], -1)[:, 0]
    np.testing.assert_array_equal(pole.status, Status.OK)
    np.testing.assert_allclose(pole.angle, np.abs(np.angle(dominant)), atol=1e-9)
    np.testing.assert_allclose(pole.frequency, pole.angle / (2 * np.pi * 1e-3))
    np.testing.assert_array_equal(pole.radius, scene.spectral_radius(K, B))
    np.testing.assert_allclose(np.exp(-1e-3 * pole.decay_rate), pole.radius, rtol=1e-12)


def test_long_delay_agrees_with_all_poles():
    """With more than 150 poles, the radius is found by counting, and the angle on the circle with this radius."""
    scene, K, B = make_scene(0.2), np.array([0.5, 5.0, 40.0, 200.0]), np.array([0.1, 1.0, 2.0, 5.0])
    pole, z = scene.dominant_pole(K, B), scene.poles(K, B)
    dominant = np.take_along_axis(z, np.abs(z).argmax(-1)[:, None], -1)[:, 0]
    np.testing.assert_array_equal(pole.status, Status.OK)
    np.testing.assert_allclose(pole.angle, np.abs(np.angle(dominant)), atol=1e-9)


def test_rigid_scene_and_walls_as_typed_by_a_user():
    scene = zwidth.Scene(DEVICE, zwidth.Timing(period="1 ms", delay="1 ms"))
    pole = scene.dominant_pole("10 kN/m", 20)
    expected = zwidth.dominant_pole(*scene.normalize_walls(10e3, 20), scene.delta, scene.d)
    assert pole.frequency == pytest.approx(float(expected.angle) / (2 * np.pi * 1e-3), rel=1e-12)
    assert scene.replace(wall=zwidth.VirtualWall(10_000, 20)).dominant_pole() == pole
    assert scene.dominant_pole([1, 1e70], 1).status.tolist() == [Status.OK, Status.OUT_OF_RANGE]


def test_rigid_scene_inside_jit(x64):
    scene = zwidth.Scene(DEVICE, zwidth.Timing(1e-3, 1e-3))
    frequency = jax.jit(lambda K: scene.dominant_pole(K, 20).frequency, compiler_options=QUICKLY)(10e3)
    assert frequency == pytest.approx(float(scene.dominant_pole(10e3, 20).frequency), rel=1e-9)


def test_other_scenes_refuse_traced_walls():
    scene = make_scene()
    with pytest.raises(zwidth.InputError, match="dominant_pole: got a value traced by JAX"):
        jax.jit(lambda K: scene.dominant_pole(K, 20).frequency)(1e3)
    with pytest.raises(zwidth.InputError, match="dominant_pole: got a value traced by JAX"):
        jax.jit(lambda scene: scene.dominant_pole(1e3, 20).frequency)(scene)


def test_frequency_is_that_of_the_assessment():
    scene = make_scene().replace(wall=zwidth.VirtualWall(2000, 10))
    verdict, pole = zwidth.assess(scene), scene.dominant_pole()
    assert pole.frequency == pytest.approx(verdict.frequency, rel=1e-12)
    assert pole.decay_rate == pytest.approx(verdict.decay_rate, rel=1e-12)
