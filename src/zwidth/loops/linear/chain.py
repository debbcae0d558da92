"""From parts to a loop: the chain of masses of device, tip and hand, discretized exactly (any loop).

Bodies stand in a row, each with a damper and a spring to ground, linked by springs and dampers; the wall's force acts
on the first. In units of T and of the first body's mass, with ``u`` the force held over a period,

    x' = A x + B u,   x = (y, e2, e3, y', e2', e3'),   y the sensed body's position, e the extensions of the links

so that no small difference of large positions is ever formed. Between samples the motion is the matrix exponential.
From held force to sampled position, with zeta = z - 1, Psi = e^A - 1 = A phi1(A) and Gamma(t) the answer to a force
held for t (docs/theory/scenes.md, V2 to V4):

    G(z) = C (zeta - Psi)^-1 (zeta Gamma(1 - f) + Gamma(1)) / z^(n+1),   d = n + f
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.circle import CirclePoints, circle, lag_jet
from zwidth.arrays.xp import namespace
from zwidth.loops.linear.roots import LoopRoots
from zwidth.loops.rigid.device import Plant, held_plant, undelayed_plant
from zwidth.parts.paths import Parts
from zwidth.parts.velocity import Estimate
from zwidth.words.errors import InputError

# Stiffer links than this, in units of the first mass over T^2, move so fast that e^A keeps no digits.
_STIFFEST = 1e8
# Continuous zeros slower than this a period lead to sampled ones; Aberth's steps at most, and the last one's share.
_SLOW, _MOST_STEPS, _ARRIVED = 0.1, 30, 1e-13
# A rate that such a link allows is below 2^35.
_DOUBLINGS = 36


class Body(NamedTuple):
    """A mass with its damper and spring to ground, in units of T and of the first mass."""

    mass: Any
    damping: Any
    stiffness: Any


class Link(NamedTuple):
    """What connects a body with the next one."""

    stiffness: Any
    damping: Any


@dataclass(frozen=True)
class Chain:
    """Bodies in a row, the sensor on one of them, and the wall's force on the first."""

    bodies: tuple[Body, ...]
    links: tuple[Link, ...]
    sensor: int
    d: Any
    whole: int
    estimate: Estimate

    @property
    def rigid(self) -> bool:
        """Whether it is one mass with a damper."""
        return len(self.bodies) == 1 and _is_zero(self.bodies[0].stiffness)


def chain_of(scene: Parts, delay: tuple[Any, int] | None = None) -> Chain:
    """The chain of a scene, normalized by its period and by the mass the wall's force acts on.

    ``delay`` is the delay in periods and its whole part, where a trace hides them.
    """
    device, timing, hand = scene.device, scene.timing, scene.operator
    period = timing.period
    masses = [(device.mass, device.damping, 0.0)]
    links = []
    if device.coupling is not None:
        tip = device.coupling
        masses.append((tip.mass, 0.0, 0.0))
        links.append((tip.stiffness, tip.damping))
    if hand is not None and hand.rigid:
        mass, damping, stiffness = masses[-1]
        masses[-1] = (mass + hand.mass, damping + hand.damping, stiffness + hand.stiffness)
    elif hand is not None:
        masses.append((hand.mass, hand.damping, hand.stiffness))
        links.append((hand.coupling_stiffness, hand.coupling_damping))
    unit = masses[0][0]
    force, rub = period * period / unit, period / unit
    # No spring stays none, also where the period is traced.
    bodies = tuple(Body(m / unit, b * rub, 0.0 if _is_zero(k) else k * force) for m, b, k in masses)
    tied = tuple(Link(k * force, c * rub) for k, c in links)
    sensor = 1 if device.coupling is not None and device.coupling.sensor == "tip" else 0
    d, whole = delay or (timing.d, int(np.floor(timing.d)))
    return Chain(bodies, tied, sensor, d, whole, scene.velocity.estimate(period))


