"""Help texts of commands: options in groups with headings, and an example at the end."""

from __future__ import annotations

from typing import Any

import click

# Options that specify a complete scene, for the examples in the help of several commands.
OF_SCENE = "--mass '100 g' --damping '10 N s/m' --rate '1 kHz' --delay '1 ms'"

OWN = "This command"  # heading of options that are specific to the command
# Groups of options in the help: the heading of each group, and the prefixes of the options in it.
GROUPS = {
    "Wall": ("--stiffness", "--virtual-damping"),
    "Gains of the controller": (
        *("--pos-gain", "--vel-", "--kp", "--ki", "--kd", "--rule"),
        *("--units", "--output-unit", "--torque-constant", "--resistance"),
    ),
    "Device": ("--device", "--sampled", "--mass", "--damping"),
    "Timing": ("--period", "--rate", "--delay"),
    OWN: (),
    "Velocity estimate": ("--velocity-",),
    "Position estimate and further feedback": ("--position-", "--feedback-"),
    "Encoder, friction and motor": ("--resolution", "--friction", "--static-friction", "--max-force", "--max-rate"),
    "Hand": ("--operator-",),
    "Simulated tool": ("--tool-",),
    "Further parts of the device": ("--coupling-", "--actuator-", "--modes-"),
    "Output": ("--figure", "--code", "--verbose", "--json", "--help"),
}
EXACT = ("--stiffness", "--delay")  # matched as whole names; other groups have options with these prefixes


class GroupedCommand(click.Command):
    """Command whose help lists its options in groups."""

    def __init__(self, *args: Any, own: tuple[str, ...] = (), **settings: Any) -> None:
        """Create the command; its help lists the options in ``own`` under "This command", not in their usual group."""
        super().__init__(*args, **settings)
        self.own = own

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options to the help text, in one section per group."""
        rows: dict[str, list[tuple[str, str]]] = {name: [] for name in GROUPS}
        for option in self.get_params(ctx):
            if isinstance(option, click.Option) and (record := option.get_help_record(ctx)) is not None:
                rows[find_group(option.opts[-1], self.own)].append(record)
        for name, records in rows.items():
            if records:
                with formatter.section(name):
                    formatter.write_dl(records)


def find_group(flag: str, own: tuple[str, ...] = ()) -> str:
    """Return the heading under which the help lists an option: "This command" for the options in ``own``."""
    if flag in own:
        return OWN
    for name, prefixes in GROUPS.items():
        if any(flag == each or (each not in EXACT and flag.startswith(each)) for each in prefixes):
            return name
    return OWN


def show_example(command: str, *more: str) -> dict[str, Any]:
    """Return the keyword arguments with which ``cli.command`` creates a command with grouped options and an example."""
    example = "\b\nExample:\n" + " \\\n    ".join((f"  zwidth {command}", *more))
    return {"cls": GroupedCommand, "epilog": example}
