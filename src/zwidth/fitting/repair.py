"""Repair of logs as control loops write them: rows without numbers, clocks, wrapped positions, isolated glitches.

Every repair is counted in a note. Nothing is guessed: a doubtful row is left out, and the rows before and after it are
fitted as two logs.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, NoReturn

import numpy as np

from zwidth.fitting.encoder import find_resolution
from zwidth.words.errors import InputError
from zwidth.words.formatting import plain, with_unit
from zwidth.words.rotation import is_rotary

# Clocks roll over after these times in s, by what counts them.
_ROLLOVERS = {
    "a 32-bit counter of microseconds": 2.0**32 * 1e-6,
    "a 32-bit counter of milliseconds": 2.0**32 * 1e-3,
    "a 32-bit counter of nanoseconds": 2.0**32 * 1e-9,
    "a 31-bit counter of microseconds": 2.0**31 * 1e-6,
    "a 16-bit counter of microseconds": 2.0**16 * 1e-6,
    "a 16-bit counter of milliseconds": 2.0**16 * 1e-3,
    "a clock of the second, without its seconds": 1.0,
    "a clock of the minute": 60.0,
    "a clock of the hour": 3600.0,
    "a clock of the day": 86400.0,
}
_GAP = 50  # steps that a log may lack where its clock rolls over
_TWICE = 0.01  # share of rows that may repeat a time
_PAIRED = 0.45  # periods between the times of a position and of a force that belong together
_WILD = 0.02  # share of positions that may be isolated glitches
_REACH = 3  # samples that a glitch lasts at most
# A glitch exceeds this many typical second differences and encoder steps, and returns to within this share of it.
_FAR, _STEPS, _RETURN = 10.0, 4.0, 0.2
_SMOOTH = 8.0  # second differences at a wrap, in typical ones
_NEAR_WRAP = 0.05  # and as a share of the modulus
# Odd steps of times cut to ticks, at least, and from how many on they may jitter; the coarsest tick in periods.
_FEW_ODD, _MANY_ODD, _COARSEST = 5, 20, 10.0
_SPAN = 0.5  # of the modulus, the least span of positions that wrap at an unknown one


class RepairedLog(NamedTuple):
    """Rows of a log that count: their times in s or None, their numbers in the log, positions, forces, and notes."""

    clock: np.ndarray | None
    row: np.ndarray
    position: np.ndarray
    force: np.ndarray
    notes: list[str]


def repair_log(clock: np.ndarray | None, position: np.ndarray, force: np.ndarray, step: float) -> RepairedLog:
    """Return the rows of a log that count, with times that grow and positions that are continuous.

    Args:
        clock: times in s, NaN where missing; None if only the period is known.
        position, force: in SI units, NaN where missing.
        step: of the encoder, 0 if unknown.
    """
    notes: list[str] = []
    if clock is not None:
        clock = _unroll(clock, notes)
        force = _pair(clock, position, force, notes)
    given = [position, force] if clock is None else [clock, position, force]
    row = np.flatnonzero(np.all(np.isfinite(given), axis=0))
    if row.size < position.size:
        count = position.size - row.size
        notes.append(f"left out {_count(count, 'row')} without a number, the first in row {_first_gap(row)}")
    if row.size < 2:
        raise InputError("time, position, force: fewer than two rows have a number in each; check the columns")
    clock = None if clock is None else clock[row]
    position, force = position[row], force[row]
    if clock is not None:
        kept = _drop_repeated(clock, position, force, notes)
        clock, row, position, force = clock[kept], row[kept], position[kept], force[kept]
    modulus = find_modulus(position, step or find_resolution(position))
    kept = ~find_glitches(unwrap(position, modulus) if modulus else position, modulus)
    if not kept.all():
        bad = np.flatnonzero(~kept)
        if bad.size > _WILD * position.size:
            raise InputError(
                f"position: {bad.size} of {position.size} samples are isolated glitches, the first is sample "
                f"{row[bad[0]]}; check how the encoder is read"
            )
        notes.append(f"left out {_count(bad.size, 'glitch', 'es')} of the position, the first at sample {row[bad[0]]}")
        clock = None if clock is None else clock[kept]
        row, position, force = row[kept], position[kept], force[kept]
    if modulus:
        # Without glitches, whose sides may lie a modulus apart.
        count = int(np.count_nonzero(np.round(np.diff(position) / modulus)))
        size = f"{with_unit(modulus, 'm', 6)}{' (360 deg)' if is_rotary() and np.isclose(modulus, 2 * np.pi) else ''}"
        notes.append(f"the position wraps at {size}, {_count(count, 'time')}, and was continued")
        position = unwrap(position, modulus)
    return RepairedLog(clock, row, position, force, notes)


def _count(number: int, noun: str, ending: str = "s") -> str:
    return f"{number:,} {noun}{'' if number == 1 else ending}"


def _first_gap(row: np.ndarray) -> int:
    """Return the first row that is missing, counted from 0."""
    late = np.flatnonzero(row != np.arange(row.size))
    return int(late[0]) if late.size else row.size


def _unroll(clock: np.ndarray, notes: list[str]) -> np.ndarray:
    """Return times that go on where the clock rolled over; raise `InputError` for times that fall otherwise."""
    known = np.flatnonzero(np.isfinite(clock))
    steps = np.diff(clock[known])
    falls = np.flatnonzero(steps < 0)
    if not falls.size:
        return clock
    if falls.size == steps.size:
        raise InputError("time: it falls in every row; the rows are in reverse order: reverse the file")
    usual = float(np.median(steps[steps > 0]))
    jumps = steps[falls]
    fitting = {
        name: span for name, span in _ROLLOVERS.items() if np.all((jumps + span > 0) & (jumps + span < _GAP * usual))
    }
    if not fitting:
        k = int(falls[0])
        raise InputError(
            f"time: it falls back by {with_unit(-float(jumps[0]), 's')} after sample {known[k]}, as of two records in "
            "one file or of rows out of order; give each record as a file of its own"
        )
    # The one that leaves the most usual step.
    name, span = min(fitting.items(), key=lambda item: abs(float(np.median(jumps)) + item[1] - usual))
    unrolled = clock.copy()
    unrolled[known[1:]] += span * np.cumsum(steps < 0)
    # Rows without a time stay without.
    notes.append(f"the time rolls over {_count(falls.size, 'time')}, as {name} does, and was continued")
    return unrolled


def _pair(clock: np.ndarray, position: np.ndarray, force: np.ndarray, notes: list[str]) -> np.ndarray:
    """Return the force of each row of the position, of a table in which each has rows of its own."""
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
    if np.mean(far) > _WILD:
        raise InputError(
            f"position, force: {places.size} rows have the one and {forces.size} the other, at other times; log both "
            "in one row at every sample"
        )
    paired = np.full(force.size, np.nan)
    paired[places[~far]] = force[nearest[~far]]
    middle = float(np.median(apart))
    notes.append(
        f"position and force have rows of their own, {with_unit(abs(middle), 's', 3)} apart, and were paired by time; "
        "the delay counts from the position"
    )
    return paired


def _drop_repeated(clock: np.ndarray, position: np.ndarray, force: np.ndarray, notes: list[str]) -> np.ndarray:
    """Return the rows to keep: one for each time, unless the clock is coarser than the samples."""
    again = np.append(False, np.diff(clock) == 0)
    same = again & np.append(False, (np.diff(position) == 0) & (np.diff(force) == 0))
    count = int(again.sum())
    if count and count <= max(1.0, _TWICE * clock.size):
        twice = "that repeats the one before" if same.sum() == count else "that repeats the time of the one before"
        notes.append(f"left out {_count(count, 'row')} {twice}, the first in row {int(np.argmax(again))}")
        return ~again
    return np.ones(clock.size, bool)


def find_modulus(position: np.ndarray, step: float) -> float:
    """Return the modulus at which the encoder, or its counter, wraps; 0 if it does not."""
    for modulus in _list_moduli(position, step):
        # Jumps of glitches are no wraps.
        places = position[~find_glitches(unwrap(position, modulus), modulus)]
        events = np.flatnonzero(np.round(np.diff(places) / modulus))
        if not events.size:
            continue
        bends = np.abs(np.diff(unwrap(places, modulus), 2))
        typical = float(np.quantile(bends, 0.99)) if bends.size else 0.0
        # The bends before and after each wrap.
        around = np.maximum(*(np.append(bends, 0.0)[np.clip(events - k, 0, bends.size)] for k in (0, 1)))
        smooth = around <= np.maximum(_SMOOTH * typical, _NEAR_WRAP * modulus)
        if smooth.mean() > 0.5:
            return modulus
    return 0.0


def unwrap(position: np.ndarray, modulus: float) -> np.ndarray:
    """Return positions that go on where they wrap."""
    return position - modulus * np.append(0.0, np.cumsum(np.round(np.diff(position) / modulus)))


def _list_moduli(position: np.ndarray, step: float) -> Iterator[float]:
    """Yield the moduli at which positions of this span may wrap: a turn, powers of two of the step, then the jumps'."""
    # Isolated glitches do not count.
    places = _filter_median(position, _REACH)
    span, largest = float(np.ptp(places)), float(np.abs(np.diff(position)).max(initial=0.0))
    moduli = [2.0 * np.pi] if is_rotary() and span <= 2.0 * np.pi * (1.0 + 1e-9) + step else []
    if step > 0 and span > 0:
        counts = round(span / step) + 1
        moduli.append(step * 2.0 ** max(8, int(np.ceil(np.log2(counts)))))
    yield from (modulus for modulus in moduli if largest > 0.5 * modulus)
    if modulus := _measure_modulus(np.diff(position[~find_glitches(position)]), span, step):
        yield modulus


