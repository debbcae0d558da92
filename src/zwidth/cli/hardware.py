"""Options of encoder, friction and motor, with which a wall is simulated as well."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from zwidth.cli.options import Command, quantity_type, warn_implausible
from zwidth.words.quantities import NOT_NEGATIVE, POSITIVE

if TYPE_CHECKING:
    from zwidth.scenes.scene import Scene


def hardware_options(command: Command) -> Command:
    """Add the options of encoder, friction and motor."""
    friction = click.option("--friction", type=quantity_type("N", NOT_NEGATIVE), help="Coulomb friction, in N.")
    resolution = click.option(
        "--resolution",
        type=quantity_type("m", POSITIVE, counts=True),
        help="One step of the position sensor, in m; or '2000 counts'.",
    )
    force = click.option("--max-force", type=quantity_type("N", POSITIVE), help="Largest force of the motor, in N.")
    return friction(resolution(force(command)))


def diagnose_wall(scene: Scene, hardware: dict[str, float | None]) -> Any:
    """Return the `zwidth.diagnose` of a wall with the hardware that options give; None without any."""
    given: dict[str, Any] = {name: value for name, value in hardware.items() if value is not None}
    if not given:
        return None
    from zwidth.scenes.diagnosis import diagnose

    warn_implausible({name: value for name, value in given.items() if name == "resolution"})
    if "friction" in given:
        given["coulomb"] = given.pop("friction")
    return diagnose(scene, **given)
