"""Compute gain, phase, modulus and delay margin of walls in any linear loop, from all crossovers of the open loop.

On the unit circle the open loop is ``L = -(alpha + beta F)/q`` (q and F as in `stability.linear.roots`). It is
tabulated at the nodes of `stability.linear.curve`, which resolve q and F; intervals in which the controller ``alpha +
beta F`` is nearly 0 are halved. Between neighboring nodes |L| and its phase hardly change. Crossovers are found at sign
changes between nodes, and next to a minimum of the magnitude from which tangents at both nodes reach zero.

Delay margin: one more period of delay changes the phase of L by the angle w and nothing else. At a gain crossover with
the phase ``p = arg(-L)``, a pole is therefore on the unit circle after m more periods if ``p - m w`` is a multiple of 2
pi. Therefore loops with delays within one period suffice for all longer delays: if m passes an integer between two of
them, Newton's method solves for the delay, with the exact loop of each iterate. A real pole reaches z = -1 where
``|L(-1)|`` passes 1. Counts of the unstable poles below and above must confirm the smallest of these delays. A *chain*
is the plant of a scene with its delay (`plant.sampled_states`).
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from dataclasses import replace
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import within
from zwidth.model.circle_functions import CirclePoints, Jet, circle_points
from zwidth.model.mechanism import AnyChain
from zwidth.numerics.root_finding import find_zeros_between
from zwidth.stability.linear.boundary import Boundary
from zwidth.stability.linear.curve import place_nodes
from zwidth.stability.linear.poles import compute_log_radius
from zwidth.stability.linear.roots import LoopRoots, find_roots
from zwidth.stability.linear.rows import label_walls
from zwidth.stability.results import Margins
from zwidth.units.quantities import WALL_RANGE

# Largest number of halvings of an interval between two nodes near a zero of the controller.
MAX_HALVINGS = 40
MAX_CONTROLLER_CHANGE = 0.25  # largest change of the controller between neighboring nodes, relative to its magnitude

POLE_AT_ONE = 1e-13  # distance from z = 1 below which a pole counts as a pole at z = 1
ZERO_OF_L = 1e-10  # value of |L| below which L counts as 0, relative to w |dL/dw|


class OpenLoop(NamedTuple):
    """The open loop L with one wall, tabulated at angles that resolve it."""

    loop: LoopRoots
    alpha: float
    beta: float
    w: np.ndarray
    L: Jet

    @classmethod
    def tabulate(cls, loop: LoopRoots, alpha: float, beta: float, nodes: np.ndarray) -> OpenLoop:
        """Return L for one wall, tabulated at the nodes and, near zeros of the controller, between them."""
        w = np.append(nodes[nodes < np.pi], np.pi)
        n_integrators = int(np.count_nonzero(np.abs(loop.poles) <= POLE_AT_ONE))
        first_gain = abs(alpha * loop.evaluate_response(circle_points(w[:1])).value[0])
        if n_integrators and 0.0 < first_gain < 1.0:
            # If the device has poles at z = 1, |L| grows without limit as w -> 0. With a small stiffness, the gain
            # crossover may lie below all nodes, so add nodes at lower angles.
            octaves = 1.0 - np.log2(first_gain) / n_integrators
            w = np.concatenate([w[0] * np.exp2(-np.linspace(octaves, 1.0, int(np.ceil(octaves)))), w])
        for _ in range(MAX_HALVINGS):
            f = loop.estimate.jet(circle_points(w))
            controller = np.abs(alpha + beta * f.value)
            step = np.diff(w)
            change = np.abs(beta * np.diff(f.value))
            wide = (change > MAX_CONTROLLER_CHANGE * np.maximum(controller[:-1], controller[1:])) & (
                step > 1e-9 * w[1:]
            )
            if not wide.any():
                break
            w = np.sort(np.concatenate([w, w[:-1][wide] + 0.5 * step[wide]]))
        return cls(loop, alpha, beta, w, open_loop_response(loop, alpha, beta, circle_points(w)))

    def evaluate(self, w: np.ndarray) -> Jet:
        """Return L and its derivative in w at angles ``w``."""
        return open_loop_response(self.loop, self.alpha, self.beta, circle_points(w))

    def evaluate_at_one(self) -> float | None:
        """Return L at z = 1; None if it is infinite or 0."""
        value = self.evaluate(np.zeros(1)).value[0]
        return float(value.real) if np.isfinite(value) and value.real != 0 else None

    def find_gain_crossovers(self) -> np.ndarray:
        """Return the angles at which ``|L| = 1``, ascending."""

        def log_gain(jet: Jet) -> tuple[np.ndarray, np.ndarray]:
            """Return ``log|L|`` and its derivative in w."""
            with np.errstate(all="ignore"):
                return np.log(np.abs(jet.value)), (jet.slope / jet.value).real

        return self._find_zeros(log_gain)

    def find_phase_crossovers(self) -> np.ndarray:
        """Return the angles in (0, pi] at which L is real and negative, ascending."""

        def phase_sine(jet: Jet) -> tuple[np.ndarray, np.ndarray]:
            """Return the sine of arg L and its derivative in w."""
            with np.errstate(all="ignore"):
                unit = jet.value / np.abs(jet.value)
                return unit.imag, unit.real * (jet.slope / jet.value).imag

        # Add the angle pi, because L is always real there.
        w = np.append(self._find_zeros(phase_sine, stop=-1), np.pi)
        L = self.evaluate(w)
        # Exclude zeros of L, where the phase jumps: for no gain is L = -1 at these points, so no pole can lie there.
        return w[(L.value.real < 0) & (np.abs(L.value) > ZERO_OF_L * w * np.abs(L.slope))]

    def _find_zeros(
        self, function: Callable[[Jet], tuple[np.ndarray, np.ndarray]], stop: int | None = None
    ) -> np.ndarray:
        """Return the angles at which a real function of L is zero.

        Args:
            function: maps L to values and derivatives in w.
            stop: index of the node before which the search stops.
        """
        w, L = self.w[:stop], Jet(*(part[:stop] for part in self.L))
        value, slope = function(L)
        minima = self._find_minima(function, w, value, slope)
        if minima.size:
            w = np.sort(np.concatenate([w, minima]))
            value, slope = function(self.evaluate(w))
        k = np.flatnonzero((value[:-1] > 0) != (value[1:] > 0))
        return find_zeros_between(lambda angles: function(self.evaluate(angles))[0], w, value, k)

    def _find_minima(
        self,
        function: Callable[[Jet], tuple[np.ndarray, np.ndarray]],
        w: np.ndarray,
        value: np.ndarray,
        slope: np.ndarray,
    ) -> np.ndarray:
        """Return the angles of minima of |function| between nodes where it has equal signs and a tangent reaches 0."""
        step, sign = np.diff(w), np.sign(value[:-1])
        approaching = (np.sign(value[1:]) == sign) & (sign * slope[:-1] < 0) & (sign * slope[1:] > 0)
        size, descent = np.abs(value), np.abs(slope)
        # Ignore NaN, which occurs because L may be 0 at the Nyquist frequency, where log|L| has no tangent.
        with np.errstate(invalid="ignore"):
            lowest = np.minimum(size[:-1] - descent[:-1] * step, size[1:] - descent[1:] * step)
        k = np.flatnonzero(approaching & (lowest < 0))
        return find_zeros_between(lambda angles: function(self.evaluate(angles))[1], w, slope, k)

    def find_least_distance(self) -> tuple[float, float]:
        """Return the modulus margin, that is, the minimum of ``|1 + L|``, and the angle at which it is reached."""

        def slope(jet: Jet) -> np.ndarray:
            """Return half the derivative of ``|1 + L|^2`` in w."""
            return ((1.0 + jet.value).conj() * jet.slope).real

        distance, rising = np.abs(1.0 + self.L.value), np.nan_to_num(slope(self.L))
        k = np.flatnonzero((rising[:-1] <= 0) & (rising[1:] > 0))
        k = k[np.minimum(distance[k], distance[k + 1]) < 2.0 * np.nanmin(distance)]
        angles = np.concatenate([self.w, find_zeros_between(lambda w: slope(self.evaluate(w)), self.w, rising, k)])
        distances = np.concatenate([distance, np.abs(1.0 + self.evaluate(angles[self.w.size :]).value)])
        at_one = self.evaluate_at_one()
        if at_one is not None:
            angles, distances = np.append(angles, 0.0), np.append(distances, abs(1.0 + at_one))
        best = int(np.nanargmin(distances))
        return float(distances[best]), float(angles[best])


def open_loop_response(loop: LoopRoots, alpha: Array, beta: Array, points: CirclePoints) -> Jet:
    """Return L of walls and its derivative in w at points of the unit circle, for arrays that broadcast."""
    with np.errstate(all="ignore"):
        f = loop.estimate.jet(points)
        L = Jet(alpha + beta * f.value, beta * f.slope).times(loop.evaluate_response(points))
        # Set the imaginary part of L at w = pi to 0, because L is real there and only a rounding error would remain.
        is_nyquist = points.w >= np.pi
        return Jet(np.where(is_nyquist, L.value.real + 0j, L.value), L.slope)


def compute_wall_margins(wall: OpenLoop, stable: bool, wanted: Container[str]) -> Margins:
    """Return the margins of one wall except the delay margin, which needs loops with other delays.

    Args:
        wall: the open loop.
        stable: True if the closed loop is stable.
        wanted: names of the margins; the others are NaN.
    """
    result = Margins(*[np.nan] * len(Margins._fields))
    if "gain_margin" in wanted:
        w = wall.find_phase_crossovers()
        gains, at_one = np.abs(wall.evaluate(w).value), wall.evaluate_at_one()
        if at_one is not None and at_one < 0:
            w, gains = np.append(w, 0.0), np.append(gains, -at_one)
        margin, angle = select_gain_margin(stable, w, gains)
        result = result._replace(gain_margin=margin, phase_crossover=angle)
    if "phase_margin" in wanted:
        w = wall.find_gain_crossovers()
        margin, angle = select_phase_margin(stable, w, np.angle(-wall.evaluate(w).value))
        result = result._replace(phase_margin=margin, gain_crossover=angle)
    if "modulus_margin" in wanted:
        distance, angle = wall.find_least_distance()
        result = result._replace(modulus_margin=distance, modulus_frequency=angle)
    return result


def select_gain_margin(stable: bool, w: np.ndarray, gains: np.ndarray) -> tuple[float, float]:
    """Return the gain margin, from the gain closest to 1 on a logarithmic scale, and the angle of its phase crossover.

    Args:
        stable: True if the closed loop is stable.
        w: phase crossovers, shape (crossovers,).
        gains: |L| at the phase crossovers, shape (crossovers,).

    Returns:
        The factor of the gain that puts a pole on the unit circle, and the angle of this pole. Without crossovers the
        margin is inf for a stable loop and 0 for an unstable one, and the angle is NaN.
    """
    if not w.size:
        return np.inf if stable else 0.0, np.nan
    nearest = int(np.argmin(np.abs(np.log(gains))))
    return float(1.0 / gains[nearest]), float(w[nearest])


def select_phase_margin(stable: bool, w: np.ndarray, phases: Array) -> tuple[float, float]:
    """Return the phase margin in degrees, negative for an unstable loop, and the angle of its gain crossover.

    Args:
        stable: True if the closed loop is stable.
        w: gain crossovers, shape (crossovers,).
        phases: arg(-L) at the gain crossovers in rad, shape (crossovers,).

    Returns:
        The margin and the angle of the crossover. Without crossovers the margin is inf for a stable loop and NaN for an
        unstable one, and the angle is NaN.
    """
    if not w.size:
        return np.inf if stable else np.nan, np.nan
    degrees = np.degrees(np.abs(phases))
    nearest = int(np.argmin(degrees))
    return float(degrees[nearest] * (1.0 if stable else -1.0)), float(w[nearest])


# Delays at which the gain crossovers are computed for the delay margin.
N_PARTS = 8  # number of these delays per period
# The number of crossovers may differ between two neighboring delays. The crossovers at both delays whose m (see the
# module docstring) differs from an integer by at most START_ERROR/N_PARTS are then starting points of Newton's method.
START_ERROR = 1.5
# Distances of further delays from the integer above them, in time constants of the fastest pole. These delays are
# needed because a strongly damped device tolerates less delay within ln 2 time constants below an integer than at the
# integer.
EARLY_DELAYS = np.array([1.0, 0.5, 0.25, 0.1])
FAST_RATE = 2.0  # decay rate of the fastest pole, per period, above which these delays are added

# Settings of Newton's method for the delay, in periods.
DIFFERENCE_STEP = 1e-5  # step of the finite difference in the delay
RELATIVE_STEP = 1e-9  # additional step, relative to the delay
MAX_STEPS = 30
LOG_TOLERANCE = 1e-9  # largest |log(-L)| at a solution

# Added delays, relative to the computed delay margin, at which pole counts must confirm this margin.
STABLE_MULTIPLES = (0.25, 0.5, 0.75, 1.0 - 1e-5)  # the wall must be stable
UNSTABLE_MULTIPLE = 1.0 + 1e-5  # the wall must be unstable


def build_delayed_loops(chain: AnyChain) -> dict[float, tuple[LoopRoots, np.ndarray]]:
    """Return the loops with delays from that of the chain to one period more, and their nodes, by delay in periods."""
    d = float(chain.d)
    fastest = -float(np.linalg.eigvals(chain.realize().A).real.min())
    early = 1.0 - EARLY_DELAYS / fastest if fastest > FAST_RATE else np.empty(0)
    grid = np.floor(d) + np.union1d(np.arange(N_PARTS) / N_PARTS, early)
    grid = np.concatenate([grid, grid + 1.0])
    delays = np.concatenate([[d], grid[(grid > d + 1e-9) & (grid < d + 1.0 - 1e-9)], [d + 1.0]])
    return {delay: (loop := change_delay(chain, delay), place_nodes(loop)) for delay in delays.tolist()}


def change_delay(chain: AnyChain, delay: float) -> LoopRoots:
    """Return the loop of a chain after replacing its delay by ``delay``, in periods."""
    return find_roots(replace(chain, d=float(delay), n_delay=int(np.floor(delay))))


def find_delay_margin(
    chain: AnyChain, delayed: dict[float, tuple[LoopRoots, np.ndarray]], alpha: float, beta: float
) -> float:
    """Return the delay margin of a stable wall in periods.

    Args:
        chain: the chain.
        delayed: result of `build_delayed_loops` for the chain.
        alpha: normalized stiffness.
        beta: normalized damping.

    Returns:
        The margin; inf if the wall is stable with any delay, NaN if pole counts do not confirm the result.
    """
    wall, delays = (alpha, beta), list(delayed)
    loops = [OpenLoop.tabulate(loop, *wall, nodes) for loop, nodes in delayed.values()]
    crossovers = [each.find_gain_crossovers() for each in loops]
    phases = [np.mod(np.angle(-each.evaluate(w).value), 2.0 * np.pi) for each, w in zip(loops, crossovers, strict=True)]
    limits = [_solve_delay(chain, wall, w, delay) for w, delay in _list_starts(delays, crossovers, phases)]

    def evaluate_at_nyquist(delay: float) -> float:
        """Return L at z = -1, which is real, for a delay in periods."""
        return open_loop_response(change_delay(chain, delay), *wall, circle_points(np.array([np.pi]))).value[0].real

    at_nyquist = np.array([each.L.value[-1].real for each in loops])
    above = np.abs(at_nyquist) - 1.0
    k = np.flatnonzero((above[1:] > 0) != (above[:-1] > 0))
    real = find_zeros_between(lambda each: np.abs([*map(evaluate_at_nyquist, each)]) - 1.0, np.array(delays), above, k)
    # A pole is at z = -1 if L(-1) = -1. If L(-1) = 1, add one period of delay, because this changes the sign of L(-1).
    limits += (real + np.where(at_nyquist[k] < 0, 0.0, 1.0)).tolist()
    limits = [limit - float(chain.d) for limit in limits if limit > chain.d]
    if not limits:
        return np.nan if any(w.size for w in crossovers) else np.inf
    return min(limits) if _is_first_loss(chain, alpha, beta, min(limits)) else np.nan


def _list_starts(
    delays: list[float], crossovers: list[np.ndarray], phases: list[np.ndarray]
) -> Iterator[tuple[float, float]]:
    """Yield starting values of Newton's method: pairs of angle and delay near which a pole is on the unit circle.

    Args:
        delays: delays of the loops.
        crossovers: gain crossovers of each loop.
        phases: arg(-L) at these crossovers, in [0, 2 pi).
    """
    # After m = phase/w more periods of delay, L would be -1 at the crossover w if |L| did not change, as is the case
    # for an integer m. So a solution exists near each integer through which m passes between two tabulated delays. Near
    # a local minimum of m, the integer below the minimum may also be reached.
    more = [phase / w for phase, w in zip(phases, crossovers, strict=True)]
    for k, (w, after) in enumerate(pairwise(crossovers)):
        if w.size != after.size:
            # Two crossovers appear or merge between these delays, and the m of one of them may pass through an integer.
            # Start from all crossovers of both loops whose m is nearly an integer.
            for i, turn in product((k, k + 1), (0.0, 2.0 * np.pi)):
                m = (phases[i] - turn) / crossovers[i]
                integer = np.round(m)
                near = (np.abs(m - integer) <= START_ERROR / N_PARTS) & (integer >= 0.0)
                yield from zip(crossovers[i][near].tolist(), (delays[i] + m[near]).tolist(), strict=True)
            continue
        rise = np.mod(phases[k + 1] - phases[k] + np.pi, 2.0 * np.pi) - np.pi
        for turn in (0.0, 2.0 * np.pi):
            first, last = (phases[k] - turn) / w, (phases[k] + rise - turn) / after
            integer = np.maximum(np.ceil(np.minimum(first, last)), 0.0)
            for j in np.flatnonzero(integer <= np.maximum(first, last)):
                share = (integer[j] - first[j]) / (last[j] - first[j]) if first[j] != last[j] else 0.0
                delay = delays[k] + share * (delays[k + 1] - delays[k])
                yield float(w[j] + share * (after[j] - w[j])), float(delay + integer[j])
    for k, (before, middle, after) in enumerate(zip(more, more[1:], more[2:], strict=False), 1):
        if before.size == middle.size == after.size:
            lowest = (middle <= before) & (middle <= after)
            for j in np.flatnonzero(lowest & (middle - np.floor(middle) <= np.maximum(before, after) - middle)):
                yield float(crossovers[k][j]), float(delays[k] + middle[j])


def _solve_delay(chain: AnyChain, wall: tuple[float, float], w: float, delay: float) -> float:
    """Return the delay in periods that puts a pole on the unit circle, by Newton's method on log(-L); else NaN."""
    residual = np.inf
    for _ in range(MAX_STEPS):
        if not (0.0 < w < np.pi and delay >= 0.0):
            return np.nan
        points, step = circle_points(np.array([w])), DIFFERENCE_STEP + RELATIVE_STEP * delay
        L, shifted = (open_loop_response(change_delay(chain, delay + h), *wall, points) for h in (0.0, step))
        residual, d_w = np.log(-L.value[0]), L.slope[0] / L.value[0]
        d_delay = np.log(shifted.value[0] / L.value[0]) / step
        # Ignore division by zero: L does not depend on the delay if the device comes to rest within a period, and the
        # step is then NaN.
        with np.errstate(all="ignore"):
            w_step, delay_step = np.imag([d_delay * residual.conj(), residual * d_w.conj()]) / np.imag(
                d_delay * d_w.conj()
            )
        w, delay = w - w_step, delay - delay_step
        # Test convergence of the delay only, because near a narrow resonance rounding errors of w keep changing w.
        if abs(delay_step) <= 1e-14 * (1.0 + delay):
            break
    return delay if abs(residual) < LOG_TOLERANCE else np.nan


