"""Arithmetic with values and their first and second derivatives, in NumPy: exact derivatives without compilation.

A `Taylor` is an array v with its derivatives in m variables: ``first`` has shape (..., m) and ``second`` (..., m, m).
Sums, products and functions of Taylor objects follow from the chain rule (forward mode; Griewank, Walther 2008,
Evaluating Derivatives, chapter 13). Formulas that are written for numbers, such as the transfer functions of parts,
also accept zero-dimensional Taylor objects and NumPy arrays of such objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

SERIES_TERMS = 18  # terms of the series of e^M for matrices of norm <= 1/2; the first omitted term is below 1e-21


class Taylor:
    """An array with its derivatives; ``second`` is None if only first derivatives are computed."""

    __slots__ = ("first", "second", "v")

    def __init__(self, v: Any, first: Any, second: Any = None) -> None:
        self.v = v
        self.first = first
        self.second = second

    def chain(self, v: Any, slope: Any, curvature: Any) -> Taylor:
        """Apply an elementwise function f, given its value, first and second derivative at v."""
        slope, curvature = np.asarray(slope)[..., None], np.asarray(curvature)[..., None, None]
        if self.second is None:
            return Taylor(v, slope * self.first)
        square = self.first[..., :, None] * self.first[..., None, :]
        return Taylor(v, slope * self.first, slope[..., None] * self.second + curvature * square)

    def map(self, function: Any) -> Taylor:
        """Apply a function that is linear over the real numbers, such as the real part or a slice."""
        second = None if self.second is None else function(self.second)
        return Taylor(function(self.v), function(self.first), second)

    def __add__(self, other: Any) -> Any:
        if isinstance(other, Taylor):
            second = None if self.second is None else self.second + other.second
            return Taylor(self.v + other.v, self.first + other.first, second)
        return NotImplemented if np.ndim(other) else Taylor(self.v + other, self.first, self.second)

    def __mul__(self, other: Any) -> Any:
        if not isinstance(other, Taylor):
            return NotImplemented if np.ndim(other) else self.map(lambda part: part * other)
        a, b = np.asarray(self.v)[..., None], np.asarray(other.v)[..., None]
        second = None
        if self.second is not None:
            mixed = self.first[..., :, None] * other.first[..., None, :]
            second = a[..., None] * other.second + b[..., None] * self.second + mixed + mixed.swapaxes(-1, -2)
        return Taylor(self.v * other.v, a * other.first + b * self.first, second)

    def __truediv__(self, other: Any) -> Any:
        if isinstance(other, Taylor):
            return self * other.reciprocal()
        return NotImplemented if np.ndim(other) else self * (1.0 / other)

    def __rtruediv__(self, other: Any) -> Any:
        return NotImplemented if np.ndim(other) else self.reciprocal() * other

    def __pow__(self, power: int) -> Taylor:
        return self.chain(self.v**power, power * self.v ** (power - 1), power * (power - 1) * self.v ** (power - 2))

    def __neg__(self) -> Taylor:
        return self * -1.0

    def __sub__(self, other: Any) -> Any:
        return NotImplemented if np.ndim(other) else self + -other

    def __rsub__(self, other: Any) -> Any:
        return NotImplemented if np.ndim(other) else -self + other

    __radd__, __rmul__ = __add__, __mul__

    def __getitem__(self, index: Any) -> Taylor:
        return self.map(lambda part: part[index])

    # Compare the values only; derivatives are ignored.
    def __lt__(self, other: Any) -> bool:
        return bool(self.v < getattr(other, "v", other))

    def __gt__(self, other: Any) -> bool:
        return bool(self.v > getattr(other, "v", other))

    def __le__(self, other: Any) -> bool:
        return not self > other

    def __ge__(self, other: Any) -> bool:
        return not self < other

    def reciprocal(self) -> Taylor:
        """Return the reciprocal."""
        inverse = 1.0 / self.v
        return self.chain(inverse, -(inverse**2), 2.0 * inverse**3)

    # For objects, NumPy functions call the method of the same name: np.exp(x) calls x.exp().
    def exp(self) -> Taylor:
        """Return the exponential."""
        v = np.exp(self.v)
        return self.chain(v, v, v)

    def expm1(self) -> Taylor:
        """Return the exponential minus 1."""
        v = np.exp(self.v)
        return self.chain(np.expm1(self.v), v, v)

    def tan(self) -> Taylor:
        """Return the tangent."""
        v = np.tan(self.v)
        return self.chain(v, 1.0 + v * v, 2.0 * v * (1.0 + v * v))

    def sin(self) -> Taylor:
        """Return the sine."""
        v = np.sin(self.v)
        return self.chain(v, np.cos(self.v), -v)

    def sqrt(self) -> Taylor:
        """Return the square root."""
        v = np.sqrt(self.v)
        return self.chain(v, 0.5 / v, -0.25 / v**3)

    def conjugate(self) -> Taylor:
        """Return the complex conjugate; the variables of the derivatives are real."""
        return self.map(np.conj)

    @property
    def real(self) -> Taylor:
        """The real part; the variables of the derivatives are real."""
        return self.map(np.real)

    @property
    def imag(self) -> Taylor:
        """The imaginary part; the variables of the derivatives are real."""
        return self.map(np.imag)


def seed(values: Sequence[float], order: int) -> list[Taylor]:
    """Return independent variables with given values, as Taylor objects with derivatives up to ``order``, 1 or 2."""
    count = len(values)
    units = np.eye(count)
    return [
        Taylor(np.float64(v), units[k], np.zeros((count, count)) if order > 1 else None) for k, v in enumerate(values)
    ]


def stack(entries: Any, like: Taylor) -> Taylor:
    """Combine numbers and scalar Taylor objects into one Taylor array; ``like`` is any Taylor of these variables."""
    objects = np.asarray(entries, object)
    zero = like * 0.0
    parts = [each if isinstance(each, Taylor) else zero + each for each in objects.ravel()]
    second = None
    if like.second is not None:
        second = np.array([part.second for part in parts]).reshape(*objects.shape, *like.second.shape)
    v, first = np.array([part.v for part in parts]), np.array([part.first for part in parts])
    return Taylor(v.reshape(objects.shape), first.reshape(*objects.shape, *like.first.shape), second)


def multiply(a: Taylor, b: Taylor) -> Taylor:
    """Return the product of two matrices, with derivatives."""
    first = np.tensordot(a.v, b.first, (1, 0)) + np.tensordot(a.first, b.v, (1, 0)).swapaxes(1, 2)
    second = None
    if a.second is not None:
        mixed = np.tensordot(a.first, b.first, (1, 0)).transpose(0, 2, 1, 3)
        second = np.tensordot(a.v, b.second, (1, 0)) + np.moveaxis(np.tensordot(a.second, b.v, (1, 0)), 3, 1)
        second = second + mixed + mixed.swapaxes(-1, -2)
    return Taylor(a.v @ b.v, first, second)


def solve(matrix: Taylor, right: Taylor) -> Taylor:
    """Return the solution x of ``matrix x = right`` for a vector ``right``, with derivatives."""
    inverse = np.linalg.inv(matrix.v)
    v = inverse @ right.v
    first = np.tensordot(inverse, right.first - np.einsum("ijm,j->im", matrix.first, v), 1)
    second = None
    if matrix.second is not None:
        mixed = np.einsum("ijm,jn->imn", matrix.first, first)
        rest = right.second - np.einsum("ijmn,j->imn", matrix.second, v) - mixed - mixed.swapaxes(-1, -2)
        second = np.tensordot(inverse, rest, 1)
    return Taylor(v, first, second)


def flow(A: Taylor, B: Taylor, time: Taylor) -> tuple[Taylor, Taylor]:
    """Return ``e^(A t) - 1`` and x(t) for ``x' = A x + B u`` with x(0) = 0 and the constant input u = 1."""
    # Sum the series for a short time, then double the time repeatedly, as in `plant.transition.compute_transition`.
    size = len(A.v)
    norm = float(np.abs(A.v * time.v).sum(0).max())
    doublings = int(np.ceil(np.log2(max(2.0 * norm, 1.0))))
    step = time / 2.0**doublings
    small, zero = A * _expand(step, 2), A * 0.0
    identity = Taylor(np.eye(size), zero.first, zero.second)
    total = identity
    for k in range(SERIES_TERMS, 1, -1):
        total = identity + multiply(small, total) / k
    column = (B * _expand(step, 1)).map(lambda part: part[:, None])
    both = multiply(total, _join(small, column))
    for _ in range(doublings):
        both = both * 2.0 + multiply(both[:, :-1], both)
    return both[:, :-1], both[:, -1]


