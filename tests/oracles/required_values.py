"""Parameter values of a rigid device required for a stiffness, by SciPy's root finding on the closed form of K_max."""

from __future__ import annotations

import math

from scipy.optimize import root_scalar

import zwidth


def find_required(name: str, stiffness: float, low: float, high: float, **fixed: float) -> float:
    """Return the value of one parameter in SI units, between two bounds, at which K_max equals ``stiffness``."""

    def surplus(value: float) -> float:
        return math.log(float(zwidth.max_stiffness(**fixed, **{name: value})) / stiffness)

    return root_scalar(surplus, bracket=(low, high), method="brentq", xtol=1e-300, rtol=1e-14).root
