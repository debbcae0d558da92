"""`zwidth devices`: the devices with published numbers, and where each number comes from."""

from __future__ import annotations

import json

import click

from zwidth.cli.commands import cli
from zwidth.cli.options import json_option
from zwidth.cli.words import row
from zwidth.words.formatting import with_unit

_COLUMNS = ("mass", "damping", "friction", "resolution", "period", "force", "stiffness_limit")


@cli.command()
@click.argument("name", required=False)
@json_option
def devices(name: str | None, as_json: bool) -> None:
    """List devices with published numbers; with a NAME, every number of one and its source.

    A dash stands where nothing is published. Rotary devices have an inertia in kg m^2 and a damping in N m s/rad.
    """
    from zwidth.parts.devices import DEVICES, Published, find_device

    chosen = DEVICES if name is None else (find_device(name),)
    if as_json:
        click.echo(json.dumps([device.as_dict() for device in chosen], indent=1, allow_nan=False))
        return
    if name is not None:
        device = chosen[0]
        click.echo(f"{device.title} ({device.motion})")
        for quantity, number in device.numbers.items():
            note = f" ({number.note})" if number.note else ""
            click.echo(row(quantity, f"{_amount(number)}{note}; {number.source}"))
        return

    def cell(number: Published | None) -> str:
        return "-" if number is None else _amount(number)

    lines = [("name", *(column.replace("_", " ") for column in _COLUMNS))]
    lines += [(device.name, *(cell(getattr(device, column)) for column in _COLUMNS)) for device in chosen]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        click.echo("  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip())


def _amount(number: tuple[float, str, str, str]) -> str:
    """A number with its unit; inertias and counts without a prefix."""
    value, unit = number[:2]
    if unit == "counts":
        return f"{value:g} counts"
    # A prefix on "kg m^2" would be a second one.
    return f"{value:g} {unit}" if unit == "kg m^2" else with_unit(value, unit, 3)
