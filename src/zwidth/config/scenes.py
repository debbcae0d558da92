"""Scenes, devices and walls of a configuration, each either in SI units or normalized."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated, Any, ClassVar, TypeAlias

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field, PlainValidator, ValidationInfo, WithJsonSchema, WrapValidator

from zwidth.arrays.xp import within
from zwidth.config.devices import DeviceForm
from zwidth.config.faults import LocatedProblem, listing, problem, validation_error
from zwidth.config.fields import Strict
from zwidth.config.parts import (
    PART_NAMES,
    SimulatedVelocityField,
    build_parts,
    list_parts,
    locate_refusal,
    make_parts_base,
)
from zwidth.config.values import Delay, NonNegative, Number, describe_entry, quantity_of
from zwidth.parts.checks import Span
from zwidth.parts.device import Device
from zwidth.parts.devices import DEVICES
from zwidth.parts.paths import PARTS, replace_parameters
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import FOAW
from zwidth.parts.wall import VirtualWall
from zwidth.scenes.scene import Scene
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe, short
from zwidth.words.quantities import LARGEST_DAMPING, MAX_DELAY_PERIODS, WALL_RANGE
from zwidth.words.rotation import is_rotary
from zwidth.words.types import DelayModel

_PHYSICAL = frozenset(
    {"device", "rotary", "mass", "damping", "period", "rate", "delay", "stiffness", "virtual_damping", *PART_NAMES}
)
_NORMALIZED = frozenset({"delta", "d", "alpha", "beta"})


class _OneKind(Strict):
    """Base of what is either physical or normalized: the other kind's keys get a message of their own."""

    foreign: ClassVar[frozenset[str]]

    @classmethod
    def unknown(cls, name: str) -> tuple[str, str, str]:
        if name not in cls.foreign:
            return super().unknown(name)
        if name in PART_NAMES:
            allowed = f"{cls.what} that is normalized has no parts: their keys are in SI units"
            remedy = "write mass, damping and period in place of delta and d"
            return f"got {name!r} after normalized keys", allowed, remedy
        kind, other = ("physical", "normalized") if name in _NORMALIZED else ("normalized", "physical")
        return (
            f"{other} key, after {kind} ones",
            f"{cls.what} is described in SI units or normalized, never both",
            f"remove it, or write all keys {'normalized' if other == 'normalized' else 'in SI units'}",
        )


def _period(value: Any, info: ValidationInfo) -> float:
    """The period itself, or one over the rate."""
    if value is not None:
        return quantity_of("period").read(value)
    # A rate that failed its own check is absent from the data; that fault is enough.
    rate = info.data.get("rate", 1.0)
    if rate is None:
        raise problem("missing", "the sampling period or its rate is needed", "add 'period: 1 ms' or 'rate: 1 kHz'")
    return 1.0 / rate


def _mass(value: Any, info: ValidationInfo) -> float | None:
    """The mass itself; none of a device that is given as a whole."""
    if value is not None:
        return quantity_of("mass").read(value)
    if info.data.get("device", ...) is None:
        allowed = "a device has mass and period or rate, or, normalized, delta"
        raise problem("missing", allowed, "add 'mass: 0.1 kg'")
    return None


def find_second_period(keys: Iterable[str]) -> Iterable[LocatedProblem]:
    """A problem where the sampling period is given twice."""
    for second in [key for key in keys if key in ("period", "rate")][1:]:
        allowed = "the sampling period and its rate say the same"
        yield (second,), problem("period and rate are both given", allowed, "remove one", on_key=True)


def find_second_device(keys: dict[str, Any]) -> Iterable[LocatedProblem]:
    """Problems of what a device that is given as a whole holds already."""
    for key in keys:
        if key.partition(".")[0] in ("mass", "damping", *PARTS, "modes") and keys[key]:
            allowed = "the linear system or response of the device holds it"
            yield (key,), problem(f"got {key!r} beside a device given as a whole", allowed, "remove one", on_key=True)


def tell_rotary(value: Any = None) -> bool | None:
    """What a section keeps: true of a file of rotary devices; nothing of linear ones."""
    if value is not None and not isinstance(value, bool):
        raise problem(f"got {describe(value)}", "it must be true or false", "remove it: units tell the kind")
    if value is False and is_rotary():
        raise problem("got false", "other devices of the file are rotary, or have units of rotation", "write two files")
    return value or is_rotary() or None


