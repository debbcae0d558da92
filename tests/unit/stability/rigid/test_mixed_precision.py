"""`is_stable` with the precision "mixed": labels equal to those of float64, and error bounds of the float32 step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exact_differences import draw_walls, exact_differences, pick

import zwidth
from zwidth.core.errors import InputError
from zwidth.plant.rigid_mass import classify_delays
from zwidth.stability.rigid import certified, mixed_precision
from zwidth.stability.rigid.characteristic_polynomial import expand_gain_difference
from zwidth.stability.rigid.crossover import decide_long_delay, decide_short_delay, stable_kernel
from zwidth.stability.rigid.mixed_precision import (
    MIN_OPEN,
    Bounded,
    bound_device,
    bound_phase,
    bound_root,
    label_in_float32,
    round_to_float32,
)

flint = pytest.importorskip("flint")
BITS = 400
DELAYS = [0.0, 0.5, 1.0, 2.0, 3.25]
WALL = (0.1, 0.4, 0.1, 1)


def draw_near_boundary(count, seed, d):
    """Return walls of many devices at relative distances in alpha of 1e-9 to 1 from the stability boundary."""
    _, beta, delta, d = draw_walls(count, seed, d)
    offset = 10.0 ** np.random.default_rng(seed).uniform(-9, 0, count) * np.where(np.arange(count) % 2, 1, -1)
    limit = zwidth.boundary_point(delta, d, beta=beta).alpha
    return np.where(np.isnan(limit), 0.1, limit * (1 + offset)), beta, delta, d


def label_mixed(*wall):
    return zwidth.is_stable(*wall, precision="mixed")


@pytest.mark.parametrize(
    "d", [*DELAYS, 8.0, 500.0, [0.0, 0.999999999, 1.0 - 2.0**-53, 1.0, 7.000000001, 60.7, 99999.5]]
)
def test_labels_equal_those_of_float64(d):
    for walls in (draw_walls(60_000, 1, d), draw_near_boundary(60_000, 2, d)):
        expected = zwidth.is_stable(*walls)
        assert 0.05 < expected.mean() < 0.95
        np.testing.assert_array_equal(label_mixed(*walls), expected)


@pytest.mark.parametrize("d", DELAYS)
def test_labels_of_grids_equal_those_of_float64(d):
    alpha, beta = np.linspace(0, 1.2, 300), np.linspace(-0.2, 1.5, 300)[:, None]
    expected = zwidth.is_stable(alpha, beta, 0.1, d)
    np.testing.assert_array_equal(label_mixed(alpha, beta, 0.1, d), expected)
    np.testing.assert_array_equal(label_mixed(jnp.asarray(alpha), beta, 0.1, d), expected)
    # A small grid is not compared with the limits of its lines.
    np.testing.assert_array_equal(label_mixed(alpha[::10], beta[::10], 0.1, d), expected[::10, ::10])


@pytest.mark.parametrize("d", [0.0, 0.5, 1.0, 3.25])
def test_few_random_walls_are_open(d):
    walls = draw_walls(60_000, 3, d)
    with jax.enable_x64(True):
        stable, is_open = jax.jit(lambda *wall: label_in_float32(*wall, kind=classify_delays(d)))(*walls)
    assert np.mean(is_open) < 1e-3
    expected = zwidth.is_stable(*walls)
    np.testing.assert_array_equal(np.asarray(stable)[~np.asarray(is_open)], expected[~np.asarray(is_open)])


@pytest.mark.parametrize("n_open", [0, 1, MIN_OPEN, MIN_OPEN + 1, 2000])
def test_any_number_of_open_walls_is_decided(n_open, monkeypatch):
    alpha, beta, delta, d = draw_walls(2000, 4, 2.0)
    is_open = np.random.default_rng(4).permutation(2000) < n_open
    expected = zwidth.is_stable(alpha, beta, delta, d)
    # The labels of the float32 step are wrong where the walls are open.
    monkeypatch.setattr(
        mixed_precision, "label_in_float32", lambda *_: (jnp.asarray(expected ^ is_open), jnp.asarray(is_open))
    )
    with jax.enable_x64(True):
        labels = mixed_precision.label_in_mixed_precision(
            jnp.asarray(alpha), jnp.asarray(beta), jnp.asarray(delta), jnp.asarray(d)
        )
    np.testing.assert_array_equal(labels, expected)


EXTREME = [0.0, -0.0, 5e-324, 1e-300, 1e-61, 1e-60, 1e-50, 1e-40, 1e-20, 1e-9, 0.1, 0.7, 1.0, 50.0, 1e9, 1e30, 1e60]
INVALID = [np.nan, np.inf, -np.inf, 1e61, -1e-300, -1.0]


def test_extreme_and_invalid_values_have_the_labels_of_float64():
    rng = np.random.default_rng(5)
    pool = np.array(EXTREME + INVALID)
    alpha, beta, delta = rng.choice(pool, (3, 20_000))
    beta = np.where(rng.random(20_000) < 0.3, -beta, beta)
    d = rng.choice([0.0, 0.3, 1e-300, 1.0 - 2.0**-53, 1.0, 2.5, 1e5, 1e5 + 0.5, -1e-300, np.nan], 20_000)
    # Both columns are compiled, because NumPy keeps numbers below 1e-308, which XLA replaces by zero.
    with jax.enable_x64(True):
        expected = jax.jit(lambda *wall: stable_kernel(*wall))(alpha, beta, delta, d)
    assert np.any(expected)
    np.testing.assert_array_equal(label_mixed(alpha, beta, delta, d), expected)


@pytest.mark.parametrize(
    "wall",
    [(1, 1, 8, 1), WALL, ([0.1, 0.9], 0.4, 0.1, [0, 1]), (np.float32(0.1), np.float32(0.4), np.float32(0.1), 2)],
)
def test_types_and_shapes_are_those_of_the_default_precision(wall):
    mixed, expected = label_mixed(*wall), zwidth.is_stable(*wall)
    assert type(mixed) is type(expected)
    np.testing.assert_array_equal(mixed, expected)
    array = label_mixed(jnp.asarray(wall[0]), *wall[1:])
    assert isinstance(array, jax.Array)
    np.testing.assert_array_equal(array, expected)
    empty = label_mixed(np.empty((0, 3)), *WALL[1:])
    assert empty.shape == (0, 3)
    assert label_mixed(jnp.empty(0), *WALL[1:]).shape == (0,)


def test_labels_inside_transformations_equal_direct_labels(x64):
    walls = [jnp.asarray(column) for column in draw_near_boundary(500, 6, [0.0, 0.5, 1.0, 3.25])]
    expected = np.asarray(zwidth.is_stable(*walls))
    np.testing.assert_array_equal(jax.jit(label_mixed)(*walls), expected)
    np.testing.assert_array_equal(jax.jit(jax.vmap(label_mixed))(*walls), expected)
    np.testing.assert_array_equal(jax.vmap(lambda alpha: label_mixed(alpha, 0.4, 0.1, 1))(walls[0]).shape, (500,))
    slope = jax.grad(lambda alpha: jnp.where(label_mixed(alpha, 0.4, 0.1, 1), 2.0 * alpha, 0.0))(0.1)
    assert slope == 2.0


def test_mixed_precision_without_float64_in_a_transformation_raises():
    with pytest.raises(InputError, match=r"^precision: .* call jax.config.update.'jax_enable_x64', True. first"):
        jax.jit(lambda alpha: label_mixed(alpha, 0.4, 0.1, 1))(0.1)


def test_impossible_precisions_raise():
    with pytest.raises(InputError, match=r"^precision: got 'mixed' with method 'companion'; use method 'auto' or"):
        zwidth.is_stable(*WALL, method="companion", precision="mixed")
    with pytest.raises(InputError, match=r"^precision: got 'float16', allowed are 'auto', 'mixed'"):
        zwidth.is_stable(*WALL, precision="float16")  # pyright: ignore[reportArgumentType]


def assert_bounded(computed, exact, index):
    """Assert that the error of each number is within its bound, at one entry; a bound may be infinite or NaN."""
    for number, truth in zip(computed, exact, strict=True):
        if not np.isfinite(pick(np.asarray(number.error, float), index)):
            continue
        with flint.ctx.workprec(BITS):
            error = abs(truth - pick(np.asarray(number.value, float), index))
            assert float(error.upper()) <= pick(np.asarray(number.error, float), index)


def record_differences(monkeypatch, operation):
    """Return the differences whose signs ``operation`` tests, with their error bounds."""
    differences = []

    def record(self, other):
        differences.append(self - other)
        return differences[-1].value > differences[-1].error

    with monkeypatch.context() as patch:
        patch.setattr(Bounded, "__gt__", record)
        operation()
    return differences


PLANT = ("delta", "c", "em", "a2", "a1", "p1", "gap")


@pytest.mark.parametrize("d", [1.0, 2.0, 500.0, 1.5, 3.25, 60.7, float(np.nextafter(2.0, 1.0)), 99999.5])
def test_float32_error_bounds_at_the_crossover_hold(d, monkeypatch, x64):
    alpha, beta, delta, d = draw_walls(60, 11, d)
    stiffness, virtual_damping = round_to_float32(jnp.asarray(alpha)), round_to_float32(jnp.asarray(beta))
    plant = bound_device(jnp.asarray(delta), jnp.asarray(d), classify_delays(d))
    cubic = expand_gain_difference(stiffness, virtual_damping, plant)
    u, exists = bound_root(cubic)
    phase = bound_phase(u, plant.whole)
    differences = record_differences(
        monkeypatch,
        lambda: decide_long_delay(stiffness, virtual_damping, plant.whole, plant, bound_root, bound_phase),
    )
    # `bound_root` tests two signs, which are not part of the verdict.
    differences = differences[2:]
    compared = 0
    for index in range(alpha.size):
        exact = certified.device(delta[index], d[index], BITS)
        names = PLANT if exact.a0 is None else (*PLANT, "a0")
        with flint.ctx.workprec(BITS):
            x, y = flint.arb(alpha[index]), flint.arb(beta[index])
            true_cubic = expand_gain_difference(x, y, exact)
            assert_bounded([getattr(plant, name) for name in names], [getattr(exact, name) for name in names], index)
            assert_bounded(cubic, true_cubic, index)
            if not exists[index]:
                continue
            root, converged = certified._enclose_root_in_balls(true_cubic)
            assert converged
            assert_bounded([u], [root], index)
            lag = certified._evaluate_phase_in_balls(root, int(d[index]))
            assert not phase.within[index] or lag.within
            assert not phase.beyond[index] or lag.beyond
            if not lag.within:
                continue
            compared += 1
            assert_bounded(phase[:3], lag[:3], index)

            def judge(a, b, terms, root=root, whole=int(d[index]), lag=lag):
                known = lag._replace(**{k: a.new(v) for k, v in lag._asdict().items() if isinstance(v, flint.arb)})
                return decide_long_delay(a, b, whole, terms, lambda _: (a.new(root), True), lambda *_: known)

            assert_bounded(differences, exact_differences(judge, (x, y), exact), index)
    assert compared > 8


@pytest.mark.parametrize("d", [0.0, 0.3, 1e-9, 0.93, 1.0 - 2.0**-53])
def test_float32_error_bounds_with_short_delay_hold(d, monkeypatch, x64):
    alpha, beta, delta, _ = draw_walls(60, 13, d)
    stiffness, virtual_damping = round_to_float32(jnp.asarray(alpha)), round_to_float32(jnp.asarray(beta))
    plant = bound_device(jnp.asarray(delta), jnp.full(60, d), classify_delays(d))
    differences = record_differences(monkeypatch, lambda: decide_short_delay(stiffness, virtual_damping, plant))
    compared = 0
    for index in range(60):
        with flint.ctx.workprec(BITS):
            exact = certified.device(delta[index], d, BITS)
            true = exact_differences(decide_short_delay, (flint.arb(alpha[index]), flint.arb(beta[index])), exact)
            # Skip differences without a finite value, because the root does not exist beyond the end of the lobe.
            kept = [k for k, value in enumerate(true) if value.is_finite()]
            compared += len(kept) == len(true)
            assert_bounded([differences[k] for k in kept], [true[k] for k in kept], index)
    assert compared > 20
