"""What a little more of every parameter of a scene buys: the derivatives of its stiffest wall."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.circle import CirclePoints, circle, lag_jet
from zwidth.arrays.evaluate import evaluate
from zwidth.loops.linear.chain import chain_of, flow, rates
from zwidth.loops.linear.ridge import BoundRidge, Condition
from zwidth.loops.rigid.device import classify_delays
from zwidth.loops.rigid.ridge import slopes_kernel, stiffness_slopes
from zwidth.words.errors import InputError
from zwidth.words.status import Status
from zwidth.words.types import Array

# The step of a difference, as a share of the parameter; its sixth power is rounding. And that of an imaginary step.
_STEP, _TINY = 1e-3, 1e-30
# A parameter below this share of its unit is next to 0: in steps of its own size rounding ate up to 3e-6 of a slope.
_NEXT_TO_NOTHING = 1e-5
# Weights of the differences: around a value, and from it on.
_CENTRAL = [(-3, -1 / 60), (-2, 3 / 20), (-1, -3 / 4), (1, 3 / 4), (2, -3 / 20), (3, 1 / 60)]
_ONE_SIDED = [-49 / 20, 6.0, -15 / 2, 20 / 3, -15 / 4, 6 / 5, -1 / 6]
# By what share G may differ by its matrices and by its roots.
_AGREES = 1e-8


class SceneSensitivities(NamedTuple):
    """K_max in N/m, its derivatives by dotted path in N/m per unit of the parameter, and the `zwidth.Status`."""

    stiffness: Array
    per: dict[str, float]
    status: Array


def differentiate(scene: Any, found: BoundRidge | None, status: Status) -> SceneSensitivities:
    """The derivatives of a ridge by the conditions that bind it."""
    paths = moving_paths(scene)
    if found is None:
        return SceneSensitivities(np.float64(math.nan), dict.fromkeys(paths, math.nan), np.int32(status))
    per = {path: _slope(scene, found, path) for path in paths}
    status = Status.NOT_CONVERGED if any(math.isnan(slope) for slope in per.values()) else status
    return SceneSensitivities(np.float64(found.alpha * scene.units.stiffness), per, np.int32(status))


def moving_paths(scene: Any) -> tuple[str, ...]:
    """The parameters of a scene, without the wall's, that K_max can be differentiated in."""
    paths = [path for path, value in scene.parameters().items() if not isinstance(value, int | np.integer)]
    without = {"stiffness", "virtual_damping"}
    if scene.operator is not None and scene.operator.rigid:
        without.add("operator.coupling_damping")
    return tuple(path for path in paths if path not in without)


def differentiate_rigid(scene: Any, negative: bool) -> SceneSensitivities | None:
    """Those of a rigid device by closed forms; None where its ridge lies at a damping that does not count."""
    values, model = (scene.delta, scene.d), scene.timing.delay_model
    found = evaluate(slopes_kernel, {"delta": scene.delta, "d": scene.d}, model, classify_delays(scene.d))
    if not negative and found.point.beta < 0:
        return None
    with np.errstate(invalid="ignore"):
        stiffness, *slopes = stiffness_slopes(found, scene.mass, scene.timing.period, *values)
    per = dict(zip(("mass", "damping", "period", "delay"), slopes, strict=True))
    if scene.operator is not None:
        per |= {"operator.mass": per["mass"], "operator.damping": per["damping"]}
        # A spring to ground that is not there yet has no closed form.
        ridge = scene.loop.ridge(negative)[0] if model == "held" else None
        per["operator.stiffness"] = math.nan if ridge is None else _slope(scene, ridge, "operator.stiffness")
    per = {path: float(slope) for path, slope in per.items()}
    return SceneSensitivities(np.float64(stiffness), per, found.point.status)


def _slope(scene: Any, found: BoundRidge, path: str) -> float:
    """The derivative of K_max in one parameter: as it moves, the conditions that bind go on to hold.

    The derivatives of the conditions are exact in the wall and its angles. In the parameter they are exact but for the
    rates of the chain and the velocity estimate, which are smooth over its own size (docs/theory/scenes.md, V21).
    """
    matrix, rows = _conditions(scene, found)
    at, whole = circle(np.array([found.w1, found.w2])), scene.whole_delay
    for weights in _stencils(scene, path):
        try:
            states = [
                [weight * part for part in _inputs(scene.replace(**{path: value}), whole, at)]
                for value, weight in weights
            ]
        except InputError:
            # The parameter is at the end of its range: from the other side.
            continue
        by_unit, by_delay, by_rate, by_push, by_f, by_f_slope = (
            np.sum(part, axis=0) for part in zip(*states, strict=True)
        )
        q, q_slope = _needed_slopes(scene, at, by_rate, by_push, by_delay)
        rest, slope = found.beta * by_f - q, found.beta * by_f_slope - q_slope
        moved = np.array([rest[0].real, rest[0].imag, rest[1].real, rest[1].imag, slope[0].imag])
        try:
            by_alpha = -np.linalg.solve(matrix, moved[rows])[0]
        except np.linalg.LinAlgError:
            break
        return float(scene.units.stiffness * by_alpha + found.alpha * by_unit)
    return math.nan


