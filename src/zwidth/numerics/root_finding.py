"""Zeros, minima and integrals of functions of one variable, computed elementwise in NumPy and JAX.

The same source code runs in NumPy and JAX. JAX takes a fixed number of steps, except in `false_position`; NumPy stops
when all points have converged. The result of a point does not depend on the other points of its batch. Only
`polish_root` solves for several unknowns; it requires JAX.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import expand_along, iterate, namespace, stop_gradient

# Types of functions that map points to values, and of functions that map points to values and derivatives.
Function = Callable[[Array], Array]
Sloped = Callable[[Array], tuple[Array, Array]]

HALVINGS = 60  # halvings in a bisection to the last digit of float64, also of the logarithm of a range of 32 decades
CONVERGED_STEP = 1e-11  # relative step after which the error of Newton's method is rounding, also near a double zero
ZERO_VALUE = 1e-15  # largest |value| of a zero in `false_position`: rounding error of a phase in rad, its main use
BISECTIONS = 52  # halvings of a bracket; they reduce it to one unit in the last place of a float64
MAX_NEWTON_STEPS = 16  # largest number of Newton steps in `polish_root`


def bisect(holds: Function, low: Array, high: Array) -> Array:
    """Find by bisection the point in [low, high] below which ``holds`` is True and above which it is False."""
    xp = namespace(low, high)

    def halve(ends: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = 0.5 * (ends[0] + ends[1])
        is_true = holds(middle)
        return xp.where(is_true, middle, ends[0]), xp.where(is_true, ends[1], middle)

    low, high = iterate(HALVINGS, halve, (low, high), xp)
    return 0.5 * (low + high)


def newton(
    function: Sloped, low: Array, high: Array, start: Array, steps: int, close: float = CONVERGED_STEP
) -> tuple[Array, Array]:
    """Find the zero of a function in a bracket by Newton's method; a bisection replaces a step that leaves the bracket.

    Args:
        function: returns value and derivative; the value is negative below the zero and positive above it.
        low: lower end of the bracket.
        high: upper end of the bracket.
        start: starting value.
        steps: largest number of steps.
        close: size of a step, relative to the zero, below which the search stops.

    Returns:
        The zero, and the magnitude of the last step.
    """
    xp = namespace(low, start)

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        x, low, high, last = state
        value, slope = function(x)
        low, high = xp.where(value < 0, x, low), xp.where(value < 0, high, x)
        new = x - value / slope
        new = xp.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        converged = last <= close * xp.abs(x)
        return xp.where(converged, x, new), low, high, xp.where(converged, last, xp.abs(new - x))

    def is_done(_: tuple[Array, ...], new: tuple[Array, ...]) -> bool:
        return bool(np.all(new[3] <= close * np.abs(new[0])))

    x, _, _, last = iterate(steps, step, (start, low, high, xp.full_like(start, xp.inf)[()]), xp, is_done)
    return x, last


def illinois(
    function: Function, low: Array, high: Array, first: Array, last: Array, steps: int, close: float
) -> tuple[Array, Array]:
    """Find the zero of a function in a bracket by the Illinois method; a bisection replaces a step out of the bracket.

    Each step replaces one end by the zero of the secant. If the other end stays the same twice in a row, the method
    halves the function value at this end, which prevents slow convergence.

    Args:
        function: a continuous function.
        low: lower ends of the brackets.
        high: upper ends of the brackets.
        first: values at ``low``.
        last: values at ``high``, of the opposite sign.
        steps: largest number of steps.
        close: size of a step, relative to the zero, below which the search stops.

    Returns:
        The zero, and the magnitude of the last step.
    """
    xp, positive = namespace(low, first), first > 0

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, first, last, x, side, move = state
        value = function(x)
        before = (value > 0) == positive
        last = xp.where(before, xp.where(side > 0, 0.5 * last, last), value)
        first = xp.where(before, value, xp.where(side < 0, 0.5 * first, first))
        low, high = xp.where(before, x, low), xp.where(before, high, x)
        new = high - last * (high - low) / (last - first)
        new = xp.where((new > low) & (new < high), new, 0.5 * (low + high))
        done = move <= close * x
        side, move = xp.where(before, 1.0, -1.0), xp.where(done, move, xp.abs(new - x))
        return low, high, first, last, xp.where(done, x, new), side, move

    begin = low, high, first, last, 0.5 * (low + high), 0.0 * low, high - low
    *_, x, _, move = iterate(steps, step, begin, xp, lambda old, new: bool(np.all(old[4] == new[4])))
    return x, move


GOLDEN_SECTION = 0.3819660112501051  # (3 - sqrt(5))/2, the position of a trial point in the longer part


def minimize_golden_section(
    cost: Function, left: Array, middle: Array, right: Array, value: Array, steps: int, close: float = 0.0
) -> tuple[Array, Array]:
    """Find a local minimum of a function in each of several brackets by golden-section search.

    Args:
        cost: the function to minimize.
        left: left ends of the brackets.
        middle: points inside with a value not above that of either end.
        right: right ends of the brackets.
        value: values at ``middle``.
        steps: number of steps; NumPy stops earlier if all brackets are narrower than ``close``.
        close: width of a bracket, relative to its middle, at which the search stops in NumPy.

    Returns:
        The arguments of the minima, and the values of the function there.
    """
    xp = namespace(left, value)

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        left, middle, right, value = state
        is_right_longer = right - middle > middle - left
        trial = middle + GOLDEN_SECTION * xp.where(is_right_longer, right - middle, left - middle)
        trial_value = cost(trial)
        # The point with the lower value, trial point or middle, becomes the new middle; the other one becomes an end.
        better = trial_value < value
        end, is_right = xp.where(better, middle, trial), better ^ (trial > middle)
        left, right = xp.where(is_right, left, end), xp.where(is_right, end, right)
        return left, xp.where(better, trial, middle), right, xp.where(better, trial_value, value)

    def is_done(_: tuple[Array, ...], new: tuple[Array, ...]) -> bool:
        return bool(np.all(new[2] - new[0] <= close * np.abs(new[1])))

    _, middle, _, value = iterate(steps, step, (left, middle, right, value), xp, is_done)
    return middle, value


# Settings of the search for the global minimum.
N_MINIMA = 3  # lowest local minima of the samples that are refined
MAX_GOLDEN_STEPS = 52  # largest number of steps of the golden-section search
SMALL_SHARE = 1e-9  # argument next to 0, relative to the first sample, that shows if the function rises from 0


def find_global_minimum(
    cost: Function, low: float, high: float, samples: int, close: float = 0.0
) -> tuple[float, float]:
    """Find the global minimum of a function that may have kinks and several local minima, by samples and refinement.

    The function is sampled, and the lowest samples are refined by golden-section search. The ends of the range count as
    minima only if ``low`` is 0 and the function increases from there.

    Args:
        cost: the function to minimize, which maps NumPy arrays to NumPy arrays.
        low: lower end of the range.
        high: upper end of the range.
        samples: number of samples.
        close: relative accuracy of the argument at the minimum.

    Returns:
        The smallest value, and its argument.
    """
    # Sample 0 as well, because the function may have a kink there.
    grid = np.union1d(np.linspace(low, high, samples), np.clip(0.0, low, high))
    values = np.pad(cost(grid[1:-1]), 1, constant_values=np.inf)
    if low == 0.0:
        at_zero, next_to_zero = cost(np.array([0.0, SMALL_SHARE * grid[1]])).tolist()
        values[0] = at_zero if at_zero <= next_to_zero else np.inf
    minima = 1 + np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:]))
    minima = minima[np.argsort(values[minima])][:N_MINIMA]
    candidates = [(float(values[0]), low)]
    if minima.size:
        middle, value = minimize_golden_section(
            cost, grid[minima - 1], grid[minima], grid[minima + 1], values[minima], MAX_GOLDEN_STEPS, close
        )
        candidates += zip(value.tolist(), middle.tolist(), strict=True)
    return min(candidates)


class _Bracket(NamedTuple):
    """State of the iteration in `false_position`: the brackets, and in each the point with the smallest |value|."""

    low: Any
    high: Any
    at_low: Any  # value at the low end; halved if this end stays twice in a row
    at_high: Any  # the same at the high end
    side: Any  # end that moved last: 1 for the low, -1 for the high one
    best: Any  # point with the smallest |value|
    value: Any  # value there


def false_position(
    function: Function, low: Array, high: Array, at_low: Array, at_high: Array, steps: int, width: Array | float
) -> Array:
    """Find a sign change of a function in each bracket by the Illinois variant of the method of false position.

    The value at an end that stays twice in a row is halved, every sixth step is a bisection, and each step is at least
    ``width`` away from both ends, because otherwise the end far from the zero might never move.

    Args:
        function: positive at ``low`` and not positive at ``high``.
        low: lower ends of the brackets.
        high: upper ends of the brackets.
        at_low: values at ``low``.
        at_high: values at ``high``.
        steps: largest number of steps.
        width: half the width of a bracket at which the search stops.

    Returns:
        The points with the smallest |value| in their final brackets.
    """
    xp = namespace(low, at_low)

    def have_converged(bracket: _Bracket) -> Array:
        return (xp.abs(bracket.value) <= ZERO_VALUE) | (bracket.high - bracket.low <= 2.0 * width)

    def is_unfinished(state: tuple[Any, _Bracket]) -> Any:
        return (state[0] < steps) & ~xp.all(have_converged(state[1]))

    def step(state: tuple[Any, _Bracket]) -> tuple[Any, _Bracket]:
        k, old = state
        gap = old.at_low - old.at_high
        trial = old.low + (old.high - old.low) * (old.at_low / xp.where(gap > 0, gap, 1.0))
        trial = xp.minimum(xp.maximum(trial, old.low + width), old.high - width)
        inside = (trial > old.low) & (trial < old.high) & (k % 6 != 5)
        # Convert a zero-dimensional array to a NumPy scalar by ``[()]``, because scalars are five times as fast.
        trial = xp.where(inside, trial, 0.5 * (old.low + old.high))[()]
        value = function(trial)
        above = value > 0
        low, high = xp.where(above, trial, old.low), xp.where(above, old.high, trial)
        # Also replace the best point if it lies outside the new bracket, as happens at a discontinuity. Do not change a
        # converged point, because its result would otherwise depend on the other points of the batch.
        better = ((xp.abs(value) < xp.abs(old.value)) | (old.best < low) | (old.best > high)) & ~have_converged(old)
        return k + 1, _Bracket(
            low,
            high,
            xp.where(above, value, xp.where(old.side < 0, 0.5 * old.at_low, old.at_low)),
            xp.where(above, xp.where(old.side > 0, 0.5 * old.at_high, old.at_high), value),
            xp.where(above, 1.0, -1.0) + 0.0 * value,
            xp.where(better, trial, old.best),
            xp.where(better, value, old.value),
        )

    lower = at_low < -at_high
    side = 0.0 * at_low
    best = xp.where(lower, low, high), xp.where(lower, at_low, at_high)
    state = 0, _Bracket(low, high, at_low, at_high, side, *best)
    if xp is not np:
        from jax.lax import while_loop

        return while_loop(is_unfinished, step, state)[1].best
    while is_unfinished(state):
        state = step(state)
    return state[1].best


# Settings of the search for zeros between nodes.
MAX_BETWEEN_STEPS = 120  # largest number of steps of false position
BETWEEN_WIDTH = 4e-16  # relative width of the final bracket


def find_zeros_between(function: Function, nodes: np.ndarray, values: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Find the zeros of a function between sampled arguments (nodes) with values of opposite sign, by false position.

    Args:
        function: the function, in NumPy.
        nodes: sampled arguments in ascending order, shape (nodes,).
        values: values at the nodes.
        k: indices of the nodes after which the sign changes, shape (zeros,).

    Returns:
        The zeros, shape (zeros,).
    """
    return find_zeros_in_brackets(function, nodes[k], nodes[k + 1], values[k], values[k + 1])


