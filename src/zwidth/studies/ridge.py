"""Studies of maximum stiffness: "ridge" and "passivity" over delta, and "workspace" over the poses of a device.

The ridge is the path of the stiffest stable wall, alpha_max and its beta, over delta for a fixed delay d. Its limit
alpha_max/delta for strong damping is g(d). Passive walls are those of Colgate's condition; for a fixed d, their set
scales with delta, so it is computed once for delta = 1.

Symbols: alpha, beta, delta and d are normalized stiffness, virtual damping, physical damping and delay; K_max is the
maximum stable stiffness in SI units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import cached_property, partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr, ValidationError, WrapValidator

from zwidth import plotting
from zwidth.analysis.assessment import trace_passivity_boundary
from zwidth.analysis.batch import stiffest_walls
from zwidth.analysis.scene import Scene
from zwidth.config.device_table import DeviceTable, find_file, read_table
from zwidth.config.devices import find_second_period, read_period
from zwidth.config.fields import LocatedProblem, Strict, list_problems, problem
from zwidth.config.scenes import AnyScene, PhysicalDevice
from zwidth.config.study import register
from zwidth.config.values import Delay, quantity_of
from zwidth.core.errors import InputError
from zwidth.core.status import RidgeKind, Status
from zwidth.io.tables import read_columns
from zwidth.model.device import Device
from zwidth.model.timing import Timing
from zwidth.plotting.stable_set import Outlines
from zwidth.plotting.table import SI_COLUMNS
from zwidth.stability.rigid.passivity import passive_stiffness_slope
from zwidth.stability.rigid.ridge import alpha_max, stiffness_slope
from zwidth.stability.rigid.verdict import is_stable
from zwidth.studies.arm import Arm, compute_arm
from zwidth.studies.outcome import ComputedStudy, CurvesStudy, Outcome, add_device_numbers, find_device_share
from zwidth.units.formatting import describe, format_wall, header, plain, round_conservatively, suggestion, with_unit
from zwidth.units.parsing import split_head
from zwidth.units.quantities import RECOMMENDED_SHARE

_STRONG_DAMPING = 100.0  # normalized damping delta above which alpha_max/delta is within some percent of g(d)
_SLOPE_SAMPLES = 64  # samples of g(d) per unit of d; integer delays are included, because g has kinks there


@register
class RidgeStudy(CurvesStudy):
    """The maximum stable stiffness over delta, with one curve per d."""

    method = "Stationary points of the closed form and corners at z = -1, to some ten rounding errors."
    takes_parts = True

    kind: Literal["ridge"]

    device: PhysicalDevice | None = None
    """Device in SI units. The curves include the effects of its parts, such as filters. Default: the device of the
    scene, if this device has parts, unless both delta and d are given."""

    two_scalings: bool = False
    """True to show small values of delta in a separate panel, as in Fig. 10 of the paper."""

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        if "device" in raw or (scene.nonrigid_parts and not {"delta", "d"} <= set(raw)):
            return {"device": scene.without_wall(), **raw}
        return super().fill(raw, scene)

    @classmethod
    def check_estimate(cls, raw: dict[str, Any], scene: AnyScene) -> None:
        if cls._list_absent(raw):  # otherwise delta and d are given, and the scene is unused
            super().check_estimate(raw, scene)

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        return add_device_numbers(raw)

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        with_parts = self.device is not None and bool(self.device.nonrigid_parts)
        if self.device is not None and with_parts:
            table, notes = device_ridge_table(self.device, self.delta.values(), self.d.values())
        else:
            table, notes = ridge_table(self.delta.values(), self.d.values())
        drawn: dict[str, Any] = {"": partial(plotting.draw_ridge, table, two_scalings=self.two_scalings)}
        if table["delta"].max() >= _STRONG_DAMPING and not with_parts:
            drawn["_slope"] = partial(plotting.draw_slope, table, slope_table(table))
        return Outcome(table=table, figures=drawn, notes=tuple(notes))


def ridge_table(delta: np.ndarray, d: np.ndarray) -> tuple[dict[str, np.ndarray], list[str]]:
    """Compute the stiffest stable wall for each combination of delta and d.

    Returns:
        A table with one row per combination, ordered by d, and notes on the number of rows without a result.
    """
    deltas, delays = np.tile(delta, d.size), np.repeat(d, delta.size)
    points = alpha_max(deltas, delays)
    columns = {"alpha_max": points.alpha, "beta": points.beta, "omega": points.omega}
    columns["kind"] = _name_kinds(points.kind)
    return {"d": delays, "delta": deltas, **columns}, _note_missing(points.status, delays)


def device_ridge_table(
    device: PhysicalDevice, delta: np.ndarray, d: np.ndarray
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Compute the stiffest stable wall of a device with parts, for each combination of delta and d.

    For each combination, the damping of the device follows from delta, and the delay from d; all other parameters are
    those of ``device``. For a device with parts, the search excludes walls with virtual damping B < 0
    (`zwidth.Scene.max_stiffness`).

    Returns:
        A table and a list of notes, as from `ridge_table`. The table also contains K and B in SI units.
    """
    scene, changed = device.to_scene(), dict[str, np.ndarray]()
    deltas, delays = np.tile(delta, d.size), np.repeat(d, delta.size)
    if delta.tolist() != [device.delta]:
        # Subtract the damping of a rigidly coupled hand, because delta is the sum of the dampings of device and hand.
        hand = float(scene.damping - scene.device.damping)
        changed["damping"] = deltas * float(scene.units.virtual_damping) - hand
    if d.tolist() != [device.d]:
        changed["delay"] = delays * float(scene.timing.period)
    walls = stiffest_walls(scene, changed) if changed else stiffest_walls([scene])
    alpha, beta = scene.normalize_walls(walls.stiffness, walls.virtual_damping)
    table = {"d": delays, "delta": deltas, "alpha_max": alpha, "beta": beta}
    table |= {"omega": np.asarray(walls.frequency) * (2.0 * math.pi * float(scene.timing.period))}
    table |= {"kind": _name_kinds(walls.kind)} | dict(zip(SI_COLUMNS, walls[:2], strict=True))
    return table, _note_missing(np.asarray(walls.status), delays)


