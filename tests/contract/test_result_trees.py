"""Contract of results as JAX pytrees: the same structure in every transformation, independent of all settings."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from contract.matrix import EVERY_CASE

TRACED = [case for case in EVERY_CASE if not case.refuses_tracing]


@pytest.mark.parametrize("case", TRACED, ids=lambda case: case.name)
def test_results_have_one_structure_in_all_transformations(case):
    numbers = {name: float(value) for name, value in case.integer_point.items()}
    traced = {name: jnp.asarray(numbers.pop(name)) for name in case.free}
    direct = case.call(**numbers, **{name: float(value) for name, value in traced.items()})
    structure = jax.tree.structure(direct)

    def call(arguments):
        return case.call(**numbers, **arguments)

    # The functions are traced, but not compiled.
    batch = {name: jnp.stack([value, value]) for name, value in traced.items()}
    for result in (jax.eval_shape(call, traced), jax.eval_shape(jax.vmap(call), batch)):
        assert type(result) is type(direct) or not isinstance(direct, tuple)
        assert jax.tree.structure(result) == structure
    mapped = jax.tree.map(np.asarray, direct)
    assert jax.tree.structure(mapped) == structure
    assert all(isinstance(leaf, np.ndarray | np.generic | float | int) for leaf in jax.tree.leaves(mapped))


@pytest.mark.parametrize("question", ["max_stiffness", "sensitivities", "margins", "dominant_pole", "boundary"])
def test_structure_does_not_depend_on_units_or_precision(question):
    """Units of linear and rotary devices belong to the display of a result, and not to its structure."""
    timing = zwidth.Timing("1 ms", "1 periods")
    linear = zwidth.Scene(zwidth.Device("100 g", "1 N s/m"), timing)
    rotary = zwidth.Scene(zwidth.Device("1 g m^2", "0.01 N m s/rad"), timing)
    walls = {"margins": (0.5, 0.01), "dominant_pole": (0.5, 0.01), "boundary": (np.array([10.0, 20.0]),)}
    results = [getattr(scene, question)(*walls.get(question, ())) for scene in (linear, rotary)]
    with jax.enable_x64(True):
        results.append(getattr(linear, question)(*walls.get(question, ())))
    first, second, third = map(jax.tree.structure, results)
    assert first == second == third
    assert hash(first) == hash(second)
    assert jax.tree.map(lambda leaf: leaf, results[1]).unit_system is None
