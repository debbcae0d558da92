"""From an estimate and its covariance to what a fit says: K_max, how far off it may be, and SI units."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from zwidth.fitting.device_fit import DeviceFit
from zwidth.fitting.fit_records import FurtherExperiment, RivalDevice
from zwidth.fitting.scenes import name_numbers
from zwidth.scenes.scene import Scene
from zwidth.words.formatting import with_unit
from zwidth.words.status import Status

# Sampling periods of loops, in s: outside a unit is suspected.
_QUICKEST, _SLOWEST = 5e-6, 0.02


@dataclass(frozen=True)
class StiffnessEstimate:
    """K_max of a scene and its derivatives in what is fitted, as `name_numbers` has it."""

    scene: Scene
    value: float
    gradient: np.ndarray
    numbers: tuple[str, ...]

    @classmethod
    def at(cls, scene: Scene, unknown_cutoff: bool = False) -> StiffnessEstimate:
        """By `zwidth.Scene.sensitivities`."""
        slopes = scene.sensitivities()
        paths = name_numbers(scene, unknown_cutoff)
        return cls(scene, float(slopes.stiffness), np.array([slopes.per[path] for path in paths]), paths)

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
        rivals: tuple[RivalDevice, ...] = (),
    ) -> DeviceFit:
        """The result, without what only logs tell; ``freedom`` as for `reach_of`."""
        scene = self.scene
        doubts = [*doubts, *_doubt_period(scene.timing.period)]
        names = [name.removeprefix("velocity.") for name in self.numbers]
        errors = dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
        error = float(np.sqrt(self.gradient @ covariance @ self.gradient))
        agreed = bool(rivals) and all(abs(one.stiffness_max - self.value) <= error for one in rivals)
        known = 1.0 if status == Status.OK or (status == Status.UNDECIDED and agreed) else np.nan
        return DeviceFit(
            mass=scene.device.mass,
            damping=scene.device.damping,
            delay=scene.timing.delay,
            errors=errors,
            covariance=covariance,
            stiffness_max=known * self.value,
            stiffness_error=known * error,
            noise=noise,
            residuals=residuals,
            doubts=tuple(doubts),
            status=int(status),
            next=further and further._replace(error_afterwards=known * further.error_afterwards),
            offset=0.0,
            friction=0.0,
            resolution=0.0,
            motions=(),
            period=scene.timing.period,
            velocity=scene.velocity,
            freedom=freedom,
            rivals=rivals,
            actuator=scene.device.actuator,
            modes=scene.device.modes,
        )


def _doubt_period(period: float) -> list[str]:
    if _QUICKEST <= period <= _SLOWEST:
        return []
    slip = "in ms or us" if period > _SLOWEST else "in s"
    return [
        f"a sampling period of {with_unit(period, 's')} is far from any loop; the time may be {slip}: check its unit"
    ]


def in_si(theta: np.ndarray, period: float, lag: int = 0, modes: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """What `scene_of` takes, of ``theta`` as `zwidth.fitting.buzzing` has it, and its derivatives in that."""
    ringing = theta.size - 3 * modes
    mass = float(np.exp(theta[0]))
    units = np.array([mass / period, period])
    # A cut-off, the numbers of a lag, and of modes are the exponentials of theta, but for what a mode moves.
    values = np.concatenate([[mass], theta[1:3] * units, np.exp(theta[3:])])
    if lag:
        values[ringing - lag] *= period
    values[ringing::3] *= 0.5 / (np.pi * period)
    shares = theta[ringing + 2 :: 3]
    values[ringing + 2 :: 3] = mass / shares
    slopes = values.copy()
    slopes[1:3], slopes[ringing + 2 :: 3] = units, -mass / shares**2
    by_theta = np.diag(slopes)
    by_theta[1, 0], by_theta[ringing + 2 :: 3, 0] = values[1], values[ringing + 2 :: 3]
    return values, by_theta
