"""Stable or not by the Schur-Cohn recursion without division: one fused kernel, no pole computed.

For real P of degree n with p_n > 0, P has all zeros inside the unit circle exactly where |p_0| < p_n and the
polynomial of one degree less

    p'_i = p_n p_(i+1) - p_0 p_(n-1-i)

does too. Its leading coefficient is ``p_n^2 - p_0^2``, so |p_0| < p_n shows as its sign. Dividing by p_n, as textbooks
do, would break XLA's fusion into some n kernels; here sizes are kept in range by exact powers of two instead.

P has few coefficients: three at the top, three at the bottom (four and four for a fractional delay), and the
recursion keeps that shape, so a stage costs 8 (13) multiplications whatever the degree. The first stage is special:
p_n = 1, and p_0 = -a1 beta does not depend on alpha, so for beta = 0 it only divides by z. The last two stages are
replaced by what they say of this loop, in factored form: P(1) > 0 is alpha > 0, P(-1) has the sign of a line, and for
d = 0 the remaining condition is

    psi alpha (phi1 + phi2 (beta + delta)) < phi1 (beta + delta)(1 - psi beta),   |psi beta| < 1

which loses nothing as delta grows, where the recursion fails.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth import phi
from zwidth._types import Array
from zwidth.grouping import Degree
from zwidth.loop import plant_of, valid_device
from zwidth.stability.layout import PIECE, DeviceWork, Points, by_degree, fields_of, per_device

# A stage squares the scale: log2 p_n falls below 2^m log2(1 - k^2) in m stages, |p_0| = k p_n. Four stages of
# 1 - k^2 = 2^-53 in all, the closest a float64 |p_0| < p_n comes to it, stay above 2^-1022; two in float32.
_STAGES_PER_SCALE = {8: 4, 4: 2}
# Beyond this many stages the kernel is a loop over blocks of stages instead of one long expression.
_UNROLLED = 112
_BLOCK = 16
# A stage with 1 - k^2 below this may have lost half of the digits: the label is then doubtful.
_DOUBT = 1e-7


class Device(NamedTuple):
    """What the recursion needs of (delta, d), computed once a device; NaN where they are out of range."""

    delta: Array
    c: Array
    p1: Array
    a2: Array
    a1: Array
    a0: Array
    tilt: Array  # P(-1) has the stable sign where tilt (alpha + 2 beta) < 1


def device_kernel(delta: Array, d: Array, degree: Degree) -> Device:
    """The `Device` of one (delta, d)."""
    ok = valid_device(delta, d)
    safe = jnp.where(ok, delta, 1.0)
    plant = plant_of(safe, jnp.where(ok, d, float(degree.whole)), degree)
    sign = -1.0 if degree.whole % 2 else 1.0
    tilt = sign * 0.5 * plant.gap / (1.0 + plant.c)
    fields = (safe, plant.c, phi.phi1(safe), plant.a2, plant.a1, plant.a0, tilt)
    return Device(*(jnp.where(ok, field, jnp.nan) for field in fields))


class _Signed(NamedTuple):
    """A coefficient up to its sign, kept apart in Python: a negation would cost as much as a product."""

    sign: int
    value: Array


def _product(left: _Signed | None, right: _Signed | None) -> _Signed | None:
    if left is None or right is None:
        return None
    return _Signed(left.sign * right.sign, left.value * right.value)


def _difference(left: _Signed | None, right: _Signed | None) -> _Signed | None:
    if right is None:
        return left
    if left is None:
        return _Signed(-right.sign, right.value)
    if left.sign == right.sign:
        return _Signed(left.sign, left.value - right.value)
    return _Signed(left.sign, left.value + right.value)


def _sum(left: _Signed | None, right: _Signed | None) -> _Signed | None:
    return _difference(left, None if right is None else _Signed(-right.sign, right.value))


class _Ends(NamedTuple):
    """A polynomial by its highest coefficients, downwards, and its lowest, upwards; None and between them: zero."""

    top: list[_Signed | None]
    low: list[_Signed | None]
    degree: int

    def joined(self) -> _Ends:
        """All coefficients from the top once the two ends meet."""
        if len(self.top) + len(self.low) <= self.degree + 1:
            return self
        full: list[_Signed | None] = [None] * (self.degree + 1)
        for index, value in enumerate(self.top):
            full[index] = _sum(full[index], value)
        for index, value in enumerate(self.low):
            full[self.degree - index] = _sum(full[self.degree - index], value)
        return _Ends(full, list(reversed(full)), self.degree)


def _at(values: list[_Signed | None], index: int) -> _Signed | None:
    return values[index] if index < len(values) else None


def _stage(p: _Ends, monic: bool = False) -> _Ends:
    """One stage; ``p'_(n-1-j) = a H_j - f L_j`` and ``p'_j = a L_(j+1) - f H_(j+1)``, a = H_0 = p_n, f = L_0 = p_0."""
    a, f = p.top[0], p.low[0]
    meet = len(p.top) + len(p.low) > p.degree + 1

    def times_a(value: _Signed | None) -> _Signed | None:
        return value if monic else _product(a, value)

    count = max(len(p.top), len(p.low))
    top = [_difference(times_a(_at(p.top, j)), _product(f, _at(p.low, j))) for j in range(count)]
    if meet:
        top = top[: p.degree]
        return _Ends(top, list(reversed(top)), p.degree - 1)
    low = [_difference(times_a(_at(p.low, j + 1)), _product(f, _at(p.top, j + 1))) for j in range(count - 1)]
    return _Ends(top, low, p.degree - 1)


def _bits(value: Array) -> Array:
    return jax.lax.bitcast_convert_type(value, jnp.int64 if value.dtype.itemsize == 8 else jnp.int32)


def _power_of_two(leading: Array) -> Array:
    """``2^-e`` for the exponent e of the leading coefficient, by its bits."""
    wide = leading.dtype.itemsize == 8
    mask, twice_bias = (0x7FF << 52, 0x7FE << 52) if wide else (0xFF << 23, 0xFE << 23)
    bits = _bits(leading)
    return jax.lax.bitcast_convert_type(twice_bias - (bits & bits.dtype.type(mask)), leading.dtype)


def _scaled(p: _Ends) -> _Ends:
    leading = p.top[0]
    assert leading is not None
    factor = _Signed(1, _power_of_two(leading.value))
    # A zero is found again in both lists where they meet; scaling it twice costs nothing after compilation.
    return _Ends([_product(factor, v) for v in p.top], [_product(factor, v) for v in p.low], p.degree)


def polynomial(alpha: Array, beta: Array, device: Device, degree: Degree) -> _Ends:
    """P by its ends."""
    a2, a1, a0 = device.a2, device.a1, device.a0
    n = [a2, a1, a0] if degree.fractional else [a2, a1]
    # N(z) ((alpha + beta) z - beta), lowest power first.
    total = alpha + beta
    low = [_Signed(-1, n[-1] * beta)]
    for left, right in zip(reversed(n), [*reversed(n[:-1]), None], strict=True):
        low.append(_Signed(1, left * total if right is None else left * total - right * beta))
    one = jnp.ones_like(device.c)
    top = [_Signed(1, one), _Signed(-1, one + device.c), _Signed(1, device.c)]
    return _Ends(top, low, degree.poles).joined()


def labels(alpha: Array, beta: Array, device: Device, degree: Degree, doubt: bool = False) -> Array:
    """The label of each point, or with ``doubt`` 1 for stable plus 2 for doubtful; any broadcast shapes, one dtype."""
    gate = (alpha > 0) & (device.tilt * (alpha + 2.0 * beta) < 1.0)
    if degree == Degree(0, False):
        stable, doubtful = _cubic(alpha, beta, device)
    else:
        stable, doubtful = _recursion(alpha, beta, device, degree, doubt)
    stable = stable & gate
    return stable.astype(jnp.int8) + 2 * doubtful.astype(jnp.int8) if doubt else stable


def _cubic(alpha: Array, beta: Array, device: Device) -> tuple[Array, Array]:
    b = beta + device.delta
    bounded = jnp.abs(device.a1 * beta) < 1.0
    left = device.a1 * alpha * (device.p1 + device.a2 * b)
    stable = bounded & (left < device.p1 * b * (1.0 - device.a1 * beta))
    return stable, jnp.zeros_like(stable)


def _recursion(alpha: Array, beta: Array, device: Device, degree: Degree, doubt: bool) -> tuple[Array, Array]:
    p = polynomial(alpha, beta, device, degree)
    signs = _Signs(doubt)
    p = _followed(p, signs, monic=True)
    if p.degree > _UNROLLED:
        p, signs = _looped(p, signs)
    done = 0
    while p.degree > 3:
        if done and done % _STAGES_PER_SCALE[alpha.dtype.itemsize] == 0:
            p = _scaled(p)
        p = _followed(p, signs)
        done += 1
    return _last_conditions(p, signs)


class _Signs:
    """The signs of all leading coefficients so far, gathered in one integer; with ``doubt`` also of small ones."""

    def __init__(self, doubt: bool, negative: Array | None = None, small: Array | None = None):
        self.doubt = doubt
        self.negative = negative
        self.small = small

    def note(self, value: Array, scale: Array | None) -> None:
        """Take in a value that must be positive, and was formed as a difference of parts of size ``scale`` (or 1)."""
        self.negative = _bits(value) if self.negative is None else self.negative | _bits(value)
        if self.doubt:
            margin = jnp.abs(value) - (_DOUBT if scale is None else _DOUBT * scale)
            self.small = _bits(margin) if self.small is None else self.small | _bits(margin)


def _followed(p: _Ends, signs: _Signs, monic: bool = False) -> _Ends:
    before = _value(p.top[0])
    p = _stage(p, monic).joined()
    signs.note(_value(p.top[0]), None if monic else before * before)
    return p


def _value(coefficient: _Signed | None) -> Array:
    if coefficient is None:
        return jnp.zeros(())
    return coefficient.value if coefficient.sign > 0 else -coefficient.value


def _last_conditions(p: _Ends, signs: _Signs) -> tuple[Array, Array]:
    """The last three stages, given the signs of P(1) and P(-1): ``q3^2 - q0^2 > q3 q1 - q0 q2``, and > 0."""
    q3, q2, q1, q0 = map(_value, p.top)
    square = q3 * q3 - q0 * q0
    rest = q3 * q1 - q0 * q2
    signs.note(square, q3 * q3)
    signs.note(square - rest, square)
    assert signs.negative is not None
    # A sign bit is blind to an exact zero and to NaN, which reaches the last difference.
    stable = (signs.negative >= 0) & (square > rest)
    return stable, jnp.zeros_like(stable) if signs.small is None else signs.small < 0


def _looped(p: _Ends, signs: _Signs) -> tuple[_Ends, _Signs]:
    """Blocks of stages in a loop, while the ends of the polynomial are still apart and keep their lengths."""
    blocks = (p.degree - len(p.top) - len(p.low)) // _BLOCK
    every = _STAGES_PER_SCALE[p.top[0].value.dtype.itemsize]
    tops = len(p.top)

    def block(_: int, carry: tuple[list[Array], list[Array]]) -> tuple[list[Array], list[Array]]:
        values, gathered = carry
        # The degree only has to be large enough for the ends not to meet inside a block.
        ends = [_Signed(1, value) for value in values]
        part = _Ends(ends[:tops], ends[tops:], 4 * _BLOCK)
        seen = _Signs(signs.doubt, *gathered)
        for done in range(_BLOCK):
            part = _followed(_scaled(part) if done % every == 0 else part, seen)
        kept = [seen.negative, seen.small] if signs.doubt else [seen.negative]
        return [_value(v) for v in (*part.top, *part.low)], kept

    shape = np.broadcast_shapes(*(v.value.shape for v in (*p.top, *p.low) if v is not None))
    values = [jnp.broadcast_to(_value(v), shape) for v in (*p.top, *p.low)]
    start = [signs.negative, signs.small] if signs.doubt else [signs.negative]
    gathered = [jnp.broadcast_to(g, shape) for g in start if g is not None]
    values, gathered = jax.lax.fori_loop(0, blocks, block, (values, gathered))
    ends: list[_Signed | None] = [_Signed(1, value) for value in values]
    return _Ends(ends[:tops], ends[tops:], p.degree - blocks * _BLOCK), _Signs(signs.doubt, *gathered)


@cache
def _work(degree: Degree, dtype: str, doubt: bool) -> DeviceWork:
    """The compiled parts of one degree, for points one by one."""

    def kernel(alpha: Array, beta: Array, fields: Array) -> Array:
        return labels(alpha.astype(dtype), beta.astype(dtype), Device(*fields.astype(dtype)), degree, doubt)

    device = jax.jit(lambda delta, d: jnp.stack(device_kernel(delta, d, degree)))
    out = np.int8 if doubt else np.bool_
    piece = 1 << 13 if degree.poles > _UNROLLED else PIECE
    return DeviceWork(device, jax.jit(kernel), len(Device._fields), out, piece)


def schur_cohn_map(points: Points, dtype: str = "float64", doubt: bool = False) -> np.ndarray:
    """Label every point by the recursion.

    Args:
        points: folded arguments.
        dtype: precision of the recursion, "float64" or "float32"; the device's coefficients are computed in float64.
        doubt: return 1 for stable plus 2 for doubtful instead of a boolean.

    Returns:
        Array of the broadcast shape; a point out of range is not stable.

    Numerics:
        One fused kernel whose cost grows with 8 (d + 3) multiplications a point, 13 for a fractional delay; about
        1e-13 from the boundary, or closer, labels may be wrong; in float32, about 1e-3.

    References:
        Schur 1918; Cohn 1922; Jury 1964 (the last conditions).
    """
    return by_degree(points, np.int8 if doubt else np.bool_, lambda degree, part: _of_degree(part, degree, dtype, doubt))


def _of_degree(points: Points, degree: Degree, dtype: str, doubt: bool) -> np.ndarray:
    work = _work(degree, dtype, doubt)
    shape = points.shape
    if not points.is_dense or degree.poles > _UNROLLED:
        return per_device(work, [points.alpha, points.beta], points.delta, points.d)
    device_shape = np.broadcast_shapes(points.delta.shape, points.d.shape)
    deltas, delays = (np.broadcast_to(array, device_shape).reshape(-1) for array in (points.delta, points.d))
    with jax.enable_x64(True):
        fields = np.asarray(fields_of(work, deltas, delays)).reshape(-1, *device_shape)
        return np.asarray(work.kernel(points.alpha, points.beta, fields)).reshape(shape)
