"""Command-line options of encoder, friction and motor ("hardware"), with which commands also simulate a wall.

The values come from the options or from the scene file of the command (`options.get_hardware`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any

import click

from zwidth.cli.options import Command, get_hardware, quantity_type, warn_implausible
from zwidth.model.measured_device import MeasuredDevice
from zwidth.units.quantities import NOT_NEGATIVE, POSITIVE

if TYPE_CHECKING:
    from zwidth.analysis.scene import Scene

# Parameters of the hardware: option, name of the parameter, SI unit, allowed range, and help text.
_HARDWARE = (
    (
        "--resolution",
        "resolution",
        "m",
        POSITIVE,
        "Encoder step, in m (rotary: rad), or '2000 counts' per revolution.",
    ),
    ("--friction", "coulomb", "N", NOT_NEGATIVE, "Coulomb friction of the device, in N (rotary: N m)."),
    ("--static-friction", "static", "N", NOT_NEGATIVE, "Static friction, in N (rotary: N m). Default: --friction."),
    ("--max-force", "max_force", "N", POSITIVE, "Largest force of the motor, in N (rotary: torque in N m)."),
    (
        "--max-rate",
        "max_rate",
        "N/s",
        POSITIVE,
        "Largest rate of change of the commanded force, in N/s (rotary: N m/s).",
    ),
)


def add_option(command: Command, chosen: str) -> Command:
    """Return a command with the option of one hardware parameter added, for example "max_force"."""
    flag, name, unit, allowed, text = next(each for each in _HARDWARE if each[1] == chosen)
    kind = quantity_type(unit, allowed, counts=name == "resolution")
    return click.option(flag, name, type=kind, help=text)(command)


def hardware_options(command: Command) -> Command:
    """Add the options of encoder, friction and motor; the command receives a dict ``hardware``.

    The scene file supplies parameters not given as options.
    """

    @wraps(command)
    def with_hardware(**given: Any) -> Any:
        hardware = {name: value for _, name, *_ in _HARDWARE if (value := given.pop(name)) is not None}
        if "resolution" in hardware:
            warn_implausible({"resolution": hardware["resolution"]}, given["scene"].unit_system)
        # Ignore the hardware of the file for a measured response, because without a model it cannot be simulated.
        from_file = {} if isinstance(given["scene"].device, MeasuredDevice) else get_hardware()
        return command(hardware=from_file | hardware, **given)

    decorated: Callable[..., Any] = with_hardware
    for each in reversed(_HARDWARE):
        decorated = add_option(decorated, each[1])
    return decorated


def spell_hardware_of_file(scene: Scene) -> str:
    """Return a phrase with encoder, friction and motor from the scene file of the command; "" if it has none."""
    from zwidth.analysis.trials import spell_hardware

    given = click.get_current_context().params
    values = {name: value for name, value in get_hardware().items() if given[name] is None}
    if not values or isinstance(scene.device, MeasuredDevice):
        return ""
    return f"{spell_hardware(values, scene.unit_system)} (from {given['scene_file'].name})"


def diagnose_wall(scene: Scene, hardware: dict[str, Any], *, remedies: bool) -> Any:
    """Simulate and diagnose a scene's wall on the given hardware (`zwidth.diagnose`); return None without hardware.

    ``remedies=False`` omits the search for remedies, which takes most of the run time.
    """
    if not hardware:
        return None
    from zwidth.analysis.diagnosis import diagnose

    return diagnose(scene, **hardware, remedies=remedies)
