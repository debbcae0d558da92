"""The device and the closed loop from their differential equations, by scipy's matrix exponential alone.

Nothing here shares a formula with the library: no phi-function, no normalized polynomial.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.linalg import expm


@cache
def advance(mass, damping, duration):
    """Exact (A, B) of x' = v, m v' = F - b v over ``duration`` under a held force."""
    generator = np.array([[0.0, 1.0, 0.0], [0.0, -damping / mass, 1.0 / mass], [0.0, 0.0, 0.0]])
    step = expm(generator * duration)
    return step[:2, :2], step[:2, 2]


def simulate(mass, damping, period, stiffness, virtual_damping, d, force, fractions, periods):
    """Position, velocity and wall force at the given fractions of every period, from event to event by expm."""
    n = int(np.floor(d))
    f = d - n
    # Forces of the samples before the first are zero.
    computed = [0.0] * (n + 1)
    state, previous = np.zeros(2), 0.0
    result = []
    for k in range(periods):
        computed.append(-(stiffness * state[0] + virtual_damping / period * (state[0] - previous)))
        previous = state[0]
        older, newer = computed[k], computed[k + 1]

        def move(start, wall_force, fraction):
            transition, by_force = advance(mass, damping, fraction * period)
            return transition @ start + by_force * (force + wall_force)

        at_bend = move(state, older, f)
        for fraction in fractions:
            if fraction < f:
                result.append((*move(state, older, fraction), older))
            else:
                result.append((*move(at_bend, newer, fraction - f), newer))
        state = move(at_bend, newer, 1.0 - f)
    return np.array(result).T
