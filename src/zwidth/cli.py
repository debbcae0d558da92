"""The command line: thin shells over the library, which they import only when they run.

Exit code 0: done; 1: the work failed; 2: the input was wrong. Errors go to stderr, one message a fault.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from zwidth import __version__
from zwidth.errors import ZwidthError
from zwidth.quantities import plain, with_unit

if TYPE_CHECKING:
    from zwidth.assess import Assessment
    from zwidth.scene import Scene

_EXIT_FAILED, _EXIT_INPUT = 1, 2


class _Quantity(click.ParamType):
    """A number in the SI base unit, or a number with a unit, as in configuration files."""

    def __init__(self, dimension: str, *, positive: bool = False, negative: bool = False) -> None:
        self.name = dimension.lower()
        self.dimension = dimension
        self.positive = positive
        self.negative = negative

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse one option."""
        from pydantic_core import PydanticCustomError

        from zwidth.sweep import fields, units

        allowed = fields.ANY if self.negative else (fields.POSITIVE if self.positive else fields.NOT_NEGATIVE)
        try:
            number: float | str = float(value)
        except ValueError:
            number = value
        try:
            return units.quantity(getattr(units, self.dimension), allowed)(number)
        except PydanticCustomError as error:
            # The parts that a message leaves out stand as empty text between separators.
            self.fail("; ".join(part for part in error.message().split("; ") if part), param, ctx)


def _physical_options(*, wall: bool, required: bool):
    """The options that describe a device, its timing and, where one is judged, its wall."""
    options = [
        click.option("--mass", type=_Quantity("MASS", positive=True), required=required, help="m, in kg."),
        click.option("--damping", type=_Quantity("DAMPING"), default=0.0, show_default=True, help="b, in N s/m."),
        click.option("--period", type=_Quantity("TIME", positive=True), required=required, help="T, in s."),
        click.option("--delay", type=_Quantity("TIME"), default=0.0, show_default=True, help="t_d, in s."),
    ]
    if wall:
        options[:0] = [
            click.option("--stiffness", type=_Quantity("STIFFNESS", negative=True), required=True, help="K, in N/m."),
            click.option(
                "--virtual-damping",
                type=_Quantity("DAMPING", negative=True),
                default=0.0,
                show_default=True,
                help="B, in N s/m.",
            ),
        ]

    def decorate(function):
        for option in reversed(options):
            function = option(function)
        return function

    return decorate


_json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="zwidth")
def cli() -> None:
    """Stability of haptic virtual walls: what stiffness and damping a sampled, delayed device can render.

    A quantity is a number in SI base units (10e3) or a number with a unit ("10 kN/m").
    """


@cli.command()
@_physical_options(wall=True, required=True)
@_json_option
def check(
    stiffness: float,
    virtual_damping: float,
    mass: float,
    damping: float,
    period: float,
    delay: float,
    as_json: bool,
) -> None:
    """Judge one wall: stable or not, how far from the boundary, passive or not, what would be possible."""
    from zwidth.assess import assess
    from zwidth.scene import Device, Scene, Timing, VirtualWall

    scene = Scene(Device(mass, damping), Timing(period, delay), VirtualWall(stiffness, virtual_damping))
    verdict = assess(scene)
    if as_json:
        click.echo(json.dumps(verdict.as_dict(), indent=2, allow_nan=False))
        return
    for line in _verdict_lines(scene, verdict):
        click.echo(line)


def _row(label: str, text: str) -> str:
    return f"{label:<22}{text}"


def _verdict_lines(scene: Scene, verdict: Assessment) -> list[str]:
    wall, device, timing = scene.wall, scene.device, scene.timing
    stable = (
        click.style("stable", fg="green", bold=True) if verdict.stable else click.style("UNSTABLE", fg="red", bold=True)
    )
    lines = [
        _row("device", f"m = {with_unit(device.mass * 1e3, 'g')}, b = {with_unit(device.damping, 'N s/m')}"),
        _row(
            "timing",
            f"T = {with_unit(timing.period, 's')}, delay {with_unit(timing.delay, 's')} (d = {plain(verdict.d)})",
        ),
        _row("wall", f"K = {with_unit(wall.stiffness, 'N/m')}, B = {with_unit(wall.virtual_damping, 'N s/m')}"),
        _row(
            "normalized",
            f"alpha = {plain(verdict.alpha)}, beta = {plain(verdict.beta)}, delta = {plain(verdict.delta)}",
        ),
        "",
        _row("verdict", f"{stable}, spectral radius {verdict.spectral_radius:.6f}"),
        *_distance_lines(wall.stiffness, wall.virtual_damping, verdict),
        _row("passive", _passivity_words(verdict)),
        _row(
            "stiffest stable wall",
            f"K_max = {with_unit(verdict.stiffness_max, 'N/m')} at B = {with_unit(verdict.virtual_damping_at_max, 'N s/m')}"
            f" (alpha_max = {plain(verdict.alpha_max)}, beta = {plain(verdict.beta_at_max)})",
        ),
        _row("slowest pole", _pole_words(verdict)),
    ]
    return lines


