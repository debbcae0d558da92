"""Studies of the stable set: boundaries ("boundary"), comparison of devices ("compare") and grids ("map").

Boundaries are closed forms over the frequency for rigid devices, and outlines of the stable region for devices with
parts. A stable region may have islands, i.e. pieces that are not connected to K = 0. The symbols alpha, beta, delta and
d are the normalized stiffness, virtual damping, physical damping and delay; omega is the angular frequency in rad per
sample.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from itertools import product
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import WrapValidator

from zwidth import plotting
from zwidth.analysis.scene import Scene
from zwidth.config.fields import LocatedProblem, find_repeated, problem, require_entries
from zwidth.config.parts import list_parts
from zwidth.config.scenes import AnyScene, LabeledDevice, PhysicalDevice, PhysicalScene
from zwidth.config.study import name_parts, register
from zwidth.config.values import AnyAxis, DelayAxis, DeltaAxis
from zwidth.core.status import note_failures
from zwidth.model.device import Device
from zwidth.model.timing import Timing
from zwidth.plotting.stable_set import Outlines, tabulate_sets
from zwidth.plotting.table import stack
from zwidth.stability.rigid.boundary import Piece, boundary_point, stable_region
from zwidth.stability.rigid.dominant.spectral_radius import spectral_radius
from zwidth.stability.rigid.normalization import status_of_results
from zwidth.stability.rigid.passivity import is_passive
from zwidth.stability.rigid.verdict import is_stable
from zwidth.studies.outcome import (
    ComputedStudy,
    CurvesStudy,
    Outcome,
    add_device_numbers,
    add_si_columns,
    csv_text,
    find_device_share,
    spell_stiffest,
    summarize_stiffest,
    track_progress,
)
from zwidth.studies.ridge import find_edges, passive_intervals, passive_outlines, ridge_table
from zwidth.units.outputs import OUTPUTS
from zwidth.units.quantities import WALL_RANGE

Plane: TypeAlias = Literal["alpha_beta", "delta_beta"]

_POINTS_PER_CURVE = 1000  # typical number of points of a boundary, for the estimated size of the result
_RIDGE_POINTS = 101  # values of delta on the path of maximum stiffness


@register
class BoundaryStudy(CurvesStudy):
    """The boundary of the stable walls for each delta and d, or for a device with parts such as an actuator."""

    method = "Closed form of the boundary, to a few rounding errors; the stable side by counting poles."
    reads_scene = True
    takes_parts = True

    kind: Literal["boundary"]

    device: PhysicalDevice | None = None
    """Device in SI units, in place of delta and d. Default: that of the scene if it has parts and neither delta nor d
    is given."""

    plane: Plane = "alpha_beta"
    """Plane of the figure: alpha and beta, or delta and beta for alpha -> 0."""

    ridge_path: bool = False
    """True to add the path of maximum stiffness over delta; only in the plane alpha_beta."""

    passivity: bool = False
    """True to add the boundary of the passive walls."""

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        if "device" in raw or (scene.nonrigid_parts and not {"delta", "d"} & set(raw)):
            return {"device": scene.without_wall(), **raw}
        return super().fill(raw, scene)

    @classmethod
    def check_parts(cls, raw: dict[str, Any], scene: AnyScene) -> None:
        given = [name for name in ("delta", "d") if name in raw]
        if len(given) == 1 and "device" not in raw and scene.nonrigid_parts:
            remedy = f"remove {given[0]!r}, or give both delta and d"
            raise problem(f"got {given[0]!r} for a scene with parts", "the device has its own delta and d", remedy)

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        return add_device_numbers(raw)

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        if raw.get("plane") == "delta_beta" and raw.get("ridge_path") is True:
            allowed = "the path of maximum stiffness exists only in the plane alpha_beta"
            yield ("ridge_path",), problem("got true with plane delta_beta", allowed, "remove ridge_path")

    def find_faults(self) -> Iterable[LocatedProblem]:
        yield from super().find_faults()
        if self.plane == "delta_beta" and self.delta.size < 2:
            allowed = "the plane delta_beta needs at least two values of delta"
            yield ("delta",), problem("got one value", allowed, "give delta as a list, linear or log axis")
        if self.device is None:
            return
        for name in ("delta", "d"):
            if getattr(self, name).values().tolist() != [getattr(self.device, name)]:
                message = f"got {name!r} together with a device"
                yield (name,), problem(message, "the device has its own", "remove one", on_key=True)
        if not self.device.nonrigid_parts:
            return
        defaults = {"plane": "alpha_beta", "ridge_path": False, "passivity": False}
        for name in [name for name, default in defaults.items() if getattr(self, name) != default]:
            parts = name_parts(self.device.nonrigid_parts)
            allowed = f"it needs a rigid mass with the difference of two samples, without {parts}"
            yield (name,), problem(f"got {name!r}", allowed, "remove it", on_key=True)

    @property
    def points(self) -> int:
        return super().points * (_POINTS_PER_CURVE if self.plane == "alpha_beta" else 1)

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        if self.device is not None and self.device.nonrigid_parts:
            return trace_device(self.device, self.device.label or self.name)
        deltas, delays = self.delta.values(), self.d.values()
        if self.plane == "delta_beta":
            deltas = np.sort(deltas)
            parts = tabulate_stable_intervals(deltas, delays)
            parts += passive_intervals(deltas, delays) if self.passivity else ()
            table = stack(parts)
            return Outcome(table=table, figures={"": partial(plotting.draw_zero_stiffness, table)})
        notes: list[str] = []
        parts = [tabulate_boundary(delta, d) for d, delta in product(delays.tolist(), deltas.tolist())]
        if self.ridge_path:
            path, notes = ridge_table(np.linspace(deltas.min(), deltas.max(), _RIDGE_POINTS), delays)
            path["alpha"] = path.pop("alpha_max")
            del path["kind"]
            parts.append({"curve": "ridge_path", **path})
        share = find_device_share(self.delta, self.d, self.device or scene)
        parts += passive_outlines(deltas, delays, share) if self.passivity else ()
        table = add_si_columns(stack(parts), self.delta, self.d, self.device or scene)
        return Outcome(table=table, figures={"": partial(plotting.draw_boundary, table)}, notes=tuple(notes))


def trace_device(device: PhysicalDevice, label: str) -> Outcome:
    """Compute the outlines of the stable set, with islands and holes, and the stiffest wall of a device with parts.

    ``label`` is the name of the device in the table and the figure.
    """
    outlines, walls = tabulate_sets({label: device.to_scene()})
    if not outlines:
        return Outcome(notes=("no wall of this device is stable",))
    about = {"curve": "boundary", "label": label, "d": device.d, "delta": device.delta}
    table = stack([{**about, **outlines}])
    return Outcome(table=table, figures={"": partial(plotting.draw_stable_set, table, walls)})


def tabulate_boundary(delta: float, d: float) -> dict[str, Any]:
    """Return columns with omega, alpha, beta and the name of the piece for points on a rigid device's boundary."""
    region = stable_region(delta, d)
    columns = {"omega": region.omega, "alpha": region.alpha, "beta": region.beta}
    columns["piece"] = np.array([Piece(int(code)).name.lower() for code in region.piece])
    return {"curve": "boundary", "d": d, "delta": delta, **columns}


