"""The maps of lanes from sample to sample between two decisions of their programs and joints.

A state is that of the bodies, of the velocity's filter, the past readings and the commands on their way; arrays have
the lanes as their first axis.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.simulation.lanes import Lanes, Options

# Squarings of a map, at most; rounding hides slower motions.
_SQUARINGS = 36


class LoopMap(NamedTuple):
    """The maps of lanes of one structure."""

    A: np.ndarray  # (lanes, n, n)
    pushed: np.ndarray  # (lanes, n), what a constant force adds
    misread: np.ndarray  # (lanes, n), what an error of the reading adds
    command: np.ndarray  # (lanes, n), the command as a row
    misled: np.ndarray  # (lanes,), what an error of the reading adds to it


class LaneGroup(NamedTuple):
    """Lanes of one structure at their last sample."""

    lanes: Any  # `Lanes` of numbers along the first axis
    plant: np.ndarray  # (lanes, m, m + 2): the bodies' map, and by the force before and after its change
    held: np.ndarray  # (lanes, m, m)
    state: np.ndarray  # (lanes, n)
    push: np.ndarray
    late: int
    window: int
    bodies: int  # of the state
    filter: int


def _rows(part: Any, at: np.ndarray) -> np.ndarray:
    """Some lanes of an array whose last axis they are, as its first."""
    part = np.moveaxis(np.asarray(part), -1, 0)
    return part[at] if len(part) > 1 else np.broadcast_to(part, (at.size, *part.shape[1:]))


def _compose(lanes: Lanes, options: Options, at: np.ndarray) -> np.ndarray:
    """The bodies' map over a period, from the map of each piece of it."""
    change = _rows(lanes.pieces.change, at)
    size = change.shape[-2]
    whole = np.concatenate([np.eye(size), np.zeros((size, 2))], 1)
    whole = np.broadcast_to(whole, (at.size, size, size + 2))
    for j in range(options.substeps):
        for piece in range(options.pieces):
            part = change[:, j, piece]
            whole = whole + part[..., :-1] @ whole
            # Of two pieces the first feels the older command.
            whole[..., size if piece + 1 < options.pieces else size + 1] += part[..., -1]
    return whole


