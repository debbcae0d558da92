"""Discrete-time state-space models, their series connection, and the realization of a velocity estimate.

A velocity estimate is realized as a shift register, which yields the difference over its window, followed by a filter
whose polynomials are in powers of z - 1. For a filter that is slow compared with the period, these coefficients are
more accurate than those in powers of z.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.model.estimate import Estimate
from zwidth.model.loop_estimates import LoopEstimates
from zwidth.units.display import compact_repr


@compact_repr(dt="s")
class StateSpace(NamedTuple):
    """State-space model ``x[k+1] = A x[k] + B u[k]``, ``y[k] = C x[k] + D u[k]`` with sampling period ``dt`` in s."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float = 1.0

    def step(self, periods: int) -> np.ndarray:
        """Return the unit step response at the first ``periods`` samples; inf or NaN after an overflow."""
        state, response = np.zeros(self.A.shape[0]), np.empty(periods)
        with np.errstate(all="ignore"):
            for k in range(periods):
                response[k] = (self.C @ state)[0] + self.D[0, 0]
                state = self.A @ state + self.B[:, 0]
        return response


def _realize_filter(estimate: Estimate) -> StateSpace:
    """Return the filter part of a velocity estimate (without the difference) in controllable canonical form.

    The canonical form uses the polynomials in z - 1. Therefore 1 is added to the diagonal of A.
    """
    # The factor z^-lag adds poles or zeros at z = 0, whose offset 1 - z is 1. With these, the filter has at least as
    # many poles as zeros, because it is causal.
    zeros = np.concatenate([estimate.zeros, np.ones(max(-estimate.lag, 0))])
    poles = np.concatenate([estimate.poles, np.ones(max(estimate.lag, 0))])
    size = poles.size
    denominator = np.atleast_1d(np.poly(-poles)).real
    numerator = float(estimate.gain) * np.atleast_1d(np.poly(-zeros)).real
    numerator = np.concatenate([np.zeros(denominator.size - numerator.size), numerator])
    A = np.eye(size, k=-1) + np.eye(size)
    B = np.zeros((size, 1))
    A[:1] -= denominator[1:]
    B[:1] = 1.0
    return StateSpace(A, B, (numerator[1:] - numerator[0] * denominator[1:])[None, :], numerator[:1, None])


def connect_in_series(first: StateSpace, second: StateSpace) -> StateSpace:
    """Return the series connection of two systems.

    Args:
        first: system that receives the input.
        second: system that receives the output of ``first``; a batch of systems if its matrices have leading axes.
    """
    n = len(first.A)
    A = np.zeros((*second.A.shape[:-2], *2 * (n + second.A.shape[-1],)))
    B = np.zeros((*A.shape[:-1], 1))
    A[..., :n, :n], A[..., n:, :n], A[..., n:, n:] = first.A, second.B @ first.C, second.A
    B[..., :n, :], B[..., n:, :] = first.B, second.B @ first.D
    return StateSpace(A, B, np.concatenate([second.D @ first.C, second.C], -1), second.D @ first.D)


def _append(first: StateSpace, second: StateSpace) -> StateSpace:
    """Combine two systems with a common input into one system with the outputs of the first, then of the second."""
    n, m = len(first.A), len(second.A)
    A = np.block([[first.A, np.zeros((n, m))], [np.zeros((m, n)), second.A]])
    C = np.block([[first.C, np.zeros((len(first.C), m))], [np.zeros((len(second.C), n)), second.C]])
    return StateSpace(A, np.concatenate([first.B, second.B]), C, np.concatenate([first.D, second.D]))


def realize_estimates(estimates: LoopEstimates) -> StateSpace:
    """Return the state-space model of the estimates and the further feedback of a scene, for T = 1.

    The input is the measured position. The three outputs are the position estimate, the velocity estimate and the
    output of the further feedback, which is 0 in a scene without further feedback.
    """
    wire = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1)))
    P, V = _realize_filter(estimates.position), realize_estimate(estimates.velocity)
    if estimates.structure == "series":
        both = connect_in_series(P, _append(wire, V))
    elif estimates.structure == "separate":
        both = _append(P, V)
    else:
        # Add poles at z = 0, canceled by zeros, so that P and V have the same poles and can share their states.
        at_zero = max(estimates.position.lag, estimates.velocity.lag, 0)
        poles = np.concatenate([estimates.position.poles, np.ones(at_zero)])
        P, V = (
            _realize_filter(Estimate(0, each.gain, 0, np.concatenate([each.zeros, np.ones(at_zero - each.lag)]), poles))
            for each in (estimates.position, estimates.velocity)
        )
        both = StateSpace(P.A, P.B, np.concatenate([P.C, V.C]), np.concatenate([P.D, V.D]))
    # Outputs: position estimate, velocity estimate, measured position.
    signals = _append(both, wire)
    if estimates.feedback is None:
        kept = np.diag([1.0, 1.0, 0.0])
        return StateSpace(signals.A, signals.B, kept @ signals.C, kept @ signals.D)
    R, weights = _realize_filter(estimates.feedback.filter), estimates.feedback.weights
    mixed = np.array([[0.0, 0.0, 1.0] if weights is None else [float(weight) for weight in (*weights, 0.0)]])
    source = StateSpace(signals.A, signals.B, mixed @ signals.C, mixed @ signals.D)
    full = connect_in_series(source, R)
    C = np.concatenate([np.pad(signals.C[:2], ((0, 0), (0, len(R.A)))), full.C])
    return StateSpace(full.A, full.B, C, np.concatenate([signals.D[:2], full.D]))


def realize_estimate(estimate: Estimate) -> StateSpace:
    """Return the state-space model of a velocity estimate, from measured position to velocity."""
    filtered, count = _realize_filter(estimate), estimate.window
    if not count:
        return filtered
    weights = np.zeros((1, count + 1))
    weights[0, [0, -1]] = 1.0 / count, -1.0 / count
    # The states are the last ``count`` positions, the newest first.
    difference = StateSpace(np.eye(count, k=-1), np.eye(count, 1), weights[:, 1:], weights[:, :1])
    return connect_in_series(difference, filtered)
