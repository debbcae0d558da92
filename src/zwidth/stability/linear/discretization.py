"""Discretize a device exactly under a delayed zero-order hold, and factor the resulting open loop.

Between samples the device obeys ``x' = A x + B u``, with the sensed position as the first state. In normalized units
(T = 1) and with ``zeta = z - 1``, ``Psi = e^A - 1``, and Gamma(t), the state after a unit force held for time t from
rest, the response from held force to sampled position is (docs/theory/scenes.md, V2 to V4)

    G(z) = C (zeta - Psi)^-1 (zeta Gamma(1 - f) + Gamma(1)) / z^(n+1),   d = n + f

with the integer delay n and the fractional delay f; for f = 0 it is ``C (zeta - Psi)^-1 Gamma(1) / z^n``. In state
space, with the wall's force u of earlier samples and an external force w held on the same body,

    x+ = e^A x + Gamma(1 - f) u_(k-n) + (Gamma(1) - Gamma(1 - f)) u_(k-n-1) + Gamma(1) w,    u = -(alpha + beta F) y

A *chain* (`model.mechanism`) is a row of masses, springs and dampers; a *system* (`model.linear_plant`) is any linear
device. A *sampled* system is given in discrete time already. ``q = -1/G`` is the critical controller
(`stability.linear.roots`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.xp import iterate, namespace, stop_gradient
from zwidth.model.circle_functions import CirclePoints, circle_points, power_jet
from zwidth.model.linear_plant import System
from zwidth.model.mechanism import AnyChain, Chain, is_zero
from zwidth.model.state_space import StateSpace, connect_in_series, realize_estimate
from zwidth.numerics.held_mass import Plant, discretize_mass, factor_numerator
from zwidth.stability.linear.roots import LoopRoots, compute_aberth_step
from zwidth.stability.linear.sampled_zeros import find_sampled_zeros

# Settings for the zeros of G.
SLOW_ZERO = 0.1  # |zeta| below which a zero starts from its continuous-time counterpart
MAX_STEPS = 30  # largest number of Aberth steps
CONVERGED_STEP = 1e-13  # last Aberth step, relative to |zeta|
CLUSTER_RADIUS = 1e-2  # |z| of zeros near z = 0 that rounding errors may make inseparable
RESPONSE_TOLERANCE = 1e-11  # relative difference of q by roots and by matrices, above which the cluster is not refined
TEST_ANGLE = 0.5  # angle in rad per sample at which the two are compared
FAR_ZERO = 1e-17  # 1/|zeta| of a zero below which the zero is dropped

# Number of terms of the series for the matrix exponential, and largest number of doublings of the time.
SERIES_TERMS = 15
MAX_DOUBLINGS = 36  # 2^36 exceeds twice the largest rate that `Chain.check` allows


def compute_transition(A: Any, B: Any, time: Any) -> tuple[Any, Any]:
    """Return ``e^(A t) - 1`` and Gamma(t), the state after a unit force held for time t from rest.

    Args:
        A: state matrices, shape (..., n, n).
        B: input vectors, shape (..., n).
        time: times t, a number or an array that broadcasts with the leading axes.
    """
    # Evaluate the series for the time divided by a power of 2, then double the time repeatedly: y(2 t) = y(t) (2 +
    # y(t)) for y = e^(A t) - 1, and similarly Gamma. This keeps the relative accuracy of slow and of strongly damped
    # modes. Write the evaluation as two program loops, because these make the program short, and the compile time of
    # derivatives is proportional to its length: with JAX's own exponential, derivatives of `zwidth.Scene.max_stiffness`
    # took 1.2 to 1.7 times as long to compile.
    xp = namespace(A)
    time = xp.asarray(time)[..., None, None]
    norm = stop_gradient(xp.abs(A * time).sum(-2, keepdims=True).max(-1, keepdims=True), xp)
    doublings = xp.ceil(xp.log2(xp.maximum(2.0 * norm, 1.0)))
    start = time / 2.0**doublings
    small, identity = A * start, xp.eye(A.shape[-1], dtype=A.dtype)

    def add(state: tuple[Any, Any]) -> tuple[Any, Any]:
        k, total = state
        return k - 1.0, identity + small @ total / k

    def double(state: tuple[Any, Any]) -> tuple[Any, Any]:
        k, both = state
        return k + 1.0, xp.where(k < doublings, 2.0 * both + both[..., :-1] @ both, both)

    zero = doublings * 0.0
    _, phi1 = iterate(SERIES_TERMS, add, (zero + SERIES_TERMS + 1.0, identity + 0.0 * small), xp)
    both = phi1 @ xp.concatenate([small, B[..., None] * start], -1)
    both = iterate(MAX_DOUBLINGS, double, (zero, both), xp, lambda old, new: bool((new[0] >= doublings).all()))[1]
    return both[..., :-1], both[..., -1]


def compute_chain_transition(chain: AnyChain, A: Any, B: Any, time: Any) -> tuple[Any, Any]:
    """Return ``e^(A t) - 1`` and Gamma(t) of a chain; for a sampled system, A - 1 and B, independently of the time."""
    return (A - np.eye(len(B)), B) if chain.sampled else compute_transition(A, B, time)


class DiscreteChain(NamedTuple):
    """A chain discretized over one period; the first state is the sensed position."""

    psi: Any  # e^A - 1
    full: Any  # Gamma(1)
    late: Any | None  # Gamma(1 - f); None for integer delays


def discretize_chain(chain: AnyChain) -> DiscreteChain | Plant:
    """Return the discretized chain: for a rigid device in closed form, otherwise by the matrix exponential."""
    if not (isinstance(chain, Chain) and chain.rigid):
        return discretize_states(chain)
    fraction = chain.d - chain.n_delay
    return discretize_mass(chain.bodies[0].damping, None if is_zero(fraction) else fraction)


def discretize_states(chain: AnyChain) -> DiscreteChain:
    """Discretize a chain by the matrix exponential."""
    A, B, _ = chain.realize()
    psi, full = compute_chain_transition(chain, A, B, 1.0)
    fraction = chain.d - chain.n_delay
    late = None if is_zero(fraction) else compute_chain_transition(chain, A, B, 1.0 - fraction)[1]
    return DiscreteChain(psi, full, late)


def evaluate_controller(chain: AnyChain, w: Any, discretized: DiscreteChain | Plant) -> Any:
    """Return q at ``e^(jw)`` for one angle w; it is differentiable in all parameters, because no root is computed."""
    points: CirclePoints = circle_points(w)
    if isinstance(discretized, Plant):
        # Evaluate the numerator of G, divided by z: a2 z + a1 + a0/z.
        numerator = discretized.a2 * points.z + discretized.a1 + discretized.a0 / points.z
        return (
            -power_jet(points, chain.n_delay).value * points.z_minus_1 * (points.z_minus_1 + discretized.em) / numerator
        )
    xp = namespace(discretized.psi, w)
    force = (
        discretized.full + 0j if discretized.late is None else points.z_minus_1 * discretized.late + discretized.full
    )
    lag = chain.n_delay if discretized.late is None else chain.n_delay + 1
    state = xp.linalg.solve(points.z_minus_1 * xp.eye(discretized.psi.shape[0]) - discretized.psi, force)
    return -power_jet(points, lag).value / state[0]


def find_roots(chain: AnyChain) -> LoopRoots:
    """Return the zeros, poles and gain of the open loop of a chain, without a wall."""
    if isinstance(chain, Chain) and chain.rigid:
        return _factor_rigid_loop(chain)
    chain.check()
    discretized = discretize_states(chain)
    if isinstance(chain, System):
        lag, (zeros, poles) = chain.n_delay + (chain.d != chain.n_delay), chain.device.offsets
        gain = chain.device.gain * float(chain.mass) / float(chain.period) ** 2
        if not chain.sampled:
            lead, zeros = find_sampled_zeros(chain.device, float(chain.period), float(chain.d) - chain.n_delay)
            gain = lead * float(chain.mass) / float(chain.period) ** 2
            poles = -np.expm1(chain.device.poles * float(chain.period))
        # Count each pole at z = 0 as a period of delay (``lag``); each zero at z = 0 cancels one of them.
        lag, at_origin = int(lag + np.sum(poles == 1)), int(np.sum(zeros == 1))
        zeros = np.append(zeros[zeros != 1], np.ones(max(at_origin - lag, 0)))
        return LoopRoots(gain, max(lag - at_origin, 0), zeros, poles[poles != 1], chain.estimate)
    continuous_zeros, poles = chain.continuous
    poles = -np.expm1(poles)
    denominator = np.atleast_1d(np.poly(-poles)).real
    numerator = _expand_numerator(discretized, discretized.full, denominator)
    lag = chain.n_delay
    if discretized.late is not None:
        numerator = np.polyadd(np.append(_expand_numerator(discretized, discretized.late, denominator), 0.0), numerator)
        lag += 1
    numerator = np.trim_zeros(numerator, "f")
    if numerator.size > 1 and abs(numerator[0]) < FAR_ZERO * abs(numerator[1]):
        # Drop one zero if the delay is just below an integer, because this zero is then so far from the unit circle
        # that it has no effect on the circle and Aberth's method would not converge to it.
        numerator = numerator[1:]
    # Rounding errors of the coefficients hide zeros near the poles of a slow mode. Start the iteration for these zeros
    # from the zeros of the continuous-time response, which approximate them.
    with np.errstate(all="ignore"):
        slow = np.expm1(continuous_zeros)
    slow = slow[np.abs(slow) < SLOW_ZERO]
    zeros = np.roots(numerator).astype(complex)
    zeros[np.argsort(np.abs(zeros))[: slow.size]] = slow
    candidates = []
    # Refine all zeros first. Modes that decay within a period have a cluster of zeros near z = 0, which the determinant
    # may not separate; then keep the roots of ``numerator`` in this cluster, because they are accurate as a group.
    for is_refined in (np.full(zeros.shape, True), np.abs(1.0 + zeros) > CLUSTER_RADIUS):
        # Move real starting values off the real axis, because Aberth's steps keep real values real, and two zeros that
        # are real according to the coefficients may be a complex pair.
        off_axis = 1.0 + 1e-6j * (1.0 - 2.0 * (np.arange(zeros.size) % 2)) * is_refined
        refined = -_refine_zeros(discretized, zeros * off_axis, is_refined)
        loop = LoopRoots(float(numerator[0]), lag, refined, poles, chain.estimate)
        error = np.abs(
            loop.evaluate_controller(circle_points(TEST_ANGLE)).value
            / evaluate_controller(chain, TEST_ANGLE, discretized)
            - 1.0
        )
        if error < RESPONSE_TOLERANCE:
            return loop
        candidates.append((error, loop))
    return min(candidates, key=lambda each: each[0])[1]


def _expand_numerator(discretized: DiscreteChain, force: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Return the numerator of ``C (zeta - Psi)^-1 force`` in zeta, computed from its Markov parameters."""
    markov, state = [], force
    for _ in range(denominator.size - 1):
        markov.append(state[0])
        state = discretized.psi @ state
    return np.convolve(denominator, markov)[: denominator.size - 1]


