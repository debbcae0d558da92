"""What a little more of every parameter of a scene buys: the derivatives of its stiffest wall."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.batching import elementwise
from zwidth.linear.stiffest import allows_negative, refuse_fractional_power
from zwidth.stability.devices import classify_delays
from zwidth.stability.ridge import slopes_kernel
from zwidth.xp import is_jax


class SceneSensitivities(NamedTuple):
    """K_max in N/m, its derivatives by dotted path in N/m per unit of the parameter, and the `zwidth.Status`."""

    stiffness: Array
    per: dict[str, float]
    status: Array


def differentiate(scene: Any, negative_damping: bool | None = None) -> SceneSensitivities:
    """See `zwidth.Scene.sensitivities`."""
    negative = allows_negative(scene, negative_damping)
    scene = scene.replace(**{path: float(value) for path, value in scene.parameters().items() if is_jax(value)})
    if scene.is_rigid:
        closed = _by_closed_form(scene, negative)
        if closed is not None:
            return closed
    refuse_fractional_power(scene)
    from zwidth.linear.ridge_kkt import moving_paths, slopes_at

    return SceneSensitivities(*slopes_at(scene, moving_paths(scene), negative))


def _by_closed_form(scene: Any, negative: bool) -> SceneSensitivities | None:
    """Those of a rigid device; None where its ridge lies at a damping that does not count."""
    device, model = scene.normalized, scene.timing.delay_model
    values = device.delta, device.d
    point, by_delta, by_d = elementwise(slopes_kernel, ("delta", "d"), values, (model, classify_delays(device.d)))
    if not negative and point.beta < 0:
        return None
    mass, rate = scene.mass, 1.0 / scene.timing.period
    alpha, change = point.alpha, device.delta * by_delta
    delayed = device.d * by_d if device.d > 0 else 0.0
    per = {
        "mass": (alpha - change) * rate * rate,
        "damping": by_delta * rate,
        "period": (change - delayed - 2.0 * alpha) * mass * rate**3,
        "delay": by_d * mass * rate**3,
    }
    if scene.operator is not None:
        per |= {"operator.mass": per["mass"], "operator.damping": per["damping"]}
        per["operator.stiffness"] = _by_spring(scene, negative)
    stiffness = np.float64(alpha * mass * rate * rate)
    return SceneSensitivities(stiffness, {path: float(slope) for path, slope in per.items()}, point.status)


def _by_spring(scene: Any, negative: bool) -> float:
    """The derivative in a spring to ground that is not there yet."""
    if scene.timing.delay_model != "held":
        return math.nan
    from zwidth.linear.ridge_kkt import slopes_at

    return slopes_at(scene, ("operator.stiffness",), negative)[1]["operator.stiffness"]
