"""The ridge (alpha_max) against values of 160 digits, the general KKT solver and a scan of the boundary curve."""

import json
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import tolerances as tol
from compiling import compile_bends

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import RidgeKind, Status
from zwidth.stability.rigid.ridge import ridge_kernel

REFERENCE = Path(__file__).resolve().parents[3] / "reference" / "ridge_extended.json"
# delta above which the ridge of d = 0 is a corner; the last smooth float64 is 4e-18 below.
TAKE_OVER = 3.659361627421783507
SIZE = 320  # points per batch of derivatives: equal for all tests, so that they share one compilation


@cache
def reference():
    rows = [row for row in json.loads(REFERENCE.read_text()) if row["model"] == "held"]
    columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name not in ("model", "kind")}
    columns["corner"] = np.array([row["kind"] == "corner" for row in rows])
    assert len(rows) > 70
    return columns


@cache
def compiled_derivatives():
    def slopes(point):
        def three(point):
            values = jnp.stack(ridge_kernel(point[0], point[1])[:3])
            return values[0], values

        gradient, values = jax.grad(three, has_aux=True)(point)
        return jnp.concatenate([gradient, values])

    return compile_bends(slopes)


def derivatives(delta, d):
    """Return the Jacobian of (alpha, beta, omega), and gradient and Hessian of alpha in (delta, d), at every point."""
    with jax.enable_x64(True):
        points = np.resize(np.stack(np.broadcast_arrays(delta, d), axis=1), (SIZE, 2))
        values, changes = (column[: np.size(delta)] for column in compiled_derivatives()(points))
        return changes[:, 2:], values[:, :2], changes[:, :2]


def excess(got, exact, relative, floor):
    """Return the largest error in units of the allowed error."""
    error = np.where(got == exact, 0.0, np.abs(got - exact))
    return np.max(error / (relative * np.abs(exact) + floor))


def test_values_and_kind_agree_with_160_digits():
    exact = reference()
    got = zwidth.alpha_max(exact["delta"], exact["d"])
    size = exact["alpha"] + np.abs(exact["beta"])
    assert excess(got.alpha, exact["alpha"], tol.RIDGE.float64, 0) <= 1
    assert excess(got.beta, exact["beta"], 0, tol.RIDGE_BETA.float64 * size) <= 1
    with np.errstate(divide="ignore"):
        condition = 1 + 1 / np.abs(np.pi - exact["omega"])
    assert excess(got.omega, exact["omega"], 0, tol.RIDGE_OMEGA.float64 * condition) <= 1
    np.testing.assert_array_equal(got.kind == RidgeKind.CORNER, exact["corner"])
    assert (got.status == Status.OK).all()


