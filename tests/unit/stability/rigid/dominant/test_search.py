"""Spectral radius by every method: error bounds and certificates against reference labels and roots computed by
mpmath.
"""

import subprocess
import sys
from pathlib import Path

import jax
import mpmath as mp
import numpy as np
import pytest
import tolerances as tol
from bounds import bound_radius
from compiling import QUICKLY
from waiting import LONGEST

import oracles
import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.stability.rigid.dominant.arrays import compute_dominant_poles
from zwidth.stability.rigid.dominant.search import quick_kernel

LABELS = Path(__file__).resolve().parents[4] / "reference" / "labels.npz"
ACCURACIES = [1e-9, 1e-12]


@pytest.fixture(scope="module")
def labels():
    with np.load(LABELS) as file:
        return {name: file[name] for name in file.files}


@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_scattered_points_satisfy_their_error_bounds(labels, accuracy):
    result = bound_radius(*(labels[name] for name in ("alpha", "beta", "delta", "d")), accuracy=accuracy)
    if accuracy == 1e-12:
        labels = {name: values[labels["d"] <= 4] for name, values in labels.items()}
        result = bound_radius(*(labels[name] for name in ("alpha", "beta", "delta", "d")), accuracy=accuracy)
    ok = result.status == Status.OK
    # At 1e-12, rounding errors prevent certification of some nearly multiple poles.
    assert ok.all() if accuracy != 1e-12 else ok.mean() > 0.97
    error = np.abs(result.radius - labels["rho"])
    assert (error <= result.error).all()
    np.testing.assert_array_equal(result.certified, ok)
    assert (result.error <= 1.1 * accuracy * labels["rho"])[ok].all()


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("d", [0.0, 1.5])
def test_grids_satisfy_their_error_bounds(d, transposed):
    # The size is no multiple of the cell size; walls are stable and unstable, with real and complex dominant poles.
    alpha, beta = np.linspace(-0.2, 1.5, 150), np.linspace(-0.5, 1.5, 117)
    axes = (alpha[:, None], beta) if transposed else (alpha, beta[:, None])
    result = bound_radius(*axes, 0.1, d)
    assert result.radius.shape == np.broadcast_shapes(*(axis.shape for axis in axes))
    assert result.certified.mean() > 0.999
    peer = zwidth.spectral_radius(*axes, 0.1, d, method="companion")
    # Near a double pole the companion matrix yields half of the digits.
    assert (np.abs(result.radius - peer) <= result.error + tol.POLE.float64 * peer)[result.certified].all()
    assert (np.abs(result.radius - peer) <= tol.DOUBLE_POLE.float64 * peer).all()
    for index in np.ndindex(result.radius[::37, ::29].shape):
        point = (37 * index[0], 29 * index[1])
        alpha, beta = (float(axis[point]) for axis in np.broadcast_arrays(*axes))
        assert abs(result.radius[point] - oracles.exact_radius(alpha, beta, 0.1, d)) <= result.error[point]


def test_mixed_delays_single_points_and_empty_input():
    exact = float(oracles.exact_radius(0.5, 0.5, 0.1, 1.5))
    assert bound_radius(0.5, 0.5, 0.1, 1.5).radius == pytest.approx(exact, rel=1e-9)
    assert bound_radius([], 0.5, 0.1, 1.5).radius.shape == (0,)
    mixed = bound_radius(0.5, 0.5, 0.1, [0.0, 1.5, 4.0])
    expected = [float(oracles.exact_radius(0.5, 0.5, 0.1, d)) for d in (0.0, 1.5, 4.0)]
    np.testing.assert_allclose(mixed.radius, expected, rtol=1e-9)


def test_double_poles_are_not_certified():
    # The undamped loop reaches no corner at d = 1, so use the ridge of a heavily damped device.
    top = zwidth.alpha_max(5.0, 0.0)
    assert top.kind == 1
    result = bound_radius(top.alpha, top.beta, 5.0, 0.0)
    assert not result.certified
    assert result.status == Status.NOT_CONVERGED
    assert 1e-9 < result.error < 1e-3
    assert abs(result.radius - oracles.exact_radius(float(top.alpha), float(top.beta), 5.0, 0.0)) <= result.error


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"method": "guess"}, "method"),
        ({"accuracy": 1e-13}, "1e-12"),
        ({"method": "bisection"}, "method"),
        ({"accuracy": "x"}, "accuracy"),
        ({"accuracy": 0.0}, "accuracy"),
        ({"accuracy": float("nan")}, "accuracy"),
    ],
)
def test_invalid_method_or_accuracy_raises(arguments, message):
    with pytest.raises((InputError, ValueError), match=message):
        zwidth.spectral_radius(0.1, 0.1, 0.1, 1, **arguments)


def test_companion_method_works_inside_jit(x64):
    companion = jax.jit(
        lambda alpha: zwidth.spectral_radius(alpha, 0.5, 0.1, 1.5, method="companion"), compiler_options=QUICKLY
    )
    assert companion(0.5) == pytest.approx(float(oracles.exact_radius(0.5, 0.5, 0.1, 1.5)), rel=1e-8)


