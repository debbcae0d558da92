"""Least squares of logged positions: mass, damping and delay, and with them a constant force and friction.

The two are always sought. A fit without them has smaller errors, but holds the device only where they are 0 indeed, and
a log that hardly shows them cannot tell: left out by a criterion, they moved damping by up to 179 standard errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from zwidth.fitting.encoder import MeasurementNoise
from zwidth.fitting.moving import ModelledMotion, Recording
from zwidth.fitting.structure import Recordings

# Dampings b T/m and frictions as shares of the largest force that are started from; the least friction that is looked
# for, for at 0 its slope is not seen.
_DELTAS = (3e-4, 3e-3, 0.02, 0.1, 0.4, 1.5, 5.0)
_FRICTIONS, LEAST = np.array([0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2, 0.35]), 1e-12
# So many first positions of each log tell the starts, so many delays at once.
_GLIMPSE, _AT_ONCE = 600, 32
# So many first positions choose so many of the starts, each followed by so many steps, or to this promised reduction.
_ROUNDS, _FOLLOWED, _NEAR = ((300, 4), (600, 3), (1200, 2), (2500, 1)), 12, 1e-3
# Devices with other parts are compared at this promised reduction.
CLOSELY = 2e-5
# Promised reductions of the squares that end the search, and that tell the noise and excuse a corner; steps; how they
# are damped.
_ARRIVED, NEARLY, _STEPS = 1e-14, 1e-6, 100
_EASY, _LIGHT, _STUBBORN = 1e-4, 1e-6, 1e12
# A mass that slides back by less than this share of its way may do so for the noise alone.
_BACK = 0.1
# Squares of standard errors: of friction that none is compared with, and of rivals that are excluded.
_CLOSE_BY, _EXCLUDED = 900.0, 25.0
# Standard deviations of the noise that a slide is lost in.
_WITHIN = 3.0
# Columns worse conditioned than this do not tell the numbers apart; a relative error this small is rounding.
_BLIND, _ROUNDING = 1e7, 1e-13
# Sums of residuals that noise alone exceeds so rarely are of something else.
_CHANCE = 1e-3
# Which numbers of theta stay as they start.
_Held = tuple[int, ...]


class ColumnsInverse(NamedTuple):
    """Their pseudo-inverse, which numbers the positions leave open, and orthonormal directions of the others."""

    matrix: np.ndarray
    open: np.ndarray
    basis: np.ndarray  # without what columns differ by in rounding alone

    @property
    def rank(self) -> int:
        """How many numbers the positions tell."""
        return self.basis.shape[1]


@dataclass(frozen=True)
class FittedModel:
    """A model at its least squares."""

    model: Recordings
    theta: np.ndarray
    squares: float
    arrived: bool
    rivals: tuple[FittedModel, ...] = ()

    @property
    def count(self) -> int:
        """How many positions it was fitted to, as many as of white noise."""
        return self.model.measured.size if self.model.noise is None else self.model.noise.count

    @cached_property
    def motion(self) -> ModelledMotion:
        """Positions and their derivatives in theta."""
        return self.model.follow(self.theta)

    @cached_property
    def residuals(self) -> np.ndarray:
        """Measured less modelled."""
        return self.model.measured - self.motion.position

    @property
    def variance(self) -> float:
        """Of the noise of a position."""
        return self.squares / max(1, self.count - self.theta.size)

    @cached_property
    def noise(self) -> MeasurementNoise:
        """That of its positions; at rest, x0 takes up an encoder's error, and the residuals show less than there is."""
        step = self.model.resolution
        return MeasurementNoise(self.motion.position, max(self.variance, step**2 / 12.0), step)

    @cached_property
    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """The derivatives, each of size 1 or, as that in the v0 of a mass that sticks, 0; and their sizes."""
        columns = self.model.weigh(self.motion.slopes)
        sizes = np.linalg.norm(columns, axis=0)
        sizes = np.where(sizes > 0, sizes, 1.0)
        return columns / sizes, sizes

    @cached_property
    def inverse(self) -> ColumnsInverse:
        """By singular values."""
        left, values, right = np.linalg.svd(self.columns[0], full_matrices=False)
        blind = values * _BLIND < values[0]
        inverse = right[~blind].T / values[~blind] @ left[:, ~blind].T
        return ColumnsInverse(inverse, np.any(np.abs(right[blind]) > _BLIND**-0.5, axis=0), left[:, ~blind])

    def step_beyond(self, k: int) -> float:
        """Where the least squares of what is held at its bound would lie, in standard errors from there."""
        step = self.inverse.matrix[k] @ self.model.weigh(self.residuals) / self.columns[1][k]
        return float(step / np.sqrt(self.covariance[k, k]))

    def lag_behind(self, other: FittedModel) -> float:
        """By how much its squares are more than another model's, in squares of standard errors."""
        floor = self.count * (_ROUNDING * float(np.abs(self.model.measured).max())) ** 2
        ratio = max(self.squares, floor) / max(other.squares, floor)
        return self.count * np.log(ratio)

    def explains_as_well(self, other: FittedModel) -> bool:
        """Whether another model leaves less by no more than its further numbers would by chance, or than rounding."""
        return self.lag_behind(other) < max(1, other.inverse.rank - self.inverse.rank) * np.log(self.count)

    @cached_property
    def excess(self) -> float:
        """By how much sums of neighboring residuals spread more than those of noise; 1 where chance explains it."""
        # Over twice the cube root of the samples, as usual for errors of unknown kinship (Newey, West 1987).
        from scipy.special import chdtri

        weights, total = self.model.noise or self.noise, self.residuals.size
        size = int(2 * np.ceil(total ** (1 / 3)))
        starts = np.arange(0, total - size + 1, size)
        sums = np.add.reduceat(weights.weigh(self.residuals)[: starts[-1] + size], starts)
        expected = self.noise.spread_of_sums(size, weights)
        if not expected > 0:
            return 1.0
        found = float(np.mean(sums**2)) / expected
        return found if found * starts.size > chdtri(starts.size, _CHANCE) else 1.0

    @cached_property
    def covariance(self) -> np.ndarray:
        """Of theta: exact slopes, the encoder's correlated errors, what else spreads the residuals, and the rivals."""
        # NaN of what is open. Where squares rise less towards a rival than slopes say, as beyond a corner, the errors
        # that way are as large as to leave it as many standard errors away as its squares do.
        (columns, sizes), weigh = self.columns, self.model.weigh
        # Not by the products of columns, which keep half of the digits.
        inverse, blind, _ = self.inverse
        triangle = inverse @ inverse.T
        whole = self.excess * (triangle @ self.noise.spread(weigh(columns)) @ triangle) / np.outer(sizes, sizes)
        whole[blind], whole[:, blind] = np.nan, np.nan
        for rival in self.rivals:
            known = ~blind & np.diag(whole > 0)
            scales, block = np.sqrt(np.diag(whole)[known]), np.ix_(known, known)
            away = (rival.theta - self.theta)[known]
            steps = away / scales
            told = float(steps @ np.linalg.lstsq(whole[block] / np.outer(scales, scales), steps, rcond=None)[0])
            found = max(rival.lag_behind(self) / self.excess, 1.0)
            if found < min(told, _EXCLUDED):
                whole[block] += (1.0 / found - 1.0 / told) * np.outer(away, away)
        return whole


