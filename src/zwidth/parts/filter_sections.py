"""Sections of a velocity filter: reading their coefficients, and computing their roots."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from zwidth.words.errors import InputError

NEXT_TO_ONE = 1e-2  # largest distance from z = 1 of poles that rounding errors of the coefficients can move there


def ball_offsets(coefficients: tuple[Any, ...]) -> np.ndarray:
    """Return 1 - root for the roots of a polynomial with exact coefficients, as balls."""
    import flint

    exact = flint.fmpq_poly([flint.arb(value).fmpq() for value in reversed(coefficients)])
    found: Any = exact(flint.fmpq_poly([1, -1])).numer().complex_roots()
    return np.array([flint.acb(root) for root, times in found for _ in range(times)], object)


def read_sections(name: str, given: Any) -> tuple[tuple[float, ...], ...]:
    """Return the coefficients of the sections without leading zeros; raise `InputError` for other values.

    Args:
        name: "numerator" or "denominator", for messages.
        given: coefficients of one polynomial, or a list of sections with their coefficients.
    """
    try:
        rows = list(given) if np.ndim(given) or any(map(np.ndim, given)) else [given]
    except ValueError:
        # NumPy raises this error for sections of different lengths.
        rows = list(given)
    except TypeError:
        rows = [given]
    nested = any(np.ndim(row) for row in rows)
    sections = []
    for row in rows if nested else [rows]:
        try:
            values = np.atleast_1d(np.asarray(row, float))
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"velocity.{name}: got {given!r}; it must be a list of real coefficients") from error
        values = np.trim_zeros(values, "f") if values.ndim == 1 else values
        if values.ndim != 1 or not values.size or not np.all(np.isfinite(values)):
            raise InputError(
                f"velocity.{name}: got {given!r}; it must be a list of finite coefficients, highest power first, not "
                "all 0"
            )
        sections.append(tuple(values.tolist()))
    return tuple(sections)


def is_rounding(coefficients: tuple[float, ...]) -> bool:
    """Return whether rounding errors of the coefficients alone can explain the roots on or outside the unit circle."""
    roots = 1.0 - offsets(np.trim_zeros(np.array(coefficients), "b"))
    on = np.exp(1j * np.angle(roots[np.abs(roots) >= 1.0]))
    # If the polynomial is this small at a point of the circle, another one whose coefficients differ only by rounding
    # errors has a root exactly there.
    noise = 4.0 * len(coefficients) * np.finfo(float).eps * np.abs(coefficients).sum()
    return bool(on.size and len(coefficients) > 2 and np.all(np.abs(np.polyval(coefficients, on)) <= noise))


def count_trailing_zeros(polynomial: np.ndarray) -> int:
    """Return the number of zero coefficients after the last nonzero one."""
    return polynomial.size - int(np.flatnonzero(polynomial)[-1]) - 1


def offsets(polynomial: np.ndarray) -> np.ndarray:
    """Return 1 - root for all roots, computed in powers of z - 1, because roots near 1 then keep their digits."""
    if polynomial.size < 2:
        return np.zeros(0, complex)
    shifted = Polynomial(polynomial[::-1])(Polynomial([1.0, 1.0])).coef
    scale = np.abs(polynomial).sum()
    shifted = np.where(np.abs(shifted) <= 4 * polynomial.size * np.finfo(float).eps * scale, 0.0, shifted)
    return -np.polynomial.polynomial.polyroots(shifted) + 0j
