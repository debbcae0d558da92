"""Radii of sweeps to an accuracy: proved or companion eigenvalues, whatever the chunks."""

import numpy as np
import pytest

import zwidth
from sweeping import config_of, study
from zwidth.sweep.compute import compute
from zwidth.sweep.grid import Grid

METHODS = {"spectral_radius": "newton"}


@pytest.fixture(scope="module")
def grid():
    axes = {
        "alpha": {"linear": {"start": 0, "stop": 1.2, "num": 40}},
        "beta": {"linear": {"start": -0.1, "stop": 1.2, "num": 60}},
        "delta": [0.0, 0.5],
        "d": 0,
    }
    return Grid(config_of(study(axes=axes, outputs=("spectral_radius",), accuracy=1e-9)).studies[0])


def radii(grid, place, accuracy=1e-9):
    return compute("wall", ("spectral_radius",), grid.block(place), METHODS, accuracy)["spectral_radius"]


def test_the_accuracy_is_kept_also_where_there_is_no_proof(grid):
    place = tuple(slice(0, size) for size in grid.shape_of("wall"))
    found = radii(grid, place)
    block = grid.block(place)
    exact = zwidth.spectral_radius(
        block.alpha[:, :, None], block.beta[:, None, :], block.delta[:, None, None], 0.0, method="companion"
    )
    np.testing.assert_allclose(found, exact, rtol=1e-9)


def test_a_part_of_the_block_has_the_same_values(grid):
    shape = grid.shape_of("wall")
    whole = radii(grid, tuple(slice(0, size) for size in shape))
    part = (*(slice(0, size) for size in shape[:-2]), slice(7, 19), slice(11, 60))
    np.testing.assert_array_equal(radii(grid, part), whole[:, 7:19, 11:60])
