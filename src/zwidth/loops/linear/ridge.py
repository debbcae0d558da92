"""The stiffest stable wall of any linear loop, and what binds it.

The top of the stable set is a smooth maximum of its edge, a corner where two conditions meet, or, where only
dampings beta >= 0 are allowed, the end of the row beta = 0. Each is the solution of two conditions of two equations
each, with ``r(z) = alpha + beta F(z) - q(z)``:

    first     r(e^(j w1)) = 0 of a pole pair, or of a real pole at z = -1 or z = 1
    second    the same at w2; or the curve of the first is stationary in alpha; or beta = 0
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from zwidth.loops.linear.border import Border
from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.curve import curve_at
from zwidth.loops.linear.held import hold
from zwidth.loops.linear.roots import LoopRoots
from zwidth.loops.linear.rows import bound_intervals
from zwidth.parts.chain import chain_of
from zwidth.parts.circle import CirclePoints, circle, lag_jet
from zwidth.words.errors import InputError
from zwidth.words.quantities import WALL
from zwidth.words.showing import shown
from zwidth.words.status import RidgeKind, Status
from zwidth.words.types import Array

# How far apart, as shares of alpha, two crossings of a corner are, and from a corner where the curve ends at z = -1.
_MEETS, _NEAR = 1e-8, 1e-5
# Steps to a corner at most, and the one, as a share of beta, after which it is reached.
_STEPS, _ARRIVED = 4, 1e-15
_ON_ROW = 1e-9  # tolerance of the lossless damping, relative to the width of the stable set in beta
# By what share rounding may make a row's wall stiffer.
_ABOVE = 1e-7
# Rows next to a ridge, as shares of the plane, one of which must reach nearly as high.
_BESIDE, _NEARLY = np.array([0.0, 1e-7, -1e-7, 1e-5, -1e-5, 1e-3, -1e-3]), 0.99


class Condition(IntEnum):
    """What holds at the stiffest wall."""

    PAIR = 0
    MINUS_ONE = 1
    PLUS_ONE = 2
    STATIONARY = 3
    NO_DAMPING = 4


class BoundRidge(NamedTuple):
    """The stiffest stable wall and the two conditions that make it so; ``w2`` is w1 where the second has no angle."""

    alpha: float
    beta: float
    w1: float
    w2: float
    first: Condition
    second: Condition

    @property
    def omega(self) -> float:
        """The angle at which the loop oscillates there, the higher one at a corner."""
        return max(self.w1, self.w2) if self.second <= Condition.PLUS_ONE else self.w1

    @property
    def kind(self) -> RidgeKind:
        """Smooth, a corner, or the end of the allowed damping."""
        if self.second == Condition.NO_DAMPING:
            return RidgeKind.NO_DAMPING
        smooth = self.first == Condition.PAIR and self.second == Condition.STATIONARY
        return RidgeKind.SMOOTH if smooth else RidgeKind.CORNER


def find_ridge(border: Border, negative_damping: bool) -> BoundRidge | None:
    """The stiffest stable wall with alpha > 0 or None; ArithmeticError where the rows contradict what was found."""
    least = -np.inf if negative_damping else 0.0
    # On an edge that does not depend on B, corners differ in alpha only by rounding errors: prefer the largest beta,
    # then the crossing on a line of constant B, because the end of an edge has no angle.
    tops = sorted(_tops(border, least), key=lambda top: (-float(f"{top.alpha:.12e}"), -top.beta, math.isnan(top.w)))
    # Where the curve runs to infinity rounding may take a part of it for an edge; rows do not see it.
    top = next((top for top in tops if _is_reached(border, top, least)), None)
    found = None if top is None else _describe(border, top, least)
    lossless = border.boundary.lossless
    if found is not None and abs(found.beta - lossless) <= _ON_ROW * border.width:
        # At exactly this damping no wall decays. With the rounding error of the corner some would appear to decay.
        found = found._replace(beta=lossless)
    highest = border.find_highest(least)
    if highest > (0.0 if found is None else found.alpha) * (1.0 + _ABOVE):
        raise ArithmeticError(f"rows reach {highest!r}, the ridge {found!r}")
    return found


class _Top(NamedTuple):
    """A local maximum of the edges: which column of a row's crossings it is on, and whether it lies inside its edge."""

    alpha: float
    beta: float
    w: float
    column: int
    inner: bool


def _tops(border: Border, least: float) -> Iterator[_Top]:
    """Local maxima of the edges of pieces with soft walls, with beta of ``least`` or more."""
    edges = border.soft_edges(least)
    for edge in edges:
        padded = np.pad(np.where(edge.beta >= least, edge.alpha, -np.inf), 1, constant_values=-np.inf)
        alpha, last = padded[1:-1], edge.w.size - 1
        for k in np.flatnonzero((alpha >= padded[:-2]) & (alpha >= padded[2:]) & (alpha > 0)):
            yield _Top(float(alpha[k]), float(edge.beta[k]), float(edge.w[k]), edge.column, bool(0 < k < last))
    if np.isfinite(least):
        # Where edges pass the least damping.
        row = border.boundary.crossings(np.array([least]))
        for edge in edges:
            high, w = float(row.alpha[0, edge.column]), float(row.w[0, edge.column])
            if edge.beta[0] <= least and high > 0:
                yield _Top(high, least, w, edge.column, False)


