"""Selection of the structure of a device by Schwarz's criterion: rigid, or with an actuator lag and resonances."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from zwidth.fitting.hidden import HiddenPole, PoleBank, detect_missing_pole, rank_poles
from zwidth.fitting.hidden_lag import LagTest, score_lags
from zwidth.fitting.output_error import CLOSELY, NEARLY, FittedModel, refine, settle
from zwidth.fitting.structure import Recordings

_MOST = 4  # largest number of parts that are added: orders of the actuator lag, and resonances
_TOLD = 2500  # positions of each log with which the candidates are compared
_BEGUN = 20  # iterations from each initial value
_COMPARED = 40  # further iterations of the best candidate of each structure
ALIKE = 1.5  # largest excess (`FittedModel.excess`) of residuals that count as white noise
EXACT = 1e-9  # residuals below this size, relative to the range of positions, are rounding errors
_BY_CHANCE = 5.99  # reduction of -2 log(likelihood) by two superfluous parameters, exceeded with probability 5 %
# Initial values of actuator lags.
_LAGS = (0.3, 1.5)  # time constants, in periods
_RATIO = 0.7  # damping ratio of a second-order lag
# Initial values of resonances.
_PARTED = 2  # number of initial frequencies
_APART = float(np.exp(0.2))  # least ratio of two initial frequencies

Choice = tuple[FittedModel, HiddenPole | None, PoleBank | None, LagTest | None]


def choose_structure(best: FittedModel) -> Choice:
    """Add actuator lags and resonances to a rigid device as long as the residuals require them.

    If the residuals of the final model are not white noise, the rigid device is returned.

    Returns:
        The selected model, the pole that it still lacks or that it may have instead of its lag, the scores of all
        poles, and the test for lags; None for what was not found or not tested.
    """
    way = max(float(np.ptp(log.position)) for log in best.model.logs)
    if float(best.residuals @ best.residuals) <= EXACT**2 * best.residuals.size * way**2:
        return best, None, None, None
    rigid = best, pole, bank, lags = _look(best)
    rival = None
    for _ in range(_MOST):
        # The signature of a lag has a known amplitude, so its test can detect a lag that the score of a pole does not.
        late = lags is not None and lags.projection.max() ** 2 > 2.0 * np.log(best.count)
        if bank is None or rival or (pole is None and not late):
            break
        richer, rival = _grow(best, bank)
        if richer is None:
            break
        best, pole, bank, lags = _look(richer)
    if best is rigid[0] or not (rival or (pole is None and best.excess <= ALIKE)):
        return rigid
    best = settle(best.model, best.theta)
    known = best.arrived and not best.inverse.open[: best.model.parts.stop].any()
    return (best, rival or pole, bank, lags) if known else rigid


def _look(best: FittedModel) -> Choice:
    """Test the residuals for missing poles; without any, and if the model has no lag, also for lags."""
    pole, bank = detect_missing_pole(best)
    return best, pole, bank, None if pole or best.model.lag else score_lags(best)


def _grow(best: FittedModel, bank: PoleBank) -> tuple[FittedModel | None, HiddenPole | None]:
    """Return the best model with one part more, and a resonance that may replace its lag.

    The model is None if Schwarz's criterion prefers the present one. A weak resonance resembles a lag, which has fewer
    parameters, but a very different K_max. Therefore the resonance is returned if it fits significantly better.
    """
    begun: dict[tuple[int, int], tuple[float, Recordings, np.ndarray]] = {}
    for lag, modes, start in _start(best, bank):
        model = replace(best.model, lag=lag, modes=modes).begin(_TOLD)
        theta, squares, _ = refine(model, start, (), _BEGUN, CLOSELY)
        if squares < begun.get((lag, modes), (np.inf,))[0]:
            begun[lag, modes] = squares, model, theta
    tried = []
    for _, model, start in begun.values():
        theta, squares, _ = refine(model, start, (), _COMPARED, CLOSELY)
        # Schwarz's criterion: -2 log(likelihood) plus log(count) per parameter.
        misfit = model.measured.size * np.log(squares)
        tried.append((misfit + theta.size * np.log(model.measured.size), misfit, model, theta))
    _, least, model, theta = min(tried, key=lambda trial: trial[0])
    model = replace(model, logs=best.model.logs)
    found = settle(model, theta, (), NEARLY)
    if model.resolution:
        found = settle(replace(model, noise=found.noise), found.theta, (), NEARLY)
    if best.lag_behind(found) <= (found.theta.size - best.theta.size) * np.log(best.count):
        return None, None
    for _, misfit, other, theta in tried:
        if other.modes > model.modes and misfit < least - _BY_CHANCE:
            return found, HiddenPole(float(theta[other.parts.stop - 3]) / (2.0 * np.pi), True, instead=True)
    return found, None


def _start(best: FittedModel, bank: PoleBank) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield models with one part more: the order of the lag, the number of modes, and the initial theta."""
    model, theta = best.model, best.theta
    lag, modes, logs, first = model.lag, model.modes, len(model.logs), model.parts.stop
    if lag == 0:
        for late in _LAGS:
            if late <= theta[2] + 0.5:
                start = [theta[0], theta[1], max(theta[2] - late, 0.0), late]
                yield 1, modes, np.r_[start, theta[3:]]
                yield 2, modes, np.r_[start, _RATIO, theta[3:]]
    elif lag == 1:
        yield 2, modes, np.r_[theta[:4], _RATIO, theta[4:]]
    speeds, states = np.split(theta[first:-2], [2 * logs])
    states = np.concatenate([states.reshape(logs, -1), np.zeros((logs, 2))], 1).ravel()
    complex_poles = bank.select(bank.ratio < 1.0)
    for _, frequency, ratio in islice(rank_poles(complex_poles, _APART), _PARTED):
        mode = [2.0 * np.pi * frequency, ratio, 0.0]
        yield lag, modes + 1, np.r_[theta[:first], mode, speeds, states, theta[-2:]]
