"""The wall to set on a device: as stiff as what is wanted of it allows, and what would allow more."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from zwidth.arrays.roots import find_lowest
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
    describe_islands,
    limits_of,
    name_kind,
    round_margin,
)
from zwidth.scenes.stiffest import SceneOptima, StiffestWall, choose_damping, soft_dampings
from zwidth.scenes.wall_code import write_wall
from zwidth.words.errors import InputError
from zwidth.words.formatting import count_digits, plain, round_safely, spell_stiffness, tell_apart, to_json, with_unit
from zwidth.words.quantities import FRACTION, RECOMMENDED_SHARE, WALL, Range
from zwidth.words.rotation import own_unit
from zwidth.words.showing import shown
from zwidth.words.status import Status
from zwidth.words.units import to_float

# Dampings tried at a stiffness, and to what share of itself the best is then found: passive ones of a weakly damped
# device are few of those that are stable.
_SAMPLES, _NEAR = 18, 2e-4
# Stiffnesses tried downwards from the most that is allowed, each this much of the one before; and the halvings between
# two of them, to less than 1e-4.
_DOWN, _TRIALS, _HALVINGS = 0.25, 15, 14

RANGES = {"gain_margin": Range(1.0, low_open=True), "phase_margin": Range(0.0, 180.0, True, True)}
_OTHER_DAMPING = "with the damping of the stiffest wall this share of its stiffness is not stable: B is another one"
_UNITS = {"stiffness": "N/m", "damping": "N s/m", "virtual_damping": "N s/m"}
_UNITS |= {"mass": "kg", "time": "s", "frequency": "Hz"}
_EXAMPLES = {"stiffness_fraction": "0.6 for 60 %", "gain_margin": "2 for 6 dB", "phase_margin": "30 for 30 degrees"}
_JUDGED = (
    *("alpha", "beta", "virtual_damping_lower", "virtual_damping_upper", "spectral_radius", "passive"),
    *("passivity_margin", "time_constant", "frequency", "gain_margin", "phase_margin", "delay_margin"),
)


class Wanted(NamedTuple):
    """What is asked of a wall; None where nothing is."""

    stiffness_fraction: float | None = None  # at most this share of K_max
    gain_margin: float | None = None  # at least, a factor
    phase_margin: float | None = None  # at least, in degrees
    passive: bool = False

    @classmethod
    def check(
        cls, stiffness_fraction: float | None, gain_margin: float | None, phase_margin: float | None, passive: bool
    ) -> Wanted:
        """What is asked, with the usual share of K_max where nothing else is; or `InputError`."""
        ranges = {"stiffness_fraction": FRACTION, **RANGES}
        given = dict(zip(ranges, (stiffness_fraction, gain_margin, phase_margin), strict=True))
        for name, value in given.items():
            number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if value is not None and not (number and math.isfinite(to_float(value)) and ranges[name].holds(value)):
                raise InputError(f"{name}: got {value!r}; a number {ranges[name]} is needed, as {_EXAMPLES[name]}")
        if not isinstance(passive, bool | np.bool_):
            raise InputError(f"passive: got {passive!r}; True or False is needed")
        if gain_margin is None and phase_margin is None and not passive and stiffness_fraction is None:
            given["stiffness_fraction"] = RECOMMENDED_SHARE
        return cls(**given, passive=bool(passive))

    def spell(self, name: str) -> str:
        """One of them in words."""
        return {
            "gain_margin": f"a gain margin of {self.gain_margin:g}" if self.gain_margin else "",
            "phase_margin": f"a phase margin of {self.phase_margin:g} degrees" if self.phase_margin else "",
            "passive": "passivity",
            "safe_limit": "the safe limit",
        }[name]


@shown(("stiffness", "virtual_damping", "limited_by", "status", "reason", "notes"))
@dataclass(frozen=True)
class Recommendation:
    """A wall to set on a device; from `zwidth.Scene.recommend`.

    Attributes:
        scene: the device with this wall as its own, for `zwidth.assess`, `zwidth.simulate` and pictures.
        stiffest: the stiffest stable wall of the device.
        wanted: what was asked of the wall.
        limited_by: which of that allows no stiffer wall: "stiffness_fraction", "gain_margin", "phase_margin" or
            "passive", or "safe_limit", the limit of the scene; "" where there is no wall.
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
        surplus = _measure(self.scene, self.wanted)

        def rounded(digits: int) -> tuple[float, float]:
            return round_safely(self.stiffness, "below", digits), float(f"{self.virtual_damping:.{digits}g}")

        def holds(digits: int) -> bool:
            wall = rounded(digits)
            return bool(self.scene.is_stable(*wall)) and all(spare >= 0 for spare in surplus(*wall).values())

        digits = count_digits(holds)
        return *rounded(digits), digits

    @cached_property
    def verdict(self) -> Assessment | None:
        """What `zwidth.assess` finds of the wall; None where there is none."""
        return assess(self.scene) if self.status == Status.OK else None

    @cached_property
    def steps(self) -> list[Limit]:
        """What would allow a stiffer wall, in steps that can be bought, by `zwidth.limits_of`: the best first."""
        known = limits_of(self.scene) if self.stiffest.status == Status.OK else []
        return [step for step in known if step.gain > 1.0]

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
        """The wall in two lines, what to set and how far that is from trouble; in one why there is none."""
        verdict = self.verdict
        if verdict is None:
            return (f"no wall: {self.reason}",)
        K, B, digits = self.read
        wall = f"K = {spell_stiffness(K, digits)}, B = {with_unit(B, 'N s/m', digits)}"
        largest = float(self.stiffest.stiffness)
        share = 100.0 * self.stiffness / largest
        first = f"{wall}: {share:.4g} % of the stiffest stable wall, {spell_stiffness(largest)}"
        if self.limited_by != "stiffness_fraction":
            first += f"; {self.wanted.spell(self.limited_by)} allows no more"
        lower, upper = tell_apart(verdict.virtual_damping_lower, verdict.virtual_damping_upper, "N s/m")
        # A unit that both have stands once.
        lower = lower.removesuffix(f" {upper.partition(' ')[2]}")
        gain, phase, late = (round_margin(f"{name}_margin", verdict, True) for name in ("gain", "phase", "delay"))
        delay = "not known" if math.isnan(late) else with_unit(late, "s")
        apart = f"gain {plain(gain)}, phase {plain(phase)} degrees, delay {delay}"
        rest = f"margins: {apart}; passive: {self.spell_passive()}"
        return first, f"stable for B from {lower} to {upper}; {rest}"

    def spell_passive(self) -> str:
        """Whether the wall is passive, or why that is not known."""
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
            "reason": self.reason,
            "notes": list(self.notes),
        }
        if self.limited_by == "stiffness_fraction":
            # As it was given: the quotient may have another last digit.
            found["recommended"]["stiffness_fraction"] = self.wanted.stiffness_fraction
        return to_json(found)


