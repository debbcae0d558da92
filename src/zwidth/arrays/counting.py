"""Poles inside any circle, for any linear loop with a delay of whole periods, at a cost that no delay changes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.evaluate import join_shapes, to_caller
from zwidth.words.errors import InputError
from zwidth.words.types import Array, ArrayLike, Counts, RootsLike
from zwidth.words.xp import is_traced, namespace

# Concrete batches run in blocks of this many loops: their intermediate arrays then stay in the cache.
_BLOCK = 1 << 9
# Roundings that one factor, one sum and one logarithm may add up to; twice what a count of the operations gives.
_ROUNDINGS = 8.0
# Closer to the circle than this many units in the last place (of r^2), a complex root cannot be told in from out.
_ON_CIRCLE = 16.0


def count_poles(zeros: RootsLike, poles: RootsLike, gain: ArrayLike, lag: ArrayLike, radius: ArrayLike = 1.0) -> Counts:
    """Count the closed loop's poles inside a circle.

    Counts, with multiplicity, the zeros of

        P(z) = z^lag (z - p_1)...(z - p_k) + gain (z - b_1)...(z - b_l)

    in ``|z| < radius``: p are the poles of the open loop (device, filters), b its zeros (wall, device), lag its delay
    in whole periods. A loop is stable where the count with ``radius=1`` is ``lag + k`` (for l < lag + k).

    Args:
        zeros: b, real or complex, shape ``(..., l)``, l >= 0; conjugate pairs are usual and not needed.
        poles: p, likewise, shape ``(..., k)``. No order of l, k and lag is assumed.
        gain: factor of the zeros' product, real and finite; 0 counts ``lag`` and the p inside.
        lag: whole number, >= 0 (up to 2^52).
        radius: of the circle, > 0. It broadcasts with gain, lag and the leading axes of zeros and poles.

    Returns:
        Array of whole numbers of the broadcast shape. -1 where an argument is out of its range, and where float64
        cannot tell: a closed-loop pole closer to the circle than the rounding of its own position there (about 1e-14
        relative for one apart from others, 1e-7 for a nearly double one, more where the delay or clusters of zeros
        and poles make rounding count more), or a complex open-loop pole within about 1e-9 of the circle while
        the gain is below 1e-8. Every other number is proved as set out below.

    Raises:
        InputError: no numbers, a complex gain, lag or radius, shapes that do not broadcast, or a single number out of
            its range.

    Numerics:
        On ``z = r e^(jw)``, with ``t = tan(w/2)``, ``|z - a|^2 (1 + t^2) = |(r - a) + j t (r + a)|^2``. Hence
        ``|T|^2 - |B|^2``, for P = T + B, is a real polynomial in t of degree ``2 max(k, l)`` (over a power of 1 + t^2).
        Its zeros are companion eigenvalues with one correction by Weierstrass, each in a disk of Smith's theorem with
        the rounding added. Where no disk meets the real axis, one part is larger, and arg P keeps within a quarter turn
        of its argument. The count is that of the larger part at z = -r, plus m at every crossover to B, less m at
        every one to T, with m = round((arg T - arg B)/(2 pi)) and arguments that are continuous in w. -1 unless m is
        the same on all of a disk: crossovers that nearly coincide, or are none, then change nothing.
        Direct calls compute with NumPy, in float64; under jit or vmap the function is traced in the precision
        there, and float32 answers -1 more often. A count has no derivative.

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
    members = list(_members(list(values.values())))
    if is_traced(*members):
        xp = namespace(*members)
        traced = [xp.asarray(value, dtype=_kind(name)) for name, value in values.items()]
        return _count(_align_coefficients(traced, xp), xp)
    columns = _align_coefficients([_check_coefficients(name, value) for name, value in values.items()], np)
    shape = columns[2].shape
    size = math.prod(shape)
    columns = [column.reshape(size, *column.shape[len(shape) :]) for column in columns]
    counts = np.empty(size, np.int64)
    with np.errstate(all="ignore"):
        for start in range(0, size, _BLOCK):
            block = slice(start, start + _BLOCK)
            counts[block] = _count([column[block] for column in columns], np)
    counts = counts.reshape(shape)
    return to_caller(counts, tuple(members))


def _members(value: ArrayLike) -> Iterator[Any]:
    """Yield what lists hold: a traced number may stand among plain ones."""
    if isinstance(value, list | tuple):
        for item in value:
            yield from _members(item)
    else:
        yield value


