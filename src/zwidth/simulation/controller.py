"""Control program of a simulation at one sample: measure, estimate position and velocity, compute the command.

k is the index of a sample. A *ring* is a circular buffer of positions or commands; sample k is stored at the index k
modulo its length, a power of 2. All functions are pure functions of arrays whose last axis is the batch of simulations.
FOAW is the adaptive velocity estimate of Janabi-Sharifi et al. 2000. `simulation.parameters` describes the estimates
and the further feedback, and docs/theory/simulation.md the program as step T2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth.core.types import Array
from zwidth.model.tool import ToolStep
from zwidth.simulation.parameters import Estimator, Filter, Options, Parameters
from zwidth.simulation.propagation import dot, read, times

# Factor on the noise bound of FOAW, slightly above 1, so that deviations of exactly one encoder count are admissible in
# spite of rounding errors.
SLACK = 1.0 + 1e-9


class FilterStates(NamedTuple):
    """States of the filters of the control program, each of shape (order, batch)."""

    position: Array  # state of the position estimate
    velocity: Array  # state of the velocity estimate
    feedback: Array  # state of the further feedback, such as an integral
    tool: Array  # state of the estimate of the velocity of the tool


class Controller(NamedTuple):
    """State of the control program between two samples: previous measurements, commands, filter state and tool."""

    positions: Array  # ring of the positions or distances from which the velocity is estimated, (length, batch)
    filters: FilterStates
    commands: Array  # ring of commands, (length, batch)
    touching: Array  # True if the last sample was in contact with the wall, (batch,)
    tool: Array  # position of the tool after its last step, and its change in this step, (2, batch)
    tool_positions: Array  # ring of the positions of the tool from which its velocity is estimated, (length, batch)


class Reading(NamedTuple):
    """Result of the control program at one sample; each array has the shape (batch,)."""

    measured: Array  # measured position
    velocity: Array  # estimated velocity
    command: Array  # commanded force
    touching: Array  # True if in contact with the wall
    tool_position: Any = None  # position of the tool from which the force is computed; None without a tool
    coupling_force: Any = None  # force of the coupling on the tool; None without a tool


def write(rows: Array, row: Array, index: Array) -> Array:
    """Return a copy of the array ``rows`` in which ``row`` replaces the entry at ``index`` along the first axis."""
    return jax.lax.dynamic_update_index_in_dim(rows, row, index, 0, allow_negative_indices=False)


def look_back(ring: Array, k: Array, back: Array) -> Array:
    """Return the entry of a ring that was written ``back`` samples before sample k.

    ``back`` has the shape (batch,), or (1,) if it is equal for all simulations. The length of a ring is a power of 2.
    """
    index = (k - back) & (len(ring) - 1)
    if back.shape[-1] == 1:
        return read(ring, index[0])
    return jnp.take_along_axis(ring, index[None], 0)[0]


@np.errstate(all="ignore")
def quantize(quantum: Any, position: Any) -> Any:
    """Round a position to multiples of ``quantum``; return it unchanged if the quantum is 0 or rounding overflows."""
    xp = np if isinstance(position, np.ndarray) else jnp
    rounded = quantum * xp.floor(position / quantum + 0.5)
    return xp.where(xp.isfinite(rounded), rounded, position)


def control(
    params: Parameters, options: Options, controller: Controller, k: Array, sensed: Array
) -> tuple[Controller, Reading]:
    """Run the control program at one sample: measure, estimate position and velocity, and compute the command.

    Args:
        params: parameters of the simulations.
        options: structure of the compiled program.
        controller: state of the control program before the sample.
        k: index of the sample.
        sensed: position at the sensor, including noise, before quantization.

    Returns:
        The state of the control program after the sample, and the reading.
    """
    measured = quantize(params.resolution, sensed)
    states = controller.filters
    position = estimated_from = measured
    if options.position:
        position, filtered = _filter(params.position, states.position, measured)
        states = states._replace(position=filtered)
        estimated_from = jnp.where(params.filtered_input, position, measured)
    if options.tool and not options.filters_tool:
        # Estimate the relative velocity from the distance between tool and device.
        rest = _estimate_velocity(params.estimator, controller.positions, states.velocity, k, 0.0 * measured)[0]
        position = estimated_from = _find_distance(params, options, controller, k, measured, rest)
    positions = write(controller.positions, estimated_from, k & (len(controller.positions) - 1))
    if options.foaw:
        velocity = _adapt_window(positions, k, estimated_from, params.estimator.bound, options.foaw)
    else:
        velocity, filtered = _estimate_velocity(params.estimator, positions, states.velocity, k, estimated_from)
        states = states._replace(velocity=filtered)
    estimates, tool_positions = jnp.stack([measured, position, velocity]), controller.tool_positions
    if options.filters_tool:
        # Estimate the velocities of tool and device separately, and subtract them.
        estimate = params.tool_estimator, tool_positions, states.tool, k
        rest = velocity - _estimate_velocity(*estimate, position)[0]
        distance = _find_distance(params, options, controller, k, position, rest)
        tool_velocity, filtered = _estimate_velocity(*estimate, position - distance)
        tool_positions = write(tool_positions, position - distance, k & (len(tool_positions) - 1))
        states = states._replace(tool=filtered)
        position, velocity = distance, velocity - tool_velocity
    touching = params.bilateral | (position > 0)
    if options.law is None:
        force = -(params.alpha * position + params.beta * velocity)
    else:
        force = options.law(position, velocity / params.period, k * params.period) / params.force
        # With a force law, count a nonzero force as contact, because a force law defines no surface of the wall.
        touching &= force != 0
    coupling_force = -force
    if options.feedback:
        entering = dot(params.feedback.weights, estimates)
        further, filtered = _filter(params.feedback.filter, states.feedback, entering)
        # Reset the state outside of contact, so that an integrator does not integrate the distance from the wall.
        states = states._replace(feedback=jnp.where(touching, filtered, 0.0))
        force = force - further
    force = jnp.where(touching, force, 0.0)
    force = jnp.where(params.pulling, force, jnp.minimum(force, 0.0))
    tool, further_readings = controller.tool, {}
    if options.tool:
        # Apply the force of the coupling to the tool without the limits of the motor, because the tool is simulated.
        tool, used = _integrate_tool(params.tool, tool, k, coupling_force)
        further_readings = {"tool_position": used, "coupling_force": coupling_force}
    ring, motor = controller.commands, params.motor
    last = read(ring, (k - 1) & (len(ring) - 1))
    force = jnp.clip(force, -motor.max_force, motor.max_force)
    command = jnp.clip(force, last - motor.max_rate, last + motor.max_rate)
    commands = write(ring, command, k & (len(ring) - 1))
    reading = Reading(measured, velocity, command, touching, **further_readings)
    return Controller(positions, states, commands, touching, tool, tool_positions), reading


def _estimate_velocity(
    estimator: Estimator, positions: Array, state: Array, k: Array, newest: Array
) -> tuple[Array, Array]:
    """Return a linear velocity estimate at sample k and the next state of its filter. ``newest`` is the input."""
    window = estimator.window
    difference = (newest - look_back(positions, k, window)) / jnp.maximum(window, 1)
    return _filter(estimator.filter, state, jnp.where(window > 0, difference, newest))


def _integrate_tool(step: ToolStep, tool: Array, k: Array, force: Array) -> tuple[Array, Array]:
    """Return the state of the tool after period k, and the position of the tool that determines the coupling force."""
    due = k % step.every == 0
    change = jnp.where(due, _step_freely(step, tool) + step.gain * force, 0.0)
    after = jnp.stack([tool[0] + change, jnp.where(due, change, tool[1])])
    return after, jnp.where(step.implicit, after[0], tool[0])


def _step_freely(step: ToolStep, tool: Array) -> Array:
    """Return the change of the position of the tool in one step if the coupling exerts no force."""
    return step.decay * tool[1] - step.spring * tool[0]


def _find_distance(
    params: Parameters, options: Options, controller: Controller, k: Array, position: Array, rest: Array
) -> Array:
    """Return the distance e from the tool to the device at sample k (docs/theory/simulation.md, T9).

    With the implicit Euler method, the position of the tool depends on the force f of the coupling, which depends on e.
    Both equations are linear, ``e = e_0 - gain f`` and ``f = alpha e + beta (v_0 + D e)``, and are solved for e. Here
    e_0 is the distance for f = 0, v_0 the relative velocity for e = 0, and D the direct feedthrough of its estimate.

    Args:
        params: parameters of the simulations.
        options: structure of the compiled program.
        controller: state of the control program before the sample.
        k: index of the sample.
        position: measured position of the device, or its estimate.
        rest: relative velocity v_0.
    """
    tool, estimator = params.tool, params.tool_estimator if options.filters_tool else params.estimator
    solved = tool.implicit & (k % tool.every == 0)
    distance = position - (controller.tool[0] + jnp.where(solved, _step_freely(tool, controller.tool), 0.0))
    if options.foaw or options.law is not None:
        # With FOAW or a force law, all tools use the semi-implicit Euler method, so e does not depend on f.
        return distance
    gain, direct = jnp.where(solved, tool.gain, 0.0), estimator.filter.D / jnp.maximum(estimator.window, 1)
    return (distance - gain * params.beta * rest) / (1.0 + gain * (params.alpha + params.beta * direct))


def _filter(part: Filter, state: Array, entering: Array) -> tuple[Array, Array]:
    """Return the output of a filter for the input ``entering``, and the next state of the filter."""
    output = part.D * entering
    if not len(state):
        return output, state
    return output + dot(part.C, state), times(part.A, state) + part.B * entering


def _adapt_window(ring: Array, k: Array, newest: Array, bound: Array, longest: int) -> Array:
    """Return the FOAW velocity estimate: the slope between both ends of the longest admissible window.

    A window of past samples is admissible if the positions in it deviate by at most ``bound`` from the straight line
    between its ends, and if all shorter windows are admissible, too.

    Args:
        ring: ring of positions.
        k: index of the current sample.
        newest: position at the current sample.
        bound: noise bound of the positions.
        longest: largest length of the window, in samples.
    """
    past = ring[(k - np.arange(longest + 1)) & (len(ring) - 1)]
    back = np.arange(1, longest + 1)[:, None]
    slopes = (newest - past[1:]) / back
    missed = jnp.abs(past[1:] - (newest - slopes[:, None] * back))  # of shape (window, sample, batch)
    within = jnp.all((missed <= bound * SLACK) | (back > back[:, None]), axis=1)
    length = jnp.sum(jnp.cumprod(within, 0), 0)
    return jnp.take_along_axis(slopes, jnp.maximum(length - 1, 0)[None], 0)[0]


def start_controller(
    params: Parameters,
    options: Options,
    motion: tuple[np.ndarray, np.ndarray],
    tool: np.ndarray,
    rings: tuple[int, int],
) -> Controller:
    """Return the state of the control program before the first sample, after uniform motion without commands.

    The estimates are in steady state: their transients have decayed. The state of the further feedback is 0.

    Args:
        params: parameters of the simulations.
        options: structure of the compiled program.
        motion: position of the sensor at sample 0, and its change per period.
        tool: position of the tool at sample 0 without a force of the coupling, and its change per period. A position of
            NaN means the measured position of the device.
        rings: lengths of the rings of positions and of commands.
    """
    x, v = motion
    back = np.mod(-np.arange(rings[0]), rings[0])
    past, speed = quantize(params.resolution, x - back[:, None] * v), v
    tool_past, tool_speed = np.zeros((0, x.size)), tool[1]
    if options.tool:
        place = np.where(np.isnan(tool[0]), past[0], tool[0])
        tool_past = place - back[:, None] * tool_speed
        if not options.filters_tool:
            past, speed = past - tool_past, v - tool_speed
        # The implicit Euler method makes a step before it computes the force at sample 0, so start one step earlier.
        step = params.tool.every * tool_speed
        tool = np.stack([place - np.where(params.tool.implicit, step, 0.0), step])
    filtered, position, change = _settle(params.position, past[0], v)
    if options.position:
        past = np.where(params.filtered_input, position - back[:, None] * change, past)
        speed = np.where(params.filtered_input, change, speed)
    settled, feedback = (
        _settle_velocity(params.estimator, past[0], speed),
        np.zeros((len(params.feedback.filter.B), x.size)),
    )
    of_tool = np.zeros((0, x.size))
    if options.filters_tool:
        of_tool = _settle_velocity(params.tool_estimator, tool_past[0], tool_speed)
    states = FilterStates(filtered, settled, feedback, of_tool)
    return Controller(past, states, np.zeros((rings[1], x.size)), np.zeros(x.size, bool), tool, tool_past)


def _settle_velocity(estimator: Estimator, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the steady state of the filter of a velocity estimate during the uniform motion ``x + k v``."""
    # If the velocity estimate starts with a difference of positions over a window, the input of its filter is constant
    # during uniform motion. Otherwise this input is the position, a ramp.
    differs = estimator.window > 0
    return _settle(estimator.filter, np.where(differs, v, x), np.where(differs, 0.0, v))[0]


def _settle(part: Filter, x: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the steady state of a filter whose input at sample k is the ramp ``x + k v``, and the ramp of its output.

    Args:
        part: the filter.
        x: input at sample 0.
        v: change of the input per period.

    Returns:
        The state before sample 0, the output at sample 0, and the change of the output per period.
    """
    A, B, C, D = (np.asarray(matrix) for matrix in part)
    left = np.eye(len(B)) - np.moveaxis(A, -1, 0)
    gain = np.linalg.solve(left, np.moveaxis(B, -1, 0)[..., None])
    ramp, gain = np.linalg.solve(left, gain)[..., 0].T, gain[..., 0].T
    state = gain * x - ramp * v
    return state, np.sum(C * state, 0) + D * x, (np.sum(C * gain, 0) + D) * v
