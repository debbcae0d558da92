"""Exact values of the differences whose signs a stability verdict tests, in balls of python-flint, and random walls."""

import numpy as np
import pytest

flint = pytest.importorskip("flint")


def pick(value, index):
    """Return one entry of an array; a number stands for all entries."""
    return float(np.broadcast_to(value, index + 1 if np.ndim(value) == 0 else value.shape)[index])


def draw_walls(count, seed, d):
    """Return walls in and around the stable sets of many devices."""
    rng = np.random.default_rng(seed)
    delta = np.where(rng.random(count) < 0.5, rng.exponential(1.0, count), 10.0 ** rng.uniform(-9, 9, count))
    d = np.full(count, float(d)) if np.ndim(d) == 0 else rng.choice(d, count)
    scale = (1 + delta) / (1 + d)
    return rng.uniform(0, 2, count) * scale, rng.uniform(-1, 2, count) * (delta + 1 / (1 + d)), delta, d


class Exact:
    """A ball that records every difference whose sign is tested."""

    def __init__(self, ball, differences):
        self.ball, self.differences = ball, differences

    def new(self, ball):
        return Exact(ball, self.differences)

    def __add__(self, other):
        return self.new(self.ball + getattr(other, "ball", other))

    def __mul__(self, other):
        return self.new(self.ball * getattr(other, "ball", other))

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self):
        return self.new(-self.ball)

    def __sub__(self, other):
        return self + -other

    def __rsub__(self, other):
        return -self + other

    def __truediv__(self, other):
        return self.new(self.ball / other.ball)

    def sqrt(self):
        return self.new(self.ball.sqrt())

    def __gt__(self, other):
        self.differences.append((self - other).ball)
        return bool(self.differences[-1] > 0)

    def __lt__(self, other):
        return -self > -other


def exact_differences(verdict, wall, plant, *more):
    """Return the differences whose signs a verdict tests, in balls."""
    differences = []
    terms = plant._replace(**{k: Exact(v, differences) for k, v in plant._asdict().items() if isinstance(v, flint.arb)})
    verdict(*(Exact(value, differences) for value in wall), *more, terms)
    return differences
