"""The modulus margin: how closely the Nyquist curve of the loop passes the point -1."""

from __future__ import annotations

from zwidth._types import Array, ArrayLike
from zwidth.domain import check_scalars
from zwidth.loop import poison, valid_wall
from zwidth.stability.devices import device
from zwidth.stability.modulus import modulus
from zwidth.stability.open_loop import by_samples
from zwidth.xp import namespace


def modulus_margin(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """Return how closely the Nyquist curve of the loop passes the point -1.

    ``min over omega of |1 + L(e^(j omega))|``, with ``L = N(z) (alpha z + beta (z - 1))/(z^(2+n) (z - 1)(z - c))``; the
    inverse of the largest sensitivity. A margin in the sense of robustness only where the wall is stable.

    Args:
        alpha: normalized stiffness, > 0.
        beta: normalized virtual damping.
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, whole or not (held). All four broadcast.

    Returns:
        Array of the broadcast shape: 0 for a pole on the unit circle, at most 1 for a stable wall, at most 2 for any
        other; NaN where alpha <= 0 or out of range.

    Raises:
        InputError: a scalar is out of range, an argument is no real number, or shapes do not broadcast.

    Numerics:
        About 1e-14, at a cost that does not grow with d. The size of L falls strictly with omega, and ``|1 + L|
        >= ||L| - 1|``: the minimum lies within a turn of the phase to either side of the gain crossover. There
        it is sampled, and the lowest dips are zoomed in on. Traceable, with derivatives up to the second.

    References:
        Landau 1990 (modulus margin); Hulin, Preusche, Hirzinger 2006, eq. (15) for the loop.

    Example:
        >>> from zwidth import modulus_margin
        >>> print(f"{modulus_margin(0.1, 0.2, 0.1, 0):.4f}")
        0.5898
    """
    check_scalars(alpha=alpha, beta=beta, delta=delta, d=d)
    names = ("alpha", "beta", "delta", "d")
    return by_samples(margin_kernel, names, (alpha, beta, delta, d))


def margin_kernel(alpha: Array, beta: Array, delta: Array, d: Array) -> Array:
    """`modulus_margin`, elementwise."""
    ok = valid_wall(alpha, beta, delta, d) & (alpha > 0)
    inputs = (alpha, beta, delta, d)
    xp = namespace(*inputs)
    alpha, beta, delta, d = (xp.where(ok, value, 1.0) for value in inputs)
    return modulus(alpha, beta, device(delta, d))[0] + poison(ok, *inputs)
