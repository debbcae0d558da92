"""Stability of a virtual coupling to a tool that a physics engine integrates only every N periods.

The *coupling* between device and tool has the normalized stiffness alpha and damping beta. The loop is periodic with
the period N T. Its poles are the eigenvalues of the *monodromy matrix*, which maps the state of the loop to the state N
periods later (`zwidth.stability.linear.slow_tool`). The stable couplings are found from samples of the spectral radius:
on geometric grids along a line of constant alpha or beta, and on a grid in the plane of both for the stiffest coupling.
Crossings of 1 between samples are refined. Methods that need the stability boundary as a curve, such as those for
margins, islands and derivatives, raise `InputError`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import ClassVar

import numpy as np

from zwidth.analysis.loop import DominantMode, LinearLoop
from zwidth.core.errors import InputError
from zwidth.core.status import Method, RidgeKind, Status
from zwidth.core.types import Array
from zwidth.core.xp import nan_beyond
from zwidth.numerics.evaluate import check_scalars
from zwidth.numerics.root_finding import find_zeros_in_brackets
from zwidth.stability.linear.regions import Outline
from zwidth.stability.linear.roots import LoopRoots
from zwidth.stability.linear.rows import Island
from zwidth.stability.linear.slow_tool import SlowToolModel
from zwidth.stability.results import DominantPole, RidgePoint, Stability
from zwidth.stability.rigid.normalization import wall_status
from zwidth.stability.rigid.verdict import StabilityMethod
from zwidth.units.quantities import WALL_RANGE

# Grids of alpha and beta. Their *scales* are alpha and beta of the stiffest wall of the device without a tool.
LOWEST, HIGHEST = 1e-7, 1e3  # ends of the range of alpha and beta, relative to their scales
# Lower end of both ranges for a light tool of mass M, relative to M/(m N^2) with the mass m of the device
LIGHT_TOOL = 1e-4
PER_DECADE_ON_LINE = 24  # points per decade on a line of constant alpha or beta
INSERTED = 12  # points inserted at each extremum of the spectral radius near 1, which may hide two crossings of 1
INSERTIONS = 2  # largest number of passes that insert such points
PER_DECADE = 8  # points per decade of the first grid in the plane of alpha and beta
FINE_DECADES, FINE_PER_DECADE = 2, 32  # decades of the fine grid, below the largest stable alpha; points per decade
POINTS_PER_PERIOD, MIN_POINTS, MAX_POINTS = 12, 96, 256  # 12 N values of beta on the fine grid, from 96 to 256
SUMMITS = 3  # number of local maxima of the fine grid, the highest ones, that are refined

# Refinement of a local maximum of alpha in a window of alpha and beta
ROWS, COLUMNS = 12, 17  # points of alpha and of beta in the window
FIRST_HEIGHT = 0.1  # height of the first window, relative to alpha
SHRINK_HEIGHT, SHRINK_WIDTH = 1 / 3, 0.5  # factors by which height and width of the window shrink
MAX_ZOOMS = 300  # largest number of windows
CLOSE = 1e-13  # size of the last window, relative to alpha and beta
SAME_MODULUS = 1e-6  # poles z with |log|z|| below this (per N periods) count as poles on the unit circle


class SlowToolLoop(LinearLoop):
    """Loop of a scene with a tool that makes one step every N > 1 periods; see `LinearLoop` for the methods."""

    has_boundary: ClassVar[bool] = False

    @cached_property
    def model(self) -> SlowToolModel:
        """State-space model of the loop, which yields the monodromy matrix of each coupling."""
        scene = self.scene
        return SlowToolModel.build(self.chain, scene.tool.compute_step(float(scene.mass), float(scene.timing.period)))

    @cached_property
    def roots(self) -> LoopRoots:
        """Poles and zeros of the loop without a wall; access raises `InputError`, because a periodic loop has none."""
        raise InputError(
            f"tool.every: got {self.scene.tool.every}, but this result is available only for every = 1; for a slow "
            "tool, choose K and B by the spectral radius and the stable intervals, which zwidth check prints"
        )

    @cached_property
    def poles_sought(self) -> int:
        return len(self.model.drift)

    def _compute_logs(self, alpha: Array, beta: Array) -> Array:
        """Return ``log|z|`` of the dominant pole z over N periods for couplings (alpha, beta), which are broadcast."""
        alpha, beta = np.broadcast_arrays(alpha, beta)
        return self.model.compute_multipliers(alpha.reshape(-1), beta.reshape(-1))[1].reshape(alpha.shape)

    def labels(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        check_scalars({"alpha": alpha, "beta": beta})
        return (self._compute_logs(*nan_beyond(WALL_RANGE, alpha, beta)) < 0)[()]

    def decide(
        self, alpha: np.ndarray, beta: np.ndarray, method: StabilityMethod, exact: tuple[np.ndarray, np.ndarray]
    ) -> Stability:
        if method not in ("auto", "companion"):
            raise InputError(f"method: got {method!r} with tool.every = {self.model.every}; use 'companion'")
        status = wall_status(alpha, beta, np.float64(0.0), np.float64(0.0))
        logs = self._compute_logs(*nan_beyond(WALL_RANGE, alpha, beta))
        # With alpha = 0, a pole may be at exactly z = 1 (device and tool drift apart); the coupling is then unstable.
        doubtful = (logs == 0) & (np.asarray(alpha) != 0)
        status = np.where((status == Status.OK) & doubtful, np.int32(Status.ON_BOUNDARY), status)
        status = np.where((status == Status.OK) & np.isnan(logs), np.int32(Status.NOT_CONVERGED), status)
        stable = logs < 0
        return Stability(stable[()], status[()], np.full(stable.shape, Method.COMPANION, np.int32)[()])

    def poles(self, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        walls = np.broadcast_arrays(*nan_beyond(WALL_RANGE, alpha, beta))
        multipliers = self.model.compute_multipliers(*(values.reshape(-1) for values in walls))[0]
        return 1.0 + multipliers.reshape(*walls[0].shape, -1)

    def radius(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        return np.exp(self._compute_logs(*nan_beyond(WALL_RANGE, alpha, beta)) / self.model.every)[()]

    def dominant_poles(self, alpha: np.ndarray, beta: np.ndarray) -> DominantPole:
        status = wall_status(alpha, beta, np.float64(0.0), np.float64(0.0))
        walls = np.broadcast_arrays(*nan_beyond(WALL_RANGE, alpha, beta))
        multipliers, logs = self.model.compute_multipliers(*(values.reshape(-1) for values in walls))
        index = np.argmax(np.nan_to_num(np.abs(1.0 + multipliers), nan=-1.0), -1)
        dominant = 1.0 + multipliers[np.arange(len(index)), index]
        every = self.model.every
        logs = logs.reshape(walls[0].shape) / every
        angle = np.abs(np.angle(dominant)).reshape(walls[0].shape) / every
        failed = (status == Status.OK) & np.isnan(logs + angle)
        status = np.where(failed, np.int32(Status.NOT_CONVERGED), status)
        return DominantPole(np.exp(logs)[()], angle[()], -logs[()], status[()])

    def find_dominant(self, alpha: float, beta: float) -> DominantMode:
        pole = self.dominant_poles(np.array([alpha]), np.array([beta]))
        radius, angle, rate = (float(values[0]) for values in pole[:3])
        if rate == 0:
            return DominantMode(True, 1.0, 0.0, angle)
        return DominantMode(False, radius, rate, angle)

    @cached_property
    def _grids(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Smallest and largest positive alpha, and smallest and largest positive beta, of the search grids."""
        wall = LinearLoop(self.scene.replace(tool=None)).stiffest(False)
        alpha = float(wall.alpha) if wall.status == Status.OK and wall.alpha > 0 else 1.0
        beta = max(alpha, float(wall.beta)) if np.isfinite(wall.beta) else alpha
        # Start the grids far below 4 M/(m N^2), the largest stable alpha of a tool of mass M on a fixed device.
        light = LIGHT_TOOL / self.model.gain
        return (
            (min(LOWEST * alpha, light), HIGHEST * alpha),
            (min(LOWEST * beta, light * self.model.every), HIGHEST * beta),
        )

    def find_stable_alpha(self, beta: np.ndarray) -> np.ndarray:
        (beta,) = nan_beyond(WALL_RANGE, beta)
        lines = [
            find_intervals(lambda alpha, b=b: self._compute_logs(alpha, b), self._grids[0])
            for b in beta.reshape(-1).tolist()
        ]
        result = np.full((len(lines), max(map(len, lines), default=0), 2), np.nan)
        for row, intervals in zip(result, lines, strict=True):
            row[: len(intervals)] = np.reshape(intervals, (-1, 2))
        return result

    def find_stable_beta(self, alpha: float) -> np.ndarray:
        (stiffness,) = nan_beyond(WALL_RANGE, np.float64(alpha))
        intervals = find_intervals(lambda beta: self._compute_logs(stiffness, beta), self._grids[1])
        return np.reshape(np.array(intervals, float), (-1, 2))

    def least_stiffness(self, least: float) -> None:
        """Return None, because the smallest stable stiffness of a device that is unstable without a wall is unknown."""

    def islands(self, least: float) -> list[Island]:
        _ = self.roots
        return []

    def outlines(self) -> list[Outline]:
        _ = self.roots
        return []

    def stiffest(self, negative: bool) -> RidgePoint:
        if negative:
            raise InputError(f"negative_damping: must be False with tool.every = {self.model.every}; omit it")
        summits, nan = self._find_summits(), np.float64(np.nan)
        alpha, beta, converged = max([self._climb(*window) for window in summits or []], default=(0.0, 0.0, False))
        if not converged:
            status = Status.NO_BOUNDARY if summits == [] else Status.NOT_CONVERGED
            return RidgePoint(nan, nan, nan, np.int32(RidgeKind.NONE), np.int32(status))
        inside = np.float64(alpha * (1.0 - 10.0 * CLOSE))
        if self._compute_logs(inside, np.float64(0.0)) < 0:
            alpha, beta = float(inside), 0.0
        multipliers = self.model.compute_multipliers(np.array([alpha]), np.array([beta]))[0][0]
        poles = 1.0 + multipliers[multipliers.imag >= 0]
        poles = poles[np.argsort(-np.abs(poles))[:2]]
        on_circle = np.abs(np.log(np.abs(poles))) < SAME_MODULUS
        kind = RidgeKind.NO_DAMPING if beta == 0 else RidgeKind.CORNER if on_circle.sum() == 2 else RidgeKind.SMOOTH
        omega = np.angle(poles[: max(on_circle.sum(), 1)]).max() / self.model.every
        return RidgePoint(np.float64(alpha), np.float64(beta), omega, np.int32(kind), np.int32(Status.OK))

    def _find_summits(self) -> list[tuple[float, float, float, float]] | None:
        """Return the highest local maxima of the largest stable alpha as a function of beta, found on a grid.

        Each maximum is a tuple (alpha, beta, height, width), the arguments of `_climb`. A stable alpha counts only if
        stable grid points connect it to the softest stable couplings. The list is empty if no coupling is stable. The
        result is None if the stable couplings reach the largest alpha of the grid.
        """
        from scipy.ndimage import label

        (low, high), (least, most) = self._grids
        alpha, beta = space(low, high, PER_DECADE), np.append(0.0, space(least, most, PER_DECADE))
        stable = self._compute_logs(alpha[:, None], beta) < 0
        if not stable.any():
            return []
        # Use a fine grid for stiff couplings, because the device may oscillate N/2 times per step of the tool.
        top = np.flatnonzero(stable.any(1))[-1]
        if top == alpha.size - 1:
            return None
        fine = alpha[max(top + 1 - FINE_DECADES * PER_DECADE, 0)], alpha[top + 1]
        widest = beta[min(np.flatnonzero(stable[alpha >= fine[0]].any(0)).max(initial=0) + 1, beta.size - 1)]
        count = int(np.clip(POINTS_PER_PERIOD * self.model.every, MIN_POINTS, MAX_POINTS))
        alpha = np.append(alpha[alpha < fine[0]], space(*fine, FINE_PER_DECADE))
        beta = np.union1d(beta, np.linspace(0.0, widest, count))
        logs = self._compute_logs(alpha[:, None], beta)
        pieces, _ = label(logs < 0)
        softest = pieces[np.flatnonzero(pieces.any(1))[0]]
        tops = np.pad(self._refine_tops(alpha, beta, logs, np.isin(pieces, softest[softest > 0])), 1)
        summits = np.flatnonzero((tops[1:-1] >= tops[:-2]) & (tops[1:-1] > tops[2:]))
        summits = summits[np.argsort(-tops[1 + summits])][:SUMMITS]
        widths = np.maximum(np.diff(beta, prepend=beta[0]), np.diff(beta, append=beta[-1]))
        tops = tops[1:-1]
        return [
            (float(tops[k]), float(beta[k]), FIRST_HEIGHT * float(tops[k]), float(widths[k])) for k in summits.tolist()
        ]

    def _refine_tops(self, alpha: Array, beta: Array, logs: Array, counted: Array) -> Array:
        """Return, for each beta, the largest stable alpha, refined between the points of a grid.

        This alpha is the upper end of the stable interval that contains the largest counted grid point. The result is 0
        for a beta without a counted grid point.

        Args:
            alpha: rows of a grid.
            beta: columns of the grid.
            logs: ``log|z|`` of the dominant pole on the grid.
            counted: True for the stable grid points that count (see `_find_summits`).
        """
        last = alpha.size - 1 - np.argmax(counted[::-1], 0)
        tops = np.where(counted.any(0), alpha[last], 0.0)
        column = np.flatnonzero(counted.any(0) & (last < alpha.size - 1))
        k = last[column]
        ends = alpha[k], alpha[k + 1], logs[k, column], logs[k + 1, column]
        tops[column] = find_zeros_in_brackets(lambda x: self._compute_logs(x, beta[column]), *ends)
        return tops

    def _climb(self, alpha: float, beta: float, height: float, width: float) -> tuple[float, float, bool]:
        """Climb from a stable coupling to a local maximum of alpha among the stable couplings.

        Args:
            alpha: alpha of the first coupling.
            beta: beta of the first coupling.
            height: height of the first search window, above ``alpha``.
            width: half the width of the first search window, around ``beta``.

        Returns:
            alpha and beta at the maximum, and True if the search converged.
        """
        highest, widest = height, width
        for _ in range(MAX_ZOOMS):
            rows, columns = np.linspace(alpha, alpha + height, ROWS), beta + width * np.linspace(-1.0, 1.0, COLUMNS)
            logs = self._compute_logs(rows[:, None], np.maximum(columns, 0.0))
            # Stay below the first row without stable couplings, because rows above it may belong to another region.
            row = max(int(np.argmin(np.append((logs < 0).any(1)[1:], False))), 0)
            column = int(np.argmin(logs[row]))
            alpha, beta = float(rows[row]), max(float(columns[column]), 0.0)
            # Enlarge the window if the best coupling is at its edge, because the maximum may be outside. Else shrink.
            at_side = column in (0, COLUMNS - 1) and columns[column] > 0
            if row == ROWS - 1:
                height = min(height / SHRINK_HEIGHT, highest)
            elif not (at_side and row):
                height *= SHRINK_HEIGHT
            if at_side and row:
                width = min(width / SHRINK_WIDTH, widest)
            elif not (at_side or row == ROWS - 1):
                width *= SHRINK_WIDTH
            if height <= CLOSE * alpha and width <= CLOSE * max(beta, widest):
                return alpha, beta, True
        return alpha, beta, False