def _refine_zeros(discretized: DiscreteChain, zeros: np.ndarray, is_refined: np.ndarray) -> np.ndarray:
    """Refine zeros of G by Aberth's method on ``det [[zeta - Psi, zeta Gamma(1 - f) + Gamma(1)], [C, 0]]``.

    No pole of G makes this determinant small, so zeros near poles are resolved (V4).

    Args:
        discretized: the chain.
        zeros: approximations of zeta.
        is_refined: False for zeros that stay fixed.

    Returns:
        The refined zeta, in the same order.
    """
    size = discretized.full.size
    constant = np.zeros((size + 1, size + 1))
    constant[:size, :size], constant[:size, size], constant[size, 0] = -discretized.psi, discretized.full, 1.0
    linear = np.eye(size + 1)
    linear[:, size] = np.append(np.zeros(size) if discretized.late is None else discretized.late, 0.0)
    for _ in range(MAX_STEPS):
        with np.errstate(all="ignore"):
            rate = np.array([_log_derivative(constant + zeta * linear, linear) for zeta in zeros])
            step = compute_aberth_step(zeros, rate)
        step = np.where(np.isfinite(step) & is_refined, step, 0.0)
        zeros = zeros - step
        if np.all(np.abs(step) <= CONVERGED_STEP * np.abs(zeros)):
            break
    return zeros


