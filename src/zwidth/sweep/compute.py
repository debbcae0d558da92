"""The outputs of one block of a sweep.

A point's value must not depend on which other points its chunk holds, nor on who computes it. Every kernel therefore
runs on pieces of one fixed size, of points that share what decides its shape: two compilations of one kernel, for
batches of two sizes, may round differently, and so may NumPy at the end of a list.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from itertools import product
from typing import TypeAlias

import numpy as np

from zwidth.arrays.blocks import map_blocks
from zwidth.arrays.evaluate import Route
from zwidth.loops.rigid.margins import margins_kernel
from zwidth.loops.rigid.normalization import status_of_results
from zwidth.loops.rigid.outermost_poles import area_poles, list_poles
from zwidth.loops.rigid.passivity import margin_at_one_delay
from zwidth.loops.rigid.pole_map import Area
from zwidth.loops.rigid.response import decay_time
from zwidth.loops.rigid.ridge import alpha_max
from zwidth.loops.rigid.row_limit import row_limits
from zwidth.sweep.grid import Block
from zwidth.words.quantities import MARGIN_OUTPUTS, NOT_COMPUTED, OUTPUTS, RADIUS_OUTPUTS, STATUS_OF, Family
from zwidth.words.status import Status

Columns: TypeAlias = list[np.ndarray]
Leaves: TypeAlias = Sequence[np.ndarray]

# Small where a point is expensive, for a sweep of a few points pays for a whole piece; the last one is for rows.
_PIECE = 1 << 9
_ROW_PIECE = 1 << 12
_WALL_PIECE = 1 << 12
# Points whose columns are laid out at one time; more of them run one after the other.
_LAID_OUT = 1 << 20
# Walls or rows of a whole grid with which NumPy is done before a compiler, and all that it needs, is ready.
_FEW = 1 << 20
# Walls of one device that are worth a map.
_SMALLEST_PLANE = 1 << 8
_MARGINS = ("gain_margin", "phase_margin", "delay_margin", "modulus_margin")


_map_pieces = partial(map_blocks, threads=1, within=nullcontext, exact=True)


def compute(family: Family, outputs: tuple[str, ...], block: Block, accuracy: float) -> dict[str, np.ndarray]:
    """Every output of a family on a block, and its status; walls in shape (D, A, B), devices in shape (D,)."""
    found = _devices(block) if family == "device" else _walls(outputs, block, accuracy)
    return {name: found[name] for name in (*outputs, STATUS_OF[family])}


def _devices(block: Block) -> dict[str, np.ndarray]:
    alpha, beta, _, kind, status = _map_pieces(alpha_max, (block.delta, block.d), _PIECE)
    rate = block.mass / block.period
    return {
        "alpha_max": alpha,
        "beta_at_max": beta,
        "kind": np.where(status == Status.OK, kind, NOT_COMPUTED).astype(np.uint8),
        "ridge_status": status.astype(np.uint8),
        "stiffness_max": alpha * rate / block.period,
        "virtual_damping_at_max": beta * rate,
    }


def _walls(outputs: tuple[str, ...], block: Block, accuracy: float) -> dict[str, np.ndarray]:
    shape = (block.delta.size, block.alpha.shape[1], block.beta.shape[1])
    found: dict[str, np.ndarray] = {}
    unproved, period = False, block.period[:, None, None]
    if RADIUS_OUTPUTS & set(outputs):
        if block.all_alpha.shape[1] * block.all_beta.shape[1] >= _SMALLEST_PLANE:
            area = Area(block.all_alpha, block.all_beta, block.delta, block.d, (block.betas, block.alphas))
            poles = area_poles(area, accuracy, with_rate=True)
            radius, proved, rate = (leaf.transpose(0, 2, 1) for leaf in poles)
        else:
            listed = partial(
                list_poles, accuracy=accuracy, with_rate=True, route=_route(block.rows * block.all_alpha.shape[1])
            )
            radius, proved, rate = _by_device(listed, block, shape, leaves=3)
        found["spectral_radius"], unproved = radius, proved == 0
        # Of the rate, not of the radius: that rounds to 1 where the decay is slow.
        found |= {"decay_rate": rate / period, "margin": -np.expm1(-rate), "settling_time": decay_time(rate) * period}
    if MARGIN_OUTPUTS & set(outputs):
        compute = partial(_margins, "delay_margin" in outputs, "modulus_margin" in outputs)
        found |= dict(zip(_MARGINS, _by_device(compute, block, shape, leaves=4), strict=True))
        found["delay_margin"] = found["delay_margin"] * period
    if "stable" in outputs:
        found["stable"] = _stable(block, shape)
    if {"passive", "passivity_margin"} & set(outputs):
        (margin,) = _by_device(_passivity, block, shape, one_delay=True)
        found |= {"passivity_margin": margin, "passive": margin > 0}
    # Of a wall that is unstable margins are NaN.
    numbers = [found[name] for name in outputs if OUTPUTS[name].dtype == "float64" and name not in MARGIN_OUTPUTS]
    device = block.delta[:, None, None], block.d[:, None, None]
    walls = block.alpha[:, :, None], block.beta[:, None, :]
    found["status"] = status = status_of_results(shape, numbers, walls, device)
    status[unproved & (status == Status.OK)] = Status.NOT_CONVERGED
    return found


def _stable(block: Block, shape: tuple[int, ...]) -> np.ndarray:
    """Which walls are stable: those below the limit of their row."""
    stable = np.empty(shape, dtype=bool)
    limit = _limits(block)
    for plane, alpha, ends in zip(stable, block.alpha, limit, strict=True):
        np.less(alpha[:, None], ends, out=plane)
        plane[~(alpha > 0)] = False
    return stable


def _route(count: int) -> Route:
    """NumPy, or a compiler: one of them for the whole grid, for they may differ in the last place."""
    return "numpy" if count <= _FEW else "jax"


def _limits(block: Block) -> np.ndarray:
    """The stiffest stable alpha of every device and beta, shape (D, B)."""
    columns = [part.ravel() for part in np.broadcast_arrays(block.beta, block.delta[:, None], block.d[:, None])]
    limit = np.empty(block.beta.size)
    # Delays below one period have a kernel of their own: with both in a piece, its size would vary.
    for long in (False, True):
        # As `row_limits` itself tells them apart: a delay that is NaN is not long.
        index = np.flatnonzero((columns[2] >= 1) == long)
        if index.size:
            by_rows = partial(row_limits, route=_route(block.rows))
            limit[index] = _map_pieces(by_rows, [column[index] for column in columns], _ROW_PIECE)
    return limit.reshape(block.beta.shape)


def _by_device(
    function: Callable[[Columns], Leaves],
    block: Block,
    shape: tuple[int, ...],
    leaves: int = 1,
    one_delay: bool = False,
) -> Leaves:
    """Apply a function of columns, of one delay or of all of them, to the walls of a block; it gives so many arrays."""
    results = tuple(np.empty(shape) for _ in range(leaves))
    rows = min(shape[1], max(1, _LAID_OUT // shape[2]))
    delays, which = np.unique(block.d if one_delay else np.zeros(block.d.size), return_inverse=True)
    for group in (np.flatnonzero(which == index) for index in range(delays.size)):
        step = max(1, _LAID_OUT // (rows * shape[2]))
        for start, row in product(range(0, group.size, step), range(0, shape[1], rows)):
            devices, alphas = group[start : start + step], slice(row, row + rows)
            walls = block.alpha[devices, alphas, None], block.beta[devices, None, :]
            device = block.delta[devices, None, None], block.d[devices, None, None]
            parameters = np.broadcast_arrays(*walls, *device)
            columns = [parameter.ravel() for parameter in parameters]
            for result, leaf in zip(results, function(columns), strict=True):
                result[devices, alphas] = leaf.reshape(parameters[0].shape)
    return results


def _margins(with_delay: bool, with_modulus: bool, columns: Columns) -> Leaves:
    """The four margins; the two that take a search are NaN where nobody asks for them."""

    def of_piece(*piece: np.ndarray) -> Leaves:
        with np.errstate(all="ignore"):
            found = margins_kernel(*piece, with_delay=with_delay, with_modulus=with_modulus)
        return tuple(np.asarray(getattr(found, name)) for name in _MARGINS)

    return _map_pieces(of_piece, columns, _PIECE)


def _passivity(columns: Columns) -> Leaves:
    *walls, d = columns
    return (_map_pieces(partial(margin_at_one_delay, d=float(d[0])), walls, _WALL_PIECE),)
