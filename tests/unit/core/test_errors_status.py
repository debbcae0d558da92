"""Test exceptions and status codes: base classes, and messages with field, value, allowed values and remedy."""

import inspect

import pytest

import zwidth
from zwidth.core import errors
from zwidth.core.errors import check_choice, describe_choice
from zwidth.core.status import Method, Status

CLASSES = [value for _, value in inspect.getmembers(errors, inspect.isclass) if not issubclass(value, Warning)]


@pytest.mark.parametrize("error", CLASSES)
def test_every_error_is_a_documented_zwidth_error(error):
    assert issubclass(error, zwidth.ZwidthError)
    assert error.__doc__


@pytest.mark.parametrize(
    "error, base",
    [
        (errors.InputError, ValueError),
        (errors.ConfigError, ValueError),
        (errors.StoreExistsError, FileExistsError),
        (errors.TracedDelayError, TypeError),
    ],
)
def test_errors_have_standard_base_classes(error, base):
    assert issubclass(error, base)


def test_describe_choice_suggests_the_nearest_value():
    assert describe_choice("hold", ("held", "fractional_power")) == (
        "got 'hold', allowed are 'held', 'fractional_power'; did you mean 'held'?"
    )
    assert "did you mean" not in describe_choice("xyz", ("held", "fractional_power"))
    assert "did you mean" not in describe_choice(None, ("held",))


def test_check_choice_rejects_unknown_values():
    check_choice("side", "upper", ("lower", "upper"))
    with pytest.raises(errors.InputError, match=r"side: got 'uper', allowed are 'lower', 'upper'; did you mean"):
        check_choice("side", "uper", ("lower", "upper"))  # codespell:ignore


@pytest.mark.parametrize("status", Status)
def test_every_status_has_one_sentence(status):
    assert status.message.endswith(".")
    assert status.message[0].isupper()


def test_status_and_method_codes_are_stable():
    # Stored datasets contain these numbers.
    statuses = "OK INVALID_INPUT NOT_CONVERGED NO_BOUNDARY UNDECIDED ON_BOUNDARY UNREACHABLE OUT_OF_RANGE"
    assert [(status.name, int(status)) for status in Status] == [(name, k) for k, name in enumerate(statuses.split())]
    methods = "COMPANION CROSSOVER CERTIFIED"
    assert [(method.name, int(method)) for method in Method] == [(name, k) for k, name in enumerate(methods.split())]
