"""What a wanted stiffness needs of a rigid device: the root that SciPy finds of K_max in closed form."""

from __future__ import annotations

import math

from scipy.optimize import root_scalar

import zwidth


def find_required(name: str, stiffness: float, low: float, high: float, **known: float) -> float:
    """The value of one quantity in SI units between two at which K_max is the wanted one."""

    def surplus(value: float) -> float:
        return math.log(float(zwidth.max_stiffness(**known, **{name: value})) / stiffness)

    return root_scalar(surplus, bracket=(low, high), method="brentq", xtol=1e-300, rtol=1e-14).root
