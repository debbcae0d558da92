"""A device under a force that is held over each period: discretized exactly, and by its roots (any loop).

With ``x' = A x + B u`` and the first number of x what is sensed, the motion between samples is the matrix exponential.
From held force to sampled position, with zeta = z - 1, Psi = e^A - 1 = A phi1(A) and Gamma(t) the answer to a force
held for t (docs/theory/scenes.md, V2 to V4):

    G(z) = C (zeta - Psi)^-1 (zeta Gamma(1 - f) + Gamma(1)) / z^(n+1),   d = n + f

As matrices, with the forces on their way, u the wall's force and w one held from outside on the same body, a period is

    x+ = e^A x + Gamma(1 - f) u_(k-n) + (Gamma(1) - Gamma(1 - f)) u_(k-n-1) + Gamma(1) w,    u = -(alpha + beta F) y
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.held_mass import Plant, factor_numerator, held_plant
from zwidth.loops.linear.roots import LoopRoots, step_apart
from zwidth.loops.linear.sampled_zeros import find_sampled_zeros
from zwidth.parts.chain import AnyChain, Chain, is_zero
from zwidth.parts.circle import CirclePoints, circle, lag_jet
from zwidth.parts.state_space import StateSpace, estimate_matrices, in_series
from zwidth.parts.system import System
from zwidth.words.xp import frozen, namespace, repeat

# Continuous zeros slower than this a period lead to sampled ones; Aberth's steps at most, and the last one's share.
_SLOW, _MOST_STEPS, _ARRIVED = 0.1, 30, 1e-13
# Zeros so near to z = 0 are taken together where G by its roots differs by more from G by its matrices, at one angle.
_FORGOTTEN, _AGREES, _LOOK = 1e-2, 1e-11, 0.5
# The inverse of how far a zero is at most that is kept.
_FAR = 1e-17
# Terms of a series; twice a rate that `Chain.check` allows is below 2^36.
_TERMS, _DOUBLINGS = 15, 36


def flow(rate: Any, push: Any, time: Any) -> tuple[Any, Any]:
    """``y = e^(A t) - 1`` and the answer ``Gamma(t)`` to a unit force held for t."""
    # The series of a time that is smaller by a power of 2, then y(2 t) = y(t) (2 + y(t)), Gamma(2 t) likewise: neither
    # slow motions nor those that strong damping stops at once lose digits. In two loops, because a program that is
    # differentiated costs by its length: with JAX's own exponential derivatives of `zwidth.Scene.max_stiffness` took
    # 1.2 to 1.7 times as long to compile.
    xp = namespace(rate)
    size = frozen(xp.abs(rate * time).sum(0).max(), xp)
    doublings = xp.ceil(xp.log2(xp.maximum(2.0 * size, 1.0)))
    small, one = rate * (time / 2.0**doublings), xp.eye(rate.shape[0], dtype=rate.dtype)

    def add(state: tuple[Any, Any]) -> tuple[Any, Any]:
        k, total = state
        return k - 1.0, one + small @ total / k

    def double(state: tuple[Any, Any]) -> tuple[Any, Any]:
        k, moved = state
        return k + 1.0, xp.where(k < doublings, 2.0 * moved + moved[:, :-1] @ moved, moved)

    _, phi1 = repeat(_TERMS, add, (doublings * 0.0 + _TERMS + 1.0, one), xp)
    moved = phi1 @ xp.concatenate([small, push[:, None] * (time / 2.0**doublings)], 1)
    moved = repeat(_DOUBLINGS, double, (doublings * 0.0, moved), xp, lambda old, new: bool(new[0] >= doublings))[1]
    return moved[:, :-1], moved[:, -1]


def hold(chain: AnyChain, rate: Any, push: Any, time: Any) -> tuple[Any, Any]:
    """The `flow` of a chain's matrices; those of a sampled one are it, whatever the time."""
    return (rate - np.eye(len(push)), push) if chain.sampled else flow(rate, push, time)


class Sampled(NamedTuple):
    """The chain between two samples; what the sensor sees is the first number of the state."""

    psi: Any
    full: Any
    late: Any | None  # Gamma(1 - f), None for whole delays


def respond(chain: AnyChain) -> Sampled | Plant:
    """The chain between two samples, what `required_wall` is computed from at every angle."""
    if not (isinstance(chain, Chain) and chain.rigid):
        return sampled(chain)
    fraction = chain.d - chain.whole
    return held_plant(chain.bodies[0].damping, None if is_zero(fraction) else fraction)


