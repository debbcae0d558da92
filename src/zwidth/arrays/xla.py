"""What is written the way it is for the compiler's sake (XLA on a processor): each trick, its reason and its gain.

Gains are those of `benchmarks/bench_xla.py`, with and without side by side, on 2 cores with AVX-512 and other work
beside it: times without over times with, to compile and to run. Differences below a tenth are noise.
"""

from __future__ import annotations

from math import factorial
from typing import Any, TypeVar

import numpy as np

from zwidth.arrays.xp import horner, is_jax, namespace
from zwidth.words.types import Array

Values = TypeVar("Values")

# Registers twice as wide as what XLA takes by itself, where the processor has them; without effect elsewhere. Runs 1.2
# times as fast for radii and 1.04 times for verdicts.
WIDE = {"xla_cpu_prefer_vector_width": 512}

# A kernel over a block of points goes through it in pieces of so many, whose intermediates stay next to the processor.
# Runs 1.05 times as fast for verdicts.
STRIP = 1 << 12


def store_once(values: Values, witness: Array) -> Values:
    """``values``, computed once: for a kernel in which many later steps use them.

    XLA repeats a chain of cheap operations in every loop it makes out of the operations behind it, but never a
    division. The divisor here is 1, or NaN where ``witness`` (anything known at run time) is, so that the compiler
    cannot see it. The rigid loop's ridge compiles 1.3 and runs 1.3 to 1.5 times as fast.
    """
    if not is_jax(witness):
        return values
    import jax
    import jax.numpy as jnp

    one = jax.lax.stop_gradient(jnp.where(jnp.isnan(witness), jnp.nan, 1.0))
    return jax.tree.map(lambda value: value / one, values)


def fit_arcsine(terms: int) -> list[float]:
    """``asin(sqrt y)/sqrt y`` on [0, 1/2] as powers of 4 y - 1, by interpolation.

    Right to 2e-16 relative with 19 terms, to 6e-15 with 16.
    """
    node = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    y = 0.25 * (node + 1.0)
    fit = np.polynomial.chebyshev.chebfit(node, np.arcsin(np.sqrt(y)) / np.sqrt(y), terms - 1)
    return np.polynomial.chebyshev.cheb2poly(fit).tolist()


# Polynomials in place of calls, which serve every argument: radii run 2.9 times as fast by the series of the sine, an
# `angle` by itself 2.1 times, and radii 1.06 times by `angle` and `find_turn`, whose compilation takes 0.7 of the time.
ARCSINE = fit_arcsine(19)
# Taylor series of sin(x)/x and cos(x) by x^2; on [0, pi/2] the first term left out is below 1e-17.
SINE = [(-1.0) ** k / factorial(2 * k + 1) for k in range(11)]
COSINE = [(-1.0) ** k / factorial(2 * k) for k in range(12)]


def angle(re: Array, im: Array) -> Array:
    """The argument in (-pi, pi]."""
    xp = namespace(re, im)
    if xp is np:
        return np.arctan2(im, re)
    size = xp.abs(re)
    length = xp.sqrt(re * re + im * im)
    half = 0.5 * im * im / (length * (length + size))
    value = 2.0 * xp.sqrt(half) * horner(4.0 * half - 1.0, ARCSINE)
    value = xp.where(re < 0, np.pi - value, value)
    return xp.where(im < 0, -value, value)


def find_turn(x: Array, y: Array, xp: Any) -> Array:
    """The w of ``x = sin^2(w/2)`` and y = 1 - x."""
    if xp is np:
        return 2.0 * np.arctan2(np.sqrt(x), np.sqrt(y))
    low = xp.minimum(x, y)
    value = 2.0 * xp.sqrt(low) * horner(4.0 * low - 1.0, ARCSINE)
    return xp.where(x > y, np.pi - value, value)
