"""The certified filter for maps: two walls proved on each row decide the others.

On every row (beta, delta, d) the stable walls are one interval, 0 < alpha < limit (docs/theory/one-lobe.md): what lies
below a wall proved stable is stable, what lies above one proved unstable is not. Which two walls does not matter for
the proof, so they are searched among those of the map, several of each row at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, log

import numpy as np

from zwidth.domain import WALL_RANGE, wall_status
from zwidth.stability.layout import Points, picked
from zwidth.status import Status

UNSTABLE, STABLE, OPEN = 0, 1, 2
# So many walls are tried at a time; as many of each row as there is room for.
_BATCH = 1 << 13
_MOST_A_ROW = 31

# alpha, beta, delta, d, each of one axis or a single value -> codes
Codes = Callable[[Points], np.ndarray]


def has_rows(points: Points) -> bool:
    """Whether alpha varies along axes of its own, and along enough values for a search to pay."""
    rows = np.broadcast_shapes(*(array.shape for array in points[1:]))
    apart = all(along == 1 or across == 1 for along, across in zip(points.alpha.shape, rows, strict=True))
    return points.is_dense and apart and points.alpha.size >= 64


def by_rows(points: Points, codes: Codes) -> np.ndarray:
    """The codes of a map for which `has_rows`; what a row does not settle is asked of ``codes`` point by point."""
    shape = points.shape
    row_shape = np.broadcast_shapes(*(array.shape for array in points[1:]))
    # A wall of moderate stiffness stands for the row: what is special about it is special about all.
    usual = (wall_status(np.ones(()), *points[1:]) == Status.OK) & (points.beta != 0)
    least, most = WALL_RANGE
    size = np.abs(points.alpha)
    known = (size >= least) & (size <= most)
    stiffness = np.unique(points.alpha[known & (points.alpha > 0)])
    if stiffness.size:
        stable, unstable = (found.reshape(row_shape) for found in _bracketed(stiffness, points, row_shape, codes))
    else:
        stable, unstable = np.zeros(()), np.full((), np.inf)
    # Walls without or with negative stiffness: P(1) < 0 is a real pole beyond 1.
    alpha = np.where(points.alpha < 0, np.inf, points.alpha)
    above = alpha > stable
    between = above & (alpha < unstable)
    code = 1 - above.view(np.uint8)
    code += OPEN * between.view(np.uint8)
    if not (known.all() and usual.all()):
        code[~np.broadcast_to(known & usual, shape)] = OPEN
    rest = code == OPEN
    if rest.any():
        code[rest] = codes(picked(points, rest))
    return code


def _bracketed(
    stiffness: np.ndarray, points: Points, row_shape: tuple[int, ...], codes: Codes
) -> tuple[np.ndarray, np.ndarray]:
    """Of each row the largest alpha proved stable (or 0) and the smallest one proved unstable (or infinity)."""
    walls = [a.reshape(-1) if a.size == 1 else np.broadcast_to(a, row_shape).reshape(-1) for a in points[1:]]
    rows, count = int(np.prod(row_shape)), stiffness.size
    tried = min(max(_BATCH // rows, 1), _MOST_A_ROW)
    shares = np.arange(1, tried + 1)[:, None]
    stable, unstable = np.full(rows, -1), np.full(rows, count)
    for _ in range(ceil(log(count + 1) / log(tried + 1)) + 1):
        gap = unstable - stable
        if gap.max() <= 1:
            break
        index = np.clip(stable + (shares * gap) // (tried + 1), 0, count - 1)
        repeated = [wall if wall.size == 1 else np.tile(wall, tried) for wall in walls]
        code = codes(Points(stiffness[index].reshape(-1), *repeated)).reshape(tried, rows)
        stable = np.maximum(stable, np.where(code == STABLE, index, -1).max(axis=0))
        unstable = np.minimum(unstable, np.where(code == UNSTABLE, index, count).min(axis=0))
    ends = np.concatenate([[0.0], stiffness, [np.inf]])
    return ends[stable + 1], ends[unstable + 1]