def _measure_modulus(moves: np.ndarray, span: float, step: float) -> float:
    """Return the modulus of a counter that ends at any number, by its jumps; 0 without jumps of one size.

    Raises:
        InputError: jumps of one size in both directions, whose size is not known to a step of the encoder.
    """
    inner = np.flatnonzero(np.abs(moves[1:-1]) > _SPAN * span) + 1 if span else np.zeros(0, int)
    # A jump after a jump is a glitch.
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
        f"position: it jumps by {with_unit(middle, 'm', 3)} {inner.size} times, as an encoder that wraps at an unknown "
        "count; give its counts and a resolution such as '4000 counts/rev', or unwrap it"
    )


def find_glitches(position: np.ndarray, modulus: float = 0.0) -> np.ndarray:
    """Return a mask of isolated positions, up to 3 in a row, that leave the motion and return to it at once.

    Positions that were unwrapped return up to whole moduli.
    """
    bends = np.abs(np.diff(position, 2))
    moving = bends[bends > 0]
    wild = np.zeros(position.size, bool)
    if position.size < 4 * _REACH or not moving.size:
        return wild
    off = np.abs(position - _filter_median(position, _REACH))
    # The encoder's step bounds bends of a slow motion; a glitch moves the median of a fast one by some samples.
    speed = _filter_median(np.abs(np.diff(position, prepend=position[0])), _REACH)
    far = off > _FAR * float(np.quantile(moving, 0.9)) + _STEPS * float(moving.min()) + 3.0 * speed
    for first in np.flatnonzero(far & ~np.append(False, far[:-1])):
        after = first + 1
        while after < position.size and far[after]:
            after += 1
        if first > 0 and after < position.size and after - first <= _REACH:
            jump, back = (
                np.abs(position[first:after] - position[first - 1]).min(),
                position[after] - position[first - 1],
            )
            back -= modulus * np.round(back / modulus) if modulus else 0.0
            if abs(back) < _RETURN * jump:
                wild[first:after] = True
    return wild


