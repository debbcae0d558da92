"""A device from a log of its free motion under a commanded force."""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth._types import ArrayLike
from zwidth.errors import InputError
from zwidth.fitting.device_fit import MASS_OPEN, VAGUE, DeviceFit, FittedMotion, StiffnessEstimate, in_si, scene_of
from zwidth.fitting.moving import Recording, Recordings
from zwidth.fitting.recordings import Log, read_logs
from zwidth.formatting import plain, with_unit
from zwidth.parts.checks import check_number
from zwidth.parts.velocity import BackwardDifference, Velocity
from zwidth.status import Status

# Dampings b T/m and steps of the delay, in periods, that are started from, and how many of the best.
_DELTAS, _STEP, _STARTS = (3e-4, 3e-3, 0.02, 0.1, 0.4, 1.5, 5.0), 0.5, 3
# So many positions of each log choose them.
_BEGINNING = 2500
_ARRIVED = 1e-13
# By default the longest delay, in periods.
_LONGEST = 20
# The masses of devices, in kg: outside a unit is suspected.
_LIGHTEST, _HEAVIEST = 2e-3, 20.0
# A slope of less than so many of its standard errors is none.
_SEEN = 5.0
# Residuals of noise are hardly correlated from sample to sample.
_CORRELATED = 0.2
# Smaller residuals, as a share of the way moved, are rounding.
_EXACT = 1e-9


def fit_log(
    time: ArrayLike,
    position: ArrayLike,
    force: ArrayLike,
    *,
    velocity: Velocity | None = None,
    max_delay: Any = None,
) -> DeviceFit:
    """Find mass, damping and delay from a log of free motion under a force that a computer commands.

    ``m x'' + b x' = F(t - t_d) + f0``, the force held from sample to sample, least squares of the positions; f0 only
    where the log asks for it.

    Args:
        time: of the samples in s, evenly spaced, or their period alone. With lists of arrays for all three, several
            logs of one device.
        position: measured at the samples, in m.
        force: commanded at the samples, in N, positive towards growing positions.
        velocity: how the loop whose K_max is asked for estimates its velocity; the backward difference by default.
        max_delay: the longest delay looked for, in s; 20 periods by default. So much of the beginning serves only as
            past force.

    Returns:
        DeviceFit: ``mass``, ``damping``, ``delay``, their ``errors`` and ``covariance``; ``stiffness_max`` with
        ``stiffness_error``; ``intervals``, 95 %; ``noise`` of the position in m; ``residuals``; ``offset``; ``doubts``,
        as of a unit or of residuals that are no noise; ``status``: UNREACHABLE where the delay ends the range looked
        in, NOT_CONVERGED.

    Raises:
        InputError: times are uneven, the force or the position never changes, or the device runs away from its force.

    Numerics:
        Exact discretization for delays of any length, exact derivatives, SciPy's least squares within bounds: a log of
        10,000 samples takes some 0.4 s, and unlike in JAX nothing is compiled for its length. In 1,000 trials with
        white noise the intervals of m, b, t_d and K_max held the true value in 97.0, 94.8, 96.1 and 95.8 %. Errors
        allow for residuals that are alike from sample to sample, up to twice the cube root of the samples, yet with an
        encoder of 2,000 steps over the way moved, and no noise, it was 89 to 92 % only (200 trials).

    References:
        Ljung 1999, System Identification, section 4.2 (output error). Hulin, Preusche, Hirzinger 2006, eq. (9).

    Example:
        >>> import numpy as np
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 2), zwidth.Timing(period=1e-3))
        >>> push = np.where(np.arange(400) % 60 < 30, 1.0, -1.0)
        >>> motion = zwidth.simulate(scene, 0.0, 0.0, push_history=push, periods=400)
        >>> fit = zwidth.fit_log(1e-3, motion.position[:400], push)
        >>> print(f"{fit.mass * 1e3:.1f} g, {fit.damping:.2f} N s/m")
        100.0 g, 2.00 N s/m
    """
    velocity = BackwardDifference() if velocity is None else velocity
    logs, period = read_logs(time, position, force)
    longest = _LONGEST if max_delay is None else check_number("max_delay", max_delay, "s") / period
    skip = int(np.ceil(longest)) + 2
    recordings = tuple(log.recording(skip, k) for k, log in enumerate(logs))
    pushed = _fit(Recordings(recordings, True), _starts(recordings, longest), longest)
    plainly = _fit(Recordings(recordings, False), [pushed[1][:-1]], longest)
    count = plainly[0].measured.size
    # One more number has to lower Schwarz's criterion.
    better = count * np.log(max(pushed[2], _floor(pushed[0])) / max(plainly[2], _floor(plainly[0]))) + np.log(count) < 0
    model, theta, squares, arrived = pushed if better else plainly
    _refuse_unmoved(model, theta, squares, period)
    places, slopes = model.predict(theta)
    residuals = model.measured - places
    variance = squares / max(1, count - theta.size)
    sizes = np.linalg.norm(slopes, axis=0)
    scaled = slopes / np.where(sizes > 0, sizes, 1.0)
    spread = variance * _inflation(residuals) * np.linalg.pinv(scaled.T @ scaled) / np.outer(sizes, sizes)
    values, by_theta = in_si((np.log(period**2 / theta[0]), theta[1], theta[2]), period)
    # From g = T^2/m to ln m.
    by_theta = by_theta @ np.diag([-1.0 / theta[0], 1.0, 1.0])
    covariance = by_theta @ spread[:3, :3] @ by_theta.T
    stiffest = StiffnessEstimate.at(scene_of(values, period, velocity))
    errors = np.sqrt(np.diag(covariance))
    doubts = _doubts(values, errors, residuals, logs)
    status = Status.OK if arrived else Status.NOT_CONVERGED
    if theta[2] > longest - 1e-3:
        status = Status.UNREACHABLE
        doubts.append(
            f"the delay ends the range looked in, {with_unit(longest * period, 's')}; give a longer max_delay"
        )
    return stiffest.conclude(
        covariance,
        noise=float(np.sqrt(variance)),
        residuals=(rest := _place(residuals, logs, skip)),
        motions=_beside(rest, logs, period),
        doubts=doubts,
        status=status,
        offset=float(theta[-1] / theta[0]) if better else 0.0,
    )


