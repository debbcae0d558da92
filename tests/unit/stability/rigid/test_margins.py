"""Stability margins against python-control, the verdict on both sides of each margin, mpmath and dense
frequency scans.
"""

import control
import jax
import mpmath as mp
import numpy as np
import pytest
from compiling import QUICKLY, compile_bends

import zwidth
from zwidth.core.errors import InputError
from zwidth.plant.rigid_mass import discretize_plant
from zwidth.stability.rigid.crossover import stable_kernel
from zwidth.stability.rigid.modulus import compute_squared_distance, find_modulus_margin

ASIDE = 1e-9  # relative offset from a margin at which the verdict must have changed; margins are accurate to 1e-13


def walls(count, seed):
    """Return random walls, most of them stable, with integer and fractional delays and damping over eight decades."""
    random = np.random.default_rng(seed)
    d = random.choice([0, 0, 1, 2, 5, 40, 1000], count) + np.where(
        random.uniform(size=count) < 0.5, 0.0, random.uniform(size=count)
    )
    delta = np.where(random.uniform(size=count) < 0.1, 0.0, 10 ** random.uniform(-4, 4, count))
    ridge = zwidth.alpha_max(delta, d)
    alpha = ridge.alpha * 10 ** random.uniform(-4, 0.1, count)
    beta = ridge.beta * random.uniform(0, 1.3, count) + 0.01 * random.normal(size=count) * np.abs(ridge.beta)
    return alpha, beta, delta, d


def verdict(alpha, beta, delta, d):
    """Return the closed-form verdict, tested elsewhere against certified labels, in NumPy without compilation."""
    with np.errstate(all="ignore"):
        alpha, beta, delta, d = np.broadcast_arrays(*map(np.float64, (alpha, beta, delta, d)))
        return stable_kernel(alpha, beta, delta, d)


def open_loop(alpha, beta, delta, d):
    """Return L as a python-control transfer function, from the polynomials of the loop with and without a wall."""
    device_only = zwidth.char_poly(0.0, 0.0, delta, d)
    return control.tf(zwidth.char_poly(alpha, beta, delta, d) - device_only, device_only, True)


@pytest.mark.parametrize(
    "wall",
    [(0.1, 0.4, 0.1, 0.0), (0.1, 0.4, 0.1, 1.0), (0.02, 0.2, 0.5, 2.3), (0.01, 0.1, 0.01, 4.0)],
)
def test_margins_agree_with_python_control(wall):
    margins = zwidth.margins(*wall)
    gm, pm, sm, wpc, wgc, wms = control.stability_margins(open_loop(*wall), epsw=1e-6)
    # python-control computes the frequencies as roots of polynomials of high degree and by a minimizer.
    assert margins.gain_margin == pytest.approx(gm, rel=1e-6)
    assert margins.phase_margin == pytest.approx(pm, rel=1e-6)
    assert margins.modulus_margin == pytest.approx(sm, rel=1e-6)
    assert margins.phase_crossover == pytest.approx(wpc, rel=1e-6)
    assert margins.gain_crossover == pytest.approx(wgc, rel=1e-6)
    # python-control may return the mirror image about pi.
    assert margins.modulus_frequency == pytest.approx(min(wms, 2 * np.pi - wms), rel=1e-4)


def test_verdict_changes_at_the_gain_margin():
    alpha, beta, delta, d = walls(1500, 1)
    margins = zwidth.margins(alpha, beta, delta, d)
    stable = verdict(alpha, beta, delta, d)
    assert 400 < stable.sum() < 1450
    np.testing.assert_array_equal(margins.phase_margin > 0, stable & (beta > -delta))
    np.testing.assert_array_equal(margins.gain_margin > 1, stable)
    np.testing.assert_array_equal(margins.delay_margin > 0, stable)
    assert np.all(margins.delay_margin[~stable] == 0)
    # Scale alpha and beta by the gain margin, from any wall with a stable gain.
    gain = margins.gain_margin
    finite = np.isfinite(gain) & (gain > 0)
    for factor, expected in ((1 - ASIDE, True), (1 + ASIDE, False)):
        scaled = gain[finite] * factor
        scaled_stable = verdict(scaled * alpha[finite], scaled * beta[finite], delta[finite], d[finite])
        assert (scaled_stable == expected).all()
    # No smaller gain is unstable.
    for factor in (0.9, 0.3, 1e-3):
        scaled = gain[finite] * factor
        assert verdict(scaled * alpha[finite], scaled * beta[finite], delta[finite], d[finite]).all()