def _distance_lines(stiffness: float, virtual_damping: float, verdict: Assessment) -> list[str]:
    limit, lower, upper = verdict.stiffness_limit, verdict.virtual_damping_lower, verdict.virtual_damping_upper
    if limit != limit:
        in_k = "no stiffness is stable at this B"
    elif verdict.stable:
        in_k = f"K may rise by {with_unit(limit - stiffness, 'N/m')}, to {with_unit(limit, 'N/m')} (at this B)"
    elif stiffness <= 0:
        in_k = f"K must be greater than 0, up to {with_unit(limit, 'N/m')} (at this B)"
    else:
        in_k = f"K must fall by {with_unit(stiffness - limit, 'N/m')}, below {with_unit(limit, 'N/m')} (at this B)"
    if lower != lower or upper != upper:
        in_b = "no damping makes this K stable"
    else:
        span = f"between {with_unit(lower, 'N s/m')} and {with_unit(upper, 'N s/m')} (at this K)"
        if verdict.stable:
            in_b = (
                f"B may fall by {with_unit(virtual_damping - lower, 'N s/m')} or rise by "
                f"{with_unit(upper - virtual_damping, 'N s/m')}: {span}"
            )
        else:
            in_b = f"B must lie {span}"
    return [_row("to the boundary in K", in_k), _row("to the boundary in B", in_b)]


def _passivity_words(verdict: Assessment) -> str:
    if verdict.passive:
        return f"yes, with {with_unit(verdict.passivity_margin, 'N s/m')} of physical damping to spare"
    return f"no, for want of {with_unit(-verdict.passivity_margin, 'N s/m')} of physical damping"


def _pole_words(verdict: Assessment) -> str:
    swing = f", oscillating at {with_unit(verdict.frequency, 'Hz')}" if verdict.frequency else ""
    constant = verdict.time_constant
    if constant == float("inf"):
        return f"neither decays nor grows{swing}"
    verb = "decays" if constant >= 0 else "grows"
    return f"{verb} with time constant {with_unit(abs(constant), 's')}{swing}"


@cli.command()
@click.option("--delta", type=float, help="Normalized physical damping b T/m.")
@click.option("--d", type=float, help="Delay in periods.")
@_physical_options(wall=False, required=False)
@click.option(
    "--delay-model",
    type=click.Choice(["held", "fractional_power"]),
    default="held",
    show_default=True,
    help="How a delay that is not whole is modelled.",
)
@_json_option
def ridge(
    delta: float | None,
    d: float | None,
    mass: float | None,
    damping: float,
    period: float | None,
    delay: float,
    delay_model: str,
    as_json: bool,
) -> None:
    """Print the stiffest stable wall of a device, given by --delta and --d or by its physical data."""
    import numpy as np

    from zwidth.scene import Device, Scene, Timing
    from zwidth.stability.ridge import RidgeKind, alpha_max
    from zwidth.status import Status

    physical = mass is not None and period is not None
    if physical == (delta is not None) or (delta is None) != (d is None):
        raise click.UsageError("give either --delta and --d, or --mass and --period (with --damping and --delay)")
    scene = Scene(Device(mass, damping), Timing(period, delay)) if mass is not None and period is not None else None
    at_delta, at_d = (scene.delta, scene.d) if scene is not None else (delta, d)
    point = alpha_max(at_delta, at_d, delay=delay_model)  # pyright: ignore[reportArgumentType]  (click checked it)
    if int(point.status) != Status.OK:
        raise click.UsageError(f"--delta {at_delta}, --d {at_d}: {Status(int(point.status)).message}")
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
    if as_json:
        click.echo(json.dumps(result, indent=2, allow_nan=False))
        return
    click.echo(_row("device", f"delta = {plain(result['delta'])}, d = {plain(result['d'])}"))
    click.echo(_row("alpha_max", f"{result['alpha_max']:.12g} ({result['kind']} optimum)"))
    click.echo(_row("beta", f"{result['beta']:.12g}"))
    if scene is not None:
        click.echo(_row("K_max", with_unit(result["stiffness_max"], "N/m")))
        click.echo(_row("B", with_unit(result["virtual_damping"], "N s/m")))


@cli.command()
def schema() -> None:
    """Print the JSON Schema of configuration files, for editors."""
    from zwidth.sweep.document import config_json_schema

    click.echo(json.dumps(config_json_schema(), indent=2))


def _use_compilation_cache() -> None:
    """Let JAX keep compiled kernels in the user's cache folder, unless JAX was told otherwise."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(base / "zwidth" / "jax")
    # Every kernel is worth keeping: the many small ones add up to most of a cold start.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit."""
    _use_compilation_cache()
    try:
        cli.main(args=arguments, prog_name="zwidth", standalone_mode=False)
    except click.exceptions.Abort:
        click.echo("zwidth: stopped", err=True)
        sys.exit(130)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except ZwidthError as error:
        for line in str(error).splitlines():
            click.echo(f"zwidth: {line}", err=True)
        sys.exit(_EXIT_INPUT)
    except BrokenPipeError:
        # The reader of a pipe, `head` say, has gone: nothing is wrong.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except Exception as error:
        if os.environ.get("ZWIDTH_TRACEBACK"):
            raise
        click.echo(f"zwidth: {type(error).__name__}: {error} (set ZWIDTH_TRACEBACK=1 for the traceback)", err=True)
        sys.exit(_EXIT_FAILED)
