"""Find the stiffest stable wall of any linear loop, its active constraints, and its derivatives in the parameters.

The maximum of alpha over the stable set is a smooth maximum of an edge, a corner where two crossings with the boundary
coincide, or, if only beta >= 0 is allowed, a crossing on the line beta = 0. It solves two conditions on
``r(z) = alpha + beta F(z) - q(z)`` (q and F as in `stability.linear.roots`; docs/theory/scenes.md, V19):

    first     r(e^(j w1)) = 0 for a pole pair, or for a real pole at z = -1 or z = 1
    second    the same at w2; or alpha is stationary along the curve of the first condition; or beta = 0

As a parameter changes, the same conditions remain active, so their implicit derivatives are those of alpha (V21). In
arrays of crossings, a *row* belongs to a line of constant B and a *column* to an arc or crossing line, as in
`stability.linear.boundary`. A *main* piece of the stable set is one that is connected to K = 0
(`stability.linear.regions`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.status import RidgeKind, Status
from zwidth.core.types import Array
from zwidth.model.circle_functions import CirclePoints, circle_points, power_jet
from zwidth.model.mechanism import build_chain
from zwidth.plant.sampled_states import integrate_chain
from zwidth.stability.linear.boundary import Boundary
from zwidth.stability.linear.curve import evaluate_curve
from zwidth.stability.linear.regions import StableSet
from zwidth.stability.linear.roots import LoopRoots
from zwidth.stability.linear.rows import find_stable_intervals
from zwidth.units.display import compact_repr
from zwidth.units.quantities import WALL

# Settings of the search for corners.
CORNER_TOLERANCE = 1e-8  # difference of the two crossings in alpha at a corner, relative to alpha
NEAR_CORNER = 1e-5  # largest relative distance from the start, in beta; for an end of the curve, in alpha
MAX_STEPS = 4  # Newton steps
CONVERGED_STEP = 1e-15  # relative to beta

ON_LOSSLESS = 1e-9  # tolerance of the lossless damping, relative to the width of the stable set in beta
# If the alpha of a stable wall exceeds the computed maximum by more than this fraction, the result is rejected. Smaller
# differences are rounding errors.
CONTRADICTION = 1e-7

# Test of a maximum on nearby lines of constant B. The scale of the offsets is the width of the stable set plus |beta|.
NEIGHBOR_OFFSETS = np.array([0.0, 1e-7, -1e-7, 1e-5, -1e-5, 1e-3, -1e-3])  # offsets in beta / scale
REACHED_FRACTION = 0.99  # fraction of the maximum alpha that a stable interval of one line must reach


class Condition(IntEnum):
    """An active constraint of the stiffest wall."""

    PAIR = 0  # a pole pair on the unit circle
    MINUS_ONE = 1  # a pole at z = -1
    PLUS_ONE = 2  # a pole at z = 1
    STATIONARY = 3  # d alpha/dw = 0 along the curve
    NO_DAMPING = 4  # beta = 0


class RidgeSolution(NamedTuple):
    """The stiffest stable wall and its two active constraints; ``w2`` equals w1 if the second one has no angle."""

    alpha: float
    beta: float
    w1: float
    w2: float
    first: Condition
    second: Condition

    @property
    def omega(self) -> float:
        """The angle of the poles on the unit circle with this wall; at a corner, the higher of the two angles."""
        return max(self.w1, self.w2) if self.second <= Condition.PLUS_ONE else self.w1

    @property
    def kind(self) -> RidgeKind:
        """The kind of the maximum: smooth, a corner, or on the line beta = 0 that bounds the allowed dampings."""
        if self.second == Condition.NO_DAMPING:
            return RidgeKind.NO_DAMPING
        smooth = self.first == Condition.PAIR and self.second == Condition.STATIONARY
        return RidgeKind.SMOOTH if smooth else RidgeKind.CORNER


def find_ridge(stable_set: StableSet, negative_damping: bool) -> RidgeSolution | None:
    """Return the stiffest stable wall with alpha > 0.

    Args:
        stable_set: the stable walls of the loop.
        negative_damping: if False, require beta >= 0.

    Returns:
        The wall and its active constraints; None if no wall with alpha > 0 is stable.

    Raises:
        ArithmeticError: if lines of constant B contradict the result, or a corner was not resolved.
    """
    least = -np.inf if negative_damping else 0.0
    # Compare alpha with 13 digits, because on an edge of constant alpha both corners differ by rounding errors. Among
    # equal maxima prefer the largest beta, then the crossing on a line of constant B, because the end of an edge has no
    # angle.
    maxima = sorted(
        _list_maxima(stable_set, least), key=lambda top: (-float(f"{top.alpha:.12e}"), -top.beta, math.isnan(top.w))
    )
    # Skip maxima on spurious edges, which rounding errors create near an asymptote of the curve. Such an edge bounds no
    # stable interval of a line of constant B.
    top = next((top for top in maxima if _is_reached(stable_set, top, least)), None)
    ridge = None if top is None else _identify_conditions(stable_set, top, least)
    lossless = stable_set.boundary.lossless
    if ridge is not None and abs(ridge.beta - lossless) <= ON_LOSSLESS * stable_set.width:
        # Set beta to exactly the lossless damping, at which no wall is asymptotically stable. At a beta with a rounding
        # error some walls would appear stable.
        ridge = ridge._replace(beta=lossless)
    highest = stable_set.find_highest(least)
    if highest > (0.0 if ridge is None else ridge.alpha) * (1.0 + CONTRADICTION):
        raise ArithmeticError(f"lines of constant B reach alpha = {highest!r}, above the maximum {ridge!r}")
    return ridge


class _Maximum(NamedTuple):
    """A local maximum of alpha along the edges."""

    alpha: float
    beta: float
    w: float
    column: int
    inner: bool  # the maximum lies inside its edge, not at an end


def _list_maxima(stable_set: StableSet, least: float) -> Iterator[_Maximum]:
    """Yield the local maxima of alpha for beta >= ``least`` along the edges of main pieces."""
    edges = stable_set.main_edges(least)
    for edge in edges:
        padded = np.pad(np.where(edge.beta >= least, edge.alpha, -np.inf), 1, constant_values=-np.inf)
        alpha, last = padded[1:-1], edge.w.size - 1
        for k in np.flatnonzero((alpha >= padded[:-2]) & (alpha >= padded[2:]) & (alpha > 0)):
            yield _Maximum(float(alpha[k]), float(edge.beta[k]), float(edge.w[k]), edge.column, bool(0 < k < last))
    if np.isfinite(least):
        # Add the crossings of the edges with the line beta = least, where the allowed range of beta ends.
        row = stable_set.boundary.find_crossings(np.array([least]))
        for edge in edges:
            high, w = float(row.alpha[0, edge.column]), float(row.w[0, edge.column])
            if edge.beta[0] <= least and high > 0:
                yield _Maximum(high, least, w, edge.column, False)


def _is_reached(stable_set: StableSet, top: _Maximum, least: float) -> bool:
    """Return whether a stable interval on a line of constant B near a maximum extends to nearly the same alpha."""
    scale = stable_set.width + abs(top.beta)
    intervals = find_stable_intervals(stable_set.boundary, np.maximum(top.beta + scale * NEIGHBOR_OFFSETS, least))
    bounded = (intervals.above == top.column) | (intervals.below == top.column)
    return bool(np.any(bounded & (intervals.high >= REACHED_FRACTION * top.alpha)))


def _identify_conditions(stable_set: StableSet, top: _Maximum, least: float) -> RidgeSolution:
    """Return the `RidgeSolution` of a local maximum, with its two active constraints."""
    alpha, beta, w = top[:3]
    if beta == least:
        return RidgeSolution(alpha, beta, w, w, _classify_angle(w), Condition.NO_DAMPING)
    if top.inner:
        return RidgeSolution(alpha, beta, w, w, Condition.PAIR, Condition.STATIONARY)
    return _solve_corner(stable_set, alpha, beta)


def _classify_angle(w: float) -> Condition:
    """Return the type of the active constraint at the angle w: a pole pair, or a real pole at z = 1 or z = -1."""
    if w == 0.0:
        return Condition.PLUS_ONE
    return Condition.MINUS_ONE if w == np.pi else Condition.PAIR


def _solve_corner(stable_set: StableSet, alpha: float, beta: float) -> RidgeSolution:
    """Compute the corner close to a wall by Newton's method, and its two active constraints."""
    # Solve for the beta at which two crossings have the same alpha. Do not use the tabulated end of an edge, because
    # near an undamped mode a rounding error of its angle changes alpha considerably.
    (w, other), heights, slopes, step = _find_nearest_two(stable_set.boundary, alpha, beta)
    for _ in range(MAX_STEPS):
        if not CONVERGED_STEP * abs(beta) < abs(step) <= NEAR_CORNER * abs(beta):
            break
        alpha, beta = heights[0] + slopes[0] * step, beta + step
        (w, other), heights, slopes, step = _find_nearest_two(stable_set.boundary, alpha, beta)
    w, other = sorted((w, other))
    # Multiply the remaining difference of the two alphas by ``flatness``, because an error of beta changes the alpha of
    # the corner only in proportion to the smaller of the two derivatives d alpha/d beta.
    difference, gap = abs(slopes[0] - slopes[1]), abs(heights[1] - heights[0]) / abs(alpha)
    flatness = min(1.0, min(map(abs, slopes)) / difference) if difference > 0 else 1.0
    if (
        abs(step) <= NEAR_CORNER * (stable_set.width + abs(beta))
        and flatness * gap <= CORNER_TOLERANCE
        and other - w > 1e-6
    ):
        return RidgeSolution(alpha, beta, w, other, _classify_angle(w), _classify_angle(other))
    # Otherwise the corner is a double pole at z = -1, or at z = 1 for a device with negative static gain, where an end
    # of the boundary curve lies on the crossing line.
    for w in (np.pi, 0.0):
        limit, damping = stable_set.boundary.limits[w]
        if abs(limit - alpha) <= NEAR_CORNER * abs(alpha):
            return RidgeSolution(limit, damping, w, w, _classify_angle(w), Condition.STATIONARY)
    raise ArithmeticError(f"no two conditions meet at alpha = {alpha!r}, beta = {beta!r}")


