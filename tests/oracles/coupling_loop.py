"""Closed loops of virtual couplings as matrices, from the statements of a program that also simulates the tool.

`step_coupling` applies one period of device, program and tool to each unit vector of the state of the loop. The program
filters the position x of the device and knows the position y of the tool exactly. It computes the force of the coupling
``f = K (P x - y) + B (V x - V_t y)``, and commands ``-f - R x``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from program_loop import Filter, Program, close_loop, draw_scene, find_difference

import zwidth


class Coupling:
    """The program of a scene with a tool."""

    def __init__(self, scene: Any, K: float, B: float) -> None:
        T, self.K, self.B, self.tool, self.T = scene.timing.period, K, B, scene.tool, scene.timing.period
        self.estimates = Program(scene, 0.0, 0.0)
        self.has_own_velocity = isinstance(scene.position, zwidth.Pll | zwidth.Observer)
        weights = self.estimates.weights
        # One filter for the velocity difference, unless the velocity of the device is also used by itself.
        self.filters_difference = not self.has_own_velocity and not (weights and weights[2])
        velocity = zwidth.BackwardDifference() if self.has_own_velocity else scene.velocity
        self.velocity = find_difference(velocity, T)
        self.size = self.estimates.size + self.velocity.size + 2
        if self.filters_difference:
            # The program of the device only copies the position that the velocity filter receives.
            self.estimates.parts["v"] = Filter([1.0], [1.0])
            self.size = sum(part.size for part in self.estimates.parts.values()) + self.velocity.size + 2
            self.estimates.size = self.size - self.velocity.size - 2

    def step(self, state: np.ndarray, x: Any) -> tuple[np.ndarray, float]:
        """Return the next state, and the commanded force."""
        n, m = self.estimates.size, self.velocity.size
        program, memory, (y, v) = state[:n], state[n : n + m], state[n + m :]
        weights, self.estimates.K, self.estimates.B = self.estimates.weights, 0.0, 0.0
        later, rest = self.estimates.step(program, x)
        # Evaluate the estimates without the further feedback, whose large force would cancel.
        self.estimates.weights, estimates = None, []
        for self.estimates.K, self.estimates.B in ((-1.0, 0.0), (0.0, -1.0)):
            estimates.append(self.estimates.step(program, x)[1])
        self.estimates.weights, (p, speed) = weights, estimates

        def couple(y: float) -> tuple[np.ndarray, float]:
            """Return the next state of the velocity filter, and the force of the coupling, for a position y."""
            if self.filters_difference:
                after, difference = self.velocity.step(memory, speed - y)
            else:
                after, moving = self.velocity.step(memory, y)
                difference = speed - moving
            return after, self.K * (p - y) + self.B * difference

        M, c, k, T = self.tool.mass, self.tool.damping, self.tool.stiffness, self.T
        if self.tool.integrator == "semi-implicit":
            memory, f = couple(y)
            v = v + T * (f - c * v - k * y) / M
            y = y + T * v
        else:
            # The force is affine in the new position, which is linear in the force.
            at_0, at_1 = couple(0.0)[1], couple(1.0)[1]
            slope = at_1 - at_0
            # M (v' - v)/T = at_0 + slope y' - c v' - k y',  y' = y + T v'
            v = (M * v / T + at_0 + (slope - k) * y) / (M / T + c - (slope - k) * T)
            y = y + T * v
            memory, f = couple(y)
        return np.concatenate([later, memory, [y, v]]), rest - f


def step_coupling(scene: Any, K: float, B: float) -> np.ndarray:
    """Return the matrix of one period of the closed loop with a virtual coupling."""
    return close_loop(scene, Coupling(scene, K, B))


def find_coupling_radius(scene: Any, K: float, B: float) -> float:
    """Return the spectral radius of the closed loop, without the modes of a common drift of device and tool at z = 1.

    A drift exists if the device without feedback and the tool have poles at z = 1; it has as many modes as both share.
    """
    poles = np.linalg.eigvals(step_coupling(scene, K, B))
    count = count_drifts(scene)
    # A double eigenvalue at 1 is accurate to the square root of the rounding error only.
    return float(np.abs(np.delete(poles, np.argsort(np.abs(poles - 1.0))[:count])).max())


def count_drifts(scene: Any) -> int:
    """Return the number of poles at z = 1 that the device with its further feedback shares with the tool."""
    tool, feedback = scene.tool, scene.feedback
    of_tool = 0 if tool.stiffness else 1 if tool.damping else 2
    if isinstance(scene.device, zwidth.LinearDevice):
        return 0
    if feedback is None:
        return min(of_tool, 1 if scene.device.damping else 2)
    # Feedback of a velocity leaves the position undetermined; other feedback acts as a spring or an integrator.
    is_velocity = isinstance(feedback, zwidth.Feedback) and abs(sum(feedback.numerator)) < 1e-12
    return min(of_tool, int(is_velocity))


def draw_coupling(rng: np.random.Generator) -> Any:
    """Return a random scene with a tool and a position estimate or further feedback."""
    scene = draw_scene(rng)
    T, mass = scene.timing.period, scene.mass * 10 ** rng.uniform(-1, 1)
    damping = rng.choice([0.0, rng.uniform(0.001, 0.1)]) * mass / T
    stiffness = rng.choice([0.0, rng.uniform(1e-5, 1e-3)]) * mass / T**2
    integrator: Any = ["semi-implicit", "implicit"][rng.integers(2)]
    tool = zwidth.Tool(mass, damping, stiffness, integrator)
    return scene.replace(tool=tool)