def _log_derivative(matrix: np.ndarray, change: np.ndarray) -> complex:
    """Return the derivative of log det(matrix) for a given derivative of the matrix; infinite for a singular matrix."""
    try:
        return np.trace(np.linalg.solve(matrix, change))
    except np.linalg.LinAlgError:
        return complex(np.inf)


def _factor_rigid_loop(chain: Chain) -> LoopRoots:
    """Return the zeros, poles and gain of the open loop of a rigid device, in closed form."""
    delta, fraction = np.float64(chain.bodies[0].damping), np.float64(chain.d - chain.n_delay)
    plant = discretize_mass(delta, fraction if fraction else None)
    if fraction:
        h, q = factor_numerator(plant)
        zeros = [1.0 + h / plant.a2, 1.0 + q]
    else:
        # Use ``gap``, because it is exactly 0 for delta = 0, and the zero is then at exactly z = -1.
        zeros = [2.0 - plant.gap / plant.a2]
    roots = (np.array(offsets, complex) for offsets in (zeros, [0.0, plant.em]))
    return LoopRoots(float(plant.a2), chain.n_delay + len(zeros) - 1, *roots, estimate=chain.estimate)


def realize_device(chain: AnyChain) -> StateSpace:
    """Return G of a chain as a state-space model, whose last states are the delayed forces."""
    return add_input_delay(discretize_states(chain), chain.n_delay)


