"""Label rigid walls as stable or unstable in float32, and again in float64 if the float32 label may be wrong.

A wall is *open* if float32 does not decide its label, usually because the wall lies near the stability boundary.

The float32 step evaluates the source code of `stability.rigid.crossover` with numbers of the class `Bounded`: float32
values, each with a bound of its error. A comparison of two numbers is accepted only if their difference exceeds the
error bound of the difference; otherwise the wall is open. Open walls are labeled by the closed form in float64, so all
labels are those of float64 (docs/theory/certified.md, steps M1 to M4). The method saves time on processors with slow
float64 arithmetic, such as many GPUs.

As in `stability.rigid.crossover`, the wall has the normalized stiffness alpha and damping beta, the device has the
normalized damping delta, and the delay is d = n + f periods. The gain crossover w determines u = 1 - cos w, a zero of
the cubic H(u) = |B|^2 - |T|^2. Further symbols: c = e^-delta; a2, a1 and a0 are the coefficients of N(z).

References:
    Higham 2002, Accuracy and Stability of Numerical Algorithms, section 3.3 (running error analysis).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import horner, lazy_jax
from zwidth.plant.rigid_mass import ANY, DelayClasses, DiscretePlant, discretize_split_delay, split_delay
from zwidth.stability.rigid.certified import OPEN, STABLE, decide_wall_codes
from zwidth.stability.rigid.crossover import DelayPhase, evaluate_phase, find_first_root, stable_kernel
from zwidth.stability.rigid.normalization import valid_wall

# Error bounds of float32 numbers. Steps M1 to M4 of docs/theory/certified.md derive them.
ROUNDING = 2.0**-22  # relative error of one operation: four rounding units, because GPUs may round less accurately
INTEGER_PLANT_ERROR = 2.0**-19  # relative error of each parameter of the discretized device, for integer delays
FRACTIONAL_PLANT_ERROR = 2.0**-17  # relative error of each parameter of the discretized device, for fractional delays
PHASE_ERROR = 2.0**-18  # relative error of the phase lag of the delay, in addition to the relative error of u
MAX_WIDTH = 2.0**-6  # largest relative error of u; squares of larger errors would not be negligible
TINY = 2.0**-100  # absolute error of a product; larger than the numbers that processors replace by 0 in float32

# Largest number of open walls that the float64 step computes separately: one in OPEN_SHARE of all walls, but at least
# MIN_OPEN. If more walls are open, it computes all walls.
OPEN_SHARE = 64
MIN_OPEN = 64


class Bounded:
    """Array of float32 values with a bound of the error of each: the exact number is within ``value +- error``.

    The class has the operators of ``flint.arb`` that `stability.rigid.crossover` uses.
    """

    __slots__ = ("error", "value")

    def __init__(self, value: Any, error: Any = 0.0):
        self.value = value
        self.error = error

    def __add__(self, other: Any) -> Bounded:
        other = other if isinstance(other, Bounded) else Bounded(other)
        value = self.value + other.value
        return Bounded(value, self.error + other.error + ROUNDING * abs(value))

    __radd__ = __add__

    def __neg__(self) -> Bounded:
        return Bounded(-self.value, self.error)

    def __sub__(self, other: Any) -> Bounded:
        return self + -other

    def __rsub__(self, other: Any) -> Bounded:
        return -self + other

    def __mul__(self, other: Any) -> Bounded:
        other = other if isinstance(other, Bounded) else Bounded(other)
        value = self.value * other.value
        error = abs(self.value) * other.error + self.error * (abs(other.value) + other.error)
        return Bounded(value, error + (ROUNDING * abs(value) + TINY))

    __rmul__ = __mul__

    def __truediv__(self, other: Bounded) -> Bounded:
        quotient, least = self.value / other.value, abs(other.value) - other.error
        error = (self.error + abs(quotient) * other.error) / least + (ROUNDING * abs(quotient) + TINY)
        return Bounded(quotient, lazy_jax.numpy.where(least > 0, error, np.inf))

    def sqrt(self) -> Bounded:
        """Return the square roots; NaN for negative values."""
        root = lazy_jax.numpy.sqrt(self.value)
        # With the value v and the exact number x, |sqrt x - sqrt v| = |x - v|/(sqrt x + sqrt v).
        return Bounded(root, self.error / root + ROUNDING * root)

    def __gt__(self, other: Any) -> Array:
        difference = self - other
        return difference.value > difference.error

    def __lt__(self, other: Any) -> Array:
        return -self > -other


def label_in_mixed_precision(alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses = ANY) -> Array:
    """Return whether each wall is stable, with the same result as float64; False for invalid input.

    Args:
        alpha, beta, delta, d: float64 JAX arrays that broadcast.
        kind: classes of the delays.
    """
    jnp = lazy_jax.numpy
    stable, is_open = label_in_float32(alpha, beta, delta, d, kind)
    shape, stable, is_open = stable.shape, stable.reshape(-1), is_open.reshape(-1)
    columns = [x if x.ndim == 0 else jnp.broadcast_to(x, shape).reshape(-1) for x in (alpha, beta, delta, d)]
    capacity = min(stable.size, max(MIN_OPEN, stable.size // OPEN_SHARE))

    def decide_open() -> Array:
        # The length of ``index`` is fixed at compilation, so that some entries are unused. They are 0, the index of the
        # first wall, because its float64 label is correct even if the wall is not open.
        index = jnp.nonzero(is_open, size=capacity, fill_value=0)[0]
        labels = stable_kernel(*(x[index] if x.ndim else x for x in columns), kind=kind)
        return stable.at[index].set(labels)

    def decide_all() -> Array:
        return jnp.broadcast_to(stable_kernel(*columns, kind=kind), stable.shape)

    return lazy_jax.lax.cond(is_open.sum() <= capacity, decide_open, decide_all).reshape(shape)


def label_in_float32(alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses) -> tuple[Array, Array]:
    """Return two masks: walls that are stable according to float32, and open walls, which float32 does not decide.

    Both masks are False for unstable walls and for invalid input.
    """
    plant = bound_device(delta, d, kind)
    code = decide_wall_codes(round_to_float32(alpha), round_to_float32(beta), plant, kind, bound_root, bound_phase)
    # Check the ranges in float64, because a small number may be 0 in float32.
    possible = valid_wall(alpha, beta, delta, d) & (alpha > 0)
    return possible & (code == STABLE), possible & (code >= OPEN)


def round_to_float32(value: Array) -> Bounded:
    """Return a float64 array, rounded to float32, as `Bounded` numbers with the rounding errors as error bounds."""
    rounded = value.astype(np.float32)
    return Bounded(rounded, ROUNDING * abs(rounded) + TINY)


def bound_device(delta: Array, d: Array, kind: DelayClasses) -> DiscretePlant:
    """Return the discretized device for float64 arrays delta and d, with `Bounded` parameters (step M2)."""
    # Split d into n + f in float64, because float32 has too few digits for the fraction f of a long delay.
    whole, f = split_delay(d)
    plant = discretize_split_delay(*(x.astype(np.float32) for x in (delta, whole, f, 1.0 - f)), kind=kind)
    relative = FRACTIONAL_PLANT_ERROR if kind.fractional else INTEGER_PLANT_ERROR
    bounded = DiscretePlant(*(Bounded(value, relative * abs(value) + TINY) for value in plant))
    # Rounding delta to float32 changes c = e^-delta by up to delta c 2^-24.
    c = Bounded(plant.c, plant.c * (relative + ROUNDING * plant.delta) + TINY)
    bounded = bounded._replace(delta=round_to_float32(delta), whole=plant.whole, c=c, a0=None)
    if kind.fractional:
        # Rounding delta and 1 - f to float32 changes a0 by up to 2^-22 a1.
        a0 = Bounded(plant.a0, relative * plant.a0 + ROUNDING * plant.a1 + TINY)
        return bounded._replace(a0=a0, gap=bounded.a2 - bounded.a1 + a0)
    return bounded


def bound_root(coefficients: tuple[Bounded, ...]) -> tuple[Bounded, Array]:
    """Return the zero u of the cubic H with an error bound, and whether a sign change of H proves it (step M3)."""
    values = tuple([h.value for h in coefficients])
    u = find_first_root(values)
    slope = horner(u, [k * value for k, value in enumerate(values)][1:])
    # Use twice the width that the error of H requires, so that the sign of H is certain at both ends of the interval.
    error = horner(Bounded(u), coefficients).error
    width = lazy_jax.numpy.maximum(2.0 * error / abs(u * slope), ROUNDING)
    low, high = (horner(Bounded(u * (1.0 + side)), coefficients) for side in (-width, width))
    return Bounded(u, u * width), (low > 0) & (high < 0) & (width < MAX_WIDTH) & (u > 0) & (u <= 1.0)


def bound_phase(u: Bounded, n: Array) -> DelayPhase:
    """Return the phase lag (n + 1/2) w at the gain crossover u = 1 - cos w, as `Bounded` numbers (step M4)."""
    phase, width = evaluate_phase(u.value, n), u.error / u.value + PHASE_ERROR
    # Compare (n + 1)^2 u with pi^2/2. A comparison is True only if it is true for all u within the error bound.
    ratio = u.value * (n + 1.0) * (n + 1.0) / (0.5 * np.pi * np.pi)
    return DelayPhase(
        Bounded(phase.cosine, 4.0 * width),
        Bounded(phase.sine, 4.0 * width * lazy_jax.numpy.sqrt(phase.half_sine_squared) + TINY),
        Bounded(phase.half_sine_squared, 5.0 * width * phase.half_sine_squared + TINY),
        ratio * (1.0 + 2.0 * width) < 1.0,
        ratio * (1.0 - 2.0 * width) > 1.0,
    )
