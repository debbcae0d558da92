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

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from zwidth.analysis.admittance_code import write_code
from zwidth.analysis.admittance_loop import AdmittanceLoop, Command, Integrator, add, find_loop
from zwidth.analysis.admittance_motion import simulate
from zwidth.analysis.environment_limits import find_limits
from zwidth.analysis.scene import Scene
from zwidth.core.errors import InputError, check_choice
from zwidth.core.pytrees import list_leaves
from zwidth.core.status import Status
from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import is_traced
from zwidth.model.actuator import Actuator
from zwidth.model.checks import Part, check_number, find_kind, read_texts
from zwidth.model.exact_polynomials import multiply
from zwidth.model.linear_device import LinearDevice
from zwidth.model.timing import Timing
from zwidth.numerics.evaluate import as_float64, broadcast, broadcast_traced
from zwidth.units.display import compact_repr
from zwidth.units.quantities import NOT_NEGATIVE, POSITIVE, Range
from zwidth.units.unit_system import SYSTEMS

# Unit (for a linear robot) and allowed range of each argument of `AdmittanceDisplay.max_environment_stiffness`.
_QUANTITIES = {
    "virtual_mass": ("kg", POSITIVE),
    "virtual_damping": ("N s/m", NOT_NEGATIVE),
    "environment_damping": ("N s/m", NOT_NEGATIVE),
}


_UNSTABLE = "The display is unstable even in soft environments; change the virtual damping or reduce the delay."


@compact_repr(messages={Status.NO_BOUNDARY: _UNSTABLE}, frequency="Hz")
class EnvironmentLimit(NamedTuple):
    """The largest stiffness K of the environment such that an admittance display is stable from 0 to K.

    ``stiffness`` is K in N/m, and ``frequency`` is the frequency in Hz of the oscillation at K. If even soft
    environments are unstable, both are NaN and ``status`` is NO_BOUNDARY.
    """

    stiffness: Array
    frequency: Array
    status: Array


_NO_MASS = "The display is unstable with every virtual mass; change the virtual damping or reduce the delay."


@compact_repr(messages={Status.NO_BOUNDARY: _NO_MASS}, virtual_mass="kg", largest="kg", frequency="Hz")
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


_NO_DAMPING = "The display is unstable with every virtual damping; change the virtual mass or reduce the delay."


@compact_repr(messages={Status.NO_BOUNDARY: _NO_DAMPING}, virtual_damping="N s/m", largest="N s/m", frequency="Hz")
class VirtualDampingLimit(NamedTuple):
    """The smallest virtual damping with which an admittance display is stable.

    The display is stable with every damping from ``virtual_damping`` to ``largest``, both in N s/m. ``frequency`` is
    the frequency in Hz of the sustained oscillation with the damping ``virtual_damping``; NaN if this damping is 0. If
    the display is unstable with every damping, all three are NaN and ``status`` is NO_BOUNDARY.
    """

    virtual_damping: float
    largest: float
    frequency: float
    status: int


