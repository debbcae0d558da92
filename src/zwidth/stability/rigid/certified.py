"""Certify stability verdicts of rigid loops: by the closed form with a static error bound, then by ball arithmetic.

Both steps evaluate the source code of `stability.rigid.crossover`, with other number types:

1. `Sized`: float64 values, each with a *size*, the sum of the magnitudes of its terms. A comparison is true if the
   difference exceeds `TOLERANCE` times its size. This static bound covers all rounding errors
   (docs/theory/certified.md).
2. Balls of python-flint (optional) around exact inputs, for walls that the first step leaves open. The precision is
   doubled until the verdict is certain.

As in `stability.rigid.crossover`, the wall has the normalized stiffness alpha and damping beta, the device the
normalized damping delta, the delay is d = n + f periods, c = e^-delta and phi1 = (1 - c)/delta. The gain crossover w
determines u = 1 - cos w, the zero of a cubic. N(z) = a2 z^2 + a1 z + a0 is the numerator of the discretized device.

A wall stays UNDECIDED if poles other than z = 1 lie exactly on the unit circle. For delta > 0 and alpha > 0 no such
wall is known: c is then transcendental, but alpha, beta, delta and d are rational.

References:
    Walton, Marshall 1987; Rump 1999; Johansson 2017; Devillers, Pion 2003 (static filters).
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.core.status import Status
from zwidth.core.types import Array
from zwidth.core.xp import horner, namespace, nan_beyond, square_roots
from zwidth.numerics.balls import BITS, available
from zwidth.numerics.evaluate import evaluate_columns
from zwidth.plant.rigid_mass import DelayClasses, DiscretePlant, PhiFunctions, classify_delays, discretize_mass
from zwidth.plant.rigid_mass import discretize_plant as discretize
from zwidth.stability.rigid.broadcasting import Points
from zwidth.stability.rigid.characteristic_polynomial import expand_wall
from zwidth.stability.rigid.crossover import (
    DelayPhase,
    DelayPhaseFunction,
    RootFinder,
    Verdict,
    decide_long_delay,
    decide_short_delay,
    evaluate_phase,
    find_first_root,
)
from zwidth.stability.rigid.normalization import wall_status
from zwidth.units.quantities import WALL_RANGE

if TYPE_CHECKING:
    import flint

# Error bounds, relative to the size of a number. Steps C1 to C6 of docs/theory/certified.md derive them.
TOLERANCE = 2.0**-35  # largest error of a number that is computed from u
CROSSOVER_WIDTH = 2.0**-39  # largest relative error of the gain crossover u = 1 - cos omega
CUBIC_TOLERANCE = 2.0**-45  # largest error of the cubic H whose zero is u
TINY = 2.0**-960  # added to each size; TOLERANCE * TINY exceeds what XLA flushes to zero

# Codes of walls, the results of the test with the static error bound.
UNSTABLE = 0
STABLE = 1
OPEN = 2  # the error bound permits both verdicts
EDGE = 3  # alpha = 0, and all poles but z = 1 lie inside the unit circle


class Sized:
    """Float64 values, each with its size, the sum of the magnitudes of its terms, elementwise.

    The exact number differs from ``value`` by at most ``TOLERANCE * size``; without ``size``, ``value`` is exact. The
    class has the operators of ``flint.arb`` that `stability.rigid.crossover` uses.
    """

    __slots__ = ("exact", "size", "value")
    __array_ufunc__ = None  # makes NumPy defer ``array * sized`` to this class

    def __init__(self, value: Any, size: Any = None):
        self.value = value
        self.exact = size is None
        self.size = abs(value) + TINY if size is None else size

    def __add__(self, other: Any) -> Sized:
        other = other if isinstance(other, Sized) else Sized(other)
        value = self.value + other.value
        # If both terms are exact, the size is the magnitude of the sum, because the rounding error of the sum is the
        # only error.
        return Sized(value, abs(value) + TINY if self.exact and other.exact else self.size + other.size)

    __radd__ = __add__

    def __neg__(self) -> Sized:
        return Sized(-self.value, None if self.exact else self.size)

    def __sub__(self, other: Any) -> Sized:
        return self + -other

    def __rsub__(self, other: Any) -> Sized:
        return -self + other

    def __mul__(self, other: Any) -> Sized:
        other = other if isinstance(other, Sized) else Sized(other)
        return Sized(self.value * other.value, self.size * other.size + TINY)

    __rmul__ = __mul__

    def __truediv__(self, other: Sized) -> Sized:
        xp, quotient = namespace(other.value), self.value / other.value
        least = abs(other.value) - TOLERANCE * other.size
        return Sized(quotient, xp.where(least > 0, (self.size + abs(quotient) * other.size) / least, xp.inf))

    def sqrt(self) -> Sized:
        """Return the square root, with NaN if ``value`` is negative."""
        root = square_roots(self.value)[0]
        # With the value v and the exact number x, the size follows from |sqrt x - sqrt v| = |x - v|/(sqrt x + sqrt v).
        return Sized(root, self.size / root)

    def __gt__(self, other: Any) -> Array:
        difference = self - other
        return difference.value > TOLERANCE * difference.size

    def __lt__(self, other: Any) -> Array:
        return -self > -other


def compute_wall_codes(alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses) -> Array:
    """Return UNSTABLE, STABLE, OPEN or EDGE for each wall, elementwise."""
    return decide_wall_codes(Sized(alpha), Sized(beta), size_device(delta, d, kind), kind, enclose_root, size_phase)


def decide_wall_codes(
    alpha: Any,
    beta: Any,
    plant: DiscretePlant,
    kind: DelayClasses,
    find_root: RootFinder,
    evaluate_phase: DelayPhaseFunction,
) -> Array:
    """Return the code UNSTABLE, STABLE, OPEN or EDGE of each wall, elementwise, for numbers with an error bound.

    Args:
        alpha: normalized stiffness, a `Sized` number, or a number of a class with the same operators and ``value``.
        beta: normalized damping, a number of the same class.
        plant: discretized device; its fields are numbers of the same class.
        kind: states whether short, long and fractional delays occur.
        find_root: function that returns the gain crossover with an error bound.
        evaluate_phase: function that returns the phase lag at the gain crossover with an error bound.
    """
    wall, verdicts = expand_wall(alpha, beta)[:2], []
    xp = namespace(alpha.value, beta.value, plant.whole)
    if kind.short:
        verdicts.append(decide_short_delay(*wall, plant))
    if kind.long:
        verdicts.append(decide_long_delay(*wall, plant.whole, plant, find_root, evaluate_phase))
    stable, unstable = (xp.where(plant.whole < 1, *pair) for pair in zip(verdicts[0], verdicts[-1], strict=True))
    # For alpha = 0 the verdict applies to the poles other than z = 1 and requires beta > delta (S15b of
    # one-crossover.md). For alpha > 0 no wall with beta <= -delta is stable (L16 of one-lobe.md). For alpha < 0 all
    # walls are unstable: P(1) = phi1 alpha < 0, so a real pole is above 1.
    b, edge, positive = beta + plant.delta, alpha.value == 0, alpha.value > 0
    valid = (edge & (beta.value > plant.delta.value)) | (positive & (b > 0))
    code = xp.where(stable & valid, xp.where(edge, EDGE, STABLE), OPEN)
    code = xp.where((unstable & valid) | (alpha.value < 0) | (positive & (b < 0)), UNSTABLE, code)
    return code.astype(xp.uint8)


def size_device(delta: Array, d: Array, kind: DelayClasses) -> DiscretePlant:
    """Return the discretized device of exact delta and d as `Sized` numbers, NaN if out of range."""
    plant = discretize(delta, d, kind)
    sized = DiscretePlant(*(Sized(value, abs(value) + TINY) for value in plant))
    sized = sized._replace(delta=Sized(plant.delta), f=Sized(plant.f), whole=plant.whole, a0=None)
    if kind.fractional:
        # Increase the size of a0 by a part of a1, because the rounding error of f changes a0 by up to 2^-52 a1.
        a0 = Sized(plant.a0, plant.a0 + plant.a1 / 16.0 + TINY)
        return sized._replace(a0=a0, gap=sized.a2 - sized.a1 + a0)
    return sized


def enclose_root(coefficients: tuple[Sized, ...]) -> tuple[Sized, Array]:
    """Return the zero u of the cubic, and whether a sign change proves the error bound `CROSSOVER_WIDTH`."""
    u = find_first_root(tuple(h.value for h in coefficients))
    low, high = (horner(Sized(u * (1.0 + side)), coefficients) for side in (-CROSSOVER_WIDTH, CROSSOVER_WIDTH))
    changes_sign = (low.value > CUBIC_TOLERANCE * low.size) & (high.value < -CUBIC_TOLERANCE * high.size)
    return Sized(u, abs(u) + TINY), changes_sign & (u > 0) & (u <= 1.0)


def size_phase(u: Sized, n: Array) -> DelayPhase:
    """Return the phase lag (n + 1/2) w at the gain crossover u = 1 - cos w, with the sizes of its sine and cosine."""
    phase = evaluate_phase(u.value, n)
    # The error of the sine is proportional to half the phase lag, h. Because h <= pi/2, h is at most (pi/2) sin h.
    cosine, sine = Sized(phase.cosine, 1.0), Sized(phase.sine, 4.0 * square_roots(phase.half_sine_squared)[0] + TINY)
    return DelayPhase(
        cosine, sine, Sized(phase.half_sine_squared, 5.0 * phase.half_sine_squared + TINY), phase.within, phase.beyond
    )


def certify_labels(points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Return certified stability labels and statuses; the status is ON_BOUNDARY or UNDECIDED without a label."""
    columns = points.columns()
    code = filter_walls(*columns)
    stable, status = code == STABLE, np.zeros(code.shape, np.int32)
    open_walls = np.flatnonzero(code >= OPEN)
    if open_walls.size:
        walls = (column if column.size == 1 else column[open_walls] for column in columns)
        stable[open_walls], status[open_walls] = _decide_rest(code[open_walls], *walls)
    return stable.reshape(points.shape), status.reshape(points.shape)


