"""The stable dampings of one stiffness: a column of the (alpha, beta) plane, for kernels.

The columns of a device share its lobe (`zwidth.stability.curve`); no derivative passes through.
"""

from __future__ import annotations

from typing import NamedTuple

from zwidth._types import Array
from zwidth.stability import curve
from zwidth.stability.curve import Peak, column_end, device_of, peak, wall
from zwidth.stability.devices import ANY, Kind
from zwidth.xp import frozen, namespace


class Lobe(NamedTuple):
    """What all columns of one device share: the curve and its ridge."""

    curve: curve.Lobe
    top: Peak


class Column(NamedTuple):
    """The lowest and the highest stable damping, and whether there is any."""

    lower: Array
    upper: Array
    exists: Array


def lobe(delta: Array, d: Array, kind: Kind = ANY) -> Lobe:
    """The lobe of a device with a held delay."""
    delta, d = frozen((delta, d), namespace(delta, d))
    whole = curve.lobe(device_of(delta, d, "held", kind), d, "held", kind)
    return Lobe(whole, peak(whole))


def column(alpha: Array, lobe: Lobe) -> Column:
    """The stable dampings at one stiffness; of no meaning where none exist."""
    whole, top = lobe
    xp = namespace(alpha, whole.delta)
    alpha = frozen(alpha, xp)
    exists = (alpha > 0) & (alpha < top.alpha)
    goal = xp.where(exists, alpha, 0.5 * top.alpha)
    lower, _ = column_end(goal, top, whole, upper=False)
    upper, on_line = column_end(goal, top, whole, upper=True)
    line = 0.5 * (1.0 / xp.where(whole.to_corner, whole.tilt, 1.0) - goal)
    upper = xp.where(on_line, line, wall(upper, whole).b - whole.delta)
    return Column(wall(lower, whole).b - whole.delta, upper, exists)
