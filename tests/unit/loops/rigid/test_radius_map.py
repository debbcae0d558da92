"""Radii of maps by following poles from the nodes of cells: held against the same points one by one."""

import numpy as np
import pytest
from bounds import bound_radius

import zwidth
from zwidth.loops.rigid.folding import Points, fold
from zwidth.loops.rigid.outermost_poles import outermost_poles
from zwidth.loops.rigid.radius_map import SMALLEST_MAP, as_map, followed_poles, lay_nodes
from zwidth.words.status import Status

ALPHA, BETA = np.linspace(-0.1, 1.5, 203), np.linspace(-0.3, 1.5, 157)


def as_area(*values):
    return as_map(Points(*map(fold, np.broadcast_arrays(*map(np.asarray, values)))))


def check_against_points(found, walls, seed, count=1500):
    """Both routes prove their values independently of each other: they differ by their errors at most."""
    rng = np.random.default_rng(seed)
    places = tuple(rng.integers(0, length, count) for length in found.radius.shape)
    alone = bound_radius(*(np.broadcast_to(wall, found.radius.shape)[places] for wall in walls))
    differ = np.abs(found.radius[places] - alone.radius)
    assert (differ <= found.error[places] + alone.error).all()
    # Where both are proved nearly all digits agree: Newton's method ends at the same pole.
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
def test_nearly_all_points_need_no_search(d):
    # As many points a cell as in maps that people draw: finer than the one above.
    alpha, beta = np.linspace(0.001, 1.5 / (1.0 + d), 320), np.linspace(0.0, 1.5 / (1.0 + d), 320)[:, None]
    area = as_area(alpha, beta, 0.1, d)
    assert area is not None
    nodes = lay_nodes(area)
    found = outermost_poles(nodes, 1e-9)
    _, ok = followed_poles(area, nodes, found.re, found.im, 1e-9, d % 1.0 != 0.0)
    assert ok.shape == (1, 320, 320)
    assert ok.mean() > 0.95


def test_bad_values_on_an_axis_leave_the_others_alone():
    alpha = np.where(np.arange(ALPHA.size) == 5, np.nan, ALPHA)
    found = bound_radius(alpha, BETA[:, None], 0.1, 0.0)
    assert (found.status[:, 5] == Status.INVALID_INPUT).all()
    assert np.isnan(found.radius[:, 5]).all()
    good = np.delete(np.arange(ALPHA.size), 5)
    plain = zwidth.spectral_radius(ALPHA, BETA[:, None], 0.1, 0.0)
    # What the two routes prove, or multiple poles.
    np.testing.assert_allclose(found.radius[:, good], plain[:, good], rtol=1e-7)
    assert np.median(np.abs(found.radius[:, good] - plain[:, good])) < 1e-15


def test_what_is_no_map_is_left_to_the_points():
    assert as_area(ALPHA, ALPHA, 0.1, 0.0) is None
    assert as_area(ALPHA, BETA[:3, None], 0.1, 0.0) is None
    assert as_area(ALPHA, BETA[:, None], np.linspace(0.1, 0.2, ALPHA.size), 0.0) is None
    area = as_area(ALPHA, BETA[:, None], np.array([0.1, 0.2])[:, None, None], 1.0)
    assert area is not None
    assert area.shape == (2, BETA.size, ALPHA.size)
    assert ALPHA.size * BETA.size >= SMALLEST_MAP
