"""Least squares of logged positions: for mass, damping and delay, and for each thing more that a log may ask for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zwidth.fitting.encoder import MeasurementNoise
from zwidth.fitting.moving import PARTS, Recording, Recordings

# Dampings b T/m and steps of the delay, in periods, that are started from, and how many of the best.
_DELTAS, _STEP, _STARTS = (3e-4, 3e-3, 0.02, 0.1, 0.4, 1.5, 5.0), 1.0, 3
# Friction as a share of the largest force, and the damping as a share of what it is without friction.
_FRICTIONS, _DAMPINGS = (0.02, 0.1, 0.3), (1.0, 0.3, 0.03)
# So many positions of each log choose the starts.
_BEGINNING = 2500
# Promised reductions of the squares that end the search, and that excuse a corner; steps; how they are damped.
_ARRIVED, _NEARLY, _STEPS = 1e-12, 1e-6, 100
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
    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The derivatives that are not 0, each of size 1; which, and their sizes. A mass that sticks forgets its v0."""
        sizes = np.linalg.norm(self.moved[1], axis=0)
        seen = np.flatnonzero(sizes)
        return self.moved[1][:, seen] / sizes[seen], seen, sizes[seen]

    @cached_property
    def conditioned(self) -> bool:
        """Whether the positions tell all numbers apart."""
        columns, seen, _ = self.columns
        needed = {0, 1, 2, *(self.model.find(part) for part in self.model.parts)}
        return needed <= set(seen.tolist()) and float(np.linalg.cond(columns)) < _BLIND

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
        """Of theta: exact slopes, the encoder's correlated errors, and what else spreads the residuals."""
        columns, seen, sizes = self.columns
        # Not by the products of columns, which keep half of the digits.
        inverse = np.linalg.pinv(columns)
        triangle = inverse @ inverse.T
        whole = np.zeros((self.theta.size, self.theta.size))
        spread = triangle @ self.noise.spread(columns) @ triangle
        whole[np.ix_(seen, seen)] = self.excess * spread / np.outer(sizes, sizes)
        return whole

    @cached_property
    def inflation(self) -> float:
        """How many times white noise's are the variances of the parts beyond mass, damping and delay; 1 or more."""
        columns, seen, sizes = self.columns
        white = np.ones(self.theta.size)
        white[seen] = self.variance * np.sum(np.linalg.pinv(columns) ** 2, axis=1) / sizes**2
        those = [self.model.find(name) for name in self.model.parts]
        return max([1.0, *(np.diag(self.covariance) / white)[those].tolist()])


def fit_models(recordings: tuple[Recording, ...], longest: float, resolution: float) -> list[tuple[FittedModel, float]]:
    """Every model with Schwarz's criterion less the least of all, that one first.

    Where errors are alike from sample to sample, likelihoods count as many times less as these widen the error of what
    is chosen (the c-hat of Burnham and Anderson 2002).
    """
    offset, friction = PARTS
    pushed = _fit(Recordings(recordings, (offset,)), _start(recordings, longest), longest, resolution)
    plainly = _fit(Recordings(recordings, ()), [pushed.theta[:-1]], longest, resolution)
    found = [plainly, pushed]
    starts = _start_rubbing(pushed)
    if starts:
        both = _fit(Recordings(recordings, (offset, friction)), starts, longest, resolution)
        rubbed = _fit(Recordings(recordings, (friction,)), [np.delete(both.theta, -2)], longest, resolution)
        found += [rubbed, both]
    # What the positions do not tell apart from the rest is not asked for.
    possible = [plainly, *(fitted for fitted in found[1:] if fitted.conditioned)]
    count, floor = plainly.count, plainly.count * (_ROUNDING * float(np.abs(plainly.model.measured).max())) ** 2
    inflation = possible[-1].inflation
    criteria = [
        count * np.log(max(fitted.squares, floor)) / inflation + fitted.theta.size * np.log(count)
        for fitted in possible
    ]
    best = min(criteria)
    ranked = sorted(zip(possible, criteria, strict=True), key=lambda pair: pair[1])
    return [(fitted, float(criterion - best)) for fitted, criterion in ranked]