def find_zeros_in_brackets(function: Function, low: Array, high: Array, at_low: Array, at_high: Array) -> Array:
    """Find the zero of a function in each bracket whose ends have values of opposite sign, by false position.

    Args:
        function: the function.
        low: lower ends of the brackets, positive.
        high: upper ends. A bracket of width 0 returns its end.
        at_low: values at ``low``.
        at_high: values at ``high``.
    """
    if not low.size:
        return low
    xp = namespace(low, at_low)
    with np.errstate(all="ignore"):
        size = xp.abs(at_low) + xp.abs(at_high)
        scale = xp.where(at_low > 0, 1.0, -1.0) / xp.where(size > 0, size, 1.0)
        ends = low, high, at_low * scale, at_high * scale
        return false_position(lambda x: function(x) * scale, *ends, MAX_BETWEEN_STEPS, BETWEEN_WIDTH * high)


def attach_root_derivatives(
    function: Callable[..., Array],
    root: Array,
    usable: Callable[..., Array],
    *parameters: Any,
    slope: Callable[..., Array] | None = None,
) -> Array:
    """Return ``root`` unchanged, with the derivatives of the implicit function theorem attached for JAX.

    The root x of ``f(x, p) = 0`` was computed before, for the parameters p. JAX differentiates the returned value to
    any order by ``dx/dp = -(df/dp)/(df/dx)``, and not the search that computed the root. A NumPy array is returned
    without derivatives.

    Args:
        function: the function f of x and the parameters.
        root: its root, for these parameters.
        usable: maps the root, df/dx and the next Newton step to a boolean array that is True where the derivatives are
            valid; elsewhere they are set to 0.
        *parameters: arrays or trees of arrays.
        slope: derivative of the function in x; computed by automatic differentiation if left out.
    """
    xp = namespace(root)
    if xp is np:
        return root
    import jax

    def differentiate(x: Array, *parameters: Any) -> Array:
        return jax.jvp(lambda x: function(x, *parameters), (x,), (xp.ones_like(x),))[1]

    @jax.custom_jvp
    def attach(root: Array, *parameters: Any) -> Array:
        """Return the root unchanged; JAX takes its derivatives from ``rule``."""
        return root

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
        """Return the root and its tangent, by implicit differentiation."""
        x, parameters = attach(*primals), primals[1:]
        leaves, tree = jax.tree.flatten(parameters)
        changes = jax.tree.leaves(tangents[1:])
        # Differentiate only with respect to parameters with a nonzero tangent, to avoid useless computation.
        varied = [k for k, each in enumerate(changes) if not isinstance(each, jax.custom_derivatives.SymbolicZero)]

        def evaluate_varied(*values: Any) -> Array:
            replaced = dict(zip(varied, values, strict=True))
            return function(x, *tree.unflatten([replaced.get(k, leaf) for k, leaf in enumerate(leaves)]))

        value, change = jax.jvp(evaluate_varied, tuple(leaves[k] for k in varied), tuple(changes[k] for k in varied))
        rate = (slope or differentiate)(x, *parameters)
        valid = usable(*stop_gradient((x, rate, value / xp.where(rate == 0, 1.0, rate)), xp))
        return x, xp.where(valid, -change / xp.where(valid, rate, 1.0), 0.0)

    attach.defjvp(rule, symbolic_zeros=True)
    return attach(stop_gradient(root, xp), *parameters)


