"""Count the closed-loop poles inside a circle for any linear loop with an integer delay, independently of the delay.

On ``|z| = r`` the characteristic polynomial is P = T + B, with

    T = z^lag prod(z - poles)        B = gain prod(z - zeros)

By the argument principle, the count follows from the *crossovers*, the points at which ``|T| = |B|``, and from arg T -
arg B there (docs/theory/one-crossover.md, S19 to S21). With ``z = r (1 + j t)/(1 - j t)``, t = tan(w/2), the difference
``|T|^2 - |B|^2`` is a real polynomial in t, divided by a power of 1 + t^2. Its zeros are enclosed in disks; the real
*intervals* that these disks cut out contain all crossovers. A count is returned only if it is the same for every
position of the crossovers in their intervals and every rounding error. In the functions below, eps is the rounding unit
of the floating-point type, and xp is NumPy or jax.numpy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.types import Array, ArrayLike, Counts, RootsLike
from zwidth.core.xp import is_jax
from zwidth.numerics.devices import map_on_devices
from zwidth.numerics.evaluate import join_shapes, precision

# Number of loops that one NumPy call evaluates, chosen so that the intermediate arrays fit in the cache.
BLOCK_SIZE = 1 << 9
# Bound on the rounding error of a factor, a sum or a logarithm, in units of eps: twice its number of operations.
ROUNDINGS = 8.0
# Relative difference of r^2 and |root|^2, in units of eps, below which rounding errors leave open whether a complex
# root lies inside the circle.
ON_CIRCLE = 16.0


def count_poles(zeros: RootsLike, poles: RootsLike, gain: ArrayLike, lag: ArrayLike, radius: ArrayLike = 1.0) -> Counts:
    """Count the closed-loop poles inside a circle.

    The count is the number, with multiplicity, of zeros of

        P(z) = z^lag (z - p_1)...(z - p_k) + gain (z - b_1)...(z - b_l)

    in ``|z| < radius``: p are the poles of the open loop (device, filters), b its zeros (wall, device), and lag its
    integer delay in periods. For l < lag + k, a loop is stable if and only if the count with ``radius=1`` is
    ``lag + k``.

    Args:
        zeros: b, real or complex, shape ``(..., l)``, l >= 0; conjugate pairs are usual, but not required.
        poles: p, likewise, shape ``(..., k)``. l, k and lag may have any order.
        gain: factor of the product of the zeros, real and finite; for 0 the result counts ``lag`` and the p inside.
        lag: integer >= 0 (up to 2^52).
        radius: of the circle, > 0. It broadcasts with gain, lag and the leading axes of zeros and poles.

    Returns:
        Array of integers of the broadcast shape. -1 for an argument out of range, and if float64 cannot decide: a
        closed-loop pole is closer to the circle than the rounding error of its own position (about 1e-14 relative for
        an isolated pole, 1e-7 for a nearly double one, more for long delays and clusters of zeros and poles), or a
        complex open-loop pole is within about 1e-9 of the circle while the gain is below 1e-8. All other counts are
        certified as described below.

    Raises:
        InputError: for non-numeric arguments, complex gain, lag or radius, shapes that do not broadcast, or a single
            number out of range.

    Numerics:
        On ``z = r e^(jw)``, with ``t = tan(w/2)``, ``|z - a|^2 (1 + t^2) = |(r - a) + j t (r + a)|^2``. Hence
        ``|T|^2 - |B|^2``, for P = T + B, is a real polynomial in t of degree ``2 max(k, l)``, divided by a power of
        1 + t^2. Its zeros are companion eigenvalues with one Weierstrass correction, each enclosed in a disk by Smith's
        theorem, enlarged by the rounding errors. Where no disk meets the real axis, one part is larger, and arg P
        differs from its argument by at most pi/2. The count is that of the larger part at z = -r, plus m at each
        crossover to B, minus m at each crossover to T, with m = round((arg T - arg B)/(2 pi)) and arguments that are
        continuous in w. The result is -1 unless m is constant on a disk; then nearly coincident crossovers have no net
        effect. Direct calls compute in float64; JAX arrays are computed on their own devices. Under jit or vmap the
        number type is JAX's default; with float32, the result is -1 more often. A count has no derivative.

    References:
        Walton, Marshall 1987, IEE Proc. D 134 (crossovers of loops with delay), Nyquist 1932, Bell Syst. Tech. J. 11.
        Smith 1970, J. ACM 17 (disks around zeros).

    Example:
        >>> import zwidth
        >>> print(zwidth.count_poles([0.8], [1.0, 0.9], gain=0.01, lag=3))
        5
        >>> print(zwidth.count_poles([0.8], [1.0, 0.9], gain=0.01, lag=[20, 100_000]))
        [   22 99374]
    """
    values = {"zeros": zeros, "poles": poles, "gain": gain, "lag": lag, "radius": radius}
    members = list(_iterate_members(list(values.values())))
    if any(map(is_jax, members)):
        return _count_jax_arrays(values, members)
    columns = _align_coefficients([_check_coefficients(name, value) for name, value in values.items()], np)
    shape = columns[2].shape
    size = math.prod(shape)
    columns = [column.reshape(size, *column.shape[len(shape) :]) for column in columns]
    counts = np.empty(size, np.int64)
    with np.errstate(all="ignore"):
        for start in range(0, size, BLOCK_SIZE):
            block = slice(start, start + BLOCK_SIZE)
            counts[block] = _count([column[block] for column in columns], np)
    return counts.reshape(shape)[()]


def _count_jax_arrays(values: dict[str, Any], members: list[Any]) -> Counts:
    """Return the pole counts, computed by code that JAX compiles; at least one argument is a JAX array."""
    import jax.numpy as jnp

    arrays = []
    for name, value in values.items():
        kind = _get_type(name)
        if not any(map(is_jax, _iterate_members(value))):
            value = _check_coefficients(name, value)
        elif kind is float and any(jnp.iscomplexobj(member) for member in _iterate_members(value)):
            raise InputError(f"{name}: got complex numbers; real numbers are needed")
        arrays.append((value, kind))
    with precision(members):
        columns = [jnp.asarray(value, dtype=jnp.result_type(kind)) for value, kind in arrays]
        return map_on_devices(_compile_count(), _align_coefficients(columns, jnp))


@cache
def _compile_count() -> Any:
    """Return `_count`, compiled by JAX as one program; without jit, JAX would compile its 700 operations one by one."""
    import jax

    return jax.jit(lambda *columns: _count(list(columns), jax.numpy))


def _iterate_members(value: ArrayLike) -> Iterator[Any]:
    """Yield a single value, or each number of nested lists, because a list may mix traced and plain numbers."""
    if isinstance(value, list | tuple):
        for item in value:
            yield from _iterate_members(item)
    else:
        yield value


def _get_type(name: str) -> type:
    """Return the number type of an argument of `count_poles`: complex for zeros and poles, otherwise float."""
    return complex if name in ("zeros", "poles") else float


def _check_coefficients(name: str, value: ArrayLike) -> np.ndarray:
    """Convert an argument of `count_poles` that is not traced to an array; raise `InputError` if it is not allowed."""
    kind = _get_type(name)
    description = "real or complex" if kind is complex else "real"
    try:
        array = np.asarray(value)
        if array.dtype.kind not in ("biufc" if kind is complex else "biuf"):
            raise TypeError(array.dtype)
        array = array.astype(kind)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: got {value!r}, a rectangular array of {description} numbers is needed") from error
    if kind is complex:
        if array.ndim == 0:
            raise InputError(f"{name}: got {value!r}, a sequence of numbers is needed; write [{value!r}] for one")
        return array
    if array.ndim == 0 and not _is_in_range(name, array, np):
        allowed = {
            "gain": "a finite number",
            "lag": "a whole number from 0 to 2^52",
            "radius": "a finite number above 0",
        }
        raise InputError(f"{name}: got {value!r}, {allowed[name]} is needed; in arrays the count of such a loop is -1")
    return array


def _is_in_range(name: str, value: Array, xp: Any) -> Array:
    """Return a boolean array that is True where the values of the argument ``name`` of `count_poles` are in range."""
    good = xp.isfinite(value)
    if name == "radius":
        return good & (value > 0)
    if name == "lag":
        return good & (value >= 0) & (value * xp.finfo(value.dtype).eps <= 1) & (value == xp.floor(value))
    return good


def _align_coefficients(arrays: list[Array], xp: Any) -> list[Array]:
    """Broadcast zeros, poles, gain, lag and radius to a common leading shape; zeros and poles keep their last axis."""
    heads = [array.shape[:-1] for array in arrays[:2]] + [array.shape for array in arrays[2:]]
    shape = join_shapes(zip(("zeros", "poles", "gain", "lag", "radius"), heads, strict=True), "leading shapes")
    roots = [xp.broadcast_to(array, (*shape, array.shape[-1])) for array in arrays[:2]]
    return roots + [xp.broadcast_to(array, shape) for array in arrays[2:]]


class _CircleParts(NamedTuple):
    """Scaled factors of T and B on the circle z = r (1 + j t)/(1 - j t); last axes: part (0: T, 1: B) and factor.

    For a root a, a factor is ``z - a = (u + j t v)/(1 - j t)``, up to its scale r + |a|.
    """

    u: Array  # (r - a)/(r + |a|)
    v: Array  # (r + a)/(r + |a|)
    inside: Array  # (r^2 - |a|^2)/(r + |a|)^2; positive for a inside the circle
    weight: Array  # factors of |T|^2 (positive) and |B|^2 (negative); the larger magnitude is 1
    uncertainty: Array  # relative error of the weights, in units of the rounding error
    exponent: Array  # power of z in T minus that in B
    start: Array  # arg T - arg B at w = 0


def _count(columns: list[Array], xp: Any) -> Array:
    """Return the number of closed-loop poles inside the circle, or -1 if it cannot be certified.

    Args:
        columns: zeros, poles, gain, lag and radius, with equal leading shapes.
        xp: NumPy or jax.numpy.
    """
    zeros, poles, gain, lag, radius = columns
    eps = float(xp.finfo(gain.dtype).eps)
    good = _is_in_range("gain", gain, xp) & _is_in_range("lag", lag, xp) & _is_in_range("radius", radius, xp)
    good = good & xp.isfinite(zeros).all(-1) & xp.isfinite(poles).all(-1)
    gain, lag, radius = xp.where(good, gain, 0.0), xp.where(good, lag, 0.0), xp.where(good, radius, 1.0)
    # Give both products the same number of factors: multiply the shorter product by a power of z (roots at 0).
    size = max(poles.shape[-1], zeros.shape[-1])
    missing = size - poles.shape[-1], size - zeros.shape[-1]
    roots = xp.stack([_pad_roots(poles, missing[0], xp), _pad_roots(zeros, missing[1], xp)], axis=-2)
    roots = xp.where(good[..., None, None], roots, 0.0)
    exponent = lag + (missing[1] - missing[0])
    loop, roots, clipped = _scale_parts(roots, gain, exponent, radius, xp)
    low, high, leading, proved = _enclose_crossovers(loop, eps, xp)
    exists = xp.isfinite(low)
    m, is_unique = _count_turns(loop, low, high, eps, xp)
    b_first, before, after, decided = _compare_parts(loop, roots, low, high, leading, m, eps, xp)
    t_dominates, b_dominates = _find_dominant(loop, eps, xp)

    within = (loop.inside >= 0).sum(-1)
    of_t, of_b = within[..., 0] - missing[0] + lag, within[..., 1] - missing[1]
    changes = m * (xp.where(after, 1.0, 0.0) - xp.where(before, 1.0, 0.0))
    total = xp.where(b_first, of_b, of_t) + xp.where(exists, changes, 0.0).sum(-1)
    certain = proved & decided & (is_unique | ~exists).all(-1) & ~(clipped & exists.any(-1))
    total = xp.where(t_dominates, of_t, xp.where(b_dominates, of_b, total))
    return xp.where(good & (certain | t_dominates | b_dominates), total, -1.0).astype(int)


def _pad_roots(roots: Array, missing: int, xp: Any) -> Array:
    """Return the roots with ``missing`` further roots at z = 0 along the last axis."""
    return xp.concatenate([roots, xp.zeros((*roots.shape[:-1], missing), roots.dtype)], axis=-1)


def _scale_parts(
    roots: Array, gain: Array, exponent: Array, radius: Array, xp: Any
) -> tuple[_CircleParts, Array, Array]:
    """Scale T and B to avoid overflow, and rotate the z plane by a multiple of 90 degrees.

    After the rotation ``|T|`` and ``|B|`` differ at z = -r, where t is infinite.

    Returns:
        The scaled parts, the rotated roots, and whether a weight was clipped because it over- or underflows.
    """
    r = radius[..., None, None]
    scale = r + xp.abs(roots)
    logs = xp.log(scale)
    log_gain, log_power = xp.log(xp.where(gain == 0, 1.0, xp.abs(gain))), exponent * xp.log(radius)
    # Compute ln |B/T|^2 without the scaled factors. If this logarithm is clipped, use only a count without crossovers:
    # a part that is larger on the whole circle with the clipped weight is also larger with the true weight.
    excess = 2.0 * (log_gain - log_power + (logs[..., 1, :] - logs[..., 0, :]).sum(-1))
    limit = 0.8 * math.log(xp.finfo(gain.dtype).max)
    clipped = (gain == 0) | (xp.abs(excess) > limit)
    excess = xp.clip(xp.where(gain == 0, -limit, excess), -limit, limit)
    uncertainty = 2.0 * (xp.abs(log_gain) + xp.abs(log_power) + xp.abs(logs).sum((-2, -1)) + roots.shape[-1] + 1.0)
    weight = xp.stack([xp.exp(-xp.maximum(excess, 0.0)), -xp.exp(xp.minimum(excess, 0.0))], axis=-1)

    # Choose the rotation for which the ratio of |T| and |B| at z = -r, where t is infinite, differs most from 1.
    # Multiples of 90 degrees have no rounding error. Ratios above a limit are treated as equal, which favors the first
    # candidate, no rotation, because unrotated real data keep their relative accuracy at small w.
    units = xp.asarray([1.0, -1.0, 1j, -1j])
    far = xp.log(xp.abs(r[..., None] + roots[..., None] * units.reshape((1,) * roots.ndim + (4,))) / scale[..., None])
    score = xp.abs(excess[..., None] + 2.0 * (far[..., 1, :, :] - far[..., 0, :, :]).sum(-2))
    best = xp.argmax(xp.minimum(xp.where(xp.isnan(score), 0.0, score), 0.1), axis=-1)
    roots = roots * units[best][..., None, None]
    u, v = (r - roots) / scale, (r + roots) / scale
    angle = xp.angle(u).sum(-1)
    quarters = xp.mod(xp.mod(exponent, 4.0) * xp.asarray([0.0, 2.0, 1.0, 3.0])[best], 4.0)
    start = angle[..., 0] - angle[..., 1] - xp.where(gain < 0, math.pi, 0.0) - 0.5 * math.pi * quarters
    inside = ((r - roots.real) * (r + roots.real) - roots.imag**2) / scale**2
    return _CircleParts(u, v, inside, weight, uncertainty, exponent, start), roots, clipped


def _find_dominant(loop: _CircleParts, eps: float, xp: Any) -> tuple[Array, Array]:
    """Return two masks: |T| > |B|, and |B| > |T|, proved on the whole circle by bounds on every factor.

    Such loops need no crossovers, whose disks are wide if many roots coincide.
    """
    size = xp.abs(loop.inside)  # (r - |a|)/(r + |a|), the ratio of the least and the largest |z - a| on the circle
    error = ROUNDINGS * eps * (loop.uncertainty + (1.0 / (size + eps)).sum((-2, -1)))
    least = xp.abs(loop.weight) * (size * size).prod(-1)
    # Reject an error bound above 0.1, because a root then lies on the circle to within rounding errors.
    first, second = (
        least[..., 0] > (1.0 + error) * -loop.weight[..., 1],
        least[..., 1] > (1.0 + error) * loop.weight[..., 0],
    )
    return first & (error < 0.1), second & (error < 0.1)


def _evaluate_difference(loop: _CircleParts, t: Array, eps: float, xp: Any) -> tuple[Array, Array]:
    """Return ``|T|^2 - |B|^2`` at points t, scaled to avoid overflow, and a bound on its rounding error.

    The scale is ``(1 + |t|)^(2 size)`` with the number ``size`` of factors of T or B.
    """
    t = t[..., None, None]
    u, v, jtv = loop.u[..., None, :, :], loop.v[..., None, :, :], 1j * t * loop.v[..., None, :, :]
    scale = 1.0 + xp.abs(t)
    plus, minus = (u + jtv) / scale, (xp.conj(u) - 1j * t * xp.conj(v)) / scale
    worst = (xp.abs(u) + xp.abs(jtv)) / scale + _get_smallest(xp, scale)
    sizes = xp.maximum(xp.abs(plus), eps * worst), xp.maximum(xp.abs(minus), eps * worst)
    relative = (worst / sizes[0] + worst / sizes[1]).sum(-1) + loop.uncertainty[..., None, None]
    weight = loop.weight[..., None, :]
    noise = (xp.abs(weight) * (sizes[0] * sizes[1]).prod(-1) * relative).sum(-1)
    return (weight * (plus * minus).prod(-1)).sum(-1), ROUNDINGS * eps * noise


def _get_smallest(xp: Any, like: Array) -> float:
    """Return a tiny positive number, in the precision of ``like``, to be added to terms of quotients to avoid 0/0."""
    return math.sqrt(xp.finfo(like.dtype).tiny)


def _enclose_crossovers(loop: _CircleParts, eps: float, xp: Any) -> tuple[Array, Array, Array, Array]:
    """Compute intervals of t that together contain all crossovers.

    Returns:
        The sorted lower and upper ends of the intervals, infinite for unused ones; the leading coefficient of
        ``|T|^2 - |B|^2``; and whether the enclosure is proved.
    """
    # Compute the coefficients of |T|^2 - |B|^2, lowest power first, from products of the factors
    # |u + jtv|^2 = |u|^2 + 2 t Im(u conj v) + t^2 |v|^2.
    a0, a1, a2 = xp.abs(loop.u) ** 2, 2.0 * (loop.u * xp.conj(loop.v)).imag, xp.abs(loop.v) ** 2
    size = a0.shape[-1]
    count = 2 * size
    poly = xp.ones((*a0.shape[:-1], 1), a0.dtype)
    for i in range(size):
        none = xp.zeros((*poly.shape[:-1], 2), poly.dtype)
        padded = xp.concatenate([none, poly, none], axis=-1)
        b0, b1, b2 = a0[..., i : i + 1], a1[..., i : i + 1], a2[..., i : i + 1]
        poly = padded[..., 2:] * b0 + padded[..., 1:-1] * b1 + padded[..., :-2] * b2
    coefficients = (loop.weight[..., None] * poly).sum(-2)
    leading = coefficients[..., -1]
    error = ROUNDINGS * eps * (xp.abs(loop.weight) * poly[..., -1]).sum(-1) * (loop.uncertainty + count)
    proved = xp.abs(leading) > error
    if not size:
        return coefficients[..., :0], coefficients[..., :0], leading, proved
    monic = coefficients[..., :-1] / xp.where(proved, leading, 1.0)[..., None]
    proved = proved & xp.isfinite(monic).all(-1)
    monic = xp.where(proved[..., None], monic, 1.0)
    # Arrange the coefficients in the companion matrix by descending powers, because this order keeps the relative
    # accuracy of small zeros next to large ones.
    shift = xp.broadcast_to(xp.eye(count, count - 1, dtype=monic.dtype), (*monic.shape, count - 1))
    guess = xp.linalg.eigvals(xp.concatenate([-monic[..., ::-1, None], shift], axis=-1)) + 0j
    # Separate equal eigenvalues by as much as rounding errors separate a double zero, because the correction divides by
    # their differences.
    tied = (guess[..., :, None] == guess[..., None, :]).sum(-1) > 1
    circle = xp.asarray(np.exp(2j * np.pi * np.arange(count) / count)).astype(guess.dtype)
    circle = math.sqrt(eps) * circle.reshape((1,) * (guess.ndim - 1) + (count,))
    guess = guess + xp.where(tied, circle * xp.where(guess == 0, 1.0, xp.abs(guess)), 0.0)
    correction, _ = _compute_corrections(loop, guess, leading, eps, xp)
    guess = xp.where(xp.isfinite(correction), guess - correction, guess)
    correction, noise = _compute_corrections(loop, guess, leading, eps, xp)
    # Enlarge the disks by a factor of 1.01, because their radii have rounding errors.
    safe = 1.01 * count * xp.abs(leading) / (xp.abs(leading) - error)
    disk = safe[..., None] * (xp.abs(correction) + noise)
    proved = proved & xp.isfinite(disk).all(-1)
    is_real = xp.abs(guess.imag) <= disk
    # Sort the lower and the upper ends separately. This may change the pairs of ends but not the union of the
    # intervals.
    low = xp.sort(xp.where(is_real, guess.real - disk, xp.inf), axis=-1)
    high = xp.sort(xp.where(is_real, guess.real + disk, xp.inf), axis=-1)
    return low, high, leading, proved


def _compute_corrections(loop: _CircleParts, guess: Array, leading: Array, eps: float, xp: Any) -> tuple[Array, Array]:
    """Return the Weierstrass corrections ``value/(leading prod(guess - other guesses))`` and their rounding errors.

    The corrections are to be subtracted from the guesses.
    """
    value, noise = _evaluate_difference(loop, guess, eps, xp)
    size = 1.0 + xp.abs(guess)
    differences = (guess[..., :, None] - guess[..., None, :]) / size[..., :, None]
    same = xp.eye(guess.shape[-1], dtype=bool).reshape((1,) * (guess.ndim - 1) + (guess.shape[-1],) * 2)
    scale = leading[..., None] * xp.where(same, 1.0, differences).prod(-1)
    return value * size / scale, noise * size / xp.abs(scale)


def _count_turns(loop: _CircleParts, low: Array, high: Array, eps: float, xp: Any) -> tuple[Array, Array]:
    """Return m = round((arg T - arg B)/(2 pi)) on each interval of t, and whether m is provably constant on it."""
    u, v, inside = (value[..., None, :, :] for value in (loop.u, loop.v, loop.inside))
    size = xp.abs(u)
    # Between 0 and t, the argument of a factor changes by arg((u + jtv)/u). The change is continuous unless the line
    # u + jtv contains 0, which requires a root on the circle; in this case use the limit for roots inside the circle.
    zero = size == 0
    rise = xp.where(zero, 1.0, inside / xp.where(zero, 1.0, size))
    slant = (u * xp.conj(v)).imag / xp.where(zero, 1.0, size)
    t = xp.concatenate([low, high], axis=-1)
    t = xp.where(xp.isfinite(t), t, 0.0)
    power_angle = 2.0 * loop.exponent[..., None] * xp.arctan(t)
    t = t[..., None, None]
    angle = xp.arctan2(t * rise, size + t * slant)
    reach = size + xp.abs(t * v) + _get_smallest(xp, size)
    condition = (reach / xp.maximum(xp.abs(u + 1j * t * v), eps * reach)).sum((-2, -1))
    rounding = ROUNDINGS * eps * (condition + xp.abs(power_angle) + 8.0 * u.shape[-1] + 8.0)
    n = low.shape[-1]
    rounding = xp.maximum(rounding[..., :n], rounding[..., n:])
    # Bound arg T - arg B on each interval by the sums of the bounds of all factors. The argument of each factor is
    # monotone in t, so its values at both ends of the interval bound it.
    edges = []
    for pick, other, side in ((xp.minimum, xp.maximum, -rounding), (xp.maximum, xp.minimum, rounding)):
        sums = pick(angle[..., :n, :, :], angle[..., n:, :, :]).sum(-1)[..., 0]
        sums = sums - other(angle[..., :n, :, :], angle[..., n:, :, :]).sum(-1)[..., 1]
        total = loop.start[..., None] + pick(power_angle[..., :n], power_angle[..., n:]) + sums + side
        edges.append(xp.floor(total / (2.0 * math.pi) + 0.5))
    return edges[0], edges[0] == edges[1]


def _compare_parts(
    loop: _CircleParts, roots: Array, low: Array, high: Array, leading: Array, m: Array, eps: float, xp: Any
) -> tuple[Array, Array, Array, Array]:
    """Determine whether |B| or |T| is larger before, between and after the intervals of the crossovers.

    Returns:
        Whether B is the larger part at z = -r, before every interval, and after every interval; and whether every
        comparison that affects the count is certain.
    """
    first = leading < 0
    n = low.shape[-1]
    gaps = xp.isfinite(low[..., 1:])
    middle = xp.where(gaps, 0.5 * high[..., :-1] + 0.5 * low[..., 1:], 0.0)
    # A root on the circle, to within rounding errors, may be counted as inside or outside. The choice does not affect
    # the result if the part to which the root belongs (T or B) is the smaller one at this root. Therefore compare the
    # parts at these roots as well.
    on_circle = (xp.abs(loop.inside) <= ON_CIRCLE * eps) & (roots.imag != 0)
    length = xp.abs(roots)
    near = xp.where(roots.real >= 0, roots.imag / (length + roots.real), (length - roots.real) / roots.imag)
    near = xp.clip(xp.where(on_circle, near, 0.0), -1e30, 1e30)
    points = xp.concatenate([middle, near[..., 0, :], near[..., 1, :]], axis=-1)
    value, noise = _evaluate_difference(loop, points, eps, xp)
    value, split = value.real, middle.shape[-1]
    clear = xp.abs(value) > noise
    # Between two intervals with equal m the comparison need not be certain, because it does not affect the count.
    certain = (clear[..., :split] | ~gaps | (m[..., :-1] == m[..., 1:])).all(-1)
    # The entries after those of the gaps belong to the roots on the circle: first the roots of T, then those of B.
    half = split + near.shape[-1]
    certain = certain & (~on_circle[..., 0, :] | (clear[..., split:half] & (value[..., split:half] < 0))).all(-1)
    certain = certain & (~on_circle[..., 1, :] | (clear[..., half:] & (value[..., half:] > 0))).all(-1)
    larger = xp.where(gaps, value[..., :split] < 0, first[..., None])
    after = xp.concatenate([larger, first[..., None]], axis=-1)[..., :n]
    before = xp.concatenate([first[..., None], larger], axis=-1)[..., :n]
    return first, before, after, certain
