"""Dominant poles of grids by series expansion, against dominant poles computed point by point."""

import numpy as np
import pytest
from bounds import bound_radius

import zwidth
from zwidth.core.status import Status
from zwidth.stability.rigid.broadcasting import Points, fold
from zwidth.stability.rigid.dominant.arrays import (
    FEW_FOR_CELLS,
    SMALLEST_MAP,
    area_poles,
    arrange_as_area,
    compute_dominant_poles,
)
from zwidth.stability.rigid.dominant.grid import Area, compute_grid_poles

ALPHA, BETA = np.linspace(-0.1, 1.5, 223), np.linspace(-0.3, 1.5, 157)


def arrange(*values):
    return arrange_as_area(Points(*map(fold, np.broadcast_arrays(*map(np.asarray, values)))))


def check_against_points(grid, walls, seed, count=1500):
    """Compare random grid points with the pointwise search: the two independent results differ by at most their error
    bounds.
    """
    rng = np.random.default_rng(seed)
    points = tuple(rng.integers(0, length, count) for length in grid.radius.shape)
    single = bound_radius(*(np.broadcast_to(wall, grid.radius.shape)[points] for wall in walls))
    difference = np.abs(grid.radius[points] - single.radius)
    assert (difference <= grid.error[points] + single.error).all()
    # The terms of the series decrease much faster than their bound.
    both = grid.certified[points] & single.certified
    assert np.median(difference[both]) < 1e-15
    assert both.mean() > 0.99


@pytest.mark.parametrize("d", [np.array([0.0, 4.0, 60.0]), 1.5])
def test_grid_radii_agree_with_single_points(d):
    walls = (ALPHA, BETA[:, None], 0.1, np.reshape(d, (-1, 1, 1)))
    grid = bound_radius(*walls)
    assert grid.certified.mean() > 0.99
    np.testing.assert_array_equal(grid.certified, grid.status == Status.OK)
    check_against_points(grid, walls, 1)


def test_axes_in_any_order_with_integer_and_fractional_delays():
    delays = np.array([1.5, 0.0, 4.0])
    walls = (ALPHA[:, None, None], BETA, 0.1, delays[:, None])
    grid = bound_radius(*walls)
    assert grid.radius.shape == (ALPHA.size, delays.size, BETA.size)
    check_against_points(grid, walls, 2)
    for k, delay in enumerate(delays):
        plain = zwidth.spectral_radius(ALPHA, BETA[:, None], 0.1, delay)
        np.testing.assert_allclose(grid.radius[:, k], plain.T, rtol=1e-9)


@pytest.mark.parametrize("d", [0.0, 4.0, 60.0, 1.5])
@pytest.mark.parametrize("accuracy", [1e-2, 1e-4, 1e-6, 1e-9])
def test_grid_satisfies_every_requested_accuracy(d, accuracy):
    """Compare with the pointwise search; loose accuracies are not satisfied by chance, because nearly all points use
    series.
    """
    rng = np.random.default_rng(3)
    alpha, beta = np.linspace(0.001, 1.5 / (1.0 + d), 320), np.linspace(0.0, 1.5 / (1.0 + d), 320)
    area = Area.whole(alpha[None], beta[None], np.array([0.1]), np.array([d]))
    log_radius = compute_grid_poles(area, accuracy)[1][0]
    missing = np.isnan(log_radius)
    assert missing.mean() < 0.1
    row, column = rng.integers(0, 320, (2, 2000))
    row, column = row[~missing[row, column]], column[~missing[row, column]]
    exact = compute_dominant_poles([alpha[column], beta[row], np.full(row.size, 0.1), np.full(row.size, d)], 1e-9)
    assert (np.abs(log_radius[row, column] - exact.re) <= accuracy + exact.error).all()


def test_angles_of_open_walls_are_nan():
    alpha, beta = np.linspace(0.01, 60.0, 64), np.linspace(-5.0, 40.0, 64)
    area = Area.whole(alpha[None], beta[None], np.array([60.0]), np.array([2.0]))
    _, re, im = compute_grid_poles(area, 1e-10, True)
    assert np.isnan(re).any()
    np.testing.assert_array_equal(np.isnan(im), np.isnan(re))


def test_permuted_axis_gives_permuted_radii():
    rng = np.random.default_rng(4)
    alpha, beta = np.geomspace(1e-12, 1.0, 200), np.linspace(-0.05, 1.0, 200)
    mixed = rng.permutation(200)
    radius = zwidth.spectral_radius(alpha, beta[:, None], 0.1, 1.0)
    np.testing.assert_allclose(
        zwidth.spectral_radius(alpha[mixed], beta[:, None], 0.1, 1.0), radius[:, mixed], rtol=2e-9
    )
    rate = zwidth.decay_rate(alpha, beta[:, None], 0.1, 1.0)
    single = zwidth.decay_rate(np.tile(alpha, 2), np.repeat(beta[[9, 150]], 200), 0.1, 1.0).reshape(2, 200)
    np.testing.assert_allclose(rate[[9, 150]], single, rtol=1e-6)
    assert np.isfinite(single).mean() > 0.95


