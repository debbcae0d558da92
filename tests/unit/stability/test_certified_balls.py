"""Ball arithmetic: verdicts against independent poles, and what is exactly on the unit circle."""

import itertools

import numpy as np
import pytest
from mpmath import mp

import oracles
from zwidth.stability import balls
from zwidth.status import Status


@pytest.mark.parametrize("d", [0.0, 5e-324, 0.3, 1.0, 1.75, 4.0])
@pytest.mark.parametrize("delta", [0.0, 1e-8, 0.4, 6.0])
def test_verdict_is_that_of_the_poles(d, delta):
    rng = np.random.default_rng(31)
    for alpha, beta in zip(rng.uniform(0, 1 + delta, 6), rng.uniform(-1 - delta, 2 + delta, 6), strict=True):
        with mp.workdps(oracles.digits_for(delta)):
            p = oracles.polynomial(alpha, beta, delta, d)[::-1]
            radius = max(abs(z) for z in mp.polyroots(p, maxsteps=400, asc=True))
            verdict = balls.decide(float(alpha), float(beta), delta, d, 4096)
            assert verdict.status == Status.OK
            assert verdict.stable == (radius < 1)


def test_sparse_and_dense_recursions_agree():
    import flint

    rng = np.random.default_rng(37)
    for d in (0.0, 0.5, 3.0, 3.5, 30.0, 30.5):
        for alpha, beta in zip(10 ** rng.uniform(-5, 0, 20), rng.uniform(-0.5, 0.5, 20), strict=True):
            with flint.ctx.workprec(256):
                plant = balls._device(0.5, d, 256)
                p = balls._coefficients(flint.arb(float(alpha)), flint.arb(float(beta)), plant, int(d))
                assert balls._sparse_schur_cohn(p) is balls.schur_cohn(p.dense())


def test_enclosures_shrink_with_the_precision():
    for delta, d in itertools.product((5e-324, 1e-300, 1e-8, 0.5, 750.0, 1e6), (0.0, 0.5, 1.0 - 2.0**-53)):
        for bits in (128, 512):
            plant = balls._device(delta, d, bits)
            assert plant.c.rel_accuracy_bits() >= bits - 40
            assert min(a.rel_accuracy_bits() for a in plant.numerator) >= bits - 40


@pytest.mark.parametrize("bits", [128, 4096])
def test_zeros_on_the_circle_are_never_labelled_by_precision(bits):
    import flint

    with flint.ctx.workprec(bits):
        assert balls.schur_cohn([flint.arb(1), flint.arb(0), flint.arb(1)]) is None
        assert balls.schur_cohn([flint.arb(3) / 3, flint.arb(1), flint.arb(1)]) is None


def test_rational_points_on_the_circle():
    # z^2 + 1 is left of P at alpha = 0, beta = 2; at alpha + 2 beta = 8, d = 1.5 a zero is at z = -1, others outside.
    assert balls.decide(0.0, 2.0, 0.0, 0.0, 512) == (False, Status.ON_BOUNDARY, 512)
    assert balls._decide_rational(2.0, 3.0, 1.5, 512) == (False, Status.OK, 512)
    assert balls._decide_rational(0.1, 0.2, 1.0, 512).status == Status.UNDECIDED


def test_precision_doubles_until_decided():
    assert [balls.decide(alpha, 0.1, 0.1, 1.0, 1 << 14).bits for alpha in (1e-3, 1e-100, 1e-300)] == [128, 512, 1024]
    assert balls.decide(1e-300, 0.1, 0.1, 1.0, 512) == (False, Status.UNDECIDED, 512)
