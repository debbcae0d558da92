"""Motions behind an actuator and with modes, against Newton's laws in SI units and absolute coordinates."""

from __future__ import annotations

from typing import Any

import any_loop
import numpy as np
import pytest
import scipy.linalg

import zwidth

# Steps a period, between which an event is placed by bisection.
STEPS, PERIODS = 64, 150
# One delay and one number of substeps for all: a program is compiled for each kind of parts, and one with friction.
TIMING, SUBSTEPS = zwidth.Timing(1e-3, 1.4e-3), 4


class Judge:
    """The bodies in SI units: positions and velocities, then modes and actuator; forces of command and of a hand."""

    def __init__(self, scene: zwidth.Scene, coulomb: float, static: float) -> None:
        table, self.size, self.seen = any_loop.rate_table(scene)
        self.matrix, self.bodies = np.array(table)[:-1, :-1], len(any_loop._masses_and_links(scene)[0])
        self.command = np.array(table)[:-1, -1]
        self.mass, self.coulomb, self.static = scene.device.mass, coulomb, static
        self.direct = np.eye(self.size)[self.bodies] / self.mass
        self.known: dict[Any, np.ndarray] = {}

    def flow(self, held: bool, span: float) -> np.ndarray:
        """What a span does to (state, command, force on the first body)."""
        if (held, span) not in self.known:
            block = np.zeros((self.size + 2, self.size + 2))
            block[: self.size] = np.column_stack([self.matrix, self.command, self.direct])
            if held:
                block[[0, self.bodies]] = 0.0
            self.known[held, span] = scipy.linalg.expm(block * span)[: self.size]
        return self.known[held, span]

    def pressed(self, x: np.ndarray, u: float, f: float) -> float:
        """The force on the first body without its friction."""
        v = self.bodies
        return self.mass * float(self.matrix[v] @ x + self.command[v] * u + self.direct[v] * f)

    def move(self, x: np.ndarray, slip: float, u: float, f: float, span: float) -> tuple[np.ndarray, float]:
        v = self.bodies
        if self.static and (slip == 0 or x[v] == 0):
            other = self.pressed(x, u, f)
            slip = 0.0 if abs(other) <= self.static else np.sign(other)

        def happened(y: np.ndarray) -> bool:
            if not self.static:
                return False
            return abs(self.pressed(y, u, f)) > self.static if slip == 0 else slip * y[v] < 0

        def after(time: float) -> np.ndarray:
            return self.flow(slip == 0 and self.static > 0, time) @ [*x, u, f - slip * self.coulomb]

        y = after(span)
        if not happened(y):
            return y, slip
        low, high = 0.0, span
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if happened(after(middle)) else (middle, high)
        self.known = {key: value for key, value in self.known.items() if key[1] == span}
        y = after(high)
        if slip:
            y[v], slip = 0.0, 0.0
            return self.move(y, slip, u, f, span - high)
        # Let go, it leaves.
        slip = float(np.sign(self.pressed(y, u, f)))
        return self.flow(False, span - high) @ [*y, u, f - slip * self.coulomb], slip


def judge(scene: Any, K: float, B: float, start: float, push: float, friction: tuple[float, float], quantum: float):
    """Sensed positions and those of the first body at the samples, one-sided contact."""
    judged = Judge(scene, *friction)
    x, v0 = np.zeros(judged.size), 0.1
    x[: judged.bodies], x[judged.bodies : 2 * judged.bodies] = start, v0
    T, late, part = scene.timing.period, scene.integer_delay, scene.d - scene.integer_delay
    slip, commands, last = np.sign(v0), [0.0] * (late + 2), start - v0 * T
    read = (lambda y: quantum * np.floor(y / quantum + 0.5)) if quantum else (lambda y: y)
    last, found = read(last), []
    for _ in range(PERIODS):
        sensed = float(judged.seen @ x)
        found.append((sensed, x[0]))
        measured = read(sensed)
        wall = -(K * measured + B * (measured - last) / T) if measured > 0 else 0.0
        last = measured
        commands.append(wall)
        pieces = [(commands[-2 - late], part), (commands[-1 - late], 1.0 - part)]
        for u, share in pieces:
            for _ in range(STEPS if share else 0):
                x, slip = judged.move(x, slip, u, push, share * T / STEPS)
    return np.array(found).T


