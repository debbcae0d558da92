"""What a simulation returns: the motion in SI units, and what is said of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.words.errors import InputError
from zwidth.words.showing import draw_line, find_unit, shown
from zwidth.words.status import Status

if TYPE_CHECKING:
    import xarray


class MotionKind(IntEnum):
    """What becomes of a motion: each proved, or `UNCLEAR` (docs/theory/simulation.md, T7)."""

    REST = 0
    DECAYING = 1
    STEADY = 2
    GROWING = 3
    DIVERGED = 4
    UNCLEAR = 5
    INVALID = 6
    RESTLESS = 7


# A tail this small beside the widest motion is at rest; halves this much alike are steady, and hold so many swings.
_AT_REST, _STILL, _ALIKE, _SWINGS, _BEYOND = 1e-9, 8, 0.02, 2, 1e100
# Who halves in so many times the periods has changed by 2 % after 20 times as many.
_FOR_GOOD = 4000.0

OF_MOTION = {
    "position": ("position of the device, into the wall", "m"),
    "velocity": ("velocity of the device", "m/s"),
    "wall_force": ("force of the wall that acts", "N"),
    "sticking": ("whether friction holds the device", "1"),
    "tip_position": ("position of the mass beyond the coupling", "m"),
    "hand_position": ("position of the hand behind its grasp", "m"),
    "measured": ("position that the program reads", "m"),
    "estimated_velocity": ("velocity that the program estimates", "m/s"),
    "command": ("force that the program commands at the sample", "N"),
    "contact": ("whether the program sees contact at the sample", "1"),
    "wall_work": ("energy that the wall has given since the start", "J"),
    "push_work": ("energy that the pushing hand has given", "J"),
    "damping_loss": ("energy that dampers have taken", "J"),
    "friction_loss": ("energy that friction has taken", "J"),
    "energy": ("kinetic and elastic energy of all bodies", "J"),
}
OF_WHOLE = {
    "amplitude": ("half of the peak-to-peak position in the tail", "m"),
    "trend": ("width of the second half of the tail over that of the first", "1"),
    "frequency": ("frequency of the motion in the tail", "Hz"),
    "penetration": ("largest position at a sample", "m"),
    "bounces": ("number of times contact ends", "1"),
    "impact_velocity": ("velocity at the first sample in contact", "m/s"),
    "energy_given": ("most energy that the wall has given beyond what it took", "J"),
    "outcome": ("how the motion ends", "1"),
    "status": ("why a simulation has its values", "1"),
}
OF_ENERGY = {"wall_work", "push_work", "damping_loss", "friction_loss", "energy", "energy_given"}


def _draw(motion: Motion) -> str:
    """A small picture of a single motion that was recorded."""
    if motion.position is None or np.ndim(motion.position) != 1:
        return ""
    return draw_line(motion.time, motion.position, "position over time")


@shown(
    ("outcome", "time", *OF_WHOLE),
    _draw,
    {
        "frequency": "the velocity does not turn twice in the tail",
        "impact_velocity": "the device does not enter the wall after the first sample",
        "trend": "nothing moves, or the tail is one period",
    },
    outcome=MotionKind,
    time="s",
    **{name: unit for name, (_, unit) in OF_WHOLE.items() if name != "outcome" and name != "status"},
)
@dataclass(frozen=True)
class Motion:
    """One motion or many: arrays of the batch's shape, those over time with one more axis at the end.

    Attributes:
        time: instants in s, ``substeps`` a period, the first 0; of one axis where all share a period.
        position, velocity: of the device, the body that the forces act on, in m and m/s; positive into the wall.
        tip_position, hand_position: of the bodies behind a coupling and behind a grasp; None without.
        wall_force: that acts from the instant on, in N; with an actuator, what it is commanded then.
        sticking: whether friction holds the device.
        measured, estimated_velocity, command, contact: what the program made of the last sample.
        wall_work, push_work: energy given by the wall and by the hand's push since the start, in J.
        damping_loss, friction_loss: energy taken by dampers and by friction.
        energy: kinetic and elastic energy of all bodies; grows by the work done and falls by what is lost.
        amplitude: half of the peak-to-peak position in the tail, in m, at the samples; infinite for a diverged motion.
        trend: the peak-to-peak position in the second half of the tail over that in the first.
        frequency: of the motion in the tail, in Hz; NaN at rest and where the velocity does not turn twice there.
        penetration: the largest position at a sample, in m, at least 0.
        bounces: number of samples at which contact ends. A bilateral wall is always in contact; a force law is in
            contact while its force is nonzero.
        impact_velocity: velocity at the first sample at which contact begins, in m/s; NaN if no contact begins after
            the first sample.
        energy_given: the most that the wall has given beyond what it took, at any sample, in J, at least 0.
        outcome: a code of `zwidth.MotionKind`, what becomes of the motion, the hand pushing on as in the tail
            (docs/theory/simulation.md, T7). Proved: REST, no body moves more than 1e-9 of the widest motion in the
            tail's second half, nor will; DECAYING, it comes to rest; GROWING, it gets ever wider; STEADY, it goes on as
            it is; RESTLESS, it never comes to rest, and ``trend`` says how its width changes: there is no place where
            it could, or it repeats by now and was wider in the tail before; DIVERGED, beyond 1e100. UNCLEAR, none of
            these is shown. INVALID, ``status`` is not 0.
        status: code of `zwidth.Status`; not 0 with NaN: INVALID_INPUT, or NOT_CONVERGED where friction had more events
            within a period than are followed, or a force law gave no finite force.
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
    wall_work: Any
    push_work: Any
    damping_loss: Any
    friction_loss: Any
    energy: Any
    amplitude: Any
    trend: Any
    frequency: Any
    penetration: Any
    bounces: Any
    impact_velocity: Any
    energy_given: Any
    outcome: Any
    status: Any

    def to_dataset(self, *dims: str) -> xarray.Dataset:
        """The same as an xarray Dataset (extra ``store``), each variable with its long name and unit.

        Args:
            *dims: names of the batch's axes, none for a single motion; ``batch_0``, ``batch_1``, ... where left out.

        Raises:
            InputError: more or fewer names than axes, one twice, or that of a variable.
        """
        import xarray

        shape = np.shape(self.amplitude)
        names = dims or tuple(f"batch_{k}" for k in range(len(shape)))
        taken = {"time", "instant", *OF_MOTION, *OF_WHOLE}
        if len(names) != len(shape) or len(set(names)) < len(names) or taken & set(names):
            raise InputError(
                f"dims: got {', '.join(map(repr, names))} for a batch of shape {shape}; give a name for each axis, all "
                "different and none of a variable or time"
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


def classify(known: Any, outlook: Any, course: Any) -> np.ndarray:
    """How motions end."""
    wide = known.high[1:] - known.low[1:]
    first, second = wide.max(1)
    # A tail of a period or two has not moved for want of time.
    still = (second <= _AT_REST * known.widest) & (first <= np.sqrt(_AT_REST) * known.widest) & (course.tail >= _STILL)
    # Commands that are still on their way may move again what has not moved for a while.
    still &= ~(outlook.settles | outlook.grows) | (outlook.off <= _AT_REST * known.widest)
    alike = np.ptp(wide[:, 0], axis=0) <= _ALIKE * wide[:, 0].max(0)
    slow = (outlook.pace > _FOR_GOOD * course.periods) & (outlook.settles | outlook.grows)
    # What repeats by now may have been wider before: the tail's width is not that of what lasts.
    lasting = ~still & (known.turns[1:].min(0) >= _SWINGS) & alike & (outlook.repeats | slow)
    growing = outlook.grows & ~still & ((wide[1, 0] >= wide[0, 0]) | (outlook.pace <= 2 * course.periods))
    kind = np.where(outlook.restless & (second > _AT_REST * known.widest), MotionKind.RESTLESS, MotionKind.UNCLEAR)
    kind = np.where(growing, MotionKind.GROWING, kind)
    kind = np.where(outlook.settles, np.where(still, MotionKind.REST, MotionKind.DECAYING), kind)
    kind = np.where(lasting, MotionKind.STEADY, kind)
    # All bodies without any motion of a loop that grows.
    kind = np.where(outlook.grows & (first == 0) & (second == 0) & still, MotionKind.REST, kind)
    return np.where(known.widest < _BEYOND, kind, MotionKind.DIVERGED)


@np.errstate(all="ignore")
def to_si(
    found: Any, given: Any, dry: np.ndarray, outlook: Any, bodies: tuple[str, ...], course: Any
) -> dict[str, np.ndarray]:
    """Columns of one row a simulation, by the names of `Motion`; ``bodies`` names the positions of all bodies."""
    state, reading, frame = found
    period, mass, instants = given.period, given.mass, given.instants
    known, force = state.summary, mass / period**2
    low, high = (part[1:, 0] for part in (known.low, known.high))
    # Of a tail of one period the second half has no sample.
    width = np.where(high >= low, high - low, np.nan)
    finite = np.isfinite(state.body.x).all(0)
    turns = known.turns[1:].sum(0)
    frequency = (turns - 1) / (np.diff(known.turned, axis=0)[0] * period)
    # A motion that is lost before it is large was not followed.
    lost = ~finite & (known.widest < _BEYOND)
    outcome = np.where(lost, MotionKind.INVALID, classify(known, outlook, course))
    columns = {
        "amplitude": np.where(outcome == MotionKind.DIVERGED, np.inf, 0.5 * (high.max(0) - low.min(0))),
        "trend": width[1] / width[0],
        "frequency": np.where((turns > 1) & (outcome != MotionKind.REST), frequency, np.nan),
        "penetration": known.deepest,
        "bounces": known.exits.astype(int),
        "impact_velocity": known.impact / period,
        "energy_given": known.given * force,
        "outcome": outcome,
        "status": np.where(lost, Status.NOT_CONVERGED, Status.OK),
    }
    if frame is None:
        return columns

    def unroll(part: np.ndarray) -> np.ndarray:
        """(periods, substeps, lanes) as (lanes, samples)."""
        return part.reshape(-1, part.shape[-1]).T

    columns |= {name: unroll(part) for name, part in zip(bodies, frame.positions, strict=True)}
    columns |= {
        "velocity": unroll(frame.velocity) / period[:, None],
        "wall_force": unroll(frame.force) * force[:, None],
        "sticking": (unroll(frame.slip) == 0) & dry[:, None],
        "measured": reading.measured.T,
        "estimated_velocity": reading.velocity.T / period[:, None],
        "command": reading.command.T * force[:, None],
        "contact": reading.touching.T > 0,
        "energy": unroll(frame.energy) * force[:, None],
    }
    for name, part in zip(("wall_work", "push_work", "damping_loss", "friction_loss"), frame.work, strict=True):
        columns[name] = unroll(part) * force[:, None]
    if instants is not None:
        substeps = frame.force.shape[1]
        shares = np.arange(substeps)[:, None] / substeps
        time = instants[:-1, None] + shares * np.diff(instants, axis=0)[:, None]
        columns["time"] = unroll(time) * period[:, None]
    return columns