def _name_kinds(codes: Any) -> np.ndarray:
    """Return an array with the name of each optimum in lower case, for an array of `zwidth.RidgeKind` codes."""
    return np.array([RidgeKind(int(code)).name.lower() for code in codes])


def _note_missing(status: np.ndarray, delays: np.ndarray) -> list[str]:
    """Return a note for each delay d at which some points of the ridge could not be computed."""
    return [
        f"alpha_max: {count} of {np.count_nonzero(delays == value)} points have no result for d = {value:g}"
        for value in np.unique(delays)
        if (count := np.count_nonzero(status[delays == value] != Status.OK))
    ]


def slope_table(table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return columns with d and the limit g(d) of alpha_max/delta.

    The values of d are those of a ridge table, and equally spaced values from 0 to the longest delay of the table.
    """
    longest = max(1, math.ceil(table["d"].max()))
    d = np.union1d(np.linspace(0.0, longest, longest * _SLOPE_SAMPLES + 1), table["d"])
    return {"d": d, "slope": np.asarray(stiffness_slope(d))}


@register
class PassivityStudy(CurvesStudy):
    """The maximum passive stiffness and the maximum stable stiffness over delta, with two curves per d."""

    method = "Colgate's condition at its worst frequency, for the exact delay, to 1e-12 of its terms."
    reads_scene = True

    kind: Literal["passivity"]

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        ridge, notes = ridge_table(self.delta.values(), self.d.values())
        table = {name: ridge[name] for name in ("d", "delta", "alpha_max", "beta")}
        slopes = map(passive_stiffness_slope, self.d.values().tolist())
        own_delta = find_device_share(self.delta, self.d, scene) * table["delta"]
        for name, slope in zip(("alpha_max_passive", "beta_passive"), zip(*slopes, strict=True), strict=True):
            table[name] = np.repeat(slope, self.delta.size) * own_delta
        return Outcome(table=table, figures={"": partial(plotting.draw_passivity_cost, table)}, notes=tuple(notes))


def trace_unit_outline(d: float) -> tuple[np.ndarray, np.ndarray]:
    """Return alpha and beta of points on the boundary of the passive set for delta = 1, ordered by increasing beta."""
    return trace_passivity_boundary(Scene(Device(1.0, 1.0), Timing(1.0, d)))


def find_edges(scene: Scene) -> dict[str, Outlines]:
    """Return the outlines of the stable set of a scene and, for a damped rigid device, of the passive set.

    The keys of the dict are "stable" and "passive".
    """
    edges: dict[str, Outlines] = {"stable": [(np.stack(piece[:2], -1), piece.hole) for piece in scene.stable_region()]}
    if not scene.nonrigid_parts and scene.device.damping > 0:
        edges["passive"] = [(np.stack(trace_passivity_boundary(scene), -1), False)]
    return edges


def passive_outlines(deltas: np.ndarray, delays: np.ndarray, share: float = 1.0) -> Iterator[dict[str, Any]]:
    """Yield alpha and beta on the boundary of the passive set as columns, for each d and each delta > 0.

    ``share`` is the proportion of the damping that belongs to the device and not to an operator.
    """
    for d in delays:
        alpha, beta = trace_unit_outline(float(d))
        for delta in deltas[share * deltas > 0]:
            yield {"curve": "passive", "d": d, "delta": delta,
                   "alpha": share * delta * alpha, "beta": share * delta * beta}  # fmt: skip


def passive_intervals(deltas: np.ndarray, delays: np.ndarray) -> Iterator[dict[str, Any]]:
    """Yield, for each d, columns with delta and both ends of the passive interval of beta for alpha -> 0."""
    for d in delays:
        _, beta = trace_unit_outline(float(d))
        yield {"curve": "passive", "d": d, "delta": deltas,
               "beta_lower": deltas * beta[0], "beta_upper": deltas * beta[-1]}  # fmt: skip


_FORM = "poses are a file with the columns mass and damping, and two columns with coordinates"


class Poses(Strict, noun="a table of poses"):
    """Table file with mass, damping and two coordinates of a device, one row per pose."""

    csv: str
    """Name of the file, relative to the configuration."""

    across: str
    """Name of the column with the coordinate along the x axis of the figure."""

    up: str
    """Name of the column with the coordinate along the y axis of the figure."""

    _coordinates: list[tuple[str, str, list[float]]] = PrivateAttr()  # name, unit and values of both coordinates

    @classmethod
    def explain_missing(cls, name: str) -> tuple[str, str]:
        return _FORM, "write {csv: arm.csv, across: shoulder, up: elbow}"

    def find_faults(self) -> Iterable[LocatedProblem]:
        try:
            table, columns = self.table, read_columns(find_file(self.csv))
            columns_by_name = {name: (unit, index) for index, (name, unit) in enumerate(map(split_head, columns.heads))}
            chosen = {key: getattr(self, key) for key in ("across", "up")}
            if set(table.columns) != {"mass", "damping"}:
                message = f"got columns {' and '.join(table.columns)}"
                yield ("csv",), problem(message, _FORM, "give mass and damping as the only parameters")
            for key in (key for key, name in chosen.items() if name not in columns_by_name):
                remedy = suggestion(chosen[key], columns_by_name, f"choose from {', '.join(columns_by_name)}")
                yield (key,), problem(f"got {describe(chosen[key])}", "it must be a column of the file", remedy)
            if self.across == self.up:
                message = f"got {describe(self.up)}, equal to across"
                yield ("up",), problem(message, "the coordinates must differ", "name another column")
            coordinates = [(name, *columns_by_name[name]) for name in chosen.values() if name in columns_by_name]
            values = columns.numbers([index for _, _, index in coordinates])
            self._coordinates = [
                (name, unit, column.tolist()) for (name, unit, _), column in zip(coordinates, values, strict=True)
            ]
        except ValidationError as error:
            yield from list_problems(error)
        except InputError as error:
            yield ("csv",), problem(str(error).partition("; ")[0], _FORM, "complete the file")

    @cached_property
    def table(self) -> DeviceTable:
        """Table with the columns mass and damping in SI units, one row per pose."""
        return read_table({"csv": self.csv})

    def tabulate(self) -> dict[str, np.ndarray]:
        """Return the coordinates of all poses as two columns of a table, the horizontal one (``across``) first."""
        return {header(name, unit): np.array(values) for name, unit, values in self._coordinates}

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """Pairs of name and unit of the two coordinates, the horizontal one (``across``) first."""
        return tuple((name, unit) for name, unit, _ in self._coordinates)

    def spell(self, pose: int) -> str:
        """Return the coordinates of the pose with the given index as text, such as "shoulder 30 deg, elbow 45 deg"."""
        return ", ".join(f"{name} {values[pose]:.4g} {unit}".rstrip() for name, unit, values in self._coordinates)


@register
class WorkspaceStudy(ComputedStudy):
    """The maximum stable stiffness over the workspace of a device, from a table of poses or a model of an arm."""

    method = "Maximum stable stiffness of the device in each pose; for an arm, along each direction."
    from_scene = ("period", "delay")

    kind: Literal["workspace"]

    poses: Poses | None = None
    """Table file with mass, damping and two coordinates of each pose. Either poses or arm is required."""

    arm: Arm | None = None
    """MuJoCo model of an arm, with the positions of its joints and the directions of the wall."""

    rate: Annotated[float, quantity_of("rate")] | None = Field(default=None, exclude=True)
    period: Annotated[float, quantity_of("period"), WrapValidator(read_period)] = Field(
        default=None, validate_default=True
    )
    delay: Delay

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        yield from find_second_period(raw)
        yield from super().find_conflicts(raw)
        if ("poses" in raw) == ("arm" in raw):
            got = "poses and arm are both given" if "arm" in raw else "poses or arm is missing"
            yield (), problem(got, _FORM, "give {csv: arm.csv, across: shoulder, up: elbow} as poses, or an arm")

    @property
    def sizes(self) -> dict[str, int]:
        if self.arm is not None:
            return {"poses": len(self.arm.poses), "directions": len(self.arm.directions)}
        return {"poses": self.poses.table.size if self.poses else 0}

    def find_faults(self) -> Iterable[LocatedProblem]:
        yield from super().find_faults()
        if self.poses is not None and self.poses.table.size < 2:
            yield ("poses",), problem("got one pose", "at least two are needed", "use the kind 'recommend' instead")

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        if self.arm is not None:
            return compute_arm(self.arm, Timing(self.period, self.delay), self.unit_system)
        assert self.poses is not None, "a study without an arm has poses"
        mass, damping = (self.poses.table.values(name) for name in ("mass", "damping"))
        rate = mass / self.period
        d, delta = self.delay.periods(self.period), damping / rate
        top = alpha_max(delta, d)
        stiffness, virtual_damping = top.alpha * rate / self.period, top.beta * rate
        coordinates = self.poses.tabulate()
        table = {**coordinates, "mass_kg": mass, "damping_N_s_per_m": damping}
        table |= dict(zip(SI_COLUMNS, (stiffness, virtual_damping), strict=True))
        has_result, file, units = np.isfinite(stiffness), self.poses.csv, self.unit_system
        notes = [
            f"{self.poses.spell(k)}: mass {with_unit(mass[k], units['kg'])} and damping "
            f"{with_unit(damping[k], units['N s/m'])} (delta = {plain(delta[k])}) have no K_max: "
            f"{Status(int(top.status[k])).message} Correct this pose in "
            f"{file}, or leave it out."
            for k in np.flatnonzero(~has_result).tolist()
        ]
        if not has_result.any():
            raise InputError(f"poses: no pose of {file} has a K_max; first pose: {notes[0]}")
        weakest = int(np.nanargmin(stiffness))
        # Test the rounded wall in every pose, because a wall that is stable in the pose with the smallest K_max may be
        # unstable in others: their K_max has another virtual damping.
        wall = (
            round_conservatively(RECOMMENDED_SHARE * stiffness[weakest], "below"),
            float(f"{virtual_damping[weakest]:.4g}"),
        )
        is_stable_at = np.asarray(is_stable(wall[0] * self.period / rate, wall[1] / rate, delta, d))
        ends = stiffness[weakest], np.nanmax(stiffness)
        low, high = (with_unit(round_conservatively(float(each), "below"), units["N/m"]) for each in ends)
        answer = (
            f"K_max from {low} at {self.poses.spell(weakest)} to {high}",
            f"{format_wall(*wall, units)}, {100 * RECOMMENDED_SHARE:g} % of the least, is "
            f"stable in {np.count_nonzero(is_stable_at)} of {np.count_nonzero(has_result)} poses",
        )
        draw = partial(plotting.draw_workspace, table, *coordinates, names=self.poses.names)
        return Outcome(table=table, figures={"": draw}, answer=answer, notes=tuple(notes))
