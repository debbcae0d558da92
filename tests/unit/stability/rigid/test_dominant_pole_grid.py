"""Outermost poles of maps from series: held against the same walls one by one."""

import numpy as np
import pytest
from bounds import bound_radius

import zwidth
from zwidth.core.status import Status
from zwidth.stability.rigid.broadcasting import Points, fold
from zwidth.stability.rigid.dominant_pole_grid import Area, compute_grid_poles
from zwidth.stability.rigid.dominant_poles import (
    FEW_FOR_CELLS,
    SMALLEST_MAP,
    area_poles,
    arrange_as_area,
    compute_dominant_poles,
)

ALPHA, BETA = np.linspace(-0.1, 1.5, 223), np.linspace(-0.3, 1.5, 157)


def laid_out(*values):
    return arrange_as_area(Points(*map(fold, np.broadcast_arrays(*map(np.asarray, values)))))


def check_against_points(found, walls, seed, count=1500):
    """Both routes prove their values independently of each other: they differ by their errors at most."""
    rng = np.random.default_rng(seed)
    places = tuple(rng.integers(0, length, count) for length in found.radius.shape)
    alone = bound_radius(*(np.broadcast_to(wall, found.radius.shape)[places] for wall in walls))
    differ = np.abs(found.radius[places] - alone.radius)
    assert (differ <= found.error[places] + alone.error).all()
    # The series' terms fall much faster than their bound says.
    both = found.certified[places] & alone.certified
    assert np.median(differ[both]) < 1e-15
    assert both.mean() > 0.99


@pytest.mark.parametrize("d", [np.array([0.0, 4.0, 60.0]), 1.5])
def test_maps_have_the_values_of_single_points(d):
    walls = (ALPHA, BETA[:, None], 0.1, np.reshape(d, (-1, 1, 1)))
    found = bound_radius(*walls)
    assert found.certified.mean() > 0.99
    np.testing.assert_array_equal(found.certified, found.status == Status.OK)
    check_against_points(found, walls, 1)


def test_axes_in_any_order_and_delays_of_both_kinds():
    delays = np.array([1.5, 0.0, 4.0])
    walls = (ALPHA[:, None, None], BETA, 0.1, delays[:, None])
    found = bound_radius(*walls)
    assert found.radius.shape == (ALPHA.size, delays.size, BETA.size)
    check_against_points(found, walls, 2)
    for k, delay in enumerate(delays):
        plain = zwidth.spectral_radius(ALPHA, BETA[:, None], 0.1, delay)
        np.testing.assert_allclose(found.radius[:, k], plain.T, rtol=1e-9)


@pytest.mark.parametrize("d", [0.0, 4.0, 60.0, 1.5])
@pytest.mark.parametrize("accuracy", [1e-2, 1e-4, 1e-6, 1e-9])
def test_every_accuracy_is_kept(d, accuracy):
    """Against walls found one by one; nearly all come from series, and coarser ones are not as right by chance."""
    rng = np.random.default_rng(3)
    alpha, beta = np.linspace(0.001, 1.5 / (1.0 + d), 320), np.linspace(0.0, 1.5 / (1.0 + d), 320)
    area = Area.whole(alpha[None], beta[None], np.array([0.1]), np.array([d]))
    found = np.log(compute_grid_poles(area, accuracy).radius[0])
    left = np.isnan(found)
    assert left.mean() < 0.1
    row, column = rng.integers(0, 320, (2, 2000))
    row, column = row[~left[row, column]], column[~left[row, column]]
    exact = compute_dominant_poles([alpha[column], beta[row], np.full(row.size, 0.1), np.full(row.size, d)], 1e-9)
    assert (np.abs(found[row, column] - exact.re) <= accuracy + exact.error).all()


