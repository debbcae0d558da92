"""Radii of sweeps: each proved, or its status says that it is not, and the same whatever the chunks."""

import numpy as np
import pytest
from sweeping import study, sweep_of

import zwidth
from methods.problems import exact_radius
from zwidth.core.status import Status
from zwidth.sweep.compute import compute_block
from zwidth.sweep.grid import Grid

OUTPUTS = ("spectral_radius", "margin")


def grid_of(d, **axes):
    axes = {
        "alpha": {"linear": {"start": 0, "stop": 1.2, "num": 40}},
        "beta": {"linear": {"start": -0.1, "stop": 1.2, "num": 60}},
        "delta": [0.0, 0.5],
        "d": d,
        **axes,
    }
    return Grid(sweep_of(study(axes=axes, outputs=OUTPUTS)))


@pytest.fixture(scope="module")
def grid():
    return grid_of([0, 1.5])


def found_in(grid, place, accuracy=1e-9):
    return compute_block("wall", OUTPUTS, grid.block(place), accuracy)


def all_of(grid):
    return tuple(slice(0, size) for size in grid.shape_of("wall"))


def by_companion(block):
    walls = (block.alpha[:, :, None], block.beta[:, None, :], block.delta[:, None, None], block.d[:, None, None])
    return zwidth.spectral_radius(*walls, method="companion")


@pytest.mark.parametrize("d", [[0, 1.5], [12, 60.5]])
def test_radii_are_those_of_all_poles(d):
    """The reference: eigenvalues of the companion matrix, another method and another code."""
    axes = {"alpha": {"linear": {"start": 0, "stop": 0.3, "num": 8}}, "beta": [-0.1, 0.05, 0.2, 0.9]}
    grid = grid_of(d, **(axes if d[0] else {}))
    found = found_in(grid, all_of(grid))
    exact = by_companion(grid.block(all_of(grid)))
    proved = found["status"].reshape(exact.shape) == Status.OK
    assert proved.mean() > 0.99
    np.testing.assert_allclose(found["spectral_radius"][proved], exact[proved], rtol=1e-9)
    np.testing.assert_allclose(found["margin"][proved], 1.0 - found["spectral_radius"][proved], rtol=0, atol=4e-16)


def test_a_part_of_the_block_has_the_same_values(grid):
    whole = found_in(grid, all_of(grid))
    part = (*all_of(grid)[:-2], slice(7, 19), slice(11, 60))
    for name, values in found_in(grid, part).items():
        np.testing.assert_array_equal(values, whole[name][:, 7:19, 11:60], err_msg=name)


def test_what_is_not_proved_says_so():
    """At a double pole the radius moves with the root of a rounding error: 1e-9 cannot be proved."""
    delta = 5.0
    top = zwidth.alpha_max(delta, 0.0)
    alpha, beta = float(top.alpha), float(top.beta)
    grid = grid_of(0, alpha=[0.1, alpha], beta=beta, delta=[delta])
    found = found_in(grid, all_of(grid))
    assert found["status"].ravel().tolist() == [Status.OK, Status.NOT_CONVERGED]
    # A larger error is proved: the value is kept.
    np.testing.assert_allclose(found["spectral_radius"].ravel()[1], exact_radius(alpha, beta, delta, 0.0), rtol=1e-3)


def test_points_where_the_model_is_not_computed_say_so():
    """The reference: `zwidth.decide_stability`, whose labels there are False with OUT_OF_RANGE, not unstable."""
    axes = {"alpha": [0.1, 1e61], "beta": [0.1, 1e61], "delta": [1.0, 1e12], "d": [0, 0.5]}
    outputs = ("stable", "passive", "spectral_radius", "gain_margin")
    grid = Grid(sweep_of(study(axes=axes, outputs=outputs)))
    block = grid.block(all_of(grid))
    # As of a mass that is so small: more than 1e12 cannot be written.
    block = block._replace(delta=block.delta * np.where(block.delta == 1e12, 10, 1))
    told = zwidth.decide_stability(
        block.alpha[:, :, None], block.beta[:, None, :], block.delta[:, None, None], block.d[:, None, None]
    )
    assert set(told.status.ravel().tolist()) == {Status.OK, Status.OUT_OF_RANGE}
    for output in outputs:
        found = compute_block("wall", (output,), block, 1e-9)
        np.testing.assert_array_equal(found["status"], told.status, err_msg=output)
