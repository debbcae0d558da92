"""Every inequality of S1 to S18 in docs/theory/one-crossover.md, and its theorems against poles.

Inequalities are proved in the balls of python-flint over boxes that cover delta in [0, 1e6] and f in [0, 1] (see
boxes.py); algebraic identities are checked exactly, in rational polynomials. Theorems are compared with the
roots of the model's polynomial in 60 digits, from oracles.py, on random loops.
"""

from __future__ import annotations

import math
import random
from functools import lru_cache

import mpmath as mp
import pytest
from boxes import TAU, UNIT, Implication, RefutedError, ball, early_mean, loop, phi, prove, symbols
from flint import arb, ctx
from mpmath import mpf

import oracles


@pytest.fixture(autouse=True)
def _digits():
    with mp.workdps(60):
        yield


def _random_device(rng: random.Random) -> tuple[float, float]:
    """delta from 0 to 1e6 and f in [0, 1), ends included."""
    delta = rng.choice([0.0, 1e-8, 1e6, *(10 ** rng.uniform(-4, 3) for _ in range(7))])
    return delta, rng.choice([0.0, 1 - 2.0**-40, *(rng.random() for _ in range(6))])


# --- S1 to S5: the numerator M ------------------------------------------------------------------------------------


def test_s1_coefficients_are_means() -> None:
    """S1: E max(1 - f - s, 0) and E max(s - 1 + f, 0) are the coefficients of the exact discretization."""
    rng = random.Random(1)
    for _ in range(200):
        delta, f = _random_device(rng)
        tau = 1 / (1 + delta)
        delta = 1 / mpf(tau) - 1  # what the rounded tau stands for
        with mp.workdps(120):
            expected = [a / oracles.phi(delta).phi1 for a in oracles.numerator(delta, f)]
        with ctx.workprec(160):
            found = loop.__wrapped__((tau, tau), (f, f))[:3]  # not a value kept from fewer bits
        for share, exact in zip(found, expected, strict=True):
            assert abs(mpf(share.mid().str(40, radius=False)) - exact) < mpf(10) ** -30


def test_s2_zeros_of_m_are_real() -> None:
    """S2: a1^2 > 8 a2 a0."""
    prove(lambda tau, f: (m := loop(tau, f)).a1 ** 2 - 8 * m.a2 * m.a0, [TAU, UNIT])


def test_s2_is_refuted_with_a_larger_factor() -> None:
    """Negative control: the least ratio is 36 (delta = 0, f = 1/2), so 40 must fail."""
    with pytest.raises(RefutedError):
        prove(lambda tau, f: (m := loop(tau, f)).a1 ** 2 - 40 * m.a2 * m.a0, [TAU, UNIT])


def _mean_gap(delta: tuple[float, float]) -> arb:
    """(phi2 - psi)/delta = sum (-delta)^k (k + 1)/(k + 3)!, cut with the term that is left out as the bound."""
    x, total, term = -ball(delta), arb(0), arb(1)
    for k in range(30):
        total += term * (k + 1) / math.factorial(k + 3)
        term *= x
    return total + arb(0, term.abs_upper() * 31 / math.factorial(33))


def test_s3_mean_of_the_density_is_below_half() -> None:
    """S3, S4: E s <= 1/2, with equality at delta = 0 only: 1 - 2 E s = delta times a positive factor."""
    prove(_mean_gap, [(0.0, 1.0)])
    # The factor is what it is said to be: at one point against the closed form.
    _, second, third = phi(arb(1) / 2)
    assert _mean_gap((0.5, 0.5)).overlaps(2 * (second - third))
    # From delta = 1 on nothing vanishes; E s is the share a0/phi1 at f = 1.
    prove(lambda tau: 1 - 2 * loop(tau, (1.0, 1.0)).a0, [(TAU[0], 0.5)])


def test_s3_a0_is_at_most_a1() -> None:
    """S3: a1 - a0 = phi1 ((1 - 2 E s) + (1 - f)(2 - 3 E max(1 - s/(1 - f), 0))) >= 0; 0 at delta = 0, f = 1."""
    # The first summand is not negative (the test before this one).
    prove(lambda tau, f: 2 - 3 * early_mean(tau, f) > 0 or (m := loop(tau, f)).a1 - m.a0, [TAU, UNIT])


