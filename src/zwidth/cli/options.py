"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click


class Quantity(click.ParamType):
    """A number in the SI base unit, or a number with a unit, as in configuration files."""

    def __init__(self, dimension: str, *, positive: bool = False, negative: bool = False) -> None:
        self.name = dimension.lower()
        self.dimension = dimension
        self.positive = positive
        self.negative = negative

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse one option."""
        from pydantic_core import PydanticCustomError

        from zwidth.config import fields, units

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


def physical_options(*, wall: bool, required: bool) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """The options that describe a device, its timing and, where one is judged, its wall."""
    options = [
        click.option("--mass", type=Quantity("MASS", positive=True), required=required, help="m, in kg."),
        click.option("--damping", type=Quantity("DAMPING"), default=0.0, show_default=True, help="b, in N s/m."),
        click.option("--period", type=Quantity("TIME", positive=True), required=required, help="T, in s."),
        click.option("--delay", type=Quantity("TIME"), default=0.0, show_default=True, help="t_d, in s."),
    ]
    if wall:
        options[:0] = [
            click.option("--stiffness", type=Quantity("STIFFNESS", negative=True), required=True, help="K, in N/m."),
            click.option(
                "--virtual-damping",
                type=Quantity("DAMPING", negative=True),
                default=0.0,
                show_default=True,
                help="B, in N s/m.",
            ),
        ]

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            function = option(function)
        return function

    return decorate


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
