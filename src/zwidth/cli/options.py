"""Options shared by several commands: quantities with units, and the parameters of a scene.

A scene is a device with its timing, wall and velocity estimate. Parameters are named by their path in a scene, as in
configuration files: ``velocity.cutoff`` is given by the option ``--velocity-cutoff``. A scene file (a configuration
or the folder of a run) supplies all parameters not given as options. The units of the options determine the kind
of device, linear (N/m) or rotary (N m/rad).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import click

from zwidth.app.printing import format_row
from zwidth.cli.help import OF_SCENE as OF_SCENE
from zwidth.cli.help import show_example as show_example
from zwidth.cli.parts import FILTER_HELP, change_kind, make_part, name_option, select_part
from zwidth.core.errors import InputError
from zwidth.model.checks import Span, find_kind, read_span
from zwidth.model.device import Device
from zwidth.model.linear_device import LinearDevice
from zwidth.model.mode import Mode
from zwidth.model.parameter_paths import CONTAINED, PARTS, WITH_KIND, find_parts
from zwidth.model.timing import Timing
from zwidth.model.wall import NoWall, VirtualWall
from zwidth.units.parsing import DIMENSIONS, detect_kind, looks_like_number, read_quantity, read_share
from zwidth.units.plausibility import list_implausible
from zwidth.units.quantities import ANY, CHOICES, FIELDS, HARDWARE, OF_PARTS, PARAMETERS, Range
from zwidth.units.unit_system import SYSTEMS, UnitSystem

if TYPE_CHECKING:
    from zwidth.analysis.scene import Scene
    from zwidth.model.devices import PublishedDevice

# Keys under which data are stored in the click context of a command.
_WITH_KIND = "zwidth.with_kind"  # options whose units determine the kind of device, linear or rotary
_HARDWARE = "zwidth.hardware"  # encoder, friction and motor of the scene file
LONG_DELAY = 0.5  # s; the largest plausible delay. A longer one requires a unit
BOTH_PERIODS = "--period and --rate are both given; give only one of them"
Command: TypeAlias = Callable[..., Any]

# Names of the parts of a scene; and the paths of the parameters of all parts, sorted by part.
_PART_NAMES = tuple(dict.fromkeys(("velocity", *WITH_KIND, *(path.rpartition(".")[0] for path in OF_PARTS))))
_PARTS = sorted((*CHOICES, *OF_PARTS), key=lambda path: _PART_NAMES.index(path.rpartition(".")[0]))
# Names of the structural modes among the parts: "modes.0", "modes.1" and so on.
_MODES = tuple(name for name in _PART_NAMES if name.startswith("modes."))
_BARE = {"mass", "damping"}  # parameters of a rigid device


class Parsed(click.ParamType):
    """Type of a click option: ``read`` converts its text; ``remedy`` completes the message for an invalid text."""

    def __init__(self, name: str, read: Callable[[str], Any], remedy: str = "") -> None:
        self.name, self.read, self.remedy = name, read, remedy

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the value of an option, converted from its text; report a `ValueError` as a usage error."""
        if self.name == "quantity" and ctx is not None and param is not None and detect_kind(value) is not None:
            ctx.meta.setdefault(_WITH_KIND, {})[param.opts[0]] = value
        try:
            return self.read(value)
        except ValueError as error:
            self.fail(f"got {value!r}; {self.remedy}" if self.remedy else str(error), param, ctx)


def get_options_with_kind() -> dict[str, Any]:
    """Return the options of the running command whose units imply a linear or a rotary device, as a dict by name."""
    return click.get_current_context().meta.get(_WITH_KIND, {})


def get_hardware() -> dict[str, float]:
    """Return the hardware of the scene file of the running command: the arguments of `zwidth.diagnose` by name."""
    return click.get_current_context().meta.get(_HARDWARE, {})


def quantity_type(unit: str, allowed: Range = ANY, *, periods: bool = False, counts: bool = False) -> Parsed:
    """Return the click type of an option for a quantity: a number in an SI unit, or a number with a unit.

    With ``periods`` the value is a duration, which may also be given in sampling periods, and becomes a `Span`.

    With ``counts`` the number is the step of an encoder, which may also be given as "2000 counts".
    """

    def read(text: str) -> Any:
        try:
            # Keep the text of inf and nan for the error message.
            number = value if math.isfinite(value := float(text)) else text
        except ValueError:
            number = text
        if periods:
            return read_span(number, allowed)
        # Read each option in the unit system (linear or rotary) of its unit. The systems of all options are compared
        # later, when the scene is built.
        dimension = DIMENSIONS[SYSTEMS[bool(detect_kind(number))][unit]]
        return read_quantity(number, dimension, allowed, counts=counts)[0]

    # Give the type of a bandwidth another name, because its unit rad/s does not imply a rotary device.
    return Parsed("bandwidth" if unit == "1/s" else "quantity", read)


