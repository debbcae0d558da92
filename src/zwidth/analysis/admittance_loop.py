"""Compute the characteristic polynomial of an admittance display in exact rational arithmetic.

The display is a robot that measures a force and moves like a virtual mass M with damping D; the environment has the
stiffness K and the damping B. T is the sampling period, z = e^(sT), and ``zeta = z - 1``. The delay of the command is
n + f periods, with the integer part n. Three responses describe the loop: Y(z) from the contact force to the command,
P(z) from the command to the position of the robot, and V(z) from the command to the velocity of the robot. The closed
loop is ``1 + Y (K P + B V) = 0`` with

    Y = N_Y/(M q_M + D q_D),   P = N_P/(Q z^lag),   V = N_V/(Q z^lag)

where N_Y, q_M, q_D, N_P, N_V and Q are polynomials and ``lag`` is an integer. Multiplied by all denominators, the
characteristic polynomial is ``M p_M + D p_D + K p_K + B p_B`` (docs/theory/admittance.md, W1 to W4; there, Q includes
the factor z^lag).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache, reduce
from typing import Any, Literal, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.model.actuator import Actuator
from zwidth.model.exact_polynomials import Polynomial, characteristic_polynomial, multiply, subtract, trim
from zwidth.model.linear_device import LinearDevice
from zwidth.model.linear_plant import System
from zwidth.model.velocity import Estimate
from zwidth.plant.sampled_states import sample_states

Command = Literal["position", "velocity"]
Integrator = Literal["semi-implicit", "trapezoidal"]
KEPT_LOOPS = 64  # number of cached loops; displays that differ only in M and D share one loop

# Polynomials in zeta = z - 1, as coefficients in descending powers
ZETA: Polynomial = (Fraction(1), Fraction(0))
Z: Polynomial = (Fraction(1), Fraction(1))  # z = zeta + 1
TWO: Polynomial = (Fraction(1), Fraction(2))  # z + 1 = zeta + 2
ONE: Polynomial = (Fraction(1),)


class Coefficients(NamedTuple):
    """The four polynomials in z in the characteristic polynomial ``M p_M + D p_D + K p_K + B p_B``."""

    mass: Polynomial  # polynomial p_M, which the virtual mass M multiplies
    damping: Polynomial  # polynomial p_D, which the virtual damping D multiplies
    stiffness: Polynomial  # polynomial p_K, which the stiffness K of the environment multiplies
    environment_damping: Polynomial  # polynomial p_B, which the damping B of the environment multiplies


class ProgramPolynomials(NamedTuple):
    """Polynomials in zeta = z - 1 of the response ``Y = N_Y/(M q_M + D q_D)`` from contact force to command."""

    numerator: Polynomial  # N_Y
    mass: Polynomial  # q_M
    damping: Polynomial  # q_D


class RobotPolynomials(NamedTuple):
    """Polynomials in zeta = z - 1 of the responses of the robot to its command.

    The response of the position is ``P = N_P/(Q z^lag)``, that of the velocity is ``V = N_V/(Q z^lag)``.
    """

    position: Polynomial  # N_P
    velocity: Polynomial  # N_V; empty for a robot model in discrete time, which does not define a velocity
    denominator: Polynomial  # Q
    lag: int


@dataclass(frozen=True)
class AdmittanceLoop:
    """The robot and the program of an admittance display, without the values of virtual mass and damping."""

    robot: Any  # `Actuator` or `LinearDevice`, the response of the robot from its command to its motion
    period: float  # T in s
    d: float  # delay in periods
    command: Command
    integrator: Integrator

    @property
    def n_delay(self) -> int:
        """Integer part n of the delay of the command, in periods."""
        return int(np.floor(self.d))

    @cached_property
    def plant(self) -> LinearDevice:
        """Model of the robot from its command, a position or a velocity, to its position."""
        device = self.robot
        if isinstance(device, Actuator):
            w = float(device.rate)
            lags = {1: ([w], [1.0, w]), 2: ([w * w], [1.0, 2.0 * float(device.damping_ratio or 0.0) * w, w * w])}
            device = LinearDevice(lags[device.order])
        if self.command == "position":
            return device
        numerator, denominator, _ = device.system
        return LinearDevice((numerator, (*denominator, Fraction(0))))

    def make_system(self) -> System:
        """Return robot and delay for time in sampling periods; raise `InputError` if they cannot be discretized."""
        system = System(self.plant, self.period, self.period**2, self.d, self.n_delay, Estimate())
        system.check()
        return system

    def check_damper(self, damping: float) -> None:
        """Raise `InputError` if the environment has a damper, but the model of the robot does not define a velocity."""
        if damping and self.plant.dt:
            raise InputError(
                "environment_damping: got a damper with a sampled robot, whose velocity is unknown; use a model in s"
            )

    @cached_property
    def program(self) -> ProgramPolynomials:
        """Response Y from the contact force to the command (docs/theory/admittance.md, W4)."""
        period = (Fraction(self.period),)
        half = (Fraction(self.period) / 2,)
        if self.integrator == "trapezoidal":
            numerator, mass, damping = reduce(multiply, (half, Z, TWO)), multiply(Z, ZETA), multiply(half, TWO)
            path = multiply(half, TWO)
        else:
            numerator, mass, damping = multiply(period, Z), ZETA, period
            path = multiply(period, Z)
        if self.command == "velocity":
            return ProgramPolynomials(numerator, mass, damping)
        # If the command is a position, multiply Y by path/zeta, because the program integrates the virtual velocity.
        return ProgramPolynomials(multiply(numerator, path), multiply(mass, ZETA), multiply(damping, ZETA))

    @cached_property
    def sampled_robot(self) -> RobotPolynomials:
        """Responses P of the position and V of the velocity to the command (docs/theory/admittance.md, W2 and W3)."""
        system = self.make_system()
        if self.plant.dt:
            numerator, denominator = (to_zeta(part) for part in self.plant.system[:2])
            return RobotPolynomials(numerator, (), denominator, self.n_delay)
        states, (A, B, _) = sample_states(system), system.realize()
        psi = _to_fractions(states.psi)
        whole = _to_fractions(states.full)
        late = whole if states.late is None else _to_fractions(states.late)
        denominator = characteristic_polynomial(psi)

        def respond(output: np.ndarray) -> Polynomial:
            """Return the numerator of the response from the command to the signal ``c X``; X is the state of the robot.

            ``output`` is the row vector c. The numerator is ``c adj(zeta - Psi) (zeta Gamma(1 - f) + Gamma(1))``. Here
            Psi is the transition matrix of X over one period minus the identity, and Gamma(t) is the state at the time
            t after a unit command from rest. The terms with Gamma(1 - f) and Gamma(1) are computed by the matrix
            determinant lemma, ``c adj(A) g = det(A) - det(A - g c)``.
            """
            first, second = (
                subtract(denominator, characteristic_polynomial(psi + np.outer(force, output)))
                for force in (late, whole)
            )
            return add(multiply(first, ZETA), second)

        sensor = _to_fractions(np.eye(len(B))[0])
        velocity = add(respond(_to_fractions(A[0])), multiply((Fraction(float(B[0])),), denominator))
        # V has a zero at z = 1, which cancels the pole of the integrator. Set the constant coefficient to exactly 0,
        # because its rounding error would move this zero.
        velocity = trim((*(value / Fraction(self.period) for value in velocity[:-1]), Fraction(0)))
        return RobotPolynomials(respond(sensor), velocity, denominator, self.n_delay + 1)

    @cached_property
    def coefficients(self) -> Coefficients:
        """The polynomials p_M, p_D, p_K and p_B of the characteristic polynomial, with rational coefficients."""
        (position, velocity, denominator, lag), program = self.sampled_robot, self.program
        common = multiply(denominator, reduce(multiply, [Z] * lag, ONE))
        parts = (multiply(program.mass, common), multiply(program.damping, common))
        parts = (*parts, multiply(program.numerator, position), multiply(program.numerator, velocity))
        return Coefficients(*map(to_z, parts))


find_loop = lru_cache(KEPT_LOOPS)(AdmittanceLoop)
"""Return the `AdmittanceLoop` with the given fields, from a cache of the last loops."""


def _to_fractions(values: Any) -> np.ndarray:
    """Convert an array of floats to exact fractions."""
    floats = np.asarray(values, float)
    return np.array([Fraction(value) for value in floats.ravel().tolist()], object).reshape(floats.shape)


def add(one: Polynomial, other: Polynomial) -> Polynomial:
    """Return the sum of two polynomials."""
    return subtract(one, tuple(-value for value in other))


def to_z(polynomial: Polynomial) -> Polynomial:
    """Convert a polynomial in zeta = z - 1 to powers of z."""
    return _substitute(polynomial, -1)


def to_zeta(polynomial: Polynomial) -> Polynomial:
    """Convert a polynomial in z to powers of zeta = z - 1."""
    return _substitute(polynomial, 1)


def _substitute(polynomial: Polynomial, offset: int) -> Polynomial:
    """Return the coefficients of p(x + offset) in powers of x for a polynomial p, by Horner's method."""
    result: Polynomial = ()
    for value in polynomial:
        result = add(multiply(result, (Fraction(1), Fraction(offset))), (value,)) if result else trim((value,))
    return result