def test_s3_is_refuted_with_a_smaller_factor() -> None:
    """Negative control: a0 <= 0.99 a1 is false where f is near 1."""
    with pytest.raises(RefutedError):
        prove(lambda tau, f: (m := loop(tau, f)).a1 * 99 - m.a0 * 100, [TAU, UNIT])


def test_s4_a2_exceeds_a0_for_f_up_to_half() -> None:
    """S4: (a2 - a0)/phi1 = (1/2 - f) + (1/2 - E s): an identity; both parts are known not to be negative."""
    rng = random.Random(3)
    for _ in range(100):
        delta, f = _random_device(rng)
        tau = (1 / (1 + delta),) * 2
        m, mean = loop(tau, (f, f)), loop(tau, (1.0, 1.0)).a0
        assert (m.a2 - m.a0).overlaps((arb(1) / 2 - arb(f)) + (arb(1) / 2 - mean))


def test_s4_m_is_not_negative_at_minus_one_for_f_from_half() -> None:
    """S4: a1 >= a2 + a0; it vanishes at delta = 0, f = 1, where the form of S3 with 4 for 3 shows the sign."""
    from_half = [TAU, (0.5, 1.0)]
    prove(lambda tau, f: 2 - 4 * early_mean(tau, f) > 0 or 1 - 2 * ((m := loop(tau, f)).a2 + m.a0), from_half)


def test_s4_is_refuted_for_smaller_f() -> None:
    """Negative control: from f = 0.45 on a1 >= a2 + a0 is false."""
    with pytest.raises(RefutedError):
        prove(lambda tau, f: 1 - 2 * ((m := loop(tau, f)).a2 + m.a0), [TAU, (0.45, 1.0)])


def test_s5_modulus_of_m_does_not_grow() -> None:
    """S5: d|M|^2/dx > 0; over x in [-1, 1] it is least at x = -1, where it is 2 (a1 (a2 + a0) - 4 a2 a0)."""
    prove(lambda tau, f: (m := loop(tau, f)).a1 * (m.a2 + m.a0) - 4 * m.a2 * m.a0, [TAU, UNIT])
    a2, a1, a0, x, y = symbols("a2 a1 a0 x y")
    # |a2 z + a1 + a0/z|^2 with z = x + j y, y^2 = 1 - x^2
    real, imag = (a2 + a0) * x + a1, (a2 - a0) * y
    square = a1**2 + (a2 - a0) ** 2 + 2 * a1 * (a2 + a0) * x + 4 * a2 * a0 * x**2
    assert real**2 + imag**2 - square == (a2 - a0) ** 2 * (x**2 + y**2 - 1)
    assert square.derivative("x") == 2 * a1 * (a2 + a0) + 8 * a2 * a0 * x


def test_s5_argument_of_m() -> None:
    """S5: -w/2 <= arg M <= w, the continuous argument; Im(M e^(jw/2)) = sin(w/2) (a2 (1 + 2x) + a1 - a0)."""
    rng = random.Random(4)
    for _ in range(300):
        delta, f = _random_device(rng)
        w = mpf(rng.uniform(1e-3, 3.141))
        a2, a1, a0 = oracles.numerator(delta, f)
        turned = (a2 * mp.expj(w) + a1 + a0 * mp.expj(-w)) * mp.expj(w / 2)
        assert abs(turned.imag - mp.sin(w / 2) * (a2 * (1 + 2 * mp.cos(w)) + a1 - a0)) < mpf(10) ** -50
        assert -w / 2 - mpf(10) ** -50 <= _arg_m((a2, a1, a0), w) <= w + mpf(10) ** -50


def _arg_m(m: tuple[mpf, mpf, mpf], w: mpf) -> mpf:
    """The argument of M at e^(jw), continuous from 0 at w = 0, from its zeros."""
    a2, a1, a0 = m
    root = mp.sqrt(a1**2 - 4 * a2 * a0)
    return -w + mp.arg(mp.expj(w) + (a1 + root) / (2 * a2)) + mp.arg(mp.expj(w) + 2 * a0 / (a1 + root))


# --- S6 to S8: one crossover --------------------------------------------------------------------------------------


def test_s6_modulus_of_the_loop() -> None:
    """S6: |W|^2 = alpha^2 + 2 beta (alpha + beta) u, |z - c|^2 = (1 - c)^2 + 2 c u, exactly."""
    alpha, beta, u, s, c = symbols("alpha beta u s c")
    circle = s**2 + u**2 - 2 * u  # is 0 on the unit circle
    wall = (alpha + beta * u) ** 2 + (beta * s) ** 2
    assert wall - (alpha**2 + 2 * beta * (alpha + beta) * u) == beta**2 * circle
    assert (1 - u - c) ** 2 + s**2 - ((1 - c) ** 2 + 2 * c * u) == circle


