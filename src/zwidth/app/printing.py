"""Printed results: labeled lines, line wrapping, JSON, and phrases shared by several commands and the explorer.

A printed line has a label and a text. `format_line` has a narrow column for labels (results of ``check``, ``recommend``
and ``fit``), `format_row` a wide one. The names of functions follow their results: `format_...` returns printed lines,
`list_...` returns texts of notes and cautions, `spell_...` returns a phrase. A caution is a text labeled CAUTION: the
result may not hold on the real device. The verdict of a wall is an `Assessment`.
"""

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

from zwidth.core.status import Status
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.parameter_paths import WITH_KIND, find_parts
from zwidth.model.wall import NoWall
from zwidth.units.formatting import format_stiffness, plain, short, to_json, with_unit
from zwidth.units.quantities import FIELDS

if TYPE_CHECKING:
    from zwidth.analysis.assessment import Assessment
    from zwidth.analysis.diagnosis import Diagnosis
    from zwidth.analysis.scene import Scene

WIDTH = 100  # maximum line length of printed results
LABEL = 11  # columns reserved for a label, including one space after it
# Colors of labels on a terminal.
COLORS = {"STABLE": "green", "SET": "green", "UNSTABLE": "red", "NO WALL": "red"}
COLORS |= dict.fromkeys(("MARGINAL", "UNDECIDED", "CAUTION"), "yellow")
_NARROW = 60  # smallest width with a separate column for labels
_COLUMN = re.compile(r" {2,}")
# Pattern of spaces within a quantity such as "B = 3 N s/m", at which lines must not break. It also matches some other
# spaces, which is harmless.
_NO_BREAK = re.compile(r"(?<=[\dNgm=]) (?=\S)| (?==)")


def format_row(label: str, text: str) -> str:
    """Return a line for printing: a label in a wide column for long labels, and a text."""
    return f"{label:<20}  {text}"


def format_line(label: str, text: str) -> str:
    """Return a printed line: a label in a narrow column of `LABEL` characters, and a text."""
    return f"{label:<{LABEL - 1}} {text}"


def print_json(result: Any) -> None:
    """Print a result as JSON, with null for values that are unknown or not finite."""
    click.echo(json.dumps(to_json(result), indent=2, allow_nan=False))


def wrap_lines(lines: Iterable[str], indent: int = LABEL, width: int = WIDTH) -> Iterator[str]:
    """Yield lines wrapped to a width, with continuation lines indented and no break between a number and its unit.

    In a narrow width, labels have no separate column, because texts next to it would wrap after every word.
    """
    narrow = width < _NARROW
    wrap = textwrap.TextWrapper(max(width, 40), break_long_words=False, break_on_hyphens=False)
    for each in lines:
        each = _COLUMN.sub("  ", each) if narrow else each
        blank = len(each) - len(each.lstrip())
        wrap.subsequent_indent = (4 if narrow else max(indent, blank)) * " "
        yield wrap.fill(_NO_BREAK.sub("\xa0", each)).replace("\xa0", " ")


def print_lines(lines: Iterable[str], indent: int = 24) -> None:
    """Print lines with colored labels, wrapped to the width of the terminal (or $COLUMNS), at most 100 columns."""
    width = shutil.get_terminal_size((WIDTH, 24)).columns
    for each in wrap_lines(lines, indent, min(width, WIDTH)):
        word = each[: LABEL - 1].rstrip()
        click.echo(click.style(word, fg=COLORS[word], bold=True) + each[len(word) :] if word in COLORS else each)


def print_result(result: Any, lines: Iterable[str], as_json: bool, indent: int = 24) -> None:
    """Print a result as JSON if ``as_json`` is True, otherwise print its lines."""
    if as_json:
        print_json(result)
    else:
        print_lines(lines, indent)


