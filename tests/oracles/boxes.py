"""Proof of inequalities over whole boxes: interval subdivision in the balls of python-flint.

`prove` bisects a box until the inequality holds in ball arithmetic on every piece; a piece on which it certainly
fails refutes it. Coordinates of a device, used by all claims about the rigid loop:

- ``tau = 1/(1 + delta)`` from 2^-20 to 1, so that delta in [0, 1048575] is a bounded box;
- ``f`` in [0, 1], the held part of the delay; 0 is a whole delay, and f = 1 the next whole delay.

The coefficients of M(z) = a2 z + a1 + a0/z enter as their shares of phi1 (they sum to 1). A ball of delta would
multiply its own width in each of them. But with the mean E over the density e^(-delta s)/phi1 on [0, 1] (S1 of
docs/theory/one-crossover.md) they are

    a2/phi1 = E max(1 - f - s, 0)      a0/phi1 = E max(s - 1 + f, 0)      psi/phi1 = E s

and each is monotone in delta and f: the derivative of E g in delta is minus the covariance of g and s, which has
one sign where g is monotone. So their exact range over a box is known from its corners.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

from flint import Ordering, arb, ctx, fmpq_mpoly, fmpq_mpoly_ctx

Range = tuple[float, float]
Box = tuple[Range, ...]

# 1/(1 + delta): reaches beyond delta = 1e6.
TAU: Range = (2.0**-20, 1.0)
UNIT: Range = (0.0, 1.0)

# How many times finer than the others a coordinate may be cut.
_UNEVEN = 2.0**40
# Below it a radius counts as this: thin balls do not decide where to bisect.
_TINY = 1e-30

# Bits for the corners: psi loses delta^2, 40 bits at most.
_CORNER_BITS = 160
_SERIES_BELOW = 0.25
# The alternating series of phi1 is cut where its terms are below 0.25^40/41! < 2^-240.
_SERIES_TERMS = 40


class RefutedError(AssertionError):
    """The inequality certainly fails somewhere."""


class UnprovedError(AssertionError):
    """The bound on the number of boxes was reached first."""


class Implication(NamedTuple):
    """The claim that `value` is positive wherever all `premises` are positive or 0."""

    premises: tuple[arb, ...]
    value: arb


Found = arb | bool | Implication
Claim = Callable[..., Found]


def prove(claim: Claim, box: Sequence[Range], *, limit: int = 50_000) -> int:
    """Prove that `claim` is positive all over `box`; return how many pieces it took.

    `claim` takes one range (low, high) per coordinate and returns a ball around the quantity that must be positive,
    an `Implication`, or True where the proof is complete. Pieces are bisected across the coordinate whose halving
    narrows those balls most. Breadth first, so that a failure is met early.
    """
    pending, count = deque([tuple(box)]), 0
    while pending:
        piece = pending.popleft()
        count += 1
        found = claim(*piece)
        if _proved(found):
            continue
        if _refuted(found):
            raise RefutedError(f"refuted on {piece}: {found}")
        if count + len(pending) > limit:
            raise UnprovedError(f"{limit} boxes were not enough; one of the last is {piece}: {found}")
        pending.extend(_halves(piece, _axis(claim, piece, box)))
    return count


def _proved(found: Found) -> bool:
    if isinstance(found, Implication):
        return found.value > 0 or any(premise < 0 for premise in found.premises)
    return found if isinstance(found, bool) else found > 0


def _refuted(found: Found) -> bool:
    if isinstance(found, Implication):
        return found.value <= 0 and all(premise >= 0 for premise in found.premises)
    return not isinstance(found, bool) and found <= 0


def _axis(claim: Claim, piece: Box, box: Sequence[Range]) -> int:
    """The coordinate to bisect: the one that matters most."""
    shares = [(high - low) / (top - bottom) for (low, high), (bottom, top) in zip(piece, box, strict=True)]
    widest = shares.index(max(shares))
    blurs = [_blur(claim(*_halves(piece, axis)[0])) for axis in range(len(piece))]
    best = blurs.index(min(blurs))
    # A coordinate left very wide would hide that it matters at a finer scale.
    return best if shares[best] * _UNEVEN > shares[widest] else widest


def _blur(found: Found) -> float:
    """How wide the balls are: the logarithm of the product of their radii."""
    if isinstance(found, bool):
        return -math.inf
    balls = (found.value, *found.premises) if isinstance(found, Implication) else (found,)
    return sum(math.log(max(float(part.rad()), _TINY)) for part in balls)


def _halves(piece: Box, axis: int) -> tuple[Box, Box]:
    low, high = piece[axis]
    middle = 0.5 * (low + high)
    before, after = piece[:axis], piece[axis + 1 :]
    return (*before, (low, middle), *after), (*before, (middle, high), *after)


def ball(span: Range) -> arb:
    """The smallest ball that holds a range."""
    return arb(span[0]) if span[0] == span[1] else arb(span[0]).union(arb(span[1]))


class Loop(NamedTuple):
    """Balls around the shares a2/phi1, a1/phi1, a0/phi1 and c = e^-delta of all devices of a box."""

    a2: arb
    a1: arb
    a0: arb
    c: arb


@lru_cache(maxsize=4096)
def loop(tau: Range, f: Range) -> Loop:
    """The shares over a box of devices."""
    # a2 falls and a0 grows with f; a2 falls and a0 grows with tau.
    a2 = _corner(tau[0], f[0])[0].union(_corner(tau[1], f[1])[0])
    a0 = _corner(tau[0], f[0])[1].union(_corner(tau[1], f[1])[1])
    return Loop(a2, 1 - a2 - a0, a0, decay(tau))


@lru_cache(maxsize=4096)
def decay(tau: Range) -> arb:
    """c over a range of tau, in which it grows."""
    return (-_delta(tau[0])).exp().union((-_delta(tau[1])).exp())


@lru_cache(maxsize=4096)
def early_mean(tau: Range, f: Range) -> arb:
    """a2/((1 - f) phi1) = E max(1 - s/(1 - f), 0), which falls with f and with tau."""
    return _early_mean(tau[0], f[0]).union(_early_mean(tau[1], f[1]))


def phi(x: arb) -> tuple[arb, arb, arb]:
    """phi1, phi2 and psi of a thin ball x >= 0; below 1/4 as series with a bound on what is cut."""
    if x < _SERIES_BELOW:
        # phi1 = sum (-x)^k/(k + 1)!, phi2 = sum (-x)^k/(k + 2)!: alternating, so what is left out is below its first
        # term.
        first = second = arb(0)
        term = arb(1)
        for k in range(_SERIES_TERMS):
            term = term / (k + 1)
            first += term
            second += term / (k + 2)
            term *= -x
        cut = arb(0, (term.abs_upper()))
        return first + cut, second + cut, first - second + cut
    first = -(-x).expm1() / x
    second = (1 - first) / x
    return first, second, first - second


def _delta(tau: float) -> arb:
    return 1 / arb(tau) - 1


@lru_cache(maxsize=65536)
def _corner(tau: float, f: float) -> tuple[arb, arb]:
    """a2/phi1 and a0/phi1 of one device: e^2 phi2(delta e)/phi1 and c^e f^2 psi(delta f)/phi1 with e = 1 - f."""
    with ctx.workprec(_CORNER_BITS):
        delta, late = _delta(tau), 1 - arb(f)
        whole, early = phi(delta)[0], phi(delta * late)
        a2 = late**2 * early[1] / whole
        a0 = (-delta * late).exp() * arb(f) ** 2 * phi(delta * arb(f))[2] / whole
    return a2, a0


@lru_cache(maxsize=65536)
def _early_mean(tau: float, f: float) -> arb:
    with ctx.workprec(_CORNER_BITS):
        delta, late = _delta(tau), 1 - arb(f)
        return late * phi(delta * late)[1] / phi(delta)[0]


def symbols(names: str) -> tuple[fmpq_mpoly, ...]:
    """Variables of polynomials with rational coefficients, for identities that must hold exactly."""
    return fmpq_mpoly_ctx.get(tuple(names.split()), Ordering.lex).gens()
