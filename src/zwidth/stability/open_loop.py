"""Find the angles w that determine the stability margins of open loops L.

L(z) at z = e^(jw) is tabulated at *nodes*, angles w so close that log L changes little between neighbors. The closed
loop has poles where ``1 + L = 0``, with ``L = G (K P + B V)``: G is the sampled plant, K and B are gains, and P and V
are the responses of the feedback terms, such as position and velocity. Only the values of L and dL/dw on the unit
circle are used. All arrays have the shape (loops, nodes) or (loops, crossovers), where "loops" stands for any number of
axes. If a loop has fewer crossovers than others, its remaining entries are NaN. The functions compute in NumPy, except
`find_nearest_angle`, which also accepts JAX arrays.

The open loop has a *gain crossover* where |L| = 1, and a *phase crossover* where L is real and negative. Both are zeros
of real functions of L, found between two nodes with different signs. Between nodes with equal signs, two zeros are
possible if the tangents at both nodes reach 0 in between; they are found on both sides of the minimum of the magnitude.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import expand_along, namespace
from zwidth.model.circle_functions import CirclePoints, Jet, circle_points
from zwidth.numerics.polynomials import abs2
from zwidth.numerics.root_finding import find_zeros_in_brackets

MAX_MINIMA = 5  # largest number of local minima of |1 + L| at the nodes that are refined, the lowest ones first
ZERO_OF_L = 1e-10  # value of |L|, relative to w |dL/dw|, below which L counts as 0

# Type of a function that returns a real function of L, and its derivative in w.
RealFunction = Callable[[Jet], tuple[Array, Array]]
# Type of a function that returns a frequency response on the unit circle, and its derivative in w.
Response = Callable[[CirclePoints], Jet]


class OpenLoop(NamedTuple):
    """Open loops L, and their values at the nodes."""

    respond: Callable[[Array], Jet]  # function from angles of shape (loops, angles) to L and dL/dw
    w: Array  # nodes, ascending and at most pi, shape (nodes,) or (loops, nodes)
    L: Jet  # L and dL/dw at the nodes, shape (loops, nodes)


def evaluate_open_loop(points: CirclePoints, plant: Response, terms: Sequence[Response], gains: Sequence[Array]) -> Jet:
    """Return the open loop ``L = G sum_i (gain_i term_i)`` and its derivative in w, for arrays that broadcast.

    Args:
        points: points of the unit circle.
        plant: response G of the plant.
        terms: response of each feedback term.
        gains: gain of each term.
    """
    with np.errstate(all="ignore"):
        value, slope = (
            sum(gain * part for gain, part in zip(gains, parts, strict=True))
            for parts in zip(*(term(points) for term in terms), strict=True)
        )
        L = Jet(value, slope).times(plant(points))
        # Set the imaginary part of L at w = pi to 0, because L is real there and only a rounding error would remain.
        return Jet(np.where(points.w >= np.pi, L.value.real + 0j, L.value), L.slope)


def tabulate_open_loop(w: Array, plant: Response, terms: Sequence[Response], gains: Sequence[Array]) -> OpenLoop:
    """Return open loops, tabulated at the nodes w.

    Each gain has the shape (loops,). The other arguments are those of `evaluate_open_loop`.
    """
    columns = [gain[..., None] for gain in gains]

    def respond(w: Array) -> Jet:
        return evaluate_open_loop(circle_points(w), plant, terms, columns)

    return OpenLoop(respond, w, respond(w))


def find_gain_crossovers(loop: OpenLoop) -> np.ndarray:
    """Return the angles at which ``|L| = 1``, ascending."""

    def log_gain(L: Jet) -> tuple[Array, Array]:
        """Return ``log|L|`` and its derivative in w."""
        return np.log(abs(L.value)), (L.slope / L.value).real

    return _find_zeros(loop, log_gain)


def find_phase_crossovers(loop: OpenLoop) -> np.ndarray:
    """Return the angles in (0, pi] at which L is real and negative, ascending."""

    def phase_sine(L: Jet) -> tuple[Array, Array]:
        """Return the sine of arg L and its derivative in w."""
        unit = L.value / abs(L.value)
        return unit.imag, unit.real * (L.slope / L.value).imag

    # Exclude the last node from the search and append the angle pi instead, because L is always real at w = pi.
    inner = OpenLoop(loop.respond, loop.w[..., :-1], Jet(*(part[..., :-1] for part in loop.L)))
    w = _find_zeros(inner, phase_sine)
    w = np.concatenate([w, np.full((*w.shape[:-1], 1), np.pi)], -1)
    with np.errstate(all="ignore"):
        L = loop.respond(w)
        # Exclude zeros of L, at which the phase jumps: L is 0 at these angles for any gain, so that no closed-loop pole
        # can occur there.
        is_crossover = (L.value.real < 0) & (abs(L.value) > ZERO_OF_L * w * abs(L.slope))
    return np.where(is_crossover, w, np.nan)


def _find_zeros(loop: OpenLoop, function: RealFunction) -> np.ndarray:
    """Return the angles at which a real function of L is 0, ascending."""

    def evaluate(w: Array, part: int) -> Array:
        return function(loop.respond(w))[part]

    with np.errstate(all="ignore"):
        value, slope = function(loop.L)
        w = np.broadcast_to(loop.w, value.shape)
        step, sign, size, descent = np.diff(w), np.sign(value), abs(value), abs(slope)
        lowest = np.minimum(size[..., :-1] - descent[..., :-1] * step, size[..., 1:] - descent[..., 1:] * step)
        # If the function has equal signs at two neighboring nodes, but its magnitude decreases from both nodes inward,
        # it may have two zeros between them. The comparisons are False for NaN, which occurs if L is 0 at the Nyquist
        # frequency.
        touches = (sign[..., 1:] == sign[..., :-1]) & (lowest < 0)
        touches &= (sign[..., :-1] * slope[..., :-1] < 0) & (sign[..., :-1] * slope[..., 1:] > 0)
        crosses = (value[..., :-1] > 0) != (value[..., 1:] > 0)
        k, exists = _list_true(crosses)
        j, is_minimum = _list_true(touches)

        def take(index: Array, *parts: Array) -> list[Array]:
            """Return values at the nodes before and after the intervals that start at the nodes ``index``."""
            return [np.take_along_axis(part, index + i, -1) for part in parts for i in (0, 1)]

        low, high, first, last = take(k, w, value)
        start, end, before, after, *slopes = take(j, w, value, slope)
        minima = find_zeros_in_brackets(lambda w: evaluate(w, 1), start, np.where(is_minimum, end, start), *slopes)
        at_minima = evaluate(minima, 0)
        is_passed = is_minimum & ((at_minima > 0) != (before > 0))
        exists = np.concatenate([exists, is_passed, is_passed], -1)
        low, high = np.concatenate([low, start, minima], -1), np.concatenate([high, minima, end], -1)
        first, last = np.concatenate([first, before, at_minima], -1), np.concatenate([last, at_minima, after], -1)
        zeros = find_zeros_in_brackets(lambda w: evaluate(w, 0), low, np.where(exists, high, low), first, last)
        return np.sort(np.where(exists, zeros, np.nan), -1)


def _list_true(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices along the last axis at which a mask is True, padded, and True for valid ones.

    The result has as many indices per row as the row with the most True entries needs.
    """
    size, count = mask.shape[-1], int(mask.sum(-1).max(initial=0))
    index = np.partition(np.where(mask, np.arange(size), size), max(count - 1, 0), -1)[..., :count]
    return np.minimum(index, size - 1), index < size


