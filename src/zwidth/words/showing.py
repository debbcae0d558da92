"""Results at the prompt and in notebooks: short, with units, with names for codes, and with the reason for a NaN."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import IntEnum
from html import escape
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from zwidth.words.formatting import round_safely, with_unit
from zwidth.words.rotation import in_own_units, is_rotary, wrap_methods
from zwidth.words.status import Status

Kind = TypeVar("Kind", bound=type)
# A unit, or the names of codes.
Unit = str | type[IntEnum]

# What these names mean wherever they stand.
_USUAL: dict[str, Unit] = {"stiffness": "N/m", "virtual_damping": "N s/m", "status": Status}
# Units that take no prefix; entries of an array that are written out; characters of a line, and rows of a table.
_BARE = ("", "1", "degrees", "periods")
_FEW, _LINE, _ROWS = 4, 120, 40


def shown(
    only: Sequence[str] = (),
    picture: Callable[[Any], str] | None = None,
    missing: Mapping[str, str] = MappingProxyType({}),
    **units: Unit,
) -> Callable[[Kind], Kind]:
    """Give a result, a dataclass or a named tuple, a short ``repr`` and a table in notebooks.

    ``units`` are those of its fields, or the codes that stand there; a stiffness, a virtual damping and a status need
    none. ``only`` are the fields that are shown, all where left out; ``missing`` says by field why one is NaN;
    ``picture`` draws what stands below the table, as HTML.
    """

    def decorate(kind: Kind) -> Kind:
        names = only or getattr(kind, "_fields", None) or tuple(getattr(kind, "__dataclass_fields__", ()))

        known = _USUAL | units

        def spell(self: Any) -> dict[str, str]:
            texts = {name: spell_value(getattr(self, name), known.get(name, "")) for name in names}
            return {
                name: f"{text}{',' if text == 'NaN' else '; NaN:'} {missing[name]}"
                if name in missing and "NaN" in text
                else text
                for name, text in texts.items()
            }

        def as_text(self: Any) -> str:
            parts = [f"{name}={text}" for name, text in spell(self).items()]
            line = f"{kind.__name__}({', '.join(parts)})"
            return line if len(line) <= _LINE else f"{kind.__name__}(\n    " + ",\n    ".join(parts) + ",\n)"

        def as_html(self: Any) -> str:
            columns, below = {name: getattr(self, name) for name in names}, picture(self) if picture else ""
            if _is_table(columns.values()):
                cells = [
                    [spell_value(each, known.get(name, "")) for each in column] for name, column in columns.items()
                ]
                return write_table(kind.__name__, list(zip(*cells, strict=True)), names) + below
            return write_table(kind.__name__, spell(self).items()) + below

        for name, method in (("__repr__", as_text), ("_repr_html_", as_html)):
            setattr(kind, name, in_own_units(method))
        _add_rotary(kind)
        return kind

    return decorate


class ResultList(list[Any]):
    """List of `shown` results, displayed as tables in notebooks."""

    def _repr_html_(self) -> str:
        return "\n".join(each._repr_html_() for each in self)


def _add_rotary(kind: Any) -> None:
    """Let results made for a rotary device keep its units: they are of a class below, ``kind.InRotaryUnits``."""
    name, plain_new = "InRotaryUnits", kind.__new__
    below = type(name, (kind,), {"__slots__": (), "__module__": kind.__module__, "in_rotary_units": True})
    # As pickle finds it.
    below.__qualname__ = f"{kind.__qualname__}.{name}"
    wrap_methods(below, of=kind)

    def make(cls: type, *args: Any, **kwargs: Any) -> Any:
        chosen = below if cls is kind and is_rotary() else cls
        return object.__new__(chosen) if plain_new is object.__new__ else plain_new(chosen, *args, **kwargs)

    kind.__new__, kind.in_rotary_units = make, False
    setattr(kind, name, below)


def spell_value(value: Any, unit: Unit = "") -> str:
    """A value in few characters; of an array its shape, its range and how much of it is NaN."""
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
        # What JAX traces, and ragged lists.
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
    """One number with its unit, or the name of a code."""
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
    # Most stiffnesses are the largest of which something holds.
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