def tabulate_stable_intervals(deltas: np.ndarray, delays: np.ndarray) -> list[dict[str, Any]]:
    """Return tables of both ends of the stable interval of beta for alpha -> 0 over delta, one table per delay.

    Args:
        deltas: values of delta, shape (n,).
        delays: values of d, shape (m,).

    Returns:
        m tables, one per delay, each a dict of columns of length n.
    """
    # Use the smallest alpha in range, because alpha = 0 is on the stability boundary.
    upper = boundary_point(deltas, delays[:, None], alpha=WALL_RANGE[0], side="upper").beta
    shared = {"delta": deltas, "beta_lower": -deltas}
    rows = zip(delays, np.asarray(upper), strict=True)
    return [{"curve": "stable", "d": d, **shared, "beta_upper": row} for d, row in rows]


@register
class CompareStudy(ComputedStudy):
    """The stable walls of several devices in one figure, and the stiffest wall of each device in a table."""

    method = "Closed forms; with parts, signed crossings of the boundary curve and the highest point of each edge."
    from_scene = ()
    takes_parts = True

    kind: Literal["compare"]

    devices: Annotated[tuple[LabeledDevice, ...], WrapValidator(require_entries("devices"))]
    """Devices in SI units, each with a label. Default of their other keys: those of the scene."""

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        devices = raw.get("devices")
        if not isinstance(scene, PhysicalScene) or not isinstance(devices, list | tuple):
            return raw
        return {**raw, "devices": [_complete(device, scene) for device in devices]}

    def find_faults(self) -> Iterable[LocatedProblem]:
        yield from super().find_faults()
        for path, fault in find_repeated([device.label for device in self.devices], "rename one"):
            yield ("devices", *path, "label"), fault

    @property
    def sizes(self) -> dict[str, int]:
        return {"devices": len(self.devices)}

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        scenes = {device.label: device.to_scene() for device in self.devices}
        # Find the stiffest walls first, because this takes longest and the tables use the stored boundaries.
        tops = {label: loop.max_stiffness() for label, loop in track_progress(list(scenes.items()))}
        table, walls = tabulate_sets(scenes)
        rows = []
        for label, wall in tops.items():
            islands = table["number"][(table["label"] == label) & (table["piece"] == "island")] if table else []
            top = summarize_stiffest(wall)
            rows.append({"label": label, **top, "islands": np.unique(islands).size})
        return Outcome(
            table=stack(rows),
            figures={"": partial(plotting.draw_stable_set, table, walls)} if table else {},
            documents={f"{self.name}_outlines.csv": csv_text(table, self.unit_system)},
            answer=tuple(
                f"{row['label']}: {spell_stiffest(row, self.unit_system)}" for row in rows if row["kind"] != "none"
            ),
            notes=tuple(f"{row['label']}: no wall is stable" for row in rows if row["kind"] == "none"),
        )


