"""The ridge of the rigid loop by Newton's method on its closed-form optimality condition.

Curve and condition are written in ``y = s^2``, ``s = sin(omega/2)``, with D = lag + 1, lag = n, and the letters of
docs/theory/boundary.md, B1 and B2. A prime on that page is a trailing digit or a leading d in the code.

The lobe has one maximum (docs/theory/one-lobe.md, Theorem B), so no search is needed. The number of steps is fixed, so
that no point of a batch waits for another.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.held_mass import ANY, DelayClasses, DeviceTerms, Plant
from zwidth.words.types import Array
from zwidth.words.xp import ARCSINE, COSINE, SINE, epsilon, frozen, horner, namespace, repeat, store_once


class Curve(NamedTuple):
    """Coefficients in y of the curve of one device: all that the solver needs beside the exponent D."""

    E: tuple[Array, Array, Array]
    H: tuple[Array, Array]
    at_one: Array  # N(1)
    sigma: Array
    mu: Array
    gap: Array  # N(-1)


def expand_curve(plant: Plant | DeviceTerms) -> Curve:
    """The curve of one plant; every coefficient is free of cancellation where the ridge can be."""
    c, em, a2, a1, a0, gap = plant.c, plant.em, plant.a2, plant.a1, plant.a0, plant.gap
    sigma = a2 + a0
    at_one = sigma + a1
    E = (em * at_one, -2.0 * (4.0 * a0 - gap + em * sigma), 8.0 * a0)
    H = (a1 + a2 * c + a0 * (1.0 + em), -4.0 * a0)
    return Curve(E, H, at_one, sigma, a2 - a0, gap)


class Wave(NamedTuple):
    """What depends on the frequency and the exponent alone."""

    y: Array
    q: Array
    tau: Array
    kappa: Array
    # For the ridge:
    half: Any = None  # omega/2, of no meaning at the corner
    per_sin: Any = None  # 1/sin omega, of no meaning at the corner
    tau1: Any = None  # d tau/dy


def wave(s: Array, lag: Array, undelayed: bool) -> Wave:
    """The oscillating factors at one s, finite with their derivatives up to the corner. ``undelayed``: all D are 1."""
    xp = namespace(s, lag)
    y, q = s * s, (1.0 - s) * (1.0 + s)
    cos_w = q - y
    # At the corner D = 1, and what the root enters is 0.
    root = xp.sqrt(xp.where(s < 1.0, q, 1.0))
    low = y < 0.5
    small = xp.where(low, s, root)
    half = small * horner(4.0 * small * small - 1.0, ARCSINE)
    half = xp.where(low, half, 0.5 * np.pi - half)
    per_sin = 0.5 / (s * root)
    if undelayed:
        return Wave(y, q, 1.0, cos_w, half, per_sin, 0.0)
    # D omega as omega + lag omega: nothing cancels near pi, and D = 1 keeps its derivatives in D.
    D, x = lag + 1.0, lag * half
    square = x * x
    sine, cosine = x * horner(square, SINE), horner(square, COSINE)
    ratio, cosine = 2.0 * sine * cosine * per_sin, 1.0 - 2.0 * sine * sine
    sin2 = 4.0 * y * q
    tau, kappa = cosine + cos_w * ratio, cos_w * cosine - sin2 * ratio
    # For D = 1 kappa is cos omega and D kappa - tau cos omega exactly 0.
    tau1 = (lag * cos_w * cosine - ratio * (D * sin2 + cos_w * cos_w)) * (2.0 * per_sin * per_sin)
    return Wave(y, q, tau, kappa, half, per_sin, tau1)


def wave_at(omega: Array, lag: Array) -> Wave:
    """Return the factors that `wall` needs at a frequency from 0 to pi, for an integer lag."""
    xp = namespace(omega, lag)
    s, cos_half = xp.sin(0.5 * omega), xp.abs(xp.cos(0.5 * omega))
    y, q = s * s, cos_half * cos_half
    D = lag + 1.0
    # Above 2 use pi - omega; the second part of pi, added separately, keeps its last digits.
    sign, beyond = 1.0 - 2.0 * xp.mod(D, 2.0), omega > 2.0
    x = xp.where(beyond, (np.pi - omega) + 1.2246467991473532e-16, omega)
    tau = xp.where(beyond, -sign, 1.0) * D * _cardinal_sine(D * x) / _cardinal_sine(x)
    return Wave(y, q, tau, xp.where(beyond, sign, 1.0) * xp.cos(D * x))


def _cardinal_sine(x: Array) -> Array:
    """``sin(x)/x``, for small x by its series: the quotient has no digit of its derivatives there."""
    xp = namespace(x)
    small = xp.abs(x) < 1.5
    inner, outer = xp.where(small, x, 0.0), xp.where(small, 2.0, x)
    return xp.where(small, horner(inner * inner, SINE), xp.sin(outer) / outer)


def _sides(at: Wave, curve: Curve) -> tuple[Array, Array, Array, Array]:
    """E, H, m and V at one s."""
    xp = namespace(at.y, curve.sigma)
    E = curve.E[0] + at.y * (curve.E[1] + at.y * curve.E[2])
    H = curve.H[0] + at.y * curve.H[1]
    # Free of cancellation at both ends.
    m = xp.where(at.y < 0.5, curve.at_one - 2.0 * curve.sigma * at.y, 2.0 * curve.sigma * at.q - curve.gap)
    return E, H, m, m * m + curve.mu * curve.mu * (4.0 * at.y * at.q)


def wall(at: Wave, curve: Curve) -> tuple[Array, Array]:
    """(alpha, beta) of the curve at one s."""
    E, H, _, V = _sides(at, curve)
    per_V = 1.0 / V
    alpha = 4.0 * at.y * (at.tau * E + at.kappa * H) * per_V
    return alpha, -(at.kappa * E - 4.0 * at.y * at.q * at.tau * H) * per_V - 0.5 * alpha


def stationarity(s: Array, curve: Curve, lag: Array, undelayed: bool = False) -> tuple[Array, Array]:
    """T of B2, and dT/ds."""
    at = wave(s, lag, undelayed)
    y, q, tau, kappa, tau1 = at.y, at.q, at.tau, at.kappa, at.tau1
    E, H, m, V = _sides(at, curve)
    cos_w, k2, twice = q - y, curve.mu * curve.mu, 2.0 * (lag + 1.0)
    tau2 = 0.0 if undelayed else -(1.5 * cos_w * tau1 + lag * (lag + 2.0) * tau) * (4.0 * at.per_sin * at.per_sin)
    dE, dH = curve.E[1] + 2.0 * y * curve.E[2], curve.H[1]
    dV, ddV = 4.0 * (k2 * cos_w - curve.sigma * m), 8.0 * (curve.sigma * curve.sigma - k2)
    value = tau * E + kappa * H
    slope = tau1 * E + tau * (dE - twice * H) + kappa * dH
    bend = tau2 * E + tau1 * (2.0 * dE - twice * H) + 2.0 * tau * (curve.E[2] - twice * dH)
    weighted = y * value
    first = V * (value + y * slope) - weighted * dV
    return first, 2.0 * s * (V * (2.0 * slope + y * bend) - weighted * ddV)


class Corner(NamedTuple):
    """The wall with a double pole at z = -1, P(-1) = P'(-1) = 0."""

    alpha: Array
    beta: Array
    reached: Array  # whether the lobe ends there
    is_ridge: Array  # and whether it is the stiffest stable wall


