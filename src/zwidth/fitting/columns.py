"""Logs in CSV files: columns in any order, under any names, in any units, read into SI units.

A file has a line of column names and a line a sample, as `sweep.files.cells` reads it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.fitting.device_fit import DeviceFit
from zwidth.fitting.log import fit_log
from zwidth.words.errors import InputError, UnusableValueError
from zwidth.words.formatting import describe, read_rows, split_title, suggestion, with_unit
from zwidth.words.quantities import POSITIVE
from zwidth.words.units import ANGLE, FORCE, LENGTH, TIME, TORQUE, Dimension, looks_like_number, read_quantity

QUANTITIES = ("time", "position", "force")
COUNTS = ("counts", "count", "cnt", "cts", "ticks", "inc", "increments")
"""Units of a position that its encoder's resolution translates."""

# What each may be in, a linear axis first, and the names that say so by themselves.
_DIMENSIONS: dict[str, tuple[Dimension, ...]] = {"time": (TIME,), "position": (LENGTH, ANGLE), "force": (FORCE, TORQUE)}
_NAMES = {
    "time": ("time", "t", "clock"),
    "position": ("position", "pos", "x", "encoder", "angle", "phi", "theta", "q"),
    "force": ("force", "f", "torque", "tau"),
}
_MOST_BYTES = 2**28
# Periods that differ by more are two.
_OTHER = 0.1


@dataclass(frozen=True, eq=False)
class LoggedMotion:
    """Columns of one log in SI units.

    Attributes:
        time: in s; None where none was read.
        position: in m, or in rad of a rotary axis.
        force: in N, or in N m of a rotary axis.
        resolution: step of the encoder in m or rad; None where it is not known.
        rotary: whether the axis turns.
    """

    time: np.ndarray | None
    position: np.ndarray
    force: np.ndarray
    resolution: float | None
    rotary: bool

    def __eq__(self, other: object) -> bool:
        """Whether all numbers are the same."""
        return isinstance(other, LoggedMotion) and all(
            np.array_equal(getattr(self, part.name), getattr(other, part.name)) for part in fields(self)
        )


def read_log(
    file: str | Path, columns: Mapping[str, str | None], *, resolution: Any = None, period: float | None = None
) -> LoggedMotion:
    """Read the time, the position and the force of a log.

    Args:
        file: of UTF-8 text.
        columns: the column of ``time``, ``position`` and ``force`` by its header, or its header without the unit in
            brackets; ``COLUMN:unit`` where the header has none, or a wrong one. Of what is left out the column is
            found by its name.
        resolution: of the encoder, a length or an angle with its unit, for one count; a number is in m, or in rad with
            a torque.
        period: of the samples, in s, where the time is not to be read.

    Raises:
        InputError: a column is missing, or may be several; a unit is unknown; a cell holds no number; a length is
            paired with a torque; a column of times with their unit contradicts the period.
    """
    lines = _read_lines(Path(file))
    heads = lines[0][1]
    wanted = [name for name in QUANTITIES if name != "time" or period is None]
    places = {name: _find_column(file, heads, name, columns.get(name)) for name in wanted}
    units = {name: _read_unit(name, unit) for name, (_, unit) in places.items()}
    taken = [at for at, _ in places.values()]
    if len(set(taken)) < len(taken):
        words = ", ".join(f"{name} {heads[at]!r}" for name, (at, _) in places.items())
        raise InputError(f"{file}: one column is taken twice: {words}; name another")
    numbers = _read_numbers(file, lines, {name: at for name, (at, _) in places.items()})
    rotary, step = _pair_units(units, resolution)
    if units["position"] in COUNTS:
        if step is None:
            raise InputError(
                "position: it is in counts; give the resolution, as 0.03 mm or 0.09 deg for a count of the encoder"
            )
        numbers["position"] = numbers["position"] * step
    for name in wanted:
        if units[name] not in COUNTS:
            numbers[name] = numbers[name] * _factor(name, units[name])
    if period is not None:
        _compare_period(file, lines, period)
    return LoggedMotion(numbers.get("time"), numbers["position"], numbers["force"], step, rotary)