Rotary = Annotated[bool | None, PlainValidator(tell_rotary, json_schema_input_type=bool)]
_LISTED = "zwidth devices lists them"


def _add_device(schema: dict[str, Any]) -> None:
    """What editors are told of the texts that name a device, in the place of mass and damping."""
    forms = schema["properties"]["device"]["anyOf"]
    forms[:0] = [{"enum": [device.name for device in DEVICES]}, {"type": "string"}]


class _Mass(_OneKind):
    """A mass with damping, sampled, in SI units."""

    # The name of a published device is replaced by its numbers.
    model_config = ConfigDict(json_schema_extra=_add_device)

    foreign: ClassVar[frozenset[str]] = _NORMALIZED

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        """Put the numbers of a published device in the place of its name; those that are written count."""
        name = raw.get("device")
        known = {device.name: device for device in DEVICES}.get(name) if isinstance(name, str) else None
        if known is None:
            return super().prepare(raw)
        if known.rotary != is_rotary():
            allowed = "this device is linear, and others of the file are rotary"
            what = problem(f"got {describe(name)}", allowed, "write two files")
            raise validation_error(cls.__name__, [(("device",), what)])
        found = {key: number.value for key in ("mass", "damping") if (number := getattr(known, key)) is not None}
        return super().prepare({**found, **{key: value for key, value in raw.items() if key != "device"}})

    device: DeviceForm | None = None
    """Name of a published device, whose mass and damping are taken where none are written; or a device that is no mass
    with damping: a linear system ('1 / 0.1 10 0' in s, or a mapping), or a measured response (FILE.csv)."""

    mass: Annotated[float | None, BeforeValidator(_mass), WithJsonSchema(quantity_of("mass").schema)] = Field(
        default=None, validate_default=True
    )
    """Moving mass m of the device in kg, > 0; of a rotary one its inertia in kg m^2."""

    damping: Annotated[float, quantity_of("damping")] = 0.0
    """Physical damping b of the device in N s/m, >= 0; of a rotary one in N m s/rad."""

    rotary: Rotary = Field(default_factory=tell_rotary)
    """Whether the device turns, as all of a file do where one quantity has a unit of rotation."""

    rate: Annotated[float, quantity_of("rate")] | None = Field(default=None, exclude=True)
    """Sampling rate 1/T in Hz; give it or the period."""

    period: Annotated[float, BeforeValidator(_period), WithJsonSchema(describe_entry("s"))] = Field(
        default=None, validate_default=True
    )
    """Sampling period T in s; give it or the rate. Always set once the file is loaded."""

    delay: Delay = Span(0.0, "s")
    """Delay t_d from the sample to the moment its force acts, in s or in periods, >= 0."""

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        yield from find_second_period(raw)
        if raw.get("device") is not None:
            yield from find_second_device(raw)


_Parts: Any = make_parts_base("the difference of two samples", "none")


class _PhysicalPlant(_Parts, _Mass):
    """The same with the parts that it may have beside."""

    def limits(self) -> Iterable[LocatedProblem]:
        delay = self.delay.value / (self.period if self.delay.unit == "s" else 1.0)
        if not delay <= MAX_DELAY_PERIODS:
            allowed = f"at most {MAX_DELAY_PERIODS:g} periods"
            yield ("delay",), problem(f"got {self.delay}, which is {short(delay)} periods", allowed, "check the units")
            return
        if self._is_double:
            # Its keys have told.
            return
        try:
            scene = self.to_scene()
            if not is_adaptive(self):
                scene.check_parts()
        except InputError as error:
            path, what = locate_refusal(error)
            yield path if path[0] in type(self).model_fields else ("device", *path), what
            return
        if self.device is not None:
            return
        with np.errstate(all="ignore"):
            numbers = scene.normalized
        for field, name in (("damping", "delta"), ("stiffness", "alpha"), ("virtual_damping", "beta")):
            least, most = (0.0, LARGEST_DAMPING) if name == "delta" else WALL_RANGE
            value = float(getattr(numbers, name))
            if not within(np.float64(value), (least, most)):
                what = f"got {short(getattr(self, field))}, whose normalized value is {name} = {short(value)}"
                bounds = f"0 or {least:g} to {most:g}" if least else f"at most {most:g}"
                yield (field,), problem(what, f"{name} must be {bounds}", "check the units and the mass")

    @property
    def _is_double(self) -> bool:
        """Whether parts stand beside a device that is given as a whole."""
        return self.device is not None and any(getattr(self, name) for name in (*PARTS, "modes"))

    @property
    def parts_beyond(self) -> tuple[str, ...]:
        """What makes it more than a rigid mass with the difference of two samples, which every kind of study takes."""
        return self.to_scene().parts_beyond

    @property
    def delta(self) -> float:
        """Normalized damping of the device, with that of a hand held rigidly."""
        return float(self.to_scene().delta)

    @property
    def own_share(self) -> float:
        """The part of delta that is the device's own, which alone makes walls passive for any hand."""
        scene = self.to_scene()
        return float(scene.own_delta / scene.delta) if scene.delta else 1.0

    @property
    def d(self) -> float:
        """Delay in periods, exact where it is written in periods."""
        return self.delay.periods(self.period)

    def to_scene(self) -> Scene:
        """The device and its timing in SI units."""
        timing = Timing(period=self.period, delay=self.delay.seconds(self.period))
        # A device that is given as a whole is one of the parts, and takes the place of this one.
        device = Device(mass=self.mass or 1.0, damping=self.damping, rotary=bool(self.rotary))
        return replace_parameters(Scene(device, timing), build_parts(self))


