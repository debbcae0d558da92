"""Assessment of one wall: stability, margins, passivity, and the limits of the device."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from zwidth.loops.linear.passivity import find_unsupported_reason
from zwidth.parts.checks import Span
from zwidth.parts.velocity import FOAW, BackwardDifference, VelocityFilter, WindowedDifference
from zwidth.scenes.answers import allows_negative
from zwidth.scenes.base import of_scene
from zwidth.scenes.stiffest import SceneOptima, StiffestWall
from zwidth.words.errors import InputError
from zwidth.words.formatting import plain, round_safely, tell_apart, to_json, with_unit
from zwidth.words.results import Margins
from zwidth.words.showing import ResultList, find_unit, shown, with_units
from zwidth.words.status import RidgeKind, Status
from zwidth.words.unit_system import LINEAR, UnitSystem

_MARGINS = ("gain_margin", "phase_margin", "delay_margin", "modulus_margin", "gain_crossover", "phase_crossover")

# Of the fields below.
_UNITS: dict[str, Any] = {
    **dict.fromkeys(("stable_stiffness", "stiffness_limit", "stiffness_max"), "N/m"),
    **dict.fromkeys(("stable_damping", "virtual_damping_lower", "virtual_damping_upper"), "N s/m"),
    **dict.fromkeys(("passivity_margin", "virtual_damping_at_max"), "N s/m"),
    **dict.fromkeys(("ridge_frequency", "frequency", "gain_crossover", "phase_crossover"), "Hz"),
    **{"decay_rate": "1/s", "time_constant": "s", "phase_margin": "degrees", "delay_margin": "s"},
}
_MISSING = {
    "passivity_margin": "no condition is known for these parts",
    "delay_margin": "it could not be confirmed",
    "phase_margin": "no frequency decides it",
    **dict.fromkeys(
        ("alpha_max", "beta_at_max", "stiffness_max", "virtual_damping_at_max", "ridge_frequency"), "no wall is stable"
    ),
}

Intervals: TypeAlias = tuple[tuple[float, float], ...]


@shown(missing=_MISSING, **_UNITS)
@dataclass(frozen=True)
class Assessment:
    """What `assess` finds of any scene; SI units unless a symbol is Greek. NaN where a quantity does not exist."""

    alpha: float  # the wall in units of the mass that its force acts on and of the period
    beta: float
    delta: float  # the damping to ground of that mass in the same units
    d: float  # the delay in periods
    stable: bool | None  # every pole lies strictly inside the unit circle; None: a measured response leaves it open
    marginal: bool  # poles on the unit circle, none outside: one at z = 1 (K = 0), or all of a plant without damping
    spectral_radius: float  # the largest pole magnitude, 1 to rounding where the decay is very slow
    decay_rate: float  # of the slowest motion, in 1/s, with relative accuracy; negative for a growing one
    stable_stiffness: Intervals  # every stable interval of K at this B, in N/m
    stable_damping: Intervals  # every stable interval of B at this K, in N s/m
    stiffness_limit: float  # the upper end of that interval of K which holds the wall or is the nearest to it
    virtual_damping_lower: float  # the ends of that interval of B which holds the wall or is the nearest to it
    virtual_damping_upper: float
    passive: bool | None  # whatever the hand; with a coupling True is proved and False is not; None without a condition
    passivity_margin: float  # the device's damping in excess of what a passive wall needs, in N s/m
    alpha_max: float  # the stiffest stable wall of this device (`zwidth.Scene.max_stiffness`)
    beta_at_max: float
    stiffness_max: float  # the same in N/m and N s/m
    virtual_damping_at_max: float
    ridge_kind: str  # "smooth", "corner" or "no_damping"; "none" where no wall is stable
    ridge_frequency: float  # of the pole pair on the unit circle there, in Hz
    time_constant: float  # of the slowest pole, in s; negative for a growing one, infinite on the circle
    frequency: float  # at which the slowest pole oscillates, in Hz; 0 for one that does not
    gain_margin: float  # the factor by which K and B together may grow; below 1 the one to which they must fall
    phase_margin: float  # in degrees; positive exactly for a stable wall
    delay_margin: float  # how much more delay the wall bears, in s; NaN where it could not be confirmed
    modulus_margin: float  # the least distance of the open loop from -1
    gain_crossover: float  # where the first two are taken, in Hz
    phase_crossover: float
    unit_system: UnitSystem = LINEAR

    def as_dict(self) -> dict[str, Any]:
        """Return the fields except the unit system as JSON values, with None in place of NaN and infinity."""
        return to_json({name: getattr(self, name) for name in _NUMBERS})


_NUMBERS = [field.name for field in fields(Assessment) if field.name != "unit_system"]


@of_scene
def assess(scene: SceneOptima) -> Assessment:
    """Judge the wall of a scene.

    Args:
        scene: device, timing, parts and wall.

    Returns:
        Assessment: stability, distances to the boundary in K and in B, passivity, the stiffest stable wall of the
        device, the slowest pole, and the margins of control engineering.

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
    # Compute the dominant pole first, because this raises an error if the loop has too many poles.
    slowest, period = scene.loop.slowest(float(scene.alpha), float(scene.beta)), scene.timing.period
    stands, best, known = scene.margins(), scene.max_stiffness(), not find_unsupported_reason(**vars(scene.device))
    margin = float(scene.passivity_margin()) if known else math.nan
    top = scene.normalize_walls(best.stiffness, best.virtual_damping)
    row, column = (tuple(map(tuple, ends.tolist())) for ends in (scene.stable_stiffness(), scene.stable_damping()))
    lower, upper = nearest_interval(column, scene.wall.virtual_damping)
    stable = bool(scene.is_stable())
    return Assessment(
        **{name: float(value) for name, value in scene.normalized._asdict().items()},
        stable=stable or (None if scene.explain_undecided() else False),
        marginal=slowest.marginal,
        spectral_radius=slowest.radius,
        decay_rate=slowest.rate / period,
        stable_stiffness=row,
        stable_damping=column,
        stiffness_limit=nearest_interval(row, scene.wall.stiffness)[1],
        virtual_damping_lower=lower,
        virtual_damping_upper=upper,
        passive=margin > 0 if known else None,
        passivity_margin=margin,
        alpha_max=float(top[0]),
        beta_at_max=float(top[1]),
        stiffness_max=float(best.stiffness),
        virtual_damping_at_max=float(best.virtual_damping),
        ridge_kind=name_kind(best),
        ridge_frequency=float(best.frequency),
        time_constant=math.inf if slowest.rate == 0 else period / slowest.rate,
        frequency=slowest.angle / (2.0 * math.pi * period),
        **{name: float(getattr(stands, name)) for name in _MARGINS},
        unit_system=scene.unit_system,
    )


