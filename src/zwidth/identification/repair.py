"""Repair the usual faults of logs: missing numbers, clock rollover, coarse times, wrapped positions, isolated glitches.

A position *wraps* if it jumps by a constant *modulus* at the end of the range of the counter. A *glitch* is a run of a
few wrong positions. A *second difference* is the difference of two successive differences of the positions. A note
reports every repair and its number of rows. No value is invented: a faulty row is omitted, and the rows before and
after it are fitted as two logs. Samples and rows are counted from 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, NoReturn

import numpy as np

from zwidth.core.errors import InputError
from zwidth.identification.quantization_noise import find_resolution, find_steps
from zwidth.units.formatting import plain, with_unit
from zwidth.units.unit_system import UnitSystem

# Times in s after which common clocks and counters roll over, keyed by the descriptions that notes contain.
_ROLLOVERS = {
    "a 32-bit counter of microseconds": 2.0**32 * 1e-6,
    "a 32-bit counter of milliseconds": 2.0**32 * 1e-3,
    "a 32-bit counter of nanoseconds": 2.0**32 * 1e-9,
    "a 31-bit counter of microseconds": 2.0**31 * 1e-6,
    "a 16-bit counter of microseconds": 2.0**16 * 1e-6,
    "a 16-bit counter of milliseconds": 2.0**16 * 1e-3,
    "a clock that shows only fractions of a second": 1.0,
    "a clock that restarts every minute": 60.0,
    "a clock that restarts every hour": 3600.0,
    "a clock that restarts every day": 86400.0,
}
# Largest time step across a rollover, in median time steps. It exceeds 1, because samples may be missing at a rollover.
_GAP = 50
_TWICE = 0.01  # largest share of rows with a repeated time that are omitted as faulty; above it, the clock is coarse
# Largest time between a position and the force that is paired with it, in periods. It is below 0.5, so that no force is
# paired with two positions.
_PAIRED = 0.45
_UNPAIRED = 0.02  # share of positions without a force within this time up to which the log is accepted

# Constants of the detection of glitches of the position.
_WILD = 0.02  # largest share of positions that are omitted as glitches; a log with more is refused
_REACH = 3  # largest length of a glitch, and half-width of the running median, in samples
# Least distance of a glitch from the line through its neighbors: the sum of two terms.
_FAR = 10.0  # first term, in typical second differences (their 90 % quantile)
_STEPS = 4.0  # second term, in smallest second differences, which are encoder steps
_RETURN = 0.2  # largest distance from this line of the first position after a glitch, relative to the glitch

# Constants of the detection of wraps. A wrap is accepted if the second differences next to it, after unwrapping, are
# below one of two limits.
_SMOOTH = 8.0  # first limit, in typical second differences (their 99 % quantile)
_NEAR_WRAP = 0.05  # second limit, relative to the modulus; also the relative tolerance of jumps of equal size
_SPAN = 0.5  # least jump that counts as a wrap if the modulus is unknown, relative to the range of the positions

# Constants of the detection of times that a coarse clock has rounded to its ticks. Rounding causes time steps that
# differ from the median time step.
_FEW_ODD = 5  # least number of these time steps; missing samples may cause fewer
# Number of time steps different from the median from which on rounding is certain. The errors of the times may then
# have a range of 1.1 instead of 1.02 ticks, because timestamp jitter can add to the rounding errors.
_MANY_ODD = 20
_COARSEST = 10.0  # largest tick of a clock whose times are repaired, in sampling periods


class RepairedLog(NamedTuple):
    """The valid rows of a log after repair, one array entry per row, and notes on the repairs."""

    clock: np.ndarray | None  # times in s; None if only the sampling period is given
    row: np.ndarray  # index of each row in the original log
    position: np.ndarray  # unwrapped positions, m or rad
    force: np.ndarray  # commanded forces, N or N m
    notes: list[str]  # description of each repair, one clause
    steps: tuple[float, float]  # encoder step and rounding step of the logged positions, from `find_steps`


def repair_log(
    clock: np.ndarray | None, position: np.ndarray, force: np.ndarray, step: float, system: UnitSystem
) -> RepairedLog:
    """Repair a log: remove rollovers of the clock, omit faulty rows, and unwrap the positions.

    Args:
        clock: times in s, NaN where missing; None if only the period is given.
        position: positions in SI units, NaN where missing.
        force: forces in SI units, NaN where missing.
        step: encoder step in SI units, 0 if unknown.
        system: units of position and force.

    Raises:
        InputError: the times decrease without a rollover, too few rows have all three numbers, or the positions contain
            too many glitches or wrap at an unknown modulus.
    """
    notes: list[str] = []
    if clock is not None:
        clock = _unroll(clock, notes)
        force = _pair(clock, position, force, notes)
    given = [position, force] if clock is None else [clock, position, force]
    row = np.flatnonzero(np.all(np.isfinite(given), axis=0))
    if row.size < position.size:
        count = position.size - row.size
        notes.append(f"left out {_count(count, 'row')} with missing numbers, the first is row {_first_gap(row)}")
    if row.size < 2:
        raise InputError("time, position, force: fewer than two rows have numbers in all columns; check the columns")
    clock = None if clock is None else clock[row]
    position, force = position[row], force[row]
    if clock is not None:
        kept = _drop_repeated(clock, position, force, notes)
        clock, row, position, force = clock[kept], row[kept], position[kept], force[kept]
    modulus = find_modulus(position, step or find_resolution(position), system)
    kept = ~find_glitches(unwrap(position, modulus) if modulus else position, modulus)
    if not kept.all():
        bad = np.flatnonzero(~kept)
        if bad.size > _WILD * position.size:
            raise InputError(
                f"position: {bad.size} of {position.size} samples are isolated glitches, the first is sample "
                f"{row[bad[0]]}; check the encoder readout"
            )
        notes.append(f"left out {_count(bad.size, 'position glitch', 'es')}, the first at sample {row[bad[0]]}")
        clock = None if clock is None else clock[kept]
        row, position, force = row[kept], position[kept], force[kept]
    # Detect the encoder step before unwrapping, because the modulus need not be a multiple of the rounding step.
    steps = find_steps(position)
    if modulus:
        # Count the wraps for the note after the removal of glitches, because a glitch may hide a wrap.
        count = int(np.count_nonzero(np.round(np.diff(position) / modulus)))
        turns = modulus / (2 * np.pi) if system.rotary else 1.0
        turn = "360 deg, " if system.rotary else ""
        turn = turn if np.isclose(turns, 1.0) else f"{turns:.4g} turns: if it should be 1, check the encoder step; "
        size = with_unit(modulus, system["m"], 6)
        notes.append(f"the position wraps at {size} ({turn}{_count(count, 'time')}) and was unwrapped")
        position = unwrap(position, modulus)
    return RepairedLog(clock, row, position, force, notes, steps)


def _count(number: int, noun: str, ending: str = "s") -> str:
    """Format a number and its noun, in the singular or plural, for a note."""
    return f"{number:,} {noun}{'' if number == 1 else ending}"


def _first_gap(row: np.ndarray) -> int:
    """Return the first index 0, 1, 2, ... that is missing from a sorted array of row indices."""
    late = np.flatnonzero(row != np.arange(row.size))
    return int(late[0]) if late.size else row.size


def _unroll(clock: np.ndarray, notes: list[str]) -> np.ndarray:
    """Remove the rollovers of a clock from its times.

    Args:
        clock: times in s, NaN where missing.
        notes: list to which a note on the rollovers is appended.

    Raises:
        InputError: the times decrease, and no common clock rolls over in this way.
    """
    timed = np.flatnonzero(np.isfinite(clock))
    steps = np.diff(clock[timed])
    falls = np.flatnonzero(steps < 0)
    if not falls.size:
        return clock
    if falls.size == steps.size:
        raise InputError("time: the times decrease from row to row; reverse the order of the rows")
    usual = float(np.median(steps[steps > 0]))
    jumps = steps[falls]
    fitting = {
        name: span for name, span in _ROLLOVERS.items() if np.all((jumps + span > 0) & (jumps + span < _GAP * usual))
    }
    if not fitting:
        k = int(falls[0])
        raise InputError(
            f"time: the time decreases by {with_unit(-float(jumps[0]), 's')} after sample {timed[k]}; sort the rows, "
            "or save each record to a separate file"
        )
    # Choose the clock for which the corrected time step across the rollover is closest to the median time step.
    name, span = min(fitting.items(), key=lambda item: abs(float(np.median(jumps)) + item[1] - usual))
    unrolled = clock.copy()
    # Correct only the rows with a time, so that missing times stay NaN.
    unrolled[timed[1:]] += span * np.cumsum(steps < 0)
    notes.append(f"the time rolls over ({_count(falls.size, 'time')}) like {name} and was unwrapped")
    return unrolled


def _pair(clock: np.ndarray, position: np.ndarray, force: np.ndarray, notes: list[str]) -> np.ndarray:
    """Assign forces to the rows of the positions if the log has separate rows for positions and forces.

    Each position is paired with the force nearest in time. If most rows have both numbers, nothing is changed.

    Args:
        clock: times in s, NaN where missing.
        position: positions, NaN where missing.
        force: forces, NaN where missing.
        notes: list to which a note on the pairing is appended.

    Returns:
        The forces in the rows of the positions, NaN in all other rows.

    Raises:
        InputError: too many positions have no force within ``_PAIRED`` periods.
    """
    timed = np.isfinite(clock)
    places, forces = (np.flatnonzero(timed & np.isfinite(column)) for column in (position, force))
    both = np.intersect1d(places, forces).size
    if not places.size or not forces.size or 2 * both > min(places.size, forces.size):
        return force
    period = float(np.median(np.diff(clock[places])))
    after = np.clip(np.searchsorted(clock[forces], clock[places]), 1, forces.size - 1)
    nearer = clock[places] - clock[forces[after - 1]] < clock[forces[after]] - clock[places]
    nearest = forces[after - nearer]
    apart = clock[nearest] - clock[places]
    far = np.abs(apart) > _PAIRED * period
    if np.mean(far) > _UNPAIRED:
        raise InputError(
            f"position, force: {places.size} rows have a position and {forces.size} rows a force, at different times; "
            "log both in each row"
        )
    paired = np.full(force.size, np.nan)
    paired[places[~far]] = force[nearest[~far]]
    middle = float(np.median(apart))
    notes.append(
        f"position and force are in separate rows, {with_unit(abs(middle), 's', 3)} apart, and were paired by time; "
        "the delay starts at the time of the position"
    )
    return paired


def _drop_repeated(clock: np.ndarray, position: np.ndarray, force: np.ndarray, notes: list[str]) -> np.ndarray:
    """Return a mask of the rows to keep, without those that repeat the time of the previous row.

    If more than a share ``_TWICE`` of the rows repeat a time, the clock is probably coarse, and all rows are kept.

    Args:
        clock: times in s.
        position: positions, which are compared for the note.
        force: forces, which are compared for the note.
        notes: list to which a note on the omitted rows is appended.
    """
    again = np.append(False, np.diff(clock) == 0)
    same = again & np.append(False, (np.diff(position) == 0) & (np.diff(force) == 0))
    count = int(again.sum())
    if count and count <= max(1.0, _TWICE * clock.size):
        rows = _count(count, "repeated row") if same.sum() == count else f"{_count(count, 'row')} with a repeated time"
        notes.append(f"left out {rows}, the first is row {int(np.argmax(again))}")
        return ~again
    return np.ones(clock.size, bool)


def find_modulus(position: np.ndarray, step: float, system: UnitSystem) -> float:
    """Return the modulus at which the positions wrap, 0 if they do not wrap.

    Several candidates are tested. A candidate is accepted if the unwrapped positions are smooth at more than half of
    the wraps.

    Args:
        position: positions in SI units.
        step: encoder step in SI units, 0 if unknown.
        system: units of the positions.
    """
    for modulus in _list_moduli(position, step, system):
        # Omit glitches first, because their jumps are not wraps.
        places = position[~find_glitches(unwrap(position, modulus), modulus)]
        events = np.flatnonzero(np.round(np.diff(places) / modulus))
        if not events.size:
            continue
        bends = np.abs(np.diff(unwrap(places, modulus), 2))
        typical = float(np.quantile(bends, 0.99)) if bends.size else 0.0
        # Compute for each wrap the larger one of the two second differences that contain the step across the wrap.
        around = np.maximum(*(np.append(bends, 0.0)[np.clip(events - k, 0, bends.size)] for k in (0, 1)))
        smooth = around <= np.maximum(_SMOOTH * typical, _NEAR_WRAP * modulus)
        if smooth.mean() > 0.5:
            return modulus
    return 0.0


def unwrap(position: np.ndarray, modulus: float) -> np.ndarray:
    """Add multiples of the modulus to the positions, so that no two successive ones differ by more than half of it."""
    return position - modulus * np.append(0.0, np.cumsum(np.round(np.diff(position) / modulus)))


def _list_moduli(position: np.ndarray, step: float, system: UnitSystem) -> Iterator[float]:
    """Yield candidates for the modulus of the positions, the most plausible one first.

    The candidates are one revolution of a rotary axis; 2^n encoder steps, with the smallest n >= 8 for which the range
    of the positions is smaller; and the modulus measured from the jumps of the positions.
    """
    # Compute the range after median filtering, which removes isolated glitches.
    places = _filter_median(position, _REACH)
    span, largest = float(np.ptp(places)), float(np.abs(np.diff(position)).max(initial=0.0))
    moduli = [2.0 * np.pi] if system.rotary and span <= 2.0 * np.pi * (1.0 + 1e-9) + step else []
    if step > 0 and span > 0:
        counts = round(span / step) + 1
        moduli.append(step * 2.0 ** max(8, int(np.ceil(np.log2(counts)))))
    yield from (modulus for modulus in moduli if largest > 0.5 * modulus)
    if modulus := _measure_modulus(np.diff(position[~find_glitches(position)]), span, step, system):
        yield modulus


def _measure_modulus(moves: np.ndarray, span: float, step: float, system: UnitSystem) -> float:
    """Return the modulus of a counter with an arbitrary range, measured by the size of its jumps; 0 if sizes differ.

    Args:
        moves: differences of successive positions.
        span: range of the positions.
        step: encoder step, 0 if unknown.
        system: units of the positions.

    Raises:
        InputError: the jumps have the same size, but do not determine the modulus to a whole number of encoder steps.
    """
    inner = np.flatnonzero(np.abs(moves[1:-1]) > _SPAN * span) + 1 if span else np.zeros(0, int)
    # Use only jumps whose neighboring steps are small, because two successive jumps indicate a glitch.
    inner = inner[(np.abs(moves[inner - 1]) < _NEAR_WRAP * span) & (np.abs(moves[inner + 1]) < _NEAR_WRAP * span)]
    if inner.size < 2:
        return 0.0
    sizes = np.abs(moves[inner] - 0.5 * (moves[inner - 1] + moves[inner + 1]))
    middle = float(np.median(sizes))
    if np.ptp(sizes) > _NEAR_WRAP * middle or span > middle * (1.0 + _NEAR_WRAP):
        return 0.0
    error = float(np.std(sizes, ddof=1)) / np.sqrt(sizes.size)
    if step > 0 and error < 0.2 * step:
        return step * round(float(np.mean(sizes)) / step)
    raise InputError(
        f"position: {inner.size} jumps by {with_unit(middle, system['m'], 3)} indicate an encoder that wraps at an "
        "unknown count; unwrap it, or log counts and specify a resolution such as '4000 counts/rev'"
    )


def find_glitches(position: np.ndarray, modulus: float = 0.0) -> np.ndarray:
    """Return a mask of glitches: runs of up to 3 positions that are far from the line through their neighbors.

    Args:
        position: positions, possibly unwrapped.
        modulus: modulus by which the positions were unwrapped, 0 if they were not. After a glitch, unwrapped positions
            may be wrong by multiples of the modulus; this is tolerated.
    """
    moves = np.diff(position)
    bends = np.abs(np.diff(moves))
    moving = bends[bends > 0]
    wild = np.zeros(position.size, bool)
    if position.size < 4 * _REACH or not moving.size:
        return wild
    # Add several encoder steps to the limit, because in slow motion most second differences are single encoder steps.
    limit = _FAR * float(np.quantile(moving, 0.9)) + _STEPS * float(moving.min())
    # Estimate the usual difference of successive positions by a running median, on which glitches have no effect.
    usual = _filter_median(moves, _REACH + 1)
    for before in np.flatnonzero(np.abs(moves - usual) > limit):
        for length in range(1, min(_REACH, position.size - before - 2) + 1):
            off = position[before : before + length + 2] - position[before] - usual[before] * np.arange(length + 2)
            back = off[-1] - (modulus * np.round(off[-1] / modulus) if modulus else 0.0)
            if not wild[before] and np.all(np.abs(off[1:-1]) > max(limit, abs(back) / _RETURN)):
                wild[before + 1 : before + length + 1] = True
                break
    return wild


def _filter_median(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the running median of each value and its ``reach`` neighbors on each side, with repeated end values."""
    padded = np.pad(values, reach, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1), axis=-1)


