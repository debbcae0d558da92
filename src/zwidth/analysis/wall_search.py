"""Search for the stiffest wall of a scene that satisfies requirements on its margins.

The *slack* of a requirement is the relative excess over it: 0 at the limit, negative if the requirement is violated, -1
for an unstable wall. The slack of a stiffness K is the smallest slack of all requirements with the best damping B. The
search brackets the largest K with nonnegative slack by steps on log K, and then finds the zero of the slack by false
position (`numerics.root_finding.false_position`). The active requirement of a wall is the one that excludes every
stiffer wall. Grasps are models of a hand on the device; the *safe limit* bounds K and B to walls that measurements of
the device support.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from zwidth.analysis.optimization import (
    SceneOptima,
    StiffestWall,
    choose_damping,
    explain_missing,
    find_connected_dampings,
)
from zwidth.core.errors import InputError, check_choice
from zwidth.core.status import Status
from zwidth.model.device import Device
from zwidth.model.feedback import IntegralFeedback
from zwidth.model.grasps import list_grasps
from zwidth.model.safe_limit import SafeLimit, reserve_damping
from zwidth.numerics.root_finding import false_position, find_global_minimum
from zwidth.units.parsing import read_degrees, read_factor, read_share, to_float
from zwidth.units.quantities import FRACTION, RECOMMENDED_SHARE, Range

# Requirements that apply if the user gives none; docs/guides/my-device.md gives the reasons for these values.
DEFAULT_PHASE_MARGIN = 30.0  # smallest phase margin, in degrees
DEFAULT_GAIN_MARGIN = 2.0  # smallest gain margin, a factor on K and B together; equals 6 dB

SAMPLES = 18  # values of B per stiffness; a weakly damped device is passive only in a small part of its stable range
NEAR = 5.0  # ratio of the tolerance of the best B to that of K; B may be less accurate, because its optimum is flat
LEAST = 1e-9  # smallest stiffness tried, relative to the largest allowed one
STEP_DOWN = 0.25  # factor by which K is lowered until a wall satisfies the requirements
STEP_DOWN_UNSTABLE = 0.95  # the same for a device unstable without a wall, whose stable walls have a lower end in K
GRASP_GAIN = 1.1  # factor on K and B with which a wall must be stable in a required grasp, because grasps vary
GRASP_GUESS = 0.95  # factor on K for the initial guess if a grasp destabilizes the wall
FIRST_STEP = 0.9  # factor of the first step from an initial guess of K, which is usually close
WIDTH = 4e-5  # half-width of the bracket of log K at which the search ends
COARSE = 1e-3  # half-width of the bracket of log K for alternatives, whose gain or cost is printed with 2 or 3 digits
# Search for the wall of a cascade, whose integrator contains pos_gain = K/B and therefore depends on the wall
MATCHED = 1e-5  # relative change of K/B below which the search has converged
RESTARTS = (0.5, 0.1, 0.02)  # pos_gain at the start of further searches, relative to K/B of the wall without integrator
MAX_MATCHES = 8  # largest number of walls chosen per search; 3 usually suffice
# Factors on K and B, tried in this order, until the wall with its integrator satisfies the requirements
REDUCTIONS = (1.0, 1.0 - 1e-5, 1.0 - 1e-4, 0.999, 0.99, 0.97, 0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
MAX_STEPS = 60  # root-finding steps on log K, bisections included; 8 usually suffice

RANGES = {"gain_margin": Range(1.0, low_open=True), "phase_margin": Range(0.0, 180.0, True, True)}
_EXAMPLES = {"stiffness_fraction": "0.6 for 60 %", "gain_margin": "2 for 6 dB", "phase_margin": "30 for 30 degrees"}
_READERS = {"stiffness_fraction": read_share, "gain_margin": read_factor, "phase_margin": read_degrees}
OTHER_DAMPING = "B differs from that of the stiffest wall, because with that B this share of K_max is unstable"

Slack = Callable[[float, Any], dict[str, np.ndarray]]
Grasps: TypeAlias = Literal["all", "soft", "none"]


class Requirements(NamedTuple):
    """Requirements on a wall; None for no requirement."""

    stiffness_fraction: float | None = None  # upper limit of K/K_max
    gain_margin: float | None = None  # lower limit, as a factor
    phase_margin: float | None = None  # lower limit, in degrees
    passive: bool = False  # require passivity
    beyond_safe: bool = False  # ignore the safe limit of the scene
    grasps: Grasps = "none"  # require stability in these grasps of `zwidth.reference_grasps`

    @classmethod
    def check(
        cls,
        stiffness_fraction: float | str | None,
        gain_margin: float | str | None,
        phase_margin: float | str | None,
        passive: bool,
        beyond_safe: bool = False,
        grasps: Grasps | None = None,
    ) -> Requirements:
        """Check the arguments of `recommend`, and return them as requirements; the defaults apply if none is given."""
        ranges = {"stiffness_fraction": FRACTION, **RANGES}
        given = dict(zip(ranges, (stiffness_fraction, gain_margin, phase_margin), strict=True))
        limits = {name: _read_limit(name, value) for name, value in given.items()}
        for name, value in limits.items():
            number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if value is not None and not (number and math.isfinite(to_float(value)) and ranges[name].holds(value)):
                raise InputError(f"{name}: got {value!r}; a number {ranges[name]} is needed, such as {_EXAMPLES[name]}")
        switches = {"passive": passive, "beyond_safe": beyond_safe}
        for name, value in switches.items():
            if not isinstance(value, bool | np.bool_):
                raise InputError(f"{name}: got {value!r}; True or False is needed")
        if grasps is not None:
            check_choice("grasps", grasps, ("all", "soft", "none"))
        default = not passive and all(value is None for value in limits.values())
        if default:
            limits = dict(zip(limits, (RECOMMENDED_SHARE, DEFAULT_GAIN_MARGIN, DEFAULT_PHASE_MARGIN), strict=True))
        return cls(
            **limits,
            passive=bool(passive),
            beyond_safe=bool(beyond_safe),
            grasps=grasps or ("soft" if default else "none"),
        )

    def spell(self, name: str) -> str:
        """Return a text that describes the requirement ``name``, a field of `Requirements` or "safe_limit"."""
        return {
            "stiffness_fraction": f"{100.0 * (self.stiffness_fraction or 1.0):.4g} % of K_max",
            "gain_margin": f"gain margin {self.gain_margin:g}" if self.gain_margin else "",
            "phase_margin": f"{self.phase_margin:g} deg phase margin" if self.phase_margin else "",
            "passive": "passivity",
            "grasps": f"stability in {'the soft' if self.grasps == 'soft' else 'all six'} reference grasps",
            "safe_limit": f"{100.0 * self.safe_share:.4g} % of the safe limit",
        }[name]

    @property
    def safe_share(self) -> float:
        """Upper limit of K as a fraction of the safe limit's stiffness."""
        return self.stiffness_fraction or RECOMMENDED_SHARE