def corner(curve: Curve, lag: Array) -> Corner:
    """The corner: where the lobe reaches y = 1 with alpha > 0, the ridge if it is still rising there."""
    # The curve gets there on the first lobe only if D = 1 and if arg M grows up to pi: N(-1) > 0, mu > 0.
    xp = namespace(curve.sigma, lag)
    E = sum(curve.E[1:], curve.E[0])
    H = curve.H[0] + curve.H[1]
    value, slope = E - H, curve.E[1] + 2.0 * curve.E[2] - 2.0 * H - curve.H[1]
    V, dV = curve.gap**2, 4.0 * (curve.sigma * curve.gap - curve.mu**2)
    reached = (lag <= 0.0) & (curve.gap > 0.0) & (curve.mu > 0.0) & (value > 0.0)
    is_ridge = reached & (V * (value + slope) - value * dV >= 0.0)
    # Elsewhere nothing may overflow: its derivative would be NaN and spoil what is chosen instead.
    V = xp.where(reached, V, 1.0)
    alpha = 4.0 * value / V
    return Corner(alpha, E / V - 0.5 * alpha, reached, is_ridge)


class Start(NamedTuple):
    """Where the solver begins."""

    scale: Array  # u = 1/(d + 1): s lies between 0.5 u and 1.3 u
    s: Array
    power: Array  # Newton's method is applied to T s^power
    corner: Array  # whether the ridge is a corner, where (delta, d) alone says so: 1 yes, -1 no, 0 unknown


