"""Coefficients and roots of the sections of a filter.

Numerator and denominator of a filter are products of *sections*, polynomials in z with the highest power first. Roots
are returned as *offsets* ``1 - root``, which are accurate for roots near z = 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from zwidth.core.errors import InputError

NEXT_TO_ONE = 1e-2  # radius around z = 1 within which rounding errors of the coefficients can move poles


def ball_offsets(coefficients: tuple[Any, ...]) -> np.ndarray:
    """Return the offsets of all roots of a polynomial with exact coefficients, as balls (flint) that contain them."""
    import flint

    exact = flint.fmpq_poly([flint.arb(value).fmpq() for value in reversed(coefficients)])
    roots: Any = exact(flint.fmpq_poly([1, -1])).numer().complex_roots()
    return np.array([flint.acb(root) for root, times in roots for _ in range(times)], object)


def read_sections(name: str, given: Any) -> tuple[tuple[float, ...], ...]:
    """Return the sections of a numerator or denominator, each a tuple of coefficients without leading zeros.

    Args:
        name: path of the parameter for messages, such as "velocity.numerator".
        given: coefficients of one polynomial, or a list of sections with their coefficients.

    Raises:
        InputError: a coefficient is not a finite real number, or all coefficients of a section are 0.
    """
    try:
        rows = list(given) if np.ndim(given) or any(map(np.ndim, given)) else [given]
    except ValueError:
        # `numpy.ndim` raises `ValueError` for a list of sections of different lengths.
        rows = list(given)
    except TypeError:
        rows = [given]
    nested = any(np.ndim(row) for row in rows)
    sections = []
    for row in rows if nested else [rows]:
        try:
            values = np.atleast_1d(np.asarray(row, float))
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{name}: got {given!r}; it must be a list of real coefficients") from error
        values = np.trim_zeros(values, "f") if values.ndim == 1 else values
        if values.ndim != 1 or not values.size or not np.all(np.isfinite(values)):
            raise InputError(
                f"{name}: got {given!r}; it must be a list of finite coefficients, highest power first, not "
                "all of them 0"
            )
        sections.append(tuple(values.tolist()))
    return tuple(sections)


def is_rounding(coefficients: tuple[float, ...]) -> bool:
    """Return whether all roots of a section on or outside the unit circle may be artifacts of rounded coefficients.

    The result is False if there is no such root. If all coefficients have at most 12 decimals, such as those copied
    from a printed table, they are assumed to be rounded to their number of decimals. All other coefficients are assumed
    to be rounded to float64.
    """
    roots = 1.0 - offsets(np.trim_zeros(np.array(coefficients), "b"))
    points = np.exp(1j * np.angle(roots[np.abs(roots) >= 1.0]))
    # If the value at a point of the unit circle is within this bound, a polynomial whose coefficients differ only by
    # rounding errors has a root at this point.
    bound = 4.0 * len(coefficients) * np.finfo(float).eps * np.abs(coefficients).sum()
    bound += 0.5 * len(coefficients) * _find_last_decimal(coefficients)
    return bool(points.size and len(coefficients) > 2 and np.all(np.abs(np.polyval(coefficients, points)) <= bound))


def _find_last_decimal(coefficients: tuple[float, ...]) -> float:
    """Return the unit 10^-k of the last decimal of coefficients with k decimals; 0 if k exceeds 12.

    At least 3 decimals are assumed, because coefficients with fewer decimals are usually exact.
    """
    return next((10.0**-k for k in range(3, 13) if all(round(value, k) == value for value in coefficients)), 0.0)


def count_trailing_zeros(polynomial: np.ndarray) -> int:
    """Return the number of zero coefficients after the last nonzero one, i.e. the multiplicity of the root z = 0."""
    return polynomial.size - int(np.flatnonzero(polynomial)[-1]) - 1


def offsets(polynomial: np.ndarray) -> np.ndarray:
    """Return the offsets of all roots of a polynomial in float64, computed from its coefficients in powers of z - 1."""
    if polynomial.size < 2:
        return np.zeros(0, complex)
    shifted = Polynomial(polynomial[::-1])(Polynomial([1.0, 1.0])).coef
    scale = np.abs(polynomial).sum()
    # Set coefficients of the size of rounding errors to 0, so that roots at z = 1 are exact.
    shifted = np.where(np.abs(shifted) <= 4 * polynomial.size * np.finfo(float).eps * scale, 0.0, shifted)
    return -np.polynomial.polynomial.polyroots(shifted) + 0j
