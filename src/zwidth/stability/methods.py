"""Stable or not, and the spectral radius: one entry each, a choice of methods behind it."""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike, DelayModel
from zwidth.batching import is_traced, to_caller
from zwidth.errors import InputError, check_choice
from zwidth.loop import check_has_poles
from zwidth.stability.boundary_map import boundary_map
from zwidth.stability.layout import Points, lay_out, point_ok
from zwidth.stability.poles import radius_by_companion
from zwidth.stability.schur_cohn import schur_cohn_map
from zwidth.status import Status

StabilityMethod = Literal["companion", "schur_cohn", "boundary", "certified"]
STABILITY_METHODS: tuple[str, ...] = ("companion", "schur_cohn", "boundary", "certified")


class Stability(NamedTuple):
    """Labels with the reason where there is none."""

    stable: Array
    status: Array


def is_stable(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: StabilityMethod = "companion",
    delay: DelayModel = "held",
) -> Array:
    """Whether every pole of the loop lies strictly inside the unit circle.

    ``stable = max |z| < 1`` over the zeros of `zwidth.char_poly`.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not; concrete also inside `jit`. All four broadcast.
        method: "companion" (eigenvalues, the reference), "schur_cohn" (a recursion, fast for short delays),
            "boundary" (a limit for each row, fastest for maps and long delays) or "certified" (proved, or no label).
        delay: only "held" has poles.

    Returns:
        Boolean array of the broadcast shape. False where the input is out of range and, for "certified", where
        there is no proof; `zwidth.stability_of` tells these apart.

    Raises:
        InputError: an argument is no real number, shapes do not broadcast, or a name is unknown; inside somebody's
            own transformation, any method but "companion".
        TracedDelayError: d is traced.

    Numerics:
        Float64 when called directly. Labels are right beyond about 1e-13 of the boundary (relative, in alpha), for
        "schur_cohn" 1e-12, and 1e-9 from d = 20 on; those of "certified" are theorems about the float64 inputs.

    References:
        Hulin, Preusche, Hirzinger 2006, section V.

    Example:
        >>> import zwidth
        >>> bool(zwidth.is_stable(0.1, 0.4, 0.1, 1)), bool(zwidth.is_stable(0.2, 0.4, 0.1, 1))
        (True, False)
    """
    if is_traced(alpha, beta, delta, d):
        check_has_poles(delay)
        _only_companion(method)
        return radius_by_companion(alpha, beta, delta, d) < 1.0
    return stability_of(alpha, beta, delta, d, method=method, delay=delay).stable


def stability_of(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: StabilityMethod = "companion",
    delay: DelayModel = "held",
) -> Stability:
    """`is_stable` with a status for every point.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not, concrete. All four broadcast.
        method: as for `is_stable`.
        delay: only "held" has poles.

    Returns:
        Stability: ``stable``, False wherever ``status`` is not 0; ``status``, see `zwidth.Status`: INVALID_INPUT,
        and for "certified" also ON_BOUNDARY and UNDECIDED.

    Raises:
        InputError: an argument is no real number, shapes do not broadcast, or a name is unknown.

    References:
        Hulin, Preusche, Hirzinger 2006, section V.

    Example:
        >>> import zwidth
        >>> zwidth.stability_of([0.1, float("nan")], 0.4, 0.1, 1).status.tolist()
        [0, 1]
    """
    check_has_poles(delay)
    check_choice("method", method, STABILITY_METHODS)
    values = (alpha, beta, delta, d)
    if method == "certified":
        from zwidth.stability.certified import certified_stable

        proved = certified_stable(*values)
        return to_caller(Stability(proved.stable, proved.status), values)
    laid = lay_out(values)
    points = laid.points
    if method == "companion":
        labels = np.asarray(radius_by_companion(*points) < 1.0)
    elif method == "schur_cohn":
        labels = schur_cohn_map(points)
    else:
        labels = _by_boundary(points)
    status = np.where(point_ok(points), Status.OK, Status.INVALID_INPUT)
    return to_caller(Stability(laid.spread(labels), laid.spread(status)), values)


def _by_boundary(points: Points) -> np.ndarray:
    """The boundary's labels, and those of the poles where the shape of the stable set has not been verified."""
    labels, known = boundary_map(points)
    unknown = ~np.broadcast_to(known, points.shape)
    if not unknown.any():
        return labels
    labels = np.array(labels)
    labels[unknown] = np.asarray(radius_by_companion(*(part[unknown] for part in np.broadcast_arrays(*points)))) < 1.0
    return labels


def _only_companion(method: str) -> None:
    check_choice("method", method, STABILITY_METHODS)
    if method != "companion":
        raise InputError(
            f"method: got {method!r} inside a JAX transformation, where only 'companion' works; "
            "call the function directly for the others"
        )


def spectral_radius(
    alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike, *, delay: DelayModel = "held"
) -> Array:
    """Return the largest pole magnitude of the loop.

    ``rho = max |z|`` over the zeros of `zwidth.char_poly`; the loop is stable when it is below 1.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not; concrete also inside `jit`. All four broadcast.
        delay: only "held" has poles.

    Returns:
        Array of the broadcast shape; NaN where the input is out of range.

    Raises:
        InputError: an argument is no real number, shapes do not broadcast, or ``delay="fractional_power"``.
        TracedDelayError: d is traced.

    Numerics:
        Companion eigenvalues, polished on the factored polynomial: about 1e-15 for a simple largest pole, about
        1e-8 where two coincide. O(degree^3) a point.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.spectral_radius(0.1, 0.4, 0.1, 1):.4f}")
        0.8763
    """
    check_has_poles(delay)
    if is_traced(alpha, beta, delta, d):
        return jnp.asarray(radius_by_companion(alpha, beta, delta, d))
    return radius_by_companion(alpha, beta, delta, d)
