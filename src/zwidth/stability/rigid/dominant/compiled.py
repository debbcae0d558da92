"""Compute the dominant poles of JAX arrays of walls by code that JAX compiles, inside and outside transformations.

The dominant pole is the pole of largest modulus. Each wall is computed by `search.find_candidate`; walls that this
method does not certify are *open*, and are computed again by `search.find_by_bisection`. Derivatives are those of the
implicit function theorem.

On a CPU, grids over alpha and beta are computed by NumPy instead (`stability.rigid.dominant.arrays`): the compiled
program calls Python back, because one Taylor series serves a whole cell of walls, but the search for cells needs
control flow. A grid of a million walls takes a quarter (d = 1) or a sixth (d = 2.5) of the time of the compiled code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any

import numpy as np

from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import (
    epsilon,
    lazy_jax,
    materialize,
    namespace,
    nan_unless,
    nan_with_nan_derivatives,
    stop_gradient,
)
from zwidth.numerics.callbacks import call_numpy
from zwidth.numerics.complex_pairs import make_complex
from zwidth.numerics.devices import map_on_devices
from zwidth.numerics.evaluate import (
    CACHED_KERNELS,
    compile_kernel,
    computes_on_one_cpu,
    convert_for_jax,
    precision,
)
from zwidth.numerics.root_finding import attach_root_derivatives
from zwidth.plant.rigid_mass import DelayClasses, classify_delays
from zwidth.stability.rigid.broadcasting import NAMES
from zwidth.stability.rigid.characteristic_polynomial import LoopFactors, factor_loop
from zwidth.stability.rigid.dominant.arrays import (
    ACCURACY,
    MAX_RATE_ERROR,
    VERDICT_WIDTH,
    find_poles,
    find_wall_axes,
    is_only_pole_outside,
    place_by_verdict,
)
from zwidth.stability.rigid.dominant.search import (
    COUNT_ROUNDING,
    DominantPoles,
    certification_width,
    certify_pole,
    find_by_bisection,
    find_candidate,
    round_to_real,
)
from zwidth.stability.rigid.dominant.steps import evaluate_polynomial
from zwidth.stability.rigid.normalization import valid_wall
from zwidth.stability.rigid.stiffness_limit import label_jax_arrays

# Default relative error of the certificate, as a power of the machine epsilon: 8e-10 in float64, 1e-4 in float32.
ACCURACY_EXPONENT = 0.58
RESCUE_SIZE = 1 << 9  # number of open walls that a JAX program computes at once by bisection
# Largest number of circles that are tried for the certificate after a bisection. Each circle is ten times as far from
# the pole as the previous one, because the rounding error of the count may be too large on a closer circle.
MAX_TRIALS = 6


def compute_jax_poles(arguments: Mapping[str, ArrayLike], accuracy: float | None, with_rate: bool) -> tuple[Array, ...]:
    """Return the dominant poles of walls, at least one of whose arguments is a JAX array, on the device of the array.

    Args:
        arguments: alpha, beta, delta and d by name; they broadcast.
        accuracy: largest relative error of the radius; None for the default of the number type.
        with_rate: whether the decay rate and the angle are computed.

    Returns:
        The spectral radius; with ``with_rate`` also the decay rate per period and the angle in rad.
    """
    static = classify_delays(arguments["d"]), accuracy, with_rate
    with precision(arguments.values()):
        arrays = convert_for_jax(arguments)
        # Add a first axis of length 1, as `find_poles` does for a line of walls.
        rank = max(map(np.ndim, arrays)) + 1
        shapes = [(1,) * (rank - np.ndim(array)) + np.shape(array) for array in arrays]
        is_grid = computes_on_one_cpu() and find_wall_axes(shapes) is not None
        if is_grid:
            radius, *others = _compile_grid(*static)(*arrays)
        else:
            # Devices that compute parts of one array bisect different numbers of open walls.
            kernel = compile_kernel(pole_kernel, static)
            radius, *others = map_on_devices(kernel, lazy_jax.numpy.broadcast_arrays(*arrays))
        # Compile the labels separately, because in a common program the search for the poles takes twice as long.
        stable = label_jax_arrays(dict(zip(NAMES, arrays, strict=True)), static[0])
        return lazy_jax.jit(place_near_one)(radius, arrays[0], stable), *others


@lru_cache(CACHED_KERNELS)
def _compile_grid(kind: DelayClasses, accuracy: float | None, with_rate: bool) -> Callable[..., tuple[Array, ...]]:
    """Return a function of JAX arrays that computes grids of walls by NumPy, and derivatives by compiled code."""
    import jax

    @jax.custom_jvp
    def compute(*arrays: Array) -> tuple[Array, ...]:
        shape = np.broadcast_shapes(*map(np.shape, arrays))
        host = partial(_compute_on_host, accuracy or ACCURACY, with_rate)
        return tuple(call_numpy(host, [shape] * (3 if with_rate else 1), *arrays))

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> Any:
        """Return values and derivatives of the compiled kernel."""
        moving = [k for k, t in enumerate(tangents) if not isinstance(t, jax.custom_derivatives.SymbolicZero)]

        def evaluate_moved(*moved: Any) -> tuple[Array, ...]:
            replaced = dict(zip(moving, moved, strict=True))
            columns = [replaced.get(k, value) for k, value in enumerate(primals)]
            return compile_kernel(pole_kernel, (kind, accuracy, with_rate))(*columns)

        return jax.jvp(evaluate_moved, tuple(primals[k] for k in moving), tuple(tangents[k] for k in moving))

    compute.defjvp(rule, symbolic_zeros=True)
    return jax.jit(compute)


def _compute_on_host(accuracy: float, with_rate: bool, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return radius, decay rate and angle of a grid of walls, computed by NumPy in float64."""
    walls = np.broadcast_arrays(*(array.astype(np.float64) for array in arrays))
    poles = find_poles(list(walls), accuracy, with_rate, with_rate, route="numpy")
    return (poles.radius, poles.rate, poles.angle) if with_rate else (poles.radius,)