def _read_delay(text: str) -> Any:
    """Return a delay as a `Span`; refuse a long one without a unit, because it is probably meant in periods or ms."""
    if looks_like_number(text) and float(text) >= LONG_DELAY:
        number = text.strip()
        raise ValueError(
            f"got {text!r}, i.e. {number} s; write '{number} periods' or '{number} ms', or '{number} s' if it is meant "
            "in seconds"
        )
    return quantity_type("s", PARAMETERS["delay"].allowed, periods=True).read(text)


SHARE = Parsed("SHARE", read_share, "write a share, such as 2% or 0.02")


def _read_figure(text: str) -> Path:
    """Return the path of a figure to write; raise an error if its folder does not exist."""
    file = Path(text)
    if file.suffix not in (".png", ".svg", ".pdf"):
        raise ValueError(f"got {text!r}; name a file that ends with .png, .svg or .pdf")
    if not file.parent.is_dir():
        raise ValueError(f"folder {file.parent} does not exist; create it first")
    return file


def _add_option(command: Command, path: str) -> Command:
    """Return a command with the option of one parameter added; ``path`` is the path of the parameter in a scene."""
    if path == "device":
        words = (
            "A published device of `zwidth devices`, with its period and delay; other options add or replace "
            "parameters. Or, in place of mass, damping and all parts: a transfer function 'NUM / DEN' by its "
            "coefficients in s, such as '1 / 0.1 10 0', by its roots, 'zpk: ZEROS / POLES / GAIN', or by sections, "
            "'sos: b0 b1 b2 a0 a1 a2; ..'; a measured response FILE.csv (.npz, .mat); or FILE.yaml with the keys of a "
            "device of a scene file, such as mass_matrix, or model and site of a robot."
        )
        return click.option("--device", metavar="NAME", help=words)(command)
    if path == "sampled":
        words = "The transfer function of --device is in z, at the period of the loop, and includes hold and delay."
        return click.option("--sampled", is_flag=True, default=None, help=words)(command)
    if path == "velocity.filter":
        return click.option("--velocity-filter", "velocity__filter", metavar="FILTER", help=FILTER_HELP)(command)
    if path in CHOICES:
        kind, text = click.Choice(CHOICES[path].names), CHOICES[path].sentence
    else:
        parameter = FIELDS[path]
        # Skip the range check of parameters of parts, because the constructors of the parts check them.
        allowed = ANY if "." in path else parameter.allowed
        kind = click.INT if parameter.whole else quantity_type(parameter.unit, allowed)
        kind = Parsed("quantity", _read_delay) if path == "delay" else kind
        unit, note = (
            f", in {parameter.unit_words}" if parameter.unit_words else "",
            f"; {parameter.note}" if parameter.note else "",
        )
        text = f"{parameter.sentence}{unit}{note}"
    return click.option(name_option(path), path.replace(".", "__"), type=kind, help=f"{text}.")(command)


# Paths of the parameters of a rigid device and of its timing.
_TIMED = ("mass", "damping", "period", "rate", "delay")


def scene_options(
    *, wall: bool, instead: str = "", make: Callable[[dict[str, Any], UnitSystem], Any] | None = None
) -> Callable[[Command], Command]:
    """Return a decorator that adds the options of a scene, with or without wall, and the argument of a scene file.

    The command receives a `zwidth.Scene` as ``scene``, or None if ``instead`` names alternative options and no scene
    option is given. If ``make`` is given, the argument ``scene`` is instead the result of ``make(values, units)``:
    ``values`` maps the path of each given parameter to its value, and ``units`` is the unit system of the options.
    """
    bare = (*(("stiffness", "virtual_damping") if wall else ()), "device", "sampled", *_TIMED)
    take = take_options(
        "scene",
        (*bare, "velocity.filter", *_PARTS),
        make or (lambda given, system: build_scene(given, system, instead, wall=wall)),
    )
    return lambda command: scene_argument(take(command))


