"""Test the noise model of encoders with unknown zero and the detection of the encoder step.

Reference: sampled encoders.
"""

import numpy as np
import pytest

from zwidth.identification.quantization_noise import MeasurementNoise, find_resolution, find_steps, fits_steps

STEP = 3e-5


def slow_motion(count=400):
    k = np.arange(count)
    return 2e-4 * np.sin(0.01 * k) + 1e-6 * k


def quantize(position, noise, random):
    zero = random.uniform()
    return STEP * (np.round(position / STEP + noise * random.standard_normal(position.size) + zero) - zero)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.4])
def test_covariance_of_encoder_errors_matches_sampled_encoders(noise):
    random, position = np.random.default_rng(2), slow_motion()
    columns = np.column_stack([np.ones(400), np.linspace(-1, 1, 400), np.cos(0.02 * np.arange(400))]) / 20.0
    errors = np.array([quantize(position, noise, random) - position for _ in range(4000)])
    model = MeasurementNoise(position, (noise**2 + 1 / 12) * STEP**2, STEP)
    drawn = errors @ columns
    # A variance from 4,000 samples has a standard error of 2.2 %.
    np.testing.assert_allclose(np.diag(model.spread(columns)), drawn.var(0), rtol=0.1)
    sums = model.weigh(errors.T).reshape(20, 20, 4000).sum(1)
    assert model.spread_of_sums(20, model) == pytest.approx(np.mean(sums**2), rel=0.1)
    if noise < 0.2:
        # A white-noise model underestimates the variance.
        white = MeasurementNoise(position, model.variance, 0.0)
        assert np.diag(model.spread(columns))[0] > 1.8 * np.diag(white.spread(columns))[0]


def test_rest_counts_as_one_sample():
    random = np.random.default_rng(5)
    rests = STEP * np.repeat([0.0, 3.3, 11.2, 7.6], 100)
    model = MeasurementNoise(rests, STEP**2 / 12, STEP)
    # The harmonics that the model omits count as white noise: 1.6 % of 400 samples.
    assert 4 <= model.count < 12
    zeros = STEP * random.uniform(-0.5, 0.5, (4000, 4))
    weighted = model.weigh(np.repeat(zeros, 100, axis=1).T)
    assert np.mean(np.sum(weighted**2, 0)) == pytest.approx(model.variance * model.count, rel=0.6)


def test_errors_at_speed_near_one_step_per_sample_are_correlated():
    random, position = np.random.default_rng(6), 1.003 * STEP * np.arange(400)
    model = MeasurementNoise(position, STEP**2 / 12, STEP)
    np.testing.assert_allclose(model.weigh(np.eye(400)), np.eye(400), atol=1e-15)
    drawn = np.array([(quantize(position, 0.0, random) - position).sum() for _ in range(4000)])
    assert model.spread(np.ones((400, 1)))[0, 0] == pytest.approx(drawn.var(), rel=0.1)


def test_resolution_is_found_from_few_positions():
    # No two positions are one encoder step apart.
    counts = np.array([0, 0, 6, 16, 31, 46, 46, 46])
    assert find_resolution(STEP * counts) == pytest.approx(STEP, rel=1e-9)
    assert find_resolution(3e-5 * np.sqrt(counts)) == 0.0


def test_resolution_is_found_from_noisy_positions():
    random = np.random.default_rng(3)
    position = quantize(slow_motion(), 0.5, random)
    assert find_resolution(position) == pytest.approx(STEP, rel=1e-9)
    # The same positions in another unit.
    assert find_resolution(3.0 * position) == pytest.approx(3 * STEP, rel=1e-9)
    assert find_resolution(slow_motion()) == 0.0
    assert find_resolution(random.standard_normal(500)) == 0.0
    assert find_resolution(np.full(10, 0.3)) == 0.0


def test_fits_steps_accepts_only_submultiples_of_the_step():
    position = quantize(slow_motion(), 0.5, np.random.default_rng(4))
    assert fits_steps(position, STEP)
    assert fits_steps(position, STEP / 3)
    assert not fits_steps(position, 1.1 * STEP)
    assert not fits_steps(slow_motion(), STEP)


@pytest.mark.parametrize("decimals", [2, 3, 4])
@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("unit", [1.0, np.pi / 180.0])
def test_encoder_step_is_found_in_rounded_degrees(decimals, wrapped, unit):
    step = 360.0 / 2048
    angle = step * np.round(np.cumsum(np.cumsum(np.random.default_rng(decimals).standard_normal(1500))) / 20.0)
    angle = np.round(np.mod(angle, 360.0) if wrapped else angle, decimals)
    steps = find_steps(unit * angle)
    # The error of the estimated step is the rounding error of the two ends, divided by the number of steps between
    # them.
    assert steps[0] / unit == pytest.approx(step, abs=10.0**-decimals / 100.0)
    assert steps[1] / unit == pytest.approx(10.0**-decimals, rel=1e-6)


def test_few_rounded_positions_suggest_no_coarse_step():
    angle = np.array([0.0, 0.6, 1.6, 3.1, 4.6])
    assert find_steps(angle) == pytest.approx((0.1, 0.1))
