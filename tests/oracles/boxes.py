"""Proof of inequalities over boxes of parameters: subdivision in the ball arithmetic of python-flint.

`prove` bisects a box until the inequality holds in ball arithmetic on every part; a part on which it provably
fails refutes it. Coordinates of a device in all claims about the rigid loop:

- ``tau = 1/(1 + delta)`` from 2^-20 to 1, so that delta in [0, 1048575] is a bounded box;
- ``f`` in [0, 1], the fractional delay; f = 0 is an integer delay, f = 1 the next one.

The coefficients of M(z) = a2 z + a1 + a0/z are used relative to phi1, so that they sum to 1. Evaluating them at
a ball of delta would multiply its radius in each of them. Instead, with the mean E over the density e^(-delta
s)/phi1 on [0, 1] (S1 of docs/theory/one-crossover.md), they are

    a2/phi1 = E max(1 - f - s, 0)      a0/phi1 = E max(s - 1 + f, 0)      psi/phi1 = E s

and each is monotone in delta and f: the derivative of E g by delta is minus the covariance of g and s, whose
sign is constant if g is monotone. Their exact range over a box therefore follows from its corners.
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

TAU: Range = (2.0**-20, 1.0)  # 1/(1 + delta), for delta up to 1e6
UNIT: Range = (0.0, 1.0)

_UNEVEN = 2.0**40  # largest ratio of subdivisions between two coordinates
_TINY = 1e-30  # smallest radius of a ball in the choice of the coordinate to bisect

_CORNER_BITS = 160  # psi loses delta^2, at most 40 bits
_SERIES_BELOW = 0.25
_SERIES_TERMS = 40  # the omitted terms of the alternating series are below 0.25^40/41! < 2^-240


class RefutedError(AssertionError):
    """The inequality provably fails somewhere."""


class UnprovedError(AssertionError):
    """The limit on the number of boxes was reached."""


class Implication(NamedTuple):
    """The claim that `value` is positive wherever all `premises` are nonnegative."""

    premises: tuple[arb, ...]
    value: arb


Evidence = arb | bool | Implication
Claim = Callable[..., Evidence]


def prove(claim: Claim, box: Sequence[Range], *, limit: int = 50_000) -> int:
    """Prove that `claim` is positive on all of `box`; return the number of parts.

    `claim` takes one range (low, high) per coordinate and returns a ball that contains the quantity to be
    positive, an `Implication`, or True if the proof is complete. Parts are bisected in the coordinate that
    narrows these balls most, breadth first, so that a failure is found early.
    """
    pending, count = deque([tuple(box)]), 0
    while pending:
        piece = pending.popleft()
        count += 1
        evidence = claim(*piece)
        if _is_proved(evidence):
            continue
        if _is_refuted(evidence):
            raise RefutedError(f"refuted on {piece}: {evidence}")
        if count + len(pending) > limit:
            raise UnprovedError(f"{limit} boxes were not enough; one of the last is {piece}: {evidence}")
        pending.extend(_halves(piece, _axis(claim, piece, box)))
    return count


def _is_proved(evidence: Evidence) -> bool:
    if isinstance(evidence, Implication):
        return evidence.value > 0 or any(premise < 0 for premise in evidence.premises)
    return evidence if isinstance(evidence, bool) else evidence > 0


def _is_refuted(evidence: Evidence) -> bool:
    if isinstance(evidence, Implication):
        return evidence.value <= 0 and all(premise >= 0 for premise in evidence.premises)
    return not isinstance(evidence, bool) and evidence <= 0


def _axis(claim: Claim, piece: Box, box: Sequence[Range]) -> int:
    """Return the coordinate to bisect, the one with the largest effect."""
    ratios = [(high - low) / (top - bottom) for (low, high), (bottom, top) in zip(piece, box, strict=True)]
    widest = ratios.index(max(ratios))
    widths = [_log_width(claim(*_halves(piece, axis)[0])) for axis in range(len(piece))]
    best = widths.index(min(widths))
    # The effect of a coordinate left very wide may be visible at a finer scale only.
    return best if ratios[best] * _UNEVEN > ratios[widest] else widest


def _log_width(evidence: Evidence) -> float:
    """Return the logarithm of the product of the radii of the balls."""
    if isinstance(evidence, bool):
        return -math.inf
    balls = (evidence.value, *evidence.premises) if isinstance(evidence, Implication) else (evidence,)
    return sum(math.log(max(float(part.rad()), _TINY)) for part in balls)


def _halves(piece: Box, axis: int) -> tuple[Box, Box]:
    low, high = piece[axis]
    middle = 0.5 * (low + high)
    before, after = piece[:axis], piece[axis + 1 :]
    return (*before, (low, middle), *after), (*before, (middle, high), *after)


def ball(span: Range) -> arb:
    """Return the smallest ball that contains a range."""
    return arb(span[0]) if span[0] == span[1] else arb(span[0]).union(arb(span[1]))


class Loop(NamedTuple):
    """Balls of a2/phi1, a1/phi1, a0/phi1 and c = e^-delta over all devices of a box."""

    a2: arb
    a1: arb
    a0: arb
    c: arb


@lru_cache(maxsize=4096)
def loop(tau: Range, f: Range) -> Loop:
    """Return the coefficients over a box of devices."""
    # a2 decreases and a0 increases with f; a2 decreases and a0 increases with tau.
    a2 = _corner(tau[0], f[0])[0].union(_corner(tau[1], f[1])[0])
    a0 = _corner(tau[0], f[0])[1].union(_corner(tau[1], f[1])[1])
    return Loop(a2, 1 - a2 - a0, a0, decay(tau))


@lru_cache(maxsize=4096)
def decay(tau: Range) -> arb:
    """Return c over a range of tau, in which it increases."""
    return (-_delta(tau[0])).exp().union((-_delta(tau[1])).exp())


@lru_cache(maxsize=4096)
def early_mean(tau: Range, f: Range) -> arb:
    """Return a2/((1 - f) phi1) = E max(1 - s/(1 - f), 0), which decreases with f and tau."""
    return _early_mean(tau[0], f[0]).union(_early_mean(tau[1], f[1]))


def phi(x: arb) -> tuple[arb, arb, arb]:
    """Return phi1, phi2 and psi of a thin ball x >= 0; below 1/4 by series with a bound on the omitted terms."""
    if x < _SERIES_BELOW:
        # phi1 = sum (-x)^k/(k + 1)!, phi2 = sum (-x)^k/(k + 2)!: alternating, so the remainder is below its first term.
        first = second = arb(0)
        term = arb(1)
        for k in range(_SERIES_TERMS):
            term = term / (k + 1)
            first += term
            second += term / (k + 2)
            term *= -x
        remainder = arb(0, (term.abs_upper()))
        return first + remainder, second + remainder, first - second + remainder
    first = -(-x).expm1() / x
    second = (1 - first) / x
    return first, second, first - second


def _delta(tau: float) -> arb:
    return 1 / arb(tau) - 1


@lru_cache(maxsize=65536)
def _corner(tau: float, f: float) -> tuple[arb, arb]:
    """Return a2/phi1 and a0/phi1 of one device: e^2 phi2(delta e)/phi1 and c^e f^2 psi(delta f)/phi1 with e = 1 - f."""
    with ctx.workprec(_CORNER_BITS):
        delta, late = _delta(tau), 1 - arb(f)
        phi1_full, early = phi(delta)[0], phi(delta * late)
        a2 = late**2 * early[1] / phi1_full
        a0 = (-delta * late).exp() * arb(f) ** 2 * phi(delta * arb(f))[2] / phi1_full
    return a2, a0


@lru_cache(maxsize=65536)
def _early_mean(tau: float, f: float) -> arb:
    with ctx.workprec(_CORNER_BITS):
        delta, late = _delta(tau), 1 - arb(f)
        return late * phi(delta * late)[1] / phi(delta)[0]


def symbols(names: str) -> tuple[fmpq_mpoly, ...]:
    """Return variables of polynomials with rational coefficients, for identities that must hold exactly."""
    return fmpq_mpoly_ctx.get(tuple(names.split()), Ordering.lex).gens()
