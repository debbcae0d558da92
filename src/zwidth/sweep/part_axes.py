"""Sweeps over the parameters of a velocity filter, a hand and a coupling: the scene at a point, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, fields
from typing import TYPE_CHECKING

from zwidth.config.faults import LocatedProblem, problem
from zwidth.config.parts import build_parts, locate_refusal
from zwidth.parts.device import Device
from zwidth.parts.paths import PARTS
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import BackwardDifference
from zwidth.scenes.scene import Scene
from zwidth.words.errors import InputError
from zwidth.words.quantities import WALL

if TYPE_CHECKING:
    from zwidth.sweep.study import Axes, SweepStudy

_EXAMPLES = {
    "velocity": "velocity: {kind: low_pass, cutoff: 100 Hz}",
    "coupling": "coupling: {mass: 50 g, stiffness: 20 kN/m}",
}


def make_scene(study: SweepStudy, values: dict[str, float]) -> Scene:
    """The scene at a point of the grid, from the parameters that the axes give.

    Raises:
        InputError: the parts refuse the values.
    """
    given = dict(values)
    period = 1.0 / given.pop("rate") if "rate" in given else given.pop("period")
    delay = given.pop("delay", 0.0) * (period if study.axes.delay_in_periods else 1.0)
    parts = build_parts(study)
    for name in given:
        part = name.partition(".")[0]
        if part in PARTS and part not in parts:
            parts[part] = PARTS[part]()
    device = Device(mass=given.pop("mass"), damping=given.pop("damping", 0.0))
    return Scene(device, Timing(period=period, delay=delay)).replace(**parts, **given)


def find_faults(study: SweepStudy) -> Iterator[LocatedProblem]:
    """Axes of parts that are not there, and values that the parts refuse."""
    axes = study.axes
    absent = [name for name in axes.given_of_parts if not _has_parameter(study, name)]
    for name in absent:
        part, _, key = name.partition(".")
        what = f"got the axis {name!r}, but no {part} with the key {key!r}"
        remedy = f"add {_EXAMPLES.get(part, part)!r}"
        yield _place_axis(axes, name), problem(what, "an axis changes a part that is there", remedy)
    found = {} if absent else {str(error): locate_refusal(error) for error in _find_refusals(study)}
    for field, what in found.values():
        name = ".".join(map(str, field))
        yield (_place_axis(axes, name) if name in axes.given else ("axes",)), what


def _has_parameter(study: SweepStudy, name: str) -> bool:
    """Whether the part that an axis belongs to is there, and has such a key."""
    part, _, key = name.partition(".")
    section = getattr(study, part)
    kind = section.part if section is not None else PARTS.get(part, BackwardDifference)
    # A part that has no section is there where it needs no numbers.
    needed = section is None and any(item.default is MISSING for item in fields(kind))
    return not needed and key in kind.__dataclass_fields__


def _place_axis(axes: Axes, name: str) -> tuple[str, ...]:
    return ("axes", "devices") if getattr(axes, name) is None else ("axes", name)


def _find_refusals(study: SweepStudy) -> Iterator[InputError]:
    """What the parts refuse with every parameter at its least value, and with those of parts at their ends in turn."""
    least = {name: study.axes.end(name, largest=False) for name in study.axes.given if name not in WALL}
    ends = [{name: study.axes.end(name, largest=True)} for name in study.axes.given_of_parts]
    for changed in ({}, *ends):
        try:
            make_scene(study, {**least, **changed}).check_parts()
        except InputError as error:
            yield error
