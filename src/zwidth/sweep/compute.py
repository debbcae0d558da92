"""Compute the outputs of one block of a sweep over rigid devices.

The *family* of an output is "wall" (one value per wall) or "device" (one value per device). A *block* of the grid
contains D devices with A x B walls each: A normalized stiffnesses alpha and B normalized dampings beta per device, with
the normalized physical damping delta and the delay of d sampling periods (`sweep.grid`). A *line* is the set of walls
of one device with the same beta.

The value of a point must depend neither on the other points of its chunk nor on the process that computes it. But a
kernel may round differently if it is compiled for another batch size, and NumPy may round differently in the last
elements of an array, outside its vectorized loop. Therefore every kernel is called with *pieces*: batches of one fixed
size, whose points are all computed by the same compiled variant of the kernel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from itertools import product
from typing import TypeAlias

import numpy as np

from zwidth.core.status import Status
from zwidth.numerics.blocks import map_blocks
from zwidth.numerics.evaluate import Route
from zwidth.stability.rigid.dominant.arrays import WallPoles, area_poles, list_poles
from zwidth.stability.rigid.dominant.grid import Area
from zwidth.stability.rigid.margins import margins_kernel
from zwidth.stability.rigid.normalization import status_of_results
from zwidth.stability.rigid.passivity import compute_margins
from zwidth.stability.rigid.ridge import alpha_max
from zwidth.stability.rigid.step_response import decay_time
from zwidth.stability.rigid.stiffness_limit import row_limits
from zwidth.sweep.grid import Block
from zwidth.units.outputs import MARGIN_OUTPUTS, NOT_COMPUTED, OUTPUTS, RADIUS_OUTPUTS, STATUS_OF, Family

Columns: TypeAlias = list[np.ndarray]
Leaves: TypeAlias = Sequence[np.ndarray]

# Numbers of points per piece. Slow kernels have small pieces, because a single point takes as long as a full piece.
_PIECE = 1 << 9  # points per piece for the ridge and the stability margins
_LINE_PIECE = 1 << 12  # lines per piece for the largest stable alpha of each line
_WALL_PIECE = 1 << 12  # walls per piece for the passivity margin
MAX_EXPANDED = 1 << 20  # largest number of points whose parameters are expanded to full arrays at once, to limit memory
# Largest number of walls or lines in the whole grid for which NumPy is used, because it is then faster than importing
# JAX and compiling the kernel.
MAX_NUMPY = 1 << 20
# Smallest number of walls per device for which the dominant poles are computed by power series over cells of the grid
# (`stability.rigid.dominant.grid`). For fewer walls, each pole is computed separately.
MIN_GRID_WALLS = 1 << 8
_MARGINS = ("gain_margin", "phase_margin", "delay_margin", "modulus_margin")


_map_pieces = partial(map_blocks, threads=1, within=nullcontext, exact=True)


def compute_block(family: Family, outputs: tuple[str, ...], block: Block, accuracy: float) -> dict[str, np.ndarray]:
    """Compute outputs of one family on a block, and their status.

    Args:
        family: "wall" or "device".
        outputs: Names of the outputs.
        block: Normalized parameters of the block.
        accuracy: Largest error of the spectral radius.

    Returns:
        The outputs and the status of the family by name: arrays of shape (D, A, B) for walls, (D,) for devices.
    """
    values = _compute_devices(block) if family == "device" else _compute_walls(outputs, block, accuracy)
    return {name: values[name] for name in (*outputs, STATUS_OF[family])}


def _compute_devices(block: Block) -> dict[str, np.ndarray]:
    """Return the stiffest stable wall of each device and its status, as a dictionary of arrays of shape (D,)."""
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


def _compute_walls(outputs: tuple[str, ...], block: Block, accuracy: float) -> dict[str, np.ndarray]:
    """Return outputs of the family "wall" and their status by name, of shape (D, A, B).

    Args:
        outputs: Names of the outputs. Further outputs that need the same computation are also returned.
        block: Normalized parameters of the block.
        accuracy: Largest error of the spectral radius.
    """
    shape = (block.delta.size, block.alpha.shape[1], block.beta.shape[1])
    values: dict[str, np.ndarray] = {}
    not_certified, period = False, block.period[:, None, None]
    if RADIUS_OUTPUTS & set(outputs):
        with_angle = bool({"pole_angle", "frequency"} & set(outputs))
        if block.all_alpha.shape[1] * block.all_beta.shape[1] >= MIN_GRID_WALLS:
            area = Area(block.all_alpha, block.all_beta, block.delta, block.d, (block.betas, block.alphas))
            poles = area_poles(area, accuracy, True, with_angle).map(lambda leaf: leaf.transpose(0, 2, 1))
        else:
            route = _choose_route(block.lines * block.all_alpha.shape[1])
            listed = partial(list_poles, accuracy=accuracy, with_rate=True, with_angle=True, route=route)
            poles = WallPoles(*_apply_to_walls(listed, block, shape, leaves=4))
        values["spectral_radius"], not_certified, rate = poles.radius, poles.certified == 0, poles.rate
        if with_angle:
            values |= {"pole_angle": poles.angle, "frequency": poles.angle / (2.0 * np.pi * period)}
        # Compute these outputs from the logarithmic decay rate and not from the spectral radius, which rounds to 1 for
        # slow decay.
        values |= {"decay_rate": rate / period, "margin": -np.expm1(-rate), "settling_time": decay_time(rate) * period}
    if MARGIN_OUTPUTS & set(outputs):
        compute = partial(_compute_margins, "delay_margin" in outputs, "modulus_margin" in outputs)
        values |= dict(zip(_MARGINS, _apply_to_walls(compute, block, shape, leaves=4), strict=True))
        values["delay_margin"] = values["delay_margin"] * period
    if "stable" in outputs:
        values["stable"] = _decide_stability(block, shape)
    if {"passive", "passivity_margin"} & set(outputs):
        (margin,) = _apply_to_walls(_compute_passivity, block, shape, one_delay=True)
        values |= {"passivity_margin": margin, "passive": margin > 0}
    # Do not derive the status from the stability margins, because they are NaN for unstable walls even if the
    # computation succeeds.
    numbers = [values[name] for name in outputs if OUTPUTS[name].dtype == "float64" and name not in MARGIN_OUTPUTS]
    device = block.delta[:, None, None], block.d[:, None, None]
    walls = block.alpha[:, :, None], block.beta[:, None, :]
    values["status"] = status = status_of_results(shape, numbers, walls, device)
    status[not_certified & (status == Status.OK)] = Status.NOT_CONVERGED
    return values


def _decide_stability(block: Block, shape: tuple[int, ...]) -> np.ndarray:
    """Return a mask of the stable walls of a block, by comparing alpha with the largest stable alpha of each line.

    ``shape`` is (D, A, B).
    """
    stable = np.empty(shape, dtype=bool)
    limit = _compute_limits(block)
    for plane, alpha, ends in zip(stable, block.alpha, limit, strict=True):
        np.less(alpha[:, None], ends, out=plane)
        plane[~(alpha > 0)] = False
    return stable


def _choose_route(count: int) -> Route:
    """Return "numpy" for small grids and "jax" for large ones, given the number of points of the whole grid.

    The choice must not depend on the size of a chunk. The results of NumPy and JAX may differ in the last digit, and
    the value of a point must not depend on the division of the grid into chunks.
    """
    return "numpy" if count <= MAX_NUMPY else "jax"


def _compute_limits(block: Block) -> np.ndarray:
    """Return the largest stable alpha of every line, of shape (D, B)."""
    columns = [part.ravel() for part in np.broadcast_arrays(block.beta, block.delta[:, None], block.d[:, None])]
    limit = np.empty(block.beta.size)
    # Compute delays d < 1 and d >= 1 separately, because `row_limits` has one kernel for each range. If a piece
    # contained delays of both ranges, the batch sizes of the kernels would not be constant.
    for long in (False, True):
        # Write the comparison as in `row_limits`, so that both functions treat d = NaN as a short delay.
        index = np.flatnonzero((columns[2] >= 1) == long)
        if index.size:
            by_rows = partial(row_limits, route=_choose_route(block.lines))
            limit[index] = _map_pieces(by_rows, [column[index] for column in columns], _LINE_PIECE)
    return limit.reshape(block.beta.shape)


def _apply_to_walls(
    function: Callable[[Columns], Leaves],
    block: Block,
    shape: tuple[int, ...],
    leaves: int = 1,
    one_delay: bool = False,
) -> Leaves:
    """Apply a function to all walls of a block, with a bounded number of walls per call.

    Args:
        function: Function that maps flat arrays of alpha, beta, delta and d to ``leaves`` flat arrays.
        block: Block with D devices and A x B walls each.
        shape: (D, A, B).
        leaves: Number of arrays that the function returns.
        one_delay: True if all walls of one call must have the same delay.

    Returns:
        The results of the function for all walls: ``leaves`` arrays of shape (D, A, B).
    """
    results = tuple(np.empty(shape) for _ in range(leaves))
    rows = min(shape[1], max(1, MAX_EXPANDED // shape[2]))
    delays, which = np.unique(block.d if one_delay else np.zeros(block.d.size), return_inverse=True)
    for group in (np.flatnonzero(which == index) for index in range(delays.size)):
        step = max(1, MAX_EXPANDED // (rows * shape[2]))
        for start, row in product(range(0, group.size, step), range(0, shape[1], rows)):
            devices, alphas = group[start : start + step], slice(row, row + rows)
            walls = block.alpha[devices, alphas, None], block.beta[devices, None, :]
            device = block.delta[devices, None, None], block.d[devices, None, None]
            parameters = np.broadcast_arrays(*walls, *device)
            columns = [parameter.ravel() for parameter in parameters]
            for result, leaf in zip(results, function(columns), strict=True):
                result[devices, alphas] = leaf.reshape(parameters[0].shape)
    return results


def _compute_margins(with_delay: bool, with_modulus: bool, columns: Columns) -> Leaves:
    """Compute the gain, phase, delay and modulus margin of walls.

    Args:
        with_delay: Compute the delay margin, which needs a search; otherwise it is NaN.
        with_modulus: Compute the modulus margin, which needs a search; otherwise it is NaN.
        columns: Flat arrays of alpha, beta, delta and d.
    """

    def compute_piece(*piece: np.ndarray) -> Leaves:
        with np.errstate(all="ignore"):
            margins = margins_kernel(*piece, with_delay=with_delay, with_modulus=with_modulus)
        return tuple(np.asarray(getattr(margins, name)) for name in _MARGINS)

    return _map_pieces(compute_piece, columns, _PIECE)


def _compute_passivity(columns: Columns) -> Leaves:
    """Return the passivity margin of walls with the same delay, from flat arrays of alpha, beta, delta and d."""
    return (_map_pieces(compute_margins, columns, _WALL_PIECE),)
