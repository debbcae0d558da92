"""Analyses of a scene inside JAX transformations such as jit and grad, if the scene has no closed form.

NumPy computes the values and derivatives of each method (`analysis.traced_answers`), and the compiled JAX program calls
NumPy. The arguments of such a call are the numbers of the scene (the *leaves* of its JAX pytree) and the walls. The
call rebuilds the scene from the numbers, and evaluates the same loop as outside a transformation. The compiled program
is therefore small, and JAX compiles it once per *structure* of a scene, i.e. once for all values of the numbers. A
batch of scenes or walls takes a single call.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zwidth.analysis.loop import LinearLoop
from zwidth.analysis.traced_answers import ANSWERS, INVALID
from zwidth.analysis.traced_batch import evaluate_batch
from zwidth.core.errors import InputError, ZwidthError
from zwidth.core.status import Status
from zwidth.core.types import Array
from zwidth.model.mechanism import AnyChain
from zwidth.numerics.evaluate import broadcast_traced
from zwidth.numerics.host_function import call_host
from zwidth.stability.linear.derivatives import SceneSensitivities, list_ridge_parameters
from zwidth.stability.results import Margins, RidgePoint

KEPT_SCENES = 32  # cached scenes with their loops, because values and derivatives are computed in several calls
MAX_POINTS = 1 << 16  # points per NumPy call; zwidth might use JAX for more, but JAX must not run inside a callback


@lru_cache(KEPT_SCENES)
def _build_scene(structure: Any, leaves: tuple[float, ...]) -> Any:
    """Return the scene with a given structure and given numbers; raise `InputError` if a number is not allowed."""
    return structure.unflatten(leaves)._rebuild()


@dataclass(frozen=True)
class Question:
    """A method of the loop for scenes of one structure, as a NumPy function of numbers and further arguments."""

    structure: Any  # structure of the scene, a JAX treedef
    method: str  # name of the method, a key of `ANSWERS`
    options: tuple[Any, ...] = ()

    def __call__(self, order: int, points: np.ndarray) -> list[np.ndarray]:
        """Return values and derivatives; a row of ``points`` contains a scene's numbers and the further arguments."""
        count, size = self.structure.num_leaves, points.shape[1]
        build = partial(_build_scene, self.structure)
        batch = evaluate_batch(self.method, build, points, count, order, self.options)
        if batch is not None:
            return batch
        results = [np.full((len(points), ANSWERS[self.method][1], *[size] * k), np.nan) for k in range(order + 1)]
        results[0][:] = INVALID.get(self.method, np.nan)
        scenes, groups = np.unique(points[:, :count], axis=0, return_inverse=True, equal_nan=True)
        for k, leaves in enumerate(scenes.tolist()):
            rows = np.flatnonzero(groups.reshape(-1) == k)
            for part in np.split(rows, range(MAX_POINTS, rows.size, MAX_POINTS)):
                try:
                    answer = self._answer(tuple(leaves), points[part, count:], order)
                except (ZwidthError, ArithmeticError):
                    continue
                for result, values in zip(results, answer, strict=True):
                    result[part] = values
        return results

    def _answer(self, leaves: tuple[float, ...], points: np.ndarray, order: int) -> list[np.ndarray]:
        """Return values and derivatives of the method for one scene, at several points."""
        scene = _build_scene(self.structure, leaves)
        with np.errstate(all="ignore"):
            return ANSWERS[self.method][0](scene, points, order, *self.options)


def ask(scene: Any, method: str, *arguments: Array, options: tuple[Any, ...] = ()) -> Sequence[Any]:
    """Return the results of a method of the loop for a scene that JAX traces, as a list of arrays.

    Args:
        scene: the scene.
        method: name of the method, a key of `ANSWERS`.
        *arguments: further arrays, such as walls, which are broadcast; none for a method with one result per scene.
        options: further arguments that JAX does not trace.
    """
    leaves, structure = jax.tree.flatten(scene)
    return _ask(Question(structure, method, options), leaves, arguments)


@partial(jax.jit, static_argnums=0)
def _ask(question: Question, leaves: Sequence[Any], arguments: Sequence[Any]) -> Sequence[Any]:
    """Return the results of a method of the loop for the numbers of a scene and further arguments."""
    numbers = broadcast_traced({f"number {k} of the scene": leaf for k, leaf in enumerate(leaves)})
    given = broadcast_traced({f"argument {k}": each for k, each in enumerate(arguments)}) if arguments else []
    shape = np.shape(given[0]) if given else ()
    points = jnp.stack([jnp.broadcast_to(each, shape).reshape(-1) for each in (*numbers, *given)], 1)
    results = jax.vmap(partial(call_host, question, ANSWERS[question.method][1]))(points)
    return [column.reshape(shape) for column in results.T]


