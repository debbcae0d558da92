"""Detect actuator lags and structural resonances missing from a fitted model, and bound the undetected ones.

Model. The weighted residuals of a fit are ``e = r s + n``: s is the signature of one missing pole, r its size, and n
noise of variance ``sigma^2``. The *signature* of a mode or lag is the part of its effect on the positions that no
change of the fitted parameters ``theta`` (`identification.extended_model.Recordings`) reproduces; theta begins with g =
T^2/m, delta = b T/m and the delay, followed by the parameters of a lag and of modes. A mode of *mass ratio* r has the
modal mass ``m/(r sqrt(1 - zeta^2))``, with the mass m of the device and the damping ratio zeta of the mode, so that
sqrt(1 - zeta^2) cancels in its response; r is negative if actuator and sensor are on opposite sides of a node. A *unit
mode* has mass ratio 1. J are the derivatives of the positions with respect to theta, W the weights of the samples.
``sigma^2`` includes ``fit.excess``, the factor by which autocorrelation increases the variance of sums of residuals.
Unless stated otherwise, times are in sampling periods and frequencies are relative to the sampling rate.

The candidates are a bank of poles: a grid of frequencies for each of a few damping ratios, and real poles for actuator
lags. No model with a candidate is fitted. A pole is *absorbed* if a change of ``theta`` reproduces nearly all of its
effect. K_max is the maximum stiffness of a wall. The steps are explained in docs/theory/hidden.md:

1. Score: the reduction of the sum of squares, in sigma^2, if the real and imaginary part of the force filtered by the
   pole are added to the model (Rao 1948). If no pole is missing, the score of one given pole is a chi-square variable
   with 2 degrees of freedom for a complex pole, 1 for a real one.
2. Detection: `detect_missing_pole` returns the pole of the highest score if it satisfies the Bayesian information
   criterion (BIC, Schwarz 1978) for white noise and for the autocorrelated errors of the encoder.
3. Bound: if no pole is detected, |r| is at most ``(sqrt(score) + 4 error)/size``, with ``size = |s|/sigma`` of the unit
   mode and the local standard ``error``, at least 1. sqrt(score) is about |t| of step 4 or more, because the score fits
   both amplitudes freely. `bound_response` computes the largest change of the response by such a mode, a radius that
   limits the safe walls.
4. Averaging: with ``t = s'e/(sigma^2 size)``, the likelihood ratio of a device with one more mode to one without it is
   ``exp(t r size - (r size)^2/2)``. Its mean over the prior is the posterior odds; `sample_resonances` draws modes from
   the posterior and computes K_max with each (Bayesian model averaging, Hoeting et al. 1999).
5. Lags: `identification.unmodeled_lag.bound_lag` returns the longest first-order actuator lag that the data cannot
   distinguish from pure delay.

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

from zwidth.analysis.measured_curve import LEAST_DAMPING_RATIO
from zwidth.analysis.scene import Scene
from zwidth.identification.friction_model import recur
from zwidth.identification.grid_limits import GridLimits
from zwidth.identification.output_error import FittedModel
from zwidth.model.circle_functions import circle_points
from zwidth.model.measured_device import MeasuredDevice
from zwidth.plant.sampled_plant import sample_parts

# Grid of candidate poles (the bank). Frequencies are relative to the sampling rate.
MIN_FREQUENCY = 0.005  # lowest natural frequency in the bank
MAX_FREQUENCY = 0.49  # highest natural frequency in the bank, just below the Nyquist frequency
# For each damping ratio in the bank, the ratio of successive frequencies. The damping ratio 1.0 represents real poles
# (actuator lags).
FREQUENCY_SPACING = {LEAST_DAMPING_RATIO: 1.01, 0.03: 1.06, 0.2: 1.06, 1.0: 1.06}
BOUNDED_RATIOS = (LEAST_DAMPING_RATIO, 0.03)  # damping ratios of the undetected modes that `bound_response` considers
# A pole counts as absorbed if the part of the filtered force that is orthogonal to the weighted derivatives J is
# smaller than this share of the norm of the filtered force.
ABSORBED_NORM = 1e-6

# Constants of the detection of a missing pole.
# Number of poles with the highest scores that are tested for autocorrelated encoder errors as well. It is more than
# one, because these errors can raise the score of a wrong pole above that of the missing one.
N_CANDIDATES = 3
CANDIDATE_SPACING = 1.1  # least ratio of the frequencies of two tested poles, so that they are different peaks
MAX_SAMPLES = 20_000  # number of leading samples of each log that are tested, to limit the time
BATCH_SIZE = 400_000  # number of values per batch of filtered forces, to limit the memory

# Constants of the upper bound of an undetected mode.
BOUND_ERRORS = 4.0  # number of standard errors that are added to the estimated amplitude of the mode
N_NEIGHBORS = 15  # number of poles on each side whose scores determine the local standard error

# Frequency grid of the response, relative to the sampling rate.
MIN_RESPONSE_FREQUENCY = 2e-4  # lowest frequency of the grid
N_BELOW_BANK = 40  # number of grid frequencies below the lowest frequency of the bank
BAND_PHASE_STEP = 0.3  # rad; largest phase change by the delay between neighboring frequencies in `bound_response`
# The same limit for `sample_resonances`, in rad: the largest phase change by the delay between neighboring frequencies.
# It is smaller than `BAND_PHASE_STEP`, because the response is interpolated linearly between the frequencies.
INTERPOLATION_PHASE_STEP = 0.06
# Distances of the additional grid points from a resonance frequency, in half-widths of the resonance.
RESONANCE_OFFSETS = np.sinh(np.linspace(-4.0, 4.0, 61))
DIFFERENCE_STEP = 1e-6  # relative step of finite differences in theta

# Prior distribution of one more resonance.
PRIOR_FREQUENCIES = (0.03, 0.4)  # lowest and highest frequency, relative to the sampling rate
PRIOR_MASS_RATIOS = np.geomspace(1.0 / 30.0, 1.0, 9)  # possible values of |r|, equally likely
NEGATIVE_PROBABILITY = 0.3  # probability that the mass ratio is negative
N_SAMPLES = 200  # number of resonances that are sampled from the posterior distribution


class HiddenResonances(NamedTuple):
    """The posterior odds of one undetected resonance, and the maximum stiffness for each sample of this resonance."""

    odds: float  # posterior odds of one more resonance against none
    stiffness_max: np.ndarray  # K_max with each sampled resonance, relative to K_max without it; equally likely values


class HiddenPole(NamedTuple):
    """A pole that the fitted model lacks, or a resonance that fits the log as well as the actuator lag of the model."""

    frequency: float  # natural frequency of the pole, relative to the sampling rate
    is_resonance: bool  # True for a complex pole (resonance), False for a real pole (actuator lag)
    # True if the pole is an alternative to the actuator lag and fits as well (set by `identification.model_selection`)
    replaces_lag: bool = False


class PoleBank(NamedTuple):
    """Results of the score test for all candidate poles, as arrays with one entry per pole.

    Standard errors are those for white noise.
    """

    ratio: np.ndarray  # damping ratio of each pole, 1 for real poles
    frequency: np.ndarray  # natural frequency of each pole, relative to the sampling rate
    score: np.ndarray  # reduction of the sum of squares, in noise variances; chi-square if no pole is missing
    signature_size: np.ndarray  # norm of the signature of the unit mode, in standard errors
    projection: np.ndarray  # projection of the residuals onto the signature of the unit mode, in standard errors
    error_inflation: np.ndarray  # standard error for autocorrelated encoder errors, relative to white noise; >= 1
    absorbed: np.ndarray  # bias of the fitted theta caused by omitting the unit mode; one column per parameter

    def select(self, mask: np.ndarray) -> PoleBank:
        """Return the entries of the poles that a boolean mask selects."""
        return PoleBank(*(field[mask] for field in self))

    def bound_mass_ratios(self) -> np.ndarray:
        """Compute an upper bound of the mass ratio |r| of an undetected mode at each pole.

        All poles of the bank must be complex and have the same damping ratio.
        """
        # Estimate the local noise variance, relative to the assumed one, as half the mean score of the neighboring
        # poles, because the expected score of a complex pole is 2 for white noise.
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
        The pole with the highest score that satisfies the BIC, or None; and the scores of all poles.
    """
    fit = truncate_logs(fit)
    basis, residuals = fit.inverse.basis, fit.model.weigh(fit.residuals)
    residuals = residuals - basis @ (basis.T @ residuals)
    noise_variance = fit.variance * fit.excess
    bank = _score_poles(fit, basis, residuals, noise_variance)
    squares = float(residuals @ residuals)
    # The BIC requires that each further parameter reduces -2 log(likelihood) by log(count). A complex
    # pole adds two real parameters for the pole and two amplitudes, a real pole one of each. Both therefore add two
    # parameters per amplitude.
    threshold_per_amplitude = 2.0 * np.log(fit.count)
    for score, frequency, ratio in islice(rank_poles(bank, CANDIDATE_SPACING), N_CANDIDATES):
        reduction = score * noise_variance
        filtered = _filter_forces(fit, _build_poles(ratio, np.array([frequency])))[..., 0].T
        directions, _ = np.linalg.qr(filtered - basis @ (basis.T @ filtered))
        amplitudes = directions.T @ residuals
        # The amplitudes are D^T W e, with the directions D, the symmetric weights W and the errors e. Therefore their
        # covariance is (W D)^T C (W D) with the covariance C of the errors. Do not multiply it by ``fit.excess``,
        # because a missing pole itself increases the excess.
        covariance = fit.noise.spread(fit.model.weigh(directions))
        autocorrelated = float(amplitudes @ np.linalg.solve(covariance, amplitudes))
        white = fit.count * np.log(squares / (squares - reduction)) if reduction < squares else np.inf
        # Require that both noise models, white noise and autocorrelated encoder errors, reject the hypothesis that no
        # pole is missing.
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
    """Return the frequency response of the fitted device, with a deviation that covers any undetected mode.

    At each frequency, the deviation is the largest change of the response by a mode whose mass ratio has the upper
    bound of `PoleBank.bound_mass_ratios`.

    Args:
        fit: The fitted model.
        scene: The scene of the fitted device.
        bank: Scores of all candidate poles.
    """
    banks = [bank.select(bank.ratio == ratio) for ratio in BOUNDED_RATIOS]
    grid = np.unique(np.concatenate([_build_frequency_grid(scene, BAND_PHASE_STEP), banks[0].frequency]))
    response, derivatives = _evaluate_response(fit, scene.timing.period, grid)
    deviation = np.zeros(grid.size)
    for poles in banks:
        # An undetected mode also biases the fitted theta. Subtract the change of the response that this bias causes.
        bias = poles.absorbed[:, : fit.model.parts.stop] @ derivatives.T
        change = _evaluate_unit_modes(fit, grid, poles.frequency[:, None], poles.ratio[:, None]) - bias
        deviation = np.maximum(deviation, np.max(np.abs(change) * poles.bound_mass_ratios()[:, None], 0))
    return MeasuredDevice(grid / scene.timing.period, response, deviation, scene.unit_system.rotary)


