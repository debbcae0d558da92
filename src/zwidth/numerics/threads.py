"""Run functions in parallel threads, one per available processor."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def count_processors() -> int:
    """Return the number of processors that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS has no CPU affinity
        return os.cpu_count() or 1


def run_in_threads(function: Callable[[Any], Any], items: Sequence[Any], threads: int | None = None) -> list[Any]:
    """Call a function once per item in parallel threads, and return the results as a list in the order of the items.

    Args:
        function: function of one item; it must be thread-safe.
        items: arguments of the calls.
        threads: number of threads; one per processor if left out.
    """
    threads = min(threads or count_processors(), len(items))
    if threads < 2:
        return list(map(function, items))
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, items))
