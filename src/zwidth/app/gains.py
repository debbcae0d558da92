"""Write the gains of motor controllers as text, with the units of the controller.

A controller is of the kind "pid" (gains kp, ki, kd) or "cascade" (pos_gain, vel_gain, vel_integrator_gain), which is a
position loop with an inner velocity loop (`zwidth.model.controller_gains`). The unit of a gain consists of the unit of
the output, such as N m, and of the position unit, such as turns.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from zwidth.app.printing import format_line
from zwidth.core.status import Status
from zwidth.model.controller_gains import ControllerKind, PositionUnit
from zwidth.model.feedback import IntegralFeedback
from zwidth.units.formatting import plain

if TYPE_CHECKING:
    from zwidth.analysis.recommendation import Recommendation
    from zwidth.analysis.scene import Scene

_SINGULAR = {"turns": "turn", "degrees": "deg", "rad": "rad", "m": "m"}


def list_units(kind: ControllerKind, units: PositionUnit, output: str) -> dict[str, str]:
    """Return a dict with the unit of each gain of a controller, such as ``{"pos_gain": "1/s"}``.

    Args:
        kind: "pid" or "cascade".
        units: position unit of the gains.
        output: unit of the output of the controller, such as "N m".
    """
    position = _SINGULAR[units]
    proportional, derivative = f"{output}/{position}", f"{output}/({position}/s)"
    if kind == "pid":
        return {"kp": proportional, "ki": f"{output}/({position} s)", "kd": derivative}
    return {"pos_gain": "1/s", "vel_gain": derivative, "vel_integrator_gain": proportional}


def spell_gains(kind: ControllerKind, gains: Mapping[str, float], units: PositionUnit, output: str) -> str:
    """Return a phrase with the nonzero gains of a controller and their units; other arguments as in `list_units`."""
    named = list_units(kind, units, output)
    return ", ".join(f"{name} {plain(gain)} {named[name]}" for name, gain in gains.items() if gain)


def spell_output(rotary: bool, output_unit: float) -> str:
    """Return the unit of the output: N m (rotary) or N (linear) if ``output_unit`` is 1, otherwise "output"."""
    return "output" if output_unit != 1.0 else "N m" if rotary else "N"


def list_cascade(recommendation: Recommendation) -> dict[str, Any]:
    """Return the gains of a recommended cascade and their position unit; an empty dict without a cascade or a wall."""
    scene = recommendation.scene
    integrator = isinstance(scene.feedback, IntegralFeedback) and scene.feedback.is_cascade
    if not integrator or recommendation.status != Status.OK:
        return {}
    units = "turns" if scene.unit_system.rotary else "m"
    return {**recommendation.cascade_gains(units)._asdict(), "units": units}


def list_cascade_cautions(scene: Scene) -> list[str]:
    """Return a list with the caution that pos_gain in the integrator of a cascade is not K/B; empty without it."""
    feedback, K, B = scene.feedback, float(scene.wall.stiffness), float(scene.wall.virtual_damping)
    if not (isinstance(feedback, IntegralFeedback) and feedback.is_cascade and B):
        return []
    pos_gain = float(feedback.position) / float(feedback.velocity)
    if abs(pos_gain * B - K) <= 1e-5 * abs(K):
        return []
    return [
        f"the integrator contains pos_gain = {plain(pos_gain)} 1/s, but this wall needs K/B = {plain(K / B)} 1/s; to "
        "assess a cascade with this wall, use zwidth gains with the same options"
    ]


def format_cascade(recommendation: Recommendation) -> list[str]:
    """Return a list with the printed line of the gains of a recommended cascade; an empty list without these gains."""
    named = list_cascade(recommendation)
    if not named:
        return []
    units, output = named.pop("units"), spell_output(recommendation.unit_system.rotary, 1.0)
    return [format_line("gains", spell_gains("cascade", named, units, output))]