def sample_resonances(fit: FittedModel, scene: Scene, bank: PoleBank) -> HiddenResonances | None:
    """Compute the posterior odds of one undetected resonance, and K_max for random samples of this resonance.

    Args:
        fit: The fitted model.
        scene: The scene of the fitted device.
        bank: Scores of all candidate poles.

    Returns:
        Odds and values of K_max, for prior odds of one; None if no wall with damping B >= 0 is stable.
    """
    odds, modes, mass_ratio = _draw_modes(bank.select(bank.ratio < 1.0))
    # The first sample has mass ratio 0 and represents the device without a further mode. Its K_max is the reference for
    # the K_max of the other samples.
    frequency, damping_ratio = modes.frequency[:, None], modes.ratio[:, None]
    # Evaluate the response of each sample on a common grid joined with a fine grid around its resonance.
    common = _build_frequency_grid(scene, INTERPOLATION_PHASE_STEP)[None]
    local = frequency * (1.0 + damping_ratio * RESONANCE_OFFSETS[::2])
    local = np.clip(local, MIN_RESPONSE_FREQUENCY, MAX_FREQUENCY)
    responses, period = [], scene.timing.period
    for grid in (common, local):
        response, derivatives = _evaluate_response(fit, period, grid)
        # An undetected mode also biases the fitted theta. Subtract the change of the response that this bias causes.
        bias = (derivatives @ modes.absorbed[:, : fit.model.parts.stop, None])[..., 0]
        change = _evaluate_unit_modes(fit, grid, frequency, damping_ratio) - bias
        responses.append(response + mass_ratio[:, None] * change)
    grid = np.concatenate([np.broadcast_to(common, (len(local), common.size)), local], -1)
    order = np.argsort(grid, -1)
    grid, response = (np.take_along_axis(each, order, -1) for each in (grid, np.concatenate(responses, -1)))
    velocity = scene.velocity.estimate(period).jet(circle_points(2.0 * np.pi * grid)).value
    # Pass q and the velocity estimate per second, one row per sample; entry 0 belongs to the device without a mode.
    reference, *stiffness = GridLimits(-1.0 / response, velocity / period).find_stiffness_max()
    return HiddenResonances(odds, np.array(stiffness) / reference) if reference > 0 else None


