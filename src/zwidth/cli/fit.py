"""`zwidth fit`: a device's mass, damping and delay from buzzing walls or from a log."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from zwidth.cli.options import QuantityType, json_option, velocity_options
from zwidth.cli.words import row
from zwidth.errors import InputError, UnusableValueError
from zwidth.formatting import plain, suggestion, with_unit
from zwidth.quantities import POSITIVE

if TYPE_CHECKING:
    from zwidth.fitting.device_fit import DeviceFit

_UNITS = {"mass": "kg", "damping": "N s/m", "delay": "s", "stiffness_max": "N/m"}
_SYMBOLS = {"mass": "m", "damping": "b", "delay": "t_d", "stiffness_max": "K_max"}
_WALL = {"K": "N/m", "B": "N s/m", "f": "Hz"}
# A letter, "=", and all up to the next letter with "=".
_ENTRY = re.compile(r"([KBf])\s*=\s*(.*?)\s*(?=(?:[KBf]\s*=)|$)")
_COLUMNS = {"time": "s", "position": "m", "force": "N"}
_KINDS = {
    "BackwardDifference": "backward_difference",
    "WindowedDifference": "windowed_difference",
    "LowPass": "low_pass",
    "Butterworth": "butterworth",
}


class WallType(click.ParamType):
    """A wall at the onset of buzzing: ``K=3.2kN/m B=0 f=71Hz``."""

    name = "WALL"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse one option."""
        from zwidth.units import find_dimension, read_quantity

        if isinstance(value, tuple):
            return value
        found = dict(_ENTRY.findall(value.replace(",", " ")))
        if _ENTRY.sub("", value.replace(",", " ")).strip() or {"K", "f"} - set(found):
            self.fail(f"got {value!r}; write K, B and f, as 'K=3.2kN/m B=0 f=71Hz'", param, ctx)
        numbers = {"B": 0.0}
        for letter, text in found.items():
            try:
                numbers[letter] = read_quantity(_as_number(text), find_dimension(_WALL[letter]))[0]
            except UnusableValueError as error:
                self.fail(f"{letter}: {error}", param, ctx)
        return numbers["K"], numbers["B"], numbers["f"]


class ShareType(click.ParamType):
    """A share: ``2%`` or ``0.02``."""

    name = "SHARE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse one option."""
        text = str(value).strip()
        try:
            return float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
        except ValueError:
            self.fail(f"got {value!r}; write a share, as 2% or 0.02", param, ctx)


def _as_number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


@click.command()
@click.argument("log", metavar="[LOG.csv]", required=False, type=click.Path(path_type=Path))
@click.option("--buzz", "walls", type=WallType(), multiple=True, help="As 'K=3.2kN/m B=0 f=71Hz'; once for each wall.")
@click.option("--period", type=QuantityType("s", POSITIVE), help="T, in s; of a log in place of --time.")
@click.option("--noise", type=ShareType(), help="Relative noise of K and f of buzzing walls, as 2%.")
@click.option("--time", help="Column of the time in a log; COLUMN:ms where it is not in s.")
@click.option("--position", help="Column of the position; COLUMN:mm where it is not in m.")
@click.option("--force", help="Column of the commanded force; COLUMN:mN where it is not in N.")
@click.option("--max-delay", type=QuantityType("s", POSITIVE), help="Longest delay looked for in a log, in s.")
@velocity_options
@click.option("--yaml", "as_yaml", is_flag=True, help="Print a configuration for `zwidth run`.")
@json_option
def fit(
    log: Path | None,
    walls: tuple[Any, ...],
    period: float | None,
    noise: float | None,
    time: str | None,
    position: str | None,
    force: str | None,
    max_delay: float | None,
    velocity: Any,
    as_yaml: bool,
    as_json: bool,
) -> None:
    """Find a device's mass, damping and delay.

    With --buzz: from walls at which it began to buzz as K was raised, at two dampings or more, and the frequencies
    heard. With LOG.csv: from its free motion under a force that a computer commanded.
    """
    if (log is None) == (not walls):
        raise click.UsageError("give either --buzz, once for each wall, or a LOG.csv")
    columns = {"time": time, "position": position, "force": force}
    if log is None:
        for name, value in (*columns.items(), ("max-delay", max_delay)):
            if value is not None:
                raise click.UsageError(f"--{name} belongs to a LOG.csv")
        if period is None:
            raise click.UsageError("give --period")
        from zwidth.fitting.buzz import fit_buzz

        found, source = fit_buzz(walls, period=period, velocity=velocity, noise=noise), f"{len(walls)} buzzing walls"
    else:
        if noise is not None:
            raise click.UsageError("--noise belongs to --buzz; the noise of a log is found from it")
        if position is None or force is None or (time is None) == (period is None):
            raise click.UsageError("give --position, --force, and one of --time and --period")
        from zwidth.fitting.log import fit_log

        read = _read_columns(log, {name: text for name, text in columns.items() if text is not None})
        when = period if time is None else read["time"]
        found = fit_log(when, read["position"], read["force"], velocity=velocity, max_delay=max_delay)
        source = log.name
    if as_json:
        click.echo(json.dumps(found.as_dict(), indent=2, allow_nan=False))
        return
    for line in _configuration(found, source) if as_yaml else _lines(found, source):
        click.echo(line)


