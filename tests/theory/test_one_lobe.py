"""Every inequality of docs/theory/one-lobe.md, and what it says of rows and columns against poles.

Inequalities are proved in the balls of python-flint over boxes that cover delta in [0, 1e6], f in [0, 1] and the
stated range of x = cos w (see boxes.py); algebraic identities are checked exactly, in rational polynomials.
Curve, rows and columns are compared with oracles.py, in 60 digits, at random devices.
"""

from __future__ import annotations

import random

import mpmath as mp
import pytest
from boxes import TAU, UNIT, Implication, RefutedError, UnprovedError, ball, loop, prove, symbols
from flint import arb, fmpq
from mpmath import mpf

import oracles


@pytest.fixture(autouse=True)
def _digits():
    with mp.workdps(60):
        yield


# --- The formulas of the page, for balls, polynomials and numbers alike, in shares or with a1 = 1 ------------------


def _square(a2, a1, a0, x):
    """|M|^2, which is a1^2 Den."""
    return a1**2 + (a2 - a0) ** 2 + 2 * a1 * (a2 + a0) * x + 4 * a2 * a0 * x**2


def _stiffness(a2, a1, a0, c, x):
    """A of L2, times a1."""
    return a2 + (2 * x - c) * a1 + a0 * (4 * x**2 - 2 * c * x - 1)


def _beta_numerator(a2, a1, a0, c, x):
    """beta |M|^2 of L2 at n = 0."""
    return -(4 * a0 * x**2 + 2 * (a1 - (1 + c) * a0) * x + (a2 - a0) * (1 - c) - (1 + c) * a1)


def _slope(a2, a1, a0, c, x):
    """H of L3, times a1^3."""
    first = (a1 + (1 + c) * a2) * (a1 + 2 * a0 * x) ** 2
    second = 4 * a0 * x * (c * a2 - a0) + a1 * (c * a2 - (2 - c) * a0) - (1 + c) * a0 * (a2 - a0)
    return first + (a2 - a0) * second


def _log_curvature(a2, a1, a0, x):
    """-(ln |M|)'' in w, times |M|^4."""
    m, slope = _square(a2, a1, a0, x), 2 * a1 * (a2 + a0) + 8 * a2 * a0 * x
    return (x * slope - 8 * a2 * a0 * (1 - x**2)) * m / 2 + (1 - x**2) * slope**2 / 2


def _turn_rate(a2, a1, a0, x):
    """d arg M/dw."""
    return (a2 - a0) * (a2 + a0 + a1 * x) / _square(a2, a1, a0, x)


def _turn_change(a2, a1, a0, x):
    """d^2 arg M/(dx dw), times |M|^4."""
    slope = 2 * a1 * (a2 + a0) + 8 * a2 * a0 * x
    return (a2 - a0) * (a1 * _square(a2, a1, a0, x) - (a2 + a0 + a1 * x) * slope)


# --- L1 to L3: the curve -------------------------------------------------------------------------------------------


def _device(rng: random.Random):
    """delta, n, f and the coefficients of M, in 60 digits."""
    delta, f, n = mpf(10 ** rng.uniform(-2, 1.5)), mpf(rng.choice([0.0, rng.random()])), rng.choice([0, 0, 1, 4])
    return delta, n, f, oracles.numerator(delta, f)


def _theta(delta, n, a, w):
    """theta of L1, with the continuous argument of M."""
    a2, a1, a0 = a
    root = mp.sqrt(a1**2 - 4 * a2 * a0)
    z = mp.expj(w)
    arg_m = -w + mp.arg(z + (a1 + root) / (2 * a2)) + mp.arg(z + 2 * a0 / (a1 + root))
    return (n + 1) * w + mp.arg(z - mp.exp(-delta)) - arg_m


def test_l1_l2_forms_of_the_curve() -> None:
    """L1 and, for n = 0, L2: against the 2x2 system Re P = Im P = 0."""
    rng = random.Random(1)
    for _ in range(150):
        delta, n, f, a = _device(rng)
        w = mpf(rng.uniform(0.01, 3.13))
        c, x, h, z = mp.exp(-delta), mp.cos(w), w / 2, mp.expj(w)
        alpha, beta = oracles.boundary(w, delta, n + f)
        ratio = abs(z - c) / abs(a[0] * z + a[1] + a[2] / z)
        theta = _theta(delta, n, a, w)
        tiny = mpf(10) ** -40 * (1 + abs(alpha) + abs(beta))
        assert abs(2 * mp.tan(h) * ratio * mp.sin(theta) - alpha) < tiny
        assert abs(-ratio * mp.cos(theta - h) / mp.cos(h) - beta) < tiny
        if n == 0:
            square = _square(*a, x)
            assert abs(2 * (1 - x) * _stiffness(*a, c, x) / square - alpha) < tiny
            assert abs(_beta_numerator(*a, c, x) / square - beta) < tiny


