"""Tables of a frequency response as analyzers and programs write them, in SI units.

Texts, or arrays of NumPy and MATLAB, as `zwidth.words.tables` reads them. One column is the frequency, in Hz or rad/s;
the response stands as real and imaginary part, as magnitude and phase, or as complex numbers in one column; a column of
its deviation may follow.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zwidth.words.errors import InputError
from zwidth.words.formatting import suggestion
from zwidth.words.tables import read_columns, split_head
from zwidth.words.units import ANGLE, FORCE, LENGTH, RATE, Dimension

# How the names of files end that hold one.
SUFFIXES = (".csv", ".txt", ".dat", ".npz", ".mat")
# What each column may be called.
_NAMES = {
    "frequency": ("frequency", "freq", "f", "omega", "w", "angular frequency"),
    "real": ("real", "re", "real part"),
    "imag": ("imag", "im", "imaginary", "imaginary part"),
    "magnitude": ("magnitude", "mag", "gain", "amplitude", "abs", "modulus"),
    "phase": ("phase", "arg", "angle"),
    "response": ("response", "complex", "frf", "g", "h"),
    "deviation": ("deviation", "radius", "uncertainty"),
}
_TURN = 2.0 * math.pi
_FREQUENCY = Dimension(RATE.powers, RATE.example, {"rad/s": 1.0 / _TURN, "1/s": 1.0 / _TURN, "krad/s": 1e3 / _TURN})
_COMPLIANCE = Dimension(
    {f"{length}/{force}": p - q for length, p in LENGTH.powers.items() for force, q in FORCE.powers.items()}, "1 mm/N"
)
_DECIBELS = re.compile(r"dB(?:\s*(?:\(?re\.?\s*)?(?:1\s*)?(m\s*/\s*N|mm\s*/\s*N|um\s*/\s*N|µm\s*/\s*N)\)?)?")


class ResponseTable(NamedTuple):
    """A frequency response: Hz, m/N, and its deviation in m/N, or None."""

    frequency: np.ndarray
    response: np.ndarray
    deviation: np.ndarray | None


def read_response_table(file: str | Path) -> ResponseTable:
    """Read a table; raise `InputError` for columns or units that cannot be told, with what is allowed."""
    file = Path(file)
    table = read_columns(file)
    heads = [split_head(head) for head in table.heads]
    found: dict[str, int] = {}
    for name, known in _NAMES.items():
        places = [k for k, (head, _) in enumerate(heads) if head.lower() in known]
        if len(places) > 1:
            raise InputError(f"{file}: {name} may be any of {', '.join(table.heads[k] for k in places)}; rename one")
        found |= {name: places[0]} if places else {}
    parts = next((p for p in (("real", "imag"), ("magnitude", "phase"), ("response",)) if set(p) <= found.keys()), None)
    if "frequency" not in found or parts is None:
        got = table.nameless or f"{file}: got the columns {', '.join(map(repr, table.heads))}"
        raise InputError(
            f"{got}; needed are 'frequency [Hz]' and 'real [m/N]' with 'imag [m/N]', or 'magnitude [m/N]' with 'phase "
            "[deg]', or 'response [m/N]'"
        )
    names = [name for name in ("frequency", *parts, "deviation") if name in found and name != "response"]
    columns = dict(zip(names, table.numbers([found[name] for name in names]), strict=True))
    units = {name: heads[at][1] for name, at in found.items()}
    hertz = columns["frequency"] * _size(file, "frequency", units["frequency"], _FREQUENCY, _FREQUENCY.units)
    scale = _compliance(file, parts[0], units[parts[0]])
    if parts[0] == "magnitude":
        size = columns["magnitude"]
        size = 10.0 ** (size / 20.0) if units["magnitude"].lower().startswith("db") else size
        answer = size * np.exp(1j * columns["phase"] * _size(file, "phase", units["phase"], ANGLE, ("deg", "rad")))
    elif parts[0] == "response":
        (answer,) = table.numbers([found["response"]], complex)
    else:
        answer = columns["real"] + 1j * columns["imag"]
    if parts[0] == "real" and _compliance(file, "imag", units["imag"]) != scale:
        raise InputError(f"{file}: real and imag have different units; write both in one")
    band = None
    if "deviation" in columns:
        band = columns["deviation"] * _compliance(file, "deviation", units["deviation"])
    return ResponseTable(hertz, answer * scale, band)


def write_response_table(file: str | Path, table: ResponseTable, remarks: tuple[str, ...] = ()) -> None:
    """Write a table that `read_response_table` reads back, with every digit."""
    heads = ["frequency [Hz]", "real [m/N]", "imag [m/N]"]
    columns = [table.frequency, np.real(table.response), np.imag(table.response)]
    if table.deviation is not None:
        heads, columns = [*heads, "deviation [m/N]"], [*columns, table.deviation]
    lines = [f"# {remark}" for remark in remarks] + [",".join(heads)]
    lines += [",".join(repr(float(value)) for value in line) for line in zip(*columns, strict=True)]
    Path(file).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _size(file: Path, name: str, unit: str, dimension: Dimension, known: tuple[str, ...]) -> float:
    """What one of a unit is in the SI unit."""
    size = dimension.in_base("1", 0, unit) if unit else None
    if size is None:
        remedy = suggestion(unit, known, f"write one of {', '.join(known)} in brackets behind the name")
        raise InputError(f"{file}: {name} in {unit or 'no unit'}; {remedy}")
    return size


def _compliance(file: Path, name: str, unit: str) -> float:
    """What one of a unit of length over force is in m/N; of decibels the unit that they are over."""
    decibels = _DECIBELS.fullmatch(unit) if name == "magnitude" else None
    known = ("m/N", "mm/N", "um/N", *(("dB",) if name == "magnitude" else ()))
    return _size(file, name, (decibels[1] if decibels else unit) or "m/N", _COMPLIANCE, known)
