"""What a device's own losses pay for: a rule for passive walls with friction and a coarse position sensor."""

from __future__ import annotations

from typing import NamedTuple


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
        >>> from zwidth.scenes.friction import friction_rule
        >>> rule = friction_rule(damping=0.033, period=350e-6, friction=0.24, resolution=15.7e-6)
        >>> print(f"{rule.by_damping:.0f} N/m, {rule.by_friction:.0f} N/m")
        189 N/m, 30573 N/m
    """
    by_friction = None if friction is None or resolution is None else 2.0 * friction / resolution
    return FrictionRule(2.0 * damping / period if damping else None, by_friction)
