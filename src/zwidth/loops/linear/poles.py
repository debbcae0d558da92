"""Poles of a linear loop with walls: companion eigenvalues, then Aberth's steps on the factored polynomial; its radius.

With zeta = z - 1 and every root t of the loop by its offset 1 - t,

    P = z^lag prod(zeta + t) Q + g prod(zeta + b) (alpha Q + beta R),     F = R/Q

keeps the digits of poles next to z = 1, which the coefficients lose; a pole is kept as its zeta as well. For long
delays the spectral radius comes from counting poles in circles.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from zwidth.arrays.counting import count_poles
from zwidth.arrays.polynomials import companion, square
from zwidth.loops.linear.roots import LoopRoots, affine_polynomial, closed_loop_roots, step_apart
from zwidth.parts.circle import Jet
from zwidth.parts.velocity import Estimate
from zwidth.words.errors import InputError
from zwidth.words.quantities import MOST_POLES, WALL_RANGE
from zwidth.words.types import Array
from zwidth.words.xp import within

# Aberth's steps at most, and the step, in units of the pole's own distance from z = 1, that ends them.
_STEPS, _ARRIVED = 60, 4e-16
_LONGEST_STEP = 0.5
# Nearer to z = 1 than this a pole's distance from it has digits of its own, that eigenvalues do not know. A pole that
# would go farther, as a share of that distance, has not arrived; and how often such are moved.
_NEAR_ONE, _STRAY, _STIRS = 1e-6, 1e-3, 4
# Imaginary parts that are none, as a share.
_REAL = 1e-13
# Numbers that a block of walls holds: eigenvalues and the distances between poles take order^2 each.
_NUMBERS = 1 << 20


class PolynomialValue(NamedTuple):
    """P, its derivative, and the size of what it is the sum of."""

    value: Array
    slope: Array
    size: Array


def _product(zeta: Array, offsets: Array, factor: float = 1.0) -> Jet:
    found = Jet(np.full_like(zeta, factor), np.zeros_like(zeta))
    for offset in offsets:
        found = found.times(Jet(zeta + offset, 1.0))
    return found


def _power(zeta: Array, turns: int) -> Jet:
    """``z^turns``."""
    below = (1.0 + zeta) ** (turns - 1) if turns else np.ones_like(zeta)
    return Jet(below * (1.0 + zeta) if turns else below, turns * below)


def _difference(zeta: Array, window: int) -> Jet:
    """``(z^window - 1)/window``: next to z = 1 by the binomial's product, where the subtraction has no digit left."""
    power, slope = _power(zeta, window)
    size = 0.5 * np.log1p(np.maximum(2.0 * zeta.real + square(zeta), -0.999))
    turned = window * (size + 1j * np.arctan2(zeta.imag, 1.0 + zeta.real))
    near = np.abs(turned) < 1.0
    small = np.where(near, turned, 0.0)
    return Jet(np.where(near, np.expm1(small), power - 1.0) / window, slope / window)


def log_size(zeta: Array) -> Array:
    """``log|z|``, with the digits of a slow pole."""
    with np.errstate(divide="ignore"):
        return 0.5 * np.log1p(np.maximum(2.0 * zeta.real + square(zeta), -1.0))


def evaluate(loop: LoopRoots, alpha: Array, beta: Array, zeta: Array) -> PolynomialValue:
    """The factored polynomial; arrays that broadcast with zeta."""
    f = loop.estimate
    turns = f.window + f.lag
    device = _product(zeta, loop.poles).times(_power(zeta, loop.lag))
    answer = _product(zeta, loop.zeros, loop.gain)
    bottom = _product(zeta, f.poles).times(_power(zeta, max(turns, 0)))
    top = _product(zeta, f.zeros, float(f.gain))
    if f.window:
        top = top.times(_difference(zeta, f.window))
    top = top.times(_power(zeta, max(-turns, 0)))
    wall = Jet(alpha * bottom.value + beta * top.value, alpha * bottom.slope + beta * top.slope)
    own, pushed = device.times(bottom), answer.times(wall)
    largest = np.abs(own.value) + np.abs(answer.value) * (np.abs(alpha * bottom.value) + np.abs(beta * top.value))
    return PolynomialValue(own.value + pushed.value, own.slope + pushed.slope, largest)


