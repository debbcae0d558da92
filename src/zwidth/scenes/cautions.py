"""Cautions about a recommended wall: small margins, slow decay, destabilizing grasps, each with its remedy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from zwidth.parts.device import Device
from zwidth.parts.grasps import list_grasps
from zwidth.scenes.assessment import Assessment, assess, round_margin
from zwidth.scenes.wall_search import COARSE, DEFAULT_GAIN_MARGIN, DEFAULT_PHASE_MARGIN, choose_wall
from zwidth.words.formatting import name_wall, plain, with_unit
from zwidth.words.status import Status

# Limits of acceptable walls; a wall that violates one of them gets a caution.
LEAST_PHASE_MARGIN = 10.0  # degrees
LEAST_GAIN_MARGIN = 1.3  # factor on K and B together
LEAST_DELAY_MARGIN = 0.1  # sampling periods
LONGEST_TIME_CONSTANT = 1.0  # s

SHARES = np.linspace(1.0, 0.02, 50)  # common factors on K and B, tried to find a wall stable in every grasp


def find_thin(verdict: Assessment, period: float) -> list[str]:
    """Return in words the margins of a stable wall that are too small, and its time constant if too long."""
    gain, phase, late = (round_margin(f"{name}_margin", verdict, True) for name in ("gain", "phase", "delay"))
    constant = verdict.time_constant
    thin = {
        f"phase margin {plain(phase, 2)} deg": phase < LEAST_PHASE_MARGIN,
        f"gain margin {plain(gain, 3)}": gain > 0 and abs(math.log(gain)) < math.log(LEAST_GAIN_MARGIN),
        f"delay margin {with_unit(late, 's', 2)}": late < LEAST_DELAY_MARGIN * period,
        f"time constant {with_unit(constant, 's', 2)}": constant > LONGEST_TIME_CONSTANT,
    }
    return [words for words, short in thin.items() if short]


def list_cautions(recommendation: Any) -> tuple[str, ...]:
    """Return the cautions about the wall of a `Recommendation`."""
    scene, cautions = recommendation.scene, []
    if thin := find_thin(recommendation.verdict, scene.timing.period):
        rings = (
            f": rings for {with_unit(recommendation.verdict.time_constant, 's', 2)}"
            if recommendation.verdict.frequency
            else ""
        )
        cautions.append(f"{', '.join(thin)}{rings}; {_advise_margins(recommendation)}")
    if unstable := [name for name, stable in recommendation.grasps.items() if not stable]:
        cautions.append(f"unstable in the hand ({'; '.join(unstable)}); {_advise_grasps(scene)}")
    return tuple(cautions)


def _advise_margins(recommendation: Any) -> str:
    """Return the options that require larger margins, and their cost in stiffness."""
    scene, wanted = recommendation.scene, recommendation.wanted
    phase = max(DEFAULT_PHASE_MARGIN, wanted.phase_margin or 0.0)
    gain = max(DEFAULT_GAIN_MARGIN, wanted.gain_margin or 0.0)
    by_phase, by_gain = f"--phase-margin {phase:g}", f"--gain-margin {gain:g}"
    tried = {by_phase: wanted._replace(phase_margin=phase)}
    tried[f"{by_phase} {by_gain}"] = wanted._replace(phase_margin=phase, gain_margin=gain)
    if wanted.passive:
        tried[f"{by_phase} without --passive"] = wanted._replace(phase_margin=phase, passive=False)
    advice = "no softer wall has larger margins"
    for words, more in tried.items():
        wall = choose_wall(scene, more, recommendation.stiffest, recommendation.stiffness, COARSE)
        if wall.status != Status.OK:
            continue
        change = 100.0 * (wall.stiffness / recommendation.stiffness - 1.0)
        cost = f"{'costs' if change <= 0 else 'gains'} {max(abs(change), 0.1):.2g} % of the stiffness"
        thin = find_thin(
            assess(scene.replace(stiffness=wall.stiffness, virtual_damping=wall.damping)), scene.timing.period
        )
        advice = f"ask for {words} ({cost}{''.join(f'; still {each}' for each in thin)})"
        if not thin:
            break
    return advice


def judge_grasps(scene: Any) -> dict[str, bool]:
    """Return the stability of a wall in each reference grasp, by name, and without the scene's operator if any."""
    if not isinstance(scene.device, Device):
        return {}
    held = list_grasps(scene.unit_system.rotary)
    hands = [*held, *([("released", None)] if scene.operator is not None else [])]
    labels: dict[str, bool] = {}
    for name, grasp in hands:
        labels[name] = labels.get(name, True) and bool(scene.replace(operator=grasp).is_stable())
    return labels


def _advise_grasps(scene: Any) -> str:
    """Return the stiffest wall with the same K/B that is stable in every grasp, and its cost in stiffness."""
    grasps = [*(grasp for _, grasp in list_grasps(scene.unit_system.rotary)), None]
    K, B = float(scene.wall.stiffness), float(scene.wall.virtual_damping)
    walls = K * SHARES, B * SHARES
    stable = np.all([scene.replace(operator=grasp).is_stable(*walls) for grasp in grasps], axis=0)
    # Count the stable walls from the softest upwards, so that every softer wall is stable as well.
    count = int(np.argmin(np.append(stable[::-1], False)))
    if not count:
        return "a passive wall is stable in every grasp: ask for --passive"
    share = SHARES[-count]
    cost = f"costs {100.0 * (1.0 - share):.2g} % of the stiffness"
    return f"{name_wall(share * K, share * B, scene.unit_system)} is stable in every grasp ({cost})"
