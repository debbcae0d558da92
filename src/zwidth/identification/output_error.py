"""Fit a device model to logged positions by least squares, with the output-error method (Ljung 1999, section 4.2).

The parameter vector theta of `identification.extended_model.Recordings` contains g = T^2/m, delta = b T/m, the delay d,
the parameters of an actuator lag and of resonances (*modes*), the initial position x0 and velocity v0 of each log, and
the accelerations o and c by a constant force and by friction. The sum of the squared residuals, measured minus modeled
positions, is minimized by Levenberg-Marquardt steps with exact derivatives. Friction causes local minima, one for each
missed stop of the mass. Therefore the search starts from several initial values with different frictions, and refines
the best ones on more and more positions of the logs.

The constant force and the friction are always fitted. A fit without them has smaller standard errors, but these are
valid only if both forces are 0. In a test in which a selection criterion omitted the forces, the damping was wrong by
up to 179 of its standard errors.

An *alternative* is a second minimum of the sum of squares, with about the same value. The *misfit* is -2
log(likelihood); for N positions with white noise of unknown variance, it is N log(sum of squares), up to a constant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from zwidth.identification.extended_model import Recordings
from zwidth.identification.friction_model import ModelResponse, Recording
from zwidth.identification.quantization_noise import MeasurementNoise

# Grid of initial values of the search.
_DELTAS = (3e-4, 3e-3, 0.02, 0.1, 0.4, 1.5, 5.0)  # damping delta = b T/m
# Initial values of the friction, relative to the largest force.
_FRICTIONS = np.array([0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2, 0.35])
# Least friction of the search, relative to the largest force. It is not exactly 0, because the model then omits
# friction, so that the derivative of the positions with respect to the friction would be 0.
MIN_FRICTION = 1e-12
_N_LEADING = 600  # number of leading positions of each log from which the initial values are computed
_BATCH_SIZE = 32  # number of delays per batch, to limit the memory
# Rounds of the selection of the best initial value: number of leading positions of each log that are fitted, and number
# of initial values that are kept for the next round.
_ROUNDS = ((300, 4), (600, 3), (1200, 2), (2500, 1))
_STEPS_PER_ROUND = 12  # largest number of Levenberg-Marquardt steps from each initial value per round

# Tolerances of the search. It ends if the next step is predicted to reduce the sum of squares by less than this share.
_NEAR = 1e-3  # tolerance in the selection of an initial value
CLOSELY = 2e-5  # tolerance in the comparison of device structures
_CONVERGED = 1e-14  # tolerance of the final fit
# Tolerance of fits from which only the noise is estimated. A search that ends because no step decreases the sum of
# squares also counts as converged if it satisfies this tolerance.
NEARLY = 1e-6
# Constants of the Levenberg-Marquardt method. Its damping is the number that is added to the diagonal of the normalized
# normal equations.
_MAX_STEPS = 100  # largest number of steps by default
_INITIAL_DAMPING = 1e-4  # damping of the first step
_NEGLIGIBLE_DAMPING = 1e-6  # value below which a decreasing damping is set to 0
_MAX_DAMPING = 1e12  # damping above which the search ends

# Limits that decide whether the log can distinguish friction from a constant force.
# A motion counts as single-directional if the path traveled backward is less than this share of the whole path.
_BACKWARD_SHARE = 0.1
# A fit without friction is tried as an alternative if (friction/standard error)^2 is below this limit.
_NEARLY_FRICTIONLESS = 900.0
_EXCLUDED = 25.0  # an alternative whose misfit exceeds the best one by this much does not enlarge the covariance
# An initial motion counts as invisible if its length is below this number of standard deviations of the noise.
_INVISIBLE_DISTANCE = 3.0
# Numerical limits and a significance level.
_MAX_CONDITION = 1e7  # condition number of the derivatives above which some parameters are not determined
_ROUNDING = 1e-13  # relative rounding error of a sum of squares, and of the positions
_SIGNIFICANCE = 1e-3  # significance level of the chi-square test for the excess
_Fixed = tuple[int, ...]  # indices of the parameters in theta that keep their initial values


class ColumnsInverse(NamedTuple):
    """Pseudo-inverse of the normalized derivatives of the positions with respect to theta, and their column space."""

    matrix: np.ndarray  # pseudo-inverse, one row per parameter
    undetermined: np.ndarray  # mask of the parameters that the positions do not determine
    basis: np.ndarray  # orthonormal basis of the column space of the derivatives, up to the numerical resolution

    @property
    def rank(self) -> int:
        """The number of independent linear combinations of parameters that the positions determine."""
        return self.basis.shape[1]


@dataclass(frozen=True)
class FittedModel:
    """A device model with the theta at which its sum of squares is minimal, and quantities derived from the fit."""

    model: Recordings
    theta: np.ndarray
    squares: float  # sum of the squared weighted residuals
    converged: bool
    alternatives: tuple[FittedModel, ...] = ()

    @property
    def count(self) -> int:
        """The number of fitted positions; if they are weighted, the effective number according to the noise model."""
        return self.model.measured.size if self.model.noise is None else self.model.noise.count

    @cached_property
    def response(self) -> ModelResponse:
        """The modeled positions of all logs and their derivatives with respect to theta."""
        return self.model.simulate(self.theta)

    @cached_property
    def residuals(self) -> np.ndarray:
        """The residuals of all logs, measured minus modeled positions, in one array."""
        return self.model.measured - self.response.position

    @property
    def variance(self) -> float:
        """The variance of the noise of one position, estimated from the residuals."""
        return self.squares / max(1, self.count - self.theta.size)

    @cached_property
    def noise(self) -> MeasurementNoise:
        """The noise model of the positions.

        Its variance is at least that of the quantization error. The variance of the residuals may be smaller, because
        x0 absorbs the error of the encoder at rest.
        """
        step = self.model.resolution
        return MeasurementNoise(self.response.position, max(self.variance, step**2 / 12.0), step)

    @cached_property
    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """The weighted derivatives of the positions with respect to theta, in normalized columns, and their norms.

        A zero column, such as the derivative with respect to v0 for a sticking mass, stays zero; its norm is set to 1.
        """
        columns = self.model.weigh(self.response.derivatives)
        sizes = np.linalg.norm(columns, axis=0)
        sizes = np.where(sizes > 0, sizes, 1.0)
        return columns / sizes, sizes

    @cached_property
    def inverse(self) -> ColumnsInverse:
        """The pseudo-inverse of the normalized derivatives, by singular value decomposition."""
        left, values, right = np.linalg.svd(self.columns[0], full_matrices=False)
        blind = values * _MAX_CONDITION < values[0]
        inverse = right[~blind].T / values[~blind] @ left[:, ~blind].T
        return ColumnsInverse(inverse, np.any(np.abs(right[blind]) > _MAX_CONDITION**-0.5, axis=0), left[:, ~blind])

    def estimate_step(self, k: int) -> float:
        """Estimate the step from a parameter fixed at its bound to its unconstrained optimum, in standard errors.

        Args:
            k: index of the parameter in theta.
        """
        step = self.inverse.matrix[k] @ self.model.weigh(self.residuals) / self.columns[1][k]
        return float(step / np.sqrt(self.covariance[k, k]))

    def compare_misfit(self, other: FittedModel) -> float:
        """Return the misfit minus that of another model of the same logs.

        Sums of squares below the rounding error of the positions are replaced by this error.
        """
        floor = self.count * (_ROUNDING * float(np.abs(self.model.measured).max())) ** 2
        ratio = max(self.squares, floor) / max(other.squares, floor)
        return self.count * np.log(ratio)

    def fits_as_well_as(self, other: FittedModel) -> bool:
        """Return whether the BIC (Schwarz 1978) prefers this model to ``other``, which has more parameters."""
        return self.compare_misfit(other) < max(1, other.inverse.rank - self.inverse.rank) * np.log(self.count)

    @cached_property
    def excess(self) -> float:
        """The factor by which autocorrelation increases the variance of sums of residuals; 1 if the test finds none.

        The value is the mean square of sums of successive residuals, divided by that expected from the noise model.
        """
        from scipy.special import chdtri

        weights, total = self.model.noise or self.noise, self.residuals.size
        # Form sums of 2 N^(1/3) successive residuals, with N the number of all residuals. This is a usual bandwidth for
        # errors with unknown autocorrelation (Newey, West 1987).
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

        It accounts for the autocorrelated errors of the encoder, for the excess of the residuals, and for alternatives.
        """
        (columns, sizes), weigh = self.columns, self.model.weigh
        # Use the pseudo-inverse of the derivatives, because the inverse of the normal matrix loses half of the digits.
        inverse, undetermined, _ = self.inverse
        gram_inverse = inverse @ inverse.T
        covariance = self.excess * (gram_inverse @ self.noise.spread(weigh(columns)) @ gram_inverse)
        covariance = covariance / np.outer(sizes, sizes)
        covariance[undetermined], covariance[:, undetermined] = np.nan, np.nan
        for alternative in self.alternatives:
            determined = ~undetermined & np.diag(covariance > 0)
            scales, block = np.sqrt(np.diag(covariance)[determined]), np.ix_(determined, determined)
            away = (alternative.theta - self.theta)[determined]
            steps = away / scales
            correlation = covariance[block] / np.outer(scales, scales)
            predicted = float(steps @ np.linalg.lstsq(correlation, steps, rcond=None)[0])
            actual = max(alternative.compare_misfit(self) / self.excess, 1.0)
            # The misfit may increase less between the minimum and the alternative than the derivatives predict, because
            # the sum of squares has a kink between them. If so, enlarge the covariance in this direction until both
            # agree.
            if actual < min(predicted, _EXCLUDED):
                covariance[block] += (1.0 / actual - 1.0 / predicted) * np.outer(away, away)
        return covariance


