"""Model of sweeps: outputs on a grid of parameters of any size, written to a store (`zwidth.sweep`).

The axes are normalized or in SI units ("physical"). Parameters of parts have dotted names such as
``velocity.cutoff``. Several parameters can vary together in a table of devices (`DeviceTable`). The scene supplies the
device and the timing unless the axes contain them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import MISSING, fields, replace
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, GetPydanticSchema, ValidationError, WrapValidator, create_model
from pydantic_core import PydanticCustomError

from zwidth.analysis.scene import Scene
from zwidth.config.device_table import TableField, read_table
from zwidth.config.devices import (
    DeviceForm,
    ResponseSection,
    find_second_device,
    find_second_period,
    replace_rigid,
)
from zwidth.config.fields import LocatedProblem, Strict, describe_parameter, problem, quote_names, require_entries
from zwidth.config.parts import build_parts, list_parts, make_parts_base, parse_input_error
from zwidth.config.scenes import AnyScene, NormalizedDevice, PhysicalScene
from zwidth.config.study import Study, register
from zwidth.config.values import Axis, Quantity, Rotary, axis_of, read_rotary
from zwidth.core.errors import InputError
from zwidth.model.device import Device
from zwidth.model.parameter_paths import PARTS
from zwidth.model.timing import Timing
from zwidth.model.velocity import BackwardDifference
from zwidth.stability.linear.passivity import find_unsupported_reason
from zwidth.units.formatting import describe
from zwidth.units.outputs import OUTPUTS, OUTPUTS_WITH_PARTS, STATUS_OF, Family
from zwidth.units.quantities import MAX_DELAY_PERIODS, NORMALIZED, OF_PARTS, PARAMETERS, PHYSICAL, WALL, Range
from zwidth.units.unit_system import SYSTEMS, UnitSystem

MAX_SWEEP_POINTS = 10**12  # points per sweep

# Remedies to report if an axis changes a part that the device does not have, by the name of the parameter or the part.
_EXAMPLES = {
    "velocity": "velocity: {kind: low_pass, cutoff: 100 Hz}",
    "velocity.samples": "velocity: {kind: windowed_difference, samples: 5}",
    "velocity.time_constant": "velocity: {kind: low_pass, time_constant: 2 ms}",
    "coupling": "coupling: {mass: 50 g, stiffness: 20 kN/m}",
    "modes": "modes: [{frequency: 120 Hz, damping_ratio: 0.03, mass: 2 kg}]",
}


def _make_axis_field(name: str) -> tuple[Any, Any]:
    """Return the type annotation and the pydantic field of the axis ``name``, or of the table "devices"."""
    if name == "devices":
        rows = "Parameters that vary together, one row per device: lists of equal length, or a CSV file."
        return TableField | None, Field(default=None, description=rows)  # pyright: ignore[reportOperatorIssue]
    axis: Any = Annotated[Axis, axis_of(name)]
    # Replace the note of the parameter, which may state another default, because the default of an axis is the value of
    # the scene.
    description = describe_parameter(
        replace(PARAMETERS[name], note="" if name in WALL else "default: that of the scene")
    )
    return axis | None, Field(default=None, description=f"{description}.")


# Keep the order of these fields, because existing stores contain their configuration in this order.
_OF_WALL = ("stiffness", "virtual_damping")
_OF_DEVICE = ("mass", "damping", "period", "rate", "delay")
_FIELDS: Any = {name: _make_axis_field(name) for name in (*OF_PARTS, "devices", *NORMALIZED, *_OF_WALL, *_OF_DEVICE)}
# Create the model by a call, because field names with dots are not possible in a class body.
_Axes: Any = create_model("_Axes", __base__=Strict, **_FIELDS)


class Axes(_Axes):
    """Parameters of a sweep and their values."""

    noun = "the axes of a sweep"

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        return _find_mixed_kinds([key for key in raw if key in PARAMETERS], "axes")

    def find_faults(self) -> Iterable[LocatedProblem]:
        """Yield a problem for each parameter given twice, and for mixing physical and normalized parameters."""
        columns = tuple(self.devices.columns) if self.devices else ()
        axes = [name for name in PARAMETERS if getattr(self, name) is not None]
        for name in axes:
            if name in columns:
                message = "given twice, as an axis and as a column of devices"
                yield (name,), problem(message, "each parameter once", "remove one")
        if columns and not any(name in columns for name in axes):
            yield from (
                (("devices",), fault) for _, fault in _find_mixed_kinds([*axes, *columns], "axes and devices together")
            )

    @property
    def given(self) -> tuple[str, ...]:
        """Names of the parameters that are axes or columns of the table."""
        columns = self.devices.columns if self.devices else {}
        return tuple(name for name in PARAMETERS if name in columns or getattr(self, name) is not None)

    @property
    def part_parameters(self) -> tuple[str, ...]:
        """Names of the given parameters that belong to parts, such as "velocity.cutoff"."""
        return tuple(name for name in self.given if name in OF_PARTS)

    @property
    def physical(self) -> bool:
        """True if the parameters are in SI units."""
        return any(name in PHYSICAL for name in self.given)

    @property
    def delay_in_periods(self) -> bool:
        """True if the delays are in sampling periods instead of seconds."""
        source = self.devices if self.delay is None else self.delay
        return source is not None and source.in_periods

    @property
    def sizes(self) -> dict[str, int]:
        """Number of values along each dimension of the grid, by its name; axes with one number are not dimensions."""
        sizes = {"device": self.devices.size} if self.devices else {}
        for name in PARAMETERS:
            axis = getattr(self, name)
            if axis is not None and axis.form != "number":
                sizes[name] = axis.size
        return sizes

    def find_range(self, name: str) -> tuple[float, float]:
        """Return the smallest and the largest value of the parameter ``name``, an axis or a column of the table."""
        source = self.devices.columns[name] if self.find_key(name) == "devices" else getattr(self, name).entries
        return min(source), max(source)

    def find_key(self, name: str) -> str:
        """Return the key that contains the values of a parameter: its name, or "devices" for a column of the table."""
        return "devices" if getattr(self, name) is None else name

    @property
    def most_periods(self) -> float:
        """Longest delay divided by the shortest sampling period."""
        if "d" in self.given:
            return self.find_range("d")[1]
        if "delay" not in self.given:
            return 0.0
        longest = self.find_range("delay")[1]
        if self.delay_in_periods:
            return longest
        return longest * (self.find_range("rate")[1] if "rate" in self.given else 1.0 / self.find_range("period")[0])


# Pairs of a normalized parameter and the corresponding physical one.
_PAIRS = (("alpha", "stiffness"), ("beta", "virtual_damping"), ("delta", "damping"), ("d", "delay"))
_COUNTERPARTS = dict(_PAIRS) | {physical: normalized for normalized, physical in _PAIRS}


def _find_mixed_kinds(keys: list[str], subject: str) -> Iterable[LocatedProblem]:
    """Yield a problem for each normalized key if the first key is in SI units, or vice versa.

    A period given together with a rate is also a problem. ``subject`` is the subject of the messages.
    """
    if not keys:
        return
    physical = keys[0] in PHYSICAL
    for key in keys:
        if (key in PHYSICAL) != physical:
            message = "physical key, after normalized ones" if not physical else "normalized key, after physical ones"
            allowed = f"{subject} are in SI units or normalized, never both"
            other = _COUNTERPARTS.get(key)
            remedy = f"write {other!r}" if other and other not in keys else "remove it"
            yield (key,), problem(message, allowed, remedy, on_key=True)
    yield from find_second_period(keys)


# Outputs by the letters of their symbols in figures and in printed results, such as "kmax".
_BY_SYMBOL = {
    letters: output.name
    for output in OUTPUTS.values()
    if (letters := re.sub(r"[\W_]", "", output.symbol).lower()) not in ("", *PARAMETERS)
}


def _name_symbol(value: Any) -> Any:
    """Return the name of an output unchanged; raise a problem with the name if the value is a symbol, such as K_max."""
    name = _BY_SYMBOL.get(value.replace("_", "").lower()) if isinstance(value, str) and value not in OUTPUTS else None
    if name is not None:
        raise problem(f"got {describe(value)}", "outputs are written by name, not by symbol", f"write {name}")
    return value


OutputName = Annotated[
    str,
    GetPydanticSchema(lambda _, handler: handler.generate_schema(Literal[tuple(OUTPUTS)])),
    BeforeValidator(_name_symbol),
]


_SCENE = "that of the scene"
_Parts: Any = make_parts_base(_SCENE, _SCENE, " Its keys can be axes of the sweep (see the table of axes).")


@register
class SweepStudy(_Parts, Study):
    """The outputs at all points of a grid of parameters, written to a store that xarray can open."""

    method = "Closed forms in float64; bit for bit independent of chunks and workers."
    from_scene = ()
    takes_parts = True

    kind: Literal["sweep"]

    axes: Axes
    """Parameters and their values; all combinations are computed."""

    device: DeviceForm | None = None
    """Linear system, measured response or arm with joints, replacing mass and damping. Default: the scene's device."""

    rotary: Rotary = Field(default_factory=read_rotary)
    """True for rotary devices. One quantity with a rotary unit makes all devices of a file rotary."""

    @property
    def unit_system(self) -> UnitSystem:
        """Unit system of the study's devices, determined by ``rotary``, which is also saved in the store."""
        return SYSTEMS[bool(self.rotary)]

    outputs: Annotated[tuple[OutputName, ...], WrapValidator(require_entries("outputs"))] = ("stable",)
    """Outputs to compute."""

    # The lower bound is 1e-12, because a radius is certified by counting the poles inside two circles, whose radii must
    # differ by more than the rounding errors.
    accuracy: Annotated[float, Quantity(allowed=Range(1e-12, 0.1))] = 1e-9
    """Certified relative error of the spectral radius.

    A larger value saves next to no time. Most radii are accurate to nearly all digits for every value. If the
    certification fails, mostly close to double poles, the status is NOT_CONVERGED; the value is then present if an
    error of at most 0.1 is certified, otherwise NaN.
    """

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        """Replace an arm that moves like one mass by the axes mass and damping, unless one of these axes is given."""
        axes = raw.get("axes")
        if isinstance(axes, dict) and not {"mass", "damping"} & _list_given(axes):
            changed = replace_rigid(raw)
            if changed is not raw:
                changed["axes"] = {**axes, **{name: changed.pop(name) for name in ("mass", "damping")}}
            raw = changed
        return super().prepare(raw)

    @classmethod
    def fill(cls, raw: dict[str, Any], scene: AnyScene) -> dict[str, Any]:
        """Return the mapping of a sweep, in which the scene supplies the device and timing that the axes lack."""
        raw = super().fill(raw, scene)
        axes = raw.get("axes")
        if not isinstance(axes, dict):
            return raw
        given = _list_given(axes)
        if given & set(PHYSICAL):
            # Take no values from the scene if the axes mix physical and normalized keys, because these values would
            # cause further errors.
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
        if not isinstance(axes, dict) or not scene.nonrigid_parts:
            return
        given = _list_given(axes)
        if given & set(NORMALIZED) and not given & set(PHYSICAL) and not {"delta", "d"} <= given:
            message = f"got normalized axes for a scene with {' and '.join(list_parts(scene))}"
            raise problem(message, "its parts are in SI units", "choose axes such as 'stiffness' and 'virtual_damping'")

    @property
    def with_parts(self) -> bool:
        """True if the devices have parts; each device is then computed as a separate `Scene`."""
        return bool(list_parts(self) or self.axes.part_parameters)

    def find_faults(self) -> Iterable[LocatedProblem]:
        """Yield problems of missing parameters, parameters without an effect, too long delays and too many points."""
        given, physical = self.axes.given, self.axes.physical
        if "rate" not in given and "period" not in given and physical:
            yield ("axes",), problem("period missing", "a physical sweep has period or rate", "add 'period: 1 ms'")
        for name, example in (("mass", "100 g"),) if physical else (("delta", "0.1"), ("d", "1")):
            if name not in given and self.device is None:
                allowed = "a sweep has mass and period or rate, or, normalized, delta and d"
                yield ("axes",), problem(f"{name} missing", allowed, f"add '{name}: {example}', or a scene")
        yield from self._check_outputs(given, physical)
        if "delay" in given and {"period", "rate"} & set(given) and not self.axes.most_periods <= MAX_DELAY_PERIODS:
            message = f"the longest delay is {self.axes.most_periods:.6g} of the shortest periods"
            path = ("axes", self.axes.find_key("delay"))
            yield path, problem(message, f"at most {MAX_DELAY_PERIODS:g} periods", "check the units")
        if self.with_parts:
            yield from self._check_parts(given, physical)
        if self.points > MAX_SWEEP_POINTS:
            message = f"{self.extent} is {self.points:.4g} points"
            yield (), problem(message, f"at most {MAX_SWEEP_POINTS:.4g} points per study", self.remedy_if_too_large)

    def _check_outputs(self, given: tuple[str, ...], physical: bool) -> Iterable[LocatedProblem]:
        """Yield problems of outputs that lack a required parameter, and of parameters that change no output.

        ``given`` are the names of the parameters that are axes or columns; ``physical`` is true for SI units.
        """
        stiffness = "stiffness" if physical else "alpha"
        walls = [name for name in self.outputs if OUTPUTS[name].family == "wall"]
        if walls and stiffness not in given:
            message = f"{stiffness} missing"
            yield (
                ("axes",),
                problem(message, f"{walls[0]} belongs to a wall", f"add {stiffness!r}, or remove the output"),
            )
        if not walls:
            for name in (name for name in given if name in WALL):
                allowed = f"{quote_names(self.outputs)} do not depend on the wall"
                message = f"got {name!r}, which changes no output"
                yield ("axes", self.axes.find_key(name)), problem(message, allowed, "remove it or add 'stable'")
        for index, name in enumerate(self.outputs):
            if OUTPUTS[name].physical_only and not physical:
                allowed = "it needs a device in SI units"
                yield ("outputs", index), problem(f"got {name!r}", allowed, "write alpha_max, or mass and period")

    def _check_parts(self, given: tuple[str, ...], physical: bool) -> Iterable[LocatedProblem]:
        """Yield problems of outputs that are not available for parts, of axes of absent parts, and of invalid values.

        Args:
            given: names of the parameters that are axes or columns.
            physical: True if the parameters are in SI units.
        """
        if not physical:
            for name in list_parts(self):
                yield (name,), problem(f"got {name!r} with normalized axes", "parts are in SI units", "remove it")
            return
        parts = build_parts(self)
        # Find the reason, if any, why the output "passive" is not available. It depends on the parts of the device; for
        # a linear system or a measured response, which has no parts, it depends on the attributes of this object.
        obstacle = find_unsupported_reason(**(vars(parts["device"]) if "device" in parts else parts))
        for index, name in enumerate(self.outputs):
            if name not in OUTPUTS_WITH_PARTS:
                allowed = f"available for devices with parts are {quote_names(OUTPUTS_WITH_PARTS)}"
                yield ("outputs", index), problem(f"got {name!r}", allowed, "choose from these")
            elif name == "passive" and obstacle:
                allowed = "available only if the command acts without lag on the body whose position is sensed"
                yield ("outputs", index), problem(f"got 'passive' {obstacle.partition(':')[0]}", allowed, "remove it")
        twice = [] if self.device is None else list(find_second_device(dict.fromkeys(given, True)))
        if twice:
            yield from ((("axes", *path), message) for path, message in twice)
        elif isinstance(self.device, ResponseSection) and (rates := {"period", "rate", "delay"} & self.sizes.keys()):
            allowed = "a response is valid only for the rate and delay at which it was measured"
            yield ("axes", min(rates)), problem("got several values", allowed, "give one value")
        elif (self.device is not None or "mass" in given) and {"period", "rate"} & set(given):
            yield from self._find_part_faults()

    def _find_part_faults(self) -> Iterable[LocatedProblem]:
        """Yield problems of axes that belong to absent parts, and of values that are invalid for the parts."""
        absent = [name for name in self.axes.part_parameters if not self._has_parameter(name)]
        for name in absent:
            part, _, key = name.partition(".")
            message = f"got the axis {name!r}, but no {part} with the key {key!r}"
            remedy = f"add {_EXAMPLES.get(name, _EXAMPLES.get(part, part))!r}"
            yield ("axes", self.axes.find_key(name)), problem(message, "an axis needs the part that it changes", remedy)
        # Check the parts at a few points of the grid only, because the grid may have too many points to check them all:
        # with all parameters at their smallest values, and with each parameter of a part in turn at its largest value.
        smallest = {name: self.axes.find_range(name)[0] for name in self.axes.given if name not in WALL}
        faults = {}
        for changed in (
            () if absent else ({}, *({name: self.axes.find_range(name)[1]} for name in self.axes.part_parameters))
        ):
            try:
                self.make_scene({**smallest, **changed}).check_parts()
            except InputError as error:
                faults[str(error)] = parse_input_error(error)
        for field, message in faults.values():
            name = ".".join(map(str, field))
            yield (("axes", self.axes.find_key(name)) if name in self.axes.given else ("axes",)), message

    def _has_parameter(self, name: str) -> bool:
        """Return whether the device has the part and the key of a dotted parameter, such as "velocity.cutoff"."""
        part, _, key = name.partition(".")
        section = getattr(self, part)
        if part == "modes":
            return int(key.partition(".")[0]) < len(section or ())
        kind = section.part if section is not None else PARTS.get(part, BackwardDifference)
        # Treat a part without a section as present if all its parameters have defaults.
        needed = section is None and any(item.default is MISSING for item in fields(kind))
        return not needed and key in kind.__dataclass_fields__

    def make_scene(self, values: dict[str, float]) -> Scene:
        """Return the scene at a point of the grid, from the values of the given parameters by name."""
        if not self.axes.physical:
            return NormalizedDevice(delta=values["delta"], d=values["d"]).to_scene()
        given = dict(values)
        period = 1.0 / given.pop("rate") if "rate" in given else given.pop("period")
        delay = given.pop("delay", 0.0) * (period if self.axes.delay_in_periods else 1.0)
        parts = build_parts(self)
        for part in (name for name in PARTS if name not in parts):
            values_of_part = {
                name.partition(".")[2]: value for name, value in given.items() if name.startswith(f"{part}.")
            }
            # Create a part that has no section from the values of its axes at this point of the grid.
            parts |= {part: PARTS[part](**values_of_part)} if values_of_part else {}
        device = Device(mass=given.pop("mass", 1.0), damping=given.pop("damping", 0.0), rotary=bool(self.rotary))
        return Scene(device, Timing(period=period, delay=delay)).replace(**parts, **given)

    @property
    def families(self) -> dict[Family, tuple[str, ...]]:
        """Names of the outputs by family: outputs with one value per wall, or with one per device and delay."""
        groups: dict[Family, tuple[str, ...]] = {
            family: tuple(name for name in self.outputs if OUTPUTS[name].family == family) for family in STATUS_OF
        }
        return {family: names for family, names in groups.items() if names}

    @property
    def sizes(self) -> dict[str, int]:
        return self.axes.sizes


def _list_given(axes: dict[str, Any]) -> set[str]:
    """Return the names of the parameters that are axes or columns of the table, from axes not validated yet."""
    raw, given = axes.get("devices"), set(axes)
    # Ignore errors of the table here, because the validation of the axes reports them.
    with suppress(PydanticCustomError, ValidationError):
        given |= set(raw if isinstance(raw, dict) and "csv" not in raw else read_table(raw).columns)
    return given & set(PARAMETERS)
