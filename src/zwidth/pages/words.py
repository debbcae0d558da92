"""What `zwidth check`, `zwidth ridge` and the explorer say of a scene, its wall and what limits it, in plain words."""

from __future__ import annotations

import json
import math
import re
import shutil
import textwrap
from collections.abc import Iterable
from math import isfinite, isnan
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from zwidth.loops.linear.passivity import find_obstacle
from zwidth.parts.device import Device
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.paths import find_parts
from zwidth.words.formatting import plain, round_safely, short, spell_stiffness, tell_apart, to_json, with_unit
from zwidth.words.quantities import PARAMETERS
from zwidth.words.rotation import in_own_units, is_rotary, own_unit

if TYPE_CHECKING:
    from zwidth.scenes.assessment import Assessment, FrictionRule, Intervals, Limit
    from zwidth.scenes.scene import Scene

# A margin is a difference of dampings; a smaller share of them is their rounding.
_ROUNDED = 1e-12
# Columns of a terminal in which a label's 22 leave too few for what it labels.
_NARROW = 60
_COLUMN = re.compile(r" {2,}")
# A space within a quantity, as in "B = 3 N s/m"; after some words as well, where it does no harm.
_BESIDE = re.compile(r"(?<=[\dNgm=]) (?=\S)| (?==)")


def row(label: str, text: str) -> str:
    return f"{label:<20}  {text}"


def print_json(result: Any) -> None:
    """Print what a machine reads; null stands for what is not known or not finite."""
    click.echo(json.dumps(to_json(result), indent=2, allow_nan=False))


def print_folded(lines: Iterable[str], indent: int = 24) -> None:
    """Print lines for people as wide as their terminal is, the rest of one below it; whole where there is none.

    Where a terminal is narrow no column is kept for labels, which would leave a word a line beside it.
    """
    width = shutil.get_terminal_size((10**4, 24)).columns
    narrow = width < _NARROW
    rest = (4 if narrow else indent) * " "
    fold = textwrap.TextWrapper(max(width, 40), subsequent_indent=rest, break_long_words=False, break_on_hyphens=False)
    for line in lines:
        # A number keeps its unit beside it.
        line = _COLUMN.sub("  ", line) if narrow else line
        click.echo(fold.fill(_BESIDE.sub("\xa0", line)).replace("\xa0", " "))


def tell(result: Any, lines: list[str], as_json: bool) -> None:
    """Print an answer for machines, or its lines for people."""
    if as_json:
        print_json(result)
    else:
        print_folded(lines)


@in_own_units
def scene_lines(scene: Scene) -> list[str]:
    device, timing = scene.device, scene.timing
    times = f"T = {with_unit(timing.period, 's')}, delay {with_unit(timing.delay, 's')} (d = {plain(scene.d)})"
    lines = [row("device", device.spell()), row("timing", times)]
    velocity = type(scene.velocity).__name__
    parts, values = find_parts(scene), scene.parameters()
    # From the motor outwards.
    for name in (name for name in dict.fromkeys(("velocity", "actuator", "coupling", *parts)) if name in parts):
        own = {path: value for path, value in values.items() if path.startswith(f"{name}.")}
        if name == "velocity" and velocity == "BackwardDifference" and not own:
            continue
        named = {path.removeprefix(f"{name}.").replace("_", " "): path for path in own if own[path]}
        words = []
        for key, path in named.items():
            value, unit = own[path], unit_of(path)
            spelled = with_unit(value, unit) if unit else short(value) if isinstance(value, int) else plain(value)
            words.append(f"{key} {spelled}")
        if name == "coupling":
            words.append(f"sensor at the {parts[name].sensor}")
        words = [velocity, *words] if name == "velocity" else words
        lines.append(row(name.replace("modes.", "mode "), ", ".join(words)))
    return lines


def unit_of(path: str) -> str:
    """The SI unit of a parameter by its path; nothing for whole numbers."""
    return PARAMETERS[path].unit.removeprefix("1") if path in PARAMETERS else ""


def word_of(verdict: Assessment) -> str:
    """The verdict in one word."""
    if verdict.stable is None:
        return "undecided"
    return "marginal" if verdict.marginal else "stable" if verdict.stable else "UNSTABLE"


def spell_radius(radius: float) -> str:
    """A spectral radius with its name, six decimals where it is near the circle."""
    return f"spectral radius {f'{radius:.6f}' if radius < 1e4 else plain(radius)}"