def _read_columns(file: Path, columns: dict[str, str]) -> dict[str, list[float]]:
    """Columns of a CSV file by name, in SI units."""
    import csv

    from zwidth.units import FORCE, LENGTH, TIME

    try:
        with open(file, encoding="utf-8-sig", newline="") as stream:
            rows = list(csv.reader(stream))
    except UnicodeDecodeError:
        raise InputError(f"{file}: is no text; give a CSV file") from None
    heads = [name.strip() for name in rows[0]] if rows else []
    read: dict[str, list[float]] = {}
    for name, text in columns.items():
        column, _, unit = (text, "", "") if text in heads else text.rpartition(":")
        if column not in heads:
            hint = suggestion(column, heads, f"it has {', '.join(heads)}" if heads else "it is empty")
            raise InputError(f"--{name}: {file} has no column {column or text!r}; {hint}")
        powers = {"time": TIME, "position": LENGTH, "force": FORCE}[name].units
        unit = unit or _COLUMNS[name]
        if unit not in powers:
            raise InputError(f"--{name}: got the unit {unit!r}; allowed are {', '.join(powers)}")
        at, read[name] = heads.index(column), []
        for number, cells in enumerate(rows[1:], start=2):
            if not cells:
                continue
            try:
                read[name].append(float(cells[at]) * 10.0 ** powers[unit])
            except (ValueError, IndexError):
                got = repr(cells[at]) if at < len(cells) else "nothing"
                raise InputError(f"{file}:{number}: got {got} under {column}; a number is needed") from None
    return read


def _amount(name: str, value: float) -> str:
    return with_unit(value * 1e3, "g") if name == "mass" else with_unit(value, _UNITS[name])


def _between(found: DeviceFit, name: str) -> str:
    bar = found.intervals[name]
    return f"95 % between {_amount(name, bar.low)} and {_amount(name, bar.high)}"


def _lines(found: DeviceFit, source: str) -> list[str]:
    """For people."""
    from zwidth.status import Status

    lines = [row("fitted to", source)]
    for name, symbol in _SYMBOLS.items():
        lines.append(row(symbol, f"{_amount(name, getattr(found, name))} ({_between(found, name)})"))
    if isinstance(found.noise, tuple):
        lines.append(row("noise of K and f", " and ".join(f"{plain(100 * share, 2)} %" for share in found.noise)))
    else:
        lines.append(row("noise of the position", with_unit(found.noise, "m", 3)))
    if found.offset:
        lines.append(row("constant force", with_unit(found.offset, "N", 3)))
    lines += [row("doubt", doubt) for doubt in found.doubts]
    if found.status == Status.NOT_CONVERGED:
        lines.append(row("doubt", Status.NOT_CONVERGED.message))
    if found.next is not None:
        step = found.next
        lines.append(
            row(
                "measure next",
                f"K at B = {with_unit(step.virtual_damping, 'N s/m', 3)}, near {with_unit(step.stiffness, 'N/m', 3)} "
                f"and {with_unit(step.frequency, 'Hz', 3)}: K_max's standard error falls from "
                f"{with_unit(found.stiffness_error, 'N/m', 2)} to {with_unit(step.error_afterwards, 'N/m', 2)}",
            )
        )
    return lines


def _configuration(found: DeviceFit, source: str) -> list[str]:
    """A configuration whose every number says where it is from."""
    name = "fitted_device"
    lines = [f"# Fitted to {source}: {_between(found, 'stiffness_max')} for K_max."]
    lines += [f"# Doubt: {doubt}" for doubt in found.doubts]
    lines += ["version: 1", f"name: {name}", "scene:"]
    values = {key: f"{getattr(found, key)!r} {_UNITS[key]}" for key in ("mass", "damping", "delay")}
    lines += [f"  {key}: {text} # fitted, {_between(found, key)}" for key, text in values.items()]
    lines.append(f"  period: {found.period!r} s # as given")
    kind = _KINDS.get(type(found.velocity).__name__)
    if kind not in (None, "backward_difference"):
        given = {part.name: getattr(found.velocity, part.name) for part in fields(found.velocity)}
        inside = ", ".join(f"{key}: {value}" for key, value in given.items() if value is not None)
        lines.append(f"  velocity: {{kind: {kind}, {inside}}} # as given")
    return [*lines, "studies:", "  - kind: recommend # what to set on this device", "    name: recommended"]
