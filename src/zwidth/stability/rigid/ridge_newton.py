"""Find the ridge, the point of maximum stiffness, by Newton's method on its closed-form optimality condition.

Points of the curve are given by s = sin(omega/2), y = s^2; T(s) = 0 is the condition, with T = dalpha/dy times a
positive factor (docs/theory/boundary.md, B2). The curve is the boundary curve (`stability.rigid.boundary_curve`), on
which the loop has a pole at z = e^(j omega); its first part is the stability *lobe*. n is the integer part of the
delay; gap, mu and sigma are fields of `Curve`.

The lobe has a single maximum of alpha (docs/theory/one-lobe.md, Theorem B), so no search is needed: a fitted start and
three Newton steps suffice. The maximum is smooth (T = 0), or it is the *corner* at y = 1, the wall with a double pole
at z = -1. The number of steps is fixed, because in a batch all points take the same steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import epsilon, horner, iterate, materialize, namespace, stop_gradient
from zwidth.plant.rigid_mass import ANY, DelayClasses, DiscretePlant, Plant
from zwidth.stability.rigid.boundary_curve import (
    Curve,
    evaluate_stationarity,
    evaluate_wall,
    evaluate_wave,
    expand_curve,
)
from zwidth.stability.rigid.characteristic_polynomial import recover_wall


class Corner(NamedTuple):
    """The wall with a double pole at z = -1, P(-1) = P'(-1) = 0."""

    alpha: Array
    beta: Array
    reached: Array  # True if the lobe ends in the corner
    is_ridge: Array  # True if the corner is the wall of maximum stiffness


def find_corner(curve: Curve, n: Array) -> Corner:
    """Return the corner, in which the lobe may end; it is the ridge if alpha increases up to the corner."""
    # The lobe ends in the corner only if n = 0 and the phase of M (`stability.rigid.characteristic_polynomial`)
    # increases up to omega = pi, i.e. gap > 0 and mu > 0.
    xp = namespace(curve.sigma, n)
    E = sum(curve.E[1:], curve.E[0])
    H = curve.H[0] + curve.H[1]
    value, slope = E - H, curve.E[1] + 2.0 * curve.E[2] - 2.0 * H - curve.H[1]
    V, dV = curve.gap**2, 4.0 * (curve.sigma * curve.gap - curve.mu**2)
    reached = (n <= 0.0) & (curve.gap > 0.0) & (curve.mu > 0.0) & (value > 0.0)
    is_ridge = reached & (V * (value + slope) - value * dV >= 0.0)
    # Replace V by 1 for devices without corner, because an overflow would have NaN derivatives, which would make the
    # selected derivatives NaN, too.
    V = xp.where(reached, V, 1.0)
    alpha = 4.0 * value / V
    return Corner(*recover_wall(alpha, E / V - 0.5 * alpha), reached, is_ridge)


class Start(NamedTuple):
    """The starting point of Newton's method."""

    scale: Array  # u = 1/(d + 1): s lies between 0.5 u and 1.3 u
    s: Array
    power: Array  # Newton's method is applied to T s^power
    corner: Array  # 1: (delta, d) implies that the ridge is the corner; -1: that it is smooth; 0: unknown


# Value of delta above which, for d = 0, the ridge is the corner. The exact threshold, 3.6593616274217835070, is 4e-18
# larger. The code compares delta, because a comparison of rounded coefficients of the curve would be wrong for
# neighboring float64 values of delta.
CORNER_DELTA = 3.6593616274217835

# Start of Newton's method: s/u as a polynomial in t and u, with t = r/(r + 3), r = delta (d + 1), u = 1/(d + 1), fitted
# over all devices. The error is at most 0.8 % for d < 1 and 1.1 % for d >= 1. Each row contains the coefficients of a
# polynomial in u, which is the coefficient of one power of t.
SHORT_START = (
    (0.3748, 0.6572, -0.7317, -0.01088, 0.2558),
    (-0.1878, 3.83, -4.872, 1.835),
    (1.511, -6.996, 5.233),
    (0.2643, 1.186),
    (-0.4501,),
)
LONG_START = ((0.542, -0.06693, 0.1218), (0.6279, 0.002018), (-0.1571,))
# Exponent ``power`` for d < 1, where Newton's method is applied to T s^power, because T alone is more curved. The
# exponent is fitted in the same form as the start.
SHORT_POWER = ((4.61, -11.6, 6.73), (-6.78, 10.3), (0.712,))
# Number of Newton steps; after two steps the error would be 5e-9.
NEWTON_STEPS = 3


