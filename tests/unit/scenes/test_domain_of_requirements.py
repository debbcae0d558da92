"""What lies beyond the range of the model is refused, point by point in arrays; nothing inside is."""

import subprocess
import sys
from functools import partial

import numpy as np
import pytest

import zwidth
from zwidth import max_stiffness, required, sensitivities
from zwidth.words.status import Status

BEYOND = [
    (partial(required, "damping"), {"stiffness": 1e3, "mass": 1e-162, "period": 1e-3}, "mass"),
    (partial(required, "mass"), {"stiffness": 1e3, "damping": 1e-300, "period": 1e-3, "delay": 1e-3}, "damping"),
    (partial(required, "delay"), {"stiffness": 1e-300, "mass": 1.0, "damping": 1.0, "period": 1e-3}, "stiffness"),
    (partial(required, "period"), {"stiffness": 1e3, "mass": 1e31, "delay": 1e-3}, "mass"),
    (partial(required, "period"), {"stiffness": 1e3, "mass": 1.0, "delay_periods": 2e5}, "d"),
    (partial(required, "damping"), {"stiffness": 1e3, "mass": 1.0, "period": 1e-3, "delay": 1e3}, "d"),
    (max_stiffness, {"mass": 1e-162, "period": 1e-3}, "mass"),
    (max_stiffness, {"mass": 1e-10, "damping": 1e10, "period": 1e-3}, "delta"),
    (sensitivities, {"mass": 1.0, "period": 1e-31}, "period"),
    (zwidth.normalize, {"mass": 1.0, "period": 1e-3, "stiffness": -1e31}, "stiffness"),
    (zwidth.normalize, {"mass": 1.0, "period": 1e-3, "virtual_damping": 1e-31}, "virtual_damping"),
]


@pytest.mark.parametrize("function, given, name", BEYOND)
def test_scalars_beyond_the_range_are_refused(function, given, name):
    with pytest.raises(zwidth.InputError, match=rf"^{name}: got .*must be"):
        function(**given)


@pytest.mark.parametrize("function, given, name", [case for case in BEYOND if case[0] is not zwidth.normalize])
def test_entries_beyond_the_range_get_nan_and_a_status(function, given, name):
    # Every entry beside it is an ordinary device.
    usual = {"stiffness": 1e3, "mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": 1e-3, "delay_periods": 1.0}
    columns = {key: np.array([usual[key], value]) for key, value in given.items()}
    answer = function(**columns)
    if function is max_stiffness:
        np.testing.assert_array_equal(np.isnan(answer), [False, True])
        return
    assert answer.status.tolist() == [Status.OK, Status.OUT_OF_RANGE]
    np.testing.assert_array_equal(np.isnan(answer[0]), [False, True])


def test_normalized_entries_beyond_the_range_are_nan():
    wall = zwidth.normalize(mass=np.array([1.0, 1e-31]), period=1e-3, stiffness=np.array([1e3, 1e3]))
    np.testing.assert_array_equal(np.isnan(wall.alpha), [False, True])


@pytest.mark.parametrize("seed", range(2))
def test_devices_up_to_the_corners_of_the_range_are_put_back(seed):
    """An answer that is OK reaches the wanted stiffness; one that is not lies beyond the range or does not exist."""
    random = np.random.default_rng(seed)
    count = 300
    mass, period = 10 ** random.uniform(-9, 9, count), 10 ** random.uniform(-9, 3, count)
    delta = np.where(random.random(count) < 0.1, 0.0, 10 ** random.uniform(-9, 9, count))
    d = np.where(random.random(count) < 0.5, random.integers(0, 9, count), 10 ** random.uniform(-3, 4.5, count))
    device = {"mass": mass, "damping": delta * mass / period, "period": period, "delay": d * period}
    wanted = max_stiffness(**device) * 10 ** random.uniform(-2, 2, count)
    answers = {
        "damping": required("damping", wanted, mass=mass, period=period, delay=device["delay"]),
        "delay": required("delay", wanted, mass=mass, damping=device["damping"], period=period),
        "mass": required("mass", wanted, damping=device["damping"], period=period, delay=device["delay"]),
        "period": required("period", wanted, mass=mass, damping=device["damping"], delay=device["delay"]),
    }
    for name, answer in answers.items():
        assert np.all(np.isnan(answer.value) == (answer.status != Status.OK))
        assert np.mean(answer.status == Status.OK) > 0.3, name
        solved = (answer.status == Status.OK) & (answer.value > 0)
        reached = max_stiffness(**(device | {name: np.where(solved, answer.value, device[name])}))
        np.testing.assert_allclose(reached[solved], wanted[solved], rtol=1e-12, err_msg=name)


def test_single_devices_need_no_jax():
    program = (
        "import sys, zwidth\n"
        "zwidth.max_stiffness(mass=0.1, damping=10.0, period=1e-3, delay=1e-3)\n"
        "zwidth.sensitivities(mass=0.1, damping=10.0, period=1e-3, delay=1e-3)\n"
        "zwidth.required('damping', 2e4, mass=0.1, period=1e-3, delay=1e-3)\n"
        "zwidth.alpha_max(0.1, 1), zwidth.stiffness_slope(2.5), zwidth.alpha_max(0.1, 1.5, delay='fractional_power')\n"
        "assert 'jax' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
