"""Polynomials by their coefficients, the highest power first: affine in two numbers, and their companion matrices."""

from __future__ import annotations

from typing import Any, NamedTuple

from zwidth.words.types import Array, Coefficients, Matrices
from zwidth.words.xp import namespace


class Affine(NamedTuple):
    """``P = D + alpha N1 + beta N2``: three coefficient vectors of one length, highest power first."""

    D: Coefficients
    N1: Coefficients
    N2: Coefficients


def companion(monic: Coefficients) -> Matrices:
    """The companion matrices whose eigenvalues are the zeros of monic polynomials, highest power first."""
    xp = namespace(monic)
    size = monic.shape[-1] - 1
    below = xp.broadcast_to(xp.eye(size - 1, size, dtype=monic.dtype), (*monic.shape[:-1], size - 1, size))
    return xp.concatenate([-monic[..., None, 1:], below], axis=-2)


def square(x: Any) -> Array:
    """``|x|^2``."""
    return x.real * x.real + x.imag * x.imag
