"""Test motions with actuators and modes.

Reference: Newton's laws in SI units and absolute coordinates, integrated by matrix exponentials.
"""

from __future__ import annotations

from typing import Any

import any_loop
import numpy as np
import pytest
import scipy.linalg

import zwidth

# Integration steps per period; events between two steps are located by bisection.
STEPS, PERIODS = 64, 150
# One delay and one number of substeps, because a program is compiled for each set of parts, with and without friction.
TIMING, SUBSTEPS = zwidth.Timing(1e-3, 1.4e-3), 4


class NewtonIntegrator:
    """Bodies in SI units: positions and velocities, then modes and actuator; forces of command and operator."""

    def __init__(self, scene: zwidth.Scene, coulomb: float, static: float) -> None:
        table, self.size, self.sensor = any_loop.rate_table(scene)
        self.matrix, self.bodies = np.array(table)[:-1, :-1], len(any_loop._masses_and_links(scene)[0])
        self.command = np.array(table)[:-1, -1]
        self.mass, self.coulomb, self.static = scene.device.mass, coulomb, static
        self.direct = np.eye(self.size)[self.bodies] / self.mass
        self.flows: dict[Any, np.ndarray] = {}

    def flow(self, sticks: bool, span: float) -> np.ndarray:
        """Return the matrix that maps (state, command, force on the first body) over a time span."""
        if (sticks, span) not in self.flows:
            block = np.zeros((self.size + 2, self.size + 2))
            block[: self.size] = np.column_stack([self.matrix, self.command, self.direct])
            if sticks:
                block[[0, self.bodies]] = 0.0
            self.flows[sticks, span] = scipy.linalg.expm(block * span)[: self.size]
        return self.flows[sticks, span]

    def compute_net_force(self, x: np.ndarray, u: float, f: float) -> float:
        """Return the force on the first body without its friction."""
        v = self.bodies
        return self.mass * float(self.matrix[v] @ x + self.command[v] * u + self.direct[v] * f)

    def move(self, x: np.ndarray, slip: float, u: float, f: float, span: float) -> tuple[np.ndarray, float]:
        v = self.bodies
        if self.static and (slip == 0 or x[v] == 0):
            other = self.compute_net_force(x, u, f)
            slip = 0.0 if abs(other) <= self.static else np.sign(other)

        def event_occurs(y: np.ndarray) -> bool:
            if not self.static:
                return False
            return abs(self.compute_net_force(y, u, f)) > self.static if slip == 0 else slip * y[v] < 0

        def evaluate_state(time: float) -> np.ndarray:
            return self.flow(slip == 0 and self.static > 0, time) @ [*x, u, f - slip * self.coulomb]

        y = evaluate_state(span)
        if not event_occurs(y):
            return y, slip
        low, high = 0.0, span
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if event_occurs(evaluate_state(middle)) else (middle, high)
        self.flows = {key: value for key, value in self.flows.items() if key[1] == span}
        y = evaluate_state(high)
        if slip:
            y[v], slip = 0.0, 0.0
            return self.move(y, slip, u, f, span - high)
        # Released from friction, the body moves on.
        slip = float(np.sign(self.compute_net_force(y, u, f)))
        return self.flow(False, span - high) @ [*y, u, f - slip * self.coulomb], slip


def integrate_motion(
    scene: Any, K: float, B: float, start: float, push: float, friction: tuple[float, float], quantum: float
):
    """Return the sensed position and that of the first body at the samples, for unilateral contact."""
    integrator = NewtonIntegrator(scene, *friction)
    x, v0 = np.zeros(integrator.size), 0.1
    x[: integrator.bodies], x[integrator.bodies : 2 * integrator.bodies] = start, v0
    T, n_delay, fraction = scene.timing.period, scene.integer_delay, scene.d - scene.integer_delay
    slip, commands, last = np.sign(v0), [0.0] * (n_delay + 2), start - v0 * T
    read = (lambda y: quantum * np.floor(y / quantum + 0.5)) if quantum else (lambda y: y)
    last, positions = read(last), []
    for _ in range(PERIODS):
        sensed = float(integrator.sensor @ x)
        positions.append((sensed, x[0]))
        measured = read(sensed)
        wall = -(K * measured + B * (measured - last) / T) if measured > 0 else 0.0
        last = measured
        commands.append(wall)
        pieces = [(commands[-2 - n_delay], fraction), (commands[-1 - n_delay], 1.0 - fraction)]
        for u, share in pieces:
            for _ in range(STEPS if share else 0):
                x, slip = integrator.move(x, slip, u, push, share * T / STEPS)
    return np.array(positions).T