def filter_walls(alpha: np.ndarray, beta: np.ndarray, delta: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return UNSTABLE, STABLE, OPEN or EDGE for each wall; OPEN if it is out of range."""
    # Replace negative delta and d by NaN in NumPy, because XLA would treat negative numbers above -2^-1022 as 0.
    device = (np.where(value < 0, np.nan, value) for value in (delta, d))
    return evaluate_columns(compute_wall_codes, [*nan_beyond(WALL_RANGE, alpha, beta), *device], classify_delays(d))


def _decide_rest(
    code: np.ndarray, alpha: np.ndarray, beta: np.ndarray, delta: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return labels and statuses of the walls that the static bound does not decide (OPEN, EDGE or out of range)."""
    code, alpha, beta, delta, d = np.broadcast_arrays(code, alpha, beta, delta, d)
    status = wall_status(alpha, beta, delta, d)
    in_range, stable = status == Status.OK, np.zeros(code.shape, bool)
    # For alpha = 0 and |beta| <= delta, no pole other than z = 1 lies outside the unit circle, because
    # |beta N| <= |beta| phi1 <= 1 - c <= |z - c| on the circle.
    edge = (alpha == 0) & ((code == EDGE) | (np.abs(beta) <= delta))
    status[in_range & edge] = Status.ON_BOUNDARY
    # Do not test walls with beta <= -delta: they are not stable. For alpha = 0, P(1) = 0 and P'(1) = phi1 (delta +
    # beta) <= 0, so a further pole is at or above z = 1; for alpha > 0, the stable set lies above beta = -delta (L16 of
    # one-lobe.md).
    open_walls = np.flatnonzero(in_range & ~edge & (expand_wall(alpha, beta).beta > -delta))
    status[open_walls] = Status.UNDECIDED
    if open_walls.size and available():
        walls = zip(*(column[open_walls].tolist() for column in (alpha, beta, delta, d)), strict=True)
        stable[open_walls], status[open_walls] = zip(*(decide(*wall) for wall in walls), strict=True)
    return stable, status


def decide(alpha: float, beta: float, delta: float, d: float) -> tuple[bool, Status]:
    """Return label and status of one wall by ball arithmetic, for beta > -delta, or beta > delta if alpha = 0."""
    at_edge = alpha == 0
    for bits in BITS:
        stable, unstable = compute_verdict(alpha, beta, delta, d, bits)
        if stable or unstable:
            return bool(stable and not at_edge), Status.ON_BOUNDARY if stable and at_edge else Status.OK
    return False, Status.UNDECIDED


def compute_verdict(alpha: float, beta: float, delta: float, d: float, bits: int) -> Verdict:
    """Return the stability verdict of one wall by ball arithmetic with a precision of ``bits``."""
    import flint

    with flint.ctx.workprec(bits):
        plant, wall = device(delta, d, bits), expand_wall(flint.arb(alpha), flint.arb(beta))[:2]
        return (
            decide_short_delay(*wall, plant)
            if d < 1
            else decide_long_delay(*wall, int(d), plant, _enclose_root_in_balls, _evaluate_phase_in_balls)
        )


@lru_cache(maxsize=64)
def device(delta: float, d: float, bits: int) -> DiscretePlant:
    """Return the discretized device of exact delta and d in balls, cached because all walls of a grid share it."""
    import flint

    # Compute with 64 additional bits, because the phi-functions amplify the rounding error of their argument delta (1 -
    # f).
    with flint.ctx.workprec(bits + 64):
        x, f = flint.arb(delta), flint.arb(d - int(d))
        phis_delta, phis_late, plant = _phi(x), _phi(x * (1 - f)), discretize_mass(x, f if f != 0 else None, _phi)
        phis = phis_delta.phi1, phis_delta.phi2, phis_delta.psi, phis_late.phi1, phis_late.psi
        a0 = plant.a0 if f != 0 else None
        return DiscretePlant(x, None, f, plant.c, plant.em, *phis, plant.a2, plant.a1, a0, plant.gap, None)


def _phi(x: flint.arb) -> PhiFunctions:
    """Return the phi-functions of x >= 0 in balls, with additional bits for small x, where their quotients cancel."""
    import flint

    if x == 0:
        one, half = flint.arb(1), flint.arb(0.5)
        return PhiFunctions(one, one, half, half, flint.arb(0))
    man, exponent = x.mid().man_exp()
    with flint.ctx.workprec(flint.ctx.prec + 16 + max(0, -3 * (int(exponent) + int(man).bit_length()))):
        c = (-x).exp()
        p1 = -(-x).expm1() / x
        p2, psi = (1 - p1) / x, (p1 - c) / x
        return PhiFunctions(c, p1, p2, psi, p2 - psi)


def _enclose_root_in_balls(coefficients: tuple[flint.arb, ...]) -> tuple[flint.arb, bool]:
    """Return a ball around the zero of the cubic, and whether sign changes of the cubic certify it."""
    import flint

    midpoints = [h.mid() for h in coefficients]
    slopes = [k * h for k, h in enumerate(midpoints)][1:]
    with np.errstate(all="ignore"):
        start = float(find_first_root(tuple(map(np.float64, midpoints))))
    u = flint.arb(start if 0 < start < 2 else 1.0)
    for _ in range(16):  # Newton steps; 10 suffice from 8 correct bits
        u = (u - horner(u, midpoints) / horner(u, slopes)).mid()
    radius = u * flint.arb(2) ** (-flint.ctx.prec // 2)
    low, high = u - radius, u + radius
    return flint.arb(u, radius), bool(
        low > 0 and high < 2 and horner(low, coefficients) > 0 and horner(high, coefficients) < 0
    )


def _evaluate_phase_in_balls(u: flint.arb, n: int) -> DelayPhase:
    """Return the phase lag (n + 1/2) w at the gain crossover u = 1 - cos w, in balls."""
    import flint

    w = (u / 2).sqrt().asin() * 2
    phase, pi = w * (n + 0.5), flint.arb.pi()
    sine, cosine = phase.sin_cos()
    half = (phase / 2).sin()
    return DelayPhase(cosine, sine, half * half, phase < pi, w * (n + 1) > pi)
