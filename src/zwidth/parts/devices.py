"""Devices whose numbers somebody published, each number with its source; None where nothing is published.

A rotary device is the same mathematics as a linear one with other units: its ``mass`` is the inertia J in kg m^2, its
``damping`` is in N m s/rad, and the walls of its loop are in N m/rad and N m s/rad.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NamedTuple

from zwidth.parts.device import Device
from zwidth.parts.operator import Operator
from zwidth.parts.timing import Timing
from zwidth.words.errors import InputError, describe_choice


class Published(NamedTuple):
    """One number, its unit, where it was published, and what must be known to use it."""

    value: float
    unit: str
    source: str
    note: str = ""


@dataclass(frozen=True)
class KnownDevice:
    """What is published of one device; a field is None where nothing is.

    Attributes:
        name: as `find_device` and the command line take it.
        title: for people.
        motion: "linear" or "rotary", which decides the units of everything else.
        mass: in kg, or the inertia in kg m^2.
        damping: viscous, in N s/m or N m s/rad.
        friction: Coulomb friction in N or N m.
        resolution: one step of the position sensor, in m or rad.
        counts: of the encoder on the motor's shaft; transmissions are not published with them.
        period: of the loop it was measured or used in, in s.
        force: the largest, in N.
        stiffness_limit: the largest in use, in N/m: what a library sets or notes name, no measured boundary.
        damping_limit: likewise, in N s/m.
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
    force: Published | None = None
    stiffness_limit: Published | None = None
    damping_limit: Published | None = None

    @property
    def numbers(self) -> dict[str, Published]:
        """Every number that is published, by its name."""
        return {
            field.name: found for field in fields(self) if isinstance(found := getattr(self, field.name), Published)
        }

    def to_device(self, *, mass: Any = None, damping: Any = None) -> Device:
        """A `zwidth.Device` with the published mass and damping.

        For a rotary device ``Device.mass`` holds the inertia in kg m^2 and ``Device.damping`` N m s/rad. Every
        stiffness and virtual damping of such a scene is in N m/rad and N m s/rad, wherever N/m and N s/m are printed.

        Args:
            mass: yours, in place of the published one or where none is published.
            damping: likewise; 0 is the cautious value, more damping was never seen to make a stable wall unstable.

        Raises:
            InputError: mass or damping is neither published nor given.

        Example:
            >>> import zwidth
            >>> zwidth.devices.find_device("haptic_wheel").to_device()
            Device(mass=0.00045, damping=0.0013, coupling=None)
        """
        return Device(mass=self._chosen("mass", mass), damping=self._chosen("damping", damping))

    def to_timing(self, *, delay: Any = 0.0) -> Timing:
        """A `zwidth.Timing` with the published period and a delay of yours in s."""
        return Timing(period=self._chosen("period", None), delay=delay)

    def _chosen(self, name: str, given: Any) -> Any:
        if given is not None:
            return given
        found = getattr(self, name)
        if found is None:
            known = ", ".join(self.numbers)
            raise InputError(
                f"{name}: none is published for {self.name!r} (published are {known}); "
                + ("use Timing(period=...)" if name == "period" else f"give to_device({name}=...)")
            )
        return found.value

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON values; null where nothing is published."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value._asdict() if isinstance(value, Published) else value for name, value in values.items()}


@dataclass(frozen=True)
class KnownHand:
    """What was measured of one hand: kg, N s/m and N/m to ground."""

    name: str
    title: str
    mass: Published
    damping: Published
    stiffness: Published

    def to_operator(self, *, coupling_stiffness: Any = None, coupling_damping: Any = 0.0) -> Operator:
        """A `zwidth.Operator`: a rigid grasp, or behind a spring in N/m and a damper in N s/m of yours.

        Example:
            >>> import zwidth
            >>> zwidth.devices.HAND.to_operator().mass
            0.554
        """
        return Operator(
            mass=self.mass.value,
            damping=self.damping.value,
            stiffness=self.stiffness.value,
            coupling_stiffness=coupling_stiffness,
            coupling_damping=coupling_damping,
        )


_PAPER = "Hulin, Preusche, Hirzinger 2006, section VIII"
_WHEEL = "github.com/eastskykang/embedded-control-systems, lab6/Lab6.pdf"
_PADDLE = "github.com/HannesRovina/HapticHumanRobotInterfaces-Lab, HHRI_Lab4_Report_HR_MSH.pdf"
_WRIST = "github.com/mahilab/OpenWrist, matlab/OpenWristInit.m"
_RIG = "github.com/raeedcho/hapticore, docs/adr/010-impedance-device-virtual-coupling.md"
_WOOD = "github.com/WoodenHaptics/woody-experimental, woodenhaptics_2016ed.json"
_FALCON = "github.com/libnifalcon/libnifalcon, include/falcon/core/FalconGeometry.h"
_CHAI_DELTA = "github.com/chai3d/chai3d, src/devices/CDeltaDevices.cpp"
_CHAI_PHANTOM = "github.com/chai3d/chai3d, src/devices/CPhantomDevices.cpp"
_HAND = "Sci. Rep. 5:18004 (2015), Fig. 3"
_SET = "a limit that the library sets, not measured"


