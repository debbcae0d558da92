"""Simulate the contact of an admittance display with an environment, sample by sample.

The display is a robot that measures the contact force and moves like a virtual mass M with damping D; the environment
has the stiffness K and the damping B. T is the sampling period, and the delay of the command is n + f periods, with the
integer part n. X is the state of the robot, whose first entry is the position, A the state matrix for time in sampling
periods, u_k the command of sample k, and Gamma(t) the state at the time t after a unit command from rest. The state at
the next sample is exact (docs/theory/admittance.md, W2):

    X_(k+1) = e^A X_k + Gamma(1 - f) u_(k-n) + (Gamma(1) - Gamma(1 - f)) u_(k-n-1)
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.types import ArrayLike
from zwidth.model.checks import check_span, read_texts
from zwidth.numerics.evaluate import as_float64
from zwidth.plant.sampled_states import sample_states
from zwidth.units.display import compact_repr

if TYPE_CHECKING:
    from zwidth.analysis.admittance import AdmittanceDisplay

MAX_PERIODS = 10_000_000  # largest number of simulated periods; a million periods take 1.5 minutes


@compact_repr(time="s", position="m", velocity="m/s", force="N", virtual_velocity="m/s", command="")
class AdmittanceMotion(NamedTuple):
    """The motion of an admittance display at its samples, as arrays with one entry per sample."""

    time: np.ndarray  # k T in s
    position: np.ndarray  # position of the robot in m; 0 where the spring of the environment exerts no force
    velocity: np.ndarray  # velocity of the robot in m/s just before the sample; NaN for a discrete-time model
    force: np.ndarray  # measured contact force f_k in N
    virtual_velocity: np.ndarray  # velocity of the virtual mass in m/s, after the force f_k has changed it
    command: np.ndarray  # command that the program sends: position in m, or velocity in m/s


def simulate(
    display: AdmittanceDisplay,
    environment_stiffness: Any,
    environment_damping: Any = 0.0,
    *,
    duration: Any = "1 s",
    force: ArrayLike = 1.0,
) -> AdmittanceMotion:
    """Simulate the motion of the display in contact with an environment, under the force of a hand.

    At the time 0 everything is at rest at the position 0. The hand then pulls the robot with a given force in the
    positive direction. The force sensor measures the sum of this force and that of the environment. With a constant
    force, a stable contact comes to rest at ``force/K``.

    Args:
        environment_stiffness: K in N/m, >= 0.
        environment_damping: B in N s/m, >= 0.
        duration: duration in s, or a string such as "500 periods".
        force: force of the hand in N, a constant or an array with one value per sample.

    Returns:
        The motion at the samples from 0 to the duration.

    Raises:
        InputError: an argument is out of range, or the number of forces differs from the number of samples.

    References:
        Franklin, Powell, Workman 1998, Digital Control of Dynamic Systems, chapter 4 (systems with a delayed hold).

    Example:
        >>> import zwidth
        >>> robot, timing = zwidth.Actuator(time_constant="5 ms"), zwidth.Timing(rate="1 kHz", delay="2 periods")
        >>> display = zwidth.AdmittanceDisplay(5, 20, robot, timing)
        >>> motion = display.simulate("1 kN/m", duration="20 s", force="5 N")
        >>> print(f"{1e3 * motion.position[-1]:.3f} mm")
        5.000 mm
    """
    K, B = display._read_environment(environment_stiffness, environment_damping)
    loop, T = display.loop, float(display.timing.period)
    loop.check_damper(B)
    count = _count_periods(duration, T) + 1
    unit = display.unit_system["N"]
    forces = as_float64("force", read_texts("force", force, unit))
    if forces.shape not in ((), (count,)):
        raise InputError(f"force: got an array of shape {forces.shape}; pass one number, or one per sample ({count})")
    rows = _run(display, K, B, np.broadcast_to(forces, count))
    result = AdmittanceMotion(np.arange(count) * T, *np.array(rows, float).reshape(count, -1).T)
    if loop.plant.dt:
        result = result._replace(velocity=np.full(count, np.nan))
    return display._label(result)


def _count_periods(duration: Any, period: float) -> int:
    """Return the integer number of periods in a duration; raise `InputError` if it is not in [1, MAX_PERIODS]."""
    count = int(np.floor(check_span("duration", duration).periods(period) + 1e-9))
    if not 1 <= count <= MAX_PERIODS:
        raise InputError(f"duration: got {duration!r}, {count} periods; it must be 1 to {MAX_PERIODS} periods")
    return count


def _run(display: AdmittanceDisplay, K: float, B: float, forces: np.ndarray) -> list[tuple[float, ...]]:
    """Return a list with position, velocity, contact force, virtual velocity and command of each sample."""
    loop, T = display.loop, float(display.timing.period)
    system = loop.make_system()
    states, (A, b, _) = sample_states(system), system.realize()
    newer = states.full if states.late is None else states.late
    older, n = states.full - newer, loop.n_delay
    X, commands = np.zeros(len(b)), deque([0.0] * (n + 1))  # commands u_(k-1) to u_(k-n-1), newest first
    step, rows = start_program(display), []
    with np.errstate(all="ignore"):
        for external in forces.tolist():
            position, velocity = float(X[0]), float(A[0] @ X + b[0] * commands[-1]) / T
            force = external - K * position - (B * velocity if B else 0.0)
            virtual_velocity, command = step(force)
            rows.append((position, velocity, force, virtual_velocity, command))
            commands.appendleft(command)
            X = X + states.psi @ X + newer * commands[n] + older * commands[n + 1]
            commands.pop()
    return rows


def start_program(display: AdmittanceDisplay) -> Any:
    """Return the program of a display as a function with internal states, which start at rest.

    The function must be called once per sample with the contact force. It returns the virtual velocity and the command
    (docs/theory/admittance.md, W1).
    """
    T, M, D = float(display.timing.period), float(display.virtual_mass), float(display.virtual_damping)
    is_trapezoidal, sends_velocity = display.integrator == "trapezoidal", display.command == "velocity"
    v = a = reference = 0.0

    def step(force: float) -> tuple[float, float]:
        nonlocal v, a, reference
        last_v, last_a = v, a
        a = (force - D * v) / M
        v += T * (a + last_a) / 2.0 if is_trapezoidal else T * a
        reference += T * (v + last_v) / 2.0 if is_trapezoidal else T * v
        return v, v if sends_velocity else reference

    return step
