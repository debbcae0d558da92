"""Test the quantization noise of velocity estimates against the impulse response and simulated encoder counts."""

import numpy as np
import pytest
from scipy import signal

import zwidth
from zwidth.model.estimate import Estimate
from zwidth.model.velocity_noise import find_velocity_noise

PERIOD, COUNT = 1e-3, 20e-6


def expand_estimate(velocity, period=PERIOD):
    """Return numerator and denominator of the estimate F(z), independently of the implementation."""
    if isinstance(velocity, zwidth.VelocityFilter):
        return np.array(velocity.numerator), np.array(velocity.denominator)
    if isinstance(velocity, zwidth.Butterworth):
        numerator, denominator = signal.butter(velocity.order, 2 * velocity.cutoff * period)
        return np.convolve(numerator, [1 / period, -1 / period]), denominator
    if isinstance(velocity, zwidth.WindowedDifference):
        numerator = np.zeros(velocity.samples + 1)
        numerator[[0, -1]] = 1.0, -1.0
        return numerator / (velocity.samples * period), np.array([1.0])
    pole = np.exp(-2 * np.pi * velocity.cutoff * period)
    numerator, denominator = np.array([1.0, -1.0]) / period, np.array([1.0])
    for _ in range(velocity.order):
        numerator, denominator = numerator * (1 - pole), np.convolve(denominator, [1.0, -pole])
    return numerator, denominator


ESTIMATES = [
    *(zwidth.WindowedDifference(n) for n in (1, 5, 40)),
    *(zwidth.LowPass(cutoff=cutoff, order=order) for cutoff in (3, 30, 300) for order in (1, 2)),
    *(zwidth.Butterworth(cutoff, order) for cutoff in (30, 300) for order in (1, 2, 4)),
    zwidth.VelocityFilter([800.0, -700.0, -100.0], [1.0, -0.5, 0.2]),
]


@pytest.mark.parametrize("velocity", ESTIMATES, ids=str)
def test_noise_is_the_norm_of_the_impulse_response(velocity):
    numerator, denominator = expand_estimate(velocity)
    impulse = np.zeros(20_000)
    impulse[0] = 1.0
    response = np.asarray(signal.lfilter(numerator, denominator, impulse))
    expected = COUNT * np.sqrt(np.sum(response**2) / 12.0)
    assert find_velocity_noise(velocity, PERIOD, COUNT) == pytest.approx(expected, rel=1e-9)


def test_noise_of_backward_difference_closed_form():
    noise = find_velocity_noise(zwidth.BackwardDifference(), PERIOD, COUNT)
    assert noise == pytest.approx(COUNT / (np.sqrt(6) * PERIOD), rel=1e-14)
    # With a coded period of a tenth, the noise is ten times as large.
    coded = zwidth.BackwardDifference(coded_period=PERIOD / 10)
    assert find_velocity_noise(coded, PERIOD, COUNT) == pytest.approx(10 * noise, rel=1e-14)


@pytest.mark.parametrize("velocity", [zwidth.WindowedDifference(5), zwidth.LowPass(cutoff=30)], ids=str)
def test_noise_matches_rounding_errors_of_a_simulated_motion(velocity):
    """Positions rounded to counts, with many counts per period at an incommensurate speed."""
    steps = np.random.default_rng(1).uniform(5, 90, 200_000) * COUNT
    position = np.cumsum(steps)
    numerator, denominator = expand_estimate(velocity)
    error = signal.lfilter(numerator, denominator, np.round(position / COUNT) * COUNT - position)[1000:]
    # 200,000 samples, correlated over about ten samples: 1 % is at least three standard errors.
    assert find_velocity_noise(velocity, PERIOD, COUNT) == pytest.approx(np.std(error), rel=0.01)


def test_noise_of_a_subclass_follows_its_transfer_function():
    """The base class must not select the formula."""

    class Halved(zwidth.LowPass):
        def estimate(self, period):
            return Estimate(window=4, gain=0.5)

    full = find_velocity_noise(zwidth.WindowedDifference(4), PERIOD, COUNT)
    assert find_velocity_noise(Halved(cutoff=30), PERIOD, COUNT) == pytest.approx(0.5 * full, rel=1e-14)
