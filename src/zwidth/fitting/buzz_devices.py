"""Devices that walls at the onset of buzzing are nearest to: least squares from many starts."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from zwidth.fitting.buzzing import Followed, Onsets

# The dampings b T/m that are started from where nothing buzzes slowly, how many of the dips, and every which damping
# beside parts.
_DELTAS = np.geomspace(1e-4, 30.0, 45)
_STARTS, _EVERY = 6, 4
# Beyond this condition number some direction is not seen at all.
_BLIND = 1e6
# Tolerances of a first look and of the end, and the evaluations they may take.
_NEARLY, _ARRIVED, _MOST_STEPS = 1e-4, 1e-12, (100, 40)
# Devices with parts that a first look leaves so many times as far away as others are no more followed.
_FAR = 100.0
# After so many devices in a row without such walls there is no way back.
_LOST = 8
_NAMES = ("mass", "damping", "delay")


class Candidate(NamedTuple):
    """A local best fit: theta, its sum of squares, residuals, what is held at 0, and whether all walls were found.

    Last, the sum of squares where its slopes lead: as much at an optimum, far less where the search got stuck.
    """

    theta: np.ndarray
    squares: float
    residuals: np.ndarray
    held: tuple[str, ...]
    found: bool
    ahead: float = np.inf


class _LostError(Exception):
    """No device around has such walls."""


def weigh(slopes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Derivatives of all residuals, a row each, in units of their noise."""
    return (slopes * weights[:, None]).reshape(-1, slopes.shape[-1])


def is_blind(slopes: np.ndarray) -> bool:
    """Whether they do not tell all numbers apart."""
    sizes = np.linalg.norm(slopes, axis=0)
    return not np.all(sizes > 0) or bool(np.linalg.cond(slopes / sizes) > _BLIND)


def look_around(onsets: Onsets, weights: np.ndarray) -> list[tuple[Candidate, np.ndarray]]:
    """Where a first look from each start leads, the best first, and the start."""
    # Half a turn over the delay, and some more for noise.
    longest = 1.2 * np.pi / float(onsets.w.max())
    parts = onsets.lag + onsets.modes > 0
    if parts:
        starts = onsets.starts_beside(_DELTAS[::_EVERY], longest, _STARTS)
    else:
        starts = onsets.starts(_dampings(onsets), longest, _STARTS)
    near = [(_solve(onsets, weights, start, (), _NEARLY), start) for start in starts]
    near = sorted(near, key=lambda each: each[0].squares)
    return [each for each in near if not parts or (each[0].found and each[0].ahead <= _FAR * near[0][0].squares)]


def find_candidates(
    onsets: Onsets, weights: np.ndarray, near: Candidate, start: np.ndarray, most: float
) -> list[Candidate]:
    """The local best fit there. Where damping or delay would be negative, those from the start with it held at 0.

    None where its squares are more than ``most``: what is held leaves more.
    """
    if near.found:
        free = _solve(onsets, weights, near.theta, ())
        if min(free.theta[1:3]) >= 0:
            return [free]
        if free.squares > most:
            return []
    ends = (_solve(onsets, weights, start, held) for held in ((1,), (2,), (1, 2)))
    return [end for end in ends if min(end.theta[1:3]) >= 0]


def _dampings(onsets: Onsets) -> np.ndarray:
    """Places to look for a damping at: a wall of B = 0 buzzes near w^2 = delta/(d + 1/2), however slowly."""
    ratio = _DELTAS[1] / _DELTAS[0]
    more = np.ceil(np.log(_DELTAS[0] / (0.1 * float(onsets.w.min()) ** 2)) / np.log(ratio))
    return np.concatenate([[0.0], _DELTAS[0] * ratio ** np.arange(-more, 0.0), _DELTAS])


def _solve(
    onsets: Onsets, weights: np.ndarray, start: np.ndarray, held: tuple[int, ...], tolerance: float = _ARRIVED
) -> Candidate:
    from scipy.optimize import least_squares

    free = [k for k in range(onsets.unknowns) if k not in held]
    theta, lost = start.copy(), 0
    theta[list(held)] = 0.0

    @lru_cache(maxsize=1)  # The solver asks for values and slopes apart.
    @np.errstate(all="ignore")
    def evaluate(values: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, Followed | None, np.ndarray]:
        nonlocal lost
        at = theta.copy()
        at[free] = values
        walls, ratios, good = None, 0.0, np.zeros(onsets.w.shape, bool)
        if onsets.is_possible(at):
            walls = onsets.follow(at)
            ratios = np.stack([np.log(walls.kappa / onsets.kappa), np.log(walls.w / onsets.w)], -1)
            good = walls.found & np.all(np.isfinite(ratios), -1)
        lost = 0 if good.all() else lost + 1
        if lost > _LOST:
            raise _LostError
        # Where no such wall is found, as wrong as can be, and flat.
        return at, np.where(good[:, None], ratios, 10.0) * weights, walls, good

    @np.errstate(all="ignore")
    def differentiate(values: np.ndarray) -> np.ndarray:
        _, _, walls, good = evaluate(tuple(values))
        slopes = walls.slopes() if walls else np.zeros((*good.shape, 2, onsets.unknowns))
        return weigh(np.where(good[:, None, None] & np.isfinite(slopes), slopes, 0.0), weights)[:, free]

    names = tuple(_NAMES[k] for k in held)
    try:
        found = least_squares(
            lambda x: evaluate(tuple(x))[1].ravel(),
            theta[free],
            differentiate,  # pyright: ignore[reportArgumentType]  (a function or a name)
            method="lm",
            x_scale="jac",
            xtol=tolerance,
            ftol=tolerance,
            gtol=tolerance,
            max_nfev=_MOST_STEPS[tolerance == _NEARLY],
        )
    except _LostError:
        return Candidate(theta, np.inf, np.full((onsets.w.size, 2), np.nan), names, False)
    at, residuals, _, good = evaluate(tuple(found.x))
    rest = residuals.ravel() - found.jac @ (np.linalg.pinv(found.jac) @ residuals.ravel())
    return Candidate(at, float((residuals**2).sum()), -residuals, names, bool(good.all()), float(rest @ rest))
