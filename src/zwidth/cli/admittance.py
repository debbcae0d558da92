"""Command `zwidth admittance`: the environments in which an admittance display is stable.

The display is a robot that moves like a virtual mass M with damping D. The environment is a spring K and a damper B
between the robot and ground, e.g. the hand of a user. The robot measures the contact force and follows the motion of
the virtual mass with a lag and a delay.
"""

from __future__ import annotations

import math
from typing import Any

import click

from zwidth.app.printing import LABEL, format_line, print_result
from zwidth.cli.commands import cli
from zwidth.cli.help import show_example
from zwidth.cli.options import get_options_with_kind, json_option, quantity_type, take_options
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.model.actuator import Actuator
from zwidth.model.checks import find_kind
from zwidth.model.linear_device import LinearDevice
from zwidth.model.timing import Timing
from zwidth.units.formatting import format_interval, format_stiffness, plain, round_conservatively, with_unit
from zwidth.units.quantities import FIELDS, NOT_NEGATIVE, POSITIVE

# Help texts of the options --robot-... of a robot that follows its command with a lag, by field of `Actuator`.
_LAG = {
    "cutoff": "Bandwidth of the robot, the corner frequency of its lag, in Hz.",
    "time_constant": "Time constant of the robot's lag, in s; instead of the bandwidth.",
    "order": "Order of the robot's lag, 1 or 2.  [default: 1]",
    "damping_ratio": "Damping ratio of a lag of order 2.  [default: sqrt(1/2)]",
}


def _add_lag(command: Any) -> Any:
    """Add one option for each parameter of the robot's lag to a command, and return the command."""
    for name, text in reversed(_LAG.items()):
        kind = click.INT if name == "order" else quantity_type(FIELDS[f"actuator.{name}"].unit, POSITIVE)
        command = click.option(f"--robot-{name.replace('_', '-')}", f"robot_{name}", type=kind, help=text)(command)
    return command


class _HiddenArgument(click.Argument):
    """An argument that the usage line of a command does not show."""

    def get_usage_pieces(self, ctx: click.Context) -> list[str]:
        return []


def _refuse_files(_context: click.Context, _argument: click.Parameter, files: tuple[str, ...]) -> None:
    """Raise `click.UsageError` if an argument without option is given, such as the path of a file."""
    if files:
        text = f"got {files[0]!r}, but this command has only options; for a file with a study"
        raise click.UsageError(f"{text} of kind admittance, use zwidth run {files[0]}")


@cli.command(
    **show_example(
        "admittance --virtual-mass '20 kg' --virtual-damping '60 N s/m'",
        "--robot-time-constant '20 ms' --rate '500 Hz' --delay '4 periods'",
        "--command velocity --integrator trapezoidal --environment '1 kN/m'",
    ),
    own=("--virtual-damping",),
)
@click.argument("files", nargs=-1, cls=_HiddenArgument, is_eager=True, expose_value=False, callback=_refuse_files)
@click.option("--virtual-mass", type=quantity_type("kg", POSITIVE), required=True, help="Virtual mass M, in kg.")
@click.option(
    "--virtual-damping", type=quantity_type("N s/m", NOT_NEGATIVE), required=True, help="Virtual damping D, in N s/m."
)
@click.option(
    "--robot",
    metavar="'NUM / DEN'",
    help="Robot as a transfer function from commanded to actual motion, in s, such as '400 / 1 28 400'.",
)
@click.option("--robot-sampled", is_flag=True, help="The transfer function is in z, and includes hold and delay.")
@_add_lag
@take_options("timing", ("period", "rate", "delay"), lambda values, _: values)
@click.option(
    "--command",
    "commanded",
    type=click.Choice(("position", "velocity")),
    default="position",
    show_default=True,
    help="Command that the program sends to the robot.",
)
@click.option(
    "--integrator",
    type=click.Choice(("semi-implicit", "trapezoidal")),
    default="semi-implicit",
    show_default=True,
    help="Method that integrates the motion of the virtual mass.",
)
@click.option("--environment", type=quantity_type("N/m", POSITIVE), help="Stiffness K of an environment, in N/m.")
@click.option(
    "--environment-damping",
    type=quantity_type("N s/m", NOT_NEGATIVE),
    default=0.0,
    help="Damping B of the environment, in N s/m.  [default: 0]",
)
@click.option("--code", type=click.Choice(("c", "python")), help="Print only the program of the display.")
@json_option
def admittance(
    environment: float | None, environment_damping: float, code: str | None, as_json: bool, **given: Any
) -> None:
    """Compute the environments in which an admittance display is stable.

    An admittance display is a robot that measures the contact force and moves like a virtual mass with a virtual
    damping. The command prints a stiffness K_max: the display is stable in all environments from K = 0 to K_max. With
    --environment, the command also assesses the contact with this environment. It then prints the virtual masses, and
    the virtual dampings, with which the contact is stable if only that parameter is changed.

    The options --virtual-mass, --virtual-damping, --rate (or --period) and a model of the robot are required. The model
    is --robot-time-constant, --robot-cutoff or --robot. The hand of a user is an environment, too. The exit code is 1
    if no environment is stable and --environment is not given, otherwise 0.
    """
    display = _make_display(**given)
    if code is not None:
        if environment is not None and not display.is_stable(environment, environment_damping):
            raise click.ClickException(
                "--code: the contact with this environment is unstable; see the output without it"
            )
        click.echo(display.code(code), nl=False)
        return
    limit = display.max_environment_stiffness(environment_damping)
    result: dict[str, Any] = {
        "stiffness_limit": float(limit.stiffness),
        "frequency": float(limit.frequency),
        "status": Status(int(limit.status)).name,
        "environment_damping": environment_damping,
    }
    about = _describe(display)
    if environment is None:
        lines = [_spell_limit(display, limit, environment_damping), *about]
    else:
        contact, assessed = _assess(display, environment, environment_damping, limit)
        result |= contact
        lines = [*assessed[:1], *about, "", *assessed[1:]]
    print_result(result, lines, as_json, LABEL)
    if environment is None and limit.status != Status.OK:
        raise SystemExit(1)


