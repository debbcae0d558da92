"""The parts of a loop as people have them: device, timing, velocity estimate, hand; normalized, with its loop."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Any, Concatenate, NamedTuple, ParamSpec, Self, TypeVar

import numpy as np

from zwidth.loops.rigid.normalization import Normalized, Physical, denormalize, normalize
from zwidth.parts.checks import Part, check_kind
from zwidth.parts.device import Device
from zwidth.parts.linear_device import LinearDevice
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.operator import Operator
from zwidth.parts.paths import find_parts, list_parameters, replace_parameters
from zwidth.parts.safe_limit import SafeLimit
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import BackwardDifference, Velocity, is_plain
from zwidth.parts.wall import NoWall, VirtualWall
from zwidth.scenes.loop import LinearLoop, RigidLoop, make_plain
from zwidth.scenes.measured_loop import MeasuredLoop
from zwidth.words.errors import InputError
from zwidth.words.quantities import WALL
from zwidth.words.showing import shown, with_units
from zwidth.words.types import Array, ArrayLike
from zwidth.words.unit_system import UnitSystem
from zwidth.words.xp import is_traced

Owner = TypeVar("Owner", bound="SceneParts")
Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

# What each part may be, and an example.
_KINDS = {
    "device": (Device | LinearDevice | MeasuredDevice, "zwidth.Device(mass=0.1, damping=10)"),
    "timing": (Timing, "zwidth.Timing(period=1e-3, delay=1e-3)"),
    "wall": (VirtualWall, "zwidth.VirtualWall(stiffness=10e3)"),
    "velocity": (Velocity, "zwidth.LowPass(cutoff=100)"),
    "operator": (Operator | None, "zwidth.Operator(mass=0.5)"),
    "safe_limit": (SafeLimit | None, "zwidth.SafeLimit(stiffness=500, virtual_damping=2)"),
}


@shown()
class WallSI(NamedTuple):
    """Walls by stiffness in N/m and damping in N s/m."""

    stiffness: Array
    virtual_damping: Array


@dataclass(frozen=True, repr=False)
class SceneParts(Part):
    """What every question of `zwidth.Scene` is about."""

    device: Device | LinearDevice | MeasuredDevice
    timing: Timing
    wall: VirtualWall = field(default_factory=NoWall)
    velocity: Velocity = field(default_factory=BackwardDifference)
    operator: Operator | None = None
    safe_limit: SafeLimit | None = None

    def __post_init__(self) -> None:
        if isinstance(self.wall, Velocity):
            self._shift_parts()
        for name, (kind, example) in _KINDS.items():
            part = getattr(self, name)
            if not isinstance(part, kind):
                raise InputError(f"{name}: got {part!r}; a part of zwidth is needed, as {example}")
        named = {name: getattr(self, name) for name in ("wall", "operator", "velocity", "safe_limit")}
        check_kind(self.unit_system.rotary, named)
        if self.operator is not None and not isinstance(self.device, Device):
            raise InputError(
                "operator: a hand holds a body, and of this device no body is known; make the hand a part of it"
            )

    def _shift_parts(self) -> None:
        """Without a wall the velocity estimate is the third part, and the hand the fourth."""
        estimate, fourth, hand = self.wall, self.velocity, self.operator
        if isinstance(fourth, Operator) and hand is None:
            hand = fourth
        elif fourth != BackwardDifference():
            raise InputError(f"wall: got {estimate!r}, and {fourth!r} as the velocity as well; name parts that follow")
        moved = {"wall": NoWall(), "velocity": estimate, "operator": hand}
        for name, part in moved.items():
            object.__setattr__(self, name, part)

    @cached_property
    def parts_beyond(self) -> tuple[str, ...]:
        """What makes it more than a rigid mass with the difference of two samples: names of its parts."""
        hand = self.operator
        grasp = hand is None or (hand.rigid and isinstance(hand.stiffness, float) and hand.stiffness == 0)
        within = {"velocity": is_plain(self.velocity, self.timing.period), "operator": grasp}
        device = () if isinstance(self.device, Device) else ("device",)
        return device + tuple(name for name in find_parts(self) if not within.get(name))

    @cached_property
    def loop(self) -> LinearLoop:
        """Its loop, normalized, that answers every question about its walls."""
        if isinstance(self.device, MeasuredDevice):
            return MeasuredLoop(self)
        return LinearLoop(make_plain(self)) if self.parts_beyond else RigidLoop(self)

    def check_parts(self) -> None:
        """Raise `InputError` for what its parts refuse only together, such as a cut-off beyond half the rate."""
        _ = self.loop.walls if isinstance(self.loop, MeasuredLoop) else self.loop.roots

    @cached_property
    def mass(self) -> Any:
        """The mass that the wall's force acts on, in kg: the unit of the normalized stiffness."""
        return self._add_rigid_operator("mass")

    @cached_property
    def damping(self) -> Any:
        """The damping to ground of that mass, in N s/m."""
        return self._add_rigid_operator("damping")

    def _add_rigid_operator(self, name: str) -> Any:
        """A number of the device, with that of a hand that holds it rigidly."""
        held = self.operator is not None and self.operator.rigid and self.device.coupling is None
        return getattr(self.device, name) + (getattr(self.operator, name) if held else 0.0)

    @cached_property
    def normalized(self) -> Normalized:
        """``alpha``, ``beta``, ``delta``, ``d`` of this scene and its wall."""
        return normalize(
            mass=self.mass,
            damping=self.damping,
            period=self.timing.period,
            delay=self.timing.delay,
            stiffness=self.wall.stiffness,
            virtual_damping=self.wall.virtual_damping,
        )._replace(d=self.d)

    @cached_property
    def traced_path(self) -> str | None:
        """Path of the first parameter that JAX traces; None if JAX traces no parameter."""
        return next((path for path, value in list_parameters(self).items() if is_traced(value)), None)

    @property
    def alpha(self) -> float:
        """Normalized stiffness of the wall."""
        return self.normalized.alpha

    @property
    def beta(self) -> float:
        """Normalized damping of the wall."""
        return self.normalized.beta

    @cached_property
    def delta(self) -> float:
        """Normalized damping of the device, with that of a hand held rigidly."""
        return self.normalized.delta

    @property
    def device_delta(self) -> float:
        """The same without the hand: what passivity, which is for any hand, counts on."""
        return self.delta if self.operator is None else self.device.damping / self.units.virtual_damping

    @cached_property
    def d(self) -> float:
        """Delay in periods."""
        return self.timing.d

    @property
    def integer_delay(self) -> int:
        """Whole periods of it."""
        return int(np.floor(self.d))

    def to_si(self, *, alpha: ArrayLike = 0.0, beta: ArrayLike = 0.0) -> Physical:
        """Stiffness in N/m and damping in N s/m of a normalized wall on this device."""
        return denormalize(
            mass=self.mass, period=self.timing.period, alpha=alpha, beta=beta, delta=self.delta, d=self.d
        )

    @property
    def unit_system(self) -> UnitSystem:
        """The units of the device, linear or rotary."""
        return self.device.unit_system

    @cached_property
    def units(self) -> WallSI:
        """The stiffness of alpha = 1 in N/m and the damping of beta = 1 in N s/m."""
        # Convert to Python floats, because concrete JAX numbers may have single precision.
        mass, period = (value if is_traced(value) else float(value) for value in (self.mass, self.timing.period))
        return with_units(WallSI(mass / period / period, mass / period), self.unit_system)

    def parameters(self) -> dict[str, Any]:
        """Every number of every part by its dotted path.

        Returns:
            For example ``{"mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": 0.0, "velocity.cutoff": 100.0, ...}``;
            the wall's ``stiffness`` and ``virtual_damping`` come last. What is left out (None) is not listed, nor what
            is chosen by a word, as ``coupling.sensor``, and the coefficients of a filter.
        """
        return list_parameters(self)

    def replace(self, **changes: Any) -> Self:
        """A new scene with one or several parameters changed; all others stay as they are, in SI units.

        A delay given in periods keeps its number of periods if the period changes.

        Args:
            **changes: by dotted path, as ``**{"velocity.cutoff": 50}``, ``period=5e-4`` or ``rate=2000``; or a whole
                part, as ``operator=zwidth.Operator(mass=0.5)``.

        Raises:
            InputError: no part of this scene has such a parameter, or the value is refused.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), velocity=zwidth.LowPass(cutoff=100))
            >>> scene.replace(**{"velocity.cutoff": 50}).parameters()["velocity.cutoff"]
            50.0
        """
        at_rate = {"period", "rate", "delay", "timing"} & changes.keys()
        if at_rate and isinstance(changes.get("device", self.device), MeasuredDevice):
            raise InputError(
                f"{min(at_rate)}: a measured response holds the rate and the delay that it was measured with; measure "
                "again at others"
            )
        made = replace_parameters(self, changes)
        if made.unit_system != self.unit_system and not {"device", "rotary"} & changes.keys():
            raise InputError(
                f"{', '.join(changes)}: these changes make the device {made.unit_system.value}, but its other "
                "parameters have other units; make a new zwidth.Scene"
            )
        changed = sorted(changes.keys() - {"wall", "safe_limit", *WALL})
        if self.safe_limit is None or not changed or "safe_limit" in changes:
            return made
        return replace(
            made,
            safe_limit=self.safe_limit.warn(
                f"{' and '.join(changed)} changed after the safe limit was measured; measure again"
            ),
        )