@in_own_units
def verdict_lines(scene: Scene, verdict: Assessment) -> list[str]:
    wall, word = scene.wall, word_of(verdict)
    color = {"stable": "green", "UNSTABLE": "red"}.get(word, "yellow")
    told = click.style(word, fg=color, bold=True)
    # Of a response no pole is known.
    dampings, free = verdict.stable_damping, wall.stiffness == 0 and not isnan(verdict.frequency)
    if free:
        dampings = tuple(map(tuple, scene.damper_range().tolist()))
    if word == "marginal":
        told += f" ({_explain_marginal(free, dampings)})"
    best, normalized = "none: no stiffness is stable at any damping", []
    # Of a device that is given as a whole no mass is known, and of a response no pole.
    by_mass, by_poles = isinstance(scene.device, Device), not isnan(verdict.frequency)
    if isfinite(verdict.stiffness_max):
        top = f"; alpha_max = {plain(verdict.alpha_max)}, beta = {plain(verdict.beta_at_max)}" if by_mass else ""
        best = (
            f"K_max = {spell_stiffness(verdict.stiffness_max)} at B = "
            f"{with_unit(verdict.virtual_damping_at_max, 'N s/m')} ({verdict.ridge_kind.replace('_', ' ')} optimum, "
            f"{with_unit(verdict.ridge_frequency, 'Hz')}{top})"
        )
    elif not by_poles:
        best = "none is told by the response"
    # Of a response the intervals are those that it proves.
    surely = "" if by_poles else " surely"
    if by_mass:
        words = f"alpha = {plain(verdict.alpha)}, beta = {plain(verdict.beta)}, delta = {plain(verdict.delta)}"
        normalized = [row("normalized", words)]
    if by_poles:
        told = f"{told}, {spell_radius(verdict.spectral_radius)}"
    return [
        *scene_lines(scene),
        row("wall", f"K = {spell_stiffness(wall.stiffness)}, B = {with_unit(wall.virtual_damping, 'N s/m')}"),
        *normalized,
        "",
        row("verdict", told),
        row("to the boundary in K", _distance(wall.stiffness, verdict.stable_stiffness, "N/m", "K", "B", surely)),
        row("to the boundary in B", _distance(wall.virtual_damping, dampings, "N s/m", "B", "K", surely)),
        row("passive", passivity_words(scene, verdict)),
        row("stiffest stable wall", best),
        *pole_lines(verdict),
        *margin_lines(wall.stiffness, verdict),
    ]


def _explain_marginal(free: bool, dampings: Intervals) -> str:
    """Return the reason for a marginal wall: the free position of a pure damper, or a plant without damping."""
    if not free:
        return "poles on the unit circle: the response neither decays nor grows"
    ranges = " and ".join(" to ".join(tell_apart(*ends, "N s/m")) for ends in dampings)
    return f"only for the free position, a pole at z = 1: a pure damper, B from {ranges}"


def _distance(value: float, intervals: Intervals, unit: str, name: str, other: str, surely: str) -> str:
    """How far a value may move inside its stable interval, or must to reach the nearest; all intervals if several."""
    from zwidth.scenes.assessment import nearest_interval

    if not intervals:
        return f"no {name} is{surely} stable at this {other}"
    ranges = " and ".join(" to ".join(tell_apart(*ends, unit)) for ends in intervals)
    low, high = nearest_interval(intervals, value)
    if low < value < high:
        ways = {"fall": value - low, "rise": high - value}
        moves = [
            f"{verb} by {with_unit(round_safely(way, 'below'), unit)}" for verb, way in ways.items() if isfinite(way)
        ]
        moved = f"{name} may {' or '.join(moves)}"
    else:
        verb, step = ("rise", low - value) if value <= low else ("fall", value - high)
        by = f" by {with_unit(round_safely(step, 'above'), unit)}" if step else ""
        moved = f"{name} must {verb}{by}"
    return f"{moved}: stable from {ranges} (at this {other})"


def margin_lines(stiffness: float, verdict: Assessment) -> list[str]:
    """The margins of control engineering, where the wall has a stiffness or stands without one."""
    from zwidth.scenes.assessment import round_margin

    if (stiffness <= 0 and not verdict.stable) or verdict.stable is None:
        return []
    gain, phase, late, least = (
        round_margin(f"{name}_margin", verdict, verdict.stable) for name in ("gain", "phase", "delay", "modulus")
    )
    parts = [f"gain {plain(gain)}"]
    if isfinite(phase):
        at = with_unit(verdict.gain_crossover, "Hz", 3)
        parts.append(f"phase {plain(phase)} degrees at {at}")
    parts += [f"delay {'not known' if isnan(late) else with_unit(late, 's')}", f"modulus {plain(least)}"]
    return [row("margins", ", ".join(parts))]