class _NormalizedPlant(_OneKind):
    """The same as two dimensionless numbers."""

    foreign: ClassVar[frozenset[str]] = _PHYSICAL

    delta: NonNegative
    """Normalized damping b T/m of the device, >= 0."""

    d: Annotated[float, quantity_of("d")] = 0.0
    """Delay in periods, whole or not, >= 0."""


class PhysicalDevice(_PhysicalPlant):
    """A device in SI units."""

    what: ClassVar[str] = "a device"

    label: str | None = None
    """Name of the device in legends."""


class SimulatedDevice(PhysicalDevice):
    """A device in SI units whose velocity estimate need not be linear."""

    velocity: SimulatedVelocityField | None = None
    """How the velocity is estimated; the difference of two samples where left out."""


class LabeledDevice(_PhysicalPlant):
    """A device in SI units among others that a figure names."""

    # The scene may supply all the rest.
    model_config = ConfigDict(json_schema_extra={"required": ["label"]})

    what: ClassVar[str] = "a device"

    label: str
    """Name of the device in the legend, each one its own."""


class NormalizedDevice(_NormalizedPlant):
    """A normalized device."""

    what: ClassVar[str] = "a device"

    label: str | None = None
    """Name of the device in legends."""


class PhysicalScene(_PhysicalPlant):
    """The file's device, timing and wall in SI units."""

    what: ClassVar[str] = "a scene"

    stiffness: Annotated[float, quantity_of("stiffness")] | None = None
    """Stiffness K of the wall in N/m."""

    virtual_damping: Annotated[float, quantity_of("virtual_damping")] | None = None
    """Damping B of the wall in N s/m."""

    velocity: SimulatedVelocityField | None = None
    """How the velocity is estimated; the difference of two samples where left out."""

    delay_model: DelayModel = "held"
    """How a delay that is not whole is modeled."""

    def to_scene(self) -> Scene:
        """Device, timing and wall; a wall that is not given has no stiffness and no damping."""
        bare = super().to_scene()
        wall = VirtualWall(stiffness=self.stiffness or 0.0, virtual_damping=self.virtual_damping or 0.0)
        timing = Timing(period=bare.timing.period, delay=bare.timing.delay, delay_model=self.delay_model)
        return replace(bare, timing=timing, wall=wall)

    @property
    def bare(self) -> PhysicalDevice:
        """The scene without its wall, for studies that need a linear velocity estimate."""
        return PhysicalDevice(**self._device_keys)

    @property
    def simulated_device(self) -> SimulatedDevice:
        """The scene without its wall."""
        return SimulatedDevice(**self._device_keys)

    @property
    def _device_keys(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in ("mass", "damping", "period", "delay", "rotary")}
        return {name: value for name, value in own.items() if value is not None} | list_parts(self)

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        if not self._is_double and self.delay_model not in self.to_scene().loop.delay_models:
            allowed = "velocity filters, hands and other parts are computed in the model 'held'"
            yield ("delay_model",), problem(f"got {self.delay_model!r}", allowed, "write 'delay_model: held'")

    @property
    def wall(self) -> PhysicalWall | None:
        """The scene's wall, where one is given."""
        if self.stiffness is None and self.virtual_damping is None:
            return None
        return PhysicalWall(stiffness=self.stiffness or 0.0, virtual_damping=self.virtual_damping or 0.0)