def fit_model(model: Recordings) -> FittedModel:
    """Fit a model without lag and modes by least squares, and find its alternatives."""
    start = _select_start(model, _list_starts(model))
    best = _fit(model, start, (), NEARLY if model.resolution else _CONVERGED)
    if model.resolution:
        # Fit again with weights from the estimated noise, because all samples at rest have the same encoder error.
        model = replace(model, noise=best.noise)
        best = _fit(model, best.theta)
    # If the mass moves in one direction only, and rests before or after, the log determines only the sum of the
    # constant force and the friction. In this case set one of both to 0. Try such a fit also if the mass moves backward
    # a little, because noise may cause this backward motion.
    steps = np.diff(best.response.position)
    direction = float(np.sign(steps.sum()))
    if -np.sum(steps, where=direction * steps < 0) * direction < _BACKWARD_SHARE * np.abs(steps).sum():
        g, total = best.theta[0], best.theta[-2] - direction * best.theta[-1]
        # Attribute the sum of both forces to the constant force if the sum acts in the direction of motion, and to
        # friction otherwise.
        if direction * total > 0:
            parts, omitted = (total, MIN_FRICTION * abs(g) * model.largest_force), -1
        else:
            parts, omitted = (0.0, -direction * total), -2
        start = np.append(best.theta[:-2], parts)
        alternative = _fit(model, start, (omitted,))
        if alternative.inverse.undetermined[-2:].all() and alternative.fits_as_well_as(best):
            return alternative
    # Compare with a fit without friction, because the standard error of a small friction may be wrong: at friction 0
    # the mass no longer sticks, so the sum of squares has a kink there, and may increase less toward it than the
    # derivatives predict.
    if best.theta[-1] ** 2 < _NEARLY_FRICTIONLESS * best.covariance[-1, -1]:
        start = best.theta - np.nan_to_num(best.covariance[:, -1]) * best.theta[-1] / best.covariance[-1, -1]
        start[-1] = MIN_FRICTION * abs(start[0]) * model.largest_force
        frictionless = fit_nonnegative(model, start, (-1,))
        if best.fits_as_well_as(frictionless):
            return replace(best, alternatives=(frictionless,))
        return replace(frictionless, alternatives=(best,))
    return best


