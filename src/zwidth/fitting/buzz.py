"""A device from walls at the onset of buzzing: which stiffness, which damping, and the frequency that was heard."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zwidth.errors import InputError
from zwidth.fitting.buzzing import Onsets, needed_answer
from zwidth.fitting.device_fit import (
    MASS_OPEN,
    VAGUE,
    DeviceFit,
    FurtherExperiment,
    StiffnessEstimate,
    in_si,
    scene_of,
)
from zwidth.formatting import plain, with_unit
from zwidth.linear_loop import circle
from zwidth.parts.checks import check_number
from zwidth.parts.velocity import BackwardDifference, Velocity
from zwidth.scene import Scene
from zwidth.status import Status

# The dampings b T/m that are started from, and how many of the dips.
_DELTAS = np.concatenate([[0.0], np.geomspace(1e-4, 30.0, 45)])
_STARTS = 6
_NEARLY, _ARRIVED = 1e-4, 1e-12
# Dampings closer than this are one experiment; beyond this condition number some direction is not seen at all.
_SAME, _BLIND = 1e-6, 1e6
# An edge of the stable set lies between walls so much softer and stiffer.
_BESIDE = 1e-6
# Another device is as good where the sum of squares in units of the noise rises by less; worse than this by chance of
# 1e-4 the points contradict each other.
_AS_GOOD, _CHANCE = 5.99, 1e-4
_ANGLES = 240
# Relative noise that no record is better than, for telling exact points from equal ones.
_EXACT = 1e-12


class BuzzPoint(NamedTuple):
    """A wall at the onset of buzzing.

    Args:
        stiffness: K in N/m, raised at this damping until the wall buzzes.
        virtual_damping: B in N s/m.
        frequency: heard or measured, in Hz.
    """

    stiffness: float
    virtual_damping: float
    frequency: float


def fit_buzz(
    points: Iterable[Any],
    *,
    period: Any,
    velocity: Velocity | None = None,
    noise: float | tuple[float, float] | None = None,
) -> DeviceFit:
    """Find mass, damping and delay from walls at the onset of buzzing and their frequencies.

    On ``z = e^(j 2 pi f T)`` each wall gives two real equations, ``K + B F(z)/T = (m/T^2) q(z; b T/m, t_d/T)``, the
    closed form of `zwidth.boundary`. Two walls of different damping determine m, b and t_d; more are least squares of
    the relative deviations of K and f, with B exact.

    Args:
        points: walls, each (K in N/m, B in N s/m, f in Hz) or a `zwidth.BuzzPoint`; K > 0, 0 < f < 1/(2 T). At least
            two dampings.
        period: T in s.
        velocity: how the velocity was estimated; the backward difference by default.
        noise: relative standard deviation of K and f, one number or one for each. Left out, it is taken to be equal
            for both and is estimated from the residuals, which two or three walls hardly determine.

    Returns:
        DeviceFit: ``mass``, ``damping``, ``delay``, their ``errors`` and ``covariance``; ``stiffness_max`` with
        ``stiffness_error``; ``intervals``, 95 %; ``residuals``; ``doubts``; ``next``, the experiment that narrows K_max
        most; ``status``: UNDECIDED where another device fits as well (told in ``doubts``), NO_BOUNDARY where the walls
        do not lie on the edge of its stable set.

    Raises:
        InputError: a number is impossible, or an experiment is missing, which the message names.

    Numerics:
        Levenberg and Marquardt (SciPy's: three unknowns, nothing to compile) from the dips over damping and delay;
        exact walls give the device back to about 1e-12. Errors are linear in the noise: with 2 % of K and f and four
        walls, the intervals of m, b, t_d and K_max held the true value on 94.7, 94.9, 95.0 and 95.9 % of 1,000 random
        devices, of which 8 % were UNDECIDED; 4 % more, strongly damped, were refused.

    References:
        Hulin, Preusche, Hirzinger 2006, section V (the boundary). Boggs, Rogers 1990 (errors in both coordinates).

    Example:
        >>> import zwidth
        >>> heard = [(6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)]
        >>> fit = zwidth.fit_buzz(heard, period="1 ms", noise=0.02)
        >>> print(f"{fit.mass * 1e3:.0f} g")
        100 g
    """
    period = check_number("period", period, "s", low_open=True)
    velocity = BackwardDifference() if velocity is None else velocity
    table = _read(points, period)
    share = _read_noise(noise)
    onsets = Onsets(
        table[:, 0] * period**2, table[:, 1] * period, 2 * np.pi * table[:, 2] * period, velocity.estimate(period)
    )
    weights = 1.0 / np.array(share or (1.0, 1.0))
    found = _candidates(onsets, weights)
    freedom = 2 * len(table) - 3
    doubts: list[str] = []
    on_edge = [fit for fit in found if fit.found and _at_edge(onsets, fit, period, velocity)]
    best, status = (on_edge or found)[0], Status.OK if on_edge else Status.NO_BOUNDARY
    if not on_edge:
        doubts.append(
            "the walls do not lie on the edge of this device's stable set: they began to buzz before or later"
        )
    scale = 1.0 if share else max(best.squares / freedom, _EXACT**2)
    if share and best.squares > _unlikely(freedom):
        doubts.append(
            f"the walls contradict each other: they are {plain(np.sqrt(best.squares / freedom), 2)} times as far from "
            "this device as their noise explains; look for friction, a compliance or a hand that holds it"
        )
    slopes = _weigh(onsets.follow(best.theta)[2], weights)
    _refuse_blind(slopes, best.theta, table)
    information = slopes.T @ slopes / scale
    for other in on_edge[1:]:
        away = other.theta - best.theta
        # Not along the flat floor of the same valley.
        if other.squares - best.squares < _AS_GOOD * scale < away @ information @ away * scale:
            values = in_si(other.theta, period)[0]
            doubts.append(f"another device fits as well: {_describe(values)}; add the experiment named next")
            status = Status.UNDECIDED
            break
    values, by_theta = in_si(best.theta, period)
    covariance = by_theta @ np.linalg.inv(information) @ by_theta.T
    if covariance[0, 0] > (VAGUE * values[0]) ** 2:
        doubts.append(MASS_OPEN)
    if best.squares > _EXACT:
        doubts += [f"the {name} is 0 at best: a negative one would fit better" for name in best.held]
    stiffest = StiffnessEstimate.at(scene_of(values, period, velocity))
    return stiffest.conclude(
        covariance,
        noise=share or (float(np.sqrt(scale)), float(np.sqrt(scale))),
        residuals=best.residuals / np.sqrt(scale),
        doubts=doubts,
        status=status,
        freedom=None if share else freedom,
        further=_further(stiffest, best.theta, information, stiffest.gradient @ by_theta, weights / np.sqrt(scale)),
    )


def _describe(values: np.ndarray) -> str:
    mass, damping, delay = values
    return f"m = {with_unit(mass * 1e3, 'g')}, b = {with_unit(damping, 'N s/m')}, t_d = {with_unit(delay, 's')}"


def _read(points: Iterable[Any], period: float) -> np.ndarray:
    """The walls as an array; an impossible one is refused, and so are walls of one damping."""
    rows = []
    for k, point in enumerate(points):
        try:
            row = [float(value) for value in point]
        except (TypeError, ValueError):
            row = []
        if len(row) != 3 or not np.all(np.isfinite(row)):
            raise InputError(f"points[{k}]: got {point!r}; give K in N/m, B in N s/m and f in Hz, as (6e3, 0, 37.6)")
        if not row[0] > 0:
            raise InputError(f"points[{k}].stiffness: got {row[0]:g} N/m; it must be greater than 0 to buzz")
        if not 0 < row[2] < 0.5 / period:
            raise InputError(
                f"points[{k}].frequency: got {row[2]:g} Hz; it must be greater than 0 and less than half the sampling "
                f"rate, {plain(0.5 / period)} Hz: check the frequency, or the period"
            )
        rows.append(row)
    if not rows:
        raise InputError("points: got none; raise K at B = 0 until the wall buzzes, and again at another B")
    table = np.array(rows)
    # A force over a velocity: the dampings that matter are of this size.
    unit = table[0, 0] / (2 * np.pi * table[0, 2])
    if np.ptp(table[:, 1]) <= _SAME * max(unit, np.abs(table[:, 1]).max()):
        count = (
            "one wall gives two equations for" if len(table) == 1 else f"{len(table)} walls of one damping cannot tell"
        )
        raise InputError(
            f"points: {count} the three unknowns m, b and t_d; what is missing is a wall of another damping: raise K "
            f"at B = {with_unit(table[0, 1] + 0.4 * unit, 'N s/m', 2)}, say, until it buzzes"
        )
    return table


def _read_noise(noise: Any) -> tuple[float, float] | None:
    if noise is None:
        return None
    try:
        pair = np.broadcast_to(np.asarray(noise, float), (2,))
    except ValueError:
        pair = np.zeros(2)
    if not np.all((pair > 0) & (pair < 1)):
        raise InputError(f"noise: got {noise!r}; give the relative noise of K and f, as 0.02, or (0.03, 0.01)")
    return float(pair[0]), float(pair[1])


class _Candidate(NamedTuple):
    theta: np.ndarray
    squares: float
    residuals: np.ndarray
    held: tuple[str, ...]
    found: bool


def _weigh(slopes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return (slopes * weights[:, None]).reshape(-1, 3)


def _candidates(onsets: Onsets, weights: np.ndarray) -> list[_Candidate]:
    """Local best fits, the best first. Where damping or delay would be negative, it is held at 0."""
    found: list[_Candidate] = []
    # Half a turn over the delay, and some more for noise.
    for start in onsets.starts(_DELTAS, 1.2 * np.pi / float(onsets.w.max()), _STARTS):
        near = _solve(onsets, weights, start, (), _NEARLY)
        if any(np.allclose(near.theta, other.theta, 1e-2, 1e-2) for other in found):
            continue
        free = _solve(onsets, weights, near.theta, ())
        if min(free.theta[1:]) >= 0:
            found.append(free)
            continue
        ends = (_solve(onsets, weights, start, held) for held in ((1,), (2,), (1, 2)))
        found += [end for end in ends if min(end.theta[1:]) >= 0]
    return sorted(found, key=lambda fit: (not fit.found, fit.squares))


def _solve(
    onsets: Onsets, weights: np.ndarray, start: np.ndarray, held: tuple[int, ...], tolerance: float = _ARRIVED
) -> _Candidate:
    from scipy.optimize import least_squares

    free = [k for k in range(3) if k not in held]
    theta = start.copy()
    theta[list(held)] = 0.0

    @lru_cache(maxsize=1)  # The solver asks for values and slopes apart.
    def evaluate(values: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
        at = theta.copy()
        at[free] = values
        with np.errstate(all="ignore"):
            kappa, w, slopes, arrived = onsets.follow(at)
            ratios = np.stack([np.log(kappa / onsets.kappa), np.log(w / onsets.w)], -1)
        good = arrived & np.all(np.isfinite(ratios), -1) & np.all(np.isfinite(slopes), (1, 2))
        # Where no such wall is found, as wrong as can be, and flat.
        ratios, slopes = np.where(good[:, None], ratios, 10.0), np.where(good[:, None, None], slopes, 0.0)
        return at, ratios * weights, _weigh(slopes, weights)[:, free], bool(good.all())

    found = least_squares(
        lambda x: evaluate(tuple(x))[1].ravel(),
        theta[free],
        lambda x: evaluate(tuple(x))[2],  # pyright: ignore[reportArgumentType]  (a function or a name)
        method="lm",
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
        max_nfev=200,
    )
    at, residuals, _, good = evaluate(tuple(found.x))
    names = tuple(("mass", "damping", "delay")[k] for k in held)
    return _Candidate(at, float((residuals**2).sum()), -residuals, names, good)


def _at_edge(onsets: Onsets, fit: _Candidate, period: float, velocity: Velocity) -> bool:
    """Whether the fitted walls are where stability ends as K rises: other lobes hold walls that buzzed long before."""
    kappa = onsets.follow(fit.theta)[0]
    if not np.all(kappa > 0):
        return False
    scene = scene_of(in_si(fit.theta, period)[0], period, velocity)
    return bool(np.all(_edges(scene, kappa / period**2, onsets.rub / period)))


def _edges(scene: Scene, stiffness: np.ndarray, virtual_damping: np.ndarray) -> np.ndarray:
    softer = scene.is_stable(stiffness * (1 - _BESIDE), virtual_damping)
    return softer & ~scene.is_stable(stiffness * (1 + _BESIDE), virtual_damping)


def _unlikely(freedom: int) -> float:
    from scipy.stats import chi2

    return float(chi2.isf(_CHANCE, freedom))


def _refuse_blind(slopes: np.ndarray, theta: np.ndarray, table: np.ndarray) -> None:
    sizes = np.linalg.norm(slopes, axis=0)
    if not np.all(sizes > 0) or np.linalg.cond(slopes / sizes) > _BLIND:
        dampings = ", ".join(f"{value:g}" for value in np.unique(table[:, 1]))
        raise InputError(
            f"points: walls of B = {dampings} N s/m cannot tell m, b and t_d apart"
            + (f", the mass hardly counts beside the damping (b T/m = {plain(theta[1], 2)})" if theta[1] > 3 else "")
            + "; what is missing is a wall of a damping farther away"
        )


def _further(
    stiffest: StiffnessEstimate,
    theta: np.ndarray,
    information: np.ndarray,
    wanted: np.ndarray,
    weights: np.ndarray,
) -> FurtherExperiment | None:
    """The wall of the device's own boundary, B >= 0, after which K_max is known best."""
    scene = stiffest.scene
    period, mass = scene.timing.period, np.exp(theta[0])
    w = np.linspace(0.0, np.pi, _ANGLES + 2)[1:-1]
    # Slow loops have all of their boundary at low frequencies.
    w = np.concatenate([np.geomspace(1e-4, w[0], 60)[:-1], w])
    estimate = scene.velocity.estimate(period)
    f, q = estimate.jet(circle(w)).value, needed_answer(w, theta[1], theta[2]).q
    rub = mass * q.imag / f.imag
    kappa = mass * q.real - rub * f.real
    # Softer walls than a tenth of the stiffest are outside of what anybody measures well.
    real = (rub >= 0) & (kappa > 0.1 * stiffest.value * period**2)
    stiffness, damping = kappa[real] / period**2, rub[real] / period
    if not stiffness.size:
        return None
    edge = _edges(scene, stiffness, damping)
    if not edge.any():
        return None
    walls = Onsets(kappa[real][edge], rub[real][edge], w[real][edge], estimate)
    rows = walls.follow(theta)[2] * weights[:, None]
    after = np.linalg.solve(information + np.einsum("nki,nkj->nij", rows, rows), wanted[:, None])[..., 0] @ wanted
    best = int(np.argmin(after))
    return FurtherExperiment(
        float(damping[edge][best]),
        float(stiffness[edge][best]),
        float(walls.w[best] / (2 * np.pi * period)),
        float(np.sqrt(max(after[best], 0.0))),
    )
