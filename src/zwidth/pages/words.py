"""Printed results: labeled lines, folding, JSON, and phrases shared by several commands and the explorer."""

from __future__ import annotations

import json
import math
import re
import shutil
import textwrap
from collections.abc import Collection, Iterable, Iterator
from math import isfinite, isnan
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.paths import find_parts
from zwidth.parts.wall import NoWall
from zwidth.words.formatting import plain, short, to_json, with_unit
from zwidth.words.quantities import PARAMETERS

if TYPE_CHECKING:
    from zwidth.scenes.assessment import Assessment
    from zwidth.scenes.diagnosis import Diagnosis
    from zwidth.scenes.scene import Scene

WIDTH = 100  # maximum line length of printed results
LABEL = 11  # columns reserved for a label, including one space after it
# Colors of labels on a terminal.
COLORS = {"STABLE": "green", "SET": "green", "UNSTABLE": "red", "NO WALL": "red"}
COLORS |= dict.fromkeys(("MARGINAL", "UNDECIDED", "CAUTION"), "yellow")
_NARROW = 60  # smallest width with a separate column for labels
_COLUMN = re.compile(r" {2,}")
# Spaces within quantities such as "B = 3 N s/m", at which lines do not break; also harmless matches after words.
_BESIDE = re.compile(r"(?<=[\dNgm=]) (?=\S)| (?==)")


def row(label: str, text: str) -> str:
    """Return a line of a printed result with a long label."""
    return f"{label:<20}  {text}"


def line(label: str, text: str) -> str:
    """Return a line of a printed result with its label."""
    return f"{label:<{LABEL - 1}} {text}"


def print_json(result: Any) -> None:
    """Print a result as JSON, with null for values that are unknown or not finite."""
    click.echo(json.dumps(to_json(result), indent=2, allow_nan=False))


def fold(lines: Iterable[str], indent: int = LABEL, width: int = WIDTH) -> Iterator[str]:
    """Yield lines wrapped to a width, continuation lines indented; no break separates a number from its unit.

    A narrow width has no separate column for labels, because the text would wrap after every word.
    """
    narrow = width < _NARROW
    wrap = textwrap.TextWrapper(max(width, 40), break_long_words=False, break_on_hyphens=False)
    for each in lines:
        each = _COLUMN.sub("  ", each) if narrow else each
        blank = len(each) - len(each.lstrip())
        wrap.subsequent_indent = (4 if narrow else max(indent, blank)) * " "
        yield wrap.fill(_BESIDE.sub("\xa0", each)).replace("\xa0", " ")


def print_folded(lines: Iterable[str], indent: int = 24) -> None:
    """Print lines as wide as ``COLUMNS`` or the terminal, at most 100 columns, with colored labels."""
    width = shutil.get_terminal_size((WIDTH, 24)).columns
    for each in fold(lines, indent, min(width, WIDTH)):
        word = each[: LABEL - 1].rstrip()
        click.echo(click.style(word, fg=COLORS[word], bold=True) + each[len(word) :] if word in COLORS else each)


def tell(result: Any, lines: Iterable[str], as_json: bool, indent: int = 24) -> None:
    """Print a result as JSON, or its lines."""
    if as_json:
        print_json(result)
    else:
        print_folded(lines, indent)


def part_lines(scene: Scene) -> list[str]:
    """Return a line for each part of a scene apart from the rigid device, in order from the motor outwards."""
    lines = []
    velocity = type(scene.velocity).__name__
    parts, values = find_parts(scene), scene.parameters()
    for name in (name for name in dict.fromkeys(("velocity", "actuator", "coupling", *parts)) if name in parts):
        own = {path: value for path, value in values.items() if path.startswith(f"{name}.")}
        if name == "velocity" and velocity == "BackwardDifference" and not own:
            continue
        named = {path.removeprefix(f"{name}.").replace("_", " "): path for path in own if own[path]}
        words = []
        for key, path in named.items():
            value, unit = own[path], scene.unit_system[unit_of(path)]
            spelled = with_unit(value, unit) if unit else short(value) if isinstance(value, int) else plain(value)
            words.append(f"{key} {spelled}")
        if name == "coupling":
            words.append(f"sensor at the {parts[name].sensor}")
        words = [velocity, *words] if name == "velocity" else words
        lines.append(line(name.replace("modes.", "mode "), ", ".join(words)))
    return lines


def unit_of(path: str) -> str:
    """Return the SI unit of a parameter of a linear device by its path; "" for numbers without a unit."""
    return PARAMETERS[path].unit.removeprefix("1") if path in PARAMETERS else ""


def word_of(verdict: Assessment) -> str:
    """Return the verdict in one word."""
    if verdict.stable is None:
        return "undecided"
    return "marginal" if verdict.marginal else "stable" if verdict.stable else "UNSTABLE"


def spell_radius(radius: float) -> str:
    """Return a spectral radius in words, with six decimals unless it is very large."""
    return f"spectral radius {f'{radius:.6f}' if radius < 1e4 else plain(radius)}"


def pole_words(constant: float, frequency: float) -> str:
    """Return the decay of the dominant pole in words, from its time constant in s (negative: growth) and frequency."""
    swing = f", oscillating at {with_unit(frequency, 'Hz')}" if frequency else ""
    if isnan(constant):
        return f"has a rate below numerical resolution, near the boundary or poles of equal magnitude{swing}"
    if not isfinite(constant):
        return f"neither decays nor grows{swing}"
    verb = "decays" if constant >= 0 else "grows"
    return f"{verb} with time constant {with_unit(abs(constant), 's')}{swing}"


