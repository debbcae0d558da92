"""Detect actuator lags and structural resonances missing from a fitted model, and bound the undetected ones.

Model. The weighted residuals of a fit are ``e = r s + n``: s is the signature of one missing pole, r its size, and n
noise of variance ``sigma^2``. The *signature* of a mode or lag is the part of its effect on the positions that no
change of the fitted parameters ``theta`` reproduces. A mode of *mass ratio* r has the modal mass
``m/(r sqrt(1 - zeta^2))``, with the mass m of the device and the damping ratio zeta of the mode; r is negative if
actuator and sensor are on opposite sides of a node. A *unit mode* has mass ratio 1.

The candidates are a bank of poles: a grid of frequencies for each of a few damping ratios, and real poles for actuator
lags. No model with a candidate is fitted. Steps, explained in docs/theory/hidden.md:

1. Score: the reduction of the sum of squares, in sigma^2, if the real and imaginary part of the force filtered by the
   pole are added to the model (Rao 1948). It is a chi-square variable if no pole is missing.
2. Detection: `detect_missing_pole` returns the pole of the highest score if it satisfies Schwarz's criterion (BIC,
   Schwarz 1978) for white noise and for the autocorrelated errors of the encoder.
3. Bound: without a detection, |r| is at most ``(sqrt(score) + 4)/size``, with ``size = |s|/sigma`` of the unit mode.
   `bound_response` adds the largest such mode to the response of the device; that radius limits the safe walls.
4. Averaging: with ``t = s'e/(sigma^2 size)``, the likelihood ratio of one more mode to none is
   ``exp(t r size - (r size)^2/2)``. Its mean over the prior is the posterior odds; `sample_resonances` draws modes from
   the posterior and computes K_max with each (Bayesian model averaging, Hoeting et al. 1999).
5. Lags: `bound_lag` returns the longest first-order actuator lag that the data cannot distinguish from pure delay.

Unless stated otherwise, times are in sampling periods, frequencies are relative to the sampling rate, and ``theta`` is
the parameter vector of `fitting.structure.Recordings`. J are the derivatives of the positions in theta, W the weights
of the samples.

References:
    Rao 1948, Proc. Cambridge Philos. Soc. 44, 50-57 (score test). Schwarz 1978, Annals of Statistics 6, 461-464
    (criterion for further parameters). Hoeting, Madigan, Raftery, Volinsky 1999, Statistical Science 14, 382-417 (model
    averaging).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from zwidth.fitting.moving import recur
from zwidth.fitting.output_error import FittedModel
from zwidth.fitting.required_wall import CriticalController, GridLimits
from zwidth.parts.circle import circle_points
from zwidth.parts.measured import MeasuredDevice
from zwidth.scenes.measured_curve import LEAST_DAMPING_RATIO
from zwidth.scenes.scene import Scene

# Grid of the pole bank. Frequencies are relative to the sampling rate.
MIN_FREQUENCY = 0.005
MAX_FREQUENCY = 0.49  # just below the Nyquist frequency
# Keys: damping ratios of the poles; 1.0 stands for real poles (actuator lags). Values: ratio of successive frequencies.
FREQUENCY_SPACING = {LEAST_DAMPING_RATIO: 1.01, 0.03: 1.06, 0.2: 1.06, 1.0: 1.06}
BOUNDED_RATIOS = (LEAST_DAMPING_RATIO, 0.03)  # damping ratios of the undetected modes that bound the response
# The model absorbs a pole if a smaller share of the norm of the filtered force is orthogonal to the columns of W J.
ABSORBED_NORM = 1e-6

# Detection of a missing pole.
N_CANDIDATES = 3  # highest scores tested with autocorrelated errors; more than one, because these can mimic a pole
CANDIDATE_SPACING = 1.1  # least ratio of the frequencies of two tested poles
MAX_SAMPLES = 20_000  # leading samples inspected per log
BATCH_SIZE = 400_000  # values per batch of filtered forces; bounds the memory

# Upper bound of an undetected mode.
BOUND_ERRORS = 4.0  # standard errors added to the observed amplitude
N_NEIGHBORS = 15  # poles on each side from which the local standard error is estimated

# Frequency grid of the response, relative to the sampling rate.
MIN_RESPONSE_FREQUENCY = 2e-4
N_BELOW_BANK = 40  # frequencies below the pole bank
BAND_PHASE_STEP = 0.3  # rad; largest phase change by the delay per grid step, for the deviation of a response
INTERPOLATION_PHASE_STEP = 0.06  # rad; the same for linear interpolation
RESONANCE_OFFSETS = np.sinh(np.linspace(-4.0, 4.0, 61))  # grid around a resonance, in half-widths
DIFFERENCE_STEP = 1e-6  # relative step of finite differences in theta

# Prior distribution of one more resonance.
PRIOR_FREQUENCIES = (0.03, 0.4)  # relative to the sampling rate
PRIOR_MASS_RATIOS = np.geomspace(1.0 / 30.0, 1.0, 9)  # magnitudes, equally likely
NEGATIVE_PROBABILITY = 0.3  # of a negative mass ratio
N_SAMPLES = 200  # samples of the posterior distribution


class HiddenResonances(NamedTuple):
    """The posterior odds of one more resonance, and equally likely samples of the maximum stiffness with it."""

    odds: float  # one more resonance against none
    stiffness_max: np.ndarray  # K_max with a sampled resonance, relative to K_max without


class HiddenPole(NamedTuple):
    """A pole that the model lacks, or a resonance that explains the log as well as the model's actuator lag."""

    frequency: float  # relative to the sampling rate
    is_resonance: bool  # complex pole; otherwise a real pole, i.e. a lag
    replaces_lag: bool = False  # alternative to the actuator lag of the model, which explains the log equally well


