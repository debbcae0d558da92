"""Parameters of a scene by dotted path, and the conversion of a scene to the mapping of a configuration file.

The path of a parameter of device, timing or wall is its name: ``mass``, ``period``, ``stiffness``. The path of a
parameter of another part begins with the name of the part: ``velocity.cutoff``, ``operator.mass``,
``coupling.stiffness``, ``actuator.order``, ``modes.0.frequency``.
"""

from __future__ import annotations

from dataclasses import MISSING, fields, replace
from typing import Any, ClassVar, Protocol, Self, TypeVar, cast

import numpy as np

from zwidth.core.errors import InputError, describe_choice
from zwidth.core.xp import is_jax
from zwidth.model.actuator import Actuator
from zwidth.model.device import Coupling, Device
from zwidth.model.feedback import FEEDBACKS, Feedback, IntegralFeedback
from zwidth.model.joint_space import JointDevice
from zwidth.model.linear_device import LinearDevice
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.operator import Operator
from zwidth.model.position import POSITIONS, Position
from zwidth.model.timing import Timing
from zwidth.model.tool import Tool
from zwidth.model.velocity import BackwardDifference, Velocity, name_estimate
from zwidth.model.wall import NoWall, VirtualWall


class Parts(Protocol):
    """The fields of a scene, for type annotations in modules that cannot import `zwidth.Scene` (circular import)."""

    __dataclass_fields__: ClassVar[dict[str, Any]]  # allows calls of `dataclasses.replace`

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
    @property
    def tool(self) -> Tool | None: ...
    @property
    def position(self) -> Position | None: ...
    @property
    def feedback(self) -> Feedback | IntegralFeedback | None: ...
    def _rebuild(self) -> Self: ...


AnyScene = TypeVar("AnyScene", bound=Parts)

_BARE = ("device", "timing", "wall")  # parts whose parameters have paths without prefix
_WHOLE = ("safe_limit",)  # parts that can only be replaced as a whole, because their parameters have no paths
PARTS = {"operator": Operator, "coupling": Coupling, "actuator": Actuator, "tool": Tool}
"""Classes of the optional parts of a scene, by name, in the order in which descriptions list these parts."""
CONTAINED = ("operator", "coupling", "actuator", "modes")
"""Parts that a linear system or a measured response already contains, so that they cannot be added to it."""
WITH_KIND: dict[str, dict[str, Any]] = {"position": POSITIONS, "feedback": FEEDBACKS}
"""Classes of position estimates and of further feedback, keyed by the name of the part and the name of the kind."""
_OF_DEVICE = ("coupling", "actuator")  # optional parts that are fields of the device
# Fields of the scene with whose names the paths of their parameters begin.
_NAMED = ("velocity", *WITH_KIND, *(name for name in PARTS if name not in _OF_DEVICE))


def find_parts(scene: Parts) -> dict[str, Any]:
    """Return a dictionary, by name, of the velocity estimate and of the optional parts and modes that a scene has."""
    parts = {name: getattr(scene, name) for name in _NAMED} | {name: getattr(scene.device, name) for name in _OF_DEVICE}
    parts |= {f"modes.{k}": mode for k, mode in enumerate(scene.device.modes)}
    return {name: part for name, part in parts.items() if part is not None}


def _parts(scene: Parts) -> list[tuple[str, str, Any]]:
    """Return a tuple (path prefix of the parameters, name, part) for each part of a scene, with the wall last."""
    *bare, wall = (("", name, getattr(scene, name)) for name in _BARE)
    return [*bare, *((f"{name}.", name, part) for name, part in find_parts(scene).items()), wall]


def list_parameters(scene: Parts) -> dict[str, Any]:
    """Return a dictionary of all numeric parameters of a scene by dotted path, the parameters of the wall last."""
    values = {
        prefix + item.name: getattr(part, item.name) for prefix, _, part in _parts(scene) for item in fields(part)
    }
    return {
        path: value
        for path, value in values.items()
        if is_jax(value) or (isinstance(value, int | float | np.number) and not isinstance(value, bool))
    }


def replace_parameters(scene: AnyScene, changes: dict[str, Any]) -> AnyScene:
    """Return a copy of a scene with some parameters or parts replaced.

    All other parameters keep their values in SI units, except that a delay in periods keeps its number of periods.

    Args:
        scene: the scene.
        changes: new values by dotted path, or new parts by name.
    """
    # Replace whole parts of the scene first, then whole parts of the device, then single parameters, because the
    # parameters refer to the new parts.
    levels = {
        path: 0 if path in (*_BARE, *_NAMED, *_WHOLE) else 1 if path in (*_OF_DEVICE, "modes") else 2
        for path in changes
    }
    for level in sorted(set(levels.values())):
        scene = _replace_fields(scene, {path: value for path, value in changes.items() if levels[path] == level})
    return scene