def test_wall_stays_stable_up_to_the_delay_margin():
    alpha, beta, delta, d = (value[:700] for value in walls(1500, 2))
    stable = verdict(alpha, beta, delta, d)
    alpha, beta, delta, d = (value[stable] for value in (alpha, beta, delta, d))
    margin = zwidth.margins(alpha, beta, delta, d).delay_margin
    offset = 1e-9 * (1 + d + margin)
    inside = d + margin + offset <= 1e5
    assert inside.sum() > 200
    alpha, beta, delta, d, margin, offset = (value[inside] for value in (alpha, beta, delta, d, margin, offset))
    assert not verdict(alpha, beta, delta, d + margin + offset).any()
    for ratio in np.linspace(0, 1, 120):
        assert verdict(alpha, beta, delta, d + ratio * np.maximum(margin - offset, 0)).all()


def test_delay_margin_ends_at_the_first_short_interval_of_instability():
    # Within ln 2/delta before an integer delay, strongly damped devices tolerate less stiffness than at the integer.
    rng = np.random.default_rng(7)
    delta = 10 ** np.append(rng.uniform(1, 2, 600), rng.uniform(0, 6, 200))
    d = np.where(rng.random(800) < 0.5, rng.integers(0, 6, 800), rng.uniform(0, 6, 800))
    alpha = zwidth.alpha_max(delta, d).alpha * 10 ** rng.uniform(-6, -0.3, 800)
    low, high = (zwidth.boundary_point(delta, d, alpha=alpha, side=side).beta for side in ("lower", "upper"))
    beta = low + (high - low) * rng.choice([0.1, 0.5, 0.9, 0.999], 800)
    walls = np.stack([alpha, beta, delta, d])[:, np.asarray(zwidth.is_stable(alpha, beta, delta, d))]
    margin = np.asarray(zwidth.margins(*walls).delay_margin)
    alpha, beta, delta, d = walls[:, :, None]
    early = np.floor(d)[..., None] + np.arange(1, 8)[:, None] - np.geomspace(1e-3, 1.5, 60) / delta[..., None]
    delays = np.concatenate([early.reshape(d.size, -1), d + margin[:, None] * np.linspace(0, 1, 100)[:-1]], axis=1)
    ahead = (delays > d) & (delays < np.minimum(d + margin[:, None] * (1 - 1e-9), 1e5))
    stable = np.asarray(zwidth.is_stable(alpha, beta, delta, np.where(ahead, delays, d)))
    assert walls.shape[1] > 700
    np.testing.assert_array_equal(stable, True)
    ends = d[:, 0] + margin < 9e4
    just_above = (d[:, 0] + margin)[ends] * (1 + 1e-12)
    a, b, damping = walls[:3, ends]
    assert not np.asarray(zwidth.is_stable(a, b, damping, just_above)).any()
    # Formerly missed: the wall loses stability 0.99 periods before the margin found with 64 equidistant samples per
    # period.
    wall = 0.02576018862704622, 20.408868144027153, 19.712750549766938, 0.9656786317506585
    assert zwidth.margins(*wall).delay_margin < 3.1e-4


def test_delay_margin_counts_only_longer_delays():
    # The line of z = -1 is active at d = 0 only: at longer delays the wall becomes stable, and unstable again later.
    d = np.linspace(0, 3, 3001)
    random = np.random.default_rng(4)
    delta, count = 10 ** random.uniform(0, 3, 4000), 0
    beta = delta * random.uniform(0.3, 1.2, 4000)
    alpha = delta * 10 ** random.uniform(-3, 0.5, 4000)
    odd = ~verdict(alpha, beta, delta, 0.0) & verdict(alpha, beta, delta, 0.4)
    for wall in list(zip(alpha[odd], beta[odd], delta[odd], strict=True))[:12]:
        stable = verdict(*wall, d)
        assert zwidth.margins(*wall, 0.0).delay_margin == 0
        start = d[np.argmax(stable)]
        lost = d[np.argmax(stable) + np.argmin(stable[np.argmax(stable) :])]
        assert start + zwidth.margins(*wall, start).delay_margin == pytest.approx(lost, abs=2e-3)
        count += 1
    assert count >= 5


