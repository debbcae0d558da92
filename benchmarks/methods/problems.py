"""Problems of the benchmarks: maps for the speed, walls near the boundary for the error."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.status import Status
from zwidth.stability.rigid import certified
from zwidth.stability.rigid.boundary import boundary, sample_lobe
from zwidth.stability.rigid.dominant.arrays import compute_dominant_poles
from zwidth.stability.rigid.ridge import alpha_max
from zwidth.stability.rigid.verdict import decide_stability

# Device of the speed problems; no method's cost depends on it.
MAP_DELTA = 0.5
# Devices of the error problems: undamped, nearly undamped, common and strongly damped.
ERROR_DELTAS = (0.0, 1e-8, 0.1, 1.0, 4.0, 50.0)
_SEED = 20060901
_ROOT_BITS, _ROOT_WIDTH = 256, 1e-40
# For higher degrees, isolating all roots takes minutes.
_MOST_ROOTS = 60
_DIGITS = 40
# Scanned frequencies per period of the fastest oscillation, before the maximum is refined.
_PER_PERIOD = 64


class Walls(NamedTuple):
    """Arguments of one problem, which broadcast."""

    alpha: Any
    beta: Any
    delta: Any
    d: Any

    @property
    def points(self) -> int:
        """Number of points."""
        return int(np.prod(np.broadcast_shapes(*(np.shape(part) for part in self))))

    def listed(self) -> Walls:
        """Return the same walls as arrays of equal length."""
        return Walls(*(np.ravel(part) for part in np.broadcast_arrays(*self)))


class Labelled(NamedTuple):
    """Walls with certified stability results and their relative distance in alpha from the boundary."""

    walls: Walls
    stable: np.ndarray
    distance: np.ndarray


def grid(d: float, points: int) -> Walls:
    """Return a map of about ``points`` walls that covers the stable region of one device and its surroundings."""
    side = max(2, round(points**0.5))
    _, _, beta = sample_lobe(MAP_DELTA, d)
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
    """Return random walls of the same region, each with a different device."""
    box = grid(d, 4)
    generator = np.random.default_rng(_SEED)
    alpha = generator.uniform(box.alpha.min(), box.alpha.max(), points)
    beta = generator.uniform(box.beta.min(), box.beta.max(), points)
    delta = MAP_DELTA * generator.uniform(0.5, 1.5, points)
    return Walls(alpha, beta, delta, np.full(points, float(d)))


def single(d: float, points: int = 1) -> Walls:
    """Return one of these walls as numbers."""
    return Walls(*(column[0].item() for column in scattered(d, points)))


@cache
def near_boundary(d: float, points: int) -> Labelled:
    """Return walls at relative distances in alpha of 1e-3 to 1e-15 from boundaries, with labels from ball arithmetic.

    Walls exactly on the boundary, whose labels cannot be proved, are omitted.
    """
    generator = np.random.default_rng([_SEED, round(1e6 * d)])
    each = max(1, points // len(ERROR_DELTAS))
    alphas, betas, deltas, distances = [], [], [], []
    for delta in ERROR_DELTAS:
        omega_max = float(sample_lobe(delta, d, points=16)[0][-1])
        omega = generator.uniform(0.02, 0.995, each) * omega_max
        curve = boundary(omega, delta, d)
        offset = 10.0 ** generator.uniform(-15.0, -3.0, each) * generator.choice([-1.0, 1.0], each)
        alphas.append(np.asarray(curve.alpha) * (1.0 + offset))
        betas.append(np.asarray(curve.beta))
        deltas.append(np.full(each, delta))
        distances.append(np.abs(offset))
    alpha, beta, delta, distance = (np.concatenate(part) for part in (alphas, betas, deltas, distances))
    walls = Walls(alpha, beta, delta, np.full(alpha.size, float(d)))
    truth = decide_stability(*walls, method="certified")
    known = np.asarray(truth.status) == Status.OK
    kept = Walls(*(np.asarray(part)[known] for part in walls))
    return Labelled(kept, np.asarray(truth.stable)[known], distance[known])


@cache
def with_radius(d: float, points: int) -> tuple[Walls, np.ndarray]:
    """Return walls near the boundary and across the map, with spectral radii in extended precision."""
    near = near_boundary(d, 20 * len(ERROR_DELTAS)).walls
    some = np.random.default_rng(_SEED).permutation(near.points)[: points // 2]
    walls = [
        np.concatenate(pair) for pair in zip((part[some] for part in near), scattered(d, points // 2), strict=True)
    ]
    exact = exact_radius if d <= _MOST_ROOTS else refined_radius
    radius = np.array([exact(*map(float, wall)) for wall in zip(*walls, strict=True)])
    return Walls(*walls), radius


def ball_polynomial(alpha: float, beta: float, delta: float, d: float, bits: int) -> list[Any]:
    """Return the coefficients of P as balls, lowest power first."""
    import flint

    with flint.ctx.workprec(bits):
        here = certified.device(delta, d, bits)
        n = [a for a in (here.a0, here.a1, here.a2) if a is not None]
        stiffness, damping = flint.arb(alpha), flint.arb(beta)
        s = stiffness + damping
        wall = [-n[0] * damping, *(left * s - right * damping for left, right in pairwise(n)), n[-1] * s]
        p = [*wall, *[flint.arb(0)] * (int(d) + 1)]
        for index, value in enumerate((here.c, -(1 + here.c), flint.arb(1)), len(p) - 3):
            p[index] += value
        return p


def exact_radius(alpha: float, beta: float, delta: float, d: float) -> float:
    """Return the spectral radius from isolated poles, with an enclosure far narrower than a rounding error."""
    import flint

    with flint.ctx.workprec(_ROOT_BITS):
        coefficients = ball_polynomial(alpha, beta, delta, d, _ROOT_BITS)
        roots = flint.acb_poly([flint.acb(value) for value in coefficients]).roots(tol=_ROOT_WIDTH)
        return max(float(abs(root).mid()) for root in roots)


def refined_radius(alpha: float, beta: float, delta: float, d: float) -> float:
    """Return the spectral radius for long delays by Newton's method, from the pole that float64 proves dominant.

    Raises:
        ArithmeticError: there is no proof, or Newton's method diverges from the pole.
    """
    import flint

    pole = compute_dominant_poles([np.array([value]) for value in (alpha, beta, delta, d)], 1e-9)
    if not pole.error[0] <= 1e-9:
        raise ArithmeticError(f"no proof of the dominant pole at {(alpha, beta, delta, d)}")
    with flint.ctx.workprec(_ROOT_BITS):
        coefficients = ball_polynomial(alpha, beta, delta, d, _ROOT_BITS)
        terms = [(k, value.mid()) for k, value in enumerate(coefficients) if value != 0]
        start = z = flint.acb(float(pole.re[0]), float(pole.im[0])).exp()
        step = z
        for _ in range(8):
            value = sum((a * z**k for k, a in terms), flint.acb(0))
            slope = sum((k * a * z ** (k - 1) for k, a in terms if k), flint.acb(0))
            step = (value / slope).mid()
            z = (z - step).mid()
        if not (abs(step) < _ROOT_WIDTH and abs(z - start) < 1e-8):
            raise ArithmeticError(f"Newton's method left the dominant pole at {(alpha, beta, delta, d)}")
        return float(abs(z).mid())


@cache
def with_needed_damping(d: float, points: int) -> tuple[Walls, np.ndarray]:
    """Return undamped walls and the damping that makes each of them passive."""
    walls = scattered(d, points)._replace(delta=np.zeros(points))
    needed = [exact_needed_damping(float(a), float(b), int(d)) for a, b in zip(walls.alpha, walls.beta, strict=True)]
    return walls, np.array(needed)


def exact_needed_damping(alpha: float, beta: float, d: int) -> float:
    """Return the supremum of ``alpha D/2 - beta cos((d + 1) w)``, ``D = sin((d + 1/2) w)/sin(w/2)``, for integer d.

    Every local maximum of a dense scan that is close to the largest is refined in extended precision.
    """
    from mpmath import mp

    count = _PER_PERIOD * (d + 1)
    w = np.linspace(0.0, np.pi, count + 1)[1:]
    value = alpha * np.sin((d + 0.5) * w) / (2.0 * np.sin(w / 2.0)) - beta * np.cos((d + 1) * w)
    with mp.workdps(_DIGITS):
        a, b = mp.mpf(alpha), mp.mpf(beta)

        def bound(w: Any) -> Any:
            return a * mp.sin((d + 0.5) * w) / (2 * mp.sin(w / 2)) - b * mp.cos((d + 1) * w)

        best = max(a * (d + mp.mpf("0.5")) - b, bound(mp.pi))
        # Between two samples, a maximum exceeds both by less than 1 % of the bound's magnitude.
        near = value > value.max() - 0.01 * (abs(alpha) * (d + 1) + abs(beta))
        tops = np.flatnonzero(near[1:-1] & (value[1:-1] >= value[:-2]) & (value[1:-1] >= value[2:])) + 1
        for top in tops:
            best = max(best, _highest(bound, mp.mpf(w[top - 1]), mp.mpf(w[top + 1])))
        return float(best)


def _highest(bound: Any, low: Any, high: Any) -> Any:
    """Return the maximum in a bracket by golden-section search; half the digits of its location suffice."""
    from mpmath import mp

    ratio = (mp.sqrt(5) - 1) / 2
    first, second = high - ratio * (high - low), low + ratio * (high - low)
    left, right = bound(first), bound(second)
    for _ in range(60):
        if left > right:
            high, second, right = second, first, left
            first = high - ratio * (high - low)
            left = bound(first)
        else:
            low, first, left = first, second, right
            second = low + ratio * (high - low)
            right = bound(second)
    return max(left, right)