def format_parts(scene: Scene) -> list[str]:
    """Return a printed line for each part of a scene except the rigid device, in order from the motor to the hand."""
    lines = []
    velocity = type(scene.velocity).__name__
    with_kind = ("velocity", *WITH_KIND)
    parts, values = find_parts(scene), scene.parameters()
    for name in (name for name in dict.fromkeys((*with_kind, "actuator", "coupling", *parts)) if name in parts):
        part_values = {path: value for path, value in values.items() if path.startswith(f"{name}.")}
        if name == "velocity" and velocity == "BackwardDifference" and not part_values:
            continue
        named = {path.removeprefix(f"{name}.").replace("_", " "): path for path in part_values if part_values[path]}
        words = []
        for key, path in named.items():
            value, unit = part_values[path], scene.unit_system[get_unit(path)]
            spelled = with_unit(value, unit) if unit else short(value) if isinstance(value, int) else plain(value)
            words.append(f"{key} {spelled}")
        if name == "coupling":
            words.append(f"sensor at the {parts[name].sensor}")
        if name == "tool":
            words = [word for word in words if not word.startswith("every ")]
            words.append(f"{parts[name].integrator} Euler")
            if parts[name].every > 1:
                words.append(f"one step per {parts[name].every} periods")
        words = [type(parts[name]).__name__, *words] if name in with_kind else words
        lines.append(format_line(name.replace("modes.", "mode "), ", ".join(words)))
    return lines


def get_unit(path: str) -> str:
    """Return the SI unit of a parameter of a linear device by its path; "" for numbers without a unit."""
    return FIELDS[path].unit_words if path in FIELDS else ""


def name_verdict(verdict: Assessment) -> str:
    """Return the verdict on a wall as one word: undecided, marginal, stable or UNSTABLE."""
    if verdict.stable is None:
        return "undecided"
    return "marginal" if verdict.marginal else "stable" if verdict.stable else "UNSTABLE"


def spell_radius(radius: float) -> str:
    """Return the spectral radius as text with six decimals, or with significant digits only if it is very large."""
    return f"spectral radius {f'{radius:.6f}' if radius < 1e4 else plain(radius)}"


def spell_decay(constant: float, frequency: float) -> str:
    """Return a phrase on the dominant pole, from its time constant in s (negative: growth) and its frequency in Hz."""
    swing = f", oscillating at {with_unit(frequency, 'Hz')}" if frequency else ""
    if isnan(constant):
        return f"has a rate below numerical resolution, near the boundary or poles of equal magnitude{swing}"
    if not isfinite(constant):
        return f"neither decays nor grows{swing}"
    verb = "decays" if constant >= 0 else "grows"
    return f"{verb} with time constant {with_unit(abs(constant), 's')}{swing}"


def list_period_notes(scene: Scene) -> list[str]:
    """Return a list with a note if the velocity estimate was designed for another period than the loop's."""
    coded, period = getattr(scene.velocity, "coded_period", None), scene.timing.period
    if coded is None or abs(coded / period - 1) < 1e-9:
        return []
    text = (
        f"the velocity estimate was designed for a period of {with_unit(coded, 's')}, but that of the loop is "
        f"{with_unit(period, 's')}: it returns {plain(period / coded, 3)} times the velocity"
    )
    cutoff = getattr(scene.velocity, "cutoff", None)
    if cutoff is not None:
        real = with_unit(cutoff * coded / period, "Hz")
        text += f", and its cutoff is {real} instead of {with_unit(cutoff, 'Hz')}"
    return [text]


def list_notes(scene: Scene) -> list[str]:
    """Return the notes on a scene: undecided walls, period of the estimate, islands of stability, safe limit."""
    from zwidth.analysis.assessment import describe_islands

    undecided = scene.explain_undecided() if scene.wall.stiffness or scene.wall.virtual_damping else []
    notes = [*undecided, *list_period_notes(scene), *list_tool_notes(scene), *describe_islands(scene)]
    return [*notes, *compare_with_limit(scene)]


