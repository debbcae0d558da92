"""Represent a device sampled with a zero-order hold by poles and residues, and a rigid mass in closed form.

Times are in sampling periods T, masses in units of m. A computed force is held for one period and acts with the delay
d = n + f (n integer, 0 <= f < 1). The response from computed force to sampled position is

    G(z) = G0(z) + sum_k r_k h(p_k; z)

G0 is the response of a rigid mass with the damping delta (`plant.rigid_mass`). Its closed form represents the poles s =
0 and s = -delta together, because partial fractions of two close poles cancel. h is the response of ``E' = p E + F``
with a pole p, r is its residue. With zeta = z - 1 and Gamma(t), the state E after a unit force held for the time t from
rest:

    h = (zeta Gamma(1 - f) + Gamma(1)) / (z^(n + 1) (zeta + 1 - e^p)),     Gamma(t) = (e^(p t) - 1)/p

``q = -1/G`` is the *critical controller*: a wall with stiffness K and damping B has a closed-loop pole at a point z of
the unit circle if and only if ``K + B F(z)/T = q(z)``, with the velocity estimate F. All functions accept NumPy and JAX
arrays. Parameters of many devices are arrays that broadcast with the points z.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from zwidth.core.types import Array
from zwidth.core.xp import namespace
from zwidth.model.circle_functions import CirclePoints, Jet, power_jet
from zwidth.plant.rigid_mass import Plant, discretize_mass, split_delay

# Least |zeta^2 - 1| of a pole pair with the damping ratio zeta. The poles of a pair closer to a double pole are moved
# apart to this distance, because partial fractions require distinct poles.
LEAST_SEPARATION = 1e-5


class SampledPlant(NamedTuple):
    """The sampled plant as the sum of a rigid mass and of first-order parts."""

    rigid: Plant  # zero-order-hold discretization of the rigid mass, with the fractional delay
    poles: Sequence[Any]  # poles p of the first-order parts, numbers or arrays
    residues: Sequence[Any]  # residues r of the first-order parts
    n_delay: Any  # integer delay n
    fraction: Any  # fractional delay f

    def response(self, points: CirclePoints) -> Array:
        """Return G at points of the unit circle."""
        return self.parts_response(points) - 1.0 / self.rigid_controller(points).value

    def controller(self, points: CirclePoints) -> Array:
        """Return the critical controller q at points of the unit circle."""
        rigid = self.rigid_controller(points).value
        return rigid / (1.0 - rigid * self.parts_response(points)) if len(self.poles) else rigid

    def rigid_controller(self, points: CirclePoints) -> Jet:
        """Return q = -1/G0 of the rigid mass without other parts, and its derivative in the angle w."""
        slope = 1j * points.z
        poles = Jet(points.z_minus_1, slope).times(Jet(points.z_minus_1 + self.rigid.em, slope))
        numerator = Jet(
            evaluate_numerator(self.rigid, points), 1j * (self.rigid.a2 * points.z - self.rigid.a0 / points.z)
        )
        value, derivative = poles.over(numerator).times(power_jet(points, self.n_delay))
        return Jet(-value, -derivative)

    def parts_response(self, points: CirclePoints) -> Array:
        """Return the contribution to G of all poles except those of the rigid mass."""
        total, xp = 0.0 * points.z, namespace(points.w, *self.poles)
        for pole, residue in zip(self.poles, self.residues, strict=True):
            late, full = integrate_pole(pole, 1.0 - self.fraction), integrate_pole(pole, 1.0)
            total = total + residue * (points.z_minus_1 * late + full) / (points.z_minus_1 - xp.expm1(pole))
        return total * power_jet(points, -self.n_delay - 1.0).value


def evaluate_numerator(plant: Plant, points: CirclePoints) -> Any:
    """Return ``a2 z + a1 + a0/z``, the numerator N(z)/z of the response of the rigid mass."""
    return plant.a2 * points.z + plant.a1 + plant.a0 / points.z


def integrate_pole(pole: Any, time: Any) -> Any:
    """Return Gamma(t) of a pole: the state of ``E' = p E + F`` after a unit force held for the time t from rest."""
    xp = namespace(pole, time)
    nonzero = xp.where(pole == 0, 1.0, pole)
    return xp.where(pole == 0, time, xp.expm1(nonzero * time) / nonzero)


def sample_parts(delta: Any, d: Any, lag: Sequence[Any] = (), modes: Sequence[Sequence[Any]] = ()) -> SampledPlant:
    """Return the sampled plant of masses with an actuator lag and modes; the parameters broadcast with the points.

    Args:
        delta: damping b T/m.
        d: delay in periods.
        lag: time constant of the actuator in periods and, for second order, its damping ratio; empty without a lag.
        modes: for each mode the frequency in rad per sample, the damping ratio and the mass ratio ``m/m_i``.
    """
    xp = namespace(delta, d, *lag, *(value for mode in modes for value in mode))
    n, fraction = split_delay(xp.asarray(d, float))
    return SampledPlant(discretize_mass(delta, fraction), *expand_partial_fractions(delta, lag, modes), n, fraction)


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
    lag_poles, gains = _expand_lag(lag)
    poles, residues = [*lag_poles], [gain / p / (p + delta) for p, gain in zip(lag_poles, gains, strict=True)]
    if lag_poles:
        poles, residues = [*poles, -delta + 0j], [*residues, -sum(residues)]
    for frequency, ratio, mass_ratio in modes:
        pair = _solve_quadratic(frequency, ratio)
        for k, (pole, gain) in enumerate(zip(lag_poles, gains, strict=True)):
            residues[k] = residues[k] + mass_ratio * gain / (pole - pair[0]) / (pole - pair[1])
        for pole, other in (pair, pair[::-1]):
            poles.append(pole)
            lagged = sum(gain / (pole - p) for p, gain in zip(lag_poles, gains, strict=True)) if lag_poles else 1.0
            residues.append(mass_ratio * lagged / (pole - other))
    return poles, residues


def _expand_lag(lag: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    """Return the poles of the transfer function of the lag and their residues; empty lists if ``lag`` is empty."""
    if len(lag) == 2:
        one, other = _solve_quadratic(1.0 / lag[0], lag[1])
        return [one, other], [one * other / (one - other), one * other / (other - one)]
    return [-1.0 / rate + 0j for rate in lag], [1.0 / rate + 0j for rate in lag]


def _solve_quadratic(w: Any, ratio: Any) -> list[Any]:
    """Return the two roots of ``s^2 + 2 zeta w s + w^2``; a double root is replaced by two close roots.

    Args:
        w: natural frequency.
        ratio: damping ratio zeta.
    """
    xp = namespace(w, ratio)
    discriminant = ratio**2 - 1.0
    root = xp.sqrt(xp.where(xp.abs(discriminant) > LEAST_SEPARATION, discriminant, LEAST_SEPARATION) + 0j)
    return [w * (-ratio + root), w * (-ratio - root)]
