"""Least squares of logged positions: mass, damping and delay, and with them a constant force and friction.

The two are always sought. A fit without them has smaller errors, but holds the device only where they are 0 indeed, and
a log that hardly shows them cannot tell: left out by a criterion, they moved damping by up to 179 standard errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zwidth.fitting.encoder import MeasurementNoise
from zwidth.fitting.moving import PARTS, Recording, Recordings

# Dampings b T/m that are started from, how far delays of starts lie apart, in periods, and how many of the best.
_DELTAS, _APART, _STARTS = (3e-4, 3e-3, 0.02, 0.1, 0.4, 1.5, 5.0), 2, 3
# Friction as shares of the largest force that are followed from below, by so many steps each; how many are kept; and
# the least that is looked for, for at 0 its slope is not seen.
_FRICTIONS, _FOLLOWED, _LEVELS, LEAST = np.geomspace(1e-3, 0.5, 8), 3, 3, 1e-12
# So many positions of each log choose the starts, and so many the best of these.
_GLIMPSE, _BEGINNING = 1200, 2500
# Promised reductions of the squares that end the search, end it among starts, and excuse a corner; steps; how they are
# damped.
_ARRIVED, _CLOSE, _NEARLY, _STEPS = 1e-12, 1e-9, 1e-6, 100
_EASY, _LIGHT, _STUBBORN = 1e-4, 1e-6, 1e12
# Standard deviations of the noise that a slide is lost in.
_WITHIN = 3.0
# Columns worse conditioned than this do not tell the numbers apart; a relative error this small is rounding.
_BLIND, _ROUNDING = 1e7, 1e-13
# Sums of residuals that noise alone exceeds so rarely are of something else.
_CHANCE = 1e-3


@dataclass(frozen=True)
class FittedModel:
    """A model at its least squares."""

    model: Recordings
    theta: np.ndarray
    squares: float
    arrived: bool
    resolution: float

    @property
    def count(self) -> int:
        """How many positions it was fitted to."""
        return self.model.measured.size

    @cached_property
    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and their derivatives in theta."""
        return self.model.predict(self.theta)

    @cached_property
    def residuals(self) -> np.ndarray:
        """Measured less modelled."""
        return self.model.measured - self.moved[0]

    @property
    def variance(self) -> float:
        """Of the noise of a position."""
        return self.squares / max(1, self.count - self.theta.size)

    @property
    def noise(self) -> MeasurementNoise:
        """That of its positions; at rest, x0 takes up an encoder's error, and the residuals show less than there is."""
        return MeasurementNoise(self.moved[0], max(self.variance, self.resolution**2 / 12.0), self.resolution)

    @cached_property
    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """The derivatives, each of size 1 or, as that in the v0 of a mass that sticks, 0; and their sizes."""
        sizes = np.linalg.norm(self.moved[1], axis=0)
        sizes = np.where(sizes > 0, sizes, 1.0)
        return self.moved[1] / sizes, sizes

    @cached_property
    def inverse(self) -> tuple[np.ndarray, np.ndarray]:
        """The pseudo-inverse of the columns, and which numbers the positions leave open."""
        left, values, right = np.linalg.svd(self.columns[0], full_matrices=False)
        blind = values * _BLIND < values[0]
        inverse = right[~blind].T / values[~blind] @ left[:, ~blind].T
        return inverse, np.any(np.abs(right[blind]) > _BLIND**-0.5, axis=0)

    @property
    def conditioned(self) -> bool:
        """Whether the positions tell mass, damping and delay."""
        return not self.inverse[1][:3].any()

    def step_beyond(self, k: int) -> float:
        """Where the least squares of what is held at its bound would lie, in standard errors from there."""
        step = self.inverse[0][k] @ self.residuals / self.columns[1][k]
        return float(step / np.sqrt(self.covariance[k, k]))

    @property
    def leaves_open(self) -> bool:
        """Whether the positions do not tell friction from a constant force."""
        return bool(self.inverse[1][-2:].all())

    def explains_as_well(self, other: FittedModel) -> bool:
        """Whether another model leaves less by no more than one number more would by chance, or than rounding."""
        floor = self.count * (_ROUNDING * float(np.abs(self.model.measured).max())) ** 2
        ratio = max(self.squares, floor) / max(other.squares, floor)
        return self.count * np.log(ratio) < np.log(self.count)

    @cached_property
    def excess(self) -> float:
        """By how much sums of neighboring residuals spread more than those of such noise; 1 where chance explains it.

        Over twice the cube root of the samples, as usual for errors of unknown kinship (Newey, West 1987).
        """
        from scipy.special import chdtri

        size = int(2 * np.ceil(self.count ** (1 / 3)))
        starts = np.arange(0, self.count - size + 1, size)
        sums = np.add.reduceat(self.residuals[: starts[-1] + size], starts)
        expected = self.noise.spread_of_sums(size)
        if not expected > 0:
            return 1.0
        found = float(np.mean(sums**2)) / expected
        return found if found * starts.size > chdtri(starts.size, _CHANCE) else 1.0

    @cached_property
    def covariance(self) -> np.ndarray:
        """Of theta: exact slopes, the encoder's correlated errors, and what else spreads the residuals; NaN if open."""
        columns, sizes = self.columns
        # Not by the products of columns, which keep half of the digits.
        inverse, blind = self.inverse
        triangle = inverse @ inverse.T
        whole = self.excess * (triangle @ self.noise.spread(columns) @ triangle) / np.outer(sizes, sizes)
        whole[blind], whole[:, blind] = np.nan, np.nan
        return whole


