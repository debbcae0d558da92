"""Devices with published parameters, each parameter with its source.

The equations of a rotary device are those of a linear one in other units: its ``mass`` is the inertia J in kg m^2, its
``damping`` is in N m s/rad, and the walls of its loop are in N m/rad and N m s/rad.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

from zwidth.parts.device import Device
from zwidth.parts.linear_device import LinearDevice
from zwidth.parts.measured import SUFFIXES, MeasuredDevice
from zwidth.parts.operator import Operator
from zwidth.parts.timing import Timing
from zwidth.words.errors import InputError, describe_choice
from zwidth.words.formatting import with_unit

__all__ = ["DEVICES", "HAND", "KnownDevice", "KnownHand", "Published", "find_device"]


def __dir__() -> list[str]:
    """Its own names, and not those that it imports."""
    return sorted(__all__)


class Published(NamedTuple):
    """One parameter with its unit, its source, and a note on its use."""

    value: float
    unit: str
    source: str
    note: str = ""

    def spell(self) -> str:
        """Return the value with its unit."""
        if self.unit in ("counts", "periods"):
            return f"{self.value:g} {self.unit.removesuffix('s') if self.value == 1 else self.unit}"
        return with_unit(self.value, self.unit, 3)


@dataclass(frozen=True)
class KnownDevice:
    """Published parameters of one device; unpublished ones are None.

    Attributes:
        name: the name in `find_device` and on the command line.
        title: the name in texts.
        motion: "linear" or "rotary"; determines the units of all other fields.
        mass: in kg, or the inertia in kg m^2.
        damping: viscous, in N s/m or N m s/rad.
        friction: Coulomb friction in N or N m.
        resolution: one step of the position sensor, in m or rad.
        counts: counts of the encoder on the motor shaft; the transmission is not published with them.
        period: sampling period in s of the loop in which the device was measured or used.
        delay: delay of that loop from a sample to its force, in s or in periods.
        force: largest force, in N.
        stiffness_limit: largest stiffness in use, in N/m, from a library or notes; not a measured boundary.
        damping_limit: largest virtual damping in use, in N s/m, likewise.
    """

    name: str
    title: str
    motion: Literal["linear", "rotary"] = "linear"
    mass: Published | None = None
    damping: Published | None = None
    friction: Published | None = None
    resolution: Published | None = None
    counts: Published | None = None
    period: Published | None = None
    delay: Published | None = None
    force: Published | None = None
    stiffness_limit: Published | None = None
    damping_limit: Published | None = None

    def __repr__(self) -> str:
        """Return the name and the parameters, without sources."""
        numbers = [f"{name}={number.spell()}" for name, number in self.numbers.items()]
        return f"KnownDevice({', '.join([self.name, *numbers])})"

    @property
    def rotary(self) -> bool:
        """True for a rotary device."""
        return self.motion == "rotary"

    @property
    def numbers(self) -> dict[str, Published]:
        """The published parameters by name."""
        return {
            field.name: found for field in fields(self) if isinstance(found := getattr(self, field.name), Published)
        }

    def to_device(self, *, mass: Any = None, damping: Any = None) -> Device:
        """Return a `zwidth.Device` with the published mass and damping.

        For a rotary device ``Device.mass`` holds the inertia in kg m^2 and ``Device.damping`` N m s/rad, and every
        stiffness and virtual damping of such a scene is in N m/rad and N m s/rad.

        Args:
            mass: mass that replaces the published one; required if none is published.
            damping: damping, likewise; 0 is the cautious value, because no stable wall was found that more physical
                damping makes unstable.

        Raises:
            InputError: mass or damping is neither published nor given.

        Example:
            >>> import zwidth
            >>> zwidth.devices.find_device("haptic_wheel").to_device()
            Device(mass=0.00045, damping=0.0013, rotary=True)
        """
        numbers = {"mass": self._chosen("mass", mass), "damping": self._chosen("damping", damping)}
        return Device(**numbers, rotary=self.rotary)

    def to_timing(self, *, period: Any = None, rate: Any = None, delay: Any = None) -> Timing:
        """Return a `zwidth.Timing` with the published period and delay; the delay is 0 if none is published.

        Args:
            period: sampling period that replaces the published one; required if neither ``rate`` nor a published
                period is available.
            rate: sampling rate, in place of ``period``.
            delay: delay that replaces the published one. A delay published in periods stays in periods.

        Raises:
            InputError: no period is published, and neither ``period`` nor ``rate`` is passed.

        Example:
            >>> import zwidth
            >>> zwidth.devices.find_device("phantom_2006").to_timing(rate="2 kHz")
            Timing(period=0.0005, delay='1 periods')
        """
        if delay is None and self.delay is not None:
            delay = f"{self.delay.value!r} periods" if self.delay.unit == "periods" else self.delay.value
        if period is None and rate is None:
            period = self._chosen("period", None)
        return Timing(period=period, rate=rate, delay=0.0 if delay is None else delay)

    def list_missing(self, given: Collection[str]) -> list[str]:
        """Return the parameters, out of mass and damping, that are neither published nor in ``given``."""
        return [name for name in ("mass", "damping") if name not in given and getattr(self, name) is None]

    def _chosen(self, name: str, given: Any) -> Any:
        if given is not None:
            return given
        found = getattr(self, name)
        if found is None:
            known = ", ".join(self.numbers)
            raise InputError(
                f"{name}: none is published for {self.name!r} (published are {known}); give one of your own"
            )
        return found.value

    def as_dict(self) -> dict[str, Any]:
        """Return JSON values; null for unpublished parameters."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value._asdict() if isinstance(value, Published) else value for name, value in values.items()}


