"""Closed loop of any linear scene as one state matrix, and random scenes.

The matrix shares no formula with `zwidth.stability.linear`. The bodies have absolute coordinates, with masses, dampers
and springs. The filters are difference equations, and each delayed command is a state. The eigenvalues are the poles.
`proved_loop` does the same in ball arithmetic, for labels that float64 does not resolve.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import flint
import numpy as np
import scipy.linalg
import scipy.signal

import zwidth


def _masses_and_links(scene: Any) -> tuple[list[list[float]], list[tuple[float, float]]]:
    """Return mass, damping and stiffness to ground of each body, and stiffness and damping between neighbors."""
    bodies, links = [[scene.device.mass, scene.device.damping, 0.0]], []
    tip, hand = scene.device.coupling, scene.operator
    if tip is not None:
        bodies.append([tip.mass, 0.0, 0.0])
        links.append((tip.stiffness, tip.damping))
    if hand is not None and hand.coupling_stiffness is None:
        body = bodies[-1]
        bodies[-1] = [a + b for a, b in zip(body, (hand.mass, hand.damping, hand.stiffness), strict=True)]
    elif hand is not None:
        bodies.append([hand.mass, hand.damping, hand.stiffness])
        links.append((hand.coupling_stiffness, hand.coupling_damping))
    return bodies, links


def rate_table(scene: Any, number: Any = float) -> tuple[list[list[Any]], int, np.ndarray]:
    """Return ``[[A, B], [0, 0]]`` of ``x' = A x + B u``, the size of A, and the output row of the sensor.

    The state contains positions and velocities of the bodies, position and velocity of each mode, the force of the
    actuator and, for a second-order actuator, its rate of change.

    Args:
        scene: the scene.
        number: type of the entries, ``float`` or ``flint.arb``.
    """
    if isinstance(scene.device, zwidth.LinearDevice):
        return _companion(scene.device, number)
    bodies, links = _masses_and_links(scene)
    n, modes, lag = len(bodies), scene.device.modes, scene.device.actuator
    size = 2 * n + 2 * len(modes) + (lag.order if lag else 0)
    table = [[number(0)] * (size + 1) for _ in range(size + 1)]
    for k, (mass, damping, stiffness) in enumerate(bodies):
        table[k][n + k] = number(1)
        table[n + k][k] -= number(stiffness) / number(mass)
        table[n + k][n + k] -= number(damping) / number(mass)
    for k, pair in enumerate(links):
        for offset, value in zip((0, n), pair, strict=True):
            for index, other in ((k, k + 1), (k + 1, k)):
                ratio = number(value) / number(bodies[index][0])
                table[n + index][offset + index] -= ratio
                table[n + index][offset + other] += ratio
    tip = scene.device.coupling
    output_row = np.zeros(size)
    output_row[int(tip is not None and tip.sensor == "tip")] = 1.0
    acts = size if lag is None else size - lag.order
    table[n][acts] = 1 / number(bodies[0][0])
    two_pi = 2 * (flint.arb.pi() if number is flint.arb else np.pi)
    for k, mode in enumerate(modes):
        index, w = 2 * (n + k), two_pi * number(mode.frequency)
        table[index][index + 1] = number(1)
        table[index + 1][index], table[index + 1][index + 1] = -w * w, -2 * number(mode.damping_ratio) * w
        table[index + 1][acts] = 1 / number(mode.mass)
        output_row[index] = 1.0
    if lag is not None:
        w = 1 / number(lag.time_constant) if lag.cutoff is None else two_pi * number(lag.cutoff)
        if lag.order == 1:
            table[acts][acts], table[acts][size] = -w, w
        else:
            table[acts][acts + 1] = number(1)
            table[acts + 1][acts], table[acts + 1][acts + 1] = -w * w, -2 * number(lag.damping_ratio) * w
            table[acts + 1][size] = w * w
    return table, size, output_row


def continuous(scene: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B and the sensor row of the device in continuous time, in SI units."""
    table, size, output_row = rate_table(scene)
    rate = np.array(table)
    return rate[:size, :size], rate[:size, size], output_row


