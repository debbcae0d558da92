"""State-space matrices, and the velocity estimate as such.

It is the difference over its window, a shift register, and a filter in the coefficients of zeta = z - 1: filters that
are slow beside the period keep their digits there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.parts.velocity import Estimate
from zwidth.words.showing import shown


@shown(dt="s")
class StateSpace(NamedTuple):
    """``x[k+1] = A x[k] + B u[k]``, ``y[k] = C x[k] + D u[k]``, a step every ``dt`` seconds."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float = 1.0

    def step(self, periods: int) -> np.ndarray:
        """The output at so many samples, with an input of 1 from the first one on; inf or NaN beyond float64."""
        state, found = np.zeros(self.A.shape[0]), np.empty(periods)
        with np.errstate(all="ignore"):
            for k in range(periods):
                found[k] = (self.C @ state)[0] + self.D[0, 0]
                state = self.A @ state + self.B[:, 0]
        return found


def _filter(estimate: Estimate) -> StateSpace:
    """What follows the window's difference, in controllable form around z = 1; it has no more zeros than poles."""
    zeros = np.concatenate([estimate.zeros, np.ones(max(-estimate.lag, 0))])
    poles = np.concatenate([estimate.poles, np.ones(max(estimate.lag, 0))])
    size = poles.size
    bottom = np.atleast_1d(np.poly(-poles)).real
    top = float(estimate.gain) * np.atleast_1d(np.poly(-zeros)).real
    top = np.concatenate([np.zeros(bottom.size - top.size), top])
    A = np.eye(size, k=-1) + np.eye(size)
    B = np.zeros((size, 1))
    A[:1] -= bottom[1:]
    B[:1] = 1.0
    return StateSpace(A, B, (top[1:] - top[0] * bottom[1:])[None, :], top[:1, None])


def in_series(first: StateSpace, second: StateSpace) -> StateSpace:
    """The second behind the first; of many second ones, along leading axes, all behind it."""
    n = len(first.A)
    A = np.zeros((*second.A.shape[:-2], *2 * (n + second.A.shape[-1],)))
    B = np.zeros((*A.shape[:-1], 1))
    A[..., :n, :n], A[..., n:, :n], A[..., n:, n:] = first.A, second.B @ first.C, second.A
    B[..., :n, :], B[..., n:, :] = first.B, second.B @ first.D
    return StateSpace(A, B, np.concatenate([second.D @ first.C, second.C], -1), second.D @ first.D)


def estimate_matrices(estimate: Estimate) -> StateSpace:
    """The velocity estimate, from sampled position."""
    behind, count = _filter(estimate), estimate.window
    if not count:
        return behind
    weights = np.zeros((1, count + 1))
    weights[0, [0, -1]] = 1.0 / count, -1.0 / count
    # A register of the last inputs, the newest first.
    difference = StateSpace(np.eye(count, k=-1), np.eye(count, 1), weights[:, 1:], weights[:, :1])
    return in_series(difference, behind)
