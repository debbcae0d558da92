"""Newton's steps on a pole, and the distance within which they prove one: against mpmath."""

import numpy as np
import pytest
from mpmath import mp

import oracles
from zwidth.loops.rigid.circle import factor_loop
from zwidth.loops.rigid.pole_step import halley_step, newton_step


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


def loop_at(alpha, beta, delta, d):
    return factor_loop(np.float64(alpha), np.float64(beta), np.float64(delta), np.float64(d), d % 1.0 != 0.0)


@pytest.mark.parametrize("d", [0.0, 3.0, 0.5, 2.25])
def test_steps_are_those_of_the_polynomial(d):
    for alpha, beta, delta, re, im in walls(d):
        step = newton_step(np.float64(re), np.float64(im), loop_at(alpha, beta, delta, d), d % 1.0 != 0.0)
        with mp.workdps(60):
            polynomial = oracles.polynomial(alpha, beta, delta, d)
            degree = len(polynomial) - 1
            z = mp.exp(re) * mp.expj(im)
            terms = [part * z ** (degree - k) for k, part in enumerate(polynomial)]
            exact = complex(-sum(terms) / sum((degree - k) * term for k, term in enumerate(terms)))
        assert abs(complex(step.re, step.im) - exact) <= 1e-12 * abs(exact)


@pytest.mark.parametrize("d", [0.0, 3.0, 0.5, 2.25])
def test_a_pole_is_as_near_as_is_said(d):
    for alpha, beta, delta, re, im in walls(d):
        loop, fractional = loop_at(alpha, beta, delta, d), d % 1.0 != 0.0
        with mp.workdps(60):
            poles = oracles.roots(oracles.polynomial(alpha, beta, delta, d))
        # From far away to where Newton's method stands still.
        for _ in range(8):
            step = newton_step(np.float64(re), np.float64(im), loop, fractional)
            with mp.workdps(60):
                z = mp.exp(re) * mp.expj(im)
                nearest = min(abs(pole / z - 1) for pole in poles)
            assert nearest <= step.within
            re, im = re + step.re, im + step.im
            if not abs(im) <= np.pi:
                break


@pytest.mark.parametrize("d", [0.0, 40.0, 2.25])
def test_halleys_method_ends_at_a_pole_from_far_away(d):
    loop, fractional = loop_at(0.01, 0.02, 0.1, d), d % 1.0 != 0.0
    # Not on the real axis: from there no step leads away, and this loop has no pole to its left.
    for start in (0.1, np.pi / (d + 2.0), 3.0):
        re, im = np.float64(0.01), np.float64(start)
        for _ in range(30):
            re, im = halley_step(re, im, loop, fractional)
        assert newton_step(re, im, loop, fractional).within < 1e-9
