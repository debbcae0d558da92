"""Grouping by degree: every point reaches the kernel of its own degree, and comes back to its own place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zwidth.loops.rigid.folding import Degree, find_degree, map_by_degree
from zwidth.words.errors import TracedDelayError
from zwidth.words.xp import namespace

DELAYS = np.array([2.0, 0.0, 0.5, 2.0, np.nan, 1e-300, 7.25, 0.0, -1.0, np.inf])
DEGREES = [(2, False), (0, False), (0, True), (2, False), (0, False), (0, True), (7, True), (0, False)]


def numbers(alpha, beta, delta, d, degree):
    """As many numbers as there are poles: alpha, then how many."""
    xp, first = namespace(alpha, d), alpha + 0.0 * d
    return xp.concatenate([first[..., None], xp.full((*first.shape, degree.poles - 1), float(degree.poles))], -1)


@pytest.mark.parametrize("d, expected", list(zip(DELAYS[:8], DEGREES, strict=True)))
def test_degree_of_one_delay(d, expected):
    assert find_degree(d) == Degree(*expected)


@pytest.mark.parametrize("whole, fractional, poles", [(0, False, 3), (0, True, 4), (5, False, 8), (5, True, 9)])
def test_count_of_poles(whole, fractional, poles):
    assert Degree(whole, fractional).poles == poles


def test_a_delay_an_ulp_from_a_whole_number_keeps_its_fraction():
    assert find_degree(np.nextafter(3.0, 0.0)) == Degree(2, True)
    assert find_degree(np.nextafter(3.0, 4.0)) == Degree(3, True)
    assert find_degree(500) == Degree(500, False)


def test_every_point_has_the_degree_of_its_delay():
    def kernel(alpha, beta, delta, d, degree):
        return np.stack([alpha + degree.whole, alpha + degree.fractional], -1)

    found = map_by_degree(kernel, (0.0, 0.0, 0.0, DELAYS))
    np.testing.assert_array_equal(found, [find_degree(d) for d in DELAYS])


def test_points_come_back_to_their_places():
    delays = np.array([[2.0, 0.0, 0.5], [0.0, 7.25, 2.0]])
    alpha = np.arange(6.0).reshape(2, 3)
    vectors = map_by_degree(numbers, (alpha, 0.0, 0.0, delays))
    assert vectors.shape == (2, 3, 11)
    expected = [[5, 3, 4], [3, 11, 5]]
    np.testing.assert_array_equal(np.isfinite(vectors).sum(-1), expected)
    np.testing.assert_array_equal(vectors[..., 0], alpha)
    np.testing.assert_array_equal(vectors[..., 1], expected)


def test_filling_in_front_is_zeros():
    vectors = map_by_degree(numbers, (7.0, 0.0, 0.0, np.array([0, 2])), lead=True)
    np.testing.assert_array_equal(vectors, [[0, 0, 7, 3, 3], [7, 5, 5, 5, 5]])


@pytest.mark.parametrize("shape", [(), (0,), (2, 0), (1, 1)])
def test_shapes(shape):
    vectors = map_by_degree(numbers, (np.ones(shape), 0.0, 0.0, 1))
    assert vectors.shape == (*shape, 4 if np.prod(shape) else 3)


def test_traced_points_are_grouped_too():
    delays = np.array([2.0, 0.0, 0.5])
    function = jax.jit(lambda alpha: map_by_degree(numbers, (alpha, 0.0, 0.0, delays)))
    vectors = function(jnp.arange(3.0))
    np.testing.assert_array_equal(vectors[:, 0], [0, 1, 2])
    np.testing.assert_array_equal(np.isfinite(vectors).sum(-1), [5, 3, 4])


def test_no_traced_points_have_the_fewest_poles():
    vectors = jax.jit(lambda alpha: map_by_degree(numbers, (alpha, 0.0, 0.0, 1.0)))(jnp.ones(0))
    assert vectors.shape == (0, 3)


def test_a_traced_delay_is_refused_with_the_remedy():
    with pytest.raises(TracedDelayError, match="pass d as a plain number, for example through jit's static_argnums"):
        jax.jit(lambda d: map_by_degree(numbers, (1.0, 0.0, 0.0, d)))(1.0)
