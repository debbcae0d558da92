"""Velocity filters by coefficients and by sections, and controllers that they cannot contain."""

import numpy as np
import pytest
import scipy.signal

import zwidth
from zwidth.core.errors import InputError

PERIOD = 1e-4
DEVICE, TIMING = zwidth.Device(0.1, 10), zwidth.Timing(PERIOD, PERIOD)


@pytest.mark.parametrize("order, cutoff", [(8, 2.0), (8, 20.0), (6, 1.0), (4, 0.5)])
def test_rounded_coefficients_are_named_and_sections_accepted(order, cutoff):
    top, bottom = scipy.signal.butter(order, cutoff, fs=1 / PERIOD)
    with pytest.raises(InputError, match="Cause: rounding errors of the coefficients; use sections in series"):
        zwidth.VelocityFilter(np.convolve(top, [1 / PERIOD, -1 / PERIOD]), np.append(bottom, 0.0))
    sos = scipy.signal.butter(order, cutoff, fs=1 / PERIOD, output="sos")
    sections = zwidth.VelocityFilter([[1 / PERIOD, -1 / PERIOD], *sos[:, :3]], [[1, 0], *sos[:, 3:]])
    found, wanted = (
        zwidth.Scene(DEVICE, TIMING, velocity=velocity).max_stiffness(negative_damping=False)
        for velocity in (sections, zwidth.Butterworth(cutoff, order))
    )
    np.testing.assert_allclose(found[:2], wanted[:2], rtol=1e-8)


def test_sections_are_their_product():
    one = zwidth.VelocityFilter([[1000, -1000], [0.5, 0.1]], [[1, 0], [1, -0.4]])
    product = zwidth.VelocityFilter([500, -400, -100], [1, -0.4, 0])
    stiffness, damping = np.meshgrid(np.linspace(1e3, 3e4, 12), np.linspace(0, 80, 9))
    scenes = [zwidth.Scene(DEVICE, zwidth.Timing(1e-3, 1e-3), velocity=each) for each in (one, product)]
    for method in ("auto", "companion", "certified"):
        if method == "certified":
            pytest.importorskip("flint")
        labels = [scene.is_stable(stiffness, damping, method=method) for scene in scenes]
        np.testing.assert_array_equal(*labels)
        assert 0 < labels[0].sum() < labels[0].size
    assert eval(repr(one), {"VelocityFilter": zwidth.VelocityFilter}) == one


def test_an_integrator_is_refused_with_what_contains_it():
    """m = 0.1 kg, K = 1 kN/m, B = 10 N s/m on the difference and its sum: stable, as one sampled device times K = 1."""
    period = 1e-3
    # F = (1 - 1/z)/T + 200 T/(1 - 1/z), over z (z - 1).
    top = np.polyadd(np.array([1.0, -2.0, 1.0]) / period, 200.0 * period * np.array([1.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="Integral action: model controller and sampled device in series as one"):
        zwidth.VelocityFilter(top, [1.0, -1.0, 0.0])
    device = period**2 / 0.2 * np.array([1.0, 1.0]), np.array([1.0, -2.0, 1.0])
    controller = np.polyadd(1e3 * np.array([1.0, -1.0, 0.0]), 10.0 * top), np.array([1.0, -1.0, 0.0])
    loop = np.convolve(device[0], controller[0]), np.convolve(device[1], controller[1])
    radius = np.abs(np.roots(np.polyadd(*loop))).max()
    system = scipy.signal.TransferFunction(*loop, dt=period)
    scene = zwidth.Scene(zwidth.LinearDevice(system), zwidth.Timing(period))
    assert radius < 1.0
    assert scene.spectral_radius(1.0, 0.0) == pytest.approx(radius, rel=1e-9)
    assert scene.is_stable(1.0, 0.0)