def test_l3_derivative_of_beta() -> None:
    """L3: d beta/dx = -2 H/(a1 Den^2), exactly; _slope is a1^3 H, and H is linear in c."""
    a2, a1, a0, c, x = symbols("a2 a1 a0 c x")
    top, square = _beta_numerator(a2, a1, a0, c, x), _square(a2, a1, a0, x)
    assert top.derivative("x") * square - top * square.derivative("x") == -2 * _slope(a2, a1, a0, c, x)
    assert _slope(a2, a1, a0, c, x).derivative("c").derivative("c") == 0


# --- L4 to L8: beta grows along the lobe ---------------------------------------------------------------------------


def test_l4_four_terms() -> None:
    """L4: H = x hx + p hp + (1 - c) q^2 (1 + q) + (1 - q)(1 + q + 2 q^2), and the form of hx, exactly."""
    p, q, c, x = symbols("p q c x")
    one = p**0
    total = 1 + (1 + c) * p
    first = 4 * q * (total * (1 + q * x) + (p - q) * (c * p - q))
    second = (1 + c) * (1 + 2 * q**2) - 2 * q + c * p - (1 + c) * p * q
    parts = x * first + p * second + (1 - c) * q**2 * (1 + q) + (1 - q) * (1 + q + 2 * q**2)
    assert parts == _slope(p, one, q, c, x)
    assert total + (p - q) * (c * p - q) == 1 + (1 + c) * p * (1 - q) + c * p**2 + q**2
    assert second - (1 - 2 * q + 2 * q**2 - p * q) == c * (1 + 2 * q**2 + p * (1 - q))


def test_l4_terms_are_not_negative() -> None:
    """L4: hp > 0 and the bracket of hx > 0 over all devices; the other two terms need q <= 1 alone (S3)."""

    def second(tau, f):
        a2, a1, a0, c = loop(tau, f)
        return (1 + c) * (a1**2 + 2 * a0**2) - 2 * a0 * a1 + c * a2 * a1 - (1 + c) * a2 * a0

    def first(tau, f):
        a2, a1, a0, c = loop(tau, f)
        return a1**2 + (1 + c) * a2 * a1 + (a2 - a0) * (c * a2 - a0)

    prove(second, [TAU, UNIT])
    prove(first, [TAU, UNIT])


def _slope_claim(tau, f, x):
    m = loop(tau, f)
    return _slope(*m, ball(x))


def test_l4_slope_is_positive_up_to_a_quarter_turn() -> None:
    """L4: H > 0 for x in [0, 1], directly; from f = 0.9 on, where H vanishes in a corner, the four terms above."""
    prove(_slope_claim, [TAU, (0.0, 0.9), UNIT])


def test_l4_fails_beyond() -> None:
    """Negative control: off the lobe, at x < 0, H takes both signs."""
    with pytest.raises(RefutedError):
        prove(_slope_claim, [TAU, UNIT, (-1.0, 0.0)])


def test_l4_vanishes_in_the_corner() -> None:
    """Negative control: at delta = 0, f = 1, x = 0 H is 0, so that no subdivision proves it there."""
    with pytest.raises(UnprovedError):
        prove(_slope_claim, [TAU, UNIT, UNIT], limit=3_000)


def test_l5_g_is_positive() -> None:
    """L5: p >= q implies q < 1/2."""
    prove(lambda tau, f: Implication(((m := loop(tau, f)).a2 - m.a0,), m.a1 - 2 * m.a0), [TAU, UNIT])


def test_l5_identity() -> None:
    """L5: A(-y) = (p - q) - (c + 2y) g with g = 1 - 2 q y, exactly."""
    p, q, c, y = symbols("p q c y")
    assert _stiffness(p, p**0, q, c, -y) == (p - q) - (c + 2 * y) * (1 - 2 * q * y)


def _lobe(tau, f, y):
    """The loop, x = -y, and what holds on the lobe there: p >= q and A >= 0."""
    m, x = loop(tau, f), -ball(y)
    # In the form of L5, in which the balls are narrowest.
    stiffness = (m.a2 - m.a0) - (m.c - 2 * x) * (m.a1 + 2 * m.a0 * x)
    return m, x, (m.a2 - m.a0, stiffness)


def test_l6_g_exceeds_half_and_q() -> None:
    """L6: on the lobe beyond a quarter turn g > 1/2 + q."""

    def claim(tau, f, y):
        m, x, premises = _lobe(tau, f, y)
        return Implication(premises, m.a1 / 2 - m.a0 + 2 * m.a0 * x)

    prove(claim, [TAU, UNIT, UNIT])


