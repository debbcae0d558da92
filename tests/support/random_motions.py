"""Random motions for a comparison of simulations: scenes of every kind, impacts on walls that hold them and do not.

A motion is a scene and the arguments of `integrator.integrate`; those but ``jitter_samples`` are also the arguments of
a simulation. Some are decided by rounding: `nearest_decision` says how far a motion is from that.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from any_loop import closed_loop_matrix, continuous
from independent_scenes import KINDS, random_scene, random_walls
from integrator import History, integrate

PERIODS = 200
# An impact comes within so many periods.
_LATEST = 50
_FASTEST_LINK = 3.0


class RandomMotion(NamedTuple):
    """A scene, the arguments that describe its motion, and whether its wall lies inside the stable set."""

    kind: str
    scene: Any
    arguments: dict[str, Any]
    inside: bool


def _wall(scene: Any, inside: bool, rng: np.random.Generator) -> tuple[float, float, bool]:
    """A wall that pushes back: stable if wanted and found, or one whose growth stays within float range."""
    mildest = math.inf, 0.0, 0.0
    for K, B in zip(*random_walls(scene, rng, 40), strict=True):
        if K <= 0:
            continue
        radius = float(np.abs(np.linalg.eigvals(closed_loop_matrix(scene, K, B))).max())
        mildest = min(mildest, (radius, float(K), float(B)))
        if radius < 1 if inside else 1 < radius < 1.15:
            return float(K), float(B), inside
    radius, K, B = mildest
    return K, B, radius < 1


def random_motion(kind: str, rng: np.random.Generator) -> RandomMotion:
    """One motion of a kind of scene: an impact from outside, or where there is no outside from beside."""
    dry = rng.random() < 0.7
    while True:
        scene = random_scene(kind, rng)
        matrix, external_force, _ = continuous(scene)
        fastest = float(np.abs(np.linalg.eigvals(matrix)).max()) * scene.timing.period
        if not dry or fastest < _FASTEST_LINK:
            break
    K, B, inside = _wall(scene, rng.random() < 0.5, rng)
    period, mass = scene.timing.period, 1.0 / float(external_force[external_force.size // 2])
    velocity = 10 ** rng.uniform(-2, 0)
    # The force that stops this impact, by its energy, and what its damper adds.
    peak = velocity * (math.sqrt(K * mass) + abs(B))
    coulomb = peak * 10 ** rng.uniform(-2, -0.5) if dry else 0.0
    # Viscous damping and the springs of hands as well brake the device on its way to the wall.
    ways = [0.3 * _LATEST * period * velocity, 0.3 * velocity * mass / max(scene.device.damping, 1e-9)]
    ways += [0.3 * mass * velocity**2 / (2.0 * coulomb)] if dry else []
    if scene.operator is not None:
        moved = mass + scene.operator.mass
        ways.append(0.3 * velocity * mass / max(scene.operator.damping, 1e-9))
        ways.append(0.3 * velocity * math.sqrt(moved / max(scene.operator.stiffness, 1e-9)))
    way = min(ways) * rng.uniform(0.1, 1.0)

    def now_and_then(share: float, low: float, high: float, otherwise: float) -> float:
        return 10 ** rng.uniform(low, high) if rng.random() < share else otherwise

    arguments = {
        "stiffness": K,
        "virtual_damping": B,
        "position": -way,
        "velocity": velocity,
        "external_force": peak * rng.uniform(0.0, 0.3) if rng.random() < 0.7 else 0.0,
        "contact": str(rng.choice(["bilateral", "unilateral", "push_only"])),
        "resolution": velocity * period * now_and_then(0.4, -2.0, 0.5, 0.0),
        "coulomb": coulomb,
        "static": coulomb * float(rng.choice([1.0, rng.uniform(1.0, 1.5)])),
        # Where the wall feeds the motion a limited motor bounds it, and friction is met again and again.
        "max_force": peak * now_and_then(0.2 if inside else 0.7, -0.7, 0.2, math.inf),
        "max_rate": peak / period * now_and_then(0.3, -1.5, 0.0, math.inf),
        "jitter_samples": None,
    }
    if rng.random() < 0.25:
        arguments["jitter_samples"] = np.append(0.0, rng.uniform(0.0, rng.uniform(0.0, 0.9), PERIODS))
    return RandomMotion(kind, scene, arguments, inside)


def random_motions(seed: int, count: int) -> list[RandomMotion]:
    """So many motions of every kind of scene."""
    rng = np.random.default_rng(seed)
    return [random_motion(kind, rng) for kind in KINDS for _ in range(count)]


def judge(motion: RandomMotion, **how: Any) -> History:
    """The motion, integrated; ``how`` goes to the integrator."""
    return integrate(motion.scene, periods=PERIODS, **motion.arguments, **how)


def nearest_decision(history: History) -> float:
    """The least distance of a decision from falling otherwise, each in units of the size of what it compares."""
    return float(min(history.distances.values(), default=math.inf))


def largest_difference(one: Any, other: Any) -> float:
    """Of positions and velocities at all samples, in units of the largest of each."""
    pairs = (one.position, other.position), (one.velocity, other.velocity)
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def condition(motion: RandomMotion, history: History, share: float = 1e-8, **how: Any) -> float:
    """How much a share of the start velocity grows by: motions that are limited by a motor can be chaotic."""
    arguments = motion.arguments | {"velocity": motion.arguments["velocity"] * (1.0 + share)}
    return largest_difference(judge(motion._replace(arguments=arguments), **how), history) / share
