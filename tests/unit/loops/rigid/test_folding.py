"""Arguments grouped by a key and put together again, against the same work on plainly broadcast arrays."""

import numpy as np
import pytest

import zwidth
from zwidth.loops.rigid.folding import fold, fold_arguments, group_by

SHAPE = (3, 4, 5)


@pytest.mark.parametrize("axes", [(), (0,), (1,), (2,), (0, 2), (0, 1, 2)])
def test_parts_of_a_key_join_to_the_whole(axes):
    """The key varies along no axis, along one, or along several."""
    random = np.random.default_rng(15)
    key = random.integers(3, size=tuple(length if axis in axes else 1 for axis, length in enumerate(SHAPE)))
    arrays = random.random(SHAPE), random.random((1, 4, 1)), random.random((3, 1, 5))
    joined, values = np.full(SHAPE, np.nan), []
    for value, (a, b, c), place in group_by(arrays, key):
        joined[place] = value + a - 2.0 * b * c
        values.append(value)
    assert values == np.unique(key).tolist()
    np.testing.assert_array_equal(joined, key + arrays[0] - 2.0 * arrays[1] * arrays[2])


def test_an_axis_along_which_values_repeat_is_shortened_and_no_other():
    values = np.arange(6.0).reshape(2, 1, 3)
    assert fold(np.broadcast_to(values, (2, 4, 3))).shape == (2, 1, 3)
    # Equal ends do not make a repetition.
    ends = np.ones((64, 64))
    ends[5] = 2.0
    assert fold(ends).shape == (64, 1)
    ends[5] = 1.0
    assert fold(ends).shape == (1, 1)


@pytest.mark.parametrize("shape", [(512, 512), (64, 64), (4, 8, 512)])
def test_a_constant_array_folds_to_one_value(shape):
    assert fold(np.full(shape, 0.1)).size == 1


def test_a_contiguous_meshgrid_is_folded_as_a_sparse_one():
    alpha, beta = np.linspace(0.01, 0.5, 512), np.linspace(0.01, 1.0, 300)
    full = np.meshgrid(alpha, beta)
    constant = np.full(full[0].shape, 0.1), np.ones(full[0].shape)
    points, shape = fold_arguments((*full, *constant))
    assert shape == (300, 512)
    assert [array.shape for array in points] == [(1, 512), (300, 1), (1, 1), (1, 1)]
    assert points.is_dense
    sparse = zwidth.is_stable(alpha, beta[:, None], 0.1, 1)
    np.testing.assert_array_equal(zwidth.is_stable(*full, *constant), sparse)
