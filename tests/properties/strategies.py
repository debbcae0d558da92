"""Hypothesis strategies for walls, devices and delays over the supported magnitudes."""

from __future__ import annotations

from hypothesis import strategies as st


def magnitudes(low: float, high: float) -> st.SearchStrategy[float]:
    """Return a strategy for powers of ten with uniform exponents."""
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


deltas = st.just(0.0) | magnitudes(-12, 4)
alphas = magnitudes(-9, 4)
# In units of 1 + delta, the range of stable virtual damping.
ratios = st.floats(-1.0, 1.0).map(lambda ratio: ratio if abs(ratio) > 1e-50 else 0.0)
# Few polynomial degrees, because each is compiled once; the fractional parts are arbitrary.
integer_delays = st.sampled_from([0, 1, 2, 4])
fractions = st.floats(1e-9, 1 - 1e-9)
delays = integer_delays.map(float) | st.tuples(st.sampled_from([0, 1, 3]), fractions).map(sum)


@st.composite
def walls(draw: st.DrawFn) -> tuple[float, float, float, float]:
    """Draw (alpha, beta, delta, d)."""
    delta = draw(deltas)
    return draw(alphas), draw(ratios) * (1.0 + delta), delta, draw(delays)
