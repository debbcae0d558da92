"""Add statuses to the solutions of `stability.reference`: the boundary points and the ridge by nonlinear solvers.

The status of a point is that of its arguments, NOT_CONVERGED if the solver did not converge, or NO_BOUNDARY if the line
has no stable wall. Values and derivatives are NaN unless the status is OK.
"""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp

from zwidth.core.status import RidgeKind, Status
from zwidth.core.types import Array
from zwidth.core.xp import nan_with_nan_derivatives
from zwidth.stability.reference import find_boundary_point, maximize_stiffness
from zwidth.stability.rigid.normalization import device_status, wall_status


@jnp.vectorize
def kkt_kernel(delta: Array, d: Array) -> tuple[Array, ...]:
    """Return the fields of `zwidth.alpha_max` for one point, from the equations of the ridge."""
    status, inputs = device_status(delta, d), (delta, d)
    # Replace NaN by valid numbers, because a solver may stop all batch entries at the NaN of one.
    ridge, is_corner = maximize_stiffness(*(jnp.where(status == Status.OK, value, 1.0) for value in inputs))
    status = jnp.where((status == Status.OK) & ~ridge.converged, int(Status.NOT_CONVERGED), status)
    kind = jnp.where(is_corner, int(RidgeKind.CORNER), int(RidgeKind.SMOOTH))
    kind = jnp.where(status == Status.OK, kind, int(RidgeKind.NONE))
    nan_if_invalid = nan_with_nan_derivatives(status == Status.OK, *inputs)
    values = (part + nan_if_invalid for part in ridge[:3])
    return *values, kind.astype(jnp.int32), status.astype(jnp.int32)


@partial(jnp.vectorize, excluded=(3,))
def point_kernel(delta: Array, d: Array, given: Array, line: str) -> tuple[Array, ...]:
    """Return the fields of `zwidth.boundary_point` for one point; arguments as in `find_boundary_point`."""
    inputs, zero = (delta, d, given), 0.0 * given
    input_status = wall_status(*((zero, given) if line == "row" else (given, zero)), delta, d)
    point, exists = find_boundary_point(
        *(jnp.where(input_status == Status.OK, value, 1.0) for value in inputs), line=line
    )
    status = jnp.where(point.converged, int(Status.OK), int(Status.NOT_CONVERGED))
    status = jnp.where(exists, status, int(Status.NO_BOUNDARY))
    status = jnp.where(input_status == Status.OK, status, input_status)
    nan_if_invalid = nan_with_nan_derivatives(status == Status.OK, *inputs)
    return *(part + nan_if_invalid for part in point[:3]), status.astype(jnp.int32)
