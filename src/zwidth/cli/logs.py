"""Commands on logs: `zwidth fit` identifies a device; `zwidth excite` and `zwidth respond` measure its response.

A log is a file with the sampled position of a device and its commanded force. `fit` estimates mass, damping, delay and
friction from logs, or from walls at the onset of oscillation (option --buzz). `excite` designs the force of a record,
and `respond` computes the frequency response of the device, with an error band, from logs of that force. A safe wall
is stable for every response in the band.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import click

from zwidth.app.printing import LABEL, format_line, format_row, print_json, print_lines, print_result, spell_diagnosis
from zwidth.cli.commands import EXIT_FAILED, cli
from zwidth.cli.hardware import add_option, diagnose_wall
from zwidth.cli.help import show_example
from zwidth.cli.options import (
    PATH,
    SHARE,
    Parsed,
    figure_option,
    get_hardware,
    get_options_with_kind,
    json_option,
    quantity_type,
    save_figure,
    verbose_option,
    warn_implausible,
)
from zwidth.cli.records import RecordLoop, log_options, loop_options, read_logs
from zwidth.core.errors import UnusableValueError
from zwidth.core.status import Status
from zwidth.model.checks import find_kind
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.timing import Timing
from zwidth.model.velocity import BackwardDifference
from zwidth.units.formatting import format_wall, round_conservatively, with_unit
from zwidth.units.parsing import detect_kind
from zwidth.units.quantities import POSITIVE
from zwidth.units.unit_system import SYSTEMS, UnitSystem

# Pattern of an entry such as "K=3.2kN/m": a letter, "=", and the text up to the next letter with "=".
_ENTRY = re.compile(r"([KBf])\s*=\s*(.*?)\s*(?=(?:[KBf]\s*=)|$)")


def _read_wall(text: str) -> tuple[tuple[float, float, float], bool | None]:
    """Return K, B and f of a wall at the onset of oscillation, and True if it is rotary (None if no unit is given)."""
    entries = _ENTRY.findall(text.replace(",", " "))
    amounts = dict(entries)
    if _ENTRY.sub("", text.replace(",", " ")).strip() or {"K", "f"} - set(amounts) or len(amounts) < len(entries):
        raise ValueError(f"got {text!r}; write K, B and f, such as 'K=3.2kN/m B=0 f=71Hz'")
    numbers, kinds = {"B": 0.0}, set()
    for letter, amount in amounts.items():
        try:
            numbers[letter] = quantity_type({"K": "N/m", "B": "N s/m", "f": "Hz"}[letter]).read(amount)
        except UnusableValueError as error:
            raise ValueError(f"{letter}: {error}") from None
        kinds |= {detect_kind(amount)} - {None}
    if len(kinds) > 1:
        raise ValueError(f"got {text!r}; write K in N/m and B in N s/m, or K in N m/rad and B in N m s/rad")
    return (numbers["K"], numbers["B"], numbers["f"]), kinds.pop() if kinds else None


_WALL = Parsed("WALL", _read_wall)
_SOFTER = 50  # largest number of reductions of K to make the rounded wall stable


# Options of the example that the help shows: two walls at the onset of instability.
_BUZZING = "--buzz 'K=218N/m B=0 f=8.38Hz'", "--buzz 'K=2.53kN/m B=8 f=33.9Hz'"


@cli.command(**show_example("fit --rate '1 kHz'", *_BUZZING))
@loop_options(logs=True)
@click.option(
    "--buzz",
    "walls",
    type=_WALL,
    multiple=True,
    help="Wall at the onset of oscillation, such as 'K=3.2kN/m B=0 f=71Hz'; may be repeated.",
)
@click.option("--noise", type=SHARE, help="Relative noise of K and f in --buzz, such as 2%.")
@log_options
@click.option("--max-delay", type=quantity_type("s", POSITIVE), help="Longest delay to search for in a log, in s.")
@click.option("--resample", is_flag=True, help="Treat samples with timestamp jitter as evenly spaced.")
@partial(add_option, chosen="max_force")
@figure_option
@click.option(
    "--code",
    type=click.Choice(("c", "python")),
    help="Print only a program for the recommended wall.",
)
@click.option(
    "--yaml",
    "as_yaml",
    is_flag=True,
    help="Print the scene as a configuration for other commands.",
)
@verbose_option
@json_option
def fit(
    logs: tuple[Path, ...],
    walls: tuple[Any, ...],
    loop: RecordLoop,
    noise: float | None,
    max_force: float | None,
    figure: Path | None,
    code: Any,
    as_yaml: bool,
    verbose: bool,
    as_json: bool,
    **of_logs: Any,
) -> None:
    """Identify mass, damping and delay of a device, and recommend a wall.

    With LOG.csv, the command identifies a device, including its friction, from a log of its motion under a commanded
    force. If you pass several logs, they must come from the same device and have the same columns. Write the unit of a
    column into its header, as in 'encoder [counts]', or after a colon in the option. With --buzz, the command
    identifies a device from walls at the onset of oscillation: for two or more values of B, increase K until the device
    begins to oscillate, and pass K, B and the frequency of the oscillation.

    The velocity estimate, the encoder step and the largest force of the motor are taken from SCENE.yaml (or from the
    folder of a run) if they are not given as options. The sampling period is also taken from this file for walls, and
    for logs without a time column. --max-force limits the force in the code of --code and in the simulation. The exit
    code is 1 if no wall is recommended, but 0 with --yaml.
    """
    from zwidth.identification.fit_report import list_units, write_scene

    if bool(logs) == bool(walls):
        raise click.UsageError("give either --buzz, once for each wall, or a LOG.csv")
    if sum(map(bool, (as_json, as_yaml, code))) > 1:
        raise click.UsageError("give only one of --json, --yaml and --code: each replaces the whole output")
    points, motions, period, velocity = (), [], loop.known_period, loop.velocity
    if walls:
        for name, value in of_logs.items():
            if value:
                raise click.UsageError(f"--{name.replace('_', '-')} applies only to a LOG.csv; omit it")
        if period is None:
            raise click.UsageError("give --period or --rate, or a scene file")
        from zwidth.identification.onset_fit import BuzzPoint, fit_buzz

        kinds = {rotary for _, rotary in walls} - {None}
        if len(kinds) > 1:
            raise click.UsageError("--buzz: some walls are in N/m, others in N m/rad; fit them separately")
        rotary_scene = loop.scene is not None and loop.scene.unit_system.rotary
        points, rotary = tuple(BuzzPoint(*point) for point, _ in walls), kinds.pop() if kinds else rotary_scene
        loop.check_kind(rotary)
        device_fit = fit_buzz(points, period=period, velocity=velocity, noise=noise, rotary=rotary)
        source = f"{len(walls)} onsets of instability"
    else:
        if noise is not None:
            raise click.UsageError("--noise applies only to --buzz; omit it, because the noise of a log is estimated")
        from zwidth.identification.columns import fit_motions

        options = {name: of_logs.pop(name) for name in ("max_delay", "resample")}
        motions = read_logs(logs, loop, **of_logs)
        device_fit = fit_motions(motions, period=period, velocity=velocity, **options)
        source = " and ".join(log.name for log in logs)
    motor = {"max_force": max_force or get_hardware().get("max_force")}
    motor = {name: value for name, value in motor.items() if value}
    written = []
    if figure is not None:
        from zwidth.identification.diagnostics import gather_evidence
        from zwidth.plotting import draw_device_fit

        evidence: dict[str, Any] = gather_evidence(device_fit, source, points)
        written.append(save_figure(draw_device_fit(**evidence, step=device_fit.resolution), figure))
    if code:
        if device_fit.recommended.status != Status.OK:
            raise click.ClickException(device_fit.recommended.reason)
        click.echo(device_fit.recommended.code(code, **motor), nl=False)
        return
    if as_yaml:
        period_given = any(motion.time is None for motion in motions)
        click.echo("\n".join(write_scene(device_fit, source, period_given=period_given, **motor)))
        return
    diagnosis = _diagnose(device_fit, motor)
    if as_json:
        checks = {"diagnosis": None if diagnosis is None else diagnosis.as_dict()}
        print_json({**device_fit.as_dict(), "units": list_units(device_fit), **checks})
    else:
        print_lines([*_list_lines(device_fit, source, diagnosis, verbose), *written], LABEL)
    if device_fit.recommended.status != Status.OK:
        raise SystemExit(EXIT_FAILED)


def _diagnose(device_fit: Any, motor: dict[str, float]) -> Any:
    """Return the diagnosis of the recommended wall, simulated with fitted friction, encoder and motor limit.

    Return None if none of these is known, or if no wall is recommended.
    """
    from zwidth.identification.fit_report import list_hardware

    recommended = device_fit.recommended
    if recommended.status != Status.OK:
        return None
    return diagnose_wall(recommended.scene, list_hardware(device_fit) | motor, remedies=False)


def _list_lines(device_fit: Any, source: str, diagnosis: Any, verbose: bool) -> list[str]:
    """Return the printed lines of a fit, with the checks of the recommended wall in grasps and by simulation."""
    from zwidth.identification.fit_report import detail_fit, summarize_fit

    checks, more = [], "details: --verbose; scene for the other commands: --yaml"
    if device_fit.recommended.status == Status.OK:
        checks = [("grasps", device_fit.recommended.spell_hands())]
        more += "; program for the loop: --code c"
    checks += spell_diagnosis(diagnosis)
    details = [("", ""), *detail_fit(device_fit, source)] if verbose else []
    rows = [*summarize_fit(device_fit, checks), *details, ("more", more)]
    return [format_line(*each).rstrip() for each in rows]


_TIME = quantity_type("s", POSITIVE)


@cli.command(**show_example("excite --rate '1 kHz' --force '2 N' --resolution '10 um'"))
@loop_options(logs=False)
@click.option("--force", type=quantity_type("N", POSITIVE), help="Largest force of the record, in N.")
@click.option(
    "--resolution",
    type=quantity_type("m", POSITIVE, counts=True),
    help="Encoder step in m, or counts per revolution such as '2000 counts'.",
)
@click.option("--duration", type=_TIME, default="60 s", show_default=True, help="Length of the record, in s.")
@click.option("--response", type=PATH, help="Response to a first record, to design a second one.")
@click.option("--out", type=PATH, default=Path("play.csv"), show_default=True, help="File of the record.")
@json_option
def excite(
    loop: RecordLoop,
    force: float | None,
    resolution: float | None,
    duration: float,
    response: Path | None,
    out: Path,
    as_json: bool,
) -> None:
    """Design the force to play before `zwidth respond`, or the torque if the units are those of a rotary device.

    The sampling period, the largest force and the encoder step are required. Values that are not given as options
    (--rate or --period, --force, --resolution) are taken from the scene of SCENE.yaml (or of the folder of a run). The
    velocity estimate and a measured device (instead of --response) are also taken from this scene.
    """
    hardware = get_hardware()
    options: dict[str, Any] = {"period": loop.known_period, "force": force or hardware.get("max_force")}
    options["resolution"] = resolution or hardware.get("resolution")
    if missing := [f"--{name}" for name, value in options.items() if value is None]:
        raise click.UsageError(f"give {', '.join(missing)}".replace("--period", "--period or --rate"))
    from zwidth.identification.excite import excite as design

    device = None if response is None else MeasuredDevice.read(response)
    # Infer the kind of device from the options as typed, because their parsed values have no units.
    implied = find_kind(get_options_with_kind())
    if loop.scene is not None:
        implied = bool(loop.scene.device.rotary)
        device = loop.scene.device if device is None and isinstance(loop.scene.device, MeasuredDevice) else device
    if resolution is not None:
        warn_implausible({"resolution": resolution}, SYSTEMS[bool(implied)])
    if device is not None and implied not in (None, device.rotary):
        kinds = ("rotary", "linear") if device.rotary else ("linear", "rotary")
        raise click.UsageError(
            f"--response is that of a {kinds[0]} device, but --force or --resolution have units of a {kinds[1]} one; "
            "use one kind"
        )
    rotary = device.rotary if device is not None else bool(implied)
    made = design(response=device, rotary=rotary, velocity=loop.velocity, duration=duration, **options)
    made.save(out)
    _print_excitation(made, out, as_json)


def _print_excitation(made: Any, out: Path, as_json: bool) -> None:
    """Print the properties of a force designed for identification, and the safe wall expected from its log."""
    low, high = (with_unit(end, "Hz") for end in made.frequency[[0, -1]])
    units = SYSTEMS[made.rotary]
    lines = [
        format_row("record", f"{made.force.size} samples, up to {with_unit(abs(made.force).max(), units['N'])}"),
        format_row(
            "frequencies", f"{made.frequency.size} from {low} to {high}, repeated after {with_unit(made.cycle, 's')}"
        ),
        format_row("deviation", f"{_compliance(made.deviation, units)} expected (median)"),
    ]
    result: dict[str, Any] = {"file": str(out), "samples": made.force.size, "cycle": made.cycle}
    if made.expected is not None and made.limit is not None:
        share = float(made.expected.stiffness / made.limit.stiffness)
        result |= {"expected": _plain(made.expected), "limit": _plain(made.limit)}
        expected = format_wall(made.expected.stiffness, made.expected.virtual_damping, units)
        lines += [format_row("expected safe wall", f"{expected}, {100 * share:.0f} % of the current K_max")]
    print_result(result, [*lines, format_row("wrote", str(out))], as_json)


@cli.command(**show_example("respond log.csv --save response.csv --figure response.png"))
@loop_options(logs=True)
@click.option("--cycle", type=_TIME, help="Period of the force, in s.  [default: detected from the force]")
@log_options
@click.option("--save", type=PATH, metavar="FILE.csv", help="File for the response.")
@figure_option
@json_option
def respond(
    logs: tuple[Path, ...],
    loop: RecordLoop,
    cycle: float | None,
    save: Path | None,
    figure: Path | None,
    as_json: bool,
    **of_logs: str | None,
) -> None:
    """Measure the frequency response of a device, and compute a safe wall from it.

    The command requires no model of the device, and computes the response with an error band. The logs can contain a
    force that `zwidth excite` has designed, or any other force. Other commands accept the file of --save, or a table
    from a network analyzer, as a device: `zwidth ridge --device FILE.csv`. The velocity estimate, the encoder step and,
    for logs without a time column, the sampling period are taken from SCENE.yaml (or from the folder of a run) if they
    are not given as options.
    """
    if not logs:
        raise click.UsageError("give one LOG.csv or several")
    from zwidth.identification.response_estimate import respond_to_logs

    response = respond_to_logs(read_logs(logs, loop, **of_logs), loop.known_period, cycle)
    _print_response(response, logs, loop.velocity, save, figure, as_json)


def _print_response(
    response: Any, logs: tuple[Path, ...], velocity: Any, save: Path | None, figure: Path | None, as_json: bool
) -> None:
    """Print a measured response and its safe wall; save and plot the response if ``save`` and ``figure`` are given."""
    from zwidth.analysis.scene import Scene
    from zwidth.identification.response_estimate import find_nominal_limit

    device, period, warnings = response.device, response.period, response.warnings
    kind = "parts of a repeating force" if response.cycle else "parts"
    source = f"{' and '.join(log.name for log in logs)}, {response.records} {kind}"
    scene = Scene(device, Timing(period), velocity=velocity or BackwardDifference())
    top, safe = find_nominal_limit(scene), scene.max_stiffness()
    low, high = (with_unit(float(end), "Hz") for end in device.frequency[[0, -1]])
    lines = [format_row("data", source), format_row("frequencies", f"{device.frequency.size} from {low} to {high}")]
    if device.deviation is not None:
        lines.append(format_row("deviation", f"{_compliance(device.deviation, device.unit_system)} (median)"))
    undecided = (
        scene.explain_undecided(float(top.stiffness), float(top.virtual_damping)) if top.status == Status.OK else []
    )
    words = (
        f"{format_wall(*top[:2], device.unit_system)}, for the measured curve without its error band"
        if top.status == Status.OK
        else "undecided"
    )
    lines.append(format_row("K_max", words))
    given = safe.status == Status.OK and device.deviation is not None and not warnings
    words = f"{spell_safe_wall(scene, safe)}: stable for every response in the band" if given else "none"
    lines.append(format_row("safe wall", words))
    lines += [format_row("stiffer wall" if k == 0 else "", text) for k, text in enumerate(undecided)]
    lines += [format_row("WARNING", text) for text in warnings]
    lines += [format_row("note", text) for text in response.notes]
    if save is not None:
        device.save(save, f"from {source}, T = {with_unit(period, 's')}")
        lines.append(format_row("wrote", str(save)))
    if figure is not None:
        lines.append(save_figure(_draw(scene, safe if safe.status == Status.OK else None), figure))
    result = {"frequencies": device.frequency.size, "period": period, "maximum": _plain(top)}
    result |= {"safe_wall": _plain(safe) if given else None, "undecided": undecided, "warnings": list(warnings)}
    result |= {"notes": list(response.notes), "rotary": device.rotary}
    print_result(result, lines, as_json)


def spell_safe_wall(scene: Any, wall: Any) -> str:
    """Return a safe wall as a phrase; its K is reduced until the rounded wall is stable for the whole error band."""
    stiffness, damping = float(wall.stiffness), float(f"{float(wall.virtual_damping):.4g}")
    for _ in range(_SOFTER):
        stiffness = round_conservatively(stiffness, "below")
        if scene.is_stable(stiffness, damping):
            return format_wall(stiffness, damping, scene.unit_system)
        stiffness *= 1.0 - 1e-4
    units = scene.unit_system
    return f"K = {float(wall.stiffness)!r} {units['N/m']}, B = {float(wall.virtual_damping)!r} {units['N s/m']}"


def _compliance(deviation: Any, system: UnitSystem) -> str:
    """Return the median of compliances in m/N (rotary: rad/(N m)), as text with a unit."""
    import numpy as np

    return with_unit(float(np.median(deviation)), system["m/N"], 3)


def _plain(wall: Any) -> dict[str, float]:
    """Return a dict with stiffness, damping, frequency and status of a safe wall, for output as JSON."""
    return {name: float(getattr(wall, name)) for name in ("stiffness", "virtual_damping", "frequency", "status")}


def _draw(scene: Any, wall: Any) -> Any:
    """Draw the measured response with its error band, and the open loop with a wall."""
    from zwidth import plotting
    from zwidth.plotting.style import style_sheet

    device = scene.device
    table = {"frequency_Hz": device.frequency, "real_m_per_N": device.response.real}
    table |= {"imag_m_per_N": device.response.imag}
    if device.deviation is not None:
        table["deviation_m_per_N"] = device.deviation
    if wall is not None:
        loop = scene.frequency_response(wall.stiffness, wall.virtual_damping, device.frequency)
        table |= {"open_loop_real": loop.real, "open_loop_imag": loop.imag}
    with style_sheet(system=device.unit_system):
        return plotting.draw_response(table)
