"""Consistency of the functions of a wall over the whole domain and at its extremes.

The functions are independent: the verdict uses the phase at the gain crossover, the radius Newton steps and two
counts, the limits the monotone functions of the lobe, passivity a frequency condition, settling times modes. If
two of them disagree, the certified verdict in ball arithmetic determines which one is wrong.

As a program, ``python tests/properties/test_consistency.py COUNT SEED`` prints the number of contradictions.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import pytest
from bounds import bound_radius

import zwidth
from zwidth.core.status import Status
from zwidth.stability.rigid.normalization import wall_status
from zwidth.stability.rigid.step_response import settling_time

BLOCK = 2000  # walls per batch; few enough for NumPy, so that nothing is compiled
ULP = 2.0**-52
ROUNDING = 1e-13  # error of limits relative to their condition, within which two functions may disagree
DELTAS = [0.0, 1e-300, 1e-30, 1e-16, 1e-8, 1e-3, 1.0, 3.65936162742, 40.0, 750.0, 1e6, 1e12]
DELAYS = [0.0, 5e-324, 1e-300, 1e-16, 0.25, 0.5, 1 - ULP / 2, 1.0, 1 + ULP, 2.0, 3 - 2 * ULP, 8.0, 64.5, 500.0]
DELAYS += [1e4 + 0.3, 99999.5, 1e5 - 1e-10, 1e5]
ALPHAS = [0.0, 1e-60, 1e-30, 1e-17, 1e-13, 1e-8, 0.1, 1e3, 1e30, 1e60]


class Walls(NamedTuple):
    """Walls and their devices, arrays of one length."""

    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray
    d: np.ndarray

    def select(self, chosen) -> Walls:
        return Walls(*(column[chosen] for column in self))


def draw(count: int, random: np.random.Generator) -> Walls:
    """Return random walls, half of them over the whole domain, half at its extremes in each of the four parameters."""
    wide, corner = random.random((2, count)) < 0.5

    def power(low, high):
        return 10.0 ** random.uniform(low, high, count)

    delta = np.where(wide, np.where(random.random(count) < 0.1, 0.0, power(-9, 6)), random.choice(DELTAS, count))
    integer = np.floor(power(0, 2.5) - 1.0)
    any_delay = np.where(random.random(count) < 0.5, integer, np.minimum(power(-4, 5), 1e5))
    d = np.where(random.random(count) < 0.5, any_delay, random.choice(DELAYS, count))
    ridge = zwidth.alpha_max(delta, d)
    # Stiffness below and above the maximum, or at an extreme of the range.
    alpha = ridge.alpha * np.where(random.random(count) < 0.5, random.uniform(0, 1.3, count), power(-8, 0.3))
    alpha = np.where(corner & (random.random(count) < 0.4), random.choice(ALPHAS, count), alpha)
    alpha = np.where(random.random(count) < 0.03, -alpha, alpha)
    beta = draw_damping(alpha, delta, d, ridge, random)
    rows = random.random(count) < 0.15
    limit = zwidth.boundary_point(delta, d, beta=beta).alpha
    alpha = np.where(rows & (limit > 0), perturb(limit, random), alpha)
    walls = Walls(clip_magnitude(alpha, 1e60), clip_magnitude(beta, 1e60), delta, d)
    assert np.all(wall_status(*walls) == Status.OK)
    return walls


def draw_damping(alpha, delta, d, ridge, random):
    """Return damping across and outside of the stable interval at each alpha, near its ends, and at extremes."""
    count = alpha.size
    stable_alpha = np.minimum(np.abs(alpha), 0.999 * ridge.alpha)
    stable_alpha = np.where(stable_alpha > 0, np.maximum(stable_alpha, 1e-60), 0.5 * ridge.alpha)
    low, high = (zwidth.boundary_point(delta, d, alpha=stable_alpha, side=side).beta for side in ("lower", "upper"))
    width = np.where(np.isfinite(high - low), high - low, 1.0)
    low = np.where(np.isfinite(low), low, -delta)
    across = low + width * random.uniform(-0.4, 1.4, count)
    ulps = -delta * (1.0 + random.integers(-4, 5, count) * ULP)
    near_start = -delta + width * 10.0 ** random.uniform(-17, 0, count)
    choices = [
        across,
        across,
        near_start,
        ulps,
        perturb(low, random),
        perturb(low + width, random),
        ridge.beta,
        np.zeros(count),
        random.choice([-1.0, 1.0], count) * 10.0 ** random.uniform(-60, 60, count),
    ]
    return np.choose(random.integers(0, len(choices), count), choices)


def perturb(value, random):
    """Return values within a relative distance of 1e-12, half of them within a few units in the last place."""
    close = random.integers(-3, 4, value.size) * ULP
    return value * (1.0 + np.where(random.random(value.size) < 0.5, close, random.uniform(-1e-12, 1e-12, value.size)))


def clip_magnitude(value, largest):
    size = np.abs(value)
    return np.where(size < 0.5e-60, 0.0, np.sign(value) * np.clip(size, 1e-60, largest))


class Facts(NamedTuple):
    """Results of the functions for the same walls."""

    walls: Walls
    stable: np.ndarray
    proved: np.ndarray  # the certified verdict, if decided
    decided: np.ndarray  # whether the certified verdict is decided
    row: zwidth.BoundaryPoint
    lower: zwidth.BoundaryPoint
    upper: zwidth.BoundaryPoint
    ridge: zwidth.RidgePoint
    margins: zwidth.Margins
    rate: np.ndarray
    radius: np.ndarray
    error: np.ndarray
    passive: np.ndarray
    excess: np.ndarray


def evaluate_all(walls: Walls) -> Facts:
    """Evaluate every function at every wall."""
    alpha, beta, delta, d = walls
    certified = zwidth.decide_stability(*walls, method="certified")
    bounded = bound_radius(*walls)
    column = np.where(alpha > 0, alpha, np.nan)
    return Facts(
        walls,
        zwidth.is_stable(*walls),
        certified.stable,
        np.isin(certified.status, [Status.OK, Status.ON_BOUNDARY]),
        zwidth.boundary_point(delta, d, beta=beta),
        zwidth.boundary_point(delta, d, alpha=column, side="lower"),
        zwidth.boundary_point(delta, d, alpha=column, side="upper"),
        zwidth.alpha_max(delta, d),
        zwidth.margins(*walls),
        zwidth.decay_rate(*walls),
        bounded.radius,
        bounded.error,
        zwidth.is_passive(*walls),
        zwidth.passivity_margin(*walls),
    )


def contradictions(f: Facts) -> dict[str, np.ndarray]:
    """Return each statement that must hold for all walls, with a mask of its violations."""
    alpha, beta = f.walls.alpha, f.walls.beta
    spring = alpha > 0
    stable, m = f.stable, f.margins
    rows, columns = f.row.status == Status.OK, f.lower.status == Status.OK
    inside = (beta > f.lower.beta) & (beta < f.upper.beta)
    return {
        "the certified verdict is known": ~f.decided,
        "the certified verdict is the verdict": f.decided & (f.proved != stable),
        "stable walls are springs": stable & ~spring,
        "the radius is below 1 for stable walls": stable & (f.radius >= 1.0),
        "the radius of other walls is not": ~stable & (f.radius < 1.0),
        "the decay rate has the sign of the verdict": ~np.isnan(f.rate) & ((f.rate > 0) != stable),
        "the decay rate is the radius": np.abs(np.exp(-f.rate) - f.radius) > 1e-9 * f.radius + f.error,
        "the phase margin has the sign of the verdict": spring & ((m.phase_margin > 0) & (beta > -f.walls.delta))
        != stable,
        "the gain margin is above 1 for stable walls": spring & ((m.gain_margin > 1) != stable),
        "stable walls bear more delay": spring & ((m.delay_margin > 0) != stable),
        "the modulus margin is at most 1 for stable walls": stable
        & ~((m.modulus_margin > 0) & (m.modulus_margin <= 1)),
        "a row ends beyond its stable walls": stable & ~(rows & (f.row.alpha > alpha)),
        "a row ends before its other walls": spring & ~stable & rows & (f.row.alpha > alpha),
        # Points within rounding errors of the ridge may be undecided.
        "rows are OK or empty": ~np.isin(f.row.status, (Status.OK, Status.NO_BOUNDARY)),
        "a column holds its stable walls": stable & ~(columns & inside),
        "a column holds no other walls": spring & ~stable & columns & inside,
        "both ends of a column exist": spring & (f.lower.status != f.upper.status),
        "columns are in order": columns & ~(f.lower.beta <= f.upper.beta),
        "no row is longer than the stiffest wall": rows & ~(f.row.alpha <= f.ridge.alpha * (1 + 20 * ULP)),
        "no stable wall is stiffer than the stiffest": stable & ~(alpha < f.ridge.alpha * (1 + 20 * ULP)),
        "every device has a stiffest wall": (f.ridge.status != Status.OK) | ~(f.ridge.alpha > 0),
        "passive springs are stable": f.passive & spring & ~stable,
        "passive walls have an excess": f.passive != (f.excess > 0),
    }


def is_near_boundary(walls: Walls) -> np.ndarray:
    """Return whether the certified verdict changes within rounding errors of the wall, in stiffness or damping."""
    alpha, beta, delta, d = walls
    # b = beta + delta is accurate to some rounding errors of its terms.
    shift = 64 * ULP * (np.abs(beta) + delta)
    labels = [
        zwidth.is_stable(
            clip_magnitude(alpha * (1 + a), 1e60), clip_magnitude(beta + b * shift, 1e60), delta, d, method="certified"
        )
        for a in (-ROUNDING, ROUNDING)
        for b in (-1.0, 1.0)
    ]
    return np.any(np.stack(labels) != labels[0], axis=0)


# Statements about single functions, which hold at any distance from the boundary.
ALWAYS = (
    "the certified verdict is known",
    "stable walls are springs",
    "the decay rate has the sign of the verdict",
    "the gain margin is above 1 for stable walls",
    "stable walls bear more delay",
    "rows are OK or empty",
    "every device has a stiffest wall",
    "no row is longer than the stiffest wall",
    "passive walls have an excess",
)


def find_contradictions(count: int, seed: int) -> dict[str, list[tuple]]:
    """Return the contradictions by statement, without those that rounding errors explain."""
    random = np.random.default_rng(seed)
    contradictions_found: dict[str, list[tuple]] = {}
    for start in range(0, count, BLOCK):
        facts = evaluate_all(draw(min(BLOCK, count - start), random))
        for statement, mask in contradictions(facts).items():
            bad = np.flatnonzero(mask)
            if bad.size and statement not in ALWAYS:
                bad = bad[~is_near_boundary(facts.walls.select(bad))]
            if bad.size:
                contradictions_found.setdefault(statement, []).extend(
                    zip(*(part.tolist() for part in facts.walls.select(bad)), strict=True)
                )
    return contradictions_found


def test_functions_are_consistent():
    assert find_contradictions(2000, 20) == {}


# Regression: found among 10^5 walls. Each is certified unstable; the first two lines are unbounded.
FORMERLY_WRONG = [
    # Lines far above the lobe, where the curve returns from infinity.
    (2.335447764326184e-07, 3.692815079655784e38, 0.0, 1 - ULP / 2),
    (325966003164.7999, 2.354637921449004e41, 1e12, 0.5),
    # Crossovers at a phase beyond a quarter turn, together with walls of a fractional delay.
    (1000.0, 1.179223312502481e49, 1e-300, 1.0),
    (0.0003979204995852754, 32868943419.924587, 1e-16, 3.0),
    (1e-13, 1.2276672712930513e19, 0.0, 2.0),
    # Lines near the end of the lobe with a long delay; their limits were 0.3 and 1.2 % too large.
    (2.674211185961894e-09, 3.6593616254797103, 3.65936162742, 1e5),
    (1000.0, 999999999116.872, 1e12, 99999.5),
]


def test_walls_formerly_labeled_stable_are_unstable():
    fraction = (0.1, 0.4, 0.1, 1.5)
    walls = Walls(*np.array([*FORMERLY_WRONG, fraction]).T)
    assert zwidth.is_stable(*walls).tolist() == [False] * len(FORMERLY_WRONG) + [True]
    assert zwidth.is_stable(*walls, method="certified").tolist() == [False] * len(FORMERLY_WRONG) + [True]
    row = zwidth.boundary_point(walls.delta, walls.d, beta=walls.beta)
    assert not np.any(row.alpha[:-1] > walls.alpha[:-1])


def test_lines_of_constant_beta_and_alpha_agree_near_the_end_of_the_lobe():
    random = np.random.default_rng(5)
    count = 2000
    d = np.minimum(np.where(random.random(count) < 0.5, 1e5, 10 ** random.uniform(0, 5, count)), 1e5)
    delta = np.where(random.random(count) < 0.1, 0.0, 10 ** random.uniform(-9, 12, count))
    end = zwidth.boundary_point(delta, d, alpha=np.full(count, 1e-60), side="upper").beta
    beta = end - (end + delta) * 10 ** random.uniform(-12, -2, count)
    alpha = zwidth.boundary_point(delta, d, beta=beta).alpha
    exists = alpha > 0
    assert exists.mean() > 0.9
    again = zwidth.boundary_point(delta[exists], d[exists], alpha=alpha[exists], side="upper").beta
    assert np.max(np.abs(again - beta[exists]) / (np.abs(beta) + delta)[exists]) < 32 * ULP


@pytest.mark.parametrize("delta", [1e-300, 1e-100, 1e-20])
def test_gain_margin_is_continuous_at_zero_damping(delta):
    walls = (0.13548921166348554, 0.47387196928852116), (1.7032855202028993e-09, 0.013311947546541589)
    for (alpha, beta), d in zip(walls, (1.0, 117.0), strict=True):
        undamped = zwidth.margins(alpha, beta, 0.0, d).gain_margin
        assert zwidth.margins(alpha, beta, delta, d).gain_margin == pytest.approx(undamped, rel=1e-12)


def test_only_stable_walls_have_a_settling_time():
    random = np.random.default_rng(22)
    walls = draw(600, random)
    # Exclude slow loops, because the search for the settling time runs backwards period by period.
    is_fast = np.abs(zwidth.decay_rate(*walls)) >= 1e-2
    walls = walls.select((walls.d <= 40) & (walls.alpha != 0) & is_fast)
    stable = zwidth.is_stable(*walls)
    times = np.array([settling_time(*(float(value) for value in wall)) for wall in zip(*walls, strict=True)])
    assert np.all(np.isnan(times) | (stable & np.isfinite(times) & (times >= 0)))
    assert np.mean(np.isfinite(times[stable])) > 0.5


def main(count: str, seed: str) -> None:
    """Print the contradictions among ``count`` random walls."""
    contradictions_found = find_contradictions(int(count), int(seed))
    for statement, walls in contradictions_found.items():
        print(f"{statement}: violated by {len(walls)}")
        print(*walls[:10], sep="\n")
    print(f"{sum(map(len, contradictions_found.values()))} contradictions among {count} walls, seed {seed}")


if __name__ == "__main__":
    main(*sys.argv[1:])
