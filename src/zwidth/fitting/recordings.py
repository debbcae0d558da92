"""Read logs from arrays, repair them, and refuse those to which no device can be fitted.

Samples are assigned to whole sampling periods by a line through all times, with the slope of the period. Times may
differ from this line by timestamp jitter within limits, or by the ticks of a coarse clock (`fitting.repair`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.evaluate import as_float64
from zwidth.fitting.moving import Recording
from zwidth.fitting.repair import even_coarse_times, refuse_repeated, repair_log
from zwidth.parts.checks import check_number
from zwidth.words.errors import InputError
from zwidth.words.formatting import plain, with_unit
from zwidth.words.quantities import NOT_NEGATIVE, POSITIVE, SI_RANGE
from zwidth.words.unit_system import UnitSystem

# Largest distance of a time from an evenly spaced one, in periods.
_UNEVEN = 0.05  # without timestamp jitter
_JITTER = 0.25  # with timestamp jitter; less than the distance that a missing sample causes
_SAME = 1e-5  # largest relative difference of the periods of two logs, in addition to their errors
_SURE = 5.0  # standard errors of a period that its difference from another may have
_STUCK = 25  # least duration in samples of a constant maximum or minimum that causes a warning
_MANY = 0.1  # a force varies if the ratio of its values below the maximum to the samples at the maximum is larger
_MISSING = 1.5  # least ratio of a time step to the median step at which samples are missing


class ReadLogs(NamedTuple):
    """Logs at even times, after repair."""

    logs: tuple[Recording, ...]
    places: tuple[np.ndarray, ...]  # for each log, the times of its samples in whole periods after the first
    period: float  # s
    period_error: float  # relative standard error of the period
    notes: tuple[str, ...]  # the repairs, one clause each
    steps: tuple[tuple[float, float], ...]  # encoder step and column step of each log, from `find_steps`


def read_logs(
    time: Any, position: Any, force: Any, system: UnitSystem, resample: bool = False, resolution: Any = None
) -> ReadLogs:
    """Read and repair logs; raise `InputError` if no device can be fitted to them.

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
    """Read one log; return its part of each field of `ReadLogs`. ``step`` is the encoder step, 0 if unknown."""
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
    """Return the index of each sample in periods, the period in s and its relative standard error.

    Args:
        clock: times in s.
        jitter: allow timestamp jitter up to ``_JITTER`` periods.
        notes: receives a note on times that are rounded to ticks.
    """
    steps = np.diff(clock)
    usual = float(np.median(steps))
    uneven = np.ptp(steps) > _UNEVEN * usual
    coarse = even_coarse_times(clock) if uneven and not jitter else None
    if coarse is not None:
        notes.append(coarse.note)
    elif steps.min() <= 0:
        refuse_repeated(clock)
    # Do not search for missing samples with timestamp jitter, because their number would be ambiguous.
    passed = np.where((steps > _MISSING * usual) & (not jitter), np.round(steps / usual), 1.0)
    place = np.concatenate([[0.0], np.cumsum(passed)]) if coarse is None else coarse.place
    count = place - place.mean()
    square = float(count @ count)
    # The slope of the line through all times, with as many digits as times usually have.
    period = float(f"{count @ clock / square:.12g}")
    late = clock - clock.mean() - period * count
    error = float(np.sqrt(late @ late / max(1, clock.size - 2) / square))
    # Measure deviations from the middle of their range, because the first sample may be the one that is late.
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
    """Return the stretches of a log without missing samples that have at least ``least`` samples."""
    runs = find_runs(np.diff(place) == 1).tolist()
    return [slice(first, last + 1) for first, last in runs if last + 1 - first >= least]


def find_stretches(log: Recording, system: UnitSystem) -> list[str]:
    """Return warnings about an end stop, a saturated sensor or a saturated motor."""
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
    """Return the first index and one past the last index of each run of marked samples, one row per run."""
    return np.flatnonzero(np.diff(np.concatenate([[0], marked.astype(np.int8), [0]]))).reshape(-1, 2)


def _find_longest_run(marked: np.ndarray) -> tuple[int, int]:
    """Return the longest of the runs of `find_runs`, (0, 0) if no sample is marked."""
    first, last = max(find_runs(marked).tolist(), key=lambda run: run[1] - run[0], default=(0, 0))
    return first, last