def loop_in_mpmath(alpha, beta, delta, d):
    """Return L as a function of w, in the working precision."""
    alpha, beta, delta = (mp.mpf(float(value)) for value in (alpha, beta, delta))
    n = int(np.floor(d))
    f = mp.mpf(float(d)) - n
    t = 1 - f

    def phi1(x):
        return -mp.expm1(-x) / x if x else mp.mpf(1)

    def phi2(x):
        return (1 - phi1(x)) / x if x else mp.mpf(1) / 2

    c = mp.exp(-delta)
    now = t * t * phi2(delta * t), t * phi1(delta * t)
    before = (
        f * f * phi2(delta * f) + t * phi1(delta * t) * f * phi1(delta * f),
        c / mp.exp(-delta * f) * f * phi1(delta * f),
    )
    p1 = phi1(delta)

    def loop(w):
        z = mp.expj(w)
        top = z * (now[0] * z + p1 * now[1] - c * now[0]) + before[0] * z + p1 * before[1] - c * before[0]
        return top * (alpha * z + beta * (z - 1)) / (z ** (2 + n) * (z - 1) * (z - c))

    return loop


def phase_in_mpmath(alpha, beta, delta, d):
    """Return the phase margin in degrees and the gain crossover, found by bisection of |L| = 1."""
    with mp.workdps(40):
        loop = loop_in_mpmath(alpha, beta, delta, d)
        low, high = mp.mpf(10) ** -12, mp.pi
        for _ in range(130):
            middle = (low + high) / 2
            low, high = (middle, high) if abs(loop(middle)) > 1 else (low, middle)
        return float(mp.arg(-loop(low)) * 180 / mp.pi), float(low)


def test_phase_margin_agrees_with_forty_digits():
    alpha, beta, delta, d = (value[:40] for value in walls(200, 3))
    margins = zwidth.margins(alpha, beta, delta, d)
    for k in np.flatnonzero(margins.phase_margin > 0):
        phase, crossover = phase_in_mpmath(alpha[k], beta[k], delta[k], d[k])
        # A rounding error of the crossover changes the phase in proportion to the delay.
        assert abs(margins.phase_margin[k] - phase) <= 1e-11, k
        assert margins.gain_crossover[k] == pytest.approx(crossover, rel=1e-13)


def test_modulus_margin_and_frequency_agree_with_forty_digits():
    alpha, beta, delta, d = (value[:40] for value in walls(200, 5))
    margins = zwidth.margins(alpha, beta, delta, d)
    inside = np.flatnonzero((margins.modulus_frequency < 3.14) & (margins.modulus_margin > 1e-3))
    assert inside.size > 20
    for k in inside:
        with mp.workdps(40):
            loop = loop_in_mpmath(alpha[k], beta[k], delta[k], d[k])
            start = mp.mpf(float(margins.modulus_frequency[k]))
            w = mp.findroot(lambda w: mp.diff(lambda w: abs(1 + loop(w)) ** 2, w), start, solver="mnewton")  # noqa: B023
            assert margins.modulus_margin[k] == pytest.approx(float(abs(1 + loop(w))), rel=1e-11), k
            # The location of a flat minimum has fewer digits.
            assert margins.modulus_frequency[k] == pytest.approx(float(w), rel=1e-10), k


def test_modulus_margin_with_long_delay_and_strong_damping():
    # A sampling of all frequencies missed this minimum; 60 digits yield 0.0513099277...
    margins = zwidth.margins(1.464471400554459e-06, 707.7238995101212, 746.0, 64)
    assert margins.modulus_margin == pytest.approx(0.0513099277, abs=1e-10)
    # One of five minima of nearly equal depth; reference by a dense scan.
    margins = zwidth.margins(0.0004437792708975559, 25721.17922255653, 24834.723768588945, 8.93337251629143)
    assert margins.modulus_margin == pytest.approx(0.0085123565, abs=1e-10)
    # Two samples coincide at the crossover, near the minimum.
    margins = zwidth.margins(1.0279633869115278e-07, 84.09864150326689, 79.03626173373243, 64.36683594188543)
    assert margins.modulus_margin == pytest.approx(0.0002142985, abs=1e-10)


def test_modulus_margin_of_a_nearly_vanishing_wall():
    # The minimum is at real negative L, far above the crossover frequency.
    margins = zwidth.margins(1e-8, 0.49993896484375, 1e12, 1.0)
    assert 0.999 < margins.modulus_margin < 1.0
    assert margins.modulus_frequency == pytest.approx(0.5 * np.pi, abs=0.01)


