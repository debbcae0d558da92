"""What every public function of arrays promises: types, shapes, bad points, messages, transformations."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from contract.cases import CASES, OTHERS
from zwidth.errors import InputError, TracedDelayError

ALL = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
LIGHT = pytest.mark.parametrize("case", [case for case in CASES if not case.heavy], ids=lambda case: case.name)
KINDS = {"b": np.bool_, "f": np.float64, "c": np.complex128}


def assert_same(left, right, exact=True):
    for name, value in left.items():
        # A single number is compiled apart from an array, to the last place.
        np.testing.assert_allclose(value, right[name], rtol=0 if exact else 1e-13, atol=0 if exact else 1e-15)


def test_every_public_function_is_covered():
    functions = {name for name in zwidth.__all__ if inspect.isfunction(getattr(zwidth, name))}
    assert functions == {case.name for case in CASES} | set(OTHERS)


@ALL
def test_numpy_in_numpy_out_in_float64(case):
    result = case.leaves(case.call(**case.arguments))
    for name, value in result.items():
        assert type(value) is np.ndarray, name
        assert value.shape[: value.ndim - case.extra_axes] == (3,), name
        assert value.dtype == KINDS.get(value.dtype.kind, np.int32), name
    assert not jax.config.jax_enable_x64


@ALL
def test_lists_are_arrays(case):
    assert_same(case.leaves(case.call(**case.good)), case.leaves(case.call(**case.arguments)))


@ALL
def test_jax_in_jax_out_with_all_digits(case):
    # Powers of two, so that float32 holds them: nothing else may be rounded to it.
    arguments = {name: np.float32(values) for name, values in case.arguments.items()}
    expected = case.leaves(case.call(**{name: np.float64(values) for name, values in arguments.items()}))
    result = case.leaves(case.call(**{name: jnp.asarray(values) for name, values in arguments.items()}))
    for name, value in result.items():
        assert isinstance(value, jax.Array), name
        assert value.dtype == expected[name].dtype, name
    assert_same(result, expected)


@ALL
def test_numbers_in_numbers_out(case):
    first = {name: values[0] for name, values in case.good.items()}
    for convert in (float, np.float64, np.asarray):
        result = case.leaves(case.call(**{name: convert(value) for name, value in first.items()}))
        for name, value in result.items():
            assert isinstance(value, np.ndarray if case.extra_axes else np.generic), name
            assert value.ndim == case.extra_axes, name
    assert_same(result, {k: v[0] for k, v in case.leaves(case.call(**case.arguments)).items()}, exact=False)


@ALL
def test_arguments_broadcast(case):
    names = list(case.good)
    arguments = {name: values[:2] for name, values in case.arguments.items()}
    # The first argument runs down, the others run across.
    spread = {name: arguments[name][:, None] if name == names[0] else arguments[name] for name in names}
    if len(names) == 1:
        spread = {names[0]: np.broadcast_to(arguments[names[0]], (2, 2))}
    full = {name: np.broadcast_to(value, (2, 2)).copy() for name, value in spread.items()}
    spread_result, full_result = case.leaves(case.call(**spread)), case.leaves(case.call(**full))
    for name, value in full_result.items():
        assert value.shape[:2] == (2, 2), name
        np.testing.assert_array_equal(np.broadcast_to(spread_result[name], value.shape), value)


@ALL
@pytest.mark.parametrize("shape", [(0,), (2, 0)])
def test_nothing_in_nothing_out(case, shape):
    for name, value in case.leaves(case.call(**{name: np.ones(shape) for name in case.good})).items():
        assert value.shape[: value.ndim - case.extra_axes] == shape, name


@ALL
def test_a_bad_point_is_marked_and_leaves_its_neighbors_alone(case):
    clean = case.leaves(case.call(**case.arguments))
    for argument, bad in case.bad.items():
        arguments = case.arguments
        arguments[argument][1] = bad
        result = case.leaves(case.call(**arguments))
        for name, value in result.items():
            np.testing.assert_array_equal(value[[0, 2]], np.asarray(clean[name])[[0, 2]], err_msg=name)
            if name == "status":
                assert value[1] != 0
            elif value.dtype.kind == "b":
                assert not value[1]
        spoiled = [name for name, value in result.items() if value.dtype.kind in "fc" and np.isnan(value[1]).all()]
        assert spoiled or all(value.dtype.kind in "bi" for value in result.values())


@ALL
def test_arguments_are_left_as_they_are(case):
    arguments = case.arguments
    result = case.leaves(case.call(**arguments))
    for value in result.values():
        value[...] = 0
    for name, value in arguments.items():
        np.testing.assert_array_equal(value, case.arguments[name])


@ALL
@pytest.mark.parametrize("value", ["1", 1j, None, ["1"], [1.0, [2.0]], {}], ids=repr)
def test_what_is_no_real_number_is_named(case, value):
    for name in case.good:
        if value is None and case.name == "boundary_point" and name not in ("delta", "d"):
            # There None says that the line is not given.
            continue
        with pytest.raises(InputError, match=rf"^{name}\w*: got .*real number"):
            case.call(**(case.arguments | {name: value}))


@ALL
def test_shapes_that_do_not_fit_are_named(case):
    names = list(case.good)
    if len(names) > 1:
        arguments = {name: np.ones(3) for name in names} | {names[-1]: np.ones(2)}
        with pytest.raises(InputError, match=rf"shapes do not broadcast: .*{names[-1]} \(2,\)"):
            case.call(**arguments)


@ALL
def test_negative_zero_is_zero(case):
    for name in case.good:
        zero, negative = (case.arguments | {name: np.array([z, z, z])} for z in (0.0, -0.0))
        try:
            expected = case.leaves(case.call(**zero))
        except InputError:
            continue
        assert_same(case.leaves(case.call(**negative)), expected)


def traced(case):
    """The case as a function of its traceable arguments alone."""
    fixed = {name: case.arguments[name][0] for name in case.concrete}
    free = [name for name in case.good if name not in case.concrete]

    def function(*values):
        return case.leaves(case.call(**dict(zip(free, values, strict=True)), **fixed))

    return function, [case.arguments[name] for name in free]


@LIGHT
def test_jit_and_vmap_agree_with_the_direct_call(case, x64):
    function, values = traced(case)
    direct = case.leaves(case.call(**case.arguments))
    for transformed in (jax.jit(function), jax.jit(jax.vmap(function))):
        result = transformed(*map(jnp.asarray, values))
        for name, value in result.items():
            assert value.shape == direct[name].shape, name
            assert value.dtype == direct[name].dtype or value.dtype.kind == "i", name
            np.testing.assert_allclose(value, direct[name], rtol=1e-11, atol=1e-12, err_msg=name)


@LIGHT
def test_plain_numbers_inside_somebody_elses_transformation_are_computed_at_once(case):
    expected = case.leaves(case.call(**case.arguments))
    first = {name: values[0] for name, values in case.good.items()}
    of_one = case.leaves(case.call(**first))
    seen = {}

    def traced(factor):
        # A direct call as any other: NumPy in, NumPy out, to the last place.
        seen["array"] = case.leaves(case.call(**case.arguments))
        seen["number"] = case.leaves(case.call(**first))
        return factor * 2.0

    jax.jit(jax.vmap(jax.grad(traced)))(np.ones(2, np.float32))
    assert all(type(value) is np.ndarray for value in seen["array"].values())
    assert_same(seen["array"], expected)
    assert_same(seen["number"], of_one)


@LIGHT
def test_inside_jit_the_ambient_precision_holds(case):
    function, values = traced(case)
    direct = case.leaves(case.call(**case.arguments))
    result = jax.jit(function)(*(jnp.asarray(np.float32(value)) for value in values))
    for name, value in result.items():
        assert value.dtype in (jnp.float32, jnp.complex64, jnp.bool_, jnp.int32), name
        if value.dtype.kind in "fc":
            np.testing.assert_allclose(value, direct[name], rtol=2e-3, atol=2e-3, err_msg=name)


@LIGHT
def test_bad_points_are_marked_inside_a_transformation_too(case, x64):
    function, values = traced(case)
    names = [name for name in case.good if name not in case.concrete]
    compiled = jax.jit(function)
    for argument, bad in case.bad.items():
        if argument in case.concrete:
            continue
        spoiled = [value.copy() for value in values]
        spoiled[names.index(argument)][1] = bad
        clean, result = compiled(*values), compiled(*spoiled)
        for name, value in result.items():
            np.testing.assert_array_equal(value[jnp.array([0, 2])], clean[name][jnp.array([0, 2])], err_msg=name)
        marked = [
            bool(np.isnan(v[1]).all() if v.dtype.kind in "fc" else not v[1]) for n, v in result.items() if n != "status"
        ]
        assert any(marked)


@LIGHT
def test_derivatives_at_bad_points_are_nan(case, x64):
    function, values = traced(case)
    names = [name for name in case.good if name not in case.concrete]

    def total(point):
        leaves = [v for v in function(*point).values() if v.dtype.kind in "fc"]
        return sum(jnp.sum(jnp.abs(leaf)) for leaf in leaves)

    points = np.stack(values, axis=-1)[1]
    rows = []
    for argument in names:
        if argument in case.bad:
            rows.append(points.copy())
            rows[-1][names.index(argument)] = case.bad[argument]
    if not rows or all(v.dtype.kind in "bi" for v in case.leaves(case.call(**case.arguments)).values()):
        pytest.skip("truth values and counts have no derivative")
    gradient = jax.jit(jax.vmap(jax.grad(total)))(np.array(rows))
    assert np.isnan(gradient).any(axis=-1).all()


@pytest.mark.parametrize("case", [case for case in CASES if case.concrete], ids=lambda case: case.name)
def test_a_traced_delay_is_refused_where_it_decides_a_shape(case):
    with pytest.raises(TracedDelayError, match=r"d: got a traced value, .* pass .*a plain number"):
        jax.jit(lambda d: case.call(**{**case.arguments, "d": d}))(1.0)
