"""The sweep study: outputs over any grid of parameters, large or small, kept in a store of its own."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import MISSING, fields, replace
from typing import Annotated, Any, Literal

from pydantic import Field, GetPydanticSchema, ValidationError, WrapValidator, create_model
from pydantic_core import PydanticCustomError

from zwidth.config.device_table import TableField, read_table
from zwidth.config.devices import (
    DeviceForm,
    ResponseSection,
    Rotary,
    find_second_device,
    find_second_period,
    read_rotary,
)
from zwidth.config.fields import LocatedProblem, Strict, describe_parameter, listing, members, problem
from zwidth.config.parts import build_parts, list_parts, locate_refusal, make_parts_base
from zwidth.config.scenes import AnyScene, NormalizedDevice, PhysicalScene
from zwidth.config.study import Study, register
from zwidth.config.values import Axis, Quantity, axis_of
from zwidth.loops.linear.passivity import find_unsupported_reason
from zwidth.parts.device import Device
from zwidth.parts.paths import PARTS
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import BackwardDifference
from zwidth.scenes.scene import Scene
from zwidth.words.errors import InputError
from zwidth.words.quantities import (
    MAX_DELAY_PERIODS,
    NORMALIZED,
    OF_PARTS,
    OUTPUTS,
    OUTPUTS_WITH_PARTS,
    PARAMETERS,
    PHYSICAL,
    STATUS_OF,
    WALL,
    Family,
    Range,
)
from zwidth.words.unit_system import SYSTEMS, UnitSystem

MAX_SWEEP_POINTS = 10**12

_EXAMPLES = {
    "velocity": "velocity: {kind: low_pass, cutoff: 100 Hz}",
    "velocity.samples": "velocity: {kind: windowed_difference, samples: 5}",
    "velocity.time_constant": "velocity: {kind: low_pass, time_constant: 2 ms}",
    "coupling": "coupling: {mass: 50 g, stiffness: 20 kN/m}",
    "modes": "modes: [{frequency: 120 Hz, damping_ratio: 0.03, mass: 2 kg}]",
}


def _axis_field(name: str) -> tuple[Any, Any]:
    if name == "devices":
        rows = "Parameters that move together, one row a device: lists of equal length, or a CSV file."
        return TableField | None, Field(default=None, description=rows)  # pyright: ignore[reportOperatorIssue]
    axis: Any = Annotated[Axis, axis_of(name)]
    # Axes have the scene as default, not the default in the note of the parameter.
    words = describe_parameter(replace(PARAMETERS[name], note="" if name in WALL else "default: that of the scene"))
    return axis | None, Field(default=None, description=f"{words}.")


# In the order in which a store keeps what was asked of it.
_OF_WALL, _OF_DEVICE = ("stiffness", "virtual_damping"), ("mass", "damping", "period", "rate", "delay")
_FIELDS: Any = {name: _axis_field(name) for name in (*OF_PARTS, "devices", *NORMALIZED, *_OF_WALL, *_OF_DEVICE)}
# Some of the names have dots, which a class body cannot have.
_Axes: Any = create_model("_Axes", __base__=Strict, **_FIELDS)


class Axes(_Axes):
    """The parameters of a sweep and the values that each of them takes."""

    what = "the axes of a sweep"

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        return _mixed([key for key in raw if key in PARAMETERS], "axes")

    def limits(self) -> Iterable[LocatedProblem]:
        """A parameter that is both an axis and a column, and kinds that only the table's columns show."""
        columns = tuple(self.devices.columns) if self.devices else ()
        own = [name for name in PARAMETERS if getattr(self, name) is not None]
        for name in own:
            if name in columns:
                twice = "given twice, as an axis and as a column of devices"
                yield (name,), problem(twice, "each parameter once", "remove one")
        if columns and not any(name in columns for name in own):
            yield from ((("devices",), what) for _, what in _mixed([*own, *columns], "axes and devices together"))

    @property
    def given(self) -> tuple[str, ...]:
        columns = self.devices.columns if self.devices else {}
        return tuple(name for name in PARAMETERS if name in columns or getattr(self, name) is not None)

    @property
    def given_of_parts(self) -> tuple[str, ...]:
        """Those of them that belong to a velocity filter, a hand or another part."""
        return tuple(name for name in self.given if name in OF_PARTS)

    @property
    def physical(self) -> bool:
        return any(name in PHYSICAL for name in self.given)

    @property
    def delay_in_periods(self) -> bool:
        """Whether the delays count sampling periods."""
        source = self.devices if self.delay is None else self.delay
        return source is not None and source.in_periods

    @property
    def sizes(self) -> dict[str, int]:
        sizes = {"device": self.devices.size} if self.devices else {}
        for name in PARAMETERS:
            axis = getattr(self, name)
            if axis is not None and axis.form != "number":
                sizes[name] = axis.size
        return sizes

    def ends(self, name: str) -> tuple[float, float]:
        source = self.devices.columns[name] if self.place(name) == "devices" else getattr(self, name).entries
        return min(source), max(source)

    def place(self, name: str) -> str:
        return "devices" if getattr(self, name) is None else name

    @property
    def most_periods(self) -> float:
        """The longest delay in the shortest periods."""
        if "d" in self.given:
            return self.ends("d")[1]
        if "delay" not in self.given:
            return 0.0
        longest = self.ends("delay")[1]
        if self.delay_in_periods:
            return longest
        return longest * (self.ends("rate")[1] if "rate" in self.given else 1.0 / self.ends("period")[0])


