"""What `zwidth check` and `zwidth ridge` say of a scene's parts, and of what limits it."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any

from zwidth.cli.words import Slope, margin_lines, passivity_words, pole_words, row, stability_word
from zwidth.parts.paths import find_parts
from zwidth.words.formatting import plain, short, tell_apart, with_unit
from zwidth.words.quantities import PARAMETERS

if TYPE_CHECKING:
    from zwidth.scenes.assessment import SceneAssessment
    from zwidth.scenes.friction import FrictionRule
    from zwidth.scenes.limits import Limit
    from zwidth.scenes.scene import Scene


def scene_lines(scene: Scene) -> list[str]:
    """Device, timing and parts."""
    device, timing = scene.device, scene.timing
    lines = [
        row("device", f"m = {with_unit(device.mass * 1e3, 'g')}, b = {with_unit(device.damping, 'N s/m')}"),
        row(
            "timing",
            f"T = {with_unit(timing.period, 's')}, delay {with_unit(timing.delay, 's')} (d = {plain(scene.d)})",
        ),
    ]
    velocity = type(scene.velocity).__name__
    parts, values = find_parts(scene), scene.parameters()
    # From the motor outwards.
    for name in (name for name in dict.fromkeys(("velocity", "coupling", *parts)) if name in parts):
        own = {path: value for path, value in values.items() if path.startswith(f"{name}.")}
        if name == "velocity" and velocity == "BackwardDifference" and not own:
            continue
        keys = {path: path.partition(".")[2].replace("_", " ") for path in own}
        words = [f"{keys[path]} {_amount(path, value)}" for path, value in own.items() if value]
        if name == "coupling":
            words.append(f"sensor at the {parts[name].sensor}")
        lines.append(row(name, ", ".join([*([velocity] if name == "velocity" else []), *words])))
    return lines


def unit_of(path: str) -> str:
    """The SI unit of a parameter by its path; nothing for whole numbers."""
    return PARAMETERS[path].unit.removeprefix("1") if path in PARAMETERS else ""


def _amount(path: str, value: Any) -> str:
    unit = unit_of(path)
    if unit == "kg":
        return with_unit(value * 1e3, "g")
    return with_unit(value, unit) if unit else short(value)


def scene_verdict_lines(scene: Scene, verdict: SceneAssessment) -> list[str]:
    """The verdict on a scene with parts."""
    wall = scene.wall
    word = stability_word(verdict.stable, verdict.marginal)
    coupled = scene.device.coupling is not None
    best = "none: no stiffness is stable at any damping"
    if isfinite(verdict.stiffness_max):
        best = (
            f"K_max = {with_unit(verdict.stiffness_max, 'N/m')} at B = "
            f"{with_unit(verdict.virtual_damping_at_max, 'N s/m')} ({verdict.ridge_kind.replace('_', ' ')} optimum, "
            f"{with_unit(verdict.ridge_frequency, 'Hz')})"
        )
    return [
        *scene_lines(scene),
        row("wall", f"K = {with_unit(wall.stiffness, 'N/m')}, B = {with_unit(wall.virtual_damping, 'N s/m')}"),
        "",
        row("verdict", f"{word}, spectral radius {verdict.spectral_radius:.6f}"),
        row("to the boundary in K", _distance(wall.stiffness, verdict.stable_stiffness, "N/m", "K", "B")),
        row("to the boundary in B", _distance(wall.virtual_damping, verdict.stable_damping, "N s/m", "B", "K")),
        row("passive", passivity_words(scene, verdict, sufficient=coupled)),
        row("stiffest stable wall", best),
        row("slowest pole", pole_words(verdict.time_constant, verdict.frequency)),
        *margin_lines(wall.stiffness, verdict),
    ]


def _distance(value: float, intervals: tuple[tuple[float, float], ...], unit: str, name: str, other: str) -> str:
    """How far a value may move inside its stable interval, or where the stable ones are; all of them if several."""
    if not intervals:
        return f"no {name} is stable at this {other}"
    ranges = " and ".join(" to ".join(tell_apart(*ends, unit)) for ends in intervals)
    inside = [(low, high) for low, high in intervals if low < value < high]
    if not inside:
        return f"stable is {name} from {ranges} (at this {other})"
    low, high = inside[0]
    moves = [f"fall by {with_unit(value - low, unit)}"] if isfinite(low) else []
    moves += [f"rise by {with_unit(high - value, unit)}"] if isfinite(high) else []
    return f"{name} may {' or '.join(moves)}: stable from {ranges} (at this {other})"


def limit_lines(limits: list[Limit]) -> list[str]:
    """What limits the stiffest wall, the largest gain first."""
    lines = []
    for limit in limits:
        if isfinite(limit.stiffness):
            less = " (it helps as it is)" if limit.gain < 1 else ""
            words = f"{limit.words}: K_max {with_unit(limit.stiffness, 'N/m')}, {plain(limit.gain, 3)} times{less}"
            lines.append(row("" if lines else "what limits it", words))
    return lines


def friction_lines(rule: FrictionRule) -> list[str]:
    """The rule of friction and resolution."""
    parts = []
    if rule.by_damping is not None:
        parts.append(f"2 b/T = {with_unit(rule.by_damping, 'N/m')}")
    if rule.by_friction is not None:
        parts.append(f"2 f_c/Q = {with_unit(rule.by_friction, 'N/m')}")
    if rule.stiffness is None:
        parts.append("both are needed for the rule")
    else:
        known = with_unit(rule.stiffness, "N/m")
        parts.append(f"a spring alone is passive up to {known} (rigid, without delay; Abbott and Okamura 2005)")
    return [row("friction, resolution", ", ".join(parts))]


def coded_period_notes(scene: Scene) -> list[str]:
    """A line where the estimate was written for another period than the loop's."""
    coded, period = getattr(scene.velocity, "coded_period", None), scene.timing.period
    if coded is None or abs(coded / period - 1) < 1e-9:
        return []
    text = (
        f"the velocity estimate is written for a period of {with_unit(coded, 's')}, the loop's is "
        f"{with_unit(period, 's')}: velocities come out {plain(period / coded, 3)} times as large"
    )
    cutoff = getattr(scene.velocity, "cutoff", None)
    if cutoff is not None:
        real = with_unit(cutoff * coded / period, "Hz")
        text += f", and the cut-off lies at {real} in place of {with_unit(cutoff, 'Hz')}"
    return [text]


def scene_notes(scene: Scene) -> list[str]:
    """What is remarkable of a scene beside its verdict."""
    from zwidth.scenes.limits import describe_islands

    return [*coded_period_notes(scene), *describe_islands(scene)]


def part_slopes(scene: Scene) -> list[Slope]:
    """What a little more of every parameter of a scene with parts changes of its stiffest wall."""
    from zwidth.scenes.stiffness import describe_effect, one_percent

    per, values = scene.sensitivities().per, scene.parameters()
    found = []
    for path, slope in per.items():
        unit, value = unit_of(path), float(slope)
        step = one_percent(float(values[path])) if values[path] else 1.0
        amount = with_unit(step * 1e3, "g", 1) if unit == "kg" else with_unit(step, unit, 1)
        found.append(
            Slope(path, f"({path})", value, f"N/m per {unit}", f"{amount} more {describe_effect(value * step)}")
        )
    return found
