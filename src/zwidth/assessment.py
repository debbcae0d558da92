"""A verdict on one wall: stable, how far from the boundary, passive, and what is possible."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from zwidth.errors import InputError
from zwidth.linear.passivity import has_condition
from zwidth.linear.poles import is_marginal
from zwidth.scene import Scene
from zwidth.stability.boundary import boundary_point
from zwidth.stability.decay import decay_rate
from zwidth.stability.proved import outermost_poles
from zwidth.stability.radii import spectral_radius
from zwidth.stability.ridge import RidgeKind, alpha_max
from zwidth.status import Status

_POLE_ACCURACY = 1e-9
_MARGINS = ("gain_margin", "phase_margin", "delay_margin", "modulus_margin", "gain_crossover", "phase_crossover")


class _AsDict:
    """Fields as plain numbers."""

    def as_dict(self: Any) -> dict[str, Any]:
        """The fields as plain JSON values, None in place of NaN and infinities."""
        return {name: _plain(value) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class Assessment(_AsDict):
    """What `assess` finds; SI units unless a symbol is Greek. NaN where a quantity does not exist."""

    alpha: float  # the normalized wall, device and delay
    beta: float
    delta: float
    d: float
    stable: bool  # every pole lies strictly inside the unit circle; everything else agrees with it
    marginal: bool  # not stable for one pole at z = 1 alone: without stiffness nothing pulls back
    spectral_radius: float  # the largest pole magnitude, 1 to rounding where the decay is very slow
    decay_rate: float  # of the slowest motion, in 1/s, with relative accuracy; negative for a growing one
    stiffness_limit: float  # the stiffest stable K at this B, in N/m
    virtual_damping_lower: float  # the ends of the stable B at this K, in N s/m
    virtual_damping_upper: float
    passive: bool  # at this delay, whatever the hand
    passivity_margin: float  # the device's damping in excess of what a passive wall needs, in N s/m
    alpha_max: float  # the stiffest stable wall of this device
    beta_at_max: float
    stiffness_max: float  # the same in N/m and N s/m
    virtual_damping_at_max: float
    ridge_kind: str  # "smooth" or "corner"
    time_constant: float  # of the slowest pole, in s; negative for a growing one, infinite on the circle
    frequency: float  # at which the slowest pole oscillates, in Hz; 0 for one that does not
    gain_margin: float  # the factor by which K and B together may grow; below 1 the one to which they must fall
    phase_margin: float  # in degrees; positive exactly for a stable wall
    delay_margin: float  # how much more delay the wall bears, in s
    modulus_margin: float  # the least distance of the open loop from -1
    gain_crossover: float  # where the first two are taken, in Hz
    phase_crossover: float


@dataclass(frozen=True)
class SceneAssessment(_AsDict):
    """What `assess` finds of a scene with a filter, a compliance or a hand; SI units, NaN for what does not exist."""

    stable: bool  # every pole lies strictly inside the unit circle
    marginal: bool  # not stable for one pole at z = 1 alone: without stiffness nothing pulls back
    spectral_radius: float  # the largest pole magnitude
    decay_rate: float  # of the slowest motion, in 1/s; negative for a growing one
    stable_stiffness: tuple[tuple[float, float], ...]  # every stable interval of K at this B, in N/m
    stable_damping: tuple[tuple[float, float], ...]  # every stable interval of B at this K, in N s/m
    stiffness_max: float  # of the stiffest stable wall, in N/m
    virtual_damping_at_max: float  # in N s/m
    ridge_kind: str  # "smooth", "corner" or "no_damping"; "none" where no wall is stable
    ridge_frequency: float  # of the pole pair on the unit circle there, in Hz
    time_constant: float  # of the slowest pole, in s; negative for a growing one, infinite on the circle
    frequency: float  # at which the slowest pole oscillates, in Hz; 0 for one that does not
    passive: bool | None  # whatever the hand; with a coupling True is proved and False is not, None with its tip sensed
    passivity_margin: float  # the device's damping in excess of what a passive wall needs, in N s/m
    gain_margin: float  # the margins are those of `zwidth.Scene.margins`
    phase_margin: float  # in degrees
    delay_margin: float  # in s; NaN where it could not be confirmed
    modulus_margin: float
    gain_crossover: float  # in Hz
    phase_crossover: float


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def assess(scene: Scene) -> Assessment | SceneAssessment:
    """Judge the wall of a scene.

    Args:
        scene: device, timing and wall; the delay model must be "held", the one that has poles.

    Returns:
        Assessment: stability, distances to the boundary in K and in B, passivity, the stiffest stable wall of the
        device, the slowest pole, and the margins of control engineering. For a scene with a filter, a compliance or a
        hand behind a spring a SceneAssessment, in SI units alone, with every stable interval.

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
    shared: dict[str, Any] = {
        "stable": bool(scene.is_stable()),
        "stiffness_max": float(best.stiffness),
        "virtual_damping_at_max": float(best.virtual_damping),
        "ridge_kind": RidgeKind(int(best.kind)).name.lower() if best.status == Status.OK else "none",
        "passive": margin > 0 if known else None,
        "passivity_margin": margin,
        **{name: float(getattr(stands, name)) for name in _MARGINS},
    }
    if scene.is_rigid:
        return Assessment(**shared, **_judge_rigid(scene))
    return SceneAssessment(**shared, **_judge_parts(scene, float(best.frequency)))


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
    answers = [field.name for kind in (Assessment, SceneAssessment) for field in fields(kind)]
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


