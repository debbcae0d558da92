"""Further feedback: a fixed filter R0(z), such as an integrator, that adds a force to those of spring and damper.

The input of R0 is the measured position x or a weighted sum of the two estimates, the position estimate P x and the
velocity estimate V x. The total force is ``-(K P + B V + R) x`` with ``R = R0`` or ``R = R0 (w_p P + w_v V)``. Poles of
R0 may be on or outside the unit circle, such as the pole of an integrator at z = 1. The stability analysis of the
closed loop includes these poles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np

from zwidth.core.errors import check_choice
from zwidth.model.checks import Part, check_number
from zwidth.model.estimate import Estimate
from zwidth.model.rational_filter import RationalFilter
from zwidth.units.quantities import ANY

IntegrationRule = Literal["backward", "forward", "trapezoidal"]
RULES = ("backward", "forward", "trapezoidal")
"""Names of the rules by which `IntegralFeedback` integrates numerically."""


class Weights(NamedTuple):
    """Weights of the position estimate and the velocity estimate in the input of R0; the unit of time is the period."""

    position: Any  # w_p
    velocity: Any  # w_v


def _read_weights(part: Any) -> None:
    """Convert the weights of a further feedback to floats, in place; leave a weight of None unchanged."""
    for name in ("position", "velocity"):
        value = getattr(part, name)
        if value is not None:
            object.__setattr__(part, name, check_number(f"feedback.{name}", value, "1", ANY))


def _normalize_weights(part: Any, period: Any) -> Weights | None:
    """Return the weights for time in sampling periods; None if the input of R0 is the measured position."""
    if part.position is None and part.velocity is None:
        return None
    position, velocity = (0.0 if weight is None else weight for weight in (part.position, part.velocity))
    return Weights(position, velocity / period if part.velocity is not None else 0.0)


@dataclass(frozen=True, repr=False)
class Feedback(RationalFilter):
    """Fixed further feedback ``R0(z) = numerator/denominator``, from position in m to force in N.

    The force of the controller is ``-(K P + B V + R) x``. To compute the maximum stiffness or the stable region of a
    scene, K and B are varied while R stays fixed. The gain, phase and modulus margins change K, B and R together.

    Args:
        numerator: coefficients in N/m, highest power of z first; or a list of sections in series, each a list of
            coefficients.
        denominator: coefficients or sections, as for the numerator. The degree must be at least that of the numerator.
            Poles on or outside the unit circle are allowed.
        sos, zeros, poles, gain: second-order sections, or roots, as for `VelocityFilter`.
        position: weight of the position estimate in the input of R0.
        velocity: weight of the velocity estimate in the input of R0, in s. If neither weight is given, the input is
            the measured position.

    Example:
        A fixed inner velocity loop with 5 N s/m at 1 kHz:

        >>> import zwidth
        >>> inner = zwidth.Feedback([5e3, -5e3], [1, 0])
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), feedback=inner)
        >>> bool(scene.is_stable(10e3, 20))
        True
    """

    _owner = "feedback"
    _poles_inside: ClassVar[bool] = False

    position: Any = None
    velocity: Any = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _read_weights(self)

    @staticmethod
    def integral(
        gain: Any, rule: IntegrationRule = "backward", position: Any = None, velocity: Any = None
    ) -> IntegralFeedback:
        """Return an `IntegralFeedback` with the given arguments, which the docstring of that class describes."""
        return IntegralFeedback(gain, rule, position, velocity)

    def estimate(self, unit: Any, period: Any) -> Estimate:
        """Return the filter R0 of the further feedback in normalized units, i.e. multiplied by ``unit``.

        Args:
            unit: T^2/m in m/N.
            period: sampling period T in s; not used, because the coefficients are those of powers of z.
        """
        return self.factor(unit)

    def weights(self, period: Any) -> Weights | None:
        """Return the weights of both estimates, for T = 1; None if the input of R0 is the measured position."""
        return _normalize_weights(self, period)


@dataclass(frozen=True, repr=False)
class IntegralFeedback(Part):
    """Integral gain k_i: further feedback with the integral of the position, ``R0 = k_i T z/(z - 1)``.

    Args:
        gain: k_i in N/(m s) or N m/(rad s).
        rule: rule of integration. "backward" adds T x_k to the sum before the force is computed, R0 = k_i T z/(z - 1).
            "forward" adds T x_k after the force is computed, R0 = k_i T/(z - 1). "trapezoidal" adds
            T (x_k + x_(k-1))/2, R0 = k_i (T/2) (z + 1)/(z - 1).
        position: weight of the position estimate in the integrand.
        velocity: weight of the velocity estimate in the integrand, in s. If neither weight is given, the integrand is
            the measured position.

    References:
        Astrom, Hagglund 2006, Advanced PID Control (discretization of the integral).

    Example:
        >>> import zwidth
        >>> scene = zwidth.Scene(
        ...     zwidth.Device(0.1, 10), zwidth.Timing(1e-3), feedback=zwidth.IntegralFeedback(1000)
        ... )
        >>> bool(scene.is_stable(1e3, 10))
        True
    """

    _owner = "feedback"

    gain: Any
    rule: IntegrationRule = "backward"
    position: Any = None
    velocity: Any = None

    def __post_init__(self) -> None:
        check_choice("feedback.rule", self.rule, RULES)
        super().__post_init__()

    def estimate(self, unit: Any, period: Any) -> Estimate:
        """Return the filter R0 of the integral feedback in normalized units, i.e. multiplied by ``unit``.

        Args:
            unit: T^2/m in m/N.
            period: sampling period T in s.
        """
        gain, pole = self.gain * period * unit, np.zeros(1, complex)
        if self.rule == "trapezoidal":
            return Estimate(0, 0.5 * gain, 0, np.full(1, 2.0 + 0j), pole)
        return Estimate(0, gain, -1 if self.rule == "backward" else 0, poles=pole)

    def weights(self, period: Any) -> Weights | None:
        """Return the weights of both estimates, for T = 1; None if the integrand is the measured position."""
        return _normalize_weights(self, period)

    @property
    def is_cascade(self) -> bool:
        """True if the integrand is a weighted sum of position and velocity, as in a cascade (`zwidth.cascade`)."""
        return bool(self.position) and bool(self.velocity)

    def match_wall(self, stiffness: float, virtual_damping: float) -> Self:
        """Return the integrator of a cascade for a new wall: the ratio of its weights becomes K/B, the new pos_gain.

        Args:
            stiffness: K in N/m.
            virtual_damping: B in N s/m, not 0.
        """
        return replace(self, position=self.velocity * (stiffness / virtual_damping))


FEEDBACKS = {"integral": IntegralFeedback, "filter": Feedback}
"""Classes of further feedback, keyed by the name of the kind in configurations."""