def _draw_modes(bank: PoleBank) -> tuple[float, PoleBank, np.ndarray]:
    """Draw modes from the posterior distribution on the grid of poles and mass ratios.

    In the prior, the device has one further mode or none, with probability 1/2 each. All damping ratios are equally
    likely, and so are all poles with the same damping ratio and a frequency within `PRIOR_FREQUENCIES`. The mass ratio
    has a magnitude of `PRIOR_MASS_RATIOS` and is negative with probability `NEGATIVE_PROBABILITY`.

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
    # Divided by its standard error for autocorrelated errors, the projection is normal with variance 1. Its mean is 0
    # without a mode; a mode changes the mean to ``shift``.
    shift = np.outer(bank.signature_size / bank.error_inflation, mass_ratios)
    likelihood_ratio = np.exp((bank.projection / bank.error_inflation)[:, None] * shift - 0.5 * shift**2)
    cumulative = np.cumsum(np.outer(pole_prior, mass_ratio_prior) * likelihood_ratio)
    # Sample equidistant quantiles of the discrete distribution instead of random ones (systematic sampling), because
    # the result is then reproducible and more accurate.
    sampled = np.searchsorted(cumulative, cumulative[-1] * (np.arange(N_SAMPLES) + 0.5) / N_SAMPLES)
    poles, mass_ratio = np.divmod(sampled, mass_ratios.size)
    return float(cumulative[-1]), bank.select(np.append(poles[0], poles)), np.append(0.0, mass_ratios[mass_ratio])


def _build_frequency_grid(scene: Scene, phase_step: float) -> np.ndarray:
    """Build a frequency grid, relative to the sampling rate, for the response of the fitted device.

    The grid is logarithmic below the frequencies of the pole bank, equidistant above their lowest one, and has
    additional points around the resonances of the device.

    Args:
        scene: The scene of the fitted device.
        phase_step: Largest phase change by the delay and one more period between neighboring frequencies, in rad.
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
    """Return the contribution of unit modes to the frequency response of the device.

    Args:
        fit: The fitted model.
        grid: Frequencies, relative to the sampling rate.
        frequency: Natural frequencies of the modes; broadcasts with ``grid``.
        ratio: Damping ratios of the modes; broadcasts with ``grid``.
    """
    (g, delta, d), mode = fit.theta[:3], (2.0 * np.pi * frequency, ratio, np.sqrt(1.0 - ratio**2))
    return g * sample_parts(delta, d, (), [mode]).parts_response(circle_points(2.0 * np.pi * grid))


