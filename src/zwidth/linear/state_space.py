"""A scene as state-space matrices: the chain's exact discretization, the velocity estimate and the forces on their way.

Normalized to T = 1 and the mass that the wall's force acts on. One period of the loop, u the wall's force and w one
held from outside on the same body,

    x+ = e^A x + Gamma(1 - f) u_(k-n) + (Gamma(1) - Gamma(1 - f)) u_(k-n-1) + Gamma(1) w,    u = -(alpha + beta F) y
"""

from __future__ import annotations

import numpy as np

from zwidth.linear.held import Sampled, hold, sampled
from zwidth.parts.chain import AnyChain
from zwidth.parts.state_space import StateSpace, estimate_matrices, in_series


def delayed_device(chain: AnyChain) -> StateSpace:
    """G: from the wall's force to the sampled position, with the forces that are on their way."""
    return delay_force(sampled(chain), chain.whole)


def delay_force(parts: Sampled, whole: int) -> StateSpace:
    """The same of a device between two samples, or of many along leading axes, and so many whole periods of delay."""
    size, held = parts.psi.shape[-1], parts.late is not None
    now = parts.late if held else parts.full
    count = whole + held
    A = np.zeros((*parts.psi.shape[:-2], size + count, size + count))
    B = np.zeros((*A.shape[:-1], 1))
    A[..., :size, :size] = np.eye(size) + parts.psi
    A[..., size:, size:] = np.eye(count, k=-1)
    B[..., size : size + 1, :] = 1.0
    if whole:
        A[..., :size, size + whole - 1] = now
    else:
        B[..., :size, 0] = now
    if held:
        A[..., :size, size + whole] += parts.full - now
    C = np.broadcast_to(np.eye(1, size + count), (*A.shape[:-2], 1, size + count))
    return StateSpace(A, B, C, np.zeros((*A.shape[:-2], 1, 1)))


def open_loop(chain: AnyChain, alpha: float, beta: float) -> StateSpace:
    """``L = (alpha + beta F) G``, from the position that the wall is given to the one that its force answers."""
    f = estimate_matrices(chain.estimate)
    return in_series(StateSpace(f.A, f.B, beta * f.C, alpha + beta * f.D), delayed_device(chain))


def closed_loop(chain: AnyChain, alpha: float, beta: float) -> StateSpace:
    """From a force held on the device to the sampled position, in contact with the wall."""
    loop, filtered = open_loop(chain, alpha, beta), len(estimate_matrices(chain.estimate).A)
    A, _, held = chain.realize()
    push = np.zeros((len(loop.A), 1))
    push[filtered : filtered + len(held), 0] = hold(chain, A, held, 1.0)[1]
    return StateSpace(loop.A - loop.B @ loop.C, push, loop.C, np.zeros((1, 1)))
