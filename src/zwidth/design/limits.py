"""What limits the stiffest wall of a scene: how stiff it were if one thing after the other were ideal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

from zwidth.errors import InputError
from zwidth.linear.stiffest import stiffest_wall
from zwidth.parts.velocity import BackwardDifference, VelocityFilter, WindowedDifference
from zwidth.scene import Scene
from zwidth.status import Status

# "Ideal" sampling is so many times faster; a window may hold no more samples than these.
_FASTER, _LONGEST_WINDOW = 64, 1000
# The delay in periods up to which the boundary of a scene with parts is laid out within a second.
_LONGEST_DELAY = 100


class Limit(NamedTuple):
    """One thing made ideal: its name, what was changed in words, K_max then in N/m, and by what factor it grew."""

    name: str
    words: str
    stiffness: float
    gain: float


def limits_of(scene: Scene) -> list[Limit]:
    """Say what limits the stiffest wall of a scene.

    Each thing that the scene has is made ideal by itself: the filter (the plain difference of two samples instead),
    the delay (none), the sampling (64 times faster, filter and delay the same in seconds) and the compliance (rigid,
    with the tip's mass added to the motor's).

    Args:
        scene: a scene of plain numbers.

    Returns:
        One record each, the largest gain first. What makes the wall softer is listed as well, with a gain below 1: a
        tip that is loose may help. The sampling of a filter given by its coefficients is left out, for nobody knows
        what it were at another rate; with parts and a delay of several periods it is made less than 64 times as fast.
        NaN where a K_max cannot be computed; those come last.

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
    plain = isinstance(scene.velocity, BackwardDifference) and scene.velocity.coded_period is None
    if not plain:
        found.append(("velocity", "the velocity unfiltered", scene.replace(velocity=BackwardDifference())))
    if scene.timing.delay > 0:
        found.append(("delay", "no delay", scene.replace(delay=0.0)))
    if not isinstance(scene.velocity, VelocityFilter):
        faster = _FASTER if scene.is_rigid else min(_FASTER, int(_LONGEST_DELAY / max(scene.d, 1.0)))
        if faster > 1:
            found.append(_sampled_faster(scene, faster))
    coupling = scene.device.coupling
    if coupling is not None:
        rigid = scene.replace(coupling=None, mass=scene.device.mass + coupling.mass)
        found.append(("coupling", "no compliance between motor and tip", rigid))
    return found


def _sampled_faster(scene: Scene, faster: int) -> tuple[str, str, Scene]:
    velocity: Any = scene.velocity
    if isinstance(velocity, WindowedDifference):
        faster = min(faster, _LONGEST_WINDOW // velocity.samples)
        velocity = replace(velocity, samples=velocity.samples * faster)
    if velocity.coded_period is not None:
        velocity = replace(velocity, coded_period=velocity.coded_period / faster)
    ideal = scene.replace(velocity=velocity, period=scene.timing.period / faster)
    return "period", f"sampled {faster} times faster", ideal