def find_nearest_angle(respond: Callable[[Array], Jet], w: Array, square: Array) -> Array:
    """Return the angle w at which |1 + L| is smallest, from the values of |1 + L|^2 at nodes.

    Args:
        respond: function from angles of shape (loops, angles) to L and dL/dw.
        w: nodes, ascending, shape (nodes,) or (loops, nodes).
        square: ``|1 + L|^2`` at the nodes, shape (loops, nodes).
    """
    xp = namespace(square)

    def slope(w: Array) -> Array:
        """Return half the derivative of ``|1 + L|^2`` in w."""
        loop = respond(w)
        return ((1.0 + loop.value).conj() * loop.slope).real

    def take(values: Array, index: Array) -> Array:
        return xp.take_along_axis(values, index, -1)

    with np.errstate(all="ignore"):
        w = xp.broadcast_to(w, square.shape)
        index = _list_minima(xp.where(square < np.inf, square, np.inf))
        # Search from the node before each minimum to the second node after it, because the next node may coincide with
        # the minimum and the true minimum may lie after both.
        index = xp.clip(index[..., None] + expand_along(np.arange(-1, 3), index), 0, w.shape[-1] - 1)
        angles = take(w, index.reshape(*w.shape[:-1], index.shape[-2] * index.shape[-1]))
        slopes, angles = (part.reshape(index.shape) for part in (slope(angles), angles))
        rises = (slopes[..., :-1] <= 0) & (slopes[..., 1:] > 0)
        first, middle = xp.argmax(rises, -1)[..., None], angles[..., 1]
        low, high = (xp.where(rises.any(-1), take(angles, first + k)[..., 0], middle) for k in (0, 1))
        at_low, at_high = (take(slopes, first + k)[..., 0] for k in (0, 1))
        refined = find_zeros_in_brackets(slope, low, high, at_low, at_high)
        # Include the nodes in the comparison, because the smallest value may occur at an end of the range, where the
        # derivative is not 0.
        candidates = xp.concatenate([refined, middle], -1)
        distance = abs2(1.0 + respond(candidates).value)
        lowest = xp.argmin(xp.where(distance < np.inf, distance, np.inf), -1)
        return take(candidates, lowest[..., None])[..., 0]


