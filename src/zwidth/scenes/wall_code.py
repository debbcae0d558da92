"""A wall with its velocity estimate as the difference equations of a control loop, in C or in Python.

The estimate is a difference over a window and first- and second-order sections in powers of ``zeta = z - 1``: a filter
that is slow beside the period keeps its digits there, which the coefficients of z lose. A section

    (b2 zeta^2 + b1 zeta + b0)/(zeta^2 + a1 zeta + a0)

has the states ``p = zeta W`` and ``q = W`` with ``zeta^2 W = w = u - a1 p - a0 q``, so that ``y = b2 w + b1 p + b0 q``.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zwidth.parts.velocity import Estimate
from zwidth.scenes.base import SceneParts
from zwidth.words.errors import check_choice
from zwidth.words.formatting import name_wall, with_unit
from zwidth.words.unit_system import UnitSystem

_COLUMNS = 100  # characters per line of a comment
# A root is real whose imaginary part is no more of it than rounding.
_ROUNDED = 1e-13


def _describe_call(system: UnitSystem) -> tuple[str, str]:
    """Return two lines that describe argument and result of the function that a control loop calls."""
    position, force = ("angle in rad", "torque") if system.rotary else ("position in m", "force")
    return (
        f"x is the {position}, 0 at the surface of the wall and positive inside of it; the {force} on the device is",
        f"in {system['N']}, and 0 outside of the wall. x must be continuous: unwrap an encoder that restarts.",
    )


def _describe_cautions(scene: SceneParts, cautions: Sequence[str]) -> list[str]:
    """Return the lines on the safe limit and the cautions in the comment at the head of a program."""
    limit, texts = scene.safe_limit, [f"CAUTION: {caution}" for caution in cautions]
    if limit is not None:
        texts += [f"Safe limit: {limit.describe(scene.unit_system)}", *(f"Warning: {text}" for text in limit.warnings)]
        if not limit.allows(float(scene.wall.stiffness), float(scene.wall.virtual_damping)):
            texts.insert(0, "WARNING: this wall exceeds the safe limit; it may be unstable.")
    # Replace character sequences that would end the comment or start an escape, because the texts come from a file.
    plain_texts = (text.replace("*/", "* /").replace('"', "'").replace("\\", "/") for text in texts)
    return [line for text in plain_texts for line in textwrap.wrap(text, _COLUMNS)]


def find_sections(estimate: Estimate) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
    """What follows the window's difference: tops and bottoms of one length, 2 or 3, the bottoms beginning with 1."""
    # Zeros at z = 1 come first, so that what comes after them stays small.
    behind = [1.0] * abs(estimate.lag)
    zeros = _find_factors(np.append(estimate.zeros, behind if estimate.lag < 0 else []))
    poles = _find_factors(np.append(estimate.poles, behind if estimate.lag > 0 else []))
    if any(len(factor) == 3 for factor in (*zeros, *poles)):
        zeros, poles = _pair(zeros), _pair(poles)
    poles.sort(key=len, reverse=True)
    zeros.sort(key=lambda factor: (-len(factor), abs(factor[-1])))
    # There are no more zeros than poles: each factor of the top finds a bottom that is as long.
    zeros += [(1.0,)] * (len(poles) - len(zeros))
    return [((0.0,) * (len(bottom) - len(top)) + top, bottom) for top, bottom in zip(zeros, poles, strict=True)]


def _find_factors(roots: np.ndarray) -> list[tuple[float, ...]]:
    """Real factors by roots that are given by their offsets from 1: ``zeta + offset``, or of a complex pair."""
    known: list[complex] = roots.tolist()
    pairs = [one for one in known if one.imag > _ROUNDED * abs(one)]
    real = [one.real for one in known if abs(one.imag) <= _ROUNDED * abs(one)]
    return [(1.0, 2.0 * one.real, abs(one) ** 2) for one in pairs] + [(1.0, one) for one in real]


