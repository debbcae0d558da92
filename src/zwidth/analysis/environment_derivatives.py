"""Compute the largest stable environment stiffness of an admittance display, with exact derivatives.

The display has the virtual mass M and damping D; the environment has the stiffness K and the damping B. At the largest
stable K, the *limit*, a pole is on the unit circle at ``z = e^(jw)``, with the angle w in rad per period. K and w solve
the closed loop divided by Y (symbols as in `zwidth.analysis.admittance_loop`),

    (M q_M + D q_D)/N_Y + K P + B V = 0

A and b are the matrices of the robot for time in sampling periods, Psi = e^A - 1, and Gamma(t) is the state at the time
t after a unit command from rest. P and V follow from the vector X (docs/theory/admittance.md, W2 and W3):

    (zeta - Psi) X = zeta Gamma(1 - f) + Gamma(1),   P = X_1/z^(n+1),   V = (A_1 X + b_1)/(T z^(n+1))

This equation is evaluated in Taylor arithmetic (`zwidth.numerics.taylor`) and differentiated by the implicit function
theorem. The *leaves* of a display are its numbers, in the order of `zwidth.core.pytrees.list_leaves`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from zwidth.core.pytrees import list_leaves, replace_leaves
from zwidth.core.status import Status
from zwidth.model.actuator import Actuator
from zwidth.numerics.taylor import Taylor, differentiate_implicitly, replace_derivatives, seed, stack
from zwidth.stability.linear.derivatives import StateTerms

NYQUIST_TOLERANCE = 1e-12  # relative distance of the angle w from pi below which the pole is at z = -1


def find_environment_limits(display: Any, points: np.ndarray, order: int) -> list[np.ndarray]:
    """Return the largest stable stiffness K, its frequency in Hz and a status, with derivatives.

    Args:
        display: a display, whose own virtual mass and damping have no effect.
        points: one row (M, D, B) per result.
        order: order of the highest derivative, 0, 1 or 2.

    Returns:
        Values (K, frequency, status) of shape (points, 3), and their derivatives up to the given order. Derivatives
        have one or two further axes for the variables: the numbers of the display, then M, D and B.
    """
    M, D, B = points.T
    limit = display.max_environment_stiffness(B, virtual_mass=M, virtual_damping=D)
    values = np.stack([*limit], -1).astype(float)
    size, period = len(list_leaves(display)) + 3, float(display.timing.period)
    results = [values, *(np.zeros((len(points), 3, *[size] * k)) for k in range(1, order + 1))]
    for result in results[1:]:
        result[:, :2] = np.nan
    rows = np.flatnonzero(values[:, 2] == Status.OK).tolist() if order else []
    if not rows:
        return results
    differentiate = _make_rule(display, order)
    for k in rows:
        K, frequency = values[k, :2].tolist()
        pair = differentiate(points[k].tolist(), K, 2.0 * np.pi * frequency * period)
        for order_index, result in enumerate(results[1:]):
            result[k, :2] = [(each.first, each.second)[order_index] for each in pair]
    return results


def _make_rule(display: Any, order: int) -> Callable[[list[float], float, float], list[Taylor]]:
    """Return a function that computes the derivatives of the largest stable K and of its frequency in Hz.

    The arguments of this function are the list [M, D, B], K, and the angle w of the pole on the unit circle. At an
    integer delay, K of some robots has a kink as a function of the delay. The derivative with respect to the delay is
    then right-sided. If the delay is given in seconds, the derivative with respect to the period is right-sided, too. A
    robot model in discrete time is valid for one period and one delay only, so these two derivatives are NaN.
    """
    loop, count = display.loop, len(list_leaves(display))
    n = loop.n_delay
    terms = LimitTerms(display, order, n)
    has_kink = not loop.plant.dt and n == loop.d > 0 and not display.timing.in_periods
    shorter = LimitTerms(display, order, n - 1) if has_kink else None

    def differentiate(factors: list[float], K: float, w: float) -> list[Taylor]:
        with np.errstate(all="ignore"):
            result = terms.differentiate(factors, K, w)
            if shorter is not None:
                replace_derivatives(result, shorter.differentiate(factors, K, w), count - 2)
        if loop.plant.dt:
            for k in (count - 2, count - 1):
                replace_derivatives(result, [each * np.nan for each in result], k)
        return result

    return differentiate


class LimitTerms:
    """Taylor expansions of the discretized robot in all variables: the numbers of the display, M, D, B, K and w."""

    def __init__(self, display: Any, order: int, n: int) -> None:
        """Discretize the robot. The highest derivative has the ``order`` 1 or 2; the integer delay is ``n`` periods."""
        self.loop, self.n = display.loop, n
        leaves = list_leaves(display)
        # Set the last five variables (M, D, B, K, w) to 1, because the robot does not depend on their values.
        self.variables = seed([*leaves, *[1.0] * 5], order)
        self.count, self.one = len(leaves), self.variables[0] * 0.0 + 1.0
        self.varied = replace_leaves(display, iter(self.variables))
        timing = self.varied.timing
        self.period = timing.period
        d = timing._periods if timing.in_periods else timing.delay / timing.period
        # Use the value `loop.d` of the delay in periods, because delay/period has a rounding error.
        fraction = Taylor(np.float64(self.loop.d), d.first, d.second) - n
        self.A, self.b = self._realize()
        self.states = StateTerms(self.A, self.b, self.one, fraction, bool(self.loop.plant.dt))

    def differentiate(self, factors: list[float], K: float, w: float) -> list[Taylor]:
        """Return the largest stable K and its frequency in Hz, with derivatives.

        Args:
            factors: values of M, D and B.
            K: the limit in N/m.
            w: angle of the pole on the unit circle.

        Returns:
            K and the frequency; the variables of their derivatives are the numbers of the display, M, D and B.
        """
        values = [*factors, K, w]
        M, D, B, stiffness, angle = (
            Taylor(np.float64(value), variable.first, variable.second)
            for value, variable in zip(values, self.variables[self.count :], strict=True)
        )
        residual = self._evaluate((M, D, B, stiffness), angle * 1j) * (1.0 / K)
        # At the Nyquist frequency, the residual is real; replace its imaginary part by the equation w = pi.
        is_nyquist = w > np.pi * (1.0 - NYQUIST_TOLERANCE)
        equations = [residual.real, angle - np.pi if is_nyquist else residual.imag]
        limit, angle = differentiate_implicitly(equations, [K, w])
        size, second = self.count + 3, self.period.second
        period = Taylor(self.period.v, self.period.first[:size], None if second is None else second[:size, :size])
        return [limit, angle / (period * (2.0 * np.pi))]

    def _evaluate(self, factors: tuple[Taylor, ...], lam: Taylor) -> Taylor:
        """Return the closed loop divided by Y, ``(M q_M + D q_D)/N_Y + K P + B V``, at ``z = e^lam``.

        ``factors`` are M, D, B and K.
        """
        M, D, B, K = factors
        z, zeta, T = lam.exp(), lam.expm1(), self.period
        # The semi-implicit method computes the virtual velocity v = T z/(M zeta + T D) f from the force f.
        # The trapezoidal method has the same response with T ``half`` in place of T, and M zeta z in place of M zeta.
        half, mass, path = self.one, zeta, z
        if self.loop.integrator == "trapezoidal":
            half = (z + 1.0) * 0.5
            mass, path = zeta * z, half
        inverse = (M * mass + D * T * half) / (T * z * half)
        if self.loop.command == "position":
            inverse = inverse * zeta / (T * path)
        position, velocity = self._respond(zeta)
        return inverse + (K * position + B * velocity) * (lam * -(self.n + 1)).exp()

    def _respond(self, zeta: Taylor) -> tuple[Taylor, Taylor]:
        """Return P and V without the factor z^-(n+1): the responses ``X_1`` and ``(A_1 X + b_1)/T`` to the command."""
        state = self.states.respond(zeta)[1]
        velocity = self.b[0]
        for k in range(len(self.b.v)):
            velocity = velocity + self.A[0, k] * state[k]
        return state[0], velocity / self.period

    def _realize(self) -> tuple[Taylor, Taylor]:
        """Return the matrices A and b of the robot, for time in periods, with the position as the first state."""
        T, robot, loop = self.period, self.varied.robot, self.loop
        if not isinstance(robot, Actuator):
            A, b = (stack(part, self.one) for part in loop.make_system().realize()[:2])
            # For time in periods, both matrices of a robot in continuous time are proportional to the period T.
            factor = self.one if loop.plant.dt else T / loop.period
            return tuple(
                part * factor.map(lambda v, part=part: np.asarray(v)[(None,) * part.v.ndim]) for part in (A, b)
            )  # pyright: ignore
        rate = robot.rate * T
        last = [-rate] if robot.order == 1 else [-(rate * rate), -(rate * robot.damping_ratio * 2.0)]
        rows = [[0.0, 1.0], last] if robot.order == 2 else [last]
        force = [*[0.0] * (robot.order - 1), rate**robot.order]
        if loop.command == "velocity":
            # Insert the position as first state; its derivative is the velocity, which becomes the second state.
            rows = [[0.0, T, *[0.0] * (robot.order - 1)], *([0.0, *row] for row in rows)]
            force = [0.0, *force]
        return stack(rows, self.one), stack(force, self.one)
