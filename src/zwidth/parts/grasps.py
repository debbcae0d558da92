"""Reference grasps: hands that hold a device, with which a recommended wall is checked.

The hand is that of `configs/operator.yaml`: 0.554 kg, 6.45 N s/m and 135 N/m, measured in one trial (Sci. Rep. 5:18004,
2015, Fig. 3). The grasp between hand and device is a spring of 1 kN/m (soft) or 10 kN/m (firm), with a damper of 1, 5
or 20 N s/m: the values of that configuration, which are assumed, not measured.
"""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import product

from zwidth.parts.operator import Operator

HAND = Operator(**Operator.usual["rigid"])
SPRINGS = {"soft": 1e3, "firm": 10e3}  # N/m
DAMPERS = {"light": 1.0, "medium": 5.0, "strong": 20.0}  # N s/m
RADIUS = 0.05  # m, from the axis of a rotary device to the hand

REFERENCE_GRASPS: dict[str, Operator] = {
    f"{spring}, {damper} damping": replace(HAND, coupling_stiffness=SPRINGS[spring], coupling_damping=DAMPERS[damper])
    for spring, damper in product(SPRINGS, DAMPERS)
}


def list_grasps(rotary: bool, radius: float = RADIUS) -> dict[str, Operator]:
    """Return the reference grasps for a linear device, or for a rotary one that is held at a radius in m.

    Mass, damping and stiffness about the axis are those of the hand times the radius squared.
    """
    if not rotary:
        return REFERENCE_GRASPS
    return {
        name: Operator(**{item.name: getattr(grasp, item.name) * radius**2 for item in fields(grasp)})
        for name, grasp in REFERENCE_GRASPS.items()
    }