@cache
def _compile(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function, compiled by JAX, that calls a scene method with constant arguments, a scene and arrays."""

    @partial(jax.jit, static_argnums=0)
    def run(constants: tuple[tuple[str, Any], ...], scene: Any, numbers: Mapping[str, Any]) -> Any:
        return method(scene, **dict(constants), **numbers)

    return run


class TracedLoop(LinearLoop):
    """Analyses of a scene inside JAX transformations; see `LinearLoop` for the methods."""

    traceable = True

    @cached_property
    def chain(self) -> AnyChain:
        raise InputError(
            "scene: got values traced by JAX; this question needs plain numbers, outside jit, vmap and grad"
        )

    def _forbid_derivatives(self, value: Array) -> Array:
        """Return the value unchanged; if the tool has ``every`` > 1, its differentiation by JAX raises `InputError`.

        Derivatives are computed from the stability boundary, which is not available if the tool makes one step per
        several periods.
        """
        tool = self.scene.tool
        if tool is None or tool.every == 1:
            return value

        @jax.custom_jvp
        def keep(value: Array) -> Array:
            return value

        @keep.defjvp
        def refuse(primals: Any, tangents: Any) -> Any:
            raise InputError(f"tool.every: got {tool.every}, but derivatives need one step per period; set every=1")

        return keep(value)

    def labels(self, alpha: Array, beta: Array) -> Array:
        return ask(self.scene, "labels", alpha, beta)[0] > 0.5

    def radius(self, alpha: Array, beta: Array) -> Array:
        return self._forbid_derivatives(ask(self.scene, "radius", alpha, beta)[0])

    def critical_walls(self, w: Array) -> tuple[Array, Array]:
        alpha, beta = ask(self.scene, "critical_walls", w)
        return alpha, beta

    def trace_stiffest(self, negative_damping: bool | None) -> RidgePoint:
        """Return the stiffest stable wall; ``negative_damping`` as for `zwidth.Scene.max_stiffness`."""
        values = ask(self.scene, "stiffest", options=(negative_damping,))
        alpha, beta, omega, kind, status = map(self._forbid_derivatives, values)
        return RidgePoint(alpha, beta, omega, kind.astype(jnp.int32), status.astype(jnp.int32))

    def margins(self, alpha: Array, beta: Array, wanted: Container[str] = Margins._fields) -> Margins:
        return Margins(*ask(self.scene, "margins", alpha, beta))

    def passivity_margin(self, alpha: Array, beta: Array) -> Array:
        return ask(self.scene, "passivity_margin", alpha, beta)[0]

    def poles(self, alpha: Array, beta: Array) -> Any:
        raise InputError(
            "poles: got a value traced by JAX, allowed only for a rigid device with the backward difference"
        )

    def dominant_poles(self, alpha: Array, beta: Array) -> Any:
        raise InputError(
            "dominant_pole: got a value traced by JAX, allowed only for a rigid device with the backward difference; "
            "use spectral_radius"
        )

    def trace_sensitivities(self, negative_damping: bool | None) -> SceneSensitivities:
        """Return K_max and its derivatives by dotted path of the parameter; see `zwidth.Scene.sensitivities`."""
        timing = self.scene.timing

        def maximum(scene: Any) -> tuple[Any, Any]:
            wall = scene.max_stiffness(negative_damping=negative_damping)
            return wall.stiffness, wall.status

        (stiffness, status), slopes = jax.value_and_grad(maximum, has_aux=True)(self.scene)
        values = slopes.parameters()
        if timing.in_periods:
            values["delay"] = slopes.timing.span.value / timing.period
        per = {path: values[path] for path in list_ridge_parameters(self.scene)}
        is_missing = jnp.isnan(sum(per.values(), stiffness)) & (status == Status.OK)
        return SceneSensitivities(stiffness, per, jnp.where(is_missing, int(Status.NOT_CONVERGED), status))

    def trace_required(
        self, parameter: str, stiffness: Any, within: tuple[Any, ...] | None, negative_damping: bool | None
    ) -> tuple[Any, ...]:
        """Return the fields of the result of `zwidth.Scene.required`, with an empty tuple of crossings."""
        options = (parameter, within, negative_damping)
        value, side, low, high, status = ask(self.scene, "required", stiffness, options=options)
        return value, side.astype(jnp.int32), (), (low, high), status.astype(jnp.int32)

    def run_compiled(self, method: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
        """Call a method of the scene as one compiled JAX program, whose inputs are the scene and all arrays."""
        numbers = {name: value for name, value in arguments.items() if isinstance(value, jax.Array | np.ndarray)}
        constants = tuple((name, value) for name, value in arguments.items() if name not in numbers)
        try:
            hash(constants)
        except TypeError:
            return method(self.scene, **arguments)
        return _compile(method)(constants, self.scene, numbers)