def _is_zero(value: Any) -> bool:
    return isinstance(value, float | np.floating) and value == 0.0


def rates(chain: Chain) -> tuple[Any, Any]:
    """A and B of the chain."""
    xp = namespace(*(value for part in (*chain.bodies, *chain.links) for value in part))
    count = len(chain.bodies)
    zero = 0.0 * (chain.bodies[0].mass + chain.bodies[-1].damping)
    size = 2 * count

    def row() -> list[Any]:
        return [zero] * size

    accelerations = []
    for k, body in enumerate(chain.bodies):
        force = row()
        for j, side in _position(k, chain.sensor):
            force[j] = force[j] - side * body.stiffness
            force[count + j] = force[count + j] - side * body.damping
        if k:
            link = chain.links[k - 1]
            force[k], force[count + k] = force[k] - link.stiffness, force[count + k] - link.damping
        if k + 1 < count:
            link = chain.links[k]
            force[k + 1], force[count + k + 1] = force[k + 1] + link.stiffness, force[count + k + 1] + link.damping
        accelerations.append([value / body.mass for value in force])
    rows = []
    for k in range(count):
        speed = row()
        speed[count + k] = zero + 1.0
        rows.append(speed)
    for k in range(count):
        above, below = (accelerations[k], accelerations[k - 1]) if k else (accelerations[chain.sensor], row())
        rows.append([a - b for a, b in zip(above, below, strict=True)])
    first = 1.0 / chain.bodies[0].mass + zero
    # A body beyond a link feels the push through the link alone.
    pushed = [zero] * count + [zero if chain.sensor else first] + [-first, zero][: count - 1]
    return xp.stack([xp.stack([xp.asarray(v) for v in r]) for r in rows]), xp.stack([xp.asarray(v) for v in pushed])


def _position(body: int, sensor: int) -> list[tuple[int, float]]:
    """The position of a body as a sum of the sensed one and of extensions: which, and their signs."""
    between = [(j, 1.0) for j in range(sensor + 1, body + 1)] + [(j, -1.0) for j in range(body + 1, sensor + 1)]
    return [(0, 1.0), *between]


def flow(rate: Any, push: Any, time: Any) -> tuple[Any, Any]:
    """``e^(A t) - 1`` and the answer ``Gamma(t)`` to a unit force held for t."""
    phi1 = _matrix_phi1(rate * time)
    # e^A - 1 = A phi1(A) keeps the digits of slow motions.
    return rate * time @ phi1, time * (phi1 @ push)


def _matrix_phi1(rate: Any) -> Any:
    """``phi1(A) = 1 + A/2! + A^2/3! + ...``."""
    if namespace(rate) is not np:
        return _traced_phi1(rate)
    return _known_phi1(rate.tobytes(), len(rate), rate.dtype.char)


@lru_cache(maxsize=64)
def _known_phi1(rate: bytes, size: int, kind: str) -> np.ndarray:
    """Kept, for the same chain is asked at many delays and its motion over a whole period hangs on none of them."""
    from scipy.linalg import expm

    # The exponential of [[A, 1], [0, 0]] holds it.
    top = np.concatenate([np.frombuffer(rate, kind).reshape(size, size), np.eye(size)], axis=1)
    return expm(np.concatenate([top, np.zeros((size, 2 * size))], axis=0))[:size, size:]


