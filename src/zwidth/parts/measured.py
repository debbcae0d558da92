"""A device by its measured frequency response: what a controller reads of what it commands, and no model.

Its tables are texts, or arrays of NumPy and MATLAB, as `zwidth.words.tables` reads them. A column is the frequency, in
Hz or rad/s; the response stands as real and imaginary part, as magnitude and phase, or as complex numbers in one; a
column of its deviation may follow.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.parts.linear_device import WholeDevice
from zwidth.words.errors import InputError
from zwidth.words.files import write_whole
from zwidth.words.formatting import suggestion
from zwidth.words.tables import read_columns
from zwidth.words.units import ANGLE, FORCE, LENGTH, RATE, Dimension, split_head

# Fewer lines show no curve.
_FEWEST = 8
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
_FREQUENCY = Dimension(RATE.names, RATE.example, {"rad/s": 1.0 / _TURN, "1/s": 1.0 / _TURN, "krad/s": 1e3 / _TURN})
_COMPLIANCE = Dimension(", ".join(f"{length}/{force}" for length in LENGTH.units for force in FORCE.units), "1 mm/N")
_ANGULAR_COMPLIANCE = Dimension("rad/(N m), rad/(mN m), mrad/(N m), mrad/(mN m), deg/(N m), deg/(mN m)", "1 rad/(N m)")
_DECIBELS = re.compile(r"dB(?:\s*(?:\(?re\.?\s*)?(?:1\s*)?(m\s*/\s*N|mm\s*/\s*N|um\s*/\s*N|µm\s*/\s*N)\)?)?")


@dataclass(frozen=True, eq=False)
class MeasuredDevice(WholeDevice):
    """A frequency response from commanded force to sampled position, at the controller's own rate.

    Hold, amplifier, mechanics, encoder and every delay are in it: the ratio of the position that the program reads to
    the force that it commands, ``G*(e^(j 2 pi f T)) = X/U`` with ``z^k = e^(+j 2 pi f k T)``, so that a lag has a
    negative phase.

    Args:
        frequency: of the lines in Hz, growing, > 0 and below half the controller's rate; 8 or more.
        response: complex, in m/N, one for each line.
        deviation: the radius in m/N, of each line or of all, in which the true response lies; None where it is taken as
            it stands. With one, answers hold for every response in the band.
        rotary: True if the response is from a torque to an angle. Response and deviation are then in rad/(N m).

    Raises:
        InputError: lines do not grow, there are too few, a number is not finite, shapes differ.

    References:
        Pintelon, Schoukens 2012, System Identification: A Frequency Domain Approach, chapter 2.

    Example:
        >>> import numpy as np
        >>> import zwidth
        >>> f = np.geomspace(1, 400, 300)
        >>> z = np.exp(2j * np.pi * f * 1e-3)
        >>> device = zwidth.MeasuredDevice(f, 5e-6 * (z + 1) / (z * (z - 1) ** 2), deviation=1e-8)
        >>> f"{device.mass:.3f} kg, {device.frequency.size} lines"
        '0.100 kg, 300 lines'
    """

    frequency: Any
    response: Any
    deviation: Any = None
    rotary: bool = False

    def __post_init__(self) -> None:
        f, g = _as_line("frequency", self.frequency, float), _as_line("response", self.response, complex)
        r = self.deviation
        if r is not None:
            r = _as_line("deviation", np.broadcast_to(r, f.shape) if np.ndim(r) == 0 else r, float)
        for name, values in {"response": g, "deviation": r}.items():
            if values is not None and values.shape != f.shape:
                raise InputError(f"{name}: got {values.size} numbers for {f.size} frequencies; give one a frequency")
        if f.size < _FEWEST:
            raise InputError(f"frequency: got {f.size} lines; at least {_FEWEST} are needed to show a curve")
        if f[0] <= 0:
            raise InputError(f"frequency: got {f[0]:g} Hz; lines must be > 0: leave out the mean position")
        falls = np.flatnonzero(np.diff(f) <= 0)
        if falls.size:
            k = int(falls[0])
            raise InputError(f"frequency: {f[k + 1]:g} Hz follows on {f[k]:g} Hz; sort the lines, drop double ones")
        if not np.any(g):
            raise InputError("response: it is 0 at every frequency; check the column of the position")
        if r is not None and r.min() < 0:
            raise InputError(f"deviation: got {r.min():g} m/N; a radius is at least 0")
        for name, values in {"frequency": f, "response": g, "deviation": r}.items():
            if values is not None:
                values.flags.writeable = False
            object.__setattr__(self, name, values)

    def __eq__(self, other: object) -> bool:
        """Whether all numbers are the same."""
        return isinstance(other, MeasuredDevice) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __repr__(self) -> str:
        return f"MeasuredDevice({self.spell().partition(', ')[2]})"

    def spell(self) -> str:
        """What it is, in words."""
        f, band = self.frequency, "" if self.deviation is None else ", with deviation"
        band += " of a rotary device" if self.rotary else ""
        return f"measured response, {f.size} lines from {f[0]:g} to {f[-1]:g} Hz{band}"

    @property
    def _key(self) -> tuple[bytes, ...]:
        parts = (self.frequency, self.response, self.deviation)
        return (*(b"" if part is None else part.tobytes() for part in parts), bytes([self.rotary]))

    @property
    def mass(self) -> float:
        """The mass in kg that moves as far in the middle of the band: the unit of normalized walls, no estimate."""
        return 1.0 / float(np.median(np.abs(self.response) * (2.0 * np.pi * self.frequency) ** 2))

    @classmethod
    def read(cls, file: str | Path) -> MeasuredDevice:
        """Read a table of frequency and response with units in the names of its columns.

        Args:
            file: a text with commas, semicolons, tabs or blanks, a preamble or a line of units, packed or not; ``.npz``
                or ``.mat``. With a column ``frequency [Hz]`` or ``[rad/s]``; and ``real [m/N]`` and ``imag [m/N]``, or
                ``magnitude`` in m/N, mm/N, um/N or dB and ``phase`` in deg or rad, or complex numbers under
                ``response``; and, where it is known, ``deviation [m/N]``. Units of rad/(N m) or deg/(N m) in place of
                m/N define a rotary device.
        """
        return cls(*_read_table(file))

    def save(self, file: str | Path, *remarks: str) -> None:
        """Write the table that `read` reads, with every digit; remarks become its first lines, behind a #."""
        unit = "rad/(N m)" if self.rotary else "m/N"
        heads = ["frequency [Hz]", f"real [{unit}]", f"imag [{unit}]"]
        columns = [self.frequency, np.real(self.response), np.imag(self.response)]
        if self.deviation is not None:
            heads, columns = [*heads, f"deviation [{unit}]"], [*columns, self.deviation]
        lines = [f"# {remark}" for remark in remarks] + [",".join(heads)]
        lines += [",".join(repr(float(value)) for value in line) for line in zip(*columns, strict=True)]
        write_whole(Path(file), ("\n".join(lines) + "\n").encode())


