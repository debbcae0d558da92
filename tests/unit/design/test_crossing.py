"""The outermost zero on functions whose zeros are known."""

import numpy as np
import pytest

from zwidth.design.crossing import outermost_zero


def solve(value, slope, inner, outer, offset=0.0):
    ends = (np.array([[end]]) for end in (inner, outer, offset))
    zero, found = outermost_zero(value, lambda x: (value(x), slope(x)), *ends)
    return zero[0, 0], bool(found[0, 0])


def test_of_several_zeros_the_last():
    zero, found = solve(lambda x: -(x - 1) * (x - 2) * (x - 3), lambda x: -3 * x * x + 12 * x - 11, 0.5, 10.0)
    assert found
    assert zero == pytest.approx(3.0, rel=1e-15)


def test_a_function_below_zero_has_none():
    assert not solve(lambda x: -1.0 - x, lambda x: -1.0 + 0 * x, 0.5, 2.0)[1]


@pytest.mark.parametrize("place", [0.713, 1.0012, 1.9, 3.999])
@pytest.mark.parametrize("height", [1e-7, 1e-9])
def test_a_peak_between_two_samples_is_found_on_its_far_side(place, height):
    # No sample of the first round lies above 0: the round after looks on both sides of the highest one.
    first = 0.5 * 8 ** (np.arange(161) / 160)
    assert np.all(height - (first - place) ** 2 < 0)
    zero, found = solve(lambda x: height - (x - place) ** 2, lambda x: -2 * (x - place), 0.5, 4.0)
    assert found
    assert zero == pytest.approx(place + np.sqrt(height), rel=1e-12)


def test_the_whole_bracket_is_seen_on_either_side_of_the_highest_sample():
    # A peak just before a sample and one just behind it.
    first = 0.5 * 8 ** (np.arange(161) / 160)
    gap = first[81] - first[80]
    for place in (first[80] - 0.2 * gap, first[80] + 0.2 * gap):
        height = (0.1 * gap) ** 2
        zero, found = solve(
            lambda x, place=place, height=height: height - (x - place) ** 2,
            lambda x, place=place: -2 * (x - place),
            0.5,
            4.0,
        )
        assert found
        assert zero == pytest.approx(place + 0.1 * gap, rel=1e-12)


def test_a_zero_at_the_inner_end_and_an_offset():
    zero, found = solve(lambda x: -x, lambda x: -1.0 + 0 * x, 0.0, 5.0, 1.0)
    assert found
    assert zero == 0.0
