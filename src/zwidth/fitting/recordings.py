"""Logs as they are given: read, and refused where nothing can be found from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from zwidth.batching import as_float64
from zwidth.errors import InputError
from zwidth.fitting.moving import Recording
from zwidth.formatting import plain, with_unit
from zwidth.parts.checks import check_number

# How far a sample's time may lie from an even one, as a share of the period; how far periods of logs may differ.
_UNEVEN, _SAME = 0.05, 1e-5
# Positions beyond the past forces.
_FEWEST = 20


@dataclass(frozen=True)
class Log:
    """One log, checked."""

    force: np.ndarray
    position: np.ndarray

    def recording(self, skip: int, k: int) -> Recording:
        """What is computed with: positions from ``skip`` on."""
        if self.force.size < skip + _FEWEST:
            raise InputError(
                f"time: log {k + 1} has {self.force.size} samples, and the first {skip} serve as past force; at least "
                f"{skip + _FEWEST} are needed: record longer, or give a shorter max_delay"
            )
        return Recording(self.force, self.position[skip:], skip)


def read_logs(time: Any, position: Any, force: Any) -> tuple[tuple[Log, ...], float]:
    """The logs and their period."""
    several = isinstance(position, list | tuple) and len(position) > 0 and np.ndim(position[0]) == 1
    positions, forces = (position, force) if several else ([position], [force])
    times = time if several and isinstance(time, list | tuple) else [time] * len(positions)
    if not len(times) == len(positions) == len(forces):
        raise InputError(
            f"time, position, force: got {len(times)}, {len(positions)} and {len(forces)} logs; give each log all three"
        )
    read = [_read(*parts) for parts in zip(times, positions, forces, strict=True)]
    periods = [period for _, period in read]
    if np.ptp(periods) > _SAME * periods[0]:
        raise InputError(
            f"time: the logs have periods of {with_unit(min(periods), 's')} to {with_unit(max(periods), 's')}; fit "
            "them one by one"
        )
    return tuple(log for log, _ in read), float(np.mean(periods))


def _read(time: Any, position: Any, force: Any) -> tuple[Log, float]:
    x, f = as_float64("position", position), as_float64("force", force)
    clock = None if isinstance(time, str) or np.ndim(time) == 0 else as_float64("time", time)
    given = {"position": x, "force": f} | ({} if clock is None else {"time": clock})
    shapes = {array.shape for array in given.values()}
    if len(shapes) > 1 or x.ndim != 1 or x.size < 2:
        text = ", ".join(f"{name} {array.shape}" for name, array in given.items())
        raise InputError(f"shapes differ or are no single columns: {text}; give one number a sample in each")
    for name, array in given.items():
        bad = np.flatnonzero(~np.isfinite(array))
        if bad.size:
            raise InputError(f"{name}: {bad.size} samples are no numbers, the first is sample {bad[0]}; leave them out")
    period = check_number("time", time, "s", low_open=True) if clock is None else _period(clock)
    if np.ptp(f) == 0:
        raise InputError(
            f"force: it is {plain(f[0])} N all the time; command a force that changes, as steps to and fro"
        )
    if np.ptp(x) == 0:
        raise InputError("position: it never changes; check the column, and that nothing holds the device")
    return Log(f, x), period


def _period(clock: np.ndarray) -> float:
    """The mean step of even times."""
    steps = np.diff(clock)
    if steps.min() <= 0:
        k = int(np.argmin(steps))
        raise InputError(f"time: it does not grow from sample {k} to {k + 1}; sort the samples, drop double ones")
    period = float((clock[-1] - clock[0]) / (clock.size - 1))
    late = clock - clock[0] - period * np.arange(clock.size)
    # Against the middle of them, for the first sample may be the late one.
    late = late - 0.5 * (late.max() + late.min())
    worst = int(np.argmax(np.abs(late)))
    if abs(late[worst]) > _UNEVEN * period:
        raise InputError(
            f"time: samples are not even: steps from {with_unit(float(steps.min()), 's')} to "
            f"{with_unit(float(steps.max()), 's')}, sample {worst} {plain(100 * abs(late[worst]) / period, 2)} % of a "
            "period off; record at even times, fill what is missing, or give the period in place of the times"
        )
    return period
