"""Further feedback: a fixed transfer function R(z) from position to force, in addition to the spring and the damper.

The force of the controller is ``-(K P + B V + R) x`` with the measured position x, the position estimate P and the
velocity estimate V. The further feedback is a filter R0 whose input is the measured position, or a weighted sum of the
two estimates: ``R = R0`` or ``R = R0 (w_p P + w_v V)``. Poles of R0 may be on or outside the unit circle, such as the
pole of an integrator at z = 1; the stability of the closed loop includes them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from zwidth.core.errors import check_choice
from zwidth.model.checks import Part, check_number
from zwidth.model.estimate import Estimate
from zwidth.model.rational_filter import RationalFilter
from zwidth.units.quantities import ANY

IntegrationRule = Literal["backward", "forward", "trapezoidal"]
RULES = ("backward", "forward", "trapezoidal")
"""Rules of numerical integration."""


class Weights(NamedTuple):
    """Weights of the position estimate P and of the velocity estimate V, for T = 1, in the input of the feedback."""

    position: Any
    velocity: Any


def _read_weights(part: Any) -> None:
    """Convert both weights of a part to floats; None stays None."""
    for name in ("position", "velocity"):
        value = getattr(part, name)
        if value is not None:
            object.__setattr__(part, name, check_number(f"feedback.{name}", value, "1", ANY))


def _normalize_weights(part: Any, period: Any) -> Weights | None:
    """Return the weights for T = 1; None if the input is the measured position."""
    if part.position is None and part.velocity is None:
        return None
    position, velocity = (0.0 if weight is None else weight for weight in (part.position, part.velocity))
    return Weights(position, velocity / period if part.velocity is not None else 0.0)


@dataclass(frozen=True, repr=False)
class Feedback(RationalFilter):
    """Fixed further feedback ``R0(z) = numerator/denominator``, from position in m to force in N.

    The force of the controller is ``-(K P + B V + R) x``. Maximum stiffness, stable region and margins of a scene vary
    K and B, and R stays fixed.

    Args:
        numerator: coefficients in N/m, highest power of z first; or a list of sections in series, each a list of
            coefficients.
        denominator: coefficients or sections, of at least the degree of the numerator; all poles are allowed.
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
        """Return an integral gain, as `IntegralFeedback`; its docstring describes the arguments."""
        return IntegralFeedback(gain, rule, position, velocity)

    def estimate(self, unit: Any, period: Any) -> Estimate:
        """Return R0 divided by the stiffness ``1/unit``; the coefficients do not depend on the sampling period."""
        return self.factor(unit)

    def weights(self, period: Any) -> Weights | None:
        """Return the weights of both estimates in the input; None if the input is the measured position."""
        return _normalize_weights(self, period)


@dataclass(frozen=True, repr=False)
class IntegralFeedback(Part):
    """Integral gain k_i: further feedback with the integral of the position, ``R0 = k_i T z/(z - 1)``.

    Args:
        gain: k_i in N/(m s).
        rule: rule of integration. "backward" adds T x_k before the sum is used, R0 = k_i T z/(z - 1). "forward" adds it
            afterwards, R0 = k_i T/(z - 1). "trapezoidal" adds T (x_k + x_(k-1))/2, R0 = k_i (T/2) (z + 1)/(z - 1).
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
        """Return R0 divided by the stiffness ``1/unit``, for a sampling period in s."""
        gain, pole = self.gain * period * unit, np.zeros(1, complex)
        if self.rule == "trapezoidal":
            return Estimate(0, 0.5 * gain, 0, np.full(1, 2.0 + 0j), pole)
        return Estimate(0, gain, -1 if self.rule == "backward" else 0, poles=pole)

    def weights(self, period: Any) -> Weights | None:
        """Return the weights of both estimates in the input; None if the input is the measured position."""
        return _normalize_weights(self, period)


FEEDBACKS = {"integral": IntegralFeedback, "filter": Feedback}
"""Classes of further feedback by the name of their kind in configurations."""
