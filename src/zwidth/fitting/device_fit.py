"""What a fit says of a device: estimates, how far they may be off, and the stiffest wall that follows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zwidth.parts.device import Device
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import Velocity
from zwidth.scene import Scene

NAMES = ("mass", "damping", "delay")
# Of the intervals.
_CONFIDENCE = 0.95
# A standard error beyond this share leaves a value open.
VAGUE = 0.5
MASS_OPEN = "the mass is hardly determined: its standard error is more than half of it"


class ErrorBar(NamedTuple):
    """An interval that holds the true value with 95 % confidence."""

    low: float
    high: float


class FurtherExperiment(NamedTuple):
    """Raise K at this damping until the wall buzzes: N s/m, the N/m and Hz expected, and K_max's error afterwards."""

    virtual_damping: float
    stiffness: float
    frequency: float
    error_afterwards: float


class FittedMotion(NamedTuple):
    """One log beside its fit, a number a sample: times in s, forces in N, positions in m.

    ``modelled`` is NaN at the first samples, whose past forces are unknown.
    """

    time: np.ndarray
    force: np.ndarray
    position: np.ndarray
    modelled: np.ndarray


class TriedModel(NamedTuple):
    """A model of a log: what it has beside mass, damping and delay, and Schwarz's criterion less the least of all."""

    parts: tuple[str, ...]
    criterion: float


