"""Passivity of the sampled wall (Colgate's condition), for any delay.

Per frequency the condition is a lower bound on the physical damping. For whole d, with D = sin((d + 1/2) w)/sin(w/2),

    delta > alpha D/2 - beta cos((d + 1) w)            for every w in (0, pi]

which at d = 0 is eq. (21), ``delta > alpha/2 + |beta|``. For a held delay d = n + f the worst motion also bends when
the force arrives; with s = sin(w/2) and G = j e^(jw(n + 1/2)) (alpha - 2j beta s e^(jw/2)) the bound becomes

    delta > (-h + sqrt(h^2 + 4 f (1 - f) s^2 |G|^2)) / (4 s),   h = Re{((1 - f) + f e^(jw)) G}

Both are convex in (alpha, beta).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import as_float64, is_traced, pointwise, to_caller
from zwidth.errors import InputError, TracedDelayError
from zwidth.loop import poison, valid_wall
from zwidth.plant import split_delay
from zwidth.stability.golden import golden_section

# Samples per half wave of the fastest term, how many peaks are refined, and by how many steps.
_SAMPLES_PER_LAG = 12
_PEAKS = 6
_REFINEMENTS = 40
# The first peak lies at omega (d + 1) < 1.1 pi.
_FIRST_HALF_WAVE = 1.25 * np.pi


def needed_damping_at(omega: Array, alpha: Array, beta: Array, d: Array) -> Array:
    """The physical damping that the wall needs at one frequency in [0, pi]; at 0 the limit."""
    n, f = split_delay(d)
    s = jnp.sin(0.5 * omega)
    tiny = s < 1e-150
    s_safe = jnp.where(tiny, 1.0, s)

    def ratio(k: Array) -> Array:
        """sin(k w)/sin(w/2)."""
        return jnp.where(tiny, 2.0 * k, jnp.sin(k * omega) / s_safe)

    # h/s, free of the division by a small s
    spring = (1.0 - f) * ratio(n + 0.5) + f * ratio(n + 1.5)
    damper = (1.0 - f) * jnp.cos((n + 1.0) * omega) + f * jnp.cos((n + 2.0) * omega)
    h = -alpha * spring + 2.0 * beta * damper
    # |G|^2 = |alpha + beta (1 - z)|^2
    size = (alpha + 2.0 * beta * s * s) ** 2 + (beta * jnp.sin(omega)) ** 2
    curved = 4.0 * f * (1.0 - f) * size
    root = jnp.sqrt(h * h + curved)
    # -h + sqrt(h^2 + x) cancels for h > 0
    both = root + h
    stable_form = curved / jnp.where(both > 0, both, 1.0)
    return 0.25 * jnp.where(h > 0, stable_form, root - h)


def needed_damping(alpha: Array, beta: Array, d: Array, samples: int) -> Array:
    """The supremum of `needed_damping_at` over frequency: samples, then golden section round the best peaks."""
    cost = partial(needed_damping_at, alpha=alpha, beta=beta, d=d)
    grid = jnp.linspace(0.0, jnp.pi, samples + 1, dtype=alpha.dtype)
    values = jax.vmap(cost)(grid)
    padded = jnp.pad(values, 1, constant_values=-jnp.inf)
    is_peak = (values >= padded[:-2]) & (values >= padded[2:])
    # Peaks may tie to within what the sampling resolves: the highest sample need not mark the highest peak.
    heights, best = jax.lax.top_k(jnp.where(is_peak, values, -jnp.inf), _PEAKS)
    # Where d + 1 peaks nearly tie (small alpha, beta > 0) the first one was found to be the highest, for every d.
    first = jnp.argmax(jnp.where(grid * (d + 1.0) <= _FIRST_HALF_WAVE, values, -jnp.inf))
    heights, best = jnp.append(heights, values[first]), jnp.append(best, first)
    refined = jax.vmap(lambda center: _refined_peak(cost, center, jnp.pi / samples))(grid[best])
    return jnp.maximum(jnp.max(jnp.where(jnp.isfinite(heights), refined, -jnp.inf)), 0.0)


def _refined_peak(cost: Callable[[Array], Array], center: Array, step: float) -> Array:
    """The height of the peak within one step of ``center``, by golden section."""
    low, high = jnp.maximum(center - step, 0.0), jnp.minimum(center + step, jnp.pi)
    low, high = golden_section(lambda omega: -cost(omega), low, high, _REFINEMENTS)
    return jnp.maximum(cost(0.5 * (low + high)), cost(center))


def _margin_kernel(alpha: Array, beta: Array, delta: Array, d: Array, samples: int) -> Array:
    ok = valid_wall(alpha, beta, delta, d)
    safe_alpha, safe_beta, safe_d = (jnp.where(ok, value, 0.0) for value in (alpha, beta, d))
    spoiled = poison(ok, alpha, beta, delta, d)
    # A spring of negative stiffness stores unbounded energy, which the frequency condition does not see.
    margin = delta - needed_damping(safe_alpha, safe_beta, safe_d, samples)
    return jnp.where(alpha < 0, jnp.minimum(margin, alpha), margin) + spoiled


def _sample_count(d: ArrayLike) -> int:
    """Enough samples for the longest delay, rounded up so that few different counts are compiled."""
    if is_traced(d):
        raise TracedDelayError(
            "d: got a traced value, but the number of frequencies depends on it; pass a plain number"
        )
    delays = as_float64("d", d)
    longest = np.max(delays, initial=0.0, where=np.isfinite(delays))
    return 1 << int(np.ceil(np.log2(_SAMPLES_PER_LAG * (longest + 3.0))))


def passivity_margin(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """Return by how much the physical damping exceeds what a passive wall needs.

    ``margin = delta - sup_w needed(w)``, in units of delta = b T/m; the wall is passive where it is positive. At
    d = 0 it is ``delta - alpha/2 - |beta|``, eq. (21).

    Args:
        alpha: normalized stiffness; a negative one is never passive and limits the margin to alpha itself.
        beta: normalized virtual damping.
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, whole or not (held); concrete also inside `jit`. All four broadcast.

    Returns:
        Array of the broadcast shape; NaN where the input is out of range.

    Raises:
        InputError: an argument is no real number, or shapes do not broadcast.
        TracedDelayError: d is traced.

    Numerics:
        The supremum is sampled 12 times a half wave and refined by golden section: about 1e-14 of the terms.

    References:
        Colgate, Schenkel 1994; Hulin, Preusche, Hirzinger 2006, eqs. (20), (21), here extended to any delay.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.passivity_margin(0.2, 0.3, 1.0, 0):.2f}")
        0.60
    """
    samples = _sample_count(d)
    chunk = max(1, (1 << 20) // samples)
    return pointwise(_margin_kernel, ("alpha", "beta", "delta", "d"), (alpha, beta, delta, d), (samples,), chunk)


def is_passive(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """Whether the wall is passive, for any delay: `passivity_margin` > 0.

    Passive implies stable for alpha > 0; stable does not imply passive.

    Args:
        alpha: normalized stiffness.
        beta: normalized virtual damping.
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, whole or not (held). All four broadcast.

    Returns:
        Boolean array of the broadcast shape; False where the input is out of range.

    Raises:
        InputError: an argument is no real number, or shapes do not broadcast.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (21), here extended to any delay.

    Example:
        >>> import zwidth
        >>> bool(zwidth.is_passive(0.2, 0.3, 1.0, 0)), bool(zwidth.is_passive(0.2, 0.9, 1.0, 0))
        (True, False)
    """
    values = (alpha, beta, delta, d)
    margin = passivity_margin(*values)
    if is_traced(*values):
        return margin > 0
    # Compared by NumPy: outside float64 mode JAX would warn of the type it keeps.
    return to_caller(np.asarray(margin) > 0, values)


def passive_stiffness_slope(d: float) -> tuple[float, float]:
    """The stiffest passive wall and its damping, both over delta, for one delay.

    The condition is homogeneous in (alpha, beta, delta), so ``alpha_passive = slope * delta`` for every delta. The
    passive set is convex: for each beta bisect the largest alpha, then golden section over beta.
    """

    delay = as_float64("d", d)
    if delay.ndim or not (np.isfinite(delay) and delay >= 0):
        raise InputError(f"d: got {d!r}; a single finite number of at least 0 is needed")

    def largest_alpha(betas: np.ndarray) -> np.ndarray:
        low, high = np.zeros_like(betas), np.full_like(betas, 2.0)
        for _ in range(50):
            middle = 0.5 * (low + high)
            inside = np.asarray(passivity_margin(middle, betas, 1.0, d)) >= 0
            low, high = np.where(inside, middle, low), np.where(inside, high, middle)
        return low

    lower, upper = -1.0, 1.0
    for _ in range(12):
        # A row of trial values costs one call; each round narrows the bracket eightfold.
        trials = np.linspace(lower, upper, 17)
        best = int(np.argmax(largest_alpha(trials)))
        lower, upper = trials[max(best - 1, 0)], trials[min(best + 1, 16)]
    beta = np.array([0.5 * (lower + upper)])
    return float(largest_alpha(beta)[0]), float(beta[0])
