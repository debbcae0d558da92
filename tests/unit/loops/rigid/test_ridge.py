"""The ridge against 160-digit values, its general solver, an independent implicit derivative and pole counts."""

import json
import warnings
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import tolerances as tol
from compiling import QUICKLY, compile_bends

import zwidth
from zwidth.loops.rigid.poles import radius_by_companion
from zwidth.loops.rigid.ridge import ridge_kernel
from zwidth.words.errors import InputError
from zwidth.words.status import RidgeKind, Status

REFERENCE = Path(__file__).resolve().parents[3] / "reference" / "ridge_extended.json"
# The corner takes over at d = 0: this float64 is the last smooth one, 4e-18 below.
TAKE_OVER = 3.659361627421783507
# One size for all derivatives: one compilation.
SIZE = 320


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
    """Jacobian of (alpha, beta, omega), gradient and Hessian of alpha in (delta, d), at every point."""
    with jax.enable_x64(True):
        points = np.resize(np.stack(np.broadcast_arrays(delta, d), axis=1), (SIZE, 2))
        values, changes = (each[: np.size(delta)] for each in compiled_derivatives()(points))
        return changes[:, 2:], values[:, :2], changes[:, :2]


def excess(got, exact, relative, floor):
    """The largest error, in units of what is allowed."""
    error = np.where(got == exact, 0.0, np.abs(got - exact))
    return np.max(error / (relative * np.abs(exact) + floor))


def test_values_and_kind():
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


def test_derivatives():
    exact = reference()
    jacobian, gradient, hessian = derivatives(exact["delta"], exact["d"])
    delta, alpha, omega = exact["delta"], exact["alpha"], exact["omega"]
    size = alpha + np.abs(exact["beta"])
    with np.errstate(divide="ignore"):
        from_pi = 1 / (np.pi - omega)
    corner = np.isinf(from_pi)
    assert np.all(jacobian[corner, 2] == 0)
    # sin(omega/2) lies near 1 there, and determines (pi - omega)^2, to which the slope is inverse, to its last places:
    # three, since each rounding of one of the curve's coefficients moves it by about one.
    by_omega = tol.RIDGE_SLOPE.float64 + 12 * tol.EPS64 / 2 * from_pi[~corner] ** 2
    # At the last smooth delta that error is as large as (pi - omega)^2 itself.
    assert by_omega[by_omega < 1].size >= by_omega.size - 1
    # What is rounded and subtracted in a derivative: the value over the distance at which it changes.
    per = {"delta": 1 / (1 + delta), "d": np.ones_like(delta)}
    for k, name in enumerate(per):
        floor = tol.RIDGE_SLOPE_FLOOR.float64 * size * per[name]
        for got in (jacobian[:, 0, k], gradient[:, k]):
            assert excess(got, exact[f"alpha_{name}"], tol.RIDGE_SLOPE.float64, floor) <= 1
        # Sixteen times as much: beta moves with omega, too, whose own equation is divided by alpha''.
        assert excess(jacobian[:, 1, k], exact[f"beta_{name}"], tol.RIDGE_SLOPE.float64, 16 * floor) <= 1
        floor = tol.RIDGE_SLOPE_FLOOR.float64 * (1 + from_pi[~corner]) * per[name][~corner]
        assert excess(jacobian[~corner, 2, k], exact[f"omega_{name}"][~corner], by_omega, floor) <= 1
    scales = {"delta_delta": (0, 0, per["delta"] ** 2), "delta_d": (0, 1, per["d"]), "d_d": (1, 1, 1 + delta)}
    for name, (i, j, scale) in scales.items():
        floor = tol.RIDGE_CURVATURE_FLOOR.float64 * size * scale
        for got in (hessian[:, i, j], hessian[:, j, i]):
            assert excess(got, exact[f"alpha_{name}"], tol.RIDGE_CURVATURE.float64, floor) <= 1, name