def test_an_axis_in_any_order_has_the_same_walls():
    rng = np.random.default_rng(4)
    alpha, beta = np.geomspace(1e-12, 1.0, 200), np.linspace(-0.05, 1.0, 200)
    mixed = rng.permutation(200)
    found = zwidth.spectral_radius(alpha, beta[:, None], 0.1, 1.0)
    np.testing.assert_allclose(
        zwidth.spectral_radius(alpha[mixed], beta[:, None], 0.1, 1.0), found[:, mixed], rtol=2e-9
    )
    rate = zwidth.decay_rate(alpha, beta[:, None], 0.1, 1.0)
    alone = zwidth.decay_rate(np.tile(alpha, 2), np.repeat(beta[[9, 150]], 200), 0.1, 1.0).reshape(2, 200)
    np.testing.assert_allclose(rate[[9, 150]], alone, rtol=1e-6)
    assert np.isfinite(alone).mean() > 0.95


@pytest.mark.parametrize(("rows", "columns"), [(1, 40000), (40000, 1), (3, 12000), (3000, 12)])
@pytest.mark.parametrize("d", [1.0, 0.37, 60.0])
def test_lines_and_long_thin_maps_are_as_well_known(rows, columns, d):
    """Cells have the proportions of the map; with others nearly all walls would be left to be computed alone."""
    alpha, beta = np.linspace(1e-4, 1.2 / (1.0 + d), columns), np.linspace(0.3, 0.9, rows)
    walls = (alpha, beta[:, None], 0.1, d)
    area = Area.whole(alpha[None], beta[None], np.array([0.1]), np.array([d]))
    assert np.isfinite(compute_grid_poles(area, 1e-9).radius).mean() > 0.99
    check_against_points(bound_radius(*walls), walls, 5)
    rate, radius = zwidth.decay_rate(*walls), zwidth.spectral_radius(*walls)
    np.testing.assert_allclose(np.exp(-rate), radius, rtol=2e-9)
    line = zwidth.spectral_radius(alpha, beta[0], 0.1, d) if rows == 1 else radius[0]
    np.testing.assert_array_equal(line, radius[0])


def test_what_is_no_map_is_left_to_the_points():
    assert laid_out(ALPHA, ALPHA, 0.1, 0.0) is None
    assert laid_out(ALPHA, BETA[:3, None], 0.1, 0.0) is None
    assert laid_out(ALPHA, BETA[:, None], np.linspace(0.1, 0.2, ALPHA.size), 0.0) is None
    found = laid_out(ALPHA, BETA[:, None], np.array([0.1, 0.2])[:, None, None], 1.0)
    assert found is not None
    assert found[2] == (2, BETA.size, ALPHA.size)
    # Of so many walls maps are looked for; fewer are taken one by one.
    assert ALPHA.size * BETA.size > FEW_FOR_CELLS >= SMALLEST_MAP


def double_pole(z, delta, d):
    """The wall with a double pole at a real z: there beta f' = Q' and alpha + beta f = Q."""
    coefficients = [np.asarray(zwidth.char_poly(*wall, delta, d)) for wall in ((0, 0), (1, 0), (0, 1))]
    device, stiff, damped = coefficients[0], coefficients[1] - coefficients[0], coefficients[2] - coefficients[0]
    value = [np.polyval(p, z) for p in (device, stiff, damped)]
    slope = [np.polyval(np.polyder(p), z) for p in (device, stiff, damped)]
    matrix = np.array([[value[1], value[2]], [slope[1], slope[2]]])
    return np.linalg.solve(matrix, -np.array([value[0], slope[0]]))