class EvenTimes(NamedTuple):
    """Evenly spaced times, reconstructed from times that a coarse clock has rounded to its ticks."""

    place: np.ndarray  # time of each sample, in sampling periods after the first sample
    tick: float  # tick of the clock, s
    note: str  # note on the repair, one clause


def even_coarse_times(clock: np.ndarray) -> EvenTimes | None:
    """Reconstruct evenly spaced times that a coarse clock has rounded to its ticks, such as 1 ms.

    Returns:
        The times; None if the timestamps are not rounded, or if the times before rounding were not evenly spaced.

    Raises:
        InputError: the tick is the sampling period of a loop that logs only some of its samples.
    """
    steps = np.diff(clock)
    mean = float(np.median(steps))
    tick = find_resolution(clock)
    mean = max(mean, tick)
    if not tick or tick <= 0.04 * mean or np.ptp(steps) < 0.5 * tick:
        return None
    window = min(64, clock.size - 1)
    period = float(np.median((clock[window:] - clock[:-window]) / window))
    # Divide the log at gaps: time steps longer than one sampling period plus one tick, which rounding cannot cause.
    begins = np.append(0, np.flatnonzero(steps > period + 1.01 * tick) + 1)
    ends = np.append(begins[1:], clock.size)
    longest = int(np.argmax(ends - begins))
    inside = np.arange(begins[longest], ends[longest])
    if inside.size < 10:
        return None
    period, start = np.polyfit(inside - inside[0], clock[inside], 1).tolist()
    if not period > 0:
        return None
    place, late = np.zeros(clock.size), np.zeros(clock.size)
    for first, last in zip(begins, ends, strict=True):
        offset = np.arange(last - first)
        middle = float(np.mean(clock[first:last] - period * offset))
        place[first:last] = offset + (np.round((middle - start) / period) if first != begins[longest] else 0.0)
        late[first:last] = clock[first:last] - period * place[first:last]
    # Count the time steps that differ from the median step. A few of them may be caused by missing samples instead of
    # rounding.
    usual = np.median(steps)
    odd = int(np.sum(np.abs(steps - usual) > 0.5 * tick))
    allowed = 1.0 + (0.1 if odd >= _MANY_ODD else 0.02)
    if np.ptp(late) > allowed * tick or np.any(np.diff(place) < 1) or odd < _FEW_ODD or tick > _COARSEST * period:
        if odd >= _FEW_ODD and period > 1.5 * tick:
            _refuse_left_out(steps, tick)
        return None
    # Interpret a tick that is not a power of ten as the sampling period of the loop, because clocks round to powers of
    # ten.
    if not np.isclose(np.log10(tick), np.round(np.log10(tick)), rtol=0, atol=1e-3) and period > 1.5 * tick:
        _refuse_left_out(steps, tick)
    ticks, apart = with_unit(tick, "s", 3), with_unit(period, "s")
    note = f"the times are rounded to {ticks} and were replaced by even times, {apart} apart"
    return EvenTimes(place - place[0], tick, note)