def take_options(
    name: str, paths: Sequence[str], make: Callable[[dict[str, Any], UnitSystem], Any]
) -> Callable[[Command], Command]:
    """Add the options of the parameters ``paths``; the command receives ``make(values, units)`` as argument ``name``.

    The units are those of the options of the command, linear or rotary.
    """

    def decorate(function: Command) -> Command:
        @wraps(function)
        def with_made(**given: Any) -> Any:
            named = {path: given.pop(path.replace(".", "__")) for path in paths}
            values = {path: each for path, each in named.items() if each is not None}
            context = click.get_current_context()
            try:
                with_kind = context.meta.get(_WITH_KIND, {})
                if (file := given.pop("scene_file", None)) is not None:
                    values["scene"] = read_scene_file(file)
                    with_kind = {file.name: values["scene"].device, **with_kind}
                if values.get("sampled") and "device" not in values:
                    raise click.UsageError("--sampled: give --device 'NUM / DEN' with coefficients in z")
                if "device" in values:
                    from zwidth.config.device_files import read_device_option

                    options = context.meta.get(_WITH_KIND, {})
                    values["device"] = read_device_option(
                        values["device"], _find_sampled_period(values), rotary=bool(find_kind(options))
                    )
                    # Ignore the unit system and the hardware of the scene file, because the option --device replaces
                    # the device of the file.
                    context.meta.pop(_HARDWARE, None)
                    with_kind = options | {"--device": values["device"]}
                return function(**{name: make(values, SYSTEMS[bool(find_kind(with_kind))])}, **given)
            except InputError as error:
                field, _, text = str(error).partition(": ")
                flags = {option.name: option.opts[0] for option in context.command.params}
                if field.replace(".", "__") not in flags:
                    raise
                raise click.BadParameter(text, param_hint=f"'{flags[field.replace('.', '__')]}'") from None

        command = with_made
        for path in reversed(paths):
            command = _add_option(command, path)
        return command

    return decorate


def _find_sampled_period(values: dict[str, Any]) -> float | None:
    """Remove the option --sampled from ``values``; return the sampling period in s if it was given, otherwise None."""
    if not values.pop("sampled", False):
        return None
    if "rate" in values or "period" in values:
        return values["period"] if "period" in values else 1.0 / values["rate"]
    if "scene" not in values:
        raise click.UsageError("--sampled: also give --rate or --period")
    return float(values["scene"].timing.period)


def warn_implausible(given: dict[str, Any], system: UnitSystem) -> None:
    """Print a warning on stderr for each implausible value of ``given``, a dict of SI values by path."""
    for line in list_implausible(
        given, lambda path, value: f"{name_option(path)} '{value}'" if value else name_option(path), system
    ):
        click.echo(f"zwidth: {line}", err=True)


def read_scene_file(path: Path) -> Scene:
    """Return the scene of a configuration file, or of the run in a folder; print its warnings on stderr."""
    from zwidth.runs.record import find_config
    from zwidth.studies.document import load_config, load_scene

    file = find_config(path) if path.is_dir() else path
    given = load_config(file).scene
    for line in getattr(given, "warnings", ()):
        click.echo(f"zwidth: {line}", err=True)
    click.get_current_context().meta[_HARDWARE] = getattr(given, "hardware", {})
    return load_scene(file)


def build_scene(given: dict[str, Any], system: UnitSystem, instead: str = "", *, wall: bool = False) -> Scene | None:
    """Return the scene with the parameters ``given`` (by path) and all other parameters from ``given["scene"]``.

    Return None if no option is given and ``instead`` names alternative options.
    """
    if not given and instead:
        return None
    if {"period", "rate"} <= given.keys():
        raise click.UsageError(BOTH_PERIODS)
    base = given.pop("scene", None)
    if wall and "stiffness" not in given and (base is None or isinstance(base.wall, NoWall)):
        raise click.UsageError("give --stiffness" + ("" if base is None else ": the scene of the file has no wall"))
    numbers = {
        path: value.value if isinstance(value, Span) and value.unit == "s" else value for path, value in given.items()
    }
    warn_implausible(numbers, system)
    scene = _make_scene(given, system, instead) if base is None else change_scene(base, given)
    scene.check_parts()
    if isinstance(scene.device, LinearDevice) and (warning := scene.device.warn_of_variable(scene.timing.period)):
        click.echo(f"zwidth: --device: {warning} add --sampled", err=True)
    return scene


def change_scene(scene: Scene, given: dict[str, Any]) -> Scene:
    """Return a scene with the option values in ``given``, by parameter path; parts that options set are added."""
    from zwidth.model.devices import PublishedDevice

    changes = {path: value for path, value in given.items() if "." not in path}
    device = changes.get("device")
    if isinstance(device, PublishedDevice):
        _check_published(device, given)
        changes["device"] = device.to_device(**{name: changes.pop(name) for name in _BARE & changes.keys()})
    for owner in ("velocity", *WITH_KIND):
        if part_values := select_part(given, owner):
            changes[owner] = change_kind(owner, getattr(scene, owner), part_values)
    parts = {} if device else find_parts(scene)
    modes = list(() if device else scene.device.modes)
    for name, kind in {**PARTS, **dict.fromkeys(_MODES, Mode)}.items():
        if part_values := select_part(given, name):
            part = replace(parts[name], **part_values) if name in parts else make_part(name, kind, part_values)
            if kind is not Mode:
                changes[name] = part
            elif name in parts:
                modes[int(name.removeprefix("modes."))] = part
            else:
                modes.append(part)
    if isinstance(scene.device, Device) and tuple(modes) != scene.device.modes:
        changes["modes"] = tuple(modes)
    try:
        return scene.replace(**changes)
    except InputError as error:
        if not str(error).startswith("parameter: "):
            raise
        flags = ", ".join(map(name_option, sorted(_BARE & given.keys())))
        raise click.UsageError(
            f"{flags}: the file gives the device as a linear system or a response; change it in the file"
        ) from None