class PoleBank(NamedTuple):
    """Score test of the residuals for all candidate poles, one array entry per pole, with white-noise errors."""

    ratio: np.ndarray  # damping ratio of each pole, 1 for real poles
    frequency: np.ndarray  # natural frequency
    score: np.ndarray  # reduction of the sum of squares, in noise variances; chi-square for white noise alone
    signature_size: np.ndarray  # norm of the signature of the unit mode, in standard errors
    projection: np.ndarray  # residuals projected onto that signature, in standard errors
    error_inflation: np.ndarray  # standard error with autocorrelated encoder errors, relative to white noise; >= 1
    absorbed: np.ndarray  # bias of theta if the unit mode is omitted from the model; one column per parameter

    def select(self, mask: np.ndarray) -> PoleBank:
        """Return the poles selected by a boolean mask."""
        return PoleBank(*(field[mask] for field in self))

    def bound_mass_ratios(self) -> np.ndarray:
        """Return an upper bound of |r| of an undetected mode, for each complex pole of one damping ratio."""
        # The expected score of a complex pole is 2 for white noise. Therefore half the mean score of the neighboring
        # poles is the local noise variance, relative to the assumed one.
        width = 2 * N_NEIGHBORS + 1
        mean_score = np.convolve(np.pad(self.score, N_NEIGHBORS, "edge"), np.full(width, 1.0 / width), "valid")
        with np.errstate(divide="ignore"):
            local_error = np.sqrt(np.maximum(0.5 * mean_score, 1.0))
            return (np.sqrt(self.score) + BOUND_ERRORS * local_error) / self.signature_size