def list_tool_notes(scene: Scene) -> list[str]:
    """Return notes on the virtual coupling of a scene with a simulated tool; an empty list without a tool."""
    if scene.tool is None:
        return []
    if scene.tool.every > 1:
        rate, every = with_unit(1.0 / (scene.tool.every * scene.timing.period), "Hz"), scene.tool.every
        text = f"; its tool makes one step per {every} periods, at {rate}; margins and islands are not computed"
    elif scene.tool.integrator == "semi-implicit":
        text = (
            "; its tool is integrated by semi-implicit Euler and therefore not passive, so even a coupling that is "
            "stable with every passive world can be unstable with this tool; Scene.lightest_tool returns the smallest "
            "stable mass"
        )
    else:
        text = ""
    return [f"K and B are those of a virtual coupling{text}", *_list_narrow_regions(scene)]


def _list_narrow_regions(scene: Scene) -> list[str]:
    """Return a list with a caution if half the maximum stiffness is unstable at the same damping; otherwise empty."""
    top = scene.max_stiffness()
    half = 0.5 * float(top.stiffness)
    if top.status != Status.OK or scene.is_stable(half, float(top.virtual_damping)):
        return []
    K = format_stiffness(half, scene.unit_system)
    return [
        f"do not set a coupling near K_max: it is in a narrow region, since K = {K} at the same B is unstable; choose "
        "a smaller B, and K in the line 'room' of zwidth check"
    ]


def compare_with_limit(scene: Scene) -> list[str]:
    """Return the warnings of the scene's safe limit, preceded by a caution if the wall exceeds this limit."""
    limit = scene.safe_limit
    return [] if limit is None or isinstance(scene.wall, NoWall) else [*list_limit_cautions(scene), *limit.warnings]


def list_limit_cautions(scene: Scene) -> list[str]:
    """Return a list with the caution that the wall exceeds the safe limit of its scene; empty if it does not."""
    limit, wall = scene.safe_limit, scene.wall
    if limit is None or isinstance(wall, NoWall) or limit.allows(float(wall.stiffness), float(wall.virtual_damping)):
        return []
    return [f"this wall exceeds the safe limit: the real device may be unstable. {limit.describe(scene.unit_system)}"]


def _has_alarm(diagnosis: Diagnosis) -> bool:
    """Return whether a diagnosis deserves a caution: the device oscillates, and not only by a small limit cycle."""
    return diagnosis.cause != "none" and not diagnosis.is_small


def spell_diagnosis(diagnosis: Diagnosis | None) -> list[tuple[str, str]]:
    """Return pairs of label and text: the result of a diagnosis and, for an oscillation that is not small, remedies."""
    if diagnosis is None:
        return []
    label, advice = ("CAUTION", diagnosis.advise()) if _has_alarm(diagnosis) else ("simulated", "")
    return [(label, f"{diagnosis.word}: {diagnosis.explain()}"), *([("", f"to stop it: {advice}")] if advice else [])]


def spell_alarm(diagnosis: Diagnosis | None, *alarms: str) -> str:
    """Return the end of a headline, "; CAUTION: ..." with a diagnosed oscillation and ``alarms``; "" without any."""
    oscillation = [diagnosis.word.lower()] if diagnosis is not None and _has_alarm(diagnosis) else []
    words = [*oscillation, *filter(None, alarms)]
    return f"; CAUTION: {', '.join(words)}" if words else ""


def format_diagnosis(diagnosis: Diagnosis | None) -> list[str]:
    """Return printed lines with the result of a diagnosis and, if the device oscillates, its remedies."""
    return [format_line(*each) for each in spell_diagnosis(diagnosis)]


def format_hardware(hardware: str) -> list[str]:
    """Return a list with the printed line that states the hardware of a scene file; empty if ``hardware`` is ""."""
    return [format_line("hardware", hardware)] if hardware else []


