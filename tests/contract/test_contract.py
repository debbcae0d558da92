"""Contract of every public function of arrays: types, shapes, bad points, error messages and transformations."""

import inspect
import subprocess
import sys

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from mpmath import mpf

import oracles
import zwidth
from contract.cases import CASES, OTHERS, SINGLE_ERROR
from contract.matrix import EVERY_CASE
from contract.traced import (
    ROWS,
    compile_case,
    compute_float32,
    compute_float64,
    evaluate_case,
    find_family,
    has_gradient,
    make_batch,
    read_concrete,
)
from zwidth.core.errors import InputError, TracedDelayError
from zwidth.core.status import Status

ALL = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
OPTIONAL = {("boundary_point", "alpha"), ("boundary_point", "beta")}
KINDS = {"b": np.bool_, "f": np.float64, "c": np.complex128}


def assert_same(left, right, exact=True):
    for name, value in left.items():
        # Numbers and arrays are computed by different code, which may differ by rounding.
        np.testing.assert_allclose(value, right[name], rtol=0 if exact else 1e-13, atol=0 if exact else 1e-15)


def test_every_public_function_has_a_case():
    functions = {name for name in zwidth.__all__ if inspect.isfunction(getattr(zwidth, name))}
    assert functions == {case.function for case in CASES} | set(OTHERS)


@ALL
def test_numpy_arguments_return_float64_numpy_arrays(case):
    result = case.leaves(case.call(**case.arguments))
    for name, value in result.items():
        assert type(value) is np.ndarray, name
        assert value.shape[: value.ndim - case.extra_axes] == (3,), name
        assert value.dtype == KINDS.get(value.dtype.kind, np.int64 if case.function == "count_poles" else np.int32), (
            name
        )
    assert not jax.enable_x64.value


@ALL
def test_jax_arguments_return_jax_arrays_in_double_precision(case):
    # The arguments are exact in float32; the results must not be rounded to it.
    arguments = {name: np.float32(values) for name, values in case.arguments.items()}
    expected = case.leaves(case.call(**{name: np.float64(values) for name, values in arguments.items()}))
    result = case.leaves(case.call(**{name: jnp.asarray(values) for name, values in arguments.items()}))
    for name, value in result.items():
        assert isinstance(value, jax.Array), name
        assert value.dtype == expected[name].dtype, name
    assert_same(result, expected, exact=False)


@ALL
def test_single_numbers_return_numpy_scalars(case):
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
    # The first argument varies along the rows, the others along the columns.
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
def test_empty_arrays_return_empty_arrays(case, shape):
    for name, value in case.leaves(case.call(**{name: np.ones(shape) for name in case.good})).items():
        assert value.shape[: value.ndim - case.extra_axes] == shape, name


@ALL
def test_bad_point_is_marked_and_does_not_change_other_points(case):
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
@pytest.mark.parametrize("value", ["1", 1j, None, ["1"], [1.0, [2.0]], {}], ids=repr)
def test_error_names_the_argument_that_is_not_real(case, value):
    for name in case.good:
        # None stands for an omitted line or delay.
        if value is None and (case.function, name) in OPTIONAL:
            continue
        # Arguments that accept units have a different message for a string without a unit.
        with pytest.raises(InputError, match=rf"^{name}\w*: got .*(real number|drop the quotes)"):
            case.call(**(case.arguments | {name: value}))


@ALL
def test_error_names_shapes_that_do_not_broadcast(case):
    names = list(case.good)
    if len(names) > 1:
        arguments = {name: np.ones(3) for name in names} | {names[-1]: np.ones(2)}
        with pytest.raises(InputError, match=rf"shapes do not broadcast: .*{names[-1]} \(2,\)"):
            case.call(**arguments)


@ALL
def test_negative_zero_equals_zero(case):
    for name in case.good:
        zero, negative = (case.arguments | {name: np.array([z, z, z])} for z in (0.0, -0.0))
        try:
            expected = case.leaves(case.call(**zero))
        except InputError:
            continue
        assert_same(case.leaves(case.call(**negative)), expected)


