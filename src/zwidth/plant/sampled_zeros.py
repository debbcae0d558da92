"""Compute the zeros of a linear system after discretization with a delayed zero-order hold, in decimal arithmetic.

The system ``x' = A x + B u`` in controllable canonical form is discretized by a matrix exponential, and the
Faddeev-LeVerrier algorithm computes the numerator of its transfer function (docs/theory/scenes.md, V4 and V22). The
precision is doubled until two successive results agree, because float64 does not resolve slow zeros next to the aliases
of fast poles: for random systems of up to 12 states, eigenvalues in float64 caused relative errors of the response of
up to 5e-9. Zeros are returned as offsets 1 - z.
"""

from __future__ import annotations

from decimal import Context, Decimal, getcontext, localcontext
from fractions import Fraction
from typing import Any

import numpy as np

from zwidth.core.errors import InputError
from zwidth.model.exact_polynomials import DIGITS, EXPONENT, Polynomial, find_simple_roots, shift, trim
from zwidth.model.linear_device import LinearDevice

PRECISION_TOLERANCE = 4e-16  # relative difference of the float64 results of two precisions that counts as agreement
# With n decimal digits, leading coefficients below 10^(-2n/NEGLIGIBLE_DIGITS) of the largest one are regarded as
# rounding errors of 0.
NEGLIGIBLE_DIGITS = 3


def find_sampled_zeros(device: LinearDevice, period: float, fraction: float) -> tuple[float, np.ndarray]:
    """Return the leading coefficient of the sampled numerator, in SI units, and the offsets 1 - z of its zeros.

    Args:
        device: the continuous-time system.
        period: sampling period T in s.
        fraction: fractional part of the delay, in periods.

    Raises:
        InputError: if the results of no two precisions agree.
    """
    previous: tuple[float, np.ndarray] = np.nan, np.zeros(0)
    for digits in DIGITS:
        with localcontext(Context(prec=digits, Emax=EXPONENT, Emin=-EXPONENT)):
            numerator = trim(map(Fraction, _expand_response(device, period, fraction, digits)))
        if not numerator:
            continue
        # One zero is at exactly z = 1 if the system has a zero at s = 0, i.e. no static response to a constant force.
        has_zero_at_one = device.system.numerator[-1] == 0
        offsets = shift(numerator)[:-1] if has_zero_at_one else shift(numerator)
        result = float(numerator[0]), np.array(find_simple_roots(offsets) + [0.0] * has_zero_at_one, complex)
        if _agree(previous, result):
            return result
        previous = result
    raise InputError(
        "device: zeros of the sampled response cannot be computed to float64 accuracy; remove modes of tiny response"
    )


def _agree(one: tuple[float, np.ndarray], other: tuple[float, np.ndarray]) -> bool:
    """Return whether gains and zeros from computations in two precisions differ by at most `PRECISION_TOLERANCE`."""
    (gain, zeros), (gain2, zeros2) = one, other
    if zeros.size != zeros2.size or not abs(gain - gain2) <= PRECISION_TOLERANCE * abs(gain2):
        return False
    nearest = np.abs(zeros - zeros2[:, None]).min(1, initial=np.inf)
    return bool(np.all(nearest <= PRECISION_TOLERANCE * np.abs(zeros2)))


def _expand_response(device: LinearDevice, period: float, fraction: float, digits: int) -> list[Any]:
    """Return the numerator of the sampled response, highest power first, in the precision of the decimal context."""
    denominator, numerator = (_as_decimals(part) for part in (device.system.denominator, device.system.numerator))
    transition, full, output = _discretize(denominator, numerator, Decimal(period))
    response = _expand_numerator(transition, full, output)
    if fraction:
        # In each period, the newer force contributes z N(newer) to the numerator, and the older force N(full - newer).
        # N(x) is the numerator of the response if x is the state at the end of a period with a held unit force; N is
        # linear in x.
        newer = _discretize(denominator, numerator, Decimal(period) * (1 - Decimal(fraction)))[1]
        late = _expand_numerator(transition, newer, output)
        response = [a + b - c for a, b, c in zip([*late, 0], [0, *response], [0, *late], strict=True)]
    largest = max(map(abs, response))
    while response and abs(response[0]) <= largest * Decimal(10) ** (-digits // NEGLIGIBLE_DIGITS * 2):
        response = response[1:]
    return response


def _as_decimals(polynomial: Polynomial) -> list[Decimal]:
    """Return rational coefficients as Decimals, rounded to the precision of the decimal context."""
    return [_as_decimal(value) for value in polynomial]


def _as_decimal(value: Fraction) -> Decimal:
    """Return a rational number as a Decimal, rounded to the precision of the decimal context."""
    return Decimal(value.numerator) / Decimal(value.denominator)


def _discretize(
    denominator: list[Decimal], numerator: list[Decimal], time: Decimal
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the transition matrix, the state after a unit force held for ``time`` from rest, and the output vector."""
    order = len(denominator) - 1
    monic = [value / denominator[0] for value in denominator]
    # Scale time so that all coefficients of the denominator are at most 1.
    sizes = [(abs(value).ln() / k).exp() for k, value in enumerate(monic) if k and value]
    unit = max(sizes, default=Decimal(1))  # independent of ``time``, because responses at two times are combined
    block = np.full((order + 1, order + 1), Decimal(0), object)
    for k in range(order - 1):
        block[k, k + 1] = Decimal(1)
    block[order - 1, :order] = [-monic[order - k] / unit ** (order - k) for k in range(order)]
    block[order - 1, order] = Decimal(1)
    exponential = _exponentiate(block, time * unit)
    # State k is the k-th derivative of the response of 1/denominator(s) to the force, times unit^(order - k).
    padded = [Decimal(0)] * (order - len(numerator)) + numerator
    output = np.array([padded[order - 1 - k] / denominator[0] * unit**k / unit**order for k in range(order)], object)
    return exponential[:order, :order], exponential[:order, order], output


def _exponentiate(matrix: np.ndarray, time: Decimal) -> np.ndarray:
    """Return ``exp(A t)`` by its Taylor series with scaling and squaring."""
    digits = getcontext().prec
    norm = max(sum(map(abs, row)) for row in matrix) * time
    doublings = max(0, int((norm.ln() / Decimal(2).ln()).to_integral_value()) + 4) if norm > 0 else 0
    small = matrix * (time / Decimal(2) ** doublings)
    size = len(matrix)
    identity = np.array([[Decimal(int(i == j)) for j in range(size)] for i in range(size)], object)
    term, total, k = identity, identity, 0
    while k == 0 or max(abs(value) for value in term.ravel()) > Decimal(10) ** (-digits - 5):
        k += 1
        term = term @ small / Decimal(k)
        total = total + term
    for _ in range(doublings):
        total = total @ total
    return total


def _expand_numerator(transition: np.ndarray, state: np.ndarray, output: np.ndarray) -> list[Decimal]:
    """Return the coefficients of ``output adj(zI - transition) state``, highest power first, by Faddeev-LeVerrier."""
    order = len(transition)
    identity = np.array([[Decimal(int(i == j)) for j in range(order)] for i in range(order)], object)
    power, coefficients = identity, []
    for k in range(1, order + 1):
        coefficients.append(output @ power @ state)
        product = transition @ power
        power = product - identity * (np.trace(product) / Decimal(k))
    return coefficients
