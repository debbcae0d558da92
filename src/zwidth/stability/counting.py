"""Poles inside any circle, for any linear loop with a delay of whole periods, at a cost that no delay changes."""

from __future__ import annotations

import math
import sys
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.errors import InputError

# Concrete batches run in blocks of this many loops: their intermediate arrays then stay in the cache.
_BLOCK = 1 << 10
# Roundings that one factor, one sum and one logarithm may add up to; twice what a count of the operations gives.
_ROUNDINGS = 8.0
# Closer to the circle than this many units in the last place (of r^2), a complex root cannot be told in from out.
_ON_CIRCLE = 16.0
_SWEEPS = 2


def count_poles(
    zeros: ArrayLike, poles: ArrayLike, gain: ArrayLike, lag: ArrayLike, radius: ArrayLike = 1.0
) -> Array:
    """Count the closed loop's poles inside a circle.

    Counts, with multiplicity, the zeros of

        P(z) = z^lag (z - p_1)...(z - p_k) + gain (z - b_1)...(z - b_l)

    in ``|z| < radius``: p are the poles of the open loop (device, filters), b its zeros (wall, device), lag its delay
    in whole periods. A loop is stable where the count with ``radius=1`` is ``lag + k`` (for l < lag + k).

    Args:
        zeros: b, real or complex, shape ``(..., l)``, l >= 0; conjugate pairs are usual and not needed.
        poles: p, likewise, shape ``(..., k)``. No order of l, k and lag is assumed.
        gain: factor of the zeros' product, real and finite; 0 counts ``lag`` and the p inside.
        lag: whole number, >= 0 (up to 2^53).
        radius: of the circle, > 0. It broadcasts with gain, lag and the leading axes of zeros and poles.

    Returns:
        Array of whole numbers of the broadcast shape. -1 where an argument is out of its range, and where float64 cannot
        tell: a pole of the closed loop closer to the circle than the rounding of its own position there, that is about
        1e-14 relative for one well apart from others, 1e-7 for a nearly double one, and more than that where delay or
        clusters of p and b make rounding count more. What is not -1 is proved as set out below.

    Raises:
        InputError: no numbers, a complex gain, lag or radius, shapes that do not broadcast, or a single number out of
            its range.

    Numerics:
        With ``t = tan(w/2)``, ``z = r e^(jw)``, the two parts T + B of P have
        ``|z - a|^2 (1 + t^2) = |(r - a) + j t (r + a)|^2``, so that ``|T|^2 - |B|^2`` is a real polynomial in t of degree
        ``2 max(k, l)``. Its zeros are companion eigenvalues, improved by Weierstrass' corrections, each in a disk of Smith's
        theorem with the rounding added. Where no disk meets the real axis, the larger part is known, and arg P keeps within
        a quarter turn of its argument. The count is that of the larger part at z = -r, plus m at each crossover to B,
        less m at each to T, m = round((arg T - arg B)/(2 pi)) with arguments continuous from w = 0. Each m must be the same on the
        whole of its disk: then crossovers that nearly coincide, or were taken for none, change nothing.
        Direct calls compute with NumPy in float64; under jit or vmap it is traced in the precision there, where
        float32 answers -1 more often. Neither has a derivative.

    References:
        Walton, Marshall 1987, IEE Proc. D 134(2) (crossovers of systems with delay); Nyquist 1932; Smith 1970,
        J. ACM 17(1) (disks); for the circle, model.md, section 8.

    Example:
        >>> import zwidth
        >>> print(zwidth.count_poles([0.8], [1.0, 0.9], gain=0.01, lag=3))
        5
        >>> print(zwidth.count_poles([0.8], [1.0, 0.9], gain=0.01, lag=[20, 100_000]))
        [    22 100000]
    """
    values = {"zeros": zeros, "poles": poles, "gain": gain, "lag": lag, "radius": radius}
    jax = sys.modules.get("jax")
    if jax is not None and any(isinstance(value, jax.core.Tracer) for value in values.values()):
        xp = jax.numpy
        arrays = [xp.asarray(value, dtype=_kind(name)) for name, value in values.items()]
        return _count(*_aligned(arrays, xp), xp)
    arrays = [_checked(name, value) for name, value in values.items()]
    shaped = _aligned(arrays, np)
    shape = shaped[2].shape
    flat = [column.reshape(math.prod(shape), *column.shape[len(shape) :]) for column in shaped]
    counts = np.empty(flat[2].size, np.int64)
    with np.errstate(all="ignore"):
        for start in range(0, counts.size, _BLOCK):
            part = slice(start, start + _BLOCK)
            counts[part] = _count(*(column[part] for column in flat), np)
    if jax is not None and any(isinstance(value, jax.Array) for value in values.values()):
        return jax.numpy.asarray(counts.reshape(shape))
    return counts.reshape(shape)[()]


