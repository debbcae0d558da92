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
    "spectral_radius": zwidth.spectral_radius,
    "decay_rate": zwidth.decay_rate,
    "dominant_pole": zwidth.dominant_pole,
    "decide_stability": zwidth.decide_stability,
    "decide_stability companion": lambda alpha, beta, delta, d: zwidth.decide_stability(
        alpha, beta, delta, 1.0, method="companion"
    ),
    "char_poly": lambda alpha, beta, delta, d: zwidth.char_poly(alpha, beta, delta, 1.5),
    "poles": lambda alpha, beta, delta, d: zwidth.poles(alpha, beta, delta, 1),
    "count_poles": lambda alpha, beta, delta, d: zwidth.count_poles([0.8], [1.0, 0.9], alpha, 3, beta + 0.5),
    "max_stiffness": lambda alpha, beta, delta, d: zwidth.max_stiffness(mass=beta, damping=delta, period=1, delay=d),
}

# Runs in a process of its own, because JAX reads the number of devices when it starts.
PROGRAM = """
import jax
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import zwidth
from contract.test_devices import CALLS, WALLS

first, second = jax.devices()
kinds = AxisType.Explicit, AxisType.Auto
explicit, automatic = (jax.make_mesh((2,), ("walls",), axis_types=(kind,)) for kind in kinds)


def check(name, columns, mesh):
    # Results are distributed over the first axis, as the arguments, and equal those of NumPy.
    spread = NamedSharding(mesh, PartitionSpec("walls"))
    with jax.enable_x64(True):
        sharded = [jax.device_put(column, spread) for column in columns]
    expected, results = (jax.tree.leaves(CALLS[name](*arrays)) for arrays in (columns, sharded))
    for values, on_both in zip(expected, results, strict=True):
        assert on_both.sharding.is_equivalent_to(spread, on_both.ndim), (name, on_both.sharding)
        if name != "poles":
            np.testing.assert_allclose(on_both, values, rtol=1e-11, atol=1e-14, err_msg=name)


with jax.enable_x64(True):
    placed = [jax.device_put(column, second) for column in WALLS]
for name, call in CALLS.items():
    for values, on_second in zip(*(jax.tree.leaves(call(*columns)) for columns in (WALLS, placed)), strict=True):
        assert on_second.devices() == {second}, name
        if name != "poles":
            np.testing.assert_allclose(on_second, values, rtol=1e-11, atol=1e-14, err_msg=name)
    check(name, WALLS, explicit)
for name in ("spectral_radius", "poles", "is_stable"):
    check(name, WALLS, automatic)
    # A grid of 64 x 8 walls, distributed by its rows.
    check(name, [np.tile(column[:, None], (1, 8)) for column in WALLS], explicit)
with jax.enable_x64(True):
    walls = [jax.device_put(column, NamedSharding(explicit, PartitionSpec("walls"))) for column in WALLS]
    inside = jax.jit(zwidth.spectral_radius)(*walls)
    assert not inside.sharding.is_fully_replicated
    np.testing.assert_allclose(inside, zwidth.spectral_radius(*WALLS), rtol=1e-11)
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
