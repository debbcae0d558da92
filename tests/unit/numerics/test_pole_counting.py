"""Test `count_poles`, the number of poles inside a circle.

References: enclosures of every pole by arb balls, and closed forms.
"""

from collections import Counter

import jax
import mpmath as mp
import numpy as np
import pytest
from compiling import QUICKLY
from flint import acb, acb_poly, arb, ctx

from zwidth.core.errors import InputError
from zwidth.numerics import pole_counting as counting
from zwidth.numerics.pole_counting import count_poles

BITS = 200


def exact_poly(zeros, poles, gain, lag):
    """Return z^lag prod(z - poles) + gain prod(z - zeros) with exact coefficients."""

    def product(start, roots):
        for root in roots:
            start = start * acb_poly([acb(-root.real, -root.imag), 1])
        return start

    delay = acb_poly([0] * lag + [1])
    return product(delay, np.asarray(poles, complex)) + product(
        acb_poly([acb(float(gain))]), np.asarray(zeros, complex)
    )


def reference(zeros, poles, gain, lag, radius):
    """Return the count and the relative distance of the nearest pole from the circle, by balls around every pole.

    The count is None if a ball meets the circle or if, as for multiple poles, no balls are found.
    """
    with ctx.workprec(BITS):
        poly = exact_poly(zeros, poles, gain, lag)
        if poly.degree() < 1:
            return 0, np.inf
        try:
            enclosures = poly.roots(tol=arb(2) ** -120, maxprec=4000)
        except ValueError:
            return None, 0.0
        circle = arb(float(radius))
        inside = sum(bool(abs(pole) < circle) for pole in enclosures)
        outside = sum(bool(abs(pole) > circle) for pole in enclosures)
        nearest = min(float(abs(abs(pole) / circle - 1).mid()) for pole in enclosures)
        return inside if inside + outside == len(enclosures) else None, nearest


def compare(loops):
    """Compare counts with the reference; return the number of comparisons and the pole distances of undecided loops."""
    distances, compared = [], 0
    for loop in loops:
        count, (expected, nearest) = count_poles(*loop), reference(*loop)
        if count < 0:
            distances.append(nearest)
        elif expected is not None:
            compared += 1
            assert count == expected, loop
    return compared, np.array(distances)


def random_roots(rng, size, conjugate=True):
    """Return real roots, including 1, -1 and 0, and pairs, some of them near the unit circle."""
    roots = []
    while len(roots) < size:
        if size - len(roots) > 1 and rng.random() < 0.4:
            root = complex(*rng.normal(size=2))
            if rng.random() < 0.2:
                root *= (1 - rng.choice([1e-8, 1e-4, -1e-4])) / abs(root)
            roots += [root, root.conjugate() if conjugate else complex(*rng.normal(size=2))]
        else:
            roots.append(rng.choice([rng.normal(), 1.0, -1.0, 0.0, rng.uniform(0.9, 1)], p=[0.5, 0.15, 0.05, 0.1, 0.2]))
    return np.array(roots)


def random_loop(rng, conjugate=True):
    zeros, poles = (random_roots(rng, rng.integers(0, 7), conjugate) for _ in range(2))
    radius = rng.choice([1.0, rng.uniform(0.3, 3)])
    return zeros, poles, rng.normal() * 10 ** rng.uniform(-5, 2), int(rng.integers(0, 9)), radius


def haptic_loop(rng, lag):
    """Return the loop of a wall with low-pass filtered velocity (model.md, section 7), sometimes with two filters."""
    delta, a = 10 ** rng.uniform(-6, 1), rng.uniform(0, 0.97)
    c, phi1 = np.exp(-delta), -np.expm1(-delta) / delta
    phi2 = (1 - phi1) / delta if delta > 1e-3 else 0.5 - delta / 6
    alpha = 10 ** rng.uniform(-7, 0.5) / (1 + lag) ** rng.choice([0, 1, 2])
    b1 = rng.choice([10 ** rng.uniform(-4, 0), delta * rng.uniform(-1, 2) / (1 + lag)]) * (1 - a)
    zeros, poles = [-(phi1 - phi2) / phi2, (alpha * a + b1) / (alpha + b1)], [1.0, c, a]
    if rng.random() < 0.3:
        zeros, poles = [*zeros, -1.0], [*poles, rng.uniform(0, 0.97)]
    return zeros, poles, phi2 * (alpha + b1), lag + 1


