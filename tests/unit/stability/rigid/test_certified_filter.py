"""Static error bounds of the certified filter, against the same source code evaluated in balls of python-flint.

`test_certified_balls` compares those balls with poles computed by mpmath.
"""

import jax
import numpy as np
import pytest
from certified_labels import certified_stable
from exact_differences import draw_walls, exact_differences, pick
from mpmath import mp

import oracles
from zwidth.plant.rigid_mass import classify_delays, phi_functions
from zwidth.stability.rigid import certified
from zwidth.stability.rigid.boundary_curve import expand_curve_with_offset, expand_short_delay_curve
from zwidth.stability.rigid.certified import (
    CROSSOVER_WIDTH,
    CUBIC_TOLERANCE,
    TOLERANCE,
    Sized,
    enclose_root,
    size_device,
)
from zwidth.stability.rigid.characteristic_polynomial import expand_gain_difference
from zwidth.stability.rigid.crossover import decide_long_delay, decide_short_delay

flint = pytest.importorskip("flint")
BITS = 400
UNIT = 2.0**-53
DELTAS = np.array([0.0, 5e-324, 1e-300, 1e-16, 1e-8, 1e-3, 0.3, 1.0, 1.4999, 1.5, 1.51, 7.0, 50.0, 699.0, 750.0, 1e12])
DELAYS = [1.0, 2.0, 7.0, 500.0, 1.5, 3.25, 60.7, np.nextafter(2.0, 1.0), 1.0 + 1e-12, 99999.5]


def errors(computed, exact, index, precision=BITS):
    """Return the errors of one entry relative to its sizes."""
    with flint.ctx.workprec(precision):
        return [
            float(abs(truth - pick(number.value, index)).upper() / flint.arb(pick(number.size, index)))
            for number, truth in zip(computed, exact, strict=True)
        ]


def collect_terms(plant, exact):
    """Return the terms of a device and the coefficients of its curve, with their exact values."""
    names = [
        name
        for name, value in plant._asdict().items()
        if isinstance(value, Sized) and name not in ("p2", "minus_one_coefficient")
    ]
    pairs = [(getattr(plant, name), getattr(exact, name)) for name in names]
    for expand in (
        (expand_curve_with_offset, expand_short_delay_curve) if exact.a0 is not None else (expand_curve_with_offset,)
    ):
        for part in zip(expand(plant), expand(exact), strict=True):
            pairs += zip(*part, strict=True) if isinstance(part[0], tuple) else [part]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def computed_differences(monkeypatch, operation):
    """Return the differences whose signs ``operation`` tests, with their sizes."""
    differences = []

    def record(self, other):
        differences.append(self - other)
        return differences[-1].value > TOLERANCE * differences[-1].size

    with monkeypatch.context() as patch, np.errstate(all="ignore"):
        patch.setattr(Sized, "__gt__", record)
        operation()
    return differences


@pytest.mark.parametrize("d", DELAYS)
def test_error_bounds_of_the_crossover_hold(d, monkeypatch):
    alpha, beta, delta, d = draw_walls(60, 11, d)
    wall = Sized(alpha), Sized(beta)
    with np.errstate(all="ignore"):
        plant = size_device(delta, d, classify_delays(d))
        cubic = expand_gain_difference(*wall, plant)
        u, exists = enclose_root(cubic)
        computed = certified.size_phase(u, np.floor(d))
    differences = computed_differences(
        monkeypatch, lambda: decide_long_delay(*wall, plant.whole, plant, enclose_root, certified.size_phase)
    )
    compared = 0
    for index in range(alpha.size):
        exact = certified.device(delta[index], d[index], BITS)
        with flint.ctx.workprec(BITS):
            x, y = flint.arb(alpha[index]), flint.arb(beta[index])
            true_cubic = expand_gain_difference(x, y, exact)
            assert max(errors(cubic, true_cubic, index)) < CUBIC_TOLERANCE / 2
            assert max(errors(*collect_terms(plant, exact), index)) < CUBIC_TOLERANCE / 2
            if not exists[index]:
                continue
            root, converged = certified._enclose_root_in_balls(true_cubic)
            assert converged
            assert float(abs(root / u.value[index] - 1).upper()) < CROSSOVER_WIDTH
            lag = certified._evaluate_phase_in_balls(root, int(d[index]))
            assert not computed.within[index] or lag.within
            assert not computed.beyond[index] or lag.beyond
            if not lag.within:
                continue
            compared += 1
            assert max(errors(computed[:3], lag[:3], index)) < 4 * CROSSOVER_WIDTH

            def judge(a, b, terms, root=root, whole=int(d[index]), lag=lag):
                phase = lag._replace(**{k: a.new(v) for k, v in lag._asdict().items() if isinstance(v, flint.arb)})
                return decide_long_delay(a, b, whole, terms, lambda _: (a.new(root), True), lambda *_: phase)

            true = exact_differences(judge, (x, y), exact)
            assert len(true) == len(differences)
            assert max(errors(differences, true, index)) < TOLERANCE / 2
    assert compared > 15


