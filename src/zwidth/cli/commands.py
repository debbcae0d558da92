"""Command group ``zwidth`` with ``check``, ``ridge``, ``recommend``, ``devices``, ``init``, ``explore``, ``report``.

The other modules of this package add further commands to `cli`. Commands import the library only when they run, so that
``zwidth --help`` is fast. A scene is a device with its timing, wall and velocity estimate; K_max is the largest
stiffness of a stable wall on the device, and the ridge is the path of these walls for rising damping of the device.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import click

from zwidth import __version__
from zwidth.app import printing
from zwidth.app.gains import list_cascade, list_cascade_cautions
from zwidth.app.printing import format_row
from zwidth.cli.hardware import diagnose_wall, hardware_options, spell_hardware_of_file
from zwidth.cli.help import OF_SCENE, show_example
from zwidth.cli.options import (
    PATH,
    SHARE,
    Parsed,
    beyond_safe_option,
    code_option,
    figure_option,
    find_omitted,
    folder_argument,
    get_hardware,
    json_option,
    quantity_type,
    save_figure,
    scene_options,
    verbose_option,
)
from zwidth.core.errors import InputError, ZwidthError, check_choice, format_install_command
from zwidth.core.status import Status
from zwidth.model.device import Device
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.timing import Timing
from zwidth.model.wall import VirtualWall
from zwidth.units.formatting import format_periods, format_stiffness, plain, with_unit
from zwidth.units.parsing import read_degrees, read_factor
from zwidth.units.quantities import SIZES, Range

EXIT_FAILED = 1  # exit code if no wall exists or a computation fails
EXIT_INPUT = 2  # exit code for invalid input
# Delay in periods from which `recommend` announces a long search. For each wall, the search computes all poles of the
# loop. Their number grows with the delay, and the time to compute them grows with the cube of their number.
LONG_SEARCH = 300.0
_PACKAGE = Path(__file__).resolve().parents[1]
# Pattern of an entry of a configuration that refers to a CSV table in the same folder.
_TABLE = re.compile(r"(?:csv|device): *([\w.-]+\.csv)")


@click.group(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Exit codes: 0 for a result, including UNSTABLE; 1 if no wall or value exists, or a computation fails; "
    "2 for invalid input.\n\n"
    "Completion in bash (zsh, fish): _ZWIDTH_COMPLETE=bash_source zwidth > FILE, and '. FILE' in ~/.bashrc.",
)
@click.version_option(__version__, prog_name="zwidth")
def cli() -> None:
    """Stability of haptic virtual walls: what stiffness and damping a sampled, delayed device can render.

    A quantity is a number in SI base units (10e3) or a number with a unit ("10 kN/m"). Rotary devices have rotary
    units: "12 g cm^2", "0.02 mN m s/rad", "20 mN m/deg". If one option has such a unit, or --device is rotary, all
    options are rotary.
    """


@cli.command(**show_example("check --stiffness '10 kN/m' --virtual-damping '40 N s/m'", OF_SCENE))
@scene_options(wall=True)
@hardware_options
@code_option
@verbose_option
@json_option
def check(scene: Any, hardware: dict[str, Any], code: Any, verbose: bool, as_json: bool) -> None:
    """Assess one wall: stability, margins and passivity; for an unstable wall, the changes that stabilize it.

    The options --stiffness, --mass (or --device) and --rate (or --period) are required; the defaults of damping and
    delay are 0. Parameters that are not given as options are taken from SCENE.yaml (or from the folder of a run). With
    --resolution, --friction or --max-force, the command also simulates the wall to find limit cycles and saturation.
    With --code, it prints only a program for the control loop, if the wall is stable. The exit code is 0 for stable and
    for unstable walls.
    """
    if code:
        click.echo(scene.code(language=code, max_force=hardware.get("max_force", math.inf)), nl=False)
        return
    from zwidth.analysis.assessment import assess, limits_of
    from zwidth.analysis.stabilization import stabilize
    from zwidth.app.verdict import format_check

    verdict, limits, notes = assess(scene), limits_of(scene), printing.list_notes(scene)
    result = verdict.as_dict() | {"limits": [limit._asdict() for limit in limits], "notes": notes}
    lines, diagnosis = list[str](), diagnose_wall(scene, hardware, remedies=not get_hardware())
    if diagnosis is not None:
        result["diagnosis"] = diagnosis.as_dict()
    if as_json:
        result["cautions"] = [
            *printing.list_limit_cautions(scene),
            *printing.list_omission_cautions(scene, find_omitted()),
            *list_cascade_cautions(scene),
        ]
        result["islands"] = _list_islands(scene)
        unstable = verdict.stable is False and not verdict.marginal
        has_damper_range = scene.loop.has_boundary and not isinstance(scene.device, MeasuredDevice)
        if scene.wall.stiffness == 0 and has_damper_range:
            result["damper_range"] = scene.damper_range().tolist()
        result["remedies"] = [each._asdict() for each in stabilize(scene)] if unstable else []
    else:
        texts = {"omitted": find_omitted(), "hardware": spell_hardware_of_file(scene)}
        lines = format_check(scene, verdict, limits, **texts, diagnosis=diagnosis, verbose=verbose)
    printing.print_result(result, lines + printing.format_notes(notes), as_json, printing.LABEL)


@cli.command(**show_example("ridge", OF_SCENE))
@click.option("--delta", type=quantity_type("1", Range(*SIZES["delta"])), help="Normalized physical damping b T/m.")
@click.option("--d", type=quantity_type("1", Range(*SIZES["d"])), help="Delay in periods.")
@scene_options(wall=False, instead="--delta and --d")
@json_option
def ridge(delta: float | None, d: float | None, scene: Any, as_json: bool) -> None:
    """Compute the stiffest stable wall of a device.

    With a velocity filter, a linear system or a measured response, only walls with B >= 0 are considered, because a
    negative B may cancel damping that exists only in the model. In Python, Scene.max_stiffness(negative_damping=True)
    includes walls with B < 0.

    Describe the device by --delta and --d, or by its physical parameters and parts. In the second case, the command
    also prints the sensitivity of K_max to each parameter. Parameters that are not given as options are taken from
    SCENE.yaml (or from the folder of a run). To choose a wall with stability margins, use `zwidth recommend`.
    """
    from zwidth.analysis.assessment import name_kind
    from zwidth.analysis.optimization import explain_missing
    from zwidth.analysis.scene import Scene
    from zwidth.app.verdict import spell_device

    if (scene is None) == (delta is None) or (delta is None) != (d is None):
        raise click.UsageError("give either --delta and --d, or --mass and --rate (with --damping and --delay)")
    given = scene
    scene = Scene(Device(1.0, delta), Timing(1.0, d)) if scene is None else scene
    wall = scene.max_stiffness()
    if int(wall.status) != Status.OK:
        none = int(wall.status) == Status.NO_BOUNDARY
        fault = "this device has no K_max" if none else "K_max of this device could not be computed"
        raise click.ClickException(f"{fault}: {explain_missing(scene, wall.status)}")
    (alpha, beta), kind, lines = scene.normalize_walls(*wall[:2]), name_kind(wall), []
    result: dict[str, Any] = {}
    if isinstance(scene.device, Device):
        # Add the normalized parameters, which exist only for a device with a known mass.
        omega = wall.frequency * (2.0 * math.pi * scene.timing.period)
        numbers = {"delta": scene.delta, "d": scene.d, "alpha_max": alpha, "beta": beta, "omega": omega}
        result = {name: float(number) for name, number in numbers.items()}
        optimum = f"alpha_max {result['alpha_max']:.12g}, beta {result['beta']:.12g}"
        lines = [printing.format_line("", f"({optimum}, delta {plain(result['delta'])}, d {plain(result['d'])})")]
        if given is None:
            lines = [
                printing.format_line("alpha_max", f"{result['alpha_max']:.12g} ({kind.replace('_', ' ')} optimum)"),
                printing.format_line("beta", f"{result['beta']:.12g}"),
                printing.format_line("device", f"delta {plain(result['delta'])}, d {plain(result['d'])}"),
            ]
    result["kind"] = kind
    if given is not None:
        slopes = printing.list_slopes(scene) if scene.loop.has_boundary else []
        notes = printing.list_notes(scene) + _list_obstacles(scene)
        stiffest = scene.replace(wall=VirtualWall(float(wall.stiffness), float(wall.virtual_damping)))
        cautions = [*printing.compare_with_limit(stiffest), *printing.list_omission_cautions(scene, find_omitted())]
        wall_values = wall.stiffness, wall.virtual_damping, wall.frequency
        named = dict(zip(("stiffness_max", "virtual_damping", "frequency"), map(float, wall_values), strict=True))
        result |= named | {
            "sensitivities": {slope.name: slope.as_dict() for slope in slopes},
            "islands": _list_islands(scene),
            "notes": notes,
            "cautions": cautions,
        }
        B, f = with_unit(wall_values[1], scene.unit_system["N s/m"]), with_unit(named["frequency"], "Hz")
        K = format_stiffness(named["stiffness_max"], scene.unit_system)
        advice = "zwidth recommend, with the same options, for the wall to set"
        top = f"{K} at B = {B}, {f} ({kind.replace('_', ' ')} optimum)"
        lines = [
            printing.format_line("K_max", top),
            *lines,
            printing.format_line("device", spell_device(scene, find_omitted())),
            *printing.format_parts(scene),
            *(printing.format_line("CAUTION", text) for text in cautions),
            *([printing.format_line("next", advice)] if scene.loop.has_boundary else []),
            "",
            *(slope.line() for slope in slopes),
            *printing.format_notes(notes),
        ]
    printing.print_result(result, lines, as_json, printing.LABEL)


def _list_islands(scene: Any) -> list[dict[str, Any]] | None:
    """Return the separate stable regions as dicts; None if they are not available with the tool of the scene."""
    return [island._asdict() for island in scene.islands()] if scene.loop.has_pieces else None


def _list_obstacles(scene: Any) -> list[str]:
    """Return notes on the measurements that are required to certify a stiffer wall on a measured response."""
    if not isinstance(scene.device, MeasuredDevice):
        return []
    from zwidth.identification.response_estimate import find_nominal_limit

    top = find_nominal_limit(scene)
    said = scene.explain_undecided(float(top.stiffness), float(top.virtual_damping)) if top.status == Status.OK else []
    K_max = format_stiffness(float(top.stiffness), scene.unit_system)
    return [f"K_max = {K_max} for the measured curve without its error band; {text}" for text in said]


@cli.command()
def schema() -> None:
    """Print the JSON Schema of configuration files, for editors."""
    from zwidth.studies.document import config_json_schema

    printing.print_json(config_json_schema())


@cli.command()
@click.argument("name", required=False)
@json_option
def devices(name: str | None, as_json: bool) -> None:
    """List devices with published parameters, or the parameters of the device NAME with their sources."""
    from zwidth.model.devices import DEVICES, find_device

    chosen = DEVICES if name is None else (find_device(name),)
    if name is None:
        lines = []
        for device in chosen:
            numbers = (f"{key.replace('_', ' ')} {each.spell()}" for key, each in device.parameters.items())
            # Omit the name of the parameter "counts", because its unit has the same name.
            lines.append(format_row(device.name, ", ".join(number.removeprefix("counts ") for number in numbers)))
    else:
        notes = {
            quantity: f" ({number.note})" if number.note else "" for quantity, number in chosen[0].parameters.items()
        }
        lines = [f"{chosen[0].title} ({chosen[0].motion})"]
        lines += [
            format_row(key, f"{each.spell()}{notes[key]}; {each.source}") for key, each in chosen[0].parameters.items()
        ]
    printing.print_result([device.as_dict() for device in chosen], lines, as_json)


def _complete(context: click.Context, parameter: click.Parameter, begun: str) -> list[str]:
    """Return the names of examples that begin with ``begun``, the text typed in the shell so far."""
    return [name for name in find_examples() if name.startswith(begun)]


@cli.command()
@click.argument("names", nargs=-1, metavar="[NAME]", shell_complete=_complete)
@click.option(
    "--example",
    metavar="EXAMPLE",
    shell_complete=_complete,
    help="Example to copy.  [default: NAME if it is an example, else quickstart]",
)
@click.option("--list", "listing", is_flag=True, help="List the examples.")
def init(names: tuple[str, ...], example: str | None, listing: bool) -> None:
    """Write an example configuration NAME.yaml to run and edit.

    The command never replaces an existing file. If NAME is omitted, the file has the name of the example.
    """
    examples = find_examples()
    if len(names) > 1:
        first, second = names[:2]
        hint = f"; write zwidth init {second} --example {first}" if first in examples else ""
        raise click.UsageError(f"got {len(names)} names, {first!r} and {second!r}, but one NAME is allowed{hint}")
    name = names[0] if names else None
    if listing:
        width = max(map(len, examples))
        for each, path in examples.items():
            comments = [line.lstrip("# ") for line in path.read_text(encoding="utf-8").splitlines() if line[:1] == "#"]
            sentence = re.match(r".*?[.?](?= |$)", " ".join(filter(None, comments[1:])))
            assert sentence is not None, "every example begins with a description"
            printing.print_lines([f"{each:<{width}}  {sentence.group()}"], width + 2)
        return
    example = example or (name if name in examples else "quickstart")
    check_choice("--example", example, tuple(examples))
    name = (name or example).removesuffix(".yaml")
    if not re.fullmatch("[a-z0-9_-]{1,64}", name):
        raise InputError(f"NAME: got {name!r}; write 1 to 64 of a-z, 0-9, _ and -, such as my_device")
    text = examples[example].read_text(encoding="utf-8")
    # Remove the line with the path of the schema, because the schema exists only in a checkout. Set the name in the
    # configuration to that of the new file, because the results of a run have this name.
    text = re.sub(r"\A# yaml-language-server:.*\n(?:#\n)?", "", text)
    text = re.sub(r"(?m)^name: .*$", f"name: {name}", text, count=1)
    contents = {Path(f"{name}.yaml"): text}
    for table in map(Path, _TABLE.findall(text)):
        content = examples[example].with_name(table.name).read_text(encoding="utf-8")
        # Do not write a table that exists already and has the same content.
        if not table.is_file() or table.read_bytes() != content.encode():
            contents[table] = content
    for file in contents:
        if file.exists() or file.is_symlink():
            raise InputError(f"{file}: already exists and is not overwritten; give another NAME, or move the file")
    for file, content in contents.items():
        with open(file, "x", encoding="utf-8") as stream:
            stream.write(content)
        click.echo(f"wrote {file}")
    click.echo(f"run it with: zwidth run {name}.yaml   (results go to runs/{name})")


def find_examples() -> dict[str, Path]:
    """Return the example configurations by name, from the package or from the checkout."""
    packaged = _PACKAGE / "examples"
    folder = packaged if packaged.is_dir() else _PACKAGE.parents[1] / "configs"
    examples = {file.stem: file for file in sorted(folder.glob("*.yaml"))}
    if not examples:
        raise ZwidthError(f"init: {packaged} contains no examples; reinstall zwidth")
    return examples


@cli.command()
@click.argument("path", metavar="[CONFIG|DIR]", required=False, type=PATH)
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port on this machine.  [default: any free one]")
@click.option("--no-browser", is_flag=True, help="Print the address without opening a browser.")
def explore(path: Path | None, port: int, no_browser: bool) -> None:
    """Open a page in the browser with sliders for device and wall, and a chart of the stable walls.

    The page starts with the scene of the file CONFIG, or of the run in DIR. The server accepts connections only from
    this machine, and only with the token that the address of the page contains. To stop the server, press Ctrl-C.
    """
    import threading
    import webbrowser

    try:
        from zwidth.app.explorer.server import Explorer
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("bokeh", "tornado"):
            raise
        raise InputError(
            f"explore: requires bokeh, which is not installed; install it: {format_install_command('explore')}"
        ) from error
    from zwidth.app.explorer.controls import read_controls
    from zwidth.runs.record import find_config

    explorer = Explorer(read_controls(find_config(path) if path and path.is_dir() else path), port)
    click.echo(f"{explorer.address}  (Ctrl-C ends it)")
    if not no_browser:
        # Open the browser in a thread, because a text browser would block the server.
        threading.Thread(target=webbrowser.open, args=(explorer.address,), daemon=True).start()
    explorer.run()
    click.echo("stopped")


@cli.command()
@folder_argument
@click.option("--out", type=PATH, help="File to write.  [default: DIR/report.html]")
@json_option
def report(folder: Path, out: Path | None, as_json: bool) -> None:
    """Write the results of the run in DIR as one HTML file, with slices of its sweeps.

    The file contains figures, methods, versions and configuration. It can be opened without a server and without a
    network connection.
    """
    from zwidth.app.report.page import write_report

    file = write_report(folder, out)
    printing.print_result({"file": str(file), "bytes": file.stat().st_size}, [f"wrote {file}"], as_json)


_FACTOR = Parsed("FACTOR", read_factor, "write a factor, such as 2 or 6 dB")
_DEGREES = Parsed("DEGREES", read_degrees, "write degrees, such as 30")


@cli.command(**show_example("recommend --phase-margin 30", OF_SCENE))
@scene_options(wall=False)
@click.option("--stiffness-fraction", type=SHARE, help="Largest share of K_max.  [default: 75%]")
@click.option("--gain-margin", type=_FACTOR, help="Smallest gain margin, a factor on K and B together.  [default: 2]")
@click.option("--phase-margin", type=_DEGREES, help="Smallest phase margin, in degrees.  [default: 30]")
@click.option(
    "--passive",
    is_flag=True,
    help="Allow only passive walls. They are stable in any grasp, because no passive hand can destabilize them.",
)
@click.option(
    "--grasps",
    type=click.Choice(("all", "soft", "none")),
    help="Reference grasps in which the wall must be stable; for every passive hand, use --passive.  [default: soft "
    "with the default margins, else none]",
)
@hardware_options
@beyond_safe_option
@figure_option
@code_option
@verbose_option
@json_option
def recommend(
    scene: Any,
    figure: Path | None,
    code: Any,
    hardware: dict[str, Any],
    verbose: bool,
    as_json: bool,
    **wanted: Any,
) -> None:
    """Recommend the wall to set: the stiffest wall with the required margins.

    The options --mass (or --device) and --rate (or --period) are required; the defaults of damping and delay are 0.
    Parameters that are not given as options are taken from SCENE.yaml (or from the folder of a run). If you use
    --stiffness-fraction, --gain-margin, --phase-margin or --passive, your requirement replaces all default
    requirements; --grasps does not replace them. With --passive as the only requirement, the result is the stiffest
    passive wall, as in publications on passivity; add --phase-margin 30 --gain-margin 2 to keep the default margins.
    With --resolution, --friction or --max-force, the command also simulates the wall to find limit cycles and
    saturation; --max-force also limits the force in the code of --code. A hand (--operator-...) is a part of the
    device, and the command also checks the wall without this hand. The exit code is 1 if no wall exists.
    """
    from zwidth.app.verdict import format_recommendation

    if code and as_json:
        raise click.UsageError("give only one of --code or --json: each replaces the whole output")
    if float(scene.d) >= LONG_SEARCH:
        click.echo(
            f"zwidth: the delay is {format_periods(float(scene.d))}, so the search for a wall may take minutes; zwidth "
            "ridge prints K_max at once",
            err=True,
        )
    recommendation = scene.recommend(**wanted)
    written = []
    if figure is not None:
        from zwidth.studies.responses import draw

        written.append(save_figure(draw(recommendation), figure))
    if code:
        if recommendation.status != Status.OK:
            raise click.ClickException(recommendation.reason)
        for caution in printing.list_omission_cautions(scene, find_omitted()):
            click.echo(f"zwidth: {caution}", err=True)
        click.echo(recommendation.code(code, max_force=hardware.get("max_force", math.inf)), nl=False)
        return
    diagnosis = (
        diagnose_wall(recommendation.scene, hardware, remedies=not get_hardware())
        if recommendation.status == Status.OK
        else None
    )
    notes, lines, result = [*printing.list_period_notes(scene), *recommendation.notes], list[str](), dict[str, Any]()
    if as_json:
        result = recommendation.as_dict() | {"notes": notes}
        result |= {"gains": gains} if (gains := list_cascade(recommendation)) else {}
        result["cautions"] += printing.list_omission_cautions(scene, find_omitted())
        result |= {} if diagnosis is None else {"diagnosis": diagnosis.as_dict()}
    else:
        texts = {"omitted": find_omitted(), "hardware": spell_hardware_of_file(scene)}
        lines = format_recommendation(recommendation, **texts, diagnosis=diagnosis, verbose=verbose)
    printing.print_result(result, [*lines, *printing.format_notes(notes), *written], as_json, printing.LABEL)
    if recommendation.status != Status.OK:
        raise SystemExit(EXIT_FAILED)
