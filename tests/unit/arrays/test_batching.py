"""Batching: shapes, types, pieces, and a caller's own transformations, with kernels whose answers are known."""

import sys
import threading
import types
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zwidth.arrays import batching
from zwidth.arrays.batching import (
    FEW,
    as_float64,
    broadcast,
    concrete_delay,
    elementwise,
    is_traced,
    map_flat,
    pointwise,
)
from zwidth.arrays.xp import is_jax, namespace
from zwidth.words.errors import InputError, PrecisionWarning, TracedDelayError


class Weighted(NamedTuple):
    total: object
    pair: object


def weighted(x, y, factor=1.0):
    return Weighted(x + factor * y, jnp.stack([x, y]))


def fragile(x):
    return jnp.where(x < 0, jnp.nan, jnp.sqrt(jnp.abs(x)))


NAMES = ("x", "y")


def test_arguments_broadcast_and_vectors_come_last():
    x, y = np.arange(3.0)[:, None], np.arange(4.0)
    got = pointwise(weighted, NAMES, (x, y), (10.0,))
    np.testing.assert_array_equal(got.total, x + 10 * y)
    assert got.pair.shape == (3, 4, 2)
    np.testing.assert_array_equal(got.pair[..., 1], np.broadcast_to(y, (3, 4)))


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 25])
@pytest.mark.parametrize("chunk", [1, 8])
def test_pieces_join_to_the_whole(count, chunk):
    x = np.arange(float(count))
    np.testing.assert_array_equal(map_flat(fragile, [x], chunk=chunk), np.sqrt(x))


def test_nothing_in_nothing_out():
    got = pointwise(weighted, NAMES, (np.ones((0, 3)), 1.0))
    assert got.total.shape == (0, 3)
    assert got.pair.shape == (0, 3, 2)
    assert got.total.dtype == np.float64


def test_a_bad_point_leaves_its_neighbors_alone():
    x = np.linspace(0.1, 5.0, 9)
    spoiled = x.copy()
    spoiled[4] = -1.0
    clean, got = pointwise(fragile, ("x",), (x,)), pointwise(fragile, ("x",), (spoiled,))
    assert np.isnan(got[4])
    np.testing.assert_array_equal(np.delete(got, 4), np.delete(clean, 4))


def test_types_follow_the_caller():
    assert isinstance(pointwise(fragile, ("x",), (2.0,)), np.float64)
    assert isinstance(pointwise(fragile, ("x",), (np.ones(2),)), np.ndarray)
    assert isinstance(pointwise(fragile, ("x",), ([1, 2],)), np.ndarray)
    from_jax = pointwise(fragile, ("x",), (jnp.ones(2),))
    assert isinstance(from_jax, jax.Array)
    assert from_jax.dtype == np.float64


def test_float64_without_touching_the_configuration():
    before = jax.enable_x64.value
    assert pointwise(fragile, ("x",), (1 + 2.0**-40,)) == np.sqrt(1 + 2.0**-40)
    assert jnp.ones(1).dtype == jnp.float32
    assert jax.enable_x64.value == before


def test_inside_a_transformation_the_ambient_precision_holds():
    def function(x):
        assert is_traced(x)
        return pointwise(fragile, ("x",), (x,))

    assert jax.jit(function)(jnp.ones(3)).dtype == jnp.float32
    assert jax.vmap(function)(jnp.ones(3)).shape == (3,)
    with jax.enable_x64(True):
        assert jax.jit(function)(jnp.ones(3)).dtype == jnp.float64
        assert float(jax.grad(function)(4.0)) == 0.25


def test_traced_arguments_broadcast_too():
    got = jax.jit(lambda x: pointwise(weighted, NAMES, (x, np.arange(4.0))))(jnp.ones((3, 1)))
    assert got.total.shape == (3, 4)
    assert got.pair.shape == (3, 4, 2)


def rooted(x, y, factor):
    xp = namespace(x, y)
    return Weighted(xp.where(x < 0, xp.nan, xp.sqrt(xp.abs(x))), factor * x * y)


def test_one_kernel_is_numpy_for_few_points_and_compiled_for_many():
    y = np.linspace(0.5, 2.0, FEW + 1)
    x = y - 1.0
    many, few = (elementwise(rooted, NAMES, (x[:count], y[:count]), (3.0,)) for count in (FEW + 1, FEW))
    assert many.total.shape == (FEW + 1,)
    np.testing.assert_allclose(few.total, many.total[:FEW], rtol=1e-15)
    np.testing.assert_allclose(few.pair, 3.0 * (x * y)[:FEW], rtol=1e-15)
    assert np.isnan(many.total[0])


