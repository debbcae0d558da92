"""What becomes of motions behind their last sample, where it can be proved (docs/theory/simulation.md, T7).

Whatever the program and the joint do, between two of their decisions the loop is an affine map from sample to sample.
If no decision changes any more, that map says all: the wall seen or left, a reading that stays, a body that friction
holds. Arrays have the lanes as their first axis.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.simulation.lanes import Lanes, Options
from zwidth.simulation.maps import LaneGroup, LoopMap, find_kept, gather, lay_loop, solve_lanes, square, take
from zwidth.simulation.period import round_to

# Samples that a cycle of readings is looked for in, how much longer than simulated a drift must not matter.
CYCLE, _LONG = 512, 1e3
# What bounds between samples have room for.
_ROOM = 2.0


class Outlook(NamedTuple):
    """What is known of the motions behind their last sample."""

    settles: np.ndarray  # comes to rest, no decision changes any more
    grows: np.ndarray  # gets ever wider
    repeats: np.ndarray  # its readings repeat for good
    restless: np.ndarray  # has no place where it could come to rest
    pace: np.ndarray  # periods in which the linear loop decays by half or grows by as much; infinite if neither


class _Rest(NamedTuple):
    """Where a map leads, and how far from there it can still go."""

    stable: np.ndarray
    state: np.ndarray
    deviation: np.ndarray
    map: np.ndarray  # of deviations
    P: np.ndarray
    drift: np.ndarray  # a period
    left: np.ndarray  # the functional that stays as it is, 0 without one

    def bound(self, rows: np.ndarray) -> np.ndarray:
        """The most that rows times the deviation can ever be, (lanes, rows)."""
        return self.reach(rows, self.deviation)

    def reach(self, rows: np.ndarray, d: np.ndarray) -> np.ndarray:
        weights = np.einsum("lrn,lrn->lr", rows, solve_lanes(self.P, rows.mT).mT)
        return np.sqrt(np.maximum(weights * np.einsum("ln,lnm,lm->l", d, self.P, d)[:, None], 0.0))


def _find_rest(loop: LoopMap, constant: np.ndarray, state: np.ndarray, kept: np.ndarray | None, held: bool) -> _Rest:
    """Where ``s -> A s + constant`` leads; ``kept`` is a state that the map keeps, or if held what keeps its value."""
    A, n = loop.A, loop.A.shape[1]
    unity = np.eye(n)
    if kept is None:
        right, left = np.zeros(state.shape), np.zeros(state.shape)
        inner = unity - A
    else:
        unit = np.broadcast_to(kept / np.sum(kept * kept, -1, keepdims=True), state.shape)
        inner = (
            unity - A + unit[..., :, None] * kept[..., None, :]
            if held
            else unity - A + kept[..., :, None] * unit[..., None, :]
        )
        if held:
            left = np.broadcast_to(kept, state.shape)
            right = solve_lanes(inner, unit[..., None])[..., 0]
        else:
            right = np.broadcast_to(kept, state.shape)
            left = solve_lanes(inner.mT, unit[..., None])[..., 0]
    inner = unity - A + right[..., :, None] * left[..., None, :]
    drift = np.einsum("ln,ln->l", left, constant)
    level = np.einsum("ln,ln->l", left, state)
    rest = solve_lanes(inner, (constant - right * drift[:, None] + right * level[:, None])[..., None])[..., 0]
    moves = A - right[..., :, None] * left[..., None, :]
    found, P = square(moves, weigh=True)
    return _Rest(found > 0, rest, state - rest, moves, P, drift, left)


@np.errstate(all="ignore")
def foresee(
    lanes: Lanes, options: Options, state: Any, push: np.ndarray, known: np.ndarray, sensed: np.ndarray, periods: int
) -> Outlook:
    """What can be proved of lanes; ``known``, of which a proof is tried, ``sensed``, what was last read.

    A motion near the end of the range of floats overflows, and nothing is proved of it.
    """
    count = push.size
    no = np.zeros(count, bool)
    outlook = Outlook(no, no.copy(), no.copy(), no.copy(), np.full(count, np.inf))
    if options.foaw or options.jitter:
        return outlook
    late, window = (np.broadcast_to(np.asarray(part), count) for part in (lanes.late, lanes.estimator.window))
    finite = np.isfinite(state.body.x).all(0)
    shapes = np.stack([late, window], 1)
    for shape in np.unique(shapes[known & finite], axis=0):
        at = np.flatnonzero(known & finite & (shapes == shape).all(1))
        group = gather(lanes, options, state, push, periods, at)
        for name, part in _foresee(group, state, at, sensed[:, at], periods).items():
            getattr(outlook, name)[at] = part
    return outlook


def _foresee(group: LaneGroup, state: Any, at: np.ndarray, sensed: np.ndarray, periods: int) -> dict[str, np.ndarray]:
    lanes, motor, count = group.lanes, group.lanes.motor, at.size
    bilateral = np.broadcast_to(lanes.bilateral, count)
    pulling = np.broadcast_to(lanes.pulling, count)
    exact, dry = lanes.resolution == 0, motor.static > 0
    endless = np.isinf(motor.max_force) & np.isinf(motor.max_rate)
    touching = np.broadcast_to(state.program.touching, state.body.x.shape[1:])[at] | bilateral
    stuck = dry & (state.body.slip[at] == 0)
    loop = lay_loop(group, True, True, False)
    squarings, _ = square(loop.A)
    pace = np.where(squarings == 0, np.inf, np.exp2(np.abs(squarings)))
    unstable = squarings < 0
    linear = exact & bilateral & endless & ~dry & pulling
    found = {
        "settles": linear & (squarings > 0),
        "grows": linear & unstable,
        "repeats": linear & (squarings == 0),
        "restless": _is_restless(group, unstable, bilateral, dry),
        "pace": pace,
    }
    rest = ~found["settles"] & ~found["grows"]
    for held in (False, True):
        for wall in (False, True):
            for seen in (False, True):
                own = rest & (stuck == held) & (dry == held) & (touching == wall)
                own &= (exact & wall) == seen
                if own.any():
                    part = take(group, own)
                    found["settles"][own] = _settles(part, seen, wall, held, bilateral[own], pulling[own], periods)
    own = ~exact & ~dry & pulling & np.isinf(motor.max_rate) & ~found["settles"] & (bilateral | (group.filter == 0))
    if own.any():
        found["repeats"][own] = _repeats(take(group, own), bilateral[own], sensed[:, own], periods)
    own = ~linear & unstable & bilateral & endless & pulling & ~found["settles"]
    if own.any():
        found["grows"][own] = _outgrows(take(group, own), LoopMap(*(part[own] for part in loop)), periods)
    return found


def _settles(
    group: LaneGroup, seen: bool, wall: bool, held: bool, bilateral: np.ndarray, pulling: np.ndarray, periods: int
) -> np.ndarray:
    """Whether no decision changes any more: the wall is kept or left for good, the reading stays, no limit is met."""
    lanes = group.lanes
    loop = lay_loop(group, seen, wall, held)
    reading = round_to(lanes.resolution, group.state[:, 0])
    constant = loop.pushed * group.push[:, None] + (0.0 if seen else loop.misread * reading[:, None])
    kept, loose = find_kept(group, loop, seen, wall, held)
    settled = np.zeros(len(reading), bool)
    for keeps, which in ((None, ~loose), (kept, loose)):
        if not which.any():
            continue
        own, at = take(group, which), np.flatnonzero(which)
        part = LoopMap(*(piece[at] for piece in loop))
        keeps = None if keeps is None else keeps[at]
        settled[at] = _stays(
            own, part, constant[at], keeps, (seen, wall, held), bilateral[at], pulling[at], reading[at], periods
        )
    return settled


def _stays(
    group: LaneGroup,
    loop: LoopMap,
    constant: np.ndarray,
    kept: np.ndarray | None,
    mode: tuple[bool, bool, bool],
    bilateral: np.ndarray,
    pulling: np.ndarray,
    reading: np.ndarray,
    periods: int,
) -> np.ndarray:
    seen, wall, held = mode
    lanes, motor, m, late = group.lanes, group.lanes.motor, group.bodies, group.late
    n, sent = group.state.shape[1], group.state.shape[1] - group.late - 1
    rest = _find_rest(loop, constant, group.state, kept, held)
    position = np.broadcast_to(np.eye(n)[0], group.state.shape)
    change = loop.command - np.eye(n)[sent]
    rows = [position, loop.command, change]
    # The force on the held body, by the commands that act within the period.
    motion = np.roll(lanes.place[:, 0], m // 2, -1)
    pull = np.zeros(group.state.shape)
    pull[:, :m] = np.einsum("lm,lmk->lk", motion, lanes.rate[..., :-1])
    for age in (late, late + 1):
        row = pull + (np.eye(n)[sent + age - 1] if age else loop.command)
        rows.append(row)
    rows = np.stack(rows, 1)
    fixed = np.zeros((len(reading), len(rows[0])))
    if not seen:
        fixed[:, 1] = fixed[:, 2] = loop.misled * reading
        if not late:
            fixed[:, 3] = fixed[:, 1]
    ends = np.einsum("lrn,ln->lr", rows, rest.state) + fixed
    spread = rest.bound(rows)
    # Forces that came before count as they are.
    slack = 1e-9 * (np.abs(ends) + spread)
    low, high = ends - spread - slack, ends + spread + slack
    scale = np.abs(group.state).max(-1) + np.abs(rest.state).max(-1)
    good = rest.stable & np.isfinite(spread).all(-1)
    far = np.abs(rest.drift) * _LONG * periods
    quantum = lanes.resolution
    if not seen and wall:
        good &= (low[:, 0] - far > reading - 0.5 * quantum) & (high[:, 0] + far < reading + 0.5 * quantum)
    if not held:
        good &= far <= 1e-9 * scale if kept is not None else True
    if not wall:
        side = high[:, 0] + far <= np.where(quantum > 0, 0.5 * quantum * (1 - 1e-9), 0.0)
        if m == 2 and kept is not None:
            # Nothing stops one body on no spring that is outside and moves on, and is pushed, away from the wall.
            away = np.concatenate([group.state[:, :2], group.push[:, None], group.state[:, sent:]], 1)
            side |= np.all(away <= 0, axis=1)
    elif seen:
        side = low[:, 0] > 0
    else:
        side = reading > 0
    good &= bilateral | side
    limits = (high[:, 1] <= motor.max_force) & (low[:, 1] >= -motor.max_force)
    limits &= (high[:, 2] <= motor.max_rate) & (low[:, 2] >= -motor.max_rate)
    limits &= pulling | (high[:, 1] <= 0)
    good &= limits | (not wall)
    if held:
        force = np.abs(ends[:, 3:] + group.push[:, None]) + _ROOM * spread[:, 3:]
        good &= np.all(force <= motor.static[:, None] * (1 - 1e-9), axis=1)
    return good


def _is_restless(group: LaneGroup, unstable: np.ndarray, bilateral: np.ndarray, dry: np.ndarray) -> np.ndarray:
    """Whether there is no place where the device could come to rest."""
    lanes, m, push = group.lanes, group.bodies, group.push
    alpha, quantum, most = lanes.alpha, lanes.resolution, lanes.motor.max_force
    loose = np.all(lanes.rate[:, :, 0] == 0, axis=1)
    force = group.plant[..., m] + group.plant[..., m + 1]
    way = np.eye(m) - group.plant[..., :m]
    way[loose] = np.eye(m)
    spring = np.where(loose, 0.0, 1.0 / solve_lanes(way, force[..., None])[:, 0, 0])
    place = push / (alpha + spring)
    count = np.round(push / (np.where(quantum > 0, quantum, 1.0) * (alpha + spring)))
    off = np.abs(push - (alpha + spring) * count * quantum)
    # In the wall it is the loop's own rest, or one within a step of the encoder.
    inside = np.where(quantum > 0, off > 0.5 * spring * quantum + 1e-9 * np.abs(push), unstable)
    inside &= (quantum == 0) | (count != 0) | (off > 0)
    inside |= ~bilateral & (place <= 0)
    outside = bilateral | (push > 0.5 * spring * quantum)
    # At the motor's limit it may leave for good or rest where the limit lets it.
    return (alpha > 0) & ~dry & inside & outside & (np.abs(push) < most) & np.isfinite(place)


def _outgrows(group: LaneGroup, loop: LoopMap, periods: int) -> np.ndarray:
    """Whether the fastest growing part of the loop's motion is beyond what steps and friction can do to it."""
    values, vectors = np.linalg.eig(loop.A.mT)
    which = np.argmax(np.abs(values), axis=-1)
    lane = np.arange(len(which))
    value, left = values[lane, which], vectors[lane, :, which]
    n = loop.A.shape[1]
    pushed = loop.pushed * group.push[:, None]
    rest = solve_lanes(np.eye(n) - loop.A, pushed[..., None])[..., 0]
    part = np.abs(np.einsum("ln,ln->l", left, group.state - rest))
    shoved = np.abs(np.einsum("ln,ln->l", left, loop.misread)) * 0.5 * group.lanes.resolution
    shoved += _ROOM * np.abs(np.einsum("ln,ln->l", left, loop.pushed)) * group.lanes.motor.static
    growth = np.abs(value) - 1.0
    return (part * growth > _ROOM * shoved) & (growth * periods > 0.05)


