"""Margins against python-control, against the verdict on both sides of each, and against dense scans."""

import control
import jax
import mpmath as mp
import numpy as np
import pytest
from compiling import QUICKLY, compile_bends

import zwidth
from zwidth.core.errors import InputError
from zwidth.numerics.held_mass import discretize_plant
from zwidth.stability.rigid.crossover import stable_kernel
from zwidth.stability.rigid.modulus import compute_squared_distance, find_modulus_margin

# Beyond this from a margin the verdict must have changed; the margins themselves are good to 1e-13 or so.
ASIDE = 1e-9


def walls(count, seed):
    """Random walls, most of them stable: delays whole and not, dampings over eight decades."""
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
    """Stable or not by the closed form, whose own judges are certified labels; in NumPy, with nothing to compile."""
    with np.errstate(all="ignore"):
        alpha, beta, delta, d = np.broadcast_arrays(*map(np.float64, (alpha, beta, delta, d)))
        return stable_kernel(alpha, beta, delta, d)


def open_loop(alpha, beta, delta, d):
    """L for python-control, from the polynomial of the closed loop and of the loop without a wall."""
    device_only = zwidth.char_poly(0.0, 0.0, delta, d)
    return control.tf(zwidth.char_poly(alpha, beta, delta, d) - device_only, device_only, True)


@pytest.mark.parametrize(
    "wall",
    [(0.1, 0.4, 0.1, 0.0), (0.1, 0.4, 0.1, 1.0), (0.02, 0.2, 0.5, 2.3), (0.01, 0.1, 0.01, 4.0)],
)
def test_python_control_agrees(wall):
    found = zwidth.margins(*wall)
    gm, pm, sm, wpc, wgc, wms = control.stability_margins(open_loop(*wall), epsw=1e-6)
    # control finds its frequencies as roots of high polynomials and by a minimizer.
    assert found.gain_margin == pytest.approx(gm, rel=1e-6)
    assert found.phase_margin == pytest.approx(pm, rel=1e-6)
    assert found.modulus_margin == pytest.approx(sm, rel=1e-6)
    assert found.phase_crossover == pytest.approx(wpc, rel=1e-6)
    assert found.gain_crossover == pytest.approx(wgc, rel=1e-6)
    # Found on either side of pi.
    assert found.modulus_frequency == pytest.approx(min(wms, 2 * np.pi - wms), rel=1e-4)


def test_each_margin_is_where_the_verdict_changes():
    alpha, beta, delta, d = walls(1500, 1)
    found = zwidth.margins(alpha, beta, delta, d)
    stable = verdict(alpha, beta, delta, d)
    assert 400 < stable.sum() < 1450
    np.testing.assert_array_equal(found.phase_margin > 0, stable & (beta > -delta))
    np.testing.assert_array_equal(found.gain_margin > 1, stable)
    np.testing.assert_array_equal(found.delay_margin > 0, stable)
    assert np.all(found.delay_margin[~stable] == 0)
    # Gain: both parts of the wall grow, from any wall whose ray is ever stable.
    gain = found.gain_margin
    finite = np.isfinite(gain) & (gain > 0)
    for factor, expected in ((1 - ASIDE, True), (1 + ASIDE, False)):
        scaled = gain[finite] * factor
        found_stable = verdict(scaled * alpha[finite], scaled * beta[finite], delta[finite], d[finite])
        assert (found_stable == expected).all()
    # No smaller gain was seen to be unstable.
    for factor in (0.9, 0.3, 1e-3):
        scaled = gain[finite] * factor
        assert verdict(scaled * alpha[finite], scaled * beta[finite], delta[finite], d[finite]).all()


def test_delay_is_borne_up_to_its_margin():
    alpha, beta, delta, d = (value[:700] for value in walls(1500, 2))
    stable = verdict(alpha, beta, delta, d)
    alpha, beta, delta, d = (value[stable] for value in (alpha, beta, delta, d))
    margin = zwidth.margins(alpha, beta, delta, d).delay_margin
    room = 1e-9 * (1 + d + margin)
    inside = d + margin + room <= 1e5
    assert inside.sum() > 200
    alpha, beta, delta, d, margin, room = (value[inside] for value in (alpha, beta, delta, d, margin, room))
    assert not verdict(alpha, beta, delta, d + margin + room).any()
    for part in np.linspace(0, 1, 120):
        assert verdict(alpha, beta, delta, d + part * np.maximum(margin - room, 0)).all()


