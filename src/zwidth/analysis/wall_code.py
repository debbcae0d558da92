"""Source code of a wall with its velocity estimate for a control loop, in C or in Python.

The velocity estimate is a difference over a window, followed by sections of first and second order in powers of
``zeta = z - 1``. A filter that is slow compared with the sampling rate has poles close to z = 1, so coefficients in
powers of z would lose digits. A second-order section

    (b2 zeta^2 + b1 zeta + b0)/(zeta^2 + a1 zeta + a0)

with input u and output y has the states ``p = zeta W`` and ``q = W``, where W is u divided by the denominator. With
``w = zeta^2 W = u - a1 p - a0 q``, the output is ``y = b2 w + b1 p + b0 q``. Since ``zeta W`` is the change of W until
the next sample, the states are updated by ``q += p`` and ``p += w``. A first-order section has the state q only, with
``w = zeta W = u - a0 q``.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zwidth.analysis.base import SceneParts
from zwidth.core.errors import InputError, check_choice
from zwidth.model.estimate import Estimate
from zwidth.model.loop_estimates import refuse_estimates
from zwidth.units.formatting import format_wall, with_unit
from zwidth.units.unit_system import UnitSystem

_COLUMNS = 100  # characters per line of a comment
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


def _describe_cautions(scene: SceneParts, cautions: Sequence[str]) -> list[str]:
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
    """Return the sections of a velocity estimate, which follow its difference over a window.

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
    states: list[str]  # names of the states of the sections
    start: list[str]  # statements that set the states to those at rest
    force: list[str]  # statements that compute the velocity v from the position x
    law: str  # expression of the force
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
    if scene.tool is not None:
        raise InputError("tool: code is written for walls only; write the coupling with the update of zwidth.Tool")
    program = build_program(scene, cautions, max_force)
    return _write_c(program) if language == "c" else _write_python(program)


def build_program(scene: SceneParts, cautions: Sequence[str] = (), max_force: float = math.inf) -> WallProgram:
    """Build the program, as statements for either language, that computes the force of the wall of a scene."""
    refuse_estimates(scene, "wall_code")
    period = float(scene.timing.period)
    estimate = scene.velocity.estimate(period)
    count, gain = estimate.window, float(estimate.gain) / period
    if count > 1:
        force = [f"u = (x - @past[@next]) / {count}", "@past[@next] = x", f"@next = (@next + 1) % {count}"]
    else:
        force = ["u = x - @x" if count else "u = x", "@x = x"]
    # Start at rest. The output of a difference is then 0, and so are the states of all sections after it. Without a
    # difference the first section has the constant input u = x.
    sections = find_sections(estimate)
    start, states = [] if count or not sections else ["u = x"], []
    for number, (numerator, denominator) in enumerate(sections):
        *inner, last = names = [f"@{name}{number}" for name in "pq"[3 - len(denominator) :]]
        states += [name[1:] for name in names]
        start += [f"{name} = 0.0" for name in inner] + [f"{last} = " + ("0.0" if count else f"u / {denominator[-1]!r}")]
        start += [] if count or number == len(sections) - 1 else [f"u = {numerator[-1]!r} * {last}"]
        if numerator == (1.0, 1.0) and denominator[-1] != 0:
            # Write a section with a zero at z = 0 as q += a0 (u - q), the usual form of a first-order low-pass filter.
            force += [f"{last} += {denominator[-1]!r} * (u - {last})", f"u = {last}"]
            start = [line if line != f"{last} = u / {denominator[-1]!r}" else f"{last} = u" for line in start]
            gain /= denominator[-1]
            continue
        feedback = "".join(f" - {factor!r} * {name}" for factor, name in zip(denominator[1:], names, strict=True))
        terms = [f"{factor!r} * {name}" for factor, name in zip(numerator, ("w", *names), strict=True) if factor]
        force += [f"w = u{feedback}", f"u = {' + '.join(terms)}", *(f"{last} += {name}" for name in inner)]
        force.append(f"{names[0]} += w")
    K, B, system = float(scene.wall.stiffness), float(scene.wall.virtual_damping), scene.unit_system
    estimator = f"velocity by {type(scene.velocity).__name__}, {with_unit(1.0 / period, 'Hz')}"
    limited = f" {'Torque' if system.rotary else 'Force'} limited to {with_unit(max_force, system['N'])}."
    wall = f"Virtual wall: {format_wall(K, B, system)}, {estimator}.{limited if max_force < math.inf else ''}"
    head, law = "\n".join([wall, *_describe_cautions(scene, cautions)]), f"-({K!r} * x + {B!r} * v)"
    return WallProgram(head, count, states, start, [*force, f"v = {gain!r} * u"], law, float(max_force), system)


def _write_c(program: WallProgram) -> str:
    """Return the source code of a program in C99, with a struct for its states and two functions."""
    count = program.window
    members = [f"double past[{count}]", "int next"] if count > 1 else ["double x"]
    begin = [f"for (int k = 0; k < {count}; k++) wall->past[k] = x", "wall->next = 0"] if count > 1 else ["wall->x = x"]
    limit, law = program.max_force, [f"return x > 0.0 ? {program.law} : 0.0"]
    if limit < math.inf:
        law = [
            f"f = x > 0.0 ? {program.law} : 0.0",
            f"return f > {limit!r} ? {limit!r} : f < -{limit!r} ? -{limit!r} : f",
        ]
    lines = [*program.force, *law]
    names = [name for name in "uvwf" if any(line.startswith(f"{name} =") for line in lines)]
    start = [*(["double u"] if "u = x" in program.start else []), *begin, *program.start]
    force = [f"double {', '.join(names)}", *lines]
    blocks = ["\n".join(f"    {line.replace('@', 'wall->')};" for line in lines) for lines in (start, force)]
    members_text = "\n".join(f"    {line};" for line in (*members, *(f"double {name}" for name in program.states)))
    comment = "\n   ".join(
        [
            "/* " + program.head.replace("\n", "\n   "),
            *_describe_call(program.system),
            "Call wall_start once, then wall_force once per period. */",
        ]
    )
    signatures = "void wall_start(Wall *wall, double x)\n{\n", "double wall_force(Wall *wall, double x)\n{\n"
    functions = [f"{head}{block}\n}}\n" for head, block in zip(signatures, blocks, strict=True)]
    return "\n".join([comment, f"typedef struct {{\n{members_text}\n}} Wall;\n", *functions])


def _write_python(program: WallProgram) -> str:
    """Return the source code of a program as a Python class with the method ``force``."""
    count = program.window
    begin = [f"@past = [x] * {count}", "@next = 0"] if count > 1 else ["@x = x"]
    limit, law = program.max_force, program.law
    law = law if limit == math.inf else f"max(-{limit!r}, min({limit!r}, {law}))"
    force = [*program.force, f"return {law} if x > 0.0 else 0.0"]
    docstring = "\n    ".join(
        [
            '    """' + program.head.replace("\n", "\n    ") + "\n",
            *_describe_call(program.system),
            "Create one instance, then call force once per period.",
            '"""',
        ]
    )
    heads = "    def __init__(self, x=0.0):", "    def force(self, x):"
    blocks = ["\n".join(f"        {line}" for line in lines) for lines in ([*begin, *program.start], force)]
    functions = [f"{head}\n{block}\n".replace("@", "self.") for head, block in zip(heads, blocks, strict=True)]
    return "\n".join([f"class Wall:\n{docstring}\n", *functions])
