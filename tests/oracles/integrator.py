"""The model of the time domain (docs/theory/simulation.md, T1 to T4) by other means: a judge of simulations.

Newton's laws in SI units and absolute coordinates of every body, integrated by an explicit Runge-Kutta method of order
8; friction by terminal events and restarts; the program by plain difference equations. A single body also moves in
closed form, so that the integrator has a judge of its own.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.signal
from any_loop import continuous
from dry_bodies import BLIND, Bodies, Friction, RigidBody

import zwidth

_MOST_EVENTS = 200


class Piece(NamedTuple):
    """A stretch of motion under constant forces; slip is the direction, 0 while it sticks, None without friction."""

    span: float
    state: np.ndarray
    wall: float
    slip: float | None


class History(NamedTuple):
    """What every sample saw; rows of position and velocity are samples, columns bodies. Everything in SI units.

    ``events``: instant and kind: "stick" (the velocity reaches 0 and stays), "turn" (reaches 0, and leaves), "slip".
    ``distances``: how far the nearest decision was from falling otherwise, by its kind: "rounding" and "contact" in
    units of the largest measured motion until then, "static" in units of static friction, "graze" (the velocity
    turns next to 0) in units of the largest velocity.
    """

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    measured: np.ndarray
    estimate: np.ndarray
    command: np.ndarray
    contact: np.ndarray
    events: list[tuple[float, str]]
    pieces: list[Piece]
    distances: dict[str, float]


def _settled_on_ramp(top: np.ndarray, bottom: np.ndarray, position: float, step: float) -> tuple[float, float]:
    """Output at step 0 and its growth a step, of a filter that has always seen ``position + step k``."""
    ages = np.arange(top.size), np.arange(bottom.size)
    growth = top.sum() * step / bottom.sum()
    return (top.sum() * position - ages[0] @ top * step + ages[1] @ bottom * growth) / bottom.sum(), growth


def velocity_program(scene: Any, position: float, velocity: float, resolution: float = 0.0) -> Callable[[float], float]:
    """The program's estimate, one measured position after the other; the past lies on a line, read like all else."""

    def read(x: float) -> float:
        return resolution * math.floor(x / resolution + 0.5) if resolution else x

    kind: Any = scene.velocity
    period = scene.timing.period
    coded = getattr(kind, "coded_period", None) or period
    if isinstance(kind, zwidth.VelocityFilter):
        top, bottom = np.array(kind.numerator), np.array(kind.denominator)
        top = np.append(np.zeros(bottom.size - top.size), top)
        now, growth = _settled_on_ramp(top, bottom, read(position), velocity * period)
        order = bottom.size - 1
        seen = deque([read(position) - velocity * period * age for age in range(1, order + 1)], maxlen=order)
        said = deque([now - growth * age for age in range(1, order + 1)], maxlen=order)

        def direct(x: float) -> float:
            y = (top[0] * x + top[1:] @ np.array(seen) - bottom[1:] @ np.array(said)) / bottom[0]
            seen.appendleft(x)
            said.appendleft(y)
            return float(y)

        return direct
    window = kind.samples if isinstance(kind, zwidth.WindowedDifference) else 1
    past = deque([read(position - velocity * period * age) for age in range(1, window + 1)], maxlen=window)

    def difference(x: float) -> float:
        quotient = (x - past[-1]) / (window * coded)
        past.appendleft(x)
        return quotient

    settled = velocity * period / coded
    if isinstance(kind, zwidth.LowPass):
        tau = kind.time_constant or 1.0 / (2.0 * np.pi * kind.cutoff)
        share = -math.expm1(-coded / tau)
        stages = [settled] * kind.order

        def low_pass(x: float) -> float:
            value = difference(x)
            for k in range(kind.order):
                stages[k] += share * (value - stages[k])
                value = stages[k]
            return value

        return low_pass
    if isinstance(kind, zwidth.Butterworth):
        sections: Any = scipy.signal.butter(kind.order, 2.0 * kind.cutoff * coded, output="sos")
        memory = [scipy.signal.sosfilt_zi(sections) * settled]

        def butterworth(x: float) -> float:
            value, memory[0] = scipy.signal.sosfilt(sections, [difference(x)], zi=memory[0])
            return float(value[0])

        return butterworth
    return difference


