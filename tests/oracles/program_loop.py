"""Closed loops of control programs as matrices, from the programs' statements: independent of the transfer functions.

`step_matrix` applies one period of a loop, plant and program, to each unit vector of its state. The program consists of
assignments as in firmware; the plant is propagated by matrix exponentials.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.signal import butter

import zwidth


class Filter:
    """Direct form I of a transfer function in z: y = (b x)/(a y)."""

    def __init__(self, b: Any, a: Any) -> None:
        self.b, self.a = np.atleast_1d(b).astype(float), np.atleast_1d(a).astype(float)
        self.b = np.concatenate([np.zeros(self.a.size - self.b.size), self.b])
        self.size = self.a.size - 1

    def step(self, state: Any, x: Any) -> tuple[Any, Any]:
        """Return the next state and the output (transposed direct form II)."""
        b, a = self.b / self.a[0], self.a / self.a[0]
        y = b[0] * x + (state[0] if self.size else 0.0)
        later = np.append(state[1:], 0.0) + b[1:] * x - a[1:] * y if self.size else state
        return later, y


class Pll:
    """The statements of the PLL of a motor controller."""

    size = 2

    def __init__(self, bandwidth: float, T: float) -> None:
        self.kp, self.T = 2 * bandwidth, T
        self.ki = self.kp**2 / 4

    def step(self, state: Any, x: Any) -> tuple[Any, tuple[Any, Any]]:
        """Return the next state, and position and velocity."""
        p, v = state
        p = p + self.T * v
        error = x - p
        p = p + self.T * self.kp * error
        v = v + self.T * self.ki * error
        return np.array([p, v]), (p, v)


def find_filter(part: Any, T: float) -> Filter:
    """Return the filter of a position part, or of a velocity estimate without the difference."""
    if isinstance(part, zwidth.ExponentialFilter):
        a = part.coefficient
        if part.time_constant is not None:
            a = 1 - np.exp(-T / part.time_constant)
        elif part.cutoff is not None:
            a = 1 - np.exp(-T * 2 * np.pi * part.cutoff)
        return Filter([a, 0], [1, a - 1])
    if isinstance(part, zwidth.LowPass):
        p = np.exp(-2 * np.pi * part.cutoff * T)
        b, a = np.array([1 - p, 0.0]), np.array([1, -p])
        for _ in range(part.order - 1):
            b, a = np.convolve(b, [1 - p, 0.0]), np.convolve(a, [1, -p])
        return Filter(b, a)
    if isinstance(part, zwidth.Butterworth):
        return Filter(*butter(part.order, part.cutoff, fs=1 / T))
    return Filter(part.numerator, part.denominator)


def find_difference(velocity: Any, T: float) -> Filter:
    """Return a velocity estimate as a filter."""
    if isinstance(velocity, zwidth.VelocityFilter):
        return Filter(velocity.numerator, velocity.denominator)
    n = velocity.samples if isinstance(velocity, zwidth.WindowedDifference) else 1
    b = np.zeros(n + 1)
    b[0], b[-1] = 1 / (n * T), -1 / (n * T)
    difference = Filter(b, [1, *[0] * n])
    if isinstance(velocity, zwidth.BackwardDifference | zwidth.WindowedDifference):
        return difference
    low = find_filter(velocity, T)
    return Filter(np.convolve(difference.b, low.b), np.convolve(difference.a, low.a))


class Program:
    """The program of a scene with a wall: from the sampled position to the force."""

    def __init__(self, scene: Any, K: float, B: float) -> None:
        T, self.K, self.B = scene.timing.period, K, B
        position, feedback = scene.position, scene.feedback
        self.parts: dict[str, Any] = {}
        self.source = getattr(position, "velocity_from", "position")
        if isinstance(position, zwidth.Pll):
            self.parts["pll"] = Pll(position.bandwidth, T)
        elif isinstance(position, zwidth.Observer):
            self.parts["p"] = Filter(position.position, position.denominator)
            self.observer = position
        elif position is not None:
            self.parts["p"] = find_filter(position, T)
        if not isinstance(position, zwidth.Pll | zwidth.Observer):
            self.parts["v"] = find_difference(scene.velocity, T)
        self.weights = None
        if feedback is not None:
            given = feedback.position, feedback.velocity
            self.weights = (1.0, 0.0, 0.0) if given == (None, None) else (0.0, given[0] or 0.0, given[1] or 0.0)
            if isinstance(feedback, zwidth.IntegralFeedback):
                b = {"backward": [1, 0], "forward": [0, 1], "trapezoidal": [0.5, 0.5]}[feedback.rule]
                self.parts["r"] = Filter(feedback.gain * T * np.array(b), [1, -1])
            else:
                self.parts["r"] = Filter(feedback.numerator, feedback.denominator)
        self.size = sum(part.size for part in self.parts.values())

    def step(self, state: Any, y: Any) -> tuple[Any, Any]:
        """Return the next state, and the force."""
        states: dict[str, Any] = {}
        start = 0
        for name, part in self.parts.items():
            states[name] = state[start : start + part.size]
            start += part.size
        p = y
        if "pll" in states:
            states["pll"], (p, v) = self.parts["pll"].step(states["pll"], y)
        elif "v" not in states:
            # One state vector for both outputs of the observer: w = x/D, then p = N_p w and v = N_v w.
            w, a = states["p"], self.parts["p"].a
            new = (y - a[1:] @ w) / a[0]
            history = np.concatenate([[new], w])
            p, v = (
                np.concatenate([np.zeros(a.size - len(b)), b]) @ history
                for b in (self.observer.position, self.observer.velocity)
            )
            states["p"] = history[:-1]
        else:
            if "p" in states:
                states["p"], p = self.parts["p"].step(states["p"], y)
            states["v"], v = self.parts["v"].step(states["v"], y if self.source == "measured" else p)
        force = -self.K * p - self.B * v
        if self.weights is not None:
            states["r"], r = self.parts["r"].step(states["r"], np.dot(self.weights, (y, p, v)))
            force -= r
        return np.concatenate([states[name] for name in self.parts]) if self.parts else state, force


def find_plant(scene: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B and C of the device, in SI units."""
    device: Any = scene.device
    if isinstance(scene.device, zwidth.Device) and device.coupling is None:
        return np.array([[0, 1], [0, -device.damping / device.mass]]), np.array([0, 1 / device.mass]), np.array([1, 0])
    if isinstance(scene.device, zwidth.Device):
        tip, m, b = device.coupling, device.mass, device.damping
        k, c, m2 = tip.stiffness, tip.damping, tip.mass
        rows = [-k / m, k / m, -(b + c) / m, c / m], [k / m2, -k / m2, c / m2, -c / m2]
        A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], *rows])
        return A, np.array([0, 0, 1 / m, 0]), np.array([0, 1, 0, 0] if tip.sensor == "tip" else [1, 0, 0, 0])
    poles, zeros = np.atleast_1d(np.poly(device.poles)).real, np.atleast_1d(np.poly(device.zeros)).real * device.gain
    n = poles.size - 1
    A = np.eye(n, k=1)
    A[-1] = -poles[:0:-1]
    return A, np.eye(n)[-1], np.pad(zeros[::-1], (0, n - zeros.size))


