"""Random scenes of every kind, and their closed loop by other means: absolute coordinates, a dense matrix exponential,
filters by their coefficients, every force on its way as a state of its own."""

from typing import Any

import numpy as np
import scipy.linalg
import scipy.signal

import zwidth

KINDS = ("rigid", "filter", "tip", "motor", "hand", "coupled hand", "all")


def random_velocity(rng, period):
    """One of the velocity estimates."""
    kind = rng.integers(0, 6)
    if kind == 1:
        return zwidth.WindowedDifference(int(rng.integers(2, 15)))
    if kind == 2:
        return zwidth.LowPass(cutoff=10 ** rng.uniform(-2.5, -0.4) / period)
    if kind == 3:
        return zwidth.LowPass(time_constant=period * 10 ** rng.uniform(-0.5, 1.5), order=2)
    if kind == 4:
        return zwidth.Butterworth(10 ** rng.uniform(-1.8, -0.4) / period, int(rng.integers(1, 5)))
    if kind == 5:
        return zwidth.VelocityFilter(np.convolve([1, -1], [1, 0.3]) / period / 1.3, [1, -0.2, 0])
    return zwidth.BackwardDifference()


def random_scene(kind, rng):
    """A scene; its stable walls lie within some units of alpha and beta."""
    mass, period = 10 ** rng.uniform(-1.5, 0.5), 10 ** rng.uniform(-4, -2.5)
    damping = rng.choice([0.0, 10 ** rng.uniform(-1, 1.5)])
    coupling = operator = None
    if kind in ("tip", "motor", "all"):
        at_tip = kind == "tip" or (kind == "all" and rng.random() < 0.5)
        coupling = zwidth.Coupling(
            mass * 10 ** rng.uniform(-1, 0.5),
            mass / period**2 * 10 ** rng.uniform(-3, 0.5),
            mass / period * 10 ** rng.uniform(-3, -0.5),
            "tip" if at_tip else "motor",
        )
    hand = mass * 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(1, 3)
    if kind == "hand" or (kind == "all" and rng.random() < 0.5):
        operator = zwidth.Operator(*hand)
    elif kind in ("coupled hand", "all"):
        tie = {"coupling_stiffness": 10 ** rng.uniform(2, 4), "coupling_damping": 10 ** rng.uniform(-1, 1)}
        operator = zwidth.Operator(*hand, **tie)
    velocity = random_velocity(rng, period) if kind in ("filter", "all") else zwidth.BackwardDifference()
    delay = rng.choice([0, 1, 2, 0.3, 1.6, 3]) * period
    return zwidth.Scene(
        zwidth.Device(mass, damping, coupling), zwidth.Timing(period, delay), velocity=velocity, operator=operator
    )


def random_walls(scene, rng, count):
    """Stiffness and virtual damping of walls around the stable ones."""
    units = scene.units
    K = 10 ** rng.uniform(-4, 0.5, count) * units.stiffness
    B = rng.uniform(-0.2, 1, count) * 10 ** rng.uniform(-1.5, 0, count) * units.virtual_damping
    return K, B


def continuous(scene):
    """State, input and sensor of the chain of masses in continuous time."""
    device, hand = scene.device, scene.operator
    bodies, ties = [[device.mass, device.damping, 0.0]], []
    if device.coupling:
        bodies.append([device.coupling.mass, 0.0, 0.0])
        ties.append((device.coupling.stiffness, device.coupling.damping))
    if hand is not None and hand.rigid:
        bodies[-1] = [a + b for a, b in zip(bodies[-1], (hand.mass, hand.damping, hand.stiffness), strict=True)]
    elif hand is not None:
        bodies.append([hand.mass, hand.damping, hand.stiffness])
        ties.append((hand.coupling_stiffness, hand.coupling_damping))
    size = len(bodies)
    mass, damping, stiffness = (np.diag([float(body[k]) for body in bodies]) for k in range(3))
    for k, pair in enumerate(ties):
        for matrix, value in zip((stiffness, damping), pair, strict=True):
            matrix[k : k + 2, k : k + 2] += value * np.array([[1.0, -1.0], [-1.0, 1.0]])
    a = np.block(
        [[np.zeros((size, size)), np.eye(size)], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)]]
    )
    b = np.zeros(2 * size)
    b[size] = 1.0 / bodies[0][0]
    sensor = np.zeros(2 * size)
    sensor[1 if device.coupling and device.coupling.sensor == "tip" else 0] = 1.0
    return a, b, sensor


def flow(a, b, time):
    """Transition over a time, and the state that a unit force reaches."""
    size = len(b)
    block = np.zeros((size + 1, size + 1))
    block[:size, :size], block[:size, size] = a * time, b * time
    block = scipy.linalg.expm(block)
    return block[:size, :size], block[:size, size]


def velocity_polynomials(scene):
    """Numerator and denominator of F in SI units, highest power first."""
    period: Any = scene.timing.period
    v: Any = scene.velocity
    top, bottom = np.array([1.0, -1.0]) / period, np.array([1.0, 0.0])
    if isinstance(v, zwidth.WindowedDifference):
        n = v.samples
        return np.concatenate([[1.0], np.zeros(n - 1), [-1.0]]) / (n * period), np.append(1.0, np.zeros(n))
    if isinstance(v, zwidth.LowPass):
        p = np.exp(-period / v.time_constant) if v.cutoff is None else np.exp(-2 * np.pi * v.cutoff * period)
        for _ in range(v.order):
            top, bottom = np.convolve(top, [1 - p, 0.0]), np.convolve(bottom, [1.0, -p])
    if isinstance(v, zwidth.Butterworth):
        designed: Any = scipy.signal.butter(v.order, 2 * period * float(v.cutoff or 0.0))
        top, bottom = np.convolve(top, designed[0]), np.convolve(bottom, designed[1])
    if isinstance(v, zwidth.VelocityFilter):
        return np.array(v.numerator), np.array(v.denominator)
    return top, bottom


def closed_loop_matrix(scene, stiffness, damping):
    """One period of the closed loop."""
    a, b, sensor = continuous(scene)
    period, whole = scene.timing.period, scene.whole_delay
    part = scene.d - whole
    step, _ = flow(a, b, period)
    rest, newer = flow(a, b, (1 - part) * period)
    older = rest @ flow(a, b, part * period)[1]
    top, bottom = velocity_polynomials(scene)
    order, size = len(bottom) - 1, len(b)
    top = np.concatenate([np.zeros(len(bottom) - len(top)), top]) / bottom[0]
    bottom = bottom / bottom[0]
    waiting = whole + (part > 0)
    total = size + order + waiting
    matrix, force = np.zeros((total, total)), np.zeros(total)
    force[:size] = -(stiffness + damping * top[0]) * sensor
    force[size : size + order] = -damping * (top[1:] - top[0] * bottom[1:])

    def delayed(periods):
        return force if periods == 0 else np.eye(total)[size + order + periods - 1]

    matrix[:size, :size] = step
    matrix[:size] += np.outer(newer, delayed(whole))
    if part > 0:
        matrix[:size] += np.outer(older, delayed(whole + 1))
    if order:
        matrix[size, size : size + order] = -bottom[1:]
        matrix[size + 1 : size + order, size : size + order - 1] = np.eye(order - 1)
        matrix[size, :size] += sensor
    for k in range(waiting):
        matrix[size + order + k] = delayed(k)
    return matrix
