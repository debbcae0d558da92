"""How fast a loop settles, with relative accuracy even where the spectral radius rounds to 1."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.arrays.batching import broadcast, elementwise, to_caller
from zwidth.arrays.double_double import Complex, Double, phi_pair, select, single, two_sum
from zwidth.arrays.xp import is_traced
from zwidth.loops.domain import check_scalars
from zwidth.loops.rigid.circle import count, factor_loop
from zwidth.loops.rigid.crossover import stable_kernel
from zwidth.loops.rigid.degrees import NAMES
from zwidth.loops.rigid.delay_classes import classify_delays
from zwidth.loops.rigid.outermost_poles import OutermostPoles, outermost_poles, usable
from zwidth.loops.rigid.pole_search import traced_kernel, window
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike

# A bound of rounding errors over the rate, many times what they are: smaller ones leave the digits promised.
_EXACT = 5e-12
_PIECE = 1 << 14
_STEPS = 24
# Errors over the rate with which its pole need not move on, and those that leave it the digits promised.
_ARRIVED, _PROMISED = 1e-14, 2e-11
# Half a unit of the digits of pairs, with room for all operations of a part; what numbers lose that are too small.
_LAST = 2.0**-103
_TINY = 1e-300
# An error of the radius this small beside the rate leaves no doubt which pole decays most slowly.
_SURELY = 1e-3
_ACCURACY = 1e-9
# Rivals are looked for where the error of the radius is below this.
_NEARBY = 1e-6
# Farther from the unit circle (in the logarithm of the radius) the verdict does not err.
_DOUBTFUL = 1e-8
# OutermostPoles so near to the real axis are taken for single ones; a pair is then a crowd.
_REAL = 1e-6
# So near to 1, in units of what the delay allows, P is known well enough by its second order.
_CLOSE = 0.1


def decay_rate(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """Return how fast the slowest motion of the loop decays: ``-ln(rho)`` per period, rho the spectral radius.

    After k periods a disturbance has decayed to about ``exp(-decay_rate k)``. The time constant is ``1/decay_rate``
    periods, the stability margin ``1 - rho = -expm1(-decay_rate)``.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not (held). All four broadcast.

    Returns:
        Array of the broadcast shape, per period: positive exactly where `zwidth.is_stable` says so, 0 with a pole at 1,
        negative where the motion grows. NaN for a point out of range, where it is not known which of several poles is
        the slowest, where its digits are not (next to multiple poles, or beyond the 31 digits used), and where the
        verdict, within its rounding of the boundary, is on the other side.

    Raises:
        InputError: an argument is no real number or a scalar out of range, or shapes do not broadcast.

    Numerics:
        Relative, not absolute accuracy, 1e-10 or better, however slow the decay: the outermost pole as for
        `zwidth.spectral_radius`, Newton steps with residuals of 31 digits, and an error bound by N |P/P'|. Where a
        count cannot exclude a second pole of nearly that size, all that are near the circle are compared. Inside `jit`
        the same in the ambient precision, without the last steps: absolute accuracy only.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17); Dekker 1971 (residuals of twice the digits).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.decay_rate(1e-15, 1e-9, 1e-9, 1):.6e}")
        9.999993e-10
    """
    values = (alpha, beta, delta, d)
    check_scalars(alpha=alpha, beta=beta, delta=delta, d=d)
    if is_traced(*values):
        fraction = is_traced(d) or bool(np.any(np.asarray(d, float) % 1.0))
        return -elementwise(traced_kernel, NAMES, values, (fraction,))
    arrays = broadcast(NAMES, values)
    columns, status = usable([array.reshape(-1) for array in arrays])
    rate = rates(outermost_poles(columns, _ACCURACY), columns)
    rate[status != Status.OK] = np.nan
    return to_caller(rate.reshape(arrays[0].shape), values)


def rates(found: OutermostPoles, columns: list[np.ndarray]) -> np.ndarray:
    """The rates of decay of outermost poles, with relative accuracy; NaN where it is not known which decays slowest."""
    rate = -found.re
    # What float64 knows well enough needs no more digits.
    vague = found.doubt > _EXACT * np.abs(rate)
    loose = np.isinf(found.doubt) | (window(found.re, _ACCURACY) > _PROMISED * np.abs(rate))
    held = columns[3] % 1.0 != 0.0
    with np.errstate(all="ignore"):
        for part in _pieces(vague):
            walls = [column[part] for column in columns]
            new, error = _refine_poles(_Factors.of(*walls), _beyond_one(found.re[part], found.im[part]))
            # A pole at 1 stays there.
            at_one = (walls[0] == 0) & (found.re[part] == 0)
            rate[part] = np.where(at_one, 0.0, np.where(error <= _PROMISED * np.abs(new), new, np.nan))
        for kind in (False, True):
            for part in _pieces(loose & (held == kind)):
                loop = factor_loop(*(column[part] for column in columns), fractional=kind)
                # Whether a count proves that no other pole is nearly as large.
                seen = count(found.re[part] - window(found.re[part], _ACCURACY), loop, kind)
                alone = seen.sure & (seen.missing == np.where(np.sin(found.im[part]) < _REAL, 1, 2))
                crowd = part[~alone | np.isinf(found.doubt[part])]
                if crowd.size:
                    rate[crowd] = _slowest(rate[crowd], found.re[crowd], [column[crowd] for column in columns], kind)
    # The steps must have stayed at the pole whose size is proved.
    known = np.abs(rate + found.re) <= found.error
    known &= (found.error <= _NEARBY) | (found.error < _SURELY * np.abs(rate))
    rate[~known] = np.nan
    # No two functions contradict each other: next to the boundary the verdict is within its rounding, too.
    near = np.flatnonzero(np.abs(rate) <= _DOUBTFUL)
    walls = [column[near] for column in columns]
    with np.errstate(all="ignore"):
        stable = np.asarray(stable_kernel(*walls, kind=classify_delays(walls[3])))
    rate[near[stable != (rate[near] > 0)]] = np.nan
    return rate


def _pieces(which: np.ndarray) -> list[np.ndarray]:
    """The places where it is true, by so many that what they need stays in the cache."""
    places = np.flatnonzero(which)
    return [places[start : start + _PIECE] for start in range(0, places.size, _PIECE)]


def _beyond_one(re: Array, im: Array) -> Array:
    """``e^(re + j im) - 1``."""
    half, size = np.sin(0.5 * im), np.exp(re)
    return (np.expm1(re) - 2.0 * size * half * half) + 1j * (size * np.sin(im))


def _slowest(rate: Array, re: Array, walls: list[np.ndarray], kind: bool) -> Array:
    """The rates of the slowest motions where several poles may be of one size."""
    factors = _Factors.of(*walls)
    # On a circle poles are where both parts of P are equally large, or real.
    close, turn = factors.next_to_one(), 0.0 * re + np.pi
    real = np.where(np.abs(close) * factors.turns < _CLOSE, close, np.expm1(re))
    starts = (
        real,
        *(_beyond_one(re, w) for w in (turn, *count(re, factor_loop(*walls, fractional=kind), kind).crossings)),
    )
    rivals = [_refine_poles(factors, start) for start in starts]
    for new, error in rivals:
        rate = np.where((error <= _PROMISED * np.abs(new)) & ~(new > rate), new, rate)
    for new, error in rivals:
        # What is not near to any pole is no rival.
        slower = (error < _NEARBY) & (new - error < rate - _PROMISED * np.abs(rate))
        rate = np.where(slower & ~(error <= _PROMISED * np.abs(new)), np.nan, rate)
    return rate


class _Factors(NamedTuple):
    """P at z = 1 + zeta: ``z^turns zeta (zeta + em) + N (alpha + s zeta)``, ``N = phi1 + lead zeta + bend zeta^2``.

    N is z M of a held delay, M of a whole one. Since em = phi1 delta, P is also ``alpha N + zeta (phi1 b + zeta Q)``
    with ``Q = 1 + G (zeta + em) + s (lead + bend zeta)``, ``G = (z^turns - 1)/zeta`` and ``b = s + delta``, where
    nothing cancels next to z = 1.
    """

    alpha: Array
    s: Double  # alpha + beta
    b: Double
    turns: Array
    em: Double
    phi1: Double
    lead: Double
    bend: Double

    @classmethod
    def of(cls, alpha: Array, beta: Array, delta: Array, d: Array) -> _Factors:
        """Those of walls."""
        f = d % 1.0
        b = two_sum(beta, delta).plus(single(alpha))
        return cls(alpha, two_sum(alpha, beta), b, np.floor(d) + 1.0 + (f != 0), *_plant(delta, f))

    def next_to_one(self) -> Array:
        """The larger zero, or one of a pair, of P to second order in zeta."""
        constant, lead = self.alpha * self.phi1.high, self.lead.high
        linear = self.phi1.high * self.b.high + self.alpha * lead
        bend = 1.0 + self.turns * self.em.high + lead * self.s.high + self.alpha * self.bend.high
        root = np.sqrt(linear * linear - 4.0 * bend * constant + 0j)
        away = np.where(linear < 0, -linear + root, -2.0 * constant / (0.5 * (linear + root)))
        return np.where(root.imag != 0, 0.5 * (root - linear) / bend, 0.5 * away / np.where(linear < 0, bend, 1.0))


def _refine_poles(at: _Factors, zeta: Array) -> tuple[Array, Array]:
    """``-log |z|`` of the pole next to ``1 + zeta`` and a bound of its error."""
    here, rate, error = Complex(single(zeta.real), single(zeta.imag)), np.full(zeta.shape, np.nan), np.inf
    for _ in range(_STEPS):
        step, new, wide = _step(at, here)
        # What has arrived stays: a point's value must not depend on how long its neighbors take.
        moving = ~(error <= _ARRIVED * np.abs(rate))
        if not np.any(moving):
            break
        better = moving & (wide < error)
        rate, error = np.where(better, new, rate), np.where(better, wide, error)
        here = here.plus(Complex(single(np.real(step)), single(np.imag(step))))
    return rate, error


def _step(at: _Factors, here: Complex) -> tuple[Array, Array, Array]:
    """Newton's step from ``1 + here``; ``-log |z|`` here, and how far that of a pole is from it at most."""
    zeta, one, alpha = here.rounded, single(np.ones(here.re.high.shape)), at.alpha
    z, g = here.shifted(one), here.grown(at.turns)
    inner = here.stretched(at.bend).shifted(at.lead)
    tail = here.shifted(at.em).times(g).plus(inner.stretched(at.s)).shifted(one)
    plant = inner.times(here).shifted(at.phi1)
    value = here.times(tail).shifted(at.phi1.times(at.b)).times(here).plus(plant.stretched(single(alpha))).rounded
    # The derivative needs no more than float64.
    lean, z1, size = inner.rounded, z.rounded, np.abs(zeta)
    r, turned, steep = np.abs(z1), (1.0 + zeta * g.rounded) * zeta, lean + at.bend.high * zeta
    em, s, b = at.em.high, at.s.high, at.phi1.high * at.b.high
    parts = turned * (at.turns * (zeta + em) / z1 + 2.0), b + 0j, zeta * em * g.rounded, zeta * lean * s
    parts = *parts, steep * alpha, steep * zeta * s
    slope, count = sum(parts), at.turns + 8.0
    # What rounding errors may add up to: of G in units of its largest part.
    growth = np.minimum(at.turns, 2.0 / size) * np.maximum(1.0, r**at.turns)
    sizes = np.abs(b) + size * (1.0 + growth * (size + em) + np.abs(lean * s))
    sizes = size * sizes + np.abs(plant.rounded * alpha)
    steepness = np.abs(slope) - 2.0**-50 * count * sum(map(np.abs, parts))
    # A polynomial of degree N has a zero within N |P/P'| of any point.
    within = (at.turns + 2.0) * (np.abs(value) + _LAST * count * sizes + _TINY) / steepness
    # |z|^2 - 1 = 2 Re zeta + |zeta|^2
    beyond = here.re.scaled(2.0).plus(here.re.times(here.re)).plus(here.im.times(here.im))
    rate = -0.5 * np.log1p(beyond.high) - 0.5 * beyond.low / (1.0 + beyond.high)
    error = within / r + _LAST * (np.abs(here.re.high) + size * size)
    # A circle with z = 1 inside says nothing: steps towards two poles there take long.
    error = np.where((steepness > 0) & (error < 0.5 * size), error, np.inf)
    step = -value / slope
    # Not to another pole, far away.
    step = step * np.minimum(1.0, np.maximum(size, 1e-3 / at.turns) / np.abs(step))
    return np.where(np.isfinite(step), step, 0.0), rate, error


def _plant(delta: Array, f: Array) -> tuple[Double, Double, Double, Double]:
    """1 - c, and N(1 + zeta) as powers of zeta: z M(z) of a held delay, M(z) of a whole one."""
    whole = phi_pair(single(delta))
    if not np.any(f):
        return whole.em, whole.phi1, whole.phi2, single(0.0 * delta)
    zero = single(0.0 * delta)
    t = two_sum(1.0 + 0.0 * f, -f)
    fraction = single(f)
    late, early = phi_pair(single(delta).times(t)), phi_pair(single(delta * 1.0).times(fraction))
    a2 = t.times(t).times(late.phi2)
    one = single(1.0 + 0.0 * f)
    overlap = t.times(fraction).times(early.phi1).times(one.minus(late.em).plus(late.phi1))
    a1 = t.times(t).times(late.phi1.minus(late.phi2)).plus(overlap).plus(fraction.times(fraction).times(early.phi2))
    held = f != 0
    lead, bend = a2.scaled(2.0).plus(a1), a2
    return whole.em, whole.phi1, select(held, lead, whole.phi2), select(held, bend, zero)
