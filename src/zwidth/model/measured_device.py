"""Device defined by its measured frequency response, from commanded force to sampled position, without a model.

Each measured frequency is called a *line*. Responses are read from text tables and from files of NumPy and MATLAB
(`zwidth.io.tables`). The columns are the frequency in Hz or rad/s; the response as real and imaginary part, as
magnitude and phase, or as complex numbers; and optionally the deviation, a radius around the response at each frequency
that contains the true response.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.core.errors import InputError
from zwidth.io.files import write_atomically
from zwidth.io.tables import read_columns
from zwidth.model.linear_device import ResponseDevice
from zwidth.units.formatting import suggestion
from zwidth.units.parsing import ANGLE, FORCE, LENGTH, RATE, Dimension, split_head

_MIN_LINES = 8  # smallest number of frequencies that define a curve
SUFFIXES = (".csv", ".txt", ".dat", ".npz", ".mat")  # suffixes of files that contain a measured response
# Accepted names of each column, in lower case.
_NAMES = {
    "frequency": ("frequency", "freq", "f", "omega", "w", "angular frequency"),
    "real": ("real", "re", "real part"),
    "imag": ("imag", "im", "imaginary", "imaginary part"),
    "magnitude": ("magnitude", "mag", "gain", "amplitude", "abs", "modulus"),
    "phase": ("phase", "arg", "angle"),
    "response": ("response", "complex", "frf", "g", "h"),
    "deviation": ("deviation", "radius", "uncertainty"),
}
_TURN = 2.0 * math.pi  # rad per revolution
# Physical dimensions of the columns, with their accepted units.
_FREQUENCY = Dimension(RATE.names, RATE.example, {"rad/s": 1.0 / _TURN, "1/s": 1.0 / _TURN, "krad/s": 1e3 / _TURN})
_COMPLIANCE = Dimension(", ".join(f"{length}/{force}" for length in LENGTH.units for force in FORCE.units), "1 mm/N")
_ANGULAR_COMPLIANCE = Dimension("rad/(N m), rad/(mN m), mrad/(N m), mrad/(mN m), deg/(N m), deg/(mN m)", "1 rad/(N m)")
# Pattern of decibels with an optional reference unit, as in "dB", "dB re 1 m/N" or "dB (mm/N)".
_DECIBELS = re.compile(r"dB(?:\s*(?:\(?re\.?\s*)?(?:1\s*)?(m\s*/\s*N|mm\s*/\s*N|um\s*/\s*N|µm\s*/\s*N)\)?)?")


@dataclass(frozen=True, eq=False)
class MeasuredDevice(ResponseDevice):
    """A device defined by its frequency response from commanded force to sampled position.

    The response is the ratio X/U of the position that the control program reads to the force that it commands, at the
    sampling rate of the controller. It includes hold, amplifier, mechanics, encoder and all delays. The convention is
    ``z = e^(+j 2 pi f T)``, so that a lag has a negative phase.

    Args:
        frequency: at least 8 frequencies in Hz, increasing, > 0 and below the Nyquist frequency of the controller.
        response: complex response in m/N, one value per frequency.
        deviation: radius in m/N around the response that contains the true response, one value or one per frequency.
            Results then hold for all responses within the radius. None if the response is exact.
        rotary: True if the response is from torque to angle. Response and deviation are then in rad/(N m).

    Raises:
        InputError: the frequencies are not increasing or too few, a value is not finite, or shapes differ.

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
                raise InputError(
                    f"{name}: got {values.size} values for {f.size} frequencies; pass one value per frequency"
                )
        if f.size < _MIN_LINES:
            raise InputError(f"frequency: got {f.size} frequencies; at least {_MIN_LINES} are needed; measure more")
        if f[0] <= 0:
            raise InputError(f"frequency: got {f[0]:g} Hz; frequencies must be > 0; omit the mean value (0 Hz)")
        decreasing = np.flatnonzero(np.diff(f) <= 0)
        if decreasing.size:
            k = int(decreasing[0])
            raise InputError(
                f"frequency: got {f[k + 1]:g} Hz after {f[k]:g} Hz; frequencies must increase; sort them and remove "
                "duplicates"
            )
        if not np.any(g):
            raise InputError("response: got 0 at every frequency; check the column of the position")
        if r is not None and r.min() < 0:
            raise InputError(f"deviation: got {r.min():g} m/N; it must be >= 0")
        for name, values in {"frequency": f, "response": g, "deviation": r}.items():
            if values is not None:
                values.flags.writeable = False
            object.__setattr__(self, name, values)

    def __eq__(self, other: object) -> bool:
        """Return whether two devices have the same frequencies, responses, deviations and kind, linear or rotary."""
        return isinstance(other, MeasuredDevice) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __repr__(self) -> str:
        return f"MeasuredDevice({self.spell().partition(', ')[2]})"

    def spell(self) -> str:
        """Return a one-line description of the response."""
        f, band = self.frequency, "" if self.deviation is None else ", with deviation"
        band += " of a rotary device" if self.rotary else ""
        return f"measured response, {f.size} lines from {f[0]:g} to {f[-1]:g} Hz{band}"

    @property
    def _key(self) -> tuple[bytes, ...]:
        """Frequencies, responses, deviations and kind of device as bytes, for comparisons and hashes."""
        parts = (self.frequency, self.response, self.deviation)
        return (*(b"" if part is None else part.tobytes() for part in parts), bytes([self.rotary]))

    @property
    def mass(self) -> float:
        """The unit of mass of normalized walls in kg: the median of the apparent mass ``1/(|G| w^2)`` over frequency.

        It is not an estimate of the mass of the device.
        """
        return 1.0 / float(np.median(np.abs(self.response) * (2.0 * np.pi * self.frequency) ** 2))

    @classmethod
    def read(cls, file: str | Path) -> MeasuredDevice:
        """Read a table of frequencies and responses, with units in the column names.

        The columns are ``frequency [Hz]`` or ``[rad/s]``; then ``real [m/N]`` and ``imag [m/N]``, or ``magnitude`` in
        m/N, mm/N, um/N or dB and ``phase`` in deg or rad, or ``response`` with complex numbers; and optionally
        ``deviation [m/N]``. Units rad/(N m) or deg/(N m) instead of m/N define a rotary device.

        Args:
            file: text file with commas, semicolons, tabs or blanks between columns, possibly with a preamble or a line
                of units, and possibly compressed by gzip; or a file ``.npz`` or ``.mat``.
        """
        return cls(*_read_table(file))

    def save(self, file: str | Path, *remarks: str) -> None:
        """Write the response to a text file for `read`, in full precision, after comment lines with ``remarks``."""
        unit = "rad/(N m)" if self.rotary else "m/N"
        heads = ["frequency [Hz]", f"real [{unit}]", f"imag [{unit}]"]
        columns = [self.frequency, np.real(self.response), np.imag(self.response)]
        if self.deviation is not None:
            heads, columns = [*heads, f"deviation [{unit}]"], [*columns, self.deviation]
        lines = [f"# {remark}" for remark in remarks] + [",".join(heads)]
        lines += [",".join(repr(float(value)) for value in line) for line in zip(*columns, strict=True)]
        write_atomically(Path(file), ("\n".join(lines) + "\n").encode())


