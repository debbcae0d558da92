"""Random admittance displays, and a composed state space as their reference.

The state space contains the program step by step, the commands on their way, and the robot, which is integrated by the
matrix exponential of scipy.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg, signal

import zwidth

PROGRAMS = [(command, method) for command in ("position", "velocity") for method in ("semi-implicit", "trapezoidal")]


def make_display(rng):
    """Return a random display and the state-space model of its robot from command to position."""
    period = 10.0 ** rng.uniform(-3.3, -2)
    tau = period * 10.0 ** rng.uniform(0.0, 1.5)
    zeta = rng.uniform(0.3, 1.2)
    kind = rng.integers(3)
    if kind == 2:
        # A robot with a zero: 1/tau^2 (1 + tau s/2)/(s^2 + 2 zeta s/tau + 1/tau^2).
        poly = [0.5 / tau, 1 / tau**2], [1, 2 * zeta / tau, 1 / tau**2]
        robot = zwidth.LinearDevice(poly)
    elif kind == 1:
        poly = [1 / tau**2], [1, 2 * zeta / tau, 1 / tau**2]
        robot = zwidth.Actuator(time_constant=tau, order=2, damping_ratio=zeta)
    else:
        poly, robot = ([1 / tau], [1, 1 / tau]), zwidth.Actuator(time_constant=tau)
    command, method = PROGRAMS[rng.integers(4)]
    delay = float(rng.choice([float(rng.integers(5)), rng.uniform(0, 4)]))
    mass = 10.0 ** rng.uniform(-0.5, 1.5)
    # The damper of the program is explicit, so D T/M must be below 2.
    damping = mass / period * 10.0 ** rng.uniform(-3, -0.5)
    timing = zwidth.Timing(period, f"{delay!r} periods")
    display = zwidth.AdmittanceDisplay(mass, damping, robot, timing, command, method)
    A, B, C, _ = signal.tf2ss(poly[0], np.append(poly[1], 0.0) if command == "velocity" else poly[1])
    return display, (A, B, C)


def make_step(display, robot, stiffness, damper):
    """Return a function that advances the state by one period, under an external force on the sensor.

    The states are those of the robot, the last commands, and v, a and x_ref. The function also returns the position,
    the velocity, the contact force and the command at the sample.
    """
    A, B, C = robot
    T, M, D = (float(each) for each in (display.timing.period, display.virtual_mass, display.virtual_damping))
    n = int(np.floor(display.timing.d))
    f = float(display.timing.d) - n
    size, lag = len(A), n + 1

    def move(time):
        """Return e^(A t) and the integral of e^(A s) B for s from 0 to t."""
        block = linalg.expm(np.block([[A, B], [np.zeros((1, size + 1))]]) * time)
        return block[:size, :size], block[:size, size:]

    (phi1, gamma1), (phi2, gamma2) = move(f * T), move((1 - f) * T)

    def step(state, external=0.0):
        x, (commands, (v, a, reference)) = state[:size], np.split(state[size:], [lag])
        position = (C @ x).item()
        # The command before the sample is the oldest stored one, u_(k-n-1).
        velocity = (C @ (A @ x + B[:, 0] * commands[-1])).item()
        force = external - stiffness * position - damper * velocity
        if display.integrator == "trapezoidal":
            new_a = (force - D * v) / M
            new_v = v + T * (new_a + a) / 2
            new_reference = reference + T * (new_v + v) / 2
        else:
            new_a = (force - D * v) / M
            new_v = v + T * new_a
            new_reference = reference + T * new_v
        sent = np.append(new_v if display.command == "velocity" else new_reference, commands)
        x = phi2 @ (phi1 @ x + gamma1[:, 0] * sent[n + 1]) + gamma2[:, 0] * sent[n]
        return np.concatenate([x, sent[:lag], [new_v, new_a, new_reference]]), (position, velocity, force, sent[0])

    return step, size + lag + 3


def compose(display, robot, stiffness, damper):
    """Return the matrix of one period."""
    step, size = make_step(display, robot, stiffness, damper)
    matrix = np.array([step(unit)[0] for unit in np.eye(size)]).T
    if display.command == "velocity":
        # The program does not integrate the position.
        matrix = matrix[:-1, :-1]
    return matrix


def find_radius(*given):
    return np.abs(np.linalg.eigvals(compose(*given))).max()