def add_input_delay(discretized: DiscreteChain, n: int) -> StateSpace:
    """Return G in state space: a discretized device, or several along leading axes, after an integer delay n."""
    size, is_fractional = discretized.psi.shape[-1], discretized.late is not None
    newer = discretized.late if is_fractional else discretized.full
    count = n + is_fractional
    A = np.zeros((*discretized.psi.shape[:-2], size + count, size + count))
    B = np.zeros((*A.shape[:-1], 1))
    A[..., :size, :size] = np.eye(size) + discretized.psi
    A[..., size:, size:] = np.eye(count, k=-1)
    B[..., size : size + 1, :] = 1.0
    if n:
        A[..., :size, size + n - 1] = newer
    else:
        B[..., :size, 0] = newer
    if is_fractional:
        A[..., :size, size + n] += discretized.full - newer
    C = np.broadcast_to(np.eye(1, size + count), (*A.shape[:-2], 1, size + count))
    return StateSpace(A, B, C, np.zeros((*A.shape[:-2], 1, 1)))


def realize_open_loop(chain: AnyChain, alpha: float, beta: float) -> StateSpace:
    """Return ``L = (alpha + beta F) G`` in state space, from the wall's input position to the sampled position."""
    f = realize_estimate(chain.estimate)
    return connect_in_series(StateSpace(f.A, f.B, beta * f.C, alpha + beta * f.D), realize_device(chain))


def realize_closed_loop(chain: AnyChain, alpha: float, beta: float) -> StateSpace:
    """Return the closed loop with a wall in state space, from a held external force to the sampled position."""
    loop, filter_order = realize_open_loop(chain, alpha, beta), len(realize_estimate(chain.estimate).A)
    A, _, external = chain.realize()
    B = np.zeros((len(loop.A), 1))
    B[filter_order : filter_order + len(external), 0] = compute_chain_transition(chain, A, external, 1.0)[1]
    return StateSpace(loop.A - loop.B @ loop.C, B, loop.C, np.zeros((1, 1)))