@dataclass(frozen=True, repr=False)
class AdmittanceDisplay(Part):
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
        if isinstance(self.robot, LinearDevice) and self.robot.dt and not is_traced(*list_leaves(self.timing)):
            self.loop.make_system()

    def _rebuild(self) -> AdmittanceDisplay:
        """Return a copy of the display after a check of all its numbers, because JAX creates objects without checks."""
        timing = self.timing._rebuild()
        robot = self.robot._rebuild() if isinstance(self.robot, Actuator) else self.robot
        return AdmittanceDisplay(self.virtual_mass, self.virtual_damping, robot, timing, self.command, self.integrator)

    @property
    def loop(self) -> AdmittanceLoop:
        """The robot and the program of the display, without the values of virtual mass and damping."""
        timing = self.timing
        return find_loop(self.robot, float(timing.period), float(timing.d), self.command, self.integrator)

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
        K = as_float64(
            "environment_stiffness",
            read_texts("environment_stiffness", environment_stiffness, SYSTEMS[self.rotary]["N/m"]),
        )
        B = self._read_array("environment_damping", environment_damping)
        K, B = broadcast({"environment_stiffness": K, "environment_damping": B})
        if not np.all(B >= 0):
            raise InputError(f"environment_damping: got {float(B[~(B >= 0)].flat[0]):g} N s/m; it must be >= 0")
        labels = np.zeros(K.shape, bool)
        for damping in np.unique(B[np.isfinite(B)]).tolist():
            chosen = damping == B
            labels[chosen] = self.scene(0.0, damping).is_stable(K[chosen], 0.0)
        return labels[()]

    def max_environment_stiffness(
        self,
        environment_damping: ArrayLike = 0.0,
        *,
        virtual_mass: ArrayLike | None = None,
        virtual_damping: ArrayLike | None = None,
    ) -> EnvironmentLimit:
        """Return the largest stiffness K of the environment such that the display is stable from 0 to K.

        The arguments are broadcast, so that one call computes K for a grid of virtual masses and dampings. Inside JAX
        transformations, such as ``jit``, ``vmap`` and ``grad``, JAX may trace the arguments and all numbers of the
        display.

        Args:
            environment_damping: damping B of the environment in N s/m, >= 0; a number or an array.
            virtual_mass: virtual mass M in kg, > 0, a number or an array; default: that of the display.
            virtual_damping: virtual damping D in N s/m, >= 0, a number or an array; default: that of the display.

        Returns:
            `EnvironmentLimit` with arrays of the broadcast shape. The relative error of K is about 1e-12. If an entry
            of an array is out of range, the results for this entry are NaN with the status INVALID_INPUT.

        Raises:
            InputError: a single number is out of range, or an argument has a wrong unit or type.

        Example:
            >>> import zwidth
            >>> robot, timing = zwidth.Actuator(time_constant="5 ms"), zwidth.Timing(rate="1 kHz", delay="2 periods")
            >>> display = zwidth.AdmittanceDisplay(5, 20, robot, timing)
            >>> display.max_environment_stiffness(virtual_mass=[1, 2, 5]).stiffness.round()
            array([3309., 3190., 3117.])
        """
        own = self.virtual_mass, self.virtual_damping
        M, D = (
            each if given is None else given for each, given in zip(own, (virtual_mass, virtual_damping), strict=True)
        )
        names = "virtual_mass", "virtual_damping", "environment_damping"
        given: dict[str, Any] = dict(zip(names, (M, D, environment_damping), strict=True))
        if is_traced(*given.values(), *list_leaves(self)):
            return self._trace_limit(given)
        factors = broadcast({name: self._read_array(name, value) for name, value in given.items()})
        self.loop.check_damper(float(np.nanmax(factors[2], initial=0.0)))
        K, frequency, status = (each.reshape(factors[0].shape)[()] for each in self._find_limits(*factors))
        return self._label(EnvironmentLimit(K, frequency, status))

    def _find_limits(self, M: np.ndarray, D: np.ndarray, B: np.ndarray) -> EnvironmentLimit:
        """Return the largest stable K for each element of the equally shaped arrays M, D and B, in flattened arrays."""
        rows = np.stack([M, D, B], -1).reshape(-1, 3)
        is_valid = np.isfinite(rows).all(-1) & (rows[:, 0] > 0) & (rows[:, 1:] >= 0).all(-1)
        limits = find_limits(self.loop, *np.where(is_valid, rows.T, [[1.0], [0.0], [0.0]]))
        K, frequency = np.where(
            is_valid, (limits.stiffness, limits.angle / (2.0 * np.pi * float(self.timing.period))), np.nan
        )
        result = EnvironmentLimit(K, frequency, np.where(is_valid, limits.status, int(Status.INVALID_INPUT)))
        for k in np.flatnonzero(result.status == Status.UNDECIDED).tolist():
            mass, damping, environment_damping = rows[k].tolist()
            display = self._replace(mass, damping)
            limit = display._find_limit({"environment_damping": environment_damping})
            for column, value in zip(result, limit, strict=True):
                column[k] = value
        return result

    def _trace_limit(self, given: dict[str, Any]) -> EnvironmentLimit:
        """Return the largest stable K if JAX traces M, D, B or a number of the display."""
        from zwidth.analysis.traced_loop import ask

        units = SYSTEMS[self.rotary]
        given = {name: read_texts(name, value, units[_QUANTITIES[name][0]]) for name, value in given.items()}
        # Set M and D of the display to constants, so that displays which differ only in M and D form one batch.
        K, frequency, status = ask(self._replace(1.0, 0.0), "environment_limit", *broadcast_traced(given))
        return self._label(EnvironmentLimit(K, frequency, status.astype("int32")))

    def _replace(self, virtual_mass: float, virtual_damping: float) -> AdmittanceDisplay:
        """Return a copy of the display with another virtual mass (in kg) and virtual damping (in N s/m)."""
        return replace(self, virtual_mass=virtual_mass, virtual_damping=virtual_damping)

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
        factors = {"stiffness": K, "environment_damping": B}
        least, gain, status = self._find_range("mass", factors)
        largest = np.inf if least == 0 else 1.0 / least
        frequency = self._find_frequency("mass", factors, gain)
        return self._label(VirtualMassLimit(1.0 / gain, largest, frequency, status))

    def min_virtual_damping(self, environment_stiffness: Any, environment_damping: Any = 0.0) -> VirtualDampingLimit:
        """Return the smallest virtual damping with which the display is stable in an environment.

        The virtual mass is that of the display. The virtual damping of the display has no effect on the result. With
        dampings above ``largest``, a field of the result, the display may be unstable again.

        Args:
            environment_stiffness: K in N/m, > 0.
            environment_damping: B in N s/m, >= 0.

        References:
            Keemink, van der Kooij, Stienen 2018, International Journal of Robotics Research 37(11), 1421-1444 (effect
            of the virtual damping on the stability of a contact).

        Example:
            >>> import zwidth
            >>> robot, timing = zwidth.Actuator(time_constant="5 ms"), zwidth.Timing(rate="1 kHz", delay="2 periods")
            >>> display = zwidth.AdmittanceDisplay(5, 20, robot, timing)
            >>> display.min_virtual_damping("20 kN/m")
            VirtualDampingLimit(virtual_damping=119.246 N s/m, largest=9.999 kN s/m, frequency=9.54812 Hz, status=OK)
        """
        K, B = self._read_environment(environment_stiffness, environment_damping, "environment", POSITIVE)
        factors = {"stiffness": K, "environment_damping": B}
        least, largest, status = self._find_range("damping", factors)
        frequency = self._find_frequency("damping", factors, least) if least else np.nan
        return self._label(VirtualDampingLimit(least, largest, frequency, status))

    simulate = simulate
    code = write_code

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

    def _read_array(self, name: str, value: Any) -> np.ndarray:
        """Return an argument as an array in SI units; raise `InputError` if it is a single number out of range."""
        unit, allowed = _QUANTITIES[name]
        unit = SYSTEMS[self.rotary][unit]
        array = as_float64(name, read_texts(name, value, unit))
        if not array.ndim and not (allowed.holds(array) and np.isfinite(array)):
            sign = ">" if allowed.low_open else ">="
            raise InputError(f"{name}: got {float(array):g} {unit}; it must be {sign} 0")
        return np.asarray(array)

    def _make_scene(self, gain: str, factors: dict[str, float]) -> Scene:
        """Return a scene in which one of the gains 1/M, D, K and B is the stiffness of the wall.

        Args:
            gain: "mass" for 1/M; "damping", "stiffness" or "environment_damping" for D, K or B.
            factors: values of the other factors by the same names. The default of M and D is the value of the display,
                the default of K and B is 0.
        """
        if is_traced(*list_leaves(self), *factors.values()):
            raise InputError(
                "display: got a value that JAX traces, allowed only in max_environment_stiffness; call this method "
                "outside of jit, vmap and grad"
            )
        self.loop.check_damper(factors.get("environment_damping", 0.0))
        mass, damping = Fraction(float(self.virtual_mass)), Fraction(float(self.virtual_damping))
        values = {"mass": mass, "damping": damping} | {name: Fraction(value) for name, value in factors.items()}
        parts = self.loop.coefficients._asdict()
        rest = reduce(
            add, (multiply((values[name],), part) for name, part in parts.items() if name != gain and values.get(name))
        )
        # With the gain 1/M, the characteristic polynomial divided by M is p_M + (1/M) rest, so p_M is the denominator.
        system = (rest, parts[gain]) if gain == "mass" else (parts[gain], rest)
        device = LinearDevice(system, float(self.timing.period))
        object.__setattr__(device, "is_display", True)
        return Scene(device, Timing(float(self.timing.period)))

    def _find_limit(self, factors: dict[str, float]) -> tuple[float, float, int]:
        """Return the largest K such that the display is stable from 0 to K, the frequency in Hz at K, and a status."""
        least, largest, status = self._find_range("stiffness", factors)
        if least > 0 or status != Status.OK:
            return np.nan, np.nan, int(Status.NO_BOUNDARY)
        return largest, self._find_frequency("stiffness", factors, largest), status

    def _find_range(self, gain: str, factors: dict[str, float]) -> tuple[float, float, int]:
        """Return the ends of the lowest stable interval of one gain (1/M, D, K or B), and a status.

        ``gain`` is the name of this gain, and ``factors`` contains the values of the other gains (`_make_scene`).
        """
        intervals = self._make_scene(gain, factors).stable_stiffness(0.0)
        intervals = intervals[intervals[:, 1] > 0]
        if not intervals.size:
            return np.nan, np.nan, int(Status.NO_BOUNDARY)
        low, high = intervals[0].tolist()
        return max(low, 0.0), high, int(Status.OK)

    def _find_frequency(self, gain: str, factors: dict[str, float], value: float) -> float:
        """Return the frequency in Hz of the dominant pole if one gain (1/M, D, K or B) has the given value.

        ``gain`` is the name of this gain, and ``factors`` contains the values of the other gains (`_make_scene`).
        """
        return float(self._make_scene(gain, factors).dominant_pole(value, 0.0).frequency) if value == value else np.nan