def detect_missing_pole(fit: FittedModel) -> tuple[HiddenPole | None, PoleBank]:
    """Search the residuals of a fit for a pole that the model lacks.

    Args:
        fit: The fitted model, at the minimum of its sum of squares.

    Returns:
        The pole with the highest score that satisfies Schwarz's criterion (BIC), or None; and the scores of all poles.
    """
    fit = truncate_logs(fit)
    basis, residuals = fit.inverse.basis, fit.model.weigh(fit.residuals)
    residuals = residuals - basis @ (basis.T @ residuals)
    noise_variance = fit.variance * fit.excess
    bank = _score_poles(fit, basis, residuals, noise_variance)
    squares = float(residuals @ residuals)
    # Schwarz's criterion (BIC): each further parameter must reduce -2 log(likelihood) by log(count). A complex pole has
    # two parameters and two amplitudes, a real pole one of each: two parameters per amplitude.
    threshold_per_amplitude = 2.0 * np.log(fit.count)
    for score, frequency, ratio in islice(rank_poles(bank, CANDIDATE_SPACING), N_CANDIDATES):
        reduction = score * noise_variance
        filtered = _filter_forces(fit, _build_poles(ratio, np.array([frequency])))[..., 0].T
        directions, _ = np.linalg.qr(filtered - basis @ (basis.T @ filtered))
        amplitudes = directions.T @ residuals
        # The amplitudes are D^T W e, with directions D, symmetric weights W and errors e. Their covariance is therefore
        # that of the unweighted errors along the columns of W D. The excess of block sums is not applied, because a
        # missing pole itself raises it.
        covariance = fit.noise.spread(fit.model.weigh(directions))
        autocorrelated = float(amplitudes @ np.linalg.solve(covariance, amplitudes))
        white = fit.count * np.log(squares / (squares - reduction)) if reduction < squares else np.inf
        # Both noise models must reject the hypothesis that no pole is missing.
        if min(autocorrelated, white) > amplitudes.size * threshold_per_amplitude:
            return HiddenPole(float(frequency), ratio < 1.0), bank
    return None, bank


def rank_poles(bank: PoleBank, spacing: float) -> Iterator[tuple[float, float, float]]:
    """Yield score, frequency and damping ratio of the poles by descending score.

    Poles whose frequency is within a factor of ``spacing`` of one already yielded are skipped.
    """
    yielded: list[float] = []
    for score, frequency, ratio in sorted(zip(bank.score, bank.frequency, bank.ratio, strict=True), reverse=True):
        if all(max(frequency / other, other / frequency) >= spacing for other in yielded):
            yielded.append(frequency)
            yield score, frequency, ratio


def bound_response(fit: FittedModel, scene: Scene, bank: PoleBank) -> MeasuredDevice:
    """Return the frequency response of the fitted device; its deviation is the largest effect of an undetected mode."""
    banks = [bank.select(bank.ratio == ratio) for ratio in BOUNDED_RATIOS]
    grid = np.unique(np.concatenate([_build_frequency_grid(scene, BAND_PHASE_STEP), banks[0].frequency]))
    response, derivatives = _evaluate_response(fit, scene.timing.period, grid)
    deviation = np.zeros(grid.size)
    for poles in banks:
        # The mode has also biased the fitted parameters; remove that bias.
        bias = poles.absorbed[:, : fit.model.parts.stop] @ derivatives.T
        change = _evaluate_unit_modes(fit, grid, poles.frequency[:, None], poles.ratio[:, None]) - bias
        deviation = np.maximum(deviation, np.max(np.abs(change) * poles.bound_mass_ratios()[:, None], 0))
    return MeasuredDevice(grid / scene.timing.period, response, deviation, scene.unit_system.rotary)


