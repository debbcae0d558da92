"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from zwidth.quantities import PARAMETERS


class QuantityType(click.ParamType):
    """A parameter of the loop: a number in its SI unit, or a number with a unit, as in configuration files."""

    def __init__(self, name: str) -> None:
        self.parameter = PARAMETERS[name]
        self.name = "quantity"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Parse one option."""
        from zwidth.errors import UnusableValueError
        from zwidth.units import find_dimension, read_quantity

        try:
            number: float | str = float(value)
        except ValueError:
            number = value
        try:
            return read_quantity(number, find_dimension(self.parameter.unit), self.parameter.allowed)[0]
        except UnusableValueError as error:
            self.fail(str(error), param, ctx)


def physical_options(*, wall: bool, required: bool) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """The options that describe a device, its timing and, where one is judged, its wall."""
    names = (*(("stiffness", "virtual_damping") if wall else ()), "mass", "damping", "period", "delay")

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        for name in reversed(names):
            parameter = PARAMETERS[name]
            given: dict[str, Any] = {"type": QuantityType(name), "help": f"{parameter.symbol}, in {parameter.unit}."}
            # Without damping and delay a device is still one.
            if name in ("damping", "delay", "virtual_damping"):
                given |= {"default": 0.0, "show_default": True}
            else:
                given |= {"required": required or name == "stiffness"}
            function = click.option(f"--{name.replace('_', '-')}", **given)(function)
        return function

    return decorate


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
