"""Continuous-time model of a mechanism (*chain*): up to three bodies in a row, structural modes and an actuator.

The bodies are the motor side of the device, its tip (the second mass behind a compliant coupling) and the hand of the
operator. Each has a damper and a spring to ground; neighboring bodies are connected by a *link*, a spring and a damper.
The actuator force acts on the first body and on the modes; an *external force*, held constant over each sampling
period, acts on the first body only. The modes add to the measured position. Times are in sampling periods T and masses
in units of the mass of the first body (V1 and V2 in docs/theory/scenes.md). With the commanded force u, the state-space
model is

    x' = A x + B u,   x = (y, e2, e3, q1, .., y', e2', e3', q1', .., a, a')

with the measured position y, the extensions e of the links, the displacements q of the modes, and the actuator force a.
Extensions in place of positions avoid small differences of large numbers, and the first state is the output.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.xp import namespace
from zwidth.model.estimate import Estimate
from zwidth.model.linear_device import LinearDevice
from zwidth.model.linear_plant import FASTEST, STRONGEST, Realization, System
from zwidth.model.loop_estimates import LoopEstimates, build_estimates
from zwidth.model.parameter_paths import Parts


class Body(NamedTuple):
    """A mass with a damper and a spring to ground, in units of the sampling period and the mass of the first body."""

    mass: Any
    damping: Any
    stiffness: Any


class Link(NamedTuple):
    """The spring and the damper between two neighboring bodies, in units of the period and the first body's mass."""

    stiffness: Any
    damping: Any


class Resonance(NamedTuple):
    """Transfer function ``(1/mass)/(s^2 + 2 zeta w s + w^2)`` of a structural mode, or of an actuator of second order.

    For an actuator, the mass is 1/w^2, so that the static gain is 1.
    """

    rate: Any  # natural frequency w in rad per period
    damping_ratio: Any  # damping ratio zeta
    mass: Any

    @property
    def poles(self) -> np.ndarray:
        """The two roots of s^2 + 2 zeta w s + w^2, complex numbers in rad per period."""
        w, zeta = float(self.rate), float(self.damping_ratio)
        root = np.sqrt(complex(zeta * zeta - 1.0))
        # Compute the slower of two real poles as w^2 divided by the faster one, because zeta - root would cancel.
        fast = -w * (zeta + root)
        return np.array([fast, w * w / fast if root.real else fast.conjugate()])


