"""How fast a loop settles, with relative accuracy even where the spectral radius rounds to 1."""

from __future__ import annotations

import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import BLOCK, broadcast, elementwise, is_traced, to_caller
from zwidth.domain import check_scalars, wall_status
from zwidth.grouping import NAMES
from zwidth.numerics.double_double import Complex, Double, phi_pair, single, two_sum
from zwidth.stability.crossover import stable_kernel
from zwidth.stability.devices import kind_of
from zwidth.stability.proved import outermost_poles
from zwidth.stability.radius import traced_kernel
from zwidth.status import Status

# Faster decay is far from a radius of 1, and float64 knows it to all its digits.
_SLOW = 2.0
_STEPS = 8
# An error of the radius this small beside the rate leaves no doubt which pole decays most slowly.
_SURELY = 1e-3
_ACCURACY = 1e-9


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
    shape = arrays[0].shape
    columns = [array.reshape(-1) for array in arrays]
    ok = np.asarray(wall_status(*columns)) == Status.OK
    columns = [np.where(ok, column, fill) for column, fill in zip(columns, (0.1, 0.1, 1.0, 0.0), strict=True)]
    alpha, beta, delta, d = columns
    found = outermost_poles(columns, _ACCURACY)
    rate = np.array(-found.re)
    refine = np.flatnonzero((np.abs(rate) < _SLOW) | (found.error > _ACCURACY))
    for start in range(0, refine.size, BLOCK):
        part = refine[start : start + BLOCK]
        with np.errstate(all="ignore"):
            wall = alpha[part], beta[part]
            rate[part] = refined_rate(*wall, delta[part], d[part], found.re[part], found.im[part])
    with np.errstate(all="ignore"):
        stable = np.asarray(stable_kernel(alpha, beta, delta, d, kind_of(d)))
    # The two agree but for walls within rounding of the circle: there the verdict's side is kept.
    rate = np.where(stable & (rate <= 0), np.finfo(float).tiny, np.where(~stable & (rate > 0), 0.0, rate))
    known = (found.error <= _ACCURACY) | (found.error < _SURELY * np.abs(rate))
    rate = np.where(ok & known, rate, np.nan)
    return to_caller(rate.reshape(shape), values)


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
        if k == _STEPS - 1 or np.all(np.abs(step) <= 4e-16 * np.abs(zeta)):
            break
        zeta = zeta + step
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

    def chosen(new: Double, old: Double) -> Double:
        return Double(np.where(held, new.high, old.high), np.where(held, new.low, old.low))

    return whole.em, whole.phi1, chosen(lead, whole.phi2), chosen(bend, zero)
