"""Lines of walls that put a pole on the unit circle at one frequency: real poles, and pairs of undamped devices.

Where F is real, ``alpha + beta F = q`` is a line as soon as q is real as well (docs/theory/scenes.md, V9 and V10).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.arrays.circle import ON_CIRCLE, circle, depths
from zwidth.loops.linear.roots import LoopRoots

# Of |q|: less of an imaginary part than that where Im F vanishes is none.
_NONE = 1e-11
# A velocity estimate that turns less than this at z = 1, -1 or a line does not answer there.
_FLAT = 1e-12


class CrossingLine(NamedTuple):
    """A frequency at which a whole line ``alpha + beta real(F) = q`` puts poles on the circle."""

    w: float
    q: float
    f: float
    q_turn: float  # Im dq/dw
    f_turn: float
    poles: int  # 1 at z = 1 and z = -1, else 2

    @property
    def meeting(self) -> float:
        """The damping at which the curve meets the line, ``Im q'/Im F'``; NaN where it does not."""
        return self.q_turn / self.f_turn if abs(self.f_turn) > _FLAT else np.nan

    def leaving(self, beta: np.ndarray) -> np.ndarray:
        """Poles that leave the circle there as alpha rises; on the row through the meeting, as just above it."""
        if np.isnan(self.meeting):
            return np.full(beta.shape, self.poles * np.sign(self.q_turn))
        return self.poles * np.sign(self.f_turn) * np.where(beta < self.meeting, 1.0, -1.0)


def interior_line(loop: LoopRoots, w: float) -> CrossingLine | None:
    """The line of a zero of Im F at which q is real as well, as for an undamped device and some windows."""
    at = circle(np.array([w]))
    if np.min(np.abs(at.before + loop.zeros), initial=1.0) < 1e-9:
        # q is infinite, not real.
        return None
    q, f = loop.required_wall(at), loop.estimate.jet(at)
    if not abs(q.value[0].imag) <= _NONE * abs(q.value[0]):
        return None
    value, turn = float(q.value[0].real), float(q.slope[0].imag)
    return CrossingLine(w, value, float(f.value[0].real), turn, float(f.slope[0].imag), 2)


def circle_zeros(loop: LoopRoots) -> np.ndarray:
    """Angles of zeros on the circle: of an undamped device, where q is infinite, or of F, where Im F may touch 0."""
    zeros = np.concatenate([loop.zeros, loop.estimate.zeros])
    angles = np.angle(1.0 - zeros[np.abs(depths(zeros)) <= ON_CIRCLE])
    return np.unique(angles[(angles > 0) & (angles < np.pi - 1e-6)])


def end_lines(loop: LoopRoots) -> list[CrossingLine]:
    """The lines of real poles at z = 1 and z = -1; where the device does not move there is none."""
    lines = []
    for w in (0.0, np.pi):
        at = circle(np.array([w]))
        with np.errstate(all="ignore"):
            q, f = loop.required_wall(at), loop.estimate.jet(at)
        numbers = q.value[0].real, f.value[0].real, q.slope[0].imag, f.slope[0].imag
        infinite = np.any(np.abs(loop.zeros - (2.0 if w else 0.0)) <= ON_CIRCLE)
        if np.all(np.isfinite(numbers)) and not infinite:
            q_value, f_value, q_turn, f_turn = (float(n) for n in numbers)
            lines.append(CrossingLine(w, q_value, f_value, q_turn, f_turn, 1))
    return lines