@dataclass(frozen=True)
class Chain:
    """The plant of a device with known masses, together with the delay of the force and the velocity estimate."""

    bodies: tuple[Body, ...]
    links: tuple[Link, ...]
    modes: tuple[Resonance, ...]
    actuator: Resonance | Any | None  # `Resonance` for order 2, corner frequency in rad per period for order 1
    sensor: int  # index of the body whose position is measured
    d: Any  # delay in periods
    n_delay: int  # integer part of d
    estimate: Estimate  # velocity estimate; divided by the position estimate if ``estimates`` is not None
    estimates: LoopEstimates | None = None  # None if there is neither a position estimate nor further feedback

    sampled: ClassVar[bool] = False

    @property
    def rigid(self) -> bool:
        """True if the device is a single mass with a damper to ground, without spring, modes and actuator lag."""
        return len(self.bodies) == 1 and self.drives_body_only and is_zero(self.bodies[0].stiffness)

    @property
    def drives_body_only(self) -> bool:
        """True if the device has no modes and no actuator lag; a commanded force then acts like an external force."""
        return not self.modes and self.actuator is None

    @property
    def has_integrator(self) -> bool:
        """True if the device has a pole at s = 0, because no spring connects it to ground."""
        return all(body.stiffness == 0 for body in self.bodies)

    def state_units(self, speed: float, force: float) -> list[float]:
        """Return the list of the units of all states in SI, with 1 m as the unit of positions.

        Args:
            speed: unit of velocities in m/s for positions in m, i.e. 1/T.
            force: unit of forces in N.
        """
        count = len(self.bodies) + len(self.modes)
        actuator_states = 0 if self.actuator is None else 2 if isinstance(self.actuator, Resonance) else 1
        return [1.0] * count + [speed] * count + [force, force * speed][:actuator_states]

    def realize(self) -> Realization:
        """Return A, B and the input vector of the external force.

        The parameters may be floats, JAX arrays or balls (intervals of python-flint).
        """
        lag = self.actuator
        parameters = [value for part in (*self.bodies, *self.links, *self.modes) for value in part]
        xp = namespace(*parameters, *(lag if isinstance(lag, Resonance) else () if lag is None else (lag,)))
        bodies, modes = len(self.bodies), len(self.modes)
        count, actuator_states = bodies + modes, 0 if lag is None else 2 if isinstance(lag, Resonance) else 1
        size = 2 * count + actuator_states
        zero = xp.asarray(0.0 * (self.bodies[0].mass + self.bodies[-1].damping + sum(mode.rate for mode in self.modes)))
        # Every quantity is a linear combination of the states, the command and the external force. Represent it by the
        # vector of its coefficients. The vectors of the states and of both inputs are the unit vectors in ``axes``.
        axes = xp.asarray(np.eye(size + 2).astype(zero.dtype)).reshape(size + 2, size + 2, *[1] * zero.ndim)
        command, external = axes[size:]
        actuator_force = command if lag is None else axes[2 * count]
        forces = [
            link.stiffness * axes[k] + link.damping * axes[count + k] for k, link in enumerate(self.links, start=1)
        ]
        # Add a zero force before the first and after the last body, because no link connects them to a further body.
        forces = [zero, *forces, zero]
        accelerations = []
        for k, body in enumerate(self.bodies):
            terms = express_body_position(k, self.sensor, bodies, modes)
            position, speed = (sum(sign * axes[start + j] for j, sign in terms) for start in (0, count))
            force = forces[k + 1] - forces[k] - body.stiffness * position - body.damping * speed
            accelerations.append((force if k else force + actuator_force + external) / body.mass)
        mode_accelerations = [
            actuator_force / mode.mass
            - mode.rate * mode.rate * axes[bodies + k]
            - 2.0 * mode.damping_ratio * mode.rate * axes[count + bodies + k]
            for k, mode in enumerate(self.modes)
        ]
        rows = [*axes[count : 2 * count], sum(mode_accelerations, accelerations[self.sensor])]
        rows += [accelerations[k] - accelerations[k - 1] for k in range(1, bodies)] + mode_accelerations
        if isinstance(lag, Resonance):
            damping_term = 2.0 * lag.damping_ratio * lag.rate * axes[size - 1]
            rows += [axes[size - 1], lag.rate * lag.rate * (command - axes[size - 2]) - damping_term]
        elif lag is not None:
            rows.append(lag * (command - axes[size - 1]))
        table = xp.stack([row + zero for row in rows])
        return Realization(table[:, :size], table[:, size], table[:, size + 1])

    @cached_property
    def continuous(self) -> tuple[np.ndarray, np.ndarray]:
        """The finite zeros and the poles of the response from command to position, two arrays in rad per period."""
        numerator, denominator = expand_compliance(self)
        poles = [_find_roots(denominator), *(mode.poles for mode in self.modes)]
        factors = [np.array([1.0, 2.0 * m.damping_ratio * m.rate, m.rate * m.rate], float) for m in self.modes]
        numerator = reduce(np.convolve, factors, numerator)
        for k, mode in enumerate(self.modes):
            numerator = np.polyadd(
                numerator, reduce(np.convolve, factors[:k] + factors[k + 1 :], denominator / float(mode.mass))
            )
        if self.actuator is not None:
            lag = self.actuator
            poles.append(lag.poles if isinstance(lag, Resonance) else np.array([-float(lag)]))
        return _find_roots(np.trim_zeros(numerator, "f")), np.concatenate(poles).astype(complex)

    def check(self) -> None:
        """Raise `InputError` if a resonance or damper is too fast to compute the matrix exponential e^A accurately."""
        smallest_mass = min(float(body.mass) for body in self.bodies)
        rates = {"coupling.stiffness: the link": [float(link.stiffness / smallest_mass) ** 0.5 for link in self.links]}
        rates["modes.frequency: the mode"] = [float(mode.rate) for mode in self.modes]
        lag = self.actuator.rate if isinstance(self.actuator, Resonance) else self.actuator
        rates["actuator.cutoff: the actuator"] = [] if lag is None else [float(lag)]
        for label, values in rates.items():
            if max(values, default=0.0) > FASTEST:
                name = label.partition(".")[0]
                raise InputError(
                    f"{label} oscillates {max(values) / (2 * np.pi):.3g} times per period, too fast to compute; "
                    f"omit the {name}, {'because the link is rigid' if name == 'coupling' else 'which is negligible'}"
                )
        first, *others = [float(body.damping / body.mass) for body in self.bodies]
        dampers = {"damping": [first], "operator.damping": others}
        dampers["coupling.damping"] = [float(link.damping / smallest_mass) for link in self.links]
        ratio = [2.0 * float(lag.damping_ratio * lag.rate)] if isinstance(lag, Resonance) else []
        for name, values in (dampers | {"actuator.damping_ratio": ratio}).items():
            if max(values, default=0.0) > STRONGEST:
                raise InputError(
                    f"{name}: the damper stops all motion within {1.0 / max(values):.3g} periods, too fast to compute; "
                    "check its unit"
                )


AnyChain: TypeAlias = Chain | System
"""The plant of a loop: bodies with known parameters, or a linear system."""


