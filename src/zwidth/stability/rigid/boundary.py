"""Compute the stability boundary of rigid devices: the curve, points at given beta or alpha, the outline and the area.

The stable walls of a device, with its normalized physical damping delta and its delay of d = n + f periods, fill one
region of the (alpha, beta) plane. Its outline consists of

- the *lobe*, the first part of the boundary curve (`stability.rigid.curve`), on which a pole pair is at e^(+-j omega);
- for short delays and strong damping, a line alpha + 2 beta = const of walls with a pole at z = -1, which the lobe
  meets in the *corner*;
- the line alpha = 0, on which a pole is at z = 1 (docs/theory/boundary.md, docs/theory/one-lobe.md).

The *ridge* is the point of the lobe with the largest alpha. A point of the lobe is given by s = sin(omega/2).
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from zwidth.core.errors import InputError, check_choice
from zwidth.core.status import Status
from zwidth.core.types import Array, ArrayLike, Vertices
from zwidth.core.xp import namespace, nan_with_nan_derivatives, stop_gradient, tree_map
from zwidth.model.checks import check_integer
from zwidth.numerics.evaluate import as_number, check_scalars, evaluate
from zwidth.numerics.root_finding import attach_root_derivatives, integrate
from zwidth.plant.rigid_mass import DelayClasses, classify_delays, discretize_mass, is_valid_device, split_delay
from zwidth.stability.rigid.boundary_curve import evaluate_wall, evaluate_wave_at, expand_curve
from zwidth.stability.rigid.characteristic_polynomial import expand_wall, recover_wall
from zwidth.stability.rigid.curve import (
    build_lobe,
    compute_damping,
    compute_frequency,
    compute_offset,
    evaluate_lobe,
    find_column_end,
    find_on_corner_line,
    find_peak,
    find_row_end,
)
from zwidth.stability.rigid.normalization import wall_status
from zwidth.units.display import compact_repr

PointMethod: TypeAlias = Literal["auto", "optimistix"]


class Wall(NamedTuple):
    """The normalized stiffness and damping of a wall, or arrays of them."""

    alpha: Array
    beta: Array


def boundary(omega: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Wall:
    """Return the wall that puts a pole pair of the loop at ``e^(+-j omega)``, in closed form.

    With ``q = -z^n (z - 1)(z - c)/(n0(z) + n1(z)/z)`` on ``z = e^(j omega)``: ``beta = Im q / sin omega``,
    ``alpha = Re q - tan(omega/2) Im q``. The curve starts at (0, -delta), eq. (19). Its first lobe bounds the stable
    set, see `zwidth.stable_region`. Walls on later parts of the curve have a pole on the unit circle, too, but do not
    bound the stable set.

    Args:
        omega: frequency in rad per sample, 0 <= omega <= pi.
        delta: normalized physical damping b T/m, 0 to 1e12.
        d: delay in periods, 0 to 1e5, integer or fractional. All three broadcast.

    Returns:
        Wall with ``alpha`` and ``beta`` of the broadcast shape; NaN out of range. At omega = 0 and pi the
        values are the limits. The limit at pi is infinite if N(-1) = 0, as for delta = 0 and integer d (for other d,
        N(-1) = 0 at one delta at most); otherwise both limits are finite.

    Numerics:
        Accurate to a few units in the last place, at a cost independent of d. JAX can trace and differentiate it, also
        in d (from the right at integer d). Float64 when called directly; the ambient precision inside `jit`.

    References:
        Hulin, Preusche, Hirzinger 2006, section V; D-decomposition.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.boundary(0.0, 0.25, 2).beta:.2f}")
        -0.25
    """
    return evaluate(_boundary_kernel, {"omega": omega, "delta": delta, "d": d})


def _boundary_kernel(omega: Array, delta: Array, d: Array) -> Wall:
    """Compute the wall with a pole pair at ``e^(+-j omega)``, elementwise; NaN if an argument is out of range."""
    xp = namespace(omega, delta, d)
    ok = is_valid_device(delta, d) & (omega >= 0) & (omega <= np.pi)
    nan_if_invalid = nan_with_nan_derivatives(ok, omega, delta, d)
    omega, delta, d = (xp.where(ok, value, 1.0) for value in (omega, delta, d))
    n, fraction = split_delay(d)
    wall = evaluate_wall(evaluate_wave_at(omega, n), expand_curve(discretize_mass(delta, fraction)))
    return Wall(*(value + nan_if_invalid for value in wall))


@compact_repr()
class BoundaryPoint(NamedTuple):
    """A wall on the stability boundary, or arrays of such walls."""

    alpha: Array
    beta: Array
    omega: Array
    status: Array


def boundary_point(
    delta: ArrayLike,
    d: ArrayLike,
    *,
    beta: ArrayLike | None = None,
    alpha: ArrayLike | None = None,
    side: str = "lower",
    method: PointMethod = "auto",
) -> BoundaryPoint:
    """Return the point of the stability boundary at a given virtual damping or at a given stiffness.

    At a given ``beta`` it is the stiffest stable wall. At a given ``alpha`` it is the wall with the smallest
    (``side="lower"``) or the largest (``"upper"``) stable damping. The point satisfies ``P(e^(j omega)) = 0``.

    Args:
        delta: normalized physical damping b T/m, 0 to 1e12.
        d: delay in periods, 0 to 1e5, integer or fractional.
        beta: normalized virtual damping B T/m; or
        alpha: normalized stiffness K T^2/m, > 0.
        side: "lower" or "upper", for a given ``alpha``. All arguments broadcast.
        method: "auto" inverts the closed form of the lobe; "optimistix" solves ``P(e^(j omega)) = 0`` in real unknowns,
            from a bracket by jaxopt. The second method is independent of the first one; JAX compiles it.

    Returns:
        BoundaryPoint: ``alpha``, ``beta``; ``omega`` of the pole on the circle (pi: a real one); ``status``, see
        `zwidth.Status`: NO_BOUNDARY if no wall of this damping or stiffness is stable. The values are NaN unless the
        status is OK.

    Raises:
        InputError: none or both of ``beta`` and ``alpha`` are given, an argument is no real number or a scalar out of
            range, shapes do not broadcast, or a name is unknown.

    Numerics:
        alpha and ``beta + delta`` to about 1e-15 relative, times their condition number: near the ridge, alpha
        determines only half of the digits of beta. NumPy, compiled and traced calls return the same; a scalar takes a
        fraction of a millisecond and compiles nothing. JAX can differentiate it twice, also in d (from the right at
        integer d). The stable walls of one damping or stiffness form an interval (docs/theory/one-lobe.md).

    References:
        Hulin, Preusche, Hirzinger 2006, section V.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.boundary_point(0.0, 0, beta=0.5).alpha:.4f}")
        0.6000
    """
    check_choice("side", side, ("lower", "upper"))
    check_choice("method", method, get_args(PointMethod))
    given_lines = [(name, value) for name, value in (("beta", beta), ("alpha", alpha)) if value is not None]
    if len(given_lines) != 1:
        raise InputError(f"beta, alpha: got {'both' if given_lines else 'none'}; give exactly one of the two")
    ((name, value),) = given_lines
    line = side if beta is None else "row"
    arguments = {"delta": delta, "d": d, name: value}
    if method == "optimistix":
        # Import the solvers only if the method "optimistix" is requested, because the import takes a second.
        from zwidth.stability.rigid.exact_points import point_kernel

        return BoundaryPoint(*evaluate(point_kernel, arguments, line, route="jax"))
    return evaluate(_point_kernel, arguments, line, classify_delays(d))


def _point_kernel(delta: Array, d: Array, number: Array, line: str, kind: Any) -> BoundaryPoint:
    """Return the point of the stability boundary at a given beta or at a given alpha, elementwise.

    Args:
        delta: Normalized physical damping.
        d: Delay in periods.
        number: The given beta if ``line`` is "row"; the given alpha if it is "lower" or "upper".
        line: "row" for the largest stable alpha at this beta; "lower" or "upper" for the smallest or the largest stable
            beta at this alpha.
        kind: `DelayClasses` of d.
    """
    xp, is_row, zero = namespace(delta, d, number), line == "row", 0.0 * number
    input_status = wall_status(*((zero, number) if is_row else (number, zero)), delta, d)
    curve = build_lobe(delta, d, kind)
    frozen_curve, frozen_number = stop_gradient((curve, number), xp)
    if is_row:
        limit = find_row_end(frozen_number, frozen_curve)
        s, on_lobe, exists = limit.s, limit.meets_lobe, (limit.meets_lobe | limit.beyond) & (limit.alpha > 0)
        s = attach_root_derivatives(
            lambda s, curve, b: evaluate_lobe(s, curve).b - b, s, lambda *_: True, curve, compute_offset(number, curve)
        )
        point = evaluate_lobe(s, curve)
        # Return exactly the limit of alpha that `zwidth.is_stable` compares with, but take the derivatives from the
        # point of the lobe, because the limit has been computed without derivatives.
        alpha = (
            limit.alpha if xp is np else stop_gradient(limit.alpha, xp) + (point.alpha - stop_gradient(point.alpha, xp))
        )
        beta = number
    else:
        top = find_peak(frozen_curve, kind)
        exists = (frozen_number > 0) & (frozen_number < top.alpha)
        target = xp.where(exists, frozen_number, 0.5 * top.alpha)
        s, on_line = find_column_end(target, top, frozen_curve, line == "upper")
        on_lobe = ~on_line
        s = attach_root_derivatives(
            lambda s, curve, alpha: evaluate_lobe(s, curve).alpha - alpha, s, lambda *_: True, curve, number
        )
        point = evaluate_lobe(s, curve)
        # Do not refine s by a further Newton step, because near the ridge both numerator and denominator of the step
        # would be rounding errors.
        alpha, beta = number, compute_damping(point.b, curve)
    omega = compute_frequency(s)
    if curve.short_curve is not None and line != "lower":
        # Replace points that are not on the lobe by points on the line of walls with a pole at z = -1.
        alpha_on_line, beta_on_line = find_on_corner_line(number, curve, is_row)
        alpha, beta = xp.where(on_lobe, alpha, alpha_on_line), xp.where(on_lobe, beta, beta_on_line)
        omega = xp.where(on_lobe, omega, np.pi)
    status = xp.where(exists, int(Status.OK), int(Status.NO_BOUNDARY))
    status = xp.where(input_status == int(Status.OK), status, input_status)
    # Make values and derivatives NaN if the point does not exist.
    nan_if_missing = nan_with_nan_derivatives(status == int(Status.OK), delta, d, number)
    return BoundaryPoint(alpha + nan_if_missing, beta + nan_if_missing, omega + nan_if_missing, status.astype(np.int32))


class Piece(IntEnum):
    """Code of the pole that is on the unit circle along one part of the outline of the stable set."""

    COMPLEX_PAIR = 0
    MINUS_ONE = 1
    PLUS_ONE = 2


@compact_repr()
class StableRegion(NamedTuple):
    """Closed outline of the stable set: vertex k lies on the part ``piece[k]``, and the line alpha = 0 closes it."""

    alpha: Vertices
    beta: Vertices
    omega: Vertices
    piece: np.ndarray

    @property
    def area(self) -> float:
        """Area of the polygon, by the shoelace formula."""
        x, y = self.alpha, self.beta
        return float(0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def sample_lobe(delta: float, d: float, *, points: int = 400) -> tuple[Vertices, Vertices, Vertices]:
    """Return frequencies along the first lobe of the boundary curve, and alpha and beta at these frequencies."""
    device = {"delta": as_number("delta", delta, 0.0), "d": as_number("d", d, 0.0)}
    check_scalars(device)
    points = check_integer("points", points, 8, 10**7)
    kind = classify_delays(d)
    with np.errstate(all="ignore"):
        curve = build_lobe(np.float64(device["delta"]), np.float64(device["d"]), kind)
        first, last = (float(compute_frequency(s)) for s in (find_peak(curve, kind).s, curve.end))
    # Space the points more closely at both ends and at the ridge, where the curvature is largest.
    half_grid = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, points // 2)))
    omega = (
        np.concatenate([first * half_grid, first + (last - first) * half_grid[1:]])
        if first < last
        else last * half_grid
    )
    # Limit omega to the end of the lobe, because the last product may exceed it by a rounding error.
    omega = np.minimum(omega, last)
    wall = boundary(omega, delta, d)
    return omega, np.asarray(wall.alpha), np.asarray(wall.beta)


def stable_region(delta: float, d: float, *, points: int = 400) -> StableRegion:
    """Return the outline of the stable set in the (alpha, beta) plane.

    The outline is the lobe of the boundary curve, from (0, -delta) to its return to alpha = 0 or to the line on which a
    real pole is at z = -1. It is closed along this line and along alpha = 0, where a real pole is at z = 1.

    Args:
        delta: normalized physical damping b T/m, >= 0, a single number.
        d: delay in periods, >= 0, a single number.
        points: number of points on the curve, 8 to 10,000,000.

    Returns:
        StableRegion: ``alpha``, ``beta``, ``omega`` (0 and pi on the straight parts), ``piece`` (see `Piece`); ``area``
        in units of alpha times beta, of the polygon.

    References:
        Hulin, Preusche, Hirzinger 2006, section V, Figs. 5 and 7.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.stable_region(0.0, 0).alpha.max():.4f}")
        0.6863
    """
    omega, alpha, beta = sample_lobe(delta, d, points=points)
    piece = np.full(omega.shape, Piece.COMPLEX_PAIR)
    if omega[-1] == np.pi and alpha[-1] > 0:
        # Add the straight part of the outline, from the corner along alpha + 2 beta = const to alpha = 0.
        omega, piece = np.append(omega, np.pi), np.append(piece, Piece.MINUS_ONE)
        beta = np.append(beta, recover_wall(0.0, sum(expand_wall(0.5 * alpha[-1], beta[-1])[:2]))[1])
        alpha = np.append(alpha, 0.0)
    alpha[-1] = 0.0
    return StableRegion(alpha, beta, omega, piece)


LOBE_NODES = 48  # number of Gauss-Legendre nodes along the lobe, on which the integrand alpha d(beta) is analytic
LOBE_WEIGHT = 16  # computing time and memory per point of `stable_area`, relative to other kernels


def stable_area(delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the area of the stable set in the (alpha, beta) plane.

    ``A = integral of alpha d(beta)`` along the outline of `zwidth.stable_region`. In SI units, the area over K and B is
    ``A m^2/T^3``.

    Args:
        delta: normalized physical damping b T/m, 0 to 1e12.
        d: delay in periods, 0 to 1e5, integer or fractional. Both broadcast.

    Returns:
        Array of the broadcast shape; NaN out of range.

    Numerics:
        Gauss-Legendre quadrature of the closed form, accurate to about 1e-13. JAX can differentiate it twice, in d from
        the right at integer d.

    References:
        Colgate, Brown 1994 (Z-width); Hulin, Preusche, Hirzinger 2006, section V.

    Example:
        >>> from zwidth import stable_area
        >>> print(f"{stable_area(0.0, 0):.4f}")
        0.9096
    """
    return evaluate(_area_kernel, {"delta": delta, "d": d}, classify_delays(d), weight=LOBE_WEIGHT)


