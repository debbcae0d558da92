"""A scene as a configuration spells it."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any

from zwidth.parts.paths import PARTS, find_parts
from zwidth.parts.velocity import BackwardDifference, Velocity, name_estimate


def spell_scene(scene: Any) -> dict[str, Any]:
    """The section ``scene`` of a configuration, with the keys that differ from their defaults."""
    parts = {name: spell_part(part) for name, part in find_parts(scene).items() if name in PARTS}
    own = {name: value for name, value in spell_part(scene.device).items() if name not in PARTS}
    own |= {"damping": scene.device.damping} | spell_part(scene.timing) | spell_part(scene.wall)
    return own | spell_estimate(scene.velocity) | parts


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
        if (value is not None if every else default is MISSING or value != default)
    }
