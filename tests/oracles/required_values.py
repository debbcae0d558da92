"""What a wanted stiffness needs of a rigid device: SciPy's root of K_max in closed form, on one side of which it is enough."""

from __future__ import annotations

import math

from scipy.optimize import brentq

import zwidth


def find_required(name: str, stiffness: float, low: float, high: float, **known: float) -> float:
    """The value of one quantity in SI units between two at which K_max is the wanted one."""

    def surplus(value: float) -> float:
        return math.log(float(zwidth.max_stiffness(**known, **{name: value})) / stiffness)

    return float(brentq(surplus, low, high, xtol=1e-300, rtol=1e-14))
