"""Float64 balls: every operation encloses what python-flint's balls compute, and comparisons are certain or false."""

import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zwidth.arrays import balls
from zwidth.arrays.balls import Ball, as_ball

flint = pytest.importorskip("flint")
OPERATIONS: tuple[Callable[[Any, Any], Ball], ...] = (operator.add, operator.sub, operator.mul, operator.truediv)
COUNT = 600


def random_balls(rng, exact):
    """Numbers of sixty decades, exact or with radii from a rounding error to ten times themselves."""
    mid = rng.choice([-1, 1], COUNT) * 10.0 ** rng.uniform(-30, 30, COUNT)
    return Ball(mid) if exact else Ball(mid, np.abs(mid) * 10.0 ** rng.uniform(-17, 1, COUNT))


def members(ball, index):
    """The ends and the middle of one ball, exactly."""
    mid = flint.arb(float(ball.mid[index]))
    if np.ndim(ball.rad) == 0:
        return [mid]
    rad = flint.arb(float(ball.rad[index]))
    return [mid - rad, mid, mid + rad]


def escaped(operation, left, right, result):
    """How many results on the balls' ends lie outside the ball computed."""
    count = 0
    with flint.ctx.workprec(400):
        for index in range(COUNT):
            if operation is operator.truediv and not all(abs(y) > 0 for y in members(right, index)):
                continue
            radius = np.broadcast_to(result.radius, COUNT)[index]
            if not np.isfinite(radius):
                continue
            for x in members(left, index):
                for y in members(right, index):
                    count += not abs(operation(x, y) - float(result.mid[index])) <= float(radius)
    return count


@pytest.mark.parametrize("exact", [(True, True), (True, False), (False, True), (False, False)])
@pytest.mark.parametrize("operation", OPERATIONS)
def test_operations_enclose(operation, exact):
    rng = np.random.default_rng(3)
    left, right = random_balls(rng, exact[0]), random_balls(rng, exact[1])
    with np.errstate(all="ignore"):
        result = operation(left, right)
    assert escaped(operation, left, right, result) == 0
    # Enclosing everything by infinity would be no achievement; a divisor that may be 0 leaves nothing else.
    known = np.isfinite(np.broadcast_to(result.radius, COUNT)).mean()
    assert known == 1.0 if operation is not operator.truediv or exact[1] else 0.7 < known < 1.0


@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_rounding_bound_too_small_is_noticed(monkeypatch, operation):
    monkeypatch.setattr(balls, "UNIT", 2.0**-55)
    rng = np.random.default_rng(3)
    left, right = random_balls(rng, True), random_balls(rng, True)
    assert escaped(operation, left, right, operation(left, right)) > 0


def test_compiled_operations_enclose():
    rng = np.random.default_rng(5)
    left, right = random_balls(rng, False), random_balls(rng, False)

    def everything(a, ra, b, rb):
        results = [operation(Ball(a, ra), Ball(b, rb)) for operation in OPERATIONS]
        return [(result.mid, result.rad) for result in results]

    with jax.enable_x64(True):
        found = jax.jit(everything)(left.mid, left.rad, right.mid, right.rad)
    for operation, (mid, rad) in zip(OPERATIONS, found, strict=True):
        assert escaped(operation, left, right, Ball(np.asarray(mid), np.asarray(rad))) == 0


def test_plain_numbers_take_part():
    ball = Ball(np.array([3.0, -0.1]), np.array([1e-3, 0.0]))
    for number in (0.5, -4, 3, 0.1):
        for operation in OPERATIONS:
            for left, right in ((ball, number), (number, ball)):
                result = operation(left, right)
                wide = operation(as_ball(left), as_ball(right))
                np.testing.assert_array_equal(result.mid, wide.mid)
                assert (result.radius <= wide.radius).all()
    # A power of two costs no rounding.
    assert (ball * 4).rad.tolist() == [4e-3, 0.0]


def test_roots_enclose():
    rng = np.random.default_rng(7)
    mid = 10.0 ** rng.uniform(-30, 30, COUNT)
    ball = Ball(mid, mid * 10.0 ** rng.uniform(-17, 0.3, COUNT))
    root = ball.sqrt()
    with flint.ctx.workprec(400):
        for index in range(COUNT):
            for x in members(ball, index):
                if x > 0:
                    assert abs(x.sqrt() - float(root.mid[index])) <= float(root.radius[index])
    with np.errstate(all="ignore"):
        unknown = Ball(np.array([0.0, -1.0]), np.array([1.0, 1.0])).sqrt()
    assert not (unknown > -1e300).any()


def test_comparisons_are_certain_or_false():
    ball = Ball(
        np.array([1.0, 1.0, -1.0, 0.0, np.nan, np.inf, 1.0]), np.array([0.5, 1.0, 0.5, 0.0, 0.1, np.inf, np.nan])
    )
    with np.errstate(all="ignore"):
        assert (ball > 0).tolist() == [True, False, False, False, False, False, False]
        assert (ball < 0).tolist() == [False, False, True, False, False, False, False]
        assert (ball > ball).tolist() == [False] * 7
        assert (Ball(np.array([2.0])) > Ball(np.array([1.0]), np.array([0.99]))).tolist() == [True]
        assert (Ball(np.array([2.0])) > Ball(np.array([1.0]), np.array([1.0]))).tolist() == [False]


def test_lower_ends_lie_below():
    rng = np.random.default_rng(9)
    ball = random_balls(rng, False)
    low = ball.lower()
    with flint.ctx.workprec(400):
        assert all(members(ball, index)[0] >= float(low[index]) for index in range(COUNT))
    assert (low >= ball.mid - (1 + 1e-9) * ball.rad - 1e-15 * (np.abs(ball.mid) + ball.rad)).all()


def test_arrays_leave_the_operation_to_the_ball():
    ball = Ball(np.ones(3), np.full(3, 0.1))
    assert isinstance(np.arange(3.0) * ball, Ball)
    assert isinstance(np.float64(2.0) - ball, Ball)
    with jax.enable_x64(True):
        assert isinstance(jnp.arange(3.0) * ball, Ball)
