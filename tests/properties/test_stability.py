"""Passive walls are stable, boundary points have a pole on the unit circle, and damping increases K_max."""

import math

import numpy as np
import tolerances as tol
from hypothesis import assume, given
from hypothesis import strategies as st
from mpmath import mp

import oracles
import zwidth
from properties.strategies import delays, deltas, integer_delays, magnitudes


@given(magnitudes(-6, 4), magnitudes(-6, 0.5), st.floats(-1.2, 1.2).map(lambda x: x if abs(x) > 1e-50 else 0.0), delays)
def test_passive_implies_stable(delta, stiffness, damping, d):
    # Passive walls have alpha below about delta/(d + 1/2) and |beta| below delta.
    alpha, beta = stiffness * delta / (d + 0.5), damping * delta
    assume(zwidth.is_passive(alpha, beta, delta, d))
    assert zwidth.spectral_radius(alpha, beta, delta, d) < 1 + 4 * np.finfo(float).eps


@given(delays, st.integers(0, 2**32 - 1))
def test_passive_implies_stable_in_batches(d, seed):
    rng = np.random.default_rng(seed)
    delta = 10 ** rng.uniform(-2, 2, 64)
    alpha, beta = rng.uniform(0, 2, 64) * delta / (d + 0.5), rng.uniform(-1, 1, 64) * delta
    passive = zwidth.is_passive(alpha, beta, delta, d)
    assert np.asarray(zwidth.is_stable(alpha, beta, delta, d))[passive].all()


@given(st.floats(0.0, 1.0), deltas, delays)
def test_boundary_has_a_pole_on_the_unit_circle(ratio, delta, d):
    omega = 1e-3 + ratio * (math.pi - 2e-3)
    wall = zwidth.boundary(omega, delta, d)
    with mp.workdps(40 + (0 if delta == 0 else 60)):
        terms = oracles.polynomial(wall.alpha, wall.beta, delta, d)
        value = oracles.evaluate(terms, mp.expj(omega))
        # The phase (d + 1) omega also contributes rounding errors.
        assert abs(value) <= tol.BOUNDARY.float64 * (d + 2) * 4 * sum(abs(term) for term in terms)


@given(deltas, st.floats(0.0, 1.0), delays)
def test_maximum_stiffness_increases_with_damping(delta, increment, d):
    low, high = zwidth.alpha_max(np.array([delta, delta * (1 + increment) + increment * 1e-3]), d).alpha
    assert high >= low * (1 - tol.EPS64 * 8)


@given(deltas, integer_delays)
def test_maximum_stiffness_decreases_with_delay(delta, d):
    stiffest = zwidth.alpha_max(delta, np.array([d, d + 1.0])).alpha
    assert stiffest[1] < stiffest[0]


@given(magnitudes(-3, 3), delays, st.floats(0.05, 0.95))
def test_walls_between_ridge_and_start_are_stable(delta, d, ratio):
    # The stable region is not convex, but it contains this segment.
    top = zwidth.alpha_max(delta, d)
    alpha, beta = ratio * top.alpha, -delta + ratio * (top.beta + delta)
    assert zwidth.alpha_max(delta, d).status == 0
    assert zwidth.spectral_radius(alpha, beta, delta, d) < 1
