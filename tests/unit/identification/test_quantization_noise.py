"""An encoder's errors over its unknown zero, against encoders drawn, and the step that positions are made of."""

import numpy as np
import pytest

from zwidth.identification.quantization_noise import MeasurementNoise, find_resolution, find_steps, fits_steps

STEP = 3e-5


def slow_motion(count=400):
    k = np.arange(count)
    return 2e-4 * np.sin(0.01 * k) + 1e-6 * k


def read(position, noise, random):
    zero = random.uniform()
    return STEP * (np.round(position / STEP + noise * random.standard_normal(position.size) + zero) - zero)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.4])
def test_errors_of_an_encoder_spread_as_drawn_ones(noise):
    random, position = np.random.default_rng(2), slow_motion()
    columns = np.column_stack([np.ones(400), np.linspace(-1, 1, 400), np.cos(0.02 * np.arange(400))]) / 20.0
    errors = np.array([read(position, noise, random) - position for _ in range(4000)])
    model = MeasurementNoise(position, (noise**2 + 1 / 12) * STEP**2, STEP)
    drawn = errors @ columns
    # A variance of 4,000 draws is known to 2.2 %.
    np.testing.assert_allclose(np.diag(model.spread(columns)), drawn.var(0), rtol=0.1)
    sums = model.weigh(errors.T).reshape(20, 20, 4000).sum(1)
    assert model.spread_of_sums(20, model) == pytest.approx(np.mean(sums**2), rel=0.1)
    if noise < 0.2:
        # As white noise they would be far smaller.
        white = MeasurementNoise(position, model.variance, 0.0)
        assert np.diag(model.spread(columns))[0] > 1.8 * np.diag(white.spread(columns))[0]


def test_a_rest_counts_as_one_sample():
    random = np.random.default_rng(5)
    rests = STEP * np.repeat([0.0, 3.3, 11.2, 7.6], 100)
    model = MeasurementNoise(rests, STEP**2 / 12, STEP)
    # The waves that are not followed are taken for white: 1.6 % of 400.
    assert 4 <= model.count < 12
    zeros = STEP * random.uniform(-0.5, 0.5, (4000, 4))
    weighed = model.weigh(np.repeat(zeros, 100, axis=1).T)
    assert np.mean(np.sum(weighed**2, 0)) == pytest.approx(model.variance * model.count, rel=0.6)


def test_errors_at_an_even_speed_of_nearly_whole_steps_are_alike():
    random, position = np.random.default_rng(6), 1.003 * STEP * np.arange(400)
    model = MeasurementNoise(position, STEP**2 / 12, STEP)
    np.testing.assert_allclose(model.weigh(np.eye(400)), np.eye(400), atol=1e-15)
    drawn = np.array([(read(position, 0.0, random) - position).sum() for _ in range(4000)])
    assert model.spread(np.ones((400, 1)))[0, 0] == pytest.approx(drawn.var(), rel=0.1)


def test_the_step_is_found_in_few_positions():
    # None of them one step from another.
    counts = np.array([0, 0, 6, 16, 31, 46, 46, 46])
    assert find_resolution(STEP * counts) == pytest.approx(STEP, rel=1e-9)
    assert find_resolution(3e-5 * np.sqrt(counts)) == 0.0


def test_the_step_is_found_in_positions():
    random = np.random.default_rng(3)
    position = read(slow_motion(), 0.5, random)
    assert find_resolution(position) == pytest.approx(STEP, rel=1e-9)
    # Another unit.
    assert find_resolution(3.0 * position) == pytest.approx(3 * STEP, rel=1e-9)
    assert find_resolution(slow_motion()) == 0.0
    assert find_resolution(random.standard_normal(500)) == 0.0
    assert find_resolution(np.full(10, 0.3)) == 0.0


def test_positions_of_a_step_are_told_from_others():
    position = read(slow_motion(), 0.5, np.random.default_rng(4))
    assert fits_steps(position, STEP)
    assert fits_steps(position, STEP / 3)
    assert not fits_steps(position, 1.1 * STEP)
    assert not fits_steps(slow_motion(), STEP)


@pytest.mark.parametrize("decimals", [2, 3, 4])
@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("unit", [1.0, np.pi / 180.0])
def test_an_encoder_is_found_in_a_column_of_rounded_degrees(decimals, wrapped, unit):
    step = 360.0 / 2048
    angle = step * np.round(np.cumsum(np.cumsum(np.random.default_rng(decimals).standard_normal(1500))) / 20.0)
    angle = np.round(np.mod(angle, 360.0) if wrapped else angle, decimals)
    found = find_steps(unit * angle)
    # The estimated step has the rounding error of the ends of the record.
    assert found[0] / unit == pytest.approx(step, abs=10.0**-decimals / 100.0)
    assert found[1] / unit == pytest.approx(10.0**-decimals, rel=1e-6)


def test_few_rounded_positions_suggest_no_coarse_step():
    angle = np.array([0.0, 0.6, 1.6, 3.1, 4.6])
    assert find_steps(angle) == pytest.approx((0.1, 0.1))