def pole_kernel(
    alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses, accuracy: float | None, with_rate: bool
) -> tuple[Array, ...]:
    """Return the dominant poles with their derivatives, as `compute_jax_poles`, for JAX arrays of equal shape.

    The values are NaN if the pole could not be certified or is a multiple pole.
    """
    xp, fractional = namespace(alpha, beta, delta, d), kind.fractional
    loop = materialize(factor_loop(alpha, beta, delta, d, fractional), delta)
    unit = epsilon(loop.c)
    tolerance = unit**ACCURACY_EXPONENT if accuracy is None else max(accuracy, COUNT_ROUNDING * unit)
    poles = _find_certified(stop_gradient(loop, xp), fractional, tolerance)

    def evaluate(log_pole: Array, loop: LoopFactors) -> list[Array]:
        return [
            make_complex(part.real, part.imag)
            for part in evaluate_polynomial(log_pole.real, log_pole.imag, loop, fractional)[:2]
        ]

    log_pole = attach_root_derivatives(
        lambda *x: evaluate(*x)[0],
        make_complex(poles.re, round_to_real(poles)),
        lambda *_: True,
        loop,
        slope=lambda *x: evaluate(*x)[1],
    )
    valid = nan_with_nan_derivatives(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)
    re, im = (part + valid for part in nan_unless(poles.certified, log_pole.real, log_pole.imag))
    if not with_rate:
        return (xp.exp(re),)
    # Float32 has not enough digits for an error bound of the rate.
    (rate,) = (
        nan_unless(_is_rate_certain(poles, stop_gradient((alpha, beta, delta), xp), loop, tolerance, fractional), -re)
        if unit < 1e-9
        else (-re,)
    )
    return xp.exp(re), rate, im


def place_near_one(radius: Array, alpha: Array, stable: Array) -> Array:
    """Return JAX arrays of radii, with those close to 1 replaced by `place_by_verdict`, and unchanged derivatives."""
    xp, constant = namespace(radius), stop_gradient(radius, namespace(radius))
    near_one = xp.abs(constant - 1.0) <= max(VERDICT_WIDTH, COUNT_ROUNDING * epsilon(radius))
    # Add the difference, a constant for JAX, because the derivative of a selected limit would be 0.
    return radius + xp.where(near_one, place_by_verdict(constant, alpha, stable) - constant, 0.0)


def _is_rate_certain(
    poles: DominantPoles, walls: tuple[Array, ...], loop: LoopFactors, tolerance: float, fractional: bool
) -> Array:
    """Return whether the certified relative error of each decay rate is at most `MAX_RATE_ERROR`."""
    import jax

    xp, (alpha, beta, delta) = namespace(poles.re), walls
    loop = stop_gradient(loop, xp)
    width, allowed = certification_width(poles.re, tolerance), MAX_RATE_ERROR * xp.abs(poles.re)
    # If alpha = 0 and beta + delta = 0, both poles near 1 are exactly 1, so that the decay rate 0 has no error.
    certain = (xp.minimum(poles.error, poles.pole_error + width) <= allowed) | (
        (poles.re == 0) & (alpha == 0) & (beta == -delta)
    )
    undecided = ~certain & (poles.pole_error <= allowed)
    # Count again only if any wall needs it, because a count takes as long as several steps to the pole.
    counted = jax.lax.cond(
        undecided.any(),
        lambda: is_only_pole_outside(poles.re, poles.im, width, loop, fractional),
        lambda: xp.zeros_like(certain),
    )
    return certain | (undecided & counted)


def _find_certified(loop: LoopFactors, fractional: bool, tolerance: float) -> DominantPoles:
    """Return the dominant poles of JAX arrays: by `find_candidate`, or else by `find_by_bisection`."""
    import jax.numpy as xp
    from jax.lax import fori_loop, while_loop

    shape, size = loop.alpha.shape, loop.alpha.size
    columns = LoopFactors(*(xp.broadcast_to(column, shape).reshape(-1) for column in loop))
    poles = certify_pole(*find_candidate(columns, fractional), tolerance, columns, fractional, fractional)
    length = min(size, RESCUE_SIZE)

    def rescue(state: tuple[DominantPoles, Array]) -> tuple[DominantPoles, Array]:
        """Compute the dominant poles of some of the open walls by bisection."""
        results, is_open = state
        index = xp.nonzero(is_open, size=length, fill_value=size)[0]
        part = LoopFactors(*(column.at[index].get(mode="clip") for column in columns))
        _, re, im = find_by_bisection(part, fractional)

        def certify(k: Any, best: DominantPoles) -> DominantPoles:
            trial = certify_pole(best.re, best.im, tolerance, part, fractional, False, 10.0**k)
            return DominantPoles(*(xp.where(best.certified, *pair) for pair in zip(best, trial, strict=True)))

        # Try to certify the poles on up to MAX_TRIALS circles. Each call of `certify_pole` also takes a Newton step.
        none = xp.full_like(re, np.inf)
        found = fori_loop(0, MAX_TRIALS, certify, DominantPoles(re, im, none, none))
        results = DominantPoles(
            *(leaf.at[index].set(new, mode="drop") for leaf, new in zip(results, found, strict=True))
        )
        return results, is_open.at[index].set(False, mode="drop")

    is_open = ~(poles.certified | xp.isnan(columns.alpha))
    poles, _ = while_loop(lambda state: state[1].any(), rescue, (poles, is_open))
    return DominantPoles(*(leaf.reshape(shape) for leaf in poles))
