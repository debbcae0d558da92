"""The wall to set on a device: the stiffest with the required margins, its risks, and improvements of the device."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from zwidth.loops.linear.passivity import find_obstacle
from zwidth.loops.rigid.response import decay_time
from zwidth.parts.checks import check_number
from zwidth.parts.safe_limit import SafeLimit
from zwidth.parts.wall import NoWall, VirtualWall
from zwidth.scenes.assessment import (
    Assessment,
    Limit,
    assess,
    check_held,
    compute_gains,
    describe_islands,
    name_kind,
    round_margin,
)
from zwidth.scenes.cautions import judge_grasps, list_cautions
from zwidth.scenes.stiffest import SceneOptima, StiffestWall
from zwidth.scenes.wall_code import write_wall
from zwidth.scenes.wall_search import COARSE, Wanted, choose_wall, measure_slack
from zwidth.words.errors import InputError
from zwidth.words.formatting import count_digits, plain, round_safely, spell_stiffness, tell_apart, to_json, with_unit
from zwidth.words.quantities import WALL
from zwidth.words.rotation import own_unit
from zwidth.words.showing import shown
from zwidth.words.status import Status

_UNITS = {"stiffness": "N/m", "damping": "N s/m", "virtual_damping": "N s/m"}
_UNITS |= {"mass": "kg", "time": "s", "frequency": "Hz"}
_JUDGED = (
    *("alpha", "beta", "virtual_damping_lower", "virtual_damping_upper", "spectral_radius", "passive"),
    *("passivity_margin", "time_constant", "frequency", "gain_margin", "phase_margin", "delay_margin"),
)


@shown(("stiffness", "virtual_damping", "limited_by", "status", "reason", "notes"))
@dataclass(frozen=True)
class Recommendation:
    """A wall to set on a device; from `zwidth.Scene.recommend`.

    Attributes:
        scene: the device with this wall as its own, for `zwidth.assess`, `zwidth.simulate` and pictures.
        stiffest: the stiffest stable wall of the device.
        wanted: what was asked of the wall.
        limited_by: which of that allows no stiffer wall: "stiffness_fraction", "gain_margin", "phase_margin",
            "passive" or "safe_limit", the limit of the scene; "" where there is no wall.
        status: code of `zwidth.Status`; where it is not OK there is no wall to set.
        reason: why there is none.
        notes: what else to know, in sentences.
    """

    scene: Any
    stiffest: StiffestWall
    wanted: Wanted
    limited_by: str
    status: Status
    reason: str = ""
    notes: tuple[str, ...] = ()

    @property
    def stiffness(self) -> float:
        """K in N/m; NaN where there is no wall."""
        return float(self.scene.wall.stiffness) if self.status == Status.OK else math.nan

    @property
    def virtual_damping(self) -> float:
        """B in N s/m; NaN where there is no wall."""
        return float(self.scene.wall.virtual_damping) if self.status == Status.OK else math.nan

    @cached_property
    def read(self) -> tuple[float, float, int]:
        """K and B as they are printed, and their digits: the fewest, from 4 on, with which the wall has what is wanted.

        K is rounded down; of a tip that leans, or of a narrow column, B needs more digits than others.
        """
        slack, verdict = measure_slack(self.scene, self.wanted), self.verdict
        ends = (math.nan, math.nan)
        if verdict is not None:
            ends = verdict.virtual_damping_lower, verdict.virtual_damping_upper

        def rounded(digits: int) -> tuple[float, float]:
            return round_safely(self.stiffness, "below", digits), float(f"{self.virtual_damping:.{digits}g}")

        def holds(digits: int) -> bool:
            wall = rounded(digits)
            if not (self.scene.is_stable(*wall) and all(spare >= 0 for spare in slack(*wall).values())):
                return False
            # The printed B must lie in the printed range of stable B, whose ends are rounded inwards.
            low, high = ends
            inside = round_safely(low, "above", digits) <= wall[1] <= round_safely(high, "below", digits)
            return inside or not low <= self.virtual_damping <= high

        digits = count_digits(holds)
        return *rounded(digits), digits

    @cached_property
    def verdict(self) -> Assessment | None:
        """What `zwidth.assess` finds of the wall; None where there is none."""
        return assess(self.scene) if self.status == Status.OK else None

    @cached_property
    def steps(self) -> list[Limit]:
        """The improvements of `zwidth.limits_of` that allow a stiffer wall under the same requirements, the best first.

        Their stiffness is that of the wall recommended for the improved device, right to some 0.2 %. Within a safe
        limit that allows no better wall, only a new measurement allows a stiffer one: the list is empty.
        """
        if self.status != Status.OK or self.is_held_back:
            return []
        found = compute_gains(self.scene.replace(wall=NoWall()), self.stiffness, self._choose_again)
        return [step for step in found if step.gain > 1.0]

    def _choose_again(self, improved: SceneOptima) -> float:
        """Return K of the wall recommended for another device under the same requirements; NaN without one."""
        try:
            top = improved.max_stiffness()
            near = self.stiffness * float(top.stiffness) / float(self.stiffest.stiffness)
            return choose_wall(improved, self.wanted, top, near, COARSE).stiffness
        except InputError:
            # At twice the rate a long delay may be more periods than the model is computed for.
            return math.nan

    @cached_property
    def cautions(self) -> tuple[str, ...]:
        """Thin margins of the wall and hands that destabilize it, each with its remedy, in sentences."""
        return () if self.verdict is None else list_cautions(self)

    @cached_property
    def grasps(self) -> dict[str, bool]:
        """Stability of the wall in each of `zwidth.reference_grasps`, by name; empty for a device given as a whole.

        A rotary device is held at radii of 10 to 100 mm. If the scene has an operator, "released" is the device
        without it.
        """
        return {} if self.status != Status.OK else judge_grasps(self.scene)

    def code(self, language: Literal["c", "python"] = "c") -> str:
        """The wall with its velocity estimate as the difference equations of a control loop.

        Args:
            language: "c" (C99 without any library) or "python".

        Returns:
            A text: a state, a function that begins at rest and one that turns a position in m, positive into the wall,
            into the force on the device in N, once a period. Forces are those of `zwidth.simulate` with
            ``contact="unilateral"`` but for rounding.

        Raises:
            InputError: there is no wall, or no such language.
        """
        if self.status != Status.OK:
            raise InputError(f"code: there is no wall: {self.reason}")
        return write_wall(self.scene, language)

    def lines(self) -> tuple[str, ...]:
        """Return the wall, its margins and its cautions, a line each; or the reason why no wall exists."""
        verdict = self.verdict
        if verdict is None:
            return (f"no wall: {self.reason}",)
        lower, upper = tell_apart(verdict.virtual_damping_lower, verdict.virtual_damping_upper, "N s/m", self.read[2])
        room = f"B from {lower} to {upper} is stable at this K"
        margins = f"margins: {self.spell_margins()}; passive: {self.spell_passive()}; {room}"
        cautions = (f"caution: {caution}" for caution in self.cautions)
        return f"{self.spell_wall()}: {self.spell_limit()}", margins, *cautions

    def spell_wall(self) -> str:
        """Return the wall to set in words."""
        K, B, digits = self.read
        return f"K = {spell_stiffness(K, digits)}, B = {with_unit(B, 'N s/m', digits)}"

    def spell_limit(self) -> str:
        """Return the share of K_max and the requirement that allows no stiffer wall, in words."""
        largest = float(self.stiffest.stiffness)
        share = f"{100.0 * self.stiffness / largest:.3g} % of K_max = {spell_stiffness(largest)}"
        return share if self.limited_by == "stiffness_fraction" else f"{share}; {self.spell_requirement()}"

    def spell_requirement(self) -> str:
        """Return the requirement that allows no stiffer wall, in words."""
        within = " within the safe limit" if self.limited_by != "safe_limit" and self.is_held_back else ""
        return f"limited by {self.wanted.spell(self.limited_by)}{within}"

    @property
    def is_held_back(self) -> bool:
        """True if the safe limit allows no better wall: the stiffness is at the limit, or the virtual damping."""
        limit = None if self.wanted.beyond_safe else self.scene.safe_limit
        ends = None if limit is None else limit.dampings(self.stiffness)
        at_end = ends is not None and any(math.isclose(self.virtual_damping, end, rel_tol=1e-3) for end in ends)
        return at_end or self.limited_by == "safe_limit"

    def spell_margins(self) -> str:
        """Return the margins of the wall in words, rounded to the safe side."""
        verdict = self.verdict
        if verdict is None:
            return "none"
        gain, phase, late = (round_margin(f"{name}_margin", verdict, True, 3) for name in ("gain", "phase", "delay"))
        delay = "not known" if math.isnan(late) else with_unit(late, "s", 3)
        return f"gain {plain(gain, 3)}, phase {plain(phase, 3)} deg, delay {delay}"

    def spell_passive(self) -> str:
        """Return the passivity of the wall in words."""
        passive = None if self.verdict is None else self.verdict.passive
        obstacle = find_obstacle(**vars(self.scene.device)).partition(":")[0]
        return {True: "yes", False: "no", None: f"not known {obstacle}".rstrip()}[passive]

    def as_dict(self) -> dict[str, Any]:
        """All of it as plain JSON values in SI units, with the normalized ones beside them; None where not known."""
        scene, verdict, top = self.scene, self.verdict, self.stiffest
        judged = {} if verdict is None else verdict.as_dict()
        device = {name: value for name, value in scene.parameters().items() if name not in WALL}
        constant = math.nan if verdict is None or not verdict.stable else verdict.time_constant
        alpha, beta = scene.normalize_walls(top.stiffness, top.virtual_damping)
        found = {
            "units": {name: own_unit(unit) for name, unit in _UNITS.items()},
            "device": {**device, "velocity": type(scene.velocity).__name__, "delta": float(scene.delta), "d": scene.d},
            "maximum": {
                "stiffness": float(top.stiffness),
                "virtual_damping": float(top.virtual_damping),
                "alpha": float(alpha),
                "beta": float(beta),
                "frequency": float(top.frequency),
                "kind": name_kind(top),
            },
            "wanted": self.wanted._asdict(),
            "recommended": {
                "stiffness_fraction": self.stiffness / float(top.stiffness),
                "limited_by": self.limited_by,
                "stiffness": self.stiffness,
                "virtual_damping": self.virtual_damping,
                # As many as it takes to write it down.
                "digits": None if verdict is None else self.read[2],
                **{name: judged.get(name) for name in _JUDGED},
                "stable": verdict is not None and verdict.stable,
                "decay_time": float(decay_time(1.0 / np.float64(constant))),
                # Of the response to a step, where one is drawn.
                "settling_time": None,
            },
            "steps": [step._asdict() for step in self.steps],
            "grasps": self.grasps,
            "cautions": list(self.cautions),
            "reason": self.reason,
            "notes": list(self.notes),
        }
        if self.limited_by == "stiffness_fraction":
            # As it was given: the quotient may have another last digit.
            found["recommended"]["stiffness_fraction"] = self.wanted.stiffness_fraction
        return to_json(found)


def _describe_limit(limit: SafeLimit | None, ignored: bool) -> list[str]:
    """Return the notes on a safe limit: the limit with its reason, and its warnings."""
    if limit is None or (limit.forbids_all and not ignored):
        # A limit that forbids all walls is the reason of the recommendation.
        return []
    return [f"safe limit{' (ignored)' if ignored else ''}: {limit.describe()}", *limit.warnings]


class SceneAdvice(SceneOptima):
    """The question of `zwidth.Scene` what to set."""

    def recommend(
        self,
        *,
        stiffness_fraction: float | None = None,
        gain_margin: float | None = None,
        phase_margin: float | None = None,
        passive: bool = False,
        beyond_safe: bool = False,
    ) -> Recommendation:
        """The stiffest wall that keeps some distance from trouble: the one to set on this device.

        Args:
            stiffness_fraction: at most this share of K_max, between 0 and 1.
            gain_margin: at least this factor on stiffness and damping together, > 1.
            phase_margin: at least so many degrees, > 0.
            passive: require a passive wall.
            beyond_safe: ignore the scene's safe limit. By default the wall lies within the limit, and its stiffness is
                at most ``stiffness_fraction`` (or 0.75) of the limit's.

        Without any requirement these are the defaults: at most 0.75 of K_max, a gain margin of 2, a phase margin of 30
        degrees, and stability in the soft reference grasps. Any requirement replaces all of them.

        Returns:
            Recommendation: ``stiffness`` and ``virtual_damping``; ``limited_by``, the active requirement; ``cautions``,
            thin margins and grasps that destabilize the wall; ``verdict``, the `zwidth.assess` of the wall; ``steps``,
            improvements of the device that allow a stiffer wall under the same requirements; ``code("c")``, the wall
            for a control loop. ``status`` is UNREACHABLE if no wall, however soft, satisfies the requirements.

        Numerics:
            A share of K_max alone is in closed form, with the damping of the stiffest wall where it is stable. Margins
            take a search over K and B: each wall is judged by `margins` and `passivity_margin` themselves, and K lies
            within 1e-4 of the largest that was found; 0.5 s for a rigid device, some seconds with other parts.

        Example:
            >>> import zwidth
            >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
            >>> found = scene.recommend(phase_margin=30)
            >>> print(f"{found.stiffness:.0f} N/m and {found.virtual_damping:.0f} N s/m")
            8009 N/m and 33 N s/m
            >>> scene.recommend().limited_by
            'phase_margin'
        """
        check_held(self)
        wanted = Wanted.check(stiffness_fraction, gain_margin, phase_margin, passive, beyond_safe)
        if wanted.passive and (obstacle := find_obstacle(**vars(self.device))):
            raise InputError(f"passive: got True {obstacle}")
        bare = self.replace(wall=NoWall())
        top, notes = bare.max_stiffness(), describe_islands(bare)
        found = choose_wall(bare, wanted, top)
        notes += [found.note] if found.note else []
        notes += _describe_limit(self.safe_limit, beyond_safe)
        if found.status == Status.OK:
            stiffness = check_number("stiffness", found.stiffness)
            wall = VirtualWall(stiffness, check_number("virtual_damping", found.damping))
            bare = bare.replace(wall=wall)
        return Recommendation(bare, top, wanted, found.limit, found.status, found.reason, tuple(notes))
