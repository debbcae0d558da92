"""Test the evaluation of kernels on arrays: shapes, types, implementations, and JAX transformations of the caller.

References: elementary functions with known values.
"""

import sys
import threading
import types
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import zwidth
from zwidth.core.errors import InputError, PrecisionWarning
from zwidth.core.xp import WIDE, compile_with_options, is_jax, is_traced, namespace
from zwidth.numerics import evaluate as module
from zwidth.numerics.blocks import map_blocks
from zwidth.numerics.evaluate import FEW, as_float64, check_scalars, evaluate, evaluate_columns

ROUTES = ("auto", "numpy", "jax")


class RootAndProduct(NamedTuple):
    root: object
    product: object


def fragile(x):
    xp = namespace(x)
    return xp.where(x < 0, xp.nan, xp.sqrt(xp.abs(x)))


def powers(x, y, highest):
    """Return a vector for each point, along the last axis."""
    xp = namespace(x, y)
    return xp.stack([y * x**k for k in range(highest)], axis=-1)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 25])
@pytest.mark.parametrize("block", [1, 8])
def test_blocks_are_concatenated(count, block):
    x = np.arange(float(count))
    np.testing.assert_array_equal(map_blocks(np.sqrt, [x], block), np.sqrt(x))


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("weight", [1, 64])
@pytest.mark.parametrize("count", [1, 3, 100, 5000])
def test_vectors_are_on_the_last_axis_and_single_values_broadcast(route, weight, count):
    x = np.linspace(0.0, 1.0, count)
    columns = evaluate_columns(powers, [x, np.array([2.0])], 3, weight=weight, route=route)
    np.testing.assert_allclose(columns, np.stack([2.0 + 0.0 * x, 2.0 * x, 2.0 * x * x], axis=-1), rtol=1e-15)


def test_traced_evaluation_uses_the_ambient_precision():
    def function(x):
        assert is_traced(x)
        return evaluate(fragile, {"x": x})

    assert jax.jit(function)(jnp.ones(3)).dtype == jnp.float32
    assert jax.vmap(function)(jnp.ones(3)).shape == (3,)
    with jax.enable_x64(True):
        assert jax.jit(function)(jnp.ones(3)).dtype == jnp.float64
        assert float(jax.grad(function)(4.0)) == 0.25


def test_scalars_outside_the_range_of_their_name_are_rejected():
    with pytest.raises(InputError, match=r"delta: got 10000000000000.0; it must be 0 to 1e"):
        evaluate(fragile, {"delta": 1e13})
    with pytest.raises(InputError, match="alpha: got 1e-70; it must be 0 or 1e-60 to 1e"):
        check_scalars({"alpha": 1e-70})
    # Arrays have a status instead, and other names have no range.
    check_scalars({"delta": np.array([1e13]), "omega": 1e-70, "alpha": np.inf, "beta": -1.0})
    # The limits exceed the range of these types; an overflow warning would be an error in the test suite.
    check_scalars({"alpha": np.float32(0.1), "beta": np.float16(0.1), "d": np.int8(1)})


def root_and_product(x, y, factor):
    xp = namespace(x, y)
    return RootAndProduct(xp.where(x < 0, xp.nan, xp.sqrt(xp.abs(x))), factor * x * y)


def test_few_points_use_numpy_and_many_are_compiled():
    y = np.linspace(0.5, 2.0, FEW + 1)
    x = y - 1.0
    many, few = (evaluate(root_and_product, {"x": x[:count], "y": y[:count]}, 3.0) for count in (FEW + 1, FEW))
    assert many.root.shape == (FEW + 1,)
    np.testing.assert_allclose(few.root, many.root[:FEW], rtol=1e-15)
    np.testing.assert_allclose(few.product, 3.0 * (x * y)[:FEW], rtol=1e-15)
    assert np.isnan(many.root[0])


def test_masked_arrays_are_rejected():
    with pytest.raises(InputError, match="x: got a masked array"):
        as_float64("x", np.ma.masked_array([1.0, 2.0], mask=[True, False]))


