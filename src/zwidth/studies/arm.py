"""Maximum stiffness of walls on an arm with several joints, over the poses and directions of a workspace study.

A *pose* contains the position of each joint. The wall acts on one point of the arm, along one *direction*. The arm is a
MuJoCo model (`zwidth.from_mujoco`). K and B are the stiffness and damping of the wall, and K_max is the maximum stable
stiffness.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property, partial
from itertools import product
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import PlainSerializer, PlainValidator, ValidationError, WithJsonSchema
from pydantic_core import PydanticCustomError

from zwidth import plotting
from zwidth.analysis.batch import stiffest_walls
from zwidth.analysis.scene import Scene
from zwidth.config.device_table import find_file
from zwidth.config.fields import LocatedProblem, Strict, combine_problems, list_problems, problem
from zwidth.config.parts import parse_message
from zwidth.config.values import Axis, AxisOf, Quantity
from zwidth.core.errors import InputError
from zwidth.model.mujoco_model import check_point, from_mujoco, list_joints, load_model
from zwidth.model.timing import Timing
from zwidth.plotting import style
from zwidth.plotting.table import SI_COLUMNS
from zwidth.studies.outcome import Outcome, track_progress
from zwidth.units.formatting import describe, format_wall, header, round_conservatively, suggestion, with_unit
from zwidth.units.parsing import detect_kind
from zwidth.units.quantities import RECOMMENDED_SHARE
from zwidth.units.unit_system import UnitSystem

_ANGLE, _LENGTH = AxisOf(Quantity("rad", turns=False)), AxisOf(Quantity("m", turns=False))
_AXES = ("x", "y", "z")


class JointAxis(NamedTuple):
    """All positions of one joint in a study, in rad or m."""

    axis: Axis
    is_angle: bool | None  # True for angles, False for lengths, None if the configuration contains no units


def _read_joints(raw: Any) -> dict[str, JointAxis]:
    """Validate the field ``joints``, which maps names of joints to positions; return it with positions in SI units."""
    if not isinstance(raw, dict) or not raw:
        raise problem(f"got {describe(raw)}", "joints are a mapping of names to positions", "write {elbow: [30 deg]}")
    joints: dict[str, JointAxis] = {}
    problems: list[LocatedProblem] = []
    for name, given in raw.items():
        kinds = {kind for text in _list_texts(given) if (kind := detect_kind(text)) is not None}
        is_angle = max(kinds) if kinds else None
        try:
            joints[name] = JointAxis((_LENGTH if is_angle is False else _ANGLE).read(given), is_angle)
        except (PydanticCustomError, ValidationError) as error:
            problems += list_problems(error, name)
    if problems:
        raise combine_problems("joints", problems)
    return joints


def _list_texts(raw: Any) -> list[str]:
    """Return all texts in a value of a configuration, including those in nested lists and mappings."""
    if isinstance(raw, str):
        return [raw]
    entries = raw.values() if isinstance(raw, dict) else raw if isinstance(raw, list | tuple) else ()
    return [text for entry in entries for text in _list_texts(entry)]


def _read_directions(raw: Any) -> tuple[Any, ...]:
    """Validate a list of directions, each "x", "y", "z" or a vector of three numbers; return names and tuples."""
    allowed, remedy = "directions are a list of x, y, z and vectors", "write [x, y, [1, 1, 0]]"
    if not isinstance(raw, list | tuple) or not raw:
        raise problem(f"got {describe(raw)}", allowed, remedy)
    for index, entry in enumerate(raw):
        is_vector = isinstance(entry, list | tuple) and len(entry) == 3 and any(entry)
        numbers = is_vector and all(type(each) in (int, float) and np.isfinite(each) for each in entry)
        if not numbers and entry not in _AXES:
            raise combine_problems("directions", [((index,), problem(f"got {describe(entry)}", allowed, remedy))])
    return tuple(entry if isinstance(entry, str) else tuple(entry) for entry in raw)


def _spell_joints(joints: dict[str, JointAxis]) -> dict[str, Any]:
    """Return the field ``joints`` as in a configuration, with a unit for each joint whose positions had a unit."""
    spelled = {}
    for name, (axis, is_angle) in joints.items():
        unit = {True: " rad", False: " m", None: ""}[is_angle]
        written = axis.serialize()
        spelled[name] = _map_numbers(written, unit) if unit else written
    return spelled


def _map_numbers(written: Any, unit: str) -> Any:
    """Return the positions of a joint as in a configuration, with a unit after each number except the count ``num``."""
    if isinstance(written, dict):
        return {key: each if key == "num" else _map_numbers(each, unit) for key, each in written.items()}
    return [f"{each!r}{unit}" for each in written] if isinstance(written, list) else f"{written!r}{unit}"


_SCHEMA = {"type": "object", "minProperties": 1, "description": "Positions by the name of the joint."}
_ENTRY = {"anyOf": [{"enum": list(_AXES)}, {"type": "array", "items": {"type": "number"}, "minItems": 3}]}
_Joints = Annotated[
    dict[str, JointAxis], PlainValidator(_read_joints), PlainSerializer(_spell_joints), WithJsonSchema(_SCHEMA)
]
_Directions = Annotated[
    Any,
    PlainValidator(_read_directions),
    PlainSerializer(lambda directions: [entry if isinstance(entry, str) else list(entry) for entry in directions]),
    WithJsonSchema({"type": "array", "items": _ENTRY, "minItems": 1}),
]


class Arm(Strict, noun="an arm"):
    """MuJoCo model of an arm, the point on which the wall acts, and its poses and directions."""

    model: str
    """Name of the model file (MJCF .xml, .urdf or .mjb), relative to the configuration."""

    site: str
    """Name of the site on which the wall acts; of a body in a model without sites."""

    joints: _Joints
    """Positions of the joints by name: a number, a list, or {linear: {start: 0 deg, stop: 90 deg, num: 4}}. All
    combinations are computed; other joints stay in the reference pose."""

    directions: _Directions = _AXES
    """Directions of the wall in world coordinates, each x, y, z or a vector. Default: x, y and z."""

    rotary: bool = False
    """True for walls that act on the rotation about the directions."""

    def find_faults(self) -> Iterable[LocatedProblem]:
        try:
            kinds = list_joints(self.loaded)
            check_point(self.loaded, self.site)
        except InputError as error:
            field, _, text = str(error).partition(": ")
            yield (field if field == "site" else "model",), parse_message(text)
            return
        for name, (_, is_angle) in self.joints.items():
            kind = kinds.get(name)
            if kind is None:
                allowed = f"joints of one coordinate are {', '.join(kinds)}"
                yield ("joints", name), problem("unknown joint", allowed, suggestion(name, kinds, "use one of these"))
            elif is_angle is not None and is_angle != (kind == "hinge"):
                unit = "deg or rad" if kind == "hinge" else "m or mm"
                yield ("joints", name), problem(f"got another unit for a {kind}", f"it must be {unit}", "change it")

    @cached_property
    def loaded(self) -> Any:
        """The MuJoCo model of the file."""
        return load_model(find_file(self.model))

    @cached_property
    def units(self) -> dict[str, str]:
        """Unit of the printed positions of each joint, "deg" or "m"."""
        kinds = list_joints(self.loaded)
        return {name: "deg" if kinds[name] == "hinge" else "m" for name in self.joints}

    @cached_property
    def poses(self) -> list[dict[str, float]]:
        """Joint positions of all poses, in rad or m by the name of the joint."""
        values = [axis.values().tolist() for axis, _ in self.joints.values()]
        return [dict(zip(self.joints, pose, strict=True)) for pose in product(*values)]

    def spell(self, pose: dict[str, float], direction: Any) -> str:
        """Return a pose and a direction as text, such as "shoulder 30 deg, elbow 45 deg along x"."""
        values = (f"{name} {self._show(name, value):.4g} {self.units[name]}" for name, value in pose.items())
        return f"{', '.join(values)} along {_spell_direction(direction)}"

    def _show(self, name: str, value: float) -> float:
        """Return the position of a joint in its printed unit, rounded to 12 digits."""
        return float(f"{np.degrees(value) if self.units[name] == 'deg' else value:.12g}")

    def tabulate(self, count: int) -> dict[str, np.ndarray]:
        """Return one table column per joint with its positions in all poses; each pose has ``count`` rows."""
        return {
            header(name, self.units[name]): np.repeat([self._show(name, pose[name]) for pose in self.poses], count)
            for name in self.joints
        }


def _spell_direction(direction: Any) -> str:
    """Return a direction as text: the name of an axis, or the components of a vector in parentheses."""
    return direction if isinstance(direction, str) else f"({' '.join(f'{value:g}' for value in direction)})"


def compute_arm(arm: Arm, timing: Timing, units: UnitSystem) -> Outcome:
    """Compute K_max for all poses and directions of an arm, and test one softer wall in all of them."""
    cases = list(product(arm.poses, arm.directions))
    scenes: dict[int, Scene] = {}
    notes: list[str] = []
    for index, (pose, direction) in enumerate(track_progress(cases)):
        try:
            device = from_mujoco(arm.loaded, arm.site, direction, pose=pose, rotary=arm.rotary)
            scenes[index] = Scene(device, timing)
        except InputError as error:
            notes.append(f"{arm.spell(pose, direction)}: no K_max; {error}")
    if not scenes:
        raise InputError(f"arm: no pose and direction has a K_max; {notes[0]}")
    stiffness, damping = np.full(len(cases), np.nan), np.full(len(cases), np.nan)
    walls = stiffest_walls(scenes.values(), negative_damping=False)
    stiffness[list(scenes)], damping[list(scenes)] = walls.stiffness, walls.virtual_damping
    notes += [
        f"{arm.spell(*cases[index])}: K_max could not be computed"
        for index in scenes
        if not np.isfinite(stiffness[index])
    ]
    names = [_spell_direction(direction) for direction in arm.directions]
    coordinates = arm.tabulate(len(names))
    table = {**coordinates, "direction": np.array(names * len(arm.poses))}
    table |= dict(zip(SI_COLUMNS, (stiffness, damping), strict=True))
    if not np.isfinite(stiffness).any():
        raise InputError(f"arm: no pose and direction has a K_max; {notes[0]}")
    ends = int(np.nanargmin(stiffness)), int(np.nanargmax(stiffness))
    low, high = (with_unit(round_conservatively(float(stiffness[k]), "below"), units["N/m"]) for k in ends)
    weakest = ends[0]
    # Test the rounded wall in all poses and directions, because the range of stable B differs between them.
    wall = (
        round_conservatively(RECOMMENDED_SHARE * stiffness[weakest], "below"),
        float(f"{damping[weakest]:.4g}"),
    )
    stable = [bool(scene.is_stable(*wall)) for scene in scenes.values()]
    answer = (
        f"K_max from {low} at {arm.spell(*cases[ends[0]])} to {high} at {arm.spell(*cases[ends[1]])}",
        f"{format_wall(*wall, units)}, {100 * RECOMMENDED_SHARE:g} % of the least, is stable in {sum(stable)} of "
        f"{len(stable)} poses and directions",
    )
    if missing := np.flatnonzero(~np.isfinite(stiffness)).tolist():
        answer += (f"no K_max in {len(missing)} of {len(cases)} cases, the first at {arm.spell(*cases[missing[0]])}",)
    unstable = [case for case, label in zip(scenes, stable, strict=True) if not label]
    notes += [f"this wall is unstable at {arm.spell(*cases[unstable[0]])}"] if unstable else []
    figures = _draw_poses(arm, coordinates, stiffness, f"{low} at {arm.spell(*cases[weakest])}")
    return Outcome(table=table, figures=figures, answer=answer, notes=tuple(notes))


def _draw_poses(arm: Arm, coordinates: dict[str, np.ndarray], stiffness: np.ndarray, weakest: str) -> dict[str, Any]:
    """Return a dict with a figure of K_max over the positions of two joints; empty if fewer than two joints vary.

    The two joints are the first ones with several positions. At each point, the figure shows the smallest K_max over
    all directions and over all positions of the other joints.

    Args:
        arm: arm of the study.
        coordinates: positions of each joint, by column name; one entry per combination of pose and direction.
        stiffness: K_max in N/m for the same combinations.
        weakest: legend entry with the smallest K_max, its pose and its direction.
    """
    several = [name for name, column in coordinates.items() if np.unique(column).size > 1]
    varied = several[:2]
    if len(varied) < 2:
        return {}
    pairs, group = np.unique(np.stack([coordinates[name] for name in varied]), axis=1, return_inverse=True)
    least = np.full(pairs.shape[1], np.inf)
    np.minimum.at(least, group.ravel(), np.where(np.isfinite(stiffness), stiffness, np.inf))
    table = dict(zip(varied, pairs, strict=True)) | {SI_COLUMNS[0]: np.where(np.isfinite(least), least, np.nan)}
    labels = {header(name, unit): (name, unit) for name, unit in arm.units.items()}
    over = "all directions" if len(several) == 2 else "all directions and other joints"
    texts = {"quantity": rf"smallest $K_{{\max}}$ over {over}", "weakest_pose": f"weakest: {style.literal(weakest)}"}
    names = tuple(labels[name] for name in varied)
    return {"": partial(plotting.draw_workspace, table, *varied, names=names, **texts)}
