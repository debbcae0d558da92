"""Options that several commands share: quantities, and those that describe a scene."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeAlias

import click

from zwidth.words.quantities import ANY, NOT_NEGATIVE, PARAMETERS, Range

if TYPE_CHECKING:
    from zwidth.scenes.scene import Scene

Command: TypeAlias = Callable[..., Any]

VELOCITY_KINDS = ("backward_difference", "windowed_difference", "low_pass", "butterworth")


class QuantityType(click.ParamType):
    """A number in its SI unit, or a number with a unit, as in configuration files."""

    name = "quantity"

    def __init__(self, unit: str, allowed: Range = ANY, *, periods: bool = False) -> None:
        self.unit, self.allowed, self.periods = unit, allowed, periods

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse one option; a length of time that may be in periods becomes a `Span`."""
        from zwidth.parts.span import read_span
        from zwidth.words.errors import UnusableValueError
        from zwidth.words.units import find_dimension, read_quantity

        try:
            number: Any = float(value)
        except (TypeError, ValueError):
            number = value
        try:
            if self.periods:
                return read_span(number, self.allowed)
            return read_quantity(number, find_dimension(self.unit), self.allowed)[0]
        except UnusableValueError as error:
            self.fail(str(error), param, ctx)


def _parameter_type(name: str) -> QuantityType:
    parameter = PARAMETERS[name]
    return QuantityType(parameter.unit, parameter.allowed, periods=name == "delay")


# Path in a scene, as in configuration files: what the option takes, and what it is. The parts check the ranges.
_PARTS: dict[str, tuple[Any, str]] = {
    "velocity.kind": (click.Choice(VELOCITY_KINDS), "Velocity estimate; told by the options below where it can be."),
    "velocity.samples": (click.INT, "Window of the velocity difference, in samples."),
    "velocity.cutoff": (QuantityType("Hz"), "Cut-off of a low-pass on the velocity, in Hz."),
    "velocity.time_constant": (QuantityType("s"), "Its time constant, in s, in place of the cut-off."),
    "velocity.order": (click.INT, "Its order: low-pass 1 or 2, Butterworth 1 to 8."),
    "velocity.coded_period": (QuantityType("s"), "The period that the estimate was written for, where it is another."),
    "operator.mass": (QuantityType("kg"), "Mass of the hand, in kg."),
    "operator.damping": (QuantityType("N s/m"), "Damping of the hand to ground, in N s/m."),
    "operator.stiffness": (QuantityType("N/m"), "Stiffness of the hand to ground, in N/m."),
    "operator.coupling_stiffness": (QuantityType("N/m"), "Spring between hand and device; rigid where left out."),
    "operator.coupling_damping": (QuantityType("N s/m"), "Damper beside that spring, in N s/m."),
    "coupling.mass": (QuantityType("kg"), "Mass of the tip, beyond a spring and damper of the device."),
    "coupling.stiffness": (QuantityType("N/m"), "That spring, in N/m."),
    "coupling.damping": (QuantityType("N s/m"), "That damper, in N s/m."),
    "coupling.sensor": (click.Choice(("motor", "tip")), "Where the position is measured; at the motor by default."),
}


def flag_of(path: str) -> str:
    """The option of a parameter: ``--velocity-cutoff`` for ``velocity.cutoff``."""
    return "--" + path.replace(".", "-").replace("_", "-")


def scene_options(*, wall: bool, required: bool) -> Callable[[Command], Command]:
    """The options that describe a scene, which the command gets as ``scene``: a `zwidth.Scene`.

    Args:
        wall: whether they include the wall that is judged.
        required: whether there must be a scene; otherwise ``scene`` is None where no mass is given.
    """
    bare = (*(("stiffness", "virtual_damping") if wall else ()), "mass", "damping", "period", "rate", "delay")

    def decorate(function: Command) -> Command:
        @wraps(function)
        def with_scene(**given: Any) -> Any:
            named = {path: given.pop(path.replace(".", "__")) for path in (*bare, *_PARTS)}
            scene = build_scene({path: value for path, value in named.items() if value is not None}, required)
            return function(scene=scene, **given)

        command = with_scene
        for path, (kind, words) in reversed(_PARTS.items()):
            command = click.option(flag_of(path), path.replace(".", "__"), type=kind, help=words)(command)
        for name in reversed(bare):
            parameter = PARAMETERS[name]
            text = f"{parameter.symbol}, in {parameter.unit}."
            if name == "delay":
                text = "t_d, in s or in periods."
            elif name == "rate":
                text = "1/T, in Hz, in place of the period."
            must = name == "stiffness" or (required and name == "mass")
            command = click.option(flag_of(name), type=_parameter_type(name), required=must, help=text)(command)
        return command

    return decorate


