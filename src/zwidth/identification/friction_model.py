"""Compute the exact response of a damped mass with Coulomb friction to a delayed logged force with zero-order hold.

In sampling periods, with g = T^2/m, the velocity v of a mass that moves in the direction s = sign(v) obeys

    v' = -delta v + a,    a = g F(t - d) + o - s c,    delta = b T/m,    o = g f0,    c = g F_c,

with the mass m, the damping b, the delay d in sampling periods T, a constant force f0 and the Coulomb friction F_c. x0
and v0 are the position and velocity at the first sample. In each period the delayed force F(t - d) changes once, at the
fractional part f of the delay. The period therefore has two *parts* of durations f and 1 - f in which a is constant.

Within a part the velocity approaches a/delta exponentially, so it reaches 0 at most once. At this *stop* the mass
sticks if ``|g F + o| <= c``; otherwise it reverses. The time of the stop follows from a logarithm. Before and after it
the velocity and position have a closed form in the phi-functions of `zwidth.plant.rigid_mass`. The derivatives with
respect to the parameters are exact, too: a change dv of the velocity near the stop shifts its time by -dv/a.

Stops are computed one after another in Python; all other steps are vectorized, and linear recursions are solved by
LAPACK. JAX is not used, because it would compile for seconds for every new length of a log.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import expm1, log1p
from typing import NamedTuple

import numpy as np

from zwidth.plant.rigid_mass import PhiFunctions, phi_functions

# Columns of the derivatives that `Recording.move` computes: index of each parameter.
G = 0  # reciprocal mass g = T^2/m
DELTA = 1  # damping delta = b T/m
DELAY = 2  # delay d, in sampling periods
X0 = 3  # initial position x0
V0 = 4  # initial velocity v0
OFFSET = 5  # acceleration o by the constant force
FRICTION = 6  # deceleration c by the Coulomb friction
N_COLUMNS = 7


class SlipParts(NamedTuple):
    """Velocities in the two parts of all periods, arrays of shape (2, periods), and the stops of the mass."""

    start: np.ndarray  # velocity at the start of each part
    end: np.ndarray  # velocity at the end of each part
    direction: np.ndarray  # direction of motion s at the start of each part: 1, -1, or 0 if the mass sticks
    sticks: np.ndarray  # mask of the parts in which the mass sticks
    # Four arrays with one entry per stop: part (0 or 1), period, time from the start of the part to the stop, and
    # direction after the stop.
    stops: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class ModelResponse:
    """Sampled positions of a model, and their derivatives with respect to the parameters, computed on demand."""

    position: np.ndarray
    differentiate: Callable[[], np.ndarray]

    @cached_property
    def derivatives(self) -> np.ndarray:
        """The derivatives of the positions, one row per sample and one column per parameter."""
        return self.differentiate()


@dataclass(frozen=True)
class Recording:
    """A log with evenly spaced samples.

    The first ``skip`` samples only provide past forces; their positions are not included.
    """

    force: np.ndarray  # force commanded at each sample, including the first ``skip`` ones
    position: np.ndarray  # measured positions, from sample ``skip`` on
    skip: int

    @cached_property
    def recent_forces(self) -> np.ndarray:
        """The two forces that act in the period before each sample k if 0 <= d < 1, the later one in the first row.

        The first row contains the force commanded at sample k - 1, the second row that at sample k - 2; forces before
        the log are 0. Two further columns repeat the last force, because a search may evaluate negative delays.
        """
        force = np.concatenate([[0.0, 0.0], self.force, self.force[-1:], self.force[-1:]])
        return np.array([force[1:-1], force[:-2]])

    def truncate(self, count: int) -> Recording:
        """Return the log, cut off ``count`` positions after the first change of the force.

        Positions before the first change are kept but not counted, because they contain little information.
        """
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
    ) -> ModelResponse:
        """Simulate the mass under the forces of the log, and return its positions from sample ``skip`` on.

        The derivatives of the result have the columns `G` to `FRICTION`. The arguments are the symbols of the module,
        with times in sampling periods; ``offset`` is the acceleration o and ``friction`` the deceleration c.
        """
        n_delay = int(np.floor(d))
        past = self.force[self.skip - n_delay - 1 :][: self.position.size]
        force, spans = np.array([past[:-1], past[1:]]), np.array([d - n_delay, n_delay + 1.0 - d])
        acceleration, phi = g * force + offset, phi_functions(delta * spans)
        integrate = _integrate_with_friction if friction else _integrate_without_friction
        parts = integrate(acceleration, spans, phi, delta, v0, friction)
        moved, differentiate = _integrate_positions(parts, force, acceleration, spans, phi, delta, friction)
        return ModelResponse(x0 + np.append(0.0, moved), differentiate)


def _integrate_without_friction(
    acceleration: np.ndarray, spans: np.ndarray, phi: PhiFunctions, delta: float, v0: float, friction: float
) -> SlipParts:
    """Compute the velocities of a mass without friction at the ends of all parts, by a linear recursion.

    Args:
        acceleration: acceleration by the forces in each part, shape (2, periods).
        spans: durations of the two parts, f and 1 - f.
        phi: phi-functions of ``delta * spans``.
        delta: damping b T/m.
        v0: velocity at the first sample.
        friction: ignored; it exists because `_integrate_with_friction` has the same arguments.
    """
    gains = (spans * phi.phi1)[:, None] * acceleration
    late = recur(phi.c[0] * phi.c[1], phi.c[1] * gains[0] + gains[1], v0)
    start = np.append(v0, late[:-1])
    middle, none = phi.c[0] * start + gains[0], np.zeros(0, int)
    still = np.zeros_like(gains)
    return SlipParts(
        np.array([start, middle]), np.array([middle, late]), still, still > 0, (none, none, 0.0 * none, none)
    )


def _integrate_with_friction(
    acceleration: np.ndarray, spans: np.ndarray, phi: PhiFunctions, delta: float, v0: float, friction: float
) -> SlipParts:
    """Compute the velocities of a mass with friction at the ends of all parts, and the stops of the mass.

    The arguments are those of `_integrate_without_friction`; ``friction`` is the deceleration c.
    """
    count, slow, rates = acceleration.size, phi.c.tolist(), (spans * phi.phi1).tolist()
    # Number all parts k in the order of time; part k starts at time t_k with velocity v_k. Let G_k be s v_k of a mass
    # that starts at rest and always moves in the direction s. Because the motion between two stops is linear, a mass
    # with velocity v_m at t_m then has s v_k = G_k + (s v_m - G_m) e^(-delta (t_k - t_m)).
    by_forces, by_friction = (
        np.append(0.0, _integrate_without_friction(each, spans, phi, delta, 0.0, 0.0).end.T)
        for each in (acceleration, np.full(acceleration.shape, friction))
    )
    acceleration = acceleration.T.ravel()
    gained = {s: s * by_forces - by_friction for s in (1.0, -1.0)}
    # List the parts in which the forces exceed the friction, because a sticking mass starts to move in the next one.
    able = np.flatnonzero(np.abs(acceleration) > friction)
    decay = np.exp(-delta * np.arange(count // 2 + 1))
    # Tabulate the decay e^(-delta t) at all later starts of parts, with the time t counted from the start of the first
    # or of the second part of a period.
    decays = [np.outer(decay, [1.0, each]).ravel() for each in slow]
    # In the loop, part m starts with velocity v in the direction s. `changes` collects the parts at whose start the
    # direction changes, with the new direction.
    m, v, s = 0, v0, float(np.sign(v0))
    changes, stops = [(0, s)], []
    while m < count:
        if s == 0.0:
            # Skip the parts in which the mass sticks, up to the next part in which the forces exceed the friction.
            after = able.searchsorted(m)
            if after == able.size:
                break
            m, v = int(able[after]), 0.0
            s = 1.0 if acceleration[m] > 0 else -1.0
            changes.append((m, s))
        # Search for the next part at whose end s v <= 0. Test parts in blocks of increasing size, because the next stop
        # is usually near.
        gain, decay, first, size = gained[s], decays[m % 2], m + 1, 128
        ahead = s * v - gain.item(m)  # the term s v_m - G_m of the formula above
        while first <= count:
            last = min(first + size, count + 1)
            stopped = gain[first:last] + ahead * decay[first - m : last - m] <= 0.0
            if stopped[k := int(stopped.argmax())]:
                break
            first, size = last, 4 * size
        else:
            break
        k += first - 1
        v, forced, part = s * max(0.0, gain.item(k) + ahead * decay.item(k - m)), acceleration.item(k), k % 2
        m, h, a = k + 1, spans.item(part), forced - s * friction
        if not (a * s < 0.0 and h > 0.0):
            # Continue without a stop if the mass does not decelerate, because s v <= 0 at the end of the part is then a
            # rounding error.
            v = slow[part] * v + rates[part] * a
            continue
        # Compute the time from the start of the part to the stop: first without damping, then corrected for damping.
        before = -v / a
        before = min(log1p(delta * before) / delta if delta else before, h)
        rest, s = h - before, -s if abs(forced) > friction else 0.0
        # Compute the velocity that a mass starting from rest at the stop has at the end of the part.
        v = (-expm1(-delta * rest) / delta if delta else rest) * (forced - s * friction) if s else 0.0
        stops.append((k, before, s, v))
        changes.append((k + 1, s))
    starts, directions = np.array(changes).T
    direction = np.repeat(directions, np.diff(np.append(starts, count)).astype(int))
    sticks = direction == 0
    # Recompute all velocities by a linear recursion, because the loop has computed only those at starts of motion and
    # at stops.
    factors = np.where(sticks, 0.0, np.tile(slow, count // 2))
    added = np.tile(rates, count // 2) * (acceleration - direction * friction)
    added[sticks] = 0.0
    k, before, after, velocities = np.reshape(stops, (-1, 4)).T
    k = k.astype(int)
    # Restart the recursion after each stop, because the velocity after a stop does not depend on that before it.
    factors[k], added[k] = 0.0, velocities
    end = recur(factors, added, v0)
    start, end, direction, sticks = (
        np.ascontiguousarray(each.reshape(-1, 2).T) for each in (np.append(v0, end[:-1]), end, direction, sticks)
    )
    return SlipParts(start, end, direction, sticks, (k % 2, k // 2, before, after))


def _integrate_positions(
    parts: SlipParts,
    force: np.ndarray,
    acceleration: np.ndarray,
    spans: np.ndarray,
    phi: PhiFunctions,
    delta: float,
    c: float,
) -> tuple[np.ndarray, Callable[[], np.ndarray]]:
    """Integrate the velocities of the mass to displacements; also return a function that computes their derivatives.

    Args:
        parts: velocities in the parts of all periods, and stops.
        force: delayed force in each part, shape (2, periods).
        acceleration: acceleration by all forces but the friction, shape (2, periods).
        spans: durations of the two parts, f and 1 - f.
        phi: phi-functions of ``delta * spans``.
        delta: damping b T/m.
        c: deceleration by the Coulomb friction.

    Returns:
        The displacements from the first sample to the end of each period, and a function that returns the derivatives
        of the positions at all samples, with the columns `G` to `FRICTION`.
    """
    v, end, direction, sticks, (*k, t, direction_after) = parts
    k = tuple(k)
    span, phi = spans[:, None], PhiFunctions(*(each[:, None] for each in phi))
    a = np.where(sticks, 0.0, acceleration - direction * c)
    moved = phi.phi1 * span * v + phi.phi2 * span**2 * a
    # Divide each part with a stop into the time t before the stop and the time r after it.
    sticks_after, r = direction_after == 0, spans[k[0]] - t
    a_after = np.where(sticks_after, 0.0, acceleration[k] - direction_after * c)
    both = phi_functions(delta * np.append(t, r))
    phi_before, phi_after = (PhiFunctions(*(each[part] for each in both)) for part in np.s_[: t.size, t.size :])
    moved[k] = t * phi_before.phi1 * v[k] + t**2 * phi_before.phi2 * a[k] + r**2 * phi_after.phi2 * a_after

    def differentiate() -> np.ndarray:
        # The axes of ``by`` are: displacement or end velocity; parameter; part; period.
        by = _differentiate_segment(phi, delta, span, v, a, force, direction, sticks)
        # Compute the derivatives of the end velocity and of the displacement with respect to the start velocity, and
        # the acceleration v' at the end. The end velocity of a sticking mass does not depend on its start velocity.
        velocity_by_v, moved_by_v, rate = np.where(sticks, 0.0, phi.c), by[1, OFFSET].copy(), a - delta * end
        if t.size:
            rate[k] = a_after - delta * end[k]
            # Include the shift of the stop: a change of the velocity just before the stop shifts its time by -1/a times
            # this change.
            velocity_shift, shift = rate[k] / a[k], end[k] / a[k]
            moved_by_v[k] = t * phi_before.phi1 + shift * phi_before.c
            velocity_by_v[k] = velocity_shift * phi_before.c
            before = _differentiate_segment(phi_before, delta, t, v[k], a[k], force[k], direction[k], sticks[k])
            after = _differentiate_segment(
                phi_after, delta, r, 0.0 * r, a_after, force[k], direction_after, sticks_after
            )
            by[0][:, *k], by[1][:, *k] = before[0] + shift * before[1] + after[0], velocity_shift * before[1] + after[1]
        # A longer delay extends the first part and shortens the second one. Therefore the derivatives of displacement
        # and end velocity with respect to the delay are the velocity and the acceleration at the end of the part, with
        # a negative sign for the second part.
        by[:, DELAY] = np.array([end, rate]) * [[1.0], [-1.0]]
        # Combine the derivatives of the two parts of each period, and compute those of the velocities at the start of
        # all periods by a recursion.
        (place, late_place), (speed, late_speed) = np.moveaxis(by, 2, 1)
        (moved_by_v, late_moved_by_v), (velocity_by_v, late_velocity_by_v) = moved_by_v, velocity_by_v
        unit = np.eye(N_COLUMNS)
        starts = recur(velocity_by_v * late_velocity_by_v, (late_velocity_by_v * speed + late_speed).T, unit[V0])[:-1].T
        place = place + late_place + late_moved_by_v * speed
        place += (moved_by_v + late_moved_by_v * velocity_by_v) * np.column_stack([unit[V0], starts])
        return np.cumsum(np.column_stack([unit[X0], place]), axis=1).T

    return np.cumsum(moved[0] + moved[1]), differentiate


def _differentiate_segment(phi: PhiFunctions, delta: float, t: np.ndarray, *segment: np.ndarray) -> np.ndarray:
    """Differentiate the displacement and the end velocity of intervals with constant a, at fixed start velocity.

    Args:
        phi: phi-functions of ``delta * t``.
        delta: damping b T/m.
        t: durations of the intervals.
        segment: start velocity, acceleration a, force, direction, and mask of the intervals in which the mass sticks.

    Returns:
        An array of shape (2, 7, ...). The first axis is displacement and end velocity, the second the parameters `G` to
        `FRICTION`. The derivatives with respect to the delay and the initial state are 0.
    """
    v, a, force, direction, sticks = segment
    minus_phi2_slope = np.where(delta * t == 0, 1.0 / 6.0, phi.gap / np.where(delta * t == 0, 1.0, delta * t))
    by = np.zeros((2, N_COLUMNS, *v.shape))
    by[0, DELTA] = -(t**2) * phi.psi * v - t**3 * minus_phi2_slope * a
    by[1, DELTA] = -t * phi.c * v - t**2 * phi.psi * a
    by[0, OFFSET], by[1, OFFSET] = np.where(sticks, 0.0, t**2 * phi.phi2), np.where(sticks, 0.0, t * phi.phi1)
    by[:, G], by[:, FRICTION] = force * by[:, OFFSET], -direction * by[:, OFFSET]
    return by


def recur(factor: np.ndarray | complex, added: np.ndarray, begin: float | np.ndarray = 0.0) -> np.ndarray:
    """Solve the real or complex linear recursion ``y_k = factor_k y_(k-1) + added_k``, and return all y_k.

    Args:
        factor: factors along the axis k; a scalar applies to all k.
        added: added terms; the first axis is k, further axes are independent recursions.
        begin: initial value, the y before the first k.
    """
    from scipy.linalg.lapack import dtbtrs, ztbtrs  # pyright: ignore[reportAttributeAccessIssue]  (made at import)

    right = np.array(added, dtype=np.result_type(factor, added, float), order="F")
    first, later = (factor[0], factor[1:]) if isinstance(factor, np.ndarray) else (factor, factor)
    right[0] += first * begin
    # Create the band matrix as a transpose, because this is LAPACK's memory layout and avoids a copy.
    band = np.empty((len(right), 2), right.dtype).T
    band[1, :-1] = np.negative(later)
    solve = ztbtrs if right.dtype == complex else dtbtrs
    return solve(band, right, uplo="L", diag="U", overwrite_b=1)[0].reshape(right.shape)