def _evaluate_response(fit: FittedModel, period: float, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the frequency response of the fitted device, and its derivatives with respect to the device parameters.

    Args:
        fit: The fitted model.
        period: Sampling period in s.
        grid: Frequencies, relative to the sampling rate.

    Returns:
        The response, and the derivatives with an additional last axis over the parameters.
    """
    points = circle_points(2.0 * np.pi * grid.ravel())

    def evaluate(theta: np.ndarray) -> np.ndarray:
        plant = sample_parts(*fit.model.normalize(theta, period)[1:])
        return (theta[0] * plant.response(points)).reshape(grid.shape)

    count, response = fit.model.parts.stop, evaluate(fit.theta)
    steps = np.abs(fit.theta[:count])
    steps[1:3] = np.maximum(steps[1:3], 1e-3)  # absolute, because only damping and delay may be 0
    steps *= DIFFERENCE_STEP
    units = np.eye(count, fit.theta.size)
    shifted = [evaluate(fit.theta + step * unit) for step, unit in zip(steps, units, strict=True)]
    return response, (np.stack(shifted, -1) - response[..., None]) / steps


def truncate_logs(fit: FittedModel) -> FittedModel:
    """Return a copy of the fit with the same theta and only the first `MAX_SAMPLES` positions of each log."""
    if max(log.position.size for log in fit.model.logs) <= MAX_SAMPLES:
        return fit
    # Drop the alternatives, which only affect the covariance of theta, and estimate the noise from the shorter logs.
    part = replace(fit, model=fit.model.truncate(MAX_SAMPLES), alternatives=())
    part = replace(part, squares=float(part.residuals @ part.residuals))
    return replace(part, model=replace(part.model, noise=part.noise)) if fit.model.noise is not None else part


def _score_poles(fit: FittedModel, basis: np.ndarray, residuals: np.ndarray, noise_variance: float) -> PoleBank:
    """Compute the score test for all candidate poles, in batches of frequencies.

    Args:
        fit: The fitted model.
        basis: Orthonormal basis of the columns of W J.
        residuals: Weighted residuals, orthogonal to ``basis``.
        noise_variance: Variance sigma^2 of the noise.
    """
    # Filter with the pole -inf, whose decay factor is 0, to obtain the latest force, because the positions of the unit
    # modes depend on it.
    last = _filter_forces(fit, np.array([-np.inf]))[0]
    last_in_basis = basis.T @ last
    last_outside = last - basis @ last_in_basis
    # Map coefficients in the basis to changes of theta: the pseudo-inverse of W J, divided by its column scales.
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
            # A complex pole is absorbed if one of its two parts is.
            remaining = np.linalg.norm(outside, axis=1).min(0)
            is_absorbed = remaining <= ABSORBED_NORM * np.linalg.norm(filtered, axis=1).max(0)
            # Fit the residuals by the real and the imaginary part of each filtered force, by least squares.
            gram = np.array([[np.sum(one * other, 0) for other in outside] for one in outside]).T
            inner, inverse = (residuals @ outside).T, np.linalg.pinv(gram, rcond=ABSORBED_NORM**2, hermitian=True)
            reduction = np.where(is_absorbed, 0.0, np.einsum("ki,kij,kj->k", inner, inverse, inner))
            # Compute the signature of each unit mode. The norm of absorbed poles is set to infinity, so that their
            # projection becomes 0 and their error inflation 1.
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
    """Compute the coefficients that express the position of each unit mode as a combination of filtered forces.

    Let p be the pole, f the fractional part of the delay and g = T^2/m. If all forces acted for a whole period, the
    response of the pole would be ``(e^p - 1) e^(-f p)/p`` times the filtered force. The latest force has acted for
    1 - f periods only; therefore ``(1 - e^(-f p))/p`` times this force is subtracted. The position is the imaginary
    part of the difference, multiplied by g/|p|.

    Returns:
        The coefficients of the real and the imaginary part of the filtered force, one row each; and the coefficient of
        the latest force, to be subtracted. Those of real poles are 0, because only the score of these is used.
    """
    unit, delayed = fit.theta[0] / np.abs(poles) / poles, np.exp(-(fit.theta[2] % 1.0) * poles)
    gain = unit * np.expm1(poles) * delayed
    # The imaginary part of gain (x + j y) is Im(gain) x + Re(gain) y, for the filtered force x + j y of a complex pole.
    return np.array([gain.imag, gain.real] if np.iscomplexobj(poles) else [gain.imag]), (unit * (1.0 - delayed)).imag


def _build_poles(ratio: float, frequency: np.ndarray) -> Any:
    """Return the dimensionless poles s T with given damping ratio and frequencies; real poles for damping ratio 1."""
    return 2.0 * np.pi * frequency * (-1.0 if ratio == 1.0 else complex(-ratio, np.sqrt(1.0 - ratio**2)))


def _filter_forces(fit: FittedModel, poles: np.ndarray) -> np.ndarray:
    """Filter the forces of all logs by each pole, delay them by the integer delay, and weight the samples.

    Returns:
        An array of shape (parts, samples, poles). The parts are the real and the imaginary part for complex poles, and
        only the real part for real poles.
    """
    n, logs = int(fit.theta[2]), fit.model.logs
    filtered = [
        [recur(decay, np.append(0.0, log.force[:-1]))[log.skip - n :][: log.position.size] for log in logs]
        for decay in np.exp(poles).tolist()
    ]
    joined: Any = np.array([np.concatenate(each) for each in filtered])
    parts = [joined.real, joined.imag] if np.iscomplexobj(joined) else [joined]
    return np.array([fit.model.weigh(part.T) for part in parts])
