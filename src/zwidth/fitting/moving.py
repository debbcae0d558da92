"""The motion of a damped, rubbing mass under a recorded force that acts a delay later, held in between; exact.

In units of the period, with g = T^2/m, the velocity of a mass that moves in the direction s obeys

    v' = -delta v + a,    a = g F(t - d) + o - s c,    o = g f0,    c = g F_c.

A period has two parts in which a is constant: until the delayed force changes, and afterwards. In a part the velocity
tends to a/delta and so passes 0 once at most, where the mass turns, or sticks if ``|g F + o| <= c``. Hence a part is a
piece before and a piece after that instant, each in closed form. So are the derivatives: the instant moves by minus
the change of the velocity there over a. Only turns are found one after the other; all else are NumPy's and LAPACK's
compiled recursions, for JAX would compile for seconds for a log's length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import expm1, log1p
from typing import NamedTuple

import numpy as np

from zwidth.arrays.held_mass import PhiFunctions, phi_functions


class Pieces(NamedTuple):
    """Both parts of all periods, two rows: velocities at their ends, directions, what sticks; and the turns.

    Of each turn: the period, the part, the time before it, and the direction after it.
    """

    start: np.ndarray
    end: np.ndarray
    way: np.ndarray
    held: np.ndarray
    turns: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class ModelledMotion:
    """Positions, and their derivatives where somebody asks: in g, delta, d, x0, v0, o and c, or in theta."""

    position: np.ndarray
    differentiate: Callable[[], np.ndarray]

    @cached_property
    def slopes(self) -> np.ndarray:
        """A column for each number."""
        return self.differentiate()


@dataclass(frozen=True)
class Recording:
    """One log at even times: its forces, and its positions from sample ``skip`` on, whose forces are all known."""

    force: np.ndarray
    position: np.ndarray
    skip: int

    @cached_property
    def pushes(self) -> np.ndarray:
        """The force of each sample and that of the one before; two more, for a search may pass delays less than 0."""
        force = np.concatenate([[0.0, 0.0], self.force, self.force[-1:], self.force[-1:]])
        return np.array([force[1:-1], force[:-2]])

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
        whole = int(np.floor(d))
        past = self.force[self.skip - whole - 1 :][: self.position.size]
        force, spans = np.array([past[:-1], past[1:]]), np.array([d - whole, whole + 1.0 - d])
        push, kinds = g * force + offset, phi_functions(delta * spans)
        pieces = (_rub if friction else _glide)(push, spans, kinds, delta, v0, friction)
        way, differentiate = _follow(pieces, force, push, spans, kinds, delta, friction)
        return ModelledMotion(x0 + np.append(0.0, way), differentiate)


def _glide(
    push: np.ndarray, spans: np.ndarray, kinds: PhiFunctions, delta: float, v0: float, friction: float
) -> Pieces:
    """Without friction; with it, what is gained from rest in one direction."""
    gains = (spans * kinds.phi1)[:, None] * push
    late = recur(kinds.c[0] * kinds.c[1], kinds.c[1] * gains[0] + gains[1], v0)
    start = np.append(v0, late[:-1])
    middle, none = kinds.c[0] * start + gains[0], np.zeros(0, int)
    still = np.zeros_like(gains)
    return Pieces(np.array([start, middle]), np.array([middle, late]), still, still > 0, (none, none, 0.0 * none, none))


def _rub(push: np.ndarray, spans: np.ndarray, kinds: PhiFunctions, delta: float, v0: float, friction: float) -> Pieces:
    count, slow, rates = push.size, kinds.c.tolist(), (spans * kinds.phi1).tolist()
    # Both parts in turn. What is gained from rest in a direction s, G: from v_m on,
    # s v_k = G_k + (s v_m - G_m) e^(-delta (t_k - t_m)).
    gliding, rubbing = (
        np.append(0.0, _glide(each, spans, kinds, delta, 0.0, 0.0).end.T)
        for each in (push, np.full(push.shape, friction))
    )
    push = push.T.ravel()
    able, gained = np.flatnonzero(np.abs(push) > friction), {s: s * gliding - rubbing for s in (1.0, -1.0)}
    decay = np.exp(-delta * np.arange(count // 2 + 1))
    decays = [np.outer(decay, [1.0, each]).ravel() for each in slow]
    # Where it moves on in which direction; where it turned from which one, how long before, and its velocity then.
    m, v, way = 0, v0, float(np.sign(v0))
    begun, turns = [(0, way)], []
    while m < count:
        if way == 0.0:
            after = able.searchsorted(m)
            if after == able.size:
                break
            m, v = int(able[after]), 0.0
            way = 1.0 if push[m] > 0 else -1.0
            begun.append((m, way))
        # The next part that ends at no speed in this direction, in ever longer windows.
        gain, decay, first, size = gained[way], decays[m % 2], m + 1, 128
        ahead = way * v - gain.item(m)
        while first <= count:
            last = min(first + size, count + 1)
            stopped = gain[first:last] + ahead * decay[first - m : last - m] <= 0.0
            if stopped[k := int(stopped.argmax())]:
                break
            first, size = last, 4 * size
        else:
            break
        k += first - 1
        v, a, part = way * max(0.0, gain.item(k) + ahead * decay.item(k - m)), push.item(k), k % 2
        m, h, pull = k + 1, spans.item(part), a - way * friction
        if not (pull * way < 0.0 and h > 0.0):
            v = slow[part] * v + rates[part] * pull
            continue
        before = -v / pull
        before = min(log1p(delta * before) / delta if delta else before, h)
        rest, way = h - before, -way if abs(a) > friction else 0.0
        v = (-expm1(-delta * rest) / delta if delta else rest) * (a - way * friction) if way else 0.0
        turns.append((k, before, way, v))
        begun.append((k + 1, way))
    starts, ways = np.array(begun).T
    way = np.repeat(ways, np.diff(np.append(starts, count)).astype(int))
    held = way == 0
    factors, added = (
        np.where(held, 0.0, np.tile(slow, count // 2)),
        np.tile(rates, count // 2) * (push - way * friction),
    )
    added[held] = 0.0
    k, before, after, speeds = np.reshape(turns, (-1, 4)).T
    k = k.astype(int)
    factors[k], added[k] = 0.0, speeds
    end = recur(factors, added, v0)
    start, end, way, held = (
        np.ascontiguousarray(each.reshape(-1, 2).T) for each in (np.append(v0, end[:-1]), end, way, held)
    )
    return Pieces(start, end, way, held, (k % 2, k // 2, before, after))


def _follow(
    pieces: Pieces, force: np.ndarray, push: np.ndarray, spans: np.ndarray, kinds: PhiFunctions, delta: float, c: float
) -> tuple[np.ndarray, Callable[[], np.ndarray]]:
    """The way gone at the end of every period, and the derivatives of places in g, delta, d, x0, v0, o and c: rows."""
    v, end, way, held, (*k, t, way_after) = pieces
    k = tuple(k)
    span, kinds = spans[:, None], PhiFunctions(*(each[:, None] for each in kinds))
    a = np.where(held, 0.0, push - way * c)
    moved = kinds.phi1 * span * v + kinds.phi2 * span**2 * a
    held_after, r = way_after == 0, spans[k[0]] - t
    a_after = np.where(held_after, 0.0, push[k] - way_after * c)
    both = phi_functions(delta * np.append(t, r))
    first, second = (PhiFunctions(*(each[part] for each in both)) for part in np.s_[: t.size, t.size :])
    moved[k] = t * first.phi1 * v[k] + t**2 * first.phi2 * a[k] + r**2 * second.phi2 * a_after

    def differentiate() -> np.ndarray:
        by = _derive(kinds, delta, span, v, a, force, way, held)
        # What sticks forgets its speed.
        slow, again, speed = np.where(held, 0.0, kinds.c), by[1, 5].copy(), a - delta * end
        if t.size:
            speed[k] = a_after - delta * end[k]
            turn, onward = speed[k] / a[k], end[k] / a[k]
            again[k], slow[k] = t * first.phi1 + onward * first.c, turn * first.c
            before = _derive(first, delta, t, v[k], a[k], force[k], way[k], held[k])
            after = _derive(second, delta, r, 0.0 * r, a_after, force[k], way_after, held_after)
            by[0][:, *k], by[1][:, *k] = before[0] + onward * before[1] + after[0], turn * before[1] + after[1]
        # A part that lasts longer goes on as it ended.
        by[:, 2] = np.array([end, speed]) * [[1.0], [-1.0]]
        # Two parts a period.
        (place, late_place), (moves, late_moves) = np.moveaxis(by, 2, 1)
        (again, late_again), (slow, late_slow) = again, slow
        speeds = recur(slow * late_slow, (late_slow * moves + late_moves).T, np.eye(7)[4])[:-1].T
        place = place + late_place + late_again * moves
        place += (again + late_again * slow) * np.column_stack([np.eye(7)[4], speeds])
        return np.cumsum(np.column_stack([np.eye(7)[3], place]), axis=1).T

    return np.cumsum(moved[0] + moved[1]), differentiate


def _derive(at: PhiFunctions, delta: float, t: np.ndarray, *piece: np.ndarray) -> np.ndarray:
    """How place and velocity at the end of a piece move with g, delta, -, -, -, o and c, the start held: rows."""
    v, a, force, way, held = piece
    # -phi2'.
    bend = np.where(delta * t == 0, 1.0 / 6.0, at.gap / np.where(delta * t == 0, 1.0, delta * t))
    by = np.zeros((2, 7, *v.shape))
    by[0, 1], by[1, 1] = -(t**2) * at.psi * v - t**3 * bend * a, -t * at.c * v - t**2 * at.psi * a
    by[0, 5], by[1, 5] = np.where(held, 0.0, t**2 * at.phi2), np.where(held, 0.0, t * at.phi1)
    by[:, 0], by[:, 6] = force * by[:, 5], -way * by[:, 5]
    return by


def recur(factor: np.ndarray | complex, added: np.ndarray, begin: float | np.ndarray = 0.0) -> np.ndarray:
    """``y_k = factor_k y_(k-1) + added_k``, of real or complex numbers."""
    from scipy.linalg.lapack import dtbtrs, ztbtrs  # pyright: ignore[reportAttributeAccessIssue]  (made at import)

    right = np.array(added, dtype=np.result_type(factor, added, float), order="F")
    first, later = (factor[0], factor[1:]) if isinstance(factor, np.ndarray) else (factor, factor)
    right[0] += first * begin
    # As LAPACK stores it: nothing is copied.
    band = np.empty((len(right), 2), right.dtype).T
    band[1, :-1] = np.negative(later)
    solve = ztbtrs if right.dtype == complex else dtbtrs
    return solve(band, right, uplo="L", diag="U", overwrite_b=1)[0].reshape(right.shape)
