"""Scaling: mass and sampling period drop out of the normalized numbers, and come back."""

import numpy as np
import pytest
import tolerances as tol
from hypothesis import given
from hypothesis import strategies as st

import zwidth
from properties.strategies import alphas, deltas, magnitudes, shares

EXPONENTS = st.integers(-40, 40)
WALL = {"mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": 2.5e-3, "stiffness": 14.9e3, "virtual_damping": -41.6}


@given(EXPONENTS, EXPONENTS)
def test_powers_of_two_leave_every_bit(mass_exponent, period_exponent):
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


# Beside 0 nothing smaller than the SI range once it is in seconds or N s/m.
SIZABLE = {"beta": shares.map(lambda beta: beta * (abs(beta) > 1e-20)), "d": st.floats(1e-20, 500) | st.just(0.0)}


@given(magnitudes(-3, 3), magnitudes(-5, 0), alphas, SIZABLE["beta"], deltas, SIZABLE["d"])
def test_there_and_back(mass, period, alpha, beta, delta, d):
    physical = zwidth.denormalize(mass=mass, period=period, alpha=alpha, beta=beta, delta=delta, d=d)
    back = zwidth.normalize(**physical._asdict())
    for got, expected in zip(back, (alpha, beta, delta, d), strict=True):
        assert got == pytest.approx(expected, rel=2 * tol.NORMALIZED.float64, abs=1e-300)


@given(st.integers(1, 2000), magnitudes(-6, 0))
def test_whole_delays_survive_the_way_through_si(periods, period):
    assert zwidth.normalize(mass=1.0, period=period, delay=periods * period).d == periods


@given(magnitudes(-3, 3), magnitudes(-5, 0))
def test_the_same_normalized_wall_has_the_same_poles(mass, period):
    physical = zwidth.denormalize(mass=mass, period=period, alpha=0.3, beta=0.2, delta=0.5, d=1.0)
    there = zwidth.poles(*zwidth.normalize(**physical._asdict()))
    np.testing.assert_allclose(np.sort(np.abs(there)), np.sort(np.abs(zwidth.poles(0.3, 0.2, 0.5, 1.0))), rtol=1e-12)
