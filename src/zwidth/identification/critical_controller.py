"""Compute the critical controller of a device, and from it the stability limits of walls on a grid of frequencies.

The critical controller is ``q(z) = -1/G(z)``, with the response G of the sampled device. A wall with stiffness K and
damping B has a closed-loop pole at a point z of the unit circle if and only if ``K + B F(z)/T = q(z)``, with the
velocity estimate F and the sampling period T. b is the damping of the device, m its mass, and K_max the largest stable
K.

An actuator lag and modes add to the response of the rigid mass a sum over their poles p of ``r h(p; z)`` with the
residue r. h is the response of ``E' = p E + F`` to a force with zero-order hold and the delay d = n + f, 0 <= f < 1, in
sampling periods. With zeta = z - 1:

    h = (zeta (e^((1 - f) p) - 1) + e^p - 1)/(p (zeta + 1 - e^p) z^(n + 1))

On a line of constant B, the stability limit is the smallest K > 0 with a pole on the unit circle (the first crossing),
provided that the walls with K -> 0+ are stable. They are stable for all B > 0 below the smallest B with a pole on the
circle at K = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from zwidth.core.types import Array
from zwidth.model.circle_functions import CirclePoints, Jet
from zwidth.numerics.held_mass import Plant, differentiate_mass, discretize_mass, split_delay

# Least |zeta^2 - 1| of a pole pair with damping ratio zeta. Pairs that are closer to a double pole are moved apart,
# because partial fractions require distinct poles.
_DOUBLE = 1e-5
# Constants of the maximization over B (`find_highest`), on a grid that is repeatedly refined around its best point.
_DAMPINGS = 33  # number of points of the first grid
_REFINED = 9  # number of points of each refined grid
_TIMES = 3  # number of refinements


class CriticalController:
    """The critical controller ``q = -1/G`` of a batch of devices, whose parameters broadcast with the frequencies.

    A rigid device has ``q = -z^n (z - 1)(z - c)/(a2 z + a1 + a0/z)``, with the coefficients of `numerics.held_mass`.

    Args:
        delta: damping b T/m.
        d: delay in periods.
        lag: time constant of the actuator in periods and, for second order, its damping ratio; empty without a lag.
        modes: for each mode the frequency in rad per sample, the damping ratio and the mass ratio ``m/m_i``.
    """

    def __init__(self, delta: Any, d: Any, lag: Sequence[Any] = (), modes: Sequence[Sequence[Any]] = ()) -> None:
        """Compute the coefficients of q that do not depend on the frequency."""
        self.n_delay, fraction = split_delay(np.asarray(d, float))
        self.delta, self.fraction = delta, fraction
        poles, residues = expand_partial_fractions(delta, lag, modes)
        self.has_parts = len(poles) > 0
        if poles:
            both = np.array(np.broadcast_arrays(fraction + np.zeros(1), *poles, *residues)[1:], complex)
            poles, self.residues = np.where(both[: len(poles)] == 0, 1e-300, both[: len(poles)]), both[len(poles) :]
            # Precompute terms of h: ``growth`` is e^p - 1, ``gain`` is (e^p - 1)/p, the change of E by a unit force
            # that acts for a whole period, and ``late_gain`` the change by a unit force that acts only after the
            # fractional delay f.
            self.growth, self.gain = np.expm1(poles), np.expm1(poles) / poles
            self.late_gain = np.expm1((1.0 - fraction) * poles) / poles

    @cached_property
    def plant(self) -> Plant:
        """The coefficients of the zero-order-hold discretization of the rigid mass."""
        return discretize_mass(self.delta, self.fraction)

    def evaluate(self, points: CirclePoints) -> Array:
        """Return q at points of the unit circle."""
        rigid = self.evaluate_rigid(points).value
        return rigid / (1.0 - rigid * self.evaluate_parts(points)) if self.has_parts else rigid

    def evaluate_rigid(self, points: CirclePoints) -> Jet:
        """Return q of the rigid mass alone, and its derivative with respect to the frequency w."""
        plant, turn = self.plant, 1j * points.z
        numerator, z_minus_c = _evaluate_numerator(plant, points), points.z_minus_1 + plant.em
        q = -np.exp(1j * self.n_delay * points.w) * points.z_minus_1 * z_minus_c / numerator
        slopes = (
            turn / points.z_minus_1 + turn / z_minus_c - 1j * (plant.a2 * points.z - plant.a0 / points.z) / numerator
        )
        return Jet(q, q * (1j * self.n_delay + slopes))

    def evaluate_parts(self, points: CirclePoints) -> Array:
        """Return the contribution of lag and modes to the response G of the device."""
        above, below = points.z_minus_1 * self.late_gain + self.gain, points.z_minus_1 - self.growth
        return (self.residues * (np.exp(-1j * (self.n_delay + 1.0) * points.w) * above / below)).sum(0)

    def differentiate(self, points: CirclePoints, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of q of the rigid mass with respect to the damping delta = b T/m and the delay d.

        Args:
            points: points of the unit circle.
            q: value of q of the rigid mass at these points.

        Returns:
            The derivatives with respect to delta and to d.
        """
        by_delta, by_fraction = differentiate_mass(self.delta, self.fraction)
        numerator = _evaluate_numerator(self.plant, points)
        return (
            q * (by_delta.em / (points.z_minus_1 + self.plant.em) - _evaluate_numerator(by_delta, points) / numerator),
            -q * _evaluate_numerator(by_fraction, points) / numerator,
        )


