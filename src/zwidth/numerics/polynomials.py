"""Polynomials, represented by their coefficients (highest power first), and their companion matrices."""

from __future__ import annotations

from typing import Any, NamedTuple

from zwidth.core.types import Array, Coefficients, Matrices
from zwidth.core.xp import namespace


class Affine(NamedTuple):
    """The characteristic polynomial ``P = D + alpha N1 + beta N2`` of a loop; the wall is (alpha, beta).

    The three coefficient vectors have the same length.
    """

    D: Coefficients
    N1: Coefficients
    N2: Coefficients


def companion(monic: Coefficients) -> Matrices:
    """Return the companion matrices of monic polynomials, whose eigenvalues are the zeros of the polynomials.

    Args:
        monic: coefficients, highest power first, shape (..., degree + 1).

    Returns:
        Matrices of shape (..., degree, degree).
    """
    xp = namespace(monic)
    size = monic.shape[-1] - 1
    shift = xp.broadcast_to(xp.eye(size - 1, size, dtype=monic.dtype), (*monic.shape[:-1], size - 1, size))
    return xp.concatenate([-monic[..., None, 1:], shift], axis=-2)


def abs2(x: Any) -> Array:
    """Return the squared magnitude ``|x|^2`` of real or complex numbers, without a square root."""
    return x.real * x.real + x.imag * x.imag
