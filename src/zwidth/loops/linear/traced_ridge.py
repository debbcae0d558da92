"""The stiffest wall of any linear loop under JAX: found on the host, finished by optimistix, differentiable.

The unknowns are alpha, beta, w1 and w2; the equations are the two conditions of `loops.linear.ridge`. The search for
which conditions those are has no derivative and needs none: as a parameter moves, the same conditions hold.
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

from zwidth.arrays.evaluate import broadcast_traced
from zwidth.arrays.roots import polish
from zwidth.loops.linear.held import required_wall, respond
from zwidth.loops.linear.ridge import Condition, moving_paths
from zwidth.parts.chain import AnyChain, chain_of
from zwidth.parts.circle import circle
from zwidth.parts.paths import replace_parameters
from zwidth.parts.wall import VirtualWall
from zwidth.words.errors import InputError, TracedDelayError
from zwidth.words.results import RidgePoint
from zwidth.words.status import RidgeKind, Status
from zwidth.words.types import Array
from zwidth.words.xp import is_traced, nan_with_nan_slopes

# Finite starting values for a batch entry without a ridge.
_NOWHERE = (1.0, 1.0, 1.0, 2.0, float(Condition.PAIR), float(Condition.PAIR), float(RidgeKind.NONE))


class Structure(NamedTuple):
    """What is compiled once: a scene whose moving parameters are placeholders, their paths, and its delay."""

    template: Any
    paths: tuple[str, ...]
    d: float
    negative: bool


def structure_of(scene: Any, paths: tuple[str, ...], negative: bool) -> Structure:
    """What is static of a scene when these parameters move; the delay in periods must be."""
    delay, period = scene.timing.delay, scene.timing.period
    undelayed = isinstance(delay, float) and delay == 0.0
    if is_traced(delay, period) and not undelayed:
        raise TracedDelayError(
            "timing: got a traced delay or period, but the number of poles depends on the whole periods of the delay; "
            "pass both as plain numbers, or ask scene.sensitivities() for the derivatives in them"
        )
    template = replace_parameters(scene, {"wall": VirtualWall(0.0), **dict.fromkeys(paths, 1.0)})
    return Structure(template, paths, 0.0 if undelayed else float(scene.d), negative)


def trace_stiffest(scene: Any, negative: bool) -> RidgePoint:
    """The stiffest wall of a scene with traced parameters."""
    values = scene.parameters()
    paths = tuple(path for path in moving_paths(scene) if is_traced(values[path]))
    if not paths:
        # Only the wall is traced, and the ridge does not depend on it.
        paths = ("mass",)
    structure = structure_of(scene, paths, negative)
    return compiled_ridge(structure, *broadcast_traced({path: values[path] for path in paths}))


@partial(jax.jit, static_argnums=0)
def compiled_ridge(structure: Structure, *values: Array) -> RidgePoint:
    """Return the point of maximum stiffness for values of the traced parameters."""
    dtype = values[0].dtype
    # As bits: the thread of a callback may have JAX's default precision, which would halve the digits on the way.
    bits = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(jnp.stack(values)), jnp.int32)
    shape = jax.ShapeDtypeStruct((len(_NOWHERE) + 1, *bits.shape[1:]), jnp.int32)
    search_there = partial(_search, structure, np.dtype(dtype))
    told = jax.pure_callback(search_there, shape, bits, vmap_method="sequential")
    told = jax.lax.bitcast_convert_type(told, dtype)
    status = told[-1].astype(jnp.int32)
    found = status == Status.OK
    nowhere = jnp.asarray(_NOWHERE, dtype).reshape(-1, *(1 for _ in found.shape))
    told = jnp.where(found, told[:-1], nowhere)
    codes = told[4:6].astype(jnp.int32)
    alpha, beta, w1, w2, close = _solve(structure, _fill(structure, values), told[:4], codes, found)
    status = jnp.where(found & ~close, int(Status.NOT_CONVERGED), status)
    spoiled = nan_with_nan_slopes(status == Status.OK, *values)
    omega = jnp.where(told[5] <= Condition.PLUS_ONE, jnp.maximum(w1, w2), w1)
    kind = jnp.where(status == Status.OK, told[6].astype(jnp.int32), int(RidgeKind.NONE))
    return RidgePoint(alpha + spoiled, beta + spoiled, omega + spoiled, kind, status)


def _search(structure: Structure, dtype: np.dtype, bits: np.ndarray) -> np.ndarray:
    """The ridge on the host, and its status behind it; numbers come and go as their bits."""
    values = np.ascontiguousarray(bits).view(dtype).reshape(-1).tolist()
    try:
        found, status = _fill(structure, values).loop.ridge(structure.negative)
    except InputError:
        found, status = None, Status.INVALID_INPUT
    ridge = (math.nan,) * len(_NOWHERE) if found is None else (*found, found.kind)
    told = np.array([*ridge, status], dtype)
    return told.view(np.int32).reshape(told.size, *np.shape(bits)[1:])


def _fill(structure: Structure, values: Iterable[Any]) -> Any:
    """The scene with these values in place of the placeholders."""
    return replace_parameters(structure.template, dict(zip(structure.paths, values, strict=True)))


def _solve(
    structure: Structure, scene: Any, start: Array, codes: Array, found: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """alpha, beta, w1, w2 at the conditions of ``codes``, and whether they lie where the search found them."""
    chain = chain_of(scene, (structure.d, int(structure.d)))
    estimate, complexes = chain.estimate, jnp.result_type(start.dtype, jnp.complex64)
    # The size of the unknowns.
    scales = jnp.stack([start[0], jnp.abs(start[0]) + jnp.abs(start[1]), start[2], start[3]])
    scales = jnp.where(scales > 0, scales, 1.0)
    moving = {
        "gain": jnp.asarray(estimate.gain, start.dtype),
        "zeros": jnp.asarray(estimate.zeros, complexes),
        "poles": jnp.asarray(estimate.poles, complexes),
    }
    begin = start / scales
    args = (jax.tree.map(jnp.asarray, respond(chain)), moving, start, codes, scales)
    end = polish(partial(_residual, chain), begin, args, found)
    # Newton must stay where the search put it; a double root is met to half of the digits.
    close = jnp.all(jnp.abs(end - begin) <= 256.0 * float(jnp.finfo(start.dtype).eps) ** 0.5)
    return *(end * scales), close


def _residual(chain: AnyChain, unknowns: Array, args: Any) -> Array:
    """The four equations, of order one; ``args`` is what they depend on beside the unknowns."""
    parts, moving, start, codes, scales = args
    alpha, beta, w1, w2 = unknowns * scales
    estimate = replace(chain.estimate, **moving)

    def distance(w: Array) -> tuple[Array, Array]:
        """``r = alpha + beta F - q`` over the size of q, and F."""
        q, f = required_wall(chain, w, parts), estimate.jet(circle(w)).value
        size = jax.lax.stop_gradient(jnp.abs(q))
        return (alpha + beta * f - q) / jnp.where(size > 0, size, 1.0), f

    def both(w: Array) -> tuple[Array, Array]:
        (r, f), (slope, _) = jax.jvp(distance, (w,), (jnp.ones_like(w),))
        across = (jnp.conj(f) * slope).imag
        size = jax.lax.stop_gradient(jnp.abs(f) * jnp.abs(slope))
        across = across / jnp.where(size > 0, size, 1.0)
        # At z = -1 F is real, and may be 0.
        return r, jnp.where(codes[0] == Condition.PAIR, across, slope.imag)

    # One text for both angles, so that the compiler reads it once.
    r, across = jax.vmap(both)(jnp.stack([w1, w2]))
    stays = unknowns[2:] - start[2:] / scales[2:]
    # A pole pair at w, or a real pole where w stays.
    meet = jnp.stack([r.real, jnp.where(codes == Condition.PAIR, r.imag, stays)], -1)
    which = jnp.maximum(codes[1] - Condition.PLUS_ONE, 0)
    second = jnp.stack([meet[1], jnp.stack([across[0], stays[1]]), jnp.stack([unknowns[1], stays[1]])])[which]
    return jnp.concatenate([meet[0], second])
