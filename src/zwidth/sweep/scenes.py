"""The outputs of one block of a sweep whose devices have parts: a scene for each device, then its rows."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from zwidth.errors import InputError, ZwidthError
from zwidth.quantities import STATUS_OF, Family
from zwidth.scene import Scene
from zwidth.status import Status
from zwidth.sweep.grid import SceneBlock
from zwidth.sweep.part_axes import make_scene
from zwidth.sweep.stiffest import find_stiffest
from zwidth.sweep.study import SweepStudy


@lru_cache(maxsize=64)
def _keep(scene: Scene) -> Scene:
    """The scene that has laid out its boundary already, where an equal one has."""
    return scene


def compute_scenes(
    family: Family, outputs: tuple[str, ...], study: SweepStudy, block: SceneBlock
) -> dict[str, np.ndarray]:
    """Every output of a family on a block, and its status; walls in shape (D, A, B), devices in shape (D,)."""
    devices = block.stiffness.shape[0]
    shape = (devices, block.stiffness.shape[1], block.virtual_damping.shape[1]) if family == "wall" else (devices,)
    found = {name: np.zeros(shape, bool) if name == "stable" else np.full(shape, np.nan) for name in outputs}
    status = np.full(shape, Status.OK, np.uint8)
    for k in range(devices):
        values = {name: float(column[k]) for name, column in block.parameters.items()}
        try:
            scene = _keep(make_scene(study, values))
            one = _compute_walls(scene, block, k) if family == "wall" else _compute_device(scene)
        except InputError:
            status[k] = Status.INVALID_INPUT
            continue
        except (ZwidthError, ArithmeticError):
            status[k] = Status.NOT_CONVERGED
            continue
        for name in outputs:
            found[name][k] = one[name]
    return {**found, STATUS_OF[family]: status}


def _compute_walls(scene: Scene, block: SceneBlock, k: int) -> dict[str, np.ndarray]:
    """Whether the walls of one device are stable: those within the intervals of their row."""
    stiffness = block.stiffness[k][:, None]
    # Shape (rows, most intervals of a row, 2).
    ends = scene.stable_stiffness(block.virtual_damping[k])
    stable = np.zeros((stiffness.size, ends.shape[0]), bool)
    for low, high in np.moveaxis(ends, (1, 2), (0, 1)):
        stable |= (stiffness > low) & (stiffness < high)
    return {"stable": stable}


def _compute_device(scene: Scene) -> dict[str, float]:
    top = find_stiffest(scene)
    return {"stiffness_max": top.stiffness, "virtual_damping_at_max": top.virtual_damping}