CASES = {
    "first order": {"actuator": zwidth.Actuator(150.0)},
    "second order, two modes": {
        "actuator": zwidth.Actuator(time_constant=1e-3, order=2, damping_ratio=0.5),
        "modes": [zwidth.Mode(90.0, 0.03, 0.6), zwidth.Mode(210.0, 0.02, -2.0)],
    },
    "a mode": {"modes": zwidth.Mode(60.0, 0.05, 0.4)},
    "tip sensed": {"actuator": zwidth.Actuator(200.0), "coupling": zwidth.Coupling(0.05, 2e4, 1.0, "tip")},
}


@pytest.mark.parametrize("friction", [(0.0, 0.0), (0.05, 0.08)], ids=["smooth", "dry"])
@pytest.mark.parametrize("parts", CASES.values(), ids=CASES.keys())
def test_motions_are_those_of_newtons_laws(parts, friction):
    device = zwidth.Device(0.1, 1.0, **parts)
    hand = zwidth.Operator(0.05, 0.5, 30.0)
    scene = zwidth.Scene(device, TIMING, operator=hand)
    K, B = 0.3 * float(scene.max_stiffness().stiffness), 0.3
    if "coupling" not in parts:
        # The hand is part of the first body, whose mass friction meets.
        scene = scene.replace(operator=None, mass=0.15, damping=1.5)
    motion = scene.simulate(
        K, B, periods=PERIODS, start_position=-1e-3, start_velocity=0.1, external_force=0.02, contact="unilateral",
        coulomb=friction[0], static=friction[1], substeps=SUBSTEPS,
    )  # fmt: skip
    sensed, first = judge(scene, K, B, -1e-3, 0.02, friction, 0.0)
    size = np.abs(first).max()
    assert np.abs(np.asarray(motion.position)[::SUBSTEPS] - first).max() < 1e-6 * size
    assert np.abs(np.asarray(motion.measured) - sensed).max() < 1e-6 * size
    assert int(motion.bounces) > 0


@pytest.mark.parametrize("parts", CASES.values(), ids=CASES.keys())
def test_energy_is_that_of_wall_and_push_less_losses(parts):
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0, **parts), TIMING)
    motion = scene.simulate(500.0, 1.0, periods=100, start_position=1e-3, external_force=0.5, substeps=SUBSTEPS)
    # The work of the push by its way, of the damper to ground by its speed; the rest is the wall's and the links'.
    way = np.asarray(motion.position) - 1e-3
    np.testing.assert_allclose(np.asarray(motion.external_work), 0.5 * way, atol=1e-9 * 0.5e-3)
    assert np.all(np.diff(np.asarray(motion.damping_loss, float)) > -1e-15)


def test_the_wall_work_of_a_lag_is_that_of_the_force_that_acts():
    # The actuator's force by its own equation, over the motion's way.
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0, actuator=zwidth.Actuator(150.0)), zwidth.Timing(1e-3))
    substeps = 256
    motion = scene.simulate(800.0, 2.0, periods=60, start_position=1e-3, substeps=substeps)
    w, step = 2 * np.pi * 150.0, 1e-3 / substeps
    command, force = np.asarray(motion.wall_force), [0.0]
    for u in command[:-1]:
        force.append(u + (force[-1] - u) * np.exp(-w * step))
    work = np.cumsum(0.5 * (np.array(force)[1:] + force[:-1]) * np.diff(np.asarray(motion.position, float)))
    found = np.asarray(motion.wall_work)[1:]
    assert np.abs(found - work).max() < 1e-4 * np.abs(found).max()


@pytest.mark.parametrize("parts", CASES.values(), ids=CASES.keys())
def test_outcomes_are_those_of_the_labels(parts):
    # One of them with a delay of whole periods, of which a force acts throughout: a program of its own.
    timing = zwidth.Timing(1e-3, 1e-3) if {"actuator", "modes"} <= parts.keys() else TIMING
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0, **parts), timing)
    top = scene.max_stiffness()
    walls = [(share * float(top.stiffness), float(top.virtual_damping)) for share in (0.6, 1.2)]
    outcomes = [
        zwidth.MotionKind(scene.simulate(*wall, start_position=1e-3, substeps=SUBSTEPS).outcome).name for wall in walls
    ]
    assert outcomes[0] in ("REST", "DECAYING")
    assert outcomes[1] in ("GROWING", "DIVERGED")