def _limited(source: str, name: str, title: str, force: float, stiffness: float, damping: float) -> KnownDevice:
    """A device of which only the limits are known that a library sets."""
    return KnownDevice(
        name,
        title,
        force=Published(force, "N", source, _SET),
        stiffness_limit=Published(stiffness, "N/m", source, _SET),
        damping_limit=Published(damping, "N s/m", source, _SET),
    )


def _wrist(axis: str, words: str, damping: float, friction: float) -> KnownDevice:
    return KnownDevice(
        f"openwrist_{axis}",
        f"OpenWrist, {words}",
        "rotary",
        damping=Published(damping, "N m s/rad", _WRIST),
        friction=Published(friction, "N m", _WRIST, "kinetic"),
        counts=Published(500, "counts", _WRIST),
        period=Published(1e-3, "s", _WRIST),
    )


DEVICES = (
    KnownDevice(
        "phantom_2006",
        "PHANToM, as in the paper's example",
        mass=Published(0.1, "kg", _PAPER),
        period=Published(1e-3, "s", _PAPER),
    ),
    KnownDevice(
        "haptic_wheel",
        "haptic wheel of a course",
        "rotary",
        mass=Published(4.5e-4, "kg m^2", _WHEEL),
        damping=Published(0.0013, "N m s/rad", _WHEEL),
        period=Published(1e-3, "s", _WHEEL, "and 0.1 ms; a spring of 50 N mm/deg grows at 1 ms and decays at 0.1 ms"),
    ),
    KnownDevice(
        "epfl_paddle",
        "EPFL haptic paddle, at the handle",
        damping=Published(0.033, "N s/m", _PADDLE, "from 8.33e-7 N m s/rad at the motor; handle at 75 mm"),
        friction=Published(0.24, "N", _PADDLE, "from 1.2 to 1.65 mN m of static friction at the motor"),
        resolution=Published(15.7e-6, "m", _PADDLE, "from 2000 counts x 15"),
        counts=Published(2000, "counts", _PADDLE),
        period=Published(350e-6, "s", _PADDLE),
    ),
    _wrist("ps", "pronation and supination", 0.0252, 0.1891),
    _wrist("fe", "flexion and extension", 0.0019, 0.0541),
    _wrist("ru", "radial and ulnar deviation", 0.0029, 0.1339),
    KnownDevice(
        "delta_3_rig",
        "delta.3 in a laboratory rig",
        mass=Published(0.35, "kg", _RIG, "0.3 to 0.5 kg; design notes"),
        period=Published(0.25e-3, "s", _RIG, "4 kHz"),
        force=Published(20.0, "N", _RIG),
        stiffness_limit=Published(800.0, "N/m", _RIG, "about, without virtual damping; design notes"),
    ),
    KnownDevice(
        "woodenhaptics",
        "WoodenHaptics",
        counts=Published(2000, "counts", _WOOD),
        force=Published(5.0, "N", _WOOD),
    ),
    replace(
        _limited(_CHAI_DELTA, "falcon", "Novint Falcon", 8.0, 3000.0, 20.0),
        resolution=Published(38e-6, "m", _FALCON, "about"),
        counts=Published(1280, "counts", _FALCON),
    ),
    _limited(_CHAI_DELTA, "delta_3", "delta.3", 20.0, 5000.0, 30.0),
    _limited(_CHAI_DELTA, "omega", "omega.x", 12.0, 5000.0, 30.0),
    _limited(_CHAI_DELTA, "sigma_7", "sigma.7", 12.0, 4000.0, 30.0),
    _limited(_CHAI_PHANTOM, "touch", "Touch", 3.3, 400.0, 4.0),
    _limited(_CHAI_PHANTOM, "omni", "PHANToM Omni", 3.3, 700.0, 5.0),
    _limited(_CHAI_PHANTOM, "desktop", "PHANToM Desktop", 7.9, 1000.0, 5.0),
    _limited(_CHAI_PHANTOM, "premium_1_5_6dof", "PHANToM Premium 1.5 6DOF", 8.5, 800.0, 5.0),
)
"""Every device, those with measured numbers first."""

HAND = KnownHand(
    "hand_2015",
    "a hand, one trial",
    Published(0.554, "kg", _HAND, "one trial"),
    Published(6.45, "N s/m", _HAND, "one trial"),
    Published(135.0, "N/m", _HAND, "one trial"),
)
"""A hand for `zwidth.Scene(..., operator=...)`."""


def find_device(name: str) -> KnownDevice:
    """Return the device of this name.

    Args:
        name: one of those that `zwidth.devices.DEVICES` holds and ``zwidth devices`` lists.

    Raises:
        InputError: there is none.

    References:
        Each number names its own source.

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
