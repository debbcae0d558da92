"""Ball arithmetic: verdicts against independent poles, and what is exactly on the unit circle."""

import itertools

import mpmath as mp
import numpy as np
import pytest

import oracles
from methods.problems import ball_polynomial
from zwidth.core.status import Status
from zwidth.stability.rigid import certified

flint = pytest.importorskip("flint")


@pytest.mark.parametrize("d", [0.0, 5e-324, 0.3, 1.0 - 2.0**-53, 1.0, 1.75, 4.0])
@pytest.mark.parametrize("delta", [0.0, 1e-8, 0.4, 6.0])
def test_verdict_is_that_of_the_poles(d, delta):
    rng = np.random.default_rng(31)
    for alpha, beta in zip(rng.uniform(0, 1 + delta, 6), rng.uniform(-delta, 2 + delta, 6), strict=True):
        with mp.workdps(oracles.digits_for(delta)):
            p = oracles.polynomial(alpha, beta, delta, d)[::-1]
            radius = max(abs(z) for z in mp.polyroots(p, maxsteps=400, asc=True))
            stable, status = certified.decide(float(alpha), float(beta), delta, d)
            assert status == Status.OK
            assert stable == (radius < 1)


@pytest.mark.parametrize("d", [0.0, 0.3, 1.0, 1.75, 4.0])
@pytest.mark.parametrize("delta", [0.0, 0.4])
def test_without_stiffness_the_other_poles_decide(d, delta):
    # P = (z - 1) R; the roots of R by synthetic division of the polynomial as printed.
    rng = np.random.default_rng(41)
    seen = set()
    for beta in delta + rng.uniform(0.01, 4.0, 8) / (1.0 + d):
        with mp.workdps(60):
            p = oracles.polynomial(0.0, beta, delta, d)
            r = list(itertools.accumulate(p, lambda total, value: total + value))[:-1]
            radius = max(abs(z) for z in mp.polyroots(r[::-1], maxsteps=400, asc=True))
        stable, status = certified.decide(0.0, float(beta), delta, d)
        assert (status, stable) == (Status.ON_BOUNDARY if radius < 1 else Status.OK, False)
        seen.add(status)
    assert len(seen) == 2


@pytest.mark.parametrize(("delta", "d"), [(0.0, 0.0), (0.4, 0.6), (0.0, 1.0), (0.4, 2.5), (6.0, 4.0)])
def test_polynomial_is_the_printed_one(delta, d):
    with mp.workdps(60):
        exact = oracles.polynomial(0.3, 0.2, delta, d)[::-1]
        found = ball_polynomial(0.3, 0.2, delta, d, 200)
        assert len(found) == len(exact)
        for ball, value in zip(found, exact, strict=True):
            assert abs(float(ball) - float(value)) <= 1e-15 * (1 + abs(float(value)))


def test_enclosures_shrink_with_the_precision():
    for delta, d in itertools.product((5e-324, 1e-300, 1e-8, 0.5, 750.0, 1e12), (0.0, 0.5, 1.0 - 2.0**-53, 1.5)):
        for bits in (128, 512):
            here = certified.device(delta, d, bits)
            assert min(a.rel_accuracy_bits() for a in here if isinstance(a, flint.arb) and a != 0) >= bits - 45


@pytest.mark.parametrize("bits", [128, 1024, 4096])
def test_zeros_on_the_circle_are_never_labelled_by_precision(bits):
    # R = z^2 + 1 is left of P at alpha = 0, beta = 2, without delay and damping.
    found = certified.compute_verdict(0.0, 2.0, 0.0, 0.0, bits)
    assert not found.stable
    assert not found.unstable


def curve(n, x):
    """The rational wall of delta = 0, whole d = n whose loop has a pole at ``e^(j w)``, ``cos w = x``, by its formula.

    There ``alpha + beta (1 - 1/z) = -2 z^n (z - 1)^2/(z + 1)``.
    """
    chebyshev, second = [flint.fmpq(1), x], [flint.fmpq(0), flint.fmpq(1)]
    for _ in range(n):
        chebyshev.append(2 * x * chebyshev[-1] - chebyshev[-2])
        second.append(2 * x * second[-1] - second[-2])
    beta = -2 * (chebyshev[n + 1] - chebyshev[n]) / (1 + x)
    real = 2 * (1 - x) * (second[n + 1] - second[n])
    return real - beta * (1 - x), beta


def test_what_is_exactly_on_the_circle_stays_undecided():
    assert certified.decide(0.0, 2.0, 0.0, 0.0) == (False, Status.UNDECIDED)
    # Poles exactly at +-j, others outside.
    assert certified.decide(0.0, 2.0, 0.0, 4.0)[1] == Status.OK
    for beta in (np.nextafter(2.0, 1.0), np.nextafter(2.0, 3.0)):
        expected = Status.ON_BOUNDARY if beta < 2 else Status.OK
        assert certified.decide(0.0, float(beta), 0.0, 0.0)[1] == expected
        first = certified.compute_verdict(0.0, float(beta), 0.0, 0.0, certified.BITS[0])
        assert first.stable or first.unstable


def at_precision(alpha, beta, bits):
    """The verdict of a rational wall at delta = 0, d = 1."""
    with flint.ctx.workprec(bits):
        wall = flint.arb(alpha), flint.arb(beta)
        return certified.decide_long_delay(
            *wall,
            1,
            certified.device(0.0, 1.0, bits),
            certified._enclose_root_in_balls,
            certified._evaluate_phase_in_balls,
        )


@pytest.mark.parametrize("bits", [64, 256, 1024])
def test_twice_the_precision_decides_walls_closer_to_the_boundary(bits):
    # The gain crossover is enclosed to half of the bits.
    alpha, beta = curve(1, flint.fmpq(3, 4))
    for side in (-1, 1):
        near = alpha + flint.fmpq(side, 2 ** (bits // 2 + 10))
        assert not any(at_precision(near, beta, bits))
        assert at_precision(near, beta, 2 * bits) == (side < 0, side > 0)
