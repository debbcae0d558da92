"""Stiffest walls, stable and passive ones over delta, and of every pose of a workspace; and their studies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import cached_property, partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr, ValidationError, WrapValidator

from zwidth import figures
from zwidth.config.device_table import DeviceTable, find_file, read_table
from zwidth.config.devices import find_second_period, read_period
from zwidth.config.fields import LocatedProblem, Strict, problem, problems_of
from zwidth.config.scenes import AnyScene
from zwidth.config.study import register
from zwidth.config.values import Delay, quantity_of
from zwidth.figures.stable_set import Outlines
from zwidth.figures.table import SI_COLUMNS
from zwidth.loops.rigid.passivity import passive_stiffness_slope
from zwidth.loops.rigid.ridge import alpha_max, stiffness_slope
from zwidth.loops.rigid.verdict import is_stable
from zwidth.parts.device import Device
from zwidth.parts.timing import Timing
from zwidth.scenes.assessment import passive_edge
from zwidth.scenes.scene import Scene
from zwidth.studies.outcome import ComputedStudy, CurvesStudy, Outcome, share_of_device
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe, header, name_wall, plain, round_safely, suggestion, with_unit
from zwidth.words.quantities import RECOMMENDED_SHARE
from zwidth.words.status import RidgeKind, Status
from zwidth.words.tables import read_columns
from zwidth.words.units import split_head

# A path that goes this far shows what alpha_max/delta tends to: within some percent.
_STRONG_DAMPING = 100.0
# Delays at which g(d) is sampled between two whole ones; it has kinks at these.
_SLOPE_SAMPLES = 64


@register
class RidgeStudy(CurvesStudy):
    """Maximum stiffness over delta, one curve per d."""

    method = "Stationary points of the closed form and corners at z = -1, to some ten rounding errors."

    kind: Literal["ridge"]

    two_scalings: bool = False
    """Show the small deltas in a panel of their own, as fig. 10 of the paper does."""

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        table, notes = ridge_table(self.delta.values(), self.d.values())
        drawn: dict[str, Any] = {"": partial(figures.draw_ridge, table, two_scalings=self.two_scalings)}
        if table["delta"].max() >= _STRONG_DAMPING:
            drawn["_slope"] = partial(figures.draw_slope, table, slope_table(table))
        return Outcome(table=table, figures=drawn, notes=tuple(notes))


def ridge_table(delta: np.ndarray, d: np.ndarray) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the stiffest stable walls over ``delta`` per delay, and notes about points without a result."""
    deltas, delays = np.tile(delta, d.size), np.repeat(d, delta.size)
    points = alpha_max(deltas, delays)
    columns = {"alpha_max": points.alpha, "beta": points.beta, "omega": points.omega}
    columns["kind"] = np.array([RidgeKind(int(code)).name.lower() for code in points.kind])
    notes = [
        f"alpha_max: {count} of {delta.size} points have no result for d = {value:g}"
        for value in d
        if (count := np.count_nonzero(points.status[delays == value] != Status.OK))
    ]
    return {"d": delays, "delta": deltas, **columns}, notes