def _make_display(
    virtual_mass: float,
    virtual_damping: float,
    robot: str | None,
    robot_sampled: bool,
    timing: dict[str, Any],
    commanded: Any,
    integrator: Any,
    **lag: Any,
) -> Any:
    """Return the display that the options describe; raise `click.UsageError` if a required option is missing."""
    from zwidth.analysis.admittance import AdmittanceDisplay

    if len({"period", "rate"} & timing.keys()) != 1:
        raise click.UsageError("give either --rate or --period")
    parameters = {name.removeprefix("robot_"): value for name, value in lag.items() if value is not None}
    if (robot is None) == (not parameters):
        raise click.UsageError("give a model of the robot, either --robot-time-constant (or --robot-cutoff) or --robot")
    if {"cutoff", "time_constant"} <= parameters.keys():
        raise click.UsageError("got both --robot-cutoff and --robot-time-constant; give only one of them")
    if parameters and not {"cutoff", "time_constant"} & parameters.keys():
        raise click.UsageError("give the lag of the robot, either --robot-time-constant or --robot-cutoff")
    if robot_sampled and robot is None:
        raise click.UsageError("--robot-sampled: give --robot 'NUM / DEN' with coefficients in z")
    loop_timing = Timing(**timing)
    try:
        model = LinearDevice(robot, loop_timing.period if robot_sampled else None) if robot else Actuator(**parameters)
    except InputError as error:
        # Name the option, such as --robot-cutoff, in place of the field "actuator.cutoff" of the message.
        field, _, text = str(error).partition(": ")
        name = field.partition(".")[2]
        raise InputError(f"robot{f'_{name}' if name else ''}: {text}") from None
    rotary = bool(find_kind(get_options_with_kind()))
    # Pass texts with units, because the display derives its kind, linear or rotary, from them.
    mass, damping = (
        f"{virtual_mass!r} {'kg m^2' if rotary else 'kg'}",
        f"{virtual_damping!r} {'N m s/rad' if rotary else 'N s/m'}",
    )
    return AdmittanceDisplay(mass, damping, model, loop_timing, commanded, integrator)


