"""Tables of named columns, as in the CSV files of studies, and the curves that they contain.

A *curve* is a group of consecutive rows of a table with the same values in some columns, the *keys*. Names of columns
end with the unit, for example ``stiffness_N_per_m``; tables of rotary devices have the units of rotary devices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import wraps
from types import SimpleNamespace
from typing import Any, ParamSpec, Protocol, TypeVar

import numpy as np

from zwidth.figures.style import house_style
from zwidth.words.formatting import convert_header
from zwidth.words.unit_system import LINEAR, ROTARY, UNIT_PAIRS

_ROTARY_UNITS = [rotary for _, rotary in UNIT_PAIRS]
# Columns of walls in SI units, in addition to alpha and beta.
SI_COLUMNS = ("stiffness_N_per_m", "virtual_damping_N_s_per_m")


class Table(Protocol):
    """Columns of equal length by name: a dict of arrays, or a pandas DataFrame."""

    def __getitem__(self, key: str, /) -> Any: ...

    def __iter__(self) -> Iterator[Any]: ...

    def __contains__(self, key: Any, /) -> bool: ...


Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def draws_tables(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Wrap a function to draw in the house style, and in rotary units if one of its tables or datasets has them."""

    @wraps(function)
    def within(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        given: Any = [*args, *kwargs.values()]
        read: Any = [name_as_linear(each) for each in given]
        rotary = any(new is not old for new, old in zip(read, given, strict=True)) or any(map(is_of_rotary, given))
        with house_style(ROTARY if rotary else None):
            return function(*read[: len(args)], **dict(zip(kwargs, read[len(args) :], strict=True)))  # pyright: ignore

    return within


def is_of_rotary(data: Any) -> bool:
    """Return whether a sweep's dataset contains units of rotary devices."""
    variables = getattr(data, "variables", {})
    return any(str(each.attrs.get("units", "")) in _ROTARY_UNITS for each in variables.values())


def name_as_linear(table: Any) -> Any:
    """Rename the columns of a table of rotary devices to those of linear devices; return other objects unchanged."""
    names = {str(name): convert_header(str(name), LINEAR) for name in table} if hasattr(table, "keys") else {}
    return {linear: table[name] for name, linear in names.items()} if any(k != v for k, v in names.items()) else table


def select(table: Table, **wanted: object) -> dict[str, np.ndarray]:
    """Return the rows of a table with the given values, by column."""
    columns = {str(name): np.asarray(table[name]) for name in table}
    for name, value in wanted.items():
        keep = columns[name] == value
        columns = {each: column[keep] for each, column in columns.items()}
    return columns


def in_order(columns: Mapping[str, np.ndarray], over: str) -> dict[str, np.ndarray]:
    """Return the rows of a table in ascending order of a column."""
    order = np.argsort(columns[over], kind="stable")
    return {name: column[order] for name, column in columns.items()}


def grid_in_order(arrays: Mapping[str, np.ndarray], axes: Iterable[str]) -> dict[str, np.ndarray]:
    """Sort arrays in ascending order of their axes.

    Args:
        arrays: The arrays by name, including one 1-D array per axis.
        axes: Names of the axes, in the order of the last dimensions of the arrays with the most dimensions.
    """
    names, n_dims = list(axes), max(values.ndim for values in arrays.values())
    ordered = dict(arrays)
    for dimension, name in enumerate(names, start=n_dims - len(names)):
        order = np.argsort(arrays[name], kind="stable")
        grids = {each: values.take(order, dimension) for each, values in ordered.items() if values.ndim == n_dims}
        ordered |= {**grids, name: arrays[name][order]}
    return ordered


def curves(table: Table, *keys: str, over: str = "", **wanted: object) -> list[Any]:
    """Return the curves of a table: consecutive rows with the same values of ``keys``.

    A curve has the columns as attributes: single values of the keys, arrays of the others, sorted by the column
    ``over`` if given. Only rows with the values ``wanted``, by column, count.
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
    """Stack curves into one table; repeat numbers and texts along their curve, and fill missing columns with NaN."""
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
    """Return K at alpha = 1 and B at beta = 1; None if a table has no walls in SI units."""
    if SI_COLUMNS[0] not in table:
        return None
    scales = []
    for name, si in zip(("alpha", "beta"), SI_COLUMNS, strict=True):
        normalized = np.asarray(table[name])
        top = int(np.nanargmax(np.abs(normalized)))
        scales.append(float(np.asarray(table[si])[top] / normalized[top]))
    return scales[0], scales[1]
