"""The commands: thin shells over the library, which they import only when they run."""

from __future__ import annotations

import json
from typing import Any

import click

from zwidth import __version__
from zwidth.cli import runs
from zwidth.cli.bench import bench
from zwidth.cli.design import design
from zwidth.cli.devices import devices
from zwidth.cli.explore import explore
from zwidth.cli.fit import fit
from zwidth.cli.init import init
from zwidth.cli.options import friction_option, json_option, resolution_option, scene_options
from zwidth.cli.report import report
from zwidth.cli.words import Slope, find_slopes, row, verdict_lines
from zwidth.words.formatting import plain, with_unit


@click.group(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Completion in bash (zsh, fish): _ZWIDTH_COMPLETE=bash_source zwidth > FILE, and '. FILE' in ~/.bashrc.",
)
@click.version_option(__version__, prog_name="zwidth")
def cli() -> None:
    """Stability of haptic virtual walls: what stiffness and damping a sampled, delayed device can render.

    A quantity is a number in SI base units (10e3) or a number with a unit ("10 kN/m").
    """


@cli.command()
@scene_options(wall=True, required=True)
@friction_option
@resolution_option
@json_option
def check(scene: Any, friction: float | None, resolution: float | None, as_json: bool) -> None:
    """Judge one wall: stable, passive, how far from the boundary, and what limits the device."""
    from zwidth.cli import scene_words
    from zwidth.scenes.assessment import Assessment, assess
    from zwidth.scenes.friction import friction_rule
    from zwidth.scenes.limits import limits_of

    verdict, limits, notes = assess(scene), limits_of(scene), scene_words.scene_notes(scene)
    rule = None
    if friction is not None or resolution is not None:
        device = {"damping": scene.damping, "period": scene.timing.period}
        rule = friction_rule(**device, friction=friction, resolution=resolution)
    if as_json:
        result = verdict.as_dict() | {"limits": [_without_nan(limit._asdict()) for limit in limits], "notes": notes}
        result["islands"] = [island._asdict() for island in scene.islands()]
        if rule is not None:
            result["friction_rule"] = rule._asdict() | {"stiffness": rule.stiffness}
        click.echo(json.dumps(result, indent=2, allow_nan=False))
        return
    rigid = isinstance(verdict, Assessment)
    lines = verdict_lines(scene, verdict) if rigid else scene_words.scene_verdict_lines(scene, verdict)
    lines += scene_words.limit_lines(limits) + (scene_words.friction_lines(rule) if rule is not None else [])
    for line in [*lines, *(row("note", note) for note in notes)]:
        click.echo(line)


def _without_nan(entries: dict[str, Any]) -> dict[str, Any]:
    return {name: None if value != value else value for name, value in entries.items()}


@cli.command()
@click.option("--delta", type=float, help="Normalized physical damping b T/m.")
@click.option("--d", type=float, help="Delay in periods.")
@scene_options(wall=False, required=False)
@click.option(
    "--delay-model",
    type=click.Choice(["held", "fractional_power"]),
    default="held",
    show_default=True,
    help="How a delay that is not whole is modelled.",
)
@json_option
def ridge(
    delta: float | None,
    d: float | None,
    scene: Any,
    delay_model: str,
    as_json: bool,
) -> None:
    """Print the stiffest stable wall of a device.

    The device is given by --delta and --d, or by its physical data; then what a little more damping, mass, rate or
    delay would change is printed as well.
    """
    import numpy as np

    from zwidth.loops.rigid.ridge import RidgeKind, alpha_max
    from zwidth.words.status import Status

    if (scene is None) == (delta is None) or (delta is None) != (d is None):
        raise click.UsageError("give either --delta and --d, or --mass and --period (with --damping and --delay)")
    if scene is not None and (not scene.is_rigid or scene.operator is not None):
        if delay_model != "held":
            raise click.UsageError("--delay-model fractional_power is for a rigid device without parts")
        _print_part_ridge(scene, as_json)
        return
    at_delta, at_d = (scene.delta, scene.d) if scene is not None else (delta, d)
    point = alpha_max(at_delta, at_d, delay=delay_model)  # pyright: ignore[reportArgumentType]  (click checked it)
    if int(point.status) != Status.OK:
        raise click.UsageError(f"--delta {at_delta}, --d {at_d}: {Status(int(point.status)).message}")
    slopes: list[Slope] = []
    result: dict[str, Any] = {
        "delta": float(np.asarray(at_delta)),
        "d": float(np.asarray(at_d)),
        "alpha_max": float(point.alpha),
        "beta": float(point.beta),
        "omega": float(point.omega),
        "kind": RidgeKind(int(point.kind)).name.lower(),
    }
    if scene is not None:
        wall = scene.to_si(alpha=point.alpha, beta=point.beta)
        result |= {"stiffness_max": float(wall.stiffness), "virtual_damping": float(wall.virtual_damping)}
        slopes = find_slopes(scene, delay_model)
        result["sensitivities"] = {slope.name: slope.as_dict() for slope in slopes}
    if as_json:
        click.echo(json.dumps(result, indent=2, allow_nan=False))
        return
    click.echo(row("device", f"delta = {plain(result['delta'])}, d = {plain(result['d'])}"))
    click.echo(row("alpha_max", f"{result['alpha_max']:.12g} ({result['kind']} optimum)"))
    click.echo(row("beta", f"{result['beta']:.12g}"))
    if scene is not None:
        click.echo(row("K_max", with_unit(result["stiffness_max"], "N/m")))
        click.echo(row("B", with_unit(result["virtual_damping"], "N s/m")))
    for slope in slopes:
        click.echo(slope.line())


def _print_part_ridge(scene: Any, as_json: bool) -> None:
    """The stiffest wall of a scene with parts."""
    from zwidth.cli import scene_words
    from zwidth.loops.rigid.ridge import RidgeKind
    from zwidth.words.status import Status

    wall = scene.max_stiffness()
    if int(wall.status) != Status.OK:
        raise click.UsageError(f"no wall with K > 0 is stable on this device: {Status(int(wall.status)).message}")
    slopes, kind = scene_words.part_slopes(scene), RidgeKind(int(wall.kind)).name.lower()
    if as_json:
        result = {
            "stiffness_max": float(wall.stiffness),
            "virtual_damping": float(wall.virtual_damping),
            "frequency": float(wall.frequency),
            "kind": kind,
            "sensitivities": {slope.name: slope.as_dict() for slope in slopes},
            "islands": [island._asdict() for island in scene.islands()],
            "notes": scene_words.scene_notes(scene),
        }
        click.echo(json.dumps(result, indent=2, allow_nan=False))
        return
    for line in scene_words.scene_lines(scene):
        click.echo(line)
    click.echo(row("K_max", f"{with_unit(float(wall.stiffness), 'N/m')} ({kind.replace('_', ' ')} optimum)"))
    click.echo(row("B", with_unit(float(wall.virtual_damping), "N s/m")))
    click.echo(row("frequency", with_unit(float(wall.frequency), "Hz")))
    for line in [*(slope.line() for slope in slopes), *(row("note", n) for n in scene_words.scene_notes(scene))]:
        click.echo(line)


@cli.command()
def schema() -> None:
    """Print the JSON Schema of configuration files, for editors."""
    from zwidth.studies.document import config_json_schema

    click.echo(json.dumps(config_json_schema(), indent=2))


for command in (init, *runs.COMMANDS, report, design, devices, explore, fit, bench):
    cli.add_command(command)
