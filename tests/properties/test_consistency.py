"""What different functions say of one wall agrees, over the whole domain and in its corners.

Every function here answers by itself: the verdict by the phase at the gain crossover, the radius by Newton steps and
two counts, the limits by the lobe's monotone functions, passivity by a frequency condition, settling by modes. Where
two of them say different things of a wall, the certified verdict, proved in balls, tells which of them is wrong.

As a program: ``python tests/properties/test_consistency.py COUNT SEED`` prints how many contradictions it finds.
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

# Walls that are judged at one time: few enough for NumPy, so that nothing is compiled.
BLOCK = 2000
ULP = 2.0**-52
# Every limit is right to about this, times its condition: so close to it two functions may round to different sides.
ROUNDING = 1e-13
DELTAS = [0.0, 1e-300, 1e-30, 1e-16, 1e-8, 1e-3, 1.0, 3.65936162742, 40.0, 750.0, 1e6, 1e12]
DELAYS = [0.0, 5e-324, 1e-300, 1e-16, 0.25, 0.5, 1 - ULP / 2, 1.0, 1 + ULP, 2.0, 3 - 2 * ULP, 8.0, 64.5, 500.0]
DELAYS += [1e4 + 0.3, 99999.5, 1e5 - 1e-10, 1e5]
ALPHAS = [0.0, 1e-60, 1e-30, 1e-17, 1e-13, 1e-8, 0.1, 1e3, 1e30, 1e60]


class Walls(NamedTuple):
    """Walls on their devices, arrays of one length."""

    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray
    d: np.ndarray

    def select(self, chosen) -> Walls:
        return Walls(*(column[chosen] for column in self))


def draw(count: int, random: np.random.Generator) -> Walls:
    """Half of them all over the domain, half of them in its corners, for each of the four numbers by itself."""
    wide, corner = random.random((2, count)) < 0.5

    def power(low, high):
        return 10.0 ** random.uniform(low, high, count)

    delta = np.where(wide, np.where(random.random(count) < 0.1, 0.0, power(-9, 6)), random.choice(DELTAS, count))
    whole = np.floor(power(0, 2.5) - 1.0)
    anywhere = np.where(random.random(count) < 0.5, whole, np.minimum(power(-4, 5), 1e5))
    d = np.where(random.random(count) < 0.5, anywhere, random.choice(DELAYS, count))
    ridge = zwidth.alpha_max(delta, d)
    # Stiffnesses below and above the stiffest, or next to a corner of the range.
    alpha = ridge.alpha * np.where(random.random(count) < 0.5, random.uniform(0, 1.3, count), power(-8, 0.3))
    alpha = np.where(corner & (random.random(count) < 0.4), random.choice(ALPHAS, count), alpha)
    alpha = np.where(random.random(count) < 0.03, -alpha, alpha)
    beta = inside_out(alpha, delta, d, ridge, random)
    rows = random.random(count) < 0.15
    limit = zwidth.boundary_point(delta, d, beta=beta).alpha
    alpha = np.where(rows & (limit > 0), nudged(limit, random), alpha)
    walls = Walls(limited(alpha, 1e60), limited(beta, 1e60), delta, d)
    assert np.all(wall_status(*walls) == Status.OK)
    return walls


def inside_out(alpha, delta, d, ridge, random):
    """Dampings across the stable ones of each column and beyond, beside their ends, and in the corners."""
    count = alpha.size
    soft = np.minimum(np.abs(alpha), 0.999 * ridge.alpha)
    soft = np.where(soft > 0, np.maximum(soft, 1e-60), 0.5 * ridge.alpha)
    low, high = (zwidth.boundary_point(delta, d, alpha=soft, side=side).beta for side in ("lower", "upper"))
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
        nudged(low, random),
        nudged(low + width, random),
        ridge.beta,
        np.zeros(count),
        random.choice([-1.0, 1.0], count) * 10.0 ** random.uniform(-60, 60, count),
    ]
    return np.choose(random.integers(0, len(choices), count), choices)


def nudged(value, random):
    """Within 1e-12 of a value, half of them within some units in the last place."""
    close = random.integers(-3, 4, value.size) * ULP
    return value * (1.0 + np.where(random.random(value.size) < 0.5, close, random.uniform(-1e-12, 1e-12, value.size)))


def limited(value, most):
    size = np.abs(value)
    return np.where(size < 0.5e-60, 0.0, np.sign(value) * np.clip(size, 1e-60, most))


class Facts(NamedTuple):
    """What the functions say of the same walls."""

    walls: Walls
    stable: np.ndarray
    proved: np.ndarray  # the certified verdict, where there is one
    known: np.ndarray  # whether there is one
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


def facts_of(walls: Walls) -> Facts:
    """Ask every function about every wall."""
    alpha, beta, delta, d = walls
    certified = zwidth.decide_stability(*walls, method="certified")
    found = bound_radius(*walls)
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
        found.radius,
        found.error,
        zwidth.is_passive(*walls),
        zwidth.passivity_margin(*walls),
    )


def contradictions(f: Facts) -> dict[str, np.ndarray]:
    """Each statement that must hold of all walls, and where it does not."""
    alpha, beta = f.walls.alpha, f.walls.beta
    spring = alpha > 0
    stable, m = f.stable, f.margins
    rows, columns = f.row.status == Status.OK, f.lower.status == Status.OK
    inside = (beta > f.lower.beta) & (beta < f.upper.beta)
    return {
        "the certified verdict is known": ~f.known,
        "the certified verdict is the verdict": f.known & (f.proved != stable),
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
        # A column within rounding of the ridge may be undecided.
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


def near_the_edge(walls: Walls) -> np.ndarray:
    """Whether the proved verdict changes within rounding of the wall, in stiffness or in damping."""
    alpha, beta, delta, d = walls
    # b = beta + delta is known to some rounding errors of its terms.
    shift = 64 * ULP * (np.abs(beta) + delta)
    labels = [
        zwidth.is_stable(limited(alpha * (1 + a), 1e60), limited(beta + b * shift, 1e60), delta, d, method="certified")
        for a in (-ROUNDING, ROUNDING)
        for b in (-1.0, 1.0)
    ]
    return np.any(np.stack(labels) != labels[0], axis=0)


# What the functions say alone, whatever the distance from the edge.
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


def found_in(count: int, seed: int) -> dict[str, list[tuple]]:
    """The contradictions among so many walls, by statement, but those that rounding explains."""
    random = np.random.default_rng(seed)
    found: dict[str, list[tuple]] = {}
    for start in range(0, count, BLOCK):
        facts = facts_of(draw(min(BLOCK, count - start), random))
        for statement, where in contradictions(facts).items():
            bad = np.flatnonzero(where)
            if bad.size and statement not in ALWAYS:
                bad = bad[~near_the_edge(facts.walls.select(bad))]
            if bad.size:
                found.setdefault(statement, []).extend(
                    zip(*(part.tolist() for part in facts.walls.select(bad)), strict=True)
                )
    return found


def test_no_two_functions_contradict_each_other():
    assert found_in(2000, 20) == {}


# Found by this file among 10^5 walls; the proved verdict on each is "unstable", the first two rows have no end.
ONCE_WRONG = [
    # Rows far above the whole lobe, where the curve comes back from infinity.
    (2.335447764326184e-07, 3.692815079655784e38, 0.0, 1 - ULP / 2),
    (325966003164.7999, 2.354637921449004e41, 1e12, 0.5),
    # Crossovers behind a quarter turn, beside walls of a fractional delay.
    (1000.0, 1.179223312502481e49, 1e-300, 1.0),
    (0.0003979204995852754, 32868943419.924587, 1e-16, 3.0),
    (1e-13, 1.2276672712930513e19, 0.0, 2.0),
    # Rows next to the lobe's end after a long delay, 0.3 and 1.2 % too long.
    (2.674211185961894e-09, 3.6593616254797103, 3.65936162742, 1e5),
    (1000.0, 999999999116.872, 1e12, 99999.5),
]


def test_walls_once_called_stable_are_not():
    fraction = (0.1, 0.4, 0.1, 1.5)
    walls = Walls(*np.array([*ONCE_WRONG, fraction]).T)
    assert zwidth.is_stable(*walls).tolist() == [False] * len(ONCE_WRONG) + [True]
    assert zwidth.is_stable(*walls, method="certified").tolist() == [False] * len(ONCE_WRONG) + [True]
    row = zwidth.boundary_point(walls.delta, walls.d, beta=walls.beta)
    assert not np.any(row.alpha[:-1] > walls.alpha[:-1])


def test_rows_next_to_the_end_of_the_lobe_and_columns_are_the_same_curve():
    random = np.random.default_rng(5)
    count = 2000
    d = np.minimum(np.where(random.random(count) < 0.5, 1e5, 10 ** random.uniform(0, 5, count)), 1e5)
    delta = np.where(random.random(count) < 0.1, 0.0, 10 ** random.uniform(-9, 12, count))
    end = zwidth.boundary_point(delta, d, alpha=np.full(count, 1e-60), side="upper").beta
    beta = end - (end + delta) * 10 ** random.uniform(-12, -2, count)
    alpha = zwidth.boundary_point(delta, d, beta=beta).alpha
    there = alpha > 0
    assert there.mean() > 0.9
    again = zwidth.boundary_point(delta[there], d[there], alpha=alpha[there], side="upper").beta
    assert np.max(np.abs(again - beta[there]) / (np.abs(beta) + delta)[there]) < 32 * ULP


@pytest.mark.parametrize("delta", [1e-300, 1e-100, 1e-20])
def test_the_gain_margin_has_a_limit_for_light_damping(delta):
    walls = (0.13548921166348554, 0.47387196928852116), (1.7032855202028993e-09, 0.013311947546541589)
    for (alpha, beta), d in zip(walls, (1.0, 117.0), strict=True):
        undamped = zwidth.margins(alpha, beta, 0.0, d).gain_margin
        assert zwidth.margins(alpha, beta, delta, d).gain_margin == pytest.approx(undamped, rel=1e-12)


def test_settling_times_belong_to_stable_walls():
    random = np.random.default_rng(22)
    walls = draw(600, random)
    # Settling is searched backwards period by period: slow loops take too long for a test.
    quick = np.abs(zwidth.decay_rate(*walls)) >= 1e-2
    walls = walls.select((walls.d <= 40) & (walls.alpha != 0) & quick)
    stable = zwidth.is_stable(*walls)
    times = np.array([settling_time(*(float(value) for value in wall)) for wall in zip(*walls, strict=True)])
    assert np.all(np.isnan(times) | (stable & np.isfinite(times) & (times >= 0)))
    assert np.mean(np.isfinite(times[stable])) > 0.5


def main(count: str, seed: str) -> None:
    """Print what is found among so many walls."""
    found = found_in(int(count), int(seed))
    for statement, walls in found.items():
        print(f"{statement}: not so for {len(walls)}")
        print(*walls[:10], sep="\n")
    print(f"{sum(map(len, found.values()))} contradictions among {count} walls, seed {seed}")


if __name__ == "__main__":
    main(*sys.argv[1:])
