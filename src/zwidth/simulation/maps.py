"""The maps of lanes from sample to sample between two decisions of their programs and joints.

A state is that of the bodies, of the velocity's filter, the past readings and the commands on their way; arrays have
the lanes as their first axis.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.simulation.lanes import Lanes, Options
from zwidth.words.xp import tree_map

# Squarings of a map, at most; rounding hides slower motions.
_SQUARINGS = 36
# Eigenvalues that nothing is left of after so many steps and two for every number of the state, which share of a state
# is nothing, what surely lies inside of the unit circle, and how long a motion is followed at most.
_FAST, _EXACT, _NOTHING, _INSIDE, _LONGEST = 0.5, 32, 1e-10, 1.0 - 1e-10, 1024


class LoopMap(NamedTuple):
    """The maps of lanes of one structure."""

    A: np.ndarray  # (lanes, n, n)
    pushed: np.ndarray  # (lanes, n), what a constant force adds
    misread: np.ndarray  # (lanes, n), what an error of the reading adds
    command: np.ndarray  # (lanes, n), the command as a row
    misled: np.ndarray  # (lanes,), what an error of the reading adds to it


class LaneGroup(NamedTuple):
    """Lanes of one structure at their last sample."""

    lanes: Any  # `Lanes` of numbers along the first axis, but for the motion over pieces and digits
    plant: np.ndarray  # (lanes, m, m + 2): the bodies' map, and by the command before and after its change
    pushed: np.ndarray  # (lanes, m): by a constant force on the device
    held: np.ndarray  # (lanes, m, m)
    halfway: np.ndarray  # (lanes, m, m + 1): the bodies' map until the force changes
    state: np.ndarray  # (lanes, n)
    push: np.ndarray
    touching: np.ndarray
    slip: np.ndarray
    late: int
    window: int

    @property
    def bodies(self) -> int:
        """How many numbers of the state are theirs."""
        return self.plant.shape[1]

    @property
    def sent(self) -> int:
        """Where in the state the newest command stands."""
        return self.state.shape[1] - self.late - 1


def _rows(part: Any, at: np.ndarray) -> Any:
    """Some lanes of arrays whose last axis they are, as their first."""

    def pick(leaf: Any) -> np.ndarray:
        first = np.moveaxis(np.asarray(leaf), -1, 0)
        return first[at] if len(first) > 1 else np.broadcast_to(first, (at.size, *first.shape[1:]))

    return tree_map(pick, part)


def _compose(lanes: Lanes, options: Options, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The bodies' map over a period and until the command changes, and what a push adds, piece by piece."""
    change = _rows(lanes.pieces.change[0], at)
    size = change.shape[-2]
    # A row for each number of the state, for the older and the newer command, and for the push.
    axes = np.eye(size + 3)
    whole = halfway = np.broadcast_to(axes[:size], (at.size, size, size + 3))
    for j in range(options.substeps):
        pieces = change.shape[2]
        for piece in range(pieces):
            part = change[:, j, piece]
            # Of two pieces the first feels the older command.
            newer = piece + 1 == pieces
            given = part[..., size : size + 1] * axes[size + newer] + part[..., -1:] * axes[-1]
            whole = whole + part[..., :size] @ whole + given
            if not newer:
                halfway = halfway + part[..., :size] @ halfway + given
    return whole[..., :-1], halfway[..., : size + 1], whole[..., -1]


def gather(lanes: Lanes, options: Options, state: Any, push: np.ndarray, k: int, at: np.ndarray) -> LaneGroup:
    """Lanes of one structure behind k periods."""
    program, body = state.program, state.body
    own: Any = _rows(lanes._replace(pieces=(), digits=()), at)
    late, window = int(own.late[0]), int(own.estimator.window[0])

    def recall(ring: np.ndarray, count: int) -> np.ndarray:
        return ring[(k - 1 - np.arange(count)) % len(ring)][:, at].T

    parts = [body.x[:, at].T, program.filtered[:, at].T]
    parts += [recall(program.positions, window), recall(program.commands, late + 1)]
    plant, halfway, pushed = _compose(lanes, options, at)
    size = plant.shape[1]
    held = plant[..., :size]
    if options.friction:
        # Over the longest digit, a period; what is held has no velocity.
        motion, force = own.motion[:, 0], own.rate[..., -1]
        held = np.eye(size) + _rows(lanes.digits.change[1, 0], at)[..., :size]
        held = held @ (np.eye(size) - force[..., :, None] * motion[..., None, :])
    touching, slip = program.touching[at] | own.bilateral, body.slip[at]
    return LaneGroup(
        own, plant, pushed, held, halfway, np.concatenate(parts, 1), push[at], touching, slip, late, window
    )


def lay_loop(group: LaneGroup, seen: bool, touching: bool, held: bool) -> LoopMap:
    """The map with the position read or the reading as it is, with the wall or without, free or held."""
    (count, n), m, W, late, sent = group.state.shape, group.bodies, group.window, group.late, group.sent
    lanes, estimator, past = group.lanes, group.lanes.estimator, sent - W
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
        pushed[:, :m] = group.pushed
        A[:, :m, sent + late] += before
        if late:
            A[:, :m, sent + late - 1] += after
        else:
            A[:, :m] += after[..., None] * command[:, None]
            misread[:, :m] = after * misled[:, None]
    A[:, m:past, m:past] = estimator.A
    A[:, m:past] += estimator.B[..., None] * entering
    misread[:, m:past] = estimator.B * added
    # Registers shift: past readings, and commands on their way.
    A[:, past:] = np.eye(n, k=-1)[past:]
    if W:
        A[:, past], misread[:, past] = reading, 1.0
    A[:, sent], misread[:, sent] = command, misled
    return LoopMap(A, pushed, misread, command, misled)


