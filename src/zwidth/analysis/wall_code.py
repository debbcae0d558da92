"""Source code of a wall with its estimates and further feedback for a control loop, in C or in Python.

From the measured position x, the program computes the position estimate y and the velocity estimate v. Inside of the
wall, y > 0, it computes the force ``-(K y + B v + r)`` with the force r of the further feedback (`model.feedback`).
Outside of the wall the force is 0, and the states of the further feedback are set to 0.

The velocity estimate is a difference over a window, followed by a filter. The position estimate and the further
feedback are filters. A filter consists of sections of first and second order in powers of ``zeta = z - 1``. A filter
that is slow compared with the sampling rate has poles close to z = 1, so coefficients in powers of z would lose digits.
A second-order section

    (b2 zeta^2 + b1 zeta + b0)/(zeta^2 + a1 zeta + a0)

with input u has the states ``p = zeta W`` and ``q = W``, where W is u divided by the denominator. With
``w = zeta^2 W = u - a1 p - a0 q``, the output of the section is ``b2 w + b1 p + b0 q``. Since ``zeta W`` is the change
of W until the next sample, the states are updated by ``q += p`` and ``p += w``. A first-order section has the state q
only, with ``w = zeta W = u - a0 q``.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zwidth.analysis.base import SceneParts
from zwidth.core.errors import check_choice
from zwidth.model.estimate import Estimate
from zwidth.model.loop_estimates import LoopEstimates, build_estimates
from zwidth.model.position import has_velocity
from zwidth.units.formatting import format_wall, with_unit
from zwidth.units.unit_system import UnitSystem

_COLUMNS = 100  # characters per line of a comment
LOCALS = (*"uvwefyr", "v_free", "y_tool", "v_tool", "v_rest")  # names of local variables, which C programs declare
# Largest ratio of imaginary part to modulus at which a root is treated as real, because rounding errors cause a small
# imaginary part.
REAL_TOLERANCE = 1e-13


def _describe_call(system: UnitSystem) -> tuple[str, str]:
    """Return two lines of comment on the argument and the result of the generated function."""
    position, force = ("angle in rad", "torque") if system.rotary else ("position in m", "force")
    return (
        f"x is the {position}, 0 at the surface of the wall and positive inside of it; the {force} on the device is",
        f"in {system['N']}, and 0 outside of the wall. x must be continuous: unwrap an encoder that restarts.",
    )


def describe_cautions(scene: SceneParts, cautions: Sequence[str]) -> list[str]:
    """Return the lines of comment on the safe limit and the cautions for the head of a program."""
    limit, texts = scene.safe_limit, [f"CAUTION: {caution}" for caution in cautions]
    if limit is not None:
        texts += [f"Safe limit: {limit.describe(scene.unit_system)}", *(f"Warning: {text}" for text in limit.warnings)]
        if not limit.allows(float(scene.wall.stiffness), float(scene.wall.virtual_damping)):
            texts.insert(0, "WARNING: this wall exceeds the safe limit; it may be unstable.")
    # Replace character sequences that would end the comment or start an escape sequence, because the texts may contain
    # arbitrary characters from a file.
    plain_texts = (text.replace("*/", "* /").replace('"', "'").replace("\\", "/") for text in texts)
    return [line for text in plain_texts for line in textwrap.wrap(text, _COLUMNS)]


def find_sections(estimate: Estimate) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
    """Return the sections of the filter of an estimate, without the difference over a window that precedes them.

    Returns:
        Numerator and denominator of each section in powers of zeta, highest power first, both of the same length 2
        (first order) or 3. The denominator starts with 1.
    """
    # Add the roots at z = 0, which the estimate stores as its lag, in the form of offsets ``1 - z = 1``.
    at_zero = [1.0] * abs(estimate.lag)
    zeros = _find_factors(np.append(estimate.zeros, at_zero if estimate.lag < 0 else []))
    poles = _find_factors(np.append(estimate.poles, at_zero if estimate.lag > 0 else []))
    if any(len(factor) == 3 for factor in (*zeros, *poles)):
        zeros, poles = _pair(zeros), _pair(poles)
    poles.sort(key=len, reverse=True)
    # Order the zeros so that those at z = 1 come first, because the input of the following sections then stays small.
    zeros.sort(key=lambda factor: (-len(factor), abs(factor[-1])))
    # Fill up the numerators with 1, because an estimate has at most as many zeros as poles. Each numerator then has a
    # denominator of at least its length.
    zeros += [(1.0,)] * (len(poles) - len(zeros))
    return [
        ((0.0,) * (len(denominator) - len(numerator)) + numerator, denominator)
        for numerator, denominator in zip(zeros, poles, strict=True)
    ]


def _find_factors(roots: np.ndarray) -> list[tuple[float, ...]]:
    """Return the coefficients of the real factors of a polynomial in zeta, from the offsets ``1 - z`` of its roots z.

    A real root yields the factor ``zeta + offset``, a complex pair a factor of second order.
    """
    offsets: list[complex] = roots.tolist()
    pairs = [offset for offset in offsets if offset.imag > REAL_TOLERANCE * abs(offset)]
    real = [offset.real for offset in offsets if abs(offset.imag) <= REAL_TOLERANCE * abs(offset)]
    return [(1.0, 2.0 * offset.real, abs(offset) ** 2) for offset in pairs] + [(1.0, offset) for offset in real]


def _pair(factors: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
    """Return factors in which those of first order are multiplied in pairs; one remains if their number is odd."""
    single = sorted((factor for factor in factors if len(factor) == 2), key=lambda factor: abs(factor[1]))
    products = [tuple(np.polymul(*two).tolist()) for two in zip(single[::2], single[1::2], strict=False)]
    return [factor for factor in factors if len(factor) == 3] + products + single[2 * len(products) :]


class WallProgram(NamedTuple):
    """Program of a wall as statements that are valid in C and Python once the mark ``@`` before states is replaced."""

    head: str  # comment at the head of the program
    window: int  # length of the difference in periods; 0 for none
    memory: str  # input of the velocity estimate: "x" (measured position) or "y" (position estimate)
    states: list[str]  # names of the states of all filters
    begin: list[str]  # statements that set the states of the position estimate to their values at rest
    start: list[str]  # statements that set all other states to their values at rest
    force: list[str]  # statements that compute the estimates of position and velocity from the measured position x
    reset: list[str]  # statements that set the states of the further feedback to 0
    feedback: list[str]  # statements that compute the force r of the further feedback
    law: str  # expression of the force
    depth: str  # position that the spring uses: "x" (measured position) or "y" (position estimate)
    max_force: float  # largest force; infinite for none
    system: UnitSystem  # units of the device


def write_wall(
    scene: SceneParts, language: str = "c", cautions: Sequence[str] = (), max_force: float = math.inf
) -> str:
    """Return the source code of the wall of a scene and its velocity estimate.

    Args:
        scene: the scene with the wall.
        language: "c" or "python".
        cautions: sentences to include in the comment at the head.
        max_force: largest force of the motor in N, to which the code limits the force.
    """
    check_choice("language", language, ("c", "python"))
    program = build_program(scene, cautions, max_force)
    return _write_c(program) if language == "c" else _write_python(program)


class FilterCode(NamedTuple):
    """Statements of a filter, which read its input from the variable u and store its output in u.

    The caller must multiply this output by the factor ``gain``.
    """

    states: list[str]  # names of the states
    start: list[str]  # statements that set the states to their steady state for a constant u, and u to the output
    update: list[str]  # statements that compute the output, and the states for the next sample
    output: list[str]  # statements that compute only the output, and leave the states unchanged
    gain: float  # factor by which u is to be multiplied after the statements


def write_filter(estimate: Estimate, prefix: str = "") -> FilterCode:
    """Return the statements of the filter of an estimate, without its difference over a window.

    Args:
        estimate: the estimate.
        prefix: beginning of the names of all states, different for each filter of a program.
    """
    states, start, update, preview, gain = [], [], [], [], float(estimate.gain)
    for number, (numerator, denominator) in enumerate(find_sections(estimate)):
        *inner, last = names = [f"@{prefix}{name}{number}" for name in "pq"[3 - len(denominator) :]]
        states += [name[1:] for name in names]
        start += [f"{name} = 0.0" for name in inner]
        if numerator == (1.0, 1.0) and denominator[-1] != 0:
            # Write a section with a zero at z = 0 as q += a0 (u - q), the usual form of a first-order low-pass filter.
            update += [f"{last} += {denominator[-1]!r} * (u - {last})", f"u = {last}"]
            preview.append(f"u = {last} + {denominator[-1]!r} * (u - {last})")
            start.append(f"{last} = u")
            gain /= denominator[-1]
            continue
        # A section with a pole at z = 1 has no steady state for a constant input, so its states start at 0.
        start += [f"{last} = u / {denominator[-1]!r}", f"u = {numerator[-1]!r} * {last}"] if denominator[-1] else []
        pairs = zip(denominator[1:], names, strict=True)
        feedback = "".join(f" - {factor!r} * {name}" for factor, name in pairs if factor)
        terms = [f"{factor!r} * {name}" for factor, name in zip(numerator, ("w", *names), strict=True) if factor]
        output = [f"w = u{feedback}", f"u = {' + '.join(terms)}"]
        preview += output
        update += [*output, *(f"{last} += {name}" for name in inner), f"{names[0]} += w"]
    return FilterCode(states, start, update, preview, gain)


def reset_states(states: Sequence[str]) -> list[str]:
    """Return the statements that set states to 0."""
    return [f"@{name} = 0.0" for name in states]


def omit_output(start: list[str]) -> list[str]:
    """Return statements without those at the end that compute u, because no later statement uses it."""
    while start and start[-1].startswith("u = "):
        start = start[:-1]
    return start


def build_program(scene: SceneParts, cautions: Sequence[str] = (), max_force: float = math.inf) -> WallProgram:
    """Build the program, as statements for either language, that computes the force of the wall of a scene."""
    period, position, further = float(scene.timing.period), scene.position, scene.feedback
    estimates = build_estimates(scene) or LoopEstimates(velocity=scene.velocity.estimate(period))
    states, begin, force = [], [], []
    depth = "x" if position is None else "y"
    memory = depth if estimates.structure == "series" else "x"
    if position is not None:
        code = write_filter(estimates.position, "position_")
        states, output = code.states, f"y = {code.gain!r} * u"
        force = ["u = x", *code.update, output]
        begin = ["u = x", *code.start, output] if memory == "y" else omit_output(["u = x", *code.start])
    count, code = estimates.velocity.window, write_filter(estimates.velocity)
    if count > 1:
        force += [f"u = ({memory} - @past[@next]) / {count}", f"@past[@next] = {memory}"]
        force.append(f"@next = (@next + 1) % {count}")
    else:
        force += [f"u = {memory} - @{memory}" if count else f"u = {memory}", f"@{memory} = {memory}"]
    # Start at rest, i.e. with a constant position. If the velocity estimate starts with a difference, its output is
    # then 0, and so are the states of its filter. Otherwise the position is the constant input of the filter.
    start = reset_states(code.states) if count else omit_output([f"u = {memory}", *code.start])
    states = code.states + states
    force += [*code.update, f"v = {code.gain / period!r} * u"]
    K, B, system = float(scene.wall.stiffness), float(scene.wall.virtual_damping), scene.unit_system
    law, reset, feedback = f"{K!r} * {depth} + {B!r} * v", [], []
    if further is not None:
        code = write_filter(further.estimate(1.0, period), "feedback_")
        states, reset = states + code.states, reset_states(code.states)
        pairs = (further.position, depth), (further.velocity, "v")
        terms = [f"{weight!r} * {name}" for weight, name in pairs if weight is not None]
        feedback = [f"u = {' + '.join(terms) or 'x'}", *code.update, f"r = {code.gain!r} * u"]
        start += reset
        law += " + r"
    estimator = f"velocity by {type(position if has_velocity(position) else scene.velocity).__name__}"
    force_name = "torque" if system.rotary else "force"
    limited = f" {force_name.capitalize()} limited to {with_unit(max_force, system['N'])}."
    wall = f"Virtual wall: {format_wall(K, B, system)}, {estimator}, {with_unit(1.0 / period, 'Hz')}."
    lines = [wall + (limited if max_force < math.inf else "")]
    if position is not None:
        lines.append(f"The position estimate y is computed by {type(position).__name__}; the wall is touched if y > 0.")
    if further is not None:
        name = type(further).__name__
        lines.append(f"The {force_name} r of {name} is added inside of the wall; its states are 0 outside of the wall.")
    head = "\n".join([*lines, *describe_cautions(scene, cautions)])
    return WallProgram(
        head, count, memory, states, begin, start, force, reset, feedback, f"-({law})", depth, float(max_force), system
    )


def write_memory(language: str, count: int, name: str, value: str, prefix: str = "") -> tuple[list[str], list[str]]:
    """Return declarations (C) and initial statements for the past samples that a difference needs.

    Args:
        language: "c" or "python".
        count: length of the difference in periods; 0 without a difference. If it exceeds 1, the samples form an array.
        name: name of the state if a single past sample suffices.
        value: initial value of all past samples, as an expression in the language.
        prefix: beginning of the names of the array and of its index.
    """
    if count <= 1:
        return [f"double {name}"], [f"@{name} = {value}"]
    fill = f"for (int k = 0; k < {count}; k++) @{prefix}past[k] = {value}"
    fill = fill if language == "c" else f"@{prefix}past = [{value}] * {count}"
    return [f"double {prefix}past[{count}]", f"int {prefix}next"], [fill, f"@{prefix}next = 0"]


def _write_c(program: WallProgram) -> str:
    """Return the source code of a program in C99, with a struct for its states and two functions."""
    members, fill = write_memory("c", program.window, program.memory, program.memory)
    start = [*program.begin, *fill, *program.start]
    limit, law, inside = program.max_force, program.law, f"{program.depth} > 0.0"
    lines = program.force
    if program.feedback:
        outside = "".join(f"        {line};\n" for line in [*program.reset, "return 0.0"])
        lines = [*lines, f"if (!({inside})) {{\n{outside}    }}", *program.feedback]
    else:
        law = f"{inside} ? {law} : 0.0"
    if limit < math.inf:
        law = f"f > {limit!r} ? {limit!r} : f < -{limit!r} ? -{limit!r} : f"
        lines = [*lines, f"f = {program.law if program.feedback else f'{inside} ? {program.law} : 0.0'}"]
    members += [f"double {name}" for name in program.states]
    comment = [*program.head.split("\n"), *_describe_call(program.system)]
    return format_c("wall", comment, members, start, [*lines, f"return {law}"])


def format_c(name: str, comment: Sequence[str], members: Sequence[str], start: list[str], force: list[str]) -> str:
    """Return the source code of a C program with a struct for its states and two functions.

    Args:
        name: name of the pointer to the struct, and beginning of the names of the functions, such as "wall".
        comment: lines of the comment at the head.
        members: declarations of the states.
        start: statements of the function that initializes the states; a comment starts with "# ".
        force: statements of the function that is called once per period. A condition has the Python syntax, such as
            "if @k == 0:", and is followed by indented statements.
    """
    blocks = []
    for block in (start, force):
        variables = [each for each in LOCALS if any(line.lstrip().startswith(f"{each} =") for line in block)]
        declared = [f"double {', '.join(variables)}", *block] if variables else block
        lines = list[str]()
        for line, following in zip(declared, [*declared[1:], ""], strict=True):
            text = line.lstrip()
            if text.startswith("# "):
                lines.append(line.replace("# ", "/* ") + " */")
            elif text.startswith("if ") and text.endswith(":"):
                lines.append(f"if ({text[3:-1]}) {{")
            else:
                lines.append(line if line.endswith("}") else f"{line};")
            if line.startswith("    ") and not following.startswith("    "):
                lines.append("}")
        blocks.append("\n".join(f"    {line}" for line in lines).replace("@", f"{name}->"))
    members_text, kind = "\n".join(f"    {line};" for line in members), name.capitalize()
    head = "\n   ".join([*comment, f"Call {name}_start once, then {name}_force once per period. */"])
    signatures = f"void {name}_start({kind} *{name}, double x)", f"double {name}_force({kind} *{name}, double x)"
    functions = [f"{each}\n{{\n{block}\n}}\n" for each, block in zip(signatures, blocks, strict=True)]
    return "\n".join([f"/* {head}", f"typedef struct {{\n{members_text}\n}} {kind};\n", *functions])


def _write_python(program: WallProgram) -> str:
    """Return the source code of a program as a Python class with the method ``force``."""
    _, fill = write_memory("python", program.window, program.memory, program.memory)
    limit, law, inside = program.max_force, program.law, f"{program.depth} > 0.0"
    law = law if limit == math.inf else f"max(-{limit!r}, min({limit!r}, {law}))"
    force = program.force
    if program.feedback:
        outside = [f"    {line}" for line in [*program.reset, "return 0.0"]]
        force = [*force, f"if not {inside}:", *outside, *program.feedback, f"return {law}"]
    else:
        force = [*force, f"return {law} if {inside} else 0.0"]
    head = program.head.split("\n")
    return format_python("Wall", head, _describe_call(program.system), [*program.begin, *fill, *program.start], force)


def format_python(name: str, head: Sequence[str], call: Sequence[str], start: list[str], force: list[str]) -> str:
    """Return the source code of a Python class with the method ``force``.

    Args:
        name: name of the class.
        head: lines of the first paragraph of its docstring.
        call: lines of the docstring on the argument and the result of the method.
        start: statements that initialize the states; a comment starts with "# ".
        force: statements of the method.
    """
    lines = [*head[:-1], f"{head[-1]}\n", *call, "Create one instance, then call force once per period.", '"""']
    docstring = '    """' + "\n    ".join(lines)
    heads = "    def __init__(self, x=0.0):", "    def force(self, x):"
    blocks = ["\n".join(f"        {line}" for line in block) for block in (start, force)]
    functions = [f"{each}\n{block}\n".replace("@", "self.") for each, block in zip(heads, blocks, strict=True)]
    return "\n".join([f"class {name}:\n{docstring}\n", *functions])
