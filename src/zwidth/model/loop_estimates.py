"""Normalize the position estimate P, the velocity estimate V and the further feedback R of a scene.

From the measured position x, the controller computes the force ``-(K P + B V + R) x`` (docs/theory/scenes.md, V25). P,
V and R are transfer functions, stored as gain, zeros and poles in normalized units (period T = 1, unit of mass m = 1).
The stability analyses use the ratio F = V/P. Its factors depend on the *structure* of V:

    "series"     V = P F, because the velocity is computed from the position estimate
    "separate"   V is computed from the measured position and has no poles in common with P
    "common"     V is an output of an observer and has the poles of P
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from zwidth.core.errors import InputError
from zwidth.model.circle_functions import CirclePoints, Jet, are_on_circle
from zwidth.model.estimate import Estimate
from zwidth.model.feedback import Weights
from zwidth.model.position import Observer, Pll, estimate_position

# Type of a function that returns a frequency response at points e^(jw), and its derivative with respect to w.
Response = Callable[[CirclePoints], Jet]


@dataclass(frozen=True)
class FurtherFeedback:
    """The further feedback ``R = R0`` or, with weights, ``R = R0 (w_p P + w_v V)``, in normalized units."""

    filter: Estimate  # R0
    weights: Weights | None  # w_p and w_v; None if the input of R0 is the measured position


@dataclass(frozen=True)
class LoopEstimates:
    """Transfer functions P, V and R of a scene that has a position estimate, further feedback, or both."""

    position: Estimate = field(default_factory=lambda: Estimate(0))  # P
    velocity: Estimate = field(default_factory=Estimate)  # F = V/P for the structure "series", otherwise V
    structure: Literal["series", "separate", "common"] = "series"
    feedback: FurtherFeedback | None = None

    @property
    def of_tool(self) -> Estimate:
        """The velocity estimate V_t of a simulated tool, whose input is the exact position of the tool.

        V_t is the velocity estimate of the scene, or the backward difference if an observer estimates the velocity of
        the device.
        """
        return Estimate() if self.structure == "common" else self.velocity

    @property
    def uses_velocity(self) -> bool:
        """True if the velocity V x of the device is an input of the further feedback or comes from an observer."""
        weights = None if self.feedback is None else self.feedback.weights
        return self.structure == "common" or (weights is not None and bool(np.any(weights.velocity != 0)))

    def respond(self) -> tuple[Response, ...]:
        """Return functions that compute P, V and, if the scene has further feedback, R on the unit circle."""
        if self.feedback is None:
            return self.position.jet, self._respond_velocity
        return self.position.jet, self._respond_velocity, self._respond_feedback

    def _respond_velocity(self, points: CirclePoints) -> Jet:
        """Return V and its derivative with respect to w, at points e^(jw) of the unit circle."""
        V = self.velocity.jet(points)
        return V.times(self.position.jet(points)) if self.structure == "series" else V

    def _respond_feedback(self, points: CirclePoints) -> Jet:
        """Return R and its derivative with respect to w, at points e^(jw) of the unit circle."""
        assert self.feedback is not None
        filtered, weights = self.feedback.filter.jet(points), self.feedback.weights
        if weights is None:
            return filtered
        P, V = self.position.jet(points), self._respond_velocity(points)
        return filtered.times(Jet(*(weights.position * p + weights.velocity * v for p, v in zip(P, V, strict=True))))

    def divide(self) -> tuple[Estimate, int]:
        """Return the ratio F = V/P, and the number of poles of F that are zeros of P.

        These poles are the last ones in the array of the poles.

        Raises:
            InputError: if P has a zero on the unit circle and V is not computed from the filtered position. F would be
                infinite at this zero.
        """
        P, V = self.position, self.velocity
        if self.structure == "series":
            return V, 0
        zeros = np.asarray(P.zeros)
        if np.any(are_on_circle(zeros)):
            raise InputError(
                "position: the filter has a zero on the unit circle, which the velocity estimate lacks, so no K acts "
                "there; compute the velocity from the filtered position"
            )
        # An observer has the same poles in V and P, so they cancel in V/P. Otherwise, the poles of P are zeros of V/P.
        common = self.structure == "common"
        parts = (V.zeros, zeros[:0]) if common else (V.zeros, P.poles)
        poles = (zeros,) if common else (V.poles, zeros)
        ratio = Estimate(
            V.window, V.gain / P.gain, V.lag - P.lag, np.concatenate(parts), np.concatenate(poles).astype(complex)
        )
        return ratio, zeros.size


def build_estimates(scene: Any) -> LoopEstimates | None:
    """Return the transfer functions P, V and R of a scene in normalized units.

    The result is None if the scene has neither a position estimate nor further feedback.
    """
    position, feedback, period = scene.position, scene.feedback, scene.timing.period
    if position is None and feedback is None:
        return None
    if isinstance(position, Pll | Observer):
        velocity, structure = position.estimate_velocity(period), "common"
    else:
        velocity = scene.velocity.estimate(period)
        structure = "separate" if getattr(position, "velocity_from", "") == "measured" else "series"
    further = None
    if feedback is not None:
        filtered = feedback.estimate(period * period / scene.mass, period)
        further = FurtherFeedback(filtered, feedback.weights(period))
    return LoopEstimates(estimate_position(position, period), velocity, structure, further)