def fit_model(recordings: tuple[Recording, ...], longest: float, resolution: float) -> FittedModel:
    """The device of the least squares, with a constant force and friction."""
    model = Recordings(recordings, PARTS)
    pushed = _choose(Recordings(recordings, PARTS[:1]), _start(recordings, longest), longest)
    # The least friction that is looked for, behind a theta without.
    pushed = np.append(pushed, LEAST * abs(pushed[0]) * find_largest(model))
    both = _fit(model, _choose(model, _start_rubbing(model, pushed, longest), longest), longest, resolution)
    # A mass that slides one way only and then rests: how much is of which stays open, and one of them is none.
    rubbed = both.theta.copy()
    rubbed[-2:] = 0.0, rubbed[-1] + abs(rubbed[-2])
    for theta, none in ((rubbed, rubbed.size - 2), (pushed, rubbed.size - 1)):
        simple = _fit(model, theta, longest, resolution, (none,))
        if simple.leaves_open and simple.explains_as_well(both):
            return simple
    return both


def find_largest(model: Recordings) -> float:
    """The largest force commanded."""
    return max(float(np.abs(log.force).max()) for log in model.logs)


def _start(recordings: tuple[Recording, ...], longest: float) -> list[np.ndarray]:
    """The best of a grid over damping and delay, where the rest is linear; by the beginnings of the logs."""
    model = Recordings(tuple(log.begin(_GLIMPSE) for log in recordings), PARTS[:1])
    grid = [(squares, delta, d) for delta in _DELTAS for d, squares in enumerate(model.try_delays(delta, longest))]
    starts: list[tuple[float, int]] = []
    for _, delta, d in sorted(grid):
        if all(abs(d - other) > _APART or delta != of for of, other in starts):
            starts.append((delta, d))
    return [model.project(*start) for start in starts[:_STARTS]]


def _start_rubbing(model: Recordings, pushed: np.ndarray, longest: float) -> list[np.ndarray]:
    """Next to no friction, and the best of ever more friction, each found from the one before."""
    model = Recordings(tuple(log.begin(_BEGINNING) for log in model.logs), PARTS)
    theta, largest = pushed, find_largest(model)
    found = [(float(np.sum((model.measured - model.predict(theta)[0]) ** 2)), theta)]
    for share in _FRICTIONS:
        theta = theta.copy()
        theta[-1] = abs(theta[0]) * largest * share
        theta, squares, _ = _refine(model, theta, longest, (theta.size - 1,), _FOLLOWED)
        found.append((squares, theta))
    return [theta for _, theta in sorted(found, key=lambda start: start[0])[:_LEVELS]]


def _choose(model: Recordings, starts: list[np.ndarray], longest: float) -> np.ndarray:
    """The start that leads to the least squares of the logs' beginnings, and where it leads to, nearly."""
    first = Recordings(tuple(log.begin(_BEGINNING) for log in model.logs), model.parts)
    found = (_refine(first, start, longest, (), arrived=_CLOSE) for start in starts)
    return min(found, key=lambda found: found[1])[0]