def passivity_words(scene: Scene, verdict: Assessment) -> str:
    """Whether a wall is passive; with a coupling a wall that misses the condition may still be."""
    stiffness, margin = scene.wall.stiffness, verdict.passivity_margin
    if verdict.passive is None:
        return f"not known {find_obstacle(**vars(scene.device)).partition(':')[0]}"
    if stiffness < 0:
        return "no, and no damping makes a negative stiffness passive"
    dampings = scene.device.damping + abs(scene.wall.virtual_damping) + stiffness * scene.timing.period
    if abs(margin) <= _ROUNDED * dampings:
        return "only just, without any physical damping to spare"
    if verdict.passive:
        return f"yes, with {with_unit(round_safely(margin, 'below'), 'N s/m')} of physical damping to spare"
    verb = "no" if scene.device.coupling is None else "not proved"
    return f"{verb}, for want of {with_unit(round_safely(-margin, 'above'), 'N s/m')} of physical damping"


def pole_lines(verdict: Assessment) -> list[str]:
    """How the slowest pole moves; nothing of a measured response, which has no poles."""
    if isnan(verdict.frequency):
        return []
    return [row("slowest pole", pole_words(verdict.time_constant, verdict.frequency))]


def pole_words(constant: float, frequency: float) -> str:
    """How the slowest pole moves: its time constant in s, negative for a growing one, and its frequency in Hz."""
    swing = f", oscillating at {with_unit(frequency, 'Hz')}" if frequency else ""
    if isnan(constant):
        return f"its rate is lost in rounding, next to the boundary or to poles of one size{swing}"
    if not isfinite(constant):
        return f"neither decays nor grows{swing}"
    verb = "decays" if constant >= 0 else "grows"
    return f"{verb} with time constant {with_unit(abs(constant), 's')}{swing}"


def check_lines(scene: Scene, verdict: Assessment, limits: list[Limit]) -> list[str]:
    """What `zwidth check` says of a scene's wall, without color."""
    lines = [*verdict_lines(scene, verdict), *limit_lines(limits), *note_lines(scene_notes(scene))]
    return [click.unstyle(line) for line in lines]


def limit_lines(limits: list[Limit]) -> list[str]:
    known = [limit for limit in limits if isfinite(limit.stiffness)]
    return [row("" if k else "what limits it", limit.spell()) for k, limit in enumerate(known)]


def friction_lines(rule: FrictionRule) -> list[str]:
    ends = {"2 b/T": rule.by_damping, "2 f_c/Q": rule.by_friction}
    parts = [f"{name} = {with_unit(end, 'N/m')}" for name, end in ends.items() if end is not None]
    if not rule.holds:
        parts.append("for a rigid device without delay alone is it known which springs these make passive")
    elif rule.stiffness is None:
        parts.append("both are needed for the rule")
    else:
        known = with_unit(round_safely(rule.stiffness, "below"), "N/m")
        parts.append(f"a spring alone is passive up to {known} (Abbott and Okamura 2005)")
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
    from zwidth.scenes.assessment import describe_islands

    undecided = scene.explain_undecided() if scene.wall.stiffness or scene.wall.virtual_damping else []
    return [*undecided, *coded_period_notes(scene), *describe_islands(scene)]


def note_lines(notes: list[str]) -> list[str]:
    return [row("note", note) for note in notes]


class Slope(NamedTuple):
    """The derivative of K_max in one parameter of a scene, and what a small step of it comes to in words."""

    name: str
    value: float
    unit: str
    words: str

    def line(self) -> str:
        return row(f"dK_max/d({self.name})", f"{with_unit(self.value, self.unit)}: {self.words}")

    def as_dict(self) -> dict[str, Any]:
        return {"value": self.value, "unit": own_unit(self.unit)}


def list_slopes(scene: Scene) -> list[Slope]:
    """What a little more of every parameter of a scene changes of its stiffest wall."""
    if isinstance(scene.device, MeasuredDevice):
        return []
    per, values = scene.sensitivities().per, scene.parameters()
    found = []
    for path, slope in per.items():
        unit, value = unit_of(path), float(slope)
        # A delay is counted in periods, a damping one by one.
        size = scene.timing.period if path == "delay" else values[path]
        by_one = not size or (unit == "N s/m" and not is_rotary())
        # A power of ten near one percent, as people can picture it.
        step = 10.0 ** (math.floor(math.log10(size) + 0.5) - 2) if not by_one else 1e-3 if is_rotary() else 1.0
        effect = "changes nothing"
        if change := value * step:
            amount = with_unit(abs(change), "N/m", 3) if isfinite(change) else "stiffness at an infinite rate at first"
            effect = f"{'buys' if change > 0 else 'costs'} {amount}"
        note = " (same delay in seconds)" if path == "period" else ""
        words = f"{with_unit(step, unit, 1)} more {effect}{note}"
        found.append(Slope(path, value, f"N/m per {unit}" if unit else "N/m", words))
    return found