def _find_poles(loop: LoopRoots, alpha: Array, beta: Array) -> Array:
    """Eigenvalues of the companion matrices, less 1, moved by Aberth's steps: Newton's, each pole off the others."""
    D, N1, N2 = affine_polynomial(loop)
    monic = (D + alpha[:, None] * N1 + beta[:, None] * N2) / D[0]
    zeta = np.linalg.eigvals(companion(monic)) - 1.0 + 0j
    _take_steps(loop, alpha, beta, zeta, np.arange(len(zeta)))
    # Steps keep a real pair real and a conjugate one conjugate. Of two poles that are almost one eigenvalues may have
    # made the other kind, from which no step leads to them.
    for turn in range(_STIRS):
        at = evaluate(loop, alpha[:, None], beta[:, None], zeta)
        with np.errstate(all="ignore"):
            step = step_apart(zeta, at.slope / at.value)
        far = (np.abs(step) > _STRAY * np.abs(zeta)) | (np.abs(zeta) < _NEAR_ONE)
        stray = (np.abs(at.value) > 1e-10 * at.size) & far
        if not stray.any():
            break
        zeta *= np.where(stray, 1.0 + 0.3 * np.exp(2.4j * (np.arange(zeta.shape[1]) + turn)), 1.0)
        _take_steps(loop, alpha, beta, zeta, np.flatnonzero(stray.any(1)))
    return zeta


def _take_steps(loop: LoopRoots, alpha: Array, beta: Array, zeta: Array, rows: Array) -> None:
    """Move some walls' poles until they stay."""
    for _ in range(_STEPS):
        if not rows.size:
            break
        now = zeta[rows]
        at = evaluate(loop, alpha[rows, None], beta[rows, None], now)
        with np.errstate(all="ignore"):
            step = step_apart(now, at.slope / at.value)
        # Below the rounding of P a step moves nothing but noise.
        good = np.isfinite(step) & (np.abs(at.value) > 1e-16 * at.size)
        step = np.where(good, step, 0.0)
        step *= _LONGEST_STEP / np.maximum(np.abs(step), _LONGEST_STEP)
        zeta[rows] = now - step
        rows = rows[(np.abs(step) > _ARRIVED * np.abs(now)).any(1)]


