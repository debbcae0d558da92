"""Z-width as a number: the area of the passive walls in the (alpha, beta) plane.

Colgate's condition asks for ``needed = sup over omega`` of what `zwidth.stability.passivity.needed_damping_at` says. In
the direction ``alpha = cos(theta)/(d + 1/2)``, ``beta = sin(theta)`` the sup is attained

    at omega = 0                       for theta < theta1,
    at one omega that rises with theta for theta1 < theta < theta2,
    at omega = pi                      for theta > theta2, which happens for d < 1 only,

within the first half wave, omega (d + 1) < 1.1 pi, whatever the delay. It passes from one to the next without a jump
(for d = 0 all at once), and between them it is analytic in theta: omega itself starts like a root, but needed is even
in it. theta1 and theta2 are where its second derivative in omega changes sign at 0 and at pi.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import pointwise
from zwidth.loop import poison, valid_device
from zwidth.plant import split_delay
from zwidth.stability.golden import golden_section
from zwidth.stability.passivity import needed_damping_at

# Gauss-Legendre nodes a panel, and panels for each of the three parts.
_NODES, _PANELS = 16, (8, 12, 4)
_BISECTIONS = 52
# Samples over the first half wave, and steps of golden section round the highest.
_SAMPLES, _REFINEMENTS = 8, 45
_CHUNK, _LEAST = 1 << 8, 1 << 2


def passive_area(delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the area of the passive set in the (alpha, beta) plane.

    The condition is convex and homogeneous in (alpha, beta, delta): with ``needed(phi)`` the physical damping that
    the wall ``(cos phi, sin phi)`` needs, ``A = (delta^2/2) integral of needed(phi)^-2`` over phi from -pi/2 to pi/2.
    At d = 0 it is the triangle ``delta > alpha/2 + |beta|``: ``A = 2 delta^2``.

    Args:
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, whole or not (held). Both broadcast.

    Returns:
        Array of the broadcast shape; NaN out of range.

    Raises:
        InputError: an argument is no real number, or shapes do not broadcast.

    Numerics:
        Gauss-Legendre quadrature between the kinks of ``needed``: about 1e-13 relative, measured up to d = 100.
        Traceable, with first derivatives to about 1e-8, those in d at whole d from the right. Relies on the frequency
        that decides being 0 up to one direction and then rising within the first half wave, as 400 frequencies a half
        wave showed.

    References:
        Colgate, Brown 1994 (Z-width); Hulin, Preusche, Hirzinger 2006, eq. (21), here extended to any delay.

    Example:
        >>> from zwidth.design import passive_area
        >>> print(f"{passive_area(0.5, 0):.4f}")
        0.5000
    """
    return pointwise(_passive_area_kernel, ("delta", "d"), (delta, d), chunk=_CHUNK, least=_LEAST)


def _passive_area_kernel(delta: Array, d: Array) -> Array:
    ok = valid_device(delta, d)
    safe_d = jnp.where(ok, d, 1.0)
    first, last = (jax.lax.stop_gradient(theta) for theta in _turns(safe_d))
    unit = 1.0 / (safe_d + 0.5)

    def needed(omega: Array, theta: Array) -> Array:
        # The straight edge alpha = 0 is the range of theta: rounding must not lead beyond it.
        return needed_damping_at(omega, jnp.maximum(jnp.cos(theta), 0.0) * unit, jnp.sin(theta), safe_d)

    end = jnp.full_like(safe_d, 0.5 * np.pi)
    # The third part is empty for d >= 1, but must be finite there too: at omega = pi nothing at all may be needed.
    zero, pi = jnp.zeros_like(end), np.pi / (split_delay(safe_d)[0] + 1.0)
    parts = (
        _integral(lambda theta: needed(zero, theta) ** -2, -end, first, _PANELS[0]),
        _integral(lambda theta: needed(_highest(needed, theta, safe_d), theta) ** -2, first, last, _PANELS[1]),
        _integral(lambda theta: needed(pi, theta) ** -2, last, end, _PANELS[2]),
    )
    return 0.5 * delta * delta * unit * sum(parts) + poison(ok, delta, d)


