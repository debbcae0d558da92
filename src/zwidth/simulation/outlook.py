"""What becomes of motions behind their last sample, where it can be proved (docs/theory/simulation.md, T7).

Whatever the program and the joint do, between two of their decisions the loop is an affine map from sample to sample.
If no decision changes any more, that map says all: the wall seen or left, a reading that stays, a body that friction
holds. Arrays have the lanes as their first axis.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.simulation.engine import round_to
from zwidth.simulation.lanes import Lanes, Options
from zwidth.simulation.maps import (
    LaneGroup,
    LoopMap,
    bound_rows,
    find_kept,
    gather,
    is_loose,
    lay_loop,
    solve_lanes,
    square,
    take,
)

# How much longer than simulated a drift must not matter.
_LONG = 1e3
# What bounds between samples have room for.
_ROOM = 2.0
# So many numbers of maps at once: behind a long delay each has the square of its commands on their way.
_AT_ONCE = 1 << 22
# How near, in steps of the encoder, a motion must come to where it was a cycle ago.
_AGAIN = 0.1


class Outlook(NamedTuple):
    """What is known of the motions behind their last sample."""

    settles: np.ndarray  # comes to rest, no decision changes any more
    grows: np.ndarray  # gets ever wider
    repeats: np.ndarray  # its readings repeat for good
    restless: np.ndarray  # has no place where it could come to rest
    pace: np.ndarray  # periods in which the linear loop decays by half or grows by as much; infinite if neither
    off: np.ndarray  # how far the loop is from its rest, commands on their way among it, as a position


@np.errstate(all="ignore")
def foresee(
    lanes: Lanes, options: Options, state: Any, push: np.ndarray, known: np.ndarray, sensed: np.ndarray, periods: int
) -> Outlook:
    """What can be proved of lanes; ``known``, of which a proof is tried, ``sensed``, the last positions."""
    # A motion near the end of the range of floats overflows, and nothing is proved of it.
    no = np.zeros(push.size, bool)
    endless = np.full(push.size, np.inf)
    outlook = Outlook(no, no.copy(), no.copy(), no.copy(), endless, endless.copy())
    if options.foaw or options.law is not None:
        return outlook
    late, window = (np.broadcast_to(np.asarray(part), push.size) for part in (lanes.late, lanes.estimator.window))
    finite = np.isfinite(state.body.x).all(0)
    if lanes.rate.shape[1] > lanes.rate.shape[0] + 1:
        # What friction holds goes on to feel what the actuator and the modes do: not known here.
        known = known & (lanes.motor.static == 0)
    shapes = np.stack([late, window], 1)
    for shape in np.unique(shapes[known & finite], axis=0):
        own = np.flatnonzero(known & finite & (shapes == shape).all(1))
        numbers = own.size * (shape.sum() + len(lanes.rate)) ** 2
        for at in np.array_split(own, 1 + numbers // _AT_ONCE):
            group = gather(lanes, options, state, push, periods, at)
            for whole, part in zip(outlook, _foresee(group, sensed[:, at], periods, options.bodies), strict=True):
                whole[at] = part
    return outlook


def _foresee(group: LaneGroup, sensed: np.ndarray, periods: int, bodies: bool) -> Outlook:
    lanes, motor, touching = group.lanes, group.lanes.motor, group.touching
    exact, dry = lanes.resolution == 0, motor.static > 0
    endless = np.isinf(motor.max_force) & np.isinf(motor.max_rate)
    loop = lay_loop(group, True, True, False)
    squarings = square(loop.A)
    pace = np.where(squarings == 0, np.inf, np.exp2(np.abs(squarings)))
    unstable = squarings < 0
    linear = exact & lanes.bilateral & endless & ~dry & lanes.pulling
    settles, grows = linear & (squarings > 0), linear & unstable
    away = (loop.A @ group.state[..., None])[..., 0] + loop.pushed * group.push[:, None] - group.state
    off = _measure(group, solve_lanes(np.eye(loop.A.shape[1]) - loop.A, away[..., None])[..., 0])
    if not bodies:
        # The poles of the loop are all that is known.
        return Outlook(settles, grows, settles & False, settles & False, pace, off)
    stuck = dry & (group.slip == 0)
    # The decisions in force; what slips on feels a constant friction.
    modes = np.stack([exact & touching, touching, stuck], 1)
    slip = np.where(dry, group.slip, 0.0)
    other = ~(linear & (squarings != 0)) & ~(unstable & modes[:, 0] & ~stuck) & ((slip == 0) | (group.bodies == 2))
    # Who is pushed on no spring comes back.
    other &= touching | stuck | (group.push <= 0) | ~is_loose(group)
    rubbed = group._replace(push=group.push - slip * motor.coulomb, slip=slip)
    for seen, wall, held in np.unique(modes[other], axis=0):
        own = other & (modes == (seen, wall, held)).all(1)
        settles[own], far = _settles(take(rubbed, own), (seen, wall, held), periods)
        off[own] = np.where(settles[own], far, off[own])
    repeats = linear & (squarings == 0) & ~settles
    own = ~exact & ~dry & ~settles
    if own.any() and not lanes.estimator.A.size:
        repeats[own] = _repeats(take(group, own), sensed[:, own], periods)
    own = ~linear & unstable & lanes.bilateral & endless & lanes.pulling & ~settles
    if own.any():
        grows[own] = _outgrows(take(group, own), take(loop, own), periods)
    # Readings that repeat change in every cycle.
    restless = _is_restless(group, unstable) | (repeats & ~exact)
    return Outlook(settles, grows, repeats, restless, pace, off)


def _measure(group: LaneGroup, away: np.ndarray) -> np.ndarray:
    """How far states are from their rest in position and readings, and in commands by the wall's force on a way."""
    sent, force = group.sent, group.lanes.alpha + 2.0 * np.abs(group.lanes.beta * group.lanes.estimator.D)
    places = np.abs(away[:, [0, *range(sent - group.window, sent)]]).max(-1)
    return np.maximum(places, np.abs(away[:, sent:]).max(-1) / np.where(force > 0, force, 1.0))