def test_an_elementwise_kernel_follows_its_caller_too():
    number = elementwise(rooted, NAMES, (2.0, 1), (3.0,))
    assert isinstance(number.total, np.float64)
    assert number.pair == 6.0
    spread = elementwise(rooted, NAMES, (np.ones((3, 1)), np.ones(4)), (3.0,))
    assert spread.total.shape == spread.pair.shape == (3, 4)
    from_jax = elementwise(rooted, NAMES, (jnp.ones(2), 1.0), (3.0,))
    assert isinstance(from_jax.total, jax.Array)
    assert from_jax.total.dtype == np.float64
    with jax.enable_x64(True):
        assert float(jax.grad(lambda x: elementwise(rooted, NAMES, (x, 1.0), (3.0,)).pair)(2.0)) == 3.0
    with pytest.raises(InputError, match="shapes do not broadcast"):
        elementwise(rooted, NAMES, (np.ones(2), np.ones(3)), (3.0,))


def test_a_mask_is_not_ignored():
    with pytest.raises(InputError, match="x: got a masked array"):
        as_float64("x", np.ma.masked_array([1.0, 2.0], mask=[True, False]))


@pytest.mark.parametrize("value", ["1", None, 1j, ["1"], [1, [2]], {}, np.array(["a"]), object()])
def test_what_is_no_real_number(value):
    with pytest.raises(InputError, match=r"x: got .*, a real number or a rectangular array of real numbers is needed"):
        as_float64("x", value)


@pytest.mark.parametrize("value", [True, 3, np.int8(3), np.float16(0.5), [1, 2.5], np.uint64(7)])
def test_what_is_a_real_number(value):
    got = as_float64("x", value)
    assert got.dtype == np.float64
    np.testing.assert_array_equal(got, value)


def test_shapes_that_do_not_fit_are_all_named():
    message = r"shapes do not broadcast: x \(2,\), y \(3,\); make each axis equal or 1"
    with pytest.raises(InputError, match=message):
        broadcast(NAMES, (np.ones(2), np.ones(3)))


def test_a_traced_delay_is_refused_with_the_remedy():
    with pytest.raises(TracedDelayError, match="pass d as a plain number, for example through jit's static_argnums"):
        jax.jit(lambda d: concrete_delay(d).sum())(1.0)


@pytest.mark.parametrize("x", [2.0, np.array([2.0, 3.0])])
def test_plain_numbers_inside_somebody_elses_transformation_are_computed_at_once(x):
    seen = []

    def traced(factor):
        seen.append(pointwise(fragile, ("x",), (x,)))
        return factor * 2.0

    jax.jit(jax.vmap(jax.grad(traced)))(np.ones(2, np.float32))
    assert isinstance(seen[0], np.ndarray | np.float64)
    np.testing.assert_array_equal(seen[0], pointwise(fragile, ("x",), (x,)))
    assert not jax.enable_x64.value


def test_float32_inside_a_transformation_is_said_once(monkeypatch):
    monkeypatch.setattr(batching, "_warned", threading.Event())
    with jax.enable_x64(True), warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(lambda x: pointwise(fragile, ("x",), (x,)))(1.0)
    with pytest.warns(PrecisionWarning, match="call jax.config.update.'jax_enable_x64', True. first") as caught:
        jax.grad(lambda x: elementwise(jnp.square, ("x",), (x,)))(1.0)
    # The line named is the caller's.
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(lambda x: pointwise(fragile, ("x",), (x,)))(2.0)


def _product(x, y):
    """x^2 y, and a whole number that no derivative passes through."""
    return x * x * y, (x > y).astype(np.int32)


def test_derivatives_of_an_elementwise_kernel_are_those_of_its_points(x64):
    def first(x, y):
        return elementwise(_product, ("x", "y"), (x, y))[0]

    x, y = np.array([1.0, np.nan, 3.0]), np.array([2.0, 1.0, 0.5])
    by_x, by_y = (jax.vmap(jax.grad(first, k))(x, y) for k in (0, 1))
    np.testing.assert_array_equal(by_x, 2 * x * y)
    np.testing.assert_array_equal(by_y, x * x)
    # An argument that does not move costs nothing, and all of them may.
    assert jax.grad(lambda x: first(x, 2.0))(3.0) == 12
    assert jax.jvp(first, (3.0, 2.0), (1.0, 10.0)) == (18.0, 12 + 90)
    np.testing.assert_array_equal(jax.jit(jax.hessian(lambda v: first(*v)))(np.array([3.0, 2.0])), [[4, 6], [6, 0]])
    value, count = jax.jit(lambda x: elementwise(_product, ("x", "y"), (x, 1.0)))(2.0)
    assert (value, count, count.dtype) == (4.0, 1, np.int32)


def test_the_first_gradient_hands_out_no_intermediate_results(x64):
    def long(x, y):
        for _ in range(50):
            x = x * y + x
        return x

    # Outside `jit`, what goes from the value to the gradient: one number an argument.
    _, pullback = jax.vjp(lambda x, y: elementwise(long, ("x", "y"), (x, y)), 0.5, 0.25)
    assert len(jax.tree.leaves(pullback)) <= 4


def test_a_module_that_is_still_being_imported_makes_no_arrays(monkeypatch):
    """Another thread may be about to import JAX, whose module is empty at first."""
    monkeypatch.setitem(sys.modules, "jax", types.ModuleType("jax"))
    assert not is_jax(object())
    assert not is_traced(object())
