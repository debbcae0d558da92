"""Stability of robots that measure a force and move like a virtual mass M with damping D (admittance displays).

The environment, or the hand of a user, is a spring K and a damper B between the robot and ground. A sensor measures the
contact force between robot and environment. In each period the program computes the velocity v of the virtual mass and
commands it, or the position that follows from it, to the controller of the robot.

T is the sampling period, z = e^(sT) and ``zeta = z - 1``. The delay of the command is n + f periods, with the integer
part n. With the position x and the velocity x' of the robot, the contact force at sample k is
``f_k = -K x(kT) - B x'(kT)``. Three responses describe the loop: Y(z) from f_k to the command, P(z) from the command to
x, and V(z) from the command to x'. The closed loop is

    1 + Y(z) (K P(z) + B V(z)) = 0

and its characteristic polynomial is ``M p_M(z) + D p_D(z) + K p_K(z) + B p_B(z)`` (docs/theory/admittance.md, W1 to
W4). Because this sum is linear in each factor, the stable values of one factor are the stable gains of a sampled linear
device: the gain is K for the stiffness of the environment, and 1/M for the virtual mass.
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
# Polynomials in zeta = z - 1; the coefficient of the highest power is the first one.
ZETA: Polynomial = (Fraction(1), Fraction(0))
Z: Polynomial = (Fraction(1), Fraction(1))  # z = zeta + 1
TWO: Polynomial = (Fraction(1), Fraction(2))  # z + 1 = zeta + 2
ONE: Polynomial = (Fraction(1),)


class Coefficients(NamedTuple):
    """The four polynomials in z in the characteristic polynomial ``M p_M + D p_D + K p_K + B p_B``."""

    mass: Polynomial  # p_M, multiplied by the virtual mass M
    damping: Polynomial  # p_D, multiplied by the virtual damping D
    stiffness: Polynomial  # p_K, multiplied by the stiffness K of the environment
    environment_damping: Polynomial  # p_B, multiplied by the damping B of the environment


@compact_repr(frequency="Hz")
class EnvironmentLimit(NamedTuple):
    """The largest stiffness K of the environment such that an admittance display is stable from 0 to K.

    ``stiffness`` is K in N/m, and ``frequency`` is the frequency in Hz of the oscillation at K. If even soft
    environments are unstable, both are NaN and ``status`` is NO_BOUNDARY.
    """

    stiffness: Array
    frequency: Array
    status: Array


@compact_repr(virtual_mass="kg", largest="kg", frequency="Hz")
class VirtualMassLimit(NamedTuple):
    """The smallest virtual mass with which an admittance display is stable.

    The display is stable with every mass from ``virtual_mass`` to ``largest``, both in kg; ``largest`` may be infinite.
    ``frequency`` is the frequency in Hz of the oscillation with the smallest mass. If no mass is stable, all three are
    NaN and ``status`` is NO_BOUNDARY.
    """

    virtual_mass: float
    largest: float
    frequency: float
    status: int


@dataclass(frozen=True)
class AdmittanceDisplay:
    """A position- or velocity-controlled robot that displays a virtual mass and damping to a hand or an environment.

    In each period T the program measures the contact force f. It updates the velocity v of the virtual mass and the
    position command x_ref. With the semi-implicit Euler method,

        v += T (f - D v)/M;   x_ref += T v

    and with the trapezoidal method, where the acceleration a_k is computed from the last velocity v_(k-1),

        a_k = (f_k - D v_(k-1))/M;   v_k = v_(k-1) + T (a_k + a_(k-1))/2;   x_ref += T (v_k + v_(k-1))/2

    The command to the robot is x_ref or v. Its motion is the response of its model to this command; the contact force
    does not deflect the robot.

    Args:
        virtual_mass: M in kg (kg m^2 for a rotary robot), > 0.
        virtual_damping: D in N s/m (N m s/rad), >= 0.
        robot: response of the controlled robot to its command, with gain 1 at frequency 0: a `zwidth.Actuator` for a
            lag of first or second order, or a `zwidth.LinearDevice`. A sampled `LinearDevice` includes the hold and the
            delay; it requires position commands, and an environment without a damper.
        timing: sampling period, and delay from the measurement of a force until the command computed from it acts on
            the robot; the delay need not be an integer number of periods.
        command: "position" if the command is x_ref, "velocity" if it is v.
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
        """Return a `Scene` whose wall is the spring of an environment, and whose device is the rest of the loop.

        This device includes the robot, the program and the damper of the environment. For walls with damping 0, the
        methods of the scene return the poles, the margins and the stable stiffnesses of the contact.

        Args:
            environment_stiffness: K in N/m, >= 0.
            environment_damping: B in N s/m, >= 0. Its force is B times the exact velocity of the robot at the sample.
                The velocity of a first-order robot jumps when its position command changes. If it jumps at the sample,
                the velocity before the jump is used.
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
        """Return the smallest virtual mass with which the display is stable in a hand or environment.

        The virtual damping is that of the display. The virtual mass of the display has no effect on the result. With
        masses above ``largest`` of the result, the display may be unstable again.

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
        """Store the unit system of the display in a result, for printing, and return the result."""
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
        """Integer part n of the delay in periods."""
        return int(np.floor(self.timing.d))

    @cached_property
    def _plant(self) -> LinearDevice:
        """Model of the robot, from its position or velocity command to its position."""
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
        """The polynomials p_M, p_D, p_K and p_B, computed from floats without rounding errors."""
        period = Fraction(float(self.timing.period))
        position, velocity, denominator = self._sample_plant(period)
        # The response of the virtual velocity v to the force is top/(M mass + D damping), and the response of the
        # command to v is path/integral (docs/theory/admittance.md, W1).
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
        """Return the numerators of P and V, and their common denominator, as polynomials in zeta.

        P and V are the responses of position and velocity of the robot to its command, computed from the matrices Psi
        and Gamma of the sampled robot (docs/theory/admittance.md, W2 and W3). For a robot that is given as a sampled
        system, the numerator of V is zero, because such a model does not define the velocity.
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
            """Return ``c adj(zeta - Psi) (zeta Gamma(1 - f) + Gamma(1))`` for the row c = ``output``.

            Both terms follow from determinants by the matrix determinant lemma.
            """
            first, second = (
                subtract(denominator, characteristic_polynomial(psi + np.outer(force, output)))
                for force in (late, whole)
            )
            return _add(multiply(first, ZETA), second)

        sensor = _to_fractions(np.eye(len(B))[0])
        velocity = _add(respond(_to_fractions(A[0])), multiply((Fraction(float(B[0])),), denominator))
        # The numerator of V is zero at z = 1 (W3). Set its constant coefficient to exactly 0, because a rounding error
        # would separate the pole at z = 1, a drift of the position, from the zero that cancels it.
        velocity = trim((*(value / period for value in velocity[:-1]), Fraction(0)))
        return respond(sensor), velocity, multiply(denominator, delays)

    def _make_scene(self, gain: str, factors: dict[str, float]) -> Scene:
        """Return a scene in which one of the gains 1/M, D, K and B is the stiffness of the wall.

        Args:
            gain: "mass" for 1/M; "damping", "stiffness" or "environment_damping" for D, K or B.
            factors: values of the other factors by the same names. The default of M and D is the value of the display,
                the default of K and B is 0.
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
        # With the gain 1/M, the characteristic polynomial divided by M is p_M + (1/M) rest, so p_M is the denominator.
        system = (rest, parts[gain]) if gain == "mass" else (parts[gain], rest)
        return Scene(LinearDevice(system, float(self.timing.period)), Timing(float(self.timing.period)))

    def _find_limit(self, gain: str, factors: dict[str, float]) -> tuple[float, float, int]:
        """Return the upper end of the stable interval of a gain that starts at 0, its frequency in Hz, and a status."""
        top, frequency, status, least = self._find_range(gain, factors)
        return (top, frequency, status) if least == 0 else (np.nan, np.nan, int(Status.NO_BOUNDARY))

    def _find_range(self, gain: str, factors: dict[str, float]) -> tuple[float, float, int, float]:
        """Return the lowest stable interval of a gain: upper end, frequency there in Hz, status, and lower end."""
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
    """Return the coefficients of the polynomial p(x + offset) in x, by Horner's method."""
    result: Polynomial = ()
    for value in polynomial:
        result = _add(multiply(result, (Fraction(1), Fraction(offset))), (value,)) if result else trim((value,))
    return result