def _kind(name: str) -> type:
    return complex if name in ("zeros", "poles") else float


def _check_coefficients(name: str, value: ArrayLike) -> np.ndarray:
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
        allowed = {
            "gain": "a finite number",
            "lag": "a whole number from 0 to 2^52",
            "radius": "a finite number above 0",
        }
        raise InputError(f"{name}: got {value!r}, {allowed[name]} is needed; in an array such a loop counts -1")
    return array


def _in_range(name: str, value: Array, xp: Any) -> Array:
    good = xp.isfinite(value)
    if name == "radius":
        return good & (value > 0)
    if name == "lag":
        return good & (value >= 0) & (value * xp.finfo(value.dtype).eps <= 1) & (value == xp.floor(value))
    return good


def _align_coefficients(arrays: list[Array], xp: Any) -> list[Array]:
    """Give every argument the common leading shape."""
    heads = [array.shape[:-1] for array in arrays[:2]] + [array.shape for array in arrays[2:]]
    shape = join_shapes(zip(("zeros", "poles", "gain", "lag", "radius"), heads, strict=True), "leading shapes")
    roots = [xp.broadcast_to(array, (*shape, array.shape[-1])) for array in arrays[:2]]
    return roots + [xp.broadcast_to(array, shape) for array in arrays[2:]]


class _Rational(NamedTuple):
    """T and B on the circle z = r (1 + jt)/(1 - jt). Last axes: part (0 is T, 1 is B), factor."""

    u: Array  # a factor z - a is (u + jtv)/(1 - jt): u = r - a, v = r + a, both over r + |a|
    v: Array
    inside: Array  # r^2 - |a|^2 over (r + |a|)^2: positive for a inside
    weight: Array  # of |T|^2 (positive) and |B|^2 (negative); the larger one is 1
    doubt: Array  # relative error of the weights, in roundings
    turns: Array  # powers of z that T has more than B
    start: Array  # arg T - arg B at w = 0


def _count(columns: list[Array], xp: Any) -> Array:
    """Count for zeros, poles, gain, lag and radius of one leading shape."""
    zeros, poles, gain, lag, radius = columns
    eps = float(xp.finfo(gain.dtype).eps)
    good = _in_range("gain", gain, xp) & _in_range("lag", lag, xp) & _in_range("radius", radius, xp)
    good = good & xp.isfinite(zeros).all(-1) & xp.isfinite(poles).all(-1)
    gain, lag, radius = xp.where(good, gain, 0.0), xp.where(good, lag, 0.0), xp.where(good, radius, 1.0)
    # Factors z make the shorter product as long as the other.
    size = max(poles.shape[-1], zeros.shape[-1])
    missing = size - poles.shape[-1], size - zeros.shape[-1]
    roots = xp.stack([_pad_roots(poles, missing[0], xp), _pad_roots(zeros, missing[1], xp)], axis=-2)
    roots = xp.where(good[..., None, None], roots, 0.0)
    turns = lag + (missing[1] - missing[0])
    loop, roots, cut = _loop(roots, gain, turns, radius, xp)
    low, high, leading, proved = _intervals(loop, eps, xp)
    met = xp.isfinite(low)
    m, clear = _count_turns(loop, low, high, eps, xp)
    b_first, before, after, told = _larger(loop, roots, low, high, leading, m, eps, xp)
    t_alone, b_alone = _alone(loop, eps, xp)

    within = (loop.inside >= 0).sum(-1)
    of_t, of_b = within[..., 0] - missing[0] + lag, within[..., 1] - missing[1]
    changes = m * (xp.where(after, 1.0, 0.0) - xp.where(before, 1.0, 0.0))
    total = xp.where(b_first, of_b, of_t) + xp.where(met, changes, 0.0).sum(-1)
    sure = proved & told & (clear | ~met).all(-1) & ~(cut & met.any(-1))
    total = xp.where(t_alone, of_t, xp.where(b_alone, of_b, total))
    return xp.where(good & (sure | t_alone | b_alone), total, -1.0).astype(int)


def _pad_roots(roots: Array, missing: int, xp: Any) -> Array:
    return xp.concatenate([roots, xp.zeros((*roots.shape[:-1], missing), roots.dtype)], axis=-1)