def test_s8_crossover_equation() -> None:
    """S8: |T|^2 - |B|^2 for a whole delay is A u^2 - b u - k with the coefficients of the page, exactly."""
    alpha, beta, u, c, phi1, phi2 = symbols("alpha beta u c phi1 phi2")
    bracket = 2 * beta * (alpha + beta)
    product = 2 * phi2 * (phi1 - phi2)
    device = 2 * u * ((1 - c) ** 2 + 2 * c * u)
    wall = (alpha**2 + bracket * u) * (phi1**2 - product * u)
    square, linear = product * bracket + 4 * c, bracket * phi1**2 - product * alpha**2 - 2 * (1 - c) ** 2
    assert device - wall == square * u**2 - linear * u - alpha**2 * phi1**2


# --- S9 to S15: the phase at the crossover, and the verdict without trigonometry ----------------------------------


class _Wall:
    """A loop at its gain crossover, in 60 digits; ``u`` is None where there is no crossover."""

    def __init__(self, alpha, beta, delta, n: int, f) -> None:
        self.alpha, self.beta, self.delta, self.n = mpf(alpha), mpf(beta), mpf(delta), n
        self.m = oracles.numerator(delta, f)
        self.c = mp.exp(-self.delta)
        self.u = self._crossover()

    def _crossover(self):
        """S8 by bisection: the root of |T|^2 - |B|^2 in (0, 2)."""
        a2, a1, a0 = self.m
        # |M|^2 in powers of u, |W|^2 = wall + bracket u, |T|^2 = device u + 4 c u^2
        m = ((a2 + a1 + a0) ** 2, -2 * a1 * (a2 + a0) - 8 * a2 * a0, 4 * a2 * a0)
        wall, bracket = self.alpha**2, 2 * self.beta * (self.alpha + self.beta)
        device = 2 * mp.expm1(-self.delta) ** 2

        def excess(u):
            return (device + 4 * self.c * u) * u - (wall + bracket * u) * (m[0] + (m[1] + m[2] * u) * u)

        low, high = mpf(0), mpf(2)
        if excess(high) <= 0:
            return None
        for _ in range(190):
            middle = (low + high) / 2
            low, high = (middle, high) if excess(middle) < 0 else (low, middle)
        return low

    def factors(self):
        """W, M, Z of S10 at the crossover and z there."""
        u = self.u
        assert u is not None
        s = mp.sqrt(u * (2 - u))
        a2, a1, a0 = self.m
        z = oracles.complex_number(1 - u, s)
        wall = self.alpha + self.beta * oracles.complex_number(u, s)
        return wall, a2 * z + a1 + a0 / z, oracles.complex_number(s, -mp.expm1(-self.delta) - u), z

    def margin(self):
        """S12: the sum of the three arguments less (n + 1/2) w."""
        wall, _, device, z = self.factors()
        w = mp.arg(z)
        return mp.arg(wall) + _arg_m(self.m, w) + mp.arg(device) - (self.n + mpf(1) / 2) * w

    def by_phase(self) -> bool:
        """Theorem 2."""
        return self.alpha > 0 and self.u is not None and self.margin() > 0

    def by_products(self) -> bool:
        """S14, without its first question, beta > -delta."""
        u = self.u
        if self.alpha <= 0 or u is None or u >= 2 * mp.sin(mp.pi / (2 * (self.n + 1))) ** 2:
            return False
        wall, numerator, device, z = self.factors()
        product = wall * numerator * device
        turn = oracles.complex_number(mp.sqrt(1 - u / 2), mp.sqrt(u / 2)) * z**self.n
        return product.imag > 0 and (product * mp.conj(turn)).imag > 0

    def by_curve(self) -> tuple[bool, bool]:
        """S15a, for n >= 1, with either of its comparisons."""
        if self.alpha <= 0 or self.u is None:
            return False, False
        _, numerator, _, z = self.factors()
        w, turns = mp.arg(z), self.n + 1
        curve = abs(numerator) ** 2 * (z - self.c) / numerator
        first = mp.sin(turns * w) * curve.real + mp.cos(turns * w) * curve.imag
        if (turns - mpf(1) / 2) * w > mp.pi or first <= 0 or (curve.real <= 0 and mp.cos(turns * w) <= 0):
            return False, False
        # alpha + beta (1 - 1/z) = -z^(n+1) (z - 1)(z - c)/(z M) on the curve
        wanted = -(z**self.n) * (z - 1) * (z - self.c) / numerator
        beta = wanted.imag / z.imag
        alpha = wanted.real - beta * self.u
        return self.beta * alpha > self.alpha * beta, self.beta > beta