def step_matrix(scene: Any, K: float, B: float) -> np.ndarray:
    """Return the matrix of one period of the closed loop with a wall."""
    return close_loop(scene, Program(scene, K, B))


def close_loop(scene: Any, program: Any) -> np.ndarray:
    """Return the matrix of one period of the device and the delay of a scene in a loop with a program.

    The attribute ``size`` of the program is its number of states; its method ``step`` maps the states and the measured
    position to the new states and the force.
    """
    T, d = scene.timing.period, scene.d
    n, f = int(np.floor(d)), d - np.floor(d)
    A, b, C = find_plant(scene)
    size = len(b)
    block = np.zeros((size + 1, size + 1))
    block[:size, :size], block[:size, size] = A, b
    first, last = expm(block * f * T), expm(block * (1 - f) * T)
    total = size + n + 1 + program.size
    columns = []
    for unit in np.eye(total):
        x, queue, state = unit[:size], unit[size : size + n + 1], unit[size + n + 1 :]
        state, force = program.step(state, C @ x)
        forces = np.concatenate([[force], queue])  # forces[i] is the command i periods ago
        x = first[:size, :size] @ x + first[:size, size] * forces[n + 1]
        x = last[:size, :size] @ x + last[:size, size] * forces[n]
        columns.append(np.concatenate([x, forces[: n + 1], state]))
    return np.array(columns).T


