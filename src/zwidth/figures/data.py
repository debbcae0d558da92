"""What the figures draw: plain records of NumPy arrays, named as in configurations and data files."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

DelayModel = Literal["held", "fractional_power"]


@dataclass(frozen=True)
class SIScale:
    """How a normalized wall reads in SI units: ``K = stiffness * alpha``, ``B = virtual_damping * beta``."""

    stiffness: float
    virtual_damping: float


@dataclass(frozen=True)
class Outline:
    """The edge of the stable set of one device in the (alpha, beta) plane, from (0, -delta) on.

    Attributes:
        piece: name of the pole that crosses the unit circle: "complex_pair", "minus_one" or "plus_one"; a vertex
            named "minus_one" begins a straight part on which a real pole sits at z = -1.
        omega: frequency of that pole in radians a period.
    """

    delta: float
    d: float
    delay_model: DelayModel
    alpha: np.ndarray
    beta: np.ndarray
    omega: np.ndarray
    piece: np.ndarray


@dataclass(frozen=True)
class PassiveOutline:
    """The edge of the passive set of one device in the (alpha, beta) plane."""

    delta: float
    d: float
    alpha: np.ndarray
    beta: np.ndarray


@dataclass(frozen=True)
class RidgePath:
    """The stiffest stable wall over delta, for one delay; ``kind`` is "smooth" or "corner"."""

    d: float
    delay_model: DelayModel
    delta: np.ndarray
    alpha_max: np.ndarray
    beta: np.ndarray
    omega: np.ndarray
    kind: np.ndarray


@dataclass(frozen=True)
class BoundaryData:
    """Stability boundaries over alpha and beta, with what is drawn beside them."""

    outlines: tuple[Outline, ...]
    ridge_paths: tuple[RidgePath, ...] = ()
    passive: tuple[PassiveOutline, ...] = ()
    si: SIScale | None = None


@dataclass(frozen=True)
class DampingInterval:
    """The virtual damping that is stable (or passive) for alpha -> 0, over delta."""

    d: float
    delay_model: DelayModel
    delta: np.ndarray
    beta_lower: np.ndarray
    beta_upper: np.ndarray


@dataclass(frozen=True)
class ZeroStiffnessData:
    """Boundaries over delta and beta for alpha -> 0."""

    stable: tuple[DampingInterval, ...]
    passive: tuple[DampingInterval, ...] = ()


@dataclass(frozen=True)
class RidgeData:
    """Maximum stiffness over delta, one path for every delay and delay model."""

    paths: tuple[RidgePath, ...]


@dataclass(frozen=True)
class SlopeCurve:
    """The slope g(d) of maximum stiffness over strong damping, for one delay model."""

    delay_model: DelayModel
    d: np.ndarray
    slope: np.ndarray


@dataclass(frozen=True)
class SlopeData:
    """alpha_max over delta together with what alpha_max/delta tends to.

    Attributes:
        limits: g(d) of every path, in their order.
        curves: g over a range of delays.
    """

    paths: tuple[RidgePath, ...]
    limits: tuple[float, ...]
    curves: tuple[SlopeCurve, ...]


@dataclass(frozen=True)
class PassivityCost:
    """The stiffest stable and the stiffest passive wall over delta, for one delay."""

    d: float
    delta: np.ndarray
    alpha_max: np.ndarray
    beta: np.ndarray
    alpha_max_passive: np.ndarray
    beta_passive: np.ndarray


@dataclass(frozen=True)
class PassivityData:
    """The cost of passivity for every delay."""

    costs: tuple[PassivityCost, ...]


@dataclass(frozen=True)
class Response:
    """The response of one device to a step of force, from rest in contact with the wall."""

    label: str
    alpha: float
    beta: float
    delta: float
    d: float
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    wall_force: np.ndarray
    final_position: float
    settling_time: float

    @property
    def settles_in_view(self) -> bool:
        """Whether it has settled, for good, at the end of the time shown."""
        return bool(self.settling_time <= self.time[-1])


@dataclass(frozen=True)
class StepData:
    """Step responses; in SI units (s, m, m/s, N) where ``physical``, otherwise normalized."""

    responses: tuple[Response, ...]
    physical: bool


@dataclass(frozen=True)
class MapData:
    """Outputs on a grid; each array has the axes alpha, beta, delta, d.

    Attributes:
        outputs: "stable" and "passive" as booleans, "spectral_radius" as numbers.
    """

    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray
    d: np.ndarray
    outputs: dict[str, np.ndarray] = field(default_factory=dict)
    si: SIScale | None = None


@dataclass(frozen=True)
class RecommendationData:
    """The recommended wall of a device in SI units, within its stable region, and the response to 1 N."""

    stiffness: float
    virtual_damping: float
    stiffness_fraction: float
    stiffness_max: float
    virtual_damping_at_max: float
    virtual_damping_lower: float
    virtual_damping_upper: float
    region: BoundaryData
    response: Response