@pytest.mark.parametrize("d", [0.0, 0.5, 1e-9, 5e-324, 0.125, 0.93, 1.0 - 2.0**-53])
def test_error_bounds_of_plants_with_short_delay_hold(d):
    with np.errstate(all="ignore"):
        plant = size_device(DELTAS, np.full(DELTAS.size, d), classify_delays(d))
    for index, delta in enumerate(DELTAS):
        assert max(errors(*collect_terms(plant, certified.device(float(delta), d, 1600)), index)) < CUBIC_TOLERANCE / 2


@pytest.mark.parametrize("d", [0.0, 0.3, 0.93])
def test_error_bounds_of_verdicts_with_short_delay_hold(d, monkeypatch):
    alpha, beta, delta, _ = draw_walls(80, 13, d)
    plant = size_device(delta, np.full(80, d), classify_delays(d))
    differences = computed_differences(monkeypatch, lambda: decide_short_delay(Sized(alpha), Sized(beta), plant))
    compared = 0
    for index in range(80):
        with flint.ctx.workprec(BITS):
            wall, exact = (flint.arb(alpha[index]), flint.arb(beta[index])), certified.device(delta[index], d, BITS)
            true = exact_differences(decide_short_delay, wall, exact)
            assert len(true) == len(differences)
            # Skip differences without a finite value, because the root does not exist beyond the end of the lobe.
            kept = [k for k, value in enumerate(true) if value.is_finite()]
            compared += len(kept) == len(true)
            assert max(errors([differences[k] for k in kept], [true[k] for k in kept], index)) < TOLERANCE / 2
    assert compared > 40


def test_error_bound_of_half_an_ulp_is_exceeded():
    _, _, delta, d = draw_walls(60, 11, [1.5, 4.2, 2.5])
    plant = size_device(delta, d, classify_delays(d))
    worst = [max(errors(*collect_terms(plant, certified.device(delta[i], d[i], BITS)), i)) for i in range(60)]
    assert max(worst) > UNIT / 2


def test_phi_functions_satisfy_the_assumed_error_bounds():
    x = np.concatenate([np.random.default_rng(5).uniform(0, 4, 1500), DELTAS])
    with jax.enable_x64(True):
        compiled = [np.asarray(part) for part in jax.jit(phi_functions)(x)]
        powers = np.exp(-x), np.asarray(jax.jit(lambda value: jax.numpy.exp(-value))(x))
    for index, value in enumerate(x):
        with mp.workdps(oracles.digits_for(value)):
            exact = oracles.phi(value)
            for power in powers:
                assert oracles.relative_error(power[index], exact.c, floor=1e-280) <= 8 * UNIT
            for c, phi1, phi2, psi, gap in (phi_functions(x), compiled):
                assert oracles.relative_error(c[index], exact.c, floor=1e-280) <= 17 * UNIT
                pairs = (phi1, exact.phi1), (phi2, exact.phi2), (psi, exact.psi), (gap, exact.phi2 - exact.psi)
                for computed, truth in pairs:
                    assert oracles.relative_error(computed[index], truth, floor=1e-300) <= 30 * UNIT


@pytest.mark.parametrize("d", [0.0, 0.4, 1.0, 3.0, 1.7, 40.0])
def test_filter_labels_agree_with_balls(d):
    alpha, beta, delta, _ = draw_walls(4000, 19, d)
    truth = certified_stable(alpha, beta, delta, d)
    code = certified.filter_walls(alpha, beta, delta, np.full(1, d))
    assert (code != certified.OPEN).mean() > 0.999
    for label in (certified.STABLE, certified.UNSTABLE):
        assert (code == label).sum() > 100
        chosen = np.flatnonzero((code == label) & (beta > -delta))[:150]
        for k in chosen:
            assert certified.decide(alpha[k], beta[k], delta[k], d)[0] == (label == certified.STABLE)
    assert (truth.status == 0).all()