def fit_model(model: Recordings) -> FittedModel:
    """The device of the least squares, with a constant force and friction."""
    start = _follow(model, _start(model))
    best = _fit(model, start, (), NEARLY if model.resolution else _ARRIVED)
    if model.resolution:
        # At rest an encoder errs by the same all the time: that counts once.
        model = replace(model, noise=best.noise)
        best = _fit(model, best.theta)
    # Of a mass that slides one way only, and rests before or after, how much is of which stays open: one of them is
    # none. Beside that device others fit that slide back a little within the noise.
    steps = np.diff(best.motion.position)
    way = float(np.sign(steps.sum()))
    if -np.sum(steps, where=way * steps < 0) * way < _BACK * np.abs(steps).sum():
        g, pull = best.theta[0], best.theta[-2] - way * best.theta[-1]
        parts, none = ((pull, LEAST * abs(g) * model.largest), -1) if way * pull > 0 else ((0.0, -way * pull), -2)
        start = np.append(best.theta[:-2], parts)
        rival = _fit(model, start, (none,))
        if rival.inverse.open[-2:].all() and rival.explains_as_well(best):
            return rival
    # Without friction nothing rests: beyond that corner the squares may rise less than the slopes say.
    if best.theta[-1] ** 2 < _CLOSE_BY * best.covariance[-1, -1]:
        none = best.theta - np.nan_to_num(best.covariance[:, -1]) * best.theta[-1] / best.covariance[-1, -1]
        none[-1] = LEAST * abs(none[0]) * model.largest
        gliding = settle(model, none, (-1,))
        if best.explains_as_well(gliding):
            return replace(best, rivals=(gliding,))
        return replace(gliding, rivals=(best,))
    return best