def slope_table(table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the limit g(d) of alpha_max/delta at the delays of a ridge table and at delays between them."""
    longest = max(1, math.ceil(table["d"].max()))
    d = np.union1d(np.linspace(0.0, longest, longest * _SLOPE_SAMPLES + 1), table["d"])
    return {"d": d, "slope": np.asarray(stiffness_slope(d))}


@register
class PassivityStudy(CurvesStudy):
    """Largest passive and largest stable stiffness over delta."""

    method = "Colgate's condition at its worst frequency, for the exact delay, to 1e-12 of its terms."
    reads_scene = True

    kind: Literal["passivity"]

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        ridge, notes = ridge_table(self.delta.values(), self.d.values())
        table = {name: ridge[name] for name in ("d", "delta", "alpha_max", "beta")}
        slopes = map(passive_stiffness_slope, self.d.values().tolist())
        own = share_of_device(self.delta, self.d, scene) * table["delta"]
        for name, slope in zip(("alpha_max_passive", "beta_passive"), zip(*slopes, strict=True), strict=True):
            table[name] = np.repeat(slope, self.delta.size) * own
        return Outcome(table=table, figures={"": partial(figures.draw_passivity_cost, table)}, notes=tuple(notes))


def unit_outline(d: float) -> tuple[np.ndarray, np.ndarray]:
    """Return alpha and beta on the boundary of the passive set for delta = 1, by increasing beta."""
    return passive_edge(Scene(Device(1.0, 1.0), Timing(1.0, d)))


def find_edges(scene: Scene) -> dict[str, Outlines]:
    """Return the outlines of the stable set of a scene and, for a rigid device, of the passive set."""
    edges: dict[str, Outlines] = {"stable": [(np.stack(piece[:2], -1), piece.hole) for piece in scene.stable_region()]}
    if not scene.parts_beyond and scene.device.damping > 0:
        edges["passive"] = [(np.stack(passive_edge(scene), -1), False)]
    return edges


def passive_outlines(deltas: np.ndarray, delays: np.ndarray, share: float = 1.0) -> Iterator[dict[str, Any]]:
    """Yield the boundary of the passive set of each device with damping, as columns.

    ``share`` is the proportion of the damping that belongs to the device and not to an operator.
    """
    for d in delays:
        alpha, beta = unit_outline(float(d))
        for delta in deltas[share * deltas > 0]:
            yield {"curve": "passive", "d": d, "delta": delta,
                   "alpha": share * delta * alpha, "beta": share * delta * beta}  # fmt: skip


def passive_intervals(deltas: np.ndarray, delays: np.ndarray) -> Iterator[dict[str, Any]]:
    """Yield the passive interval of the virtual damping for alpha -> 0 over delta, as columns."""
    for d in delays:
        _, beta = unit_outline(float(d))
        yield {"curve": "passive", "d": d, "delta": deltas,
               "beta_lower": deltas * beta[0], "beta_upper": deltas * beta[-1]}  # fmt: skip


_FORM = "poses are a file with columns mass and damping, and the two columns of it that a pose is drawn over"


class Poses(Strict, what="a table of poses"):
    """Masses and dampings of a device, one row a pose, and two coordinates of it."""

    csv: str
    """Name of the file, relative to the configuration."""

    across: str
    """Name of the column that poses are drawn over from left to right."""

    up: str
    """Name of the one from bottom to top."""

    # Name, unit and values of both.
    _coordinates: list[tuple[str, str, list[float]]] = PrivateAttr()

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        return _FORM, "write {csv: arm.csv, across: shoulder, up: elbow}"

    def limits(self) -> Iterable[LocatedProblem]:
        try:
            table, columns = self.table, read_columns(find_file(self.csv))
            known = {name: (unit, place) for place, (name, unit) in enumerate(map(split_head, columns.heads))}
            chosen = {key: getattr(self, key) for key in ("across", "up")}
            if set(table.columns) != {"mass", "damping"}:
                what = f"got columns {' and '.join(table.columns)}"
                yield ("csv",), problem(what, _FORM, "give these two, and no other parameter")
            for key in (key for key, name in chosen.items() if name not in known):
                remedy = suggestion(chosen[key], known, f"choose from {', '.join(known)}")
                yield (key,), problem(f"got {describe(chosen[key])}", "it names a column of the file", remedy)
            if self.across == self.up:
                what = f"got {describe(self.up)}, as across"
                yield ("up",), problem(what, "a map has two coordinates", "name another")
            found = [(name, *known[name]) for name in chosen.values() if name in known]
            values = columns.numbers([place for _, _, place in found])
            self._coordinates = [(name, unit, of.tolist()) for (name, unit, _), of in zip(found, values, strict=True)]
        except ValidationError as error:
            yield from problems_of(error)
        except InputError as error:
            yield ("csv",), problem(str(error).partition("; ")[0], _FORM, "complete the file")

    @cached_property
    def table(self) -> DeviceTable:
        """The masses and dampings."""
        return read_table({"csv": self.csv})

    def tabulate(self) -> dict[str, np.ndarray]:
        """The coordinates as columns, across and up."""
        return {header(name, unit): np.array(values) for name, unit, values in self._coordinates}

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """The name and the unit of both coordinates."""
        return tuple((name, unit) for name, unit, _ in self._coordinates)

    def spell(self, pose: int) -> str:
        """A pose by its coordinates."""
        return ", ".join(f"{name} {values[pose]:.4g} {unit}".rstrip() for name, unit, values in self._coordinates)


@register
class WorkspaceStudy(ComputedStudy):
    """The stiffest stable wall over a device's workspace, from the mass and damping that it has in every pose."""

    method = "The stiffest wall of each pose as that of a rigid device, to some rounding errors."
    from_scene = ("period", "delay")

    kind: Literal["workspace"]

    poses: Poses
    """A file with a row for each pose: its mass and damping, and the two columns that they are drawn over."""

    rate: Annotated[float, quantity_of("rate")] | None = Field(default=None, exclude=True)
    period: Annotated[float, quantity_of("period"), WrapValidator(read_period)] = Field(
        default=None, validate_default=True
    )
    delay: Delay

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        yield from find_second_period(raw)
        yield from super().conflicts(raw)

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
        d, delta = self.delay.periods(self.period), damping / rate
        top = alpha_max(delta, d)
        stiffness, virtual_damping = top.alpha * rate / self.period, top.beta * rate
        coordinates = self.poses.tabulate()
        table = {**coordinates, "mass_kg": mass, "damping_N_s_per_m": damping}
        table |= dict(zip(SI_COLUMNS, (stiffness, virtual_damping), strict=True))
        known, file, units = np.isfinite(stiffness), self.poses.csv, self.unit_system
        notes = [
            f"{self.poses.spell(k)}: mass {with_unit(mass[k], units['kg'])} and damping "
            f"{with_unit(damping[k], units['N s/m'])} (delta = {plain(delta[k])}) have no K_max: "
            f"{Status(int(top.status[k])).message} Correct this pose in "
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
        low, high = (with_unit(round_safely(float(each), "below"), units["N/m"]) for each in ends)
        answer = (
            f"K_max from {low} at {self.poses.spell(weakest)} to {high}",
            f"{name_wall(*wall, units)}, {100 * RECOMMENDED_SHARE:g} % of the least, is "
            f"stable in {np.count_nonzero(bears)} of {np.count_nonzero(known)} poses",
        )
        draw = partial(figures.draw_workspace, table, *coordinates, names=self.poses.names)
        return Outcome(table=table, figures={"": draw}, answer=answer, notes=tuple(notes))