def test_the_kind_is_right_to_the_last_place_of_delta():
    spacing = np.spacing(TAKE_OVER)
    delta = TAKE_OVER + spacing * np.concatenate(
        [np.arange(-40, 41), 10.0 ** np.arange(2, 9), -(10.0 ** np.arange(2, 9))]
    )
    got = zwidth.alpha_max(delta, 0.0)
    np.testing.assert_array_equal(got.kind == RidgeKind.CORNER, delta > TAKE_OVER)
    np.testing.assert_array_equal(got.omega == np.pi, delta > TAKE_OVER)
    with mp.workdps(60):
        exact = [float(precise_curve(mp.pi - mp.mpf(10) ** -25, mp.mpf(float(x)), mp.mpf(0))[0]) for x in delta]
    # So near the take-over the smooth optimum and the corner differ by less than a rounding error.
    close = np.abs(delta - TAKE_OVER) < 1e-9
    np.testing.assert_allclose(got.alpha[close], np.array(exact)[close], rtol=tol.RIDGE.float64)


def precise_curve(omega, delta, d):
    """(alpha, beta) in mpmath, from the matrices of the held loop: a route of its own."""
    n = mp.floor(d)
    f = d - n
    c = mp.exp(-delta)

    def held_for(t):
        """Position and velocity after a unit force for t."""
        if delta == 0:
            return t * t / 2, t
        return (t - (1 - mp.exp(-delta * t)) / delta) / delta, (1 - mp.exp(-delta * t)) / delta

    whole, late, early = held_for(mp.mpf(1)), held_for(1 - f), held_for(f)
    # Superposition: the older force for the whole period, less what it lacks after f.
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


def test_values_against_60_digits_at_random():
    rng = np.random.default_rng(8)
    delta = np.where(rng.random(60) < 0.1, 0.0, 10 ** rng.uniform(-6, 4, 60))
    d = np.concatenate([rng.uniform(0, 3, 20), 10 ** rng.uniform(-3, np.log10(500), 20), rng.integers(0, 501, 20)])
    got = zwidth.alpha_max(delta, d)
    for i in range(60):
        with mp.workdps(60):
            point = (mp.mpf(float(delta[i])), mp.mpf(float(d[i])))

            def height(omega, point=point):
                return precise_curve(omega, *point)[0]

            near_pi = height(mp.pi - mp.mpf(10) ** -12), height(mp.pi - 2 * mp.mpf(10) ** -12)
            is_corner = near_pi[0] > near_pi[1] and height(mp.pi - mp.mpf(10) ** -3) > 0 and d[i] < 1
            if got.kind[i] == RidgeKind.CORNER:
                assert is_corner
                top = near_pi[0]
            else:
                omega = mp.findroot(lambda w: mp.diff(height, w), mp.mpf(float(got.omega[i])), tol=1e-40)
                assert abs(omega - float(got.omega[i])) < 1e-9
                top = height(omega)
            assert abs(float(got.alpha[i]) / top - 1) <= tol.RIDGE.float64, (delta[i], d[i])


def test_published_values():
    undamped = zwidth.alpha_max(0.0, 0)
    assert undamped.alpha == pytest.approx(12 - 8 * np.sqrt(2), rel=1e-15)
    assert undamped.beta == pytest.approx(2 * np.sqrt(2) - 2, rel=1e-15)
    corner_point = zwidth.alpha_max(4.0, 0)
    assert corner_point.kind == RidgeKind.CORNER
    assert corner_point.omega == np.pi


def test_agrees_with_the_general_solver():
    rng = np.random.default_rng(4)
    delta = np.concatenate([[0.0, 1e-9, 3.6, 3.7, 40.0, 1e4], 10 ** rng.uniform(-3, 3, 58)])
    d = np.concatenate([[0.0, 1.0, 0.0, 0.0, 0.125, 3.0], rng.uniform(0, 6, 58)])
    fast = zwidth.alpha_max(delta, d, method="newton")
    general = zwidth.alpha_max(delta, d, method="kkt")
    np.testing.assert_array_equal(general.status, Status.OK)
    np.testing.assert_array_equal(general.kind, fast.kind)
    np.testing.assert_allclose(general.alpha, fast.alpha, rtol=tol.RIDGE.float64)
    np.testing.assert_allclose(general.omega, fast.omega, rtol=1e-9)


def independent_curve(omega, point):
    """(alpha, beta) straight from the definitions, in complex arithmetic; for delta well above 0."""
    delta, d = point
    c, z = jnp.exp(-delta), jnp.exp(1j * omega)

    def velocity(t):
        return (1 - jnp.exp(-delta * t)) / delta

    def position(t):
        return (t - velocity(t)) / delta

    n = jnp.floor(d)
    f = d - n
    t = 1 - f
    x0, v0 = position(t), velocity(t)
    x1, v1 = position(f) + velocity(f) * velocity(t), velocity(f) * jnp.exp(-delta * t)
    gain = x0 * z + velocity(1.0) * v0 - c * x0 + (x1 * z + velocity(1.0) * v1 - c * x1) / z
    q = -jnp.exp(1j * omega * n) * (z - 1) * (z - c) / gain
    return q.real - jnp.tan(omega / 2) * q.imag, q.imag / jnp.sin(omega)


