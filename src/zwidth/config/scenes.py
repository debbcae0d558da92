"""Models of scenes, devices and walls, each in SI units ("physical") or normalized.

A scene is a device with its timing, optional parts and optional wall, and supplies the default values of the studies.
A plant is a device with its timing, but without a wall. Normalized parameters are those of `zwidth.Scene.normalized`:
delta, d, alpha and beta. The first key of a mapping that belongs to only one of the two kinds determines the kind of
the mapping.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, TypeAlias

import numpy as np
from pydantic import ConfigDict, Field, WrapValidator

from zwidth.analysis.scene import Scene
from zwidth.config.controllers import ControllerField, derive_keys, find_second_wall
from zwidth.config.devices import NORMALIZED_KEYS, PHYSICAL_KEYS, OneKind, SampledMass
from zwidth.config.fields import LocatedProblem, problem, quote_names
from zwidth.config.parts import (
    SafeLimitSection,
    SimulatedVelocityField,
    build_parts,
    list_parts,
    make_parts_base,
    parse_input_error,
)
from zwidth.config.values import NonNegative, Number, quantity_of
from zwidth.core.errors import InputError
from zwidth.core.xp import within
from zwidth.model.device import Device
from zwidth.model.linear_device import LinearDevice
from zwidth.model.parameter_paths import CONTAINED, replace_parameters
from zwidth.model.timing import Timing
from zwidth.model.velocity import FOAW
from zwidth.model.wall import VirtualWall
from zwidth.units.formatting import describe, short
from zwidth.units.plausibility import list_implausible
from zwidth.units.quantities import HARDWARE, LARGEST_DAMPING, MAX_DELAY_PERIODS, WALL_RANGE

_Parts: Any = make_parts_base("the difference of two samples", "none")


class _PhysicalPlant(_Parts, SampledMass):
    """A device in SI units with its optional parts."""

    def find_faults(self) -> Iterable[LocatedProblem]:
        if not self.d <= MAX_DELAY_PERIODS:
            allowed = f"at most {MAX_DELAY_PERIODS:g} periods"
            yield ("delay",), problem(f"got {self.delay}, which is {short(self.d)} periods", allowed, "check the units")
            return
        if self.device is not None and any(getattr(self, name) for name in CONTAINED):
            # Skip the checks below, because parts that conflict with a linear system or measured response are already
            # reported.
            return
        try:
            scene = self.to_scene()
            if not is_adaptive(self):
                scene.check_parts()
        except InputError as error:
            path, message = parse_input_error(error)
            yield path if path[0] in type(self).model_fields else ("device", *path), message
            return
        if self.device is not None:
            return
        with np.errstate(all="ignore"):
            normalized = scene.normalized
        for field, name in (("damping", "delta"), ("stiffness", "alpha"), ("virtual_damping", "beta")):
            least, most = (0.0, LARGEST_DAMPING) if name == "delta" else WALL_RANGE
            value = float(getattr(normalized, name))
            if not within(np.float64(value), (least, most)):
                message = f"got {short(getattr(self, field))}, whose normalized value is {name} = {short(value)}"
                bounds = f"0 or {least:g} to {most:g}" if least else f"at most {most:g}"
                yield (field,), problem(message, f"{name} must be {bounds}", "check the units and the mass")

    @property
    def nonrigid_parts(self) -> tuple[str, ...]:
        """Names of the parts that a rigid mass with backward difference lacks; only some kinds of study accept them."""
        return self.to_scene().nonrigid_parts

    @property
    def delta(self) -> float:
        """Normalized damping delta of the device and, with a rigid grasp, of the operator."""
        return float(self.to_scene().delta)

    @property
    def d(self) -> float:
        """Delay in sampling periods, without rounding error if it is given in periods."""
        return self.delay.periods(self.period)

    def to_scene(self) -> Scene:
        """Return the device, its timing and, if given, its wall as a `Scene` in SI units."""
        return self._scene

    @cached_property
    def _scene(self) -> Scene:
        # Pass the delay as a `Span`, because the conversion of periods to seconds has rounding errors.
        timing = Timing(self.period, self.delay)
        # Use a mass of 1 kg if none is given, because `replace_parameters` then replaces this device by the linear
        # system or measured response.
        device = Device(mass=self.mass or 1.0, damping=self.damping, rotary=bool(self.rotary))
        limit = getattr(self, "safe_limit", None)
        return replace_parameters(Scene(device, timing, safe_limit=limit and limit.instance), build_parts(self))


class _NormalizedPlant(OneKind):
    """A plant in normalized parameters, as a mass of 1 kg at a period of 1 s."""

    period: ClassVar[float] = 1.0
    nonrigid_parts: ClassVar[tuple[str, ...]] = ()

    delta: NonNegative
    d: Annotated[float, quantity_of("d")] = 0.0

    def to_scene(self) -> Scene:
        """Return the plant as a `Scene` with a mass of 1 kg and a period of 1 s."""
        return Scene(Device(1.0, self.delta), Timing(self.period, self.d))


class PhysicalDevice(_PhysicalPlant, noun="a device"):
    """A device in SI units."""

    label: str | None = None
    """Name of the device in legends."""

    safe_limit: SafeLimitSection | None = None
    """Stiffest wall that measurements of the device support."""


class SimulatedDevice(PhysicalDevice):
    """A device in SI units for simulations, which also accept nonlinear velocity estimates."""

    velocity: SimulatedVelocityField | None = None
    """Velocity estimate. Default: the difference of two samples."""


class LabeledDevice(_PhysicalPlant, noun="a device"):
    """A device in SI units with a label; the scene supplies the keys that are not given."""

    # Only the label is required in the schema, because the scene may supply all other keys.
    model_config = ConfigDict(json_schema_extra={"required": ["label"]})

    label: str
    """Unique name of the device in the legend."""


class NormalizedDevice(_NormalizedPlant, noun="a device"):
    """A normalized device."""

    label: str | None = None
    """Name of the device in legends."""


class PhysicalWall(OneKind, noun="a wall"):
    """A wall in SI units."""

    stiffness: Annotated[float, quantity_of("stiffness")]
    virtual_damping: Annotated[float, quantity_of("virtual_damping")] = 0.0


class NormalizedWall(OneKind, noun="a wall"):
    """A normalized wall."""

    alpha: Number
    beta: Number = 0.0


def _pick_wall(scene: Any, kind: Any) -> Any:
    """Return the wall of a scene as an instance of ``kind``; None if both of its parameters are absent.

    If only one parameter is absent, it is 0.
    """
    given = {name: getattr(scene, name) for name in kind.model_fields}
    return None if set(given.values()) == {None} else kind(**{name: value or 0.0 for name, value in given.items()})


class PhysicalScene(_PhysicalPlant, noun="a scene"):
    """Device, timing and wall in SI units, the default values of the studies."""

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        return super().prepare(derive_keys(raw))

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        yield from super().find_conflicts(raw)
        yield from find_second_wall(raw)

    stiffness: Annotated[float, quantity_of("stiffness")] | None = None
    virtual_damping: Annotated[float, quantity_of("virtual_damping")] | None = None

    controller: ControllerField | None = Field(default=None, exclude=True)
    """Gains of a motor controller, in place of the keys stiffness, virtual_damping and feedback."""

    velocity: SimulatedVelocityField | None = None
    """Velocity estimate. Default: the difference of two samples."""

    safe_limit: SafeLimitSection | None = None
    """Stiffest wall that measurements of the device support."""

    resolution: Annotated[float, quantity_of("resolution")] | None = None
    coulomb: Annotated[float, quantity_of("coulomb")] | None = None
    static: Annotated[float, quantity_of("static")] | None = None
    max_force: Annotated[float, quantity_of("max_force")] | None = None
    max_rate: Annotated[float, quantity_of("max_rate")] | None = None

    @property
    def hardware(self) -> dict[str, float]:
        """Values of the given parameters of encoder, friction and motor, by the name of the parameter."""
        return {name: value for name in HARDWARE if (value := getattr(self, name)) is not None}

    @cached_property
    def _scene(self) -> Scene:
        # Represent an absent wall by stiffness 0 and damping 0, because such a wall exerts no force.
        wall = VirtualWall(stiffness=self.stiffness or 0.0, virtual_damping=self.virtual_damping or 0.0)
        return replace(super()._scene, wall=wall)

    def without_wall(self, kind: type[PhysicalDevice] = PhysicalDevice) -> PhysicalDevice:
        """Return the device, timing, parts and safe limit of the scene as a device model of class ``kind``.

        The default class accepts only velocity estimates with a linear form.
        """
        names = "mass", "damping", "period", "delay", "rotary", "safe_limit"
        values = {name: getattr(self, name) for name in names}
        return kind(**{name: value for name, value in values.items() if value is not None}, **list_parts(self))

    @property
    def warnings(self) -> list[str]:
        """Warnings about implausible values of parameters, one line each."""
        parameters = {
            path: value for path, value in self.to_scene().parameters().items() if path not in ("period", "rate")
        }
        parameters |= {"period": self.period} if self.rate is None else {"rate": self.rate}
        system, device = self.to_scene().unit_system, self.to_scene().device
        warning = device.warn_of_variable(self.period) if isinstance(device, LinearDevice) else ""
        return list_implausible(
            parameters, lambda path, value: f"'{path}: {value}'" if value else f"scene.{path}", system
        ) + ([f"scene.device: {warning} write a mapping with 'sampled'"] if warning else [])

    @property
    def wall(self) -> PhysicalWall | None:
        """Wall of the scene; None if neither stiffness nor virtual damping is given."""
        return _pick_wall(self, PhysicalWall)


class NormalizedScene(_NormalizedPlant, noun="a scene"):
    """Normalized device, delay and wall, the default values of the studies."""

    alpha: Number | None = None
    beta: Number | None = None

    def without_wall(self) -> NormalizedDevice:
        """Return the device and the delay of the scene, without the wall."""
        return NormalizedDevice(delta=self.delta, d=self.d)

    @property
    def wall(self) -> NormalizedWall | None:
        """Wall of the scene; None if neither alpha nor beta is given."""
        return _pick_wall(self, NormalizedWall)


def is_adaptive(owner: Any) -> bool:
    """Return whether the velocity estimate of a scene or a device has no linear form (FOAW)."""
    velocity = getattr(owner, "velocity", None)
    return velocity is not None and velocity.part is FOAW


def normalized_wall(device: AnyDevice, wall: AnyWall) -> tuple[float, float]:
    """Return the normalized stiffness alpha and the normalized damping beta of a wall on a device."""
    if isinstance(wall, NormalizedWall):
        return wall.alpha, wall.beta
    alpha, beta = device.to_scene().normalize_walls(wall.stiffness, wall.virtual_damping)
    return float(alpha), float(beta)


def is_normalized(raw: dict[str, Any]) -> bool:
    """Return whether a mapping is normalized: its first key that is allowed in only one of the two forms decides."""
    decisive = [key for key in raw if key in PHYSICAL_KEYS | NORMALIZED_KEYS]
    return bool(decisive) and decisive[0] in NORMALIZED_KEYS


def _read_either(raw: Any, physical: type[Any], normalized: type[Any]) -> Any:
    """Validate a mapping with the physical or the normalized model, selected by `is_normalized`, and return it."""
    if isinstance(raw, physical | normalized):
        return raw
    if not isinstance(raw, dict):
        keys = f"{quote_names(physical.model_fields)} or, normalized, {quote_names(normalized.model_fields)}"
        allowed = f"{physical.noun} is a mapping with the keys {keys}"
        raise problem(f"got {describe(raw)}", allowed, "write 'key: value' lines")
    return (normalized if is_normalized(raw) else physical).model_validate(raw)


AnyScene: TypeAlias = PhysicalScene | NormalizedScene
AnyDevice: TypeAlias = PhysicalDevice | NormalizedDevice
AnyWall: TypeAlias = PhysicalWall | NormalizedWall


def read_scene(raw: Any) -> AnyScene:
    """Validate the mapping of a scene and return its model, physical or normalized."""
    return _read_either(raw, PhysicalScene, NormalizedScene)


# Do not call pydantic's handler of the union, because it would try both kinds and report the faults of both.
SceneField = Annotated[AnyScene, WrapValidator(lambda raw, _: read_scene(raw))]
DeviceField = Annotated[AnyDevice, WrapValidator(lambda raw, _: _read_either(raw, PhysicalDevice, NormalizedDevice))]
WallField = Annotated[AnyWall, WrapValidator(lambda raw, _: _read_either(raw, PhysicalWall, NormalizedWall))]
