"""Normalization: invariance under scaling of mass and period, and inversion."""

import numpy as np
import pytest
import tolerances as tol
from hypothesis import given
from hypothesis import strategies as st

import zwidth
from properties.strategies import alphas, deltas, magnitudes, ratios

EXPONENTS = st.integers(-40, 40)
WALL = {"mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": 2.5e-3, "stiffness": 14.9e3, "virtual_damping": -41.6}


@given(EXPONENTS, EXPONENTS)
def test_scaling_by_powers_of_two_is_exact(mass_exponent, period_exponent):
    by_mass, by_period = 2.0**mass_exponent, 2.0**period_exponent
    scaled = zwidth.normalize(
        mass=WALL["mass"] * by_mass,
        period=WALL["period"] * by_period,
        delay=WALL["delay"] * by_period,
        damping=WALL["damping"] * by_mass / by_period,
        stiffness=WALL["stiffness"] * by_mass / by_period**2,
        virtual_damping=WALL["virtual_damping"] * by_mass / by_period,
    )
    assert scaled == zwidth.normalize(**WALL)


# Nonzero values in seconds or N s/m must not be below the SI range.
LARGE_ENOUGH = {"beta": ratios.map(lambda beta: beta * (abs(beta) > 1e-20)), "d": st.floats(1e-20, 500) | st.just(0.0)}


@given(magnitudes(-3, 3), magnitudes(-5, 0), alphas, LARGE_ENOUGH["beta"], deltas, LARGE_ENOUGH["d"])
def test_normalization_is_inverted_by_denormalize(mass, period, alpha, beta, delta, d):
    physical = zwidth.denormalize(mass=mass, period=period, alpha=alpha, beta=beta, delta=delta, d=d)
    back = zwidth.normalize(**physical._asdict())
    for got, expected in zip(back, (alpha, beta, delta, d), strict=True):
        assert got == pytest.approx(expected, rel=2 * tol.NORMALIZED.float64, abs=1e-300)


@given(st.integers(1, 2000), magnitudes(-6, 0))
def test_integer_delays_are_exact_after_conversion_from_si(periods, period):
    assert zwidth.normalize(mass=1.0, period=period, delay=periods * period).d == periods


@given(magnitudes(-3, 3), magnitudes(-5, 0))
def test_poles_depend_on_normalized_parameters_only(mass, period):
    physical = zwidth.denormalize(mass=mass, period=period, alpha=0.3, beta=0.2, delta=0.5, d=1.0)
    poles = zwidth.poles(*zwidth.normalize(**physical._asdict()))
    np.testing.assert_allclose(np.sort(np.abs(poles)), np.sort(np.abs(zwidth.poles(0.3, 0.2, 0.5, 1.0))), rtol=1e-12)
