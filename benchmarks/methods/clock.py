"""Timer of all benchmarks."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np


def time_calls(call: Callable[[], Any], least: int, most: float = np.inf, seconds: float = 0.0) -> np.ndarray:
    """Return wall time and CPU time of each call in s, in two rows.

    The function is called at least ``least`` times, then until ``seconds`` have passed or ``most`` calls are made.
    """
    spent: list[tuple[float, float]] = []
    total = 0.0
    while len(spent) < least or (total < seconds and len(spent) < most):
        busy, start = time.process_time(), time.perf_counter()
        call()
        spent.append((time.perf_counter() - start, time.process_time() - busy))
        total += spent[-1][0]
    return np.array(spent).T