def _read_limit(name: str, value: Any) -> Any:
    """Convert a requirement given as a string, such as "50%" or "6 dB", to a number; return a number unchanged."""
    if not isinstance(value, str):
        return value
    try:
        return _READERS[name](value)
    except ValueError:
        return value


class WallChoice(NamedTuple):
    """The stiffest wall that satisfies the requirements, or the reason why none exists."""

    stiffness: float  # in N/m; NaN if no wall exists
    damping: float  # virtual damping in N s/m; NaN if no wall exists
    limit: str  # active requirement: a field of `Requirements`, or "safe_limit"
    status: Status
    reason: str = ""  # reason why no wall exists
    note: str = ""  # remark on the choice


def list_grasped_scenes(scene: SceneOptima, requirements: Requirements) -> list[SceneOptima]:
    """Return copies of the scene in each required grasp; if the scene has an operator, also one without operator."""
    if not isinstance(scene.device, Device) or requirements.grasps == "none":
        return []
    pairs = list_grasps(scene.unit_system.rotary)
    hands: list[Any] = [
        hand for name, hand in pairs if requirements.grasps == "all" or name.startswith(requirements.grasps)
    ]
    return [scene.replace(operator=hand) for hand in (*hands, *([None] if scene.operator is not None else []))]


def measure_slack(scene: SceneOptima, requirements: Requirements, grasped: Sequence[SceneOptima] = ()) -> Slack:
    """Return a function that computes the slack of each requirement for walls with K in N/m and B in N s/m.

    The requirements are those on margins and passivity in ``requirements``, and stability in every scene of
    ``grasped``. The slack of the latter is the modulus margin of the wall, so that a search for the largest slack
    prefers well-damped walls.
    """
    device_damping = float(scene.device.damping)
    reserve = 0.0 if requirements.beyond_safe else reserve_damping(scene)
    needed_margins = [name for name in ("gain_margin", "phase_margin") if getattr(requirements, name)]
    needed_margins += ["modulus_margin"] if grasped else []

    def slack(stiffness: float, damping: Any) -> dict[str, np.ndarray]:
        """Return the slack of each requirement by name, for walls with one stiffness and several dampings."""
        alpha, beta = np.broadcast_arrays(*scene.normalize_walls(stiffness, damping))
        stable, slacks = scene.loop.labels(alpha, beta), {}
        margins: Any = None
        if needed_margins:
            margins = scene.loop.margins(alpha, beta, needed_margins)
            if requirements.gain_margin:
                with np.errstate(all="ignore"):
                    slacks["gain_margin"] = (
                        np.abs(np.log(margins.gain_margin)) / math.log(requirements.gain_margin) - 1.0
                    )
            if requirements.phase_margin:
                slacks["phase_margin"] = np.asarray(margins.phase_margin) / requirements.phase_margin - 1.0
        if requirements.passive:
            margin = (np.asarray(scene.passivity_margin(stiffness, damping)) - reserve) / (device_damping or 1.0)
            # Replace a passivity margin of exactly 0 by a negative slack, because a wall with this margin is not
            # passive.
            slacks["passive"] = np.where(margin == 0, -np.finfo(float).eps, margin)
        if grasped:
            stable_in_grasps = np.all([_is_stable_in_grasp(each, stiffness, damping) for each in grasped], axis=0)
            slacks["grasps"] = np.where(stable_in_grasps, margins.modulus_margin, -1.0)
        return {name: np.where(stable & ~np.isnan(value), value, -1.0) for name, value in slacks.items()}

    return slack


