"""Printed results of `zwidth check` and `zwidth recommend`: the verdict in the first line, then margins and advice.

The verdict of a wall is an `Assessment` with its margins, decay, passivity and the stiffest stable wall (K_max) of the
device. A `Limit` is an improvement of the device with the K_max that it yields. The explorer also shows the result of
`zwidth check`.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import isfinite, isinf, isnan
from typing import TYPE_CHECKING

from zwidth.analysis.assessment import round_margin
from zwidth.analysis.cautions import find_thin, price_passivity, summarize_thin
from zwidth.analysis.optimization import explain_missing
from zwidth.analysis.stabilization import stabilize
from zwidth.app.gains import format_cascade, list_cascade_cautions
from zwidth.app.printing import (
    format_diagnosis,
    format_hardware,
    format_line,
    format_parts,
    list_limit_cautions,
    list_notes,
    list_omission_cautions,
    name_verdict,
    spell_alarm,
    spell_radius,
    wrap_lines,
)
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.model.device import Device
from zwidth.model.safe_limit import reserve_damping
from zwidth.stability.linear.passivity import find_obstacle
from zwidth.units.display import find_unit
from zwidth.units.formatting import (
    format_interval,
    format_periods,
    format_stiffness,
    plain,
    round_conservatively,
    with_unit,
)

if TYPE_CHECKING:
    from zwidth.analysis.assessment import Assessment, Intervals, Limit
    from zwidth.analysis.diagnosis import Diagnosis
    from zwidth.analysis.recommendation import Recommendation
    from zwidth.analysis.scene import Scene

ROUNDED = 1e-12  # passivity margins below this fraction of the summed dampings are rounding errors
NOTEWORTHY = 1.005  # smallest factor of increase in stiffness that is printed without --verbose
LONG = 20  # number of characters of the longest heading that shares a line with the first row of its table
MARGINAL_DAMPER = (
    "a pure damper: marginal only because without stiffness no force restores the position (pole at z = 1)"
)
MARGINAL_PLANT = "poles on the unit circle: the response neither decays nor grows"

# Phrases for the reference grasps (models of a hand on the device) in which a wall is required to be stable.
GRASP_WORDS = {
    "all": "stable in all six reference grasps",
    "soft": "stable in the soft reference grasps",
    "none": "not checked in the reference grasps",
}


def spell_device(scene: Scene, omitted: frozenset[str] = frozenset()) -> str:
    """Return a phrase with device and timing; ``omitted`` contains the names of options that were not given."""
    device, timing = scene.device, scene.timing

    def name_default(name: str) -> str:
        return f"{name} 0 (not given)" if name in omitted else f"{name} 0"

    if isinstance(device, Device):
        units = scene.unit_system
        damping = with_unit(device.damping, units["N s/m"]) if device.damping else name_default("damping")
        body = f"{with_unit(device.mass, units['kg'])}, {damping}"
    else:
        body = device.spell()
    delay = format_periods(float(scene.d)) if scene.d else ""
    if delay and not timing.in_periods:
        delay = f"{with_unit(timing.delay, 's')} ({delay})"
    delay = f"delay {delay}" if delay else name_default("delay")
    return f"{body}, at {with_unit(1.0 / timing.period, 'Hz')}, {delay}"


def format_check(
    scene: Scene,
    verdict: Assessment,
    limits: Iterable[Limit] | None,
    *,
    omitted: frozenset[str] = frozenset(),
    hardware: str = "",
    diagnosis: Diagnosis | None = None,
    verbose: bool = False,
) -> list[str]:
    """Return the printed lines of `zwidth check` without notes: verdict, device, margins and remedies.

    ``limits=None`` omits improvements and remedies, whose computation takes longer. ``hardware`` is a phrase that
    states encoder, friction and motor of the scene file.
    """
    wall, word, units = scene.wall, name_verdict(verdict).upper(), scene.unit_system
    K, B = format_stiffness(wall.stiffness, units), with_unit(wall.virtual_damping, units["N s/m"])
    wall_words, device_words = f"K = {K}, B = {B}", spell_device(scene, omitted)
    if isinstance(scene.device, Device):
        wall_words += f" (alpha {plain(verdict.alpha)}, beta {plain(verdict.beta)})"
        device_words += f" (delta {plain(verdict.delta)}, d {plain(verdict.d)})"
    alarm = spell_alarm(diagnosis, "exceeds the safe limit" if list_limit_cautions(scene) else "")
    lines = [format_line(word, wall_words + (alarm if word == "STABLE" else "")), format_line("device", device_words)]
    lines += [*format_parts(scene), *format_hardware(hardware)]
    cautions = [*list_omission_cautions(scene, omitted), *list_cascade_cautions(scene)]
    lines += [format_line("CAUTION", text) for text in cautions]
    # With K = 0, print the stable dampings of a pure damper. Exclude measured responses, which have no poles and
    # therefore the frequency NaN.
    damper = wall.stiffness == 0 and not isnan(verdict.frequency) and scene.loop.has_boundary
    dampings = tuple(map(tuple, scene.damper_range().tolist())) if damper else verdict.stable_damping
    if word == "MARGINAL":
        lines.append(format_line("", MARGINAL_DAMPER if damper else MARGINAL_PLANT))
    lines.append("")
    if word == "UNSTABLE" and damper and dampings:
        lines.append(format_line("remedy", f"a pure damper: {_spell_intervals('B', dampings, units['N s/m'], 'K')}"))
    elif word == "UNSTABLE" and limits is not None:
        changes = [each.spell() for each in stabilize(scene)]
        if not changes:
            lines.append(format_line("remedy", "no stabilizing change of one parameter was found"))
        else:
            lines += [format_line("remedy", changes[0]), *(format_line("", f"or {change}") for change in changes[1:])]
            advice = ": for a wall to set, use recommend" if scene.loop.has_boundary else ""
            lines.append(format_line("", f"these are limits of stability, without margins{advice}"))
    lines += format_margins(verdict)
    lines += format_decay(verdict)
    if word != "UNSTABLE" or verbose:
        lines.append(format_line("room", _spell_room(verdict, dampings)))
    lines.append(format_line("passive", spell_passivity(scene, verdict)))
    lines += _list_maximum(scene, verdict, verbose)
    lines += format_gains("To gain K_max:", limits or (), verbose)
    return lines if diagnosis is None else [*lines, "", *format_diagnosis(diagnosis)]


def write_check(scene: Scene, verdict: Assessment, limits: Iterable[Limit] | None) -> str:
    """Return the printed lines and notes of `zwidth check` as one text, wrapped and without colors."""
    lines = [*format_check(scene, verdict, limits), *(format_line("note", note) for note in list_notes(scene))]
    return "\n".join(wrap_lines(lines))


def _spell_room(verdict: Assessment, dampings: Intervals) -> str:
    """Return a phrase with the stable interval of K at the wall's B, and that of B at the wall's K."""
    units = verdict.unit_system
    rooms = (("K", verdict.stable_stiffness, units["N/m"], "B"), ("B", dampings, units["N s/m"], "K"))
    return "; ".join(_spell_intervals(*room) for room in rooms)


def _spell_intervals(name: str, intervals: Intervals, unit: str, other: str) -> str:
    """Return a phrase with the stable intervals of the parameter ``name`` (K or B) if the ``other`` one is fixed."""
    if not intervals:
        return f"no stable {name} at this {other}"
    spelled = []
    for ends in intervals:
        low, high = format_interval(*ends, unit)
        shared = f" {high.partition(' ')[2]}"
        low = "0" if not ends[0] else low.removesuffix(shared)
        spelled.append(f"{low} to {high}")
    return f"{name} from {' and '.join(spelled)} at this {other}"


def _list_maximum(scene: Scene, verdict: Assessment, verbose: bool) -> list[str]:
    """Return printed lines with K_max and its wall, and the percentage of K_max that the wall of the scene uses."""
    if isinf(verdict.virtual_damping_at_max):
        return [format_line("K_max", "none: with a sufficiently large B, every K > 0 is stable with this tool")]
    damping = with_unit(verdict.virtual_damping_at_max, scene.unit_system["N s/m"])
    if isinf(verdict.stiffness_max):
        return [format_line("K_max", f"none: every K > 0 is stable at B = {damping} with this tool")]
    if not isfinite(verdict.stiffness_max):
        if isnan(verdict.frequency):
            return [format_line("K_max", "the response certifies no wall")]
        status = scene.max_stiffness().status
        fault = "none" if status == Status.NO_BOUNDARY else "not computed"
        return [format_line("K_max", f"{fault}: {explain_missing(scene, status)}")]
    top = f"{format_stiffness(verdict.stiffness_max, scene.unit_system)} at B = {damping}"
    used = f"; this wall uses {plain(100.0 * scene.wall.stiffness / verdict.stiffness_max, 3)} %"
    lines = [format_line("K_max", top + (used if scene.wall.stiffness > 0 and verdict.stable else ""))]
    if verbose:
        kind, frequency = verdict.ridge_kind.replace("_", " "), with_unit(verdict.ridge_frequency, "Hz")
        normalized = f"; alpha_max {plain(verdict.alpha_max)}, beta {plain(verdict.beta_at_max)}"
        lines.append(
            format_line("", f"{kind} optimum at {frequency}{normalized if isinstance(scene.device, Device) else ''}")
        )
    return lines


def format_margins(verdict: Assessment) -> list[str]:
    """Return a list with the printed line of the margins of a stable wall; empty for other walls."""
    if not verdict.stable or isnan(verdict.gain_margin):
        return []
    gain, phase, late, least = (
        round_margin(f"{name}_margin", verdict, True) for name in ("gain", "phase", "delay", "modulus")
    )
    parts = [f"gain {plain(gain)}"]
    if isfinite(phase):
        parts.append(f"phase {plain(phase)} deg at {with_unit(verdict.gain_crossover, 'Hz', 3)}")
    parts += [f"delay {'not known' if isnan(late) else with_unit(late, 's')}", f"modulus {plain(least)}"]
    return [format_line("margins", ", ".join(parts))]


def format_decay(verdict: Assessment) -> list[str]:
    """Return a list with the printed line of the time constant of decay or growth; empty for a measured response."""
    if isnan(verdict.frequency):
        return []
    constant, frequency = verdict.time_constant, verdict.frequency
    label = "growth" if constant < 0 else "decay"
    place = f" at {with_unit(frequency, 'Hz')}" if frequency else ""
    if isnan(constant):
        text = f"below numerical resolution{place}: close to the stability boundary, or poles of equal magnitude"
    elif not isfinite(constant):
        text = f"none{place}"
    else:
        text = f"time constant {with_unit(abs(constant), 's')}{place}"
    return [format_line(label, f"{text} ({spell_radius(verdict.spectral_radius)})")]


def spell_passivity(scene: Scene, verdict: Assessment) -> str:
    """Return a phrase on the passivity of a wall; with a coupling the condition is sufficient but not necessary."""
    stiffness, margin = scene.wall.stiffness, verdict.passivity_margin
    if scene.tool is not None:
        return _spell_worlds(scene)
    if verdict.passive is None:
        return f"not known {find_obstacle(scene).partition(':')[0]}"
    if stiffness < 0:
        return "no: no damping makes a negative stiffness passive"
    dampings = scene.device.damping + abs(scene.wall.virtual_damping) + stiffness * scene.timing.period
    if abs(margin) <= ROUNDED * dampings:
        return "on the limit: no physical damping to spare"
    size = with_unit(abs(round_conservatively(margin, "below")), scene.unit_system["N s/m"])
    if verdict.passive and margin < (reserve := reserve_damping(scene)):
        spread = with_unit(reserve, scene.unit_system["N s/m"])
        return f"uncertain: {size} of physical damping to spare, but the fitted damping may be lower by {spread}"
    if verdict.passive:
        return f"yes: {size} of physical damping to spare"
    return f"{'no' if scene.device.coupling is None else 'not certified'}: {size} more physical damping needed"


def _spell_worlds(scene: Scene) -> str:
    """Return a phrase that states whether the virtual coupling of a scene is stable with every passive world."""
    try:
        safe = bool(scene.is_safe_for_every_world())
    except InputError:
        return "not known for a virtual coupling with these parts"
    if safe:
        return "a virtual coupling, stable with every passive world, such as tools in implicit Euler"
    K, B = scene.max_safe_coupling()
    units = scene.unit_system
    limit = f"K = {format_stiffness(K, units)}, B = {with_unit(B, units['N s/m'])}"
    return f"a virtual coupling, not stable with every passive world; the stiffest that is: {limit}"


def format_gains(heading: str, limits: Iterable[Limit], verbose: bool = False) -> list[str]:
    """Return the lines of a table of improvements of a device and the factors by which they raise K_max."""
    # Always show the rate with a constant delay in seconds, because twice the rate then often gains much less than with
    # a constant delay in periods, which is the first entry.
    shown = [
        limit
        for limit in limits
        if isfinite(limit.gain) and (verbose or limit.gain > NOTEWORTHY or (limit.name == "period" and limit.note))
    ]
    if not shown:
        return []
    width, rows = max(len(limit.label) for limit in shown), []
    for limit in shown:
        stiffness = with_unit(round_conservatively(limit.stiffness, "below"), find_unit(limit, "N/m"))
        kept = f"; {limit.note}" if limit.note else ""
        rows.append(f"{limit.label:<{width}}  {stiffness}  (x {plain(limit.gain, 3)}{kept})")
    if len(heading) > LONG:
        return ["", heading, *(format_line("", row) for row in rows)]
    return ["", *(f"{heading if not k else '':<{len(heading)}}  {row}" for k, row in enumerate(rows))]


def format_recommendation(
    recommendation: Recommendation,
    *,
    omitted: frozenset[str] = frozenset(),
    hardware: str = "",
    diagnosis: Diagnosis | None = None,
    verbose: bool = False,
) -> list[str]:
    """Return the printed lines of `zwidth recommend` without notes, from a recommendation and its checks.

    ``hardware`` is a phrase as in `format_check`, and ``diagnosis`` is that of the recommended wall.
    """
    scene, verdict = recommendation.scene, recommendation.verdict
    device = [format_line("device", spell_device(scene, omitted)), *format_parts(scene), *format_hardware(hardware)]
    omission_lines = [format_line("CAUTION", text) for text in list_omission_cautions(scene, omitted)]
    if verdict is None:
        return [format_line("NO WALL", recommendation.reason), *device, *omission_lines]
    thin = summarize_thin(find_thin(verdict, scene.timing.period))
    alarm = spell_alarm(diagnosis, thin, "" if all(recommendation.grasps.values()) else "unstable in a grasp")
    margins = [format_line("margins", recommendation.spell_margins())]
    if verbose:
        margins = [
            *format_margins(verdict),
            *format_decay(verdict),
            format_line("room", _spell_room(verdict, verdict.stable_damping)),
        ]
    passive = spell_passivity(scene, verdict) if verbose else recommendation.spell_passive()
    passive = "; ".join(filter(None, (passive, price_passivity(recommendation))))
    lines = [
        format_line("SET", f"{recommendation.spell_wall()}; {recommendation.spell_limit()}{alarm}"),
        *format_cascade(recommendation),
        *device,
        *margins,
        *([format_line("grasps", hands)] if (hands := recommendation.spell_hands()) else []),
        *format_diagnosis(diagnosis),
        format_line("passive", passive),
        *omission_lines,
        *(format_line("CAUTION", caution) for caution in recommendation.cautions),
    ]
    heading = f"To gain stiffness under the same requirements ({GRASP_WORDS[recommendation.requirements.grasps]}):"
    return lines + format_gains(heading, recommendation.improvements, verbose)
