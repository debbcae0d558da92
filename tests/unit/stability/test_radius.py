"""Spectral radius by every method: error bounds and certificates held against references and mpmath's roots."""

from pathlib import Path

import jax
import numpy as np
import pytest
from mpmath import mp
from zwidth.stability.methods import Method, radius_of

import oracles
import tolerances as tol
import zwidth
from zwidth.errors import InputError
from zwidth.status import Status

LABELS = Path(__file__).resolve().parents[2] / "reference" / "labels.npz"
METHODS = [("newton", 1e-9), ("bisection", 1e-9), ("companion", None)]


@pytest.fixture(scope="module")
def labels():
    """The points of two degrees: every degree is compiled for every method."""
    with np.load(LABELS) as file:
        some = np.isin(file["d"], [0.0, 1.5])
        return {name: file[name][some] for name in file.files}


@pytest.mark.parametrize("method, accuracy", METHODS)
def test_scattered_points_keep_their_bounds(labels, method, accuracy):
    found = radius_of(*(labels[name] for name in ("alpha", "beta", "delta", "d")), method=method, accuracy=accuracy)
    assert (found.status == Status.OK).all()
    error = np.abs(found.radius - labels["rho"])
    assert (error <= found.error).all()
    # An honest bound that says nothing would be of no use; bisection adds that of its test to that of the interval.
    assert np.quantile(found.error / labels["rho"], 0.8) <= 2.1e-9
    if method == "newton":
        assert found.certified.mean() > 0.85
        assert (found.error <= 1.1e-9 * labels["rho"])[found.certified].all()
        assert (found.method[found.certified] == Method.NEWTON).all()
    else:
        assert not found.certified.any()


def exact_radius(alpha, beta, delta, d):
    with mp.workdps(oracles.digits_for(delta)):
        return max(
            abs(root) for root in mp.polyroots(oracles.polynomial(alpha, beta, delta, d)[::-1], asc=True, maxsteps=400)
        )


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("d", [0.0, 1.5])
def test_maps_keep_their_bounds(d, transposed):
    # Not whole cells, and both stable and unstable walls, real largest poles and pairs.
    alpha, beta = np.linspace(-0.2, 1.5, 150), np.linspace(-0.5, 1.5, 117)
    axes = (alpha[:, None], beta) if transposed else (alpha, beta[:, None])
    found = radius_of(*axes, 0.1, d, method="newton")
    assert found.radius.shape == np.broadcast_shapes(*(axis.shape for axis in axes))
    assert found.certified.mean() > 0.97
    peer = zwidth.spectral_radius(*axes, 0.1, d, method="companion")
    # Near a double pole the companion matrix keeps half of the digits.
    assert (np.abs(found.radius - peer) <= found.error + tol.POLE.float64 * peer)[found.certified].all()
    assert (np.abs(found.radius - peer) <= tol.DOUBLE_POLE.float64 * peer).all()
    for index in np.ndindex(found.radius[::37, ::29].shape):
        place = (37 * index[0], 29 * index[1])
        wall = (float(axis[place]) for axis in np.broadcast_arrays(*axes))
        assert abs(found.radius[place] - exact_radius(*wall, 0.1, d)) <= found.error[place]


def test_several_devices_in_one_call_are_several_maps():
    alpha, beta = np.linspace(0.01, 1.0, 128), np.linspace(0.0, 1.0, 128)[:, None]
    both = radius_of(alpha, beta, np.array([0.1, 0.5])[:, None, None], 0.0, method="newton")
    for delta, radius in zip((0.1, 0.5), both.radius, strict=True):
        np.testing.assert_array_equal(radius, radius_of(alpha, beta, delta, 0.0, method="newton").radius)


def test_mixed_delays_single_points_and_none():
    assert radius_of(0.5, 0.5, 0.1, 1.5, method="newton").radius == pytest.approx(
        float(exact_radius(0.5, 0.5, 0.1, 1.5)), rel=1e-9
    )
    assert radius_of([], 0.5, 0.1, 1.5, method="newton").radius.shape == (0,)
    mixed = radius_of(0.5, 0.5, 0.1, [0.0, 1.5, 4.0], method="bisection")
    expected = [float(exact_radius(0.5, 0.5, 0.1, d)) for d in (0.0, 1.5, 4.0)]
    np.testing.assert_allclose(mixed.radius, expected, rtol=1e-9)


@pytest.mark.parametrize("method, accuracy", METHODS)
def test_bad_points_leave_the_others_alone(method, accuracy):
    alpha = np.array([0.1, np.nan, 0.2, np.inf, 0.3])
    delta = np.array([0.1, 0.1, -1.0, 0.1, 0.1])
    found = radius_of(alpha, 0.3, delta, 1.5, method=method, accuracy=accuracy)
    assert found.status.tolist() == [0, 1, 1, 1, 0]
    assert np.isnan(found.radius).tolist() == [False, True, True, True, False]
    alone = radius_of(alpha[[0, 4]], 0.3, 0.1, 1.5, method=method, accuracy=accuracy)
    np.testing.assert_array_equal(found.radius[[0, 4]], alone.radius)


def test_bisection_takes_the_accuracy_it_is_asked_for():
    exact = float(exact_radius(0.5, 0.5, 0.1, 1.5))
    rough, fine = (radius_of(0.5, 0.5, 0.1, 1.5, method="bisection", accuracy=value) for value in (1e-2, 1e-12))
    assert 1e-9 < abs(rough.radius - exact) <= rough.error < 0.1
    assert abs(fine.radius - exact) <= fine.error < 1e-10


def test_double_poles_are_not_certified():
    # The corner of the undamped loop is not reached at d = 1: take the ridge of a heavily damped device.
    top = zwidth.alpha_max(5.0, 0.0)
    assert top.kind == 1
    found = radius_of(top.alpha, top.beta, 5.0, 0.0, method="newton")
    assert not found.certified
    assert found.radius == pytest.approx(1.0, abs=tol.DOUBLE_POLE.float64)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"method": "guess"}, "method"),
        ({"method": "newton", "accuracy": 1e-12}, "1e-10"),
        ({"method": "bisection", "accuracy": 1e-15}, "1e-14"),
        ({"accuracy": 0.0}, "accuracy"),
        ({"accuracy": float("nan")}, "accuracy"),
        ({"delay": "fractional_power"}, "held"),
    ],
)
def test_what_cannot_be_asked_is_refused(arguments, message):
    with pytest.raises((InputError, ValueError), match=message):
        zwidth.spectral_radius(0.1, 0.1, 0.1, 1, **arguments)


@pytest.mark.parametrize("method", ["companion", "bisection"])
def test_inside_a_transformation(method, x64):
    got = jax.jit(lambda alpha: zwidth.spectral_radius(alpha, 0.5, 0.1, 1.5, method=method))(0.5)
    assert got == pytest.approx(float(exact_radius(0.5, 0.5, 0.1, 1.5)), rel=1e-8)
    with pytest.raises(InputError, match="newton"):
        jax.jit(lambda alpha: zwidth.spectral_radius(alpha, 0.5, 0.1, 1.5, method="newton"))(0.5)


def test_a_wall_without_stiffness_keeps_its_pole_at_one_exactly():
    found = radius_of(0.0, np.linspace(0.0, 0.5, 9), 0.1, 1.5, method="newton")
    assert found.certified.any()
    np.testing.assert_array_equal(found.radius[found.certified], 1.0)