@pytest.mark.parametrize("conjugate", [True, False])
def test_random_loops_match_reference(conjugate):
    rng = np.random.default_rng(81)
    compared, distances = compare(random_loop(rng, conjugate) for _ in range(600))
    # Only loops with poles exactly on the circle (both products vanish at 1 or -1) or nearly on it are undecided.
    assert compared > 540
    assert len(distances) < 36
    assert (distances < 1e-7).all()


def test_circle_near_a_pole():
    # The relative distance of the circle from a pole is 1e-5 to 1e-16.
    rng = np.random.default_rng(82)
    undecided = Counter()
    for _ in range(600):
        zeros, poles, gain, lag, _ = random_loop(rng, rng.random() < 0.5)
        with ctx.workprec(BITS):
            try:
                enclosures = exact_poly(zeros, poles, gain, lag).roots(tol=arb(2) ** -120, maxprec=4000)
            except ValueError:
                continue
        sizes = [float(abs(pole).mid()) for pole in enclosures]
        sizes = [size for size in sizes if size > 1e-2]
        if not sizes:
            continue
        step = int(rng.integers(5, 17))
        loop = zeros, poles, gain, lag, rng.choice(sizes) * (1 + rng.choice([-1, 1]) * 10.0**-step)
        count, (expected, _) = count_poles(*loop), reference(*loop)
        undecided[step] += int(count < 0)
        undecided["all", step] += 1
        assert count < 0 or expected is None or count == expected, loop
    for step in range(5, 9):
        assert undecided[step] == 0
    assert sum(undecided[step] for step in (9, 10, 11)) < 0.05 * sum(undecided["all", step] for step in (9, 10, 11))


def test_nearly_touching_crossovers():
    # With this gain |T| = |B| at an extremum on the circle, up to 1e-15 or 1e-9: two crossovers or none.
    rng = np.random.default_rng(83)
    circle = np.exp(2j * np.pi * np.linspace(0, 1, 20001))

    def loops():
        for _ in range(400):
            zeros, poles, _, lag, radius = random_loop(rng, rng.random() < 0.5)
            z = radius * circle
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.abs(np.prod(z[:, None] - poles, 1) * z**lag) / np.abs(np.prod(z[:, None] - zeros, 1))
            gain = ratio[np.nanargmin(ratio) if rng.random() < 0.5 else np.nanargmax(ratio)]
            if 1e-8 < gain < 1e8:
                yield zeros, poles, gain * rng.choice([-1, 1]) * (1 + rng.choice([0, 1e-9, -1e-9])), lag, radius

    compared, distances = compare(loops())
    assert compared > 150
    # An extremum at w = 0 or pi with T = -B is a pole on the circle; most undecided loops are of this kind.
    assert (distances < 1e-6).all()


def test_filtered_walls_match_reference():
    rng = np.random.default_rng(84)

    def loops():
        for lag in [0, 1, 2, 5, 20, 60] * 60:
            yield *haptic_loop(rng, lag), rng.choice([1.0, rng.uniform(0.8, 1.2)])
        for lag in [200, 500] * 2:
            yield *haptic_loop(rng, lag), rng.choice([1.0, 1 - 10 ** rng.uniform(-5, -1.5)])

    compared, distances = compare(loops())
    assert compared + len(distances) == 364
    assert len(distances) <= 3


