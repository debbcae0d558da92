"""Zeros and integrals of functions of one unknown, elementwise, for NumPy and JAX; of several unknowns for JAX only.

The number of steps is fixed, so that no point of a batch waits for another. The result of a point does not depend on
the other points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from zwidth.words.types import Array
from zwidth.words.xp import along, frozen, namespace, repeat

Function = Callable[[Array], Array]
Sloped = Callable[[Array], tuple[Array, Array]]

# Halvings to the last place of float64, with room; also of a logarithm that spans 32 decades.
_HALVINGS = 60
# After a step of such a share of x nothing but rounding is left, near a double zero too.
_SMALL = 1e-11
# A phase in radians, which false position is for, is not known better.
_ROUNDING = 1e-15
# Of optimistix.
_NEWTON_STEPS = 16


def bisect(holds: Function, low: Array, high: Array) -> Array:
    """Return the point between ``low`` and ``high`` up to which a condition holds, by bisection."""
    xp = namespace(low, high)

    def halve(ends: tuple[Array, Array]) -> tuple[Array, Array]:
        at = 0.5 * (ends[0] + ends[1])
        held = holds(at)
        return xp.where(held, at, ends[0]), xp.where(held, ends[1], at)

    low, high = repeat(_HALVINGS, halve, (low, high), xp)
    return 0.5 * (low + high)


def newton(function: Sloped, low: Array, high: Array, start: Array, steps: int) -> tuple[Array, Array]:
    """Newton's method in a bracket below which a function is negative; the zero, and the size of the last step."""
    # The bracket shrinks with every value, and a step that leaves it becomes a bisection.
    xp = namespace(low, start)

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        x, low, high, last = state
        value, slope = function(x)
        low, high = xp.where(value < 0, x, low), xp.where(value < 0, high, x)
        new = x - value / slope
        new = xp.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        done = last <= _SMALL * xp.abs(x)
        return xp.where(done, x, new), low, high, xp.where(done, last, xp.abs(new - x))

    def arrived(_: tuple[Array, ...], new: tuple[Array, ...]) -> bool:
        return bool(np.all(new[3] <= _SMALL * np.abs(new[0])))

    x, _, _, last = repeat(steps, step, (start, low, high, xp.full_like(start, xp.inf)[()]), xp, arrived)
    return x, last


# Of a step of golden section.
_GOLDEN = 0.3819660112501051


def narrow_dips(
    cost: Function, left: Array, middle: Array, right: Array, value: Array, steps: int, close: float = 0.0
) -> tuple[Array, Array]:
    """Lowest places of a function between two others, and its values there, by golden section."""
    # In NumPy no longer than until each is known to the share ``close`` of itself.
    xp = namespace(left, value)

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        left, middle, right, value = state
        upwards = right - middle > middle - left
        trial = middle + _GOLDEN * xp.where(upwards, right - middle, left - middle)
        reached = cost(trial)
        # Of the trial and the middle the lower one becomes the middle, the other one an end.
        better = reached < value
        end, is_right = xp.where(better, middle, trial), better ^ (trial > middle)
        left, right = xp.where(is_right, left, end), xp.where(is_right, end, right)
        return left, xp.where(better, trial, middle), right, xp.where(better, reached, value)

    def arrived(_: tuple[Array, ...], new: tuple[Array, ...]) -> bool:
        return bool(np.all(new[2] - new[0] <= close * np.abs(new[1])))

    _, middle, _, value = repeat(steps, step, (left, middle, right, value), xp, arrived)
    return middle, value


# How many dips between samples are refined, and by how many steps at most; and the share of the first sample at which a
# function tells whether it falls from 0.
_DIPS, _STEPS, _HARDLY_ANY = 3, 52, 1e-9


def find_lowest(cost: Function, low: float, high: float, samples: int, close: float = 0.0) -> tuple[float, float]:
    """How low a function with kinks and several dips is in NumPy, and where: samples, then golden section."""
    # At 0 it may have a kink. Ends do not count, but 0 where it rises from there.
    grid = np.union1d(np.linspace(low, high, samples), np.clip(0.0, low, high))
    values = np.pad(cost(grid[1:-1]), 1, constant_values=np.inf)
    if low == 0.0:
        none, beside = cost(np.array([0.0, _HARDLY_ANY * grid[1]])).tolist()
        values[0] = none if none <= beside else np.inf
    dips = 1 + np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:]))
    dips = dips[np.argsort(values[dips])][:_DIPS]
    found = [(float(values[0]), low)]
    if dips.size:
        middle, value = narrow_dips(cost, grid[dips - 1], grid[dips], grid[dips + 1], values[dips], _STEPS, close)
        found += zip(value.tolist(), middle.tolist(), strict=True)
    return min(found)


class _Bracket(NamedTuple):
    low: Any
    high: Any
    at_low: Any  # weights: the values, halved where an end stays twice
    at_high: Any
    side: Any  # which end moved last, 1 the low one
    best: Any
    value: Any


