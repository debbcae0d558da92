"""Decide the stability of walls in any linear loop with a certificate: Schur-Cohn recursion in ball arithmetic.

The characteristic polynomial is ``P = D + K N1 + B N2``, here in SI units; G is the response from force to sampled
position, F the velocity estimate, T the period. All parameters of the scene and of the wall are taken as exact; the
delay in periods is the float64 quotient that the scene uses. The matrix exponential of the device, its characteristic
polynomial and the velocity estimate are computed in balls of python-flint, i.e. with error bounds.

Let P have degree n and leading coefficient ``lead``, and let ``P*(z) = z^n P(1/z)``. All zeros of P lie inside the unit
circle if and only if ``|P(0)| < |lead|`` and all zeros of ``(lead P - P(0) P*)/z`` lie inside it. The precision is
doubled until all comparisons are certain.

References:
    Schur 1917, J. reine angew. Math. 147; Cohn 1922, Math. Zeitschrift 14 (recursion). Johansson 2017, IEEE Trans.
    Computers 66 (ball arithmetic).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.core.errors import InputError, format_install_command
from zwidth.core.status import Status
from zwidth.model.estimate import Estimate
from zwidth.model.linear_device import LinearDevice
from zwidth.model.loop_estimates import LoopEstimates, build_estimates
from zwidth.model.mechanism import AnyChain, build_chain
from zwidth.model.tool import ToolResponse
from zwidth.numerics.balls import BITS, available
from zwidth.stability.linear.composition import find_roots

if TYPE_CHECKING:
    import flint

# Placeholder for the velocity estimate when the plant is built without it, because F is expanded separately.
NO_ESTIMATE = Estimate(0, 0.0)


def decide_walls(scene: Any, stiffness: np.ndarray, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decide with a certificate whether walls are stable, in ball arithmetic of sufficient precision.

    Args:
        scene: the scene.
        stiffness: K in N/m, any shape.
        damping: B in N s/m, the same shape.

    Returns:
        Label (True if stable) and `Status` of each wall.

    Raises:
        InputError: if python-flint is not installed.
    """
    if not available():
        raise InputError(
            f"method: 'certified' needs python-flint for this scene: {format_install_command('certified')}"
        )
    polynomials = cache(lambda bits: _expand_polynomials(scene))
    stable, status = np.zeros(stiffness.shape, bool), np.zeros(stiffness.shape, np.int32)
    for index in np.ndindex(stiffness.shape):
        stable[index], status[index] = _decide(polynomials, float(stiffness[index]), float(damping[index]))
    return stable, status


def _decide(polynomials: Callable[[int], Any], stiffness: float, damping: float) -> tuple[bool, Status]:
    """Return whether one wall is stable, and the `Status` of this result."""
    import flint

    if not (np.isfinite(stiffness) and np.isfinite(damping)):
        return False, Status.INVALID_INPUT
    for bits in BITS:
        with flint.ctx.workprec(bits):
            D, N1, N2, has_rest = polynomials(bits)
            p = D + N1 * flint.arb(stiffness) + N2 * flint.arb(damping)
            at_one = stiffness == 0 and has_rest
            if at_one:
                # Divide out the pole at z = 1, because the wall is on the stability boundary if all other poles are
                # inside.
                p = p // flint.arb_poly([-1, 1])
            verdict = are_zeros_inside(p)
        if verdict is not None:
            return (False, Status.ON_BOUNDARY if verdict else Status.OK) if at_one else (verdict, Status.OK)
    return False, Status.UNDECIDED


def are_zeros_inside(p: flint.arb_poly) -> bool | None:
    """Return whether all zeros of p lie inside the unit circle; None if the balls are too wide to decide."""
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
        reversed_ = flint.arb_poly(coefficients[::-1])
        reduced = (p * (1 / last) - reversed_ * (first / last / last)).coeffs()
        p = flint.arb_poly(reduced[1 : len(coefficients)])
    return True


