"""The device between two samples: exact discretization of a damped mass under a delayed, held force.

Normalized to T = 1 and m = 1. With d = n + f (n whole, 0 <= f < 1) the force computed at sample k acts from
k + d on: in each period the older force holds during [0, f), the newer one during [f, 1). From computed
force to sampled position that is

    x/F = N(z) / (z^(1+n) (z - 1)(z - c))     with N(z) = z n0(z) + n1(z) = a2 z^2 + a1 z + a0,

``phi2 z^2 + psi z`` at f = 0. All three coefficients are sums of positive terms, so none of them cancels:

    t = 1 - f
    a2 = t^2 phi2(delta t)
    a1 = t^2 psi(delta t) + t f e^(-delta t) phi1(delta f) + f^2 phi2(delta f) + t f phi1(delta t) phi1(delta f)
    a0 = e^(-delta t) f^2 psi(delta f)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from zwidth.arrays import phi
from zwidth.arrays.xp import namespace
from zwidth.words.types import Array

# x -> `arrays.phi.PhiFunctions`, in any arithmetic
Functions = Callable[[Any], Any]


class Plant(NamedTuple):
    """What the loop needs to know of device and delay; scalars, normalized."""

    c: Array  # e^-delta, the pole of the velocity
    em: Array  # 1 - c without cancellation
    a2: Array
    a1: Array
    a0: Array
    gap: Array  # N(-1) = a2 - a1 + a0 without cancellation


def held_plant(delta: Array, fraction: Array) -> Plant:
    """Discretize for a delay whose fractional part is ``fraction``, in [0, 1)."""
    return discretize(delta, fraction, phi.phi_functions)


def undelayed_plant(delta: Array) -> Plant:
    """Discretize without the fractional part: N(z) = z (phi2 z + psi)."""
    return discretize(delta, None, phi.phi_functions)


def discretize(delta: Any, fraction: Any, functions: Functions, at: Any = None) -> Plant:
    """The plant in any arithmetic whose phi-functions are given; ``fraction`` is None for whole delays.

    ``at`` are the functions at delta, where somebody has them.
    """
    at = functions(delta) if at is None else at
    if fraction is None:
        return Plant(at.c, delta * at.phi1, at.phi2, at.psi, 0.0 * at.gap, at.gap)
    f = fraction
    t = 1.0 - f
    at_t, at_f = functions(delta * t), functions(delta * f)
    e_t = at_t.c
    a2 = t * t * at_t.phi2
    a1 = t * t * at_t.psi + t * f * e_t * at_f.phi1 + f * f * at_f.phi2 + t * f * at_t.phi1 * at_f.phi1
    a0 = e_t * f * f * at_f.psi
    gap = (
        t * t * at_t.gap - t * f * at_f.phi1 * (e_t + at_t.phi1) - f * f * (at_f.gap + delta * t * at_t.phi1 * at_f.psi)
    )
    return Plant(at.c, delta * at.phi1, a2, a1, a0, gap)


def split_delay(d: Array) -> tuple[Array, Array]:
    """``d = n + f``; the difference is exact in floating point. Derivatives are those from the right."""
    whole = namespace(d).floor(d)
    return whole, d - whole