def _settles(group: LaneGroup, mode: tuple[bool, bool, bool], periods: int) -> tuple[np.ndarray, np.ndarray]:
    """Whether no decision changes any more: the wall is kept or left for good, the reading stays, no limit is met.

    And how far a body that is not held is from its rest.
    """
    seen, wall, held = mode
    lanes, motor, bilateral, quantum = group.lanes, group.lanes.motor, group.lanes.bilateral, group.lanes.resolution
    m, late, sent, slip, n = group.bodies, group.late, group.sent, group.slip, group.state.shape[1]
    loop = lay_loop(group, seen, wall, held)
    reading = round_to(quantum, group.state[:, 0])
    constant = loop.pushed * group.push[:, None] + (0.0 if seen else loop.misread * reading[:, None])
    # Where the map leads, apart from what it keeps: ``left`` times the state stays, or drifts, along ``right``.
    kept = find_kept(group, seen, held)
    length = np.sum(kept * kept, -1, keepdims=True)
    unit = kept / np.where(length > 0, length, 1.0)
    inner = np.eye(n) - (loop.A if held else loop.A.mT)
    dual = solve_lanes(inner + unit[..., None] * kept[:, None], unit[..., None])[..., 0]
    right, left = (dual, kept) if held else (kept, dual)
    both = right[..., None] * left[:, None]
    drift, level = (np.einsum("ln,ln->l", left, part) for part in (constant, group.state))
    goal = constant + right * (level - drift)[:, None]
    rest = solve_lanes(np.eye(n) - loop.A + both, goal[..., None])[..., 0]

    position = np.broadcast_to(np.eye(n)[0], group.state.shape)
    rows = [position, loop.command, loop.command - np.eye(n)[sent]]
    # The force on the held body, by the commands that act within the period.
    motion = lanes.motion[:, 0]
    pull = np.zeros(group.state.shape)
    pull[:, :m] = np.einsum("lm,lmk->lk", motion, lanes.rate[..., :m])
    rows += [pull + (np.eye(n)[sent + age - 1] if age else loop.command) for age in (late, late + 1)]
    rows = np.stack(rows, 1)
    fixed = np.zeros((len(reading), len(rows[0])))
    if not seen:
        fixed[:, 1] = fixed[:, 2] = loop.misled * reading
        if not late:
            fixed[:, 3] = fixed[:, 1]
    ends = np.einsum("lrn,ln->lr", rows, rest) + fixed
    # Where the map leads to another side of the wall there is nothing to bound.
    off = np.zeros(len(reading)) if held else _measure(group, rest - group.state)
    settled = np.isfinite(ends).all(-1) & (bilateral | ((ends[:, 0] > 0) if wall else (drift <= 0)))
    # A body that slips on keeps its velocity's sign, at the samples and where the force changes between them.
    signed = np.zeros((len(reading), 2, n))
    signed[:, 0, m // 2], signed[:, 1, :m] = 1.0, group.halfway[:, m // 2, :m]
    signed[:, 1, sent + late] = group.halfway[:, m // 2, m]
    low, high, above = np.full(ends.shape, np.nan), np.full(ends.shape, np.nan), np.zeros(len(reading), bool)
    low[settled], high[settled], above[settled] = bound_rows(
        (loop.A - both)[settled], (group.state - rest)[settled], rows[settled], (signed * slip[:, None, None])[settled]
    )
    # Or what is left could not turn the force of friction: that takes more than twice of it.
    left = np.maximum(np.abs(low), np.abs(high))[:, 3:].max(-1) <= 1e-9 * motor.static
    settled &= above | left | (slip == 0)
    # Forces that came before count as they are.
    slack = 1e-9 * (np.abs(ends) + np.maximum(high, -low))
    low, high = ends + low - slack, ends + high + slack
    settled &= np.isfinite(low + high).all(-1)
    far = np.abs(drift) * _LONG * periods
    if not seen and wall:
        settled &= (low[:, 0] - far > reading - 0.5 * quantum) & (high[:, 0] + far < reading + 0.5 * quantum)
    if not held:
        settled &= far <= 1e-9 * (np.abs(group.state).max(-1) + np.abs(rest).max(-1))
    if not wall:
        side = high[:, 0] + far <= 0.5 * quantum * (1 - 1e-9)
        if m == 2 and not held:
            # Nothing stops one body on no spring that is outside and moves on, and is pushed, away from the wall.
            away = np.concatenate([group.state[:, :2], group.push[:, None], group.state[:, sent:]], 1)
            side |= np.all(away <= 0, axis=1) & (length[:, 0] > 0)
    else:
        side = low[:, 0] > 0 if seen else reading > 0
    settled &= bilateral | side
    least, most = -motor.max_force, np.where(lanes.pulling, motor.max_force, 0.0)
    if held and m == 2:
        # The only body does not move: it feels the commands on their way, and at last those within the limits.
        waiting = group.state[:, sent:]
        low = np.minimum(waiting.min(1), np.clip(low[:, 1], least, most))
        high = np.maximum(waiting.max(1), np.clip(high[:, 1], least, most))
        strongest = np.maximum(np.abs(low + group.push), np.abs(high + group.push))
        return settled & (strongest <= motor.static * (1 - 1e-9)), off
    if wall:
        settled &= np.all((low[:, 1:3] >= np.stack([least, -motor.max_rate], 1)), axis=1)
        settled &= np.all((high[:, 1:3] <= np.stack([most, motor.max_rate], 1)), axis=1)
    if held:
        wide = np.maximum(high - ends, ends - low)[:, 3:]
        force = np.abs(ends[:, 3:] + group.push[:, None]) + _ROOM * wide
        settled &= np.all(force <= motor.static[:, None] * (1 - 1e-9), axis=1)
    return settled, off


def _is_restless(group: LaneGroup, unstable: np.ndarray) -> np.ndarray:
    """Whether there is no place where the device could come to rest."""
    lanes, motor, m, push, loose = group.lanes, group.lanes.motor, group.bodies, group.push, is_loose(group)
    alpha, quantum, bilateral = lanes.alpha, lanes.resolution, lanes.bilateral
    force = group.pushed
    way = np.eye(m) - group.plant[..., :m]
    way[loose] = np.eye(m)
    spring = np.where(loose, 0.0, 1.0 / solve_lanes(way, force[..., None])[:, 0, 0])
    place = push / (alpha + spring)
    count = np.round(push / (np.where(quantum > 0, quantum, 1.0) * (alpha + spring)))
    off = np.abs(push - (alpha + spring) * count * quantum)
    # In the wall it is the loop's own rest, or one within a step of the encoder.
    inside = np.where(quantum > 0, off > 0.5 * spring * quantum + 1e-9 * np.abs(push), unstable)
    inside |= ~bilateral & (place <= 0)
    outside = bilateral | (push > 0.5 * spring * quantum)
    # Behind modes a command and a push bend the device differently.
    if lanes.rate.shape[-1] > m + 1:
        return loose & False
    # At the motor's limit it may leave for good or rest where the limit lets it; nothing stops who is pushed harder.
    bound = (alpha > 0) & (motor.static == 0) & inside & outside
    bound &= (np.abs(push) < motor.max_force) & np.isfinite(place)
    return bound | (loose & (np.abs(push) > (motor.max_force + motor.static) * (1 + 1e-9)))


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


def _repeats(group: LaneGroup, sensed: np.ndarray, periods: int) -> np.ndarray:
    """Whether the readings repeat for good: the motion draws near to one that repeats, too near for a change."""
    # Without a filter readings alone decide the commands, whatever the motor's limits: two motions of equal readings
    # differ by what the bodies make of it.
    found = np.zeros(len(group.push), bool)
    counts = sensed / group.lanes.resolution
    reading, memory = np.floor(counts + 0.5), group.window + group.late + 2
    # A cycle holds a change of the reading, and comes nearest to where it began.
    lasted = np.argmax(reading[::-1] != reading[-1], axis=0)
    spans = np.arange(memory, len(counts) - memory)
    if not spans.size:
        return found
    last = len(counts) - 1 - memory
    far = np.abs(counts[last : memory - 1 : -1] - counts[-1])
    far += np.abs(counts[last - 1 : memory - 2 : -1] - counts[-2])
    far[(lasted == 0) | (spans[:, None] < lasted)] = np.inf
    nearest = far.min(0)
    at = np.flatnonzero(nearest < _AGAIN)
    length = memory + np.argmax(far[:, at] <= 2.0 * nearest[at] + 1e-9, axis=0)
    longest_first = np.argsort(-length)
    at, length = at[longest_first], length[longest_first]
    if not at.size:
        return found
    group, reading = take(group, at), reading[:, at]
    lanes, motor, quantum = group.lanes, group.lanes.motor, group.lanes.resolution
    m, window, late = group.bodies, group.window, group.late
    # The readings of one more cycle, and what the program makes of them.
    past = len(reading)
    again = reading[past - length + np.arange(length[0])[:, None] % length, np.arange(at.size)]
    reading = np.concatenate([reading, again]) * quantum
    entering = (reading[past:] - reading[past - window : -window]) / window if window else reading[past:]
    wanted = -(lanes.alpha * reading[past:] + lanes.beta * lanes.estimator.D * entering)
    wanted = np.where(lanes.bilateral | (again > 0), wanted, 0.0)
    most = np.where(lanes.pulling, motor.max_force, 0.0)
    commands = np.concatenate([group.state[:, : -late - 2 : -1].T, np.clip(wanted, -motor.max_force, most)])
    if np.isfinite(motor.max_rate).any():
        for j in range(late + 1, len(commands)):
            commands[j] = np.clip(commands[j], commands[j - 1] - motor.max_rate, commands[j - 1] + motor.max_rate)
    change = [np.abs(commands[length + j, np.arange(at.size)] - commands[j]) for j in range(late + 1)]
    same = np.max(change, axis=0) <= 1e-9 * np.abs(commands).max(0)
    moves, before, after = group.plant[..., :m], group.plant[..., m].T, group.plant[..., m + 1].T
    body, room = group.state[:, :m].T.copy(), np.full(at.size, 0.5)
    for j in range(length[0]):
        own = slice(np.count_nonzero(length > j))
        room[own] = np.minimum(room[own], 0.5 - np.abs(body[0, own] / quantum[own] - again[j, own]))
        forces = before[:, own] * commands[j, own] + after[:, own] * commands[j + 1, own]
        forces += group.pushed[own].T * group.push[own]
        body[:, own] = np.einsum("lnm,ml->nl", moves[own], body[:, own]) + forces
    values, vectors = np.linalg.eig(moves)
    share = solve_lanes(vectors, (body.T - group.state[:, :m])[..., None])[..., 0]
    # Differences of cycles add up along each eigenvector, or for as long as a motion may last.
    times = np.minimum(2.0 / np.abs(1.0 - values ** length[:, None]), (_LONG * periods / length)[:, None])
    sum_ = np.sum(np.abs(vectors[:, 0] * share) * times, axis=-1)
    found[at] = same & (np.abs(values).max(-1) <= 1.0 + 1e-12) & (sum_ < room * quantum)
    return found
