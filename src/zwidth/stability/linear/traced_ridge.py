"""Compute the stiffest stable wall of any linear loop under JAX, differentiably, for traced parameters of the scene.

A host callback runs the search of `stability.linear.ridge` in NumPy, which needs no derivative: it only determines
which two conditions are active. Newton's method (optimistix) then solves these conditions for alpha, beta, w1 and w2 in
JAX. The implicit derivatives of this solution are those of the ridge, because the same conditions remain active when
the parameters change. Symbols are those of `stability.linear.ridge`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth.core.errors import InputError, TracedDelayError
from zwidth.core.status import RidgeKind, Status
from zwidth.core.types import Array
from zwidth.core.xp import is_traced, nan_with_nan_derivatives
from zwidth.model.circle_functions import circle_points
from zwidth.model.mechanism import AnyChain, build_chain
from zwidth.model.parameter_paths import replace_parameters
from zwidth.model.wall import VirtualWall
from zwidth.numerics.evaluate import broadcast_traced
from zwidth.numerics.root_finding import polish_root
from zwidth.plant.sampled_states import sample_chain
from zwidth.stability.linear.ridge import Condition, list_ridge_parameters
from zwidth.stability.results import RidgePoint

# Finite placeholders for batch entries without a ridge: alpha, beta, w1, w2, codes of both conditions, kind of ridge.
PLACEHOLDER = (1.0, 1.0, 1.0, 2.0, float(Condition.PAIR), float(Condition.PAIR), float(RidgeKind.NONE))


class Structure(NamedTuple):
    """The static part of a scene with traced parameters; one program is compiled per structure."""

    template: Any  # the scene, with placeholders for the traced parameters
    paths: tuple[str, ...]  # of the traced parameters
    d: float  # delay in periods
    negative: bool  # True if beta < 0 is allowed


def build_structure(scene: Any, paths: tuple[str, ...], negative: bool) -> Structure:
    """Return the static part of a scene: placeholders for its traced parameters, and its delay in periods.

    Args:
        scene: the scene.
        paths: dotted paths of its traced parameters.
        negative: True if beta < 0 is allowed.

    Raises:
        TracedDelayError: if the delay or the period is traced, unless the delay is a plain 0.
    """
    delay, period = scene.timing.delay, scene.timing.period
    undelayed = isinstance(delay, float) and delay == 0.0
    if is_traced(delay, period) and not undelayed:
        raise TracedDelayError(
            "timing: got a traced delay or period, but the number of poles depends on the integer delay; pass both as "
            "plain numbers, or use scene.sensitivities() for their derivatives"
        )
    template = replace_parameters(scene, {"wall": VirtualWall(0.0), **dict.fromkeys(paths, 1.0)})
    return Structure(template, paths, 0.0 if undelayed else float(scene.d), negative)


def trace_stiffest(scene: Any, negative: bool) -> RidgePoint:
    """Return the stiffest stable wall of a scene with traced parameters, with beta >= 0 unless ``negative``."""
    values = scene.parameters()
    paths = tuple(path for path in list_ridge_parameters(scene) if is_traced(values[path]))
    if not paths:
        # If only the wall is traced, on which the ridge does not depend, pass any parameter, because the compiled
        # function needs one.
        paths = ("mass",)
    structure = build_structure(scene, paths, negative)
    return compute_ridge(structure, *broadcast_traced({path: values[path] for path in paths}))


@partial(jax.jit, static_argnums=0)
def compute_ridge(structure: Structure, *values: Array) -> RidgePoint:
    """Return the stiffest stable wall for given values of the traced parameters, with implicit derivatives."""
    dtype = values[0].dtype
    # Pass values to the callback and back as bits, because the thread of the callback may use JAX's default precision,
    # which would round them to float32.
    bits = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(jnp.stack(values)), jnp.int32)
    shape = jax.ShapeDtypeStruct((len(PLACEHOLDER) + 1, *bits.shape[1:]), jnp.int32)
    search = partial(_search_on_host, structure, np.dtype(dtype))
    result = jax.pure_callback(search, shape, bits, vmap_method="sequential")
    result = jax.lax.bitcast_convert_type(result, dtype)
    status = result[-1].astype(jnp.int32)
    exists = status == Status.OK
    placeholder = jnp.asarray(PLACEHOLDER, dtype).reshape(-1, *(1 for _ in exists.shape))
    result = jnp.where(exists, result[:-1], placeholder)
    conditions = result[4:6].astype(jnp.int32)
    alpha, beta, w1, w2, close = _solve_conditions(
        structure, _fill_template(structure, values), result[:4], conditions, exists
    )
    status = jnp.where(exists & ~close, int(Status.NOT_CONVERGED), status)
    invalid = nan_with_nan_derivatives(status == Status.OK, *values)
    omega = jnp.where(result[5] <= Condition.PLUS_ONE, jnp.maximum(w1, w2), w1)
    kind = jnp.where(status == Status.OK, result[6].astype(jnp.int32), int(RidgeKind.NONE))
    return RidgePoint(alpha + invalid, beta + invalid, omega + invalid, kind, status)


def _search_on_host(structure: Structure, dtype: np.dtype, bits: np.ndarray) -> np.ndarray:
    """Compute the ridge in NumPy; return alpha, beta, w1, w2, both conditions, the kind and the status, as bits."""
    values = np.ascontiguousarray(bits).view(dtype).reshape(-1).tolist()
    try:
        ridge, status = _fill_template(structure, values).loop.ridge(structure.negative)
    except InputError:
        ridge, status = None, Status.INVALID_INPUT
    fields = (math.nan,) * len(PLACEHOLDER) if ridge is None else (*ridge, ridge.kind)
    result = np.array([*fields, status], dtype)
    return result.view(np.int32).reshape(result.size, *np.shape(bits)[1:])


def _fill_template(structure: Structure, values: Iterable[Any]) -> Any:
    """Return the scene of the template with values in place of the placeholders."""
    return replace_parameters(structure.template, dict(zip(structure.paths, values, strict=True)))


def _solve_conditions(
    structure: Structure, scene: Any, start: Array, conditions: Array, exists: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Solve the two active conditions for alpha, beta, w1 and w2 by Newton's method.

    Args:
        structure: the static part of the scene.
        scene: the scene with traced parameters.
        start: alpha, beta, w1 and w2 from the search.
        conditions: codes of the two active conditions.
        exists: False if there is no ridge.

    Returns:
        alpha, beta, w1, w2, and whether they agree with ``start``.
    """
    chain = build_chain(scene, (structure.d, int(structure.d)))
    estimate, complex_dtype = chain.estimate, jnp.result_type(start.dtype, jnp.complex64)
    # Scale the unknowns to order one.
    scales = jnp.stack([start[0], jnp.abs(start[0]) + jnp.abs(start[1]), start[2], start[3]])
    scales = jnp.where(scales > 0, scales, 1.0)
    traced = {
        "gain": jnp.asarray(estimate.gain, start.dtype),
        "zeros": jnp.asarray(estimate.zeros, complex_dtype),
        "poles": jnp.asarray(estimate.poles, complex_dtype),
    }
    begin = start / scales
    args = (jax.tree.map(jnp.asarray, sample_chain(chain)), traced, start, conditions, scales)
    end = polish_root(partial(_residual, chain), begin, args, exists)
    # Return whether the solution is close to the start, because Newton's method may converge to a different solution.
    # Only half of the digits must agree, because a double root is not more accurate.
    close = jnp.all(jnp.abs(end - begin) <= 256.0 * float(jnp.finfo(start.dtype).eps) ** 0.5)
    return *(end * scales), close


