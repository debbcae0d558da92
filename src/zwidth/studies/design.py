"""What to choose: the design study, which value of a parameter a stiffness needs, and the filters study."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import groupby, product
from operator import itemgetter
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, GetPydanticSchema, ValidationInfo, WithJsonSchema

from zwidth import figures
from zwidth.config.fields import LocatedProblem, listing, problem
from zwidth.config.parts import locate_refusal
from zwidth.config.scenes import AnyScene, PhysicalDevice
from zwidth.config.study import register
from zwidth.config.values import Axis, Fraction, Quantity, axis_of, quantity_of, read_entries
from zwidth.figures.table import SI_COLUMNS, stack
from zwidth.parts.noise import find_velocity_noise
from zwidth.parts.velocity import BackwardDifference, LowPass, Velocity, WindowedDifference
from zwidth.parts.wall import VirtualWall
from zwidth.scenes.scene import Scene
from zwidth.scenes.stiffest import RequiredValue
from zwidth.scenes.tolerances import Tolerance, simulate_tolerances
from zwidth.studies.outcome import ComputedStudy, Outcome, csv_text, spell_stiffest, summarize_stiffest, track
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe, header, short, spell_enough, with_unit
from zwidth.words.quantities import PARAMETERS, PHYSICAL, POSITIVE, Range
from zwidth.words.status import Status
from zwidth.words.unit_system import UnitSystem

FINDS = tuple(name for name in PHYSICAL if not PARAMETERS[name].whole and name not in ("stiffness", "virtual_damping"))
# Scenes that the search for one value asks about.
_TRIALS = 60


def _read_range(raw: Any, info: ValidationInfo) -> tuple[float, ...]:
    name = info.data.get("find")
    if not isinstance(raw, list | tuple) or len(raw) != 2:
        raise problem(f"got {describe(raw)}", "a range is a list of its two ends", "write [low, high]")
    if name is None:
        raise problem(f"got {describe(raw)}", "it has the unit of what is to be found", "mend 'find' first")
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
    """The value of one parameter at which the stiffest wall reaches a wanted stiffness, and what tolerances leave."""

    method = "The stiffest wall, solved for the parameter to 1e-11."
    from_scene = ("device", "stiffness")
    takes_parts = True

    kind: Literal["design"]

    device: PhysicalDevice
    """Device in SI units. A delay given in periods keeps its number of periods if the period changes."""

    find: Parameter
    """The parameter to choose, by its path, as damping, rate or velocity.cutoff."""

    stiffness: Annotated[Axis, axis_of("stiffness")]
    """Wanted stiffness K in N/m or with a unit, one or several."""

    reserve: Annotated[float, Quantity(allowed=Range(1.0, 100.0))] = 1.0
    """How many times the wanted stiffness the stiffest stable wall is to reach, 1 or more."""

    within: Ends | None = None
    """The two ends of the search range. Default: a thirtieth to 30 times the present value, and
    delays of no more than 1,000 periods."""

    num: Count = 61
    """Points of the curve in the figure."""

    tolerances: dict[str, Fraction] | None = None
    """Shares by which parameters of a device may differ from their values, by path: the share that bears the wall."""

    distribution: Literal["uniform", "normal"] = "uniform"
    """Of the tolerances: anywhere within the share, or with the share as standard deviation."""

    samples: Count | None = None
    """Number of random devices for each required stiffness. Default: 10000, or 200 for a device with parts."""

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        if name == "stiffness":
            return "a design begins with the stiffness that is wanted", "add 'stiffness: [20 kN/m, 40 kN/m]'"
        if name == "find":
            return "a design chooses one parameter, the others as they are", "add 'find: damping', or another"
        return super().missing(name)

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        if not (least := float(self.stiffness.values().min())) > 0:
            yield ("stiffness",), problem(f"got {short(least)} {self.unit_system['N/m']}", "it must be greater than 0")
        known = self._list_parameters()
        if self.find not in known:
            has = f"this device has {listing(known)}"
            yield ("find",), problem(f"got {self.find!r}", has, "add the part to the scene, or write one of these")
        elif not known[self.find] > 0 and self.within is None:
            what = f"{self.find} is 0 now"
            yield ("within",), problem(what, "a search from nothing needs a range", "add 'within: [0.1, 100]'")
        yield from self._check_tolerances(known)

    def _check_tolerances(self, known: dict[str, float]) -> Iterable[LocatedProblem]:
        most = 1 / 3 if self.distribution == "normal" else 1.0
        for name, share in (self.tolerances or {}).items():
            if name not in known or name == "rate":
                yield ("tolerances", name), problem("unknown parameter", f"this device has {listing(known)}")
            elif share >= most:
                yield ("tolerances", name), problem(f"got {short(share)}", f"it must be less than {most:.3g}")
            elif known[name] == 0 and name != self.find:
                what = problem(f"{name} is 0, and so is any share of it", "a value greater than 0", "leave it out")
                yield ("tolerances", name), what

    def _list_parameters(self) -> dict[str, float]:
        found = self.device.to_scene().parameters()
        known = {name: float(value) for name, value in found.items() if name in FINDS and isinstance(value, float)}
        return known | {"rate": 1.0 / known["period"]}

    @property
    def draws(self) -> int:
        if self.tolerances is None:
            return 0
        return self.samples or self.device.to_scene().loop.draws

    @property
    def points(self) -> int:
        return self.stiffness.size * (_TRIALS + self.draws) + self.num

    @property
    def _name(self) -> str:
        """Name of the parameter: "inertia" for the mass of a rotary device."""
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
                value = spell_enough(needed.value, needed.enough, [one.value for one in needed.crossings], unit)
                answer.append(f"K_max = {with_unit(self.reserve * stiffness, units['N/m'])}: {self._name} of {value}")
        low, high = min(ends[0] for ends in ranges), max(ends[1] for ends in ranges)
        curve = self._trace(nominal, low, high)
        table = stack(rows)
        return Outcome(
            table=table,
            figures={"": partial(figures.draw_requirement, curve, table)},
            documents={f"{self.name}_curve.csv": csv_text(curve, units)},
            answer=tuple(answer),
            notes=tuple(notes),
        )

    def _describe(self, nominal: Scene, stiffness: float, needed: RequiredValue) -> dict[str, Any]:
        """A row of the table: what is needed, the wall there, and what tolerances leave of it."""
        unit = PARAMETERS[self.find].unit
        others = [c for c in needed.crossings if c.value != needed.value]
        row: dict[str, Any] = {
            SI_COLUMNS[0]: stiffness,
            "reserve": self.reserve,
            "parameter": self.find,
            header("present", unit): self._list_parameters()[self.find],
            header("value", unit): needed.value,
            "enough": needed.enough,
            header("other_crossings", unit): "; ".join(f"{c.value!r} {c.enough}" for c in others),
            header("range_low", unit): needed.range[0],
            header("range_high", unit): needed.range[1],
            "status": Status(needed.status).name,
            "stiffness_max_N_per_m": math.nan,
            SI_COLUMNS[1]: math.nan,
        }
        found = None
        if needed.status == Status.OK:
            found = nominal.replace(**{self.find: needed.value})
            top = found.max_stiffness()
            row |= {"stiffness_max_N_per_m": float(top.stiffness), SI_COLUMNS[1]: float(top.virtual_damping)}
        return row | (self._tolerate(found, stiffness, row[SI_COLUMNS[1]]) if self.tolerances is not None else {})

    def _tolerate(self, found: Scene | None, stiffness: float, virtual_damping: float) -> dict[str, float]:
        """The share of devices on which the wanted stiffness is stable at the damping that suits the nominal one."""
        names = ("stable_share", "stable_share_low", "stable_share_high", "borne_by_99_percent_N_per_m")
        if found is None:
            return dict.fromkeys(names, math.nan)
        scene = found.replace(wall=VirtualWall(stiffness, virtual_damping))
        shares = {name: Tolerance(share, self.distribution) for name, share in (self.tolerances or {}).items()}
        drawn = simulate_tolerances(scene, shares, samples=self.draws)
        return dict(zip(names, (drawn.stable, drawn.stable_low, drawn.stable_high, drawn.stiffness), strict=True))

    def _note(self, stiffness: float, needed: RequiredValue) -> Iterable[str]:
        wanted = with_unit(self.reserve * stiffness, self.unit_system["N/m"])
        low, high = (with_unit(end, self.unit_system[PARAMETERS[self.find].unit]) for end in needed.range)
        if needed.status != Status.OK:
            yield f"{wanted}: {self._name} from {low} to {high}: {Status(needed.status).message}"
        elif needed.enough == "everywhere":
            yield f"{wanted}: any {self._name} from {low} to {high} is enough"
        elif len(needed.crossings) > 1:
            count = len(needed.crossings)
            yield f"{wanted}: K_max crosses this value at {count} values of {self._name}; the nearest is reported"

    def _trace(self, nominal: Scene, low: float, high: float) -> dict[str, np.ndarray]:
        """K_max over the parameter; NaN where a value is refused or no wall is stable."""
        rows = []
        for value in np.geomspace(low, high, self.num).tolist():
            wall = (math.nan, math.nan)
            with suppress(InputError):
                top = nominal.replace(**{self.find: value}).max_stiffness()
                wall = (float(top.stiffness), float(top.virtual_damping)) if top.status == Status.OK else wall
            named = {"parameter": self.find, header("value", PARAMETERS[self.find].unit): value}
            rows.append({**named, **dict(zip(SI_COLUMNS, wall, strict=True))})
        return stack(rows)


@register
class FiltersStudy(ComputedStudy):
    """The stiffest wall over the cut-off of a low-pass and over the length of a window, and its noise."""

    method = "The highest point of all edges of the stable set, one filter after the other, to about 1e-13."
    from_scene = ("device",)
    takes_parts = True

    kind: Literal["filters"]

    device: PhysicalDevice
    """Device in SI units. Its velocity estimate is replaced."""

    damping: Annotated[Axis, axis_of("damping")] | None = None
    """Physical damping of the device, in N s/m or with a unit. Default: that of the device."""

    cutoff: Annotated[Axis, axis_of("velocity.cutoff")] | None = None
    """Cut-offs of a low-pass, in Hz or with a unit."""

    order: Annotated[int, quantity_of("velocity.order")] = 1
    """Order of the low-pass, 1 or 2."""

    samples: Annotated[Axis, axis_of("velocity.samples")] | None = None
    """Lengths of a window, in periods."""

    resolution: Annotated[float, Quantity("m", POSITIVE, counts=True)] | None = None
    """One count of the position, in m or with a unit: the noise that it makes of the velocity is computed as well."""

    noise_limit: Annotated[float, Quantity("m/s", POSITIVE)] | None = None
    """Standard deviation that the noise of the velocity may have, in m/s or with a unit: the best filter is marked."""

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        if self.cutoff is None and self.samples is None:
            yield (), problem("cutoff and samples are missing", "filters have one of them", "add 'cutoff: [30, 100]'")
        if self.noise_limit is not None and self.resolution is None:
            what = "got a noise limit without a resolution"
            yield ("noise_limit",), problem(what, "noise comes from the counts of the position", "add 'resolution'")
        if self.cutoff is not None:
            try:
                LowPass(cutoff=max(self.cutoff.entries), order=self.order).estimate(self.device.period)
            except InputError as error:
                path, what = locate_refusal(error)
                yield path[-1:], what

    @property
    def dampings(self) -> np.ndarray:
        return np.array([self.device.damping]) if self.damping is None else self.damping.values()

    @property
    def sizes(self) -> dict[str, int]:
        filters = 1 + sum(axis.size for axis in (self.cutoff, self.samples) if axis is not None)
        return {"damping": self.dampings.size, "filters": filters}

    def estimates(self) -> Iterator[tuple[dict[str, Any], Velocity]]:
        """Every estimate with the columns that name it; the difference of two samples first."""
        absent = {"cutoff_Hz": np.nan, "samples": np.nan}
        yield {"estimate": "backward_difference", **absent, "samples": 1.0}, BackwardDifference()
        for cutoff in () if self.cutoff is None else self.cutoff.values().tolist():
            yield {"estimate": "low_pass", **absent, "cutoff_Hz": cutoff}, LowPass(cutoff=cutoff, order=self.order)
        for samples in () if self.samples is None else self.samples.values().tolist():
            named = {"estimate": "windowed_difference", **absent, "samples": samples}
            yield named, WindowedDifference(int(samples))

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        rows = []
        bare = self.device.to_scene()
        for damping, (named, velocity) in track(list(product(self.dampings.tolist(), self.estimates()))):
            top = bare.replace(damping=damping, velocity=velocity).max_stiffness()
            row = {"damping_N_s_per_m": damping, **named, **summarize_stiffest(top)}
            if self.resolution is not None:
                noise = find_velocity_noise(velocity, self.device.period, self.resolution)
                row |= {"velocity_noise_m_per_s": noise, "force_noise_N": noise * abs(float(top.virtual_damping))}
            rows.append(row)
        drawn: dict[str, Any] = {"": partial(figures.draw_filters, stack(rows))}
        if self.resolution is not None:
            limit = np.nan if self.noise_limit is None else self.noise_limit
            quiet = [row for row in rows if row["velocity_noise_m_per_s"] <= limit and np.isfinite(row[SI_COLUMNS[0]])]
            # The stiffest wall of each damping; rows stand together by it.
            own = groupby(quiet, itemgetter("damping_N_s_per_m"))
            best = {id(max(those, key=itemgetter(SI_COLUMNS[0]))) for _, those in own}
            rows = [{**row, "best": id(row) in best} for row in rows]
            drawn["_noise"] = partial(figures.draw_filter_noise, stack(rows), limit)
        answer = tuple(_spell_best(row, self.unit_system) for row in rows if row.get("best"))
        return Outcome(table=stack(rows), figures=drawn, answer=answer)


def _spell_best(row: dict[str, Any], system: UnitSystem) -> str:
    """Return the best filter for a damping in one line."""
    size = f"{row['samples']:g} samples"
    size = size if row["samples"] == row["samples"] else with_unit(row["cutoff_Hz"], "Hz")
    damping, estimate = with_unit(row["damping_N_s_per_m"], system["N s/m"]), row["estimate"].replace("_", " ")
    return f"b = {damping}: {estimate}, {size}: {spell_stiffest(row, system)}"