def test_l6_needs_the_lobe() -> None:
    """Negative control: off the lobe g > 1/2 + q is false."""

    def claim(tau, f, y):
        m, x, _ = _lobe(tau, f, y)
        return m.a1 / 2 - m.a0 + 2 * m.a0 * x

    with pytest.raises(RefutedError):
        prove(claim, [TAU, UNIT, UNIT])


def test_l7_forms_at_both_ends_of_c() -> None:
    """L7: H at c = 0 and c = 1 in g = 1 - 2 q y and t = p - q, exactly."""
    q, t, y = symbols("q t y")
    one, p, g = q**0, q + t, 1 - 2 * q * y
    at_zero, at_one = (_slope(p, one, q, c * one, -y) for c in (0, 1))
    assert at_zero == (1 + p) * g**2 - 2 * g * t * q - t**2 * q
    assert at_one == (1 + 2 * p) * g**2 + t**2 * (2 * g - 1 - 2 * q)
    # What is left after t q <= 1/4 - q^2
    assert at_zero - (g**2 * (1 + q) + t * ((g - q) ** 2 - one / 4)) == t * (one / 4 - q**2 - t * q)


def test_l7_slope_is_positive_on_the_lobe() -> None:
    """L7: H > 0 on the lobe beyond a quarter turn, directly."""

    def claim(tau, f, y):
        m, x, premises = _lobe(tau, f, y)
        return Implication(premises, _slope(*m, x))

    prove(claim, [TAU, UNIT, UNIT])


def test_l8_beta_grows_for_whole_periods() -> None:
    """L8: along lobes of n from 0 to 5 beta grows from -delta on; sampled in 60 digits."""
    rng = random.Random(2)
    for _ in range(25):
        delta, _, f, a = _device(rng)
        n = rng.randint(0, 5)
        values = []
        for k in range(1, 60):
            w = k * mp.pi / (n + 1) / 60
            if _theta(delta, n, a, w) >= mp.pi:
                break
            values.append(oracles.boundary(w, delta, n + f)[1])
        assert all(low < high for low, high in zip([-delta, *values], values, strict=False))


# --- L9 to L14: alpha has one maximum on the lobe ------------------------------------------------------------------


def test_l9_second_derivative_of_ln_alpha() -> None:
    """L9: the sum of the page, against numerical differentiation in 60 digits."""
    rng, seen = random.Random(3), 0
    while seen < 20:
        delta, n, f, a = _device(rng)
        w = mpf(rng.uniform(0.05, 1.5)) / (n + 1)
        if _theta(delta, n, a, w) > 3:
            continue
        seen += 1
        c, x, sine = mp.exp(-delta), mp.cos(w), mp.sin(w)
        r = (1 - c) ** 2 + 2 * c * (1 - x)
        tau, k, theta = (1 - c**2) / (2 * r), c * sine / r, _theta(delta, n, a, w)
        square = _square(*a, x)
        turn, change = _turn_rate(*a, x), -sine * _turn_change(*a, x) / square**2
        rate, bend = n + mpf(3) / 2 + tau - turn, -2 * tau * k - change
        total = -x / sine**2 + c * x / r - 2 * k**2 + _log_curvature(*a, x) / square**2
        total += bend * mp.cot(theta) - rate**2 / mp.sin(theta) ** 2
        measured = mp.diff(lambda v: mp.log(oracles.boundary(v, delta, n + f)[0]), w, 2)  # noqa: B023
        assert abs(total - measured) < mpf(10) ** -15 * (1 + abs(total))


def test_l10_first_two_terms() -> None:
    """L10: r - c sin^2 w = (1 - c)^2 + c (1 - x)^2, exactly: c/r <= 1/sin^2 w."""
    c, x = symbols("c x")
    assert (1 - c) ** 2 + 2 * c * (1 - x) - c * (1 - x**2) == (1 - c) ** 2 + c * (1 - x) ** 2


def test_l10_curvature_of_the_modulus() -> None:
    """L10: -(ln |M|)'' <= 1/(1 + cos w) for x in [0, 1]."""

    def claim(tau, f, x):
        m, x = loop(tau, f)[:3], ball(x)
        return _square(*m, x) ** 2 - (1 + x) * _log_curvature(*m, x)

    prove(claim, [TAU, UNIT, UNIT])


def _change_claim(bound: arb):
    """|d^2 arg M/dw^2| < bound, squared."""

    def claim(tau, f, x):
        m, x = loop(tau, f)[:3], ball(x)
        return bound**2 * _square(*m, x) ** 4 - (1 - x**2) * _turn_change(*m, x) ** 2

    return claim


