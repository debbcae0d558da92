"""The means of proof themselves: what tests/oracles/boxes.py proves, refutes, leaves open and encloses."""

from __future__ import annotations

import random

import pytest
from boxes import UNIT, Implication, RefutedError, UnprovedError, ball, early_mean, loop, prove


def test_prove_stops_at_what_it_cannot_prove() -> None:
    """x^2 >= 0 vanishes inside the box: neither proved nor refuted, and said so."""
    with pytest.raises(UnprovedError):
        prove(lambda x: ball(x) * ball(x), [(-1.0, 1.0)], limit=2_000)


def test_prove_refutes_an_implication() -> None:
    """x > 1/2 does not imply x > 3/4."""
    with pytest.raises(RefutedError):
        prove(lambda x: Implication((ball(x) - 0.5,), ball(x) - 0.75), [UNIT])


def test_s1_ranges_hold_the_devices_of_a_box() -> None:
    """S1: the shares are monotone, so that the corners of a box enclose all its devices."""
    rng = random.Random(2)
    for _ in range(300):
        low = 2.0 ** rng.uniform(-20, -0.01)
        tau = (low, min(1.0, low * 2.0 ** rng.uniform(0, 3)))
        f = tuple(sorted((rng.random(), rng.random())))
        inside = (rng.uniform(*tau), rng.uniform(*f))
        whole, point = loop(tau, f), loop((inside[0],) * 2, (inside[1],) * 2)
        assert all(box.overlaps(value) for box, value in zip(whole, point, strict=True))
        assert early_mean(tau, f).overlaps(early_mean((inside[0],) * 2, (inside[1],) * 2))