def sample_resonances(fit: FittedModel, scene: Scene, bank: PoleBank) -> HiddenResonances | None:
    """Return the posterior odds of one more resonance, and samples of the maximum stiffness with it.

    Args:
        fit: The fitted model.
        scene: The loop of the fitted device.
        bank: Scores of all poles.

    Returns:
        Odds and samples, for prior odds of one; None if no wall with virtual damping B >= 0 is stable.
    """
    odds, modes, mass_ratio = _draw_modes(bank.select(bank.ratio < 1.0))
    # The first sample has mass ratio 0: the device without a further mode. Its K_max is the reference.
    frequency, damping_ratio = modes.frequency[:, None], modes.ratio[:, None]
    # Join a grid for all samples with a fine grid around the resonance of each sample.
    common = _build_frequency_grid(scene, INTERPOLATION_PHASE_STEP)[None]
    local = frequency * (1.0 + damping_ratio * RESONANCE_OFFSETS[::2])
    local = np.clip(local, MIN_RESPONSE_FREQUENCY, MAX_FREQUENCY)
    responses, period = [], scene.timing.period
    for grid in (common, local):
        response, derivatives = _evaluate_response(fit, period, grid)
        # The mode has also biased the fitted parameters; remove that bias.
        bias = (derivatives @ modes.absorbed[:, : fit.model.parts.stop, None])[..., 0]
        change = _evaluate_unit_modes(fit, grid, frequency, damping_ratio) - bias
        responses.append(response + mass_ratio[:, None] * change)
    grid = np.concatenate([np.broadcast_to(common, (len(local), common.size)), local], -1)
    order = np.argsort(grid, -1)
    grid, response = (np.take_along_axis(each, order, -1) for each in (grid, np.concatenate(responses, -1)))
    velocity = scene.velocity.estimate(period).jet(circle_points(2.0 * np.pi * grid)).value
    reference, *stiffness = GridLimits(-1.0 / response, velocity / period).find_stiffness_max()
    return HiddenResonances(odds, np.array(stiffness) / reference) if reference > 0 else None


def _draw_modes(bank: PoleBank) -> tuple[float, PoleBank, np.ndarray]:
    """Draw modes from the posterior distribution on the grid of poles and mass ratios.

    The prior is one mode or none, with probability 1/2 each; equally likely damping ratios; equally likely poles of a
    damping ratio within `PRIOR_FREQUENCIES`; and the mass ratios `PRIOR_MASS_RATIOS` with either sign.

    Returns:
        The posterior odds of one mode against none, and the poles and mass ratios of the samples: a first one with mass
        ratio 0, then `N_SAMPLES` equally likely ones.
    """
    in_range = (bank.frequency >= PRIOR_FREQUENCIES[0]) & (bank.frequency <= PRIOR_FREQUENCIES[1])
    ratios, which = np.unique(bank.ratio, return_inverse=True)
    pole_prior = in_range / np.bincount(which, in_range)[which] / ratios.size
    sign_prior = [1.0 - NEGATIVE_PROBABILITY, NEGATIVE_PROBABILITY]
    mass_ratio_prior = np.repeat(sign_prior, PRIOR_MASS_RATIOS.size) / PRIOR_MASS_RATIOS.size
    mass_ratios = np.concatenate([PRIOR_MASS_RATIOS, -PRIOR_MASS_RATIOS])
    # Relative to its standard error with autocorrelation, the projection is normal with variance 1. Its mean is the
    # shift, which is 0 without a mode.
    shift = np.outer(bank.signature_size / bank.error_inflation, mass_ratios)
    likelihood_ratio = np.exp((bank.projection / bank.error_inflation)[:, None] * shift - 0.5 * shift**2)
    cumulative = np.cumsum(np.outer(pole_prior, mass_ratio_prior) * likelihood_ratio)
    # Systematic sampling: equidistant quantiles of the discrete distribution.
    sampled = np.searchsorted(cumulative, cumulative[-1] * (np.arange(N_SAMPLES) + 0.5) / N_SAMPLES)
    poles, mass_ratio = np.divmod(sampled, mass_ratios.size)
    return float(cumulative[-1]), bank.select(np.append(poles[0], poles)), np.append(0.0, mass_ratios[mass_ratio])


