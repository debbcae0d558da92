"""Reference grasps: models of a hand on the device, used to check the stability of recommended walls."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import product

from zwidth.model.checks import check_number
from zwidth.model.operator import Operator
from zwidth.units.quantities import POSITIVE

HAND = Operator(**Operator.usual["rigid"])  # measured hand; its rigid grasp is replaced by a spring and a damper
SPRINGS = {"soft": 1e3, "firm": 10e3}  # coupling stiffness between hand and device, in N/m
DAMPERS = {"light": 1.0, "medium": 5.0, "strong": 20.0}  # coupling damping between hand and device, in N s/m
# Distances of the hand from the axis of a rotary device, in m. They are closely spaced, because a grasp with light
# damping may destabilize a wall in a narrow range of distances only.
RADII = (0.01, 0.0125, 0.016, 0.02, 0.025, 0.032, 0.04, 0.05, 0.063, 0.08, 0.1)


def reference_grasps(radius: float | str | None = None) -> dict[str, Operator]:
    """Return the grasps that are used to check the stability of recommended walls.

    The hand is a mass of 0.554 kg with a damper of 6.45 N s/m and a spring of 135 N/m to ground (measured in one
    trial). It is coupled to the device by a spring of 1 kN/m (soft) or 10 kN/m (firm) and a damper of 1, 5 or 20 N s/m
    (light, medium or strong damping). The coupling parameters are assumptions, as in the example configuration
    ``operator``.

    Args:
        radius: distance of the hand from the axis of a rotary device, in m, > 0; None for a linear device. Mass,
            damping and stiffness of the grasp are multiplied by the squared radius.

    Returns:
        A dictionary of six `zwidth.Operator`; the keys are names such as "soft, light damping".

    References:
        Sci. Rep. 5:18004 (2015), Fig. 3 (the hand).

    Example:
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device("100 g", damping=1), zwidth.Timing(rate="1 kHz", delay="1 periods"))
        >>> [name for name, grasp in zwidth.reference_grasps().items()
        ...  if not scene.replace(operator=grasp).is_stable("11.22 kN/m", 42.37)]
        ['firm, light damping']
    """
    scale = 1.0 if radius is None else check_number("radius", radius, "m", POSITIVE) ** 2
    grasps = {}
    for spring, damper in product(SPRINGS, DAMPERS):
        grasp = replace(HAND, coupling_stiffness=SPRINGS[spring], coupling_damping=DAMPERS[damper])
        scaled = {item.name: getattr(grasp, item.name) * scale for item in fields(grasp)}
        grasps[f"{spring}, {damper} damping"] = Operator(**scaled)
    return grasps


def list_grasps(rotary: bool) -> list[tuple[str, Operator]]:
    """Return pairs of name and grasp: six for a linear device; for a rotary device, six per radius in ``RADII``."""
    radii = RADII if rotary else (None,)
    return [pair for radius in radii for pair in reference_grasps(radius).items()]
