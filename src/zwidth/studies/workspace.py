"""The workspace study: the stiffest wall of every pose of a device whose mass and damping vary with the pose."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import PlainSerializer, PlainValidator, WithJsonSchema

from zwidth import figures
from zwidth.config.device_table import DeviceTable, find_file, read_table
from zwidth.config.faults import LocatedProblem, problem
from zwidth.config.scenes import AnyScene, PhysicalScene
from zwidth.config.study import register
from zwidth.config.values import Delay, quantity_of
from zwidth.figures.table import SI_COLUMNS
from zwidth.loops.rigid.ridge import alpha_max
from zwidth.loops.rigid.verdict import is_stable
from zwidth.studies.outcome import ComputedStudy, Outcome
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe, header, name_wall, plain, round_safely, suggestion, with_unit
from zwidth.words.quantities import RECOMMENDED_SHARE
from zwidth.words.status import Status
from zwidth.words.tables import read_columns, split_head

_FORM = "poses are a file with columns mass and damping, and the two columns of it that a pose is drawn over"
_EXAMPLE = "write {csv: arm.csv, across: shoulder, up: elbow}"


@dataclass(frozen=True)
class Poses:
    """Masses and dampings of a device, one row a pose, and two coordinates of it with their names and units."""

    source: dict[str, str]  # as it is written: the file and its two columns
    table: DeviceTable
    names: tuple[tuple[str, str], ...]
    places: tuple[tuple[float, ...], ...]


def _read_poses(raw: Any) -> Any:
    """A validator for poses in a file."""
    if isinstance(raw, Poses):
        return raw
    if not isinstance(raw, dict) or set(raw) != {"csv", "across", "up"}:
        raise problem(f"got {describe(raw)}", _FORM, _EXAMPLE)
    table = read_table({"csv": raw["csv"]})
    if set(table.columns) != {"mass", "damping"}:
        raise problem(f"got columns {' and '.join(table.columns)}", _FORM, "give these two, and no other parameter")
    try:
        columns = read_columns(find_file(raw["csv"]))
        heads = [split_head(head) for head in columns.heads]
        known = {name: place for place, (name, _) in enumerate(heads)}
        for key in ("across", "up"):
            if raw[key] not in known:
                remedy = suggestion(raw[key], known, f"choose from {', '.join(known)}")
                raise problem(f"{key}: got {describe(raw[key])}", "it names a column of the file", remedy)
        chosen = [known[raw[key]] for key in ("across", "up")]
        places = columns.numbers(chosen)
    except InputError as error:
        raise problem(str(error).partition("; ")[0], _FORM, "complete the file") from None
    return Poses(dict(raw), table, tuple(heads[at] for at in chosen), tuple(tuple(each.tolist()) for each in places))


_KEYS = ("csv", "across", "up")
_SCHEMA = {
    "type": "object",
    "description": f"{_FORM[0].upper()}{_FORM[1:]}.",
    "properties": {key: {"type": "string"} for key in _KEYS},
    "required": list(_KEYS),
    "additionalProperties": False,
}
PosesField = Annotated[
    Poses,
    PlainValidator(_read_poses),
    PlainSerializer(lambda poses: poses.source, return_type=dict[str, str]),
    WithJsonSchema(_SCHEMA),
]


@register
class WorkspaceStudy(ComputedStudy):
    """The stiffest stable wall over a device's workspace, from the mass and damping that it has in every pose."""

    method = "The stiffest wall of each pose as that of a rigid device, to some rounding errors."
    from_scene = ("period", "delay")
    # Two coordinates, mass, damping and the wall.
    point_bytes = 48

    kind: Literal["workspace"]

    poses: PosesField
    """A file with a row for each pose: its mass and damping, and the two columns that they are drawn over."""

    period: Annotated[float, quantity_of("period")]
    """Sampling period T; the scene's where left out."""

    delay: Delay
    """Delay t_d from a sample to the moment its force acts, in s or in periods; the scene's where left out."""

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        supplied = {"period": scene.period, "delay": scene.delay} if isinstance(scene, PhysicalScene) else {}
        return {**supplied, **raw}

    @property
    def sizes(self) -> dict[str, int]:
        return {"poses": self.poses.table.size}

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        if self.poses.table.size < 2:
            yield ("poses",), problem("got one pose", "a map needs several", "use the kind 'recommend' for one device")

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        mass, damping = (self.poses.table.values(name) for name in ("mass", "damping"))
        rate = mass / self.period
        d = self.delay.value / (self.period if self.delay.unit == "s" else 1.0)
        delta = damping / rate
        top = alpha_max(delta, d)
        stiffness, virtual_damping = top.alpha * rate / self.period, top.beta * rate
        names = [header(name, unit) for name, unit in self.poses.names]
        places = map(np.array, self.poses.places)
        table = dict(zip(names, places, strict=True)) | {"mass_kg": mass, "damping_N_s_per_m": damping}
        table |= dict(zip(SI_COLUMNS, (stiffness, virtual_damping), strict=True))
        known, file = np.isfinite(stiffness), self.poses.source["csv"]

        def spell_pose(k: int) -> str:
            units = (unit for _, unit in self.poses.names)
            parts = zip((name for name, _ in self.poses.names), names, units, strict=True)
            return ", ".join(f"{name} {table[column][k]:.4g} {unit}".rstrip() for name, column, unit in parts)

        notes = [
            f"{spell_pose(k)}: mass {with_unit(mass[k], 'kg')} and damping {with_unit(damping[k], 'N s/m')} (delta = "
            f"{plain(delta[k])}) have no K_max: {Status(int(top.status[k])).message} Correct this pose in {file}, or "
            "leave it out."
            for k in np.flatnonzero(~known).tolist()
        ]
        if not known.any():
            raise InputError(f"poses: no pose of {file} has a K_max; the first, {notes[0]}")
        weakest = int(np.nanargmin(stiffness))
        # Other poses are heavier or more damped, but not alike in both: the wall as it is written is tried on each.
        wall = round_safely(RECOMMENDED_SHARE * stiffness[weakest], "below"), float(f"{virtual_damping[weakest]:.4g}")
        bears = np.asarray(is_stable(wall[0] * self.period / rate, wall[1] / rate, delta, d))
        ends = stiffness[weakest], np.nanmax(stiffness)
        low, high = (with_unit(round_safely(float(each), "below"), "N/m") for each in ends)
        answer = (
            f"K_max from {low} at {spell_pose(weakest)} to {high}",
            f"{name_wall(*wall)}, {100 * RECOMMENDED_SHARE:g} % of the least, is "
            f"stable in {np.count_nonzero(bears)} of {np.count_nonzero(known)} poses",
        )
        draw = partial(figures.draw_workspace, table, *names)
        return Outcome(table=table, figures={"": draw}, answer=answer, notes=tuple(notes))