def _expand_polynomials(scene: Any) -> tuple[flint.arb_poly, flint.arb_poly, flint.arb_poly, bool]:
    """Return the polynomials D, N1 and N2 in SI units, and whether K = 0 puts a pole at exactly z = 1."""
    import flint

    exact = _convert_exactly(scene)
    period = exact.timing.period
    chain = build_chain(exact, (scene.d, int(scene.d)), NO_ESTIMATE)
    numerator, denominator = _expand_response(chain)
    unit = period * period / exact.mass
    lag = chain.n_delay + (1 if chain.d > chain.n_delay else 0)
    delayed = flint.arb_poly([0] * lag + denominator.coeffs())
    estimates = build_estimates(exact)
    if estimates is None:
        estimates = LoopEstimates(velocity=_exact_estimate(exact, scene.velocity, scene.timing.period))
    polynomials = _expand_estimates(estimates, numerator, delayed)
    has_integrator = chain.has_integrator
    if exact.tool is not None:
        free = scene.tool.stiffness == 0
        at_one = free and bool(np.any(find_roots(build_chain(scene)).poles == 0)) and polynomials[0](1).contains(0)
        polynomials = _add_tool(*polynomials, estimates.of_tool, exact.tool.respond(exact.mass, period), int(at_one))
        has_integrator = has_integrator or free
    D, N1, N2 = polynomials
    # F(1) is exactly 0 if F is a windowed difference, or if one of its zeros is exactly z = 1.
    F = estimates.velocity
    has_rest = has_integrator and (F.window > 0 or any(offset == 0 for offset in np.asarray(F.zeros).tolist()))
    has_rest = has_rest and scene.position is None and scene.feedback is None
    return D, N1 * unit, N2 * (unit / period), has_rest


