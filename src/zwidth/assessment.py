"""A verdict on one wall: stable, how far from the boundary, passive, and what is possible."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from zwidth.errors import InputError
from zwidth.linear.columns import stable_dampings
from zwidth.scene import Scene
from zwidth.stability.boundary import boundary_point
from zwidth.stability.decay import decay_rate
from zwidth.stability.labels import is_stable
from zwidth.stability.margins import margins
from zwidth.stability.passivity import passivity_margin
from zwidth.stability.proved import outermost_poles
from zwidth.stability.ridge import RidgeKind, alpha_max
from zwidth.status import Status

_POLE_ACCURACY = 1e-9


@dataclass(frozen=True)
class Assessment:
    """What `assess` finds; SI units unless a symbol is Greek. NaN where a quantity does not exist."""

    alpha: float  # the normalized wall, device and delay
    beta: float
    delta: float
    d: float
    stable: bool  # every pole lies strictly inside the unit circle; everything else agrees with it
    spectral_radius: float  # the largest pole magnitude, 1 to rounding where the decay is very slow
    decay_rate: float  # of the slowest motion, in 1/s, with relative accuracy; negative for a growing one
    stiffness_limit: float  # the stiffest stable K at this B, in N/m
    virtual_damping_lower: float  # the ends of the stable B at this K, in N s/m
    virtual_damping_upper: float
    passive: bool  # at this delay
    passivity_margin: float  # the physical damping in excess of what a passive wall needs, in N s/m
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

    def as_dict(self) -> dict[str, Any]:
        """The fields as plain JSON values, None in place of NaN and infinities."""
        return {name: _plain(value) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class SceneAssessment:
    """What `assess` finds of a scene with a filter, a compliance or a hand; SI units, NaN for what does not exist."""

    stable: bool  # every pole lies strictly inside the unit circle
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

    def as_dict(self) -> dict[str, Any]:
        """The fields as plain JSON values, None in place of NaN and infinities."""
        return {name: _plain(value) for name, value in asdict(self).items()}


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
        InputError: the scene's delay model is "fractional_power".

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
    return _assess_rigid(scene) if scene.is_rigid else _assess_parts(scene)


def _assess_rigid(scene: Scene) -> Assessment:
    alpha, beta, delta, d = (float(value) for value in scene.normalized)
    period = scene.timing.period
    spring = scene.mass / period**2
    damper = scene.mass / period
    hertz = 1.0 / (2.0 * math.pi * period)
    rate = float(decay_rate(alpha, beta, delta, d))
    stands = margins(alpha, beta, delta, d)
    ridge = alpha_max(delta, d)
    row = boundary_point(delta, d, beta=beta)
    lower, upper = _column(alpha, delta, d)
    margin = float(passivity_margin(alpha, beta, delta, d))
    return Assessment(
        alpha=alpha,
        beta=beta,
        delta=delta,
        d=d,
        stable=bool(is_stable(alpha, beta, delta, d)),
        spectral_radius=math.exp(-rate),
        decay_rate=rate / period,
        stiffness_limit=float(row.alpha) * spring,
        virtual_damping_lower=lower * damper,
        virtual_damping_upper=upper * damper,
        passive=margin > 0,
        passivity_margin=margin * damper,
        alpha_max=float(ridge.alpha),
        beta_at_max=float(ridge.beta),
        stiffness_max=float(ridge.alpha) * spring,
        virtual_damping_at_max=float(ridge.beta) * damper,
        ridge_kind=RidgeKind(int(ridge.kind)).name.lower(),
        time_constant=math.inf if rate == 0 else period / rate,
        frequency=_slowest_turn(alpha, beta, delta, d) * hertz,
        gain_margin=float(stands.gain_margin),
        phase_margin=float(stands.phase_margin),
        delay_margin=float(stands.delay_margin) * period,
        modulus_margin=float(stands.modulus_margin),
        gain_crossover=float(stands.gain_crossover) * hertz,
        phase_crossover=float(stands.phase_crossover) * hertz,
    )


def _assess_parts(scene: Scene) -> SceneAssessment:
    stiffness, damping = scene.wall.stiffness, scene.wall.virtual_damping
    units = scene.units
    slowest = scene.pole_table(stiffness, damping)
    best = scene.max_stiffness()
    column = stable_dampings(scene.traced_boundary, stiffness / units.stiffness) * units.virtual_damping
    constant = float(slowest.time_constant[0])
    return SceneAssessment(
        stable=bool(scene.is_stable(stiffness, damping)),
        spectral_radius=float(scene.spectral_radius(stiffness, damping)),
        decay_rate=1.0 / constant if constant else math.inf,
        stable_stiffness=_as_pairs(scene.stable_stiffness(damping)),
        stable_damping=_as_pairs(column),
        stiffness_max=float(best.stiffness),
        virtual_damping_at_max=float(best.virtual_damping),
        ridge_kind=RidgeKind(int(best.kind)).name.lower() if best.status == Status.OK else "none",
        ridge_frequency=float(best.frequency),
        time_constant=constant,
        frequency=float(slowest.frequency[0]),
    )


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