def _is_reached(border: Border, top: _Top, least: float) -> bool:
    """Whether a row next to a top is stable nearly up to it."""
    size = border.width + abs(top.beta)
    found = bound_intervals(border.boundary, np.maximum(top.beta + size * _BESIDE, least))
    own = (found.above == top.column) | (found.below == top.column)
    return bool(np.any(own & (found.high >= _NEARLY * top.alpha)))


def _describe(border: Border, top: _Top, least: float) -> BoundRidge:
    alpha, beta, w = top[:3]
    if beta == least:
        return BoundRidge(alpha, beta, w, w, _condition(w), Condition.NO_DAMPING)
    if top.inner:
        return BoundRidge(alpha, beta, w, w, Condition.PAIR, Condition.STATIONARY)
    return _corner(border, alpha, beta)


def _condition(w: float) -> Condition:
    if w == 0.0:
        return Condition.PLUS_ONE
    return Condition.MINUS_ONE if w == np.pi else Condition.PAIR


def _corner(border: Border, alpha: float, beta: float) -> BoundRidge:
    """The two conditions that meet at a corner."""
    # By Newton's method on rows: an edge's end is as far off, beside an undamped mode, as a digit of its angle tells.
    (w, other), heights, slopes, step = _nearest_two(border.boundary, alpha, beta)
    for _ in range(_STEPS):
        if not _ARRIVED * abs(beta) < abs(step) <= _NEAR * abs(beta):
            break
        alpha, beta = heights[0] + slopes[0] * step, beta + step
        (w, other), heights, slopes, step = _nearest_two(border.boundary, alpha, beta)
    w, other = sorted((w, other))
    # Of the place in beta the flatter one makes the less of alpha.
    apart, missed = abs(slopes[0] - slopes[1]), abs(heights[1] - heights[0]) / abs(alpha)
    flat = min(1.0, min(map(abs, slopes)) / apart) if apart > 0 else 1.0
    if abs(step) <= _NEAR * (border.width + abs(beta)) and flat * missed <= _MEETS and other - w > 1e-6:
        return BoundRidge(alpha, beta, w, other, _condition(w), _condition(other))
    # A double pole at z = -1, or at z = 1 of a device that moves against its force: the curve ends on the line there.
    for w in (np.pi, 0.0):
        top, damping = border.boundary.limits[w]
        if abs(top - alpha) <= _NEAR * abs(alpha):
            return BoundRidge(top, damping, w, w, _condition(w), Condition.STATIONARY)
    raise ArithmeticError(f"no two conditions meet at alpha = {alpha!r}, beta = {beta!r}")


def _nearest_two(b: Boundary, alpha: float, beta: float) -> tuple[list[float], list[float], list[float], float]:
    """Angles of a row's two crossings nearest to a wall, their alphas, these' slopes in beta, and how far they meet."""
    found = b.crossings(np.array([beta]))
    away = np.abs(found.alpha[0] - alpha)
    near = np.resize(np.argsort(np.where(np.isnan(away), np.inf, away))[:2], 2)
    here = curve_at(b.loop, found.w[0, near])
    with np.errstate(all="ignore"):
        slopes = here.alpha_slope * here.fall**2 / here.turn
    for k in np.flatnonzero(near >= len(b.arcs)):
        slopes[k] = -b.lines[near[k] - len(b.arcs)].f
    heights = found.alpha[0, near]
    step = (heights[1] - heights[0]) / ((slopes[0] - slopes[1]) or np.inf)
    return found.w[0, near].tolist(), heights.tolist(), slopes.tolist(), float(step)


def _conditions(loop: LoopRoots, wall: BoundRidge) -> tuple[np.ndarray, list[int]]:
    """How what binds a wall moves with what may of alpha, beta, w1 and w2, and which of five conditions that is."""
    # Of ``r = alpha + beta F - q``: Re and Im at w1, the same at w2, and Im dr/dw at w1, where w stays. At a smooth
    # optimum the angle may stay where it is: to first order it does not matter.
    at = circle(np.array([wall.w1, wall.w2]))
    with np.errstate(all="ignore"):
        q, f = loop.required_wall(at), loop.estimate.jet(at)
        slope = wall.beta * f.slope - q.slope
    matrix = np.zeros((5, 4))
    matrix[[0, 2], 0] = 1.0
    matrix[:, 1] = _list_conditions(f.value, f.slope)
    matrix[:2, 2], matrix[2:4, 3] = _list_conditions(slope, slope)[:4].reshape(2, 2)
    pair = wall.first == Condition.PAIR, wall.second == Condition.PAIR
    rows, columns = [0, 1] if pair[0] else [0], [0]
    if wall.second != Condition.NO_DAMPING:
        columns.append(1)
    if wall.second <= Condition.PLUS_ONE:
        rows += [2, 3] if pair[1] else [2]
    elif wall.second == Condition.STATIONARY and not pair[0]:
        rows.append(4)
    if wall.second != Condition.STATIONARY:
        columns += [2 + k for k in range(2) if pair[k]]
    return matrix[np.ix_(rows, columns)], rows


