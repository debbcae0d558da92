"""Certified verdicts of any linear loop: its characteristic polynomial in balls, decided by the Schur-Cohn recursion.

All parameters of the scene and of the wall are exact; the delay in periods is the float64 quotient that the scene uses.
The matrix exponential of the device, its characteristic polynomial and the velocity estimate are balls of python-flint.
Let P have degree n, and let ``P*(z) = z^n P(1/z)``. All zeros of P lie inside the unit circle if and only if
``|P(0)| < |lead|`` and all zeros of ``(lead P - P(0) P*)/z`` lie inside it. The precision is doubled until all
comparisons are certain.

References:
    Schur 1917; Cohn 1922; Johansson 2017.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.arrays.balls import BITS, available
from zwidth.parts.chain import AnyChain, chain_of
from zwidth.parts.linear_device import LinearDevice
from zwidth.parts.velocity import Estimate
from zwidth.words.errors import InputError, how_to_install
from zwidth.words.status import Status

if TYPE_CHECKING:
    import flint

NO_ESTIMATE = Estimate(0, 0.0)


def decide_walls(scene: Any, stiffness: np.ndarray, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return labels and statuses of walls of one shape, in SI units."""
    if not available():
        raise InputError(f"method: 'certified' needs python-flint for this scene: {how_to_install('certified')}")
    polynomials = cache(lambda bits: _polynomials(scene))
    stable, status = np.zeros(stiffness.shape, bool), np.zeros(stiffness.shape, np.int32)
    for place in np.ndindex(stiffness.shape):
        stable[place], status[place] = _decide(polynomials, float(stiffness[place]), float(damping[place]))
    return stable, status


def _decide(polynomials: Callable[[int], Any], stiffness: float, damping: float) -> tuple[bool, Status]:
    """Return label and status of one wall."""
    import flint

    if not (np.isfinite(stiffness) and np.isfinite(damping)):
        return False, Status.INVALID_INPUT
    for bits in BITS:
        with flint.ctx.workprec(bits):
            D, N1, N2, rest = polynomials(bits)
            p = D + N1 * flint.arb(stiffness) + N2 * flint.arb(damping)
            at_one = stiffness == 0 and rest
            if at_one:
                # z = 1 is a pole; decide on the other poles.
                p = p // flint.arb_poly([-1, 1])
            verdict = all_inside(p)
        if verdict is not None:
            return (False, Status.ON_BOUNDARY if verdict else Status.OK) if at_one else (verdict, Status.OK)
    return False, Status.UNDECIDED


def all_inside(p: flint.arb_poly) -> bool | None:
    """Return whether all zeros lie inside the unit circle; None if the balls are too wide."""
    import flint

    while p.degree() > 0:
        first, last = p[0], p[p.degree()]
        if first == 0:
            p = flint.arb_poly(p.coeffs()[1:])
            continue
        gap = abs(last) - abs(first)
        if not gap > 0:
            return False if gap < 0 else None
        coefficients = p.coeffs()
        mirrored = flint.arb_poly(coefficients[::-1])
        reduced = (p * (1 / last) - mirrored * (first / last / last)).coeffs()
        p = flint.arb_poly(reduced[1 : len(coefficients)])
    return True


def _polynomials(scene: Any) -> tuple[flint.arb_poly, flint.arb_poly, flint.arb_poly, bool]:
    """Return D, N1 and N2 of ``P = D + K N1 + B N2`` in SI units, and whether K = 0 puts a pole at exactly z = 1."""
    import flint

    exact = _exact(scene)
    period = exact.timing.period
    chain = chain_of(exact, (scene.d, int(scene.d)), NO_ESTIMATE)
    answer, device = _device(chain)
    estimate = _exact_estimate(exact, scene.velocity, scene.timing.period)
    top, bottom = _estimate_polynomials(estimate)
    unit = period * period / exact.mass
    whole = chain.whole + (1 if chain.d > chain.whole else 0)
    waiting = flint.arb_poly([0] * whole + device.coeffs())
    # F(1) is exactly 0 if F is a windowed difference, or if one of its zeros is exactly z = 1.
    rest = chain.free and (estimate.window > 0 or any(offset == 0 for offset in np.asarray(estimate.zeros).tolist()))
    return waiting * bottom, answer * bottom * unit, answer * top * (unit / period), rest


