"""Convert simulations to their results in SI units: the motion over time, its statistics and its observed behavior.

The *tail* is the last part of a simulation, divided into equal segments. The *width* of a segment is the peak-to-peak
position in it. ``summary`` is the record of the extreme positions and of the oscillations per segment
(`simulation.engine.Summary`); index 0 of its arrays is the time before the tail.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.units.display import compact_repr, draw_line, find_unit

if TYPE_CHECKING:
    import xarray


class MotionKind(IntEnum):
    """Observed behavior of a motion in the tail of its simulation, which implies nothing about later times.

    The tail is divided into six equal segments. The width of a segment is the peak-to-peak position of the device
    (docs/theory/simulation.md, T7).
    """

    REST = 0
    """In the second half of the tail no body moves by more than 1e-9 of the largest magnitude of all positions."""
    DECAYING = 1
    """The width decreases from each segment to the next; or, in a slow oscillation, the width of the second half of the
    tail is below 1 % of the width before the tail and less than half that of the first half."""
    STEADY = 2
    """The position oscillates, and the width has no trend."""
    GROWING = 3
    """The width increases from each segment to the next; or, in a slow oscillation, the width of the second half of the
    tail is more than twice the width before the tail and more than twice that of the first half."""
    DIVERGED = 4
    """A body is farther than 1e100 m from the surface of the wall."""
    UNCLEAR = 5
    """None of these: the trend of the width is not clear, or the tail has too few oscillations."""
    INVALID = 6
    """The ``status`` of the simulation is not 0."""


# Thresholds of `classify`.
AT_REST = 1e-9  # largest width at rest, relative to the largest magnitude of all positions
LEAST_REST = 3  # number of samples; without motion for at most this many, a body does not yet count as at rest
EQUAL = 1e-3  # largest relative difference of the widths of a steady oscillation
NO_TREND = 1.25  # largest ratio of the widths of both halves of the tail that counts as no trend
DECAYED = 0.01  # width relative to the motion before the tail; smaller widths that halve count as decaying
BEYOND = 1e100  # distance from the surface of the wall in m; a motion beyond it has diverged

FRAME = (
    *("velocity", "wall_force", "sticking"),
    *("energy", "wall_work", "external_work", "damping_loss", "friction_loss"),
)
"""Fields of `Motion` with one value per recorded instant, in the order of a frame, which begins with the positions."""
READING = ("measured", "estimated_velocity", "command", "contact", "tool_position", "coupling_force")
"""Fields of `Motion` with one value per sample, in the order of a reading; the last two only with a tool."""

# Description and SI unit of each field of `Motion` over time.
OF_MOTION = {
    "position": ("position of the device, into the wall", "m"),
    "velocity": ("velocity of the device", "m/s"),
    "wall_force": ("force of the wall", "N"),
    "sticking": ("friction holds the device", "1"),
    "tip_position": ("position of the mass at the far end of the coupling", "m"),
    "hand_position": ("position of the operator's hand", "m"),
    "measured": ("measured position", "m"),
    "estimated_velocity": ("estimated velocity", "m/s"),
    "command": ("force commanded at the sample", "N"),
    "contact": ("contact at the sample", "1"),
    "tool_position": ("position of the tool at the sample", "m"),
    "coupling_force": ("force of the coupling on the tool", "N"),
    "wall_work": ("energy supplied by the wall since the start", "J"),
    "external_work": ("energy supplied by the external force", "J"),
    "damping_loss": ("energy dissipated by dampers", "J"),
    "friction_loss": ("energy dissipated by friction", "J"),
    "energy": ("kinetic and elastic energy of all bodies", "J"),
}
# Description and SI unit of each field of `Motion` with one value per simulation.
OF_WHOLE = {
    "amplitude": ("half of the peak-to-peak position in the tail", "m"),
    "trend": ("ratio of the peak-to-peak positions in the second and first half of the tail", "1"),
    "frequency": ("frequency of the motion in the tail", "Hz"),
    "penetration": ("largest position at a sample", "m"),
    "bounces": ("number of times contact ends", "1"),
    "impact_velocity": ("velocity at the first sample in contact", "m/s"),
    "wall_work_max": ("largest net energy supplied by the wall", "J"),
    "outcome": ("code of the observed behavior", "1"),
    "status": ("status code", "1"),
}
# SI units of the fields above that contain quantities.
UNITS: dict[str, Any] = {name: unit for name, (_, unit) in OF_WHOLE.items() if name not in ("outcome", "status")}
# Fields of `Motion` that are unknown for a linear system.
OF_ENERGY = {"wall_work", "external_work", "damping_loss", "friction_loss", "energy", "wall_work_max"}


def _draw(motion: Motion) -> str:
    """Return a plot of position over time in text characters; "" for a batch, and if no samples were recorded."""
    if motion.position is None or np.ndim(motion.position) != 1:
        return ""
    return draw_line(motion.time, motion.position, "position over time")


@compact_repr(
    tuple(dict.fromkeys(("outcome", "time", *OF_WHOLE))),
    _draw,
    {
        "frequency": "fewer than two oscillations in the tail",
        "impact_velocity": "the device does not enter the wall after the first sample",
        "trend": "no motion in the tail, or a tail of one period",
    },
    outcome=MotionKind,
    time="s",
    **UNITS,
)
@dataclass(frozen=True)
class Motion:
    """Result of one simulation or a batch: arrays of the batch shape, those over time with one more axis at the end.

    Attributes:
        time: instants in s, ``substeps`` per period, the first 0; one axis if all simulations share the period.
        position, velocity: motion of the device, the body that the forces act on, in m and m/s; positive into the wall.
        tip_position, hand_position: positions of the bodies at the far ends of a coupling and of a grasp, in m; None
            if there is no such body.
        wall_force: force of the wall from the instant on, in N; with an actuator, its commanded force.
        sticking: True if friction holds the device.
        measured, estimated_velocity, command, contact: result of the control program at each sample. With a tool,
            ``estimated_velocity`` is the velocity of the device relative to the tool. ``command`` is the force on the
            device, after the limits of the motor.
        tool_position: position y of the tool at each sample in m, from which the force is computed; None without a
            tool.
        coupling_force: force f of the coupling on the tool at each sample, in N, before the limits of the motor; None
            without a tool.
        wall_work, external_work: energy supplied by the wall and by the external force since the start, in J.
        damping_loss, friction_loss: energy dissipated by dampers and by friction, in J.
        energy: kinetic and elastic energy of all bodies; increases by the work and decreases by the losses.
        amplitude: half of the peak-to-peak position at the samples of the tail, in m; infinite if the motion diverged.
        trend: peak-to-peak position in the second half of the tail, relative to the first half.
        frequency: frequency in the tail in Hz; NaN at rest, and with fewer than two oscillations.
        penetration: largest position at a sample, in m, at least 0.
        bounces: number of samples at which contact ends. A bilateral wall is always in contact; a force law is in
            contact while its force is nonzero.
        impact_velocity: velocity at the first sample at which contact begins, in m/s; NaN if no contact begins after
            the first sample.
        wall_work_max: largest net energy supplied by the wall, at any sample, in J, at least 0.
        outcome: code of `zwidth.MotionKind`, the behavior observed in the tail.
        status: code of `zwidth.Status`; not 0 with NaN: INVALID_INPUT, or NOT_CONVERGED if friction has more events
            within a period than the simulation follows, or if a force law returns no finite force.
    """

    time: Any
    position: Any
    velocity: Any
    wall_force: Any
    sticking: Any
    tip_position: Any
    hand_position: Any
    measured: Any
    estimated_velocity: Any
    command: Any
    contact: Any
    tool_position: Any
    coupling_force: Any
    wall_work: Any
    external_work: Any
    damping_loss: Any
    friction_loss: Any
    energy: Any
    amplitude: Any
    trend: Any
    frequency: Any
    penetration: Any
    bounces: Any
    impact_velocity: Any
    wall_work_max: Any
    outcome: Any
    status: Any

    def to_dataset(self, *dims: str) -> xarray.Dataset:
        """Return the motion as an xarray Dataset with long names and units; needs ``pip install zwidth[store]``.

        Args:
            *dims: names of the batch axes, none for a single motion; default ``batch_0``, ``batch_1``, ...

        Raises:
            InputError: the number of names differs from the number of axes, or a name is not unique.
        """
        import xarray

        shape = np.shape(self.amplitude)
        names = dims or tuple(f"batch_{k}" for k in range(len(shape)))
        taken = {"time", "instant", *OF_MOTION, *OF_WHOLE}
        if len(names) != len(shape) or len(set(names)) < len(names) or taken & set(names):
            raise InputError(
                f"dims: got {', '.join(map(repr, names))} for a batch of shape {shape}; use one unique name per axis, "
                "different from all variables"
            )
        variables: dict[str, Any] = {}
        for name, (long_name, units) in (OF_MOTION | OF_WHOLE).items():
            value = getattr(self, name)
            if value is not None:
                over = (*names, "time") if name in OF_MOTION else names
                variables[name] = (over, value, {"long_name": long_name, "units": find_unit(self, units)})
        data = xarray.Dataset(variables)
        if self.time is not None:
            over = "time" if self.time.ndim == 1 else (*names, "time")
            name = "time" if self.time.ndim == 1 else "instant"
            data = data.assign_coords({name: (over, self.time, {"long_name": "time", "units": "s"})})
        return data


def _measure_width(summary: Any, start: int, stop: int) -> np.ndarray:
    """Return the width of the motion of each body over segments ``start`` to ``stop - 1``; NaN without samples."""
    width = summary.far[start:stop].max(0).sum(0)
    return np.where(width >= 0, width, np.nan)


def _measure_halves(summary: Any) -> list[np.ndarray]:
    """Return the widths in the first and in the second half of the tail, two arrays of shape (bodies, batch)."""
    count = len(summary.far)
    return [_measure_width(summary, *half) for half in ((1, (1 + count) // 2), ((1 + count) // 2, count))]


def find_largest(summary: Any) -> np.ndarray:
    """Return the largest magnitude of the positions of all bodies at all samples, for each simulation."""
    return np.maximum(summary.far.max((0, 1, 2)), 0.0)


def classify(summary: Any, memory: np.ndarray, tail: int) -> np.ndarray:
    """Return the observed behavior of each motion, as a code of `MotionKind` (T7).

    Args:
        summary: extreme positions and number of oscillations per segment.
    """
    widest = find_largest(summary)
    width = np.stack([_measure_width(summary, k, k + 1)[0] for k in range(1, len(summary.turns))])
    before, (first, second) = _measure_width(summary, 0, 1), _measure_halves(summary)
    still = (second.max(0) <= AT_REST * widest) & (first.max(0) <= np.sqrt(AT_REST) * widest)
    # A motion counts as rest only if the second half of the tail is longer than the delay plus the window of the
    # velocity estimate, because commands computed from earlier positions can still move the bodies.
    still &= tail // 2 > np.maximum(memory, LEAST_REST)
    before, trend, second = before[0], second[0] / first[0], second[0]
    oscillating = summary.turns[1:].min(0) >= 1
    falling = np.all((np.diff(width, axis=0) < 0) | (width[1:] <= AT_REST * widest), axis=0)
    falling = (falling & (width[0] > AT_REST * widest)) | ((trend < 0.5) & (second < DECAYED * before))
    rising = np.all(np.diff(width, axis=0) > 0, axis=0) | ((trend > 2.0) & (second > 2.0 * before))
    conditions = {
        MotionKind.DIVERGED: ~(widest < BEYOND),
        MotionKind.REST: still,
        MotionKind.STEADY: oscillating & (np.ptp(width, axis=0) <= EQUAL * width.max(0)),
        MotionKind.DECAYING: falling,
        MotionKind.GROWING: rising,
    }
    level = oscillating & (np.abs(np.log(trend)) < np.log(NO_TREND))
    return np.select([*conditions.values(), level], [*conditions, MotionKind.STEADY], MotionKind.UNCLEAR)


@np.errstate(all="ignore")
def convert_to_si(
    simulated: Any, inputs: Any, dry: np.ndarray, memory: np.ndarray, bodies: tuple[str, ...], settings: Any
) -> dict[str, np.ndarray]:
    """Return a dict of the fields of `Motion`, converted to SI units, with one row per simulation.

    Args:
        simulated: result of `run_batch`: final state, readings and frames.
        inputs: external inputs, including the units of time and mass in SI.
        dry: mask of the simulations with friction.
        memory: number of past samples that can affect the next command.
        bodies: fields of `Motion` with the positions of the bodies.
        settings: settings that all simulations share.
    """
    state, readings, frames = simulated
    period, mass, instants = inputs.period, inputs.mass, inputs.instants
    summary, force = state.summary, mass / period**2
    first, second = _measure_halves(summary)
    turns = summary.turns[1:].sum(0)
    frequency = (turns - 1) / (np.diff(summary.turned, axis=0)[0] * period)
    # If the state is not finite although the motion was small, the simulation has failed: in the search for friction
    # events, or because a force law returned a force that is not finite.
    lost = ~np.isfinite(state.body.x).all(0) & (find_largest(summary) < BEYOND)
    outcome = np.where(lost, MotionKind.INVALID, classify(summary, memory, settings.tail))
    columns = {
        "amplitude": np.where(
            outcome == MotionKind.DIVERGED, np.inf, 0.5 * _measure_width(summary, 1, len(summary.far))[0]
        ),
        "trend": second[0] / first[0],
        "frequency": np.where((turns > 1) & (outcome != MotionKind.REST), frequency, np.nan),
        "penetration": np.maximum(summary.far[:, 1, 0].max(0), 0.0),
        "bounces": summary.exits.astype(int),
        "impact_velocity": summary.impact / period,
        "wall_work_max": summary.given * force,
        "outcome": outcome,
        "status": np.where(lost, Status.NOT_CONVERGED, Status.OK),
    }
    if frames is None:
        return columns
    units = {"velocity": 1.0 / period, "estimated_velocity": 1.0 / period}
    units |= dict.fromkeys(("wall_force", "command", "coupling_force", *FRAME[3:]), force)
    for rows, names in ((frames, (*bodies, *FRAME)), (readings[:, None], READING[: readings.shape[1]])):
        # Convert each array from the axes (periods, substeps, rows, batch) to (rows, batch, instants), where a row is
        # one recorded quantity. The axes of periods and substeps are merged into one axis of recorded instants, in
        # order of time.
        flat = np.moveaxis(rows, (2, 3), (0, 1)).reshape(len(names), len(period), -1)
        columns |= {name: row * units.get(name, np.ones(1))[:, None] for name, row in zip(names, flat, strict=True)}
    columns["sticking"] = (columns["sticking"] == 0) & dry[:, None]
    columns["contact"] = columns["contact"] > 0
    if instants is not None:
        substeps = frames.shape[1]
        shares = np.arange(substeps)[:, None] / substeps
        time = instants[:-1, None] + shares * np.diff(instants, axis=0)[:, None]
        columns["time"] = time.reshape(-1, len(period)).T * period[:, None]
    return columns