def _add_tool(
    D: flint.arb_poly, N1: flint.arb_poly, N2: flint.arb_poly, velocity: Estimate, response: ToolResponse, common: int
) -> tuple[flint.arb_poly, flint.arb_poly, flint.arb_poly]:
    """Add a simulated tool to the characteristic polynomial ``D + alpha N1 + beta N2`` of a device.

    The estimates of position and velocity of the device have the responses P H = N1/D and V H = N2/D to the force,
    those of the tool G_t and V_t G_t. The closed loop is ``1 + alpha (P H + G_t) + beta (V H + V_t G_t) = 0``.

    Args:
        D, N1, N2: the polynomials of the device.
        velocity: velocity estimate V_t of the tool.
        response: response G_t of the tool.
        common: 1 if D and the denominator of G_t have a common zero at exactly z = 1, of which one is omitted; else 0.
    """
    import flint

    gain, power, a2, a1, a0 = response
    zeta = flint.arb_poly([-1, 1])
    # With zeta = z - 1, the denominator of G_t is a2 zeta^2 + a1 zeta + a0; a0 is 0 for a tool without a spring.
    # If D and the denominator of G_t share a factor zeta, omit it in one of them.
    tool = zeta * a2 + flint.arb_poly([a1]) if common else zeta * zeta * a2 + zeta * a1 + flint.arb_poly([a0])
    rest = (D // zeta if common else D) * flint.arb_poly([0] * power + [1]) * gain
    v_numerator, v_denominator = _expand_estimate(velocity)
    return D * tool * v_denominator, (N1 * tool + rest) * v_denominator, N2 * tool * v_denominator + rest * v_numerator


def _expand_estimates(
    estimates: LoopEstimates, numerator: flint.arb_poly, denominator: flint.arb_poly
) -> tuple[flint.arb_poly, flint.arb_poly, flint.arb_poly]:
    """Return D, N1 and N2 of the characteristic polynomial ``D + alpha N1 + beta N2`` in normalized units.

    The controller is ``alpha P + beta V + R`` with the position estimate P, the velocity estimate V and the further
    feedback R. Common poles of P and V are not canceled. They are inside the unit circle, so the verdict is the same.

    Args:
        estimates: P, V and R.
        numerator: numerator of the plant.
        denominator: denominator of the plant, with the factors z of the delay.
    """
    p_numerator, p_denominator = _expand_estimate(estimates.position)
    v_numerator, v_denominator = _expand_estimate(estimates.velocity)
    velocity = (p_numerator if estimates.structure == "series" else p_denominator) * v_numerator
    D = denominator * p_denominator * v_denominator
    N1, N2 = numerator * p_numerator * v_denominator, numerator * velocity
    if estimates.feedback is None:
        return D, N1, N2
    r_numerator, r_denominator = _expand_estimate(estimates.feedback.filter)
    weights = estimates.feedback.weights
    source = numerator * p_denominator * v_denominator
    if weights is not None:
        source = N1 * weights.position + N2 * weights.velocity
    return D * r_denominator + source * r_numerator, N1 * r_denominator, N2 * r_denominator


def _convert_exactly(part: Any) -> Any:
    """Return a copy of a scene, or of one of its parts, in which every float is an exact ball (radius 0).

    The copies are created without calling the constructors, because these accept only floats.
    """
    import flint

    if isinstance(part, tuple):
        return tuple(map(_convert_exactly, part))
    if isinstance(part, LinearDevice) or not is_dataclass(part):
        # Keep the coefficients of a linear device, because they are exact fractions.
        return flint.arb(part) if isinstance(part, float) else part
    # Copy only the fields and no cached results, because cached results are floats.
    copy = object.__new__(type(part))
    for item in fields(part):
        object.__setattr__(copy, item.name, _convert_exactly(getattr(part, item.name)))
    return copy


def _expand_response(chain: AnyChain) -> tuple[flint.arb_poly, flint.arb_poly]:
    """Return the numerator and denominator polynomials of G in normalized units, without the delay's poles at z = 0."""
    import flint

    A, B, _ = (array.tolist() for array in chain.realize())
    size = len(B)

    def compute_transition(time: flint.arb) -> tuple[flint.arb_mat, flint.arb_mat]:
        """Return e^(A t), and the state at time t after a unit force held from rest."""
        rows = [[time * value for value in (*row, force)] for row, force in zip(A, B, strict=True)]
        block = flint.arb_mat([*rows, [0] * (size + 1)]).exp()
        return (
            flint.arb_mat([[block[i, j] for j in range(size)] for i in range(size)]),
            flint.arb_mat([[block[i, size]] for i in range(size)]),
        )

    if chain.sampled:
        transition, full = flint.arb_mat(A), flint.arb_mat([[value] for value in B])
    else:
        transition, full = compute_transition(flint.arb(1))
    denominator = transition.charpoly()

    def expand_numerator(state: flint.arb_mat) -> flint.arb_poly:
        """Return the polynomial ``C adj(z - transition) state`` by the determinant lemma; C selects the first state."""
        changed = flint.arb_mat(transition)
        for k in range(size):
            changed[k, 0] = changed[k, 0] - state[k, 0]
        return changed.charpoly() - denominator

    if chain.d == chain.n_delay:
        return expand_numerator(full), denominator
    late = compute_transition(1 - flint.arb(float(chain.d - chain.n_delay)))[1]
    return flint.arb_poly([0, 1]) * expand_numerator(late) + expand_numerator(full - late), denominator


def _exact_estimate(exact: Any, velocity: Any, period: float) -> Estimate:
    """Return the velocity estimate in balls; if its class supports only floats, in floats, which are taken as exact."""
    try:
        return exact.velocity.estimate(exact.timing.period)
    except (ArithmeticError, AttributeError, TypeError, ValueError):
        # Use floats for an estimate whose class, defined by a user, calls functions of ``math``, which accept only
        # floats.
        return velocity.estimate(period)


def _expand_estimate(estimate: Estimate) -> tuple[flint.arb_poly, flint.arb_poly]:
    """Return the numerator and the denominator polynomials of the velocity estimate F in z, for T = 1."""
    import flint

    z, delay = flint.arb_poly([0, 1]), estimate.window + estimate.lag
    numerator, denominator = (_expand(roots) for roots in (estimate.zeros, estimate.poles))
    numerator = numerator * estimate.gain * z ** max(-delay, 0)
    if estimate.window:
        numerator = numerator * (z**estimate.window - 1) * (1 / flint.arb(estimate.window))
    return numerator, denominator * z ** max(delay, 0)


def _expand(offsets: Any) -> flint.arb_poly:
    """Return the monic polynomial with real coefficients of roots in conjugate pairs, given as offsets ``1 - z``."""
    import flint

    product = flint.acb_poly([1])
    for offset in np.asarray(offsets).tolist():
        product = product * flint.acb_poly([flint.acb(offset) - 1, 1])
    return flint.arb_poly([coefficient.real for coefficient in product.coeffs()])
