"""Read logs from files: identify the columns, convert them to SI units, and fit them.

`io.tables` reads a file as a table, and `identification.headers` identifies the columns of the *quantities* time,
position and force and their units. If the log has a velocity in place of a position, the velocity is integrated; a
motor current in place of a force is multiplied by the motor constant.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.core.errors import InputError, UnusableValueError
from zwidth.identification.device_fit import DeviceFit
from zwidth.identification.headers import DIMENSIONS, QUANTITIES, Column, find_columns, has_column
from zwidth.identification.log_fit import fit_log
from zwidth.io.tables import NamedColumns, read_columns
from zwidth.units.formatting import describe, plain, suggestion, with_unit
from zwidth.units.parsing import (
    ANGLE,
    COUNTS,
    FORCE,
    LENGTH,
    MASS,
    TORQUE,
    Dimension,
    looks_like_number,
    read_quantity,
)
from zwidth.units.quantities import POSITIVE

_AMPERES = {"A": 1.0, "mA": 1e-3}
_PER_AMPERE = re.compile(r"(.*?)\s*/\s*A\s*")
_MANY_COUNTS = 50.0  # least range (maximum minus minimum) of integer positions that are read as encoder counts
_ROUNDING = 1e-9  # relative difference of two conversion factors below which they count as equal (rounding errors)
_SAME_PERIOD = 1e-3  # largest relative difference between the specified period and that of the logged times
_OTHER = 0.1  # relative difference from the logged times above which the period specified in their place is refused
# Units of mass in which scales and load cells display a force, each with the unit of force of the corresponding weight.
_WEIGHTS = {"kg": "kgf", "g": "gf", "lb": "lbf", "oz": "ozf"}
_EPOCH = 1e9  # s since 1970 (the year 2001); larger times without a unit are assumed to be times since 1970
_EPOCH_UNITS = (("ns", 1e-9), ("us", 1e-6), ("ms", 1e-3))  # possible units of times since 1970, in the order of trial
_COARSEST = 1.1  # rad or m; largest accepted encoder step (6 steps per turn), because a larger value is a count


@dataclass(frozen=True)
class LoggedMotion:
    """Time, position and force of one log in SI units, as arrays with one entry per row of the file.

    Cells of the file without a number are NaN. Comparison of two logs with ``==`` ignores the arrays.

    Attributes:
        time: times in s; None if the period replaces them.
        position: positions in m; for a rotary axis in rad.
        force: forces in N; for a rotary axis torques in N m.
        resolution: encoder step in m or rad; None if it is unknown.
        rotary: True for a rotary axis.
        notes: assumptions about columns and units that the user should check, one clause each.
    """

    time: np.ndarray | None = field(compare=False)
    position: np.ndarray = field(compare=False)
    force: np.ndarray = field(compare=False)
    resolution: float | None
    rotary: bool
    notes: tuple[str, ...] = ()


def read_log(
    file: str | Path,
    columns: Mapping[str, str | None],
    *,
    resolution: Any = None,
    period: float | None = None,
    usual_period: float | None = None,
    motor_constant: str | None = None,
) -> LoggedMotion:
    """Read the times, positions and forces of a log from a file, and convert them to SI units.

    Args:
        file: a text file, also compressed by gzip: columns separated by commas, semicolons, tabs or blanks, in UTF-8,
            UTF-16 or Latin-1, with or without a preamble and a line of units; a NumPy file, .npz or .npy; or a MATLAB
            file, .mat up to version 7.
        columns: the columns of ``time``, ``position`` and ``force``, each by its header with or without the unit, or by
            its number if the file has no headers. ``COLUMN:unit`` replaces the unit of the header. Omitted
            columns are recognized by their headers. Times may be dates in ISO 8601. A column in m/s, rad/s or counts/s
            is summed to a position; it must be the unfiltered difference of successive positions.
        resolution: encoder step per count, a length or an angle with its unit; a number without a unit is in m, or in
            rad if the force is a torque.
        period: sampling period in s, which replaces the times; these are then not read.
        usual_period: sampling period in s that replaces the times if no column of times is recognized.
        motor_constant: force or torque per current, such as "5 N/A" or "0.03 N m/A", for a current in A or mA.

    Raises:
        InputError: a column is missing or ambiguous, a unit is unknown, a cell is not a number, a length is combined
            with a torque, or times with a unit contradict the period.
    """
    table = read_columns(Path(file))
    heads = table.heads
    if columns.get("time") is None and not has_column(heads, "time"):
        period = period or usual_period
    wanted = [name for name in QUANTITIES if name != "time" or period is None]
    if table.nameless and not all((columns.get(name) or "").partition(":")[0] in heads for name in wanted):
        raise InputError(
            f"{table.nameless}; add a header such as 'time [s],position [m],force [N]', or specify each column by its "
            "number and unit, as 1:ms, 2:mm and 3:N for time, position and force (1:s+2:ns for a time in two columns)"
        )
    sources = find_columns(file, heads, columns, wanted)
    taken = [index for column in sources.values() for index in column.indices]
    if len(set(taken)) < len(taken):
        names = ", ".join(f"{name} {heads[column.indices[0]]!r}" for name, column in sources.items())
        raise InputError(f"{file}: the same column is used twice: {names}; specify another one")
    cells = dict(zip(taken, table.numbers(taken, gaps=True), strict=True))
    for index, column in cells.items():
        if not np.isfinite(column).any():
            raise InputError(f"{file}: column {heads[index]!r} contains no number; specify another column")
    is_counts = _look_like_counts(cells[sources["position"].indices[0]])
    given, notes = _name_units(heads, sources, resolution, is_counts)
    # If the position column contains a velocity, determine the unit of the integrated position.
    integrated = _integrate_unit(given["position"])
    units = {**given, "position": integrated or given["position"]}
    constant = 1.0
    if given["force"] in _AMPERES:
        constant, units["force"] = _read_constant(motor_constant, given["force"])
    read = {name: _read_unit(name, unit) for name, unit in units.items() if name != "time"}
    factors = {name: size for name, (size, _) in read.items()}
    dimensions = {name: dimension for name, (_, dimension) in read.items()}
    rotary, step = dimensions["force"] is TORQUE, _check_pairs(units, dimensions, resolution)
    if dimensions["position"] is None:
        if step is None:
            raise InputError(
                "position: it is in counts; specify the resolution, as 0.03 mm or 0.09 deg per count, or as "
                "'4000 counts/rev'"
            )
        factors["position"] = step
    factors["force"] *= constant
    numbers = {name: cells[sources[name].indices[0]] * factors[name] for name in factors}
    time = None if period is not None else _join_times(sources["time"], cells, notes)
    if period is not None:
        _compare_period(file, table, period)
    if integrated is not None:
        timed = np.zeros(1) if time is None else time[np.isfinite(time)]
        interval = float(timed[-1] - timed[0]) / max(1, timed.size - 1) if period is None else period
        speed = numbers["position"] * interval * (1 / 60 if given["position"] == "rpm" else 1.0)
        numbers["position"] = np.where(np.isnan(speed), np.nan, np.cumsum(np.nan_to_num(speed)))
    return LoggedMotion(time, numbers["position"], numbers["force"], step, rotary, tuple(notes))


def _look_like_counts(position: np.ndarray) -> bool:
    """Return whether all positions are integers and have a large range, like encoder counts."""
    finite = position[np.isfinite(position)]
    return bool(np.all(finite == np.round(finite))) and float(np.ptp(finite)) >= _MANY_COUNTS


def _name_units(
    heads: Sequence[str], sources: Mapping[str, Column], resolution: Any, is_counts: bool
) -> tuple[dict[str, str], list[str]]:
    """Determine the unit of each quantity, from its header or by assumption.

    Args:
        heads: headers of the table.
        sources: column of each quantity.
        resolution: encoder step as specified by the user; an angle implies a rotary axis.
        is_counts: True if the positions are probably encoder counts; without a unit they are then read in counts.

    Returns:
        The unit of each quantity, and notes on assumptions that the user should check.
    """
    units = {name: column.units[0] for name, column in sources.items()}
    notes = []
    if any(column.guessed for column in sources.values()):
        names = [f"{name} {' + '.join(repr(heads[k]) for k in column.indices)}" for name, column in sources.items()]
        notes.append(f"columns identified by their headers: {', '.join(names)}")
    for name in ("position", "force"):
        header_unit, specified = sources[name].header_unit, sources[name].units[0]
        sizes = [size for unit in (header_unit, specified) if (size := _measure(name, unit)) is not None]
        if header_unit != specified and len(sizes) == 2 and abs(sizes[0] / sizes[1] - 1) > _ROUNDING:
            notes.append(f"the {name} is read in {specified}, as specified, although its header has {header_unit}")
    if units["force"] in _WEIGHTS:
        mass, units["force"] = units["force"], _WEIGHTS[units["force"]]
        weight = FORCE.in_base("1", 0, units["force"])
        notes.append(f"the force in {mass} is read as a weight: 1 {mass} = {plain(weight or 0)} N")
    if is_counts and not units["position"]:
        units["position"] = COUNTS[0]
        notes.append(f"the position {heads[sources['position'].indices[0]]!r} has no unit and is read in counts")
    if _is_rotary(units, sources, resolution):
        for name, unit in (("position", "rad"), ("force", "N m")):
            if not units[name] and sources[name].is_rotary is not False:
                units[name] = unit
                notes.append(f"the {name} {heads[sources[name].indices[0]]!r} has no unit and is read in {unit}")
    return units, notes


def _is_rotary(units: Mapping[str, str], sources: Mapping[str, Column], resolution: Any) -> bool:
    """Return whether the axis is rotary, by the units; without units by the resolution; else by the headers."""
    for name in ("force", "position"):
        linear, angular = DIMENSIONS[name]
        base = _integrate_unit(units[name]) or units[name]
        for dimension in (linear, angular):
            if base and dimension.in_base("1", 0, base) is not None:
                return dimension is angular
    if resolution is not None and read_step(resolution)[1] is not None:
        return bool(read_step(resolution)[1])
    return any(sources[name].is_rotary for name in ("force", "position"))


def _measure(name: str, unit: str) -> float | None:
    """Return the factor that converts a position or force from a unit to SI; None if the unit has another dimension.

    A unit of mass stands for the corresponding weight.
    """
    for dimension in (*DIMENSIONS[name], MASS):
        size = dimension.in_base("1", 0, unit) if unit else None
        if size is not None:
            return size * (9.80665 if dimension is MASS else 1.0)
    return None


def _join_times(column: Column, numbers: Mapping[int, np.ndarray], notes: list[str]) -> np.ndarray:
    """Return the times in s, read from one column, or added up from two: seconds and fractions of a second.

    Args:
        column: the column or the two columns of the time.
        numbers: values of the cells, by column index.
        notes: list to which a note is appended if the unit is assumed.
    """
    total: Any = 0.0
    for index, unit in zip(column.indices, column.units, strict=True):
        values = numbers[index]
        size = _read_unit("time", unit)[0]
        first = float(values[np.isfinite(values)][0])
        if not unit:
            # Derive the unit of a time since 1970 from its magnitude, because every smaller unit yields a date before
            # 2001.
            name, size = next(((name, size) for name, size in _EPOCH_UNITS if first * size >= _EPOCH), ("s", 1.0))
            if name != "s":
                notes.append(f"the time has no unit and is read in {name} since 1970, according to its magnitude")
        # Subtract the first value from the column of seconds, because the rounding error of a time since 1970 would
        # exceed the resolution of the column of fractions.
        total = total + (values - first if len(column.indices) > 1 and size == 1.0 else values) * size
    return total


def _integrate_unit(unit: str) -> str | None:
    """Return the unit of position that belongs to a unit of velocity, e.g. "m" for "m/s"; None for any other unit."""
    if unit == "rpm":
        return "turns"
    base, per, second = unit.rpartition("/")
    return base if per and second == "s" else None


def _read_constant(constant: str | None, unit: str) -> tuple[float, str]:
    """Return the force in N or the torque in N m per unit of current, and the unit of the result, "N" or "N m".

    Args:
        constant: motor constant as specified by the user, such as "5 N/A"; None if the user specified none.
        unit: unit of the current, "A" or "mA".
    """
    match = _PER_AMPERE.fullmatch(constant or "")
    for dimension in (FORCE, TORQUE):
        try:
            if match:
                return read_quantity(match[1], dimension, POSITIVE)[0] * _AMPERES[unit], dimension.base
        except UnusableValueError:
            continue
    got = "nothing" if constant is None else describe(constant)
    raise InputError(
        f"motor_constant: got {got} for a force in {unit}; give the force per ampere, as 5 N/A or 0.03 N m/A"
    )


def _compare_period(file: str | Path, table: NamedColumns, period: float) -> None:
    """Raise `InputError` if the times of the log have a unit and contradict the period that the user specified."""
    try:
        column = find_columns(file, table.heads, {}, ["time"])["time"]
        if not all(column.units):
            return
        values = table.numbers(column.indices, gaps=True)
        time = _join_times(column, dict(zip(column.indices, values, strict=True)), [])
        time = time[np.isfinite(time)]
    except InputError:
        # Ignore times that cannot be read, because they may be the reason why the user specified the period.
        return
    step = float(time[-1] - time[0]) / max(1, time.size - 1)
    if not abs(step - period) <= _OTHER * period:
        raise InputError(
            f"period: got {with_unit(period, 's')}, but the times in {file} are {with_unit(step, 's')} apart; omit the "
            "period, or correct one of them"
        )


def _read_unit(name: str, unit: str) -> tuple[float, Dimension | None]:
    """Return the factor that converts a quantity from a unit to SI, and the dimension of the unit (None for counts).

    For an empty unit, the factor is 1 and the dimension is that of a linear axis.
    """
    if name == "position" and unit.lower() in COUNTS:
        return 1.0, None
    for dimension in DIMENSIONS[name]:
        size = dimension.in_base("1", 0, unit) if unit else 1.0
        if size is not None:
            return size, dimension
    allowed = [each for dimension in DIMENSIONS[name] for each in dimension.units]
    allowed += [COUNTS[0]] if name == "position" else []
    raise InputError(
        f"{name}: got the unit {unit!r}; allowed are {', '.join(allowed)}; "
        + suggestion(unit, allowed, "write COLUMN:unit with one of them")
    )


def _check_pairs(units: Mapping[str, str], dimensions: Mapping[str, Dimension | None], resolution: Any) -> float | None:
    """Return the encoder step in SI units; raise `InputError` if position, force and step mix linear and rotary units.

    Args:
        units: unit of each quantity, "" if it has none.
        dimensions: dimension of position and force, None for counts.
        resolution: encoder step as specified by the user.

    Returns:
        The encoder step, None if the user specified none.

    Raises:
        InputError: linear and rotary quantities are combined.
    """
    is_rotary = dimensions["force"] is TORQUE
    force = f"a {'torque' if is_rotary else 'force'} in {units['force'] or 'N (no unit)'}"
    step, angular = (None, None) if resolution is None else read_step(resolution)
    if angular is not None and angular != is_rotary:
        raise InputError(
            f"resolution: got {describe(resolution)} with {force}; "
            + ("an angle belongs to a torque, as in N m" if angular else "a length belongs to a force, as in N")
        )
    if dimensions["position"] not in (None, ANGLE if is_rotary else LENGTH):
        raise InputError(
            f"position, force: got a position in {units['position'] or 'm (no unit)'} with {force}; a length "
            "belongs to a force, an angle to a torque: specify units, as COLUMN:deg and COLUMN:mN m"
        )
    return step


def read_step(resolution: Any) -> tuple[float, bool | None]:
    """Convert a user-specified encoder step to SI units.

    Returns:
        The step in m or rad; and True for an angle, False for a length, None for a number without a unit.
    """
    number = not isinstance(resolution, str) or looks_like_number(resolution)
    value = float(resolution) if isinstance(resolution, str) and number else resolution
    if number and isinstance(value, int | float) and value > _COARSEST:
        raise InputError(
            f"resolution: got {describe(resolution)}, more than 1 rad or 1 m per count; write counts per turn as "
            f"'{describe(resolution).strip(chr(39))} counts/rev', or a step as '0.09 deg'"
        )
    try:
        return read_quantity(value, LENGTH, POSITIVE)[0], None if number else False
    except UnusableValueError as error:
        try:
            return read_quantity(value, ANGLE, POSITIVE, counts=True)[0], True
        except UnusableValueError:
            problem, allowed = error.parts[:2]
            raise InputError(
                f"resolution: {problem}; {allowed}, or with one of {', '.join(ANGLE.units)}: as 0.03 mm or 0.09 deg"
            ) from None


def join_logs(motions: Sequence[LoggedMotion], period: float | None) -> dict[str, Any]:
    """Return the logs of one axis as keyword arguments of `zwidth.fit_log`; ``period`` replaces missing times."""
    if len({motion.rotary for motion in motions}) > 1:
        raise InputError("logs: some have angles, others lengths; fit them separately")
    steps = {motion.resolution for motion in motions}
    if len(steps) > 1:
        raise InputError("resolution: the logs have different ones; give all the same, or fit them separately")
    columns = {name: [getattr(motion, name) for motion in motions] for name in QUANTITIES}
    columns["time"] = [period if time is None else time for time in columns["time"]]
    return {**columns, "resolution": steps.pop(), "rotary": motions[0].rotary}


def check_period(period: float | None, logged: float) -> None:
    """Raise `InputError` if the sampling period of the logged times differs from the one that the user specified."""
    if period is not None and abs(logged - period) > _SAME_PERIOD * period:
        raise InputError(
            f"period: got {with_unit(period, 's')}, but the samples of the log are {with_unit(logged, 's')} apart; "
            "correct the period, or leave it out"
        )


def fit_motions(motions: Sequence[LoggedMotion], *, period: float | None = None, **options: Any) -> DeviceFit:
    """Fit a device with `zwidth.fit_log` to logs read from files, and add the notes on their columns to the result."""
    fit = fit_log(**join_logs(motions, period), **options)
    check_period(period, fit.period)
    notes = dict.fromkeys(note for motion in motions for note in motion.notes)
    return replace(fit, notes=(*notes, *fit.notes)) if notes else fit
