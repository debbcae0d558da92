"""Exact response of a damped mass with Coulomb friction to a logged force with delay and zero-order hold.

In sampling periods, with g = T^2/m, the velocity v of a mass that moves in the direction s = sign(v) obeys

    v' = -delta v + a,    a = g F(t - d) + o - s c,    delta = b T/m,    o = g f0,    c = g F_c,

with a constant force f0 and the Coulomb friction F_c. x0 and v0 are the position and velocity at the first sample. In
each period the delayed force F(t - d) changes once, at the fractional part f of the delay. The period therefore has two
*parts* of durations f and 1 - f in which a is constant.

Within a part the velocity approaches a/delta exponentially, so it reaches 0 at most once. At such a *stop* the mass
sticks if ``|g F + o| <= c``; otherwise it reverses. The time of the stop follows from a logarithm. Before and after it
the velocity and position have a closed form in the phi-functions of `zwidth.arrays.held_mass`. The derivatives in the
parameters are exact, too: a change dv of the velocity near the stop shifts its time by -dv/a.

Stops are found one after another in Python; everything else is vectorized, and linear recursions are solved by LAPACK.
JAX is not used, because it would compile for seconds for every length of a log.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import expm1, log1p
from typing import NamedTuple

import numpy as np

from zwidth.arrays.held_mass import PhiFunctions, phi_functions

# Columns of the derivatives of `Recording.move`, by parameter.
G = 0  # T^2/m
DELTA = 1  # b T/m
DELAY = 2  # d, in periods
X0 = 3  # initial position
V0 = 4  # initial velocity
OFFSET = 5  # o, acceleration by the constant force
FRICTION = 6  # c, deceleration by the Coulomb friction
N_COLUMNS = 7


class SlipParts(NamedTuple):
    """The two parts of all periods, arrays of shape (2, periods), and the stops within them."""

    start: np.ndarray  # velocity at the start of each part
    end: np.ndarray  # velocity at its end
    direction: np.ndarray  # direction of motion at its start: 1, -1, or 0 if the mass sticks
    sticks: np.ndarray  # mask of the parts in which the mass sticks
    stops: tuple[np.ndarray, ...]  # four arrays: part (0 or 1), period, time before the stop, direction after it


@dataclass(frozen=True)
class ModelResponse:
    """Sampled positions of a model, and their derivatives in its parameters, computed on first use."""

    position: np.ndarray
    differentiate: Callable[[], np.ndarray]

    @cached_property
    def derivatives(self) -> np.ndarray:
        """The derivatives of the positions, one row per sample and one column per parameter."""
        return self.differentiate()


@dataclass(frozen=True)
class Recording:
    """A log at even times. The first ``skip`` samples only provide past forces; their positions are not included."""

    force: np.ndarray  # force commanded at each sample
    position: np.ndarray  # measured positions from sample ``skip`` on
    skip: int

    @cached_property
    def recent_forces(self) -> np.ndarray:
        """Forces of samples k - 1 and k - 2 for each sample k, two rows; the force before the log is 0.

        With an integer delay of 0, they act during the period before sample k. The array has two more columns, with the
        last force repeated, because a search may evaluate negative delays.
        """
        force = np.concatenate([[0.0, 0.0], self.force, self.force[-1:], self.force[-1:]])
        return np.array([force[1:-1], force[:-2]])

    def truncate(self, count: int) -> Recording:
        """Return the log up to ``count`` positions after the first change of the force.

        Positions before this change contain little information and are not counted.
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
        """Return the response of the mass at the samples with positions.

        The derivatives have the columns `G` to `FRICTION`. Units are sampling periods; ``offset`` and ``friction`` are
        the accelerations o and c.
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
    """Return the velocities of a mass without friction; ``friction`` is ignored.

    Args:
        acceleration: acceleration by the forces in each part, shape (2, periods).
        spans: durations of the two parts.
        phi: phi-functions of ``delta * spans``.
        delta: damping b T/m.
        v0: velocity at the first sample.
        friction: deceleration c by the Coulomb friction, for a common signature with `_integrate_with_friction`.
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
    """Return the velocities of a mass with friction, and its stops; arguments as `_integrate_without_friction`."""
    count, slow, rates = acceleration.size, phi.c.tolist(), (spans * phi.phi1).tolist()
    # All parts are treated in the order of time. Let G_k be s v at the end of part k for a mass that starts at rest and
    # always moves in the direction s. From velocity v_m at time t_m on, linearity gives
    # s v_k = G_k + (s v_m - G_m) e^(-delta (t_k - t_m)).
    by_forces, by_friction = (
        np.append(0.0, _integrate_without_friction(each, spans, phi, delta, 0.0, 0.0).end.T)
        for each in (acceleration, np.full(acceleration.shape, friction))
    )
    acceleration = acceleration.T.ravel()
    gained = {s: s * by_forces - by_friction for s in (1.0, -1.0)}
    # Parts in which the forces can move a mass that sticks.
    able = np.flatnonzero(np.abs(acceleration) > friction)
    decay = np.exp(-delta * np.arange(count // 2 + 1))
    # Decay since the start of a first or of a second part.
    decays = [np.outer(decay, [1.0, each]).ravel() for each in slow]
    # Part m starts with velocity v in the direction s; `changes` lists the parts at which the direction changes.
    m, v, s = 0, v0, float(np.sign(v0))
    changes, stops = [(0, s)], []
    while m < count:
        if s == 0.0:
            # The mass sticks until the forces exceed the friction.
            after = able.searchsorted(m)
            if after == able.size:
                break
            m, v = int(able[after]), 0.0
            s = 1.0 if acceleration[m] > 0 else -1.0
            changes.append((m, s))
        # Find the next part at whose end s v <= 0, in windows of increasing size.
        gain, decay, first, size = gained[s], decays[m % 2], m + 1, 128
        ahead = s * v - gain.item(m)  # s v_m - G_m
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
            # The sign of s v at the end of the part is a rounding error: the mass does not decelerate.
            v = slow[part] * v + rates[part] * a
            continue
        # The time from the start of the part to the stop, first without and then with damping.
        before = -v / a
        before = min(log1p(delta * before) / delta if delta else before, h)
        rest, s = h - before, -s if abs(forced) > friction else 0.0
        # The velocity at the end of the part, from rest at the stop.
        v = (-expm1(-delta * rest) / delta if delta else rest) * (forced - s * friction) if s else 0.0
        stops.append((k, before, s, v))
        changes.append((k + 1, s))
    starts, directions = np.array(changes).T
    direction = np.repeat(directions, np.diff(np.append(starts, count)).astype(int))
    sticks = direction == 0
    # With known directions and stops, the velocities obey a linear recursion.
    factors = np.where(sticks, 0.0, np.tile(slow, count // 2))
    added = np.tile(rates, count // 2) * (acceleration - direction * friction)
    added[sticks] = 0.0
    k, before, after, velocities = np.reshape(stops, (-1, 4)).T
    k = k.astype(int)
    # The velocity after a stop does not depend on that before it.
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
    """Integrate the velocities.

    Args:
        parts: the velocities and stops.
        force: delayed force in each part, shape (2, periods).
        acceleration: acceleration by all forces but the friction, shape (2, periods).
        spans: durations of the two parts.
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
    # Parts with a stop: t before it, r after it.
    sticks_after, r = direction_after == 0, spans[k[0]] - t
    a_after = np.where(sticks_after, 0.0, acceleration[k] - direction_after * c)
    both = phi_functions(delta * np.append(t, r))
    phi_before, phi_after = (PhiFunctions(*(each[part] for each in both)) for part in np.s_[: t.size, t.size :])
    moved[k] = t * phi_before.phi1 * v[k] + t**2 * phi_before.phi2 * a[k] + r**2 * phi_after.phi2 * a_after

    def differentiate() -> np.ndarray:
        # Axes: displacement and end velocity; parameter; part; period.
        by = _differentiate_segment(phi, delta, span, v, a, force, direction, sticks)
        # Derivatives of the end velocity and of the displacement in the start velocity, and v' at the end. The end
        # velocity of a mass that sticks does not depend on its start velocity.
        velocity_by_v, moved_by_v, rate = np.where(sticks, 0.0, phi.c), by[1, OFFSET].copy(), a - delta * end
        if t.size:
            rate[k] = a_after - delta * end[k]
            # A change of the velocity just before the stop shifts the stop by -1/a times this change.
            velocity_shift, shift = rate[k] / a[k], end[k] / a[k]
            moved_by_v[k] = t * phi_before.phi1 + shift * phi_before.c
            velocity_by_v[k] = velocity_shift * phi_before.c
            before = _differentiate_segment(phi_before, delta, t, v[k], a[k], force[k], direction[k], sticks[k])
            after = _differentiate_segment(
                phi_after, delta, r, 0.0 * r, a_after, force[k], direction_after, sticks_after
            )
            by[0][:, *k], by[1][:, *k] = before[0] + shift * before[1] + after[0], velocity_shift * before[1] + after[1]
        # A longer delay extends the first part and shortens the second one, at the velocity and rate at their ends.
        by[:, DELAY] = np.array([end, rate]) * [[1.0], [-1.0]]
        # Join the two parts of each period, and chain the periods by a recursion for the start velocities.
        (place, late_place), (speed, late_speed) = np.moveaxis(by, 2, 1)
        (moved_by_v, late_moved_by_v), (velocity_by_v, late_velocity_by_v) = moved_by_v, velocity_by_v
        unit = np.eye(N_COLUMNS)
        starts = recur(velocity_by_v * late_velocity_by_v, (late_velocity_by_v * speed + late_speed).T, unit[V0])[:-1].T
        place = place + late_place + late_moved_by_v * speed
        place += (moved_by_v + late_moved_by_v * velocity_by_v) * np.column_stack([unit[V0], starts])
        return np.cumsum(np.column_stack([unit[X0], place]), axis=1).T

    return np.cumsum(moved[0] + moved[1]), differentiate


def _differentiate_segment(phi: PhiFunctions, delta: float, t: np.ndarray, *segment: np.ndarray) -> np.ndarray:
    """Return the derivatives of displacement and end velocity over an interval of constant a, at fixed start velocity.

    Args:
        phi: phi-functions of ``delta * t``.
        delta: damping b T/m.
        t: durations.
        segment: start velocity, acceleration a, force, direction, and mask of the intervals in which the mass sticks.

    Returns:
        An array of shape (2, 7, ...): displacement and end velocity, by the parameters `G` to `FRICTION`. Those in the
        delay and in the initial state are 0.
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
    """Solve the recursion ``y_k = factor_k y_(k-1) + added_k``, real or complex, with ``begin`` before the first entry.

    The first axis of ``added`` is k; a scalar ``factor`` is constant.
    """
    from scipy.linalg.lapack import dtbtrs, ztbtrs  # pyright: ignore[reportAttributeAccessIssue]  (made at import)

    right = np.array(added, dtype=np.result_type(factor, added, float), order="F")
    first, later = (factor[0], factor[1:]) if isinstance(factor, np.ndarray) else (factor, factor)
    right[0] += first * begin
    # The transpose has LAPACK's memory layout, so the matrix is not copied.
    band = np.empty((len(right), 2), right.dtype).T
    band[1, :-1] = np.negative(later)
    solve = ztbtrs if right.dtype == complex else dtbtrs
    return solve(band, right, uplo="L", diag="U", overwrite_b=1)[0].reshape(right.shape)