def _kind(name: str) -> type:
    return complex if name in ("zeros", "poles") else float


def _checked(name: str, value: ArrayLike) -> np.ndarray:
    """Convert one concrete argument, or say what is wrong with it."""
    kind = _kind(name)
    what = "real or complex" if kind is complex else "real"
    try:
        array = np.asarray(value)
        if array.dtype.kind not in ("biufc" if kind is complex else "biuf"):
            raise TypeError(array.dtype)
        array = array.astype(kind)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: got {value!r}, a rectangular array of {what} numbers is needed") from error
    if kind is complex:
        if array.ndim == 0:
            raise InputError(f"{name}: got {value!r}, a sequence of numbers is needed; write [{value!r}] for one")
        return array
    if array.ndim == 0 and not _in_range(name, array, np):
        allowed = {"gain": "a finite number", "lag": "a whole number from 0 to 2^53", "radius": "a finite number above 0"}
        raise InputError(f"{name}: got {value!r}, {allowed[name]} is needed; in an array such a loop counts -1")
    return array


def _in_range(name: str, value: Array, xp: Any) -> Array:
    good = xp.isfinite(value)
    if name == "radius":
        return good & (value > 0)
    if name == "lag":
        return good & (value >= 0) & (value * xp.finfo(value.dtype).eps <= 2) & (value == xp.floor(value))
    return good


def _aligned(arrays: list[Array], xp: Any) -> list[Array]:
    """Give every argument the common leading shape."""
    heads = [array.shape[:-1] for array in arrays[:2]] + [array.shape for array in arrays[2:]]
    try:
        shape = np.broadcast_shapes(*heads)
    except ValueError as error:
        named = zip(("zeros", "poles", "gain", "lag", "radius"), heads, strict=True)
        shapes = ", ".join(f"{name} {head}" for name, head in named)
        raise InputError(f"leading shapes do not broadcast: {shapes}; make each axis equal or 1") from error
    roots = [xp.broadcast_to(array, (*shape, array.shape[-1])) for array in arrays[:2]]
    return roots + [xp.broadcast_to(array, shape) for array in arrays[2:]]


# Below, the last axes are (part, factor) or (point, part, factor); part 0 is T, part 1 is B.


class _Parts(NamedTuple):
    """T and B on the circle, z = r (1 + jt)/(1 - jt): products of (u + jtv)/(1 + |t|) with their conjugates, weighted."""

    u: Array
    v: Array
    weight: Array  # T positive, B negative; the larger weight is 1
    doubt: Array  # relative error of the weights and of what does not depend on t, in roundings