def space(low: float, high: float, per_decade: int) -> Array:
    """Return a geometric grid from ``low`` to ``high`` with at least ``per_decade`` points per decade."""
    return np.geomspace(low, high, int(np.ceil(np.log10(high / low) * per_decade)) + 1)


def find_intervals(evaluate: Callable[[Array], Array], ends: tuple[float, float]) -> list[tuple[float, float]]:
    """Return the intervals in which a function of one variable is negative, in ascending order.

    The function is sampled at 0 and on geometric grids of positive and of negative values. Points are inserted at local
    extrema that may hide two crossings of zero.

    Args:
        evaluate: the function.
        ends: smallest and largest magnitude of the samples. An interval is unbounded if it contains the sample of the
            largest magnitude.
    """
    sides = [_find_on_side(partial(_mirror, evaluate, sign), ends) for sign in (-1.0, 1.0)]
    negative, positive = [(-high, -low) for low, high in reversed(sides[0])], sides[1]
    if negative and positive and negative[-1][1] == 0 == positive[0][0] and evaluate(np.zeros(1))[0] < 0:
        return [*negative[:-1], (negative[-1][0], positive[0][1]), *positive[1:]]
    return [*negative, *positive]


def _mirror(evaluate: Callable[[Array], Array], sign: float, x: Array) -> Array:
    """Return the value of a function at ``sign * x``."""
    return evaluate(sign * x)


