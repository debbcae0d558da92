"""Timing and error of one method on one problem."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from zwidth.bench.problems import Labelled, Walls

# A measurement is repeated until it has taken this long, and at least this often.
_SECONDS = 0.4
_LEAST, _MOST = 3, 40


@dataclass(frozen=True)
class Measurement:
    """What was measured of one method on one problem.

    Attributes:
        quantity: "stable", "spectral_radius" or "alpha_max".
        method: the method's name; a baseline's is that of the tool.
        dtype: "float64" or "float32".
        layout: "grid" or "scattered".
        d: delay in periods.
        points: how many were computed at once.
        first_seconds: the first call, compilation included.
        seconds: the median of the later calls.
        points_per_second: points over the best of the later calls' median.
        worst_error: of "stable", the largest relative distance in alpha from the boundary at which a label was wrong;
            of "spectral_radius", the largest absolute error; of "alpha_max", the largest relative one; 0 for none.
        wrong: how many of ``checked`` labels were wrong; of other quantities, 0.
        checked: how many points the error was measured on.
        baseline: whether it is a tool for comparison.
    """

    quantity: str
    method: str
    dtype: str
    layout: str
    d: float
    points: int
    first_seconds: float
    seconds: float
    points_per_second: float
    worst_error: float
    wrong: int
    checked: int
    baseline: bool = False

    def as_dict(self) -> dict[str, Any]:
        """The fields as plain JSON values."""
        return asdict(self)


def clock(call: Callable[[], Any]) -> tuple[float, float]:
    """Seconds of the first call and the median of the warm ones; results are NumPy arrays, hence complete."""
    start = time.perf_counter()
    call()
    first = time.perf_counter() - start
    durations: list[float] = []
    while len(durations) < _LEAST or (sum(durations) < _SECONDS and len(durations) < _MOST):
        start = time.perf_counter()
        call()
        durations.append(time.perf_counter() - start)
    return first, float(np.median(durations))


def label_error(classify: Callable[[Walls], np.ndarray], truth: Labelled) -> tuple[float, int, int]:
    """The farthest wrong label, how many are wrong, and of how many."""
    wrong = np.asarray(classify(truth.walls)) != truth.stable
    return float(np.max(truth.distance, initial=0.0, where=wrong)), int(wrong.sum()), int(wrong.size)


def value_error(values: np.ndarray, truth: np.ndarray, relative: bool) -> tuple[float, int, int]:
    """The largest error of real values; a missing value counts as an infinite one."""
    error = np.abs(np.asarray(values) - truth) / (np.abs(truth) if relative else 1.0)
    return float(np.max(np.where(np.isfinite(error), error, np.inf))), 0, int(truth.size)
