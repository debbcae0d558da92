"""Compute the dominant pole of each wall, given as JAX arrays, by code that JAX compiles.

The dominant pole is the pole of largest modulus. A wall is *open* as long as no error bound of its pole is certified;
a certificate is a count of the poles outside a circle. `search.find_candidate` computes the pole of each wall, and
`search.find_by_bisection` computes the pole of each open wall again. Derivatives follow from the implicit function
theorem. All functions work inside and outside JAX transformations.

On a CPU, grids over alpha and beta are computed by NumPy instead (`stability.rigid.dominant.arrays`), in a call of
Python from the compiled program. NumPy computes one Taylor series for each cell of neighboring walls; the division of
the grid into cells needs control flow, which Python has. A grid of a million walls takes a quarter (d = 1) or a sixth
(d = 2.5) of the time of the compiled code.
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

# The default relative error of the radius is eps^ACCURACY_EXPONENT: 8e-10 in float64, 1e-4 in float32.
ACCURACY_EXPONENT = 0.58
RESCUE_SIZE = 1 << 9  # number of open walls that a JAX program computes at once by bisection
# Largest number of circles on which poles are counted to certify a pole after a bisection. Each circle is ten times as
# far from the pole as the previous one, because rounding errors may make the count uncertain on a close circle.
MAX_TRIALS = 6


def compute_jax_poles(arguments: Mapping[str, ArrayLike], accuracy: float | None, with_rate: bool) -> tuple[Array, ...]:
    """Return the dominant poles of walls, computed on the processors (JAX devices) that store the arguments.

    Args:
        arguments: alpha, beta, delta and d by name; they broadcast, and at least one of them is a JAX array.
        accuracy: largest relative error of the spectral radius; None for the default of the number type.
        with_rate: whether the decay rate and the angle are computed.

    Returns:
        The spectral radius; with ``with_rate`` also the decay rate per period and the angle in rad.
    """
    static = classify_delays(arguments["d"]), accuracy, with_rate
    with precision(arguments.values()):
        arrays = convert_for_jax(arguments)
        # Add a first axis of length 1, because `find_wall_axes` needs it if alpha or beta is constant.
        rank = max(map(np.ndim, arrays)) + 1
        shapes = [(1,) * (rank - np.ndim(array)) + np.shape(array) for array in arrays]
        is_grid = computes_on_one_cpu() and find_wall_axes(shapes) is not None
        if is_grid:
            radius, *others = _compile_grid(*static)(*arrays)
        else:
            # If the arrays are distributed over several JAX devices, run the kernel on each of them separately: the
            # number of bisections depends on the open walls of each part.
            kernel = compile_kernel(pole_kernel, static)
            radius, *others = map_on_devices(kernel, lazy_jax.numpy.broadcast_arrays(*arrays))
        # Compute the labels (stable or not) in a program of their own, because the search for the poles takes twice as
        # long in a program that also computes labels.
        stable = label_jax_arrays(dict(zip(NAMES, arrays, strict=True)), static[0])
        return lazy_jax.jit(place_near_one)(radius, arrays[0], stable), *others


@lru_cache(CACHED_KERNELS)
def _compile_grid(kind: DelayClasses, accuracy: float | None, with_rate: bool) -> Callable[..., tuple[Array, ...]]:
    """Return a function of JAX arrays that computes the dominant poles of a grid of walls by NumPy.

    Only derivatives are computed by code that JAX compiles.
    """
    import jax

    @jax.custom_jvp
    def compute(*arrays: Array) -> tuple[Array, ...]:
        shape = np.broadcast_shapes(*map(np.shape, arrays))
        host = partial(_compute_on_host, accuracy or ACCURACY, with_rate)
        return tuple(call_numpy(host, [shape] * (3 if with_rate else 1), *arrays))

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> Any:
        """Return values and derivatives of `pole_kernel`, compiled by JAX, for `jax.custom_jvp`."""
        moving = [k for k, t in enumerate(tangents) if not isinstance(t, jax.custom_derivatives.SymbolicZero)]

        def evaluate_moved(*moved: Any) -> tuple[Array, ...]:
            replaced = dict(zip(moving, moved, strict=True))
            columns = [replaced.get(k, value) for k, value in enumerate(primals)]
            return compile_kernel(pole_kernel, (kind, accuracy, with_rate))(*columns)

        return jax.jvp(evaluate_moved, tuple(primals[k] for k in moving), tuple(tangents[k] for k in moving))

    compute.defjvp(rule, symbolic_zeros=True)
    return jax.jit(compute)


def _compute_on_host(accuracy: float, with_rate: bool, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the spectral radius, decay rate and angle for a grid of walls, computed by NumPy in float64."""
    walls = np.broadcast_arrays(*(array.astype(np.float64) for array in arrays))
    poles = find_poles(list(walls), accuracy, with_rate, with_rate, route="numpy")
    return (poles.radius, poles.rate, poles.angle) if with_rate else (poles.radius,)