def find_radius(scene: Any, K: float, B: float) -> float:
    """Return the spectral radius of the closed loop with a wall."""
    return float(np.abs(np.linalg.eigvals(step_matrix(scene, K, B))).max())


def draw_scene(rng: np.random.Generator) -> Any:
    """Return a random scene with a position estimate or further feedback."""
    T = 10 ** rng.uniform(-4, -2.7)
    m = 10 ** rng.uniform(-2, 0.5)
    b = rng.choice([0.0, rng.uniform(0.001, 0.3)]) * m / T
    unit = m / T**2
    kind = rng.integers(4)
    if kind == 0:
        coupling = zwidth.Coupling(
            mass=m * rng.uniform(0.1, 1), stiffness=unit * rng.uniform(0.02, 1), damping=m / T * rng.uniform(0.01, 0.1),
            sensor=rng.choice(["motor", "tip"]).item(),
        )  # fmt: skip
        device: Any = zwidth.Device(m, b, coupling=coupling)
    elif kind == 1:
        w, zeta = rng.uniform(0.05, 1) / T, rng.uniform(0.05, 0.8)
        device = zwidth.LinearDevice(([1 / m], [1, 2 * zeta * w, w * w]))
    else:
        device = zwidth.Device(m, b)
    d = rng.choice([0.0, 1.0, 2.0, rng.uniform(0, 4)])
    timing = zwidth.Timing(T, delay=f"{d} periods")
    velocity = [
        zwidth.BackwardDifference(),
        zwidth.WindowedDifference(int(rng.integers(1, 5))),
        zwidth.LowPass(cutoff=rng.uniform(0.01, 0.4) / T, order=int(rng.integers(1, 3))),
    ][rng.integers(3)]
    source = rng.choice(["position", "position", "measured"]).item()
    g, h = rng.uniform(0.2, 1), rng.uniform(0.005, 0.1)
    position: Any = [
        None,
        zwidth.ExponentialFilter(rng.uniform(0.05, 1.0), velocity_from=source),
        zwidth.ExponentialFilter(cutoff=rng.uniform(0.02, 0.3) / T),
        zwidth.PositionFilter([0.5, 0.3, 0.2], [1, 0, 0], velocity_from=source),
        zwidth.PositionFilter([1 - g * 0.9], [1, -g * 0.9], velocity_from=source),
        zwidth.LowPass(cutoff=rng.uniform(0.03, 0.4) / T, order=int(rng.integers(1, 3))),
        zwidth.Butterworth(cutoff=rng.uniform(0.05, 0.4) / T, order=int(rng.integers(1, 4))),
        zwidth.Pll(rng.uniform(0.02, 0.5) / T),
        zwidth.Observer([g, h - g, 0], [h / T, -h / T, 0], [1, g + h - 2, 1 - g]),
    ][rng.integers(9)]
    if isinstance(position, zwidth.Pll | zwidth.Observer):
        velocity = zwidth.BackwardDifference()
    weights: Any = [{}, {"position": 1.0}, {"position": rng.uniform(1, 50), "velocity": 1.0}][rng.integers(3)]
    ki = unit / T * 10 ** rng.uniform(-6, -3)
    if len(weights) == 2:
        ki *= T
    Bi = m / T**2 * rng.uniform(0.01, 0.1)
    feedback: Any = [
        None,
        zwidth.Feedback.integral(ki, rng.choice(["backward", "forward", "trapezoidal"]).item(), **weights),
        zwidth.Feedback([Bi, -Bi], [1, 0], **({} if len(weights) == 2 else weights)),
        zwidth.Feedback([ki * T, 0.2 * ki * T], [1, -0.6], **weights),
    ][rng.integers(4)]
    if position is None and feedback is None:
        return draw_scene(rng)
    return zwidth.Scene(device, timing, velocity=velocity, position=position, feedback=feedback)
