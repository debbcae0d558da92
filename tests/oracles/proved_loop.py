"""Poles of any linear scene in the ball arithmetic of python-flint, which bounds its own rounding errors.

The loop is that of `any_loop`: ``P = D + K N1 + B N2`` from the matrix exponential of the device. Polynomials have
their lowest power first.
"""

from __future__ import annotations

from typing import Any

import flint
import numpy as np
from any_loop import rate_table

import zwidth


def _ball_filter(scene: Any) -> tuple[flint.acb_poly, flint.acb_poly]:
    """Return numerator and denominator of the velocity estimate in balls."""
    velocity, period = scene.velocity, flint.arb(scene.timing.period)
    if isinstance(velocity, zwidth.VelocityFilter):
        parts = [flint.acb_poly([flint.arb(c) for c in p[::-1]]) for p in (velocity.numerator, velocity.denominator)]
        return parts[0], parts[1]
    coded = getattr(velocity, "coded_period", None)
    period = period if coded is None else flint.arb(coded)
    z = flint.acb_poly([0, 1])
    if isinstance(velocity, zwidth.WindowedDifference):
        power = z**velocity.samples
        return (power - 1) * (1 / (period * velocity.samples)), power
    top, bottom = (z - 1) * (1 / period), z
    if isinstance(velocity, zwidth.LowPass):
        rate = 1 / flint.arb(velocity.time_constant) if velocity.time_constant else 2 * flint.arb.pi() * velocity.cutoff
        p = (-period * rate).exp()
        for _ in range(velocity.order):
            top, bottom = top * z * (1 - p), bottom * (z - p)
    if isinstance(velocity, zwidth.Butterworth):
        warped = (flint.arb.pi() * flint.arb(velocity.cutoff) * period).tan()
        for k in range(velocity.order):
            angle = flint.arb.pi() * (2 * k + 1 + velocity.order) / (2 * velocity.order)
            s = warped * flint.acb(angle.cos(), angle.sin())
            # s/(bilinear - s) with the bilinear (z - 1)/(z + 1).
            top, bottom = top * (z + 1) * (-s), bottom * ((z - 1) - (z + 1) * s)
    return top, bottom


def ball_parts(scene: Any) -> tuple[flint.acb_poly, flint.acb_poly, flint.acb_poly]:
    """Return D, N1 and N2 of ``P = D + K N1 + B N2`` in SI units, at the precision of `flint.ctx`."""
    table, size, sees = rate_table(scene, flint.arb)
    late = scene.integer_delay
    fraction = flint.arb(scene.d) - late
    rate = flint.arb_mat(table) * flint.arb(scene.timing.period)
    step, rest, first = (_top((rate * part).exp(), size) for part in (flint.arb(1), 1 - fraction, fraction))
    unforced = step[0].charpoly()

    def answer(push: flint.arb_mat) -> flint.arb_poly:
        """Return ``C adj(z - step) push`` by the matrix determinant lemma."""
        closed_update = flint.arb_mat(size, size, [push[i, 0] * sees[j] for i in range(size) for j in range(size)])
        return (step[0] - closed_update).charpoly() - unforced

    z = flint.acb_poly([0, 1])
    top, bottom = _ball_filter(scene)
    if scene.d == late:
        device, moved = z**late * flint.acb_poly(unforced), flint.acb_poly(answer(rest[1]))
    else:
        older = flint.acb_poly(answer(rest[0] * first[1]))
        device, moved = z ** (late + 1) * flint.acb_poly(unforced), z * flint.acb_poly(answer(rest[1])) + older
    return device * bottom, moved * bottom, moved * top


def _top(block: flint.arb_mat, size: int) -> tuple[flint.arb_mat, flint.arb_mat]:
    """Return the transition matrix and the response to a unit force from the exponential of a rate table."""
    a = flint.arb_mat(size, size, [block[i, j] for i in range(size) for j in range(size)])
    return a, flint.arb_mat(size, 1, [block[i, size] for i in range(size)])