def rigid_loop(alpha, beta, delta, n):
    """Return the rigid loop with integer delay n, and its verdict by Theorem 2 of model.md, with 200 digits."""
    with mp.workdps(200):
        alpha, beta, delta = mp.mpf(float(alpha)), mp.mpf(float(beta)), mp.mpf(float(delta))
        c = mp.exp(-delta)
        phi1 = (1 - c) / delta
        phi2 = (1 - phi1) / delta
        psi, em = phi1 - phi2, 1 - c
        wall = 2 * beta * (alpha + beta)
        leading = 2 * phi2 * psi * wall + 4 * c
        linear = wall * phi1**2 - 2 * phi2 * psi * alpha**2 - 2 * em**2
        u = (linear + mp.sqrt(linear**2 + 4 * leading * (alpha * phi1) ** 2)) / (2 * leading)
        stable = False
        if u < 2:
            s, w = mp.sqrt(u * (2 - u)), 2 * mp.asin(mp.sqrt(u / 2))
            factors = (alpha + beta * u, beta * s), (phi1 - phi2 * u, phi2 * s), (s, em - u)
            stable = sum(mp.arg(mp.mpc(*factor)) for factor in factors) > (n + mp.mpf(1) / 2) * w
        zeros = [float(-psi / phi2), float(beta / (alpha + beta))]
        return (zeros, [1.0, float(c)], float(phi2 * (alpha + beta)), n + 1), stable


def test_rigid_walls_at_any_stiffness_and_delay_match_theorem_2():
    rng = np.random.default_rng(86)
    seen = Counter()
    for power in (-100, -60, -30, -12, -6, -3, -1, 0, 30):
        for _ in range(40):
            alpha, delta = 10 ** rng.uniform(power, power + 2), 10 ** rng.uniform(-5, 2)
            n = int(rng.choice([0, 1, 5, 100, 10**5, 10**7]))
            loop, stable = rigid_loop(alpha, alpha * 10 ** rng.uniform(-2, 3), delta, n)
            count = count_poles(*loop)
            seen[stable, bool(count < 0)] += 1
            assert count < 0 or (count == n + 3) == stable
    assert seen[True, False] > 150
    assert seen[False, False] > 50
    assert seen[True, True] + seen[False, True] == 0


@pytest.mark.parametrize("lag", [1, 10, 10**5, 10**12])
def test_delay_without_poles_and_zeros(lag):
    # All zeros of z^n + g have the magnitude |g|^(1/n).
    for gain, size in [(0.5, -np.log(2)), (-3.0, np.log(3)), (1e-300, -300 * np.log(10))]:
        root = np.exp(size / lag)
        assert count_poles([], [], gain, lag, [root * (1 - 1e-3 / lag), root * (1 + 1e-3 / lag)]).tolist() == [0, lag]


def test_more_zeros_than_poles():
    # gain (z - 1)(z - 2)(z - 0.5) + 1: at gain 1e6 the roots are near the three zeros, at 1e-6 none is within |z| < 10.
    for radius, expected in [(0.9, 1), (1.5, 2), (2.5, 3)]:
        assert count_poles([1.0, 2.0, 0.5], [], 1e6, 0, radius) == expected
        assert count_poles([1.0, 2.0, 0.5], [], 1e-6, 0, radius) == 0


def test_zero_gain_counts_the_poles_of_the_device():
    assert count_poles([0.3, 2.0], [0.2, 0.9, 1.2, -1j], 0, 7, 0.95) == 9
    for pole in (1.0, -1.0, 1j, 0.6 + 0.8j, *np.exp(1j * np.arange(1, 40))):
        assert count_poles([0.3], [0.2, pole], 0, 3) == -1
        # A gain of 1e-40 moves the real poles detectably; for complex ones the rounding error of about 1e-16 prevails.
        assert (count_poles([0.3], [0.2, pole], 1e-40, 3) == -1) == (np.imag(pole) != 0)


