"""Decay rates against labels of 60 digits, exact roots in mpmath and ball arithmetic; their signs against the
verdict.
"""

from pathlib import Path

import flint
import mpmath as mp
import numpy as np
import pytest

import oracles
import zwidth
from zwidth.stability.rigid.characteristic_polynomial import factor_loop
from zwidth.stability.rigid.dominant.search import approximate_first_pair, approximate_slow_pole
from zwidth.stability.rigid.dominant.steps import halley_step

REFERENCE = Path(__file__).resolve().parents[4] / "reference"
NAMES = ("alpha", "beta", "delta", "d")
# Hard cases: rates formerly returned as 0 or -5e-16; a double pole near 1; beta = -delta; a slow pole and a pair of
# equal modulus.
HARD_WALLS = zip(
    (1e-60, 2152.8250035942688, 2151.825004026501, np.nextafter(1.0, 2.0)),
    (5.024833777510824e-35, 1.398206984365602e-17, 1.9514254455461163e-19, 3.587500244316158),
    (1.0852888887691377e-38, -2.1906036452364306e-10, 2.1906036452364306e-10, 59.0),
    (7.631510433624652e-09, 0.26362768524208585, 0.0004982256326648892, 5.0),
    strict=True,
)
HARD_WALLS = [np.array(column) for column in HARD_WALLS]


def exact_rate(*wall):
    with mp.workdps(120):
        return -mp.log(max(abs(root) for root in oracles.roots(oracles.polynomial(*wall))))


def test_rates_of_reference_labels_are_accurate_and_have_the_right_sign():
    with np.load(REFERENCE / "labels.npz") as file:
        rate, exact = zwidth.decay_rate(*(file[name] for name in NAMES)), -np.log1p(file["margin"])
        finite = np.isfinite(rate)
        assert finite[np.abs(exact) > 1e-11].mean() > 0.99
        np.testing.assert_allclose(rate[finite], exact[finite], rtol=1e-12, atol=2e-15)
        np.testing.assert_allclose(rate[finite], exact[finite], rtol=1e-3)
        np.testing.assert_array_equal((rate > 0)[finite], file["stable"][finite])


