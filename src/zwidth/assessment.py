"""A verdict on one wall: stable or not, how far from the boundary, passive or not, and what would be possible."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from zwidth.errors import InputError
from zwidth.scene import Scene
from zwidth.stability.boundary import boundary_point
from zwidth.stability.passivity import passivity_margin
from zwidth.stability.poles import poles
from zwidth.stability.ridge import RidgeKind, alpha_max


@dataclass(frozen=True)
class Assessment:
    """What `assess` finds; SI units unless a symbol is Greek. NaN where a quantity does not exist.

    Attributes:
        alpha, beta, delta, d: the normalized wall, device and delay.
        stable: whether every pole lies strictly inside the unit circle.
        spectral_radius: the largest pole magnitude.
        stiffness_limit: the stiffest stable K at this B, in N/m.
        virtual_damping_lower, virtual_damping_upper: the ends of the stable B at this K, in N s/m.
        passive: whether the wall is passive at this delay.
        passivity_margin: the physical damping in excess of what a passive wall needs, in N s/m.
        alpha_max, beta_at_max: the stiffest stable wall of this device, normalized.
        stiffness_max, virtual_damping_at_max: the same in N/m and N s/m.
        ridge_kind: "smooth" or "corner".
        time_constant: of the slowest pole, in s; negative for a growing one, infinite on the circle.
        frequency: at which the slowest pole oscillates, in Hz; 0 for one that does not.
    """

    alpha: float
    beta: float
    delta: float
    d: float
    stable: bool
    spectral_radius: float
    stiffness_limit: float
    virtual_damping_lower: float
    virtual_damping_upper: float
    passive: bool
    passivity_margin: float
    alpha_max: float
    beta_at_max: float
    stiffness_max: float
    virtual_damping_at_max: float
    ridge_kind: str
    time_constant: float
    frequency: float

    def as_dict(self) -> dict[str, Any]:
        """The fields as plain JSON values, None in place of NaN and infinities."""
        return {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in asdict(self).items()
        }


def assess(scene: Scene) -> Assessment:
    """Judge the wall of a scene.

    Args:
        scene: device, timing and wall; the delay model must be "held", the one that has poles.

    Returns:
        Assessment: stability, distances to the boundary in K and in B, passivity, the stiffest stable wall of the
        device, and the slowest pole.

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
    alpha, beta, delta, d = (float(value) for value in scene.normalized)
    period = scene.timing.period
    spring = scene.device.mass / period**2
    damper = scene.device.mass / period
    slowest = _slowest_pole(alpha, beta, delta, d)
    radius = abs(slowest)
    ridge = alpha_max(delta, d)
    row = boundary_point(delta, d, beta=beta)
    lower, upper = _column(alpha, delta, d)
    margin = float(passivity_margin(alpha, beta, delta, d))
    return Assessment(
        alpha=alpha,
        beta=beta,
        delta=delta,
        d=d,
        stable=bool(radius < 1.0),
        spectral_radius=radius,
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
        time_constant=_time_constant(radius, period),
        frequency=float(abs(np.angle(slowest)) / (2 * np.pi * period)),
    )


def _slowest_pole(alpha: float, beta: float, delta: float, d: float) -> complex:
    every = np.asarray(poles(alpha, beta, delta, d))
    return complex(every[np.argmax(np.abs(every))])


def _column(alpha: float, delta: float, d: float) -> tuple[float, float]:
    """The smallest and largest stable damping at this stiffness."""
    if alpha <= 0:
        return math.nan, math.nan
    ends = [boundary_point(delta, d, alpha=alpha, side=side) for side in ("lower", "upper")]
    return float(ends[0].beta), float(ends[1].beta)


def _time_constant(radius: float, period: float) -> float:
    """The time in which the pole's share decays to 1/e."""
    if radius == 0:
        return 0.0
    rate = -math.log(radius)
    return math.inf if rate == 0 else period / rate
