"""Bisection by jaxopt, in the one module that imports it, and what the general solvers bracket with it (any loop)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp

from zwidth.loops.rigid.polynomial import FrequencyLoop, frequency_boundary
from zwidth.loops.rigid.ridge_newton import corner, expand_curve
from zwidth.words.types import Array

# Each step halves the bracket: 52 of them leave one unit in the last place of a float64.
_STEPS = 52


@cache
def _jaxopt() -> Any:
    with warnings.catch_warnings():
        # jaxopt announces at import that it is no longer maintained; a user of zwidth cannot act on that.
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        import jaxopt

    return jaxopt


def bisect(function: Callable[..., Array], lower: Array, upper: Array, *args: Array) -> tuple[Array, Array]:
    """A sign change of ``function(x, *args)`` in [lower, upper], and whether the bracket held one.

    No derivative passes through: the result is a starting point, to be polished by something differentiable.
    """
    lower, upper, args = jax.lax.stop_gradient((lower, upper, args))
    solver = _jaxopt().Bisection(
        optimality_fun=function,
        lower=lower,
        upper=upper,
        maxiter=_STEPS,
        tol=0.0,
        check_bracket=False,
        unroll=False,
        jit=True,
    )
    root, state = solver.run(None, *args)
    return jax.lax.stop_gradient(root), state.sign != 0


def lobe_end(loop: FrequencyLoop, d: Array, delay_model: str) -> Array:
    """The frequency at which the boundary curve first returns to alpha = 0, pi where it reaches the corner before."""
    limit = jnp.minimum(jnp.pi, jnp.pi / (d + 0.5))
    end, found = bisect(
        lambda omega, loop: frequency_boundary(omega, loop, delay_model).alpha, 1e-6 * limit, limit, loop
    )
    return jnp.where(found & ~corner(expand_curve(loop.plant), loop.lag).reached, end, jnp.pi)
