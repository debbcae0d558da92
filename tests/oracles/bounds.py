"""Spectral radii with certified error bounds."""

from typing import NamedTuple

import numpy as np

from zwidth.core.status import Status
from zwidth.numerics.evaluate import broadcast
from zwidth.stability.rigid.broadcasting import NAMES
from zwidth.stability.rigid.dominant.arrays import compute_dominant_poles, find_poles
from zwidth.stability.rigid.normalization import wall_status


class Radius(NamedTuple):
    """Radii, absolute error bounds, whether these satisfy the requested accuracy, and status."""

    radius: np.ndarray
    error: np.ndarray
    certified: np.ndarray
    status: np.ndarray


def bound_radius(alpha, beta, delta, d, *, accuracy=1e-9) -> Radius:
    """Return the radius, error bound, certificate and status of each point by the methods of
    `zwidth.spectral_radius`.
    """
    arrays = broadcast(dict(zip(NAMES, (alpha, beta, delta, d), strict=True)))
    shape, arrays = arrays[0].shape, [np.atleast_1d(array) for array in arrays]
    radius, certified, *_ = find_poles(arrays, accuracy)
    log_error, status = np.full(radius.shape, accuracy), np.asarray(wall_status(*arrays))
    # Uncertified points: compute the error bound pointwise, also for points of a grid.
    open_points = [array[~certified] for array in arrays]
    log_error[~certified] = np.where(
        np.isnan(radius[~certified]), np.inf, compute_dominant_poles(open_points, accuracy).error
    )
    # Convert from the logarithm of the radius, which has full relative accuracy.
    error = np.where(np.isinf(log_error), np.inf, (np.expm1(log_error) + 2e-16) * radius)
    status = np.where((status == Status.OK) & ~certified, Status.NOT_CONVERGED, status)
    return Radius(*(leaf.reshape(shape) for leaf in (radius, error, certified, status)))
