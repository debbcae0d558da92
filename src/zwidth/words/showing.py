"""Display of results at the prompt and in notebooks: short, with units, names of codes, and reasons for NaN."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import IntEnum
from html import escape
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from zwidth.words.formatting import round_safely, with_unit
from zwidth.words.status import Status
from zwidth.words.unit_system import ROTARY, UnitSystem

Kind = TypeVar("Kind", bound=type)
Result = TypeVar("Result")
# A unit, or the names of codes.
Unit = str | type[IntEnum]

# Default units of fields, by name.
_USUAL: dict[str, Unit] = {"stiffness": "N/m", "virtual_damping": "N s/m", "status": Status}
_BARE = ("", "1", "degrees", "periods")  # units without prefixes
_FEW = 4  # largest number of entries of an array that are shown
_LINE = 120  # characters per line
_ROWS = 40  # rows per table


def shown(
    only: Sequence[str] = (),
    picture: Callable[[Any], str] | None = None,
    missing: Mapping[str, str] = MappingProxyType({}),
    **units: Unit,
) -> Callable[[Kind], Kind]:
    """Return a decorator that gives a result class, dataclass or named tuple, a short ``repr`` and an HTML table.

    The attribute ``unit_system`` of a result, which `with_units` sets, selects linear or rotary units.

    Args:
        only: names of the fields to show; all if empty.
        picture: returns an HTML picture of the result, which follows the table.
        missing: reasons for NaN, by field.
        **units: units of linear devices, or enumerations of codes, by field; stiffness, virtual damping and status have
            defaults.
    """

    def decorate(kind: Kind) -> Kind:
        shown_kind: Any = kind
        base: Any = kind
        if issubclass(kind, tuple):
            # Use a subclass, because named tuples cannot have further attributes. JAX treats it as a named tuple, too.
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
        known = _USUAL | units

        def spell(self: Any, name: str, value: Any) -> str:
            text = spell_value(value, find_unit(self, known.get(name, "")))
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
    """List of `shown` results, displayed as tables in notebooks."""

    def _repr_html_(self) -> str:
        return "\n".join(each._repr_html_() for each in self)


def find_unit(result: Any, unit: Any) -> Any:
    """Return a unit in the unit system of a result; "" for units that depend on the system if it is not known."""
    if isinstance(unit, type) or ROTARY[unit] == unit:
        return unit
    return result.unit_system[unit] if result.unit_system else ""


def with_units(result: Result, system: UnitSystem | None) -> Result:
    """Return a result, or a list of results, after setting the unit system in which it is shown.

    JAX ignores the unit system: results returned by `jit`, `vmap` and `tree.map` are shown in SI units without symbols.
    """
    for each in result if isinstance(result, list) else [result]:
        # Scenes have a unit system of their own.
        if getattr(type(each), "unit_system", "") is None:
            object.__setattr__(each, "unit_system", system)
    return result


def spell_value(value: Any, unit: Unit = "") -> str:
    """Return a short text for a value; for an array its shape, range and number of NaN."""
    if isinstance(value, str):
        return value or "''"
    if isinstance(value, bool | np.bool_) or value is None:
        return str(value)
    if isinstance(value, Mapping):
        parts = ", ".join(f"{name}: {spell_value(each, unit)}" for name, each in value.items())
        return "{" + parts + "}" if len(parts) <= 2 * _LINE else f"{len(value)} entries, {', '.join(map(str, value))}"
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        # The value is traced by JAX or a ragged list.
        return repr(value)
    if array.dtype.kind not in "biufc":
        text = repr(value)
        return text if len(text) <= 2 * _LINE else f"{len(value)} of {type(next(iter(value))).__name__}"
    if array.ndim == 0:
        number = array[()]
        code = Status(int(number)) if unit is Status else Status.OK
        return _spell_number(number, unit) + (f": {code.message}" if code != Status.OK else "")
    if array.size <= _FEW:
        return f"[{', '.join(_spell_number(each, unit) for each in array.ravel())}]"
    return f"array {array.shape}, {_spell_range(array, unit)}".replace(",)", ")")


def _spell_number(value: Any, unit: Unit) -> str:
    """Return one number with its unit, or the name of a code."""
    if isinstance(unit, type):
        return unit(int(value)).name
    if isinstance(value, np.bool_ | np.integer):
        return str(value)
    if isinstance(value, complex | np.complexfloating):
        return f"{value:.6g}"
    if math.isnan(value):
        return "NaN"
    if unit in _BARE or not (value == 0 or 1e-12 < abs(value) < 1e12):
        # A zero has no sign.
        return f"{float(value) + 0.0:.6g} {'' if unit == '1' else unit}".strip()
    # Round stiffnesses down, because most are upper limits.
    value = round_safely(float(value), "below" if unit == "N/m" else "", 6)
    number, _, rest = with_unit(value, unit, 6).partition(" ")
    return f"{float(number):.6g} {rest}"


def _spell_range(array: np.ndarray, unit: Unit) -> str:
    """The least and the largest, or how often each code stands there."""
    if array.dtype.kind == "b":
        return f"{np.count_nonzero(array)} True"
    if isinstance(unit, type):
        codes, counts = np.unique(array, return_counts=True)
        return ", ".join(f"{count} {unit(int(code)).name}" for code, count in zip(codes, counts, strict=True))
    if array.dtype.kind == "c":
        return "complex"
    known = array[np.isfinite(array)] if array.dtype.kind == "f" else array
    nans = f", {np.count_nonzero(np.isnan(array))} NaN" if known.size < array.size else ""
    if not known.size:
        return "none of them finite"
    ends = [_spell_number(end, unit) for end in (known.min(), known.max())]
    return f"{' to '.join(dict.fromkeys(ends))}{nans}"


def _is_table(columns: Iterable[Any]) -> bool:
    """Whether all are columns of one length that fits."""
    shapes = {each.shape if isinstance(each, np.ndarray) else () for each in columns}
    return len(shapes) == 1 and all(len(shape) == 1 and 0 < shape[0] <= _ROWS for shape in shapes)


def write_table(title: str, rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A table of HTML."""

    def write(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f'<{tag} style="text-align:left">{escape(cell)}</{tag}>' for cell in cells) + "</tr>"

    lines = [f"<table><caption>{escape(title)}</caption>", *([write(head, "th")] if head else [])]
    return "\n".join([*lines, *(write(row, "td") for row in rows), "</table>"])


def draw_line(x: np.ndarray, y: np.ndarray, words: str) -> str:
    """A small picture of a curve, as SVG: what is not finite is left out."""
    known = np.isfinite(x) & np.isfinite(y)
    if np.count_nonzero(known) < 2:
        return ""
    # So many points as there are places for them.
    pick = np.flatnonzero(known)[np.unique(np.linspace(0, np.count_nonzero(known) - 1, 600).astype(int))]
    across, up = ((part[pick] - part[pick].min()) / (np.ptp(part[pick]) or 1.0) for part in (x, y))
    points = " ".join(f"{4 + 312 * a:.1f},{76 - 72 * b:.1f}" for a, b in zip(across, up, strict=True))
    return (
        f'<svg width="320" height="80" role="img"><title>{escape(words)}</title>'
        f'<polyline points="{points}" fill="none" stroke="#0072B2" stroke-width="1.2"/></svg>'
    )
