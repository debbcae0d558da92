"""The motion of the device over which a wall that is not passive gives energy (docs/theory/simulation.md, T8).

Who moves the device holds it together: its position is prescribed, from rest at 0. Between two instants at which the
held force changes the least energy is taken by a constant velocity. Found by frequency, from Colgate's condition; the
energy is then summed in time, of the motion that is returned, which shares nothing with the condition.
"""

from __future__ import annotations

from itertools import zip_longest
from typing import NamedTuple

import numpy as np

from zwidth.loops.linear.passivity import PassivityCondition, find_need
from zwidth.parts.velocity import Estimate
from zwidth.parts.wall import resolve_wall
from zwidth.scenes.answers import SceneAnswers, one_wall
from zwidth.scenes.base import of_scene
from zwidth.words.showing import shown
from zwidth.words.status import Status

# Periods that are tried.
_SHORTEST, _LONGEST = 8, 1 << 20
# The largest sampled position, in m.
_PEAK = 1e-3
# Eight rounding errors of each term; a filter's own are seen where it is given the same motion at another scale.
_ROUNDING, _SCALE, _SEEN = 2.0**-49, 0.7, 8.0
# By how much what one motion misses may exceed what the condition asks for: rounding of either.
_ROUNDED = 1e-9
# A share of what a filter has been given that no sum shows.
_FORGOTTEN = 1e-30
# Needs that differ by rounding, as a share.
_SAME = 1.0 - 1e-14


@shown(time="s", position="m", velocity="m/s", force="N", energy="J", missing_damping="N s/m", frequency="Hz")
class WorstMotion(NamedTuple):
    """A motion of the device over which its own damping and the wall give more energy than they take.

    ``velocity[i]`` and ``force[i]`` hold from ``time[i]`` to ``time[i + 1]``, the last ones from then on.
    """

    time: np.ndarray  # s; the samples, and with a delay of parts of a period the instants at which forces arrive
    position: np.ndarray  # m
    velocity: np.ndarray  # m/s
    force: np.ndarray  # N, the wall's on the device
    energy: np.ndarray  # J put in by who moves it, up to each time; the last one is negative
    missing_damping: float  # N s/m that would take all of it from this motion: -energy/integral of v^2 dt
    frequency: float  # Hz
    status: Status


@of_scene
def worst_motion(
    scene: SceneAnswers, stiffness: float | None = None, virtual_damping: float | None = None
) -> WorstMotion:
    """Return a motion over which device and wall give energy, the proof that the wall is not passive.

    ``energy = integral (b v^2 - F_wall v) dt < 0`` from rest at x = 0; afterwards the device is held still.

    Args:
        scene: a `zwidth.Scene`, with the sensor where the wall's force acts. Its hand is left out: the motion is
            prescribed.
        stiffness: K of the wall in N/m, one number; the scene's own wall where neither is given.
        virtual_damping: B of the wall in N s/m, one number.

    Returns:
        `WorstMotion`: ``time``, ``position``, ``velocity``, ``force``, ``energy``, arrays of one length. The largest
        sampled position is 1 mm; energy goes by its square. ``missing_damping`` does not depend on that size and is at
        most ``-scene.passivity_margin``, which longer motions approach; no damping makes a wall of negative stiffness
        passive, and there it is that of the shortest push that gives energy. ``frequency`` is where the wall needs
        the most damping, one of several such; 0 for a push into a wall of negative stiffness. ``status``: OK;
        UNREACHABLE where no motion gives energy (``passivity_margin`` >= 0); NOT_CONVERGED where none that was
        tried does so beyond rounding; OUT_OF_RANGE; these with NaN in arrays of length 1.

    Raises:
        InputError: no passivity condition is known for the device; the wall is not one of finite numbers, or not said.

    Numerics:
        A sinusoid at that frequency under a window, of 8, 16, ... periods, until it gives energy: some 3 to 9
        ``sqrt(M''/excess)`` periods, M(w) the damping that a turn w a period needs, excess the lack of it. Some ms,
        0.1 s for 100,000 periods, seconds before all have failed behind a filter of order 8. The energy is summed with
        twice the digits; it must exceed what rounding can come to.

    References:
        Colgate, Schenkel 1994 (the condition).

    Example:
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period=1e-3, delay=1e-3))
        >>> motion = zwidth.worst_motion(scene, 8e3)
        >>> print(f"{motion.frequency:.0f} Hz, {1e6 * motion.energy[-1]:.2f} µJ")
        0 Hz, -435.13 µJ
    """
    given = resolve_wall(scene.wall, stiffness, virtual_damping)
    alpha, beta = one_wall(*scene.normalize_walls(*given))
    wall = np.asarray(given[0], float).item(), np.asarray(given[1], float).item()
    margin = float(scene.passivity_margin(*wall))
    if not margin < 0:
        return _no_motion(Status.UNREACHABLE if margin >= 0 else Status.OUT_OF_RANGE)
    condition = PassivityCondition.derive(scene.loop.chain.estimate, scene.d)
    stiff = alpha + beta * condition.spring
    needed, w = find_need(condition, alpha, beta)
    # The ends first: next to them the need is the same but for rounding.
    places = np.array([0.0, np.pi, w])
    needs = condition.needed(max(stiff, 0.0), beta, places)
    w, damping = float(places[np.argmax(needs >= needs.max() * _SAME)]), needed * scene.units.virtual_damping
    kinds = [(w, damping)] if damping > scene.device.damping else []
    # A push; between the samples as slow as at them.
    kinds += [(None, np.inf)] if stiff < 0 else []
    periods = _SHORTEST
    while periods <= _LONGEST:
        for w, damping in kinds:
            motion = _move(scene, wall, _sampled_position(w, periods), damping)
            if motion is not None and w is None:
                motion = _shorten_push(scene, wall, periods, motion)
            if motion is not None and motion.missing_damping <= -margin * (1.0 + _ROUNDED):
                return motion._replace(frequency=(w or 0.0) / (2.0 * np.pi * scene.timing.period))
        periods *= 2
    return _no_motion(Status.NOT_CONVERGED)