def wrap_function(
    function: Callable[Concatenate[Owner, Parameters], Result],
) -> Callable[Concatenate[Owner, Parameters], Result]:
    """Wrap a function of a scene: check the scene, and show the result in the units of its device."""

    @wraps(function)
    def checked(scene: Owner, *args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        check_scene(scene, function.__name__)
        return with_units(function(scene, *args, **kwargs), scene.unit_system)

    return checked


def wrap_methods(kind: type[SceneParts], *, traceable: Collection[str], but: Collection[str]) -> None:
    """Wrap the public methods of a scene class, except those in ``but``.

    Their results are shown in the units of the device. Methods that are not ``traceable`` raise `InputError` for traced
    values.
    """
    for name in dir(kind):
        method = inspect.getattr_static(kind, name)
        if inspect.isfunction(method) and not name.startswith("_") and name not in but:
            setattr(kind, name, _wrap_method(method, name in traceable))


def _wrap_method(method: Callable[Concatenate[Owner, Parameters], Result], traceable: bool) -> Callable[..., Result]:
    @wraps(method)
    def wrapped(scene: Owner, *args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if not traceable and (scene.traced_path is not None or is_traced(*args, *kwargs.values())):
            refuse_traced(method.__name__, scene, inspect.signature(method).bind(scene, *args, **kwargs).arguments)
        return with_units(method(scene, *args, **kwargs), scene.unit_system)

    return wrapped


def refuse_traced(question: str, scene: SceneParts, arguments: Mapping[str, Any]) -> None:
    """Raise `InputError` if JAX traces a parameter of the scene or an argument of the method ``question``."""
    traced = scene.traced_path or next((name for name, value in arguments.items() if is_traced(value)), None)
    if traced is not None:
        raise InputError(
            f"{traced}: got a value that JAX traces; {question} needs numbers: call it outside of jit, vmap and grad"
        )


def check_scene(scene: object, question: str = "this function") -> None:
    """Raise `InputError` if an object is not a scene, or if JAX traces one of its parameters."""
    if not isinstance(scene, SceneParts):
        example = "zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3))"
        raise InputError(f"scene: got {scene!r}; a zwidth.Scene is needed, as {example}")
    refuse_traced(question, scene, {})