def sampled(chain: AnyChain) -> Sampled:
    """Discretize exactly."""
    A, B, _ = chain.realize()
    psi, full = hold(chain, A, B, 1.0)
    fraction = chain.d - chain.whole
    late = None if is_zero(fraction) else hold(chain, A, B, 1.0 - fraction)[1]
    return Sampled(psi, full, late)


def required_wall(chain: AnyChain, w: Any, parts: Sampled | Plant) -> Any:
    """``q = -1/G`` at ``e^(jw)``, one angle, without any root: what derivatives are taken of."""
    at: CirclePoints = circle(w)
    if isinstance(parts, Plant):
        # N(z)/z = a2 z + a1 + a0/z, around z = 1.
        answer = parts.a2 * at.z + parts.a1 + parts.a0 / at.z
        return -lag_jet(at, chain.whole).value * at.before * (at.before + parts.em) / answer
    xp = namespace(parts.psi, w)
    force = parts.full + 0j if parts.late is None else at.before * parts.late + parts.full
    turns = chain.whole if parts.late is None else chain.whole + 1
    moved = xp.linalg.solve(at.before * xp.eye(parts.psi.shape[0]) - parts.psi, force)
    return -lag_jet(at, turns).value / moved[0]


def find_roots(chain: AnyChain) -> LoopRoots:
    """Return the zeros, poles, gain and delay of the loop of a chain."""
    if isinstance(chain, Chain) and chain.rigid:
        return _rigid_loop(chain)
    chain.check()
    parts = sampled(chain)
    if isinstance(chain, System):
        lag, (zeros, poles) = chain.whole + (chain.d != chain.whole), chain.device.offsets
        gain = chain.device.gain * float(chain.mass) / float(chain.period) ** 2
        if not chain.sampled:
            lead, zeros = find_sampled_zeros(chain.device, float(chain.period), float(chain.d) - chain.whole)
            gain = lead * float(chain.mass) / float(chain.period) ** 2
            poles = -np.expm1(chain.device.poles * float(chain.period))
        # Each pole at z = 0 is a delay of one period; zeros at z = 0 cancel such poles.
        lag, still = int(lag + np.sum(poles == 1)), int(np.sum(zeros == 1))
        zeros = np.append(zeros[zeros != 1], np.ones(max(still - lag, 0)))
        return LoopRoots(gain, max(lag - still, 0), zeros, poles[poles != 1], chain.estimate)
    seen, poles = chain.continuous
    poles = -np.expm1(poles)
    den = np.atleast_1d(np.poly(-poles)).real
    top = _numerator(parts, parts.full, den)
    lag = chain.whole
    if parts.late is not None:
        top = np.polyadd(np.append(_numerator(parts, parts.late, den), 0.0), top)
        lag += 1
    top = np.trim_zeros(top, "f")
    if top.size > 1 and abs(top[0]) < _FAR * abs(top[1]):
        # Just before a whole delay: a zero so far off moves nothing on the circle, and no step would find it.
        top = top[1:]
    # Zeros beside a soft mode's poles are lost in ``top``; they are nearly those of the continuous motion.
    with np.errstate(all="ignore"):
        slow = np.expm1(seen)
    slow = slow[np.abs(slow) < _SLOW]
    zeros = np.roots(top).astype(complex)
    zeros[np.argsort(np.abs(zeros))[: slow.size]] = slow
    found = []
    # What a period forgets leaves zeros next to z = 0, of which no determinant may tell one from another; of ``top``
    # they are right together.
    for moves in (np.full(zeros.shape, True), np.abs(1.0 + zeros) > _FORGOTTEN):
        # Off the real line, which steps cannot leave: two real ones may have become a pair.
        off = 1.0 + 1e-6j * (1.0 - 2.0 * (np.arange(zeros.size) % 2)) * moves
        polished = -_polished_zeros(parts, zeros * off, moves)
        loop = LoopRoots(float(top[0]), lag, polished, poles, chain.estimate)
        error = np.abs(loop.required_wall(circle(_LOOK)).value / required_wall(chain, _LOOK, parts) - 1.0)
        if error < _AGREES:
            return loop
        found.append((error, loop))
    return min(found, key=lambda each: each[0])[1]