def test_a_delay_that_a_strongly_damped_wall_does_not_bear_for_a_moment_ends_its_margin():
    # Just before a whole delay, within ln 2/delta of it, such devices bear less than at it.
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
    beyond = (d[:, 0] + margin)[ends] * (1 + 1e-12)
    a, b, damping = walls[:3, ends]
    assert not np.asarray(zwidth.is_stable(a, b, damping, beyond)).any()
    # Lost 0.99 periods before the margin that 64 even samples of a period tell.
    wall = 0.02576018862704622, 20.408868144027153, 19.712750549766938, 0.9656786317506585
    assert zwidth.margins(*wall).delay_margin < 3.1e-4


def test_a_shorter_delay_may_be_worse_and_only_what_lies_ahead_counts():
    # The line of z = -1 binds at d = 0 only: beyond, the wall becomes stable, and later unstable for good.
    d = np.linspace(0, 3, 3001)
    random = np.random.default_rng(4)
    delta, found = 10 ** random.uniform(0, 3, 4000), 0
    beta = delta * random.uniform(0.3, 1.2, 4000)
    alpha = delta * 10 ** random.uniform(-3, 0.5, 4000)
    odd = ~verdict(alpha, beta, delta, 0.0) & verdict(alpha, beta, delta, 0.4)
    for wall in list(zip(alpha[odd], beta[odd], delta[odd], strict=True))[:12]:
        stable = verdict(*wall, d)
        assert zwidth.margins(*wall, 0.0).delay_margin == 0
        start = d[np.argmax(stable)]
        lost = d[np.argmax(stable) + np.argmin(stable[np.argmax(stable) :])]
        assert start + zwidth.margins(*wall, start).delay_margin == pytest.approx(lost, abs=2e-3)
        found += 1
    assert found >= 5


def loop_in_mpmath(alpha, beta, delta, d):
    """L as a function of w, in the working precision."""
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
    """The phase margin in degrees: the crossover by bisection of |L| = 1, then the phase followed from there."""
    with mp.workdps(40):
        loop = loop_in_mpmath(alpha, beta, delta, d)
        low, high = mp.mpf(10) ** -12, mp.pi
        for _ in range(130):
            middle = (low + high) / 2
            low, high = (middle, high) if abs(loop(middle)) > 1 else (low, middle)
        return float(mp.arg(-loop(low)) * 180 / mp.pi), float(low)


def test_the_phase_margin_in_forty_digits():
    alpha, beta, delta, d = (value[:40] for value in walls(200, 3))
    found = zwidth.margins(alpha, beta, delta, d)
    for k in np.flatnonzero(found.phase_margin > 0):
        phase, crossover = phase_in_mpmath(alpha[k], beta[k], delta[k], d[k])
        # A crossover known to a rounding error moves the phase by the lag's share of it.
        assert abs(found.phase_margin[k] - phase) <= 1e-11, k
        assert found.gain_crossover[k] == pytest.approx(crossover, rel=1e-13)


def test_the_modulus_margin_and_its_frequency_in_forty_digits():
    alpha, beta, delta, d = (value[:40] for value in walls(200, 5))
    found = zwidth.margins(alpha, beta, delta, d)
    inside = np.flatnonzero((found.modulus_frequency < 3.14) & (found.modulus_margin > 1e-3))
    assert inside.size > 20
    for k in inside:
        with mp.workdps(40):
            loop = loop_in_mpmath(alpha[k], beta[k], delta[k], d[k])
            start = mp.mpf(float(found.modulus_frequency[k]))
            w = mp.findroot(lambda w: mp.diff(lambda w: abs(1 + loop(w)) ** 2, w), start, solver="mnewton")  # noqa: B023
            assert found.modulus_margin[k] == pytest.approx(float(abs(1 + loop(w))), rel=1e-11), k
            # A flat minimum is known to fewer digits.
            assert found.modulus_frequency[k] == pytest.approx(float(w), rel=1e-10), k


def test_the_modulus_margin_of_long_delay_and_strong_damping():
    # A minimum that samples over all frequencies missed; 60 digits give .0513099277...
    found = zwidth.margins(1.464471400554459e-06, 707.7238995101212, 746.0, 64)
    assert found.modulus_margin == pytest.approx(0.0513099277, abs=1e-10)
    # One of five dips of nearly one depth, by a scan.
    found = zwidth.margins(0.0004437792708975559, 25721.17922255653, 24834.723768588945, 8.93337251629143)
    assert found.modulus_margin == pytest.approx(0.0085123565, abs=1e-10)
    # The crossover, where one sample lies on another, is next to the dip.
    found = zwidth.margins(1.0279633869115278e-07, 84.09864150326689, 79.03626173373243, 64.36683594188543)
    assert found.modulus_margin == pytest.approx(0.0002142985, abs=1e-10)


