"""Every requirement is put back into the forward model; impossible ones say so."""

import numpy as np
import pytest

import zwidth
from contract.traced import ask as ask_traced
from zwidth import max_stiffness, required, sensitivities
from zwidth.words.status import Status

# The search takes a logarithm of K_max/K within 1e-14 for 0; the forward model adds a few rounding errors.
RTOL = 3e-14
COUNT = 64


@pytest.fixture(scope="module")
def devices():
    """Random devices: delta from 1e-3 to 1e2, d from 0 to 30, whole for every third."""
    random = np.random.default_rng(4)
    mass, period = 10 ** random.uniform(-3, 1, COUNT), 10 ** random.uniform(-5, -1, COUNT)
    damping = 10 ** random.uniform(-3, 2, COUNT) * mass / period
    d = 10 ** random.uniform(-1, 1.5, COUNT)
    d[::3] = np.floor(d[::3])
    damping[:4] = 0.0
    return {"mass": mass, "damping": damping, "period": period, "delay": d * period}


def ask(name, wanted, device):
    return required(name, wanted, **{key: value for key, value in device.items() if key != name})


# How a little more of the quantity moves K_max past the answer.
IMPROVES = {"damping": 1.0, "period": -1.0, "delay": -1.0, "mass": 1.0}


@pytest.mark.parametrize("name", IMPROVES)
@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_the_forward_model_returns_the_wanted_stiffness(name, factor, devices):
    wanted = factor * max_stiffness(**devices)
    answer = ask(name, wanted, devices)
    found = (answer.status == Status.OK) & (answer.value > 0)
    assert np.sum(found) > COUNT // 4
    reached = max_stiffness(**(devices | {name: np.where(found, answer.value, devices[name])}))
    np.testing.assert_allclose(reached[found], wanted[found], rtol=RTOL)
    beyond = np.where(found, answer.value, devices[name]) * (1.0 - 1e-5 * IMPROVES[name])
    # On the worse side the wanted wall is out of reach; K_max is nearly flat on some plateaus.
    assert np.all(max_stiffness(**(devices | {name: beyond}))[found] < wanted[found] * (1 + 1e-12))
    if factor == 1.0:
        _stable_just_below_and_not_above(wanted, devices | {name: np.where(found, answer.value, devices[name])}, found)
    free = answer.value == 0
    assert np.all(
        max_stiffness(**(devices | {name: np.where(free, 1e-9 * devices[name], devices[name])}))[free]
        >= wanted[free] * (1 - 1e-6)
    )
    assert np.all(np.isnan(answer.value) == (answer.status == Status.UNREACHABLE))


def _stable_just_below_and_not_above(wanted, device, found):
    wall = zwidth.normalize(**device, stiffness=wanted)
    use = found & (wall.d <= 8)
    alpha, delta, d = wall.alpha[use], wall.delta[use], wall.d[use]
    beta = zwidth.alpha_max(delta, d).beta
    assert np.all(zwidth.is_stable(alpha * (1 - 1e-6), beta, delta, d, method="certified"))
    assert not np.any(zwidth.is_stable(alpha * (1 + 1e-6), beta, delta, d, method="certified"))


def test_a_period_for_a_delay_in_periods():
    mass, damping, d = 0.1, np.array([0.0, 1.0, 10.0, 100.0]), np.array([0.0, 0.3, 1.0, 4.0])
    answer = required("period", 20e3, mass=mass, damping=damping, delay_periods=d)
    reached = max_stiffness(mass=mass, damping=damping, period=answer.value, delay=d * answer.value)
    np.testing.assert_allclose(reached, 20e3, rtol=RTOL)


def test_no_rate_makes_up_for_a_delay_in_seconds():
    # In continuous time this device reaches 1.80e5 N/m.
    answer = required("period", np.array([1.5e5, 1.9e5]), mass=1e-3, damping=100.0, delay=1e-3)
    assert answer.status.tolist() == [Status.OK, Status.UNREACHABLE]
    assert np.isnan(answer.value[1])


def test_nothing_is_required_where_the_rest_is_enough():
    assert required("damping", np.array([1e3]), mass=0.1, period=1e-3, delay=1e-3).value == 0
    assert required("mass", np.array([1.0]), damping=100.0, period=1e-3, delay=1e-3).value == 0
    assert required("delay", np.array([1e9]), mass=0.1, damping=0.0, period=1e-3).status == Status.UNREACHABLE


def test_the_longest_delay_is_found_beyond_the_best_one():
    # At delta = 10 a delay of about 0.1 periods is better than none.
    device = {"mass": 1.0, "damping": 10.0, "period": 1.0}
    best = np.max(max_stiffness(**device, delay=np.linspace(0, 0.3, 301)))
    none = max_stiffness(**device, delay=0.0)
    wanted = np.array([0.5 * (best + none)])
    answer = required("delay", wanted, **device)
    assert best > 1.01 * none
    np.testing.assert_allclose(max_stiffness(**device, delay=answer.value), wanted, rtol=RTOL)


def test_derivatives_are_those_of_the_inverse_function(x64):
    damping = np.array([10.0])
    wanted = max_stiffness(damping=damping, mass=0.1, period=1e-3, delay=1e-3)
    gain = sensitivities(damping=damping, mass=0.1, period=1e-3, delay=1e-3)

    # A requirement's only number is its value, which is positive: the slope of its leaves' sum is its own.
    leaves, slopes = ask_traced("required damping", stiffness=wanted, mass=0.1, period=1e-3, delay=1e-3)
    assert leaves["value"] == pytest.approx(damping, rel=1e-10)
    np.testing.assert_allclose(slopes["stiffness"], 1 / gain.per_damping, rtol=1e-10)
    np.testing.assert_allclose(slopes["mass"], -gain.per_mass / gain.per_damping, rtol=1e-10)


def test_bad_entries_spoil_no_other():
    answer = required("damping", np.array([20e3, -1.0, np.nan]), mass=0.1, period=1e-3, delay=1e-3)
    assert answer.status.tolist() == [Status.OK, Status.INVALID_INPUT, Status.INVALID_INPUT]
    assert np.isnan(answer.value).tolist() == [False, True, True]


def test_wrong_input_is_named():
    with pytest.raises(zwidth.InputError, match=r"stiffness: got -1; it must be finite and greater than 0"):
        required("damping", -1, mass=0.1, period=1e-3)
    with pytest.raises(zwidth.InputError, match="delay_periods: got 1, and a delay in seconds; give one of the two"):
        required("period", 1e3, mass=0.1, delay=1e-3, delay_periods=1)
    with pytest.raises(zwidth.InputError, match=r"mass: got 0\.1, but it is what is sought; leave it out"):
        required("mass", 1e3, mass=0.1, period=1e-3)
    with pytest.raises(zwidth.InputError, match="mass: got None, a real number"):
        required("period", 1e3)
    with pytest.raises(zwidth.InputError, match="parameter: got 'rate'"):
        required("rate", 1e3, mass=0.1)  # pyright: ignore[reportArgumentType]
    with pytest.raises(zwidth.InputError, match="period: got 0"):
        required("delay", 1e3, mass=0.1, period=0)