def _is_stable_in_grasp(grasped: SceneOptima, stiffness: float, damping: Any) -> Any:
    """Return whether walls with K and B, and walls with both multiplied by ``GRASP_GAIN``, are stable in a grasp."""
    return np.all([grasped.is_stable(gain * stiffness, gain * damping) for gain in (1.0, GRASP_GAIN)], axis=0)


def find_stiffest(
    scene: SceneOptima,
    slack: Slack,
    most: float,
    near: float | None = None,
    width: float = WIDTH,
    safe: SafeLimit | None = None,
) -> tuple[float, float]:
    """Find the stiffest wall whose slack is nonnegative, and return its K and B; NaN if no such wall is found.

    Args:
        scene: the scene.
        slack: function returned by `measure_slack`.
        most: largest K allowed, in N/m.
        near: initial guess of K in N/m; ``most`` if left out.
        width: relative tolerance of K.
        safe: safe limit that the wall must respect.
    """
    unit, dampings = scene.units.virtual_damping, {}

    def best_slack(log_stiffness: float) -> float:
        """Return the slack of a stiffness with the best damping, limited to the range from -1 to 1."""
        stiffness = math.exp(log_stiffness)

        def cost(beta: Any) -> np.ndarray:
            """Return the negative of the smallest slack of all requirements, which the best damping minimizes."""
            return -np.min(list(slack(stiffness, beta * unit).values()), axis=0)

        intervals = find_connected_dampings(scene, stiffness)
        if safe is not None:
            intervals = _clip(intervals, *(end / unit for end in safe.dampings(stiffness) or (math.inf, -math.inf)))
        dips = [
            find_global_minimum(cost, low, high, SAMPLES, NEAR * width) if low < high else (float(cost(low)), low)
            for low, high in intervals
        ]
        lowest, beta = min(dips, default=(1.0, math.nan))
        if lowest <= 0:
            dampings[log_stiffness] = beta * unit
        # Keep the magnitude of the slack above 1e-12 without changing its sign, because `false_position` stops at
        # values close to 0.
        return min(max(-lowest, 1e-12), 1.0) if lowest <= 0 else max(min(-lowest, -1e-12), -1.0)

    top, softest = math.log(most), scene.loop.least_stiffness(-math.inf)
    end, longest = top + math.log(LEAST), math.log(STEP_DOWN)
    if softest is not None:
        end, longest = math.log(softest * scene.units.stiffness), math.log(STEP_DOWN_UNSTABLE)
    low = high = top if near is None or not 0 < near < most else math.log(near)
    at_low = at_high = best_slack(low)
    step = longest if low == top else math.log(FIRST_STEP)
    while at_high > 0 and high < top:
        low, at_low = high, at_high
        high = min(high - step, top)
        at_high, step = best_slack(high), 2.0 * step
    while at_low <= 0 and low > end:
        high, at_high = low, at_low
        low = low + step
        at_low, step = best_slack(low), max(2.0 * step, longest)
    if at_low <= 0:
        return math.nan, math.nan
    if low < high and at_high <= 0:
        ends = np.float64(low), np.float64(high), np.float64(at_low), np.float64(at_high)
        false_position(np.vectorize(best_slack, otypes=[float]), *ends, MAX_STEPS, width)
    log_stiffness = max(dampings)
    wall = most if log_stiffness == top else math.exp(log_stiffness), dampings[log_stiffness]
    if wall[0] == most:
        return wall
    # Round K and B to six digits, which are easier to type, if the rounded wall satisfies the requirements.
    short = float(f"{wall[0]:.6g}"), float(f"{wall[1]:.6g}")
    return short if min(map(float, slack(*short).values())) >= 0 else wall


