"""A whole loop as people have it: device, timing, velocity estimate, hand; and every question about its walls."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.evaluate import as_float64
from zwidth.loops.linear.border import Outline, outlines
from zwidth.loops.linear.curve import curve_at
from zwidth.loops.linear.ridge import SceneSensitivities
from zwidth.loops.loop import LinearLoop, RigidLoop, make_plain
from zwidth.loops.measured.loop import MeasuredLoop
from zwidth.loops.normalization import Normalized, Physical, denormalize, normalize
from zwidth.parts.device import Device
from zwidth.parts.linear_device import LinearDevice
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.operator import Operator
from zwidth.parts.paths import find_parts, list_parameters, replace_parameters
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import BackwardDifference, Velocity
from zwidth.parts.wall import NoWall, VirtualWall
from zwidth.scenes.answers import SceneAnswers
from zwidth.scenes.recommendation import Recommendation, recommend
from zwidth.scenes.stiffest import (
    BestDamping,
    Goal,
    RequiredValue,
    StiffestWall,
    allows_negative,
    find_best_damping,
    require,
    stiffest_wall,
)
from zwidth.simulation.result import Motion
from zwidth.simulation.simulate import simulate
from zwidth.words.errors import InputError
from zwidth.words.showing import shown
from zwidth.words.types import Array, ArrayLike

_EXAMPLES = {
    "device": "zwidth.Device(mass=0.1, damping=10)",
    "timing": "zwidth.Timing(period=1e-3, delay=1e-3)",
    "wall": "zwidth.VirtualWall(stiffness=10e3)",
    "velocity": "zwidth.LowPass(cutoff=100)",
    "operator": "zwidth.Operator(mass=0.5)",
}


@shown()
class WallSI(NamedTuple):
    """Walls by stiffness in N/m and damping in N s/m."""

    stiffness: Array
    virtual_damping: Array


@dataclass(frozen=True)
class Scene(SceneAnswers):
    """A device, its timing, the velocity estimate, the hand and, where one is chosen, the wall that is rendered.

    Args:
        device: mass and damping, rigid or with a coupling, modes and an actuator; or its measured response.
        timing: period and delay.
        wall: the wall that `zwidth.assess` judges, and that the questions below mean where no other is named. It may be
            left out.
        velocity: how the velocity is estimated; the backward difference by default.
        operator: the hand, None where nobody holds the device.

    Example:
        >>> import zwidth
        >>> device, timing = zwidth.Device(mass=0.1, damping=10), zwidth.Timing(period=1e-3, delay=1e-3)
        >>> scene = zwidth.Scene(device, timing, velocity=zwidth.LowPass(cutoff=100))
        >>> scene.is_stable(10e3, [5, 40])
        array([False,  True])
    """

    device: Device | LinearDevice | MeasuredDevice
    timing: Timing
    wall: VirtualWall = field(default_factory=NoWall)
    velocity: Velocity = field(default_factory=BackwardDifference)
    operator: Operator | None = None

    def __post_init__(self) -> None:
        if isinstance(self.wall, Velocity):
            self._move_up()
        kinds = {
            "device": Device | LinearDevice | MeasuredDevice,
            "timing": Timing,
            "wall": VirtualWall,
            "velocity": Velocity,
        }
        for name, kind in {**kinds, "operator": Operator | None}.items():
            part = getattr(self, name)
            if not isinstance(part, kind):
                raise InputError(f"{name}: got {part!r}; a part of zwidth is needed, as {_EXAMPLES[name]}")
        if self.operator is not None and not isinstance(self.device, Device):
            raise InputError(
                "operator: a hand holds a body, and of this device no body is known; make the hand a part of it"
            )

    def _move_up(self) -> None:
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
        plain = isinstance(self.velocity, BackwardDifference) and self.velocity.coded_period is None
        within = {"velocity": plain, "operator": grasp}
        device = () if isinstance(self.device, Device) else ("device",)
        return device + tuple(name for name in find_parts(self) if not within.get(name))

    @cached_property
    def loop(self) -> LinearLoop | MeasuredLoop:
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
        held = self.operator is not None and self.operator.rigid and self.device.coupling is None
        return self.device.mass + (self.operator.mass if held and self.operator is not None else 0.0)

    @cached_property
    def damping(self) -> Any:
        """The damping to ground of that mass, in N s/m."""
        held = self.operator is not None and self.operator.rigid and self.device.coupling is None
        return self.device.damping + (self.operator.damping if held and self.operator is not None else 0.0)

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
    def own_delta(self) -> float:
        """The same without the hand: what passivity, which is for any hand, counts on."""
        return self.delta if self.operator is None else self.device.damping / self.units.virtual_damping

    @cached_property
    def d(self) -> float:
        """Delay in periods."""
        return self.timing.d

    @property
    def whole_delay(self) -> int:
        """Whole periods of it."""
        return int(np.floor(self.d))

    def to_si(self, *, alpha: ArrayLike = 0.0, beta: ArrayLike = 0.0) -> Physical:
        """Stiffness in N/m and damping in N s/m of a normalized wall on this device."""
        return denormalize(
            mass=self.mass, period=self.timing.period, alpha=alpha, beta=beta, delta=self.delta, d=self.d
        )

    @cached_property
    def units(self) -> WallSI:
        """The stiffness of alpha = 1 in N/m and the damping of beta = 1 in N s/m."""
        rate = self.mass / self.timing.period
        return WallSI(rate / self.timing.period, rate)

    def boundary(self, omega: ArrayLike) -> WallSI:
        """The walls that put a pole pair on the unit circle at a frequency.

        Args:
            omega: in rad/s, between 0 and half the sampling rate, ``pi/T``.

        Returns:
            ``stiffness`` in N/m and ``virtual_damping`` in N s/m; NaN for other frequencies.
        """
        w = as_float64("omega", omega) * self.timing.period
        inside = (w > 0) & (w < np.pi)
        curve = curve_at(self.loop.roots, np.where(inside, w, 1.0))
        units = self.units
        numbers = (curve.alpha * units.stiffness, curve.beta * units.virtual_damping)
        return WallSI(*(np.where(inside, part, np.nan)[()] for part in numbers))

    def stable_region(self) -> list[Outline]:
        """Closed outlines of the stable set, the largest first, islands and holes told apart.

        Returns:
            A list of outlines with ``stiffness`` in N/m, ``virtual_damping`` in N s/m, ``hole`` and ``island``, as
            `islands` means it.
        """
        units = self.units
        if isinstance(self.loop, MeasuredLoop):
            found = self.loop.outline()
            pieces = [] if found is None else [Outline(*found, False, False)]
        else:
            pieces = outlines(self.loop.border)
        return [
            Outline(piece.stiffness * units.stiffness, piece.virtual_damping * units.virtual_damping, *piece[2:])
            for piece in pieces
        ]

    def max_stiffness(self, *, negative_damping: bool | None = None) -> StiffestWall:
        """The stiffest stable wall that soft ones lead to, and what binds it.

        ``sup {K : some B is stable}`` over the pieces of the stable set that contain soft walls, down to K = 0: along a
        path of stable walls K and B can rise to it. Walls apart from these are `islands`.

        Args:
            negative_damping: whether walls with B < 0 count. By default they do with the backward difference; behind a
                filter a negative B is a lead compensator and no damper, and B >= 0 is meant. What is a piece does not
                depend on it: a path may lead through B < 0.

        Returns:
            ``stiffness`` in N/m; ``virtual_damping`` in N s/m; ``frequency`` in Hz of the pole pair on the unit circle,
            of the higher one at a corner; ``kind``, a code of `zwidth.RidgeKind`; ``status`` of `zwidth.Status`, with
            NaN where it is not 0: NO_BOUNDARY where no such wall with K > 0 is stable.

        Numerics:
            Closed form for a rigid device. Otherwise the highest point of all edges of the stable set (50 to 150 ms),
            about 1e-13 relative, refused where rows of the plane contradict it. Inside a JAX transformation it is
            finished by optimistix, with implicit derivatives in every parameter of every part. The delay and, with
            one, the period must be plain numbers there (`TracedDelayError`).

        Example:
            >>> import zwidth
            >>> timing = zwidth.Timing(period=1e-3, delay=1e-3)
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), timing, velocity=zwidth.LowPass(cutoff=100))
            >>> print(f"{scene.max_stiffness().stiffness:.0f} N/m")
            11942 N/m
        """
        return stiffest_wall(self, negative_damping)

    def sensitivities(self, *, negative_damping: bool | None = None) -> SceneSensitivities:
        """What a little more of every parameter of every part buys.

        Args:
            negative_damping: as for `max_stiffness`.

        Returns:
            ``stiffness``, K_max in N/m; ``per``, its derivatives by dotted path ("mass", "velocity.cutoff",
            "operator.mass", ...) in N/m per SI unit, each with all others held fixed; ``status``, NOT_CONVERGED where
            one of them is NaN, as all are without a K_max. Whole numbers and coefficients of a filter have none. At
            zero they are those from the right, at a whole delay both sides agree.

        Numerics:
            Closed form for a rigid device; otherwise implicit derivatives of the conditions that bind, some ms a
            parameter: right to 1e-6, or where one is nearly 0, to 1e-11 of K_max over the parameter.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> print(f"{scene.sensitivities().per['damping']:.0f} N/m per N s/m")
            572 N/m per N s/m
        """
        return self.loop.sensitivities(allows_negative(self, negative_damping))

    def required(
        self,
        parameter: str,
        stiffness: float | str,
        *,
        within: tuple[Any, Any] | None = None,
        negative_damping: bool | None = None,
    ) -> RequiredValue:
        """The value of one parameter at which K_max reaches a wanted stiffness, all others as they are.

        Args:
            parameter: its dotted path, such as "damping", "velocity.cutoff" or "rate".
            stiffness: wanted, in N/m, > 0.
            within: the range that is searched, 0 < low < high; by default a thirtieth to 30 times the present value.
            negative_damping: as for `max_stiffness`.

        Returns:
            ``value``, the nearest to the present one, itself enough; ``enough``, the side of it on which there is
            enough ("above", "below"), or "everywhere" in the range (then ``value`` is the present one, or the end next
            to it), or "nowhere"; ``crossings``, all that were found, each proved by a K_max on either side; ``range``;
            ``status``, UNREACHABLE with NaN where the range never reaches the stiffness.

        Numerics:
            25 values across the range, then each crossing to 1e-11 relative. K_max need not be monotone; two crossings
            between neighboring values are not seen.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> needed = scene.required("damping", 25e3)
            >>> print(f"{needed.value:.2f} N s/m or {needed.enough}")
            18.62 N s/m or above
        """
        return require(self, parameter, stiffness, within, negative_damping)

    def best_damping(
        self, stiffness: float | str | None = None, *, goal: Goal = "fast", negative_damping: bool | None = None
    ) -> BestDamping:
        """The virtual damping that suits a stiffness best.

        Args:
            stiffness: K in N/m, > 0; that of the scene's own wall where left out.
            goal: "fast", the smallest spectral radius, with which the wall settles fastest; "robust", the largest
                modulus margin, with which it bears the largest unknown change of the loop at every frequency.
            negative_damping: as for `max_stiffness`, as is the piece of the stable set that is meant.

        Returns:
            ``virtual_damping`` in N s/m; ``spectral_radius`` and ``modulus_margin`` there; ``status``, NO_BOUNDARY with
            NaN where no damping is stable in that piece.

        Numerics:
            Samples across the stable dampings, then golden section round the three lowest dips: the optimum is usually
            a kink, where poles meet. The radius is right to about 1e-8 where two poles meet; 0.1 to 1 s.

        References:
            Hulin, Preusche, Hirzinger 2006, section VIII. Landau 1990 (modulus margin).

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> best = scene.best_damping(5e3)
            >>> print(f"{best.virtual_damping:.1f} N s/m, spectral radius {best.spectral_radius:.3f}")
            25.8 N s/m, spectral radius 0.759
        """
        return find_best_damping(self, stiffness, goal, negative_damping)

    def recommend(
        self,
        *,
        stiffness_fraction: float | None = None,
        gain_margin: float | None = None,
        phase_margin: float | None = None,
        passive: bool = False,
    ) -> Recommendation:
        """The stiffest wall that keeps some distance from trouble: the one to set on this device.

        Args:
            stiffness_fraction: at most this share of K_max, between 0 and 1; 0.75 where nothing is asked for.
            gain_margin: at least this factor on stiffness and damping together, > 1.
            phase_margin: at least so many degrees, > 0.
            passive: whether the wall must be passive.

        Returns:
            Recommendation: ``stiffness`` and ``virtual_damping``; ``limited_by``, what allows no more; ``verdict``,
            what `zwidth.assess` says of the wall; ``steps``, what could be bought for a stiffer one; ``code("c")``, the
            wall for a control loop. ``status`` is UNREACHABLE, and there is no wall, where nothing softer keeps what is
            asked for either.

        Numerics:
            A share of K_max alone is in closed form, with the damping of the stiffest wall where it is stable. Margins
            take a search over K and B: each wall is judged by `margins` and `passivity_margin` themselves, and K lies
            within 2e-4 of the largest that was found; 0.3 s for a rigid device, some seconds with other parts.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> found = scene.recommend(phase_margin=30)
            >>> print(f"{found.stiffness:.0f} N/m and {found.virtual_damping:.1f} N s/m")
            8009 N/m and 33.4 N s/m
        """
        return recommend(self, stiffness_fraction, gain_margin, phase_margin, passive)

    def simulate(
        self, stiffness: ArrayLike | None = None, virtual_damping: ArrayLike | None = None, **options: Any
    ) -> Motion:
        """Simulate this device on a wall in time, with contact, friction, an encoder and a motor as wanted.

        Args:
            stiffness, virtual_damping: K in N/m and B in N s/m; neither means the scene's own wall.
            **options: those of `zwidth.simulate`, which this calls.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> zwidth.MotionKind(scene.simulate(25e3, 40, start_position=1e-4, coulomb=1.0).outcome).name
            'REST'
        """
        return simulate(self, stiffness, virtual_damping, **options)

    def parameters(self) -> dict[str, Any]:
        """Every number of every part by its dotted path.

        Returns:
            For example ``{"mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": 0.0, "velocity.cutoff": 100.0, ...}``;
            the wall's ``stiffness`` and ``virtual_damping`` come last. What is left out (None) is not listed, nor what
            is chosen by a word, as ``coupling.sensor``, and the coefficients of a filter.
        """
        return list_parameters(self)

    def replace(self, **changes: Any) -> Scene:
        """A new scene with one or several parameters changed; all others stay as they are, in SI units.

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
        return replace_parameters(self, changes)
