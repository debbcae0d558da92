"""The outputs of one block of a sweep whose devices have parts: a scene for each device, then its rows."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from zwidth.scenes.scene import Scene
from zwidth.sweep.grid import SceneBlock
from zwidth.sweep.study import SweepStudy
from zwidth.words.errors import InputError, ZwidthError
from zwidth.words.quantities import OUTPUTS, STATUS_OF, Family
from zwidth.words.status import Status


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
    found = {
        name: np.zeros(shape, bool) if OUTPUTS[name].dtype == "bool" else np.full(shape, np.nan) for name in outputs
    }
    status = np.full(shape, Status.OK, np.uint8)
    for k in range(devices):
        values = {name: float(column[k]) for name, column in block.parameters.items()}
        try:
            scene = _keep(study.make_scene(values))
            if family == "wall":
                walls = block.stiffness[k][:, None], block.virtual_damping[k][None, :]
                one, told = _compute_walls(scene, outputs, *walls)
            else:
                top = scene.max_stiffness()
                one, told = {"stiffness_max": top.stiffness, "virtual_damping_at_max": top.virtual_damping}, top.status
        except InputError:
            status[k] = Status.INVALID_INPUT
            continue
        except (ZwidthError, ArithmeticError):
            status[k] = Status.NOT_CONVERGED
            continue
        status[k] = told
        for name in outputs:
            found[name][k] = one[name]
    return {**found, STATUS_OF[family]: status}


def _compute_walls(
    scene: Scene, outputs: tuple[str, ...], stiffness: np.ndarray, virtual_damping: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The outputs of one device's walls, and where one of them is not known."""
    found: dict[str, np.ndarray] = {}
    unknown = np.zeros((stiffness.size, virtual_damping.size), bool)
    if "stable" in outputs:
        # With a row a damping its intervals serve all of its walls.
        found["stable"] = np.asarray(scene.is_stable(stiffness.T, virtual_damping.T)).T
    if "spectral_radius" in outputs:
        found["spectral_radius"] = radius = np.asarray(scene.spectral_radius(stiffness, virtual_damping))
        unknown |= np.isnan(radius)
    if "passive" in outputs:
        margin = np.asarray(scene.passivity_margin(stiffness, virtual_damping))
        found["passive"] = margin > 0
        unknown |= np.isnan(margin)
    return found, np.where(unknown, Status.NOT_CONVERGED, Status.OK)
