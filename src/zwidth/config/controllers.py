"""Models of the section ``controller`` of a scene: the gains of a PID or cascade controller.

A cascade is a position loop with an inner velocity loop. The gains have the units of the controller, such as turns.
They determine the keys ``stiffness``, ``virtual_damping`` and ``feedback`` of the scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
    find_given_units,
    find_output_unit,
    find_units,
    make_controller,
)
from zwidth.model.feedback import IntegrationRule
from zwidth.model.parameter_paths import spell_part
from zwidth.units.parsing import detect_kind, looks_like_number
from zwidth.units.quantities import POSITIVE

Positive = Annotated[float, Quantity(allowed=POSITIVE)]
DERIVED = ("stiffness", "virtual_damping", "feedback")  # keys of a scene whose values follow from its controller


class ControllerSection(Strict):
    """Base class of the models of PID and cascade controllers."""

    name: ClassVar[ControllerKind]

    rule: IntegrationRule = "backward"
    """Rule by which the controller computes its integral: forward in ODrive, trapezoidal in SimpleFOC."""

    units: PositionUnit | None = None
    """Position unit of the gains. Default: turns for a cascade; for a PID controller, rad, or m with a linear
    device."""

    output_unit: Positive | None = None
    """Torque in N m (linear devices: force in N) per unit of the controller's output. Default: 1."""

    torque_constant: Positive | None = None
    """Torque constant of the motor in N m/A, if the output of the controller is a current or a voltage."""

    resistance: Positive | None = None
    """Winding resistance of the motor in ohm, if the output of the controller is a voltage."""

    @property
    def gains(self) -> dict[str, float]:
        """Gains by name, in the units of the controller."""
        return {name: getattr(self, name) for name in GAIN_NAMES[self.name]}

    @cached_property
    def position_unit(self) -> PositionUnit:
        """Position unit of the gains, either the given one or the default."""
        return find_units(self.name, find_given_units(self.name, self.units), get_system().rotary)

    @property
    def output_scale(self) -> float:
        """Torque in N m, or force in N, per unit of the controller's output."""
        return find_output_unit(self.output_unit, self.torque_constant, self.resistance)

    @cached_property
    def parts(self) -> ControllerParts:
        """Wall and further feedback that follow from the gains; the position estimate is a key of the scene."""
        return make_controller(self.name, self.gains, None, self.rule, self.position_unit, self.output_scale)

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
    """Proportional gain: output per position unit."""
    ki: Number = 0.0
    """Integral gain: output per (position unit times s)."""
    kd: Number = 0.0
    """Derivative gain: output per velocity unit, i.e. per (position unit/s)."""


class CascadeSection(ControllerSection, noun="a cascade"):
    """Gains of a position loop with an inner velocity loop (ODrive, VESC, SimpleFOC)."""

    name = "cascade"

    kind: Literal["cascade"]
    pos_gain: Number
    """Gain of the position loop in 1/s."""
    vel_gain: Number
    """Gain of the velocity loop: output per velocity unit, in N m/(turn/s) for ODrive."""
    vel_integrator_gain: Number = 0.0
    """Integral gain of the velocity loop: output per position unit, in N m/turn for ODrive."""


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


def implies_rotary(scene: Any) -> bool:
    """Return whether the gains of a controller, in turns, degrees or rad, imply that the device of a scene is rotary.

    ``scene`` is the mapping of a scene. Return False if another quantity of the scene has a unit of linear devices; the
    position unit of the controller is then reported as an error.
    """
    controller = scene.get("controller") if isinstance(scene, Mapping) else None
    if (
        not isinstance(controller, Mapping)
        or scene.get("rotary") is False
        or not looks_like_number(str(scene.get("mass")))
    ):
        return False
    units = find_given_units(controller.get("kind", "pid"), controller.get("units"))
    return units in ("turns", "degrees", "rad") and all(detect_kind(value) is not False for value in scene.values())


def derive_keys(raw: dict[str, Any]) -> dict[str, Any]:
    """Return the mapping of a scene with the keys in `DERIVED` in place of the key ``controller``.

    The mapping stays unchanged if the controller is invalid, or if it also contains a key in `DERIVED`, because the
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
            # Integrate the position estimate, not the measured position, because all terms of a PID controller use it.
            derived["feedback"].setdefault("position", 1.0)
    return {**{name: value for name, value in raw.items() if name != "controller"}, **derived}


def find_second_wall(raw: dict[str, Any]) -> Iterable[LocatedProblem]:
    """Yield an error for each key of the scene that its controller already determines (`DERIVED`)."""
    for name in DERIVED if raw.get("controller") is not None else ():
        if raw.get(name) is not None:
            allowed = "the gains of the controller determine it"
            yield (name,), problem(f"got {name!r} together with a controller", allowed, "remove one", on_key=True)
