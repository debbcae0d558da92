"""Derivatives of K_max, the maximum stable stiffness, with respect to the dampings of the joints of an arm.

D is the damping of one joint, M the entry of this joint on the diagonal of the mass matrix, T the sampling period. The
implicit derivatives of `zwidth.stability.linear.derivatives` treat the coefficients of a device with joints
(`zwidth.model.joint_space.JointDevice`) as constants. Therefore this module computes K_max at several values of D, and
returns finite differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from zwidth.core.status import Status
from zwidth.model.joint_space import JointDevice
from zwidth.stability.linear.derivatives import CENTRAL_DIFFERENCE, SceneSensitivities

# Largest step of D, relative to D and relative to M/T. A joint with the damping M/T stops within about one period.
RELATIVE_STEP, SCALED_STEP = 1e-2, 1e-3
SMALLEST_STEP = 1e-6  # step, relative to M/T, below which differences of K_max are mostly rounding errors
# Pairs of offset (in steps) and weight of a forward difference of third order, used if D is about zero
FORWARD_DIFFERENCE = [(0, -11 / 6), (1, 3.0), (2, -3 / 2), (3, 1 / 3)]


def add_joint_dampings(scene: Any, result: SceneSensitivities, measure: Callable[[Any], float]) -> SceneSensitivities:
    """Add the derivatives of K_max with respect to the joint dampings to the sensitivities of a scene.

    Args:
        scene: the scene; the result is unchanged unless its device is a `JointDevice`.
        result: the derivatives with respect to all other parameters.
        measure: function that returns K_max of a scene in N/m.
    """
    if not isinstance(scene.device, JointDevice):
        return result
    masses = np.diag(scene.device.spell_form()["mass_matrix"])
    slopes = {}
    for mass, (path, damping) in zip(masses, scene.device.joint_dampings.items(), strict=True):
        unit = float(mass) / float(scene.timing.period)
        step, weights = min(RELATIVE_STEP * damping, SCALED_STEP * unit), CENTRAL_DIFFERENCE
        if step < SMALLEST_STEP * unit:
            step, weights = 1e-1 * SCALED_STEP * unit, FORWARD_DIFFERENCE
        values = (weight * measure(scene.replace(**{path: damping + offset * step})) for offset, weight in weights)
        slopes[path] = float(sum(values)) / step if math.isfinite(float(result.stiffness)) else math.nan
    status = result.status
    if status == Status.OK and any(map(math.isnan, slopes.values())):
        status = np.int32(Status.NOT_CONVERGED)
    return result._replace(per={**result.per, **slopes}, status=status)
