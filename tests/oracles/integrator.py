"""Independent simulation of the time-domain model (docs/theory/simulation.md, T1 to T4), as a reference.

Newton's laws in SI units and absolute coordinates of every body, integrated by an explicit Runge-Kutta method
of order 8; friction by terminal events and restarts; the controller by difference equations. A single body is
also available in closed form, as a reference for the integrator itself.
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

_MOST_EVENTS = 200  # per period


class Piece(NamedTuple):
    """A part of the response under constant forces; slip is the direction, 0 while sticking, None without friction."""

    span: float
    state: np.ndarray
    wall: float
    slip: float | None


class History(NamedTuple):
    """Values at every sample in SI units; rows of position and velocity are samples, columns bodies.

    ``events``: instant and kind: "stick" (the velocity reaches 0 and stays there), "turn" (reaches 0 and
    changes sign), "slip".
    ``distances``: smallest distance of a decision from its threshold, by kind: "rounding" and "contact"
    relative to the largest measured position so far, "static" relative to static friction, "graze" (the
    velocity has an extremum near 0) relative to the largest velocity.
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
    """Return the output at step 0 and its increment per step of a filter in steady state for the input
    ``position + step k``.
    """
    ages = np.arange(top.size), np.arange(bottom.size)
    growth = top.sum() * step / bottom.sum()
    return (top.sum() * position - ages[0] @ top * step + ages[1] @ bottom * growth) / bottom.sum(), growth


def velocity_program(scene: Any, position: float, velocity: float, resolution: float = 0.0) -> Callable[[float], float]:
    """Return the velocity filter as a function of successive measured positions; the past is a quantized ramp."""

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
        inputs = deque([read(position) - velocity * period * age for age in range(1, order + 1)], maxlen=order)
        outputs = deque([now - growth * age for age in range(1, order + 1)], maxlen=order)

        def direct(x: float) -> float:
            y = (top[0] * x + top[1:] @ np.array(inputs) - bottom[1:] @ np.array(outputs)) / bottom[0]
            inputs.appendleft(x)
            outputs.appendleft(y)
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
        gain = -math.expm1(-coded / tau)
        stages = [settled] * kind.order

        def low_pass(x: float) -> float:
            value = difference(x)
            for k in range(kind.order):
                stages[k] += gain * (value - stages[k])
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
    """Return the response at samples 0 to ``periods``, inclusive; ``jitter_samples`` has one delay in periods
    per sample.

    ``law`` replaces spring and damper if given; ``position`` and ``velocity`` are those of all bodies, or of
    each. ``rtol`` and ``step``, the longest step in radians of the fastest mode, bound the integration error.
    """
    friction = Friction(coulomb, coulomb if static is None else static) if coulomb or static else None
    bodies = (RigidBody if closed_form else Bodies)(scene, friction, rtol, step)
    sensor = int(np.argmax(continuous(scene)[2]))
    period, delay = scene.timing.period, float(scene.d)
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
    pending: deque[tuple[float, float]] = deque()

    def note(kind: str, distance: float) -> None:
        distances[kind] = min(distances.get(kind, math.inf), abs(distance))

    def decide(y: np.ndarray, force: float) -> float:
        assert friction is not None
        other = bodies.other_forces(y, force)
        note("static", abs(other) / friction.static - 1.0)
        return 0.0 if abs(other) <= friction.static else math.copysign(1.0, other)

    def pass_time(y: np.ndarray, start: float, span: float, slip: float | None) -> tuple[np.ndarray, float | None]:
        """Integrate over an interval of constant wall force, from event to event."""
        force = wall + external_force
        if slip is None or friction is None:
            pieces.append(Piece(span, y, wall, slip))
            return bodies.move(y, span, force, slip), slip
        skipped = 0.0
        if slip * y[n] <= 0:
            if abs(y[n]) * period > 1e-6 * bodies.size:
                raise RuntimeError(f"a stop was missed before {start} s, where the velocity is {y[n]} m/s")
            y[n], before = 0.0, slip
            slip = decide(y, force)
            if slip != before:
                events.append((start, "slip" if before == 0 else "turn" if slip else "stick"))
            skipped = BLIND * period if slip else 0.0
        else:
            note("graze", y[n] * period / bodies.size if bodies.size else math.inf)
        for _ in range(_MOST_EVENTS):
            pieces.append(Piece(span, y.copy(), wall, slip))
            skipped = min(skipped, span)
            y = bodies.move(y, skipped, force, slip) if skipped else y
            elapsed, y, is_event = bodies.until(y, span - skipped, force, slip, note)
            elapsed += skipped
            if not is_event:
                if slip == 0:
                    note("static", abs(bodies.other_forces(y, force)) / friction.static - 1.0)
                return y, slip
            pieces[-1] = pieces[-1]._replace(span=elapsed)
            start, span = start + elapsed, span - elapsed
            y[n] = 0.0
            if slip == 0:
                slip, kind = math.copysign(1.0, bodies.other_forces(y, force)), "slip"
            else:
                slip = decide(y, force)
                kind = "turn" if slip else "stick"
            skipped = BLIND * period if slip else 0.0
            events.append((start, kind))
        raise RuntimeError(f"more than {_MOST_EVENTS} events within one period, at {start} s")

    for k, instant in enumerate(instants.tolist()):
        sensor_position = float(state[sensor])
        reach = max(reach, abs(sensor_position))
        measured = sensor_position
        if resolution:
            measured = resolution * math.floor(sensor_position / resolution + 0.5)
            note("rounding", (abs(sensor_position - measured) - 0.5 * resolution) / (reach or resolution))
        elif contact != "bilateral" and reach:
            note("contact", sensor_position / reach)
        speed = estimate(measured)
        touching = contact == "bilateral" or measured > 0
        law_force = (
            -(stiffness * measured + virtual_damping * speed) if law is None else law(measured, speed, k * period)
        )
        target_force = law_force if touching else 0.0
        if contact == "push_only":
            target_force = min(target_force, 0.0)
        target_force = min(max(target_force, -max_force), max_force)
        max_change = max_rate * period
        command = min(max(target_force, command - max_change), command + max_change)
        rows.append((state.copy(), measured, speed, command, touching))
        if k == periods:
            break
        pending.append((instant + delay, command))
        now = instant
        while now < instants[k + 1]:
            while pending and pending[0][0] <= now:
                wall = pending.popleft()[1]
            then = min(pending[0][0] if pending else math.inf, float(instants[k + 1]))
            state, slip = pass_time(state, now * period, (then - now) * period, slip)
            now = then
    states, measures, speeds, commands, touches = (np.array(column) for column in zip(*rows, strict=True))
    return History(
        instants * period, states[:, :n], states[:, n:], measures, speeds, commands, touches, events, pieces, distances
    )
