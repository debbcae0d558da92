"""Realize the open and the closed loop of a wall in state space.

In normalized units, the controller of the wall (alpha, beta) computes the force u from the sampled position y:

    u = -(alpha + beta F) y           with a velocity estimate F
    u = -(alpha P + beta V + R) y     with a position estimate P, a velocity estimate V and further feedback R

With a simulated tool, u is the force of a virtual coupling between device and tool, plus R (`_couple_tool`).

An external force, held constant over each period, acts on the first body without delay.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from zwidth.model.estimate import Estimate
from zwidth.model.loop_estimates import LoopEstimates
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


def _couple_tool(chain: AnyChain, alpha: float, beta: float, tool: ToolResponse) -> StateSpace:
    """Return the controller of a virtual coupling to a tool, in state space from the device position x to the force.

    The coupling computes ``f = alpha (P x - y) + beta (V x - V_t y)``. The tool has the position y = G_t f.
    The force on the device is f + R x with the further feedback R. One filter computes the relative velocity, unless an
    observer estimates V x or R needs V x as an input.
    """
    estimates = chain.estimates or LoopEstimates(velocity=chain.estimate)
    if estimates.uses_velocity:
        # Filter x and y separately, because V x is needed as an input of R, or an observer computes it.
        program, sources = realize_estimates(estimates), np.array([[alpha, beta, 0.0], [0.0] * 3, [0.0, 0.0, 1.0]])
    else:
        # Omit the velocity filter from the program, whose second output is then the input of this filter (P x or x).
        program = realize_estimates(replace(estimates, velocity=Estimate(0)))
        sources = np.array([[alpha, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    plant = factor_tool(tool)
    difference, response = (
        realize_estimate(estimates.of_tool),
        realize_estimate(Estimate(0, plant.gain, 0, plant.zeros, plant.poles)),
    )
    # The states are those of the program, the velocity filter and the tool.
    # A row vector represents each signal: its coefficients of all states and, in the last column, of the position x.
    # ``rest`` and ``spring`` do not depend on the tool position y. The velocity filter has the input rest - y,
    # and the coupling has the force spring - alpha y + beta (output of the filter).
    sizes = [len(program.A), len(difference.A), len(response.A)]
    ends = np.cumsum([0, *sizes])
    rows = np.eye(ends[-1] + 1)
    own, filtered, moved = (rows[start:end] for start, end in pairwise(ends.tolist()))
    x = rows[-1:]
    spring, rest, further = (sources @ (program.C @ own + program.D @ x))[:, None]
    through = float(response.D[0, 0])
    gain = alpha + beta * float(difference.D[0, 0])
    still = response.C @ moved
    # The position of the tool, y = still + through f, depends on f. Insert it into the force, and solve for f.
    f = spring - alpha * still + beta * (difference.C @ filtered + difference.D @ (rest - still))
    f = f / (1.0 + gain * through)
    y = still + through * f
    states = [
        program.A @ own + program.B @ x,
        difference.A @ filtered + difference.B @ (rest - y),
        response.A @ moved + response.B @ f,
    ]
    table, force = np.concatenate(states), f + further
    return StateSpace(table[:, :-1], table[:, -1:], force[:, :-1], force[:, -1:])


def realize_closed_loop(chain: AnyChain, alpha: float, beta: float, tool: ToolResponse | None = None) -> StateSpace:
    """Return the closed loop in state space, from an external force held over each period to the sampled position.

    With a tool, the wall (alpha, beta) is the coupling between device and tool.
    """
    arguments = chain, alpha, beta
    controller = _realize_controller(*arguments) if tool is None else _couple_tool(*arguments, tool)
    loop, filter_order = connect_in_series(controller, sample_states(chain).realize()), len(controller.A)
    A, _, external = chain.realize()
    B = np.zeros((len(loop.A), 1))
    B[filter_order : filter_order + len(external), 0] = integrate_chain(chain, A, external, 1.0)[1]
    return StateSpace(loop.A - loop.B @ loop.C, B, loop.C, np.zeros((1, 1)))