def _is_first_loss(chain: AnyChain, alpha: float, beta: float, margin: float) -> bool:
    """Return whether the wall is stable at added delays below the margin and unstable just above the margin."""
    wall = np.array([alpha]), np.array([beta])
    delays = [float(chain.d) + multiple * margin for multiple in (*STABLE_MULTIPLES, UNSTABLE_MULTIPLE)]
    logs = [compute_log_radius(change_delay(chain, delay), *wall)[0] for delay in delays]
    return all(log < 0 for log in logs[:-1]) and logs[-1] > 0


def compute_margins(
    chain: AnyChain, boundary: Boundary, alpha: np.ndarray, beta: np.ndarray, wanted: Container[str]
) -> Margins:
    """Return the margins of walls, with delays in periods and angles in rad per sample.

    Args:
        chain: the chain.
        boundary: the stability boundary of its loop.
        alpha: normalized stiffness, any shape.
        beta: normalized damping, the same shape.
        wanted: names of the margins; the others are NaN.

    Returns:
        Margins of that shape; NaN for walls out of range.
    """
    stable = label_walls(boundary, alpha, beta)
    in_range = within(alpha, WALL_RANGE) & within(beta, WALL_RANGE)
    delayed: dict[float, tuple[LoopRoots, np.ndarray]] = {}
    # Omit the delay margin of a sampled system, which does not define its response at fractional delays.
    with_delay = "delay_margin" in wanted and not chain.sampled
    out = np.full((len(Margins._fields), *alpha.shape), np.nan)
    for index in np.ndindex(alpha.shape):
        a, b, is_stable = float(alpha[index]), float(beta[index]), bool(stable[index])
        if not in_range[index]:
            continue
        margins = compute_wall_margins(OpenLoop.tabulate(boundary.loop, a, b, boundary.w), is_stable, wanted)
        delay = 0.0 if with_delay else np.nan
        if is_stable and with_delay:
            delayed = delayed or build_delayed_loops(chain)
            delay = find_delay_margin(chain, delayed, a, b)
        out[(slice(None), *index)] = margins._replace(delay_margin=delay)
    return Margins(*(part[()] for part in out))
