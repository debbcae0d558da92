"""Stable or not by the Schur-Cohn recursion: one fused kernel, no pole computed.

The general recursion is in `zwidth.stability.recursion`; this loop shortens it at both ends. The first stage is
special: p_n = 1, and p_0 = -a1 beta does not depend on alpha, so XLA takes its products out of the loop along alpha,
and for beta = 0 it only divides by z. The last three stages are replaced by what they say of this loop, in factored
form: P(1) > 0 is alpha > 0, P(-1) has the stable sign on one side of a line, and for d = 0 the remaining condition is

    psi alpha (phi1 + phi2 (beta + delta)) < phi1 (beta + delta)(1 - psi beta),   |psi beta| < 1

which loses nothing as delta grows, where the recursion itself fails.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array
from zwidth.batching import concretely
from zwidth.grouping import Degree
from zwidth.stability.devices import Device, compiled_device
from zwidth.stability.layout import PIECE, DeviceWork, Points, assemble, fields_of, per_device, split_by_degree
from zwidth.stability.recursion import UNROLLED, Ends, Signed, Verdict, reduce_to

# A stage with 1 - k^2 below this may have lost half of the digits: the label is then doubtful.
_DOUBT = 1e-7
# Kernels with a loop pass over their points once a block of stages: so many points stay in the cache.
_LOOP_PIECE = 1 << 12


def polynomial(alpha: Array, beta: Array, device: Device, degree: Degree) -> Ends:
    """P by its ends: ``z^k (z - 1)(z - c)`` at the top, ``N(z) ((alpha + beta) z - beta)`` at the bottom."""
    n = [device.a1, device.a2]
    if degree.fractional:
        n.insert(0, device.a0)
    total = alpha + beta
    low: list[Signed | None] = [Signed(-1, n[0] * beta)]
    low += [Signed(1, left * total - right * beta) for left, right in pairwise(n)]
    low.append(Signed(1, n[-1] * total))
    one = jnp.ones_like(device.c)
    top: list[Signed | None] = [Signed(1, one), Signed(-1, one + device.c), Signed(1, device.c)]
    return Ends(top, low, degree.poles)


def labels(alpha: Array, beta: Array, device: Device, degree: Degree, doubt: bool = False) -> Array:
    """The label of each point, or with ``doubt`` 1 for stable plus 2 for doubtful; any broadcast shapes, one dtype."""
    # What does not depend on alpha stands apart: XLA takes it out of the loop along alpha.
    gate = (alpha > 0) & (device.tilt * alpha < 1.0 - device.tilt * (2.0 * beta))
    if degree == Degree(0, False):
        stable = gate & _cubic(alpha, beta, device)
        return stable.astype(jnp.int8) if doubt else stable
    verdict = Verdict(_DOUBT if doubt else None)
    q3, q2, q1, q0 = reduce_to(polynomial(alpha, beta, device, degree), verdict, 3).values
    # Given the signs of P(1) and P(-1), a cubic is stable where q3^2 - q0^2 > 0 and > q3 q1 - q0 q2.
    square, rest = q3 * q3 - q0 * q0, q3 * q1 - q0 * q2
    verdict.note(square, q3)
    verdict.note_ratio(square - rest, square)
    stable = gate & verdict.positive & (square > rest)
    return stable.astype(jnp.int8) + 2 * verdict.doubtful.astype(jnp.int8) if doubt else stable


def _cubic(alpha: Array, beta: Array, device: Device) -> Array:
    b = beta + device.delta
    damped = device.a1 * beta
    stiffness = alpha * (device.a1 * (device.p1 + device.a2 * b))
    return (jnp.abs(damped) < 1.0) & (stiffness < device.p1 * b * (1.0 - damped))


@cache
def _work(degree: Degree, dtype: str, doubt: bool) -> DeviceWork:
    """The compiled parts of one degree."""

    def kernel(alpha: Array, beta: Array, fields: Array) -> Array:
        return labels(alpha.astype(dtype), beta.astype(dtype), Device(*fields.astype(dtype)), degree, doubt)

    piece = _LOOP_PIECE if degree.poles > UNROLLED else PIECE
    return DeviceWork(compiled_device(), jax.jit(kernel), np.int8 if doubt else np.bool_, piece)


def schur_cohn_map(points: Points, dtype: str = "float64", doubt: bool = False) -> np.ndarray:
    """Label every point by the recursion.

    Args:
        points: folded arguments.
        dtype: precision of the recursion, "float64" or "float32"; the device's coefficients are computed in float64.
        doubt: return 1 for stable plus 2 for doubtful instead of a boolean.

    Returns:
        Array of the broadcast shape; a point out of range is not stable.

    Numerics:
        One fused kernel: 8 (d + 3) multiplications a point, 13 a stage for a fractional delay. A label can be wrong
        where alpha is within about 1e-12 of the boundary, relative, 1e-9 from d = 20 on; in float32, within 1e-3.

    References:
        Schur 1918; Cohn 1922; Jury 1964 (the last conditions).
    """
    out = np.int8 if doubt else np.bool_

    def of(degree: Degree, *part: np.ndarray) -> np.ndarray:
        return _of_degree(Points(*part), degree, dtype, doubt)

    return assemble(split_by_degree(points), points.shape, out, of)


def _of_degree(points: Points, degree: Degree, dtype: str, doubt: bool) -> np.ndarray:
    work = _work(degree, dtype, doubt)
    if not points.is_dense or degree.poles > UNROLLED:
        return per_device(work, [points.alpha, points.beta], points.delta, points.d)
    device_shape = np.broadcast_shapes(points.delta.shape, points.d.shape)
    deltas, delays = (np.broadcast_to(array, device_shape).reshape(-1) for array in (points.delta, points.d))
    with concretely():
        fields = np.asarray(fields_of(work, deltas, delays)).reshape(-1, *device_shape)
        return np.asarray(work.kernel(points.alpha, points.beta, fields)).reshape(points.shape)
