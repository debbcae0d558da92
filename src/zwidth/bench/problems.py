"""What is measured on: maps for the speed, walls close to the boundary for the error."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from zwidth.stability import balls
from zwidth.stability.boundary import boundary
from zwidth.stability.certified import certified_stable
from zwidth.stability.region import lobe
from zwidth.stability.ridge import alpha_max
from zwidth.status import Status

# The device of the speed problems; the cost of no method depends on it.
MAP_DELTA = 0.5
# The devices of the error problems: undamped, nearly so, common, and strongly damped.
ERROR_DELTAS = (0.0, 1e-8, 0.1, 1.0, 4.0, 50.0)
_SEED = 20060901
_ROOT_BITS, _ROOT_WIDTH = 256, 1e-40


class Walls(NamedTuple):
    """Arguments of one problem; they broadcast."""

    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray
    d: np.ndarray

    @property
    def points(self) -> int:
        """How many points there are."""
        return int(np.prod(np.broadcast_shapes(*(np.shape(part) for part in self))))

    def listed(self) -> Walls:
        """The same walls as columns of one length."""
        return Walls(*(np.ravel(part) for part in np.broadcast_arrays(*self)))


class Labelled(NamedTuple):
    """Walls with certified labels and their relative distance in alpha from the boundary."""

    walls: Walls
    stable: np.ndarray
    distance: np.ndarray


def grid(d: float, points: int) -> Walls:
    """A map of about ``points`` walls that covers the stable region of one device and some of what is beyond."""
    side = max(2, round(points**0.5))
    _, _, beta = lobe(MAP_DELTA, d)
    ridge = float(alpha_max(MAP_DELTA, d).alpha)
    low, high = float(np.min(beta)), float(np.max(beta))
    margin = 0.05 * (high - low)
    return Walls(
        np.linspace(0.0, 1.2 * ridge, side)[None, :],
        np.linspace(low - margin, high + margin, side)[:, None],
        np.full((1, 1), MAP_DELTA),
        np.full((1, 1), float(d)),
    )


def scattered(d: float, points: int) -> Walls:
    """As many random walls of the same region, each of a device of its own."""
    box = grid(d, 4)
    generator = np.random.default_rng(_SEED)
    alpha = generator.uniform(box.alpha.min(), box.alpha.max(), points)
    beta = generator.uniform(box.beta.min(), box.beta.max(), points)
    delta = MAP_DELTA * generator.uniform(0.5, 1.5, points)
    return Walls(alpha, beta, delta, np.full(points, float(d)))


@cache
def near_boundary(d: float, points: int) -> Labelled:
    """Walls 1e-3 to 1e-15 (relative, in alpha) off the boundary of many devices, with labels from ball arithmetic.

    A wall whose label cannot be proved, being exactly on the boundary, is left out.
    """
    generator = np.random.default_rng([_SEED, round(1e6 * d)])
    each = max(1, points // len(ERROR_DELTAS))
    alphas, betas, deltas, distances = [], [], [], []
    for delta in ERROR_DELTAS:
        omega_max = float(lobe(delta, d, points=16)[0][-1])
        omega = generator.uniform(0.02, 0.995, each) * omega_max
        curve = boundary(omega, delta, d)
        offset = 10.0 ** generator.uniform(-15.0, -3.0, each) * generator.choice([-1.0, 1.0], each)
        alphas.append(np.asarray(curve.alpha) * (1.0 + offset))
        betas.append(np.asarray(curve.beta))
        deltas.append(np.full(each, delta))
        distances.append(np.abs(offset))
    alpha, beta, delta, distance = (np.concatenate(part) for part in (alphas, betas, deltas, distances))
    walls = Walls(alpha, beta, delta, np.full(alpha.size, float(d)))
    truth = certified_stable(*walls)
    known = np.asarray(truth.status) == Status.OK
    kept = Walls(*(np.asarray(part)[known] for part in walls))
    return Labelled(kept, np.asarray(truth.stable)[known], distance[known])


@cache
def with_radius(d: float, points: int) -> tuple[Walls, np.ndarray]:
    """Walls near the boundary and all over the map, with spectral radii enclosed by ball arithmetic."""
    near = near_boundary(d, 20 * len(ERROR_DELTAS)).walls
    some = np.random.default_rng(_SEED).permutation(near.points)[: points // 2]
    walls = [
        np.concatenate(pair) for pair in zip((part[some] for part in near), scattered(d, points // 2), strict=True)
    ]
    radius = np.array([exact_radius(*map(float, wall)) for wall in zip(*walls, strict=True)])
    return Walls(*walls), radius


def exact_radius(alpha: float, beta: float, delta: float, d: float) -> float:
    """The largest of all isolated poles: an enclosure far narrower than a rounding error."""
    import flint

    with flint.ctx.workprec(_ROOT_BITS):
        coefficients = balls.polynomial(alpha, beta, delta, d, _ROOT_BITS)
        roots = flint.acb_poly([flint.acb(value) for value in coefficients]).roots(tol=_ROOT_WIDTH)
        return max(float(abs(root).mid()) for root in roots)
