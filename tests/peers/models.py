"""The device and the closed loop from their differential equations, by scipy's matrix exponential.

Independent of the library: no phi-functions, no normalized polynomial.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.linalg import expm


@cache
def advance(mass, damping, duration):
    """Return the exact (A, B) of x' = v, m v' = F - b v over ``duration`` under a held force."""
    generator = np.array([[0.0, 1.0, 0.0], [0.0, -damping / mass, 1.0 / mass], [0.0, 0.0, 0.0]])
    step = expm(generator * duration)
    return step[:2, :2], step[:2, 2]


def simulate(mass, damping, period, stiffness, virtual_damping, d, force, fractions, periods):
    """Return position, velocity and wall force at given fractions of every period, by matrix exponentials
    between events.
    """
    n = int(np.floor(d))
    f = d - n
    # Forces before the first sample are zero.
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

        at_change = move(state, older, f)
        for fraction in fractions:
            if fraction < f:
                result.append((*move(state, older, fraction), older))
            else:
                result.append((*move(at_change, newer, fraction - f), newer))
        state = move(at_change, newer, 1.0 - f)
    return np.array(result).T
