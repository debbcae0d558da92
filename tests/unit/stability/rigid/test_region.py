"""The outline of the stable region, against pole counts on a grid and verdicts on both sides of its vertices."""

import math

import numpy as np
import pytest
import tolerances as tol
from mpmath import mp

import oracles
import zwidth
from zwidth.core.errors import InputError
from zwidth.stability.rigid.boundary import Piece, sample_lobe, stable_region
from zwidth.stability.rigid.poles import radius_by_companion

# A lobe, and lobes cut by the line at z = -1; integer and fractional delays; weak and strong damping.
DEVICES = [(0.0, 0), (0.5, 1), (2.4, 0), (6.0, 0), (50.0, 0.125), (3.0, 0.6), (0.1, 4), (1e3, 1.3)]


def separates_verdicts(alpha, beta, delta, d, away=1e-6):
    """Return whether each vertex separates stable from unstable walls, towards the center and, at alpha = 0, along
    beta.
    """
    center, rim = (np.mean(alpha), np.mean(beta)), slice(1, -1)
    low, high, off = beta[0], beta[-1], away * (beta[-1] - beta[0])
    column = zwidth.is_stable(away**2 * alpha.max(), [low - off, low + off, high - off, high + off], delta, d)
    inside, outside = (
        zwidth.is_stable(
            center[0] + size * (alpha[rim] - center[0]), center[1] + size * (beta[rim] - center[1]), delta, d
        )
        for size in (1.0 - away, 1.0 + away)
    )
    return column.tolist() == [False, True, True, False] and inside.all() and not outside.any()


@pytest.fixture(scope="module")
def regions():
    return {device: stable_region(*device) for device in DEVICES}


@pytest.mark.parametrize("device", DEVICES)
def test_outline_is_closed_and_separates_verdicts(regions, device):
    region = regions[device]
    assert separates_verdicts(region.alpha, region.beta, *device)
    assert (region.alpha[0], region.alpha[-1]) == (0.0, 0.0)
    assert region.beta[0] == pytest.approx(-device[0], abs=1e-12)
    assert region.omega[0] == 0
    assert (np.diff(region.omega) >= 0).all()
    assert (region.alpha >= 0).all()
    assert region.alpha.size == region.beta.size == region.omega.size == region.piece.size


@pytest.mark.parametrize("device", DEVICES)
def test_stiffest_vertex_is_the_ridge(regions, device):
    region, top = regions[device], zwidth.alpha_max(*device)
    # A corner lies between the last vertex of the curve and the first one of the line.
    assert region.alpha.max() == pytest.approx(top.alpha, rel=1e-3)
    assert region.alpha.max() <= top.alpha * (1 + 1e-12)


@pytest.mark.parametrize("device", DEVICES)
def test_area_agrees_with_stable_fraction_of_a_grid(regions, device):
    region = regions[device]
    cells = 128
    # The grid extends beyond the outline on all sides, so that a part missed by the outline is counted.
    low, high = np.min(region.beta), np.max(region.beta)
    width, height = 1.2 * region.alpha.max(), 1.2 * (high - low)
    alpha = (np.arange(cells)[:, None] + 0.5) / cells * width
    beta = low - 0.1 * (high - low) + (np.arange(cells) + 0.5) / cells * height
    stable = radius_by_companion(alpha, beta, *device) < 1
    counted = stable.mean() * width * height
    assert region.area == pytest.approx(counted, rel=tol.AREA_GRID.float64)


def test_vertices_of_the_curve_have_a_pole_on_the_unit_circle(regions):
    delta, d = 3.0, 0.6
    region = regions[delta, d]
    curve = np.flatnonzero(region.piece == Piece.COMPLEX_PAIR)[1:-1:40]
    with mp.workdps(oracles.DIGITS):
        for k in curve:
            terms = oracles.polynomial(region.alpha[k], region.beta[k], delta, d)
            value = oracles.evaluate(terms, mp.expj(float(region.omega[k])))
            assert abs(value) <= 1e-13 * sum(abs(term) for term in terms)


@pytest.mark.parametrize("device", [(6.0, 0), (50.0, 0.125), (2.4, 0)])
def test_vertices_of_the_cut_have_a_pole_at_minus_one(regions, device):
    region = regions[device]
    on_line = np.flatnonzero(region.piece == Piece.MINUS_ONE)
    assert on_line.size
    np.testing.assert_array_equal(region.omega[on_line], math.pi)
    with mp.workdps(oracles.DIGITS):
        for k in on_line:
            terms = oracles.polynomial(region.alpha[k], region.beta[k], *device)
            assert abs(oracles.evaluate(terms, -1)) <= 1e-13 * sum(abs(term) for term in terms)


@pytest.mark.parametrize("points", [8, 9, 13, 32])
@pytest.mark.parametrize("device", [*DEVICES, (1e6, 0), (0.0, 100), (3.0, 0), (0.3, 0.999)])
def test_outline_with_few_points_separates_verdicts(device, points):
    region = stable_region(*device, points=points)
    assert separates_verdicts(region.alpha, region.beta, *device)
    assert region.alpha.max() <= zwidth.alpha_max(*device).alpha * (1 + 1e-12)


def test_lobe_is_the_closed_form():
    omega, alpha, beta = sample_lobe(0.5, 1, points=20)
    curve = zwidth.boundary(omega, 0.5, 1)
    np.testing.assert_array_equal(alpha, curve.alpha)
    np.testing.assert_array_equal(beta, curve.beta)
    assert alpha[-1] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((-1.0, 1), "delta: got -1.0; a single finite number of at least 0"),
        ((0.1, np.nan), "d: got nan; a single finite number"),
        (([0.1, 0.2], 1), r"delta: got \[0.1, 0.2\]; a single finite number"),
        (("0.1", 1), "delta: got '0.1', a real number"),
        ((0.1, 1, 3), "points: got 3; it must be a whole number from 8"),
    ],
)
def test_invalid_arguments_raise(arguments, message):
    names = ("delta", "d", "points")
    with pytest.raises(InputError, match=message):
        stable_region(**dict(zip(names, arguments, strict=False)))