def _judge_rigid(scene: Scene) -> dict[str, Any]:
    """What the closed forms give of a rigid scene alone: normalized numbers, one interval of each kind."""
    alpha, beta, delta, d = (float(value) for value in scene.normalized)
    units, period = scene.units, scene.timing.period
    rate = float(decay_rate(alpha, beta, delta, d))
    ridge = alpha_max(delta, d)
    row = boundary_point(delta, d, beta=beta)
    lower, upper = _column(alpha, delta, d)
    return {
        "alpha": alpha,
        "beta": beta,
        "delta": delta,
        "d": d,
        # The row is stable right above K = 0, where nothing but the pole at z = 1 comes to the circle.
        "marginal": alpha == 0 and float(row.alpha) > 0,
        "spectral_radius": float(spectral_radius(alpha, beta, delta, d)),
        "decay_rate": rate / period,
        "stiffness_limit": float(row.alpha) * units.stiffness,
        "virtual_damping_lower": lower * units.virtual_damping,
        "virtual_damping_upper": upper * units.virtual_damping,
        "alpha_max": float(ridge.alpha),
        "beta_at_max": float(ridge.beta),
        "time_constant": math.inf if rate == 0 else period / rate,
        "frequency": _slowest_turn(alpha, beta, delta, d) / (2.0 * math.pi * period),
    }


def _judge_parts(scene: Scene, frequency: float) -> dict[str, Any]:
    """The same of a scene with parts: every stable interval, and the slowest of all poles."""
    alpha, beta = (float(value) for value in scene.normalize_walls())
    slowest = scene.pole_table()
    marginal = is_marginal(scene.loop, alpha, beta)
    constant = math.inf if marginal else float(slowest.time_constant[0])
    return {
        "marginal": marginal,
        "spectral_radius": 1.0 if marginal else float(scene.spectral_radius()),
        "decay_rate": 1.0 / constant if constant else math.inf,
        "stable_stiffness": _as_pairs(scene.stable_stiffness()),
        "stable_damping": _as_pairs(scene.stable_damping()),
        "ridge_frequency": frequency,
        "time_constant": constant,
        "frequency": 0.0 if marginal else float(slowest.frequency[0]),
    }


def _as_pairs(intervals: np.ndarray) -> tuple[tuple[float, float], ...]:
    return tuple((float(low), float(high)) for low, high in intervals)


def _slowest_turn(alpha: float, beta: float, delta: float, d: float) -> float:
    """By which angle the slowest pole turns a period."""
    with np.errstate(all="ignore"):
        found = outermost_poles([np.array([value]) for value in (alpha, beta, delta, d)], _POLE_ACCURACY)
    return abs(float(found.im[0]))


def _column(alpha: float, delta: float, d: float) -> tuple[float, float]:
    """The smallest and largest stable damping at this stiffness."""
    if alpha <= 0:
        return math.nan, math.nan
    ends = [boundary_point(delta, d, alpha=alpha, side=side) for side in ("lower", "upper")]
    return float(ends[0].beta), float(ends[1].beta)
