"""Stable walls as outlines and maps: boundaries over alpha and beta or delta and beta, devices compared, and grids."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from itertools import product
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import WrapValidator

from zwidth import figures
from zwidth.config.fields import LocatedProblem, members, problem, repeated
from zwidth.config.parts import list_parts
from zwidth.config.scenes import AnyScene, LabeledDevice, PhysicalDevice, PhysicalScene
from zwidth.config.study import name_parts, register
from zwidth.config.values import AnyAxis, DelayAxis, DeltaAxis
from zwidth.figures.stable_set import Outlines, tabulate_sets
from zwidth.figures.table import stack
from zwidth.loops.rigid.boundary import Piece, boundary_point, stable_region
from zwidth.loops.rigid.normalization import status_of_results
from zwidth.loops.rigid.passivity import is_passive
from zwidth.loops.rigid.spectral_radius import spectral_radius
from zwidth.loops.rigid.verdict import is_stable
from zwidth.parts.device import Device
from zwidth.parts.timing import Timing
from zwidth.scenes.scene import Scene
from zwidth.studies.outcome import (
    ComputedStudy,
    CurvesStudy,
    Outcome,
    add_si_of_scene,
    csv_text,
    share_of_device,
    spell_stiffest,
    summarize_stiffest,
)
from zwidth.studies.ridge import find_edges, passive_intervals, passive_outlines, ridge_table
from zwidth.words.quantities import OUTPUTS, WALL_RANGE
from zwidth.words.status import note_failures

Plane: TypeAlias = Literal["alpha_beta", "delta_beta"]

# Samples of a boundary over frequency; only an estimate of a result's size rests on it.
_POINTS_PER_CURVE = 1000
_RIDGE_POINTS = 101


@register
class BoundaryStudy(CurvesStudy):
    """Stability boundaries, one per delta and d."""

    method = "Closed form of the boundary, to a few rounding errors; the stable side by counting poles."
    reads_scene = True
    takes_parts = True

    kind: Literal["boundary"]

    device: PhysicalDevice | None = None
    """A device in SI units, in place of delta and d; the scene's where it has parts and they are left out."""

    plane: Plane = "alpha_beta"
    """Boundary over alpha and beta, or over delta and beta at alpha -> 0."""

    ridge_path: bool = False
    """Draw the path of maximum stiffness over delta as well; in the plane alpha_beta."""

    passivity: bool = False
    """Draw the passivity condition as well."""

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        if "device" in raw or (scene.parts_beyond and not {"delta", "d"} & set(raw)):
            return {"device": scene.bare(), **raw}
        return super().fill(raw, scene)

    @classmethod
    def check_parts(cls, raw: dict[str, Any], scene: AnyScene) -> None:
        given = [name for name in ("delta", "d") if name in raw]
        if len(given) == 1 and "device" not in raw and scene.parts_beyond:
            remedy = f"remove {given[0]!r}, or give both delta and d"
            raise problem(f"got {given[0]!r} beside a scene with parts", "a device with parts has its own", remedy)

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        """Take delta and d from the device; errors of the device are reported at its fields."""
        if "device" not in raw:
            return raw
        try:
            device = PhysicalDevice.model_validate(raw["device"])
        except ValueError:
            return {"delta": 0.0, "d": 0.0, **raw}
        return {"delta": device.delta, "d": device.d, **raw}

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        if raw.get("plane") == "delta_beta" and raw.get("ridge_path") is True:
            allowed = "the path of maximum stiffness lies in the plane alpha_beta; at alpha -> 0 there is none"
            yield ("ridge_path",), problem("got true with plane delta_beta", allowed, "remove ridge_path")

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        if self.plane == "delta_beta" and self.delta.size < 2:
            allowed = "the plane delta_beta needs two values of delta or more, its curves run over delta"
            yield ("delta",), problem("got one value", allowed, "give delta as a list, linear or log axis")
        if self.device is None:
            return
        for name in ("delta", "d"):
            if getattr(self, name).values().tolist() != [getattr(self.device, name)]:
                what = f"got {name!r} beside a device"
                yield (name,), problem(what, "a device has its own", "remove one", on_key=True)
        if not self.device.parts_beyond:
            return
        asked = {"plane": "alpha_beta", "ridge_path": False, "passivity": False}
        for name in [name for name, known in asked.items() if getattr(self, name) != known]:
            parts = name_parts(self.device.parts_beyond)
            allowed = f"it is known for a rigid mass with the difference of two samples, not for one with {parts}"
            yield (name,), problem(f"got {name!r}", allowed, "remove it", on_key=True)

    @property
    def points(self) -> int:
        return super().points * (_POINTS_PER_CURVE if self.plane == "alpha_beta" else 1)

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        if self.device is not None and self.device.parts_beyond:
            return outline_device(self.device, self.device.label or self.name)
        deltas, delays = self.delta.values(), self.d.values()
        if self.plane == "delta_beta":
            deltas = np.sort(deltas)
            parts = stable_intervals(deltas, delays)
            parts += passive_intervals(deltas, delays) if self.passivity else ()
            table = stack(parts)
            return Outcome(table=table, figures={"": partial(figures.draw_zero_stiffness, table)})
        notes: list[str] = []
        parts = [outline(delta, d) for d, delta in product(delays.tolist(), deltas.tolist())]
        if self.ridge_path:
            path, notes = ridge_table(np.linspace(deltas.min(), deltas.max(), _RIDGE_POINTS), delays)
            path["alpha"] = path.pop("alpha_max")
            del path["kind"]
            parts.append({"curve": "ridge_path", **path})
        share = share_of_device(self.delta, self.d, self.device or scene)
        parts += passive_outlines(deltas, delays, share) if self.passivity else ()
        table = add_si_of_scene(stack(parts), self.delta, self.d, self.device or scene)
        return Outcome(table=table, figures={"": partial(figures.draw_boundary, table)}, notes=tuple(notes))


