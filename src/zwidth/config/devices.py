"""Devices of a configuration: a sampled mass and the keys that cannot stand beside it, a linear system, a response."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cached_property
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field, PlainValidator, ValidationInfo, WithJsonSchema, WrapValidator

from zwidth.config.device_table import find_file
from zwidth.config.fields import LocatedProblem, Strict, listing, problem, validation_error
from zwidth.config.parts import PART_NAMES, PartSection, split_refusal
from zwidth.config.values import Delay, Quantity, get_system, quantity_of
from zwidth.parts.checks import Span
from zwidth.parts.devices import DEVICES
from zwidth.parts.linear_device import LinearDevice, split_fraction
from zwidth.parts.measured import SUFFIXES, MeasuredDevice
from zwidth.parts.paths import PARTS
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe, suggestion
from zwidth.words.quantities import HARDWARE, POSITIVE

FORMS = "a published name, 'NUMERATOR / DENOMINATOR' in s, a table FILE.csv of a response, or a mapping"
_OF_SYSTEM = (("numerator", "denominator"), ("zeros", "poles", "gain"), ("A", "B", "C"))


def _to_array(raw: Any) -> np.ndarray:
    """Real numbers, or complex ones where one is, of a list or of one; `ValueError` where one is none."""
    given = np.array([] if raw is None else raw)
    if given.dtype.kind == "U":
        given = np.array([complex(text.replace(" ", "")) for text in given.ravel()]).reshape(given.shape)
    if given.dtype.kind not in "iufc":
        raise ValueError("no numbers")
    return given


def _check_numbers(raw: Any) -> Any:
    with suppress(ValueError):
        if np.all(np.isfinite(_to_array(raw))):
            return raw
    remedy = "write [1, 0.5], or '-3+40j' for a complex root"
    raise problem(f"got {describe(raw)}", "it must be a list of finite numbers", remedy)


_Numbers = Annotated[Any, BeforeValidator(_check_numbers), WithJsonSchema({"type": ["array", "number"]})]


class SystemSection(PartSection, what="a linear system"):
    """A device as a linear system, from commanded force in N to sensed position in m."""

    numerator: _Numbers | None = None
    """Coefficients in s, or in z of a sampled system, highest power first."""

    denominator: _Numbers | None = None
    """Likewise; of a higher degree."""

    zeros: _Numbers | None = None
    """Finite zeros in rad/s, or in z; complex ones as text, '-3+40j', with their conjugates. Default: none."""

    poles: _Numbers | None = None
    """Poles, likewise."""

    gain: _Numbers | None = None
    """Of the highest powers, with zeros and poles."""

    A: _Numbers | None = None
    """Matrix of the state, a list of rows."""

    B: _Numbers | None = None
    """Column of the force."""

    C: _Numbers | None = None
    """Row of the position."""

    sampled: Annotated[float, Quantity("s", POSITIVE)] | None = None
    """The period of a system from sample to sample, that of the loop; a continuous one has none."""

    @cached_property
    def known(self) -> LinearDevice:
        form = next(form for form in _OF_SYSTEM if getattr(self, form[-1]) is not None)
        names = {"numerator": "num", "denominator": "den"}
        known: dict[str, Any] = {names.get(name, name): _to_array(getattr(self, name)) for name in form}
        if form != ("A", "B", "C"):
            known = {name: values if name == "gain" else np.atleast_1d(values) for name, values in known.items()}
        return LinearDevice(SimpleNamespace(**known, D=0.0, dt=self.sampled))

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        # A misspelled key is reported, and its form is as good as there.
        if raw.keys() <= cls.model_fields.keys() and not _is_whole(raw):
            given, forms = listing(raw.keys() - {"sampled"}) or "nothing", " or ".join(map(listing, _OF_SYSTEM))
            yield (), problem(f"got {given}", f"a linear system has {forms}", "write one of these")

    def limits(self) -> Iterable[LocatedProblem]:
        # Of its keys at large, for the message tells which.
        return [((), what) for _, what in super().limits()] if _is_whole(self.model_fields_set) else []


def _is_whole(given: Iterable[str]) -> bool:
    """Whether keys are those of one form; a system may have no zeros."""
    return any(set(form) - {"zeros"} <= set(given) <= {*form, "sampled"} for form in _OF_SYSTEM)


class ResponseSection(PartSection, what="a response"):
    """A device by its measured frequency response, the columns of a table."""

    frequency: _Numbers
    """Of its lines, in Hz."""

    real: _Numbers
    """Real part of position over force, in m/N."""

    imag: _Numbers
    """Imaginary part, in m/N."""

    deviation: _Numbers | None = None
    """The radius in which the true response lies, in m/N."""

    rotary: bool = False
    """Set to true if the response is that of an angle to a torque, in rad/(N m)."""

    @classmethod
    def read(cls, file: str) -> ResponseSection:
        """The columns of a table, so that a run keeps the numbers and not the name."""
        known = MeasuredDevice.read(find_file(file))
        columns = {"frequency": known.frequency, "real": known.response.real, "imag": known.response.imag}
        columns |= {} if known.deviation is None else {"deviation": known.deviation}
        return cls(**{name: column.tolist() for name, column in columns.items()}, rotary=known.rotary)

    @cached_property
    def known(self) -> MeasuredDevice:
        real, imag = (_to_array(part) for part in (self.real, self.imag))
        if real.shape != imag.shape:
            raise InputError(f"imag: got {imag.size} numbers beside {real.size} of real; give one a frequency")
        return MeasuredDevice(self.frequency, real + 1j * imag, self.deviation, self.rotary)


def _read_form(raw: Any) -> SystemSection | ResponseSection:
    """A device in any of its forms but its numbers."""
    if isinstance(raw, SystemSection | ResponseSection):
        return raw
    try:
        if isinstance(raw, str) and raw.endswith(SUFFIXES):
            return ResponseSection.read(raw)
        if isinstance(raw, str) and "/" in raw:
            raw = dict(zip(_OF_SYSTEM[0], split_fraction(raw), strict=True))
    except InputError as error:
        # Of a table its name is said.
        raise split_refusal(str(error).removeprefix("device: ")) from None
    if not isinstance(raw, dict):
        names = tuple(device.name for device in DEVICES)
        allowed = f"published are {listing(names)}"
        raise problem(f"got {describe(raw)}", allowed, suggestion(raw, names, f"zwidth devices lists them; or {FORMS}"))
    return (ResponseSection if "frequency" in raw else SystemSection).model_validate(raw)


DeviceForm = Annotated[SystemSection | ResponseSection, WrapValidator(lambda raw, _: _read_form(raw))]


PHYSICAL_KEYS = frozenset({"device", "rotary", "mass", "damping", "period", "rate", "delay", *PART_NAMES})
PHYSICAL_KEYS |= {"stiffness", "virtual_damping", "safe_limit", *HARDWARE}
NORMALIZED_KEYS = frozenset({"delta", "d", "alpha", "beta"})


class OneKind(Strict):
    """Base of sections that are either physical or normalized, with messages for keys of the other kind."""

    @classmethod
    def unknown(cls, name: str) -> tuple[str, str, str]:
        if name not in (PHYSICAL_KEYS if NORMALIZED_KEYS & cls.model_fields.keys() else NORMALIZED_KEYS):
            return super().unknown(name)
        if name in PART_NAMES:
            allowed = f"{cls.what} that is normalized has no parts: their keys are in SI units"
            remedy = "write mass, damping and period in place of delta and d"
            return f"got {name!r} after normalized keys", allowed, remedy
        kind, other = ("physical", "normalized") if name in NORMALIZED_KEYS else ("normalized", "physical")
        return (
            f"{other} key, after {kind} ones",
            f"{cls.what} is described in SI units or normalized, never both",
            f"remove it, or write all keys {'normalized' if other == 'normalized' else 'in SI units'}",
        )


def read_period(value: Any, read: Callable[[Any], float], info: ValidationInfo) -> float:
    """Return the period, given as such or as the inverse of the rate."""
    if value is not None:
        return read(value)
    # A rate that failed its own check is absent from the data; that fault is enough.
    rate = info.data.get("rate", 1.0)
    if rate is None:
        raise problem("missing", "the sampling period or its rate is needed", "add 'period: 1 ms' or 'rate: 1 kHz'")
    return 1.0 / rate


def _mass(value: Any, read: Callable[[Any], float], info: ValidationInfo) -> float | None:
    """Return the mass; None for a linear system or a measured response."""
    if value is not None:
        return read(value)
    if info.data.get("device", ...) is None:
        allowed = "a device has mass and period or rate, or, normalized, delta"
        raise problem("missing", allowed, "add 'mass: 0.1 kg'")
    return None


def find_second_period(keys: Iterable[str]) -> Iterable[LocatedProblem]:
    """Return a problem if both period and rate are given."""
    for second in [key for key in keys if key in ("period", "rate")][1:]:
        allowed = "the period is the inverse of the rate"
        yield (second,), problem("period and rate are both given", allowed, "remove one", on_key=True)


def find_second_device(keys: dict[str, Any]) -> Iterable[LocatedProblem]:
    """Return problems of parameters that a linear system or measured response already contains."""
    for key in keys:
        if key.partition(".")[0] in ("mass", "damping", *PARTS, "modes") and keys[key]:
            what, allowed = f"got {key!r} together with a system or response", "the system or response contains it"
            yield (key,), problem(what, allowed, "remove one", on_key=True)


def read_rotary(value: Any = None) -> bool | None:
    """Validate the key ``rotary``; return True for a file of rotary devices, None for a file of linear devices."""
    if value is not None and not isinstance(value, bool):
        raise problem(f"got {describe(value)}", "it must be true or false", "remove it: the units determine the kind")
    if value is False and get_system().rotary:
        raise problem("got false", "other devices of the file are rotary, or have units of rotation", "write two files")
    return value or get_system().rotary or None


Rotary = Annotated[bool | None, PlainValidator(read_rotary, json_schema_input_type=bool)]


def _add_device(schema: dict[str, Any]) -> None:
    """Add the texts that name a device in place of mass and damping to the schema for editors."""
    forms = schema["properties"]["device"]["anyOf"]
    forms[:0] = [{"enum": [device.name for device in DEVICES]}, {"type": "string"}]


class SampledMass(OneKind):
    """A sampled mass with damping, in SI units."""

    # The schema also allows the name of a published device, which `prepare` replaces by its parameters.
    model_config = ConfigDict(json_schema_extra=_add_device)

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        """Replace the name of a published device by its parameters; keys of the section override them."""
        name = raw.get("device")
        known = {device.name: device for device in DEVICES}.get(name) if isinstance(name, str) else None
        if known is None:
            return super().prepare(raw)
        if known.rotary != get_system().rotary:
            allowed = "this device is linear, and others of the file are rotary"
            what = problem(f"got {describe(name)}", allowed, "write two files")
            raise validation_error(cls.__name__, [(("device",), what)])
        found = {key: number.value for key in ("mass", "damping") if (number := getattr(known, key)) is not None}
        return super().prepare({**found, **{key: value for key, value in raw.items() if key != "device"}})

    device: DeviceForm | None = None
    """Name of a published device, which supplies mass and damping if they are not given; or a device that is not a mass
    with damping: a linear system ('1 / 0.1 10 0' in s, or a mapping), or a measured response (FILE.csv)."""

    mass: Annotated[float | None, quantity_of("mass"), WrapValidator(_mass)] = Field(
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
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        yield from find_second_period(raw)
        if raw.get("device") is not None:
            yield from find_second_device(raw)
