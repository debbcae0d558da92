"""Zeros of a linear system ``x' = A x + B u`` after zero-order-hold discretization.

A matrix exponential discretizes the system, and the Faddeev-LeVerrier algorithm computes the numerator of its transfer
function. Both use decimal arithmetic. The precision is doubled until two successive results agree,
because float64 does not resolve slow zeros next to the aliases of fast poles.
"""

from __future__ import annotations

from decimal import Context, Decimal, getcontext, localcontext
from fractions import Fraction
from math import comb
from typing import Any

import numpy as np

from zwidth.parts.exact_polynomials import DIGITS, EXPONENT, Complex, Polynomial, iterate_roots, size
from zwidth.parts.linear_device import LinearDevice
from zwidth.words.errors import InputError

AGREES = 1e-17  # largest relative difference between results of two precisions; a tenth of float64's resolution
# With n decimal digits, leading coefficients below 10^(-2n/NO_TERM) of the largest are rounding errors of 0.
NO_TERM = 3


def find_sampled_zeros(device: LinearDevice, period: float, fraction: float) -> tuple[float, np.ndarray]:
    """Return the leading coefficient of the discretized numerator, in SI units, and ``1 - z`` of its zeros.

    Args:
        device: the continuous-time system.
        period: sampling period T in s.
        fraction: fractional part of the delay, in periods.
    """
    before: tuple[Decimal, list[Any]] | None = None
    for digits in DIGITS:
        with localcontext(Context(prec=digits, Emax=EXPONENT, Emin=-EXPONENT)):
            found = _zeros_at(device, period, fraction, digits)
            if found is not None and before is not None and _agree(before, found):
                return float(found[0]), np.array([complex(*map(float, zero)) for zero in found[1]], complex)
            before = found
    raise InputError(
        "device: zeros of the sampled response cannot be computed to float64 accuracy; remove modes of tiny response"
    )


def _agree(one: tuple[Decimal, list[Any]], other: tuple[Decimal, list[Any]]) -> bool:
    """Return whether gain and zeros of two precisions differ by at most `AGREES`."""
    (gain, zeros), (gain2, zeros2) = one, other
    if len(zeros) != len(zeros2) or abs(gain - gain2) > Decimal(AGREES) * abs(gain2):
        return False
    left = list(zeros)
    for zero in zeros2:
        away = [size(Complex(each.real - zero.real, each.imag - zero.imag)) for each in left]
        nearest = min(range(len(left)), key=away.__getitem__)
        if away[nearest] > Decimal(AGREES) * size(zero):
            return False
        del left[nearest]
    return True


def _zeros_at(device: LinearDevice, period: float, fraction: float, digits: int) -> Any:
    """Return gain and zeros in the context's precision, or None if all coefficients are rounding errors."""
    bottom, top = (_as_decimals(part) for part in (device.system.denominator, device.system.numerator))
    late = 1 - Decimal(fraction)
    step, full, seen = _discretize(bottom, top, Decimal(period))
    if fraction:
        newer = _discretize(bottom, top, Decimal(period) * late)[1]
        parts = [*_numerator(step, newer, seen), Decimal(0)], [Decimal(0), *_numerator(step, full - newer, seen)]
        response = [a + b for a, b in zip(*parts, strict=True)]
    else:
        response = _numerator(step, full, seen)
    largest = max(map(abs, response))
    while response and abs(response[0]) <= largest * Decimal(10) ** (-digits // NO_TERM * 2):
        response = response[1:]
    if not response:
        return None
    # The polynomial in x = 1 - z.
    order = len(response) - 1
    shifted = [
        (-1) ** power * sum(response[order - k] * comb(k, power) for k in range(power, order + 1))
        for power in range(order, -1, -1)
    ]
    # A zero at s = 0 (no static response to a constant force) becomes a zero at exactly z = 1.
    still = device.system.numerator[-1] == 0
    if still:
        shifted = shifted[:-1]
    zeros, _ = iterate_roots(shifted) if len(shifted) > 1 else ([], [])
    # Make conjugate pairs exact, and drop imaginary parts that are rounding errors.
    real = Decimal(10) ** (-digits // 3)
    pairs = [zero for zero in zeros if zero.imag > real * size(zero)]
    flat = [Complex(zero.real, Decimal(0)) for zero in zeros if abs(zero.imag) <= real * size(zero)]
    found = [*pairs, *(Complex(zero.real, -zero.imag) for zero in pairs), *flat]
    if still:
        found.append(Complex(Decimal(0), Decimal(0)))
    return response[0], found


def _as_decimals(polynomial: Polynomial) -> list[Decimal]:
    return [_as_decimal(value) for value in polynomial]


def _as_decimal(value: Fraction) -> Decimal:
    return Decimal(value.numerator) / Decimal(value.denominator)


def _discretize(bottom: list[Decimal], top: list[Decimal], time: Decimal) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the transition matrix, the state after a unit force held for ``time``, and the row of the output."""
    order = len(bottom) - 1
    monic = [value / bottom[0] for value in bottom]
    # Scale time so that all coefficients of the denominator are at most 1.
    sizes = [(abs(value).ln() / k).exp() for k, value in enumerate(monic) if k and value]
    unit = max(sizes, default=Decimal(1))  # must not depend on ``time``, because responses of two times are combined
    block = np.full((order + 1, order + 1), Decimal(0), object)
    for k in range(order - 1):
        block[k, k + 1] = Decimal(1)
    block[order - 1, :order] = [-monic[order - k] / unit ** (order - k) for k in range(order)]
    block[order - 1, order] = Decimal(1)
    whole = _exponential(block, time * unit)
    # State x_k: the k-th derivative of the response of 1/denominator, times unit^(order - k).
    padded = [Decimal(0)] * (order - len(top)) + top
    seen = np.array([padded[order - 1 - k] / bottom[0] * unit**k / unit**order for k in range(order)], object)
    return whole[:order, :order], whole[:order, order], seen


def _exponential(matrix: np.ndarray, time: Decimal) -> np.ndarray:
    """Return ``exp(A t)`` by its Taylor series with scaling and squaring."""
    digits = getcontext().prec
    norm = max(sum(map(abs, row)) for row in matrix) * time
    halvings = max(0, int((norm.ln() / Decimal(2).ln()).to_integral_value()) + 4) if norm > 0 else 0
    small = matrix * (time / Decimal(2) ** halvings)
    size = len(matrix)
    one = np.array([[Decimal(int(i == j)) for j in range(size)] for i in range(size)], object)
    term, total, k = one, one, 0
    while k == 0 or max(abs(value) for value in term.ravel()) > Decimal(10) ** (-digits - 5):
        k += 1
        term = term @ small / Decimal(k)
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def _numerator(step: np.ndarray, push: np.ndarray, seen: np.ndarray) -> list[Decimal]:
    """Return the coefficients of ``seen adj(zI - step) push``, highest power first, by Faddeev-LeVerrier."""
    order = len(step)
    one = np.array([[Decimal(int(i == j)) for j in range(order)] for i in range(order)], object)
    power, found = one, []
    for k in range(1, order + 1):
        found.append(seen @ power @ push)
        product = step @ power
        power = product - one * (np.trace(product) / Decimal(k))
    return found
