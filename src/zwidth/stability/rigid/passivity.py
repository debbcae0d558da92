"""Test and measure the passivity of walls on rigid devices (Colgate's condition), for any delay.

The wall with the normalized stiffness alpha and damping beta is passive if the physical damping delta exceeds a bound
at every frequency (docs/theory/passivity.md). The *needed damping* is the maximum of this bound over frequency
(`stability.rigid.required_damping`). It is convex and homogeneous in (alpha, beta), so the passive walls of all devices
with the same delay d form one convex set, scaled by delta.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import namespace, nan_with_nan_derivatives, stop_gradient
from zwidth.numerics.evaluate import as_number, check_scalars, evaluate
from zwidth.numerics.root_finding import integrate
from zwidth.plant.rigid_mass import ANY, DelayClasses, classify_delays, is_valid_device
from zwidth.stability.passivity import limit_margin
from zwidth.stability.rigid.broadcasting import NAMES
from zwidth.stability.rigid.normalization import valid_wall
from zwidth.stability.rigid.required_damping import compute_needed_damping, find_directions

# Rounds of the search in `passive_stiffness_slope`; each narrows the bracket of the direction by a factor of 8.
SEARCH_ROUNDS = 17
NO_DELAY = DelayClasses(True, False, False)


def _margin_kernel(alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses) -> Array:
    """Compute `passivity_margin` elementwise, for the classes of delays ``kind``."""
    xp = namespace(alpha, beta, delta, d)
    valid = valid_wall(alpha, beta, delta, d)
    # Select by alpha >= 0 and do not use the maximum of alpha and 0, because that would halve the derivative at 0.
    safe_alpha = xp.where(valid & (alpha >= 0), alpha, 0.0)
    safe_beta, safe_d = xp.where(valid, beta, 0.0), xp.where(valid, d, 0.0)
    margin = delta - compute_needed_damping(safe_alpha, safe_beta, safe_d, kind)
    return limit_margin(margin, alpha) + nan_with_nan_derivatives(valid, alpha, beta, delta, d)


def compute_margins(alpha: np.ndarray, beta: np.ndarray, delta: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Compute `passivity_margin` of walls with one delay in NumPy; no result depends on the other points."""
    with np.errstate(all="ignore"):
        return _margin_kernel(alpha, beta, delta, d, NO_DELAY if classify_delays(d) == NO_DELAY else ANY)