def _evaluate_numerator(plant: Plant, points: CirclePoints) -> Any:
    """Return ``a2 z + a1 + a0/z``: the numerator of the transfer function of the sampled rigid mass, divided by z."""
    return plant.a2 * points.z + plant.a1 + plant.a0 / points.z


def expand_partial_fractions(delta: Any, lag: Any, modes: Any) -> tuple[list[Any], list[Any]]:
    """Expand the contribution of an actuator lag and modes to the transfer function of the device in partial fractions.

    The expanded function is ``A(s) (1/(s (s + delta)) + sum_i r_i/(s^2 + 2 zeta_i w_i s + w_i^2)) - 1/(s (s + delta))``
    with the transfer function A of the lag and, for each mode i, the mass ratio r_i, the damping ratio zeta_i and the
    frequency w_i.

    Args:
        delta: damping b T/m.
        lag: time constant and, for second order, damping ratio; empty without a lag.
        modes: for each mode the frequency, the damping ratio and the mass ratio.

    Returns:
        A list of poles and a list of their residues, in this order: the poles of the lag, -delta if there is a lag, and
        two poles per mode.
    """
    lag_poles, gains = (list(each) for each in _expand_lag(lag))
    poles, weights = list(lag_poles), [gain / p / (p + delta) for p, gain in zip(lag_poles, gains, strict=True)]
    if lag_poles:
        poles, weights = [*poles, -delta + 0j], [*weights, -sum(weights)]
    for frequency, ratio, mass_ratio in modes:
        pair = _solve_quadratic(frequency, ratio)
        for k, (pole, gain) in enumerate(zip(lag_poles, gains, strict=True)):
            weights[k] = weights[k] + mass_ratio * gain / (pole - pair[0]) / (pole - pair[1])
        for pole, other in (pair, pair[::-1]):
            poles.append(pole)
            lagged = sum(gain / (pole - p) for p, gain in zip(lag_poles, gains, strict=True)) if lag_poles else 1.0
            weights.append(mass_ratio * lagged / (pole - other))
    return poles, weights