def _traced_phi1(rate: Any) -> Any:
    """The series for A over a power of 2, then ``phi1(2 A) = phi1(A) (1 + A phi1(A)/2)``.

    In two loops, because a program that is differentiated costs by its length: with JAX's own exponential, which holds
    an approximant for each of five sizes, derivatives of `zwidth.Scene.max_stiffness` took 1.2 to 1.7 times as long to
    compile.
    """
    import jax
    import jax.numpy as jnp

    size = jax.lax.stop_gradient(jnp.abs(rate).sum(0).max())
    doublings = jnp.ceil(jnp.log2(jnp.maximum(2.0 * size, 1.0)))
    small, one = rate / 2.0**doublings, jnp.eye(rate.shape[0], dtype=rate.dtype)

    def add(total: Any, k: Any) -> tuple[Any, None]:
        return one + small @ total / k, None

    def double(phi1: Any, k: Any) -> tuple[Any, None]:
        return phi1 + jnp.where(k < doublings, 0.5 * 2.0**k, 0.0) * (small @ phi1 @ phi1), None

    terms = jnp.arange(16, 1, -1, dtype=rate.dtype)
    phi1, _ = jax.lax.scan(add, one, terms)
    return jax.lax.scan(double, phi1, jnp.arange(_DOUBLINGS, dtype=rate.dtype))[0]


class Sampled(NamedTuple):
    """The chain between two samples; what the sensor sees is the first number of the state."""

    psi: Any
    full: Any
    late: Any | None  # Gamma(1 - f), None for whole delays


def respond(chain: Chain) -> Sampled | Plant:
    """The chain between two samples, what `needed` is computed from at every angle."""
    return _rigid_plant(chain) if chain.rigid else sampled(chain)


def sampled(chain: Chain) -> Sampled:
    """Discretize exactly."""
    rate, push = rates(chain)
    psi, full = flow(rate, push, 1.0)
    fraction = chain.d - chain.whole
    late = None if _is_zero(fraction) else flow(rate, push, 1.0 - fraction)[1]
    return Sampled(psi, full, late)


def required_wall(chain: Chain, w: Any, parts: Sampled | Plant | None = None) -> Any:
    """``q = -1/G`` at ``e^(jw)``, one angle, without any root: what derivatives are taken of."""
    at: CirclePoints = circle(w)
    parts = respond(chain) if parts is None else parts
    if isinstance(parts, Plant):
        # N(z)/z = a2 z + a1 + a0/z, around z = 1.
        answer = parts.a2 * at.z + parts.a1 + parts.a0 / at.z
        return -lag_jet(at, chain.whole).value * at.before * (at.before + parts.em) / answer
    xp = namespace(parts.psi, w)
    force = parts.full + 0j if parts.late is None else at.before * parts.late + parts.full
    turns = chain.whole if parts.late is None else chain.whole + 1
    moved = xp.linalg.solve(at.before * xp.eye(parts.psi.shape[0]) - parts.psi, force)
    return -lag_jet(at, turns).value / moved[0]


def _rigid_plant(chain: Chain) -> Plant:
    fraction, delta = chain.d - chain.whole, chain.bodies[0].damping
    return undelayed_plant(delta) if _is_zero(fraction) else held_plant(delta, fraction)


