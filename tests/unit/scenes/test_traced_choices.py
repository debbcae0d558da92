"""The chosen dampings and walls inside transformations and in batches, and the columns that they are sought in."""

import jax
import numpy as np
import pytest
from compiling import SOON

import zwidth
from zwidth import fastest_damping, fastest_wall, most_robust_damping
from zwidth.loops.rigid.curve import column, lobe, peak
from zwidth.loops.rigid.delay_classes import ANY
from zwidth.words.status import Status

# One degree, hence one compilation a question; two stiffnesses, one out of reach.
ALPHA, DELTA, D = np.array([0.05, 0.1, 5.0]), np.array([0.1, 0.5, 0.1]), 1.0
# At a smooth optimum, and at a double pole, beta is known to the square root of a rounding error only.
BETA, ACHIEVED = 1e-6, 1e-8


@pytest.fixture(scope="module", params=[fastest_damping, most_robust_damping])
def question(request):
    return request.param


@pytest.fixture(scope="module")
def direct(question):
    return question(ALPHA, DELTA, D)


def same(left, right):
    np.testing.assert_array_equal(left.status, right.status)
    np.testing.assert_allclose(left.beta, right.beta, rtol=BETA)
    np.testing.assert_allclose(left.achieved, right.achieved, rtol=ACHIEVED)


def test_jit_and_vmap_agree_with_direct_calls(question, direct, x64):
    assert direct.status.tolist() == [Status.OK, Status.OK, Status.NO_BOUNDARY]
    # A function of one point inside vmap inside jit; beside it the same of whole arrays would compile for as long.
    mapped = jax.jit(jax.vmap(lambda alpha, delta: question(alpha, delta, D)), compiler_options=SOON)(ALPHA, DELTA)
    same(mapped, direct)
    assert mapped.beta.dtype == np.float64


def test_a_batch_is_its_points(question, direct):
    for i in range(2):
        one = question(ALPHA[i : i + 1], DELTA[i], D)
        assert one.beta[0] == pytest.approx(direct.beta[i], rel=BETA)
        assert one.achieved[0] == pytest.approx(direct.achieved[i], rel=ACHIEVED)


def test_a_bad_entry_leaves_the_others_alone(question, direct):
    spoiled = question(np.array([ALPHA[0], np.inf, -1.0]), np.array([DELTA[0], np.nan, 0.1]), D)
    assert spoiled.status.tolist() == [Status.OK, Status.INVALID_INPUT, Status.NO_BOUNDARY]
    assert (spoiled.beta[0], spoiled.achieved[0]) == (direct.beta[0], direct.achieved[0])
    assert np.isnan(spoiled.beta[1:]).all()


def test_the_choice_is_certified_and_lies_between_unstable_walls(direct):
    walls = (ALPHA[:2], direct.beta[:2], DELTA[:2], D)
    assert np.all(zwidth.is_stable(*walls, method="certified"))
    ends = [zwidth.boundary_point(DELTA[:2], D, alpha=ALPHA[:2], side=side).beta for side in ("lower", "upper")]
    assert np.all((ends[0] < direct.beta[:2]) & (direct.beta[:2] < ends[1]))


def test_a_search_has_no_derivative(question, x64):
    slope = jax.jit(jax.grad(lambda alpha: question(alpha, 0.1, D).achieved), compiler_options=SOON)
    assert np.isnan(slope(0.05))


def test_traced_delays_are_refused_where_all_poles_are_computed():
    with pytest.raises(zwidth.TracedDelayError, match="d: got a traced value"):
        jax.jit(lambda d: fastest_damping(0.1, 0.1, d))(1.0)
    with pytest.raises(zwidth.TracedDelayError, match="d: got a traced value"):
        jax.jit(lambda d: fastest_wall(0.1, d))(1.0)


def test_mixed_degrees_in_one_compiled_function(x64):
    # Eigenvalues of two sizes in one program.
    d = np.array([0.0, 1.0, 0.0, 0.5])
    alpha = np.array([0.1, 0.05, 0.2, 0.05])
    choice = jax.jit(lambda alpha: fastest_damping(alpha, 0.2, d), compiler_options=SOON)(alpha)
    direct = fastest_damping(alpha, 0.2, d)
    same(choice, direct)


def test_walls_in_a_batch_and_inside_jit(x64):
    delta = np.array([0.0, 0.5, np.nan])
    batch = fastest_wall(delta, 0.0)
    assert batch.status.tolist() == [Status.OK, Status.OK, Status.INVALID_INPUT]
    assert np.isnan(batch.spectral_radius[2])
    # (z - r)^3: the triple pole of the undamped wall.
    assert batch.spectral_radius[0] == pytest.approx(4 ** (1 / 3) - 1, abs=2e-5)
    traced = jax.jit(jax.vmap(lambda delta: fastest_wall(delta, 0.0)), compiler_options=SOON)(delta)
    np.testing.assert_allclose(traced.spectral_radius, batch.spectral_radius, atol=1e-5)
    np.testing.assert_allclose(traced.alpha, batch.alpha, atol=1e-3)
    assert np.all(zwidth.is_stable(batch.alpha[:2], batch.beta[:2], delta[:2], 0.0, method="certified"))
    other = fastest_wall(np.array([0.0, 0.5, 0.7]), 0.0)
    assert np.array_equal(other.alpha[:2], batch.alpha[:2])


def test_columns_end_where_stability_does():
    random = np.random.default_rng(4)
    count = 400
    d = random.choice([0.0, 0.05, 0.3, 0.9, 1.0, 1.5, 3.0], count)
    delta = 10 ** random.uniform(-3, 2, count) * (random.random(count) > 0.1)
    top = zwidth.alpha_max(delta, d)
    alpha = top.alpha * random.uniform(0.01, 0.999, count)
    # What does not apply to a point is computed beside it.
    with np.errstate(all="ignore"):
        curve = lobe(delta, d, "held", ANY)
        lower, upper, exists = column(alpha, curve, peak(curve, "held", ANY))
    assert np.all(exists)
    width = upper - lower
    for end, inside in ((lower, 1.0), (upper, -1.0)):
        # Relative to what rounding does to the poles: beta itself may be much larger than the column is wide.
        step = inside * (1e-6 * width + 1e-12 * np.abs(end))
        assert np.all(zwidth.is_stable(alpha, end + step, delta, d, method="certified"))
        assert not np.any(zwidth.is_stable(alpha, end - step, delta, d, method="certified"))
