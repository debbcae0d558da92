"""Verdicts in ball arithmetic, against poles computed by mpmath and loops with poles exactly on the unit circle."""

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
def test_verdict_agrees_with_poles(d, delta):
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
def test_zero_stiffness_is_decided_by_the_remaining_poles(d, delta):
    # P = (z - 1) R; synthetic division of the paper's polynomial yields R.
    rng = np.random.default_rng(41)
    statuses = set()
    for beta in delta + rng.uniform(0.01, 4.0, 8) / (1.0 + d):
        with mp.workdps(60):
            p = oracles.polynomial(0.0, beta, delta, d)
            r = list(itertools.accumulate(p, lambda total, value: total + value))[:-1]
            radius = max(abs(z) for z in mp.polyroots(r[::-1], maxsteps=400, asc=True))
        stable, status = certified.decide(0.0, float(beta), delta, d)
        assert (status, stable) == (Status.ON_BOUNDARY if radius < 1 else Status.OK, False)
        statuses.add(status)
    assert len(statuses) == 2


@pytest.mark.parametrize(("delta", "d"), [(0.0, 0.0), (0.4, 0.6), (0.0, 1.0), (0.4, 2.5), (6.0, 4.0)])
def test_ball_polynomial_is_the_polynomial_of_the_paper(delta, d):
    with mp.workdps(60):
        exact = oracles.polynomial(0.3, 0.2, delta, d)[::-1]
        computed = ball_polynomial(0.3, 0.2, delta, d, 200)
        assert len(computed) == len(exact)
        for ball, value in zip(computed, exact, strict=True):
            assert abs(float(ball) - float(value)) <= 1e-15 * (1 + abs(float(value)))


def test_enclosures_of_plant_shrink_with_precision():
    for delta, d in itertools.product((5e-324, 1e-300, 1e-8, 0.5, 750.0, 1e12), (0.0, 0.5, 1.0 - 2.0**-53, 1.5)):
        for bits in (128, 512):
            plant = certified.device(delta, d, bits)
            assert min(a.rel_accuracy_bits() for a in plant if isinstance(a, flint.arb) and a != 0) >= bits - 45


@pytest.mark.parametrize("bits", [128, 1024, 4096])
def test_zeros_on_the_unit_circle_stay_undecided_at_any_precision(bits):
    # At alpha = 0, beta = 2, without delay and damping, the remaining factor of P is R = z^2 + 1.
    verdict = certified.compute_verdict(0.0, 2.0, 0.0, 0.0, bits)
    assert not verdict.stable
    assert not verdict.unstable


def wall_with_pole_on_circle(n, x):
    """Return the rational wall (alpha, beta) of delta = 0, integer d = n whose loop has a pole at e^(j w), x = cos w.

    On the boundary ``alpha + beta (1 - 1/z) = -2 z^n (z - 1)^2/(z + 1)``.
    """
    chebyshev, second = [flint.fmpq(1), x], [flint.fmpq(0), flint.fmpq(1)]
    for _ in range(n):
        chebyshev.append(2 * x * chebyshev[-1] - chebyshev[-2])
        second.append(2 * x * second[-1] - second[-2])
    beta = -2 * (chebyshev[n + 1] - chebyshev[n]) / (1 + x)
    real = 2 * (1 - x) * (second[n + 1] - second[n])
    return real - beta * (1 - x), beta


def test_poles_exactly_on_the_unit_circle_are_undecided():
    assert certified.decide(0.0, 2.0, 0.0, 0.0) == (False, Status.UNDECIDED)
    # Poles at exactly +-j, others outside the unit circle.
    assert certified.decide(0.0, 2.0, 0.0, 4.0)[1] == Status.OK
    for beta in (np.nextafter(2.0, 1.0), np.nextafter(2.0, 3.0)):
        expected = Status.ON_BOUNDARY if beta < 2 else Status.OK
        assert certified.decide(0.0, float(beta), 0.0, 0.0)[1] == expected
        first = certified.compute_verdict(0.0, float(beta), 0.0, 0.0, certified.BITS[0])
        assert first.stable or first.unstable


def decide_at_precision(alpha, beta, bits):
    """Return the verdict on a rational wall at delta = 0, d = 1, computed with this many bits."""
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
def test_doubled_precision_decides_walls_closer_to_the_boundary(bits):
    # The gain crossover is enclosed to half of the bits only.
    alpha, beta = wall_with_pole_on_circle(1, flint.fmpq(3, 4))
    for side in (-1, 1):
        near = alpha + flint.fmpq(side, 2 ** (bits // 2 + 10))
        assert not any(decide_at_precision(near, beta, bits))
        assert decide_at_precision(near, beta, 2 * bits) == (side < 0, side > 0)
