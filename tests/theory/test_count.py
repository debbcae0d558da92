"""Poles inside any circle: S19 to S22 of docs/theory/one-crossover.md against roots in 60 digits, on random loops.

The count is written here from the page, factor by factor. The roots are those of the expanded polynomial, from
tests/oracles/oracles.py.
"""

from __future__ import annotations

import random
from itertools import pairwise

import mpmath as mp
import pytest
from boxes import symbols
from mpmath import mpc, mpf

import oracles


@pytest.fixture(autouse=True)
def _digits():
    with mp.workdps(60):
        yield


def _count(zeros, poles, gain, lag: int, r):
    """Zeros of z^lag prod(z - poles) + gain prod(z - zeros) inside |z| = r by S19 to S21, and the crossovers."""

    def parts(w):
        z = r * mp.expj(w)
        return z**lag * mp.fprod(z - t for t in poles), gain * mp.fprod(z - b for b in zeros)

    def excess(x):
        """|T|^2 - |B|^2 as a product of the factors of S19."""
        return r ** (2 * lag) * _square(poles, r, x) - gain**2 * _square(zeros, r, x)

    # The coefficients from more points than the degree asks for, then the roots in (0, 1).
    degree = max(len(zeros), len(poles))
    nodes = [mpf(k) / degree for k in range(degree + 1)]
    matrix = mp.matrix([[node**j for j in range(degree + 1)] for node in nodes])
    coefficients = list(mp.lu_solve(matrix, mp.matrix([excess(node) for node in nodes])))[::-1]
    places = oracles.roots(coefficients)
    inside = sorted(root.real for root in places if abs(root.imag) < mpf(10) ** -25 and 0 < root.real < 1)
    crossings = [2 * mp.asin(mp.sqrt(x)) for x in inside]

    def argument(w, factors, start, whole):
        """Continuous from w = 0, factor by factor; a zero on the circle turns it by half a turn, at once."""
        return start + whole * w + mp.fsum(_turn(t, r, w) for t in factors)

    def both(w):
        return argument(w, poles, mpf(0), lag), argument(w, zeros, mpf(0) if gain > 0 else mp.pi, 0)

    edges = [mpf(0), *crossings, mp.pi]
    total, larger = mpf(0), []
    for low, high in pairwise(edges):
        device, wall = parts((low + high) / 2)
        larger.append(abs(device) > abs(wall))
    for before, after, w in zip(larger, larger[1:], crossings, strict=False):
        if before != after:
            device, wall = both(w)
            turns = mp.nint((device - wall) / (2 * mp.pi))
            total += 2 * mp.pi * turns * (1 if before else -1)
    total += both(mp.pi)[0 if larger[-1] else 1] - both(mpf(0))[0 if larger[0] else 1]
    return total / mp.pi, sum(before != after for before, after in pairwise(larger))


def _turn(root, r, w):
    """arg(r e^(jw) - root), continuous in w from its principal value at w = 0."""
    # On the circle itself z - root starts from 0; -root is then the direction that the next line turns.
    start = mp.arg(r - root) if root != r else mp.pi
    z = r * mp.expj(w)
    if abs(root) >= r:
        # z/root - 1 keeps a negative real part: no turn passes unseen.
        return start + mp.arg(1 - z / root) - mp.arg(1 - r / root)
    return start + w + mp.arg(1 - root / z) - mp.arg(1 - root / r)


def _square(roots, r, x):
    """S19: the product of |z - a|^2 in x = sin^2(w/2), for real roots and pairs."""
    total = mpf(1)
    for root in roots:
        if mp.im(root) == 0:
            total *= (r - root.real) ** 2 + 4 * r * root.real * x
        elif mp.im(root) > 0:
            size, real, cosine = abs(root) ** 2, root.real, 1 - 2 * x
            total *= (r**2 + size - 2 * r * real * cosine) ** 2 - 4 * r**2 * root.imag**2 * (1 - cosine**2)
    return total