def _list_conditions(rest: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """The five parts of r and dr/dw, or of what moves them, at two angles."""
    return np.array([rest[0].real, rest[0].imag, rest[1].real, rest[1].imag, slope[0].imag])


# The step of a difference, as a share of the parameter; its sixth power is rounding. And that of an imaginary step.
_STEP, _TINY = 1e-3, 1e-30
# A parameter below this share of its unit is next to 0: in steps of its own size rounding ate up to 3e-6 of a slope.
_NEXT_TO_NOTHING = 1e-5
# Weights of the differences: around a value, and from it on.
_CENTRAL = [(-3, -1 / 60), (-2, 3 / 20), (-1, -3 / 4), (1, 3 / 4), (2, -3 / 20), (3, 1 / 60)]
_ONE_SIDED = [-49 / 20, 6.0, -15 / 2, 20 / 3, -15 / 4, 6 / 5, -1 / 6]
# By what share G may differ by its matrices and by its roots.
_AGREES = 1e-8


@shown()
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
    per = {path: find_slope(scene, found, path) for path in paths}
    status = Status.NOT_CONVERGED if any(math.isnan(slope) for slope in per.values()) else status
    return SceneSensitivities(np.float64(found.alpha * scene.units.stiffness), per, np.int32(status))


def moving_paths(scene: Any) -> tuple[str, ...]:
    """The parameters of a scene, without the wall's, that K_max can be differentiated in."""
    paths = [path for path, value in scene.parameters().items() if not isinstance(value, int | np.integer)]
    rigid = scene.operator is not None and scene.operator.rigid
    without = (*WALL, "operator.coupling_damping") if rigid else WALL
    return tuple(path for path in paths if path not in without)


def find_slope(scene: Any, found: BoundRidge, path: str) -> float:
    """The derivative of K_max in one parameter: as it moves, the conditions that bind go on to hold (V21)."""
    matrix, rows = _conditions(scene.loop.roots, found)
    at = circle(np.array([found.w1, found.w2]))
    # Longer periods are fewer in a delay: from a whole number of them on, a fraction of one less.
    whole = scene.whole_delay - (path == "period" and scene.d == scene.whole_delay > 0)
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
        q, q_slope = _needed_slopes(scene, whole, at, by_rate, by_push, by_delay)
        rest, slope = found.beta * by_f - q, found.beta * by_f_slope - q_slope
        try:
            by_alpha = -np.linalg.solve(matrix, _list_conditions(rest, slope)[rows])[0]
        except np.linalg.LinAlgError:
            break
        return float(scene.units.stiffness * by_alpha + found.alpha * by_unit)
    return math.nan


def _inputs(scene: Any, whole: int, at: CirclePoints) -> tuple[Any, ...]:
    """What K_max depends on a parameter through: the unit of stiffness, the delay, the rates of the chain, F and F'."""
    delay = scene.timing.delay / scene.timing.period
    chain = chain_of(scene, (delay, whole))
    if chain.sampled:
        # Its period is that of the loop.
        chain.check()
    return (scene.units.stiffness, delay, *chain.realize()[:2], *chain.estimate.jet(at))


def _needed_slopes(
    scene: Any, whole: int, at: CirclePoints, by_rate: np.ndarray, by_push: np.ndarray, by_delay: float
) -> tuple[np.ndarray, np.ndarray]:
    """The derivatives of ``q = -1/G`` and of dq/dw in a parameter, by those of the chain's rates and of the delay."""
    # NaN where G by the matrices of the chain is not G by its roots: then rounding has eaten what they tell.
    chain = scene.loop.chain
    # An imaginary step so short that its square is nothing is a derivative without a difference, here of e^A.
    rate, push = (value + 1j * _TINY * by for value, by in zip(chain.realize(), (by_rate, by_push), strict=False))
    fraction = chain.d - whole + 1j * _TINY * by_delay
    steps = (*hold(chain, rate, push, 1.0), hold(chain, rate, push, 1.0 - fraction)[1])
    (psi, full, late), (by_psi, by_full, by_late) = ([f(x) for x in steps] for f in (np.real, lambda x: x.imag / _TINY))
    turns, slopes = whole + 1, np.full((2, at.w.size), complex(np.nan, np.nan))
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