def _expand(x: Taylor, axes: int) -> Taylor:
    """Return a zero-dimensional Taylor, reshaped to the given number of axes of length 1."""
    return x.map(lambda part: np.asarray(part)[(None,) * axes])


def _join(a: Taylor, b: Taylor) -> Taylor:
    """Return the block matrix [a, b], with derivatives."""
    second = None if a.second is None else np.concatenate([a.second, b.second], 1)
    return Taylor(np.concatenate([a.v, b.v], 1), np.concatenate([a.first, b.first], 1), second)


def differentiate_implicitly(equations: Sequence[Taylor], values: Sequence[float]) -> list[Taylor]:
    """Return the solution u of ``F(p, u) = 0`` with its derivatives in p, by the implicit function theorem.

    Args:
        equations: components of F at the solution, which are real. The variables of their derivatives are all
            parameters p, followed by the unknowns u, whose number equals that of the equations.
        values: values of the unknowns.

    Returns:
        The unknowns, in order; their derivatives are NaN if the system is singular.
    """
    count = len(equations)
    slopes = np.array([each.first for each in equations])
    parameters = slopes.shape[1] - count
    try:
        inverse = -np.linalg.inv(slopes[:, parameters:])
    except np.linalg.LinAlgError:
        inverse = np.full((count, count), np.nan)
    first = inverse @ slopes[:, :parameters]
    if equations[0].second is None:
        return list(map(Taylor, values, first))
    directions = np.concatenate([np.eye(parameters), first])
    curvatures = np.array([directions.T @ each.second @ directions for each in equations])
    return list(map(Taylor, values, first, np.tensordot(inverse, curvatures, 1)))


def replace_derivatives(results: list[Taylor], others: list[Taylor], k: int) -> None:
    """Replace, in each result, the derivatives with respect to variable k by those of ``others``."""
    for result, other in zip(results, others, strict=True):
        result.first[k] = other.first[k]
        if result.second is not None and other.second is not None:
            result.second[k], result.second[:, k] = other.second[k], other.second[:, k]
