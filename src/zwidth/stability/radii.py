"""The spectral radius of arrays of walls, by a method of one's choice."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from zwidth import accuracy as costs
from zwidth._types import Array, ArrayLike, DelayModel
from zwidth.batching import is_traced, to_caller
from zwidth.errors import InputError, check_choice
from zwidth.loop import check_has_poles
from zwidth.stability import traced
from zwidth.stability.layout import Points, lay_out, point_ok
from zwidth.stability.radius_map import COMPANION_POLES, Radii, bisected, by_companion, by_newton
from zwidth.status import Method, Status

RadiusMethod: TypeAlias = Literal["auto", "companion", "bisection", "newton"]
RADIUS_METHODS: tuple[str, ...] = get_args(RadiusMethod)

# "auto" takes companion eigenvalues, with all digits, for so few points of delays up to this.
_FEW_POINTS = 1 << 12
_FEW_PERIODS = 32.0
_DEFAULT_ACCURACY = 1e-9
# Closer in, the rounding errors of its own test would spoil Newton's certificate.
_LEAST_CERTIFIED = 1e-10
_LEAST_BISECTED = 1e-14


class Radius(NamedTuple):
    """Spectral radii with absolute error bounds, certificates, status and `Method`, all of the broadcast shape."""

    radius: Array
    error: Array
    certified: Array
    status: Array
    method: Array


def spectral_radius(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: RadiusMethod = "auto",
    accuracy: float | None = None,
    delay: DelayModel = "held",
) -> Array:
    """Return the spectral radius of the loop: the modulus of its largest pole.

    ``max |z|`` over ``P(z) = 0``, see `zwidth.char_poly`; the loop is stable where it is below 1. One period multiplies
    a slowly decaying motion by it.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not, mixed in one array. All four broadcast; for a map pass alpha of shape
            (1, N) and beta of shape (M, 1).
        method: "newton" follows the largest pole across a map (scattered points start from a coarse bisection) and
            proves each value; "bisection" halves an interval by the Schur-Cohn test; "companion" computes all poles.
            "auto" is "companion" for fewer than 4096 points of d <= 32, else "newton"; where an accuracy is given, the
            cheapest that was measured to keep it, see `zwidth.accuracy.choose`.
        accuracy: relative error asked for; 1e-9 by default. At least 1e-10 for "newton", 1e-14 for "bisection".
        delay: only "held" has poles.

    Returns:
        Array of the broadcast shape, maybe read-only. NaN for a point out of range.

    Raises:
        InputError: an argument is no real number, shapes do not broadcast, a name is unknown, or the accuracy is out
            of the method's reach.
        TracedDelayError: d is traced.

    Numerics:
        Float64 when called directly, the ambient precision inside `jit` (methods "companion" and "bisection"; "auto"
        is "companion"). Error bounds and certificates come from `radius_of`. Near a double pole the radius itself is
        uncertain by about 1e-8, and bisection by 1e-5.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17); Schur 1918; Cohn 1922.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.spectral_radius(0.5, 0.5, 0.1, 1):.6f}")
        1.207346
    """
    values = (alpha, beta, delta, d)
    wanted = _check_radius(method, accuracy, delay)
    if is_traced(*values):
        return traced.radius(values, method, wanted)
    laid = lay_out(values)
    radii, _ = _radii(laid.points, method, wanted, asked=accuracy is not None)
    found = radii.radius if np.all(ok := point_ok(laid.points)) else np.where(ok, radii.radius, np.nan)
    return to_caller(laid.spread(found), values)


def radius_of(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: RadiusMethod = "auto",
    accuracy: float | None = None,
    delay: DelayModel = "held",
) -> Radius:
    """Return the spectral radius with an error bound for every point.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0. All four broadcast.
        method: as for `zwidth.spectral_radius`.
        accuracy: as for `zwidth.spectral_radius`.
        delay: only "held" has poles.

    Returns:
        Radius: ``radius``; ``error``, absolute: where ``certified``, a pole was shown to lie within the error of
        ``radius`` and all poles inside ``radius + error``, in float64 arithmetic and with rounding errors that could
        not have decided either. Elsewhere it bounds the last interval (bisection), or the distance from the largest
        computed pole to a true one (companion). ``status``: INVALID_INPUT with NaN for a point out of range,
        NOT_CONVERGED where no bound was found; ``method``, a `Method`: points that Newton's method leaves open are
        COMPANION or BISECTION. Arrays may be read-only.

    Raises:
        InputError: an argument is no real number or traced, shapes do not broadcast, a name is unknown, or the
            accuracy is out of the method's reach.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17); Schur 1918; Cohn 1922.

    Example:
        >>> from zwidth.stability.radii import radius_of
        >>> found = radius_of(0.5, 0.5, 0.1, 1, method="newton")
        >>> bool(found.certified), f"{found.radius:.6f}"
        (True, '1.207346')
    """
    values = (alpha, beta, delta, d)
    wanted = _check_radius(method, accuracy, delay)
    _refuse_traced(values, "radius_of", "spectral_radius")
    laid = lay_out(values)
    radii, used = _radii(laid.points, method, wanted, asked=accuracy is not None)
    ok = np.broadcast_to(point_ok(laid.points), laid.points.shape)
    bounded = np.isfinite(radii.error)
    status = np.where(ok, np.where(bounded, Status.OK, Status.NOT_CONVERGED), Status.INVALID_INPUT)
    found = np.where(ok, radii.radius, np.nan)
    error = np.where(ok, np.where(bounded, radii.error, np.inf), np.nan)
    everything = (found, error, radii.certified & ok, status.astype(np.int32), np.asarray(used, np.int32))
    return to_caller(Radius(*map(laid.spread, everything)), values)


def _check_radius(method: str, accuracy: float | None, delay: str) -> float:
    check_has_poles(delay)
    check_choice("method", method, RADIUS_METHODS)
    if accuracy is None:
        return _DEFAULT_ACCURACY
    least = {"newton": _LEAST_CERTIFIED, "bisection": _LEAST_BISECTED}.get(method, 0.0)
    if not (np.ndim(accuracy) == 0 and np.isfinite(accuracy) and least <= accuracy < 1 and accuracy > 0):
        raise InputError(
            f"accuracy: got {accuracy!r}; a relative error of at least {least:g} and below 1 is needed for "
            f"method={method!r}; 'companion' takes any"
        )
    return float(accuracy)


def _radii(points: Points, method: str, accuracy: float, asked: bool) -> tuple[Radii, Any]:
    """Results, and the `Method` of each point (or one for all)."""
    if method == "auto" and asked:
        method = "companion" if accuracy < _LEAST_CERTIFIED else _cheapest("spectral_radius", points, accuracy).method
    elif method == "auto":
        few = points.size < _FEW_POINTS and not np.any(points.d > _FEW_PERIODS)
        method = "companion" if few else "newton"
    if method == "companion":
        return by_companion(points), Method.COMPANION
    if method == "bisection":
        return bisected(points, accuracy), Method.BISECTION
    found = by_newton(points, accuracy)
    whole = np.floor(points.d)
    otherwise = np.where(whole + 3 + (points.d != whole) <= COMPANION_POLES, Method.COMPANION, Method.BISECTION)
    return found, np.where(found.certified, Method.NEWTON, otherwise)


def _cheapest(quantity: costs.Quantity, points: Points, accuracy: float) -> costs.Choice:
    good = points.d[np.isfinite(points.d)]
    longest = float(np.max(good, initial=0.0))
    layout: costs.Layout = "map" if points.is_dense else "scattered"
    return costs.choose(quantity, d=longest, points=points.size, layout=layout, accuracy=accuracy)


def _refuse_traced(values: tuple[ArrayLike, ...], name: str, instead: str) -> None:
    if is_traced(*values):
        raise InputError(f"{name}: got traced values; inside a JAX transformation use `zwidth.{instead}`")
