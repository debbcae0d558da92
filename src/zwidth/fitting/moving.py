"""The motion of a damped, rubbing mass under a recorded force that acts a delay later, held in between; exact.

In units of the period, with g = T^2/m, the velocity of a mass that moves in the direction s obeys

    v' = -delta v + a,    a = g F(t - d) + o - s c,    o = g f0,    c = g F_c.

A period has two parts in which a is constant: until the delayed force changes, and afterwards. In a part the velocity
tends to a/delta and so passes 0 once at most, where the mass turns, or sticks if ``|g F + o| <= c``. Hence a part is a
piece before and a piece after that instant, each in closed form. So are the derivatives: the instant moves by minus
the change of the velocity there over a. Only with friction are velocities found one after the other; all else are
NumPy's and LAPACK's compiled recursions, for JAX would compile for seconds for a log's length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import exp, expm1, log1p
from typing import ClassVar, NamedTuple, Self

import numpy as np

from zwidth.fitting.encoder import MeasurementNoise
from zwidth.loops.rigid.device import PhiFunctions, phi_functions, split_delay


class Pieces(NamedTuple):
    """Every part of a period: velocities at its ends; where it turns, how long before; directions; what sticks."""

    start: np.ndarray
    end: np.ndarray
    turned: np.ndarray
    before: np.ndarray
    way: np.ndarray
    way_after: np.ndarray
    held: np.ndarray
    held_after: np.ndarray


class ModelledMotion(NamedTuple):
    """Positions and their derivatives in g, delta, d, x0, v0, o and c, (n, 7)."""

    position: np.ndarray
    slopes: np.ndarray


@dataclass(frozen=True)
class Recording:
    """One log at even times: its forces, and its positions from sample ``skip`` on, whose forces are all known."""

    force: np.ndarray
    position: np.ndarray
    skip: int

    def begin(self, count: int) -> Recording:
        """So many first positions alone, counted from where the force first changes, for before that little is seen."""
        count += max(0, int(np.argmax(self.force != self.force[0])) - self.skip)
        return Recording(self.force[: self.skip + count], self.position[:count], self.skip)

    def move(
        self,
        g: float,
        delta: float,
        d: float,
        x0: float = 0.0,
        v0: float = 0.0,
        offset: float = 0.0,
        friction: float = 0.0,
    ) -> ModelledMotion:
        """Where the mass is at the samples; ``offset`` is o, ``friction`` c."""
        whole, f = (float(part) for part in split_delay(np.float64(d)))
        now = self.skip + np.arange(self.position.size - 1) - int(whole)
        force = np.stack([self.force[now - 1], self.force[now]], -1).ravel()
        length, longer = np.tile([f, 1.0 - f], now.size), np.tile([1.0, -1.0], now.size)
        push = g * force + offset
        pieces = _rub(push, length, delta, v0, friction) if friction else _glide(push, length, delta, v0)
        place, slopes = _follow(pieces, force, push, length, longer, delta, friction)
        # Two parts a period.
        place, slopes = place[1::2], slopes[1::2]
        whole_slopes = np.zeros((self.position.size, 7))
        whole_slopes[:, 3] = 1.0
        whole_slopes[1:, [0, 1, 2, 4, 5, 6]] = slopes
        return ModelledMotion(x0 + np.concatenate([[0.0], place]), whole_slopes)


def _glide(push: np.ndarray, length: np.ndarray, delta: float, v0: float) -> Pieces:
    at = phi_functions(delta * length)
    end = recur(at.c, length * at.phi1 * push, v0)
    start = np.concatenate([[v0], end[:-1]])
    never, still = np.zeros(push.shape, bool), np.zeros_like(push)
    return Pieces(start, end, never, length, still, still, never, never)


def _rub(push: np.ndarray, length: np.ndarray, delta: float, v0: float, friction: float) -> Pieces:
    kinds = [(h, exp(-delta * h), -expm1(-delta * h) / delta if delta else h) for h in length[:2].tolist()]
    v, way = v0, float(np.sign(v0))
    # Where it moves on in which direction, and where it turned from which one and when.
    ends, begun, ways, turns, times, olds = [0.0] * push.size, [0], [way], [], [], []
    rub = way * friction
    for k, a in enumerate(push.tolist()):
        if way == 0.0:
            if not abs(a) > friction:
                continue
            way = 1.0 if a > 0 else -1.0
            rub = way * friction
            begun.append(k)
            ways.append(way)
        h, c, rate = kinds[k % 2]
        pull = a - rub
        v = c * v + rate * pull
        if v * way <= 0.0 and pull * way < 0.0 and h > 0.0:
            before = -(ends[k - 1] if k else v0) / pull
            before = min(log1p(delta * before) / delta if delta else before, h)
            turns.append(k)
            times.append(before)
            olds.append(way)
            if abs(a) > friction:
                way, rest = -way, h - before
                rub = way * friction
                v = (-expm1(-delta * rest) / delta if delta else rest) * (a - rub)
            else:
                way, v = 0.0, 0.0
            begun.append(k)
            ways.append(way)
        ends[k] = v
    start, end = np.array([v0, *ends[:-1]]), np.array(ends)
    way_after = np.repeat(ways, np.diff([*begun, push.size]))
    turned, before, at = np.zeros(push.shape, bool), length.copy(), way_after.copy()
    turned[turns], before[turns], at[turns] = True, times, olds
    return Pieces(start, end, turned, before, at, way_after, at == 0, way_after == 0)


def _follow(
    pieces: Pieces,
    force: np.ndarray,
    push: np.ndarray,
    length: np.ndarray,
    longer: np.ndarray,
    delta: float,
    friction: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The way gone at the end of every part, and its derivatives in g, delta, d, v0, o and c."""
    v, end, turned, t = pieces.start, pieces.end, pieces.turned, pieces.before
    first, a = phi_functions(delta * t), np.where(pieces.held, 0.0, push - pieces.way * friction)
    moved = first.phi1 * t * v + first.phi2 * t**2 * a
    by_speed, by_place = _derive(first, delta, t, v, a, force, pieces.way, pieces.held)
    # What sticks forgets its speed.
    slow = np.where(pieces.held, 0.0, first.c)
    speed = np.where(turned, 0.0, a) - delta * end
    again = np.where(pieces.held, 0.0, t * first.phi1)
    if turned.any():
        k = np.flatnonzero(turned)
        r, a_after = (length - t)[k], np.where(pieces.held_after, 0.0, push - pieces.way_after * friction)[k]
        second = phi_functions(delta * r)
        moved[k] += second.phi2 * r**2 * a_after
        after_speed, after_place = _derive(
            second, delta, r, 0.0 * r, a_after, force[k], pieces.way_after[k], pieces.held_after[k]
        )
        speed[k] += a_after
        turn, onward = speed[k] / a[k], end[k] / a[k]
        again[k] += onward * slow[k]
        by_place[k] += after_place + onward[:, None] * by_speed[k]
        by_speed[k] = turn[:, None] * by_speed[k] + after_speed
        slow[k] *= turn
    # A part that lasts longer goes on as it ended.
    by_speed[:, 2], by_place[:, 2] = longer * speed, longer * end
    begin = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    speeds = recur(slow, by_speed, begin)
    speeds = np.concatenate([begin[None], speeds[:-1]])
    return np.cumsum(moved), np.cumsum(again[:, None] * speeds + by_place, axis=0)


