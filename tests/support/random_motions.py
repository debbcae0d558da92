"""Random responses for comparisons of simulations: scenes of every kind, impacts on stable and unstable walls.

A response is given by a scene and the arguments of `integrator.integrate`; those except ``jitter_samples`` are
also arguments of a simulation. Some responses depend on rounding errors: `nearest_decision` returns the
distance from that.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from any_loop import closed_loop_matrix, continuous
from independent_scenes import KINDS, random_scene, random_walls
from integrator import History, integrate

PERIODS = 200
_LATEST = 50  # periods within which the impact occurs
_FASTEST_LINK = 3.0  # largest natural frequency with dry friction, in rad per sample


class RandomMotion(NamedTuple):
    """A scene, the arguments of its simulation, and whether its wall is stable."""

    kind: str
    scene: Any
    arguments: dict[str, Any]
    inside: bool


def _wall(scene: Any, inside: bool, rng: np.random.Generator) -> tuple[float, float, bool]:
    """Return K > 0, B and stability of a random wall: as wanted if found; unstable ones grow without overflow."""
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
    """Return a random response of a kind of scene: an impact, from outside of the wall if possible."""
    has_friction = rng.random() < 0.7
    while True:
        scene = random_scene(kind, rng)
        matrix, external_force, _ = continuous(scene)
        fastest = float(np.abs(np.linalg.eigvals(matrix)).max()) * scene.timing.period
        if not has_friction or fastest < _FASTEST_LINK:
            break
    K, B, inside = _wall(scene, rng.random() < 0.5, rng)
    period, mass = scene.timing.period, 1.0 / float(external_force[external_force.size // 2])
    velocity = 10 ** rng.uniform(-2, 0)
    # The force that stops this impact by its energy, plus that of the damper.
    peak = velocity * (math.sqrt(K * mass) + abs(B))
    coulomb = peak * 10 ** rng.uniform(-2, -0.5) if has_friction else 0.0
    # Viscous damping and the operator's spring also decelerate the device on its way to the wall.
    distances = [0.3 * _LATEST * period * velocity, 0.3 * velocity * mass / max(scene.device.damping, 1e-9)]
    distances += [0.3 * mass * velocity**2 / (2.0 * coulomb)] if has_friction else []
    if scene.operator is not None:
        total_mass = mass + scene.operator.mass
        distances.append(0.3 * velocity * mass / max(scene.operator.damping, 1e-9))
        distances.append(0.3 * velocity * math.sqrt(total_mass / max(scene.operator.stiffness, 1e-9)))
    distance = min(distances) * rng.uniform(0.1, 1.0)

    def draw_sometimes(probability: float, low: float, high: float, otherwise: float) -> float:
        return 10 ** rng.uniform(low, high) if rng.random() < probability else otherwise

    arguments = {
        "stiffness": K,
        "virtual_damping": B,
        "position": -distance,
        "velocity": velocity,
        "external_force": peak * rng.uniform(0.0, 0.3) if rng.random() < 0.7 else 0.0,
        "contact": str(rng.choice(["bilateral", "unilateral", "push_only"])),
        "resolution": velocity * period * draw_sometimes(0.4, -2.0, 0.5, 0.0),
        "coulomb": coulomb,
        "static": coulomb * float(rng.choice([1.0, rng.uniform(1.0, 1.5)])),
        # On an unstable wall a force limit bounds the response, and friction acts repeatedly.
        "max_force": peak * draw_sometimes(0.2 if inside else 0.7, -0.7, 0.2, math.inf),
        "max_rate": peak / period * draw_sometimes(0.3, -1.5, 0.0, math.inf),
        "jitter_samples": None,
    }
    if rng.random() < 0.25:
        arguments["jitter_samples"] = np.append(0.0, rng.uniform(0.0, rng.uniform(0.0, 0.9), PERIODS))
    return RandomMotion(kind, scene, arguments, inside)


def random_motions(seed: int, count: int) -> list[RandomMotion]:
    """Return ``count`` random responses per kind of scene."""
    rng = np.random.default_rng(seed)
    return [random_motion(kind, rng) for kind in KINDS for _ in range(count)]


def judge(motion: RandomMotion, **how: Any) -> History:
    """Integrate a response; ``how`` is passed to the integrator."""
    return integrate(motion.scene, periods=PERIODS, **motion.arguments, **how)


def nearest_decision(history: History) -> float:
    """Return the smallest distance of a decision from its threshold, relative to the size of the compared values."""
    return float(min(history.distances.values(), default=math.inf))


def largest_difference(one: Any, other: Any) -> float:
    """Return the largest difference of positions and velocities at the samples, relative to the largest of each."""
    pairs = (one.position, other.position), (one.velocity, other.velocity)
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def condition(motion: RandomMotion, history: History, step: float = 1e-8, **how: Any) -> float:
    """Return the amplification of a relative change of the initial velocity; saturated responses can be chaotic."""
    arguments = motion.arguments | {"velocity": motion.arguments["velocity"] * (1.0 + step)}
    return largest_difference(judge(motion._replace(arguments=arguments), **how), history) / step
