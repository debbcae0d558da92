"""Pydantic models of devices in configurations: a mass with damping, a linear system, a measured response, an arm.

The *section* of a device is the mapping that describes it. Sections are either in SI units ("physical") or normalized;
`OneKind` reports keys of the other kind. A linear system or a measured frequency response replaces mass, damping and
mechanical parts. A linear system has one of four forms: numerator and denominator; zeros, poles and gain; the matrices
A, B and C; or second-order sections. An arm with several joints (`zwidth.config.joint_devices`) is converted to a
linear system, or to the keys ``mass`` and ``damping`` if it moves like one mass along the direction of the wall.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, ValidationError, ValidationInfo, WrapValidator
from pydantic_core import PydanticCustomError

from zwidth.config.device_table import find_file
from zwidth.config.fields import LocatedProblem, Strict, combine_problems, problem, quote_names
from zwidth.config.joint_devices import MassMatrixSection, MujocoSection
from zwidth.config.parts import PART_NAMES, Numbers, PartSection, parse_message, to_array
from zwidth.config.values import Delay, Quantity, Rotary, get_system, quantity_of, read_rotary
from zwidth.core.errors import InputError
from zwidth.model.checks import Span
from zwidth.model.device import Device
from zwidth.model.devices import DEVICES
from zwidth.model.linear_device import LinearDevice
from zwidth.model.measured_device import SUFFIXES, MeasuredDevice
from zwidth.model.mujoco_model import MODEL_SUFFIXES
from zwidth.model.parameter_paths import CONTAINED
from zwidth.model.system_forms import parse_system
from zwidth.units.formatting import describe, suggestion
from zwidth.units.quantities import HARDWARE, POSITIVE

FORMS = "a published name, 'NUMERATOR / DENOMINATOR' in s, a table FILE.csv of a response, or a mapping"
# Keys of each form of a linear system. The last key identifies the form, because it is required and in no other form.
_SYSTEM_FORMS = (("numerator", "denominator"), ("zeros", "poles", "gain"), ("A", "B", "C"), ("sos",))


class SystemSection(PartSection, noun="a linear system"):
    """A device as a linear system, from the commanded force in N to the measured position in m."""

    numerator: Numbers | None = None
    """Numerator coefficients in powers of s, or of z for a sampled system; highest power first."""

    denominator: Numbers | None = None
    """Denominator coefficients, highest power first; the degree must exceed that of the numerator."""

    zeros: Numbers | None = None
    """Finite zeros in rad/s, or in the z plane for a sampled system; complex zeros as text such as '-3+40j', together
    with their conjugates. Default: none."""

    poles: Numbers | None = None
    """Poles, in the same form as the zeros."""

    gain: Numbers | None = None
    """Ratio of the leading coefficients of numerator and denominator; required with zeros and poles."""

    A: Numbers | None = None
    """State matrix, a list of rows."""

    B: Numbers | None = None
    """Input vector, for the force."""

    C: Numbers | None = None
    """Output vector, for the position."""

    sos: Numbers | None = None
    """Second-order sections, rows of the coefficients b0 b1 b2 a0 a1 a2, whose product is the system."""

    sampled: Annotated[float, Quantity("s", POSITIVE)] | None = None
    """Sampling period of a discrete-time system, in s or with a unit; must equal the period of the loop. Default: the
    system is continuous-time."""

    @cached_property
    def instance(self) -> LinearDevice:
        """The linear system as an object of `zwidth.model`, built from the keys of the given form."""
        form = next(form for form in _SYSTEM_FORMS if getattr(self, form[-1]) is not None)
        values = {name: to_array(getattr(self, name)) for name in form}
        vectors = ("numerator", "denominator", "zeros", "poles")
        system = {name: np.atleast_1d(value) if name in vectors else value for name, value in values.items()}
        return LinearDevice(system, self.sampled)

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        # Skip this check if a key is unknown, because the unknown key is reported anyway and may be a misspelling of
        # the missing one.
        if raw.keys() <= cls.model_fields.keys() and not _is_complete(raw):
            given, forms = (
                quote_names(raw.keys() - {"sampled"}) or "nothing",
                " or ".join(map(quote_names, _SYSTEM_FORMS)),
            )
            yield (), problem(f"got {given}", f"a linear system has {forms}", "write one of these")

    def find_faults(self) -> Iterable[LocatedProblem]:
        # Report the problems with the path of the section instead of that of a key, because the messages already name
        # the key.
        return [((), fault) for _, fault in super().find_faults()] if _is_complete(self.model_fields_set) else []


def _is_complete(given: Iterable[str]) -> bool:
    """Return whether the keys are exactly those of one form of a linear system; the key ``zeros`` is optional."""
    return any(set(form) - {"zeros"} <= set(given) <= {*form, "sampled"} for form in _SYSTEM_FORMS)


class ResponseSection(PartSection, noun="a response"):
    """A device given by its measured frequency response from force to position, as lists of equal length."""

    frequency: Numbers
    """Frequencies in Hz."""

    real: Numbers
    """Real part of the response at each frequency, in m/N."""

    imag: Numbers
    """Imaginary part of the response at each frequency, in m/N."""

    deviation: Numbers | None = None
    """Radius around each value that contains the true response, in m/N. Default: the values are exact."""

    rotary: bool = False
    """True for a response from torque to angle, in rad/(N m). Default: false."""

    @classmethod
    def read(cls, file: str) -> ResponseSection:
        """Read a response from a table file.

        The section contains the values instead of the name of the file, so that the saved configuration of a run does
        not depend on the file.
        """
        response = MeasuredDevice.read(find_file(file))
        columns = {"frequency": response.frequency, "real": response.response.real, "imag": response.response.imag}
        columns |= {} if response.deviation is None else {"deviation": response.deviation}
        return cls(**{name: column.tolist() for name, column in columns.items()}, rotary=response.rotary)

    @cached_property
    def instance(self) -> MeasuredDevice:
        """The measured response as an object of `zwidth.model`."""
        real, imag = (to_array(part) for part in (self.real, self.imag))
        if real.shape != imag.shape:
            raise InputError(f"imag: got {imag.size} numbers and {real.size} of real; give one per frequency")
        return MeasuredDevice(self.frequency, real + 1j * imag, self.deviation, self.rotary)


_Section = SystemSection | ResponseSection | MassMatrixSection
# Keys that only one kind of device has, by the Pydantic model of this kind. A mapping without any of these keys
# describes a linear system.
_IDENTIFYING: dict[type[Strict], set[str]] = {
    ResponseSection: {"frequency"},
    MujocoSection: {"model", "site", "pose"},
    MassMatrixSection: {"mass_matrix", "jacobian", "direction"},
}


def read_device_form(raw: Any) -> _Section:
    """Return the validated section of a linear system, a response or an arm, given as a mapping, a string or a file."""
    if isinstance(raw, _Section):
        return raw
    try:
        if isinstance(raw, str) and raw.endswith(SUFFIXES):
            return ResponseSection.read(raw)
        if isinstance(raw, str) and ("/" in raw or raw.startswith("sos:")) and not raw.endswith(MODEL_SUFFIXES):
            raw = parse_system("device", raw, "s")
    except InputError as error:
        # Remove the prefix "device: ", because the location is reported separately.
        raise parse_message(str(error).removeprefix("device: ")) from None
    if isinstance(raw, str) and raw.endswith(MODEL_SUFFIXES):
        allowed = "a device from a model has the keys 'model', 'site' and 'direction'"
        raise problem(f"got {describe(raw)}", allowed, f"write {{model: {raw}, site: handle, direction: x}}")
    if not isinstance(raw, dict):
        names = tuple(device.name for device in DEVICES)
        allowed = f"published are {quote_names(names)}"
        raise problem(f"got {describe(raw)}", allowed, suggestion(raw, names, f"zwidth devices lists them; or {FORMS}"))
    section = next((section for section, keys in _IDENTIFYING.items() if keys & raw.keys()), SystemSection)
    model: Any = section.model_validate(raw)
    return MassMatrixSection.model_validate(model.joints) if isinstance(model, MujocoSection) else model


def replace_rigid(raw: dict[str, Any]) -> dict[str, Any]:
    """Replace the key ``device`` by ``mass`` and ``damping`` if it is an arm that moves like a rigid mass.

    Return the mapping ``raw`` unchanged if it contains another device. Also return it unchanged if the arm is invalid,
    or if the mapping contains mass or damping, because the subsequent validation reports these errors.
    """
    device = raw.get("device")
    if not isinstance(device, dict | MassMatrixSection) or {"mass", "damping"} & raw.keys():
        return raw
    with suppress(PydanticCustomError, ValidationError):
        section = read_device_form(device)
        if isinstance(section, MassMatrixSection) and isinstance(section.instance, Device):
            rigid = {"mass": section.instance.mass, "damping": section.instance.damping}
            rigid |= {"rotary": True} if section.instance.rotary else {}
            return {**{key: value for key, value in raw.items() if key != "device"}, **rigid}
    return raw


# This union contains `MujocoSection` so that the JSON Schema describes it. `read_device_form` converts it to a
# `MassMatrixSection`.
DeviceForm = Annotated[_Section | MujocoSection, WrapValidator(lambda raw, _: read_device_form(raw))]


PHYSICAL_KEYS = frozenset({"device", "rotary", "mass", "damping", "period", "rate", "delay", *PART_NAMES})
PHYSICAL_KEYS |= {"stiffness", "virtual_damping", "controller", "safe_limit", *HARDWARE}
NORMALIZED_KEYS = frozenset({"delta", "d", "alpha", "beta"})


class OneKind(Strict):
    """Base of the sections that are either physical or normalized; its messages explain keys of the other kind."""

    @classmethod
    def explain_unknown(cls, name: str) -> tuple[str, str, str]:
        if name not in (PHYSICAL_KEYS if NORMALIZED_KEYS & cls.model_fields.keys() else NORMALIZED_KEYS):
            return super().explain_unknown(name)
        if name in PART_NAMES:
            allowed = f"{cls.noun} that is normalized has no parts: their keys are in SI units"
            remedy = "write mass, damping and period in place of delta and d"
            return f"got {name!r} after normalized keys", allowed, remedy
        kind, other = ("physical", "normalized") if name in NORMALIZED_KEYS else ("normalized", "physical")
        return (
            f"{other} key, after {kind} ones",
            f"{cls.noun} is described in SI units or normalized, never both",
            f"remove it, or write all keys {'normalized' if other == 'normalized' else 'in SI units'}",
        )


def read_period(value: Any, read: Callable[[Any], float], info: ValidationInfo) -> float:
    """Validate the key ``period`` with the function ``read``; if it is absent, return the inverse of ``rate``, in s."""
    if value is not None:
        return read(value)
    # A rate whose validation failed is absent from ``info.data``. Use 1 in its place, because the invalid rate is
    # already reported.
    rate = info.data.get("rate", 1.0)
    if rate is None:
        raise problem("missing", "the sampling period or its rate is needed", "add 'period: 1 ms' or 'rate: 1 kHz'")
    return 1.0 / rate


def _validate_mass(value: Any, read: Callable[[Any], float], info: ValidationInfo) -> float | None:
    """Validate the key ``mass`` with the function ``read``; return None if a system or a response replaces it."""
    if value is not None:
        return read(value)
    if info.data.get("device", ...) is None:
        allowed = "a device has mass and period or rate, or, normalized, delta"
        raise problem("missing", allowed, "add 'mass: 0.1 kg'")
    return None


def find_second_period(keys: Iterable[str]) -> Iterable[LocatedProblem]:
    """Yield a problem if ``keys`` contains both ``period`` and ``rate``."""
    for second in [key for key in keys if key in ("period", "rate")][1:]:
        allowed = "the period is the inverse of the rate"
        yield (second,), problem("period and rate are both given", allowed, "remove one", on_key=True)


def find_second_device(keys: dict[str, Any]) -> Iterable[LocatedProblem]:
    """Yield a problem for each key, such as ``mass`` or a mechanical part, that conflicts with the key ``device``."""
    device = keys.get("device")
    has_joints = isinstance(device, dict) and bool(_IDENTIFYING[MassMatrixSection] & device.keys())
    has_joints |= isinstance(device, MassMatrixSection) or (isinstance(device, dict) and "model" in device)
    for key in keys:
        if key.partition(".")[0] not in ("mass", "damping", *CONTAINED) or not keys[key]:
            continue
        message, allowed, remedy = "a system or response", "the system or response contains it", "remove one"
        if has_joints:
            message, allowed = "joints", "the joints determine mass and damping"
            if key not in ("mass", "damping"):
                allowed, remedy = "an arm that is no rigid mass has no separate parts", "add them to its matrices"
        yield (key,), problem(f"got {key!r} together with {message}", allowed, remedy, on_key=True)


def _add_device(schema: dict[str, Any]) -> None:
    """Add to the JSON Schema that the key ``device`` may also be a text, such as the name of a published device."""
    forms = schema["properties"]["device"]["anyOf"]
    forms[:0] = [{"enum": [device.name for device in DEVICES]}, {"type": "string"}]


class SampledMass(OneKind):
    """A sampled mass with damping, in SI units."""

    # Add texts to the schema, because `prepare` replaces the name of a published device by its parameters.
    model_config = ConfigDict(json_schema_extra=_add_device)

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        """Replace ``device`` by mass and damping for a published device, and for an arm that moves like one mass.

        The keys mass and damping of the section override the values of a published device.
        """
        name = raw.get("device")
        published = {device.name: device for device in DEVICES}.get(name) if isinstance(name, str) else None
        if published is None:
            return super().prepare(replace_rigid(raw))
        if published.rotary != get_system().rotary:
            allowed = "this device is linear, and others of the file are rotary"
            fault = problem(f"got {describe(name)}", allowed, "write two files")
            raise combine_problems(cls.__name__, [(("device",), fault)])
        parameters = {
            key: number.value for key in ("mass", "damping") if (number := getattr(published, key)) is not None
        }
        return super().prepare({**parameters, **{key: value for key, value in raw.items() if key != "device"}})

    device: DeviceForm | None = None
    """Name of a published device; the keys mass and damping override its values. Otherwise one of: a linear system
    ('1 / 0.1 10 0' in s, or a mapping); a measured response (FILE.csv); an arm with joints, given by its mass matrix
    (mapping with the key mass_matrix) or by a model file (mapping with the keys model, site and direction)."""

    mass: Annotated[float | None, quantity_of("mass"), WrapValidator(_validate_mass)] = Field(
        default=None, validate_default=True
    )
    damping: Annotated[float, quantity_of("damping")] = 0.0

    rotary: Rotary = Field(default_factory=read_rotary)
    """True for rotary devices. One quantity with a rotary unit makes all devices of a file rotary."""

    rate: Annotated[float, quantity_of("rate")] | None = Field(default=None, exclude=True)
    period: Annotated[float, quantity_of("period"), WrapValidator(read_period)] = Field(
        default=None, validate_default=True
    )
    delay: Delay = Span(0.0, "s")

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        yield from find_second_period(raw)
        if raw.get("device") is not None:
            yield from find_second_device(raw)
