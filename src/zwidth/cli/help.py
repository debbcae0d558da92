"""Help of commands: options in groups, and an example at the end."""

from __future__ import annotations

from typing import Any

import click

OF_SCENE = "--mass '100 g' --damping '10 N s/m' --rate '1 kHz' --delay '1 ms'"

OWN = "This command"
# Groups of options by the beginnings of their names; all others are the command's own.
GROUPS = {
    "Wall": ("--stiffness", "--virtual-damping"),
    "Device": ("--device", "--mass", "--damping"),
    "Timing": ("--period", "--rate", "--delay"),
    OWN: (),
    "Velocity estimate": ("--velocity-",),
    "Encoder, friction and motor": ("--resolution", "--friction", "--static-friction", "--max-force", "--max-rate"),
    "Hand": ("--operator-",),
    "Further parts of the device": ("--coupling-", "--actuator-", "--modes-"),
    "Output": ("--figure", "--code", "--verbose", "--json", "--help"),
}
EXACT = ("--stiffness", "--delay")  # other options begin with these as well


class GroupedCommand(click.Command):
    """A command whose help lists its options in groups."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, a section for each group."""
        rows: dict[str, list[tuple[str, str]]] = {name: [] for name in GROUPS}
        for option in self.get_params(ctx):
            if isinstance(option, click.Option) and (record := option.get_help_record(ctx)) is not None:
                rows[_find_group(option.opts[-1])].append(record)
        for name, records in rows.items():
            if records:
                with formatter.section(name):
                    formatter.write_dl(records)


def _find_group(flag: str) -> str:
    """Return the group of an option."""
    for name, beginnings in GROUPS.items():
        if any(flag == each or (each not in EXACT and flag.startswith(each)) for each in beginnings):
            return name
    return OWN


def show_example(command: str, *more: str) -> dict[str, Any]:
    """Return the arguments of a command's declaration that group its options and end its help with an example."""
    example = "\b\nExample:\n" + " \\\n    ".join((f"  zwidth {command}", *more))
    return {"cls": GroupedCommand, "epilog": example}