def _replace_fields(scene: AnyScene, changes: dict[str, Any]) -> AnyScene:
    """Return a copy of a scene with the new values in ``changes``, by path; raise `InputError` for an unknown path."""
    parts = {name: part for _, name, part in _parts(scene)}
    owners = {prefix + item.name: (name, item.name) for prefix, name, part in _parts(scene) for item in fields(part)}
    owners |= {name: ("", name) for name in (*_BARE, *_NAMED, *_WHOLE)}
    # Add the paths of joint dampings, which are not fields of the class `JointDevice`.
    owners |= {path: ("joints", path) for path in getattr(scene.device, "joint_dampings", ())}
    changed: dict[str, dict[str, Any]] = {}
    for path, value in changes.items():
        if path not in owners and path.startswith("joints.") and isinstance(scene.device, Device):
            raise InputError(
                f"{path}: the device is a rigid mass along this direction and has no joint dampings; change 'damping', "
                "or create the device again"
            )
        if path not in owners:
            raise InputError(f"parameter: {describe_choice(path, tuple(owners))}")
        part, name = owners[path]
        changed.setdefault(part, {})[name] = value
    if "rate" in changed.get("timing", {}):
        # Pass None as the period, because `Timing` accepts either period or rate.
        changed["timing"].setdefault("period", None)
    if "timing" in changed:
        # If the user gave the delay as a number of periods, this number must not change with the sampling period.
        # Therefore pass the delay as it was given, because `replace` would pass it in seconds.
        changed["timing"].setdefault("delay", scene.timing.span)
    if isinstance(scene.wall, NoWall):
        parts["wall"] = VirtualWall(0.0)
    whole_parts, device_fields = changed.pop("", {}), changed.pop("device", {})
    joint_dampings = changed.pop("joints", {})
    new_parts = {name: replace(parts[name], **values) for name, values in changed.items()}
    device_fields |= {name: new_parts.pop(name) for name in _OF_DEVICE if name in new_parts}
    if any(name.startswith("modes.") for name in new_parts):
        device_fields["modes"] = tuple(new_parts.pop(f"modes.{k}", mode) for k, mode in enumerate(scene.device.modes))
    if device_fields:
        new_parts["device"] = replace(scene.device, **device_fields)
    if joint_dampings:
        new_parts["device"] = cast(JointDevice, scene.device).replace_dampings(joint_dampings)
    return replace(scene, **whole_parts, **new_parts)


def spell_scene(scene: Any) -> dict[str, Any]:
    """Return the section ``scene`` of a configuration as a dictionary, without keys that have their default values."""
    parts: dict[str, Any] = {name: spell_part(part) for name, part in find_parts(scene).items() if name in PARTS}
    for name, kinds in WITH_KIND.items():
        part = getattr(scene, name)
        if part is not None:
            parts[name] = spell_kind(part, kinds)
    if scene.safe_limit is not None:
        parts["safe_limit"] = spell_part(scene.safe_limit)
    if scene.device.modes:
        parts["modes"] = [spell_part(mode) for mode in scene.device.modes]
    if isinstance(scene.device, LinearDevice):
        device: dict[str, Any] = {"device": scene.device.spell_form()}
        device |= {"rotary": True} if scene.device.rotary else {}
    else:
        device = {name: value for name, value in spell_part(scene.device).items() if name not in (*PARTS, "modes")}
        device |= {"damping": scene.device.damping}
    return device | spell_part(scene.timing) | spell_part(scene.wall) | spell_estimate(scene.velocity) | parts


def spell_estimate(velocity: Velocity, *, every: bool = False) -> dict[str, Any]:
    """Return a dictionary with the key ``velocity`` of a configuration; empty for the default, the backward difference.

    Args:
        velocity: the velocity estimate.
        every: include parameters that have their default values.
    """
    given = {"kind": name_estimate(velocity), **spell_part(velocity, every=every)}
    return {} if velocity == BackwardDifference() else {"velocity": given}


def spell_kind(part: Any, kinds: dict[str, Any]) -> dict[str, Any]:
    """Return a dictionary with the key ``kind`` and with the fields of a part that differ from their defaults.

    ``kinds`` contains the class of each kind.
    """
    for kind, each in kinds.items():
        if type(part) is each:
            return {"kind": kind, **spell_part(part)}
    names = ", ".join(each.__name__ for each in kinds.values())
    raise InputError(f"part: got {type(part).__name__}, which is not available in configurations; use one of {names}")


def spell_part(part: Any, *, every: bool = False) -> dict[str, Any]:
    """Return a dictionary of the fields of a part that differ from their defaults.

    Args:
        part: the part.
        every: return all fields that are not None instead.
    """
    values = {field.name: (getattr(part, field.name), field.default) for field in fields(part)}
    return {
        name: value
        for name, (value, default) in values.items()
        # Omit ``rotary=False``, because a device is linear by default.
        if (value is not None if every else default is MISSING or value != default) and value is not False
    }


def fill_parameters(scene: AnyScene, values: dict[str, Any]) -> AnyScene:
    """Return an unchecked copy of a scene in which parameters are arrays; only `build_chain` accepts such a scene.

    Args:
        scene: the scene.
        values: arrays by dotted path, such as ``{"mass": numpy.array([0.1, 0.2])}``.
    """
    parts = {name: copy_unchecked(part) for _, name, part in _parts(scene)}
    for prefix, name, part in _parts(scene):
        for item in fields(part):
            if prefix + item.name in values:
                object.__setattr__(parts[name], item.name, values[prefix + item.name])
    modes = tuple(parts[f"modes.{k}"] for k in range(len(scene.device.modes)))
    own = {name: parts[name] for name in _OF_DEVICE if name in parts} | ({"modes": modes} if modes else {})
    for name, part in own.items():
        object.__setattr__(parts["device"], name, part)
    filled = copy_unchecked(scene)
    for name in (*_BARE, *_NAMED):
        if name in parts:
            object.__setattr__(filled, name, parts[name])
    return filled


def copy_unchecked(part: Any) -> Any:
    """Return a copy of a part or a scene, without checks and without its cached properties."""
    new = object.__new__(type(part))
    for item in fields(part):
        object.__setattr__(new, item.name, getattr(part, item.name))
    return new
