"""Description of the final state of a simulated motion, for studies, commands and the explorer."""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.simulation.result import Motion, MotionKind
from zwidth.words.formatting import with_unit
from zwidth.words.showing import find_unit

_UNBOUNDED = "grows without bound"
_WORDS = {
    MotionKind.REST: "comes to rest",
    MotionKind.DECAYING: "decays to rest",
    MotionKind.GROWING: _UNBOUNDED,
    MotionKind.DIVERGED: _UNBOUNDED,
    MotionKind.INVALID: "not simulated to the end",
}


def describe_ending(motion: Motion, index: Any = ()) -> str:
    """Return the final state of a recorded motion in words; ``index`` selects one entry of a batch."""
    kind = MotionKind(int(motion.outcome[index]))
    if kind in (MotionKind.DIVERGED, MotionKind.INVALID):
        return _WORDS[kind]
    velocity, contact = motion.velocity[index], motion.contact[index]
    if not contact[-max(contact.size // 4, 1) :].any() and kind is not MotionKind.RESTLESS:
        times = int(np.count_nonzero(contact[1:] & ~contact[:-1]) + contact[0])
        left = f"leaves the wall after {times} contact{'' if times == 1 else 's'}" if times else "never meets the wall"
        return left + (", comes to rest outside" if kind is MotionKind.REST else "")
    if kind in (MotionKind.UNCLEAR, MotionKind.RESTLESS):
        hits = np.flatnonzero(contact[1:] & ~contact[:-1]) + 1
        if hits.size > 1:
            speeds = velocity.reshape(contact.size, -1)[hits, 0]
            first, last = (with_unit(float(speed), find_unit(motion, "m/s"), 3) for speed in speeds[[0, -1]])
            change = "growing" if speeds[-1] > speeds[0] else "decaying"
            return f"bounces, {change}: impact velocity from {first} to {last} over {hits.size} impacts"
    if kind in (MotionKind.REST, MotionKind.DECAYING, MotionKind.GROWING):
        return _WORDS[kind]
    frequency = float(motion.frequency[index])
    if kind is MotionKind.UNCLEAR and not np.isfinite(frequency):
        return "undecided: too few oscillations at the end; simulate longer"
    rate = f" at {with_unit(frequency, 'Hz', 3)}" if np.isfinite(frequency) else ""
    swing = f"{rate}, amplitude {with_unit(float(motion.amplitude[index]), find_unit(motion, 'm'), 3)}"
    return f"oscillates at the end{swing}" if kind is MotionKind.UNCLEAR else f"limit cycle{swing}"