def _shorten_push(scene: SceneAnswers, wall: tuple[float, float], periods: int, motion: WorstMotion) -> WorstMotion:
    """The shortest push that gives energy: what a push needs has no end, it grows with its length."""
    low = 0
    while periods - low > 1:
        middle = (low + periods) // 2
        shorter = _move(scene, wall, _sampled_position(None, middle), np.inf)
        low, periods, motion = (middle, periods, motion) if shorter is None else (low, middle, shorter)
    return motion


def _no_motion(status: Status) -> WorstMotion:
    none = np.full(1, np.nan)
    return WorstMotion(none, none, none, none, none, np.nan, np.nan, status)


def _sampled_position(w: float | None, periods: int) -> np.ndarray:
    """A sinusoid that swells and fades like sin^2, or a push at a constant velocity."""
    k = np.arange(periods + 1)
    if w is None:
        return _PEAK * k / periods
    x = np.sin(np.pi * k / periods) ** 2 * np.cos(w * (k - periods // 2))
    x[-1] = 0.0
    return _PEAK * x / np.abs(x).max()


def _estimate_velocity(estimate: Estimate, x: np.ndarray) -> np.ndarray:
    """The estimate's difference equation, in units of the period, after rest at 0; exact sums, no recursion."""
    v = (x - _delay(x, estimate.window)) / estimate.window if estimate.window else x
    v = float(estimate.gain) * _delay(v, estimate.lag + estimate.poles.size - estimate.zeros.size)
    # In turns: what rounds off in front of a pole next to the circle, a zero next to it takes away.
    for zero, pole in zip_longest(estimate.zeros, estimate.poles):
        if zero is not None:
            v = v - (1.0 - zero) * _delay(v, 1)
        # The sum of the last 2, 4, 8, ... inputs, each p times the one behind it.
        power, reach = 0.0 if pole is None else 1.0 - pole, 1
        while reach < x.size and abs(power) > _FORGOTTEN:
            v = v + power * _delay(v, reach)
            power, reach = power * power, 2 * reach
    return np.real(v)


def _delay(values: np.ndarray, count: int) -> np.ndarray:
    """What was ``count`` samples ago, 0 before the first."""
    return np.concatenate([np.zeros(count, values.dtype), values])[: values.size]


def _move(scene: SceneAnswers, wall: tuple[float, float], x: np.ndarray, damping: float) -> WorstMotion | None:
    """The motion through these samples; None where it does not give energy for certain."""
    # Between them it bends, where a force arrives, as takes least energy under this damping.
    period, b = scene.timing.period, scene.device.damping
    estimate = scene.loop.chain.estimate
    estimated = _estimate_velocity(estimate, x)
    answer = wall[0] * x + wall[1] / period * estimated
    now, f = _delay(answer, scene.whole_delay), float(scene.d - scene.whole_delay)
    step = np.diff(x, append=x[-1])
    k = np.arange(x.size)
    time, position, lasting, force = k * period, x, np.array([period]), -now
    if f > 0:
        before = _delay(now, 1)
        bent = x + f * step - f * (1.0 - f) * period * (before - now) / (2.0 * damping)
        bent[-1] = x[-1]
        time, position, force = (
            np.stack(pair, -1).reshape(-1) for pair in ((time, (k + f) * period), (x, bent), (-before, -now))
        )
        lasting = np.array([f * period, (1.0 - f) * period])
    step = np.diff(position, append=position[-1])
    lasting = np.resize(lasting, step.size)
    velocity = step / lasting
    loss, work = b * velocity * step, force * step
    energy = _add_up(loss - work)
    # What rounding of the estimate, of the force and of its work can come to.
    error = _SEEN * np.abs(estimated - _estimate_velocity(estimate, _SCALE * x) / _SCALE).max()
    # The rounding of a pole moves what it remembers by as much a period.
    turns = 1 + (x.size if estimate.poles.size else 0)
    damper = abs(wall[1]) / period * (error + turns * _ROUNDING * np.abs(estimated).max())
    path = np.abs(step).sum()
    slack = _ROUNDING * (loss.sum() + abs(wall[0]) * _PEAK * path) + damper * path
    if not energy[-1] < -slack:
        return None
    missing = float(-energy[-1] / (velocity * step).sum())
    return WorstMotion(time, position, velocity, force, energy, missing, np.nan, Status.OK)


def _add_up(terms: np.ndarray) -> np.ndarray:
    """The sums of the terms before each, with what rounding left out of each sum added up as well."""
    sums = np.concatenate([[0.0], np.cumsum(terms[:-1])])
    before, added = sums[:-1], terms[:-1]
    # Of one sum of two numbers it is known exactly (Knuth).
    rounded = before + added
    part = rounded - before
    lost = (before - (rounded - part)) + (added - part)
    return sums + np.concatenate([[0.0], np.cumsum(lost)])