def false_position(
    function: Function, low: Array, high: Array, at_low: Array, at_high: Array, steps: int, width: Array | float
) -> Array:
    """Where a function that is positive at ``low`` and not at ``high`` changes sign, within two of ``width``."""
    # With halved weights, every sixth step a bisection, and cut ``width`` from the ends at least, or the end that is
    # not next to the zero would stay.
    xp = namespace(low, at_low)

    def done(at: _Bracket) -> Array:
        return (xp.abs(at.value) <= _ROUNDING) | (at.high - at.low <= 2.0 * width)

    def going(state: tuple[Any, _Bracket]) -> Any:
        return (state[0] < steps) & ~xp.all(done(state[1]))

    def step(state: tuple[Any, _Bracket]) -> tuple[Any, _Bracket]:
        k, at = state
        gap = at.at_low - at.at_high
        trial = at.low + (at.high - at.low) * (at.at_low / xp.where(gap > 0, gap, 1.0))
        trial = xp.minimum(xp.maximum(trial, at.low + width), at.high - width)
        inside = (trial > at.low) & (trial < at.high) & (k % 6 != 5)
        # A scalar of NumPy is five times faster than an array of no dimension.
        trial = xp.where(inside, trial, 0.5 * (at.low + at.high))[()]
        value = function(trial)
        above = value > 0
        low, high = xp.where(above, trial, at.low), xp.where(above, at.high, trial)
        # Of a jump the best one is what is left of the bracket, too. A point that is done keeps its value: it must not
        # depend on the points beside it.
        better = ((xp.abs(value) < xp.abs(at.value)) | (at.best < low) | (at.best > high)) & ~done(at)
        return k + 1, _Bracket(
            low,
            high,
            xp.where(above, value, xp.where(at.side < 0, 0.5 * at.at_low, at.at_low)),
            xp.where(above, xp.where(at.side > 0, 0.5 * at.at_high, at.at_high), value),
            xp.where(above, 1.0, -1.0) + 0.0 * value,
            xp.where(better, trial, at.best),
            xp.where(better, value, at.value),
        )

    lower = at_low < -at_high
    none = 0.0 * at_low
    best = xp.where(lower, low, high), xp.where(lower, at_low, at_high)
    state = 0, _Bracket(low, high, at_low, at_high, none, *best)
    if xp is not np:
        from jax.lax import while_loop

        return while_loop(going, step, state)[1].best
    while going(state):
        state = step(state)
    return state[1].best


# Steps towards a zero between two nodes at most, and how near, as a share of its place, it is told.
_BETWEEN_STEPS, _CLOSED = 120, 4e-16


def zeros_between(function: Function, nodes: np.ndarray, values: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Where a function changes its sign behind nodes ``k``, given its values at all nodes; in NumPy."""
    if not k.size:
        return nodes[k]
    low, high, first, last = nodes[k], nodes[k + 1], values[k], values[k + 1]
    with np.errstate(all="ignore"):
        sizes = np.abs(first) + np.abs(last)
        scale = np.where(first > 0, 1.0, -1.0) / np.where(sizes > 0, sizes, 1.0)
        ends = low, high, first * scale, last * scale
        return false_position(lambda at: function(at) * scale, *ends, _BETWEEN_STEPS, _CLOSED * high)


def follow_root(
    function: Callable[..., Array],
    root: Array,
    usable: Callable[..., Array],
    *known: Any,
    slope: Callable[..., Array] | None = None,
) -> Array:
    """A zero x of ``function(x, *known)``, in JAX with its derivatives of every order in what is known."""
    # They are those of the implicit function, so that nothing of a search is differentiated, and 0 but where
    # ``usable(x, slope, step)``, of the function and of Newton's next step. ``slope`` is its derivative where known.
    xp = namespace(root)
    if xp is np:
        return root
    import jax

    def differentiate(x: Array, *known: Any) -> Array:
        return jax.jvp(lambda x: function(x, *known), (x,), (xp.ones_like(x),))[1]

    @jax.custom_jvp
    def follow(root: Array, *known: Any) -> Array:
        return root

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
        x, known = follow(*primals), primals[1:]
        leaves, tree = jax.tree.flatten(known)
        sides = jax.tree.leaves(tangents[1:])
        # What does not move costs nothing.
        moving = [k for k, side in enumerate(sides) if not isinstance(side, jax.custom_derivatives.SymbolicZero)]

        def of_moving(*moved: Any) -> Array:
            among = dict(zip(moving, moved, strict=True))
            return function(x, *tree.unflatten([among.get(k, leaf) for k, leaf in enumerate(leaves)]))

        value, change = jax.jvp(of_moving, tuple(leaves[k] for k in moving), tuple(sides[k] for k in moving))
        rate = (slope or differentiate)(x, *known)
        taken = usable(*frozen((x, rate, value / xp.where(rate == 0, 1.0, rate)), xp))
        return x, xp.where(taken, -change / xp.where(taken, rate, 1.0), 0.0)

    follow.defjvp(rule, symbolic_zeros=True)
    return follow(frozen(root, xp), *known)


def integrate(function: Callable[[Array], Array], edges: Sequence[Array], nodes: Sequence[int]) -> Array:
    """The integral of a function of points along a new last axis, by Gauss and Legendre's nodes between edges."""
    xp, pieces = namespace(*edges), []
    for low, high, count in zip(edges[:-1], edges[1:], nodes, strict=True):
        node, weight = (along(values, low) for values in np.polynomial.legendre.leggauss(count))
        half = 0.5 * (high - low)[..., None]
        pieces.append((low[..., None] + half * (node + 1.0), half * weight))
    points, weights = (xp.concatenate(parts, axis=-1) for parts in zip(*pieces, strict=True))
    return xp.sum(function(points) * weights, axis=-1)


def polish(residual: Callable[[Array, Any], Array], start: Array, args: Any, usable: Array) -> Array:
    """The zero of real equations next to a ``usable`` start by optimistix' Newton method, differentiable in args."""
    import jax.numpy as jnp
    import optimistix

    def equations(unknowns: Array, known: Any) -> Array:
        # Another start stays: what is not finite, or has no slope, would stop the solver for all lanes that share it.
        args, usable, start = known
        return jnp.where(usable, residual(unknowns, args), unknowns - start)

    tolerance = float(16 * jnp.finfo(start.dtype).eps)
    solver = optimistix.Newton(rtol=tolerance, atol=tolerance)
    return optimistix.root_find(
        equations, solver, start, args=(args, usable, start), max_steps=_NEWTON_STEPS, throw=False
    ).value
