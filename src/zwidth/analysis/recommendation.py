"""Recommended wall of a device: the stiffest that satisfies requirements, with cautions and useful improvements.

The requirements (`wall_search.Requirements`) limit the stiffness K relative to the maximum stiffness K_max of the
device, the margins, the passivity, and the stability in reference grasps, which are models of a hand. The *safe limit*
of a scene bounds K and the damping B to walls that measurements of the device support. The *active* requirement is the
one that excludes every stiffer wall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, cast

import numpy as np

from zwidth.analysis.assessment import (
    Assessment,
    Limit,
    assess,
    compute_gains,
    describe_islands,
    find_nearest_interval,
    name_kind,
    round_margin,
)
from zwidth.analysis.cautions import describe_limit, judge_grasps, list_cautions
from zwidth.analysis.coupling_code import write_program
from zwidth.analysis.optimization import SceneOptima, StiffestWall
from zwidth.analysis.wall_search import (
    COARSE,
    Grasps,
    Requirements,
    choose_controller,
    list_grasped_scenes,
    measure_slack,
)
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.model.checks import check_limit
from zwidth.model.controller_gains import CascadeGains, ControllerKind, PidGains, PositionUnit, find_gains, find_units
from zwidth.model.device import Device
from zwidth.model.grasps import RADII
from zwidth.model.safe_limit import reserve_damping
from zwidth.model.wall import NoWall, VirtualWall
from zwidth.stability.linear.passivity import find_obstacle
from zwidth.stability.rigid.step_response import decay_time
from zwidth.units.display import compact_repr
from zwidth.units.formatting import (
    count_digits,
    format_interval,
    format_stiffness,
    plain,
    round_conservatively,
    to_json,
    with_unit,
)
from zwidth.units.quantities import WALL
from zwidth.units.unit_system import UnitSystem

_UNITS = {"stiffness": "N/m", "damping": "N s/m", "virtual_damping": "N s/m"}
_UNITS |= {"mass": "kg", "time": "s", "frequency": "Hz"}
# Fields of `Assessment` that `Recommendation.as_dict` repeats in its entry "recommended".
_JUDGED = (
    *("alpha", "beta", "virtual_damping_lower", "virtual_damping_upper", "spectral_radius", "passive"),
    *("passivity_margin", "time_constant", "frequency", "gain_margin", "phase_margin", "delay_margin"),
)


@compact_repr(("stiffness", "virtual_damping", "limited_by", "status", "reason", "notes"))
@dataclass(frozen=True)
class Recommendation:
    """Recommended wall of a device, or the reason why none exists, from `zwidth.Scene.recommend`.

    Attributes:
        scene: the device with the recommended wall, for `zwidth.assess`, `zwidth.simulate` and figures.
        stiffest: the stiffest stable wall of the device.
        requirements: the requirements on the wall.
        limited_by: the active requirement, which excludes every stiffer wall: "stiffness_fraction", "gain_margin",
            "phase_margin", "passive", "grasps" or "safe_limit"; "" if no wall is recommended.
        status: code of `zwidth.Status`; no wall is recommended unless it is OK.
        reason: the reason why no wall is recommended; "" otherwise.
        notes: further remarks, one sentence each.
    """

    scene: Any
    stiffest: StiffestWall
    requirements: Requirements
    limited_by: str
    status: Status
    reason: str = ""
    notes: tuple[str, ...] = ()

    @property
    def unit_system(self) -> UnitSystem:
        """Unit system of the device, linear or rotary."""
        return self.scene.unit_system

    @property
    def stiffness(self) -> float:
        """Stiffness K of the wall in N/m; NaN if no wall is recommended."""
        return float(self.scene.wall.stiffness) if self.status == Status.OK else math.nan

    @property
    def virtual_damping(self) -> float:
        """Virtual damping B of the wall in N s/m; NaN if no wall is recommended."""
        return float(self.scene.wall.virtual_damping) if self.status == Status.OK else math.nan

    @cached_property
    def rounded_wall(self) -> tuple[float, float, int]:
        """K and B of the wall, rounded for printing, and their number of significant digits.

        The number of digits is the smallest, at least 4, with which the rounded wall satisfies the requirements. K is
        rounded down. If only a narrow range of B satisfies the requirements, more than 4 digits are needed.
        """
        grasped = list_grasped_scenes(self.scene, self.requirements)
        slack, verdict = measure_slack(self.scene, self.requirements, grasped), self.verdict
        ends = (math.nan, math.nan)
        if verdict is not None:
            ends = verdict.virtual_damping_lower, verdict.virtual_damping_upper

        def rounded(digits: int) -> tuple[float, float]:
            """Return K rounded down and B rounded to nearest, with this number of significant digits."""
            return round_conservatively(self.stiffness, "below", digits), float(f"{self.virtual_damping:.{digits}g}")

        def holds(digits: int) -> bool:
            """Return whether the wall rounded to this number of digits is stable and satisfies the requirements."""
            wall = rounded(digits)
            if not (self.scene.is_stable(*wall) and all(spare >= 0 for spare in slack(*wall).values())):
                return False
            # Require that the rounded B lies in the printed range of stable B, because the ends of this range are
            # rounded inwards.
            low, high = ends
            inside = (
                round_conservatively(low, "above", digits) <= wall[1] <= round_conservatively(high, "below", digits)
            )
            return inside or not low <= self.virtual_damping <= high

        digits = count_digits(holds)
        return *rounded(digits), digits

    @cached_property
    def verdict(self) -> Assessment | None:
        """Assessment of the wall by `zwidth.assess`; None if no wall is recommended."""
        return assess(self.scene) if self.status == Status.OK else None

    @cached_property
    def improvements(self) -> list[Limit]:
        """Improvements of the device that allow a stiffer wall under the same requirements, the largest gain first.

        The improvements are those of `zwidth.limits_of`. The stiffness of each entry is that of the wall recommended
        for the improved device, accurate to about 0.2 %. Twice the rate at a constant delay is included even if it
        gains nothing. The list is empty if the safe limit is active, because then only a new measurement allows a
        stiffer wall.
        """
        if self.status != Status.OK or self.is_at_safe_limit:
            return []
        steps = compute_gains(self.scene.replace(wall=NoWall()), self.stiffness, self._choose_again)
        return [step for step in steps if step.gain > 1.0 or (step.name == "period" and step.note and step.gain > 0)]

    def _choose_again(self, improved: SceneOptima) -> float:
        """Return the K recommended for an improved device under the same requirements; NaN if none is recommended."""
        try:
            top = improved.max_stiffness()
            near = self.stiffness * float(top.stiffness) / float(self.stiffest.stiffness)
            return choose_controller(improved, self.requirements, top, near, COARSE).wall.stiffness
        except InputError:
            # Return NaN for an invalid improved scene: at twice the sampling rate, a long delay may exceed the largest
            # allowed number of periods.
            return math.nan

    @cached_property
    def cautions(self) -> tuple[str, ...]:
        """Sentences on small margins of the wall and on grasps that destabilize it, each with its remedy."""
        return () if self.verdict is None else list_cautions(self)

    @cached_property
    def grasps(self) -> dict[str, bool]:
        """Dictionary that maps each of `zwidth.reference_grasps` to True if the wall is stable in this grasp.

        It is empty unless the device is a `Device`. The grasps hold a rotary device 10 to 100 mm from its axis. If the
        scene has an operator, the entry "released" is the stability without the operator.
        """
        return {} if self.status != Status.OK else judge_grasps(self.scene)

    def code(self, language: Literal["c", "python"] = "c", *, max_force: float | str = math.inf) -> str:
        """Return source code for a control loop, which renders the wall, or the virtual coupling and its tool.

        Args:
            language: "c" (C99 without any library) or "python".
            max_force: largest force of the motor in N; the code limits the force to it.

        Returns:
            Source code with a state, a function that initializes it at rest, and a function to call once per period,
            which converts the position in m, positive into the wall, to the force on the device in N. The forces equal
            those of `zwidth.simulate` with ``contact="unilateral"`` and the same ``max_force``, except for rounding
            errors. If the scene has a tool, the program also integrates the tool, and its forces equal those of
            `zwidth.simulate` with ``contact="bilateral"``.

        Raises:
            InputError: no wall is recommended, the language is unknown, or ``max_force`` is not positive.
        """
        if self.status != Status.OK:
            raise InputError(f"code: there is no wall: {self.reason}")
        limit = check_limit("max_force", max_force, self.unit_system["N"])
        return write_program(self.scene, language, self.cautions, limit)

    def cascade_gains(self, units: PositionUnit | None = None, output_unit: float = 1.0) -> CascadeGains:
        """Return the gains with which a cascade, a position loop with an inner velocity loop, renders the wall.

        Such a cascade is, for example, the controller of ODrive. The gain of its integrator is that of the scene. The
        wall is stable and satisfies the requirements with these gains, because the integrator of the field ``scene``
        contains ``pos_gain`` = K/B of the recommended wall.

        Args:
            units: position unit of the gains: "turns", "degrees", "rad" or "m". Default: turns, or m for a linear
                device.
            output_unit: force or torque per unit of output, see `zwidth.cascade`.

        Raises:
            InputError: no wall is recommended, or the further feedback is not the integrator of a cascade.

        Example:
            >>> import zwidth
            >>> device, timing = zwidth.Device("1e-4 kg m^2", "1e-4 N m s/rad"), zwidth.Timing(rate="8 kHz")
            >>> scene = zwidth.Scene(device, timing, **zwidth.cascade(20, 0.16, vel_integrator_gain=0.3))
            >>> scene.recommend(stiffness_fraction=0.1).cascade_gains().vel_integrator_gain
            0.3
        """
        return cast(CascadeGains, self._find_gains("cascade", units, output_unit))

    def pid_gains(self, units: PositionUnit | None = None, output_unit: float = 1.0) -> PidGains:
        """Return the gains of a PID controller for the wall; the integral gain is that of the scene.

        Args:
            units: position unit of the gains: "turns", "degrees", "rad" or "m". Default: rad, or m for a linear
                device.
            output_unit: force or torque per unit of output, see `zwidth.pid`.

        Raises:
            InputError: no wall is recommended, or the further feedback is not the integral of the position.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), **zwidth.pid(1000, 2000, 10))
            >>> print(f"{scene.recommend(stiffness_fraction=0.1).pid_gains().ki:.6g}")
            2000
        """
        return cast(PidGains, self._find_gains("pid", units, output_unit))

    def _find_gains(self, kind: ControllerKind, units: PositionUnit | None, output_unit: float) -> Any:
        """Return the gains of a controller that renders the wall; raise `InputError` if no wall is recommended."""
        if self.status != Status.OK:
            raise InputError(f"gains: there is no wall: {self.reason}")
        scene = self.scene
        return find_gains(
            scene.wall, scene.feedback, kind, find_units(kind, units, self.unit_system.rotary), output_unit
        )

    def lines(self) -> tuple[str, ...]:
        """Return lines of text on the wall, its margins and its cautions, or the reason why no wall is recommended."""
        verdict = self.verdict
        if verdict is None:
            return (f"no wall: {self.reason}",)
        # Compute the stable range of B at the printed K, because a negative lower end depends strongly on K.
        intervals = tuple(map(tuple, self.scene.stable_damping(self.rounded_wall[0]).tolist()))
        lower, upper = format_interval(
            *find_nearest_interval(intervals, self.virtual_damping), self.unit_system["N s/m"], self.rounded_wall[2]
        )
        room = f"B from {lower} to {upper} is stable at this K"
        margins = f"margins: {self.spell_margins()}; passive: {self.spell_passive()}; {room}"
        hands = [f"grasps: {hands}"] if (hands := self.spell_hands()) else []
        cautions = (f"caution: {caution}" for caution in self.cautions)
        return f"{self.spell_wall()}: {self.spell_limit()}", margins, *hands, *cautions

    def spell_wall(self) -> str:
        """Return a text with K and B of the recommended wall, such as "K = 8 kN/m, B = 33 N s/m"."""
        (K, B, digits), units = self.rounded_wall, self.unit_system
        return f"K = {format_stiffness(K, units, digits)}, B = {with_unit(B, units['N s/m'], digits)}"

    def spell_limit(self) -> str:
        """Return a text with the stiffness of the wall as a percentage of K_max, and with the active requirement."""
        largest = float(self.stiffest.stiffness)
        share = f"{100.0 * self.stiffness / largest:.3g} % of K_max = {format_stiffness(largest, self.unit_system)}"
        return share if self.limited_by == "stiffness_fraction" else f"{share}; {self.spell_requirement()}"

    def spell_requirement(self) -> str:
        """Return a text that names the active requirement, such as "limited by gain margin 2"."""
        bounded = (
            ", with B limited by the safe limit" if self.limited_by != "safe_limit" and self.is_at_safe_limit else ""
        )
        return f"limited by {self.requirements.spell(self.limited_by)}{bounded}"

    @property
    def is_at_safe_limit(self) -> bool:
        """True if the safe limit is active, i.e. K or B of the wall equals its bound."""
        limit = None if self.requirements.beyond_safe else self.scene.safe_limit
        ends = None if limit is None else limit.dampings(self.stiffness)
        at_end = ends is not None and any(math.isclose(self.virtual_damping, end, rel_tol=1e-3) for end in ends)
        return at_end or self.limited_by == "safe_limit"

    def spell_margins(self) -> str:
        """Return a text with gain, phase and delay margin of the wall, each rounded to the safe side."""
        verdict = self.verdict
        if verdict is None:
            return "none"
        gain, phase, late = (round_margin(f"{name}_margin", verdict, True, 3) for name in ("gain", "phase", "delay"))
        delay = "not known" if math.isnan(late) else with_unit(late, "s", 3)
        return f"gain {plain(gain, 3)}, phase {plain(phase, 3)} deg, delay {delay}"

    def spell_hands(self) -> str:
        """Return a text with the number of reference grasps in which the wall is stable; "" if none was evaluated."""
        labels = {name: stable for name, stable in self.grasps.items() if name != "released"}
        if not labels:
            return ""
        radii = f", held {1e3 * RADII[0]:g} to {1e3 * RADII[-1]:g} mm from the axis" if self.unit_system.rotary else ""
        stable = sum(labels.values())
        count = "all six" if stable == len(labels) else f"{stable} of {len(labels)}"
        return f"stable in {count} reference grasps{radii}"

    def spell_passive(self) -> str:
        """Return "yes" for a passive wall, "no" for another one, or the reason as text if passivity is not known."""
        passive = None if self.verdict is None else self.verdict.passive
        if passive and self.verdict is not None and self.verdict.passivity_margin < reserve_damping(self.scene):
            return "uncertain, because the fitted damping is"
        obstacle = find_obstacle(self.scene).partition(":")[0]
        return {True: "yes", False: "no", None: f"not known {obstacle}".rstrip()}[passive]

    def as_dict(self) -> dict[str, Any]:
        """Return a nested dictionary of all results as JSON values, in SI units and normalized; None if unknown."""
        scene, verdict, top = self.scene, self.verdict, self.stiffest
        judged = {} if verdict is None else verdict.as_dict()
        device = {name: value for name, value in scene.parameters().items() if name not in WALL}
        constant = math.nan if verdict is None or not verdict.stable else verdict.time_constant
        alpha, beta = scene.normalize_walls(top.stiffness, top.virtual_damping)
        result = {
            "units": {name: scene.unit_system[unit] for name, unit in _UNITS.items()},
            "device": {**device, "velocity": type(scene.velocity).__name__, "delta": float(scene.delta), "d": scene.d},
            "maximum": {
                "stiffness": float(top.stiffness),
                "virtual_damping": float(top.virtual_damping),
                "alpha": float(alpha),
                "beta": float(beta),
                "frequency": float(top.frequency),
                "kind": name_kind(top),
            },
            "requirements": self.requirements._asdict(),
            "recommended": {
                "stiffness_fraction": self.stiffness / float(top.stiffness),
                "limited_by": self.limited_by,
                "stiffness": self.stiffness,
                "virtual_damping": self.virtual_damping,
                # Number of significant digits with which K and B are printed.
                "digits": None if verdict is None else self.rounded_wall[2],
                **{name: judged.get(name) for name in _JUDGED},
                "stable": verdict is not None and verdict.stable,
                "decay_time": float(decay_time(1.0 / np.float64(constant))),
                # The recommend study sets this value if it computes a step response.
                "settling_time": None,
            },
            "improvements": [each._asdict() for each in self.improvements],
            "grasps": self.grasps,
            "cautions": list(self.cautions),
            "reason": self.reason,
            "notes": list(self.notes),
        }
        if self.limited_by == "stiffness_fraction":
            # Replace the computed fraction by the value that the user gave, because both may differ in the last digit.
            result["recommended"]["stiffness_fraction"] = self.requirements.stiffness_fraction
        return to_json(result)


class SceneAdvice(SceneOptima):
    """Base class of `zwidth.Scene` with the method `recommend`."""

    def recommend(
        self,
        *,
        stiffness_fraction: float | str | None = None,
        gain_margin: float | str | None = None,
        phase_margin: float | str | None = None,
        passive: bool = False,
        grasps: Grasps | None = None,
        beyond_safe: bool = False,
    ) -> Recommendation:
        """Return the wall recommended for this device: the stiffest that satisfies the requirements.

        Args:
            stiffness_fraction: largest K as a fraction of K_max, between 0 and 1, or a string such as "50%".
            gain_margin: smallest gain margin, a factor on K and B together, > 1, or a string such as "6 dB".
            phase_margin: smallest phase margin in degrees, > 0, or a string such as "30 deg".
            passive: require a passive wall.
            grasps: require stability in "all" or only the "soft" grasps of `zwidth.reference_grasps`, or in "none".
            beyond_safe: ignore the scene's safe limit. By default the wall lies within the limit, and its K is at most
                ``stiffness_fraction`` (default 0.75) of the limit's stiffness.

        If neither a fraction, a margin nor passivity is given, the defaults are a stiffness fraction of 0.75, a gain
        margin of 2, a phase margin of 30 degrees and, for a `Device` without an operator, ``grasps="soft"``. If one of
        them is given, it replaces all defaults, so that ``passive=True`` alone yields the stiffest passive wall.
        ``grasps`` leaves the other defaults unchanged.

        Returns:
            Recommendation: ``stiffness`` and ``virtual_damping``; ``limited_by``, the active requirement; ``cautions``,
            small margins and grasps that destabilize the wall; ``verdict``, the `zwidth.assess` of the wall;
            ``improvements``, changes of the device that allow a stiffer wall under the same requirements;
            ``code("c")``, the wall as a program for a control loop. ``status`` is UNREACHABLE if no wall satisfies the
            requirements.

        If the further feedback is the integrator of a cascade (`zwidth.cascade`), ``pos_gain`` = K/B of the recommended
        wall also becomes the ``pos_gain`` of the integrator. ``recommend(...).cascade_gains()`` returns all gains.

        Numerics:
            A stiffness fraction without other requirements needs no search: B is that of the stiffest wall if the wall
            is stable with it. Required margins need a search over K and B, in which `margins` and `passivity_margin`
            decide every wall; K is within 1e-4 of the largest value found. The search takes 0.5 s for a rigid device
            and some seconds with other parts.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> advice = scene.recommend(phase_margin=30)
            >>> print(f"{advice.stiffness:.0f} N/m and {advice.virtual_damping:.0f} N s/m")
            8009 N/m and 33 N s/m
            >>> scene.recommend().limited_by
            'phase_margin'
        """
        if getattr(self.device, "is_display", False):
            raise InputError(
                "recommend: got the scene of an admittance display, where K and B belong to the environment; use "
                "min_virtual_mass or min_virtual_damping of the display"
            )
        requirements = Requirements.check(stiffness_fraction, gain_margin, phase_margin, passive, beyond_safe, grasps)
        if requirements.passive and (obstacle := find_obstacle(self)):
            raise InputError(f"passive: got True {obstacle}")
        if not isinstance(self.device, Device) and requirements.grasps != "none" and grasps is not None:
            raise InputError(f"grasps: got {grasps!r}, but the device is no Device with a mass; only 'none' is allowed")
        if grasps is None and (self.operator is not None or not isinstance(self.device, Device)):
            requirements = requirements._replace(grasps="none")
        bare = self.replace(wall=NoWall())
        top, notes = bare.max_stiffness(), describe_islands(bare)
        if np.isinf(top.stiffness):
            raise InputError("tool: the coupling is stable with every stiffness; choose K and B by assess or margins")
        bare, top, choice = choose_controller(bare, requirements, top)
        notes += [choice.note] if choice.note else []
        notes += describe_limit(self.safe_limit, beyond_safe, self.unit_system)
        if choice.status == Status.OK:
            bare = bare.replace(wall=VirtualWall(choice.stiffness, choice.damping))
        return Recommendation(bare, top, requirements, choice.limit, choice.status, choice.reason, tuple(notes))
