"""The parts of a scene beside device and timing, as a configuration has them: velocity estimate, hand, coupling, ...

Each section below has the keys of the part of that name in `zwidth.parts`, and gives that part.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import MISSING, fields
from functools import cached_property
from math import isfinite
from typing import Annotated, Any, ClassVar, Literal, Union

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
from zwidth.parts.checks import find_range
from zwidth.parts.mode import Mode
from zwidth.parts.paths import PARTS
from zwidth.parts.safe_limit import SafeLimit
from zwidth.parts.velocity import ESTIMATES, FOAW
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe
from zwidth.words.quantities import CHOICES, FIELDS, NOT_NEGATIVE

PART_NAMES = ("velocity", *PARTS, "modes")

NO_LINEAR_FORM = "FOAW chooses its window by the motion and has no linear form"
SIMULATED = "use the kind 'simulate' or 'limit_cycle', or a linear estimate such as 'windowed_difference'"


def locate_refusal(error: InputError) -> LocatedProblem:
    """What a part or a scene refuses, at the field that its message names."""
    field, _, text = str(error).partition(": ")
    return tuple(field.split(".")), split_refusal(text)


def split_refusal(text: str) -> Any:
    """A refusal as what was given, what is allowed and the remedy; of two parts the second is the remedy."""
    what, _, rest = text.partition("; ")
    allowed, _, remedy = rest.rpartition("; ")
    return problem(what, allowed, remedy)


class PartSection(Strict):
    """Base of the sections: what the keys give is checked by the part itself."""

    part: ClassVar[Any]

    @cached_property
    def known(self) -> Any:
        """The part itself."""
        given = {name: getattr(self, name) for name in type(self).model_fields if name != "kind"}
        return self.part(**given)

    def limits(self) -> Iterable[LocatedProblem]:
        try:
            self.known  # noqa: B018  (raises where the part refuses)
        except InputError as error:
            path, what = locate_refusal(error)
            # A whole part begins the path with its name; a field of the section is its own place.
            yield path if path[0] in type(self).model_fields else path[1:], what


def _read_coefficients(raw: Any) -> tuple[Any, ...]:
    """Return coefficients, or sections in series, each with its coefficients."""
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


def make_section(part: Any, owner: str, what: str, kind: str = "") -> type[PartSection]:
    """The section of a part: a key a field, as `words.quantities` declares it under the name of its ``owner``."""
    keys: Any = {"kind": (Literal[kind], ...)} if kind else {}  # pyright: ignore[reportInvalidTypeForm]
    for item in fields(part):
        form, words = _describe(f"{owner}.{item.name}", item)
        default: Any = ... if item.default is MISSING else item.default
        keys[item.name] = (form | None if default is None else form, Field(default, description=words))
    section = create_model(f"{part.__name__}Section", __base__=PartSection, __doc__=_head(part), **keys)
    section.what, section.part = what, part
    return section


def _head(part: Any) -> str:
    """What a part says of itself, in one line."""
    return part.__doc__.partition("\n")[0]


def _describe(path: str, item: Any) -> tuple[Any, str]:
    """How a key is read, and what the schema says of it."""
    if path in CHOICES:
        return Literal[CHOICES[path].names], f"{CHOICES[path].sentence}."
    if path not in FIELDS:
        words = (
            f"Coefficients of the {path.rpartition('.')[2]}, highest power of z first, or a list of sections in series."
        )
        return Coefficients, words
    known, allowed = FIELDS[path], find_range(item, path)
    low, high, low_open, _ = allowed
    bounds = f"{low:g} to {high:g}" if isfinite(high) else f"{'>' if low_open else '>='} {low:g}"
    words = f"{describe_parameter(known, f', {bounds}')}."
    return Annotated[int if known.whole else float, Quantity(known.unit, allowed, known.whole)], words


_ESTIMATES = {
    kind: make_section(part, "velocity", f"a velocity estimate of kind {kind}", kind)
    for kind, part in ESTIMATES.items()
}
_LINEAR = {kind: section for kind, section in _ESTIMATES.items() if section.part is not FOAW}


def read_velocity(raw: Any, known: dict[str, type[PartSection]] = _LINEAR) -> Any:
    """A velocity estimate, read as what its kind names."""
    if isinstance(raw, tuple(known.values())):
        return raw
    if isinstance(raw, PartSection):
        raise problem("got a velocity estimate of kind 'foaw'", NO_LINEAR_FORM, SIMULATED)
    refused = {"foaw": (NO_LINEAR_FORM, SIMULATED)}
    section = find_kind(raw, known, "a velocity estimate", "{kind: low_pass, cutoff: 100 Hz}", refused)
    return section.model_validate(raw)


def _make_one_of(known: dict[str, type[PartSection]]) -> GetPydanticSchema:
    """Make a field one of these estimates; the schema tells them apart by their kind."""
    every = Annotated[Union[tuple(known.values())], Field(discriminator="kind")]  # noqa: UP007
    read = Annotated[every, WrapValidator(lambda raw, _: read_velocity(raw, known))]
    return GetPydanticSchema(lambda _, handler: handler.generate_schema(read))


VelocityField = Annotated[PartSection, _make_one_of(_LINEAR)]
SimulatedVelocityField = Annotated[PartSection, _make_one_of(_ESTIMATES)]
_SECTIONS: Any = {
    name: make_section(part, name, f"{'an' if name[0] in 'aeiou' else 'a'} {name}") for name, part in PARTS.items()
}
ModeSection: Any = make_section(Mode, "mode", "a mode")


class SafeLimitSection(PartSection, what="a safe limit"):
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
    """A base of what has a section for each of the parts that a scene need not have."""
    known: dict[str, Any] = {"velocity": ("Velocity estimate", VelocityField, no_estimate)}
    known |= {name: (_head(section.part)[:-1], section, no_part) for name, section in _SECTIONS.items()}
    known["modes"] = "Resonances that the sensor sees", list[ModeSection], no_part
    keys: Any = {
        name: (form | None, Field(default=None, description=f"{words}. Default: {absent}.{more}"))
        for name, (words, form, absent) in known.items()
    }
    return create_model("Parts", __base__=Strict, **keys)


def list_parts(owner: Any) -> dict[str, Any]:
    """The parts that a device, a scene or a study has, by name: a section each, of the modes a list of them."""
    # The first is a device that is no mass with damping, but given as a whole.
    found = {name: getattr(owner, name, None) for name in ("device", *PART_NAMES)}
    return {name: section for name, section in found.items() if section is not None and section != []}


def build_parts(owner: Any) -> dict[str, Any]:
    """The same as parts of a scene."""
    return {
        name: [each.known for each in section] if isinstance(section, list) else section.known
        for name, section in list_parts(owner).items()
    }