def _loop(roots: Array, gain: Array, turns: Array, radius: Array, xp: Any) -> tuple[_Rational, Array, Array]:
    """Scale and turn the plane; also the turned roots, and whether a weight too large or small for the type was cut."""
    r = radius[..., None, None]
    scale = r + xp.abs(roots)
    logs = xp.log(scale)
    log_gain, log_turns = xp.log(xp.where(gain == 0, 1.0, xp.abs(gain))), turns * xp.log(radius)
    # ln |B/T|^2 without the factors. Where it is cut, only a count without any crossover is used: one part is larger on
    # the whole circle already, and more so beyond the cut.
    excess = 2.0 * (log_gain - log_turns + (logs[..., 1, :] - logs[..., 0, :]).sum(-1))
    limit = 0.8 * math.log(xp.finfo(gain.dtype).max)
    cut = (gain == 0) | (xp.abs(excess) > limit)
    excess = xp.clip(xp.where(gain == 0, -limit, excess), -limit, limit)
    doubt = 2.0 * (xp.abs(log_gain) + xp.abs(log_turns) + xp.abs(logs).sum((-2, -1)) + roots.shape[-1] + 1.0)
    weight = xp.stack([xp.exp(-xp.maximum(excess, 0.0)), -xp.exp(xp.minimum(excess, 0.0))], axis=-1)

    # Quarter turns round nothing. At z = -r, where t is infinite, T and B must differ; that real data keep the relative
    # accuracy of small w unturned lets no turn come first.
    units = xp.asarray([1.0, -1.0, 1j, -1j])
    far = xp.log(xp.abs(r[..., None] + roots[..., None] * units.reshape((1,) * roots.ndim + (4,))) / scale[..., None])
    score = xp.abs(excess[..., None] + 2.0 * (far[..., 1, :, :] - far[..., 0, :, :]).sum(-2))
    best = xp.argmax(xp.minimum(xp.where(xp.isnan(score), 0.0, score), 0.1), axis=-1)
    roots = roots * units[best][..., None, None]
    u, v = (r - roots) / scale, (r + roots) / scale
    angle = xp.angle(u).sum(-1)
    quarters = xp.mod(xp.mod(turns, 4.0) * xp.asarray([0.0, 2.0, 1.0, 3.0])[best], 4.0)
    start = angle[..., 0] - angle[..., 1] - xp.where(gain < 0, math.pi, 0.0) - 0.5 * math.pi * quarters
    inside = ((r - roots.real) * (r + roots.real) - roots.imag**2) / scale**2
    return _Rational(u, v, inside, weight, doubt, turns, start), roots, cut


def _alone(loop: _Rational, eps: float, xp: Any) -> tuple[Array, Array]:
    """Whether one part is larger on the whole circle by its least and the other's largest possible size."""
    # Such loops need no crossovers, whose disks are wide where many roots coincide.
    size = xp.abs(loop.inside)  # (r - |a|)/(r + |a|), the least of |z - a| over its largest
    doubt = _ROUNDINGS * eps * (loop.doubt + (1.0 / (size + eps)).sum((-2, -1)))
    least = xp.abs(loop.weight) * (size * size).prod(-1)
    # More doubt than a tenth is a root on the circle to within rounding.
    first, second = (
        least[..., 0] > (1.0 + doubt) * -loop.weight[..., 1],
        least[..., 1] > (1.0 + doubt) * loop.weight[..., 0],
    )
    return first & (doubt < 0.1), second & (doubt < 0.1)


def _difference(loop: _Rational, t: Array, eps: float, xp: Any) -> tuple[Array, Array]:
    """|T|^2 - |B|^2 at the points t, over (1 + |t|)^(2 size), and a bound of its rounding."""
    t = t[..., None, None]
    u, v, jtv = loop.u[..., None, :, :], loop.v[..., None, :, :], 1j * t * loop.v[..., None, :, :]
    below = 1.0 + xp.abs(t)
    plus, minus = (u + jtv) / below, (xp.conj(u) - 1j * t * xp.conj(v)) / below
    worst = (xp.abs(u) + xp.abs(jtv)) / below + _smallest(xp, below)
    sizes = xp.maximum(xp.abs(plus), eps * worst), xp.maximum(xp.abs(minus), eps * worst)
    relative = (worst / sizes[0] + worst / sizes[1]).sum(-1) + loop.doubt[..., None, None]
    weight = loop.weight[..., None, :]
    noise = (xp.abs(weight) * (sizes[0] * sizes[1]).prod(-1) * relative).sum(-1)
    return (weight * (plus * minus).prod(-1)).sum(-1), _ROUNDINGS * eps * noise


