"""Convert the gains of PID and cascade controllers to a wall, estimates and further feedback, and back.

A PID controller computes the force ``kp e + ki T sum(e) - kd v`` from the position error e = -x and the velocity v, so
that K = kp and B = kd. Its integral part is further feedback (`model.feedback`) with the gain ki. A *cascade* of a
position loop and a velocity loop computes

    e_v = pos_gain e - v        force = vel_gain e_v + vel_integrator_gain T sum(e_v)

so that B = vel_gain and K = pos_gain vel_gain. The integrator of the cascade is further feedback, which integrates
-e_v: ``pos_gain`` times the position estimate plus the velocity estimate.

Motor controllers measure angles in turns or degrees, and their output may be a current or a voltage. The *output unit*
is the force or torque per unit of output: the torque constant in N m/A, or the torque constant divided by the winding
resistance in N m/V.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, Literal, NamedTuple

from zwidth.core.errors import InputError, check_choice
from zwidth.core.xp import is_traced
from zwidth.model.checks import accept_units, check_number, read_texts
from zwidth.model.feedback import IntegralFeedback, IntegrationRule
from zwidth.model.position import Position, has_velocity
from zwidth.model.velocity import BackwardDifference, LowPass, Velocity
from zwidth.model.wall import VirtualWall
from zwidth.units.display import compact_repr
from zwidth.units.quantities import ANY, POSITIVE
from zwidth.units.unit_system import SYSTEMS

PositionUnit = Literal["m", "rad", "turns", "degrees"]
ControllerKind = Literal["pid", "cascade"]
_UNITS = {"m": 1.0, "rad": 1.0, "turns": 2.0 * math.pi, "degrees": math.pi / 180.0}  # size of each unit, in m or rad


@dataclass(frozen=True)
class ControllerParts:
    """Parts of a scene that describe a controller; a mapping, so that ``Scene(device, timing, **controller)`` works.

    Args:
        wall: stiffness K and damping B of the controller.
        velocity: velocity estimate.
        position: position estimate; None for the measured position.
        feedback: integral part; None for a controller without integral part.
    """

    wall: VirtualWall
    velocity: Velocity
    position: Position | None = None
    feedback: IntegralFeedback | None = None

    def keys(self) -> Iterator[str]:
        """Return the names of the parts, so that ``**controller`` passes them as keyword arguments."""
        return (item.name for item in fields(self))

    def __getitem__(self, name: str) -> Any:
        """Return the part with a given name."""
        return getattr(self, name)


@compact_repr()
class PidGains(NamedTuple):
    """Gains of a PID controller, in the units of the controller."""

    kp: float  # output per position unit
    ki: float  # output per (position unit times s)
    kd: float  # output per velocity unit, i.e. per (position unit/s)


@compact_repr()
class CascadeGains(NamedTuple):
    """Gains of a position loop with an inner velocity loop, in the units of the controller."""

    pos_gain: float  # 1/s
    vel_gain: float  # output per velocity unit, i.e. per (position unit/s)
    vel_integrator_gain: float  # output per position unit, because the integral of the velocity is a position


def _find_scale(units: PositionUnit, output_unit: float) -> float:
    """Return the factor that converts a gain of the controller to SI units: output unit divided by position unit."""
    check_choice("units", units, tuple(_UNITS))
    return _read_gain("output_unit", output_unit) / _UNITS[units]


def _read_gain(name: str, gain: Any) -> Any:
    """Convert a gain to a float; raise `InputError` if it is a text with a unit or not finite."""
    if isinstance(gain, str):
        raise InputError(
            f"{name}: got the text {gain!r}; pass a number in the unit of your controller, which the arguments units "
            "and output_unit state"
        )
    return check_number(name, gain, "1", ANY)


def _check_position(position: Any) -> None:
    """Raise `InputError` if a position estimate is neither None nor an object such as a PLL."""
    if position is not None and not isinstance(position, Position):
        raise InputError(f"position: got {position!r}; pass an object such as zwidth.Pll(bandwidth=1000), or omit it")


def pid(
    kp: float,
    ki: float = 0.0,
    kd: float = 0.0,
    *,
    derivative_filter: float | str | Velocity | None = None,
    position: Position | None = None,
    rule: IntegrationRule = "backward",
    units: PositionUnit = "rad",
    output_unit: float = 1.0,
) -> ControllerParts:
    """Return the parts of a scene for a PID controller.

    Args:
        kp: output per position unit; K = kp in SI units.
        ki: output per (position unit times s).
        kd: output per velocity unit, i.e. per (position unit/s); B = kd in SI units.
        derivative_filter: time constant in s of a first-order low-pass filter of the derivative; or any velocity
            estimate; None for the backward difference.
        position: position estimate, from which all three terms are computed; None for the measured position.
        rule: rule of integration, see `IntegralFeedback`.
        units: position unit of the gains: "m", "rad", "turns" (moteus) or "degrees".
        output_unit: force in N or torque in N m per unit of output, such as the torque constant in N m/A.

    Returns:
        A `ControllerParts`; use it as ``zwidth.Scene(device, timing, **controller)``.

    References:
        Astrom, Hagglund 2006, Advanced PID Control.

    Example:
        >>> import zwidth
        >>> controller = zwidth.pid(kp=1000, ki=2000, kd=10)
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 0), zwidth.Timing(1e-3), **controller)
        >>> print(f"{scene.spectral_radius():.5f}")
        0.99796
    """
    scale = _find_scale(units, output_unit)
    kp, ki, kd = (_read_gain(name, gain) for name, gain in (("kp", kp), ("ki", ki), ("kd", kd)))
    _check_position(position)
    velocity: Any = BackwardDifference() if derivative_filter is None else derivative_filter
    if isinstance(velocity, int | float | str):
        velocity = LowPass(time_constant=velocity)
    weight = None if position is None else 1.0
    feedback = IntegralFeedback(ki * scale, rule, weight) if is_traced(ki) or ki else None
    return ControllerParts(VirtualWall(kp * scale, kd * scale), velocity, position, feedback)


@accept_units
def pid_gains(
    stiffness: float,
    virtual_damping: float,
    integral_gain: float = 0.0,
    *,
    units: PositionUnit = "rad",
    output_unit: float = 1.0,
) -> PidGains:
    """Return the gains of a PID controller that renders a wall: the inverse of `pid`.

    Args:
        stiffness: K in N/m or N m/rad.
        virtual_damping: B in N s/m or N m s/rad.
        integral_gain: gain of the integral feedback in N/(m s) or N m/(rad s).
        units: position unit of the gains, see `pid`.
        output_unit: force or torque per unit of output, see `pid`.

    Returns:
        The gains in the units of the controller.

    References:
        Astrom, Hagglund 2006, Advanced PID Control.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.pid_gains(2.0, 0.05, units='turns').kp:.3f} N m/turn")
        12.566 N m/turn
    """
    scale = _find_scale(units, output_unit)
    integral_gain = read_texts("integral_gain", integral_gain, SYSTEMS[units != "m"]["N/(m s)"])
    return PidGains(stiffness / scale, integral_gain / scale, virtual_damping / scale)


def cascade(
    pos_gain: float,
    vel_gain: float,
    vel_integrator_gain: float = 0.0,
    *,
    position: Position | None = None,
    velocity: Velocity | None = None,
    rule: IntegrationRule = "backward",
    units: PositionUnit = "turns",
    output_unit: float = 1.0,
) -> ControllerParts:
    """Return the parts of a scene for a position loop with an inner velocity loop, as in ODrive, VESC and SimpleFOC.

    The wall is K = pos_gain vel_gain and B = vel_gain. The integrator of the velocity loop is further feedback, which
    stays fixed if an analysis varies K and B. Therefore the maximum stiffness of the scene holds for this integrator
    gain. The gain margin of the scene is a common factor on all gains, including the integrator gain.

    Args:
        pos_gain: gain of the position loop in 1/s.
        vel_gain: output per velocity unit, in N m/(turn/s) for ODrive.
        vel_integrator_gain: output per position unit, in N m/turn for ODrive.
        position: position estimate, such as ``zwidth.Pll(1000)``; None for the measured position.
        velocity: velocity estimate; None for the backward difference or, if ``position`` is an observer or PLL, for the
            velocity estimate of ``position``.
        rule: rule of integration, see `IntegralFeedback`: "backward", "forward" (ODrive), "trapezoidal" (SimpleFOC).
        units: position unit: "turns" (ODrive, moteus), "degrees", "rad" (SimpleFOC) or "m".
        output_unit: torque in N m per unit of output: 1 for a torque (ODrive), the torque constant in N m/A for a
            current, the torque constant divided by the winding resistance for a voltage (SimpleFOC).

    Returns:
        A `ControllerParts`; use it as ``zwidth.Scene(device, timing, **controller)``.

    Raises:
        InputError: if ``velocity`` is given together with an observer or PLL.

    References:
        Ellis 2012, Control System Design Guide, 4th ed. (position loop with an inner velocity loop);
            odriverobotics/ODrive ``Firmware/MotorControl/controller.cpp``;
            simplefoc/Arduino-FOC ``src/common/pid.cpp``.

    Example:
        >>> import zwidth
        >>> controller = zwidth.cascade(pos_gain=20, vel_gain=0.16, position=zwidth.Pll(bandwidth=1000))
        >>> device = zwidth.Device("1e-4 kg m^2", "1e-4 N m s/rad")
        >>> scene = zwidth.Scene(device, zwidth.Timing(rate=8e3, delay="1.5 periods"), **controller)
        >>> print(f"{scene.spectral_radius():.9f}")
        0.997411977
    """
    _check_position(position)
    if velocity is not None and has_velocity(position):
        raise InputError(f"velocity: got {velocity!r}, but {position!r} has its own velocity estimate; omit velocity")
    scale = _find_scale(units, output_unit)
    pos_gain, vel_gain = _read_gain("pos_gain", pos_gain), _read_gain("vel_gain", vel_gain)
    vel_integrator_gain = _read_gain("vel_integrator_gain", vel_integrator_gain)
    feedback = None
    if is_traced(vel_integrator_gain) or vel_integrator_gain:
        feedback = IntegralFeedback(vel_integrator_gain * scale, rule, pos_gain, 1.0)
    wall = VirtualWall(pos_gain * vel_gain * scale, vel_gain * scale)
    return ControllerParts(wall, velocity or BackwardDifference(), position, feedback)


@accept_units
def cascade_gains(
    stiffness: float,
    virtual_damping: float,
    integral_gain: float = 0.0,
    *,
    units: PositionUnit = "turns",
    output_unit: float = 1.0,
) -> CascadeGains:
    """Return the gains of a position loop with an inner velocity loop that renders a wall: the inverse of `cascade`.

    Args:
        stiffness: K in N/m or N m/rad.
        virtual_damping: B in N s/m or N m s/rad, not 0.
        integral_gain: gain of the integrator of the velocity loop, in N/m or N m/rad.
        units: position unit of the gains, see `cascade`.
        output_unit: force or torque per unit of output, see `cascade`.

    Returns:
        ``pos_gain = K/B``, ``vel_gain = B`` and ``vel_integrator_gain`` in the units of the controller. The
        integrator of the scene must contain the same ``pos_gain``. `zwidth.Scene.recommend` returns such a scene.

    Raises:
        InputError: if the damping is 0, because a cascade renders a spring only together with a damper.

    References:
        Ellis 2012, Control System Design Guide, 4th ed. (position loop with an inner velocity loop).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.cascade_gains(0.509, 0.0255).pos_gain:.2f} 1/s")
        19.96 1/s
    """
    if not virtual_damping:
        raise InputError("virtual_damping: got 0; a cascade needs damping, K = pos_gain B; pass a value other than 0")
    scale = _find_scale(units, output_unit)
    integral_gain = read_texts("integral_gain", integral_gain, SYSTEMS[units != "m"]["N/m"])
    return CascadeGains(stiffness / virtual_damping, virtual_damping / scale, integral_gain / scale)


def find_gains(
    wall: VirtualWall,
    feedback: Any,
    kind: ControllerKind,
    units: PositionUnit,
    output_unit: float = 1.0,
) -> PidGains | CascadeGains:
    """Return the gains of a controller that renders a wall with integral feedback.

    Args:
        wall: K and B.
        feedback: further feedback of the scene: None or an `IntegralFeedback`.
        kind: "pid" or "cascade".
        units: position unit of the gains, see `cascade`.
        output_unit: force or torque per unit of output, see `cascade`.

    Raises:
        InputError: if the further feedback is not the integrator of a controller of this kind.
    """
    K, B = float(wall.stiffness), float(wall.virtual_damping)
    integral, is_cascade = 0.0, kind == "cascade"
    if feedback is not None:
        integrated = isinstance(feedback, IntegralFeedback) and feedback.is_cascade == is_cascade
        if is_cascade and integrated:
            # Compare pos_gain B with K, because B may be small; K and B may be rounded to six digits.
            integrated = abs(feedback.position / feedback.velocity * B - K) <= 1e-5 * abs(K)
        if not integrated or (not is_cascade and feedback.velocity):
            allowed = "the integrator of a cascade with pos_gain = K/B" if is_cascade else "an integral of the position"
            raise InputError(f"feedback: got {feedback!r}; these gains require {allowed}, or no feedback")
        weight = feedback.velocity if is_cascade else 1.0 if feedback.position is None else feedback.position
        integral = feedback.gain * weight
    convert: Any = cascade_gains if is_cascade else pid_gains
    return convert(K, B, integral, units=units, output_unit=output_unit)


GAIN_NAMES: dict[str, tuple[str, ...]] = {"pid": PidGains._fields, "cascade": CascadeGains._fields}
"""Names of the gains of the two kinds of controllers, "pid" and "cascade"."""


def find_output_unit(output_unit: float | None, torque_constant: float | None, resistance: float | None) -> float:
    """Return the force or torque per unit of output of a controller.

    Args:
        output_unit: the force in N or torque in N m per unit of output.
        torque_constant: torque constant in N m/A of a motor whose current is the output.
        resistance: winding resistance in ohm, if the output is a voltage; requires ``torque_constant``.

    Returns:
        ``output_unit``; or the torque constant, divided by the resistance if given; or 1 without any argument.
    """
    given = {"output_unit": output_unit, "torque_constant": torque_constant, "resistance": resistance}
    numbers = {name: check_number(name, value, "1", POSITIVE) for name, value in given.items() if value is not None}
    if "output_unit" in numbers and len(numbers) > 1:
        raise InputError(f"output_unit: got {output_unit} and torque_constant or resistance; give only one of them")
    if "resistance" in numbers and "torque_constant" not in numbers:
        raise InputError(f"resistance: got {resistance} without torque_constant; give torque_constant too")
    return numbers.get("output_unit", numbers.get("torque_constant", 1.0) / numbers.get("resistance", 1.0))


def find_given_units(kind: ControllerKind, units: PositionUnit | None) -> PositionUnit | None:
    """Return the position unit of given gains; without ``units``, "turns" for a cascade and None for a PID controller.

    None means that the kind of device, rotary or linear, determines the position unit.
    """
    return "turns" if units is None and kind == "cascade" else units


def find_units(kind: ControllerKind, units: PositionUnit | None, rotary: bool) -> PositionUnit:
    """Return the position unit of the gains of a controller, checked against the kind of device.

    Args:
        kind: "pid" or "cascade".
        units: the position unit; None for "m" with a linear device, and for "turns" (cascade) or "rad" (PID) with a
            rotary device.
        rotary: True for a rotary device.
    """
    if units is None:
        return "m" if not rotary else "turns" if kind == "cascade" else "rad"
    check_choice("units", units, tuple(_UNITS))
    if (units == "m") == rotary:
        default = " (default of a cascade)" if (kind, units) == ("cascade", "turns") else ""
        linear = "m, or write the inertia in a rotary unit, such as '1e-4 kg m^2'"
        allowed = "turns, degrees or rad" if rotary else linear
        raise InputError(
            f"units: got {units!r}{default} for a {'rotary' if rotary else 'linear'} device; use {allowed}"
        )
    return units


def make_controller(
    kind: ControllerKind,
    gains: dict[str, float],
    position: Position | None,
    rule: IntegrationRule,
    units: PositionUnit,
    output_unit: float,
) -> ControllerParts:
    """Convert the gains of a controller, given by name, to parts of a scene; see `pid` and `cascade`."""
    options: Any = {"position": position, "rule": rule, "units": units, "output_unit": output_unit}
    return cascade(**gains, **options) if kind == "cascade" else pid(**gains, **options)