Surplus = Callable[[float, Any], dict[str, np.ndarray]]


def _measure(scene: SceneOptima, wanted: Wanted) -> Surplus:
    """By how much walls have more than is wanted beside a share of K_max, by its name, negative for too little."""
    own = float(scene.device.damping)
    asked = [name for name in ("gain_margin", "phase_margin") if getattr(wanted, name)]

    def surplus(stiffness: float, damping: Any) -> dict[str, np.ndarray]:
        alpha, beta = np.broadcast_arrays(*scene.normalize_walls(stiffness, damping))
        stable, found = scene.loop.labels(alpha, beta), {}
        if asked:
            margins = scene.loop.margins(alpha, beta, asked)
            if wanted.gain_margin:
                with np.errstate(all="ignore"):
                    found["gain_margin"] = np.abs(np.log(margins.gain_margin)) / math.log(wanted.gain_margin) - 1.0
            if wanted.phase_margin:
                found["phase_margin"] = np.asarray(margins.phase_margin) / wanted.phase_margin - 1.0
        if wanted.passive:
            found["passive"] = np.asarray(scene.passivity_margin(stiffness, damping)) / (own or 1.0)
        return {name: np.where(stable & ~np.isnan(value), value, -1.0) for name, value in found.items()}

    return surplus


def _clip_dampings(scene: SceneOptima, stiffness: float, limit: SafeLimit | None) -> list[tuple[float, float]]:
    """Return the intervals of beta, connected to K = 0, that are stable and within the safe limit."""
    intervals = soft_dampings(scene, stiffness)
    if limit is None:
        return intervals
    low, high = np.array(limit.dampings(stiffness) or (math.inf, -math.inf)) / scene.units.virtual_damping
    clipped = [(max(start, low), min(end, high)) for start, end in intervals]
    return [(start, end) for start, end in clipped if start <= end]


def _search(scene: SceneOptima, surplus: Surplus, most: float, limit: SafeLimit | None) -> tuple[float, float]:
    """K and B of the stiffest wall that has all that is wanted, from the most downwards; NaN where none was found."""

    def suit(log_stiffness: float) -> tuple[float, float] | None:
        """The wall that has the most to spare of what is scarcest, if it has all that is wanted."""
        stiffness, unit = math.exp(log_stiffness), scene.units.virtual_damping

        def cost(beta: Any) -> np.ndarray:
            return -np.min(list(surplus(stiffness, beta * unit).values()), axis=0)

        intervals = _clip_dampings(scene, stiffness, limit)
        found = [
            find_lowest(cost, low, high, _SAMPLES, _NEAR) if high > low else (float(cost(low)), low)
            for low, high in intervals
        ]
        lowest, beta = min(found, default=(1.0, math.nan))
        return (stiffness, beta * unit) if lowest <= 0 else None

    low = high = math.log(most)
    wall = suit(high)
    if wall is not None:
        return most, wall[1]
    for _ in range(_TRIALS):
        low, high = low + math.log(_DOWN), low
        wall = suit(low)
        if wall is not None:
            break
    else:
        return math.nan, math.nan
    # By halves: where a margin without an end ends, what is to spare jumps.
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        stiffer = suit(middle)
        low, high, wall = (low, middle, wall) if stiffer is None else (middle, high, stiffer)
    # A wall to type in: no more digits than a device can tell apart, where what is wanted allows it.
    short = float(f"{wall[0]:.6g}"), float(f"{wall[1]:.6g}")
    return short if min(map(float, surplus(*short).values())) >= 0 else wall


