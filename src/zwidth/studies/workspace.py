"""The workspace study: the stiffest wall of every pose of a device whose mass and damping vary with the pose."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import PrivateAttr, ValidationError

from zwidth import figures
from zwidth.config.device_table import DeviceTable, find_file, read_table
from zwidth.config.fields import LocatedProblem, Strict, problem, problems_of
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


class Poses(Strict, what="a table of poses"):
    """Masses and dampings of a device, one row a pose, and two coordinates of it."""

    csv: str
    """Name of the file, relative to the configuration."""

    across: str
    """Name of the column that poses are drawn over from left to right."""

    up: str
    """Name of the one from bottom to top."""

    _table: DeviceTable = PrivateAttr()
    # Name, unit and values of both.
    _coordinates: list[tuple[str, str, list[float]]] = PrivateAttr()

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        return _FORM, "write {csv: arm.csv, across: shoulder, up: elbow}"

    def limits(self) -> Iterable[LocatedProblem]:
        try:
            self._table, columns = read_table({"csv": self.csv}), read_columns(find_file(self.csv))
            known = {name: (unit, place) for place, (name, unit) in enumerate(map(split_head, columns.heads))}
            chosen = {key: getattr(self, key) for key in ("across", "up")}
            if set(self._table.columns) != {"mass", "damping"}:
                what = f"got columns {' and '.join(self._table.columns)}"
                yield ("csv",), problem(what, _FORM, "give these two, and no other parameter")
            for key in (key for key, name in chosen.items() if name not in known):
                remedy = suggestion(chosen[key], known, f"choose from {', '.join(known)}")
                yield (key,), problem(f"got {describe(chosen[key])}", "it names a column of the file", remedy)
            found = [(name, *known[name]) for name in chosen.values() if name in known]
            values = columns.numbers([place for _, _, place in found])
            self._coordinates = [(name, unit, of.tolist()) for (name, unit, _), of in zip(found, values, strict=True)]
        except ValidationError as error:
            yield from problems_of(error)
        except InputError as error:
            yield ("csv",), problem(str(error).partition("; ")[0], _FORM, "complete the file")

    @property
    def table(self) -> DeviceTable:
        """The masses and dampings."""
        return self._table

    def tabulate(self) -> dict[str, np.ndarray]:
        """The coordinates as columns, across and up."""
        return {header(name, unit): np.array(values) for name, unit, values in self._coordinates}

    def spell(self, pose: int) -> str:
        """A pose by its coordinates."""
        return ", ".join(f"{name} {values[pose]:.4g} {unit}".rstrip() for name, unit, values in self._coordinates)


@register
class WorkspaceStudy(ComputedStudy):
    """The stiffest stable wall over a device's workspace, from the mass and damping that it has in every pose."""

    method = "The stiffest wall of each pose as that of a rigid device, to some rounding errors."
    from_scene = ("period", "delay")
    # Two coordinates, mass, damping and the wall.
    point_bytes = 48

    kind: Literal["workspace"]

    poses: Poses
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
        coordinates = self.poses.tabulate()
        table = {**coordinates, "mass_kg": mass, "damping_N_s_per_m": damping}
        table |= dict(zip(SI_COLUMNS, (stiffness, virtual_damping), strict=True))
        known, file = np.isfinite(stiffness), self.poses.csv
        notes = [
            f"{self.poses.spell(k)}: mass {with_unit(mass[k], 'kg')} and damping {with_unit(damping[k], 'N s/m')} "
            f"(delta = {plain(delta[k])}) have no K_max: {Status(int(top.status[k])).message} Correct this pose in "
            f"{file}, or leave it out."
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
            f"K_max from {low} at {self.poses.spell(weakest)} to {high}",
            f"{name_wall(*wall)}, {100 * RECOMMENDED_SHARE:g} % of the least, is "
            f"stable in {np.count_nonzero(bears)} of {np.count_nonzero(known)} poses",
        )
        draw = partial(figures.draw_workspace, table, *coordinates)
        return Outcome(table=table, figures={"": draw}, answer=answer, notes=tuple(notes))