def test_derivatives_agree_with_160_digits():
    exact = reference()
    jacobian, gradient, hessian = derivatives(exact["delta"], exact["d"])
    delta, alpha, omega = exact["delta"], exact["alpha"], exact["omega"]
    size = alpha + np.abs(exact["beta"])
    with np.errstate(divide="ignore"):
        from_pi = 1 / (np.pi - omega)
    corner = np.isinf(from_pi)
    assert np.all(jacobian[corner, 2] == 0)
    # Near pi, sin(omega/2) is close to 1 and determines (pi - omega)^2, to which the derivative is inversely
    # proportional, up to three last places, because each rounded coefficient of the curve contributes about one.
    by_omega = tol.RIDGE_SLOPE.float64 + 12 * tol.EPS64 / 2 * from_pi[~corner] ** 2
    # At the last smooth delta that error is as large as (pi - omega)^2 itself.
    assert by_omega[by_omega < 1].size >= by_omega.size - 1
    # Scale of cancellation in a derivative: the value divided by the distance over which it changes.
    per = {"delta": 1 / (1 + delta), "d": np.ones_like(delta)}
    for k, name in enumerate(per):
        floor = tol.RIDGE_SLOPE_FLOOR.float64 * size * per[name]
        for got in (jacobian[:, 0, k], gradient[:, k]):
            assert excess(got, exact[f"alpha_{name}"], tol.RIDGE_SLOPE.float64, floor) <= 1
        # Sixteen times as much: beta also depends on omega, whose own equation is divided by alpha''.
        assert excess(jacobian[:, 1, k], exact[f"beta_{name}"], tol.RIDGE_SLOPE.float64, 16 * floor) <= 1
        floor = tol.RIDGE_SLOPE_FLOOR.float64 * (1 + from_pi[~corner]) * per[name][~corner]
        assert excess(jacobian[~corner, 2, k], exact[f"omega_{name}"][~corner], by_omega, floor) <= 1
    scales = {"delta_delta": (0, 0, per["delta"] ** 2), "delta_d": (0, 1, per["d"]), "d_d": (1, 1, 1 + delta)}
    for name, (i, j, scale) in scales.items():
        floor = tol.RIDGE_CURVATURE_FLOOR.float64 * size * scale
        for got in (hessian[:, i, j], hessian[:, j, i]):
            assert excess(got, exact[f"alpha_{name}"], tol.RIDGE_CURVATURE.float64, floor) <= 1, name


def test_kind_changes_at_the_exact_delta():
    spacing = np.spacing(TAKE_OVER)
    delta = TAKE_OVER + spacing * np.concatenate(
        [np.arange(-40, 41), 10.0 ** np.arange(2, 9), -(10.0 ** np.arange(2, 9))]
    )
    got = zwidth.alpha_max(delta, 0.0)
    np.testing.assert_array_equal(got.kind == RidgeKind.CORNER, delta > TAKE_OVER)
    np.testing.assert_array_equal(got.omega == np.pi, delta > TAKE_OVER)
    with mp.workdps(60):
        exact = [float(boundary_in_mpmath(mp.pi - mp.mpf(10) ** -25, mp.mpf(float(x)), mp.mpf(0))[0]) for x in delta]
    # This close to TAKE_OVER, smooth optimum and corner differ by less than a rounding error.
    close = np.abs(delta - TAKE_OVER) < 1e-9
    np.testing.assert_allclose(got.alpha[close], np.array(exact)[close], rtol=tol.RIDGE.float64)


def boundary_in_mpmath(omega, delta, d):
    """Return (alpha, beta) in mpmath, independently, from the superposed responses of the zero-order-hold loop."""
    n = mp.floor(d)
    f = d - n
    c = mp.exp(-delta)

    def respond_to_pulse(t):
        """Return position and velocity after a unit force of duration t."""
        if delta == 0:
            return t * t / 2, t
        return (t - (1 - mp.exp(-delta * t)) / delta) / delta, (1 - mp.exp(-delta * t)) / delta

    whole, late, early = respond_to_pulse(mp.mpf(1)), respond_to_pulse(1 - f), respond_to_pulse(f)
    # Superposition: the previous force acts during the whole period, minus its missing part after f.
    older = (whole[0] - late[0], whole[1] - late[1])
    assert mp.almosteq(older[1], early[1] * mp.exp(-delta * (1 - f)), 1e-40)
    z = mp.expj(omega)
    drift = whole[1]
    gain = sum(((x * (z - c) + drift * v) * u for (x, v), u in ((late, 1), (older, 1 / z))), mp.mpc(0))
    # x = gain F/((z - 1)(z - c)) with F = -z^-(n+1) (alpha z + beta (z - 1)) x
    wall = -(z - 1) * (z - c) * mp.expj(omega * (n + 1)) / gain
    # wall = alpha z + beta (z - 1), a real 2 x 2 system
    beta = (mp.re(wall) * mp.im(z) - mp.im(wall) * mp.re(z)) / (-mp.im(z))
    return (mp.im(wall) - beta * mp.im(z)) / mp.im(z), beta


