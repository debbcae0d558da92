"""Compute results for many scenes at once in NumPy, for calls from JAX with a batch of scenes (`jax.vmap`).

A scene is a JAX pytree; its *leaves* are its numbers, in the order of `zwidth.core.pytrees.list_leaves`. All scenes of
a batch have the same structure and differ in their leaves. `Variants` evaluates them together, and confirms each result
by pole counts. A scene without a confirmed result is evaluated by itself. A wall has the normalized stiffness alpha and
damping beta.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

import numpy as np

from zwidth.analysis.ensemble import LEAST_BATCH, BatchRidge, Variants
from zwidth.analysis.traced_answers import Derivatives, fill_rows, no_derivatives
from zwidth.analysis.walls import allows_negative
from zwidth.core.errors import InputError, ZwidthError
from zwidth.core.status import RidgeKind, Status
from zwidth.model.wall import NoWall
from zwidth.stability.linear.derivatives import differentiate_ridge, index_parameters
from zwidth.stability.linear.ridge import Condition, RidgeSolution
from zwidth.units.quantities import WALL

# Largest number of walls per scene whose labels (stable or unstable) are computed for all scenes at once, with one pole
# count per wall. For more walls, one stability boundary per scene takes less time.
MAX_WALLS = 8


class LeafVariants(Variants):
    """Scenes of the same structure, given by the leaves of each scene.

    Args:
        build: function that returns the scene with the given leaves; it raises `InputError` if a number is not allowed.
        leaves: leaves of the scenes, shape (scenes, leaves).

    Raises:
        InputError: no scene is valid.
    """

    def __init__(self, build: Callable[[tuple[float, ...]], Any], leaves: np.ndarray) -> None:
        self.make, self.leaves = build, leaves
        scene, k = _find_valid(build, leaves)
        index = index_parameters(scene)
        if isinstance(scene.wall, NoWall):
            index = {path: each for path, each in index.items() if path not in WALL}
        drawn = {path: leaves[:, each].copy() for path, each in index.items()}
        if scene.timing.in_periods:
            drawn["delay"] *= drawn["period"]
        # If the hand's spring to ground has stiffness 0 in all scenes, do not list this stiffness as varied, because
        # `Variants` does not support a varied stiffness of 0.
        if not drawn.get("operator.stiffness", np.ones(1)).any():
            del drawn["operator.stiffness"]
        # Some leaves, such as those of a safe limit, are not parameters of the scene, so `Variants` does not check
        # their values. If these leaves differ from those of the first valid scene, evaluate the scene by itself.
        other = np.setdiff1d(np.arange(leaves.shape[1]), list(index.values()))
        self.similar = np.all(leaves[:, other] == leaves[k, other], 1)
        super().__init__(scene, drawn)

    def build(self, k: int) -> Any:
        return self.make(tuple(self.leaves[k].tolist()))

    def _is_supported(self, values: dict[str, np.ndarray]) -> np.ndarray:
        return np.asarray(super()._is_supported(values)) & self.similar

    def _label(self, k: int, alpha: np.ndarray, beta: np.ndarray) -> bool:
        try:
            return super()._label(k, alpha, beta)
        except (ZwidthError, ArithmeticError):
            return False


def _find_valid(build: Callable[[tuple[float, ...]], Any], leaves: np.ndarray) -> tuple[Any, int]:
    """Return the first valid scene and its index; raise `InputError` if no scene is valid."""
    for k, each in enumerate(leaves.tolist()):
        with suppress(ZwidthError, ArithmeticError):
            return build(tuple(each)), k
    raise InputError("scene: no scene of the batch is valid")


def find_stiffest_of_many(
    variants: LeafVariants, points: np.ndarray, order: int, negative_damping: bool | None
) -> Derivatives:
    """Return the stiffest walls and their derivatives as `traced_answers.find_stiffest` does, one row per scene."""
    negative = allows_negative(variants.scene, negative_damping)
    top = variants.find_ridges(negative)
    results = no_derivatives(np.stack(top.point, -1), variants.leaves.shape[1], order)
    for result in results[1:]:
        result[:, :3] = np.nan
    for k in np.flatnonzero(top.point.status == Status.OK).tolist() if order else ():
        scene = variants.build(k)
        ridge = scene.loop.ridge(negative)[0] if top.searched[k] else _describe_maximum(top, k)
        if ridge is not None:
            fill_rows(results, k, range(3), differentiate_ridge(scene, ridge, order))
    return results


def _describe_maximum(top: BatchRidge, k: int) -> RidgeSolution:
    """Return the stiffest wall of the scene with the index k, with the two conditions that determine it."""
    alpha, beta, (w1, w2) = float(top.point.alpha[k]), float(top.point.beta[k]), top.angles[:, k].tolist()
    # A pole on the unit circle at the angle w belongs to a complex pair or, if w = pi, is the single pole z = -1.
    first, second = (Condition.MINUS_ONE if w == np.pi else Condition.PAIR for w in (w1, w2))
    if top.point.kind[k] == RidgeKind.SMOOTH:
        second = Condition.STATIONARY
    elif top.point.kind[k] == RidgeKind.NO_DAMPING:
        second = Condition.NO_DAMPING
    return RidgeSolution(alpha, beta, w1, w2, first, second)


def label_many(variants: LeafVariants, points: np.ndarray, order: int) -> Derivatives:
    """Return the labels of walls (1 stable, 0 unstable) as `traced_answers.label_walls` does, one row per wall."""
    labels = variants.label_normalized(*points.T)[:, None].astype(float)
    return no_derivatives(labels, variants.leaves.shape[1] + points.shape[1], order)


BATCHES: dict[str, Callable[..., Derivatives]] = {"stiffest": find_stiffest_of_many, "labels": label_many}
"""Functions that compute one method for many scenes at once, by the name of the method in `traced_answers.ANSWERS`.

The arguments of each function are the scenes, an array with the walls of the method (one row per scene), the order of
the highest derivative, and the options of the method.
"""


def evaluate_batch(
    method: str,
    build: Callable[[tuple[float, ...]], Any],
    rows: np.ndarray,
    count: int,
    order: int,
    options: Iterable[Any],
) -> Derivatives | None:
    """Return values and derivatives of a method for many scenes, or None if the caller must evaluate each by itself.

    Args:
        method: name of the method in `traced_answers.ANSWERS`.
        build: function that returns the scene with the given leaves.
        rows: leaves of a scene, followed by the further arguments of the method, such as alpha and beta of a wall;
            shape (rows, leaves + arguments).
        count: number of leaves of a scene.
        order: order of the highest derivative.
        options: options of the method.

    Returns:
        Arrays as those of the functions in `traced_answers.ANSWERS`, with one row per row of ``rows``.
    """
    if method not in BATCHES or len(rows) < LEAST_BATCH:
        return None
    different, groups = np.unique(rows, axis=0, return_inverse=True, equal_nan=True)
    if len(different) > MAX_WALLS * len(np.unique(different[:, :count], axis=0, equal_nan=True)):
        return None
    try:
        variants = LeafVariants(build, different[:, :count])
    except InputError:
        return None
    results = BATCHES[method](variants, different[:, count:], order, *options)
    return [result[groups.reshape(-1)] for result in results]
