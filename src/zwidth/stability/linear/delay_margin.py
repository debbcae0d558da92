"""Compute the delay margin of stable walls in any linear loop: the smallest additional delay that makes them unstable.

At a gain crossover w the open loop L has ``|L| = 1``. Each period of delay adds -w to the phase of L and leaves |L|
unchanged. At a gain crossover with ``p = arg(-L)``, a pole is therefore on the unit circle after m more periods if
``p - m w`` is a multiple of 2 pi. Loops with delays within one period, the *tabulated delays*, thus suffice for all
longer delays: if m passes an integer between two tabulated delays, Newton's method solves for the delay. A real pole
reaches z = -1 at a delay at which ``|L(-1)|`` passes 1.

Each result is confirmed: the poles outside the unit circle are counted at all shorter delays that differ from a
tabulated one by an integer, and the pole on the circle must move outward. If no shorter delay has a pole outside, and
the pole moves outward, the wall becomes unstable at this delay.

A *chain* is the plant of a scene with its delay. Discretized for any delay d = n + f (n integer, 0 <= f < 1), it has
the response

    G = z^-(n+1) C (z - e^A)^-1 ((z - 1) Gamma(1 - f) + Gamma(1))

with the state Gamma(t) after a unit force held for time t (`plant.sampled_states`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from zwidth.model.circle_functions import Jet, are_on_circle, circle_points, distances_inside
from zwidth.model.mechanism import AnyChain
from zwidth.numerics.root_finding import find_zeros_in_brackets
from zwidth.plant.sampled_states import integrate_chain
from zwidth.stability.linear.composition import find_roots
from zwidth.stability.linear.curve import place_nodes
from zwidth.stability.linear.roots import POLE_AT_ONE, LoopRoots, Terms, evaluate_controller, list_terms
from zwidth.stability.open_loop import OpenLoop, find_gain_crossovers

N_PARTS = 8  # number of delays per period at which the gain crossovers are tabulated
# Distances of additional tabulated delays from the next larger integer, in time constants of the fastest pole. They are
# needed because a strongly damped device tolerates less delay within ln 2 time constants below an integer than at the
# integer.
EARLY_DELAYS = np.array([1.0, 0.5, 0.25, 0.1])
FAST_RATE = 2.0  # decay rate of the fastest pole, per period, above which the additional delays are tabulated
# If the number of gain crossovers w differs between two neighboring tabulated delays, Newton's method starts at each of
# these crossovers at which m = arg(-L)/w differs from an integer by at most START_ERROR/N_PARTS.
START_ERROR = 1.5

# Settings of Newton's method for the delay, in periods.
MAX_STEPS = 30
CONVERGED_STEP = 1e-14  # last step of the delay, relative to 1 + delay
LOG_TOLERANCE = 1e-9  # largest |log(-L)| at a solution
NEXT_INTEGER = (
    1e-9  # largest distance above an integer, relative to 1 + m, at which m = arg(-L)/w counts as the integer
)

# Omit starting delays that exceed the smallest one of the same wall by more than this, in periods. Each starting delay
# differs less than this from its solution, so later ones cannot yield the smallest delay.
MAX_STARTS = 2.0

BATCH_WALLS = 128  # walls per batch; so many that array operations take most of the time, not the Python interpreter

# Type of a function that tabulates the open loops L of walls at given angles (arguments: loop, alpha, beta, angles).
Tabulate = Callable[[LoopRoots, np.ndarray, np.ndarray, np.ndarray], OpenLoop]


class TabulatedDelay(NamedTuple):
    """The gain crossovers of the open loops L of walls at one delay."""

    delay: float  # in periods
    w: np.ndarray  # gain crossovers, ascending, shape (walls, crossovers), padded with NaN
    phase: np.ndarray  # arg(-L) at the crossovers, in [0, 2 pi), the same shape
    at_nyquist: np.ndarray  # L at z = -1, shape (walls,)
    outside: np.ndarray  # number of closed-loop poles outside the unit circle, shape (walls,)


def list_delays(chain: AnyChain) -> list[float]:
    """Return the tabulated delays in periods, from the delay of the chain to one period more."""
    d = float(chain.d)
    fastest = -float(np.linalg.eigvals(chain.realize().A).real.min())
    early = 1.0 - EARLY_DELAYS / fastest if fastest > FAST_RATE else np.empty(0)
    grid = np.floor(d) + np.union1d(np.arange(N_PARTS) / N_PARTS, early)
    grid = np.concatenate([grid, grid + 1.0])
    return [d, *grid[(grid > d + 1e-9) & (grid < d + 1.0 - 1e-9)].tolist(), d + 1.0]


def change_delay(chain: AnyChain, delay: float) -> LoopRoots:
    """Return the loop of a chain after replacing its delay by ``delay``, in periods."""
    return find_roots(replace(chain, d=float(delay), n_delay=int(np.floor(delay))))


def find_delay_margins(chain: AnyChain, tabulate: Tabulate, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Return the delay margin of each stable wall in periods.

    Args:
        chain: device and delay.
        tabulate: function that tabulates the open loops of walls.
        alpha: normalized stiffness, shape (walls,).
        beta: normalized damping, shape (walls,).

    Returns:
        The margins; inf for a wall that is stable with any delay, NaN if the result is not confirmed.
    """
    margins = np.full(alpha.shape, np.nan)
    loops = {delay: change_delay(chain, delay) for delay in list_delays(chain)} if alpha.size else {}
    nodes = [place_nodes(loop) for loop in loops.values()]
    for start in range(0, alpha.size, BATCH_WALLS):
        part = slice(start, start + BATCH_WALLS)
        walls = alpha[part], beta[part]
        tabulated = [
            _describe(delay, loop, tabulate(loop, *walls, w), walls)
            for (delay, loop), w in zip(loops.items(), nodes, strict=True)
        ]
        margins[part] = _find_first_losses(chain, tabulated, *walls)
    return margins