def _count(zeros: Array, poles: Array, gain: Array, lag: Array, radius: Array, xp: Any) -> Array:
    """Count for arrays of one leading shape."""
    eps = float(xp.finfo(gain.dtype).eps)
    good = _in_range("gain", gain, xp) & _in_range("lag", lag, xp) & _in_range("radius", radius, xp)
    good = good & xp.all(xp.isfinite(zeros), axis=-1) & xp.all(xp.isfinite(poles), axis=-1)
    gain, lag, radius = xp.where(good, gain, 0.0), xp.where(good, lag, 0.0), xp.where(good, radius, 1.0)
    # Factors z of the shorter product make both equally long; `turns` are the powers of z that T has more than B.
    turns = lag + (poles.shape[-1] - zeros.shape[-1])
    size = max(poles.shape[-1], zeros.shape[-1])
    roots = xp.stack([_padded(poles, size, xp), _padded(zeros, size, xp)], axis=-2)
    roots = xp.where(good[..., None, None], roots, 0.0)
    r = radius[..., None, None]

    # E = ln |B/T|^2 without the factors. Where it is cut, only a count without any crossover is used.
    scale = r + xp.abs(roots)
    sizes = xp.sum(xp.log(scale), axis=-1)
    logs = (xp.log(xp.where(gain == 0, 1.0, xp.abs(gain))), turns * xp.log(radius), sizes[..., 0], sizes[..., 1])
    excess = 2.0 * (logs[0] - logs[1] - logs[2] + logs[3])
    limit = 0.8 * float(np.log(xp.finfo(gain.dtype).max))
    excess = xp.where(gain == 0, -limit, excess)
    cut = (gain == 0) | (xp.abs(excess) > limit)
    excess = xp.clip(excess, -limit, limit)
    doubt = 2.0 * sum(xp.abs(part) for part in logs) + 2.0 * size + 2.0
    weight = xp.stack([xp.exp(-xp.maximum(excess, 0.0)), -xp.exp(xp.minimum(excess, 0.0))], axis=-1)

    roots, quarter = _turned(roots, r, excess, xp)
    u, v = (r - roots) / scale, (r + roots) / scale
    inside = ((r - roots.real) * (r + roots.real) - roots.imag**2) / scale**2
    parts = _Parts(u, v, weight, doubt)
    low, high, leading, proved = _intervals(parts, eps, xp)
    met = xp.isfinite(low)
    m, clear = _turns_between(parts, inside, turns, quarter, gain, (low, high), eps, xp)

    # Which part is larger: at z = -r (t infinite), after each interval, and where a root is on the circle.
    first = leading < 0
    on = (xp.abs(inside) <= _ON_CIRCLE * eps) & (roots.imag != 0)
    near = xp.where(roots.real >= 0, roots.imag / (xp.abs(roots) + roots.real), (xp.abs(roots) - roots.real) / roots.imag)
    near = xp.clip(xp.where(on, near, 0.0), -1e30, 1e30)
    gaps = xp.isfinite(low[..., 1:])
    middle = xp.where(gaps, 0.5 * high[..., :-1] + 0.5 * low[..., 1:], 0.0)
    points = xp.concatenate([middle, near[..., 0, :], near[..., 1, :]], axis=-1)
    value, noise = _difference(parts, points, eps, xp)
    value, noise = value.real, noise
    split = middle.shape[-1]
    b_larger = xp.where(gaps, value[..., :split] < 0, first[..., None])
    told = ~gaps | (high[..., :-1] >= low[..., 1:]) | (xp.abs(value[..., :split]) > noise[..., :split])
    # A root on the circle to within rounding is as good inside as outside where its own part is the smaller one.
    sign = xp.concatenate([xp.full((size,), -1.0), xp.full((size,), 1.0)])
    smaller = value[..., split:] * sign.reshape((1,) * gain.ndim + (-1,)) > noise[..., split:]
    on = xp.concatenate([on[..., 0, :], on[..., 1, :]], axis=-1)

    after = xp.concatenate([b_larger, first[..., None]], axis=-1)[..., : low.shape[-1]]
    before = xp.concatenate([first[..., None], b_larger], axis=-1)[..., : low.shape[-1]]
    steps = xp.where(after, 1.0, 0.0) - xp.where(before, 1.0, 0.0)
    count = xp.sum(inside >= 0, axis=-1)
    count_t = lag + count[..., 0] - (size - poles.shape[-1])
    count_b = count[..., 1] - (size - zeros.shape[-1])
    total = xp.where(first, count_b, count_t) + xp.sum(xp.where(met, m * steps, 0.0), axis=-1)
    sure = good & proved & xp.all(clear | ~met, axis=-1) & xp.all(told, axis=-1) & xp.all(smaller | ~on, axis=-1)
    sure = sure & ~(cut & xp.any(met, axis=-1))
    return xp.where(sure, total, -1.0).astype(int)


def _padded(roots: Array, size: int, xp: Any) -> Array:
    missing = size - roots.shape[-1]
    return xp.concatenate([roots, xp.zeros((*roots.shape[:-1], missing), roots.dtype)], axis=-1)