def build_chain(scene: Parts, delay: tuple[Any, int] | None = None, estimate: Estimate | None = None) -> AnyChain:
    """Build the plant of a scene, normalized by the sampling period and the mass of the first body.

    Args:
        scene: the scene.
        delay: delay in periods and its integer part, required if JAX traces the delay. Default: the scene's delay.
        estimate: velocity estimate that replaces the scene's.
    """
    device, timing, hand = scene.device, scene.timing, scene.operator
    period = timing.period
    d, n_delay = delay or (timing.d, int(np.floor(timing.d)))
    estimates = None
    if estimate is None:
        estimates = build_estimates(scene)
        estimate = scene.velocity.estimate(period) if estimates is None else estimates.divide()[0]
    if isinstance(device, LinearDevice):
        # If the period is a ball (interval), convert the mass to a ball of radius 0, because `System` then uses ball
        # arithmetic.
        mass = type(period)(device.mass) if hasattr(period, "mid") else device.mass
        return System(device, period, mass, d, n_delay, estimate, estimates)
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
    stiffness_factor, damping_factor = period * period / unit, period / unit
    # Keep a zero stiffness as a plain 0, because its product with a traced period would no longer be recognized as
    # zero.
    bodies = tuple(
        Body(m / unit, b * damping_factor, 0.0 if is_zero(k) else k * stiffness_factor) for m, b, k in masses
    )
    normalized_links = tuple(Link(k * stiffness_factor, c * damping_factor) for k, c in links)
    sensor = 1 if device.coupling is not None and device.coupling.sensor == "tip" else 0
    modes = tuple(Resonance(mode.rate * period, mode.damping_ratio, mode.mass / unit) for mode in device.modes)
    lag = device.actuator
    actuator: Any = None if lag is None else lag.rate * period
    if lag is not None and lag.order == 2:
        actuator = Resonance(actuator, lag.damping_ratio, 1.0 / (actuator * actuator))
    return Chain(bodies, normalized_links, modes, actuator, sensor, d, n_delay, estimate, estimates)


def is_zero(value: Any) -> bool:
    """Return whether a value is a number equal to zero; False for values that JAX traces."""
    return isinstance(value, float | np.floating) and value == 0.0


def express_body_position(body: int, sensor: int, bodies: int, modes: int) -> list[tuple[int, float]]:
    """Return the indices and signs of the states whose sum is the position of a body.

    Args:
        body: index of the body.
        sensor: index of the body whose position is measured.
        bodies: number of bodies.
        modes: number of modes.
    """
    extensions = [(j, 1.0) for j in range(sensor + 1, body + 1)] + [(j, -1.0) for j in range(body + 1, sensor + 1)]
    return [(0, 1.0), *extensions, *((j, -1.0) for j in range(bodies, bodies + modes))]


def expand_compliance(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Return numerator and denominator of the response from actuator force to the position of the sensor body.

    Both are arrays of coefficients in s, highest power first. Modes are not included.
    """
    # Add the bodies one by one, from the last one to the first. numerator/denominator is the dynamic stiffness of the
    # bodies added so far: a force on the body added last, divided by the position of this body. Once the sensor body is
    # added, its position divided by this force is sensor_numerator/numerator. All terms are positive, so that nothing
    # cancels and slow roots are accurate.
    numerator, denominator, sensor_numerator = np.zeros(0), np.ones(1), np.ones(1)
    for k in reversed(range(len(chain.bodies))):
        body = chain.bodies[k]
        dynamic_stiffness = np.array([body.mass, body.damping, body.stiffness], float)
        if numerator.size:
            link = np.array([chain.links[k].damping, chain.links[k].stiffness], float)
            denominator = np.polyadd(np.convolve(link, denominator), numerator)
            # Connect the link in series with the bodies added so far: their joint dynamic stiffness is link * numerator
            # / (link * denominator + numerator). The divisor is the new denominator.
            numerator = np.polyadd(np.convolve(dynamic_stiffness, denominator), np.convolve(link, numerator))
            sensor_numerator = denominator if k == chain.sensor else np.convolve(link, sensor_numerator)
        else:
            numerator = dynamic_stiffness
    return np.trim_zeros(sensor_numerator, "f"), np.trim_zeros(numerator, "f")


def _find_roots(polynomial: np.ndarray) -> np.ndarray:
    """Return the roots of a polynomial given by its coefficients, highest power first, refined by two Newton steps."""
    n_zero = polynomial.size - 1 - int(np.flatnonzero(polynomial)[-1])
    rest = polynomial[: polynomial.size - n_zero]
    if rest.size % 2 and not rest[1::2].any():
        # Without damping, the polynomial contains only even powers. Solve it for s^2, because the square roots are then
        # exactly on the imaginary axis.
        half = np.sqrt(np.roots(rest[::2]).astype(complex))
        roots = np.concatenate([half, -half])
    else:
        roots = np.roots(rest).astype(complex)
    for _ in range(2):
        with np.errstate(all="ignore"):
            step = np.polyval(rest, roots) / np.polyval(np.polyder(rest), roots)
        # Skip large steps, because they indicate a multiple root, where Newton's method does not converge fast.
        roots = roots - np.where(np.isfinite(step) & (np.abs(step) < 1e-3 * np.abs(roots)), step, 0.0)
    return np.concatenate([np.zeros(n_zero, complex), roots])