class NormalizedScene(_NormalizedPlant):
    """The file's device, timing and wall, normalized."""

    what: ClassVar[str] = "a scene"

    alpha: Number | None = None
    """Normalized stiffness K T^2/m of the wall."""

    beta: Number | None = None
    """Normalized damping B T/m of the wall."""

    delay_model: DelayModel = "held"
    """How a delay that is not whole is modeled."""

    @property
    def bare(self) -> NormalizedDevice:
        """The scene without its wall."""
        return NormalizedDevice(delta=self.delta, d=self.d)

    @property
    def wall(self) -> NormalizedWall | None:
        """The scene's wall, where one is given."""
        if self.alpha is None and self.beta is None:
            return None
        return NormalizedWall(alpha=self.alpha or 0.0, beta=self.beta or 0.0)


class PhysicalWall(_OneKind):
    """A wall in SI units."""

    what: ClassVar[str] = "a wall"
    foreign: ClassVar[frozenset[str]] = _NORMALIZED

    stiffness: Annotated[float, quantity_of("stiffness")]
    """Stiffness K in N/m."""

    virtual_damping: Annotated[float, quantity_of("virtual_damping")] = 0.0
    """Damping B in N s/m."""


class NormalizedWall(_OneKind):
    """A normalized wall."""

    what: ClassVar[str] = "a wall"
    foreign: ClassVar[frozenset[str]] = _PHYSICAL

    alpha: Number
    """Normalized stiffness K T^2/m."""

    beta: Number = 0.0
    """Normalized damping B T/m."""


def is_adaptive(owner: Any) -> bool:
    """Whether the velocity estimate of a scene or a device has no linear form."""
    velocity = getattr(owner, "velocity", None)
    return velocity is not None and velocity.part is FOAW


def is_with_parts(owner: AnyScene | AnyDevice) -> bool:
    """Whether a scene or a device is more than a rigid mass with the difference of two samples."""
    return isinstance(owner, PhysicalScene | PhysicalDevice) and bool(owner.parts_beyond)


def normalized_wall(device: AnyDevice, wall: AnyWall) -> tuple[float, float]:
    """``alpha`` and ``beta`` of a wall on a device; a wall in SI units needs a device in SI units."""
    if isinstance(wall, NormalizedWall):
        return wall.alpha, wall.beta
    if isinstance(device, NormalizedDevice):
        raise InputError("wall: got one in SI units for a normalized device; give alpha and beta")
    alpha, beta = device.to_scene().normalize_walls(wall.stiffness, wall.virtual_damping)
    return float(alpha), float(beta)


def is_normalized(raw: dict[str, Any]) -> bool:
    """Whether the first key that tells the kinds apart is a normalized one."""
    telling = [key for key in raw if key in _PHYSICAL | _NORMALIZED]
    return bool(telling) and telling[0] in _NORMALIZED


def _as_either(raw: Any, physical: type[Any], normalized: type[Any]) -> Any:
    """Read a mapping as the kind that its first telling key belongs to."""
    if isinstance(raw, physical | normalized):
        return raw
    if not isinstance(raw, dict):
        keys = f"{listing(physical.model_fields)} or, normalized, {listing(normalized.model_fields)}"
        allowed = f"{physical.what} is a mapping with the keys {keys}"
        raise problem(f"got {describe(raw)}", allowed, "write 'key: value' lines")
    return (normalized if is_normalized(raw) else physical).model_validate(raw)


AnyScene: TypeAlias = PhysicalScene | NormalizedScene
AnyDevice: TypeAlias = PhysicalDevice | NormalizedDevice
AnyWall: TypeAlias = PhysicalWall | NormalizedWall


def read_scene(raw: Any) -> AnyScene:
    return _as_either(raw, PhysicalScene, NormalizedScene)


# The handler, which would try one kind after the other and report the faults of both, is never called.
SceneField = Annotated[AnyScene, WrapValidator(lambda raw, _: read_scene(raw))]
DeviceField = Annotated[AnyDevice, WrapValidator(lambda raw, _: _as_either(raw, PhysicalDevice, NormalizedDevice))]
WallField = Annotated[AnyWall, WrapValidator(lambda raw, _: _as_either(raw, PhysicalWall, NormalizedWall))]
