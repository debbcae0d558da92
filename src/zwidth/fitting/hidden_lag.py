"""Test for first-order actuator lags that a fit may have taken for delay, and bound the lag.

At low frequencies a lag ``tau`` delays the force as a pure delay of the same length does. The test replaces a part of
the fitted delay by a lag, and compares the residuals with the signature of that replacement. The words and symbols are
those of `zwidth.fitting.hidden` and docs/theory/hidden.md. Times are in sampling periods unless stated otherwise.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from zwidth.fitting.hidden import truncate_logs
from zwidth.fitting.output_error import FittedModel
from zwidth.fitting.structure import Recordings
from zwidth.parts.actuator import Actuator
from zwidth.scenes.scene import Scene

# Actuator lags that replace part of the delay, in sampling periods.
MIN_LAG = 0.03
MIN_LONGEST_LAG = 0.05  # the longest lag tested is the fitted delay, but at least this
MAX_LAG = 3.0
N_LAGS = 40


class HiddenLag(NamedTuple):
    """The longest actuator lag that a log cannot distinguish from pure delay, and the maximum stiffness with it."""

    time_constant: float  # s
    delay: float  # remaining pure delay, s
    stiffness_max: float  # K_max, N/m


class LagTest(NamedTuple):
    """Score test of the residuals for first-order actuator lags that each replace an equal part of the delay."""

    lag: np.ndarray  # time constants, in periods
    signature_size: np.ndarray  # norm of the signature of each lag, in standard errors
    projection: np.ndarray  # residuals projected onto that signature, in standard errors
    theta: np.ndarray  # fitted parameters corrected for each lag, a column per lag


def score_lags(fit: FittedModel) -> LagTest:
    """Compare the residuals with the signatures of first-order actuator lags that the fit may have taken for delay."""
    fit = truncate_logs(fit)
    lags = np.geomspace(MIN_LAG, max(MIN_LONGEST_LAG, min(MAX_LAG, fit.theta[2])), N_LAGS)
    # The change of the positions if a lag replaces an equal part of the delay. Computed for the rigid mass alone,
    # because the lag hardly changes the contribution of the resonances.
    (g, delta, d), model = fit.theta[:3], Recordings(fit.model.logs, lag=1)
    thetas = [np.pad([g, delta, d - lag, lag], (0, model.size - 4)) for lag in lags]
    changes = [np.concatenate([model.add_parts(theta, k).position for k in range(len(model.logs))]) for theta in thetas]
    changes = fit.model.weigh(np.stack(changes, -1))
    absorbed = fit.inverse.matrix @ changes
    signatures, residuals = changes - fit.columns[0] @ absorbed, fit.model.weigh(fit.residuals)
    norms = np.linalg.norm(signatures, axis=0)
    # The larger of the variances along a signature: with the encoder's autocorrelated errors, or of white noise.
    variance = fit.noise.spread_each(fit.model.weigh(signatures)) / norms**2
    error = np.sqrt(np.maximum(variance, fit.variance) * fit.excess)
    theta = fit.theta[:, None] - absorbed / fit.columns[1][:, None]
    theta[2] -= lags
    return LagTest(lags, norms / error, signatures.T @ residuals / norms / error, theta)


def bound_lag(fit: FittedModel, test: LagTest | None, scene: Scene, reach: float) -> HiddenLag | None:
    """Return the longest actuator lag that the residuals do not exclude.

    Args:
        fit: The fitted model.
        test: Scores of its lags, or None if lags were not tested.
        scene: The fitted device in its loop.
        reach: Half-width of the confidence interval, in standard errors.

    Returns:
        The lag, the remaining delay and K_max with both; None if even the shortest lag is excluded.
    """
    if test is None:
        return None
    # A device with the lag must also keep nonnegative damping and delay.
    possible = (test.signature_size - test.projection <= reach) & (test.theta[1:3] >= 0).all(0)
    count = int(np.argmin(np.append(possible, False)))  # leading lags that are possible without exception
    if not count:
        return None
    lag = float(test.lag[count - 1] * scene.timing.period)
    # The linearized shift of the parameters of resonances is small, but may exceed their bounds.
    theta = np.clip(test.theta[:, count - 1], *fit.model.bounds())
    lagged = fit.model.normalize(theta, scene.timing.period).to_scene(
        scene.timing.period, scene.velocity, scene.unit_system
    )
    lagged = replace(lagged, device=replace(lagged.device, actuator=Actuator(time_constant=lag)))
    return HiddenLag(lag, float(lagged.timing.delay), float(lagged.max_stiffness().stiffness))