def _turned(roots: Array, r: Array, excess: Array, xp: Any) -> tuple[Array, Array]:
    """Turn the plane by quarters, without rounding, until T and B differ at z = -r, where t is infinite."""
    scores = []
    for unit in (1.0, -1.0, 1j, -1j):
        far = xp.log(xp.abs(r + roots * unit) / (r + xp.abs(roots)))
        score = xp.abs(excess + 2.0 * xp.sum(far[..., 1, :] - far[..., 0, :], axis=-1))
        # Unturned data keep the relative accuracy of small w, so that one is preferred.
        scores.append(xp.minimum(xp.where(xp.isnan(score), 0.0, score), 0.1))
    best = xp.argmax(xp.stack(scores, axis=-1), axis=-1)
    unit = xp.asarray([1.0, -1.0, 1j, -1j])[best]
    return roots * unit[..., None, None], xp.asarray([0.0, 2.0, 1.0, 3.0])[best]


def _difference(parts: _Parts, t: Array, eps: float, xp: Any) -> tuple[Array, Array]:
    """|T|^2 - |B|^2 at the points t, over (1 + |t|)^(2 size), and a bound of its rounding."""
    t = t[..., None, None]
    u, v = parts.u[..., None, :, :], parts.v[..., None, :, :]
    below = 1.0 + xp.abs(t)
    plus, minus = (u + 1j * t * v) / below, (xp.conj(u) - 1j * t * xp.conj(v)) / below
    worst = (xp.abs(u) + xp.abs(t) * xp.abs(v)) / below + 1e-300
    sizes = xp.maximum(xp.abs(plus), eps * worst), xp.maximum(xp.abs(minus), eps * worst)
    relative = xp.sum(worst / sizes[0] + worst / sizes[1], axis=-1) + parts.doubt[..., None, None]
    weight = parts.weight[..., None, :]
    noise = xp.sum(xp.abs(weight) * xp.prod(sizes[0] * sizes[1], axis=-1) * relative, axis=-1)
    return xp.sum(weight * xp.prod(plus * minus, axis=-1), axis=-1), _ROUNDINGS * eps * noise


def _intervals(parts: _Parts, eps: float, xp: Any) -> tuple[Array, Array, Array, Array]:
    """Intervals of t that hold every crossover, lower and upper ends sorted, infinite where a disk misses the real axis."""
    # The polynomial's coefficients, lowest power first: products of |u|^2 + 2 t Im(u conj v) + t^2 |v|^2.
    a0, a2 = xp.abs(parts.u) ** 2, xp.abs(parts.v) ** 2
    a1 = 2.0 * (parts.u * xp.conj(parts.v)).imag
    size = a0.shape[-1]
    poly = xp.ones((*a0.shape[:-1], 1), a0.dtype)
    for i in range(size):
        none = xp.zeros((*poly.shape[:-1], 1), poly.dtype)
        poly = (
            xp.concatenate([poly * a0[..., i : i + 1], none, none], axis=-1)
            + xp.concatenate([none, poly * a1[..., i : i + 1], none], axis=-1)
            + xp.concatenate([none, none, poly * a2[..., i : i + 1]], axis=-1)
        )
    coefficients = xp.sum(parts.weight[..., None] * poly, axis=-2)
    leading = coefficients[..., -1]
    doubt = _ROUNDINGS * eps * xp.sum(xp.abs(parts.weight) * poly[..., -1], axis=-1) * (parts.doubt + 2.0 * size)
    proved = xp.abs(leading) > doubt
    if not size:
        return xp.zeros_like(coefficients[..., :0]), xp.zeros_like(coefficients[..., :0]), leading, proved
    count = 2 * size
    monic = coefficients[..., :-1] / xp.where(proved, leading, 1.0)[..., None]
    proved = proved & xp.all(xp.isfinite(monic), axis=-1)
    monic = xp.where(proved[..., None], monic, 1.0)
    shift = xp.broadcast_to(xp.eye(count, count - 1, k=-1, dtype=monic.dtype), (*monic.shape, count - 1))
    guess = xp.linalg.eigvals(xp.concatenate([shift, -monic[..., None]], axis=-1)) + 0j
    for _ in range(_SWEEPS):
        correction, _ = _weierstrass(parts, guess, leading, eps, xp)
        guess = xp.where(xp.isfinite(correction), guess - correction, guess)
    correction, noise = _weierstrass(parts, guess, leading, eps, xp)
    share = xp.abs(leading) / xp.maximum(xp.abs(leading) - doubt, 0.0)
    disk = 1.01 * count * (xp.abs(correction) + noise) * share[..., None]
    proved = proved & xp.all(xp.isfinite(disk), axis=-1)
    met = xp.abs(guess.imag) <= disk
    low = xp.sort(xp.where(met, guess.real - disk, xp.inf), axis=-1)
    high = xp.sort(xp.where(met, guess.real + disk, xp.inf), axis=-1)
    return low, high, leading, proved