def _fit(
    model: Recordings, start: np.ndarray, longest: float, resolution: float, held: tuple[int, ...] = ()
) -> FittedModel:
    """Least squares from a start, or at rest where that is as good."""
    best = _settle(model, start, longest, held)
    still = _rest(model, *best[:2])
    if still is not None:
        resting = _settle(model, still, longest, held)
        # A start at rest needs one number less.
        count = model.measured.size
        if not best[2] or count * np.log(resting[1] / best[1]) < np.log(count):
            best = resting
    return FittedModel(model, *best, resolution)


def _settle(
    model: Recordings, start: np.ndarray, longest: float, held: tuple[int, ...] = ()
) -> tuple[np.ndarray, float, bool]:
    """As `_refine`, with neither damping nor delay negative."""
    best = _refine(model, start, longest, held)
    while any(best[0][k] < 0 for k in (1, 2)):
        negative = tuple(k for k in (1, 2) if best[0][k] < 0)
        best[0][list(negative)] = 0.0
        held = (*held, *negative)
        best = _refine(model, best[0], longest, held)
    return best


def _rest(model: Recordings, theta: np.ndarray, squares: float) -> np.ndarray | None:
    """Without the first speeds that friction stops within the noise: they hardly move the positions; None without any.

    Beside such a speed the position's derivative is next to 0, and steps towards the best one hardly end.
    """
    speeds = 4 + 2 * np.arange(len(model.logs))
    if PARTS[1] not in model.parts or not theta[-1] > 0:
        return None
    slid = theta[speeds] ** 2 / (2.0 * theta[-1])
    idle = (slid > 0) & (slid < _WITHIN * np.sqrt(squares / model.measured.size))
    still = theta.copy()
    still[speeds[idle]] = 0.0
    return still if idle.any() else None


def _refine(
    model: Recordings,
    start: np.ndarray,
    longest: float,
    held: tuple[int, ...],
    most: int = _STEPS,
    arrived: float = _ARRIVED,
) -> tuple[np.ndarray, float, bool]:
    """Levenberg and Marquardt's steps within bounds: theta, the sum of squares, and whether it is the least.

    What is ``held`` stays as it starts.
    """
    count = max(log.force.size for log in model.logs)
    low, high = np.full(start.size, -np.inf), np.full(start.size, np.inf)
    # A little beyond 0 the model goes on, so that an optimum at 0 is no corner.
    low[1], low[2], high[1], high[2] = -5.0 / count, -1.0, 50.0, longest
    if PARTS[1] in model.parts:
        low[-1] = LEAST * abs(start[0]) * find_largest(model)
    low[list(held)] = high[list(held)] = start[list(held)]
    theta, measured, damping = np.clip(start, low, high), model.measured, _EASY
    place, slopes = model.predict(theta)
    squares = float(np.sum((measured - place) ** 2))
    for _ in range(most):
        sizes = np.linalg.norm(slopes, axis=0)
        # Only what moves the positions moves, and nothing out of its bounds.
        fall = slopes.T @ (measured - place)
        free = (sizes > 0) & ((theta > low) | (fall > 0)) & ((theta < high) | (fall < 0))
        sizes = sizes[free]
        columns = slopes[:, free] / sizes
        square, fall = columns.T @ columns, fall[free] / sizes
        while True:
            # Products of columns keep half of their digits: enough for a step, since the residuals keep all of theirs.
            step = np.linalg.lstsq(square + damping * np.eye(sizes.size), fall, rcond=None)[0]
            promised = float(step @ (2.0 * fall - square @ step))
            trial = theta.copy()
            trial[free] += step / sizes
            trial = np.clip(trial, low, high)
            trial_place, trial_slopes = model.predict(trial)
            trial_squares = float(np.sum((measured - trial_place) ** 2))
            if trial_squares < squares or damping > _STUBBORN:
                break
            if promised <= arrived * squares:
                return theta, squares, True
            damping = max(10.0 * damping, _EASY)
        if not trial_squares < squares:
            # No step in the direction of the slopes helps any more: a corner, or rounding.
            return theta, squares, promised <= _NEARLY * squares
        theta, place, slopes, squares, before = trial, trial_place, trial_slopes, trial_squares, squares
        damping = 0.0 if damping < _LIGHT else damping / 10.0
        if before - squares <= arrived * before and promised <= arrived * before:
            return theta, squares, True
    return theta, squares, False