def test_zero_of_one_part_on_the_circle():
    # A root of one part may lie on the circle, on the real axis or elsewhere, where the other part is larger: the count
    # does not change there.
    for root in (1.0, -1.0, 1j, 0.6 + 0.8j, np.exp(2j)):
        expected = [reference([root, np.conj(root)], [0.3, -0.2], 0.05, 2, radius)[0] for radius in (0.999, 1.0, 1.001)]
        assert (
            count_poles([root, np.conj(root)], [0.3, -0.2], 0.05, 2, [0.999, 1.0, 1.001]).tolist()
            == expected
            == [4] * 3
        )
        expected = [reference([0.3, -0.2], [root, np.conj(root)], 9.0, 2, radius)[0] for radius in (0.999, 1.0, 1.001)]
        assert count_poles([0.3, -0.2], [root, np.conj(root)], 9.0, 2, [0.999, 1.0, 1.001]).tolist() == expected


def test_parts_of_nearly_equal_size_on_the_circle():
    # Small roots make T and B nearly equal at z = 1, -1, j and -j; the plane is rotated before counting.
    rng = np.random.default_rng(91)

    def loops():
        for _ in range(300):
            roots = 0.04 * rng.normal(size=(2, 3)) + 0.04j * rng.normal(size=(2, 3))
            yield *roots, rng.choice([-1, 1]) * rng.uniform(0.95, 1.05), int(rng.integers(1, 9)), 1.0

    assert compare(loops())[0] == 300


def test_multiple_roots_and_clusters():
    # Roots that coincide on the path of the polynomial to the crossovers, most of them far from the crossovers.
    loops = [
        ([0.3] * 6, [0.2] * 6, 1e-3, 2, 1.0),
        ([0.3] * 6, [0.2] * 6, 1.0, 2, 1.0),
        ([0.3] * 6, [0.2] * 6, 1e3, 2, 1.0),
        ([1.0, 0.3, 1.5, 1.5, 0.4 + 0.9j, 0.4 - 0.9j], [], 1e-9, 4, 1.0),
        ([1.0, 1.6 + 0.9j, 1.6 - 0.9j, 1.0, 0.4 + 1.6j, 0.4 - 1.6j], [], 1e-9, 5, 2.5),
        ([0.0] * 6, [1.0, 1.0], 0.1, 0, 1.0),
        ([0.9] * 3, [1.0] * 4, 1e-2, 1, 1.0),
        ([0.9] * 3, [1.0] * 4, -1e-5, 3, 0.99),
    ]
    assert [count_poles(*loop) for loop in loops] == [reference(*loop)[0] for loop in loops]


def test_poles_on_the_circle_are_undecided():
    # In order: P(1) = 0; P(-1) = 0; |z| = 1 for all; a common factor; |T| = |B| everywhere.
    loops = [
        ([0.5], [0.5, 0.9], -0.1, 4),
        ([0.0], [0.5], 1.5, 1),
        ([], [], 1.0, 9),
        ([1.0, 0.3], [1.0], 0.2, 3),
        ([0.3], [0.3], 1.0, 0),
    ]
    for loop in loops:
        assert count_poles(*loop) == -1


def test_arrays_broadcast_and_invalid_entries_are_separate():
    rng = np.random.default_rng(87)
    zeros, poles = rng.normal(size=(4, 1, 2)), rng.uniform(-1, 1, size=(3, 3))
    gain, lag, radius = rng.normal(size=(4, 3)), np.array([1, 50, 10**5]), np.array([[1.0], [0.9], [1.1], [1.0]])
    counts = count_poles(zeros, poles, gain, lag, radius)
    assert counts.shape == (4, 3)
    assert counts.dtype == np.int64
    for i, j in np.ndindex(4, 3):
        assert counts[i, j] == count_poles(zeros[i, 0], poles[j], gain[i, j], lag[j], radius[i, 0])
    valid = count_poles([0.5], [0.9], 0.01, 3)
    assert count_poles([0.5], [0.9], [0.01, np.nan, np.inf, 0.01], 3).tolist() == [valid, -1, -1, valid]
    assert count_poles([0.5], [0.9], 0.01, [3, -1, 2.5, np.nan, 2.0**60]).tolist() == [valid, -1, -1, -1, -1]
    assert count_poles([0.5], [0.9], 0.01, 3, [1, 0, -1, np.inf, np.nan]).tolist() == [valid, -1, -1, -1, -1]
    assert count_poles([[0.5], [np.nan], [complex(0, np.inf)]], [0.9], 0.01, 3).tolist() == [valid, -1, -1]
    assert count_poles(np.zeros((0, 2)), [0.9], 0.01, 3).shape == (0,)


