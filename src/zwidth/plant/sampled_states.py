"""Discretize a device exactly under a delayed zero-order hold, in state space.

Between samples the device obeys ``x' = A x + B u + external w`` with the sensed position as the first state, the
commanded force u and an external force w. In normalized units (T = 1) and with ``zeta = z - 1``, ``Psi = e^A - 1``, and
Gamma(t), the state after a unit force held for time t from rest, the response from held force to sampled position is
(docs/theory/scenes.md, V2 to V4)

    G(z) = C (zeta - Psi)^-1 (zeta Gamma(1 - f) + Gamma(1)) / z^(n+1),   d = n + f

with the integer delay n and the fractional delay f; for f = 0 it is ``C (zeta - Psi)^-1 Gamma(1) / z^n``. The state x
follows from the forces u of earlier samples:

    x_(k+1) = e^A x_k + Gamma(1 - f) u_(k-n) + (Gamma(1) - Gamma(1 - f)) u_(k-n-1)

A *chain* (`model.mechanism`) is a row of masses, springs and dampers; a *system* (`model.linear_plant`) is any linear
device. A *sampled* system is given in discrete time already.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import namespace
from zwidth.model.circle_functions import CirclePoints, power_jet
from zwidth.model.mechanism import AnyChain, Chain, is_zero
from zwidth.model.state_space import StateSpace
from zwidth.plant.rigid_mass import discretize_mass
from zwidth.plant.sampled_plant import SampledPlant
from zwidth.plant.transition import compute_transition


class SampledStates(NamedTuple):
    """The sampled plant in state space; the matrices may have leading axes, which broadcast with the points z."""

    psi: Any  # e^A - 1, shape (..., n, n)
    full: Any  # Gamma(1), shape (..., n)
    late: Any  # Gamma(1 - f), shape (..., n); None for integer delays
    n_delay: Any  # integer delay n

    @property
    def lag(self) -> Any:
        """The power of 1/z in G: the integer delay, plus one if the delay has a fractional part."""
        return self.n_delay if self.late is None else self.n_delay + 1

    def controller(self, points: CirclePoints) -> Array:
        """Return ``q = -1/G`` at points of the unit circle. Without roots, it is differentiable in JAX."""
        xp = namespace(self.psi, points.w)
        zeta = points.z_minus_1[..., None]
        force = self.full + 0j * zeta if self.late is None else zeta * self.late + self.full
        matrix = zeta[..., None] * xp.broadcast_to(xp.eye(self.psi.shape[-1]), self.psi.shape) - self.psi
        state = xp.linalg.solve(matrix, force[..., None])[..., 0]
        return -power_jet(points, self.lag).value / state[..., 0]

    def response(self, points: CirclePoints) -> Array:
        """Return G at points of the unit circle."""
        return -1.0 / self.controller(points)

    def realize(self) -> StateSpace:
        """Return the state-space model of G; its last states are the delayed forces."""
        n, size = int(self.n_delay), self.psi.shape[-1]
        newer = self.full if self.late is None else self.late
        count = int(self.lag)
        A = np.zeros((*self.psi.shape[:-2], size + count, size + count))
        B = np.zeros((*A.shape[:-1], 1))
        A[..., :size, :size] = np.eye(size) + self.psi
        A[..., size:, size:] = np.eye(count, k=-1)
        B[..., size : size + 1, :] = 1.0
        if n:
            A[..., :size, size + n - 1] = newer
        else:
            B[..., :size, 0] = newer
        if self.late is not None:
            A[..., :size, size + n] += self.full - newer
        C = np.broadcast_to(np.eye(1, size + count), (*A.shape[:-2], 1, size + count))
        return StateSpace(A, B, C, np.zeros((*A.shape[:-2], 1, 1)))


def sample_chain(chain: AnyChain) -> SampledPlant | SampledStates:
    """Return the sampled plant of a chain: a rigid device in closed form, otherwise in state space."""
    if not (isinstance(chain, Chain) and chain.rigid):
        return sample_states(chain)
    fraction = chain.d - chain.n_delay
    rigid = discretize_mass(chain.bodies[0].damping, None if is_zero(fraction) else fraction)
    return SampledPlant(rigid, (), (), chain.n_delay, fraction)


def sample_states(chain: AnyChain) -> SampledStates:
    """Return the sampled plant in state space of one chain, or of many, if parameters have one value per chain."""
    A, B, _ = chain.realize()
    if A.ndim > 2:
        xp = namespace(A)
        A, B = xp.moveaxis(A, -1, 0), xp.moveaxis(B, -1, 0)
    psi, full = integrate_chain(chain, A, B, 1.0)
    fraction = chain.d - chain.n_delay
    late = None if is_zero(fraction) else integrate_chain(chain, A, B, 1.0 - fraction)[1]
    return SampledStates(psi, full, late, chain.n_delay)


def integrate_chain(chain: AnyChain, A: Any, B: Any, time: Any) -> tuple[Any, Any]:
    """Return ``e^(A t) - 1`` and Gamma(t) of a chain; for a sampled system, A - 1 and B, independently of the time."""
    if chain.sampled:
        return A - np.eye(len(B)), B
    change = compute_transition(namespace(A).concatenate([A, B[..., None]], -1), time).change
    return change[..., :-1], change[..., -1]