def _list_minima(values: Array) -> Array:
    """Return the indices of the nodes with the `MAX_MINIMA` lowest local minima of ``values``."""
    xp = namespace(values)
    below, inner, above = values[..., :-2], values[..., 1:-1], values[..., 2:]
    is_minimum = (inner < below) & (inner <= above)
    # Rank each minimum by the lowest point of the parabola through its node and both neighbors, as if nodes were
    # equidistant.
    lowest = inner - (above - below) ** 2 / (8.0 * (above - inner + (below - inner)))
    ends = (
        xp.where(part[..., :1] <= part[..., 1:], part[..., :1], np.inf)
        for part in (values[..., :2], values[..., :-3:-1])
    )
    first, last = ends
    rank = xp.concatenate([first, xp.where(is_minimum, lowest, np.inf), last], -1)
    if xp is not np:
        # In JAX, sort all values, because XLA cannot find only the smallest ones in arrays that are distributed over
        # devices.
        return xp.argsort(rank, axis=-1)[..., :MAX_MINIMA]
    return np.argpartition(rank, MAX_MINIMA - 1, axis=-1)[..., :MAX_MINIMA]


def select_gain_margin(stable: np.ndarray | bool, w: np.ndarray, gains: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gain margin, i.e. the gain factor closest to 1 on a logarithmic scale, and the angle of its crossover.

    Args:
        stable: True if the closed loop is stable, shape (loops,).
        w: phase crossovers, shape (loops, crossovers).
        gains: |L| at the phase crossovers, same shape.

    Returns:
        The factor by which the gain must change to put a pole on the unit circle, and the angle of this pole. Without
        crossovers the factor is inf for a stable loop and 0 for an unstable one, and the angle is NaN.
    """
    w, gain = _select_nearest(w, abs(np.log(gains)), gains)
    return np.where(np.isnan(w), np.where(stable, np.inf, 0.0), 1.0 / gain), w


def select_phase_margin(stable: np.ndarray | bool, w: np.ndarray, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the phase margin in degrees, which is negative for an unstable loop, and the angle of its gain crossover.

    Args:
        stable: True if the closed loop is stable, shape (loops,).
        w: gain crossovers, shape (loops, crossovers).
        phases: arg(-L) at the gain crossovers in rad, same shape.

    Returns:
        The margin and the angle of the crossover. Without crossovers the margin is inf for a stable loop and NaN for an
        unstable one, and the angle is NaN.
    """
    w, degrees = _select_nearest(w, abs(phases), np.degrees(abs(phases)))
    return np.where(np.isnan(w), np.where(stable, np.inf, np.nan), np.where(stable, degrees, -degrees)), w


def _select_nearest(w: np.ndarray, cost: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the crossover with the smallest cost, and the value at this crossover; both are NaN without crossovers."""
    nan = np.full((*cost.shape[:-1], 1), np.nan)
    k = np.argmin(np.nan_to_num(np.concatenate([cost, nan], -1), nan=np.inf), -1)[..., None]
    w, value = (np.take_along_axis(np.concatenate([part, nan], -1), k, -1)[..., 0] for part in (w, values))
    return w, value