def poles_less_one(loop: LoopRoots, alpha: Array, beta: Array) -> Array:
    """``z - 1`` for all poles of walls of one shape, along a new last axis; NaN where a wall is out of range."""
    order, shape = loop.order, alpha.shape
    if order > MOST_POLES:
        raise InputError(
            f"scene: its {order} poles would take minutes a wall, and at most {MOST_POLES} are computed; "
            "spectral_radius and is_stable answer for every delay at once"
        )
    alpha, beta = alpha.reshape(-1), beta.reshape(-1)
    out = np.full((alpha.size, order), complex(np.nan, np.nan))
    known = np.flatnonzero(within(alpha, WALL_RANGE) & within(beta, WALL_RANGE))
    block = max(1, _NUMBERS // order**2)
    for damped in (True, False):
        walls = known[(beta[known] != 0) == damped]
        for k in range(0, walls.size, block):
            some = walls[k : k + block]
            out[some] = _find_poles(loop, alpha[some], beta[some]) if damped else _springs(loop, alpha[some])
    # Steps leave rounding on real poles; those of a pair that meets there are 1e-8 apart.
    out = np.where(np.abs(np.imag(out)) <= _REAL * np.abs(out), np.real(out) + 0j, out)
    return out.reshape(*shape, order)


def _springs(loop: LoopRoots, alpha: Array) -> Array:
    """Walls without damping: the poles of the estimate are in nobody's loop, and known."""
    f = loop.estimate
    idle = np.concatenate([-f.poles, -np.ones(max(f.window + f.lag, 0))])
    found = _find_poles(replace(loop, estimate=Estimate(0)), alpha, np.zeros_like(alpha))
    return np.concatenate([found, np.broadcast_to(idle, (alpha.size, idle.size))], 1)


# In a difference of two numbers: what the rounding of either may leave of it.
_CANCELLED = 1e-14


def is_marginal(loop: LoopRoots, alpha: float, beta: float) -> bool:
    """Whether a wall has one pole exactly at z = 1 and all others strictly inside: it neither pulls back nor grows."""
    wall = np.array([alpha]), np.array([beta])
    at = evaluate(loop, *wall, np.zeros(1, complex))
    undamped = evaluate(loop, wall[0], 0.0 * wall[1], np.zeros(1, complex))
    # Where the wall's damping takes away all that the device has, the difference is rounding: two poles at z = 1.
    parts = np.abs(undamped.slope[0]) + np.abs(at.slope[0] - undamped.slope[0])
    if at.value[0] != 0 or np.abs(at.slope[0]) <= _CANCELLED * parts:
        return False
    found = poles_less_one(loop, *wall)[0]
    return bool(np.all(log_size(np.delete(found, np.argmin(np.abs(found)))) < 0))


# Beyond so many poles a count, whose cost no delay changes, is faster than all of them; but the window's zeros count.
_MOST_POLES, _LONGEST_WINDOW = 150, 40
# Circles looked at in one call, which narrow the bracket by one more; and where the bracket ends.
_CIRCLES, _ROUNDS, _WIDTH = 16, 24, 4e-16
# A bracket that stays wider holds poles that the count cannot tell apart from the circle.
_UNKNOWN = 1e-6
# Where label and radius contradict each other by more than that, one of the two is wrong: neither is given.
_CONTRADICTION = 1e-7


def log_radius(loop: LoopRoots, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """``log max|z|`` of walls of shape (walls,); NaN where it is not known."""
    if loop.order <= _MOST_POLES or loop.estimate.window > _LONGEST_WINDOW:
        return log_size(poles_less_one(loop, alpha, beta)).max(-1)
    return np.array([_by_circles(loop, a, b) for a, b in zip(alpha.tolist(), beta.tolist(), strict=True)])


def spectral_radius(loop: LoopRoots, alpha: np.ndarray, beta: np.ndarray, stable: np.ndarray) -> np.ndarray:
    """``max|z|`` on the verdict's side of 1: within rounding of the boundary the two would contradict each other."""
    log = log_radius(loop, alpha, beta)
    log = np.where((log < 0) != stable, np.where(np.abs(log) < _CONTRADICTION, 0.0, np.nan), log)
    radius = np.exp(log)
    return np.where(stable, np.minimum(radius, np.nextafter(1.0, 0.0)), radius)


def _by_circles(loop: LoopRoots, alpha: float, beta: float) -> float:
    if not (np.isfinite(alpha) and np.isfinite(beta)):
        return np.nan
    zeros, poles, gain, lag = closed_loop_roots(loop, alpha, beta)
    full = poles.size + lag
    low, high = -1.0, 1.0
    for round_ in range(_ROUNDS):
        logs = np.linspace(low, high, _CIRCLES + 2)[0 if round_ < 3 else 1 : None if round_ < 3 else -1]
        with np.errstate(all="ignore"):
            counts = count_poles(zeros, poles, gain, lag, np.exp(logs))
        holds, lacks = logs[counts == full], logs[(counts >= 0) & (counts < full)]
        if not holds.size and round_ < 3 and lacks.size:
            low, high = high, 8.0 * high
            continue
        if not lacks.size and round_ < 3 and holds.size:
            low, high = 8.0 * low, low
            continue
        if not holds.size and not lacks.size:
            break
        low, high = max([low, *lacks]), min([high, *holds])
        if high - low <= _WIDTH * max(1.0, abs(high)):
            break
    return 0.5 * (low + high) if high - low <= _UNKNOWN else np.nan