def _find_on_side(evaluate: Callable[[Array], Array], ends: tuple[float, float]) -> list[tuple[float, float]]:
    """Return the intervals of x > 0 in which a function is negative; the first interval may begin at 0."""
    x = space(*ends, PER_DECADE_ON_LINE)
    values = evaluate(x)
    for _ in range(INSERTIONS):
        rises, stable = np.diff(values) > 0, values[1:-1] < 0
        hidden = 1 + np.flatnonzero(np.where(stable, rises[:-1] & ~rises[1:], ~rises[:-1] & rises[1:]))
        if not hidden.size:
            break
        new = np.concatenate([np.linspace(x[k - 1], x[k + 1], INSERTED + 2)[1:-1] for k in hidden.tolist()])
        new = np.setdiff1d(new, x)
        order = np.argsort(np.append(x, new))
        x, values = np.append(x, new)[order], np.append(values, evaluate(new))[order]
    stable = np.pad(values < 0, 1)
    first, last = np.flatnonzero(np.diff(stable.astype(int)) > 0), np.flatnonzero(np.diff(stable.astype(int)) < 0) - 1
    low, high = np.zeros(first.size), np.full(last.size, np.inf)
    for edge, inside, outside in ((low, first, first - 1), (high, last, last + 1)):
        k = np.flatnonzero((outside >= 0) & (outside < x.size))
        a, b = np.minimum(inside, outside)[k], np.maximum(inside, outside)[k]
        edge[k] = find_zeros_in_brackets(evaluate, x[a], x[b], values[a], values[b])
    return list(zip(low.tolist(), high.tolist(), strict=True))