def coded_period_notes(scene: Scene) -> list[str]:
    """Return a note if the velocity estimate was designed for a period other than that of the loop."""
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
    """Return notes on a scene in addition to its verdict."""
    from zwidth.scenes.assessment import describe_islands

    undecided = scene.explain_undecided() if scene.wall.stiffness or scene.wall.virtual_damping else []
    return [*undecided, *coded_period_notes(scene), *describe_islands(scene), *compare_with_limit(scene)]


def compare_with_limit(scene: Scene) -> list[str]:
    """Return a warning if the wall exceeds the scene's safe limit, and the warnings that the limit carries."""
    limit = scene.safe_limit
    return [] if limit is None or isinstance(scene.wall, NoWall) else [*limit_cautions(scene), *limit.warnings]


def limit_cautions(scene: Scene) -> list[str]:
    """Return the caution that a wall exceeds the safe limit of its scene; an empty list if it does not."""
    limit, wall = scene.safe_limit, scene.wall
    if limit is None or isinstance(wall, NoWall) or limit.allows(float(wall.stiffness), float(wall.virtual_damping)):
        return []
    return [f"this wall exceeds the safe limit: the real device may be unstable. {limit.describe(scene.unit_system)}"]


def spell_diagnosis(found: Diagnosis | None) -> list[tuple[str, str]]:
    """Return pairs of label and text: the result of a diagnosis and, if the device oscillates, its remedies."""
    if found is None:
        return []
    advice = found.advise()
    label = "simulated" if found.cause == "none" else "CAUTION"
    return [(label, f"{found.word}: {found.explain()}"), *([("", f"to stop it: {advice}")] if advice else [])]


def spell_alarm(diagnosis: Diagnosis | None, *alarms: str) -> str:
    """Return the words with which a headline points to cautions: an oscillation, if diagnosed, and ``alarms``."""
    oscillation = [] if diagnosis is None or diagnosis.cause == "none" else [diagnosis.word.lower()]
    words = [*oscillation, *filter(None, alarms)]
    return f"; CAUTION: {', '.join(words)}" if words else ""


def diagnosis_lines(found: Diagnosis | None) -> list[str]:
    """Return lines with the result of a diagnosis and, if the device oscillates, its remedies."""
    return [line(*each) for each in spell_diagnosis(found)]


def hardware_lines(hardware: str) -> list[str]:
    """Return the line with encoder, friction and motor of a file, in words; no line for an empty text."""
    return [line("hardware", hardware)] if hardware else []


def silent_cautions(scene: Scene, silent: Collection[str]) -> list[str]:
    """Return the cautions about a delay and a friction that are 0 only because they were not given.

    ``silent`` names the options that were not given.
    """
    # A measured response usually contains the delay, and no model to simulate.
    if isinstance(scene.device, MeasuredDevice):
        return []
    cautions = {
        "delay": "no delay given: the results hold only if the force acts at the sample; if it acts one period later, "
        "add --delay '1 periods'",
        "friction": "no friction given: the encoder is simulated without friction, which can stop a limit cycle; give "
        "the device's friction by --friction",
    }
    return [text for name, text in cautions.items() if name in silent and not (name == "delay" and scene.timing.delay)]


def note_lines(notes: list[str]) -> list[str]:
    return [line("note", note) for note in notes]


class Slope(NamedTuple):
    """The derivative of K_max with respect to one parameter, and the effect of a small change in words."""

    name: str  # path of the parameter
    value: float  # derivative of K_max
    unit: str  # unit of the derivative
    words: str  # effect of a small change

    def line(self) -> str:
        """Return the derivative as a printed line."""
        name = "inertia" if self.name == "mass" and self.unit.endswith("kg m^2") else self.name
        return row(f"dK_max/d({name})", f"{with_unit(self.value, self.unit)}: {self.words}")

    def as_dict(self) -> dict[str, Any]:
        return {"value": self.value, "unit": self.unit}


def list_slopes(scene: Scene) -> list[Slope]:
    """Return the sensitivity of the maximum stiffness to each parameter of a scene, with its effect in words."""
    if isinstance(scene.device, MeasuredDevice):
        return []
    per, values = scene.sensitivities().per, scene.parameters()
    found, system = [], scene.unit_system
    for path, slope in per.items():
        unit, value = system[unit_of(path)], float(slope)
        # The scale of a delay is the period, because a delay may be 0; that of a linear damping is 1 N s/m.
        size = scene.timing.period if path == "delay" else values[path]
        by_one = not size or unit == "N s/m"
        # Use the power of ten nearest to one percent of the scale as step.
        step = 10.0 ** (math.floor(math.log10(size) + 0.5) - 2) if not by_one else 1e-3 if system.rotary else 1.0
        effect = "changes nothing" if isfinite(value) else "has an effect that could not be computed"
        if isfinite(value) and (change := value * step):
            effect = f"{'buys' if change > 0 else 'costs'} {with_unit(abs(change), system['N/m'], 3)}"
        note = f" (the delay stays {scene.timing.kept_delay})" if path == "period" and scene.timing.delay else ""
        words = f"{with_unit(step, unit, 1)} more {effect}{note}"
        found.append(Slope(path, value, f"{system['N/m']} per {unit}" if unit else system["N/m"], words))
    return found