def _clip(intervals: list[tuple[float, float]], low: float, high: float) -> list[tuple[float, float]]:
    """Return the nonempty intersections of intervals with the interval from ``low`` to ``high``."""
    clipped = [(max(start, low), min(end, high)) for start, end in intervals]
    return [(start, end) for start, end in clipped if start <= end]


def choose_wall(
    scene: SceneOptima, requirements: Requirements, top: StiffestWall, near: float | None = None, width: float = WIDTH
) -> WallChoice:
    """Choose the stiffest wall of a scene that satisfies the requirements.

    Args:
        scene: the scene.
        requirements: the requirements.
        top: the stiffest stable wall of the scene.
        near: initial guess of K in N/m.
        width: relative tolerance of K.
    """
    grasps, active = list_grasped_scenes(scene, requirements), list[SceneOptima]()
    free = choice = _choose_free(scene, requirements, top, near, width, active)
    # Add a grasp to the requirements only if the chosen wall is unstable in it, because each grasp slows the search.
    while choice.status == Status.OK and (
        unstable := [
            grasped for grasped in grasps if not _is_stable_in_grasp(grasped, choice.stiffness, choice.damping)
        ]
    ):
        active += unstable
        choice = _choose_free(scene, requirements, top, GRASP_GUESS * choice.stiffness, width, active)
    if choice.status != Status.OK:
        return choice
    return choice._replace(limit="grasps" if choice.stiffness < (1.0 - 2.0 * width) * free.stiffness else free.limit)


def _choose_free(
    scene: SceneOptima,
    requirements: Requirements,
    top: StiffestWall,
    near: float | None,
    width: float,
    grasped: Sequence[SceneOptima],
) -> WallChoice:
    """Choose the stiffest wall that satisfies all requirements; of the grasps, only those in ``grasped`` are required.

    The other arguments are those of `choose_wall`.
    """
    nan = math.nan
    if top.status != Status.OK:
        return WallChoice(nan, nan, "", Status(int(top.status)), explain_missing(scene, top.status))
    most, active = (requirements.stiffness_fraction or 1.0) * float(top.stiffness), "stiffness_fraction"
    safe = None if requirements.beyond_safe else scene.safe_limit
    if safe is not None:
        if safe.forbids_all:
            why = "; ".join(safe.warnings) or safe.reason or "the safe limit is 0"
            return WallChoice(nan, nan, "", Status.UNREACHABLE, f"no wall is safe: {why}")
        # Limit K to the same fraction of the safe limit as of K_max, because both limits need the same reserve.
        share = requirements.safe_share * safe.stiffness
        most, active = (share, "safe_limit") if share < most else (most, active)
    usual, slack = choose_damping(scene, top, most), measure_slack(scene, requirements, grasped)
    if safe is not None:
        low, high = safe.dampings(most) or (usual, usual)
        usual = min(max(usual, low), high)
    spare = slack(most, usual)
    if spare and not (requirements.stiffness_fraction and min(spare.values()) >= 0):
        # Do not start the search, which may take half a minute, if the damping excludes every passive wall.
        reason, reserve = "", 0.0 if safe is None else safe.damping_reserve
        if requirements.passive and scene.device.damping == 0:
            reason = "no passive wall exists, because the device has no physical damping"
        elif requirements.passive and scene.device.damping <= reserve:
            reason = "no wall is passive for certain, because the device may have no physical damping; record longer"
        stiffness, damping = (nan, nan) if reason else find_stiffest(scene, slack, most, near, width, safe)
        if math.isnan(stiffness):
            reason = reason or f"no wall satisfies {' and '.join(map(requirements.spell, spare))}; relax a requirement"
            return WallChoice(nan, nan, "", Status.UNREACHABLE, reason)
        spare = slack(stiffness, damping)
        limit = min(spare, key=lambda name: float(spare[name])) if stiffness < most else active
        return WallChoice(stiffness, damping, limit, Status.OK)
    if not np.all(scene.is_stable(most, usual)):
        share = most / float(top.stiffness)
        reason = f"no stable wall found at {100 * share:.4g} % of K_max; choose another stiffness fraction"
        return WallChoice(nan, nan, "", Status.UNREACHABLE, reason)
    note = OTHER_DAMPING if usual != top.virtual_damping and active == "stiffness_fraction" else ""
    return WallChoice(most, usual, active, Status.OK, note=note)