def _smallest(xp: Any, like: Array) -> float:
    """Return a number far below all others that leaves quotients finite."""
    return math.sqrt(xp.finfo(like.dtype).tiny)


def _intervals(loop: _Rational, eps: float, xp: Any) -> tuple[Array, Array, Array, Array]:
    """Sorted ends of intervals of t, some infinite, that hold every crossover; the leading coefficient; if proved."""
    # The coefficients, lowest power first: products of |u + jtv|^2 = |u|^2 + 2 t Im(u conj v) + t^2 |v|^2.
    a0, a1, a2 = xp.abs(loop.u) ** 2, 2.0 * (loop.u * xp.conj(loop.v)).imag, xp.abs(loop.v) ** 2
    size = a0.shape[-1]
    count = 2 * size
    poly = xp.ones((*a0.shape[:-1], 1), a0.dtype)
    for i in range(size):
        none = xp.zeros((*poly.shape[:-1], 2), poly.dtype)
        wide = xp.concatenate([none, poly, none], axis=-1)
        b0, b1, b2 = a0[..., i : i + 1], a1[..., i : i + 1], a2[..., i : i + 1]
        poly = wide[..., 2:] * b0 + wide[..., 1:-1] * b1 + wide[..., :-2] * b2
    coefficients = (loop.weight[..., None] * poly).sum(-2)
    leading = coefficients[..., -1]
    doubt = _ROUNDINGS * eps * (xp.abs(loop.weight) * poly[..., -1]).sum(-1) * (loop.doubt + count)
    proved = xp.abs(leading) > doubt
    if not size:
        return coefficients[..., :0], coefficients[..., :0], leading, proved
    monic = coefficients[..., :-1] / xp.where(proved, leading, 1.0)[..., None]
    proved = proved & xp.isfinite(monic).all(-1)
    monic = xp.where(proved[..., None], monic, 1.0)
    # In this order of the rows, large coefficients first, small zeros beside large ones keep their digits.
    shift = xp.broadcast_to(xp.eye(count, count - 1, dtype=monic.dtype), (*monic.shape, count - 1))
    guess = xp.linalg.eigvals(xp.concatenate([-monic[..., ::-1, None], shift], axis=-1)) + 0j
    # Equal ones would divide by zero: parted as far as rounding parts a double zero.
    tied = (guess[..., :, None] == guess[..., None, :]).sum(-1) > 1
    circle = xp.asarray(np.exp(2j * np.pi * np.arange(count) / count)).astype(guess.dtype)
    circle = math.sqrt(eps) * circle.reshape((1,) * (guess.ndim - 1) + (count,))
    guess = guess + xp.where(tied, circle * xp.where(guess == 0, 1.0, xp.abs(guess)), 0.0)
    correction, _ = _corrections(loop, guess, leading, eps, xp)
    guess = xp.where(xp.isfinite(correction), guess - correction, guess)
    correction, noise = _corrections(loop, guess, leading, eps, xp)
    # The one hundredth is for the rounding of the disks themselves.
    safe = 1.01 * count * xp.abs(leading) / (xp.abs(leading) - doubt)
    disk = safe[..., None] * (xp.abs(correction) + noise)
    proved = proved & xp.isfinite(disk).all(-1)
    met = xp.abs(guess.imag) <= disk
    # Sorted apart, the ends pair to other intervals with the same union.
    low = xp.sort(xp.where(met, guess.real - disk, xp.inf), axis=-1)
    high = xp.sort(xp.where(met, guess.real + disk, xp.inf), axis=-1)
    return low, high, leading, proved


def _corrections(loop: _Rational, guess: Array, leading: Array, eps: float, xp: Any) -> tuple[Array, Array]:
    """Weierstrass: value/(leading prod(guess - other guesses)), to be subtracted, and what rounding adds to that."""
    value, noise = _difference(loop, guess, eps, xp)
    far = 1.0 + xp.abs(guess)
    apart = (guess[..., :, None] - guess[..., None, :]) / far[..., :, None]
    same = xp.eye(guess.shape[-1], dtype=bool).reshape((1,) * (guess.ndim - 1) + (guess.shape[-1],) * 2)
    scale = leading[..., None] * xp.where(same, 1.0, apart).prod(-1)
    return value * far / scale, noise * far / xp.abs(scale)