def _find_nearest_two(b: Boundary, alpha: float, beta: float) -> tuple[list[float], list[float], list[float], float]:
    """Return the two crossings nearest to a wall on its line of constant B.

    Returns:
        Their angles, alphas, and derivatives d alpha/d beta; and the Newton step in beta to where their alphas agree.
    """
    row = b.find_crossings(np.array([beta]))
    distance = np.abs(row.alpha[0] - alpha)
    near = np.resize(np.argsort(np.where(np.isnan(distance), np.inf, distance))[:2], 2)
    curve = evaluate_curve(b.loop, row.w[0, near])
    with np.errstate(all="ignore"):
        slopes = curve.alpha_slope * curve.im_f**2 / curve.wronskian
    for k in np.flatnonzero(near >= len(b.arcs)):
        slopes[k] = -b.lines[near[k] - len(b.arcs)].f
    heights = row.alpha[0, near]
    step = (heights[1] - heights[0]) / ((slopes[0] - slopes[1]) or np.inf)
    return row.w[0, near].tolist(), heights.tolist(), slopes.tolist(), float(step)


def _differentiate_conditions(loop: LoopRoots, ridge: RidgeSolution) -> tuple[np.ndarray, list[int]]:
    """Return the Jacobian of the active constraints with respect to the free unknowns.

    The five possible equations are Re r and Im r at w1, the same at w2, and Im dr/dw at w1; the unknowns are alpha,
    beta, w1 and w2. An angle is free only if it belongs to a pole pair. At a smooth maximum w1 may stay fixed, because
    it changes alpha only to second order (envelope theorem).

    Returns:
        The square Jacobian, and the indices of its equations.
    """
    points = circle_points(np.array([ridge.w1, ridge.w2]))
    with np.errstate(all="ignore"):
        q, f = loop.evaluate_controller(points), loop.estimate.jet(points)
        slope = ridge.beta * f.slope - q.slope
    matrix = np.zeros((5, 4))
    matrix[[0, 2], 0] = 1.0
    matrix[:, 1] = _stack_equations(f.value, f.slope)
    matrix[:2, 2], matrix[2:4, 3] = _stack_equations(slope, slope)[:4].reshape(2, 2)
    is_pair = ridge.first == Condition.PAIR, ridge.second == Condition.PAIR
    equations, unknowns = [0, 1] if is_pair[0] else [0], [0]
    if ridge.second != Condition.NO_DAMPING:
        unknowns.append(1)
    if ridge.second <= Condition.PLUS_ONE:
        equations += [2, 3] if is_pair[1] else [2]
    elif ridge.second == Condition.STATIONARY and not is_pair[0]:
        equations.append(4)
    if ridge.second != Condition.STATIONARY:
        unknowns += [2 + k for k in range(2) if is_pair[k]]
    return matrix[np.ix_(equations, unknowns)], equations


