"""Decay rates against labels of 60 digits and exact roots; their sign against the verdict."""

from pathlib import Path

import jax
import numpy as np
import pytest
from mpmath import mp

import oracles
import zwidth
from zwidth.errors import InputError
from zwidth.numerics.double_double import phi_pair, single

REFERENCE = Path(__file__).resolve().parents[2] / "reference"
NAMES = ("alpha", "beta", "delta", "d")


def exact_rate(*wall):
    with mp.workdps(120):
        return -mp.log(max(abs(root) for root in oracles.roots(oracles.polynomial(*wall))))


def test_labels_have_ten_digits_and_the_right_sign():
    with np.load(REFERENCE / "labels.npz") as file:
        rate = zwidth.decay_rate(*(file[name] for name in NAMES))
        np.testing.assert_allclose(rate, -np.log1p(file["margin"]), rtol=1e-12)
        np.testing.assert_array_equal(rate > 0, file["stable"])


def test_adversarial_walls_have_ten_digits_or_none():
    with np.load(REFERENCE / "adversarial.npz") as file:
        walls, margin = [file[name] for name in NAMES], file["margin"]
    rate = zwidth.decay_rate(*walls)
    # Walls with margins below 1e-16 lie where the verdict itself may be wrong: its side is kept, not the digits.
    judged = np.isfinite(rate) & (np.abs(margin) > 1e-16)
    assert judged.sum() > 2000
    np.testing.assert_allclose(rate[judged], -np.log1p(margin[judged]), rtol=1e-9)


def test_the_sign_is_that_of_the_verdict():
    rng = np.random.default_rng(8)
    alpha, beta = 10.0 ** rng.uniform(-25, 1, 3000), rng.uniform(-0.5, 1, 3000)
    delta, d = 10.0 ** rng.uniform(-9, 1, 3000), rng.choice([0.0, 0.3, 1.0, 2.5, 40.0], 3000)
    rate = zwidth.decay_rate(alpha, beta, delta, d)
    known = np.isfinite(rate)
    assert known.mean() > 0.99
    np.testing.assert_array_equal((rate > 0)[known], zwidth.is_stable(alpha, beta, delta, d)[known])


@pytest.mark.parametrize(
    "wall",
    [
        (1e-20, 1e-3, 1e-9, 0.0),
        (1e-15, 1e-9, 1e-9, 1.0),
        (1e-10, 1e-7, 0.0, 2.0),
        (0.05, 0.1, 0.03, 1.5),
        # Poles next to 1 and a pair elsewhere, all within 1e-12 of the unit circle: the slowest is meant.
        (1e-13, 1.4132588650193014, 0.00027724736314914985, 0.25),
        (1e-17, 0.8284272285685977, 1.3888413586734453e-07, 1.0),
    ],
)
def test_slow_loops_keep_their_digits(wall):
    assert zwidth.decay_rate(*wall) == pytest.approx(float(exact_rate(*wall)), rel=1e-13)


def test_without_stiffness_nothing_decays():
    assert zwidth.decay_rate(0.0, 0.3, 0.1, 1) == 0.0


def test_inside_a_transformation(x64):
    rate, slope = jax.jit(jax.value_and_grad(lambda alpha: zwidth.decay_rate(alpha, 0.3, 0.2, 1.0)))(0.1)
    assert rate == pytest.approx(zwidth.decay_rate(0.1, 0.3, 0.2, 1.0), rel=1e-12)
    h = 1e-5
    difference = (zwidth.decay_rate(0.1 + h, 0.3, 0.2, 1.0) - zwidth.decay_rate(0.1 - h, 0.3, 0.2, 1.0)) / (2 * h)
    assert slope == pytest.approx(difference, rel=1e-7)


def test_bad_points_are_nan_and_scalars_refused():
    assert np.isnan(zwidth.decay_rate([0.1, np.nan, 1e70], 0.3, 0.2, 1.0)).tolist() == [False, True, True]
    with pytest.raises(InputError, match="alpha"):
        zwidth.decay_rate(1e70, 0.3, 0.2, 1.0)


@pytest.mark.parametrize("x", [0.0, 1e-12, 0.01, 0.7, 3.0, 60.0, 1e6])
def test_phi_functions_have_thirty_digits(x):
    got = phi_pair(single(np.float64(x)))
    with mp.workdps(80):
        y = mp.mpf(x)
        em = -mp.expm1(-y)
        phi1 = em / y if x else mp.mpf(1)
        phi2 = (1 - phi1) / y if x else mp.mpf(1) / 2
        for value, exact in zip(got, (em, phi1, phi2), strict=True):
            error = mp.mpf(float(value.high)) + mp.mpf(float(value.low)) - exact
            assert abs(error) <= 1e-29 * abs(exact)
