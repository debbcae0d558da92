"""The noise of velocity estimates, against simulated counts and against the sum of the impulse response."""

import numpy as np
import pytest
from scipy import signal

import zwidth
from zwidth.model.velocity import Estimate
from zwidth.model.velocity_noise import find_velocity_noise

PERIOD, COUNT = 1e-3, 20e-6


def coefficients(velocity, period=PERIOD):
    """F(z) of the estimates, written out here from their definitions."""
    if isinstance(velocity, zwidth.VelocityFilter):
        return np.array(velocity.numerator), np.array(velocity.denominator)
    if isinstance(velocity, zwidth.Butterworth):
        top, bottom = signal.butter(velocity.order, 2 * velocity.cutoff * period)
        return np.convolve(top, [1 / period, -1 / period]), bottom
    if isinstance(velocity, zwidth.WindowedDifference):
        top = np.zeros(velocity.samples + 1)
        top[[0, -1]] = 1.0, -1.0
        return top / (velocity.samples * period), np.array([1.0])
    pole = np.exp(-2 * np.pi * velocity.cutoff * period)
    top, bottom = np.array([1.0, -1.0]) / period, np.array([1.0])
    for _ in range(velocity.order):
        top, bottom = top * (1 - pole), np.convolve(bottom, [1.0, -pole])
    return top, bottom


ESTIMATES = [
    *(zwidth.WindowedDifference(n) for n in (1, 5, 40)),
    *(zwidth.LowPass(cutoff=cutoff, order=order) for cutoff in (3, 30, 300) for order in (1, 2)),
    *(zwidth.Butterworth(cutoff, order) for cutoff in (30, 300) for order in (1, 2, 4)),
    zwidth.VelocityFilter([800.0, -700.0, -100.0], [1.0, -0.5, 0.2]),
]


@pytest.mark.parametrize("velocity", ESTIMATES, ids=str)
def test_it_is_the_sum_of_the_squared_impulse_response(velocity):
    top, bottom = coefficients(velocity)
    impulse = np.zeros(20_000)
    impulse[0] = 1.0
    response = np.asarray(signal.lfilter(top, bottom, impulse))
    expected = COUNT * np.sqrt(np.sum(response**2) / 12.0)
    assert find_velocity_noise(velocity, PERIOD, COUNT) == pytest.approx(expected, rel=1e-9)


def test_the_difference_of_counts_has_the_noise_of_the_textbook():
    noise = find_velocity_noise(zwidth.BackwardDifference(), PERIOD, COUNT)
    assert noise == pytest.approx(COUNT / (np.sqrt(6) * PERIOD), rel=1e-14)
    # A period ten times too short in the formula makes ten times the noise.
    coded = zwidth.BackwardDifference(coded_period=PERIOD / 10)
    assert find_velocity_noise(coded, PERIOD, COUNT) == pytest.approx(10 * noise, rel=1e-14)


@pytest.mark.parametrize("velocity", [zwidth.WindowedDifference(5), zwidth.LowPass(cutoff=30)], ids=str)
def test_counts_of_a_moving_device_make_this_noise(velocity):
    """Positions rounded to counts while the device moves many counts a period, at no ratio to them."""
    steps = np.random.default_rng(1).uniform(5, 90, 200_000) * COUNT
    position = np.cumsum(steps)
    top, bottom = coefficients(velocity)
    error = signal.lfilter(top, bottom, np.round(position / COUNT) * COUNT - position)[1000:]
    # 200,000 samples, correlated over some ten: a percent is three standard errors or more.
    assert find_velocity_noise(velocity, PERIOD, COUNT) == pytest.approx(np.std(error), rel=0.01)


def test_a_subclass_has_the_noise_of_its_transfer_function():
    """The class alone must not select the formula."""

    class Halved(zwidth.LowPass):
        def estimate(self, period):
            return Estimate(window=4, gain=0.5)

    whole = find_velocity_noise(zwidth.WindowedDifference(4), PERIOD, COUNT)
    assert find_velocity_noise(Halved(cutoff=30), PERIOD, COUNT) == pytest.approx(0.5 * whole, rel=1e-14)
