"""Describe the observed behavior of a simulated motion in words, for studies, commands and the explorer."""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.simulation.result import Motion, MotionKind
from zwidth.units.display import find_unit
from zwidth.units.formatting import with_unit

SMALL = 1e-6  # amplitude in m (rad) below which a motion has decayed
SMALL_RATIO = 1e-3  # the same, relative to the largest position
WORDS = {
    MotionKind.REST: "comes to rest",
    MotionKind.DECAYING: "decays",
    MotionKind.STEADY: "keeps oscillating",
    MotionKind.GROWING: "grows",
    MotionKind.DIVERGED: "grows without bound",
    MotionKind.UNCLEAR: "oscillates with unclear trend",
    MotionKind.INVALID: "not simulated to the end",
}


def describe_ending(motion: Motion, index: Any = ()) -> str:
    """Return a phrase for the observed behavior of a recorded motion; ``index`` selects one entry of a batch."""
    kind = MotionKind(int(motion.outcome[index]))
    if kind in (MotionKind.DIVERGED, MotionKind.INVALID):
        return WORDS[kind]
    time, contact = motion.time if motion.time.ndim == 1 else motion.time[index], motion.contact[index]
    # Add one step to the last recorded instant, because it precedes the end of the simulation by one step.
    duration = with_unit(float(time[-1]) * time.size / max(time.size - 1, 1), "s", 3)
    hits = np.flatnonzero(contact[1:] & ~contact[:-1]) + 1
    if not contact[-max(contact.size // 4, 1) :].any():
        times = hits.size + int(contact[0])
        left = f"leaves the wall after {times} contact{'' if times == 1 else 's'}" if times else "never meets the wall"
        return left + (", comes to rest outside" if kind is MotionKind.REST else "") + f" within {duration}"
    if kind not in (MotionKind.REST, MotionKind.DECAYING) and hits.size > 1:
        speeds = motion.velocity[index].reshape(contact.size, -1)[hits, 0]
        first, last = (with_unit(float(speed), find_unit(motion, "m/s"), 3) for speed in speeds[[0, -1]])
        return f"bounces: impact velocity from {first} to {last} over {hits.size} impacts within {duration}"
    frequency = float(motion.frequency[index])
    if kind in (MotionKind.STEADY, MotionKind.UNCLEAR) and np.isfinite(frequency):
        amplitude = with_unit(float(motion.amplitude[index]), find_unit(motion, "m"), 3)
        return f"{WORDS[kind]} at {with_unit(frequency, 'Hz', 3)}, amplitude {amplitude}, after {duration}"
    if kind is MotionKind.UNCLEAR:
        positions = motion.position[index]
        steps = np.diff(positions[-max(positions.size // 4, 2) :])
        if np.all(steps >= 0) or np.all(steps <= 0):
            return f"still moves in one direction after {duration}; simulate longer"
        return f"undecided after {duration}: too few oscillations; simulate longer"
    if kind is MotionKind.DECAYING:
        size, depth = float(motion.amplitude[index]), float(motion.penetration[index])
        amplitude = with_unit(size, find_unit(motion, "m"), 3)
        if size < max(SMALL, SMALL_RATIO * depth):
            return f"decays to an amplitude of {amplitude} within {duration}"
        return f"still decays after {duration}, amplitude {amplitude}"
    return f"{WORDS[kind]} within {duration}"