def test_the_modulus_margin_of_a_wall_that_is_next_to_nothing():
    # Least where L is negative, far behind the crossover.
    found = zwidth.margins(1e-8, 0.49993896484375, 1e12, 1.0)
    assert 0.999 < found.modulus_margin < 1.0
    assert found.modulus_frequency == pytest.approx(0.5 * np.pi, abs=0.01)


def test_no_frequency_comes_closer():
    random = np.random.default_rng(6)
    for _ in range(200):
        d = random.choice([0, 0, 1, 2, 8, 64, 300]) + random.choice([0, random.uniform()])
        delta = random.choice([0, 10 ** random.uniform(-4, 5)])
        if random.uniform() < 0.5:
            # |L| is all but constant, and the closest turn one of many.
            beta, alpha = delta * random.uniform(0.5, 1.3), 10 ** random.uniform(-9, 0) * (1 + delta) / (d + 1)
        else:
            beta = (delta + 0.1) * 10 ** random.uniform(-3, 0.3) * random.choice([-1, 1, 1])
            alpha = 10 ** random.uniform(-8, 1) / (d + 1) * (1 + delta)
        w = np.concatenate([np.linspace(0, np.pi, 200 * (int(d) + 2))[1:], np.geomspace(1e-12, np.pi, 8000)])
        scanned = np.sqrt(
            compute_squared_distance(w, alpha, beta, discretize_plant(np.float64(delta), np.float64(d))).min()
        )
        found = zwidth.margins(alpha, beta, delta, d)
        assert found.modulus_margin <= scanned * (1 + 1e-12), (alpha, beta, delta, d)
        # And the distance is attained.
        at = compute_squared_distance(
            found.modulus_frequency, alpha, beta, discretize_plant(np.float64(delta), np.float64(d))
        )
        assert found.modulus_margin == pytest.approx(np.sqrt(at), rel=1e-12)


def test_what_is_returned_for_walls_without_margins():
    # No stiffness, negative stiffness, out of range.
    found = zwidth.margins(
        np.array([0.0, -1.0, 0.1, 0.1, np.nan]), 0.4, np.array([1.0, 1, -1, 1, 1]), [1, 1, 1, 1e6, 1]
    )
    assert all(np.isnan(field).all() for field in found)
    # Undamped, with too little virtual damping for any gain.
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
    # Below -delta the phase decides nothing.
    assert np.isnan(zwidth.margins(0.1, -2.0, 1.0, 0).phase_margin)
    with pytest.raises(InputError, match="alpha: got"):
        zwidth.margins(1e70, 0.4, 0.1, 1)


@pytest.mark.parametrize("delta", [5e-324, 1e-310, 5e-309, 2.3e-308, 1e-300])
def test_a_damping_next_to_none_moves_no_margin(delta):
    """Its inverse is infinite or nearly so; stable walls of an undamped device have the margins of one without any."""
    walls = 1e-3, 1e-2, np.array([0.0, delta])[:, None], np.array([0.0, 0.5, 1.0, 3.0])
    none, least = (np.array([field[k] for field in zwidth.margins(*walls)]) for k in (0, 1))
    np.testing.assert_allclose(least, none, rtol=1e-12)


def test_the_longest_delays():
    wall = (1e-7, 0.05, 0.1)
    short, long = zwidth.margins(*wall, 1.0), zwidth.margins(*wall, 9_001.0)
    assert short.delay_margin == pytest.approx(long.delay_margin + 9_000, rel=1e-12)
    assert short.gain_crossover == long.gain_crossover


