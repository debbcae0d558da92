"""Test velocity filters given by coefficients and by sections, and the rejection of integral action.

References: Butterworth filters, products of polynomials, and roots of the closed loop.
"""

import numpy as np
import pytest
import scipy.signal

import zwidth
from zwidth.core.errors import InputError

PERIOD = 1e-4
DEVICE, TIMING = zwidth.Device(0.1, 10), zwidth.Timing(PERIOD, PERIOD)


@pytest.mark.parametrize("order, cutoff", [(8, 2.0), (8, 20.0), (6, 1.0), (4, 0.5)])
def test_rounded_coefficients_are_rejected_and_sections_accepted(order, cutoff):
    numerator, denominator = scipy.signal.butter(order, cutoff, fs=1 / PERIOD)
    with pytest.raises(InputError, match="Cause: rounding errors of the coefficients; use sections in series"):
        zwidth.VelocityFilter(np.convolve(numerator, [1 / PERIOD, -1 / PERIOD]), np.append(denominator, 0.0))
    sos = scipy.signal.butter(order, cutoff, fs=1 / PERIOD, output="sos")
    sections = zwidth.VelocityFilter([[1 / PERIOD, -1 / PERIOD], *sos[:, :3]], [[1, 0], *sos[:, 3:]])
    by_sections, by_design = (
        zwidth.Scene(DEVICE, TIMING, velocity=velocity).max_stiffness(negative_damping=False)
        for velocity in (sections, zwidth.Butterworth(cutoff, order))
    )
    np.testing.assert_allclose(by_sections[:2], by_design[:2], rtol=1e-8)


def test_sections_are_equivalent_to_their_product():
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


def test_integral_action_is_rejected_with_an_alternative():
    """m = 0.1 kg, K = 1 kN/m, and B = 10 N s/m on the difference and its sum: stable as a sampled device with K = 1."""
    period = 1e-3
    # F = (1 - 1/z)/T + 200 T/(1 - 1/z), with the denominator z (z - 1).
    numerator = np.polyadd(np.array([1.0, -2.0, 1.0]) / period, 200.0 * period * np.array([1.0, 0.0, 0.0]))
    with pytest.raises(InputError, match=r"For an integral gain, pass feedback=zwidth\.Feedback\.integral"):
        zwidth.VelocityFilter(numerator, [1.0, -1.0, 0.0])
    device = period**2 / 0.2 * np.array([1.0, 1.0]), np.array([1.0, -2.0, 1.0])
    controller = np.polyadd(1e3 * np.array([1.0, -1.0, 0.0]), 10.0 * numerator), np.array([1.0, -1.0, 0.0])
    loop = np.convolve(device[0], controller[0]), np.convolve(device[1], controller[1])
    radius = np.abs(np.roots(np.polyadd(*loop))).max()
    system = scipy.signal.TransferFunction(*loop, dt=period)
    scene = zwidth.Scene(zwidth.LinearDevice(system), zwidth.Timing(period))
    assert radius < 1.0
    assert scene.spectral_radius(1.0, 0.0) == pytest.approx(radius, rel=1e-9)
    assert scene.is_stable(1.0, 0.0)
