"""Express a virtual coupling with its simulated tool as one filter from the position of the device to its force.

The program computes the force ``f = alpha (P x - y) + beta (V x - V_t y)`` of the coupling from the position x of the
device and the position y = G_t f of the tool, and the force R x of the further feedback. With ``C = alpha P + beta V``
and ``C_t = alpha + beta V_t``, the force on the device is

    f + R x = Q x,     Q = C/(1 + C_t G_t) + R

The device with this force is the loop of a spring of stiffness 1 with the position estimate Q. Unlike in the loop of
the coupling force, all delays of this loop are those of the device, so additional delay multiplies its open loop by a
power of z. Q may have poles outside the unit circle.
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

# The zeros of a long velocity window may be inaccurate. Therefore Q from zeros and poles is compared with its
# definition, at angles given by the smallest angle, the largest angle and their number.
TEST_ANGLES = 1e-3, 3.1, 64
TOLERANCE = 1e-8  # largest relative difference of the two values of Q


def find_coupling_delay_margin(chain: AnyChain, tool: FactoredPlant, alpha: float, beta: float) -> float:
    """Return the delay margin of a stable coupling in periods: the smallest additional delay that makes it unstable.

    Args:
        chain: device and delay, with the estimates of the scene.
        tool: the response G_t of the tool.
        alpha: normalized stiffness of the coupling.
        beta: normalized damping of the coupling.

    Returns:
        The margin; inf if the coupling is stable with any delay. NaN if the result is not confirmed, or if rounding
        errors of Q are too large.
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
    """Return Q at points of the unit circle, computed by its definition."""
    P, V, *R = (term(points).value for term in estimates.respond())
    returned = (alpha + beta * estimates.of_tool.jet(points).value) * tool.evaluate_response(points).value
    return (alpha * P + beta * V) / (1.0 + returned) + sum(R)


def _compose_controller(estimates: LoopEstimates, tool: FactoredPlant, alpha: float, beta: float) -> FactoredPlant:
    """Return the filter Q of a coupling with a tool."""
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
    """Convert an estimate to gain, zeros and poles; the difference over its window becomes zeros."""
    n = estimate.window
    zeros = np.concatenate([estimate.zeros, np.zeros(min(n, 1)), estimate.list_window_zeros()])
    return FactoredPlant(float(estimate.gain) / max(n, 1), estimate.lag + n, zeros, np.asarray(estimate.poles))


def _multiply(first: FactoredPlant, second: FactoredPlant) -> FactoredPlant:
    """Return the product of two filters."""
    zeros, poles = ([getattr(each, name) for each in (first, second)] for name in ("zeros", "poles"))
    return FactoredPlant(first.gain * second.gain, first.lag + second.lag, np.concatenate(zeros), np.concatenate(poles))


def _add(first: FactoredPlant, second: FactoredPlant, a: float = 1.0, b: float = 1.0) -> FactoredPlant:
    """Return the sum of two filters with the factors a and b."""
    if not a or not b:
        filter_, factor = (first, a) if a else (second, b)
        return replace(filter_, gain=factor * filter_.gain)
    # Multiply both by a power of z, so that the second one has no poles at z = 0 but those among its poles.
    lag = second.lag
    moved = [replace(first, gain=a * first.gain, lag=first.lag - lag), replace(second, gain=b * second.gain, lag=0)]
    early = max(lag - first.lag, 0)
    moved[0] = replace(moved[0], lag=max(moved[0].lag, 0), zeros=np.append(moved[0].zeros, np.ones(early)))
    total = add_plants(*moved)
    return replace(total, lag=total.lag + lag)
