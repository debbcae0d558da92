"""What limits the stiffest wall of a scene: how stiff it were if one thing after the other were ideal."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.parts.velocity import FOAW, BackwardDifference, VelocityFilter, WindowedDifference
from zwidth.scenes.scene import Scene
from zwidth.scenes.stiffest import stiffest_wall
from zwidth.words.errors import InputError
from zwidth.words.formatting import tell_apart
from zwidth.words.status import Status

# "Ideal" sampling is so many times faster, or as much less as keeps window and delay within what a search affords.
_FASTER = 64


class Limit(NamedTuple):
    """One thing made ideal: its name, what was changed in words, K_max then in N/m, and by what factor it grew."""

    name: str
    words: str
    stiffness: float
    gain: float


def limits_of(scene: Scene) -> list[Limit]:
    """Say what limits the stiffest wall of a scene, that of `Scene.max_stiffness`: islands do not count.

    Each thing that the scene has is made ideal by itself: the filter (the plain difference of two samples instead),
    the delay (none), the sampling (64 times faster, or less where window and delay are long; both, and the filter, the
    same in seconds) and the compliance (rigid, with the tip's mass added to the motor's).

    Args:
        scene: a scene of plain numbers.

    Returns:
        One record each, the largest gain first. What makes the wall softer is listed as well, with a gain below 1: a
        tip that is loose may help. The sampling of a filter given by its coefficients is left out, for nobody knows
        what it were at another rate. NaN where a K_max cannot be computed; those come last.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII (what damping, mass, rate and delay change of a rigid device).

    Example:
        >>> import zwidth
        >>> timing = zwidth.Timing(period=1e-3, delay=1e-3)
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), timing, velocity=zwidth.LowPass(cutoff=30))
        >>> [limit.name for limit in zwidth.limits_of(scene)]
        ['delay', 'velocity', 'period']
    """
    now = _stiffness(scene)
    found = []
    for name, words, ideal in _ideals(scene):
        stiffness = _stiffness(ideal)
        found.append(Limit(name, words, stiffness, stiffness / now))
    # NaN is larger than nothing.
    return sorted(found, key=lambda limit: (not limit.gain >= 0, -limit.gain))


def describe_islands(scene: Scene) -> list[str]:
    """A line for each island: stable walls that K_max does not count."""
    lines = []
    for island in scene.islands():
        units = {"K": (island.stiffness, "N/m"), "B": (island.virtual_damping, "N s/m")}
        ends = (f"{name} from {' to '.join(tell_apart(*ends, u))}" for name, (ends, u) in units.items())
        lines.append(
            f"an island of stable walls, {', '.join(ends)}: no stable softer walls lead to it, K_max leaves it out"
        )
    return lines


def _stiffness(scene: Scene) -> float:
    try:
        wall = stiffest_wall(scene)
    except InputError:
        # Many times faster a long delay may be more periods than the model is computed for.
        return float("nan")
    return float(wall.stiffness) if wall.status == Status.OK else float("nan")


def _ideals(scene: Scene) -> list[tuple[str, str, Scene]]:
    """The scene with one thing ideal, for each thing it has."""
    found = []
    if "velocity" in scene.parts_beyond:
        found.append(("velocity", "the velocity unfiltered", scene.replace(velocity=BackwardDifference())))
    if scene.timing.delay > 0:
        found.append(("delay", "no delay", scene.replace(delay=0.0)))
    faster = _affordable_rate(scene)
    if faster > 1:
        found.append(("period", f"sampled {faster} times faster", _sample_faster(scene, faster)))
    coupling = scene.device.coupling
    if coupling is not None:
        rigid = scene.replace(coupling=None, mass=scene.device.mass + coupling.mass)
        found.append(("coupling", "no compliance between motor and tip", rigid))
    return found


def _affordable_rate(scene: Scene) -> int:
    """How many times faster the sampling may be, 1 where nobody knows what the filter were then."""
    if isinstance(scene.velocity, VelocityFilter):
        return 1
    window = scene.velocity.samples if isinstance(scene.velocity, WindowedDifference) else 1
    return int(min(_FASTER, scene.loop.most_periods / (window + scene.d)))


def _sample_faster(scene: Scene, faster: int) -> Scene:
    """The scene at so many times the rate, filter and delay the same in seconds."""
    changes: dict[str, float] = {"period": scene.timing.period / faster}
    if isinstance(scene.velocity, WindowedDifference):
        changes["velocity.samples"] = scene.velocity.samples * faster
    if not isinstance(scene.velocity, VelocityFilter | FOAW) and scene.velocity.coded_period is not None:
        changes["velocity.coded_period"] = scene.velocity.coded_period / faster
    return scene.replace(**changes)


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
    """Up to which stiffness in N/m a wall without virtual damping and delay is passive: ``K <= min(2 b/T, 2 f_c/Q)``.

    Viscous damping b pays for sampling, Coulomb friction f_c in N for quantization in steps of Q in m. A sufficient
    condition for a spring alone, on a rigid device (Abbott, Okamura 2005, IEEE Trans. Robotics 21(5), 952-964).
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
