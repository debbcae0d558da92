"""Identify causes of motion that a fitted model lacks: gravity, a spring, a wrong sign, a rounded force column.

Two functions test for these causes:

- `explain_motion` treats logs to which no device can be fitted. It multiplies the equation of motion by test functions,
  integrates by parts (weak form), and determines its coefficients by linear regression.
- `explain_residuals` treats fits whose residuals are not white noise. It computes the share of the residual sum of
  squares that the response to one further force explains.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.identification.friction_model import Recording
from zwidth.identification.output_error import FittedModel
from zwidth.identification.quantization_noise import find_steps
from zwidth.units.formatting import plain, with_unit
from zwidth.units.unit_system import UnitSystem

# Constants of the regression on the weak form (`explain_motion`).
# Lengths of the test functions, in samples. The effect of position errors decreases as 1/length^2.
_WINDOWS = (32, 128)
_MIN_WINDOWS = 12  # least number of half-overlapping test functions that fit into a log
# A wrong sign of the force or position is reported if the fitted mass is negative and the regression explains most of
# the acceleration: its residual sum of squares is less than this share of the total sum of squares.
_SIGN = 0.3
# A spring or gravity is reported if adding it to the model reduces the residual sum of squares to less than this share.
_EXPLAINED = 0.25

# Constants of the test of residuals (`explain_residuals`).
_SHARE = 0.5  # a force is reported as the cause if it explains more than this share of the residual sum of squares
# Share of the residual sum of squares above which rounding errors of the force are reported as the cause. It is smaller
# than `_SHARE`, because the size of rounding errors is computed and not fitted.
_ROUNDING_SHARE = 0.2
_TRIALS = 4  # number of random draws of the rounding errors, over which their effect is averaged
_MIN_LEVELS = 8  # least number of distinct forces; a force with fewer values is not tested for rounding
_MIN_STEP = 2e-4  # least rounding step that is tested, relative to the largest force


class Cause(NamedTuple):
    """The identified cause of a motion that the logged force does not explain."""

    text: str  # the cause as a clause for a message; "" if no cause was identified
    reversed: bool = False  # True if the force or the position has the wrong sign


def explain_motion(logs: tuple[Recording, ...], period: float, system: UnitSystem) -> Cause:
    """Identify the cause of a motion that the logged force F does not explain, by linear regression on the weak form.

    In sampling periods, the equation of motion is ``x'' = g F - delta x' + o + e(x)`` with the position x, the
    reciprocal mass g, the damping delta, the acceleration o by a constant force and the acceleration e(x) by a spring
    or gravity. Integration by parts removes the derivatives of the measured x. The delay is neglected, because it is
    short compared with the test functions.

    Args:
        logs: the logs of one device.
        period: sampling period in s.
        system: units of position and force.
    """
    best = Cause("")
    lowest = np.inf
    for window in _WINDOWS:
        rows = [integrals for log in logs if (integrals := _integrate(log, window)) is not None]
        if not rows:
            continue
        acceleration, force, speed, constant, position, sine, cosine = np.concatenate(rows, axis=1)
        total = float(acceleration @ acceleration)
        free, squares = _fit_columns(acceleration, [force, speed, constant])
        spring, with_spring = _fit_columns(acceleration, [force, speed, constant, position])
        gravity, with_gravity = (
            _fit_columns(acceleration, [force, speed, constant, sine, cosine]) if system.rotary else (None, np.inf)
        )
        if min(with_spring, with_gravity) < min(lowest, _EXPLAINED * squares):
            lowest = min(with_spring, with_gravity)
            if gravity is not None and gravity[0] > 0 and with_gravity < 0.5 * with_spring:
                size = float(np.hypot(*gravity[3:])) / gravity[0]
                best = Cause(f"gravity also moves the device, with a torque of up to {with_unit(size, system['N'], 3)}")
            elif spring[0] > 0:
                stiffness = -spring[3] / spring[0]
                size = f"{'-' if stiffness < 0 else ''}{with_unit(abs(stiffness), system['N/m'], 3)}"
                best = Cause(f"a spring or gravity of about {size} also moves the device")
        if not best.text and free[0] < 0 and squares < _SIGN * total:
            best = Cause("", reversed=True)
    return best


def _integrate(log: Recording, window: int) -> np.ndarray | None:
    """Integrate each term of the equation of motion, multiplied by test functions of length ``window``, over a log.

    Returns:
        An array with one row per term (acceleration, force, velocity, constant, position, sine of the position, cosine
        of the position) and one column per test function. Successive test functions start a quarter of the window
        apart. None if the log is too short.
    """
    count = log.position.size
    if count < (_MIN_WINDOWS + 1) * window // 2:
        return None
    phase = np.pi * (np.arange(window + 1) / window)
    # Use sin^4 as test function, because it and its first derivative vanish at the ends, so that the integration by
    # parts has no boundary terms.
    function = np.sin(phase) ** 4
    derivative = 4.0 * np.sin(phase) ** 3 * np.cos(phase) * np.pi / window
    second_derivative = (12.0 * np.sin(phase) ** 2 * np.cos(phase) ** 2 - 4.0 * np.sin(phase) ** 4) * (
        np.pi / window
    ) ** 2
    x, force = log.position - log.position.mean(), log.force[log.skip :][:count]
    columns = [(second_derivative, x), (function, force), (-derivative, x), (function, np.ones(count)), (function, x)]
    columns += [(function, np.sin(log.position)), (function, np.cos(log.position))]
    return np.array([np.convolve(values, weight[::-1], "valid")[:: window // 4] for weight, values in columns])


def _fit_columns(wanted: np.ndarray, columns: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Fit a vector by a linear combination of columns; return its coefficients and the residual sum of squares."""
    matrix = np.array(columns).T
    sizes = np.linalg.norm(matrix, axis=0)
    sizes = np.where(sizes > 0, sizes, 1.0)
    values = np.linalg.lstsq(matrix / sizes, wanted, rcond=None)[0]
    residuals = wanted - matrix / sizes @ values
    return values / sizes, float(residuals @ residuals)


