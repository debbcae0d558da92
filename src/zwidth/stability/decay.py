"""How fast a loop settles, with relative accuracy even where the spectral radius rounds to 1."""

from __future__ import annotations

import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import BLOCK, broadcast, elementwise, is_traced, to_caller
from zwidth.domain import check_scalars
from zwidth.grouping import NAMES
from zwidth.numerics.double_double import Complex, Double, chosen, phi_pair, single, two_sum
from zwidth.stability.circle import loop_of
from zwidth.stability.crossover import stable_kernel
from zwidth.stability.devices import kind_of
from zwidth.stability.proved import Poles, outermost_poles, usable
from zwidth.stability.radius import both_poles, traced_kernel
from zwidth.status import Status

# A bound of rounding errors over the rate, many times what they are: smaller ones leave the digits promised.
_EXACT = 5e-12
_STEPS = 8
# An error of the radius this small beside the rate leaves no doubt which pole decays most slowly.
_SURELY = 1e-3
_ACCURACY = 1e-9
# Steps of Halley's method with poles that may be the slowest; that at -1 begins close enough.
_FOLLOWED = 8
# Farther from the unit circle (in the logarithm of the radius) the sign of the rate is proved with the radius.
_DOUBTFUL = 1e-8


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
        Array of the broadcast shape, per period: positive exactly where `zwidth.is_stable` says so, 0 with a pole on
        the unit circle, negative where the motion grows. NaN for a point out of range, and
        where poles lie so close together that two counts cannot tell which is the slowest.

    Raises:
        InputError: an argument is no real number or a scalar out of range, or shapes do not broadcast.

    Numerics:
        Relative, not absolute accuracy, 1e-10 or better, however slow the decay: the outermost pole as for
        `zwidth.spectral_radius`, then Newton steps with residuals of 31 digits. Next to a k-fold pole the k-th root of
        that is left. Inside `jit` the same in the ambient precision, without the last step: absolute accuracy only.

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


def rates(found: Poles, columns: list[np.ndarray]) -> np.ndarray:
    """The rates of decay of outermost poles, with relative accuracy; NaN where it is not known which decays slowest."""
    rate = -found.re
    # What float64 knows well enough needs no more digits.
    refine = np.flatnonzero((found.doubt > _EXACT * np.abs(rate)) | (found.error > _ACCURACY))
    for start in range(0, refine.size, BLOCK):
        part = refine[start : start + BLOCK]
        with np.errstate(all="ignore"):
            rate[part] = refined_rate(*(column[part] for column in (*columns, found.re, found.im)))
    near = np.flatnonzero(~(np.abs(found.re) > _DOUBTFUL))
    if near.size:
        walls = [column[near] for column in columns]
        with np.errstate(all="ignore"):
            rate[near] = _beside_circle(rate[near], *walls)
    # The steps must have stayed at the pole whose size is proved.
    known = np.abs(rate + found.re) <= found.error
    known &= (found.error <= _ACCURACY) | (found.error < _SURELY * np.abs(rate))
    rate[~known] = np.nan
    return rate


def _beside_circle(rate: Array, alpha: Array, beta: Array, delta: Array, d: Array) -> Array:
    """The rates of poles next to the unit circle: the slowest motion, on the verdict's side."""
    # The proof of the radius does not tell apart poles that are all so near.
    # Whole delays as fractions, too: what is alone must not be computed otherwise than among neighbors.
    both = both_poles(_FOLLOWED, loop_of(alpha, beta, delta, d, True), True)
    for re, im in (both[:2], both[2:], (0.0 * rate, 0.0 * rate + np.pi)):
        other = refined_rate(alpha, beta, delta, d, re, im)
        rate = np.where((other < rate) & (alpha != 0), other, rate)
    stable = np.asarray(stable_kernel(alpha, beta, delta, d, kind_of(d)))
    # The two agree but for walls within rounding of the circle.
    return np.where(stable & (rate <= 0), np.finfo(float).tiny, np.where(~stable & (rate > 0), 0.0, rate))


def refined_rate(alpha: Array, beta: Array, delta: Array, d: Array, re: Array, im: Array) -> Array:
    """``-log |z|`` of the pole next to ``e^(re + j im)``, from residuals of twice the digits."""
    whole = np.floor(d)
    em, start, lead, bend = _plant(delta, d - whole)
    fractional = d != whole
    turns = whole + 1.0 + fractional
    s = two_sum(alpha, beta)
    half = np.sin(0.5 * im)
    size = np.exp(re)
    zeta = (np.expm1(re) - 2.0 * size * half * half) + 1j * (size * np.sin(im))
    step = 0.0 * zeta
    for k in range(_STEPS):
        at = Complex(single(zeta.real), single(zeta.imag))
        z = at.shifted(single(1.0 + 0.0 * re))
        device = z.power(turns).times(at).times(at.shifted(em))
        plant = at.stretched(bend).shifted(lead).times(at).shifted(start)
        wall = at.stretched(s).shifted(single(alpha))
        value = device.plus(plant.times(wall)).rounded
        # The derivative needs no more than float64.
        z1, m = 1.0 + zeta, plant.rounded
        slope = device.rounded * (turns / z1 + 1.0 / zeta + 1.0 / (zeta + em.high))
        slope = slope + (lead.high + 2.0 * bend.high * zeta) * wall.rounded + m * s.high
        step = -value / slope
        # A multiple pole moves by as much as it is uncertain.
        step = np.where(np.isfinite(step) & (np.abs(step) < 0.5 * np.maximum(np.abs(zeta), 1e-3 / turns)), step, 0.0)
        # What has arrived stays: a point's value must not depend on how long its neighbors take.
        moving = np.abs(step) > 4e-16 * np.abs(zeta)
        if k == _STEPS - 1 or not np.any(moving):
            break
        zeta = np.where(moving, zeta + step, zeta)
    # |z|^2 - 1 = 2 Re zeta + |zeta|^2
    re2, im2 = single(zeta.real), single(zeta.imag)
    beyond = re2.scaled(2.0).plus(re2.times(re2)).plus(im2.times(im2))
    change = 2.0 * np.real(np.conj(1.0 + zeta) * step) + np.abs(step) ** 2
    beyond = beyond.plus(single(change))
    rate = -0.5 * np.log1p(beyond.high) - 0.5 * beyond.low / (1.0 + beyond.high)
    at_one = (alpha == 0) & (re == 0)
    # Steps that do not settle have lost the pole: next to a double one, of walls a last place from none.
    settled = np.abs(step) <= 4e-15 * np.abs(zeta)
    return np.where(at_one, 0.0, np.where(settled, rate, np.nan))


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
    return whole.em, whole.phi1, chosen(held, lead, whole.phi2), chosen(held, bend, zero)