@dataclass(frozen=True)
class DeviceFit:
    """A device found from records of it.

    Attributes:
        mass, damping, delay: estimates in kg, N s/m, s.
        errors: standard errors of the three, by name.
        covariance: of the three, in that order, SI units.
        stiffness_max: K_max in N/m of the estimated device, `zwidth.Scene.max_stiffness`.
        stiffness_error: its standard error, by K_max's gradient.
        noise: relative (K and f) of buzzing walls, of the position in m of a log; given, or estimated from residuals.
        residuals: measured less fitted, of buzzing walls an array (n, 2) in units of the noise of K and f, of a log in
            m, NaN where samples are left out.
        doubts: what is odd about the records or about the estimate, a sentence each.
        status: of `zwidth.Status`: UNDECIDED where another device fits as well.
        next: the further experiment that narrows K_max most; None of a log.
        offset: constant force in N that the log asks for beside the commanded one; 0 where it asks for none.
        friction: Coulomb friction in N that the log asks for, its error in ``errors`` then; 0 where it asks for none.
        resolution: step of the encoder in m that a log was fitted with; 0 of buzzing walls, and where there is none.
        motions: of a log, each with its fit, a `zwidth.FittedMotion`.
        tried: of a log, the models that were compared, a `zwidth.TriedModel` each, the one kept first.
    """

    mass: float
    damping: float
    delay: float
    errors: dict[str, float]
    covariance: np.ndarray
    stiffness_max: float
    stiffness_error: float
    noise: float | tuple[float, float]
    residuals: np.ndarray
    doubts: tuple[str, ...]
    status: int
    next: FurtherExperiment | None
    offset: float
    friction: float
    resolution: float
    motions: tuple[FittedMotion, ...]
    tried: tuple[TriedModel, ...]
    period: float
    velocity: Velocity
    # How many standard errors the intervals reach.
    reach: float

    @cached_property
    def scene(self) -> Scene:
        """The estimated device with its timing and velocity estimate."""
        return scene_of((self.mass, self.damping, self.delay), self.period, self.velocity)

    @property
    def intervals(self) -> dict[str, ErrorBar]:
        """95 % intervals by name: of mass, damping, delay, friction where there is any, and of "stiffness_max"."""
        errors = self.errors | {"stiffness_max": self.stiffness_error}
        reaches = {name: (getattr(self, name), self.reach * error) for name, error in errors.items()}
        return {name: ErrorBar(max(0.0, value - far), value + far) for name, (value, far) in reaches.items()}

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON; None for what is NaN."""
        return _without_nan(self._numbers())

    def _numbers(self) -> dict[str, Any]:
        return {
            **{name: getattr(self, name) for name in NAMES},
            "stiffness_max": self.stiffness_max,
            "errors": self.errors | {"stiffness_max": self.stiffness_error},
            "intervals": {name: list(bar) for name, bar in self.intervals.items()},
            "covariance": self.covariance.tolist(),
            "noise": list(self.noise) if isinstance(self.noise, tuple) else self.noise,
            "offset": self.offset,
            "friction": self.friction,
            "resolution": self.resolution,
            "tried": [{"parts": list(model.parts), "criterion": model.criterion} for model in self.tried],
            "period": self.period,
            "doubts": list(self.doubts),
            "status": int(self.status),
            "next": None if self.next is None else self.next._asdict(),
        }


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_nan(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_without_nan(part) for part in value]
    return None if value != value else value


def scene_of(values: Iterable[float], period: float, velocity: Velocity) -> Scene:
    """A device of this mass, damping and delay with its timing."""
    mass, damping, delay = map(float, values)
    return Scene(Device(mass, damping), Timing(period=period, delay=delay), velocity=velocity)


@dataclass(frozen=True)
class StiffnessEstimate:
    """K_max of a scene and its derivatives in mass, damping and delay."""

    scene: Scene
    value: float
    gradient: np.ndarray

    @classmethod
    def at(cls, scene: Scene) -> StiffnessEstimate:
        """By `zwidth.Scene.sensitivities`."""
        slopes = scene.sensitivities()
        return cls(scene, float(slopes.stiffness), np.array([slopes.per[name] for name in NAMES]))

    def conclude(
        self,
        covariance: np.ndarray,
        *,
        noise: float | tuple[float, float],
        residuals: np.ndarray,
        doubts: Iterable[str],
        status: int,
        freedom: int | None = None,
        further: FurtherExperiment | None = None,
        offset: float = 0.0,
        friction: tuple[float, float] = (0.0, 0.0),
        resolution: float = 0.0,
        motions: tuple[FittedMotion, ...] = (),
        tried: tuple[TriedModel, ...] = (),
    ) -> DeviceFit:
        """The result; ``friction`` with its error, ``freedom`` as for `reach_of`."""
        scene = self.scene
        errors = np.sqrt(np.diag(covariance)).tolist()
        return DeviceFit(
            mass=scene.device.mass,
            damping=scene.device.damping,
            delay=scene.timing.delay,
            errors=dict(zip(NAMES, errors, strict=True)) | ({"friction": friction[1]} if friction[0] else {}),
            covariance=covariance,
            stiffness_max=self.value,
            stiffness_error=float(np.sqrt(self.gradient @ covariance @ self.gradient)),
            noise=noise,
            residuals=residuals,
            doubts=tuple(doubts),
            status=int(status),
            next=further,
            offset=offset,
            friction=friction[0],
            resolution=resolution,
            motions=motions,
            tried=tried,
            period=scene.timing.period,
            velocity=scene.velocity,
            reach=reach_of(freedom),
        )


def in_si(theta: Iterable[float], period: float) -> tuple[np.ndarray, np.ndarray]:
    """Mass, damping and delay of ``(ln m, delta, d)``, and their derivatives in these."""
    log_mass, delta, d = theta
    mass = float(np.exp(log_mass))
    rate = mass / period
    return np.array([mass, delta * rate, d * period]), np.array(
        [[mass, 0.0, 0.0], [delta * rate, rate, 0.0], [0.0, 0.0, period]]
    )


def reach_of(freedom: int | None) -> float:
    """Standard errors to either side: of a known noise, or of one estimated with so many degrees of freedom."""
    from scipy.stats import norm, t

    upper = 0.5 + 0.5 * _CONFIDENCE
    return float(norm.ppf(upper) if freedom is None else t.ppf(upper, freedom))
