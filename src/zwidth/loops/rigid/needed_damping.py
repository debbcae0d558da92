"""The physical damping that a passive wall of the rigid loop needs, for any delay: one maximum over frequency.

What a wall needs at one frequency, N, where that is highest for alpha >= 0 (P1 to P3), and all letters stand in
docs/theory/passivity.md. N is homogeneous in (alpha, beta), a polynomial in u under the root, and stationary where
``E = A' + kappa (b^2 - a^2)/(8 N)`` vanishes, a prime for d/du.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.held_mass import ANY, DelayClasses, split_delay
from zwidth.arrays.roots import newton
from zwidth.words.types import Array
from zwidth.words.xp import ARCSINE, COSINE, SINE, epsilon, frozen, horner, namespace

# Of the peak, from its fit; of the direction from which it exists, from twice its beta at most.
_STEPS, _DIRECTION_STEPS = 3, 12


class Delay(NamedTuple):
    """What the condition needs to know of a delay."""

    f: Array
    k: Array
    kappa: Array


class PeakCondition(NamedTuple):
    """The condition at one frequency."""

    slope: Array  # E, of the sign of dN/du
    bend: Array  # A''; of E the slope, where it vanishes
    root: Array  # 2 N - A
    needed: Array


def describe_delay(d: Array) -> Delay:
    """The `Delay` of d >= 0."""
    n, f = split_delay(d)
    return Delay(f, n + 1.0, 4.0 * f * (1.0 - f))


def larger_root(linear: Array, square: Array, xp: Any) -> tuple[Array, Array]:
    """N and 2 N - A of ``N^2 - A N - S/4 = 0``, free of cancellation; finite derivatives for A = S = 0."""
    total = linear * linear + square
    root = xp.where(total > 0, xp.sqrt(xp.where(total > 0, total, 1.0)), 0.0)
    other = root - linear
    return xp.where(linear > 0, 0.5 * (root + linear), 0.5 * square / xp.where(other > 0, other, 1.0)), root


def _rise(a: Array, beta: Array, delay: Delay) -> tuple[Array, Array, Array]:
    """At w = 0: what is needed, E, and the derivative of E in beta."""
    f, k, kappa = delay
    xp = namespace(a, f)
    n = k - 1.0
    # Of A at u = 0: the sums 1 + 2 sum cos(i w) and cos(k w), with their derivatives -i^2 in u.
    spring = (1.0 - f) * n * k * (2.0 * n + 1.0) + f * k * (k + 1.0) * (2.0 * k + 1.0)
    damper = (1.0 - f) * k * k + f * (k + 1.0) ** 2
    needed, root = larger_root(a * (2.0 * (n + f) + 1.0) - beta, kappa * a * a, xp)
    per = 0.125 * kappa / xp.where(needed > 0, needed, 1.0)
    pull = per * beta * (beta + 2.0 * a)
    rise = beta * damper - a * spring / 3.0 + pull
    return needed, rise, damper + 2.0 * per * (beta + a) + pull / xp.where(root > 0, root, 1.0)


def turns(a: Array, beta: Array, delay: Delay) -> tuple[Array, Array, Array, Array]:
    """Of the wall ``(2 a, beta)``: its need at w = 0, E there, its need at w = pi, and whether that is the peak."""
    f, k, _ = delay
    xp = namespace(a, f)
    at_zero, rise, _ = _rise(a, beta, delay)
    b = beta + a
    end = beta * (1.0 - 5.0 * f) - 2.0 * a * f + 0.5 * f * beta * (beta + 2.0 * a) / xp.where(b > 0, b, 1.0)
    return at_zero, xp.where(beta > 0, rise, -1.0), b * (1.0 - f), (k == 1) & (end >= 0)


def condition(u: Array, a: Array, beta: Array, delay: Delay) -> PeakCondition:
    """The condition at ``u = 1 - cos w`` in (0, 2], for n >= 1 in (0, 1]."""
    f, k, kappa = delay
    xp = namespace(u, a)
    cos_w, square = 1.0 - u, u * (2.0 - u)
    # For n = 0 all is a polynomial in u, up to w = pi.
    undelayed = k == 1
    square_safe = xp.where(undelayed, 1.0, square)
    cosine, sine = _wave(xp.minimum(u, 1.0), k, xp)
    cosine, tau = xp.where(undelayed, cos_w, cosine), xp.where(undelayed, 1.0, sine / xp.sqrt(square_safe))
    tau1 = xp.where(undelayed, 0.0, (k * cosine - tau * cos_w) / square_safe)
    inner = (k * cosine - tau) / u
    spring, spring1 = tau * (2.0 - u) - cosine, inner + k * tau
    spring2 = (-k * k * tau - tau1 - inner) / u + k * tau1
    damper, damper1, damper2 = cosine, -k * tau, -k * tau1
    spring, spring1, spring2 = spring + 2.0 * f * cosine, spring1 - 2.0 * f * k * tau, spring2 - 2.0 * f * k * tau1
    late, late_tau = cosine * cos_w - tau * square, tau * cos_w + cosine
    late_tau1 = tau1 * cos_w - tau - k * tau
    damper, damper1 = damper + f * (late - damper), damper1 - f * ((k + 1.0) * late_tau + damper1)
    damper2 = damper2 - f * ((k + 1.0) * late_tau1 + damper2)
    # Of the size of f: above, 1 - 1 would leave rounding errors.
    spring1, spring2 = xp.where(undelayed, -2.0 * f, spring1), xp.where(undelayed, 0.0, spring2)
    damper1 = xp.where(undelayed, 4.0 * f * u - 3.0 * f - 1.0, damper1)
    damper2 = xp.where(undelayed, 4.0 * f, damper2)
    linear, linear1, linear2 = a * spring - beta * damper, a * spring1 - beta * damper1, a * spring2 - beta * damper2
    gain = beta * (beta + 2.0 * a)
    needed, root = larger_root(linear, kappa * (a * a + 0.5 * gain * u), xp)
    # Stationary where this vanishes; its own slope is that of A there.
    slope = linear1 + 0.125 * kappa * gain / xp.where(needed > 0, needed, 1.0)
    return PeakCondition(slope, linear2, root, needed)


def _wave(u: Array, k: Array, xp: Any) -> tuple[Array, Array]:
    """Cosine and sine of ``k w`` in [0, pi], u in (0, 1]."""
    if xp is np:
        x = 2.0 * k * np.arcsin(np.sqrt(0.5 * u))
        return np.cos(x), np.sin(x)
    half = k * xp.sqrt(0.5 * u) * horner(2.0 * u - 1.0, ARCSINE)
    square = half * half
    sine, cosine = half * horner(square, SINE), horner(square, COSINE)
    return (cosine - sine) * (cosine + sine), 2.0 * sine * cosine


def peak(a: Array, beta: Array, delay: Delay, rise: Array) -> Array:
    """u of the one peak between w = 0 and pi, where it exists; ``rise`` is E at u = 0."""
    # The start, from ``(1 - x cot x)/x^2 = 2 sum 1/(i^2 pi^2 - x^2)``, is within a few per cent. An error of u enters
    # the height squared.
    f, k, _ = delay
    xp = namespace(a, f)
    period = k + f
    # b/(2 a (d + 1)) = (1 - x cot x)/x^2, as its inverse: a may be 0.
    ratio = 2.0 * a * period / (beta + a)
    y = np.pi**2 - 2.0 * ratio / xp.maximum(1.0 - 0.1307 * ratio, 0.5)
    y = np.pi**2 - 2.0 * ratio / xp.maximum(1.0 - (0.1307 + 0.00216 * y) * ratio, 0.5)
    end = xp.where(k == 1, 2.0, 2.0 * xp.sin(0.5 * np.pi / k) ** 2)
    # Below this the height is that at 0 to the last digit.
    floor = epsilon(a) ** 0.5 * end
    # 1 - cos w to 1e-3
    y = xp.maximum(y, 0.0) / (period * period)
    u = xp.minimum(xp.maximum(0.5 * y * (1.0 - y * (1.0 / 12.0 - y * (1.0 / 360.0))), floor), end)
    # Unrolled: XLA then makes one loop over the points out of all steps.
    for _ in range(_STEPS):
        here = condition(u, a, beta, delay)
        # Near the turn E is all but a straight line from its value at 0, and Newton's method may leave (0, end].
        new = u - here.slope / xp.where(here.bend < 0, here.bend, -1.0)
        chord = u * rise / xp.where(here.slope < 0, rise - here.slope, 1.0)
        u = xp.where(new > 0, new, chord)
        u = xp.minimum(xp.maximum(u, floor), end)
    return u


def needed_damping(alpha: Array, beta: Array, d: Array, kind: DelayClasses = ANY) -> Array:
    """The supremum over frequency of the damping needed, for alpha >= 0, elementwise, with its derivatives."""
    xp = namespace(alpha, beta, d)
    if not (kind.long or kind.fractional):
        return 0.5 * alpha + xp.abs(beta)
    delay = describe_delay(d)
    scale = frozen(alpha + xp.abs(beta), xp)
    scale = xp.where(scale > 0, scale, 1.0)
    a, beta = 0.5 * alpha / scale, beta / scale
    at_zero, rise, at_pi, reaches_pi = turns(a, beta, delay)
    rises = rise > 0
    inside = rises & ~reaches_pi
    # Where there is no peak, harmless values that have one.
    a_in, beta_in = xp.where(inside, a, 0.0), xp.where(inside, beta, 1.0)
    f_in = xp.where(inside, delay.f, 0.5)
    delay_in = Delay(f_in, delay.k, 4.0 * f_in * (1.0 - f_in))
    u = peak(*frozen((a_in, beta_in, delay_in, xp.where(inside, rise, 1.0)), xp))
    here = condition(u, a_in, beta_in, delay_in)
    # One more step, as its effect on the height: with it the second derivatives are right too.
    curvature = frozen(xp.where(here.bend < 0, here.bend * here.root / here.needed, -1.0), xp)
    height = here.needed - xp.where(here.bend < 0, 0.5 * here.slope * here.slope / curvature, 0.0)
    return scale * xp.where(rises, xp.where(reaches_pi, at_pi, height), at_zero)


def directions(d: Array) -> tuple[Array, Array]:
    """``beta/alpha`` between which the peak lies inside (0, pi): below at w = 0, above at w = pi (f < 2/9 only)."""
    xp = namespace(d)
    delay = describe_delay(d)
    f, k, _ = delay
    half, zero = 0.5 + 0.0 * d, 0.0 * d
    # E at w = 0 grows with beta. Without the pull of a fraction it vanishes at the first guess.
    _, short, by_beta = _rise(half, zero, delay._replace(kappa=zero))
    highest = -short / by_beta
    first, _ = newton(lambda beta: _rise(half, beta, delay)[1:], zero, highest, highest, _DIRECTION_STEPS)
    # (2 - 9 f) t^2 + (1 - 6 f) t = f
    ends = (k == 1) & (9.0 * f < 2.0)
    below = xp.where(ends, f, 0.0)
    last = 2.0 * below / (1.0 - 6.0 * below + xp.sqrt(1.0 - 4.0 * below))
    return first, xp.where(ends, last, xp.inf)