@dataclass(frozen=True)
class KnownHand:
    """Measured mass (kg), damping (N s/m) and stiffness (N/m) to ground of one hand."""

    name: str
    title: str
    mass: Published
    damping: Published
    stiffness: Published

    def to_operator(self) -> Operator:
        """Return a `zwidth.Operator` with a rigid grasp; add a spring by `dataclasses.replace`.

        Example:
            >>> import zwidth
            >>> zwidth.devices.HAND.to_operator().mass
            0.554
        """
        return Operator(self.mass.value, self.damping.value, self.stiffness.value)


def _read_published() -> tuple[tuple[KnownDevice, ...], KnownHand]:
    """Return the devices and the hand in ``published.json``."""
    known = json.loads(Path(__file__).with_name("published.json").read_text(encoding="utf-8"))

    def spell_out(entry: dict[str, Any]) -> dict[str, Any]:
        """Return an entry with its parameters as `Published`, with the sources in place of their keys."""
        return {
            name: Published(value[0], value[1], known["sources"][value[2]], *value[3:])
            if isinstance(value, list)
            else value
            for name, value in entry.items()
        }

    return tuple(KnownDevice(**spell_out(entry)) for entry in known["devices"]), KnownHand(**spell_out(known["hand"]))


DEVICES, HAND = _read_published()
"""All devices, those with measured parameters first; and a hand for `zwidth.Scene(..., operator=...)`."""


def find_device(name: str) -> KnownDevice:
    """Return the published device with a name.

    Args:
        name: name of a device in `zwidth.devices.DEVICES`, as listed by ``zwidth devices``.

    Raises:
        InputError: no device has this name.

    References:
        Each parameter contains its source.

    Example:
        >>> import zwidth
        >>> wheel = zwidth.devices.find_device("haptic_wheel")
        >>> wheel.damping.value, wheel.damping.unit, wheel.friction
        (0.0013, 'N m s/rad', None)
    """
    for device in DEVICES:
        if device.name == name:
            return device
    raise InputError(f"device: {describe_choice(name, tuple(device.name for device in DEVICES))}")


def read_device(text: str) -> KnownDevice | LinearDevice | MeasuredDevice:
    """A device as the command line names it: published, by its transfer function, or by a table of its response.

    Args:
        text: a name that `find_device` knows, ``"NUMERATOR / DENOMINATOR"`` with coefficients in s, highest power
            first, or the name of a file as `zwidth.MeasuredDevice.read` takes it.
    """
    if text.endswith(SUFFIXES):
        return MeasuredDevice.read(text)
    return LinearDevice(text) if "/" in text else find_device(text)
