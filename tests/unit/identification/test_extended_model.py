"""Test the motion model with actuator lag and modes.

References: matrix exponentials, and finite differences for the derivatives.
"""

import numpy as np
import pytest
from measured_devices import PERIOD, TrueDevice

import zwidth
from zwidth.identification.device_estimate import differentiate
from zwidth.identification.extended_model import Recordings
from zwidth.identification.friction_model import Recording

SKIP = 22
CASES = {
    "lag": (1.3e-3, 3e-4, ()),
    "long lag, integer delay": (2e-3, 2.5e-3, ()),
    "mode": (1.3e-3, 0.0, ((100.0, 0.03, 0.2),)),
    "overdamped mode": (0.4e-3, 0.0, ((60.0, 1.4, 0.2),)),
    "lag and modes": (0.4e-3, 4e-4, ((100.0, 0.03, 0.2), (310.0, 0.01, -0.5))),
}


def build_model(delay, lag, modes, *, friction=1e-15, order=1):
    rng = np.random.default_rng(0)
    force = 3 * np.repeat(rng.choice([-1.0, 1.0], 30), 20)
    force[: SKIP + 3] = 0.0
    device = TrueDevice("", 0.1, 1.0, lag, modes, delay, PERIOD, 1e-5, 10.0)
    positions = device.play(force, read=False)[SKIP:]
    model = Recordings((Recording(force, positions, SKIP),), None, order if lag else 0, len(modes))
    theta = np.zeros(model.size)
    theta[:3] = PERIOD**2 / 0.1, PERIOD / 0.1, delay / PERIOD
    theta[3 : 3 + model.lag] = [lag / PERIOD, 0.7][: model.lag]
    for k, (hertz, ratio, mass) in enumerate(modes):
        theta[3 + model.lag + 3 * k :][:3] = 2 * np.pi * hertz * PERIOD, ratio, PERIOD**2 / mass
    theta[-1] = friction
    return model, theta


@pytest.mark.parametrize("case", CASES)
def test_motion_matches_matrix_exponentials(case):
    model, theta = build_model(*CASES[case])
    positions = model.simulate(theta).position
    np.testing.assert_allclose(positions, model.measured, atol=1e-9 * np.ptp(positions))


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("friction", [1e-15, 3e-7])
@pytest.mark.parametrize("case", CASES)
def test_derivatives_of_motion_match_differences(case, friction, order):
    model, theta = build_model(*CASES[case], friction=friction, order=order)
    # Nonzero initial states, as of a device in motion before the log.
    theta[model.parts.stop : -2] += 1e-4 * np.random.default_rng(1).standard_normal(theta[model.parts.stop : -2].size)
    slopes = model.simulate(theta).derivatives
    for k in range(theta.size - 1):
        step = np.eye(theta.size)[k] * 1e-5 * max(abs(theta[k]), 1e-6)
        ends = [model.simulate(theta + side * step).position for side in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step[k])
        np.testing.assert_allclose(slopes[:, k], difference, atol=3e-6 * np.abs(difference).max())


def test_motion_is_finite_at_the_bounds_of_damping_and_lag():
    """The bounds keep the poles of damping and lag distinct, as needed for the fit of a device held by a spring."""
    model, theta = build_model(*CASES["lag"])
    low, high = model.bounds()
    theta[1], theta[3] = high[1], low[3]
    assert np.isfinite(model.simulate(theta).position).all()


def test_derivatives_of_scene_parameters_match_differences():
    model, theta = build_model(*CASES["lag and modes"], order=2)
    velocity = zwidth.BackwardDifference()
    names = ("mass", "damping", "delay", "actuator.time_constant", "actuator.damping_ratio")
    names += tuple(f"modes.{k}.{name}" for k in range(2) for name in ("frequency", "damping_ratio", "mass"))

    def evaluate_parameters(theta, period=PERIOD):
        by_name = model.normalize(theta, period).to_scene(period, velocity).parameters()
        return np.array([by_name[name] for name in names])

    slopes = differentiate(lambda theta: model.normalize(theta, PERIOD).to_parameters(PERIOD), theta)
    for k in range(len(names)):
        step = np.eye(theta.size)[k] * 1e-6 * theta[k]
        difference = (evaluate_parameters(theta + step) - evaluate_parameters(theta - step)) / (2 * step[k])
        np.testing.assert_allclose(slopes[:, k], difference, rtol=1e-7, atol=1e-7 * np.abs(difference).max())
    device = model.normalize(theta, PERIOD)
    restored = type(device).from_parameters(evaluate_parameters(theta), PERIOD, model.lag)
    for restored_value, expected in zip(restored, device, strict=True):
        np.testing.assert_allclose(restored_value, expected, rtol=1e-14)


def test_interval_is_valid_if_lag_and_resonance_fit_equally_well():
    # The log shows the resonance with only about twelve standard errors; a lag in its place would double K_max.
    true = TrueDevice("", 0.1, 3.0, 0.0, ((270.0, 0.017, 0.15),), 1.2e-3, PERIOD, 2e-5, 3.0)
    rng = np.random.default_rng(3)
    force = 3 * np.repeat(rng.choice([-1.0, 1.0], 100), 25)
    fit = zwidth.fit_log(PERIOD, true.play(force), force)
    interval = fit.intervals["stiffness_max"]
    assert fit.is_unreliable or interval.low <= true.limit_of_walls() <= interval.high