def integrate(
    scene: Any,
    stiffness: float,
    virtual_damping: float,
    periods: int,
    *,
    law: Callable[[float, float, float], float] | None = None,
    position: float | Sequence[float] = 0.0,
    velocity: float | Sequence[float] = 0.0,
    external_force: float = 0.0,
    contact: str = "bilateral",
    resolution: float = 0.0,
    coulomb: float = 0.0,
    static: float | None = None,
    max_force: float = math.inf,
    max_rate: float = math.inf,
    jitter_samples: np.ndarray | None = None,
    rtol: float = 3e-14,
    step: float = 0.25,
    closed_form: bool = False,
) -> History:
    """The motion at samples 0 to ``periods``, the last included; ``jitter_samples`` has one share for each.

    ``law`` stands for spring and damper where it is given; ``position`` and ``velocity`` are of all bodies, or of each.
    ``rtol`` and ``step``, the longest one in radians of the fastest motion, bound the error of the integration.
    """
    friction = Friction(coulomb, coulomb if static is None else static) if coulomb or static else None
    bodies = (RigidBody if closed_form else Bodies)(scene, friction, rtol, step)
    sensor = int(np.argmax(continuous(scene)[2]))
    period, late = scene.timing.period, float(scene.d)
    n = bodies.count
    state = np.concatenate([np.broadcast_to(np.asarray(start, float), n) for start in (position, velocity)])
    estimate = velocity_program(scene, float(state[sensor]), float(state[n + sensor]), resolution)
    instants = np.arange(periods + 1) + (0.0 if jitter_samples is None else np.asarray(jitter_samples))
    distances: dict[str, float] = {}
    events: list[tuple[float, str]] = []
    pieces: list[Piece] = []
    rows = []
    slip = None if friction is None else float(np.sign(state[n]))
    wall = command = reach = 0.0
    coming: deque[tuple[float, float]] = deque()

    def note(kind: str, distance: float) -> None:
        distances[kind] = min(distances.get(kind, math.inf), abs(distance))

    def decide(y: np.ndarray, force: float) -> float:
        assert friction is not None
        other = bodies.other_forces(y, force)
        note("static", abs(other) / friction.static - 1.0)
        return 0.0 if abs(other) <= friction.static else math.copysign(1.0, other)

    def pass_time(y: np.ndarray, start: float, span: float, slip: float | None) -> tuple[np.ndarray, float | None]:
        """One stretch of constant wall force, from event to event."""
        force = wall + external_force
        if slip is None or friction is None:
            pieces.append(Piece(span, y, wall, slip))
            return bodies.move(y, span, force, slip), slip
        blind = 0.0
        if slip * y[n] <= 0:
            if abs(y[n]) * period > 1e-6 * bodies.size:
                raise RuntimeError(f"a stop was missed before {start} s, where the velocity is {y[n]} m/s")
            y[n], before = 0.0, slip
            slip = decide(y, force)
            if slip != before:
                events.append((start, "slip" if before == 0 else "turn" if slip else "stick"))
            blind = BLIND * period if slip else 0.0
        else:
            note("graze", y[n] * period / bodies.size if bodies.size else math.inf)
        for _ in range(_MOST_EVENTS):
            pieces.append(Piece(span, y.copy(), wall, slip))
            blind = min(blind, span)
            y = bodies.move(y, blind, force, slip) if blind else y
            passed, y, happened = bodies.until(y, span - blind, force, slip, note)
            passed += blind
            if not happened:
                if slip == 0:
                    note("static", abs(bodies.other_forces(y, force)) / friction.static - 1.0)
                return y, slip
            pieces[-1] = pieces[-1]._replace(span=passed)
            start, span = start + passed, span - passed
            y[n] = 0.0
            if slip == 0:
                slip, kind = math.copysign(1.0, bodies.other_forces(y, force)), "slip"
            else:
                slip = decide(y, force)
                kind = "turn" if slip else "stick"
            blind = BLIND * period if slip else 0.0
            events.append((start, kind))
        raise RuntimeError(f"more than {_MOST_EVENTS} events within one period, at {start} s")

    for k, instant in enumerate(instants.tolist()):
        sensed = float(state[sensor])
        reach = max(reach, abs(sensed))
        measured = sensed
        if resolution:
            measured = resolution * math.floor(sensed / resolution + 0.5)
            note("rounding", (abs(sensed - measured) - 0.5 * resolution) / (reach or resolution))
        elif contact != "bilateral" and reach:
            note("contact", sensed / reach)
        speed = estimate(measured)
        touching = contact == "bilateral" or measured > 0
        asked = -(stiffness * measured + virtual_damping * speed) if law is None else law(measured, speed, k * period)
        wanted = asked if touching else 0.0
        if contact == "push_only":
            wanted = min(wanted, 0.0)
        wanted = min(max(wanted, -max_force), max_force)
        most = max_rate * period
        command = min(max(wanted, command - most), command + most)
        rows.append((state.copy(), measured, speed, command, touching))
        if k == periods:
            break
        coming.append((instant + late, command))
        now = instant
        while now < instants[k + 1]:
            while coming and coming[0][0] <= now:
                wall = coming.popleft()[1]
            then = min(coming[0][0] if coming else math.inf, float(instants[k + 1]))
            state, slip = pass_time(state, now * period, (then - now) * period, slip)
            now = then
    states, measures, speeds, commands, touches = (np.array(column) for column in zip(*rows, strict=True))
    return History(
        instants * period, states[:, :n], states[:, n:], measures, speeds, commands, touches, events, pieces, distances
    )