def _repeats(group: LaneGroup, bilateral: np.ndarray, sensed: np.ndarray, periods: int) -> np.ndarray:
    """Whether the readings repeat for good: the motion draws near to one that repeats, too near for a change."""
    lanes, motor = group.lanes, group.lanes.motor
    quantum = lanes.resolution
    reading = np.floor(sensed / quantum + 0.5)
    memory = group.window + group.late + 2
    length = np.zeros(quantum.size, int)
    for span in range(1, (len(reading) - memory) // 2):
        (likely,) = np.nonzero((reading[-1] == reading[-1 - span]) & (length == 0))
        ends = reading[-memory:, likely] == reading[-memory - span : -span, likely]
        likely = likely[ends.all(0)]
        same = reading[-span - memory :, likely] == reading[-2 * span - memory : -span, likely]
        length[likely[same.all(0)]] = span
    found = np.zeros(quantum.size, bool)
    at = np.flatnonzero(length)
    if not at.size:
        return found
    own = take(group, length > 0)
    loop, left = lay_loop(own, False, True, False), lay_loop(own, False, False, False)
    bilateral, reading, length, quantum = bilateral[at], reading[:, at], length[at], quantum[at]
    most = np.broadcast_to(motor.max_force, found.shape)[at]
    state, room = own.state, np.full(at.size, np.inf)
    for j in range(length.max()):
        going = j < length
        now = reading[len(reading) - length + j % length, np.arange(at.size)]
        touching = bilateral | (now > 0)
        A = np.where(touching[:, None, None], loop.A, left.A)
        misread = np.where(touching[:, None], loop.misread, left.misread)
        step = np.einsum("lnm,lm->ln", A, state) + misread * (now * quantum)[:, None]
        step += loop.pushed * own.push[:, None]
        inside = np.abs(step[:, -own.late - 1]) <= most
        near = np.where(inside, 0.5 - np.abs(state[:, 0] / quantum - now), -1.0)
        room = np.where(going, np.minimum(room, near), room)
        state = np.where(going[:, None], step, state)
    gap = state - own.state
    kept, loose = find_kept(own, loop, False, True, False)
    for keeps, which in ((None, ~loose), (kept, loose)):
        if which.any():
            part = LoopMap(*(piece[which] for piece in loop))
            rest = _find_rest(part, 0.0 * gap[which], gap[which], None if keeps is None else keeps[which], False)
            position = np.zeros((which.sum(), 1, gap.shape[1]))
            position[:, 0, 0] = 1.0
            # Differences of cycles add up to e - G^j e: G the map of a cycle, (1 - G) e the first.
            pairs = zip(rest.map, length[which], strict=True)
            cycles = np.stack([np.linalg.matrix_power(moves, span) for moves, span in pairs])
            whole = solve_lanes(np.eye(gap.shape[1]) - cycles, rest.deviation[..., None])[..., 0]
            total = 2.0 * rest.reach(position, whole)[:, 0]
            drift = np.abs(np.einsum("ln,ln->l", rest.left, gap[which])) * periods * 20.0 / length[which]
            found[at[which]] = rest.stable & (total + drift < room[which] * quantum[which])
    return found