def _count_turns(loop: _Rational, low: Array, high: Array, eps: float, xp: Any) -> tuple[Array, Array]:
    """m = round((arg T - arg B)/(2 pi)) on every interval, and whether it is one number there."""
    u, v, inside = (value[..., None, :, :] for value in (loop.u, loop.v, loop.inside))
    size = xp.abs(u)
    # From t = 0 on, a factor turns by arg((u + jtv)/u), without a jump: that line meets 0 only if the root is on the
    # circle, where the limit from inside is taken.
    zero = size == 0
    rise = xp.where(zero, 1.0, inside / xp.where(zero, 1.0, size))
    slant = (u * xp.conj(v)).imag / xp.where(zero, 1.0, size)
    t = xp.concatenate([low, high], axis=-1)
    t = xp.where(xp.isfinite(t), t, 0.0)
    whole = 2.0 * loop.turns[..., None] * xp.arctan(t)
    t = t[..., None, None]
    angle = xp.arctan2(t * rise, size + t * slant)
    reach = size + xp.abs(t * v) + _smallest(xp, size)
    cond = (reach / xp.maximum(xp.abs(u + 1j * t * v), eps * reach)).sum((-2, -1))
    rounding = _ROUNDINGS * eps * (cond + xp.abs(whole) + 8.0 * u.shape[-1] + 8.0)
    n = low.shape[-1]
    rounding = xp.maximum(rounding[..., :n], rounding[..., n:])
    # Every angle is monotone in t, so that the ends bound each of them, hence their sum.
    edges = []
    for pick, other, side in ((xp.minimum, xp.maximum, -rounding), (xp.maximum, xp.minimum, rounding)):
        sums = pick(angle[..., :n, :, :], angle[..., n:, :, :]).sum(-1)[..., 0]
        sums = sums - other(angle[..., :n, :, :], angle[..., n:, :, :]).sum(-1)[..., 1]
        total = loop.start[..., None] + pick(whole[..., :n], whole[..., n:]) + sums + side
        edges.append(xp.floor(total / (2.0 * math.pi) + 0.5))
    return edges[0], edges[0] == edges[1]


def _larger(
    loop: _Rational, roots: Array, low: Array, high: Array, leading: Array, m: Array, eps: float, xp: Any
) -> tuple[Array, Array, Array, Array]:
    """Whether B is larger: at z = -r, before and after every interval; and whether all of that is told that matters."""
    first = leading < 0
    n = low.shape[-1]
    gaps = xp.isfinite(low[..., 1:])
    middle = xp.where(gaps, 0.5 * high[..., :-1] + 0.5 * low[..., 1:], 0.0)
    # A root on the circle to within rounding is as good inside as outside where its own part is the smaller one.
    on = (xp.abs(loop.inside) <= _ON_CIRCLE * eps) & (roots.imag != 0)
    length = xp.abs(roots)
    near = xp.where(roots.real >= 0, roots.imag / (length + roots.real), (length - roots.real) / roots.imag)
    near = xp.clip(xp.where(on, near, 0.0), -1e30, 1e30)
    points = xp.concatenate([middle, near[..., 0, :], near[..., 1, :]], axis=-1)
    value, noise = _difference(loop, points, eps, xp)
    value, split = value.real, middle.shape[-1]
    clear = xp.abs(value) > noise
    # Between two intervals of the same m it does not matter.
    told = (clear[..., :split] | ~gaps | (m[..., :-1] == m[..., 1:])).all(-1)
    # Half of what follows the gaps belongs to roots of T.
    half = split + near.shape[-1]
    told = told & (~on[..., 0, :] | (clear[..., split:half] & (value[..., split:half] < 0))).all(-1)
    told = told & (~on[..., 1, :] | (clear[..., half:] & (value[..., half:] > 0))).all(-1)
    larger = xp.where(gaps, value[..., :split] < 0, first[..., None])
    after = xp.concatenate([larger, first[..., None]], axis=-1)[..., :n]
    before = xp.concatenate([first[..., None], larger], axis=-1)[..., :n]
    return first, before, after, told