def name_kind(wall: StiffestWall) -> str:
    """The kind of a stiffest wall in words, "none" where there is no such wall."""
    return RidgeKind(int(wall.kind)).name.lower() if wall.status == Status.OK else "none"


def round_margin(
    name: str, margins: Assessment | Margins, stable: bool | None, digits: int = 4, *, decibel: bool = False
) -> float:
    """A margin in few digits, rounded so that a wall bears what is read, or that an unstable one is stable by it."""
    value = float(getattr(margins, name))
    # A gain margin may be a factor below 1 of a stable wall, too.
    outward = name == "gain_margin" and (value > 1.0) != bool(stable)
    return round_safely(20.0 * math.log10(value) if decibel else value, "above" if outward else "below", digits)


def nearest_interval(intervals: Intervals, value: float) -> tuple[float, float]:
    """The interval that holds a value or is the nearest to it; NaN where there is none."""
    away = [max(low - value, value - high, 0.0) for low, high in intervals]
    return intervals[away.index(min(away))] if away else (math.nan, math.nan)


def assess_many(scenes: Iterable[SceneOptima] | Mapping[str, SceneOptima]) -> list[dict[str, Any]]:
    """Judge the walls of many scenes, one record each; a scene that has no answer leaves the others alone.

    Args:
        scenes: scenes of any kind, or a mapping of names to scenes.

    Returns:
        A list of dicts with the same keys, a row of a table each: ``scene``, its name or number; ``status`` and
        ``message`` ("OK" and nothing, or "INVALID_INPUT" and why); every parameter by its dotted path; and what
        `assess` finds, None where a scene has no such number. ``csv.DictWriter`` writes them as they are.

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
    records = [_record(name, scene) for name, scene in named]
    given = [name for record in records for name in record if name not in _NUMBERS]
    names = list(dict.fromkeys([*given, *_NUMBERS]))
    return [{name: record.get(name) for name in names} for record in records]


def _record(name: str | int, scene: SceneOptima) -> dict[str, Any]:
    head: dict[str, Any] = {"scene": name, "status": Status.OK.name, "message": ""}
    try:
        if not isinstance(scene, SceneOptima):
            raise InputError(f"scene: got {scene!r}; a zwidth.Scene is needed")
        verdict = assess(scene).as_dict()
    except InputError as error:
        verdict, head = {}, head | {"status": Status.INVALID_INPUT.name, "message": str(error)}
    own = scene.parameters() if isinstance(scene, SceneOptima) else {}
    return head | own | verdict


# What somebody can buy of a parameter, by its path: the factor on it, and the words.
_STEPS = {
    "delay": (0.5, "half the delay"),
    "damping": (1.1, "10 % more damping of the device"),
    "velocity.cutoff": (2.0, "a velocity filter twice as fast"),
    "velocity.time_constant": (0.5, "a velocity filter twice as fast"),
    "velocity.samples": (0.5, "a velocity window half as long"),
    "actuator.cutoff": (2.0, "an amplifier twice as fast"),
    "actuator.time_constant": (0.5, "an amplifier twice as fast"),
    "coupling.stiffness": (2.0, "a link twice as stiff"),
}


@shown()
class Limit(NamedTuple):
    """An improvement of a scene and the stiffness gained by it."""

    name: str  # name of the part or parameter
    words: str  # the improvement in words, such as "half the delay"
    stiffness: float  # in N/m: K_max, or K recommended under the same requirements, of the improved scene
    gain: float  # ratio of that stiffness to the present one
    note: str = ""  # quantity that stays constant, such as "the delay stays 1 ms"

    def spell(self) -> str:
        """Describe the improvement and the increase of the stiffness that it brings."""
        K = with_unit(round_safely(self.stiffness, "below"), find_unit(self, "N/m"))
        kept = f"; {self.note}" if self.note else ""
        return f"{self.words}: {K} (x {plain(self.gain, 3)}{kept})"


class Improvement(NamedTuple):
    """A scene with one part or parameter improved."""

    name: str  # name of the part or parameter
    words: str  # the improvement in words
    scene: SceneOptima  # the improved scene
    note: str = ""  # quantity that stays constant


@of_scene
def limits_of(scene: SceneOptima) -> list[Limit]:
    """Say what limits the stiffest wall of a scene, that of `Scene.max_stiffness`: islands do not count.

    Each part and parameter of the scene is improved separately, by a step that is available in practice: twice the
    rate, half the delay, 10 % more damping, a filter or an amplifier twice as fast, a window half as long, a coupling
    twice as stiff, or a structure twice as stiff for the modes. At twice the rate the window keeps its length in
    seconds and the delay stays constant in the unit in which it was given; a delay given in seconds is also evaluated
    constant in periods. If twice the cutoff exceeds the Nyquist frequency, the filter is removed instead.

    Args:
        scene: a scene of plain numbers.

    Returns:
        One record each, the largest gain first. What makes the wall softer is listed as well, with a gain below 1: a
        filter may help as it is. A filter given by its coefficients has no steps, and no rate but its own. NaN where a
        K_max cannot be computed; those come last.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII (what damping, mass, rate and delay change of a rigid device).

    Example:
        >>> import zwidth
        >>> timing = zwidth.Timing(period=1e-3, delay=1e-3)
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), timing, velocity=zwidth.LowPass(cutoff=30))
        >>> [limit.words for limit in zwidth.limits_of(scene)][:2]
        ['twice the rate', 'half the delay']
    """
    return compute_gains(scene, _stiffness(scene), _stiffness)


def compute_gains(scene: SceneOptima, now: float, measure: Callable[[SceneOptima], float]) -> list[Limit]:
    """Return all improvements by the increase of the stiffness that ``measure`` computes, largest first, NaN last."""
    found = []
    for name, words, improved, note in list_improvements(scene):
        stiffness = measure(improved)
        found.append(Limit(name, words, stiffness, stiffness / now, note))
    found.sort(key=lambda limit: (not limit.gain >= 0, -limit.gain))
    return with_units(ResultList(found), scene.unit_system)


def describe_islands(scene: SceneOptima) -> list[str]:
    """Return one line for each island, and one line if the device is unstable without a wall."""
    lines, system = [], scene.unit_system
    least = scene.loop.least_stiffness(-math.inf if allows_negative(scene, None) else 0.0)
    if least is not None:
        softest = with_unit(round_safely(least * scene.units.stiffness, "above"), system["N/m"])
        lines.append(f"the device is unstable without a wall: no wall softer than K = {softest} is stable")
    for island in scene.islands():
        units = {"K": (island.stiffness, system["N/m"]), "B": (island.virtual_damping, system["N s/m"])}
        ends = (f"{name} from {' to '.join(tell_apart(*ends, u))}" for name, (ends, u) in units.items())
        lines.append(
            f"an island of stable walls, {', '.join(ends)}: no stable softer walls lead to it, K_max leaves it out"
        )
    return lines


def _stiffness(scene: SceneOptima) -> float:
    """K_max in N/m; NaN where there is none or it cannot be computed."""
    try:
        return float(scene.max_stiffness().stiffness)
    except InputError:
        # At twice the rate a long delay may be more periods than the model is computed for.
        return math.nan


def list_improvements(scene: SceneOptima) -> Iterator[Improvement]:
    """Yield the scene with one part or parameter improved, for each that it has."""
    timing = scene.timing
    slower = {"period": scene}
    if timing.delay and not timing.in_periods:
        slower["period_and_delay"] = scene.replace(delay=Span(float(scene.d), "periods"))
    for name, present in slower.items():
        if _can_sample_faster(present):
            note = f"the delay stays {present.timing.kept_delay}" if timing.delay else ""
            yield Improvement(name, "twice the rate", _double_rate(present), note)
    values = scene.parameters()
    for path, (factor, words) in _STEPS.items():
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
                # Beyond half the rate there is no filter.
                improved, words = scene.replace(velocity=BackwardDifference()), "no velocity filter"
        yield Improvement(path.partition(".")[0], words, improved)
    if scene.device.modes:
        stiffer = tuple(replace(mode, frequency=math.sqrt(2.0) * mode.frequency) for mode in scene.device.modes)
        yield Improvement("modes", "a structure twice as stiff", scene.replace(modes=stiffer))


def _can_sample_faster(scene: SceneOptima) -> bool:
    """Return whether the scene is defined at twice the rate; a model given in z holds for one rate only."""
    if isinstance(scene.velocity, VelocityFilter) or getattr(scene.device, "dt", None) is not None:
        return False
    window = scene.velocity.samples if isinstance(scene.velocity, WindowedDifference) else 1
    later = scene.d if scene.timing.in_periods else 2 * scene.d
    return 2 * window + later <= scene.loop.most_periods


def _double_rate(scene: SceneOptima) -> SceneOptima:
    """Return the scene at twice the rate: filter and window constant in seconds, the delay in its given unit."""
    changes: dict[str, float] = {"period": scene.timing.period / 2}
    if isinstance(scene.velocity, WindowedDifference):
        changes["velocity.samples"] = scene.velocity.samples * 2
    if not isinstance(scene.velocity, VelocityFilter | FOAW) and scene.velocity.coded_period is not None:
        changes["velocity.coded_period"] = scene.velocity.coded_period / 2
    return scene.replace(**changes)


def passive_edge(scene: SceneOptima, directions: int = 721) -> tuple[np.ndarray, np.ndarray]:
    """K and B of the edge of the passive walls with K >= 0, from the least B to the largest; empty without damping."""
    # The condition is homogeneous: a wall needs damping in proportion to its distance from the origin.
    own, units = float(scene.device.damping), scene.units
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, directions)
    # The smallest cosines are rounded zeros.
    stiffness, damping = np.maximum(np.cos(turn), 0.0) * units.stiffness, np.sin(turn) * units.virtual_damping
    needed = own - np.asarray(scene.passivity_margin(stiffness, damping))
    if own == 0:
        return np.empty(0), np.empty(0)
    return stiffness / needed * own, damping / needed * own