def _floor(model: Recordings) -> float:
    """What rounding alone leaves of squares."""
    return model.measured.size * (1e-13 * float(np.abs(model.measured).max())) ** 2


def _starts(recordings: tuple[Recording, ...], longest: float) -> list[np.ndarray]:
    """The best of a grid over damping and delay, where the rest is linear; by the beginnings of the logs."""
    model = Recordings(tuple(log.begin(_BEGINNING) for log in recordings), True)
    grid = [(delta, d) for delta in _DELTAS for d in np.arange(0.0, longest + 0.5 * _STEP, _STEP)]
    starts: list[np.ndarray] = []
    for theta, _ in sorted((model.project(*at) for at in grid), key=lambda found: found[1]):
        if all(abs(theta[2] - other[2]) > 2 * _STEP or theta[1] != other[1] for other in starts):
            starts.append(theta)
    return starts[:_STARTS]


def _fit(model: Recordings, starts: list[np.ndarray], longest: float) -> tuple[Recordings, np.ndarray, float, bool]:
    """Least squares from several starts; neither damping nor delay is negative."""
    best = min((_refine(model, start, longest, ()) for start in starts), key=lambda found: found[1])
    held: tuple[int, ...] = ()
    while any(best[0][k] < 0 for k in (1, 2)):
        held = tuple(k for k in (1, 2) if k in held or best[0][k] < 0)
        best = _refine(model, best[0], longest, held)
    return model, *best


def _refine(
    model: Recordings, start: np.ndarray, longest: float, held: tuple[int, ...]
) -> tuple[np.ndarray, float, bool]:
    from scipy.optimize import least_squares

    free = [k for k in range(start.size) if k not in held]
    theta = start.copy()
    theta[list(held)] = 0.0
    # In units in which each number moves the positions alike.
    sizes = np.linalg.norm(model.predict(theta)[1], axis=0)[free]
    sizes = 1.0 / np.where(sizes > 0, sizes, 1.0)
    count = max(log.force.size for log in model.logs)
    low, high = np.full(start.size, -np.inf), np.full(start.size, np.inf)
    # A little beyond 0 the model goes on, so that an optimum at 0 is no corner.
    low[1], low[2], high[1], high[2] = -5.0 / count, -1.0, 50.0, longest
    theta[1:3] = np.clip(theta[1:3], low[1:3], high[1:3] - 1e-6)

    def at(values):
        whole = theta.copy()
        whole[free] = values * sizes
        return whole

    unit = float(np.std(model.measured)) or 1.0
    solution = least_squares(
        lambda values: (model.predict(at(values))[0] - model.measured) / unit,
        theta[free] / sizes,
        lambda values: model.predict(at(values))[1][:, free] * sizes / unit,  # pyright: ignore[reportArgumentType]
        bounds=(low[free] / sizes, high[free] / sizes),
        x_scale="jac",
        xtol=_ARRIVED,
        ftol=_ARRIVED,
        gtol=_ARRIVED,
        max_nfev=200,
    )
    return at(solution.x), 2.0 * float(solution.cost) * unit**2, solution.status > 0


