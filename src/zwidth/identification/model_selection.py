"""Select the structure of a device by the BIC: a rigid mass, or a mass with an actuator lag and resonances.

Starting from the rigid mass, a score test of the residuals (`zwidth.identification.unmodeled_dynamics`,
`identification.unmodeled_lag`)
decides whether the model lacks a pole or a lag. If so, all models with one *part* more are fitted: an actuator lag of
the next order, or a resonance (*mode*) at one of the frequencies with the highest scores. The Bayesian information
criterion (BIC, Schwarz 1978) selects the model with the lowest sum of the *misfit*, -2 log(likelihood), and log(N) per
parameter, for N positions. Then the residuals are tested again. ``theta`` is the parameter vector of
`zwidth.identification.extended_model.Recordings`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from zwidth.identification.extended_model import Recordings
from zwidth.identification.output_error import CLOSELY, NEARLY, FittedModel, fit_nonnegative, minimize_squares
from zwidth.identification.unmodeled_dynamics import HiddenPole, PoleBank, detect_missing_pole, rank_poles
from zwidth.identification.unmodeled_lag import LagTest, score_lags

_MAX_PARTS = 4  # largest number of parts added to the rigid mass; each order of the actuator lag counts as one
_N_COMPARED = 2500  # number of leading positions of each log on which the candidate models are compared, to save time
_FIRST_STEPS = 20  # largest number of Levenberg-Marquardt steps from each initial value
_FURTHER_STEPS = 40  # largest number of further steps, from the best result for each structure
ALIKE = 1.5  # largest autocorrelation measure `FittedModel.excess` of residuals that count as white noise
EXACT = 1e-9  # RMS residual, relative to the range of positions, below which residuals are rounding errors
# Reduction of the misfit that two unnecessary parameters exceed by chance with a probability of 5 % (chi-square).
_BY_CHANCE = 5.99
# Initial values of the parameters of an actuator lag.
_TIME_CONSTANTS = (0.3, 1.5)  # time constants, in sampling periods
_DAMPING_RATIO = 0.7  # initial damping ratio of a second-order lag
# Initial values of the frequency of a resonance.
_N_FREQUENCIES = 2  # number of frequencies: those of the highest scores
_FREQUENCY_SPACING = float(np.exp(0.2))  # least ratio of two initial frequencies, so that they are different peaks

Choice = tuple[FittedModel, HiddenPole | None, PoleBank | None, LagTest | None]


def choose_structure(best: FittedModel) -> Choice:
    """Extend the model of a rigid device by actuator lags and resonances until its residuals are white noise.

    If no extended model leaves white noise, the rigid device is returned.

    Returns:
        A tuple of four: the selected model; the pole that the model lacks, or the resonance that may replace its lag,
        None if there is neither; the scores of all candidate poles; and the test for lags. The scores are None if the
        residuals are rounding errors. The test for lags is None in this case too, and if a pole is missing or the model
        has a lag.
    """
    span = max(float(np.ptp(log.position)) for log in best.model.logs)
    if float(best.residuals @ best.residuals) <= EXACT**2 * best.residuals.size * span**2:
        return best, None, None, None
    rigid = best, pole, bank, lags = _test_residuals(best)
    alternative = None
    for _ in range(_MAX_PARTS):
        # Use the test for lags as well, because it is more sensitive to lags than the scores of the poles: the
        # amplitude of the effect of a lag is known, so this test does not estimate it.
        has_lag = lags is not None and lags.projection.max() ** 2 > 2.0 * np.log(best.count)
        if bank is None or alternative or (pole is None and not has_lag):
            break
        larger, alternative = _add_part(best, bank)
        if larger is None:
            break
        best, pole, bank, lags = _test_residuals(larger)
    if best is rigid[0] or not (alternative or (pole is None and best.excess <= ALIKE)):
        return rigid
    best = fit_nonnegative(best.model, best.theta)
    is_determined = best.converged and not best.inverse.undetermined[: best.model.parts.stop].any()
    return (best, alternative or pole, bank, lags) if is_determined else rigid


def _test_residuals(best: FittedModel) -> Choice:
    """Test the residuals for a missing pole and, if none is detected and the model has no lag, for a missing lag.

    Returns:
        The model, the missing pole, the scores of all poles, and the test for lags, as in `choose_structure`.
    """
    pole, bank = detect_missing_pole(best)
    return best, pole, bank, None if pole or best.model.lag else score_lags(best)


def _add_part(best: FittedModel, bank: PoleBank) -> tuple[FittedModel | None, HiddenPole | None]:
    """Fit all models with one part more than ``best``, and return the one that the BIC selects.

    A weak resonance has nearly the same effect on the positions as a lag, which has fewer parameters, but its K_max is
    very different. Therefore a resonance that fits significantly better than the selected lag is returned as well.

    Returns:
        The selected model, None if ``best`` itself satisfies the criterion better; and the resonance, or None.
    """
    first_fits: dict[tuple[int, int], tuple[float, Recordings, np.ndarray]] = {}
    for lag, modes, start in _list_starts(best, bank):
        model = replace(best.model, lag=lag, modes=modes).truncate(_N_COMPARED)
        theta, squares, _ = minimize_squares(model, start, (), _FIRST_STEPS, CLOSELY)
        if squares < first_fits.get((lag, modes), (np.inf,))[0]:
            first_fits[lag, modes] = squares, model, theta
    tried = []
    for _, model, start in first_fits.values():
        theta, squares, _ = minimize_squares(model, start, (), _FURTHER_STEPS, CLOSELY)
        misfit = model.measured.size * np.log(squares)
        tried.append((misfit + theta.size * np.log(model.measured.size), misfit, model, theta))
    _, least, model, theta = min(tried, key=lambda trial: trial[0])
    model = replace(model, logs=best.model.logs)
    selected = fit_nonnegative(model, theta, (), NEARLY)
    if model.resolution:
        selected = fit_nonnegative(replace(model, noise=selected.noise), selected.theta, (), NEARLY)
    if best.compare_misfit(selected) <= (selected.theta.size - best.theta.size) * np.log(best.count):
        return None, None
    for _, misfit, other, theta in tried:
        if other.modes > model.modes and misfit < least - _BY_CHANCE:
            return selected, HiddenPole(float(theta[other.parts.stop - 3]) / (2.0 * np.pi), True, replaces_lag=True)
    return selected, None


def _list_starts(best: FittedModel, bank: PoleBank) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield initial values for all models with one part more than ``best``.

    Each item contains the order of the lag, the number of modes, and the initial theta.
    """
    model, theta = best.model, best.theta
    lag, modes, logs, first = model.lag, model.modes, len(model.logs), model.parts.stop
    if lag == 0:
        for delay in _TIME_CONSTANTS:
            if delay <= theta[2] + 0.5:
                start = [theta[0], theta[1], max(theta[2] - delay, 0.0), delay]
                yield 1, modes, np.r_[start, theta[3:]]
                yield 2, modes, np.r_[start, _DAMPING_RATIO, theta[3:]]
    elif lag == 1:
        yield 2, modes, np.r_[theta[:4], _DAMPING_RATIO, theta[4:]]
    # Start with a mass ratio and a free response of 0 for the new mode, so that the model reproduces ``best`` exactly.
    rigid_states, states = np.split(theta[first:-2], [2 * logs])
    states = np.concatenate([states.reshape(logs, -1), np.zeros((logs, 2))], 1).ravel()
    complex_poles = bank.select(bank.ratio < 1.0)
    for _, frequency, ratio in islice(rank_poles(complex_poles, _FREQUENCY_SPACING), _N_FREQUENCIES):
        mode = [2.0 * np.pi * frequency, ratio, 0.0]
        yield lag, modes + 1, np.r_[theta[:first], mode, rigid_states, states, theta[-2:]]
