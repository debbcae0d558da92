"""Least-squares fit of a device model to logged positions, by the output-error method (Ljung 1999, section 4.2).

The parameters are theta of `fitting.structure.Recordings`: g = T^2/m, delta = b T/m, the delay d, those of an actuator
lag and of modes, the initial states, and the accelerations o and c by a constant force and by friction. The sum of the
squared residuals, measured minus modeled positions, is minimized by Levenberg-Marquardt steps with exact derivatives.
Friction causes local minima, one for each missed stop of the mass. Therefore several initial values, with different
frictions, are followed through more and more positions of the logs.

The constant force and the friction are always fitted. A fit without them has smaller standard errors, but these are
valid only if both forces are 0. When a selection criterion omitted them, the damping was wrong by up to 179 of its
standard errors.

A *rival* is another minimum that fits about as well. One more symbol: -2 log(likelihood) of N positions with white
noise of unknown variance is N log(sum of squares), up to a constant; it is called the misfit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from zwidth.fitting.encoder import MeasurementNoise
from zwidth.fitting.moving import ModelResponse, Recording
from zwidth.fitting.structure import Recordings

# Initial values.
_DELTAS = (3e-4, 3e-3, 0.02, 0.1, 0.4, 1.5, 5.0)  # damping b T/m
_FRICTIONS = np.array([0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2, 0.35])  # friction, relative to the largest force
MIN_FRICTION = 1e-12  # least friction of the search, relative to the largest force; at 0 the derivative vanishes
_N_LEADING = 600  # leading positions of each log that determine the initial values
_BATCH_SIZE = 32  # delays per batch; bounds the memory
# Selection of an initial value.
_ROUNDS = ((300, 4), (600, 3), (1200, 2), (2500, 1))  # leading positions, and number of initial values that are kept
_STEPS_PER_ROUND = 12  # largest number of steps from each initial value per round

# Tolerances of the search: predicted reduction of the sum of squares by the next step, relative to this sum.
_NEAR = 1e-3  # in the selection of an initial value
CLOSELY = 2e-5  # in the comparison of device structures
_CONVERGED = 1e-14  # of the final fit
NEARLY = 1e-6  # if only the noise is estimated; also accepted as converged if no step decreases the sum of squares
# Levenberg-Marquardt steps.
_MAX_STEPS = 100  # largest number of steps
_INITIAL_DAMPING = 1e-4  # initial damping of the steps
_NEGLIGIBLE_DAMPING = 1e-6  # a decreasing damping below this value is set to 0
_MAX_DAMPING = 1e12  # largest damping, at which the search ends

# Ambiguity of friction.
_BACKWARD_SHARE = 0.1  # a motion is in one direction if its way back is shorter than this share of all motion
_NEARLY_FRICTIONLESS = 900.0  # squared standard errors of the friction, below which a fit without friction is tried
_EXCLUDED = 25.0  # squared standard errors from which on a rival does not enlarge the covariance
_INVISIBLE_DISTANCE = 3.0  # an initial motion shorter than this many standard deviations of the noise is not visible
# Numerical limits.
_MAX_CONDITION = 1e7  # condition number of the columns above which parameters are not determined
_ROUNDING = 1e-13  # relative rounding error of a sum of squares, and of the positions
_SIGNIFICANCE = 1e-3  # significance level of the excess of sums of residuals
_Fixed = tuple[int, ...]  # indices of the parameters in theta that keep their initial values


class ColumnsInverse(NamedTuple):
    """Pseudo-inverse of the normalized derivatives of the positions, with the parameters that are not determined."""

    matrix: np.ndarray  # pseudo-inverse
    undetermined: np.ndarray  # mask of the parameters that the positions do not determine
    basis: np.ndarray  # orthonormal basis of the columns, without directions below numerical resolution

    @property
    def rank(self) -> int:
        """The number of independent directions of theta that the positions determine."""
        return self.basis.shape[1]


@dataclass(frozen=True)
class FittedModel:
    """A model at the minimum of its sum of squares."""

    model: Recordings
    theta: np.ndarray
    squares: float  # weighted sum of the squared residuals
    converged: bool
    rivals: tuple[FittedModel, ...] = ()

    @property
    def count(self) -> int:
        """The number of fitted positions; with weights, that of white noise (`MeasurementNoise.count`)."""
        return self.model.measured.size if self.model.noise is None else self.model.noise.count

    @cached_property
    def response(self) -> ModelResponse:
        """The modeled positions and their derivatives in theta."""
        return self.model.simulate(self.theta)

    @cached_property
    def residuals(self) -> np.ndarray:
        """The measured minus the modeled positions."""
        return self.model.measured - self.response.position

    @property
    def variance(self) -> float:
        """The estimated variance of the noise of a position."""
        return self.squares / max(1, self.count - self.theta.size)

    @cached_property
    def noise(self) -> MeasurementNoise:
        """The noise of the positions, of at least the variance of the quantization error.

        The residuals may have a smaller variance, because x0 absorbs the error of the encoder at rest.
        """
        step = self.model.resolution
        return MeasurementNoise(self.response.position, max(self.variance, step**2 / 12.0), step)

    @cached_property
    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """The weighted derivatives of the positions, normalized, and their norms.

        A derivative that vanishes, as that in v0 of a mass that sticks, stays 0 and has the norm 1.
        """
        columns = self.model.weigh(self.response.derivatives)
        sizes = np.linalg.norm(columns, axis=0)
        sizes = np.where(sizes > 0, sizes, 1.0)
        return columns / sizes, sizes

    @cached_property
    def inverse(self) -> ColumnsInverse:
        """The pseudo-inverse of ``columns``, by singular values."""
        left, values, right = np.linalg.svd(self.columns[0], full_matrices=False)
        blind = values * _MAX_CONDITION < values[0]
        inverse = right[~blind].T / values[~blind] @ left[:, ~blind].T
        return ColumnsInverse(inverse, np.any(np.abs(right[blind]) > _MAX_CONDITION**-0.5, axis=0), left[:, ~blind])

    def estimate_step(self, k: int) -> float:
        """Return the step to the unconstrained minimum of a parameter fixed at its bound, in standard errors.

        Args:
            k: index of the parameter in theta.
        """
        step = self.inverse.matrix[k] @ self.model.weigh(self.residuals) / self.columns[1][k]
        return float(step / np.sqrt(self.covariance[k, k]))

    def compare_misfit(self, other: FittedModel) -> float:
        """Return the misfit, -2 log(likelihood), minus that of another model; rounding errors count as equal."""
        floor = self.count * (_ROUNDING * float(np.abs(self.model.measured).max())) ** 2
        ratio = max(self.squares, floor) / max(other.squares, floor)
        return self.count * np.log(ratio)

    def fits_as_well_as(self, other: FittedModel) -> bool:
        """Return whether Schwarz's criterion (BIC) prefers this model to another one with more parameters."""
        return self.compare_misfit(other) < max(1, other.inverse.rank - self.inverse.rank) * np.log(self.count)

    @cached_property
    def excess(self) -> float:
        """The mean square of sums of neighboring residuals, relative to that of the noise; 1 if not significant."""
        # Each sum adds 2 N^(1/3) of the N residuals. This is a usual bandwidth for errors of unknown autocorrelation
        # (Newey, West 1987).
        from scipy.special import chdtri

        weights, total = self.model.noise or self.noise, self.residuals.size
        size = int(2 * np.ceil(total ** (1 / 3)))
        starts = np.arange(0, total - size + 1, size)
        sums = np.add.reduceat(weights.weigh(self.residuals)[: starts[-1] + size], starts)
        expected = self.noise.spread_of_sums(size, weights)
        if not expected > 0:
            return 1.0
        ratio = float(np.mean(sums**2)) / expected
        return ratio if ratio * starts.size > chdtri(starts.size, _SIGNIFICANCE) else 1.0

    @cached_property
    def covariance(self) -> np.ndarray:
        """The covariance of theta, NaN for parameters that are not determined.

        It contains the autocorrelated errors of the encoder, the excess of the residuals, and the rivals.
        """
        (columns, sizes), weigh = self.columns, self.model.weigh
        # Use the pseudo-inverse, because products of columns lose half of the digits.
        inverse, undetermined, _ = self.inverse
        gram_inverse = inverse @ inverse.T
        covariance = self.excess * (gram_inverse @ self.noise.spread(weigh(columns)) @ gram_inverse)
        covariance = covariance / np.outer(sizes, sizes)
        covariance[undetermined], covariance[:, undetermined] = np.nan, np.nan
        for rival in self.rivals:
            determined = ~undetermined & np.diag(covariance > 0)
            scales, block = np.sqrt(np.diag(covariance)[determined]), np.ix_(determined, determined)
            away = (rival.theta - self.theta)[determined]
            steps = away / scales
            correlation = covariance[block] / np.outer(scales, scales)
            predicted = float(steps @ np.linalg.lstsq(correlation, steps, rcond=None)[0])
            actual = max(rival.compare_misfit(self) / self.excess, 1.0)
            # If the misfit increases less toward the rival than the derivatives predict, as beyond a kink of the sum of
            # squares, enlarge the covariance in this direction until both agree.
            if actual < min(predicted, _EXCLUDED):
                covariance[block] += (1.0 / actual - 1.0 / predicted) * np.outer(away, away)
        return covariance


