"""Select, sort, split and stack the rows of tables, as in the CSV files of studies.

A *table* has named columns of equal length. A *curve* is a group of consecutive rows with equal values in some columns,
the *keys*. Names of columns end with the unit, for example ``stiffness_N_per_m``; tables of rotary devices have the
units of rotary devices. *Arrays* of npz files have several dimensions, one per parameter at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import wraps
from types import SimpleNamespace
from typing import Any, ParamSpec, Protocol, TypeVar

import numpy as np

from zwidth.plotting.style import house_style
from zwidth.units.formatting import convert_header
from zwidth.units.unit_system import LINEAR, ROTARY, UNIT_PAIRS

_ROTARY_UNITS = [rotary for _, rotary in UNIT_PAIRS]  # units that only datasets of rotary devices have
# Names of the columns with the stiffness and the virtual damping of walls in SI units.
SI_COLUMNS = ("stiffness_N_per_m", "virtual_damping_N_s_per_m")


class Table(Protocol):
    """Columns of equal length by name: a dict of arrays, or a pandas DataFrame."""

    def __getitem__(self, key: str, /) -> Any: ...

    def __iter__(self) -> Iterator[Any]: ...

    def __contains__(self, key: Any, /) -> bool: ...


Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def draws_tables(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Wrap a function so that it draws in the house style, and in rotary units if one of its arguments has these.

    Tables with rotary units are passed on with the column names of linear devices.
    """

    @wraps(function)
    def within(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        given: Any = [*args, *kwargs.values()]
        read: Any = [name_as_linear(each) for each in given]
        rotary = any(new is not old for new, old in zip(read, given, strict=True)) or any(map(is_of_rotary, given))
        with house_style(ROTARY if rotary else None):
            return function(*read[: len(args)], **dict(zip(kwargs, read[len(args) :], strict=True)))  # pyright: ignore

    return within


def is_of_rotary(data: Any) -> bool:
    """Return whether an object is the dataset of a sweep over rotary devices, as shown by its units."""
    variables = getattr(data, "variables", {})
    return any(str(each.attrs.get("units", "")) in _ROTARY_UNITS for each in variables.values())


def name_as_linear(table: Any) -> Any:
    """Return a table of rotary devices with the column names of linear devices; return other objects unchanged."""
    names = {str(name): convert_header(str(name), LINEAR) for name in table} if hasattr(table, "keys") else {}
    return {linear: table[name] for name, linear in names.items()} if any(k != v for k, v in names.items()) else table


def select(table: Table, **wanted: object) -> dict[str, np.ndarray]:
    """Return the rows of a table that have the given values; the keywords are column names."""
    columns = {str(name): np.asarray(table[name]) for name in table}
    for name, value in wanted.items():
        keep = columns[name] == value
        columns = {each: column[keep] for each, column in columns.items()}
    return columns


def in_order(columns: Mapping[str, np.ndarray], over: str) -> dict[str, np.ndarray]:
    """Return the rows of a table, sorted in ascending order of the column ``over``."""
    order = np.argsort(columns[over], kind="stable")
    return {name: column[order] for name, column in columns.items()}


def grid_in_order(arrays: Mapping[str, np.ndarray], axes: Iterable[str]) -> dict[str, np.ndarray]:
    """Sort multi-dimensional arrays in ascending order of each of their parameters.

    Args:
        arrays: The arrays by name, including one 1-D array per parameter. Only the arrays with the most dimensions are
            sorted, together with those of the parameters.
        axes: Names of the parameters, in the order of the last dimensions of these arrays.
    """
    names, n_dims = list(axes), max(values.ndim for values in arrays.values())
    ordered = dict(arrays)
    for dimension, name in enumerate(names, start=n_dims - len(names)):
        order = np.argsort(arrays[name], kind="stable")
        grids = {each: values.take(order, dimension) for each, values in ordered.items() if values.ndim == n_dims}
        ordered |= {**grids, name: arrays[name][order]}
    return ordered


def curves(table: Table, *keys: str, over: str = "", **wanted: object) -> list[Any]:
    """Return the curves of a table as objects with the columns as attributes.

    Args:
        table: Table.
        keys: Columns with equal values along a curve, which become single values; the others become arrays.
        over: Column by which the rows of each curve are sorted; "" to keep their order.
        wanted: Values that rows must have to be selected, by column.
    """
    columns = select(table, **wanted)
    changes = [columns[key][1:] != columns[key][:-1] for key in keys]
    ends = np.flatnonzero(np.any(changes, axis=0)) + 1
    parts = {name: np.split(column, ends) for name, column in columns.items()}
    rows = [{name: part[k] for name, part in parts.items()} for k in range(ends.size + 1)]
    all_curves = [SimpleNamespace(**(in_order(each, over) if over else each)) for each in rows]
    for curve in all_curves if columns[keys[0]].size else ():
        vars(curve).update({key: getattr(curve, key)[0] for key in keys})
    return all_curves if columns[keys[0]].size else []


def stack(parts: Iterable[Mapping[str, object]]) -> dict[str, np.ndarray]:
    """Stack curves, given as columns by name, into one table.

    A number or text in place of a column is repeated along its curve. Columns that a curve lacks are filled with NaN,
    or with "" for texts.
    """
    blocks = []
    for part in filter(None, parts):
        arrays = [np.asarray(value) for value in part.values()]
        rows = max(array.size for array in arrays)
        blocks.append({name: np.broadcast_to(array, rows) for name, array in zip(part, arrays, strict=True)})
    names = list(dict.fromkeys(name for block in blocks for name in block))
    table = {}
    for name in names:
        like = next(block[name] for block in blocks if name in block)
        absent = "" if like.dtype.kind == "U" else np.nan
        columns = [block.get(name, np.full(next(iter(block.values())).size, absent)) for block in blocks]
        table[name] = np.concatenate(columns)
    return table


def si_scale(table: Table) -> tuple[float, float] | None:
    """Return the stiffness at alpha = 1 and the damping at beta = 1 in SI units; None without columns in SI units."""
    if SI_COLUMNS[0] not in table:
        return None
    scales = []
    for name, si in zip(("alpha", "beta"), SI_COLUMNS, strict=True):
        normalized = np.asarray(table[name])
        top = int(np.nanargmax(np.abs(normalized)))
        scales.append(float(np.asarray(table[si])[top] / normalized[top]))
    return scales[0], scales[1]
