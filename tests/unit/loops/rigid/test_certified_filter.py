"""The verdict in float64 balls: every intermediate encloses what the same text gives in python-flint's balls.

Those are held to poles in mpmath by test_certified_balls.py; the device's numbers here to mpmath's formulas.
"""

import numpy as np
import pytest
from mpmath import mp, mpf
from proved import certified_stable

import oracles
from zwidth.arrays import balls
from zwidth.arrays.balls import Ball
from zwidth.arrays.held_mass import classify_delays
from zwidth.loops.rigid import certified, certified_filter
from zwidth.loops.rigid.certified_filter import enclose_zero, enclosed_device, exp, functions, take_lag
from zwidth.loops.rigid.crossover import gain_cubic, long_curve, long_verdict, short_curve, short_verdict
from zwidth.loops.rigid.folding import Points

flint = pytest.importorskip("flint")
BITS = 400
UNIT = 2.0**-53
DELTAS = np.array([0.0, 5e-324, 1e-300, 1e-16, 1e-8, 1e-3, 0.3, 1.0, 1.4999, 1.5, 1.51, 7.0, 50.0, 699.0, 750.0, 1e12])


def numbers(here, exact):
    """The balls of a device beside their true values, and those of its curve."""
    names = [name for name, value in here._asdict().items() if isinstance(value, Ball)]
    curve = short_curve if isinstance(here.p1_t, Ball) else None
    pairs = [(getattr(here, name), getattr(exact, name)) for name in names]
    for of in (long_curve, curve):
        if of is not None:
            pairs += [pair for parts in zip(of(here), of(exact), strict=True) for pair in zip(*parts, strict=True)]
    return zip(*pairs, strict=True)


def escaped(found, exact, index):
    """How many balls of one point miss the numbers in the balls of arb."""
    count = 0
    with flint.ctx.workprec(BITS):
        for ball, truth in zip(found, exact, strict=True):
            mid, rad = (
                float(np.broadcast_to(x, index + 1 if np.ndim(x) == 0 else x.shape)[index])
                for x in (ball.mid, ball.radius)
            )
            count += not abs(truth - mid) <= rad
    return count


def walls(count, seed, d):
    """Walls on and around the stable set of many devices."""
    rng = np.random.default_rng(seed)
    delta = np.where(rng.random(count) < 0.5, rng.exponential(1.0, count), 10.0 ** rng.uniform(-9, 9, count))
    d = np.full(count, float(d)) if np.ndim(d) == 0 else rng.choice(d, count)
    scale = (1 + delta) / (1 + d)
    return rng.uniform(0, 2, count) * scale, rng.uniform(-1, 2, count) * (delta + 1 / (1 + d)), delta, d


@pytest.mark.parametrize("d", [1.0, 2.0, 7.0, 500.0, 1.5, 3.25, 60.7, np.nextafter(2.0, 1.0), 1.0 + 1e-12, 99999.5])
def test_every_intermediate_of_the_crossover_is_enclosed(d):
    alpha, beta, delta, d = walls(60, 11, d)
    a, b = Ball(alpha), Ball(beta)
    with np.errstate(all="ignore"):
        here = enclosed_device(delta, d, classify_delays(d))
        cubic = gain_cubic(a, b, here)
        u, found = enclose_zero(cubic)
        lag = take_lag(u, np.floor(d))
    seen = 0
    for index in range(alpha.size):
        with flint.ctx.workprec(BITS):
            x, y = flint.arb(alpha[index]), flint.arb(beta[index])
            device = certified.device(delta[index], d[index], BITS)
            truth = gain_cubic(x, y, device)
            assert escaped(*numbers(here, device), index=index) == 0
            assert escaped(cubic, truth, index) == 0
            if not found[index]:
                continue
            root, sure = certified._enclose_zero(truth)
            assert sure
            exact = certified._take_lag(root, int(d[index]))
            assert escaped((u,), (root,), index) == 0
            if exact.within:
                seen += 1
                assert escaped(lag[:3], exact[:3], index) == 0
            assert not lag.within[index] or exact.within
            assert not lag.beyond[index] or exact.beyond
    assert seen > 15


@pytest.mark.parametrize("d", [0.0, 0.5, 1e-9, 5e-324, 0.125, 0.93, 1.0 - 2.0**-53])
def test_every_number_of_a_short_device_is_enclosed(d):
    with np.errstate(all="ignore"):
        here = enclosed_device(DELTAS, np.full(DELTAS.size, d), classify_delays(d))
    for index, delta in enumerate(DELTAS):
        assert escaped(*numbers(here, certified.device(float(delta), d, 1600)), index=index) == 0


def test_bounds_too_small_are_noticed(monkeypatch):
    _, _, delta, d = walls(60, 11, [1.5, 4.2, 2.5])
    monkeypatch.setattr(balls, "UNIT", 2.0**-58)
    monkeypatch.setattr(certified_filter, "UNIT", 2.0**-58)
    here = enclosed_device(delta, d, classify_delays(d))
    assert sum(escaped(*numbers(here, certified.device(delta[i], d[i], BITS)), index=i) for i in range(60)) > 10


