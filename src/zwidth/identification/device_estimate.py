"""Represent an estimated device: its parameters with their covariance, random devices around it, and its response.

The parameters are the mass m, the damping b, the delay, those of an actuator lag, and those of resonances (*modes*), in
SI units; T is the sampling period. If the noise was estimated with a number of degrees of freedom, the errors of the
parameters have Student's t distribution; if it is known, they are normal. For a log, the estimate also contains the
frequency response with a radius at each frequency: the responses of all devices that agree with the log are within it.
K_max is the largest stable wall stiffness, B the virtual damping of a wall.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from zwidth.analysis.scene import Scene
from zwidth.model.actuator import Actuator
from zwidth.model.device import Device
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.mode import Mode
from zwidth.model.timing import Timing
from zwidth.model.velocity import Velocity
from zwidth.units.unit_system import LINEAR, UnitSystem

UPPER = 0.975  # probability that the true value is below the upper end of a 95 % confidence interval
_STEP = 0.1  # step of finite differences in the parameters, in standard errors
_TINY = 1e-40  # step of complex-step differentiation; its square is below the rounding error
RELIABILITY = 0.99  # proportion of devices on which a safe wall is stable, by default
_ROUNDS = 50  # largest number of rounds of random draws; if too few valid devices result, no devices are returned


class DimensionlessDevice(NamedTuple):
    """A device in units of its mass m and of the sampling period T; the fields are numbers or arrays that broadcast."""

    mass: Any  # mass m, kg
    delta: Any  # damping b T/m
    d: Any  # delay, in sampling periods
    lag: Any = ()  # time constant of the actuator in sampling periods and, for second order, its damping ratio
    modes: Any = ()  # for each mode the frequency in rad per sample, the damping ratio and the mass ratio m/m_i

    def to_parameters(self, period: Any) -> np.ndarray:
        """Return the parameters in SI units along the first axis of an array: mass, damping, delay, lag and modes."""
        mass, units = self.mass, [period, 1.0]
        values = [mass, self.delta * mass / period, self.d * period]
        values += [part * unit for part, unit in zip(self.lag, units, strict=False)]
        for frequency, ratio, mass_ratio in self.modes:
            values += [frequency * 0.5 / (np.pi * period), ratio, mass / mass_ratio]
        return np.array(values)

    @classmethod
    def from_parameters(cls, values: np.ndarray, period: float, lag: int) -> DimensionlessDevice:
        """Convert parameters in SI units to a dimensionless device.

        Args:
            values: parameters along the first axis, in the order of `name_parameters`.
            period: sampling period in s.
            lag: order of the actuator lag, 0 for none.
        """
        mass, modes = values[0], values[3 + lag :].reshape(-1, 3, *values.shape[1:])
        scaled = [(2.0 * np.pi * period * hertz, ratio, mass / modal_mass) for hertz, ratio, modal_mass in modes]
        delays = [part / unit for part, unit in zip(values[3 : 3 + lag], [period, 1.0], strict=False)]
        return cls(mass, values[1] / (mass / period), values[2] / period, delays, scaled)

    def to_scene(self, period: float, velocity: Velocity, system: UnitSystem = LINEAR) -> Scene:
        """Return the scene of the device with its delay and velocity estimate, without a wall."""
        lag, (mass, damping, delay, *parts) = len(self.lag), map(float, self.to_parameters(period))
        constant, *ratio = parts[:lag] or [None]
        actuator = Actuator(None, constant, lag, *ratio) if lag else None
        modes = [Mode(*parts[k : k + 3]) for k in range(lag, len(parts), 3)]
        device = Device(mass, damping, actuator=actuator, modes=modes, rotary=system.rotary)
        return Scene(device, Timing(period=period, delay=delay), velocity=velocity)


def differentiate(function: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
    """Differentiate an analytic function by complex steps, which have no cancellation error (Squire, Trapp 1998).

    Args:
        function: function of an array of parameters.
        values: the parameters at which it is differentiated.

    Returns:
        The derivatives with an additional last axis over the parameters.
    """
    return np.stack([np.imag(function(values + 1j * _TINY * unit)) / _TINY for unit in np.eye(values.size)], -1)


def name_parameters(scene: Scene) -> tuple[str, ...]:
    """List the paths of the fitted parameters of a scene, such as "mass" and "modes.0.frequency".

    The order is mass, damping, delay, parameters of the actuator lag, parameters of the modes.
    """
    actuator, modes = scene.device.actuator, range(len(scene.device.modes))
    lag = () if actuator is None else ("time_constant", *(["damping_ratio"] if actuator.order == 2 else []))
    of_mode = ("frequency", "damping_ratio", "mass")
    parts = [f"actuator.{name}" for name in lag] + [f"modes.{k}.{name}" for k in modes for name in of_mode]
    return ("mass", "damping", "delay", *parts)


def differentiate_stiffness_max(scene: Scene) -> tuple[float, np.ndarray]:
    """Return K_max of a scene, and an array of its derivatives with respect to the fitted parameters of the scene."""
    sensitivities = scene.sensitivities()
    return float(sensitivities.stiffness), np.array([sensitivities.per[path] for path in name_parameters(scene)])


def compute_coverage_factor(degrees_of_freedom: int | None, upper: float = UPPER) -> float:
    """Return the half-width of a confidence interval in standard errors: a quantile of the t or normal distribution.

    Args:
        degrees_of_freedom: degrees of freedom with which the noise was estimated; None if the noise is known.
        upper: probability that the true value is below the upper end of the interval.
    """
    from scipy.special import ndtri, stdtrit

    return float(ndtri(upper) if degrees_of_freedom is None else stdtrit(degrees_of_freedom, upper))


@dataclass(frozen=True, kw_only=True)
class DeviceEstimate:
    """An estimated device: its scene, the covariance of its parameters and, for a log, its frequency response."""

    nominal: Scene  # scene with the fitted parameters
    covariance: np.ndarray  # covariance of the parameters, in SI units
    noise: float | tuple[float, float]  # standard deviation of the position in m; for walls that of K and f, relative
    degrees_of_freedom: int | None = (
        None  # degrees of freedom with which the noise was estimated; None if the noise is given
    )
    response: MeasuredDevice | None = None  # response; its radius covers the largest undetected resonance
    measured_damping: float | None = None  # largest B of the measured walls, N s/m; None for a log
    measured_stiffness: float | None = None  # K measured at the largest B, N/m; None for a log

    # Make attributes of the fitted scene available as attributes of the estimate, because they are used often.
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
    def parameter_names(self) -> tuple[str, ...]:
        """The dotted paths of the fitted parameters, such as "modes.0.frequency", in the order of the covariance."""
        return name_parameters(self.nominal)

    @cached_property
    def estimates(self) -> np.ndarray:
        """The values of the fitted parameters in SI units, in the order of the covariance."""
        parameters = self.nominal.parameters()
        return np.array([parameters[name] for name in self.parameter_names])

    @property
    def coverage_factor(self) -> float:
        """The half-width of the 95 % confidence intervals, in standard errors."""
        return compute_coverage_factor(self.degrees_of_freedom)

    def normalize(self, drawn: np.ndarray) -> DimensionlessDevice:
        """Convert parameters in SI units to a batch of dimensionless devices.

        ``drawn`` has one row per device and one column per fitted parameter, in the order of the covariance.
        """
        lag = 0 if self.actuator is None else self.actuator.order
        return DimensionlessDevice.from_parameters(np.moveaxis(drawn, 1, 0), self.period, lag)

    def propagate_errors(self, evaluate: Callable[[Scene], Any]) -> np.ndarray:
        """Propagate the covariance of the parameters to a quantity computed from a scene, by finite differences.

        Args:
            evaluate: function that computes the quantity, a number or an array, from a scene.

        Returns:
            The linearized change of the quantity by one standard deviation along each principal axis of the covariance,
            one row per axis. The sum of the squared rows is the variance of the quantity.
        """
        values, middle, rows = self.estimates, evaluate(self.nominal), []
        for axis in _find_axes(self.covariance).T:
            step = _STEP * axis
            # Use a one-sided difference if a parameter would change its sign on one side, because most parameters must
            # not be negative.
            sides = [side for side in (-1.0, 1.0) if np.all((values + side * step) * np.where(values < 0, -1, 1) >= 0)]
            moved = [dict(zip(self.parameter_names, (values + side * step).tolist(), strict=True)) for side in sides]
            ends = [evaluate(self.nominal.replace(**each)) for each in moved]
            if len(sides) == 1:
                sides, ends = [0.0, *sides], [middle, *ends]
            change = (ends[-1] - ends[0]) / (_STEP * (sides[-1] - sides[0])) if sides else np.nan * middle
            rows.append(change)
        return np.array(rows)

    def draw(self, count: int) -> np.ndarray | None:
        """Draw the parameters of random devices from the distribution of the estimate, one row per device.

        The logarithm of the mass and the reciprocals of modal masses are drawn, because measurements determine the mass
        to a relative error and the response of a mode is proportional to the reciprocal of its modal mass. Devices with
        negative damping, delay or other parameters are drawn again.

        Args:
            count: number of devices.

        Returns:
            The parameters, one row per device, in the order of ``parameter_names``. None if the covariance is not
            finite, or if almost all drawn devices have negative parameters.
        """
        values = self.estimates
        if not np.all(np.isfinite(self.covariance)):
            return None
        # Mark the modal masses, because their reciprocals are drawn, and because they may have either sign.
        inverse = np.array([name.endswith(".mass") for name in self.parameter_names])
        center, slopes = values.copy(), np.ones(values.size)
        center[inverse], slopes[inverse] = 1.0 / values[inverse], -1.0 / values[inverse] ** 2
        center[0], slopes[0] = np.log(self.mass), 1.0 / self.mass
        root = _find_axes(self.covariance * np.outer(slopes, slopes))
        generator = np.random.default_rng(0)
        kept = np.zeros((0, values.size))
        for _ in range(_ROUNDS):
            spread = generator.standard_normal((count, values.size))
            if self.degrees_of_freedom is not None:
                spread /= np.sqrt(generator.chisquare(self.degrees_of_freedom, count) / self.degrees_of_freedom)[
                    :, None
                ]
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
        """Return a lower confidence limit in N/m of the onset stiffness measured at the largest B; 0 after a log fit.

        Args:
            confidence: probability that the true onset K is above the limit.
        """
        noise = self.noise[0] if isinstance(self.noise, tuple) else 0.0
        return max(
            0.0,
            (self.measured_stiffness or 0.0)
            * (1.0 - compute_coverage_factor(self.degrees_of_freedom, confidence) * noise),
        )

    @cached_property
    def response_scene(self) -> Scene | None:
        """The scene of the fitted response with a radius that covers one undetected resonance; None without a response.

        The radius covers the responses of 99 % of the devices that agree with the fitted parameters.
        """
        return self.build_response_scene(RELIABILITY, True)

    def build_response_scene(self, reliability: float, hidden: bool) -> Scene | None:
        """Build a scene that describes the device by its response with a radius, in place of the fitted parameters.

        A wall that is stable for all responses within the radius is stable on every device with such a response.

        Args:
            reliability: proportion of the devices that agree with the fitted parameters and their covariance whose
                response is within the radius. For a rigid device, the covariance does not contribute to the radius.
            hidden: True if the radius also covers one undetected resonance.

        Returns:
            The scene; None if the estimate has no response, or if the radius is not finite.
        """
        from scipy.special import fdtri

        fitted = self.response
        if fitted is None:
            return None
        radius = fitted.deviation if hidden else 0.0 * fitted.deviation
        if self.is_structured:
            changes = self.propagate_errors(lambda scene: scene.frequency_response(1.0, 0.0, fitted.frequency))
            # To first order, the confidence region of the response at one frequency is an ellipse in the complex plane.
            # Add the longer half-axis of the ellipse to the radius, so that the disk contains the ellipse.
            square, across = np.sum(np.abs(changes) ** 2, 0), np.abs(np.sum(changes**2, 0))
            count = len(self.parameter_names)
            reach = count * fdtri(count, self.degrees_of_freedom, reliability)
            radius = radius + np.sqrt(0.5 * (square + across) * reach)
        if not np.all(np.isfinite(radius)):
            return None
        device = MeasuredDevice(fitted.frequency, fitted.response, radius, fitted.rotary)
        return Scene(device, Timing(self.period), velocity=self.velocity)


def _find_axes(covariance: np.ndarray) -> np.ndarray:
    """Return a square root of a covariance: its principal axes scaled to one standard deviation, one per column."""
    # Decompose the correlation matrix, because the parameters have very different units. Leave exact parameters, whose
    # standard error is 0, unscaled.
    errors = np.sqrt(np.diag(covariance))
    errors = np.where(errors > 0, errors, 1.0)
    sizes, axes = np.linalg.eigh(covariance / np.outer(errors, errors))
    return errors[:, None] * axes * np.sqrt(np.maximum(sizes, 0.0))