def outline_device(device: PhysicalDevice, label: str) -> Outcome:
    """Return the outlines of the stable set of a device with parts, islands and holes included, and its K_max."""
    outlines, walls = tabulate_sets({label: device.to_scene()})
    if not outlines:
        return Outcome(notes=("no wall of this device is stable",))
    about = {"curve": "boundary", "label": label, "d": device.d, "delta": device.delta}
    table = stack([{**about, **outlines}])
    return Outcome(table=table, figures={"": partial(figures.draw_stable_set, table, walls)})


def outline(delta: float, d: float) -> dict[str, Any]:
    """Return the boundary of the stable set of one device, as columns."""
    region = stable_region(delta, d)
    columns = {"omega": region.omega, "alpha": region.alpha, "beta": region.beta}
    columns["piece"] = np.array([Piece(int(code)).name.lower() for code in region.piece])
    return {"curve": "boundary", "d": d, "delta": delta, **columns}


def stable_intervals(deltas: np.ndarray, delays: np.ndarray) -> list[dict[str, Any]]:
    """Return the stable interval of the virtual damping for alpha -> 0 over delta, as columns per delay."""
    # Use the smallest alpha in range, because alpha = 0 is on the stability boundary.
    upper = boundary_point(deltas, delays[:, None], alpha=WALL_RANGE[0], side="upper").beta
    shared = {"delta": deltas, "beta_lower": -deltas}
    rows = zip(delays, np.asarray(upper), strict=True)
    return [{"curve": "stable", "d": d, **shared, "beta_upper": row} for d, row in rows]


@register
class CompareStudy(ComputedStudy):
    """The stable walls of several devices in one figure, and the stiffest wall of each in a table."""

    method = "Closed forms; with parts, signed crossings of the boundary curve and the highest point of each edge."
    from_scene = ()
    takes_parts = True

    kind: Literal["compare"]

    devices: Annotated[tuple[LabeledDevice, ...], WrapValidator(members("devices"))]
    """Devices in SI units, each with a label; what one of them leaves out is the scene's."""

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        devices = raw.get("devices")
        if not isinstance(scene, PhysicalScene) or not isinstance(devices, list | tuple):
            return raw
        return {**raw, "devices": [_complete(device, scene) for device in devices]}

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        for place, what in repeated([device.label for device in self.devices], "rename one"):
            yield ("devices", *place, "label"), what

    @property
    def sizes(self) -> dict[str, int]:
        return {"devices": len(self.devices)}

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        scenes = {device.label: device.to_scene() for device in self.devices}
        table, walls = tabulate_sets(scenes)
        rows = []
        for label, loop in scenes.items():
            islands = table["number"][(table["label"] == label) & (table["piece"] == "island")] if table else []
            top = summarize_stiffest(loop.max_stiffness())
            rows.append({"label": label, **top, "islands": np.unique(islands).size})
        return Outcome(
            table=stack(rows),
            figures={"": partial(figures.draw_stable_set, table, walls)} if table else {},
            documents={f"{self.name}_outlines.csv": csv_text(table, self.unit_system)},
            answer=tuple(
                f"{row['label']}: {spell_stiffest(row, self.unit_system)}" for row in rows if row["kind"] != "none"
            ),
            notes=tuple(f"{row['label']}: no wall is stable" for row in rows if row["kind"] == "none"),
        )