def passivity_margin(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the margin by which the physical damping exceeds the damping that passivity requires.

    ``margin = delta - sup_w needed(w)``, in units of delta = b T/m. The wall is passive if and only if the margin is
    positive. At d = 0 it is ``delta - alpha/2 - |beta|``, eq. (21).

    Args:
        alpha: normalized stiffness; no damping makes a wall of negative stiffness passive, and its margin is at most
            alpha itself.
        beta: normalized virtual damping.
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, integer or fractional. All four broadcast.

    Returns:
        Array of the broadcast shape; NaN for a point out of range.

    Numerics:
        The error is about 1e-15 of the damping needed, at a cost independent of d. The frequency of the maximum is
        proved for integer d and was verified numerically for fractional d (`stability.rigid.required_damping`).
        Traceable, with two derivatives. In d at integer d and in alpha at alpha = 0 they are those from the right; in
        beta at beta = 0 and d = 0 that from below; without a wall (alpha = beta = 0) they are 0 if the maximum is a
        peak.

    References:
        Colgate, Schenkel 1994; Hulin, Preusche, Hirzinger 2006, eqs. (20), (21), here extended to any delay.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.passivity_margin(0.2, 0.3, 1.0, 0):.2f}")
        0.60
    """
    return _evaluate(_margin_kernel, (alpha, beta, delta, d))


def is_passive(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """Return whether the wall is passive, i.e. `passivity_margin` > 0, for any delay.

    Passive implies stable for alpha > 0; stable does not imply passive.

    Args:
        alpha, beta, delta, d: as for `passivity_margin`.

    Returns:
        Boolean array of the broadcast shape; False for a point out of range. Rounding errors matter only within about
        1e-15 of the boundary of the passive set.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (21), here extended to any delay.

    Example:
        >>> import zwidth
        >>> bool(zwidth.is_passive(0.2, 0.3, 1.0, 0)), bool(zwidth.is_passive(0.2, 0.9, 1.0, 0))
        (True, False)
    """
    return _evaluate(_passive_kernel, (alpha, beta, delta, d))


def _evaluate(kernel: Callable[..., Array], values: tuple[ArrayLike, ...]) -> Array:
    """Evaluate a kernel for alpha, beta, delta and d; if all delays are 0, use its simpler form for d = 0."""
    kind = classify_delays(values[3])
    return evaluate(kernel, dict(zip(NAMES, values, strict=True)), NO_DELAY if kind == NO_DELAY else ANY)


def _passive_kernel(alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses) -> Array:
    """Return whether each wall is passive, elementwise."""
    return _margin_kernel(alpha, beta, delta, d, kind) > 0


def passive_stiffness_slope(d: float) -> tuple[float, float]:
    """Return alpha/delta and beta/delta of the stiffest passive wall for one delay."""
    check_scalars({"d": d})
    delay = as_number("d", d, 0.0)
    period = delay + 1.0
    if period == np.floor(period):
        # Use the frequency with cos((d + 1) w) = 0, at which the virtual damping has no effect on the condition.
        angle = np.pi / (4.0 * period)
        slope = 2.0 * np.tan(angle)
        return float(slope), float(slope * (0.25 / (period * np.sin(angle) ** 2) - 0.5))
    unit = 1.0 / (period - 0.5)

    def stiffness(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        alpha, beta = unit * np.cos(angles), np.sin(angles)
        needed = compute_needed_damping(alpha, beta, np.full(angles.shape, delay))
        return alpha / needed, beta / needed

    lower, upper = -0.49 * np.pi, 0.49 * np.pi
    # The passive set is convex, so its boundary, parameterized by the angle of (alpha, beta), has one maximum of alpha.
    with np.errstate(all="ignore"):
        for _ in range(SEARCH_ROUNDS):
            angles = np.linspace(lower, upper, 17)
            best = int(np.argmax(stiffness(angles)[0]))
            lower, upper = angles[max(best - 1, 0)], angles[min(best + 1, 16)]
        alpha, beta = stiffness(np.array([0.5 * (lower + upper)]))
    return float(alpha[0]), float(beta[0])


# Numbers of Gauss-Legendre nodes on the three parts of the range of directions; the integrand is analytic on each
# part.
AREA_NODES = (64, 64, 32)
# Computing cost of a point relative to other kernels, because the integrand is evaluated at all nodes.
AREA_WEIGHT = 64


def passive_area(delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the area of the passive set in the (alpha, beta) plane.

    The condition is convex and homogeneous in (alpha, beta, delta): with ``needed(phi)`` the physical damping that
    the wall ``(cos phi, sin phi)`` needs, ``A = (delta^2/2) integral of needed(phi)^-2`` over phi from -pi/2 to pi/2.
    At d = 0 it is the triangle ``delta > alpha/2 + |beta|``: ``A = 2 delta^2``.

    Args:
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, integer or fractional. Both broadcast.

    Returns:
        Array of the broadcast shape; NaN for a point out of range.

    Numerics:
        Gauss-Legendre quadrature between the kinks of ``needed``: about 1e-14 relative, at a cost independent of d.
        Traceable, with derivatives; at integer d the derivatives in d are those from the right.

    References:
        Colgate, Brown 1994 (Z-width); Hulin, Preusche, Hirzinger 2006, eq. (21), here extended to any delay.

    Example:
        >>> from zwidth import passive_area
        >>> print(f"{passive_area(0.5, 0):.4f}")
        0.5000
    """
    return evaluate(_passive_area_kernel, {"delta": delta, "d": d}, weight=AREA_WEIGHT)


def _passive_area_kernel(delta: Array, d: Array) -> Array:
    """Return `passive_area`, elementwise, by an integral over the direction theta.

    The walls are ``alpha = cos(theta)/(d + 1/2)``, ``beta = sin(theta)``. The damping needed is analytic in theta on
    each of three parts: below the lower direction of `find_directions` the maximum is at omega = 0, above the upper one
    (d < 2/9 only) at pi, and in between at a frequency that increases with theta continuously.
    """
    xp = namespace(delta, d)
    valid = is_valid_device(delta, d)
    safe_d = xp.where(valid, d, 1.0)
    unit = 1.0 / (safe_d + 0.5)
    # Compute the ends of the parts without derivatives, because errors of the ends have no effect of first order.
    lower, upper = (xp.arctan(t * stop_gradient(unit, xp)) for t in find_directions(stop_gradient(safe_d, xp)))
    end = 0.5 * np.pi + 0.0 * safe_d

    def integrand(theta: Array) -> Array:
        # At theta = +-pi/2 alpha is 0, and a rounding error must not make it negative.
        alpha = xp.maximum(xp.cos(theta), 0.0) * unit[..., None]
        return compute_needed_damping(alpha, xp.sin(theta), safe_d[..., None] + 0.0 * theta) ** -2

    inverse_squares = integrate(integrand, (-end, lower, upper, end), AREA_NODES)
    return 0.5 * delta * delta * unit * inverse_squares + nan_with_nan_derivatives(valid, delta, d)
