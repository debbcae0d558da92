"""Pydantic models of the optional parts of a scene in configurations, such as estimates, operator, coupling and modes.

Each part has a *section*, a mapping in the configuration. Parts with several *kinds*, such as the velocity estimate,
select one by the key ``kind``. The model of a section is generated from the dataclass of the part in `zwidth.model`:
its fields are the keys, and `units.quantities` declares their units and ranges. The dataclass validates combinations
of values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import MISSING, fields, replace
from functools import cached_property
from math import isfinite
from typing import Annotated, Any, ClassVar, Literal, Union

import numpy as np
from pydantic import (
    BeforeValidator,
    Field,
    GetPydanticSchema,
    PlainSerializer,
    WithJsonSchema,
    WrapValidator,
    create_model,
)

from zwidth.config.fields import LocatedProblem, Strict, describe_parameter, find_kind, problem
from zwidth.config.values import Quantity, read_entries
from zwidth.core.errors import InputError
from zwidth.model.checks import find_range
from zwidth.model.linear_device import LinearDevice
from zwidth.model.mode import Mode
from zwidth.model.parameter_paths import PARTS, WITH_KIND
from zwidth.model.rational_filter import RationalFilter
from zwidth.model.safe_limit import SafeLimit
from zwidth.model.velocity import ESTIMATES, FOAW
from zwidth.units.formatting import describe
from zwidth.units.quantities import CHOICES, FIELDS, NOT_NEGATIVE

PART_NAMES = ("velocity", *WITH_KIND, *PARTS, "modes")

# Texts that are reported if FOAW, an adaptive velocity estimate, is given but a linear estimate is required: reason and
# remedy.
NO_LINEAR_FORM = "FOAW chooses its window by the motion and has no linear form"
SIMULATED = "use the kind 'simulate' or 'limit_cycle', or a linear estimate such as 'windowed_difference'"


def parse_input_error(error: InputError) -> LocatedProblem:
    """Convert the error of a part or a scene to a pair (path, problem).

    Its message begins with the path of the field, as in "coupling.mass: got ...".
    """
    field, _, text = str(error).partition(": ")
    return tuple(field.split(".")), parse_message(text)


def parse_message(text: str) -> Any:
    """Convert a message of the form ``received; allowed; remedy`` or ``received; remedy`` to a `problem`."""
    message, _, rest = text.partition("; ")
    allowed, _, remedy = rest.rpartition("; ")
    return problem(message, allowed, remedy)


class PartSection(Strict):
    """Base of the models of parts, whose values are validated by the part itself."""

    part: ClassVar[Any]  # class of the part

    @cached_property
    def instance(self) -> Any:
        """The part as an object of `zwidth.model`, with the values of the keys of this section."""
        given = {name: getattr(self, name) for name in type(self).model_fields if name != "kind"}
        return self.part(**given)

    def find_faults(self) -> Iterable[LocatedProblem]:
        try:
            self.instance  # noqa: B018  (raises an error if the part refuses the values)
        except InputError as error:
            path, fault = parse_input_error(error)
            # Omit the name of the part if the path begins with it, because paths are relative to the section.
            yield path if path[0] in type(self).model_fields else path[1:], fault


def to_array(raw: Any) -> np.ndarray:
    """Convert a number or a list to an array; the array is complex if an entry is a text such as "-3+40j".

    Raises:
        ValueError: if an entry is not a number.
    """
    array = np.array([] if raw is None else raw)
    if array.dtype.kind == "U":
        array = np.array([complex(text.replace(" ", "")) for text in array.ravel()]).reshape(array.shape)
    if array.dtype.kind not in "iufc":
        raise ValueError("no numbers")
    return array


def _check_numbers(raw: Any) -> Any:
    """Return ``raw`` unchanged; raise a validation error if it is neither a finite number nor a list of them."""
    with suppress(ValueError):
        if np.all(np.isfinite(to_array(raw))):
            return raw
    remedy = "write [1, 0.5], or '-3+40j' for a complex root"
    raise problem(f"got {describe(raw)}", "it must be a list of finite numbers", remedy)


Numbers = Annotated[Any, BeforeValidator(_check_numbers), WithJsonSchema({"type": ["array", "number"]})]


def _read_coefficients(raw: Any) -> tuple[Any, ...]:
    """Validate the coefficients of a polynomial, or a list of such lists for sections in series; return tuples."""
    if not isinstance(raw, list | tuple):
        raise problem(f"got {describe(raw)}", "coefficients are a list, highest power first", "write [1000, -1000]")
    sections = any(isinstance(each, list | tuple) for each in raw)
    entry: Any = _read_coefficients if sections else Quantity().read
    return read_entries(raw, entry, distinct=False)


_NUMBERS = {"type": "array", "items": {"type": "number"}, "minItems": 1}
Coefficients = Annotated[
    tuple[Any, ...],
    BeforeValidator(_read_coefficients),
    PlainSerializer(list, return_type=list[Any]),
    WithJsonSchema({"anyOf": [_NUMBERS, {**_NUMBERS, "items": _NUMBERS}]}),
]


def make_section(part: Any, owner: str, noun: str, kind: str = "") -> type[PartSection]:
    """Create the model of a part with one key per field of its dataclass.

    Args:
        part: class of the part.
        owner: prefix of the names of the part's parameters in `units.quantities`, such as "coupling".
        noun: noun of the section for messages, such as "a coupling".
        kind: value of the key ``kind``; "" for a section without this key.
    """
    keys: Any = {"kind": (Literal[kind], ...)} if kind else {}  # pyright: ignore[reportInvalidTypeForm]
    for item in fields(part):
        form, description = _describe(f"{owner}.{item.name}", item, part)
        default: Any = ... if item.default is MISSING else item.default
        keys[item.name] = (form | None if default is None else form, Field(default, description=description))
    prefix, description = "", _head(part)
    if owner == "position" and part in ESTIMATES.values():
        # Velocity estimates are also used as position estimates. Give the model of the position estimate another name,
        # because names in a schema must be unique. Omit the difference from its description, because a position
        # estimate uses only the filter.
        prefix, description = "Position", description.removeprefix("The backward difference, followed by ")
        description = description[0].upper() + description[1:]
    section = create_model(f"{prefix}{part.__name__}Section", __base__=PartSection, __doc__=description, **keys)
    section.noun, section.part = noun, part
    return section


def _head(part: Any) -> str:
    """Return the first line of the docstring of a part, which describes its section."""
    return part.__doc__.partition("\n")[0]


# Schema descriptions of the keys of a filter that is given by second-order sections or by zeros, poles and gain.
_ROOTS = {
    "sos": "Second-order sections of the filter, rows of the coefficients b0 b1 b2 a0 a1 a2.",
    "zeros": "Zeros of the filter in the z plane; complex zeros as text such as '0.9+0.1j', with conjugates.",
    "poles": "Poles of the filter, in the same form as the zeros.",
    "gain": "Ratio of the leading coefficients; required with poles.",
}


def _describe(path: str, item: Any, part: Any) -> tuple[Any, str]:
    """Return the type annotation of a key, and its description for the schema.

    Args:
        path: name of the key in `units.quantities`.
        item: field of the dataclass from which the key is generated.
        part: the dataclass.
    """
    if path in CHOICES:
        return Literal[CHOICES[path].names], f"{CHOICES[path].sentence}."
    if issubclass(part, RationalFilter) and item.name in _ROOTS:
        return Numbers, _ROOTS[item.name]
    if path not in FIELDS:
        description = f"Coefficients of the {path.rpartition('.')[2]}, highest power of z first"
        return Coefficients, f"{description}, or a list of sections in series."
    parameter, allowed = FIELDS[path], find_range(item, path)
    low, high, low_open, _ = allowed
    bounds = f", {low:g} to {high:g}" if isfinite(high) else f", {'>' if low_open else '>='} {low:g}"
    description = f"{describe_parameter(parameter, bounds if isfinite(low) else '')}."
    return Annotated[int if parameter.whole else float, Quantity(parameter.unit, allowed, parameter.whole)], description


_ESTIMATES = {
    kind: make_section(part, "velocity", f"a velocity estimate of kind {kind}", kind)
    for kind, part in ESTIMATES.items()
}
_LINEAR = {kind: section for kind, section in _ESTIMATES.items() if section.part is not FOAW}


def read_velocity(raw: Any, sections: dict[str, type[PartSection]] = _LINEAR) -> Any:
    """Return the model of a velocity estimate, selected from ``sections`` by its key ``kind``."""
    if isinstance(raw, tuple(sections.values())):
        return raw
    if isinstance(raw, PartSection):
        raise problem("got a velocity estimate of kind 'foaw'", NO_LINEAR_FORM, SIMULATED)
    refused = {"foaw": (NO_LINEAR_FORM, SIMULATED)}
    section = find_kind(raw, sections, "a velocity estimate", "{kind: low_pass, cutoff: 100 Hz}", refused)
    return section.model_validate(raw)


def _make_one_of(
    sections: dict[str, type[PartSection]], read: Callable[[Any, dict[str, type[PartSection]]], Any]
) -> GetPydanticSchema:
    """Return the annotation of a field whose value is a section of one of several kinds.

    Args:
        sections: models of the sections, keyed by kind.
        read: function that validates a value of the configuration, with the arguments (value, ``sections``), and
            returns the model of its section.
    """
    every = Annotated[Union[tuple(sections.values())], Field(discriminator="kind")]  # noqa: UP007
    validated = Annotated[every, WrapValidator(lambda raw, _: read(raw, sections))]
    return GetPydanticSchema(lambda _, handler: handler.generate_schema(validated))


VelocityField = Annotated[PartSection, _make_one_of(_LINEAR, read_velocity)]
SimulatedVelocityField = Annotated[PartSection, _make_one_of(_ESTIMATES, read_velocity)]
# Description in the schema, noun for messages and example for messages of each part that has several kinds.
_OF_KIND = {
    "position": ("Position estimate", "a position estimate", "{kind: exponential, coefficient: 0.3}"),
    "feedback": ("Further feedback", "further feedback", "{kind: integral, gain: 1000}"),
}


def _make_kinds(name: str) -> Any:
    """Return the annotation of the field for the part ``name``, which has several kinds, such as "position"."""
    _, noun, example = _OF_KIND[name]
    sections = {
        kind: make_section(part, name, f"{noun} of kind {kind}", kind) for kind, part in WITH_KIND[name].items()
    }

    def read(raw: Any, sections: dict[str, type[PartSection]]) -> Any:
        if isinstance(raw, PartSection):
            return raw
        return find_kind(raw, sections, noun, example).model_validate(raw)

    return Annotated[PartSection, _make_one_of(sections, read)]


_KIND_FIELDS = {name: _make_kinds(name) for name in WITH_KIND}
_SECTIONS: Any = {
    name: make_section(part, name, f"{'an' if name[0] in 'aeiou' else 'a'} {name}") for name, part in PARTS.items()
}
ModeSection: Any = make_section(Mode, "mode", "a mode")
ActuatorSection: Any = _SECTIONS["actuator"]


class SafeLimitSection(PartSection, noun="a safe limit"):
    """Stiffest wall that measurements of the device support."""

    part = SafeLimit

    stiffness: Annotated[float, Quantity("N/m", NOT_NEGATIVE)]
    """Stiffness of the wall, in N/m or with a unit; 0 if the measurements support no wall."""

    virtual_damping: Annotated[float, Quantity("N s/m")] = 0.0
    """Virtual damping of the wall, in N s/m or with a unit."""

    reason: str = ""
    """Reason for the limit."""

    warnings: list[str] = Field(default=[])
    """Warnings about the measurements."""

    damping_reserve: Annotated[float, Quantity("N s/m", NOT_NEGATIVE)] = 0.0
    """Physical damping that passivity does not count, because its estimate is uncertain, in N s/m or with a unit."""


def make_parts_base(no_estimate: str, no_part: str, more: str = "") -> type[Strict]:
    """Create the base class of models that have one section per optional part of a scene.

    Args:
        no_estimate: text of the default of the velocity estimate, for descriptions in the schema.
        no_part: text of the default of the other parts, for the same descriptions.
        more: sentence to append to the descriptions.
    """
    parts: dict[str, Any] = {"velocity": ("Velocity estimate", VelocityField, no_estimate)}
    parts |= {name: (_OF_KIND[name][0], form, no_part) for name, form in _KIND_FIELDS.items()}
    parts |= {name: (_head(section.part)[:-1], section, no_part) for name, section in _SECTIONS.items()}
    parts["modes"] = "Resonances in the measured position", list[ModeSection], no_part
    keys: Any = {
        name: (
            form | None,
            Field(default=None, description=f"{description}. Default: {absent}.{'' if name in WITH_KIND else more}"),
        )
        for name, (description, form, absent) in parts.items()
    }
    return create_model("Parts", __base__=Strict, **keys)


def list_parts(owner: Any) -> dict[str, Any]:
    """Return the sections of the given parts of a device, scene or study, by the name of the part.

    The entry "modes" is a list of sections; "device" is a linear system or a measured response that replaces mass and
    damping.
    """
    parts = {name: getattr(owner, name, None) for name in ("device", *PART_NAMES)}
    return {name: section for name, section in parts.items() if section is not None and section != []}


def build_parts(owner: Any) -> dict[str, Any]:
    """Return the given parts of a device, scene or study as objects of `zwidth.model`, by the name of the part."""
    parts: dict[str, Any] = {
        name: [each.instance for each in section] if isinstance(section, list) else section.instance
        for name, section in list_parts(owner).items()
    }
    if owner.rotary and isinstance(parts.get("device"), LinearDevice):
        # Mark the device as rotary if any value of the file has a rotary unit. The section of the device does not
        # suffice to decide this, because it may contain no such unit.
        parts["device"] = replace(parts["device"], rotary=True)
    return parts