def _describe(display: Any) -> list[str]:
    """Return the printed lines with the parameters of the display and of its robot, and with a caution."""
    units, timing = display.unit_system, display.timing
    mass, damping = (
        with_unit(value, units[unit])
        for value, unit in ((display.virtual_mass, "kg"), (display.virtual_damping, "N s/m"))
    )
    method = {"trapezoidal": "trapezoidal rule", "semi-implicit": "semi-implicit Euler"}[display.integrator]
    rate = f"at {with_unit(1.0 / timing.period, 'Hz')}, delay {timing.delay_text if timing.delay else '0'}"
    robot = display.robot
    if isinstance(robot, Actuator):
        size = with_unit(robot.cutoff, "Hz") if robot.cutoff is not None else with_unit(robot.time_constant, "s")
        words = f"{'bandwidth' if robot.cutoff is not None else 'time constant'} {size}"
        words += f", order 2, damping ratio {plain(robot.damping_ratio)}" if robot.order == 2 else ""
    else:
        words = robot.spell()
    lines = [
        format_line("display", f"M = {mass}, D = {damping}, {rate}, {display.command} command, {method}"),
        format_line("robot", words),
    ]
    if not timing.delay and not getattr(robot, "dt", None):
        text = "no delay given: the results hold only if the command acts at the sample of the force; add --delay"
        lines.append(format_line("CAUTION", text))
    return lines


def _spell_limit(display: Any, limit: Any, damping: float) -> str:
    """Return the printed line with K_max, the largest stable stiffness of environments with the given damping B."""
    units = display.unit_system
    with_damper = f" with B = {with_unit(damping, units['N s/m'])}" if damping else ""
    if limit.status != Status.OK:
        return format_line("K_max", f"none: the display is unstable even in soft environments{with_damper}")
    K, frequency = format_stiffness(float(limit.stiffness), units), with_unit(float(limit.frequency), "Hz")
    return format_line("K_max", f"{K}{with_damper}, where the contact oscillates at {frequency}")


def _assess(display: Any, stiffness: float, damping: float, limit: Any) -> tuple[dict[str, Any], list[str]]:
    """Assess the contact with an environment; return results as a dict and printed lines, the verdict first."""
    units, scene = display.unit_system, display.scene(stiffness, damping)
    is_stable, radius = bool(display.is_stable(stiffness, damping)), float(scene.spectral_radius())
    pole, margins = scene.dominant_pole(), scene.margins()
    mass = display.min_virtual_mass(stiffness, damping)
    least = display.min_virtual_damping(stiffness, damping)
    result = {"stable": is_stable, "stiffness": stiffness, "spectral_radius": radius}
    result |= {"pole_frequency": float(pole.frequency), "gain_margin": float(margins.gain_margin)}
    result |= {"phase_margin": float(margins.phase_margin), "modulus_margin": float(margins.modulus_margin)}
    result |= {"virtual_mass_range": [mass.virtual_mass, mass.largest]}
    result |= {"virtual_damping_range": [least.virtual_damping, least.largest]}
    K, B = with_unit(stiffness, units["N/m"]), with_unit(damping, units["N s/m"])
    lines = [format_line("STABLE" if is_stable else "UNSTABLE", f"in an environment with K = {K}, B = {B}")]
    if is_stable:
        gain, phase, modulus = (
            round_conservatively(result[f"{name}_margin"], "below") for name in ("gain", "phase", "modulus")
        )
        place = with_unit(float(margins.gain_crossover), "Hz", 3)
        text = f"gain {plain(gain)}, phase {plain(phase)} deg at {place}, modulus {plain(modulus)}"
        lines.append(format_line("margins", text))
    decay = float(pole.decay_rate)
    if math.isfinite(decay) and decay:
        time = with_unit(1.0 / abs(decay), "s")
        text = f"time constant {time} at {with_unit(result['pole_frequency'], 'Hz')} (spectral radius {radius:.5g})"
        lines.append(format_line("decay" if decay > 0 else "growth", text))
    lines.append(_spell_limit(display, limit, damping))
    if limit.status == Status.OK:
        used = 100.0 * stiffness / float(limit.stiffness)
        lines[-1] += f"; this environment has {plain(used, 3)} % of K_max"
    ranges = (("M", mass.virtual_mass, mass.largest, "kg"), ("D", least.virtual_damping, least.largest, "N s/m"))
    spelled = [_spell_range(name, low, high, units[unit]) for name, low, high, unit in ranges]
    lines.append(
        format_line("room" if is_stable else "remedy", f"{'; '.join(spelled)}, each alone; no margins at the ends")
    )
    return result, lines


def _spell_range(name: str, low: float, high: float, unit: str) -> str:
    """Return a phrase with the stable interval of a parameter; rounding never extends the interval."""
    if math.isnan(low):
        return f"no {name} is stable"
    if math.isinf(high):
        return f"{name} from {with_unit(round_conservatively(low, 'above'), unit)}"
    first, last = format_interval(low, high, unit)
    return f"{name} from {first} to {last}"
