"""Spectral radii with the errors that are proved of them."""

from typing import NamedTuple

import numpy as np

from zwidth.core.status import Status
from zwidth.numerics.evaluate import broadcast
from zwidth.stability.rigid.broadcasting import NAMES
from zwidth.stability.rigid.dominant_poles import compute_dominant_poles, find_poles
from zwidth.stability.rigid.normalization import wall_status


class Radius(NamedTuple):
    """Radii, absolute errors, whether these are as small as asked for, and status."""

    radius: np.ndarray
    error: np.ndarray
    certified: np.ndarray
    status: np.ndarray


def bound_radius(alpha, beta, delta, d, *, accuracy=1e-9) -> Radius:
    """What `zwidth.spectral_radius` knows of each point."""
    arrays = broadcast(dict(zip(NAMES, (alpha, beta, delta, d), strict=True)))
    shape, arrays = arrays[0].shape, [np.atleast_1d(array) for array in arrays]
    radius, certified, _ = find_poles(arrays, accuracy)
    proved, status = np.full(radius.shape, accuracy), np.asarray(wall_status(*arrays))
    # What is known of the others, whether of a map or not.
    left = [array[~certified] for array in arrays]
    proved[~certified] = np.where(np.isnan(radius[~certified]), np.inf, compute_dominant_poles(left, accuracy).error)
    # Of the pole at 1 of a wall without stiffness, and of any other, the logarithm has all the digits.
    error = np.where(np.isinf(proved), np.inf, (np.expm1(proved) + 2e-16) * radius)
    status = np.where((status == Status.OK) & ~certified, Status.NOT_CONVERGED, status)
    return Radius(*(leaf.reshape(shape) for leaf in (radius, error, certified, status)))
