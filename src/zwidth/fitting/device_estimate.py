"""A device as records leave it: its scene, the covariance of its numbers, and what the records say of other devices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from zwidth.parts.actuator import Actuator
from zwidth.parts.device import Device
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.mode import Mode
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import Velocity
from zwidth.scenes.scene import Scene
from zwidth.words.unit_system import LINEAR, UnitSystem

# Of the upper ends of intervals of 95 %.
UPPER = 0.975
# Of standard errors, for differences; of complex numbers, whose square is lost beside 1.
_STEP, _TINY = 0.1, 1e-40
# Of the usual safe wall.
RELIABILITY = 0.99
# Rounds of draws; where most are impossible, the estimate says nothing.
_ROUNDS = 50


class DimensionlessDevice(NamedTuple):
    """A device in units of its mass and of the sampling period, arrays that broadcast.

    ``mass`` in kg, ``delta = b T/m``, the delay in periods, of an amplifier its time constant in periods (and of second
    order its damping ratio), of each mode its frequency in radians a period, damping ratio and ``m/m_i``.
    """

    mass: Any
    delta: Any
    d: Any
    lag: Any = ()
    modes: Any = ()

    def to_numbers(self, period: Any) -> np.ndarray:
        """Its numbers in SI units, as `name_numbers` names them."""
        mass, units = self.mass, [period, 1.0]
        values = [mass, self.delta * mass / period, self.d * period]
        values += [part * unit for part, unit in zip(self.lag, units, strict=False)]
        for turns, ratio, share in self.modes:
            values += [turns * 0.5 / (np.pi * period), ratio, mass / share]
        return np.array(values)

    @classmethod
    def of_numbers(cls, values: np.ndarray, period: float, lag: int) -> DimensionlessDevice:
        """Return the device with the parameters along the first axis of ``values``; ``lag`` is the order of its lag."""
        mass, modes = values[0], values[3 + lag :].reshape(-1, 3, *values.shape[1:])
        ringing = [(2.0 * np.pi * period * hertz, ratio, mass / own) for hertz, ratio, own in modes]
        delays = [part / unit for part, unit in zip(values[3 : 3 + lag], [period, 1.0], strict=False)]
        return cls(mass, values[1] / (mass / period), values[2] / period, delays, ringing)

    def to_scene(self, period: float, velocity: Velocity, system: UnitSystem = LINEAR) -> Scene:
        """Return the loop of the device, without a wall."""
        lag, (mass, damping, delay, *beside) = len(self.lag), map(float, self.to_numbers(period))
        constant, *ratio = beside[:lag] or [None]
        actuator = Actuator(None, constant, lag, *ratio) if lag else None
        modes = [Mode(*beside[k : k + 3]) for k in range(lag, len(beside), 3)]
        device = Device(mass, damping, actuator=actuator, modes=modes, rotary=system.rotary)
        return Scene(device, Timing(period=period, delay=delay), velocity=velocity)


def differentiate(function: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
    """The derivatives of a smooth formula, a column each, by complex steps: exact to rounding (Squire, Trapp 1998)."""
    return np.stack([np.imag(function(values + 1j * _TINY * unit)) / _TINY for unit in np.eye(values.size)], -1)


def name_numbers(scene: Scene) -> tuple[str, ...]:
    """Paths of what is fitted: mass, damping, delay, and what stands beside the rigid mass."""
    actuator, modes = scene.device.actuator, range(len(scene.device.modes))
    lag = () if actuator is None else ("time_constant", *(["damping_ratio"] if actuator.order == 2 else []))
    of_mode = ("frequency", "damping_ratio", "mass")
    beside = [f"actuator.{name}" for name in lag] + [f"modes.{k}.{name}" for k in modes for name in of_mode]
    return ("mass", "damping", "delay", *beside)


def find_stiffest(scene: Scene) -> tuple[float, np.ndarray]:
    """K_max of a scene, and its derivatives in what `name_numbers` names."""
    slopes = scene.sensitivities()
    return float(slopes.stiffness), np.array([slopes.per[path] for path in name_numbers(scene)])


def reach_of(freedom: int | None, upper: float = UPPER) -> float:
    """Standard errors to a side: of a known noise, or of one estimated with so many degrees of freedom."""
    from scipy.special import ndtri, stdtrit

    return float(ndtri(upper) if freedom is None else stdtrit(freedom, upper))


@dataclass(frozen=True, kw_only=True)
class DeviceEstimate:
    """What is known of a device; the attributes are those of `zwidth.DeviceFit`."""

    nominal: Scene
    covariance: np.ndarray
    noise: float | tuple[float, float]
    freedom: int | None = None
    response: MeasuredDevice | None = None
    damping_tried: float | None = None
    stiffness_tried: float | None = None

    # Of its scene: kg, N s/m, s, the period in s, and the parts that the records ask for.
    mass = property(attrgetter("nominal.device.mass"))
    damping = property(attrgetter("nominal.device.damping"))
    delay = property(attrgetter("nominal.timing.delay"))
    period = property(attrgetter("nominal.timing.period"))
    velocity = property(attrgetter("nominal.velocity"))
    actuator = property(attrgetter("nominal.device.actuator"))
    modes = property(attrgetter("nominal.device.modes"))
    unit_system = property(attrgetter("nominal.unit_system"))

    @property
    def is_structured(self) -> bool:
        """True if the device has an actuator lag or resonances."""
        return self.actuator is not None or bool(self.modes)

    @property
    def numbers(self) -> tuple[str, ...]:
        """Paths of what was fitted, in the order of the covariance: mass, damping, delay, and what more there is."""
        return name_numbers(self.nominal)

    @cached_property
    def estimates(self) -> np.ndarray:
        """The values of ``numbers``."""
        own = self.nominal.parameters()
        return np.array([own[name] for name in self.numbers])

    @property
    def reach(self) -> float:
        """How many standard errors the intervals reach."""
        return reach_of(self.freedom)

    def normalize(self, drawn: np.ndarray) -> DimensionlessDevice:
        """Devices of other values of ``numbers``, a row each."""
        lag = 0 if self.actuator is None else self.actuator.order
        return DimensionlessDevice.of_numbers(np.moveaxis(drawn, 1, 0), self.period, lag)

    def differ(self, ask: Callable[[Scene], Any]) -> np.ndarray:
        """By how much an answer changes along each axis of the covariance, one standard deviation far: a row each."""
        values, middle, rows = self.estimates, ask(self.nominal), []
        for axis in _find_axes(self.covariance).T:
            step = _STEP * axis
            # Where damping or delay would be negative, to one side.
            sides = [side for side in (-1.0, 1.0) if np.all((values + side * step) * np.where(values < 0, -1, 1) >= 0)]
            moved = [dict(zip(self.numbers, (values + side * step).tolist(), strict=True)) for side in sides]
            ends = [ask(self.nominal.replace(**each)) for each in moved]
            if len(sides) == 1:
                sides, ends = [0.0, *sides], [middle, *ends]
            change = (ends[-1] - ends[0]) / (_STEP * (sides[-1] - sides[0])) if sides else np.nan * middle
            rows.append(change)
        return np.array(rows)

    def draw(self, count: int) -> np.ndarray | None:
        """What ``numbers`` has of possible devices around the estimate, a row each; None if few are possible.

        The mass is drawn by its logarithm, for what walls and logs tell of it is a share, and of a mode what it moves.
        """
        values = self.estimates
        if not np.all(np.isfinite(self.covariance)):
            return None
        # By their reciprocals, and of any sign.
        inverse = np.array([name.endswith(".mass") for name in self.numbers])
        center, slopes = values.copy(), np.ones(values.size)
        center[inverse], slopes[inverse] = 1.0 / values[inverse], -1.0 / values[inverse] ** 2
        center[0], slopes[0] = np.log(self.mass), 1.0 / self.mass
        root = _find_axes(self.covariance * np.outer(slopes, slopes))
        generator = np.random.default_rng(0)
        kept = np.zeros((0, values.size))
        for _ in range(_ROUNDS):
            spread = generator.standard_normal((count, values.size))
            if self.freedom is not None:
                spread /= np.sqrt(generator.chisquare(self.freedom, count) / self.freedom)[:, None]
            some = center + spread @ root.T
            some = some[np.all((some >= 0) | inverse | (np.arange(values.size) == 0), 1)]
            with np.errstate(over="ignore", divide="ignore"):
                some[:, 0] = np.exp(some[:, 0])
                some[:, inverse] = 1.0 / some[:, inverse]
            kept = np.concatenate([kept, some])
            if len(kept) >= count:
                return kept[:count]
        return None

    def bear_tried(self, confidence: float) -> float:
        """What the K that buzzed at the largest damping tried is at least, by its noise."""
        noise = self.noise[0] if isinstance(self.noise, tuple) else 0.0
        return max(0.0, (self.stiffness_tried or 0.0) * (1.0 - reach_of(self.freedom, confidence) * noise))

    @cached_property
    def responding(self) -> Scene | None:
        """The same loop with the response in place of the device: what holds for every resonance within its radius.

        Of a device with an amplifier or resonances, the radius has what their numbers may be, too.
        """
        return self.respond(RELIABILITY, True)

    def respond(self, reliability: float, hidden: bool) -> Scene | None:
        """The loop of the response; within its radius are so many devices that the log allows, and what it may hide.

        None without a response, and where the numbers are too open for a radius.
        """
        from scipy.special import fdtri

        known = self.response
        if known is None:
            return None
        radius = known.deviation if hidden else 0.0 * known.deviation
        if self.is_structured:
            changes = self.differ(lambda scene: scene.frequency_response(1.0, 0.0, known.frequency))
            # The longer axis of the ellipse in which the response lies with the numbers.
            square, across = np.sum(np.abs(changes) ** 2, 0), np.abs(np.sum(changes**2, 0))
            count = len(self.numbers)
            reach = count * fdtri(count, self.freedom, reliability)
            radius = radius + np.sqrt(0.5 * (square + across) * reach)
        if not np.all(np.isfinite(radius)):
            return None
        device = MeasuredDevice(known.frequency, known.response, radius, known.rotary)
        return Scene(device, Timing(self.period), velocity=self.velocity)


def _find_axes(covariance: np.ndarray) -> np.ndarray:
    """One standard deviation along each axis of a covariance, a column each."""
    # Of very different units: by correlations. What is known exactly has none.
    errors = np.sqrt(np.diag(covariance))
    errors = np.where(errors > 0, errors, 1.0)
    sizes, axes = np.linalg.eigh(covariance / np.outer(errors, errors))
    return errors[:, None] * axes * np.sqrt(np.maximum(sizes, 0.0))
