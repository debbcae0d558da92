"""Bodies in series under constant forces, dry friction on the first: by Runge-Kutta, or one body in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from any_loop import continuous
from scipy.integrate import solve_ivp

BLIND = 1e-9  # in periods: no event is searched this soon after another; so short a motion is a parabola


class Friction(NamedTuple):
    """Friction on the first body in N: while sliding, and at most at rest."""

    coulomb: float
    static: float


def _event(value: Any, direction: float, terminal: bool) -> Any:
    """Set the attributes of an event function that solve_ivp reads."""
    value.direction, value.terminal = direction, terminal
    return value


class Bodies:
    """Bodies in series, integrated by solve_ivp."""

    def __init__(self, scene: Any, friction: Friction | None, rtol: float, step: float) -> None:
        self.matrix, self.push, _ = continuous(scene)
        self.count = self.push.size // 2
        self.friction, self.rtol, self.period = friction, rtol, scene.timing.period
        self.mass = 1.0 / self.push[self.count]
        self.held = self.matrix.copy()
        self.held[[0, self.count]] = 0.0
        # The force of springs and dampers on the first body while it sticks.
        self.pull = self.matrix[self.count] * self.mass
        self.pull[self.count] = 0.0
        self.longest = step / max(np.abs(np.linalg.eigvals(self.matrix)).max(), 1e-300)
        self.size = 0.0

    def other_forces(self, state: np.ndarray, force: float) -> float:
        """Return the sum of the other forces on the first body while it sticks."""
        return float(self.pull @ state) + force

    def _flow(self, force: float, slip: float | None) -> tuple[np.ndarray, np.ndarray]:
        if slip == 0:
            return self.held, np.zeros_like(self.push)
        return self.matrix, self.push * (force - (slip * self.friction.coulomb if slip and self.friction else 0.0))

    def _grow(self, state: np.ndarray, push: np.ndarray) -> None:
        """Update the largest position, velocity and acceleration, converted to lengths by powers of the period."""
        lengths = np.concatenate([state[: self.count], state[self.count :] * self.period, push * self.period**2])
        self.size = max(self.size, float(np.abs(lengths).max()))

    def _solve(self, state: np.ndarray, span: float, matrix: np.ndarray, push: np.ndarray, events: Any = None) -> Any:
        n = self.count
        self._grow(state, push)
        near = 0.1 * self.rtol * (self.size or 1.0)
        return solve_ivp(
            lambda _, y: matrix @ y + push,
            (0.0, span),
            state,
            method="DOP853",
            rtol=self.rtol,
            atol=np.repeat([near, near / self.period], n),
            max_step=self.longest,
            first_step=min(abs(span), 0.1 * self.longest),
            events=events,
        )

    def move(self, state: np.ndarray, span: float, force: float, slip: float | None) -> np.ndarray:
        """Return the state after a time span, ignoring events."""
        matrix, push = self._flow(force, slip)
        if abs(span) <= BLIND * self.period:
            rate = matrix @ state + push
            return state + span * rate + 0.5 * span**2 * (matrix @ rate)
        return self._solve(state, span, matrix, push).y[:, -1]

    def _list_events(self, force: float, slip: float) -> list[tuple[np.ndarray, float, float]]:
        """Return rows and constants whose sum increases through 0 at the next event, and the scale of each."""
        assert self.friction is not None
        if slip:
            row = np.zeros_like(self.push)
            row[self.count] = -slip
            return [(row, 0.0, self.size / self.period)]
        static = self.friction.static
        return [(sign * self.pull, sign * force - static, static) for sign in (1.0, -1.0)]

    def until(
        self, state: np.ndarray, span: float, force: float, slip: float, note: Callable[[str, float], None]
    ) -> tuple[float, np.ndarray, bool]:
        """Return time and state of the next event or of the end of the span, and whether it is an event."""
        matrix, push = self._flow(force, slip)
        if slip == 0 and self.count == 1:
            return span, state.copy(), False
        if span <= BLIND * self.period:
            return span, self.move(state, span, force, slip), False
        self._grow(state, push)
        monitored = self._list_events(force, slip)

        def rise(k: int) -> Any:
            def value(_: float, y: np.ndarray) -> float:
                return float(monitored[k][0] @ y) + monitored[k][1]

            return _event(value, 1.0, terminal=True)

        def top(k: int) -> Any:
            def value(_: float, y: np.ndarray) -> float:
                return float(monitored[k][0] @ (matrix @ y + push))

            return _event(value, -1.0, terminal=False)

        rises = [rise(k) for k in range(len(monitored))]
        result = self._solve(state, span, matrix, push, [*rises, *(top(k) for k in range(len(monitored)))])
        end, high = float(result.t[-1]), []
        for k, (row, constant, size) in enumerate(monitored):
            tops = result.t_events[len(monitored) + k], result.y_events[len(monitored) + k]
            for instant, y in zip(*tops, strict=True):
                height = float(row @ y) + constant
                note("graze" if slip else "static", height / size)
                if height > 0.0 and instant < end:
                    high.append(instant)
        if high:
            # The value rises above 0 and returns within one step: integrate to the maximum, where it is positive.
            result = self._solve(state, min(high), matrix, push, rises)
            end = float(result.t[-1])
        hit = next((k for k in range(len(monitored)) if result.t_events[k].size), None)
        if hit is None:
            return span, result.y[:, -1], False
        # The interpolant locates the event approximately; refine it by integration.
        row, constant, _ = monitored[hit]
        y = self.move(state, end, force, slip)
        for _ in range(3):
            rate = float(row @ (matrix @ y + push))
            correction = -(float(row @ y) + constant) / rate if rate else 0.0
            if not abs(correction) < 1e-3 * self.period:
                break
            y, end = self.move(y, correction, force, slip), end + correction
        return min(max(end, 0.0), span), y, True


class RigidBody(Bodies):
    """A single body without a spring, in closed form."""

    def __init__(self, scene: Any, friction: Friction | None, rtol: float, step: float) -> None:
        super().__init__(scene, friction, rtol, step)
        if self.count > 1 or self.matrix[1, 0]:
            raise ValueError("only a single body without a spring moves in closed form")
        self.loss = -self.matrix[1, 1]

    def move(self, state: np.ndarray, span: float, force: float, slip: float | None) -> np.ndarray:
        push = self._flow(force, slip)[1]
        if slip == 0:
            return state.copy()
        (x, v), a, c = state, push[1], self.loss
        self._grow(state, push)
        if c == 0:
            return np.array([x + v * span + 0.5 * a * span**2, v + a * span])
        gained = -math.expm1(-c * span) / c
        # (span - gained)/c without cancellation at small c.
        bend = _second(c * span) * span**2
        return np.array([x + v * gained + a * bend, v * math.exp(-c * span) + a * gained])

    def until(
        self, state: np.ndarray, span: float, force: float, slip: float, note: Callable[[str, float], None]
    ) -> tuple[float, np.ndarray, bool]:
        if slip == 0:
            return span, state.copy(), False
        a, c, v = self._flow(force, slip)[1][1], self.loss, state[1]
        speed, acceleration = slip * v, slip * (a - c * v)
        if acceleration >= 0 or speed <= 0:
            stop = math.inf
        elif c == 0:
            stop = speed / -acceleration
        else:
            # v reaches 0 at exp(c t) = 1 - c v/a, or never if the force acts in the direction of motion.
            stop = math.log1p(-c * v / a) / c if slip * a < 0 else math.inf
        if stop >= span:
            return span, self.move(state, span, force, slip), False
        return stop, self.move(state, stop, force, slip), True


def _second(c: float) -> float:
    """Return ``(c - 1 + e^-c)/c^2``."""
    if abs(c) > 0.5:
        return (c + math.expm1(-c)) / c**2
    return sum((-c) ** k / math.factorial(k + 2) for k in range(20))