def _complete(device: Any, scene: PhysicalScene) -> Any:
    """Return the mapping of a device, in which the scene supplies the absent keys; return other values unchanged."""
    if not isinstance(device, dict):
        return device
    supplied = {"mass": scene.mass, "damping": scene.damping, "delay": scene.delay, **list_parts(scene)}
    supplied |= {} if {"period", "rate"} & set(device) else {"period": scene.period}
    # Supply no mass, damping or mechanical parts to a linear system or measured response, because it contains them,
    # and no system or response to a device with a mass, because a device has only one of both.
    if "device" in device:
        supplied = {name: value for name, value in supplied.items() if name in ("period", "delay", "velocity")}
    elif "mass" in device:
        supplied.pop("device", None)
    return {name: value for name, value in {**supplied, **device}.items() if value is not None}


MapOutput: TypeAlias = Literal["stable", "spectral_radius", "passive"]

_OUTPUTS = {"stable": is_stable, "spectral_radius": spectral_radius, "passive": is_passive}


@register
class MapStudy(ComputedStudy):
    """The stability, spectral radius and passivity of walls on a grid of alpha, beta, delta and d."""

    method = "Stability by the phase at the gain crossover; radii by Newton's method, to some rounding errors."
    reads_scene = True

    kind: Literal["map"]

    alpha: AnyAxis
    beta: AnyAxis
    delta: DeltaAxis
    d: DelayAxis

    outputs: Annotated[tuple[MapOutput, ...], WrapValidator(require_entries("outputs"))] = ("stable",)
    """Outputs to compute at every point."""

    @property
    def nbytes(self) -> int:
        # Add one byte per point for the status code.
        return self.points * (1 + sum(np.dtype(OUTPUTS[name].dtype).itemsize for name in self.outputs))

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        alpha, beta, delta, d = (axis.values() for axis in (self.alpha, self.beta, self.delta, self.d))
        share = find_device_share(self.delta, self.d, scene)
        shape = tuple(self.sizes.values())
        outputs = {name: np.empty(shape, dtype=OUTPUTS[name].dtype) for name in self.outputs}
        status = np.empty(shape, np.uint8)
        # Compute one plane of alpha and beta at a time, because broadcast intermediate arrays are several times as
        # large as the results.
        for delta_index, d_index in np.ndindex(delta.size, d.size):
            index = (slice(None), slice(None), delta_index, d_index)
            walls, device = (alpha[:, None], beta[None, :]), (delta[delta_index], d[d_index])
            for name in outputs:
                damping = device[0] * (share if name == "passive" else 1.0)
                outputs[name][index] = np.asarray(_OUTPUTS[name](*walls, damping, device[1]))
            numbers = [outputs[name][index] for name in outputs if OUTPUTS[name].dtype == "float64"]
            status[index] = status_of_results(shape[:2], numbers, walls, device)
        arrays = {"alpha": alpha, "beta": beta, "delta": delta, "d": d, **outputs, "status": status}
        arrays = add_si_columns(arrays, self.delta, self.d, scene)
        names = outputs if min(alpha.size, beta.size) > 1 else ()

        def find_edge(name: str, delta: float, d: float) -> Outlines | None:
            passive = name == "passive"
            device = Device(1.0, delta * (share if passive else 1.0))
            return find_edges(Scene(device, Timing(1.0, d))).get("passive" if passive else "stable")

        draw = partial(plotting.draw_map, arrays)
        drawn = {f"_{name}": partial(draw, name, edges=partial(find_edge, name)) for name in names}
        return Outcome(arrays=arrays, figures=drawn, notes=note_failures(np.bincount(status.ravel())))