@pytest.mark.parametrize(("z", "d"), [(0.9, 0.0), (0.85, 1.0), (0.95, 4.0), (0.9, 1.5)])
@pytest.mark.parametrize("width", [0.05, 1e-4])
def test_two_poles_that_meet_are_followed_together(z, d, width):
    """A map across a double pole: half of its walls have two real poles, the others a pair."""
    alpha, beta = double_pole(z, 0.1, d)
    alphas, betas = (middle * (1.0 + width * np.linspace(-1.0, 1.0, 64)) for middle in (alpha, beta))
    area = Area.whole(alphas[None], betas[None], np.array([0.1]), np.array([d]))
    found = np.log(compute_grid_poles(area, 1e-9).radius[0])
    assert np.isnan(found).sum() < 64
    columns = [np.tile(alphas, 64), np.repeat(betas, 64), np.full(4096, 0.1), np.full(4096, d)]
    alone = compute_dominant_poles(columns, 1e-9)
    error, known = np.abs(found - alone.re.reshape(64, 64)), ~np.isnan(found)
    assert (error <= 1e-9 + alone.error.reshape(64, 64))[known].all()
    # The double pole is the outermost one, known to the root of rounding.
    assert zwidth.spectral_radius(alpha, beta, 0.1, d) == pytest.approx(z, abs=1e-6)
    real = np.sin(alone.im) < 1e-6
    assert 0.1 < real.mean() < 0.9


@pytest.mark.parametrize("accuracy", [1e-2, 1e-9])
@pytest.mark.parametrize("d", [0.37, 50.0])
@pytest.mark.parametrize("longer", [1, 40])
def test_a_window_has_the_bits_of_the_whole_map(d, accuracy, longer):
    """Windows that end inside of cells, one wall from their edge too; a rate is that of its radius."""
    alpha, beta = np.linspace(0.0, 0.8 / (1.0 + d), 209 * longer)[None], np.linspace(-0.2, 1.0, 150)[None]
    devices = np.array([0.1, 0.7]), np.full(2, d)
    whole = area_poles(Area.whole(alpha, beta, *devices), accuracy, with_rate=True)
    known = np.isfinite(whole.rate)
    np.testing.assert_allclose(np.exp(-whole.rate[known]), whole.radius[known], rtol=2e-9)
    for rows, columns in (
        (slice(40, 101), slice(87, 200)),
        (slice(15, 33), slice(7, 209)),
        (slice(0, 150), slice(8, 9)),
    ):
        part = area_poles(Area(alpha, beta, *devices, (rows, columns)), accuracy, with_rate=True)
        for leaf, found in zip(whole, part, strict=True):
            np.testing.assert_array_equal(leaf[:, rows, columns], found)


@pytest.mark.parametrize(("d", "low"), [(8.0, 0.3), (500.0, 0.9)])
def test_poles_of_nearly_one_size_need_not_be_told_apart(d, low):
    """Of a coarse map next to all poles of a ring, and where the outermost one changes, cells find nearly all."""
    alpha, beta = np.linspace(1e-4, 0.9, 128) / (1.0 + d), np.linspace(0.1, 0.54, 128)
    found = compute_grid_poles(Area.whole(alpha[None], beta[None], np.array([0.5]), np.array([d])), 1e-2).radius[0]
    known = ~np.isnan(found)
    assert known.mean() > low
    row, column = np.nonzero(known)
    alone = compute_dominant_poles([alpha[column], beta[row], np.full(row.size, 0.5), np.full(row.size, d)], 1e-9)
    assert (np.abs(np.log(found[known]) - alone.re) <= 1e-2 + alone.error).all()
    stable = zwidth.is_stable(alpha[column], beta[row], 0.5, d)
    sure = np.abs(alone.re) > 1.1e-5
    np.testing.assert_array_equal((found[known] < 1)[sure], stable[sure])


def test_cells_know_the_pair_of_a_short_delay_that_is_neither_slow_nor_of_the_ring():
    """From half the angle of the ring's first pair; from that pair and from the slow one steps lead to real poles."""
    alpha, beta, device = np.linspace(0.31, 0.37, 100), np.linspace(0.55, 0.62, 100), (0.1, 0.37)
    found = compute_grid_poles(Area.whole(alpha[None], beta[None], *np.transpose([device])), 1e-9).radius[0]
    assert np.isfinite(found).mean() > 0.95
    row, column = np.nonzero(np.isfinite(found))
    alone = compute_dominant_poles([alpha[column], beta[row], *(np.full(row.size, x) for x in device)], 1e-9)
    assert (np.abs(np.log(found[row, column]) - alone.re) <= 1e-9 + alone.error).all()
