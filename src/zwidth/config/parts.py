"""The parts of a scene beside device and timing, as a configuration has them: velocity estimate, hand and coupling.

Each section below has the keys of the part of that name in `zwidth.parts`, and gives that part.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema, WrapValidator

from zwidth.config.axes import read_entries
from zwidth.config.faults import LocatedProblem, listing, problem, validation_error
from zwidth.config.fields import Quantity, Strict
from zwidth.config.numbers import number, whole_number
from zwidth.errors import InputError
from zwidth.formatting import describe, suggestion
from zwidth.parts.coupling import Coupling
from zwidth.parts.operator import Operator
from zwidth.parts.velocity import (
    FOAW,
    BackwardDifference,
    Butterworth,
    LowPass,
    Velocity,
    VelocityFilter,
    WindowedDifference,
)
from zwidth.quantities import NOT_NEGATIVE, PARAMETERS, POSITIVE, Range

PARTS = ("velocity", "operator", "coupling")

NO_LINEAR_FORM = "FOAW chooses its window by the motion and has no linear form"
SIMULATED = "use the kind 'simulate' or 'limit_cycle', or a linear estimate such as 'windowed_difference'"


def locate_refusal(error: InputError) -> LocatedProblem:
    """What a part or a scene refuses, at the field that its message names."""
    field, _, text = str(error).partition(": ")
    what, _, rest = text.partition("; ")
    allowed, _, remedy = rest.partition("; ")
    return tuple(field.split(".")), problem(what, allowed, remedy)


class PartSection(Strict):
    """Base of the sections: what the keys give is checked by the part itself."""

    part: ClassVar[Any]

    def to_part(self) -> Any:
        """The part of the scene."""
        given = {name: getattr(self, name) for name in type(self).model_fields if name != "kind"}
        return self.part(**given)

    def limits(self) -> Iterable[LocatedProblem]:
        try:
            self.to_part()
        except InputError as error:
            path, what = locate_refusal(error)
            yield path[1:], what


Samples = Annotated[int, BeforeValidator(whole_number(PARAMETERS["velocity.samples"].allowed))]
Order = Annotated[int, BeforeValidator(whole_number(PARAMETERS["velocity.order"].allowed))]
Frequency = Annotated[float, Quantity("Hz", POSITIVE)]
Time = Annotated[float, Quantity("s", POSITIVE)]
Spring = Annotated[float, Quantity("N/m", POSITIVE)]
GroundSpring = Annotated[float, Quantity("N/m", NOT_NEGATIVE)]
HandMass = Annotated[float, Quantity("kg", NOT_NEGATIVE)]
Damping = Annotated[float, Quantity("N s/m", NOT_NEGATIVE)]
Mass = Annotated[float, Quantity("kg", POSITIVE)]


def _read_coefficients(raw: Any) -> tuple[float, ...]:
    if not isinstance(raw, list | tuple):
        raise problem(f"got {describe(raw)}", "coefficients are a list, highest power first", "write [1000, -1000]")
    return read_entries(raw, number(), distinct=False)


Coefficients = Annotated[
    tuple[float, ...],
    BeforeValidator(_read_coefficients),
    PlainSerializer(list, return_type=list[float]),
    WithJsonSchema({"type": "array", "items": {"type": "number"}, "minItems": 1}),
]


class _CodedSection(PartSection):
    """What all estimates but a free filter have."""

    coded_period: Time | None = None
    """The period that the formula was written for, in s or with a unit; the loop's where left out."""


class BackwardDifferenceSection(_CodedSection):
    """The difference of two samples over the period, the default."""

    what: ClassVar[str] = "a velocity estimate of kind backward_difference"
    part: ClassVar[Any] = BackwardDifference

    kind: Literal["backward_difference"]


class WindowedDifferenceSection(_CodedSection):
    """The mean velocity of the last n periods."""

    what: ClassVar[str] = "a velocity estimate of kind windowed_difference"
    part: ClassVar[Any] = WindowedDifference

    kind: Literal["windowed_difference"]

    samples: Samples
    """Length n of the window in periods, 1 to 1000."""


class LowPassSection(_CodedSection):
    """The difference behind one or two equal first-order low-passes."""

    what: ClassVar[str] = "a velocity estimate of kind low_pass"
    part: ClassVar[Any] = LowPass

    kind: Literal["low_pass"]

    cutoff: Frequency | None = None
    """Cut-off in Hz or with a unit, below half the sampling rate; give it or time_constant."""

    time_constant: Time | None = None
    """Time constant in s or with a unit; give it or cutoff."""

    order: Order = 1
    """Number of low-passes, 1 or 2."""


class ButterworthSection(_CodedSection):
    """The difference behind a Butterworth low-pass."""

    what: ClassVar[str] = "a velocity estimate of kind butterworth"
    part: ClassVar[Any] = Butterworth

    kind: Literal["butterworth"]

    cutoff: Frequency
    """Cut-off in Hz or with a unit, below half the sampling rate."""

    order: Order = 2
    """Order, 1 to 8."""


