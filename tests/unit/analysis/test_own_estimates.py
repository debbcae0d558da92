"""Test velocity estimates of user-defined classes: only the transfer function determines stability.

Reference: roots of the characteristic polynomial, in NumPy.
"""

import math

import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.model.estimate import Estimate

MASS, DAMPING, PERIOD = 0.1, 10.0, 1e-3


class Smoothed(zwidth.BackwardDifference):
    """``(x_k - x_(k-1))/T`` with a first-order low-pass of pole 0.8, in floats."""

    def estimate(self, period):
        return Estimate(window=1, gain=0.2, lag=-1, poles=np.array([0.2 + 0j]))

    def fraction(self):
        return 0.2 * np.array([1.0, -1.0]) / PERIOD, np.array([1.0, -0.8])


class Weak(zwidth.BackwardDifference):
    """Half of the backward difference."""

    def estimate(self, period):
        return Estimate(window=1, gain=0.5)

    def fraction(self):
        return 0.5 * np.array([1.0, -1.0]) / PERIOD, np.array([1.0, 0.0])


class Faster(zwidth.LowPass):
    """A low-pass at three times the cutoff frequency, computed with `math`."""

    def estimate(self, period):
        offset = -math.expm1(-6.0 * math.pi * float(self.cutoff) * float(period))
        return Estimate(1, offset, -1, poles=np.array([offset + 0j]))

    def fraction(self):
        p = math.exp(-6.0 * math.pi * self.cutoff * PERIOD)
        return (1 - p) * np.array([1.0, -1.0]) / PERIOD, np.array([1.0, -p])


class Lead(zwidth.WindowedDifference):
    """A windowed difference with an additional zero."""

    def estimate(self, period):
        return Estimate(window=self.samples, gain=2.0, lag=1, zeros=np.array([0.5 + 0j]))

    def fraction(self):
        n = self.samples
        numerator = np.zeros(n + 1)
        numerator[[0, -1]] = 1.0 / n, -1.0 / n
        return 2.0 * np.convolve(numerator, [1.0, -0.5]) / PERIOD, np.append(1.0, np.zeros(n + 1))


ESTIMATES = [Smoothed(), Weak(), Faster(cutoff=40.0), Lead(samples=3)]


def compute_radius(velocity, stiffness, damping, delay):
    """Return the largest pole magnitude of a rigid mass with zero-order hold and an integer delay."""
    rate = DAMPING / MASS
    e = math.exp(-rate * PERIOD)
    b1 = (PERIOD - (1 - e) / rate) / DAMPING
    b0 = ((1 - e) / rate - PERIOD * e) / DAMPING
    device = np.convolve(np.convolve([1.0, -1.0], [1.0, -e]), np.append(1.0, np.zeros(delay)))
    numerator, denominator = velocity.fraction()
    wall = np.polyadd(stiffness * denominator, damping * numerator)
    return np.abs(np.roots(np.polyadd(np.convolve(device, denominator), np.convolve([b1, b0], wall)))).max()


def make_scene(velocity, delay):
    device, timing = zwidth.Device(MASS, DAMPING), zwidth.Timing(PERIOD, delay * PERIOD)
    return zwidth.Scene(device, timing, velocity=velocity)


@pytest.mark.parametrize("velocity", ESTIMATES, ids=lambda each: type(each).__name__)
def test_walls_match_polynomial_of_transfer_function(velocity):
    rng = np.random.default_rng(3)
    for delay in (0, 1, 2):
        scene = make_scene(velocity, delay)
        top = scene.max_stiffness()
        assert int(top.status) == Status.OK
        damping = float(top.virtual_damping)
        assert compute_radius(velocity, 0.999 * top.stiffness, damping, delay) < 1.0
        assert compute_radius(velocity, 1.001 * top.stiffness, damping, delay) > 1.0
        K, B = top.stiffness * rng.uniform(0.01, 1.5, 40), (abs(damping) + 5.0) * rng.uniform(0.0, 2.0, 40)
        radii = np.array([compute_radius(velocity, *wall, delay) for wall in zip(K, B, strict=True)])
        np.testing.assert_allclose(scene.spectral_radius(K, B), radii, rtol=1e-7)
        for method in ("auto", "companion", "certified"):
            if method == "certified":
                pytest.importorskip("flint")
            decision = scene.decide_stability(K, B, method=method)
            assert np.all(decision.status == Status.OK)
            np.testing.assert_array_equal(decision.stable, radii < 1.0)


def test_filter_with_coefficients_of_backward_difference_has_its_maximum():
    """For both, negative dampings are included by default."""
    device, timing = zwidth.Device(0.1, 1000.0), zwidth.Timing(1e-3)
    plain = zwidth.Scene(device, timing).max_stiffness()
    assert plain.virtual_damping < 0
    filtered = zwidth.Scene(device, timing, velocity=zwidth.VelocityFilter([1000, -1000], [1, 0])).max_stiffness()
    np.testing.assert_allclose(filtered[:2], plain[:2], rtol=1e-9)


def test_user_defined_class_has_no_name_in_configurations():
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
def test_certified_decisions_match_companion_matrix(velocity):
    pytest.importorskip("flint")
    rng = np.random.default_rng(11)
    scene = make_scene(velocity, 1)
    top = scene.max_stiffness()
    K, B = top.stiffness * rng.uniform(0.01, 1.5, 40), abs(top.virtual_damping) * rng.uniform(0.0, 2.5, 40)
    K[0] = 0.0
    decision = scene.decide_stability(K, B, method="certified")
    assert decision.status.tolist() == [Status.ON_BOUNDARY] + 39 * [Status.OK]
    np.testing.assert_array_equal(decision.stable[1:], scene.is_stable(K, B, method="companion")[1:])
