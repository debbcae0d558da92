"""Realize the open and the closed loop of a wall in state space.

In normalized units, the controller of the wall (alpha, beta) computes the force u from the sampled position y:

    u = -(alpha + beta F) y           with a velocity estimate F
    u = -(alpha P + beta V + R) y     with a position estimate P, a velocity estimate V and further feedback R
    u = -C/(1 + C G_t) y              with a simulated tool: C is one of the two controllers above, now a coupling, and
                                      G_t the response of the tool's position to the force

An external force, held constant over each period, acts on the first body without delay.
"""

from __future__ import annotations

import numpy as np

from zwidth.model.estimate import Estimate
from zwidth.model.mechanism import AnyChain
from zwidth.model.state_space import StateSpace, connect_in_series, realize_estimate, realize_estimates
from zwidth.model.tool import ToolResponse
from zwidth.plant.composed_plant import factor_tool
from zwidth.plant.sampled_states import integrate_chain, sample_states


def realize_open_loop(chain: AnyChain, alpha: float, beta: float) -> StateSpace:
    """Return the open loop ``L = (alpha + beta F) G`` in state space, from the input of the wall to the position."""
    return connect_in_series(_realize_controller(chain, alpha, beta), sample_states(chain).realize())


def _realize_controller(chain: AnyChain, alpha: float, beta: float) -> StateSpace:
    """Return the controller in state space: ``alpha + beta F``, or ``alpha P + beta V + R`` if the scene has P or R."""
    if chain.estimates is not None:
        program = realize_estimates(chain.estimates)
        gains = np.array([[alpha, beta, 1.0]])
        return StateSpace(program.A, program.B, gains @ program.C, gains @ program.D)
    f = realize_estimate(chain.estimate)
    return StateSpace(f.A, f.B, beta * f.C, alpha + beta * f.D)


def _couple_tool(coupling: StateSpace, tool: ToolResponse) -> StateSpace:
    """Return the state-space model from the position x of the device to the force of a virtual coupling.

    The coupling C connects the device with a simulated tool at the position y = G_t f. Its force f = C (x - y) is
    therefore ``C/(1 + C G_t) x``.
    """
    plant = factor_tool(tool)
    y = realize_estimate(Estimate(0, plant.gain, 0, plant.zeros, plant.poles))
    # The distance x - y is ``share`` times x plus ``states`` times the states of coupling and tool.
    share = 1.0 / (1.0 + float(y.D[0, 0] * coupling.D[0, 0]))
    states = -share * np.concatenate([y.D @ coupling.C, y.C], 1)
    C = np.pad(coupling.C, ((0, 0), (0, len(y.A)))) + coupling.D @ states
    A = np.block([[coupling.A, np.zeros((len(coupling.A), 2))], [np.zeros((2, len(coupling.A))), y.A]])
    A += np.concatenate([coupling.B @ states, y.B @ C])
    return StateSpace(A, share * np.concatenate([coupling.B, y.B @ coupling.D]), C, share * coupling.D)


def realize_closed_loop(chain: AnyChain, alpha: float, beta: float, tool: ToolResponse | None = None) -> StateSpace:
    """Return the closed loop in state space, from an external force held over each period to the sampled position.

    With a tool, the wall (alpha, beta) is the coupling between device and tool.
    """
    controller = _realize_controller(chain, alpha, beta)
    controller = controller if tool is None else _couple_tool(controller, tool)
    loop, filter_order = connect_in_series(controller, sample_states(chain).realize()), len(controller.A)
    A, _, external = chain.realize()
    B = np.zeros((len(loop.A), 1))
    B[filter_order : filter_order + len(external), 0] = integrate_chain(chain, A, external, 1.0)[1]
    return StateSpace(loop.A - loop.B @ loop.C, B, loop.C, np.zeros((1, 1)))
