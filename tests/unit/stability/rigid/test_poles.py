"""Poles and spectral radius against labels in 60 digits, roots in mpmath, and constructed double poles."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import tolerances as tol
from mpmath.libmp import NoConvergence

import oracles
import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.stability.rigid.broadcasting import map_by_degree
from zwidth.stability.rigid.poles import _eigenvalues, aberth_kernel, radius_by_companion

LABELS = Path(__file__).resolve().parents[3] / "reference" / "labels.npz"


@pytest.fixture(scope="module")
def labels():
    with np.load(LABELS) as file:
        return {name: file[name] for name in file.files}


@pytest.fixture(scope="module")
def radius(labels):
    return radius_by_companion(*(labels[name] for name in ("alpha", "beta", "delta", "d")))


def test_labels_outside_the_error_band_are_right(labels, radius):
    clear = np.abs(labels["margin"]) > tol.LABEL_BAND.float64
    assert clear.mean() > 0.9
    np.testing.assert_array_equal((radius < 1)[clear], labels["stable"][clear])


def test_radius_is_accurate_to_rounding(labels, radius):
    # Applies to every point of this set: no dominant poles are so close that the radius would lose digits.
    np.testing.assert_allclose(radius, labels["rho"], rtol=tol.POLE.float64)


def match_poles(got, exact):
    """Yield the relative distance of each exact pole to its computed one, relative to at least 1e-12."""
    remaining = list(np.asarray(got))
    for pole in sorted(exact, key=abs, reverse=True):
        nearest = min(range(len(remaining)), key=lambda k: abs(remaining[k] - complex(pole)))
        yield abs(remaining.pop(nearest) - complex(pole)) / max(abs(complex(pole)), 1e-12)


WALLS = [
    (0.108, 0.425, 0.0, 1.0),
    (0.5, 0.5, 1e-12, 0.0),
    (3.0, -0.2, 2.0, 0.125),
    (40.0, -3.0, 30.0, 0.9),
    (0.05, 0.2, 0.1, 4.0),
    (0.02, 0.1, 0.5, 8.5),
    (-0.1, 0.2, 0.3, 2.0),
    (5e3, 700.0, 1e4, 1.3),
]


@pytest.mark.parametrize("wall", WALLS)
def test_poles_are_roots_of_the_exact_polynomial(wall):
    with mp.workdps(oracles.DIGITS):
        exact = oracles.roots(oracles.polynomial(*wall))
    assert max(match_poles(zwidth.poles(*wall), exact)) <= tol.POLE.float64


def test_poles_of_a_delay_of_500_periods():
    wall = (1e-6, 1e-3, 0.01, 500)
    got = zwidth.poles(*wall)
    assert got.shape == (503,)
    np.testing.assert_allclose(np.sum(got), -zwidth.char_poly(*wall)[1], rtol=0, atol=503 * tol.POLE.float64)
    with mp.workdps(oracles.DIGITS):
        coefficients = oracles.polynomial(*wall)
        derivative = [(503 - k) * coefficient for k, coefficient in enumerate(coefficients[:-1])]
        for pole in got[::25]:
            # The distance to the nearest root is about |P/P'|.
            step = oracles.evaluate(coefficients, complex(pole)) / oracles.evaluate(derivative, complex(pole))
            assert abs(step) <= tol.POLE.float64


def find_corner(delta):
    """Return the wall at d = 0 with P(-1) = P'(-1) = 0, from the model formulas in mpmath."""
    value = oracles.phi(delta)
    gap, s = value.phi2 - value.psi, value.psi / value.phi2
    alpha = 4 * (1 + value.c) * (1 + 1 / (1 + value.c) - 1 / (1 - s)) / gap
    return alpha, (1 + value.c) / gap - alpha / 2


@pytest.mark.parametrize("delta", [4.0, 10.0, 300.0])
def test_double_pole_has_half_of_the_digits(delta):
    with mp.workdps(oracles.DIGITS):
        alpha, beta = (float(value) for value in find_corner(delta))
    got = zwidth.poles(alpha, beta, delta, 0)
    nearest = np.sort(np.abs(got + 1))[:2]
    assert (nearest <= tol.DOUBLE_POLE.float64).all()
    assert radius_by_companion(alpha, beta, delta, 0) == pytest.approx(1.0, rel=tol.DOUBLE_POLE.float64)


def test_zero_stiffness_has_a_pole_at_one():
    got = zwidth.poles(0.0, 0.4, np.array([0.0, 0.3, 2.0]), 1)
    assert np.abs(got - 1).min(axis=-1).max() <= 2 * np.finfo(float).eps


