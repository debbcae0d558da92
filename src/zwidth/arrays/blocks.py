"""Evaluation of functions on columns of points, block by block and on all processors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from zwidth.arrays.threads import run_in_threads
from zwidth.words.xp import compute_concretely, tree_map

LEAST = 1 << 4  # points of the smallest block, because XLA rounds differently in shorter arrays


def map_blocks(
    function: Callable[..., Any],
    columns: Sequence[np.ndarray],
    block: int,
    threads: int | None = None,
    within: Callable[[], Any] = compute_concretely,
    exact: bool = False,
) -> Any:
    """Apply a function to columns block by block, on all processors.

    Blocks keep the intermediate arrays in the cache: one array of a million points takes 2.5 times as long for the
    ridge (benchmarks/bench_xla.py).

    Args:
        function: maps columns to an array or tree of arrays, with one row per point.
        columns: arrays of one length, or of length 1 for a value that all points share.
        block: largest number of points per call.
        threads: number of threads; one per processor if left out.
        within: returns the context manager of each call.
        exact: pad a short batch to ``block`` points; otherwise to a power of 2.

    Returns:
        The results for all points, as writable NumPy arrays.
    """
    count = count_points(columns)
    # Round up to a power of 2, so that batches of many sizes share a few compilations.
    size = block if exact else min(block, 1 << max(count - 1, LEAST - 1).bit_length())
    flagged = [(column, column.size == 1 < count) for column in columns]

    def run(start: int) -> Any:
        with within():
            parts = (column if shared else _cut_block(column, start, size) for column, shared in flagged)
            return tree_map(np.asarray, function(*parts))

    first = run(0)
    # Copy the results, because arrays of JAX are read-only.
    whole = tree_map(lambda leaf: np.empty((count, *leaf.shape[1:]), leaf.dtype), first)

    def store(start: int, result: Any) -> None:
        stop = min(start + size, count)
        tree_map(lambda to, leaf: np.copyto(to[start:stop], leaf[: stop - start]), whole, result)

    store(0, first)
    # The first block has compiled the function; threads run the others in parallel, because JAX releases the
    # interpreter lock.
    run_in_threads(lambda start: store(start, run(start)), range(size, count, size), threads)
    return whole


def count_points(columns: Sequence[np.ndarray]) -> int:
    """Return the number of points of columns of one length or of length 1."""
    return np.broadcast_shapes(*(column.shape for column in columns))[0]


def _cut_block(column: np.ndarray, start: int, size: int) -> np.ndarray:
    """Return one block of a column, padded to the full size."""
    part = column[start : start + size]
    missing = size - part.size
    if not missing:
        return part
    # Repeat the last point, because no other value is valid for every kernel.
    return np.concatenate([part, np.full(missing, part[-1] if part.size else 0.0)])