class FilterSection(PartSection):
    """Any linear estimate, from position in m to velocity in m/s."""

    what: ClassVar[str] = "a velocity estimate of kind filter"
    part: ClassVar[Any] = VelocityFilter

    kind: Literal["filter"]

    numerator: Coefficients
    """Coefficients of the numerator in 1/s, highest power of z first."""

    denominator: Coefficients
    """Coefficients of the denominator, highest power of z first; its roots lie inside the unit circle."""


class FOAWSection(PartSection):
    """First-order adaptive windowing, for simulations."""

    what: ClassVar[str] = "a velocity estimate of kind foaw"
    part: ClassVar[Any] = FOAW

    kind: Literal["foaw"]

    noise: Annotated[float, Quantity("m", POSITIVE)]
    """The largest error of a measured position in m or with a unit, > 0: one count of an encoder."""

    samples: Annotated[int, BeforeValidator(whole_number(Range(1, 64)))] = 15
    """The longest window in periods, 1 to 64."""


LinearVelocity: TypeAlias = (
    BackwardDifferenceSection | WindowedDifferenceSection | LowPassSection | ButterworthSection | FilterSection
)
_LINEAR: dict[str, type[PartSection]] = {
    "backward_difference": BackwardDifferenceSection,
    "windowed_difference": WindowedDifferenceSection,
    "low_pass": LowPassSection,
    "butterworth": ButterworthSection,
    "filter": FilterSection,
}
_ESTIMATES = {**_LINEAR, "foaw": FOAWSection}


def read_velocity(raw: Any, known: dict[str, type[PartSection]] = _LINEAR) -> Any:
    """A velocity estimate, read as what its kind names."""
    if isinstance(raw, tuple(known.values())):
        return raw
    if isinstance(raw, FOAWSection):
        raise problem("got a velocity estimate of kind 'foaw'", NO_LINEAR_FORM, SIMULATED)
    kinds = f"a velocity estimate is a mapping with one of the kinds {listing(known)}"
    if not isinstance(raw, dict):
        raise problem(f"got {describe(raw)}", kinds, "write {kind: low_pass, cutoff: 100 Hz}")
    if "kind" not in raw:
        raise validation_error("velocity", [(("kind",), problem("missing", kinds, "add 'kind: low_pass'"))])
    kind = raw["kind"]
    if not isinstance(kind, str) or kind not in known:
        allowed, remedy = f"the kinds are {listing(known)}", suggestion(kind, known, "write one of these")
        if kind == "foaw":
            allowed, remedy = NO_LINEAR_FORM, SIMULATED
        raise validation_error("velocity", [(("kind",), problem(f"got {describe(kind)}", allowed, remedy))])
    return known[kind].model_validate(raw)


VelocityField = Annotated[
    Annotated[LinearVelocity, Field(discriminator="kind")], WrapValidator(lambda raw, _: read_velocity(raw))
]
SimulatedVelocityField = Annotated[
    Annotated[LinearVelocity | FOAWSection, Field(discriminator="kind")],
    WrapValidator(lambda raw, _: read_velocity(raw, _ESTIMATES)),
]


class OperatorSection(PartSection):
    """The hand that holds the device."""

    what: ClassVar[str] = "an operator"
    part: ClassVar[Any] = Operator

    mass: HandMass = 0.0
    """Mass of the hand in kg or with a unit, >= 0; > 0 behind a spring."""

    damping: Damping = 0.0
    """Damping of the hand to ground in N s/m or with a unit, >= 0."""

    stiffness: GroundSpring = 0.0
    """Stiffness of the hand to ground in N/m or with a unit, >= 0."""

    coupling_stiffness: Spring | None = None
    """Spring between hand and device in N/m or with a unit, > 0; a rigid grasp where left out."""

    coupling_damping: Damping = 0.0
    """Damper beside that spring in N s/m or with a unit, >= 0."""


class CouplingSection(PartSection):
    """The mass beyond a spring and damper of the device itself."""

    what: ClassVar[str] = "a coupling"
    part: ClassVar[Any] = Coupling

    mass: Mass
    """Mass on the tip's side in kg or with a unit, > 0."""

    stiffness: Spring
    """Spring between motor and tip in N/m or with a unit, > 0."""

    damping: Damping = 0.0
    """Damper between motor and tip in N s/m or with a unit, >= 0."""

    sensor: Literal["motor", "tip"] = "motor"
    """Where the position is measured."""


def list_parts(owner: Any) -> dict[str, Any]:
    """The parts that a device, a scene or a study has, by name."""
    found = {name: getattr(owner, name, None) for name in PARTS}
    return {name: part for name, part in found.items() if part is not None}


def build_velocity(section: PartSection | None) -> Velocity:
    """The velocity estimate of a section, the backward difference where there is none."""
    return section.to_part() if section is not None else BackwardDifference()
