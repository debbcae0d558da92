"""From parts to a loop: the bodies of device, tip and hand, its modes and its actuator (any loop).

Bodies stand in a row, each with a damper and a spring to ground, linked by springs and dampers. Modes add to what the
sensor sees. The wall's force acts on the first body and on the modes, behind the actuator; a force held on the device
acts on the first body. In units of T and of the first body's mass, with ``u`` the command,

    x' = A x + B u,   x = (y, e2, e3, q1, .., y', e2', e3', q1', .., a, a')

y the position that the sensor sees, e the extensions of the links, q the modes and a the actuator's force: so that no
small difference of large positions is ever formed, and the first number of the state is always what is sensed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np

from zwidth.parts.linear_device import LinearDevice
from zwidth.parts.paths import Parts
from zwidth.parts.system import FASTEST, STRONGEST, Realization, System
from zwidth.parts.velocity import Estimate
from zwidth.words.errors import InputError
from zwidth.words.xp import namespace


class Body(NamedTuple):
    """A mass with its damper and spring to ground, in units of T and of the first mass."""

    mass: Any
    damping: Any
    stiffness: Any


class Link(NamedTuple):
    """What connects a body with the next one."""

    stiffness: Any
    damping: Any


class Resonance(NamedTuple):
    """``(1/mass)/(s^2 + 2 zeta w s + w^2)``: a mode, or with mass 1/w^2 an actuator of second order."""

    rate: Any
    damping_ratio: Any
    mass: Any

    @property
    def poles(self) -> np.ndarray:
        """Its two poles in s."""
        w, zeta = float(self.rate), float(self.damping_ratio)
        root = np.sqrt(complex(zeta * zeta - 1.0))
        # The product of the two is w^2: the slow one without a difference.
        fast = -w * (zeta + root)
        return np.array([fast, w * w / fast if root.real else fast.conjugate()])


@dataclass(frozen=True)
class Chain:
    """Bodies in a row, the sensor on one of them, and the wall's force on the first."""

    bodies: tuple[Body, ...]
    links: tuple[Link, ...]
    modes: tuple[Resonance, ...]
    # A first order has a rate alone.
    actuator: Resonance | Any | None
    sensor: int
    d: Any
    whole: int
    estimate: Estimate

    sampled: ClassVar[bool] = False

    @property
    def rigid(self) -> bool:
        """Whether it is one mass with a damper."""
        return len(self.bodies) == 1 and self.plain and is_zero(self.bodies[0].stiffness)

    @property
    def plain(self) -> bool:
        """Whether a command acts at once, and on the bodies alone."""
        return not self.modes and self.actuator is None

    @property
    def free(self) -> bool:
        """Whether nothing pulls a device at rest back."""
        return all(body.stiffness == 0 for body in self.bodies)

    def state_units(self, speed: float, force: float) -> list[float]:
        """The units of the state's numbers in SI ones, with m a length: a speed's and a force's."""
        count = len(self.bodies) + len(self.modes)
        behind = 0 if self.actuator is None else 2 if isinstance(self.actuator, Resonance) else 1
        return [1.0] * count + [speed] * count + [force, force * speed][:behind]

    def realize(self) -> Realization:
        """The matrices of its motion, of numbers, JAX's arrays or balls alike."""
        lag = self.actuator
        numbers = [value for part in (*self.bodies, *self.links, *self.modes) for value in part]
        xp = namespace(*numbers, *(lag if isinstance(lag, Resonance) else () if lag is None else (lag,)))
        bodies, modes = len(self.bodies), len(self.modes)
        count, behind = bodies + modes, 0 if lag is None else 2 if isinstance(lag, Resonance) else 1
        size = 2 * count + behind
        zero = xp.asarray(0.0 * (self.bodies[0].mass + self.bodies[-1].damping + sum(mode.rate for mode in self.modes)))
        # A row for each number of the state, for the command and for a force held on the first body.
        axes = xp.asarray(np.eye(size + 2).astype(zero.dtype)).reshape(size + 2, size + 2, *[1] * zero.ndim)
        command, held = axes[size:]
        driven = command if lag is None else axes[2 * count]
        ties = [link.stiffness * axes[k] + link.damping * axes[count + k] for k, link in enumerate(self.links, start=1)]
        ties = [zero, *ties, zero]
        accelerations = []
        for k, body in enumerate(self.bodies):
            seen = body_position(k, self.sensor, bodies, modes)
            place, speed = (sum(sign * axes[start + j] for j, sign in seen) for start in (0, count))
            force = ties[k + 1] - ties[k] - body.stiffness * place - body.damping * speed
            accelerations.append((force if k else force + driven + held) / body.mass)
        swings = [
            driven / mode.mass
            - mode.rate * mode.rate * axes[bodies + k]
            - 2.0 * mode.damping_ratio * mode.rate * axes[count + bodies + k]
            for k, mode in enumerate(self.modes)
        ]
        rows = [*axes[count : 2 * count], sum(swings, accelerations[self.sensor])]
        rows += [accelerations[k] - accelerations[k - 1] for k in range(1, bodies)] + swings
        if isinstance(lag, Resonance):
            slows = 2.0 * lag.damping_ratio * lag.rate * axes[size - 1]
            rows += [axes[size - 1], lag.rate * lag.rate * (command - axes[size - 2]) - slows]
        elif lag is not None:
            rows.append(lag * (command - axes[size - 1]))
        table = xp.stack([row + zero for row in rows])
        return Realization(table[:, :size], table[:, size], table[:, size + 1])

    @cached_property
    def continuous(self) -> tuple[np.ndarray, np.ndarray]:
        """The finite zeros and the poles in s of what the sensor sees of a command."""
        seen, stiffness = compliance(self)
        poles = [_roots(stiffness), *(mode.poles for mode in self.modes)]
        pairs = [np.array([1.0, 2.0 * m.damping_ratio * m.rate, m.rate * m.rate], float) for m in self.modes]
        seen = reduce(np.convolve, pairs, seen)
        for k, mode in enumerate(self.modes):
            seen = np.polyadd(seen, reduce(np.convolve, pairs[:k] + pairs[k + 1 :], stiffness / float(mode.mass)))
        if self.actuator is not None:
            lag = self.actuator
            poles.append(lag.poles if isinstance(lag, Resonance) else np.array([-float(lag)]))
        return _roots(np.trim_zeros(seen, "f")), np.concatenate(poles).astype(complex)

    def check(self) -> None:
        """Refuse what moves so fast that e^A keeps no digits."""
        light = min(float(body.mass) for body in self.bodies)
        rates = {"coupling.stiffness: a link": [float(link.stiffness / light) ** 0.5 for link in self.links]}
        rates["modes.frequency: a mode"] = [float(mode.rate) for mode in self.modes]
        lag = self.actuator.rate if isinstance(self.actuator, Resonance) else self.actuator
        rates["actuator.cutoff: an actuator"] = [] if lag is None else [float(lag)]
        for what, found in rates.items():
            if max(found, default=0.0) > FASTEST:
                name = what.partition(".")[0]
                raise InputError(
                    f"{what} that rings {max(found) / (2 * np.pi):.3g} times a period cannot be resolved; leave the "
                    f"{name} out, so {'stiff a link is rigid' if name == 'coupling' else 'fast a one is not there'}"
                )
        own, *others = [float(body.damping / body.mass) for body in self.bodies]
        dampers = {"damping": [own], "operator.damping": others}
        dampers["coupling.damping"] = [float(link.damping / light) for link in self.links]
        ratio = [2.0 * float(lag.damping_ratio * lag.rate)] if isinstance(lag, Resonance) else []
        for name, found in (dampers | {"actuator.damping_ratio": ratio}).items():
            if max(found, default=0.0) > STRONGEST:
                raise InputError(
                    f"{name}: a damper that stops what moves in {1.0 / max(found):.3g} periods cannot be resolved; "
                    "check its unit"
                )


