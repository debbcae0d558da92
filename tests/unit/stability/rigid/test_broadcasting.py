"""Folding of repeated values in broadcast arguments, against evaluation on fully broadcast arrays."""

import numpy as np

import zwidth
from zwidth.stability.rigid.broadcasting import fold, fold_arguments


def test_fold_shortens_only_axes_of_repeated_values():
    values = np.arange(6.0).reshape(2, 1, 3)
    assert fold(np.broadcast_to(values, (2, 4, 3))).shape == (2, 1, 3)
    # Equal first and last values do not imply a constant axis.
    ends = np.ones((64, 64))
    ends[5] = 2.0
    assert fold(ends).shape == (64, 1)
    ends[5] = 1.0
    assert fold(ends).shape == (1, 1)


def test_dense_meshgrid_is_folded_like_a_sparse_one():
    alpha, beta = np.linspace(0.01, 0.5, 512), np.linspace(0.01, 1.0, 300)
    full = np.meshgrid(alpha, beta)
    constant = np.full(full[0].shape, 0.1), np.ones(full[0].shape)
    points, shape = fold_arguments((*full, *constant))
    assert shape == (300, 512)
    assert [array.shape for array in points] == [(1, 512), (300, 1), (1, 1), (1, 1)]
    assert points.is_dense
    sparse = zwidth.is_stable(alpha, beta[:, None], 0.1, 1)
    np.testing.assert_array_equal(zwidth.is_stable(*full, *constant), sparse)
