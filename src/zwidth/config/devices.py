"""Devices of a configuration that are no mass with damping: a linear system, or a measured frequency response."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, WithJsonSchema, WrapValidator

from zwidth.config.device_table import find_file
from zwidth.config.faults import LocatedProblem, listing, problem
from zwidth.config.parts import PartSection, split_refusal
from zwidth.config.values import Quantity
from zwidth.parts.devices import DEVICES
from zwidth.parts.linear_device import LinearDevice, split_fraction
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.response_table import SUFFIXES
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe, suggestion
from zwidth.words.quantities import POSITIVE

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
    try:
        if np.all(np.isfinite(_to_array(raw))):
            return raw
    except ValueError:
        pass
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
    """Finite zeros in rad/s, or in z; complex ones as text, '-3+40j', with their conjugates. None where left out."""

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
    def _known(self) -> LinearDevice:
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

    @classmethod
    def read(cls, file: str) -> ResponseSection:
        """The columns of a table, so that a run keeps the numbers and not the name."""
        known = MeasuredDevice.read(find_file(file))
        columns = {"frequency": known.frequency, "real": known.response.real, "imag": known.response.imag}
        columns |= {} if known.deviation is None else {"deviation": known.deviation}
        return cls(**{name: column.tolist() for name, column in columns.items()})

    @cached_property
    def _known(self) -> MeasuredDevice:
        real, imag = (_to_array(part) for part in (self.real, self.imag))
        if real.shape != imag.shape:
            raise InputError(f"imag: got {imag.size} numbers beside {real.size} of real; give one a frequency")
        return MeasuredDevice(self.frequency, real + 1j * imag, self.deviation)


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