def test_data_arrays_with_dimension_names_are_rejected():
    """Axes with equal lengths but different names would be paired; `xarray.apply_ufunc` broadcasts by name."""
    stiffness, damping = xarray.DataArray([5e3, 40e3], dims="K"), xarray.DataArray([20.0, 30.0], dims="B")
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))
    with pytest.raises(InputError, match=r"stiffness: got a DataArray.*xarray\.apply_ufunc"):
        scene.is_stable(stiffness, damping)
    stable = xarray.apply_ufunc(scene.is_stable, stiffness, damping)
    assert stable.dims == ("K", "B")
    assert stable.values.tolist() == [[True, True], [False, False]]
    assert zwidth.alpha_max(xarray.DataArray(0.1), 1) == zwidth.alpha_max(0.1, 1)


def test_integers_within_float64_are_accepted_by_all_implementations():
    """NumPy's own integers end at 2^64."""
    walls = 2**70, 0.4, 0.1, 1.0
    assert not zwidth.is_stable(*walls, method="certified")
    assert zwidth.spectral_radius(*walls) == zwidth.spectral_radius(2.0**70, *walls[1:])
    assert as_float64("x", -(2**64)) == -(2.0**64)
    with pytest.raises(InputError, match="x: got 1000"):
        as_float64("x", 10**400)


@pytest.mark.parametrize("value", [True, 3, np.int8(3), np.float16(0.5), [1, 2.5], np.uint64(7), jnp.bfloat16(0.5)])
def test_as_float64_accepts_real_numbers(value):
    converted = as_float64("x", value)
    assert converted.dtype == np.float64
    np.testing.assert_array_equal(converted, value)


def test_float32_in_a_transformation_warns_once(monkeypatch):
    monkeypatch.setattr(module, "_warned", threading.Event())
    with jax.enable_x64(True), warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(lambda x: evaluate(fragile, {"x": x}))(1.0)
    with pytest.warns(PrecisionWarning, match="call jax.config.update.'jax_enable_x64', True. first") as caught:
        jax.grad(lambda x: evaluate(jnp.square, {"x": x}))(1.0)
    # The warning refers to the line of the caller.
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(lambda x: evaluate(fragile, {"x": x}))(2.0)


def _product(x, y):
    """Return x^2 y, and an integer without derivative."""
    return x * x * y, (x > y).astype(np.int32)


def test_derivatives_of_elementwise_kernels(x64):
    def first(x, y):
        return evaluate(_product, {"x": x, "y": y})[0]

    x, y = np.array([1.0, np.nan, 3.0]), np.array([2.0, 1.0, 0.5])
    by_x, by_y = (jax.vmap(jax.grad(first, k))(x, y) for k in (0, 1))
    np.testing.assert_array_equal(by_x, 2 * x * y)
    np.testing.assert_array_equal(by_y, x * x)
    # Some or all arguments may be constant.
    assert jax.grad(lambda x: first(x, 2.0))(3.0) == 12
    assert jax.jvp(first, (3.0, 2.0), (1.0, 10.0)) == (18.0, 12 + 90)
    np.testing.assert_array_equal(jax.jit(jax.hessian(lambda v: first(*v)))(np.array([3.0, 2.0])), [[4, 6], [6, 0]])
    value, count = jax.jit(lambda x: evaluate(_product, {"x": x, "y": 1.0}))(2.0)
    assert (value, count, count.dtype) == (4.0, 1, np.int32)


def test_gradient_stores_no_intermediate_results(x64):
    def evaluate_long(x, y):
        for _ in range(50):
            x = x * y + x
        return x

    # Outside `jit`, the stored values between value and gradient are one number per argument.
    _, pullback = jax.vjp(lambda x, y: evaluate(evaluate_long, {"x": x, "y": y}), 0.5, 0.25)
    assert len(jax.tree.leaves(pullback)) <= 4


def test_partially_imported_jax_module_is_ignored(monkeypatch):
    """Another thread may be importing JAX, whose module is empty at first."""
    monkeypatch.setitem(sys.modules, "jax", types.ModuleType("jax"))
    assert not is_jax(object())
    assert not is_traced(object())


@pytest.mark.parametrize("options", [WIDE, {"xla_option_of_no_release": 1}])
def test_compiler_options_that_xla_rejects_are_omitted(options):
    double = compile_with_options(lambda x: 2 * x, options)
    assert [float(double(x)) for x in (1.0, 2.0)] == [2.0, 4.0]
