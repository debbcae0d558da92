"""Passive worlds with which a coupling beyond the safe limit is unstable, against the composed polynomial in z."""

from typing import Any

import numpy as np
import pytest
from numpy.polynomial import polynomial
from scipy.signal import cont2discrete

import zwidth

PERIOD, MASS, DAMPING = 1e-3, 0.1, 10.0


def make_scene(n_delay, **parts):
    return zwidth.Scene(zwidth.Device(MASS, DAMPING), zwidth.Timing(PERIOD, f"{n_delay} periods"), **parts)


def compute_radius(world, n_delay, K, B):
    """Return the largest modulus of the poles, without those of the common drift of device and tool at z = 1.

    The force of the tool is M (v' - v)/T plus that of a spring by the trapezoidal rule, so that its impedance in the
    backward difference v of the position is ``2 M/T (1 - q)/(1 + q) + (k T/2) (1 + q)/(1 - q)`` with q = 1/z.
    """
    body = [MASS + world.hand_mass, DAMPING, world.hand_stiffness]
    numerator, denominator, _ = cont2discrete(([1.0], body), PERIOD)
    minus, plus = np.array([1.0, -1.0]), np.array([1.0, 1.0])
    # Impedances as fractions in ascending powers of q: coupling (B (1 - q) + K T)/(1 - q), tool upper/lower.
    coupling = polynomial.polyadd(B * minus, [K * PERIOD])
    upper = polynomial.polyadd(
        2 * world.tool_mass / PERIOD * polynomial.polymul(minus, minus),
        world.tool_stiffness * PERIOD / 2 * polynomial.polymul(plus, plus),
    )
    lower = polynomial.polymul(plus, minus)
    # In series: Z = Z_1 Z_2/(Z_1 + Z_2). The force per position is Z (1 - q)/T.
    top = polynomial.polymul(polynomial.polymul(coupling, upper), minus) / PERIOD
    bottom = polynomial.polyadd(polynomial.polymul(coupling, lower), polynomial.polymul(upper, minus))
    plant = np.append(np.zeros(n_delay), numerator.ravel())
    loop = polynomial.polyadd(polynomial.polymul(denominator, bottom), polynomial.polymul(plant, top))
    roots = np.roots(np.trim_zeros(loop, "f"))
    return float(np.max(np.abs(roots[np.abs(roots - 1) > 1e-3])))


@pytest.mark.parametrize("n_delay", [0, 1, 2])
def test_just_beyond_the_limit_without_damper(n_delay):
    scene = make_scene(n_delay)
    K = 2 * DAMPING / (PERIOD * (n_delay + 1) ** 2)
    assert scene.unsafe_world(K * (1 - 1e-6), 0).status == zwidth.Status.UNREACHABLE
    assert scene.unsafe_world(K * (1 + 1e-5), 0).status == zwidth.Status.OK
    world = scene.unsafe_world(K * 1.01, 0)
    assert world.status == zwidth.Status.OK
    assert world.spectral_radius > 1
    assert compute_radius(world, n_delay, K * 1.01, 0) == pytest.approx(world.spectral_radius, abs=1e-6)


@pytest.mark.parametrize(("n_delay", "factor"), [(1, 1.07), (2, 1.04), (3, 1.03)])
def test_beyond_the_stiffest_coupling(n_delay, factor):
    scene = make_scene(n_delay)
    K, B = scene.max_safe_coupling()
    world = scene.unsafe_world(factor * K, B)
    assert world.status == zwidth.Status.OK
    assert compute_radius(world, n_delay, factor * K, B) > 1
    near = scene.unsafe_world(1.001 * K, B)
    assert near.status == zwidth.Status.NOT_CONVERGED
    assert np.isnan(near.spectral_radius)


@pytest.mark.parametrize("coupling", [(0, 100), ("1 MN/m", 0), (1e5, "50 N s/m"), (200, 40)])
def test_unsafe_couplings(coupling):
    hand, tool = zwidth.Operator(0.5, 5), zwidth.Tool(0.1)
    world = make_scene(1, operator=hand, tool=tool).unsafe_world(*coupling)
    np.testing.assert_allclose(world, make_scene(1).unsafe_world(*coupling), rtol=1e-9)
    assert world.status == zwidth.Status.OK
    assert world.spectral_radius > 1


def test_units_and_refusals():
    device, timing = zwidth.Device("1e-4 kg m^2", "0.01 N m s/rad"), zwidth.Timing("1 ms", "1 ms")
    assert "g cm^2" in repr(zwidth.Scene(device, timing).unsafe_world(6, 0))
    with pytest.raises(zwidth.InputError, match="integer delays"):
        make_scene(0.5).unsafe_world(1e4, 0)
    with pytest.raises(zwidth.InputError, match="backward difference"):
        make_scene(1, velocity=zwidth.LowPass(cutoff=50)).unsafe_world(1e4, 0)
    untyped: Any = make_scene(1)
    with pytest.raises(zwidth.InputError, match="pass one wall"):
        untyped.unsafe_world([1e4, 2e4], 0)