def _expand_lag(lag: Sequence[Any] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the poles of the transfer function of the lag and their residues, along the first axis.

    Both arrays are empty if ``lag`` is empty.
    """
    if len(lag) == 0:
        return np.zeros(0), np.zeros(0)
    poles = _solve_quadratic(1.0 / lag[0], lag[1]) if len(lag) == 2 else np.array([-1.0 / lag[0] + 0j])
    return poles, np.prod(-poles, 0) / (poles - poles[::-1] if len(lag) == 2 else np.ones_like(poles))


def _solve_quadratic(w: Any, ratio: Any) -> np.ndarray:
    """Return the two roots of ``s^2 + 2 zeta w s + w^2`` along the first axis; a double root is split slightly.

    Args:
        w: natural frequency.
        ratio: damping ratio zeta.
    """
    discriminant = ratio**2 - 1.0
    root = np.sqrt(np.where(np.abs(discriminant) > _DOUBLE, discriminant, _DOUBLE) + 0j)
    return np.array([w * (-ratio + root), w * (-ratio - root)])


@dataclass(frozen=True)
class GridLimits:
    """Stability limits of a batch of devices for walls with B >= 0, computed on a grid of ascending frequencies."""

    critical: Array  # critical controller q in N/m, one row per device and one column per frequency
    velocity: Array  # velocity estimate F/T in 1/s, one row for all devices or one row per device

    @cached_property
    def damping_limits(self) -> np.ndarray:
        """Upper limit of B for each device, below which walls with K -> 0+ are stable; infinite if no limit exists."""
        return _cross_first(self.critical * self.velocity.conj(), self.critical / self.velocity)

    def limit_stiffness(self, virtual_damping: np.ndarray) -> np.ndarray:
        """Return the stability limit of each device at a given B: the K below which all walls are stable; 0 if none is.

        Args:
            virtual_damping: B, one value for all devices or one per device.
        """
        stiffness = self.critical - np.reshape(virtual_damping, (-1, 1)) * self.velocity
        limits = _cross_first(stiffness, stiffness)
        # Set the limit to 0 if it is infinite, if walls with K -> 0+ are unstable, or if the first crossing may be
        # below the lowest frequency of the grid.
        valid = (stiffness.imag[:, 0] < 0) & (virtual_damping < self.damping_limits) & np.isfinite(limits)
        return np.where(valid, limits, 0.0)

    def find_stiffness_max(self) -> np.ndarray:
        """Return K_max of each device, the largest stability limit over all B >= 0."""
        limits = self.damping_limits
        return find_highest(self.limit_stiffness, np.where(np.isfinite(limits), limits, 0.0))[0]


def find_highest(limit: Callable[[np.ndarray], np.ndarray], top: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maximize a function of B over 0 <= B <= ``top`` for each device of a batch, on a grid that is refined repeatedly.

    Args:
        limit: function that returns one value per device for an array of one B per device.
        top: largest B of each device.

    Returns:
        The maxima, and the B of each maximum.
    """
    middle = width = limits = 0.5 * top
    for count in (_DAMPINGS, *_TIMES * [_REFINED]):
        tried = np.clip(middle + width * np.linspace(-1.0, 1.0, count)[:, None], 0.0, top)
        limits = np.array([limit(damping) for damping in tried])
        middle = np.take_along_axis(tried, limits.argmax(0)[None], 0)[0]
        width = 2.0 * width / (count - 1)
    return limits.max(0), middle


@np.errstate(all="ignore")
def _cross_first(criterion: Array, value: Array) -> np.ndarray:
    """Return the smallest positive Re(``value``) at the frequencies at which Im(``criterion``) crosses zero.

    Rows are devices and columns frequencies. Both arrays are interpolated linearly between neighboring frequencies. At
    the last frequency, ``criterion`` counts as real, because this frequency is at or near z = -1.

    Returns:
        One value per device; infinite if no such frequency exists.
    """
    left, right = criterion.imag[:, :-1], criterion.imag[:, 1:]
    share = np.where(left == right, 0.0, left / (left - right))
    between = value.real[:, :-1] + share * (value.real[:, 1:] - value.real[:, :-1])
    crossed = (left * right <= 0) & (between > 0)
    first = np.where(crossed, between, np.inf).min(1)
    last = value.real[:, -1]
    return np.where((last > 0) & np.isfinite(last), np.minimum(first, last), first)
