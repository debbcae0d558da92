"""`zwidth fit`: a device's mass, damping and delay from buzzing walls or from logs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import click

from zwidth.cli.commands import cli
from zwidth.cli.options import (
    SHARE,
    Parsed,
    figure_option,
    json_option,
    log_options,
    period_options,
    quantity_type,
    read_logs,
    save_figure,
    velocity_options,
)
from zwidth.pages.words import row, tell
from zwidth.words.errors import UnusableValueError
from zwidth.words.quantities import POSITIVE
from zwidth.words.units import tell_kind

# A letter, "=", and all up to the next letter with "=".
_ENTRY = re.compile(r"([KBf])\s*=\s*(.*?)\s*(?=(?:[KBf]\s*=)|$)")


class HeardWall(NamedTuple):
    """A wall at the onset of buzzing, and whether it is of a rotary axis; None where no unit says."""

    point: tuple[float, float, float]
    rotary: bool | None


def _read_wall(text: str) -> HeardWall:
    entries = _ENTRY.findall(text.replace(",", " "))
    found = dict(entries)
    if _ENTRY.sub("", text.replace(",", " ")).strip() or {"K", "f"} - set(found) or len(found) < len(entries):
        raise ValueError(f"got {text!r}; write K, B and f, as 'K=3.2kN/m B=0 f=71Hz'")
    numbers, kinds = {"B": 0.0}, set()
    for letter, amount in found.items():
        try:
            numbers[letter] = quantity_type({"K": "N/m", "B": "N s/m", "f": "Hz"}[letter]).read(amount)
        except UnusableValueError as error:
            raise ValueError(f"{letter}: {error}") from None
        kinds |= {tell_kind(amount)} - {None}
    if len(kinds) > 1:
        raise ValueError(f"got {text!r}; N/m goes with N s/m, N m/rad with N m s/rad")
    return HeardWall((numbers["K"], numbers["B"], numbers["f"]), kinds.pop() if kinds else None)


_WALL = Parsed("WALL", _read_wall)


@cli.command()
@click.argument("logs", metavar="[LOG.csv]...", nargs=-1, type=click.Path(path_type=Path))
@click.option("--buzz", "walls", type=_WALL, multiple=True, help="As 'K=3.2kN/m B=0 f=71Hz'; once for each wall.")
@period_options
@click.option("--noise", type=SHARE, help="Relative noise of K and f of buzzing walls, as 2%.")
@log_options
@click.option("--max-delay", type=quantity_type("s", POSITIVE), help="Longest delay looked for in a log, in s.")
@click.option("--resample", is_flag=True, help="Take samples as even whose clock wavers.")
@velocity_options
@click.option("--unknown-cutoff", is_flag=True, help="Find the velocity's cut-off, too; needs --buzz at B > 0.")
@figure_option
@click.option("--yaml", "as_yaml", is_flag=True, help="Print a configuration for `zwidth run`.")
@json_option
def fit(
    logs: tuple[Path, ...],
    walls: tuple[Any, ...],
    period: float | None,
    noise: float | None,
    unknown_cutoff: bool,
    velocity: Any,
    figure: Path | None,
    as_yaml: bool,
    as_json: bool,
    **of_logs: Any,
) -> None:
    """Find a device's mass, damping and delay.

    With --buzz: from walls at which it began to buzz as K was raised, at two dampings or more, and the frequencies
    heard. With LOG.csv: from its free motion under a force that a computer commanded, friction included; several logs
    are of one device and have the same columns. Units stand in headers, as 'encoder [counts]', or behind a colon.
    """
    from zwidth.fitting.words import LINEAR, ROTARY, describe_fit, write_scene

    if bool(logs) == bool(walls):
        raise click.UsageError("give either --buzz, once for each wall, or a LOG.csv")
    if as_json and as_yaml:
        raise click.UsageError("give one of --json and --yaml")
    units, points = LINEAR, ()
    if walls:
        for name, value in of_logs.items():
            if value:
                raise click.UsageError(f"--{name.replace('_', '-')} belongs to a LOG.csv")
        if period is None:
            raise click.UsageError("give --period or --rate")
        from zwidth.fitting.buzz import BuzzPoint, fit_buzz

        kinds = {wall.rotary for wall in walls} - {None}
        if len(kinds) > 1:
            raise click.UsageError("--buzz: some walls are in N/m, others in N m/rad; fit them apart")
        units = ROTARY if kinds == {True} else LINEAR
        points = tuple(BuzzPoint(*wall.point) for wall in walls)
        found = fit_buzz(points, period=period, velocity=velocity, noise=noise, unknown_cutoff=unknown_cutoff)
        source = f"{len(walls)} buzzing walls"
    else:
        if noise is not None:
            raise click.UsageError("--noise belongs to --buzz; the noise of a log is found from it")
        if unknown_cutoff:
            raise click.UsageError("--unknown-cutoff belongs to --buzz; no velocity is estimated in a log")
        if of_logs["time"] is not None and period is not None:
            raise click.UsageError("give one of --time, --period and --rate")
        from zwidth.fitting.columns import fit_motions

        options = {name: of_logs.pop(name) for name in ("max_delay", "resample")}
        motions = read_logs(logs, period, **of_logs)
        units = ROTARY if motions[0].rotary else LINEAR
        found = fit_motions(motions, period=period, velocity=velocity, **options)
        source = " and ".join(log.name for log in logs)
    wrote = []
    if figure is not None:
        from zwidth.figures import draw_device_fit
        from zwidth.fitting.evidence import gather_evidence

        evidence: dict[str, Any] = gather_evidence(found, source, points, units)
        wrote.append(save_figure(draw_device_fit(**evidence, step=found.resolution), figure))
    if as_yaml:
        click.echo("\n".join(write_scene(found, source, units)))
        return
    lines = () if as_json else describe_fit(found, source, units)
    tell({**found.as_dict(), "units": units._asdict()}, [*(row(*each) for each in lines), *wrote], as_json)