def _complete(device: Any, scene: PhysicalScene) -> Any:
    """A device's mapping with what the scene knows and it leaves out; anything else as it is."""
    if not isinstance(device, dict):
        return device
    supplied = {"mass": scene.mass, "damping": scene.damping, "delay": scene.delay, **list_parts(scene)}
    supplied |= {} if {"period", "rate"} & set(device) else {"period": scene.period}
    # A device that is given as a whole stands for mass, damping and parts, and they for it.
    if "device" in device:
        supplied = {name: value for name, value in supplied.items() if name in ("period", "delay", "velocity")}
    elif "mass" in device:
        supplied.pop("device", None)
    return {name: value for name, value in {**supplied, **device}.items() if value is not None}


MapOutput: TypeAlias = Literal["stable", "spectral_radius", "passive"]

_OUTPUTS = {"stable": is_stable, "spectral_radius": spectral_radius, "passive": is_passive}


@register
class MapStudy(ComputedStudy):
    """Stability and passivity on a grid of alpha, beta, delta and d."""

    method = "Labels by the phase at the one gain crossover; radii by Newton's method, to some rounding errors."
    reads_scene = True

    kind: Literal["map"]

    alpha: AnyAxis
    beta: AnyAxis
    delta: DeltaAxis
    d: DelayAxis

    outputs: Annotated[tuple[MapOutput, ...], WrapValidator(members("outputs"))] = ("stable",)
    """What is computed at every point."""

    @property
    def nbytes(self) -> int:
        # And a status code a point.
        return self.points * (1 + sum(np.dtype(OUTPUTS[name].dtype).itemsize for name in self.outputs))

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        alpha, beta, delta, d = (axis.values() for axis in (self.alpha, self.beta, self.delta, self.d))
        share = share_of_device(self.delta, self.d, scene)
        shape = tuple(self.sizes.values())
        outputs = {name: np.empty(shape, dtype=OUTPUTS[name].dtype) for name in self.outputs}
        status = np.empty(shape, np.uint8)
        # One plane at a time: the columns that broadcasting lays out are several times as large as the results.
        for delta_index, d_index in np.ndindex(delta.size, d.size):
            place = (slice(None), slice(None), delta_index, d_index)
            walls, device = (alpha[:, None], beta[None, :]), (delta[delta_index], d[d_index])
            for name in outputs:
                damping = device[0] * (share if name == "passive" else 1.0)
                outputs[name][place] = np.asarray(_OUTPUTS[name](*walls, damping, device[1]))
            numbers = [outputs[name][place] for name in outputs if OUTPUTS[name].dtype == "float64"]
            status[place] = status_of_results(shape[:2], numbers, walls, device)
        arrays = {"alpha": alpha, "beta": beta, "delta": delta, "d": d, **outputs, "status": status}
        arrays = add_si_of_scene(arrays, self.delta, self.d, scene)
        names = outputs if min(alpha.size, beta.size) > 1 else ()

        def find_edge(name: str, delta: float, d: float) -> Outlines | None:
            passive = name == "passive"
            device = Device(1.0, delta * (share if passive else 1.0))
            return find_edges(Scene(device, Timing(1.0, d))).get("passive" if passive else "stable")

        draw = partial(figures.draw_map, arrays)
        drawn = {f"_{name}": partial(draw, name, edges=partial(find_edge, name)) for name in names}
        return Outcome(arrays=arrays, figures=drawn, notes=note_failures(np.bincount(status.ravel())))
