"""Realize the open and the closed loop of a wall in state space.

In normalized units, a wall (alpha, beta) acts on the sampled position y through the velocity estimate F with the force
``u = -(alpha + beta F) y``. An external force, held constant over each period, acts on the first body without delay.
"""

from __future__ import annotations

import numpy as np

from zwidth.model.mechanism import AnyChain
from zwidth.model.state_space import StateSpace, connect_in_series, realize_estimate
from zwidth.plant.sampled_states import integrate_chain, sample_states


def realize_open_loop(chain: AnyChain, alpha: float, beta: float) -> StateSpace:
    """Return the open loop ``L = (alpha + beta F) G`` in state space, from the input of the wall to the position."""
    f = realize_estimate(chain.estimate)
    wall = StateSpace(f.A, f.B, beta * f.C, alpha + beta * f.D)
    return connect_in_series(wall, sample_states(chain).realize())


def realize_closed_loop(chain: AnyChain, alpha: float, beta: float) -> StateSpace:
    """Return the closed loop with a wall in state space, from a held external force to the sampled position."""
    loop, filter_order = realize_open_loop(chain, alpha, beta), len(realize_estimate(chain.estimate).A)
    A, _, external = chain.realize()
    B = np.zeros((len(loop.A), 1))
    B[filter_order : filter_order + len(external), 0] = integrate_chain(chain, A, external, 1.0)[1]
    return StateSpace(loop.A - loop.B @ loop.C, B, loop.C, np.zeros((1, 1)))
