"""Assessment of one wall, and the improvements of a device that increase its maximum stiffness.

`assess` collects stability, margins, passivity and the dominant pole of the wall of a scene, and its distances to the
stability boundary in K and B, the stiffness and damping of the wall. K_max is the maximum stiffness of the device
(`zwidth.Scene.max_stiffness`). An *improvement* changes one part or parameter by a step that is available in practice,
such as half the delay; `limits_of` returns the K_max of each improved scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from zwidth.analysis.base import wrap_function
from zwidth.analysis.optimization import SceneOptima, StiffestWall
from zwidth.analysis.walls import allows_negative
from zwidth.core.errors import InputError
from zwidth.core.status import RidgeKind, Status
from zwidth.model.checks import Span
from zwidth.model.feedback import Feedback
from zwidth.model.position import Observer, PositionFilter
from zwidth.model.velocity import FOAW, BackwardDifference, VelocityFilter, WindowedDifference
from zwidth.stability.linear.passivity import find_obstacle
from zwidth.stability.results import Margins
from zwidth.units.display import ResultList, compact_repr, find_unit, with_units
from zwidth.units.formatting import format_interval, plain, round_conservatively, to_json, with_unit
from zwidth.units.quantities import FIELDS
from zwidth.units.unit_system import LINEAR, UnitSystem

_MARGINS = ("gain_margin", "phase_margin", "delay_margin", "modulus_margin", "gain_crossover", "phase_crossover")

# Units in which the fields of `Assessment` are printed, and texts that are printed in place of missing values.
_UNITS: dict[str, Any] = {
    **dict.fromkeys(("stable_stiffness", "stiffness_limit", "stiffness_max"), "N/m"),
    **dict.fromkeys(("stable_damping", "virtual_damping_lower", "virtual_damping_upper"), "N s/m"),
    **dict.fromkeys(("passivity_margin", "virtual_damping_at_max"), "N s/m"),
    **dict.fromkeys(("ridge_frequency", "frequency", "gain_crossover", "phase_crossover"), "Hz"),
    **{"decay_rate": "1/s", "time_constant": "s", "phase_margin": "degrees", "delay_margin": "s"},
}
_MISSING = {
    "passivity_margin": "no condition is known for these parts",
    "delay_margin": "not confirmed by the number of poles",
    "phase_margin": "no gain crossover determines it",
    **dict.fromkeys(
        ("alpha_max", "beta_at_max", "stiffness_max", "virtual_damping_at_max", "ridge_frequency"), "no wall is stable"
    ),
}

Intervals: TypeAlias = tuple[tuple[float, float], ...]


@compact_repr(missing=_MISSING, **_UNITS)
@dataclass(frozen=True)
class Assessment:
    """Assessment of the wall of a scene, in SI units except for alpha, beta, delta and d; NaN for undefined values."""

    alpha: float  # normalized stiffness K T^2/m, with period T and the mass m that the force of the wall acts on
    beta: float  # normalized damping B T/m
    delta: float  # normalized damping of the device, b T/m
    d: float  # delay in periods
    stable: bool | None  # all poles lie strictly inside the unit circle; None: undecided by a measured response
    marginal: bool  # poles on the unit circle, none outside: one at z = 1 (K = 0), or all poles of an undamped plant
    spectral_radius: float  # largest pole magnitude; rounds to 1 if the decay is very slow
    decay_rate: float  # decay rate of the dominant pole in 1/s, accurate also if slow; negative for a growing response
    stable_stiffness: Intervals  # all stable intervals of K at this B, in N/m
    stable_damping: Intervals  # all stable intervals of B at this K, in N s/m
    stiffness_limit: float  # upper end of the interval of K that contains the wall or is nearest to it
    virtual_damping_lower: float  # lower end of the interval of B that contains the wall or is nearest to it
    virtual_damping_upper: float  # upper end of that interval
    passive: bool | None  # for any operator; with a coupling only sufficient; None if no condition is known
    passivity_margin: float  # damping of the device minus that required for a passive wall, in N s/m
    alpha_max: float  # normalized stiffness of the stiffest stable wall of the device
    beta_at_max: float  # normalized damping of that wall
    stiffness_max: float  # K_max, the stiffness of that wall in N/m
    virtual_damping_at_max: float  # damping of that wall in N s/m
    ridge_kind: str  # "smooth", "corner" or "no_damping"; "none" if no wall is stable
    ridge_frequency: float  # frequency in Hz of the pole pair on the unit circle at K_max
    time_constant: float  # time constant of the dominant pole in s; negative if growing, infinite on the unit circle
    frequency: float  # frequency of the dominant pole in Hz; 0 if it does not oscillate
    gain_margin: float  # factor on K and B together that moves a pole onto the unit circle; below 1: a reduction
    phase_margin: float  # in degrees; positive if and only if the wall is stable
    delay_margin: float  # additional delay in s up to which the wall is stable; NaN if it was not confirmed
    modulus_margin: float  # smallest distance of the open loop from -1
    gain_crossover: float  # frequency of the phase margin, in Hz
    phase_crossover: float  # frequency of the gain margin, in Hz
    unit_system: UnitSystem = LINEAR

    def as_dict(self) -> dict[str, Any]:
        """Return a dictionary of the fields except the unit system, as JSON values with None for NaN and infinity."""
        return to_json({name: getattr(self, name) for name in _NUMBERS})


_NUMBERS = [field.name for field in fields(Assessment) if field.name != "unit_system"]


@wrap_function
def assess(scene: SceneOptima) -> Assessment:
    """Compute stability, margins, passivity and dominant pole of the wall of a scene, and limits of its stiffness.

    Args:
        scene: device, timing, wall and other parts.

    Returns:
        Assessment: stability, stable intervals of K and B, passivity, the stiffest stable wall of the device, the
        dominant pole, and gain, phase, delay and modulus margins.

    Raises:
        InputError: the scene has no wall.

    References:
        Hulin, Preusche, Hirzinger 2006, sections V to VIII.

    Example:
        >>> import zwidth
        >>> device, timing = zwidth.Device(mass=0.1, damping=10), zwidth.Timing(period=1e-3, delay=1e-3)
        >>> verdict = zwidth.assess(zwidth.Scene(device, timing, zwidth.VirtualWall(10e3, 40)))
        >>> verdict.stable, verdict.passive
        (True, False)
    """
    # Compute the dominant pole before the other results, because this step raises an error if the loop has too many
    # poles.
    dominant, period = scene.loop.find_dominant(float(scene.alpha), float(scene.beta)), scene.timing.period
    margins = scene.margins() if scene.loop.has_boundary else Margins(*[math.nan] * len(Margins._fields))
    best, has_condition = scene.max_stiffness(), not find_obstacle(scene)
    margin = float(scene.passivity_margin()) if has_condition else math.nan
    top = scene.normalize_walls(best.stiffness, best.virtual_damping)
    in_stiffness, in_damping = (
        tuple(map(tuple, ends.tolist())) for ends in (scene.stable_stiffness(), scene.stable_damping())
    )
    lower, upper = find_nearest_interval(in_damping, scene.wall.virtual_damping)
    stable = bool(scene.is_stable())
    return Assessment(
        **{name: float(value) for name, value in scene.normalized._asdict().items()},
        stable=stable or (None if scene.explain_undecided() else False),
        marginal=dominant.marginal,
        spectral_radius=dominant.radius,
        decay_rate=dominant.rate / period,
        stable_stiffness=in_stiffness,
        stable_damping=in_damping,
        stiffness_limit=find_nearest_interval(in_stiffness, scene.wall.stiffness)[1],
        virtual_damping_lower=lower,
        virtual_damping_upper=upper,
        passive=margin > 0 if has_condition else None,
        passivity_margin=margin,
        alpha_max=float(top[0]),
        beta_at_max=float(top[1]),
        stiffness_max=float(best.stiffness),
        virtual_damping_at_max=float(best.virtual_damping),
        ridge_kind=name_kind(best),
        ridge_frequency=float(best.frequency),
        time_constant=math.inf if dominant.rate == 0 else period / dominant.rate,
        frequency=dominant.angle / (2.0 * math.pi * period),
        **{name: float(getattr(margins, name)) for name in _MARGINS},
        unit_system=scene.unit_system,
    )


def name_kind(wall: StiffestWall) -> str:
    """Return the kind of the optimum at a stiffest wall as a word, such as "smooth"; "none" if no such wall exists."""
    return RidgeKind(int(wall.kind)).name.lower() if wall.status == Status.OK else "none"


def round_margin(
    name: str, margins: Assessment | Margins, stable: bool | None, digits: int = 4, *, decibel: bool = False
) -> float:
    """Return a stability margin, rounded to a few digits in the safe direction.

    A change of the loop by the rounded margin leaves a stable wall stable, or makes an unstable wall stable.

    Args:
        name: field with the margin, such as "gain_margin".
        margins: object with this field.
        stable: True if the wall is stable.
        digits: number of significant digits.
        decibel: True to return a gain margin in dB.
    """
    value = float(getattr(margins, name))
    # Round down, with two exceptions: a gain margin above 1 of an unstable wall, because the gain must be increased to
    # stabilize the wall; and a gain margin below 1 of a stable wall, because a reduction of the gain destabilizes it.
    outward = name == "gain_margin" and (value > 1.0) != bool(stable)
    return round_conservatively(20.0 * math.log10(value) if decibel else value, "above" if outward else "below", digits)


def find_nearest_interval(intervals: Intervals, value: float) -> tuple[float, float]:
    """Return both ends of the interval that contains a value or is nearest to it; NaN if the list is empty."""
    away = [max(low - value, value - high, 0.0) for low, high in intervals]
    return intervals[away.index(min(away))] if away else (math.nan, math.nan)


def assess_many(scenes: Iterable[SceneOptima] | Mapping[str, SceneOptima]) -> list[dict[str, Any]]:
    """Assess the walls of many scenes; an error in one scene does not affect the others.

    Args:
        scenes: scenes of any kind, or a mapping of names to scenes.

    Returns:
        A list of dictionaries with equal keys, one per scene: ``scene``, its name or index; ``status`` and ``message``
        ("OK" and "", or "INVALID_INPUT" and the reason); all parameters by dotted path; and the fields of `Assessment`.
        Values that a scene does not have are None. ``csv.DictWriter`` accepts the dictionaries as rows.

    References:
        Hulin, Preusche, Hirzinger 2006, sections V to VIII.

    Example:
        >>> import zwidth
        >>> device, timing, wall = zwidth.Device(0.1, 10), zwidth.Timing(1e-3), zwidth.VirtualWall(25e3, 40)
        >>> scenes = {name: zwidth.Scene(device, timing, wall, zwidth.LowPass(cutoff=c)) for name, c in
        ...           {"slow": 20, "fast": 200, "refused": 900}.items()}
        >>> [(row["scene"], row["status"], row["stable"]) for row in zwidth.assess_many(scenes)]
        [('slow', 'OK', False), ('fast', 'OK', True), ('refused', 'INVALID_INPUT', None)]
    """
    named: Any = scenes.items() if isinstance(scenes, Mapping) else enumerate(scenes)
    records = [_build_record(name, scene) for name, scene in named]
    parameters = [name for record in records for name in record if name not in _NUMBERS]
    names = list(dict.fromkeys([*parameters, *_NUMBERS]))
    return [{name: record.get(name) for name in names} for record in records]


def _build_record(name: str | int, scene: SceneOptima) -> dict[str, Any]:
    """Return a dictionary with the assessment of one scene: its name, status, message, parameters and results."""
    head: dict[str, Any] = {"scene": name, "status": Status.OK.name, "message": ""}
    try:
        if not isinstance(scene, SceneOptima):
            raise InputError(f"scene: got {scene!r}; pass a zwidth.Scene")
        verdict = assess(scene).as_dict()
    except InputError as error:
        verdict, head = {}, head | {"status": Status.INVALID_INPUT.name, "message": str(error)}
    values = scene.parameters() if isinstance(scene, SceneOptima) else {}
    return head | values | verdict


# Improvements that are available in practice. Each entry maps the dotted path of a parameter to the factor by which its
# value is multiplied, and to a description.
IMPROVEMENTS = {
    "delay": (0.5, "half the delay"),
    "damping": (1.1, "10 % more damping of the device"),
    "velocity.cutoff": (2.0, "a velocity filter twice as fast"),
    "velocity.time_constant": (0.5, "a velocity filter twice as fast"),
    "velocity.samples": (0.5, "a velocity window half as long"),
    "actuator.cutoff": (2.0, "an amplifier twice as fast"),
    "actuator.time_constant": (0.5, "an amplifier twice as fast"),
    "coupling.stiffness": (2.0, "a link twice as stiff"),
    "tool.every": (0.5, "a physics engine twice as fast"),
}
# A heavier tool increases K_max of some scenes, a lighter tool that of other scenes; only an increase is listed.
TOOL_MASSES = ((2.0, "a tool twice as heavy"), (0.5, "a tool half as heavy"))
HARMFUL_GAIN = 0.9995  # ratio of the new K_max to the old one below which the note of a change contains "harmful"


@compact_repr()
class Limit(NamedTuple):
    """An improvement of a scene, the stiffness of the improved scene, and its ratio to the current stiffness."""

    name: str  # name of the part or parameter
    label: str  # the improvement in words, such as "half the delay"
    stiffness: float  # in N/m: K_max, or K recommended under the same requirements, of the improved scene
    gain: float  # ratio of that stiffness to the current one
    # Note, such as "the delay stays 1 ms" for a quantity that stays constant, and "harmful" if K_max decreases
    note: str = ""

    def spell(self) -> str:
        """Return a text with the improvement, the stiffness that results from it, and the gain."""
        K = with_unit(round_conservatively(self.stiffness, "below"), find_unit(self, "N/m"))
        note = f"; {self.note}" if self.note else ""
        return f"{self.label}: {K} (x {plain(self.gain, 3)}{note})"


class Improvement(NamedTuple):
    """An improved copy of a scene, with the part or parameter that was improved and a description."""

    name: str  # name of the part or parameter
    label: str  # the improvement in words
    scene: SceneOptima  # the improved scene
    note: str = ""  # quantity that stays constant


@wrap_function
def limits_of(scene: SceneOptima) -> list[Limit]:
    """Compute K_max of a scene after improvements of single parts, to find what limits its maximum stiffness.

    Each part and parameter of the scene is improved separately, by a step that is available in practice: twice the
    rate, half the delay, 10 % more damping, a filter or an amplifier twice as fast, a window half as long, a coupling
    twice as stiff, a structure (modes) twice as stiff, a simulated tool of twice or half the mass, or a physics
    engine twice as fast. At twice the rate the window keeps its length in seconds and the delay stays constant in the
    unit in which it was given; a delay given in seconds is also evaluated constant in periods. If twice the cutoff
    exceeds the Nyquist frequency, the filter is removed instead.

    Args:
        scene: a scene whose parameters are plain numbers.

    Returns:
        List of `Limit`, one per improvement, the largest gain first. Changes that reduce K_max are included, with a
        gain below 1 and the note "harmful", because a filter or a delay may also increase K_max. A filter given by its
        coefficients is not changed and excludes other rates. Entries without a computed K_max contain NaN and are last.
        The list is empty if K_max is infinite, which is possible for a virtual coupling.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII (influence of damping, mass, rate and delay on a rigid device).

    Example:
        >>> import zwidth
        >>> timing = zwidth.Timing(period=1e-3, delay=1e-3)
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), timing, velocity=zwidth.LowPass(cutoff=30))
        >>> [limit.label for limit in zwidth.limits_of(scene)][:2]
        ['twice the rate', 'half the delay']
    """
    return compute_gains(scene, _compute_max_stiffness(scene), _compute_max_stiffness)


def compute_gains(scene: SceneOptima, now: float, measure: Callable[[SceneOptima], float]) -> list[Limit]:
    """Return a list with one `Limit` per improvement of a scene, sorted by gain: the largest first, NaN last.

    Args:
        scene: the scene to improve.
        now: stiffness of the scene without improvements, in N/m.
        measure: function that returns the stiffness of an improved scene in N/m, such as its K_max.
    """
    limits = []
    for name, words, improved, note in list_improvements(scene) if not math.isinf(now) else ():
        stiffness = measure(improved)
        gain = stiffness / now
        if gain < HARMFUL_GAIN:
            note = "; ".join(filter(None, (note, "harmful")))
        if name != "tool" or gain > 1:
            limits.append(Limit(name, words, stiffness, gain, note))
    limits.sort(key=lambda limit: (not limit.gain >= 0, -limit.gain))
    return with_units(ResultList(limits), scene.unit_system)


def describe_islands(scene: SceneOptima) -> list[str]:
    """Return a list of texts: one per island of stable walls not connected to K = 0, and one on an unstable device.

    A device is unstable if it is unstable without a wall.
    """
    lines, system = [], scene.unit_system
    least = scene.loop.least_stiffness(-math.inf if allows_negative(scene, None) else 0.0)
    if least is not None:
        softest = with_unit(round_conservatively(least * scene.units.stiffness, "above"), system["N/m"])
        lines.append(f"the device is unstable without a wall: no wall softer than K = {softest} is stable")
    for island in scene.islands() if scene.loop.has_pieces else []:
        units = {"K": (island.stiffness, system["N/m"]), "B": (island.virtual_damping, system["N s/m"])}
        ends = (f"{name} from {' to '.join(format_interval(*ends, u))}" for name, (ends, u) in units.items())
        lines.append(f"an island of stable walls, {', '.join(ends)}, is not connected to K = 0 and excluded from K_max")
    return lines


def _compute_max_stiffness(scene: SceneOptima) -> float:
    """Return K_max in N/m; NaN if no wall is stable or K_max cannot be computed."""
    try:
        return float(scene.max_stiffness().stiffness)
    except InputError:
        # Return NaN for an invalid improved scene: at twice the sampling rate, a long delay may exceed the largest
        # allowed number of periods.
        return math.nan


def list_improvements(scene: SceneOptima) -> Iterator[Improvement]:
    """Yield one improved copy of the scene for each part or parameter that can be improved."""
    timing = scene.timing
    slower = {"period": scene}
    if timing.delay and not timing.in_periods:
        slower["period_and_delay"] = scene.replace(delay=Span(float(scene.d), "periods"))
    for name, present in slower.items():
        if _can_sample_faster(present):
            note = f"the delay stays {present.timing.delay_text}" if timing.delay else ""
            yield Improvement(name, "twice the rate", _double_rate(present), note)
    values = scene.parameters()
    for path, (factor, words) in IMPROVEMENTS.items():
        if not (now := values.get(path)):
            continue
        better = max(1, round(factor * now)) if isinstance(now, int) else factor * now
        if better == now:
            continue
        improved = scene.replace(**{path: better})
        if path == "velocity.cutoff":
            try:
                improved.check_parts()
            except InputError:
                # Remove the filter instead of doubling its cutoff, because the cutoff must not exceed the Nyquist
                # frequency.
                improved, words = scene.replace(velocity=BackwardDifference()), "no velocity filter"
        yield Improvement(path.partition(".")[0], words, improved)
    if scene.device.modes:
        stiffer = tuple(replace(mode, frequency=math.sqrt(2.0) * mode.frequency) for mode in scene.device.modes)
        yield Improvement("modes", "a structure twice as stiff", scene.replace(modes=stiffer))
    if scene.tool is not None:
        for factor, words in TOOL_MASSES:
            yield Improvement("tool", words, scene.replace(**{"tool.mass": factor * scene.tool.mass}))
    dampings = getattr(scene.device, "joint_dampings", {})
    if any(dampings.values()):
        more = {path: 1.1 * damping for path, damping in dampings.items()}
        yield Improvement("joints", "10 % more damping of the joints", scene.replace(**more))


def _can_sample_faster(scene: SceneOptima) -> bool:
    """Return whether the scene can be evaluated at twice the sampling rate.

    A filter or device given in powers of z is valid for one rate only, and the number of periods in the velocity window
    and the delay is limited.
    """
    if isinstance(scene.velocity, VelocityFilter) or getattr(scene.device, "dt", None) is not None:
        return False
    if isinstance(scene.feedback, Feedback) or isinstance(scene.position, PositionFilter | Observer):
        return False
    too_many_periods = scene.tool is not None and 2 * scene.tool.every > FIELDS["tool.every"].allowed.high
    if too_many_periods or getattr(scene.position, "coefficient", None) is not None:
        return False
    window = scene.velocity.samples if isinstance(scene.velocity, WindowedDifference) else 1
    later = scene.d if scene.timing.in_periods else 2 * scene.d
    return 2 * window + later <= scene.loop.most_periods


def _double_rate(scene: SceneOptima) -> SceneOptima:
    """Return a copy of the scene with half the sampling period.

    Filter, velocity window and steps of the tool stay constant in seconds, the delay in the unit in which it was given.
    """
    changes: dict[str, float] = {"period": scene.timing.period / 2}
    if scene.tool is not None and scene.tool.every > 1:
        changes["tool.every"] = 2 * scene.tool.every
    if isinstance(scene.velocity, WindowedDifference):
        changes["velocity.samples"] = scene.velocity.samples * 2
    if not isinstance(scene.velocity, VelocityFilter | FOAW) and scene.velocity.coded_period is not None:
        changes["velocity.coded_period"] = scene.velocity.coded_period / 2
    if (coded_period := getattr(scene.position, "coded_period", None)) is not None:
        changes["position.coded_period"] = coded_period / 2
    return scene.replace(**changes)


def trace_passivity_boundary(scene: SceneOptima, directions: int = 721) -> tuple[np.ndarray, np.ndarray]:
    """Return arrays of K and B along the boundary of the set of passive walls with K >= 0, in order of increasing B.

    The arrays have ``directions`` elements; they are empty for a device without damping.
    """
    # The device damping that passivity requires is proportional to the distance of the wall (K, B) from the origin.
    # Therefore compute it for one wall in each direction, and scale the wall until the required damping equals that of
    # the device.
    device_damping, units = float(scene.device.damping), scene.units
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, directions)
    # Clip the cosines at 0, because rounding errors may make them negative at angles of -90 and 90 degrees.
    stiffness, damping = np.maximum(np.cos(angle), 0.0) * units.stiffness, np.sin(angle) * units.virtual_damping
    needed = device_damping - np.asarray(scene.passivity_margin(stiffness, damping))
    if device_damping == 0:
        return np.empty(0), np.empty(0)
    return stiffness / needed * device_damping, damping / needed * device_damping
