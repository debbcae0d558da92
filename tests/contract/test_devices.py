"""Contract of JAX arrays passed directly: results stay on the devices of the arguments, also of several devices."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth

WALLS = (np.linspace(-0.1, 1.0, 64), np.linspace(0.1, 1.0, 64), np.full(64, 0.3), np.resize([0.0, 0.3, 1.0, 2.5], 64))
CALLS = {
    "is_stable": zwidth.is_stable,
    "is_passive": zwidth.is_passive,
    "passivity_margin": zwidth.passivity_margin,
    "alpha_max": lambda alpha, beta, delta, d: zwidth.alpha_max(delta, d),
    "boundary_point": lambda alpha, beta, delta, d: zwidth.boundary_point(delta, d, beta=beta),
    "max_stiffness": lambda alpha, beta, delta, d: zwidth.max_stiffness(mass=beta, damping=delta, period=1, delay=d),
}

# Runs in a process of its own, because JAX reads the number of devices when it starts.
PROGRAM = """
import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from contract.test_devices import CALLS, WALLS

first, second = jax.devices()
with jax.enable_x64(True):
    placed = [jax.device_put(column, second) for column in WALLS]
    spread = NamedSharding(jax.make_mesh((2,), ("walls",)), PartitionSpec("walls"))
    sharded = [jax.device_put(column, spread) for column in WALLS]
for name, call in CALLS.items():
    expected, one, two = (jax.tree.leaves(call(*columns)) for columns in (WALLS, placed, sharded))
    for values, on_second, on_both in zip(expected, one, two, strict=True):
        assert on_second.devices() == {second}, name
        assert on_both.sharding.is_equivalent_to(spread, 1), (name, on_both.sharding)
        np.testing.assert_allclose(on_second, values, rtol=1e-11, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(on_both, values, rtol=1e-11, atol=1e-14, err_msg=name)
"""


def test_results_stay_on_a_second_device_and_stay_sharded(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2 --xla_backend_optimization_level=0")
    monkeypatch.setenv("PYTHONPATH", ":".join(filter(None, sys.path)))
    result = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize("name", ["is_stable", "alpha_max"])
def test_grids_of_jax_arrays_equal_those_of_numpy(name, enabled):
    """A million walls, so that lines of constant beta and blocks are used; float32 where it is not requested, too."""
    alpha, beta, d = (
        np.linspace(-0.1, 1.0, 512)[None, None],
        np.linspace(-0.2, 1.0, 256)[:, None],
        np.array([0.0, 0.5, 1, 2.5]),
    )
    shape = (4, 256, 512)
    grid = (alpha, beta[None], np.float64(0.3), d[:, None, None])
    expected = CALLS[name](*grid)
    with jax.enable_x64(enabled):
        direct = (
            CALLS[name](*map(jnp.asarray, grid))
            if enabled
            else CALLS[name](alpha, beta[None], 0.3, jnp.asarray(d)[:, None, None])
        )
    for left, right in zip(jax.tree.leaves(direct), jax.tree.leaves(expected), strict=True):
        assert isinstance(left, jax.Array)
        assert left.dtype == right.dtype
        if name == "is_stable":
            assert left.shape == shape
            assert np.mean(np.asarray(left) != right) < 1e-5
        else:
            np.testing.assert_allclose(left, right, rtol=1e-13, atol=1e-15)


def test_traced_grid_equals_direct_grid():
    alpha, beta = np.linspace(0.0, 1.0, 700)[None], np.linspace(-0.2, 1.0, 200)[:, None]
    with jax.enable_x64(True):
        traced = jax.jit(lambda alpha, d: zwidth.is_stable(alpha, beta, 0.3, d))
        for d in (0.0, 0.3, 1.0, 4.5):
            np.testing.assert_array_equal(traced(alpha, d), zwidth.is_stable(alpha, beta, 0.3, d))
        for index in ((0, 0), (100, 5), (50, 50)):
            assert traced(alpha, 1.0)[index] == zwidth.is_stable(alpha[0, index[1]], beta[index[0], 0], 0.3, 1.0)
        for bad in (np.nan, -1.0, 1e9):
            assert not traced(alpha, bad).any()
        assert not traced(np.full_like(alpha, np.nan), 1.0).any()


def test_numbers_are_not_compiled_again():
    """The values of the arguments are no constants of the programs."""
    compiled = []
    with jax.enable_x64(True):
        zwidth.alpha_max(jnp.asarray([0.1, 0.2]), jnp.asarray([1.0, 1.5]))
        jax.monitoring.register_event_duration_secs_listener(
            lambda event, duration_secs, **_: compiled.append(event) if "backend_compile" in event else None
        )
        try:
            zwidth.alpha_max(jnp.asarray([0.3, 4.0]), jnp.asarray([0.0, 7.0]))
        finally:
            jax.monitoring.clear_event_listeners()
    assert not compiled
