"""Read logs from arrays, repair them, and refuse those to which no device can be fitted.

Each sample gets an integer index, its time in sampling periods after the first sample. A straight line is fitted to the
times over these indices; its slope is the sampling period. The times may deviate from the line by limited timestamp
jitter, or by the rounding of a coarse clock to its ticks (`identification.repair`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.identification.friction_model import Recording
from zwidth.identification.repair import even_coarse_times, refuse_repeated, repair_log
from zwidth.model.checks import check_number
from zwidth.numerics.evaluate import as_float64
from zwidth.units.formatting import plain, with_unit
from zwidth.units.quantities import NOT_NEGATIVE, POSITIVE, SI_RANGE
from zwidth.units.unit_system import UnitSystem

# Largest accepted deviation of a time from the fitted line, in sampling periods.
_UNEVEN = 0.05  # deviation that is always accepted
_JITTER = 0.25  # deviation accepted if the user allows timestamp jitter; smaller than a missing sample causes
# Largest accepted difference between the sampling periods of two logs: a share of the period plus a number of standard
# errors.
_SAME = 1e-5  # relative to the period
_SURE = 5.0  # number of standard errors
# A warning is issued if position or force is constant at its maximum or minimum for this number of samples.
_STUCK = 25
# A warning about a constant extreme value of the force also requires that the force varies elsewhere: the number of its
# other distinct values must exceed this share of the number of samples.
_MANY = 0.1
_MISSING = 1.5  # ratio of a time step to the median time step above which samples are missing


class ReadLogs(NamedTuple):
    """Repaired logs with evenly spaced samples, which may have gaps."""

    logs: tuple[Recording, ...]
    places: tuple[np.ndarray, ...]  # for each log, the times of its samples in sampling periods after the first sample
    period: float  # sampling period, s
    period_error: float  # relative standard error of the period; 0 if the user specified the period
    notes: tuple[str, ...]  # descriptions of the repairs, one clause each
    steps: tuple[tuple[float, float], ...]  # encoder step and rounding step of each position column, from `find_steps`


def read_logs(
    time: Any, position: Any, force: Any, system: UnitSystem, resample: bool = False, resolution: Any = None
) -> ReadLogs:
    """Read logs from arrays and repair them; raise `InputError` if no device can be fitted to them.

    Args:
        time: times in s, or the sampling period; a list for several logs.
        position: positions in SI units, NaN where missing; a list for several logs.
        force: forces in SI units, NaN where missing; a list for several logs.
        system: units of position and force.
        resample: allow timestamp jitter up to a quarter of the period.
        resolution: encoder step in SI units; None if unknown.
    """
    several = isinstance(position, list | tuple) and len(position) > 0 and np.ndim(position[0]) == 1
    positions, forces = (position, force) if several else ([position], [force])
    times = time if several and isinstance(time, list | tuple) else [time] * len(positions)
    if not len(times) == len(positions) == len(forces):
        raise InputError(
            f"time, position, force: got {len(times)}, {len(positions)} and {len(forces)} logs; give each log all three"
        )
    step = 0.0 if resolution is None else check_number("resolution", resolution, system["m"], NOT_NEGATIVE)
    read = [_read(*parts, resample, step, system) for parts in zip(times, positions, forces, strict=True)]
    logs, places, periods, errors, notes, steps = zip(*read, strict=True)
    if len(read) > 1:
        notes = [[f"log {k}: {note}" for note in each] for k, each in enumerate(notes, start=1)]
    error = max(errors)
    if np.ptp(periods) > (_SAME + _SURE * error) * periods[0]:
        raise InputError(
            f"time: the logs have periods of {with_unit(min(periods), 's')} to {with_unit(max(periods), 's')}; fit "
            "them one by one"
        )
    return ReadLogs(logs, places, float(np.mean(periods)), error, tuple(note for each in notes for note in each), steps)


def _read(
    time: Any, position: Any, force: Any, resample: bool, step: float, system: UnitSystem
) -> tuple[Recording, np.ndarray, float, float, list[str], tuple[float, float]]:
    """Read and repair one log.

    Args:
        time: times in s, or the sampling period.
        position: positions in SI units, NaN where missing.
        force: forces in SI units, NaN where missing.
        resample: allow timestamp jitter up to a quarter of the period.
        step: encoder step in SI units, 0 if unknown.
        system: units of position and force.

    Returns:
        The entries of this log for the fields of `ReadLogs`, in their order.
    """
    x, f = as_float64("position", position), as_float64("force", force)
    clock = None if isinstance(time, str) or np.ndim(time) == 0 else as_float64("time", time)
    given = {"position": x, "force": f} | ({} if clock is None else {"time": clock})
    shapes = {array.shape for array in given.values()}
    if len(shapes) == 1 and x.shape == (1,):
        raise InputError("got a single sample; a fit needs many: record some seconds of motion")
    if len(shapes) > 1 or x.ndim != 1 or x.size < 2:
        text = ", ".join(f"{name} {array.shape}" for name, array in given.items())
        raise InputError(f"shapes differ or are not single columns: {text}; give one number per sample in each")
    for name, array in given.items():
        finite = array[np.isfinite(array)]
        if not finite.size:
            raise InputError(f"{name}: it contains no number; check the column")
        low, high = float(finite.min()), float(finite.max())
        if max(-low, high) > SI_RANGE[1] or 0 < high - low < SI_RANGE[0]:
            least, most = SI_RANGE
            raise InputError(
                f"{name}: got values from {plain(low)} to {plain(high)}; they must be at most {most:g} in magnitude "
                f"and at least {least:g} apart; check the unit"
            )
    clock, row, x, f, notes, steps = repair_log(clock, x, f, step, system)
    if clock is None:
        place, period, error = row - row[0], check_number("time", time, "s", POSITIVE), 0.0
    else:
        place, period, error = _assign_periods(clock, resample, notes)
    if np.ptp(f) == 0:
        raise InputError(
            f"force: it is {plain(f[0])} {system['N']} all the time; command a force that changes, such as steps of "
            "both signs"
        )
    if np.ptp(x) == 0:
        raise InputError("position: it never changes; check the column, and that nothing blocks the device")
    return Recording(f, x, 0), place, period, error, notes, steps


def _assign_periods(clock: np.ndarray, jitter: bool, notes: list[str]) -> tuple[np.ndarray, float, float]:
    """Assign the samples to sampling periods, and estimate the period by a line through all times.

    Args:
        clock: times in s.
        jitter: allow timestamp jitter up to ``_JITTER`` periods.
        notes: list to which a note is appended if the times are rounded to ticks.

    Returns:
        The index of each sample in sampling periods, the period in s, and its relative standard error.
    """
    steps = np.diff(clock)
    usual = float(np.median(steps))
    uneven = np.ptp(steps) > _UNEVEN * usual
    coarse = even_coarse_times(clock) if uneven and not jitter else None
    if coarse is not None:
        notes.append(coarse.note)
    elif steps.min() <= 0:
        refuse_repeated(clock)
    # Assume that no samples are missing if timestamp jitter is allowed, because their number would be ambiguous.
    passed = np.where((steps > _MISSING * usual) & (not jitter), np.round(steps / usual), 1.0)
    place = np.concatenate([[0.0], np.cumsum(passed)]) if coarse is None else coarse.place
    count = place - place.mean()
    square = float(count @ count)
    # Compute the slope of the line through all times, rounded to the number of digits that times usually have.
    period = float(f"{count @ clock / square:.12g}")
    late = clock - clock.mean() - period * count
    error = float(np.sqrt(late @ late / max(1, clock.size - 2) / square))
    # Center the range of the deviations at 0, because a single late sample would otherwise shift all deviations.
    late = late - 0.5 * (late.max() + late.min())
    worst = int(np.argmax(np.abs(late)))
    if coarse is None and abs(late[worst]) > (_JITTER if jitter else _UNEVEN) * period:
        if abs(late[worst]) > _JITTER * period:
            remedy = "the samples cannot be assigned to periods; record with a constant period"
        else:
            remedy = (
                "record with a constant period; if only the timestamps have jitter, give the period in place of the "
                "times, or use resample"
            )
        raise InputError(
            f"time: samples are not evenly spaced: steps from {with_unit(float(steps.min()), 's')} to "
            f"{with_unit(float(steps.max()), 's')}, sample {worst} is off by "
            f"{plain(100 * abs(late[worst]) / period, 2)} % of a period; {remedy}"
        )
    return place.astype(int), period, error / period


def find_even(place: np.ndarray, least: int) -> list[slice]:
    """Divide a log at its gaps, and return the stretches with at least ``least`` samples as slices.

    Args:
        place: index of each sample in sampling periods.
        least: least number of samples per stretch.
    """
    runs = find_runs(np.diff(place) == 1).tolist()
    return [slice(first, last + 1) for first, last in runs if last + 1 - first >= least]


def find_stretches(log: Recording, system: UnitSystem) -> list[str]:
    """Return warnings about positions or forces that stay at an extreme value.

    They indicate an end stop, a saturated sensor or a saturated motor.
    """
    warnings = []
    for end, direction in ((log.position.max(), 1.0), (log.position.min(), -1.0)):
        first, last = _find_longest_run((log.position == end) & (log.force * direction > 0))
        if last - first >= _STUCK:
            warnings.append(
                f"the position stays at {with_unit(end, system['m'], 4)} from sample {first} to {last - 1} despite a "
                "force: end stop, saturated sensor or static friction; omit such stretches"
            )
    for end in (log.force.max(), log.force.min()):
        at_end = log.force == end
        first, last = _find_longest_run(at_end)
        inside = np.unique(log.force[~at_end]).size
        if inside > _MANY * at_end.size and last - first >= _STUCK:
            warnings.append(
                f"the force stays at {with_unit(end, system['N'], 4)} from sample {first} to {last - 1} and varies "
                "elsewhere: if the motor saturates, log the force after saturation"
            )
    return warnings


def find_runs(marked: np.ndarray) -> np.ndarray:
    """Find the runs of successive True entries in a mask.

    Returns:
        An array with one row per run: its first index, and its last index plus 1.
    """
    return np.flatnonzero(np.diff(np.concatenate([[0], marked.astype(np.int8), [0]]))).reshape(-1, 2)


def _find_longest_run(marked: np.ndarray) -> tuple[int, int]:
    """Return the first index and the last index plus 1 of the longest run in a mask; (0, 0) if there is none."""
    first, last = max(find_runs(marked).tolist(), key=lambda run: run[1] - run[0], default=(0, 0))
    return first, last
