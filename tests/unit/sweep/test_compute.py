"""Blocks of sweeps: certified radii or a status, independent of chunks, against companion matrices and
zwidth.decide_stability.
"""

import numpy as np
import pytest
from sweeping import make_sweep, study

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
    return Grid(make_sweep(study(axes=axes, outputs=OUTPUTS)))


@pytest.fixture(scope="module")
def grid():
    return grid_of([0, 1.5])


def compute(grid, slices, accuracy=1e-9):
    return compute_block("wall", OUTPUTS, grid.block(slices), accuracy)


def slices_of(grid):
    return tuple(slice(0, size) for size in grid.shape_of("wall"))


def radius_by_companion(block):
    walls = (block.alpha[:, :, None], block.beta[:, None, :], block.delta[:, None, None], block.d[:, None, None])
    return zwidth.spectral_radius(*walls, method="companion")


@pytest.mark.parametrize("d", [[0, 1.5], [12, 60.5]])
def test_radii_agree_with_companion_matrices(d):
    """Compare with eigenvalues of the companion matrix, an independent method."""
    axes = {"alpha": {"linear": {"start": 0, "stop": 0.3, "num": 8}}, "beta": [-0.1, 0.05, 0.2, 0.9]}
    grid = grid_of(d, **(axes if d[0] else {}))
    result = compute(grid, slices_of(grid))
    exact = radius_by_companion(grid.block(slices_of(grid)))
    certified = result["status"].reshape(exact.shape) == Status.OK
    assert certified.mean() > 0.99
    np.testing.assert_allclose(result["spectral_radius"][certified], exact[certified], rtol=1e-9)
    np.testing.assert_allclose(
        result["margin"][certified], 1.0 - result["spectral_radius"][certified], rtol=0, atol=4e-16
    )


def test_part_of_a_block_has_equal_values(grid):
    block_values = compute(grid, slices_of(grid))
    part = (*slices_of(grid)[:-2], slice(7, 19), slice(11, 60))
    for name, values in compute(grid, part).items():
        np.testing.assert_array_equal(values, block_values[name][:, 7:19, 11:60], err_msg=name)


def test_uncertified_radius_has_status_not_converged():
    """At a double pole the error of the radius is the square root of a rounding error: 1e-9 cannot be certified."""
    delta = 5.0
    top = zwidth.alpha_max(delta, 0.0)
    alpha, beta = float(top.alpha), float(top.beta)
    grid = grid_of(0, alpha=[0.1, alpha], beta=beta, delta=[delta])
    result = compute(grid, slices_of(grid))
    assert result["status"].ravel().tolist() == [Status.OK, Status.NOT_CONVERGED]
    # The value has a larger certified error and is kept.
    np.testing.assert_allclose(result["spectral_radius"].ravel()[1], exact_radius(alpha, beta, delta, 0.0), rtol=1e-3)


def test_points_out_of_range_have_their_status():
    """Compare with `zwidth.decide_stability`: label False and status OUT_OF_RANGE."""
    axes = {"alpha": [0.1, 1e61], "beta": [0.1, 1e61], "delta": [1.0, 1e12], "d": [0, 0.5]}
    outputs = ("stable", "passive", "spectral_radius", "gain_margin")
    grid = Grid(make_sweep(study(axes=axes, outputs=outputs)))
    block = grid.block(slices_of(grid))
    # The configuration accepts at most 1e12, so simulate a tiny mass.
    block = block._replace(delta=block.delta * np.where(block.delta == 1e12, 10, 1))
    decision = zwidth.decide_stability(
        block.alpha[:, :, None], block.beta[:, None, :], block.delta[:, None, None], block.d[:, None, None]
    )
    assert set(decision.status.ravel().tolist()) == {Status.OK, Status.OUT_OF_RANGE}
    for output in outputs:
        result = compute_block("wall", (output,), block, 1e-9)
        np.testing.assert_array_equal(result["status"], decision.status, err_msg=output)
