"""Decide the stability of arrays of walls on rigid devices, by one of three methods.

The public functions are `is_stable` (labels only) and `decide_stability` (labels, statuses and the method used). The
methods:

- "crossover": the closed form at the gain crossover (`stability.rigid.crossover`). On a large grid, alpha is compared
  with the stability limit of its line of constant beta, by the same closed form (`stability.rigid.stiffness_limit`).
  The argument ``precision="mixed"`` selects float32 for most walls that form no grid
  (`stability.rigid.mixed_precision`).
- "companion": the spectral radius from all eigenvalues of the companion matrix (`stability.rigid.poles`).
- "certified": the closed form with error bounds, then ball arithmetic (`stability.rigid.certified`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from zwidth.core.errors import InputError, check_choice
from zwidth.core.status import Method, Status
from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import epsilon, is_jax, is_traced, namespace
from zwidth.numerics.evaluate import are_numbers, check_scalars, evaluate, evaluate_columns, to_caller
from zwidth.numerics.evaluate import precision as choose_precision
from zwidth.plant.rigid_mass import classify_delays
from zwidth.stability.results import Stability
from zwidth.stability.rigid.broadcasting import NAMES, Points, fold_arguments, restore_shape
from zwidth.stability.rigid.crossover import stable_kernel
from zwidth.stability.rigid.normalization import wall_status
from zwidth.stability.rigid.poles import radius_by_companion
from zwidth.stability.rigid.stiffness_limit import label_grid, label_jax_arrays

StabilityMethod: TypeAlias = Literal["auto", "crossover", "companion", "certified"]
STABILITY_METHODS: tuple[str, ...] = get_args(StabilityMethod)
Precision: TypeAlias = Literal["auto", "mixed"]

# Error of computed eigenvalues at a double pole, about the square root of the rounding unit. The companion method
# reports a wall as UNDECIDED if its spectral radius is closer to 1.
DOUBLE_POLE_ERROR = 2e-8


def is_stable(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: StabilityMethod = "auto",
    precision: Precision = "auto",
) -> Array:
    """Return whether each wall is stable: all poles are strictly inside the unit circle.

    Poles are the roots of ``P(z)``, see `zwidth.char_poly`.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, integer or fractional, also mixed in one array. All four broadcast. Axes along which
            an argument is constant cost nothing: for a grid pass alpha of shape (1, N) and beta of shape (M, 1).
        method: "crossover" evaluates the phase at the gain crossover, in closed form; "companion" computes all poles;
            "certified" returns True only with a certificate (`zwidth.decide_stability` returns the status of undecided
            points); it computes on the CPU, even for JAX arrays on a GPU. "auto" is "crossover". On a grid of walls on
            one device, "crossover" compares alpha with the stability limit at each beta, by the same closed form.
        precision: number type of the closed form: "auto" or "mixed". "auto" is float64 in a direct call, and JAX's
            default type inside `jit`. "mixed" computes each wall in float32 with an error bound. If this bound permits
            both labels, "mixed" computes the wall again in float64; this happens for fewer than 1 in 1,000 random
            walls. All labels are those of float64. "mixed" is slower than "auto" on a CPU. Use it on processors with
            slow float64 arithmetic, such as many GPUs. Large grids are computed in the same way with both values.

    Returns:
        Boolean array of the broadcast shape, possibly read-only. False for unstable walls and for invalid input (NaN,
        infinite, out of range, or negative if the argument must not be). To distinguish them, use the status that
        `zwidth.decide_stability` returns.

    Raises:
        InputError: an argument is no real number, a scalar is out of range, shapes do not broadcast, a name is unknown,
            or ``precision`` is "mixed" together with another method than the closed form, or inside `jit` while float64
            is disabled in JAX (``jax_enable_x64``).
        TracedDelayError: d is traced with method "companion".

    Numerics:
        The cost does not depend on d. The label of the closed form is right if alpha is more than some rounding errors
        away from the boundary. Times per point: benchmarks/results/bench.md. Errors of float32:
        benchmarks/results/precision.md.

    References:
        docs/theory/one-crossover.md; Hulin, Preusche, Hirzinger 2006, eq. (17), section V.

    Example:
        >>> import numpy as np, zwidth
        >>> zwidth.is_stable(np.array([0.1, 0.6, 0.8]), 0.4, 0.1, 0)
        array([ True,  True, False])
    """
    values = (alpha, beta, delta, d)
    arguments, numbers = dict(zip(NAMES, values, strict=True)), are_numbers(*values)
    if method != "auto":
        check_choice("method", method, STABILITY_METHODS)
    kernel = stable_kernel if precision == "auto" else _select_kernel(precision, method, values)
    if method in ("auto", "crossover"):
        if numbers and kernel is stable_kernel:
            return evaluate(kernel, arguments, classify_delays(d))
        if not numbers and any(map(is_jax, values)):
            return label_jax_arrays(arguments, classify_delays(d), kernel)
    check_scalars(arguments)
    if method == "companion" and any(map(is_jax, values)):
        with choose_precision(values):
            return radius_by_companion(*values) < 1.0
    _refuse_traced(values)
    points, shape = fold_arguments(values)
    return to_caller(restore_shape(_decide(points, method, kernel)[0], shape), values)


def _refuse_traced(values: tuple[ArrayLike, ...]) -> None:
    """Raise `InputError` if JAX traces an argument, because the method "certified" needs concrete numbers."""
    if is_traced(*values):
        raise InputError(
            "method: 'certified' decides in arbitrary precision on the host; inside a JAX transformation use "
            "'auto', 'crossover' or 'companion'"
        )


def _select_kernel(precision: str, method: str, values: tuple[ArrayLike, ...]) -> Callable[..., Any]:
    """Return the function that labels single walls with the given precision; raise `InputError` if none exists."""
    check_choice("precision", precision, get_args(Precision))
    if precision == "auto":
        return stable_kernel
    if method not in ("auto", "crossover"):
        raise InputError(f"precision: got 'mixed' with method {method!r}; use method 'auto' or 'crossover'")
    if is_traced(*values):
        import jax

        if jax.numpy.result_type(float) != np.float64:
            raise InputError(
                "precision: got 'mixed' inside a JAX transformation without float64; call "
                "jax.config.update('jax_enable_x64', True) first"
            )
    # Import `mixed_precision` only here, because most programs do not use it.
    from zwidth.stability.rigid.mixed_precision import label_in_mixed_precision

    return label_in_mixed_precision


def decide_stability(
    alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike, *, method: StabilityMethod = "auto"
) -> Stability:
    """Return the stability of each wall with the method that decided it.

    Args:
        alpha, beta, delta, d, method: as for `zwidth.is_stable`.

    Returns:
        Stability: ``stable``, boolean; ``status``, see `zwidth.Status`: INVALID_INPUT or OUT_OF_RANGE for a point that
        is not computed; with "certified" UNDECIDED or ON_BOUNDARY for a wall without a label (``stable`` is then
        False); with "companion" UNDECIDED if the radius differs from 1 by less than the error of the eigenvalues at a
        double pole; ``method``, the `Method` that decided. Arrays may be read-only.

    Raises:
        InputError, TracedDelayError: as for `zwidth.is_stable`.

    Numerics:
        As for `zwidth.is_stable`. JAX arrays are computed on the processors that store them; the method "certified"
        always computes on the CPU.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17), section V.

    Example:
        >>> import zwidth
        >>> zwidth.decide_stability([0.1, float("nan")], 0.4, 0.1, 1).status
        array([0, 1], dtype=int32)
    """
    values = (alpha, beta, delta, d)
    check_choice("method", method, STABILITY_METHODS)
    arguments = dict(zip(NAMES, values, strict=True))
    check_scalars(arguments)
    if method != "certified" and any(map(is_jax, values)):
        return _decide_jax_arrays(arguments, method)
    _refuse_traced(values)
    points, shape = fold_arguments(values)
    stable, deciding_method, status = _decide(points, method)
    input_status = wall_status(*points)
    status = input_status if status is None else np.where(input_status == Status.OK, status, input_status)
    codes = np.broadcast_to(status, points.shape).astype(np.int32), np.asarray(deciding_method, np.int32)
    return to_caller(Stability(*(restore_shape(leaf, shape) for leaf in (stable, *codes))), values)


def _decide_jax_arrays(arguments: dict[str, ArrayLike], method: str) -> Stability:
    """Return the stability of walls by code that JAX compiles; at least one of the arguments is a JAX array."""
    values = tuple(arguments.values())
    if method != "companion":
        stable = label_jax_arrays(arguments, classify_delays(values[3]))
        return Stability(stable, *evaluate(_status_kernel, arguments, Method.CROSSOVER))
    radius = radius_by_companion(*values)
    with choose_precision(values):
        stable = radius < 1.0
    return Stability(stable, *evaluate(_status_kernel, arguments | {"radius": radius}, Method.COMPANION))


def _status_kernel(alpha: Array, beta: Array, delta: Array, d: Array, *others: Any) -> tuple[Array, Array]:
    """Return the status of each wall and the code of the method that decided it, elementwise.

    Args:
        alpha, beta, delta, d: the walls.
        *others: spectral radii (only for the method "companion"), then the code of the method.
    """
    *radius, code = others
    status = wall_status(alpha, beta, delta, d)
    xp = namespace(status)
    if radius:
        error = max(DOUBLE_POLE_ERROR, epsilon(alpha) ** 0.5)
        inconclusive = (xp.abs(radius[0] - 1.0) < error) & (alpha != 0) & (status == Status.OK)
        status = xp.where(inconclusive, int(Status.UNDECIDED), status)
    return status, xp.full_like(status, int(code))


def _decide(
    points: Points, method: str, kernel: Callable[..., Any] = stable_kernel
) -> tuple[np.ndarray, Method, np.ndarray | None]:
    """Return labels, the code of the method that decided them, and their statuses (None if all are OK).

    Args:
        points: walls.
        method: name of the method.
        kernel: function that returns whether each wall is stable, by the closed form; used if the walls form no grid.
    """
    if method == "companion":
        radius = np.asarray(radius_by_companion(*points))
        inconclusive = (np.abs(radius - 1.0) < DOUBLE_POLE_ERROR) & (np.asarray(points[0]) != 0)
        return radius < 1.0, Method.COMPANION, np.where(inconclusive, Status.UNDECIDED, Status.OK)
    if method == "certified":
        # Import the module only if the method is requested, because most programs never certify.
        from zwidth.stability.rigid.certified import certify_labels

        stable, status = certify_labels(points)
        return stable, Method.CERTIFIED, status
    if points.is_dense:
        return label_grid(points), Method.CROSSOVER, None
    route = "auto" if kernel is stable_kernel else "jax"
    stable = evaluate_columns(kernel, points.columns(), classify_delays(points.d), route=route)
    return stable.reshape(points.shape), Method.CROSSOVER, None