def independent_ridge():
    """Bisection of the curve's slope in omega; its implicit derivative from jaxopt."""
    with warnings.catch_warnings():
        # jaxopt announces at import that it is no longer maintained.
        warnings.simplefilter("ignore", DeprecationWarning)
        from jaxopt import implicit_diff

    def slope(omega, point):
        return jax.grad(lambda w: independent_curve(w, point)[0])(omega)

    def solve(_, point):
        limit = jnp.minimum(jnp.pi, jnp.pi / (point[1] + 0.5))

        def halve(_, bracket):
            low, high = bracket
            middle = 0.5 * (low + high)
            rising = slope(middle, point) > 0
            return jnp.where(rising, middle, low), jnp.where(rising, high, middle)

        return jax.lax.fori_loop(0, 60, halve, (1e-3 * limit, limit * (1 - 1e-9)))[0]

    def three(point):
        omega = implicit_diff.custom_root(slope)(solve)(None, point)
        return jnp.stack([*independent_curve(omega, point), omega])

    return three


def test_gradient_agrees_with_an_independent_implicit_derivative():
    rng = np.random.default_rng(5)
    delta, d = 10 ** rng.uniform(-0.5, 1, 24), rng.uniform(0.3, 5, 24)
    with jax.enable_x64(True):
        three = jax.vmap(jax.jacrev(independent_ridge()))
        oracle = jax.jit(three, compiler_options=QUICKLY)(np.stack([delta, d], axis=1))
    got = derivatives(delta, d)[0]
    # alpha's slope sees the oracle's omega only to second order.
    np.testing.assert_allclose(got[:, 0], oracle[:, 0], rtol=tol.RIDGE_ORACLE.float64)
    np.testing.assert_allclose(got, oracle, rtol=1e-7, atol=1e-9)


def test_slopes_are_continuous_where_the_corner_takes_over():
    step = 1e-7
    jacobian, gradient, hessian = derivatives(np.array([TAKE_OVER - step, TAKE_OVER + step]), np.zeros(2))
    np.testing.assert_allclose(gradient[1], gradient[0], atol=5e3 * step)
    assert np.isfinite(jacobian).all()
    # Curvatures jump, omega leaves pi with a vertical tangent.
    assert abs(hessian[1, 1, 1] - hessian[0, 1, 1]) > 1e3
    assert jacobian[0, 2, 0] > 1e2
    assert jacobian[1, 2, 0] == 0


def test_slopes_are_continuous_at_whole_delays():
    step = 1e-8
    whole = np.array([1.0, 2.0, 5.0])
    for delta in (0.0, 0.3, 8.0):
        _, right, at = derivatives(np.full(3, delta), whole)
        _, left, before = derivatives(np.full(3, delta), whole - step)
        np.testing.assert_allclose(left, right, rtol=1e-5)
        # The second derivative is the one from the right: it differs from the one from the left.
        assert (np.abs(before[:, 1, 1] / at[:, 1, 1] - 1) > 1e-2).all()


BAD = [(np.nan, 1.0), (-1.0, 1.0), (np.inf, 0.5), (1.0, np.nan), (1.0, -0.5), (0.2, np.inf), (-np.inf, -np.inf)]


def test_bad_points_spoil_nothing():
    rng = np.random.default_rng(6)
    good = np.stack([10 ** rng.uniform(-3, 3, 41), rng.uniform(0, 9, 41)])
    place = np.sort(rng.choice(41, len(BAD)))
    mixed = np.insert(good, place, np.transpose(BAD), axis=1)
    is_bad = np.insert(np.zeros(41, bool), place, True)
    alone = zwidth.alpha_max(*good)
    among = zwidth.alpha_max(*mixed)
    for clean, spoiled in zip(alone, among, strict=True):
        np.testing.assert_array_equal(spoiled[~is_bad], clean)
    np.testing.assert_array_equal(among.status[is_bad], Status.INVALID_INPUT)
    for leaf in among[:3]:
        assert np.isnan(leaf[is_bad]).all()
    for clean, spoiled in zip(derivatives(*good), derivatives(*mixed), strict=True):
        np.testing.assert_array_equal(spoiled[~is_bad], clean)
        assert np.isnan(spoiled[is_bad]).all()