def test_block_size_does_not_affect_counts():
    rng = np.random.default_rng(88)
    size = 2 * counting.BLOCK_SIZE + 3
    zeros, gain = rng.normal(size=(size, 2)), rng.normal(size=size)
    counts = count_poles(zeros, [1.0, 0.9], gain, 4)
    sample = rng.integers(0, size, 40)
    assert counts[sample].tolist() == [count_poles(zeros[i], [1.0, 0.9], gain[i], 4) for i in sample]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (([0.5], [0.9], 1j, 3), "gain: got 1j, .* real"),
        (([0.5], [0.9], np.nan, 3), "gain: got nan, a finite number"),
        (([0.5], [0.9], 0.1, 2.5), "lag: got 2.5, a whole number from 0"),
        (([0.5], [0.9], 0.1, -1), "lag: got -1"),
        (([0.5], [0.9], 0.1, 3, 0.0), "radius: got 0.0, a finite number above 0"),
        ((0.5, [0.9], 0.1, 3), "zeros: got 0.5, a sequence .* write"),
        (([0.5], ["a"], 0.1, 3), "poles: got .* numbers is needed"),
        (([0.5], [[0.9], [0.8, 0.7]], 0.1, 3), "poles: got"),
        (([[0.5]] * 2, [0.9], [0.1] * 3, 3), r"do not broadcast: zeros \(2,\)"),
    ],
)
def test_invalid_arguments_are_rejected(arguments, message):
    with pytest.raises(InputError, match=message):
        count_poles(*arguments)


def test_traced_counts_equal_direct_counts(x64):
    rng = np.random.default_rng(89)
    size = 300
    zeros, poles = rng.normal(size=(size, 2)), rng.normal(size=(size, 3)) * np.array([1, 1j, 1])
    poles[:50, 0] = 1.0
    zeros[40:50, 0] = 1.0
    gain, lag, radius = rng.normal(size=size), rng.integers(0, 40, size), rng.choice([1.0, 0.9, 1.2], size)
    gain[60:65], gain[65] = 0.0, np.nan
    direct = count_poles(zeros, poles, gain, lag, radius)
    assert (direct[40:50] == -1)[radius[40:50] == 1].all()
    assert direct[65] == -1
    for traced in (jax.vmap(count_poles), count_poles):
        counts = jax.jit(traced, compiler_options=QUICKLY)(zeros, poles, gain, lag, radius)
        np.testing.assert_array_equal(counts, direct)


def test_traced_values_in_lists_and_constant_arguments(x64):
    def mixed(gain):
        return count_poles([gain], [1.0], 0.1 * gain, 3), count_poles([0.2], [1.0, 0.9], 0.01, 3)

    gain = np.linspace(-2, 2, 20)
    traced, constant = jax.jit(jax.vmap(mixed), compiler_options=QUICKLY)(gain)
    assert traced.tolist() == [count_poles([g], [1.0], 0.1 * g, 3) for g in gain]
    assert (constant == count_poles([0.2], [1.0, 0.9], 0.01, 3)).all()


def test_traced_float32_counts_are_correct_if_decided():
    # In JAX's default precision, values that float32 represents may be undecided more often, but no count may be wrong.
    rng = np.random.default_rng(90)
    zeros, poles, gain = (rng.normal(size=shape).astype(np.float32) for shape in ((1000, 2), (1000, 3), (1000,)))
    direct = count_poles(zeros, poles, gain, 4)
    single = jax.jit(count_poles, compiler_options=QUICKLY)(zeros, poles, gain, 4)
    assert single.dtype == np.int32
    is_decided = np.asarray(single) >= 0
    np.testing.assert_array_equal(np.asarray(single)[is_decided], direct[is_decided])
    assert is_decided.mean() > 0.99
