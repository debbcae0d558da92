"""A scene as configurations spell it, its parameters by dotted path: ``mass``, ``period``, ``velocity.cutoff``, ...

Device, timing and wall go by bare names, for each name is one thing there; velocity estimate, hand and coupling go by
their own: ``velocity.``, ``operator.``, ``coupling.``, ``actuator.``, ``modes.0.``.
"""

from __future__ import annotations

from dataclasses import MISSING, fields, replace
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from zwidth.parts.actuator import Actuator
from zwidth.parts.device import Coupling, Device
from zwidth.parts.linear_device import LinearDevice
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.operator import Operator
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import BackwardDifference, Velocity, name_estimate
from zwidth.parts.wall import NoWall, VirtualWall
from zwidth.words.errors import InputError, describe_choice
from zwidth.words.xp import is_jax


class Parts(Protocol):
    """A scene as those see it who are below it: its parts, and nothing that is asked of them."""

    # Of dataclasses.
    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def device(self) -> Device | LinearDevice | MeasuredDevice: ...
    @property
    def timing(self) -> Timing: ...
    @property
    def wall(self) -> VirtualWall: ...
    @property
    def velocity(self) -> Velocity: ...
    @property
    def operator(self) -> Operator | None: ...


AnyScene = TypeVar("AnyScene", bound=Parts)

_BARE = ("device", "timing", "wall")
# Parts that are replaced only as a whole, because they have no paths to single parameters.
_WHOLE = ("safe_limit",)
# The parts that a scene need not have, in the order in which it is described; those of the device are fields of it.
PARTS = {"operator": Operator, "coupling": Coupling, "actuator": Actuator}
_OF_DEVICE = ("coupling", "actuator")
_NAMED = ("velocity", *(name for name in PARTS if name not in _OF_DEVICE))


def find_parts(scene: Parts) -> dict[str, Any]:
    """The velocity estimate and the parts that a scene has, by name."""
    found = {name: getattr(scene, name) for name in _NAMED} | {name: getattr(scene.device, name) for name in _OF_DEVICE}
    found |= {f"modes.{k}": mode for k, mode in enumerate(scene.device.modes)}
    return {name: part for name, part in found.items() if part is not None}


def _parts(scene: Parts) -> list[tuple[str, str, Any]]:
    """Every part there is, the wall last: what its paths begin with, its field of the scene, and itself."""
    *bare, wall = (("", name, getattr(scene, name)) for name in _BARE)
    return [*bare, *((f"{name}.", name, part) for name, part in find_parts(scene).items()), wall]


def list_parameters(scene: Parts) -> dict[str, Any]:
    """Every number of a scene by its dotted path, those of the wall last."""
    found = {prefix + item.name: getattr(part, item.name) for prefix, _, part in _parts(scene) for item in fields(part)}
    return {
        path: value
        for path, value in found.items()
        if is_jax(value) or (isinstance(value, int | float | np.number) and not isinstance(value, bool))
    }


def replace_parameters(scene: AnyScene, changes: dict[str, Any]) -> AnyScene:
    """A new scene with some parameters, or whole parts, changed; everything else stays as it is in SI units."""
    # Numbers are those of the new parts.
    levels = {
        path: 0 if path in (*_BARE, *_NAMED, *_WHOLE) else 1 if path in (*_OF_DEVICE, "modes") else 2
        for path in changes
    }
    for level in sorted(set(levels.values())):
        scene = _replace_fields(scene, {path: value for path, value in changes.items() if levels[path] == level})
    return scene


def _replace_fields(scene: AnyScene, changes: dict[str, Any]) -> AnyScene:
    parts = {name: part for _, name, part in _parts(scene)}
    owners = {prefix + item.name: (name, item.name) for prefix, name, part in _parts(scene) for item in fields(part)}
    owners |= {name: ("", name) for name in (*_BARE, *_NAMED, *_WHOLE)}
    changed: dict[str, dict[str, Any]] = {}
    for path, value in changes.items():
        if path not in owners:
            raise InputError(f"parameter: {describe_choice(path, tuple(owners))}")
        part, name = owners[path]
        changed.setdefault(part, {})[name] = value
    if "rate" in changed.get("timing", {}):
        # Period and rate are one thing; what was given last counts.
        changed["timing"].setdefault("period", None)
    if "timing" in changed:
        # Pass a delay in its original unit, so that a delay in periods stays in periods if the period changes.
        changed["timing"].setdefault("delay", scene.timing.span)
    if isinstance(scene.wall, NoWall):
        parts["wall"] = VirtualWall(0.0)
    whole, own = changed.pop("", {}), changed.pop("device", {})
    made = {name: replace(parts[name], **new) for name, new in changed.items()}
    own |= {name: made.pop(name) for name in _OF_DEVICE if name in made}
    if any(name.startswith("modes.") for name in made):
        own["modes"] = tuple(made.pop(f"modes.{k}", mode) for k, mode in enumerate(scene.device.modes))
    if own:
        made["device"] = replace(scene.device, **own)
    return replace(scene, **whole, **made)


def spell_scene(scene: Any) -> dict[str, Any]:
    """The section ``scene`` of a configuration, with the keys that differ from their defaults."""
    parts: dict[str, Any] = {name: spell_part(part) for name, part in find_parts(scene).items() if name in PARTS}
    if scene.safe_limit is not None:
        parts["safe_limit"] = spell_part(scene.safe_limit)
    if scene.device.modes:
        parts["modes"] = [spell_part(mode) for mode in scene.device.modes]
    if isinstance(scene.device, LinearDevice):
        own: dict[str, Any] = {"device": scene.device.spell_form()}
    else:
        own = {name: value for name, value in spell_part(scene.device).items() if name not in (*PARTS, "modes")}
        own |= {"damping": scene.device.damping}
    return own | spell_part(scene.timing) | spell_part(scene.wall) | spell_estimate(scene.velocity) | parts


def spell_estimate(velocity: Velocity, *, every: bool = False) -> dict[str, Any]:
    """The key ``velocity``, nothing for the difference of two samples; ``every`` writes defaults as well."""
    given = {"kind": name_estimate(velocity), **spell_part(velocity, every=every)}
    return {} if velocity == BackwardDifference() else {"velocity": given}


def spell_part(part: Any, *, every: bool = False) -> dict[str, Any]:
    """The fields of a part that differ from their defaults, or every one that is not None."""
    values = {field.name: (getattr(part, field.name), field.default) for field in fields(part)}
    return {
        name: value
        for name, (value, default) in values.items()
        # A device is linear where nothing is said.
        if (value is not None if every else default is MISSING or value != default) and value is not False
    }
