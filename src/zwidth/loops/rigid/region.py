"""The stable set of one device in the (alpha, beta) plane, as an outline (rigid loop)."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from zwidth.arrays.arguments import as_float64, check_scalars
from zwidth.loops.rigid import curve
from zwidth.loops.rigid.boundary import boundary
from zwidth.loops.rigid.delay_classes import classify_delays
from zwidth.loops.rigid.polynomial import check_delay_model
from zwidth.words.errors import InputError
from zwidth.words.types import DelayModel, Vertices


class Piece(IntEnum):
    """Which pole crosses the unit circle on a part of the outline."""

    COMPLEX_PAIR = 0
    MINUS_ONE = 1
    PLUS_ONE = 2


class StableRegion(NamedTuple):
    """A closed outline: vertex k belongs to ``piece[k]``, and the last vertex joins the first along alpha = 0."""

    alpha: Vertices
    beta: Vertices
    omega: Vertices
    piece: np.ndarray

    @property
    def area(self) -> float:
        """The area of the polygon, by the shoelace formula."""
        x, y = self.alpha, self.beta
        return float(0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def lobe(
    delta: float, d: float, *, delay: DelayModel = "held", points: int = 400
) -> tuple[Vertices, Vertices, Vertices]:
    """Frequencies along the first lobe of the boundary curve, and its alpha and beta there."""
    check_delay_model(delay)
    for name, value in (("delta", delta), ("d", d)):
        number = as_float64(name, value)
        if number.ndim or not (np.isfinite(number) and number >= 0):
            raise InputError(f"{name}: got {value!r}; a single finite number of at least 0 is needed")
    check_scalars({"delta": float(delta), "d": float(d)})
    if not isinstance(points, int | np.integer) or isinstance(points, bool) or points < 8:
        raise InputError(f"points: got {points!r}; a whole number of at least 8 is needed")
    kind = classify_delays(d)
    with np.errstate(all="ignore"):
        numbers = np.float64(delta), np.float64(d)
        whole = curve.lobe(*numbers, delay, kind)
        top = curve.peak(whole, delay, kind).x
        first, last = (float(curve.frequency(x, whole)) for x in (top, whole.end))
    # Closer together at both ends and round the ridge, where the outline bends most.
    half = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, points // 2)))
    omega = np.concatenate([first * half, first + (last - first) * half[1:]]) if first < last else last * half
    # The last product may round past its end.
    omega = np.minimum(omega, last)
    wall = boundary(omega, delta, d, delay=delay)
    return omega, np.asarray(wall.alpha), np.asarray(wall.beta)


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
        StableRegion: ``alpha``, ``beta``, ``omega`` (0 and pi on the straight parts), ``piece`` (see `Piece`); ``area``
        in units of alpha times beta, of the polygon.

    References:
        Hulin, Preusche, Hirzinger 2006, section V, Figs. 5 and 7.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.stable_region(0.0, 0).alpha.max():.4f}")
        0.6863
    """
    omega, alpha, beta = lobe(delta, d, delay=delay, points=points)
    piece = np.full(omega.shape, Piece.COMPLEX_PAIR)
    if omega[-1] == np.pi and alpha[-1] > 0:
        # From the corner along the line alpha + 2 beta = const to alpha = 0.
        omega, piece = np.append(omega, np.pi), np.append(piece, Piece.MINUS_ONE)
        beta = np.append(beta, beta[-1] + 0.5 * alpha[-1])
        alpha = np.append(alpha, 0.0)
    alpha[-1] = 0.0
    return StableRegion(alpha, beta, omega, piece)
