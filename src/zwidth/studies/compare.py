"""The compare study: several devices side by side, their stable walls and the stiffest of each."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import WrapValidator

from zwidth import figures
from zwidth.config.faults import LocatedProblem
from zwidth.config.fields import members, repeated
from zwidth.config.parts import list_parts
from zwidth.config.scenes import AnyScene, LabeledDevice, PhysicalScene
from zwidth.config.study import register
from zwidth.figures.stable_set import tabulate_walls, trace_outlines
from zwidth.figures.table import stack
from zwidth.studies.outcome import ComputedStudy, Outcome, csv_text, summarize_stiffest

# An outline has some hundreds of points, of which an estimate of the size may rest on.
_POINTS_PER_OUTLINE = 1000


@register
class CompareStudy(ComputedStudy):
    """The stable walls of several devices in one figure, and the stiffest wall of each in a table."""

    method = "Closed forms; with parts, signed crossings of the boundary curve and the highest point of each edge."
    from_scene = ()
    takes_parts = True
    point_bytes = 64

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

    @property
    def points(self) -> int:
        return super().points * _POINTS_PER_OUTLINE

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        """The outlines of every device, and a table of the stiffest walls."""
        rows, outlines, walls = [], [], []
        for device in self.devices:
            label, loop = device.label, device.to_scene()
            top = loop.max_stiffness()
            pieces = list(trace_outlines(loop, label=label))
            islands = sum(piece["piece"] == "island" for piece in pieces)
            rows.append({"label": label, **summarize_stiffest(top), "islands": islands})
            outlines += pieces
            walls.append({"label": label, "wall": "stiffest", **tabulate_walls(loop, *top[:2])})
        bare = [row["label"] for row in rows if row["kind"] == "none"]
        table = stack(outlines)
        return Outcome(
            table=stack(rows),
            figures={"": partial(figures.draw_stable_set, table, stack(walls))} if table else {},
            documents={f"{self.name}_outlines.csv": csv_text(table)},
            notes=tuple(f"{label}: no wall is stable" for label in bare),
        )


def _complete(device: Any, scene: PhysicalScene) -> Any:
    """A device's mapping with what the scene knows and it leaves out; anything else as it is."""
    if not isinstance(device, dict):
        return device
    supplied = {"mass": scene.mass, "damping": scene.damping, "delay": scene.delay, **list_parts(scene)}
    supplied |= {} if {"period", "rate"} & set(device) else {"period": scene.period}
    return {**supplied, **device}
