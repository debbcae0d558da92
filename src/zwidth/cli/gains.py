"""Command ``zwidth gains``: convert the gains of a motor controller to a wall and back.

The wall has stiffness K and damping B. The kind of a controller is "pid" or "cascade", a position loop with an inner
velocity loop. The integrator of a controller is the further feedback of a scene. With a device, the command also
assesses the scene of device and controller.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from zwidth.app import printing
from zwidth.app.gains import list_units, spell_gains, spell_output
from zwidth.app.printing import format_line
from zwidth.cli.commands import cli
from zwidth.cli.help import show_example
from zwidth.cli.options import (
    Command,
    Parsed,
    build_scene,
    find_omitted,
    get_options_with_kind,
    json_option,
    scene_options,
    verbose_option,
)
from zwidth.core.errors import InputError
from zwidth.model.controller_gains import (
    GAIN_NAMES,
    ControllerKind,
    PositionUnit,
    find_gains,
    find_given_units,
    find_output_unit,
    find_units,
    make_controller,
)
from zwidth.model.feedback import RULES, IntegralFeedback, IntegrationRule
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.wall import VirtualWall
from zwidth.units.formatting import format_interval, format_wall
from zwidth.units.unit_system import SYSTEMS, UnitSystem

if TYPE_CHECKING:
    from zwidth.config.controllers import ControllerSection

_HELP = {
    "pos_gain": "Cascade: gain of the position loop, unit 1/s (ODrive pos_gain, SimpleFOC P_angle.P).",
    "vel_gain": "Cascade: output per velocity unit (ODrive vel_gain, SimpleFOC PID_velocity.P).",
    "vel_integrator_gain": "Cascade: output per position unit (ODrive vel_integrator_gain, SimpleFOC PID_velocity.I).",
    "kp": "PID: output per position unit.",
    "ki": "PID: output per (position unit times s).",
    "kd": "PID: output per velocity unit, i.e. per (position unit/s).",
}
_REQUIRED = {"cascade": ("pos_gain", "vel_gain"), "pid": ("kp",)}
_DEVICE = {"scene", "device", "mass", "rate", "period"}  # with any of these options, the controller is assessed


class _GivenController(NamedTuple):
    """The controller that the options give, either by its gains or by a wall."""

    gains: dict[ControllerKind, dict[str, float]]  # by kind; a wall without feedback has gains of both kinds
    units: dict[ControllerKind, PositionUnit]  # position unit of the gains, by kind
    wall: VirtualWall
    feedback: Any
    scene: Any  # device with this controller; None if no device is given
    limits: dict[str, tuple[float, float] | None]  # stable interval of each gain if only that gain is changed
    system: UnitSystem
    output: str  # unit of the output of the controller


def _read_gain(text: str) -> float:
    """Return a gain, which is a number in the unit of the controller; accept the unit 1/s of the gain ``pos_gain``."""
    return float(re.sub(r"\s*1?/s$", "", text.strip()))


_GAIN = Parsed("FLOAT", _read_gain, "write only a number; --units and --output-unit determine the unit of a gain")


def _add_options(command: Command) -> Command:
    """Add the options for the gains and their units to a command, and return the command."""
    texts = {
        "--torque-constant": "Torque constant in N m/A, if the output is a current or, with --resistance, a voltage.",
        "--resistance": "Winding resistance in ohm, if the output is a voltage.",
        "--output-unit": "Torque in N m (linear: force in N) per unit of output.  [default: 1]",
    }
    units = "Position unit of the gains.  [default: turns for a cascade; rad for a PID, m with a linear device]"
    rule = "Rule of integration: forward for ODrive, trapezoidal for SimpleFOC.  [default: backward]"
    options = [
        *(click.option(f"--{name.replace('_', '-')}", type=_GAIN, help=text) for name, text in _HELP.items()),
        click.option("--rule", type=click.Choice(RULES), help=rule),
        click.option("--units", type=click.Choice(("turns", "degrees", "rad", "m")), help=units),
        *(click.option(flag, type=float, help=text) for flag, text in texts.items()),
    ]
    for add in reversed(options):
        command = add(command)
    return command


def _find_kind(given: dict[str, float], section: ControllerSection | None) -> ControllerKind | None:
    """Return the kind of controller that has the given gains, by their names; None if no gains are given.

    ``section`` contains the gains of the scene file, which replace missing gains of the same kind of controller.
    """
    kinds: list[ControllerKind] = [kind for kind in ("cascade", "pid") if given.keys() & set(GAIN_NAMES[kind])]
    if len(kinds) > 1:
        raise click.UsageError("got gains of a cascade and of a PID controller; give only those of one controller")
    if section is not None and kinds in ([], [section.name]):
        return section.name
    missing = [name for kind in kinds for name in _REQUIRED[kind] if name not in given]
    if missing:
        raise click.UsageError(f"a {kinds[0]} controller requires --{missing[0].replace('_', '-')}")
    return kinds[0] if kinds else None


def _read_section(file: Path | None, scene: Any) -> ControllerSection | None:
    """Return the section ``controller`` of a scene file or of the run in a folder; None without such a section."""
    from zwidth.config.controllers import read_controller
    from zwidth.config.reader import read_section
    from zwidth.config.values import read_in_units
    from zwidth.runs.record import find_config

    if file is None:
        return None
    raw = read_section(find_config(file) if file.is_dir() else file, "scene", "controller")
    if raw is None:
        return None
    with read_in_units(scene.unit_system):
        section = read_controller(raw)
        section.parts  # noqa: B018  (converts the gains in the units of the file)
    return section


def _read_controller(values: dict[str, Any], system: UnitSystem) -> _GivenController:
    """Return the controller that the options describe; ``values`` are the values of the scene options, by path."""
    options = click.get_current_context().params
    given = {name: options[name] for name in _HELP if options[name] is not None}
    has_wall = bool({"stiffness", "virtual_damping"} & values.keys())
    section = _read_section(options["scene_file"], values.get("scene"))
    kind = _find_kind(given, None if has_wall else section)
    if kind is not None and has_wall:
        raise click.UsageError("got gains together with a wall; give either the gains, or K and B")
    if kind is None and not values.keys() & {"stiffness", "scene"}:
        raise click.UsageError("give gains such as --pos-gain and --vel-gain, or --stiffness and --virtual-damping")
    chosen = options["units"]
    sizes = [options[name] for name in ("output_unit", "torque_constant", "resistance")]
    output_unit = find_output_unit(*sizes)
    if section is not None and kind in (None, section.name):
        # Read gains that are options in the same units as those of the file.
        chosen = chosen or (section.position_unit if kind else section.units)
        output_unit = section.output_scale if sizes == [None, None, None] else output_unit
    chosen = chosen if kind is None else find_given_units(kind, chosen)
    if not get_options_with_kind() and not values.keys() & {"scene", "device"} and kind is not None:
        # Quantities without a unit belong to the device of the controller: rotary for turns, degrees and rad.
        system = SYSTEMS[chosen not in (None, "m")]
    scene = build_scene(dict(values), system, wall=kind is None) if values.keys() & _DEVICE else None
    if scene is not None:
        system = scene.unit_system
    elif options["units"] or kind is not None:
        system = SYSTEMS[options["units"] != "m"]
    kinds: tuple[ControllerKind, ...] = ("cascade", "pid") if kind is None else (kind,)
    units: Any = {each: find_units(each, chosen, system.rotary) for each in kinds}
    feedback = None if scene is None else scene.feedback
    rule: IntegrationRule = options["rule"] or (section.rule if section else getattr(feedback, "rule", "backward"))
    if kind is None:
        wall = VirtualWall(values.get("stiffness", 0.0), values.get("virtual_damping", 0.0))
        if scene is not None:
            wall = scene.wall
            if has_wall and isinstance(feedback, IntegralFeedback) and feedback.is_cascade and wall.virtual_damping:
                # The integrator of a cascade contains pos_gain = K/B.
                feedback = feedback.match_wall(wall.stiffness, wall.virtual_damping)
                scene = scene.replace(feedback=feedback)
        gains: dict[ControllerKind, dict[str, float]] = _list_gains(wall, feedback, units, output_unit)
    else:
        base = dict[str, float]()
        if section is not None and section.name == kind:
            base = section.gains
            if (units[kind], output_unit) != (section.position_unit, section.output_scale):
                base = find_gains(section.parts.wall, section.parts.feedback, kind, units[kind], output_unit)._asdict()
        gains = {kind: base | given}
        position = None if scene is None else scene.position
        parts = make_controller(kind, gains[kind], position, rule, units[kind], output_unit)
        wall, feedback = parts.wall, parts.feedback
        scene = None if scene is None else scene.replace(wall=wall, feedback=feedback)
    limits = {} if scene is None else _find_limits(scene, gains, units, output_unit, rule)
    return _GivenController(
        gains, units, wall, feedback, scene, limits, system, spell_output(system.rotary, output_unit)
    )


def _find_limits(
    scene: Any,
    gains: dict[ControllerKind, dict[str, float]],
    units: dict[ControllerKind, PositionUnit],
    output_unit: float,
    rule: IntegrationRule,
) -> dict[str, tuple[float, float] | None]:
    """Return the stable interval of each gain that is not 0 if only that gain is changed; None if no value is stable.

    Return an empty dict if the intervals are not available.

    ``scene`` is the device with the controller; the other arguments are those of `make_controller`, by kind.
    """
    from zwidth.analysis.gain_limits import find_gain_limits

    # A tool with ``every`` > 1 has no open loop. An unstable loop with a measured response may be only undecided.
    measured = isinstance(scene.device, MeasuredDevice)
    if not scene.loop.has_boundary or (measured and not bool(scene.is_stable())):
        return {}
    limits = dict[str, tuple[float, float] | None]()
    for kind, given in gains.items():
        for name in (name for name, gain in given.items() if gain):

            def change(gain: float, name: str = name, kind: ControllerKind = kind) -> Any:
                """Return the scene with another value of the gain ``name``."""
                changed = gains[kind] | {name: gain}
                parts = make_controller(kind, changed, scene.position, rule, units[kind], output_unit)
                return scene.replace(wall=parts.wall, feedback=parts.feedback)

            limits[name] = find_gain_limits(change, given[name])
    return limits


def _list_gains(
    wall: VirtualWall, feedback: Any, units: dict[ControllerKind, PositionUnit], output_unit: float
) -> dict[ControllerKind, dict[str, float]]:
    """Return the gains for a wall, by kind of controller; raise `InputError` if no kind can render the wall."""
    gains, faults = dict[ControllerKind, dict[str, float]](), list[InputError]()
    for kind, unit in units.items():
        try:
            gains[kind] = find_gains(wall, feedback, kind, unit, output_unit)._asdict()
        except InputError as error:
            faults.append(error)
    if not gains:
        raise faults[0]
    return gains


def _format_controller(controller: _GivenController) -> list[str]:
    """Return printed lines with the gains of a controller, their stable intervals and, if unstable, remedies."""
    lines = []
    unstable = controller.scene is not None and not bool(controller.scene.is_stable())
    for kind, gains in controller.gains.items():
        lines.append(format_line(kind, spell_gains(kind, gains, controller.units[kind], controller.output)))
        units, spans, remedies = list_units(kind, controller.units[kind], controller.output), list[str](), list[str]()
        for name in (name for name in gains if name in controller.limits):
            if (limits := controller.limits[name]) is None:
                spans.append(f"no {name} > 0 is stable")
                continue
            (low, high), (low_end, high_end) = limits, format_interval(*limits)
            spans.append(f"{name} from {low_end if low else '0'} to {high_end} {units[name]}")
            if not low < gains[name] < high:
                change = f"below {high_end}" if gains[name] >= high else f"above {low_end if low else '0'}"
                remedies.append(f"{name} {change} {units[name]}")
        if spans:
            text = f"{'; '.join(spans)}; each with the other gains unchanged; no margins at the ends"
            lines.append(format_line("limits", text))
        if unstable and spans:
            change = f"set {', or '.join(remedies)}" if remedies else "no change of one gain stabilizes this controller"
            lines.append(format_line("remedy", f"{change}; for K and B with margins, use zwidth recommend"))
    return lines


_MOTOR = "--mass '1000 g cm^2' --rate '8 kHz' --delay '1.5 periods'"


@cli.command(**show_example("gains --pos-gain 20 --vel-gain 0.16 --position-bandwidth 1000", _MOTOR))
@_add_options
@scene_options(wall=True, make=_read_controller)
@verbose_option
@json_option
def gains(scene: _GivenController, verbose: bool, as_json: bool, **_: Any) -> None:
    """Convert the gains of a motor controller to K and B, or K and B to gains; with a device, assess the controller.

    Gains are numbers in the units of the controller: a cascade (ODrive, VESC, SimpleFOC) has --pos-gain, --vel-gain and
    --vel-integrator-gain; a PID controller (moteus, SmartKnob, Arduino) has --kp, --ki and --kd. With --mass (or
    --device) and --rate (or --period), or with SCENE.yaml, the command prints the results of `zwidth check` for the
    controller, and for each gain an interval in which the loop is stable. Without gains, the command converts
    --stiffness and --virtual-damping, or the wall of SCENE.yaml, to gains. Options replace single gains of the section
    `controller` of SCENE.yaml. With gains in turns, degrees or rad, a mass without unit is an inertia in kg m^2.
    """
    controller, wall = scene, scene.wall
    result: dict[str, Any] = {
        "gains": {kind: {**each, "units": controller.units[kind]} for kind, each in controller.gains.items()},
        "stiffness": float(wall.stiffness),
        "virtual_damping": float(wall.virtual_damping),
        "integral_gain": float(getattr(controller.feedback, "gain", 0.0)),
        "limits": controller.limits,
    }
    rows = _format_controller(controller)
    if controller.scene is None:
        words = format_wall(wall.stiffness, wall.virtual_damping, controller.system)
        printing.print_result(result, [format_line("wall", words), *rows], as_json, printing.LABEL)
        return
    from zwidth.analysis.assessment import assess
    from zwidth.app.verdict import format_check

    verdict, notes = assess(controller.scene), printing.list_notes(controller.scene)
    lines = format_check(controller.scene, verdict, None, omitted=find_omitted(), verbose=verbose)
    result |= {"check": verdict.as_dict(), "notes": notes}
    printing.print_result(result, [lines[0], *rows, *lines[1:], *printing.format_notes(notes)], as_json, printing.LABEL)
