"""Test simulations against an independent integrator: `solve_ivp` of SciPy with events, in absolute coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tolerances
from independent_scenes import KINDS
from random_motions import PERIODS, RandomMotion, condition, judge, nearest_decision, random_motion

from zwidth import Motion

# Differences are allowed if an event is decided by rounding (distance below NEAR), or if the motion amplifies errors of
# the integrator by more than CHAOTIC (random_motions).
NEAR, CHAOTIC = 1e-8, 1e4


def simulate(motion: RandomMotion, seed: int) -> tuple[Motion, RandomMotion]:
    """Return the simulated motion, and the same arguments with the sampled jitter."""
    period = motion.scene.timing.period
    call_options = dict(motion.arguments)
    jitter = call_options.pop("jitter_samples")
    options: dict[str, Any] = {
        "start_position": call_options.pop("position"),
        "start_velocity": call_options.pop("velocity"),
        "jitter": 0.0 if jitter is None else float(np.max(jitter)) * period,
    }
    response = motion.scene.simulate(**call_options, **options, periods=PERIODS, seed=seed)
    if jitter is None:
        return response, motion
    lateness = np.append(np.asarray(response.time) / period - np.arange(PERIODS), 0.0)
    return response, motion._replace(arguments=motion.arguments | {"jitter_samples": lateness})


@pytest.mark.parametrize("kind", KINDS)
def test_motion_matches_independent_integrator(kind):
    rng, has_closed_form = np.random.default_rng([12, KINDS.index(kind)]), kind in ("rigid", "filter")
    compared = 0
    for seed in range(3):
        response, motion = simulate(random_motion(kind, rng), seed)
        history = judge(motion, closed_form=has_closed_form)
        # The first body at the start of every period.
        first = (part.reshape(PERIODS + 1, -1)[:PERIODS, 0] for part in (history.position, history.velocity))
        pairs = zip((np.asarray(response.position), np.asarray(response.velocity)), first, strict=True)
        agrees = max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs) < tolerances.JUDGE.float64
        compared += agrees
        # A difference must have one of the two causes above.
        assert (
            agrees
            or nearest_decision(history) <= NEAR
            or condition(motion, history, closed_form=has_closed_form) >= CHAOTIC
        )
    assert compared >= 2
