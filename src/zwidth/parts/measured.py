"""A device by its measured frequency response: what a controller reads of what it commands, and no model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.parts.linear_device import WholeDevice
from zwidth.parts.response_table import ResponseTable, read_response_table, write_response_table
from zwidth.words.errors import InputError

# Fewer lines show no curve.
_FEWEST = 8


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
        return f"measured response, {f.size} lines from {f[0]:g} to {f[-1]:g} Hz{band}"

    @property
    def _key(self) -> tuple[bytes, ...]:
        parts = (self.frequency, self.response, self.deviation)
        return tuple(b"" if part is None else part.tobytes() for part in parts)

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
                ``response``; and, where it is known, ``deviation [m/N]``.
        """
        return cls(*read_response_table(file))

    def save(self, file: str | Path, *remarks: str) -> None:
        """Write the table that `read` reads; remarks become its first lines, behind a #."""
        write_response_table(file, ResponseTable(self.frequency, self.response, self.deviation), remarks)


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