def _describe(delay: float, loop: LoopRoots, wall: OpenLoop, walls: tuple[np.ndarray, np.ndarray]) -> TabulatedDelay:
    """Return the gain crossovers and the number of poles outside the unit circle, for walls at one delay."""
    with np.errstate(all="ignore"):
        w = find_gain_crossovers(wall)
        phase = np.mod(np.angle(-wall.respond(w).value), 2.0 * np.pi)
        return TabulatedDelay(delay, w, phase, wall.L.value[:, -1].real, count_outside(loop, wall, w, *walls))


def count_outside(
    loop: LoopRoots, wall: OpenLoop, crossovers: np.ndarray, alpha: np.ndarray, beta: np.ndarray
) -> np.ndarray:
    """Count the closed-loop poles of each wall outside the unit circle, by the Nyquist criterion.

    Where |L| < 1, the phase of 1 + L differs from 0 by less than pi/2. Where |L| > 1, it differs from the phase of L by
    less than pi/2. The phases of L at the crossovers therefore determine by which multiple of 2 pi the phase of 1 + L
    changes between crossovers, and no node is needed near a zero of 1 + L.

    Args:
        loop: the loop without a wall.
        wall: the open loop of each wall.
        crossovers: gain crossovers of each wall, ascending, shape (walls, crossovers), padded with NaN.
        alpha: normalized stiffness, shape (walls,).
        beta: normalized damping, shape (walls,).

    Returns:
        The counts; NaN if the gain crossovers do not match the gains at the ends of the unit circle.
    """
    w, L = wall.w, wall.L.value
    step = np.angle(L[:, 1:] / L[:, :-1])
    # At a pole of L on the unit circle, the phase of L changes by -pi, because the path passes the pole on the outside.
    poles = loop.open_poles[are_on_circle(loop.open_poles)]
    angles = np.angle(1.0 - poles)
    jumps = np.searchsorted(w, angles[(angles > 0) & (angles < np.pi)]) - 1
    step[:, jumps] -= np.where(step[:, jumps] > 0, 2.0 * np.pi, 0.0)
    # Start at a real z slightly above 1, where L is real. From there, the path around n poles at z = 1 changes the
    # phase of L by -n pi/2.
    is_integrator = np.abs(loop.open_poles) <= POLE_AT_ONE
    # Each zero at exactly z = 1 changes the phase by +pi/2; a coupling to a free tool has such a zero.
    n = int(np.count_nonzero(is_integrator) - np.count_nonzero(loop.terms[0].zeros == 0))
    sign = _find_sign(loop, is_integrator, alpha, beta)
    start = np.where(sign < 0, np.pi, 0.0)
    first = start - 0.5 * np.pi * n + np.angle(L[:, 0] * sign * 1j**n)
    phase = first[:, None] + np.pad(np.cumsum(step, -1), ((0, 0), (1, 0)))
    k = np.minimum(np.searchsorted(w, crossovers) - 1, w.size - 2)
    before = np.maximum(k, 0)
    rows = np.arange(alpha.size)[:, None]
    at_crossover = phase[rows, before] + np.angle(wall.respond(crossovers).value / L[rows, before])
    exists = np.isfinite(crossovers)
    starts_above, ends_above = np.abs(L[:, 0]) > 1.0, np.abs(L[:, -1]) > 1.0
    # The crossovers alternately end and start an interval with |L| > 1.
    side = np.where((np.arange(crossovers.shape[1]) % 2 == 0) == starts_above[:, None], 1.0, -1.0)
    turns = 2.0 * np.pi * np.where(exists, side * np.round(at_crossover / (2.0 * np.pi)), 0.0).sum(-1)
    change = turns - np.where(starts_above, start, 0.0) + np.where(ends_above, phase[:, -1], 0.0)
    is_outside = (distances_inside(loop.open_poles) < 0) & ~are_on_circle(loop.open_poles)
    unstable = np.count_nonzero(is_outside & ~is_integrator)
    matches = (exists.sum(-1) % 2 == 1) == (starts_above != ends_above)
    return np.where(matches, np.round(unstable - change / np.pi), np.nan)