def _integral(function: Callable[[Array], Array], low: Array, high: Array, panels: int) -> Array:
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    part = (np.arange(panels)[:, None] + 0.5 * (node + 1.0)).ravel() / panels
    values = jax.vmap(function)(low + (high - low) * jnp.asarray(part, low.dtype))
    return (high - low) * jnp.sum(values * jnp.asarray(np.tile(0.5 * weight / panels, panels), low.dtype))


def _highest(needed: Callable[[Array, Array], Array], theta: Array, d: Array) -> Array:
    """The frequency that decides; where its height is stationary, its own derivative does not matter."""
    theta, d = jax.lax.stop_gradient((theta, d))
    grid = jnp.minimum(np.pi, 1.25 * np.pi / (d + 1.0)) * jnp.linspace(0.0, 1.0, _SAMPLES + 1, dtype=d.dtype)
    top = jnp.argmax(jax.vmap(lambda omega: needed(omega, theta))(grid))

    low, high = grid[jnp.maximum(top - 1, 0)], grid[jnp.minimum(top + 1, _SAMPLES)]
    low, high = golden_section(lambda omega: -needed(omega, theta), low, high, _REFINEMENTS)
    return jax.lax.stop_gradient(0.5 * (low + high))


def _turns(d: Array) -> tuple[Array, Array]:
    """theta1 and theta2; with ``4 needed = -h + sqrt(h^2 + c)`` and the derivatives of h and c in omega^2 or s^2."""
    n, f = split_delay(d)
    unit = 1.0 / (d + 0.5)

    def rises(h: Array, dh: Array, c: Array, dc: Array) -> Array:
        """Positive where needed grows, for h < 0: free of cancellation."""
        return 0.5 * dc - dh * (jnp.sqrt(h * h + c) - h)

    def leaves_zero(theta: Array) -> Array:
        alpha, beta = jnp.cos(theta) * unit, jnp.sin(theta)
        # sin(k w)/sin(w/2) = 2 k (1 - (k^2 - 1/4) w^2/6 + ...)
        third = [k * (k * k - 0.25) / 3.0 for k in (n + 0.5, n + 1.5)]
        h = 2.0 * (beta - jnp.cos(theta))
        dh = alpha * ((1.0 - f) * third[0] + f * third[1]) - beta * ((1.0 - f) * (n + 1.0) ** 2 + f * (n + 2.0) ** 2)
        c, dc = 4.0 * f * (1.0 - f) * alpha**2, 4.0 * f * (1.0 - f) * beta * (alpha + beta)
        return rises(h, dh, c, dc) > 0

    def short_of_pi(theta: Array) -> Array:
        alpha, beta = jnp.cos(theta) * unit, jnp.sin(theta)
        # For n = 0 everything is a polynomial in s^2, here at s = 1.
        h = -(1.0 - 2.0 * f) * (alpha + 2.0 * beta)
        dh = 4.0 * f * alpha + 4.0 * beta * (5.0 * f - 1.0)
        dc = 16.0 * f * (1.0 - f) * (alpha + beta) * beta
        c = 4.0 * f * (1.0 - f) * (alpha * alpha) + dc
        return (n > 0) | (rises(h, dh, c, dc) < 0)

    # At theta = pi/4 of these units h vanishes at omega = 0, which has long ceased to decide.
    first = _last_before(lambda theta: ~leaves_zero(theta), jnp.zeros_like(d), jnp.full_like(d, 0.25 * np.pi))
    return first, _last_before(short_of_pi, first, jnp.full_like(d, 0.5 * np.pi))


def _last_before(holds: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Where something ceases to hold, by bisection."""

    def halve(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        inside = holds(middle)
        return jnp.where(inside, middle, low), jnp.where(inside, high, middle)

    return jax.lax.fori_loop(0, _BISECTIONS, halve, (low, high))[1]
