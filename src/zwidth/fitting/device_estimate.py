"""Estimate of a device from records: its parameters with their covariance, as a scene, and random devices around it.

The parameters are mass, damping and delay, those of an actuator lag, and those of resonances (*modes*), in SI units. A
fit with d degrees of freedom has parameters with Student's t distribution; with known noise they are normal. The
response of the estimated device with a radius around it describes all devices that agree with the records.
"""

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

UPPER = 0.975  # probability below the upper end of a 95 % interval
_STEP = 0.1  # step of central differences, in standard deviations
_TINY = 1e-40  # complex step of derivatives; its square is below the rounding error
RELIABILITY = 0.99  # default of the proportion of devices on which a safe wall is stable
_ROUNDS = 50  # rounds of random draws, after which an estimate with mostly impossible devices is given up


class DimensionlessDevice(NamedTuple):
    """A device in units of its mass and of the sampling period; the fields are numbers or arrays that broadcast."""

    mass: Any  # m, kg
    delta: Any  # b T/m
    d: Any  # delay, in periods
    lag: Any = ()  # time constant of the actuator in periods and, for second order, its damping ratio
    modes: Any = ()  # for each mode the frequency in rad per sample, the damping ratio and the mass ratio m/m_i

    def to_parameters(self, period: Any) -> np.ndarray:
        """Return the parameters in SI units, in the order of `name_parameters`, along the first axis."""
        mass, units = self.mass, [period, 1.0]
        values = [mass, self.delta * mass / period, self.d * period]
        values += [part * unit for part, unit in zip(self.lag, units, strict=False)]
        for frequency, ratio, mass_ratio in self.modes:
            values += [frequency * 0.5 / (np.pi * period), ratio, mass / mass_ratio]
        return np.array(values)

    @classmethod
    def from_parameters(cls, values: np.ndarray, period: float, lag: int) -> DimensionlessDevice:
        """Return the device with the parameters along the first axis of ``values``; ``lag`` is the order of its lag."""
        mass, modes = values[0], values[3 + lag :].reshape(-1, 3, *values.shape[1:])
        scaled = [(2.0 * np.pi * period * hertz, ratio, mass / modal_mass) for hertz, ratio, modal_mass in modes]
        delays = [part / unit for part, unit in zip(values[3 : 3 + lag], [period, 1.0], strict=False)]
        return cls(mass, values[1] / (mass / period), values[2] / period, delays, scaled)

    def to_scene(self, period: float, velocity: Velocity, system: UnitSystem = LINEAR) -> Scene:
        """Return the loop of the device, without a wall."""
        lag, (mass, damping, delay, *parts) = len(self.lag), map(float, self.to_parameters(period))
        constant, *ratio = parts[:lag] or [None]
        actuator = Actuator(None, constant, lag, *ratio) if lag else None
        modes = [Mode(*parts[k : k + 3]) for k in range(lag, len(parts), 3)]
        device = Device(mass, damping, actuator=actuator, modes=modes, rotary=system.rotary)
        return Scene(device, Timing(period=period, delay=delay), velocity=velocity)


