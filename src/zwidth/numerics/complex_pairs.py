"""Complex arrays as pairs of real arrays, because XLA (the compiler of JAX) compiles real arrays to faster loops."""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import namespace
from zwidth.numerics.polynomials import abs2


class Pair:
    """A complex array as a pair of real arrays, which XLA compiles to faster loops than complex arrays."""

    __slots__ = ("imag", "real")

    def __init__(self, real: Array, imag: Array) -> None:
        self.real, self.imag = real, imag

    def __add__(self, other: Any) -> Pair:
        if isinstance(other, Pair):
            return Pair(self.real + other.real, self.imag + other.imag)
        return Pair(self.real + other, self.imag)

    def __mul__(self, other: Any) -> Pair:
        if isinstance(other, Pair):
            real = self.real * other.real - self.imag * other.imag
            return Pair(real, self.real * other.imag + self.imag * other.real)
        return Pair(self.real * other, self.imag * other)

    def over(self, other: Pair) -> Pair:
        """Return this complex array divided by ``other``."""
        size = abs2(other)
        real = (self.real * other.real + self.imag * other.imag) / size
        return Pair(real, (self.imag * other.real - self.real * other.imag) / size)

    def conjugate(self) -> Pair:
        """Return the complex conjugate."""
        return Pair(self.real, -self.imag)


def make_complex(re: Array, im: Array) -> Array:
    """Return the complex array re + j im."""
    # For JAX, call `jax.lax.complex`: XLA then computes both parts in a single loop. For two separate real arrays, XLA
    # would use two loops and repeat the operations that both parts share.
    if namespace(re) is not np:
        from jax.lax import complex as make_complex

        return make_complex(re, im)
    value = np.empty(np.broadcast_shapes(re.shape, im.shape), complex)
    value.real, value.imag = re, im
    return value
