"""Write the program of a virtual coupling and its simulated tool as source code in C or in Python.

The *coupling* is a spring K and a damper B between the device, at the measured position x, and the *tool*, a mass at
the position y that the program integrates by one step of length T per period (`model.tool`). In each period, the
program computes the distance e = x - y, the estimate v of its derivative, and the force f = K e + B v of the coupling
on the tool. It returns -f, the force on the device.

If the tool is integrated by the implicit Euler method, y is its position after the step, which depends on f. Let v_0 be
the velocity estimate for e = 0, D its direct feedthrough, e_0 the distance without the force, and h f the displacement
of the tool by the force. From ``e = e_0 - h f`` and ``f = K e + B (v_0 + D e)`` follows

    e = (e_0 - h B v_0)/(1 + h (K + B D))

If the scene has a position estimate or further feedback, e is computed from the position estimate of the device, and v
is the velocity estimate of the device minus that of the tool. Then v_0 is the velocity estimate of the device minus
that of a tool which is at the position of the device. The force r of the feedback is added to f after
the step of the tool. Estimates and filters are written by `analysis.wall_code`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from zwidth.analysis.base import SceneParts
from zwidth.analysis.wall_code import (
    build_program,
    describe_cautions,
    find_sections,
    format_c,
    format_python,
    omit_output,
    reset_states,
    write_filter,
    write_memory,
    write_wall,
)
from zwidth.core.errors import check_choice
from zwidth.model.loop_estimates import build_estimates
from zwidth.model.position import has_velocity
from zwidth.model.tool import Tool
from zwidth.units.formatting import format_wall, with_unit
from zwidth.units.unit_system import UnitSystem


class CouplingProgram(NamedTuple):
    """Program of a coupling as lists of statements in C or Python; "@" marks a state, "# " begins a comment."""

    members: list[str]  # declarations of the states, for C code
    start: list[str]  # statements that initialize the states at rest, with the tool at the position of the device
    force: list[str]  # statements that compute the force f on the tool (-f acts on the device) and integrate the tool


class DeviceCode(NamedTuple):
    """Statements that estimate position and velocity of the device, and compute the further feedback."""

    members: list[str]  # declarations of the states in C
    start: list[str]  # statements that set the states to their values at rest
    update: list[str]  # statements that compute the estimates of position and velocity, and the force r of the feedback
    position: str  # position that the coupling uses: "x" (measured position) or "y" (position estimate)


class VelocityCode(NamedTuple):
    """Statements that estimate the velocity v of the device relative to the tool.

    The statements estimate v from the distance e, or subtract the estimated velocity of the tool from that of the
    device.
    """

    members: list[str]  # declarations of the states in C
    start: list[str]  # statements that set the states to their values at rest
    update: list[str]  # statements that compute the relative velocity v and the states for the next sample
    at_zero: list[str]  # statements that compute v for the distance e = 0, and leave the states unchanged
    direct: float  # direct feedthrough from e to v, in 1/s


def write_program(
    scene: SceneParts, language: str = "c", cautions: Sequence[str] = (), max_force: float = math.inf
) -> str:
    """Return the source code of a wall or, if the scene has a tool, of the coupling between device and tool.

    Args:
        scene: the scene with the wall.
        language: "c" or "python".
        cautions: sentences to include in the comment at the head of the code.
        max_force: largest force of the motor in N, to which the code limits the force on the device.
    """
    if scene.tool is None:
        return write_wall(scene, language, cautions, max_force)
    check_choice("language", language, ("c", "python"))
    members, start, force = build_coupling_program(scene, scene.tool, language)
    head = [*_describe_coupling(scene, scene.tool, max_force), *describe_cautions(scene, cautions)]
    call, limited = _describe_call(scene.unit_system), max_force < math.inf
    if language == "c":
        law = f"f > {max_force!r} ? -{max_force!r} : f < -{max_force!r} ? {max_force!r} : -f" if limited else "-f"
        return format_c("coupling", [*head, *call], members, start, [*force, f"return {law}"])
    law = f"max(-{max_force!r}, min({max_force!r}, -f))" if limited else "-f"
    return format_python("Coupling", head, call, start, [*force, f"return {law}"])


def build_coupling_program(scene: SceneParts, tool: Tool, language: str) -> CouplingProgram:
    """Build the statements of the program of a coupling to a simulated tool, in C or in Python."""
    K, B, every = float(scene.wall.stiffness), float(scene.wall.virtual_damping), tool.every
    device = write_device(scene, language)
    velocity = write_velocity(scene, language, device.position)
    solve, step = write_tool(scene, tool, device.position, velocity)
    name = "torque" if scene.unit_system.rotary else "force"
    further = [f"# Add the {name} of the further feedback, which acts on the device only.", "f += r"]
    force = [
        *device.update,
        *solve,
        "# Estimate the velocity of the device relative to the tool.",
        *velocity.update,
        f"# Compute the {name} of the coupling on the tool.",
        f"f = {K!r} * e + {B!r} * v",
        *step,
        *[f"@sample = (@sample + 1) % {every}"] * (every > 1),
        *(further if scene.feedback is not None else []),
        "# Return the reaction, which acts on the device.",
    ]
    members = ["double tool_position", "double tool_velocity", *["int sample"] * (every > 1)]
    start = ["# Place the tool at rest at the device.", "@tool_position = x", "@tool_velocity = 0.0"]
    start += ["@sample = 0"] * (every > 1)
    return CouplingProgram(
        [*members, *device.members, *velocity.members], [*start, *device.start, *velocity.start], force
    )


def write_device(scene: SceneParts, language: str) -> DeviceCode:
    """Return the statements that estimate position and velocity of the device, and compute the further feedback.

    The lists are empty if the scene has neither a position estimate nor further feedback.
    """
    if scene.position is None and scene.feedback is None:
        return DeviceCode([], [], [], "x")
    program = build_program(scene)
    members, fill = write_memory(language, program.window, program.memory, program.memory)
    update = ["# Estimate the position and the velocity of the device.", *program.force]
    if program.feedback:
        update += ["# Compute the further feedback.", *program.feedback]
    members += [f"double {name}" for name in program.states]
    return DeviceCode(members, [*program.begin, *fill, *program.start], update, program.depth)


def write_velocity(scene: SceneParts, language: str, position: str) -> VelocityCode:
    """Return the statements that estimate the velocity of the device relative to the tool.

    ``position`` is the variable with the position of the device, "x" (measured) or "y" (estimate).
    """
    period, estimates = float(scene.timing.period), build_estimates(scene)
    # Estimate the velocities of tool and device separately if the position is filtered or further feedback exists.
    # Otherwise estimate the relative velocity from the distance between device and tool.
    prefix, newest, value, at_rest = ("tool_", "y_tool", "v_tool", "x") if estimates else ("", "e", "v", "0.0")
    estimate = estimates.of_tool if estimates else scene.velocity.estimate(period)
    count, code = estimate.window, write_filter(estimate, prefix)
    single = "last_y_tool" if estimates else "distance"
    past = f"@{prefix}past[@{prefix}next]" if count > 1 else f"@{single}"
    advance = [f"@{prefix}next = (@{prefix}next + 1) % {count}"] if count > 1 else []

    def estimate_from(name: str, statements: list[str]) -> list[str]:
        """Return statements that estimate a velocity; the variable called ``name`` contains the newest position."""
        difference = f"{name} - {past}" if count else name
        entering = f"u = ({difference}) / {count}" if count > 1 else f"u = {difference}"
        scale = f"{value} = {code.gain / period!r} * u"
        return [entering, *statements, scale, *(["v_rest = v - v_tool"] if estimates else [])]

    direct = float(estimate.gain) / period / max(count, 1)
    for numerator, _ in find_sections(estimate):
        direct *= numerator[0]
    members, start = write_memory(language, count, single, at_rest, prefix)
    start += reset_states(code.states) if count or not estimates else omit_output(["u = x", *code.start])
    update = estimate_from(newest, [f"{past} = {newest}", *advance, *code.update])
    if estimates:
        update = [f"y_tool = {position} - e", *update[:-1], "v -= v_tool"]
    return VelocityCode(
        [*members, *(f"double {name}" for name in code.states)],
        start,
        update,
        estimate_from(position if estimates else "0.0", code.output),
        direct,
    )


def write_tool(scene: SceneParts, tool: Tool, position: str, velocity: VelocityCode) -> tuple[list[str], list[str]]:
    """Return two lists of statements: the first computes the distance e of device and tool, the second moves the tool.

    Args:
        scene: the scene with the wall.
        tool: the tool.
        position: name of the variable with the position of the device, "x" or "y".
        velocity: statements of the estimate of the relative velocity.
    """
    every = tool.every
    length = every * float(scene.timing.period)
    rate, damping, stiffness = length / float(tool.mass), float(tool.damping), float(tool.stiffness)
    move = f"@tool_position += {length!r} * @tool_velocity"

    def limit(statements: list[str]) -> list[str]:
        """Return statements that run only in the periods in which the tool makes a step."""
        return statements if every == 1 else ["if @sample == 0:", *(f"    {line}" for line in statements)]

    if tool.integrator == "semi-implicit":
        forces = _join((1.0, "f"), (-damping, "@tool_velocity"), (-stiffness, "@tool_position"))
        change = f"@tool_velocity += {rate!r} * {forces if forces == 'f' else f'({forces})'}"
        solve = ["# Compute the distance from the tool to the device.", f"e = {position} - @tool_position"]
        return solve, limit(["# Integrate the tool by semi-implicit Euler: velocity, then position.", change, move])
    K, B = float(scene.wall.stiffness), float(scene.wall.virtual_damping)
    share = 1.0 / (1.0 + damping * rate + stiffness * rate * length)
    lever = rate * length * share
    rest = "v" if position == "x" and scene.feedback is None else "v_rest"
    # Define e and v_free, the velocity of the tool for f = 0, also in periods without a step of the tool.
    solve = [f"e = {position} - @tool_position"] * (every > 1) + [
        "# Implicit Euler method: the step of the tool depends on f. First compute its velocity for f = 0.",
        f"v_free = {_join((share, '@tool_velocity'), (-share * rate * stiffness, '@tool_position'))}",
    ]
    solve += limit(
        [
            f"# Compute the relative velocity {rest} that the estimate would return for the distance e = 0.",
            *velocity.at_zero,
            "# Solve the equations of tool and coupling for the distance e after the step.",
            f"e = {position} - (@tool_position + {length!r} * v_free)",
            f"e = (e - {lever * B!r} * {rest}) / {1.0 + lever * (K + B * velocity.direct)!r}",
        ]
    )
    change = f"@tool_velocity = v_free + {rate * share!r} * f"
    return solve, limit(["# Integrate the tool: velocity, then position.", change, move])


def _join(*terms: tuple[float, str]) -> str:
    """Return the sum of products ``factor * name`` as an expression in source code, without products that are 0."""
    texts = [
        f"{'-' if factor < 0 else '+'} {'' if abs(factor) == 1.0 else f'{abs(factor)!r} * '}{name}"
        for factor, name in terms
        if factor
    ]
    return " ".join(texts).removeprefix("+ ")


def _describe_coupling(scene: SceneParts, tool: Tool, max_force: float) -> list[str]:
    """Return comment lines for the source code: coupling, largest force, tool, position estimate and feedback."""
    system, wall = scene.unit_system, scene.wall
    coupling = format_wall(float(wall.stiffness), float(wall.virtual_damping), system)
    estimator = type(scene.position if has_velocity(scene.position) else scene.velocity).__name__
    line = f"Virtual coupling: {coupling}, velocity by {estimator}, "
    line += f"{with_unit(1.0 / float(scene.timing.period), 'Hz')}."
    name = "Torque" if system.rotary else "Force"
    if max_force < math.inf:
        line += f" {name} on the device limited to {with_unit(max_force, system['N'])}."
    units = {"mass": "kg", "damping": "N s/m", "stiffness": "N/m"}
    values = [(name, float(getattr(tool, name)), system[unit]) for name, unit in units.items()]
    if system.rotary:
        values[0] = ("moment of inertia", *values[0][1:])
    texts = [f"{name} {with_unit(value, unit)}" for name, value, unit in values if value]
    rate = f", one step every {tool.every} periods" if tool.every > 1 else ""
    lines = [line, f"Tool: {', '.join(texts)}, {tool.integrator} Euler method{rate}."]
    if scene.position is not None:
        lines.append(f"The coupling uses the position estimate y, computed by {type(scene.position).__name__}.")
    if scene.feedback is not None:
        lines.append(f"{name} r of {type(scene.feedback).__name__} acts on the device in addition to the coupling.")
    return lines


def _describe_call(system: UnitSystem) -> list[str]:
    """Return comment lines on the argument and the result of the generated function, and on the tool."""
    position, force, unit = ("angle", "torque", "rad") if system.rotary else ("position", "force", "m")
    return [
        f"x is the {position} of the device in {unit}; the result is the {force} on the device in {system['N']}.",
        f"tool_position is the {position} of the tool in {unit}, after the step of this call.",
        "x must be continuous: unwrap an encoder that restarts.",
    ]