def _list_starts(model: Recordings) -> list[np.ndarray]:
    """Compute initial values of theta: one without friction, and one for each value of a grid of frictions.

    For each friction, the damping and the delay are those with the least sum of squares on a grid, evaluated on the
    first `_N_LEADING` positions of each log.
    """
    # At fixed damping, delay and friction relative to g, the positions are linear in the other parameters, which linear
    # least squares determines. Simulate each damping only once: the response begins earlier than the log, and shifting
    # it by whole samples yields the responses for all integer delays.
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
        """Return the damping in ``deltas`` and the integer delay that together yield the least sum of squares."""
        tried = []
        for delta, some in product(deltas, np.array_split(np.arange(most + 1), 1 + most // _BATCH_SIZE)):
            rows = np.swapaxes(_simulate_rows(early, delta, 0.0, base)[:, samples - some[:, None]], 0, 1)
            squares = _combine_rows(rows, model.measured)[1]
            tried += [(float(each), delta, d) for each, d in zip(squares, some.tolist(), strict=True)]
        return min(tried)[1:]

    def start(delta: float, d: float) -> np.ndarray:
        """Return theta for a damping and a delay, with the other parameters from linear least squares."""
        values = _combine_rows(_simulate_rows(model, delta, d, base), model.measured)[0]
        return np.array([values[0], delta, d, *(values[0] * base[3:-1] + values[1:]), abs(values[0]) * base[-1]])

    delta, d = search(_DELTAS)
    starts = [minimize_squares(model, start(delta, d), (-1,), tolerance=_NEAR)[0]]
    # Compute the other initial values from positions that are linearized at the constant force of the first one.
    base[-2] = starts[0][-2] / starts[0][0]
    for friction in _FRICTIONS * model.largest_force:
        base[-1] = friction
        # Omit dampings above the one selected for the previous, smaller friction, because a larger friction explains
        # more of the energy loss. Keep the next larger damping of the grid as a margin.
        delta, d = search(_DELTAS[: _DELTAS.index(delta) + 2])
        starts.append(minimize_squares(model, start(delta, d), (-1,), tolerance=_NEAR)[0])
    return starts


def _simulate_rows(model: Recordings, delta: float, d: float, base: np.ndarray) -> np.ndarray:
    """Simulate the positions for g = 1, and their derivatives with respect to x0, v0 and o, as basis of a linear fit.

    Args:
        model: the logs, with a model without lag and modes.
        delta: damping b T/m.
        d: delay in sampling periods.
        base: a theta that contains the initial states, o and c, divided by g.

    Returns:
        An array with one sample per column. The rows are the positions, and their derivatives with respect to x0 and v0
        of each log and to o.
    """
    response = model.simulate(np.array([1.0, delta, d, *base[3:]]))
    return np.vstack([response.position, response.derivatives[:, 3:-1].T])


def _combine_rows(rows: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit positions by linear combinations of rows, by least squares; leading axes of ``rows`` are a batch.

    The normal equations are solved. Their accuracy, half of the digits of float64, suffices for initial values.

    Returns:
        The coefficients, and the sums of squares of the residuals.
    """
    square = rows @ np.swapaxes(rows, -1, -2)
    sizes = np.sqrt(np.diagonal(square, axis1=-2, axis2=-1))
    sizes = np.where(sizes > 0, sizes, 1.0)
    least = sizes.shape[-1] * np.finfo(float).eps
    inverse = np.linalg.pinv(square / sizes[..., None] / sizes[..., None, :], least, hermitian=True)
    values = (inverse @ (rows @ wanted / sizes)[..., None])[..., 0] / sizes
    return values, np.sum((wanted - (values[..., None, :] @ rows)[..., 0, :]) ** 2, -1)


def _select_start(model: Recordings, starts: list[np.ndarray]) -> np.ndarray:
    """Refine initial values on more and more leading positions, dropping the worse ones, and return the best one.

    The first positions contain few stops of the mass. Therefore their sum of squares has hardly any local minima.
    """
    for count, kept in _ROUNDS:
        part = model.truncate(count)
        refined = [minimize_squares(part, start, (), _STEPS_PER_ROUND, _NEAR) for start in starts]
        starts = [theta for theta, *_ in sorted(refined, key=lambda result: result[1])[:kept]]
    return starts[0]


def _fit(model: Recordings, start: np.ndarray, fixed: _Fixed = (), tolerance: float = _CONVERGED) -> FittedModel:
    """Fit a model from one initial value; set initial velocities to exactly 0 if the model then fits equally well.

    Args:
        model: the logs and the structure of the model.
        start: initial theta.
        fixed: indices of the parameters that keep their initial values.
        tolerance: tolerance of the search, as in `minimize_squares`.
    """
    # Treat initial motions that end within the noise of the positions separately: the derivative of the positions with
    # respect to such an initial velocity is almost 0, so that the search converges slowly.
    best = fit_nonnegative(model, start, fixed, tolerance)
    speed, (_, delta, *_, friction) = np.abs(best.theta[model.velocity_indices]), best.theta
    # Approximate the distance to the stop by a formula that is exact without damping, v^2/(2 c), and without friction,
    # v/delta.
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
    """Fit a model by least squares; if the damping or the delay becomes negative, fix it at 0 and fit again."""
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
        # Let the step change only parameters that have an effect on the positions and would not leave their bounds.
        descent = derivatives.T @ residuals
        free = (sizes > 0) & ((theta > low) | (descent > 0)) & ((theta < high) | (descent < 0))
        sizes = sizes[free]
        columns = derivatives[:, free] / sizes
        square, descent = columns.T @ columns, descent[free] / sizes
        while True:
            # Solve the normal equations. Their lower accuracy suffices for a step, because the residuals, which decide
            # the convergence, are computed with full accuracy.
            step = np.linalg.lstsq(square + damping * np.eye(sizes.size), descent, rcond=None)[0]
            predicted = float(step @ (2.0 * descent - square @ step))
            trial = theta.copy()
            trial[free] += step / sizes
            trial = np.clip(trial, low, high)
            trial_response, trial_residuals, trial_squares = evaluate(trial)
            # Also accept steps whose effect is below the rounding error of the sum of squares, because the last steps
            # before convergence are so small.
            better = trial_squares < squares or max(predicted, trial_squares - squares) <= _ROUNDING * squares
            if better or damping > _MAX_DAMPING:
                break
            if predicted <= tolerance * squares:
                return theta, squares, True
            damping = max(10.0 * damping, _INITIAL_DAMPING)
        if not better:
            # End the search, because no step decreases the sum of squares: theta is at a kink, or the possible decrease
            # is below the rounding error.
            break
        theta, response, residuals, squares, before = trial, trial_response, trial_residuals, trial_squares, squares
        # Decrease the damping if the sum of squares decreased about as predicted, and increase it if the reduction was
        # less than half of the prediction (Nielsen 1999).
        ratio = (before - squares) / predicted if predicted > 0 else 0.0
        factor = max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3)
        damping = 0.0 if damping < _NEGLIGIBLE_DAMPING and factor < 1.0 else factor * damping
        if before - squares <= tolerance * before and predicted <= tolerance * before:
            return theta, squares, True
    return theta, squares, predicted <= NEARLY * squares