def _as_line(name: str, values: Any, kind: type) -> np.ndarray:
    """Return a copy of the values as a one-dimensional array of finite numbers, one per frequency.

    Args:
        name: name of the argument, for messages.
        values: the values.
        kind: float or complex.

    Raises:
        InputError: the values are not numbers, not finite, or not one-dimensional.
    """
    try:
        with np.errstate(all="ignore"):
            array = np.array(values)
            array = array.astype(kind, casting="safe" if array.dtype.kind in "iufcb" else "unsafe")
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name}: got {type(values).__name__}; it must be a list of {kind.__name__} numbers") from None
    if array.ndim != 1:
        raise InputError(f"{name}: got shape {array.shape}; it must be a list of numbers, one per frequency")
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise InputError(
            f"{name}: got {bad.size} values that are not finite, first at index {bad[0]}; omit these lines"
        )
    return array


def _read_table(file: str | Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, bool]:
    """Read a table of a frequency response.

    Returns:
        The frequencies in Hz; the response and its deviation in m/N, or in rad/(N m) for a rotary device; and whether
        the device is rotary. The deviation is None if the table has no such column.

    Raises:
        InputError: a column is missing, or a unit is unknown.
    """
    file = Path(file)
    table = read_columns(file)
    heads = [split_head(head) for head in table.heads]
    indices: dict[str, int] = {}
    for name, names in _NAMES.items():
        matches = [k for k, (head, _) in enumerate(heads) if head.lower() in names]
        if len(matches) > 1:
            raise InputError(
                f"{file}: got several columns for {name}: {', '.join(table.heads[k] for k in matches)}; rename one"
            )
        indices |= {name: matches[0]} if matches else {}
    parts = next(
        (p for p in (("real", "imag"), ("magnitude", "phase"), ("response",)) if set(p) <= indices.keys()), None
    )
    if "frequency" not in indices or parts is None:
        got = table.nameless or f"{file}: got the columns {', '.join(map(repr, table.heads))}"
        raise InputError(
            f"{got}; required are 'frequency [Hz]' and 'real [m/N]' with 'imag [m/N]', or 'magnitude [m/N]' with "
            "'phase [deg]', or 'response [m/N]'"
        )
    names = [name for name in ("frequency", *parts, "deviation") if name in indices and name != "response"]
    columns = dict(zip(names, table.numbers([indices[name] for name in names]), strict=True))
    units = {name: heads[k][1] for name, k in indices.items()}
    hertz = columns["frequency"] * _size(file, "frequency", units["frequency"], _FREQUENCY, _FREQUENCY.units)
    scale, rotary = _compliance(file, parts[0], units[parts[0]])
    if parts[0] == "magnitude":
        size = columns["magnitude"]
        size = 10.0 ** (size / 20.0) if units["magnitude"].lower().startswith("db") else size
        response = size * np.exp(1j * columns["phase"] * _size(file, "phase", units["phase"], ANGLE, ("deg", "rad")))
    elif parts[0] == "response":
        (response,) = table.numbers([indices["response"]], complex)
    else:
        response = columns["real"] + 1j * columns["imag"]
    if parts[0] == "real" and _compliance(file, "imag", units["imag"]) != (scale, rotary):
        raise InputError(f"{file}: real and imag have different units; write both in the same unit")
    band = None
    if "deviation" in columns:
        size, deviation_rotary = _compliance(file, "deviation", units["deviation"])
        if deviation_rotary != rotary:
            raise InputError(f"{file}: response and deviation mix linear and rotary units; use one unit for both")
        band = columns["deviation"] * size
    return hertz, response * scale, band, rotary


