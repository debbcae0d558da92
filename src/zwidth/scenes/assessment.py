"""A verdict on one wall: stable, how far from the boundary, passive, and what is possible."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, TypeAlias

import numpy as np

from zwidth.loops.linear.passivity import has_condition
from zwidth.scenes.scene import Scene
from zwidth.scenes.stiffest import StiffestWall
from zwidth.words.errors import InputError
from zwidth.words.formatting import to_json
from zwidth.words.status import RidgeKind, Status

_MARGINS = ("gain_margin", "phase_margin", "delay_margin", "modulus_margin", "gain_crossover", "phase_crossover")

Intervals: TypeAlias = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Assessment:
    """What `assess` finds of any scene; SI units unless a symbol is Greek. NaN where a quantity does not exist."""

    alpha: float  # the wall in units of the mass that its force acts on and of the period
    beta: float
    delta: float  # the damping to ground of that mass in the same units
    d: float  # the delay in periods
    stable: bool  # every pole lies strictly inside the unit circle; everything else agrees with it
    marginal: bool  # not stable for one pole at z = 1 alone: without stiffness nothing pulls back
    spectral_radius: float  # the largest pole magnitude, 1 to rounding where the decay is very slow
    decay_rate: float  # of the slowest motion, in 1/s, with relative accuracy; negative for a growing one
    stable_stiffness: Intervals  # every stable interval of K at this B, in N/m
    stable_damping: Intervals  # every stable interval of B at this K, in N s/m
    stiffness_limit: float  # the upper end of that interval of K which holds the wall or is the nearest to it
    virtual_damping_lower: float  # the ends of that interval of B which holds the wall or is the nearest to it
    virtual_damping_upper: float
    passive: bool | None  # whatever the hand; with a coupling True is proved and False is not, None with its tip sensed
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

    def as_dict(self) -> dict[str, Any]:
        """The fields as plain JSON values, None in place of NaN and infinities."""
        return to_json(asdict(self))


def assess(scene: Scene) -> Assessment:
    """Judge the wall of a scene.

    Args:
        scene: device, timing, parts and wall; the delay model must be "held", the one that has poles.

    Returns:
        Assessment: stability, distances to the boundary in K and in B, passivity, the stiffest stable wall of the
        device, the slowest pole, and the margins of control engineering.

    Raises:
        InputError: the scene's delay model is "fractional_power", or it has no wall.

    References:
        Hulin, Preusche, Hirzinger 2006, sections V to VIII.

    Example:
        >>> import zwidth
        >>> device, timing = zwidth.Device(mass=0.1, damping=10), zwidth.Timing(period=1e-3, delay=1e-3)
        >>> verdict = zwidth.assess(zwidth.Scene(device, timing, zwidth.VirtualWall(10e3, 40)))
        >>> verdict.stable, verdict.passive
        (True, False)
    """
    if scene.timing.delay_model != "held":
        raise InputError(
            f"delay_model: got {scene.timing.delay_model!r}, which has no poles; use 'held' to judge a single wall"
        )
    stands, best, known = scene.margins(), scene.max_stiffness(), has_condition(scene.device)
    margin = float(scene.passivity_margin()) if known else math.nan
    top = scene.normalize_walls(best.stiffness, best.virtual_damping)
    row, column = (_list_intervals(ends) for ends in (scene.stable_stiffness(), scene.stable_damping()))
    lower, upper = nearest_interval(column, scene.wall.virtual_damping)
    slowest, period = scene.loop.slowest(float(scene.alpha), float(scene.beta)), scene.timing.period
    return Assessment(
        **{name: float(value) for name, value in scene.normalized._asdict().items()},
        stable=bool(scene.is_stable()),
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
    )


def _list_intervals(ends: np.ndarray) -> Intervals:
    return tuple((low, high) for low, high in ends.tolist())


def name_kind(wall: StiffestWall) -> str:
    """The kind of a stiffest wall in words, "none" where there is no such wall."""
    return RidgeKind(int(wall.kind)).name.lower() if wall.status == Status.OK else "none"


def nearest_interval(intervals: Intervals, value: float) -> tuple[float, float]:
    """The interval that holds a value or is the nearest to it; NaN where there is none."""
    away = [max(low - value, value - high, 0.0) for low, high in intervals]
    return intervals[away.index(min(away))] if away else (math.nan, math.nan)


def assess_many(scenes: Iterable[Scene] | Mapping[str, Scene]) -> list[dict[str, Any]]:
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
    answers = [field.name for field in fields(Assessment)]
    given = [name for record in records for name in record if name not in answers]
    names = list(dict.fromkeys([*given, *answers]))
    return [{name: record.get(name) for name in names} for record in records]


def _record(name: str | int, scene: Scene) -> dict[str, Any]:
    head: dict[str, Any] = {"scene": name, "status": Status.OK.name, "message": ""}
    try:
        if not isinstance(scene, Scene):
            raise InputError(f"scene: got {scene!r}; a zwidth.Scene is needed")
        verdict = assess(scene).as_dict()
    except InputError as error:
        verdict, head = {}, head | {"status": Status.INVALID_INPUT.name, "message": str(error)}
    own = scene.parameters() if isinstance(scene, Scene) else {}
    return head | own | verdict