def _evaluate_bivariate(t: Array, u: Array, rows: tuple[tuple[float, ...], ...]) -> Array:
    """Evaluate a polynomial in t whose coefficients are polynomials in u (``rows``), lowest powers first."""
    return horner(t, [horner(u, list(row)) for row in rows])


def guess_start(
    delta: Array, d: Array, fraction: Array, kind: DelayClasses = ANY, strength: Array | None = None
) -> Start:
    """Return the starting point of Newton's method from a fit over delta and d.

    ``strength``, if given, replaces t of `SHORT_START`; 1 is the limit delta -> infinity.
    """
    xp = namespace(delta, d)
    delta, d, f = stop_gradient((delta, d, fraction), xp)
    r = delta * (d + 1.0)
    u, t = 1.0 / (d + 1.0), r / (r + 3.0) if strength is None else strength
    s = power = corner = zero = 0.0 * u
    if kind.long:
        s = _evaluate_bivariate(t, u, LONG_START) + 0.4702 * f * (1.0 - f) * u * u * t
    if kind.short:
        short, low, bent = d < 1.0, _evaluate_bivariate(t, u, SHORT_START), _evaluate_bivariate(t, u, SHORT_POWER)
        s, power = (xp.where(short, low, s), xp.where(short, bent, zero)) if kind.long else (low, bent)
        corner = xp.where(d == 0.0, xp.where(delta > CORNER_DELTA, 1.0, -1.0), zero)
    return Start(u, s * u, power, corner)


class Ridge(NamedTuple):
    """The point of maximum stiffness of one plant."""

    alpha: Array
    beta: Array
    omega: Array
    s: Array  # sin(omega/2), exactly 1 at a corner
    last: Array  # the last step taken in s


def _find_stationary(curve: Curve, n: Array, start: Start, undelayed: bool) -> tuple[Array, Array]:
    """Return s at the smooth maximum and the last step in s, by Newton's method in a bracket around all ridges."""
    xp = namespace(curve.sigma, n)
    lower, upper = 0.5 * start.scale, xp.minimum(1.3 * start.scale, 1.0)
    s = xp.minimum(xp.maximum(start.s, lower), upper)

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        s, _ = state
        first, second = evaluate_stationarity(s, curve, n, undelayed)
        new = s - first * s / (second * s + start.power * first)
        return xp.minimum(xp.maximum(new, lower), upper), s

    s, before = iterate(NEWTON_STEPS, step, (s, s), xp)
    return s, s - before


def solve_ridge(plant: Plant | DiscretePlant, n: Array, start: Start, kind: DelayClasses) -> Ridge:
    """Return the ridge of one plant with a delay of n periods."""
    xp = namespace(plant.a2, n)
    undelayed = not kind.long
    curve = expand_curve(materialize(plant, start.scale))
    s, last = _find_stationary(curve, n, start, undelayed)
    # Keep s below 1, because a smooth maximum near the corner may round to 1.
    s = xp.minimum(s, 1.0 - 0.5 * epsilon(s))
    wave = evaluate_wave(s, n, undelayed)
    ridge = Ridge(*evaluate_wall(wave, curve), 2.0 * wave.half_omega, s, last)
    if not kind.short:
        return ridge
    corner = find_corner(curve, n)
    is_corner = xp.where(start.corner == 0.0, corner.is_ridge, start.corner > 0.0)
    corner_ridge = Ridge(corner.alpha, corner.beta, np.pi, 1.0, 0.0)
    return Ridge(*(xp.where(is_corner, end, value) for end, value in zip(corner_ridge, ridge, strict=True)))