@pytest.mark.parametrize(("rows", "columns"), [(1, 40000), (40000, 1), (3, 12000), (3000, 12)])
@pytest.mark.parametrize("d", [1.0, 0.37, 60.0])
def test_elongated_grids_are_covered_by_cells(rows, columns, d):
    """Cells take the proportions of the grid; square cells would leave nearly all points to the pointwise search."""
    alpha, beta = np.linspace(1e-4, 1.2 / (1.0 + d), columns), np.linspace(0.3, 0.9, rows)
    walls = (alpha, beta[:, None], 0.1, d)
    area = Area.whole(alpha[None], beta[None], np.array([0.1]), np.array([d]))
    assert np.isfinite(compute_grid_poles(area, 1e-9)[0]).mean() > 0.99
    check_against_points(bound_radius(*walls), walls, 5)
    rate, radius = zwidth.decay_rate(*walls), zwidth.spectral_radius(*walls)
    np.testing.assert_allclose(np.exp(-rate), radius, rtol=2e-9)
    line = zwidth.spectral_radius(alpha, beta[0], 0.1, d) if rows == 1 else radius[0]
    np.testing.assert_array_equal(line, radius[0])


def test_arguments_without_grid_structure_are_not_arranged():
    assert arrange(ALPHA, ALPHA, 0.1, 0.0) is None
    assert arrange(ALPHA, BETA[:3, None], 0.1, 0.0) is None
    assert arrange(ALPHA, BETA[:, None], np.linspace(0.1, 0.2, ALPHA.size), 0.0) is None
    arranged = arrange(ALPHA, BETA[:, None], np.array([0.1, 0.2])[:, None, None], 1.0)
    assert arranged is not None
    assert arranged[2] == (2, BETA.size, ALPHA.size)
    # Batches of this size are checked for grid structure; smaller ones are computed pointwise.
    assert ALPHA.size * BETA.size > FEW_FOR_CELLS >= SMALLEST_MAP


def double_pole(z, delta, d):
    """Return the wall with a double pole at a real z, from the linear equations P = 0 and P' = 0 in alpha and beta."""
    coefficients = [np.asarray(zwidth.char_poly(*wall, delta, d)) for wall in ((0, 0), (1, 0), (0, 1))]
    device, stiff, damped = coefficients[0], coefficients[1] - coefficients[0], coefficients[2] - coefficients[0]
    value = [np.polyval(p, z) for p in (device, stiff, damped)]
    slope = [np.polyval(np.polyder(p), z) for p in (device, stiff, damped)]
    matrix = np.array([[value[1], value[2]], [slope[1], slope[2]]])
    return np.linalg.solve(matrix, -np.array([value[0], slope[0]]))


@pytest.mark.parametrize(("z", "d"), [(0.9, 0.0), (0.85, 1.0), (0.95, 4.0), (0.9, 1.5)])
@pytest.mark.parametrize("width", [0.05, 1e-4])
def test_radii_and_angles_around_a_double_pole(z, d, width):
    """On a grid across a double pole, half of the walls have two real poles, the others a complex pair."""
    alpha, beta = double_pole(z, 0.1, d)
    alphas, betas = (middle * (1.0 + width * np.linspace(-1.0, 1.0, 64)) for middle in (alpha, beta))
    grid = area_poles(Area.whole(alphas[None], betas[None], np.array([0.1]), np.array([d])), 1e-9, with_angle=True)
    columns = [np.tile(alphas, 64), np.repeat(betas, 64), np.full(4096, 0.1), np.full(4096, d)]
    single = compute_dominant_poles(columns, 1e-9)
    error, finite = np.abs(np.log(grid.radius).reshape(-1) - single.re), np.isfinite(grid.angle).reshape(-1)
    assert (error <= 1e-9 + single.error).all()
    np.testing.assert_allclose(grid.angle.reshape(-1)[finite], single.im[finite], atol=2e-9)
    # The double pole is dominant, with an error of the order of the square root of the rounding error.
    assert zwidth.spectral_radius(alpha, beta, 0.1, d) == pytest.approx(z, abs=1e-6)
    assert 0.1 < (grid.angle == 0).mean() < 0.9


@pytest.mark.parametrize("accuracy", [1e-2, 1e-9])
@pytest.mark.parametrize("d", [0.37, 50.0])
@pytest.mark.parametrize("longer", [1, 40])
def test_window_equals_the_full_grid_bit_for_bit(d, accuracy, longer):
    """Windows end inside cells, also one point from a cell's edge; the rate must agree with the radius."""
    alpha, beta = np.linspace(0.0, 0.8 / (1.0 + d), 209 * longer)[None], np.linspace(-0.2, 1.0, 150)[None]
    devices = np.array([0.1, 0.7]), np.full(2, d)
    full = area_poles(Area.whole(alpha, beta, *devices), accuracy, with_rate=True, with_angle=True)
    finite = np.isfinite(full.rate)
    np.testing.assert_allclose(np.exp(-full.rate[finite]), full.radius[finite], rtol=2e-9)
    for rows, columns in (
        (slice(40, 101), slice(87, 200)),
        (slice(15, 33), slice(7, 209)),
        (slice(0, 150), slice(8, 9)),
    ):
        view = area_poles(Area(alpha, beta, *devices, (rows, columns)), accuracy, with_rate=True, with_angle=True)
        for leaf, window in zip(full, view, strict=True):
            np.testing.assert_array_equal(leaf[:, rows, columns], window)


def test_cells_find_a_dominant_pair_between_slow_pole_and_ring():
    """The iteration must start at half the angle of the ring's first pair; from the usual starts it converges to real
    poles.
    """
    alpha, beta, device = np.linspace(0.31, 0.37, 100), np.linspace(0.55, 0.62, 100), (0.1, 0.37)
    log_radius = compute_grid_poles(Area.whole(alpha[None], beta[None], *np.transpose([device])), 1e-9)[1][0]
    assert np.isfinite(log_radius).mean() > 0.95
    row, column = np.nonzero(np.isfinite(log_radius))
    single = compute_dominant_poles([alpha[column], beta[row], *(np.full(row.size, x) for x in device)], 1e-9)
    assert (np.abs(log_radius[row, column] - single.re) <= 1e-9 + single.error).all()
