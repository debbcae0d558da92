"""Read a transfer function that is given by coefficients, roots or second-order sections, as values or as text.

The forms have the names of scipy.signal: "tf" is numerator and denominator, and "zpk" is zeros, poles and gain. "sos"
is a list of second-order sections, whose product is the transfer function. Each section is a row of the six
coefficients b0 b1 b2 a0 a1 a2 of ``(b0 + b1/z + b2/z^2)/(a0 + a1/z + a2/z^2)``.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np

from zwidth.core.errors import InputError

TEXTS = "'NUMERATOR / DENOMINATOR', 'zpk: ZEROS / POLES / GAIN' or 'sos: b0 b1 b2 a0 a1 a2; ...'"


def parse_system(field: str, text: str, variable: str) -> dict[str, Any]:
    """Parse a transfer function in one of the forms `TEXTS`; return a dict with keys such as "numerator" or "zeros".

    Args:
        field: path of the parameter, for the error message.
        text: the transfer function; numbers are separated by spaces or commas, complex roots are written 0.9+0.1j.
        variable: "s" or "z", the variable of the coefficients, for the error message.
    """
    form, colon, body = text.partition(":")
    sides = (body if colon else text).split("/")
    try:
        if colon and form.strip() == "sos":
            return {"sos": [list(map(float, _split(row))) for row in body.split(";") if row.strip()]}
        if colon and form.strip() == "zpk":
            zeros, poles, (gain,) = map(_split, sides)
            return {"zeros": read_roots(zeros), "poles": read_roots(poles), "gain": float(gain)}
        numerator, denominator = (list(map(float, _split(side))) for side in sides)
    except ValueError:
        raise InputError(
            f"{field}: got {text!r}; it must be {TEXTS}, coefficients in {variable}, highest power first; "
            f"write {'1 / 0.1 10 0' if variable == 's' else '1000 -1000 / 1 0'!r}"
        ) from None
    return {"numerator": numerator, "denominator": denominator}


def _split(text: str) -> list[str]:
    """Split a text at spaces and commas."""
    return text.replace(",", " ").split()


def read_roots(given: Any) -> np.ndarray:
    """Convert numbers, or texts such as "-3+40j", to an array of complex roots; raise `ValueError` for other values."""
    array = np.ravel(np.array([] if given is None else given))
    if array.dtype.kind == "U":
        array = np.array([complex(root.replace(" ", "")) for root in array])
    return array.astype(complex)


def read_sos(field: str, given: Any) -> np.ndarray:
    """Convert second-order sections to an array of shape (sections, 6); raise `InputError` for any other shape."""
    try:
        rows: Any = np.array(given, float)
    except (TypeError, ValueError):
        rows = np.zeros(0)
    if rows.ndim != 2 or rows.shape[1] != 6 or not rows.size:
        raise InputError(
            f"{field}: got {str(given)[:60]}; it must be rows of six coefficients b0 b1 b2 a0 a1 a2; "
            "use output='sos' of scipy.signal"
        )
    return rows


def pair_roots(roots: Any) -> list[tuple[Fraction, ...]]:
    """Return the monic factors, with exact coefficients, of the polynomial with the given roots.

    A real root has a factor of degree 1, a pair of conjugate roots a factor of degree 2.

    Raises:
        ValueError: a complex root has no conjugate.
    """
    factors: list[tuple[Fraction, ...]] = []
    for root in roots[roots.imag >= 0].tolist():
        real, imag = Fraction(root.real), Fraction(root.imag)
        if root.imag and np.sum(roots == root.conjugate()) != np.sum(roots == root):
            raise ValueError("a root without its conjugate")
        one = Fraction(1)
        factors.append((one, -2 * real, real * real + imag * imag) if root.imag else (one, -real))
    if sum(len(factor) - 1 for factor in factors) != roots.size:
        raise ValueError("a root without its conjugate")
    return factors