def _stack_equations(value: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return the five equations, or their derivatives, for given r and dr/dw (or their derivatives) at two angles."""
    return np.array([value[0].real, value[0].imag, value[1].real, value[1].imag, slope[0].imag])


DIFFERENCE_STEP = 1e-3  # step relative to the parameter; the truncation error is of the order of its sixth power
COMPLEX_STEP = 1e-30  # imaginary step; its square is negligible
# Fraction of its unit below which the step of a parameter is relative to the unit and not to the value, because steps
# relative to such small values caused rounding errors of the derivative of up to 3e-6.
SMALL_PARAMETER = 1e-5
# Sixth-order finite differences: pairs of offset (in steps) and weight of the central difference, and the weights of
# the one-sided difference at 0, 1, ... 6 steps.
CENTRAL_DIFFERENCE = [(-3, -1 / 60), (-2, 3 / 20), (-1, -3 / 4), (1, 3 / 4), (2, -3 / 20), (3, 1 / 60)]
ONE_SIDED_DIFFERENCE = [-49 / 20, 6.0, -15 / 2, 20 / 3, -15 / 4, 6 / 5, -1 / 6]
RESPONSE_TOLERANCE = 1e-8  # largest relative difference of G by the matrices of the chain and by its roots


@compact_repr()
class SceneSensitivities(NamedTuple):
    """K_max in N/m, its derivatives by dotted path in N/m per unit of the parameter, and the `zwidth.Status`."""

    stiffness: Array
    per: dict[str, float]
    status: Array


def compute_sensitivities(scene: Any, ridge: RidgeSolution | None, status: Status) -> SceneSensitivities:
    """Return K_max and its derivatives in all parameters of a scene; NaN if ``ridge`` is None."""
    paths = list_ridge_parameters(scene)
    if ridge is None:
        return SceneSensitivities(np.float64(math.nan), dict.fromkeys(paths, math.nan), np.int32(status))
    per = {path: differentiate_stiffness(scene, ridge, path) for path in paths}
    status = Status.NOT_CONVERGED if any(math.isnan(slope) for slope in per.values()) else status
    return SceneSensitivities(np.float64(ridge.alpha * scene.units.stiffness), per, np.int32(status))


def list_ridge_parameters(scene: Any) -> tuple[str, ...]:
    """Return the dotted paths of the real-valued parameters of a scene on which K_max depends."""
    paths = [path for path, value in scene.parameters().items() if not isinstance(value, int | np.integer)]
    rigid = scene.operator is not None and scene.operator.rigid
    excluded = (*WALL, "operator.coupling_damping") if rigid else WALL
    return tuple(path for path in paths if path not in excluded)


def differentiate_stiffness(scene: Any, ridge: RidgeSolution, path: str) -> float:
    """Return the derivative of K_max in one parameter, with the same active constraints (V21); NaN if inaccurate."""
    matrix, equations = _differentiate_conditions(scene.loop.roots, ridge)
    points = circle_points(np.array([ridge.w1, ridge.w2]))
    # Reduce the integer delay by one if the period changes and the delay is an integer: a longer period shortens a
    # delay measured in periods, so the delay becomes a fractional one with a smaller integer part.
    n = scene.integer_delay - (path == "period" and scene.d == scene.integer_delay > 0)
    for weights in _list_differences(scene, path):
        try:
            states = [
                [weight * part for part in _collect_dependencies(scene.replace(**{path: value}), n, points)]
                for value, weight in weights
            ]
        except InputError:
            # Try the next, one-sided difference, because the value of the parameter is at an end of its range.
            continue
        d_unit, d_delay, d_A, d_B, d_f, d_f_slope = (np.sum(part, axis=0) for part in zip(*states, strict=True))
        q, q_slope = _differentiate_controller(scene, n, points, d_A, d_B, d_delay)
        residual, slope = ridge.beta * d_f - q, ridge.beta * d_f_slope - q_slope
        try:
            d_alpha = -np.linalg.solve(matrix, _stack_equations(residual, slope)[equations])[0]
        except np.linalg.LinAlgError:
            break
        return float(scene.units.stiffness * d_alpha + ridge.alpha * d_unit)
    return math.nan


def _collect_dependencies(scene: Any, n: int, points: CirclePoints) -> tuple[Any, ...]:
    """Return the quantities that determine K_max: unit of stiffness, delay, A, B, and F and dF/dw at two angles."""
    delay = scene.timing.delay / scene.timing.period
    chain = build_chain(scene, (delay, n))
    if chain.sampled:
        # Raise an error if the loop's period differs from that of a sampled system.
        chain.check()
    return (scene.units.stiffness, delay, *chain.realize()[:2], *chain.estimate.jet(points))


def _differentiate_controller(
    scene: Any, n: int, points: CirclePoints, d_A: np.ndarray, d_B: np.ndarray, d_delay: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of q and dq/dw with respect to a parameter, by the chain rule.

    Args:
        scene: the scene.
        n: integer delay.
        points: the two angles of the ridge.
        d_A: derivative of the matrix A of the chain in the parameter.
        d_B: derivative of its matrix B.
        d_delay: derivative of the delay in periods.

    Returns:
        Both derivatives at the angles; NaN where G by the matrices of the chain differs from G by its roots, because
        rounding errors then dominate.
    """
    chain = scene.loop.chain
    # Differentiate the discretization by the complex-step method, because it has no cancellation.
    A, B = (value + 1j * COMPLEX_STEP * d for value, d in zip(chain.realize(), (d_A, d_B), strict=False))
    fraction = chain.d - n + 1j * COMPLEX_STEP * d_delay
    steps = (
        *integrate_chain(chain, A, B, 1.0),
        integrate_chain(chain, A, B, 1.0 - fraction)[1],
    )
    (psi, full, late), (d_psi, d_full, d_late) = (
        [f(x) for x in steps] for f in (np.real, lambda x: x.imag / COMPLEX_STEP)
    )
    lag, slopes = n + 1, np.full((2, points.w.size), complex(np.nan, np.nan))
    exact, z_power = scene.loop.roots.evaluate_controller(points).value, power_jet(points, lag)
    for k, (zeta, zeta_slope) in enumerate(zip(points.z_minus_1, 1j * points.z, strict=True)):
        with np.errstate(all="ignore"):
            try:
                inverse = np.linalg.inv(zeta * np.eye(len(psi)) - psi)
            except np.linalg.LinAlgError:
                continue
            # Compute the state x = (zeta - Psi)^-1 (zeta Gamma(1 - f) + Gamma(1)), and its derivatives in w, in the
            # parameter p, and in both.
            x = inverse @ (zeta * late + full)
            x_w = inverse @ (zeta_slope * late - zeta_slope * x)
            x_p = inverse @ (d_psi @ x + zeta * d_late + d_full)
            x_wp = inverse @ (d_psi @ x_w + zeta_slope * d_late - zeta_slope * x_p)
            value, slope = z_power.value[k] / x[0] ** 2, z_power.slope[k] / x[0] ** 2
            if abs(z_power.value[k] / x[0] + exact[k]) <= RESPONSE_TOLERANCE * abs(exact[k]):
                slopes[0, k] = value * x_p[0]
                slopes[1, k] = slope * x_p[0] + value * (x_wp[0] - 2.0 * x_p[0] * x_w[0] / x[0])
    return slopes[0], slopes[1]


def _list_differences(scene: Any, path: str) -> Iterator[list[tuple[float, float]]]:
    """Yield sixth-order finite differences for a parameter: central, above its value, and below its value.

    Each is a list of values of the parameter and their weights.
    """
    value = float(scene.parameters()[path])
    period = float(scene.timing.period)
    units = {"mass": scene.mass, "damping": scene.mass / period, "stiffness": scene.mass / period**2, "delay": period}
    unit = float(next((unit for name, unit in units.items() if path.endswith(name)), 0.0))
    # A step relative to the unit is accurate, because A and B are linear in dampings and stiffnesses and smooth in the
    # delay. For a mass the step must be relative to the value, because A and B depend on its inverse.
    least = 0.0 if path.endswith("mass") else SMALL_PARAMETER * unit
    step = DIFFERENCE_STEP * (abs(value) if abs(value) > least else unit)
    yield from ([[(value + k * step, weight / step) for k, weight in CENTRAL_DIFFERENCE]] if value > 3.0 * step else [])
    yield from (
        [(value + side * k * step, side * w / step) for k, w in enumerate(ONE_SIDED_DIFFERENCE)] for side in (1, -1)
    )
