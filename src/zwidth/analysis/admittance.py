"""Admittance displays: robots that measure a force and move as a virtual mass and damper would.

A force sensor measures the contact force f between the robot and its environment (or the hand of a user). The program
computes the velocity v of a virtual mass M with a virtual damping D, and the robot follows this motion with its own
position or velocity controller. The environment is a spring K and a damper B between the robot and ground. The roles of
device and wall are exchanged: the program displays a mass, and the environment is the spring.

Symbols: T is the sampling period, z = e^(sT), ``zeta = z - 1``, and n + f the delay of the command in periods, with the
integer part n. With the position x and the velocity x' of the robot, the force at sample k is
``f_k = -K x(kT) - B x'(kT)``. Let Y(z) be the response of the command to f, P(z) that of x to the command, and V(z)
that of x' to the command. The loop is

    1 + Y(z) (K P(z) + B V(z)) = 0

Its characteristic polynomial is a sum of four polynomials with the factors M, D, K and B (docs/theory/admittance.md,
W1 to W4). If three factors are given, the loop is that of a sampled linear device whose gain is the fourth: K for the
stiffness of the environment, or 1/M for the virtual mass.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, reduce
from typing import Any, Literal, NamedTuple

import numpy as np

from zwidth.analysis.scene import Scene
from zwidth.core.errors import InputError, check_choice
from zwidth.core.status import Status
from zwidth.core.types import Array, ArrayLike
from zwidth.model.actuator import Actuator
from zwidth.model.checks import check_number, find_kind, read_texts
from zwidth.model.exact_polynomials import Polynomial, characteristic_polynomial, multiply, subtract, trim
from zwidth.model.linear_device import LinearDevice
from zwidth.model.linear_plant import System
from zwidth.model.timing import Timing
from zwidth.model.velocity import Estimate
from zwidth.numerics.evaluate import as_float64
from zwidth.plant.sampled_states import sample_states
from zwidth.units.display import compact_repr
from zwidth.units.quantities import NOT_NEGATIVE, POSITIVE, Range
from zwidth.units.unit_system import SYSTEMS

Command = Literal["position", "velocity"]
Integrator = Literal["semi-implicit", "trapezoidal"]
ZETA: Polynomial = (Fraction(1), Fraction(0))
Z: Polynomial = (Fraction(1), Fraction(1))  # z = zeta + 1
TWO: Polynomial = (Fraction(1), Fraction(2))  # z + 1 = zeta + 2
ONE: Polynomial = (Fraction(1),)


class Coefficients(NamedTuple):
    """The four polynomials in z whose sum, with the factors M, D, K and B, is the characteristic polynomial."""

    mass: Polynomial
    damping: Polynomial
    stiffness: Polynomial
    environment_damping: Polynomial


@compact_repr(frequency="Hz")
class EnvironmentLimit(NamedTuple):
    """The largest stiffness of the environment up to which an admittance display is stable.

    ``stiffness`` is in N/m, ``frequency`` that of the oscillation at this stiffness in Hz. Without a stable stiffness
    both are NaN, and ``status`` is NO_BOUNDARY.
    """

    stiffness: Array
    frequency: Array
    status: Array


@compact_repr(virtual_mass="kg", largest="kg", frequency="Hz")
class VirtualMassLimit(NamedTuple):
    """The smallest virtual mass with which an admittance display is stable.

    All masses from ``virtual_mass`` to ``largest`` (in kg, or infinite) are stable; ``frequency`` is that of the
    oscillation with the smallest one, in Hz. Without a stable mass, all three are NaN, and ``status`` is NO_BOUNDARY.
    """

    virtual_mass: float
    largest: float
    frequency: float
    status: int


@dataclass(frozen=True)
class AdmittanceDisplay:
    """A position- or velocity-controlled robot that displays a virtual mass and damping to a hand or an environment.

    In each period T the program measures the contact force f and updates the velocity v of the virtual mass. With the
    semi-implicit Euler method,

        v += T (f - D v)/M;   x_ref += T v

    and with the trapezoidal method, with the acceleration a computed from the last velocity,

        a_k = (f_k - D v_(k-1))/M;   v_k = v_(k-1) + T (a_k + a_(k-1))/2;   x_ref += T (v_k + v_(k-1))/2

    The robot follows x_ref, or v if it is commanded in velocity, exactly as its model states. The contact force does
    not deflect the robot.

    Args:
        virtual_mass: M in kg (kg m^2 for a rotary robot), > 0.
        virtual_damping: D in N s/m (N m s/rad), >= 0.
        robot: response of the controlled robot to its command, with gain 1 at frequency 0: a `zwidth.Actuator` for a
            lag of first or second order, or a `zwidth.LinearDevice`. A sampled `LinearDevice` (position command only)
            includes hold and delay, and allows an environment without damper only.
        timing: sampling period, and delay from the force measurement to the change of the command that the robot
            follows; the delay may be any number of periods.
        command: "position" if the robot follows x_ref, "velocity" if it follows v.
        integrator: "semi-implicit" or "trapezoidal".

    Raises:
        InputError: an argument is out of range or has a wrong unit or type.

    References:
        Keemink, van der Kooij, Stienen 2018, International Journal of Robotics Research 37(11), 1421-1444 (review).
        UniversalRobots/URScript_Examples, admittance_control.script (trapezoidal, velocity command).

    Example:
        >>> import zwidth
        >>> display = zwidth.AdmittanceDisplay(
        ...     virtual_mass=20,
        ...     virtual_damping=60,
        ...     robot=zwidth.Actuator(time_constant="20 ms"),
        ...     timing=zwidth.Timing(rate="500 Hz", delay="4 periods"),
        ...     command="velocity",
        ...     integrator="trapezoidal",
        ... )
        >>> display.max_environment_stiffness()
        EnvironmentLimit(stiffness=2.16008 kN/m, frequency=1.60773 Hz, status=OK)
    """

    virtual_mass: Any
    virtual_damping: Any
    robot: Any
    timing: Timing
    command: Command = "position"
    integrator: Integrator = "semi-implicit"

    def __post_init__(self) -> None:
        given = {name: getattr(self, name) for name in ("virtual_mass", "virtual_damping")}
        object.__setattr__(self, "rotary", bool(find_kind(given)))
        for name, unit, allowed in (("virtual_mass", "kg", POSITIVE), ("virtual_damping", "N s/m", NOT_NEGATIVE)):
            value = check_number(name, given[name], SYSTEMS[self.rotary][unit], allowed)
            object.__setattr__(self, name, value)
        check_choice("command", self.command, ("position", "velocity"))
        check_choice("integrator", self.integrator, ("semi-implicit", "trapezoidal"))
        if not isinstance(self.timing, Timing):
            raise InputError(f"timing: got {self.timing!r}; pass an object such as zwidth.Timing(period=1e-3)")
        if not isinstance(self.robot, Actuator | LinearDevice):
            raise InputError(
                f"robot: got {self.robot!r}; pass zwidth.Actuator(time_constant=20e-3), or a zwidth.LinearDevice from "
                "commanded to actual motion"
            )
        if self.command == "velocity" and isinstance(self.robot, LinearDevice) and self.robot.dt:
            raise InputError("robot: got a sampled system with a velocity command; use its response to position")
        if self._plant.dt:
            System(self._plant, self.timing.period, 1.0, self.timing.d, self._n_delay, Estimate()).check()

    rotary = False
    """True if virtual mass and damping have rotary units."""

    def scene(self, environment_stiffness: Any = 0.0, environment_damping: Any = 0.0) -> Scene:
        """Return the loop with an environment as a `Scene`, whose wall is the spring of the environment.

        The damper of the environment is part of the scene's device. All questions of a scene about walls without
        damping are questions about the stiffness of the environment: poles, margins, and intervals of stable stiffness.

        Args:
            environment_stiffness: K in N/m, >= 0.
            environment_damping: B in N s/m, >= 0, on the exact velocity of the robot at the sample. If the velocity
                jumps at the sample, because a first-order robot follows a new position, it is that before the jump.
        """
        stiffness, damping = self._read_environment(environment_stiffness, environment_damping)
        scene = self._make_scene("stiffness", {"environment_damping": damping})
        return scene.replace(stiffness=stiffness, virtual_damping=0.0)

    def is_stable(self, environment_stiffness: ArrayLike, environment_damping: ArrayLike = 0.0) -> np.ndarray:
        """Return whether the display is stable in contact with environments; Boolean array of the broadcast shape.

        Args:
            environment_stiffness: K in N/m, > 0.
            environment_damping: B in N s/m, >= 0.
        """
        K, B = np.broadcast_arrays(*self._read_environments(environment_stiffness, environment_damping))
        labels = np.zeros(K.shape, bool)
        for damping in np.unique(B[np.isfinite(B)]).tolist():
            chosen = damping == B
            labels[chosen] = self.scene(0.0, damping).is_stable(K[chosen], 0.0)
        return labels[()]

    def max_environment_stiffness(self, environment_damping: ArrayLike = 0.0) -> EnvironmentLimit:
        """Return the largest stiffness K of the environment such that the display is stable from 0 to K.

        Args:
            environment_damping: damping B of the environment in N s/m, >= 0; a number or an array.

        Returns:
            Stiffness in N/m and frequency in Hz, of the shape of the damping. The relative error is about 1e-12.
        """
        B = self._read_environments(0.0, environment_damping)[1]
        limits = [self._find_limit("stiffness", {"environment_damping": b}) for b in B.ravel().tolist()]
        columns = (np.array(column).reshape(B.shape)[()] for column in zip(*limits, strict=True))
        return self._label(EnvironmentLimit(*columns))

    def min_virtual_mass(self, hand_stiffness: Any, hand_damping: Any = 0.0) -> VirtualMassLimit:
        """Return the smallest virtual mass that is stable in a hand, or an environment, of given stiffness.

        The virtual damping is that of the display; its virtual mass has no effect. Masses that are too large may be
        unstable as well.

        Args:
            hand_stiffness: K in N/m, > 0.
            hand_damping: B in N s/m, >= 0.

        Example:
            >>> import zwidth
            >>> robot, timing = zwidth.Actuator(time_constant="5 ms"), zwidth.Timing(rate="1 kHz", delay="2 periods")
            >>> display = zwidth.AdmittanceDisplay(5, 20, robot, timing)
            >>> display.min_virtual_mass(hand_stiffness=500)
            VirtualMassLimit(virtual_mass=10.0125 g, largest=inf kg, frequency=500 Hz, status=OK)
        """
        K, B = self._read_environment(hand_stiffness, hand_damping, "hand", POSITIVE)
        gain, frequency, status, least = self._find_range("mass", {"stiffness": K, "environment_damping": B})
        largest = np.inf if least == 0 else 1.0 / least
        return self._label(VirtualMassLimit(1.0 / gain, largest, frequency, status))

    def _label(self, result: Any) -> Any:
        """Return a result with the unit system of the display, for printing."""
        result.unit_system = SYSTEMS[self.rotary]
        return result

    def _read_environment(
        self, stiffness: Any, damping: Any, name: str = "environment", allowed: Range = NOT_NEGATIVE
    ) -> tuple[float, float]:
        """Return stiffness and damping of one environment in SI units; raise `InputError` if one is out of range.

        Args:
            stiffness: K, a number or a text with a unit.
            damping: B, a number or a text with a unit.
            name: beginning of the names of both arguments, for messages.
            allowed: allowed range of the stiffness.
        """
        units = SYSTEMS[self.rotary]
        K = check_number(f"{name}_stiffness", stiffness, units["N/m"], allowed)
        return K, check_number(f"{name}_damping", damping, units["N s/m"], NOT_NEGATIVE)

    def _read_environments(self, stiffness: Any, damping: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return arrays of stiffness and damping in SI units; raise `InputError` if a damping is negative."""
        units = SYSTEMS[self.rotary]
        texts = (("environment_stiffness", stiffness, "N/m"), ("environment_damping", damping, "N s/m"))
        K, B = (np.asarray(as_float64(name, read_texts(name, value, units[unit]))) for name, value, unit in texts)
        if np.any(~(B >= 0)):
            raise InputError(f"environment_damping: got {float(B[~(B >= 0)].flat[0]):g} N s/m; it must be >= 0")
        return K, B

    @property
    def _n_delay(self) -> int:
        """Integer part of the delay in periods."""
        return int(np.floor(self.timing.d))

    @cached_property
    def _plant(self) -> LinearDevice:
        """Response of the position of the robot to its command."""
        device = self.robot
        if isinstance(device, Actuator):
            w = float(device.rate)
            lags = {1: ([w], [1.0, w]), 2: ([w * w], [1.0, 2.0 * float(device.damping_ratio or 0.0) * w, w * w])}
            device = LinearDevice(lags[device.order])
        if self.command == "position":
            return device
        numerator, denominator, _ = device.system
        return LinearDevice((numerator, (*denominator, Fraction(0))))

    @cached_property
    def _coefficients(self) -> Coefficients:
        """The polynomials of the mass, the damping, the spring and the damper, computed exactly from floats."""
        period = Fraction(float(self.timing.period))
        position, velocity, denominator = self._sample_plant(period)
        # The virtual velocity is v = top/(M mass + D damping) f (docs/theory/admittance.md, W1).
        top, mass, damping = (period,), ZETA, (period,)
        top = multiply(top, Z)
        path, integral = multiply((period,), Z), ZETA
        if self.integrator == "trapezoidal":
            half = (period / 2,)
            top = reduce(multiply, (half, Z, TWO))
            mass, damping = multiply(Z, ZETA), multiply(half, TWO)
            path = multiply(half, TWO)
        if self.command == "velocity":
            path, integral = ONE, ONE
        common, forward = multiply(integral, denominator), multiply(top, path)
        parts = (multiply(mass, common), multiply(damping, common), multiply(forward, position))
        return Coefficients(*map(_in_z, (*parts, multiply(forward, velocity))))

    def _sample_plant(self, period: Fraction) -> tuple[Polynomial, Polynomial, Polynomial]:
        """Return P, V and their common denominator as polynomials in zeta (docs/theory/admittance.md, W2 and W3).

        The polynomial of V is zero for a sampled robot, whose velocity is unknown.
        """
        delays = reduce(multiply, [Z] * (self._n_delay + 1), ONE)
        if self._plant.dt:
            numerator, denominator = (_in_zeta(part) for part in self._plant.system[:2])
            return multiply(numerator, Z), (), multiply(denominator, delays)
        T = float(self.timing.period)
        system = System(self._plant, T, T * T, self.timing.d, self._n_delay, Estimate())
        system.check()
        states, (A, B, _) = sample_states(system), system.realize()
        psi = _to_fractions(states.psi)
        whole = _to_fractions(states.full)
        late = whole if states.late is None else _to_fractions(states.late)
        denominator = characteristic_polynomial(psi)

        def respond(output: np.ndarray) -> Polynomial:
            """Return ``c adj(zeta - Psi) (zeta Gamma(1 - f) + Gamma(1))`` by the matrix determinant lemma."""
            first, second = (
                subtract(denominator, characteristic_polynomial(psi + np.outer(force, output)))
                for force in (late, whole)
            )
            return _add(multiply(first, ZETA), second)

        sensor = _to_fractions(np.eye(len(B))[0])
        velocity = _add(respond(_to_fractions(A[0])), multiply((Fraction(float(B[0])),), denominator))
        # At z = 1 the velocity per command has no pole that the position lacks, so its constant coefficient is exactly
        # 0 (W3); without rounding error, the drift of the virtual position cancels exactly.
        velocity = trim((*(value / period for value in velocity[:-1]), Fraction(0)))
        return respond(sensor), velocity, multiply(denominator, delays)

    def _make_scene(self, gain: str, factors: dict[str, float]) -> Scene:
        """Return the scene in which the factor ``gain`` (or 1/M for "mass") is the stiffness of the wall.

        Args:
            gain: name of a field of `Coefficients`.
            factors: values of the other factors that differ from those of the display; K and B are 0 by default.
        """
        if self._plant.dt and factors.get("environment_damping"):
            raise InputError(
                "environment_damping: got a damper with a sampled robot, whose velocity is unknown; use a model in s"
            )
        mass, damping = Fraction(float(self.virtual_mass)), Fraction(float(self.virtual_damping))
        values = {"mass": mass, "damping": damping} | {name: Fraction(value) for name, value in factors.items()}
        parts = self._coefficients._asdict()
        rest = reduce(
            _add, (multiply((values[name],), part) for name, part in parts.items() if name != gain and values.get(name))
        )
        # For the mass, divide the characteristic polynomial by M: its polynomial is then the denominator.
        system = (rest, parts[gain]) if gain == "mass" else (parts[gain], rest)
        return Scene(LinearDevice(system, float(self.timing.period)), Timing(float(self.timing.period)))

    def _find_limit(self, gain: str, factors: dict[str, float]) -> tuple[float, float, int]:
        """Return the upper end of the stable interval of a gain from 0, its frequency in Hz, and a status."""
        top, frequency, status, least = self._find_range(gain, factors)
        return (top, frequency, status) if least == 0 else (np.nan, np.nan, int(Status.NO_BOUNDARY))

    def _find_range(self, gain: str, factors: dict[str, float]) -> tuple[float, float, int, float]:
        """Return the first stable interval of a gain: upper end, frequency in Hz, status and lower end."""
        scene = self._make_scene(gain, factors)
        intervals = scene.stable_stiffness(0.0)
        intervals = intervals[intervals[:, 1] > 0]
        if not intervals.size:
            return np.nan, np.nan, int(Status.NO_BOUNDARY), np.nan
        low, high = intervals[0].tolist()
        pole = scene.dominant_pole(high, 0.0)
        return high, float(pole.frequency), int(pole.status), max(low, 0.0)


def _to_fractions(values: Any) -> np.ndarray:
    """Return an array of floats as exact fractions."""
    floats = np.asarray(values, float)
    return np.array([Fraction(value) for value in floats.ravel().tolist()], object).reshape(floats.shape)


def _add(one: Polynomial, other: Polynomial) -> Polynomial:
    """Return the sum of two polynomials."""
    return subtract(one, tuple(-value for value in other))


def _in_z(polynomial: Polynomial) -> Polynomial:
    """Return the coefficients in z of a polynomial in zeta = z - 1."""
    return _substitute(polynomial, -1)


def _in_zeta(polynomial: Polynomial) -> Polynomial:
    """Return the coefficients in zeta of a polynomial in z = zeta + 1."""
    return _substitute(polynomial, 1)


def _substitute(polynomial: Polynomial, offset: int) -> Polynomial:
    """Return the coefficients of p(x + offset) by Horner's method."""
    result: Polynomial = ()
    for value in polynomial:
        result = _add(multiply(result, (Fraction(1), Fraction(offset))), (value,)) if result else trim((value,))
    return result