def _refuse_unmoved(model: Recordings, theta: np.ndarray, squares: float, period: float) -> None:
    """Raise `InputError` where the force explains nothing of the motion, or the contrary of it."""
    alone = model.columns(theta[1], theta[2])[:, 1:]
    sizes = np.linalg.norm(alone, axis=0)
    rest = model.measured - alone / sizes @ np.linalg.lstsq(alone / sizes, model.measured, rcond=None)[0]
    if float(rest @ rest) - squares <= _SEEN**2 * squares / model.measured.size:
        raise InputError(
            "force: the position does not follow it; check that both columns are of the same axis, and that nothing "
            "holds the device"
        )
    if theta[0] <= 0:
        raise InputError(
            f"force: the device runs away from it, as if its mass were {with_unit(1e3 * period**2 / theta[0], 'g')}; "
            "turn the sign of the force, or of the position"
        )


def _inflation(residuals: np.ndarray) -> float:
    """By how much neighbors that are alike make variances larger than those of white noise: 1 + 2 sum of correlations.

    Weighed by Bartlett's triangle over twice the cube root of the samples.
    """
    count, size = residuals.size, float(residuals @ residuals)
    if size == 0:
        return 1.0
    reach = int(2 * np.ceil(count ** (1 / 3)))
    alike = [(1 - k / (reach + 1)) * float(residuals[k:] @ residuals[:-k]) / size for k in range(1, reach + 1)]
    return max(1.0, 1.0 + 2.0 * sum(alike))


def _doubts(values: np.ndarray, errors: np.ndarray, residuals: np.ndarray, logs: tuple[Log, ...]) -> list[str]:
    mass, damping, delay = values
    doubts = []
    if not _LIGHTEST <= mass <= _HEAVIEST:
        slip = "the position may be in mm, or the force in kN" if mass < _LIGHTEST else "the force may be in mN"
        doubts.append(f"a mass of {with_unit(1e3 * mass, 'g')} is far from any device; {slip}: m, N and s are meant")
    if errors[0] > VAGUE * mass:
        doubts.append(MASS_OPEN)
    size = float(residuals @ residuals)
    if size <= _EXACT**2 * residuals.size * max(float(np.ptp(log.position)) for log in logs) ** 2:
        # Nothing but rounding is left.
        return doubts
    if damping == 0:
        doubts.append("the damping is 0 at best: a negative one would fit better")
    elif errors[1] > VAGUE * damping:
        span = max(log.force.size for log in logs)
        doubts.append(
            f"the damping is hardly seen, its standard error is {with_unit(errors[1], 'N s/m', 2)}; record longer than "
            f"these {span} samples, or let the device run faster"
        )
    if delay == 0:
        doubts.append("the delay is 0 at best: the position would have to precede the force to fit better")
    near = float(residuals[1:] @ residuals[:-1]) / size
    if near > _CORRELATED and near > _SEEN / np.sqrt(residuals.size):
        doubts.append(
            f"what the fit leaves is no noise (neighbors correlate by {plain(near, 2)}), and the errors may be too "
            "small; look for friction, a compliance, a hand that holds the device, or coarse steps of the encoder"
        )
    return doubts


def _beside(residuals: np.ndarray, logs: tuple[Log, ...], period: float) -> tuple[FittedMotion, ...]:
    """Every log beside its fit."""
    parts = np.split(residuals, np.cumsum([log.force.size for log in logs])[:-1])
    return tuple(
        FittedMotion(period * np.arange(rest.size), log.force, log.position, log.position - rest)
        for log, rest in zip(logs, parts, strict=True)
    )


def _place(residuals: np.ndarray, logs: tuple[Log, ...], skip: int) -> np.ndarray:
    """Residuals at their samples, one log after the other."""
    parts, first = [], 0
    for log in logs:
        count = log.force.size - skip
        parts += [np.full(skip, np.nan), residuals[first : first + count]]
        first += count
    return np.concatenate(parts)
