"""Logs in files: columns in any order, under any names, in any units, read into SI units (`words.tables` finds them).

A velocity is summed up to a position, and a current is a force by the constant of its motor.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.fitting.device_fit import DeviceFit
from zwidth.fitting.log import fit_log
from zwidth.words.errors import InputError, UnusableValueError
from zwidth.words.formatting import describe, suggestion, with_unit
from zwidth.words.quantities import POSITIVE
from zwidth.words.tables import NamedColumns, read_columns
from zwidth.words.units import (
    ANGLE,
    COUNTS,
    FORCE,
    LENGTH,
    TIME,
    TORQUE,
    Dimension,
    looks_like_number,
    read_quantity,
    split_head,
)

QUANTITIES = ("time", "position", "force")
# What each may be in, a linear axis first, and the names that say so by themselves.
_DIMENSIONS: dict[str, tuple[Dimension, ...]] = {"time": (TIME,), "position": (LENGTH, ANGLE), "force": (FORCE, TORQUE)}
_NAMES = {
    "time": ("time", "t", "clock"),
    "position": ("position", "pos", "x", "encoder", "angle", "phi", "theta", "q"),
    "force": ("force", "f", "torque", "tau"),
}
# What is read in place of a position or a force that no name says, and the unit without one.
_INSTEAD = {
    "position": (("velocity", "vel", "speed"), "m/s"),
    "force": (("current", "iq", "i_q"), "A"),
}
_AMPERES = {"A": 1.0, "mA": 1e-3}
_PER_AMPERE = re.compile(r"(.*?)\s*/\s*A\s*")
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
    file: str | Path,
    columns: Mapping[str, str | None],
    *,
    resolution: Any = None,
    period: float | None = None,
    motor_constant: str | None = None,
) -> LoggedMotion:
    """Read the time, the position and the force of a log.

    Args:
        file: columns between commas, semicolons, tabs or blanks, in UTF-8, UTF-16 or Latin-1, packed by gzip or not,
            with a preamble and a line of units or not; of NumPy, .npz or .npy; of MATLAB, .mat up to version 7.
        columns: the column of ``time``, ``position`` and ``force`` by its header, or its header without the unit, or
            its number where a file has no names; ``COLUMN:unit`` where the header has none, or a wrong one. Of what is
            left out the column is found by its name. Times may be those of a calendar, ISO 8601. A position in m/s,
            rad/s or counts/s is summed up: of a velocity that is the difference of two positions, and not filtered.
        resolution: of the encoder, a length or an angle with its unit, for one count; a number is in m, or in rad with
            a torque.
        period: of the samples, in s, where the time is not to be read.
        motor_constant: what a force in A or mA is multiplied with, as "5 N/A" or "0.03 N m/A".

    Raises:
        InputError: a column is missing, or may be several; a unit is unknown; a cell holds no number; a length is
            paired with a torque; a column of times with their unit contradicts the period.
    """
    table = read_columns(Path(file))
    heads = table.heads
    wanted = [name for name in QUANTITIES if name != "time" or period is None]
    if table.nameless and not all((columns.get(name) or "").partition(":")[0] in heads for name in wanted):
        raise InputError(
            f"{table.nameless}; add a line such as 'time [s],position [m],force [N]', or say which column is which by "
            "its number, as 1:ms, 2:mm and 3:N for time, position and force"
        )
    places = {name: _find_column(file, heads, name, columns.get(name)) for name in wanted}
    taken = [at for at, _ in places.values()]
    if len(set(taken)) < len(taken):
        words = ", ".join(f"{name} {heads[at]!r}" for name, (at, _) in places.items())
        raise InputError(f"{file}: one column is taken twice: {words}; name another")
    given = {name: unit for name, (_, unit) in places.items()}
    moves = _without_rate(given["position"])
    units = {**given, "position": moves or given["position"]}
    constant = 1.0
    if given["force"] in _AMPERES:
        constant, units["force"] = _read_constant(motor_constant, given["force"])
    read = {name: _read_unit(name, unit) for name, unit in units.items()}
    factors = {name: size for name, (size, _) in read.items()}
    dimensions = {name: dimension for name, (_, dimension) in read.items()}
    rotary, step = dimensions["force"] is TORQUE, _check_pairs(units, dimensions, resolution)
    if dimensions["position"] is None:
        if step is None:
            raise InputError(
                "position: it is in counts; give the resolution, as 0.03 mm or 0.09 deg for a count of the encoder"
            )
        factors["position"] = step
    factors["force"] *= constant
    columns_read = dict(zip(wanted, table.numbers(taken), strict=True))
    numbers = {name: column * factors[name] for name, column in columns_read.items()}
    if period is not None:
        _compare_period(file, table, period)
    if moves is not None:
        time = numbers.get("time", np.zeros(1))
        apart = float(time[-1] - time[0]) / max(1, time.size - 1) if period is None else period
        numbers["position"] = np.cumsum(numbers["position"]) * apart * (1 / 60 if given["position"] == "rpm" else 1.0)
    return LoggedMotion(numbers.get("time"), numbers["position"], numbers["force"], step, rotary)


def _without_rate(unit: str) -> str | None:
    """The length, angle or counts that a velocity sums up to; None of no velocity."""
    if unit == "rpm":
        return "turns"
    base, per, second = unit.rpartition("/")
    return base if per and second == "s" else None


def _read_constant(constant: str | None, unit: str) -> tuple[float, str]:
    """N or N m that one of a unit of current makes, and which of them."""
    match = _PER_AMPERE.fullmatch(constant or "")
    for dimension in (FORCE, TORQUE):
        try:
            if match:
                return read_quantity(match[1], dimension, POSITIVE)[0] * _AMPERES[unit], dimension.base
        except UnusableValueError:
            continue
    got = "nothing" if constant is None else describe(constant)
    raise InputError(
        f"motor_constant: got {got} for a force in {unit}; write what an ampere makes, as 5 N/A or 0.03 N m/A"
    )


def _compare_period(file: str | Path, table: NamedColumns, period: float) -> None:
    """Raise `InputError` where a column of times, in a unit that it says, is of another period than the one given."""
    heads = [split_head(head) for head in table.heads]
    found = [(at, unit) for at, (name, unit) in enumerate(heads) if name.lower() in _NAMES["time"] and unit]
    if len(found) != 1:
        return
    try:
        time = _read_unit("time", found[0][1])[0] * table.numbers([found[0][0]])[0]
    except InputError:
        # The period may be given for the times' sake.
        return
    step = float(time[-1] - time[0]) / max(1, time.size - 1)
    if not abs(step - period) <= _OTHER * period:
        raise InputError(
            f"period: got {with_unit(period, 's')}, but the times in {file} are {with_unit(step, 's')} apart; leave "
            "the period out, or correct one of them"
        )


def _find_column(file: str | Path, heads: Sequence[str], name: str, wanted: str | None) -> tuple[int, str]:
    """The column's index and its unit, "" where nothing says it."""
    if wanted is None:
        titles = [split_head(head) for head in heads]
        others, usual = _INSTEAD.get(name, ((), ""))
        found = [k for k, (title, _) in enumerate(titles) if title.lower() in _NAMES[name]]
        instead = [k for k, (title, _) in enumerate(titles) if title.lower() in others]
        if len(found) == 1:
            return found[0], titles[found[0]][1]
        if not found and len(instead) == 1:
            return instead[0], titles[instead[0]][1] or usual
        what = f"may be any of {_listing(heads[k] for k in found)}" if found else f"is none of {_listing(heads)}"
        measured = "frequency" in {title.lower() for title, _ in titles}
        remedy = f"a table of a response is a device: zwidth ridge --device {file}" if measured else ""
        raise InputError(f"{name}: by its name it {what} in {file}; {remedy or 'say which column it is'}")
    title, unit = wanted.strip(), None
    found = _matches(heads, title)
    if not found:
        title, _, unit = (part.strip() for part in wanted.rpartition(":"))
        found = _matches(heads, title)
    if len(found) != 1:
        title = title or wanted.strip()
        if found:
            raise InputError(f"{name}: {file} has {len(found)} columns {title!r}; give each a name of its own")
        known = [*heads, *(split_head(head)[0] for head in heads)]
        hint = suggestion(title, known, f"it has {_listing(heads)}")
        raise InputError(f"{name}: {file} has no column {title!r}; {hint}")
    return found[0], split_head(heads[found[0]])[1] if unit is None else unit