CASES = {
    "first order": {"actuator": zwidth.Actuator(150.0)},
    "second order, two modes": {
        "actuator": zwidth.Actuator(time_constant=1e-3, order=2, damping_ratio=0.5),
        "modes": [zwidth.Mode(90.0, 0.03, 0.6), zwidth.Mode(210.0, 0.02, -2.0)],
    },
    "mode": {"modes": zwidth.Mode(60.0, 0.05, 0.4)},
    "tip sensed": {"actuator": zwidth.Actuator(200.0), "coupling": zwidth.Coupling(0.05, 2e4, 1.0, "tip")},
}


@pytest.mark.parametrize("friction", [(0.0, 0.0), (0.05, 0.08)], ids=["without friction", "with friction"])
@pytest.mark.parametrize("parts", CASES.values(), ids=CASES.keys())
def test_motion_matches_newtons_laws(parts, friction):
    device = zwidth.Device(0.1, 1.0, **parts)
    hand = zwidth.Operator(0.05, 0.5, 30.0)
    scene = zwidth.Scene(device, TIMING, operator=hand)
    K, B = 0.3 * float(scene.max_stiffness().stiffness), 0.3
    if "coupling" not in parts:
        # A rigidly coupled operator is part of the first body; the reference applies friction to the mass of the
        # device.
        scene = scene.replace(operator=None, mass=0.15, damping=1.5)
    motion = scene.simulate(
        K, B, periods=PERIODS, start_position=-1e-3, start_velocity=0.1, external_force=0.02, contact="unilateral",
        coulomb=friction[0], static=friction[1], substeps=SUBSTEPS,
    )  # fmt: skip
    sensed, first = integrate_motion(scene, K, B, -1e-3, 0.02, friction, 0.0)
    size = np.abs(first).max()
    assert np.abs(np.asarray(motion.position)[::SUBSTEPS] - first).max() < 1e-6 * size
    assert np.abs(np.asarray(motion.measured) - sensed).max() < 1e-6 * size
    assert int(motion.bounces) > 0


@pytest.mark.parametrize("parts", CASES.values(), ids=CASES.keys())
def test_external_work_and_losses(parts):
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0, **parts), TIMING)
    motion = scene.simulate(500.0, 1.0, periods=100, start_position=1e-3, external_force=0.5, substeps=SUBSTEPS)
    # The work of the external force follows from the displacement; the damper to ground only dissipates energy.
    displacement = np.asarray(motion.position) - 1e-3
    np.testing.assert_allclose(np.asarray(motion.external_work), 0.5 * displacement, atol=1e-9 * 0.5e-3)
    assert np.all(np.diff(np.asarray(motion.damping_loss, float)) > -1e-15)


def test_wall_work_with_actuator_lag_is_that_of_the_acting_force():
    # Reference: the actuator force from its own equation, integrated over the motion.
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0, actuator=zwidth.Actuator(150.0)), zwidth.Timing(1e-3))
    substeps = 256
    motion = scene.simulate(800.0, 2.0, periods=60, start_position=1e-3, substeps=substeps)
    w, step = 2 * np.pi * 150.0, 1e-3 / substeps
    command, force = np.asarray(motion.wall_force), [0.0]
    for u in command[:-1]:
        force.append(u + (force[-1] - u) * np.exp(-w * step))
    work = np.cumsum(0.5 * (np.array(force)[1:] + force[:-1]) * np.diff(np.asarray(motion.position, float)))
    simulated_work = np.asarray(motion.wall_work)[1:]
    assert np.abs(simulated_work - work).max() < 1e-4 * np.abs(simulated_work).max()


@pytest.mark.parametrize("parts", CASES.values(), ids=CASES.keys())
def test_outcomes_match_the_verdicts(parts):
    # One case has an integer delay, because integer delays use a separate program.
    timing = zwidth.Timing(1e-3, 1e-3) if {"actuator", "modes"} <= parts.keys() else TIMING
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0, **parts), timing)
    top = scene.max_stiffness()
    walls = [(share * float(top.stiffness), float(top.virtual_damping)) for share in (0.6, 1.2)]
    outcomes = [
        zwidth.MotionKind(scene.simulate(*wall, start_position=1e-3, substeps=SUBSTEPS).outcome).name for wall in walls
    ]
    assert outcomes[0] in ("REST", "DECAYING")
    assert outcomes[1] in ("GROWING", "DIVERGED")