def _filter_median(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the running median over ``reach`` samples to both sides."""
    padded = np.pad(values, reach, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1), axis=-1)


class EvenTimes(NamedTuple):
    """Samples in whole periods by a clock coarser than they are: their places, the clock's tick in s, and a note."""

    place: np.ndarray
    tick: float
    note: str


def even_coarse_times(clock: np.ndarray) -> EvenTimes | None:
    """Return the places of even samples whose times were cut to ticks, as to milliseconds; None for another clock.

    Raises:
        InputError: the times are whole ticks of a loop that logs only some of its samples.
    """
    steps = np.diff(clock)
    mean = float(np.median(steps))
    tick = find_resolution(clock)
    mean = max(mean, tick)
    if not tick or tick <= 0.04 * mean or np.ptp(steps) < 0.5 * tick:
        return None
    window = min(64, clock.size - 1)
    period = float(np.median((clock[window:] - clock[:-window]) / window))
    # Between gaps no step is longer than a period and a tick.
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
        own = np.arange(last - first)
        middle = float(np.mean(clock[first:last] - period * own))
        place[first:last] = own + (np.round((middle - start) / period) if first != begins[longest] else 0.0)
        late[first:last] = clock[first:last] - period * place[first:last]
    # A few long steps may be missing samples; many in a regular row are those of cut times.
    usual = np.median(steps)
    odd = int(np.sum(np.abs(steps - usual) > 0.5 * tick))
    allowed = 1.0 + (0.1 if odd >= _MANY_ODD else 0.02)
    if np.ptp(late) > allowed * tick or np.any(np.diff(place) < 1) or odd < _FEW_ODD or tick > _COARSEST * period:
        if odd >= _FEW_ODD and period > 1.5 * tick:
            _refuse_left_out(steps, tick)
        return None
    if not np.isclose(np.log10(tick), np.round(np.log10(tick)), rtol=0, atol=1e-3) and period > 1.5 * tick:
        _refuse_left_out(steps, tick)
    ticks, apart = with_unit(tick, "s", 3), with_unit(period, "s")
    note = f"times are whole multiples of {ticks} and were read as even samples, {apart} apart"
    return EvenTimes(place - place[0], tick, note)


def _refuse_left_out(steps: np.ndarray, tick: float) -> None:
    """Raise `InputError` for times of a loop that logs some of its samples only."""
    counts = np.round(steps / tick)
    if counts.min() >= 1 and counts.max() <= 20 and np.allclose(steps / tick, counts, atol=0.02):
        low, high = (plain(float(end), 1) for end in (counts.min(), counts.max()))
        raise InputError(
            f"time: samples are {low} to {high} periods of {with_unit(tick, 's')} apart: the log leaves out samples of "
            "the loop; log every sample, or every second one"
        )


def refuse_repeated(clock: np.ndarray) -> NoReturn:
    """Raise `InputError` for a clock that stands still over samples, with its cause."""
    steps = np.diff(clock)
    k = int(np.argmin(steps))
    if np.mean(steps == 0) > 0.5:
        raise InputError(
            "time: most samples have the time of the one before: it has too few digits; give its second column too, as "
            "1:s+2:ns, or the rate in its place"
        )
    raise InputError(
        f"time: sample {k + 1} has the time of sample {k}; log each sample once, or give the rate in its place"
    )
