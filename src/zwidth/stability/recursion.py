"""The Schur-Cohn recursion without division, on polynomials known by their two ends.

For real P of degree n with p_n > 0, P has all zeros inside the unit circle exactly where |p_0| < p_n and the
polynomial of one degree less

    p'_i = p_n p_(i+1) - p_0 p_(n-1-i)

does too. Its leading coefficient is ``p_n^2 - p_0^2``, so |p_0| < p_n shows as its sign. Dividing by p_n, as textbooks
do, would break XLA's fusion into some n kernels; here sizes are kept in range by exact powers of two instead.

The loop's P has a few coefficients at the top and a few at the bottom, and the recursion keeps that shape: a stage
costs 8 multiplications for whole delays, 13 for others, whatever the degree.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array

# A stage squares the scale: log2 p_n falls by 2^m - 1 times -log2(1 - k^2) in m stages, |p_0| = k p_n. Four stages of
# 1 - k^2 = 2^-53, the closest a float64 |p_0| < p_n comes to 0, stay above 2^-1022; two stages in float32.
STAGES_PER_SCALE = {8: 4, 4: 2}
# Beyond this degree the kernel is a loop over blocks of stages instead of one long expression.
UNROLLED = 112
_BLOCK = 16


class Signed(NamedTuple):
    """A coefficient up to its sign, which is kept apart in Python: a negation would cost as much as a product."""

    sign: int
    number: Array

    @property
    def value(self) -> Array:
        """The coefficient itself."""
        return self.number if self.sign > 0 else -self.number


def _product(left: Signed | None, right: Signed | None) -> Signed | None:
    if left is None or right is None:
        return None
    return Signed(left.sign * right.sign, left.number * right.number)


def _difference(left: Signed | None, right: Signed | None) -> Signed | None:
    if right is None:
        return left
    if left is None:
        return Signed(-right.sign, right.number)
    same = left.sign == right.sign
    return Signed(left.sign, left.number - right.number if same else left.number + right.number)


def _sum(left: Signed | None, right: Signed | None) -> Signed | None:
    return _difference(left, None if right is None else Signed(-right.sign, right.number))


class Ends(NamedTuple):
    """A polynomial by its highest coefficients, downwards, and its lowest, upwards; None, and between them: zero."""

    top: list[Signed | None]
    low: list[Signed | None]
    degree: int

    @property
    def leading(self) -> Array:
        """The leading coefficient."""
        first = self.top[0]
        return jnp.zeros(()) if first is None else first.value

    @property
    def values(self) -> list[Array]:
        """All coefficients of a polynomial whose ends have met, highest power first."""
        return [jnp.zeros(()) if v is None else v.value for v in self.top]

    def joined(self) -> Ends:
        """The full list of coefficients, twice, once the two ends meet."""
        if len(self.top) + len(self.low) <= self.degree + 1:
            return self
        full: list[Signed | None] = [None] * (self.degree + 1)
        for index, value in enumerate(self.top):
            full[index] = value
        if len(self.top) <= self.degree:
            for index, value in enumerate(self.low):
                full[self.degree - index] = _sum(full[self.degree - index], value)
        return Ends(full, full[::-1], self.degree)


def _at(values: list[Signed | None], index: int) -> Signed | None:
    return values[index] if index < len(values) else None


def stage(p: Ends, monic: bool = False) -> Ends:
    """One stage: ``p'_(n-1-j) = a H_j - f L_j`` and ``p'_j = a L_(j+1) - f H_(j+1)`` with a = H_0, f = L_0."""
    a, f = p.top[0], p.low[0]

    def combined(value: Signed | None, other: Signed | None) -> Signed | None:
        return _difference(value if monic else _product(a, value), _product(f, other))

    if len(p.top) > p.degree:
        full = [combined(p.top[j], p.low[j]) for j in range(p.degree)]
        return Ends(full, full[::-1], p.degree - 1)
    count = max(len(p.top), len(p.low))
    top = [combined(_at(p.top, j), _at(p.low, j)) for j in range(count)]
    low = [combined(_at(p.low, j), _at(p.top, j)) for j in range(1, count)]
    return Ends(top, low, p.degree - 1).joined()


def bits(value: Array) -> Array:
    """The bits of a floating-point number as an integer."""
    return jax.lax.bitcast_convert_type(value, jnp.int64 if value.dtype.itemsize == 8 else jnp.int32)


def scaled(p: Ends) -> Ends:
    """Multiply by the power of two that brings the leading coefficient into [1, 2)."""
    wide = p.leading.dtype.itemsize == 8
    mask, twice_bias = (0x7FF << 52, 0x7FE << 52) if wide else (0xFF << 23, 0xFE << 23)
    exponent = bits(p.leading) & mask
    factor = Signed(1, jax.lax.bitcast_convert_type(twice_bias - exponent, p.leading.dtype))
    if len(p.top) > p.degree:
        full = [_product(factor, v) for v in p.top]
        return Ends(full, full[::-1], p.degree)
    return Ends([_product(factor, v) for v in p.top], [_product(factor, v) for v in p.low], p.degree)


class Verdict:
    """The signs of all values that must be positive, gathered in one integer: one operation a stage.

    With a threshold ``doubt`` it also gathers whether any of them was small beside the parts it is the difference of,
    and with ``margin`` the logarithm of the product of all ratios 1 - k^2, by which rounding errors are amplified.
    """

    def __init__(self, doubt: float | None = None, margin: bool = False, gathered: list[Array] | None = None):
        self.doubt, self.margin = doubt, margin
        self.gathered = gathered

    def note(self, value: Array, scale: Array | None) -> None:
        """Take in a value that must be positive: a difference of parts of the size of ``scale`` squared, or 1."""
        here = [bits(value)]
        if self.doubt is not None:
            allowed = self.doubt if scale is None else self.doubt * (scale * scale)
            here.append(bits(jnp.abs(value) - allowed))
        if self.margin:
            here.append(_log2(bits(value) - (_ONE if scale is None else 2 * bits(scale) - _ONE)))
        self._take(here)

    def note_ratio(self, value: Array, parts: Array) -> None:
        """Take in a difference of parts of the size of ``parts``."""
        here = [bits(value)]
        if self.doubt is not None:
            here.append(bits(jnp.abs(value) - self.doubt * parts))
        if self.margin:
            here.append(_log2(bits(value) - bits(parts)))
        self._take(here)

    def _take(self, here: list[Array]) -> None:
        if self.gathered is None:
            self.gathered = here
            return
        last = len(here) - 1
        summed = [
            old + new if self.margin and k == last else old | new
            for k, (old, new) in enumerate(zip(self.gathered, here, strict=True))
        ]
        self.gathered = summed

    @property
    def positive(self) -> Array:
        """No value had its sign bit set; blind to exact zeros and NaN, which later values inherit."""
        assert self.gathered is not None
        return self.gathered[0] >= 0

    @property
    def doubtful(self) -> Array:
        """Some value was small."""
        assert self.gathered is not None
        return self.gathered[1] < 0

    @property
    def small_margin(self) -> Array:
        """The product of all ratios is below `_LEAST_MARGIN`; meaningful where all values were positive, in float64."""
        assert self.gathered is not None
        return self.gathered[-1] < _LEAST_MARGIN


_ONE = 0x3FF << 52
# Rounding errors near 1e-16, amplified by the inverse of the product of all 1 - k^2, stay below 1e-4 of the least one.
_LEAST_MARGIN = -40 << 40


def _log2(difference: Array) -> Array:
    """The bits of a positive number, taken as an integer, are 2^52 log2 of it within 9 %; here in units of 2^-40."""
    return difference >> 12


def follow(p: Ends, verdict: Verdict, monic: bool = False) -> Ends:
    """One stage, whose leading coefficient is noted."""
    after = stage(p, monic)
    verdict.note(after.leading, None if monic else p.leading)
    return after


def reduce_to(p: Ends, verdict: Verdict, degree: int) -> Ends:
    """Follow the recursion from a monic polynomial down to a degree of at least 2."""
    p = follow(p.joined(), verdict, monic=True)
    if p.degree > UNROLLED:
        p = _looped(p, verdict)
    done = 0
    while p.degree > degree:
        if done and done % STAGES_PER_SCALE[p.leading.dtype.itemsize] == 0:
            p = scaled(p)
        p = follow(p, verdict)
        done += 1
    return p


def _looped(p: Ends, verdict: Verdict) -> Ends:
    """Blocks of stages in a loop, while the two ends are apart and keep their lengths."""
    tops, each = len(p.top), _BLOCK
    blocks = (p.degree - tops - len(p.low)) // each
    every = STAGES_PER_SCALE[p.leading.dtype.itemsize]

    def block(_: int, carry: tuple[list[Array], list[Array]]) -> tuple[list[Array], list[Array]]:
        ends: list[Signed | None] = [Signed(1, value) for value in carry[0]]
        # The degree only has to be so large that the ends do not meet inside a block.
        part = Ends(ends[:tops], ends[tops:], 4 * each)
        seen = Verdict(verdict.doubt, verdict.margin, list(carry[1]))
        for done in range(each):
            part = follow(scaled(part) if done % every == 0 else part, seen)
        return [v.value for v in (*part.top, *part.low) if v is not None], seen.gathered or []

    given = [v.value for v in (*p.top, *p.low) if v is not None]
    shape = np.broadcast_shapes(*(value.shape for value in given))
    start = ([jnp.broadcast_to(v, shape) for v in given], [jnp.broadcast_to(g, shape) for g in verdict.gathered or []])
    values, verdict.gathered = jax.lax.fori_loop(0, blocks, block, start)
    ends: list[Signed | None] = [Signed(1, value) for value in values]
    return Ends(ends[:tops], ends[tops:], p.degree - blocks * each)
