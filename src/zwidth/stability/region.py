"""The stable set of one device in the (alpha, beta) plane, as a closed outline whose sides are verified."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, DelayModel
from zwidth.batching import as_float64, map_flat
from zwidth.errors import InputError
from zwidth.loop import check_delay_model, frequency_loop, line_at_minus_one
from zwidth.stability.boundary import boundary
from zwidth.stability.curve import lobe_end
from zwidth.stability.labels import is_stable
from zwidth.stability.ridge import alpha_max


class Piece(IntEnum):
    """Which pole crosses the unit circle on a part of the outline."""

    COMPLEX_PAIR = 0
    MINUS_ONE = 1
    PLUS_ONE = 2


class StableRegion(NamedTuple):
    """A closed outline: vertex k belongs to ``piece[k]``, and the last vertex joins the first along alpha = 0."""

    alpha: np.ndarray
    beta: np.ndarray
    omega: np.ndarray
    piece: np.ndarray
    verified: bool

    @property
    def area(self) -> float:
        """The area of the polygon, by the shoelace formula."""
        x, y = self.alpha, self.beta
        return float(0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def lobe(delta: float, d: float, *, delay: DelayModel = "held", points: int = 400) -> tuple[np.ndarray, ...]:
    """Frequencies along the first lobe of the boundary curve, and its alpha and beta there."""
    check_delay_model(delay)
    for name, value in (("delta", delta), ("d", d)):
        number = as_float64(name, value)
        if number.ndim or not (np.isfinite(number) and number >= 0):
            raise InputError(f"{name}: got {value!r}; a single finite number of at least 0 is needed")
    if not isinstance(points, int | np.integer) or isinstance(points, bool) or points < 8:
        raise InputError(f"points: got {points!r}; a whole number of at least 8 is needed")
    columns = [np.array([float(delta)]), np.array([float(d)])]
    end = float(map_flat(_lobe_end_kernel, columns, (delay,), fused=False)[0])
    top = float(alpha_max(delta, d, delay=delay).omega)
    # Closer together at both ends and round the ridge, where the outline bends most.
    half = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, points // 2)))
    omega = np.concatenate([top * half, top + (end - top) * half[1:]]) if top < end else end * half
    curve = boundary(omega, delta, d, delay=delay)
    return omega, np.asarray(curve.alpha), np.asarray(curve.beta)


def _lobe_end_kernel(delta: Array, d: Array, delay: str) -> Array:
    return lobe_end(frequency_loop(delta, d, delay), d, delay)


def _line_kernel(delta: Array, d: Array) -> Array:
    return jnp.asarray(line_at_minus_one(delta, d))


def stable_region(delta: float, d: float, *, delay: DelayModel = "held", points: int = 400) -> StableRegion:
    """Return the outline of the stable set in the (alpha, beta) plane.

    The lobe of the boundary curve from (0, -delta) to its return to alpha = 0, cut by the line on which a real pole
    crosses at z = -1, and closed along alpha = 0, where one crosses at z = 1.

    Args:
        delta: normalized physical damping b T/m, >= 0, a single number.
        d: delay in periods, >= 0, a single number.
        delay: "held" or "fractional_power".
        points: how many points of the curve to take, >= 8.

    Returns:
        StableRegion: ``alpha``, ``beta``, ``omega`` (0 and pi on the straight parts), ``piece`` (see `Piece`);
        ``verified`` tells that stability was decided on both sides of every third edge of the outline: inside stable,
        outside not. It is False for a fractional power, which has no poles. ``area`` in units of alpha times beta.

    Raises:
        InputError: an argument is no single number in range, or ``delay`` is unknown.

    References:
        Hulin, Preusche, Hirzinger 2006, section V, Figs. 5 and 7.

    Example:
        >>> import zwidth
        >>> region = zwidth.stable_region(0.0, 0)
        >>> region.verified, f"{region.alpha.max():.4f}"
        (True, '0.6863')
    """
    omega, alpha, beta = lobe(delta, d, delay=delay, points=points)
    piece = np.full(omega.shape, Piece.COMPLEX_PAIR)
    if delay == "held" or float(d) == int(d):
        omega, alpha, beta, piece = _cut_by_line(omega, alpha, beta, piece, delta, d)
    if omega[-1] == np.pi and alpha[-1] > 0:
        # The line alpha + 2 beta = const from where it meets the curve to alpha = 0.
        omega, alpha, beta = (np.append(row, value) for row, value in ((omega, np.pi), (alpha, 0.0), (beta, 0.0)))
        beta[-1] = beta[-2] + 0.5 * alpha[-2]
        piece = np.append(piece, Piece.MINUS_ONE)
    alpha = np.where(np.arange(alpha.size) == alpha.size - 1, 0.0, alpha)
    verified = delay == "held" and _sides_are_right(alpha, beta, delta, d)
    return StableRegion(alpha, beta, omega, piece, verified)


def _cut_by_line(omega, alpha, beta, piece, delta: float, d: float) -> tuple[np.ndarray, ...]:
    """Drop what lies beyond the line alpha + 2 beta = const, and end on it."""
    columns = [np.array([float(delta)]), np.array([float(d)])]
    limit = float(map_flat(_line_kernel, columns)[0])
    if not np.isfinite(limit):
        return omega, alpha, beta, piece
    # The lobe starts on the stable side, at alpha + 2 beta = -2 delta.
    room = (limit - alpha - 2.0 * beta) * np.sign(limit + 2.0 * delta)
    beyond = np.flatnonzero((room < 0) & (np.arange(room.size) > 0) & (omega < np.pi))
    if not beyond.size:
        return omega, alpha, beta, piece
    first = int(beyond[0])
    share = room[first - 1] / (room[first - 1] - room[first])
    on_line = [row[first - 1] + share * (row[first] - row[first - 1]) for row in (alpha, beta)]
    rows = [np.append(row[:first], value) for row, value in zip((alpha, beta), on_line, strict=True)]
    return np.append(omega[:first], np.pi), rows[0], rows[1], np.append(piece[:first], Piece.MINUS_ONE)


def _sides_are_right(alpha: np.ndarray, beta: np.ndarray, delta: float, d: float) -> bool:
    """Whether the loop is stable a little inside, and not a little outside, the middle of every third edge."""
    scale_alpha, scale_beta = np.ptp(alpha), np.ptp(beta)
    x, y = alpha / scale_alpha, beta / scale_beta
    dx, dy = np.diff(x, append=x[0]), np.diff(y, append=y[0])
    length = np.hypot(dx, dy)
    # The outline starts upwards from alpha = 0 with the stable set on its left.
    use = np.flatnonzero(length > 1e-3)[::3]
    middle_x, middle_y = (x + 0.5 * dx)[use], (y + 0.5 * dy)[use]
    normal_x, normal_y = (-dy / length)[use], (dx / length)[use]
    # Farther than a chord sags from the curve it replaces.
    step = 2e-3
    inside, outside = (
        np.asarray(
            is_stable(
                (middle_x + side * step * normal_x) * scale_alpha,
                (middle_y + side * step * normal_y) * scale_beta,
                delta,
                d,
                method="schur_cohn",
            )
        )
        for side in (1.0, -1.0)
    )
    return bool(use.size and inside.all() and not outside.any())
