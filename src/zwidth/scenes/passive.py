"""What a device's own losses pay for: the edge of its passive walls, and a rule with friction and a coarse sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.scenes.scene import Scene


class FrictionRule(NamedTuple):
    """Stiffnesses up to which viscous damping, and Coulomb friction, pay for sampling and for quantization."""

    by_damping: float | None  # 2 b/T; None where there is no damping
    by_friction: float | None  # 2 f_c/Q; None where friction or resolution is not given

    @property
    def stiffness(self) -> float | None:
        """The lower of the two, which is the rule; None where one of them is missing."""
        return None if self.by_damping is None or self.by_friction is None else min(self.by_damping, self.by_friction)


def friction_rule(
    *, damping: float, period: float, friction: float | None = None, resolution: float | None = None
) -> FrictionRule:
    """Return up to which stiffness a wall without virtual damping and delay is passive.

    ``K <= min(2 b/T, 2 f_c/Q)``: viscous damping pays for sampling, Coulomb friction for quantization. A sufficient
    condition for a spring alone, on a rigid device; its delay and its velocity estimate do not enter.

    Args:
        damping: b in N s/m, >= 0.
        period: T in s, > 0.
        friction: f_c in N.
        resolution: Q, one step of the position sensor, in m, > 0.

    Returns:
        FrictionRule in N/m.

    References:
        Abbott and Okamura 2005, IEEE Transactions on Robotics 21(5), 952-964.

    Example:
        >>> from zwidth.scenes.passive import friction_rule
        >>> rule = friction_rule(damping=0.033, period=350e-6, friction=0.24, resolution=15.7e-6)
        >>> print(f"{rule.by_damping:.0f} N/m, {rule.by_friction:.0f} N/m")
        189 N/m, 30573 N/m
    """
    by_friction = None if friction is None or resolution is None else 2.0 * friction / resolution
    return FrictionRule(2.0 * damping / period if damping else None, by_friction)


def passive_edge(scene: Scene, directions: int = 721) -> tuple[np.ndarray, np.ndarray]:
    """K and B of the edge of the passive walls with K >= 0, from the least B to the largest; empty without damping.

    The condition is homogeneous: a wall needs damping in proportion to its distance from the origin.
    """
    own, units = float(scene.device.damping), scene.units
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, directions)
    # The smallest cosines are rounded zeros.
    stiffness, damping = np.maximum(np.cos(turn), 0.0) * units.stiffness, np.sin(turn) * units.virtual_damping
    needed = own - np.asarray(scene.passivity_margin(stiffness, damping))
    if own == 0:
        return np.empty(0), np.empty(0)
    return stiffness / needed * own, damping / needed * own