def _refuse_left_out(steps: np.ndarray, tick: float) -> None:
    """Raise `InputError` if each time step is a whole number of 1 to 20 ticks, which indicates omitted samples.

    Args:
        steps: time steps in s.
        tick: tick in s, assumed to be the sampling period of the loop.
    """
    counts = np.round(steps / tick)
    if counts.min() >= 1 and counts.max() <= 20 and np.allclose(steps / tick, counts, atol=0.02):
        low, high = (plain(float(end), 1) for end in (counts.min(), counts.max()))
        raise InputError(
            f"time: samples are {low} to {high} periods of {with_unit(tick, 's')} apart, so the log omits samples of "
            "the loop; log every sample, or every second one"
        )


def refuse_repeated(clock: np.ndarray) -> NoReturn:
    """Raise `InputError` with a message about repeated times that states their likely cause and the remedy."""
    steps = np.diff(clock)
    k = int(np.argmin(steps))
    if np.mean(steps == 0) > 0.5:
        raise InputError(
            "time: most samples repeat the previous time, so the column has too few digits; also give the column with "
            "the rest of the time, as 1:s+2:ns, or the rate instead"
        )
    raise InputError(
        f"time: sample {k + 1} repeats the time of sample {k}; log each sample once, or give the rate instead"
    )