def square(A: np.ndarray) -> np.ndarray:
    """How many squarings shrink a map by half, negative where they show that it grows, 0 where neither."""
    # ``trace A^N > n`` needs an eigenvalue outside of the unit circle, ``|A^N| < 1`` needs none.
    count, n = A.shape[:2]
    found, left, power = np.zeros(count, int), np.arange(count), A
    for j in range(1, _SQUARINGS + 1):
        power = power @ power
        small = np.abs(power).sum(-1).max(-1) < 0.5
        large = np.abs(np.trace(power, axis1=1, axis2=2)) > n
        found[left[small]], found[left[large]] = j, -j
        going = ~(small | large)
        left, power = left[going], power[going]
        if not left.size:
            break
    return found


def bound_rows(
    A: np.ndarray, state: np.ndarray, rows: np.ndarray, signed: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The least and the most that rows of a state that A moves ever are, and whether the signed rows stay above 0."""
    # The first steps as they are; then no row is further from 0 than the sum of what the slow eigenvectors add to it,
    # ``|g v| |c| |eigenvalue|^k``, which falls. By then the others, shift registers among them, have no share. A row
    # stays above 0 if the slowest adds more to it than all others. NaN where the state does not decay.
    values, vectors = np.linalg.eig(A)
    slow, inside = np.abs(values) > _FAST, np.abs(values).max(-1) < _INSIDE
    vectors = np.where(slow[:, None], vectors, 0.0)
    nothing, count = _NOTHING * np.abs(state).max(-1), rows.shape[1]
    every = np.concatenate([rows, signed], 1)
    first = np.einsum("lrn,ln->lr", every, state)
    low, high, state = _follow(A, state, every, first, first, _EXACT + 2 * A.shape[1])
    adjoint = vectors.conj().mT
    normal = adjoint @ vectors + ~slow[..., None] * np.eye(A.shape[1])
    share = solve_lanes(normal, adjoint @ state[..., None])
    rest = np.abs(state - np.real(vectors @ share)[..., 0]).max(-1)
    parts = every @ vectors * share.mT
    most = np.abs(parts).sum(-1)
    slowest = np.take_along_axis(parts, np.argmax(np.abs(values), -1)[:, None, None], -1)[..., 0]
    above = np.all(((low > 0) & (2.0 * np.real(slowest) > most * (1 + 1e-9)))[:, count:], axis=1)
    # Equal eigenvalues have too few eigenvectors: those motions are followed until nothing is left of them.
    own = np.flatnonzero(inside & ~(rest <= nothing))
    low[own], high[own], left = _follow(A[own], state[own], every[own], low[own], high[own], _LONGEST)
    most[own], above[own], rest[own] = 0.0, False, np.abs(left).max(-1)
    most = np.where((inside & (rest <= nothing))[:, None], most, np.nan)
    low, high = np.minimum(low, -most), np.maximum(high, most)
    return low[:, :count], high[:, :count], above


def _follow(
    A: np.ndarray, state: np.ndarray, rows: np.ndarray, low: np.ndarray, high: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The least and the most of rows on so many steps, with what they were before, and the state behind these."""
    for _ in range(steps if len(A) else 0):
        state = np.einsum("lnm,lm->ln", A, state)
        now = np.einsum("lrn,ln->lr", rows, state)
        low, high = np.minimum(low, now), np.maximum(high, now)
    return low, high, state


def solve_lanes(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The solutions of all lanes, NaN where there is none: one lane spoils no other."""
    try:
        return np.linalg.solve(A, b)
    except np.linalg.LinAlgError:
        if len(A) == 1:
            return np.full(b.shape, np.nan)
        middle = len(A) // 2
        return np.concatenate([solve_lanes(A[:middle], b[:middle]), solve_lanes(A[middle:], b[middle:])])


def take(part: Any, own: np.ndarray) -> Any:
    """Some lanes of a group, by their places or a mask."""
    return tree_map(lambda leaf: leaf[own] if isinstance(leaf, np.ndarray) else leaf, part)


def find_kept(group: LaneGroup, seen: bool, held: bool) -> np.ndarray:
    """What the maps of lanes keep: the place of a held body, a shift of bodies that no spring returns, or 0."""
    m, past, estimator = group.bodies, group.sent - group.window, group.lanes.estimator
    kept = np.zeros(group.state.shape)
    if held:
        kept[:, :m] = group.lanes.place[:, 0]
        return kept
    kept[:, 0] = 1.0
    if seen:
        # Readings shift with it, and what a filter of them settles on.
        kept[:, past : group.sent] = 1.0
        if not group.window:
            kept[:, m:past] = solve_lanes(np.eye(past - m) - estimator.A, estimator.B[..., None])[..., 0]
    return kept * (is_loose(group) & (~np.bool_(seen) | (group.lanes.alpha == 0)))[:, None]


def is_loose(group: LaneGroup) -> np.ndarray:
    """Whether no spring returns the bodies of lanes."""
    return np.all(group.lanes.rate[:, :, 0] == 0, axis=1)