def _exact(part: Any) -> Any:
    """Return a scene or part with exact balls for floats; bypass constructors, because their checks need floats."""
    import flint

    if isinstance(part, tuple):
        return tuple(map(_exact, part))
    if isinstance(part, LinearDevice) or not is_dataclass(part):
        # The coefficients of a linear device are exact fractions.
        return flint.arb(part) if isinstance(part, float) else part
    # Omit cached values, which are floats.
    made = object.__new__(type(part))
    for item in fields(part):
        object.__setattr__(made, item.name, _exact(getattr(part, item.name)))
    return made


def _device(chain: AnyChain) -> tuple[flint.arb_poly, flint.arb_poly]:
    """Return numerator and denominator of G without its integer delay."""
    import flint

    rate, push, _ = (array.tolist() for array in chain.realize())
    size = len(push)

    def flow(time: flint.arb) -> tuple[flint.arb_mat, flint.arb_mat]:
        rows = [[time * value for value in (*row, force)] for row, force in zip(rate, push, strict=True)]
        whole = flint.arb_mat([*rows, [0] * (size + 1)]).exp()
        return (
            flint.arb_mat([[whole[i, j] for j in range(size)] for i in range(size)]),
            flint.arb_mat([[whole[i, size]] for i in range(size)]),
        )

    if chain.sampled:
        step, full = flint.arb_mat(rate), flint.arb_mat([[value] for value in push])
    else:
        step, full = flow(flint.arb(1))
    device = step.charpoly()

    def numerator(state: flint.arb_mat) -> flint.arb_poly:
        """Return ``C adj(z - A) state`` by the matrix determinant lemma; C selects the first state."""
        changed = flint.arb_mat(step)
        for k in range(size):
            changed[k, 0] = changed[k, 0] - state[k, 0]
        return changed.charpoly() - device

    if chain.d == chain.whole:
        return numerator(full), device
    late = flow(1 - flint.arb(float(chain.d - chain.whole)))[1]
    return flint.arb_poly([0, 1]) * numerator(late) + numerator(full - late), device


def _exact_estimate(exact: Any, velocity: Any, period: float) -> Estimate:
    """Return the velocity estimate in balls, or in floats, taken as exact, if its class supports only floats."""
    try:
        return exact.velocity.estimate(exact.timing.period)
    except (ArithmeticError, AttributeError, TypeError, ValueError):
        # Estimates defined by users may call functions of ``math``, which accept only floats.
        return velocity.estimate(period)


def _estimate_polynomials(estimate: Estimate) -> tuple[flint.arb_poly, flint.arb_poly]:
    """Return the numerator and the denominator of the velocity estimate F, for T = 1."""
    import flint

    z, turns = flint.arb_poly([0, 1]), estimate.window + estimate.lag
    top, bottom = (_expand(roots) for roots in (estimate.zeros, estimate.poles))
    top = top * estimate.gain * z ** max(-turns, 0)
    if estimate.window:
        top = top * (z**estimate.window - 1) * (1 / flint.arb(estimate.window))
    return top, bottom * z ** max(turns, 0)


def _expand(offsets: Any) -> flint.arb_poly:
    """Return the real monic polynomial of roots in conjugate pairs, given as offsets ``1 - z``."""
    import flint

    found = flint.acb_poly([1])
    for offset in np.asarray(offsets).tolist():
        found = found * flint.acb_poly([flint.acb(offset) - 1, 1])
    return flint.arb_poly([coefficient.real for coefficient in found.coeffs()])