@lru_cache(maxsize=1)
def _random_walls() -> list[tuple]:
    """Walls near enough to the boundary that many are stable and many are not: (alpha, beta, delta, n, f)."""
    rng, walls = random.Random(5), []
    for _ in range(400):
        delta, f, n = 10 ** rng.uniform(-2, 1.5), rng.random(), rng.choice([0, 0, 1, 2, 5])
        alpha = 10 ** rng.uniform(-2.5, 0.5) * (1 + delta) / (1 + n) ** 2
        beta = rng.uniform(-1.3, 1.3) * delta + rng.uniform(-0.1, 0.5) / (1 + n)
        walls.append((alpha, beta, delta, n, f))
    return walls


def test_theorem_2_against_poles() -> None:
    """S9 to S14: the phase at the crossover, and the products, tell what the poles tell."""
    stable = 0
    for wall in _random_walls():
        alpha, beta, delta, n, f = wall
        found, radius = _Wall(*wall), oracles.exact_radius(alpha, beta, delta, n + mpf(f))
        assert abs(radius - 1) > 1e-9
        assert found.by_phase() == (radius < 1), wall
        assert (wall[1] > -wall[2] and found.by_products()) == (radius < 1), wall
        stable += radius < 1
    assert 80 < stable < 320


def test_s15a_the_curve_tells_what_the_phase_tells() -> None:
    rng, seen = random.Random(7), [0, 0]
    for _ in range(500):
        delta, f, n = 10 ** rng.uniform(-3, 2), rng.choice([0.0, rng.random(), 1 - 1e-9]), rng.choice([1, 1, 2, 3, 9])
        # Stiff and soft walls, also far beyond the lobe and next to beta = -delta.
        alpha = 10 ** rng.uniform(-3, 1) * (1 + delta) / (1 + n)
        beta = rng.choice([-delta * (1 - 10 ** rng.uniform(-9, 0)), rng.uniform(-1.2, 1.2) * delta, rng.uniform(0, 1)])
        found = _Wall(alpha, beta, delta, n, f)
        stable = found.by_phase()
        assert found.by_curve() == (stable, stable), (alpha, beta, delta, n, f)
        seen[stable] += 1
    assert min(seen) > 100


def test_theorem_2_at_its_edge() -> None:
    """Negative control of the comparison: a margin that asks 1 % of a turn more calls stable walls unstable."""
    walls = [_Wall(*wall) for wall in _random_walls()]
    margins = [wall.margin() for wall in walls if wall.by_phase()]
    assert any(margin < 2 * mp.pi / 100 for margin in margins)


def test_s13_cone_of_w() -> None:
    """S13: with beta = -b, 2 b^2 u - |W|^2 = alpha (2 b u - alpha), which is positive for 0 < alpha <= b (2u - 1)."""
    alpha, b, u, rest = symbols("alpha b u rest")
    wall = alpha**2 - 2 * b * (alpha - b) * u
    assert 2 * b**2 * u - wall == alpha * (2 * b * u - alpha)
    # alpha = b (2u - 1) - rest with rest >= 0
    assert 2 * b * u - (b * (2 * u - 1) - rest) == b + rest


def test_s13_phase_sum_at_random_walls() -> None:
    """S13: for beta > -delta the sum of the arguments stays inside (-pi, pi - w/2)."""
    for wall in _random_walls():
        found = _Wall(*wall)
        if wall[1] > -wall[2] and found.u is not None:
            w = mp.arg(found.factors()[3])
            assert -mp.pi < found.margin() + (found.n + mpf(1) / 2) * w < mp.pi - w / 2