@ALL
def test_arguments_are_not_modified(case):
    arguments = case.arguments
    result = case.leaves(case.call(**arguments))
    for value in result.values():
        # Read-only results cannot alias writable arguments.
        if value.flags.writeable:
            value[...] = 0
    for name, value in arguments.items():
        np.testing.assert_array_equal(value, case.arguments[name])


@ALL
def test_out_of_range_entry_sets_status_and_out_of_range_number_raises(case):
    clean = case.leaves(case.call(**case.arguments))
    for argument, beyond in case.beyond.items():
        arguments = case.arguments
        arguments[argument][1] = beyond
        result = case.leaves(case.call(**arguments))
        for name, value in result.items():
            np.testing.assert_array_equal(value[[0, 2]], np.asarray(clean[name])[[0, 2]], err_msg=name)
            if name == "status":
                assert value[1] == Status.OUT_OF_RANGE, argument
        assert is_marked(result, 1), argument
        numbers = {name: float(values[0]) for name, values in case.arguments.items()} | {argument: beyond}
        with pytest.raises(InputError, match=rf"^{argument}: got .*(must be|needed)"):
            case.call(**numbers)


@pytest.mark.parametrize("case", [case for case in CASES if case.strict], ids=lambda case: case.name)
def test_single_bad_quantity_raises(case):
    for argument, bad in case.bad.items():
        numbers = {name: float(values[0]) for name, values in case.arguments.items()} | {argument: bad}
        with pytest.raises(InputError, match=rf"^{argument}: got .*(must be|needed)"):
            case.call(**numbers)