def test_long_delays_need_neither_jax_nor_a_matrix():
    # A companion matrix of the longest delay would exceed the memory and take hours.
    code = (
        "import sys, zwidth\n"
        "for d in (62, 63, 64, 501, 1e4, 1e5, 1.5): zwidth.spectral_radius(.01, .01, .5, d)\n"
        "assert 'jax' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=LONGEST)


def test_triple_poles_satisfy_their_error_bounds():
    # P = (z - r)^3 at d = 0, delta = 0: the coefficients of z (z - 1)^2 + (z + 1)((alpha + beta) z - beta)/2 yield
    # (alpha + beta)/2 - 2 = -3 r, 1 + alpha/2 = 3 r^2 and -beta/2 = -r^3.
    with mp.workdps(60):
        r = mp.findroot(lambda r: 2 * (3 * r**2 - 1) + 2 * r**3 - 4 + 6 * r, mp.mpf("0.6"))
        alpha, beta = float(2 * (3 * r**2 - 1)), float(2 * r**3)
    rng = np.random.default_rng(5)
    alpha = alpha * (1 + np.concatenate([[0.0], 10.0 ** rng.uniform(-16, -3, 60) * rng.choice([-1, 1], 60)]))
    result = bound_radius(alpha, beta, 0.0, 0.0)
    assert result.error[0] > 1e-7 * result.radius[0]
    for k in range(61):
        assert abs(result.radius[k] - oracles.exact_radius(alpha[k], beta, 0.0, 0.0)) <= result.error[k]


def test_radii_of_adversarial_walls_satisfy_their_error_bounds():
    with np.load(LABELS.parent / "adversarial.npz") as file:
        walls = [file[name] for name in ("alpha", "beta", "delta", "d")]
        exact = 1.0 + file["margin"]
    result = bound_radius(*walls)
    compared = np.isfinite(result.error) & np.isfinite(exact)
    assert compared.mean() > 0.85
    # The reference 1 + margin is rounded itself.
    assert (np.abs(result.radius - exact) <= result.error + 2e-16 * exact)[compared].all()


def test_zero_stiffness_has_radius_exactly_one():
    result = bound_radius(0.0, np.linspace(0.0, 0.5, 9), 0.1, 1.5)
    assert result.certified.any()
    np.testing.assert_array_equal(result.radius[result.certified], 1.0)


def test_many_walls_inside_jit_agree_with_direct_calls(labels):
    # Walls are processed in blocks of 512 with a shorter last one; more remain open than one search processes at once.
    walls = [np.tile(labels[name], 3) for name in ("alpha", "beta", "delta", "d")]
    with np.errstate(all="ignore"):
        alpha, beta, delta, d = walls
        result = quick_kernel(alpha, beta, delta, d, np.full(alpha.size, 3e-10), fractional=True)
    open_walls = np.flatnonzero(~result.certified)
    # Walls with a pair near 1 and two real poles near -1, which blur the pole count just outside of them.
    blurred = np.array(
        [
            (1.8183874317401205e-06, -7.052473545074463, 7.05266809463501, 1.6817187070846558),
            (7.981878297869116e-06, -34.8948974609375, 34.89617919921875, 1.0),
            (9.925483936967794e-07, -6.349642753601074, 6.355916976928711, 0.0),
            (1110.008154243134, -260.7505798339844, 292.2397155761719, 0.0),
            (18.894075255914455, -0.7544297575950623, 4.545729160308838, 0.02368774265050888),
        ]
    ).T
    walls = [np.concatenate([column[:1300], np.resize(column[open_walls], 695)]) for column in walls]
    walls[0][::97], walls[3][1::97] = np.nan, -1.0
    walls = [np.concatenate(columns) for columns in zip(walls, blurred, strict=True)]
    direct = zwidth.spectral_radius(*walls)
    with jax.enable_x64(True):
        inside = np.asarray(jax.jit(zwidth.spectral_radius, compiler_options=QUICKLY)(*walls))
    assert open_walls.size > 3
    assert np.isnan(inside[np.isnan(direct)]).all()
    # A traced program returns NaN at multiple poles, because it must be differentiable.
    finite = np.isfinite(inside)
    assert 0.95 < finite.mean() < 0.99
    assert finite[-5:].all()
    np.testing.assert_allclose(inside[finite], direct[finite], rtol=2e-9)


def test_numpy_and_jax_routes_give_equal_poles(labels):
    columns = [labels[name][::7] for name in ("alpha", "beta", "delta", "d")]
    few, many = (compute_dominant_poles(columns, 1e-9, route) for route in ("numpy", "jax"))
    assert few.certified.sum() > 100
    np.testing.assert_array_equal(many.certified, few.certified)
    np.testing.assert_allclose(many.re[few.certified], few.re[few.certified], rtol=0, atol=2e-9)
