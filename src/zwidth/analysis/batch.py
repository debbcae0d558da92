"""Stiffest walls of many scenes at once.

Scenes of one structure, i.e. with the same kinds of parts and the same orders, are evaluated together
(`zwidth.analysis.ensemble.Variants`). Pole counts confirm each result. A scene without a confirmed result is searched
by itself, by `Scene.max_stiffness`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from zwidth.analysis.base import check_scene
from zwidth.analysis.ensemble import Variants, list_further_parts
from zwidth.analysis.optimization import SceneOptima
from zwidth.analysis.walls import allows_negative
from zwidth.core.errors import InputError, describe_choice
from zwidth.core.status import RidgeKind, Status
from zwidth.core.types import ArrayLike
from zwidth.model.checks import read_texts
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.parameter_paths import find_parts
from zwidth.numerics.evaluate import as_float64, join_shapes
from zwidth.stability.results import RidgePoint
from zwidth.stability.rigid.ridge import alpha_max
from zwidth.units.display import compact_repr
from zwidth.units.quantities import FIELDS, WALL


@compact_repr(stiffness="N/m", virtual_damping="N s/m", frequency="Hz", kind=RidgeKind)
class StiffestWalls(NamedTuple):
    """Stiffest stable walls of many scenes; all arrays have one entry per scene."""

    stiffness: np.ndarray  # K_max in N/m
    virtual_damping: np.ndarray  # in N s/m
    frequency: np.ndarray  # frequency of the pole pair on the unit circle, in Hz
    kind: np.ndarray  # code of `zwidth.RidgeKind`
    status: np.ndarray  # code of `zwidth.Status`; the walls are NaN unless this code is 0
    searched: np.ndarray  # True if the scene was searched by itself


def stiffest_walls(
    scenes: Iterable[SceneOptima] | SceneOptima,
    parameters: Mapping[str, ArrayLike] | None = None,
    *,
    negative_damping: bool | None = None,
) -> StiffestWalls:
    """Return the stiffest stable wall of each of many scenes, as `Scene.max_stiffness` does for one scene.

    Args:
        scenes: scenes of any kinds; or one scene together with ``parameters``.
        parameters: arrays of values by dotted path, in SI units or as texts with units, such as
            ``{"velocity.cutoff": [50, 100]}``. They broadcast; all other parameters are those of the scene.
        negative_damping: as for `Scene.max_stiffness`.

    Returns:
        StiffestWalls of the broadcast shape, or of shape (scenes,): the fields of `Scene.max_stiffness`, and
        ``searched``. If a scene is invalid with its parameters, its wall is NaN with the status INVALID_INPUT.

    Raises:
        InputError: an object is not a scene, a parameter is unknown, or shapes do not broadcast.

    Numerics:
        The stability boundary of all scenes of one structure is evaluated together. Bisection for the largest K with a
        stable B, followed by Newton's method, yields the wall. Pole counts along lines of walls confirm that this wall
        is stable and connected to K = 0, and that no such wall is stiffer by more than a relative 4e-10
        (docs/theory/scenes.md, V23, V24). Scenes without this confirmation are searched one by one; in ordinary ranges
        of the parameters, these are up to one percent of the scenes. Fewer than 6 scenes of one structure are also
        searched one by one, because this takes less time. The result for a scene does not depend on the other scenes,
        apart from this choice of the method.

        The following times per scene are measured on one processor core. In a call with 20,000 scenes, a scene with a
        velocity filter takes 0.2 ms, and a scene with a coupling, a mode or an operator 0.3 to 0.5 ms. In a call with
        64 scenes, a scene takes 0.3 ms if all scenes have the same integer delay, otherwise up to 7 ms. A scene that is
        searched by itself takes 10 to 25 ms.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII (rigid device).

    Example:
        >>> import numpy as np
        >>> import zwidth
        >>> timing = zwidth.Timing(period=1e-3, delay=1e-3)
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), timing, velocity=zwidth.LowPass(cutoff=100))
        >>> walls = zwidth.stiffest_walls(scene, {"velocity.cutoff": np.geomspace(10, 400, 100)})
        >>> print(f"{walls.stiffness.min():.0f} to {walls.stiffness.max():.0f} N/m")
        6846 to 18729 N/m
    """
    if isinstance(scenes, SceneOptima):
        return _vary_scene(scenes, parameters or {}, negative_damping)
    if parameters is not None:
        raise InputError("parameters: allowed only together with one scene; pass a zwidth.Scene as the first argument")
    members = list(scenes)
    table = np.full((3, len(members)), np.nan)
    kind = np.full(len(members), int(RidgeKind.NONE), np.int32)
    status = np.full(len(members), int(Status.INVALID_INPUT), np.int32)
    searched = np.ones(len(members), bool)
    groups: dict[Any, list[int]] = {}
    for k, scene in enumerate(members):
        check_scene(scene, "stiffest_walls")
        if negative_damping is not None:
            allows_negative(scene, negative_damping)
        # Skip an invalid scene, such as one with a cutoff above the Nyquist frequency; its wall remains NaN.
        with suppress(InputError):
            groups.setdefault((_describe_structure(scene), allows_negative(scene, negative_damping)), []).append(k)
    for (_, negative), index in groups.items():
        walls = _solve_group([members[k] for k in index], negative)
        table[:, index], kind[index], status[index] = walls[:3], walls.kind, walls.status
        searched[index] = walls.searched
    return StiffestWalls._make([*table, kind, status, searched])


def _vary_scene(scene: SceneOptima, parameters: Mapping[str, ArrayLike], negative: bool | None) -> StiffestWalls:
    """Return the stiffest walls of one scene for arrays of parameters."""
    check_scene(scene, "stiffest_walls")
    known = {**scene.parameters(), "rate": 1.0}
    for name in parameters:
        if name not in known:
            raise InputError(f"parameters: {describe_choice(name, tuple(known))}")
    units = {name: scene.unit_system[FIELDS[name].unit] if name in FIELDS else "" for name in parameters}
    columns = {name: as_float64(name, read_texts(name, value, units[name])) for name, value in parameters.items()}
    shape = join_shapes((name, column.shape) for name, column in columns.items()) if columns else ()
    drawn = {name: np.broadcast_to(column, shape).ravel() for name, column in columns.items()}
    variants = scene.loop.vary(drawn or {"mass": np.full(1, float(scene.device.mass))})
    walls = _convert(variants, *variants.find_ridges(allows_negative(scene, negative))[:2])
    return StiffestWalls(*(column.reshape(shape) for column in walls))


class _ListedVariants(Variants):
    """Scenes of one structure, which differ in their parameters only."""

    def __init__(self, scenes: list[SceneOptima], drawn: dict[str, np.ndarray]) -> None:
        super().__init__(scenes[0], drawn)
        self.scenes = scenes

    def build(self, k: int) -> SceneOptima:
        return self.scenes[k]


def _solve_group(scenes: list[SceneOptima], negative: bool) -> StiffestWalls:
    """Return the stiffest walls of scenes of one structure."""
    parameters = [scene.parameters() for scene in scenes]
    names = [name for name, value in parameters[0].items() if isinstance(value, float) and name not in WALL]
    columns = {name: np.array([each[name] for each in parameters]) for name in names}
    # Do not vary the stiffness of a spring to ground that is 0 in all scenes, because models without this spring have a
    # different structure.
    variants = _ListedVariants(
        scenes, {name: c for name, c in columns.items() if name != "operator.stiffness" or c.any()}
    )
    if not scenes[0].nonrigid_parts and negative:
        point = alpha_max(*(np.array([float(getattr(scene, name)) for scene in scenes]) for name in ("delta", "d")))
        return _convert(variants, RidgePoint(*map(np.asarray, point)), np.zeros(len(scenes), bool))
    return _convert(variants, *variants.find_ridges(negative)[:2])


def _convert(variants: Variants, point: RidgePoint, searched: np.ndarray) -> StiffestWalls:
    """Convert the stiffest walls of variants from normalized to SI units."""
    mass, period = variants.normalized.mass, variants.normalized.period
    with np.errstate(all="ignore"):
        rate = mass / period
        numbers = point.alpha * rate / period, point.beta * rate, point.omega / (2.0 * math.pi * period)
    return StiffestWalls._make([*numbers, point.kind.astype(np.int32), point.status.astype(np.int32), searched])


def _describe_structure(scene: SceneOptima) -> tuple[Any, ...]:
    """Return a hashable description of the structure of a scene: everything except its continuous parameters."""
    if isinstance(scene.device, MeasuredDevice) or list_further_parts(scene):
        return (id(scene),)
    parts = {"device": scene.device, **find_parts(scene)}
    described: list[Any] = []
    for name, part in parts.items():
        described.append((name, type(part)))
        for item in fields(part):
            value = getattr(part, item.name)
            if not isinstance(value, float | np.floating) and item.name not in ("coupling", "actuator", "modes"):
                described.append((name, item.name, value))
    ground = scene.operator is not None and scene.operator.stiffness == 0
    return (*described, ground, not scene.nonrigid_parts)
