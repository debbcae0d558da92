"""How fast a loop settles, with relative accuracy even where the spectral radius rounds to 1."""

from __future__ import annotations

import numpy as np

from zwidth.arrays.arguments import broadcast, check_scalars, to_caller
from zwidth.arrays.evaluate import evaluate
from zwidth.arrays.xp import is_traced
from zwidth.loops.rigid.circle import count, factor_loop
from zwidth.loops.rigid.degrees import NAMES
from zwidth.loops.rigid.outermost_poles import OutermostPoles, outermost_poles, usable
from zwidth.loops.rigid.pole_search import certification_width, traced_kernel
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike

# A rate of which no more is proved than this is no answer.
_LARGEST_ERROR = 1e-3
_ACCURACY = 1e-9
# Poles so near to the real axis are taken for single ones.
_REAL = 1e-6


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
        negative where the motion grows. NaN for a point out of range and where less than three digits of the rate are
        known: on the boundary but for some 1e-12 of alpha or beta, and next to multiple poles that are nearly as slow.

    Raises:
        InputError: an argument is no real number or a scalar out of range, or shapes do not broadcast.

    Numerics:
        The logarithm of the outermost pole as for `zwidth.spectral_radius`, found from z - 1: the motion of a soft wall
        keeps 11 digits or more however slow it is, that of a pair of poles near the circle has an absolute error of
        some 1e-16. A proved bound of either is below a thousandth of the rate, or the rate is NaN. Where poles are
        not told from each other (within 1e-12 in size), any of them is meant. Inside `jit` the same in the ambient
        precision, without a bound.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.decay_rate(1e-15, 1e-9, 1e-9, 1):.6e}")
        9.999993e-10
    """
    values = (alpha, beta, delta, d)
    arguments = dict(zip(NAMES, values, strict=True))
    check_scalars(arguments)
    if is_traced(*values):
        fraction = is_traced(d) or bool(np.any(np.asarray(d, float) % 1.0))
        return -evaluate(traced_kernel, arguments, fraction)
    arrays = broadcast(arguments)
    columns, status = usable([array.reshape(-1) for array in arrays])
    rate = rates(outermost_poles(columns, _ACCURACY), columns)
    rate[status != Status.OK] = np.nan
    return to_caller(rate.reshape(arrays[0].shape), values)


def rates(found: OutermostPoles, columns: list[np.ndarray]) -> np.ndarray:
    """The rates of decay of outermost poles; NaN where their relative errors are not proved to be small."""
    rate, allowed, beyond = 0.0 - found.re, _LARGEST_ERROR * np.abs(found.re), certification_width(found.re, _ACCURACY)
    # Other poles may be larger by what the count allows.
    error = np.minimum(found.error, found.doubt + beyond)
    # Without stiffness and damping both poles next to 1 are at 1.
    error[(found.re == 0) & (columns[0] == 0) & (columns[1] == -columns[2])] = 0.0
    held = columns[3] % 1.0 != 0.0
    with np.errstate(all="ignore"):
        for kind in (False, True):
            part = np.flatnonzero((error > allowed) & (found.doubt <= allowed) & (held == kind))
            loop = factor_loop(*(column[part] for column in columns), fractional=kind)
            # Whether a count proves that no other pole is nearly as large.
            seen = count(found.re[part] - beyond[part], loop, kind)
            alone = seen.sure & (seen.missing == np.where(np.sin(found.im[part]) < _REAL, 1, 2))
            error[part] = np.where(alone, found.doubt[part], error[part])
    return np.where(error <= allowed, rate, np.nan)