def _compare_period(file: str | Path, lines: list[tuple[int, list[str]]], period: float) -> None:
    """Raise `InputError` where a column of times, in a unit that it says, is of another period than the one given."""
    heads = [split_title(head) for head in lines[0][1]]
    found = [(at, unit) for at, (name, unit) in enumerate(heads) if name.lower() in _NAMES["time"] and unit]
    if len(found) != 1:
        return
    try:
        factor = _factor("time", _read_unit("time", found[0][1]))
        time = factor * _read_numbers(file, lines, {"time": found[0][0]})["time"]
    except InputError:
        # The period may be given for the times' sake.
        return
    step = float(time[-1] - time[0]) / max(1, time.size - 1)
    if not abs(step - period) <= _OTHER * period:
        raise InputError(
            f"period: got {with_unit(period, 's')}, but the times in {file} are {with_unit(step, 's')} apart; leave "
            "the period out, or correct one of them"
        )


def _read_lines(file: Path) -> list[tuple[int, list[str]]]:
    """The row of names and those of samples."""
    rows, separator = read_rows(file, _MOST_BYTES)
    if not rows:
        raise InputError(f"{file}: it is empty; a line of column names and a line a sample are needed")
    line, heads = rows[0]
    if len(heads) == 1:
        raise InputError(f"{file}:{line}: got {heads[0][:60]!r}; separate the columns by commas, semicolons or tabs")
    if all(looks_like_number(name.replace(",", ".")) for name in heads if name):
        raise InputError(
            f"{file}:{line}: got numbers where the names of the columns are expected; add a line such as "
            f"{separator.join(('time [s]', 'position [m]', 'force [N]'))!r}, without # before it"
        )
    if len(rows) < 2:
        raise InputError(f"{file}: it has names of columns and no samples; record some")
    for number, cells in rows[1:]:
        if any(cells[len(heads) :]):
            hint = "; a comma as decimal sign needs semicolons between the columns" if separator == "," else ""
            raise InputError(f"{file}:{number}: got {len(cells)} cells for {len(heads)} columns{hint}")
    return rows


def _find_column(file: str | Path, heads: Sequence[str], name: str, wanted: str | None) -> tuple[int, str]:
    """The column's index and its unit, "" where nothing says it."""
    if wanted is None:
        found = [k for k, head in enumerate(heads) if split_title(head)[0].lower() in _NAMES[name]]
        if len(found) == 1:
            return found[0], split_title(heads[found[0]])[1]
        what = f"may be any of {_listing(heads[k] for k in found)}" if found else f"is none of {_listing(heads)}"
        raise InputError(f"{name}: by its name it {what} in {file}; say which column it is")
    title, unit = wanted.strip(), None
    found = _matches(heads, title)
    if not found:
        title, _, unit = (part.strip() for part in wanted.rpartition(":"))
        found = _matches(heads, title)
    if len(found) != 1:
        title = title or wanted.strip()
        if found:
            raise InputError(f"{name}: {file} has {len(found)} columns {title!r}; give each a name of its own")
        known = [*heads, *(split_title(head)[0] for head in heads)]
        hint = suggestion(title, known, f"it has {_listing(heads)}")
        raise InputError(f"{name}: {file} has no column {title!r}; {hint}")
    return found[0], split_title(heads[found[0]])[1] if unit is None else unit


def _matches(heads: Sequence[str], title: str) -> list[int]:
    """Columns of this header; else those of this name before the brackets."""
    whole = [k for k, head in enumerate(heads) if head == title]
    return whole or [k for k, head in enumerate(heads) if title and split_title(head)[0] == title]


def _listing(heads: Any) -> str:
    names = [repr(head) for head in heads if head]
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def _read_unit(name: str, unit: str) -> str:
    """A unit that exists, or "" for the SI unit."""
    if not unit:
        return ""
    if name == "position" and unit.lower() in COUNTS:
        return COUNTS[0]
    if all(dimension.in_base("1", 0, unit) is None for dimension in _DIMENSIONS[name]):
        known = [each for dimension in _DIMENSIONS[name] for each in dimension.units]
        known += [COUNTS[0]] if name == "position" else []
        raise InputError(
            f"{name}: got the unit {unit!r}; allowed are {', '.join(known)}; "
            + suggestion(unit, known, "write COLUMN:unit with one of them")
        )
    return unit


