"""Cautions about a recommended wall: small margins, slow decay and destabilizing grasps, each with its remedy.

A remedy is an option of ``zwidth recommend``, i.e. a different requirement, for which the recommended wall has no such
problem. Its text states this wall and the loss of stiffness.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from zwidth.analysis.assessment import Assessment, assess, round_margin
from zwidth.analysis.wall_search import (
    COARSE,
    DEFAULT_GAIN_MARGIN,
    DEFAULT_PHASE_MARGIN,
    Requirements,
    WallChoice,
    choose_controller,
)
from zwidth.core.status import Status
from zwidth.model.device import Device
from zwidth.model.grasps import list_grasps
from zwidth.model.joint_space import JointDevice
from zwidth.model.linear_device import LinearDevice
from zwidth.model.safe_limit import SafeLimit
from zwidth.stability.linear.passivity import find_obstacle
from zwidth.units.formatting import format_wall, plain, with_unit
from zwidth.units.unit_system import UnitSystem

# Limits of acceptable walls. A recommended wall that violates one of these limits has a caution.
LEAST_PHASE_MARGIN = 10.0  # smallest phase margin, in degrees
LEAST_GAIN_MARGIN = 1.3  # smallest gain margin, a factor on K and B together
LEAST_DELAY_MARGIN = 0.1  # smallest delay margin, in sampling periods
LONGEST_TIME_CONSTANT = 1.0  # largest time constant of the decay, in s
SLOW_DECAY = "slow decay"  # first words of the text for a time constant that is too large
# A slow motion is independent of the wall if half the stiffness changes its time constant by less than this ratio. The
# time constant B/K of an overdamped wall would double.
INDEPENDENT = 0.1


def find_thin(verdict: Assessment, period: float) -> list[str]:
    """Return a list of texts, one for each margin of a stable wall that is too small and one for a slow decay.

    Args:
        verdict: assessment of the wall.
        period: sampling period in s, the unit of the limit of the delay margin.
    """
    gain, phase, late = (round_margin(f"{name}_margin", verdict, True) for name in ("gain", "phase", "delay"))
    constant = verdict.time_constant
    thin = {
        f"phase margin {plain(phase, 2)} deg": phase < LEAST_PHASE_MARGIN,
        f"gain margin {plain(gain, 3)}": gain > 0 and abs(math.log(gain)) < math.log(LEAST_GAIN_MARGIN),
        f"delay margin {with_unit(late, 's', 2)}": late < LEAST_DELAY_MARGIN * period,
        f"{SLOW_DECAY} (time constant {with_unit(constant, 's', 2)})": constant > LONGEST_TIME_CONSTANT,
    }
    return [words for words, short in thin.items() if short]


def summarize_thin(thin: list[str]) -> str:
    """Return "small margins", "slow decay" or both for the texts of `find_thin`; "" if there are none."""
    slow = [SLOW_DECAY for text in thin if text.startswith(SLOW_DECAY)]
    return ", ".join([*(["small margins"] if len(thin) > len(slow) else []), *slow])


def explain_slow(scene: Any, verdict: Assessment, thin: list[str]) -> str:
    """Return the cause and the remedy of a slow decay that the wall hardly affects; "" if there is another problem.

    Args:
        scene: scene with the wall.
        verdict: assessment of the wall.
        thin: texts of `find_thin`.
    """
    if summarize_thin(thin) != SLOW_DECAY or verdict.frequency != 0 or not isinstance(scene.device, LinearDevice):
        return ""
    softer = assess(scene.replace(stiffness=0.5 * scene.wall.stiffness))
    if softer.frequency != 0 or not math.isclose(softer.time_constant, verdict.time_constant, rel_tol=INDEPENDENT):
        return ""
    if isinstance(scene.device, JointDevice):
        return "a motion of the arm that hardly depends on the wall, such as sliding along it; more joint damping helps"
    return "a motion of the device that hardly depends on the wall; more damping of the device helps"


def list_cautions(recommendation: Any) -> tuple[str, ...]:
    """Return the cautions about the wall of a `Recommendation`, one sentence each; empty if there are none."""
    scene, verdict, requirements, cautions = (
        recommendation.scene,
        recommendation.verdict,
        recommendation.requirements,
        [],
    )
    thin = find_thin(verdict, scene.timing.period)
    if cause := explain_slow(scene, verdict, thin):
        cautions.append(f"{thin[0]}: {cause}")
    elif thin:
        rings = thin[0].startswith("phase") and verdict.frequency > 0 and math.isfinite(verdict.time_constant)
        after = f": rings for {with_unit(verdict.time_constant, 's', 2)}" if rings else ""
        remedy = "more damping of the device or less delay"
        if scene.feedback is not None:
            remedy = "less further feedback, such as a smaller integral gain,"
        advice = _advise(
            recommendation,
            _list_margins(requirements),
            lambda improved: not find_thin(assess(improved), scene.timing.period),
            f"no other requirement avoids this; {remedy} may avoid it",
        )
        cautions.append(f"{', '.join(thin)}{after}; {advice}")
    if unstable := [name for name, stable in recommendation.grasps.items() if not stable]:
        options = {"--grasps all": requirements._replace(grasps="all")}
        if float(scene.device.damping) > 0 and not find_obstacle(scene):
            options["--passive"] = Requirements(passive=True, beyond_safe=requirements.beyond_safe)
        advice = _advise(
            recommendation,
            options,
            lambda improved: all(judge_grasps(improved).values()),
            "no wall found that is stable in every grasp",
        )
        cautions.append(f"unstable in the hand ({'; '.join(unstable)}); {advice}")
    return tuple(cautions)


def _list_margins(requirements: Requirements) -> dict[str, Requirements]:
    """Return a dictionary of other requirements that may yield larger margins, keyed by their command-line options."""
    phase = max(DEFAULT_PHASE_MARGIN, requirements.phase_margin or 0.0)
    gain = max(DEFAULT_GAIN_MARGIN, requirements.gain_margin or 0.0)
    by_phase, by_gain = f"--phase-margin {phase:g}", f"--gain-margin {gain:g}"
    passive = " --passive" if requirements.passive else ""
    tried = {by_phase + passive: requirements._replace(phase_margin=phase)}
    tried[f"{by_phase} {by_gain}{passive}"] = requirements._replace(phase_margin=phase, gain_margin=gain)
    if requirements.passive:
        tried[f"{by_phase} without --passive"] = requirements._replace(phase_margin=phase, passive=False)
    defaults = Requirements.check(None, None, None, False, requirements.beyond_safe, requirements.grasps)
    return tried | {"without options for margins": defaults}


def _advise(
    recommendation: Any, options: dict[str, Requirements], accepts: Callable[[Any], bool], otherwise: str
) -> str:
    """Return a text with the first option that avoids a problem of the wall, the new wall, and the loss of stiffness.

    Args:
        recommendation: the recommendation whose wall has the problem.
        options: requirements to try, by the text of the option.
        accepts: function that returns True if the wall of a scene does not have the problem.
        otherwise: text to return if no option solves the problem.
    """
    for words, requirements in options.items():
        scene = recommendation.scene
        choice = choose_controller(scene, requirements, recommendation.stiffest, recommendation.stiffness, COARSE)
        wall, scene = choice.wall, choice.scene
        if wall.status == Status.OK and accepts(scene.replace(stiffness=wall.stiffness, virtual_damping=wall.damping)):
            return f"use recommend {words}: {_spell_change(recommendation, wall)}"
    return otherwise


def _spell_change(recommendation: Any, wall: WallChoice) -> str:
    """Return a text that describes a wall and its loss or gain of stiffness, compared with the recommended wall."""
    ratio = wall.stiffness / recommendation.stiffness
    percent = max(100.0 * (1.0 - ratio), 0.1)
    cost = f"costs {percent:.{2 if percent < 99.0 else 3}g} % of the stiffness"
    cost = cost if ratio <= 1.0 else f"{plain(ratio, 3)} times the stiffness"
    return f"{format_wall(wall.stiffness, wall.damping, recommendation.scene.unit_system)} ({cost})"


def price_passivity(recommendation: Any) -> str:
    """Return a text that describes the passive wall for the same requirements, its options and its loss of stiffness.

    The text is empty if the recommended wall is passive, or if its passivity cannot be determined. The passive wall is
    accurate to about 0.2 %.
    """
    scene, requirements = recommendation.scene, recommendation.requirements
    if recommendation.verdict is None or recommendation.verdict.passive is not False:
        return ""
    wall = choose_controller(
        scene, requirements._replace(passive=True), recommendation.stiffest, recommendation.stiffness, COARSE
    ).wall
    if wall.status != Status.OK:
        return "no passive wall satisfies the same requirements"
    # State every requirement as an option, because the option --passive replaces the default requirements.
    options = {
        "--stiffness-fraction": requirements.stiffness_fraction and f"{100.0 * requirements.stiffness_fraction:.4g}%",
        "--gain-margin": requirements.gain_margin and f"{requirements.gain_margin:g}",
        "--phase-margin": requirements.phase_margin and f"{requirements.phase_margin:g}",
        "--grasps": requirements.grasps if requirements.grasps != "none" else None,
    }
    listed = " ".join(f"{name} {value}" for name, value in options.items() if value)
    listed += " --beyond-safe" if requirements.beyond_safe else ""
    return f"a passive wall has {_spell_change(recommendation, wall)}: recommend --passive {listed}".rstrip()


def judge_grasps(scene: Any) -> dict[str, bool]:
    """Return the stability of the wall of a scene in each reference grasp, as a dictionary of Booleans by grasp.

    If the scene has an operator, the entry "released" is the stability without the operator.
    """
    if not isinstance(scene.device, Device):
        return {}
    grasps = list_grasps(scene.unit_system.rotary)
    hands = [*grasps, *([("released", None)] if scene.operator is not None else [])]
    labels: dict[str, bool] = {}
    for name, grasp in hands:
        labels[name] = labels.get(name, True) and bool(scene.replace(operator=grasp).is_stable())
    return labels


def describe_limit(limit: SafeLimit | None, ignored: bool, units: UnitSystem) -> list[str]:
    """Return texts on the safe limit: one with its values and its reason, then its warnings.

    Args:
        limit: the safe limit of the scene; None if the scene has none.
        ignored: True if the recommended wall may exceed the limit.
        units: units in which the texts state the limit.
    """
    if limit is None or (limit.forbids_all and not ignored):
        # If the safe limit excludes all walls, the reason for the missing recommendation already states this.
        return []
    return [f"safe limit{' (ignored)' if ignored else ''}: {limit.describe(units)}", *limit.warnings]