def _derive(
    at: PhiFunctions,
    delta: float,
    t: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    force: np.ndarray,
    way: np.ndarray,
    held: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """How the velocity and the place at the end of a piece move with g, delta, -, -, o and c, the start held."""
    free = np.where(held, 0.0, 1.0)
    by = np.stack([force * free, 0.0 * t, 0.0 * t, 0.0 * t, free, -way * free], -1)
    by_speed, by_place = (t * at.phi1)[:, None] * by, (t**2 * at.phi2)[:, None] * by
    by_speed[:, 1] = -t * (at.c * v + t * at.psi * a)
    # -phi2'.
    bend = np.where(delta * t == 0, 1.0 / 6.0, at.gap / np.where(delta * t == 0, 1.0, delta * t))
    by_place[:, 1] = -(t**2) * (at.psi * v + t * bend * a)
    return by_speed, by_place


def recur(factor: np.ndarray | complex, added: np.ndarray, begin: float | np.ndarray = 0.0) -> np.ndarray:
    """``y_k = factor_k y_(k-1) + added_k``, of real or complex numbers."""
    from scipy.linalg.lapack import dtbtrs, ztbtrs  # pyright: ignore[reportAttributeAccessIssue]  (made at import)

    factor = np.broadcast_to(factor, len(added))
    right = np.array(added, dtype=np.result_type(factor, added, float))
    right[0] += factor[0] * begin
    band = np.ones((2, factor.size), right.dtype)
    band[1, :-1] = -factor[1:]
    solve = ztbtrs if right.dtype == complex else dtbtrs
    return solve(band, right.reshape(factor.size, -1), uplo="L", diag="U")[0].reshape(right.shape)


@dataclass(frozen=True)
class Recordings:
    """Several logs of one device; theta is ``(g, delta, d)``, for each log x0 and v0, then o and c."""

    logs: tuple[Recording, ...]
    noise: MeasurementNoise | None = None

    def weigh(self, columns: np.ndarray) -> np.ndarray:
        """Columns over samples, as `MeasurementNoise.weigh` where the noise is known."""
        return columns if self.noise is None else self.noise.weigh(columns)

    def begin(self, count: int) -> Self:
        """Of each log so many first positions."""
        return replace(self, logs=tuple(log.begin(count) for log in self.logs), noise=None)

    @property
    def measured(self) -> np.ndarray:
        """All positions that count."""
        return np.concatenate([log.position for log in self.logs])

    def split(self, column: np.ndarray) -> list[np.ndarray]:
        """What of a column over samples belongs to each log."""
        return np.split(column, np.cumsum([log.position.size for log in self.logs])[:-1])

    @property
    def size(self) -> int:
        """How many numbers theta has."""
        return self.parts.stop + 2 + 2 * (1 + self.modes) * len(self.logs)

    # Of the amplifier the order, and how many modes: none beside a rigid mass.
    lag: ClassVar[int] = 0
    modes: ClassVar[int] = 0

    @property
    def parts(self) -> slice:
        """Where in theta the numbers of amplifier and modes are."""
        return slice(3, 3 + self.lag + 3 * self.modes)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the largest that each number of theta may be."""
        return np.full(self.size, -np.inf), np.full(self.size, np.inf)

    @property
    def speeds(self) -> np.ndarray:
        """Where in theta the first speeds are."""
        return self.parts.stop + 1 + 2 * np.arange(len(self.logs))

    @property
    def largest(self) -> float:
        """The largest force commanded."""
        return max(float(np.abs(log.force).max()) for log in self.logs)

    def predict(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and their derivatives in theta."""
        places, slopes = [], []
        for speed, log in zip(self.speeds, self.logs, strict=True):
            into = [0, 1, 2, speed - 1, speed, -2, -1]
            moved = log.move(*theta[into].tolist())
            slope = np.zeros((log.position.size, self.size))
            slope[:, into] = moved.slopes
            places.append(moved.position)
            slopes.append(slope)
        return np.concatenate(places), np.concatenate(slopes)
