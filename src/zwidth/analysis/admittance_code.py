"""Write the program of an admittance display, which runs in a control loop, as source code in C or in Python.

An *admittance display* is a robot that measures the contact force f and moves like a virtual mass M with damping D. The
program integrates the velocity v of this mass from f; a is its acceleration. If the command is a position, the program
also integrates v to the commanded position x (docs/theory/admittance.md, W1). In the statements of this module, the
mark ``@`` precedes each state; C code contains "display->" in its place, Python code "self.".
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from zwidth.core.errors import check_choice
from zwidth.units.formatting import with_unit

if TYPE_CHECKING:
    from zwidth.analysis.admittance import AdmittanceDisplay


def write_code(display: AdmittanceDisplay, language: str = "c") -> str:
    """Return the source code of the program that computes the command of the display from the contact force.

    The code declares the states of the program and two functions: one that initializes the states for a robot at rest,
    and one that computes the command and must be called once per period.

    Args:
        language: "c" for C99, or "python".

    References:
        UniversalRobots/URScript_Examples, admittance_control.script (trapezoidal, velocity command).

    Example:
        >>> import zwidth
        >>> robot, timing = zwidth.Actuator(time_constant="5 ms"), zwidth.Timing(rate="1 kHz", delay="2 periods")
        >>> names = {}
        >>> exec(zwidth.AdmittanceDisplay(5, 20, robot, timing).code("python"), names)
        >>> program = names["Display"]()
        >>> [program.command(1.0), program.command(1.0)]
        [2e-07, 5.992e-07]
    """
    check_choice("language", language, ("c", "python"))
    T, M, D = (float(each) for each in (display.timing.period, display.virtual_mass, display.virtual_damping))
    sends_velocity, states, path = display.command == "velocity", ["v"], f"@x += {T!r} * @v"
    update = [f"@v += {T / M!r} * (f - {D!r} * @v)"]
    if display.integrator == "trapezoidal":
        states, path = ["v", "a"], f"@x += {T / 2.0!r} * (v + @v)"
        update = [f"a = (f - {D!r} * @v) / {M!r}", f"v = @v + {T / 2.0!r} * (a + @a)"]
    if not sends_velocity:
        states, update = [*states, "x"], [*update, path]
    if display.integrator == "trapezoidal":
        update += ["@a = a", "@v = v"]
    result = "@v" if sends_velocity else "@x"
    units = display.unit_system
    mass, damping = (with_unit(value, units[unit]) for value, unit in ((M, "kg"), (D, "N s/m")))
    unit = units["m/s" if sends_velocity else "m"]
    force, place = ("torque", "angle") if display.unit_system["N"] != "N" else ("force", "position")
    start = "at rest" if sends_velocity else f"with the present {place} of the robot"
    lines = [
        f"Admittance display: M = {mass}, D = {damping}, at {with_unit(1.0 / T, 'Hz')}, {display.integrator}.",
        f"f is the measured contact {force} in {units['N']}; the result is the {display.command} command in {unit}.",
        f"Start {start}, then compute one command per period.",
    ]
    return _write_c(lines, states, update, result) if language == "c" else _write_python(lines, states, update, result)


def _write_c(lines: list[str], states: list[str], update: list[str], result: str) -> str:
    """Return the source code in C99: a struct for the states and two functions."""
    start = [f"@{name} = {name if name == 'x' else '0.0'}" for name in states]
    body = [f"double {line}" if line[0] in "av" else line for line in update]
    blocks = [start, [*body, f"return {result}"]]
    texts = ["".join(f"    {line};\n" for line in block).replace("@", "display->") for block in blocks]
    comment = "/* " + "\n   ".join(lines) + " */\n"
    struct = "typedef struct {\n" + "".join(f"    double {name};\n" for name in states) + "} Display;\n\n"
    argument = ", double x" if "x" in states else ""
    heads = f"void display_start(Display *display{argument})", "double display_command(Display *display, double f)"
    functions = "\n".join(f"{head}\n{{\n{text}}}\n" for head, text in zip(heads, texts, strict=True))
    return comment + struct + functions


def _write_python(lines: list[str], states: list[str], update: list[str], result: str) -> str:
    """Return the source code of a Python class; its method ``command`` computes the command from the force."""
    start = [f"@{name} = {name if name == 'x' else '0.0'}" for name in states]
    blocks = [start, [*update, f"return {result}"]]
    texts = ["".join(f"        {line}\n" for line in block).replace("@", "self.") for block in blocks]
    docstring = '    """' + lines[0] + "\n\n    " + "\n    ".join(lines[1:]) + '\n    """\n\n'
    heads = f"    def __init__(self{', x=0.0' if 'x' in states else ''}):\n", "    def command(self, f):\n"
    functions = "\n".join(head + text for head, text in zip(heads, texts, strict=True))
    return "class Display:\n" + docstring + functions