def test_every_device_is_answered():
    """No point of a wide domain fails, and none lies below a plain scan of the curve."""
    rng = np.random.default_rng(7)
    delta = np.where(rng.random(4000) < 0.05, 0.0, 10 ** rng.uniform(-12, 8, 4000))
    d = np.concatenate([rng.uniform(0, 4, 1000), 10 ** rng.uniform(-12, 3, 1000), rng.integers(0, 501, 1000)])
    d = np.concatenate([d, rng.integers(1, 9, 1000) - 10 ** rng.uniform(-15, -2, 1000)])
    got = zwidth.alpha_max(delta, d)
    np.testing.assert_array_equal(got.status, Status.OK)
    limit = np.minimum(np.pi, np.pi / (d + 0.5))
    lobe = np.full(4000, True)
    # Up to the first return to alpha = 0 the scan sees nothing stiffer.
    for fraction in np.linspace(0, 1, 120)[1:-1]:
        scanned = zwidth.boundary(fraction * limit, delta, d).alpha
        lobe &= scanned > 0
        assert (scanned[lobe] <= got.alpha[lobe] * (1 + 1e-13)).all()


# Few whole parts of d: each is another polynomial, hence another compilation.
SAMPLE = [
    (0.0, 0.0),
    (3.0, 0.0),
    (3.67, 0.0),
    (10.0, 0.01),
    (34.0, 0.125),
    (0.5, 0.9),
    (1e3, 0.5),
    (0.1, 2.0),
    (5.0, 2.0),
]


def test_stable_just_inside_and_never_just_outside():
    delta, d = np.transpose(SAMPLE)
    ridge = zwidth.alpha_max(delta, d)
    assert (radius_by_companion(ridge.alpha * (1 - 1e-9), ridge.beta, delta, d) < 1).all()
    spread = np.maximum(np.abs(ridge.beta), ridge.alpha)
    beta = ridge.beta + np.linspace(-0.2, 0.2, 401)[:, None] * spread
    assert (radius_by_companion(1.0005 * ridge.alpha, beta, delta, d) >= 1).all()


def test_shapes_types_and_precision():
    point = zwidth.alpha_max(1, 1)
    assert isinstance(point.alpha, np.float64)
    assert type(point.kind) is np.int32
    grid = zwidth.alpha_max(np.array([[0.1], [2.0]]), [0, 1, 2.5])
    assert grid.alpha.shape == grid.status.shape == (2, 3)
    assert grid.alpha.dtype == np.float64
    assert zwidth.alpha_max([], 1).alpha.shape == (0,)
    assert grid.alpha[1, 1] == pytest.approx(zwidth.alpha_max(2.0, 1).alpha, rel=tol.RIDGE.float64)
    assert isinstance(zwidth.alpha_max(jnp.ones(2), 1).alpha, jax.Array)


def test_ambient_precision_inside_jit():
    exact = reference()
    usual = (exact["delta"] <= 1e4) & (exact["d"] % 1 < 0.99)
    delta, d = np.float32(exact["delta"][usual]), np.float32(exact["d"][usual])
    got = jax.jit(lambda *point: zwidth.alpha_max(*point), compiler_options=QUICKLY)(delta, d)
    assert got.alpha.dtype == jnp.float32
    # float32 inputs are other numbers.
    truth = zwidth.alpha_max(np.float64(delta), np.float64(d))
    np.testing.assert_allclose(got.alpha, truth.alpha, rtol=tol.RIDGE.float32)
    np.testing.assert_array_equal(got.status, Status.OK)


def test_arguments_are_checked():
    with pytest.raises(InputError, match=r"method: got 'newtno', .* did you mean 'newton'"):
        zwidth.alpha_max(1.0, 1, method="newtno")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="delta"):
        zwidth.alpha_max("much", 1)


def test_a_point_without_a_stiffest_wall_has_no_kind():
    found = zwidth.alpha_max([np.nan, 1.0, -1.0, 1e13], 1)
    assert found.kind.tolist() == [RidgeKind.NONE, RidgeKind.SMOOTH, RidgeKind.NONE, RidgeKind.NONE]
    assert "kind=NONE" in repr(zwidth.alpha_max(np.nan, 1))
