"""Models of the section ``controller`` of a scene: gains of a PID or cascade controller in the units of the controller.

The section supplies the keys ``stiffness``, ``virtual_damping`` and ``feedback`` of the scene.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationError, WrapValidator

from zwidth.config.fields import LocatedProblem, Strict, find_kind, problem
from zwidth.config.parts import parse_input_error
from zwidth.config.values import Number, Quantity, get_system
from zwidth.core.errors import InputError
from zwidth.model.controller_gains import (
    GAIN_NAMES,
    ControllerKind,
    ControllerParts,
    PositionUnit,
    find_output_unit,
    find_units,
    make_controller,
)
from zwidth.model.feedback import IntegrationRule
from zwidth.model.parameter_paths import spell_part
from zwidth.units.quantities import POSITIVE

Positive = Annotated[float, Quantity(allowed=POSITIVE)]
DERIVED = ("stiffness", "virtual_damping", "feedback")  # keys of a scene that its controller supplies


class ControllerSection(Strict):
    """Base of the models of controllers."""

    name: ClassVar[ControllerKind]

    rule: IntegrationRule = "backward"
    """Rule of integration: forward for ODrive, trapezoidal for SimpleFOC."""

    units: PositionUnit | None = None
    """Position unit of the gains. Default: turns for a cascade, rad for a PID controller; m for linear devices."""

    output_unit: Positive | None = None
    """Torque in N m (linear devices: force in N) per unit of output. Default: 1."""

    torque_constant: Positive | None = None
    """Torque constant in N m/A, if the output is a current or, with a resistance, a voltage."""

    resistance: Positive | None = None
    """Winding resistance in ohm, if the output is a voltage."""

    @cached_property
    def parts(self) -> ControllerParts:
        """Wall and feedback of the controller, without a position estimate."""
        gains = {name: getattr(self, name) for name in GAIN_NAMES[self.name]}
        output_unit = find_output_unit(self.output_unit, self.torque_constant, self.resistance)
        units = find_units(self.name, self.units, get_system().rotary)
        return make_controller(self.name, gains, None, self.rule, units, output_unit)

    def find_faults(self) -> Iterable[LocatedProblem]:
        try:
            self.parts  # noqa: B018  (raises an error if the gains are invalid)
        except InputError as error:
            yield parse_input_error(error)


class PidSection(ControllerSection, noun="a PID controller"):
    """Gains of a PID controller (moteus, SmartKnob, Arduino)."""

    name = "pid"

    kind: Literal["pid"]
    kp: Number
    """Output per position unit."""
    ki: Number = 0.0
    """Output per (position unit times s)."""
    kd: Number = 0.0
    """Output per velocity unit, i.e. per (position unit/s)."""


class CascadeSection(ControllerSection, noun="a cascade"):
    """Gains of a position loop with an inner velocity loop (ODrive, VESC, SimpleFOC)."""

    name = "cascade"

    kind: Literal["cascade"]
    pos_gain: Number
    """Gain of the position loop in 1/s."""
    vel_gain: Number
    """Output per velocity unit, in N m/(turn/s) for ODrive."""
    vel_integrator_gain: Number = 0.0
    """Output per position unit, in N m/turn for ODrive."""


_SECTIONS: dict[str, type[ControllerSection]] = {"cascade": CascadeSection, "pid": PidSection}


def read_controller(raw: Any) -> ControllerSection:
    """Return the model of a controller, selected by its key ``kind``."""
    if isinstance(raw, ControllerSection):
        return raw
    example = "{kind: cascade, pos_gain: 20, vel_gain: 0.16}"
    return find_kind(raw, _SECTIONS, "a controller", example).model_validate(raw)


ControllerField = Annotated[
    Annotated[PidSection | CascadeSection, Field(discriminator="kind")],
    WrapValidator(lambda raw, _: read_controller(raw)),
]


def derive_keys(raw: dict[str, Any]) -> dict[str, Any]:
    """Return the mapping of a scene with its controller replaced by the keys that the controller supplies.

    The mapping is returned unchanged if the controller is invalid, or if one of these keys is given too, because the
    validation of the scene then reports the problem.
    """
    if raw.get("controller") is None or raw.keys() & set(DERIVED):
        return raw
    try:
        parts = read_controller(raw["controller"]).parts
    except (ValidationError, ValueError):
        return raw
    derived: dict[str, Any] = {
        "stiffness": float(parts.wall.stiffness),
        "virtual_damping": float(parts.wall.virtual_damping),
    }
    if parts.feedback is not None:
        derived["feedback"] = {"kind": "integral", **spell_part(parts.feedback)}
        if raw.get("position") is not None:
            # The integral of a PID controller contains the position estimate, as its other terms do.
            derived["feedback"].setdefault("position", 1.0)
    return {**{name: value for name, value in raw.items() if name != "controller"}, **derived}


def find_second_wall(raw: dict[str, Any]) -> Iterable[LocatedProblem]:
    """Yield a problem for each key of a scene that its controller supplies, if both are given."""
    for name in DERIVED if raw.get("controller") is not None else ():
        if raw.get(name) is not None:
            allowed = "the gains of the controller determine it"
            yield (name,), problem(f"got {name!r} together with a controller", allowed, "remove one", on_key=True)