def _as_line(name: str, values: Any, kind: type) -> np.ndarray:
    """A copy as one line of finite numbers."""
    try:
        with np.errstate(all="ignore"):
            line = np.array(values)
            line = line.astype(kind, casting="safe" if line.dtype.kind in "iufcb" else "unsafe")
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name}: got {type(values).__name__} that holds no {kind.__name__} numbers") from None
    if line.ndim != 1:
        raise InputError(f"{name}: got shape {line.shape}; a list of numbers, one a frequency, is needed")
    bad = np.flatnonzero(~np.isfinite(line))
    if bad.size:
        raise InputError(
            f"{name}: {bad.size} numbers are not finite, the first is number {bad[0]}; leave the lines out"
        )
    return line


def _read_table(file: str | Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, bool]:
    """Read a table of a frequency response.

    Returns:
        The frequencies in Hz; the response and its deviation in m/N, or in rad/(N m) for a rotary device, with None for
        the deviation if the table has none; and whether the device is rotary.

    Raises:
        InputError: a column is missing, or a unit is unknown.
    """
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
    scale, rotary = _compliance(file, parts[0], units[parts[0]])
    if parts[0] == "magnitude":
        size = columns["magnitude"]
        size = 10.0 ** (size / 20.0) if units["magnitude"].lower().startswith("db") else size
        answer = size * np.exp(1j * columns["phase"] * _size(file, "phase", units["phase"], ANGLE, ("deg", "rad")))
    elif parts[0] == "response":
        (answer,) = table.numbers([found["response"]], complex)
    else:
        answer = columns["real"] + 1j * columns["imag"]
    if parts[0] == "real" and _compliance(file, "imag", units["imag"]) != (scale, rotary):
        raise InputError(f"{file}: real and imag have different units; write both in one")
    band = None
    if "deviation" in columns:
        size, turns = _compliance(file, "deviation", units["deviation"])
        if turns != rotary:
            raise InputError(f"{file}: response and deviation mix linear and rotary units; use one unit for both")
        band = columns["deviation"] * size
    return hertz, answer * scale, band, rotary


def _size(file: Path, name: str, unit: str, dimension: Dimension, known: tuple[str, ...]) -> float:
    """What one of a unit is in the SI unit."""
    size = dimension.in_base("1", 0, unit) if unit else None
    if size is None:
        remedy = suggestion(unit, known, f"write one of {', '.join(known)} in brackets behind the name")
        raise InputError(f"{file}: {name} in {unit or 'no unit'}; {remedy}")
    return size


def _compliance(file: Path, name: str, unit: str) -> tuple[float, bool]:
    """Return the factor that converts a unit of compliance to m/N or rad/(N m), and whether the unit is rotary.

    For decibels the factor is that of the reference unit, m/N by default.
    """
    decibels = _DECIBELS.fullmatch(unit) if name == "magnitude" else None
    unit = (decibels[1] if decibels else unit) or "m/N"
    angular = _ANGULAR_COMPLIANCE.in_base("1", 0, unit)
    if angular is not None:
        return angular, True
    known = ("m/N", "mm/N", "um/N", "rad/(N m)", "deg/(N m)", *(("dB",) if name == "magnitude" else ()))
    return _size(file, name, unit, _COMPLIANCE, known), False
