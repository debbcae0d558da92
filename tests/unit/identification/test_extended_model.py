"""Motions with an amplifier and resonances against matrix exponentials, and their derivatives against differences."""

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
    "a long lag, a whole delay": (2e-3, 2.5e-3, ()),
    "mode": (1.3e-3, 0.0, ((100.0, 0.03, 0.2),)),
    "a mode that does not ring": (0.4e-3, 0.0, ((60.0, 1.4, 0.2),)),
    "lag and modes": (0.4e-3, 4e-4, ((100.0, 0.03, 0.2), (310.0, 0.01, -0.5))),
}


def lay_out(delay, lag, modes, *, friction=1e-15, order=1):
    rng = np.random.default_rng(0)
    force = 3 * np.repeat(rng.choice([-1.0, 1.0], 30), 20)
    force[: SKIP + 3] = 0.0
    device = TrueDevice("", 0.1, 1.0, lag, modes, delay, PERIOD, 1e-5, 10.0)
    place = device.play(force, read=False)[SKIP:]
    model = Recordings((Recording(force, place, SKIP),), None, order if lag else 0, len(modes))
    theta = np.zeros(model.size)
    theta[:3] = PERIOD**2 / 0.1, PERIOD / 0.1, delay / PERIOD
    theta[3 : 3 + model.lag] = [lag / PERIOD, 0.7][: model.lag]
    for k, (hertz, ratio, mass) in enumerate(modes):
        theta[3 + model.lag + 3 * k :][:3] = 2 * np.pi * hertz * PERIOD, ratio, PERIOD**2 / mass
    theta[-1] = friction
    return model, theta


@pytest.mark.parametrize("case", CASES)
def test_motions_are_those_of_matrix_exponentials(case):
    model, theta = lay_out(*CASES[case])
    place = model.simulate(theta).position
    np.testing.assert_allclose(place, model.measured, atol=1e-9 * np.ptp(place))


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("friction", [1e-15, 3e-7])
@pytest.mark.parametrize("case", CASES)
def test_derivatives_are_those_of_differences(case, friction, order):
    model, theta = lay_out(*CASES[case], friction=friction, order=order)
    # As of a device that moved before.
    theta[model.parts.stop : -2] += 1e-4 * np.random.default_rng(1).standard_normal(theta[model.parts.stop : -2].size)
    slopes = model.simulate(theta).derivatives
    for k in range(theta.size - 1):
        step = np.eye(theta.size)[k] * 1e-5 * max(abs(theta[k]), 1e-6)
        ends = [model.simulate(theta + side * step).position for side in (1, -1)]
        found = (ends[0] - ends[1]) / (2 * step[k])
        np.testing.assert_allclose(slopes[:, k], found, atol=3e-6 * np.abs(found).max())


def test_a_motion_is_one_where_damping_and_lag_end_their_ranges():
    """As of a device that a spring holds: the pole of the lag and that of the damping would be one."""
    model, theta = lay_out(*CASES["lag"])
    low, high = model.bounds()
    theta[1], theta[3] = high[1], low[3]
    assert np.isfinite(model.simulate(theta).position).all()


def test_the_numbers_of_the_scene_move_with_theta_as_their_derivatives_say():
    model, theta = lay_out(*CASES["lag and modes"], order=2)
    velocity = zwidth.BackwardDifference()
    names = ("mass", "damping", "delay", "actuator.time_constant", "actuator.damping_ratio")
    names += tuple(f"modes.{k}.{name}" for k in range(2) for name in ("frequency", "damping_ratio", "mass"))

    def numbers(theta, period=PERIOD):
        own = model.normalize(theta, period).to_scene(period, velocity).parameters()
        return np.array([own[name] for name in names])

    slopes = differentiate(lambda theta: model.normalize(theta, PERIOD).to_parameters(PERIOD), theta)
    for k in range(len(names)):
        step = np.eye(theta.size)[k] * 1e-6 * theta[k]
        found = (numbers(theta + step) - numbers(theta - step)) / (2 * step[k])
        np.testing.assert_allclose(slopes[:, k], found, rtol=1e-7, atol=1e-7 * np.abs(found).max())
    device = model.normalize(theta, PERIOD)
    again = type(device).from_parameters(numbers(theta), PERIOD, model.lag)
    for found, wanted in zip(again, device, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-14)


def test_where_a_lag_and_a_resonance_explain_a_log_alike_neither_is_believed():
    # Of the resonance hardly a dozen standard errors are seen; as a lag it would double K_max.
    true = TrueDevice("", 0.1, 3.0, 0.0, ((270.0, 0.017, 0.15),), 1.2e-3, PERIOD, 2e-5, 3.0)
    rng = np.random.default_rng(3)
    force = 3 * np.repeat(rng.choice([-1.0, 1.0], 100), 25)
    fit = zwidth.fit_log(PERIOD, true.play(force), force)
    found = fit.intervals["stiffness_max"]
    assert fit.is_unreliable or found.low <= true.limit_of_walls() <= found.high
