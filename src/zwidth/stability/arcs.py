"""Angles by square roots and a polynomial, which compiled loops evaluate many at a time."""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth._types import Array
from zwidth.stability.crossover import ARCSINE
from zwidth.xp import horner, namespace


def angle(re: Array, im: Array) -> Array:
    """The argument in (-pi, pi]; four times faster than the compiler's."""
    xp = namespace(re, im)
    if xp is np:
        return np.arctan2(im, re)
    size = xp.abs(re)
    length = xp.sqrt(re * re + im * im)
    half = 0.5 * im * im / (length * (length + size))
    value = 2.0 * xp.sqrt(half) * horner(4.0 * half - 1.0, ARCSINE)
    value = xp.where(re < 0, np.pi - value, value)
    return xp.where(im < 0, -value, value)


def turn_of(x: Array, y: Array, xp: Any) -> Array:
    """The w of ``x = sin^2(w/2)`` and y = 1 - x."""
    if xp is np:
        return 2.0 * np.arctan2(np.sqrt(x), np.sqrt(y))
    low = xp.minimum(x, y)
    value = 2.0 * xp.sqrt(low) * horner(4.0 * low - 1.0, ARCSINE)
    return xp.where(x > y, np.pi - value, value)