AnyChain: TypeAlias = Chain | System


def chain_of(scene: Parts, delay: tuple[Any, int] | None = None, estimate: Estimate | None = None) -> AnyChain:
    """The bodies of a scene, or its linear system, normalized by its period and by the mass that the force acts on."""
    # ``delay`` is in periods, with its whole part, where a trace hides it; ``estimate`` stands for the scene's.
    device, timing, hand = scene.device, scene.timing, scene.operator
    period = timing.period
    d, whole = delay or (timing.d, int(np.floor(timing.d)))
    estimate = estimate or scene.velocity.estimate(period)
    if isinstance(device, LinearDevice):
        # In balls a float is exact.
        mass = type(period)(device.mass) if hasattr(period, "mid") else device.mass
        return System(device, period, mass, d, whole, estimate)
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
    bodies = tuple(Body(m / unit, b * rub, 0.0 if is_zero(k) else k * force) for m, b, k in masses)
    tied = tuple(Link(k * force, c * rub) for k, c in links)
    sensor = 1 if device.coupling is not None and device.coupling.sensor == "tip" else 0
    modes = tuple(Resonance(mode.rate * period, mode.damping_ratio, mode.mass / unit) for mode in device.modes)
    lag = device.actuator
    actuator: Any = None if lag is None else lag.rate * period
    if lag is not None and lag.order == 2:
        actuator = Resonance(actuator, lag.damping_ratio, 1.0 / (actuator * actuator))
    return Chain(bodies, tied, modes, actuator, sensor, d, whole, estimate)


def is_zero(value: Any) -> bool:
    """Whether a number is zero for good, and not only where it is traced."""
    return isinstance(value, float | np.floating) and value == 0.0


def body_position(body: int, sensor: int, bodies: int, modes: int) -> list[tuple[int, float]]:
    """The position of a body as a sum of the sensed one, of extensions and of modes: which, and their signs."""
    between = [(j, 1.0) for j in range(sensor + 1, body + 1)] + [(j, -1.0) for j in range(body + 1, sensor + 1)]
    return [(0, 1.0), *between, *((j, -1.0) for j in range(bodies, bodies + modes))]


def compliance(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator in s of what the sensor sees of a force, highest power first."""
    # Sums of positive terms, so that slow roots are exact.
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


def _roots(polynomial: np.ndarray) -> np.ndarray:
    still = polynomial.size - 1 - int(np.flatnonzero(polynomial)[-1])
    moving = polynomial[: polynomial.size - still]
    if moving.size % 2 and not moving[1::2].any():
        # Without dampers in squares: modes are on the imaginary axis, to the last digit.
        half = np.sqrt(np.roots(moving[::2]).astype(complex))
        roots = np.concatenate([half, -half])
    else:
        roots = np.roots(moving).astype(complex)
    for _ in range(2):
        with np.errstate(all="ignore"):
            step = np.polyval(moving, roots) / np.polyval(np.polyder(moving), roots)
        roots = roots - np.where(np.isfinite(step) & (np.abs(step) < 1e-3 * np.abs(roots)), step, 0.0)
    return np.concatenate([np.zeros(still, complex), roots])