def _weierstrass(parts: _Parts, guess: Array, leading: Array, eps: float, xp: Any) -> tuple[Array, Array]:
    """Correct every zero by p(guess)/(leading prod(guess - others)), and say what rounding adds to that."""
    value, noise = _difference(parts, guess, eps, xp)
    far = 1.0 + xp.abs(guess)
    apart = (guess[..., :, None] - guess[..., None, :]) / (far[..., :, None] * far[..., None, :])
    same = xp.eye(guess.shape[-1], dtype=bool).reshape((1,) * (guess.ndim - 1) + (guess.shape[-1],) * 2)
    scale = leading[..., None] * xp.prod(xp.where(same, 1.0, apart), axis=-1)
    scale = scale * xp.prod(xp.where(same, 1.0, far[..., None, :]), axis=-1)
    return value * far / scale, noise * far / xp.abs(scale)


def _turns_between(
    parts: _Parts, inside: Array, turns: Array, quarter: Array, gain: Array, ends: tuple, eps: float, xp: Any
) -> tuple[Array, Array]:
    """m = round((arg T - arg B)/(2 pi)) on every interval, and whether it is one number there."""
    u, v, inside = (value[..., None, :, :] for value in (parts.u, parts.v, inside))
    size = xp.abs(u)
    # From t = 0 on, a factor turns by arg((u + jtv)/u), without a jump: that line meets 0 only if the root is on the
    # circle, where the limit from inside is taken.
    rise = xp.where(size == 0, 1.0, inside / xp.where(size == 0, 1.0, size))
    slant = (u * xp.conj(v)).imag / xp.where(size == 0, 1.0, size)
    sign = xp.asarray([1.0, -1.0], dtype=gain.dtype).reshape((1,) * (u.ndim - 2) + (2, 1))
    start = xp.sum((sign * xp.angle(u))[..., 0, :, :], axis=(-2, -1)) - xp.where(gain < 0, np.pi, 0.0)
    start = start - 0.5 * np.pi * xp.mod(xp.mod(turns, 4.0) * quarter, 4.0)
    angles = []
    rounding = 4.0 * inside.shape[-1] + 4.0
    for end in ends:
        t = xp.where(xp.isfinite(end), end, 0.0)
        whole = 2.0 * turns[..., None] * xp.arctan(t)
        t = t[..., None, None]
        angles.append((whole, sign * xp.arctan2(t * rise, size + t * slant)))
        reach = xp.abs(u) + xp.abs(t) * xp.abs(v) + 1e-300
        cond = xp.sum(reach / xp.maximum(xp.abs(u + 1j * t * v), eps * reach), axis=(-2, -1))
        rounding = rounding + cond + xp.abs(whole)
    # Every angle is monotone in t, so that the ends bound each of them, hence their sum.
    edges = []
    for pick, side in ((xp.minimum, -1.0), (xp.maximum, 1.0)):
        total = pick(angles[0][0], angles[1][0]) + xp.sum(pick(angles[0][1], angles[1][1]), axis=(-2, -1))
        edges.append(xp.floor((start[..., None] + total + side * _ROUNDINGS * eps * rounding) / (2.0 * np.pi) + 0.5))
    return edges[0], edges[0] == edges[1]
