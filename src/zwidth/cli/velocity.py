"""Velocity estimates from the options ``--velocity-...`` of a command."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any

import click

from zwidth.model.system_forms import parse_system
from zwidth.model.velocity import ESTIMATES, VelocityFilter

FILTER_HELP = (
    "Velocity estimate as a transfer function in z from position to velocity: 'NUM / DEN', such as '1000 -1000 / 1 0', "
    "'zpk: ZEROS / POLES / GAIN' or 'sos: b0 b1 b2 a0 a1 a2; ..'."
)


def name_option(path: str) -> str:
    """Return the name of the option for a parameter, ``--velocity-cutoff`` for ``velocity.cutoff``."""
    return "--" + path.replace(".", "-").replace("_", "-")


def list_needed(kind: Any) -> list[str]:
    """Return the names of the fields without default value of the class ``kind`` of a part."""
    return [item.name for item in fields(kind) if item.default is MISSING]


def make_velocity(given: dict[str, Any]) -> Any:
    """Return the velocity estimate built from the parameters ``given``, a dict by field name."""
    kind = given.pop("kind", None)
    if "filter" in given:
        text = given.pop("filter")
        if others := sorted([*given, *(["kind"] if kind else [])]):
            raise click.UsageError(f"--velocity-filter: got {name_option(f'velocity.{others[0]}')} too; give only one")
        return VelocityFilter(**parse_system("velocity.filter", text, "z"))
    if kind is None:
        low = {"cutoff", "time_constant"} & set(given)
        kind = "windowed_difference" if "samples" in given else "low_pass" if low else "backward_difference"
    part = ESTIMATES[kind]
    needed = ["cutoff"] if kind == "low_pass" and "time_constant" not in given else list_needed(part)
    for name in needed:
        if name not in given:
            raise click.UsageError(f"a velocity estimate of kind {kind} requires {name_option(f'velocity.{name}')}")
    for name in sorted(set(given) - set(part.__dataclass_fields__)):
        raise click.UsageError(
            f"{name_option(f'velocity.{name}')} does not belong to a velocity estimate of kind {kind}"
        )
    return part(**given)
