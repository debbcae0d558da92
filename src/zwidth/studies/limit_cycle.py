"""Study "limit_cycle": amplitude and frequency of limit cycles over one or two parameters, for several conditions.

Every point of the grid is simulated. Its motion is at rest, in a limit cycle or at a larger amplitude, depending on
the amplitude in the last quarter. The linear stability boundary is drawn for comparison. Parameters of the grid are K,
B, encoder step and Coulomb friction; each condition has its own panel in the figure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, Literal, get_type_hints

import numpy as np
from pydantic import WrapValidator, create_model

from zwidth import plotting
from zwidth.analysis.scene import Scene
from zwidth.config.fields import LocatedProblem, Strict, find_repeated, problem, require_entries
from zwidth.config.scenes import AnyScene
from zwidth.config.study import register
from zwidth.config.values import Axis, Quantity, axis_of
from zwidth.core.status import Status
from zwidth.model.velocity import FOAW
from zwidth.plotting.limit_cycle import AXES
from zwidth.plotting.stable_set import trace_outlines
from zwidth.plotting.table import stack
from zwidth.simulation.result import OF_WHOLE, MotionKind
from zwidth.studies.outcome import Outcome, csv_text
from zwidth.studies.simulate import SimulatedStudy, SimulationConditions
from zwidth.units.display import find_unit
from zwidth.units.formatting import format_short, header, with_unit
from zwidth.units.quantities import POSITIVE

_COLUMNS = {parameter.name: column for column, parameter in AXES.items()}
_OUTPUTS = ("amplitude", "frequency", "wall_work_max", "outcome", "status")
_MAX_CURVES = 6  # largest number of values of a list that are drawn as curves; a longer list is drawn as a plane
# Default of the largest amplitude that counts as a limit cycle: in m for linear devices (key False), in rad for rotary
# devices (key True).
WIDEST = {False: 1e-3, True: math.radians(20.0)}
WIDEST_STEPS = 10.0  # lower bound of this default, in encoder steps


# Make every field of `SimulationConditions` optional, because a condition contains only the values that it overrides.
_OVERRIDES: Any = {
    name: (hint | None, None)
    for name, hint in get_type_hints(SimulationConditions, include_extras=True).items()
    if name in SimulationConditions.model_fields
}
_Overrides: Any = create_model("_Own", __base__=Strict, **_OVERRIDES)


class CycleCondition(_Overrides):
    """Condition of one panel of a limit_cycle study; its parameters replace those of the study."""

    noun = "a condition"
    described_by = (SimulationConditions,)

    label: str
    """Unique name of the condition, the title of its panel."""


class CycleAxes(Strict, noun="the axes of a limit_cycle study"):
    """Parameters of a limit_cycle study, one or two of them with several values."""

    stiffness: Annotated[Axis, axis_of("stiffness")]
    virtual_damping: Annotated[Axis, axis_of("virtual_damping")]
    resolution: Annotated[Axis, axis_of("resolution")] | None = None
    coulomb: Annotated[Axis, axis_of("coulomb")] | None = None

    def find_faults(self) -> Iterable[LocatedProblem]:
        if not 1 <= len(self.varied) <= 2:
            message = f"got {len(self.varied)} axes with several values"
            yield (), problem(message, "one or two are allowed", "write the others as numbers")

    @property
    def given(self) -> dict[str, Axis]:
        """Dictionary of the axes in the configuration, with one or several values, by the name of the parameter."""
        return {name: getattr(self, name) for name in _COLUMNS if getattr(self, name) is not None}

    @property
    def varied(self) -> dict[str, Axis]:
        """Axes with several values, by the name of the parameter."""
        return {name: axis for name, axis in self.given.items() if axis.size > 1}

    def broadcast(self) -> dict[str, np.ndarray]:
        """Return the values of each axis by its name: a number, or an array that broadcasts to the grid."""
        grid = np.meshgrid(*(axis.values() for axis in self.varied.values()), indexing="ij", sparse=True)
        return {name: axis.values()[0] for name, axis in self.given.items()} | dict(zip(self.varied, grid, strict=True))


@register
class LimitCycleStudy(SimulatedStudy, SimulationConditions):
    """The amplitude and frequency of limit cycles over one or two parameters, under one or more conditions."""

    method = "Simulations, exact between samples; amplitude and frequency as observed in the last quarter."
    point_bytes = 8 * (1 + len(_OUTPUTS))

    kind: Literal["limit_cycle"]

    axes: CycleAxes
    """Stiffness and virtual damping of the walls, and optionally encoder step and Coulomb friction."""

    conditions: Annotated[tuple[CycleCondition, ...], WrapValidator(require_entries("conditions"))]
    """Conditions, one per panel, with the parameters that differ from those of the study. Default: one panel."""

    smallest_amplitude: Annotated[float, Quantity("m", POSITIVE)] = 1e-6
    """Amplitude below which a motion counts as at rest, in m or rad or with a unit."""

    largest_amplitude: Annotated[float, Quantity("m", POSITIVE)] | None = None
    """Largest amplitude still counted as a limit cycle, in m or rad or with a unit; larger motions are counted and
    plotted separately. Default: 1 mm (20 deg for a rotary device) or 10 encoder steps, whichever is larger."""

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        return {"conditions": [{"label": raw.get("name", "")}], **raw}

    def find_faults(self) -> Iterable[LocatedProblem]:
        yield from super().find_faults()
        for path, message in find_repeated([each.label for each in self.conditions], "rename one"):
            yield ("conditions", *path, "label"), message
        for index, condition in enumerate(self.conditions):
            for name in self.axes.given:
                if getattr(condition, name, None) is not None:
                    message = "given twice, in the condition and as an axis"
                    yield ("conditions", index, name), problem(message, "each parameter once", "remove one")
        scene = self.device.to_scene()
        if scene.tool is not None:
            yield ("device",), problem("got a tool", "limit cycles are found on walls only", "use the kind 'simulate'")
        smallest_amplitude, largest_amplitude = self.bound_amplitudes(scene)
        if largest_amplitude <= smallest_amplitude:
            low, high = (with_unit(end, scene.unit_system["m"]) for end in (smallest_amplitude, largest_amplitude))
            name = "smallest_amplitude" if self.largest_amplitude is None else "largest_amplitude"
            received = f"got smallest_amplitude {low}, largest_amplitude {high}"
            yield (
                (name,),
                problem(
                    received,
                    "smallest_amplitude must be less than largest_amplitude",
                    "raise largest_amplitude or lower smallest_amplitude",
                ),
            )
        problems = [list(each.find_inconsistencies(scene)) for each in self.list_conditions()]
        for index, (condition, faults) in enumerate(zip(self.conditions, problems, strict=True)):
            for path, message in faults:
                is_overridden = getattr(condition, str(path[0])) is not None
                # Report a fault in a value of the study itself only once, for the first condition, because all
                # conditions share this value.
                if is_overridden or index == 0:
                    yield (("conditions", index, *path) if is_overridden else path), message

    def list_conditions(self) -> list[SimulationConditions]:
        """Return the complete conditions of each panel; the study supplies the parameters that are not overridden."""
        common = {name: getattr(self, name) for name in SimulationConditions.model_fields}
        overrides = [{name: getattr(each, name) for name in common} for each in self.conditions]
        return [
            SimulationConditions.model_construct(
                **common | {name: value for name, value in override.items() if value is not None}
            )
            for override in overrides
        ]

    def bound_amplitudes(self, scene: Scene) -> tuple[float, float]:
        """Return the smallest and the largest amplitude that count as a limit cycle, in m or rad."""
        if self.largest_amplitude is not None:
            return self.smallest_amplitude, self.largest_amplitude
        steps = [self.resolution, *(each.resolution or 0.0 for each in self.conditions)]
        steps += self.axes.resolution.values().tolist() if self.axes.resolution is not None else []
        return self.smallest_amplitude, max(WIDEST[scene.unit_system.rotary], WIDEST_STEPS * max(steps))

    @property
    def sizes(self) -> dict[str, int]:
        return {"conditions": len(self.conditions)} | {name: axis.size for name, axis in self.axes.varied.items()}

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        axes, varied = self.axes.broadcast(), self.axes.varied
        labels = [each.label for each in self.conditions]
        results: dict[str, list[np.ndarray]] = {name: [] for name in (*_OUTPUTS, "linearly_stable")}
        bounds = self.bound_amplitudes(self.device.to_scene())
        edges, notes = [], []
        for label, given in zip(labels, self.list_conditions(), strict=True):
            scene_of_panel = given.set_velocity(self.device.to_scene())
            options: dict[str, Any] = given.list_options(self.device.period) | axes
            motion = scene_of_panel.simulate(**options, record=False)
            for name in _OUTPUTS:
                results[name].append(getattr(motion, name))
            stable = np.full(motion.outcome.shape, -1, np.int8)
            if not isinstance(scene_of_panel.velocity, FOAW):
                stable[...] = scene_of_panel.is_stable(axes["stiffness"], axes["virtual_damping"])
                edges += trace_edges(scene_of_panel, label, varied, axes)
            results["linearly_stable"].append(stable)
            notes.append(f"{label}: {describe_outcomes(motion, stable, bounds)}")
        units = {name: unit for name, (_, unit) in OF_WHOLE.items()}
        arrays = {"condition": np.array(labels)} | {_COLUMNS[name]: axis.values() for name, axis in varied.items()}
        arrays |= {header(name, units.get(name, "1")): np.stack(values) for name, values in results.items()}
        table = stack(edges)
        # Draw curves if only one parameter varies or if one has a short list of values, because a plane needs two
        # parameters with many values.
        short = [name for name, axis in varied.items() if axis.form == "list" and axis.size <= _MAX_CURVES]
        draw = partial(plotting.draw_limit_cycles, arrays, table, bounds)
        if short or len(varied) == 1:
            family = _COLUMNS[short[0]] if len(varied) > 1 else ""
            draw = partial(plotting.draw_limit_cycle_curves, arrays, table, bounds, family)
        low, high = (format_short(bound, self.unit_system["m"]) for bound in bounds)
        rest = f"at rest: an amplitude below {low} in the last quarter of {self.duration}"
        notes.append(f"{rest}; limit cycle: amplitude from {low} to {high}")
        return Outcome(
            arrays=arrays,
            figures={"": draw},
            documents={f"{self.name}_boundary.csv": csv_text(table, self.unit_system)} if table else {},
            notes=tuple(notes),
        )


def trace_edges(scene: Scene, label: str, varied: dict[str, Axis], axes: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Compute the linear stability boundary of one panel in the plane of its varied parameters.

    If K and B vary, the curves are the outlines of the stable set. If only one of them varies, they are straight lines
    at the limits of its stable intervals. If neither varies, there are no curves.

    Args:
        scene: device with the velocity estimate of the panel.
        label: name of the condition.
        varied: axes with several values, by the name of the parameter.
        axes: values of all axes, by the name of the parameter.

    Returns:
        One dict of columns per curve.
    """
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
    """Return a text with the number of walls at rest, in a limit cycle and at a larger amplitude.

    Args:
        motion: motions of all walls.
        stable: 1 for linearly stable walls, 0 for unstable ones, -1 if the velocity estimate has no linear form.
        bounds: smallest and largest amplitude that count as a limit cycle, in m or rad.
    """
    wide = (motion.outcome == MotionKind.DIVERGED) | (motion.amplitude > bounds[1])
    rest = ~wide & (motion.amplitude < bounds[0])
    complete = motion.status == Status.OK
    ends = {
        "at rest": rest,
        "in a limit cycle": ~rest & ~wide,
        f"larger than {format_short(bounds[1], find_unit(motion, 'm'))}": wide,
    }
    parts = []
    for name, kind in {"linearly stable ": 1, "linearly unstable ": 0, "": -1}.items():
        selected = complete & (stable == kind)
        if selected.any():
            counts = ", ".join(f"{np.count_nonzero(end[selected]):,} {word}" for word, end in ends.items())
            parts.append(f"of {np.count_nonzero(selected):,} {name}walls {counts}")
    lost = int(np.count_nonzero(~complete))
    return "; ".join(parts) + (f"; {lost} not simulated to the end" if lost else "")
