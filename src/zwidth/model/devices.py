"""Catalog of devices and of a hand with published parameters, each parameter with its source.

The data are in ``published.json``. For a rotary device, ``mass`` is the inertia J in kg m^2, ``damping`` is in
N m s/rad, and walls are in N m/rad and N m s/rad.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

from zwidth.core.errors import InputError, describe_choice
from zwidth.model.device import Device
from zwidth.model.linear_device import LinearDevice
from zwidth.model.measured_device import SUFFIXES, MeasuredDevice
from zwidth.model.operator import Operator
from zwidth.model.timing import Timing
from zwidth.units.formatting import with_unit

__all__ = ["DEVICES", "HAND", "PublishedDevice", "PublishedHand", "PublishedValue", "find_device"]


def __dir__() -> list[str]:
    """Return the public names of this module for completion at the prompt, without imported names."""
    return sorted(__all__)


class PublishedValue(NamedTuple):
    """A published parameter with its unit, its source, and a note on its use."""

    value: float
    unit: str
    source: str
    note: str = ""

    def spell(self) -> str:
        """Return the value with its unit as text, to three significant digits."""
        if self.unit in ("counts", "periods"):
            return f"{self.value:g} {self.unit.removesuffix('s') if self.value == 1 else self.unit}"
        return with_unit(self.value, self.unit, 3)


@dataclass(frozen=True)
class PublishedDevice:
    """Published parameters of one device; unpublished ones are None.

    Attributes:
        name: short name, for `find_device` and the command line.
        title: full name, for texts.
        motion: "linear" or "rotary"; determines the units of all other fields.
        mass: mass in kg, or inertia in kg m^2.
        damping: viscous damping in N s/m or N m s/rad.
        friction: Coulomb friction in N or N m.
        resolution: resolution of the position sensor in m or rad.
        counts: counts of the encoder on the motor shaft, published without the transmission ratio.
        period: sampling period in s of the loop in which the device was measured or used.
        delay: delay of that loop from a sample to its force, in s or in periods.
        force: largest force in N.
        stiffness_limit: largest stiffness in use in N/m, from a software library or notes; not a stability limit.
        damping_limit: largest virtual damping in use in N s/m, from a software library or notes.
    """

    name: str
    title: str
    motion: Literal["linear", "rotary"] = "linear"
    mass: PublishedValue | None = None
    damping: PublishedValue | None = None
    friction: PublishedValue | None = None
    resolution: PublishedValue | None = None
    counts: PublishedValue | None = None
    period: PublishedValue | None = None
    delay: PublishedValue | None = None
    force: PublishedValue | None = None
    stiffness_limit: PublishedValue | None = None
    damping_limit: PublishedValue | None = None

    def __repr__(self) -> str:
        """Return the name and the parameters, without sources."""
        parameters = [f"{name}={parameter.spell()}" for name, parameter in self.parameters.items()]
        return f"PublishedDevice({', '.join([self.name, *parameters])})"

    @property
    def rotary(self) -> bool:
        """True for a rotary device."""
        return self.motion == "rotary"

    @property
    def parameters(self) -> dict[str, PublishedValue]:
        """The published parameters by name."""
        return {
            field.name: value
            for field in fields(self)
            if isinstance(value := getattr(self, field.name), PublishedValue)
        }

    def to_device(self, *, mass: Any = None, damping: Any = None) -> Device:
        """Return a `zwidth.Device` with the published mass and damping.

        For a rotary device, ``Device.mass`` is the inertia in kg m^2 and ``Device.damping`` is in N m s/rad. Stiffness
        and virtual damping of its scene are in N m/rad and N m s/rad.

        Args:
            mass: mass that replaces the published one; required if none is published.
            damping: damping that replaces the published one; required if none is published. If the damping is unknown,
                0 is the cautious choice, because no stable wall was found that more physical damping makes unstable.

        Raises:
            InputError: mass or damping is neither published nor passed.

        Example:
            >>> import zwidth
            >>> zwidth.devices.find_device("haptic_wheel").to_device()
            Device(mass=0.00045, damping=0.0013, rotary=True)
        """
        values = {"mass": self._choose("mass", mass), "damping": self._choose("damping", damping)}
        return Device(**values, rotary=self.rotary)

    def to_timing(self, *, period: Any = None, rate: Any = None, delay: Any = None) -> Timing:
        """Return a `zwidth.Timing` with the published period and delay; the delay is 0 if none is published.

        Args:
            period: sampling period in s that replaces the published one; required if none is published and no ``rate``
                is passed.
            rate: sampling rate in Hz, instead of ``period``.
            delay: delay in s, or a text such as "1.5 periods", that replaces the published one.

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
            period = self._choose("period", None)
        return Timing(period=period, rate=rate, delay=0.0 if delay is None else delay)

    def list_missing(self, given: Collection[str]) -> list[str]:
        """Return a list of the names "mass" and "damping" without those that are published or in ``given``."""
        return [name for name in ("mass", "damping") if name not in given and getattr(self, name) is None]

    def _choose(self, name: str, given: Any) -> Any:
        """Return the passed value or, if it is None, the published one; raise `InputError` if both are missing."""
        if given is not None:
            return given
        published = getattr(self, name)
        if published is None:
            names = ", ".join(self.parameters)
            raise InputError(f"{name}: no value is published for {self.name!r}, only {names}; pass a value")
        return published.value

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name, with values that JSON can represent; unpublished parameters are None (null)."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value._asdict() if isinstance(value, PublishedValue) else value for name, value in values.items()}


