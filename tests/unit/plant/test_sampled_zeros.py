"""Test the zeros of sampled linear systems, against partial fractions in mpmath."""

import numpy as np
import pytest
from mpmath import mp

import zwidth
from zwidth.plant.sampled_zeros import find_sampled_zeros


def evaluate_response(zeros, poles, gain, period, fraction, z):
    """Return G(z), times z for a fractional delay, of a sampled system with simple poles, by partial fractions."""
    total = mp.mpc(0)
    for k, p in enumerate(poles):
        residue = mp.mpf(gain) * mp.fprod(p - q for q in zeros)
        residue /= mp.fprod(p - q for i, q in enumerate(poles) if i != k)
        a, partial = mp.exp(p * period), mp.expm1(p * period * (1 - fraction)) / p
        full = mp.expm1(p * period) / p
        total += residue * (z * partial + full - partial if fraction else full) / (z - a)
    return total


@pytest.mark.parametrize("fraction", [0.0, 0.3, 1e-3])
def test_sampled_zeros_reproduce_the_frequency_response(fraction):
    rng = np.random.default_rng(5)
    for count in (1, 2, 4, 5):
        poles = [*(-(10 ** rng.uniform(0, 4, count))).tolist(), -30 + 800j, -30 - 800j]
        zeros = (-(10 ** rng.uniform(0, 4, count - 1))).tolist()
        device = zwidth.LinearDevice((zeros, poles, 3.0))
        lead, zeros_minus_one = find_sampled_zeros(device, 1e-3, fraction)
        with mp.workdps(80):
            exact = [mp.mpc(pole) for pole in poles]
            for angle in (0.01, 0.3, 1.0, 3.0):
                z = mp.expj(angle)
                value = mp.mpf(lead) * mp.fprod(z - 1 + mp.mpc(zero) for zero in zeros_minus_one.tolist())
                value /= mp.fprod(z - mp.exp(pole * mp.mpf(1e-3)) for pole in exact)
                expected = evaluate_response([mp.mpf(q) for q in zeros], exact, 3.0, mp.mpf(1e-3), mp.mpf(fraction), z)
                assert abs(value / expected - 1) < 1e-13