def test_l10_change_of_the_turn() -> None:
    """L10: |d^2 arg M/dw^2| < 1/2 for x in [0, 1]."""
    prove(_change_claim(arb(1) / 2), [TAU, UNIT, UNIT])


def test_l10_fails_with_less_than_half_the_bound() -> None:
    """Negative control: one factor of M alone reaches 1/4, so 1/5 must fail."""
    with pytest.raises(RefutedError):
        prove(_change_claim(arb(1) / 5), [TAU, (0.0, 2.0**-6), (0.0, 2.0**-4)])


def test_l11_last_sum() -> None:
    """L11: (3/2 + tau)^2 - tau^2/2 - 5/4 = 1 + 3 tau + tau^2/2, exactly, which is positive."""
    (tau,) = symbols("tau")
    one = tau**0
    assert (one * 3 / 2 + tau) ** 2 - tau**2 / 2 - one * 5 / 4 == 1 + 3 * tau + tau**2 / 2


def test_l12_cubic() -> None:
    """L12: F = (1 - x) A - t Den: its leading coefficient, its value at 1 and its curvature, exactly."""
    p, q, c, x, t = symbols("p q c x t")
    one = p**0
    cubic = (1 - x) * _stiffness(p, one, q, c, x) - t * _square(p, one, q, x)
    assert cubic.derivative("x").derivative("x").derivative("x") == -24 * q
    bent = cubic.derivative("x").derivative("x")
    assert bent == 8 * q - 24 * q * x - 4 + 4 * c * q - 8 * p * q * t
    assert bent.subs({"x": -1}) == 4 * (q * (8 + c) - 1 - 2 * p * q * t)
    assert cubic.subs({"x": 1}) == -t * (1 + p + q) ** 2


def test_l14_lobe_that_reaches_minus_one() -> None:
    """L14: p >= q and A(-1) >= 0 imply q (8 + c) < 1."""

    def claim(tau, f):
        m, _, premises = _lobe(tau, f, (1.0, 1.0))
        return Implication(premises, m.a1 - (8 + m.c) * m.a0)

    prove(claim, [TAU, UNIT])


def test_l14_algebra() -> None:
    """L14: the parabola of the page at both ends of [1/(8 + c), 1/2], exactly."""
    q, c = symbols("q c")
    parabola = 8 * q**2 + 8 * q * (c + 2) * (1 - 2 * q) - 1
    assert parabola.subs({"q": fmpq(1, 2)}) == 1
    assert parabola.derivative("q").derivative("q") == -16 - 32 * (c + 1)
    # At q = 1/(8 + c), times (8 + c)^2
    assert 8 + 8 * (c + 2) * (8 + c - 2) - (8 + c) ** 2 == 7 * c**2 + 48 * c + 40


def test_l14_refuted_with_a_larger_factor() -> None:
    """Negative control: q (2000 + c) < 1 does not follow (q reaches 0.0013 there)."""

    def claim(tau, f):
        m, _, premises = _lobe(tau, f, (1.0, 1.0))
        return Implication(premises, m.a1 - (2000 + m.c) * m.a0)

    with pytest.raises(RefutedError):
        prove(claim, [TAU, UNIT])


# --- L15 to L17: rows and columns ----------------------------------------------------------------------------------


def _runs(flags: list[bool]) -> int:
    """How many runs of True."""
    return sum(flag and not before for before, flag in zip([False, *flags], flags, strict=False))


def _stable(alpha, beta, delta, d) -> bool:
    return oracles.exact_radius(alpha, beta, delta, d) < 1


def test_l15_to_l17_rows_and_columns() -> None:
    """L15 to L17: along random rows and columns the poles show one stable interval at most; none for beta <= -delta."""
    rng, seen = random.Random(4), 0
    for _ in range(16):
        delta, n, f, a = _device(rng)
        w = mpf(rng.uniform(0.2, 0.9)) * mp.pi / (n + 2)
        if _theta(delta, n, a, w) >= mp.pi:
            continue
        alpha, beta = oracles.boundary(w, delta, n + f)
        row = [_stable(alpha * k / 16 + mpf("1e-6"), beta, delta, n + f) for k in range(30)]
        assert row[0]
        assert _runs(row) == 1
        reach = 2 * (abs(beta) + delta)
        column = [_stable(alpha * mpf("0.8"), -delta + reach * k / 30, delta, n + f) for k in range(40)]
        assert _runs(column) <= 1
        seen += _runs(column)
        assert not any(_stable(alpha * k / 4, -delta * (1 + mpf(k) / 9), delta, n + f) for k in range(1, 9))
    assert seen > 6