def _matches(heads: Sequence[str], title: str) -> list[int]:
    """Columns of this header; else those of this name before the brackets."""
    whole = [k for k, head in enumerate(heads) if head == title]
    return whole or [k for k, head in enumerate(heads) if title and split_head(head)[0] == title]


def _listing(heads: Any) -> str:
    names = [repr(head) for head in heads if head]
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def _read_unit(name: str, unit: str) -> tuple[float, Dimension | None]:
    """What one of a unit is in SI units, the base unit of a linear axis without one; its dimension, None of counts."""
    if name == "position" and unit.lower() in COUNTS:
        return 1.0, None
    for dimension in _DIMENSIONS[name]:
        size = dimension.in_base("1", 0, unit) if unit else 1.0
        if size is not None:
            return size, dimension
    known = [each for dimension in _DIMENSIONS[name] for each in dimension.units]
    known += [COUNTS[0]] if name == "position" else []
    raise InputError(
        f"{name}: got the unit {unit!r}; allowed are {', '.join(known)}; "
        + suggestion(unit, known, "write COLUMN:unit with one of them")
    )


def _check_pairs(units: Mapping[str, str], dimensions: Mapping[str, Dimension | None], resolution: Any) -> float | None:
    """The encoder's step in its SI unit; `InputError` where it, or the position, is of another axis than the force."""
    turns = dimensions["force"] is TORQUE
    force = f"a {'torque' if turns else 'force'} in {units['force'] or 'N (no unit is given)'}"
    step, angular = (None, None) if resolution is None else read_step(resolution)
    if angular is not None and angular != turns:
        raise InputError(
            f"resolution: got {describe(resolution)} with {force}; "
            + ("an angle belongs to a torque, as in N m" if angular else "a length belongs to a force, as in N")
        )
    if dimensions["position"] not in (None, ANGLE if turns else LENGTH):
        raise InputError(
            f"position, force: got a position in {units['position'] or 'm (no unit is given)'} with {force}; a length "
            "goes with a force, an angle with a torque: say the units, as COLUMN:deg and COLUMN:mN m"
        )
    return step


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


def join_logs(motions: Sequence[LoggedMotion], period: float | None) -> dict[str, Any]:
    """Arguments of `zwidth.fit_log`: one axis and one encoder, and the period where no times were read."""
    if len({motion.rotary for motion in motions}) > 1:
        raise InputError("logs: some are of an angle, others of a length; fit them apart")
    steps = {motion.resolution for motion in motions}
    if len(steps) > 1:
        raise InputError("resolution: the logs have several; give all of them the same, or fit them apart")
    columns = {name: [getattr(motion, name) for motion in motions] for name in QUANTITIES}
    columns["time"] = [period if time is None else time for time in columns["time"]]
    return {**columns, "resolution": steps.pop(), "rotary": motions[0].rotary}


def fit_motions(motions: Sequence[LoggedMotion], *, period: float | None = None, **options: Any) -> DeviceFit:
    """`zwidth.fit_log` of logs that are read."""
    return fit_log(**join_logs(motions, period), **options)
