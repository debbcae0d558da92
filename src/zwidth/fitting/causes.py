"""Causes of motion that a free mass under the logged force does not explain: gravity, a spring, a rounded force column.

Two tests: the weak form of the equation of motion, which needs no fit, for logs whose fit fails; and the share of a
fit's residuals that one more force explains, for logs whose residuals are not white noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.fitting.encoder import find_resolution
from zwidth.fitting.moving import Recording
from zwidth.fitting.output_error import FittedModel
from zwidth.words.formatting import plain, with_unit
from zwidth.words.rotation import is_rotary

_WINDOWS = (32, 128)  # samples of test functions; a position error of 1 counts as 1/32^2 and less
_FEWEST = 12  # windows of a log for a regression
_EXPLAINED = 0.25  # share of the squares that may remain if one more force is the cause
_SIGN = 0.3  # share of the squares that may remain if the sign of the force alone is wrong
_SHARE = 0.5  # share of the residuals' squares that a cause explains
_LEVELS, _COARSE = 8, 2e-4  # least distinct forces, and least step over the largest, of a rounded column
_TRIALS = 4  # random rounding errors


class Cause(NamedTuple):
    """A cause of motion in words, or whether the force has the wrong sign."""

    words: str
    reversed: bool = False


def explain_motion(logs: tuple[Recording, ...], period: float) -> Cause:
    """Return the cause of a motion that the force does not explain; empty words for an unknown one.

    With smooth test functions of some dozens of samples ``x'' = g F - delta x' + o + e(x)`` is linear in its
    coefficients, and needs no derivative of a position. Delays are short against the test functions.
    """
    best = Cause("")
    lowest = np.inf
    for window in _WINDOWS:
        rows = [found for log in logs if (found := _weigh(log, window)) is not None]
        if not rows:
            continue
        wanted, force, speed, constant, place, sine, cosine = np.concatenate(rows, axis=1)
        total = float(wanted @ wanted)
        free, rest = _solve(wanted, [force, speed, constant])
        spring, with_spring = _solve(wanted, [force, speed, constant, place])
        gravity, with_gravity = (
            _solve(wanted, [force, speed, constant, sine, cosine]) if is_rotary() else (None, np.inf)
        )
        if min(with_spring, with_gravity) < min(lowest, _EXPLAINED * rest):
            lowest = min(with_spring, with_gravity)
            if gravity is not None and gravity[0] > 0 and with_gravity < 0.5 * with_spring:
                size = float(np.hypot(*gravity[3:])) / gravity[0]
                best = Cause(f"gravity moves it, with a torque of up to {with_unit(size, 'N', 3)}")
            elif spring[0] > 0:
                stiffness = -spring[3] / spring[0]
                size = f"{with_unit(abs(stiffness), 'N/m', 3)}{' away from rest' if stiffness < 0 else ''}"
                best = Cause(f"a spring or gravity of about {size} moves it")
        if not best.words and free[0] < 0 and rest < _SIGN * total:
            best = Cause("", reversed=True)
    return best


def _weigh(log: Recording, window: int) -> np.ndarray | None:
    """Return the acceleration and what may cause it, weighed by test functions: rows; None for a short log."""
    count = log.position.size
    if count < (_FEWEST + 1) * window // 2:
        return None
    phase = np.pi * (np.arange(window + 1) / window)
    # sin^4 and its derivatives, which vanish at the ends.
    function = np.sin(phase) ** 4
    slope = 4.0 * np.sin(phase) ** 3 * np.cos(phase) * np.pi / window
    bend = (12.0 * np.sin(phase) ** 2 * np.cos(phase) ** 2 - 4.0 * np.sin(phase) ** 4) * (np.pi / window) ** 2
    x, force = log.position - log.position.mean(), log.force[log.skip :][:count]
    columns = [(bend, x), (function, force), (-slope, x), (function, np.ones(count)), (function, x)]
    columns += [(function, np.sin(log.position)), (function, np.cos(log.position))]
    return np.array([np.convolve(values, weight[::-1], "valid")[:: window // 4] for weight, values in columns])


def _solve(wanted: np.ndarray, columns: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Return the coefficients of least squares and the squares that remain."""
    matrix = np.array(columns).T
    sizes = np.linalg.norm(matrix, axis=0)
    sizes = np.where(sizes > 0, sizes, 1.0)
    values = np.linalg.lstsq(matrix / sizes, wanted, rcond=None)[0]
    rest = wanted - matrix / sizes @ values
    return values / sizes, float(rest @ rest)


def explain_residuals(best: FittedModel) -> str:
    """Return the cause of residuals that are not white noise: a spring, gravity or a rounded force; "" for another."""
    slopes = best.motion.slopes
    basis = np.linalg.qr(slopes / np.maximum(np.linalg.norm(slopes, axis=0), 1e-300))[0]
    left = best.residuals - basis @ (basis.T @ best.residuals)
    squares = float(left @ left)
    # Rounding errors drift as a weak spring does, so that they are looked at first.
    if rounded := _explain_rounding(best, basis, squares):
        return rounded

    def share(*pushes: list[np.ndarray]) -> float:
        columns = np.array([_respond(best, push) for push in pushes]).T
        columns = columns - basis @ (basis.T @ columns)
        return 1.0 - _solve(left, list(columns.T))[1] / squares

    places = [log.position - log.position.mean() for log in best.model.logs]
    spring = share([-each for each in places])
    if is_rotary() and max(map(np.ptp, places)) > 0.5:
        gravity = share(*([turn(log.position) for log in best.model.logs] for turn in (np.sin, np.cos)))
        if gravity > _SHARE and gravity > spring + 0.1:
            return "it follows the angle, as of gravity"
    # Friction hides a part of a spring, so that its stiffness is not found here.
    if spring > _SHARE:
        return "it follows the position, as of a weak spring, a cable or gravity"
    return ""


def _respond(best: FittedModel, pushes: list[np.ndarray]) -> np.ndarray:
    """Return the positions by further accelerations, one array for the positions of each log, without friction."""
    delta = float(best.theta[1])
    moved = []
    for log, push in zip(best.model.logs, pushes, strict=True):
        force = np.concatenate([np.full(log.skip, push[0]), push])
        moved.append(Recording(force, log.position, log.skip).move(1.0, delta, 0.0).position)
    return np.concatenate(moved)


def _explain_rounding(best: FittedModel, basis: np.ndarray, squares: float) -> str:
    """Return the words for a force column whose rounding explains the residuals, "" if it does not."""
    forces = np.concatenate([log.force for log in best.model.logs])
    step, largest = find_resolution(forces), best.model.largest
    if step < _COARSE * largest or np.unique(forces).size < _LEVELS:
        return ""
    rng, found = np.random.default_rng(0), []
    for _ in range(_TRIALS):
        pushes = []
        for log in best.model.logs:
            force = log.force[log.skip :][: log.position.size]
            # One error for each stretch of equal force.
            run = np.append(0, np.cumsum(np.diff(force) != 0))
            pushes.append(best.theta[0] * rng.uniform(-0.5 * step, 0.5 * step, run[-1] + 1)[run])
        moved = _respond(best, pushes)
        moved = moved - basis @ (basis.T @ moved)
        found.append(float(moved @ moved))
    if np.mean(found) < 0.2 * squares:
        return ""
    percent = plain(100.0 * step / largest, 1)
    return f"the force column is rounded to {with_unit(step, 'N', 3)}, {percent} % of its largest, which leaves as much"
