"""Compute zeros, poles and gain of loops that have filters in the controller.

H is the sampled plant, P the position estimate, V the velocity estimate, and R a further feedback filter. With

    G = H P/(1 + H R)      F = V/P

the loop is that of a plant G with the velocity estimate F. A wall has the normalized stiffness alpha and damping beta.
A closed-loop pole is a root z of ``1 + H (alpha P + beta V + R) = 0``, which is equivalent to the equation
``1 + G (alpha + beta F) = 0`` of `stability.linear.roots` (docs/theory/scenes.md, V25). R is a filter R0 of the sampled
position, or a filter R0 of the weighted estimates, ``R = R0 (w_p P + w_v V)`` (`model.loop_estimates`).

The zeros of 1 + H R are poles of G. They are computed like closed-loop poles, by Aberth's method in z - 1. Common poles
of P, V and R cancel by construction, never by a comparison of rounded roots. *Shared* roots are the last zeros of G,
which are also the last poles of F. Roots are stored as *offsets* 1 - root. The *lag* of a transfer function is its
number of factors 1/z; a negative lag is a number of factors z.

A simulated tool at the position y adds its response G_t. A virtual coupling computes the force ``alpha (P x - y) +
beta (V x - V_t y)`` from the position x of the device, with the velocity estimate V_t of the tool. The closed loop
``1 + alpha (P H + G_t) + beta (V H + V_t G_t) = 0`` is also that of a plant G with a velocity estimate F, with
``H = plant/(1 + plant R)`` (docs/theory/passivity.md, U7).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from zwidth.model.estimate import Estimate
from zwidth.model.feedback import Weights
from zwidth.model.loop_estimates import LoopEstimates
from zwidth.model.mechanism import AnyChain
from zwidth.plant.composed_plant import add_plants
from zwidth.plant.factored_plant import FactoredPlant, factor_chain
from zwidth.stability.linear.poles import find_poles
from zwidth.stability.linear.roots import LoopRoots


def find_roots(chain: AnyChain) -> LoopRoots:
    """Return the zeros, poles and gain of a loop without a wall, for the model ``chain`` of plant and controller."""
    plant = factor_chain(chain)
    if chain.estimates is None:
        return LoopRoots(**vars(plant), estimate=chain.estimate)
    return compose_loop(plant, chain.estimates)


def compose_loop(plant: FactoredPlant, estimates: LoopEstimates) -> LoopRoots:
    """Return the loop of a sampled plant with a position estimate, a velocity estimate and further feedback."""
    P, feedback, (ratio, shared) = estimates.position, estimates.feedback, estimates.divide()
    inner = plant
    if feedback is not None and feedback.weights is None:
        inner = _close_measured(plant, feedback.filter)
    loop = _build_loop(
        float(inner.gain * P.gain),
        inner.lag + P.lag,
        np.concatenate([inner.zeros, P.zeros]),
        np.concatenate([inner.poles, P.poles]),
        ratio,
        shared,
    )
    if feedback is not None and feedback.weights is not None:
        loop = _close_estimated(loop, feedback.filter, feedback.weights)
    return loop if feedback is None else replace(loop, inner=(plant, estimates))


def compose_coupling(device: LoopRoots, estimates: LoopEstimates | None, tool: FactoredPlant) -> LoopRoots:
    """Return the loop of a virtual coupling between a device and a simulated tool.

    Args:
        device: the loop of the device without the tool: the plant is ``G = P H``, the velocity estimate ``F = V/P``.
        estimates: the estimates P and V of the device; None if P is 1.
        tool: the response G_t of the tool.
    """
    plant, F = add_plants(device, tool), device.estimate
    if estimates is None or estimates.structure == "series":
        # With V = P F for the device and V_t = F for the tool, the coupling force is (alpha + beta F) (P x - y).
        return LoopRoots(**vars(plant), estimate=F)
    V, gain, lag = estimates.velocity, device.gain * float(F.gain), device.lag + F.lag
    if estimates.structure == "separate":
        # The tool has the velocity estimate V_t = V, so the velocity part of the loop is V H + V_t G_t = V (H + G_t).
        # The array ``F.zeros`` contains first the zeros of V, then the poles of P, because F = V/P.
        # If V is an input of R, the poles of V are zeros of H, and cancel in V H.
        released = V.poles[: 0 if device.free_poles.size else None]
        zeros = np.concatenate([device.free_zeros, F.zeros[np.size(V.zeros) :], released])
        outer, second = V, tool
        first = _build_plant(gain / float(V.gain), lag - V.lag, zeros, device.poles)
    else:
        # The tool has the velocity estimate (z - 1)/z: ``outer`` contains the factor 1/z, ``second`` the zero at z = 1.
        outer = Estimate(0, lag=1)
        first = _build_plant(gain, lag - 1, np.concatenate([device.free_zeros, F.zeros]), device.poles)
        second = replace(tool, zeros=np.append(tool.zeros, 0.0))
    total = add_plants(first, second)
    estimate = Estimate(
        outer.window,
        float(outer.gain) * total.gain / plant.gain,
        outer.lag + total.lag - plant.lag,
        np.concatenate([outer.zeros, total.zeros]),
        np.concatenate([outer.poles, plant.zeros]),
    )
    return LoopRoots(**vars(plant), estimate=estimate, shared=plant.zeros.size)


def _build_plant(gain: float, lag: int, zeros: np.ndarray, poles: np.ndarray) -> FactoredPlant:
    """Return the plant with the given zeros, poles and gain, times z^-lag; ``lag`` = -k < 0 adds k zeros at z = 0."""
    return FactoredPlant(gain, max(lag, 0), np.concatenate([zeros, np.ones(max(-lag, 0))]), poles)


def _build_loop(
    gain: float, lag: int, zeros: np.ndarray, poles: np.ndarray, estimate: Estimate, shared: int
) -> LoopRoots:
    """Return a loop whose plant G has a nonnegative lag; see `LoopRoots` for the arguments.

    If the given lag is -k < 0, G gets k zeros at z = 0. If F has poles at z = 0, as many as possible of these zeros
    become shared roots, because they cancel the poles of F.
    """
    zeros, poles = np.asarray(zeros, complex), np.asarray(poles, complex)
    estimate = replace(
        estimate,
        gain=float(estimate.gain),
        zeros=np.asarray(estimate.zeros, complex),
        poles=np.asarray(estimate.poles, complex),
    )
    at_zero = max(-lag, 0)
    moved = min(at_zero, max(estimate.window + estimate.lag, 0))
    first = zeros.size - shared
    zeros = np.concatenate([zeros[:first], np.ones(at_zero - moved), zeros[first:], np.ones(moved)])
    estimate = replace(
        estimate, lag=estimate.lag - moved, poles=np.concatenate([estimate.poles, np.ones(moved, complex)])
    )
    return LoopRoots(gain, max(lag, 0), zeros, poles, estimate, shared + moved)


def _close_measured(plant: FactoredPlant, feedback: Estimate) -> FactoredPlant:
    """Return the closed loop ``H/(1 + H R)`` of a plant H with feedback R; the lag of the result may be negative."""
    opened = _connect(plant.gain, plant.lag, plant.zeros, plant.poles, feedback)
    poles, lag = _close_at(opened, 1.0, 0.0), plant.lag + feedback.lag
    zeros = np.concatenate([plant.zeros, feedback.poles])
    return FactoredPlant(plant.gain, -feedback.lag if lag >= 0 else plant.lag, zeros, poles)


def _close_estimated(loop: LoopRoots, feedback: Estimate, weights: Weights) -> LoopRoots:
    """Return the loop with further feedback ``R = R0 (w_p P + w_v V)``, from the loop without it.

    Args:
        loop: the loop without R, i.e. with ``G = H P`` and ``F = V/P``.
        feedback: the filter R0.
        weights: the weights w_p and w_v.
    """
    F, lag = loop.estimate, loop.lag + feedback.lag
    if weights.velocity == 0:
        opened = _connect(loop.gain * float(weights.position), loop.lag, loop.zeros, loop.poles, feedback)
        poles, shared, released, delay = _close_at(opened, 1.0, 0.0), loop.shared, np.zeros(0, complex), 0
    else:
        opened = _connect(loop.gain, loop.lag, loop.zeros, loop.poles, feedback, F, loop.shared)
        poles = _close_at(opened, float(weights.position), float(weights.velocity))
        # All poles of F become zeros of the new G, because R = R0 P (w_p + w_v F) has the denominator of F.
        shared, released, delay = F.poles.size, loop.free_poles, max(F.window + F.lag, 0)
    ends = loop.zeros[loop.zeros.size - loop.shared :]
    zeros = np.concatenate([loop.free_zeros, feedback.poles, released, ends])
    # With lag < 0, R0 has -lag more zeros at z = 0 than G has poles there. These zeros cancel poles of F at z = 0.
    net = -feedback.lag - delay if lag >= 0 else loop.lag - max(delay + lag, 0)
    return _build_loop(loop.gain, net, zeros, poles, F, shared)


def _connect(
    gain: float,
    lag: int,
    zeros: np.ndarray,
    poles: np.ndarray,
    feedback: Estimate,
    estimate: Estimate | None = None,
    shared: int = 0,
) -> LoopRoots:
    """Return the loop whose plant is in series with a filter.

    Args:
        gain, lag, zeros, poles: the plant.
        feedback: the filter R0.
        estimate: the velocity estimate F; None for a loop without damper.
        shared: number of roots that are both zeros of the plant and poles of F; both lists end with these roots.
    """
    first = zeros.size - shared
    return _build_loop(
        gain * float(feedback.gain),
        lag + feedback.lag,
        np.concatenate([zeros[:first], feedback.zeros, zeros[first:]]),
        np.concatenate([poles, feedback.poles]),
        Estimate(0) if estimate is None else estimate,
        shared,
    )


def _close_at(loop: LoopRoots, alpha: float, beta: float) -> np.ndarray:
    """Return the offsets 1 - pole of the closed-loop poles for one wall (alpha, beta).

    A pole of G at z = 1 that is also a zero of G is a closed-loop pole for every wall. It is removed from G before the
    other poles are computed, so that its offset is exactly 0.
    """
    zeros, poles = np.flatnonzero(loop.free_zeros == 0), np.flatnonzero(loop.poles == 0)
    count = min(zeros.size, poles.size)
    loop = replace(loop, zeros=np.delete(loop.zeros, zeros[:count]), poles=np.delete(loop.poles, poles[:count]))
    if alpha == 0 and beta != 0 and loop.estimate.window + loop.estimate.lag >= 0:
        damper = loop.as_damper()
        if damper is not None:
            loop, alpha, beta, count = damper, beta, 0.0, count + 1
    if beta == 0:
        loop = replace(loop, estimate=Estimate(0), shared=0)
    zeta = find_poles(loop, np.full(1, alpha), np.full(1, beta))[0] if loop.order else np.zeros(0, complex)
    return np.concatenate([np.zeros(count, complex), -zeta])
