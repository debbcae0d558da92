"""Source code of a virtual coupling and its simulated tool for a control loop, in C or in Python.

Each period, the program computes the distance e = x - y from the tool, at the position y, to the device, at the
measured position x. It computes the velocity estimate v of e, and the force f = K e + B v of the coupling on the tool.
It integrates the tool by one step of length T (`model.tool`), and returns -f, the force on the device.

If the tool is integrated by the implicit Euler method, y is its position after the step, which depends on f. Let v_0 be
the velocity estimate for e = 0, D its direct feedthrough, e_0 the distance without the force, and h f the displacement
of the tool by the force. From ``e = e_0 - h f`` and ``f = K e + B (v_0 + D e)`` follows

    e = (e_0 - h B v_0)/(1 + h (K + B D))

The velocity estimate and its filters are written by `analysis.wall_code`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from zwidth.analysis.base import SceneParts
from zwidth.analysis.wall_code import (
    describe_cautions,
    find_sections,
    format_c,
    format_python,
    reset_states,
    write_filter,
    write_wall,
)
from zwidth.core.errors import InputError, check_choice
from zwidth.model.estimate import Estimate
from zwidth.model.tool import Tool
from zwidth.units.formatting import format_wall, with_unit
from zwidth.units.unit_system import UnitSystem


class CouplingProgram(NamedTuple):
    """Program of a coupling as statements that are valid in C and Python once the mark ``@`` is replaced.

    Statements that start with "# " are comments.
    """

    head: list[str]  # lines of comment on the coupling and the tool
    call: list[str]  # lines of comment on the argument and the result
    window: int  # length of the difference in periods; 0 for none
    states: list[str]  # names of the states of the filter
    every: int  # number of periods per step of the tool
    force: list[str]  # statements that compute the force f from the measured position x, and integrate the tool


def write_program(
    scene: SceneParts, language: str = "c", cautions: Sequence[str] = (), max_force: float = math.inf
) -> str:
    """Return the source code of the wall of a scene or, if the scene has a tool, of the coupling to the tool.

    Args:
        scene: the scene with the wall.
        language: "c" or "python".
        cautions: sentences to include in the comment at the head.
        max_force: largest force of the motor in N, to which the code limits the force on the device.
    """
    if scene.tool is None:
        return write_wall(scene, language, cautions, max_force)
    check_choice("language", language, ("c", "python"))
    for name in ("position", "feedback"):
        if getattr(scene, name) is not None:
            raise InputError(f"{name}: the code of a coupling excludes it; omit {name} or the tool")
    program = build_coupling_program(scene, scene.tool, cautions, max_force)
    count, limited = program.window, max_force < math.inf
    start = ["# Place the tool at rest at the device.", "@tool_position = x", "@tool_velocity = 0.0"]
    start += ["@sample = 0"] * (program.every > 1)
    if language == "c":
        members = ["double tool_position", "double tool_velocity", *["int sample"] * (program.every > 1)]
        members += [f"double past[{count}]", "int next"] if count > 1 else ["double distance"]
        members += [f"double {name}" for name in program.states]
        past = [f"for (int k = 0; k < {count}; k++) @past[k] = 0.0", "@next = 0"]
        start += [*(past if count > 1 else ["@distance = 0.0"]), *reset_states(program.states)]
        law = f"f > {max_force!r} ? -{max_force!r} : f < -{max_force!r} ? {max_force!r} : -f" if limited else "-f"
        return format_c("coupling", [*program.head, *program.call], members, start, [*program.force, f"return {law}"])
    start += [f"@past = [0.0] * {count}", "@next = 0"] if count > 1 else ["@distance = 0.0"]
    start += reset_states(program.states)
    law = f"max(-{max_force!r}, min({max_force!r}, -f))" if limited else "-f"
    return format_python("Coupling", program.head, program.call, start, [*program.force, f"return {law}"])


def build_coupling_program(
    scene: SceneParts, tool: Tool, cautions: Sequence[str] = (), max_force: float = math.inf
) -> CouplingProgram:
    """Build the program of a coupling, as statements for either language."""
    K, B = float(scene.wall.stiffness), float(scene.wall.virtual_damping)
    velocity = write_velocity(scene.velocity.estimate(float(scene.timing.period)), float(scene.timing.period))
    solve, step = write_tool(scene, tool, velocity)
    every = getattr(tool, "every", 1)
    counter = [f"@sample = (@sample + 1) % {every}"] if every > 1 else []
    force = [
        *solve,
        "# Estimate the velocity of the device relative to the tool.",
        *velocity.update,
        f"# Compute the {'torque' if scene.unit_system.rotary else 'force'} of the coupling on the tool.",
        f"f = {K!r} * e + {B!r} * v",
        *step,
        *counter,
        "# Return the reaction, which acts on the device.",
    ]
    head = [*_describe_coupling(scene, tool, max_force), *describe_cautions(scene, cautions)]
    return CouplingProgram(head, _describe_call(scene.unit_system), velocity.window, velocity.states, every, force)


class VelocityCode(NamedTuple):
    """Statements that compute the velocity estimate v of the distance e."""

    window: int  # length of the difference in periods; 0 for none
    states: list[str]  # names of the states of the filter
    update: list[str]  # statements that compute v from e, and the states of the next sample
    at_zero: list[str]  # statements that compute v for e = 0, and leave the states unchanged
    direct: float  # direct feedthrough from e to v, in 1/s


def write_velocity(estimate: Estimate, period: float) -> VelocityCode:
    """Return the statements of the velocity estimate of the distance; ``period`` is the sampling period in s."""
    count, code = estimate.window, write_filter(estimate)
    # The distances of the last periods are stored in an array if the difference covers several periods.
    past = "@past[@next]" if count > 1 else "@distance"
    scale, advance = f"v = {code.gain / period!r} * u", [f"@next = (@next + 1) % {count}"] if count > 1 else []

    def subtract(newest: str) -> str:
        """Return the statement that computes the input u of the filter from the newest distance."""
        difference = f"{newest} - {past}" if count else newest
        return f"u = ({difference}) / {count}" if count > 1 else f"u = {difference}"

    direct = float(estimate.gain) / period / max(count, 1)
    for numerator, _ in find_sections(estimate):
        direct *= numerator[0]
    update = [subtract("e"), f"{past} = e", *advance, *code.update, scale]
    return VelocityCode(count, code.states, update, [subtract("0.0"), *code.output, scale], direct)


def write_tool(scene: SceneParts, tool: Tool, velocity: VelocityCode) -> tuple[list[str], list[str]]:
    """Return the statements that compute the distance e, and those that integrate the tool after the force f."""
    every = getattr(tool, "every", 1)
    length = every * float(scene.timing.period)
    rate, damping, stiffness = length / float(tool.mass), float(tool.damping), float(tool.stiffness)
    move = f"@tool_position += {length!r} * @tool_velocity"

    def limit(statements: list[str]) -> list[str]:
        """Return statements with the condition that the tool makes a step in this period."""
        return statements if every == 1 else ["if @sample == 0:", *(f"    {line}" for line in statements)]

    if tool.integrator == "semi-implicit":
        forces = _join((1.0, "f"), (-damping, "@tool_velocity"), (-stiffness, "@tool_position"))
        change = f"@tool_velocity += {rate!r} * {forces if forces == 'f' else f'({forces})'}"
        solve = ["# Compute the distance from the tool to the device.", "e = x - @tool_position"]
        return solve, limit(["# Integrate the tool by semi-implicit Euler: velocity, then position.", change, move])
    K, B = float(scene.wall.stiffness), float(scene.wall.virtual_damping)
    share = 1.0 / (1.0 + damping * rate + stiffness * rate * length)
    lever = rate * length * share
    # Compute v_free and e before the condition, so that both are always defined.
    solve = ["e = x - @tool_position"] * (every > 1) + [
        "# Implicit Euler method: the step of the tool depends on f. First compute its velocity for f = 0.",
        f"v_free = {_join((share, '@tool_velocity'), (-share * rate * stiffness, '@tool_position'))}",
    ]
    solve += limit(
        [
            "# Compute the velocity v that the estimate would return for the distance e = 0.",
            *velocity.at_zero,
            "# Solve the equations of tool and coupling for the distance e after the step.",
            f"e = x - (@tool_position + {length!r} * v_free)",
            f"e = (e - {lever * B!r} * v) / {1.0 + lever * (K + B * velocity.direct)!r}",
        ]
    )
    change = f"@tool_velocity = v_free + {rate * share!r} * f"
    return solve, limit(["# Integrate the tool: velocity, then position.", change, move])


def _join(*terms: tuple[float, str]) -> str:
    """Return a sum of products as an expression, without products that are 0."""
    texts = [
        f"{'-' if factor < 0 else '+'} {'' if abs(factor) == 1.0 else f'{abs(factor)!r} * '}{name}"
        for factor, name in terms
        if factor
    ]
    return " ".join(texts).removeprefix("+ ")


def _describe_coupling(scene: SceneParts, tool: Tool, max_force: float) -> list[str]:
    """Return two lines of comment: the coupling and the limit of its force, and the tool."""
    system, wall = scene.unit_system, scene.wall
    coupling = format_wall(float(wall.stiffness), float(wall.virtual_damping), system)
    line = f"Virtual coupling: {coupling}, velocity by {type(scene.velocity).__name__}, "
    line += f"{with_unit(1.0 / float(scene.timing.period), 'Hz')}."
    if max_force < math.inf:
        name = "Torque" if system.rotary else "Force"
        line += f" {name} on the device limited to {with_unit(max_force, system['N'])}."
    units = {"mass": "kg", "damping": "N s/m", "stiffness": "N/m"}
    values = [(name, float(getattr(tool, name)), system[unit]) for name, unit in units.items()]
    if system.rotary:
        values[0] = ("moment of inertia", *values[0][1:])
    texts = [f"{name} {with_unit(value, unit)}" for name, value, unit in values if value]
    every = getattr(tool, "every", 1)
    rate = f", one step every {every} periods" if every > 1 else ""
    return [line, f"Tool: {', '.join(texts)}, {tool.integrator} Euler method{rate}."]


def _describe_call(system: UnitSystem) -> list[str]:
    """Return the lines of comment on the argument and the result of the generated function, and on the tool."""
    position, force, unit = ("angle", "torque", "rad") if system.rotary else ("position", "force", "m")
    return [
        f"x is the {position} of the device in {unit}; the result is the {force} on the device in {system['N']}.",
        f"tool_position is the {position} of the tool in {unit}, after the step of this call.",
        "x must be continuous: unwrap an encoder that restarts.",
    ]