def _describe_limit(limit: SafeLimit | None, ignored: bool) -> list[str]:
    """Return the notes on a safe limit: the limit with its reason, and its warnings."""
    if limit is None:
        return []
    return [f"safe limit{' (ignored)' if ignored else ''}: {limit.describe()}", *limit.warnings]


def _forbid(limit: SafeLimit) -> str:
    """Return the reason that no wall is recommended within a limit that supports none."""
    return f"no wall is safe: {'; '.join(limit.warnings) or limit.reason or 'the safe limit is 0'}"


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
            stiffness_fraction: at most this share of K_max, between 0 and 1; 0.75 where nothing is asked for.
            gain_margin: at least this factor on stiffness and damping together, > 1.
            phase_margin: at least so many degrees, > 0.
            passive: whether the wall must be passive.
            beyond_safe: ignore the scene's safe limit. By default the wall lies within the limit, and its stiffness is
                at most ``stiffness_fraction`` (or 0.75) of the limit's.

        Returns:
            Recommendation: ``stiffness`` and ``virtual_damping``; ``limited_by``, what allows no more; ``verdict``,
            what `zwidth.assess` says of the wall; ``steps``, what could be bought for a stiffer one; ``code("c")``, the
            wall for a control loop. ``status`` is UNREACHABLE, and there is no wall, where nothing softer keeps what is
            asked for either.

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
        """
        check_held(self)
        wanted = Wanted.check(stiffness_fraction, gain_margin, phase_margin, passive)
        if wanted.passive and (obstacle := find_obstacle(**vars(self.device))):
            raise InputError(f"passive: got True {obstacle}")
        bare = self.replace(wall=NoWall())
        limit = None if beyond_safe else self.safe_limit
        top, notes = bare.max_stiffness(), [*describe_islands(bare), *_describe_limit(self.safe_limit, beyond_safe)]
        if top.status != Status.OK:
            status = Status(int(top.status))
            reason = "no stiffness is stable at any damping" if status == Status.NO_BOUNDARY else status.message
            return Recommendation(bare, top, wanted, "", status, reason, tuple(notes))
        most, binding = (wanted.stiffness_fraction or 1.0) * float(top.stiffness), "stiffness_fraction"
        if limit is not None:
            if limit.forbids_all:
                return Recommendation(bare, top, wanted, "", Status.UNREACHABLE, _forbid(limit), tuple(notes))
            # The reserve is the same, whichever limit binds.
            safe = (wanted.stiffness_fraction or RECOMMENDED_SHARE) * limit.stiffness
            most, binding = (safe, "safe_limit") if safe < most else (most, binding)
        usual = choose_damping(bare, top, most)
        if limit is not None:
            low, high = limit.dampings(most) or (usual, usual)
            usual = min(max(usual, low), high)
        stiffness, damping = most, usual
        surplus = _measure(bare, wanted)
        spare = surplus(most, usual)
        if spare and not (wanted.stiffness_fraction and min(spare.values()) >= 0):
            stiffness, damping = _search(bare, surplus, most, limit)
            if math.isnan(stiffness):
                asked = " and ".join(map(wanted.spell, spare))
                undamped = wanted.passive and bare.device.damping == 0
                why = "without damping of the device no wall is passive" if undamped else "ask for less"
                reason = f"none was found that keeps {asked}, however soft; {why}"
                return Recommendation(bare, top, wanted, "", Status.UNREACHABLE, reason, tuple(notes))
            spare = surplus(stiffness, damping)
            if stiffness < most:
                binding = min(spare, key=lambda name: float(spare[name]))
        elif not np.all(bare.is_stable(stiffness, damping)):
            share = most / float(top.stiffness)
            reason = f"none was found that is stable at {share:g} of the largest stiffness; choose another share"
            return Recommendation(bare, top, wanted, "", Status.UNREACHABLE, reason, tuple(notes))
        elif damping != top.virtual_damping and limit is None:
            notes.append(_OTHER_DAMPING)
        wall = VirtualWall(check_number("stiffness", stiffness), check_number("virtual_damping", damping))
        return Recommendation(bare.replace(wall=wall), top, wanted, binding, Status.OK, notes=tuple(notes))