def test_s19_factor_of_a_pair() -> None:
    """S19: |z - a|^2 |z - conj a|^2 on |z| = r, exactly, with z = r (x + j y)."""
    r, x, y, real, imag = symbols("r x y re im")
    one = (r * x - real) ** 2 + (r * y - imag) ** 2
    two = (r * x - real) ** 2 + (r * y + imag) ** 2
    size = real**2 + imag**2
    stated = (r**2 + size - 2 * r * real * x) ** 2 - 4 * r**2 * imag**2 * (1 - x**2)
    # y^2 = 1 - x^2 removes the rest.
    rest = one * two - stated
    assert rest.subs({"y": 0}).subs({"x": 1}) == 0
    assert _reduced(rest) == 0


def _reduced(polynomial):
    """The polynomial in (r, x, y, re, im) with y^2 replaced by 1 - x^2."""
    r, x, y, real, imag = symbols("r x y re im")
    total = 0 * x
    for (i, j, k, p, q), value in zip(polynomial.monoms(), polynomial.coeffs(), strict=True):
        total += value * r**i * x**j * y ** (k % 2) * (1 - x**2) ** (k // 2) * real**p * imag**q
    return total


def _random_roots(rng: random.Random, count: int) -> list:
    """Real roots and pairs, some beyond the circle."""
    roots = []
    while len(roots) < count:
        if count - len(roots) >= 2 and rng.random() < 0.5:
            root = oracles.complex_number(rng.uniform(-1.2, 1.2), rng.uniform(0.05, 1.2))
            roots += [root, mp.conj(root)]
        else:
            roots.append(oracles.complex_number(rng.uniform(-1.5, 1.5)))
    return roots


def test_s21_count_against_roots() -> None:
    """S19 to S21: random loops of 2 to 5 poles and 4 zeros, gain of either sign, lag 0 to 6, radius 0.3 to 3."""
    rng, crossings = random.Random(8), set()
    for _ in range(150):
        poles, lag = _random_roots(rng, rng.randint(2, 5)), rng.randint(0, 6)
        zeros = _random_roots(rng, rng.randint(0, min(4, len(poles) + lag - 1)))
        gain, r = rng.choice([-1, 1]) * 10 ** mpf(rng.uniform(-2, 1)), 10 ** mpf(rng.uniform(-0.5, 0.5))
        found, crossed = _count(zeros, poles, gain, lag, r)
        high = _product([*poles, *[mpf(0)] * lag])
        low = [gain * value for value in _product(zeros)]
        total = [a + b for a, b in zip(high, [mpf(0)] * (len(high) - len(low)) + low, strict=True)]
        exact = sum(abs(root) < r for root in oracles.roots(total))
        assert abs(found - exact) < 1e-20
        crossings.add(crossed)
    assert {0, 1, 2} <= crossings


def _product(roots) -> list:
    """The monic polynomial of these roots, highest power first."""
    total = [mpf(1)]
    for root in roots:
        shifted = [*total, mpf(0)]
        total = [a - root * b for a, b in zip(shifted, [mpf(0), *total], strict=True)]
    return [mp.re(value) for value in total]


def test_s22_rigid_loop_has_at_most_three_crossovers() -> None:
    """S22: T and B of the rigid loop on any circle: degree 2 in x for whole delays, 3 for held ones."""
    rng = random.Random(9)
    for _ in range(60):
        delta, n, f = 10 ** rng.uniform(-2, 1), rng.randint(0, 4), rng.choice([0.0, rng.random()])
        alpha, beta = 10 ** rng.uniform(-2, 0.5), rng.uniform(-1, 1)
        a2, a1, a0 = oracles.numerator(delta, f)
        s = mp.sqrt(a1**2 - 4 * a2 * a0)
        zeros = [mpc(-(a1 + s) / (2 * a2)), mpc(mpf(beta) / (mpf(alpha) + beta))]
        if f:
            zeros.append(mpc(-2 * a0 / (a1 + s)))
        r = mpf(rng.choice([1, 1, 0.9, 1.1, rng.uniform(0.3, 2)]))
        lag = n + 2 if f else n + 1
        found, crossed = _count(zeros, [mpc(1), mpc(mp.exp(-mpf(delta)))], a2 * (mpf(alpha) + beta), lag, r)
        roots = oracles.roots(oracles.polynomial(alpha, beta, delta, n + mpf(f)))
        assert abs(found - sum(abs(root) < r for root in roots)) < 1e-20
        assert crossed <= (3 if f else 2)
