"""Factor the sampled plant: compute its zeros, poles and gain.

With ``zeta = z - 1``, the plant is (`plant.sampled_states`; docs/theory/scenes.md, V4)

    G(z) = C (zeta - Psi)^-1 (zeta Gamma(1 - f) + Gamma(1)) / z^(n+1) = gain prod(z - zeros)/(z^lag prod(z - poles))

The poles follow from those of the continuous-time device, ``z = e^p``. The zeros of a rigid mass have a closed form;
the zeros of a linear system are computed in decimal arithmetic (`plant.sampled_zeros`), all others by Aberth's method.
Roots are stored as *offsets* 1 - root, because the poles of slow motions lie near z = 1 and would lose their
significant digits in z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zwidth.core.types import Array
from zwidth.model.circle_functions import CirclePoints, Jet, circle_points, power_jet, product_jet
from zwidth.model.linear_plant import System
from zwidth.model.mechanism import AnyChain, Chain
from zwidth.numerics.polynomials import compute_aberth_step
from zwidth.plant.rigid_mass import discretize_mass, factor_numerator
from zwidth.plant.sampled_states import SampledStates, sample_states
from zwidth.plant.sampled_zeros import find_sampled_zeros

# Settings for the zeros of G.
SLOW_ZERO = 0.1  # |zeta| below which the iteration for a zero starts from a zero of the continuous-time device
MAX_STEPS = 30  # largest number of Aberth steps
CONVERGED_STEP = 1e-13  # last Aberth step, relative to |zeta|
CLUSTER_RADIUS = 1e-2  # |z| of zeros near z = 0 that rounding errors may make inseparable
# Relative difference of q = -1/G from roots and q from matrices, above which the cluster is not refined.
RESPONSE_TOLERANCE = 1e-11
TEST_ANGLE = 0.5  # angle in rad per sample at which q from roots and q from matrices are compared
FAR_ZERO = 1e-17  # 1/|zeta| below which a zero is dropped, because it is far from the unit circle


@dataclass(frozen=True)
class FactoredPlant:
    """The sampled plant ``G(z) = gain prod(z - zeros)/(z^lag prod(z - poles))``, with the offsets of its roots."""

    gain: float
    lag: int
    zeros: Array
    poles: Array

    def evaluate_controller(self, points: CirclePoints) -> Jet:
        """Return the critical controller ``q = -1/G`` and its derivative in w at points of the unit circle."""
        quotient = product_jet(points, self.poles, -1.0).over(product_jet(points, self.zeros, self.gain))
        return quotient.times(power_jet(points, self.lag))

    def evaluate_response(self, points: CirclePoints) -> Jet:
        """Return the response G and its derivative in w at points of the unit circle."""
        quotient = product_jet(points, self.zeros, self.gain).over(product_jet(points, self.poles, 1.0))
        return quotient.times(power_jet(points, -self.lag))


def factor_chain(chain: AnyChain) -> FactoredPlant:
    """Return the zeros, poles and gain of the sampled plant of a chain."""
    if isinstance(chain, Chain) and chain.rigid:
        return _factor_rigid_mass(chain)
    chain.check()
    return _factor_system(chain) if isinstance(chain, System) else _factor_bodies(chain)


def _factor_rigid_mass(chain: Chain) -> FactoredPlant:
    """Return the zeros, poles and gain of the sampled plant of a rigid device, in closed form."""
    delta, fraction = np.float64(chain.bodies[0].damping), np.float64(chain.d - chain.n_delay)
    plant = discretize_mass(delta, fraction if fraction else None)
    if fraction:
        h, q = factor_numerator(plant)
        zeros = [1.0 + h / plant.a2, 1.0 + q]
    else:
        # Use ``gap``, because it is exactly 0 for delta = 0, and the zero is then at exactly z = -1.
        zeros = [2.0 - plant.gap / plant.a2]
    roots = (np.array(offsets, complex) for offsets in (zeros, [0.0, plant.em]))
    return FactoredPlant(float(plant.a2), chain.n_delay + len(zeros) - 1, *roots)


def _factor_system(system: System) -> FactoredPlant:
    """Return the zeros, poles and gain of a linear device; a device in discrete time already contains them."""
    device, period, lag = system.device, float(system.period), system.n_delay + (system.d != system.n_delay)
    if system.sampled:
        gain, (zeros, poles) = device.gain, device.offsets
    else:
        gain, zeros = find_sampled_zeros(device, period, float(system.d) - system.n_delay)
        poles = -np.expm1(device.poles * period)
    # Count each pole at z = 0 as a period of delay (``lag``); each zero at z = 0 cancels one of them.
    lag, at_origin = int(lag + np.sum(poles == 1)), int(np.sum(zeros == 1))
    zeros = np.append(zeros[zeros != 1], np.ones(max(at_origin - lag, 0)))
    return FactoredPlant(gain * float(system.mass) / period**2, max(lag - at_origin, 0), zeros, poles[poles != 1])


def _factor_bodies(chain: Chain) -> FactoredPlant:
    """Return the zeros, poles and gain of a device that consists of bodies, modes and an actuator."""
    plant = sample_states(chain)
    continuous_zeros, poles = chain.continuous
    poles = -np.expm1(poles)
    denominator = np.atleast_1d(np.poly(-poles)).real
    numerator = _expand_numerator(plant, plant.full, denominator)
    if plant.late is not None:
        numerator = np.polyadd(np.append(_expand_numerator(plant, plant.late, denominator), 0.0), numerator)
    numerator = np.trim_zeros(numerator, "f")
    if numerator.size > 1 and abs(numerator[0]) < FAR_ZERO * abs(numerator[1]):
        # Drop one zero if the delay is just below an integer, because this zero is then so far from the unit circle
        # that it has no effect on the circle and Aberth's method would not converge to it.
        numerator = numerator[1:]
    # Zeros near the poles of a slow mode are below the numerical resolution of the coefficients. Start the iteration
    # for these zeros from those of the continuous-time response, which are close to them.
    with np.errstate(all="ignore"):
        slow = np.expm1(continuous_zeros)
    slow = slow[np.abs(slow) < SLOW_ZERO]
    zeros = np.roots(numerator).astype(complex)
    zeros[np.argsort(np.abs(zeros))[: slow.size]] = slow
    candidates, point = [], circle_points(np.float64(TEST_ANGLE))
    # First refine all zeros. Modes that decay within a period lead to a cluster of zeros near z = 0, which Aberth's
    # method may not separate. In this case, keep the roots of ``numerator`` in the cluster, because they are accurate
    # as a group.
    for is_refined in (np.full(zeros.shape, True), np.abs(1.0 + zeros) > CLUSTER_RADIUS):
        # Move real starting values off the real axis, because Aberth's steps keep real values real, and two zeros that
        # are real according to the coefficients may be a complex pair.
        off_axis = 1.0 + 1e-6j * (1.0 - 2.0 * (np.arange(zeros.size) % 2)) * is_refined
        refined = -_refine_zeros(plant, zeros * off_axis, is_refined)
        factored = FactoredPlant(float(numerator[0]), plant.lag, refined, poles)
        error = np.abs(factored.evaluate_controller(point).value / plant.controller(point) - 1.0)
        if error < RESPONSE_TOLERANCE:
            return factored
        candidates.append((error, factored))
    return min(candidates, key=lambda each: each[0])[1]


def _expand_numerator(plant: SampledStates, force: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Return the numerator of ``C (zeta - Psi)^-1 force`` in zeta, computed from its Markov parameters."""
    markov, state = [], force
    for _ in range(denominator.size - 1):
        markov.append(state[0])
        state = plant.psi @ state
    return np.convolve(denominator, markov)[: denominator.size - 1]


def _refine_zeros(plant: SampledStates, zeros: np.ndarray, is_refined: np.ndarray) -> np.ndarray:
    """Refine zeros of G by Aberth's method on ``det [[zeta - Psi, zeta Gamma(1 - f) + Gamma(1)], [C, 0]]``.

    No pole of G makes this determinant small, so zeros near poles are resolved (V4).

    Args:
        plant: the sampled plant.
        zeros: approximations of zeta.
        is_refined: False for zeros that stay fixed.

    Returns:
        The refined zeta, in the same order.
    """
    size = plant.full.size
    constant = np.zeros((size + 1, size + 1))
    constant[:size, :size], constant[:size, size], constant[size, 0] = -plant.psi, plant.full, 1.0
    linear = np.eye(size + 1)
    linear[:, size] = np.append(np.zeros(size) if plant.late is None else plant.late, 0.0)
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