def test_rates_of_adversarial_walls_are_accurate_or_nan():
    with np.load(REFERENCE / "adversarial.npz") as file:
        walls, margin = [file[name] for name in NAMES], file["margin"]
    rate = zwidth.decay_rate(*walls)
    # At margins below 1e-16 the verdict itself may be wrong: the rate agrees with the verdict, not with the label.
    compared = np.isfinite(rate) & (np.abs(margin) > 1e-16)
    assert compared.sum() > 2000
    np.testing.assert_allclose(rate[compared], -np.log1p(margin[compared]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rate[compared], -np.log1p(margin[compared]), rtol=1e-3)


@pytest.mark.parametrize(
    "wall",
    [
        (1e-20, 1e-3, 1e-9, 0.0),
        (1e-15, 1e-9, 1e-9, 1.0),
        (1e-10, 1e-7, 0.0, 2.0),
        (0.05, 0.1, 0.03, 1.5),
    ],
)
def test_rates_of_slow_loops_are_accurate(wall):
    assert zwidth.decay_rate(*wall) == pytest.approx(float(exact_rate(*wall)), rel=1e-13)


@pytest.mark.parametrize(
    "wall",
    [(1e-13, 1.4132588650193014, 0.00027724736314914985, 0.25), (1e-17, 0.8284272285685977, 1.3888413586734453e-07, 1)],
)
def test_poles_of_equal_modulus_on_the_unit_circle_have_no_rate(wall):
    # Poles near 1 and a pair elsewhere, all within 1e-12 of the unit circle.
    assert np.isnan(zwidth.decay_rate(*wall))


def rate_by_balls(alpha, beta, delta, d):
    """Return the decay rate of the dominant root of the paper's polynomial, enclosed by python-flint's balls."""
    whole, t = int(d), flint.arb(1) - (flint.arb(d) - int(d))
    for bits in (400, 1600):
        with flint.ctx.workprec(2 * bits):
            x, f = flint.arb(delta), 1 - t

            def phis(x):
                p1 = -(-x).expm1() / x
                return p1, (1 - p1) / x

            (p1, p2), (late1, late2) = phis(x), phis(x * t)
            c, numerator = (-x).exp(), [p1 - p2, p2]
            if d != whole:
                early1, early2 = phis(x * f)
                g0 = t * t * late2, t * late1
                g1 = f * f * early2 + t * late1 * f * early1, (-x * t).exp() * f * early1
                numerator = [p1 * g1[1] - c * g1[0], p1 * g0[1] - c * g0[0] + g1[0], g0[0]]
            arms = flint.arb_poly(numerator) * flint.arb_poly([-flint.arb(beta), flint.arb(alpha) + flint.arb(beta)])
            lag = whole + 1 + (d != whole)
            p = flint.acb_poly(arms + flint.arb_poly([0] * lag + [c, -(1 + c), 1]))
        with flint.ctx.workprec(bits):
            try:
                roots = p.roots()
            except ValueError:
                continue
            slope, best = p.derivative(), max(float(abs(z).lower()) for z in roots)
            rates = []
            for z in roots:
                if float(abs(z).upper()) > best - 1e-9:
                    for _ in range(12):
                        middle = flint.acb(z.real.mid(), z.imag.mid())
                        new = middle - p(middle) / slope(z)
                        z = new if z.contains(new) else z
                    # A ball that contains its own conjugate and no other root contains a real root.
                    rates.append(-abs(z.real if z.imag.contains(0) else z).log())
            rate = min(rates, key=lambda rate: float(rate.mid()))
            if rate.rad() < abs(rate.mid()) * flint.arb(1e-13):
                return float(rate.mid())
    return np.nan


def walls_near_minus_delta(count, rng):
    """Return walls near ``beta = -delta``, where the linear term of P at z = 1 nearly vanishes and two poles nearly
    coincide.
    """
    delta, alpha = 10.0 ** rng.uniform(-19, 3, 4 * count), 10.0 ** rng.uniform(-60, -3, 4 * count)
    d = rng.choice([0.0, 1.0, 3.0, 17.0, 0.25, 1.5, 2.9, np.nextafter(1.0, 2.0)], 4 * count)
    near = -delta * (1 + rng.integers(-40, 41, 4 * count) * 2.0**-53)
    beta = np.concatenate([near[:count], -delta[count:] * (1 - 10.0 ** rng.uniform(-16, 0, 3 * count))])
    least = np.abs(beta + delta)[2 * count :] ** 2 / np.maximum(1, delta[2 * count :])
    spread = np.concatenate([10.0 ** rng.uniform(-4, 2, count), 0.25 * (1 + 10.0 ** rng.uniform(-9, 0, count))])
    alpha[2 * count :] = least * spread + 1e-60
    return alpha, beta, delta, d


def iterate_both(steps, loop, fractional):
    """Return the slow pole and the first complex pair after this many Halley steps from their initial
    approximations.
    """
    poles = approximate_slow_pole(loop), approximate_first_pair(loop, fractional)
    for _ in range(steps):
        poles = [halley_step(*pole, loop, fractional) for pole in poles]
    return poles


def walls_with_poles_of_equal_modulus(count, rng):
    """Return walls whose slow pole and first pair have equal modulus (bisection in beta), up to relative offsets of
    1e-17 to 1e-8.
    """
    delta, d = 10.0 ** rng.uniform(-5, 1, count), rng.choice([0.0, 1.0, 2.0, 5.0, 0.5, 1.25], count)
    alpha = 10.0 ** rng.uniform(-9, -1, count) / (1 + d)
    low, high = (zwidth.boundary_point(delta, d, alpha=alpha, side=side).beta for side in ("lower", "upper"))

    def is_slow_larger(beta):
        (slow, _), (pair, _) = iterate_both(40, factor_loop(alpha, beta, delta, d, True), True)
        return slow > pair

    low, high = np.array(low + 0.02 * (high - low)), np.array(high)
    middle = high
    with np.errstate(all="ignore"):
        before = is_slow_larger(low)
        for _ in range(70):
            middle = 0.5 * (low + high)
            same = is_slow_larger(middle) == before
            low, high = np.where(same, middle, low), np.where(same, high, middle)
    return alpha, middle * (1 + rng.choice([-1, 0, 1], count) * 10.0 ** rng.uniform(-17, -8, count)), delta, d


def scattered_walls(count, rng):
    """Return random walls of every stiffness, down to loops whose spectral radius rounds to 1."""
    beta = np.append(rng.uniform(-0.2, 1.2, count // 2), 10.0 ** rng.uniform(-9, 0, count - count // 2))
    delta, d = 10.0 ** rng.uniform(-6, 1, count), rng.integers(0, 17, count) / 2
    return 10.0 ** rng.uniform(-18, 0, count), beta, delta, d


def walls_with_double_poles(count, rng):
    """Return walls at the stiffness, found by bisection, at which two real poles become a complex pair."""
    beta, delta, d = rng.uniform(0, 0.3, count), 10.0 ** rng.uniform(-3, 0, count), rng.integers(0, 4, count) * 1.0
    low, high = np.full(count, 1e-9), np.full(count, 2.0)
    with np.errstate(all="ignore"):
        for _ in range(70):
            middle = np.sqrt(low * high)
            pair = iterate_both(30, factor_loop(middle, beta, delta, d, False), False)[0][1] > 1e-7
            low, high = np.where(pair, low, middle), np.where(pair, middle, high)
    return high, beta, delta, d


@pytest.mark.parametrize(
    "draw, count, rtol, atol",
    [
        (scattered_walls, 150, 1e-12, 0.0),
        (walls_with_double_poles, 50, 0.0, 1e-9),
        (walls_near_minus_delta, 100, 1e-10, 1e-12),
        (walls_with_poles_of_equal_modulus, 150, 1e-10, 1e-12),
    ],
)
def test_rates_near_multiple_poles_are_accurate_or_nan(draw, count, rtol, atol):
    walls = draw(count, np.random.default_rng(31))
    walls = [np.append(column, extra) for column, extra in zip(walls, HARD_WALLS, strict=True)]
    rate = zwidth.decay_rate(*walls)
    finite = np.isfinite(rate)
    exact = np.array([rate_by_balls(*wall) for wall in zip(*(column.tolist() for column in walls), strict=True)])
    compared = finite & np.isfinite(exact)
    assert compared.sum() > 0.9 * finite.sum()
    assert finite[np.abs(exact) > 1e-6].all()
    np.testing.assert_allclose(rate[compared], exact[compared], rtol=rtol, atol=atol)
    np.testing.assert_allclose(rate[compared], exact[compared], rtol=1e-3)


def test_rate_without_stiffness_is_zero():
    assert zwidth.decay_rate(0.0, 0.3, 0.1, 1) == 0.0