def count_outside(scene: Any, stiffness: float, virtual_damping: float, digits: int = 60) -> int | None:
    """Return the number of poles outside the unit circle, by disjoint balls; None if a ball meets the circle."""
    before = flint.ctx.dps
    try:
        flint.ctx.dps = digits
        device, spring, damper = ball_parts(scene)
        polynomial = device + spring * flint.arb(stiffness) + damper * flint.arb(virtual_damping)
        outside = 0
        for root in nonzero(polynomial).roots(tol=10.0 ** (-digits // 2)):
            size = abs(root)
            if size > 1:
                outside += 1
            elif not size < 1:
                return None
        return outside
    except ValueError:
        return None
    finally:
        flint.ctx.dps = before


def proved_poles(
    scene: Any, stiffness: float, virtual_damping: float, computed: np.ndarray, digits: int = 90
) -> tuple[np.ndarray, np.ndarray]:
    """Return pole - 1 for all poles, and the backward error of each computed pole.

    The backward error is |P| relative to the sum of the magnitudes of its terms: the pole is exact for a loop whose
    D, K and B differ by this relative amount.
    """
    before = flint.ctx.dps
    try:
        flint.ctx.dps = digits
        device, spring, damper = ball_parts(scene)
        terms = device, spring * flint.arb(stiffness), damper * flint.arb(virtual_damping)
        roots = nonzero(terms[0] + terms[1] + terms[2]).roots(tol=10.0 ** (-digits // 2))
        missed = []
        for zeta in computed.tolist():
            z = 1 + flint.acb(zeta.real, zeta.imag)
            values = [term(z) for term in terms]
            size = abs(values[0]) + abs(values[1]) + abs(values[2])
            missed.append(float((abs(values[0] + values[1] + values[2]) / size).mid()))
        return np.array([_number(root - 1) for root in roots]), np.array(missed)
    finally:
        flint.ctx.dps = before


def proved_zeros(scene: Any, digits: int = 90) -> np.ndarray:
    """Return zero - 1 for the nonzero zeros of N1: those of the device, and the poles of the velocity estimate."""
    before = flint.ctx.dps
    try:
        flint.ctx.dps = digits
        return np.array([_number(root - 1) for root in nonzero(ball_parts(scene)[1]).roots(tol=10.0 ** (-digits // 2))])
    finally:
        flint.ctx.dps = before


def _number(ball: flint.acb) -> complex:
    """Return the midpoint of a ball."""
    return complex(float(ball.real.mid()), float(ball.imag.mid()))


def nonzero(polynomial: flint.acb_poly) -> flint.acb_poly:
    """Return a polynomial without its roots at 0: exact ones, and those of modes that decay within one period."""
    parts = polynomial.coeffs()
    largest = max(abs(part).abs_upper() for part in parts)
    while parts and abs(parts[0]) < largest * flint.arb(10) ** -40:
        parts = parts[1:]
    return flint.acb_poly(parts)


def proved_column(scene: Any, stiffness: float, digits: int = 60) -> np.ndarray | None:
    """Return the stable intervals of B at one K, shape (n, 2), by balls; None if the poles cannot be counted.

    On the unit circle ``Im((D + K N1) conj N2)`` is a polynomial in ``1 - cos w``. Its roots are the frequencies at
    which some B puts a pole on the circle. The poles are counted between these dampings.
    """
    before = flint.ctx.dps
    try:
        flint.ctx.dps = digits
        device, spring, damper = ball_parts(scene)
        fixed, moved = device + spring * flint.arb(stiffness), damper
        count = max(fixed.length(), moved.length())
        # Divide by the filter's double zeros at z = -1, because multiple roots of the polynomial would merge with
        # others. Up to a power of z this factor is real on the circle.
        pairs = scene.velocity.order // 2 if isinstance(scene.velocity, zwidth.Butterworth) else 0
        turned = divmod(moved, flint.acb_poly([1, 2, 1]) ** pairs)[0] * flint.acb_poly([0] * pairs + [1])
        a, b = ([part[k].real for k in range(count)] for part in (fixed, turned))
        x = flint.arb_poly([0, 1])
        sines, total = [flint.arb_poly([1]), 2 * (1 - x)], flint.arb_poly([0])
        for k in range(1, count):
            while len(sines) < k:
                sines.append(2 * (1 - x) * sines[-1] - sines[-2])
            total += sum((a[j + k] * b[j] - a[j] * b[j + k] for j in range(count - k)), flint.arb(0)) * sines[k - 1]
        # The first and last coefficients may be rounding errors of 0.
        parts = total.coeffs()
        threshold = max(abs(part).abs_upper() for part in parts) * flint.arb(10) ** (12 - digits)
        significant = [k for k, part in enumerate(parts) if not abs(part) < threshold]
        roots = (
            flint.acb_poly(parts[significant[0] : significant[-1] + 1]).roots(tol=10.0 ** (-digits // 2))
            if len(significant) > 1
            else []
        )
        real = [r.real for r in roots if abs(r.imag) < flint.arb(10) ** (-digits // 3) * abs(r)]
        angles = [flint.acb(1 - y, (y * (2 - y)).sqrt()) for y in real if y > 0 and y < 2] + [
            flint.acb(1),
            flint.acb(-1),
        ]
        size = sum((abs(moved[k]) for k in range(count)), flint.arb(0))
        regular = [z for z in angles if not abs(moved(z)) < size * flint.arb(10) ** (-digits // 4)]
        crossings = np.array(sorted(float(-(fixed(z) / moved(z)).real.mid()) for z in regular))
    except ValueError:
        return None
    finally:
        flint.ctx.dps = before
    reach = np.ptp(crossings) + np.abs(crossings).max() + 1e-300
    ends = np.concatenate([[-np.inf], crossings, [np.inf]])
    between = 0.5 * (
        np.concatenate([[crossings[0] - reach], crossings]) + np.concatenate([crossings, [crossings[-1] + reach]])
    )
    outside = [count_outside(scene, stiffness, damping, digits) for damping in between.tolist()]
    if None in outside:
        return None
    stable = np.array(outside) == 0
    return np.stack([ends[:-1][stable], ends[1:][stable]], -1)