def _area_kernel(delta: Array, d: Array, kind: DelayClasses) -> Array:
    """Compute the area of the stable set: the integral of alpha db along the lobe and, beyond a corner, a triangle."""
    xp = namespace(delta, d)
    curve = build_lobe(delta, d, kind)
    # Attach derivatives to the end of the lobe: without a corner, it is the s with alpha = 0; a corner is fixed at s =
    # 1 (infinite slope).
    end = attach_root_derivatives(
        lambda x, curve: evaluate_lobe(x, curve).alpha,
        curve.end,
        lambda *_: True,
        curve,
        slope=lambda x, curve: xp.where(curve.to_corner, xp.inf, evaluate_lobe(x, curve).d_alpha),
    )
    # If the lobe ends in the corner, add the triangle below the line alpha + 2 beta = const, on which the outline
    # continues to alpha = 0.
    point = evaluate_lobe(end, curve)
    corner_alpha = xp.where(curve.to_corner, point.alpha, 0.0)
    # Add an axis for the quadrature nodes.
    expanded = tree_map(lambda value: None if value is None else value[..., None], curve)

    def integrand(s: Array) -> Array:
        point = evaluate_lobe(s, expanded)
        return point.alpha * point.d_b

    under_lobe = integrate(integrand, (0.0 * end, end), (LOBE_NODES,))
    return (
        under_lobe + 0.25 * corner_alpha * corner_alpha + nan_with_nan_derivatives(is_valid_device(delta, d), delta, d)
    )
