"""What Hypothesis draws: walls, devices and delays over all the magnitudes the model is meant for."""

from __future__ import annotations

from hypothesis import strategies as st


def magnitudes(low: float, high: float) -> st.SearchStrategy[float]:
    """Powers of ten, evenly by exponent."""
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


deltas = st.just(0.0) | magnitudes(-12, 4)
alphas = magnitudes(-9, 4)
# In units of 1 + delta, the range in which stable dampings lie.
shares = st.floats(-1.0, 1.0).map(lambda share: share if abs(share) > 1e-50 else 0.0)
# Few degrees, because each is compiled once; the fractions are free.
whole_delays = st.sampled_from([0, 1, 2, 4])
fractions = st.floats(1e-9, 1 - 1e-9)
delays = whole_delays.map(float) | st.tuples(st.sampled_from([0, 1, 3]), fractions).map(sum)


@st.composite
def walls(draw: st.DrawFn) -> tuple[float, float, float, float]:
    """(alpha, beta, delta, d)."""
    delta = draw(deltas)
    return draw(alphas), draw(shares) * (1.0 + delta), delta, draw(delays)
