"""The radius that a Newton step certifies to contain a pole, against poles computed by mpmath."""

import numpy as np
import pytest
from mpmath import mp

import oracles
from zwidth.stability.rigid.characteristic_polynomial import factor_loop
from zwidth.stability.rigid.dominant.steps import newton_step


def walls(d, count=12):
    rng = np.random.default_rng(int(10 * d))
    scale = 1.0 + d
    return [
        (float(alpha), float(beta), float(delta), float(re), float(im))
        for alpha, beta, delta, re, im in zip(
            rng.uniform(-0.2, 1.5, count) / scale,
            rng.uniform(-0.5, 1.5, count) / scale,
            10.0 ** rng.uniform(-3, 1, count),
            rng.uniform(-0.6, 0.6, count) / scale,
            rng.uniform(0, np.pi, count),
            strict=True,
        )
    ]


def build_loop(alpha, beta, delta, d):
    return factor_loop(np.float64(alpha), np.float64(beta), np.float64(delta), np.float64(d), d % 1.0 != 0.0)


@pytest.mark.parametrize("d", [0.0, 3.0, 0.5, 2.25])
def test_newton_radius_contains_a_pole(d):
    for alpha, beta, delta, re, im in walls(d):
        loop, fractional = build_loop(alpha, beta, delta, d), d % 1.0 != 0.0
        with mp.workdps(60):
            poles = oracles.roots(oracles.polynomial(alpha, beta, delta, d))
        # Iterate from a remote start until Newton's method has converged.
        for _ in range(8):
            step = newton_step(np.float64(re), np.float64(im), loop, fractional)
            with mp.workdps(60):
                z = mp.exp(re) * mp.expj(im)
                nearest = min(abs(pole / z - 1) for pole in poles)
            assert nearest <= step.radius
            re, im = re + step.re, im + step.im
            if not abs(im) <= np.pi:
                break
