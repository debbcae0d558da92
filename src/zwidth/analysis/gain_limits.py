"""Stable intervals of single gains of a PID or cascade controller, with all other gains unchanged.

The open loop L(z) is affine in every gain x of such a controller: ``L = L_0 + x L_1``. A pole lies on the unit circle
at z = exp(j w) if and only if ``1 + L_0 + x L_1 = 0``, so that x = -(1 + L_0)/L_1 is real. These critical values bound
the interval around a stable gain, because the number of unstable poles changes only at a critical value.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from zwidth.analysis.base import SceneParts

# Frequencies, relative to the Nyquist frequency, between which the search looks for sign changes of Im x.
# The geometric part resolves the slow poles of integrators, the linear part resolves resonances.
GRID = np.unique(np.concatenate([np.geomspace(1e-7, 1.0, 4001), np.linspace(1e-4, 1.0, 8001)]))
SPLITS = 33  # frequencies per bracket in each refinement
REFINEMENTS = 9  # number of refinements; each divides the width of a bracket by 32


def find_gain_limits(make: Callable[[float], Any], gain: float) -> tuple[float, float] | None:
    """Return the ends of an interval of stable values of one gain, with all other gains of the controller unchanged.

    Args:
        make: function that returns the `zwidth.Scene` of the controller for a value of this gain.
        gain: the given value of the gain, not 0.

    Returns:
        Lower end, at least 0, and upper end, which is infinity if every larger gain is stable. If the given value is
        unstable or negative, the interval is the stable one closest to this value; None if no positive value is stable.
    """
    size = abs(gain)
    critical = size * _find_critical(make, size)
    if gain > 0 and bool(make(gain).is_stable()):
        below, above = critical[critical <= gain], critical[critical > gain]
        return float(below.max(initial=0.0)), float(above.min(initial=math.inf))
    ends = [0.0, *critical.tolist(), math.inf]
    intervals = list[tuple[float, float]]()
    for low, high in pairwise(ends):
        # Skip intervals between critical values that differ only by rounding errors.
        if math.isfinite(high) and high - low <= 1e-9 * high:
            continue
        inside = 0.5 * (low + high) if math.isfinite(high) else 2.0 * (low or size)
        if bool(make(inside).is_stable()):
            # Join adjacent intervals, because poles may touch the unit circle without crossing it.
            joined = bool(intervals) and intervals[-1][1] == low
            intervals[-1:] = [(intervals[-1][0], high)] if joined else [*intervals[-1:], (low, high)]
    return min(intervals, key=lambda ends: max(ends[0] - gain, gain - ends[1]), default=None)


def _find_critical(make: Callable[[float], Any], gain: float) -> np.ndarray:
    """Return the positive critical values of one gain relative to ``gain``, a positive value, in ascending order."""
    without, given = make(0.0), make(gain)
    nyquist = 0.5 / float(given.timing.period)

    def evaluate(frequency: np.ndarray) -> Any:
        """Return x = -(1 + L_0)/L_1, relative to ``gain``, at frequencies relative to the Nyquist frequency."""
        base = _open_loop(without, frequency * nyquist)
        with np.errstate(all="ignore"):
            return -(1.0 + base) / (_open_loop(given, frequency * nyquist) - base)

    values = evaluate(GRID)
    signs = np.sign(values.imag)
    (index,) = np.nonzero(signs[:-1] * signs[1:] < 0)
    low, high, sign = GRID[index], GRID[index + 1], signs[index]
    for _ in range(REFINEMENTS if index.size else 0):
        points = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, SPLITS)
        kept = (np.sign(evaluate(points).imag) == sign[:, None])[:, :-1]
        last = SPLITS - 2 - np.argmax(kept[:, ::-1], axis=1)
        rows = np.arange(index.size)
        low, high = points[rows, last], points[rows, last + 1]
    # The last value is also critical, because x is real at the Nyquist frequency, z = -1.
    roots = [evaluate(0.5 * (low + high)).real] if index.size else []
    critical = np.concatenate([*roots, values[-1:].real])
    # Exclude sign changes of Im x at poles of x, where |x| is infinite.
    return np.sort(critical[np.isfinite(critical) & (critical > 0) & (critical < 1e9)])


def _open_loop(scene: SceneParts, frequency: np.ndarray) -> np.ndarray:
    """Return the open loop L of a scene with its wall and further feedback, at frequencies in Hz."""
    return np.asarray(scene.frequency_response(frequency=frequency))  # pyright: ignore[reportAttributeAccessIssue]
