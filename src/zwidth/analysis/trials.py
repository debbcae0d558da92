"""Simulations of one wall with an encoder, friction and a motor, from several initial conditions.

A *trial* is the set of simulations, one for each initial condition, with one set of parameter values. It comes to rest
if every simulated response does. The *trend* of a response is the ratio of its peak-to-peak positions in the second and
the first half of the *tail*, the last quarter of the simulation (`zwidth.Motion`). K is the stiffness of the wall, Q
the step of the encoder.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.model.linear_device import LinearDevice
from zwidth.simulation.result import MotionKind
from zwidth.simulation.simulate import simulate
from zwidth.units.formatting import with_unit
from zwidth.units.quantities import FIELDS
from zwidth.units.unit_system import UnitSystem

DISPLACEMENTS = (0.6, 1.3, 2.2, 3.7, 7.1, 13.0, 26.0, 50.0)  # initial displacements, in steps of the encoder
# Spring forces K x at the initial displacements x, as multiples of max_force and of max_rate times the sampling period.
OVERLOADS = (1.5, 6.0, 30.0)
LARGEST_PUSH = 0.9  # largest constant external force on a `LinearDevice`, in units of the motor's force limit
SPEEDS = (0.05, 0.5)  # initial velocities if K = 0, in initial displacements per sampling period
FIRST_DISPLACEMENT = 1e-3  # m or rad; used if neither the encoder nor the motor sets a scale

SUSTAINED = 0.8  # least trend of a sustained oscillation
RUNAWAY = 1.1  # trend above which a response without a frequency counts as growing without bound

TRIALS = 16  # trials per call of `simulate`; constant, because JAX compiles once per batch size
LONG_DELAY = 50.0  # sampling periods; with a longer delay one trial takes seconds, so trials run one by one

# Names under which the fields of `Hardware` are printed.
_LABELS = {"resolution": "encoder step", "coulomb": "friction", "static": "static friction"}
_LABELS |= {"max_force": "largest motor output", "max_rate": "largest rate of the motor output"}


class Hardware(NamedTuple):
    """Encoder, friction and motor of a device, in SI units."""

    resolution: float  # step of the encoder; 0 for an ideal sensor
    coulomb: float  # Coulomb friction
    static: float  # static friction
    max_force: float  # largest force of the motor; infinite for none
    max_rate: float  # largest rate of change of the commanded force; infinite for none


def spell_hardware(values: dict[str, float], system: UnitSystem) -> str:
    """Return a text that lists values of encoder, friction and motor with their units.

    ``values`` maps names of fields of `Hardware` to values in SI units.
    """
    texts = (f"{_LABELS[name]} {with_unit(value, system[FIELDS[name].unit], 3)}" for name, value in values.items())
    return ", ".join(texts)


class Starts(NamedTuple):
    """Initial conditions of the simulations of one wall: one-dimensional arrays of equal length."""

    position: np.ndarray
    velocity: np.ndarray
    external_force: np.ndarray  # constant external force
    half_steps: np.ndarray  # additional constant external force, in units of K Q/2
    scaled: np.ndarray  # bool; the displacement is proportional to the encoder step


class SustainedMotion(NamedTuple):
    """The sustained motion of largest amplitude in each trial: one-dimensional arrays with one entry per trial."""

    amplitude: np.ndarray  # 0 if every response of the trial comes to rest
    frequency: np.ndarray  # in Hz; NaN if the motion has no frequency
    outcome: np.ndarray  # code of `MotionKind`
    at_rest: np.ndarray  # bool; every response of the trial is observed at rest


class Experiment(NamedTuple):
    """Settings for trials of one wall and hardware, which all start from the same initial conditions."""

    scene: Any
    hardware: Hardware
    starts: Starts
    periods: int  # length of a simulation, in sampling periods
    decay: float  # length of a simulation, in time constants of the linear loop

    @property
    def present(self) -> dict[str, float]:
        """Stiffness and damping of the wall and the values of the hardware, by the argument names of `simulate`."""
        wall = self.scene.wall
        walls = {"stiffness": float(wall.stiffness), "virtual_damping": float(wall.virtual_damping)}
        return self.hardware._asdict() | walls

    def measure(self, **changes: Any) -> SustainedMotion:
        """Run one trial for each value of the changed parameters; all other parameters keep their current values."""
        count = max([np.size(value) for value in changes.values()], default=1)
        width = TRIALS if self.scene.d <= LONG_DELAY else 1
        rows = [np.minimum(np.arange(start, start + width), count - 1) for start in range(0, count, width)]
        table = {name: np.broadcast_to(value, count) for name, value in (self.present | changes).items()}
        parts = [self._measure({name: value[row] for name, value in table.items()}) for row in rows]
        return SustainedMotion(*(np.concatenate(columns)[:count] for columns in zip(*parts, strict=True)))

    def _measure(self, table: dict[str, np.ndarray]) -> SustainedMotion:
        """Run several trials in one simulation; ``table`` maps each parameter to its values, one per trial."""
        starts = self.starts
        columns: dict[str, Any] = {name: value[:, None] for name, value in table.items()}
        present = self.hardware.resolution
        ratio = columns["resolution"] / present if present > 0 else 1.0
        external_force = starts.external_force + 0.5 * starts.half_steps * columns["stiffness"] * columns["resolution"]
        motion = simulate(
            self.scene,
            **columns,
            start_position=starts.position * np.where(starts.scaled, ratio, 1.0),
            start_velocity=starts.velocity,
            external_force=external_force,
            periods=self.periods,
            record=False,
        )
        if np.any(motion.outcome == MotionKind.INVALID):
            raise InputError("coulomb: friction stops and restarts the device too often within one period; lower it")
        # A response that decays like the linear loop, by exp(-decay) during the simulation, has the trend
        # exp(-decay/8), because each half of the tail lasts an eighth of the simulation. Require at least the square
        # root of this trend for a sustained oscillation.
        least_trend = max(SUSTAINED, math.exp(-self.decay / 16.0) if self.decay > 0 else 0.0)
        # Treat a growing response as unbounded only if the linear loop is unstable and the motor has no limits, because
        # all other growing responses approach a limit cycle.
        limited = np.minimum(columns["max_force"], columns["max_rate"]) < np.inf
        return _pick_largest(motion, least_trend, ~limited & (self.decay < 0))


def list_starts(scene: Any, hardware: Hardware) -> Starts:
    """Return the initial conditions of the trials, scaled to the encoder step and the motor limits of the hardware."""
    K, Q, period = float(scene.wall.stiffness), hardware.resolution, scene.timing.period
    position = [Q * factor for factor in DISPLACEMENTS if Q > 0]
    half_steps = [0.0] * len(position) + [1.0] * len(position)
    # If a trial changes the encoder step, scale the displacements, which are multiples of the encoder step, by the same
    # factor. Add the largest one a second time, as a displacement that is not scaled.
    scaled = 2 * len(position)
    position, half_steps = position * 2 + position[-1:] * 2, half_steps + [0.0, 1.0][: 2 * len(position)]
    loads = [hardware.max_force, hardware.max_rate * period]
    position += [factor * load / K for load in loads if K > 0 and load < math.inf for factor in OVERLOADS]
    position = position or [FIRST_DISPLACEMENT]
    velocity = np.zeros(len(position))
    if K == 0:
        velocity = np.resize(SPEEDS, len(position)) * position / period
    halves = np.zeros(len(position))
    halves[: len(half_steps)] = half_steps
    starts = np.array(position), velocity, np.zeros(len(position)), halves, np.arange(len(position)) < scaled
    if isinstance(scene.device, LinearDevice):
        # Displace the equilibrium of a linear system by a constant external force, because its simulation always starts
        # at rest at 0.
        external_force = np.minimum(K * starts[0], LARGEST_PUSH * hardware.max_force)
        return Starts(np.zeros(len(external_force)), np.zeros(len(external_force)), external_force, *starts[3:])
    return Starts(*starts)


def _pick_largest(motion: Any, least_trend: float, unlimited: np.ndarray) -> SustainedMotion:
    """Select in each trial the sustained motion of largest amplitude among all initial conditions (last axis).

    Args:
        motion: simulated responses, shape (trials, initial conditions).
        least_trend: smallest trend of an oscillation that counts as sustained.
        unlimited: True for trials in which growing responses count as unbounded.
    """
    kind, moving = motion.outcome, motion.outcome != MotionKind.REST
    # Treat a response without a frequency as unbounded if its trend exceeds RUNAWAY, because it then departs from an
    # unstable equilibrium; otherwise it only drifts.
    oscillating = np.isfinite(motion.frequency)
    unbounded = (kind == MotionKind.DIVERGED) | (~oscillating & moving & (motion.trend > RUNAWAY))
    unbounded |= unlimited & (kind == MotionKind.GROWING)
    sustained = unbounded | (oscillating & ((kind == MotionKind.STEADY) | (moving & (motion.trend > least_trend))))
    amplitude = np.where(unbounded, np.inf, np.where(sustained, motion.amplitude, 0.0))
    index = np.argmax(amplitude, axis=-1)[:, None]
    size, frequency, outcome = (
        np.take_along_axis(part, index, -1)[:, 0] for part in (amplitude, motion.frequency, kind)
    )
    return SustainedMotion(size, frequency, outcome, ~moving.any(-1))