def _find_sign(loop: LoopRoots, is_integrator: np.ndarray, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Return the sign of the open loop L of each wall at a real z slightly above 1.

    Args:
        loop: the loop without a wall.
        is_integrator: mask of the poles of L at z = 1.
        alpha: normalized stiffness, shape (walls,).
        beta: normalized damping, shape (walls,).
    """
    plant, terms = loop.terms
    zeros = plant.zeros[plant.zeros != 0]
    product = plant.gain * (np.prod(zeros) / np.prod(loop.open_poles[~is_integrator])).real
    if loop.inner is None:
        spring = alpha + beta * loop.estimate.jet(circle_points(np.zeros(1))).value[0].real
        return np.sign(spring * product)
    feedback = loop.inner[1].feedback
    assert feedback is not None
    R0, weights = feedback.filter, feedback.weights
    at_one = circle_points(np.zeros(1))
    P, V = (term(at_one).value[0].real for term in terms[:2])
    filtered = 1.0 if weights is None else weights.position * P + weights.velocity * V
    # R0 is the filter of the further feedback R, and ``poles`` are the offsets 1 - pole of its poles not at z = 1. The
    # sum ``spring + further`` is the controller times the product of these offsets. If R0 has poles at z = 1, R exceeds
    # the forces of spring and damper near z = 1, so that ``spring`` is 0.
    poles = R0.poles[np.abs(R0.poles) > POLE_AT_ONE]
    further = float(R0.gain) * (np.prod(R0.zeros)).real * filtered
    spring = 0.0 * alpha if poles.size < R0.poles.size else (alpha * P + beta * V) * np.prod(poles).real
    return np.sign((spring + further) * product)


class DelayedPlant:
    """The response G of the sampled plant of a chain at any angle and any delay."""

    def __init__(self, chain: AnyChain) -> None:
        """Discretize the device of the chain."""
        self.chain, (self.A, self.B, _) = chain, chain.realize()
        self.psi, self.full = integrate_chain(chain, self.A, self.B, 1.0)

    def evaluate(self, w: np.ndarray, delay: np.ndarray) -> tuple[Jet, np.ndarray]:
        """Return G with its derivative in w, and the derivative of G in the delay, at given angles and delays."""
        points, n = circle_points(w), np.floor(delay)
        psi, late = integrate_chain(self.chain, self.A, self.B, 1.0 - (delay - n))
        zeta, size = points.z_minus_1[:, None], self.B.size
        inverse = np.linalg.inv(zeta[..., None] * np.eye(size) - self.psi)
        row = inverse[:, :1] @ np.stack([zeta * late + self.full, late, zeta * (self.B + (psi @ self.B))], -1)
        resolvent = (inverse[:, 0][:, None] @ inverse @ (zeta * late + self.full)[..., None])[:, 0, 0]
        # Multiply by z^-(n + 1). The derivative of Gamma(t) is e^(A t) B.
        power, z = np.exp(-1j * (n + 1.0) * w), points.z
        value, by_zeta, by_time = row[:, 0].T
        slope = 1j * z * (by_zeta - resolvent) - 1j * (n + 1.0) * value
        return Jet(power * value, power * slope), -power * by_time


class StartingPoints(NamedTuple):
    """Starting values of Newton's method: angles and delays near which a wall has a pole on the unit circle."""

    wall: np.ndarray  # index of the wall
    w: np.ndarray
    delay: np.ndarray  # in periods


def _list_starts(tabulated: list[TabulatedDelay]) -> StartingPoints:
    """Return the starting values for all walls, from their gain crossovers at the tabulated delays."""
    # At the crossover w, L is -1 after m = phase/w more periods of delay if m is an integer, because |L| does not
    # change. A solution therefore exists near each integer that m passes between two tabulated delays. Near a local
    # minimum of m, m may also reach the integer below the minimum.
    most = max(each.w.shape[1] for each in tabulated)
    w, phase = (
        np.stack([np.pad(part, ((0, 0), (0, most - part.shape[1])), constant_values=np.nan) for part in parts])
        for parts in ([each.w for each in tabulated], [each.phase for each in tabulated])
    )
    delays, count = np.array([each.delay for each in tabulated])[:, None, None], np.isfinite(w).sum(-1, keepdims=True)
    equal, rise = count[1:] == count[:-1], np.mod(np.diff(phase, axis=0) + np.pi, 2.0 * np.pi) - np.pi
    m, starts = phase / w, []

    def add(mask: np.ndarray, w: np.ndarray, delay: np.ndarray) -> None:
        """Append the starting values that a mask of shape (delays, walls, crossovers) selects."""
        mask, w, delay = np.broadcast_arrays(mask, w, delay)
        starts.append((np.nonzero(mask)[1], w[mask], delay[mask]))

    for turn in (0.0, 2.0 * np.pi):
        first, last = (phase[:-1] - turn) / w[:-1], (phase[:-1] + rise - turn) / w[1:]
        integer = np.maximum(np.ceil(np.minimum(first, last)), 0.0)
        share = np.where(first == last, 0.0, (integer - first) / np.where(first == last, 1.0, last - first))
        delay = delays[:-1] + share * np.diff(delays, axis=0) + integer
        add(equal & (integer <= np.maximum(first, last)), w[:-1] + share * np.diff(w, axis=0), delay)
        # If two crossovers appear or merge between two delays, m may pass an integer at one of them. Start from all
        # crossovers at both delays at which m is nearly an integer.
        more = (phase - turn) / w
        near = (np.abs(more - np.round(more)) <= START_ERROR / N_PARTS) & (np.round(more) >= 0.0)
        differs = np.pad(~equal, ((1, 1), (0, 0), (0, 0)))
        add(near & (differs[1:] | differs[:-1]), w, delays + more)
    middle, least = m[1:-1], np.maximum(m[:-2], m[2:]) - m[1:-1]
    lowest = equal[1:] & equal[:-1] & (middle <= m[:-2]) & (middle <= m[2:])
    add(lowest & (middle - np.floor(middle) <= least), w[1:-1], delays[1:-1] + middle)
    return StartingPoints(*(np.concatenate(part) for part in zip(*starts, strict=True)))


def _find_first_losses(
    chain: AnyChain, tabulated: list[TabulatedDelay], alpha: np.ndarray, beta: np.ndarray
) -> np.ndarray:
    """Return the delay margins of one batch of walls in periods, as in `find_delay_margins`, from tabulated delays."""
    d, plant, terms = float(chain.d), DelayedPlant(chain), list_terms(chain)
    with np.errstate(all="ignore"):
        starts = _list_starts(tabulated)
        earliest = np.full(alpha.shape, np.inf)
        np.minimum.at(earliest, starts.wall, starts.delay)
        starts = StartingPoints(*(part[starts.delay <= earliest[starts.wall] + MAX_STARTS] for part in starts))
        walls = alpha[starts.wall], beta[starts.wall]
        pairs = starts.wall, _solve_delays(plant, terms, *walls, starts.w, starts.delay)
        real = _find_real_losses(plant, terms, tabulated, alpha, beta)
        margins = np.full(alpha.shape, np.inf)
        for wall, limit in (pairs, real):
            np.fmin.at(margins, wall, np.where(limit > d, limit - d, np.nan))
        end = d + margins * (1.0 - NEXT_INTEGER)
        confirmed = np.isfinite(margins) | ~np.isfinite([each.w[:, :1] for each in tabulated]).any((0, 2))
        for each in tabulated:
            m = each.phase / each.w
            integer = np.ceil(m - NEXT_INTEGER * (1.0 + m))
            confirmed &= ((each.outside == 0) & ~(each.delay + integer < end[:, None]).any(1)) | (each.delay >= end)
    return np.where(confirmed, margins, np.nan)


def _find_real_losses(
    plant: DelayedPlant, terms: Terms, tabulated: list[TabulatedDelay], alpha: np.ndarray, beta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the delays at which a real pole leaves the unit circle at z = -1, after the indices of their walls."""
    L = np.array([each.at_nyquist for each in tabulated])
    above, delays = np.abs(L) - 1.0, np.array([each.delay for each in tabulated])
    k, wall = np.nonzero((above[1:] > 0) & (above[:-1] <= 0))
    controller = evaluate_controller(terms, circle_points(np.full(1, np.pi)), alpha, beta).value.real

    def evaluate(delay: np.ndarray) -> np.ndarray:
        """Return |L(-1)| - 1 for delays in periods."""
        return np.abs(controller[wall] * plant.evaluate(np.full(delay.shape, np.pi), delay)[0].value) - 1.0

    delay = find_zeros_in_brackets(evaluate, delays[k], delays[k + 1], above[k, wall], above[k + 1, wall])
    # A pole is at z = -1 if L(-1) = -1. If L(-1) = 1, add one period of delay, which changes the sign of L(-1).
    return wall, delay + np.where(L[k, wall] < 0, 0.0, 1.0)


def _solve_delays(
    plant: DelayedPlant, terms: Terms, alpha: np.ndarray, beta: np.ndarray, w: np.ndarray, delay: np.ndarray
) -> np.ndarray:
    """Return the delays at which a pole leaves the unit circle, by Newton's method on log(-L); NaN if it fails.

    Args:
        plant: the plant for any delay.
        terms: position estimate P, velocity estimate V and, if present, further feedback R.
        alpha: normalized stiffness, one value for each starting value.
        beta: normalized damping.
        w: starting values of the angle.
        delay: starting values of the delay in periods.
    """
    solutions, active = np.full(w.shape, np.nan), np.arange(w.size)
    for _ in range(MAX_STEPS):
        inside = (w[active] > 0.0) & (w[active] < np.pi) & (delay[active] >= 0.0)
        solutions[active[~inside]] = np.nan
        active = active[inside]
        if not active.size:
            break
        G, by_delay = plant.evaluate(w[active], delay[active])
        L = evaluate_controller(terms, circle_points(w[active]), alpha[active], beta[active]).times(G)
        residual, d_w, d_delay = np.log(-L.value), L.slope / L.value, by_delay / G.value
        # If the device comes to rest within a period, L does not depend on the delay, and both steps are NaN. A
        # positive determinant means that the pole moves outward as the delay increases.
        determinant = (d_delay * d_w.conj()).imag
        step = (residual * d_w.conj()).imag / determinant
        w[active] -= (d_delay * residual.conj()).imag / determinant
        delay[active] -= step
        is_loss = (np.abs(residual) < LOG_TOLERANCE) & (determinant > 0)
        solutions[active] = np.where(is_loss, delay[active], np.nan)
        # Test convergence of the delay only, because near a narrow resonance rounding errors of w keep changing w.
        active = active[~(np.abs(step) <= CONVERGED_STEP * (1.0 + delay[active]))]
    return solutions