def test_single_numbers_do_not_load_jax():
    program = f"""
import sys

sys.modules["jax"] = None
import numpy as np

import zwidth

zwidth.count_poles([0.8], [1.0, 0.9], 0.01, 3.0)
for name, line in (("beta", 0.3), ("alpha", 0.1)):
    zwidth.boundary_point(0.1, 1.0, **{{name: line}})
zwidth.stable_region(0.5, 1)
calls = {[(case.function, make_numbers(case)) for case in CASES if is_called_by_name(case)]!r}
for name, numbers in calls:
    getattr(zwidth, name)(**numbers)
del sys.modules["jax"]
assert not [name for name in sys.modules if name.partition(".")[0] in ("jax", "jaxlib")]
print(len(calls))
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) == len(CASES) - 3


def make_numbers(case):
    return {**getattr(case.call, "keywords", {}), **{name: values[1] for name, values in case.good.items()}}


def is_called_by_name(case):
    return case.function not in ("count_poles", "boundary_point")


def is_marked(result, index):
    """Return True if a point is marked as bad: NaN, False, or a count of -1."""
    values = [(name, np.asarray(value)[index]) for name, value in result.items()]
    floats = [np.isnan(value).any() for _, value in values if value.dtype.kind in "fc"]
    if floats:
        return any(floats)
    remaining = {value.dtype.kind: value for name, value in values if name not in ("status", "method")}
    return not remaining["b"] if "b" in remaining else remaining["i"] == -1


TRACED = [case for case in CASES if not case.refuses_tracing]
TRACEABLE = pytest.mark.parametrize("case", TRACED, ids=lambda case: case.name)
SMOOTH = pytest.mark.parametrize("case", [case for case in TRACED if has_gradient(case)], ids=lambda case: case.name)


def compute_direct(case, columns):
    columns = dict(zip(case.free, columns, strict=True))
    fixed = {name: np.full(ROWS, value) for name, value in read_concrete(case).items()}
    return case.leaves(case.call(**columns, **fixed))


@TRACEABLE
def test_traced_values_and_statuses_equal_those_of_direct_calls(case):
    traced, direct = compute_float64(case.name)[0], compute_direct(case, make_batch(case)[0])
    for name, value in traced.items():
        assert value.shape == direct[name].shape, name
        assert value.dtype == direct[name].dtype or value.dtype.kind == "i", name
        rtol = 1e-9 if name == "modulus_frequency" else 1e-11  # a minimum is accurate to half the digits only
        np.testing.assert_allclose(value, direct[name], rtol=rtol, atol=1e-12, err_msg=name)


@TRACEABLE
def test_traced_bad_points_do_not_change_other_points(case):
    columns, good = make_batch(case)
    clean = [np.where(good, column, column[0]) for column in columns]
    with jax.enable_x64(True):
        result = compile_case(case.name)([jnp.asarray(column) for column in clean])
    leaves = result[1] if has_gradient(case) else result
    traced = compute_float64(case.name)[0]
    for name, value in leaves.items():
        np.testing.assert_array_equal(np.asarray(value)[good], traced[name][good], err_msg=name)
    assert all(is_marked(traced, index) for index in np.flatnonzero(~good))


@SMOOTH
def test_derivatives_are_finite_at_good_points_and_nan_at_bad_points(case):
    slopes = compute_float64(case.name)[1]
    assert slopes
    gradient = np.stack([np.asarray(part) for parts in slopes.values() for part in parts], axis=-1)
    good = make_batch(case)[1]
    assert np.isfinite(gradient[good]).all()
    assert np.isnan(gradient[~good]).any(axis=-1).all()


@TRACEABLE
def test_without_x64_results_are_float32_with_equal_statuses(case):
    # Values beyond the float64 domain overflow in float32, which changes the status but not the NaN.
    columns, _ = make_batch(case, beyond=False)
    columns = [np.float32(column) for column in columns]
    direct = compute_direct(case, [np.float64(column) for column in columns])
    for name, value in compute_float32(find_family(case.name))[case.name].items():
        assert value.dtype in (jnp.float32, jnp.complex64, jnp.bool_, jnp.int32), name
        if value.dtype.kind in "fc":
            np.testing.assert_allclose(value, direct[name], rtol=SINGLE_ERROR, atol=SINGLE_ERROR, err_msg=name)
        else:
            np.testing.assert_array_equal(value, direct[name], err_msg=name)


@pytest.mark.parametrize("name", ["is_stable", "normalize", "boundary"])
def test_untraced_arguments_in_a_transformation_are_computed_directly(name):
    case = next(case for case in CASES if case.name == name)
    expected = case.leaves(case.call(**case.arguments))
    first = {name: values[0] for name, values in case.good.items()}
    single = case.leaves(case.call(**first))
    results = {}

    def traced(factor):
        # Equal to a direct call to the last bit, as NumPy arrays.
        results["array"] = case.leaves(case.call(**case.arguments))
        results["number"] = case.leaves(case.call(**first))
        return factor * 2.0

    jax.jit(jax.vmap(jax.grad(traced)))(np.ones(2, np.float32))
    assert all(type(value) is np.ndarray for value in results["array"].values())
    assert_same(results["array"], expected)
    assert_same(results["number"], single)


@pytest.mark.parametrize("case", [case for case in CASES if case.concrete], ids=lambda case: case.name)
def test_traced_delay_raises_where_it_determines_a_shape(case):
    with pytest.raises(TracedDelayError, match=r"d: got a traced value, .* pass .*a plain number"):
        jax.jit(lambda d: case.call(**{**case.arguments, "d": d}))(1.0)


@pytest.mark.parametrize("case", [case for case in EVERY_CASE if case.refuses_tracing], ids=lambda case: case.name)
def test_error_names_the_method_that_cannot_be_traced(case):
    name = case.function.rpartition(".")[2]
    with pytest.raises(InputError, match=rf"traced by JAX; call {name} with plain numbers, outside jit"):
        jax.jit(lambda values: case.call(**values))(case.arguments)


# --- Derivatives of single functions, evaluated by the programs compiled above ---


def test_spectral_radius_and_its_derivative_at_traced_delays():
    delays, h = [0.0, 4.0, 1.5], mpf(10) ** -20
    slopes = evaluate_case("spectral_radius", alpha=0.2, beta=0.4, delta=0.1, d=delays)[1]["value"]["alpha"]
    for d, slope in zip(delays, slopes, strict=True):
        with mp.workdps(60):
            low, high = (oracles.exact_radius(mpf("0.2") + step, mpf("0.4"), mpf("0.1"), d) for step in (-h, h))
            assert slope == pytest.approx(float((high - low) / (2 * h)), rel=1e-9)
    np.testing.assert_allclose(slopes[:2], [0.92824, 0.53533], atol=1e-5)
    values = evaluate_case("spectral_radius", alpha=0.5, beta=0.5, delta=0.1, d=[0.0, 1.5, 30.0])[0]["value"]
    assert values[1] == pytest.approx(float(oracles.exact_radius(0.5, 0.5, 0.1, 1.5)), rel=1e-8)
    np.testing.assert_allclose(values, zwidth.spectral_radius(0.5, 0.5, 0.1, [0.0, 1.5, 30.0]), rtol=1e-11)


def test_spectral_radius_has_no_derivative_at_a_double_pole():
    maximum = zwidth.alpha_max(5.0, 0.0)
    slopes = evaluate_case("spectral_radius", alpha=maximum.alpha, beta=maximum.beta, delta=5.0, d=0.0)[1]["value"]
    assert all(np.isnan(slope) for slope in slopes.values())


def test_decay_rate_and_its_derivative():
    values, slopes = evaluate_case("decay_rate", alpha=0.1, beta=0.3, delta=0.2, d=1.0)
    assert values["value"] == pytest.approx(zwidth.decay_rate(0.1, 0.3, 0.2, 1.0), rel=1e-12)
    h = 1e-5
    difference = (zwidth.decay_rate(0.1 + h, 0.3, 0.2, 1.0) - zwidth.decay_rate(0.1 - h, 0.3, 0.2, 1.0)) / (2 * h)
    assert slopes["value"]["alpha"] == pytest.approx(difference, rel=1e-7)


@pytest.mark.parametrize("line", ["beta", "alpha"])
def test_derivatives_of_boundary_points_match_mpmath(line):
    """Derivatives with respect to the given coordinate, delta and d, at integer d from the right, against
    secant roots in mpmath.
    """
    other, axis, step = "alpha" if line == "beta" else "beta", ("alpha", "beta").index(line), mpf(10) ** -25
    points = [(0.1, 0.4, 0.4), (0.1, 0.4, 2.0), (0.05, 0.9, 2.3), (0.02, 0.1, 7.0)]
    if line == "beta":
        points += [(0.3, 0.1, 1.0), (0.1, 0.7, 2.4), (0.5, 0.0, 0.0), (50.0, 0.1, 1.0)]
    names = (line, "delta", "d")
    columns = dict(zip(names, np.transpose(points), strict=True))
    leaves, slopes = evaluate_case(f"boundary_point at constant {line}", **columns)

    def exact(omega, number, delta, d):
        def offset(w):
            return oracles.boundary(w, delta, d)[axis] - number

        start = (mpf(float(omega)), mpf(float(omega)) * (1 - mpf(10) ** -9))
        return oracles.boundary(mp.findroot(offset, start, solver="secant", tol=mpf(10) ** -75), delta, d)[1 - axis]

    with mp.workdps(160):
        for row, values in enumerate(points):
            if values[0] == 50.0:
                # No wall in this row is stable.
                assert np.isnan([leaves[other][row], *(slopes[other][name][row] for name in names)]).all()
                continue
            for k, name in enumerate(names):
                shifted = [mpf(value) + (step if j == k else 0) for j, value in enumerate(values)]
                expected = (
                    exact(leaves["omega"][row], *shifted) - exact(leaves["omega"][row], *map(mpf, values))
                ) / step
                assert float(slopes[other][name][row]) == pytest.approx(float(expected), rel=1e-10)


def test_derivatives_of_areas_match_central_differences():
    step, d = 1e-5, np.array([0.0, 0.3, 1.0, 2.5, 0.1, 1.3])
    low, high = zwidth.stable_area(np.array([1.0 - step, 1.0 + step]), 1.3)
    slopes = evaluate_case("stable_area", delta=1.0, d=1.3)[1]["value"]
    assert slopes["delta"] == pytest.approx((high - low) / (2 * step), rel=1e-8)
    area, slopes = evaluate_case("passive_area", delta=0.7, d=d)
    np.testing.assert_allclose(area["value"], zwidth.passive_area(0.7, d), rtol=1e-14)
    for delay, by_d in zip(d[4:], slopes["value"]["d"][4:], strict=True):
        # A maximum over frequency is accurate to the square root of a rounding error only.
        low, high = zwidth.passive_area(0.7, np.array([delay - step, delay + step]))
        assert by_d == pytest.approx((high - low) / (2 * step), abs=1e-7)