def test_no_scanned_frequency_is_closer_to_minus_one():
    random = np.random.default_rng(6)
    for _ in range(200):
        d = random.choice([0, 0, 1, 2, 8, 64, 300]) + random.choice([0, random.uniform()])
        delta = random.choice([0, 10 ** random.uniform(-4, 5)])
        if random.uniform() < 0.5:
            # |L| is almost constant, with many minima of similar depth.
            beta, alpha = delta * random.uniform(0.5, 1.3), 10 ** random.uniform(-9, 0) * (1 + delta) / (d + 1)
        else:
            beta = (delta + 0.1) * 10 ** random.uniform(-3, 0.3) * random.choice([-1, 1, 1])
            alpha = 10 ** random.uniform(-8, 1) / (d + 1) * (1 + delta)
        w = np.concatenate([np.linspace(0, np.pi, 200 * (int(d) + 2))[1:], np.geomspace(1e-12, np.pi, 8000)])
        scanned = np.sqrt(
            compute_squared_distance(w, alpha, beta, discretize_plant(np.float64(delta), np.float64(d))).min()
        )
        margins = zwidth.margins(alpha, beta, delta, d)
        assert margins.modulus_margin <= scanned * (1 + 1e-12), (alpha, beta, delta, d)
        # The distance is attained at the returned frequency.
        attained = compute_squared_distance(
            margins.modulus_frequency, alpha, beta, discretize_plant(np.float64(delta), np.float64(d))
        )
        assert margins.modulus_margin == pytest.approx(np.sqrt(attained), rel=1e-12)


def test_walls_without_margins_have_nan_zero_or_infinity():
    # No stiffness, negative stiffness, parameters out of range.
    margins = zwidth.margins(
        np.array([0.0, -1.0, 0.1, 0.1, np.nan]), 0.4, np.array([1.0, 1, -1, 1, 1]), [1, 1, 1, 1e6, 1]
    )
    assert all(np.isnan(field).all() for field in margins)
    # Undamped, with too little virtual damping for stability at any gain.
    none = zwidth.margins(0.1, 0.1, 0.0, 1)
    assert none.gain_margin == 0
    assert np.isnan(none.phase_crossover)
    assert none.phase_margin < 0
    # |L| > 1 throughout.
    over = zwidth.margins(100.0, 100.0, 1.0, 0)
    assert np.isnan(over.gain_crossover)
    assert np.isnan(over.phase_margin)
    assert over.gain_margin < 1
    assert over.delay_margin == 0
    # For beta < -delta the phase margin is undefined.
    assert np.isnan(zwidth.margins(0.1, -2.0, 1.0, 0).phase_margin)
    with pytest.raises(InputError, match="alpha: got"):
        zwidth.margins(1e70, 0.4, 0.1, 1)


@pytest.mark.parametrize("delta", [5e-324, 1e-310, 5e-309, 2.3e-308, 1e-300])
def test_subnormal_damping_does_not_change_margins(delta):
    """1/delta overflows or nearly does; stable walls must have the margins of the undamped device."""
    walls = 1e-3, 1e-2, np.array([0.0, delta])[:, None], np.array([0.0, 0.5, 1.0, 3.0])
    none, tiny = (np.array([field[k] for field in zwidth.margins(*walls)]) for k in (0, 1))
    np.testing.assert_allclose(tiny, none, rtol=1e-12)


def test_longest_delays():
    wall = (1e-7, 0.05, 0.1)
    short, long = zwidth.margins(*wall, 1.0), zwidth.margins(*wall, 9_001.0)
    assert short.delay_margin == pytest.approx(long.delay_margin + 9_000, rel=1e-12)
    assert short.gain_crossover == long.gain_crossover