def list_omission_cautions(scene: Scene, omitted: Collection[str]) -> list[str]:
    """Return a list of cautions about a delay or a friction that is 0 only because the user has given no value.

    ``omitted`` contains the names of options that were not given.
    """
    # Return no caution for a measured response, because it usually includes the delay, and friction cannot be simulated
    # with it.
    if isinstance(scene.device, MeasuredDevice):
        return []
    cautions = {
        "delay": "no delay given: the results hold only if the force acts at the sample; if it acts one period later, "
        "add --delay '1 periods'",
        "friction": "no friction given: the encoder is simulated without friction, which can stop a limit cycle; give "
        "the device's friction by --friction",
    }
    return [text for name, text in cautions.items() if name in omitted and not (name == "delay" and scene.timing.delay)]


def format_notes(notes: list[str]) -> list[str]:
    """Return a printed line for each note."""
    return [format_line("note", note) for note in notes]


class Slope(NamedTuple):
    """The derivative of K_max with respect to one parameter, and a phrase on the effect of a small change of it."""

    name: str  # path of the parameter
    value: float  # derivative of K_max
    unit: str  # unit of the derivative
    words: str  # effect of a small change

    def line(self) -> str:
        """Return a printed line with the derivative, its unit and the effect of a small change."""
        name = "inertia" if self.name == "mass" and self.unit.endswith("kg m^2") else self.name
        return format_row(f"dK_max/d({name})", f"{with_unit(self.value, self.unit)}: {self.words}")

    def as_dict(self) -> dict[str, Any]:
        """Return a dict of the derivative and its unit for JSON output."""
        return {"value": self.value, "unit": self.unit}


def list_slopes(scene: Scene) -> list[Slope]:
    """Return the derivatives of K_max with respect to all parameters of a scene, each with its effect in words."""
    if isinstance(scene.device, MeasuredDevice):
        return []
    per, values = scene.sensitivities().per, scene.parameters()
    slopes, system = [], scene.unit_system
    dampings = getattr(scene.device, "joint_dampings", {})
    for path, slope in per.items():
        if path in dampings:
            slopes.append(_spell_joint_slope(path, float(slope), dampings[path], system["N/m"]))
            continue
        unit, value = system[get_unit(path)], float(slope)
        # The printed change of a parameter is relative to its absolute value, because modal masses and weights of
        # feedback may be negative. That of a delay is relative to the sampling period, because the delay may be 0.
        size = scene.timing.period if path == "delay" else abs(values[path])
        by_one = not size or unit == "N s/m"
        # Choose the step of the parameter whose effect is stated: the power of ten nearest to one percent of this size;
        # 1 N s/m for a linear damping; 1 or, for rotary devices, 1e-3 if the size is 0.
        step = 10.0 ** (math.floor(math.log10(size) + 0.5) - 2) if not by_one else 1e-3 if system.rotary else 1.0
        effect = "no change" if isfinite(value) else "not computed"
        if isfinite(value) and (change := value * step):
            effect = f"{'+' if change > 0 else '-'}{with_unit(abs(change), system['N/m'], 3)}"
        note = f" (the delay stays {scene.timing.delay_text})" if path == "period" and scene.timing.delay else ""
        words = f"{effect} for {with_unit(step, unit, 1)} more{note}"
        slopes.append(Slope(path, value, f"{system['N/m']} per {unit}" if unit else system["N/m"], words))
    return slopes


def _spell_joint_slope(path: str, slope: float, damping: float, unit: str) -> Slope:
    """Return the derivative of K_max with respect to the damping of a joint, with its effect in words.

    Args:
        path: path of the damping.
        slope: derivative, per N m s/rad (hinges) or per N s/m (slides).
        damping: value of the damping in the same unit.
        unit: unit of K_max.
    """
    # Name no unit of the damping, because hinges and slides have different units, and the kind of joint is not stored.
    step, words = (0.1 * damping, "10 % more") if damping > 0 else (1e-3, "a damping of 0.001")
    effect = "no change" if isfinite(slope) else "not computed"
    if isfinite(slope) and (change := slope * step):
        effect = f"{'+' if change > 0 else '-'}{with_unit(abs(change), unit, 3)}"
    return Slope(path, slope, f"{unit} per SI unit", f"{effect} for {words}")