def _factor(name: str, unit: str) -> float:
    """What one of the unit is in SI units."""
    return next((size for each in _DIMENSIONS[name] if (size := each.in_base("1", 0, unit)) is not None), 1.0)


def _pair_units(units: Mapping[str, str], resolution: Any) -> tuple[bool, float | None]:
    """Whether the axis is rotary, and the encoder's step in its unit."""
    turns = units["force"] != "" and TORQUE.in_base("1", 0, units["force"]) is not None
    step = None
    if resolution is not None:
        step, angular = read_step(resolution)
        if angular is not None and angular != turns:
            raise InputError(
                f"resolution: got {describe(resolution)} with {_force_words(units['force'])}; "
                + ("an angle belongs to a torque, as in N m" if angular else "a length belongs to a force, as in N")
            )
    if units["position"] not in COUNTS:
        angular = units["position"] != "" and ANGLE.in_base("1", 0, units["position"]) is not None
        if angular != turns:
            place = f"a position in {units['position'] or 'm (no unit is given)'}"
            raise InputError(
                f"position, force: got {place} with {_force_words(units['force'])}; a length goes with a force, an "
                "angle with a torque: say the units, as COLUMN:deg and COLUMN:mN m"
            )
    return turns, step


def _force_words(unit: str) -> str:
    torque = unit != "" and TORQUE.in_base("1", 0, unit) is not None
    return f"a {'torque' if torque else 'force'} in {unit or 'N (no unit is given)'}"


def read_step(resolution: Any) -> tuple[float, bool | None]:
    """The step in SI units, and whether it is an angle; None of a number alone."""
    number = not isinstance(resolution, str) or looks_like_number(resolution)
    value = float(resolution) if isinstance(resolution, str) and number else resolution
    try:
        return read_quantity(value, LENGTH, POSITIVE)[0], None if number else False
    except UnusableValueError as error:
        try:
            return read_quantity(value, ANGLE, POSITIVE)[0], True
        except UnusableValueError:
            what, allowed = error.parts[:2]
            raise InputError(
                f"resolution: {what}; {allowed}, or with one of {', '.join(ANGLE.units)}: as 0.03 mm or 0.09 deg"
            ) from None


def _read_numbers(
    file: str | Path, lines: list[tuple[int, list[str]]], places: Mapping[str, int]
) -> dict[str, np.ndarray]:
    """The columns as they stand."""
    heads, samples = lines[0][1], lines[1:]
    read = {}
    for name, at in places.items():
        try:
            # Python would read 1_000 as well.
            cells = [row[at] for _, row in samples]
            values = np.array([float(cell) if "_" not in cell else np.nan for cell in cells])
        except (ValueError, IndexError):
            values = np.full(len(samples), np.nan)
        if not np.all(np.isfinite(values)):
            for number, row in samples:
                got = row[at] if at < len(row) else ""
                if not (looks_like_number(got) and np.isfinite(float(got))):
                    raise InputError(
                        f"{file}:{number}: got {repr(got) if got else 'nothing'} under {heads[at]!r}; "
                        "a number is needed"
                    )
        read[name] = values
    return read


def fit_motions(motions: Sequence[LoggedMotion], *, period: float | None = None, **options: Any) -> DeviceFit:
    """`zwidth.fit_log` of logs that are read, all of one axis.

    Raises:
        InputError: the logs are of different axes or encoders, or as `zwidth.fit_log` says.
    """
    if len({motion.rotary for motion in motions}) > 1:
        raise InputError("logs: some are of an angle, others of a length; fit them apart")
    steps = {motion.resolution for motion in motions}
    if len(steps) > 1:
        raise InputError("resolution: the logs have several; give all of them the same, or fit them apart")
    times = [motion.time for motion in motions]
    when = period if times[0] is None else times
    positions, forces = [motion.position for motion in motions], [motion.force for motion in motions]
    return fit_log(when, positions, forces, resolution=steps.pop(), rotary=motions[0].rotary, **options)  # pyright: ignore[reportArgumentType]