def test_values_and_derivatives_inside_jit(x64):
    wall = np.array([0.1, 0.4, 0.1, 1.3])

    def all_of(wall):
        return jax.numpy.stack(zwidth.margins(*wall))

    compiled = jax.jit(lambda wall, side: jax.jvp(all_of, (wall,), (side,)), compiler_options=QUICKLY)

    def differentiate(wall, side):
        # Convert to NumPy, because every operation on JAX arrays would compile a program.
        return map(np.asarray, compiled(wall, side))

    for side in np.eye(4):
        values, slopes = differentiate(wall, side)
        np.testing.assert_allclose(values, zwidth.margins(*wall), rtol=1e-9)
        step = 1e-6 * side
        up, down = (np.array(zwidth.margins(*(wall + sign * step))) for sign in (1, -1))
        expected = (up - down) / 2e-6
        np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-7)
    # Missing margins have NaN derivatives: gain above 1 at every frequency, no stable gain, beta <= -delta.
    for wall in ((100.0, 100.0, 1.0, 0.0), (0.1, 0.1, 0.0, 1.0), (0.1, -2.0, 1.0, 0.0)):
        for side in np.eye(4):
            values, slopes = differentiate(np.array(wall), side)
            missing = np.isnan(values)
            assert missing.any()
            assert np.isnan(slopes[missing]).all()
    # On the boundary, rounding errors determine the sign of the margin; its derivatives are those of a nearby wall.
    edge = zwidth.boundary(0.5, 0.3, 1.0)
    for side in np.eye(4)[:3]:
        (_, slopes), (_, nearby) = (
            differentiate(np.array([edge.alpha * by, edge.beta, 0.3, 1.0]), side) for by in (1.0, 1.0 - 1e-7)
        )
        np.testing.assert_allclose(slopes[:2], nearby[:2], rtol=1e-5)
    # Near a corner, references in 50 digits: a zero of the phase near z = -1, and the line of z = -1 without one.
    for wall, expected in (
        ((232.74593597019737, -57.112690872135914, 57.18779732288607, 0.0), (-6.0587189e-6, 0.017484553, 0.017533416)),
        ((16533.94525926982, -4132.485346166673, 4132.486315063933, 0.0), (-1.2093398e-4, -2.4186796e-4, 2.418679e-4)),
    ):
        slopes = [tuple(differentiate(np.array(wall), side))[1][0] for side in np.eye(4)[:3]]
        np.testing.assert_allclose(slopes, expected, rtol=1e-5, atol=1e-8)


def test_second_derivatives_of_modulus_margin_and_frequency(x64):
    wall = np.array([0.1, 0.4, 0.1, 1.3])

    def nearest(wall):
        alpha, beta, delta, d = wall
        return jax.numpy.stack(find_modulus_margin(alpha, beta, discretize_plant(delta, d)))

    differentiate = compile_bends(jax.jacfwd(nearest))
    for side, bend in zip(np.eye(4), np.moveaxis(differentiate([wall, wall])[1][0], -1, 0), strict=True):
        up, down = differentiate([wall + sign * 1e-5 * side for sign in (1, -1)])[0]
        np.testing.assert_allclose(bend, (up - down) / 2e-5, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("delta", [1e-300, 1e-200, 1e-153])
def test_damping_whose_square_underflows_equals_zero_damping(delta):
    """If no gain is stable without damping, the gain margin is 0 and its frequency NaN."""
    walls = [1e-8, 0.686, 0.1], [-0.18, 0.0, 0.4], delta, [0.3, 0.0, 1.0]
    margins, without = zwidth.margins(*walls), zwidth.margins(*walls[:2], 0.0, walls[3])
    np.testing.assert_array_equal(margins, without)
    assert margins.gain_margin.tolist()[:2] == [0.0, 0.0]
    assert np.isnan(margins.phase_crossover[:2]).all()


def test_phase_margin_of_an_unstable_wall_is_the_smallest_rotation():
    """The phase margin lies between -180 and 0 degrees; reference: the frequency response from the polynomials."""
    random = np.random.default_rng(52)
    wall = [10.0 ** random.uniform(low, high, 400) for low, high in ((-3, 1.5), (-3, 1), (-3, 1))]
    wall.append(random.choice([0.0, 1.0, 2.0, 0.5, 3.3, 8.0], 400))
    margins = zwidth.margins(*wall)
    unstable = np.flatnonzero(~zwidth.is_stable(*wall) & np.isfinite(margins.phase_margin))
    assert unstable.size > 100
    for k in unstable:
        alpha, beta, delta, d = (values[k] for values in wall)
        z = np.exp(1j * margins.gain_crossover[k])
        free, closed = (np.polyval(zwidth.char_poly(*kb, delta, d), z) for kb in ((0.0, 0.0), (alpha, beta)))
        rotation = np.degrees(abs(np.angle(-(closed - free) / free)))
        assert margins.phase_margin[k] == pytest.approx(-rotation, abs=1e-9)
    # Formerly returned as -346.9 degrees.
    assert -180 <= margins.phase_margin[unstable].min() < margins.phase_margin[unstable].max() <= 0