def gather(lanes: Lanes, options: Options, state: Any, push: np.ndarray, k: int, at: np.ndarray) -> LaneGroup:
    program = state.program
    late, window = (int(_rows(part, at)[0]) for part in (lanes.late, lanes.estimator.window))

    def recall(ring: np.ndarray, count: int) -> np.ndarray:
        return ring[(k - 1 - np.arange(count)) % len(ring)][:, at].T

    parts = [state.body.x[:, at].T, program.filtered[:, at].T]
    parts += [recall(program.positions, window), recall(program.commands, late + 1)]
    own = type(lanes)(
        **{
            name: part if isinstance(part, tuple) else _rows(part, at)
            for name, part in lanes._asdict().items()
            if name not in ("motor", "estimator", "pieces", "digits")
        },
        motor=type(lanes.motor)(*(_rows(part, at) for part in lanes.motor)),
        estimator=type(lanes.estimator)(*(_rows(part, at) for part in lanes.estimator)),
        pieces=lanes.pieces,
        digits=lanes.digits,
    )
    plant = _compose(lanes, options, at)
    size = plant.shape[1]
    held = plant[..., :size]
    if options.friction:
        # Over the longest digit, a period; what is held has no velocity.
        motion, force = np.roll(own.place[:, 0], size // 2, -1), own.rate[..., -1]
        held = np.eye(size) + _rows(lanes.digits.change[1, 0], at)[..., :-1]
        held = held @ (np.eye(size) - force[..., :, None] * motion[..., None, :])
    return LaneGroup(
        own, plant, held, np.concatenate(parts, 1), push[at], late, window, size, program.filtered.shape[0]
    )


def lay_loop(group: LaneGroup, seen: bool, touching: bool, held: bool) -> LoopMap:
    """The map with the position read or the reading as it is, with the wall or without, free or held."""
    n, m, p, W, late = group.state.shape[1], group.bodies, group.filter, group.window, group.late
    lanes, count = group.lanes, len(group.state)
    estimator = lanes.estimator
    past, sent = m + p, m + p + W
    reading = np.zeros(n)
    reading[0] = float(seen)
    # What enters the velocity's filter, and what an error of the reading adds to it.
    entering, added = reading.copy(), 1.0
    if W:
        entering[past + W - 1] -= 1.0
        entering, added = entering / W, 1.0 / W
    velocity = estimator.D[:, None] * entering
    velocity[:, m:past] += estimator.C
    command = -(lanes.alpha[:, None] * reading + lanes.beta[:, None] * velocity) * float(touching)
    misled = -(lanes.alpha + lanes.beta * estimator.D * added) * float(touching)
    A, misread, pushed = np.zeros((count, n, n)), np.zeros((count, n)), np.zeros((count, n))
    A[:, :m, :m] = group.plant[..., :m]
    if held:
        A[:, :m, :m] = group.held
    else:
        before, after = group.plant[..., m], group.plant[..., m + 1]
        pushed[:, :m] = before + after
        A[:, :m, sent + late] += before
        if late:
            A[:, :m, sent + late - 1] += after
        else:
            A[:, :m] += after[..., None] * command[:, None]
            misread[:, :m] = after * misled[:, None]
    A[:, m:past, m:past] = estimator.A
    A[:, m:past] += estimator.B[..., None] * entering
    misread[:, m:past] = estimator.B * added
    for j in range(W):
        A[:, past + j] = reading if j == 0 else np.eye(n)[past + j - 1]
    if W:
        misread[:, past] = 1.0
    A[:, sent], misread[:, sent] = command, misled
    for j in range(1, late + 1):
        A[:, sent + j, sent + j - 1] = 1.0
    return LoopMap(A, pushed, misread, command, misled)


def square(A: np.ndarray, weigh: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """How many squarings shrink a map by half, negative where they show that it grows, 0 where neither; and P.

    ``trace A^N > n`` needs an eigenvalue outside of the unit circle, ``|A^N| < 1`` needs none. P is the sum of
    ``(A^k)^T A^k``: ``d^T P d`` falls from sample to sample.
    """
    count, n = A.shape[:2]
    found, P = np.zeros(count, int), np.broadcast_to(np.eye(n), A.shape).copy()
    left = np.arange(count)
    power = A
    for j in range(1, _SQUARINGS + 1):
        if weigh:
            P[left] += power.mT @ P[left] @ power
        power = power @ power
        small = np.abs(power).sum(-1).max(-1) < (1e-17 if weigh else 0.5)
        large = np.abs(np.trace(power, axis1=1, axis2=2)) > n
        found[left[small]], found[left[large]] = j, -j
        going = ~(small | large)
        left, power = left[going], power[going]
        if not left.size:
            break
    return found, P


def solve_lanes(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The solutions of all lanes, NaN where there is none: one lane spoils no other."""
    try:
        return np.linalg.solve(A, b)
    except np.linalg.LinAlgError:
        if len(A) == 1:
            return np.full(b.shape, np.nan)
        middle = len(A) // 2
        return np.concatenate([solve_lanes(A[:middle], b[:middle]), solve_lanes(A[middle:], b[middle:])])


def take(group: LaneGroup, own: np.ndarray) -> LaneGroup:
    lanes, at = group.lanes, np.flatnonzero(own)

    def pick(part: Any) -> Any:
        return part[at] if isinstance(part, np.ndarray) else part

    own_lanes = lanes._replace(
        **{name: pick(part) for name, part in lanes._asdict().items()},
    )
    own_lanes = own_lanes._replace(
        motor=type(lanes.motor)(*map(pick, lanes.motor)), estimator=type(lanes.estimator)(*map(pick, lanes.estimator))
    )
    return group._replace(
        lanes=own_lanes,
        **{name: getattr(group, name)[at] for name in ("plant", "held", "state", "push")},
    )


def find_kept(group: LaneGroup, loop: LoopMap, seen: bool, wall: bool, held: bool) -> tuple[np.ndarray, np.ndarray]:
    """What the map keeps, and of which lanes: the place of a held body, or a shift of bodies that no spring returns."""
    n, m = group.state.shape[1], group.bodies
    if held:
        place = np.zeros((len(group.state), n))
        place[:, :m] = group.lanes.place[:, 0]
        return place, np.ones(len(group.state), bool)
    loose = np.all(group.lanes.rate[:, :, 0] == 0, axis=1)
    shift = np.zeros((len(group.state), n))
    shift[:, 0] = 1.0
    if seen:
        # Readings shift with it, and what a filter of them settles on.
        shift[:, n - group.late - 1 - group.window : n - group.late - 1] = 1.0
        if not group.window and group.filter:
            own = np.eye(group.filter) - group.lanes.estimator.A
            shift[:, m : m + group.filter] = solve_lanes(own, group.lanes.estimator.B[..., None])[..., 0]
        loose &= group.lanes.alpha == 0
    return shift, loose
