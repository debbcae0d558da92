"""Which device a log asks for: a rigid one, or with an amplifier's lag and resonances, by Schwarz's criterion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from zwidth.fitting.hidden import HiddenPole, PoleBank, detect_missing_pole, rank_poles
from zwidth.fitting.hidden_lag import LagTest, score_lags
from zwidth.fitting.output_error import CLOSELY, NEARLY, FittedModel, refine, settle
from zwidth.fitting.structure import Recordings

# So many parts, lags and resonances, are added at most; so many positions of each log tell which one.
_MOST, _TOLD = 4, 2500
# Steps from every start, and then from the best one of each kind of device.
_BEGUN, _COMPARED = 20, 40
# Sums of what the fit leaves may spread so many times more than noise's, before it is doubted.
ALIKE = 1.5
# Smaller residuals, as a share of the way moved, are rounding.
EXACT = 1e-9
# What two numbers more explain of noise in 19 of 20 cases.
_BY_CHANCE = 5.99
# Time constants that lags are started from, in periods; a second order's damping ratio.
_LAGS, _RATIO = (0.3, 1.5), 0.7
# So many resonances are started from, their frequencies so far apart.
_PARTED, _APART = 2, float(np.exp(0.2))

Choice = tuple[FittedModel, HiddenPole | None, PoleBank | None, LagTest | None]


def choose_structure(best: FittedModel) -> Choice:
    """Add what explains the residuals best as long as they show a pole; then what they still show, and of lags."""
    # Where that leaves no noise, parts explain nothing: then the rigid device with what its residuals show.
    way = max(float(np.ptp(log.position)) for log in best.model.logs)
    if float(best.residuals @ best.residuals) <= EXACT**2 * best.residuals.size * way**2:
        return best, None, None, None
    rigid = best, pole, bank, lags = _look(best)
    rival = None
    for _ in range(_MOST):
        # A lag has no size of its own, and so is seen where a pole of any size is not.
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
    """What the residuals show; of lags where they show no pole and the device has none."""
    pole, bank = detect_missing_pole(best)
    return best, pole, bank, None if pole or best.model.lag else score_lags(best)


def _grow(best: FittedModel, bank: PoleBank) -> tuple[FittedModel | None, HiddenPole | None]:
    """The likeliest device with one part more, None where none is as likely as without; and what else it may be."""
    # A resonance that a log hardly shows looks like a lag, which has fewer numbers, but quite another K_max. So a lag
    # is doubted where the further numbers of a resonance explain more than chance does.
    begun: dict[tuple[int, int], tuple[float, Recordings, np.ndarray]] = {}
    for lag, modes, start in _start(best, bank):
        model = replace(best.model, lag=lag, modes=modes).begin(_TOLD)
        theta, squares, _ = refine(model, start, (), _BEGUN, CLOSELY)
        if squares < begun.get((lag, modes), (np.inf,))[0]:
            begun[lag, modes] = squares, model, theta
    tried = []
    for _, model, start in begun.values():
        theta, squares, _ = refine(model, start, (), _COMPARED, CLOSELY)
        # -2 times its logarithmic likelihood, and Schwarz's criterion.
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
    """Devices with one part more: the amplifier's order, how many modes, and theta to begin with."""
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