def _residual(chain: AnyChain, unknowns: Array, args: Any) -> Array:
    """Return the residuals of the four equations of the two active conditions, scaled to order one.

    Args:
        chain: the chain, for its static fields.
        unknowns: alpha, beta, w1 and w2, divided by their scales.
        args: traced values: discretized chain, velocity estimate, start, conditions and scales.
    """
    discretized, traced, start, conditions, scales = args
    alpha, beta, w1, w2 = unknowns * scales
    estimate = replace(chain.estimate, **traced)

    def evaluate_r(w: Array) -> tuple[Array, Array]:
        """Return the pair (r/|q|, F) at the angle w, with ``r = alpha + beta F - q``."""
        points = circle_points(w)
        q, f = discretized.controller(points), estimate.jet(points).value
        size = jax.lax.stop_gradient(jnp.abs(q))
        return (alpha + beta * f - q) / jnp.where(size > 0, size, 1.0), f

    def evaluate_both(w: Array) -> tuple[Array, Array]:
        """Return r at the angle w, and the quantity that is 0 if alpha is stationary along the curve."""
        (r, f), (slope, _) = jax.jvp(evaluate_r, (w,), (jnp.ones_like(w),))
        stationary = (jnp.conj(f) * slope).imag
        size = jax.lax.stop_gradient(jnp.abs(f) * jnp.abs(slope))
        stationary = stationary / jnp.where(size > 0, size, 1.0)
        # For a real pole at z = -1 use Im dr/dw itself and do not divide by F, because F may be 0 there.
        return r, jnp.where(conditions[0] == Condition.PAIR, stationary, slope.imag)

    # Evaluate both angles in one vmap, so that the function is compiled only once.
    r, stationary = jax.vmap(evaluate_both)(jnp.stack([w1, w2]))
    fixed = unknowns[2:] - start[2:] / scales[2:]
    # Require r = 0 for a pole pair; for a real pole, require Re r = 0 and a fixed w.
    poles = jnp.stack([r.real, jnp.where(conditions == Condition.PAIR, r.imag, fixed)], -1)
    index = jnp.maximum(conditions[1] - Condition.PLUS_ONE, 0)
    second = jnp.stack([poles[1], jnp.stack([stationary[0], fixed[1]]), jnp.stack([unknowns[1], fixed[1]])])[index]
    return jnp.concatenate([poles[0], second])