def pole_kernel(
    alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses, accuracy: float | None, with_rate: bool
) -> tuple[Array, ...]:
    """Return the dominant poles and their derivatives for JAX arrays of equal shape, as `compute_jax_poles` does.

    The results are NaN if the pole is not certified or is a multiple pole.
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
    # In float32, return the decay rate without checking its error bound, because this number type has too few digits.
    (rate,) = (
        nan_unless(_is_rate_certain(poles, stop_gradient((alpha, beta, delta), xp), loop, tolerance, fractional), -re)
        if unit < 1e-9
        else (-re,)
    )
    return xp.exp(re), rate, im


def place_near_one(radius: Array, alpha: Array, stable: Array) -> Array:
    """Return spectral radii of which those close to 1 are corrected to agree with ``stable``; keep the derivatives."""
    xp, constant = namespace(radius), stop_gradient(radius, namespace(radius))
    near_one = xp.abs(constant - 1.0) <= max(VERDICT_WIDTH, COUNT_ROUNDING * epsilon(radius))
    # Add the correction as a constant, because the derivative of ``xp.where(near_one, limit, radius)`` would be 0.
    return radius + xp.where(near_one, place_by_verdict(constant, alpha, stable) - constant, 0.0)


def _is_rate_certain(
    poles: DominantPoles, walls: tuple[Array, ...], loop: LoopFactors, tolerance: float, fractional: bool
) -> Array:
    """Return whether the certified relative error of each decay rate is at most `MAX_RATE_ERROR`."""
    import jax

    xp, (alpha, beta, delta) = namespace(poles.re), walls
    loop = stop_gradient(loop, xp)
    width, allowed = certification_width(poles.re, tolerance), MAX_RATE_ERROR * xp.abs(poles.re)
    # If alpha = 0 and beta + delta = 0, z = 1 is a double pole, so that the decay rate 0 is exact.
    certain = (xp.minimum(poles.error, poles.pole_error + width) <= allowed) | (
        (poles.re == 0) & (alpha == 0) & (beta == -delta)
    )
    undecided = ~certain & (poles.pole_error <= allowed)
    # Count poles again only if at least one wall is undecided, because a count takes as long as several Halley steps.
    counted = jax.lax.cond(
        undecided.any(),
        lambda: is_only_pole_outside(poles.re, poles.im, width, loop, fractional),
        lambda: xp.zeros_like(certain),
    )
    return certain | (undecided & counted)


def _find_certified(loop: LoopFactors, fractional: bool, tolerance: float) -> DominantPoles:
    """Return the dominant poles of walls, computed by `find_candidate`; those of open walls by `find_by_bisection`."""
    import jax.numpy as xp
    from jax.lax import fori_loop, while_loop

    shape, size = loop.alpha.shape, loop.alpha.size
    columns = LoopFactors(*(xp.broadcast_to(column, shape).reshape(-1) for column in loop))
    poles = certify_pole(*find_candidate(columns, fractional), tolerance, columns, fractional, fractional)
    length = min(size, RESCUE_SIZE)

    def rescue(state: tuple[DominantPoles, Array]) -> tuple[DominantPoles, Array]:
        """Compute the dominant poles of up to `RESCUE_SIZE` open walls by bisection."""
        results, is_open = state
        index = xp.nonzero(is_open, size=length, fill_value=size)[0]
        part = LoopFactors(*(column.at[index].get(mode="clip") for column in columns))
        _, re, im = find_by_bisection(part, fractional)

        def certify(k: Any, best: DominantPoles) -> DominantPoles:
            trial = certify_pole(best.re, best.im, tolerance, part, fractional, False, 10.0**k)
            return DominantPoles(*(xp.where(best.certified, *pair) for pair in zip(best, trial, strict=True)))

        # Count poles on up to MAX_TRIALS circles until the pole is certified. Each call of `certify_pole` also takes a
        # Newton step.
        none = xp.full_like(re, np.inf)
        found = fori_loop(0, MAX_TRIALS, certify, DominantPoles(re, im, none, none))
        results = DominantPoles(
            *(leaf.at[index].set(new, mode="drop") for leaf, new in zip(results, found, strict=True))
        )
        return results, is_open.at[index].set(False, mode="drop")

    is_open = ~(poles.certified | xp.isnan(columns.alpha))
    poles, _ = while_loop(lambda state: state[1].any(), rescue, (poles, is_open))
    return DominantPoles(*(leaf.reshape(shape) for leaf in poles))
