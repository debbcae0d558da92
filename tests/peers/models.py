"""The closed loop as peers see it: built from differential equations with scipy's matrix exponential alone.

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


def held_loop(mass, damping, period, stiffness, virtual_damping, d):
    """The closed loop's state matrix for any delay d = n + f, by expm over the two parts of the period.

    State: x_k, v_k, x_(k-1), and the forces computed at k-1, ..., k-1-n. Period k is driven by the force of k-1-n
    during [0, f T) and by that of k-n afterwards.
    """
    n = int(np.floor(d))
    f = d - n
    first, by_older = advance(mass, damping, f * period)
    second, by_newer = advance(mass, damping, (1.0 - f) * period)
    size = 3 + n + 1
    loop = np.zeros((size, size))
    feedback = np.zeros(size)
    feedback[0] = -(stiffness + virtual_damping / period)
    feedback[2] = virtual_damping / period
    loop[:2, :2] = second @ first
    loop[:2, 3 + n] += second @ by_older
    if n == 0:
        loop[:2] += np.outer(by_newer, feedback)
    else:
        loop[:2, 3 + n - 1] += by_newer
    loop[2, 0] = 1.0
    loop[3] = feedback
    for k in range(n):
        loop[4 + k, 3 + k] = 1.0
    return loop


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