def _build_frequency_grid(scene: Scene, phase_step: float) -> np.ndarray:
    """Build a frequency grid for the response of the fitted device.

    The delay changes the phase by at most ``phase_step`` between neighboring frequencies. The grid is logarithmic below
    the pole bank and has further points around the resonances of the device.
    """
    count = 2.0 * np.pi * MAX_FREQUENCY * (1.0 + scene.d) / phase_step
    even = np.arange(1.0, count) * phase_step / (2.0 * np.pi * (1.0 + scene.d))
    below = np.geomspace(MIN_RESPONSE_FREQUENCY, MIN_FREQUENCY, N_BELOW_BANK)[:-1]
    around_modes = [
        mode.frequency * scene.timing.period * (1.0 + mode.damping_ratio * RESONANCE_OFFSETS)
        for mode in scene.device.modes
    ]
    grid = np.concatenate([below, even[even > MIN_FREQUENCY], *around_modes])
    return grid[(grid >= MIN_RESPONSE_FREQUENCY) & (grid <= MAX_FREQUENCY)]


def _evaluate_unit_modes(fit: FittedModel, grid: np.ndarray, frequency: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Return the contribution of unit modes to the frequency response."""
    (g, delta, d), mode = fit.theta[:3], (2.0 * np.pi * frequency, ratio, np.sqrt(1.0 - ratio**2))
    return g * CriticalController(delta, d, (), [mode]).evaluate_parts(circle_points(2.0 * np.pi * grid))


def _evaluate_response(fit: FittedModel, period: float, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the response of the fitted device, and along a last axis its derivatives in the device parameters."""
    points = circle_points(2.0 * np.pi * grid.ravel())

    def evaluate(theta: np.ndarray) -> np.ndarray:
        controller = CriticalController(*fit.model.normalize(theta, period)[1:])
        return (-theta[0] / controller.evaluate(points)).reshape(grid.shape)

    count, response = fit.model.parts.stop, evaluate(fit.theta)
    steps = np.abs(fit.theta[:count])
    steps[1:3] = np.maximum(steps[1:3], 1e-3)  # damping and delay may be 0
    steps *= DIFFERENCE_STEP
    units = np.eye(count, fit.theta.size)
    shifted = [evaluate(fit.theta + step * unit) for step, unit in zip(steps, units, strict=True)]
    return response, (np.stack(shifted, -1) - response[..., None]) / steps


def truncate_logs(fit: FittedModel) -> FittedModel:
    """Return the fit, restricted to the first `MAX_SAMPLES` positions of each log."""
    if max(log.position.size for log in fit.model.logs) <= MAX_SAMPLES:
        return fit
    part = replace(fit, model=fit.model.truncate(MAX_SAMPLES), rivals=())
    part = replace(part, squares=float(part.residuals @ part.residuals))
    return replace(part, model=replace(part.model, noise=part.noise)) if fit.model.noise is not None else part


def _score_poles(fit: FittedModel, basis: np.ndarray, residuals: np.ndarray, noise_variance: float) -> PoleBank:
    """Compute the score test of all candidate poles.

    Args:
        fit: The fitted model.
        basis: Orthonormal basis of the columns of W J.
        residuals: Weighted residuals, orthogonal to ``basis``.
        noise_variance: Variance of white noise.
    """
    # The pole -inf has decay factor 0, so this filter returns the latest force, which the unit modes need.
    last = _filter_forces(fit, np.array([-np.inf]))[0]
    last_in_basis = basis.T @ last
    last_outside = last - basis @ last_in_basis
    basis_to_theta = fit.inverse.matrix @ basis / fit.columns[1][:, None]
    batch_size = max(1, BATCH_SIZE // (2 * residuals.size))
    batches = []
    for ratio, spacing in FREQUENCY_SPACING.items():
        count = 1 + round(np.log(MAX_FREQUENCY / MIN_FREQUENCY) / np.log(spacing))
        frequencies = np.geomspace(MIN_FREQUENCY, MAX_FREQUENCY, count)
        for frequency in np.split(frequencies, range(batch_size, count, batch_size)):
            poles = _build_poles(ratio, frequency)
            filtered, (gain, last_gain) = _filter_forces(fit, poles), _expand_unit_modes(fit, poles)
            in_basis = basis.T @ filtered
            outside = filtered - basis @ in_basis
            remaining = np.linalg.norm(outside, axis=1).min(0)
            is_absorbed = remaining <= ABSORBED_NORM * np.linalg.norm(filtered, axis=1).max(0)
            # Least squares of the residuals by the real and imaginary part of each filtered force.
            gram = np.array([[np.sum(one * other, 0) for other in outside] for one in outside]).T
            inner, inverse = (residuals @ outside).T, np.linalg.pinv(gram, rcond=ABSORBED_NORM**2, hermitian=True)
            reduction = np.where(is_absorbed, 0.0, np.einsum("ki,kij,kj->k", inner, inverse, inner))
            # The signature of the unit mode. For absorbed poles an infinite norm makes the projection 0 and the error
            # inflation 1.
            signature = np.sum(outside * gain[:, None], 0) - last_outside * last_gain
            norm = np.linalg.norm(signature, axis=0)
            size, norm = norm / np.sqrt(noise_variance), np.where(is_absorbed | (norm == 0), np.inf, norm)
            projection = residuals @ signature / norm / np.sqrt(noise_variance)
            variance = fit.noise.spread_each(fit.model.weigh(signature)) * fit.excess
            inflation = np.sqrt(np.maximum(variance / norm**2 / noise_variance, 1.0))
            absorbed = basis_to_theta @ (np.sum(in_basis * gain[:, None], 0) - last_in_basis * last_gain)
            scores = reduction / noise_variance, size, projection, inflation, absorbed.T
            batches.append(PoleBank(np.full_like(frequency, ratio), frequency, *scores))
    return PoleBank(*map(np.concatenate, zip(*batches, strict=True)))


def _expand_unit_modes(fit: FittedModel, poles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Expand the position of each unit mode in the filtered forces of `_filter_forces`.

    A force that was held for a whole period contributes ``(e^p - 1) e^(-f p)/p`` times the filtered force, with f
    the fractional part of the delay. The latest force has acted for 1 - f periods only, which subtracts
    ``(1 - e^(-f p))/p`` times that force. The position is the imaginary part, multiplied by g/|p|.

    Returns:
        The gains of the real and the imaginary part of the filtered force, one row each; and the gain of the latest
        force, to be subtracted. They are 0 for real poles, of which only the score is used.
    """
    unit, delayed = fit.theta[0] / np.abs(poles) / poles, np.exp(-(fit.theta[2] % 1.0) * poles)
    gain = unit * np.expm1(poles) * delayed
    # Im(gain (x + j y)) = Im(gain) x + Re(gain) y.
    return np.array([gain.imag, gain.real] if np.iscomplexobj(poles) else [gain.imag]), (unit * (1.0 - delayed)).imag


def _build_poles(ratio: float, frequency: np.ndarray) -> Any:
    """Return the poles s T of one damping ratio; they are real for damping ratio 1."""
    return 2.0 * np.pi * frequency * (-1.0 if ratio == 1.0 else complex(-ratio, np.sqrt(1.0 - ratio**2)))


def _filter_forces(fit: FittedModel, poles: np.ndarray) -> np.ndarray:
    """Filter the forces of all logs with each pole, delay them by the integer delay, and weight the samples.

    Returns:
        An array of shape (parts, samples, poles): the real and, for complex poles, the imaginary part.
    """
    n, logs = int(fit.theta[2]), fit.model.logs
    filtered = [
        [recur(decay, np.append(0.0, log.force[:-1]))[log.skip - n :][: log.position.size] for log in logs]
        for decay in np.exp(poles).tolist()
    ]
    joined: Any = np.array([np.concatenate(each) for each in filtered])
    parts = [joined.real, joined.imag] if np.iscomplexobj(joined) else [joined]
    return np.array([fit.model.weigh(part.T) for part in parts])