@dataclass(frozen=True)
class PublishedHand:
    """Published parameters of a hand: a mass in kg, connected to ground by a damper in N s/m and a spring in N/m."""

    name: str
    title: str
    mass: PublishedValue
    damping: PublishedValue
    stiffness: PublishedValue

    def to_operator(self) -> Operator:
        """Return a `zwidth.Operator` with a rigid grasp.

        Pass ``coupling_stiffness`` to `dataclasses.replace` for a grasp with a spring.

        Example:
            >>> import zwidth
            >>> zwidth.devices.HAND.to_operator().mass
            0.554
        """
        return Operator(self.mass.value, self.damping.value, self.stiffness.value)


def _read_published() -> tuple[tuple[PublishedDevice, ...], PublishedHand]:
    """Return a tuple of all devices of ``published.json``, and the hand."""
    catalog = json.loads(Path(__file__).with_name("published.json").read_text(encoding="utf-8"))

    def convert(entry: dict[str, Any]) -> dict[str, Any]:
        """Convert the parameters of an entry to `PublishedValue`, with the text of the source in place of its key."""
        return {
            name: PublishedValue(value[0], value[1], catalog["sources"][value[2]], *value[3:])
            if isinstance(value, list)
            else value
            for name, value in entry.items()
        }

    return tuple(PublishedDevice(**convert(entry)) for entry in catalog["devices"]), PublishedHand(
        **convert(catalog["hand"])
    )


DEVICES, HAND = _read_published()
"""All devices of the catalog, those with measured parameters first; and a hand with published parameters."""


def find_device(name: str) -> PublishedDevice:
    """Return a device of the catalog.

    Args:
        name: name of a device in `zwidth.devices.DEVICES`, as listed by ``zwidth devices``.

    Raises:
        InputError: no device has this name.

    References:
        The field ``source`` of each parameter.

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


def read_device(text: str, sampled: Any = None) -> PublishedDevice | LinearDevice | MeasuredDevice:
    """Return the device that the text of an option ``--device`` describes by name, transfer function or file.

    Args:
        text: the name of a device for `find_device`; a transfer function, "NUMERATOR / DENOMINATOR" or another text
            that `LinearDevice` accepts; or the name of a file for `zwidth.MeasuredDevice.read`.
        sampled: sampling period in s for a transfer function in z; None for a transfer function in s.

    Raises:
        InputError: the text is none of these, or ``sampled`` is given for a device that is not a transfer function.
    """
    if text.endswith(SUFFIXES) or not ("/" in text or text.startswith("sos:")):
        if sampled is not None:
            raise InputError(f"device: got {text!r} as a sampled system; write 'NUM / DEN' with coefficients in z")
        return MeasuredDevice.read(text) if text.endswith(SUFFIXES) else find_device(text)
    return LinearDevice(text, sampled)
