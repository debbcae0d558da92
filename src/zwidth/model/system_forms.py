"""Forms in which a transfer function is given: coefficients, roots and second-order sections, as values or as text.

The forms have the names of scipy.signal: "tf" is numerator and denominator, "zpk" zeros, poles and gain, and "sos" a
list of second-order sections, each a row of the six coefficients b0 b1 b2 a0 a1 a2 of
``(b0 + b1/z + b2/z^2)/(a0 + a1/z + a2/z^2)``. The transfer function of the list is the product of its sections.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np

from zwidth.core.errors import InputError

TEXTS = "'NUMERATOR / DENOMINATOR', 'zpk: ZEROS / POLES / GAIN' or 'sos: b0 b1 b2 a0 a1 a2; ...'"


def parse_system(field: str, text: str, variable: str) -> dict[str, Any]:
    """Return the values of a transfer function in one of the forms `TEXTS`, as a dict by the names of its keys.

    Args:
        field: path of the parameter, for the message.
        text: the transfer function; numbers are separated by spaces or commas, complex roots are written 0.9+0.1j.
        variable: "s" or "z", the variable of the coefficients, for the message.
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
    """Return the words of a text, which are separated by spaces or commas."""
    return text.replace(",", " ").split()


def read_roots(given: Any) -> np.ndarray:
    """Return roots as complex numbers, from numbers or texts such as "-3+40j"; raise `ValueError` for other values."""
    array = np.ravel(np.array([] if given is None else given))
    if array.dtype.kind == "U":
        array = np.array([complex(root.replace(" ", "")) for root in array])
    return array.astype(complex)


def read_sos(field: str, given: Any) -> np.ndarray:
    """Return second-order sections as an array of shape (sections, 6); raise `InputError` for other shapes."""
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
    """Return monic factors with exact coefficients: one of degree 1 per real root, one of degree 2 per conjugate pair.

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