def test_zero_virtual_damping_has_a_pole_at_zero():
    got = zwidth.poles(0.1, 0.0, 0.3, np.array([0, 1, 2.5]))
    np.testing.assert_array_equal(np.nanmin(np.abs(got), axis=-1), [0, 0, 0])


@pytest.mark.parametrize("d", [0.0, 2.0, 2.5, 20.0])
def test_zero_virtual_damping_is_certified_in_a_mixed_batch(d):
    rng = np.random.default_rng(6)
    beta = np.where(np.arange(300) % 2, 0.0, rng.uniform(-0.1, 1.2, 300))
    z, within, certified = run_aberth(rng.uniform(1e-3, 0.6, 300), beta, rng.uniform(0.0, 0.5, 300), d)
    assert certified[beta == 0].all()
    nearest = np.abs(z).argmin(-1)[:, None]
    for values in (np.abs(z), within):
        assert (np.take_along_axis(values, nearest, -1)[beta == 0] == 0).all()


def test_mixed_degrees_are_padded_with_nan():
    got = zwidth.poles(0.1, 0.2, 0.3, np.array([0, 4.5, 2]))
    np.testing.assert_array_equal(np.isfinite(got).sum(-1), [3, 8, 5])
    assert np.isnan(got[0, 3:]).all()


def test_nearly_integer_delay_adds_a_pole_at_zero():
    for d, near in ((np.nextafter(2.0, 3.0), 2), (5e-324, 0), (np.nextafter(1.0, 0.0), 1)):
        got, integer = zwidth.poles(0.2, 0.3, 0.4, d), zwidth.poles(0.2, 0.3, 0.4, near)
        reference = [*integer, 0.0] if d != np.nextafter(1.0, 0.0) else integer
        for pole in reference:
            assert np.abs(got - pole).min() <= 1e-7


@pytest.mark.parametrize("d", [2046, 10_000, 1e5])
def test_too_many_poles_raise_with_the_estimated_cost(d):
    if d == 2046:
        from zwidth.stability.rigid.poles import check_degree

        check_degree(d)
        return
    with pytest.raises(InputError, match=r"poles need about .* MB and .* s per point"):
        zwidth.poles(0.1, 0.1, 0.1, d)


def test_zero_stiffness_has_radius_of_at_least_one():
    rng = np.random.default_rng(3)
    beta, delta, d = rng.uniform(-1, 1, 3000), 10.0 ** rng.uniform(-3, 2, 3000), rng.choice([0.0, 1.0, 2.0, 0.5], 3000)
    assert (np.asarray(radius_by_companion(0.0, beta, delta, d)) >= 1.0).all()


def test_derivative_of_the_dominant_pole(x64):
    def dominant_modulus(alpha):
        return jnp.max(jnp.abs(zwidth.poles(alpha, 0.4, 0.3, 1)))

    h = 1e-5
    difference = (radius_by_companion(0.2 + h, 0.4, 0.3, 1) - radius_by_companion(0.2 - h, 0.4, 0.3, 1)) / (2 * h)
    assert float(jax.grad(dominant_modulus)(0.2)) == pytest.approx(difference, rel=1e-8)
    assert np.isnan(jax.grad(dominant_modulus)(np.nan))


def many_walls(count=600):
    """Return random walls including corner cases: delta 0 and 1e6, beta near -delta, alpha near 1e-12."""
    rng = np.random.default_rng(9)
    d = rng.choice([0.0, 1.0, 2.0, 4.0, 8.0, 0.125, 2.5, 5.3], count)
    delta = rng.choice([0.0, 1e-12, 1e-8, 0.1, 1.0, 4.0, 50.0, 1e4, 1e6], count)
    size = np.maximum(1.0, np.where(rng.random(count) < 0.4, delta, 1.0))
    beta = rng.uniform(-0.5, 1.5, count) * size
    near = -delta * (1.0 + 10.0 ** rng.uniform(-14, -1, count) * rng.choice([-1.0, 1.0], count))
    return 10.0 ** rng.uniform(-13, 1, count) * size, np.where(rng.random(count) < 0.25, near, beta), delta, d


def run_aberth(*walls):
    """Return poles, the radii of their inclusion discs, and whether these are certified."""
    z, within = (map_by_degree(lambda *args, k=k: aberth_kernel(*args)[k], walls, route="numpy") for k in (0, 1))
    return z, within, map_by_degree(lambda *args: aberth_kernel(*args)[2][:, None], walls, route="numpy")[..., 0]


