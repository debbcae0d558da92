"""What a little more of every parameter of a scene buys: the derivatives of its stiffest wall."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.batching import elementwise
from zwidth.errors import InputError
from zwidth.linear.ridge import BoundRidge, Condition
from zwidth.linear.stiffest import allows_negative, refuse_fractional_power, search
from zwidth.linear_loop import Jet, circle
from zwidth.stability.devices import classify_delays
from zwidth.stability.ridge import slopes_kernel
from zwidth.xp import is_jax

# The step of a difference, as a share of the parameter; its sixth power is rounding.
_STEP = 4e-3
# Weights of the differences: around a value, and from it on.
_CENTRAL = [(-3, -1 / 60), (-2, 3 / 20), (-1, -3 / 4), (1, 3 / 4), (2, -3 / 20), (3, 1 / 60)]
_ONE_SIDED = [-49 / 20, 6.0, -15 / 2, 20 / 3, -15 / 4, 6 / 5, -1 / 6]
# Nearer to whole periods than this a delay counts as beside them.
_SMALL = 1e-3


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
    paths = moving_paths(scene)
    found, status = search(scene, negative)
    if found is None:
        return SceneSensitivities(np.float64(math.nan), dict.fromkeys(paths, math.nan), np.int32(status))
    per = {path: _slope(scene, found, path) for path in paths}
    return SceneSensitivities(np.float64(found.alpha * scene.units.stiffness), per, np.int32(status))


def moving_paths(scene: Any) -> tuple[str, ...]:
    """The parameters of a scene, without the wall's, that K_max can be differentiated in."""
    paths = [path for path, value in scene.parameters().items() if not isinstance(value, int | np.integer)]
    without = {"stiffness", "virtual_damping"}
    if scene.operator is not None and scene.operator.rigid:
        without.add("operator.coupling_damping")
    return tuple(path for path in paths if path not in without)


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
    found = search(scene, negative)[0] if scene.timing.delay_model == "held" else None
    return math.nan if found is None else _slope(scene, found, "operator.stiffness")


def _slope(scene: Any, found: BoundRidge, path: str) -> float:
    """The derivative of K_max in one parameter: as it moves, the conditions that bind go on to hold.

    How they move at a fixed wall and fixed angles is told by differences of sixth order of smooth closed forms; how the
    wall follows, by their exact derivatives (docs/theory/scenes.md).
    """
    matrix, rows = _conditions(scene, found)
    for weights in _stencils(scene, path):
        try:
            states = [weight * _state(scene.replace(**{path: value}), found) for value, weight in weights]
        except InputError:
            # The parameter is at the end of its range: from the other side.
            continue
        moved = np.sum(states, axis=0)
        by_alpha = -np.linalg.solve(matrix, moved[1:][rows])[0]
        unit = scene.units.stiffness
        return float(unit * by_alpha + found.alpha * moved[0])
    return math.nan


def _state(scene: Any, found: BoundRidge) -> np.ndarray:
    """The stiffness of alpha = 1, and what the conditions say of the wall found before; 0 on its own scene."""
    rest, slope, _ = _residual(scene, found)
    return np.array([scene.units.stiffness, rest[0].real, rest[0].imag, rest[1].real, rest[1].imag, slope[0].imag])


def _residual(scene: Any, found: BoundRidge) -> tuple[np.ndarray, np.ndarray, Jet]:
    """``r = alpha + beta F - q`` at both angles, dr/dw, and F."""
    at = circle(np.array([found.w1, found.w2]))
    with np.errstate(all="ignore"):
        q, f = scene.loop.needed(at), scene.loop.estimate.jet(at)
        return found.alpha + found.beta * f.value - q.value, found.beta * f.slope - q.slope, f


def _conditions(scene: Any, found: BoundRidge) -> tuple[np.ndarray, list[int]]:
    """The derivatives of the binding conditions in alpha and what moves with it; their rows of `_state`.

    At a smooth optimum the angle may stay where it is: to first order it does not matter.
    """
    _, slope, f = _residual(scene, found)
    by_alpha = np.array([1.0, 0.0, 1.0, 0.0, 0.0])
    by_beta = np.array([f.value[0].real, f.value[0].imag, f.value[1].real, f.value[1].imag, f.slope[0].imag])
    columns = [by_alpha]
    pair = (found.first == Condition.PAIR, found.second == Condition.PAIR)
    rows = [0, 1] if pair[0] else [0]
    if found.second != Condition.NO_DAMPING:
        columns.append(by_beta)
    if found.second <= Condition.PLUS_ONE:
        rows += [2, 3] if pair[1] else [2]
    elif found.second == Condition.STATIONARY and not pair[0]:
        rows.append(4)
    for k in range(2):
        if pair[k] and found.second != Condition.STATIONARY:
            column = np.zeros(5)
            column[2 * k : 2 * k + 2] = slope[k].real, slope[k].imag
            columns.append(column)
    return np.stack(columns, -1)[rows], rows


def _stencils(scene: Any, path: str) -> Iterator[list[tuple[float, float]]]:
    """Values of a parameter with their weights in its derivative, of sixth order: around it, above it, below it.

    A delay of whole periods is a place where higher derivatives jump, and nobody has less than no damping.
    """
    value = float(scene.parameters()[path])
    period, d = float(scene.timing.period), float(scene.d)
    units = {"mass": scene.mass, "damping": scene.mass / period, "stiffness": scene.mass / period**2, "delay": period}
    size = abs(value) or float(next(unit for name, unit in units.items() if path.endswith(name)))
    step = _STEP * size
    smooth = True
    if path in ("period", "delay"):
        # By how many periods the delay moves.
        far = 3.0 * _STEP * max(d, 1.0) if path == "period" else 3.0 * step / period
        nearest = abs(d - round(d))
        smooth = d != round(d) and nearest > _SMALL
        step *= min(1.0, (0.5 * nearest if smooth else 0.5) / far)
    around = [(value + k * step, weight / step) for k, weight in _CENTRAL]
    beside = [[(value + side * k * step, side * w / step) for k, w in enumerate(_ONE_SIDED)] for side in (1, -1)]
    yield from ([around] if smooth and value > 3.0 * step else [])
    yield from beside