class ControllerChoice(NamedTuple):
    """A chosen wall, the scene to which it belongs, and the stiffest stable wall of this scene."""

    scene: SceneOptima  # the given scene; for a cascade, a copy whose integrator contains pos_gain = K/B
    top: StiffestWall  # the stiffest stable wall of this scene
    wall: WallChoice


def choose_controller(
    scene: SceneOptima, requirements: Requirements, top: StiffestWall, near: float | None = None, width: float = WIDTH
) -> ControllerChoice:
    """Choose the stiffest wall that satisfies requirements; for a cascade, match the integrator to this wall.

    The integrator of a cascade integrates the velocity plus ``pos_gain`` times the position. Because ``pos_gain`` is
    K/B, each new wall changes the integrator. The search chooses a wall, matches the integrator to this wall and
    chooses again until K/B converges. Then K and B are reduced together, which does not change the integrator, until
    the loop with the matching integrator satisfies the requirements.

    The arguments are those of `choose_wall`.
    """
    choice = choose_wall(scene, requirements, top, near, width)
    feedback = scene.feedback
    if not (isinstance(feedback, IntegralFeedback) and feedback.is_cascade):
        return ControllerChoice(scene, top, choice)
    first = result = _match_integrator(scene, feedback, requirements, top, choice, width)
    if result.wall.status != Status.OK:
        # Search again from smaller values of pos_gain, because no wall may be stable with the given value.
        free = scene.replace(feedback=None)
        start = choose_wall(free, requirements, free.max_stiffness(), None, COARSE)
        for factor in RESTARTS if start.status == Status.OK and start.damping > 0 else ():
            feedback = feedback.match_wall(factor * start.stiffness, start.damping)
            changed = scene.replace(feedback=feedback)
            top = changed.max_stiffness()
            choice = choose_wall(changed, requirements, top, None, width)
            result = _match_integrator(changed, feedback, requirements, top, choice, width)
            if result.wall.status == Status.OK:
                return result
    return first if result.wall.status != Status.OK else result


def _match_integrator(
    scene: SceneOptima,
    feedback: IntegralFeedback,
    requirements: Requirements,
    top: StiffestWall,
    choice: WallChoice,
    width: float,
) -> ControllerChoice:
    """Choose walls until pos_gain in the integrator of a cascade equals K/B; ``choice`` is the first wall."""
    for _ in range(MAX_MATCHES):
        if choice.status != Status.OK:
            return ControllerChoice(scene, top, choice)
        if not choice.damping > 0:
            reason = "no wall with B > 0 satisfies the requirements, and a cascade requires pos_gain = K/B > 0"
            return ControllerChoice(scene, top, WallChoice(math.nan, math.nan, "", Status.UNREACHABLE, reason))
        matched = feedback.match_wall(choice.stiffness, choice.damping)
        changed = abs(matched.position - feedback.position) > max(MATCHED, width) * abs(matched.position)
        feedback, scene = matched, scene.replace(feedback=matched)
        top = scene.max_stiffness()
        if not changed:
            break
        choice = choose_wall(scene, requirements, top, choice.stiffness, width)
    return _confirm_cascade(scene, feedback, requirements, choice)


def _confirm_cascade(
    scene: SceneOptima, feedback: IntegralFeedback, requirements: Requirements, choice: WallChoice
) -> ControllerChoice:
    """Reduce K and B together until the loop with pos_gain = K/B in its integrator satisfies the requirements."""
    safe = None if requirements.beyond_safe else scene.safe_limit
    for factor in REDUCTIONS if choice.status == Status.OK else ():
        wall = float(f"{factor * choice.stiffness:.6g}"), float(f"{factor * choice.damping:.6g}")
        scene = scene.replace(feedback=feedback.match_wall(*wall))
        if (
            scene.is_stable(*wall)
            and all(value >= 0 for value in measure_slack(scene, requirements)(*wall).values())
            and all(_is_stable_in_grasp(each, *wall) for each in list_grasped_scenes(scene, requirements))
            and (safe is None or safe.allows(*wall))
        ):
            return ControllerChoice(scene, scene.max_stiffness(), choice._replace(stiffness=wall[0], damping=wall[1]))
    if choice.status == Status.OK:
        reason = "no wall satisfies the requirements with the integrator of the cascade; reduce vel_integrator_gain"
        choice = WallChoice(math.nan, math.nan, "", Status.UNREACHABLE, reason)
    return ControllerChoice(scene, scene.max_stiffness(), choice)