_PAIRS = (("alpha", "stiffness"), ("beta", "virtual_damping"), ("delta", "damping"), ("d", "delay"))
_COUNTERPARTS = dict(_PAIRS) | {physical: normalized for normalized, physical in _PAIRS}


def _mixed(keys: list[str], where: str) -> Iterable[LocatedProblem]:
    if not keys:
        return
    physical = keys[0] in PHYSICAL
    for key in keys:
        if (key in PHYSICAL) != physical:
            kinds = "physical key, after normalized ones" if not physical else "normalized key, after physical ones"
            allowed = f"{where} are in SI units or normalized, never both"
            other = _COUNTERPARTS.get(key)
            remedy = f"write {other!r}" if other and other not in keys else "remove it"
            yield (key,), problem(kinds, allowed, remedy, on_key=True)
    yield from find_second_period(keys)


OutputName = Annotated[str, GetPydanticSchema(lambda _, handler: handler.generate_schema(Literal[tuple(OUTPUTS)]))]


_SCENE = "that of the scene"
_Parts: Any = make_parts_base(_SCENE, _SCENE, " Its keys may be axes, with its name and a dot.")


@register
class SweepStudy(_Parts, Study):
    """Outputs over a grid of parameters, in a store that can be resumed, verified and opened with xarray."""

    method = "Closed forms in float64; the same bits whatever the chunks and workers."
    from_scene = ()
    takes_parts = True

    kind: Literal["sweep"]

    axes: Axes
    """The parameters and their values; every combination is computed."""

    device: DeviceForm | None = None
    """A linear system or a measured response in place of mass and damping. Default: that of the scene."""

    rotary: Rotary = Field(default_factory=read_rotary)
    """True for rotary devices. One quantity with a rotary unit makes all devices of a file rotary."""

    @property
    def unit_system(self) -> UnitSystem:
        """The unit system of the study's devices, also for a study that is read from a store."""
        return SYSTEMS[bool(self.rotary)]

    outputs: Annotated[tuple[OutputName, ...], WrapValidator(members("outputs"))] = ("stable",)
    """What is computed."""

    # Closer in, the rounding of the two counts that prove a radius would meet.
    accuracy: Annotated[float, Quantity(allowed=Range(1e-12, 0.1))] = 1e-9
    """Relative error to prove of every spectral radius.

    On a map (alpha or the stiffness along one axis, the damping along another) a larger one is quicker: a Taylor series
    serves a cell of walls, and one count of the poles inside a circle proves it for all of them. Single walls have
    nearly all digits whatever is asked for. Where no proof is found, next to double poles above all, the status is
    NOT_CONVERGED: the value is there if a larger error of at most 0.1 is proved, and NaN otherwise.
    """

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        """Let the scene supply the device and the timing."""
        raw = super().fill(raw, scene)
        axes = raw.get("axes")
        if not isinstance(axes, dict):
            return raw
        given = _list_given(axes)
        if given & set(PHYSICAL):
            # Add nothing from the scene to mixed keys, because it would cause further errors in addition to the mixing.
            if not isinstance(scene, PhysicalScene) or given & set(NORMALIZED):
                return raw
            supplied: dict[str, Any] = {"delay": str(scene.delay)}
            supplied |= {} if given & {"period", "rate"} else {"period": scene.period}
            raw = {**list_parts(scene), **raw}
            supplied |= {} if "device" in raw else {"mass": scene.mass, "damping": scene.damping}
        else:
            supplied = {"delta": scene.delta, "d": scene.d}
        return {**raw, "axes": {**axes, **{key: value for key, value in supplied.items() if key not in given}}}

    @classmethod
    def check_parts(cls, raw: dict[str, Any], scene: AnyScene) -> None:
        axes = raw.get("axes")
        if not isinstance(axes, dict) or not scene.parts_beyond:
            return
        given = _list_given(axes)
        if not given & set(PHYSICAL) and not {"delta", "d"} <= given:
            what = f"got normalized axes for a scene with {' and '.join(list_parts(scene))}"
            raise problem(what, "its parts are in SI units", "choose axes such as 'stiffness' and 'virtual_damping'")

    @property
    def with_parts(self) -> bool:
        """Whether its devices have parts, so that every one of them is a scene of its own."""
        return bool(list_parts(self) or self.axes.given_of_parts)

    def limits(self) -> Iterable[LocatedProblem]:
        """Parameters that are missing or move nothing, delays that are too long, and too many points."""
        given, physical = self.axes.given, self.axes.physical
        if "rate" not in given and "period" not in given and physical:
            yield ("axes",), problem("period missing", "a physical sweep has period or rate", "add 'period: 1 ms'")
        for name, example in (("mass", "100 g"),) if physical else (("delta", "0.1"), ("d", "1")):
            if name not in given and self.device is None:
                kinds = "a sweep has mass and period or rate, or, normalized, delta and d"
                yield ("axes",), problem(f"{name} missing", kinds, f"add '{name}: {example}', or a scene")
        yield from self._outputs_limits(given, physical)
        if "delay" in given and {"period", "rate"} & set(given) and not self.axes.most_periods <= MAX_DELAY_PERIODS:
            what = f"the longest delay is {self.axes.most_periods:.6g} of the shortest periods"
            place = ("axes", self.axes.place("delay"))
            yield place, problem(what, f"at most {MAX_DELAY_PERIODS:g} periods", "check the units")
        if self.with_parts:
            yield from self._part_limits(given, physical)
        if self.points > MAX_SWEEP_POINTS:
            what = f"{self.extent} is {self.points:.4g} points"
            yield (), problem(what, f"at most {MAX_SWEEP_POINTS:.4g} points a study", self.remedy_if_too_large)

    def _outputs_limits(self, given: tuple[str, ...], physical: bool) -> Iterable[LocatedProblem]:
        stiffness = "stiffness" if physical else "alpha"
        walls = [name for name in self.outputs if OUTPUTS[name].family == "wall"]
        if walls and stiffness not in given:
            what = f"{stiffness} missing"
            yield ("axes",), problem(what, f"{walls[0]} belongs to a wall", f"add {stiffness!r}, or remove the output")
        if not walls:
            for name in (name for name in given if name in WALL):
                allowed = f"{listing(self.outputs)} do not depend on the wall"
                what = f"got {name!r}, which moves no output"
                yield ("axes", self.axes.place(name)), problem(what, allowed, "remove it or add 'stable'")
        for index, name in enumerate(self.outputs):
            if OUTPUTS[name].physical_only and not physical:
                allowed = "it needs a device in SI units"
                yield ("outputs", index), problem(f"got {name!r}", allowed, "write alpha_max, or mass and period")

    def _part_limits(self, given: tuple[str, ...], physical: bool) -> Iterable[LocatedProblem]:
        """Outputs that nobody knows for parts, axes of parts that are not there, and values that parts refuse."""
        if not physical:
            for name in list_parts(self):
                yield (name,), problem(f"got {name!r} beside normalized axes", "parts are in SI units", "remove it")
            return
        parts = build_parts(self)
        # A device that is given as a whole has what such a condition asks for inside.
        obstacle = find_unsupported_reason(**(vars(parts["device"]) if "device" in parts else parts))
        for index, name in enumerate(self.outputs):
            if name not in OUTPUTS_WITH_PARTS:
                allowed = f"with a velocity filter, a hand or another part there are {listing(OUTPUTS_WITH_PARTS)}"
                yield ("outputs", index), problem(f"got {name!r}", allowed, "choose from these")
            elif name == "passive" and obstacle:
                allowed = "it is known where a command acts at once, on the body whose position is sensed"
                yield ("outputs", index), problem(f"got 'passive' {obstacle.partition(':')[0]}", allowed, "remove it")
        twice = [] if self.device is None else list(find_second_device(dict.fromkeys(given, True)))
        if twice:
            yield from ((("axes", *path), what) for path, what in twice)
        elif isinstance(self.device, ResponseSection) and (rates := {"period", "rate", "delay"} & self.sizes.keys()):
            allowed = "a response holds the rate and the delay that it was measured with"
            yield ("axes", min(rates)), problem("got several values", allowed, "measure again at others")
        elif (self.device is not None or "mass" in given) and {"period", "rate"} & set(given):
            yield from self._find_part_faults()

    def _find_part_faults(self) -> Iterable[LocatedProblem]:
        """Axes of parts that are not there, and values that the parts refuse."""
        absent = [name for name in self.axes.given_of_parts if not self._has_parameter(name)]
        for name in absent:
            part, _, key = name.partition(".")
            what = f"got the axis {name!r}, but no {part} with the key {key!r}"
            remedy = f"add {_EXAMPLES.get(name, _EXAMPLES.get(part, part))!r}"
            yield ("axes", self.axes.place(name)), problem(what, "an axis changes a part that is there", remedy)
        # Every parameter at its least value, and those of parts at their ends.
        least = {name: self.axes.ends(name)[0] for name in self.axes.given if name not in WALL}
        found = {}
        for changed in () if absent else ({}, *({name: self.axes.ends(name)[1]} for name in self.axes.given_of_parts)):
            try:
                self.make_scene({**least, **changed}).check_parts()
            except InputError as error:
                found[str(error)] = locate_refusal(error)
        for field, what in found.values():
            name = ".".join(map(str, field))
            yield (("axes", self.axes.place(name)) if name in self.axes.given else ("axes",)), what

    def _has_parameter(self, name: str) -> bool:
        """Whether the part that an axis belongs to is there, and has such a key."""
        part, _, key = name.partition(".")
        section = getattr(self, part)
        if part == "modes":
            return int(key.partition(".")[0]) < len(section or ())
        kind = section.part if section is not None else PARTS.get(part, BackwardDifference)
        # A part that has no section is there where it needs no numbers.
        needed = section is None and any(item.default is MISSING for item in fields(kind))
        return not needed and key in kind.__dataclass_fields__

    def make_scene(self, values: dict[str, float]) -> Scene:
        """The scene at a point of the grid, from the parameters that the axes give."""
        if not self.axes.physical:
            return NormalizedDevice(delta=values["delta"], d=values["d"]).to_scene()
        given = dict(values)
        period = 1.0 / given.pop("rate") if "rate" in given else given.pop("period")
        delay = given.pop("delay", 0.0) * (period if self.axes.delay_in_periods else 1.0)
        parts = build_parts(self)
        for part in (name for name in PARTS if name not in parts):
            own = {name.partition(".")[2]: value for name, value in given.items() if name.startswith(f"{part}.")}
            # Of its axes alone.
            parts |= {part: PARTS[part](**own)} if own else {}
        device = Device(mass=given.pop("mass", 1.0), damping=given.pop("damping", 0.0), rotary=bool(self.rotary))
        return Scene(device, Timing(period=period, delay=delay)).replace(**parts, **given)

    @property
    def families(self) -> dict[Family, tuple[str, ...]]:
        groups: dict[Family, tuple[str, ...]] = {
            family: tuple(name for name in self.outputs if OUTPUTS[name].family == family) for family in STATUS_OF
        }
        return {family: names for family, names in groups.items() if names}

    @property
    def sizes(self) -> dict[str, int]:
        return self.axes.sizes


def _list_given(axes: dict[str, Any]) -> set[str]:
    """The parameters of axes and of a table among them, as far as it can be read."""
    raw, given = axes.get("devices"), set(axes)
    # The table's faults are reported where it is read itself.
    with suppress(PydanticCustomError, ValidationError):
        given |= set(raw if isinstance(raw, dict) and "csv" not in raw else read_table(raw).columns)
    return given & set(PARAMETERS)