def _make_scene(given: dict[str, Any], system: UnitSystem, instead: str) -> Scene:
    """Return the scene built from options, without a scene file."""
    from zwidth.analysis.scene import Scene
    from zwidth.model.devices import PublishedDevice

    device = given.pop("device", None)
    published = device if isinstance(device, PublishedDevice) else None
    timed = {"period", "rate"} & given.keys() or (published and published.period)
    requirements = {"--mass or --device": device or "mass" in given, "--rate or --period": timed}
    missing = [flags for flags, given_any in requirements.items() if not given_any]
    if published:
        _check_published(published, given, missing)
    if missing:
        normalized = f"; for normalized parameters, give only {instead}" if instead else ""
        raise click.UsageError(f"give {', and '.join(missing)}{normalized}")

    def select(*names: str) -> dict[str, Any]:
        """Return the values that are given among the named parameters, as a dict by name."""
        return {name: given[name] for name in names if name in given}

    timing = Timing
    if device is None:
        device = Device(**select("mass", "damping"), rotary=system.rotary)
    elif isinstance(device, PublishedDevice):
        timing, device = device.to_timing, device.to_device(**select("mass", "damping"))
    elif isinstance(device, Device):
        device = replace(device, **select("mass", "damping"))
    else:
        for path in (path for path in given if path in ("mass", "damping") or path.partition(".")[0] in CONTAINED):
            raise click.UsageError(
                f"{name_option(path)}: the given --device already contains it; give only one of the two"
            )
    wall = VirtualWall(given.get("stiffness", 0.0), given.get("virtual_damping", 0.0))
    rigid = Scene(device, timing(**select("period", "rate", "delay")), wall)
    return change_scene(rigid, {path: value for path, value in given.items() if "." in path})


def _check_published(device: PublishedDevice, given: dict[str, Any], more: Sequence[str] = ()) -> None:
    """Raise an error if parameters of a device are unpublished and not given as options; list these options."""
    remedies = {"mass": "--mass", "damping": "--damping (0 if unknown)"}
    flags = [*(remedies[name] for name in device.list_missing(given)), *more]
    if flags:
        raise click.UsageError(f"--device {device.name}: also give {', '.join(flags)}; not published for this device")


PATH = click.Path(path_type=Path)
folder_argument = click.argument("folder", metavar="DIR", type=PATH)
scene_argument = click.argument("scene_file", metavar="[SCENE.yaml|DIR]", required=False, type=PATH)
figure_option = click.option(
    "--figure", type=Parsed("FILE.png", _read_figure), help="Write a figure: FILE.png, .svg or .pdf."
)
beyond_safe_option = click.option("--beyond-safe", is_flag=True, help="Ignore the safe limit of a fitted scene.")
code_option = click.option(
    "--code", type=click.Choice(("c", "python")), help="Print only the code of the wall for the control loop."
)
verbose_option = click.option("--verbose", is_flag=True, help="Print all results.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print the results as JSON.")


def find_omitted() -> frozenset[str]:
    """Return which of damping, delay and friction are 0 only because neither an option nor a file gives a value.

    Friction is included only if the command simulates an encoder.
    """
    given, hardware = click.get_current_context().params, get_hardware()
    # Do not report the delay as missing with --sampled, because the transfer function of the device includes the delay.
    named = () if given.get("scene_file") is not None else ("damping", *(() if given.get("sampled") else ("delay",)))
    omitted = {name for name in named if given.get(name) is None}
    values = {name: hardware.get(name) if given[name] is None else given[name] for name in HARDWARE if name in given}
    simulated = values.get("resolution") and "coulomb" in values
    return frozenset(omitted | ({"friction"} if simulated and values["coulomb"] is values["static"] is None else set()))


def read_pairs(context: click.Context, option: click.Parameter, pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return the values of an option given several times, as a dict by name; raise an error for a repeated name."""
    values: dict[str, Any] = {}
    for name, value in pairs:
        if name in values:
            raise click.BadParameter(f"got {name!r} twice; give each name only once", context, option)
        values[name] = value
    return values


def save_figure(drawn: Any, file: Path) -> str:
    """Write a figure to a file, and return the line that reports its path."""
    from zwidth.plotting import save

    save(drawn, file.with_suffix(""), (file.suffix[1:],))
    return format_row("wrote", str(file))