def test_aberth_is_at_least_as_accurate_as_eigenvalues():
    walls = many_walls()
    _, within, certified = run_aberth(*walls)
    aberth, companion = (zwidth.poles(*walls, method=method) for method in ("aberth", "companion"))
    assert certified.mean() > 0.8
    wrong, checked = [], 0
    for k in range(0, 600, 6):
        with mp.workdps(oracles.DIGITS):
            polynomial = oracles.polynomial(*(column[k] for column in walls))
            try:
                exact = mp.polyroots(polynomial[::-1], maxsteps=200, extraprec=400, asc=True)
            except NoConvergence:
                continue
            checked += 1
            errors = [max(match_poles(z[k][np.isfinite(z[k])], exact)) for z in (aberth, companion)]
            wrong += [k] if errors[0] > 10 * errors[1] + 100 * np.finfo(float).eps else []
            if certified[k]:
                inside = [
                    sum(
                        abs(root - mp.mpc(z)) <= r + mp.mpf(10) ** -50
                        for z, r in zip(aberth[k], within[k], strict=True)
                    )
                    for root in exact
                ]
                assert inside == [1] * len(exact)
    assert checked > 85
    assert wrong == []


@pytest.mark.usefixtures("early_compiler")
@pytest.mark.parametrize(("d", "beta"), [(0.0, None), (2.5, None), (2.0, 0.0), (2.5, 0.0)])
def test_compiled_and_numpy_kernels_give_equal_poles(d, beta):
    rng = np.random.default_rng(4)
    count = 5000
    walls = (rng.uniform(0, 0.5, count), rng.uniform(0, 0.6, count) if beta is None else beta, 0.3, d)
    computed, peer = zwidth.poles(*walls), zwidth.poles(*walls, method="companion")
    z, within, certified = run_aberth(*walls)
    assert certified.mean() > 0.99
    for k in (0, 7, 4999):
        few = zwidth.poles(walls[0][k], walls[1] if beta is not None else walls[1][k], 0.3, d, method="aberth")
        for other in (peer[k], few):
            np.testing.assert_allclose(
                np.sort_complex(computed[k].round(9)), np.sort_complex(other.round(9)), atol=1e-8
            )
    # Each disc contains exactly one pole of the companion matrix: equal poles in any order.
    distance = np.abs(z[certified][:, :, None] - peer[certified][:, None, :])
    overlaps = distance <= within[certified][:, :, None] + 1e-9
    assert (overlaps.sum(-1) == 1).all()
    assert (overlaps.sum(-2) == 1).all()


@pytest.mark.parametrize("method", ["aberth", "companion"])
def test_discs_of_a_double_pole_are_not_certified(method):
    # At beta = 0, delta = 0, d = 0 two poles are roots of z^2 - (2 - alpha/2) z + 1 + alpha/2, double at alpha = 16.
    np.testing.assert_array_equal(run_aberth([16.0, 15.0], 0.0, 0.0, 0.0)[2], [False, True])
    computed = zwidth.poles([16.0, 15.0], 0.0, 0.0, 0.0, method=method)
    np.testing.assert_allclose(np.sort(computed[0].real), [-3, -3, 0], rtol=tol.DOUBLE_POLE.float64)


def test_invalid_walls_do_not_affect_valid_ones():
    for method in ("aberth", "companion"):
        computed = zwidth.poles([0.1, np.nan, 0.1, 1e300], 0.2, [0.3, 0.3, -1.0, 0.3], 1, method=method)
        assert np.isnan(computed[1:]).all()
        assert np.isfinite(computed[0]).all()


def test_nan_matrix_does_not_affect_other_matrices():
    matrices = np.stack([np.eye(3), np.full((3, 3), np.nan), 2 * np.eye(3)])
    got = _eigenvalues(matrices)
    np.testing.assert_array_equal(np.real(got[[0, 2]]), [[1, 1, 1], [2, 2, 2]])
    assert np.isnan(got[1]).all()


def test_invalid_method_raises():
    with pytest.raises(InputError, match="method: got 'eig'"):
        zwidth.poles(0.1, 0.1, 0.1, 1, method="eig")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="aberth"):
        jax.jit(lambda alpha: zwidth.poles(alpha, 0.1, 0.1, 1, method="aberth"))(0.1)


def test_eigenvalues_near_the_unit_circle_are_undecided():
    """Two poles are 5e-6 apart, the outer one 1.3e-13 inside the unit circle: eigenvalues have errors of about
    1e-10.
    """
    wall = (1.2216906670092685e-18, 0.0, 2.600792744791581e-13, 0.3)
    assert zwidth.is_stable(*wall)
    assert zwidth.decide_stability(*wall, method="companion").status == Status.UNDECIDED
    # Without stiffness the pole at 1 is exact.
    assert zwidth.decide_stability(0.0, *wall[1:], method="companion").status == Status.OK
    decision = zwidth.decide_stability([0.1, 0.6, 5.0], 0.4, 0.1, 0, method="companion")
    assert decision.stable.tolist() == [True, True, False]
    assert decision.status.tolist() == [Status.OK] * 3
