"""Compute the walls at the onset of instability as functions of the device parameters.

With z = e^(jw), w = 2 pi f T, a pole pair is on the unit circle if and only if

    K T^2 + B T F(z) = m q(z),     q = -1/G,

which are two real equations per wall (docs/theory/scenes.md). G is the response of the device, F the velocity estimate,
T the sampling period and f the frequency in Hz. For a given B the equations determine w and K; kappa = K T^2. The
unknowns of the fit are ``theta = (ln m, delta, d)``: the mass m, the damping delta = b T/m and the delay d in sampling
periods.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from zwidth.identification.device_estimate import DimensionlessDevice
from zwidth.model.circle_functions import CirclePoints, circle_points
from zwidth.model.estimate import Estimate
from zwidth.model.velocity import Velocity
from zwidth.plant.rigid_mass import differentiate_mass
from zwidth.plant.sampled_plant import SampledPlant, evaluate_numerator, sample_parts
from zwidth.units.unit_system import LINEAR, UnitSystem

# Constants of the Newton iteration, which solves the imaginary part of the equation for w, in rad per sample.
STEPS = 25  # largest number of Newton steps
LONGEST = 0.15  # largest Newton step, relative to w, so that the iteration stays close to the measured frequency
CONVERGED = 1e-9  # relative Newton step at which the iteration ends; the convergence is quadratic, so w is then exact
SOLVED = 1e-6  # largest relative size of the last Newton step with which a result is accepted as converged


class PredictedWalls(NamedTuple):
    """Walls at the onset of instability that a device has at the measured values of B."""

    kappa: np.ndarray  # stiffness K T^2 of each wall, kg
    w: np.ndarray  # frequency of each wall, rad per sample
    converged: np.ndarray  # mask of the walls for which the iteration converged
    differentiate: Callable[
        [], np.ndarray
    ]  # function that returns the derivatives of ln kappa and ln w with respect to theta, shape (walls, 2, 3)


@dataclass(frozen=True)
class Onsets:
    """Measured walls at the onset of instability, with the velocity estimate and the sampling period of the loop."""

    kappa: np.ndarray  # measured stiffness K T^2 of each wall, kg
    scaled_damping: np.ndarray  # measured damping B T of each wall, kg
    w: np.ndarray  # measured frequency of each wall, rad per sample
    velocity: Velocity
    period: float  # sampling period T, s
    system: UnitSystem = LINEAR

    @cached_property
    def _estimate(self) -> Estimate:
        """The velocity estimate, discretized with the sampling period."""
        return self.velocity.estimate(self.period)

    def normalize(self, theta: np.ndarray) -> DimensionlessDevice:
        """Convert theta to a rigid device in units of its mass and of the sampling period."""
        return DimensionlessDevice(np.exp(theta[0]), *theta[1:3])

    def predict_walls(self, theta: np.ndarray) -> PredictedWalls:
        """Compute the walls at the onset of instability of the device theta, at the measured values of B.

        The frequency w of each wall is computed by Newton's method from the measured frequency.
        """
        mass, plant, estimate, w = np.exp(theta[0]), sample_parts(*theta[1:3]), self._estimate, self.w
        step = np.full(w.shape, np.inf)
        for _ in range(STEPS):
            points = circle_points(w)
            f, q = estimate.jet(points), plant.rigid_controller(points)
            residual, slope = (
                (self.scaled_damping * f.value - mass * q.value).imag,
                (self.scaled_damping * f.slope - mass * q.slope).imag,
            )
            step = np.clip(-residual / slope, -LONGEST * w, LONGEST * w)
            w = np.minimum(w + step, 0.5 * (w + np.pi))
            # Walls with a NaN step do not prolong the iteration, because comparisons with NaN are false. Their step
            # stays NaN.
            if not np.any(np.abs(step) > CONVERGED * w):
                break
        points = circle_points(w)
        f, q = estimate.jet(points), plant.rigid_controller(points)
        kappa = (mass * q.value - self.scaled_damping * f.value).real

        def differentiate() -> np.ndarray:
            # Differentiating kappa + B T F = m q gives d kappa + (B T F' - m q') dw = d(m q), with d(m q) at fixed w.
            # The imaginary part of this equation determines dw, and the real part d kappa.
            moved = mass * np.stack([q.value, *_differentiate_controller(plant, theta[1], points, q.value)], -1)
            by_w = (self.scaled_damping * f.slope - mass * q.slope)[:, None]
            dw = moved.imag / by_w.imag
            return np.stack([(moved.real - by_w.real * dw) / kappa[:, None], dw / w[:, None]], 1)

        return PredictedWalls(kappa, w, np.abs(step) <= SOLVED * w, differentiate)

    def list_starts(self, deltas: np.ndarray, longest: float, count: int) -> list[np.ndarray]:
        """Return initial values of theta, sorted by cost: the best local minima on a grid of delta and d.

        The cost is the sum over the walls of ``|ln((kappa + B T F)/(m q))|^2``.

        Args:
            deltas: values of delta in the grid.
            longest: largest delay d in the grid.
            count: largest number of initial values.
        """
        from scipy.ndimage import minimum_filter

        delays = np.linspace(0.0, longest, max(8, int(np.ceil(longest * self.w.max() / 0.1))) + 1)
        points = circle_points(self.w)
        q = sample_parts(deltas[:, None, None], delays[:, None]).controller(points)
        errors = np.log((self.kappa + self.scaled_damping * self._estimate.jet(points).value) / q)
        # At fixed delta and d, the cost is quadratic in ln m, so that the optimal ln m is the mean of the real parts of
        # the logarithms.
        log_mass = errors.real.mean(-1)
        cost = (errors.imag**2).sum(-1) + ((errors.real - log_mass[..., None]) ** 2).sum(-1)
        lowest = np.argwhere(cost == minimum_filter(cost, 3, mode="constant", cval=np.inf))
        minima = sorted(lowest.tolist(), key=lambda index: cost[tuple(index)])[:count]
        return [np.array([log_mass[i, j], deltas[i], delays[j]]) for i, j in minima]


def _differentiate_controller(
    plant: SampledPlant, delta: float, points: CirclePoints, q: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of the critical controller q of a rigid mass with respect to damping delta and delay d.

    Args:
        plant: the sampled rigid mass.
        delta: normalized damping b T/m of the mass.
        points: points of the unit circle.
        q: value of q at these points.
    """
    by_delta, by_fraction = differentiate_mass(delta, plant.fraction)
    numerator = evaluate_numerator(plant.rigid, points)
    return (
        q * (by_delta.em / (points.z_minus_1 + plant.rigid.em) - evaluate_numerator(by_delta, points) / numerator),
        -q * evaluate_numerator(by_fraction, points) / numerator,
    )
