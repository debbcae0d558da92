"""Walls at the onset of buzzing as people give them: read, and refused where an experiment is missing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from zwidth.parts.checks import read_texts
from zwidth.words.errors import InputError
from zwidth.words.formatting import plain, with_unit

# Dampings closer than this are one experiment.
_SAME = 1e-6


class BuzzPoint(NamedTuple):
    """A wall at the onset of buzzing.

    Args:
        stiffness: K in N/m, raised at this damping until the wall buzzes.
        virtual_damping: B in N s/m.
        frequency: heard or measured, in Hz.
    """

    stiffness: float
    virtual_damping: float
    frequency: float


def read_points(
    points: Iterable[Any], period: float, copies_count_once: bool
) -> tuple[np.ndarray, list[str]]:
    """The walls as an array, and doubts; an impossible one is refused, and so are walls that cannot tell a device."""
    if not isinstance(points, Iterable) or isinstance(points, str | dict):
        raise InputError(f"points: got {points!r}; give walls, each (K in N/m, B in N s/m, f in Hz)")
    rows = []
    for k, point in enumerate(points):
        try:
            row = [float(read_texts(f"points[{k}]", *each)) for each in zip(point, ("N/m", "N s/m", "Hz"), strict=True)]
        except (TypeError, ValueError):
            row = []
        if len(row) != 3 or not np.all(np.isfinite(row)):
            raise InputError(f"points[{k}]: got {point!r}; give K in N/m, B in N s/m and f in Hz, as (6e3, 0, 37.6)")
        if not row[0] > 0:
            raise InputError(f"points[{k}].stiffness: got {row[0]:g} N/m; it must be greater than 0 to buzz")
        if not 0 < row[2] < 0.5 / period:
            raise InputError(
                f"points[{k}].frequency: got {row[2]:g} Hz; it must be greater than 0 and less than half the sampling "
                f"rate, {plain(0.5 / period)} Hz: check the frequency, or the period"
            )
        rows.append(row)
    if not rows:
        raise InputError("points: got none; raise K at B = 0 until the wall buzzes, and again at another B")
    doubts = []
    if copies_count_once and len(kept := list(dict.fromkeys(map(tuple, rows)))) < len(rows):
        doubts.append(
            f"{len(rows) - len(kept)} of the walls repeat others to the last digit and count once; give the noise if "
            "they were measured again"
        )
        rows = kept
    table = np.array(rows)
    # A force over a velocity: the dampings that matter are of this size.
    unit = table[0, 0] / (2 * np.pi * table[0, 2])
    if np.ptp(table[:, 1]) <= _SAME * max(unit, np.abs(table[:, 1]).max()):
        count = (
            "one wall gives two equations for" if len(table) == 1 else f"{len(table)} walls of one damping cannot tell"
        )
        raise InputError(
            f"points: {count} the three unknowns m, b and t_d; what is missing is a wall of another damping: raise K "
            f"at B = {with_unit(table[0, 1] + 0.4 * unit, 'N s/m', 2)}, say, until it buzzes"
        )
    return table, doubts


def read_noise(noise: Any) -> tuple[float, float] | None:
    if noise is None:
        return None
    try:
        pair = np.broadcast_to(np.asarray(noise, float), (2,))
    except ValueError:
        pair = np.zeros(2)
    if not np.all((pair > 0) & (pair < 1)):
        raise InputError(f"noise: got {noise!r}; give the relative noise of K and f, as 0.02, or (0.03, 0.01)")
    return float(pair[0]), float(pair[1])