def explain_residuals(best: FittedModel, system: UnitSystem) -> str:
    """Return the cause of residuals that are not white noise, as a clause for a message; "" if none is identified."""
    derivatives = best.response.derivatives
    basis = np.linalg.qr(derivatives / np.maximum(np.linalg.norm(derivatives, axis=0), 1e-300))[0]
    left = best.residuals - basis @ (basis.T @ best.residuals)
    squares = float(left @ left)
    # Test for rounding first, because the response to rounding errors drifts and resembles that of a weak spring.
    if rounded := _explain_rounding(best, basis, squares, system):
        return rounded

    def explain(*accelerations: list[np.ndarray]) -> float:
        """Return the share of the residual sum of squares that the responses to ``accelerations`` explain."""
        columns = np.array([_simulate_accelerations(best, each) for each in accelerations]).T
        columns = columns - basis @ (basis.T @ columns)
        return 1.0 - _fit_columns(left, list(columns.T))[1] / squares

    places = [log.position - log.position.mean() for log in best.model.logs]
    spring = explain([-each for each in places])
    if system.rotary and max(map(np.ptp, places)) > 0.5:
        gravity = explain(*([function(log.position) for log in best.model.logs] for function in (np.sin, np.cos)))
        if gravity > _SHARE and gravity > spring + 0.1:
            return "they depend on the angle, as gravity would cause"
    # Do not report the stiffness of the spring, because its estimate would be biased: the fitted friction has already
    # absorbed a part of the spring force.
    if spring > _SHARE:
        return "they depend on the position, as a weak spring, a cable or gravity would cause"
    return ""


def _simulate_accelerations(best: FittedModel, accelerations: list[np.ndarray]) -> np.ndarray:
    """Simulate the positions of a mass without friction that starts at rest and moves under given accelerations.

    Args:
        best: fitted model; only its damping and its logs are used.
        accelerations: for each log an array of accelerations in m per squared sampling period, one per position.

    Returns:
        The positions of all logs, joined into one array.
    """
    delta = float(best.theta[1])
    moved = []
    for log, acceleration in zip(best.model.logs, accelerations, strict=True):
        force = np.concatenate([np.full(log.skip, acceleration[0]), acceleration])
        moved.append(Recording(force, log.position, log.skip).move(1.0, delta, 0.0).position)
    return np.concatenate(moved)


def _explain_rounding(best: FittedModel, basis: np.ndarray, squares: float, system: UnitSystem) -> str:
    """Return a clause that names the rounding of the force column as the cause of the residuals; "" if it is not.

    The expected effect of the rounding is the mean over random rounding errors, simulated with the fitted mass.

    Args:
        best: fitted model.
        basis: orthonormal basis of the position changes that a change of the fitted parameters can produce.
        squares: residual sum of squares.
        system: units of the force.

    Returns:
        A clause for a message if the rounding explains residuals of this size, "" otherwise.
    """
    forces = np.concatenate([log.force for log in best.model.logs])
    step, largest = find_steps(forces)[1], best.model.largest_force
    if step < _MIN_STEP * largest or np.unique(forces).size < _MIN_LEVELS:
        return ""
    rng, expected = np.random.default_rng(0), []
    for _ in range(_TRIALS):
        accelerations = []
        for log in best.model.logs:
            force = log.force[log.skip :][: log.position.size]
            # Draw one rounding error for each run of successive equal forces, because equal forces have equal rounding
            # errors.
            run = np.append(0, np.cumsum(np.diff(force) != 0))
            accelerations.append(best.theta[0] * rng.uniform(-0.5 * step, 0.5 * step, run[-1] + 1)[run])
        moved = _simulate_accelerations(best, accelerations)
        moved = moved - basis @ (basis.T @ moved)
        expected.append(float(moved @ moved))
    if np.mean(expected) < _ROUNDING_SHARE * squares:
        return ""
    percent, rounded = plain(100.0 * step / largest, 1), with_unit(step, system["N"], 3)
    return (
        f"the force column is rounded to {rounded}, {percent} % of its largest value, which alone "
        "accounts for residuals of this size"
    )
