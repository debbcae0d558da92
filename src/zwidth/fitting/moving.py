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
        whole, f = (float(part) for part in split_delay(np.float64(d)))
        now = self.skip + np.arange(self.position.size - 1) - int(whole)
        force = np.stack([self.force[now - 1], self.force[now]], -1).ravel()
        push, length = g * force + offset, np.tile([f, 1.0 - f], now.size)
        kinds = phi_functions(delta * length[:2])
        pieces = (_rub if friction else _glide)(push, length, kinds, delta, v0, friction)
        way, differentiate = _follow(pieces, force, push, length, kinds, delta, friction)
        return ModelledMotion(x0 + np.append(0.0, way), differentiate)


def _glide(
    push: np.ndarray, length: np.ndarray, kinds: PhiFunctions, delta: float, v0: float, friction: float
) -> Pieces:
    slow, rates = (np.tile(each, push.size // 2) for each in (kinds.c, length[:2] * kinds.phi1))
    end = recur(slow, rates * push, v0)
    never, still = np.zeros(push.shape, bool), np.zeros_like(push)
    return Pieces(np.append(v0, end[:-1]), end, never, length, still, still, never, never)


def _rub(push: np.ndarray, length: np.ndarray, kinds: PhiFunctions, delta: float, v0: float, friction: float) -> Pieces:
    count = push.size
    slow, rates = (np.tile(each, count // 2) for each in (kinds.c, length[:2] * kinds.phi1))
    able, times = np.flatnonzero(np.abs(push) > friction), np.append(0.0, np.cumsum(length))
    # What is gained from rest in a direction s, G. From v_m on, s v_k = G_k + (s v_m - G_m) e^(-delta (t_k - t_m)).
    gliding, rubbing = np.append(0.0, recur(slow, rates * push)), np.append(0.0, recur(slow, rates * friction))
    gained = {s: s * gliding - rubbing for s in (1.0, -1.0)}
    decays = [np.exp(-delta * (times[k:] - times[k])) for k in (0, 1)]
    # Where it moves on in which direction; where it turned from which one, how long before, and its velocity then.
    m, v, way = 0, v0, float(np.sign(v0))
    begun, turns = [(0, way)], []
    while m < count:
        if way == 0.0:
            after = np.searchsorted(able, m)
            if after == able.size:
                break
            m, v = int(able[after]), 0.0
            way = 1.0 if push[m] > 0 else -1.0
            begun.append((m, way))
        # The next part that ends at no speed in this direction, in ever longer windows.
        gain, decay, first, size = gained[way], decays[m % 2], m + 1, 32
        ahead = way * v - gain.item(m)
        while first <= count:
            stopped = (
                gain[first : first + size] + ahead * decay[first - m : first - m + size][: count + 1 - first] <= 0.0
            )
            if stopped[k := int(stopped.argmax())]:
                break
            first, size = first + size, 4 * size
        else:
            break
        k += first - 1
        v, a, h = way * max(0.0, gain.item(k) + ahead * decay.item(k - m)), push.item(k), length.item(k)
        m = k + 1
        pull = a - way * friction
        if not (pull * way < 0.0 and h > 0.0):
            v = slow.item(k) * v + rates.item(k) * pull
            continue
        before = -v / pull
        before = min(log1p(delta * before) / delta if delta else before, h)
        rest, old, way = h - before, way, -way if abs(a) > friction else 0.0
        v = (-expm1(-delta * rest) / delta if delta else rest) * (a - way * friction) if way else 0.0
        turns.append((k, before, old, v))
        begun.append((k, way))
    starts, ways = np.array(begun).T
    way_after = np.repeat(ways, np.diff(np.append(starts, count)).astype(int))
    turned, before, at = np.zeros(count, bool), length.copy(), way_after.copy()
    held, added = way_after == 0, rates * (push - way_after * friction)
    if turns:
        k = [turn[0] for turn in turns]
        turned[k], (before[k], at[k], added[k]) = True, np.array(turns)[:, 1:].T
    end = recur(np.where(held | turned, 0.0, slow), np.where(held, 0.0, added), v0)
    return Pieces(np.append(v0, end[:-1]), end, turned, before, at, way_after, at == 0, held)


def _follow(
    pieces: Pieces, force: np.ndarray, push: np.ndarray, length: np.ndarray, kinds: PhiFunctions, delta: float, c: float
) -> tuple[np.ndarray, Callable[[], np.ndarray]]:
    """The way gone at the end of every period, and the derivatives of places in g, delta, d, x0, v0, o and c."""
    v, end, way, held, k = pieces.start, pieces.end, pieces.way, pieces.held, np.flatnonzero(pieces.turned)
    a, held_after, way_after = np.where(held, 0.0, push - way * c), pieces.held_after[k], pieces.way_after[k]
    a_after = np.where(held_after, 0.0, push[k] - way_after * c)
    t, r = pieces.before[k], (length - pieces.before)[k]
    both, spans = phi_functions(delta * np.append(t, r)), length[:2]
    first, second = (PhiFunctions(*(each[part] for each in both)) for part in np.s_[: t.size, t.size :])
    moved = (kinds.phi1 * spans * v.reshape(-1, 2) + kinds.phi2 * spans**2 * a.reshape(-1, 2)).ravel()
    moved[k] = t * first.phi1 * v[k] + t**2 * first.phi2 * a[k] + r**2 * second.phi2 * a_after

    def differentiate() -> np.ndarray:
        by = _derive(kinds, delta, spans, *(each.reshape(-1, 2) for each in (v, a, force, way, held))).reshape(2, 7, -1)
        # What sticks forgets its speed.
        again, slow = (np.where(held.reshape(-1, 2), 0.0, each).ravel() for each in (spans * kinds.phi1, kinds.c))
        speed = a - delta * end
        if k.size:
            speed[k] = a_after - delta * end[k]
            turn, onward = speed[k] / a[k], end[k] / a[k]
            again[k], slow[k] = t * first.phi1 + onward * first.c, turn * first.c
            before = _derive(first, delta, t, v[k], a[k], force[k], way[k], held[k])
            after = _derive(second, delta, r, 0.0 * r, a_after, force[k], way_after, held_after)
            by[0][:, k], by[1][:, k] = before[0] + onward * before[1] + after[0], turn * before[1] + after[1]
        # A part that lasts longer goes on as it ended.
        by[:, 2] = np.tile([1.0, -1.0], end.size // 2) * np.array([end, speed])
        # Two parts a period.
        (place, late_place), (moves, late_moves) = (np.moveaxis(each.reshape(7, -1, 2), -1, 0) for each in by)
        (again, late_again), (slow, late_slow) = again.reshape(-1, 2).T, slow.reshape(-1, 2).T
        speeds = np.column_stack(
            [np.eye(7)[4], recur(slow * late_slow, (late_slow * moves + late_moves).T, np.eye(7)[4])[:-1].T]
        )
        place = place + late_place + late_again * moves + (again + late_again * slow) * speeds
        return np.cumsum(np.column_stack([np.eye(7)[3], place]), axis=1).T

    return np.cumsum(moved[::2] + moved[1::2]), differentiate


def _derive(at: PhiFunctions, delta: float, t: np.ndarray, *piece: np.ndarray) -> np.ndarray:
    """How place and velocity at the end of a piece move with g, delta, -, -, -, o and c, the start held: rows."""
    v, a, force, way, held = piece
    # -phi2'.
    bend = np.where(delta * t == 0, 1.0 / 6.0, at.gap / np.where(delta * t == 0, 1.0, delta * t))
    by = np.zeros((2, 7, *v.shape))
    by[0, 1], by[1, 1] = -(t**2) * (at.psi * v + t * bend * a), -t * (at.c * v + t * at.psi * a)
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
