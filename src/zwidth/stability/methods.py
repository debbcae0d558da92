"""Stability and spectral radius of whole arrays, by a method of one's choice."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from zwidth import accuracy as costs
from zwidth._types import Array, ArrayLike, DelayModel
from zwidth.batching import is_traced, to_caller
from zwidth.errors import InputError, check_choice
from zwidth.loop import check_has_poles
from zwidth.stability import traced
from zwidth.stability.boundary_map import boundary_map
from zwidth.stability.layout import Points, lay_out, picked, point_ok
from zwidth.stability.poles import unstable_poles
from zwidth.stability.radius_map import COMPANION_POLES, Radii, bisected, by_companion, by_newton
from zwidth.stability.schur_cohn import schur_cohn_map
from zwidth.status import Status

StabilityMethod: TypeAlias = Literal["auto", "companion", "schur_cohn", "boundary", "certified"]
RadiusMethod: TypeAlias = Literal["auto", "companion", "bisection", "newton"]
STABILITY_METHODS: tuple[str, ...] = get_args(StabilityMethod)
RADIUS_METHODS: tuple[str, ...] = get_args(RadiusMethod)

# "auto" solves the boundary of each row (beta, delta, d) up to so many rows; where there are more, and up to this
# delay, it runs the recursion first and solves only the rows of doubtful points.
_MANY_ROWS = 1 << 20
_SHORT_DELAY = 40.0
# "auto" takes companion eigenvalues, with all digits, for so few points of delays up to this.
_FEW_POINTS = 1 << 12
_FEW_PERIODS = 32.0
_DEFAULT_ACCURACY = 1e-9
# Closer in, the rounding errors of its own test would spoil Newton's certificate.
_LEAST_CERTIFIED = 1e-10
_LEAST_BISECTED = 1e-14


class Method(IntEnum):
    """What decided a point, as the code in `Stability.method` and `Radius.method`."""

    COMPANION = 0
    SCHUR_COHN = 1
    BOUNDARY = 2
    CERTIFIED = 3
    BISECTION = 4
    NEWTON = 5


class Stability(NamedTuple):
    """Labels with their status and the `Method` that decided each point, all of the broadcast shape."""

    stable: Array
    status: Array
    method: Array


class Radius(NamedTuple):
    """Spectral radii with absolute error bounds, certificates, status and `Method`, all of the broadcast shape."""

    radius: Array
    error: Array
    certified: Array
    status: Array
    method: Array


def is_stable(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: StabilityMethod = "auto",
    accuracy: float | None = None,
    dtype: Any = None,
    delay: DelayModel = "held",
) -> Array:
    """Tell which walls are stable: every pole strictly inside the unit circle.

    ``P(z) = 0`` only for ``|z| < 1``, see `zwidth.char_poly`.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not, mixed in one array. All four broadcast; axes along which an argument
            does not vary cost nothing: for a map pass alpha of shape (1, N) and beta of shape (M, 1).
        method: "boundary" compares alpha with the closed-form end of its row, whatever d (verified for d <= 500 and
            delta <= 1e6; elsewhere the recursion decides, see `zwidth.stability_of`); "schur_cohn" runs a recursion
            at every point; "companion" computes all poles; "certified" never guesses (`zwidth.stability_of` names
            the points it leaves open). "auto" is "boundary", for maps and scattered points; with more than a million
            scattered rows of d <= 40 the recursion decides the clear points first, in a fraction of the time.
        accuracy: with "auto", take the cheapest method that was measured to err only this close to the boundary
            (relative distance in alpha), see `zwidth.accuracy.choose`; 0 for proof, as "certified".
        dtype: "float32" for a faster, rougher recursion (method "schur_cohn" or "auto"); by default float64.
        delay: only "held" has poles.

    Returns:
        Boolean array of the broadcast shape, maybe read-only. False for a point out of range.

    Raises:
        InputError: an argument is no real number, shapes do not broadcast, or a name is unknown.
        TracedDelayError: d is traced.

    Numerics:
        Float64 when called directly, the ambient precision inside `jit`. Relative distances in alpha at which labels
        were seen to be wrong: boundary 1e-15, near the lobe's end 1e-15 of the largest alpha; schur_cohn 1e-12, 1e-9
        for d >= 20, in float32 1e-3. What a point costs: benchmarks/results/bench.md.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17), section V; Jury 1964.

    Example:
        >>> import numpy as np, zwidth
        >>> zwidth.is_stable(np.array([0.1, 0.6, 0.8]), 0.4, 0.1, 0)
        array([ True,  True, False])
    """
    values = (alpha, beta, delta, d)
    _check_stability(method, accuracy, dtype, delay)
    if is_traced(*values):
        # Every other accuracy is kept by what runs inside a transformation.
        return traced.stable(values, "certified" if accuracy == 0 else method)
    laid = lay_out(values)
    chosen, dtype = _stability_choice(laid.points, method, accuracy, dtype)
    return to_caller(laid.spread(_decide(laid.points, chosen, dtype)[0]), values)


def stability_of(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: StabilityMethod = "auto",
    accuracy: float | None = None,
    dtype: Any = None,
    delay: DelayModel = "held",
) -> Stability:
    """Tell which walls are stable, and for each point how that was decided.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0. All four broadcast.
        method: as for `zwidth.is_stable`.
        accuracy: as for `zwidth.is_stable`.
        dtype: as for `zwidth.is_stable`.
        delay: only "held" has poles.

    Returns:
        Stability: ``stable``, boolean; ``status``, see `zwidth.Status`: INVALID_INPUT for a point out of range, and
        with method "certified" UNDECIDED or ON_BOUNDARY where no label is given (``stable`` is False there);
        ``method``, the `Method` that decided: where "boundary" is asked for outside its verified range it is
        SCHUR_COHN. Arrays may be read-only.

    Raises:
        InputError: an argument is no real number or traced, shapes do not broadcast, or a name is unknown.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17), section V.

    Example:
        >>> import zwidth
        >>> zwidth.stability_of([0.1, float("nan")], 0.4, 0.1, 1).status
        array([0, 1], dtype=int32)
    """
    values = (alpha, beta, delta, d)
    _check_stability(method, accuracy, dtype, delay)
    _refuse_traced(values, "stability_of", "is_stable")
    laid = lay_out(values)
    chosen, dtype = _stability_choice(laid.points, method, accuracy, dtype)
    stable, used, status = _decide(laid.points, chosen, dtype)
    ok = point_ok(laid.points)
    status = np.where(ok, Status.OK if status is None else status, Status.INVALID_INPUT)
    codes = (status.astype(np.int32), np.asarray(used, np.int32))
    return to_caller(Stability(*map(laid.spread, (stable, *codes))), values)


def _check_stability(method: str, accuracy: float | None, dtype: Any, delay: str) -> None:
    check_has_poles(delay)
    check_choice("method", method, STABILITY_METHODS)
    if accuracy is not None:
        if not (np.ndim(accuracy) == 0 and np.isfinite(accuracy) and 0 <= accuracy < 1):
            raise InputError(f"accuracy: got {accuracy!r}, a distance of at least 0 (for proof) and below 1 is needed")
        if method != "auto" or dtype is not None:
            raise InputError(
                f"accuracy: got {accuracy!r} with method={method!r} and dtype={dtype!r}; an accuracy chooses both: "
                "leave them out, or leave the accuracy out"
            )
    if dtype is not None and np.dtype(dtype) not in (np.float32, np.float64):
        raise InputError(f"dtype: got {dtype!r}, allowed are 'float32' and 'float64'")
    if _is_float32(dtype) and method not in ("auto", "schur_cohn"):
        raise InputError(f"dtype: got 'float32' with method={method!r}; only 'schur_cohn' has a float32 form")


def _stability_choice(points: Points, method: str, accuracy: float | None, dtype: Any) -> tuple[str, Any]:
    """Method and precision for an accuracy; what was asked for where there is none."""
    if accuracy is None:
        return method, dtype
    choice = _cheapest("stable", points, accuracy)
    return choice.method, choice.dtype if choice.dtype == "float32" else None


def _cheapest(quantity: costs.Quantity, points: Points, accuracy: float) -> costs.Choice:
    good = points.d[np.isfinite(points.d)]
    longest = float(np.max(good, initial=0.0))
    layout: costs.Layout = "map" if points.is_dense else "scattered"
    return costs.choose(quantity, d=longest, points=points.size, layout=layout, accuracy=accuracy)


def _is_float32(dtype: Any) -> bool:
    return dtype is not None and np.dtype(dtype) == np.float32


def _refuse_traced(values: tuple[ArrayLike, ...], name: str, instead: str) -> None:
    if is_traced(*values):
        raise InputError(f"{name}: got traced values; inside a JAX transformation use `zwidth.{instead}`")


def _decide(points: Points, method: str, dtype: Any) -> tuple[np.ndarray, Any, np.ndarray | None]:
    """Labels, the `Method` of each point (or one for all), and statuses where they are not all OK."""
    if method == "schur_cohn" or _is_float32(dtype):
        return schur_cohn_map(points, "float32" if _is_float32(dtype) else "float64"), Method.SCHUR_COHN, None
    if method == "companion":
        return np.asarray(unstable_poles(*points)) == 0, Method.COMPANION, None
    if method == "certified":
        return _certified(points)
    rows = np.broadcast_shapes(points.beta.shape, points.delta.shape, points.d.shape)
    if method == "boundary" or np.prod(rows) <= _MANY_ROWS or not np.all(points.d <= _SHORT_DELAY):
        return *_by_boundary(points), None
    return *_recursion_first(points), None


def _by_boundary(points: Points) -> tuple[np.ndarray, Any]:
    found = boundary_map(points)
    if found.known.all():
        return found.stable, Method.BOUNDARY
    known = np.broadcast_to(found.known, points.shape)
    rest = ~known
    stable = found.stable.copy()
    stable[rest] = schur_cohn_map(picked(points, rest))
    return stable, np.where(known, Method.BOUNDARY, Method.SCHUR_COHN)


def _recursion_first(points: Points) -> tuple[np.ndarray, np.ndarray]:
    code = schur_cohn_map(points, doubt=True)
    stable, doubtful = (code & 1).astype(bool), code >= 2
    used = np.where(doubtful, Method.BOUNDARY, Method.SCHUR_COHN)
    if doubtful.any():
        stable[doubtful], used[doubtful] = _by_boundary(picked(points, doubtful))
    return stable, used


def _certified(points: Points) -> tuple[np.ndarray, Any, np.ndarray]:
    # Loaded here: it needs an extra for its last resort.
    from zwidth.stability.certified import certified_stable

    proved = certified_stable(*points)
    return proved.stable, Method.CERTIFIED, proved.status


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
        >>> from zwidth.stability.methods import radius_of
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