def velocity_options(function: Command) -> Command:
    """The options of a velocity estimate alone, which the command gets as ``velocity``."""
    paths = [path for path in _PARTS if path.startswith("velocity.")]

    @wraps(function)
    def with_velocity(**given: Any) -> Any:
        named = {path.partition(".")[2]: given.pop(path.replace(".", "__")) for path in paths}
        return function(
            velocity=_velocity({name: value for name, value in named.items() if value is not None}), **given
        )

    command = with_velocity
    for path in reversed(paths):
        kind, words = _PARTS[path]
        command = click.option(flag_of(path), path.replace(".", "__"), type=kind, help=words)(command)
    return command


def build_scene(given: dict[str, Any], required: bool = True) -> Scene | None:
    """The scene of some options by path; None where nothing describes one and none is required."""
    from zwidth.cli.doubts import doubts_of
    from zwidth.parts.coupling import Coupling
    from zwidth.parts.device import Device
    from zwidth.parts.operator import Operator
    from zwidth.parts.timing import Timing
    from zwidth.parts.wall import VirtualWall
    from zwidth.scenes.scene import Scene
    from zwidth.words.errors import InputError

    if not given and not required:
        return None
    if "mass" not in given or ("period" in given) == ("rate" in given):
        raise click.UsageError("give --mass, and one of --period and --rate")
    for line in doubts_of(given):
        click.echo(f"zwidth: {line}", err=True)

    def part(name: str) -> dict[str, Any]:
        return {path.partition(".")[2]: value for path, value in given.items() if path.startswith(f"{name}.")}

    def own(*names: str) -> dict[str, Any]:
        return {name: given[name] for name in names if name in given}

    try:
        tip, hand = part("coupling"), part("operator")
        for name in ("mass", "stiffness") if tip else ():
            if name not in tip:
                raise click.UsageError(f"a coupling has a mass and a stiffness; give {flag_of(f'coupling.{name}')}")
        scene = Scene(
            Device(**own("mass", "damping"), coupling=Coupling(**tip) if tip else None),
            Timing(**own("period", "rate", "delay")),
            VirtualWall(given.get("stiffness", 0.0), given.get("virtual_damping", 0.0)),
            velocity=_velocity(part("velocity")),
            operator=Operator(**hand) if hand else None,
        )
        # What parts refuse only together, as a cut-off beyond half the sampling rate.
        _ = scene.is_rigid or scene.loop
        return scene
    except InputError as error:
        field, _, text = str(error).partition(": ")
        known = field in _PARTS or field in PARAMETERS
        raise click.BadParameter(text, param_hint=f"'{flag_of(field)}'") if known else error from None


def _velocity(given: dict[str, Any]) -> Any:
    from zwidth.parts.velocity import BackwardDifference, Butterworth, LowPass, WindowedDifference

    kind = given.pop("kind", None)
    if kind is None:
        low = {"cutoff", "time_constant"} & set(given)
        kind = "windowed_difference" if "samples" in given else "low_pass" if low else "backward_difference"
    parts = dict(zip(VELOCITY_KINDS, (BackwardDifference, WindowedDifference, LowPass, Butterworth), strict=True))
    takes = {
        "backward_difference": set(),
        "windowed_difference": {"samples"},
        "low_pass": {"cutoff", "time_constant", "order"},
        "butterworth": {"cutoff", "order"},
    }[kind] | {"coded_period"}
    needs = {"windowed_difference": "samples", "butterworth": "cutoff", "low_pass": "cutoff"}.get(kind)
    if needs and needs not in given and not (kind == "low_pass" and "time_constant" in given):
        raise click.UsageError(f"a velocity estimate of kind {kind} needs {flag_of(f'velocity.{needs}')}")
    for name in sorted(set(given) - takes):
        raise click.UsageError(f"{flag_of(f'velocity.{name}')} does not belong to a velocity estimate of kind {kind}")
    return parts[kind](**given)


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
friction_option = click.option(
    "--friction", type=QuantityType("N", NOT_NEGATIVE), help="Coulomb friction f_c of the device, in N."
)
resolution_option = click.option(
    "--resolution", type=QuantityType("m", Range(0.0, low_open=True)), help="One step Q of the position sensor, in m."
)