def integrate(function: Callable[[Array], Array], edges: Sequence[Array], nodes: Sequence[int]) -> Array:
    """Integrate a function over adjacent intervals by Gauss-Legendre quadrature.

    Args:
        function: the integrand, evaluated at points along a new last axis.
        edges: ends of the intervals of integration, one array per end.
        nodes: number of nodes in each interval.

    Returns:
        The integral from the first to the last edge, in their shape.
    """
    xp, pieces = namespace(*edges), []
    for low, high, count in zip(edges[:-1], edges[1:], nodes, strict=True):
        node, weight = (expand_along(values, low) for values in np.polynomial.legendre.leggauss(count))
        half = 0.5 * (high - low)[..., None]
        pieces.append((low[..., None] + half * (node + 1.0), half * weight))
    points, weights = (xp.concatenate(parts, axis=-1) for parts in zip(*pieces, strict=True))
    return xp.sum(function(points) * weights, axis=-1)


def bracket_root(function: Callable[..., Array], lower: Array, upper: Array, *args: Any) -> tuple[Array, Array]:
    """Return a zero of ``function(x, *args)`` between two points by bisection, and whether the signs there differ."""
    import jax

    with warnings.catch_warnings():
        # Suppress the notice that jaxopt is no longer maintained, because a user of zwidth cannot act on it.
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        from jaxopt import Bisection

    lower, upper, args = jax.lax.stop_gradient((lower, upper, args))
    solver = Bisection(function, lower, upper, BISECTIONS, tol=0.0, check_bracket=False, unroll=False)
    root, state = solver.run(None, *args)
    return jax.lax.stop_gradient(root), state.sign != 0


def polish_root(residual: Callable[[Array, Any], Array], start: Array, args: Any, usable: Array) -> Array:
    """Solve a system of real equations by the Newton method of optimistix, differentiably with respect to ``args``.

    Args:
        residual: maps unknowns and ``args`` to the residuals of the equations, as many as unknowns.
        start: starting values of the unknowns, close to the solution.
        args: parameters of the equations.
        usable: False to return the starting values unchanged, e.g. if they are not finite.
    """
    import jax.numpy as jnp
    import optimistix

    def equations(unknowns: Array, parameters: Any) -> Array:
        # For an unusable start, solve equations that the start satisfies, because nonfinite values or a singular
        # Jacobian would stop the solver for all entries of a batch.
        args, usable, start = parameters
        return jnp.where(usable, residual(unknowns, args), unknowns - start)

    tolerance = float(16 * jnp.finfo(start.dtype).eps)
    solver = optimistix.Newton(rtol=tolerance, atol=tolerance)
    return optimistix.root_find(
        equations, solver, start, args=(args, usable, start), max_steps=MAX_NEWTON_STEPS, throw=False
    ).value
