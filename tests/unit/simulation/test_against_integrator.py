"""Simulations against an independent integrator: scipy's `solve_ivp` with events, in absolute coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tolerances
from independent_scenes import KINDS
from random_motions import PERIODS, RandomMotion, condition, judge, nearest_decision, random_motion

from zwidth import Motion

# Decided by rounding, or so unstable that the integrator's own error shows (random_motions).
NEAR, CHAOTIC = 1e-8, 1e4


def simulate(motion: RandomMotion, seed: int) -> tuple[Motion, RandomMotion]:
    """The motion simulated, and the same with the instants that were drawn."""
    period = motion.scene.timing.period
    given = dict(motion.arguments)
    jitter = given.pop("jitter_samples")
    options: dict[str, Any] = {
        "start_position": given.pop("position"),
        "start_velocity": given.pop("velocity"),
        "jitter": 0.0 if jitter is None else float(np.max(jitter)) * period,
    }
    found = motion.scene.simulate(**given, **options, periods=PERIODS, seed=seed)
    if jitter is None:
        return found, motion
    late = np.append(np.asarray(found.time) / period - np.arange(PERIODS), 0.0)
    return found, motion._replace(arguments=motion.arguments | {"jitter_samples": late})


@pytest.mark.parametrize("kind", KINDS)
def test_motions_are_those_of_an_independent_integrator(kind):
    rng, own = np.random.default_rng([12, KINDS.index(kind)]), kind in ("rigid", "filter")
    compared = 0
    for seed in range(3):
        found, motion = simulate(random_motion(kind, rng), seed)
        history = judge(motion, closed_form=own)
        # The first body, at the start of every period.
        first = (part.reshape(PERIODS + 1, -1)[:PERIODS, 0] for part in (history.position, history.velocity))
        pairs = zip((np.asarray(found.position), np.asarray(found.velocity)), first, strict=True)
        alike = max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs) < tolerances.JUDGE.float64
        compared += alike
        # Who differs is asked why, and has one excuse.
        assert alike or nearest_decision(history) <= NEAR or condition(motion, history, closed_form=own) >= CHAOTIC
    assert compared >= 2