def test_newton_agrees_with_the_general_solver():
    rng = np.random.default_rng(4)
    delta = np.concatenate([[0.0, 1e-9, 3.6, 3.7, 40.0, 1e4], 10 ** rng.uniform(-3, 3, 58)])
    d = np.concatenate([[0.0, 1.0, 0.0, 0.0, 0.125, 3.0], rng.uniform(0, 6, 58)])
    fast = zwidth.alpha_max(delta, d, method="newton")
    general = zwidth.alpha_max(delta, d, method="kkt")
    np.testing.assert_array_equal(general.status, Status.OK)
    np.testing.assert_array_equal(general.kind, fast.kind)
    np.testing.assert_allclose(general.alpha, fast.alpha, rtol=tol.RIDGE.float64)
    np.testing.assert_allclose(general.omega, fast.omega, rtol=1e-9)


def test_first_derivatives_are_continuous_at_the_corner_transition():
    step = 1e-7
    jacobian, gradient, hessian = derivatives(np.array([TAKE_OVER - step, TAKE_OVER + step]), np.zeros(2))
    np.testing.assert_allclose(gradient[1], gradient[0], atol=5e3 * step)
    assert np.isfinite(jacobian).all()
    # Second derivatives jump, and omega leaves pi with a vertical tangent.
    assert abs(hessian[1, 1, 1] - hessian[0, 1, 1]) > 1e3
    assert jacobian[0, 2, 0] > 1e2
    assert jacobian[1, 2, 0] == 0


def test_first_derivatives_are_continuous_at_integer_delays():
    step = 1e-8
    integers = np.array([1.0, 2.0, 5.0])
    for delta in (0.0, 0.3, 8.0):
        _, right, at_integers = derivatives(np.full(3, delta), integers)
        _, left, before = derivatives(np.full(3, delta), integers - step)
        np.testing.assert_allclose(left, right, rtol=1e-5)
        # The second derivative is that from the right; it differs from that from the left.
        assert (np.abs(before[:, 1, 1] / at_integers[:, 1, 1] - 1) > 1e-2).all()


def test_every_device_has_a_ridge_above_the_scanned_curve():
    """The solver converges everywhere in a wide domain, and no scanned point of the lobe has a larger alpha."""
    rng = np.random.default_rng(7)
    delta = np.where(rng.random(4000) < 0.05, 0.0, 10 ** rng.uniform(-12, 8, 4000))
    d = np.concatenate([rng.uniform(0, 4, 1000), 10 ** rng.uniform(-12, 3, 1000), rng.integers(0, 501, 1000)])
    d = np.concatenate([d, rng.integers(1, 9, 1000) - 10 ** rng.uniform(-15, -2, 1000)])
    got = zwidth.alpha_max(delta, d)
    np.testing.assert_array_equal(got.status, Status.OK)
    limit = np.minimum(np.pi, np.pi / (d + 0.5))
    lobe = np.full(4000, True)
    # The scan stops at the first return to alpha = 0.
    for fraction in np.linspace(0, 1, 120)[1:-1]:
        scanned = zwidth.boundary(fraction * limit, delta, d).alpha
        lobe &= scanned > 0
        assert (scanned[lobe] <= got.alpha[lobe] * (1 + 1e-13)).all()


def test_invalid_arguments_raise():
    with pytest.raises(InputError, match=r"method: got 'newtno', .* did you mean 'newton'"):
        zwidth.alpha_max(1.0, 1, method="newtno")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="delta"):
        zwidth.alpha_max("much", 1)


def test_invalid_points_have_kind_none():
    ridge = zwidth.alpha_max([np.nan, 1.0, -1.0, 1e13], 1)
    assert ridge.kind.tolist() == [RidgeKind.NONE, RidgeKind.SMOOTH, RidgeKind.NONE, RidgeKind.NONE]
    assert "kind=NONE" in repr(zwidth.alpha_max(np.nan, 1))