def _start(model: Recordings) -> list[np.ndarray]:
    """The best without friction, and for every friction the best of a grid over damping and delay, by beginnings."""
    # All else is linear there, for all speeds grow with g. One motion serves all delays: begun so much earlier.
    model = model.begin(_GLIMPSE)
    base, most = np.zeros(model.size), int(model.longest)
    early = Recordings(
        tuple(Recording(log.force, np.zeros(log.position.size + most), log.skip - most) for log in model.logs)
    )
    ends = np.cumsum([log.position.size for log in early.logs])
    samples = np.concatenate(
        [np.arange(end - log.position.size, end) for end, log in zip(ends, model.logs, strict=True)]
    )

    def search(deltas: tuple[float, ...]) -> tuple[float, int]:
        """The damping and the delay of the least sum of squares."""
        found = []
        for delta, some in product(deltas, np.array_split(np.arange(most + 1), 1 + most // _AT_ONCE)):
            answers = np.swapaxes(_answer(early, delta, 0.0, base)[:, samples - some[:, None]], 0, 1)
            rests = _combine(answers, model.measured)[1]
            found += [(float(rest), delta, d) for rest, d in zip(rests, some.tolist(), strict=True)]
        return min(found)[1:]

    def start(delta: float, d: float) -> np.ndarray:
        values = _combine(_answer(model, delta, d, base), model.measured)[0]
        return np.array([values[0], delta, d, *(values[0] * base[3:-1] + values[1:]), abs(values[0]) * base[-1]])

    delta, d = search(_DELTAS)
    starts = [refine(model, start(delta, d), (-1,), arrived=_NEAR)[0]]
    # From there on with the constant force that was found.
    base[-2] = starts[0][-2] / starts[0][0]
    for friction in _FRICTIONS * model.largest:
        base[-1] = friction
        # The more friction, the less damping is left to find.
        delta, d = search(_DELTAS[: _DELTAS.index(delta) + 2])
        starts.append(refine(model, start(delta, d), (-1,), arrived=_NEAR)[0])
    return starts


def _answer(model: Recordings, delta: float, d: float, base: np.ndarray) -> np.ndarray:
    """Positions where g is 1 and the first speeds, o and c are as in ``base``, and their slopes in x0, v0, o: rows."""
    motion = model.follow(np.array([1.0, delta, d, *base[3:]]))
    return np.vstack([motion.position, motion.slopes[:, 3:-1].T])


def _combine(rows: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares to half of the digits, which are enough to start from, and their sums of squares."""
    square = rows @ np.swapaxes(rows, -1, -2)
    sizes = np.sqrt(np.diagonal(square, axis1=-2, axis2=-1))
    sizes = np.where(sizes > 0, sizes, 1.0)
    least = sizes.shape[-1] * np.finfo(float).eps
    inverse = np.linalg.pinv(square / sizes[..., None] / sizes[..., None, :], least, hermitian=True)
    values = (inverse @ (rows @ wanted / sizes)[..., None])[..., 0] / sizes
    return values, np.sum((wanted - (values[..., None, :] @ rows)[..., 0, :]) ** 2, -1)


def _follow(model: Recordings, starts: list[np.ndarray]) -> np.ndarray:
    """The best start, followed through ever longer beginnings: few turns and rests make hardly a false optimum."""
    for count, kept in _ROUNDS:
        part = model.begin(count)
        found = [refine(part, start, (), _FOLLOWED, _NEAR) for start in starts]
        starts = [theta for theta, *_ in sorted(found, key=lambda found: found[1])[:kept]]
    return starts[0]


def _fit(model: Recordings, start: np.ndarray, held: _Held = (), arrived: float = _ARRIVED) -> FittedModel:
    """Least squares from a start, or at rest where that is as good."""
    # First speeds that friction stops within the noise hardly move the positions. Beside such a speed the position's
    # derivative is next to 0, and steps towards the best one hardly end.
    best = settle(model, start, held, arrived)
    speed, (_, delta, *_, friction) = np.abs(best.theta[model.speeds]), best.theta
    # The way to the stop, v^2/(2 c) without damping and v/delta without friction.
    slid = speed**2 / (2.0 * friction + delta * speed)
    idle = (slid > 0) & (slid < _WITHIN * np.sqrt(best.variance))
    if idle.any():
        still = best.theta.copy()
        still[model.speeds[idle]] = 0.0
        resting = settle(model, still, held, arrived)
        if not best.arrived or resting.explains_as_well(best):
            return resting
    return best


def settle(model: Recordings, start: np.ndarray, held: _Held = (), arrived: float = _ARRIVED) -> FittedModel:
    """As `refine`, with neither damping nor delay negative."""
    best = refine(model, start, held, arrived=arrived)
    while negative := tuple(k for k in (1, 2) if best[0][k] < 0):
        best[0][list(negative)] = 0.0
        held = (*held, *negative)
        best = refine(model, best[0], held, arrived=arrived)
    return FittedModel(model, *best)


def refine(
    model: Recordings, start: np.ndarray, held: _Held, most: int = _STEPS, arrived: float = _ARRIVED
) -> tuple[np.ndarray, float, bool]:
    """Levenberg and Marquardt's steps within bounds but for what is ``held``: theta, squares, and whether the least."""
    low, high = model.bounds()
    low[-1] = LEAST * abs(start[0]) * model.largest
    low[list(held)] = high[list(held)] = start[list(held)]
    theta, measured, damping = np.clip(start, low, high), model.measured, _EASY

    def look(theta: np.ndarray) -> tuple[ModelledMotion, np.ndarray, float]:
        motion = model.follow(theta)
        rest = model.weigh(measured - motion.position)
        return motion, rest, float(rest @ rest)

    (motion, rest, squares), promised = look(theta), np.inf
    for _ in range(most):
        slopes = model.weigh(motion.slopes)
        sizes = np.linalg.norm(slopes, axis=0)
        # Only what moves the positions moves, and nothing out of its bounds.
        fall = slopes.T @ rest
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
            trial_motion, trial_rest, trial_squares = look(trial)
            # The last steps move the squares by less than these are rounded by.
            better = trial_squares < squares or max(promised, trial_squares - squares) <= _ROUNDING * squares
            if better or damping > _STUBBORN:
                break
            if promised <= arrived * squares:
                return theta, squares, True
            damping = max(10.0 * damping, _EASY)
        if not better:
            # No step in the direction of the slopes helps any more: a corner, or rounding.
            break
        theta, motion, rest, squares, before = trial, trial_motion, trial_rest, trial_squares, squares
        # Damped less where the slopes told the fall, more where it was less than half of that (Nielsen 1999).
        told = (before - squares) / promised if promised > 0 else 0.0
        less = max(0.1, 1.0 - (2.0 * told - 1.0) ** 3)
        damping = 0.0 if damping < _LIGHT and less < 1.0 else less * damping
        if before - squares <= arrived * before and promised <= arrived * before:
            return theta, squares, True
    return theta, squares, promised <= NEARLY * squares
