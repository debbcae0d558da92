"""Errors of float32 inside `jit`, against bounds that follow from the rounding errors and from float64 results.

Two bounds are used. A label may only be wrong for a wall that the running error bound of
`stability.rigid.mixed_precision` leaves open. Any other value may differ by `COUNT` rounding errors of its terms, plus
the change of the value if each argument changes by `COUNT` rounding errors.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import QUICKLY
from tolerances import EPS32

import zwidth
from zwidth.plant.rigid_mass import ANY
from zwidth.stability.rigid.mixed_precision import label_in_float32
from zwidth.stability.rigid.stiffness_limit import row_limits

# Step C6 of docs/theory/certified.md: the compared numbers have fewer than 200 rounding errors of at most EPS32/2.
COUNT = 100
DELAYS = (0.0, 0.5, 1.0, 2.0, 3.25, 8.0, 50.0)
DELTAS = (0.0, 1e-4, 1e-2, 0.1, 1.0, 10.0, 100.0)


def draw_near_boundary(seed, each, nearest=-7.0):
    """Return walls that are float32 numbers, near the stability boundary of each device, in float64 columns."""
    rng = np.random.default_rng(seed)
    d, delta = np.repeat([(d, delta) for d in DELAYS for delta in DELTAS], each, axis=0).T
    delta = np.float32(delta).astype(float)
    beta = np.float32(np.asarray(zwidth.alpha_max(delta, d).beta) * rng.uniform(0.05, 0.95, d.size)).astype(float)
    offset = 10.0 ** rng.uniform(nearest, -0.5, d.size) * rng.choice([-1.0, 1.0], d.size)
    alpha = np.float32(row_limits(beta, delta, d) * (1.0 + offset)).astype(float)
    return alpha, beta, delta, d


def compute_in_float32(function, walls):
    with jax.enable_x64(False):
        columns = [jnp.asarray(column, jnp.float32) for column in walls]
        return jax.tree.map(np.asarray, jax.jit(function, compiler_options=QUICKLY)(*columns))


def evaluate_quantities(alpha, beta, delta, d):
    """Return the quantities with continuous values by name."""
    margins = zwidth.margins(alpha, beta, delta, d)
    return {
        "spectral_radius": zwidth.spectral_radius(alpha, beta, delta, d),
        "alpha_max": zwidth.alpha_max(delta, d).alpha,
        "boundary_point": zwidth.boundary_point(delta, d, beta=beta).alpha,
        "gain_margin": margins.gain_margin,
        "phase_margin": margins.phase_margin,
        "delay_margin": margins.delay_margin,
        "modulus_margin": margins.modulus_margin,
        "passivity_margin": zwidth.passivity_margin(alpha, beta, delta, d),
    }


# Sizes of the terms from which a quantity is computed, in addition to its own size: 180 degrees and the phase of L;
# 1 and L; the terms of the passivity bound.
SIZES = {
    "phase_margin": lambda *_: 180.0,
    "modulus_margin": lambda *_: 1.0,
    "passivity_margin": lambda alpha, beta, delta, d: alpha * (d + 1) + np.abs(beta) + delta,
}


def find_changes(walls):
    """Return the sum of the changes of each quantity if alpha, beta or delta changes by `COUNT` rounding errors."""
    center = evaluate_quantities(*walls)
    total = dict.fromkeys(center, 0.0)
    for argument in range(3):
        moved = []
        for side in (-1.0, 1.0):
            changed = list(walls)
            changed[argument] = changed[argument] * (1.0 + side * COUNT * EPS32)
            moved.append(evaluate_quantities(*changed))
        for name, value in center.items():
            total[name] = total[name] + np.maximum(*(np.abs(result[name] - value) for result in moved))
    return center, total


def test_wrong_float32_labels_belong_to_open_walls():
    walls = draw_near_boundary(1, 300)
    expected, labels = zwidth.is_stable(*walls), compute_in_float32(zwidth.is_stable, walls)
    with jax.enable_x64(True):
        stable, is_open = jax.jit(lambda *wall: label_in_float32(*wall, kind=ANY))(*walls)
    stable, is_open, wrong = np.asarray(stable), np.asarray(is_open), labels != expected
    assert 0 < wrong.sum() < 0.1 * wrong.size
    assert not np.any(wrong & ~is_open)
    np.testing.assert_array_equal(stable[~is_open], expected[~is_open])
    np.testing.assert_array_equal(zwidth.is_stable(*walls, precision="mixed"), expected)


def test_wrong_float32_labels_are_within_the_error_of_the_boundary():
    walls = draw_near_boundary(2, 300)
    alpha, *line = walls
    wrong = compute_in_float32(zwidth.is_stable, walls) != zwidth.is_stable(*walls)
    limit = row_limits(*line)
    allowed = COUNT * EPS32 * limit
    for argument in range(2):
        for side in (-1.0, 1.0):
            changed = list(line)
            changed[argument] = changed[argument] * (1.0 + side * COUNT * EPS32)
            allowed = allowed + np.abs(row_limits(*changed) - limit)
    assert np.any(wrong)
    assert np.all(np.abs(alpha - limit)[wrong] <= allowed[wrong])


@pytest.fixture(scope="module")
def quantities():
    # Walls with a distance above the error, because the delay margin of a wall may jump at the boundary.
    walls = draw_near_boundary(3, 20, nearest=-3.0)
    center, changes = find_changes(walls)
    return walls, center, changes, compute_in_float32(evaluate_quantities, walls)


@pytest.mark.parametrize(
    "name", ["spectral_radius", "alpha_max", "boundary_point", "gain_margin", *SIZES, "delay_margin"]
)
def test_float32_errors_are_bounded_by_rounding_errors_and_condition(name, quantities):
    walls, center, changes, rounded = quantities
    value, exact, change = rounded[name].astype(float), center[name], changes[name]
    size = np.abs(exact) + SIZES.get(name, lambda *_: 0.0)(*walls)
    # The spectral radius has no float32 value if its pole count is uncertain.
    missing = np.isnan(value) & ~np.isnan(exact)
    assert missing.mean() < (0.1 if name == "spectral_radius" else 1e-9)
    finite = np.isfinite(exact) & np.isfinite(change) & ~missing
    assert finite.mean() > 0.8
    error, allowed = np.abs(value - exact)[finite], (COUNT * EPS32 * size + change)[finite]
    assert np.all(error <= allowed)
    # The bound is small for most walls.
    assert np.median(allowed) < 1e-4 * np.max(size[finite])
