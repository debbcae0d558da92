"""Test whether a part of the fitted delay is a first-order actuator lag, and bound the time constant of such a lag.

At low frequencies a first-order lag with time constant ``tau`` is equivalent to a pure delay ``tau``. The test replaces
part of the fitted delay by an equal time constant. The *signature* of this lag is the part of the resulting change of
the positions that no change of the other parameters reproduces; the residuals are projected onto it. ``theta`` is the
parameter vector of `identification.extended_model.Recordings`, K_max the maximum stiffness of a wall. Further terms are
those of `zwidth.identification.unmodeled_dynamics` and docs/theory/hidden.md. Times are in sampling periods unless
stated otherwise.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from zwidth.analysis.scene import Scene
from zwidth.identification.extended_model import Recordings
from zwidth.identification.output_error import FittedModel
from zwidth.identification.unmodeled_dynamics import truncate_logs
from zwidth.model.actuator import Actuator

# Logarithmic grid of time constants, in sampling periods. It ends at the fitted delay, but not below `MIN_LONGEST_LAG`
# and not above `MAX_LAG`.
MIN_LAG = 0.03  # shortest time constant of the grid
MIN_LONGEST_LAG = 0.05  # least end of the grid
MAX_LAG = 3.0  # largest end of the grid
N_LAGS = 40  # number of time constants in the grid


class HiddenLag(NamedTuple):
    """The longest actuator lag that a log cannot distinguish from pure delay, and K_max of the device with this lag."""

    time_constant: float  # time constant of the lag, s
    delay: float  # pure delay that remains in addition to the lag, s
    stiffness_max: float  # K_max with this lag and delay, N/m


class LagTest(NamedTuple):
    """Results of the score test for first-order actuator lags, as arrays with one entry per time constant."""

    lag: np.ndarray  # time constants, in periods
    signature_size: np.ndarray  # norm of the signature of each lag, in standard errors
    projection: np.ndarray  # projection of the residuals onto the signature of each lag, in standard errors
    theta: np.ndarray  # theta refitted with each lag, to first order in the change; one column per lag


def score_lags(fit: FittedModel) -> LagTest:
    """Test the residuals of a fit for first-order actuator lags that the fitted delay has absorbed (score test)."""
    fit = truncate_logs(fit)
    lags = np.geomspace(MIN_LAG, max(MIN_LONGEST_LAG, min(MAX_LAG, fit.theta[2])), N_LAGS)
    # Compute the change of the positions by the lag for the rigid mass alone, because a lag hardly changes the
    # response of the resonances.
    (g, delta, d), model = fit.theta[:3], Recordings(fit.model.logs, lag=1)
    thetas = [np.pad([g, delta, d - lag, lag], (0, model.size - 4)) for lag in lags]
    changes = [
        np.concatenate([model.simulate_parts(theta, k).position for k in range(len(model.logs))]) for theta in thetas
    ]
    changes = fit.model.weigh(np.stack(changes, -1))
    absorbed = fit.inverse.matrix @ changes
    signatures, residuals = changes - fit.columns[0] @ absorbed, fit.model.weigh(fit.residuals)
    norms = np.linalg.norm(signatures, axis=0)
    # Use the larger of two variances of the projection: that for the autocorrelated errors of the encoder, and that for
    # white noise.
    variance = fit.noise.spread_each(fit.model.weigh(signatures)) / norms**2
    error = np.sqrt(np.maximum(variance, fit.variance) * fit.excess)
    theta = fit.theta[:, None] - absorbed / fit.columns[1][:, None]
    theta[2] -= lags
    return LagTest(lags, norms / error, signatures.T @ residuals / norms / error, theta)


def bound_lag(fit: FittedModel, test: LagTest | None, scene: Scene, coverage_factor: float) -> HiddenLag | None:
    """Compute the longest first-order actuator lag that the residuals do not exclude, and K_max with this lag.

    Args:
        fit: The fitted model.
        test: The result of `score_lags`, None if lags were not tested.
        scene: The scene of the fitted device.
        coverage_factor: Half-width of the confidence interval, in standard errors.

    Returns:
        The lag, the remaining delay and K_max with both; None if lags were not tested, or if the residuals exclude even
        the shortest lag.
    """
    if test is None:
        return None
    # Exclude a lag also if the damping or delay refitted with this lag is negative, because no such device exists.
    possible = (test.signature_size - test.projection <= coverage_factor) & (test.theta[1:3] >= 0).all(0)
    count = int(np.argmin(np.append(possible, False)))  # number of time constants below the first excluded one
    if not count:
        return None
    lag = float(test.lag[count - 1] * scene.timing.period)
    # Clip theta to the bounds, because its linearized change may move parameters of resonances slightly out of them.
    theta = np.clip(test.theta[:, count - 1], *fit.model.bounds())
    lagged = fit.model.normalize(theta, scene.timing.period).to_scene(
        scene.timing.period, scene.velocity, scene.unit_system
    )
    lagged = replace(lagged, device=replace(lagged.device, actuator=Actuator(time_constant=lag)))
    return HiddenLag(lag, float(lagged.timing.delay), float(lagged.max_stiffness().stiffness))
