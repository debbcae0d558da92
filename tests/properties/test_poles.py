"""Relations between poles and polynomial, and limits of weak damping and of nearly integer delays."""

import numpy as np
import tolerances as tol
from hypothesis import assume, given
from hypothesis import strategies as st

import zwidth
from properties.strategies import alphas, magnitudes, ratios, walls


def size(alpha, beta):
    """Return a bound on the magnitude of the coefficients of P."""
    return 4.0 + abs(alpha) + 3.0 * abs(beta)


@given(walls())
def test_poles_are_real_or_in_conjugate_pairs(wall):
    poles = zwidth.poles(*wall)
    distances = np.abs(poles[:, None] - np.conj(poles)).min(axis=1)
    assert (distances <= tol.POLE.float64 * np.maximum(np.abs(poles), 1.0)).all()


@given(walls())
def test_product_of_poles_is_the_polynomial(wall):
    poles = zwidth.poles(*wall)
    size = np.abs(poles)
    rebuilt, magnitude = np.poly(poles), np.poly(-size)
    # Eigenvalues have errors relative to the largest one: much smaller poles may be returned as 0.
    rounding = np.poly(-(size + 1e-15 * size.max())) - magnitude
    assert (np.abs(rebuilt - zwidth.char_poly(*wall)) <= tol.REBUILT.float64 * magnitude + rounding).all()


@given(walls())
def test_sum_of_poles_is_independent_of_the_wall_from_one_period(wall):
    _, _, delta, d = wall
    assume(d >= 1)
    # The wall contributes to powers of P below the second highest.
    poles = zwidth.poles(*wall)
    assert abs(poles.sum() - (1 + np.exp(-delta))) <= tol.REBUILT.float64 * np.abs(poles).sum()


@given(alphas, ratios, magnitudes(-300, -5), st.sampled_from([0.0, 1.0, 2.0, 0.5, 1.3]))
def test_polynomial_is_continuous_at_zero_damping(alpha, beta, delta, d):
    damped, free = (zwidth.char_poly(alpha, beta, value, d) for value in (delta, 0.0))
    # Every phi-function changes by less than delta/2, and c by less than delta.
    assert (np.abs(damped - free) <= (delta + 1e-15) * size(alpha, beta)).all()


@given(magnitudes(-300, -5), st.floats(0.1, 3.0), st.sampled_from([0.0, 1.0, 2.0, 0.5, 1.3]))
def test_boundary_is_continuous_at_zero_damping(delta, omega, d):
    damped, free = (zwidth.boundary(omega, value, d) for value in (delta, 0.0))
    # The curve starts at beta = -delta. Near pi the numerator of the undamped loop vanishes, which increases the
    # derivative.
    slope = 2.0 + 50.0 / (np.pi - omega) ** 4
    assert abs(damped.alpha - free.alpha) <= slope * (delta + 1e-14)
    assert abs(damped.beta - free.beta) <= slope * (delta + 1e-14)


@given(alphas, ratios, magnitudes(-9, 4), st.sampled_from([0, 1, 3]), magnitudes(-15, -6), st.booleans())
def test_polynomial_is_continuous_at_integer_delays(alpha, beta, delta, integer, fraction, below):
    # From above, P is compared with the P of n = d in powers of z higher by one; from below, with the P of n + 1.
    end, d = (integer + 1, integer + 1 - fraction) if below else (integer, integer + fraction)
    assume(d != end)
    partial, expected = (zwidth.char_poly(alpha, beta, delta, value) for value in (d, end))
    expected = expected if below else np.append(expected, 0.0)
    assert (np.abs(partial - expected) <= (2 * abs(d - end) * (1 + delta) + 1e-15) * size(alpha, beta)).all()