def compliance(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator in s of what the sensor sees of a force, highest power first.

    Sums of positive terms, so that slow roots are exact.
    """
    top, bottom, seen = np.zeros(0), np.ones(1), np.ones(1)
    for k in reversed(range(len(chain.bodies))):
        body = chain.bodies[k]
        own = np.array([body.mass, body.damping, body.stiffness], float)
        if top.size:
            link = np.array([chain.links[k].damping, chain.links[k].stiffness], float)
            bottom = np.polyadd(np.convolve(link, bottom), top)
            # The series of link and what follows stands on ``bottom``.
            top = np.polyadd(np.convolve(own, bottom), np.convolve(link, top))
            seen = bottom if k == chain.sensor else np.convolve(link, seen)
        else:
            top = own
    return np.trim_zeros(seen, "f"), np.trim_zeros(top, "f")


def _continuous_roots(polynomial: np.ndarray) -> np.ndarray:
    still = polynomial.size - 1 - int(np.flatnonzero(polynomial)[-1])
    moving = polynomial[: polynomial.size - still]
    roots = np.roots(moving).astype(complex)
    for _ in range(2):
        with np.errstate(all="ignore"):
            step = np.polyval(moving, roots) / np.polyval(np.polyder(moving), roots)
        roots = roots - np.where(np.isfinite(step) & (np.abs(step) < 1e-3 * np.abs(roots)), step, 0.0)
    return np.concatenate([np.zeros(still, complex), roots])


def find_roots(chain: Chain) -> LoopRoots:
    """The loop of a chain by its roots."""
    if chain.rigid:
        return _rigid_loop(chain)
    stiffest = max(
        float(link.stiffness) / min(float(b.mass) for b in chain.bodies) for link in (*chain.links, Link(0.0, 0.0))
    )
    if stiffest > _STIFFEST:
        raise InputError(
            f"coupling.stiffness: a link that rings {np.sqrt(stiffest) / (2 * np.pi):.3g} times a period cannot be "
            "resolved; leave the coupling out, so stiff a link is rigid"
        )
    parts = sampled(chain)
    seen, stiffness = compliance(chain)
    poles = -np.expm1(_continuous_roots(stiffness))
    den = np.atleast_1d(np.poly(-poles)).real
    top = _numerator(parts, parts.full, den)
    lag = chain.whole
    if parts.late is not None:
        top = np.polyadd(np.append(_numerator(parts, parts.late, den), 0.0), top)
        lag += 1
    top = np.trim_zeros(top, "f")
    # Zeros beside a soft mode's poles are lost in ``top``; they are nearly those of the continuous motion.
    slow = np.expm1(_continuous_roots(seen))
    slow = slow[np.abs(slow) < _SLOW]
    zeros = np.roots(top).astype(complex)
    zeros[np.argsort(np.abs(zeros))[: slow.size]] = slow
    return LoopRoots(float(top[0]), lag, -_polished_zeros(parts, zeros), poles, chain.estimate)


def _numerator(parts: Sampled, push: np.ndarray, den: np.ndarray) -> np.ndarray:
    """The numerator in zeta of ``C (zeta - Psi)^-1 push``, by its Markov parameters."""
    markov, state = [], push
    for _ in range(den.size - 1):
        markov.append(state[0])
        state = parts.psi @ state
    return np.convolve(den, markov)[: den.size - 1]


def _polished_zeros(parts: Sampled, zeros: np.ndarray) -> np.ndarray:
    """Aberth's steps on the determinant of ``[[zeta - Psi, push], [C, 0]]``, where no pole cancels a zero."""
    size = parts.full.size
    at_rest = np.zeros((size + 1, size + 1))
    at_rest[:size, :size], at_rest[:size, size], at_rest[size, 0] = -parts.psi, parts.full, 1.0
    growing = np.eye(size + 1)
    growing[:, size] = np.append(np.zeros(size) if parts.late is None else parts.late, 0.0)
    same = np.eye(zeros.size, dtype=bool)
    for _ in range(_MOST_STEPS):
        with np.errstate(all="ignore"):
            slope = np.array([_relative_slope(at_rest + zeta * growing, growing) for zeta in zeros])
            step = 1.0 / (slope - (1.0 / np.where(same, np.inf, zeros[:, None] - zeros)).sum(1))
        step = np.where(np.isfinite(step), step, 0.0)
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
    if fraction == 0:
        plant = undelayed_plant(delta)
        # At delta = 0 the zero is at -1 exactly.
        zeros = np.array([2.0 + plant.gap * -1.0 / plant.a2 + 0j])
        return LoopRoots(float(plant.a2), chain.whole, zeros, np.array([0.0, plant.em], complex), chain.estimate)
    plant = held_plant(delta, fraction)
    root = np.sqrt(max(plant.a1 * plant.a1 - 4.0 * plant.a2 * plant.a0, 0.0))
    far = -0.5 * (plant.a1 + root)
    zeros = np.array([1.0 - far / plant.a2, 1.0 - plant.a0 / far], complex)
    return LoopRoots(float(plant.a2), chain.whole + 1, zeros, np.array([0.0, plant.em], complex), chain.estimate)