def flow(a: np.ndarray, b: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the transition matrix over a time, and the state after a unit force from rest."""
    size = len(b)
    block = np.zeros((size + 1, size + 1))
    block[:size, :size], block[:size, size] = a * time, b * time
    block = scipy.linalg.expm(block)
    return block[:size, :size], block[:size, size]


def _companion(device: Any, number: Any) -> tuple[list[list[Any]], int, np.ndarray]:
    """Return the result of `rate_table` for a continuous linear device, in controllable canonical form."""
    bottom, top = (
        [value / device.system.denominator[0] for value in part]
        for part in (device.system.denominator, device.system.numerator)
    )
    size = len(bottom) - 1
    table = [[number(0)] * (size + 1) for _ in range(size + 1)]

    def exact(value: Any) -> Any:
        return number(flint.fmpq(value.numerator, value.denominator)) if number is flint.arb else float(value)

    for k in range(size - 1):
        table[k][k + 1] = number(1)
    table[size - 1] = [*(-exact(value) for value in bottom[:0:-1]), number(1)]
    output_row = np.array([exact(value) for value in top[::-1]] + [number(0)] * (size - len(top)), object)
    return table, size, output_row if number is flint.arb else output_row.astype(float)


def velocity_polynomials(scene: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return numerator and denominator of the velocity estimate in m and s, of equal length, highest power first."""
    velocity, period = scene.velocity, scene.timing.period
    period = getattr(velocity, "coded_period", None) or period
    top, bottom = np.array([1.0, -1.0]) / period, np.array([1.0, 0.0])
    if isinstance(velocity, zwidth.VelocityFilter):
        top, bottom = np.array(velocity.numerator), np.array(velocity.denominator)
    elif isinstance(velocity, zwidth.WindowedDifference):
        top, bottom = np.zeros(velocity.samples + 1), np.zeros(velocity.samples + 1)
        top[[0, -1]] = 1.0 / (velocity.samples * period), -1.0 / (velocity.samples * period)
        bottom[0] = 1.0
    elif isinstance(velocity, zwidth.LowPass):
        tau = velocity.time_constant or 1.0 / (2.0 * np.pi * velocity.cutoff)
        p = np.exp(-period / tau)
        for _ in range(velocity.order):
            top, bottom = np.convolve(top, [-np.expm1(-period / tau), 0.0]), np.convolve(bottom, [1.0, -p])
    elif isinstance(velocity, zwidth.Butterworth):
        designed: Any = scipy.signal.butter(velocity.order, 2.0 * velocity.cutoff * period)
        top, bottom = np.convolve(designed[0], top), np.convolve(designed[1], bottom)
    return np.concatenate([np.zeros(bottom.size - top.size), top]), bottom


def _sample(scene: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the transition over a period, the effects of the newer and the older force, and the sensor row."""
    a, b, output_row = continuous(scene)
    period, fraction = scene.timing.period, scene.d - scene.integer_delay
    rest, newer = flow(a, b, (1.0 - fraction) * period)
    return flow(a, b, period)[0], newer, rest @ flow(a, b, fraction * period)[1], output_row


def closed_loop_matrix(scene: Any, stiffness: float, virtual_damping: float) -> np.ndarray:
    """Return the state matrix of the closed loop: positions, velocities, filter, then the delayed commands."""
    step, newer, older, output_row = _sample(scene)
    size, late = len(step), scene.integer_delay
    fraction = scene.d - late
    top, bottom = velocity_polynomials(scene)
    top, bottom = top / bottom[0], bottom / bottom[0]
    order = bottom.size - 1
    queue = late + (1 if fraction else 0)
    total = size + order + queue
    force = np.zeros(total)
    force[:size] = -(stiffness + virtual_damping * top[0]) * output_row
    force[size : size + order] = -virtual_damping * (top[1:] - top[0] * bottom[1:])

    def sample(age: int) -> np.ndarray:
        """Return the command of this age in samples, as a row of the state."""
        return force if age == 0 else np.eye(total)[size + order + age - 1]

    matrix = np.zeros((total, total))
    matrix[:size, :size] = step
    matrix[:size] += np.outer(newer, sample(late))
    if fraction:
        matrix[:size] += np.outer(older, sample(late + 1))
    if order:
        matrix[size, size : size + order] = -bottom[1:]
        matrix[size + 1 : size + order, size : size + order - 1] = np.eye(order - 1)
        matrix[size, :size] += output_row
    for age in range(queue):
        matrix[size + order + age] = sample(age)
    return matrix


def spectral_radius(scene: Any, stiffness: float, virtual_damping: float) -> float:
    """Return the largest modulus of a pole."""
    return float(np.abs(np.linalg.eigvals(closed_loop_matrix(scene, stiffness, virtual_damping))).max())


def scene_of(parts: dict[str, Any]) -> zwidth.Scene:
    """Return the scene that a reference file describes: its parts by name, the velocity estimate with its kind."""
    device = dict(parts["device"])
    if coupling := device.pop("coupling", None):
        device["coupling"] = zwidth.Coupling(**coupling)
    velocity = dict(parts.get("velocity", {"kind": "BackwardDifference"}))
    estimate = getattr(zwidth, velocity.pop("kind"))(**velocity)
    hand = zwidth.Operator(**parts["operator"]) if parts.get("operator") else None
    return zwidth.Scene(zwidth.Device(**device), zwidth.Timing(**parts["timing"]), velocity=estimate, operator=hand)


def random_scene(kind: str, generator: np.random.Generator) -> zwidth.Scene:
    """Return a random scene of one of `KINDS`, with integer or fractional delay."""
    draw = generator.uniform
    mass, period = 10 ** draw(-1.5, 0.5), 10 ** draw(-4, -2.5)
    coupling = hand = None
    velocity: Any = zwidth.BackwardDifference()
    if kind in ("tip", "motor", "all"):
        sensor = kind if kind != "all" else str(generator.choice(["tip", "motor"]))
        stiffness = mass / period**2 * 10 ** draw(-3, 0.5)
        damping = float(generator.choice([0.0, mass / period * 10 ** draw(-3, -0.5)]))
        coupling = zwidth.Coupling(mass * 10 ** draw(-1, 0.5), stiffness, damping, sensor)  # type: ignore[arg-type]
    if kind in ("hand", "soft hand", "all"):
        hand_mass, damping, stiffness = mass * 10 ** draw(-1, 1), 10 ** draw(-1, 1), 10 ** draw(1, 3)
        soft = kind == "soft hand" or (kind == "all" and draw() < 0.5)
        link = {"coupling_stiffness": 10 ** draw(2, 4), "coupling_damping": 10 ** draw(-1, 1)} if soft else {}
        hand = zwidth.Operator(hand_mass, damping, stiffness, **link)
    if kind in ("filter", "all"):
        cutoff = 10 ** draw(-2.5, -0.4) / period
        velocity = (
            zwidth.BackwardDifference(),
            zwidth.WindowedDifference(int(generator.integers(2, 15))),
            zwidth.LowPass(cutoff=cutoff),
            zwidth.LowPass(time_constant=period * 10 ** draw(-0.5, 1.5), order=2),
            zwidth.Butterworth(max(cutoff, 0.02 / period), int(generator.integers(1, 5))),
            zwidth.VelocityFilter(np.convolve([1.0, -1.0], [1.0, 0.3]) / period / 1.3, [1.0, -0.2, 0.0]),
        )[generator.integers(0, 6)]
    device = zwidth.Device(mass, float(generator.choice([0.0, 10 ** draw(-1, 1.5)])), coupling)
    if kind == "driven":
        rate = 10 ** draw(-2, 1) / period
        lag = zwidth.Actuator(rate) if draw() < 0.5 else zwidth.Actuator(rate, order=2, damping_ratio=10 ** draw(-1, 0))
        modes = [
            zwidth.Mode(10 ** draw(-2.5, -0.1) / period, 10 ** draw(-3, -0.7), mass * 10 ** draw(0, 2) * sign)
            for sign in generator.choice([1.0, 1.0, -1.0], generator.integers(0, 3))
        ]
        device = replace(device, modes=modes, actuator=lag if draw() < 0.6 or not modes else None)
    n, fractional = int(generator.integers(0, 12)), float(draw(0, 8))
    periods = float(generator.choice([0, 1, n, fractional, 0.3, np.nextafter(3, 0)]))
    return zwidth.Scene(device, zwidth.Timing(period, periods * period), velocity=velocity, operator=hand)


KINDS = ("device", "filter", "tip", "motor", "hand", "soft hand", "all", "driven")


def row_ends(scene: Any, virtual_damping: float, angles: int = 4000) -> tuple[np.ndarray, float]:
    """Return all K that put a pole on the unit circle at one B, by a dense frequency grid, and their typical magnitude.

    The response of the device is computed from its state matrix at each frequency.
    """
    transition, newer, older, output_row = _sample(scene)
    size, late = len(transition), scene.integer_delay
    fraction = scene.d - late
    top, bottom = velocity_polynomials(scene)

    def critical_controller(w: np.ndarray) -> Any:
        """Return ``-1/G - B F``, which is the stiffness where it is real."""
        z = np.exp(1j * w)
        input_response = (
            newer[None, :] + older[None, :] / z[:, None] if fraction else np.broadcast_to(newer, (w.size, size))
        )
        position = (
            np.linalg.solve(z[:, None, None] * np.eye(size) - transition, input_response[..., None])[..., 0]
            @ output_row
        )
        return -(z**late) / position - virtual_damping * np.polyval(top, z) / np.polyval(bottom, z)

    grid = np.unique(np.concatenate([np.geomspace(1e-6, 0.3, angles // 2), np.linspace(1e-3, np.pi - 1e-9, angles)]))
    value = critical_controller(grid)
    k = np.flatnonzero(np.sign(value.imag[:-1]) * np.sign(value.imag[1:]) < 0)
    low, high, sign = grid[k], grid[k + 1], np.sign(value.imag[k])
    for _ in range(60 if k.size else 0):
        middle = 0.5 * (low + high)
        same = np.sign(critical_controller(middle).imag) == sign
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    at_ends = np.array([1e-9, np.pi])
    values: Any = np.concatenate([critical_controller(0.5 * (low + high)), critical_controller(at_ends)])
    return values.real, float(np.median(np.abs(value)))