def fit_model(model: Recordings) -> FittedModel:
    """Return the least-squares fit of a model, with its rivals; the model must not have a lag or modes."""
    start = _select_start(model, _list_starts(model))
    best = _fit(model, start, (), NEARLY if model.resolution else _CONVERGED)
    if model.resolution:
        # Weight the samples, because at rest all of them have the same error of the encoder.
        model = replace(model, noise=best.noise)
        best = _fit(model, best.theta)
    # If the mass moves in one direction only, and rests before or after, the log determines only the sum of constant
    # force and friction. Then one of them is set to 0. Compare with such a fit also if the best one moves back by
    # little, because noise can cause that.
    steps = np.diff(best.response.position)
    direction = float(np.sign(steps.sum()))
    if -np.sum(steps, where=direction * steps < 0) * direction < _BACKWARD_SHARE * np.abs(steps).sum():
        g, total = best.theta[0], best.theta[-2] - direction * best.theta[-1]
        # A total in the direction of motion is a constant force, one against it friction.
        if direction * total > 0:
            parts, omitted = (total, MIN_FRICTION * abs(g) * model.largest_force), -1
        else:
            parts, omitted = (0.0, -direction * total), -2
        start = np.append(best.theta[:-2], parts)
        rival = _fit(model, start, (omitted,))
        if rival.inverse.undetermined[-2:].all() and rival.fits_as_well_as(best):
            return rival
    # Without friction the mass never rests. There the sum of squares has a kink, beyond which it may increase less than
    # the derivatives predict; therefore compare with a fit without friction.
    if best.theta[-1] ** 2 < _NEARLY_FRICTIONLESS * best.covariance[-1, -1]:
        start = best.theta - np.nan_to_num(best.covariance[:, -1]) * best.theta[-1] / best.covariance[-1, -1]
        start[-1] = MIN_FRICTION * abs(start[0]) * model.largest_force
        frictionless = fit_nonnegative(model, start, (-1,))
        if best.fits_as_well_as(frictionless):
            return replace(best, rivals=(frictionless,))
        return replace(frictionless, rivals=(best,))
    return best