def _inputs(scene: Any, whole: int, at: CirclePoints) -> tuple[Any, ...]:
    """What K_max depends on a parameter through: the unit of stiffness, the delay, the rates of the chain, F and F'."""
    delay = scene.timing.delay / scene.timing.period
    chain = chain_of(scene, (delay, whole))
    return (scene.units.stiffness, delay, *rates(chain), *chain.estimate.jet(at))


def _needed_slopes(
    scene: Any, at: CirclePoints, by_rate: np.ndarray, by_push: np.ndarray, by_delay: float
) -> tuple[np.ndarray, np.ndarray]:
    """The derivatives of ``q = -1/G`` and of dq/dw in a parameter, by those of the chain's rates and of the delay.

    NaN where G by the matrices of the chain is not G by its roots: then rounding has eaten what they tell.
    """
    chain = scene.loop.chain
    # An imaginary step so short that its square is nothing is a derivative without a difference, here of e^A.
    rate, push = (value + 1j * _TINY * by for value, by in zip(rates(chain), (by_rate, by_push), strict=True))
    fraction = chain.d - chain.whole + 1j * _TINY * by_delay
    steps = (*flow(rate, push, 1.0), flow(rate, push, 1.0 - fraction)[1])
    (psi, full, late), (by_psi, by_full, by_late) = ([f(x) for x in steps] for f in (np.real, lambda x: x.imag / _TINY))
    turns, slopes = chain.whole + 1, np.full((2, at.w.size), complex(np.nan, np.nan))
    exact, lag = scene.loop.roots.required_wall(at).value, lag_jet(at, turns)
    for k, (zeta, turn) in enumerate(zip(at.before, 1j * at.z, strict=True)):
        with np.errstate(all="ignore"):
            try:
                back = np.linalg.inv(zeta * np.eye(len(psi)) - psi)
            except np.linalg.LinAlgError:
                continue
            moved = back @ (zeta * late + full)
            by_w = back @ (turn * late - turn * moved)
            by_p = back @ (by_psi @ moved + zeta * by_late + by_full)
            by_both = back @ (by_psi @ by_w + turn * by_late - turn * by_p)
            value, slope = lag.value[k] / moved[0] ** 2, lag.slope[k] / moved[0] ** 2
            if abs(lag.value[k] / moved[0] + exact[k]) <= _AGREES * abs(exact[k]):
                slopes[0, k] = value * by_p[0]
                slopes[1, k] = slope * by_p[0] + value * (by_both[0] - 2.0 * by_p[0] * by_w[0] / moved[0])
    return slopes[0], slopes[1]


def _conditions(scene: Any, found: BoundRidge) -> tuple[np.ndarray, list[int]]:
    """The derivatives of the binding conditions in alpha and what moves with it; their rows of `_state`.

    At a smooth optimum the angle may stay where it is: to first order it does not matter.
    """
    at, loop = circle(np.array([found.w1, found.w2])), scene.loop.roots
    with np.errstate(all="ignore"):
        q, f = loop.required_wall(at), loop.estimate.jet(at)
        # Of r = alpha + beta F - q.
        slope = found.beta * f.slope - q.slope
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
    """Values of a parameter with their weights in its derivative, of sixth order: around it, above it, below it."""
    value = float(scene.parameters()[path])
    period = float(scene.timing.period)
    units = {"mass": scene.mass, "damping": scene.mass / period, "stiffness": scene.mass / period**2, "delay": period}
    unit = float(next((unit for name, unit in units.items() if path.endswith(name)), 0.0))
    # Rates are linear in dampings and springs, and smooth in the delay, over all of the unit; a light mass has its own.
    least = 0.0 if path.endswith("mass") else _NEXT_TO_NOTHING * unit
    step = _STEP * (abs(value) if abs(value) > least else unit)
    yield from ([[(value + k * step, weight / step) for k, weight in _CENTRAL]] if value > 3.0 * step else [])
    yield from ([(value + side * k * step, side * w / step) for k, w in enumerate(_ONE_SIDED)] for side in (1, -1))
