"""Velocity estimates of a user's own class: the transfer function decides, never the class."""

import math

import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.model.velocity import Estimate

MASS, DAMPING, PERIOD = 0.1, 10.0, 1e-3


class Smoothed(zwidth.BackwardDifference):
    """``(x_k - x_(k-1))/T`` behind a low-pass with the pole 0.8, in floats."""

    def estimate(self, period):
        return Estimate(window=1, gain=0.2, lag=-1, poles=np.array([0.2 + 0j]))

    def fraction(self):
        return 0.2 * np.array([1.0, -1.0]) / PERIOD, np.array([1.0, -0.8])


class Weak(zwidth.BackwardDifference):
    """Half of the difference."""

    def estimate(self, period):
        return Estimate(window=1, gain=0.5)

    def fraction(self):
        return 0.5 * np.array([1.0, -1.0]) / PERIOD, np.array([1.0, 0.0])


class Faster(zwidth.LowPass):
    """A low-pass at three times the cut-off, computed with `math`."""

    def estimate(self, period):
        offset = -math.expm1(-6.0 * math.pi * float(self.cutoff) * float(period))
        return Estimate(1, offset, -1, poles=np.array([offset + 0j]))

    def fraction(self):
        p = math.exp(-6.0 * math.pi * self.cutoff * PERIOD)
        return (1 - p) * np.array([1.0, -1.0]) / PERIOD, np.array([1.0, -p])


class Lead(zwidth.WindowedDifference):
    """Two samples of a window behind a zero."""

    def estimate(self, period):
        return Estimate(window=self.samples, gain=2.0, lag=1, zeros=np.array([0.5 + 0j]))

    def fraction(self):
        n = self.samples
        top = np.zeros(n + 1)
        top[[0, -1]] = 1.0 / n, -1.0 / n
        return 2.0 * np.convolve(top, [1.0, -0.5]) / PERIOD, np.append(1.0, np.zeros(n + 1))


ESTIMATES = [Smoothed(), Weak(), Faster(cutoff=40.0), Lead(samples=3)]


def own_radius(velocity, stiffness, damping, delay):
    """The largest pole magnitude, from a rigid mass under a held force and whole periods of delay."""
    rate = DAMPING / MASS
    e = math.exp(-rate * PERIOD)
    b1 = (PERIOD - (1 - e) / rate) / DAMPING
    b0 = ((1 - e) / rate - PERIOD * e) / DAMPING
    device = np.convolve(np.convolve([1.0, -1.0], [1.0, -e]), np.append(1.0, np.zeros(delay)))
    top, bottom = velocity.fraction()
    wall = np.polyadd(stiffness * bottom, damping * top)
    return np.abs(np.roots(np.polyadd(np.convolve(device, bottom), np.convolve([b1, b0], wall)))).max()


def make_scene(velocity, delay):
    device, timing = zwidth.Device(MASS, DAMPING), zwidth.Timing(PERIOD, delay * PERIOD)
    return zwidth.Scene(device, timing, velocity=velocity)


@pytest.mark.parametrize("velocity", ESTIMATES, ids=lambda each: type(each).__name__)
def test_walls_are_those_of_the_transfer_function(velocity):
    rng = np.random.default_rng(3)
    for delay in (0, 1, 2):
        scene = make_scene(velocity, delay)
        top = scene.max_stiffness()
        assert int(top.status) == Status.OK
        damping = float(top.virtual_damping)
        assert own_radius(velocity, 0.999 * top.stiffness, damping, delay) < 1.0
        assert own_radius(velocity, 1.001 * top.stiffness, damping, delay) > 1.0
        K, B = top.stiffness * rng.uniform(0.01, 1.5, 40), (abs(damping) + 5.0) * rng.uniform(0.0, 2.0, 40)
        radii = np.array([own_radius(velocity, *wall, delay) for wall in zip(K, B, strict=True)])
        np.testing.assert_allclose(scene.spectral_radius(K, B), radii, rtol=1e-7)
        for method in ("auto", "companion", "certified"):
            if method == "certified":
                pytest.importorskip("flint")
            found = scene.decide_stability(K, B, method=method)
            assert np.all(found.status == Status.OK)
            np.testing.assert_array_equal(found.stable, radii < 1.0)


def test_coefficients_of_the_plain_difference_count_as_it():
    """The same transfer function as a filter: negative dampings count by default for both, with the same K_max."""
    device, timing = zwidth.Device(0.1, 1000.0), zwidth.Timing(1e-3)
    plain = zwidth.Scene(device, timing).max_stiffness()
    assert plain.virtual_damping < 0
    found = zwidth.Scene(device, timing, velocity=zwidth.VelocityFilter([1000, -1000], [1, 0])).max_stiffness()
    np.testing.assert_allclose(found[:2], plain[:2], rtol=1e-9)


def test_a_class_of_a_user_has_no_name_in_configurations():
    from zwidth.model.parameter_paths import spell_estimate

    with pytest.raises(InputError, match="got Weak, which is not available in configurations"):
        spell_estimate(Weak())


@pytest.mark.parametrize(
    "velocity",
    [
        zwidth.LowPass(cutoff=100),
        zwidth.LowPass(time_constant=2e-3, order=2),
        zwidth.Butterworth(60, order=3),
        zwidth.VelocityFilter([1000, -1000], [1, 0]),
        zwidth.VelocityFilter([500, -500, 0], [1, -0.6, 0.1]),
        zwidth.WindowedDifference(5),
        zwidth.BackwardDifference(coded_period=5e-4),
    ],
    ids=str,
)
def test_certified_labels_are_those_of_all_poles(velocity):
    pytest.importorskip("flint")
    rng = np.random.default_rng(11)
    scene = make_scene(velocity, 1)
    top = scene.max_stiffness()
    K, B = top.stiffness * rng.uniform(0.01, 1.5, 40), abs(top.virtual_damping) * rng.uniform(0.0, 2.5, 40)
    K[0] = 0.0
    found = scene.decide_stability(K, B, method="certified")
    assert found.status.tolist() == [Status.ON_BOUNDARY] + 39 * [Status.OK]
    np.testing.assert_array_equal(found.stable[1:], scene.is_stable(K, B, method="companion")[1:])
