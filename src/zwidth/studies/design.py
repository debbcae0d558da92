"""Studies for the choice of parameters: "design" and "filters".

"design" solves K_max = reserve * K for one parameter of the device, where K_max is the maximum stable stiffness, K the
required stiffness and reserve >= 1 a factor of safety, and simulates random devices within tolerances. "filters"
computes K_max over velocity filters, and the noise of their velocity from the encoder steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import groupby, product
from operator import itemgetter
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, GetPydanticSchema, ValidationInfo, WithJsonSchema

from zwidth import plotting
from zwidth.analysis.batch import stiffest_walls
from zwidth.analysis.optimization import RequiredValue, StiffestWall
from zwidth.analysis.scene import Scene
from zwidth.analysis.tolerances import Tolerance, simulate_tolerances
from zwidth.config.fields import LocatedProblem, problem, quote_names
from zwidth.config.parts import parse_input_error
from zwidth.config.scenes import AnyScene, PhysicalDevice
from zwidth.config.study import register
from zwidth.config.values import Axis, Fraction, Quantity, axis_of, quantity_of, read_entries
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.model.velocity import BackwardDifference, LowPass, Velocity, WindowedDifference
from zwidth.model.velocity_noise import find_velocity_noise
from zwidth.model.wall import VirtualWall
from zwidth.plotting.table import SI_COLUMNS, stack
from zwidth.studies.outcome import ComputedStudy, Outcome, csv_text, spell_stiffest, summarize_stiffest
from zwidth.units.formatting import describe, format_sufficient, header, short, with_unit
from zwidth.units.quantities import PARAMETERS, PHYSICAL, POSITIVE, Range
from zwidth.units.unit_system import UnitSystem

# Names of the parameters for which the design study can solve.
FINDS = tuple(name for name in PHYSICAL if not PARAMETERS[name].whole and name not in ("stiffness", "virtual_damping"))
_TRIALS = 60  # typical number of evaluations of K_max per required stiffness; used to estimate `points`


def _read_range(raw: Any, info: ValidationInfo) -> tuple[float, ...]:
    """Validate a search range [low, high] with 0 < low < high; return it in the SI unit of the parameter to find."""
    name = info.data.get("find")
    if not isinstance(raw, list | tuple) or len(raw) != 2:
        raise problem(f"got {describe(raw)}", "a range is a list of its two ends", "write [low, high]")
    if name is None:
        raise problem(f"got {describe(raw)}", "its unit is that of the parameter in 'find'", "correct 'find' first")
    ends = read_entries(raw, replace(quantity_of(name), periods=False).read)
    if not 0 < ends[0] < ends[1]:
        raise problem(f"got {short(ends[0])} and {short(ends[1])}", "0 < low < high", "write the lower end first")
    return ends


Parameter = Annotated[str, GetPydanticSchema(lambda _, handler: handler.generate_schema(Literal[FINDS]))]
Ends = Annotated[
    tuple[float, float],
    BeforeValidator(_read_range),
    WithJsonSchema(
        {"type": "array", "items": {"anyOf": [{"type": "number"}, {"type": "string"}]}, "minItems": 2, "maxItems": 2}
    ),
]
Count = Annotated[int, Quantity(allowed=Range(2, 100_000), whole=True)]


@register
class DesignStudy(ComputedStudy):
    """The value of a parameter at which K_max reaches a required stiffness, and the effect of tolerances."""

    method = "The maximum stable stiffness, solved for the parameter to a relative error of 1e-11."
    from_scene = ("device", "stiffness")
    takes_parts = True

    kind: Literal["design"]

    device: PhysicalDevice
    """Device in SI units. A delay given in periods keeps its number of periods if the period changes."""

    find: Parameter
    """Parameter to solve for, such as damping, rate or velocity.cutoff."""

    stiffness: Annotated[Axis, axis_of("stiffness")]
    """Required stiffness K, one or several values in N/m or with a unit."""

    reserve: Annotated[float, Quantity(allowed=Range(1.0, 100.0))] = 1.0
    """Required ratio of the maximum stable stiffness to the required stiffness, 1 or more."""

    within: Ends | None = None
    """Search range [low, high]. Default: 1/30 to 30 times the current value, with delays of at most 1,000 periods."""

    num: Count = 61
    """Number of points of the curve in the figure."""

    tolerances: dict[str, Fraction] | None = None
    """Relative tolerances by parameter, such as {mass: 0.05}; the study then simulates random devices. Default: no
    tolerances."""

    distribution: Literal["uniform", "normal"] = "uniform"
    """Distribution within the tolerances: uniform over the tolerance range, or normal with the tolerance as standard
    deviation."""

    samples: Count | None = None
    """Number of random devices for each required stiffness. Default: 10000; 200 for a device with additional parts."""

    @classmethod
    def explain_missing(cls, name: str) -> tuple[str, str]:
        if name == "stiffness":
            return "a design needs the required stiffness", "add 'stiffness: [20 kN/m, 40 kN/m]'"
        if name == "find":
            return "a design solves for one parameter", "add 'find: damping', or another parameter"
        return super().explain_missing(name)

    def find_faults(self) -> Iterable[LocatedProblem]:
        yield from super().find_faults()
        if not (smallest := float(self.stiffness.values().min())) > 0:
            yield (
                ("stiffness",),
                problem(f"got {short(smallest)} {self.unit_system['N/m']}", "it must be greater than 0"),
            )
        parameters = self._list_parameters()
        if self.find not in parameters:
            allowed = f"this device has {quote_names(parameters)}"
            yield ("find",), problem(f"got {self.find!r}", allowed, "add the part to the scene, or write one of these")
        elif not parameters[self.find] > 0 and self.within is None:
            message = f"{self.find} is 0"
            yield ("within",), problem(message, "a search from 0 needs a range", "add 'within: [0.1, 100]'")
        yield from self._check_tolerances(parameters)

    def _check_tolerances(self, parameters: dict[str, float]) -> Iterable[LocatedProblem]:
        """Yield a problem for each tolerance that is too large, has no effect, or belongs to an unknown parameter."""
        bound = 1 / 3 if self.distribution == "normal" else 1.0
        for name, tolerance in (self.tolerances or {}).items():
            if name not in parameters or name == "rate":
                yield ("tolerances", name), problem("unknown parameter", f"this device has {quote_names(parameters)}")
            elif tolerance >= bound:
                yield ("tolerances", name), problem(f"got {short(tolerance)}", f"it must be less than {bound:.3g}")
            elif parameters[name] == 0 and name != self.find:
                fault = problem(f"{name} is 0, so a relative tolerance has no effect", "a value > 0", "remove it")
                yield ("tolerances", name), fault

    def _list_parameters(self) -> dict[str, float]:
        """Return the current values of the parameters for which the study can solve, by name, in SI units."""
        every = self.device.to_scene().parameters()
        parameters = {name: float(value) for name, value in every.items() if name in FINDS and isinstance(value, float)}
        return parameters | {"rate": 1.0 / parameters["period"]}

    @property
    def draws(self) -> int:
        """Number of random devices per required stiffness."""
        if self.tolerances is None:
            return 0
        return self.samples or self.device.to_scene().loop.draws

    @property
    def points(self) -> int:
        return self.stiffness.size * (_TRIALS + self.draws) + self.num

    @property
    def _name(self) -> str:
        """Name of the parameter ``find`` for messages: "inertia" in place of "mass" for a rotary device."""
        return "inertia" if self.find == "mass" and self.unit_system.rotary else self.find

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        nominal = self.device.to_scene()
        rows, answer, notes, ranges, units = [], [], [], [], self.unit_system
        unit = units[PARAMETERS[self.find].unit]
        for stiffness in self.stiffness.values().tolist():
            needed = nominal.required(self.find, self.reserve * stiffness, within=self.within)
            ranges.append(needed.range)
            rows.append(self._describe(nominal, stiffness, needed))
            notes += self._note(stiffness, needed)
            if needed.crossings and needed.status == Status.OK:
                value = format_sufficient(
                    needed.value, needed.sufficient_side, [one.value for one in needed.crossings], unit
                )
                answer.append(f"K_max = {with_unit(self.reserve * stiffness, units['N/m'])}: {self._name} of {value}")
        low, high = min(ends[0] for ends in ranges), max(ends[1] for ends in ranges)
        curve = self._trace(nominal, low, high)
        table = stack(rows)
        return Outcome(
            table=table,
            figures={"": partial(plotting.draw_requirement, curve, table)},
            documents={f"{self.name}_curve.csv": csv_text(curve, units)},
            answer=tuple(answer),
            notes=tuple(notes),
        )

    def _describe(self, nominal: Scene, stiffness: float, needed: RequiredValue) -> dict[str, Any]:
        """Return a row of the table: required value of the parameter, stiffest wall, and results of random devices.

        Args:
            nominal: device with the current value of the parameter.
            stiffness: required stiffness in N/m.
            needed: result of the search for the parameter.
        """
        unit = PARAMETERS[self.find].unit
        others = [c for c in needed.crossings if c.value != needed.value]
        row: dict[str, Any] = {
            SI_COLUMNS[0]: stiffness,
            "reserve": self.reserve,
            "parameter": self.find,
            header("present", unit): self._list_parameters()[self.find],
            header("value", unit): needed.value,
            "sufficient_side": needed.sufficient_side,
            header("other_crossings", unit): "; ".join(f"{c.value!r} {c.sufficient_side}" for c in others),
            header("range_low", unit): needed.range[0],
            header("range_high", unit): needed.range[1],
            "status": Status(needed.status).name,
            "stiffness_max_N_per_m": math.nan,
            SI_COLUMNS[1]: math.nan,
        }
        scene = None
        if needed.status == Status.OK:
            scene = nominal.replace(**{self.find: needed.value})
            top = scene.max_stiffness()
            row |= {"stiffness_max_N_per_m": float(top.stiffness), SI_COLUMNS[1]: float(top.virtual_damping)}
        return row | (self._tolerate(scene, stiffness, row[SI_COLUMNS[1]]) if self.tolerances is not None else {})

    def _tolerate(self, nominal: Scene | None, stiffness: float, virtual_damping: float) -> dict[str, float]:
        """Simulate random devices within the tolerances, and return the share of stable ones as columns.

        The columns are the share of devices that are stable with the required stiffness, its confidence interval, and
        the stiffness with which 99 % of the devices are stable.

        Args:
            nominal: device with the required value of the parameter; None if no such value exists.
            stiffness: required stiffness in N/m.
            virtual_damping: virtual damping at K_max of the nominal device, in N s/m.
        """
        names = ("stable_share", "stable_share_low", "stable_share_high", "borne_by_99_percent_N_per_m")
        if nominal is None:
            return dict.fromkeys(names, math.nan)
        scene = nominal.replace(wall=VirtualWall(stiffness, virtual_damping))
        tolerances = {
            name: Tolerance(tolerance, self.distribution) for name, tolerance in (self.tolerances or {}).items()
        }
        drawn = simulate_tolerances(scene, tolerances, samples=self.draws)
        return dict(zip(names, (drawn.stable, drawn.stable_low, drawn.stable_high, drawn.stiffness), strict=True))

    def _note(self, stiffness: float, needed: RequiredValue) -> Iterable[str]:
        """Yield a note if the search failed, if every value is sufficient, or if several values solve the equation.

        The equation is K_max = reserve * K, with K = ``stiffness``.
        """
        wanted = with_unit(self.reserve * stiffness, self.unit_system["N/m"])
        low, high = (with_unit(end, self.unit_system[PARAMETERS[self.find].unit]) for end in needed.range)
        if needed.status != Status.OK:
            yield f"{wanted}: {self._name} from {low} to {high}: {Status(needed.status).message}"
        elif needed.sufficient_side == "everywhere":
            yield f"{wanted}: any {self._name} from {low} to {high} is enough"
        elif len(needed.crossings) > 1:
            count = len(needed.crossings)
            yield f"{wanted}: K_max crosses this value at {count} values of {self._name}; the nearest is reported"

    def _trace(self, nominal: Scene, low: float, high: float) -> dict[str, np.ndarray]:
        """Compute K_max and its virtual damping over the parameter, from ``low`` to ``high`` in logarithmic steps.

        Returns:
            Columns with the values of the parameter, K_max and virtual damping. The latter two are NaN where the value
            is invalid or no wall is stable.
        """
        values = np.geomspace(low, high, self.num)
        walls = stiffest_walls(nominal, {self.find: values})
        columns = {header("value", PARAMETERS[self.find].unit): values, **dict(zip(SI_COLUMNS, walls, strict=False))}
        return {"parameter": np.full(values.size, self.find), **columns}


@register
class FiltersStudy(ComputedStudy):
    """K_max and the velocity noise for low-pass filters and windowed differences of the velocity."""

    method = "The maximum over all boundary curves of the stable set, for each filter, to about 1e-13."
    from_scene = ("device",)
    takes_parts = True

    kind: Literal["filters"]

    device: PhysicalDevice
    """Device in SI units; its velocity estimate is replaced by each filter."""

    damping: Annotated[Axis, axis_of("damping")] | None = None
    """Physical damping of the device, in N s/m or with a unit. Default: that of the device."""

    cutoff: Annotated[Axis, axis_of("velocity.cutoff")] | None = None
    """Cut-off frequencies of the low-pass, in Hz or with a unit. Default: no low-pass."""

    order: Annotated[int, quantity_of("velocity.order")] = 1
    """Order of the low-pass, 1 or 2."""

    samples: Annotated[Axis, axis_of("velocity.samples")] | None = None
    """Window lengths of the windowed difference, in sampling periods. Default: no windowed difference."""

    resolution: Annotated[float, Quantity("m", POSITIVE, counts=True)] | None = None
    """Encoder step, in m or with a unit; the noise that it causes in the velocity is then computed. Default: no
    noise."""

    noise_limit: Annotated[float, Quantity("m/s", POSITIVE)] | None = None
    """Largest standard deviation of the velocity noise, in m/s or with a unit; the filter with the largest stiffness
    within this limit is then marked. Default: no limit."""

    def find_faults(self) -> Iterable[LocatedProblem]:
        yield from super().find_faults()
        if self.cutoff is None and self.samples is None:
            yield (
                (),
                problem(
                    "cutoff and samples are missing", "filters need at least one of them", "add 'cutoff: [30, 100]'"
                ),
            )
        if self.noise_limit is not None and self.resolution is None:
            message = "got a noise limit without a resolution"
            yield ("noise_limit",), problem(message, "noise is computed from the encoder step", "add 'resolution'")
        if self.cutoff is not None:
            try:
                LowPass(cutoff=max(self.cutoff.entries), order=self.order).estimate(self.device.period)
            except InputError as error:
                path, message = parse_input_error(error)
                yield path[-1:], message

    @property
    def dampings(self) -> np.ndarray:
        """Values of the physical damping, in N s/m; that of the device if the field ``damping`` is absent."""
        return np.array([self.device.damping]) if self.damping is None else self.damping.values()

    @property
    def sizes(self) -> dict[str, int]:
        filters = 1 + sum(axis.size for axis in (self.cutoff, self.samples) if axis is not None)
        return {"damping": self.dampings.size, "filters": filters}

    def estimates(self) -> Iterator[tuple[dict[str, Any], Velocity]]:
        """Yield a pair for each velocity estimate: the columns that identify it, and the estimate.

        The backward difference is the first estimate, for comparison.
        """
        absent = {"cutoff_Hz": np.nan, "samples": np.nan}
        yield {"estimate": "backward_difference", **absent, "samples": 1.0}, BackwardDifference()
        for cutoff in () if self.cutoff is None else self.cutoff.values().tolist():
            yield {"estimate": "low_pass", **absent, "cutoff_Hz": cutoff}, LowPass(cutoff=cutoff, order=self.order)
        for samples in () if self.samples is None else self.samples.values().tolist():
            named = {"estimate": "windowed_difference", **absent, "samples": samples}
            yield named, WindowedDifference(int(samples))

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        rows, bare = [], self.device.to_scene()
        cases = [(damping, *estimate) for damping, estimate in product(self.dampings.tolist(), self.estimates())]
        walls = stiffest_walls(bare.replace(damping=damping, velocity=velocity) for damping, _, velocity in cases)
        for (damping, named, velocity), *numbers in zip(cases, *walls[:5], strict=True):
            top = StiffestWall(*numbers)
            row = {"damping_N_s_per_m": damping, **named, **summarize_stiffest(top)}
            if self.resolution is not None:
                noise = find_velocity_noise(velocity, self.device.period, self.resolution)
                row |= {"velocity_noise_m_per_s": noise, "force_noise_N": noise * abs(float(top.virtual_damping))}
            rows.append(row)
        drawn: dict[str, Any] = {"": partial(plotting.draw_filters, stack(rows))}
        if self.resolution is not None:
            limit = np.nan if self.noise_limit is None else self.noise_limit
            quiet = [row for row in rows if row["velocity_noise_m_per_s"] <= limit and np.isfinite(row[SI_COLUMNS[0]])]
            # Mark the row with the largest K_max for each damping. The rows need not be sorted for `groupby`, because
            # rows with equal damping are adjacent.
            groups = groupby(quiet, itemgetter("damping_N_s_per_m"))
            best = {id(max(group, key=itemgetter(SI_COLUMNS[0]))) for _, group in groups}
            rows = [{**row, "best": id(row) in best} for row in rows]
            drawn["_noise"] = partial(plotting.draw_filter_noise, stack(rows), limit)
        answer = tuple(_spell_best(row, self.unit_system) for row in rows if row.get("best"))
        return Outcome(table=stack(rows), figures=drawn, answer=answer)


def _spell_best(row: dict[str, Any], system: UnitSystem) -> str:
    """Return a line of text with the damping, the filter and the stiffest wall of a row of the table."""
    size = f"{row['samples']:g} samples"
    size = size if row["samples"] == row["samples"] else with_unit(row["cutoff_Hz"], "Hz")
    damping, estimate = with_unit(row["damping_N_s_per_m"], system["N s/m"]), row["estimate"].replace("_", " ")
    return f"b = {damping}: {estimate}, {size}: {spell_stiffest(row, system)}"
