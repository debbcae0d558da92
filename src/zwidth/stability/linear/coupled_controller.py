"""Express a virtual coupling with its simulated tool as one filter Q of the position x of the device.

The coupling has the normalized stiffness alpha and damping beta, the tool the response G_t from force to position. P
and V are the estimates of position and velocity of the device, V_t is the velocity estimate of the tool, and R the
further feedback. The force of the coupling is ``f = alpha (P x - y) + beta (V x - V_t y)`` with the position y = G_t f
of the tool. With ``C = alpha P + beta V`` and ``C_t = alpha + beta V_t``, the force on the device is

    f + R x = Q x,     Q = C/(1 + C_t G_t) + R

Device and force form the loop of a wall with the stiffness 1, no damping, and the position estimate Q. The delay of the
scene is the delay of this force, so additional delay multiplies the open loop by a power of z. Q may have poles outside
the unit circle.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from zwidth.model.circle_functions import CirclePoints, circle_points
from zwidth.model.estimate import Estimate
from zwidth.model.loop_estimates import LoopEstimates
from zwidth.model.mechanism import AnyChain
from zwidth.plant.composed_plant import add_plants
from zwidth.plant.factored_plant import FactoredPlant
from zwidth.stability.linear.delay_margin import find_delay_margins
from zwidth.stability.linear.margins import tabulate

# Angles at which Q is checked, because its zeros may be inaccurate: smallest angle, largest angle, number of angles
TEST_ANGLES = 1e-3, 3.1, 64
TOLERANCE = 1e-8  # largest relative difference between Q from its zeros and poles, and Q from its definition


def find_coupling_delay_margin(chain: AnyChain, tool: FactoredPlant, alpha: float, beta: float) -> float:
    """Return the delay margin of a stable coupling in periods: the smallest additional delay that makes it unstable.

    Args:
        chain: normalized model of device, delay and estimates of the scene.
        tool: the response G_t of the tool from force to position.
        alpha: normalized stiffness of the coupling.
        beta: normalized damping of the coupling.

    Returns:
        The margin; inf if the coupling is stable with any delay. NaN if pole counts do not confirm the result, or if
        the rounding errors of Q are too large.
    """
    estimates = chain.estimates or LoopEstimates(velocity=chain.estimate)
    Q = _compose_controller(estimates, tool, alpha, beta)
    points = circle_points(np.geomspace(*TEST_ANGLES))
    expected = _evaluate_controller(estimates, tool, alpha, beta, points)
    error = np.abs(Q.evaluate_response(points).value - expected)
    if not np.all(error <= TOLERANCE * np.abs(expected)):
        return math.nan
    folded = replace(chain, estimates=LoopEstimates(position=Estimate(0, Q.gain, Q.lag, Q.zeros, Q.poles)))
    return float(find_delay_margins(folded, tabulate, np.ones(1), np.zeros(1))[0])


def _evaluate_controller(
    estimates: LoopEstimates, tool: FactoredPlant, alpha: float, beta: float, points: CirclePoints
) -> np.ndarray:
    """Return ``Q = C/(1 + C_t G_t) + R`` at points of the unit circle, computed from the values of its parts."""
    P, V, *R = (term(points).value for term in estimates.respond())
    returned = (alpha + beta * estimates.of_tool.jet(points).value) * tool.evaluate_response(points).value
    return (alpha * P + beta * V) / (1.0 + returned) + sum(R)


def _compose_controller(estimates: LoopEstimates, tool: FactoredPlant, alpha: float, beta: float) -> FactoredPlant:
    """Return the filter Q from the position of the device to the force on it, for a coupling to a tool."""
    P, V, V_t = (_factor(each) for each in (estimates.position, estimates.velocity, estimates.of_tool))
    V = _multiply(V, P) if estimates.structure == "series" else V
    total = FactoredPlant(0.0, 0, np.zeros(0), np.zeros(0))
    if alpha or beta:
        coupling = _add(P, V, alpha, beta)
        direct = _add(FactoredPlant(1.0, 0, np.zeros(0), np.zeros(0)), V_t, alpha, beta)
        returned = _multiply(direct, tool)
        closed = _add(FactoredPlant(1.0, 0, np.zeros(0), np.zeros(0)), returned)
        total = _multiply(coupling, FactoredPlant(1.0 / closed.gain, -closed.lag, closed.poles, closed.zeros))
    feedback = estimates.feedback
    if feedback is None:
        return total
    R = _factor(feedback.filter)
    if feedback.weights is not None:
        R = _multiply(R, _add(P, V, float(feedback.weights.position), float(feedback.weights.velocity)))
    return _add(total, R) if total.gain else R


def _factor(estimate: Estimate) -> FactoredPlant:
    """Convert an estimate to gain, lag, zeros and poles; a difference over n periods contributes n zeros."""
    n = estimate.window
    zeros = np.concatenate([estimate.zeros, np.zeros(min(n, 1)), estimate.list_window_zeros()])
    return FactoredPlant(float(estimate.gain) / max(n, 1), estimate.lag + n, zeros, np.asarray(estimate.poles))


def _multiply(first: FactoredPlant, second: FactoredPlant) -> FactoredPlant:
    """Return the product of two filters; the factors and the product are given by gain, lag, zeros and poles."""
    zeros, poles = ([getattr(each, name) for each in (first, second)] for name in ("zeros", "poles"))
    return FactoredPlant(first.gain * second.gain, first.lag + second.lag, np.concatenate(zeros), np.concatenate(poles))


def _add(first: FactoredPlant, second: FactoredPlant, a: float = 1.0, b: float = 1.0) -> FactoredPlant:
    """Return the sum of a times the first filter and b times the second filter."""
    if not a or not b:
        filter_, factor = (first, a) if a else (second, b)
        return replace(filter_, gain=factor * filter_.gain)
    # Multiply both filters by z^lag with the lag of the second filter; the last line divides the sum by z^lag.
    lag = second.lag
    moved = [replace(first, gain=a * first.gain, lag=first.lag - lag), replace(second, gain=b * second.gain, lag=0)]
    early = max(lag - first.lag, 0)
    moved[0] = replace(moved[0], lag=max(moved[0].lag, 0), zeros=np.append(moved[0].zeros, np.ones(early)))
    total = add_plants(*moved)
    return replace(total, lag=total.lag + lag)