def test_phi_errors_are_as_stated():
    x = np.concatenate([np.random.default_rng(5).uniform(0, 4, 1500), DELTAS])
    found, power = functions(x), exp(-x)
    for index, value in enumerate(x):
        with mp.workdps(oracles.digits_for(value)):
            exact = oracles.phi(value)
            assert oracles.relative_error(power[index], exact.c, floor=1e-280) <= 8 * UNIT
            assert oracles.relative_error(found.c[index], exact.c, floor=1e-280) <= 17 * UNIT
            pairs = (found.phi1, exact.phi1), (found.phi2, exact.phi2), (found.psi, exact.psi)
            for value_of, truth in (*pairs, (found.gap, exact.phi2 - exact.psi)):
                assert oracles.relative_error(value_of[index], truth, floor=1e-300) <= 30 * UNIT


def test_device_is_that_of_the_printed_formulas():
    for delta in (1e-6, 0.4, 3.0, 40.0):
        for f in (0.0, 1e-7, 0.4, 0.999):
            with mp.workdps(oracles.digits_for(delta)):
                exact = oracles.numerator(delta, f)[: 3 if f else 2]
                here = enclosed_device(np.float64(delta), np.float64(f), classify_delays(f))
                for ball, value in zip((here.a2, here.a1, here.a0), exact, strict=False):
                    assert abs(mpf(float(ball.mid)) - value) <= mpf(float(ball.radius))
                assert abs(mpf(float(here.c.mid)) - mp.exp(-mpf(delta))) <= mpf(float(here.c.radius))


def test_arcsine_series_is_as_close_as_stated():
    # Over boxes that cover [0, 0.5002], by Taylor polynomials of the difference with a bounded remainder.
    pieces, order, worst = 200, 8, 0.0
    with flint.ctx.workprec(200):
        fit = flint.arb_poly([flint.arb(c) for c in certified_filter.ARCSINE])(flint.arb_poly([-1, 4]))
        half = flint.arb(0.5002) / (2 * pieces)
        offset = flint.arb(0, (half * 1.0001).upper())
        for piece in range(pieces):
            centre = (2 * piece + 1) * half
            total, power = flint.arb(0), flint.arb(1)
            for k in range(order + 1):
                at = centre if k < order else centre + offset
                total += (_arcsine_derivative(at, k) - fit(flint.arb_poly([at, 1]))[k]) * power
                power *= offset
            worst = max(worst, float(abs(total).upper()))
    # The rest up to 2^-46 is room for the rounding of the evaluation.
    assert 2.0**-48 < worst < 2.0**-46.5


def _arcsine_derivative(y, k):
    """The k-th derivative over k! of ``asin(sqrt y)/sqrt y = sum_j binom(2 j, j)/(4^j (2 j + 1)) y^j``."""
    total, term, power = flint.arb(0), flint.arb(1), flint.arb(1)
    for j in range(120):
        if j >= k:
            total += term / (2 * j + 1) * flint.arb.bin_uiui(j, k) * power
            power *= y
        term = term * (2 * j + 1) / (2 * j + 2)
    # Later terms fall by more than y 120/(120 - k) < 0.54 each.
    return total + flint.arb(0, (term / 241 * flint.arb.bin_uiui(120, k) * power * 3).upper())


@pytest.mark.parametrize("d", [0.0, 0.4, 1.0, 3.0, 1.7, 40.0])
def test_a_verdict_on_a_box_holds_for_every_wall_in_it(d):
    rng = np.random.default_rng(17)
    alpha, beta, delta, _ = walls(400, 19, d)
    width = 10.0 ** rng.uniform(-5, -1, 400)
    boxes = Ball(alpha, 1.001 * width * np.abs(alpha)), Ball(beta, 1.001 * width * np.abs(beta))
    with np.errstate(all="ignore"):
        here = enclosed_device(delta, np.full(400, d), classify_delays(d))
        if d < 1:
            verdict = short_verdict(*boxes, here)
        else:
            verdict = long_verdict(*boxes, here.whole, here, enclose_zero, take_lag)
        meant = (boxes[0] > 0) & (boxes[1] + delta > 0)
    stable, unstable = verdict.stable & meant, verdict.unstable & meant
    assert stable.sum() > 20
    assert unstable.sum() > 20
    for _ in range(8):
        inside = [x * (1 + width * rng.uniform(-1, 1, 400)) for x in (alpha, beta)]
        truth = certified_stable(*inside, delta=delta, d=d)
        assert (truth.status == 0).all()
        assert truth.stable[stable].all()
        assert not truth.stable[unstable].any()


@pytest.mark.parametrize("error", [0.3, 0.9, 1.1, 3.0, np.nan])
def test_where_the_computed_end_of_a_row_is_wrong_nothing_wrong_is_proved(error, monkeypatch):
    """The end only chooses the walls that are tried: whatever it is, the codes are those of the walls one by one."""
    arrays = np.linspace(0.0, 0.9, 1701)[None, :], np.linspace(-0.3, 1.1, 41)[:, None], np.full((1, 1), 0.2)
    points = Points(*arrays, np.full((1, 1), 1.5))
    assert certified_filter.has_rows(points)
    expected = certified_filter.each_code(points)
    assert {certified_filter.STABLE, certified_filter.UNSTABLE} <= set(expected.ravel().tolist())
    computed = certified_filter.row_limits
    monkeypatch.setattr(certified_filter, "row_limits", lambda *row: computed(*row) * error)
    np.testing.assert_array_equal(certified_filter.filter_walls(points), expected)
