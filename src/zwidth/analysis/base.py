"""Parts of a scene: device, timing, wall, velocity estimate, operator, safe limit; and its normalized quantities.

`SceneParts` is the base class of `zwidth.Scene`. It checks that the parts fit together, normalizes them (unit of time:
the sampling period T; unit of mass: the mass m that the force of the wall acts on), and selects the implementation of
all analyses, `zwidth.analysis.loop`. The normalized quantities are

    alpha = K T^2/m      beta = B T/m      delta = b T/m      d = t_d/T

with K and B the stiffness and damping of the wall, b the damping of the device and t_d its delay. The subclasses in the
other modules of this package add the analyses; `wrap_methods` makes their results print in the units of the device.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Any, Concatenate, NamedTuple, ParamSpec, Self, TypeVar

import numpy as np

from zwidth.analysis.coupling_loop import CouplingLoop
from zwidth.analysis.loop import LinearLoop, RigidLoop, make_plain
from zwidth.analysis.measured_loop import MeasuredLoop
from zwidth.analysis.slow_tool_loop import SlowToolLoop
from zwidth.core.errors import InputError
from zwidth.core.pytrees import list_leaves
from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import is_traced
from zwidth.model.checks import Part, check_kind
from zwidth.model.device import Device
from zwidth.model.feedback import Feedback, IntegralFeedback
from zwidth.model.linear_device import LinearDevice
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.operator import Operator
from zwidth.model.parameter_paths import find_parts, list_parameters, replace_parameters
from zwidth.model.position import Position, has_velocity
from zwidth.model.safe_limit import SafeLimit
from zwidth.model.timing import Timing
from zwidth.model.tool import Tool
from zwidth.model.velocity import BackwardDifference, Velocity, is_plain
from zwidth.model.wall import NoWall, VirtualWall
from zwidth.stability.rigid.normalization import Normalized, Physical, denormalize, normalize
from zwidth.units.display import compact_repr, with_units
from zwidth.units.quantities import WALL
from zwidth.units.unit_system import UnitSystem

Owner = TypeVar("Owner", bound="SceneParts")
Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

# Allowed types of each part of a scene, and an example of a valid part for error messages.
_KINDS = {
    "device": (Device | LinearDevice | MeasuredDevice, "zwidth.Device(mass=0.1, damping=10)"),
    "timing": (Timing, "zwidth.Timing(period=1e-3, delay=1e-3)"),
    "wall": (VirtualWall, "zwidth.VirtualWall(stiffness=10e3)"),
    "velocity": (Velocity, "zwidth.LowPass(cutoff=100)"),
    "operator": (Operator | None, "zwidth.Operator(mass=0.5)"),
    "safe_limit": (SafeLimit | None, "zwidth.SafeLimit(stiffness=500, virtual_damping=2)"),
    "position": (Position | None, "zwidth.ExponentialFilter(cutoff=100)"),
    "feedback": (Feedback | IntegralFeedback | None, "zwidth.IntegralFeedback(1000)"),
    "tool": (Tool | None, "zwidth.Tool(mass=0.1)"),
}


@compact_repr()
class WallSI(NamedTuple):
    """Stiffness K in N/m and damping B in N s/m of one wall or of several walls."""

    stiffness: Array
    virtual_damping: Array


@dataclass(frozen=True, repr=False)
class SceneParts(Part):
    """Base class of `zwidth.Scene`: its parts, and the normalized quantities derived from them."""

    device: Device | LinearDevice | MeasuredDevice
    timing: Timing
    wall: VirtualWall = field(default_factory=NoWall)
    velocity: Velocity = field(default_factory=BackwardDifference)
    operator: Operator | None = None
    safe_limit: SafeLimit | None = None
    position: Position | None = None
    feedback: Feedback | IntegralFeedback | None = None
    tool: Tool | None = None

    def __post_init__(self) -> None:
        """Raise `InputError` if a part has a wrong type or unit, or if the device does not allow an operator."""
        if isinstance(self.wall, Velocity):
            self._shift_parts()
        for name, (kind, example) in _KINDS.items():
            part = getattr(self, name)
            if not isinstance(part, kind):
                raise InputError(f"{name}: got {part!r}; pass an object such as {example}")
        named = {
            name: getattr(self, name) for name in ("wall", "operator", "velocity", "safe_limit", "feedback", "tool")
        }
        check_kind(self.unit_system.rotary, named)
        if self.operator is not None and not isinstance(self.device, Device):
            raise InputError(
                "operator: allowed only with a zwidth.Device; include the hand in the model of this device"
            )
        if isinstance(self.device, MeasuredDevice) and (self.position is not None or self.feedback is not None):
            name = "feedback" if self.position is None else "position"
            raise InputError(f"{name}: needs a model of the device; fit one to the measured response, or omit {name}")
        if has_velocity(self.position) and self.velocity != BackwardDifference():
            raise InputError(
                f"velocity: got {self.velocity!r}, but {self.position!r} has its own velocity estimate; omit velocity"
            )
        if self.tool is not None and isinstance(self.device, MeasuredDevice):
            raise InputError("tool: not allowed with a measured response; use a model of the device")
        if self.tool is not None and self.tool.every > 1 and (self.position is not None or self.feedback is not None):
            name = "feedback" if self.position is None else "position"
            raise InputError(f"{name}: not allowed with tool.every = {self.tool.every}; omit {name}, or set every=1")

    def _shift_parts(self) -> None:
        """Move velocity estimate and operator to their fields if the positional arguments omit the wall before them."""
        estimate, fourth, hand = self.wall, self.velocity, self.operator
        if isinstance(fourth, Operator) and hand is None:
            hand = fourth
        elif fourth != BackwardDifference():
            raise InputError(f"wall: got {estimate!r}, but velocity is given too, as {fourth!r}; name the parts")
        moved = {"wall": NoWall(), "velocity": estimate, "operator": hand}
        for name, part in moved.items():
            object.__setattr__(self, name, part)

    @cached_property
    def nonrigid_parts(self) -> tuple[str, ...]:
        """Names of the parts that the closed forms for a rigid mass with the backward difference do not support."""
        hand = self.operator
        grasp = hand is None or (hand.rigid and isinstance(hand.stiffness, float) and hand.stiffness == 0)
        basic = {"velocity": is_plain(self.velocity, self.timing.period), "operator": grasp}
        device = () if isinstance(self.device, Device) else ("device",)
        return device + tuple(name for name in find_parts(self) if not basic.get(name))

    @cached_property
    def loop(self) -> LinearLoop:
        """Normalized loop of the scene, in the fastest implementation that supports its parts."""
        shape = next((np.shape(leaf) for leaf in list_leaves(self) if np.ndim(leaf)), ())
        if shape:
            raise InputError(f"scene: got numbers of shape {shape}; map over scenes with jax.vmap")
        if isinstance(self.device, MeasuredDevice):
            return MeasuredLoop(self)
        if self.nonrigid_parts and self.traced_path is not None:
            return self.traced_loop
        if self.tool is not None:
            return (CouplingLoop if self.tool.every == 1 else SlowToolLoop)(make_plain(self))
        return LinearLoop(make_plain(self)) if self.nonrigid_parts else RigidLoop(self)

    @cached_property
    def traced_loop(self) -> Any:
        """Loop for parameters and walls that JAX traces; `zwidth.Scene` defines it, because it requires JAX."""
        raise NotImplementedError

    def check_parts(self) -> None:
        """Raise `InputError` for an invalid combination of parts, such as a cutoff above the Nyquist frequency."""
        loop = self.loop
        _ = loop.walls if isinstance(loop, MeasuredLoop) else loop.roots if loop.has_boundary else loop.chain

    @cached_property
    def mass(self) -> Any:
        """Mass in kg that the force of the wall acts on, including the mass of a rigidly coupled operator."""
        return self._add_rigid_operator("mass")

    @cached_property
    def damping(self) -> Any:
        """Damping in N s/m between `mass` and ground, including the damping of a rigidly coupled operator."""
        return self._add_rigid_operator("damping")

    def _add_rigid_operator(self, name: str) -> Any:
        """Return the parameter ``name`` (mass or damping) of the device, plus that of a rigidly coupled operator.

        The operator adds nothing to a device with a coupling, because it holds the body at the other end of the
        coupling.
        """
        is_rigid = self.operator is not None and self.operator.rigid and self.device.coupling is None
        return getattr(self.device, name) + (getattr(self.operator, name) if is_rigid else 0.0)

    @cached_property
    def normalized(self) -> Normalized:
        """Normalized parameters ``alpha``, ``beta``, ``delta`` and ``d`` of the scene with its wall."""
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
        """Normalized damping of the device, including the damping of a rigidly coupled operator."""
        return self.normalized.delta

    @property
    def device_delta(self) -> float:
        """Normalized damping of the device without its operator, because passivity must hold for any operator."""
        return self.delta if self.operator is None else self.device.damping / self.units.virtual_damping

    @cached_property
    def d(self) -> float:
        """Delay in periods."""
        return self.timing.d

    @property
    def integer_delay(self) -> int:
        """Integer part n of the delay in periods."""
        return int(np.floor(self.d))

    def to_si(self, *, alpha: ArrayLike = 0.0, beta: ArrayLike = 0.0) -> Physical:
        """Convert the normalized stiffness alpha and damping beta of walls on this device to SI units."""
        return denormalize(
            mass=self.mass, period=self.timing.period, alpha=alpha, beta=beta, delta=self.delta, d=self.d
        )

    @property
    def unit_system(self) -> UnitSystem:
        """Unit system of the device, linear or rotary."""
        return self.device.unit_system

    @cached_property
    def units(self) -> WallSI:
        """Units of alpha and beta: the stiffness m/T^2 in N/m, and the damping m/T in N s/m."""
        # Convert numbers that are not traced to Python floats, because JAX numbers may have single precision.
        mass, period = (value if is_traced(value) else float(value) for value in (self.mass, self.timing.period))
        return with_units(WallSI(mass / period / period, mass / period), self.unit_system)

    def parameters(self) -> dict[str, Any]:
        """Return a dictionary of the numerical parameters of all parts, keyed by dotted path.

        Returns:
            For example ``{"mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": 0.0, "velocity.cutoff": 100.0, ...}``;
            ``stiffness`` and ``virtual_damping`` of the wall come last. Optional parameters that are not given (None),
            choices such as ``coupling.sensor``, and the coefficients of a filter are not listed.
        """
        return list_parameters(self)

    def replace(self, **changes: Any) -> Self:
        """Return a new scene with some parameters changed, in SI units; all other parameters stay the same.

        A delay given in periods keeps its number of periods if the period changes.

        Args:
            **changes: new values by dotted path, such as ``**{"velocity.cutoff": 50}``, ``period=5e-4`` or
                ``rate=2000``; or a whole part, such as ``operator=zwidth.Operator(mass=0.5)``.

        Raises:
            InputError: no part of this scene has the parameter, or the value is not allowed.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), velocity=zwidth.LowPass(cutoff=100))
            >>> scene.replace(**{"velocity.cutoff": 50}).parameters()["velocity.cutoff"]
            50.0
        """
        at_rate = {"period", "rate", "delay", "timing"} & changes.keys()
        if at_rate and isinstance(changes.get("device", self.device), MeasuredDevice):
            raise InputError(
                f"{min(at_rate)}: cannot change, because a measured response is valid for one rate and delay; "
                "measure again"
            )
        changed_scene = replace_parameters(self, changes)
        if changed_scene.unit_system != self.unit_system and not {"device", "rotary"} & changes.keys():
            raise InputError(
                f"{', '.join(changes)}: these changes make the device {changed_scene.unit_system.value}, but its other "
                "parameters have other units; create a new zwidth.Scene"
            )
        changed = sorted(changes.keys() - {"wall", "safe_limit", *WALL})
        if self.safe_limit is None or not changed or "safe_limit" in changes:
            return changed_scene
        return replace(
            changed_scene,
            safe_limit=self.safe_limit.warn(
                f"{' and '.join(changed)} changed after the safe limit was measured; measure again"
            ),
        )


def wrap_function(
    function: Callable[Concatenate[Owner, Parameters], Result],
) -> Callable[Concatenate[Owner, Parameters], Result]:
    """Wrap a function of a scene so that it checks the scene, and its result prints in the units of the device."""

    @wraps(function)
    def checked(scene: Owner, *args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        check_scene(scene, function.__name__)
        return with_units(function(scene, *args, **kwargs), scene.unit_system)

    return checked


# Methods that are compiled as one program if JAX traces the scene and the scene has no closed form. Without this, JAX
# would compile each operation of the method separately outside jit, e.g. in grad, which takes ten times as long.
COMPILED = (
    "boundary",
    "is_passive",
    "margins",
    "max_stiffness",
    "passivity_margin",
    "required",
    "sensitivities",
    "spectral_radius",
)


def wrap_methods(kind: type[SceneParts], *, traceable: Collection[str], but: Collection[str]) -> None:
    """Wrap the public methods of a scene class, except those named in ``but``, so that their results print with units.

    The results of a wrapped method print in the units of the device. A wrapped method that is not named in
    ``traceable`` raises `InputError` for values traced by JAX.
    """
    for name in dir(kind):
        method = inspect.getattr_static(kind, name)
        if inspect.isfunction(method) and not name.startswith("_") and name not in but:
            setattr(kind, name, _wrap_method(method, name in traceable))


def _wrap_method(method: Callable[Concatenate[Owner, Parameters], Result], traceable: bool) -> Callable[..., Result]:
    """Wrap a method so that its result prints in the device's units; refuse traced values unless ``traceable``."""

    @wraps(method)
    def wrapped(scene: Owner, *args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if scene.traced_path is not None or is_traced(*args, *kwargs.values()):
            arguments = inspect.signature(method).bind(scene, *args, **kwargs).arguments
            if not traceable:
                refuse_traced(method.__name__, scene, arguments)
            if method.__name__ in COMPILED and scene.traced_path is not None and scene.nonrigid_parts:
                _, *rest = arguments.items()
                return with_units(scene.traced_loop.run_compiled(method, dict(rest)), scene.unit_system)
        return with_units(method(scene, *args, **kwargs), scene.unit_system)

    return wrapped


def refuse_traced(method: str, scene: SceneParts, arguments: Mapping[str, Any]) -> None:
    """Raise `InputError` if JAX traces a parameter of the scene or one of the arguments of a method.

    Args:
        method: name of the method, for the message.
        scene: the scene.
        arguments: arguments of the method by name.
    """
    traced = scene.traced_path or next((name for name, value in arguments.items() if is_traced(value)), None)
    if traced is not None:
        raise InputError(
            f"{traced}: got a value traced by JAX; call {method} with plain numbers, outside jit, vmap and grad"
        )


def check_scene(scene: object, method: str = "this function") -> None:
    """Raise `InputError` if an object is not a scene, or if JAX traces one of its parameters."""
    if not isinstance(scene, SceneParts):
        example = "zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3))"
        raise InputError(f"scene: got {scene!r}; pass a zwidth.Scene, such as {example}")
    refuse_traced(method, scene, {})
