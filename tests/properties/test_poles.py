"""What poles and polynomial owe each other, and how they depend on damping and delay."""

import numpy as np
import tolerances as tol
from hypothesis import assume, given
from hypothesis import strategies as st

import zwidth
from properties.strategies import alphas, magnitudes, shares, walls


def size(alpha, beta):
    """What the coefficients of P are made of."""
    return 4.0 + abs(alpha) + 3.0 * abs(beta)


@given(walls())
def test_poles_are_real_or_come_in_pairs(wall):
    poles = zwidth.poles(*wall)
    distances = np.abs(poles[:, None] - np.conj(poles)).min(axis=1)
    assert (distances <= tol.POLE.float64 * np.maximum(np.abs(poles), 1.0)).all()


@given(walls())
def test_poles_rebuild_the_polynomial(wall):
    poles = zwidth.poles(*wall)
    size = np.abs(poles)
    rebuilt, magnitude = np.poly(poles), np.poly(-size)
    # Eigenvalues are right to rounding of the largest one: poles far smaller may come out as 0.
    rounding = np.poly(-(size + 1e-15 * size.max())) - magnitude
    assert (np.abs(rebuilt - zwidth.char_poly(*wall)) <= tol.REBUILT.float64 * magnitude + rounding).all()


@given(walls())
def test_the_sum_of_the_poles_does_not_know_the_wall_beyond_one_period(wall):
    _, _, delta, d = wall
    assume(d >= 1)
    # The force enters P at powers below the second highest.
    poles = zwidth.poles(*wall)
    assert abs(poles.sum() - (1 + np.exp(-delta))) <= tol.REBUILT.float64 * np.abs(poles).sum()


@given(alphas, shares, magnitudes(-300, -5), st.sampled_from([0.0, 1.0, 2.0, 0.5, 1.3]))
def test_weak_damping_tends_to_none(alpha, beta, delta, d):
    damped, free = (zwidth.char_poly(alpha, beta, value, d) for value in (delta, 0.0))
    # Every phi-function changes by less than delta/2, and c by delta.
    assert (np.abs(damped - free) <= (delta + 1e-15) * size(alpha, beta)).all()


@given(magnitudes(-300, -5), st.floats(0.1, 3.0), st.sampled_from([0.0, 1.0, 2.0, 0.5, 1.3]))
def test_the_boundary_of_a_weakly_damped_device(delta, omega, d):
    damped, free = (zwidth.boundary(omega, value, d) for value in (delta, 0.0))
    # The curve starts at beta = -delta. Towards pi the numerator of the undamped loop vanishes, which raises the slope.
    slope = 2.0 + 50.0 / (np.pi - omega) ** 4
    assert abs(damped.alpha - free.alpha) <= slope * (delta + 1e-14)
    assert abs(damped.beta - free.beta) <= slope * (delta + 1e-14)


@given(alphas, shares, magnitudes(-9, 4), st.sampled_from([0, 1, 3]), magnitudes(-15, -6))
def test_a_short_fraction_tends_to_the_whole_delay_below(alpha, beta, delta, whole, fraction):
    assume(whole + fraction != whole)
    partial = zwidth.char_poly(alpha, beta, delta, whole + fraction)
    expected = np.append(zwidth.char_poly(alpha, beta, delta, whole), 0.0)
    # The last one is exact: d = n + f to a rounding error.
    step = (whole + fraction) - whole
    assert (np.abs(partial - expected) <= (2 * step * (1 + delta) + 1e-15) * size(alpha, beta)).all()


@given(alphas, shares, magnitudes(-9, 4), st.sampled_from([0, 1, 3]), magnitudes(-15, -6))
def test_a_long_fraction_tends_to_the_whole_delay_above(alpha, beta, delta, whole, rest):
    d = whole + 1 - rest
    assume(d < whole + 1)
    partial, expected = (zwidth.char_poly(alpha, beta, delta, value) for value in (d, whole + 1))
    step = (whole + 1) - d
    assert (np.abs(partial - expected) <= (2 * step * (1 + delta) + 1e-15) * size(alpha, beta)).all()
