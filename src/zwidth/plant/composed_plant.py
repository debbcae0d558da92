"""Add the response of a simulated tool to the sampled plant of a device: zeros, poles and gain of G + G_t.

A virtual coupling C between the device (response G from force to position) and the tool (response G_t) has the closed
loop ``1 + C (G + G_t) = 0``, as a wall on a device with the response G + G_t (docs/theory/passivity.md, U5). With
``zeta = z - 1``, the gains g, the monic numerators N, and the denominators D without their common factor zeta^c,

    G = g N/(z^lag zeta^c D),  G_t = g_t N_t/(zeta^c D_t),  G + G_t = A/(z^lag zeta^c D D_t)
    A = g N D_t + g_t N_t z^lag D

The common factor zeta^c is counted once, because a common displacement of device and tool does not change their
distance and is therefore not observable. The zeros of A are refined by Aberth's method on the factored form of A. Roots
are stored as *offsets* 1 - root.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from zwidth.core.types import Array
from zwidth.model.circle_functions import Jet
from zwidth.model.tool import ToolResponse
from zwidth.numerics.polynomials import compute_aberth_step
from zwidth.plant.factored_plant import CONVERGED_STEP, FAR_ZERO, FactoredPlant

MAX_STEPS = 60  # largest number of Aberth steps
# |A| relative to the sum of the magnitudes of its two terms. Below this limit, A is only a rounding error, so its zero
# is not refined further.
NEGLIGIBLE = 1e-16


def factor_tool(response: ToolResponse) -> FactoredPlant:
    """Convert the response G_t of a tool to gain, zeros and poles."""
    gain, power, a2, a1, a0 = (float(value) for value in response)
    # Compute the larger root of the quadratic first, and the smaller root as a quotient, so that no digits cancel. A
    # tool without spring has a0 = 0, so its pole at z = 1 is exact.
    root = np.sqrt(complex(a1 * a1 - 4.0 * a2 * a0))
    large = 0.5 * (a1 + root)
    offsets = np.array([large / a2, a0 / large if large else 0.0])
    return FactoredPlant(gain / a2, 0, np.ones(int(power), complex), offsets)


def add_plants(first: FactoredPlant, second: FactoredPlant) -> FactoredPlant:
    """Return the zeros, poles and gain of the sum of two plants. The lag of the second plant must be 0.

    Poles at exactly z = 1 that occur in both plants are counted once.
    """
    common = min(int(np.sum(first.poles == 0)), int(np.sum(second.poles == 0)))
    first_poles, second_poles = (_drop_at_one(plant.poles, common) for plant in (first, second))
    terms = (
        (first.gain, np.concatenate([first.zeros, second_poles]), 0),
        (second.gain, np.concatenate([second.zeros, first_poles]), first.lag),
    )
    gain, zeros = _find_zeros(terms)
    poles = np.concatenate([np.zeros(common), first_poles, second_poles])
    # Each zero at z = 0 cancels one of the ``lag`` poles at z = 0.
    at_origin = min(int(np.sum(zeros == 1)), first.lag)
    zeros = np.delete(zeros, np.flatnonzero(zeros == 1)[:at_origin])
    return FactoredPlant(gain, first.lag - at_origin, zeros, poles)


def _drop_at_one(roots: Array, count: int) -> Array:
    """Remove ``count`` roots at exactly z = 1 (offset 0) from an array of offsets 1 - root."""
    return np.delete(roots, np.flatnonzero(roots == 0)[:count])


Terms = Sequence[tuple[float, Array, int]]  # gain, offsets of the zeros and power of z, for each term of A


def _find_zeros(terms: Terms) -> tuple[float, Array]:
    """Return the leading coefficient of the polynomial A, the sum of two terms, and the offsets of the zeros of A."""
    # Split off the powers of z and of z - 1 that the two terms have in common, so that these zeros of A are exact.
    powers = [int(np.sum(offsets == 1)) + power for _, offsets, power in terms]
    at_origin, at_one = min(powers), min(int(np.sum(offsets == 0)) for _, offsets, _ in terms)
    reduced = tuple(
        (gain, _drop_at_one(offsets[offsets != 1], at_one), power - at_origin)
        for (gain, offsets, _), power in zip(terms, powers, strict=True)
    )
    parts = [gain * np.pad(np.atleast_1d(np.poly(1.0 - offsets)).real, (0, power)) for gain, offsets, power in reduced]
    numerator = np.trim_zeros(np.polyadd(*parts), "f")
    while numerator.size > 1 and abs(numerator[0]) < FAR_ZERO * abs(numerator[1]):
        # Drop a negligible leading coefficient. The zero of A that it causes is too far from the unit circle to affect
        # the values of A on the circle.
        numerator = numerator[1:]
    zeta = _refine(reduced, np.roots(numerator) - 1.0 + 0j)
    return float(numerator[0]), np.concatenate([-zeta, np.zeros(at_one), np.ones(at_origin)])


def _refine(terms: Terms, zeta: Array) -> Array:
    """Refine the zeros of A, the sum of two terms, by Aberth's method; zeros are values of zeta = z - 1."""
    for _ in range(MAX_STEPS):
        with np.errstate(all="ignore"):
            first, second = (_evaluate(zeta, *term) for term in terms)
            value = first.value + second.value
            step = compute_aberth_step(zeta, (first.slope + second.slope) / value)
            significant = np.abs(value) > NEGLIGIBLE * (np.abs(first.value) + np.abs(second.value))
        step = np.where(np.isfinite(step) & significant, step, 0.0)
        zeta = zeta - step
        if np.all(np.abs(step) <= CONVERGED_STEP * np.abs(zeta)):
            break
    return zeta


def _evaluate(zeta: Array, gain: float, offsets: Array, power: int) -> Jet:
    """Return ``gain z^power prod(zeta + offset)`` and its derivative with respect to zeta."""
    result = Jet(gain * (1.0 + zeta) ** power, gain * power * (1.0 + zeta) ** max(power - 1, 0))
    for offset in offsets:
        result = result.times(Jet(zeta + offset, 1.0))
    return result