def _numerator(parts: Sampled, push: np.ndarray, den: np.ndarray) -> np.ndarray:
    """The numerator in zeta of ``C (zeta - Psi)^-1 push``, by its Markov parameters."""
    markov, state = [], push
    for _ in range(den.size - 1):
        markov.append(state[0])
        state = parts.psi @ state
    return np.convolve(den, markov)[: den.size - 1]


def _polished_zeros(parts: Sampled, zeros: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Aberth's steps on the determinant of ``[[zeta - Psi, push], [C, 0]]``, where no pole cancels a zero."""
    size = parts.full.size
    at_rest = np.zeros((size + 1, size + 1))
    at_rest[:size, :size], at_rest[:size, size], at_rest[size, 0] = -parts.psi, parts.full, 1.0
    growing = np.eye(size + 1)
    growing[:, size] = np.append(np.zeros(size) if parts.late is None else parts.late, 0.0)
    for _ in range(_MOST_STEPS):
        with np.errstate(all="ignore"):
            slope = np.array([_relative_slope(at_rest + zeta * growing, growing) for zeta in zeros])
            step = step_apart(zeros, slope)
        step = np.where(np.isfinite(step) & moves, step, 0.0)
        zeros = zeros - step
        if np.all(np.abs(step) <= _ARRIVED * np.abs(zeros)):
            break
    return zeros


def _relative_slope(matrix: np.ndarray, growing: np.ndarray) -> complex:
    """The derivative of the determinant over itself; infinite on a zero."""
    try:
        return np.trace(np.linalg.solve(matrix, growing))
    except np.linalg.LinAlgError:
        return complex(np.inf)


def _rigid_loop(chain: Chain) -> LoopRoots:
    delta, fraction = np.float64(chain.bodies[0].damping), np.float64(chain.d - chain.whole)
    plant = held_plant(delta, fraction if fraction else None)
    if fraction:
        h, q = factor_numerator(plant)
        zeros = [1.0 + h / plant.a2, 1.0 + q]
    else:
        # At delta = 0 it is at -1 exactly.
        zeros = [2.0 - plant.gap / plant.a2]
    roots = (np.array(offsets, complex) for offsets in (zeros, [0.0, plant.em]))
    return LoopRoots(float(plant.a2), chain.whole + len(zeros) - 1, *roots, estimate=chain.estimate)


def delayed_device(chain: AnyChain) -> StateSpace:
    """G: from the wall's force to the sampled position, with the forces that are on their way."""
    return delay_force(sampled(chain), chain.whole)


def delay_force(parts: Sampled, whole: int) -> StateSpace:
    """The same of a device between two samples, or of many along leading axes, and so many whole periods of delay."""
    size, held = parts.psi.shape[-1], parts.late is not None
    now = parts.late if held else parts.full
    count = whole + held
    A = np.zeros((*parts.psi.shape[:-2], size + count, size + count))
    B = np.zeros((*A.shape[:-1], 1))
    A[..., :size, :size] = np.eye(size) + parts.psi
    A[..., size:, size:] = np.eye(count, k=-1)
    B[..., size : size + 1, :] = 1.0
    if whole:
        A[..., :size, size + whole - 1] = now
    else:
        B[..., :size, 0] = now
    if held:
        A[..., :size, size + whole] += parts.full - now
    C = np.broadcast_to(np.eye(1, size + count), (*A.shape[:-2], 1, size + count))
    return StateSpace(A, B, C, np.zeros((*A.shape[:-2], 1, 1)))


def open_loop(chain: AnyChain, alpha: float, beta: float) -> StateSpace:
    """``L = (alpha + beta F) G``, from the position that the wall is given to the one that its force answers."""
    f = estimate_matrices(chain.estimate)
    return in_series(StateSpace(f.A, f.B, beta * f.C, alpha + beta * f.D), delayed_device(chain))


def closed_loop(chain: AnyChain, alpha: float, beta: float) -> StateSpace:
    """From a force held on the device to the sampled position, in contact with the wall."""
    loop, filtered = open_loop(chain, alpha, beta), len(estimate_matrices(chain.estimate).A)
    A, _, held = chain.realize()
    push = np.zeros((len(loop.A), 1))
    push[filtered : filtered + len(held), 0] = hold(chain, A, held, 1.0)[1]
    return StateSpace(loop.A - loop.B @ loop.C, push, loop.C, np.zeros((1, 1)))