def test_traced(x64):
    wall = np.array([0.1, 0.4, 0.1, 1.3])

    def all_of(wall):
        return jax.numpy.stack(zwidth.margins(*wall))

    compiled = jax.jit(lambda wall, side: jax.jvp(all_of, (wall,), (side,)), compiler_options=QUICKLY)

    def along(wall, side):
        # NumPy's: every other operation on JAX's arrays would be a program to compile.
        return map(np.asarray, compiled(wall, side))

    for side in np.eye(4):
        values, slopes = along(wall, side)
        np.testing.assert_allclose(values, zwidth.margins(*wall), rtol=1e-9)
        step = 1e-6 * side
        up, down = (np.array(zwidth.margins(*(wall + sign * step))) for sign in (1, -1))
        expected = (up - down) / 2e-6
        np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-7)
    # Margins that are not there have no slopes: too much gain at every frequency, none that is stable, beta <= -delta.
    for wall in ((100.0, 100.0, 1.0, 0.0), (0.1, 0.1, 0.0, 1.0), (0.1, -2.0, 1.0, 0.0)):
        for side in np.eye(4):
            values, slopes = along(np.array(wall), side)
            missing = np.isnan(values)
            assert missing.any()
            assert np.isnan(slopes[missing]).all()
    # Where rounding decides on which side of 0 a margin is, its slopes are those beside it.
    edge = zwidth.boundary(0.5, 0.3, 1.0)
    for side in np.eye(4)[:3]:
        (_, slopes), (_, beside) = (
            along(np.array([edge.alpha * by, edge.beta, 0.3, 1.0]), side) for by in (1.0, 1.0 - 1e-7)
        )
        np.testing.assert_allclose(slopes[:2], beside[:2], rtol=1e-5)
    # Next to a corner, in 50 digits: a zero of the phase beside z = -1, and the line of z = -1 without one before it.
    for wall, expected in (
        ((232.74593597019737, -57.112690872135914, 57.18779732288607, 0.0), (-6.0587189e-6, 0.017484553, 0.017533416)),
        ((16533.94525926982, -4132.485346166673, 4132.486315063933, 0.0), (-1.2093398e-4, -2.4186796e-4, 2.418679e-4)),
    ):
        slopes = [tuple(along(np.array(wall), side))[1][0] for side in np.eye(4)[:3]]
        np.testing.assert_allclose(slopes, expected, rtol=1e-5, atol=1e-8)


def test_second_derivatives_of_the_modulus_margin_and_of_its_frequency(x64):
    wall = np.array([0.1, 0.4, 0.1, 1.3])

    def nearest(wall):
        alpha, beta, delta, d = wall
        return jax.numpy.stack(find_modulus_margin(alpha, beta, discretize_plant(delta, d)))

    differentiate = compile_bends(jax.jacfwd(nearest))
    for side, bend in zip(np.eye(4), np.moveaxis(differentiate([wall, wall])[1][0], -1, 0), strict=True):
        up, down = differentiate([wall + sign * 1e-5 * side for sign in (1, -1)])[0]
        np.testing.assert_allclose(bend, (up - down) / 2e-5, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("delta", [1e-300, 1e-200, 1e-153])
def test_a_damping_whose_square_float64_does_not_have_is_none(delta):
    """Where no gain is stable without it the gain margin is 0, at no frequency."""
    walls = [1e-8, 0.686, 0.1], [-0.18, 0.0, 0.4], delta, [0.3, 0.0, 1.0]
    found, without = zwidth.margins(*walls), zwidth.margins(*walls[:2], 0.0, walls[3])
    np.testing.assert_array_equal(found, without)
    assert found.gain_margin.tolist()[:2] == [0.0, 0.0]
    assert np.isnan(found.phase_crossover[:2]).all()


def test_the_phase_margin_of_an_unstable_wall_is_the_least_turn():
    """From -180 to 0 degrees, by the loop's response at the gain crossover, computed apart from the kernel."""
    random = np.random.default_rng(52)
    wall = [10.0 ** random.uniform(low, high, 400) for low, high in ((-3, 1.5), (-3, 1), (-3, 1))]
    wall.append(random.choice([0.0, 1.0, 2.0, 0.5, 3.3, 8.0], 400))
    found = zwidth.margins(*wall)
    unstable = np.flatnonzero(~zwidth.is_stable(*wall) & np.isfinite(found.phase_margin))
    assert unstable.size > 100
    for k in unstable:
        alpha, beta, delta, d = (values[k] for values in wall)
        z = np.exp(1j * found.gain_crossover[k])
        free, closed = (np.polyval(zwidth.char_poly(*kb, delta, d), z) for kb in ((0.0, 0.0), (alpha, beta)))
        turn = np.degrees(abs(np.angle(-(closed - free) / free)))
        assert found.phase_margin[k] == pytest.approx(-turn, abs=1e-9)
    # Formerly -346.9 degrees.
    assert -180 <= found.phase_margin[unstable].min() < found.phase_margin[unstable].max() <= 0