def _list_starts(model: Recordings) -> list[np.ndarray]:
    """Return initial values of theta: one without friction, and the best one for each friction of a grid.

    For each friction, damping and delay are those of least squares on a grid, for the first `_N_LEADING` positions.
    """
    # At fixed damping, delay, and velocities and accelerations relative to g, the positions are linear in all other
    # parameters. One response per damping serves all integer delays: it begins earlier and is shifted.
    model = model.truncate(_N_LEADING)
    base, most = np.zeros(model.size), int(model.longest)
    early = Recordings(
        tuple(Recording(log.force, np.zeros(log.position.size + most), log.skip - most) for log in model.logs)
    )
    ends = np.cumsum([log.position.size for log in early.logs])
    samples = np.concatenate(
        [np.arange(end - log.position.size, end) for end, log in zip(ends, model.logs, strict=True)]
    )

    def search(deltas: tuple[float, ...]) -> tuple[float, int]:
        """Return the damping and the delay of the least sum of squares."""
        tried = []
        for delta, some in product(deltas, np.array_split(np.arange(most + 1), 1 + most // _BATCH_SIZE)):
            rows = np.swapaxes(_simulate_rows(early, delta, 0.0, base)[:, samples - some[:, None]], 0, 1)
            squares = _combine_rows(rows, model.measured)[1]
            tried += [(float(each), delta, d) for each, d in zip(squares, some.tolist(), strict=True)]
        return min(tried)[1:]

    def start(delta: float, d: float) -> np.ndarray:
        """Return theta with the linear parameters of least squares."""
        values = _combine_rows(_simulate_rows(model, delta, d, base), model.measured)[0]
        return np.array([values[0], delta, d, *(values[0] * base[3:-1] + values[1:]), abs(values[0]) * base[-1]])

    delta, d = search(_DELTAS)
    starts = [minimize_squares(model, start(delta, d), (-1,), tolerance=_NEAR)[0]]
    # Linearize the other initial values at the constant force of the first one.
    base[-2] = starts[0][-2] / starts[0][0]
    for friction in _FRICTIONS * model.largest_force:
        base[-1] = friction
        # A larger friction explains more of the losses, so the damping can only be smaller; allow one grid step more.
        delta, d = search(_DELTAS[: _DELTAS.index(delta) + 2])
        starts.append(minimize_squares(model, start(delta, d), (-1,), tolerance=_NEAR)[0])
    return starts


def _simulate_rows(model: Recordings, delta: float, d: float, base: np.ndarray) -> np.ndarray:
    """Return the positions for g = 1 and their derivatives in x0, v0 of all logs and o, one per row.

    Args:
        model: the logs.
        delta: damping b T/m.
        d: delay.
        base: a theta with the initial states, o and c, relative to g.
    """
    response = model.simulate(np.array([1.0, delta, d, *base[3:]]))
    return np.vstack([response.position, response.derivatives[:, 3:-1].T])


def _combine_rows(rows: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares coefficients of rows, and the sums of squares of the residuals.

    The normal equations have half of the digits of float64, which are enough for initial values.
    """
    square = rows @ np.swapaxes(rows, -1, -2)
    sizes = np.sqrt(np.diagonal(square, axis1=-2, axis2=-1))
    sizes = np.where(sizes > 0, sizes, 1.0)
    least = sizes.shape[-1] * np.finfo(float).eps
    inverse = np.linalg.pinv(square / sizes[..., None] / sizes[..., None, :], least, hermitian=True)
    values = (inverse @ (rows @ wanted / sizes)[..., None])[..., 0] / sizes
    return values, np.sum((wanted - (values[..., None, :] @ rows)[..., 0, :]) ** 2, -1)


def _select_start(model: Recordings, starts: list[np.ndarray]) -> np.ndarray:
    """Refine the initial values on more and more positions, and return the best one.

    Short logs have few stops of the mass, and therefore hardly any local minima.
    """
    for count, kept in _ROUNDS:
        part = model.truncate(count)
        refined = [minimize_squares(part, start, (), _STEPS_PER_ROUND, _NEAR) for start in starts]
        starts = [theta for theta, *_ in sorted(refined, key=lambda result: result[1])[:kept]]
    return starts[0]


def _fit(model: Recordings, start: np.ndarray, fixed: _Fixed = (), tolerance: float = _CONVERGED) -> FittedModel:
    """Return the least-squares fit from an initial value, with the mass initially at rest if that fits as well."""
    # If friction stops the mass within the noise, its initial velocity hardly changes the positions. The derivative in
    # this velocity is then almost 0, and the search converges slowly.
    best = fit_nonnegative(model, start, fixed, tolerance)
    speed, (_, delta, *_, friction) = np.abs(best.theta[model.velocity_indices]), best.theta
    # The distance to the stop, interpolated: v^2/(2 c) without damping, v/delta without friction.
    distance = speed**2 / (2.0 * friction + delta * speed)
    invisible = (distance > 0) & (distance < _INVISIBLE_DISTANCE * np.sqrt(best.variance))
    if invisible.any():
        still = best.theta.copy()
        still[model.velocity_indices[invisible]] = 0.0
        resting = fit_nonnegative(model, still, fixed, tolerance)
        if not best.converged or resting.fits_as_well_as(best):
            return resting
    return best


def fit_nonnegative(
    model: Recordings, start: np.ndarray, fixed: _Fixed = (), tolerance: float = _CONVERGED
) -> FittedModel:
    """Return the fit of `minimize_squares` with nonnegative damping and delay: a negative one is fixed at 0."""
    best = minimize_squares(model, start, fixed, tolerance=tolerance)
    while negative := tuple(k for k in (1, 2) if best[0][k] < 0):
        best[0][list(negative)] = 0.0
        fixed = (*fixed, *negative)
        best = minimize_squares(model, best[0], fixed, tolerance=tolerance)
    return FittedModel(model, *best)


def minimize_squares(
    model: Recordings, start: np.ndarray, fixed: _Fixed, most: int = _MAX_STEPS, tolerance: float = _CONVERGED
) -> tuple[np.ndarray, float, bool]:
    """Minimize the weighted sum of squares by Levenberg-Marquardt steps within the bounds of theta.

    Args:
        model: the logs and the structure of the model.
        start: initial theta.
        fixed: indices of the parameters that keep their initial values.
        most: largest number of steps.
        tolerance: predicted reduction of the sum of squares, relative to this sum, at which the search ends.

    Returns:
        theta, the sum of squares, and whether the search converged.
    """
    low, high = model.bounds()
    low[-1] = MIN_FRICTION * abs(start[0]) * model.largest_force
    low[list(fixed)] = high[list(fixed)] = start[list(fixed)]
    theta, measured, damping = np.clip(start, low, high), model.measured, _INITIAL_DAMPING

    def evaluate(theta: np.ndarray) -> tuple[ModelResponse, np.ndarray, float]:
        response = model.simulate(theta)
        residuals = model.weigh(measured - response.position)
        return response, residuals, float(residuals @ residuals)

    (response, residuals, squares), predicted = evaluate(theta), np.inf
    for _ in range(most):
        derivatives = model.weigh(response.derivatives)
        sizes = np.linalg.norm(derivatives, axis=0)
        # Change only parameters that change the positions, and none across its bound.
        descent = derivatives.T @ residuals
        free = (sizes > 0) & ((theta > low) | (descent > 0)) & ((theta < high) | (descent < 0))
        sizes = sizes[free]
        columns = derivatives[:, free] / sizes
        square, descent = columns.T @ columns, descent[free] / sizes
        while True:
            # The normal equations keep half of the digits. That suffices for a step, because the residuals keep all.
            step = np.linalg.lstsq(square + damping * np.eye(sizes.size), descent, rcond=None)[0]
            predicted = float(step @ (2.0 * descent - square @ step))
            trial = theta.copy()
            trial[free] += step / sizes
            trial = np.clip(trial, low, high)
            trial_response, trial_residuals, trial_squares = evaluate(trial)
            # Accept steps whose effect is below the rounding error of the sum of squares, as the last ones are.
            better = trial_squares < squares or max(predicted, trial_squares - squares) <= _ROUNDING * squares
            if better or damping > _MAX_DAMPING:
                break
            if predicted <= tolerance * squares:
                return theta, squares, True
            damping = max(10.0 * damping, _INITIAL_DAMPING)
        if not better:
            # No step along the derivatives decreases the sum of squares, because of a kink or rounding errors.
            break
        theta, response, residuals, squares, before = trial, trial_response, trial_residuals, trial_squares, squares
        # Decrease the damping if the reduction was about as predicted; increase it below half of that (Nielsen 1999).
        ratio = (before - squares) / predicted if predicted > 0 else 0.0
        factor = max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3)
        damping = 0.0 if damping < _NEGLIGIBLE_DAMPING and factor < 1.0 else factor * damping
        if before - squares <= tolerance * before and predicted <= tolerance * before:
            return theta, squares, True
    return theta, squares, predicted <= NEARLY * squares
