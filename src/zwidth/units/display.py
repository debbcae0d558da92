"""Display of results at the prompt and in notebooks: short texts with units, names of codes, and reasons for NaN."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import IntEnum
from html import escape
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from zwidth.core.status import Status
from zwidth.units.formatting import round_conservatively, with_unit
from zwidth.units.unit_system import ROTARY, UnitSystem

Kind = TypeVar("Kind", bound=type)
Result = TypeVar("Result")
Unit = str | type[IntEnum]  # unit of a field as text, or the enumeration to which the codes of a field belong

# Default units, on linear devices, of fields that occur in several result types; by name of the field.
_DEFAULT_UNITS: dict[str, Unit] = {"stiffness": "N/m", "virtual_damping": "N s/m", "status": Status}
_BARE = ("", "1", "degrees", "periods")  # units without SI prefixes
_FEW = 4  # largest number of entries of an array that is displayed with all entries
_LINE = 120  # characters per line; longer results are displayed with one field per line
_ROWS = 40  # largest number of rows of a table


def compact_repr(
    only: Sequence[str] = (),
    picture: Callable[[Any], str] | None = None,
    missing: Mapping[str, str] = MappingProxyType({}),
    messages: Mapping[Status, str] = MappingProxyType({}),
    **units: Unit,
) -> Callable[[Kind], Kind]:
    """Return a class decorator that adds a short ``repr`` and an HTML table to a dataclass or named tuple of results.

    The attribute ``unit_system`` of a result, which `with_units` sets, selects linear or rotary units.

    Args:
        only: names of the displayed fields; empty for all fields.
        picture: function that returns an HTML picture of the result, to be displayed after the table.
        missing: reasons for NaN, by field.
        messages: texts for status codes, in place of the general messages in `core.status`.
        **units: units on a linear device, or enumerations of codes, by field. Defaults exist for ``stiffness``,
            ``virtual_damping`` and ``status``.
    """

    def decorate(kind: Kind) -> Kind:
        shown_kind: Any = kind
        base: Any = kind
        if issubclass(kind, tuple):
            # Create a subclass, because named tuples cannot have further attributes. JAX handles the subclass like a
            # named tuple.
            names = ("__module__", "__qualname__", "__doc__")
            shown_kind = type(kind.__name__, (kind,), {name: getattr(kind, name) for name in names})
            shown_kind._replace = lambda self, **changes: with_units(base._replace(self, **changes), self.unit_system)
        if not hasattr(kind, "unit_system"):
            shown_kind.unit_system = None
        fields = (
            only
            or getattr(kind, "_fields", None)
            or tuple(name for name in getattr(kind, "__dataclass_fields__", ()) if name != "unit_system")
        )
        all_units = _DEFAULT_UNITS | units

        def spell(self: Any, name: str, value: Any) -> str:
            text = format_value(value, find_unit(self, all_units.get(name, "")), messages)
            if name in missing and "NaN" in text:
                text += f"{',' if text == 'NaN' else '; NaN:'} {missing[name]}"
            return text

        def as_text(self: Any) -> str:
            parts = [f"{name}={spell(self, name, getattr(self, name))}" for name in fields]
            line = f"{kind.__name__}({', '.join(parts)})"
            return line if len(line) <= _LINE else f"{kind.__name__}(\n    " + ",\n    ".join(parts) + ",\n)"

        def as_html(self: Any) -> str:
            columns, below = {name: getattr(self, name) for name in fields}, picture(self) if picture else ""
            if _is_table(columns.values()):
                cells = [[spell(self, name, each) for each in column] for name, column in columns.items()]
                return write_table(kind.__name__, list(zip(*cells, strict=True)), fields) + below
            rows = [(name, spell(self, name, value)) for name, value in columns.items()]
            return write_table(kind.__name__, rows) + below

        shown_kind.__repr__, shown_kind._repr_html_ = as_text, as_html
        return shown_kind

    return decorate


class ResultList(list[Any]):
    """A list of `compact_repr` results, displayed as tables in notebooks."""

    def _repr_html_(self) -> str:
        return "\n".join(each._repr_html_() for each in self)


def find_unit(result: Any, unit: Any) -> Any:
    """Convert a unit of linear devices to the unit in which a result is displayed: "N/m" to "N m/rad" if rotary.

    Enumerations of codes are returned unchanged. If the result has no unit system, a unit that differs between linear
    and rotary devices is converted to "", because the kind of the device is unknown.
    """
    if isinstance(unit, type) or ROTARY[unit] == unit:
        return unit
    return result.unit_system[unit] if result.unit_system else ""


def with_units(result: Result, system: UnitSystem | None) -> Result:
    """Set the unit system in which a result, or each result of a list, is displayed; return the result.

    JAX does not pass the unit system on: results of `jit`, `vmap` and `tree.map` are displayed without unit symbols.
    """
    for each in result if isinstance(result, list) else [result]:
        # Set the unit system only where the class has the default None; objects such as scenes define their own.
        if getattr(type(each), "unit_system", "") is None:
            object.__setattr__(each, "unit_system", system)
    return result


def format_value(value: Any, unit: Unit = "", messages: Mapping[Status, str] = MappingProxyType({})) -> str:
    """Format a value as a short text; a large array as its shape, range and number of NaN.

    Args:
        value: the value.
        unit: its unit, or the enumeration to which its codes belong.
        messages: texts for status codes, in place of the general messages in `core.status`.
    """
    if isinstance(value, str):
        return value or "''"
    if isinstance(value, bool | np.bool_) or value is None:
        return str(value)
    if isinstance(value, Mapping):
        parts = ", ".join(f"{name}: {format_value(each, unit)}" for name, each in value.items())
        return "{" + parts + "}" if len(parts) <= 2 * _LINE else f"{len(value)} entries, {', '.join(map(str, value))}"
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        # The value cannot be converted to an array: it is traced by JAX, or it is a ragged list.
        return repr(value)
    if array.dtype.kind not in "biufc":
        text = repr(value)
        return text if len(text) <= 2 * _LINE else f"{len(value)} of {type(next(iter(value))).__name__}"
    if array.ndim == 0:
        number = array[()]
        code = Status(int(number)) if unit is Status else Status.OK
        return _spell_number(number, unit) + (f": {messages.get(code, code.message)}" if code != Status.OK else "")
    if array.size <= _FEW:
        return f"[{', '.join(_spell_number(each, unit) for each in array.ravel())}]"
    return f"array {array.shape}, {_spell_range(array, unit)}".replace(",)", ")")


def _spell_number(value: Any, unit: Unit) -> str:
    """Format one number with its unit; for a code of an enumeration, return its name."""
    if isinstance(unit, type):
        return unit(int(value)).name
    if isinstance(value, np.bool_ | np.integer):
        return str(value)
    if isinstance(value, complex | np.complexfloating):
        return f"{value:.6g}"
    if math.isnan(value):
        return "NaN"
    if unit in _BARE or not (value == 0 or 1e-12 < abs(value) < 1e12):
        # Add 0 to remove the sign of a negative zero.
        return f"{float(value) + 0.0:.6g} {'' if unit == '1' else unit}".strip()
    # Round stiffnesses down, because most are upper limits.
    value = round_conservatively(float(value), "below" if unit == "N/m" else "", 6)
    number, _, rest = with_unit(value, unit, 6).partition(" ")
    return f"{float(number):.6g} {rest}"


def _spell_range(array: np.ndarray, unit: Unit) -> str:
    """Return the smallest and largest entry of an array as text; for codes or Booleans, the number of each of them."""
    if array.dtype.kind == "b":
        return f"{np.count_nonzero(array)} True"
    if isinstance(unit, type):
        codes, counts = np.unique(array, return_counts=True)
        return ", ".join(f"{count} {unit(int(code)).name}" for code, count in zip(codes, counts, strict=True))
    if array.dtype.kind == "c":
        return "complex"
    finite = array[np.isfinite(array)] if array.dtype.kind == "f" else array
    nans = f", {np.count_nonzero(np.isnan(array))} NaN" if finite.size < array.size else ""
    if not finite.size:
        return "none of them finite"
    ends = [_spell_number(end, unit) for end in (finite.min(), finite.max())]
    return f"{' to '.join(dict.fromkeys(ends))}{nans}"


def _is_table(columns: Iterable[Any]) -> bool:
    """Return whether all columns are one-dimensional arrays of the same length, at most ``_ROWS``."""
    shapes = {each.shape if isinstance(each, np.ndarray) else () for each in columns}
    return len(shapes) == 1 and all(len(shape) == 1 and 0 < shape[0] <= _ROWS for shape in shapes)


def write_table(title: str, rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """Return the HTML code of a table.

    Args:
        title: caption of the table.
        rows: cells of each row.
        head: cells of the header row; empty for a table without header.
    """

    def write(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f'<{tag} style="text-align:left">{escape(cell)}</{tag}>' for cell in cells) + "</tr>"

    lines = [f"<table><caption>{escape(title)}</caption>", *([write(head, "th")] if head else [])]
    return "\n".join([*lines, *(write(row, "td") for row in rows), "</table>"])


def draw_line(x: np.ndarray, y: np.ndarray, words: str) -> str:
    """Return the SVG code of a small picture of a curve, drawn through its finite points; "" for fewer than 2 of them.

    Args:
        x: horizontal coordinates.
        y: vertical coordinates.
        words: title of the picture.
    """
    finite = np.isfinite(x) & np.isfinite(y)
    if np.count_nonzero(finite) < 2:
        return ""
    # Draw at most 600 points, because the picture is only 320 pixels wide.
    pick = np.flatnonzero(finite)[np.unique(np.linspace(0, np.count_nonzero(finite) - 1, 600).astype(int))]
    across, up = ((part[pick] - part[pick].min()) / (np.ptp(part[pick]) or 1.0) for part in (x, y))
    points = " ".join(f"{4 + 312 * a:.1f},{76 - 72 * b:.1f}" for a, b in zip(across, up, strict=True))
    return (
        f'<svg width="320" height="80" role="img"><title>{escape(words)}</title>'
        f'<polyline points="{points}" fill="none" stroke="#0072B2" stroke-width="1.2"/></svg>'
    )
