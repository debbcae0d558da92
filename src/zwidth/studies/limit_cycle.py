"""Study "limit_cycle": amplitude and frequency of limit cycles over one or two parameters, for several conditions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, Literal, get_type_hints

import numpy as np
from pydantic import WrapValidator, create_model

from zwidth import figures
from zwidth.config.fields import LocatedProblem, Strict, members, problem, repeated
from zwidth.config.scenes import AnyScene
from zwidth.config.study import register
from zwidth.config.values import Axis, Quantity, axis_of
from zwidth.figures.limit_cycle import AXES
from zwidth.figures.stable_set import trace_outlines
from zwidth.figures.table import stack
from zwidth.parts.velocity import FOAW
from zwidth.scenes.scene import Scene
from zwidth.simulation.result import OF_WHOLE, MotionKind
from zwidth.studies.outcome import Outcome, csv_text
from zwidth.studies.simulate import Circumstances, SimulatedStudy
from zwidth.words.formatting import header, spell_short, with_unit
from zwidth.words.quantities import POSITIVE
from zwidth.words.showing import find_unit
from zwidth.words.status import Status

_COLUMNS = {known.name: column for column, known in AXES.items()}
_OUTPUTS = ("amplitude", "frequency", "energy_given", "outcome", "status")
_MOST_CURVES = 6  # values of a list that are drawn as curves; a longer list is drawn as a plane
# Default of the largest amplitude that counts as a limit cycle, by "is rotary": in m for a linear, in rad for a rotary
# device.
WIDEST = {False: 1e-3, True: math.radians(20.0)}
WIDEST_STEPS = 10.0  # lower bound of that default, in encoder steps


# A condition may override every parameter of the study; None means not overridden.
_OWN: Any = {
    name: (hint | None, None)
    for name, hint in get_type_hints(Circumstances, include_extras=True).items()
    if name in Circumstances.model_fields
}
_Own: Any = create_model("_Own", __base__=Strict, **_OWN)


class CycleCondition(_Own):
    """Parameters of one panel of a limit_cycle study."""

    what = "a condition"
    described_by = (Circumstances,)

    label: str
    """Unique name of the condition."""


class CycleAxes(Strict, what="the axes of a limit_cycle study"):
    """Parameters of a limit_cycle study, one or two of them with several values."""

    stiffness: Annotated[Axis, axis_of("stiffness")]
    virtual_damping: Annotated[Axis, axis_of("virtual_damping")]
    resolution: Annotated[Axis, axis_of("resolution")] | None = None
    coulomb: Annotated[Axis, axis_of("coulomb")] | None = None

    def limits(self) -> Iterable[LocatedProblem]:
        if not 1 <= len(self.varied) <= 2:
            what = f"got {len(self.varied)} axes with several values"
            yield (), problem(what, "one or two are allowed", "write the others as numbers")

    @property
    def given(self) -> dict[str, Axis]:
        return {name: getattr(self, name) for name in _COLUMNS if getattr(self, name) is not None}

    @property
    def varied(self) -> dict[str, Axis]:
        return {name: axis for name, axis in self.given.items() if axis.size > 1}

    def lay_out(self) -> dict[str, np.ndarray]:
        """Return the values of every axis, shaped to broadcast to the grid."""
        grid = np.meshgrid(*(axis.values() for axis in self.varied.values()), indexing="ij", sparse=True)
        return {name: axis.values()[0] for name, axis in self.given.items()} | dict(zip(self.varied, grid, strict=True))


@register
class LimitCycleStudy(SimulatedStudy, Circumstances):
    """Amplitude of limit cycles over one or two parameters, under one or several conditions."""

    method = "Simulations, exact between samples; amplitude and frequency as observed in the last quarter."
    point_bytes = 8 * (1 + len(_OUTPUTS))

    kind: Literal["limit_cycle"]

    axes: CycleAxes
    """Walls, and encoder and friction if they vary."""

    conditions: Annotated[tuple[CycleCondition, ...], WrapValidator(members("conditions"))]
    """Parameters of each panel that differ from those of the study; default: one panel."""

    silence: Annotated[float, Quantity("m", POSITIVE)] = 1e-6
    """Amplitude below which a motion counts as at rest, in m or rad or with a unit."""

    widest: Annotated[float, Quantity("m", POSITIVE)] | None = None
    """Largest amplitude still counted as a limit cycle, in m or rad or with a unit; larger motions are counted and
    plotted separately. Default: 1 mm (20 deg for a rotary device) or 10 encoder steps, whichever is larger."""

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        return {"conditions": [{"label": raw.get("name", "")}], **raw}

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        for place, what in repeated([each.label for each in self.conditions], "rename one"):
            yield ("conditions", *place, "label"), what
        for index, condition in enumerate(self.conditions):
            for name in self.axes.given:
                if getattr(condition, name, None) is not None:
                    what = "given twice, here and as an axis"
                    yield ("conditions", index, name), problem(what, "each parameter once", "remove one")
        scene = self.device.to_scene()
        silence, widest = self.bound_amplitudes(scene)
        if widest <= silence:
            low, high = (with_unit(end, scene.unit_system["m"]) for end in (silence, widest))
            name = "silence" if self.widest is None else "widest"
            received = f"got silence {low}, widest {high}"
            yield (name,), problem(received, "silence must be less than widest", "raise widest or lower silence")
        found = [list(each.find_clashes(scene)) for each in self.list_circumstances()]
        for index, (condition, faults) in enumerate(zip(self.conditions, found, strict=True)):
            for path, what in faults:
                own = getattr(condition, str(path[0])) is not None
                # Report a fault of the whole study only once.
                if own or index == 0:
                    yield (("conditions", index, *path) if own else path), what

    def list_circumstances(self) -> list[Circumstances]:
        common = {name: getattr(self, name) for name in Circumstances.model_fields}
        owns = [{name: getattr(each, name) for name in common} for each in self.conditions]
        return [
            Circumstances.model_construct(**common | {name: value for name, value in own.items() if value is not None})
            for own in owns
        ]

    def bound_amplitudes(self, scene: Scene) -> tuple[float, float]:
        """Return the smallest and the largest amplitude counted as a limit cycle, in SI units."""
        if self.widest is not None:
            return self.silence, self.widest
        steps = [self.resolution, *(each.resolution or 0.0 for each in self.conditions)]
        steps += self.axes.resolution.values().tolist() if self.axes.resolution is not None else []
        return self.silence, max(WIDEST[scene.unit_system.rotary], WIDEST_STEPS * max(steps))

    @property
    def sizes(self) -> dict[str, int]:
        return {"conditions": len(self.conditions)} | {name: axis.size for name, axis in self.axes.varied.items()}

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        axes, varied = self.axes.lay_out(), self.axes.varied
        labels = [each.label for each in self.conditions]
        found: dict[str, list[np.ndarray]] = {name: [] for name in (*_OUTPUTS, "linearly_stable")}
        bounds = self.bound_amplitudes(self.device.to_scene())
        edges, notes = [], []
        for label, given in zip(labels, self.list_circumstances(), strict=True):
            placed = given.place(self.device.to_scene())
            options: dict[str, Any] = given.options(self.device.period) | axes
            motion = placed.simulate(**options, record=False)
            for name in _OUTPUTS:
                found[name].append(getattr(motion, name))
            stable = np.full(motion.outcome.shape, -1, np.int8)
            if not isinstance(placed.velocity, FOAW):
                stable[...] = placed.is_stable(axes["stiffness"], axes["virtual_damping"])
                edges += trace_edges(placed, label, varied, axes)
            found["linearly_stable"].append(stable)
            notes.append(f"{label}: {describe_outcomes(motion, stable, bounds)}")
        units = {name: unit for name, (_, unit) in OF_WHOLE.items()}
        arrays = {"condition": np.array(labels)} | {_COLUMNS[name]: axis.values() for name, axis in varied.items()}
        arrays |= {header(name, units.get(name, "1")): np.stack(values) for name, values in found.items()}
        table = stack(edges)
        # Draw one curve for each value of a short list, or one curve; otherwise a plane.
        short = [name for name, axis in varied.items() if axis.form == "list" and axis.size <= _MOST_CURVES]
        draw = partial(figures.draw_limit_cycles, arrays, table, bounds)
        if short or len(varied) == 1:
            family = _COLUMNS[short[0]] if len(varied) > 1 else ""
            draw = partial(figures.draw_limit_cycle_curves, arrays, table, bounds, family)
        low, high = (spell_short(bound, self.unit_system["m"]) for bound in bounds)
        rest = f"at rest: an amplitude below {low} in the last quarter of {self.duration}"
        notes.append(f"{rest}; limit cycle: amplitude from {low} to {high}")
        return Outcome(
            arrays=arrays,
            figures={"": draw},
            documents={f"{self.name}_boundary.csv": csv_text(table, self.unit_system)} if table else {},
            notes=tuple(notes),
        )


def trace_edges(scene: Scene, label: str, varied: dict[str, Axis], axes: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Return the linear boundary in the plane of two axes, as columns: outlines, or lines if K or B is fixed."""
    walls = [name for name in ("stiffness", "virtual_damping") if name in varied]
    if not walls:
        return []
    if len(walls) == 2:
        lines = [{name: outline[_COLUMNS[name]] for name in walls} for outline in trace_outlines(scene)]
    else:
        (along,) = walls
        ends = scene.stable_stiffness if along == "stiffness" else scene.stable_damping
        others = {name: varied[name].values() for name in varied if name != along}
        far = {name: np.array([values.min(), values.max()]) for name, values in others.items()}
        (level,) = (float(axes[name]) for name in ("stiffness", "virtual_damping") if name != along)
        lines = [{along: np.full(2, value), **far} for value in ends(level).ravel()]
    return [
        {"condition": label, "number": number, **{_COLUMNS[name]: part for name, part in line.items()}}
        for number, line in enumerate(lines, start=1)
    ]


def describe_outcomes(motion: Any, stable: np.ndarray, bounds: tuple[float, float]) -> str:
    """Return the numbers of linearly stable and unstable walls at rest, in a limit cycle or at a larger amplitude."""
    wide = (motion.outcome == MotionKind.DIVERGED) | (motion.amplitude > bounds[1])
    rest = ~wide & (motion.amplitude < bounds[0])
    known = motion.status == Status.OK
    ends = {
        "at rest": rest,
        "in a limit cycle": ~rest & ~wide,
        f"larger than {spell_short(bounds[1], find_unit(motion, 'm'))}": wide,
    }
    words = []
    for name, kind in {"linearly stable ": 1, "linearly unstable ": 0, "": -1}.items():
        those = known & (stable == kind)
        if those.any():
            counts = ", ".join(f"{np.count_nonzero(end[those]):,} {word}" for word, end in ends.items())
            words.append(f"of {np.count_nonzero(those):,} {name}walls {counts}")
    lost = int(np.count_nonzero(~known))
    return "; ".join(words) + (f"; {lost} not simulated to the end" if lost else "")