def differentiate(function: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
    """Return the derivatives of an analytic function, one column per argument, exact to rounding error.

    Complex steps have no cancellation (Squire, Trapp 1998).
    """
    return np.stack([np.imag(function(values + 1j * _TINY * unit)) / _TINY for unit in np.eye(values.size)], -1)


def name_parameters(scene: Scene) -> tuple[str, ...]:
    """Return the paths of the fitted parameters: mass, damping, delay, and those of actuator lag and modes."""
    actuator, modes = scene.device.actuator, range(len(scene.device.modes))
    lag = () if actuator is None else ("time_constant", *(["damping_ratio"] if actuator.order == 2 else []))
    of_mode = ("frequency", "damping_ratio", "mass")
    parts = [f"actuator.{name}" for name in lag] + [f"modes.{k}.{name}" for k in modes for name in of_mode]
    return ("mass", "damping", "delay", *parts)


def differentiate_stiffness_max(scene: Scene) -> tuple[float, np.ndarray]:
    """Return K_max of a scene and its derivatives in the parameters of `name_parameters`."""
    sensitivities = scene.sensitivities()
    return float(sensitivities.stiffness), np.array([sensitivities.per[path] for path in name_parameters(scene)])


def compute_reach(freedom: int | None, upper: float = UPPER) -> float:
    """Return the half-width of a confidence interval, in standard errors.

    Args:
        freedom: degrees of freedom with which the noise was estimated; None if it is known.
        upper: probability below the upper end of the interval.
    """
    from scipy.special import ndtri, stdtrit

    return float(ndtri(upper) if freedom is None else stdtrit(freedom, upper))


@dataclass(frozen=True, kw_only=True)
class DeviceEstimate:
    """An estimate of a device with its uncertainty; the attributes are described in `zwidth.DeviceFit`."""

    nominal: Scene  # the fitted loop
    covariance: np.ndarray  # of the parameters, in SI units
    noise: float | tuple[float, float]  # of the position in m; for walls the relative noise of K and f
    freedom: int | None = None  # degrees of freedom with which the noise was estimated; None if it is given
    response: MeasuredDevice | None = None  # of the device, with a radius for an undetected resonance
    damping_tried: float | None = None  # largest B of the measured walls, N s/m
    stiffness_tried: float | None = None  # K measured at this B, N/m

    # Attributes of the fitted scene.
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
        """The paths of the fitted parameters, in the order of the covariance."""
        return name_parameters(self.nominal)

    @cached_property
    def estimates(self) -> np.ndarray:
        """The values of the fitted parameters, in the order of ``numbers``."""
        parameters = self.nominal.parameters()
        return np.array([parameters[name] for name in self.numbers])

    @property
    def reach(self) -> float:
        """The half-width of the 95 % confidence intervals, in standard errors."""
        return compute_reach(self.freedom)

    def normalize(self, drawn: np.ndarray) -> DimensionlessDevice:
        """Return devices with other parameters, given in the order of ``numbers``, one row per device."""
        lag = 0 if self.actuator is None else self.actuator.order
        return DimensionlessDevice.from_parameters(np.moveaxis(drawn, 1, 0), self.period, lag)

    def propagate_errors(self, evaluate: Callable[[Scene], Any]) -> np.ndarray:
        """Return the linearized change of a quantity by one standard deviation along each axis of the covariance.

        Args:
            evaluate: function that computes the quantity, a number or an array, from a scene.

        Returns:
            One row per axis. The sum of their squares is the variance of the quantity.
        """
        values, middle, rows = self.estimates, evaluate(self.nominal), []
        for axis in _find_axes(self.covariance).T:
            step = _STEP * axis
            # Use a one-sided difference if a parameter would change its sign on the other side.
            sides = [side for side in (-1.0, 1.0) if np.all((values + side * step) * np.where(values < 0, -1, 1) >= 0)]
            moved = [dict(zip(self.numbers, (values + side * step).tolist(), strict=True)) for side in sides]
            ends = [evaluate(self.nominal.replace(**each)) for each in moved]
            if len(sides) == 1:
                sides, ends = [0.0, *sides], [middle, *ends]
            change = (ends[-1] - ends[0]) / (_STEP * (sides[-1] - sides[0])) if sides else np.nan * middle
            rows.append(change)
        return np.array(rows)

    def draw(self, count: int) -> np.ndarray | None:
        """Draw parameters of random devices around the estimate, in the order of ``numbers``, one row per device.

        The logarithm of the mass and the reciprocals of modal masses are drawn, because measurements determine the mass
        to a relative error and the response of a mode is proportional to the reciprocal of its modal mass. Devices with
        negative damping, delay or other parameters are drawn again.

        Args:
            count: number of devices.

        Returns:
            The parameters; None if the covariance is not finite or almost all devices are impossible.
        """
        values = self.estimates
        if not np.all(np.isfinite(self.covariance)):
            return None
        # Modal masses may have any sign.
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
            devices = center + spread @ root.T
            devices = devices[np.all((devices >= 0) | inverse | (np.arange(values.size) == 0), 1)]
            with np.errstate(over="ignore", divide="ignore"):
                devices[:, 0] = np.exp(devices[:, 0])
                devices[:, inverse] = 1.0 / devices[:, inverse]
            kept = np.concatenate([kept, devices])
            if len(kept) >= count:
                return kept[:count]
        return None

    def bound_measured_stiffness(self, confidence: float) -> float:
        """Return the lower confidence limit of the K measured at the largest B, in N/m; 0 for a log.

        Args:
            confidence: probability that the true K is above the limit.
        """
        noise = self.noise[0] if isinstance(self.noise, tuple) else 0.0
        return max(0.0, (self.stiffness_tried or 0.0) * (1.0 - compute_reach(self.freedom, confidence) * noise))

    @cached_property
    def response_scene(self) -> Scene | None:
        """The scene of `build_response_scene` with undetected resonances, at the default reliability."""
        return self.build_response_scene(RELIABILITY, True)

    def build_response_scene(self, reliability: float, hidden: bool) -> Scene | None:
        """Build the loop with the response of the device and its radius, in place of the fitted parameters.

        A wall that is stable for all responses within the radius is stable on all devices that these describe.

        Args:
            reliability: proportion of devices whose response the radius covers, for a device with a lag or modes; the
                parameters of a rigid device do not enter the radius.
            hidden: include one undetected resonance in the radius.

        Returns:
            The scene; None without a response, or if the parameters are too uncertain for a finite radius.
        """
        from scipy.special import fdtri

        fitted = self.response
        if fitted is None:
            return None
        radius = fitted.deviation if hidden else 0.0 * fitted.deviation
        if self.is_structured:
            changes = self.propagate_errors(lambda scene: scene.frequency_response(1.0, 0.0, fitted.frequency))
            # To first order, the confidence region of the response at a frequency is an ellipse in the complex plane;
            # add its longer half-axis.
            square, across = np.sum(np.abs(changes) ** 2, 0), np.abs(np.sum(changes**2, 0))
            count = len(self.numbers)
            reach = count * fdtri(count, self.freedom, reliability)
            radius = radius + np.sqrt(0.5 * (square + across) * reach)
        if not np.all(np.isfinite(radius)):
            return None
        device = MeasuredDevice(fitted.frequency, fitted.response, radius, fitted.rotary)
        return Scene(device, Timing(self.period), velocity=self.velocity)


def _find_axes(covariance: np.ndarray) -> np.ndarray:
    """Return one standard deviation along each axis of a covariance, one column per axis."""
    # Use the correlations, because the parameters have very different units. Exact parameters have no error.
    errors = np.sqrt(np.diag(covariance))
    errors = np.where(errors > 0, errors, 1.0)
    sizes, axes = np.linalg.eigh(covariance / np.outer(errors, errors))
    return errors[:, None] * axes * np.sqrt(np.maximum(sizes, 0.0))