def _size(file: Path, name: str, unit: str, dimension: Dimension, allowed: tuple[str, ...]) -> float:
    """Return the factor that converts the unit of a column to SI; raise `InputError` for an unknown or missing unit.

    Args:
        file: path of the table, for messages.
        name: name of the column.
        unit: unit of the column; "" if its header has none.
        dimension: dimension of the column.
        allowed: usual units of the column, for messages.
    """
    size = dimension.in_base("1", 0, unit) if unit else None
    if size is None:
        remedy = suggestion(unit, allowed, f"write one of {', '.join(allowed)} in brackets after the name")
        raise InputError(f"{file}: got {unit or 'no unit'} for column {name}; {remedy}")
    return size


def _compliance(file: Path, name: str, unit: str) -> tuple[float, bool]:
    """Return the factor that converts a unit of compliance to m/N or rad/(N m), and whether the unit is rotary.

    Args:
        file: path of the table, for messages.
        name: name of the column; only "magnitude" may be in decibels.
        unit: unit of the column. For decibels, the factor is that of the reference unit, m/N by default.
    """
    decibels = _DECIBELS.fullmatch(unit) if name == "magnitude" else None
    unit = (decibels[1] if decibels else unit) or "m/N"
    angular = _ANGULAR_COMPLIANCE.in_base("1", 0, unit)
    if angular is not None:
        return angular, True
    allowed = ("m/N", "mm/N", "um/N", "rad/(N m)", "deg/(N m)", *(("dB",) if name == "magnitude" else ()))
    return _size(file, name, unit, _COMPLIANCE, allowed), False