def test_s15_products_need_the_first_question() -> None:
    """S15: the wall of the page has beta < -delta, passes every other question of S14 and is unstable."""
    alpha, beta, delta, n, f = 0.9, -4.1, 1.0, 0, 0.9
    assert _Wall(alpha, beta, delta, n, f).by_products()
    assert not _Wall(alpha, beta, delta, n, f).by_phase()
    assert abs(oracles.exact_radius(alpha, beta, delta, n + mpf(f)) - mpf("1.3545034")) < 1e-6


# --- S16 to S18: the stable set is one piece ----------------------------------------------------------------------


def _place(delta, n, f, w, m):
    """S16: the wall whose crossover is w with phase margin m, and theta(w)."""
    a = oracles.numerator(delta, f)
    z, h = mp.expj(w), w / 2
    device = z - mp.exp(-mpf(delta))
    ratio = abs(device) / abs(a[0] * z + a[1] + a[2] / z)
    theta = (n + 1) * w + mp.arg(device) - _arg_m(a, w)
    alpha = 2 * mp.tan(h) * ratio * mp.sin(m + theta)
    return alpha, -ratio * mp.cos(m + theta - h) / mp.cos(h), theta


def test_s16_crossover_and_margin_are_coordinates() -> None:
    """S16: (w, m) -> (alpha, beta) and back; walls with m > 0 and m + theta < pi are stable, by their poles."""
    rng, seen = random.Random(7), 0
    while seen < 80:
        delta, f, n = 10 ** rng.uniform(-2, 1.5), rng.random(), rng.choice([0, 0, 1, 3])
        w = mpf(rng.uniform(0, math.pi / (n + 1)))
        theta = _place(delta, n, f, w, 0)[2]
        assert theta >= (n + 1) * w
        if theta >= mp.pi:
            continue
        seen += 1
        m = rng.uniform(0.01, 0.99) * (mp.pi - theta)
        alpha, beta, _ = _place(delta, n, f, w, m)
        wall = _Wall(alpha, beta, delta, n, f)
        assert abs(wall.margin() - m) < 1e-30
        assert abs(mp.arg(wall.factors()[3]) - w) < 1e-30
        assert oracles.exact_radius(alpha, beta, delta, n + mpf(f)) < 1
        # Beyond the edge m = 0 lies no stable wall.
        alpha, beta, _ = _place(delta, n, f, w, -m * mpf("1e-3"))
        assert alpha <= 0 or oracles.exact_radius(alpha, beta, delta, n + mpf(f)) > 1


def _turning_claim(tau, f, x):
    """S17: |M|^2 (1 - d arg M/dw) over phi1^2."""
    (a2, a1, a0, _), x = loop(tau, f), ball(x)
    return a1**2 + 2 * a0**2 - 2 * a2 * a0 + a1 * (a2 + 3 * a0) * x + 4 * a2 * a0 * x**2


def test_s17_theta_grows_for_one_period_and_more() -> None:
    """S17: d arg M/dw <= 1 where x = cos w is in [0, 1]; with the identity behind the claim."""
    prove(_turning_claim, [TAU, UNIT, UNIT])
    a2, a1, a0, x = symbols("a2 a1 a0 x")
    square = a1**2 + (a2 - a0) ** 2 + 2 * a1 * (a2 + a0) * x + 4 * a2 * a0 * x**2
    turning = (a2 - a0) * (a2 + a0 + a1 * x)
    assert square - turning == a1**2 + 2 * a0**2 - 2 * a2 * a0 + a1 * (a2 + 3 * a0) * x + 4 * a2 * a0 * x**2


def test_s17_fails_beyond_a_quarter_turn() -> None:
    """Negative control: over all x in [-1, 1] the same claim is false."""
    with pytest.raises(RefutedError):
        prove(_turning_claim, [TAU, UNIT, (-1.0, 1.0)])


def test_s17_theta_does_not_return_below_one_period() -> None:
    """S17: where a lobe could reach w = pi (a2 >= a0 and A(-1) >= 0), a1 > (8 + c) a0: A then grows on [-1, 1]."""

    def claim(tau, f):
        a2, a1, a0, c = loop(tau, f)
        return Implication((a2 - a0, a2 - a0 - (2 + c) * (a1 - 2 * a0)), a1 - (8 + c) * a0)

    prove(claim, [TAU, UNIT])


def test_s17_needs_its_premise() -> None:
    """Negative control: without A(-1) >= 0 the conclusion is false."""
    with pytest.raises(RefutedError):
        prove(lambda tau, f: (m := loop(tau, f)).a1 - (8 + m.c) * m.a0, [TAU, UNIT])
