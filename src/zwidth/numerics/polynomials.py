"""Polynomials by their coefficients (highest power first), their companion matrices, and Aberth's iteration."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

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


def compute_aberth_step(roots: Array, rate: Array) -> Array:
    """Return Aberth's steps for approximations of all roots of a polynomial P, along the last axis.

    The step is Newton's, corrected for the other roots, so that no two approximations converge to the same root.

    Args:
        roots: approximations.
        rate: ``P'/P`` at the approximations.

    Returns:
        The steps, to be subtracted.
    """
    differences = np.where(np.eye(roots.shape[-1], dtype=bool), np.inf, roots[..., :, None] - roots[..., None, :])
    return 1.0 / (rate - (1.0 / differences).sum(-1))