# The last smooth delta at d = 0: the corner takes over at 3.6593616274217835070, 4e-18 above this float64. Judged by
# rounded coefficients of the curve, its next neighbors would fall on either side.
_TAKE_OVER = 3.6593616274217835

# s/u as a polynomial in t = r/(r + 3), r = delta (d + 1), and u, fitted over all devices: within 0.8 % below one
# period, 1.1 % beyond.
_SHORT = (
    (0.3748, 0.6572, -0.7317, -0.01088, 0.2558),
    (-0.1878, 3.83, -4.872, 1.835),
    (1.511, -6.996, 5.233),
    (0.2643, 1.186),
    (-0.4501,),
)
_LONG = ((0.542, -0.06693, 0.1218), (0.6279, 0.002018), (-0.1571,))
# Power of s in `Start` below one period, where T has a larger curvature.
_POWER = ((4.61, -11.6, 6.73), (-6.78, 10.3), (0.712,))
_STEPS = 3  # Newton steps; two leave an error of 5e-9


def _polynomial(t: Array, u: Array, rows: tuple[tuple[float, ...], ...]) -> Array:
    return horner(t, [horner(u, list(row)) for row in rows])


def guess_start(
    delta: Array, d: Array, fraction: Array, kind: DelayClasses = ANY, strength: Array | None = None
) -> Start:
    """Where to begin for one (delta, d); ``strength`` 1 stands for delta -> infinity."""
    xp = namespace(delta, d)
    delta, d, f = frozen((delta, d, fraction), xp)
    r = delta * (d + 1.0)
    u, t = 1.0 / (d + 1.0), r / (r + 3.0) if strength is None else strength
    s = power = corner = zero = 0.0 * u
    if kind.long:
        s = _polynomial(t, u, _LONG) + 0.4702 * f * (1.0 - f) * u * u * t
    if kind.short:
        short, low, bent = d < 1.0, _polynomial(t, u, _SHORT), _polynomial(t, u, _POWER)
        s, power = (xp.where(short, low, s), xp.where(short, bent, zero)) if kind.long else (low, bent)
        corner = xp.where(d == 0.0, xp.where(delta > _TAKE_OVER, 1.0, -1.0), zero)
    return Start(u, s * u, power, corner)


class Ridge(NamedTuple):
    """The ridge of one plant: s is exactly 1 at a corner, ``last`` the last step taken in s."""

    alpha: Array
    beta: Array
    omega: Array
    s: Array
    last: Array


def _find_stationary(curve: Curve, lag: Array, start: Start, undelayed: bool) -> tuple[Array, Array]:
    """Return s at the smooth maximum and the last step, by Newton's method in a bracket that contains every ridge."""
    xp = namespace(curve.sigma, lag)
    lower, upper = 0.5 * start.scale, xp.minimum(1.3 * start.scale, 1.0)
    s = xp.minimum(xp.maximum(start.s, lower), upper)

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        s, _ = state
        first, second = stationarity(s, curve, lag, undelayed)
        new = s - first * s / (second * s + start.power * first)
        return xp.minimum(xp.maximum(new, lower), upper), s

    s, before = repeat(_STEPS, step, (s, s), xp)
    return s, s - before


def solve(plant: Plant | DeviceTerms, lag: Array, start: Start, kind: DelayClasses) -> Ridge:
    """Return the ridge of one plant with an integer delay of ``lag`` periods."""
    xp = namespace(plant.a2, lag)
    undelayed = not kind.long
    curve = expand_curve(store_once(plant, start.scale))
    s, last = _find_stationary(curve, lag, start, undelayed)
    # Keep s below 1, because a smooth maximum near the corner may round to 1.
    s = xp.minimum(s, 1.0 - 0.5 * epsilon(s))
    at = wave(s, lag, undelayed)
    ridge = Ridge(*wall(at, curve), 2.0 * at.half, s, last)
    if not kind.short:
        return ridge
    at_end = corner(curve, lag)
    taken = xp.where(start.corner == 0.0, at_end.is_ridge, start.corner > 0.0)
    there = Ridge(at_end.alpha, at_end.beta, np.pi, 1.0, 0.0)
    return Ridge(*(xp.where(taken, end, value) for end, value in zip(there, ridge, strict=True)))
