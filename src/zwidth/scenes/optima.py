"""What is best on a scene: its stiffest wall, what buys more, the damping that suits, the wall to set."""

from __future__ import annotations

from typing import Any

from zwidth.loops.linear.ridge import SceneSensitivities
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


class SceneOptima:
    """The questions of `zwidth.Scene` that look for a wall, or for a device that bears it."""

    def max_stiffness(self: Any, *, negative_damping: bool | None = None) -> StiffestWall:
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

    def sensitivities(self: Any, *, negative_damping: bool | None = None) -> SceneSensitivities:
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
        self: Any,
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
        self: Any, stiffness: float | str | None = None, *, goal: Goal = "fast", negative_damping: bool | None = None
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
        self: Any,
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
