"""Compute results for a scene in NumPy, such as margins, with exact derivatives, for calls from JAX.

A wall has the stiffness alpha and the damping beta, both normalized; L is the open loop, and w is an angle on the unit
circle, in rad per period. F is the velocity estimate, G the device, and q = -1/G the critical controller.

Each function in `ANSWERS` has three arguments: a scene whose parameters are floats; an array with one row per point,
which contains the alpha and beta of a wall, or an angle w; and the order of the highest derivative, 0, 1 or 2. The
values equal those of a direct call. The variables of the derivatives are the numbers of the scene (the leaves of its
JAX pytree) and the entries of the row. The derivatives follow from the equations that the result solves
(`stability.linear.derivatives`); where they do not exist, they are NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from zwidth.analysis.environment_derivatives import find_environment_limits
from zwidth.analysis.optimization import SIDES
from zwidth.analysis.walls import allows_negative
from zwidth.core.errors import InputError
from zwidth.core.pytrees import list_leaves, replace_leaves
from zwidth.core.status import RidgeKind, Status
from zwidth.model.circle_functions import circle_points
from zwidth.numerics.taylor import Taylor, differentiate_implicitly, seed
from zwidth.stability.linear.derivatives import LoopTerms, differentiate, differentiate_ridge, index_parameters, split
from zwidth.stability.linear.margins import evaluate_walls
from zwidth.stability.linear.passivity import PassivityCondition
from zwidth.stability.linear.poles import compute_poles_minus_one, log_modulus

# Constants of the search for the angle of the pole that is on the unit circle if the delay grows by the delay margin.
POLE_TOLERANCE = 1e-9  # largest |1 + L| at this angle; the relative error of the delay margin is about 1e-12
ANGLE_STEPS = 12  # Newton steps for the angle
N_ANGLES = 8  # number of angles, those with the smallest |1 + L|, at which each Newton step starts

# Values, first derivatives and second derivatives, up to the requested order, as arrays of shape (points, results),
# (points, results, variables) and (points, results, variables, variables).
Derivatives = list[np.ndarray]


def no_derivatives(values: np.ndarray, arguments: int, order: int, fill: float = 0.0) -> Derivatives:
    """Return values together with derivatives that are all 0, or all ``fill``."""
    return [values, *(np.full((*values.shape, *[arguments] * k), fill) for k in range(1, order + 1))]


def fill_rows(results: Derivatives, point: Any, rows: Sequence[int], unknowns: Sequence[Taylor]) -> None:
    """Store the derivatives of each unknown in the results for one point; ``rows`` has one row index per unknown."""
    for row, unknown in zip(rows, unknowns, strict=False):
        for result, part in zip(results[1:], (unknown.first, unknown.second), strict=False):
            result[point, row] = part


def find_stiffest(scene: Any, points: np.ndarray, order: int, negative_damping: bool | None) -> Derivatives:
    """Return alpha, beta, angular frequency, kind and status of the stiffest stable wall, with derivatives."""
    negative = allows_negative(scene, negative_damping)
    top = scene.loop.stiffest(negative)
    results = no_derivatives(np.array([[*top]], float), len(list_leaves(scene)), order)
    for result in results[1:]:
        result[:, :3] = np.nan
    if order and top.status == Status.OK and (ridge := scene.loop.ridge(negative)[0]):
        fill_rows(results, 0, range(3), differentiate_ridge(scene, ridge, order))
    return results


def label_walls(scene: Any, points: np.ndarray, order: int) -> Derivatives:
    """Return 1 for stable walls and 0 for all other walls; all derivatives are 0."""
    stable = np.asarray(scene.loop.labels(*points.T), float)
    return no_derivatives(stable.reshape(-1, 1), len(list_leaves(scene)) + 2, order)


def find_radius(scene: Any, points: np.ndarray, order: int) -> Derivatives:
    """Return the spectral radius of walls, with derivatives."""
    radius = np.asarray(scene.loop.radius(*points.T)).reshape(-1, 1)
    results = no_derivatives(radius, len(list_leaves(scene)) + 2, order, np.nan)

    def equations(terms: LoopTerms, values: Sequence[Taylor]) -> list[Taylor]:
        alpha, beta, log_radius, w = values
        return split(terms.residual(alpha, beta, log_radius + w * 1j)[0])

    for k in np.flatnonzero(np.isfinite(radius[:, 0])) if order else ():
        wall = points[k]
        try:
            zeta = compute_poles_minus_one(scene.loop.roots, *wall[:, None])[0]
        except InputError:
            continue  # too many poles to compute all; the derivatives remain NaN
        pole = np.log1p(zeta[np.argmax(log_modulus(zeta))])
        log_radius, _ = differentiate(scene, order, wall.tolist(), [pole.real, abs(pole.imag)], equations)
        fill_rows(results, k, [0], [log_radius.exp()])
    return results


def find_boundary(scene: Any, points: np.ndarray, order: int) -> Derivatives:
    """Return alpha and beta of the walls that have a pole pair on the unit circle at the angles w, with derivatives."""
    walls = np.stack(scene.loop.critical_walls(points[:, 0]), -1)
    results = no_derivatives(walls, len(list_leaves(scene)) + 1, order)

    def equations(terms: LoopTerms, values: Sequence[Taylor]) -> list[Taylor]:
        w, alpha, beta = values
        return split(terms.residual(alpha, beta, w * 1j)[0])

    for k in range(len(points)) if order else ():
        fill_rows(results, k, [0, 1], differentiate(scene, order, points[k].tolist(), walls[k].tolist(), equations))
    return results


def find_margins(scene: Any, points: np.ndarray, order: int) -> Derivatives:
    """Return the normalized stability margins of walls, in the order of `zwidth.Margins`, with derivatives."""
    margins = np.stack([np.broadcast_to(part, len(points)) for part in scene.loop.margins(*points.T)], -1)
    results = no_derivatives(margins, len(list_leaves(scene)) + 2, order, np.nan)
    for k in range(len(points)) if order else ():
        wall, (gain, phase, delay, modulus, w_gain, w_phase, w_modulus) = points[k].tolist(), margins[k].tolist()

        def fill(
            unknowns: list[float],
            equations: Any,
            rows: list[int],
            *,
            k: int = k,
            wall: list[float] = wall,
            factor: float = 1.0,
            added: float | None = None,
        ) -> None:
            margin, *angle = differentiate(scene, order, wall, unknowns, equations, added)
            for result in results[1:]:
                result[k, rows] = 0.0  # for a constant angle; overwritten below if the angle is an unknown
            fill_rows(results, k, rows, [margin * factor, *angle])

        if np.isfinite(w_gain):
            fill(*_at_angle(_meet_gain, [gain], w_gain), [0, 4])
        if np.isfinite(w_phase):
            angle = float(np.angle(-scene.loop.open_loop(*np.array(wall)[:, None], np.array([w_phase]))[0]))
            sign = np.sign(phase) * np.sign(angle)
            fill(*_at_angle(_meet_phase, [angle], w_phase), [1, 5], factor=np.degrees(sign))
        if np.isfinite(w_modulus):
            fill(*_at_angle(_meet_distance, [modulus], w_modulus), [3, 6])
        if delay > 0 and np.isfinite(delay):
            w = _find_delayed_angle(scene, wall, delay)
            if w is not None:
                fill(*_at_angle(_meet_delay, [delay], w), [2], added=delay)
    return results


def _at_angle(meet: Callable[..., list[Taylor]], unknowns: list[float], w: float) -> tuple[list[float], Any]:
    """Return the unknowns and the equations of a stability margin that is attained at the angle w.

    The angle is an additional unknown unless it is 0 or pi. These two angles are constant, and one equation suffices.
    """
    fixed = w in (0.0, np.pi)

    def equations(terms: LoopTerms, values: Sequence[Taylor]) -> list[Taylor]:
        alpha, beta, unknown, *free = values
        both = meet(terms, alpha, beta, unknown, terms.one * w if fixed else free[0])
        return both[:1] if fixed else both

    return unknowns if fixed else [*unknowns, w], equations


def _meet_gain(terms: LoopTerms, alpha: Taylor, beta: Taylor, gain: Taylor, w: Taylor) -> list[Taylor]:
    """Return the equations for a pole at the angle w on the unit circle, with the open loop multiplied by ``gain``."""
    r, _, _ = terms.residual(alpha * gain, beta * gain, w * 1j)
    scale = abs(terms.controller(w * 1j)[0].v)
    return split(r + terms.feedback(w * 1j)[0] * (gain - 1.0) / scale)


def _meet_phase(terms: LoopTerms, alpha: Taylor, beta: Taylor, angle: Taylor, w: Taylor) -> list[Taylor]:
    """Return the equations for a gain crossover (|L| = 1) at the angle w, where -L has the phase ``angle``."""
    q, f, rest = terms.controller(w * 1j)[0], terms.estimate(w * 1j)[0], terms.feedback(w * 1j)[0]
    return split(((alpha + beta * f + rest) * (angle * -1j).exp() - q - rest) / abs(q.v))


def _meet_delay(terms: LoopTerms, alpha: Taylor, beta: Taylor, delay: Taylor, w: Taylor) -> list[Taylor]:
    """Return the equations for a pole on the unit circle at the angle w; ``terms`` include the additional delay."""
    return split(terms.residual(alpha, beta, w * 1j)[0])


def _meet_distance(terms: LoopTerms, alpha: Taylor, beta: Taylor, distance: Taylor, w: Taylor) -> list[Taylor]:
    """Return the equations for the smallest distance of L from -1, which is attained at the angle w."""
    (q, q_slope), (f, f_slope) = terms.controller(w * 1j), terms.estimate(w * 1j)
    rest, rest_slope = terms.feedback(w * 1j)
    q, q_slope = q + rest, q_slope + rest_slope
    L = -(alpha + beta * f + rest) / q
    slope = (-(beta * f_slope) - rest_slope - L * q_slope) / q
    difference = L + 1.0
    square = difference.real * difference.real + difference.imag * difference.imag
    return [distance - square.sqrt(), (difference.conjugate() * slope * 1j).real]


def _find_delayed_angle(scene: Any, wall: list[float], delay: float) -> float | None:
    """Return the angle w of the pole that is on the unit circle if the delay grows by ``delay``, the delay margin."""
    chain, (alpha, beta) = scene.loop.chain, wall
    loop, w = scene.loop.with_delay(float(chain.d) + delay), np.append(scene.loop.boundary.w, np.pi)
    for _ in range(ANGLE_STEPS):
        L = evaluate_walls(loop, alpha, beta, circle_points(w))
        distance = np.abs(1.0 + L.value)
        best = np.argsort(np.where(np.isnan(distance), np.inf, distance))[:N_ANGLES]
        if distance[best[0]] <= POLE_TOLERANCE:
            return float(w[best[0]])
        # Start Newton steps at the angles with L closest to -1. Keep these angles, because a step may increase |1 + L|.
        w, step = w[best], ((1.0 + L.value[best]) / L.slope[best]).real
        w = np.concatenate([w, np.clip(np.where(w < np.pi, w - step, w), 0.0, np.pi)])
    return None


# Constants of the search for the angle at which the passivity condition requires the largest damping.
NODES_PER_PERIOD = 32  # grid angles per period of the delay and of the velocity window
NEWTON_STEPS = 2  # Newton steps that refine the angle, because the minimizer is accurate to half of the digits only
# Largest relative difference between the margin of a direct call and the margin at the refined angle. Above it, the
# derivatives are NaN.
MARGIN_TOLERANCE = 1e-9


def find_passivity_margin(scene: Any, points: np.ndarray, order: int) -> Derivatives:
    """Return the normalized passivity margin of walls, with derivatives."""
    margin = np.asarray(scene.loop.passivity_margin(*points.T), float).reshape(-1, 1)
    size = len(list_leaves(scene)) + 2
    results = no_derivatives(margin, size, order, np.nan)
    for k in np.flatnonzero(np.isfinite(margin[:, 0])) if order else ():
        w = _find_worst_angle(scene, *points[k].tolist())
        value = _evaluate_passivity(scene, points[k], w)
        for _ in range(NEWTON_STEPS):
            slope, curvature = value.first[-1], value.second[-1, -1]
            if 0.0 < w < np.pi and curvature > 0.0:
                w = float(np.clip(w - slope / curvature, 0.0, np.pi))
                value = _evaluate_passivity(scene, points[k], w)
        if not abs(value.v - margin[k, 0]) <= MARGIN_TOLERANCE * (abs(value.v) + abs(points[k]).sum()):
            continue
        # The margin is a minimum over w, so its first derivatives are those at constant w (envelope theorem).
        results[1][k, 0] = value.first[:size]
        if order > 1:
            mixed, curvature = value.second[:size, -1], value.second[-1, -1]
            inverse = 1.0 / curvature if 0.0 < w < np.pi and curvature > 0.0 else 0.0
            results[2][k, 0] = value.second[:size, :size] - inverse * np.outer(mixed, mixed)
    return results


def _find_worst_angle(scene: Any, alpha: float, beta: float) -> float:
    """Return the angle w at which a passive wall requires the largest damping, accurate to half of the digits."""
    from scipy.optimize import minimize_scalar

    estimate = scene.velocity.estimate(scene.timing.period)
    condition = PassivityCondition.derive(estimate, scene.d)
    wall = np.array(max(alpha + beta * condition.spring, 0.0)), np.array(beta)

    def require_damping(w: Any) -> Any:
        return condition.require_damping(*wall, np.asarray(w))

    w = np.linspace(0.0, np.pi, 513 + NODES_PER_PERIOD * (condition.integer_delay + estimate.degree))
    needed = require_damping(w)
    k = int(np.argmax(needed))
    if k in (0, w.size - 1):
        return float(w[k])
    bounds = w[k - 1], w[k + 1]
    return float(
        minimize_scalar(lambda x: -require_damping(x), bounds=bounds, method="bounded", options={"xatol": 1e-12}).x
    )


def _evaluate_passivity(scene: Any, wall: np.ndarray, w: float) -> Taylor:
    """Return the passivity margin that the passivity condition yields at one angle w, with derivatives.

    The variables are the numbers of the scene, alpha, beta and w. The formulas are those of
    `stability.linear.passivity`.
    """
    leaves = list_leaves(scene)
    variables = seed([*leaves, *wall.tolist(), w], 2)
    alpha, beta, angle = variables[len(leaves) :]
    terms = LoopTerms(scene, variables, scene.integer_delay)
    n, f, one = scene.integer_delay, terms.d - scene.integer_delay, terms.one
    (spring, rate), lam = terms.estimate(one * 0j), angle * 1j
    velocity = terms.estimate(lam)[0] - spring
    quotient = velocity / lam.expm1() if w else rate
    kernel = (angle * (n + 0.5)).sin() / (angle * 0.5).sin() if w else one * (2.0 * n + 1.0)
    stiffness = (alpha + beta * spring).real
    controller = stiffness + beta * velocity
    a = (beta * (lam * -n).exp() * quotient).real * 2.0 - stiffness * kernel
    a = a - f * (controller * (lam * -(n + 1)).exp()).real * 2.0
    square = controller.real * controller.real + controller.imag * controller.imag
    needed = ((a * a + f * (1.0 - f) * square * 4.0).sqrt() - a) / 4.0
    device = terms.varied.device
    margin = device.damping * terms.varied.timing.period / terms.varied.mass - needed
    return stiffness if stiffness.v < min(0.0, margin.v) else margin


def find_required(scene: Any, points: np.ndarray, order: int, parameter: str, *options: Any) -> Derivatives:
    """Return required parameter value, sufficient side, both ends of the range, and status, with derivatives."""
    within, negative = options
    count = len(list_leaves(scene))
    results = no_derivatives(np.full((len(points), 5), np.nan), count + 1, order)
    for k, stiffness in enumerate(points[:, 0].tolist()):
        needed = scene.required(parameter, stiffness, within=within, negative_damping=negative)
        side = SIDES.index(needed.sufficient_side)
        results[0][k] = needed.value, side, *needed.range, needed.status
        for result in results[1:]:
            result[k, 0] = np.nan
        if order and needed.status == Status.OK and needed.crossings:
            fill_rows(
                results, k, [0], [_differentiate_required(scene, parameter, needed.value, stiffness, order, negative)]
            )
    return results


def _differentiate_required(
    scene: Any, parameter: str, value: float, stiffness: float, order: int, negative: bool | None
) -> Taylor:
    """Return the parameter value for a required stiffness, with derivatives in the scene and the stiffness."""
    path, x = ("period", 1.0 / value) if parameter == "rate" else (parameter, value)
    changed = scene.replace(**{path: x})
    count, index = len(list_leaves(scene)), index_parameters(changed)[path]
    top = find_stiffest(changed, np.zeros((1, 0)), order, negative)
    leaves = seed(list_leaves(changed), order)
    varied = replace_leaves(changed, iter(leaves))
    alpha = Taylor(top[0][0, 0], top[1][0, 0], top[2][0, 0] if order > 1 else None)
    K = alpha * varied.mass / varied.timing.period / varied.timing.period

    def move(part: np.ndarray) -> np.ndarray:
        """Add the stiffness as a variable, and move the derivatives in the parameter to the last variable."""
        moved = np.zeros(tuple(size + 2 for size in part.shape))
        moved[tuple(slice(count) for _ in part.shape)] = part
        for axis in range(part.ndim):
            moved = np.moveaxis(moved, axis, 0)
            moved[-1], moved[index] = moved[index].copy(), 0.0
            moved = np.moveaxis(moved, 0, axis)
        return moved

    equation = Taylor(K.v - stiffness, move(K.first), None if K.second is None else move(K.second))
    equation.first[count] = -1.0
    (unknown,) = differentiate_implicitly([equation], [x])
    return unknown.reciprocal() if parameter == "rate" else unknown


ANSWERS: dict[str, tuple[Callable[..., Derivatives], int]] = {
    "stiffest": (find_stiffest, 5),
    "labels": (label_walls, 1),
    "radius": (find_radius, 1),
    "critical_walls": (find_boundary, 2),
    "margins": (find_margins, 7),
    "passivity_margin": (find_passivity_margin, 1),
    "required": (find_required, 5),
    "environment_limit": (find_environment_limits, 3),
}
"""For each method of a loop (`zwidth.analysis.loop`): function that computes its results, and their number.

The method "environment_limit" belongs to `zwidth.AdmittanceDisplay`; its function has a display in place of the scene.
"""

# Values for scenes with a parameter out of range, for methods whose values are then not all NaN; the label 0 means
# "not stable".
INVALID = {
    "stiffest": [np.nan, np.nan, np.nan, RidgeKind.NONE, Status.INVALID_INPUT],
    "labels": [0.0],
    "required": [np.nan, SIDES.index("nowhere"), np.nan, np.nan, Status.INVALID_INPUT],
    "environment_limit": [np.nan, np.nan, Status.INVALID_INPUT],
}