def _start(recordings: tuple[Recording, ...], longest: float) -> list[np.ndarray]:
    """The best of a grid over damping and delay, where the rest is linear; by the beginnings of the logs."""
    model = Recordings(tuple(log.begin(_BEGINNING) for log in recordings), PARTS[:1])
    grid = [(delta, d) for delta in _DELTAS for d in np.arange(0.0, longest + 0.5 * _STEP, _STEP)]
    starts: list[np.ndarray] = []
    for theta, _ in sorted((model.project(*at) for at in grid), key=lambda found: found[1]):
        if all(abs(theta[2] - other[2]) > 2 * _STEP or theta[1] != other[1] for other in starts):
            starts.append(theta)
    return starts[:_STARTS]


def _start_rubbing(pushed: FittedModel) -> list[np.ndarray]:
    """The best of some frictions and dampings, around what was found without friction."""
    logs = pushed.model.logs
    model = Recordings(tuple(log.begin(_BEGINNING) for log in logs), PARTS)
    largest = max(float(np.abs(log.force).max()) for log in logs)
    starts = []
    for share in _FRICTIONS:
        for damping in _DAMPINGS:
            theta = np.append(pushed.theta, pushed.theta[0] * largest * share)
            theta[1] *= damping
            scaled, squares = model.scale(theta)
            if scaled[0] > 0 and scaled[-1] > 0:
                starts.append((squares, scaled))
    return [theta for _, theta in sorted(starts, key=lambda start: start[0])[:2]]


def _fit(model: Recordings, starts: list[np.ndarray], longest: float, resolution: float) -> FittedModel:
    """Least squares from several starts, by the beginnings of the logs first; neither damping nor delay is negative."""
    start = starts[0]
    if len(starts) > 1:
        first = Recordings(tuple(log.begin(_BEGINNING) for log in model.logs), model.parts)
        start = min((_refine(first, start, longest, ()) for start in starts), key=lambda found: found[1])[0]
    best = _refine(model, start, longest, ())
    still = _rest(model, *best[:2])
    if still is not None:
        resting = _refine(model, still, longest, ())
        # A start at rest needs one number less.
        count = model.measured.size
        if not best[2] or count * np.log(resting[1] / best[1]) < np.log(count):
            best = resting
    held: tuple[int, ...] = ()
    while any(best[0][k] < 0 for k in (1, 2)):
        held = tuple(k for k in (1, 2) if k in held or best[0][k] < 0)
        best = _refine(model, best[0], longest, held)
    return FittedModel(model, *best, resolution)


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
    model: Recordings, start: np.ndarray, longest: float, held: tuple[int, ...]
) -> tuple[np.ndarray, float, bool]:
    """Levenberg and Marquardt's steps within bounds: theta, the sum of squares, and whether it is the least."""
    count = max(log.force.size for log in model.logs)
    low, high = np.full(start.size, -np.inf), np.full(start.size, np.inf)
    # A little beyond 0 the model goes on, so that an optimum at 0 is no corner.
    low[1], low[2], high[1], high[2] = -5.0 / count, -1.0, 50.0, longest
    if PARTS[1] in model.parts:
        low[-1] = 0.0
    low[list(held)] = high[list(held)] = 0.0
    theta, measured, damping = np.clip(start, low, high), model.measured, _EASY
    place, slopes = model.predict(theta)
    squares = float(np.sum((measured - place) ** 2))
    for _ in range(_STEPS):
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
            if promised <= _ARRIVED * squares:
                return theta, squares, True
            damping = max(10.0 * damping, _EASY)
        if not trial_squares < squares:
            # No step in the direction of the slopes helps any more: a corner, or rounding.
            return theta, squares, promised <= _NEARLY * squares
        theta, place, slopes, squares, before = trial, trial_place, trial_slopes, trial_squares, squares
        damping = 0.0 if damping < _LIGHT else damping / 10.0
        if before - squares <= _ARRIVED * before and promised <= _ARRIVED * before:
            return theta, squares, True
    return theta, squares, False