def _pair(factors: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
    """Two factors with one root each as one with two."""
    single = sorted((factor for factor in factors if len(factor) == 2), key=lambda factor: abs(factor[1]))
    both = [tuple(np.polymul(*two).tolist()) for two in zip(single[::2], single[1::2], strict=False)]
    return [factor for factor in factors if len(factor) == 3] + both + single[2 * len(both) :]


class WallProgram(NamedTuple):
    """What a loop does; statements are C and Python alike, but for ``@`` before what is kept to the next sample."""

    head: str
    window: int
    states: list[str]
    start: list[str]  # the states at rest
    force: list[str]  # from the position x to the velocity v
    law: str
    max_force: float  # largest force; infinite for none
    system: UnitSystem


def write_wall(
    scene: SceneParts, language: str = "c", cautions: Sequence[str] = (), max_force: float = math.inf
) -> str:
    """Return a wall as source code (`zwidth.scenes.recommendation.Recommendation.code`)."""
    check_choice("language", language, ("c", "python"))
    program = build_program(scene, cautions, max_force)
    return _write_c(program) if language == "c" else _write_python(program)


def build_program(scene: SceneParts, cautions: Sequence[str] = (), max_force: float = math.inf) -> WallProgram:
    """Return the wall of a scene and its velocity estimate as statements."""
    period = float(scene.timing.period)
    estimate = scene.velocity.estimate(period)
    count, gain = estimate.window, float(estimate.gain) / period
    if count > 1:
        force = [f"u = (x - @past[@next]) / {count}", "@past[@next] = x", f"@next = (@next + 1) % {count}"]
    else:
        force = ["u = x - @x" if count else "u = x", "@x = x"]
    # Behind a difference all is 0 at rest.
    sections = find_sections(estimate)
    start, states = [] if count or not sections else ["u = x"], []
    for number, (top, bottom) in enumerate(sections):
        *inner, last = names = [f"@{name}{number}" for name in "pq"[3 - len(bottom) :]]
        states += [name[1:] for name in names]
        start += [f"{name} = 0.0" for name in inner] + [f"{last} = " + ("0.0" if count else f"u / {bottom[-1]!r}")]
        start += [] if count or number == len(sections) - 1 else [f"u = {top[-1]!r} * {last}"]
        if top == (1.0, 1.0) and bottom[-1] != 0:
            # A zero at z = 0: the low-pass as people write it.
            force += [f"{last} += {bottom[-1]!r} * (u - {last})", f"u = {last}"]
            start = [line if line != f"{last} = u / {bottom[-1]!r}" else f"{last} = u" for line in start]
            gain /= bottom[-1]
            continue
        back = "".join(f" - {factor!r} * {name}" for factor, name in zip(bottom[1:], names, strict=True))
        parts = [f"{factor!r} * {name}" for factor, name in zip(top, ("w", *names), strict=True) if factor]
        force += [f"w = u{back}", f"u = {' + '.join(parts)}", *(f"{last} += {name}" for name in inner)]
        force.append(f"{names[0]} += w")
    K, B, system = float(scene.wall.stiffness), float(scene.wall.virtual_damping), scene.unit_system
    estimated = f"velocity by {type(scene.velocity).__name__}, {with_unit(1.0 / period, 'Hz')}"
    limited = f" {'Torque' if system.rotary else 'Force'} limited to {with_unit(max_force, system['N'])}."
    wall = f"Virtual wall: {name_wall(K, B, system)}, {estimated}.{limited if max_force < math.inf else ''}"
    head, law = "\n".join([wall, *_describe_cautions(scene, cautions)]), f"-({K!r} * x + {B!r} * v)"
    return WallProgram(head, count, states, start, [*force, f"v = {gain!r} * u"], law, float(max_force), system)


def _write_c(program: WallProgram) -> str:
    """The wall as C99."""
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
    kept = "\n".join(f"    {line};" for line in (*members, *(f"double {name}" for name in program.states)))
    words = "\n   ".join(
        [
            "/* " + program.head.replace("\n", "\n   "),
            *_describe_call(program.system),
            "Call wall_start once, then wall_force once per period. */",
        ]
    )
    opened = "void wall_start(Wall *wall, double x)\n{\n", "double wall_force(Wall *wall, double x)\n{\n"
    functions = [f"{head}{block}\n}}\n" for head, block in zip(opened, blocks, strict=True)]
    return "\n".join([words, f"typedef struct {{\n{kept}\n}} Wall;\n", *functions])


def _write_python(program: WallProgram) -> str:
    """The wall as a class of Python."""
    count = program.window
    begin = [f"@past = [x] * {count}", "@next = 0"] if count > 1 else ["@x = x"]
    limit, law = program.max_force, program.law
    law = law if limit == math.inf else f"max(-{limit!r}, min({limit!r}, {law}))"
    force = [*program.force, f"return {law} if x > 0.0 else 0.0"]
    words = "\n    ".join(
        [
            '    """' + program.head.replace("\n", "\n    ") + "\n",
            *_describe_call(program.system),
            "Make one, then call force once per period.",
            '"""',
        ]
    )
    heads = "    def __init__(self, x=0.0):", "    def force(self, x):"
    blocks = ["\n".join(f"        {line}" for line in lines) for lines in ([*begin, *program.start], force)]
    functions = [f"{head}\n{block}\n".replace("@", "self.") for head, block in zip(heads, blocks, strict=True)]
    return "\n".join([f"class Wall:\n{words}\n", *functions])
